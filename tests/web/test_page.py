"""Journeys of visitors through the page in a real Chromium, and five tasks of newcomers with the clicks they take."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from astropy.table import QTable

from mauvecl import __version__
from tests.web.test_files import light_curve, rows_of, standards, star_file, zipped
from tests.web.visits import PATIENCE, Server, Window

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator

Visit = Callable[..., Window]

pytestmark = pytest.mark.long


def test_visitor_changes_values_and_reads_the_answer(visit: Visit) -> None:
    """Without scrolling: by typing and sliders, with values that are refused; nothing jumps."""
    page = visit(viewport={"width": 1280, "height": 800})
    assert page.get_by_text("not a flight calibration").count() == 1, "stated once"
    for label, text in (("Exposure, slider", "50 s"), ("Magnitude, slider", "V = 8.5")):
        assert page.get_by_label(label).get_attribute("aria-valuetext") == text
    temperature = page.field("Detector temperature")
    assert temperature.input_value() == ""
    assert temperature.get_attribute("placeholder") == "21, or along the orbit in plans"
    page.enter(magnitude="7.4")
    assert page.locator("#chance").inner_text() == "78.0 %"
    assert page.shown().startswith("Mauve would see a flare of 2 % on G2V V = 7.4 in 50 s with a chance of 78.0 % (")
    boxes = {
        found: page.locator(found).bounding_box()
        for found in ("#f-star", "#f-magnitude", "#f-amplitude_percent", "#f-exposure_s", "#chance", "#facts",
                      "#simulate", "#plot-excess", "#plot-distributions")
    }  # fmt: skip
    for found, box in boxes.items():
        assert box["x"] >= 0
        assert (box["x"] + box["width"] <= 1280, box["y"] + box["height"] <= 800) == (True, True), found
    assert len({round(boxes[f"#f-{name}"]["x"]) for name in ("star", "magnitude", "exposure_s")}) == 1, "one left edge"
    assert page.evaluate("scrollY") == 0
    # A value that is refused removes the answer, and the right one brings it back.
    page.enter(magnitude="8.5")
    before = page.shown()
    page.locator("#plot-excess .bk-Figure").wait_for()
    top = page.script("places")
    for name, wrong, right, reported in (
        ("magnitude", "7,4", "8.5", "'7,4' is not a number"),
        ("seed", "", "1", "nothing is entered; a whole number"),
        ("star", "Nowhere", "G2V", "'Nowhere' is unknown"),
    ):
        page.enter(**{name: wrong})
        page.answerless()
        assert page.title() == "No answer: mauvecl", "the browser's tab tells no answer either"
        assert page.script("places")[0] == top[0], "nothing jumps"
        entered = page.locator(f"#f-{name}")
        assert entered.input_value() == wrong, "what was entered stays there"
        assert entered.get_attribute("aria-invalid") == "true"
        assert reported in page.locator(f"#{entered.get_attribute('aria-describedby')}").inner_text(), "at its field"
        page.enter(**{name: right})
        assert page.shown() == before
        assert page.get_by_text(reported).count() == 0
    top = page.script("places")[1:]
    for label, text in (("Magnitude", "abc"), ("Magnitude", "8.5"), ("Star", "AU Mic"), ("Star", "x")):
        page.field(label).fill(text)
        page.settled()
        assert (page.field(label).get_attribute("aria-invalid") == "true") == (text in ("abc", "x"))
        assert page.script("places")[1:] == pytest.approx(top, abs=1), text
    page.enter(star="G2V")
    # Values that cannot be together mark their field, and choices follow from others.
    page.enter(unknown="realistic", statistic="paper")
    assert page.field("Detection statistic").get_attribute("aria-invalid") == "true"
    assert "cannot be marginalised" in page.locator("#words-of").inner_text()
    page.enter(statistic="matched")
    assert "Mauve would see" in page.shown()
    page.enter(unknown="ideal", realisations="1000000", fap="1e-6")
    number = page.field("Realisations")
    offered = [o.get_attribute("value") for o in number.locator("option:not([disabled])").all()]
    assert offered == ["100000 sampled", "1000000 sampled"]
    assert number.input_value() == "100000 sampled"
    assert "No answer" not in page.shown()
    assert "fap=1e-6" in page.url
    assert "1,000,000 are too few" in page.locator("#n-realisations").inner_text()
    page.enter(fap="0.001")
    assert number.input_value() == "1000000", "what was chosen comes back"
    assert page.locator("#n-realisations").inner_text() == ""
    # Keys in a number, and on sliders.
    magnitude = page.field("Magnitude")
    magnitude.press("End")
    magnitude.press("Backspace")
    magnitude.press_sequentially("2")
    page.says("V = 8.2")
    assert "magnitude=8.2" in page.url
    magnitude.press("ArrowUp")
    page.says("V = 8.3")
    for label, words in (("Exposure, slider", "in 55 s"), ("Flare amplitude, slider", "a flare of 2.5 %")):
        page.get_by_label(label).press("ArrowRight")
        page.says(words)
    assert page.field("Flare amplitude").input_value() == "2.5"
    # The focus of a slider leaves its number free, and help stands next to its question mark.
    assert page.get_by_label("Flare amplitude, slider").evaluate("e => e.matches(':focus-visible')")
    assert page.script("outline") >= page.field("Flare amplitude").evaluate("e => e.getBoundingClientRect().bottom")
    mark = page.button("What is Magnitude?")
    mark.click()
    at, message = mark.bounding_box(), page.locator("#help-magnitude").bounding_box()
    assert max(abs(message["x"] - at["x"]), abs(message["y"] - at["y"])) < 60
    page.keyboard.press("Escape")
    page.get_by_label("Begin with").select_option("M dwarf")
    page.until(lambda: page.field("Star").input_value() == "GJ 581" and "GJ 581" in page.shown())
    # Notes are put away, and those on a field stand there, too.
    page.enter(magnitude="-1")
    page.get_by_text(re.compile(r"SATURATED: 952 of 1643 pixels")).first.wait_for()
    notices = page.locator("#notices .danger").count()
    page.get_by_role("button", name=re.compile("Put away: SATURATED")).first.click()
    assert page.locator("#notices .danger").count() == notices - 1
    page.enter(sky="target and time")
    page.field("Sky target").fill("180.0 0.0")
    page.field("Time, UTC").fill("2026-09-23T00:00")
    for place in ("#w-target", "#words-of"):
        page.locator(place, has_text=re.compile(r"the Sun is \d+\.\d deg from the target")).wait_for()
    page.answerless()


def test_visitor_looks_for_a_star_by_keys_and_goes_back(page: Window) -> None:
    before, star = page.shown(), page.field("Star")
    star.click()
    star.press_sequentially("hd")
    page.get_by_role("option", name="HD 85512", exact=True).wait_for()
    star.press("ArrowDown")
    star.press("Enter")
    page.says("on HD 40307 V")
    second = page.shown()
    third = second.replace("HD 40307", "K3V")
    page.enter(star="K3V")
    page.until(lambda: "star=K3V" in page.url)
    assert page.shown() == third, "another name of the same star"
    page.tab("Noise")
    page.until(lambda: "tab=noise" in page.url)
    page.go_back()
    page.go_back()
    page.until(lambda: "star=HD+40307" in page.url and "tab=detection" in page.url)
    page.until(lambda: star.input_value() == "HD 40307" and page.shown() == second)
    while "star=HD" in page.url or "star=h" in page.url:
        page.go_back()
    page.until(lambda: star.input_value() == "G2V" and page.shown() == before)
    while "tab=noise" not in page.url:
        page.go_forward()
    page.until(lambda: star.input_value() == "K3V" and page.shown() == third)
    assert page.get_by_role("tab", name="Noise", exact=True).get_attribute("aria-selected") == "true"
    assert page.locator("#panel-noise").is_visible()
    page.press("Start afresh")
    page.enter(star="AU Mic")
    page.says("AU Mic V = 8.81")
    # A magnitude that the user entered stays.
    page.enter(magnitude="9")
    page.says("V = 9 in")
    # The name is confirmed after the answer to the typed text has come, or while the server still computes it.
    for answered in (True, False):
        page.goto(page.url.partition("?")[0])
        page.settled()
        if not answered:
            page.script("late")
        star.fill("gj 581")
        if answered:
            page.until(lambda: "gj 581" in page.locator("#words-of").inner_text())
            page.settled()
        star.press("Enter")
        page.says("V = 10.57")
        assert page.field("Magnitude").input_value() == "10.57"
        assert page.locator("#k-star").inner_text() == "M3V, 6.215 pc, V = 10.57; Hipparcos"
        # Name and magnitude are one step of the history.
        page.go_back()
        page.says("on G2V V = 8.5")
    # Tabs stand in groups and turn round; newcomers do the rest by keys.
    headings = page.locator("[role=tablist] > div > span").all_inner_texts()
    assert headings == ["Plan observations", "Simulate observations", "Analyse observations", "Tools"]
    for name, number in (("detection", 0), ("visibility", 0), ("snr", 1), ("calibrate", 2), ("compare", 3)):
        described = page.locator(f"#tab-{name}").get_attribute("aria-describedby")
        assert page.locator(f"#{described}").inner_text() == headings[number], name
    page.locator("#tab-detection").focus()
    for key, name in (("ArrowRight", "limit"), ("ArrowLeft", "detection"), ("ArrowLeft", "compare")):
        page.keyboard.press(key)
        assert page.evaluate("document.activeElement.id") == f"tab-{name}"


def test_visitor_studies_and_keeps_pictures(page: Window) -> None:
    """Legends, tooltips, zoom, tables, both axes, files, and a click that sets the question."""
    # A picture is one named stop of the keyboard.
    box = page.locator("#plot-excess")
    page.settled_ranges("excess")
    assert (page.script("stops", "plot-excess"), box.evaluate("e => e.tabIndex")) == ([], 0)
    assert page.get_by_role("img", name="Flare minus quiet, in sigma of the noise").count() == 1
    drawn = page.locator("#figure-excess .legend li:visible", has_text="drawn exposure")
    drawn.wait_for()
    before = page.settled_ranges("excess")

    def point() -> tuple[float, float]:
        x, y = page.centre("excess", 0.4, 0.3)
        page.mouse.move(x, y)
        return x, y

    def inside() -> None:
        page.until(lambda: page.ranges("excess") != before)
        low, high, bottom, top = page.ranges("excess")
        assert before[0] <= low < high <= before[1]
        assert high - low < before[1] - before[0]
        assert top - bottom < before[3] - before[2], "both axes"

    x, y = point()
    page.mouse.down()
    page.mouse.move(x + 60, y + 60, steps=4)
    page.mouse.up()
    inside()
    page.press("Reset zoom", "#figure-excess")
    page.until(lambda: page.ranges("excess") == before)
    page.evaluate("document.activeElement.blur()")
    point()
    place = page.evaluate("scrollY")
    page.mouse.wheel(0, -200)
    page.until(lambda: page.evaluate("scrollY") < place)
    page.wait_for_timeout(300)
    assert page.ranges("excess") == before, "the wheel alone scrolls"
    # With Ctrl, and once the picture has the focus, it zooms.
    for keys in (["Control"], []):
        point()
        for key in keys:
            page.keyboard.down(key)
        page.mouse.wheel(0, -200)
        for key in keys:
            page.keyboard.up(key)
        inside()
        box.press("0")
        page.until(lambda: page.ranges("excess") == before)
    box.press("+")
    inside()
    page.settled_ranges("roc")
    frame = page.locator("#figure-roc")
    frame.get_by_text("Data as a table").click()
    table = frame.locator("table", has_text="closed form")
    assert table.locator("caption").inner_text() == "closed form: 50 of 120 rows"
    assert table.locator("th").all_inner_texts() == ["false-alarm probability per test", "detection probability"]

    def first_row() -> list[float]:
        return [float(text) for text in table.locator("tr").nth(1).locator("td").all_inner_texts()]

    fap, chance = first_row()
    assert fap == 1e-6
    assert 0 < chance < 0.2
    page.enter(magnitude="7")
    page.until(lambda: first_row()[1] > chance + 0.3)
    page.enter(amplitude_percent="1.9")
    drawn.wait_for()
    # A legend keeps its lines when an entry appears, at every width.
    there = page.script("heights", False)
    assert len(set(there)) > 2, "the widths wrap it differently"
    assert page.script("heights", True) == there
    page.tab("Spectrum")
    recorded = page.locator("#figure-recorded")
    recorded.locator(".legend li:visible", has_text="drawn exposure").wait_for()
    for name in ("dark", "bias"):
        assert not recorded.locator(".legend li", has_text=name).last.is_visible(), "until it is asked for"
    recorded.get_by_role("checkbox", name="Bias and dark").check()
    recorded.locator(".legend li:visible", has_text="bias").wait_for()
    dark = page.evaluate("document.documentElement.dataset.theme")
    page.locator("#theme").click()
    page.locator("#theme").click()
    assert page.evaluate("document.documentElement.dataset.theme") != dark
    recorded.get_by_label("log y").check()
    ends = "page.pictures.all.%s.figure?.models.get('wavelength')"
    page.until(lambda: page.evaluate(f"Boolean({ends % 'recorded'})"))
    page.evaluate(f"{ends % 'recorded'}.setv({{start: 250, end: 300}})")
    page.until(lambda: page.evaluate(f"{ends % 'telescope'}.end") == 300)
    page.enter(magnitude="9")
    assert page.evaluate(f"{ends % 'recorded'}.end") == 300, "the axis stays where the visitor has put it"
    page.settled_ranges("recorded")
    names = page.evaluate("page.pictures.all.recorded.figure.plot.renderers.map(one => one.name)")
    assert names.index("drawn exposure") < names.index("star") < names.index("star with flare")
    page.tab("Limit and map")
    page.locator("#text-map", has_text="At least half").wait_for()
    answer = page.shown()
    page.settled_ranges("map")
    page.mouse.click(*page.centre("map", 0.5, 0.4))
    page.until(lambda: "magnitude=8.5" not in page.url and "magnitude" in page.url)
    assert page.shown() != answer
    entered = float(page.field("Magnitude").input_value())
    own = "page.pictures.all.map.figure.models.get('own').data.x[0]"
    page.until(lambda: abs(page.evaluate(own) - entered) < 1e-3)


def test_visitor_in_the_dark_keeps_pictures_on_white(visit: Visit) -> None:
    """At least 1600 pixels, with title, legend, and what was asked, whatever the page's colours are."""
    from PIL import Image

    page = visit("?magnitude=8&statistic=chi2", color_scheme="dark")
    for theme in ("dark", "light"):
        page.emulate_media(color_scheme=theme)
        page.reload()
        page.settled()
        for picture, curve in (("excess", "expected per element"), ("distributions", "no flare")):
            page.settled_ranges(picture)
            tip = page.locator(".bk-Tooltip", has_text=curve)
            for k in range(200):
                x, y = page.centre(picture, 0.4, 0.4)
                page.mouse.move(x + k % 5, y)
                if tip.is_visible():
                    break
                page.wait_for_timeout(20)
            colours = "e => [getComputedStyle(e).color, getComputedStyle(e).backgroundColor]"
            assert tip.evaluate(colours) == page.locator("#asked").evaluate(colours), f"those of the {theme} page"
        page.mouse.move(1, 1)
        svg, png, pdf = (page.download(ending, "#figure-distributions") for ending in ("SVG", "PNG", "PDF"))
        for part in ("The statistic without and with the flare", "no flare", "threshold", "V = 8",
                     "Detection statistic: chi2", f"mauvecl {__version__}"):  # fmt: skip
            assert part in svg.decode(), part
        with Image.open(io.BytesIO(png)) as image:
            assert image.width >= 1600
            assert image.convert("RGB").getpixel((2, 2)) == (255, 255, 255)
            dark = np.mean(np.asarray(image.convert("L"))[image.height // 3 : -image.height // 3] < 100)
        assert dark < 0.1, "dark on light"
        assert b"A click" not in page.download("SVG", "#figure-roc"), "what the page offers is not on paper"
        assert pdf.startswith(b"%PDF-")
        table = pdf[int(pdf.split(b"startxref\n")[1].split()[0]) :].split(b"\n")
        assert table[0] == b"xref"
        for n in range(1, 6):
            assert pdf[int(table[n + 2].split()[0]) :].startswith(b"%d 0 obj" % n)


def test_visitor_simulates_shares_and_compares(visit: Visit, page: Window) -> None:
    """A link opened again shows the same; pinned scenarios are compared; `test_files.py` compares numbers."""
    page.enter(fap="0.05", realisations="10000", amplitude_percent="1.5")
    place = page.locator("#plot-excess").bounding_box()
    reported = page.simulate()
    assert page.locator("#plot-excess").bounding_box() == place, "nothing jumps"
    assert "of 10,000 simulated" in reported
    rows = QTable.read(io.BytesIO(page.download("detection (ecsv)")), format="ascii.ecsv")
    (row,) = (row for row in rows if row["statistic"] == "matched")
    assert reported.count(f"{100 * row['probability']:.1f} %") >= 2, "in the sentence and in the number"
    page.until(lambda: "simulated=detection" in page.url)
    second = visit(page.url.partition("/?")[2].join(("?", "")))
    second.until(lambda: second.shown() == reported)
    assert second.url == page.url
    assert second.field("Realisations").input_value() == "10000"
    page.tab("Compare")
    page.button("Open run 1").wait_for()
    page.tab("Limit and map")
    page.simulate("Simulate the map")
    page.get_by_text("64 cells are simulated").wait_for()
    page.tab("Detection")
    with page.exporting():
        page.get_by_text("mauvecl detect --star G2V --magnitude 8.5").wait_for()
        assert "Study.build(" in page.locator("#as-python").inner_text()
    page.press("Start afresh")
    # Pinned scenarios stay over a reload.
    chances = []
    for magnitude in ("8.5", "8"):
        page.enter(magnitude=magnitude)
        page.press("Pin")
        chances.append(page.locator("#chance").inner_text())
    page.tab("Compare")
    words = page.locator("#pinned tr", has_text="Detected").inner_text().split()
    assert {chance.split()[0] for chance in chances} <= {*words}
    page.reload()
    page.settled()
    page.button("Open scenario 1").click()
    page.until(lambda: page.locator("#chance").inner_text() == chances[0])
    # In the pictures, too: in their own colours, which are those of the table and the key.
    strokes = "paths => paths.map(path => path.getAttribute('stroke'))"
    colours = page.locator("#pinned .swatch path").evaluate_all(strokes)
    assert len(set(colours)) == 2
    for name, picture in (("Detection", "excess"), ("S/N", "snr"), ("Limit and map", "map")):
        page.tab(name)
        page.until(partial(lambda picture: page.script("pins", picture)[0] == [True, True, False], picture))
        _, drawn = page.script("pins", picture)
        assert [colour for colour in drawn if colour != "#ffffff"][:2] == colours
        key = page.locator(f"#panel-{page.evaluate('page.routing.seen.tab')} .pins")
        assert key.locator("path").evaluate_all(strokes) == colours
        assert "2: G2V, V = 8, 2 %, 50 s" in key.inner_text()
    page.tab("Compare")
    page.button("Remove scenario 1").click()
    assert page.locator("#pinned .swatch path").get_attribute("stroke") == colours[1], "what is left keeps its colour"
    # What is pressed before an answer has come, and without what it needs.
    page.tab("Detection")
    page.press("Start afresh")
    assert page.script("hasty") == ["true", True]
    page.get_by_text("Done").first.wait_for()
    page.tab("Plan")
    page.locator('#panel-plan [data-simulate="plan"]').dispatch_event("click")
    page.locator("#panel-plan").get_by_text("a field that it needs is empty").wait_for()
    # `test_server.py` cancels while others are served.
    page.tab("Detection")
    page.press("Start afresh")
    page.enter(realisations="4000000")
    page.button("Simulate").click()
    page.get_by_text(re.compile(r"of 12,000,000 realisations, about .* s left")).wait_for()
    page.get_by_role("button", name="Cancel").click()
    page.get_by_text("Cancelled.").wait_for()
    assert "in closed form" in page.shown()
    # The next question is no run if one that was simulated is refused.
    runs = page.locator("#history li").count()
    page.evaluate("page.simulated(); page.enter({magnitude: '99'})")
    page.get_by_text("No answer.", exact=True).wait_for()
    page.enter(magnitude="8")
    assert page.locator("#history li").count() == runs


def test_visitor_uploads_spectra(browser: Browser, page: Window) -> None:
    """Good and bad ones, by choice and by dropping; units are advised where they are needed; a reload keeps files."""
    before, star = page.shown(), page.field("Star")
    page.give("star", "200 1e-12\n300 <script>alert(1)</script>\n")
    page.locator("#w-star", has_text=re.compile(r"line 2: .* is not numeric")).wait_for()
    page.answerless()
    assert star.input_value() == "", "no star's name next to another star's file"
    page.give("star", star_file())
    page.until(lambda: star.input_value() == "uploaded star" and "star=uploaded" in page.url)
    page.says("on uploaded star V")
    assert page.shown() != before
    page.give("star", bytes(45 * 2**20))
    page.locator("#w-star", has_text="the upload has 45.0 MiB, but may have at most 4 MiB").wait_for()
    page.answerless()
    page.give("star", star_file())
    page.give("own_unknown", "200 1\n450 3\n700 1\n")
    page.until(lambda: page.locator("#f-own_unknown").input_value() == "uploaded spectrum")
    page.says("on uploaded star V")
    page.press("Start afresh")
    page.script("dropped", star_file().decode())
    page.locator("[data-uploaded=star]", has_text="dropped star.txt").wait_for()
    page.says("on uploaded star V")
    for name, is_held in (("", True), ("Vega", False)):
        if name:
            page.enter(star=name)
        with page.exporting():
            warning = page.get_by_text("The link does not hold your file")
            warning.wait_for(state="visible" if is_held else "hidden")
    page.press("Start afresh")
    page.tab("Change")
    page.enter(changes="Mg II")
    page.give("change_file", star_file(), "companion.txt")
    page.until(lambda: "change_file=uploaded" in page.url)
    assert page.locator("[data-uploaded=change_file]").inner_text() == "companion.txt"
    page.enter(change_band="B")
    page.simulate("Change")
    page.locator("#panel-change .rows", has_text="spectrum").wait_for()
    page.locator("[data-remove=change_file]").click()
    page.field("Band of the added light").wait_for(state="hidden")
    page.until(lambda: "change_file" not in page.url and "change_band=B" not in page.url)
    page.settled()
    page.tab("Detection")
    page.press("Start afresh")
    assert not page.field("Unit of wavelengths").is_visible()
    page.give("star", flat(3300, 7501), "angstrom.txt")
    page.get_by_text("look like Angstrom").first.wait_for()
    page.answerless()
    # What the message advises is one click away, and the field that it names stands below the file.
    page.button("Unit of wavelengths: Angstrom").click()
    page.get_by_text("“Continue with” continues it by a library spectrum").first.wait_for()
    assert page.field("Unit of wavelengths").input_value() == "Angstrom"
    page.enter(extend="M3V")
    page.says("on uploaded star V")
    continued, address = page.shown(), page.url
    assert page.get_by_text("below 330 nm it is continued by M3V").count() == 1
    page.reload()
    page.says("on uploaded star V")
    assert page.shown() == continued
    assert page.locator("[data-uploaded=star]").inner_text() == "angstrom.txt"
    # Another visitor has not got the file, nor has another tab of this browser.
    for context in (page.context, browser.new_context()):
        other = context.new_page()
        other.goto(address)
        other.get_by_text("give its file again, since links do not hold it").first.wait_for()
        other.close()
    # An archive after a refused one.
    page.tab("Calibrate")
    page.give("observations", zipped({"../a.csv": b"1"}))
    page.locator("#panel-calibrate").get_by_text("the archive holds a file named '../a.csv'").wait_for()
    page.give("observations", zipped(standards()), "standards.zip")
    page.locator('[data-simulate="calibrate"]').click()
    # Seen, although the refusal hid the notes.
    page.get_by_text("notes on this answer").wait_for()
    assert page.locator('[data-file="instrument.zip"]').is_enabled()


def flat(first: int, end: int) -> bytes:
    angstrom = np.arange(first, end, 10)
    return rows_of(angstrom, np.full(angstrom.size, 1e-12))


@pytest.mark.parametrize("width", [390, 640, 1440])
def test_visitor_finds_reasons_and_targets_at_any_width(visit: Visit, width: int) -> None:
    """No tab scrolls sideways, what is pressed has 24 pixels, and why a file is refused stays at its field alone.

    Of every field that takes a file: a file that is larger than accepted, which is made small here; and of each with a
    unit, wavelengths that look like Angstrom. Of the star: a spectrum that ends within the payload's range.
    """
    page = visit(viewport={"width": width, "height": 900})
    if width < 900:
        card, asked = page.locator("#numbers").bounding_box(), page.locator("#asked").bounding_box()
        assert card["y"] < asked["y"], "the answer first"
        assert not page.field("Magnitude").is_visible(), "folded"
        page.get_by_text("Change the question").click()
    page.get_by_text("Advanced", exact=True).click()

    def refuse(name: str, content: bytes, reason: str) -> None:
        page.give(name, content)
        page.locator(f"#w-{name}:visible", has_text=reason).wait_for()
        # Messages at typed fields are seen while the field has the focus.
        page.locator(f"[data-choose={name}]").focus()
        assert page.script("covered") == [], name

    seen = set()
    for tab_name in page.tabs():
        page.locator(f"#tab-{tab_name}").click()
        page.settled()
        assert page.script("targets") == [], tab_name
        assert page.evaluate("document.documentElement.scrollWidth") <= width, tab_name
        uploads = page.evaluate("page.uploads.words.uploads")
        for name in (uploads.keys() & page.evaluate("page.tab.reads")) - seen:
            seen.add(name)
            most = f"page.uploads.words.uploads.{name}.most"
            page.evaluate(f"{most} = 10")
            refuse(name, bytes(11), "may have at most")
            page.evaluate(f"{most} = {uploads[name]['most']}")
            if any(option.endswith("wavelength_unit") for option in uploads[name]["options"]):
                refuse(name, flat(3000, 7001), "look like Angstrom")
            if name == "star":
                page.button("Unit of wavelengths: Angstrom").click()
                page.locator("#w-extend", has_text="Continue with").wait_for()
                assert page.script("covered") == []
            page.press("Start afresh")
    assert seen == uploads.keys()


def test_visitor_with_a_phone(visit: Visit) -> None:
    """Two fingers zoom, and flares of a plan are seen at once."""
    page = visit(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    before = page.settled_ranges("excess")
    x, y = page.centre("excess", 0.5, 0.5)
    touch = page.context.new_cdp_session(page.page)
    for kind, apart in (("touchStart", 20), *(("touchMove", 20 + 8 * k) for k in range(1, 9)), ("touchEnd", 0)):
        points = [{"x": x + side * apart, "y": y, "id": (side + 1) // 2} for side in (-1, 1) if apart]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    page.until(lambda: page.ranges("excess")[1] - page.ranges("excess")[0] < before[1] - before[0])
    assert page.evaluate("visualViewport.scale") == 1, "the picture, not the page"
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page = visit("?tab=plan", viewport={"width": 390, "height": 844})
    assert page.get_by_role("button", name="Share, export, cite").is_visible(), "outside of what is folded"
    page.get_by_role("button", name="Three flare stars").click()
    page.script("written")
    page.simulate("Plan")
    table = page.get_by_role("region", name="Table of Plan")
    page.until(lambda: "·" not in table.inner_text())
    box, flares = table.bounding_box(), table.get_by_role("columnheader", name="flares", exact=True).bounding_box()
    assert flares["x"] + flares["width"] <= box["x"] + box["width"]
    for wide in (table, page.get_by_role("region", name="Table of targets")):
        assert wide.evaluate("e => e.scrollWidth > e.clientWidth && e.tabIndex === 0")
        assert "gradient" in wide.evaluate("e => getComputedStyle(e).backgroundImage"), "a shadow at the edge"
    for picture in ("recovered", "expected"):
        page.settled_ranges(picture)
    # Decades are a base and its exponent.
    energies = [
        (exponent, left, right)
        for (base, left, _), (exponent, _, right) in pairwise(page.evaluate("written"))
        if base == "10" and exponent in map(str, range(28, 38))
    ]
    assert len(energies) > [exponent for exponent, *_ in energies].count("28") > 0
    for (first, _, right), (second, left, _) in pairwise(energies):
        assert left > right or second == "28", (first, second)
    page.field("First day").fill("2026-11-01")
    page.settled()
    assert page.get_by_role("status").inner_text() == "", "nothing is done of another plan"


def test_visitor_pastes_and_opens_targets(visit: Visit) -> None:
    page = visit("?tab=visibility", permissions=["clipboard-read", "clipboard-write"])
    page.field("Target of target 1").click()
    page.evaluate("navigator.clipboard.writeText('name\\tV\\nAU Mic\\t\\nmine\\t9.5')")
    page.keyboard.press("Control+v")
    page.until(lambda: page.field("V of target 2").input_value() == "9.5")
    page.locator("#w-targets", has_text="mine").wait_for()
    assert page.field("Target of target 2").get_attribute("aria-invalid") == "true"
    page.field("Coordinates (deg) of target 2").fill("53.2 -9.4")
    page.until(lambda: page.button("Find when").is_enabled())
    # Quoted names, and names of columns as on the command line.
    for text, cells in (
        ('name,ra,dec,mass_msun,age_myr\n"one, two",10,20,1.0,600\nAU Mic,,,,\n',
         {"age_myr of target 1": "600", "Target of target 1": "one, two"}),
        ("source_id,main_id,RAJ2000,DEJ2000,Vmag,SpType,Plx\n12,HD 1,10.5,-3,8,K5V,100\n",
         {"Target of target 1": "12", "V of target 1": "8", "Type of target 1": "K5V"}),
        ("name\none\nAU Mic\n", {"Target of target 1": "one", "Target of target 2": "AU Mic"}),
    ):  # fmt: skip
        page.give("#targets-file", text, "targets.csv")
        page.until(partial(lambda cells: {name: page.field(name).input_value() for name in cells} == cells, cells))
        page.until(partial(lambda text: page.button("Find when").is_enabled() != text.startswith("name\n"), text))
    page.button("Remove target 1").click()
    assert page.field("Target of target 1").input_value() == "AU Mic"
    page.button("Remove all").click()
    assert page.button("Find when").is_disabled()


def test_visitor_analyses_an_example_and_own_columns(page: Window) -> None:
    """One click answers a light curve of Kepler; columns of a file that is not understood are chosen from menus."""
    page.tab("Analyse")
    page.field("Quality bits").fill("all")
    page.get_by_role("button", name="Try an example file").click()
    page.get_by_text("Done: ").wait_for()
    page.says("flares are detected in 9.97 star-days of KIC 10002792")
    assert page.field("Quality bits").input_value() == "", "that was entered on another file"
    assert "detected" in page.locator("#panel-analyse .rows").inner_text()
    page.press("Start afresh")
    page.tab("Analyse")
    page.give("frames", light_curve(flags=True), "mine.csv")
    menus = page.get_by_role("group", name="Which column is what?")
    menus.get_by_label("Time", exact=True).select_option("minute")
    flux = menus.get_by_label("Flux", exact=True)
    assert flux.locator("option").all_inner_texts() == ["choose", "minute", "rate", "sd", "flag"]
    flux.select_option("rate")
    page.until(lambda: "200 frames of" in page.locator("#text-frames").inner_text())
    menus.get_by_label("Unit of time").select_option("min")
    menus.get_by_label("Error", exact=True).select_option("sd")
    assert menus.is_visible(), "what was chosen can be chosen otherwise"
    page.simulate("Analyse")
    page.says("1 flare is detected")
    # What is chosen is a mapping, which the command line reads as well.
    assert page.taken()["columns.toml"] == 'time = "minute"\ntime_unit = "min"\nflux = "rate"\nerror = "sd"\n'


@pytest.mark.parametrize("theme", ["light", "dark", "forced"])
def test_visitor_with_a_screen_reader_or_other_colours_and_sizes(visit: Visit, theme: str) -> None:
    """axe-core finds no violation of any impact on any tab, dialog or error.

    Twice the size in the browser's settings is twice the size on the page; four sizes are used.
    """
    axe = Path(pytest.importorskip("axe_playwright_python").__file__).parent / "axe.min.js"
    page = visit(**({"forced_colors": "active"} if theme == "forced" else {"color_scheme": theme}))
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
        first, *others = [page.evaluate(ground, name) for name in page.tabs()]
        assert len({*others}) == 1
        assert first not in others, "the first is selected"
    page.get_by_text("Advanced", exact=True).click()
    for name in page.tabs():
        page.locator(f"#tab-{name}").click()
        page.locator(f"#panel-{name}").wait_for()
        page.settled()
        # The pictures of an earlier answer are dim, and become clear slowly.
        page.until(lambda: page.script("clear"))
        # The pointer is on the tab.
        look(name, f"#panel-{name}", f"#tab-{name}")
    look("page")
    if theme != "light":
        return
    for name in ("Pin", "About and citation", "What is Star?"):
        page.button(name).click()
        look(name)
        page.keyboard.press("Escape")
    for text, place in (("-1", "#notices .danger"), ("x", "#w-magnitude:visible")):
        page.enter(magnitude=text)
        page.locator(place).first.wait_for()
        look(place)
    page.enter(magnitude="8.5")
    before = page.script("sizes")
    assert len(before) <= 4, before
    page.add_style_tag(content="@media all { :root { font-size: 187.5% !important; } }")
    # The chance grows with the window, up to its largest size.
    assert page.script("sizes")[:3] == pytest.approx([2 * one for one in before[:3]], rel=0.01)
    source = page.evaluate("fetch('assets/page.css').then(r => r.text())")
    assert not re.search(r"font(-size)?:[^;]*\dpx", source), "relative sizes only"


def test_visitor_with_a_hostile_link_or_without_scripts(browser: Browser, server: Server) -> None:
    """A link is escaped; the page loads nothing from elsewhere; without scripts it says so."""
    evil = "%21%5Bx%5D(http://127.0.0.1:9/x.png)%3Cimg%20src=http://127.0.0.1:9/y.png%3E"
    asked: list[str] = []
    page = browser.new_page()
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{server.address}?star={evil}&band={evil}&target={evil}&sky=target+and+time&{evil}=1&tab={evil}")
    for text in ("which is no field here", "![x](http://127.0.0.1:9/x.png)"):
        page.get_by_text(text).first.wait_for(timeout=PATIENCE)
    page.get_by_text("No answer.", exact=True).wait_for()
    page.wait_for_timeout(300)
    assert [url for url in asked if not url.startswith((server.address, "data:", "blob:"))] == []
    page.close()
    page = browser.new_page(java_script_enabled=False)
    page.goto(server.address)
    assert page.locator(".noscript").is_visible()
    assert "needs JavaScript" in page.locator(".noscript").inner_text()
    page.close()


def test_visitor_loses_the_server_and_finds_it_again(visit: Visit, server: Server) -> None:
    page = visit("?magnitude=9&fap=0.05&realisations=10000")
    page.give("star", star_file())
    page.says("on uploaded star V")
    before, lost = page.simulate(), page.get_by_text("The connection to the server is lost")
    server.kill()
    lost.wait_for()
    assert page.evaluate("[...document.body.children].every(e => e.inert || e.id === 'lost')")
    server.start()
    lost.wait_for(state="hidden")
    page.until(lambda: page.shown() == before)  # the upload too: the browser has kept it, and what was simulated
    assert page.field("Magnitude").input_value() == "9"


#: Stops of the keyboard on the way to a control at most.
MOST_STOPS = 150


class Keys:
    """Visitor with the keyboard alone, who sees at each stop where he is."""

    def __init__(self, page: Window) -> None:
        self.page, self.clicks = page, 0

    def reach(self, control: Locator) -> None:
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

    def type(self, control: Locator, *lines: str) -> None:
        self.press(control)
        for line in lines:
            self.page.keyboard.type(line)
            self.page.keyboard.press("Enter")


def which_flares_on_an_m_dwarf(visitor: Keys, page: Window) -> None:
    visitor.type(page.field("Star"), "AU Mic")
    solved = page.locator("#solved", has_text="at V = 8.81")
    solved.wait_for()
    assert solved.inner_text().startswith("90 % of flares of at least ")
    assert "if everything but the noise were known" in solved.inner_text()


def limiting_magnitude(visitor: Keys, page: Window) -> None:
    visitor.reach(page.field("Solve for"))
    page.keyboard.press("m")
    # A choice counts as two clicks.
    visitor.clicks += 2
    assert page.field("Solve for").input_value() == "magnitude"
    page.locator("#solved", has_text=re.compile(r"to V = 7\.26.*to V = 8\.40 if everything but the noise")).wait_for()


def own_spectrum(visitor: Keys, page: Window) -> None:
    with page.expect_file_chooser() as asked:
        visitor.press(page.get_by_role("button", name="Use your own spectrum"))
    asked.value.set_files({"name": "mine.txt", "mimeType": "text/plain", "buffer": star_file()})
    page.locator("[data-uploaded=star]", has_text="mine.txt").wait_for()
    page.says("on uploaded star V")


def plan_of_three_targets(visitor: Keys, page: Window) -> None:
    """Plan, and pin the plan, which survives a change of the star of other tabs and is found again."""
    visitor.reach(page.locator("[role=tab][aria-selected=true]"))
    while page.evaluate("document.activeElement.textContent.trim()") != "Plan":
        page.keyboard.press("ArrowRight")
    visitor.clicks += 1
    page.wait_for_url("**tab=plan**")
    assert not page.locator("#numbers").is_visible(), "no chance of another star"
    assert not page.field("Magnitude").is_visible()
    table, names = page.locator("#panel-plan .rows"), ("AU Mic", "eps Eri", "YZ CMi")
    page.locator("#panel-plan .rows", has_text="best months").wait_for()
    visitor.type(page.get_by_label("Target of target 1"), *names)
    page.until(lambda: page.get_by_label("V of target 3").get_attribute("placeholder") == "11.19")
    visitor.press(page.button("Plan"))
    page.locator("#panel-plan").get_by_text("Done: 3 of 3 targets").wait_for()
    page.until(lambda: all(name in table.inner_text() for name in (*names, "best months", "false alarms")))
    page.locator("#figure-recovered .legend", has_text="YZ CMi").wait_for()
    planned = table.inner_text()
    assert page.locator("#words-of").inner_text().startswith("Mauve would recover ")
    page.button("Pin").click()
    page.tab("Detection")
    page.enter(magnitude="6")
    page.tab("Plan")
    page.until(lambda: table.inner_text() == planned and "simulated=plan" in page.url)
    page.tab("Compare")
    pinned = page.locator("#pinned")
    assert "eps Eri" in pinned.inner_text()
    pinned.get_by_role("button", name="Open table 1").click()
    page.until(lambda: "tab=plan" in page.url and "YZ CMi" in table.inner_text())


def share_download_cite(visitor: Keys, page: Window) -> None:
    with page.expect_download() as coming:
        visitor.press(page.locator("#figure-excess").get_by_role("button", name="PNG"))
    assert coming.value.suggested_filename == "mauvecl-excess.png"
    visitor.press(page.get_by_role("button", name="Share, export, cite"))
    page.locator("#export[open]").wait_for()
    copied = "navigator.clipboard.readText()"
    visitor.press(page.get_by_role("button", name="Copy the link"))
    page.until(lambda: page.evaluate(copied) == page.url)
    visitor.press(page.get_by_role("button", name="Copy the BibTeX"))
    page.until(lambda: page.evaluate(copied).startswith("@software{mauvecl"))


#: Tasks, with the number of their clicks.
TASKS = {which_flares_on_an_m_dwarf: 1, limiting_magnitude: 2, own_spectrum: 1, plan_of_three_targets: 3,
         share_download_cite: 4}  # fmt: skip


def test_newcomers_do_five_tasks(visit: Visit, server: Server) -> None:
    page = visit(permissions=["clipboard-read", "clipboard-write"])
    for task, clicks in TASKS.items():
        page.goto(server.address)
        page.settled()
        visitor = Keys(page)
        task(visitor, page)
        assert visitor.clicks == clicks, task.__name__
