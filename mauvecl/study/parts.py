"""Parts of lists that are too long to show, with a note on the number left out."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from itertools import islice
from typing import TypeVar

T = TypeVar("T")


class First(list[T]):
    """The first items of a list, and a note on their number.

    Parameters
    ----------
    most : int
        Largest number of items.
    name : str
        Plural noun for the items.

    Attributes
    ----------
    note : str
        As in "6 of 9 stars shown"; empty if all are kept.
    """

    def __init__(self, things: Collection[T], most: int, name: str) -> None:
        super().__init__(islice(things, most))
        self.note = part_note(len(self), len(things), name)


def part_note(shown: int, total: int, name: str) -> str:
    """Return the note on a part of a list, as in "6 of 9 stars shown", or nothing for all of it."""
    return f"{shown} of {total} {name} shown" if shown < total else ""


def note_of(things: Iterable[object]) -> str:
    """Return the note of items that are a part of a list, or nothing."""
    return things.note if isinstance(things, First) else ""
