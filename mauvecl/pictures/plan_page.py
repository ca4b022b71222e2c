"""Report of a plan as one self-contained HTML page."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

from mauvecl.answers.campaigns.plan_lines import LEGEND, target_lines
from mauvecl.host.version import VERSION
from mauvecl.pictures.plan_report import overview_png, target_png
from mauvecl.pictures.registry import document_of
from mauvecl.pictures.style import available

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer

STYLE = (
    "body{font-family:sans-serif;max-width:60em;margin:2em auto;font-size:14px;line-height:1.35}"
    "table{border-collapse:collapse;margin:1em 0}img{max-width:100%;break-inside:avoid}"
    "td,th{padding:.2em .7em;text-align:left;border-bottom:1px solid #ccc;vertical-align:top}.from{color:#666}"
    ".numbers td:nth-child(n+2):not(:last-child),.numbers th:nth-child(n+2):not(:last-child){text-align:right}"
    "section{break-before:page}h2{break-after:avoid}@media print{body{font-size:11px}}"
)


@document_of("PlanAnswer", "plan.html", when=lambda answer: answer.study.plan.report == "html")
def report_html(answer: PlanAnswer) -> bytes:
    """Return the report: summary, a section per target (with pictures if matplotlib is installed), assumptions."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>Mauve: {escape(answer.heading)}</title>",
        f"<style>{STYLE}</style><h1>Mauve: yields of a campaign</h1>",
        f"<p>{escape(answer.heading)}; mauvecl {VERSION}.</p>",
        html_table(*answer.views[0].texts(), "numbers", link=True),
        f"<p class=from>{escape(LEGEND)}</p>",
        html_image(overview_png, answer, text="flares expected and energies of all targets"),
        *(f"<p>{escape(message)}</p>" for message in answer.messages),
    ]
    for k, one in enumerate(answer.planned):
        lines = html_table(("", "", "table: column"), target_lines(answer, k))
        parts.append(f"<section id=target-{k}><h2>{escape(one.name)}</h2>{lines}")
        if one.seen_h > 0:
            parts.append(html_image(target_png, answer, k, text=f"hours and energies of {one.name}"))
        parts.append("</section>")
    table = answer.assumptions
    rows = [tuple(str(cell) for cell in row) for row in table]
    parts.append(
        "<section><h2>What is assumed</h2><p class=from>Rows of assumptions.ecsv.</p>"
        f"{html_table(table.colnames, rows)}"
        "</section></html>"
    )
    return "\n".join(parts).encode()


def html_table(names: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "", *, link: bool = False) -> str:
    """Return a table; `link` makes the first cell of row k lead to the section of target k."""
    head = "".join(f"<th>{escape(name)}</th>" for name in names)
    body = ""
    for k, row in enumerate(rows):
        cells = [escape(cell) for cell in row]
        if link:
            cells[0] = f"<a href='#target-{k}'>{cells[0]}</a>"
        body += "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
    return f"<table class='{kind}'><tr>{head}</tr>{body}</table>"


def html_image(draw: Callable[..., bytes], *what: object, text: str) -> str:
    """Return an image with its content; nothing if matplotlib is not installed."""
    if not available():
        return ""
    content = base64.b64encode(draw(*what)).decode()
    return f"<img alt='{escape(text, quote=True)}' src='data:image/png;base64,{content}'>"
