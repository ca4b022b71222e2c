"""Folders of visitors end with their server, however it ends."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

pytest.importorskip("bokeh")

from tornado.httpclient import HTTPRequest
from tornado.websocket import websocket_connect

from mauvecl.web import folders

pytestmark = pytest.mark.long


def test_folders_end_with_their_server(tmp_path: Path) -> None:
    """Ctrl-C and SIGTERM remove them amid a simulation, without errors; the next start, those of a killed server."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    command = [sys.executable, "-m", "mauvecl", "serve", "--port", str(port)]

    def left(end: signal.Signals) -> int:
        """Serve a visitor who stays, end the server by a signal, and return the number of folders that are left."""

        async def visit() -> None:
            request = HTTPRequest(f"ws://127.0.0.1:{port}/live", headers={"Origin": f"http://127.0.0.1:{port}"})
            connection = await websocket_connect(request)
            assert await connection.read_message() is not None
            assert len(list(tmp_path.glob(f"{folders.PREFIX}*/*/"))) == 1
            asked = {"n": 1, "link": "?realisations=4000000"}
            await connection.write_message(json.dumps(asked | {"ask": "simulate", "kind": "detection"}))
            started = json.loads(await asyncio.wait_for(connection.read_message(), 60))
            assert "progress" in started, started
            for magnitude in range(6, 12):
                link = f"?magnitude={magnitude}"
                await connection.write_message(json.dumps({"ask": "answer", "n": 2, "link": link, "tab": "detection"}))
            server.send_signal(end)
            await asyncio.to_thread(server.wait, 60)

        pipe = subprocess.PIPE
        with subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True) as server:
            assert server.stdout is not None
            assert server.stderr is not None
            assert "serves at" in server.stdout.readline()
            asyncio.run(visit())
            log = server.stderr.read()
        assert not re.search("ERROR|Traceback|note:", log), log
        return len(list(tmp_path.glob(f"{folders.PREFIX}*")))

    assert left(signal.SIGTERM) == 0
    assert left(signal.SIGKILL) == 1, "nothing can clean up after this"
    assert left(signal.SIGINT) == 0, "nor is the folder of the killed one left"


def test_folder_of_a_running_server_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folders.tempfile, "gettempdir", lambda: str(tmp_path))
    for name in ("running", "killed"):
        (tmp_path / f"{folders.PREFIX}{name}").mkdir()
    with (tmp_path / f"{folders.PREFIX}running" / folders.LOCK).open("wb") as lock:
        assert folders._locked(lock)
        (tmp_path / f"{folders.PREFIX}killed" / folders.LOCK).touch()
        folders.remove_abandoned()
        assert [path.name for path in tmp_path.iterdir()] == [f"{folders.PREFIX}running"]


def test_content_is_written_once_and_whole(tmp_path: Path) -> None:
    """Two threads that write the same content get one folder, with whatever either of them wrote in full."""
    filled: list[Path] = []
    both = threading.Barrier(2)

    def fill(new: Path) -> None:
        both.wait(20.0)
        (new / "a.txt").write_text("content")
        filled.append(new)

    with ThreadPoolExecutor(2) as threads:
        first, second = threads.map(lambda _: folders.content_folder(tmp_path, b"content", fill), range(2))
    assert first == second
    assert (first / "a.txt").read_text() == "content"
    assert folders.content_folder(tmp_path, b"content", fill) == first
    assert len(filled) == 2
    assert folders.content_folder(tmp_path, b"other", lambda new: (new / "b.txt").touch()) != first
