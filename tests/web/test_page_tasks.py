"""Five tasks of newcomers, by mouse and by keyboard alone, with the clicks that they take."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.web.visits import Server, fresh, settled, until

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

pytestmark = pytest.mark.long

#: Stops of the keyboard on the way to a control at most.
MOST_STOPS = 150


class Mouse:
    """Visitor with a mouse, who clicks into fields, on buttons, and twice at a list: to open it and to choose."""

    def __init__(self, page: Page) -> None:
        self.page, self.clicks = page, 0

    def press(self, control: Locator) -> None:
        """Press a button or go into a field."""
        control.click()
        self.clicks += 1

    def choose(self, control: Locator, option: str) -> None:
        """Choose from a list."""
        control.select_option(option)
        self.clicks += 2

    def turn(self, name: str) -> None:
        """Open a tab."""
        self.press(self.page.get_by_role("tab", name=name, exact=True))

    def type(self, control: Locator, *lines: str) -> None:
        """Go into a field and type, each line with Enter."""
        self.press(control)
        for line in lines:
            self.page.keyboard.type(line)
            self.page.keyboard.press("Enter")


class Keys(Mouse):
    """Visitor with the keyboard alone, who sees at each stop where he is."""

    def reach(self, control: Locator) -> None:
        """Go from stop to stop until this one."""
        for _ in range(MOST_STOPS):
            if control.count() and control.evaluate("e => e === document.activeElement"):
                assert control.evaluate("e => getComputedStyle(e).outlineStyle") != "none"
                return
            self.page.keyboard.press("Tab")
        raise AssertionError(f"never at {control}")

    def press(self, control: Locator) -> None:
        """Press a button or go into a field."""
        self.reach(control)
        if control.evaluate("e => e.tagName") != "INPUT":
            self.page.keyboard.press("Enter")
        self.clicks += 1

    def choose(self, control: Locator, option: str) -> None:
        """Choose from a list by its first letter."""
        self.reach(control)
        self.page.keyboard.press(option[0])
        assert control.input_value() == option
        self.clicks += 2

    def turn(self, name: str) -> None:
        """Open a tab with the arrows."""
        self.reach(self.page.locator("[role=tab][aria-selected=true]"))
        for _ in range(self.page.get_by_role("tab").count()):
            if self.page.evaluate("document.activeElement.textContent.trim()") == name:
                break
            self.page.keyboard.press("ArrowRight")
        assert self.page.locator("[role=tab][aria-selected=true]").inner_text().strip() == name
        self.clicks += 1


def sentence(page: Page, part: str) -> str:
    """Return the limit in a sentence, once it has these words."""
    solved = page.locator("#solved", has_text=part)
    solved.wait_for()
    settled(page)
    return solved.inner_text()


def which_flares_on_an_m_dwarf(visitor: Mouse) -> None:
    page = visitor.page
    visitor.type(page.get_by_label("Star", exact=True), "AU Mic")
    visitor.press(page.get_by_role("button", name="Use M1V at V = 8.81"))
    told = sentence(page, "at V = 8.81")
    assert told.startswith("90 % of flares of at least ")
    assert "with the usual unknowns" in told
    assert visitor.clicks == 2


def limiting_magnitude(visitor: Mouse) -> None:
    page = visitor.page
    visitor.choose(page.get_by_label("Solve for", exact=True), "magnitude")
    assert "with everything known" in sentence(page, "to V = 8.14")
    assert visitor.clicks == 2


def own_spectrum_in_angstrom(visitor: Mouse) -> None:
    """Upload the same spectrum in nm and in Angstrom, which give the same answer."""
    page = visitor.page
    nm = np.linspace(170.0, 1000.0, 400)
    flux = 1e-12 * np.exp(-(((nm - 500) / 150) ** 2))
    shown = []
    for unit, scale in (("nm", 1.0), ("Angstrom", 10.0)):
        rows = "\n".join(f"{w:.6f},{f:.6e}" for w, f in zip(scale * nm, flux, strict=True))
        text = f"wavelength ({unit}),flux (erg/s/cm2/Angstrom)\n{rows}\n"
        with page.expect_file_chooser() as asked:
            visitor.press(page.get_by_role("button", name="Use your own spectrum"))
        asked.value.set_files({"name": f"{unit}.csv", "mimeType": "text/csv", "buffer": text.encode()})
        page.locator("[data-uploaded=star]", has_text=f"{unit}.csv").wait_for()
        until(page, lambda: "your own star" in page.locator("#words-of").inner_text())
        settled(page)
        shown.append(page.locator("#facts").inner_text())
    assert shown[0] == shown[1]
    assert visitor.clicks == 2, "one for each file"


def plan_of_three_targets(visitor: Mouse) -> None:
    page = visitor.page
    visitor.turn("Plan")
    visitor.type(page.get_by_label("Target of target 1"), "AU Mic", "eps Eri", "YZ CMi")
    until(page, lambda: page.get_by_label("V of target 3").get_attribute("placeholder") == "11.19")
    visitor.press(page.get_by_role("button", name="Plan", exact=True))
    page.locator("#panel-plan").get_by_text("Done: 3 of 3 targets").wait_for()
    table = page.locator("#panel-plan .rows")
    until(page, lambda: all(name in table.inner_text() for name in ("AU Mic", "eps Eri", "YZ CMi", "best months")))
    assert visitor.clicks == 3


def share_download_cite(visitor: Mouse) -> None:
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


@pytest.mark.parametrize("visitor", [Mouse, Keys])
def test_newcomers_do_five_tasks(browser: Browser, server: Server, visitor: type[Mouse]) -> None:
    page = fresh(browser, server.address, permissions=["clipboard-read", "clipboard-write"])
    for task in TASKS:
        page.goto(server.address)
        settled(page)
        task(visitor(page))
    page.context.close()
