"""Server of the page: access, connections, static files, and its log."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import hashlib
import ipaddress
import json
import logging
import re
import signal
import socket
import sys
import tempfile
import time
import traceback
import webbrowser
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bokeh
from bokeh.embed import json_item
from mako.lookup import TemplateLookup
from tornado.httpserver import HTTPServer
from tornado.ioloop import PeriodicCallback
from tornado.iostream import IOStream
from tornado.web import Application, HTTPError, RequestHandler, StaticFileHandler

from mauvecl.answers.verbs import GROUPS
from mauvecl.host import VERSION
from mauvecl.host.exposure.background import NEIGHBOUR_COLUMNS
from mauvecl.host.stars.library import all_names, library_names, well_known_stars
from mauvecl.schema.errors import InputError, printable, shortened
from mauvecl.study.plan import TARGET_COLUMNS
from mauvecl.web import fields
from mauvecl.web.closed_forms import TITLES, ClosedForms
from mauvecl.web.page import SEEN, SIMULATIONS, TABS, State, reads_of
from mauvecl.web.tab import INKS, PINS, Canvas
from mauvecl.web.uploads import EXAMPLES, MAPPED, TIME_UNITS, UPLOADS
from mauvecl.web.visitor import READER, UNUSED, Job, Visitor, content_of, release_memory

if TYPE_CHECKING:
    from tornado.httputil import HTTPServerRequest

# Limits of the server; sizes in bytes.
MAX_VISITORS = 100  # visitors at the same time, with some megabytes each (assumed to suffice for a team)
MAX_CONNECTIONS = 512  # number above which the oldest one without a page is closed; browsers open up to six
MESSAGE = 17 * 2**20  # message from a page: an upload with a margin
BODY = 2**16  # body of a request; those of the page have none
REQUEST_S = 20.0  # longest time for the headers and the body of each request
IDLE_S, SWEEP_S = 3600, 5  # time after which unused pages are disconnected, and interval of this check
PING_S = 20  # time between pings of a connection, which is closed if it does not reply
CLOSED_FORMS = 2  # number of threads that compute closed forms, pictures and files for all visitors
MOST_LOGGED = 1200  # largest number of characters of a line of the log
ASSETS = Path(__file__).parent / "assets"
#: The page connects to its own server only, and runs only its own code. Browsers ask whether a file has changed, unless
#: its address states its version.
HEADERS = {
    "Cache-Control": "no-cache",
    "Content-Security-Policy": (
        "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; object-src 'none'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
#: Columns of the page's table of targets that have other names in tables, with the keys of targets.
HEADINGS = {"name": "name", "spectral_type": "spectral_type", "V": "magnitude", "coordinates": "coordinates"}
#: A host as browsers write it: name, IPv4 address or IPv6 address in brackets; and a port.
HOST = r"(?:[a-z0-9](?:[a-z0-9.-]*[a-z0-9])?|\[[0-9a-f:.]+\])(?::\d{1,5})?"


def local(address: str) -> bool:
    """Return whether an address is reachable from this machine only."""
    if not address.strip():
        raise InputError.of("address", address, "one such as 127.0.0.1, ::1 or 0.0.0.0")
    try:
        infos = socket.getaddrinfo(address, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise InputError.of("address", address, "one such as 127.0.0.1") from error
    return all(ipaddress.ip_address(str(info[4][0]).split("%")[0]).is_loopback for info in infos)


def netloc(address: str, port: int) -> str:
    """Format host and port, with IPv6 addresses in brackets."""
    return f"[{address}]:{port}" if ":" in address else f"{address}:{port}"


def plain_host(host: str) -> str:
    """Return a host in lower case without default ports."""
    return re.sub(r":(80|443)$", "", host.strip().lower())


def hosts(address: str, port: int, allowed: Sequence[str]) -> frozenset[str]:
    """Return the hosts under which the page is served; origins are ``https://name`` or ``name:port``."""
    named = [re.sub(r"^https?://", "", text.strip().lower()).removesuffix("/") for text in allowed]
    for text, host in zip(allowed, named, strict=True):
        if re.fullmatch(HOST, host) is None:
            raise InputError.of("allow_origin", text, "one host such as https://mauve.example.org")
    if not local(address) and not named:
        raise InputError(
            f"address = {shortened(address)} accepts other machines; give `allow_origin` with the address that "
            "visitors' browsers will show, such as https://mauve.example.org",
            key="address",
        )
    addresses = {"127.0.0.1", "localhost", "::1"} | ({address} if local(address) else set())
    return frozenset(plain_host(host) for host in (*named, *(netloc(address, port) for address in addresses)))


class PageApplication(Application):
    """Application that refuses requests which do not come from pages of the `hosts` in its settings."""

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        """Return the handler of a request, or of a refusal: unknown names (DNS rebinding) and other servers' pages."""
        origins, allowed = request.headers.get_list("Origin"), self.settings["hosts"]
        status, message, is_visitor = 403, "", request.path == "/live"
        if [plain_host(host) for host in request.headers.get_list("Host")] not in [[host] for host in allowed]:
            message = "The page is not served under this host name; see `mauvecl serve --allow-origin`."
        elif any(plain_host(re.sub(r"^https?://", "", origin.lower())) not in allowed for origin in origins):
            message = "Pages of other servers cannot use this page; see `mauvecl serve --allow-origin`."
        elif is_visitor and not origins:
            message = "Expected a connection from the page."
        elif (is_visitor or request.path == "/") and len(Visitor.connected) >= MAX_VISITORS:
            status, message = 503, "Too many visitors are here at the moment; please come again in some minutes."
        if message:
            return self.get_handler_delegate(request, RefusalHandler, {"status": status, "message": message})
        return super().find_handler(request, **kwargs)


class BoundedServer(HTTPServer):
    """HTTP server that closes the oldest connection without a visitor's page if there are too many."""

    max_connections: int
    streams: list[IOStream]  # of all connections

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Serve a new connection."""
        self.streams = [stream for stream in self.streams if not stream.closed()]
        if len(self.streams) >= self.max_connections:
            # There are fewer pages than connections.
            pages = {id(page.ws_connection.stream) for page in Visitor.connected if page.ws_connection is not None}
            next(oldest for oldest in self.streams if id(oldest) not in pages).close()
        self.streams.append(stream)
        super().handle_stream(stream, address)


class OneLine(logging.Formatter):
    """Formatter that writes one line of bounded length, with the lines of mauvecl in the traceback of an exception."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        return printable(" ".join(super().format(record).split()), MOST_LOGGED)

    def formatException(self, ei: Any) -> str:  # noqa: N802
        """Return kind and message of an exception, and modules and lines of its traceback: ours, or the last one."""
        if ei[0] is None:
            return ""
        frames = [(frame.f_globals.get("__name__", "?"), line) for frame, line in traceback.walk_tb(ei[2])]
        ours = [frame for frame in frames if frame[0].startswith("mauvecl.")] or frames[-1:]
        return f"({ei[0].__name__}: {ei[1]}; {', '.join(f'{name} line {line}' for name, line in ours)})"


def make(address: str, port: int, allowed: Sequence[str]) -> Any:
    """Return a listening server.

    Raises InputError if the address is invalid or accepts other machines without an origin, and OSError if the port is
    taken.
    """
    application = PageApplication(
        [
            (r"/", FrontHandler),
            (r"/live", Visitor),
            (r"/figures/([a-z]+)/([a-z]+)\.json", FigureHandler),
            (r"/(favicon\.svg)", AssetHandler, {"path": ASSETS}),
            (r"/assets/(bokeh\.min\.js)", AssetHandler, {"path": Path(bokeh.__file__).parent / "server/static/js"}),
            (r"/assets/([a-z0-9-]+\.(?:js|css|svg|fits))", AssetHandler, {"path": ASSETS}),
        ],
        compress_response=True,
        websocket_max_message_size=MESSAGE,
        websocket_ping_interval=PING_S,
        default_handler_class=RefusalHandler,
        log_function=lambda handler: None,
        hosts=hosts(address, port, allowed),
    )
    limits = {"max_body_size": BODY, "max_buffer_size": MESSAGE}
    server = BoundedServer(application, **limits, idle_connection_timeout=REQUEST_S, body_timeout=REQUEST_S)
    server.max_connections, server.streams = MAX_CONNECTIONS, []
    server.listen(port, address)
    return server


def close_unused() -> None:
    """Close the connections of unused pages, and release the memory of visitors who have left."""
    if Visitor.has_left:
        Visitor.has_left = False
        READER.submit(release_memory)
    now = time.monotonic()
    for visitor in list(Visitor.connected):
        if now - visitor.used > IDLE_S and visitor.job is None:
            visitor.close(UNUSED, "not used for a long time")


def warm() -> None:
    """Prepare imports, response matrix, kernels and page before the first visitor."""
    # A cancelled simulation may interrupt an import, and this one cannot be repeated.
    import_module("scipy.signal")
    with tempfile.TemporaryDirectory() as folder:
        closed = ClosedForms.of(State().question(), Path(folder))
    for tab in TABS.values():
        content_of(tab, closed, {})
    Job(lambda pool: pool.realise(closed.quiet, count=1, seed=0)).future.result()
    # What every visitor requests; pictures of other tabs follow on request.
    front()
    for picture in next(iter(TABS.values())).pictures:
        usual = "".join(axis.lower() for axis in picture.logs if axis.isupper())
        for theme in INKS:
            figure(theme, picture.name, usual)
    # Objects that exist now are permanent, so garbage collection need not scan them again.
    gc.collect()
    gc.freeze()


def serve(address: str, port: int, *, show: bool = False, allow_origin: Sequence[str] = ()) -> None:
    """Serve the page until interrupted; parameters and errors as for `make`."""

    async def run() -> None:
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(CLOSED_FORMS, "mauvecl-closed"))
        # Exit normally on SIGTERM, so that the folders of visitors are removed.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
        make(address, port, allow_origin)
        warm()
        if not local(address):
            text = f"the page has no users and no passwords: whoever reaches {netloc(address, port)} may use it."
            print(f"mauvecl: {text}", file=sys.stderr)
        url = f"http://{netloc(address, port)}/"
        print(f"mauvecl serves at {url}; Ctrl-C ends it.", flush=True)
        PeriodicCallback(close_unused, 1000 * SWEEP_S).start()
        if show:
            webbrowser.open(url)
        try:
            await asyncio.Event().wait()
        finally:
            # Simulations would keep the process until they end.
            for visitor in list(Visitor.connected):
                visitor.on_close()

    # Warnings and errors of all libraries have one format; bokeh and tornado write their own otherwise.
    handler = logging.StreamHandler()
    handler.setFormatter(OneLine("%(asctime)s %(levelname)s %(name)s %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    for name in ("bokeh", "tornado"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [], True
        logger.setLevel(logging.WARNING)
    # Threads share two pools of glibc's malloc, since each pool keeps what its threads have freed; -8 is M_ARENA_MAX.
    getattr(ctypes.CDLL(None), "mallopt", lambda *_: None)(-8, 2)
    asyncio.run(run())


@cache
def front() -> bytes:
    """Return the page."""
    # The digest of all assets, so that browsers do not use old ones.
    assets = [path.read_bytes() for path in sorted(ASSETS.iterdir())]
    digest = hashlib.sha256(b"".join([f"{VERSION} {bokeh.__version__}".encode(), *assets])).hexdigest()[:12]
    lookup = TemplateLookup([str(ASSETS)], default_filters=["h"], strict_undefined=True)
    template = lookup.get_template("page.html.mako")
    text = template.render(
        fields=fields, uploads=UPLOADS, examples=EXAMPLES, names=[star.name for star in well_known_stars()],
        mapped=MAPPED, time_units=TIME_UNITS, library=library_names(), tabs=TABS, groups=GROUPS, version=VERSION,
        titles=TITLES, digest=digest, words=json.dumps(_words()).replace("<", "\\u003c"),
    )  # fmt: skip
    return str(text).encode()


def _words() -> dict[str, Any]:
    """Return the settings of the page's script."""
    return {
        "version": VERSION,
        "fields": {name: field.first for name, field in fields.FIELDS.items()},
        "sliders": {name: vars(field.slider) for name, field in fields.FIELDS.items() if field.slider is not None},
        "stars": all_names(),
        "example": "AU Mic\nYZ CMi\neps Eri",
        "headings": {name: [text.lower() for text in (key, *TARGET_COLUMNS[key])] for name, key in HEADINGS.items()},
        "asks": {name: sorted(reads_of(name)) for name in SIMULATIONS},
        "uploads": {
            name: {"entered": upload.entered, "options": upload.fields, "most": upload.most}
            for name, upload in UPLOADS.items()
        },
        "withFile": fields.WITH_FILE,
        "columns": sorted({*NEIGHBOUR_COLUMNS}),
        "needs": {name: tab.needs for name, tab in SIMULATIONS.items() if tab.needs},
        "under": fields.ASKED_UNDER,
        "presets": fields.PRESETS,
        "seen": {name: field.first for name, field in SEEN.items()},
        "tabs": {
            tab.name: {
                "pictures": [
                    {"name": p.name, "sets": p.sets, "logs": list(p.logs), "pins": p.pins, "alike": p.alike}
                    for p in tab.pictures
                ],
                "reads": sorted(tab.reads),
                "chance": tab.chance,
            }
            for tab in TABS.values()
        },
        "pins": PINS,
        "unused": UNUSED,
    }


@cache
def figure(theme: str, name: str, logs: str) -> bytes:
    """Return an empty figure with its legend; unknown ones raise HTTPError, which is not cached."""
    picture = next((p for tab in TABS.values() for p in tab.pictures if p.name == name), None)
    if picture is None or theme not in INKS or not set(logs) <= {axis.lower() for axis in picture.logs}:
        raise HTTPError(404)
    canvas = Canvas(picture, theme, frozenset(logs))
    return json.dumps({"item": json_item(canvas.plot), "legend": canvas.legend}).encode()


class PageHandler(RequestHandler):
    """Base of the page's handlers, with their headers and messages without internal details."""

    def set_default_headers(self) -> None:
        """Set the headers of every answer."""
        self.clear_header("Server")
        for name, value in HEADERS.items():
            self.set_header(name, value)

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Send the argument `message`, or a usual one."""
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        if status_code == 503:
            self.set_header("Retry-After", "60")
        usual = "There is no such page." if status_code == 404 else f"The page cannot answer this ({status_code})."
        self.finish(f"{kwargs.get('message', usual)}\n")


class AssetHandler(PageHandler, StaticFileHandler):
    """Handler of the page's files; one with its version in its address never changes."""


class FrontHandler(PageHandler):
    """Handler of the page itself."""

    def get(self) -> None:
        """Send the page."""
        self.finish(front())


class FigureHandler(PageHandler):
    """Handler of empty figures."""

    def get(self, theme: str, name: str) -> None:
        """Send a figure, with the axes of the argument `log` in logarithms."""
        content = figure(theme, name, "".join(sorted(set(self.get_query_argument("log", ""))))[:2])
        self.set_header("Content-Type", "application/json")
        if "v" in self.request.arguments:
            self.set_header("Cache-Control", f"max-age={StaticFileHandler.CACHE_MAX_AGE}")
        self.finish(content)


class RefusalHandler(PageHandler):
    """Handler of requests that are refused, by default because there is no such page."""

    def initialize(self, status: int = 404, **reason: str) -> None:
        """Set the status, and the reason as the argument `message`."""
        self._refusal = partial(self.send_error, status, **reason)

    def prepare(self) -> None:
        """Refuse the request."""
        self._refusal()
