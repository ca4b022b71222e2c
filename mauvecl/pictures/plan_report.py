"""Pictures of a plan: an overview of all targets, and a PDF report for proposals with a page per target."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.campaigns.plan_lines import LEGEND, target_lines
from mauvecl.host.version import VERSION
from mauvecl.pictures.registry import document_of, picture_of
from mauvecl.pictures.style import COLOURS, NULL, STYLE, canvas, save_or_return
from mauvecl.pictures.visibility import calendar

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.plan import PlanAnswer

#: A4, and its margin, inches.
PAGE, MARGIN = (8.27, 11.69), 0.6
#: Approximate width of a letter divided by its size, for line breaks; line spacing divided by the size.
LETTER, LINE = 0.53, 1.4
#: Starts of the columns of the summary and of the assumptions, as fractions of the text width.
SUMMARY_AT = (0.0, 0.16, 0.235, 0.34, 0.425, 0.51, 0.605, 0.685, 0.755, 0.86)
ASSUMED_AT = (0.0, 0.24, 0.5)
#: Number of colours kept in the pictures of an HTML report.
COLOURS_KEPT = 64
#: Margins of a target's panels, as fractions of the figure; computing them takes longer than drawing the figure.
PANELS = {"left": 0.085, "right": 0.905, "top": 0.955, "bottom": 0.09, "hspace": 0.5}


@picture_of("PlanAnswer", "plan")
def overview(answer: PlanAnswer, path: str | Path | None) -> Any:
    """Plot each target's expected number of flares with the range of 95 % of campaigns, and E50 to E90."""
    plt = canvas()
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 2, figsize=(7.4, 0.24 * len(answer.planned) + 1.5), sharey=True)
        _overview(axes, answer)
        return save_or_return(figure, path)


@picture_of("PlanAnswer", "visible")
def visible(answer: PlanAnswer, path: str | Path | None = None) -> Any:
    """Plot the daily hours of exposure of all targets."""
    return calendar(answer.seen, path)


def overview_png(answer: PlanAnswer) -> bytes:
    """Return the overview as PNG."""
    plt = canvas()
    with plt.rc_context(STYLE):
        figure = overview(answer, None)
        return figure_png(plt, figure)


def _overview(axes: Any, answer: PlanAnswer) -> None:
    left, right = axes
    n = len(answer.planned)
    for k, one in enumerate(answer.planned):
        if one.recovered is not None and one.recovered.high > 0:
            # A logarithmic axis cannot show zero.
            least = max(one.recovered.low, 0.05)
            left.plot([least, max(one.recovered.high, least)], [k, k], color=COLOURS[0], linewidth=2.5, alpha=0.5)
            left.plot([max(one.recovered.expected, 0.05)], [k], "o", color=COLOURS[0], ms=4)
        ends = [one.energy_at(0.5), one.energy_at(0.9)]
        if np.isfinite(ends[0]):
            right.plot(ends, [k, k], color=COLOURS[4], linewidth=2.5, alpha=0.5)
            right.plot(ends[:1], [k], "o", color=COLOURS[4], ms=4)
    left.set(xscale="log", xlabel="flares recovered", xlim=(0.05, None))
    left.set_title("expected (dot); 95 % of campaigns")
    # Limits at whole decades avoid labels that overlap.
    ends = [
        energy for one in answer.planned for energy in (one.energy_at(0.5), one.energy_at(0.9)) if np.isfinite(energy)
    ]
    decades = 10.0 ** np.array([np.floor(np.log10(min(ends))), np.ceil(np.log10(max(ends)))]) if ends else None
    right.set(xscale="log", xlabel="bolometric energy (erg)", xlim=decades)
    right.set_title("E50 (dot) to E90")
    left.set_yticks(range(n), [f"{one.name} ({one.hours:.0f} h)" for one in answer.planned], fontsize=8)
    left.set_ylim(n - 0.5, -0.5)


@document_of("PlanAnswer", "plan.pdf", when=lambda answer: answer.study.plan.report == "pdf")
def pdf_bytes(answer: PlanAnswer) -> bytes:
    """Return the report as PDF: summary, a page per target, and all assumptions."""
    from matplotlib.backends.backend_pdf import PdfPages

    plt, made = canvas(), io.BytesIO()
    # Without a date, equal plans give equal files.
    about = {"Title": f"Mauve: {answer.heading}", "Creator": f"mauvecl {VERSION}", "CreationDate": None}
    with plt.rc_context(STYLE | {"pdf.fonttype": 42}), PdfPages(made, metadata=about) as pages:
        targets = [_target(plt, answer, k) for k in range(len(answer.planned))]
        for figure in [*_summary(plt, answer), *targets, *_assumptions(plt, answer)]:
            pages.savefig(figure)
            plt.close(figure)
    return made.getvalue()


def target_png(answer: PlanAnswer, k: int) -> bytes:
    """Return the pictures of a target as PNG."""
    plt = canvas()
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(7.4, 5.4), layout="none")
        _panels(figure, answer, k)
        return figure_png(plt, figure)


def figure_png(plt: Any, figure: Any) -> bytes:
    """Return a figure as PNG with few colours, and close it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    made = io.BytesIO()
    # savefig draws each picture twice.
    figure.set_dpi(110)
    drawn = FigureCanvasAgg(figure)
    drawn.draw()  # type: ignore[no-untyped-call]
    # A palette holds the few colours of a figure in a fourth of the bytes: a report may hold hundreds.
    colours = Image.fromarray(np.asarray(drawn.buffer_rgba())[:, :, :3])  # type: ignore[no-untyped-call]
    colours.quantize(COLOURS_KEPT, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(made, "png")
    plt.close(figure)
    return made.getvalue()


class Sheets:
    """Text that flows over as many pages as it needs."""

    def __init__(self, plt: Any) -> None:
        self._plt = plt
        self.pages: list[Any] = []
        self.left_in = 0.0

    def line(self, cells: Sequence[tuple[float, str]], size: float, **how: Any) -> None:
        """Write cells at fractions of the text width, each wrapped before the start of the next."""
        edges = [*(place for place, _ in cells[1:]), 1.0]
        width = PAGE[0] - 2 * MARGIN
        wrapped = []
        for (place, text), end in zip(cells, edges, strict=True):
            letters = max(8, int((end - place) * width * 72 / (LETTER * size)) - 1)
            wrapped.append((MARGIN + place * width, textwrap.wrap(text, letters) or [""]))
        height = max(len(lines) for _, lines in wrapped) * size * LINE / 72
        y = self.take(height)
        for x, lines in wrapped:
            self.pages[-1].text(x / PAGE[0], y / PAGE[1], "\n".join(lines), fontsize=size, va="top", linespacing=LINE,
                                parse_math=False, **how)  # fmt: skip

    def rule(self) -> None:
        """Draw a line across the page."""
        y = self.take(0.06) / PAGE[1]
        ends = (MARGIN / PAGE[0], 1 - MARGIN / PAGE[0])
        self.pages[-1].add_artist(self._plt.Line2D(ends, (y, y), color=NULL, linewidth=0.5))

    def take(self, height_in: float) -> float:
        """Reserve a height, on a new page if necessary, and return its top in inches from the bottom."""
        if not self.pages or self.left_in < height_in:
            self.pages.append(self._plt.figure(figsize=PAGE, layout="none"))
            self.left_in = PAGE[1] - 2 * MARGIN
        top = MARGIN + self.left_in
        self.left_in -= height_in
        return top


def _summary(plt: Any, answer: PlanAnswer) -> list[Any]:
    sheets = Sheets(plt)
    sheets.line([(0.0, "Mauve: yields of a campaign")], 15)
    sheets.line([(0.0, f"{answer.heading}; mauvecl {VERSION}")], 9)
    sheets.take(0.1)
    headings, cells = answer.views[0].texts()
    for number, row in enumerate([headings, *cells]):
        sheets.line(list(zip(SUMMARY_AT, row, strict=True)), 7, weight="normal" if number else "bold")
        sheets.rule()
    sheets.take(0.05)
    sheets.line([(0.0, LEGEND)], 7, color=NULL)
    height = 0.2 * len(answer.planned) + 1.3
    if height < PAGE[1] - 2 * MARGIN:
        top = sheets.take(height)
        bottom, size = (top - height + 0.55) / PAGE[1], (height - 0.95) / PAGE[1]
        left = sheets.pages[-1].add_axes((0.24, bottom, 0.32, size))
        right = sheets.pages[-1].add_axes((0.6, bottom, 0.32, size), sharey=left)
        right.tick_params(labelleft=False)
        _overview((left, right), answer)
    for message in answer.messages:
        sheets.line([(0.0, message)], 8)
        sheets.take(0.08)
    return sheets.pages


def _assumptions(plt: Any, answer: PlanAnswer) -> list[Any]:
    sheets = Sheets(plt)
    sheets.line([(0.0, "What is assumed")], 14)
    sheets.line([(0.0, "Rows of assumptions.ecsv.")], 8, color=NULL)
    sheets.take(0.1)
    for row in answer.assumptions:
        sheets.line([(place, str(cell)) for place, cell in zip(ASSUMED_AT, row, strict=True)], 7)
        sheets.rule()
    return sheets.pages


def _target(plt: Any, answer: PlanAnswer, k: int) -> Any:
    figure = plt.figure(figsize=PAGE, layout="none")
    # The text is above the pictures.
    margin = MARGIN / PAGE[0]
    pictures = figure.subfigures(2, 3, height_ratios=[0.43, 0.57], width_ratios=[margin, 1 - 2 * margin, margin])[1, 1]
    figure.text(margin, 0.96, answer.planned[k].name, fontsize=14, va="top", parse_math=False)
    figure.text(1 - margin, 0.96, answer.heading, fontsize=8, va="top", ha="right", color=NULL)
    y = 0.925
    for name, value, where in target_lines(answer, k):
        lines = textwrap.wrap(value, 48) or [""]
        figure.text(margin, y, name, fontsize=8, va="top")
        figure.text(0.33, y, "\n".join(lines), fontsize=8, va="top", parse_math=False)
        figure.text(1 - margin, y, where, fontsize=6.5, va="top", ha="right", color=NULL)
        y -= 0.018 * len(lines)
    if answer.planned[k].seen_h > 0:
        _panels(pictures, answer, k)
    return figure


def _panels(figure: Any, answer: PlanAnswer, k: int) -> None:
    """Plot daily hours with elongation, monthly hours, and recovered fraction with the rate by energy."""
    one, seen = answer.planned[k], answer.seen
    top, bottom = figure.subplots(2, 1)
    figure.subplots_adjust(**PANELS)
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
    _plain_decades(bottom.xaxis)
    for share, style in ((0.5, "--"), (0.9, ":")):
        if np.isfinite(one.energy_at(share)):
            bottom.axvline(one.energy_at(share), color=NULL, linestyle=style, linewidth=0.8)
    bottom.set_title("flares recovered (E50 dashed, E90 dotted), and how often they are")
    if one.rates is not None:
        often = bottom.twinx()
        rate = one.rates.per_day_above(energy[shown]) * one.hours / 24
        used = rate > 0
        often.plot(energy[shown][used], rate[used], color=COLOURS[4])
        often.set(yscale="log", ylabel=f"flares above this energy in {one.hours:.0f} h")
        often.spines["right"].set_visible(True)
        often.yaxis.label.set_color(COLOURS[4])
        _plain_decades(often.yaxis)


def _plain_decades(axis: Any) -> None:
    """Label whole decades as 1e33, since minor ticks and formulas take most of the drawing time."""
    from matplotlib.ticker import FuncFormatter, NullLocator

    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}" if 1e-3 <= value < 1e4 else f"{value:.0e}"))
