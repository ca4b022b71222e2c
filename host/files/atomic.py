"""Atomic writing of files."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from mauvecl.schema.errors import InputError

#: Prefix of files that are being written.
UNFINISHED = ".unfinished-"


@contextlib.contextmanager
def writing(what: str, path: Path, expected: str, *, key: str) -> Iterator[None]:
    """Convert failures of the operating system in the block to an InputError that `what` cannot be written."""
    try:
        yield
    except OSError as error:
        fault = f"{what} cannot be written ({error.strerror or error})"
        raise InputError(fault, expected, key=key, value=str(path)) from error


def write_whole(path: Path, *parts: bytes | memoryview, shared: bool = False) -> None:
    """Write a file atomically: under a temporary name, flushed to the disk, then renamed.

    Parameters
    ----------
    parts : bytes or memoryview
        Content of the file.
    shared : bool
        Whether other processes may write the file at the same time; the last one wins.

    Raises InputError if the file cannot be written; an existing file is then kept.
    """
    tail = f".{os.getpid()}-{secrets.token_hex(4)}" if shared else ""
    unfinished = path.with_name(f"{UNFINISHED}{path.name}{tail}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished.open("wb", buffering=0) as file:
            for part in parts:
                left = memoryview(part).cast("B")
                while left:
                    left = left[file.write(left) :]
            os.fsync(file.fileno())
        unfinished.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        with writing(repr(str(path)), path, "a writable disk with room; what was written before is kept", key="file"):
            raise
