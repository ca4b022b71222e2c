"""Instructions per pixel-realisation, counted from the compiled kernel, and the share of the machine's peak reached.

    python bench/roofline.py [--output bench/results/roofline.ecsv] [--picture docs/images/roofline.png]

For PoCL on a processor with AVX-512. The statistics kernel spends its time in three innermost loops: words of the
generator, normals, and statistics; each turn of them serves a known number of vectors of 16 pixel-realisations. Their
instructions are counted by kind. The peak is measured: independent fused multiply-adds on 512-bit vectors, and a copy
that does not fit the caches.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import time
from pathlib import Path

import numpy as np
from astropy.table import Table
from rates import engine_lines
from tables import write

from mauvecl import Engine
from mauvecl.device.build import VECTORS
from mauvecl.device.drivers import kernel_cache

PEAK = """
typedef float float16_;
__kernel void peak(const uint turns, __global float *out)
{
    float16 a[24];
    for (int i = 0; i < 24; i++) a[i] = (float16)(i + get_global_id(0));
    const float16 b = (float16)(0.999f), c = (float16)(0.001f);
    for (uint t = 0; t < turns; t++) {
#pragma unroll
        for (int i = 0; i < 24; i++)
            a[i] = __builtin_ia32_vfmaddps512_mask(a[i], b, c, (unsigned short)0xffff, 4);
    }
    float16 sum = 0;
    for (int i = 0; i < 24; i++) sum += a[i];
    out[get_global_id(0)] = sum.s0 + sum.s7;
}
"""
#: Vectors of 16 pixel-realisations that one turn of each loop serves, in the order of the code.
LOOPS = (("words", 8), ("normals", 8), ("statistic", 4 * VECTORS))


def peak_rate(engine: Engine, turns: int = 3_000_000) -> float:
    """Measure the 512-bit fused multiply-adds per second of the whole device."""
    cl, items = engine.open_device.cl, engine.device.compute_units
    kernel = cl.Kernel(cl.Program(engine.open_device.context, PEAK).build(), "peak")
    out = cl.Buffer(engine.open_device.context, cl.mem_flags.READ_WRITE, 4 * items)
    seconds = []
    for _ in range(7):
        start = time.perf_counter()
        kernel(engine.open_device.queue, (items,), (1,), np.uint32(turns), out)
        engine.open_device.queue.finish()
        seconds.append(time.perf_counter() - start)
    return items * turns * 24 / float(np.median(seconds))


def copy_rate() -> float:
    """Measure the bytes written per second by a copy far larger than the caches."""
    source = np.ones(2**28, np.uint8)
    target, seconds = np.empty_like(source), []
    for _ in range(7):
        start = time.perf_counter()
        np.copyto(target, source)
        seconds.append(time.perf_counter() - start)
    return source.size / float(np.median(seconds))


def innermost_loops(library: Path, function: str) -> list[list[str]]:
    """Return the instructions of each innermost loop, in the order of the code."""
    text = subprocess.run(
        ["objdump", "-d", "--no-show-raw-insn", str(library)], capture_output=True, text=True, check=True
    ).stdout
    body = re.search(rf"<{function}>:\n(.*?)\n\n", text + "\n\n", re.DOTALL)
    if body is None:
        raise SystemExit(f"{library.name} holds no {function}")
    rows = [line.split("\t") for line in body[1].splitlines() if "\t" in line]
    address = [int(row[0].strip().rstrip(":"), 16) for row in rows]
    code = [row[1].strip() for row in rows]
    loops = []
    for i, one in enumerate(code):
        jump = re.match(r"j\w+\s+([0-9a-f]+)", one)
        if jump and int(jump[1], 16) in address and address.index(int(jump[1], 16)) <= i:
            loops.append((address.index(int(jump[1], 16)), i))
    inner = [a for a in loops if not any(b != a and a[0] <= b[0] and b[1] <= a[1] for b in loops)]
    return [code[a : b + 1] for a, b in sorted(inner)]


def kinds(code: list[str]) -> dict[str, int]:
    """Count the instructions of a loop by kind."""
    found = {"arithmetic": 0, "moves": 0, "scalar": 0}
    for one in code:
        name = one.split()[0]
        if "mm" not in one:
            found["scalar"] += 1
        elif name.startswith(("vmov", "vbroadcast")):
            found["moves"] += 1
        else:
            found["arithmetic"] += 1
    return found


def main() -> None:
    """Print the table, write it and draw it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    here = Path(__file__).parent
    parser.add_argument("--output", type=Path, default=here / "results" / "roofline.ecsv")
    parser.add_argument("--picture", type=Path, default=here.parent / "docs" / "images" / "roofline.png")
    options = parser.parse_args()
    engine = Engine()
    chi2, _, _, many, _, frames, _ = engine_lines(engine)
    chi2.run(64)
    found = list(kernel_cache().work.rglob("statistics.so"))
    if len(found) != 1:
        raise SystemExit(f"expected one compiled statistics kernel, found {len(found)}")
    loops = innermost_loops(found[0], "_pocl_kernel_statistics_workgroup_fast")
    # Initialisation and output have short ones.
    largest = sorted(sorted(loops, key=len)[-3:], key=loops.index)
    rows = []
    for (name, vectors), code in zip(LOOPS, largest, strict=True):
        rows.append((name, len(code), vectors, *(count / vectors for count in kinds(code).values())))
    table = Table(rows=rows, names=("loop", "instructions", "vectors", "arithmetic", "moves", "scalar"))
    table["vectors"].info.description = "of 16 pixel-realisations that a turn serves"
    for name in ("arithmetic", "moves", "scalar"):
        table[name].info.format = ".1f"
        table[name].info.description = "instructions per vector; moves are loads, stores, broadcasts and copies"
    for line in (chi2, many, frames):
        line.run(64)
        for _ in range(9):
            line.measure()
    pixels = 1643
    peak, copy = peak_rate(engine), copy_rate()
    draw, statistic = table["arithmetic"][0] + table["arithmetic"][1], table["arithmetic"][2]
    every = sum(table[name].sum() for name in ("arithmetic", "moves", "scalar"))
    one = chi2.rate(pixels)
    sixteen = many.rate(pixels)
    table.meta = {
        "device": engine.device_name,
        "driver": engine.driver,
        "peak_vector_operations_per_s": float(f"{peak:.3g}"),
        "copy_bytes_per_s": float(f"{copy:.3g}"),
        "instructions_per_pixel_realisation": round(every / 16, 2),
        "chi2_rate": float(f"{one:.3g}"),
        "chi2_share_of_peak": round(one / 16 * (draw + statistic) / peak, 2),
        "sixteen_scenarios_rate": float(f"{sixteen:.3g}"),
        "sixteen_scenarios_share_of_peak": round(sixteen / 16 * (draw / 16 + statistic) / peak, 2),
        "frames_rate": float(f"{frames.rate(pixels):.3g}"),
        "frames_share_of_copy": round(2 * frames.rate(pixels) / copy, 2),
    }
    write(table, options.output)
    for key, value in table.meta.items():
        print(f"{key}: {value}")
    points = [
        ("chi2, one scenario", draw + statistic, 4 / pixels, one),
        ("chi2, 16 scenarios", draw / 16 + statistic, 4 / pixels, sixteen),
        ("16-bit frames", draw + statistic, 2.0, frames.rate(pixels)),
    ]
    picture(options.picture, points, peak, copy)


def picture(path: Path, points: list[tuple[str, float, float, float]], peak: float, copy: float) -> None:
    """Plot vector operations per second against vector operations per byte to memory, with both ceilings."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.8), layout="constrained")
    axes = figure.add_subplot()
    x = np.geomspace(0.3, 3e3, 200)
    axes.loglog(x, np.minimum(peak, copy * x), color="black", label="ceilings: copy, fused multiply-adds")
    for (name, operations, nbytes, rate), marker, colour in zip(
        points, "osD", ("#0072B2", "#D55E00", "#009E73"), strict=True
    ):
        per_second = rate / 16 * operations
        axes.plot(operations / (16 * nbytes), per_second, marker, color=colour, label=f"{name}: {rate:.1e} /s")
    axes.set(
        xlabel="512-bit operations per byte moved to memory",
        ylabel="512-bit operations per second",
        title="Statistics kernel under the ceilings of its processor",
    )
    axes.legend(frameon=False, fontsize=8, loc="lower right")
    axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main()
