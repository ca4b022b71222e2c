"""Drivers of OpenCL: their folders, the processor for which they compile, their kernel cache, and first builds.

Folders. The .icd file in the wheel of Intel's runtime names a path of the machine that built the wheel. The loader is
therefore given a folder with a correct .icd file next to those that it would have found.

Processors. PoCL before version 5 loads the library of built-in functions that suits the processor's instructions, but
compiles kernels for LLVM's name of the processor, which need not match the library. LLVM 14 calls AMD's Zen 4 "znver3",
which has no AVX-512: a build with the AVX-512 library takes minutes and gigabytes and ends in a segmentation fault. It
rejects "generic", its name of an unknown processor (PoCL issue 1049). No setting changes the name. This module writes
the highest level of the x86-64 psABI that fits processor and library into PoCL's record of the device in memory.
PoCL 5 and later, and Debian's 3.1, name the processor after the library; their record is not changed.

Kernel cache. PoCL aborts the process on a damaged cache entry and finds no device if its cache folder cannot be
created. It is therefore given a working folder of this process alone. A folder per version of mauvecl keeps each
program's files in an archive, whose checksums show damage. What is damaged or cannot be stored is built again.

First builds. A driver's compiler may crash, hang or exhaust the memory, which would end the user's process without a
message. The first build for a device, driver and version of mauvecl therefore runs in a child process with limits of
time and memory, which draws a small scene and compares the counts with NumPy's. If it fails, the next lower level of
the processor is tried. The level that works is saved with the compiled kernels, so that later processes read one small
file.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import hashlib
import io
import itertools
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
import zlib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import IO, Any, Literal
from zipfile import BadZipFile, ZipFile

from mauvecl.host import VERSION
from mauvecl.host.tables.files import write_whole
from mauvecl.schema.errors import InputError

_PACKAGE = "`apt-get install pocl-opencl-icd` (Debian, Ubuntu) or `dnf install pocl` (Fedora)"
_CONDA = "`conda install -c conda-forge pyopencl pocl`"
_MAKER = "the driver of your GPU's maker"
_WHEELS = (
    "`pip install 'pyopencl[pocl]'` (PoCL, for processors)",
    "`pip install 'mauvecl[intel]'` (Intel's runtime, for processors)",
)
#: Sources by system and machine, as Python's `platform` spells them; "" is any other machine.
SOURCES = {
    ("Linux", "x86_64"): (*_WHEELS, _PACKAGE, _CONDA, _MAKER),
    ("Linux", ""): (_PACKAGE, _CONDA, _MAKER),
    ("Darwin", ""): (_CONDA, "the OpenCL that macOS brings, with pip's pyopencl"),
    ("Windows", ""): ("Linux on Windows (`wsl --install`), since mauvecl needs Linux or macOS",),
    ("", ""): (_CONDA, "a driver for your device"),
}


def driver_sources(system: str | None = None) -> str:
    """Return the sources of drivers for a system, by default this one, as the end of a sentence."""
    system = platform.system() if system is None else system
    sources = SOURCES.get((system, platform.machine())) or SOURCES.get((system, "")) or SOURCES["", ""]
    return ", or ".join(sources)


#: Free space that PoCL needs to build the kernels of a session, bytes.
MIN_FREE_BYTES = 64 * 2**20
#: Largest size of the stored archives in bytes; the oldest are removed.
MAX_STORED = 128 * 2**20
#: Name prefix of working folders, and the age after which a folder was left by a killed process (assumed).
WORK, ABANDONED_S = "mauvecl-work-", 90 * 86400.0


class KernelCache:
    """Working folder of a process, and the archives that outlive it.

    `store` is the folder with an archive of each program and of each text, by their keys, which need not exist; `work`
    is PoCL's cache folder, which belongs to the process `pid`.
    """

    def __init__(self, store: Path, work: Path) -> None:
        self.store, self.work, self.pid = store, work, os.getpid()
        self._folders: dict[str, str] = {}
        self._stored: dict[str, int] = {}

    def read(self, key: str) -> dict[str, bytes]:
        """Return the contents of an archive by name; empty if it is missing or damaged."""
        try:
            with ZipFile(self.store / f"{key}.zip") as archive:
                return {name: archive.read(name) for name in archive.namelist()}
        except (OSError, ValueError, BadZipFile, NotImplementedError, RuntimeError, zlib.error):
            return {}

    def write(self, key: str, contents: Mapping[str, bytes]) -> None:
        """Write an archive, of which readers find the old state or the new; failures to write are ignored."""
        packed = io.BytesIO()
        with ZipFile(packed, "w") as archive:
            for name, content in contents.items():
                archive.writestr(name, content)
        with contextlib.suppress(InputError):
            write_whole(self.store / f"{key}.zip", packed.getbuffer(), shared=True)

    def read_text(self, key: str) -> str | None:
        """Return a stored text, or None."""
        text = self.read(key).get("text")
        return None if text is None else text.decode()

    def write_text(self, key: str, text: str) -> None:
        """Store a text."""
        self.write(key, {"text": text.encode()})

    def restore(self, key: str) -> bool:
        """Copy a program's files to the working folder if they are intact; return whether they are."""
        if key in self._folders:
            # The file of a loaded kernel must not be written again.
            return True
        contents = self.read(key)
        for name, content in contents.items():
            target = self.work / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content)
            self._folders[key] = "/".join(name.split("/")[:2])
        self._stored[key] = len(contents)
        return bool(contents)

    @contextlib.contextmanager
    def building(self, key: str) -> Iterator[None]:
        """Record which of PoCL's folders belongs to the program built inside the block.

        Earlier programs are stored then instead of at exit, so that concurrent processes need not build them. PoCL
        completes a kernel only at its first launch: it links the kernel outside the folder and moves the result there.
        """
        before = set(self.work.glob("*/*/program.bc"))
        yield
        new = [path.parent for path in self.work.glob("*/*/program.bc") if path not in before]
        if len(new) == 1:
            self._folders[key] = new[0].relative_to(self.work).as_posix()
        self.store_programs()

    def store_programs(self) -> None:
        """Store the programs that were built or completed since the last call, and remove the oldest of too many."""
        for key, folder in self._folders.items():
            files = [path for path in (self.work / folder).rglob("*") if path.suffix in (".bc", ".so")]
            if len(files) == self._stored.get(key):
                continue
            self.write(key, {path.relative_to(self.work).as_posix(): path.read_bytes() for path in files})
            self._stored[key] = len(files)
            total = 0
            with contextlib.suppress(OSError), os.scandir(self.store) as entries:
                # A full store has a thousand archives, and is read twice for each program.
                stored = ((entry.stat(), entry.path) for entry in entries)
                for status, path in sorted(stored, key=lambda pair: -pair[0].st_mtime):
                    total += status.st_size
                    if total > MAX_STORED:
                        os.unlink(path)

    def close(self) -> None:
        """Store programs and remove the working folder, except in a forked child."""
        if os.getpid() == self.pid:
            with contextlib.suppress(OSError):
                self.store_programs()
            shutil.rmtree(self.work, ignore_errors=True)


@cache
def kernel_cache() -> KernelCache:
    """Return the cache of this process.

    It is in ``MAUVECL_CACHE_DIR`` or the user's cache folder; working folders are in the folder of temporary files if
    that has too little space. Raises OSError if neither is usable.
    """
    import platformdirs

    folder = os.environ.get("MAUVECL_CACHE_DIR") or platformdirs.user_cache_dir("mauvecl")
    base = Path(folder) / f"kernels-{VERSION}"
    work = _working_folder(base) or _working_folder(Path(tempfile.gettempdir()))
    if work is None:
        raise OSError(f"no folder for compiled kernels can be written to with {MIN_FREE_BYTES >> 20} MiB to spare")
    store = KernelCache(base / "store", work)
    # PoCL's threads may still write when Python exits; a later process removes these files.
    atexit.register(store.close)
    return store


def _working_folder(parent: Path) -> Path | None:
    """Create a working folder under `parent`, or return None if that fails or the free space is too small."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        for folder in parent.glob(f"{WORK}*"):
            # Other processes remove their folders at the same time.
            with contextlib.suppress(OSError):
                if time.time() - folder.stat().st_mtime > ABANDONED_S:
                    shutil.rmtree(folder, ignore_errors=True)
        if shutil.disk_usage(parent).free < MIN_FREE_BYTES:
            return None
        return Path(tempfile.mkdtemp(prefix=WORK, dir=parent))
    except OSError:
        return None


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
    """Return the address of the pointer to the processor's name in PoCL's record.

    None if the name needs no change, or is not found.
    """
    match = TARGET.search(str(device.version))
    if match is None or not (CHOOSES_LIBRARY in str(device.platform.version) or match[2] == UNKNOWN):
        return None
    (triple, name), record = match.groups(), int(device.int_ptr)
    try:
        memory = os.open("/proc/self/mem", os.O_RDONLY)
    except OSError:
        return None
    try:
        # The pointer to the triple precedes that to the name, except in versions that name the processor after the
        # library.
        pointers = [int.from_bytes(_bytes(memory, record + at, 8), "little") for at in range(0, RECORD_BYTES, 8)]
        for place, (first, second) in enumerate(itertools.pairwise(pointers), 1):
            if _text_at(memory, first) == triple and _text_at(memory, second) in (name, *_names):
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
    """Return the text that begins at an address, empty if it does not end within 64 bytes."""
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
    try:
        file = next(file for file in metadata.files(WHEEL) or () if file.name == DRIVER)
        library = Path(str(file.locate())).resolve(strict=True)
    except (metadata.PackageNotFoundError, StopIteration, OSError):
        return None
    system = os.environ.get(FOLDER_VARIABLES[1]) or DEFAULT_FOLDER
    folders = [system, os.path.join(sys.prefix, "etc", "OpenCL", "vendors")]
    files = {}
    for path in (path for place in reversed(folders) for path in sorted(Path(place).glob("*.icd"))):
        with contextlib.suppress(OSError, UnicodeError):
            files[path.name] = path.read_text(encoding="utf-8")
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


#: Kinds of failures that callers may want to tell apart.
Kind = Literal["no device", "unknown device", "processor", "kernel", "memory", "failed", "lost", ""]


class DeviceError(RuntimeError):
    """Failure of a device, a driver or a worker, with a one-sentence message.

    `kind` is "no device", "unknown device" (a wrong name), "processor" (unknown to the driver), "kernel" (not compiled:
    the message has its source and the device's log), "memory" (too little), "failed" (at some realisations, also in
    further tries), "lost" (the scheduler of a cluster), or empty for others.
    """

    def __init__(self, message: str, kind: Kind = "") -> None:
        super().__init__(message)
        self.kind = kind


#: Variable that sets the child's limit of processor time, and its default in seconds; 0 builds without a child. The
#: child needs 3 s on a processor of 2024.
LIMIT, LIMIT_S = "MAUVECL_BUILD_LIMIT_S", 60.0
#: Wall-clock limit per second of the processor-time limit, since other programs may run.
CLOCK = 10.0
#: Limit of writable memory for a child on a CPU, which uses 300 MiB. GPU drivers reserve more than they use.
MEMORY = 4 * 2**30
#: Variables that limit the number of threads of old and new versions of PoCL.
THREADS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")
#: Code of the child, which searches the same import path as its parent.
CHILD = (
    "import json, sys; request = json.loads(sys.argv[1]); sys.path[:] = request['path']; "
    "from mauvecl.device.selftest import child; child(request)"
)
#: CL_DEVICE_TYPE_CPU of the OpenCL specification.
CPU = 2
#: Processor name chosen for each device of this process.
settled: dict[int, str | None] = {}
_one_at_a_time = threading.Lock()


def choose_processor_level(device: Any, number: int | None) -> str | None:
    """Set the highest processor level at which the driver works, and return its name; None if the driver chooses.

    `number` is that of the device in another process, or None if it has none. Raises DeviceError if the driver works at
    no level.
    """
    place = int(device.int_ptr)
    with _one_at_a_time:
        if place not in settled:
            name = _working_level(device, names(device), number)
            if name is not None:
                set_processor_name(device, name)
            settled[place] = name
    return settled[place]


def _working_level(device: Any, names: tuple[str | None, ...], number: int | None) -> str | None:
    """Return the level that an earlier process has found, or try levels until a first build succeeds."""
    setting = os.environ.get(LIMIT, "")
    try:
        limit_s = float(setting or LIMIT_S)
    except ValueError:
        limit_s = -1.0
    if not 0 <= limit_s <= 86400:
        raise InputError.of(LIMIT, setting, "between 1 and 86400 seconds of processor time, or 0 for no limit")
    if limit_s == 0 or number is None or not sys.executable:
        return names[0]
    # The level's key in the cache is unique for driver, processor and installation.
    target = (device.platform.version, device.name, device.version, device.driver_version, sys.prefix)
    unique = "\0".join((*map(str, target), *map(str, names), *sorted(flags())))
    cache, key = kernel_cache(), f"level-{hashlib.sha256(unique.encode()).hexdigest()[:32]}"
    level = cache.read_text(key)
    if level is not None:
        return level or None
    failed: list[str] = []
    for name in names:
        why = _try(name, number, device, limit_s)
        if why is None:
            cache.write_text(key, name or "")
            if failed:
                warnings.warn(
                    f"The first build of kernels for {device.name.strip()} failed ({'; '.join(failed)}). The next "
                    f"lower level, {name}, is used.",
                    stacklevel=2,
                )
            return name
        failed.append(f"{'it' if name is None else f'level {name}'} {why}")
    raise DeviceError(
        f"{device.platform.version.strip()}, driver {device.driver_version.strip()}, cannot build kernels for the "
        f"processor {device.name.strip()} ({'; '.join(failed)}); it needs enough memory, a linker that works, another "
        f"device (`mauvecl devices` lists them) or another driver: {driver_sources()}; {LIMIT} sets the limit of time"
    )


def _try(name: str | None, number: int, device: Any, limit_s: float) -> str | None:
    """Build in a child process; return why it failed, as the end of a sentence, or None after a success."""
    request = {
        "path": sys.path,
        "name": name,
        "number": number,
        "label": f"{device.platform.name.strip()}: {device.name.strip()}",
        "limit_s": limit_s,
        "memory": MEMORY if int(device.type) & CPU else None,
    }
    threads = {variable: os.environ.get(variable, "2") for variable in THREADS}
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
            return f"could not be started ({error.strerror})"
        try:
            code = child.wait(CLOCK * limit_s)
        except subprocess.TimeoutExpired:
            return f"was not finished after {CLOCK * limit_s:g} s"
        finally:
            # The child and the compilers and linkers that it has started.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()
        if code == 0:
            return None
        message = _last_line(out) or _last_line(log) or "no message"
    if -code == signal.SIGXCPU:
        return f"was not finished after {limit_s:g} s of processor time"
    if code < 0:
        return f"was ended by a signal ({(signal.strsignal(-code) or str(-code)).lower()}: {message})"
    return f"failed ({message})"


def _last_line(file: IO[bytes]) -> str:
    """Return the last line of a file that is not blank, or an empty string."""
    file.seek(0)
    lines = file.read(2**16).decode(errors="replace").split("\n")
    return next((line.strip()[:200] for line in reversed(lines) if line.strip()), "")
