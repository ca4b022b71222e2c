"""Plots by name, so that classes with a `plot` method import neither matplotlib nor `mauvecl.pictures`."""

from __future__ import annotations

from contextvars import ContextVar
from importlib import import_module
from typing import Any

from .errors import InputError
from .quantities import shown

#: The caller's axes to draw in; None if the plot makes its own figure.
AXES: ContextVar[Any] = ContextVar("axes", default=None)


def picture(name: str, *given: Any, ax: Any = None, **named: Any) -> Any:
    """Draw a plot and return the figure, the path of the saved file, or `ax`.

    Parameters
    ----------
    name : str
        Module and function in `mauvecl.pictures`, such as ``"answers.detection"``.
    *given, **named
        Arguments of the function, such as the `path` of the file.
    ax : matplotlib Axes, optional
        Axes to draw in; a plot of several panels replaces them.
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
