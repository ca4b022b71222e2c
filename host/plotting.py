"""Pictures by name: what draws itself loads no matplotlib, and imports nothing above it."""

from __future__ import annotations

from contextvars import ContextVar
from importlib import import_module
from typing import Any

from .errors import InputError
from .quantities import shown

#: Axes of the caller's that a picture is drawn in; None where it has a figure of its own.
AXES: ContextVar[Any] = ContextVar("axes", default=None)


def picture(name: str, *given: Any, ax: Any = None, **named: Any) -> Any:
    """A figure, or the path it was saved under.

    Parameters
    ----------
    name : str
        Module and function in `mauvecl.pictures`, such as ``"answers.detection"``.
    *given, **named
        What the function takes, such as the `path` that it is saved under.
    ax : matplotlib Axes, optional
        Drawn into instead, and handed back; a picture of several panels takes their place.

    Raises
    ------
    InputError
        If `ax` is no axes.
    """
    if ax is not None and not (hasattr(ax, "plot") and hasattr(ax, "figure")):
        raise InputError(f"ax = {shown(ax)}, expected axes, as plt.subplots makes")
    module, _, function = name.rpartition(".")
    before = AXES.set(ax)
    try:
        drawn = getattr(import_module(f"mauvecl.pictures.{module}"), function)(*given, **named)
    finally:
        AXES.reset(before)
    return drawn if ax is None else ax
