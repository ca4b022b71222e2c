"""The verb that serves the page."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated

import typer

from mauvecl.cli.values import within
from mauvecl.schema.parsing import count


def serve(
    address: Annotated[
        str, typer.Option(metavar="TEXT", help="Who may come: 127.0.0.1 is this machine alone.")
    ] = "127.0.0.1",
    port: Annotated[str, typer.Option(metavar="INTEGER", help="Port.")] = "5006",
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TEXT",
            help="An address that visitors' browsers show, such as https://mauve.example.org; needed where --address "
            "lets in other machines. May be repeated.",
            show_default=False,
        ),
    ] = None,
    show: Annotated[bool, typer.Option("--show", help="Open a browser.")] = False,
) -> None:
    """Serve a page in your browser: questions, answers, downloads.

    Example: mauvecl serve --show
    """
    from mauvecl.schema.errors import InputError
    from mauvecl.schema.text import shortened

    number = within(port, "--port", read=count, low=1, high=65535)
    if find_spec("bokeh") is None or find_spec("tornado") is None:
        raise InputError("Bokeh is missing", "it for the page: pip install 'mauvecl[web]'", key="bokeh")
    from mauvecl.web.server import serve

    try:
        serve(address, number, show=show, allow_origin=allow_origin or ())
    except OSError as error:
        raise InputError(
            f"port {port} of {shortened(address)} cannot be used ({error.strerror})",
            "another: --port",
            key="port",
            value=port,
        ) from error
