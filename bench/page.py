"""What a visitor of the page waits for after a change, in a real Chromium on the same machine.

python bench/page.py [--output bench/results/page.ecsv]
"""

from __future__ import annotations

import argparse
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from astropy.table import Table
from playwright.sync_api import Page, sync_playwright

from mauvecl.statistics.registry import STATISTICS

CHANGES = 11
#: What is changed, and what from and to; each change is another value between.
FIELDS = {"Flare amplitude, %": (0.3, 0.9), "Magnitude of the star": (7.5, 9.0)}
#: Tab in front, and statistic asked for.
CASES = (
    ("Simulated observation", "matched"),
    ("Noise budget", "matched"),
    *(("Flare detection", statistic) for statistic in STATISTICS),
)

#: Milliseconds from a field's own event of a change to another text of the answer, and to the next picture.
WATCH = """
([label, value]) => new Promise((done, failed) => {
  const everywhere = root => [...root.querySelectorAll('*')].flatMap(
    e => e.shadowRoot ? [e, ...everywhere(e.shadowRoot)] : [e])
  const field = everywhere(document).find(e => e.tagName === 'INPUT' && e.labels?.[0]?.innerText.trim() === label)
  const seen = () => everywhere(document).filter(e => e.tagName === 'B').map(e => e.parentElement.innerText).join()
  const before = seen(), start = performance.now()
  field.value = value
  field.dispatchEvent(new Event('change', {bubbles: true}))
  const look = () => {
    const now = performance.now() - start
    if (seen() !== before) {
      requestAnimationFrame(() => requestAnimationFrame(() => done([now, performance.now() - start])))
    }
    else if (now > 20000) failed('no answer')
    else setTimeout(look, 5)
  }
  look()
})
"""


def waits(page: Page, label: str, values: list[str]) -> np.ndarray:
    """Milliseconds to the answer and to its picture, one row per value."""
    rows = []
    for value in values:
        rows.append(page.evaluate(WATCH, [label, value]))
        # One spectrum is drawn in the background after each change.
        page.wait_for_timeout(1200)
    return np.array(rows)


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "page.ecsv")
    output = parser.parse_args().output
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen(
        [sys.executable, "-m", "mauvecl", "serve", "--port", str(port)], stdout=subprocess.PIPE, text=True
    )
    rows = []
    try:
        assert server.stdout is not None
        while "serves at" not in server.stdout.readline():
            time.sleep(0.1)
        with sync_playwright() as play:
            browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            page = browser.new_page()
            page.goto(f"http://127.0.0.1:{port}/")
            page.get_by_text("of such flares are detected").wait_for()
            page.wait_for_timeout(5000)
            for tab, statistic in CASES:
                page.get_by_text(tab, exact=True).first.click()
                page.get_by_label("Detection statistic").select_option(statistic)
                page.wait_for_timeout(2000)
                for label, (low, high) in FIELDS.items():
                    if statistic != "matched" and label != "Magnitude of the star":
                        # So faint a flare does not move the others' answer.
                        continue
                    given = [f"{x:.4f}" for x in np.linspace(low, high, CHANGES + 2)]
                    answer, drawn = np.median(waits(page, label, given)[2:], axis=0) / 1e3
                    rows.append((tab, statistic, label, round(answer, 3), round(drawn, 3)))
                    print(f"{tab:24s} {statistic:14s} {label:24s} {answer:.3f} s, drawn {drawn:.3f} s", flush=True)
            browser.close()
    finally:
        server.terminate()
    table = Table(rows=rows, names=("tab", "statistic", "changed", "answer (s)", "drawn (s)"))
    table.meta["what"] = f"medians of {CHANGES} changes; server and browser on the same two cores"
    table.write(output, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
