"""Common Python usage: equality, text, pickles, 1e5, pictures in given axes, and exchange with other packages."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from answers import FEW, QUICK
from astropy.table import Table
from marks import long_but
from refusals import refused
from scenes import paper, quiescent, source

import mauvecl
from mauvecl import Blackbody, Engine, Expectation, Frames, Instrument, Pool, Sky, Source, Study, expect
from mauvecl.host.stars import flare as flare_tables

#: A few pixels and less usual questions.
SETTINGS = ["observation.changes={output_min_nm=300.0, output_max_nm=322.0}", "flare.amplitudes=[0.1, 0.3]"]
ASKED = QUICK | {
    "detect": ["run.statistics=['matched', 'chi2']"],
    "exposure": ["signal.snr=5", "signal.wavelength_nm=310"],
    "limit": ["limit.power=0.9", "flare.amplitudes=[0.3]"],
    "map": ["map.x={quantity='magnitude', values=[7.0, 8.0]}", "map.y={quantity='amplitude', values=[0.1, 0.3]}"],
}
#: Verbs, and parts of their answers.
ANSWERS = (*ASKED, "detect detection", "snr result")


def answer(name: str, engine: Engine, value: float = 7.0) -> Any:
    """Ask a verb about a star of a magnitude, which is the seed as well."""
    verb, *part = name.split()
    asked = paper(*FEW, *SETTINGS, *ASKED[verb], f"star.0.magnitude={value}", f"run.seed={value:.0f}")
    found = getattr(mauvecl, verb)(asked, mauvecl.Stares() if verb == "plan" else engine)
    return getattr(found.stars[0], part[0]) if part else found


def things() -> dict[str, Callable[[float], Any]]:
    mauve = Instrument.load("mauvesim")
    return {
        "Source": lambda v: Source.from_library("G2V").at_magnitude(v),
        "Instrument": lambda v: mauve.with_(temperature_c=v),
        "Expectation": lambda v: expect(Source.from_library("G2V").at_magnitude(v), mauve, exposure=50),
        "Sky": Sky.of_brightness,
        "Study": lambda v: paper(*FEW, f"star.0.magnitude={v}"),
        "PixelMap": lambda v: mauvecl.PixelMap.made_up(50, seed=int(v)),
        "Linear": lambda v: mauvecl.Linear("mine", np.full(9, v)),
        "Nuisances": lambda v: mauvecl.Nuisances(("own",), np.ones((1, 5)), np.array([v])),
    }


@pytest.mark.parametrize("name", [*ANSWERS, *things()])
def test_objects_compare_by_content_are_pickled_and_have_short_repr(engine: Engine, name: str) -> None:
    def make(value: float) -> Any:
        return answer(name, engine, value) if name in ANSWERS else things()[name](value)

    one, same, other = make(7.0), make(7.0), make(9.0)
    # Tables of one are read, which is not to change what it is.
    assert getattr(one, "tables", True)
    assert pickle.loads(pickle.dumps(one)) == one == same
    assert one not in (other, "another thing")
    if name != "Study":
        assert len({one, same, pickle.loads(pickle.dumps(one)), other}) == 2
    assert len(repr(one)) < {"change": 260}.get(name, 200 if name in ANSWERS else 160)
    assert "\n" not in repr(one)


def test_tuples_may_be_single_values(engine: Engine, scene: list[Expectation]) -> None:
    quiet, flare, _ = scene
    found = engine.detect(quiet, [flare], realisations=10_000, seed=1, statistics=("matched",))
    for one in (engine, Pool()):
        assert one.detect(quiet, flare, realisations=1e4, seed=1, statistics="matched") == found


def test_tables_have_units_and_texts_of_notebooks_their_values(scene: list[Expectation]) -> None:
    quiet = scene[0]
    for table, snr_of in ((quiet.table, quiet.snr()), (quiet.element_table, quiet.snr_per_element())):
        assert (table["wavelength"].unit, table["signal"].unit, table["noise"].unit) == (u.nm, u.DN, u.DN)
        np.testing.assert_allclose((table["signal"] / table["noise"]).value, snr_of)
    mauve = Instrument.load("mauvesim").table
    assert mauve["effective_area"].unit == u.cm**2
    np.testing.assert_allclose(mauve["effective_area"].value / mauve["throughput"], 122.0)
    star = Source.from_library("G2V").table
    again = Source.from_arrays(star["wavelength"], star["flux"])
    np.testing.assert_allclose(again.flux_flam, Source.from_library("G2V").flux_flam)
    assert "best S/N" in quiet._repr_html_()
    star = Source.from_arrays(np.linspace(170, 800, 50), np.ones(50), name="<script>")
    assert "<script>" not in star._repr_html_()


@pytest.mark.parametrize("name", long_but(["Source", "Expectation", *ANSWERS], "Source", "Expectation", "snr", "limit"))
def test_pictures_are_drawn_into_given_axes(engine: Engine, name: str) -> None:
    """Draw into the second of three axes; nothing outside of them changes."""
    import matplotlib.pyplot as plt

    made = answer(name, engine) if name in ANSWERS else things()[name](7.0)
    figure, axes = plt.subplots(1, 3, figsize=(15, 6))
    before = [ax.get_position().bounds for ax in axes]
    how = {"fap": 0.05} if name == "detect detection" else {}
    assert made.plot(ax=axes[1], **how) is axes[1]
    drawn = [axes[1]] + [ax for part in figure.subfigs for ax in part.axes]
    assert any(ax.lines or ax.collections or ax.images or ax.patches for ax in drawn)
    assert not any(ax.lines for ax in (axes[0], axes[2]))
    assert figure._suptitle is None
    figure.canvas.draw()
    # A colour bar takes its room from its own axes.
    after = [ax.get_position().bounds for ax in axes]
    assert (after[0], after[2]) == (before[0], before[2])
    assert plt.fignum_exists(figure.number)
    plt.close(figure)
    own = made.plot(**how)
    assert own.axes
    # One panel needs no grid, with or without a colour bar.
    if len(own.axes) > 1 and name != "map":
        figure = plt.figure()
        with refused("ax"):
            made.plot(ax=figure.add_axes((0, 0, 1, 1)), **how)
        plt.close(figure)


SUN = source("G2V", 7.4)


def test_synphot_spectrum_round_trips_and_one_of_stsynphot_is_read(recwarn: pytest.WarningsRecorder) -> None:
    from synphot import SourceSpectrum
    from synphot.models import Empirical1D

    back = Source.from_synphot(SUN.to_synphot(), name="G2V")
    found = np.interp(SUN.wavelength_nm, back.wavelength_nm, back.flux_flam)
    np.testing.assert_allclose(found, SUN.flux_flam, rtol=1e-10, atol=1e-25)
    # As many photons at all wavelengths are no straight line between two points.
    flat = Source.from_synphot(SourceSpectrum(Empirical1D, points=[1600, 11_000], lookup_table=[1.0, 1.0]))
    nm = np.arange(200.0, 700.0, 7.3)
    light = nm * np.interp(nm, flat.wavelength_nm, flat.flux_flam)
    np.testing.assert_allclose(light, light[0], rtol=1e-5)
    # What stsynphot's parser makes of expressions that need no data files.
    parser = pytest.importorskip("stsynphot.spparser")
    found = Source.from_synphot(parser.parse_spec("rn(bb(9000),box(5500,100),15,abmag)"))
    assert found.at_magnitude(8.0).magnitude("V") == pytest.approx(8.0, abs=1e-6)
    body = Source.from_arrays(found.wavelength_nm, Blackbody(9000.0).flux(found.wavelength_nm))
    np.testing.assert_allclose(found.at_magnitude(8.0).flux_flam, body.at_magnitude(8.0).flux_flam, rtol=1e-3)


def test_specutils_spectra_are_read_and_made() -> None:
    specutils = pytest.importorskip("specutils")
    out = SUN.to_specutils()
    back = Source.from_specutils(out, name="G2V")
    np.testing.assert_array_equal((back.flux_flam, back.wavelength_nm), (SUN.flux_flam, SUN.wavelength_nm))
    other = specutils.Spectrum(spectral_axis=SUN.wavelength_nm * u.nm, flux=out.flux.to(u.W / u.m**2 / u.um))
    np.testing.assert_allclose(Source.from_specutils(other).flux_flam, SUN.flux_flam)
    other.mask = SUN.wavelength_nm > 1000.0
    assert Source.from_specutils(other).wavelength_nm[-1] <= 1000.0
    quiet, signal = quiescent(), quiescent().to_specutils()
    np.testing.assert_array_equal(signal.flux.value, quiet.signal_dn)
    np.testing.assert_allclose(signal.uncertainty.array, np.sqrt(quiet.variance_dn2))
    assert not signal.mask.any()


def test_data_frame_and_fits_table_are_read(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    seconds, light = pandas.Series(np.arange(20.0)), pandas.Series([None] + 19 * [7], dtype="Int64")
    np.testing.assert_array_equal(Frames.of(seconds, light).flux, [np.nan] + 19 * [7.0])
    frame = pandas.DataFrame({"Amplitude": [0.1, 0.2], "Start": [1.0, 2.0]})
    found = flare_tables.flares_of(frame)
    assert (found["amplitude"].tolist(), found["start"].to_value("h").tolist()) == ([0.1, 0.2], [24.0, 48.0])
    frame.to_csv(tmp_path / "f.csv", index=False)
    assert Study.of(flares=str(tmp_path / "f.csv")).flare.amplitudes == (0.1, 0.2)
    Table({"amp": [0.3, 0.1, 0.3], "istart": [1, 2, 3]}).write(tmp_path / "f.fits")
    with pytest.warns(UserWarning, match="not used: istart"):
        study = Study.of(flares=str(tmp_path / "f.fits"))
    assert study.flare.amplitudes == (0.1, 0.3), "each amplitude once"
