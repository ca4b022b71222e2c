"""Matplotlib figures: the registry of pictures by class, style, axes, and files."""

from __future__ import annotations

import io
import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from itertools import cycle
from operator import itemgetter
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, TypeVar

import numpy as np

from mauvecl.charts.chart import INK, Area, Dots, Levels, Line, Mesh, Panel, Picture, Rule, Series, Strips, Targets
from mauvecl.host.tables.files import write_whole
from mauvecl.schema.errors import InputError

#: Colours of Okabe & Ito, which colour-blind readers can distinguish (jfly.uni-koeln.de/color); neighbours differ in
#: lightness as well.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#56B4E9", "#D55E00", "#CC79A7", "#000000")
NULL = INK["drawn"]
RANGE_NM = (200.0, 700.0)  # wavelengths that are shown
MANY = 5000  # number of cells of a mesh above which vector files hold it as pixels
MAX_COLUMNS = 3  # largest number of panels side by side
COLUMN = 3.5  # width of one column of a journal, inches
UNBROKEN, MINUS = "\N{NO-BREAK SPACE}", "\N{MINUS SIGN}"
SMALL = 8  # size of the labels of ticks that are names
#: Largest fractions of a figure's width that legends and titles take.
INSIDE, TITLE = 0.97, 0.93
#: Largest width of a panel's title, as a fraction of the width that matplotlib gives the panel before the layout, which
#: leaves less room between panels.
PANEL_TITLE = 1.2

STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.formatter.use_mathtext": True,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.markerscale": 1.6,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 160,
    "pdf.fonttype": 42,
    "lines.linewidth": 1.2,
}


def available() -> bool:
    """Return whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def style() -> Any:
    """Return a context in which figures have the common style."""
    import matplotlib as mpl

    return mpl.rc_context(STYLE)  # type: ignore[arg-type]


def new_figure(size: tuple[float, float], **options: Any) -> Any:
    """Return an empty figure that Agg renders, without pyplot's windows, and that notebooks display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    def png() -> bytes:
        content = io.BytesIO()
        figure.savefig(content, format="png")
        return content.getvalue()

    figure: Any = Figure(figsize=size, **options)
    FigureCanvasAgg(figure)
    figure._repr_png_ = png
    return figure


def _subfigure_of(ax: Any) -> Any:
    """Return the part of the caller's figure that axes occupy, for a picture of several panels.

    Raises InputError if the axes are not part of a grid.
    """
    spec = ax.get_subplotspec()
    if spec is None:
        raise InputError(
            "ax must be part of a grid for a picture of several panels; use axes from plt.subplots", key="ax"
        )
    ax.set_axis_off()
    return ax.figure.add_subfigure(spec)


def _legend_below(figure: Any, axes: Sequence[Any]) -> None:
    """Add a legend of axes below all panels, in as few rows as fit, which have about equally many entries."""
    entries = (zip(*axis.get_legend_handles_labels(), strict=True) for axis in axes)
    handles = {name: handle for of_axis in entries for handle, name in of_axis}
    for rows in range(1, len(handles) + 1):
        columns = -(-len(handles) // rows)
        legend = figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns)
        if columns == 1 or legend.get_window_extent().width <= INSIDE * figure.bbox.width:
            return
        legend.remove()


def numeral(value: float, digits: int = 6) -> str:
    """Return a number, rounded to some significant digits, as people write it: 0.1, 500, or 2 times a power of ten."""
    rounded = float(f"{value:.{digits}g}")
    factor, _, power = f"{rounded:.5e}".partition("e")
    if rounded == 0 or -4 <= int(power) < 5:
        return f"{rounded:g}".replace("-", MINUS)
    factor = f"{float(factor):g}"
    return rf"$10^{{{int(power)}}}$" if factor == "1" else rf"${factor}\times10^{{{int(power)}}}$"


def in_rows(panels: Sequence[Panel], columns: int) -> list[Sequence[Panel]]:
    """Divide panels into rows with a number of columns."""
    return [panels[k : k + columns] for k in range(0, len(panels), columns)]


def cell_edges(middles: Any, *, log: bool = False) -> Any:
    """Return the edges of cells halfway between ascending middles, in the logarithm if `log`."""
    at = np.log(middles) if log else np.asarray(middles, float)
    half = np.diff(at) / 2 if at.size > 1 else np.array([0.5 if log else abs(at[0]) / 10 or 0.5])
    edges = np.concatenate([at[:1] - half[:1], at[:-1] + half[: at.size - 1], at[-1:] + half[-1:]])
    return np.exp(edges) if log else edges


def unit_label(unit: str) -> str:
    """Return a unit in astropy's notation as labels of axes show it."""
    from astropy.units import Unit

    return str(Unit(unit).to_string("latex_inline"))


@dataclass(frozen=True)
class PictureFunction:
    """Function that returns a picture, or its only panel, of the objects of a class."""

    name: str  # name of the file
    draw: Callable[..., Picture | Panel]
    given: Callable[[Any], tuple[Any, ...]] = lambda instance: (instance,)  # arguments of `draw` for an object
    #: Arguments of `draw` for each of several numbered pictures of an object.
    each: Callable[[Any], Iterable[tuple[Any, ...]]] | None = None
    when: Callable[[Any], object] = lambda instance: True  # whether an object has the picture


#: Entries by class name, since importing the classes would import every answer.
ENTRIES: defaultdict[str, list[PictureFunction]] = defaultdict(list)
Draw = TypeVar("Draw", bound=Callable[..., Picture | Panel])


def picture_of(kind: str, name: str, **options: Any) -> Callable[[Draw], Draw]:
    """Return a decorator that registers a function as a picture of a class; `plot` draws the first.

    `kind` is the name of the class, as in "LimitAnswer", `name` that of the file without its ending; `options` are as
    for `PictureFunction`.
    """

    def registered(draw: Draw) -> Draw:
        ENTRIES[kind].append(PictureFunction(name, draw, **options))
        return draw

    return registered


def load() -> None:
    """Import all modules of pictures, so that they register their functions."""
    for module in iter_modules([str(Path(__file__).parent)]):
        import_module(f"{__package__}.{module.name}")


def pictures_of(instance: Any) -> dict[str, Callable[..., Any]]:
    """Return every picture of an object by file name, numbered ones by number, as functions of `path` and `ax`."""
    load()
    entries = next((ENTRIES[kind.__name__] for kind in type(instance).__mro__ if kind.__name__ in ENTRIES), [])
    numbered = list[tuple[int, str, Callable[..., Any]]]()
    for entry in filter(lambda entry: entry.when(instance), entries):
        if entry.each is None:
            numbered.append((1, entry.name, partial(entry.draw, *entry.given(instance))))
        for number, arguments in enumerate(entry.each(instance) if entry.each else (), 1):
            numbered.append((number, f"{entry.name}-{number}", partial(entry.draw, *arguments)))
    return {name: partial(draw_and_save, draw) for _, name, draw in sorted(numbered, key=itemgetter(0))}


def draw_and_save(
    draw: Callable[..., Picture | Panel], path: str | Path | None = None, *, ax: Any = None, **options: Any
) -> Any:
    """Draw a function's picture in the common style; return its figure, the path if it is saved, or the axes `ax`."""
    if ax is not None and not (hasattr(ax, "plot") and hasattr(ax, "figure")):
        raise InputError.of("ax", ax, "axes, as returned by plt.subplots")
    with style():
        described = draw(**options)
        picture = Picture([[described]]) if isinstance(described, Panel) else described
        saved = save_or_return(draw_picture(picture, ax=ax), path)
    return saved if ax is None else ax


def draw_picture(picture: Picture, figure: Any = None, *, ax: Any = None) -> Any:
    """Draw a picture in a figure, by default one of its own or that of axes `ax`, and return the figure."""
    rows, n = picture.rows, max(len(row) for row in picture.rows)
    alone = ax is not None and len(rows) == n == 1
    if figure is None:
        figure = new_figure(picture.size) if ax is None else ax.figure if alone else _subfigure_of(ax)
    axes = np.array([[ax]]) if alone else figure.subplots(
        len(rows), n, squeeze=False, sharex=picture.share_x, sharey=picture.share_y, height_ratios=picture.heights,
        width_ratios=picture.widths,
    )  # fmt: skip
    bars, drawn = dict[str, tuple[Any, list[Any]]](), list[tuple[Any, Panel]]()
    for (i, k), axis in np.ndenumerate(axes):
        panel, below = (rows[j][k] if j < len(rows) and k < len(rows[j]) else None for j in (i, i + 1))
        if panel is None:
            axis.set_visible(False)
            continue
        drawn.append((axis, panel))
        for called, mesh in _draw_panel(axis, panel, legend=alone or not picture.below).items():
            bars.setdefault(called, (mesh, []))[1].append(axis)
        before = rows[i][k - 1] if k else None
        if picture.share_x and below is not None:
            axis.set_xlabel("")
        if before is not None and before.y.label == panel.y.label:
            axis.set_ylabel("")
    for axis, panel in drawn:
        _finish(axis, panel)
    for called, (mesh, beside) in bars.items():
        figure.colorbar(mesh, ax=beside, label=called)
    title = "; ".join(filter(None, (picture.title, *picture.notes)))
    if alone:
        axes[0, 0].set_title(axes[0, 0].get_title(loc="left") or title)
        return figure
    if picture.below:
        _legend_below(figure, [axis for axis, _ in drawn])
    if title:
        # matplotlib would fill the width to the edges.
        _wrap(figure.suptitle(title, fontsize=9.0), TITLE * figure.bbox.width)
    return figure


def _wrap(text: Any, width: float) -> None:
    """Break a text that is wider than some pixels into lines of about this width."""
    words, extent = text.get_text(), text.get_window_extent().width
    if extent > width:
        letters = max(int(len(words) * width / extent), 1)
        text.set_text(textwrap.fill(words, letters, break_on_hyphens=False, break_long_words=False))


def _finish(axis: Any, panel: Panel) -> None:
    """Set ranges and ticks of axes, which may be shared, when all panels are drawn.

    Logarithmic ticks are plain numbers (0.1, 20, 500), with intermediate ones only over few decades.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    for side, of in ((axis.xaxis, panel.x), (axis.yaxis, panel.y)):
        limits, name = RANGE_NM if of.kind == "wavelength" and of.limits is None else of.limits, side.axis_name
        if limits is not None:
            axis.set(**{f"{name}lim": limits})
        if of.ticks is not None:
            side.set_ticks(*of.ticks, **({"fontsize": SMALL} if len(of.ticks) > 1 else {}))
        if side.get_scale() != "log":
            continue
        low, high = sorted(side.get_view_interval())
        decades = float(np.log10(high / low))
        if of.ticks is None:
            # Powers of ten are too wide to stand side by side with others.
            most = 1 if name == "x" and (low < 1e-4 or high > 1e5) else 2
            side.set_major_locator(LogLocator(subs=(1.0,) if decades > most else (1.0, 2.0, 5.0)))
        if decades < 4:
            side.set_major_formatter(lambda value, _: numeral(value))
        side.set_minor_formatter(NullFormatter())
    if panel.finish is not None:
        panel.finish(axis)


def _draw_panel(axis: Any, panel: Panel, *, legend: bool) -> dict[str, Any]:
    """Draw a panel on axes, and return what its colour bars are of, by their labels."""
    for name, of in (("x", panel.x), ("y", panel.y)):
        getattr(axis, f"set_{name}label")(of.label)
        if of.log:
            getattr(axis, f"set_{name}scale")("log")
    bars = {item.called: mesh for item in panel.series if (mesh := _draw_series(axis, item)) is not None}
    title, place = axis.set_title(panel.title), axis.get_subplotspec()
    if panel.title and place is not None:
        _wrap(title, PANEL_TITLE * place.get_position(axis.figure).width * axis.figure.bbox.width)
    if legend and axis.get_legend_handles_labels()[1]:
        axis.legend()
    return bars


def _draw_series(axis: Any, item: Series) -> Any:
    """Draw a series, and return what a colour bar is of, if any."""
    look = {
        "color": INK.get(item.colour, item.colour),
        "alpha": item.alpha,
        "label": (item.called if item.listed else "") or None,
    }
    width, at = {"linewidth": 0.75 * item.width}, item.at
    match item:
        case Mesh():
            look = {"cmap": item.palette, "rasterized": at[2].size > MANY, "edgecolors": item.edges, "linewidth": 0.2}
            axis.set_facecolor(item.empty)
            return axis.pcolormesh(*at, vmin=item.low, vmax=item.high, **look)
        case Levels():
            # Lines are close where a map is steep, so that labels would not fit; a bright edge sets them off.
            strokes = dict(zip(sorted(item.levels), cycle(("dotted", "dashed", "-", "dashdot")), strict=False))
            axis.contour(*at, levels=list(strokes), colors="white", linewidths=2.4)
            axis.contour(*at, levels=list(strokes), colors="black", linewidths=1.2, linestyles=list(strokes.values()))
            for level, dash in strokes.items():
                axis.plot([], [], "k", linestyle=dash, label=f"{item.called} in {100 * level:g} %", **width)
        case Rule():
            for place in np.atleast_1d(at):
                (axis.axvline if item.along == "x" else axis.axhline)(place, **look, linewidth=0.8, linestyle=item.dash)
                look["label"] = None
        case Strips():
            for low, high in zip(*at, strict=True):
                (axis.axvspan if item.along == "x" else axis.axhspan)(low, high, **look, linewidth=0)
                look["label"] = None
        case Targets():
            for colour, (name, x, y) in zip(cycle(COLOURS), at, strict=False):
                axis.plot(x, y, color=colour, label=name, **width)
        case Area():
            axis.fill_between(*at, step="mid" if item.step else None, **look, linewidth=0)
        case Dots():
            form = "o" if item.marker == "circle" else item.marker or "none"
            axis.errorbar(*at, fmt=form, markersize=0.6 * item.size, elinewidth=0.6 * item.width, **look)
        case Line():
            look |= {"marker": item.marker, "markersize": 3, "drawstyle": "steps-mid" if item.step else "default"}
            axis.plot(*at, linestyle=item.dash or "-", **look, **width)
    return None


def save_or_return(figure: Any, path: str | Path | None) -> Any:
    """Save a figure in the format of the path's extension (.png, .pdf, .svg), or return it if there is no path.

    Raises InputError, without changing an existing file, if the figure cannot be written.
    """
    if path is None:
        return figure
    content, place, parent = io.BytesIO(), Path(path), figure.figure
    if place.suffix == ".png":
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        # savefig gives the same result, but draws each picture twice.
        parent.set_dpi(STYLE["savefig.dpi"])
        FigureCanvasAgg(parent).print_png(content)  # type: ignore[no-untyped-call]
    else:
        parent.savefig(content, format=place.suffix[1:] or None)
    write_whole(place, content.getbuffer())
    return place
