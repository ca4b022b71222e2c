"""Compare the kernels of the self-test on another processor, compiled by clang, with what they left on this one.

For processors on which no OpenCL driver can be run, such as an emulated one. In the form of GPUs, one realisation per
work-item, kernels are functions of C that need thirteen builtins. Of the three steps, the last runs on the other
processor and needs no package:

    python tools/replay_kernels.py record FOLDER
    python tools/replay_kernels.py compile FOLDER --target aarch64-linux-gnu --clang clang --ld aarch64-linux-gnu-ld
    python tools/replay_kernels.py replay FOLDER
"""

from __future__ import annotations

import argparse
import ctypes
import hashlib
import pickle
import platform
import subprocess
from pathlib import Path
from typing import Any

#: Registers and stack slots of eight bytes that every kernel is called with; it ignores those that it does not declare.
SLOTS = 28
#: The builtins that kernels call, by the names that clang gives them, and a loop over the work-items.
BUILTINS = """
typedef unsigned int uint; typedef unsigned long ulong;
static ulong id[2], size[2];
#define BUILTIN(type, symbol, name, arguments, value) type name arguments __asm__(symbol); type name arguments { value }
BUILTIN(ulong, "_Z13get_global_idj", global_id, (uint axis), return axis < 2 ? id[axis] : 0;)
BUILTIN(ulong, "_Z15get_global_sizej", global_size, (uint axis), return axis < 2 ? size[axis] : 1;)
BUILTIN(float, "_Z13convert_floati", float_of_int, (int x), return (float)x;)
BUILTIN(float, "_Z13convert_floatj", float_of_uint, (uint x), return (float)x;)
BUILTIN(int, "_Z11convert_inti", int_of_int, (int x), return x;)
BUILTIN(unsigned short, "_Z14convert_ushorti", ushort_of_int, (int x), return (unsigned short)x;)
BUILTIN(int, "_Z15convert_int_rtzf", int_of_float, (float x), return (int)x;)
BUILTIN(float, "_Z3fmafff", fused, (float a, float b, float c), return __builtin_fmaf(a, b, c);)
BUILTIN(float, "_Z4sqrtf", root, (float x), return __builtin_sqrtf(x);)
BUILTIN(uint, "_Z6mul_hijj", high, (uint a, uint b), return (uint)((ulong)a * b >> 32);)
BUILTIN(uint, "_Z10atomic_addPU8CLglobalVjj", add, (uint *p, uint x), uint old = *p; *p = old + x; return old;)
BUILTIN(uint, "_Z10atomic_incPU8CLglobalVj", increment, (uint *p), uint old = *p; *p = old + 1; return old;)
BUILTIN(uint, "_Z9atomic_orPU8CLglobalVjj", either, (uint *p, uint x), uint old = *p; *p = old | x; return old;)
void run(void (*kernel)(SLOT_TYPES), ulong *a, ulong columns, ulong rows) {
    size[0] = columns; size[1] = rows;
    for (id[1] = 0; id[1] < rows; id[1]++) for (id[0] = 0; id[0] < columns; id[0]++) kernel(SLOT_VALUES);
}
""".replace("SLOT_TYPES", ", ".join(["ulong"] * SLOTS)).replace(
    "SLOT_VALUES", ", ".join(f"a[{slot}]" for slot in range(SLOTS))
)


def record(folder: Path) -> None:
    """Run the cases of the self-test here, and keep what each launch found in its buffers and left there."""
    import numpy as np
    import pyopencl as cl

    from mauvecl.device import build as program
    from mauvecl.device import launches
    from mauvecl.device.engine import Engine
    from mauvecl.device.selftest import CASES, COUNT, results

    recorded: list[dict[str, Any]] = []

    def launch(self: Any, name: str, items: tuple[int, ...], *arguments: Any) -> None:
        detection = launches.COMPARED if self.variant.compared else launches.DETECTION
        kernel_files = detection if name in (detection[1], "tally", "marginalise") else (name,)
        source = program.render(kernel_files, self.variant)

        def contents() -> list[bytes | None]:
            found: list[bytes | None] = []
            for one in arguments:
                if isinstance(one, cl.Buffer):
                    values = np.empty(one.size, np.uint8)
                    cl.enqueue_copy(self._queue, values, one)
                    self._queue.finish()
                found.append(values.tobytes() if isinstance(one, cl.Buffer) else None)
            return found

        before = contents()
        self._device.kernel(kernel_files, self.variant, name)(self._queue, items, None, *arguments)
        self._queue.finish()
        digest = hashlib.sha256(source.encode()).hexdigest()[:12]
        (folder / f"{digest}.cl").write_text(source, encoding="utf-8")
        arguments_kept = [id(one) if isinstance(one, cl.Buffer) else one.tobytes() for one in arguments]
        recorded.append({"case": case, "kernel": name, "source": digest, "items": [int(one) for one in items],
                         "arguments": arguments_kept, "before": before, "after": contents()})  # fmt: skip

    launches.Launches._launch = launch  # type: ignore[method-assign]
    engine = Engine(width=1)
    for case in CASES:
        results(engine, case, COUNT)
    (folder / "launches.pickle").write_bytes(pickle.dumps(recorded))


def compile_sources(folder: Path, target: str, clang: str, ld: str) -> None:
    """Compile the recorded sources and the builtins to shared objects for another processor."""
    fused = ["-mfma"] if target.startswith("x86_64") else []
    common = [clang, "-O2", "-ffp-contract=off", "-fPIC", *fused, "-target", target, "-c"]
    (folder / "builtins.c").write_text(BUILTINS, encoding="utf-8")
    subprocess.run([*common, "-fno-math-errno", folder / "builtins.c", "-o", folder / "builtins.o"], check=True)
    # Kernels become plain functions: clang knows no calling convention of kernels for most processors.
    opencl = ["-x", "cl", "-cl-std=CL1.2", "-cl-fp32-correctly-rounded-divide-sqrt", "-w", "-D__kernel="]
    for source in folder.glob("*.cl"):
        compiled = source.with_suffix(".o")
        subprocess.run([*common, *opencl, source, "-o", compiled], check=True)
        subprocess.run([ld, "-shared", "-o", source.with_suffix(".so"), compiled, folder / "builtins.o"], check=True)


def replay(folder: Path) -> int:
    """Run the recorded launches on this processor; return how many left other bits."""
    recorded = pickle.loads((folder / "launches.pickle").read_bytes())
    different = 0
    for one in recorded:
        library = ctypes.CDLL(str((folder / f"{one['source']}.so").resolve()))
        buffers: dict[int, Any] = {}
        slots = (ctypes.c_uint64 * SLOTS)()
        for slot, (argument, before) in enumerate(zip(one["arguments"], one["before"], strict=True)):
            if before is None:
                slots[slot] = int.from_bytes(argument, "little")
            else:
                buffer = buffers.setdefault(argument, ctypes.create_string_buffer(before, len(before)))
                slots[slot] = ctypes.addressof(buffer)
        kernel = ctypes.cast(getattr(library, one["kernel"]), ctypes.c_void_p)
        library.run(kernel, slots, *(ctypes.c_uint64(size) for size in (*one["items"], 1)[:2]))
        left = [
            after == buffers[a].raw
            for a, after in zip(one["arguments"], one["after"], strict=True)
            if after is not None
        ]
        different += not all(left)
    cases = len({one["case"] for one in recorded})
    print(f"{platform.machine()}: {len(recorded)} launches of {cases} cases, {different} leave other bits")
    return different


def main() -> int:
    """Do one of the steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("step", choices=("record", "compile", "replay"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--target", default=f"{platform.machine()}-linux-gnu")
    parser.add_argument("--clang", default="clang")
    parser.add_argument("--ld", default="ld")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    if given.step == "replay":
        return replay(given.folder)
    if given.step == "record":
        record(given.folder)
    else:
        compile_sources(given.folder, given.target, given.clang, given.ld)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
