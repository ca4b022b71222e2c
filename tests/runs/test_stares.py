"""Shards of stares join to the same bits, whoever draws them and whatever is kept."""

import pickle
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
from scenes import FIRST_STARE as START
from scenes import N_STARES as N
from scenes import flaring_stares as request

from mauvecl import Engine, LocalWorkers, Pool, Stare, Stares
from mauvecl.runs import checkpoint as shards

pytestmark = pytest.mark.usefixtures("small_shards")


@dataclass(frozen=True)
class Largest:
    """Reduction to the largest value of each stare."""

    adds: ClassVar[bool] = False

    def __call__(self, values: np.ndarray, first: int) -> dict[str, np.ndarray]:
        largest = values.max(axis=(-2, -1)).reshape(-1, values.shape[-3]).T
        return {"largest": largest, "number": first + np.arange(len(largest))}


@dataclass(frozen=True)
class Above:
    """Reduction to the number of frames above a level."""

    level: float
    adds: ClassVar[bool] = True

    def __call__(self, values: np.ndarray, first: int) -> dict[str, np.ndarray]:
        return {"frames": np.count_nonzero(values > self.level, axis=(-3, -2))}


@pytest.mark.long
@pytest.mark.parametrize("method", ["pixels", "cumulants"])
@pytest.mark.parametrize("reduction", [None, Largest(), Above(500.0)])
def test_shards_of_stares_join_to_the_same_bits(engine: Engine, method: Any, reduction: Any) -> None:
    """Compare two engines of different form, with requests in the form in which they travel, with one call."""
    asked = request(method, reduction=reduction)
    widths = iter((16, 1))

    def make(device: str | None, progress: Any) -> Engine:
        return Engine(device, progress=progress, width=next(widths))

    workers = LocalWorkers([None, "0"], make=make)
    pool = Pool(workers)
    found = pool.stares(pickle.loads(pickle.dumps(asked)))
    workers.close()
    assert pool.standing.shards == len(shards.shards(asked)) == 5, "cut at multiples of 64, and where the word ends"
    whole = Stares(engine.open_device).frames(
        asked.components, asked.stare, asked.flare, amplitudes=asked.amplitudes, first=START, count=N, seed=5,
        method=method,
    )  # fmt: skip
    if reduction is None:
        np.testing.assert_array_equal(found["values"], np.moveaxis(whole, 0, 1))
    else:
        for name, values in reduction(whole, START).items():
            np.testing.assert_array_equal(found[name], values)
    assert (whole[1] != whole[0]).any()


def test_fingerprints_distinguish_requests_of_stares() -> None:
    base = request()
    warmer = Stare.of(30.0, jitters={"light": 0.01}, offsets={"temperature": 0.1}, temperature_c=np.nextafter(21.0, 22))
    others = [
        replace(base, seed=6),
        replace(base, method="pixels"),
        replace(base, stare=warmer),
        replace(base, stare=Stare.of(30.0, jitters={"light": 0.01}, offsets={"star": 0.1}, temperature_c=21.0)),
        replace(base, components=replace(base.components, weights=2 * base.components.weights)),
        replace(base, flare=np.nextafter(base.flare, 9)),
        replace(base, amplitudes=base.amplitudes[:1]),
        replace(base, reduction=Largest()),
        replace(base, reduction=Above(1.0)),
        replace(base, reduction=Above(2.0)),
        # Rows belong to stares: from another first one on they mean something else.
        replace(base, start=START + 64),
    ]
    names = [shards.fingerprint(one) for one in (base, *others)]
    assert len(set(names)) == len(names)
    assert shards.fingerprint(pickle.loads(pickle.dumps(base))) == names[0]
    alike = replace(base, flare=None, amplitudes=None)
    assert shards.fingerprint(replace(alike, start=0, realisations=7)) == shards.fingerprint(alike)
