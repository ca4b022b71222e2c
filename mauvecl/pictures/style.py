"""Common style of all pictures: colours, axes and output."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec

import numpy as np

from mauvecl.host.files.atomic import write_whole
from mauvecl.schema.errors import InputError

P = ParamSpec("P")
#: Caller's axes to draw in; None if the picture creates its own figure.
AXES: ContextVar[Any] = ContextVar("axes", default=None)
#: Colours of Okabe & Ito, which colour-blind readers can distinguish (jfly.uni-koeln.de/color).
COLOURS = ("#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7", "#000000")
NULL = "#777777"
#: Panels side by side.
MAX_COLUMNS = 3
#: Width of one column of a journal, inches.
COLUMN = 3.5
#: No-break space.
UNBROKEN = "\N{NO-BREAK SPACE}"
#: Largest fraction of a figure's width for titles and legends.
INSIDE = 0.97

STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.constrained_layout.use": True,
    "savefig.dpi": 160,
    "lines.linewidth": 1.2,
}


def available() -> bool:
    """Return whether matplotlib is installed."""
    from importlib.util import find_spec

    return find_spec("matplotlib") is not None


def canvas() -> Any:
    """Return the canvas that creates figures, or parts of the caller's axes."""
    ax = AXES.get()
    return Canvas() if ax is None else Within(Canvas(), ax)


class Canvas:
    """Functions of pyplot that pictures need, without its windows, backend and list of open figures."""

    def __init__(self) -> None:
        import matplotlib as mpl
        from matplotlib.lines import Line2D

        self.rc_context, self.rcParams, self.Line2D = mpl.rc_context, mpl.rcParams, Line2D

    def figure(self, **how: Any) -> Any:
        """Return an empty figure that Agg renders."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        from mauvecl.pictures.figure import Picture

        figure = Picture(**how)
        FigureCanvasAgg(figure)
        return figure

    def subplots(self, rows: int = 1, columns: int = 1, **how: Any) -> Any:
        """Return a figure and its panels."""
        of_panels = ("squeeze", "sharex", "sharey", "width_ratios", "height_ratios", "subplot_kw", "gridspec_kw")
        panels = {key: how.pop(key) for key in of_panels if key in how}
        figure = self.figure(**how)
        return figure, figure.subplots(rows, columns, **panels)

    def close(self, figure: Any) -> None:
        """Do nothing: no list holds the figure."""


class Within:
    """Canvas whose new figures are the caller's axes."""

    def __init__(self, plt: Any, ax: Any) -> None:
        self._plt, self._ax = plt, ax

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plt, name)

    def subplots(self, rows: int = 1, columns: int = 1, *, squeeze: bool = True, **how: Any) -> Any:
        """Return the axes for one panel; for more, panels that replace them."""
        if rows == columns == 1:
            axes = self._ax if squeeze else np.array([[self._ax]])
            return TitledAxes(self._ax), axes
        how.pop("figsize", None)
        part = self.figure()
        return part, part.subplots(rows, columns, squeeze=squeeze, **how)

    def figure(self, **_: Any) -> Any:
        """Return the part of the caller's figure that the axes occupy.

        Raises InputError if the axes are not part of a grid.
        """
        spec = self._ax.get_subplotspec()
        if spec is None:
            raise InputError(
                "ax is not part of a grid", "axes from plt.subplots, for a picture of several panels", key="ax"
            )
        self._ax.set_axis_off()
        return self._ax.figure.add_subfigure(spec)

    def close(self, figure: Any) -> None:
        """Do nothing, since the figure belongs to the caller."""


class TitledAxes:
    """Axes that act as a figure, with its title and legend in the axes."""

    def __init__(self, ax: Any) -> None:
        self._ax = ax

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ax.figure, name)

    @property
    def bbox(self) -> Any:
        """Bounding box of the axes."""
        return self._ax.bbox

    def suptitle(self, text: str, **_: Any) -> Any:
        """Set the axes' title, unless they have one."""
        return None if self._ax.get_title(loc="left") else self._ax.set_title(text)

    def legend(self, handles: Sequence[Any], names: Sequence[str], **_: Any) -> Any:
        """Add a legend within the axes."""
        return self._ax.legend(handles, names, loc="best")


def headline(figure: Any, text: str, *notes: str, fontsize: float = 9.0) -> None:
    """Add a title above all panels, wrapped to the figure's width."""
    text = "; ".join(filter(None, (text, *notes)))
    if not text:
        return
    title = figure.suptitle(text, fontsize=fontsize)
    if title is None:
        return
    words, lines = text.split(" "), [""]
    for word in words:
        title.set_text(f"{lines[-1]} {word}".strip())
        if lines[-1] and title.get_window_extent(_renderer(figure)).width > INSIDE * figure.bbox.width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    title.set_text("\n".join(lines))


def legend_below(figure: Any, handles: Sequence[Any], names: Sequence[str]) -> None:
    """Add a legend below all panels, in as many columns as fit."""
    for columns in range(len(names), 0, -1):
        legend = figure.legend(handles, names, loc="outside lower center", ncols=columns)
        if columns == 1 or legend.get_window_extent(_renderer(figure)).width <= INSIDE * figure.bbox.width:
            return
        legend.remove()


def plain_numbers(axis: Any) -> None:
    """Label logarithmic ticks as plain numbers (0.1, 20, 500), with intermediate ticks only over few decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for one in (axis.xaxis, axis.yaxis):
        if one.get_scale() != "log":
            continue
        low, high = sorted(one.get_view_interval())
        decades = float(np.log10(high / low))
        one.set_major_locator(LogLocator(subs=(1.0,) if decades > 2 else (1.0, 2.0, 5.0)))
        if decades < 4:
            one.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        one.set_minor_formatter(NullFormatter())


def _renderer(figure: Any) -> Any:
    """Return the renderer that measures text."""
    from matplotlib.backends.backend_agg import RendererAgg

    size = figure.bbox
    return RendererAgg(size.width, size.height, figure.dpi)  # type: ignore[no-untyped-call]


def styled_picture(draw: Callable[Concatenate[Any, P], Any]) -> Callable[..., Any]:
    """Decorate a function that draws on a canvas: apply the common style, and save the figure if a path is given."""

    @wraps(draw)
    def picture(*what: Any, path: str | Path | None = None, **how: Any) -> Any:
        plt = canvas()
        with plt.rc_context(STYLE):
            return save_or_return(draw(plt, *what, **how), path)

    return picture


def save_or_return(figure: Any, path: str | Path | None) -> Any:
    """Save a figure in the format of the path's extension (.png, .pdf, .svg), or return it if there is no path.

    Raises InputError, without changing an existing file, if the figure cannot be written.
    """
    canvas().close(figure)
    if path is None:
        return figure
    drawn, place, whole = io.BytesIO(), Path(path), figure.figure
    if place.suffix == ".png":
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        # savefig gives the same result, but draws each picture twice.
        whole.set_dpi(canvas().rcParams["savefig.dpi"])
        FigureCanvasAgg(whole).print_png(drawn)  # type: ignore[no-untyped-call]
    else:
        whole.savefig(drawn, format=place.suffix[1:] or None)
    write_whole(place, drawn.getbuffer())
    return place
