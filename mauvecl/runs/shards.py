"""Division of requests into shards, and fingerprints of requests."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from mauvecl.detection.requests import Countable, Divisible, Shard
from mauvecl.host.version import VERSION

#: Version of the content of a shard, raised with every change, so that shards of older versions are never added.
FORM = 2
#: Approximate work of a shard, realisations times pixels times scenarios: some seconds on a processor.
SHARD_WORK = 2**34
#: Approximate largest number of shards per part. Larger requests have larger shards, so that one process can add up
#: the counts of a thousand.
MAX_SHARDS = 2**13


def shards(request: Divisible) -> list[Shard]:
    """Divide a request into shards at multiples of a power of two, independently of the workers."""
    wanted = max(SHARD_WORK // request.work, request.realisations // MAX_SHARDS)
    size = 1 << (max(wanted, request.least).bit_length() - 1)
    first, end = request.start, request.start + request.realisations
    cuts = [first, *range(first - first % size + size, end, size), end]
    return [Shard(part, a, b - a) for part in range(request.parts) for a, b in itertools.pairwise(cuts)]


@dataclass(frozen=True, eq=False)
class Task:
    """A shard to count."""

    request: Countable
    key: str  # fingerprint of the request
    shard: Shard
    tick: Callable[[int], None] = lambda done: None  # called with the number of counted realisations, if possible
    out: NDArray[Any] | None = None  # array for raw spectra, if a worker of this process draws them

    @property
    def name(self) -> str:
        """Name in a checkpoint."""
        return f"{self.key}-{self.shard.name}"


#: Packages whose code affects the counts of a shard.
DRAWING_PACKAGES = ("device", "kernels", "lightcurve", "noise", "results", "statistics")


@cache
def code_identity() -> tuple[str, str]:
    """Return mauvecl's version, and a digest of the kernels and other code on which the counts of a shard depend."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for name in DRAWING_PACKAGES:
        for path in sorted((package / name).rglob("*")):
            if path.suffix in (".py", ".mako"):
                digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return VERSION, digest.hexdigest()[:16]


#: Fields that do not affect a draw.
_DESCRIPTIVE = ("provenance", "messages")


def fingerprint(request: object) -> str:
    """Return the SHA-256 of everything in a request, or in a tuple, that affects its answer.

    The number of realisations is excluded, since runs of different length share shards.
    """
    digest = hashlib.sha256(f"form {FORM}".encode())
    _feed(digest, request, leave=("realisations", "start", "tails"))
    return digest.hexdigest()[:32]


def _feed(digest: Any, value: Any, leave: tuple[str, ...] = ()) -> None:
    if is_dataclass(value) and not isinstance(value, type):
        digest.update(f"<{type(value).__name__}".encode())
        for each in fields(value):
            if each.name not in (*leave, *_DESCRIPTIVE):
                digest.update(each.name.encode())
                _feed(digest, getattr(value, each.name))
    elif isinstance(value, BaseModel):
        digest.update(f"<{type(value).__name__}".encode())
        for name in type(value).model_fields:
            digest.update(name.encode())
            _feed(digest, getattr(value, name))
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
        # None, integers, text.
        digest.update(repr(value).encode())
