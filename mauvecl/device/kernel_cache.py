"""Compiled kernels kept from run to run, checked before PoCL sees them.

PoCL ends the whole process on a damaged cache entry and finds no device where its folder cannot be made. So it works
in a folder of this process alone; a store beside it keeps each program's files with their digests, and gives back only
what still has them. A store that is damaged, full or unwritable costs a build, never a run.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

from mauvecl.host.files.bounded import read_bytes
from mauvecl.host.version import VERSION

#: What PoCL needs to build the kernels of a session, bytes.
ROOM = 64 * 2**20
#: The store's size; the programs used longest ago make room.
MOST_STORED = 128 * 2**20
#: Working folders, the lock in each, and folders that are becoming one.
WORK, LOCK, MAKING = "mauvecl-work-", "lock", ".mauvecl-making-"
#: Random for each boot, the same in every container of a host (Linux, Documentation/admin-guide/sysctl/kernel.rst).
BOOT = Path("/proc/sys/kernel/random/boot_id")
#: A folder of another host, whose locks may not be seen here, is left over when nothing was built in it for so long.
ABANDONED_S = 30 * 86400.0


class KernelCache:
    """One process's working folder and the store behind it.

    Attributes
    ----------
    work : Path
        PoCL's cache folder.
    pid : int
        The process that it belongs to.
    store : Path
        One folder per program, named by its key, with a manifest of digests; need not exist.
    """

    def __init__(self, base: Path | None, work: Path) -> None:
        self.work = work
        self.pid = os.getpid()
        # Age tells other hosts whether the folder is in use.
        self._lock = work / LOCK
        self.store = (base or work) / "store"
        self._folders: dict[str, str] = {}
        self._published: dict[str, int] = {}
        self._grown = False

    def restore(self, key: str) -> bool:
        """Bring a program's files back from the store, if all of them are as they were put there."""
        if key in self._folders:
            # Already in the working folder, and perhaps in use: a loaded kernel's file must not be written again.
            return True
        folder = self.store / key
        if not (folder / "manifest.json").exists():
            return False
        try:
            manifest = json.loads(read_bytes(folder / "manifest.json", "manifest"))
            there, contents = self.work / manifest["folder"], {}
            for name, digest in manifest["files"].items():
                contents[name] = read_bytes(folder / name, "kernel")
                if hashlib.sha256(contents[name]).hexdigest() != digest:
                    raise ValueError(name)
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            shutil.rmtree(folder, ignore_errors=True)
            return False
        for name, content in contents.items():
            target = there / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
        with contextlib.suppress(OSError):
            os.utime(folder)
        self._folders[key], self._published[key] = manifest["folder"], len(contents)
        return True

    @contextlib.contextmanager
    def building(self, key: str) -> Iterator[None]:
        """Learn which of PoCL's folders belongs to the program built inside the block.

        Those built before go into the store then, not only at the end, so that processes that run beside this one need
        not build them: PoCL finishes a kernel at its first launch, beside its folder, and moves it there when whole.
        """
        with contextlib.suppress(OSError):
            os.utime(self._lock)
        before = set(self._programs())
        yield
        new = [folder for folder in self._programs() if folder not in before]
        if len(new) == 1:
            self._folders[key] = new[0]
        self._keep()

    def _programs(self) -> Iterator[str]:
        for path in self.work.glob("*/*/program.bc"):
            yield path.parent.relative_to(self.work).as_posix()

    def remembered(self, key: str, make: Callable[[], str]) -> str:
        """A text kept under its own digest, or made and kept."""
        text = self.recall(key)
        if text is None:
            text = make()
            self.remember(key, text)
        return text

    def recall(self, key: str) -> str | None:
        """A text kept, or None where there is none or it is not what was put there."""
        with contextlib.suppress(OSError, ValueError):
            digest, text = (self.store / f"{key}.txt").read_text(encoding="utf-8").split("\n", 1)
            if hashlib.sha256(text.encode()).hexdigest() == digest:
                return text
        return None

    def remember(self, key: str, text: str) -> None:
        """Keep a text under its own digest; whatever prevents it is no fault of the run."""
        path = self.store / f"{key}.txt"
        self._grown = True
        with contextlib.suppress(OSError):
            self.store.mkdir(parents=True, exist_ok=True)
            new = path.with_name(f".{key}-{secrets.token_hex(8)}")
            new.write_text(f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}", encoding="utf-8")
            new.replace(path)

    def publish(self) -> None:
        """Put what was built since into the store, and keep that to its size."""
        self._keep()
        with contextlib.suppress(OSError):
            # Looking through the store takes a tenth of a second, at the end of each run.
            if self._grown:
                self._prune()
                self._grown = False

    def _keep(self) -> None:
        """Put what was built since into the store; whatever prevents it is no fault of the run."""
        for key, folder in self._folders.items():
            with contextlib.suppress(OSError):
                files = [
                    path for path in (self.work / folder).rglob("*") if path.suffix in (".bc", ".so") and path.is_file()
                ]
                if len(files) != self._published.get(key):
                    self._put(key, folder, files)
                    self._published[key] = len(files)

    def _put(self, key: str, folder: str, files: list[Path]) -> None:
        self._grown = True
        self.store.mkdir(parents=True, exist_ok=True)
        new = Path(tempfile.mkdtemp(prefix=".new-", dir=self.store))
        try:
            digests = {}
            for path in files:
                name = path.relative_to(self.work / folder).as_posix()
                content = path.read_bytes()
                (new / name).parent.mkdir(parents=True, exist_ok=True)
                (new / name).write_bytes(content)
                digests[name] = hashlib.sha256(content).hexdigest()
            (new / "manifest.json").write_text(json.dumps({"folder": folder, "files": digests}), encoding="utf-8")
            # A reader sees the old folder, none, or the new one.
            shutil.rmtree(self.store / key, ignore_errors=True)
            new.rename(self.store / key)
        finally:
            shutil.rmtree(new, ignore_errors=True)

    def _prune(self) -> None:
        kept = sorted(self.store.iterdir(), key=lambda p: p.stat().st_mtime, reverse=True)
        total = 0
        for entry in kept:
            files = entry.rglob("*") if entry.is_dir() else [entry]
            total += sum(path.stat().st_size for path in files if path.is_file())
            if total > MOST_STORED:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()

    def close(self) -> None:
        """Publish, and remove the working folder; a forked child leaves it to its parent."""
        if os.getpid() != self.pid:
            return
        self.publish()
        shutil.rmtree(self.work, ignore_errors=True)


@cache
def kernel_cache() -> KernelCache:
    """The process's cache, in ``MAUVECL_CACHE_DIR``, the user's cache folder, or a temporary one: the first with room.

    Raises
    ------
    OSError
        If none can be written to.
    """
    import platformdirs

    wanted = os.environ.get("MAUVECL_CACHE_DIR") or platformdirs.user_cache_dir("mauvecl")
    base = Path(wanted) / f"kernels-{VERSION}"
    for parent in (base, Path(tempfile.gettempdir()), Path("/dev/shm")):
        work = _working_folder(parent)
        if work is not None:
            break
    else:
        raise OSError(f"no folder for compiled kernels can be written to with {ROOM >> 20} MiB to spare")
    store = KernelCache(base if _writable(base) else None, work)
    # PoCL's own threads may still write when Python ends; what they leave is swept up by a later process.
    atexit.register(store.close)
    return store


def _writable(folder: Path) -> bool:
    return folder.is_dir() and os.access(folder, os.W_OK)


def _working_folder(parent: Path) -> Path | None:
    """A new folder of this process under `parent`, or None where it cannot be made or would not suffice.

    It is named by host and boot, since a home may be shared, and locked while the process lives: process numbers mean
    nothing on another host, nor in another container of this one.
    """
    try:
        parent.mkdir(parents=True, exist_ok=True)
        _sweep(parent)
        if shutil.disk_usage(parent).free < ROOM:
            return None
        # Under another name until it is locked, so that nobody finds it without a lock.
        making = Path(tempfile.mkdtemp(prefix=MAKING, dir=parent))
        (making / "probe").write_bytes(b"\0" * 4096)
        (making / "probe").unlink()
        handle = os.open(making / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        with contextlib.suppress(OSError):
            # A file system without locks leaves age alone to tell.
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # The handle is never closed: the operating system lets go of the lock when the process has ended.
        return making.rename(parent / f"{WORK}{_here()}-{secrets.token_hex(8)}")
    except OSError:
        return None


def _here() -> str:
    """This host since its last boot."""
    host = re.sub(r"[^A-Za-z0-9]", "", socket.gethostname())[:32]
    with contextlib.suppress(OSError):
        return f"{host}-{BOOT.read_text().strip().replace('-', '')}"
    return f"{host}-unknown"


def _sweep(parent: Path) -> None:
    """Remove what processes that were killed have left: here by its lock, elsewhere by its age too."""
    here = _here()
    for folder in [*parent.glob(f"{WORK}*"), *parent.glob(f"{MAKING}*")]:
        try:
            # Containers of one host have one kernel, which knows all locks, whatever they are called.
            same = not here.endswith("unknown") and here.rpartition("-")[2] == folder.name.split("-")[-2]
            lock = folder / LOCK
            age = time.time() - (lock if lock.exists() else folder).stat().st_mtime
            if ((same and lock.exists()) or age > ABANDONED_S) and _is_free(lock):
                shutil.rmtree(folder, ignore_errors=True)
        except (OSError, IndexError):
            continue


def _is_free(lock: Path) -> bool:
    """Whether no living process holds a lock; without a lock there is no holder."""
    try:
        handle = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(handle)
    return True
