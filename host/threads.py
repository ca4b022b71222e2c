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


def map_in_threads(work: Callable[[Item], Answer], items: Iterable[Item], *, small: bool = False) -> Generator[Answer]:
    """Apply a function to items in several threads and yield the results in the order of the items.

    At most one result for each thread waits to be yielded, so that the memory stays limited.

    Parameters
    ----------
    work : callable
    items : iterable
    small : bool, optional
        Whether the work is too little for threads; it is then done in the caller's.
    """
    number = min(os.cpu_count() or 1, MOST_THREADS)
    if small or number == 1:
        yield from map(work, items)
        return
    ahead: deque[Future[Answer]] = deque()
    threads = ThreadPoolExecutor(number)
    try:
        for item in items:
            ahead.append(threads.submit(work, item))
            if len(ahead) > number:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()
    finally:
        threads.shutdown(cancel_futures=True)
