"""Sources: the embedded library, users' files, magnitudes, flares, dust, and refusals."""

import re
import warnings

import astropy.units as u
import numpy as np
import pytest
from refusals import refused
from scenes import BANDS, instrument, source

from mauvecl import Blackbody, Source, expect

SYSTEMS = ("catalogue", "vega", "ab")


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
        for system in SYSTEMS:
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


def test_flares_do_not_depend_on_the_system_of_magnitudes() -> None:
    for system, wanted in {"catalogue": "as in catalogues: AB", "vega": "have Vega at 0", "ab": "are AB"}.items():
        star = SUN.at_magnitude(7.4, "Kepler", system)
        assert wanted in star.scale
        flare = star.flaring(0.24).flux_flam * (SUN.flux_flam[0] / star.flux_flam[0])
        np.testing.assert_allclose(flare, SUN.flaring(0.24).flux_flam)


def test_replacing_flare_hides_photosphere() -> None:
    """Compare with the exact area-weighted sum of two blackbodies, for a star that is a blackbody."""
    cool, hot = (Blackbody(kelvin).flux(NM) for kelvin in (5000.0, 10_000.0))
    star = Source.from_arrays(NM, cool)
    difference = star.magnitude("Kepler") - Source.from_arrays(NM, hot).magnitude("Kepler")
    f = 0.1 / (10 ** (0.4 * difference) - 1)
    flare = star.flaring(0.1, 10_000, geometry="replaces", photosphere_temperature=5000)
    np.testing.assert_allclose(flare.flux_flam, (1 - f) * cool + f * hot, rtol=1e-9)


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
    assert star.binned(5.0).magnitude("V") == pytest.approx(star.magnitude("V"), abs=2e-3)


def test_stated_error_of_a_mean_equals_the_scatter_of_means() -> None:
    """Compare the error in the refusal of a mean far below zero with the scatter of the means of 100 spectra.

    The standard deviation of 100 draws is accurate to 7 %, and the mean of 20 stated errors to 5 %. The limits of 0.7
    and 1.3 lie beyond three standard deviations of their ratio: false failures for less than 3e-3 of seeds.
    """
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
