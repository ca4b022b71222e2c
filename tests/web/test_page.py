"""Journeys of visitors through the page in a real Chromium, and five tasks of newcomers with the clicks they take."""

from __future__ import annotations

import io
import re
import time
import zipfile
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from astropy.table import QTable

from mauvecl import __version__
from tests.web.test_files import light_curve, standards, star_file, zipped
from tests.web.visits import PATIENCE, Server, enter, fresh, settled, until

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, Locator, Page

pytestmark = pytest.mark.long


def shown(page: Page) -> str:
    """Return the answer in the words of the card: a sentence, and both chances."""
    settled(page)
    return "\n".join(page.locator("#card :is(.message, .words)").all_inner_texts())


def answerless(page: Page) -> None:
    """Check that the page shows no answer, button or picture."""
    page.get_by_text("No answer.", exact=True).wait_for()
    for name in ("Simulate", "Pin"):
        assert page.get_by_role("button", name=name, exact=True).is_disabled()
    assert page.locator(".pictures.dim").count() == page.locator(".pictures").count()
    assert all(button.is_disabled() for button in page.locator("[data-file]").all())


def tab(page: Page, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


def simulate(page: Page, name: str = "Simulate") -> str:
    page.get_by_role("button", name=name, exact=True).click()
    page.get_by_text("Done: ").wait_for()
    return shown(page)


def download(page: Page, label: str, within: str = "body") -> bytes:
    with page.expect_download() as coming:
        page.locator(within).get_by_role("button", name=label, exact=True).click()
    return Path(coming.value.path()).read_bytes()


@contextmanager
def exporting(page: Page) -> Iterator[Locator]:
    """Open the dialog of exports, and close it."""
    page.get_by_role("button", name="Share, export, cite", exact=True).click()
    page.locator("#export[open]").wait_for()
    yield page.locator("#export")
    page.keyboard.press("Escape")


def taken(page: Page) -> bytes:
    with exporting(page):
        return download(page, "Study for the command line")


def give(page: Page, field: str, content: bytes | str, name: str = "mine.txt") -> None:
    """Choose a file for a field."""
    content = content.encode() if isinstance(content, str) else content
    file: Any = {"name": name, "mimeType": "text/plain", "buffer": content}
    page.locator(f"[data-upload={field}]").set_input_files(file)


def says(page: Page, words: str) -> None:
    """Wait until the answer holds these words."""
    until(page, lambda: words in shown(page))


def ranges(page: Page, picture: str) -> list[float]:
    plot = f"page.pictures.all.{picture}.figure.plot"
    return list(page.evaluate(f"[{plot}.x_range, {plot}.y_range].flatMap(range => [range.start, range.end])"))


def settled_ranges(page: Page, picture: str) -> list[float]:
    """Return the ends of a picture's axes once it is drawn."""
    until(page, lambda: page.evaluate(f"page.pictures.all.{picture}.figure?.view?.has_finished() ?? false"))
    return ranges(page, picture)


def places(page: Page) -> list[float]:
    return [
        page.evaluate(f"document.getElementById('f-{name}').getBoundingClientRect().y")
        for name in ("magnitude", "amplitude_percent", "exposure_s")
    ]


def script(name: str) -> str:
    return (Path(__file__).parent / "scripts" / f"{name}.js").read_text(encoding="utf-8")


def tabs_of(page: Page) -> list[str]:
    return [str(one.get_attribute("id")).removeprefix("tab-") for one in page.get_by_role("tab").all()]


def centre(page: Page, picture: str, x: float, y: float) -> tuple[float, float]:
    """Scroll to a picture, and return a point of it by parts of its width and height."""
    plot = page.locator(f"#plot-{picture}")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def afresh(page: Page) -> None:
    page.get_by_role("button", name="Start afresh").click()
    settled(page)


def test_visitor_changes_values_and_reads_the_answer(browser: Browser, server: Server) -> None:
    """Without scrolling: by typing and sliders, with values that are refused; nothing jumps."""
    page = fresh(browser, server.address, viewport={"width": 1280, "height": 800})
    assert page.get_by_text("not a flight calibration").count() == 1, "stated once"
    assert page.get_by_label("Exposure, slider").get_attribute("aria-valuetext") == "50 s"
    assert page.get_by_label("Magnitude, slider").get_attribute("aria-valuetext") == "V = 8.5"
    temperature = page.get_by_label("Detector temperature", exact=True)
    assert temperature.input_value() == ""
    assert temperature.get_attribute("placeholder") == "21, or along the orbit in plans"
    # A 2 % flare on a G2V star of V = 7.4 in 50 s.
    enter(page, "Magnitude", "7.4")
    reported = shown(page)
    assert page.locator("#chance").inner_text() == "78.0 %"
    assert "Mauve would see a flare of 2 % on G2V V = 7.4 in 50 s with a chance of 78.0 % (" in reported
    assert reported.splitlines()[0].endswith(
        "if everything but the noise were known), by the estimate before a simulation."
    )
    for found in ("#f-star", "#f-magnitude", "#f-amplitude_percent", "#f-exposure_s", "#chance", "#facts", "#simulate",
                  "#plot-excess", "#plot-distributions"):  # fmt: skip
        box = page.locator(found).bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 1280, found
        assert box["y"] + box["height"] <= 800, found
    left = {round(page.locator(f"#f-{name}").bounding_box()["x"]) for name in ("star", "magnitude", "exposure_s")}  # type: ignore[index]
    assert len(left) == 1, "one left edge"
    assert page.evaluate("scrollY") == 0
    # A value that is refused removes the answer, and the right one brings it back.
    enter(page, "Magnitude", "8.5")
    before = shown(page)
    page.locator("#plot-excess .bk-Figure").wait_for()
    place = "document.querySelector('#plot-excess').getBoundingClientRect().y + scrollY"
    top = page.evaluate(place)
    for label, wrong, right, reported in (
        ("Magnitude", "99", "8.5", "'99' is out of range: enter a number between -30 and 40 mag"),
        ("Magnitude", "7,4", "8.5", "'7,4' is not a number"),
        ("Seed", "", "1", "nothing is entered; a whole number"),
        ("Star", "Nowhere", "G2V", "'Nowhere' is unknown"),
    ):
        enter(page, label, wrong)
        answerless(page)
        assert page.title() == "No answer: mauvecl", "the browser's tab tells no answer either"
        assert page.evaluate(place) == top, "nothing jumps"
        field = page.get_by_label(label, exact=True)
        assert field.input_value() == wrong, "what was entered stays there"
        assert field.get_attribute("aria-invalid") == "true"
        assert reported in page.locator(f"#{field.get_attribute('aria-describedby')}").inner_text(), "at its field"
        enter(page, label, right)
        assert shown(page) == before
        assert page.get_by_text(reported).count() == 0
    before = places(page)
    for label, text in (("Magnitude", "abc"), ("Magnitude", "8.5"), ("Star", "AU Mic"), ("Star", "x")):
        field = page.get_by_label(label, exact=True)
        field.fill(text)
        settled(page)
        assert (field.get_attribute("aria-invalid") == "true") == (text in ("abc", "x"))
        assert places(page) == pytest.approx(before, abs=1), text
    enter(page, "Star", "G2V")
    # Values that cannot be together mark their field, and choices follow from others.
    enter(page, "Kind of answer", "realistic")
    enter(page, "Detection statistic", "paper")
    assert page.get_by_label("Detection statistic", exact=True).get_attribute("aria-invalid") == "true"
    assert "cannot be marginalised" in page.locator("#words-of").inner_text()
    enter(page, "Detection statistic", "matched")
    assert "Mauve would see" in shown(page)
    enter(page, "Kind of answer", "ideal")
    enter(page, "Realisations", "1000000")
    enter(page, "False-alarm probability", "1e-6")
    field = page.get_by_label("Realisations", exact=True)
    offered = [o.get_attribute("value") for o in field.locator("option:not([disabled])").all()]
    assert offered == ["100000 sampled", "1000000 sampled"]
    assert field.input_value() == "100000 sampled"
    assert "No answer" not in shown(page)
    assert "fap=1e-6" in page.url
    assert "1,000,000 are too few" in page.locator("#n-realisations").inner_text()
    enter(page, "False-alarm probability", "0.001")
    assert field.input_value() == "1000000", "what was chosen comes back"
    assert page.locator("#n-realisations").inner_text() == ""
    before = shown(page)
    field = page.get_by_label("Magnitude", exact=True)
    field.focus()
    field.press("End")
    field.press("Backspace")
    field.press_sequentially("2")
    says(page, "V = 8.2")
    assert shown(page) != before
    assert "magnitude=8.2" in page.url
    field.press("ArrowUp")
    says(page, "V = 8.3")
    page.get_by_label("Exposure, slider").focus()
    page.keyboard.press("ArrowRight")
    says(page, "in 55 s")
    page.get_by_label("Flare amplitude, slider").focus()
    page.keyboard.press("ArrowRight")
    until(page, lambda: "a flare of 2 %" not in shown(page))
    assert page.get_by_label("Flare amplitude", exact=True).input_value() == "2.5"
    page.get_by_label("Begin with").select_option("M dwarf")
    until(page, lambda: page.get_by_label("Star", exact=True).input_value() == "GJ 581" and "GJ 581" in shown(page))
    enter(page, "Magnitude", "-1")
    notice = page.get_by_text(re.compile(r"SATURATED: 952 of 1643 pixels")).first
    notice.wait_for()
    before = page.locator("#notices .danger").count()
    page.get_by_role("button", name=re.compile("Put away: SATURATED")).first.click()
    assert page.locator("#notices .danger").count() == before - 1
    enter(page, "Sky", "target and time")
    page.get_by_label("Sky target", exact=True).fill("180.0 0.0")
    page.get_by_label("Time, UTC", exact=True).fill("2026-09-23T00:00")
    for place in ("#w-target", "#words-of"):
        page.locator(place, has_text=re.compile(r"the Sun is \d+\.\d deg from the target")).wait_for()
    answerless(page)
    page.context.close()


def test_visitor_looks_for_a_star_and_goes_back(page: Page) -> None:
    before = shown(page)
    field = page.get_by_label("Star", exact=True)
    field.click()
    field.press_sequentially("hd")
    page.get_by_role("option", name="HD 85512", exact=True).wait_for()
    field.press("ArrowDown")
    field.press("Enter")
    says(page, "on HD 40307 V")
    second = shown(page)
    enter(page, "Star", "K3V")
    until(page, lambda: "star=K3V" in page.url)
    assert shown(page) == second.replace("HD 40307", "K3V"), "another name of the same star"
    tab(page, "Noise")
    until(page, lambda: "tab=noise" in page.url)
    page.go_back()
    page.go_back()
    until(page, lambda: "star=HD+40307" in page.url and "tab=detection" in page.url)
    until(page, lambda: field.input_value() == "HD 40307" and shown(page) == second)
    while "star=HD" in page.url or "star=h" in page.url:
        page.go_back()
    until(page, lambda: field.input_value() == "G2V" and shown(page) == before)
    while "tab=noise" not in page.url:
        page.go_forward()
    until(page, lambda: field.input_value() == "K3V" and shown(page) == second.replace("HD 40307", "K3V"))
    assert page.get_by_role("tab", name="Noise", exact=True).get_attribute("aria-selected") == "true"
    assert page.locator("#panel-noise").is_visible()
    afresh(page)
    enter(page, "Star", "gj 581")
    says(page, "V = 10.57")
    assert page.locator("#k-star").inner_text() == "M3V, 6.215 pc, V = 10.57; Hipparcos"
    page.go_back()
    says(page, "on G2V V = 8.5")
    enter(page, "Star", "AU Mic")
    says(page, "AU Mic V = 8.81")
    # A magnitude that the user entered stays.
    enter(page, "Magnitude", "9")
    says(page, "V = 9 in")
    # The name is confirmed after the answer to the typed text has come, or while the server still computes it.
    for answered in (True, False):
        page.goto(page.url.partition("?")[0])
        settled(page)
        if not answered:
            # Every message of the server comes late.
            page.evaluate("""() => { const come = page.live.come.bind(page.live)
                page.live.come = data => setTimeout(() => come(data), 1500) }""")
        field = page.get_by_label("Star", exact=True)
        field.fill("gj 581")
        if answered:
            until(page, lambda: "gj 581" in page.locator("#words-of").inner_text())
            settled(page)
        field.press("Enter")
        says(page, "V = 10.57")
        assert page.get_by_label("Magnitude", exact=True).input_value() == "10.57"
        # Name and magnitude are one step of the history.
        page.go_back()
        says(page, "on G2V V = 8.5")


def test_visitor_studies_and_keeps_pictures(page: Page) -> None:
    """Legends, tooltips, zoom, tables, both axes, files, and a click that sets the question."""
    # A picture is one named stop of the keyboard.
    settled_ranges(page, "excess")
    stops = """box => { const found = []; const walk = node => { for (const e of node.children) {
        if (e.tabIndex >= 0) found.push(e.className); if (e.shadowRoot) walk(e.shadowRoot); walk(e) } };
        walk(box); return found }"""
    box = page.locator("#plot-excess")
    assert box.evaluate(stops) == []
    assert box.evaluate("e => e.tabIndex") == 0
    assert page.get_by_role("img", name="Flare minus quiet, in sigma of the noise").count() == 1
    page.locator("#figure-excess .legend li:visible", has_text="drawn exposure").wait_for()
    before = settled_ranges(page, "excess")

    def point() -> tuple[float, float]:
        x, y = centre(page, "excess", 0.4, 0.3)
        page.mouse.move(x, y)
        return x, y

    def inside() -> None:
        until(page, lambda: ranges(page, "excess") != before)
        low, high, bottom, top = ranges(page, "excess")
        assert before[0] <= low < high <= before[1]
        assert high - low < before[1] - before[0]
        assert top - bottom < before[3] - before[2], "both axes"

    def back() -> None:
        until(page, lambda: ranges(page, "excess") == before)

    x, y = point()
    page.mouse.down()
    page.mouse.move(x + 60, y + 60, steps=4)
    page.mouse.up()
    inside()
    page.locator("#figure-excess").get_by_role("button", name="Reset zoom").click()
    back()
    page.evaluate("document.activeElement.blur()")
    point()
    top = page.evaluate("scrollY")
    page.mouse.wheel(0, -200)
    until(page, lambda: page.evaluate("scrollY") < top)
    page.wait_for_timeout(300)
    assert ranges(page, "excess") == before, "the wheel alone scrolls"
    point()
    page.keyboard.down("Control")
    page.mouse.wheel(0, -200)
    page.keyboard.up("Control")
    inside()
    box.focus()
    page.keyboard.press("0")
    back()
    point()
    page.mouse.wheel(0, -200)
    inside()
    page.keyboard.press("0")
    back()
    page.keyboard.press("+")
    inside()
    settled_ranges(page, "roc")
    frame = page.locator("#figure-roc")
    frame.get_by_text("Data as a table").click()
    table = frame.locator("table", has_text="closed form")
    assert table.locator("caption").inner_text() == "closed form: 50 of 120 rows"
    assert table.locator("th").all_inner_texts() == ["false-alarm probability per test", "detection probability"]
    first = [float(text) for text in table.locator("tr").nth(1).locator("td").all_inner_texts()]
    assert first[0] == 1e-6
    assert 0 < first[1] < 0.2
    enter(page, "Magnitude", "7")
    until(page, lambda: float(table.locator("tr").nth(1).locator("td").nth(1).inner_text()) > first[1] + 0.3)
    enter(page, "Flare amplitude", "1.9")
    page.locator("#figure-excess .legend li:visible", has_text="drawn exposure").wait_for()
    # A legend keeps its lines when an entry appears, at every width.
    there = page.evaluate(script("heights"), False)
    assert len(set(there)) > 2, "the widths wrap it differently"
    assert page.evaluate(script("heights"), True) == there
    tab(page, "Spectrum")
    page.locator("#figure-recorded .legend li:visible", has_text="drawn exposure").wait_for()
    for name in ("dark", "bias"):
        assert not page.locator("#figure-recorded .legend li", has_text=name).last.is_visible(), "until it is asked for"
    page.locator("#figure-recorded").get_by_role("checkbox", name="Bias and dark").check()
    page.locator("#figure-recorded .legend li:visible", has_text="bias").wait_for()
    dark = page.evaluate("document.documentElement.dataset.theme")
    page.locator("#theme").click()
    page.locator("#theme").click()
    assert page.evaluate("document.documentElement.dataset.theme") != dark
    page.locator("#figure-recorded").get_by_label("log y").check()
    ends = "page.pictures.all.%s.figure?.models.get('wavelength')"
    until(page, lambda: page.evaluate(f"Boolean({ends % 'recorded'})"))
    page.evaluate(f"{ends % 'recorded'}.setv({{start: 250, end: 300}})")
    until(page, lambda: page.evaluate(f"{ends % 'telescope'}.end") == 300)
    enter(page, "Magnitude", "9")
    assert page.evaluate(f"{ends % 'recorded'}.end") == 300, "the axis stays where the visitor has put it"
    for ending, first in (("SVG", b"<svg"), ("PNG", b"\x89PNG")):
        assert download(page, ending, "#figure-telescope").startswith(first)
    settled_ranges(page, "recorded")
    names = page.evaluate("page.pictures.all.recorded.figure.plot.renderers.map(one => one.name)")
    assert names.index("drawn exposure") < names.index("star") < names.index("star with flare")
    tab(page, "Limit and map")
    page.locator("#text-map", has_text="At least half").wait_for()
    before = shown(page)
    settled_ranges(page, "map")
    page.mouse.click(*centre(page, "map", 0.5, 0.4))
    until(page, lambda: "magnitude=8.5" not in page.url and "magnitude" in page.url)
    assert shown(page) != before
    entered = float(page.get_by_label("Magnitude", exact=True).input_value())
    own = "page.pictures.all.map.figure.models.get('own').data.x[0]"
    until(page, lambda: abs(page.evaluate(own) - entered) < 1e-3)


def test_visitor_in_the_dark_keeps_pictures_on_white(browser: Browser, server: Server) -> None:
    """At least 1600 pixels, with title, legend, and what was asked, whatever the page's colours are."""
    from PIL import Image

    page = fresh(browser, f"{server.address}?magnitude=8&statistic=chi2", color_scheme="dark")
    for theme in ("dark", "light"):
        for picture, curve in (("excess", "expected per element of 10.5 nm"), ("distributions", "no flare")):
            settled_ranges(page, picture)
            tip = page.locator(".bk-Tooltip", has_text=curve)
            for k in range(200):
                x, y = centre(page, picture, 0.4, 0.4)
                page.mouse.move(x + k % 5, y)
                if tip.is_visible():
                    break
                page.wait_for_timeout(20)
            colours = "e => [getComputedStyle(e).color, getComputedStyle(e).backgroundColor]"
            assert tip.evaluate(colours) == page.locator("#asked").evaluate(colours), f"those of the {theme} page"
        page.mouse.move(1, 1)
        if theme == "dark":
            svg, png, pdf = (download(page, ending, "#figure-distributions") for ending in ("SVG", "PNG", "PDF"))
            asked = ("V = 8", "Detection statistic: chi2", f"mauvecl {__version__}")
            for part in ("The statistic without and with the flare", "no flare", "threshold", *asked):
                assert part in svg.decode(), part
            with Image.open(io.BytesIO(png)) as image:
                assert image.width >= 1600
                assert image.convert("RGB").getpixel((2, 2)) == (255, 255, 255)
                dark = np.mean(np.asarray(image.convert("L"))[image.height // 3 : -image.height // 3] < 100)
            assert dark < 0.1, "dark on light"
            assert b"A click" not in download(page, "SVG", "#figure-roc"), "what the page offers is not on paper"
            assert pdf.startswith(b"%PDF-")
            table = pdf[int(pdf.split(b"startxref\n")[1].split()[0]) :].split(b"\n")
            assert table[0] == b"xref"
            for n in range(1, 6):
                assert pdf[int(table[n + 2].split()[0]) :].startswith(b"%d 0 obj" % n)
            page.emulate_media(color_scheme="light")
            page.reload()
            settled(page)
    page.context.close()


def test_visitor_simulates_shares_and_compares(browser: Browser, page: Page, server: Server) -> None:
    """A link opened again shows the same; pinned scenarios are compared; `test_files.py` compares numbers."""
    enter(page, "False-alarm probability", "0.05")
    enter(page, "Realisations", "10000")
    enter(page, "Flare amplitude", "1.5")
    place = page.locator("#plot-excess").bounding_box()
    reported = simulate(page)
    assert page.locator("#plot-excess").bounding_box() == place, "nothing jumps"
    assert "of 10,000 simulated" in reported
    rows = QTable.read(io.BytesIO(download(page, "detection (ecsv)")), format="ascii.ecsv")
    (row,) = (row for row in rows if row["statistic"] == "matched")
    assert reported.startswith("Mauve would see a flare of 1.5 % on G2V V = 8.5 in 50 s with a chance of "), (
        "the answer"
    )
    assert reported.count(f"{100 * row['probability']:.1f} %") >= 2, "in the sentence and in the number"
    # The link is opened again.
    until(page, lambda: "simulated=detection" in page.url)
    second = fresh(browser, page.url)
    until(second, lambda: shown(second) == reported)
    assert second.url == page.url
    assert second.get_by_label("Realisations", exact=True).input_value() == "10000"
    second.context.close()
    tab(page, "Compare")
    page.get_by_role("button", name="Open run 1").wait_for()
    tab(page, "Limit and map")
    simulate(page, "Simulate the map")
    page.get_by_text("64 cells are simulated").wait_for()
    assert b"\n[map.x]\n" in download(page, "map (study)")
    tab(page, "Detection")
    with exporting(page):
        page.get_by_text("mauvecl detect --star G2V --magnitude 8.5").wait_for()
        assert "Study.build(" in page.locator("#as-python").inner_text()
    afresh(page)
    first = page.locator("#chance").inner_text()
    page.get_by_role("button", name="Pin", exact=True).click()
    enter(page, "Magnitude", "8")
    page.get_by_role("button", name="Pin", exact=True).click()
    second = page.locator("#chance").inner_text()
    tab(page, "Compare")
    row = page.locator("#pinned tr", has_text="Detected").inner_text().split()
    assert {first.split()[0], second.split()[0]} <= {*row}
    page.reload()
    settled(page)
    page.get_by_role("button", name="Open scenario 1").click()
    until(page, lambda: page.locator("#chance").inner_text() == first)
    # In the pictures, too: in their own colours, which are those of the table and the key.
    strokes = "paths => paths.map(path => path.getAttribute('stroke'))"
    colours = page.locator("#pinned .swatch path").evaluate_all(strokes)
    assert len(set(colours)) == 2
    for name, picture in (("Detection", "excess"), ("S/N", "snr"), ("Limit and map", "map")):
        tab(page, name)
        models = f"page.pictures.all.{picture}.figure?.models"
        filled = f"[0, 1, 2].map(k => Object.values({models}?.get(`pin ${{k}}`).data ?? {{}})[0]?.length > 0)"
        until(page, partial(lambda script: page.evaluate(script) == [True, True, False], filled))
        lines = f"page.pictures.all.{picture}.figure.plot.renderers.filter(r => r.name?.startsWith('pinned'))"
        drawn = page.evaluate(f"{lines}.map(r => r.glyph.line_color.value)")
        assert [colour for colour in drawn if colour != "#ffffff"][:2] == colours
        key = page.locator(f"#panel-{page.evaluate('page.routing.seen.tab')} .pins")
        assert key.locator("path").evaluate_all(strokes) == colours
        assert "2: G2V, V = 8, 2 %, 50 s" in key.inner_text()
    # What is left keeps its colour.
    tab(page, "Compare")
    page.get_by_role("button", name="Remove scenario 1").click()
    assert page.locator("#pinned .swatch path").get_attribute("stroke") == colours[1]
    tab(page, "Detection")
    afresh(page)
    settled(page)
    assert page.evaluate(
        """() => {
          const field = document.getElementById("f-magnitude"), button = document.getElementById("simulate")
          field.value = "6.5"
          field.dispatchEvent(new Event("input", {bubbles: true}))
          button.focus()
          button.click()
          return [button.ariaDisabled, document.activeElement === button]
        }"""
    ) == ["true", True]
    page.get_by_text("Done").first.wait_for()
    tab(page, "Plan")
    page.locator('#panel-plan [data-simulate="plan"]').dispatch_event("click")
    page.locator("#panel-plan").get_by_text("a field that it needs is empty").wait_for()
    tab(page, "Detection")
    afresh(page)
    # A simulation is cancelled while others are served.
    enter(page, "Realisations", "4000000")
    page.get_by_role("button", name="Simulate", exact=True).click()
    page.get_by_text(re.compile(r"of 8,000,000 realisations, about .* s left")).wait_for()
    second = fresh(browser, f"{server.address}?fap=0.05&realisations=10000")
    enter(second, "Magnitude", "12")
    assert "V = 12" in shown(second)
    assert "of 10,000 simulated" in simulate(second)
    second.context.close()
    assert page.get_by_label("Magnitude", exact=True).input_value() == "8.5"
    started = time.monotonic()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_text("Cancelled.").wait_for()
    assert time.monotonic() - started < 10, "a tile, not the rest"
    assert "in closed form" in shown(page)


def test_visitor_uploads_spectra(browser: Browser, page: Page, tmp_path: Path) -> None:
    """Good and bad ones, by choice and by dropping; units are advised where they are needed; a reload keeps files."""
    before = shown(page)
    star = page.get_by_label("Star", exact=True)
    give(page, "star", "200 1e-12\n300 <script>alert(1)</script>\n")
    page.locator("#w-star", has_text=re.compile(r"line 2: .* is not numeric")).wait_for()
    answerless(page)
    assert star.input_value() == "", "no star's name next to another star's file"
    give(page, "star", star_file())
    until(page, lambda: star.input_value() == "uploaded star")
    says(page, "on uploaded star V")
    assert shown(page) != before
    large = tmp_path / "large.txt"
    for size in (4.2, 200):
        with large.open("wb") as file:
            file.truncate(int(size * 2**20))
        page.locator("[data-upload=star]").set_input_files(large)
        page.locator("#w-star", has_text=f"the upload has {size:.1f} MiB, but may have at most 4 MiB").wait_for()
        answerless(page)
    enter(page, "Star", "K5V")
    assert "K5V" in shown(page)
    give(page, "star", star_file())
    until(page, lambda: "star=uploaded" in page.url and "on uploaded star V" in shown(page))
    give(page, "own_unknown", "200 1\n450 3\n700 1\n")
    until(page, lambda: page.locator("#f-own_unknown").input_value() == "uploaded spectrum")
    says(page, "on uploaded star V")
    with zipfile.ZipFile(io.BytesIO(taken(page))) as archive:
        archive.extractall(tmp_path / "study")
    assert 'file = "star.ecsv"' in (tmp_path / "study" / "study.toml").read_text()
    assert "points" in (tmp_path / "study" / "study.toml").read_text()
    afresh(page)
    text = "\n".join(f"{nm} 1e-12" for nm in range(170, 1001))
    page.evaluate(
        """text => { const held = new DataTransfer()
        held.items.add(new File([text], "dropped star.txt"))
        const how = {dataTransfer: held, bubbles: true, cancelable: true}
        document.querySelector('[data-field=star]').dispatchEvent(new DragEvent("drop", how)) }""",
        text,
    )
    page.locator("[data-uploaded=star]", has_text="dropped star.txt").wait_for()
    says(page, "on uploaded star V")
    with exporting(page):
        page.get_by_text("The link does not hold your file").wait_for()
    enter(page, "Star", "Vega")
    with exporting(page):
        assert not page.get_by_text("The link does not hold your file").is_visible()
    afresh(page)
    tab(page, "Change")
    enter(page, "Changes", "Mg II")
    text = "\n".join(f"{angstrom} 1e-12" for angstrom in range(1700, 10001, 10))
    give(page, "change_file", text, "companion.txt")
    page.locator("#w-change_file", has_text="Added: unit of wavelengths Angstrom").wait_for()
    page.get_by_role("button", name="Added: unit of wavelengths: Angstrom", exact=True).click()
    until(page, lambda: "change_file=uploaded" in page.url)
    assert page.get_by_label("Added: unit of wavelengths", exact=True).input_value() == "Angstrom"
    assert page.locator("[data-uploaded=change_file]").inner_text() == "companion.txt"
    enter(page, "Band of the added light", "B")
    simulate(page, "Change")
    page.locator("#panel-change .rows", has_text="spectrum").wait_for()
    with exporting(page):
        page.get_by_text("--change-file added.ecsv --change-band B").wait_for()
    page.locator("[data-remove=change_file]").click()
    page.get_by_label("Band of the added light", exact=True).wait_for(state="hidden")
    until(page, lambda: "change_file" not in page.url)
    assert "change_band=B" not in page.url
    settled(page)
    tab(page, "Detection")
    afresh(page)
    unit = page.get_by_label("Unit of wavelengths", exact=True)
    assert not unit.is_visible()
    short = "\n".join(f"{angstrom} 1e-12" for angstrom in range(3300, 7501, 10))
    give(page, "star", short, "angstrom.txt")
    page.get_by_text("look like Angstrom").first.wait_for()
    answerless(page)
    # What the message advises is one click away, and the field that it names stands below the file.
    assert unit.is_visible()
    page.get_by_role("button", name="Unit of wavelengths: Angstrom", exact=True).click()
    page.get_by_text("“Continue with” continues it by a library spectrum").first.wait_for()
    assert unit.input_value() == "Angstrom"
    enter(page, "Continue with", "M3V")
    says(page, "on uploaded star V")
    continued, address = shown(page), page.url
    assert page.get_by_text("below 330 nm it is continued by M3V").count() == 1
    page.reload()
    says(page, "on uploaded star V")
    assert shown(page) == continued
    assert page.locator("[data-uploaded=star]").inner_text() == "angstrom.txt"
    # Another visitor has not got the file, nor has another tab of this browser.
    for context in (page.context, browser.new_context()):
        other = context.new_page()
        other.goto(address)
        other.get_by_text("give its file again, since links do not hold it").first.wait_for()
        other.close()
    # An archive after a refused one.
    tab(page, "Calibrate")
    give(page, "observations", zipped({"../a.csv": b"1"}))
    page.locator("#panel-calibrate").get_by_text("the archive holds a file named '../a.csv'").wait_for()
    give(page, "observations", zipped(standards()), "standards.zip")
    page.locator('[data-simulate="calibrate"]').click()
    # Seen, although the refusal hid the notes.
    page.get_by_text("notes on this answer").wait_for()
    assert page.locator('[data-file="instrument.zip"]').is_enabled()


@pytest.mark.parametrize("width", [390, 640, 1440])
def test_visitor_finds_reasons_and_targets_at_any_width(browser: Browser, server: Server, width: int) -> None:
    """No tab scrolls sideways, what is pressed has 24 pixels, and why a file is refused stays at its field alone.

    Of every field that takes a file: a file that is larger than accepted, which is made small here; and of each with a
    unit, wavelengths that look like Angstrom. Of the star: a spectrum that ends within the payload's range.
    """
    page = fresh(browser, server.address, viewport={"width": width, "height": 900})
    if width < 900:
        card, asked = page.locator("#numbers").bounding_box(), page.locator("#asked").bounding_box()
        assert card["y"] < asked["y"], "the answer first"
        assert not page.get_by_label("Magnitude", exact=True).is_visible(), "folded"
        page.get_by_text("Change the question").click()
    page.get_by_text("Advanced", exact=True).click()
    angstrom = "\n".join(f"{wavelength} 1e-12" for wavelength in range(3000, 7001, 10)).encode()

    def refuse(name: str, content: bytes, reason: str) -> None:
        give(page, name, content)
        page.locator(f"#w-{name}:visible", has_text=reason).wait_for()
        # Messages at typed fields are seen while the field has the focus.
        page.locator(f"[data-choose={name}]").focus()
        assert page.evaluate(script("covered")) == [], name

    seen = set()
    for tab_name in tabs_of(page):
        page.locator(f"#tab-{tab_name}").click()
        settled(page)
        assert page.evaluate(script("targets")) == [], tab_name
        assert page.evaluate("document.documentElement.scrollWidth") <= width, tab_name
        reads = page.evaluate("page.tab.reads")
        uploads = page.evaluate("Object.entries(page.uploads.words.uploads)")
        for name, upload in uploads:
            if name not in reads or name in seen:
                continue
            seen.add(name)
            most = "page.uploads.words.uploads[name].most"
            page.evaluate(f"name => {most} = 10", name)
            refuse(name, bytes(11), "may have at most")
            page.evaluate(f"([name, bytes]) => {most} = bytes", [name, upload["most"]])
            if any(option.endswith("wavelength_unit") for option in upload["options"]):
                refuse(name, angstrom, "look like Angstrom")
            if name == "star":
                page.get_by_role("button", name="Unit of wavelengths: Angstrom", exact=True).click()
                page.locator("#w-extend", has_text="Continue with").wait_for()
                assert page.evaluate(script("covered")) == []
            page.get_by_role("button", name="Start afresh").click()
            settled(page)
    assert len(seen) == len(uploads)
    page.context.close()


def test_visitor_with_a_phone(browser: Browser, server: Server) -> None:
    """Two fingers zoom, and flares of a plan are seen at once."""
    page = fresh(browser, server.address, viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    before = settled_ranges(page, "excess")
    x, y = centre(page, "excess", 0.5, 0.5)
    touch = page.context.new_cdp_session(page)
    for kind, apart in (("touchStart", 20), *(("touchMove", 20 + 8 * k) for k in range(1, 9)), ("touchEnd", 0)):
        points = [{"x": x + side * apart, "y": y, "id": (side + 1) // 2} for side in (-1, 1) if apart]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    until(page, lambda: ranges(page, "excess")[1] - ranges(page, "excess")[0] < before[1] - before[0])
    assert page.evaluate("visualViewport.scale") == 1, "the picture, not the page"
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.context.close()
    page = fresh(browser, server.address, viewport={"width": 390, "height": 844})
    assert page.get_by_role("button", name="Share, export, cite").is_visible(), "outside of what is folded"
    tab(page, "Plan")
    settled(page)
    page.get_by_role("button", name="Three flare stars").click()
    page.evaluate(script("written"))
    simulate(page, "Plan")
    table = page.get_by_role("region", name="Table of Plan")
    until(page, lambda: "·" not in table.inner_text())
    box, flares = table.bounding_box(), table.get_by_role("columnheader", name="flares", exact=True).bounding_box()
    assert flares["x"] + flares["width"] <= box["x"] + box["width"]
    for wide in (table, page.get_by_role("region", name="Table of targets")):
        assert wide.evaluate("e => e.scrollWidth > e.clientWidth && e.tabIndex === 0")
        assert "gradient" in wide.evaluate("e => getComputedStyle(e).backgroundImage"), "a shadow at the edge"
    settled_ranges(page, "recovered")
    settled_ranges(page, "expected")
    # Decades are a base and its exponent.
    written = page.evaluate("written")
    energies = [
        (exponent, left, right)
        for (base, left, _), (exponent, _, right) in pairwise(written)
        if base == "10" and exponent in map(str, range(28, 38))
    ]
    starts = [k for k, (exponent, *_) in enumerate(energies) if exponent == "28"]
    assert len(energies) > len(starts) > 0
    for (first, _, right), (second, left, _) in pairwise(energies):
        assert left > right or second == "28", (first, second)
    page.get_by_label("First day", exact=True).fill("2026-11-01")
    settled(page)
    assert page.get_by_role("status").inner_text() == "", "nothing is done of another plan"
    page.context.close()


def test_visitor_with_a_keyboard(page: Page) -> None:
    """Tabs stand in groups and turn round, slider and help stand where they belong; newcomers do the rest by keys."""
    headings = page.locator("[role=tablist] > div > span").all_inner_texts()
    assert headings == ["Plan observations", "Simulate observations", "Analyse observations", "Tools"]
    for name, number in (("detection", 0), ("visibility", 0), ("snr", 1), ("calibrate", 2), ("compare", 3)):
        described = page.locator(f"#tab-{name}").get_attribute("aria-describedby")
        assert page.locator(f"#{described}").inner_text() == headings[number], name
    page.locator("#tab-detection").focus()
    for key, name in (("ArrowRight", "limit"), ("ArrowLeft", "detection"), ("ArrowLeft", "compare")):
        page.keyboard.press(key)
        assert page.evaluate("document.activeElement.id") == f"tab-{name}"
    page.keyboard.press("Home")
    settled(page)
    # The focus of a slider leaves its number free, and help stands next to its question mark.
    number, slider = page.locator("#f-amplitude_percent"), page.get_by_label("Flare amplitude, slider")
    number.focus()
    page.keyboard.press("Tab")
    frame = """e => { const style = getComputedStyle(e)
        return e.getBoundingClientRect().top - parseFloat(style.outlineWidth) - parseFloat(style.outlineOffset) }"""
    assert slider.evaluate("e => e.matches(':focus-visible')")
    assert slider.evaluate(frame) >= number.evaluate("e => e.getBoundingClientRect().bottom")
    button = page.get_by_role("button", name="What is Magnitude?")
    button.click()
    mark, message = button.bounding_box(), page.locator("#help-magnitude").bounding_box()
    assert abs(message["x"] - mark["x"]) < 60
    assert abs(message["y"] - mark["y"]) < 60
    page.keyboard.press("Escape")


def test_visitor_pastes_and_opens_targets(page: Page) -> None:
    tab(page, "Visibility")
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.get_by_label("Target of target 1").click()
    page.evaluate("navigator.clipboard.writeText('name\\tV\\nAU Mic\\t\\nmine\\t9.5')")
    page.keyboard.press("Control+v")
    until(page, lambda: page.get_by_label("V of target 2").input_value() == "9.5")
    page.locator("#w-targets", has_text="mine").wait_for()
    assert page.get_by_label("Target of target 2").get_attribute("aria-invalid") == "true"
    page.get_by_label("Coordinates (deg) of target 2").fill("53.2 -9.4")
    until(page, lambda: page.get_by_role("button", name="Find when").is_enabled())

    def give_targets(text: str) -> None:
        file: Any = {"name": "targets.csv", "mimeType": "text/csv", "buffer": text.encode()}
        page.locator("#targets-file").set_input_files(file)

    give_targets('name,ra,dec,mass_msun,age_myr\n"one, two",10,20,1.0,600\nAU Mic,,,,\n')
    until(page, lambda: page.get_by_label("age_myr of target 1").input_value() == "600")
    assert page.get_by_label("Target of target 1").input_value() == "one, two"
    until(page, lambda: page.get_by_role("button", name="Find when").is_enabled())
    # Names of columns as on the command line.
    give_targets("source_id,main_id,RAJ2000,DEJ2000,Vmag,SpType,Plx\n12,HD 1,10.5,-3,8,K5V,100\n")
    until(page, lambda: page.get_by_label("Target of target 1").input_value() == "12")
    cells = [page.get_by_label(f"{name} of target 1").input_value() for name in ("V", "Type")]
    assert cells == ["8", "K5V"]
    until(page, lambda: page.get_by_role("button", name="Find when").is_enabled())
    give_targets("name\none\nAU Mic\n")
    until(page, lambda: page.get_by_label("Target of target 2").input_value() == "AU Mic")
    page.get_by_role("button", name="Remove target 1", exact=True).click()
    assert page.get_by_label("Target of target 1").input_value() == "AU Mic"
    page.get_by_role("button", name="Remove all").click()
    assert page.get_by_role("button", name="Find when").is_disabled()


def test_visitor_analyses_an_example_and_own_columns(page: Page) -> None:
    """One click answers a light curve of Kepler; columns of a file that is not understood are chosen from menus."""
    tab(page, "Analyse")
    page.get_by_label("Quality bits", exact=True).fill("all")
    page.get_by_role("button", name="Try an example file").click()
    page.get_by_text("Done: ").wait_for()
    says(page, "flares are detected in 9.97 star-days of KIC 10002792")
    assert page.get_by_label("Quality bits", exact=True).input_value() == "", "that was entered on another file"
    assert "detected" in page.locator("#panel-analyse .rows").inner_text()
    afresh(page)
    tab(page, "Analyse")
    give(page, "frames", light_curve(flags=True), "mine.csv")
    menus = page.get_by_role("group", name="Which column is what?")
    menus.get_by_label("Time", exact=True).select_option("minute")
    flux = menus.get_by_label("Flux", exact=True)
    assert flux.locator("option").all_inner_texts() == ["choose", "minute", "rate", "sd", "flag"]
    flux.select_option("rate")
    until(page, lambda: "200 frames of" in page.locator("#text-frames").inner_text())
    menus.get_by_label("Unit of time").select_option("min")
    menus.get_by_label("Error", exact=True).select_option("sd")
    assert menus.is_visible(), "what was chosen can be chosen otherwise"
    simulate(page, "Analyse")
    says(page, "1 flare is detected")
    # What is chosen is a mapping, which the command line reads as well.
    with zipfile.ZipFile(io.BytesIO(taken(page))) as archive:
        mapping = archive.read("columns.toml").decode()
    assert mapping == 'time = "minute"\ntime_unit = "min"\nflux = "rate"\nerror = "sd"\n'


@pytest.mark.parametrize("theme", ["light", "dark", "forced"])
def test_visitor_with_a_screen_reader_or_other_colours_and_sizes(browser: Browser, server: Server, theme: str) -> None:
    """axe-core finds no violation of any impact on any tab, dialog or error.

    Twice the size in the browser's settings is twice the size on the page; four sizes are used.
    """
    axe = Path(pytest.importorskip("axe_playwright_python").__file__).parent / "axe.min.js"
    colours = {"forced_colors": "active"} if theme == "forced" else {"color_scheme": theme}
    page = fresh(browser, server.address, **colours)
    page.evaluate(axe.read_text())

    # The whole page once, then what a tab brings; of other themes only the colours are others.
    rules = "rules: {'target-size': {enabled: true}}" if theme == "light" else "runOnly: ['color-contrast']"

    def look(where: str, *parts: str) -> None:
        page.evaluate("window.scrollTo(0, 0)")
        context = {"include": [[part] for part in parts or ("html",)]}
        found = page.evaluate(f"at => axe.run(at, {{resultTypes: ['violations'], {rules}}})", context)["violations"]
        seen = [(one["id"], one["impact"], [node["html"][:200] for node in one["nodes"]][:3]) for one in found]
        assert not seen, (where, seen)

    if theme == "forced":
        ground = "name => getComputedStyle(document.getElementById(`tab-${name}`)).backgroundColor"
        grounds = [page.evaluate(ground, name) for name in tabs_of(page)]
        assert len(set(grounds)) == 2
        assert grounds.count(grounds[0]) == 1, "the first, which is selected"
    page.get_by_text("Advanced", exact=True).click()
    for name in tabs_of(page):
        page.locator(f"#tab-{name}").click()
        page.locator(f"#panel-{name}").wait_for()
        settled(page)
        page.wait_for_timeout(200)
        # The pointer is on the tab.
        look(name, f"#panel-{name}", f"#tab-{name}")
    look("page")
    if theme == "light":
        page.get_by_role("button", name="Pin", exact=True).click()
        look("pinned")
        page.get_by_role("button", name="About and citation").click()
        look("about")
        page.keyboard.press("Escape")
        page.get_by_role("button", name="What is Star?").click()
        look("meaning")
        page.keyboard.press("Escape")
        enter(page, "Magnitude", "-1")
        page.locator("#notices .danger").first.wait_for()
        look("notice")
        enter(page, "Magnitude", "x")
        look("fault")
        enter(page, "Magnitude", "8.5")
        sizes = """() => [...new Set([...document.querySelectorAll("body *")].filter(e => e.checkVisibility() &&
            [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim()))
            .map(e => parseFloat(getComputedStyle(e).fontSize).toFixed(2)))].sort()"""
        before = page.evaluate(sizes)
        assert len(before) <= 4, before
        page.add_style_tag(content="@media all { :root { font-size: 187.5% !important; } }")
        after = page.evaluate(sizes)
        # The chance grows with the window, up to its largest size.
        small = [float(one) for one in before][:3]
        assert [float(one) for one in after][:3] == pytest.approx([2 * one for one in small], rel=0.01)
        source = page.evaluate("fetch('assets/page.css').then(r => r.text())")
        assert not re.search(r"font(-size)?:[^;]*\dpx", source), "relative sizes only"
    page.context.close()


def test_visitor_with_a_hostile_link_or_without_scripts(browser: Browser, server: Server) -> None:
    """A link is escaped; the page loads nothing from elsewhere; without scripts it says so."""
    evil = "%21%5Bx%5D(http://127.0.0.1:9/x.png)%3Cimg%20src=http://127.0.0.1:9/y.png%3E"
    asked: list[str] = []
    page = browser.new_page()
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{server.address}?star={evil}&band={evil}&target={evil}&sky=target+and+time&{evil}=1&tab={evil}")
    page.get_by_text("which is no field here").first.wait_for(timeout=PATIENCE)
    page.get_by_text("![x](http://127.0.0.1:9/x.png)").first.wait_for(timeout=PATIENCE)
    answerless(page)
    page.wait_for_timeout(300)
    assert [url for url in asked if ":9/" in url.split("?")[0]] == []
    elsewhere = [url for url in asked if not url.startswith((server.address, "data:", "blob:"))]
    assert elsewhere == []
    page.close()
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(server.address)
    reported = page.locator(".noscript")
    assert reported.is_visible()
    assert "needs JavaScript" in reported.inner_text()
    context.close()


def test_visitor_loses_the_server_and_finds_it_again(browser: Browser, server: Server) -> None:
    page = fresh(browser, f"{server.address}?magnitude=9&fap=0.05&realisations=10000")
    give(page, "star", star_file())
    says(page, "on uploaded star V")
    before = simulate(page)
    server.kill()
    page.get_by_text("The connection to the server is lost").wait_for()
    assert page.evaluate("[...document.body.children].every(e => e.inert || e.id === 'lost')")
    server.start()
    page.get_by_text("The connection to the server is lost").wait_for(state="hidden")
    until(page, lambda: shown(page) == before)  # the upload too: the browser has kept it, and what was simulated
    assert page.get_by_label("Magnitude", exact=True).input_value() == "9"
    page.context.close()


#: Stops of the keyboard on the way to a control at most.
MOST_STOPS = 150


class Keys:
    """Visitor with the keyboard alone, who sees at each stop where he is; a choice counts as two clicks."""

    def __init__(self, page: Page) -> None:
        self.page, self.clicks = page, 0

    def reach(self, control: Locator) -> None:
        """Go from stop to stop until this one."""
        for _ in range(MOST_STOPS):
            if control.count() and control.evaluate("e => e === document.activeElement"):
                assert control.evaluate("e => getComputedStyle(e).outlineStyle") != "none"
                return
            self.page.keyboard.press("Tab")
        raise AssertionError(f"never at {control}")

    def press(self, control: Locator) -> None:
        self.reach(control)
        if control.evaluate("e => e.tagName") != "INPUT":
            self.page.keyboard.press("Enter")
        self.clicks += 1

    def choose(self, control: Locator, option: str) -> None:
        self.reach(control)
        self.page.keyboard.press(option[0])
        assert control.input_value() == option
        self.clicks += 2

    def turn(self, name: str) -> None:
        self.reach(self.page.locator("[role=tab][aria-selected=true]"))
        for _ in range(self.page.get_by_role("tab").count()):
            if self.page.evaluate("document.activeElement.textContent.trim()") == name:
                break
            self.page.keyboard.press("ArrowRight")
        assert self.page.locator("[role=tab][aria-selected=true]").inner_text().strip() == name
        self.clicks += 1

    def type(self, control: Locator, *lines: str) -> None:
        self.press(control)
        for line in lines:
            self.page.keyboard.type(line)
            self.page.keyboard.press("Enter")


def sentence(page: Page, part: str) -> str:
    """Return the limit in a sentence, once it has these words."""
    solved = page.locator("#solved", has_text=part)
    solved.wait_for()
    settled(page)
    return solved.inner_text()


def which_flares_on_an_m_dwarf(visitor: Keys) -> None:
    page = visitor.page
    visitor.type(page.get_by_label("Star", exact=True), "AU Mic")
    told = sentence(page, "at V = 8.81")
    assert told.startswith("90 % of flares of at least ")
    assert "if everything but the noise were known" in told
    assert visitor.clicks == 1


def limiting_magnitude(visitor: Keys) -> None:
    page = visitor.page
    visitor.choose(page.get_by_label("Solve for", exact=True), "magnitude")
    assert "to V = 8.40 if everything but the noise were known" in sentence(page, "to V = 7.26")
    assert visitor.clicks == 2


def own_spectrum_in_angstrom(visitor: Keys) -> None:
    """Upload the same spectrum in nm and in Angstrom, which give the same answer."""
    page = visitor.page
    nm, flux = np.loadtxt(star_file().decode().splitlines()).T
    shown = []
    for unit, scale in (("nm", 1.0), ("Angstrom", 10.0)):
        rows = "\n".join(f"{w:.6f},{f:.6e}" for w, f in zip(scale * nm, flux, strict=True))
        text = f"wavelength ({unit}),flux (erg/s/cm2/Angstrom)\n{rows}\n"
        with page.expect_file_chooser() as asked:
            visitor.press(page.get_by_role("button", name="Use your own spectrum"))
        asked.value.set_files({"name": f"{unit}.csv", "mimeType": "text/csv", "buffer": text.encode()})
        page.locator("[data-uploaded=star]", has_text=f"{unit}.csv").wait_for()
        until(page, lambda: "on uploaded star V" in page.locator("#words-of").inner_text())
        settled(page)
        shown.append(page.locator("#facts").inner_text())
    assert shown[0] == shown[1]
    assert visitor.clicks == 2, "one for each file"


def plan_of_three_targets(visitor: Keys) -> None:
    """Plan, and pin the plan, which survives a change of the star of other tabs and is found again."""
    page = visitor.page
    visitor.turn("Plan")
    page.wait_for_url("**tab=plan**")
    assert not page.locator("#numbers").is_visible(), "no chance of another star"
    assert not page.get_by_label("Magnitude", exact=True).is_visible()
    page.locator("#panel-plan .rows", has_text="best months").wait_for()
    visitor.type(page.get_by_label("Target of target 1"), "AU Mic", "eps Eri", "YZ CMi")
    until(page, lambda: page.get_by_label("V of target 3").get_attribute("placeholder") == "11.19")
    visitor.press(page.get_by_role("button", name="Plan", exact=True))
    page.locator("#panel-plan").get_by_text("Done: 3 of 3 targets").wait_for()
    table = page.locator("#panel-plan .rows")
    names = ("AU Mic", "eps Eri", "YZ CMi", "best months", "false alarms")
    until(page, lambda: all(name in table.inner_text() for name in names))
    assert visitor.clicks == 3
    page.locator("#figure-recovered .legend", has_text="YZ CMi").wait_for()
    planned = table.inner_text()
    assert page.locator("#words-of").inner_text().startswith("Mauve would recover ")
    page.get_by_role("button", name="Pin", exact=True).click()
    tab(page, "Detection")
    enter(page, "Magnitude", "6")
    tab(page, "Plan")
    until(page, lambda: table.inner_text() == planned and "simulated=plan" in page.url)
    tab(page, "Compare")
    pinned = page.locator("#pinned")
    assert "eps Eri" in pinned.inner_text()
    pinned.get_by_role("button", name="Open table 1").click()
    until(page, lambda: "tab=plan" in page.url and "YZ CMi" in table.inner_text())


def share_download_cite(visitor: Keys) -> None:
    page = visitor.page
    with page.expect_download() as coming:
        visitor.press(page.locator("#figure-excess").get_by_role("button", name="PNG"))
    assert coming.value.suggested_filename == "mauvecl-excess.png"
    visitor.press(page.get_by_role("button", name="Share, export, cite"))
    page.locator("#export[open]").wait_for()
    copied = "navigator.clipboard.readText()"
    visitor.press(page.get_by_role("button", name="Copy the link"))
    until(page, lambda: page.evaluate(copied) == page.url)
    visitor.press(page.get_by_role("button", name="Copy the BibTeX"))
    until(page, lambda: page.evaluate(copied).startswith("@software{mauvecl"))
    assert visitor.clicks == 4


TASKS = (which_flares_on_an_m_dwarf, limiting_magnitude, plan_of_three_targets, share_download_cite,
         own_spectrum_in_angstrom)  # fmt: skip


def test_newcomers_do_five_tasks(browser: Browser, server: Server) -> None:
    page = fresh(browser, server.address, permissions=["clipboard-read", "clipboard-write"])
    for task in TASKS:
        page.goto(server.address)
        settled(page)
        task(Keys(page))
    page.context.close()
