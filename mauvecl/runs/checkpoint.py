"""Checkpoints of long runs: one immutable file per shard, from which an interrupted run continues.

A file is named by the request's fingerprint and the range of the shard. It is written atomically and ends with a
digest, which shows whether it is intact. Requests depend on the study and earlier results only, so a run that is
started again makes the same requests and finds the files.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import itertools
import json
import os
import re
import threading
import time
import tomllib
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from mauvecl.detection.requests import Shard, ShardedRequest
from mauvecl.host import VERSION
from mauvecl.host.arrays import Arrays
from mauvecl.host.tables.files import UNFINISHED, read_bytes, write_whole
from mauvecl.schema.errors import InputError


@contextlib.contextmanager
def locked(folder: Path, name: str) -> Iterator[None]:
    """Lock a folder for this process; the operating system releases the lock however the process ends."""
    with ExitStack() as stack:
        try:
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            stack.callback(os.close, handle)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            reason = f"cannot be locked ({error.strerror}): use a readable folder of a file system with locks"
            if isinstance(error, BlockingIOError):
                reason = "is being written by another process: wait until it ends"
            raise InputError(f"{name} {str(folder)!r} {reason}", key="lock") from error
        yield


def differing_keys(ours: Any, theirs: Any) -> list[str]:
    """Return the dotted keys at which two nested structures differ."""
    our_values, their_values = dict(_flat(ours)), dict(_flat(theirs))
    missing = object()
    keys = our_values.keys() | their_values.keys()
    return sorted(key for key in keys if our_values.get(key, missing) != their_values.get(key, missing))


def _flat(data: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list | tuple) else None
    if items is None:
        yield path, data
        return
    for key, value in items:
        yield from _flat(value, f"{path}.{key}" if path else str(key))


#: Version of the content of a shard, raised with every change, so that shards of older versions are never added.
FORM = 4
#: Approximate work of a shard, realisations times pixels times scenarios: some seconds on a processor.
SHARD_WORK = 2**34
#: Approximate largest number of shards per part. Larger requests have larger shards, so that one process can add up
#: the counts of a thousand.
MAX_SHARDS = 2**13


def shards(request: ShardedRequest) -> list[Shard]:
    """Divide a request into shards at multiples of a power of two, independently of the workers."""
    count = max(SHARD_WORK // request.work, request.realisations // MAX_SHARDS, request.least)
    size = 1 << (count.bit_length() - 1)
    first, end = request.start, request.start + request.realisations
    cuts = [first, *range(first - first % size + size, end, size), end]
    return [Shard(part, a, b - a) for part in range(request.parts) for a, b in itertools.pairwise(cuts)]


@dataclass(frozen=True, eq=False)
class Task:
    """A shard to count."""

    request: ShardedRequest
    key: str  # fingerprint of the request
    shard: Shard
    tick: Callable[[int], None] = lambda done: None  # called with the number of counted realisations, if possible
    out: NDArray[Any] | None = None  # array for raw spectra, if a worker of this process draws them

    @property
    def name(self) -> str:
        """Name in a checkpoint."""
        return f"{self.key}-{self.shard.name}"


class Stopped(Exception):  # noqa: N818
    """Raised between two tiles of a shard whose result is no longer needed."""


class ShardLost(Exception):  # noqa: N818
    """Raised by workers that could not count a shard, which the pool then submits again up to `MAX_FAILURES` times."""


#: Packages whose code affects the counts of a shard.
DRAWING_PACKAGES = ("detection", "device", "fits", "flares", "kernels", "noise", "search")


@cache
def code_identity() -> tuple[str, str]:
    """Return mauvecl's version, and a digest of the kernels and other code on which the counts of a shard depend."""
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for name in DRAWING_PACKAGES:
        for path in sorted((package / name).rglob("*")):
            if path.suffix in (".py", ".mako"):
                digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return VERSION, digest.hexdigest()[:16]


#: Fields that do not affect a draw, and those of a request that do not affect a shard.
_DESCRIPTIVE, _OF_RUN = ("provenance", "messages"), ("realisations", "start", "tails")


def fingerprint(request: object) -> str:
    """Return the SHA-256 of everything in a request, or in a tuple, that affects its answer.

    The number of realisations is excluded, since runs of different length share shards.
    """
    if not isinstance(request, tuple):
        kind, values = _json_content(request)
        request = kind, {name: value for name, value in values.items() if name not in _OF_RUN}
    text = json.dumps(request, default=_json_content, sort_keys=True)
    return hashlib.sha256(f"form {FORM} {text}".encode()).hexdigest()[:32]


def _json_content(value: Any) -> Any:
    """Return what JSON can hold of an object: its class and fields, the digest of an array, or its text."""
    if isinstance(value, np.ndarray):
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes())
        return value.dtype.str, value.shape, digest.hexdigest()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, BaseModel) or is_dataclass(value):
        names = [*type(value).model_fields] if isinstance(value, BaseModel) else [field.name for field in fields(value)]
        return type(value).__name__, {name: getattr(value, name) for name in names if name not in _DESCRIPTIVE}
    return repr(value)


FOLDER, MANIFEST = "checkpoint", "manifest.json"
#: Names of shards: fingerprint, part, start, count.
SHARD_NAME = re.compile(r"[0-9a-f]{32}-[0-9]+-[0-9]+-[0-9]+\.npz")
#: Time before the first shard is written, s, so that short runs write no files.
PATIENCE_S = 20.0
DIGEST_BYTES = 32


class Checkpoint:
    """Context manager of the shards of one run in its output folder, which exists.

    The study may be any object with a method `toml`. An unfinished run is continued if `resume` is true, and discarded
    if `restart` is. `held` states that the caller has locked the folder.
    """

    def __init__(
        self, folder: Path, verb: str, study: Any, *, resume: bool = False, restart: bool = False,
        patience_s: float = PATIENCE_S, held: bool = False,
    ) -> None:  # fmt: skip
        self.parent, self.folder, self.verb, self.study = folder, folder / FOLDER, verb, study
        self._resume, self._restart, self._patience_s, self._is_locked = resume, restart, patience_s, held
        self.damaged = 0  # number of unusable files
        self.messages: list[str] = []  # remarks for the user
        self._unwritten: list[tuple[str, Arrays]] = []
        self._lock = threading.Lock()

    def __enter__(self) -> Self:
        """Lock the output folder, and check that an unfinished run in it is to be resumed and is of this study."""
        with ExitStack() as stack:
            if not self._is_locked:
                stack.enter_context(locked(self.parent, "output folder"))
            self._check_files()
            self._stack = stack.pop_all()
        self._started, self._written = time.monotonic(), bool(self._files())
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # An exception of the block is more important than one of writing.
        with self._stack, contextlib.suppress(InputError):
            if kind is not None:
                # After an interruption or error, write pending shards unless the run was short.
                self._write()

    def _check_files(self) -> None:
        """Discard, continue or refuse an unfinished run in the folder."""
        if self._restart:
            self._remove()
        if not self._files():
            return
        if not self._resume:
            raise InputError(
                f"{str(self.folder)!r} holds an unfinished run: use `resume=True` to continue it or `restart=True` to "
                "discard it",
                key="resume",
            )
        manifest = _intact(self.folder / MANIFEST)
        if manifest is None:
            # Names of files include the fingerprint, so shards of another study are never used.
            self.messages.append(
                f"The manifest of {str(self.folder)!r} was damaged or missing and is written anew; the shards that "
                "belong to this study are used."
            )
            self._write_manifest()
            return
        differing = [key.removeprefix("study.") for key in differing_keys(self._manifest(), manifest)]
        if differing:
            raise InputError(
                f"the unfinished run in {str(self.folder)!r} differs in {', '.join(differing)}: use the same study, or "
                "`restart=True` to discard it",
                key="restart",
            )

    def get(self, name: str) -> Arrays | None:
        """Return a shard that was counted before, or None."""
        path = self.folder / f"{name}.npz"
        if not path.exists():
            return None
        try:
            data = read_bytes(path, "shard")
            body, digest = data[:-DIGEST_BYTES], data[-DIGEST_BYTES:]
            if _file_digest(name, body) != digest:
                raise ValueError
            with np.load(io.BytesIO(body)) as arrays:
                return dict(arrays)
        except (OSError, ValueError, KeyError, zipfile.BadZipFile):
            with self._lock:
                self.damaged += 1
            return None

    def put(self, name: str, shard: Arrays) -> None:
        """Keep a shard, and write it to disk once the run has lasted `patience_s`."""
        with self._lock:
            self._unwritten.append((name, shard))
            self._write()

    def _write(self) -> None:
        """Write the shards that are kept, once the run has lasted long enough for a checkpoint."""
        if not self._written and time.monotonic() - self._started < self._patience_s:
            return
        if not self._written and self._unwritten:
            self._write_manifest()
            self._written = True
        while self._unwritten:
            name, shard = self._unwritten[0]
            body = io.BytesIO()
            np.savez(body, **shard)  # type: ignore[arg-type]
            data = body.getvalue()
            write_whole(self.folder / f"{name}.npz", data, _file_digest(name, data))
            self._unwritten.pop(0)

    @property
    def kept(self) -> int:
        """Number of files of shards."""
        return sum(path.suffix == ".npz" for path in self._files())

    def forget(self) -> None:
        """Remove the checkpoint, which is no longer needed once the result is written."""
        self._unwritten = []
        self._remove()

    def _files(self) -> list[Path]:
        """Return the files in the folder that belong to a checkpoint, by name."""
        names = sorted(os.listdir(self.folder)) if self.folder.is_dir() else []
        names = [name for name in names if SHARD_NAME.fullmatch(name) or name == MANIFEST]
        if names == [MANIFEST] and _intact(self.folder / MANIFEST) is None:
            raise InputError(
                f"{str(self.folder / MANIFEST)!r} is not mauvecl's: use another output folder", key="folder"
            )
        return [self.folder / name for name in names]

    def _remove(self) -> None:
        """Remove the checkpoint's files, and the folder if it is then empty."""
        for path in [*self._files(), *self.folder.glob(f"{UNFINISHED}*")]:
            name = path.name.removeprefix(UNFINISHED)
            if name == MANIFEST or SHARD_NAME.fullmatch(name):
                path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self.folder.rmdir()

    def _manifest(self) -> dict[str, Any]:
        return {"mauvecl": VERSION, "form": FORM, "verb": self.verb, "study": tomllib.loads(self.study.toml())}

    def _write_manifest(self) -> None:
        manifest = self._manifest()
        text = json.dumps(manifest | {"digest": _manifest_digest(manifest)}, indent=2)
        write_whole(self.folder / MANIFEST, text.encode())


def checkpointed(checkpoint: Checkpoint | None, question: object, compute: Callable[[], Arrays]) -> Arrays:
    """Return the arrays of a computation, from the checkpoint if an earlier run has finished it.

    The question is everything on which the result depends, as for `fingerprint`.
    """
    if checkpoint is None:
        return compute()
    name = f"{fingerprint(question)}-0-0-1"
    arrays = checkpoint.get(name)
    if arrays is None:
        arrays = compute()
        checkpoint.put(name, arrays)
    return arrays


def _intact(manifest: Path) -> dict[str, Any] | None:
    """Return the content of a manifest without its digest, or None if it is not an intact one of a checkpoint."""
    try:
        content = json.loads(read_bytes(manifest, "manifest"))
        is_whole = content.pop("digest") == _manifest_digest(content) and isinstance(content["study"], dict)
        return dict(content) if is_whole else None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return None


def _file_digest(name: str, body: bytes) -> bytes:
    """Return the digest of a file and its name, which detects renamed files."""
    return hashlib.sha256(name.encode() + b"\0" + body).digest()


def _manifest_digest(manifest: Mapping[str, object]) -> str:
    """Return the digest of the content of a manifest."""
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
