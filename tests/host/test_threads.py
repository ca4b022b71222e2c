"""Work in threads yields results in order, few ahead of their use, and ends with its caller."""

import os
import threading
import time

import pytest

from mauvecl.host.arrays import map_in_threads

Work = list[int]
#: At most as many, however many cores there are.
THREADS = 4


@pytest.fixture(autouse=True)
def several_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 8)


@pytest.mark.parametrize("number", [None, 1, 3])
def test_results_are_in_the_order_of_the_items(number: int | None) -> None:
    def work(k: int) -> int:
        time.sleep(0.002 * (k % 3))
        return k * k

    assert list(map_in_threads(work, range(30), number)) == [k * k for k in range(30)]


def test_items_are_worked_on_at_the_same_time() -> None:
    together = threading.Barrier(THREADS)
    assert all(map_in_threads(lambda _: together.wait(10) >= 0, range(THREADS)))


def test_few_results_wait_and_none_are_made_after_the_caller_stops() -> None:
    begun: Work = []
    results = map_in_threads(lambda k: begun.append(k), range(100))
    for _ in range(5):
        next(results)
    time.sleep(0.05)
    assert len(begun) <= 5 + THREADS
    results.close()
    number = len(begun)
    time.sleep(0.05)
    assert len(begun) == number


def test_an_error_reaches_the_caller_and_ends_the_work() -> None:
    begun: Work = []

    def work(k: int) -> int:
        begun.append(k)
        return 1 // (3 - k)

    results = map_in_threads(work, range(100))
    with pytest.raises(ZeroDivisionError):
        list(results)
    assert len(begun) <= 4 + 2 * THREADS
