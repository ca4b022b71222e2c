"""Figures of the page in a light and a dark theme."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from bokeh import models
from bokeh.models.annotations import ColorBar, Label, Span
from bokeh.plotting import figure

from mauvecl.charts import chart
from mauvecl.host.arrays import true_runs
from mauvecl.host.stars.flare import EmissionLine

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
