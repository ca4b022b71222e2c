"""Report of the analysis of observed frames, as one self-contained HTML page or as PDF."""

from __future__ import annotations

import io
from functools import partial
from html import escape
from typing import TYPE_CHECKING, Any

from mauvecl.host.version import VERSION
from mauvecl.pictures.plan_page import STYLE as PAGE_STYLE
from mauvecl.pictures.plan_page import html_image, html_table
from mauvecl.pictures.plan_report import Sheets, figure_png
from mauvecl.pictures.registry import document_of, pictures_of
from mauvecl.pictures.style import NULL, STYLE, canvas
from mauvecl.schema.tables import without_empty

if TYPE_CHECKING:
    from mauvecl.answers.observations.analyse import AnalyseAnswer

#: Sizes of text on a page of A4: of tables with many columns, and of others.
SMALL, NORMAL = 5.5, 7.0
#: Number of columns from which a table has small letters.
MANY = 9


def title(answer: AnalyseAnswer) -> str:
    """Return the heading of the report."""
    frames = answer.analysis.frames
    return f"{frames.name}: {frames.n_frames} frames from {frames.date(float(frames.time_s[0]))[:19]}"


def _sections(answer: AnalyseAnswer) -> list[tuple[str, list[str], list[list[str]]]]:
    """Return title, headings and cells of each table, without empty columns."""
    return [(view.title, *without_empty(*view.texts())) for view in answer.all_views]


@document_of("AnalyseAnswer", "analyse.html", when=lambda answer: answer.study.data.report == "html")
def report_html(answer: AnalyseAnswer) -> bytes:
    """Return the report: messages, tables, remarks, and pictures if matplotlib is installed."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(title(answer))}</title>",
        f"<style>{PAGE_STYLE}</style><h1>{escape(title(answer))}</h1>",
        f"<p>Analysed by mauvecl {VERSION}. {escape(answer.assumed)}</p>",
        *(f"<p>{escape(text)}</p>" for text in answer.messages),
    ]
    for heading, names, cells in _sections(answer):
        parts.append(f"<h2>{escape(heading)}</h2>{html_table(names, cells) if names else ''}")
    parts += [f"<p>{escape(text)}</p>" for text in answer.remarks]
    for name, draw in pictures_of(answer).items():
        parts.append(html_image(partial(_png, draw), text=name))
    return "\n".join([*parts, "</html>"]).encode()


def _png(draw: Any) -> bytes:
    plt = canvas()
    with plt.rc_context(STYLE):
        return figure_png(plt, draw())


@document_of("AnalyseAnswer", "analyse.pdf", when=lambda answer: answer.study.data.report == "pdf")
def report_pdf(answer: AnalyseAnswer) -> bytes:
    """Return the report as PDF: messages, tables, remarks, and a page for each picture."""
    from matplotlib.backends.backend_pdf import PdfPages

    plt, made = canvas(), io.BytesIO()
    # Without a date, equal analyses give equal files.
    about = {"Title": title(answer), "Creator": f"mauvecl {VERSION}", "CreationDate": None}
    with plt.rc_context(STYLE | {"pdf.fonttype": 42}), PdfPages(made, metadata=about) as pages:
        sheets = Sheets(plt)
        sheets.line([(0.0, title(answer))], 14)
        for text in (f"Analysed by mauvecl {VERSION}. {answer.assumed}", *answer.messages, *answer.remarks):
            sheets.line([(0.0, text)], 8)
            sheets.take(0.05)
        for heading, names, cells in _sections(answer):
            sheets.take(0.1)
            sheets.line([(0.0, heading)], 10)
            size = SMALL if len(names) >= MANY else NORMAL
            for number, row in enumerate([names, *cells] if names else []):
                places = [k / len(row) for k in range(len(row))]
                sheets.line(list(zip(places, row, strict=True)), size, weight="normal" if number else "bold")
                sheets.rule()
        sheets.line([(0.0, "Every number is a row of the tables next to this report.")], SMALL, color=NULL)
        for figure in [*sheets.pages, *(draw() for draw in pictures_of(answer).values())]:
            pages.savefig(figure)
            plt.close(figure)
    return made.getvalue()
