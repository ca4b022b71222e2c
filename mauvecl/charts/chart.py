"""Descriptions of charts, which matplotlib and Bokeh draw."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation

#: Colours on light ground by name, after Okabe & Ito; `web.tab.INKS` has those on dark ground as well.
INK = {
    "text": "#1b2733", "grid": "#dde3ea", "ground": "#ffffff", "star": "#0072B2", "flare": "#D55E00", "sky": "#009E73",
    "drawn": "#6b7785", "dark": "#7b4ea3", "read": "#B8860B", "bias": "#A65082", "total": "#1b2733",
    "threshold": "#1b2733", "own": "#C2185B", "shortest": "#E8801F", "middle": "#B34700", "longest": "#5C2200",
}  # fmt: skip
MOST_TARGETS = 8  # largest number of targets with a curve on the page; further ones are in the table alone


@dataclass(frozen=True)
class PlotAxis:
    """Axis of a chart."""

    label: str = ""
    log: bool = False
    limits: tuple[Any, Any] | None = None
    log_limits: tuple[Any, Any] | None = None  # limits of an axis that the visitor has made logarithmic, if others
    kind: str = ""  # "wavelength", "dates" or "names"; empty for other numbers
    ticks: tuple[Any, ...] | None = None  # places, and labels if they are no numbers, in files


WAVELENGTH = PlotAxis("wavelength (nm)", kind="wavelength")


@dataclass(frozen=True)
class Series:
    """Part of a chart, which one entry of the chart's data fills: an array for each of its columns."""

    called: str = ""  # in the legend
    colour: str = "drawn"  # name in a theme, or the colour itself
    name: str = ""  # of its data; by default that of the legend
    show: str = ""  # part of the page that shows or hides it; "if any" if only the legend depends on its data
    listed: bool = True  # whether the legend lists it
    width: float = 1.6
    dash: str = ""
    alpha: float = 1.0
    tips: tuple[str, ...] = ()  # names of y, or of x and y, in its tooltip; without a name it has no tooltip
    form: str = "line"  # in the legend: "line", "dash", "band", "dot", "bar" or "bars"
    columns: tuple[str, ...] = ("x", "y")
    at: Any = None  # its data, unless the chart's data hold it

    @property
    def key(self) -> str:
        """Name of its data."""
        return self.name or self.called


@dataclass(frozen=True)
class Line(Series):
    """Line through points."""

    step: bool = False
    marker: str = ""  # of its points in files


@dataclass(frozen=True)
class Area(Series):
    """Area between two lines."""

    alpha: float = 0.22
    step: bool = False
    form: str = "band"
    columns: tuple[str, ...] = ("x", "low", "high")


@dataclass(frozen=True)
class Dots(Series):
    """Points; in files also with the lengths of error bars along y and x."""

    size: float = 5
    marker: str = "circle"
    alone: bool = False  # whether the y axis has the range of these points alone
    form: str = "dot"


@dataclass(frozen=True)
class OwnMarker(Series):
    """Marker of the visitor's question."""

    called: str = "your question"
    colour: str = "own"
    name: str = "own"
    form: str = "dot"


@dataclass(frozen=True)
class Strips(Series):
    """Ranges of x over the whole height, in files also of y over the whole width."""

    alpha: float = 0.3
    along: str = "x"
    hatched: bool = False
    form: str = "band"
    columns: tuple[str, ...] = ("x0", "x1")


@dataclass(frozen=True)
class Bars(Series):
    """Histogram."""

    alpha: float = 0.45
    form: str = "bars"
    columns: tuple[str, ...] = ("left", "right", "top")


@dataclass(frozen=True)
class Contours(Series):
    """Several lines, each a list of points."""

    columns: tuple[str, ...] = ("xs", "ys")


@dataclass(frozen=True)
class Rule(Series):
    """Straight line at a value of x or y, which is its data, in files also at several."""

    along: str = "x"
    dash: str = "dashed"


@dataclass(frozen=True)
class Targets(Series):
    """Lines of several targets; its data is a list of name, x and y."""


@dataclass(frozen=True)
class Mesh(Series):
    """Values over x and y as colours, for files; `called` is the label of the colour bar."""

    low: float | None = 0.0
    high: float | None = 1.0
    palette: str = "cividis"
    edges: str = "none"  # colour of the cells' edges
    empty: str = "#bbbbbb"  # colour of cells without a value, which no palette has
    columns: tuple[str, ...] = ("x", "y", "values")


@dataclass(frozen=True)
class Levels(Series):
    """Contours of a probability over x and y, for files."""

    levels: tuple[float, ...] = (0.1, 0.5, 0.9)
    columns: tuple[str, ...] = ("x", "y", "values")


@dataclass(frozen=True)
class LegendEntry(Series):
    """Entry of the legend for parts that are not listed themselves."""


@dataclass(frozen=True)
class Custom(Series):
    """Part that the page draws by a function of its own, which is given the page's figure and the data source."""

    draw: Callable[[Any, Any], None] | None = None


@dataclass(frozen=True)
class ChartData:
    """Data of a chart."""

    text: str  # the picture in words, for visitors who do not see it
    #: By the name of the series: arrays for its columns, the place of a rule, or the curves of targets.
    series: Mapping[str, Any] = field(default_factory=dict)
    #: Properties by the name of the page's model, such as an axis's label.
    props: Mapping[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Chart:
    """Description of a picture: axes and series, without their data."""

    name: str
    title: str
    x: PlotAxis
    y: PlotAxis
    series: tuple[Series, ...]
    logs: tuple[str, ...] = ()  # axes that the visitor may make logarithmic; in capitals those that are so at first
    shows: Mapping[str, str] = field(default_factory=dict)  # parts that are hidden at first, with what they are called
    sets: str = ""  # fields that a click on the page sets, with the axis that gives each, as in "magnitude=x"
    pins: str = ""  # series that pinned scenarios have, too; empty if they are not drawn
    alike: tuple[str, ...] = ()  # fields in which a pinned scenario must agree with the question
    # Set by `data`: the function that returns the data, the answer that it takes, and the text without that answer.
    fill: Callable[[Any, Any], ChartData] = lambda closed, answers: ChartData("")
    of: str = ""
    before: str = ""

    def panel(self, series: Mapping[str, Any], title: str = "") -> Panel:
        """Return the chart with the data of its series; those without data are left out."""
        filled = [replace(item, at=series[item.key]) for item in self.series if item.key in series]
        return Panel(self.x, self.y, filled, title)

    def data(self, of: str = "", before: str = "") -> Callable[[Callable[[Any, Any], ChartData]], Chart]:
        """Return a decorator for the function that gives the data, which makes the whole chart of it.

        The function takes the closed forms of a question and its answers by name, or the answer `of` alone; without
        that answer the chart is empty, and `before` is its text.
        """
        return lambda fill: replace(self, fill=fill, of=of, before=before)

    def series_of(self, answer: Any) -> dict[str, Any]:
        """Return the data of the series for the answer that the chart is of."""
        return dict(self.fill(None, answer).series)

    def drawn(self, closed: Any, answers: Mapping[str, Any]) -> dict[str, Any]:
        """Return the text, the columns of the page's data sources, properties of models, and entries of the legend."""
        data = ChartData(self.before)
        if not self.of or self.of in answers:
            data = self.fill(closed, answers[self.of] if self.of else answers)
        assert data.series.keys() <= {item.key for item in self.series}
        sources, props, names = dict[str, Any](), dict(data.props), dict[str, str]()
        for item in self.series:
            columns = data.series.get(item.key, item.at)
            if isinstance(item, Rule):
                props[item.key] = {"location": columns}
            elif isinstance(item, Targets):
                for k, (name, x, y) in enumerate([*(columns or ()), *[("", [], [])] * MOST_TARGETS][:MOST_TARGETS]):
                    sources[f"{item.key} {k}"] = {"x": x, "y": y}
                    names |= {f"target {k + 1}": name} if name else {}
            elif not isinstance(item, LegendEntry):
                columns = [[]] * len(item.columns) if columns is None else columns
                sources[item.key] = dict(zip(item.columns, columns, strict=True))
        return {"text": data.text, "sources": sources, "props": props, "names": names}


@dataclass(frozen=True)
class Panel:
    """Axes and series with their data, as a part of a file."""

    x: PlotAxis
    y: PlotAxis
    series: Sequence[Series]
    title: str = ""
    finish: Callable[[Any], None] | None = None  # changes the axes of matplotlib when all is drawn


@dataclass(frozen=True)
class Picture:
    """Panels of a file, from top to bottom and from left to right; None for an empty place.

    A label that the panel below or on the left has, too, is not repeated.
    """

    rows: Sequence[Sequence[Panel | None]]
    size: tuple[float, float] = (3.6, 2.7)  # inches
    title: str = ""
    notes: tuple[str, ...] = ()
    below: bool = False  # whether one legend stands below all panels
    share_x: bool = False
    share_y: bool | str = False
    heights: tuple[float, ...] | None = None  # ratios of the rows' heights
    widths: tuple[float, ...] | None = None


def throughput_of(expectations: Iterable[Expectation]) -> str:
    """Return whether the throughput of expectations is nominal or calibrated, for the notes of pictures."""
    return " and ".join(dict.fromkeys(filter(None, (x.notice.kind for x in expectations))))
