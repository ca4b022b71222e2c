"""One style for all pictures: colours, names on axes, what a figure becomes at the end."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from mauvecl.host.errors import InputError
from mauvecl.host.plotting import AXES
from mauvecl.runs.durable import write_whole

#: Okabe and Ito's colours, which colour-blind readers can tell apart (jfly.uni-koeln.de/color).
COLOURS = ("#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7", "#000000")
NULL = "#777777"
#: Panels side by side.
MOST_COLUMNS = 3

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
    """Whether matplotlib is installed."""
    from importlib.util import find_spec

    return find_spec("matplotlib") is not None


def pyplot() -> Any:
    """Matplotlib's pyplot, without windows unless a notebook or the user has chosen how figures are shown."""
    import os

    import matplotlib as mpl

    if "MPLBACKEND" not in os.environ:
        mpl.use("Agg")
    import matplotlib.pyplot as plt

    ax = AXES.get()
    return plt if ax is None else Within(plt, ax)


class Within:
    """Pyplot, whose new figures are the caller's axes."""

    def __init__(self, plt: Any, ax: Any) -> None:
        self._plt, self._ax = plt, ax

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plt, name)

    def subplots(self, rows: int = 1, columns: int = 1, *, squeeze: bool = True, **how: Any) -> Any:
        """The axes themselves for one panel; panels in their place for more."""
        if rows == columns == 1:
            axes = self._ax if squeeze else np.array([[self._ax]])
            return TitledAxes(self._ax), axes
        how.pop("figsize", None)
        part = self.figure()
        return part, part.subplots(rows, columns, squeeze=squeeze, **how)

    def figure(self, **_: Any) -> Any:
        """A part of the caller's figure, where the axes are.

        Raises
        ------
        InputError
            If they are not of a grid.
        """
        spec = self._ax.get_subplotspec()
        if spec is None:
            raise InputError(
                "ax is not of a grid, expected axes as plt.subplots makes, for a picture of several panels"
            )
        self._ax.set_axis_off()
        return self._ax.figure.add_subfigure(spec)

    def close(self, figure: Any) -> None:
        """The figure stays the caller's."""


class TitledAxes:
    """Axes for a figure: its title is theirs."""

    def __init__(self, ax: Any) -> None:
        self._ax = ax

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ax.figure, name)

    def suptitle(self, text: str, **_: Any) -> None:
        """The axes' own title, where they have none."""
        if not self._ax.get_title(loc="left"):
            self._ax.set_title(text)


def finished(figure: Any, path: str | Path | None) -> Any:
    """Save a figure under a path, in the form of its ending (.png, .pdf, .svg), or hand it out; pyplot forgets it.

    Raises
    ------
    InputError
        If it cannot be written; what was at its place is still there.
    """
    pyplot().close(figure)
    if path is None:
        return figure
    drawn, place = io.BytesIO(), Path(path)
    figure.figure.savefig(drawn, format=place.suffix[1:] or None)
    write_whole(place, drawn.getbuffer())
    return place
