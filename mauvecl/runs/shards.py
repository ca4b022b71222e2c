"""Requests cut into shards, whatever counts them, and the fingerprints that shards are kept under."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.results.requests.requests import Countable, Divisible, Shard

#: What a shard holds, and how: raised with every change, so that none of an older form is ever added.
FORM = 2
#: Realisations times pixels times scenarios of one shard, about: some seconds of a processor's work.
SHARD = 2**34
#: Shards of one part of a request, about, at most: larger requests have larger shards, so that one process can add up
#: what a thousand count.
MOST = 2**13


def shards(request: Divisible) -> list[Shard]:
    """All shards of a request: cut at multiples of a power of two, whatever counts them."""
    wanted = max(SHARD // request.work, request.realisations // MOST)
    size = 1 << (max(wanted, request.least).bit_length() - 1)
    first, end = request.start, request.start + request.realisations
    cuts = [first, *range(first - first % size + size, end, size), end]
    return [Shard(part, a, b - a) for part in range(request.parts) for a, b in itertools.pairwise(cuts)]


@dataclass(frozen=True, eq=False)
class Task:
    """A shard to be counted.

    Attributes
    ----------
    request : Countable
    key : str
        The request's fingerprint.
    shard : Shard
    tick : callable
        Told how many realisations are done of it, where a worker can.
    out : ndarray, optional
        Where raw spectra go that a worker of this process draws.
    """

    request: Countable
    key: str
    shard: Shard
    tick: Callable[[int], None] = lambda done: None
    out: NDArray[Any] | None = None

    @property
    def name(self) -> str:
        """What it is kept under."""
        return f"{self.key}-{self.shard.name}"


#: What describes an input and does not change a draw.
_TOLD = ("provenance", "messages")


def fingerprint(request: Countable) -> str:
    """Sha256 of everything in a request that its answer depends on, to the last bit.

    Realisations are left out: the same shards are counted of more of them.
    """
    digest = hashlib.sha256(f"form {FORM}".encode())
    _feed(digest, request, leave=("realisations", "start", "tails"))
    return digest.hexdigest()[:32]


def _feed(digest: Any, value: Any, leave: tuple[str, ...] = ()) -> None:
    if is_dataclass(value) and not isinstance(value, type):
        digest.update(f"<{type(value).__name__}".encode())
        for each in fields(value):
            if each.name not in (*leave, *_TOLD):
                digest.update(each.name.encode())
                _feed(digest, getattr(value, each.name))
    elif isinstance(value, np.ndarray):
        digest.update(f"<{value.dtype.str}{value.shape}".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif isinstance(value, Mapping):
        for key in sorted(value):
            digest.update(str(key).encode())
            _feed(digest, value[key])
    elif isinstance(value, list | tuple):
        digest.update(f"<{len(value)}".encode())
        for one in value:
            _feed(digest, one)
    elif isinstance(value, float):
        digest.update(value.hex().encode())
    else:
        # None, whole numbers, words.
        digest.update(repr(value).encode())
