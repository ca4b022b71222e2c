"""The user's own stars: kept from files, and fetched from a local server in place of the archives."""

from __future__ import annotations

import contextlib
import http.server
import io
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from astropy.io import fits
from refusals import refused
from typer.testing import CliRunner

from mauvecl.cli.app import app
from mauvecl.host.expectation import expect
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.stars import hst_collections, own_stars
from mauvecl.host.stars.add_star import add
from mauvecl.host.stars.catalogue import library_table
from mauvecl.host.stars.source import Source
from mauvecl.study.cases import Case
from mauvecl.study.study import Study


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set a temporary data folder."""
    monkeypatch.setenv("MAUVECL_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "data" / "stars"


WHOLE = Path(__file__).parents[1] / "data" / "spectra" / "18sco_stis_004.fits"
WAVELENGTH_NM = np.linspace(170.0, 1000.0, 500)
FLUX = 1e-12 * np.exp(-(((WAVELENGTH_NM - 500) / 200) ** 2))


def text_file(path: Path, scale: float = 1.0) -> Path:
    np.savetxt(path, np.transpose([WAVELENGTH_NM, scale * FLUX]))
    return path


def archive_file(units: tuple[str, str], **header: Any) -> bytes:
    """Return a FITS table in the archives' format."""
    columns = [
        fits.Column("WAVELENGTH", "D", unit=units[0], array=10 * WAVELENGTH_NM),
        fits.Column("FLUX", "E", unit=units[1], array=FLUX),
    ]
    primary = fits.PrimaryHDU()
    primary.header.update(header)
    out = io.BytesIO()
    fits.HDUList([primary, fits.BinTableHDU.from_columns(columns)]).writeto(out)
    return out.getvalue()


def test_kept_star_is_part_of_the_library(tmp_path: Path, own_folder: Path) -> None:
    file = text_file(tmp_path / "mine.txt")
    kept = add(file, "HD 1234")
    assert kept.path.parent == own_folder
    star = Source.from_library("hd 1234")
    np.testing.assert_array_equal(star.wavelength_nm, Source.read(file).wavelength_nm)
    np.testing.assert_array_equal(star.flux_flam, Source.read(file).flux_flam)
    assert star.digest == Source.read(file).digest
    row = library_table()[-1]
    assert (row["name"], row["kept"]) == ("HD 1234", "yours")
    asked = Study.build({"star": [{"library": "HD 1234", "magnitude": 7.0}]}, "test")
    assert Case(asked).expectations[0].name == "HD 1234"
    own_stars.remove("hd 1234")
    with refused("name", "'HD 1234'"):
        Source.from_library("HD 1234")
    with refused("name", "'HD 1234'"):
        own_stars.remove("HD 1234")


def test_invalid_star_names_raise(tmp_path: Path) -> None:
    file = text_file(tmp_path / "mine.txt")
    with refused("name", "'g2v'"):
        add(file, "g2v")
    with refused("name", "64"):
        add(file, "../escape")
    add(file, "twin")
    with refused("name", "'twin'", "`replace=True`"):
        add(file, "twin")
    add(text_file(tmp_path / "other.txt", 2.0), "Twin", replace=True)
    assert len(own_stars.kept()) == 1
    np.testing.assert_allclose(Source.from_library("twin").flux_flam, 2 * Source.read(file).flux_flam, rtol=1e-15)
    with refused("name"):
        add(file, "a b") and add(file, "a_b")


def test_names_in_other_letters_are_kept_side_by_side(tmp_path: Path) -> None:
    """Names of files have no Greek letters: those of two stars were the same, and the wrong one was removed."""
    for k, name in enumerate(("β Pic", "γ Pic", "_ Pic x"), 1):
        add(text_file(tmp_path / f"{k}.txt", float(k)), name)
    assert sorted(star.name for star in own_stars.kept()) == ["_ Pic x", "β Pic", "γ Pic"]
    fluxes = [Source.from_library(name).flux_flam[100] for name in ("β Pic", "γ Pic")]
    assert fluxes[1] == pytest.approx(2 * fluxes[0])
    own_stars.remove("γ Pic")
    assert sorted(star.name for star in own_stars.kept()) == ["_ Pic x", "β Pic"]
    add(text_file(tmp_path / "2.txt", 2.0), "γ Pic")
    own_stars.remove("β Pic")
    assert sorted(star.name for star in own_stars.kept()) == ["_ Pic x", "γ Pic"]
    with refused("name", "β Pic"):
        own_stars.remove("β Pic")


def test_changed_file_raises(tmp_path: Path) -> None:
    kept = add(text_file(tmp_path / "mine.txt"), "mine")
    text = kept.path.read_text()
    kept.path.write_text(text.replace("e-13", "e-12", 1))
    with refused("name", "'mine'"):
        Source.from_library("mine")
    kept.path.write_text("garbage")
    with refused("file"):
        Source.from_library("mine")
    own_stars.remove("mine")
    assert own_stars.kept() == []


class Archive(http.server.BaseHTTPRequestHandler):
    """Serves `files`; addresses in `broken` break off, hang or fail."""

    files: ClassVar[dict[str, bytes]] = {}
    over: ClassVar[threading.Event]
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        path = self.path.lstrip("/")
        if path.endswith("hang"):
            time.sleep(3)
        if "endless" in path or "slow" in path:
            self.send_response(200)
            self.end_headers()
            with contextlib.suppress(OSError):
                while not self.over.wait(0.02 if "slow" in path else 0.0):
                    self.wfile.write(bytes(1 << 6 if "slow" in path else 1 << 16))
            self.close_connection = True
            return
        if path not in self.files:
            self.send_error(503 if "busy" in path else 404)
            return
        content = self.files[path]
        self.send_response(200)
        self.send_header("Content-Length", str(len(content) * (2 if "cut" in path else 1)))
        self.end_headers()
        self.wfile.write(content)
        self.close_connection = "cut" in path

    def log_message(self, *_: Any) -> None:
        pass


@pytest.fixture
def archive() -> Iterator[str]:
    """Serve the archives' files locally and return the address."""
    calspec = WHOLE.read_bytes()
    ngsl = archive_file(("Angstrom", "erg/s/cm2/A"), TARGNAME="HD037202", DATAQUAL="good", OFFSETPX=0.1)
    names = (
        "18sco_stis_004.fits",
        "18sco_stis_006.fits",
        "18sco_stis_005.fits",
        "18sco_mod_009.fits",
        "cut_stis_001.fits",
        "vb8_stiswfcnic_004.fits",
    )
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
        f"lowlib/{lowlib.format('hd146233')}": archive_file(("Angstrom", "erg/s/cm2/A")),
    }
    Archive.over = threading.Event()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Archive)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    Archive.over.set()
    server.shutdown()
    server.server_close()


def test_calspec_star_is_its_newest_file(archive: str) -> None:
    kept = hst_collections.fetch("calspec:18 Sco", base=f"{archive}/calspec/", show_progress=False)
    assert kept.name == "18 Sco"
    assert "18sco_stis_006.fits" in kept.origin
    assert "doi 10.1086/677655" in kept.origin
    star = Source.from_library("18 sco")
    with fits.open(WHOLE) as hdus:
        np.testing.assert_allclose(star.flux_flam, hdus[1].data["FLUX"].astype(float), rtol=1e-12)
        np.testing.assert_allclose(star.wavelength_nm, hdus[1].data["WAVELENGTH"] / 10, rtol=1e-12)
    assert star.magnitude("V") == pytest.approx(5.50, abs=0.06)


def test_short_spectrum_is_kept_with_its_extension(archive: str, tmp_path: Path) -> None:
    base = f"{archive}/calspec/"
    with refused("base", "VB8", "290.033-2497.72", "200-700"):
        hst_collections.fetch("calspec:VB 8", base=base, show_progress=False)
    kept = hst_collections.fetch("calspec:VB 8", base=base, show_progress=False, extend="M3V")
    assert any("continued by M3V" in text for text in kept.messages)
    star = Source.from_library("VB 8")
    direct = Source.read(WHOLE.parent / "vb8_stiswfcnic_004.fits", extend="M3V")
    np.testing.assert_array_equal(star.flux_flam, direct.flux_flam)
    # Its messages are reported wherever it is used.
    messages = expect(star.at_magnitude(9.0), Instrument.load("mauve"), exposure=50.0).messages
    assert any("113 of its 1349 points" in message for message in messages)
    assert any("continued by M3V" in message for message in messages)
    models = WHOLE.parent / "ckp00_5750.fits"
    surface = add(f"{models}[g45]", "model")
    assert "at the star's surface" in surface.unscaled
    with refused("magnitude"):
        expect(Source.from_library("model"), Instrument.load("mauve"), exposure=5.0)


def test_ngsl_star_is_fetched(archive: str) -> None:
    kept = hst_collections.fetch("ngsl:HD 37202", base=f"{archive}/ngsl", show_progress=False)
    assert "DATAQUAL = good" in kept.notes
    assert not kept.dereddened


def test_dereddened_star_is_marked_and_can_be_reddened(archive: str) -> None:
    kept = hst_collections.fetch("lowlib:HD146233", base=f"{archive}/lowlib/", show_progress=False)
    assert kept.dereddened
    star, mauve = Source.from_library("HD146233").at_magnitude(7.0), Instrument.load("mauve")
    plain = expect(star, mauve, exposure=5.0)
    assert any("dereddened by its archive" in m for m in plain.messages)
    dusty = Study.build({"star": [{"library": "HD146233", "magnitude": 7.0, "ebv": 0.1}]}, "test")
    reddened = Case(dusty).expectations[0]
    assert not any("dereddened by its archive" in m for m in reddened.messages)
    ratio = (reddened.source_electrons / plain.source_electrons)[[100, -100]]
    assert ratio[0] < 0.8 < ratio[1]


def test_any_collection_is_searched(archive: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    here = tuple(replace(c, base=f"{archive}/{c.name}/") for c in hst_collections.COLLECTIONS)
    monkeypatch.setattr(hst_collections, "COLLECTIONS", here)
    assert "Spectral Library" in hst_collections.fetch("HD 37202", show_progress=False).origin
    with refused("name", "'HD 99999'", "CALSPEC"):
        hst_collections.fetch("HD 99999", show_progress=False)


@pytest.mark.parametrize(
    ("name", "below", "refusal"),
    [
        ("ngsl:HD 1", "ngsl", ("base", "h_stis_ngsl_hd000001_v2.fits")),
        ("ngsl:HD 2", "ngsl", ("base", "h_stis_ngsl_hd000002_v2.fits")),
        ("calspec:cut", "calspec", ("base", "cut_stis_001.fits")),
        ("ngsl:HD 3", "ngsl", ("name", "'HD 3'")),
        ("calspec:nobody", "calspec", ("name", "'nobody'", "CALSPEC")),
        ("ngsl:HD 3", "busy", ("base", "503")),
        ("calspec:x", "hang", ("base",)),
    ],
)
def test_failed_downloads_raise(
    archive: str, name: str, below: str, refusal: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hst_collections, "TIMEOUT_S", 0.5)
    base = f"{archive}/{below}" if below != "hang" else f"{archive}/x"
    if below == "hang":
        collection = hst_collections.Collection("calspec", "CALSPEC", "", base, lambda star, listing: "hang")
        monkeypatch.setattr(hst_collections, "COLLECTIONS", (collection,))
    with refused(*refusal):
        hst_collections.fetch(name, base=base, show_progress=False)
    assert own_stars.kept() == []


@pytest.mark.parametrize(
    ("name", "below", "refusal"),
    [
        ("ngsl:HD 1", "endless", ("MAUVECL_LARGEST_FILE_MIB", "_v2.fits", "1")),
        ("calspec:x", "endless", ("MAUVECL_LARGEST_FILE_MIB", "1")),
        ("ngsl:HD 1", "slow", ("base", "_v2.fits", "0")),
    ],
)
def test_endless_downloads_raise(
    archive: str, name: str, below: str, refusal: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAUVECL_LARGEST_FILE_MIB", "1")
    monkeypatch.setattr(hst_collections, "MAX_LISTING_BYTES", 1 << 20)
    monkeypatch.setattr(hst_collections, "MAX_DOWNLOAD_S", 0.3 if below == "slow" else 60.0)
    with refused(*refusal):
        hst_collections.fetch(name, base=f"{archive}/{below}", show_progress=False)
    assert own_stars.kept() == []


def test_download_without_a_network_raises() -> None:
    with refused("base"):
        hst_collections.fetch("ngsl:HD 37202", base="http://127.0.0.1:9/", show_progress=False)
    with refused("collection", "'mast'"):
        hst_collections.fetch("mast:HD 37202")
    with refused("name", "37202"):
        hst_collections.fetch("HD 37202", base="http://127.0.0.1:9/")


@pytest.mark.long
def test_library_commands_work(tmp_path: Path, archive: str) -> None:
    run = CliRunner().invoke
    files = [str(text_file(tmp_path / f"{name}.txt")) for name in ("one", "two")]
    added = run(app, ["library", "add", *files])
    assert added.exit_code == 0, added.output
    assert "Kept one: --star one" in added.output
    fetched = run(app, ["library", "fetch", "lowlib:HD 146233", "--from", f"{archive}/lowlib"])
    assert fetched.exit_code == 0, fetched.output
    assert '--star "HD 146233"' in fetched.output
    assert "--ebv reddens it again" in fetched.output
    listed = run(app, ["library"])
    assert "Your own" in listed.output
    assert "HST stellar library of 513 stars" in listed.output
    simulated = run(
        app, ["simulate", "--star", "HD 146233", "-m", "8", "--ebv", "0.1", "--no-pictures", "-o", str(tmp_path / "s")]
    )
    assert simulated.exit_code == 0, simulated.output
    assert run(app, ["library", "remove", "one", "two", "HD 146233"]).exit_code == 0
    assert "Your own" not in run(app, ["library"]).output


def test_documentation_and_help_list_all_collections() -> None:
    page = (Path(__file__).parents[2] / "docs/my-star.md").read_text(encoding="utf-8")
    named = {*re.findall(r'fetch "(\w+):', page), *re.findall(r"\b(\w+):\.\.\.", page)}
    assert named == {one.name for one in hst_collections.COLLECTIONS}
    reported = CliRunner().invoke(app, ["library", "fetch", "--help"]).output
    assert all(name in reported for name in named)
