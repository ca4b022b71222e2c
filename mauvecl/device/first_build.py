"""The first build for a device and a driver, in a process of its own.

A driver's compiler may crash, hang or fill the memory, which would end the user's process without a word. The first
build for a device, driver and version of mauvecl therefore runs in a child process with limits of time and memory,
which draws a small scene and compares the counts with NumPy's. If that fails, the next lower level of the processor is
tried. The outcome is kept in the store of compiled kernels, so that later processes read one small file.
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
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mauvecl.device import processor
from mauvecl.device.drivers import sources
from mauvecl.device.errors import DeviceError
from mauvecl.device.kernel_cache import kernel_cache
from mauvecl.host.errors import InputError
from mauvecl.host.version import VERSION

#: Seconds of processor time that the child may use, unless this variable says otherwise; 0 builds without a child. On
#: a processor of 2024 it uses 3.
LIMIT, LIMIT_S = "MAUVECL_BUILD_LIMIT_S", 60.0
#: Seconds by the clock for each second of processor time, since other programs may run.
CLOCK = 10.0
#: Bytes of memory that a child on a processor may write to; it uses 300 MiB. GPU drivers reserve more than they use.
MEMORY = 4 * 2**30
#: Variables that tell PoCL, old and new, how many threads it may use.
THREADS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")
#: An outcome with a failure in it may have had another cause, such as a full machine, and is forgotten after a week.
KEPT_S = 7 * 86400.0
#: The child: it finds what its parent can import, wherever the parent was started.
CHILD = (
    "import json, sys; asked = json.loads(sys.argv[1]); sys.path[:] = asked['path']; "
    "from mauvecl.device import first_build; first_build.child(asked)"
)
#: CL_DEVICE_TYPE_CPU of the OpenCL specification.
CPU = 2
#: Signals by which a person or a scheduler stops a process.
STOPPED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

#: Names by which devices of this process are compiled for.
_settled: dict[int, str | None] = {}
_one_at_a_time = threading.Lock()


@dataclass(frozen=True)
class Outcome:
    """Names tried in turn, each with why it failed; the last one's reason is empty if it succeeded."""

    tried: tuple[tuple[str | None, str], ...]
    time_s: float

    @property
    def succeeded(self) -> bool:
        return not self.tried[-1][1]

    @property
    def current(self) -> bool:
        """Whether it can still be relied on."""
        return not any(why for _, why in self.tried) or 0 <= time.time() - self.time_s < KEPT_S


def settle(device: Any, others: Callable[[], Sequence[Any]]) -> str | None:
    """Let the driver compile for the highest level at which it works, and return that level's name.

    Parameters
    ----------
    device : pyopencl.Device
    others : callable
        Returns the devices of this machine, among them `device`, in the order in which another process finds them.

    Returns
    -------
    str or None
        None if the driver chooses by itself.

    Raises
    ------
    DeviceError
        If the driver works at no level.
    """
    place = int(device.int_ptr)
    if place not in _settled:
        with _one_at_a_time:
            if place not in _settled:
                names = processor.names(device)
                outcome = _outcome(device, names, others)
                if not outcome.succeeded:
                    raise DeviceError(_sentence(device, outcome))
                name = outcome.tried[-1][0]
                if name is not None:
                    processor.give_name(device, name)
                _settled[place] = name
    return _settled[place]


def _outcome(device: Any, names: tuple[str | None, ...], others: Callable[[], Sequence[Any]]) -> Outcome:
    """Recall what came of the first build, or try it."""
    untried = Outcome(((names[0], ""),), time.time())
    limit_s = _limit_s()
    if limit_s == 0:
        return untried
    kept, key = kernel_cache(), _key(device, names)
    recalled = _recalled(key)
    if recalled is not None:
        return recalled
    number = next((i for i, other in enumerate(others()) if other.int_ptr == device.int_ptr), None)
    if number is None or not sys.executable:
        return untried
    with _alone():
        # Another process may have tried in the meantime.
        recalled = _recalled(key)
        if recalled is not None:
            return recalled
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
        kept.remember(key, json.dumps(asdict(outcome)))
    return outcome


def _limit_s() -> float:
    said = os.environ.get(LIMIT, "")
    with contextlib.suppress(ValueError):
        if not said or 0 <= float(said) <= 86400:
            return float(said or LIMIT_S)
    raise InputError(f"{LIMIT} is {said!r}, expected 1 to 86400 seconds of processor time, or 0 for no limit")


def _key(device: Any, names: tuple[str | None, ...]) -> str:
    """Name of the outcome in the store: another driver, processor or version is tried again."""
    about = (VERSION, device.platform.version, device.name, device.version, device.driver_version, sys.prefix)
    said = "\0".join(("first build", *map(str, about), *map(str, names), *sorted(processor.flags())))
    return hashlib.sha256(said.encode()).hexdigest()[:32]


def _recalled(key: str) -> Outcome | None:
    text = kernel_cache().recall(key)
    if text is None:
        return None
    found = json.loads(text)
    outcome = Outcome(tuple((name, why) for name, why in found["tried"]), found["time_s"])
    return outcome if outcome.current else None


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """Hold a lock next to the store, so that processes started together do not all try."""
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
    """Build in a child process and return why that failed, or an empty text.

    Raises
    ------
    InterruptedError
        If no child could be started, or it was stopped from outside.
    """
    asked = {
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
            [sys.executable, "-c", CHILD, json.dumps(asked)],
            env=os.environ | threads,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=CLOCK * limit_s,
            # Ctrl-C is for the parent, which then ends the child.
            start_new_session=True,
        )
    except subprocess.TimeoutExpired:
        return f"not built after {CLOCK * limit_s:g} s"
    except OSError as error:
        raise InterruptedError from error
    if run.returncode == 0:
        return ""
    if -run.returncode in STOPPED:
        raise InterruptedError
    if -run.returncode == signal.SIGXCPU:
        return f"not built after {limit_s:g} s of processor time"
    if run.returncode < 0:
        return f"crashed: {(signal.strsignal(-run.returncode) or f'signal {-run.returncode}').lower()}"
    lines = run.stdout.decode(errors="replace").splitlines()
    return lines[-1] if lines else "failed"


def _sentence(device: Any, outcome: Outcome) -> str:
    """Say which processor and driver fail, what was tried, and what a user can do."""
    tried = "; ".join(f"{name or 'its own choice'} {why}" for name, why in outcome.tried)
    return (
        f"{device.platform.version.strip()}, driver {device.driver_version.strip()}, cannot build kernels for the "
        f"processor {device.name.strip()} (compiled for {tried}), expected another device (`mauvecl "
        f"devices` lists them) or driver: {sources()}; {LIMIT} sets the limit, and mauvecl tries again after a week"
    )


# In the child.


def child(asked: dict[str, Any]) -> None:
    """Build and run kernels within limits; end the process with 0, or print one sentence and end it with 1."""
    limit(asked)
    try:
        why = _build(asked)
    except Exception as error:
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
    if why:
        print(why)
    sys.exit(1 if why else 0)


def limit(asked: dict[str, Any]) -> None:
    """Set the limits of this process."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    seconds = max(1, round(asked["limit_s"]))
    # The hard limit kills where a handler of the compiler survives the soft one.
    _lower(resource.RLIMIT_CPU, seconds, seconds + 5)
    # Should the parent be killed, nobody waits for this process.
    signal.alarm(max(1, round(CLOCK * asked["limit_s"])))
    if asked["memory"] is not None:
        _lower(resource.RLIMIT_DATA, asked["memory"], asked["memory"])


def _lower(what: int, soft: int, hard: int) -> None:
    """Lower a limit; one that is lower already stays."""
    now = resource.getrlimit(what)[1]
    most = hard if now == resource.RLIM_INFINITY else min(hard, now)
    # macOS knows some limits by name only.
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(what, (min(soft, most), most))


def _build(asked: dict[str, Any]) -> str:
    """Draw a small scene and return what is wrong with it, or an empty text."""
    import numpy as np

    from mauvecl.device.engine import Engine
    from mauvecl.device.program import SAME_BITS, choose_device
    from mauvecl.device.selftest import toy
    from mauvecl.noise import twin
    from mauvecl.noise.scene import prepare

    handle, record = choose_device(str(asked["number"]))
    if record.label != asked["label"]:
        return f"device {asked['number']} is {record.label} in a new process, expected {asked['label']}"
    name = asked["name"]
    if name is not None and not processor.give_name(handle, name):
        return "PoCL's record of the device is not understood"
    _settled[int(handle.int_ptr)] = name
    engine, quiet, flare = Engine(str(asked["number"])), toy(), toy(flare=0.3)
    raw = engine.realise(quiet, count=64, seed=1)
    engine.detect(quiet, [flare], realisations=64, seed=1)
    same = np.array_equal(raw, twin.realise(prepare([quiet]), np.arange(64, dtype=np.uint64), 1))
    return "" if same or record.promise != SAME_BITS else "draws other counts than NumPy"
