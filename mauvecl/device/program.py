"""Find a device, render the kernels, build them, keep them in a private cache.

Only this room touches pyopencl.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
import warnings
from dataclasses import asdict, dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from mauvecl.device import vendors
from mauvecl.device.drivers import sources
from mauvecl.device.errors import BuildError, DeviceError
from mauvecl.device.first_build import settle
from mauvecl.device.kernel_cache import kernel_cache
from mauvecl.host.version import VERSION
from mauvecl.noise import layout

if TYPE_CHECKING:
    import pyopencl

ROOMS = ("portable", "philox", "normal", "poisson", "prior", "detector")
POCL = "Portable Computing Language"


#: What a device with strict arithmetic promises: every draw, statistic and table as on any other such device.
SAME_BITS = "same bits"


@dataclass(frozen=True)
class DeviceRecord:
    """One OpenCL device, as `mauvecl devices` lists it."""

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


@dataclass(frozen=True)
class Variant:
    """What kernels are rendered for; no value of a study is among it."""

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
    cosmic: bool = False
    modulations: tuple[tuple[str, str], ...] = ()
    row_type: str = "int"
    sums: int = 0
    spectra: int = 0
    unknown_groups: int = 0
    jittered: bool = False
    counts: bool = False
    fourths: bool = False
    in_time: bool = False

    @property
    def compared(self) -> bool:
        """Whether more is compared than the expectation by the model's variances."""
        return self.pair or self.noisy or self.estimated or self.slots > 0


def load_opencl() -> Any:
    """Import pyopencl with a cache folder of our own, after checking what would abort the process.

    PoCL ends the whole process when its cache is unusable or the linker it calls is missing, so both
    are looked at before it is loaded.

    Raises
    ------
    DeviceError
        If the linker ``ld`` is not on the path, pyopencl cannot be loaded, or it was loaded before a fork.
    """
    linker = shutil.which("ld", path=os.environ.get("PATH") or os.defpath)
    if linker is None:
        raise DeviceError(
            "no linker `ld` found on PATH, and PoCL needs it to link kernels: install binutils "
            "(Debian, Ubuntu: `apt-get install binutils`; Fedora: `dnf install binutils`)"
        )
    if not os.environ.get("PATH"):
        # Python looks in the usual folders then, PoCL in none, and ends the process.
        os.environ["PATH"] = os.path.dirname(linker)
    try:
        os.environ["POCL_CACHE_DIR"] = str(kernel_cache().work)
    except OSError as error:
        raise DeviceError(f"{error}: set MAUVECL_CACHE_DIR to a folder that can") from error
    if kernel_cache().pid != os.getpid():
        # PoCL's threads do not survive a fork; its next call would wait for them for ever.
        raise DeviceError("OpenCL was loaded before a fork, expected a process of its own start (use spawn)")
    # pyopencl's own cache would be a second one beside PoCL's.
    os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
    try:
        import pyopencl
    except ImportError as error:
        raise DeviceError(f"pyopencl cannot be loaded ({error}): install {sources()}") from error
    return pyopencl


def _devices() -> list[Any]:
    cl = load_opencl()
    try:
        with vendors.shown():
            platforms = cl.get_platforms()
    except cl.Error:
        platforms = []
    handles = []
    for platform in platforms:
        try:
            handles += platform.get_devices()
        except cl.Error:
            continue
    if not handles:
        # Loaders look in the folder that a variable names, and then nowhere else.
        places = ", ".join(f"{name}={os.environ[name]}" for name in vendors.FOLDERS if os.environ.get(name))
        searched = f" ({places})" if places else ""
        raise DeviceError(f"no OpenCL device found{searched}: install {sources()}")
    # PoCL on the CPU first: it is the default.
    return sorted(handles, key=lambda d: (d.platform.name != POCL, "cpu" not in _kind(d)))


def _kind(device: Any) -> str:
    cl = load_opencl()
    kinds = {"cpu": cl.device_type.CPU, "gpu": cl.device_type.GPU, "accelerator": cl.device_type.ACCELERATOR}
    return next((name for name, bit in kinds.items() if device.type & bit), "other")


def _promise(device: Any) -> str:
    lacking = weaknesses(device)
    return SAME_BITS if not lacking else f"same draws to float rounding: no {', no '.join(lacking)}"


def weaknesses(device: Any) -> list[str]:
    """What a device lacks of the arithmetic that gives the same bits everywhere."""
    cl = load_opencl()
    bits = cl.device_fp_config
    needed = {
        "rounding to nearest": bits.ROUND_TO_NEAREST,
        "fused multiply-add": bits.FMA,
        "correctly rounded division and square root": bits.CORRECTLY_ROUNDED_DIVIDE_SQRT,
    }
    return [name for name, bit in needed.items() if not device.single_fp_config & bit]


def devices() -> list[DeviceRecord]:
    """Every OpenCL device here, the default one first.

    Raises
    ------
    DeviceError
        If there is none, or no linker.
    """
    return [
        DeviceRecord(
            platform=device.platform.name.strip(),
            name=device.name.strip(),
            driver=device.driver_version.strip(),
            kind=_kind(device),
            compute_units=int(device.max_compute_units),
            global_memory=int(device.global_mem_size),
            default=index == 0,
            promise=_promise(device),
        )
        for index, device in enumerate(_devices())
    ]


def choose_device(wanted: str | None) -> tuple[Any, DeviceRecord]:
    """The pyopencl device whose number, platform or name matches `wanted`; the default one for None.

    Raises
    ------
    DeviceError
        If nothing matches; the message lists the devices present.
    """
    handles, records = _devices(), devices()
    if wanted is None:
        return handles[0], records[0]
    for index, record in enumerate(records):
        if wanted == str(index) or wanted.casefold() in record.label.casefold():
            return handles[index], record
    present = "; ".join(f"{index} = {record.label}" for index, record in enumerate(records))
    raise DeviceError(f"device {wanted!r} is not here, expected one of: {present}")


@cache
def render(rooms: tuple[str, ...], variant: Variant) -> str:
    """The OpenCL C source of these files, after the shared ones.

    Parameters
    ----------
    rooms : tuple of str
        Names of kernel sources without their ending, such as ``("statistics",)``.
    variant : Variant
        Widths and switches.
    """
    local = "" if variant.width == 1 else "__attribute__((reqd_work_group_size(1, 1, 1)))"
    values = asdict(variant) | {
        "attributes": local,
        "streams": layout.STREAMS,
        "polynomials": {k: [f"{c}f" for c in v] for k, v in layout.POLYNOMIALS.items()},
        "two_ln2": f"{layout.TWO_LN2}f",
        "magic": f"{layout.MAGIC}f",
        "reference": layout.REFERENCE,
        "fixed": len(layout.FIXED_STATISTICS),
        "linear": variant.linears > 0,
        "modulated": bool(variant.modulations),
        "jitter": next((i for i, (name, _) in enumerate(variant.modulations) if name == "jitter"), None),
        "prior_bits": layout.PRIOR_BITS,
        "prior_finest": layout.PRIOR_FINEST,
        "prior_nodes": layout.PRIOR_NODES,
        "observer_bins": layout.OBSERVER_BINS,
        "log2_e": f"{layout.LOG2_E}f",
        "ln2_parts": layout.LN2_PARTS,
        "exponential": [f"{c!r}f" for c in layout.EXPONENTIAL],
        "bins": layout.BINS,
        "fine_bits": layout.FINE_BITS,
        "structs": {name: dtype.names for name, dtype in layout.STRUCTS.items()},
    }
    names = (*ROOMS, *rooms)
    folder = files("mauvecl.kernels")
    texts = [folder.joinpath(f"{name}.cl.mako").read_text(encoding="utf-8") for name in names]
    structs = layout.c_structs()

    def make() -> str:
        parts = (str(_parsed(text).render(**values)) for text in texts)
        return "\n".join((f"/* mauvecl {VERSION} */", structs, *parts))

    # Rendering takes longer than starting a kernel that is built already.
    return kernel_cache().remembered(hashlib.sha256(repr((structs, values, texts)).encode()).hexdigest()[:32], make)


@cache
def _parsed(text: str) -> Any:
    # Heavy to import.
    from mako.template import Template

    return Template(text, strict_undefined=True)


def out_of_memory(error: Exception) -> bool:
    """Whether an OpenCL error says that the device's memory did not suffice."""
    told = ("MEM_OBJECT_ALLOCATION_FAILURE", "OUT_OF_RESOURCES", "OUT_OF_HOST_MEMORY", "INVALID_BUFFER_SIZE")
    return any(word in str(error) for word in told)


def digest(source: str) -> str:
    """Short sha256 of a rendered source, as run records carry it."""
    return hashlib.sha256(source.encode()).hexdigest()[:16]


def build(context: pyopencl.Context, source: str) -> pyopencl.Program:
    """Compile a rendered source with strict arithmetic, or take it from the cache.

    Raises
    ------
    BuildError
        With the numbered source and the device's log.
    """
    cl = load_opencl()
    device = context.devices[0]
    # Without -w PoCL's compiler prints how many warnings it kept to itself.
    options = ["-cl-std=CL1.2", "-w"]
    if not weaknesses(device):
        options.append("-cl-fp32-correctly-rounded-divide-sqrt")
    kept = kernel_cache()
    # A store shared by several machines holds what each processor can run; names such as "AMD EPYC" do not tell.
    # PoCL tells its programs apart by the place of its own libraries too: what another installation has compiled would
    # be brought back and compiled again at every start.
    target = (device.name, device.version, device.driver_version, str(settle(device, _devices)), sys.prefix)
    key = hashlib.sha256("\0".join((source, *options, *target)).encode()).hexdigest()[:32]
    restored = kept.restore(key)
    try:
        with warnings.catch_warnings(), contextlib.nullcontext() if restored else kept.building(key):
            # Some compilers greet.
            warnings.simplefilter("ignore", cl.CompilerWarning)
            program: pyopencl.Program = cl.Program(context, source).build(options, cache_dir=False)
    except cl.Error as error:
        if "unknown target CPU" in str(error):
            raise DeviceError(
                f"{device.platform.version.strip()} does not know the processor {device.name} and cannot build for it, "
                "expected a newer PoCL or another OpenCL driver"
            ) from error
        numbered = "\n".join(f"{i:4d}  {line}" for i, line in enumerate(source.splitlines(), 1))
        raise BuildError(f"a kernel did not compile on {device.name}\n{numbered}\n{error}") from error
    return program
