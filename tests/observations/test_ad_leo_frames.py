"""The great flare of AD Leo (1985) as frames of Mauve: found, measured, and its departure from a blackbody noticed.

The published spectra at 912 and 1497 s, less the quiescent one, rise and decay as template flares with a half-width of
120 s, with the peak of the published flux: net flux in 200-330 nm 4.0e-9 and 9.2e-10 erg/s/cm2, colour temperature
9500 K in the optical, 13 800-14 500 K between 270 and 417 nm at 912 s.
"""

from pathlib import Path

import numpy as np
import pytest

from mauvecl import SHAPES, Frames, Instrument, ObservedFlare, Source, Study, analyse, expect

DATA = Path(__file__).parents[1] / "data"
FILES = {912: DATA / "spectra" / "ADLeo_912s.dat", 1497: DATA / "flares" / "ADLeo_1497s.dat"}
QUIET = DATA / "flares" / "adleo_quiescent2.dat"
NET = {912: 4.0e-9, 1497: 9.2e-10}
N, FRAME_S, PEAKS_S, HALF_WIDTH_S = 2880, 5.0, {912: 4800.0, 1497: 9600.0}, 120.0
DISTANCE_PC = 4.97
TIME = (np.arange(N) + 0.5) * FRAME_S
EDGES = np.column_stack([TIME - FRAME_S / 2, TIME + FRAME_S / 2])


def course(seconds: int) -> np.ndarray:
    return SHAPES["davenport2014"].mean_over(EDGES, PEAKS_S[seconds], HALF_WIDTH_S)


@pytest.mark.long
def test_temperatures_and_luminosities_are_those_of_the_spectra() -> None:
    """Statistical errors are 4 % at 912 s and 13 % at 1497 s; a blackbody adds some 7 % to the ultraviolet at 912 s."""
    star, mauve = Source.read(QUIET, wavelength_unit="Angstrom", extend="M3V"), Instrument.load("mauvesim")
    quiet = expect(star, mauve, exposure=FRAME_S)
    light = np.tile(quiet.light_dn, (N, 1))
    for seconds, path in FILES.items():
        flare = ObservedFlare.read(path, QUIET, wavelength_unit="Angstrom", continue_at_k=9500.0)
        grid = flare.grid(star.wavelength_nm)
        both = Source(grid, np.interp(grid, star.wavelength_nm, star.flux_flam) + flare.flux(grid), "AD Leo", "test")
        light += np.outer(course(seconds), expect(both, mauve, exposure=FRAME_S).light_dn - quiet.light_dn)
    fixed = quiet.unsaturated_variance_dn2 - quiet.gain_dn_per_electron * quiet.light_dn
    rng = np.random.default_rng(912)
    drawn = rng.normal(light, np.sqrt(fixed + quiet.gain_dn_per_electron * light))
    bins = (quiet.element == np.arange(quiet.element_wavelength_nm.size)[:, None]).astype(float)
    error = np.sqrt(bins @ quiet.unsaturated_variance_dn2) / FRAME_S
    frames = Frames.of(
        TIME, drawn @ bins.T / FRAME_S, np.tile(error, (N, 1)), exposure_s=FRAME_S, name="AD Leo", unit="adu / s",
        wavelength_nm=quiet.element_wavelength_nm,
    )  # fmt: skip
    sections = {
        "star": [{"file": QUIET, "wavelength_unit": "Angstrom", "extend": "M3V", "distance_pc": DISTANCE_PC}],
        "search": {"per": "day"},
        "measure": {"bands_nm": [[200, 330], [200, 700]]},
    }
    answer = analyse(Study(**sections), frames=frames)  # type: ignore[arg-type]
    survey, significant = answer.analysis.survey, [row for row in answer.rows if row.significant]
    rows = [max(significant, key=lambda row: -abs(survey.time_s[row.event.brightest] - PEAKS_S[one])) for one in FILES]
    assert [row.event.kind for row in rows] == ["flare", "flare"]
    # A sixth of a false alarm is promised; more than two happen once in 1500 draws.
    assert len(significant) <= 2 + 2
    for row, seconds in zip(rows, FILES, strict=True):
        found = row.measured
        assert not isinstance(found, str), found
        assert abs(survey.time_s[row.event.brightest] - PEAKS_S[seconds]) < 30
        inside = np.isin(TIME, survey.time_s[row.event.first : row.event.last + 1])
        luminosity = NET[seconds] * course(seconds)[inside].mean() * 4 * np.pi * (DISTANCE_PC * 3.0857e18) ** 2
        k = found.column("luminosity 200-330 nm")
        assert found.low[1, 0, k] < luminosity < found.high[1, 0, k] or seconds == 912
        assert found.estimates[0, k] == pytest.approx(luminosity, rel={912: 0.2, 1497: 0.4}[seconds])
        temperature, low, high = row.quantity("temperature")
        assert low < temperature < high
        assert 9500 < temperature < 14_500
    # A blackbody does not fit the epoch of the peak, and the answer says so.
    assert rows[0].measured.p_value[0] < 1e-3  # type: ignore[union-attr]
    assert "no flare of one temperature fits" in rows[0].note
