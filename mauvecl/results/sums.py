"""Shards of a request: packed where they were counted, added up where they are wanted, exactly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.results.counts.far import FarCounts
from mauvecl.results.counts.tally import TailSamples, Tally
from mauvecl.results.detection.detection import Detection
from mauvecl.results.requests.requests import DetectRequest, SnrRequest
from mauvecl.results.snr import Counts, SnrResult, elements, observers

Arrays = dict[str, NDArray[Any]]


def packed_detection(tally: Tally, samples: Sequence[TailSamples | None]) -> Arrays:
    """One shard of a detection as arrays."""
    shard = _sparse("counts", tally.counts)
    shard["sums"] = np.array([[str(value) for value in row] for row in tally.sums])
    shard["n"] = np.array(tally.n)
    for number, far in enumerate(tally.far):
        beyond = far.frozen()
        if beyond.n or beyond.undefined:
            shard |= _spread(f"far-{number}", beyond.keys, beyond.counts)
            shard[f"far-{number}-sums"] = np.array([str(x) for x in (beyond.first, beyond.second, beyond.undefined)])
    for number, kept in enumerate(samples):
        if kept is not None:
            shard[f"values-{number}"], shard[f"realisations-{number}"] = kept.values, kept.realisations
    return shard


def packed_snr(counts: Counts) -> Arrays:
    """One shard of an S/N as arrays."""
    shard = _sparse("pixel", counts.pixel) | _sparse("element", counts.element)
    for name, far in counts.far.items():
        shard |= _spread(f"far-{name}", far.keys, far.counts)
    return shard | {"clipped": counts.clipped, "n": np.array(counts.n)}


class DetectionSums:
    """What has come of a detection so far."""

    def __init__(self, request: DetectRequest) -> None:
        self._request = request
        self._sums = [(Tally(plan.grids), plan.tails()) for plan, _ in request.plans]

    def add(self, part: int, shard: Arrays) -> None:
        """Add a shard of one part."""
        tally, samples = self._sums[part]
        sums = np.array([[int(value) for value in row] for row in shard["sums"]], object)
        tally.add(_dense("counts", shard, tally.counts.shape), sums, int(shard["n"]))
        for number, far in enumerate(tally.far):
            if f"far-{number}" in shard:
                first, second, undefined = (int(value) for value in shard[f"far-{number}-sums"])
                far.merge(FarCounts(*_gathered(f"far-{number}", shard), first, second, undefined))
        for number, kept in enumerate(samples):
            if kept is not None:
                kept.merge(shard[f"values-{number}"], shard[f"realisations-{number}"])

    def answer(self) -> Detection:
        """The answer, once all shards have come."""
        asked = self._request
        detection = Detection.of(asked.hypotheses, asked.realisations, asked.tails, asked.seed)
        for (plan, _), (tally, samples) in zip(asked.plans, self._sums, strict=True):
            detection.collect(plan, tally, samples)
        return detection


class SnrSums:
    """What has come of an S/N so far."""

    def __init__(self, request: SnrRequest) -> None:
        self._request, self._elements = request, elements(request.expectation)
        self._counts = Counts(request.scene.n_pixel, len(self._elements))

    def add(self, part: int, shard: Arrays) -> None:
        """Add a shard."""
        counts = self._counts
        pixel, element = _dense("pixel", shard, counts.pixel.shape), _dense("element", shard, counts.element.shape)
        counts.add(pixel, element, shard["clipped"], int(shard["n"]))
        for name, far in counts.far.items():
            far.add(*_gathered(f"far-{name}", shard))

    def answer(self) -> SnrResult:
        """The answer, once all shards have come."""
        x, scene = self._request.expectation, self._request.scene
        return SnrResult(x, scene, observers(x, scene), self._elements, self._counts)


def _sparse(name: str, counts: NDArray[np.int64]) -> Arrays:
    """Steps from one bin that is not empty to the next, and what these hold, in as few bytes as they need."""
    where = np.flatnonzero(counts)
    return _spread(name, where, counts.ravel()[where])


def _spread(name: str, keys: NDArray[np.int64], counts: NDArray[np.int64]) -> Arrays:
    """Counts of rising keys, of which only the first may be negative."""
    steps = np.diff(keys)
    return {f"{name}-first": keys[:1], f"{name}-steps": _narrow(steps), name: _narrow(counts)}


def _gathered(name: str, shard: Arrays) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys and counts."""
    first = shard[f"{name}-first"]
    keys = np.cumsum(np.concatenate([first, shard[f"{name}-steps"].astype(np.int64)]), dtype=np.int64)
    return keys, shard[name].astype(np.int64)


def _narrow(values: NDArray[np.int64]) -> NDArray[np.unsignedinteger]:
    return values.astype(np.min_scalar_type(int(values.max(initial=0))))


def _dense(name: str, shard: Arrays, shape: tuple[int, ...]) -> NDArray[np.int64]:
    counts = np.zeros(int(np.prod(shape)), np.int64)
    keys, values = _gathered(name, shard)
    counts[keys] = values
    return counts.reshape(shape)
