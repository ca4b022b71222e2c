"""Bad requests to the engine: each row is a call, the key that its error names, and facts of its sentence."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
from refusals import Row, check
from scenes import instrument, star

from mauvecl import Engine, Expectation

PAYLOAD = instrument(part=True)


@cache
def engine() -> Engine:
    return Engine()


@cache
def scene(**how: Any) -> list[Expectation]:
    return star(amplitudes=(0.24,), payload=PAYLOAD, **how)


def realise(count: int = 1, seed: int = 1, **how: Any) -> None:
    engine().realise(scene()[0], count=count, seed=seed, **how)


def detect(flares: list[Expectation], *statistics: str) -> None:
    engine().detect(scene()[0], flares, realisations=10, seed=1, statistics=statistics)


ROWS: list[Row] = [
    (lambda: realise(count=0), "count", "0"),
    (lambda: realise(seed=-1), "seed", "-1"),
    (lambda: realise(seed=2**64), "seed", "18446744073709551616"),
    (lambda: realise(start=-1), "start", "-1"),
    (lambda: realise(mode="fast"), "mode", "'fast'"),
    (lambda: detect(scene()[1:], "chi3"), "statistic", "'chi3'"),
    (lambda: detect([], "matched"), "flares"),
    (lambda: detect(scene(exposure=5.0)[:1], "matched"), "n_frames"),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[1])
def test_bad_input_raises(row: Row) -> None:
    check(row)
