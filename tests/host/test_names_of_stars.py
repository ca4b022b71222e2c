"""Stars of the library, their names and neighbours, and the user's own: from files, and fetched from a local server."""

import contextlib
import http.server
import io
import json
import re
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commands import run
from refusals import refused
from scenes import quiescent
from tables import DATA, toml

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


@pytest.mark.long
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


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MAUVECL_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "data" / "stars"


WHOLE = DATA / "spectra" / "18sco_stis_004.fits"
WAVELENGTH_NM = np.linspace(170.0, 1000.0, 500)
FLUX = 1e-12 * np.exp(-(((WAVELENGTH_NM - 500) / 200) ** 2))


def text_file(path: Path, scale: float = 1.0) -> Path:
    np.savetxt(path, np.transpose([WAVELENGTH_NM, scale * FLUX]))
    return path


def archive_file(**header: Any) -> bytes:
    out, units = io.BytesIO(), ["Angstrom", "erg / (s cm2 Angstrom)"]
    Table({"WAVELENGTH": 10 * WAVELENGTH_NM, "FLUX": FLUX}, units=units, meta=header).write(out, format="fits")
    return out.getvalue()


def library(folder: Path, *words: str | Path, code: int = 0) -> str:
    done = run("library", *words, folder=folder, code=code)
    return done.stdout + done.stderr


def kept(folder: Path) -> list[str]:
    return sorted(one["name"] for one in json.loads(library(folder, "--json")) if one["kept"] == "yours")


def test_kept_stars_are_part_of_the_library(tmp_path: Path, own_folder: Path) -> None:
    mine, two = (text_file(tmp_path / name, scale) for name, scale in (("mine.txt", 1.0), ("two.txt", 2.0)))
    assert "Kept mine: --star mine" in library(tmp_path, "add", mine, two)
    assert {path.parent for path in own_folder.rglob("*.ecsv")} == {own_folder}
    assert Source.from_library("MINE").digest == Source.read(mine).digest
    assert simulate(star="mine", magnitude=7.0).inputs[0].name == "mine"
    assert "--replace" in library(tmp_path, "add", two, "--name", "mine", code=2)
    library(tmp_path, "add", two, "--name", "Mine", "--replace")
    assert kept(tmp_path) == ["Mine", "two"]
    np.testing.assert_allclose(Source.from_library("mine").flux_flam, 2 * Source.read(mine).flux_flam, rtol=1e-15)
    library(tmp_path, "add", mine, "--name", "a b")
    for name, fact in (("a_b", "too much like another"), ("g2v", "'g2v'"), ("../escape", "64")):
        assert fact in library(tmp_path, "add", mine, "--name", name, code=2)
    assert "Your own" in library(tmp_path)
    library(tmp_path, "remove", "MINE", "two")
    with refused("name", "'mine'"):
        Source.from_library("mine")
    assert "'mine'" in library(tmp_path, "remove", "mine", code=2)
    # A file that was changed is no star, and may be removed.
    (path,) = own_folder.rglob("*.ecsv")
    for changed, key in ((path.read_text().replace("e-13", "e-12", 1), "name"), ("garbage", "file")):
        path.write_text(changed)
        with refused(key):
            Source.from_library("a b")
    library(tmp_path, "remove", "a b")
    assert "Your own" not in library(tmp_path)
    # Names of files have no Greek letters: those of two stars were the same, and the wrong one was removed.
    for k, name in enumerate(("β Pic", "γ Pic", "_ Pic x"), 1):
        library(tmp_path, "add", text_file(tmp_path / f"{k}.txt", float(k)), "--name", name)
    assert kept(tmp_path) == ["_ Pic x", "β Pic", "γ Pic"]
    fluxes = [Source.from_library(name).flux_flam[100] for name in ("β Pic", "γ Pic")]
    assert fluxes[1] == pytest.approx(2 * fluxes[0])
    library(tmp_path, "remove", "γ Pic")
    assert kept(tmp_path) == ["_ Pic x", "β Pic"]
    assert "γ Pic" in library(tmp_path, "remove", "γ Pic", code=2)


class Archive(http.server.BaseHTTPRequestHandler):
    """Serves `files`; addresses with "cut", "hang", "endless", "slow" and "busy" break off, hang or fail."""

    files: ClassVar[dict[str, bytes]] = {}
    over: ClassVar[threading.Event]
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        path = self.path.lstrip("/")
        if "hang" in path:
            self.over.wait(3)
        is_slow = "slow" in path
        if "endless" not in path and not is_slow and path not in self.files:
            self.send_error(503 if "busy" in path else 404)
            return
        self.send_response(200)
        self.close_connection = path not in self.files or "cut" in path
        if path in self.files:
            self.send_header("Content-Length", str(len(self.files[path]) * (2 if "cut" in path else 1)))
        self.end_headers()
        self.wfile.write(self.files.get(path, b""))
        with contextlib.suppress(OSError):
            while path not in self.files and not self.over.wait(0.02 * is_slow):
                self.wfile.write(bytes(1 << (6 if is_slow else 16)))

    def log_message(self, *_: Any) -> None:
        pass


ARCHIVE, CALSPEC = "https://archive.stsci.edu/", "hlsps/reference-atlases/cdbs/current_calspec/"


@pytest.fixture
def archive(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return the address of a server that answers for the archive, which has half a second in place of twenty."""
    calspec = WHOLE.read_bytes()
    ngsl = archive_file(TARGNAME="HD037202", DATAQUAL="good", OFFSETPX=0.1)
    names = ("18sco_stis_004.fits", "18sco_stis_006.fits", "18sco_stis_005.fits", "18sco_mod_009.fits",
             "cut_stis_001.fits", "vb8_stiswfcnic_004.fits")  # fmt: skip
    links = "".join(f'<a href="{name}">{name}</a>' for name in names)
    Archive.files = {
        CALSPEC: f"<html>{links}</html>".encode(),
        f"{CALSPEC}18sco_stis_006.fits": calspec,
        f"{CALSPEC}cut_stis_001.fits": calspec,
        f"{CALSPEC}vb8_stiswfcnic_004.fits": (WHOLE.parent / "vb8_stiswfcnic_004.fits").read_bytes(),
        "pub/hlsp/stisngsl/v2/hd037202/h_stis_ngsl_hd037202_v2.fits": ngsl,
        "pub/hlsp/stisngsl/v2/hd000001/h_stis_ngsl_hd000001_v2.fits": ngsl[: len(ngsl) // 2],
        "pub/hlsp/stisngsl/v2/hd000002/h_stis_ngsl_hd000002_v2.fits": b"<html>Sorry</html>",
        "hlsps/lowlib/hlsp_lowlib_hst_stis_hd146233_g230lb-g430l-g750l_v1.0_spect.fits": archive_file(),
    }
    Archive.over = threading.Event()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Archive) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        here, opened = f"http://127.0.0.1:{server.server_port}/", urllib.request.urlopen

        def urlopen(request: Any, timeout: float) -> Any:
            request.full_url = request.full_url.replace(ARCHIVE, here)
            return opened(request, timeout=timeout / 40)

        monkeypatch.setattr(urllib.request, "urlopen", urlopen)
        yield here
        Archive.over.set()
        server.shutdown()


def test_calspec_stars_are_their_newest_files_and_short_ones_need_an_extension(archive: str, tmp_path: Path) -> None:
    library(tmp_path, "fetch", "calspec:18 Sco", "--from", f"{archive}{CALSPEC[:-1]}")
    star, data = Source.from_library("18 sco"), fits.getdata(WHOLE)
    assert star.name == "18 Sco"
    assert all(words in star.origin for words in ("18sco_stis_006.fits", "doi 10.1086/677655"))
    np.testing.assert_allclose(star.flux_flam, data["FLUX"].astype(float), rtol=1e-12)
    np.testing.assert_allclose(star.wavelength_nm, data["WAVELENGTH"] / 10, rtol=1e-12)
    reported = library(tmp_path, "fetch", "calspec:VB 8", code=2)
    assert all(fact in reported for fact in ("VB8", "290.033-2497.72", "200-700", "--extend"))
    library(tmp_path, "fetch", "calspec:VB 8", "--extend", "M3V")
    direct = Source.read(WHOLE.parent / "vb8_stiswfcnic_004.fits", extend="M3V")
    np.testing.assert_array_equal(Source.from_library("VB 8").flux_flam, direct.flux_flam)
    # Its messages are reported wherever it is used.
    said = " ".join(simulate(star="VB 8", magnitude=9.0).inputs[0].messages)
    assert all(words in said for words in ("113 of its 1349 points", "continued by M3V"))
    library(tmp_path, "add", f"{WHOLE.parent / 'ckp00_5750.fits'}[g45]", "--name", "model")
    assert "at the star's surface" in Source.from_library("model").unscaled
    with refused("magnitude"):
        simulate(star="model")


def test_dereddened_star_is_marked_and_can_be_reddened(archive: str, tmp_path: Path) -> None:
    reported = library(tmp_path, "fetch", "lowlib:HD146233")
    assert "--star HD146233" in reported
    assert "--ebv reddens it again" in reported
    assert "HST stellar library of 513 stars" in library(tmp_path)
    plain, dusty = (simulate(star="HD146233", magnitude=7.0, **red).inputs[0] for red in ({}, {"ebv": 0.1}))
    assert any("dereddened by its archive" in text for text in plain.messages)
    assert not any("dereddened by its archive" in text for text in dusty.messages)
    ratio = (dusty.source_electrons / plain.source_electrons)[[100, -100]]
    assert ratio[0] < 0.8 < ratio[1]
    # Without a collection's name each is searched.
    library(tmp_path, "fetch", "HD 37202")
    star = Source.from_library("HD 37202")
    assert "Spectral Library" in star.origin
    assert "DATAQUAL = good" in star.notes
    assert not any("dereddened" in text for text in star.notes)


@pytest.mark.parametrize(("name", "below", "facts"), toml("downloads.toml")["failed"])
def test_failed_downloads_raise(
    archive: str, tmp_path: Path, name: str, below: str, facts: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    if below == "slow":
        # The ten minutes of a download pass in a third of a second.
        monkeypatch.setattr(time, "monotonic", lambda: 2000 * time.perf_counter())
    reported = library(tmp_path, "fetch", name, *(["--from", f"{archive}{below}"] if below else []), code=2)
    assert all(fact in reported for fact in facts), reported
    assert kept(tmp_path) == []


def test_documentation_and_help_list_all_collections(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/my-star.md").read_text(encoding="utf-8")
    named = {*re.findall(r'fetch "(\w+):', page), *re.findall(r"\b(\w+):\.\.\.", page)}
    (listed,) = re.findall("must be one of (.*), not 'mast'", library(tmp_path, "fetch", "mast:HD 37202", code=2))
    assert named == {*listed.split(", ")}
    assert all(name in library(tmp_path, "fetch", "--help") for name in named)
