"""Observations of standard stars that a visitor uploads: read apart from the server, fitted as on the command line."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from golden_inputs import RAW
from refusals import refused

pytest.importorskip("bokeh")

from mauvecl import Instrument, Source, Study, calibrate
from mauvecl.web.closed_forms import ClosedForms
from mauvecl.web.downloads import as_file, commands_and_programs
from mauvecl.web.fields import UPLOADED_FILE
from mauvecl.web.standards import MOST_BYTES, MOST_FILES, MOST_NAME, MOST_TOML_BYTES, Observations, unpacked
from mauvecl.web.state import State
from mauvecl.web.tabs import TABS
from mauvecl.web.visitor import shown
from tests.observations.test_calibration import frames_of, star, truth
from tests.web.visits import Server, fresh

if TYPE_CHECKING:
    from playwright.sync_api import Browser

TAB = TABS["calibrate"]
#: The star of the file is half a magnitude fainter in it than it was observed.
STUDY = """
[[calibrate.observations]]
frames = "nights/b3v.fits"
mapping = "frames.toml"
spectrum = "b3v.ecsv"
magnitude = 4.5

[[calibrate.observations]]
frames = "dark.fits"
mapping = "frames.toml"
"""


def fits_of(source: Source | None, temperatures: list[float], seed: int) -> bytes:
    frames = frames_of(truth(), source, temperatures, 20, np.random.default_rng(seed))
    times = Table({"TIME": frames.time_s, "TEMPERATURE": frames.temperature_c})
    assert frames.wavelength_nm is not None
    images = [fits.ImageHDU(frames.flux, name="RAW"), fits.ImageHDU(frames.wavelength_nm, name="WAVELENGTH")]
    out = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU(times, name="FRAMES"), *images]).writeto(out)
    return out.getvalue()


def spectrum() -> bytes:
    fainter = star("B3V", 5.0)
    table = Table({"wavelength": fainter.wavelength_nm, "flux": fainter.flux_flam})
    table["wavelength"].unit, table["flux"].unit = "nm", "erg / (s cm2 Angstrom)"
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    return text.getvalue().encode()


@pytest.fixture(scope="module")
def contents() -> dict[str, bytes]:
    """Return the files of a visitor by name."""
    return {
        "standards.toml": STUDY.encode(), "frames.toml": RAW.encode(), "b3v.ecsv": spectrum(),
        "b3v.fits": fits_of(star("B3V", 4.5), [17.0], 1), "dark.fits": fits_of(None, [15.0, 17.0, 19.0], 2),
    }  # fmt: skip


def zipped(contents: dict[str, bytes], packing: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", packing) as archive:
        for name, one in contents.items():
            archive.writestr(name, one)
    return out.getvalue()


def page_of(contents: dict[str, bytes], folder: Path) -> ClosedForms:
    """Return the question of a visitor who has chosen an archive of files."""
    state = State({"observations": Observations.of("standards.zip", zipped(contents))})
    state.enter({"observations": UPLOADED_FILE})
    question = state.question(TAB.reads)
    return ClosedForms.of(question, folder, headline=False, given=TAB.given(question))


@pytest.mark.long
def test_uploaded_standards_are_fitted_as_on_the_command_line(contents: dict[str, bytes], tmp_path: Path) -> None:
    page = page_of(contents, tmp_path)
    answers = {"calibrate": calibrate(page.study, **page.given)}
    here = tmp_path / "here"
    (here / "nights").mkdir(parents=True)
    for name, content in contents.items():
        (here / ("nights" if name == "b3v.fits" else "") / name).write_bytes(content)
    own = calibrate(Study.read(here / "standards.toml"))
    np.testing.assert_array_equal(answers["calibrate"].throughput.log_factor, own.throughput.log_factor)
    np.testing.assert_array_equal(answers["calibrate"].throughput.joint, own.throughput.joint)
    # What the files are called on the server appears in no table, and the study comes with its files.
    _, table = as_file(TAB, "calibrate", "ecsv", page, answers)
    assert str(tmp_path).encode() not in table
    _, study = as_file(TAB, "calibrate", "study", page, answers)
    with zipfile.ZipFile(io.BytesIO(study)) as archive:
        archive.extractall(tmp_path / "again")
    assert str(tmp_path) not in (tmp_path / "again" / "study.toml").read_text()
    again = calibrate(Study.read(tmp_path / "again" / "study.toml"))
    np.testing.assert_array_equal(again.throughput.joint, own.throughput.joint)
    # The archive is an instrument like the shipped ones.
    name, content = as_file(TAB, "instrument.zip", "", page, answers)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        archive.extractall(tmp_path / "instrument")
    assert name == "instrument.zip"
    nm = np.array([300.0, 500.0])
    read = Instrument.load(tmp_path / "instrument" / "instrument.toml")
    np.testing.assert_allclose(read.throughput(nm), own.instrument.throughput(nm), rtol=1e-12)


@pytest.mark.long
def test_pictures_show_the_fit(contents: dict[str, bytes], tmp_path: Path) -> None:
    page = page_of(contents, tmp_path)
    answers = {"calibrate": calibrate(page.study, **page.given)}
    pictures = shown("calibrate", page, answers)["pictures"]
    assert "B3V" in pictures["residuals"]["text"] or "b3v" in pictures["residuals"]["text"]
    assert "times the nominal one" in pictures["throughput"]["text"]
    assert "DN per electron" in pictures["transfer"]["text"]
    assert shown("calibrate", page, {})["pictures"]["transfer"]["text"].startswith("Choose an archive")
    assert TAB.rows(page, answers)[1][0] == "dark current"
    (one,) = commands_and_programs(TAB, page.question, tmp_path)
    assert str(tmp_path) not in one["command"] + one["python"]


@pytest.mark.long
def test_visitor_calibrates_after_a_refused_archive(
    browser: Browser, server: Server, contents: dict[str, bytes]
) -> None:
    page = fresh(browser, f"{server.address}?tab=calibrate")
    chosen = page.locator('[data-upload="observations"]')
    chosen.set_input_files(
        {"name": "standards.zip", "mimeType": "application/zip", "buffer": zipped({"../a.csv": b"1"})}
    )
    page.locator("#panel-calibrate").get_by_text("the archive holds a file named '../a.csv'").wait_for()
    chosen.set_input_files({"name": "standards.zip", "mimeType": "application/zip", "buffer": zipped(contents)})
    page.locator('[data-simulate="calibrate"]').click()
    # Seen, although the refusal hid the notes.
    page.get_by_text("notes on this answer").wait_for()
    assert page.locator('[data-file="instrument.zip"]').is_enabled()


@pytest.mark.parametrize(
    ("change", "value"),
    [
        ({"dark.fits": None}, "dark.fits"),
        ({"standards.toml": None}, None),
        ({"second.toml": STUDY.encode()}, None),
        ({"standards.toml": b"[calibrate\n"}, None),
        ({"other/frames.toml": b""}, None),
        ({"standards.toml": b"[calibrate]\nobservations = 3\n"}, None),
        ({"b3v.fits": b"nothing of the kind"}, "b3v.fits"),
        ({"b3v.ecsv": b"nothing of the kind"}, "b3v.ecsv"),
        ({"standards.toml": f"[sky]\nnone = true\n{STUDY}".encode()}, "sky"),
        ({"standards.toml": STUDY.encode() * MOST_FILES}, None),
        ({"standards.toml": b"a = " + b"[" * 10_000}, None),
        ({"standards.toml": STUDY.encode() + b"#" * MOST_TOML_BYTES}, None),
    ],
)
def test_missing_and_broken_files_are_refused(
    change: dict[str, bytes | None], value: str | None, contents: dict[str, bytes], tmp_path: Path
) -> None:
    chosen = {name: one for name, one in (contents | change).items() if one is not None}
    with refused("observations", **({} if value is None else {"value": value})):
        page_of(chosen, tmp_path)


@pytest.mark.parametrize(
    "content",
    [
        b"no archive",
        zipped({f"{k}.txt": b"" for k in range(MOST_FILES + 1)}),
        zipped({"zeros": bytes(MOST_BYTES + 1)}),
        zipped({"../b3v.fits": b"1"}),
        zipped({"nights/..": b"1"}),
        zipped({"/etc/b3v.fits": b"1"}),
        zipped({"C:\\b3v.fits": b"1"}),
        zipped({"a" * (MOST_NAME + 1): b"1"}),
        zipped({"a\nb": b"1"}),
        zipped({"a.csv": b"1" * 999})[:-40],
        zipped({"a.csv": b"1" * 999}).replace(b"a.csv", b"b.csv", 1),
        zipped({"a.csv": bytes(range(256))}, zipfile.ZIP_STORED).replace(b"\x10\x11", b"\x11\x10"),
        zipped({"a.csv": b"1" * 999}, zipfile.ZIP_LZMA),
    ],
    ids=["no archive", "many files", "large file", "parent folder", "only a parent", "absolute", "drive", "long name",
         "line break", "cut off", "two names", "checksum", "unbounded packing"],
)  # fmt: skip
def test_archives_are_limited(content: bytes) -> None:
    with refused("observations"):
        unpacked(content)


def test_archives_that_state_too_small_sizes_are_not_unpacked() -> None:
    size = MOST_BYTES // 2
    content = zipped({"zeros": bytes(size)}).replace(struct.pack("<I", size), struct.pack("<I", 9))
    tracemalloc.start()
    try:
        with refused("observations"):
            unpacked(content)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < size / 10


def test_hidden_files_of_an_archive_are_left_out() -> None:
    hidden = {"__MACOSX/._standards.toml": b"\x00", ".DS_Store": b"1", "nights/.DS_Store": b"2"}
    assert unpacked(zipped({"nights/a.csv": b"1"} | hidden)) == {"a.csv": b"1"}
