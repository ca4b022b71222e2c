"""Server of the page."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

#: Bytes of one message: an upload, and room; and of a request's body, for the page takes none.
MESSAGE, BODY = 8 * 2**20, 2**16
#: Seconds that a connection may take for the headers of a request and for its body, also where it is kept for another.
REQUEST_S = 20.0
#: Open connections; of more, the oldest that is not a visitor's page is closed. Browsers open up to six each.
MAX_CONNECTIONS = 512
#: Seconds after which a page that nobody uses is let go, and between two looks.
IDLE_S, SWEEP_S = 3600, 5
#: Seconds between two signs of life on a connection; one that gives none is ended.
PING_S = 20


def make(address: str, port: int, allowed: Sequence[str]) -> Any:
    """Create a listening server.

    Parameters
    ----------
    address : str
        127.0.0.1 lets only this machine in.
    port : int
    allowed : sequence of str
        Origins by which the page may be asked for beside this machine's own.

    Returns
    -------
    tornado.httpserver.HTTPServer

    Raises
    ------
    InputError
        If the address cannot be, or lets in other machines without an origin.
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
    # The door is asked before anything else.
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


def let_go() -> None:
    """Close the connections of unused pages."""
    from mauvecl.web.visitor import UNUSED, Visitor

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
    # What is there now stays; looking through it again would cost each visitor.
    gc.collect()
    gc.freeze()


def serve(address: str, port: int, *, show: bool = False, allow_origin: Sequence[str] = ()) -> None:
    """Serve the page until interrupted.

    Parameters
    ----------
    address : str
        127.0.0.1 lets only this machine in.
    port : int
    show : bool
        Open a browser.
    allow_origin : sequence of str
        Origins by which the page may be asked for; needed where the address lets in other machines.

    Raises
    ------
    InputError, OSError
        As `make` does.
    """
    import asyncio

    from mauvecl.web.access import local, netloc
    from mauvecl.web.plain_log import install

    async def run() -> None:
        from tornado.ioloop import PeriodicCallback

        make(address, port, allow_origin)
        warm()
        if not local(address):
            print(
                f"mauvecl: the page has no users and no passwords: whoever reaches {netloc(address, port)} may use it.",
                file=sys.stderr,
            )
        url = f"http://{netloc(address, port)}/"
        print(f"mauvecl serves at {url}; Ctrl-C ends it.", flush=True)
        PeriodicCallback(let_go, 1000 * SWEEP_S).start()
        if show:
            import webbrowser

            webbrowser.open(url)
        await asyncio.Event().wait()

    install()
    asyncio.run(run())
