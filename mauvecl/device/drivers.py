"""Drivers of OpenCL: their folders, the processor for which they compile, their kernel cache, and first builds.

Folders. The wheel of Intel's runtime contains the driver's library, but its .icd file names a path of the machine on
which the wheel was built, and no loader searches the file's folder. The loader is therefore given a folder with a
correct .icd file in addition to those that it would have found. It finds the PoCL of pyopencl's wheels in any case.

Processors. The PoCL of wheels and distributions supports many processors. It loads the library of built-in functions
that suits the instructions of the processor, but before version 5 it compiles kernels for LLVM's name of the processor,
which need not match the library. LLVM 14 calls AMD's Zen 4 "znver3", which has no AVX-512, while PoCL loads the AVX-512
library: a build then takes minutes and gigabytes and ends in a segmentation fault. LLVM calls an unknown processor
"generic", which its compiler rejects for x86-64 (PoCL issue 1049). No setting changes the name. This module therefore
writes the highest level of the x86-64 psABI that fits processor and library into PoCL's record of the device in memory.
PoCL 5 and later, and Debian's 3.1, name the processor after the library; their record is not changed.

Kernel cache. PoCL aborts the process on a damaged cache entry and finds no device if its cache folder cannot be
created. It is therefore given a working folder of this process alone. A store next to it keeps each program's files
in an archive with checksums and restores only intact ones. If the store is damaged, full or read-only, kernels are
built again.

First builds. A driver's compiler may crash, hang or exhaust the memory, which would end the user's process without a
message. The first build for a device, driver and version of mauvecl therefore runs in a child process with limits of
time and memory, which draws a small scene and compares the counts with NumPy's. If it fails, the next lower level of
the processor is tried. The outcome is saved with the compiled kernels, so that later processes read one small file,
unless something else than the driver failed: a child that was killed, the linker, or memory.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import fcntl
import hashlib
import io
import itertools
import json
import os
import platform
import re
import resource
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import IO, Any, Literal
from zipfile import BadZipFile, ZipFile

from mauvecl.host import VERSION
from mauvecl.schema.errors import InputError

#: Sources by system and machine, as Python's `platform` spells them; "" is any other machine.
SOURCES = {
    ("Linux", "x86_64"): (
        "`pip install 'pyopencl[pocl]'` (PoCL, for processors)",
        "`pip install 'mauvecl[intel]'` (Intel's runtime, for processors)",
        "`apt-get install pocl-opencl-icd` (Debian, Ubuntu) or `dnf install pocl` (Fedora)",
        "`conda install -c conda-forge pyopencl pocl`",
        "the driver of your GPU's maker",
    ),
    ("Linux", ""): (
        "`apt-get install pocl-opencl-icd` (Debian, Ubuntu) or `dnf install pocl` (Fedora)",
        "`conda install -c conda-forge pyopencl pocl`",
        "the driver of your GPU's maker",
    ),
    ("Darwin", ""): (
        "`conda install -c conda-forge pyopencl pocl`",
        "the OpenCL that macOS brings, with pip's pyopencl",
    ),
    ("Windows", ""): ("Linux on Windows (`wsl --install`), since mauvecl needs Linux or macOS",),
    ("", ""): ("`conda install -c conda-forge pyopencl pocl`", "a driver for your device"),
}


def driver_sources(system: str | None = None, machine: str | None = None) -> str:
    """Return the sources of drivers for a machine, by default this one, as the end of a sentence."""
    system = platform.system() if system is None else system
    machine = platform.machine() if machine is None else machine
    sources = SOURCES.get((system, machine)) or SOURCES.get((system, "")) or SOURCES["", ""]
    return ", or ".join(sources)


#: Free space that PoCL needs to build the kernels of a session, bytes.
MIN_FREE_BYTES = 64 * 2**20
#: Largest size of the store in bytes; the least recently used programs are removed.
MAX_STORED = 128 * 2**20
#: Name prefix of working folders, name of the lock in each, and prefix of folders that are being created.
WORK, LOCK, MAKING = "mauvecl-work-", "lock", ".mauvecl-making-"
#: Age after which an unlocked folder counts as abandoned; the locks of other hosts that share a home may be invisible.
ABANDONED_S = 86400.0


class KernelCache:
    """Working folder of a process and the store that outlives it.

    Attributes
    ----------
    work : Path
        PoCL's cache folder.
    pid : int
        Process that owns the working folder.
    store : Path
        Folder with an archive of each program and with texts, by their keys; need not exist.
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
        """Copy a program's files to the working folder if they are intact; return whether they are."""
        if key in self._folders:
            # The file of a loaded kernel must not be written again.
            return True
        path = self.store / f"{key}.zip"
        try:
            with ZipFile(path) as archive:
                contents = {name: archive.read(name) for name in archive.namelist()}
            folder = "/".join(next(iter(contents)).split("/")[:2])
        except FileNotFoundError:
            return False
        except (OSError, ValueError, BadZipFile, NotImplementedError, RuntimeError, StopIteration, zlib.error):
            path.unlink(missing_ok=True)
            return False
        for name, content in contents.items():
            target = self.work / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
        with contextlib.suppress(OSError):
            os.utime(path)
        self._folders[key], self._published[key] = folder, len(contents)
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
        with contextlib.suppress(OSError):
            self._write(f"{key}.txt", f"{hashlib.sha256(text.encode()).hexdigest()}\n{text}".encode())

    def _write(self, name: str, content: bytes) -> None:
        """Write a file of the store; a reader finds the old one, none, or the new one."""
        self._grown = True
        self.store.mkdir(parents=True, exist_ok=True)
        new = self.store / f".{name}-{secrets.token_hex(8)}"
        try:
            new.write_bytes(content)
            new.replace(self.store / name)
        finally:
            new.unlink(missing_ok=True)

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
                    packed = io.BytesIO()
                    with ZipFile(packed, "w") as archive:
                        for path in files:
                            archive.writestr(path.relative_to(self.work).as_posix(), path.read_bytes())
                    self._write(f"{key}.zip", packed.getvalue())
                    self._published[key] = len(files)

    def _prune(self) -> None:
        total = 0
        for path in sorted(self.store.iterdir(), key=lambda p: p.stat().st_mtime, reverse=True):
            total += path.stat().st_size
            if total > MAX_STORED:
                path.unlink()

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

    A lock marks the folder as in use, since process numbers are not unique across hosts and containers.
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
        return making.rename(parent / f"{WORK}{secrets.token_hex(8)}")
    except OSError:
        return None


def _sweep(parent: Path) -> None:
    """Remove folders of killed processes."""
    for folder in [*parent.glob(f"{WORK}*"), *parent.glob(f"{MAKING}*")]:
        with contextlib.suppress(OSError):
            lock = folder / LOCK
            age = time.time() - (lock if lock.exists() else folder).stat().st_mtime
            if age > ABANDONED_S and _is_free(lock):
                shutil.rmtree(folder, ignore_errors=True)


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


#: Processor names, lowest first, and the instructions that each adds, as /proc/cpuinfo spells them. "sandybridge"
#: denotes processors with AVX but without AVX2, for which PoCL has a library but the psABI has no level.
LEVELS = {
    "x86-64": (),
    "x86-64-v2": ("cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"),
    "sandybridge": ("avx", "xsave"),
    "x86-64-v3": ("avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"),
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
}
#: Bits of the registers in which each level passes vectors. They must agree with those of the library, which PoCL
#: chooses by the processor: kernels for x86-64-v3 with the library for AVX-512 are not built within ten minutes.
WIDTHS = {"x86-64": 128, "x86-64-v2": 128, "sandybridge": 256, "x86-64-v3": 256, "x86-64-v4": 512}
#: LLVM's name of an unknown processor.
UNKNOWN = "generic"
#: Part of the version of a PoCL that chooses among libraries.
CHOOSES_LIBRARY = "DISTRO"
#: End of a device's version: driver, target triple, processor.
TARGET = re.compile(r"HSTR: \w+-(x86_64-\w+-\w+-\w+)-([\w-]+)$")
#: Bytes of a device's record that are searched, out of about 2500.
RECORD_BYTES = 2048

#: Names that must stay in memory, since PoCL has pointers to them.
_names: dict[str, Any] = {}


def levels(flags: frozenset[str]) -> tuple[str, ...]:
    """Return the names that a processor with these flags can run with the library that PoCL loads, highest first."""
    fitting = tuple(itertools.takewhile(lambda name: flags.issuperset(LEVELS[name]), LEVELS))[::-1]
    return tuple(name for name in fitting if WIDTHS[name] == WIDTHS[fitting[0]])


@cache
def flags() -> frozenset[str]:
    """Return the instruction sets of this machine's first processor; empty if unknown."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines():
            name, _, words = line.partition(":")
            if name.strip() == "flags":
                return frozenset(words.split())
    return frozenset()


def target(device: Any) -> tuple[str, str] | None:
    """Return the triple and processor name for which PoCL compiles, or None if they need no change."""
    match = TARGET.search(str(device.version))
    if match is None or not (CHOOSES_LIBRARY in str(device.platform.version) or match[2] == UNKNOWN):
        return None
    return match[1], match[2]


def names(device: Any) -> tuple[str | None, ...]:
    """Return the names to compile for, best first; ``(None,)`` leaves the choice to PoCL."""
    return levels(flags()) if flags() and _name_address(device) is not None else (None,)


def set_processor_name(device: Any, name: str) -> bool:
    """Make PoCL compile for a processor name known to LLVM; return False if the record's layout is unknown."""
    place = _name_address(device)
    if place is None:
        return False
    text = _names.setdefault(name, ctypes.create_string_buffer(name.encode()))
    ctypes.c_void_p.from_address(place).value = ctypes.addressof(text)
    return True


def _name_address(device: Any) -> int | None:
    """Return the address of the pointer to the processor's name in PoCL's record, or None if it is not found."""
    own_target = target(device)
    if own_target is None:
        return None
    triple, own = own_target
    record = int(device.int_ptr)
    try:
        memory = os.open("/proc/self/mem", os.O_RDONLY)
    except OSError:
        return None
    try:
        # The pointer to the triple precedes that to the name, except in versions that name the processor after the
        # library.
        pointers = [int.from_bytes(_bytes(memory, record + at, 8), "little") for at in range(0, RECORD_BYTES, 8)]
        for place, (first, second) in enumerate(itertools.pairwise(pointers), 1):
            if _text_at(memory, first) == triple and _text_at(memory, second) in (own, *_names):
                return record + 8 * place
    finally:
        os.close(memory)
    return None


def _bytes(memory: int, address: int, size: int) -> bytes:
    """Read memory of this process as a file, since a wrong address then returns nothing instead of a crash."""
    try:
        return os.pread(memory, size, address)
    except (OSError, OverflowError):
        return b""


def _text_at(memory: int, address: int) -> str:
    text, end, _ = _bytes(memory, address, 64).partition(b"\0")
    return text.decode("ascii", errors="replace") if end else ""


#: Name of the wheel and of its driver's library.
WHEEL, DRIVER = "intel-opencl-rt", "libintelocl.so"
#: Variables that name the loader's folder, in order of precedence, and the default folder.
FOLDER_VARIABLES, DEFAULT_FOLDER = ("OCL_ICD_VENDORS", "OPENCL_VENDOR_PATH"), "/etc/OpenCL/vendors"


@contextlib.contextmanager
def show_intel_runtime() -> Iterator[None]:
    """Make Intel's runtime visible to an OpenCL loader that starts inside the block."""
    folder = None if os.environ.get(FOLDER_VARIABLES[0]) else _folder()
    if folder is None:
        yield
        return
    os.environ[FOLDER_VARIABLES[0]] = str(folder)
    try:
        yield
    finally:
        # Child processes may outlive the folder.
        del os.environ[FOLDER_VARIABLES[0]]


@cache
def _folder() -> Path | None:
    """Make a folder of .icd files, Intel's among them, or return None if there is nothing to add."""
    library = _library()
    if library is None:
        return None
    system = os.environ.get(FOLDER_VARIABLES[1]) or DEFAULT_FOLDER
    folders = [system, os.path.join(sys.prefix, "etc", "OpenCL", "vendors")]
    files = {path.name: _text(path) for place in reversed(folders) for path in sorted(Path(place).glob("*.icd"))}
    drivers = {name: text for name, text in files.items() if DRIVER not in text or Path(text.strip()).exists()}
    if any(DRIVER in text for text in drivers.values()):
        # The system lists Intel's runtime already.
        return None
    folder = kernel_cache().work / "vendors"
    with contextlib.suppress(OSError):
        folder.mkdir(exist_ok=True)
        for name, text in (drivers | {"mauvecl-intel.icd": f"{library}\n"}).items():
            (folder / name).write_text(text, encoding="utf-8")
        return folder
    return None


def _library() -> Path | None:
    """Return the path of the wheel's library, or None if the wheel is not installed."""
    with contextlib.suppress(metadata.PackageNotFoundError):
        for file in metadata.files(WHEEL) or ():
            if file.name == DRIVER:
                path = Path(str(file.locate())).resolve()
                return path if path.exists() else None
    return None


def _text(path: Path) -> str:
    with contextlib.suppress(OSError, UnicodeError):
        return path.read_text(encoding="utf-8")
    return ""


#: Kinds of failures that callers may want to tell apart.
Kind = Literal["no device", "unknown device", "processor", "memory", "failed", "lost", ""]


class DeviceError(RuntimeError):
    """Failure of a device, a driver or a worker, with a one-sentence message.

    `kind` is "no device", "unknown device" (a wrong name), "processor" (unknown to the driver), "memory" (too little),
    "failed" (at some realisations, also in further tries), "lost" (the scheduler of a cluster), or empty for others.
    """

    def __init__(self, message: str, kind: Kind = "") -> None:
        super().__init__(message)
        self.kind = kind


class BuildError(DeviceError):
    """Failure to compile a kernel; the message contains the numbered source and the device's log."""


#: Variable that sets the child's limit of processor time, and its default in seconds; 0 builds without a child. The
#: child needs 3 s on a processor of 2024.
LIMIT, LIMIT_S = "MAUVECL_BUILD_LIMIT_S", 60.0
#: Wall-clock limit per second of the processor-time limit, since other programs may run.
CLOCK = 10.0
#: Limit of writable memory for a child on a CPU, which uses 300 MiB. GPU drivers reserve more than they use.
MEMORY = 4 * 2**30
#: Variables that limit the number of threads of old and new versions of PoCL.
THREADS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")
#: A failure may have a temporary cause and is discarded after a day.
OUTCOME_LIFETIME_S = 86400.0
#: Beginning of the outcomes' names in the cache, and the command that forgets them.
OUTCOME_KEY, FORGET = "first-build-", "`mauvecl devices --forget`"
#: Exit codes of the child: the driver failed, or something else.
DRIVER_FAILED, OTHER_FAILED = 1, 3
#: Code of the child, which searches the same import path as its parent.
CHILD = (
    "import json, sys; request = json.loads(sys.argv[1]); sys.path[:] = request['path']; "
    "from mauvecl.device.selftest import child; child(request)"
)
#: CL_DEVICE_TYPE_CPU of the OpenCL specification.
CPU = 2
#: Signals that a process causes itself.
CRASHES = (signal.SIGSEGV, signal.SIGBUS, signal.SIGILL, signal.SIGFPE, signal.SIGABRT)
#: Messages with which compilers abort although the driver is not at fault, and what has failed.
OTHER_CAUSES = {
    "linker command failed": "the linker `ld` failed",
    "Final linking": "the linker `ld` failed",
    "bad_alloc": "ran out of memory",
    "out of memory": "ran out of memory",
    "MemoryError": "ran out of memory",
    "No space left": "the disk is full",
}

#: Processor name chosen for each device of this process.
settled: dict[int, str | None] = {}
_one_at_a_time = threading.Lock()


@dataclass(frozen=True)
class Failure:
    """Failed first build at a level."""

    #: Reason, as the end of a sentence about the attempt.
    why: str
    #: Whether the driver is at fault, so that it would fail again.
    by_driver: bool = True


@dataclass(frozen=True)
class Outcome:
    """Outcome of the first build for a device."""

    #: Processor names in the order of trial and why each failed; the last reason is empty after a success.
    tried: tuple[tuple[str | None, str], ...]
    time_s: float
    #: Whether only the driver is at fault for failures.
    by_driver: bool = True

    @property
    def current(self) -> bool:
        """True if the outcome is still valid."""
        return not any(why for _, why in self.tried) or 0 <= time.time() - self.time_s < OUTCOME_LIFETIME_S


def forget_outcomes() -> int:
    """Forget the outcomes of all first builds, so that drivers that failed are tried again; return their number."""
    return kernel_cache().forget(OUTCOME_KEY)


def choose_processor_level(device: Any, others: Callable[[], Sequence[Any]]) -> str | None:
    """Set the highest processor level at which the driver works, and return its name.

    Parameters
    ----------
    others : callable
        Function that returns all devices, including `device`, in the order in which another process finds them.

    Returns
    -------
    str or None
        None if the driver makes the choice.

    Raises
    ------
    DeviceError
        If the driver works at no level.
    """
    place = int(device.int_ptr)
    if place not in settled:
        with _one_at_a_time:
            if place not in settled:
                outcome = _outcome(device, names(device), others)
                name, reason = outcome.tried[-1]
                if reason:
                    raise DeviceError(_failure_message(device, outcome))
                if name is not None:
                    set_processor_name(device, name)
                settled[place] = name
    return settled[place]


def _outcome(device: Any, names: tuple[str | None, ...], others: Callable[[], Sequence[Any]]) -> Outcome:
    """Read the outcome of the first build, or run the build."""
    untried = Outcome(((names[0], ""),), time.time())
    limit_s = _limit_s()
    if limit_s == 0:
        return untried
    cache, key = kernel_cache(), _key(device, names)
    known = _read_outcome(key)
    if known is not None:
        return known
    number = next((i for i, other in enumerate(others()) if other.int_ptr == device.int_ptr), None)
    if number is None or not sys.executable:
        return untried
    with _locked():
        # Another process may have tried in the meantime.
        known = _read_outcome(key)
        if known is not None:
            return known
        tried: list[tuple[str | None, str]] = []
        by_driver = True
        for place, name in enumerate(names):
            try:
                failure = _try(name, number, device, limit_s)
            except InterruptedError:
                return untried
            tried.append((name, failure.why if failure else ""))
            if failure is None:
                break
            by_driver &= failure.by_driver
            if place + 1 < len(names):
                level = f" at level {name}" if name else ""
                warnings.warn(
                    f"The first build of kernels for {device.name.strip()}{level} {failure.why}. "
                    f"The next lower level, {names[place + 1]}, is tried.",
                    stacklevel=2,
                )
        outcome = Outcome(tuple(tried), time.time(), by_driver)
        if by_driver:
            cache.write_text(key, json.dumps(asdict(outcome)))
    return outcome


def _limit_s() -> float:
    said = os.environ.get(LIMIT, "")
    with contextlib.suppress(ValueError):
        if not said or 0 <= float(said) <= 86400:
            return float(said or LIMIT_S)
    raise InputError.of(LIMIT, said, "1 to 86400 seconds of processor time, or 0 for no limit")


def _key(device: Any, names: tuple[str | None, ...]) -> str:
    """Return the outcome's name in the cache, unique for version, driver, processor and installation."""
    about = (VERSION, device.platform.version, device.name, device.version, device.driver_version, sys.prefix)
    said = "\0".join((*map(str, about), *map(str, names), *sorted(flags())))
    return OUTCOME_KEY + hashlib.sha256(said.encode()).hexdigest()[:32]


def _read_outcome(key: str) -> Outcome | None:
    text = kernel_cache().read_text(key)
    if text is None:
        return None
    content = json.loads(text)
    outcome = Outcome(tuple((name, why) for name, why in content["tried"]), content["time_s"], content["by_driver"])
    return outcome if outcome.current else None


@contextlib.contextmanager
def _locked() -> Iterator[None]:
    """Hold a lock next to the cache, so that of processes started together only one builds."""
    handle = None
    with contextlib.suppress(OSError):
        handle = os.open(kernel_cache().store.parent / "first-build.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(handle, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if handle is not None:
            os.close(handle)


def _try(name: str | None, number: int, device: Any, limit_s: float) -> Failure | None:
    """Build in a child process and return why it failed, or None after a success.

    Raises InterruptedError if the child could not be started.
    """
    request = {
        "path": sys.path,
        "name": name,
        "number": number,
        "label": f"{device.platform.name.strip()}: {device.name.strip()}",
        "limit_s": limit_s,
        "memory": MEMORY if int(device.type) & CPU else None,
    }
    threads = {variable: os.environ.get(variable, "2") for variable in THREADS}
    before_s = _children_s()
    # Files instead of pipes, which a linker started by the child would keep open after the child's death.
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as log:
        try:
            child = subprocess.Popen(
                [sys.executable, "-c", CHILD, json.dumps(request)],
                env=os.environ | threads,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=log,
                # Ctrl-C must reach only the parent, which then ends the child.
                start_new_session=True,
            )
        except OSError as error:
            raise InterruptedError from error
        try:
            code = child.wait(CLOCK * limit_s)
        except subprocess.TimeoutExpired:
            return Failure(f"was not finished after {CLOCK * limit_s:g} s", by_driver=False)
        finally:
            # The child and the compilers and linkers that it has started.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        return _failure(code, _start(out), _start(log), limit_s, _children_s() - before_s)


def _start(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read(2**16).decode(errors="replace")


def _children_s() -> float:
    """Return the processor time of this process's children that have ended, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _failure(code: int, out: str, log: str, limit_s: float, used_s: float) -> Failure | None:
    """Return the failure of a child by its exit code, output, messages and processor time; None after a success."""
    if code == 0:
        return None
    # A compiler that handles SIGXCPU is killed at the hard limit.
    if -code == signal.SIGXCPU or (-code == signal.SIGKILL and used_s >= limit_s):
        return Failure(f"was not finished after {limit_s:g} s of processor time")
    cause = next((cause for words, cause in OTHER_CAUSES.items() if words in log), None)
    if cause is not None and -code not in (signal.SIGSEGV, signal.SIGBUS, signal.SIGILL, signal.SIGFPE):
        return Failure(f"failed ({cause})", by_driver=False)
    if code < 0:
        said = (signal.strsignal(-code) or f"signal {-code}").lower()
        if -code in CRASHES:
            return Failure(f"crashed ({said})")
        return Failure(f"was stopped from outside ({said}), as systems do when memory is short", by_driver=False)
    lines = out.splitlines()
    return Failure(f"failed ({lines[-1] if lines else 'without a message'})", by_driver=code == DRIVER_FAILED)


def _failure_message(device: Any, outcome: Outcome) -> str:
    """Return a message that names the processor, the driver, the attempts and the remedies."""
    tried = "; ".join(f"{'it' if name is None else f'level {name}'} {why}" for name, why in outcome.tried)
    driver = f"{device.platform.version.strip()}, driver {device.driver_version.strip()}"
    if not outcome.by_driver:
        return (
            f"the first build of kernels for {device.name.strip()} did not succeed ({tried}), expected enough memory "
            f"and time ({LIMIT} sets the limit) and a linker that works; the next run tries again ({driver})"
        )
    return (
        f"{driver}, cannot build kernels for the processor {device.name.strip()} ({tried}), expected another device "
        f"(`mauvecl devices` lists them) or driver: {driver_sources()}; {LIMIT} sets the limit, and mauvecl tries "
        f"again after a day or after {FORGET}"
    )
