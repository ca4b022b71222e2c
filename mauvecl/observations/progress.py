"""Progress of an analysis, as shares of the whole."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")

#: Share of what is left that a step of an unknown number of steps counts as.
EACH = 0.07


class Steps:
    """Part of an analysis, which reports the share of the whole that is done.

    `report` is called with shares of the whole, which rise from `first` to `last`; it may raise to stop the work.
    """

    def __init__(self, report: Callable[[float], None] | None = None, first: float = 0.0, last: float = 1.0) -> None:
        self._report, self._first, self._last = report, first, last
        self._done = 0.0

    def part(self, first: float, last: float) -> Steps:
        """Return the part between two shares of this one."""
        length = self._last - self._first
        return Steps(self._report, self._first + first * length, self._first + last * length)

    def reached(self, share: float) -> None:
        """Report that a share of this part is done."""
        self._done = max(self._done, min(share, 1.0))
        if self._report is not None:
            self._report(self._first + self._done * (self._last - self._first))

    def step(self) -> None:
        """Report that a step of an unknown number is done: each counts as the same share of what is left."""
        self.reached(self._done + EACH * (1.0 - self._done))

    def each(self, items: Iterable[Item], total: int) -> Iterator[Item]:
        """Yield items, and report after the work on each."""
        for done, item in enumerate(items, 1):
            yield item
            self.reached(done / total)
        self.reached(1.0)


#: Steps of work whose progress nobody follows.
UNREPORTED = Steps()
