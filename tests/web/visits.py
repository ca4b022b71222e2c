"""What visitors do with the page: servers, connections as the page's script makes them, and windows of Chromium."""

from __future__ import annotations

import asyncio
import base64
import io
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlencode

import numpy as np
from astropy.table import Table
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

T = TypeVar("T")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
#: Milliseconds: generous, for tests that share two cores.
PATIENCE = 90_000


class Server:
    """Server of the page in a process of its own, which can be ended and started again at the same address."""

    def __init__(
        self, log: Path, *more: str, program: str = "", address: str = "127.0.0.1", **environment: str
    ) -> None:
        self.log, self.environment = log, environment
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as free:
            free.bind((address, 0))
            self.port = free.getsockname()[1]
        self.host = f"[{address}]:{self.port}" if ":" in address else f"{address}:{self.port}"
        self.address = f"http://{self.host}/"
        words = ["-m", "mauvecl", "serve", "--address", address, "--port", str(self.port), *more]
        self.command = [sys.executable, *(["-c", program, address, str(self.port)] if program else words)]
        self.start()

    def start(self) -> None:
        with self.log.open("a") as out:
            before = self.log.stat().st_size
            self.process = subprocess.Popen(self.command, stdout=out, stderr=out, env=os.environ | self.environment)
        while "mauvecl serves at" not in self.log.read_text()[before:]:
            assert self.process.poll() is None, self.log.read_text()
            time.sleep(0.1)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(20)

    def end(self) -> None:
        """Check that the server has reported no fault: a visitor who leaves in mid-sentence is none."""
        self.kill()
        reported = self.log.read_text()
        for word in ("mauvecl.web", "Traceback", "Warning", "ERROR"):
            assert word not in reported, reported

    def memory(self) -> float:
        """Return the resident memory in MB."""
        (kib,) = re.findall(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{self.process.pid}/status").read_text())
        return int(kib) * 1024 / 1e6

    def spent(self, *, readers: bool = False) -> float:
        """Return the processor time of the server in s, or that of its processes that have read files."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        first = 13 if readers else 11
        return (int(fields[first]) + int(fields[first + 1])) / 100

    def visited(self, work: Callable[[Talk], Coroutine[Any, Any, T]]) -> T:
        """Return what becomes of a new visitor's talk with the server."""

        async def visit() -> T:
            talk = await self.talk()
            try:
                return await work(talk)
            finally:
                talk.end()

        return asyncio.run(asyncio.wait_for(visit(), 580))

    async def talk(self, **headers: str) -> Talk:
        """Return the connection of a new visitor, who has been greeted."""
        found = Talk(await self._connected({"Origin": f"http://{self.host}"} | headers))
        assert "hello" in await found.next()
        return found

    def _connected(self, headers: dict[str, str]) -> Any:
        return websocket_connect(HTTPRequest(f"ws://{self.host}/live", headers=headers, request_timeout=60))

    async def refuses_talk(self, **headers: str) -> int:
        """Return the status with which a connection is refused."""
        try:
            await self._connected(headers)
        except HTTPClientError as error:
            return error.code
        raise AssertionError("let in")

    async def got(self, path: str = "", **headers: str) -> tuple[int, str]:
        request = HTTPRequest(self.address + path, headers=headers, request_timeout=60)
        answer = await AsyncHTTPClient().fetch(request, raise_error=False)
        return answer.code, (answer.body or b"").decode(errors="replace")

    def words(self) -> dict[str, Any]:
        _, html = asyncio.run(self.got())
        (text,) = re.findall(r'<script[^>]*type="application/json"[^>]*>(.*?)</script>', html, re.DOTALL)
        return dict(json.loads(text))


def link(**entered: str) -> str:
    return "?" + urlencode(entered)


class Talk:
    """Connection of a visitor that sends what the page's script would."""

    def __init__(self, connection: Any) -> None:
        self.connection, self._n = connection, 0

    async def next(self) -> dict[str, Any]:
        message = await asyncio.wait_for(self.connection.read_message(), 300)
        assert message is not None, "the connection has ended"
        return dict(json.loads(message))

    async def say(self, what: str, **more: Any) -> int:
        """Ask, and return the number of the question."""
        self._n += 1
        await self.connection.write_message(json.dumps({"ask": what, "n": self._n} | more))
        return self._n

    async def ask(self, what: str, *until: str, **more: Any) -> dict[str, Any]:
        """Ask, and wait for a message of the answer that holds one of these words."""
        n = await self.say(what, **more)
        while True:
            reported = await self.next()
            if reported.get("n") == n and reported.keys() & {*until}:
                return reported

    async def answer(self, link: str = "", tab: str = "detection") -> dict[str, Any]:
        """Return the message with the faults, or with the card, to which that with the pictures is added."""
        reported = await self.ask("answer", "faults", link=link, tab=tab)
        if "answer" in reported:
            while "pictures" not in (drawn := await self.next()):
                assert "refused" not in drawn, drawn
            assert drawn["tab"] == tab
            reported |= drawn
        return reported

    async def faults(self, link: str, tab: str = "detection") -> dict[str, str]:
        return dict((await self.ask("answer", "faults", link=link, tab=tab))["faults"])

    async def chances(self, link: str) -> list[float]:
        return [one["value"] for one in (await self.answer(link))["answer"]["numbers"]]

    async def solved(self, link: str) -> tuple[str, str]:
        """Return the sentences on the chances of other payloads, and on the limit."""
        payloads = (await self.ask("solve", "payloads", link=link))["payloads"]
        return payloads, (await self.next())["solved"]

    async def upload(
        self, content: bytes, field: str = "star", name: str = "star.txt", link: str = ""
    ) -> dict[str, Any]:
        n = await self.say("upload", field=field, name=name, link=link)
        await self.connection.write_message(content, binary=True)
        while (reported := await self.next()).get("n") != n:
            pass
        return reported

    async def file(self, **which: str) -> tuple[str, bytes]:
        reported = await self.ask("file", "file", "refused", **which)
        assert reported["file"], reported
        return reported["file"], await asyncio.wait_for(self.connection.read_message(), 60)

    async def table(self, link: str, tab: str, name: str) -> Table:
        _, content = await self.file(link=link, tab=tab, name=name, ending="ecsv")
        assert b"mauvecl-page" not in content, "nothing names a folder of the server"
        return Table.read(content.decode(), format="ascii.ecsv")

    async def simulate(self, kind: str, link: str) -> str:
        """Simulate to the end, and return what is reported of it."""
        return str((await self.ask("simulate", "ended", kind=kind, link=link))["ended"])

    async def exported(self, link: str = "", tab: str = "detection") -> dict[str, dict[str, str]]:
        """Return commands and programs by question."""
        reported = await self.ask("export", "taken", "refused", link=link, tab=tab)
        return {one["question"]: one for one in reported["taken"]}

    async def ended(self) -> tuple[int, str]:
        """Wait until the server ends the connection, and return code and reason."""
        while await asyncio.wait_for(self.connection.read_message(), 30) is not None:
            pass
        return self.connection.close_code, str(self.connection.close_reason)

    def end(self) -> None:
        self.connection.close()


def column(drawn: dict[str, Any], picture: str, source: str, name: str) -> Any:
    packed = drawn["pictures"][picture]["sources"][source][name]
    if not isinstance(packed, dict):
        return packed
    return np.frombuffer(base64.b64decode(packed["f4"]), "<f4").reshape(packed["shape"])


class Window:
    """Window of Chromium with a visitor's page and its first answer; what it lacks is playwright's, of the page."""

    def __init__(self, browser: Browser, address: str, **how: Any) -> None:
        self.page: Page = browser.new_context(**how).new_page()
        self.page.set_default_timeout(PATIENCE)
        self.faults: list[str] = []
        self.on("pageerror", lambda error: self.faults.append(str(error)))
        # A browser says of a connection that it is lost; nothing else stands in its console.
        self.on("console", lambda m: None if "WebSocket" in m.text else self.faults.append(f"{m.type}: {m.text}"))
        self.goto(address)
        self.settled()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.page, name)

    def until(self, true: Callable[[], bool]) -> None:
        for _ in range(PATIENCE // 50):
            if true():
                return
            self.wait_for_timeout(50)
        raise AssertionError("never true")

    def settled(self) -> None:
        self.locator("#card[aria-busy=false]").wait_for(state="attached")
        assert not self.faults, self.faults

    def shown(self) -> str:
        """Return the answer in the words of the card: a sentence, and both chances."""
        self.settled()
        return "\n".join(self.locator("#card :is(.message, .words)").all_inner_texts())

    def says(self, words: str) -> None:
        self.until(lambda: words in self.shown())

    def field(self, label: str) -> Locator:
        return self.page.get_by_label(label, exact=True)

    def button(self, name: str, within: str = "body") -> Locator:
        return self.page.locator(within).get_by_role("button", name=name, exact=True)

    def press(self, name: str, within: str = "body") -> None:
        self.button(name, within).click()
        self.settled()

    def tab(self, name: str) -> None:
        self.get_by_role("tab", name=name, exact=True).click()

    def tabs(self) -> list[str]:
        return [str(one.get_attribute("id")).removeprefix("tab-") for one in self.get_by_role("tab").all()]

    def enter(self, **texts: str) -> None:
        """Open what is folded, enter the texts of fields by name, and wait for what comes of each."""
        for name, text in texts.items():
            field = self.locator(f"#f-{name}")
            if not field.is_visible():
                self.get_by_text("Advanced", exact=True).click()
            if field.evaluate("e => e.tagName") == "SELECT":
                field.select_option(text)
            else:
                field.fill(text)
                field.press("Enter")
            self.settled()

    def simulate(self, name: str = "Simulate") -> str:
        self.button(name).click()
        self.get_by_text("Done: ").wait_for()
        return self.shown()

    def download(self, label: str, within: str = "body") -> bytes:
        with self.expect_download() as coming:
            self.button(label, within).click()
        return Path(coming.value.path()).read_bytes()

    @contextmanager
    def exporting(self) -> Iterator[None]:
        self.button("Share, export, cite").click()
        self.locator("#export[open]").wait_for()
        yield
        self.keyboard.press("Escape")

    def taken(self) -> dict[str, str]:
        """Return the files of the downloaded study by name."""
        with self.exporting(), zipfile.ZipFile(io.BytesIO(self.download("Study for the command line"))) as archive:
            return {name: archive.read(name).decode() for name in archive.namelist()}

    def give(self, name: str, content: bytes | str, file: str = "mine.txt") -> None:
        """Choose a file for a field, or for the input of a selector."""
        content = content.encode() if isinstance(content, str) else content
        given: Any = {"name": file, "mimeType": "text/plain", "buffer": content}
        self.locator(name if name.startswith("#") else f"[data-upload={name}]").set_input_files(given)

    def answerless(self) -> None:
        self.get_by_text("No answer.", exact=True).wait_for()
        buttons = [self.button("Simulate"), self.button("Pin"), *self.locator("[data-file]").all()]
        assert all(one.is_disabled() for one in buttons)
        assert self.locator(".pictures.dim").count() == self.locator(".pictures").count()

    def ranges(self, picture: str) -> list[float]:
        plot = f"page.pictures.all.{picture}.figure.plot"
        return list(self.evaluate(f"[{plot}.x_range, {plot}.y_range].flatMap(range => [range.start, range.end])"))

    def settled_ranges(self, picture: str) -> list[float]:
        """Return the ends of a picture's axes once it is drawn."""
        self.until(lambda: self.evaluate(f"page.pictures.all.{picture}.figure?.view?.has_finished() ?? false"))
        return self.ranges(picture)

    def centre(self, picture: str, x: float, y: float) -> tuple[float, float]:
        """Scroll to a picture, and return a point of it by parts of its width and height."""
        plot = self.locator(f"#plot-{picture}")
        plot.scroll_into_view_if_needed()
        box = plot.bounding_box()
        return box["x"] + x * box["width"], box["y"] + y * box["height"]

    def script(self, name: str, given: Any = None) -> Any:
        return self.evaluate((Path(__file__).parent / "scripts" / f"{name}.js").read_text(encoding="utf-8"), given)
