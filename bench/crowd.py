"""What visitors of the page wait for when there are many, and what a page and an answer cost the server.

python bench/crowd.py [--visitors 50] [--changes 10] [--bombs] [--output bench/results/crowd.ecsv]

Visitors are websockets on this machine's own loopback that speak as the page's browser does; each loads the page, then
changes the magnitude once a second and waits for the answer. With ``--bombs`` one more uploads files that unpack to
much, one after the other.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import bz2
import json
import os
import re
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from tornado.httpclient import AsyncHTTPClient, HTTPRequest
from tornado.websocket import websocket_connect

#: Seconds without an answer that end a visit.
PATIENCE = 60.0


class Visitor:
    """One visitor's connection."""

    def __init__(self, host: str) -> None:
        self._host = host

    async def come(self) -> None:
        """Load the page: its frame, then its document."""
        answer = await AsyncHTTPClient(max_clients=100).fetch(f"http://{self._host}/", request_timeout=PATIENCE)
        token = re.search(r'"token":"([^"]+)"', answer.body.decode())
        assert token is not None
        request = HTTPRequest(
            f"ws://{self._host}/ws", request_timeout=PATIENCE, headers={"Origin": f"http://{self._host}"}
        )
        self._socket = await websocket_connect(request, subprotocols=["bokeh", token[1]], max_message_size=2**26)
        await self._message()
        await self._send("PULL-DOC-REQ", {})
        while "doc" not in (content := await self._message()):
            pass
        text = json.dumps(content)
        ready = {"type": "event", "name": "document_ready", "values": {"type": "map", "entries": []}}
        await self._send(
            "PATCH-DOC", {"events": [{"kind": "MessageSent", "msg_type": "bokeh_event", "msg_data": ready}]}
        )
        self._field = self._model("TextInput", text[: text.index('"Magnitude of the star"')])
        self._file = self._model("FileInput", text)
        self._summary = self._model("Div", text[: text.index("of such flares are detected")])

    def _model(self, kind: str, text: str) -> str:
        """The id of the last model of a kind in a text."""
        return str(re.findall(rf'"name": "[^"]*{kind}", "id": "([^"]+)"', text)[-1])

    async def _message(self) -> dict[str, Any]:
        """The content of the next message."""

        async def fragment() -> str:
            got = await asyncio.wait_for(self._socket.read_message(), PATIENCE)
            if got is None:
                raise ConnectionError("the server has closed the connection")
            return str(got)

        header = json.loads(await fragment())
        await fragment()
        content = await fragment()
        for _ in range(2 * header.get("num_buffers", 0)):
            await fragment()
        return dict(json.loads(content))

    async def _send(self, kind: str, content: Any) -> None:
        for part in ({"msgid": os.urandom(8).hex(), "msgtype": kind}, {}, content):
            await self._socket.write_message(json.dumps(part))

    async def _set(self, model: str, **values: Any) -> None:
        events = [{"kind": "ModelChanged", "model": {"id": model}, "attr": k, "new": v} for k, v in values.items()]
        await self._send("PATCH-DOC", {"events": events})

    async def change(self, magnitude: float) -> float:
        """Seconds from a change to its answer."""
        start = time.perf_counter()
        await self._set(self._field, value=f"{magnitude:.4f}")
        while True:
            for event in (await self._message()).get("events", ()):
                if event.get("model", {}).get("id") == self._summary and event.get("attr") == "text":
                    return time.perf_counter() - start

    async def upload(self, name: str, content: bytes) -> None:
        """Send a file; what comes back is read and left."""
        await self._set(self._file, value=base64.b64encode(content).decode(), mime_type="", filename=name)
        await asyncio.sleep(1.0)


async def visit(visitor: Visitor, number: int, changes: int, start: float) -> list[float]:
    """Waits of one visitor who changes something once a second."""
    waits = []
    for i in range(changes):
        await asyncio.sleep(max(0.0, start + i + (number * 0.618) % 1.0 - time.perf_counter()))
        waits.append(await visitor.change(7.5 + 0.01 * i + 0.0001 * number))
    return waits


async def bombs(visitor: Visitor, until: asyncio.Event) -> int:
    """Uploads of files that unpack to much."""
    content, sent = bz2.compress(bytes(2**30)), 0
    while not until.is_set():
        await visitor.upload(f"star{sent}.fits", content)
        sent += 1
    return sent


def spent(process: int) -> float:
    """Seconds of processor time of a process and the children that it has ended."""
    fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


async def measure(host: str, process: int, visitors: int, changes: int, with_bombs: bool) -> dict[str, float]:
    """All visits."""
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
    parser.add_argument("--visitors", type=int, default=50)
    parser.add_argument("--changes", type=int, default=10)
    parser.add_argument("--bombs", action="store_true")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "crowd.ecsv")
    given = parser.parse_args()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen(
        [sys.executable, "-m", "mauvecl", "serve", "--port", str(port)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert server.stdout is not None
        while "serves at" not in server.stdout.readline():
            time.sleep(0.1)
        rows = [
            asyncio.run(measure(f"127.0.0.1:{port}", server.pid, visitors, given.changes, given.bombs))
            for visitors in sorted({1, given.visitors})
        ]
    finally:
        server.terminate()
    table = Table(rows)
    table.meta["what"] = f"{given.changes} changes of each visitor, one a second; all on one machine"
    print(table)
    table.write(given.output, format="ascii.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
