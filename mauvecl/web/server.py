"""Start the page's server."""

from __future__ import annotations

import gc
import secrets
import sys
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

#: Bytes of one message: an upload in base64, and room; and of a request's body, for the page takes none.
MESSAGE, BODY = 8 * 2**20, 2**16
#: Seconds after which a page that nobody uses is let go.
IDLE_S = 3600
#: Milliseconds after which a session without a browser is forgotten, and between two looks.
UNUSED_MS, SWEEP_MS = 30_000, 5000


def make(address: str, port: int, allowed: Sequence[str]) -> Any:
    """A server that is ready to start.

    Parameters
    ----------
    address : str
        127.0.0.1 lets only this machine in.
    port : int
    allowed : sequence of str
        Origins by which the page may be asked for beside this machine's own.

    Raises
    ------
    InputError
        If the address cannot be, or lets in other machines without an origin.
    OSError
        If the port is taken.
    """
    from mauvecl.web.doors import guard, hosts

    let_in = hosts(address, port, allowed)
    import panel as pn
    from tornado.ioloop import PeriodicCallback

    from mauvecl.web.frame import session

    pn.extension()
    # A function may fill the document itself.
    pages: Any = {"/": session}
    server = pn.io.server.get_server(
        pages,
        address=address,
        port=port,
        title="mauvecl",
        location=False,
        websocket_max_message_size=MESSAGE,
        http_server_kwargs={"max_body_size": BODY, "max_buffer_size": MESSAGE},
        sign_sessions=True,
        secret_key=secrets.token_bytes(32),
        unused_session_lifetime_milliseconds=UNUSED_MS,
        check_unused_sessions_milliseconds=SWEEP_MS,
        start=False,
    )
    guard(server._tornado, let_in)
    sweep = PeriodicCallback(lambda: let_go(server), SWEEP_MS)
    sweep.start()
    return server


def let_go(server: Any) -> None:
    """End pages that nobody uses."""
    from mauvecl.web.frame import PAGES

    now = time.monotonic()
    for one in list(server.get_sessions()):
        page = PAGES.get(one.document)
        if page is not None and one.connection_count and now - page.used > IDLE_S and page.job is None:
            page.used = now
            one.document.add_next_tick_callback(partial(setattr, page.bridge, "idle", True))
            server.io_loop.call_later(1.0, _disconnect, one)


def _disconnect(session: Any) -> None:
    for connection in list(session._subscribed_connections):
        connection._socket.close(1001, "not used for a long time")
    session.request_expiration()


def warm() -> None:
    """What the first visitor should not wait for: imports, the response matrix, kernels."""
    from mauvecl.web.frame import layout
    from mauvecl.web.page import Page
    from mauvecl.web.state import State
    from mauvecl.web.work import Job

    study = State().question().study()
    quiet, _ = study.expectations(study.star[0])
    Job(lambda pool: pool.realise(quiet, count=1, seed=0)).future.result()
    layout(Page())
    # What is there now stays; looking through it again would cost each visitor.
    gc.collect()
    gc.freeze()


def serve(address: str, port: int, *, show: bool = False, allowed: Sequence[str] = ()) -> None:
    """Serve the page until interrupted.

    Parameters
    ----------
    address : str
        127.0.0.1 lets only this machine in.
    port : int
    show : bool
        Open a browser.
    allowed : sequence of str
        Origins by which the page may be asked for; needed where the address lets in other machines.

    Raises
    ------
    InputError, OSError
        As `make` does.
    """
    from mauvecl.web.doors import local, netloc
    from mauvecl.web.plain_log import install

    install()
    server = make(address, port, allowed)
    warm()
    if not local(address):
        print(
            f"mauvecl: the page has no users and no passwords: whoever reaches {netloc(address, port)} may use it.",
            file=sys.stderr,
        )
    url = f"http://{netloc(address, port)}/"
    print(f"mauvecl serves at {url}; Ctrl-C ends it.", flush=True)
    if show:
        import webbrowser

        server.io_loop.call_later(0.1, webbrowser.open, url)
    server.start()
    server.io_loop.start()
