"""How realisations are drawn: what a user may say about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypedDict, get_args

from mauvecl.host.errors import InputError
from mauvecl.noise.processes import NONE, Processes

Mode = Literal["auto", "frames", "stacked"]
Recipe = Literal["auto", "joint", "apart"]


class DrawingWords(TypedDict, total=False):
    """The fields of a `Drawing`, as keyword arguments."""

    mode: Mode
    recipe: Recipe
    processes: Processes
    first_frame: int


@dataclass(frozen=True)
class Drawing:
    """How realisations are drawn.

    Attributes
    ----------
    mode : {"auto", "frames", "stacked"}
        Draw each frame, or all at once; by itself frames only near a rail, and where a frame has so little noise that
        its rounding is none.
    recipe : {"auto", "joint", "apart"}
        Draw all noise of a pixel from one normal, or Poisson counts apart; by itself apart only where the joint draw
        would not be exact.
    processes : Processes
    first_frame : int
        Where frames are counted from: one frame k of an exposure is drawn with an expectation of one frame and
        ``first_frame=k``.

    Raises
    ------
    InputError
        For another mode or recipe.
    """

    mode: Mode = "auto"
    recipe: Recipe = "auto"
    processes: Processes = NONE
    first_frame: int = 0

    def __post_init__(self) -> None:
        for name, value, known in (("mode", self.mode, get_args(Mode)), ("recipe", self.recipe, get_args(Recipe))):
            if value not in known:
                a, b, c = map(repr, known)
                raise InputError(f"{name} = {value!r}, expected {a}, {b} or {c}")

    @property
    def words(self) -> DrawingWords:
        """Its fields."""
        return {
            "mode": self.mode,
            "recipe": self.recipe,
            "processes": self.processes,
            "first_frame": self.first_frame,
        }


#: As the noise itself asks for.
AUTOMATIC = Drawing()
