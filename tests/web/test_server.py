"""The server: who is let in, what it makes of nonsense, what it computes for whom, and what it leaves behind."""

import asyncio
import json
import re
import signal
import socket
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from marks import long_but
from refusals import says_what_is_accepted
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.web import HTTPError

from tests.web.visits import Server, Talk, link

ROOT = Path(__file__).parents[2]
#: Server with less patience, so that tests need not wait, which fails at one magnitude, and whose astropy turns every
#: exception into a TypeError, as conversions of times and coordinates do.
STRICT = """
import sys, time
from astropy import coordinates
from mauvecl import Study
from mauvecl.web import server

build = Study.build

def mistaken(data, *where):
    if any(star.get("magnitude") == 6.66 for star in data["star"]):
        raise RuntimeError("odd")
    return build(data, *where)

def stubborn(*given, **how):
    print("catches everything", flush=True)
    try:
        for _ in range(20_000):
            time.sleep(1e-3)
    except BaseException as error:
        raise TypeError from error

Study.build, coordinates.get_sun = staticmethod(mistaken), stubborn
server.REQUEST_S, server.MAX_CONNECTIONS, server.IDLE_S, server.SWEEP_S = 3.0, 60, 10, 1
server.serve(sys.argv[1], int(sys.argv[2]))
"""


@pytest.fixture(scope="module")
def strict(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    found = Server(tmp_path_factory.mktemp("strict") / "log.txt", program=STRICT)
    yield found
    found.kill()


async def test_foreign_hosts_and_origins_are_refused(talk: Talk, server: Server) -> None:
    port = server.port
    for foreign in ("evil.example", f"evil.example:{port}", f"127.0.0.1.evil.example:{port}", "127.0.0.1:1"):
        assert (await server.got(Host=foreign))[0] == 403
        assert (await server.got("assets/page.js", Host=foreign))[0] == 403
    for origin in ("http://evil.example", "null", "https://127.0.0.1:1", f"http://localhost.evil:{port}"):
        assert (await server.got(Origin=origin))[0] == 403
        assert await server.refuses_talk(Origin=origin) == 403
    assert await server.refuses_talk(Host=f"evil.example:{port}") == 403
    assert await server.refuses_talk() == 403
    assert (await server.got(Origin=f"http://localhost:{port}"))[0] == 200
    assert (await server.got(Host=f"LOCALHOST:{port}"))[0] == 200
    assert "answer" in await talk.answer()


@pytest.mark.long
def test_ipv6_and_allowed_origins_are_served(tmp_path: Path) -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("no IPv6 here")
    served = Server(tmp_path / "log.txt", "--allow-origin", "https://Mauve.example.org/", address="::1")

    async def work(talk: Talk) -> None:
        assert "answer" in await talk.answer()
        assert (await served.got(Host="mauve.example.org"))[0] == 200
        assert (await served.got(Host="mauve.example.org:8443"))[0] == 403
        (await served.talk(Host="mauve.example.org:443", Origin="https://mauve.example.org")).end()

    served.visited(work)
    served.end()


async def test_number_of_visitors_is_limited(talk: Talk, server: Server) -> None:
    # Those who have just left may still be counted.
    here: list[Talk] = []
    while (reported := await server.got())[0] == 200 and len(here) < 110:
        here.append(await server.talk())
    assert 90 < len(here) <= 99
    assert reported == (503, "Too many visitors are here at the moment; please come again in some minutes.\n")
    assert await server.refuses_talk(Origin=f"http://{server.host}") == 503
    assert (await server.got("favicon.svg"))[0] == 200
    assert "answer" in await talk.answer(), "who is in stays in"
    for one in here:
        one.end()
    for _ in range(100):
        if (await server.got())[0] == 200:
            return
        await asyncio.sleep(0.1)
    raise AssertionError("full for ever")


@pytest.mark.long
async def test_connections_are_bounded_and_half_open_or_unused_ones_end(talk: Talk, strict: Server) -> None:
    """Connections that never end their headers or body are dropped, and those beyond the limit; a page stays."""
    kept: list[Any] = []

    async def connected(*parts: bytes) -> list[asyncio.StreamReader]:
        some = [(await asyncio.open_connection("127.0.0.1", strict.port), part) for part in parts]
        for (_, writer), part in some:
            writer.write(part)
        kept.extend(some)
        return [reader for (reader, _), _ in some]

    unused = await strict.talk()
    begun = f"POST / HTTP/1.1\r\nHost: {strict.host}\r\nContent-Length: 100\r\n\r\nx".encode()
    for reader in await connected(*(b"", b"GET / HTTP/1.1\r\nHost:", begun) * 15):
        await asyncio.wait_for(reader.read(), 20)
    readers = await connected(*[b""] * 80)
    await asyncio.sleep(0.5)
    ended = [reader.at_eof() for reader in readers]
    assert ended == sorted(ended, reverse=True), "the oldest are closed"
    assert sum(ended) == 80 + 2 - 60, "and no page"
    assert "star" in str(await talk.exported())
    assert (await strict.got())[0] == 200
    # The page receives the reason.
    assert await unused.ended() == (4000, "not used for a long time")


MESSAGES = tomllib.loads((ROOT / "tests" / "data" / "web" / "messages.toml").read_text(encoding="utf-8"))


@pytest.mark.long
async def test_invalid_messages_give_no_traceback_and_no_path(talk: Talk, strict: Server) -> None:
    reported: list[str] = []
    for message in (*MESSAGES["nonsense"], "[" * 100_000, "x" * 100_000, b"bytes of no file"):
        one = await strict.talk()
        await one.connection.write_message(message, binary=isinstance(message, bytes))
        code, reason = await one.ended()
        assert code == 1003
        reported.append(reason)
    for pointless in MESSAGES["pointless"]:
        await talk.connection.write_message(json.dumps(pointless))
        # Whoever is still there answers the next message.
        n = await talk.say("export", link="?star=M3V&magnitude=9")
        found: dict[str, Any] = {}
        while found.get("n") != n:
            message = await asyncio.wait_for(talk.connection.read_message(), 60)
            assert message is not None, pointless
            # A requested file arrives as bytes.
            found = json.loads(message) if isinstance(message, str) else {}
            reported.append(str(message))
    for path in MESSAGES["paths"]:
        code, text = await strict.got(path)
        assert 400 <= code < 500, path
        reported.append(text)
    assert (await strict.got("?star=%ff%fe"))[0] == 200
    reader, writer = await asyncio.open_connection("127.0.0.1", strict.port)
    writer.write(b"GET / HTTP/9.9\r\nHost: \xff\xfe\r\nContent-Length: -1\r\n\r\n")
    reported.append((await reader.read(1000)).decode())
    # A mistake of the page leaves no answer, and the next question has one.
    wrong = await talk.answer("?magnitude=6.66")
    assert "answer" not in wrong
    assert "this is a fault of mauvecl" in (wrong if "refused" in wrong else await talk.next())["refused"]
    assert "answer" in await talk.answer("?magnitude=6.67")
    lines = strict.log.read_text().splitlines()
    assert any("not a valid request" in one for one in lines), "there is something to see"
    for text in (*reported, *lines):
        for word in ("Traceback", "site-packages", str(ROOT), 'File "/', "odd\n"):
            assert word not in text
    assert all(len(line) < 1500 for line in lines)


async def test_first_load_is_small_and_compressed(talk: Talk, server: Server, words: dict[str, Any]) -> None:
    """2.5 MB is the most that the issue allows; nothing for formulas is among it."""
    _, html = await server.got()
    for name in words["fields"]:
        assert html.count(f'id="f-{name}"') == 1, name
    waiting = ["", *re.findall(r'(?:src|href)="((?:assets|favicon)[^"]+)"', html)]
    waiting += [f"figures/light/{name}.json" for name in ("excess", "distributions", "roc")]
    total, seen = 0, set[str]()
    while waiting:
        part = waiting.pop()
        if part.partition("?")[0] in seen:
            continue
        seen.add(part.partition("?")[0])
        assert "mathjax" not in part
        request = HTTPRequest(server.address + part, headers={"Accept-Encoding": "gzip"}, decompress_response=False)
        answer = await AsyncHTTPClient().fetch(request)
        assert answer.headers["Content-Encoding"] == "gzip", part
        assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        total += len(answer.body)
        if ".js" in part and "bokeh" not in part:
            _, text = await server.got(part)
            waiting.extend(f"assets/{name}" for name in re.findall(r'from "\./([\w.-]+\.js)', text))
        request.headers["If-None-Match"] = answer.headers["Etag"]
        with pytest.raises(HTTPClientError, match="304"):
            await AsyncHTTPClient().fetch(request)
    assert len(seen) > 20, "scripts import others"
    assert total / 1e6 < 0.6


KINDS = ("detection", "map", "limit", "measure", "change", "periods", "completeness", "visible", "plan")


@pytest.mark.long
async def test_cancel_ends_work_in_libraries_that_catch_exceptions(talk: Talk, strict: Server) -> None:
    """Some libraries turn every exception into another, by chance the interruption as well."""
    n = await talk.say("simulate", kind="visible", link=link(targets="Vega"))
    while "catches everything" not in strict.log.read_text():
        await asyncio.sleep(0.05)
    await talk.say("cancel")
    while (reported := await talk.next()).get("n") != n or "ended" not in reported:
        pass
    assert reported["ended"] == "Cancelled."


@pytest.mark.parametrize("kind", long_but(KINDS, "detection"))
async def test_cancel_ends_every_computation(talk: Talk, server: Server, kind: str) -> None:
    """Cancel each computation once it has started, and compute the next one; progress never falls."""
    bands = ",".join(f"{start}-{start + 150}" for start in range(210, 450, 12))
    targets = "\n".join(("eps Eri", "AU Mic", "YZ CMi", "AD Leo", "EV Lac", "Vega"))
    many = link(realisations="4000000", targets=targets, days="200", visits="100", changes=bands)
    await talk.answer(many)
    n = await talk.say("simulate", kind=kind, link=many)
    shares, left = [0.0], []
    # The first reports suffice: some computations last a second on a fast machine.
    while "waiting" in (reported := await talk.next()).get("message", "waiting") or len(shares) < 2:
        assert "ended" not in reported, reported
        shares.append(reported.get("progress") or 0.0)
        left += re.findall(r"about (\d+) s left", reported.get("message", ""))
    assert shares == sorted(shares)
    assert [int(one) for one in left] == sorted(map(int, left), reverse=True), "never more"
    refused = await talk.ask("simulate", "ended", kind=kind, link=many)
    assert "a simulation is running already" in refused["refused"]
    used = server.spent()
    await talk.say("cancel")
    while (reported := await talk.next()).get("n") != n or "ended" not in reported:
        pass
    assert reported["ended"] == "Cancelled."
    spent = server.spent() - used
    await asyncio.sleep(0.5)
    idle = server.spent() - used - spent
    small = link(realisations="10000", fap="0.05")
    assert (await talk.simulate("detection", small)).startswith("Done")
    # Processor time, for others may be at work; a tile may be under way on both processors.
    assert spent < (2.0 if kind in ("completeness", "visible") else 8.0)
    assert idle < 0.25, "nothing goes on behind it"


@pytest.mark.long
async def test_answers_continue_while_others_compute_upload_and_leave(talk: Talk, server: Server) -> None:
    other = await server.talk()
    coming = asyncio.create_task(talk.upload(b"# %ECSV 1.0\n# ---\n# meta: " + b"[" * 200_000 + b"\n"))
    assert "answer" in await other.answer("?magnitude=8")
    assert not coming.done(), "the event loop does not wait for the reader"
    assert says_what_is_accepted((await coming)["lacks"])
    many = link(realisations="4000000")
    await talk.say("simulate", kind="detection", link=many)
    while "progress" not in await talk.next():
        pass
    assert "answer" in await other.answer("?magnitude=8.2")
    talk.end()
    for _ in range(60):
        used = server.spent()
        await asyncio.sleep(0.5)
        if server.spent() - used < 0.1:
            break
    else:
        raise AssertionError("a simulation of a visitor who has left goes on")
    other.end()


@pytest.mark.long
def test_memory_of_uploads_and_answers_is_bounded(tmp_path: Path) -> None:
    """Of 256 MiB of uploads the oldest are dropped; those of visitors who have left make room."""
    served = Server(tmp_path / "log.txt")
    documented = (ROOT / "docs" / "page.md").read_text()
    assert documented.count("256 MiB of") == 2

    async def has_file(talk: Talk) -> bool:
        return "its file again" not in str(await talk.faults("?frames=uploaded+file", "analyse"))

    async def work(first: Talk) -> None:
        content = b"\xff" + bytes(2**24 - 2)
        assert "entered" in await first.upload(content, "frames", "mine.csv")
        for number in (8, 8, 16):
            others = [await served.talk() for _ in range(number)]
            for one in others:
                assert "entered" in await one.upload(content, "frames", "mine.csv")
            assert await has_file(first) == (number == 8)
            assert await has_file(others[-1])
            for one in others:
                one.end()
            await asyncio.sleep(0.5)
        # The positions of a year, 110 MB, once stayed with every plan that a connection kept.
        for kind in ("visible", "plan"):
            memory = []
            for days in ("360", "361"):
                assert (await first.simulate(kind, link(targets="AU Mic", days=days))).startswith("Done")
                memory.append(served.memory())
            assert memory[1] - memory[0] < 60

    served.visited(work)
    served.end()


def test_invented_figures_are_not_kept_in_memory() -> None:
    from mauvecl.web import server

    for name in ("one", "two"):
        with pytest.raises(HTTPError, match="404"):
            server.figure("light", name, "")
    assert server.figure.cache_info().currsize == 0


def test_scipy_is_imported_before_a_simulation_is_cancelled_meanwhile() -> None:
    code = "import sys; from mauvecl.web import server; server.warm(); sys.exit('scipy.signal' not in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.long
def test_folders_end_with_their_server(tmp_path: Path) -> None:
    """Ctrl-C and SIGTERM remove them amid a simulation of a visitor who stays, without errors."""
    for end in (signal.SIGTERM, signal.SIGINT):
        served = Server(tmp_path / f"{end.name}.txt", TMPDIR=str(tmp_path))

        async def work(talk: Talk, served: Server = served, end: signal.Signals = end) -> None:
            await talk.say("simulate", kind="detection", link="?realisations=4000000")
            while "progress" not in await talk.next():
                pass
            for magnitude in range(6, 12):
                await talk.say("answer", link=f"?magnitude={magnitude}", tab="detection")
            served.process.send_signal(end)
            await asyncio.to_thread(served.process.wait, 60)

        served.visited(work)
        assert not re.search("ERROR|Traceback|note:", served.log.read_text()), served.log.read_text()
        assert list(tmp_path.glob("mauvecl-page-*/")) == []
