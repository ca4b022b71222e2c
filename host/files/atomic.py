"""Write files whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path

from mauvecl.schema.errors import InputError

#: Prefix of files that are being written.
UNFINISHED = ".unfinished-"


def write_whole(path: Path, *parts: bytes | memoryview, shared: bool = False) -> None:
    """Write a file under a temporary name in its folder, flush it to the disk, and rename it.

    Parameters
    ----------
    path : Path
    parts : bytes or memoryview
        Its content.
    shared : bool
        Whether another process may write it at the same time; the last one wins.

    Raises InputError if it cannot be written; a file that was there before is kept.
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
            f"{str(path)!r} cannot be written ({error.strerror})",
            "a writable disk with room; what was written before is kept",
            key="file",
            value=str(path),
        ) from error
