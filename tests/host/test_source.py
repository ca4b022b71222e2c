"""Sources: photometry, dust-free flares and their spectra, extensions, and noise of measured spectra."""

import re
import tracemalloc
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from refusals import refused
from scenes import BANDS, instrument, source

from mauvecl import Blackbody, ObservedFlare, Source, expect

NM = np.arange(170.0, 1100.0, 1.0)
GOOD = NM * 1e-15
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


def test_spectra_are_released_after_their_magnitude_is_computed() -> None:
    n = 500_000
    star = Source(np.linspace(180.0, 1100.0, n), np.full(n, 1e-13), "mine", "made up")
    Source.from_library("G2V").magnitude("V")
    tracemalloc.start()
    star.magnitude("V")
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert held < n, "bytes, of which the spectrum has 16 a point"


def test_flares_do_not_depend_on_the_system_of_magnitudes() -> None:
    for system, wanted in {"catalogue": "as in catalogues: AB", "vega": "have Vega at 0", "ab": "are AB"}.items():
        star = SUN.at_magnitude(7.4, "Kepler", system)
        assert wanted in star.scale
        flare = star.flaring(0.24).flux_flam * (SUN.flux_flam[0] / star.flux_flam[0])
        np.testing.assert_allclose(flare, SUN.flaring(0.24).flux_flam)


def test_short_spectra_are_used_where_they_suffice() -> None:
    """The nominal range refuses others: `data/refusals/host.toml`."""
    narrow, parts = MAUVE.with_(output_min_nm=250.0, output_max_nm=600.0), (slice(None), slice(31, None), slice(500))
    seen = [expect(Source.from_arrays(NM[part], GOOD[part]), narrow, exposure=5.0) for part in parts]
    for x in seen[1:]:
        np.testing.assert_array_equal(x.source_electrons, seen[0].source_electrons)
    # A bright star begins at 180.1 nm, from where the line function hardly reaches the pixels.
    hot, finer = Blackbody(30_000.0).flux(NM), np.append(180.1, NM[11:])
    whole, short = Source.from_arrays(NM, hot), Source.from_arrays(finer, np.interp(finer, NM, hot))
    assert any("starts at 180.1 nm and is continued to 180 nm" in text for text in short.messages)
    assert short.flux_flam[0] == pytest.approx(short.flux_flam[1:][np.abs(finer - finer[0]) <= 5.0].mean())
    one, other = (expect(star.at_magnitude(5.0), MAUVE, exposure=5.0) for star in (whole, short))
    np.testing.assert_allclose(one.source_electrons, other.source_electrons, rtol=2e-4)
    # What was continued is not taken for measured light in a band.
    cut = Source.from_arrays(NM[25:], np.where(NM < 300, 1e-17, GOOD)[25:])
    assert cut.measured_nm == (195.0, 1099.0)
    with refused("band", "195-1099", "99%", "GALEX"):
        cut.magnitude("GALEX NUV")
    # Noise below zero is not continued.
    assert Source.from_arrays(NM[15:], np.where(NM < 200, -1e-17, GOOD)[15:]).flux_flam[0] == 0.0


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


def test_quiescent_spectrum_is_subtracted(tmp_path: Path) -> None:
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
