"""Folders of a server for its visitors' files, which end with it, or with the next server if it was killed."""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import IO

PREFIX = "mauvecl-page-"
#: File that a running server holds locked.
LOCK = "in-use"


@cache
def _own() -> tuple[Path, IO[bytes]]:
    """Make the folder of this server, with its lock, which the system releases however the server ends."""
    folder = Path(tempfile.mkdtemp(prefix=PREFIX))
    lock = (folder / LOCK).open("wb")
    _locked(lock)
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder, lock


def visitor_folder() -> tempfile.TemporaryDirectory[str]:
    """Make a folder for a visitor in that of this server."""
    return tempfile.TemporaryDirectory(dir=_own()[0])


def content_folder(folder: Path, content: bytes, fill: Callable[[Path], object]) -> Path:
    """Return the subfolder for some content, named after its digest; the first call fills it."""
    home = folder / hashlib.sha256(content).hexdigest()
    if not home.exists():
        new = Path(tempfile.mkdtemp(dir=folder))
        fill(new)
        # Another thread may have been faster; the visitor's folder is removed as a whole.
        with contextlib.suppress(OSError):
            new.rename(home)
    return home


def remove_abandoned() -> None:
    """Remove the folders of servers that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        # Those of other users cannot be opened; one without a lock is being made, or of an older version.
        with contextlib.suppress(OSError), (folder / LOCK).open("r+b") as lock:
            if _locked(lock):
                shutil.rmtree(folder, ignore_errors=True)


def _locked(file: IO[bytes]) -> bool:
    """Lock a file; return False if a running server holds it, or the file system has no locks."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
