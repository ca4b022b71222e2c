"""Flare spectra in studies, flags and answers."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import expectations
from refusals import refused
from scenes import through

import mauvecl
from mauvecl import BalmerFlare, Blackbody, FlareWithLines, Source, Study, stare

DATA = Path(__file__).parent.parent / "data"
FILE, QUIET = DATA / "spectra" / "ADLeo_912s.dat", DATA / "flares" / "adleo_quiescent2.dat"
OF_FILE: dict[str, Any] = {
    "file": str(FILE), "quiescent": str(QUIET), "wavelength_unit": "Angstrom", "continue_at_k": 9500.0
}  # fmt: skip
#: Section of a study for each spectrum, and the spectrum at 9000 K.
TEXTS: dict[str, tuple[dict[str, Any], Any]] = {
    "blackbody": ({}, Blackbody(9000.0)),
    "jump": ({"balmer_jump": 2.5, "electron_temperature_k": 8000.0}, BalmerFlare(9000.0, 2.5, 8000.0)),
    "two": ({"second_temperature_k": 25_000.0, "second_area": 0.1}, mauvecl.TwoBlackbodies(9000.0, 25_000.0, 0.1)),
    "lines": (
        {"lines": {"Mg II": 0.04, "H alpha": 0.1}, "line_scale": 0.5, "balmer_jump": 2.0},
        FlareWithLines(BalmerFlare(9000.0, 2.0), {"Mg II": 0.02, "H alpha": 0.05}),
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
    fixed = FlareWithLines(Blackbody(9000.0), {}, {"Mg II": 1e-12, "H beta": 2e-12})
    for amplitude in (0.01, 0.1):
        plain, lit = star.flaring(amplitude, 9000.0), star.flaring(amplitude, spectrum=fixed)
        near = (lit.wavelength_nm > 279) & (lit.wavelength_nm < 281)
        nm = lit.wavelength_nm[near]
        extra = lit.flux_flam[near] - np.interp(nm, plain.wavelength_nm, plain.flux_flam)
        assert 10 * np.trapezoid(extra, nm) == pytest.approx(1e-12, rel=0.01)
