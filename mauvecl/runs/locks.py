"""Locks on folders, and differences between studies."""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mauvecl.schema.errors import InputError


@contextlib.contextmanager
def locked(folder: Path, what: str) -> Iterator[None]:
    """Lock a folder for this process; the operating system releases the lock however the process ends.

    Raises InputError if another process holds the lock, or the file system has no locks.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except OSError as error:
        raise InputError(
            f"{what} {str(folder)!r} cannot be opened ({error.strerror})", "a folder", key="lock", value=str(folder)
        ) from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"{what} {str(folder)!r} is being written by another process", "only one", key="lock", value=str(folder)
            ) from error
        except OSError as error:
            raise InputError(
                f"{what} {str(folder)!r} cannot be locked ({error.strerror})",
                "a file system with locks",
                key="lock",
                value=str(folder),
            ) from error
        yield
    finally:
        os.close(handle)


def differing_keys(ours: Any, theirs: Any) -> list[str]:
    """Return the dotted keys at which two nested structures differ."""
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
