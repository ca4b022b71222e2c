"""A plan as pictures: all targets beside each other, and a report for a proposal's appendix, a page for each target."""

from __future__ import annotations

import io
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.campaigns.plan_text import SUMMARY, SUMMARY_TABLE, heading, summary_rows, target_lines
from mauvecl.host.version import VERSION
from mauvecl.pictures.style import COLOURS, NULL, STYLE, finished, pyplot

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer

#: A4, inches.
PAGE = (8.27, 11.69)
#: Rows of text on a page.
LINES = 66


def overview(found: PlanAnswer, path: str | Path | None) -> Any:
    """Flares expected of each target with 95 % of campaigns, and E50 to E90."""
    plt = pyplot()
    n = len(found.planned)
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(7.4, 0.24 * n + 1.5), sharey=True)
        for k, one in enumerate(found.planned):
            if one.found is not None and one.found.high > 0:
                # A logarithmic axis has no zero.
                least = max(one.found.low, 0.05)
                left.plot([least, max(one.found.high, least)], [k, k], color=COLOURS[0], linewidth=2.5, alpha=0.5)
                left.plot([max(one.found.expected, 0.05)], [k], "o", color=COLOURS[0], ms=4)
            ends = [one.energy_at(0.5), one.energy_at(0.9)]
            if np.isfinite(ends[0]):
                right.plot(ends, [k, k], color=COLOURS[4], linewidth=2.5, alpha=0.5)
                right.plot(ends[:1], [k], "o", color=COLOURS[4], ms=4)
        left.set(xscale="log", xlabel="flares recovered", xlim=(0.05, None))
        left.set_title("expected; 95 % of campaigns")
        right.set(xscale="log", xlabel="bolometric energy (erg)")
        right.set_title("E50 (dot) to E90")
        left.set_yticks(range(n), [f"{one.name} ({one.hours:.0f} h)" for one in found.planned], fontsize=8)
        left.set_ylim(n - 0.5, -0.5)
        return finished(figure, path)


def pdf_bytes(found: PlanAnswer) -> bytes:
    """The report as PDF: the summary, a page for each target, every assumption."""
    from matplotlib.backends.backend_pdf import PdfPages

    plt, made = pyplot(), io.BytesIO()
    # Without a date the same plan is the same file.
    about = {"Title": f"Mauve: {heading(found)}", "Creator": f"mauvecl {VERSION}", "CreationDate": None}
    with plt.rc_context(STYLE | {"pdf.fonttype": 42}), PdfPages(made, metadata=about) as pages:
        drawn = [*_summary(plt, found), *(_target(plt, found, k) for k in range(len(found.planned)))]
        for figure in [*drawn, *_assumptions(plt, found)]:
            pages.savefig(figure)
            plt.close(figure)
    return made.getvalue()


def target_png(found: PlanAnswer, k: int) -> bytes:
    """The pictures of one target as PNG."""
    plt, made = pyplot(), io.BytesIO()
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(7.4, 5.4))
        _panels(figure, found, k)
        figure.savefig(made, format="png", dpi=110)
        plt.close(figure)
    return made.getvalue()


def _summary(plt: Any, found: PlanAnswer) -> list[Any]:
    rows = summary_rows(found)
    lines = [f"Mauve: {heading(found)}", f"mauvecl {VERSION}; numbers are those of {SUMMARY_TABLE}", ""]
    lines += _columns([SUMMARY, *rows])
    lines += ["", *(line for message in found.messages for line in [*textwrap.wrap(message, 108), ""])]
    return _text_pages(plt, lines, 7.0)


def _assumptions(plt: Any, found: PlanAnswer) -> list[Any]:
    lines = ["What is assumed (assumptions.ecsv)", ""]
    for name, value, source in found.assumptions:
        told = ": ".join(part for part in (str(name), str(value)) if part)
        lines += [*textwrap.wrap(told, 108), *textwrap.wrap(str(source), 104, initial_indent="    ",
                                                            subsequent_indent="    "), ""]  # fmt: skip
    return _text_pages(plt, lines, 7.0)


def _columns(rows: list[tuple[str, ...]]) -> list[str]:
    """Rows of text with blanks between columns."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return [text[0], "-" * max(map(len, text)), *text[1:]]


def _text_pages(plt: Any, lines: list[str], size: float) -> list[Any]:
    """Lines of one width on as many pages as they need, smaller where a line is long."""
    found = []
    longest = max(map(len, lines))
    for first in range(0, len(lines), LINES):
        figure = plt.figure(figsize=PAGE)
        # A letter is some 0.6 of its size wide; 7.3 inches are there.
        figure.text(0.06, 0.96, "\n".join(lines[first : first + LINES]), family="monospace", va="top",
                    fontsize=min(size, 7.3 * 72 / (0.605 * longest)), linespacing=1.45, parse_math=False)  # fmt: skip
        found.append(figure)
    return found


def _target(plt: Any, found: PlanAnswer, k: int) -> Any:
    figure = plt.figure(figsize=PAGE)
    words, pictures = figure.subfigures(2, 1, height_ratios=[1, 1.35])
    words.text(0.07, 0.95, found.planned[k].name, fontsize=14, va="top", parse_math=False)
    words.text(0.93, 0.95, heading(found), fontsize=8, va="top", ha="right", color=NULL)
    y = 0.84
    for name, value, where in target_lines(found, k):
        told = textwrap.wrap(value, 66) or [""]
        words.text(0.07, y, name, fontsize=8, va="top")
        words.text(0.33, y, "\n".join(told), fontsize=8, va="top", parse_math=False)
        words.text(0.93, y, where, fontsize=6.5, va="top", ha="right", color=NULL)
        y -= 0.048 * len(told)
    _panels(pictures, found, k)
    return figure


def _panels(figure: Any, found: PlanAnswer, k: int) -> None:
    """Hours a day with elongation, hours by month, and recovered share with the rate by energy."""
    one, seen = found.planned[k], found.seen
    top, bottom = figure.subplots(2, 1)
    days = np.arange(len(seen.days))
    top.fill_between(days, seen.visibility.by_day(k), step="mid", color=COLOURS[1], linewidth=0)
    top.set(ylabel="hours a day", xlim=(0, max(len(days) - 1, 1)), ylim=(0, None))
    firsts = [i for i, day in enumerate(seen.days) if day.endswith("-01")]
    step = max(1, len(firsts) // 12)
    top.set_xticks(firsts[::step], [seen.days[i][:7] for i in firsts[::step]], fontsize=7, rotation=30)
    sun = top.twinx()
    sun.plot(days, seen.elongation_deg(k), color=COLOURS[4])
    sun.set(ylabel="angle from the Sun (deg)", ylim=(0, 180))
    sun.spines["right"].set_visible(True)
    sun.yaxis.label.set_color(COLOURS[4])
    top.set_title("when it is seen")
    if one.completeness is None:
        bottom.set_visible(False)
        return
    energy, p = one.completeness.energy_erg, one.completeness.probability
    first = int(np.argmax(p > 0))
    shown = slice(max(first - 4, 0), min(first + 100, energy.size))
    bottom.plot(energy[shown], p[shown], color=COLOURS[0])
    bottom.set(xscale="log", xlabel="bolometric energy (erg)", ylabel="share recovered", ylim=(0, 1.02))
    bottom.yaxis.label.set_color(COLOURS[0])
    for share, style in ((0.5, "--"), (0.9, ":")):
        if np.isfinite(one.energy_at(share)):
            bottom.axvline(one.energy_at(share), color=NULL, linestyle=style, linewidth=0.8)
    bottom.set_title("flares recovered (E50 dashed, E90 dotted), and how often they are")
    if one.rates is not None:
        often = bottom.twinx()
        rate = one.rates.per_day_above(energy[shown]) * one.hours / 24
        used = rate > 0
        often.plot(energy[shown][used], rate[used], color=COLOURS[4])
        often.set(yscale="log", ylabel=f"flares of so much or more in {one.hours:.0f} h")
        often.spines["right"].set_visible(True)
        often.yaxis.label.set_color(COLOURS[4])
