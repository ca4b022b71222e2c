"""Progress of a verb in its stars, cells or targets."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")


def reported(items: Iterable[Item], total: int, progress: Callable[[int, int], None] | None) -> Iterator[Item]:
    """Yield items, and call ``progress(done, total)`` after the work on each.

    If that raises, a generator of items is closed at once, while the workers that it uses are still open.
    """
    try:
        for done, item in enumerate(items, 1):
            yield item
            if progress is not None:
                progress(done, total)
    finally:
        if isinstance(items, Generator):
            items.close()
