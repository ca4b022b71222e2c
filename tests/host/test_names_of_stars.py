"""Stars of the library and their names wherever a star can be given, formulas, and neighbours in the fibre."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from refusals import refused
from scenes import quiescent

import mauvecl
from mauvecl import Expectation, PixelMap, Source, Study, expect, simulate, snr, visible

LIBRARY = Path(mauvecl.__file__).parent / "host" / "stars" / "library"
KNOWN = Table.read(LIBRARY / "well_known.ecsv", format="ascii.ecsv")


def target(name: str) -> Any:
    return visible(Study.build({"orbit": {"targets": [name], "days": 0.1}}, "test")).targets[0]


@pytest.mark.parametrize(("text", "name"), [
    ("M3", "M3V"), ("m3v", "M3V"), (" g2v ", "G2V"),  # without luminosity class, in other letters
    ("K3V", "K2.5V"), ("K2.5", "K2.5V"), ("hd 40307", "K2.5V"),  # an alias, and the star of the class
    ("gj581", "M3V"), ("GX And", "M1V"),  # stars with spectra of their own; the library has one as GJ 15A
    ("BLACK BODY 9e3K", "blackbody 9000 K"), ("planck 5772.5 K", "blackbody 5772.5 K"),
    ("powerlaw +1.50", "power law 1.5"),
    ("epsilon Eri", "eps Eri"), ("EPS ERI", "eps Eri"), ("hd22049", "eps Eri"), ("gj581", "GJ 581"),  # targets
    ("Proxima", "Proxima Cen"), ("GJ 354.1", "DX Leo"),  # a decimal point that counts
])  # fmt: skip
def test_names_are_resolved(text: str, name: str) -> None:
    if name in KNOWN["name"]:
        assert target(text).name == name
    else:
        assert Source.from_library(text).name == name
        assert Source.from_library(name).digest == Source.from_library(text).digest


def test_given_values_win_over_those_of_the_list() -> None:
    def chosen(name: str | None = None, **given: object) -> Any:
        study = Study.build({"star": [{"library": "AU Mic"} | given]}, "test")
        return (study if name is None else study.at("star", name)).star[0]

    for given, values, note in (
        ({}, (8.81, 9.91), "spectrum of type M1V, V = 8.81, 9.91 pc, from Hipparcos"),
        ({"magnitude": 9}, (9.0, 9.91), "spectrum of type M1V, 9.91 pc, from Hipparcos"),
        ({"magnitude": 9, "distance_pc": 10}, (9.0, 10.0), "spectrum of type M1V"),
    ):
        star = chosen(**given)
        assert ((star.magnitude, star.distance_pc), star.source().messages[0]) == (values, note)
    # The list has no magnitude in another band.
    with refused("magnitude", "give a magnitude"):
        expect(chosen(band="TESS").source(), "mauve", exposure=50)
    # Swept stars have their own values unless others are given.
    for star, values in (
        (chosen("YZ CMi"), (11.19, 5.957)),
        (chosen("YZ CMi", library="M3V", magnitude=9), (9.0, 5.957)),
        (chosen("M3V", library="M1V", magnitude=9, distance_pc=3), (9.0, None)),
    ):
        assert (star.magnitude, star.distance_pc) == values


@pytest.mark.parametrize(("text", "nearest"), [("M3.5V", "M3V"), ("dM4.5", "M4V"), ("G3V", "G2V")])
def test_types_between_those_of_the_library_take_the_nearest_with_a_message(text: str, nearest: str) -> None:
    star = Source.from_library(text)
    np.testing.assert_array_equal(star.flux_flam, Source.from_library(nearest).flux_flam)
    assert star.messages[0].startswith(f"spectrum of {nearest}, the nearest to type ")


def test_every_listed_star_is_found_with_its_light_and_place() -> None:
    """No name stands for two stars; each has its spectrum at its magnitude, and its coordinates."""
    for row in KNOWN:
        name = str(row["name"])
        (star,) = Study.build({"star": [{"library": name}]}, "test").star
        x, same = (expect(one, "mauve", exposure=50) for one in (name, star.source()))
        assert star.source().magnitude("V") == pytest.approx(row["V"], abs=0.01), name
        np.testing.assert_allclose(x.source_electrons, same.source_electrons, rtol=1e-9)
        if name != "Vega":
            assert (star.magnitude, star.distance_pc) == (row["V"], row["distance"])
            assert f"V = {row['V']:g}, {row['distance']:g} pc, from " in " ".join(x.messages)
        for other in {name, *str(row["other_names"]).split(", ")} - {"", "--"}:
            found = target(other)
            assert (found.name, found.magnitude) == (name, row["V"]), other
            assert (found.ra_deg, found.dec_deg) == (row["ra"], row["dec"])
    assert target("19h22m00s -11d12m00s").ra_deg == pytest.approx(290.5)


ALONE = quiescent("G2V", 7.4)
B, FAR = "B,12.5,6.9,K5V", "D,47.47,1.0,A0V"


def seen(folder: Path, *rows: str, share: float = 1.0, **changes: Any) -> Expectation:
    (folder / "near.csv").write_text("\n".join(("name,separation,V,sptype", *rows)) + "\n")
    star = {"library": "G2V", "magnitude": 7.4, "neighbours": str(folder / "near.csv"), "neighbour_share": share}
    study = {"star": [star], "observation": {"exposure_s": 50.0, "changes": changes}}
    return simulate(Study.build(study, "test").paper()).inputs[0]


def test_light_of_neighbours_follows_from_magnitude_share_and_place(tmp_path: Path) -> None:
    x = seen(tmp_path, "twin,1.0,8.4,G2V", "faint,1.0,9.9,G2V", share=0.5)
    assert x.target_share == pytest.approx(1 / (1 + 0.5 * (10**-0.4 + 10**-1.0)), rel=1e-9)
    # The light of a twin falls on the same uneven pixels.
    PixelMap(response=np.linspace(0.5, 1.5, 2048)).write(tmp_path / "map.ecsv")
    twin = seen(tmp_path, "twin,1.0,7.4,G2V", pixel_map=str(tmp_path / "map.ecsv"))
    np.testing.assert_allclose(twin.neighbour_electrons, twin.source_electrons, rtol=1e-12)
    # A star beyond the fibre needs neither magnitude nor type.
    assert "neighbour_photon" not in ALONE.noise_budget().colnames
    for x in (seen(tmp_path, FAR), seen(tmp_path, "x,50,,"), seen(tmp_path, B, share=0.0)):
        np.testing.assert_array_equal(x.variance_dn2, ALONE.variance_dn2)
        assert x.target_share == 1.0


def test_messages_and_noise_of_neighbours(tmp_path: Path) -> None:
    for row, said in (
        (FAR, "none within 47.46 arcsec; 1 star beyond does not enter"),
        ("c,1,9,M2V", "of type M2V: M1V, the nearest type"),
        ("c,1,9,K", "of type K: K5V"),
        ("A,0.3,7.2,G2V", "neighbours_of"),
    ):
        assert said in " ".join(seen(tmp_path, row).messages)
    # Noise by origin has no number where a star has no neighbour.
    alone = {"library": "G2V", "magnitude": 7.4}
    both = [alone | {"neighbours": str(tmp_path / "near.csv")}, alone]
    few = {"star": both, "observation": {"exposure_s": 50.0}, "run": {"realisations": 1000}}
    noise = snr(Study.build(few, "test")).views[1].table
    assert np.isnan(noise["neighbour_photon"].value).tolist() == [False] * 4 + [True] * 4


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
