"""Server of the page."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Sequence
from typing import Any

#: Largest size in bytes of a message, an upload with a margin, and of a request's body, of which the page has none.
MESSAGE, BODY = 17 * 2**20, 2**16
#: Seconds that a connection may take for the headers and the body of each request.
REQUEST_S = 20.0
#: Largest number of open connections, beyond which the oldest without a page is closed; browsers open up to six.
MAX_CONNECTIONS = 512
#: Seconds after which unused pages are disconnected, and interval of this check.
IDLE_S, SWEEP_S = 3600, 5
#: Seconds between pings of a connection, which is closed if it does not reply.
PING_S = 20


def make(address: str, port: int, allowed: Sequence[str]) -> Any:
    """Create a listening server.

    Parameters
    ----------
    address : str
        Address; 127.0.0.1 accepts only this machine.
    allowed : sequence of str
        Origins of the page in addition to this machine's own.

    Returns
    -------
    tornado.httpserver.HTTPServer

    Raises
    ------
    InputError
        If the address is invalid, or accepts other machines without an origin.
    OSError
        If the port is taken.
    """
    from mauvecl.web.access import AccessMatcher, RefusalHandler, hosts

    let_in = hosts(address, port, allowed)
    from tornado.web import Application

    from mauvecl.web.connections import BoundedServer
    from mauvecl.web.static_pages import AssetHandler, FigureHandler, FrontHandler
    from mauvecl.web.visitor import Visitor

    application = Application(
        [
            (r"/", FrontHandler),
            (r"/live", Visitor),
            (r"/figures/([a-z]+)/([a-z]+)\.json", FigureHandler),
            (r"/(favicon\.svg)", AssetHandler),
            (r"/assets/([a-z0-9.-]+)", AssetHandler),
        ],
        websocket_max_message_size=MESSAGE,
        websocket_ping_interval=PING_S,
        default_handler_class=RefusalHandler,
        default_handler_args={"status": 404, "why": "There is no such page."},
        log_function=lambda handler: None,
    )
    # Access control comes first.
    application.default_router.rules.insert(0, AccessMatcher.rule(let_in))
    server = BoundedServer(
        application,
        max_body_size=BODY,
        max_buffer_size=MESSAGE,
        idle_connection_timeout=REQUEST_S,
        body_timeout=REQUEST_S,
    )
    server.max_connections = MAX_CONNECTIONS
    server.listen(port, address)
    return server


def close_unused() -> None:
    """Close the connections of unused pages, and release the memory of visitors who have left."""
    from mauvecl.web.visitor import UNUSED, Visitor
    from mauvecl.web.work import reading, release_memory

    if Visitor.has_left:
        Visitor.has_left = False
        reading(release_memory)

    now = time.monotonic()
    for one in list(Visitor.here):
        if now - one.used > IDLE_S and one.job is None:
            one.close(UNUSED, "not used for a long time")


def warm() -> None:
    """Prepare imports, response matrix, kernels and page before the first visitor."""
    import gc
    import tempfile
    from pathlib import Path

    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.state import State
    from mauvecl.web.static_pages import prepare
    from mauvecl.web.tabs import TABS
    from mauvecl.web.visitor import shown
    from mauvecl.web.work import Job

    with tempfile.TemporaryDirectory() as folder:
        closed = ClosedForms.of(State().question(), Path(folder))
    for tab in TABS:
        shown(tab, closed, {})
    Job(lambda pool: pool.realise(closed.quiet, count=1, seed=0)).future.result()
    prepare()
    # Objects that exist now are permanent, so garbage collection need not scan them again.
    gc.collect()
    gc.freeze()


def serve(address: str, port: int, *, show: bool = False, allow_origin: Sequence[str] = ()) -> None:
    """Serve the page until interrupted.

    Parameters
    ----------
    address : str
        Address; 127.0.0.1 accepts only this machine.
    show : bool
        Whether to open a browser.
    allow_origin : sequence of str
        Origins of the page; required if the address accepts other machines.

    Raises
    ------
    InputError, OSError
        As for `make`.
    """
    import asyncio

    from mauvecl.web.access import local, netloc
    from mauvecl.web.folders import remove_abandoned
    from mauvecl.web.plain_log import install
    from mauvecl.web.visitor import Visitor
    from mauvecl.web.work import limit_arenas

    async def run() -> None:
        from tornado.ioloop import PeriodicCallback

        # Exit normally on SIGTERM, so that the folders of visitors are removed.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
        remove_abandoned()
        make(address, port, allow_origin)
        warm()
        if not local(address):
            print(
                f"mauvecl: the page has no users and no passwords: whoever reaches {netloc(address, port)} may use it.",
                file=sys.stderr,
            )
        url = f"http://{netloc(address, port)}/"
        print(f"mauvecl serves at {url}; Ctrl-C ends it.", flush=True)
        PeriodicCallback(close_unused, 1000 * SWEEP_S).start()
        if show:
            import webbrowser

            webbrowser.open(url)
        try:
            await asyncio.Event().wait()
        finally:
            # Simulations would keep the process until they end.
            for one in list(Visitor.here):
                one.on_close()

    install()
    limit_arenas()
    asyncio.run(run())
