"""First build of kernels for a device and driver, in a child process.

A driver's compiler may crash, hang or exhaust the memory, which would end the user's process without a message. The
first build for a device, driver and version of mauvecl therefore runs in a child process with limits of time and
memory, which draws a small scene and compares the counts with NumPy's. If it fails twice, the next lower level of the
processor is tried. The outcome is saved with the compiled kernels, so that later processes read one small file, unless
something else than the driver failed: a child that was killed, the linker, or memory.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import IO, Any

from mauvecl.device import processor
from mauvecl.device.drivers import driver_sources
from mauvecl.device.errors import DeviceError
from mauvecl.device.kernel_cache import kernel_cache
from mauvecl.host.version import VERSION
from mauvecl.schema.errors import InputError

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
#: Number of attempts at each level, since a failure may not occur again.
ATTEMPTS = 2
#: Exit codes of the child: the driver failed, or something else.
DRIVER_FAILED, OTHER_FAILED = 1, 3
#: Code of the child, which searches the same import path as its parent.
CHILD = (
    "import json, sys; request = json.loads(sys.argv[1]); sys.path[:] = request['path']; "
    "from mauvecl.device import first_build_child; first_build_child.child(request)"
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
    """Failed attempt of the first build."""

    #: Reason, as the end of a sentence about the attempt.
    why: str
    #: Whether the driver is at fault, so that it would fail again.
    by_driver: bool = True
    #: Whether another attempt at the same level would take as long.
    slow: bool = False


@dataclass(frozen=True)
class Outcome:
    """Outcome of the first build for a device."""

    #: Processor names in the order of trial and why each failed; the last reason is empty after a success.
    tried: tuple[tuple[str | None, str], ...]
    time_s: float
    #: Whether only the driver is at fault for failures.
    by_driver: bool = True

    @property
    def succeeded(self) -> bool:
        return not self.tried[-1][1]

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
                names = processor.names(device)
                outcome = _outcome(device, names, others)
                if not outcome.succeeded:
                    raise DeviceError(_failure_message(device, outcome))
                name = outcome.tried[-1][0]
                if name is not None:
                    processor.set_processor_name(device, name)
                settled[place] = name
    return settled[place]


def _outcome(device: Any, names: tuple[str | None, ...], others: Callable[[], Sequence[Any]]) -> Outcome:
    """Read the outcome of the first build, or run the build."""
    untried = Outcome(((names[0], ""),), time.time())
    limit_s = _limit_s()
    if limit_s == 0:
        return untried
    kept, key = kernel_cache(), _key(device, names)
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
                failure = _attempts(name, number, device, limit_s)
            except InterruptedError:
                return untried
            tried.append((name, failure.why if failure else ""))
            if failure is None:
                break
            by_driver &= failure.by_driver
            if place + 1 < len(names):
                _warn(device, name, failure, f"The next lower level, {names[place + 1]}, is tried.")
        outcome = Outcome(tuple(tried), time.time(), by_driver)
        if by_driver:
            kept.write_text(key, json.dumps(asdict(outcome)))
    return outcome


def _attempts(name: str | None, number: int, device: Any, limit_s: float) -> Failure | None:
    """Build for a level in one or more attempts, and return the last failure, or None after a success."""
    for attempt in range(ATTEMPTS):
        failure = _try(name, number, device, limit_s)
        if failure is None or failure.slow:
            break
        if attempt + 1 < ATTEMPTS and not failure.by_driver:
            _warn(device, name, failure, "It is tried again.")
    return failure


def _warn(device: Any, name: str | None, failure: Failure, what_follows: str) -> None:
    """Warn of a failure, because further attempts take time."""
    level = f" at level {name}" if name else ""
    message = f"The first build of kernels for {device.name.strip()}{level} {failure.why}. {what_follows}"
    warnings.warn(message, stacklevel=2)


def _limit_s() -> float:
    said = os.environ.get(LIMIT, "")
    with contextlib.suppress(ValueError):
        if not said or 0 <= float(said) <= 86400:
            return float(said or LIMIT_S)
    raise InputError.of(LIMIT, said, "1 to 86400 seconds of processor time, or 0 for no limit")


def _key(device: Any, names: tuple[str | None, ...]) -> str:
    """Return the outcome's name in the cache, unique for version, driver, processor and installation."""
    about = (VERSION, device.platform.version, device.name, device.version, device.driver_version, sys.prefix)
    said = "\0".join((*map(str, about), *map(str, names), *sorted(processor.flags())))
    return OUTCOME_KEY + hashlib.sha256(said.encode()).hexdigest()[:32]


def _read_outcome(key: str) -> Outcome | None:
    text = kernel_cache().read_text(key)
    if text is None:
        return None
    found = json.loads(text)
    outcome = Outcome(tuple((name, why) for name, why in found["tried"]), found["time_s"], found["by_driver"])
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
            return Failure(f"was not finished after {CLOCK * limit_s:g} s", by_driver=False, slow=True)
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
        return Failure(f"was not finished after {limit_s:g} s of processor time", slow=True)
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
