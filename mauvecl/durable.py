"""Files that are whole or not there, writers that are alone, and what differs between two studies."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mauvecl.host.errors import InputError

#: Files beside their place carry this in front of their name until they are whole.
UNFINISHED = ".unfinished-"


def write_whole(path: Path, *parts: bytes | memoryview) -> None:
    """Write a file beside its place, bring it to the disk, and rename it.

    Raises
    ------
    InputError
        If it cannot be written; what was at its place is still there.
    """
    beside = path.with_name(f"{UNFINISHED}{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("wb", buffering=0) as file:
            for part in parts:
                left = memoryview(part).cast("B")
                while left:
                    left = left[file.write(left) :]
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        raise InputError(
            f"{str(path)!r} cannot be written ({error.strerror}), expected a writable disk with room; what was written "
            "before is kept"
        ) from error


@contextlib.contextmanager
def alone(folder: Path, what: str) -> Iterator[None]:
    """Hold a folder for this process; the operating system lets go of it whatever becomes of the process.

    Raises
    ------
    InputError
        If another process holds it, or the file system has no locks.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise InputError(f"{what} {str(folder)!r} cannot be opened ({error.strerror}), expected a folder") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"{what} {str(folder)!r} is being written by another process, expected only one"
            ) from error
        except OSError as error:
            raise InputError(
                f"{what} {str(folder)!r} cannot be locked ({error.strerror}), expected a file system with locks"
            ) from error
        yield
    finally:
        os.close(handle)


def differing_keys(ours: Any, theirs: Any) -> list[str]:
    """Dotted keys at which two nested data differ."""
    mine, other = dict(_flat(ours)), dict(_flat(theirs))
    missing = object()
    return sorted(key for key in mine.keys() | other.keys() if mine.get(key, missing) != other.get(key, missing))


def _flat(data: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list | tuple) else None
    if items is None:
        yield path, data
        return
    for key, value in items:
        yield from _flat(value, f"{path}.{key}" if path else str(key))
