"""Progress of a verb in its stars, cells or targets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")


def reported(items: Iterable[Item], total: int, progress: Callable[[int, int], None] | None) -> Iterator[Item]:
    """Yield items, and call ``progress(done, total)`` after the work on each."""
    for done, item in enumerate(items, 1):
        yield item
        if progress is not None:
            progress(done, total)
