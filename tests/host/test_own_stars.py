"""The user's own stars: kept from files, and fetched from a local server in place of the archives."""

import contextlib
import http.server
import io
import json
import re
import threading
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commands import run
from refusals import refused

from mauvecl import Expectation, Source, Study, simulate
from mauvecl.host.stars import additions


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MAUVECL_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "data" / "stars"


DATA = Path(__file__).parents[1] / "data"
WHOLE = DATA / "spectra" / "18sco_stis_004.fits"
DOWNLOADS = tomllib.loads((DATA / "downloads.toml").read_text(encoding="utf-8"))["failed"]
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


def not_done(folder: Path, *words: str | Path) -> str:
    return library(folder, *words, code=2)


def kept(folder: Path) -> list[str]:
    return [one["name"] for one in json.loads(library(folder, "--json")) if one["kept"] == "yours"]


def answered(name: str, **star: Any) -> Expectation:
    return simulate(Study.build({"star": [{"library": name, **star}]}, "test")).inputs[0]


def test_kept_star_is_part_of_the_library(tmp_path: Path, own_folder: Path) -> None:
    files = [text_file(tmp_path / name) for name in ("mine.txt", "two.txt")]
    assert "Kept mine: --star mine" in library(tmp_path, "add", *files)
    assert {path.parent for path in own_folder.rglob("*.ecsv")} == {own_folder}
    assert Source.from_library("MINE").digest == Source.read(files[0]).digest
    assert kept(tmp_path) == ["mine", "two"]
    assert "Your own" in library(tmp_path)
    assert answered("mine", magnitude=7.0).name == "mine"
    library(tmp_path, "remove", "Mine", "two")
    assert "Your own" not in library(tmp_path)
    with refused("name", "'mine'"):
        Source.from_library("mine")
    assert "'mine'" in not_done(tmp_path, "remove", "mine")


def test_invalid_star_names_raise(tmp_path: Path) -> None:
    file = text_file(tmp_path / "mine.txt")
    assert "'g2v'" in not_done(tmp_path, "add", file, "--name", "g2v")
    assert "64" in not_done(tmp_path, "add", file, "--name", "../escape")
    library(tmp_path, "add", file, "--name", "twin")
    assert "--replace" in not_done(tmp_path, "add", file, "--name", "twin")
    library(tmp_path, "add", text_file(tmp_path / "other.txt", 2.0), "--name", "Twin", "--replace")
    assert len(kept(tmp_path)) == 1
    np.testing.assert_allclose(Source.from_library("twin").flux_flam, 2 * Source.read(file).flux_flam, rtol=1e-15)
    library(tmp_path, "add", file, "--name", "a b")
    assert "too much like another" in not_done(tmp_path, "add", file, "--name", "a_b")


def test_names_in_other_letters_are_kept_side_by_side(tmp_path: Path) -> None:
    """Names of files have no Greek letters: those of two stars were the same, and the wrong one was removed."""
    for k, name in enumerate(("β Pic", "γ Pic", "_ Pic x"), 1):
        library(tmp_path, "add", text_file(tmp_path / f"{k}.txt", float(k)), "--name", name)
    assert sorted(kept(tmp_path)) == ["_ Pic x", "β Pic", "γ Pic"]
    fluxes = [Source.from_library(name).flux_flam[100] for name in ("β Pic", "γ Pic")]
    assert fluxes[1] == pytest.approx(2 * fluxes[0])
    library(tmp_path, "remove", "γ Pic")
    assert sorted(kept(tmp_path)) == ["_ Pic x", "β Pic"]
    assert "γ Pic" in not_done(tmp_path, "remove", "γ Pic")


def test_changed_file_raises(tmp_path: Path, own_folder: Path) -> None:
    library(tmp_path, "add", text_file(tmp_path / "mine.txt"))
    (path,) = own_folder.rglob("*.ecsv")
    path.write_text(path.read_text().replace("e-13", "e-12", 1))
    with refused("name", "'mine'"):
        Source.from_library("mine")
    path.write_text("garbage")
    with refused("file"):
        Source.from_library("mine")
    library(tmp_path, "remove", "mine")
    assert kept(tmp_path) == []


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


@pytest.fixture
def archive() -> Iterator[str]:
    calspec = WHOLE.read_bytes()
    ngsl = archive_file(TARGNAME="HD037202", DATAQUAL="good", OFFSETPX=0.1)
    names = ("18sco_stis_004.fits", "18sco_stis_006.fits", "18sco_stis_005.fits", "18sco_mod_009.fits",
             "cut_stis_001.fits", "vb8_stiswfcnic_004.fits")  # fmt: skip
    links = "".join(f'<a href="{name}">{name}</a>' for name in names)
    lowlib = "hlsp_lowlib_hst_stis_{}_g230lb-g430l-g750l_v1.0_spect.fits"
    Archive.files = {
        "calspec/": f"<html>{links}</html>".encode(),
        "calspec/18sco_stis_006.fits": calspec,
        "calspec/cut_stis_001.fits": calspec,
        "calspec/vb8_stiswfcnic_004.fits": (WHOLE.parent / "vb8_stiswfcnic_004.fits").read_bytes(),
        "ngsl/hd037202/h_stis_ngsl_hd037202_v2.fits": ngsl,
        "ngsl/hd000001/h_stis_ngsl_hd000001_v2.fits": ngsl[: len(ngsl) // 2],
        "ngsl/hd000002/h_stis_ngsl_hd000002_v2.fits": b"<html>Sorry</html>",
        f"lowlib/{lowlib.format('hd146233')}": archive_file(),
    }
    Archive.over = threading.Event()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Archive) as server:
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        Archive.over.set()
        server.shutdown()


def test_calspec_star_is_its_newest_file(archive: str, tmp_path: Path) -> None:
    library(tmp_path, "fetch", "calspec:18 Sco", "--from", f"{archive}/calspec/")
    star, data = Source.from_library("18 sco"), fits.getdata(WHOLE)
    assert star.name == "18 Sco"
    assert all(words in star.origin for words in ("18sco_stis_006.fits", "doi 10.1086/677655"))
    np.testing.assert_allclose(star.flux_flam, data["FLUX"].astype(float), rtol=1e-12)
    np.testing.assert_allclose(star.wavelength_nm, data["WAVELENGTH"] / 10, rtol=1e-12)


def test_short_spectrum_is_kept_with_its_extension(archive: str, tmp_path: Path) -> None:
    words = ("fetch", "calspec:VB 8", "--from", f"{archive}/calspec/")
    reported = not_done(tmp_path, *words)
    assert all(fact in reported for fact in ("VB8", "290.033-2497.72", "200-700", "--extend"))
    library(tmp_path, *words, "--extend", "M3V")
    direct = Source.read(WHOLE.parent / "vb8_stiswfcnic_004.fits", extend="M3V")
    np.testing.assert_array_equal(Source.from_library("VB 8").flux_flam, direct.flux_flam)
    # Its messages are reported wherever it is used.
    said = " ".join(answered("VB 8", magnitude=9.0).messages)
    assert all(words in said for words in ("113 of its 1349 points", "continued by M3V"))
    library(tmp_path, "add", f"{WHOLE.parent / 'ckp00_5750.fits'}[g45]", "--name", "model")
    assert "at the star's surface" in Source.from_library("model").unscaled
    with refused("magnitude"):
        answered("model")


def test_dereddened_star_is_marked_and_can_be_reddened(archive: str, tmp_path: Path) -> None:
    reported = library(tmp_path, "fetch", "lowlib:HD146233", "--from", f"{archive}/lowlib")
    assert "--star HD146233" in reported
    assert "--ebv reddens it again" in reported
    assert "HST stellar library of 513 stars" in library(tmp_path)
    plain, dusty = (answered("HD146233", magnitude=7.0, **more) for more in ({}, {"ebv": 0.1}))
    assert any("dereddened by its archive" in text for text in plain.messages)
    assert not any("dereddened by its archive" in text for text in dusty.messages)
    ratio = (dusty.source_electrons / plain.source_electrons)[[100, -100]]
    assert ratio[0] < 0.8 < ratio[1]
    library(tmp_path, "fetch", "ngsl:HD 37202", "--from", f"{archive}/ngsl")
    star = Source.from_library("HD 37202")
    assert "DATAQUAL = good" in star.notes
    assert not any("dereddened" in text for text in star.notes)


def test_any_collection_is_searched(archive: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = tuple(replace(c, base=f"{archive}/{c.name}/") for c in additions.COLLECTIONS)
    monkeypatch.setattr(additions, "COLLECTIONS", here)
    library(tmp_path, "fetch", "HD 37202")
    assert "Spectral Library" in Source.from_library("HD 37202").origin
    reported = not_done(tmp_path, "fetch", "HD 99999")
    assert all(words in reported for words in ("'HD 99999'", "CALSPEC"))


@pytest.mark.parametrize(("name", "below", "facts"), DOWNLOADS)
def test_failed_downloads_raise(
    archive: str, tmp_path: Path, name: str, below: str, facts: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    monkeypatch.setattr(additions, "MAX_LISTING_BYTES", 1 << 20)
    monkeypatch.setattr(additions, "MAX_DOWNLOAD_S", 0.3 if below == "slow" else 60.0)
    monkeypatch.setattr(additions, "TIMEOUT_S", 0.5)
    reported = not_done(tmp_path, "fetch", name, "--from", f"{archive}/{below}")
    assert all(fact in reported for fact in facts), reported
    assert kept(tmp_path) == []


def test_documentation_and_help_list_all_collections(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs/my-star.md").read_text(encoding="utf-8")
    named = {*re.findall(r'fetch "(\w+):', page), *re.findall(r"\b(\w+):\.\.\.", page)}
    assert named == {one.name for one in additions.COLLECTIONS}
    assert all(name in library(tmp_path, "fetch", "--help") for name in named)
