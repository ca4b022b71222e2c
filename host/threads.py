"""Work in threads, for functions of NumPy and SciPy, which let other threads run."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")

#: Largest number of threads that work at the same time; each may hold large arrays.
MOST_THREADS = 4


def map_in_threads(
    work: Callable[[Item], Answer],
    items: Iterable[Item],
    number: int | None = None,
    stop: Callable[[], object] | None = None,
) -> Generator[Answer]:
    """Apply a function to items in several threads and yield the results in the order of the items.

    At most one result for each thread waits to be yielded, so that the memory stays limited.

    Parameters
    ----------
    work : callable
    items : iterable
    number : int, optional
        Number of threads, by default that of the cores, up to `MOST_THREADS`; one works in the caller's thread.
    stop : callable, optional
        Ends work in progress if it fails, or if its caller needs no more results; without it, that work is awaited.
    """
    number = number or min(os.cpu_count() or 1, MOST_THREADS)
    if number == 1:
        yield from map(work, items)
        return
    ahead: deque[Future[Answer]] = deque()
    with ThreadPoolExecutor(number) as threads:
        try:
            for item in items:
                ahead.append(threads.submit(work, item))
                if len(ahead) > number:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        except BaseException:
            for future in ahead:
                future.cancel()
            if stop is not None:
                stop()
            raise
