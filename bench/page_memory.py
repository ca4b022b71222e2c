"""How the server's memory grows while visitors come, plan, search stares, and leave.

python bench/page_memory.py [--sessions 50] [--minutes 30] [--output bench/results/page_memory.ecsv]

Sessions start evenly over the time. Each asks for every tab at some magnitudes, runs a plan and a search of a stare of
its own star, and leaves. Memory is that of the server's process, after its start and after each session.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import time
from pathlib import Path
from typing import Any

from astropy.table import Table
from page_server import page_server
from tornado.httpclient import HTTPRequest
from tornado.websocket import websocket_connect

#: Seconds without a message that end a session.
PATIENCE = 600.0
TABS = ("detection", "spectrum", "snr", "noise", "limit", "measure", "unknowns")
TARGETS = ("AU Mic", "eps Eri", "Proxima Cen", "EV Lac", "AD Leo", "YZ CMi")


def resident_mib(process: int) -> float:
    """Return the resident memory of a process, MiB."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


async def session(host: str, number: int) -> None:
    """Run one visitor's session from coming to leaving."""
    request = HTTPRequest(f"ws://{host}/live", headers={"Origin": f"http://{host}"})
    socket_ = await websocket_connect(request, max_message_size=2**26)
    n = 0

    async def ask(done: Any, **what: Any) -> None:
        nonlocal n
        n += 1
        await socket_.write_message(json.dumps({"n": n} | what))
        while True:
            got = await asyncio.wait_for(socket_.read_message(), PATIENCE)
            if got is None:
                raise ConnectionError("the server has closed the connection")
            reported = json.loads(got) if isinstance(got, str) else {}
            if reported.get("n") != n:
                continue
            if reported.get("refused") or reported.get("faults"):
                raise RuntimeError(str(reported))
            if done in reported:
                return

    target = TARGETS[number % len(TARGETS)]
    for step, tab in enumerate(TABS):
        link = f"?magnitude={8 + 0.01 * number + 0.1 * step:.2f}&exposure_s={50 + 5 * number}"
        await ask("pictures", ask="answer", link=link, tab=tab)
    link = f"?star=M3V&targets={target.replace(' ', '+')}&magnitude={8 + 0.01 * number:.2f}"
    for kind in ("plan", "completeness"):
        await ask("ended", ask="simulate", link=link, kind=kind)
        await ask("pictures", ask="answer", link=link, tab=kind)
    socket_.close()


async def visits(host: str, process: int, sessions: int, minutes: float) -> list[dict[str, float]]:
    """Run all sessions and return the memory after each."""
    start = time.monotonic()
    rows = [{"sessions": 0, "minutes": 0.0, "resident_mib": round(resident_mib(process), 1)}]

    async def one(number: int) -> None:
        await asyncio.sleep(max(0.0, start + 60 * minutes * number / sessions - time.monotonic()))
        await session(host, number)
        minute = (time.monotonic() - start) / 60
        rows.append(
            {"sessions": len(rows), "minutes": round(minute, 2), "resident_mib": round(resident_mib(process), 1)}
        )
        print(rows[-1], flush=True)

    await asyncio.gather(*(one(number) for number in range(sessions)))
    return rows


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=50)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "page_memory.ecsv")
    given = parser.parse_args()
    with page_server() as (host, process):
        rows = asyncio.run(visits(host, process, given.sessions, given.minutes))
    table = Table(rows)
    table.meta["what"] = (
        f"{given.sessions} sessions in {given.minutes:g} minutes, each with a plan and a search of a stare"
    )
    print(table)
    table.write(given.output, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
