"""Devices and their programs: choice of a device, rendering of kernels, and builds."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import sys
import time
import warnings
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from mauvecl.device import drivers
from mauvecl.host import VERSION
from mauvecl.noise import layout
from mauvecl.noise.scene import PIXEL_BLOCK
from mauvecl.noise.unknowns import PROCESSES

if TYPE_CHECKING:
    import pyopencl

SHARED_FILES = ("portable", "philox", "normal", "poisson", "prior", "detector")
POCL = "Portable Computing Language"
#: Promise of devices with strict arithmetic: draws, statistics and tables are equal on all of them.
SAME_BITS = "same bits"


@dataclass(frozen=True)
class DeviceRecord:
    """OpenCL device, as listed by `mauvecl devices`."""

    platform: str
    name: str
    driver: str
    kind: str
    compute_units: int
    global_memory: int
    default: bool
    promise: str = SAME_BITS

    @property
    def label(self) -> str:
        return f"{self.platform}: {self.name}"


def write_outcome(device: DeviceRecord, checks: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Store and return the record of a self-test, for later records of the same device, driver and version."""
    record = {
        "mauvecl": VERSION,
        "device": asdict(device),
        "date_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "seconds": round(seconds, 1),
        "passed": all(check["passed"] for check in checks),
        "checks": checks,
    }
    drivers.kernel_cache().write_text(_outcome_key(device), json.dumps(record))
    return record


def read_outcome(device: DeviceRecord) -> dict[str, Any] | None:
    """Return the latest outcome of the self-test on a device, or None."""
    text = drivers.kernel_cache().read_text(_outcome_key(device))
    return None if text is None else dict(json.loads(text))


def _outcome_key(device: DeviceRecord) -> str:
    unique = f"selftest {VERSION} {device.label} {device.driver}"
    return hashlib.sha256(unique.encode()).hexdigest()[:32]


@dataclass(frozen=True)
class Variant:
    """Options for which kernels are rendered; values of a study are not among them."""

    width: int
    vector_forms: bool
    chunk: int
    vectors: int = 1
    scenarios: int = 16
    linears: int = 0
    frames: bool = False
    clip: bool = False
    pair: bool = False
    noisy: bool = False
    estimated: bool = False
    slots: int = 0
    smooths: int = 0
    elements: bool = True
    joint: bool = True
    quartic: bool = True
    photons: bool = False
    additive: tuple[str, ...] = ()
    modulations: tuple[tuple[str, str], ...] = ()
    row_type: str = "int"
    sums: int = 0
    spectra: int = 0
    unknown_groups: int = 0
    jittered: bool = False
    counts: bool = False
    fourths: bool = False
    neighbours: bool = False
    pointing: bool = False
    in_time: bool = False

    @property
    def compared(self) -> bool:
        """Whether statistics use more than the expectation and the model's variances."""
        return self.pair or self.noisy or self.estimated or self.slots > 0


def load_opencl() -> Any:
    """Import pyopencl with a private cache folder.

    PoCL aborts the process if its cache is unusable or the linker is missing, so both are checked first. Raises
    DeviceError if the linker ``ld`` is not on the path, or pyopencl cannot be loaded or was loaded before a fork.
    """
    linker = shutil.which("ld", path=os.environ.get("PATH") or os.defpath)
    if linker is None:
        raise drivers.DeviceError(
            "no linker `ld` found on PATH, and PoCL needs it to link kernels: install binutils "
            "(Debian, Ubuntu: `apt-get install binutils`; Fedora: `dnf install binutils`)"
        )
    if not os.environ.get("PATH"):
        # Without PATH, Python searches the default folders, but PoCL finds no linker and aborts the process.
        os.environ["PATH"] = os.path.dirname(linker)
    try:
        os.environ["POCL_CACHE_DIR"] = str(drivers.kernel_cache().work)
    except OSError as error:
        raise drivers.DeviceError(f"{error}: set MAUVECL_CACHE_DIR to a folder that can") from error
    libraries = drivers.kernel_cache().work / "libraries"
    if not libraries.exists():
        # PoCL links kernels as a compiler links programs, with the compiler's own libraries, although kernels call none
        # of their functions. Empty archives take their places where no compiler is installed.
        libraries.mkdir()
        for name in ("gcc", "gcc_s", "c"):
            (libraries / f"lib{name}.a").write_bytes(b"!<arch>\n")
        os.environ["LIBRARY_PATH"] = os.pathsep.join(filter(None, (os.environ.get("LIBRARY_PATH"), str(libraries))))
    if drivers.kernel_cache().pid != os.getpid():
        # PoCL's threads do not survive a fork; its next call would wait forever.
        raise drivers.DeviceError("OpenCL was loaded before a fork, but needs a newly started process (use spawn)")
    # pyopencl's own cache would duplicate PoCL's.
    os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
    try:
        import pyopencl
    except ImportError as error:
        raise drivers.DeviceError(f"pyopencl cannot be loaded ({error}): install {drivers.driver_sources()}") from error
    return pyopencl


def _handles_and_records() -> list[tuple[Any, DeviceRecord]]:
    """Return all OpenCL devices and their records, the default one first."""
    cl = load_opencl()
    handles, kind = list[Any](), cl.device_type
    with contextlib.suppress(cl.Error), drivers.show_intel_runtime():
        platforms = cl.get_platforms()
        for platform in platforms:
            with contextlib.suppress(cl.Error):
                handles += platform.get_devices()
    if not handles:
        # If a variable names a folder, loaders search only that.
        folders = ", ".join(f"{name}={os.environ[name]}" for name in drivers.FOLDER_VARIABLES if os.environ.get(name))
        place = f" ({folders})" if folders else ""
        raise drivers.DeviceError(f"no OpenCL device found{place}: install {drivers.driver_sources()}", "no device")
    # PoCL on the CPU is the default.
    handles.sort(key=lambda device: (device.platform.name != POCL, not device.type & kind.CPU))
    kinds = {"cpu": kind.CPU, "gpu": kind.GPU, "accelerator": kind.ACCELERATOR}
    pairs = list[tuple[Any, DeviceRecord]]()
    for device in handles:
        lacking = weaknesses(device)
        record = DeviceRecord(
            platform=device.platform.name.strip(),
            name=device.name.strip(),
            driver=device.driver_version.strip(),
            kind=next((name for name, bit in kinds.items() if device.type & bit), "other"),
            compute_units=int(device.max_compute_units),
            global_memory=int(device.global_mem_size),
            default=not pairs,
            promise=f"same draws to float rounding: no {', no '.join(lacking)}" if lacking else SAME_BITS,
        )
        pairs.append((device, record))
    return pairs


def weaknesses(device: Any) -> list[str]:
    """Return the properties of strict arithmetic that a device lacks."""
    cl = load_opencl()
    bits = cl.device_fp_config
    needed = {
        "rounding to nearest": bits.ROUND_TO_NEAREST,
        "fused multiply-add": bits.FMA,
        "correctly rounded division and square root": bits.CORRECTLY_ROUNDED_DIVIDE_SQRT,
    }
    return [name for name, bit in needed.items() if not device.single_fp_config & bit]


def devices() -> list[DeviceRecord]:
    """List all OpenCL devices, the default one first. Raises DeviceError if there is none, or no linker."""
    return [record for _, record in _handles_and_records()]


def choose_device(name: str | None) -> tuple[Any, DeviceRecord]:
    """Return the device whose number, platform or name matches `name`, by default the first one, and its record.

    Raises DeviceError if none matches.
    """
    pairs = _handles_and_records()
    for index, (handle, record) in enumerate(pairs):
        if name is None or name == str(index) or name.casefold() in record.label.casefold():
            return handle, record
    present = "; ".join(f"{index} = {record.label}" for index, (_, record) in enumerate(pairs))
    raise drivers.DeviceError(f"device {name!r} is not here; use one of: {present}", "unknown device")


@cache
def render(kernel_files: tuple[str, ...], variant: Variant) -> str:
    """Render the OpenCL C source of the shared files and `kernel_files`, given without their extension."""
    local = "" if variant.width == 1 else "__attribute__((reqd_work_group_size(1, 1, 1)))"
    values = asdict(variant) | {
        "attributes": local,
        "polynomials": {k: [f"{c}f" for c in v] for k, v in layout.POLYNOMIALS.items()},
        "two_ln2": f"{layout.TWO_LN2}f",
        "magic": f"{layout.MAGIC}f",
        "log2_e": f"{layout.LOG2_E}f",
        "exponential": [f"{c!r}f" for c in layout.EXPONENTIAL],
        "fixed": len(layout.FIXED_STATISTICS),
        "linear": variant.linears > 0,
        "modulated": bool(variant.modulations),
        "jitter": next((i for i, (name, _) in enumerate(variant.modulations) if PROCESSES[name].when == "frame"), None),
        "structs": {name: dtype.names for name, dtype in layout.STRUCTS.items()},
    }
    plain = "streams reference prior_bits prior_finest prior_nodes observer_bins ln2_parts bins fine_bits"
    values |= {name: getattr(layout, name.upper()) for name in plain.split()}
    names = (*SHARED_FILES, *kernel_files)
    folder = files("mauvecl") / "kernels"
    texts = [(folder / f"{name}.cl.mako").read_text(encoding="utf-8") for name in names]
    structs = layout.c_structs()

    key = hashlib.sha256(repr((structs, values, texts)).encode()).hexdigest()[:32]
    # Rendering takes longer than loading a compiled kernel.
    source = drivers.kernel_cache().read_text(key)
    if source is None:
        rendered = (str(_parsed(text).render(**values)) for text in texts)
        source = "\n".join((f"/* mauvecl {VERSION} */", structs, *rendered))
        drivers.kernel_cache().write_text(key, source)
    return source


@cache
def _parsed(text: str) -> Any:
    # The import is slow.
    from mako.template import Template

    return Template(text, strict_undefined=True)


def out_of_memory(error: Exception) -> bool:
    """Return whether an OpenCL error means that the device's memory does not suffice."""
    codes = ("MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_RESOURCES", "OUT_OF_HOST_MEMORY", "INVALID_BUFFER_SIZE")
    return any(code in str(error) for code in codes)


def build(context: pyopencl.Context, source: str) -> pyopencl.Program:
    """Compile a rendered source with strict arithmetic, or load it from the cache.

    Raises DeviceError if the driver cannot compile it; the message then contains the numbered lines of the source.
    """
    cl = load_opencl()
    device = context.devices[0]
    # Without -w, PoCL's compiler prints the number of suppressed warnings.
    options = ["-cl-std=CL1.2", "-w"]
    if not weaknesses(device):
        options.append("-cl-fp32-correctly-rounded-divide-sqrt")
    cache = drivers.kernel_cache()
    pointers = [handle.int_ptr for handle, _ in _handles_and_records()]
    number = pointers.index(device.int_ptr) if device.int_ptr in pointers else None
    # The key contains the processor level, since machines with the same device name, such as "AMD EPYC", may share the
    # store, and the installation, since PoCL compiles a program of another installation again at every start.
    level = str(drivers.choose_processor_level(device, number))
    target = (device.name, device.version, device.driver_version, level, sys.prefix)
    key = hashlib.sha256("\0".join((source, *options, *target)).encode()).hexdigest()[:32]
    restored = cache.restore(key)
    try:
        with warnings.catch_warnings(), contextlib.nullcontext() if restored else cache.building(key):
            # Some compilers print a greeting.
            warnings.simplefilter("ignore", cl.CompilerWarning)
            program: pyopencl.Program = cl.Program(context, source).build(options, cache_dir=False)
    except cl.Error as error:
        if "unknown target CPU" in str(error):
            raise drivers.DeviceError(
                f"{device.platform.version.strip()} does not know the processor {device.name} and cannot build for it, "
                "expected a newer PoCL or another OpenCL driver",
                "processor",
            ) from error
        numbered = "\n".join(f"{i:4d}  {line}" for i, line in enumerate(source.splitlines(), 1))
        message = f"a kernel did not compile on {device.name}"
        raise drivers.DeviceError(f"{message}\n{numbered}\n{error}", "kernel") from error
    return program


#: Largest number of vectors of realisations per work-item of the detection kernels on a CPU.
VECTORS = 4


class Device:
    """Open OpenCL device with its context, queue and compiled kernels.

    `name` is the number or part of the name, as for `Engine`, and `width` the number of realisations per work-item,
    by default 16 on CPUs and 1 elsewhere.
    """

    def __init__(self, name: str | None = None, *, width: int | None = None) -> None:
        self.cl = load_opencl()
        handle, self.record = choose_device(name)
        self.context = self.cl.Context([handle])
        self.queue = self.cl.CommandQueue(self.context)
        self.width = width or (16 if self.record.kind == "cpu" else 1)
        # Realisations per work-item of the widest kernel; launches are cut at its multiples.
        self.step = VECTORS * self.width if self.width > 1 else 1
        self._vector_forms = self.width == 16 and self.record.platform == POCL
        self._programs: dict[str, Any] = {}
        self._kernels: dict[tuple[str, str], Any] = {}
        self.pid = os.getpid()

    @property
    def variant(self) -> Variant:
        """Kernel variant of this device, before a scene sets its own options."""
        return Variant(width=self.width, vector_forms=self._vector_forms, chunk=PIXEL_BLOCK if self.width > 1 else 4)

    @property
    def kernel_digest(self) -> str:
        """Short sha256 of the kernels rendered so far, for run records."""
        return hashlib.sha256("\n".join(sorted(self._programs)).encode()).hexdigest()[:16]

    def kernel(self, kernel_files: tuple[str, ...], variant: Variant, name: str) -> Any:
        """Return a kernel of the program of these files; both are built once."""
        source = render(kernel_files, variant)
        if source not in self._programs:
            self._programs[source] = build(self.context, source)
        if (source, name) not in self._kernels:
            self._kernels[source, name] = self.cl.Kernel(self._programs[source], name)
        return self._kernels[source, name]
