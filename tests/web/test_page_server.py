"""The page without a browser: its state, who is let in, and what its server makes of nonsense."""

from __future__ import annotations

import asyncio
import bz2
import gzip
import io
import json
import logging
import lzma
import re
import resource
import socket
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("panel")

from bokeh.document import Document
from bokeh.io.doc import patch_curdoc
from bokeh.util.token import generate_jwt_token
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

from mauvecl.host.errors import InputError
from mauvecl.runs.pool import Pool
from mauvecl.study.study import Study
from mauvecl.web import doors, page, server
from mauvecl.web.asked import detect_and_snr
from mauvecl.web.fields import FIELDS, star_names
from mauvecl.web.plain_log import Plain
from mauvecl.web.state import State
from mauvecl.web.upload import MOST_UPLOADED, read_upload
from mauvecl.web.words import alerts
from mauvecl.web.work import reading

NUMBERS = [name for name, field in FIELDS.items() if hasattr(field.read, "low")]
HOSTILE = "![x](http://127.0.0.1:1/x.png) <img src=http://127.0.0.1:1/y.png>"


# What is entered


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize(
    "text", ["", " ", "7,4", "1e999", "nan", "inf", "-inf", "seven", "1_0", "0x10", "٣", "1e400000"]
)
def test_no_number_is_guessed(name: str, text: str) -> None:
    state = State()
    state.enter({name: text})
    assert re.search(r"expected a (whole )?number from \S+ to \S+", state.faults[name]), "what it accepts"
    assert state.entered[name] == text, "what stands there stays"
    with pytest.raises(InputError, match=re.escape(FIELDS[name].label)):
        state.question()
    state.enter({name: FIELDS[name].first})
    assert not state.faults
    state.question()


@pytest.mark.parametrize("name", NUMBERS)
def test_ranges_end_where_they_say(name: str) -> None:
    read: Any = FIELDS[name].read
    for end in (read.low, read.high):
        assert read(f"{end:.17g}") == end
    for beyond in (read.low - 1, 2 * read.high + 1):
        with pytest.raises(InputError, match="out of range"):
            read(f"{beyond:.15g}")


def test_stars_by_any_name_they_have() -> None:
    state = State()
    for given, library in (
        ("GJ 581", "M3V"),
        ("hd 40307", "K2.5V"),
        ("K3V", "K2.5V"),
        ("m3v", "M3V"),
        ("vega", "Vega"),
    ):
        state.enter({"star": given})
        assert state.question().star == library
    assert [name for name in star_names() if "HD" in name] == ["HD 40307", "HD 85512"]
    for name in star_names():
        state.enter({"star": name})
        assert not state.faults, name
    state.enter({"star": "Proxima"})
    assert "Proxima" in state.faults["star"]


def test_a_link_is_what_was_entered_right_or_wrong() -> None:
    first, second = State(), State()
    first.enter(
        {"magnitude": "7,4", "star": HOSTILE, "tab": "noise", "simulated": "detection,map", "target": "1 & 2=3"}
    )
    second.follow(first.link)
    assert (second.entered, second.faults) == (first.entered, first.faults)
    assert (second.tab, second.simulated) == ("noise", ("detection", "map"))
    second.follow("?magnitude=8")
    assert second.entered == State().entered | {"magnitude": "8"}, "what it does not hold stands as at first"
    second.follow("?magnitud=8&tab=x")
    assert "magnitud" in second.stray
    assert "tab" in second.stray
    second.question()
    second.follow("?star=" + "G" * 10_000)
    assert "more than" in second.stray
    second.enter({"star": "G" * 10**6})
    assert len(second.link) < 10_000


def test_hosts_text_stays_text() -> None:
    shown = alerts([(HOSTILE, "danger")])
    assert "<img" not in shown
    assert "![x](http://127.0.0.1:1/x.png)" in shown


# Answers


def star_file(path: Path) -> bytes:
    wavelength = np.linspace(170.0, 1000.0, 400)
    np.savetxt(path, np.transpose([wavelength, 1e-12 * np.exp(-(((wavelength - 500) / 150) ** 2))]))
    return path.read_bytes()


def alone(link: str = "") -> page.Page:
    """A page of no session: servers of other tests may have left theirs as the current document."""
    with patch_curdoc(Document()):
        return page.Page(link)


def settled(found: page.Page) -> page.Page:
    """Once its upload is read."""
    reading(lambda name, content: None, "", b"").result()
    return found


def answerless(found: page.Page) -> bool:
    return (
        found.quiet is None
        and "No answer" in found.summary.text
        and found.run.disabled
        and found.tabs.whole.styles.get("opacity") == "0.25"
    )


@pytest.mark.long
def test_an_upload_that_fails_in_any_way_leaves_no_answer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    good = star_file(tmp_path / "star.txt")
    found = alone()
    for fault in (
        InputError("no spectrum"),
        RuntimeError("odd"),
        MemoryError(),
        ValueError("unequal columns"),
        KeyError(1),
    ):
        assert found.quiet is not None

        def fail(name: str, content: bytes, fault: Exception = fault) -> None:
            raise fault

        monkeypatch.setattr(page, "read_upload", fail)
        found._upload("my ![star](http://x/y.png).txt", good)
        settled(found)
        assert answerless(found)
        assert found.state.entered["star"] == "", "no other star's name"
        assert found.state.faults["star"]
        assert "expected a question" in found.safely(lambda: found.file("snr", "ecsv")).read().decode()
        found.enter({"star": "G2V"})
        assert not answerless(found)
    monkeypatch.undo()
    for name, content in (
        ("a.txt", b""),
        ("a.txt", b"200 1\n300 2 3\n"),
        ("a.fits", b"SIMPLE  = " * 300),
    ):
        found._upload(name, content)
        assert answerless(settled(found)), name
    found._upload("a.exe", gzip.compress(good))
    assert not answerless(settled(found)), "what it is shows in its content"
    assert found.uploaded
    found._refused(50e6)
    assert answerless(found)
    assert "47.7 MiB" in found.state.faults["star"]


def test_answers_go_on_while_an_upload_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    wait = threading.Event()

    def slow(name: str, content: bytes) -> Any:
        assert wait.wait(60.0)
        raise InputError("no spectrum")

    monkeypatch.setattr(page, "read_upload", slow)
    first, other = alone(), alone()
    first._upload("star.txt", b"")
    assert "is being read" in first.state.faults["star"]
    # Would the event loop wait for the reader, it would wait for ever.
    other.enter({"magnitude": "8"})
    assert not answerless(other)
    wait.set()
    settled(first)
    assert first.state.faults["star"] == "no spectrum"


WIDE = (
    "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: w, datatype: float64}\n# meta:\n#   a0: &a0 [x, x, x, x, x, x, x, x]\n"
)
ALIASES = "".join(f"#   a{i}: &a{i} [{', '.join(8 * [f'*a{i - 1}'])}]\n" for i in range(1, 9))


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(bz2.compress(bytes(2**28)), id="bzip2 of zeros"),
        pytest.param(gzip.compress(gzip.compress(bytes(2**28))), id="gzip twice"),
        pytest.param(lzma.compress(bytes(2**27)), id="xz of zeros"),
        pytest.param(f"{WIDE}{ALIASES}w\n1\n".encode(), id="YAML aliases"),
        pytest.param(b"# %ECSV 1.0\n# ---\n# meta: " + b"[" * 200_000 + b"\n", id="deep YAML"),
        pytest.param(b'<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "b">]><VOTABLE>&a;</VOTABLE>', id="XML entities"),
    ],
)
def test_bombs_end_in_a_sentence_and_take_little(content: bytes) -> None:
    def spent() -> tuple[float, int]:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime, used.ru_maxrss

    before, most = spent()
    with pytest.raises(InputError, match=r", expected [^\n]*$"):
        read_upload("star.fits", content)
    # The clock's limit is the reader's own; processor time is the same on a busy machine, 3 s with the start of Python.
    assert spent()[0] - before < 10.0
    # The largest of all processes that these tests have started, in KiB; others may have been larger.
    assert spent()[1] <= max(most, 700 * 1024)


def test_a_star_chosen_while_an_upload_is_read_stays(tmp_path: Path) -> None:
    found = alone()
    found._upload("star.txt", star_file(tmp_path / "star.txt"))
    found.enter({"star": "Vega"})
    settled(found)
    assert found.state.entered["star"] == "Vega"
    assert not found.uploaded


def test_a_fault_of_our_own_leaves_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    found = alone()
    monkeypatch.setattr(page, "prepare", lambda *_, **__: 1 / 0)
    found.enter({"magnitude": "8"})
    assert answerless(found)
    monkeypatch.undo()
    found.enter({"magnitude": "9"})
    assert not answerless(found)


def test_an_uploaded_star_gives_the_same_bytes_on_the_command_line(tmp_path: Path) -> None:
    found = alone("?magnitude=8&realisations=10000&fap=0.01")
    found._upload("star.txt", star_file(tmp_path / "star.txt"))
    settled(found)
    study = found.study()
    found.found["detection"], found.found["snr"] = detect_and_snr(study, Pool())
    with zipfile.ZipFile(io.BytesIO(found.study_of().read())) as archive:
        archive.extractall(tmp_path / "study")
    assert 'file = "star.ecsv"' in (tmp_path / "study" / "study.toml").read_text()
    for verb, *flags in (["simulate", "-a", "0.24"], ["detect"], ["snr"]):
        command = [sys.executable, "-m", "mauvecl", verb, "study.toml", *flags, "--no-pictures", "--quiet", "-o", "out"]
        subprocess.run(command, cwd=tmp_path / "study", check=True, capture_output=True)
    for name, file in (
        ("observation", "observation-2.ecsv"),
        ("detection", "detection.ecsv"),
        ("roc", "roc.ecsv"),
        ("snr", "snr-element.ecsv"),
    ):
        mine = found.file(name, "ecsv").read()
        assert found._folder.name.encode() not in mine
        assert b"mauvecl-page" not in mine
        (written,) = (tmp_path / "study" / "out").glob(file)
        assert mine == written.read_bytes(), name
    # From another folder the table finds its star again, and no other file of that name.
    again = Study.read(tmp_path / "study" / "out" / "detection.ecsv")
    assert again.star[0].file == (tmp_path / "study" / "star.ecsv").resolve()
    (tmp_path / "study" / "star.ecsv").write_bytes(star_file(tmp_path / "other.txt"))
    with pytest.raises(InputError, match="is not there as it was"):
        Study.read(tmp_path / "study" / "out" / "detection.ecsv")


# Who is let in


def test_addresses_are_checked_before_anything_is_served() -> None:
    with pytest.raises(InputError, match="is empty"):
        doors.hosts("", 5006, [])
    with pytest.raises(InputError, match="expected --allow-origin"):
        doors.hosts("0.0.0.0", 5006, [])
    with pytest.raises(InputError, match="expected --allow-origin"):
        doors.hosts("::", 5006, [])
    with pytest.raises(InputError, match="unknown here"):
        doors.hosts("no such host", 5006, [])
    for wrong in ("*", "http://*", "", "a b", "https://x/path", "x:port", "x,y"):
        with pytest.raises(InputError, match="expected one host"):
            doors.hosts("0.0.0.0", 5006, [wrong])
    assert doors.hosts("127.0.0.1", 5006, []) == {"127.0.0.1:5006", "localhost:5006", "[::1]:5006"}
    assert doors.hosts("0.0.0.0", 5006, ["https://Mauve.example.org/"]) >= {"mauve.example.org"}
    assert "[::1]:80" not in doors.hosts("::1", 80, [])


@pytest.mark.parametrize("address", ["", "no such host", "0.0.0.0"])
def test_serve_refuses_an_address_in_a_sentence(address: str) -> None:
    command = [sys.executable, "-m", "mauvecl", "serve", "--address", address]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert re.fullmatch(r"mauvecl: --address '[^\n]*\n", done.stderr)


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A server that runs within a coroutine: called with one, it gives its outcome."""
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    async def all_of(work: Any, address: str) -> Any:
        made = server.make(address, port, [])
        made.start()
        try:
            return await work(f"{doors.netloc(address, port)}", made)
        finally:
            made.stop()
            made._http.stop()

    yield lambda work, address="127.0.0.1": loop.run_until_complete(asyncio.wait_for(all_of(work, address), 120))
    loop.close()
    asyncio.set_event_loop(None)


async def got(url: str, **headers: str) -> tuple[int, str]:
    try:
        answer = await AsyncHTTPClient().fetch(HTTPRequest(url, headers=headers, request_timeout=60))
    except HTTPClientError as error:
        return error.code, (error.response.body or b"").decode() if error.response else ""
    return answer.code, answer.body.decode(errors="replace")


async def opened(host: str, token: str, **headers: str) -> Any:
    return await websocket_connect(
        HTTPRequest(f"ws://{host}/ws", headers=headers, request_timeout=60), subprotocols=["bokeh", token]
    )


def token_of(html: str) -> str:
    found = re.search(r'"token":"([^"]+)"', html)
    assert found is not None
    return found[1]


def test_foreign_hosts_origins_and_tokens_are_refused(served: Any) -> None:
    async def work(host: str, made: Any) -> None:
        port = host.rsplit(":", 1)[1]
        for foreign in ("evil.example", f"evil.example:{port}", f"127.0.0.1.evil.example:{port}", "127.0.0.1:1"):
            assert (await got(f"http://{host}/", Host=foreign))[0] == 403
            assert (await got(f"http://{host}/static/js/bokeh.min.js", Host=foreign))[0] == 403
        for origin in ("http://evil.example", "null", "https://127.0.0.1:1", f"http://localhost.evil:{port}"):
            assert (await got(f"http://{host}/", Origin=origin))[0] == 403
        for query in ("bokeh-token=x", "bokeh-session-id=x", "bokeh-session-id=x&bokeh-token=y"):
            assert (await got(f"http://{host}/?{query}"))[0] == 403
        assert not made.get_sessions(), "nothing is made for them"
        code, html = await got(f"http://{host}/", Origin=f"http://localhost:{port}")
        assert code == 200
        token = token_of(html)
        forged = generate_jwt_token("another")  # type: ignore[arg-type]
        for bad in (forged, "x", "e30", token[:-3], "é"):
            with pytest.raises((HTTPClientError, UnicodeEncodeError)):
                await opened(host, bad)
        for headers in ({"Origin": "http://evil.example"}, {"Host": f"evil.example:{port}"}):
            with pytest.raises(HTTPClientError, match="403"):
                await opened(host, token, **headers)
        connection = await opened(host, token, Origin=f"http://{host}")
        assert "ACK" in await connection.read_message()
        connection.close()

    served(work)


def test_ipv6_is_served(served: Any) -> None:
    async def work(host: str, made: Any) -> None:
        code, html = await got(f"http://{host}/")
        assert code == 200
        connection = await opened(host, token_of(html), Origin=f"http://{host}")
        assert "ACK" in await connection.read_message()
        connection.close()

    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 here")
    served(work, "::1")


def test_so_many_visitors_and_no_more(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doors, "MOST_SESSIONS", 2)

    async def work(host: str, made: Any) -> None:
        (_, first), _ = [await got(f"http://{host}/") for _ in range(2)]
        code, told = await got(f"http://{host}/")
        assert (code, told) == (503, "Too many visitors are here at the moment; please come again in some minutes.\n")
        assert (await got(f"http://{host}/favicon.ico"))[0] == 200
        connection = await opened(host, token_of(first))
        assert "ACK" in await connection.read_message(), "who is in stays in"
        assert len(made.get_sessions()) == 2
        connection.close()

    served(work)


def test_a_page_that_nobody_uses_is_let_go(served: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(host: str, made: Any) -> None:
        _, html = await got(f"http://{host}/")
        connection = await opened(host, token_of(html))
        for _ in range(3):
            await connection.read_message()
        server.let_go(made)
        await asyncio.sleep(1.2)
        (session,) = made.get_sessions()
        assert session.connection_count == 1, "it was used just now"
        monkeypatch.setattr(server, "IDLE_S", 0)
        server.let_go(made)
        told = ""
        while (message := await connection.read_message()) is not None:
            told += str(message)
        assert '"idle"' in told, "the page is told why"
        await asyncio.sleep(0.1)
        assert session.connection_count == 0

    served(work)


def wire(kind: str, content: Any) -> list[str]:
    header = {"msgid": "1", "msgtype": kind}
    return [json.dumps(header), "{}", content if isinstance(content, str) else json.dumps(content)]


NONSENSE = [
    ["{"],
    ["[]"],
    ['{"msgid": 1}'],
    wire("PATCH-DOC", "{"),
    wire("PATCH-DOC", {}),
    wire("PATCH-DOC", {"events": [{"kind": "ModelChanged", "model": {"id": "none"}, "attr": "x", "new": 1}]}),
    wire("PATCH-DOC", {"events": [{"kind": "Nothing"}]}),
    wire("PUSH-DOC", {"doc": {"roots": [{"type": "object", "name": "os.system", "id": "1"}]}}),
    wire("NO-SUCH", {}),
    ["x" * 100_000],
]


@pytest.mark.long
def test_nonsense_gives_no_traceback_and_no_path(served: Any, caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []

    async def work(host: str, made: Any) -> None:
        for fragments in NONSENSE:
            _, html = await got(f"http://{host}/")
            connection = await opened(host, token_of(html))
            await connection.read_message()
            await connection.read_message()
            await connection.read_message()
            for fragment in fragments:
                await connection.write_message(fragment)
            try:
                for _ in range(3):
                    message = await asyncio.wait_for(connection.read_message(), 1.0)
                    if message is None:
                        break
                    told.append(str(message))
            except TimeoutError:
                pass
            connection.close()
        for path in (
            "/..%2f..%2fetc/passwd",
            "/static/%00",
            "/?star=%ff%fe",
            "/nothing",
            "/ws",
            "/static/extensions/x",
        ):
            told.append((await got(f"http://{host}{path}"))[1])
        reader, writer = await asyncio.open_connection(*host.rsplit(":", 1))
        writer.write(b"GET / HTTP/9.9\r\nHost: \xff\xfe\r\nContent-Length: -1\r\n\r\n")
        told.append((await reader.read(1000)).decode())

    with caplog.at_level(logging.WARNING):
        served(work)
    form = Plain()
    lines = [form.format(record) for record in caplog.records]
    assert any("error handling message" in one for one in lines), "there is something to see"
    for text in (*told, *lines):
        assert "Traceback" not in text
        assert "site-packages" not in text
        assert str(Path(__file__).parents[2]) not in text
        assert not re.search(r'File "/', text)
    assert all("\n" not in line and len(line) < 1500 for line in lines)


def test_a_fresh_page_builds_what_is_in_front_alone(served: Any) -> None:
    """Its cost grows with its models; `bench/crowd.py` measures the time itself."""

    async def work(host: str, made: Any) -> int:
        await got(f"http://{host}/")
        (session,) = made.get_sessions()
        return len(list(session.document.models))

    assert served(work) < 260, "half of what all tabs together need"


def test_uploads_have_a_limit_that_a_message_can_carry() -> None:
    assert MOST_UPLOADED * 4 / 3 + 4096 < server.MESSAGE
