"""Child process of the first build: builds and runs kernels within limits of time and memory."""

from __future__ import annotations

import contextlib
import resource
import signal
import sys
from typing import Any

import numpy as np

from mauvecl.device import first_build, processor
from mauvecl.device.engine import Engine
from mauvecl.device.errors import BuildError, DeviceError
from mauvecl.device.program import SAME_BITS, choose_device, load_opencl, out_of_memory
from mauvecl.device.toy_exposure import toy
from mauvecl.noise import reference
from mauvecl.noise.scene import prepare


def child(request: dict[str, Any]) -> None:
    """Build and run kernels within the limits; print the reason of a failure, and exit with a code that says whose."""
    limit(request)
    code = first_build.DRIVER_FAILED
    try:
        why = _build(request)
    except Exception as error:
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        if not _is_drivers(error):
            code = first_build.OTHER_FAILED
    if why:
        print(why)
    sys.exit(code if why else 0)


def _is_drivers(error: Exception) -> bool:
    """Return whether the driver is at fault for an exception, and not memory, disk or another device."""
    if isinstance(error, DeviceError):
        return isinstance(error, BuildError) or error.kind == "processor"
    return isinstance(error, load_opencl().Error) and not out_of_memory(error)


def limit(request: dict[str, Any]) -> None:
    """Set the limits of this process."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    seconds = max(1, round(request["limit_s"]))
    # The hard limit ends the process even if the compiler handles the signal of the soft one.
    _lower(resource.RLIMIT_CPU, seconds, seconds + 5)
    # The alarm ends this process if the parent is killed.
    signal.alarm(max(1, round(first_build.CLOCK * request["limit_s"])))
    if request["memory"] is not None:
        _lower(resource.RLIMIT_DATA, request["memory"], request["memory"])


def _lower(what: int, soft: int, hard: int) -> None:
    """Lower a resource limit, unless it is lower already."""
    now = resource.getrlimit(what)[1]
    most = hard if now == resource.RLIM_INFINITY else min(hard, now)
    # macOS defines some limits without enforcing them.
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(what, (min(soft, most), most))


def _build(request: dict[str, Any]) -> str:
    """Draw a small scene and return a message if its counts are wrong, or an empty string."""
    handle, record = choose_device(str(request["number"]))
    if record.label != request["label"]:
        raise DeviceError(f"device {request['number']} is {record.label} in a new process, not {request['label']}")
    name = request["name"]
    if name is not None and not processor.set_processor_name(handle, name):
        return "PoCL's record of the device is not understood"
    first_build.settled[int(handle.int_ptr)] = name
    engine, quiet, flare = Engine(str(request["number"])), toy(), toy(flare=0.3)
    raw = engine.realise(quiet, count=64, seed=1)
    engine.detect(quiet, [flare], realisations=64, seed=1)
    same = np.array_equal(raw, reference.realise(prepare([quiet]), np.arange(64, dtype=np.uint64), 1))
    return "" if same or record.promise != SAME_BITS else "draws other counts than NumPy"
