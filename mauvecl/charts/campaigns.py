"""Pictures and reports of campaigns, as HTML and PDF, and the report of an analysis."""

from __future__ import annotations

import base64
import calendar as months_of_years
import io
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.charts.chart import Area, Dots, Line, Mesh, Panel, Picture, PlotAxis, Rule, Series
from mauvecl.charts.matplotlib import COLOURS, NULL, available, draw_picture, in_rows, new_figure, picture_of, style
from mauvecl.host import VERSION

if TYPE_CHECKING:
    from mauvecl.answers.analyse import AnalyseAnswer
    from mauvecl.answers.plan import PlanAnswer
    from mauvecl.answers.visible import VisibleAnswer

MOST_CALENDARS = 6  # largest number of targets with a calendar each; more targets are rows of one picture
MOST_MONTHS = 8  # largest number of months whose names fit side by side
PAGE, MARGIN = (8.27, 11.69), 0.6  # A4, and its margin, inches
LETTER, BOLD, LINE = 0.53, 1.1, 1.4  # width of a letter and line spacing over the size, and factor for bold letters
#: Starts of the columns of the summary, of a target and of the assumptions, as fractions of the text width.
SUMMARY_AT = (0.0, 0.15, 0.215, 0.31, 0.39, 0.47, 0.55, 0.615, 0.69, 0.755, 0.86)
TARGET_AT, ASSUMED_AT = (0.0, 0.28, 0.72), (0.0, 0.24, 0.5)
SMALL, NORMAL, MANY = 5.5, 7.0, 9  # sizes of text in wide tables and in others, and number of columns of a wide one
COLOURS_KEPT = 64  # number of colours in the pictures of an HTML report
#: Height of a target's panels, inches, and their margins as fractions of it: computing them takes longer than drawing.
PANELS_IN, PANELS = 6.2, {"left": 0.085, "right": 0.98, "top": 0.955, "bottom": 0.09, "hspace": 0.35, "wspace": 0.3}
#: Explanation of the summary's columns.
LEGEND = (
    "E50 and E90: bolometric energies from which on half and 90 % of the flares are recovered. Flares: recovered "
    "in the hours observed, expected by the rates as they are; 95 % of campaigns recover the numbers next to them, by "
    "Poisson's scatter and that of a star's rate; ideal: by the closed form if everything but the noise were known; "
    "P(>= 1): probability of recovering any. False alarms: expected from noise. Numbers are those of plan.ecsv."
)


@picture_of("PlanAnswer", "plan")
def overview(answer: PlanAnswer) -> Picture:
    """Plot each target's expected number of flares with the range of 95 % of campaigns, and E50 to E90."""
    planned, nothing = answer.planned, [np.nan] * 3
    yields = [target.recovered for target in planned]
    flares = np.array([(it.low, it.high, it.expected) if it else nothing for it in yields], np.float64)
    # A logarithmic axis cannot show zero.
    flares[flares == 0] = np.nan
    edge = 0.5 * float(np.fmin.reduce(flares[:, 2], initial=0.1))
    flares[np.isnan(flares[:, 0]) & np.isfinite(flares[:, 1]), 0] = edge
    energies = np.array([[target.energy_at(share) for share in (0.5, 0.9, 0.5)] for target in planned])
    energies[np.isinf(energies)] = np.nan
    # Limits at whole decades avoid labels that overlap.
    logs = np.log10(energies[np.isfinite(energies)])
    decades = (10 ** np.floor(logs.min()), 10 ** np.ceil(logs.max())) if logs.size else None
    names = range(len(planned)), [f"{target.name} ({target.hours:.0f} h)" for target in planned]
    y, x = PlotAxis(limits=(len(planned) - 0.5, -0.5), ticks=names), PlotAxis("flares recovered", True, (edge, None))
    left = Panel(x, y, _bars(flares, "star"), "mean (dot), 95 % of campaigns (edge: 0)")
    x = PlotAxis("bolometric energy (erg)", True, decades)
    right = Panel(x, y, _bars(energies, "flare"), "recovered in 50 % (dot) to 90 %")
    return Picture([[left, right]], (7.4, 0.24 * len(planned) + 1.5), share_y=True)


def _bars(values: Any, colour: str) -> list[Series]:
    """Return a range and a dot of each target, from low, high and middle values, shape (n, 3)."""
    x, y = np.column_stack([values[:, :2], np.full(len(values), np.nan)]).ravel(), np.arange(len(values))
    bars = Line("", colour, width=3.3, alpha=0.5, at=(x, np.repeat(y, 3)))
    return [bars, Dots("", colour, size=7, at=(values[:, 2], y))]


@picture_of("PlanAnswer", "visible", given=lambda answer: (answer.seen,))
@picture_of("VisibleAnswer", "visible")
def calendar(answer: VisibleAnswer) -> Picture:
    """Plot daily hours of exposure: a calendar per target or, for many targets, a row."""
    hours = np.array([answer.visibility.by_day(k) for k in range(len(answer.targets))])
    picture = (_calendars if len(answer.targets) <= MOST_CALENDARS else _rows)(answer, hours)
    kind = "mean orbit" if answer.study.orbit.orbit().resolved(answer.times) == "mean" else "SGP4"
    return replace(picture, title=f"Hours of exposure a day ({kind}); limits are assumptions, no stray light")


def _calendars(answer: VisibleAnswer, hours: Any) -> Picture:
    """Return calendars with days of the month across and months down."""
    months = sorted({day[:7] for day in answer.days})
    across, step = min(len(answer.targets), 2), max(1, len(months) // 14)
    x = PlotAxis("day of the month (UTC)", ticks=([1, 8, 15, 22, 29],))
    names = np.arange(0, len(months), step), [_month(name) for name in months[::step]]
    y, panels = PlotAxis(limits=(len(months) - 0.5, -0.5), ticks=names), list[Panel]()
    for target, daily_hours, total in zip(answer.targets, hours, answer.visibility.hours, strict=True):
        grid = np.full((len(months), 31), np.nan)
        for day, value in zip(answer.days, daily_hours, strict=True):
            grid[months.index(day[:7]), int(day[8:]) - 1] = value
        at = np.arange(0.5, 32), np.arange(-0.5, len(months)), grid
        mesh = Mesh("hours a day", high=max(float(hours.max()), 0.1), edges="white", empty="white", at=at)
        panels.append(Panel(x, y, [mesh], f"{target.name}: {total:.0f} h in {answer.times.days:g} d"))
    rows, height = in_rows(panels, across), max(1.3, 0.17 * len(months) + 0.8)
    return Picture(rows, (3.9 * across + 0.8, height * len(rows) + 0.4), share_x=True)


def _rows(answer: VisibleAnswer, hours: Any) -> Picture:
    """Return targets as rows and days as columns."""
    n = len(answer.targets)
    mesh = Mesh("hours a day", high=None, at=(np.arange(len(answer.days) + 1) - 0.5, np.arange(n + 1) - 0.5, hours))
    step = max(1, n // 60)
    names = np.arange(0, n, step), [target.name for target in answer.targets[::step]]
    panel = Panel(
        PlotAxis(ticks=_first_days(answer, MOST_MONTHS)), PlotAxis(limits=(n - 0.5, -0.5), ticks=names), [mesh]
    )
    return Picture([[panel]], (7.4, min(0.16 * n + 1.4, 20.0)))


def _first_days(answer: VisibleAnswer, most: int) -> tuple[list[int], list[str]]:
    """Return the places of at most some first days of months, and the months."""
    firsts = [i for i, day in enumerate(answer.days) if day.endswith("-01")]
    firsts = firsts[:: -(-len(firsts) // most) or 1]
    return firsts, [_month(answer.days[i]) for i in firsts]


def _month(day: str) -> str:
    return f"{months_of_years.month_abbr[int(day[5:7])]} {day[:4]}"


@dataclass(frozen=True)
class ReportPart:
    """Part of a report, from top to bottom: heading, sentences, a table with a note on it, and a picture."""

    heading: str = ""
    lines: Sequence[str] = ()
    names: Sequence[str] = ()  # headings of the table
    rows: Sequence[Sequence[object]] = ()
    places: Sequence[float] = ()  # starts of its columns, as fractions of the text width; evenly spaced by default
    links: int = 0  # number of the part to which the first row is a link, if rows are links to the parts that follow
    note: str = ""
    # Draws in a part of a page, or in a figure of its own if it is given none, which it returns.
    picture: Callable[[Any], Any] | None = None
    text: str = ""  # the picture in words
    height_in: float = 0.0  # of the picture on a page; 0 for a page of its own
    new_page: bool = False


def html_image(draw: Callable[[Any], Any], text: str) -> str:
    """Return a figure as an image of few colours; nothing if matplotlib is not installed."""
    if not available():
        return ""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    content = io.BytesIO()
    with style():
        figure = draw(None)
        # savefig draws each picture twice.
        figure.set_dpi(110)
        drawn = FigureCanvasAgg(figure)
        drawn.draw()  # type: ignore[no-untyped-call]
    # A palette holds the few colours of a figure in a fourth of the bytes: a report may hold hundreds.
    colours = Image.fromarray(np.asarray(drawn.buffer_rgba())[:, :, :3])  # type: ignore[no-untyped-call]
    colours.quantize(COLOURS_KEPT, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(content, "png")
    encoded = base64.b64encode(content.getvalue()).decode()
    return f"<img alt='{escape(text, quote=True)}' src='data:image/png;base64,{encoded}'>"


class TextPages:
    """Text that flows over as many pages as it needs."""

    def __init__(self) -> None:
        self.pages: list[Any] = []
        self.left_in = 0.0

    def add(self, part: ReportPart) -> None:
        """Write a part of a report."""
        from matplotlib.lines import Line2D

        if part.new_page:
            self.left_in = 0.0
        if part.heading:
            self.take(0.1)
            self.line([(0.0, part.heading)], 12 if self.pages[1:] else 14)
        for text in part.lines:
            self.line([(0.0, text)], 8)
            self.take(0.05)
        places = part.places or [k / len(part.names) for k in range(len(part.names))]
        head = [part.names] if any(part.names) else []
        size = SMALL if len(part.names) >= MANY and not part.places else NORMAL
        for number, row in enumerate([*head, *part.rows]):
            weight = "bold" if head and not number else "normal"
            self.line([(place, str(cell)) for place, cell in zip(places, row, strict=True)], size, weight=weight)
            y, ends = self.take(0.06) / PAGE[1], (MARGIN / PAGE[0], 1 - MARGIN / PAGE[0])
            self.pages[-1].add_artist(Line2D(ends, (y, y), color=NULL, linewidth=0.5))
        if part.note:
            self.line([(0.0, part.note)], NORMAL, color=NULL)
        if part.picture is not None and part.height_in:
            # Of the width of the text.
            top, margin = self.take(part.height_in) / PAGE[1], MARGIN / PAGE[0]
            heights = [1 - top, part.height_in / PAGE[1], top - part.height_in / PAGE[1]]
            widths = [margin, 1 - 2 * margin, margin]
            part.picture(self.pages[-1].subfigures(3, 3, height_ratios=heights, width_ratios=widths)[1, 1])
        elif part.picture is not None:
            self.pages.append(part.picture(None))
            self.left_in = 0.0

    def line(self, cells: Sequence[tuple[float, str]], size: float, **look: Any) -> None:
        """Write cells at fractions of the text width, each wrapped before the start of the next."""
        edges = [*(place for place, _ in cells[1:]), 1.0]
        width, letter = PAGE[0] - 2 * MARGIN, LETTER * (BOLD if look.get("weight") == "bold" else 1.0)
        wrapped = []
        for (place, text), end in zip(cells, edges, strict=True):
            letters = max(5, int((end - place) * width * 72 / (letter * size)) - 1)
            wrapped.append((MARGIN + place * width, textwrap.wrap(text, letters) or [""]))
        height = max(len(lines) for _, lines in wrapped) * size * LINE / 72
        y = self.take(height)
        for x, lines in wrapped:
            self.pages[-1].text(x / PAGE[0], y / PAGE[1], "\n".join(lines), fontsize=size, va="top", linespacing=LINE,
                                parse_math=False, **look)  # fmt: skip

    def take(self, height_in: float) -> float:
        """Reserve a height, on a new page if necessary, and return its top in inches from the bottom."""
        if not self.pages or self.left_in < height_in:
            self.pages.append(new_figure(PAGE, layout="none"))
            self.left_in = PAGE[1] - 2 * MARGIN
        top = MARGIN + self.left_in
        self.left_in -= height_in
        return top


def plan_report(answer: PlanAnswer) -> tuple[str, list[ReportPart]]:
    """Return title and parts of a plan's report: summary, messages, a part for each target, and all assumptions."""
    height = 0.2 * len(answer.planned) + 1.3

    def all_targets(figure: Any) -> Any:
        drawn = draw_picture(overview(answer), figure)
        if figure is not None:
            drawn.subplots_adjust(left=0.2, right=0.98, bottom=0.6 / height, top=1 - 0.3 / height)
        return drawn

    view = answer.views[0]
    headings, rows = view.texts()
    names = [column.name for column in view.columns if column.heading]
    fits, text = height < PAGE[1] - 2 * MARGIN, "flares expected and energies of all targets"
    parts = [
        ReportPart(
            f"{answer.instrument_name}: yields of a campaign", [f"{answer.heading}; mauvecl {VERSION}."],
            headings, rows, SUMMARY_AT, 2, LEGEND, all_targets, text, height if fits else 0.0,
        ),
        ReportPart(lines=answer.messages),
    ]  # fmt: skip
    for k, (target, row) in enumerate(zip(answer.planned, rows, strict=True)):
        draw = partial(_panels, answer, k) if target.seen_h > 0 else None
        lines = _target_lines(answer, k, dict(zip(names, row, strict=True)))
        parts.append(ReportPart(
            target.name, (), ("", "", "table: column"), lines, TARGET_AT, picture=draw,
            text=f"hours and energies of {target.name}", height_in=PANELS_IN, new_page=True,
        ))  # fmt: skip
    assumed = answer.assumptions
    note = "Rows of assumptions.ecsv."
    parts.append(ReportPart("What is assumed", [note], assumed.colnames, list(assumed), ASSUMED_AT, new_page=True))
    return f"{answer.instrument_name}: {answer.heading}", parts


def _target_lines(answer: PlanAnswer, k: int, cells: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """Return the lines on a target: quantity, value, and the file and column of the value.

    `cells` has the texts of the target in the table of the plan, by column.
    """
    target, observation = answer.planned[k], answer.planned[k].observation
    place, star, visible = observation.target, observation.case.star, answer.seen
    lines = [
        ("right ascension, declination", f"{place.ra_deg:.4f}, {place.dec_deg:.4f} deg ({place.source})",
         "stars: ra, dec, position"),
        ("type; spectrum that stands for it", f"{place.spectral_type}; {star.library}",
         "stars: spectral_type, spectrum"),
        ("V; distance", f"{star.magnitude:g}; {star.distance_pc:g} pc", "stars: V, distance"),
        ("seen; observed", f"{cells['seen']} h; {cells['hours']} h", "plan: seen, hours"),
    ]  # fmt: skip
    if target.seen_h == 0:
        return [*lines, ("never seen", visible.reason(place.name), "assumptions")]
    away = visible.elongation_deg(k)
    lines += [
        ("median stretch", f"{observation.window_s / 60:.0f} min", "stars: window"),
        ("best months", cells["best_months"], "plan: best_months; months"),
        ("angle from the Sun", f"{away.min():.0f} to {away.max():.0f} deg", "days: elongation"),
        ("detector; hits by particles", f"{observation.quiet.conditions['temperature_c']:.1f} deg C; "
         f"{observation.case.study.processes.particles_per_cm2_s:.2f} per cm^2 and s", "stars: temperature, hits"),
        ("S/N of a frame at amplitude 1", f"{observation.signal_per_frame:.4g}", "stars: signal_per_frame"),
        ("half of flares recovered from (erg)", cells["E50"], "plan: E50; energies: recovered"),
        ("90 % of flares recovered from (erg)", cells["E90"], "plan: E90; energies: recovered"),
    ]  # fmt: skip
    if target.recovered is not None:
        lines += [
            ("flares recovered, expected", cells["expected"], "plan: expected; stars: recovered_per_day"),
            ("95 % of campaigns", cells["low"], "plan: low, high; stars: scatter"),
            ("probability of at least one", cells["at_least_one"], "plan: at_least_one"),
        ]
    lines.append(("false alarms expected", cells["false_alarms"], "plan: false_alarms"))
    rates = target.no_rates if target.rates is None else target.rates.source
    lines.append(("flare rates", rates, "stars: rates; assumptions"))
    return lines


def _panels(answer: PlanAnswer, k: int, figure: Any) -> Any:
    """Plot the daily hours of a target, its angle from the Sun, and its recovered fraction and rate by energy."""
    target, visible, days = answer.planned[k], answer.seen, np.arange(len(answer.seen.days))
    x = PlotAxis(limits=(0, max(len(days) - 1, 1)), ticks=_first_days(visible, MOST_MONTHS // 2))
    hours = Area("", COLOURS[3], alpha=1.0, step=True, at=(days, np.zeros(days.size), visible.visibility.by_day(k)))
    away = Line("", "flare", at=(days, visible.elongation_deg(k)))
    rows = [[
        Panel(x, PlotAxis("hours a day", limits=(0, None)), [hours], "when it is seen"),
        Panel(x, PlotAxis("angle from the Sun (deg)", limits=(0, 180)), [away]),
    ]]  # fmt: skip
    if target.completeness is not None:
        row, x = target.by_energy, PlotAxis("bolometric energy (erg)", log=True)
        energy, often = row["energy"], row["rate_above"] * target.hours / 24
        share = Line("", "star", at=(energy, row["recovered"]))
        limits = [(target.energy_at(p), dash) for p, dash in ((0.5, "--"), (0.9, ":"))]
        series = [share, *(Rule("", dash=dash, at=at) for at, dash in limits if np.isfinite(at))]
        y = PlotAxis("share recovered", limits=(0, 1.02))
        rows.append([Panel(x, y, series, "flares recovered (E50 dashed, E90 dotted)", _plain_decades)])
        if target.rates is not None:
            rate = Line("", "flare", at=(energy, np.where(often > 0, often, np.nan)))
            above = PlotAxis(f"flares above this energy in {target.hours:.0f} h", log=True)
            rows[-1].append(Panel(x, above, [rate], "how often they are", _plain_decades))
    figure = draw_picture(Picture(rows), figure or new_figure((7.4, 5.4), layout="none"))
    figure.subplots_adjust(**PANELS)
    return figure


def _plain_decades(axes: Any) -> None:
    """Label whole decades as 1e33, since minor ticks and formulas take most of the drawing time."""
    from matplotlib.ticker import LogLocator, NullLocator

    for axis in (axis for axis in (axes.xaxis, axes.yaxis) if axis.get_scale() == "log"):
        axis.set_major_locator(LogLocator())
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(lambda value, _: f"{value:g}" if 1e-3 <= value < 1e4 else f"{value:.0e}")


def analysis_report(answer: AnalyseAnswer) -> tuple[str, list[ReportPart]]:
    """Return title and parts of an analysis's report: messages, tables without empty columns, remarks, and pictures."""
    frames = answer.analysis.frames
    title = f"{frames.name}: {frames.n_frames} frames from {frames.date(float(frames.time_s[0]))[:19]}"
    parts = [ReportPart(title, [f"Analysed by mauvecl {VERSION}. {answer.assumed}", *answer.messages])]
    parts += [ReportPart(view.title, (), *view.texts(empty=False)) for view in answer.all_views]
    parts.append(ReportPart(lines=answer.remarks, note="Every number is a row of the tables next to this report."))
    return title, parts + [ReportPart(picture=draw, text=name) for name, draw in answer.pictures.items()]


#: Functions that return title and parts of the report of an answer, by its class.
REPORTS: dict[str, Callable[[Any], tuple[str, list[ReportPart]]]] = {
    "PlanAnswer": plan_report,
    "AnalyseAnswer": analysis_report,
}


def report(answer: Any, form: str) -> bytes:
    """Return the report of a plan or an analysis as "html", with pictures if matplotlib is installed, or as "pdf"."""
    title, parts = REPORTS[type(answer).__name__](answer)
    if form == "html":
        from mako.template import Template

        path = Path(__file__).with_name("reports.html.mako")
        filters, imports = ["str", "escape"], ["from html import escape"]
        template = Template(filename=str(path), default_filters=filters, imports=imports, strict_undefined=True)
        return str(template.render(title=title, parts=parts, html_image=html_image)).encode()
    from matplotlib.backends.backend_pdf import PdfPages

    # Without a date, so that equal answers give equal files.
    content, about = io.BytesIO(), {"Title": title, "Creator": f"mauvecl {VERSION}", "CreationDate": None}
    with style(), PdfPages(content, metadata=about) as pages:
        sheets = TextPages()
        for part in parts:
            sheets.add(part)
        for figure in sheets.pages:
            pages.savefig(figure)
    return content.getvalue()
