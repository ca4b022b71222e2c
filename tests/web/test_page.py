"""The page in a real Chromium, as its visitors use it."""

from __future__ import annotations

import io
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from astropy.table import QTable

playwright = pytest.importorskip("playwright.sync_api")
pytest.importorskip("panel")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
if CHROMIUM is None:
    pytest.skip("no Chromium here", allow_module_level=True)

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.long

#: Milliseconds: generous, for tests that share two cores.
PATIENCE = 90_000
CLOSED, SIMULATED = "of such flares are detected", "simulated flares are detected"


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A server of its own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    log = tmp_path_factory.mktemp("serve") / "log.txt"
    with log.open("w") as out:
        server = subprocess.Popen(
            [sys.executable, "-m", "mauvecl", "serve", "--port", str(port)], stdout=out, stderr=out
        )
        while "mauvecl serves at" not in log.read_text():
            assert server.poll() is None, log.read_text()
            time.sleep(0.1)
        yield f"http://127.0.0.1:{port}/"
        server.terminate()
        server.wait(20)
    # A visitor who leaves in mid-sentence is no fault.
    told = log.read_text()
    assert "mauvecl.web" not in told, told
    assert "Traceback" not in told, told


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with playwright.sync_playwright() as play:
        found = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield found
        found.close()


@pytest.fixture
def page(browser: Browser, address: str) -> Iterator[Page]:
    found = fresh(browser, address)
    yield found
    found.close()


def fresh(browser: Browser, address: str, **how: Any) -> Page:
    page = browser.new_page(**how)
    page.set_default_timeout(PATIENCE)
    page.goto(address)
    page.get_by_role("button", name="Simulate", exact=True).wait_for()
    return page


def enter(page: Page, label: str, value: str) -> None:
    field = page.get_by_label(label)
    field.fill(value)
    field.press("Enter")


def summary(page: Page, words: str = CLOSED) -> str:
    found = page.get_by_text(words)
    found.wait_for()
    return str(found.inner_text())


def changed(page: Page, before: str) -> str:
    """The summary, once it is another."""
    for _ in range(PATIENCE // 50):
        now = page.get_by_text(CLOSED).all_inner_texts()
        if now and now[0] != before:
            return str(now[0])
        page.wait_for_timeout(50)
    raise AssertionError(f"still {before}")


def answerless(page: Page) -> None:
    """There is no answer, and nothing to press."""
    page.get_by_text("No answer.").wait_for()
    assert page.get_by_text(CLOSED).count() == 0
    assert page.get_by_text(SIMULATED).count() == 0
    assert page.get_by_role("button", name="Simulate", exact=True).is_disabled()


def download(page: Page, label: str) -> bytes:
    with page.expect_download() as coming:
        page.get_by_role("link", name=label, exact=True).or_(page.get_by_role("button", name=label, exact=True)).click()
    return Path(coming.value.path()).read_bytes()


def test_the_papers_star_from_a_fresh_page_to_the_same_bits_on_the_command_line(page: Page, tmp_path: Path) -> None:
    assert "100.00 %" in summary(page)
    assert "not a flight calibration" in page.get_by_text("The throughput is nominal").inner_text()
    page.get_by_label("Flare amplitude, %").wait_for()
    before = summary(page)
    enter(page, "Flare amplitude, %", "0.5")
    changed(page, before)
    page.get_by_role("button", name="Simulate", exact=True).click()
    told = summary(page, SIMULATED)
    page.get_by_text("Done: 200,000 of 200,000 realisations").wait_for()
    page.get_by_role("tab", name="Flare detection").or_(page.get_by_text("Flare detection", exact=True)).first.click()
    table, study = download(page, "detection (ecsv)"), download(page, "Study for the command line")
    picture, roc = download(page, "detection (png)"), download(page, "roc (fits)")
    assert picture.startswith(b"\x89PNG")
    assert download(page, "roc (png)").startswith(b"\x89PNG")
    assert roc.startswith(b"SIMPLE")
    page.get_by_text("S/N", exact=True).first.click()
    assert b"q97.5" in download(page, "snr (ecsv)"), "simulated as well"
    assert download(page, "snr (png)").startswith(b"\x89PNG")
    page.get_by_text("Noise budget", exact=True).first.click()
    assert download(page, "noise-budget (png)").startswith(b"\x89PNG")
    (tmp_path / "study.toml").write_bytes(study)
    command = [sys.executable, "-m", "mauvecl", "detect", "study.toml", "--no-pictures", "--quiet", "-o", "out"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "out" / "detection.ecsv").read_bytes() == table
    rows = QTable.read(io.BytesIO(table), format="ascii.ecsv")
    (row,) = (row for row in rows if row["statistic"] == "matched")
    assert f"{100 * row['probability']:.2f} %" in told


def test_a_link_holds_the_whole_state(browser: Browser, address: str) -> None:
    first = fresh(browser, address)
    before = summary(first)
    enter(first, "Magnitude of the star", "11")
    after = changed(first, before)
    link = first.url
    first.close()
    second = fresh(browser, link)
    assert summary(second) == after
    assert second.get_by_label("Magnitude of the star").input_value() == "11"
    second.close()


def test_an_upload_good_and_bad(page: Page, tmp_path: Path) -> None:
    before = summary(page)
    wavelength = np.linspace(170.0, 1000.0, 400)
    good, bad = tmp_path / "my star.txt", tmp_path / "bad.txt"
    np.savetxt(good, np.transpose([wavelength, 1e-12 * np.exp(-(((wavelength - 500) / 150) ** 2))]))
    bad.write_text("200 1e-12\n300 <script>alert(1)</script>\n")
    choose = page.locator("input[type=file]")
    choose.set_input_files(bad)
    page.get_by_text(re.compile(r"line 2: .* is not numeric, expected wavelength and flux")).first.wait_for()
    answerless(page)
    assert page.get_by_label("Library star").input_value() == "", "no star's name beside another's file"
    empty = tmp_path / "empty.txt"
    empty.write_text("")
    choose.set_input_files(empty)
    page.get_by_text(re.compile("empty.*|.*holds no numbers.*")).first.wait_for()
    answerless(page)
    choose.set_input_files(good)
    assert summary(page) != before
    assert page.get_by_label("Library star").input_value() == "uploaded star"
    for size in (4.2, 30, 200):
        large = tmp_path / "large.txt"
        with large.open("wb") as file:
            file.truncate(int(size * 2**20))
        choose.set_input_files(large)
        page.get_by_text(f"upload of {size:.1f} MiB, expected at most 4 MiB").first.wait_for()
        answerless(page)
        choose.set_input_files(good)
        summary(page)
    enter(page, "Library star", "Vega")
    summary(page)
    until(page, lambda: choose.input_value() == "")  # no file's name beside another star
    choose.set_input_files(good)
    page.wait_for_function("location.search.includes('star=uploaded')")
    summary(page)
    with zipfile.ZipFile(io.BytesIO(download(page, "Study for the command line"))) as archive:
        archive.extractall(tmp_path / "study")
    assert sorted(os.listdir(tmp_path / "study")) == ["star.ecsv", "study.toml"]
    text = (tmp_path / "study" / "study.toml").read_text()
    assert 'file = "star.ecsv"' in text
    command = [sys.executable, "-m", "mauvecl", "simulate", "study.toml", "--no-pictures", "--quiet"]
    subprocess.run(command, cwd=tmp_path / "study", check=True, capture_output=True)


def test_cancel_stops_at_once(page: Page) -> None:
    summary(page)
    page.get_by_label("Realisations").select_option("4000000")
    page.get_by_role("button", name="Simulate", exact=True).click()
    page.get_by_text(re.compile(r"of 8,000,000 realisations, .* a second")).wait_for()
    started = time.monotonic()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_text("Cancelled.").wait_for()
    assert time.monotonic() - started < 10, "a tile, not the rest"
    page.get_by_label("Realisations").select_option("10000")
    before = page.get_by_text(SIMULATED).count()
    assert before == 0
    enter(page, "False-alarm probability per test", "0.05")
    page.get_by_role("button", name="Simulate", exact=True).click()
    summary(page, SIMULATED)


def test_a_second_visitor_is_served_while_the_first_computes(browser: Browser, address: str) -> None:
    first, second = fresh(browser, address), fresh(browser, address)
    # Minutes of work.
    before = summary(first)
    first.get_by_label("Detection statistic").select_option("chi2_pair")
    changed(first, before)
    first.get_by_label("Realisations").select_option("4000000")
    first.get_by_role("button", name="Simulate", exact=True).click()
    first.get_by_text(re.compile(r"of 8,000,000 realisations")).wait_for()
    before = summary(second)
    enter(second, "Magnitude of the star", "12")
    changed(second, before)
    enter(second, "False-alarm probability per test", "0.05")
    second.get_by_label("Realisations").select_option("10000")
    second.get_by_role("button", name="Simulate", exact=True).click()
    summary(second, SIMULATED)
    assert first.get_by_text(SIMULATED).count() == 0, "the first is still at it"
    assert first.get_by_label("Magnitude of the star").input_value() == "7.4"
    first.get_by_role("button", name="Cancel").click()
    first.get_by_text("Cancelled.").wait_for()
    first.close()
    second.close()


def test_alerts_are_sentences(page: Page) -> None:
    before = summary(page)
    enter(page, "Magnitude of the star", "1")
    page.get_by_text(re.compile(r"SATURATED: \d+ of 1643 pixels")).wait_for()
    changed(page, before)
    page.get_by_label("Sky", exact=True).select_option("target and time")
    enter(page, "Target: coordinates such as 290.68 +11.12", "180.0 0.0")
    enter(page, "Time, UTC, such as 2026-09-01T12:00", "2026-09-23T00:00")
    page.get_by_text(re.compile(r"the Sun is \d+\.\d deg from the target")).wait_for()
    assert page.get_by_role("button", name="Simulate", exact=True).is_disabled()


def test_limit_and_map(page: Page, tmp_path: Path) -> None:
    summary(page)
    page.get_by_text("Limiting magnitude and map", exact=True).first.click()
    page.get_by_role("button", name="Draw the map").click()
    page.get_by_alt_text("Detection probability over magnitude and flare amplitude").wait_for()
    content = download(page, "map (ecsv)")
    table = QTable.read(io.BytesIO(content), format="ascii.ecsv")
    assert len(table) == 64
    assert table["closed_form"].min() < 0.5 < table["closed_form"].max()
    (tmp_path / "map.toml").write_bytes(download(page, "map (study)"))
    command = [sys.executable, "-m", "mauvecl", "map", "map.toml", "--no-pictures", "--quiet", "-o", "out"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "out" / "map.ecsv").read_bytes() == content


def test_a_phone_a_keyboard_and_a_screen_reader(browser: Browser, address: str) -> None:
    page = fresh(browser, address, viewport={"width": 390, "height": 844})
    summary(page)
    for name in ("Simulate", "Cancel"):
        box = page.get_by_role("button", name=name, exact=True).bounding_box()
        assert 0 <= box["x"] <= box["x"] + box["width"] <= 390
    for label in ("Magnitude of the star", "Flare temperature, K"):
        box = page.get_by_label(label).bounding_box()
        assert 0 <= box["x"] <= box["x"] + box["width"] <= 390
    plot = page.locator(".bk-Figure").first.bounding_box()
    assert 0 <= plot["x"] <= plot["x"] + plot["width"] <= 390
    assert page.evaluate("document.documentElement.scrollWidth") <= 390, "nothing to scroll sideways for"
    page.close()
    page = fresh(browser, address)
    summary(page)
    unnamed = page.evaluate(
        """() => {
            const found = [];
            const visit = root => {
                for (const e of root.querySelectorAll('*')) {
                    if (e.shadowRoot) visit(e.shadowRoot);
                    if (['INPUT', 'SELECT', 'BUTTON'].includes(e.tagName) && e.offsetParent !== null) {
                        const labelled = e.labels && e.labels[0] && e.labels[0].textContent;
                        const label = labelled || e.getAttribute('aria-label') || e.textContent || e.title
                            || e.placeholder;
                        if (!label) found.push(e.outerHTML.slice(0, 200));
                    }
                }
            };
            visit(document);
            return found;
        }"""
    )
    assert unnamed == []
    button = page.get_by_role("button", name="Simulate", exact=True)
    button.focus()
    page.keyboard.press("Enter")
    summary(page, SIMULATED)
    page.close()


def test_no_visitor_is_sent_elsewhere(browser: Browser, address: str) -> None:
    """The page asks no other server for anything."""
    page = browser.new_page()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(address)
    summary(page)
    elsewhere = [url for url in asked if not url.startswith((address, address.replace("http", "ws"), "data:", "blob:"))]
    page.close()
    assert elsewhere == []


def test_no_answer_beside_a_field_that_is_wrong(page: Page) -> None:
    before = summary(page)
    for label, wrong, right, told in (
        ("Magnitude of the star", "99", "7.4", "'99' is out of range, expected a number from -2 to 25"),
        ("Magnitude of the star", "7,4", "7.4", "'7,4' is not a number"),
        ("Seed", "", "1", "nothing is entered, expected a whole number"),
        ("Library star", "Proxima", "G2V", "'Proxima' is not in the library"),
    ):
        enter(page, label, wrong)
        page.get_by_text(told).first.wait_for()
        answerless(page)
        assert page.get_by_label(label).input_value() == wrong, "what was entered stays there"
        enter(page, label, right)
        assert summary(page) == before
        assert page.get_by_text(told).count() == 0


def test_stars_by_any_name_and_back_and_forward(page: Page) -> None:
    before = summary(page)
    field = page.get_by_label("Library star")
    field.fill("")
    field.press_sequentially("hd")
    page.get_by_text("HD 85512", exact=True).wait_for()
    page.get_by_text("HD 40307", exact=True).click()
    second = changed(page, before)
    enter(page, "Library star", "K3V")
    page.wait_for_function("location.search.includes('star=K3V')")
    assert summary(page) == second, "another name of the same star"
    page.get_by_text("Noise budget", exact=True).first.click()
    page.wait_for_function("location.search.includes('tab=noise')")
    for _ in range(2):
        page.go_back()
    page.wait_for_function("location.search.includes('star=HD') && location.search.includes('tab=observation')")
    field.wait_for()
    until(page, lambda: field.input_value() == "HD 40307")
    page.go_back()
    until(page, lambda: field.input_value() == "G2V" and summary(page) == before)
    for _ in range(3):
        page.go_forward()
    until(page, lambda: field.input_value() == "K3V" and summary(page) == second)
    assert "tab=noise" in page.url
    assert page.get_by_text("noise-budget (ecsv)").first.is_visible()


def until(page: Page, true: Any) -> None:
    for _ in range(PATIENCE // 50):
        if true():
            return
        page.wait_for_timeout(50)
    raise AssertionError("never true")


def test_a_copied_link_is_what_is_seen(browser: Browser, page: Page) -> None:
    summary(page)
    page.get_by_label("Realisations").select_option("10000")
    enter(page, "False-alarm probability per test", "0.05")
    page.wait_for_function("location.search.includes('fap=0.05')")
    enter(page, "Flare amplitude, %", "0.5")
    page.wait_for_function("location.search.includes('amplitude_percent=0.5')")
    page.get_by_text("Flare detection", exact=True).first.click()
    page.get_by_role("button", name="Simulate", exact=True).click()
    told = summary(page, SIMULATED)
    page.wait_for_function("location.search.includes('simulated=detection')")
    second = fresh(browser, page.url)
    assert summary(second, SIMULATED) == told, "the same numbers, without a word"
    second.get_by_text("Receiver operating").or_(second.locator("table")).first.wait_for()
    assert second.url == page.url
    second.close()


def test_a_link_is_text(browser: Browser, address: str) -> None:
    page = browser.new_page()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    evil = "%21%5Bx%5D(http://127.0.0.1:9/x.png)%3Cimg%20src=http://127.0.0.1:9/y.png%3E"
    page.goto(f"{address}?star={evil}&band={evil}&target={evil}&sky=target+and+time&{evil}=1&tab={evil}")
    page.get_by_text("![x](http://127.0.0.1:9/x.png)").first.wait_for(timeout=PATIENCE)
    answerless(page)
    page.wait_for_timeout(500)
    assert [url for url in asked if ":9/" in url.split("?")[0]] == []
    page.close()


def test_a_lost_connection_blocks_says_so_and_comes_back(browser: Browser, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def start() -> subprocess.Popen[bytes]:
        log = tmp_path / "log.txt"
        with log.open("w") as out:
            server = subprocess.Popen(
                [sys.executable, "-m", "mauvecl", "serve", "--port", str(port)], stdout=out, stderr=out
            )
        while "mauvecl serves at" not in log.read_text():
            assert server.poll() is None, log.read_text()
            time.sleep(0.1)
        return server

    server = start()
    try:
        page = fresh(browser, f"http://127.0.0.1:{port}/?magnitude=11")
        before = summary(page)
        server.kill()
        server.wait()
        page.get_by_text("The connection to the server is lost").wait_for()
        assert page.evaluate("[...document.body.children].every(e => e.inert || e.id === 'mauvecl-lost')")
        server = start()
        page.get_by_text("The connection to the server is lost").wait_for(state="detached")
        assert summary(page) == before
        assert page.get_by_label("Magnitude of the star").input_value() == "11"
        page.close()
    finally:
        server.kill()
        server.wait()
