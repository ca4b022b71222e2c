"""One style for all pictures: colours, names on axes, what a figure becomes at the end."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

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

    return plt


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
    figure.savefig(drawn, format=place.suffix[1:] or None)
    write_whole(place, drawn.getbuffer())
    return place
