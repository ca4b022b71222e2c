"""Cache of compiled kernels, verified before PoCL reads them.

PoCL aborts the process on a damaged cache entry and finds no device if its cache folder cannot be created. It is
therefore given a working folder of this process alone. A store next to it keeps each program's files with their
digests and restores only files that match. If the store is damaged, full or read-only, kernels are built again.
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

from mauvecl.host.files.size_limits import read_bytes
from mauvecl.host.version import VERSION

#: Free space that PoCL needs to build the kernels of a session, bytes.
MIN_FREE_BYTES = 64 * 2**20
#: Largest size of the store in bytes; the least recently used programs are removed.
MAX_STORED = 128 * 2**20
#: Name prefix of working folders, name of the lock in each, and prefix of folders that are being created.
WORK, LOCK, MAKING = "mauvecl-work-", "lock", ".mauvecl-making-"
#: Random identifier of each boot, shared by all containers of a host (Linux, admin-guide/sysctl/kernel.rst).
BOOT = Path("/proc/sys/kernel/random/boot_id")
#: Age after which a folder of another host, whose locks may be invisible here, counts as abandoned.
ABANDONED_S = 30 * 86400.0


class KernelCache:
    """Working folder of a process and the store that outlives it.

    Attributes
    ----------
    work : Path
        PoCL's cache folder.
    pid : int
        Process that owns the working folder.
    store : Path
        Folder with one subfolder per program, named by its key, with a manifest of digests; need not exist.
    """

    def __init__(self, base: Path | None, work: Path) -> None:
        self.work = work
        self.pid = os.getpid()
        # The age of this file shows other hosts whether the folder is in use.
        self._lock = work / LOCK
        self.store = (base or work) / "store"
        self._folders: dict[str, str] = {}
        self._published: dict[str, int] = {}
        self._grown = False

    def restore(self, key: str) -> bool:
        """Copy a program's files to the working folder if all match their digests; return whether they do."""
        if key in self._folders:
            # The file of a loaded kernel must not be written again.
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
        """Record which of PoCL's folders belongs to the program built inside the block.

        Earlier programs are stored then instead of at exit, so that concurrent processes need not build them. PoCL
        completes a kernel only at its first launch: it links the kernel outside the folder and moves the result there.
        """
        with contextlib.suppress(OSError):
            os.utime(self._lock)
        before = set(self._programs())
        yield
        new = [folder for folder in self._programs() if folder not in before]
        if len(new) == 1:
            self._folders[key] = new[0]
        self._store_new()

    def _programs(self) -> Iterator[str]:
        for path in self.work.glob("*/*/program.bc"):
            yield path.parent.relative_to(self.work).as_posix()

    def get_or_write(self, key: str, make: Callable[[], str]) -> str:
        """Return a stored text, or make and store it."""
        text = self.read_text(key)
        if text is None:
            text = make()
            self.write_text(key, text)
        return text

    def read_text(self, key: str) -> str | None:
        """Return a stored text, or None if it is missing or damaged."""
        with contextlib.suppress(OSError, ValueError):
            digest, text = (self.store / f"{key}.txt").read_text(encoding="utf-8").split("\n", 1)
            if hashlib.sha256(text.encode()).hexdigest() == digest:
                return text
        return None

    def write_text(self, key: str, text: str) -> None:
        """Store a text with its digest; failures to write are ignored."""
        path = self.store / f"{key}.txt"
        self._grown = True
        with contextlib.suppress(OSError):
            self.store.mkdir(parents=True, exist_ok=True)
            new = path.with_name(f".{key}-{secrets.token_hex(8)}")
            new.write_text(f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}", encoding="utf-8")
            new.replace(path)

    def forget(self, prefix: str) -> int:
        """Remove stored texts whose keys begin with `prefix`, and return their number."""
        texts = list(self.store.glob(f"{prefix}*.txt"))
        for path in texts:
            path.unlink(missing_ok=True)
        return len(texts)

    def publish(self) -> None:
        """Store programs built since the last call, and limit the size of the store."""
        self._store_new()
        with contextlib.suppress(OSError):
            # Listing the store takes 0.1 s at the end of each run.
            if self._grown:
                self._prune()
                self._grown = False

    def _store_new(self) -> None:
        """Store programs built since the last call; failures to write are ignored."""
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
            # A reader finds the old folder, none, or the new one.
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
            if total > MAX_STORED:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()

    def close(self) -> None:
        """Publish and remove the working folder, except in a forked child."""
        if os.getpid() != self.pid:
            return
        self.publish()
        shutil.rmtree(self.work, ignore_errors=True)


@cache
def kernel_cache() -> KernelCache:
    """Return the cache of this process.

    It is in ``MAUVECL_CACHE_DIR`` or the user's cache folder, or in a temporary folder if that has too little space.
    Raises OSError if none of them is usable.
    """
    import platformdirs

    wanted = os.environ.get("MAUVECL_CACHE_DIR") or platformdirs.user_cache_dir("mauvecl")
    base = Path(wanted) / f"kernels-{VERSION}"
    for parent in (base, Path(tempfile.gettempdir()), Path("/dev/shm")):
        work = _working_folder(parent)
        if work is not None:
            break
    else:
        raise OSError(f"no folder for compiled kernels can be written to with {MIN_FREE_BYTES >> 20} MiB to spare")
    store = KernelCache(base if base.is_dir() and os.access(base, os.W_OK) else None, work)
    # PoCL's threads may still write when Python exits; a later process removes these files.
    atexit.register(store.close)
    return store


def _working_folder(parent: Path) -> Path | None:
    """Create a working folder under `parent`, or return None if that fails or the free space is too small.

    The name contains host and boot, since hosts may share a home. A lock marks the folder as in use, since process
    numbers are not unique across hosts and containers.
    """
    try:
        parent.mkdir(parents=True, exist_ok=True)
        _sweep(parent)
        if shutil.disk_usage(parent).free < MIN_FREE_BYTES:
            return None
        # The folder has a temporary name until it is locked, so that no other process finds it without a lock.
        making = Path(tempfile.mkdtemp(prefix=MAKING, dir=parent))
        (making / "probe").write_bytes(b"\0" * 4096)
        (making / "probe").unlink()
        handle = os.open(making / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        with contextlib.suppress(OSError):
            # On a file system without locks, age alone shows whether the folder is in use.
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # The handle is never closed: the operating system releases the lock when the process ends.
        return making.rename(parent / f"{WORK}{_here()}-{secrets.token_hex(8)}")
    except OSError:
        return None


def _here() -> str:
    """Return an identifier of this host and its last boot."""
    host = re.sub(r"[^A-Za-z0-9]", "", socket.gethostname())[:32]
    with contextlib.suppress(OSError):
        return f"{host}-{BOOT.read_text().strip().replace('-', '')}"
    return f"{host}-unknown"


def _sweep(parent: Path) -> None:
    """Remove folders of killed processes: those of this host if unlocked, those of other hosts if also old."""
    here = _here()
    for folder in [*parent.glob(f"{WORK}*"), *parent.glob(f"{MAKING}*")]:
        try:
            # Containers of a host share a kernel, which knows all locks, but may differ in host name.
            same = not here.endswith("unknown") and here.rpartition("-")[2] == folder.name.split("-")[-2]
            lock = folder / LOCK
            age = time.time() - (lock if lock.exists() else folder).stat().st_mtime
            if ((same and lock.exists()) or age > ABANDONED_S) and _is_free(lock):
                shutil.rmtree(folder, ignore_errors=True)
        except (OSError, IndexError):
            continue


def _is_free(lock: Path) -> bool:
    """Return whether no running process holds the lock, which need not exist."""
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
