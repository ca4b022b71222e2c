"""User's options for the drawing of realisations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypedDict, get_args

from mauvecl.noise.processes import NONE, Processes
from mauvecl.schema.errors import InputError

Mode = Literal["auto", "frames", "stacked"]
Recipe = Literal["auto", "joint", "apart"]


class DrawingOptions(TypedDict, total=False):
    """Fields of a `Drawing` as keyword arguments."""

    mode: Mode
    recipe: Recipe
    processes: Processes
    first_frame: int


@dataclass(frozen=True)
class Drawing:
    """Options for the drawing of realisations."""

    # Whether to draw each frame, or their sum at once. "auto" draws frames only near zero or saturation, and if a frame
    # has too little noise to treat its rounding as noise.
    mode: Mode = "auto"
    # Whether to draw all noise of a pixel from one normal, or Poisson counts separately. "auto" draws separately only
    # if the joint draw is not exact.
    recipe: Recipe = "auto"
    processes: Processes = NONE  # optional noise processes
    # Number of the first frame. Frame k of an exposure is drawn with an expectation of one frame and ``first_frame=k``.
    first_frame: int = 0

    def __post_init__(self) -> None:
        for name, value, known in (("mode", self.mode, get_args(Mode)), ("recipe", self.recipe, get_args(Recipe))):
            if value not in known:
                a, b, c = map(repr, known)
                raise InputError.of(name, value, f"{a}, {b} or {c}")

    @property
    def options(self) -> DrawingOptions:
        """Fields as keyword arguments."""
        return {
            "mode": self.mode,
            "recipe": self.recipe,
            "processes": self.processes,
            "first_frame": self.first_frame,
        }


#: Options that follow from the noise.
AUTOMATIC = Drawing()
