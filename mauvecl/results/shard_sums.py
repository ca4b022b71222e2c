"""Packing of shards for transport and storage, and their exact sums."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.results.counts.sparse_counts import FarCounts
from mauvecl.results.counts.tally import TailSamples, Tally
from mauvecl.results.detection.detection import Detection
from mauvecl.results.requests.requests import DetectRequest, SnrRequest
from mauvecl.results.snr import Counts, SnrResult, elements, observers

Arrays = dict[str, NDArray[Any]]


def pack_detection(tally: Tally, samples: Sequence[TailSamples | None]) -> Arrays:
    """Pack a shard of a detection as arrays."""
    shard = _pack_counts("counts", tally.fine.keys, tally.fine.counts)
    shard["sums"] = np.array([[str(value) for value in row] for row in tally.sums])
    shard["n"] = np.array(tally.n)
    for number, far in enumerate(tally.far):
        beyond = far.frozen()
        if beyond.n or beyond.undefined:
            shard |= _pack_counts(f"far-{number}", beyond.keys, beyond.counts)
            shard[f"far-{number}-sums"] = np.array([str(x) for x in (beyond.first, beyond.second, beyond.undefined)])
    for number, kept in enumerate(samples):
        if kept is not None:
            shard[f"values-{number}"], shard[f"realisations-{number}"] = kept.values, kept.realisations
    return shard


def pack_snr(counts: Counts) -> Arrays:
    """Pack a shard of an S/N as arrays."""
    shard = _pack_array("pixel", counts.pixel) | _pack_array("element", counts.element)
    for name, far in counts.far.items():
        shard |= _pack_counts(f"far-{name}", far.keys, far.counts)
    return shard | {"clipped": counts.clipped, "n": np.array(counts.n)}


class DetectionSums:
    """Accumulator of the shards of a detection."""

    def __init__(self, request: DetectRequest) -> None:
        self._request = request
        self._sums = [(Tally(plan.grids), plan.tails()) for plan, _ in request.plans]

    def add(self, part: int, shard: Arrays) -> None:
        """Add a shard of one part."""
        tally, samples = self._sums[part]
        sums = np.array([[int(value) for value in row] for row in shard["sums"]], object)
        tally.merge(*_unpack_counts("counts", shard), sums, int(shard["n"]))
        for number, far in enumerate(tally.far):
            if f"far-{number}" in shard:
                first, second, undefined = (int(value) for value in shard[f"far-{number}-sums"])
                far.merge(FarCounts(*_unpack_counts(f"far-{number}", shard), first, second, undefined))
        for number, kept in enumerate(samples):
            if kept is not None:
                kept.merge(shard[f"values-{number}"], shard[f"realisations-{number}"])

    def answer(self) -> Detection:
        """Return the result, once all shards are added."""
        asked = self._request
        detection = Detection.of(asked.hypotheses, asked.realisations, asked.tails, asked.seed)
        for (plan, _), (tally, samples) in zip(asked.plans, self._sums, strict=True):
            detection.collect(plan, tally, samples)
        return detection


class SnrSums:
    """Accumulator of the shards of an S/N."""

    def __init__(self, request: SnrRequest) -> None:
        self._request, self._elements = request, elements(request.expectation)
        self._counts = Counts(request.scene.n_pixel, len(self._elements))

    def add(self, part: int, shard: Arrays) -> None:
        """Add a shard."""
        counts = self._counts
        pixel, element = (
            _unpack_array("pixel", shard, counts.pixel.shape),
            _unpack_array("element", shard, counts.element.shape),
        )
        counts.add(pixel, element, shard["clipped"], int(shard["n"]))
        for name, far in counts.far.items():
            far.add(*_unpack_counts(f"far-{name}", shard))

    def answer(self) -> SnrResult:
        """Return the result, once all shards are added."""
        x, scene = self._request.expectation, self._request.scene
        return SnrResult(x, scene, observers(x, scene), self._elements, self._counts)


def _pack_array(name: str, counts: NDArray[np.int64]) -> Arrays:
    """Pack the filled bins of an array."""
    where = np.flatnonzero(counts)
    return _pack_counts(name, where, counts.ravel()[where])


def _pack_counts(name: str, keys: NDArray[np.int64], counts: NDArray[np.int64]) -> Arrays:
    """Pack counts of ascending keys as differences of keys, in the smallest integer types."""
    steps = np.diff(keys)
    return {f"{name}-first": keys[:1], f"{name}-steps": _smallest_type(steps), name: _smallest_type(counts)}


def _unpack_counts(name: str, shard: Arrays) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Unpack keys and counts."""
    first = shard[f"{name}-first"]
    keys = np.cumsum(np.concatenate([first, shard[f"{name}-steps"].astype(np.int64)]), dtype=np.int64)
    return keys, shard[name].astype(np.int64)


def _smallest_type(values: NDArray[np.int64]) -> NDArray[np.unsignedinteger]:
    return values.astype(np.min_scalar_type(int(values.max(initial=0))))


def _unpack_array(name: str, shard: Arrays, shape: tuple[int, ...]) -> NDArray[np.int64]:
    counts = np.zeros(int(np.prod(shape)), np.int64)
    keys, values = _unpack_counts(name, shard)
    counts[keys] = values
    return counts.reshape(shape)
