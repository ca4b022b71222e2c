"""Pictures by name: what draws itself loads no matplotlib, and imports nothing above it."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def picture(name: str, *given: Any) -> Any:
    """A figure, or the path it was saved under.

    Parameters
    ----------
    name : str
        Module and function in `mauvecl.pictures`, such as ``"answers.detection"``.
    *given
        What the function takes.
    """
    module, _, function = name.rpartition(".")
    return getattr(import_module(f"mauvecl.pictures.{module}"), function)(*given)
