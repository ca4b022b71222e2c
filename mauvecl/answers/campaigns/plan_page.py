"""A plan's report as one page of HTML that needs nothing beside it."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

from mauvecl.answers.campaigns.plan_text import SUMMARY, SUMMARY_TABLE, heading, summary_rows, target_lines
from mauvecl.host.plotting import picture
from mauvecl.host.version import VERSION

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer

STYLE = (
    "body{font-family:sans-serif;max-width:60em;margin:2em auto;font-size:14px}"
    "table{border-collapse:collapse;margin:1em 0}"
    "td,th{padding:.2em .7em;text-align:left;border-bottom:1px solid #ccc;vertical-align:top}.from{color:#666}"
    "section{break-before:page}img{max-width:100%}"
)


def report_html(found: PlanAnswer) -> bytes:
    """The report: summary, a section for each target with its pictures where matplotlib is there, assumptions."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>Mauve: {escape(heading(found))}</title>",
        f"<style>{STYLE}</style><h1>Mauve: yields of a campaign</h1>",
        f"<p>{escape(heading(found))}; mauvecl {VERSION}.</p>",
        _table(SUMMARY, summary_rows(found)),
        f"<p class=from>Numbers are those of {SUMMARY_TABLE}.</p>",
        *(f"<p>{escape(message)}</p>" for message in found.messages),
    ]
    for k, one in enumerate(found.planned):
        parts.append(f"<section><h2>{escape(one.name)}</h2>{_table(('', '', 'table: column'), target_lines(found, k))}")
        image = _image(found, k)
        if image:
            parts.append(f"<img alt='hours and energies of {escape(one.name, quote=True)}' src='{image}'>")
        parts.append("</section>")
    table = found.assumptions
    rows = [tuple(str(cell) for cell in row) for row in table]
    parts.append(f"<section><h2>What is assumed</h2>{_table(table.colnames, rows)}</section></html>")
    return "\n".join(parts).encode()


def _table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in names)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _image(found: PlanAnswer, k: int) -> str:
    from importlib.util import find_spec

    if find_spec("matplotlib") is None:
        return ""
    return "data:image/png;base64," + base64.b64encode(picture("plan_report.target_png", found, k)).decode()
