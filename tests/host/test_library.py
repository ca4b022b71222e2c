"""Headers of library spectra state assumptions and sources."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from refusals import refused

from mauvecl.host.expectation import expect
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.stars import bands, catalogue
from mauvecl.host.stars.band_names import ALIASES
from mauvecl.host.stars.source import Source


def near_ultraviolet(name: str) -> float:
    """Return the mean flux at 290-310 nm over that at 540-560 nm."""
    star = Source.from_library(name)

    def mean(low: float, high: float) -> float:
        return float(star.flux_flam[(star.wavelength_nm > low) & (star.wavelength_nm < high)].mean())

    return mean(290, 310) / mean(540, 560)


def test_library_stars_agree_with_their_neighbours() -> None:
    """Check that the ratio falls with class from G5V to M4V; a ratio twice the warmer neighbour's is a fault."""
    order = ["G5V", "G8V", "K1V", "K2.5V", "K5V", "K6V", "M0V", "M1V", "M3V", "M4V"]
    ratios = [near_ultraviolet(name) for name in order]
    assert all(own < 2 * warm for warm, own in pairwise(ratios))


def test_noise_dominated_ultraviolet_is_reported() -> None:
    """Report the ultraviolet of M5V and M6V, which is brighter than M4V's because of noise."""
    limits = {"M0V": 0.0, "M1V": 240.0, "M3V": 0.0, "M4V": 240.0, "M5V": 300.0, "M6V": 300.0}
    for name, limit in limits.items():
        reported = Source.from_library(name).messages
        assert reported == (
            (f"noise rules its ultraviolet below {limit:g} nm, where its flux is an upper limit",) * (limit > 0)
        )
        assert (near_ultraviolet(name) > 2 * near_ultraviolet("M4V")) <= (limit >= 300 or name in ("M0V", "M1V"))
        # Redder than that they fall, 20 nm by 20 nm.
        star = Source.from_library(name)
        bands = [
            star.flux_flam[(star.wavelength_nm >= a) & (star.wavelength_nm < a + 20)].mean()
            for a in np.arange(max(limit, 200.0), 400.0, 20.0)
            if a != 280.0
        ]
        assert all(blue < 1.2 * red for blue, red in pairwise(bands))


def test_colours_are_those_of_the_classes() -> None:
    """Compare B - V with Pickles (1998, table 2) to 0.03, and check Vega's zero and Gaia's colour of red stars."""
    for name, colour in (("B5V", -0.14), ("A5V", 0.17), ("F0V", 0.31), ("G0V", 0.59), ("G2V", 0.63), ("G5V", 0.68)):
        star = Source.from_library(name)
        assert star.magnitude("B") - star.magnitude("V") == pytest.approx(colour, abs=0.03)
    gaia = [
        Source.from_library(name).magnitude("Gaia BP") - Source.from_library(name).magnitude("Gaia RP")
        for name in ("Vega", "G2V", "K5V", "M0V", "M3V", "M6V")
    ]
    assert gaia[0] == pytest.approx(0.0, abs=1e-9)
    assert all(a < b for a, b in pairwise(gaia))


def test_each_star_has_a_photosphere_temperature_with_source() -> None:
    for row in catalogue.library_table():
        assert row["temperature_source"]
        assert 2500 < float(row["temperature_k"]) < 30_000
        assert Source.from_library(row["name"]).temperature_k == float(row["temperature_k"])


def test_galex_in_both_systems() -> None:
    """Compare AB less Vega, 1.64 with this Vega and curve, with the 1.70 of catalogues (Bianchi 2011)."""
    star = Source.from_library("G2V").at_magnitude(12.0, "GALEX NUV Vega")
    assert star.magnitude("GALEX NUV", "vega") == pytest.approx(12.0, abs=1e-6)
    assert star.magnitude("GALEX NUV") - 12.0 == pytest.approx(1.69, abs=0.08)


def test_unscaled_library_star_needs_a_magnitude() -> None:
    """Require a magnitude for templates, which are kept at V = 0; Vega itself needs none."""
    mauve = Instrument.load("mauve")
    for row in catalogue.library_table():
        star = Source.from_library(row["name"])
        assert bool(star.unscaled) == (row["name"] not in ("Sun", "Vega"))
        assert not star.at_magnitude(7.0).unscaled
    with refused("magnitude", "0"):
        expect(Source.from_library("G2V"), mauve, exposure=50)
    with refused("magnitude"):
        expect(Source.from_library("G2V").flaring(0.1), mauve, exposure=50)
    assert expect(Source.from_library("Vega"), mauve, exposure=5).saturated.any()


def test_muscles_entries_admit_their_model_and_cite_their_data() -> None:
    table = catalogue.library_table()
    muscles = [row for row in table if "MUSCLES" in row["origin"]]
    assert len(muscles) == 11
    assert all("PHOENIX model" in row["origin"] for row in muscles)
    assert all(row["citation"].endswith("10.17909/T9DG6F") for row in muscles)


@pytest.mark.parametrize("name", ALIASES)
def test_bands_state_source_and_system(name: str) -> None:
    meta = catalogue.band_table(f"{name.lower().replace(' ', '_')}.ecsv").meta
    assert all(meta[field] for field in ("origin", "licence", "system", "zero_point"))
    assert ("vega" in meta) == (meta["system"] == "Vega")
    assert "per photon" in meta["response"]


def test_magnitude_of_the_sun() -> None:
    """Compare with V = -26.76 +- 0.02 (Willmer 2018), which ties Vega, band and absolute scale together."""
    assert Source.from_library("Sun").magnitude("V") == pytest.approx(-26.76, abs=0.02)


def test_response_of_v_is_per_photon() -> None:
    """Check that Pickles spectra, normalised to V = 0, agree in every class only for photons."""
    v, vega = bands.band("V"), Source.from_library("Vega")

    def magnitude(star: Source, power: int) -> float:
        grid = np.union1d(star.wavelength_nm, v.wavelength_nm)
        grid = grid[(grid >= v.wavelength_nm[0]) & (grid <= v.wavelength_nm[-1])]
        response = np.interp(grid, v.wavelength_nm, v.throughput) * grid**power
        flux, zero = (
            np.trapezoid(response * np.interp(grid, s.wavelength_nm, s.flux_flam), grid) for s in (star, vega)
        )
        return float(-2.5 * np.log10(flux / zero))

    stars = [Source.from_library(row["name"]) for row in catalogue.library_table() if "Pickles" in row["origin"]]
    assert len(stars) == 20
    # Weighted with the wavelength an integral over energy counts photons.
    assert np.ptp([magnitude(star, 1) for star in stars]) < 2e-4
    assert np.ptp([magnitude(star, 0) for star in stars]) > 0.01
    # And the package itself weights so.
    assert np.ptp([star.magnitude("V") for star in stars]) < 2e-4


def test_every_spectrum_and_band_names_its_source_file() -> None:
    """Check package, wheel and digests as in the headers of the files."""
    library = Path(catalogue.__file__).parent / "library"
    table = Table.read(library / "inputs.ecsv", format="ascii.ecsv")
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in (*table["sha256"], *table.meta["wheels"].values()))
    files = {row["entry"]: row for row in table}
    index = Table.read(library / "index.ecsv", format="ascii.ecsv")
    for row in index:
        reported = files.pop(f"spectrum {row['name']}")
        assert reported["file"].endswith("/" + row["source_file"])
        assert reported["package"] in row["origin"]
    for file in (library / "bands").glob("*.ecsv"):
        meta = Table.read(file, format="ascii.ecsv").meta
        assert f"package {files.pop('band ' + meta['name'])['package']} " in meta["origin"]
    assert not files
    assert "not known" in table.meta["unknown"]
