"""Text on the page: whatever comes from a visitor, a link or a file stays text."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import Any

from bokeh.models.widgets import Div

#: Colours of what is told; dark on light with a contrast of at least 7.
KINDS = {"danger": "#fbe3e4", "warning": "#fff3cd", "info": "#e3f1fb"}


def line(text: str = "", **how: Any) -> Div:
    """A line of HTML of our own; `escaped` makes others' text part of it. It changes without a look at the page."""
    return Div(text=text, sizing_mode="stretch_width", disable_math=True, **how)


def escaped(text: str) -> str:
    """Text as HTML that shows it as it is."""
    return escape(text, quote=True)


def alerts(told: Iterable[tuple[str, str]]) -> str:
    """Sentences with their kinds, as HTML."""
    return "".join(
        f'<p role="alert" style="background:{KINDS[kind]};color:#000;padding:.6em 1em">{escaped(text)}</p>'
        for text, kind in told
    )
