"""Tabs of light curves: observed frames and the completeness of a search."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.charts.chart import (
    Axis,
    Band,
    Chart,
    ChartData,
    Contours,
    Custom,
    Dots,
    Line,
    Listed,
    Rule,
    Strips,
)
from mauvecl.charts.light_curves import SCATTER, scatter_series
from mauvecl.schema.columns import View
from mauvecl.schema.errors import InputError
from mauvecl.web.closed_forms import Answers, percent, short
from mauvecl.web.tabs.tab import Tab
from mauvecl.web.uploads import MOST_VALUES, read_frames_of

if TYPE_CHECKING:
    from astropy.table import Table
    from bokeh.models.sources import ColumnDataSource

    from mauvecl.answers.analyse import AnalyseAnswer
    from mauvecl.observations.analysis import Analysis
    from mauvecl.observations.frames import Frames
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.figures import Canvas
    from mauvecl.web.question import Question

Float = NDArray[np.float64]

#: Largest numbers of points of a light curve, and of columns and rows of a dynamic spectrum.
MOST_POINTS, MOST_COLUMNS, MOST_ROWS = 8000, 600, 300
#: Verdicts on events, with their colours.
VERDICTS = {"detected": "star", "candidate": "drawn", "rejected": "own", "undecided": "dark"}
#: Colours of the dynamic spectrum.
BLUE, RED = "#0072B2", "#D55E00"
NO_FILE = "Choose a file of frames: a light curve or a sequence of spectra."


def frames_of(closed: ClosedForms) -> Frames | None:
    """Return the frames of the question, or None if there is no file."""
    frames: Frames | None = closed.given.get("frames")
    return frames


def minutes(frames: Frames, time_s: Any) -> Float:
    """Return times in minutes from the first frame."""
    return np.asarray(time_s - frames.time_s[0]) / 60.0


def thinned(values: Float, most: int) -> NDArray[np.int64]:
    """Return the indices of at most `most` values, including the smallest and largest of each part."""
    if values.size <= most:
        return np.arange(values.size)
    parts = np.array_split(np.arange(values.size), most // 2)
    ends = [(part[np.argmin(values[part])], part[np.argmax(values[part])]) for part in parts]
    return np.unique(np.array(ends))


@Chart(
    "frames", "Light curve", Axis("time from the first frame (min)"), Axis("flux"),
    (
        *(Strips(verdict, colour, f"{verdict} events") for verdict, colour in VERDICTS.items()),
        Line("quiescent level", "flare", "level"),
        # A bad frame far away does not compress the others.
        Dots("frames", "text", "searched", size=3, tips=("minute", "flux"), alone=True),
        Dots("not searched", "own", "left out", size=6, marker="x"),
    ),
    logs=("y",),
).data()  # fmt: skip
def light_curve(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the light curve, its quiescent level, and the events."""
    frames, series = frames_of(closed), dict[str, Any]()
    if frames is None:
        return ChartData(NO_FILE)
    flux, used = frames.white_light[0], frames.faults == 0
    text = f"{frames.n_frames} frames of {frames.name}. Analyse searches them for flares."
    if "analyse" in answers:
        answer = answers["analyse"]
        analysis: Analysis = answer.analysis
        flux, used = analysis.flux, analysis.level.used
        chosen = thinned(analysis.level.level, MOST_POINTS)
        series["level"] = minutes(frames, frames.time_s[chosen]), analysis.level.level[chosen]
        text = _summary(answer.rows, analysis)
        half = frames.cadence_s / 2
        for verdict in VERDICTS:
            rows = [row.event for row in answer.rows if row.verdict == verdict]
            ends = np.array(
                [(analysis.survey.time_s[event.first], analysis.survey.time_s[event.last]) for event in rows]
            )
            series[f"{verdict} events"] = minutes(frames, ends.reshape(-1, 2) + [-half, half]).T
    for name, which in (("searched", used), ("left out", ~used & np.isfinite(flux))):
        chosen = np.flatnonzero(which)
        chosen = chosen[thinned(flux[chosen], MOST_POINTS)]
        series[name] = minutes(frames, frames.time_s[chosen]), flux[chosen]
    return ChartData(text, series, {"y axis": {"axis_label": f"flux ({frames.unit})" if frames.unit else "flux"}})


def _summary(rows: Any, analysis: Analysis) -> str:
    """Return the numbers of events in words."""
    verdicts = [row.verdict for row in rows]
    named = [verdict for verdict in VERDICTS if verdict != "undecided" or verdict in verdicts]
    counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in named)
    return f"Events in {short(analysis.days)} star-days: {counts}; detected above an S/N of {analysis.threshold:.2f}."


def _image(canvas: Canvas, source: ColumnDataSource) -> None:
    from bokeh.models import HoverTool, LinearColorMapper
    from bokeh.palettes import diverging_palette

    colours = diverging_palette(_shades(BLUE), _shades(RED), 255)
    mapper = LinearColorMapper(palette=colours, name="deviation", low=-5, high=5, nan_color=canvas.ink["grid"])
    image = canvas.plot.image("image", "x", "y", "dw", "dh", source=source, color_mapper=mapper)
    shown = [("standard deviations", "@image{0.0}"), ("minute", "$x{0.0}"), ("nm", "$y{0.0}")]
    canvas.plot.add_tools(HoverTool(renderers=[image], tooltips=shown))


@Chart(
    "dynamic", "Dynamic spectrum", Axis("time from the first frame (min)"), Axis("wavelength (nm)"),
    (
        Custom("dynamic", columns=("image", "x", "y", "dw", "dh"), draw=_image),
        Contours("events", "star", "marks", show="if any", width=5),
        Listed("brighter than the median", RED, form="bar"),
        Listed("fainter", BLUE, form="bar"),
    ),
).data()  # fmt: skip
def dynamic_spectrum(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return every spectrum against time, in standard deviations from the median."""
    frames = frames_of(closed)
    if frames is None or frames.wavelength_nm is None:
        return ChartData("A light curve has no spectra." if frames else NO_FILE)
    image, nm = _deviations(frames), frames.wavelength_nm
    reach = max(3.0, float(np.nanpercentile(np.abs(image), 99.5)))
    length = float(minutes(frames, frames.time_s[-1] + frames.cadence_s))
    series: dict[str, Any] = {"dynamic": (image[None], [0.0], [nm[0]], [length], [max(nm[-1] - nm[0], 1.0)])}
    if "analyse" in answers:
        analysis: Analysis = answers["analyse"].analysis
        ends = [minutes(frames, analysis.survey.time_s[[event.first, event.last]]) for event in analysis.events]
        above = float(nm[-1] + 0.02 * (nm[-1] - nm[0]))
        series["marks"] = [list(map(float, x)) for x in ends], [[above, above]] * len(ends)
    text = f"{frames.n_frames} spectra of {nm.size} pixels, {nm[0]:.0f} to {nm[-1]:.0f} nm."
    return ChartData(text, series, {"deviation": {"low": -reach, "high": reach}})


def _shades(colour: str) -> tuple[str, ...]:
    """Return shades from a colour to white."""
    ends = np.array([[int(colour[k : k + 2], 16) for k in (1, 3, 5)], [247, 247, 247]])
    steps = np.linspace(0.0, 1.0, 128)[:, None]
    return tuple(
        "#" + "".join(f"{round(value):02x}" for value in row) for row in ends[0] * (1 - steps) + ends[1] * steps
    )


def _deviations(frames: Frames) -> Float:
    """Return spectra less their median in standard deviations, averaged, shape (n_row, n_column); gaps are NaN."""
    columns = _means(frames.flux, frames.numbers, MOST_COLUMNS)
    image = _means(columns.T, np.arange(frames.flux.shape[1]), MOST_ROWS)
    with np.errstate(invalid="ignore", divide="ignore"):
        image = image - np.nanmedian(image, axis=1, keepdims=True)
        steps = np.diff(image, axis=1)
        # Differences of neighbouring columns hold noise alone; 1.4826 makes a median absolute deviation a normal one's.
        return np.asarray(image / (1.4826 / np.sqrt(2.0) * np.nanmedian(np.abs(steps), axis=1, keepdims=True)))


def _means(values: Float, numbers: NDArray[np.int64], most: int) -> Float:
    """Return the means of rows by their number, at most `most`; rows that do not exist are NaN."""
    bins = numbers // -(-(int(numbers[-1]) + 1) // most)
    sums = np.zeros((int(bins[-1]) + 1, values.shape[1]))
    counts = np.zeros_like(sums)
    finite = np.isfinite(values)
    np.add.at(sums, bins, np.where(finite, values, 0.0))
    np.add.at(counts, bins, finite)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sums / counts)


@SCATTER.data("analyse", "Analyse checks the noise.")
def scatter(closed: ClosedForms, answer: AnalyseAnswer) -> ChartData:
    """Return the scatter of means of quiescent frames against that of independent ones."""
    rows, series = answer.analysis.scatter, scatter_series(answer)
    red = next((row for row in rows if row.red), None) if series else None
    text = "Analyse checks the noise."
    if rows:
        text = "Quiescent frames are independent." if series else "Too few consecutive quiescent frames for means."
    if red is not None:
        of = "Single frames" if red.frames == 1 else f"Means of {red.frames} frames"
        text = f"{of} scatter {red.measured / red.white:.2f} times as much as independent frames."
    return ChartData(text, series)


class Analyse(Tab):
    """Flares in observed frames."""

    verb = "analyse"
    about = (
        "Flares in your own light curve or spectra: the noise is checked first, and every event has its false-alarm "
        "rate in the noise as measured. The star's fields are for spectra of Mauve."
    )
    headline = False
    pictures = (light_curve, dynamic_spectrum, scatter)
    files = dict.fromkeys(("events", "measured", "frames", "noise", "limits", "completeness"), "analyse")
    documents = {"analyse.html": "analyse"}  # noqa: RUF012

    def given(self, question: Question) -> dict[str, Any]:
        """Read the frames; raises InputError with the name of the field whose file cannot be read."""
        if "frames" not in question.uploads:
            return {}
        frames = read_frames_of(
            question.uploads["frames"], question.uploads.get("mapping"), "frames", quality_bits=question.quality_bits
        )
        if frames.flux.size > MOST_VALUES:
            raise InputError.of("frames", frames.flux.size, f"at most {MOST_VALUES} values, or the command line")
        return {"frames": frames}

    def words(self, question: Question) -> str:
        """Return the name of the file."""
        return question.uploads["frames"].name if "frames" in question.uploads else "no file of frames yet"

    def offers(self, name: str, answers: Answers) -> bool:
        """Return whether the answer has a table; some exist only for spectra."""
        return self.answer in answers and name in answers[self.answer].tables

    def table(self, name: str, closed: ClosedForms, answers: Answers) -> Table:
        """Return a table of the answer; raises InputError for one that only spectra have."""
        tables = answers[self.answer].tables
        if name not in tables:
            raise InputError(f"a light curve has no table {name}", f"one of {', '.join(tables)}", key="name")
        table: Table = tables[name]
        return table

    def shown(self, closed: ClosedForms, answers: Answers) -> View | None:
        """Return the table of events; without an event, the sentence that says so."""
        view = super().shown(closed, answers)
        return view if view is not None and view.columns else None


#: Half-widths of the flares: as many as there are lines.
LENGTHS = ("shortest", "middle", "longest")


@Chart(
    "shares", "Share of flares that a search of a stare finds",
    Axis("peak amplitude of the flare (%)", log=True, limits=(0.01, 100)),
    Axis("share of flares found", limits=(-0.03, 1.05)),
    (
        *(
            series
            for k, called in enumerate(LENGTHS)
            for series in (
                Band(f"{called} flares", called, f"band {k}", listed=False),
                Line(f"{called} flares", called, f"line {k}", width=2,
                     tips=("amplitude (%)", f"found of the {called}")),
            )
        ),
        Rule("amplitude of your question", "own", "own"),
    ),
).data()  # fmt: skip
def shares(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the fraction of injected flares that the search finds against their amplitude."""
    series: dict[str, Any] = {"own": closed.question.amplitude_percent}
    if "completeness" not in answers:
        text = (
            "Nothing is injected yet: Inject flares puts flares of several lengths and sizes into a stare of one "
            "orbit, and searches it."
        )
        return ChartData(text, series)
    injected, parts = answers["completeness"].stars[0].injected, []
    for k, width in enumerate(injected.half_widths_s):
        x, share = 100 * injected.sizes, injected.completeness[k]
        series |= {
            f"band {k}": (x, injected.completeness_low[k], injected.completeness_high[k]),
            f"line {k}": (x, share),
        }
        seen = float(np.interp(np.log(closed.question.amplitude_percent), np.log(x), share))
        parts.append(f"{percent(seen)} of those of half-width {short(width)} s")
    peak = f"{closed.question.amplitude_percent:g} %"
    return ChartData(f"Of flares that peak at {peak} the search finds {'; '.join(parts)}.", series)


class Completeness(Tab):
    """Tab of completeness."""

    name, title = "completeness", "Stare"
    about = (
        "One exposure sees a flare at its peak; a stare sees it rise and fade. This tab shows which flares a search of "
        "one orbit finds at the chosen rate of false alarms, with losses while the star drifts out of the fibre."
    )
    pictures = (shares,)
    headline = False
    # The picture reads off the share of flares of this size.
    also = ("amplitude_percent",)
    simulations = {"completeness": "Inject flares"}  # noqa: RUF012
    answer, view = "completeness", 1
    files = {"completeness": "completeness", "limits": "completeness"}  # noqa: RUF012
