"""Spectra of frames: line indices, the colour of events, and flares of neighbours that look like one."""

from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from scenes import MG_II, analysed

from mauvecl import Frames, Instrument, Source, Study, analyse, expect
from mauvecl.observations import visits

AU_MIC = Path(__file__).parents[1] / "data" / "flares" / "aumic_iue"
NM = np.linspace(270.0, 290.0, 201)
LINE = np.exp(-((NM - 280.0) ** 2) / 2 / 0.3**2) / 0.3 / np.sqrt(2 * np.pi)


def mg_ii(nm: np.ndarray, flux: np.ndarray, error: np.ndarray | None = None) -> tuple[float, float]:
    found = visits.line_index(nm, flux, error, **MG_II)
    return float(found.flux), float(found.error)


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_straight_continuum_is_removed_exactly(slope: float) -> None:
    found = visits.line_index(NM, 5.0 + slope * (NM - 280) + 2 * LINE, **MG_II)
    assert found.flux == pytest.approx(2.0, abs=2e-6)
    assert found.equivalent_width_nm == pytest.approx(0.4, abs=1e-5)
    assert np.isnan(found.error)


def test_batch_of_spectra_equals_single_spectra() -> None:
    rng = np.random.default_rng(1)
    flux, error = 5.0 + rng.normal(0, 0.1, (4, NM.size)), rng.uniform(0.05, 0.2, (4, NM.size))
    error[2, 60] = np.nan
    found = visits.line_index(NM * u.nm, flux, error, **MG_II)
    for k in range(4):
        assert (found.flux[k], found.error[k]) == pytest.approx(mg_ii(NM, flux[k], error[k]), rel=1e-12)


def test_mg_ii_of_au_mic_lies_in_the_published_range() -> None:
    """20 IUE spectra: 0.6-3.5e-12 erg/s/cm2, median 3.0e-12; formal errors from 1e-13, of long exposures, to 5e-13."""
    found = []
    for path in sorted(AU_MIC.glob("lp*.txt")):
        angstrom, flux, error = np.loadtxt(path, skiprows=19, usecols=(0, 1, 2)).T
        # Per nm, so that the index is a flux.
        found.append(mg_ii(angstrom / 10, 10 * flux, 10 * error))
    flux, error = np.array(found).T
    assert flux.size == 20
    assert [round(float(1e12 * x), 1) for x in (flux.min(), np.median(flux), flux.max())] == [0.6, 3.0, 3.5]
    assert 7e-14 < error.min() < 1e-13
    assert error.max() < 5e-13


def test_the_answer_tells_a_flare_from_a_change_of_throughput() -> None:
    rng = np.random.default_rng(299)
    star, blue, shape, loss = np.linspace(100.0, 900.0, 40), np.linspace(300.0, 50.0, 40), np.zeros(300), np.ones(300)
    shape[80:100] = np.exp(-np.arange(20) / 6.0)
    loss[200:215] = 1.15
    mean = (star + shape[:, None] * blue) * loss[:, None]
    error = np.full(mean.shape, 15.0)
    wavelength = np.linspace(200.0, 700.0, 40)
    frames = Frames.of(np.arange(300) * 60.0, rng.normal(mean, error), error, wavelength_nm=wavelength)
    events = analysed(frames).events
    flare, change = (next(row for row in events if row["istart"] <= at <= row["istop"]) for at in (82, 205))
    assert flare["blue_over_red"] > 2
    assert flare["p_no_colour"] < 1e-6
    assert abs(change["blue_over_red"] - 1) < 4 * change["blue_over_red_error"]
    assert change["p_no_colour"] > 1e-4


def electrons(source: Source) -> float:
    return float(expect(source, Instrument.load("mauvesim"), exposure=50.0).source_electrons.sum())


def test_analyse_lists_for_each_event_the_flares_that_raise_the_light_as_much(tmp_path: Path) -> None:
    """The light of a flare of unit amplitude on each star, made by hand, says how large it must be."""
    (tmp_path / "near.csv").write_text("name,separation,magnitude,spectral_type\nB,8,10,M4V\nC,30,12,G2V\nD,60,1,A0V\n")
    star = {"library": "M3V", "magnitude": 9.0, "neighbours": tmp_path / "near.csv", "neighbour_share": 0.8}
    study = Study.model_validate({"star": [star], "search": {"per": "day"}})
    rng = np.random.default_rng(3)
    time = np.arange(400) * 60.0
    flux = rng.normal(1000.0, 5.0, 400)
    flux[200:206] += [400, 300, 200, 120, 60, 30]
    answer = analyse(study, frames=Frames.of(time, flux, np.full(400, 5.0)))
    n, table = len(answer.events), answer.tables["neighbour-flares"]
    assert n >= 1
    assert table["star"].tolist() == ["M3V V = 9", "B", "C"] * n
    stars = [Source.from_library(x).at_magnitude(m) for x, m in (("M3V", 9.0), ("M4V", 10.0), ("G2V", 12.0))]
    light = np.array([electrons(one) for one in stars])
    shares = np.array([1.0, 0.8, 0.8])
    rise = shares * (np.array([electrons(one.flaring(1.0)) for one in stars]) - light) / (shares @ light)
    np.testing.assert_allclose(table["amplitude"], table["ampl_rec"] / np.tile(rise, n), rtol=1e-9)
    duration = [one.equivalent_duration_s for one in answer.analysis.events for _ in stars]
    np.testing.assert_allclose(table["equivalent_duration"].to_value("s"), duration / np.tile(rise, n), rtol=1e-9)
    assert "neighbours.ecsv" in answer.files
    assert any("assumption: 80 % of it enters" in text for text in answer.messages)
