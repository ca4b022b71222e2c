"""Headers of library spectra state assumptions and sources."""

import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table

import mauvecl
from mauvecl import Source

LIBRARY = Path(mauvecl.__file__).parent / "host" / "stars" / "library"
TABLE = Table.read(LIBRARY / "index.ecsv", format="ascii.ecsv")


@pytest.mark.parametrize("entry", list(TABLE), ids=list(TABLE["name"]))
def test_each_spectrum_is_usable_and_has_an_origin(entry: Any) -> None:
    assert all(entry[field] for field in ("treatment", "temperature_source"))
    source = Source.from_library(entry["name"])
    assert (source.wavelength_nm[0] <= 180, source.wavelength_nm[-1] >= 1050) == (True, True)
    # No zeros where Mauve sees, but for two bins of two Pickles classes that their header names.
    dark = (source.flux_flam <= 0) & (source.wavelength_nm > 200) & (source.wavelength_nm < 700)
    assert dark.sum() == 0 or (dark.sum() <= 2 and "zero in 2 bins" in entry["treatment"])
    header = Table.read(LIBRARY / "spectra" / entry["file"], format="ascii.ecsv").meta
    for key in ("origin", "citation", "licence", "uv_quality"):
        assert header[key] == entry[key] != ""
    assert 2500 < float(entry["temperature_k"]) < 30_000
    assert source.temperature_k == float(entry["temperature_k"])
    # Templates are kept at V = 0; the Sun and Vega need no magnitude.
    assert bool(source.unscaled) == (entry["name"] not in ("Sun", "Vega"))
    assert not source.at_magnitude(7.0).unscaled


def mean(name: str, low: float, high: float) -> float:
    """Return the mean flux of a star in a range of wavelengths, nm."""
    star = Source.from_library(name)
    return float(star.flux_flam[(star.wavelength_nm >= low) & (star.wavelength_nm < high)].mean())


def test_ultraviolet_falls_with_class_or_is_reported_as_noise() -> None:
    """Check the near ultraviolet of G5V to M4V, and the blue ends of M stars, which fall 20 nm by 20 nm.

    A ratio twice the warmer neighbour's is a fault. That of M5V and M6V is brighter than M4V's because of noise.
    """
    order = ["G5V", "G8V", "K1V", "K2.5V", "K5V", "K6V", "M0V", "M1V", "M3V", "M4V", "M5V", "M6V"]
    near = {name: mean(name, 290, 310) / mean(name, 540, 560) for name in order}
    assert all(near[own] < 2 * near[warm] for warm, own in pairwise(order[:-2]))
    for name, limit in {"M0V": 0.0, "M1V": 240.0, "M3V": 0.0, "M4V": 240.0, "M5V": 300.0, "M6V": 300.0}.items():
        said = f"noise rules its ultraviolet below {limit:g} nm, where its flux is an upper limit"
        assert Source.from_library(name).messages == ((said,) if limit else ())
        assert (near[name] > 2 * near["M4V"]) <= (limit >= 300 or name in ("M0V", "M1V"))
        starts = [nm for nm in np.arange(max(limit, 200.0), 400.0, 20.0) if nm != 280.0]
        bands = [mean(name, nm, nm + 20) for nm in starts]
        assert all(blue < 1.2 * red for blue, red in pairwise(bands))


def test_colours_are_those_of_the_classes() -> None:
    """Compare B - V with Pickles (1998, table 2) to 0.03, and check Vega's zero and Gaia's colour of red stars."""
    for name, colour in (("B5V", -0.14), ("A5V", 0.17), ("F0V", 0.31), ("G0V", 0.59), ("G2V", 0.63), ("G5V", 0.68)):
        star = Source.from_library(name)
        assert star.magnitude("B") - star.magnitude("V") == pytest.approx(colour, abs=0.03)
    stars = map(Source.from_library, ("Vega", "G2V", "K5V", "M0V", "M3V", "M6V"))
    gaia = [star.magnitude("Gaia BP") - star.magnitude("Gaia RP") for star in stars]
    assert gaia[0] == pytest.approx(0.0, abs=1e-9)
    assert all(a < b for a, b in pairwise(gaia))


def test_every_spectrum_and_band_states_its_source() -> None:
    """Check sources and systems of bands, and package, wheel and digest of each file that the library is made of."""
    table = Table.read(LIBRARY / "inputs.ecsv", format="ascii.ecsv")
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in (*table["sha256"], *table.meta["wheels"].values()))
    files = {row["entry"]: row for row in table}
    for row in TABLE:
        reported = files.pop(f"spectrum {row['name']}")
        assert reported["file"].endswith("/" + row["source_file"])
        assert reported["package"] in row["origin"]
    muscles = [row for row in TABLE if "MUSCLES" in row["origin"]]
    assert len(muscles) == 11
    assert all("PHOENIX model" in row["origin"] for row in muscles)
    for file in (LIBRARY / "bands").glob("*.ecsv"):
        meta = Table.read(file, format="ascii.ecsv").meta
        assert f"package {files.pop('band ' + meta['name'])['package']} " in meta["origin"]
        assert all(meta[field] for field in ("licence", "system", "zero_point"))
        assert ("vega" in meta) == (meta["system"] == "Vega")
        assert "per photon" in meta["response"]
    assert not files
    assert "not known" in table.meta["unknown"]
    assert sum(path.stat().st_size for path in LIBRARY.rglob("*") if path.is_file()) < 2e6
