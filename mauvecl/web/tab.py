"""Base of the page's tabs: the questions that they ask, their tables, and their figures in both themes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from bokeh import models
from bokeh.models.annotations import ColorBar, Label, Span
from bokeh.plotting import figure

from mauvecl.answers.verbs import VERBS, Progress
from mauvecl.charts import chart
from mauvecl.host.arrays import true_runs
from mauvecl.host.stars.flare import EmissionLine
from mauvecl.schema.columns import View
from mauvecl.schema.errors import InputError
from mauvecl.study.study import Study
from mauvecl.web.closed_forms import OTHER
from mauvecl.web.fields import FIELDS

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.runs.pool import Pool
    from mauvecl.web.closed_forms import Answers, ClosedForms, FieldValues

#: Cells along each axis of the page's map, and realisations per cell.
MAP_STEPS, MAP_REALISATIONS = 8, 20_000
#: Injected flares: numbers of sizes and half-widths, flares of each, and positions.
INJECTED = {"of": "amplitude", "sizes": 12, "widths": 3, "count": 200, "positions": 4, "fitted": 0}
#: Largest number of simulated fits, and of those of two temperatures, which take fifty times as long.
MOST_FITS, MOST_OF_TWO = 10_000, 1000
DRAWN_UNITS = ("realisations", "steps", "cells")  # units of the progress of verbs that use the pool's devices
FIXED = ("star", "amplitude")  # columns that the page does not show: its question has one star and one flare
SHOWN_NM = (195.0, 705.0)  # wavelengths that are shown
#: Spectral lines, and the Balmer jump at 4 / R_H with Rydberg's constant for hydrogen, nm in vacuum.
MARKS = {name: EmissionLine.named(name).wavelengths_nm for name in ("Mg II", "Ca II", "H alpha")}
MARKS["Balmer jump"] = (364.7,)
MORE_MARKS = ("H alpha",)  # marks that are hidden by default
#: Colours of the light and the dark theme by name, lighter on dark ground.
INKS = {
    "light": chart.INK,
    "dark": {
        "text": "#e6ebf1", "grid": "#34404d", "ground": "#182029", "star": "#56B4E9", "flare": "#FF8C42",
        "sky": "#2fc79a", "drawn": "#9aa7b5", "dark": "#b99be0", "read": "#F0C040", "bias": "#E39BC9",
        "total": "#e6ebf1", "threshold": "#e6ebf1", "own": "#ff6fa3", "shortest": "#FF8C42", "middle": "#FFBE8A",
        "longest": "#FFE8D6",
    },
}  # fmt: skip
#: Colours and dash patterns (lengths of dashes and gaps) of the lines of pinned scenarios, by theme.
PINS = {
    "light": (("#A21CAF", "6 3"), ("#7C4A03", "9 3 2 3"), ("#0E7490", "2 2")),
    "dark": (("#F0ABFC", "6 3"), ("#D9AE76", "9 3 2 3"), ("#67E8F9", "2 2")),
}
TARGETS = ("star", "flare", "sky", "own", "dark", "read", "bias", "drawn")  # colours of several targets' curves


def _map_around(study: Study) -> Study:
    """Return the study of a coarse map around the question's star."""
    star, amplitude = study.star[0], study.flare.amplitudes[0]
    middle = 7.0 if star.magnitude is None else star.magnitude
    x = {"quantity": "magnitude", "start": middle - 2.5, "stop": middle + 2.5, "steps": MAP_STEPS}
    y = {"quantity": "amplitude", "start": amplitude / 10, "stop": amplitude * 3, "steps": MAP_STEPS, "log": True}
    # One statistic and the fewest realisations that the false-alarm probability allows keep the map fast.
    fewest = math.ceil(100 / study.run.fap)
    n = min(max(MAP_REALISATIONS, fewest), study.run.realisations)
    return _changed(study, map={"x": x, "y": y}, run={"realisations": n, "statistics": [study.run.statistics[-1]]})


def _changed(study: Study, **sections: dict[str, Any]) -> Study:
    """Return a study with other values of keys, by section."""
    return study.with_changes(sections, None, "page")


@dataclass(frozen=True)
class Simulation:
    """Verbs that answer a question of the page, and the study that they receive."""

    #: Verbs that answer it. The page keeps the answer of the first under the question's name, others under their own.
    verbs: tuple[str, ...]
    study: Callable[[Study], Study] = lambda study: study  # converts the study of the page


def _fits(study: Study) -> Study:
    """Return the study of fits of the flare's spectrum."""
    most = MOST_FITS if study.flare.spectrum.second_area is None else MOST_OF_TWO
    return _changed(study, measure={"fits": min(study.run.realisations, most)})


#: Simulations by the name of their question: that of the verb, unless it changes the study or has another name.
QUESTIONS = {name: Simulation((name,)) for name in VERBS} | {
    "detection": Simulation(("detect", "snr")),
    "map": Simulation(("map",), _map_around),
    "measure": Simulation(("measure",), _fits),
    "completeness": Simulation(("inject",), partial(_changed, injections=INJECTED, search={"nulls": 0})),
    "periods": Simulation(("change",), partial(_changed, change={"periods": True})),
}


def simulate(
    name: str, study: Study, pool: Pool, progress: Progress = None, *, inputs: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the answers to a question by name; its first verb reports its progress and takes the contents of files.

    A detection also has the answer with the other choice of unknowns, unless that is refused.
    """
    question = QUESTIONS[name]
    study, (main, *more) = question.study(study), question.verbs
    questions = [(name, main, study), *((verb, verb, study) for verb in more)]
    if name == "detection":
        questions.append((OTHER, main, _changed(study, nuisances={"usual": not study.nuisances.usual})))
    # Each verb announces its own realisations alone.
    n_draws = sum(VERBS[verb].counts == "realisations" for _, verb, _ in questions)
    pool.expect(study.run.realisations * n_draws)
    answers: dict[str, Any] = {}
    for key, verb, study in questions:
        try:
            answers[key] = VERBS[verb].ask(study, pool, progress, **(inputs or {} if verb == main else {}))
        except InputError:
            if key != OTHER:
                raise
    return answers


def target_words(question: FieldValues) -> str:
    """Return the targets and days of a question in words."""
    names = ", ".join(target["name"] for target in question.targets) or "no target yet"
    return f"{names}; {question.days:g} days from {question.start}"


@dataclass(kw_only=True, eq=False)
class Tab:
    """Tab of the page; what a tab with a verb does not state follows from its verb."""

    verb: str = ""  # name of the verb that it shows, if any
    name: str = ""
    title: str = ""
    about: str = ""  # what it shows, in a sentence
    pictures: tuple[chart.Chart, ...] = ()
    simulations: Mapping[str, str] = field(default_factory=dict)  # questions that its buttons simulate, with labels
    needs: str = ""  # field without which no simulation of it can start
    answer: str = ""  # name of the simulated answer whose table is below the pictures
    view: int = 0  # number of that table among the answer's `views`
    #: Another table below the pictures, and the rows before there is an answer.
    own_view: Callable[[ClosedForms, Answers], View] | None = None
    rows_before: Callable[[FieldValues], list[list[str]]] = lambda question: []
    #: Questions of "Share, export, cite"; by default its own simulations.
    questions: tuple[str, ...] = ()
    #: Key of `GROUPS` under whose heading it stands; by default that of the verb that answers its first question.
    group: str = ""
    #: Whether the chance of detection stands above it, whose fields it then shows.
    chance: bool = True
    #: Its question in words, if it has no chance.
    words: Callable[[FieldValues], str] = lambda q: f"{q.star_in_words} of {q.band} = {q.magnitude:g}"
    #: Reads the file of the field that it `needs` on a thread of its own, and returns arguments of the verb.
    read_inputs: Callable[[FieldValues], dict[str, Any]] = lambda question: {}
    #: Fields that it reads although its verbs do not take their keys, and those that it does not read.
    also: tuple[str, ...] = ()
    never: tuple[str, ...] = ()
    #: Tables that can be downloaded, with the simulation that each needs, or none.
    files: Mapping[str, str | None] = field(default_factory=dict)
    own_table: Callable[[ClosedForms, Answers], Table] | None = None  # table of its only file, if no answer has it
    #: Documents of answers that can be downloaded, by file name, with the simulation that each needs.
    documents: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if verb := self.verb:
            title, (about, *_) = verb.capitalize(), VERBS[verb].help.split("\n")
            self.name, self.title, self.about = self.name or verb, self.title or title, self.about or about
            self.simulations, self.answer = self.simulations or {verb: title}, self.answer or verb
            self.files = self.files or {verb: verb}
        self.questions = self.questions or tuple(self.simulations) or ("detection",)
        self.group = self.group or VERBS[QUESTIONS[self.questions[0]].verbs[0]].group

    @cached_property
    def reads(self) -> frozenset[str]:
        """Fields on which the tab depends, with those of the card: the chance, and the limit in a sentence."""
        above = ("detection", "limit") if self.chance else ()
        return self.reads_of(*self.questions, *self.simulations, *above)

    def reads_of(self, *questions: str) -> frozenset[str]:
        """Return the fields on which questions depend, by the keys that the flags of their verbs set."""
        accepts = [VERBS[verb].accepts for question in questions for verb in QUESTIONS[question].verbs]
        names = (name for name, field in FIELDS.items() if any(takes(key) for takes in accepts for key in field.keys))
        return frozenset({*names, *self.also}).difference(self.never)

    def offers(self, name: str, answers: Answers) -> bool:
        """Return whether one of `files` or `documents` can be downloaded: the answer it needs is there and has it."""
        needed = self.documents[name] if name in self.documents else self.files[name]
        # An answer lacks tables that the question does not ask for.
        always = name in self.documents or self.own_table is not None
        return needed is None or (needed in answers and (always or answers[needed].has_table(name)))

    def rows(self, closed: ClosedForms, answers: Answers) -> list[list[str]]:
        """Return a small table as text with a header row; empty if there is nothing to report."""
        if self.own_view is None and self.answer not in answers:
            return self.rows_before(closed.question)
        view = answers[self.answer].views[self.view] if self.own_view is None else self.own_view(closed, answers)
        headings, cells = view.texts(FIXED, empty=False)
        return [headings, *cells] if headings else []


class Canvas:
    """Empty figure of a chart, whose data sources have the names of the chart's data."""

    def __init__(self, picture: chart.Chart, theme: str, logs: frozenset[str]) -> None:
        self.ink, self.picture = INKS[theme], picture
        always = {name for name, axis in (("x", picture.x), ("y", picture.y)) if axis.log}
        self.logs = logs | (always - {axis.lower() for axis in picture.logs})
        self.plot = self._frame(picture.x, picture.y)
        #: Entries of the legend: name, colour, form, and the tag that shows or hides each.
        self.legend: list[tuple[str, str, str, str]] = []
        if picture.x.kind == "wavelength":
            self._mark()
        # A line for each scenario that can be pinned is drawn as the series that it repeats.
        pins = [
            replace(item, called=f"pinned {k + 1}", name=f"pin {k}", colour=colour, dash=dash, width=2.0, show="pins",
                    tips=(), listed=False)
            for k, (colour, dash) in enumerate(PINS[theme]) for item in picture.series if item.key == picture.pins
        ]  # fmt: skip
        for series in sorted((*picture.series, *pins), key=lambda item: isinstance(item, chart.OwnMarker)):
            self._add(series)

    def _frame(self, x: chart.PlotAxis, y: chart.PlotAxis) -> Any:
        """Return a figure with axes only."""
        ranges = {f"{name}_range": bounds for name, axis in (("x", x), ("y", y)) if (bounds := self._range(name, axis))}
        plot = figure(
            x_axis_label=x.label,
            y_axis_label=y.label,
            x_axis_type="datetime" if x.kind == "dates" else "log" if "x" in self.logs else "linear",
            y_axis_type="auto" if y.kind == "names" else "log" if "y" in self.logs else "linear",
            sizing_mode="stretch_both",
            min_height=60,
            min_width=60,
            min_border=2,
            # Room for half of a label at the end of the axis, which Bokeh otherwise moves over its neighbour.
            min_border_right=14,
            # The wheel alone scrolls the page; two fingers zoom.
            tools=[models.BoxZoomTool(), models.WheelZoomTool(modifiers={"ctrl": True}), models.ResetTool()],
            active_scroll="auto",
            toolbar_location=None,
            background_fill_color=None,
            border_fill_color=None,
            outline_line_color=None,
            **ranges,
        )
        text = self.ink["text"]
        for axis in (*plot.xaxis, *plot.yaxis):
            axis.update(
                axis_label_text_font_style="normal", axis_label_text_font="system-ui", axis_label_text_font_size="12px",
                axis_label_text_color=text, major_label_text_font="system-ui", major_label_text_font_size="11px",
                major_label_text_color=text, axis_line_color=text, major_tick_line_color=text,
                minor_tick_line_color=None, major_label_policy=models.NoOverlap(),
            )  # fmt: skip
            if isinstance(axis.formatter, models.BasicTickFormatter):
                axis.formatter.power_limit_high = 7
        plot.xaxis.name, plot.yaxis.name = "x axis", "y axis"
        plot.grid.grid_line_color = self.ink["grid"]
        plot.x_range.name, plot.y_range.name = "wavelength" if x.kind == "wavelength" else "x range", "y range"
        return plot

    def _range(self, name: str, axis: chart.PlotAxis) -> Any:
        """Return the range of an axis, or None for Bokeh's own."""
        if axis.kind == "wavelength":
            # All figures with wavelengths share one range.
            return models.Range1d(start=SHOWN_NM[0], end=SHOWN_NM[1], bounds=SHOWN_NM)
        if axis.kind == "names":
            return ["nothing"]
        if axis.limits is not None:
            return axis.log_limits if axis.log_limits is not None and name in self.logs else axis.limits
        # Hidden marks do not affect the range; without data, the range is a default one.
        return models.DataRange1d(only_visible=True, default_span=2.0) if name == "y" else None

    def share_colours(self, title: str) -> models.LinearColorMapper:
        """Add the colour bar of a share, and return its colours."""
        text, mapper = self.ink["text"], models.LinearColorMapper(palette="Cividis256", low=0, high=1)
        bar = ColorBar(
            color_mapper=mapper, width=10, title=title, background_fill_color=None, major_label_text_color=text,
            title_text_color=text, major_tick_line_color=text, title_text_font_style="normal",
            title_text_font="system-ui", major_label_text_font="system-ui",
        )  # fmt: skip
        self.plot.add_layout(bar, "right")
        return mapper

    def _add(self, series: chart.Series) -> None:
        """Add a series with its data source, entry of the legend, and tooltip."""
        if isinstance(series, chart.Rule):
            # Its position is set later.
            dimension: Literal["height", "width"] = "height" if series.along == "x" else "width"
            style: dict[str, Any] = {"line_color": self.ink.get(series.colour, series.colour), "line_dash": series.dash}
            self.plot.add_layout(Span(dimension=dimension, location=None, name=series.key, **style))
        if isinstance(series, chart.Rule | chart.LegendEntry):
            self._list(series)
            return
        if isinstance(series, chart.Targets):
            for k, colour in enumerate(TARGETS):
                name = f"{series.key} {k}"
                self._add(chart.Line(f"target {k + 1}", colour, name, width=2, dash=series.dash, tips=series.tips))
            return
        source = models.ColumnDataSource({column: [] for column in series.columns}, name=series.key)
        if isinstance(series, chart.Custom):
            if series.draw is not None:
                series.draw(self, source)
            return
        renderer = self._drawn(series, source)
        hidden = series.show in self.picture.shows
        renderer.name, renderer.visible = series.called, not hidden
        renderer.tags = [series.show] if hidden or series.show == "pins" else []
        self._list(series)
        if series.tips:
            self.tooltips(renderer, *zip(series.tips, ("x", "y")[-len(series.tips) :], strict=True))
        if isinstance(series, chart.Dots) and series.alone:
            self.plot.y_range.update(renderers=[renderer])

    def _drawn(self, series: chart.Series, source: models.ColumnDataSource) -> Any:
        """Return the renderer of a series."""
        plot, colour, columns = self.plot, self.ink.get(series.colour, series.colour), series.columns
        line: dict[str, Any] = {
            "line_color": colour, "line_width": series.width, "line_dash": series.dash or "solid",
            "line_alpha": series.alpha,
        }  # fmt: skip
        fill: dict[str, Any] = {"source": source, "fill_color": colour, "fill_alpha": series.alpha}
        match series:
            case chart.Area():
                return plot.varea(*columns, **fill)
            case chart.Strips():
                hatch = {"hatch_pattern": "/", "hatch_color": colour, "hatch_alpha": 0.5} if series.hatched else {}
                return plot.vstrip(*columns, line_color=None, **fill, **hatch)
            case chart.Bars():
                return plot.quad("left", "right", "top", 1e-9 if "y" in self.logs else 0, line_color=None, **fill)
            case chart.OwnMarker():
                return plot.scatter(*columns, source=source, size=13, marker="circle", fill_color=colour,
                                    line_color=self.ink["ground"], line_width=2)  # fmt: skip
            case chart.Dots():
                return plot.scatter(*columns, source=source, size=series.size, color=colour, marker=series.marker)
            case chart.Contours():
                if series.dash:
                    # A bright edge sets pinned contours off from the map.
                    plot.multi_line(*columns, source=source, line_color="#ffffff", line_width=5, tags=[series.show])
                return plot.multi_line(*columns, source=source, **line)
            case chart.Line(step=True):
                return plot.step(*columns, source=source, mode="center", **line)
        return plot.line(*columns, source=source, **line)

    def _list(self, series: chart.Series) -> None:
        """Add an entry to the legend."""
        if series.listed:
            form = "dash" if series.dash else series.form
            self.legend.append((series.called, self.ink.get(series.colour, series.colour), form, series.show))

    def tooltips(self, renderer: Any, *lines: tuple[str, str], along: Literal["hline", "vline"] = "vline") -> None:
        """Add a tooltip with the name of a renderer and columns in four significant digits."""
        columns = [column for _, column in lines]
        rows = "".join(f"<div>{name}: <b>@{column}{{%.4g}}</b></div>" for name, column in lines)
        target = renderer
        if isinstance(renderer.glyph, models.Step):
            # BokehJS finds no steps below the pointer.
            target = self.plot.line("x", "y", source=renderer.data_source, line_alpha=0)
        self.plot.add_tools(
            models.HoverTool(
                renderers=[target],
                mode="mouse" if isinstance(renderer.glyph, models.Scatter) else along,
                point_policy="snap_to_data",
                line_policy="nearest",
                tooltips=f"<b>{renderer.name}</b>{rows}",
                formatters={f"@{column}": "printf" for column in columns},
            )
        )

    def _mark(self) -> None:
        """Add marks of spectral lines."""
        colour = self.ink["text"]
        for name, wavelengths_nm in MARKS.items():
            hidden = name in MORE_MARKS
            shared: dict[str, Any] = {"tags": ["more marks" if hidden else "marks"], "visible": not hidden}
            line: dict[str, Any] = {"line_color": colour, "line_alpha": 0.35, "line_width": 1, "line_dash": "dotted"}
            for nm in wavelengths_nm:
                self.plot.add_layout(Span(dimension="height", location=nm, **line, **shared))
            self.plot.add_layout(
                Label(
                    x=sum(wavelengths_nm) / len(wavelengths_nm), y=0, y_units="screen", y_offset=2, x_offset=3,
                    text=name, angle=1.5708, text_font="system-ui", text_font_size="10px", text_color=colour,
                    text_alpha=0.8, **shared,
                )
            )  # fmt: skip


#: Pixels that saturate, whose data `strips` returns.
SATURATED = chart.Strips("saturated", "own", show="if any", alpha=0.18, hatched=True)


def strips(wavelength_nm: Any, flags: Any) -> tuple[Any, Any]:
    """Return the ends of runs of flagged pixels, half a pixel beyond each, as columns of `Strips`."""
    first, end = true_runs(flags).T
    half = 0.5 * np.gradient(wavelength_nm)
    return (wavelength_nm - half)[first], (wavelength_nm + half)[end - 1]
