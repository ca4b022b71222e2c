"""What visitors do with the page in Chromium, for tests of it."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
#: Milliseconds: generous, for tests that share two cores.
PATIENCE = 90_000


class Server:
    """Server that can be ended and started again at the same address."""

    def __init__(self, log: Path) -> None:
        self.log = log
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = f"http://127.0.0.1:{self.port}/"
        self.start()

    def start(self) -> None:
        with self.log.open("a") as out:
            before = self.log.stat().st_size
            command = [sys.executable, "-m", "mauvecl", "serve", "--port", str(self.port)]
            self.process = subprocess.Popen(command, stdout=out, stderr=out)
        while "mauvecl serves at" not in self.log.read_text()[before:]:
            assert self.process.poll() is None, self.log.read_text()
            time.sleep(0.1)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(20)


def fresh(browser: Browser, address: str, **how: Any) -> Page:
    """Yield a new visitor's page with its first answer; errors in it fail the test."""
    page = browser.new_context(**how).new_page()
    page.set_default_timeout(PATIENCE)
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    # A browser says of a connection that it is lost; nothing else stands in its console.
    page.on("console", lambda m: None if "WebSocket" in m.text else faults.append(f"{m.type}: {m.text}"))
    page.faults = faults  # type: ignore[attr-defined]
    page.goto(address)
    settled(page)
    return page


def until(page: Page, true: Callable[[], bool]) -> None:
    for _ in range(PATIENCE // 50):
        if true():
            return
        page.wait_for_timeout(50)
    raise AssertionError("never true")


def settled(page: Page) -> None:
    """Wait until the page shows the answer to what was entered."""
    page.locator("#card[aria-busy=false]").wait_for(state="attached")
    assert not page.faults, page.faults  # type: ignore[attr-defined]


def enter(page: Page, label: str, value: str) -> None:
    """Open what is folded, enter a text, and wait for what comes of it."""
    field = page.get_by_label(label, exact=True)
    if not field.is_visible():
        page.get_by_text("Advanced", exact=True).click()
    if field.evaluate("e => e.tagName") == "SELECT":
        field.select_option(value)
    else:
        field.fill(value)
        field.press("Enter")
    settled(page)
