"""Sources: photometry, dust-free flares and their spectra, extensions; spectra of tables, archives and odd files."""

import bz2
import csv
import gzip
import lzma
import os
import re
import tracemalloc
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.modeling.physical_models import BlackBody
from astropy.table import Column, MaskedColumn
from corpus import CORPUS, FLUX, NM, cases, value, written
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from refusals import refused
from scenes import BANDS, instrument, source
from tables import DATA, toml

from mauvecl import (
    BalmerFlare,
    Blackbody,
    FlareWithLines,
    InputError,
    ObservedFlare,
    Source,
    TwoBlackbodies,
    expect,
)

GRID_NM = np.arange(170.0, 1100.0, 1.0)
GOOD = GRID_NM * 1e-15
SUN, MAUVE = source("G2V", 7.4), instrument()


@pytest.mark.parametrize("band", BANDS)
@pytest.mark.parametrize("name", ["B2IV", "G2V", "K3V"])
def test_photometry_equals_synphot(name: str, band: str) -> None:
    """Compare magnitudes to 1e-13 with synphot, also for spectra that end in the band."""
    from synphot import Empirical1D, Observation, SpectralElement, units

    whole, vega, record = Source.from_library(name), Source.from_library("Vega").to_synphot(), BANDS[band].meta
    nm_of_band, throughput = (np.asarray(BANDS[band][column], float) for column in BANDS[band].colnames)
    element = SpectralElement(Empirical1D, points=nm_of_band * u.nm, lookup_table=throughput)
    through = np.cumsum(throughput)
    # Where the spectrum ends within the band, one that is there leaves 0.5 % of its throughput out.
    last = nm_of_band[np.searchsorted(through, 0.995 * through[-1])]
    inside = whole.wavelength_nm < max(last, 751.0)
    for one in (whole, Source.from_arrays(whole.wavelength_nm[inside], whole.flux_flam[inside])):
        grid = np.union1d(one.wavelength_nm, nm_of_band) * 10.0
        with warnings.catch_warnings():
            # It tells that it tapers.
            warnings.simplefilter("ignore")
            seen = Observation(one.to_synphot(), element, binset=grid, force="taper")
        for system in ("catalogue", "vega", "ab"):
            ab = system == "ab" or (system == "catalogue" and record["system"] == "AB")
            exact = seen.effstim(u.ABmag if ab else units.VEGAMAG, vegaspec=vega, wavelengths=seen.binset).value
            exact += float(record["vega"]) if system == "catalogue" and not ab else 0.0
            assert one.magnitude(band, system) == pytest.approx(exact, abs=1e-13)
            assert whole.at_magnitude(5.0, band, system).magnitude(band, system) == pytest.approx(5.0, abs=1e-9)


def test_vega_has_its_catalogued_magnitude_and_ten_is_fainter() -> None:
    """Compare V = .03 (Johnson et al. 1966), T = 0 (Sullivan et al. 2015), G = .023 (Riello et al. 2021), AB."""
    vega = Source.from_library("Vega")
    for band, catalogued in (("B", 0.03), ("V", 0.03), ("TESS", 0.0), ("Gaia G", 0.023), ("GALEX NUV Vega", 0.0)):
        assert vega.magnitude(band) == pytest.approx(catalogued, abs=1e-9)
    for band in BANDS:
        assert vega.magnitude(band, "vega") == pytest.approx(0.0, abs=1e-9)
    for band in ("Kepler", "GALEX NUV"):
        assert vega.magnitude(band) == vega.magnitude(band, "ab")
    np.testing.assert_allclose(SUN.at_magnitude(9.9).flux_flam, 0.1 * SUN.at_magnitude(7.4).flux_flam, rtol=1e-9)
    # Flares do not depend on the system.
    for system, wanted in {"catalogue": "as in catalogues: AB", "vega": "have Vega at 0", "ab": "are AB"}.items():
        star = SUN.at_magnitude(7.4, "Kepler", system)
        assert wanted in star.scale
        flare = star.flaring(0.24).flux_flam * (SUN.flux_flam[0] / star.flux_flam[0])
        np.testing.assert_allclose(flare, SUN.flaring(0.24).flux_flam)


def test_spectra_are_released_after_their_magnitude_is_computed() -> None:
    n = 500_000
    star = Source(np.linspace(180.0, 1100.0, n), np.full(n, 1e-13), "mine", "made up")
    Source.from_library("G2V").magnitude("V")
    tracemalloc.start()
    star.magnitude("V")
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held < n, "bytes, of which the spectrum has 16 a point"


def test_replacing_flare_hides_photosphere() -> None:
    """Compare with the exact area-weighted sum of two blackbodies, for a star that is a blackbody."""
    cool, hot = (Blackbody(kelvin).flux(GRID_NM) for kelvin in (5000.0, 10_000.0))
    star = Source.from_arrays(GRID_NM, cool)
    difference = star.magnitude("Kepler") - Source.from_arrays(GRID_NM, hot).magnitude("Kepler")
    f = 0.1 / (10 ** (0.4 * difference) - 1)
    flare = star.flaring(0.1, 10_000, geometry="replaces", photosphere_temperature=5000)
    np.testing.assert_allclose(flare.flux_flam, (1 - f) * cool + f * hot, rtol=1e-9)
    # Two halves of a flare hide as much as one of both.
    halves = TwoBlackbodies(10_000.0, 10_000.0, 1.0)
    for light in (halves, FlareWithLines(halves)):
        parts = star.flaring(0.1, spectrum=light, geometry="replaces", photosphere_temperature=5000)
        np.testing.assert_allclose(parts.flux_flam, flare.flux_flam, rtol=1e-9)


def test_short_spectra_are_used_where_they_suffice() -> None:
    """The nominal range refuses others: `data/refusals/host.toml`."""
    narrow, parts = MAUVE.with_(output_min_nm=250.0, output_max_nm=600.0), (slice(None), slice(31, None), slice(500))
    seen = [expect(Source.from_arrays(GRID_NM[part], GOOD[part]), narrow, exposure=5.0) for part in parts]
    for x in seen[1:]:
        np.testing.assert_array_equal(x.source_electrons, seen[0].source_electrons)
    # An instrument that reads further needs light from further, also of spectra that suffice for others.
    efficiency = MAUVE.grating_efficiency
    curves = {name: efficiency.flat(0.1) for name, value in vars(MAUVE).items() if isinstance(value, type(efficiency))}
    wide = MAUVE.with_(output_max_nm=760.0, **curves)
    ends = [Source.from_arrays(np.linspace(180.0, end, 50), np.full(50, 1e-12)) for end in (765.0, 790.0, 900.0)]
    with refused("extend", "must reach 810 nm", "ends at 765 nm"):
        expect(ends[0], wide, exposure=5.0)
    continued, whole = (expect(star, wide, exposure=5.0).source_electrons for star in ends[1:])
    np.testing.assert_allclose(continued, whole, rtol=1e-9)
    # A bright star begins at 180.1 nm, from where the line function hardly reaches the pixels.
    hot, finer = Blackbody(30_000.0).flux(GRID_NM), np.append(180.1, GRID_NM[11:])
    whole, short = Source.from_arrays(GRID_NM, hot), Source.from_arrays(finer, np.interp(finer, GRID_NM, hot))
    assert any("starts at 180.1 nm and is continued to 180 nm" in text for text in short.messages)
    assert short.flux_flam[0] == pytest.approx(short.flux_flam[1:][np.abs(finer - finer[0]) <= 5.0].mean())
    one, other = (expect(star.at_magnitude(5.0), MAUVE, exposure=5.0) for star in (whole, short))
    np.testing.assert_allclose(one.source_electrons, other.source_electrons, rtol=2e-4)
    # Files of CALSPEC begin at 180.02 nm, that of P330E at 199.95 nm: the error is a tenth of the noise at most.
    star = Source.read(DATA / "spectra" / "18sco_stis_004.fits")
    assert star.name == "18SCO"
    for kept in (star.wavelength_nm >= 180.02, star.wavelength_nm >= 199.95):
        short = Source.from_arrays(star.wavelength_nm[kept], star.flux_flam[kept])
        whole, cut = (expect(one, MAUVE, exposure=50.0) for one in (star, short))
        assert (np.abs(cut.signal_dn - whole.signal_dn) < 0.1 * np.sqrt(whole.variance_dn2)).all()
    # What was continued is not taken for measured light in a band.
    cut = Source.from_arrays(GRID_NM[25:], np.where(GRID_NM < 300, 1e-17, GOOD)[25:])
    assert cut.measured_nm == (195.0, 1099.0)
    with refused("band", "195-1099", "99%", "GALEX"):
        cut.magnitude("GALEX NUV")
    # Noise below zero is not continued.
    assert Source.from_arrays(GRID_NM[15:], np.where(GRID_NM < 200, -1e-17, GOOD)[15:]).flux_flam[0] == 0.0


def test_extension_by_another_star() -> None:
    """Cut the library's Sun at both ends and extend it by itself at another brightness."""
    kept = (SUN.wavelength_nm > 250) & (SUN.wavelength_nm < 650)
    short = (SUN.wavelength_nm[kept], 1e-3 * SUN.flux_flam[kept])
    for extension in ("G2V", Source.from_library("G2V")):
        star = Source.from_arrays(*short, name="short", extend=extension)
        assert sum("it is continued by G2V, scaled by" in text for text in star.messages) == 2
        one, other = (expect(x, MAUVE, exposure=5).source_electrons for x in (star.at_magnitude(7.4), SUN))
        np.testing.assert_allclose(one, other, rtol=1e-6)
    whole = Source.from_arrays(SUN.wavelength_nm, SUN.flux_flam, extend="G2V")
    assert "reaches no farther and is not used" in whole.messages[-1]
    # What the library says of its star's ultraviolet is said of a spectrum that it continues to the blue.
    (noisy,) = Source.from_library("M4V").messages
    assert "noise rules" in noisy
    # Zeros at the start stand for missing data.
    dark = Source.from_arrays(GRID_NM, np.where(GRID_NM < 300.0, 0.0, 1e-12), extend="M4V")
    for star in (Source.read(DATA / "spectra" / "vb8_stiswfcnic_004.fits", extend="M4V"), dark):
        assert f"in M4V, {noisy}" in star.messages


def test_measured_noise_is_kept_and_reported_once() -> None:
    """Read a cool star sampled at 0.1 nm, dark below 350 nm, with noise of 1e-14 per point."""
    nm = np.arange(170.0, 1100.0, 0.1)
    flux = np.where(nm > 350, 1e-12, 0.0) + 1e-14 * np.random.default_rng(3).standard_normal(nm.size)
    star = Source.from_arrays(nm, flux, name="cool")
    np.testing.assert_array_equal(star.flux_flam, flux)
    found = expect(star, MAUVE, exposure=50.0)
    (reported,) = (message for message in found.messages if "negative flux" in message)
    assert f"{int((flux[(nm >= 180) & (nm <= 750)] < 0).sum())} of its 570" in reported
    assert (found.source_electrons >= 0).all()
    # Magnitudes take the noise as it is, above and below zero.
    assert star.magnitude("GALEX NUV") != Source.from_arrays(nm, np.maximum(flux, 0), name="x").magnitude("GALEX NUV")
    assert star.binned(5.0).wavelength_nm.size < 200
    # The last bin is at least half as wide as the others.
    assert all(np.diff(SUN.binned(width).wavelength_nm[1:-1]).min() > 0.7 * width for width in (5.0, 9.0, 11.0))
    assert star.binned(5.0).magnitude("V") == pytest.approx(star.magnitude("V"), abs=2e-3)


def test_stated_error_of_a_mean_equals_the_scatter_of_means() -> None:
    """Compare the error that a refusal states with the scatter of means of 100 spectra; 3e-3 of seeds fail."""
    nm, rng = np.arange(170.0, 800.0, 0.5), np.random.default_rng(5)

    def star(level: float) -> Source:
        return Source.from_arrays(nm, np.where(nm > 350.0, 2e-10, level) + 1e-11 * rng.standard_normal(nm.size))

    drawn = [expect(star(2e-10), MAUVE, exposure=5000.0, sky=22.1).source_electrons for _ in range(100)]
    scatter, ratios = np.std(drawn, axis=0), []
    for _ in range(20):
        with refused("bin_nm") as caught:
            expect(star(-1e-10), MAUVE, exposure=5000.0)
        at, error = re.search(r"at ([\d.]+) nm.* error of ([\d.e+]+)", str(caught.value)).groups()
        ratios.append(float(error) / np.interp(float(at), MAUVE.wavelength_nm, scatter))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.3)


FLARE, QUIET = DATA / "spectra" / "ADLeo_912s.dat", DATA / "flares" / "adleo_quiescent2.dat"


def blackbody(nm: np.ndarray, kelvin: float) -> np.ndarray:
    """Return the surface flux of astropy's blackbody, erg s-1 cm-2 A-1."""
    unit = u.erg / (u.s * u.cm**2 * u.AA * u.sr)
    return np.asarray(np.pi * BlackBody(temperature=kelvin * u.K, scale=1.0 * unit)(nm * u.nm).to_value(unit))


SPECTRA = {
    "blackbody": Blackbody(9000.0),
    "two": TwoBlackbodies(7000.0, 25_000.0, 0.1),
    "Balmer": BalmerFlare(9500.0, 2.5),
    "lines": FlareWithLines(BalmerFlare(9500.0, 1.5), {"Mg II": 0.03, "Ca II": 0.02, "Balmer": 0.1, "250": 0.01}),
    "observed": ObservedFlare.read(FLARE, QUIET, wavelength_unit="Angstrom", continue_at_k=9500.0),
}


@pytest.mark.parametrize("spectrum", SPECTRA.values(), ids=SPECTRA)
def test_total_equals_the_integral_on_a_grid_with_lines_and_edges(spectrum: Any) -> None:
    grids = (spectrum.grid(np.linspace(180.0, 750.0, n)) for n in (1141, 57_001))
    coarse, fine = (np.trapezoid(spectrum.flux(grid), grid) for grid in grids)
    assert coarse == pytest.approx(fine, rel=1e-5)
    grid = spectrum.grid(np.geomspace(10.0, 300_000.0, 40_001))
    total = 10.0 * np.trapezoid(spectrum.flux(grid), grid)
    assert spectrum.bolometric_flux() == pytest.approx(total, rel=2e-5)


def test_blackbody_equals_astropy_to_the_last_bit_and_balmer_flare_its_formula() -> None:
    for kelvin in (3000.0, 5772.0, 10_000.0, 50_000.0):
        np.testing.assert_array_equal(Blackbody(kelvin).flux(GRID_NM), blackbody(GRID_NM, kelvin))
    nm, flare = np.array([200.0, 300.0, 364.5, 364.7, 500.0]), BalmerFlare(9500.0, 2.5, 8000.0)
    edge = blackbody(np.array([364.6]), 9500.0)[0]
    # h, c and k of CODATA 2018, SI.
    exponent = 6.62607015e-34 * 2.99792458e8 / (1.380649e-23 * 8000.0) * (1 / nm - 1 / 364.6) * 1e9
    added = np.where(nm <= 364.6, 1.5 * edge * (364.6 / nm) ** 2 * np.exp(-exponent), 0.0)
    np.testing.assert_allclose(flare.flux(nm), blackbody(nm, 9500.0) + added, rtol=1e-8)
    sides = flare.flux(np.array([364.6, 364.601]))
    assert sides[0] / sides[1] == pytest.approx(2.5, rel=1e-4)
    assert BalmerFlare(9500.0, 1.0).flux(nm) == pytest.approx(blackbody(nm, 9500.0), rel=1e-15)


def test_lines_have_their_share_or_flux_at_the_wavelengths_of_their_atoms() -> None:
    """Compare with the Rydberg constant of hydrogen, 1.09677583e7 m-1 (CODATA), and NIST's lines of Ca II and Mg II."""
    plain, nm = Blackbody(10_000.0), np.linspace(200.0, 700.0, 50_001)
    lined = FlareWithLines(plain, {"Mg II": 0.05}, {"H beta": 2e-13})
    grid = lined.grid(nm)
    added = np.trapezoid(lined.flux(grid) - plain.flux(grid), grid) / np.trapezoid(plain.flux(nm), nm)
    assert added == pytest.approx(0.05, rel=1e-6)
    assert 10 * np.trapezoid(lined.flux_at_telescope(grid), grid) == pytest.approx(2e-13, rel=1e-12)
    assert lined.fixed_lines
    assert not FlareWithLines(plain, {"Mg II": 0.05}).fixed_lines

    def centre(*lines: str) -> float:
        flare = FlareWithLines(Blackbody(), {}, dict.fromkeys(lines, 1e-13))
        at = flare.grid(nm)
        return float(np.average(at, weights=flare.flux_at_telescope(at) * np.gradient(at)))

    for n, name in enumerate(("h_ALPHA", "H beta", "H gamma", "H delta", "H epsilon", "H8"), 3):
        assert centre(name) == pytest.approx(1e9 / (1.09677583e7 * (0.25 - 1 / n**2)), abs=0.02)
    for name, at in (("Ca II K", 393.478), ("Ca II H", 396.959), ("Mg II k", 279.635), ("Mg II h", 280.353)):
        assert centre(name) == pytest.approx(at, abs=0.002)
    assert centre("Ca II") == pytest.approx(centre("Ca II K", "Ca II H"), abs=1e-6)


def test_observed_flare_lacks_the_quiescent_star_and_is_continued_if_asked(tmp_path: Path) -> None:
    nm, other = np.linspace(150.0, 800.0, 1301), np.linspace(190.0, 820.0, 2001)
    for name, at, flux in (("both", nm, 3e-14 * nm), ("star", other, 1e-14 * other)):
        np.savetxt(tmp_path / f"{name}.txt", np.column_stack([at, flux]))
    flare = ObservedFlare.read(tmp_path / "both.txt", tmp_path / "star.txt")
    assert flare.measured_nm == (190.0, 800.0)
    inside = nm[nm >= 190.0]
    np.testing.assert_allclose(flare.flux(inside), 2e-14 * inside, rtol=1e-9)
    assert not any("gap" in text for text in flare.messages)
    # What is left of equal spectra may be their rounding.
    for factor in (1.0, 1.0 - 1e-14, 1.01):
        np.savetxt(tmp_path / "same.txt", np.column_stack([nm, factor * 3e-14 * nm]), fmt="%.17e")
        with refused("quiescent", "brighter than same"):
            ObservedFlare.read(tmp_path / "both.txt", tmp_path / "same.txt", continue_at_k=9000.0)
    kept = (nm < 330.0) | (nm > 356.0)
    gap = ObservedFlare.from_arrays(nm[kept], 1e-14 * nm[kept])
    assert any("its gap at 329.5-356.5 nm" in text for text in gap.messages)
    flare = ObservedFlare.from_arrays([150.0, 300.0, 500.0], [1.0, 2.0, 3.0], continue_at_k=8000.0)
    assert flare.measured_nm == (150.0, 500.0)
    assert "8000 K continues it" in flare.messages[-1]
    far = blackbody(np.array([500.0, flare.wavelength_nm[-1]]), 8000.0)
    assert flare.flux_flam[-1] == pytest.approx(3.0 * far[1] / far[0])
    # A finer one is continued from the mean of its last 20 nm.
    nm = np.arange(200.0, 801.0)
    flare, last = ObservedFlare.from_arrays(nm, nm**4, continue_at_k=8000.0), nm >= 780.0
    level = np.trapezoid(nm[last] ** 4) / np.trapezoid(blackbody(nm[last], 8000.0))
    assert flare.flux_flam[-1] == pytest.approx(level * blackbody(flare.wavelength_nm[-1:], 8000.0)[0])


CASES = dict(cases(CORPUS / "spectrum_files.toml"))


def is_right(star: Source) -> bool:
    pairs = ((star.wavelength_nm, NM, 1e-8), (star.flux_flam, FLUX, 1e-6))
    return star.wavelength_nm.size == NM.size and all(np.allclose(*both, rtol, 0) for *both, rtol in pairs)


def is_right_or_raises(folder: Path, head: str, mark: str, columns: dict[str, Any], may_raise: bool) -> None:
    rows = [mark.join(f"{value:.12g}" for value in row) for row in zip(*columns.values(), strict=True)]
    (folder / "star.dat").write_text("\n".join([head, *rows, ""]))
    try:
        star = Source.read(folder / "star.dat")
    except InputError as error:
        assert may_raise, error  # noqa: PT017
        assert "\n" not in str(error)  # noqa: PT017
    else:
        assert is_right(star), star.messages


def test_units_may_be_those_of_astropy_and_frequencies_may_rise_or_fall(tmp_path: Path) -> None:
    case = CASES["spectrum_files assumed units txt"] | {"columns": {"w": "10 * nm", "f": "flux / 100"}}
    assert is_right(Source.read(written(case, tmp_path), wavelength_unit=u.AA, flux_unit=u.W / u.m**2 / u.nm))
    frequency, flux = (NM * u.nm).to(u.Hz, u.spectral()), value('per("Jy")') * u.Jy
    for order in (slice(None), slice(None, None, -1)):
        assert is_right(Source.from_arrays(frequency[order], flux[order]))
    # Columns of a plain table have units but are no Quantities, and values below a mask are none.
    spoilt = MaskedColumn(np.where(NM < 175.0, 1.0, FLUX / 100), unit=u.W / u.m**2 / u.nm, mask=NM < 175.0)
    star = Source.from_arrays(Column(10 * NM, unit=u.AA), spoilt)
    np.testing.assert_allclose((star.wavelength_nm, star.flux_flam), (NM[NM > 175.0], FLUX[NM > 175.0]), rtol=1e-6)


RANDOM = toml("corpus/spectrum_files.toml")["random"]
WAVES, FLUXES = ({name: value(text) for name, text in RANDOM[key].items()} for key in ("waves", "fluxes"))
#: Columns that are not taken for the flux.
NOT_FLUX = [case["head"].split(",")[0] for name, case in CASES.items() if " a column that is no flux " in name]
AT_RANDOM = settings(
    max_examples=150, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.long
@given(
    wave=st.sampled_from(sorted(WAVES)),
    flux=st.sampled_from(sorted(FLUXES)),
    extras=st.lists(
        st.tuples(st.sampled_from(NOT_FLUX + RANDOM["extras"]), st.booleans()), max_size=5, unique_by=lambda one: one[0]
    ),
    order=st.randoms(use_true_random=False),
    mark=st.sampled_from([",", "\t", " ", ";"]),
    remark=st.sampled_from(["", "# "]),
    prose=st.sampled_from(["", "# vacuum wavelengths\n", "# fluxes and errors, in 3 columns\n", "# made in 2024\n"]),
)
@AT_RANDOM
def test_any_table_is_read_correctly_or_raises(
    tmp_path: Path, wave: str, flux: str, extras: list[tuple[str, bool]], order: Any, mark: str, remark: str, prose: str
) -> None:
    columns = [(wave, WAVES[wave]), (flux, FLUXES[flux])]
    columns += [(name, 0.3 * k * FLUX if like else NM + 3.0 * k) for k, (name, like) in enumerate(extras, 1)]
    order.shuffle(columns)
    # Without another column of light there is nothing to ask.
    may_raise = {"foo", *RANDOM["extras"]} & {*dict(extras)}
    is_right_or_raises(tmp_path, prose + remark + mark.join(dict(columns)), mark, dict(columns), bool(may_raise))


@pytest.mark.long
@given(
    lines=st.lists(st.sampled_from(RANDOM["prose"]), min_size=1, max_size=3, unique=True),
    remark=st.sampled_from(["# ", "% ", "! ", ";", ""]),
    mark=st.sampled_from([" ", "\t", ",", "  "]),
    columns=st.sampled_from([{"0": NM, "1": FLUX}, {"0": NM, "1": FLUX, "2": 0.03 * FLUX}]),
)
@AT_RANDOM
def test_prose_in_a_header_changes_nothing(tmp_path: Path, lines: Any, remark: str, mark: str, columns: Any) -> None:
    """Add prose with words for wavelength, flux, errors and units; the first two columns are read, or it raises."""
    is_right_or_raises(tmp_path, "\n".join(remark + line for line in lines), mark, columns, True)


@pytest.mark.long
@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
def test_decompression_bomb_raises_early(pack: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bomb").write_bytes(pack(bytes(64 << 20)))
    monkeypatch.setenv("MAUVECL_LARGEST_CONTENT_MIB", "16")
    # Python reserves the memory of the largest file.
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    tracemalloc.start()
    with refused("MAUVECL_LARGEST_CONTENT_MIB", "16"):
        Source.read(tmp_path / "bomb")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40 << 20


def test_only_regular_files_of_limited_size_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fifo, large = tmp_path / "fifo", tmp_path / "large"
    os.mkfifo(fifo)
    names = ("/dev/zero", fifo, tmp_path, tmp_path / "none", "a\0b", "x\ny" * 5000, tmp_path / ("y" * 300), "\ud800")
    for path in names:
        with refused("file") as caught:
            Source.read(path)
        assert len(str(caught.value)) < 600
    with large.open("wb") as file:
        file.truncate((1 << 20) + 1)
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    with refused("MAUVECL_LARGEST_FILE_MIB", "1"):
        Source.read(large)
    # A file that grows is not cut silently, nor is one whose size the system does not know.
    size, known = os.fstat, os.stat_result
    with monkeypatch.context() as patch, refused("MAUVECL_LARGEST_FILE_MIB", "1"):
        patch.setattr(os, "fstat", lambda handle: known([*size(handle)[:6], 0, *size(handle)[7:]]))
        Source.read(large)
    os.truncate(large, 1 << 20)
    # It is read, and holds no text.
    with refused("file", "null bytes"):
        Source.read(large)
    for limit in ("", "-1", "0", "1e3", "99999999", "٣"):
        monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", limit)
        with refused("MAUVECL_LARGEST_FILE_MIB"):
            Source.read(large)


HERE, ENTRIES = DATA / "spectra", toml("corpus/archive_files.toml")
RIGHT, SHORT = ([pytest.param(one, id=one["file"]) for one in ENTRIES[key]] for key in ("right", "short"))


def by_hand(name: str, flux: str = "FLUX", skip: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Read a file's wavelengths and fluxes, Angstrom and erg s-1 cm-2 A-1, by astropy, or as text."""
    if ".fits" in name:
        data = fits.getdata(HERE / name)
        return data["WAVELENGTH"].astype(float), data[flux].astype(float)
    text = (HERE / name).read_text()
    if name.endswith(".csv"):
        # Gaia's fluxes at 336 + 2 i nm, W m-2 nm-1, which are 100 erg s-1 cm-2 A-1.
        row = next(row for row in csv.DictReader(text.splitlines()) if row["source_id"] == "4")
        return 3360.0 + 20.0 * np.arange(343), 100.0 * np.array(row["flux"].strip("()").split(","), float)
    values = np.array([line.split()[:2] for line in text.splitlines()[skip:]], float)
    return values[:, 0], values[:, 1]


def test_every_file_is_tried() -> None:
    held = [case for _, case in cases(CORPUS / "archive_files.toml")] + ENTRIES["right"] + ENTRIES["short"]
    tried = {case["file"].split("[")[0] for case in held}
    assert tried == {path.name for path in HERE.iterdir() if path.suffix != ".md"}


# Astropy, by which files are read by hand, warns of a header with null values of real columns.
@pytest.mark.filterwarnings("ignore:Invalid keyword for column.*TNULLn")
@pytest.mark.parametrize("entry", RIGHT)
def test_archive_files_are_read(entry: dict[str, Any]) -> None:
    options = entry.get("options", {})
    star = Source.read(HERE / entry["file"], **options)
    angstrom, flux = by_hand(entry["file"].split("[")[0], **entry.get("how", {}))
    assert np.isfinite(star.flux_flam).all()
    assert all(any(words in text for text in star.messages) for words in entry.get("messages", ())), star.messages
    assert len(star.messages) == entry.get("n_messages", len(star.messages))
    # Points that stand once and have a flux are there as they stand, to the rounding of the unit.
    once = np.isfinite(flux) & np.isin(angstrom, np.unique(angstrom)[np.unique(angstrom, return_counts=True)[1] == 1])
    inside = once & (angstrom > 2000.0) & (angstrom < 7000.0)
    assert inside.sum() > 100
    place = np.searchsorted(star.wavelength_nm, angstrom[inside] / 10.0 * (1 - 1e-12))
    np.testing.assert_allclose(star.wavelength_nm[place], angstrom[inside] / 10.0, rtol=1e-12)
    np.testing.assert_allclose(star.flux_flam[place], flux[inside], rtol=1e-12)
    if "v" in entry:
        # Zero points of V differ by 0.03 mag; the M7 dwarf varies, and catalogues with it.
        assert star.magnitude("V") == pytest.approx(entry["v"], abs=0.15 if "extend" in options else 0.06)
    messages = expect(star.at_magnitude(8.0), MAUVE, exposure=50.0).messages
    assert all(any(text in message for message in messages) for text in star.messages)


@pytest.mark.parametrize("entry", SHORT)
def test_short_spectra_need_an_extension(entry: dict[str, Any]) -> None:
    star = Source.read(HERE / entry["file"], **entry.get("options", {}))
    assert any(text.startswith("its own points cover") for text in star.messages)
    with refused(*entry["refused"]):
        expect(replace(star, unscaled=""), MAUVE, exposure=5.0)


def test_surface_or_relative_fluxes_need_a_magnitude(tmp_path: Path) -> None:
    lamost = written(dict(cases(CORPUS / "surveys.toml"))["surveys LAMOST table of DR8 fits"], tmp_path)
    model, ngsl = HERE / "ckp00_5750.fits[g45]", HERE / "h_stis_ngsl_hd095735_v2.txtA"
    for star in (Source.read(model), Source.read(ngsl, wavelength_unit="Angstrom"), Source.read(lamost, extend="K5V")):
        with refused("magnitude"):
            expect(star, MAUVE, exposure=5.0)
        assert expect(star.at_magnitude(7.5), MAUVE, exposure=5.0).signal_dn.max() > 0
    # The Sun is as bright as its file states.
    assert not Source.read(HERE / "sun_reference_stis_002.fits").unscaled
