"""First build of kernels for a device and driver, in a child process.

A driver's compiler may crash, hang or exhaust the memory, which would end the user's process without a message. The
first build for a device, driver and version of mauvecl therefore runs in a child process with limits of time and
memory, which draws a small scene and compares the counts with NumPy's. If it fails, the next lower level of the
processor is tried. The outcome is saved with the compiled kernels, so that later processes read one small file.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

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
#: A failure may have a temporary cause, such as too little free memory, and is discarded after a week.
OUTCOME_LIFETIME_S = 7 * 86400.0
#: Code of the child, which searches the same import path as its parent.
CHILD = (
    "import json, sys; request = json.loads(sys.argv[1]); sys.path[:] = request['path']; "
    "from mauvecl.device import first_build_child; first_build_child.child(request)"
)
#: CL_DEVICE_TYPE_CPU of the OpenCL specification.
CPU = 2
#: Signals with which users and schedulers stop processes.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

#: Processor name chosen for each device of this process.
settled: dict[int, str | None] = {}
_one_at_a_time = threading.Lock()


@dataclass(frozen=True)
class Outcome:
    """Outcome of the first build for a device."""

    #: Processor names in the order of trial and why each failed; the last reason is empty after a success.
    tried: tuple[tuple[str | None, str], ...]
    time_s: float

    @property
    def succeeded(self) -> bool:
        return not self.tried[-1][1]

    @property
    def current(self) -> bool:
        """True if the outcome is still valid."""
        return not any(why for _, why in self.tried) or 0 <= time.time() - self.time_s < OUTCOME_LIFETIME_S


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
        for name in names:
            try:
                why = _try(name, number, device, limit_s)
            except InterruptedError:
                return untried
            tried.append((name, why))
            if not why:
                break
        outcome = Outcome(tuple(tried), time.time())
        kept.write_text(key, json.dumps(asdict(outcome)))
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
    said = "\0".join(("first build", *map(str, about), *map(str, names), *sorted(processor.flags())))
    return hashlib.sha256(said.encode()).hexdigest()[:32]


def _read_outcome(key: str) -> Outcome | None:
    text = kernel_cache().read_text(key)
    if text is None:
        return None
    found = json.loads(text)
    outcome = Outcome(tuple((name, why) for name, why in found["tried"]), found["time_s"])
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


def _try(name: str | None, number: int, device: Any, limit_s: float) -> str:
    """Build in a child process and return why it failed, or an empty string.

    Raises InterruptedError if the child could not be started or was stopped by a signal.
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
    try:
        run = subprocess.run(
            [sys.executable, "-c", CHILD, json.dumps(request)],
            env=os.environ | threads,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=CLOCK * limit_s,
            # Ctrl-C must reach only the parent, which then ends the child.
            start_new_session=True,
        )
    except subprocess.TimeoutExpired:
        return f"not built after {CLOCK * limit_s:g} s"
    except OSError as error:
        raise InterruptedError from error
    if run.returncode == 0:
        return ""
    if -run.returncode in STOP_SIGNALS:
        raise InterruptedError
    if -run.returncode == signal.SIGXCPU:
        return f"not built after {limit_s:g} s of processor time"
    if run.returncode < 0:
        return f"crashed: {(signal.strsignal(-run.returncode) or f'signal {-run.returncode}').lower()}"
    lines = run.stdout.decode(errors="replace").splitlines()
    return lines[-1] if lines else "failed"


def _failure_message(device: Any, outcome: Outcome) -> str:
    """Return a message that names the processor, the driver, the attempts and the remedies."""
    tried = "; ".join(f"{name or 'its own choice'} {why}" for name, why in outcome.tried)
    return (
        f"{device.platform.version.strip()}, driver {device.driver_version.strip()}, cannot build kernels for the "
        f"processor {device.name.strip()} (compiled for {tried}), expected another device (`mauvecl "
        f"devices` lists them) or driver: {driver_sources()}; {LIMIT} sets the limit, and mauvecl tries again after "
        "a week"
    )
