"""Files that are whole or not there."""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path

from ..errors import InputError

#: Files beside their place carry this in front of their name until they are whole.
UNFINISHED = ".unfinished-"


def write_whole(path: Path, *parts: bytes | memoryview, shared: bool = False) -> None:
    """Write a file beside its place, bring it to the disk, and rename it.

    Parameters
    ----------
    path : Path
    parts : bytes or memoryview
        Its content.
    shared : bool
        Whether another process may write it at the same time: then the last one wins.

    Raises
    ------
    InputError
        If it cannot be written; what was at its place is still there.
    """
    tail = f".{os.getpid()}-{secrets.token_hex(4)}" if shared else ""
    beside = path.with_name(f"{UNFINISHED}{path.name}{tail}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("wb", buffering=0) as file:
            for part in parts:
                left = memoryview(part).cast("B")
                while left:
                    left = left[file.write(left) :]
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        raise InputError(
            f"{str(path)!r} cannot be written ({error.strerror}), expected a writable disk with room; what was written "
            "before is kept"
        ) from error
