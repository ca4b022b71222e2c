"""Figures of the page in a light and a dark theme."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from bokeh.models import (
    BasicTickFormatter,
    BoxZoomTool,
    DataRange1d,
    HoverTool,
    NoOverlap,
    Range1d,
    ResetTool,
    WheelZoomTool,
)
from bokeh.models.annotations import Label, Span
from bokeh.models.sources import ColumnDataSource
from bokeh.plotting import figure

#: Wavelengths that are shown, nm.
SHOWN_NM = (195.0, 705.0)
#: Spectral lines, nm in vacuum (NIST Atomic Spectra Database, version 5): Mg II h and k, Ca II H and K, H alpha. The
#: Balmer jump is 4 / R_H, with Rydberg's constant for hydrogen.
MARKS = {"Mg II": (279.63, 280.35), "Ca II": (393.48, 396.96), "Balmer jump": (364.7,), "H alpha": (656.46,)}
#: Marks that are hidden by default.
MORE_MARKS = ("H alpha",)


@dataclass(frozen=True)
class Ink:
    """Colours of a theme, after Okabe & Ito, lighter on dark ground."""

    text: str
    grid: str
    ground: str
    star: str
    flare: str
    sky: str
    drawn: str
    dark: str
    read: str
    bias: str
    total: str
    threshold: str
    own: str
    lengths: tuple[str, ...]
    pins: tuple[str, ...]

    def __getitem__(self, name: str) -> str:
        return str(getattr(self, name, name))


INKS = {
    "light": Ink(
        text="#1b2733", grid="#dde3ea", ground="#ffffff", star="#0072B2", flare="#D55E00", sky="#009E73",
        drawn="#6b7785", dark="#7b4ea3", read="#B8860B", bias="#A65082", total="#1b2733", threshold="#1b2733",
        own="#C2185B", lengths=("#E8801F", "#B34700", "#5C2200"), pins=("#A21CAF", "#7C4A03", "#0E7490"),
    ),
    "dark": Ink(
        text="#e6ebf1", grid="#34404d", ground="#182029", star="#56B4E9", flare="#FF8C42", sky="#2fc79a",
        drawn="#9aa7b5", dark="#b99be0", read="#F0C040", bias="#E39BC9", total="#e6ebf1", threshold="#e6ebf1",
        own="#ff6fa3", lengths=("#FF8C42", "#FFBE8A", "#FFE8D6"), pins=("#F0ABFC", "#D9AE76", "#67E8F9"),
    ),
}  # fmt: skip


#: Colours of the curves of several targets; further targets are in the table alone.
TARGETS = ("star", "flare", "sky", "own", "dark", "read", "bias", "drawn")
#: Dash patterns of the lines of pinned scenarios: lengths of dashes and gaps.
DASHES = ("6 3", "9 3 2 3", "2 2")


class Canvas:
    """Figure with its data sources.

    Parameters
    ----------
    x, y : str
        Labels of the axes, with units.
    logs : frozenset of str
        Logarithmic axes.
    wavelength : bool
        Whether x is a wavelength: its range is then shared with all such figures, and lines are marked.
    """

    def __init__(self, ink: Ink, x: str, y: str, logs: frozenset[str], *, wavelength: bool = False, **how: Any) -> None:
        self.ink = ink
        ranges: dict[str, Any] = (
            {"x_range": Range1d(start=SHOWN_NM[0], end=SHOWN_NM[1], bounds=SHOWN_NM)} if wavelength else {}
        )
        named = isinstance(how.get("y_range"), list)
        if "y_range" not in how:
            # Hidden marks do not affect the range; without data, the range is a default one.
            ranges["y_range"] = DataRange1d(only_visible=True, default_span=2.0)
        plot = figure(
            x_axis_label=x,
            y_axis_label=y,
            x_axis_type=how.pop("x_axis_type", "log" if "x" in logs else "linear"),
            y_axis_type="auto" if named else "log" if "y" in logs else "linear",
            sizing_mode="stretch_both",
            min_height=60,
            min_width=60,
            min_border=2,
            # Half of a label at the end of the axis, which is else moved over its neighbour.
            min_border_right=14,
            # The wheel alone scrolls the page; two fingers zoom.
            tools=[BoxZoomTool(), WheelZoomTool(modifiers={"ctrl": True}), ResetTool()],
            active_scroll="auto",
            toolbar_location=None,
            background_fill_color=None,
            border_fill_color=None,
            outline_line_color=None,
            **(ranges | how),
        )
        for axis in (*plot.xaxis, *plot.yaxis):
            axis.update(
                axis_label_text_font_style="normal", axis_label_text_font="system-ui", axis_label_text_font_size="12px",
                axis_label_text_color=ink.text, major_label_text_font="system-ui", major_label_text_font_size="11px",
                major_label_text_color=ink.text, axis_line_color=ink.text, major_tick_line_color=ink.text,
                minor_tick_line_color=None, major_label_policy=NoOverlap(),
            )  # fmt: skip
            if isinstance(axis.formatter, BasicTickFormatter):
                axis.formatter.power_limit_high = 7
        plot.xaxis.name, plot.yaxis.name = "x axis", "y axis"
        plot.grid.grid_line_color = ink.grid
        plot.x_range.name, plot.y_range.name = "wavelength" if wavelength else "x range", "y range"
        self.plot = plot
        #: Entries of the legend: name, colour, form, and the tag that shows or hides each.
        self.legend: list[tuple[str, str, str, str]] = []
        if wavelength:
            self._mark()

    @property
    def bar_text(self) -> dict[str, Any]:
        """Look of a colour bar's text."""
        return {
            "background_fill_color": None, "major_label_text_color": self.ink.text, "title_text_color": self.ink.text,
            "major_tick_line_color": self.ink.text, "title_text_font_style": "normal",
            "title_text_font": "system-ui", "major_label_text_font": "system-ui",
        }  # fmt: skip

    def source(self, name: str, *columns: str) -> ColumnDataSource:
        """Add an empty data source."""
        return ColumnDataSource({column: [] for column in columns}, name=name)

    def line(self, name: str, called: str, colour: str, *, show: str = "", step: bool = False, **how: Any) -> Any:
        """Add a named line of columns x and y."""
        source = self.source(name, "x", "y")
        kind: Any = partial(self.plot.step, mode="center") if step else self.plot.line
        made = kind("x", "y", source=source, color=self.ink[colour], **({"line_width": 1.6} | how))
        return self._described(made, called, colour, "dash" if "line_dash" in how else "line", show)

    def targets(self, name: str, called: str, **how: Any) -> None:
        """Add lines of columns x and y for several targets, with tooltips."""
        for k, colour in enumerate(TARGETS):
            curve = self.line(f"{name} {k}", f"target {k + 1}", colour, line_width=2, **how)
            self.tooltips(curve, (called, "y"))

    def band(self, name: str, called: str, colour: str, *, show: str = "", alpha: float = 0.22) -> Any:
        """Add a band of columns x, low and high."""
        source = self.source(name, "x", "low", "high")
        made = self.plot.varea("x", "low", "high", source=source, fill_color=self.ink[colour], fill_alpha=alpha)
        return self._described(made, called, colour, "band", show)

    def dots(self, name: str, called: str, colour: str, *, size: float = 5, show: str = "", **how: Any) -> Any:
        """Add dots of columns x and y."""
        source = self.source(name, "x", "y")
        made = self.plot.scatter("x", "y", source=source, size=size, color=self.ink[colour], **how)
        return self._described(made, called, colour, "dot", show)

    def pinned(self, kind: Any = None, *columns: str, halo: str = "") -> None:
        """Add a line for each scenario that can be pinned; its columns are x and y or as named."""
        columns, kind = columns or ("x", "y"), kind or self.plot.line
        for k, (colour, dash) in enumerate(zip(self.ink.pins, DASHES, strict=True)):
            source, name = self.source(f"pin {k}", *columns), f"pinned {k + 1}"
            looks: list[dict[str, Any]] = [{"line_color": colour, "line_width": 2, "line_dash": dash}]
            if halo:
                looks.insert(0, {"line_color": halo, "line_width": 5})
            for look in looks:
                kind(*columns, source=source, name=name, tags=["pins"], **look)

    def own_point(self, called: str = "your question") -> Any:
        """Add a marker of the question."""
        source = self.source("own", "x", "y")
        made = self.plot.scatter(
            "x", "y", source=source, size=13, marker="circle", fill_color=self.ink.own, line_color=self.ink.ground,
            line_width=2,
        )  # fmt: skip
        return self._described(made, called, "own", "dot", "")

    def strips(self, name: str, called: str, colour: str) -> None:
        """Add strips over the whole height, of columns x0 and x1."""
        made = self.plot.vstrip(
            "x0", "x1", source=self.source(name, "x0", "x1"), fill_color=self.ink[colour], fill_alpha=0.3,
            line_color=None,
        )  # fmt: skip
        self._described(made, called, colour, "band", "")

    def rule(self, name: str, called: str, along: str, colour: str = "threshold", dash: str = "dashed") -> Any:
        """Add a straight line whose position is set later."""
        dimension: Literal["height", "width"] = "height" if along == "x" else "width"
        span = Span(dimension=dimension, location=None, line_color=self.ink[colour], line_dash=dash, name=name)
        self.plot.add_layout(span)
        self.legend.append((called, self.ink[colour], "dash", ""))
        return span

    def saturated(self) -> None:
        """Add strips that mark saturated pixels."""
        made = self.plot.vstrip(
            "x0", "x1", source=self.source("saturated", "x0", "x1"), fill_color=self.ink.own, fill_alpha=0.18,
            line_color=None, hatch_pattern="/", hatch_color=self.ink.own, hatch_alpha=0.5,
        )  # fmt: skip
        made.name = "saturated"
        self.legend.append(("saturated", self.ink.own, "band", "if any"))

    def tooltips(self, made: Any, *lines: tuple[str, str], mode: Literal["mouse", "hline", "vline"] = "vline") -> None:
        """Add a tooltip with the name of what is drawn and columns in four significant digits."""
        columns = [column for _, column in lines]
        rows = "".join(f"<div>{name}: <b>@{column}{{%.4g}}</b></div>" for name, column in lines)
        over = made
        if made.glyph.__class__.__name__ == "Step":
            # BokehJS finds no steps below the pointer.
            over = self.plot.line("x", "y", source=made.data_source, line_alpha=0)
        self.plot.add_tools(
            HoverTool(
                renderers=[over],
                mode=mode,
                point_policy="snap_to_data",
                line_policy="nearest",
                tooltips=f"<b>{made.name}</b>{rows}",
                formatters={f"@{column}": "printf" for column in columns},
            )
        )

    def _described(self, made: Any, called: str, colour: str, form: str, show: str) -> Any:
        """Add an entry to the page's legend, with the tag that shows or hides it."""
        made.name, made.tags, made.visible = called, [show], not show
        self.legend.append((called, self.ink[colour], form, show))
        return made

    def _mark(self) -> None:
        """Add marks of spectral lines."""
        for name, places in MARKS.items():
            show = "more marks" if name in MORE_MARKS else "marks"
            for place in places:
                self.plot.add_layout(
                    Span(
                        dimension="height", location=place, line_color=self.ink.text, line_alpha=0.35, line_width=1,
                        line_dash="dotted", tags=[show], visible=name not in MORE_MARKS,
                    )
                )  # fmt: skip
            self.plot.add_layout(
                Label(
                    x=sum(places) / len(places), y=0, y_units="screen", y_offset=2, x_offset=3, text=name, tags=[show],
                    visible=name not in MORE_MARKS, text_font="system-ui", text_font_size="10px", angle=1.5708,
                    text_color=self.ink.text, text_alpha=0.8,
                )
            )  # fmt: skip


def curves(name: str, drawn: Sequence[tuple[Any, Any]]) -> dict[str, dict[str, Any]]:
    """Return the sources of `Canvas.targets` from x and y of each target."""
    empty: list[tuple[Any, Any]] = [([], [])] * (len(TARGETS) - len(drawn))
    return {f"{name} {k}": {"x": x, "y": y} for k, (x, y) in enumerate([*drawn[: len(TARGETS)], *empty])}


def target_names(names: Sequence[str]) -> dict[str, str]:
    """Return the entries of the legend of `Canvas.targets`."""
    return {f"target {k}": name for k, name in enumerate(names[: len(TARGETS)], 1)}


def strips(wavelength_nm: Any, flags: Any) -> dict[str, Any]:
    """Return the ends of runs of flagged pixels, half a pixel beyond each."""
    import numpy as np

    padded = np.diff(np.concatenate([[0], np.asarray(flags, int), [0]]))
    first, last = np.nonzero(padded == 1)[0], np.nonzero(padded == -1)[0] - 1
    half = 0.5 * np.gradient(wavelength_nm)
    return {"x0": (wavelength_nm - half)[first], "x1": (wavelength_nm + half)[last]}
