"""Every kernel under Oclgrind, which simulates a device and detects races and invalid memory accesses."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ICD = next(
    (path for root in ("/usr/lib", "/usr/local/lib") for path in Path(root).rglob("liboclgrind-rt-icd.so")), None
)
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(ICD is None, reason="Oclgrind is not installed (Debian: apt-get install oclgrind)"),
]

KERNELS = """
import sys
import numpy as np
from reference import known_answers
from mauvecl.device import selftest
from mauvecl.device.engine import Engine
from probes import Probes
from mauvecl.noise import layout

width = int(sys.argv[1])
# Cross the counter's boundary with three work-items; at width 1, sixteen realisations suffice and take half the time.
count = 40 if width > 1 else 16
engine = Engine("Oclgrind", width=width)
# Cases that access the same memory as others are left out: their results are tested with PoCL. At width 1 one case of
# each draw and comparison remains.
few = {"apart, tables", "estimated variances", "marginalised, the sky unknown"}
many = set(selftest.CASES) - {"one frame", "fourth power", "apart", "priors, fourth power"}
for name in sorted((many if width > 1 else few) | set(selftest.STARE_CASES)):
    theirs = known_answers.results(name, count)
    for part, ours in selftest.results(engine, name, count).items():
        np.testing.assert_array_equal(ours, theirs[part], f"{name}, {part}")
probes = Probes(device=engine.open_device)
words = np.arange(160, dtype=np.uint32) * np.uint32(0x9E3779B9)
assert selftest.known_answers(engine).passed
probes.normal(words, words[::-1].copy())
probes.expansion(words, words[::-1].copy(), 2225.0)
probes.alias(words, np.zeros(16, np.uint32), 4)
ends = np.repeat(np.array([0, 1, 2**31 - 1, 2**31, 2**32 - 1], np.uint32), 32)
probes.prior(ends, ~ends, np.zeros(2 * layout.PRIOR_NODES, np.float32))
print("kernels", len(engine.open_device._programs))
"""

RACE = """
import numpy as np
import pyopencl as cl
platform = next(p for p in cl.get_platforms() if p.name == "Oclgrind")
context = cl.Context(platform.get_devices())
queue = cl.CommandQueue(context)
source = "__kernel void race(__global int *a) { a[0] += get_global_id(0); }"
buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE, 4)
cl.Program(context, source).build().race(queue, (64,), None, buffer)
queue.finish()
"""


def under_oclgrind(code: str, folder: Path, *arguments: str) -> tuple[subprocess.CompletedProcess, str]:
    """Run Python with Oclgrind as an OpenCL device and return its log, since its exit code is always 0."""
    (folder / "oclgrind.icd").write_text(f"{ICD}\n")
    log = folder / "log"
    environment = os.environ | {"OCL_ICD_VENDORS": str(folder), "OCLGRIND_DATA_RACES": "1", "OCLGRIND_LOG": str(log)}
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    run = subprocess.run([sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True)
    return run, log.read_text() if log.exists() else ""


@pytest.mark.parametrize("width", ["16", "1"])
def test_kernels_have_no_races_or_invalid_accesses_and_equal_reference(tmp_path: Path, width: str) -> None:
    run, log = under_oclgrind(KERNELS, tmp_path, width)
    assert run.returncode == 0, run.stderr
    assert int(run.stdout.split()[-1]) >= (24 if width == "16" else 10)
    assert log == ""


def test_race_is_detected(tmp_path: Path) -> None:
    run, log = under_oclgrind(RACE, tmp_path)
    assert run.returncode == 0, run.stderr
    assert "data race" in log.lower()
