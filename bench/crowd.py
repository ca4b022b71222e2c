"""What visitors of the page wait for when there are many, and what a page and an answer cost the server.

python bench/crowd.py [--visitors 1 30 50] [--changes 10] [--bombs] [--output bench/results/crowd.ecsv]

Visitors are websockets on this machine's own loopback that speak as the page's browser does; each loads the page, then
changes the magnitude once a second and waits for the answer. With ``--bombs`` one more uploads files that unpack to
much, one after the other.
"""

from __future__ import annotations

import argparse
import asyncio
import bz2
import json
import os
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from page_server import page_server
from tornado.httpclient import AsyncHTTPClient, HTTPRequest
from tornado.websocket import websocket_connect

#: Seconds without an answer that end a visit.
PATIENCE = 60.0


class Visitor:
    """One visitor's connection."""

    def __init__(self, host: str) -> None:
        self._host, self._n = host, 0

    async def come(self) -> None:
        """Load the page as a browser without anything of it does, and have the first answer with its pictures."""
        client = AsyncHTTPClient(max_clients=100)
        html = (await client.fetch(f"http://{self._host}/", request_timeout=PATIENCE)).body.decode()
        for part in re.findall(r'(?:src|href)="((?:assets|favicon)[^"]+)"', html):
            await client.fetch(f"http://{self._host}/{part}", request_timeout=PATIENCE)
        request = HTTPRequest(
            f"ws://{self._host}/live", request_timeout=PATIENCE, headers={"Origin": f"http://{self._host}"}
        )
        self._socket = await websocket_connect(request, max_message_size=2**26)
        await self._message()
        await self.change(8.5)

    async def _message(self) -> dict[str, Any]:
        got = await asyncio.wait_for(self._socket.read_message(), PATIENCE)
        if got is None:
            raise ConnectionError("the server has closed the connection")
        return dict(json.loads(got))

    async def _ask(self, what: str, **more: Any) -> int:
        self._n += 1
        await self._socket.write_message(json.dumps({"ask": what, "n": self._n} | more))
        return self._n

    async def change(self, magnitude: float) -> float:
        """Return the time from a change to its answer, s; pictures and a drawn exposure follow, as in a browser."""
        start, link = time.perf_counter(), f"?magnitude={magnitude:.4f}"
        n = await self._ask("answer", link=link, tab="detection")
        answered = 0.0
        while True:
            reported = await self._message()
            if reported.get("n") != n:
                continue
            if "answer" in reported:
                answered = time.perf_counter() - start
            elif "pictures" in reported:
                return answered
            elif "refused" in reported or reported.get("faults"):
                raise RuntimeError(str(reported))

    async def draw(self, magnitude: float) -> None:
        """Draw one exposure, half a second after the last change."""
        await self._ask("draw", link=f"?magnitude={magnitude:.4f}", tab="detection")

    async def upload(self, name: str, content: bytes) -> None:
        """Send a file; what comes back is read and left."""
        await self._ask("upload", field="star", name=name)
        await self._socket.write_message(content, binary=True)
        await asyncio.sleep(1.0)


async def visit(visitor: Visitor, number: int, changes: int, start: float) -> list[float]:
    """Measure the waits of one visitor who changes something once a second."""
    waits = []
    for i in range(changes):
        await asyncio.sleep(max(0.0, start + i + (number * 0.618) % 1.0 - time.perf_counter()))
        magnitude = 7.5 + 0.01 * i + 0.0001 * number
        waits.append(await visitor.change(magnitude))
        await asyncio.sleep(0.5)
        await visitor.draw(magnitude)
    return waits


async def bombs(visitor: Visitor, until: asyncio.Event) -> int:
    """Upload files that unpack to large sizes."""
    content, sent = bz2.compress(bytes(2**30)), 0
    while not until.is_set():
        await visitor.upload(f"star{sent}.fits", content)
        sent += 1
    return sent


def spent(process: int) -> float:
    """Return the processor time of a process and its ended children, s."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


async def measure(host: str, process: int, visitors: int, changes: int, with_bombs: bool) -> dict[str, float]:
    """Run all visits and return their times."""
    first = Visitor(host)
    await first.come()
    before = spent(process)
    crowd = [Visitor(host) for _ in range(visitors)]
    for visitor in crowd:
        await visitor.come()
    page_s = (spent(process) - before) / visitors
    await asyncio.sleep(2.0)
    over = asyncio.Event()
    other = asyncio.create_task(bombs(first, over)) if with_bombs else None
    before, start = spent(process), time.perf_counter() + 0.5
    found = await asyncio.gather(*(visit(v, i, changes, start) for i, v in enumerate(crowd)))
    answer_s = (spent(process) - before) / (visitors * changes)
    over.set()
    waits = np.concatenate(found)
    return {
        "visitors": visitors,
        "uploads": 0 if other is None else await other,
        "page_cpu_s": round(page_s, 3),
        "answer_cpu_s": round(answer_s, 4),
        "median_s": round(float(np.median(waits)), 3),
        "p95_s": round(float(np.quantile(waits, 0.95)), 3),
        "longest_s": round(float(waits.max()), 3),
    }


def main() -> None:
    """Print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--visitors", type=int, nargs="+", default=[1, 30, 50])
    parser.add_argument("--changes", type=int, default=10)
    parser.add_argument("--bombs", action="store_true")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "crowd.ecsv")
    given = parser.parse_args()
    with page_server() as (host, process):
        rows = [
            asyncio.run(measure(host, process, visitors, given.changes, given.bombs)) for visitors in given.visitors
        ]
    table = Table(rows)
    table.meta["what"] = f"{given.changes} changes of each visitor, one a second; all on one machine"
    print(table)
    table.write(given.output, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
