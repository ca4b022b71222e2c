"""Photosphere, magnitude and flare of each star of a study, and processes in its stares."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import expectations, small
from marks import long_but
from refusals import refused
from scenes import through
from tables import DATA

import mauvecl
from mauvecl import Blackbody, Engine, Instrument, Source, Stares, Study, detect, expect, simulate, stare

PART = {"changes": {"output_min_nm": 300.0, "output_max_nm": 330.0}}


def study(*stars: dict[str, Any], **flare: Any) -> Study:
    given = [{"magnitude": 8.0} | star for star in stars]
    return Study.build({"star": given, "flare": {"amplitudes": [0.1]} | flare, "observation": PART}, "test").paper()


def light(asked: Study) -> list[np.ndarray]:
    few = asked.with_settings(["run={realisations=500, fap=0.3, statistics=['matched']}"])
    return [one.detection.flares[0].source_electrons for one in detect(few).stars]


def test_each_star_has_its_own_photosphere() -> None:
    """The default is the library's temperature; a star's own temperature overrides it, as does that of the flare."""
    both = light(study({"library": "G2V"}, {"library": "M3V"}, geometry="replaces"))
    for found, name, kelvin in zip(both, ("G2V", "M3V"), (5636.0, 3295.0), strict=True):
        star = Source.from_library(name).at_magnitude(8.0)
        flaring = star.flaring(0.1, geometry="replaces", photosphere_temperature=kelvin)
        wanted = expect(flaring, Instrument.load("mauvesim").with_(**PART["changes"]), exposure=50)
        np.testing.assert_allclose(found, wanted.source_electrons, rtol=1e-12)
    # In a stare it is below every flare, of which the first is as far from the start as from the next.
    few = ["stare={duration_s=60, search=false, bands_nm=[]}", "flare.amplitudes=[0.1, 0.2]"]
    stared = stare(study({"library": "G2V"}, geometry="replaces").with_settings(few))
    assert stared.events["peak_time"].value.tolist() == [20.0, 40.0]
    staring = stared.stares[0].staring
    rise = both[0] - staring.quiet.source_electrons
    np.testing.assert_allclose(staring.flare_electrons, [rise / 0.1], rtol=1e-9, atol=1e-9 * rise.max())
    own = study({"library": "G2V", "effective_temperature_k": 5000.0, "distance_pc": 10.0}, geometry="replaces")
    one = study({"library": "G2V"}, geometry="replaces", photosphere_temperature_k=5000.0)
    np.testing.assert_array_equal(light(own), light(one))
    assert not np.array_equal(light(own)[0], both[0])
    assert Study.build(own.model_dump(), "again") == own
    # Another star has its own temperature and distance.
    other = own.at("star", "M3V").star[0]
    assert (other.effective_temperature_k, other.distance_pc) == (None, None)
    # Its V in the list is no magnitude in another band.
    bands = {"Kepler": None, "V": 8.81, "Johnson V": 8.81}
    vega = {band: study({"library": "Vega", "magnitude": None, "band": band}) for band in bands}
    assert {band: one.at("star", "AU Mic").star[0].magnitude for band, one in vega.items()} == bands


#: Normal priors whose effect exceeds the noise of a frame's total light; the cuts are five standard deviations away.
PRIORS = {
    "jitter": {"normal": [0.25, 0.05], "between": [0.0, 0.5]},
    "detector_temperature": {"normal": [20.0, 1.0], "between": [15.0, 25.0]},
    "light_loss": {"normal": [0.4, 0.06], "between": [0.1, 0.7]},
    "pointing_loss": {"normal": [0.3, 0.05], "between": [0.05, 0.55]},
    "qe_scale": {"normal": [1.1, 0.1], "between": [0.6, 1.6]},
    "sky_level": {"normal": [1.2, 0.15], "between": [0.45, 1.95]},
}
#: Sky that is bright enough for its level to be seen.
BRIGHT = {"surface_brightness": 12.0}
N = 4000


def asked(name: str) -> Study:
    star, stare = [{"library": "G2V", "magnitude": 6.0}], {"duration_s": 5.0}
    return small(star=star, sky=BRIGHT, observation={"exposure_s": 5.0}, stare=stare, processes={name: PRIORS[name]})


def frames(study: Study, count: int, **how: Any) -> Any:
    """Draw the total of the only frame of many stares."""
    staring = stare(study).stares[0].staring
    components = staring.components(np.ones((1, staring.quiet.wavelength_nm.size)))
    return Stares().frames(components, staring.stare, count=count, **how)[:, 0, 0]


@pytest.mark.parametrize("name", long_but((name for name, _ in Study().processes if name != "cosmic_rays"), "qe_scale"))
def test_stare_draws_prior_as_exposure_does(engine: Engine, name: str) -> None:
    """Compare moments of a frame's total: five standard errors of twelve comparisons fail once in 1e5."""
    study = asked(name)
    quiet = simulate(study).observations[0][1]
    exposures = engine.realise(quiet, count=N, seed=3, processes=study.processes).sum(axis=1) - quiet.mean_raw_dn.sum()
    found = frames(study, N, seed=4)
    assert exposures.std() > 3 * np.sqrt(quiet.unsaturated_variance_dn2.sum())
    assert abs(found.mean() - exposures.mean()) < 5 * np.hypot(found.std(), exposures.std()) / np.sqrt(N)
    assert abs(np.log(found.std() / exposures.std())) < 5 / np.sqrt(N)


FILE, QUIET = DATA / "spectra" / "ADLeo_912s.dat", DATA / "flares" / "adleo_quiescent2.dat"
OF_FILE: dict[str, Any] = {
    "file": str(FILE), "quiescent": str(QUIET), "wavelength_unit": "Angstrom", "continue_at_k": 9500.0
}  # fmt: skip
#: Section of a study for each spectrum, and the spectrum at 9000 K.
TEXTS: dict[str, tuple[dict[str, Any], Any]] = {
    "blackbody": ({}, Blackbody(9000.0)),
    "jump": ({"balmer_jump": 2.5, "electron_temperature_k": 8000.0}, mauvecl.BalmerFlare(9000.0, 2.5, 8000.0)),
    "two": ({"second_temperature_k": 25_000.0, "second_area": 0.1}, mauvecl.TwoBlackbodies(9000.0, 25_000.0, 0.1)),
    "lines": (
        {"lines": {"Mg II": 0.04, "H alpha": 0.1}, "line_scale": 0.5, "balmer_jump": 2.0},
        mauvecl.FlareWithLines(mauvecl.BalmerFlare(9000.0, 2.0), {"Mg II": 0.02, "H alpha": 0.05}),
    ),
    "file": (OF_FILE, mauvecl.ObservedFlare.read(FILE, QUIET, wavelength_unit="Angstrom", continue_at_k=9500.0)),
}


def study_of(name: str, **flare: Any) -> Study:
    return Study.build(
        {
            "star": [{"library": "M3V", "magnitude": 9.0, "distance_pc": 5.0}],
            "flare": {"temperature_k": 9000.0, "amplitudes": [0.3], "spectrum": TEXTS[name][0], **flare},
        },
        "test",
    ).paper()


@pytest.mark.parametrize("name", TEXTS)
def test_spectrum_round_trips_through_toml_and_answers_take_it(name: str, tmp_path: Path) -> None:
    study, spectrum = study_of(name), TEXTS[name][1]
    nm = spectrum.grid(np.linspace(200.0, 700.0, 1001))
    np.testing.assert_array_equal(study.flare.light().flux(nm), spectrum.flux(nm))
    (tmp_path / "study.toml").write_text(study.toml())
    assert Study.read(tmp_path / "study.toml") == study
    assert ("spectrum" in study.toml()) == (name != "blackbody")
    fixed = study.flare.spectrum.model_copy(update={"line_fluxes": {"280": 2e-13}, "line_scale": 3.0})
    assert fixed.at_temperature(9000.0).fluxes_cgs == {"280": 3.0 * 2e-13}
    # Only a spectrum with a surface may replace the photosphere.
    with refused("flare_geometry") if name == "file" else nullcontext():
        assert expectations(study_of(name, geometry="replaces"))
    # Detections and stares have the light of the spectrum, and stares its energy.
    short = ["stare.duration_s=600", "observation.exposure_s=5", "stare.search=false"]
    study = study_of(name, amplitudes=[0.05]).with_settings(short)
    star = Source.from_library("M3V").at_magnitude(9)
    wanted = mauvecl.expect(star.flaring(0.05, spectrum=spectrum), "mauvesim", exposure=5.0)
    quiet, flaring = expectations(study)
    np.testing.assert_allclose(flaring.recorded_dn, wanted.recorded_dn, rtol=1e-12)
    (found,) = stare(study).stares
    lit = flaring.source_electrons - quiet.source_electrons
    np.testing.assert_allclose(0.05 * found.staring.flare_electrons[0], lit, rtol=1e-6, atol=1e-9)
    (flare,) = found.flares
    for kind, erg in (("band", flare.band_erg), ("bolometric", flare.bolometric_erg)):
        scale = mauvecl.EnergyScale.of_star(star, 5.0, flare=spectrum, kind=kind)
        assert erg == pytest.approx(scale.erg_per_s * flare.event.equivalent_duration_s, rel=1e-6)


@pytest.mark.parametrize("name", TEXTS)
def test_amplitude_is_the_rise_of_photons_in_the_band_and_energy_that_of_the_light(name: str) -> None:
    """Energies equal the integral of the flux added by `flaring`, extended by the flare's own spectrum."""
    star, spectrum = Source.from_library("M3V").at_magnitude(9), TEXTS[name][1]
    for band in ("GALEX NUV", "Kepler"):
        lit = star.flaring(0.3, spectrum=spectrum, band=band)
        # Magnitudes count photons. Narrow lines are sampled differently there.
        rise = 10 ** (0.4 * (star.magnitude(band) - lit.magnitude(band))) - 1
        assert rise == pytest.approx(0.3, rel=3e-3 if name in ("lines", "file") else 1e-9)
        nm = lit.wavelength_nm
        added = lit.flux_flam - np.interp(nm, star.wavelength_nm, star.flux_flam)
        shape = spectrum.flux(nm)
        used = shape > 0.01 * shape.max()
        np.testing.assert_allclose(added[used] / shape[used], (added[used] / shape[used])[0], rtol=1e-6)
    # Kepler's band is that of the energies.
    added, sphere = added / 0.3, 4 * np.pi * (5.0 * 3.0856775814913674e18) ** 2
    far = spectrum.grid(np.geomspace(20.0, 200_000.0, 30_001))
    share = np.trapezoid(added[(nm > 400) & (nm < 600)], nm[(nm > 400) & (nm < 600)])
    inside = spectrum.grid(np.linspace(400.0, 600.0, 40_001))
    whole = 10 * share * np.trapezoid(spectrum.flux(far), far) / np.trapezoid(spectrum.flux(inside), inside)
    for kind, energy in (("band", through("Kepler", nm, added)), ("bolometric", whole)):
        scale = mauvecl.EnergyScale.of_star(star, 5.0, flare=spectrum, kind=kind)
        assert scale.erg_per_s == pytest.approx(energy * sphere, rel=5e-3), kind


@pytest.mark.long
def test_search_injects_the_flare_of_the_file() -> None:
    """Templates are those of a blackbody for a file, and of the spectrum otherwise; the file has more ultraviolet."""
    few = ["stare.duration_s=2000", "injections={count=20, sizes=2, widths=2, fitted=0}", "search.nulls=0"]
    body, file, jump = (
        mauvecl.inject(study_of(name).with_settings(few)).stars[0].survey for name in ("blackbody", "file", "jump")
    )
    np.testing.assert_array_equal(file.templates.directions, body.templates.directions)
    assert not np.array_equal(jump.templates.directions, body.templates.directions)
    assert file.unit_snr > body.unit_snr


def test_lines_of_a_fixed_flux_do_not_scale() -> None:
    star = Source.from_library("M3V").at_magnitude(9)
    fixed = mauvecl.FlareWithLines(Blackbody(9000.0), {}, {"Mg II": 1e-12, "H beta": 2e-12})
    for amplitude in (0.01, 0.1):
        plain, lit = star.flaring(amplitude, 9000.0), star.flaring(amplitude, spectrum=fixed)
        near = (lit.wavelength_nm > 279) & (lit.wavelength_nm < 281)
        nm = lit.wavelength_nm[near]
        extra = lit.flux_flam[near] - np.interp(nm, plain.wavelength_nm, plain.flux_flam)
        assert 10 * np.trapezoid(extra, nm) == pytest.approx(1e-12, rel=0.01)
