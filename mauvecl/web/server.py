"""Start the page's server."""

from __future__ import annotations

from typing import Any

#: Bytes of one message: an upload in base64, and room.
MESSAGE = 8 * 2**20


def warm() -> None:
    """What the first visitor should not wait for: imports, the response matrix, kernels."""
    from mauvecl.web.question import Question
    from mauvecl.web.work import Job

    study = Question().study()
    quiet, _ = study.expectations(study.star[0])
    Job(lambda pool: pool.realise(quiet, count=1, seed=0)).future.result()


def serve(address: str, port: int, *, show: bool = False) -> Any:
    """Serve the page until interrupted.

    Parameters
    ----------
    address : str
        127.0.0.1 lets only this machine in.
    port : int
    show : bool
        Open a browser.
    """
    import panel as pn

    from mauvecl.web.frame import layout
    from mauvecl.web.page import Page

    pn.extension(notifications=True)
    warm()
    origin = [f"{address}:{port}", f"localhost:{port}"] if address != "0.0.0.0" else ["*"]
    print(f"mauvecl serves at http://{address}:{port}/; Ctrl-C ends it.", flush=True)
    return pn.serve(
        {"/": lambda: layout(Page())},
        address=address,
        port=port,
        show=show,
        title="mauvecl",
        websocket_origin=origin,
        websocket_max_message_size=MESSAGE,
        # Forgotten visitors do not stay in memory.
        unused_session_lifetime_milliseconds=60_000,
        check_unused_sessions_milliseconds=20_000,
        autoreload=False,
        verbose=False,
    )
