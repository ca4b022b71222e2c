"""What the library's headers must admit, beside where the numbers come from."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from mauvecl.host.stars import bands, catalogue
from mauvecl.host.stars.source import Source


def near_ultraviolet(name: str) -> float:
    """Mean flux at 290-310 nm over that at 540-560 nm."""
    star = Source.from_library(name)

    def mean(low: float, high: float) -> float:
        return float(star.flux_flam[(star.wavelength_nm > low) & (star.wavelength_nm < high)].mean())

    return mean(290, 310) / mean(540, 560)


def test_no_star_is_out_of_line_with_its_neighbours() -> None:
    """From G5V to M3V the ratio falls by class; one twice its warmer neighbour would be a fault of its file."""
    order = ["G5V", "G8V", "K1V", "K2.5V", "K5V", "K6V", "M0V", "M3V"]
    ratios = [near_ultraviolet(name) for name in order]
    assert all(own < 2 * warm for warm, own in pairwise(ratios))


def test_muscles_entries_admit_their_model_and_cite_their_data() -> None:
    table = catalogue.library_table()
    muscles = [row for row in table if "MUSCLES" in row["origin"]]
    assert len(muscles) == 7
    assert all("PHOENIX model" in row["origin"] for row in muscles)
    assert all(row["citation"].endswith("10.17909/T9DG6F") for row in muscles)


@pytest.mark.parametrize("name", bands.ALIASES)
def test_bands_say_where_they_are_from_and_what_they_mean(name: str) -> None:
    meta = catalogue.band_table(f"{name.lower().replace(' ', '_')}.ecsv").meta
    assert all(meta[field] for field in ("origin", "licence", "system", "zero_point"))
    assert ("vega" in meta) == (meta["system"] == "Vega")
    assert "per photon" in meta["response"]


def test_the_sun_has_its_magnitude() -> None:
    """V = -26.76 +- 0.02 (Willmer 2018): ties Vega, the band and the absolute scale together."""
    assert Source.from_library("Sun").magnitude("V") == pytest.approx(-26.76, abs=0.02)


def test_the_response_of_v_is_per_photon() -> None:
    """Pickles spectra come normalised to V = 0: per photon they agree in every class, per energy they do not."""
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
