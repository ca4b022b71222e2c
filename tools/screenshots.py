"""Take the screenshots of the page that the documentation shows, into docs/images; needs Chromium and playwright."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from playwright.sync_api import sync_playwright  # noqa: E402
from web.visits import CHROMIUM, Server, Window, link  # noqa: E402

#: By the name of the file: size of the window, other options of the browser, and entries of the link.
SHOTS: dict[str, tuple[tuple[int, int], dict[str, Any], dict[str, str]]] = {
    "page": ((1280, 800), {}, {"amplitude_percent": "5", "magnitude": "8.5", "simulated": "detection"}),
    "page-dark": ((1280, 800), {"color_scheme": "dark"}, {"tab": "spectrum", "magnitude": "7.4"}),
    "page-1440": ((1440, 900), {}, {"star": "K3V", "magnitude": "7", "amplitude_percent": "10", "tab": "limit"}),
    "page-narrow": ((390, 844), {"device_scale_factor": 2}, {"amplitude_percent": "5", "magnitude": "8.5"}),
}


def main() -> None:
    """Take the screenshots."""
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        server = Server(Path(folder) / "log")
        browser = playwright.chromium.launch(executable_path=CHROMIUM)
        for name, ((width, height), how, entries) in SHOTS.items():
            page = Window(browser, server.address + link(**entries), viewport={"width": width, "height": height}, **how)
            # Pictures are drawn after the answer.
            page.wait_for_timeout(10_000)
            page.settled()
            page.screenshot(path=ROOT / "docs" / "images" / f"{name}.png")
        browser.close()
        server.kill()


if __name__ == "__main__":
    main()
