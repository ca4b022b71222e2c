"""Stars of the library and their names wherever a star can be given, formulas, and neighbours in the fibre."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from scenes import quiescent

import mauvecl
from mauvecl import Expectation, PixelMap, Source, Study, expect, simulate, snr, visible

LIBRARY = Path(mauvecl.__file__).parent / "host" / "stars" / "library"


def read(*names: str) -> Table:
    return Table.read(LIBRARY.joinpath(*names), format="ascii.ecsv")


KNOWN = read("well_known.ecsv")


def target(name: str) -> Any:
    return visible(Study.build({"orbit": {"targets": [name], "days": 0.1}}, "test")).targets[0]


@pytest.mark.parametrize(("text", "name"), [
    ("M3", "M3V"), ("m3v", "M3V"), (" g2v ", "G2V"),  # without luminosity class, in other letters
    ("K3V", "K2.5V"), ("K2.5", "K2.5V"), ("hd 40307", "K2.5V"),  # an alias, and the star of the class
    ("gj581", "M3V"), ("GX And", "M1V"),  # stars with spectra of their own; the library has one as GJ 15A
    ("BLACK BODY 9e3K", "blackbody 9000 K"), ("planck 5772.5 K", "blackbody 5772.5 K"),
    ("powerlaw +1.50", "power law 1.5"), ("M3.5V", "M3V"), ("dM4.5", "M4V"), ("G3V", "G2V"),  # and the nearest types
    ("epsilon Eri", "eps Eri"), ("EPS ERI", "eps Eri"), ("hd22049", "eps Eri"), ("gj581", "GJ 581"),  # targets
    ("Proxima", "Proxima Cen"), ("GJ 354.1", "DX Leo"),  # a decimal point that counts
])  # fmt: skip
def test_names_are_resolved(text: str, name: str) -> None:
    if name in KNOWN["name"]:
        assert target(text).name == name
    else:
        star = Source.from_library(text)
        said = f"spectrum of {name}, the nearest to type " in " ".join(star.messages[:1])
        assert (star.name == name, said) == ((False, True) if text in ("M3.5V", "dM4.5", "G3V") else (True, False))
        assert star.digest == Source.from_library(name).digest


def test_given_values_win_over_those_of_the_list() -> None:
    """Swept stars have their own values unless others are given; notes on the list are in `said.toml`."""

    def chosen(name: str | None = None, **given: object) -> Any:
        study = Study.build({"star": [{"library": "AU Mic"} | given]}, "test")
        return (study if name is None else study.at("star", name)).star[0]

    for star, values in (
        (chosen(), (8.81, 9.91)),
        (chosen(magnitude=9, distance_pc=10), (9.0, 10.0)),
        (chosen("YZ CMi"), (11.19, 5.957)),
        (chosen("YZ CMi", library="M3V", magnitude=9), (9.0, 5.957)),
        (chosen("M3V", library="M1V", magnitude=9, distance_pc=3), (9.0, None)),
    ):
        assert (star.magnitude, star.distance_pc) == values


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


def seen(folder: Path, *rows: str, share: float = 1.0, **changes: Any) -> Expectation:
    (folder / "near.csv").write_text("\n".join(("name,separation,V,sptype", *rows)) + "\n")
    star = {"library": "G2V", "magnitude": 7.4, "neighbours": str(folder / "near.csv"), "neighbour_share": share}
    study = {"star": [star], "observation": {"exposure_s": 50.0, "changes": changes}}
    return simulate(Study.build(study, "test").paper()).inputs[0]


def test_light_noise_and_messages_of_neighbours_follow_from_magnitude_share_and_place(tmp_path: Path) -> None:
    far, lone = "D,47.47,1.0,A0V", quiescent("G2V", 7.4)
    x = seen(tmp_path, "twin,1.0,8.4,G2V", "faint,1.0,9.9,G2V", share=0.5)
    assert x.target_share == pytest.approx(1 / (1 + 0.5 * (10**-0.4 + 10**-1.0)), rel=1e-9)
    # The light of a twin falls on the same uneven pixels.
    PixelMap(response=np.linspace(0.5, 1.5, 2048)).write(tmp_path / "map.ecsv")
    twin = seen(tmp_path, "twin,1.0,7.4,G2V", pixel_map=str(tmp_path / "map.ecsv"))
    np.testing.assert_allclose(twin.neighbour_electrons, twin.source_electrons, rtol=1e-12)
    # A star beyond the fibre needs neither magnitude nor type.
    assert "neighbour_photon" not in lone.noise_budget().colnames
    for x in (seen(tmp_path, far), seen(tmp_path, "x,50,,"), seen(tmp_path, "B,12.5,6.9,K5V", share=0.0)):
        np.testing.assert_array_equal(x.variance_dn2, lone.variance_dn2)
        assert x.target_share == 1.0
    for row, said in (
        (far, "none within 47.46 arcsec; 1 star beyond does not enter"),
        ("c,1,9,M2V", "of type M2V: M1V, the nearest type"),
        ("c,1,9,K", "of type K: K5V"),
        ("A,0.3,7.2,G2V", "neighbours_of"),
    ):
        assert said in " ".join(seen(tmp_path, row).messages)
    # Noise by origin has no number where a star has no neighbour.
    alone = {"library": "G2V", "magnitude": 7.4}
    both = [alone | {"neighbours": str(tmp_path / "near.csv")}, alone]
    noise = snr(Study.build({"star": both, "run": {"realisations": 1000}}, "test")).views[1].table
    assert np.isnan(noise["neighbour_photon"].value).tolist() == [False] * 4 + [True] * 4


def test_every_spectrum_and_band_is_usable_and_states_its_source() -> None:
    """Check sources and systems of bands, and package, wheel and digest of each file that the library is made of."""
    index, table = read("index.ecsv"), read("inputs.ecsv")
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in (*table["sha256"], *table.meta["wheels"].values()))
    files = {row["entry"]: row for row in table}
    for row in index:
        reported, header = files.pop(f"spectrum {row['name']}"), read("spectra", row["file"]).meta
        assert reported["file"].endswith("/" + row["source_file"])
        assert reported["package"] in row["origin"]
        assert all(row[field] for field in ("treatment", "temperature_source"))
        for key in ("origin", "citation", "licence", "uv_quality"):
            assert header[key] == row[key] != ""
        source = Source.from_library(row["name"])
        assert source.wavelength_nm[0] <= 180, row["name"]
        assert source.wavelength_nm[-1] >= 1050, row["name"]
        # No zeros where Mauve sees, but for two bins of two Pickles classes that their header names.
        dark = (source.flux_flam <= 0) & (source.wavelength_nm > 200) & (source.wavelength_nm < 700)
        assert dark.sum() == 0 or (dark.sum() <= 2 and "zero in 2 bins" in row["treatment"])
    muscles = [row for row in index if "MUSCLES" in row["origin"]]
    assert len(muscles) == 11
    assert all("PHOENIX model" in row["origin"] for row in muscles)
    for file in (LIBRARY / "bands").glob("*.ecsv"):
        meta = read("bands", file.name).meta
        assert f"package {files.pop('band ' + meta['name'])['package']} " in meta["origin"]
        assert all(meta[field] for field in ("licence", "system", "zero_point"))
        assert ("vega" in meta) == (meta["system"] == "Vega")
        assert "per photon" in meta["response"]
    assert not files
    assert "not known" in table.meta["unknown"]
    assert sum(path.stat().st_size for path in LIBRARY.rglob("*") if path.is_file()) < 2e6
