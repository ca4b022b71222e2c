"""What a visitor of the page waits for after a change, in a real Chromium on the same machine.

python bench/page.py [--output bench/results/page.ecsv]
"""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path

import numpy as np
from astropy.table import Table
from page_server import page_server
from playwright.sync_api import Browser, Page, sync_playwright

from mauvecl.detection.requests import STATISTICS

CHANGES = 7
#: What is changed, and what from and to; each change is another value between.
FIELDS = {"amplitude_percent": (1.3, 2.9), "magnitude": (7.5, 9.0)}
#: Visible tab, and requested statistic.
CASES = (
    *((tab, "matched") for tab in ("spectrum", "noise", "limit", "unknowns")),
    *(("detection", statistic) for statistic in STATISTICS),
)

#: Milliseconds from an event of a field to another answer, and to the picture of it: its data are there and painted.
WATCH = """
([name, value]) => new Promise((done, failed) => {
  const field = document.getElementById(`f-${name}`), card = document.getElementById('card')
  const tab = document.querySelector('[role=tabpanel]:not([hidden])')
  const start = performance.now()
  let answered = 0, draws = 0
  const renders = [...tab.querySelectorAll('.plot')].map(plot => plot.id.replace('plot-', ''))
  const original = {}
  for (const name of renders) {
    const picture = window.page.pictures.all[name]
    original[name] = picture.fill
    picture.fill = function () { original[name].call(this); draws += 1 }
  }
  field.value = value
  field.dispatchEvent(new Event('input', {bubbles: true}))
  const look = () => {
    const now = performance.now() - start
    if (!answered && card.ariaBusy === 'false') answered = now
    if (answered && draws >= renders.length) {
      requestAnimationFrame(() => requestAnimationFrame(() => {
        for (const name of renders) window.page.pictures.all[name].fill = original[name]
        done([answered, performance.now() - start, draws / Math.max(renders.length, 1)])
      }))
    }
    else if (now > 20000) failed('no answer')
    else setTimeout(look, 2)
  }
  look()
})
"""


def waits(page: Page, name: str, values: list[str]) -> np.ndarray:
    """Return the times to the answer and to its picture, ms, and the number of draws, one row per value."""
    rows = []
    for value in values:
        rows.append(page.evaluate(WATCH, [name, value]))
        # One exposure is drawn in the background after each change.
        page.wait_for_timeout(700)
    return np.array(rows)


def first_load(browser: Browser, address: str) -> tuple[float, float, float]:
    """Return the times to a new visitor's first answer and first picture, s, and the megabytes sent."""
    page = browser.new_context().new_page()
    sent = 0.0

    def count(event: dict[str, float]) -> None:
        nonlocal sent
        sent += event["encodedDataLength"]

    session = page.context.new_cdp_session(page)
    session.send("Network.enable")
    session.on("Network.loadingFinished", count)
    start = time.perf_counter()
    page.goto(address)
    page.locator("#card[aria-busy=false]").wait_for(state="attached")
    answered = time.perf_counter() - start
    page.locator(".pictures:not(.dim) canvas").first.wait_for()
    drawn = time.perf_counter() - start
    page.context.close()
    return answered, drawn, sent / 1e6


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "page.ecsv")
    output = parser.parse_args().output
    rows = []
    with page_server() as (host, _):
        address = f"http://{host}/"
        with sync_playwright() as play:
            browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            loads = np.array([first_load(browser, address) for _ in range(5)])
            load_s, load_drawn_s, load_mb = np.median(loads, axis=0)
            print(f"first load: answer {load_s:.2f} s, pictures {load_drawn_s:.2f} s, {load_mb:.3f} MB", flush=True)
            page = browser.new_page()
            page.goto(address)
            page.locator("#card[aria-busy=false]").wait_for(state="attached")
            page.get_by_text("Advanced", exact=True).click()
            for tab, statistic in CASES:
                page.locator(f"#tab-{tab}").click()
                page.locator("#f-statistic").select_option(statistic)
                page.wait_for_timeout(1000)
                for name, (low, high) in FIELDS.items():
                    given = [f"{x:.4f}" for x in np.linspace(low, high, CHANGES + 2)]
                    answer, drawn, times = np.median(waits(page, name, given)[2:], axis=0) / (1e3, 1e3, 1)
                    rows.append((tab, statistic, name, round(answer, 3), round(drawn, 3), times))
                    print(f"{tab:12s} {statistic:14s} {name:18s} {answer:.3f} s, drawn {drawn:.3f} s", flush=True)
            browser.close()
    table = Table(rows=rows, names=("tab", "statistic", "changed", "answer (s)", "drawn (s)", "times drawn"))
    table.meta["what"] = (
        f"medians of {CHANGES} changes; server and browser on the same two cores; a first load has its answer after "
        f"{load_s:.2f} s, its pictures after {load_drawn_s:.2f} s, and {load_mb:.2f} MB (medians of 5)"
    )
    table.write(output, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
