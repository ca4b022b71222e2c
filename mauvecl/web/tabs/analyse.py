"""Flares in a visitor's own frames: light curve, dynamic spectrum, noise and table of events."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError
from mauvecl.schema.tables import View
from mauvecl.web.closed_forms import short
from mauvecl.web.figures import Canvas
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab
from mauvecl.web.upload import MOST_VALUES, read_frames_of

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.observations.analysis import Analysis
    from mauvecl.observations.frames import Frames
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.question import Question

Float = NDArray[np.float64]

#: Largest numbers of points of a light curve, and of columns and rows of a dynamic spectrum.
MOST_POINTS, MOST_COLUMNS, MOST_ROWS = 8000, 600, 300
#: Verdicts on events, with their colours.
VERDICTS = {"detected": "star", "candidate": "drawn", "rejected": "own", "undecided": "dark"}
NO_FILE = "Choose a file of frames: a light curve or a sequence of spectra."


def frames_of(closed: ClosedForms) -> Frames | None:
    """Return the frames of the question, or None if there is no file."""
    found: Frames | None = closed.given.get("frames")
    return found


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


class LightCurve(Picture):
    """Light curve, its quiescent level, and the events."""

    name, title = "frames", "Light curve"
    logs = ("y",)

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "time from the first frame (min)", "flux", logs)
        for verdict, colour in VERDICTS.items():
            canvas.strips(f"{verdict} events", verdict, colour)
        canvas.line("level", "quiescent level", "flare")
        dots = canvas.dots("searched", "frames", "text", size=3)
        canvas.tooltips(dots, ("minute", "x"), ("flux", "y"), mode="mouse")
        canvas.dots("left out", "not searched", "own", size=6, marker="x")
        # A bad frame far away does not compress the others.
        canvas.plot.y_range.update(renderers=[dots])
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        frames = frames_of(closed)
        sources: dict[str, Any] = {name: {"x": [], "y": []} for name in ("searched", "left out", "level")}
        sources |= {f"{verdict} events": {"x0": [], "x1": []} for verdict in VERDICTS}
        if frames is None:
            return PictureData(NO_FILE, sources)
        flux, used = frames.white_light[0], frames.faults == 0
        text = f"{frames.n_frames} frames of {frames.name}. Analyse searches them for flares."
        if "analyse" in answers:
            answer = answers["analyse"]
            one: Analysis = answer.analysis
            flux, used = one.flux, one.level.used
            chosen = thinned(one.level.level, MOST_POINTS)
            sources["level"] = {"x": minutes(frames, frames.time_s[chosen]), "y": one.level.level[chosen]}
            text = _summary(answer.rows, one)
            half = frames.cadence_s / 2
            for verdict in VERDICTS:
                rows = [row.event for row in answer.rows if row.verdict == verdict]
                ends = np.array([(one.survey.time_s[event.first], one.survey.time_s[event.last]) for event in rows])
                ends = ends.reshape(-1, 2) + [-half, half]
                sources[f"{verdict} events"] = dict(zip(("x0", "x1"), minutes(frames, ends).T, strict=True))
        for name, which in (("searched", used), ("left out", ~used & np.isfinite(flux))):
            chosen = np.flatnonzero(which)
            chosen = chosen[thinned(flux[chosen], MOST_POINTS)]
            sources[name] = {"x": minutes(frames, frames.time_s[chosen]), "y": flux[chosen]}
        unit = f"flux ({frames.unit})" if frames.unit else "flux"
        return PictureData(text, sources, {"y axis": {"axis_label": unit}})


def _summary(rows: Any, one: Analysis) -> str:
    """Return the numbers of events in words."""
    verdicts = [row.verdict for row in rows]
    named = [verdict for verdict in VERDICTS if verdict != "undecided" or verdict in verdicts]
    counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in named)
    return f"Events in {short(one.days)} star-days: {counts}; detected above an S/N of {one.threshold:.2f}."


class DynamicSpectrum(Picture):
    """Every spectrum against time, in standard deviations from the median."""

    name, title = "dynamic", "Dynamic spectrum"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        from bokeh.models import HoverTool, LinearColorMapper
        from bokeh.palettes import diverging_palette

        canvas = Canvas(ink, "time from the first frame (min)", "wavelength (nm)", logs)
        colours = diverging_palette(_shades("#0072B2"), _shades("#D55E00"), 255)
        mapper = LinearColorMapper(palette=colours, name="deviation", low=-5, high=5, nan_color=ink.grid)
        source = canvas.source("dynamic", "image", "x", "y", "dw", "dh")
        plot: Any = canvas.plot
        image = plot.image("image", "x", "y", "dw", "dh", source=source, color_mapper=mapper)
        shown = [("standard deviations", "@image{0.0}"), ("minute", "$x{0.0}"), ("nm", "$y{0.0}")]
        canvas.plot.add_tools(HoverTool(renderers=[image], tooltips=shown))
        marks = canvas.source("marks", "xs", "ys")
        canvas.plot.multi_line("xs", "ys", source=marks, line_color=ink.star, line_width=5).name = "marks"
        canvas.legend += [("events", ink.star, "line", "if any")]
        canvas.legend += [("brighter than the median", "#D55E00", "bar", ""), ("fainter", "#0072B2", "bar", "")]
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        frames = frames_of(closed)
        sources: dict[str, Any] = {"dynamic": {"image": [], "x": [], "y": [], "dw": [], "dh": []}}
        sources["marks"] = {"xs": [], "ys": []}
        if frames is None or frames.wavelength_nm is None:
            return PictureData("A light curve has no spectra." if frames else NO_FILE, sources)
        image = _deviations(frames)
        reach = max(3.0, float(np.nanpercentile(np.abs(image), 99.5)))
        nm, length = frames.wavelength_nm, float(minutes(frames, frames.time_s[-1] + frames.cadence_s))
        sources["dynamic"] = {
            "image": image[None], "x": [0.0], "y": [nm[0]], "dw": [length], "dh": [max(nm[-1] - nm[0], 1.0)],
        }  # fmt: skip
        if "analyse" in answers:
            one: Analysis = answers["analyse"].analysis
            ends = [minutes(frames, one.survey.time_s[[event.first, event.last]]) for event in one.events]
            above = float(nm[-1] + 0.02 * (nm[-1] - nm[0]))
            sources["marks"] = {"xs": [list(map(float, x)) for x in ends], "ys": [[above, above]] * len(ends)}
        text = f"{frames.n_frames} spectra of {nm.size} pixels, {nm[0]:.0f} to {nm[-1]:.0f} nm."
        return PictureData(text, sources, {"deviation": {"low": -reach, "high": reach}})


def _shades(colour: str) -> tuple[str, ...]:
    """Return shades from a colour to white."""
    ends = np.array([[int(colour[k : k + 2], 16) for k in (1, 3, 5)], [247, 247, 247]])
    steps = np.linspace(0.0, 1.0, 128)[:, None]
    return tuple("#" + "".join(f"{round(one):02x}" for one in row) for row in ends[0] * (1 - steps) + ends[1] * steps)


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


class Noise(Picture):
    """Scatter of means of quiescent frames against that of independent ones."""

    name, title = "scatter", "Noise of quiescent frames"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "frames in a mean", "scatter (noise of one frame)", logs | {"x", "y"})
        canvas.band("range", "95 % of independent frames", "drawn", alpha=0.4)
        canvas.line("white", "independent frames", "drawn")
        measured = canvas.dots("measured", "as measured", "star", size=8)
        canvas.tooltips(measured, ("frames", "x"), ("scatter", "y"), mode="mouse")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        found = answers["analyse"].analysis.scatter if "analyse" in answers else []
        rows = found if len(found) > 1 else []
        x = [row.frames for row in rows]
        sources: dict[str, Any] = {
            "range": {"x": x, "low": [row.low for row in rows], "high": [row.high for row in rows]},
            "white": {"x": x, "y": [row.white for row in rows]},
            "measured": {"x": x, "y": [row.measured for row in rows]},
        }
        red = next((row for row in rows if row.red), None)
        text = "Analyse checks the noise."
        if found:
            text = "Quiescent frames are independent." if rows else "Too few consecutive quiescent frames for means."
        if red is not None:
            ratio = red.measured / red.white
            of = "Single frames" if red.frames == 1 else f"Means of {red.frames} frames"
            text = f"{of} scatter {ratio:.2f} times as much as independent frames."
        return PictureData(text, sources)


class Analyse(Tab):
    """Flares in observed frames."""

    verb = "analyse"
    about = (
        "Flares in your own light curve or spectra: the noise is checked first, and every event has its false-alarm "
        "rate in the noise as measured. The star's fields are for spectra of Mauve."
    )
    headline = False
    pictures = (LightCurve(), DynamicSpectrum(), Noise())
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
            raise InputError(
                f"a light curve has no table {name}", f"one of {', '.join(tables)}", key="name", value=name
            )
        table: Table = tables[name]
        return table

    def shown(self, closed: ClosedForms, answers: Answers) -> View | None:
        """Return the table of events; without an event, the sentence that says so."""
        view = super().shown(closed, answers)
        return view if view is not None and view.columns else None
