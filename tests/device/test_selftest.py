"""The self-test passes on correct kernels and fails on wrong ones; Oclgrind finds no race and no invalid access."""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run
from processes import python
from reference import known_answers

from mauvecl import Engine
from mauvecl.device import build, drivers, selftest

WEAKER = "same draws to float rounding: no fused multiply-add"


@pytest.mark.long
def test_self_test_passes(engine: Engine) -> None:
    """Pass on a correct device; limits of p = 1e-6 and 5 standard errors fail for one in 1e5 seeds."""
    reported = selftest.run(engine)
    assert len(reported) > 20
    assert [check.name for check in reported if not check.passed] == []


def test_known_answers_are_those_of_the_numpy_reference() -> None:
    stored, computed = selftest.known_arrays(), known_answers.every_result(selftest.COUNT)
    assert stored.keys() == computed.keys()
    for name, array in computed.items():
        assert stored[name].dtype == array.dtype
        np.testing.assert_array_equal(stored[name], array, name)


# Without fused multiply-add a joint draw and separate ones; square roots, whose errors have one sign, need two cases.
# Another key schedule is no weaker promise.
@pytest.mark.long
@pytest.mark.parametrize(("old", "new", "cases"), [
    ("#define FMA(a, b, c) fused((a), (b), (c))", "#define FMA(a, b, c) ((a) * (b) + (c))",
     ("stack", "priors, frames", "skewed stares")),
    ("floatv root(floatv a) { return ", "floatv root(floatv a) { return 1.0000003f * ",
     ("apart, tables", "marginalised, the sky unknown")),
    ("0x9E3779B9u", "0x9E3779BBu", ("stack",)),
], ids=["unfused", "rough roots", "wrong"])  # fmt: skip
def test_weaker_promise_is_checked_and_marked(monkeypatch: Any, old: str, new: str, cases: tuple[str, ...]) -> None:
    """Change a text in the kernels; the self-test has few cases, as builds are slow."""
    render = build.render

    def changed(rooms: tuple[str, ...], variant: build.Variant) -> str:
        source = render(rooms, variant)
        assert old in source
        return source.replace(old, new)

    monkeypatch.setattr(build, "render", changed)
    for kind in ("CASES", "STARE_CASES"):
        monkeypatch.setattr(selftest, kind, {k: v for k, v in getattr(selftest, kind).items() if k in cases})
    weak = Engine()
    strict = list(selftest.check_results(weak))
    assert not all(check.passed for check in strict), "a device that promises the same bits must give them"
    weak.open_device.record = replace(weak.device, promise=WEAKER)
    checks = list(selftest.check_results(weak))
    if cases == ("stack",):
        assert not selftest.known_answers(weak).passed
        assert not any(check.passed for check in checks)
        return
    assert [check.name for check in checks if not check.passed] == []
    marked = [check for check in checks if "weaker promise" in check.result]
    assert len(marked) == sum(not check.passed for check in strict) > 0


def test_device_without_strict_arithmetic_has_weaker_promise(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert "same bits" in run("devices", "--no-rate", folder=tmp_path).stdout.replace("\n", " ")
    monkeypatch.setattr(build, "weaknesses", lambda device: ["fused multiply-add"])
    (first, *_) = json.loads(run("devices", "--json", folder=tmp_path).stdout)
    assert first["promise"] == Engine().device.promise == WEAKER
    assert first["rate"] > 1e7


def test_selftest_command_reports_and_records_outcome(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check table, file, exit codes 0 and 1 (failed check), and the outcome in later run records."""
    # A separate store keeps these invented outcomes out of the user's; the working folder holds loaded kernels.
    monkeypatch.setattr(drivers.kernel_cache(), "store", tmp_path / "store")
    checks = [selftest.Check("one thing", True, "as it should be")]
    monkeypatch.setattr(selftest, "run", lambda engine: checks)
    good = run("selftest", "--quiet", "--output", tmp_path, folder=tmp_path).stdout
    assert all(words in good for words in ("PASS", "All 1 checks passed"))
    kept = json.loads((tmp_path / "selftest.json").read_text())
    assert (kept["passed"], kept["checks"][0]["name"]) == (True, "one thing")
    run("detect", "-n", "1000", "--fap", "0.1", "--no-pictures", "--output", tmp_path / "out", folder=tmp_path)
    assert json.loads((tmp_path / "out" / "run.json").read_text())["selftest"] == [kept]
    checks.append(selftest.Check("another", False, "wrong"))
    bad = run("selftest", "--quiet", folder=tmp_path, code=1).stdout
    assert all(words in bad for words in ("FAIL", "1 of 2 checks FAILED"))
    assert json.loads(run("selftest", "--quiet", "--json", folder=tmp_path, code=1).stdout)["passed"] is False


ICD = next(
    (path for root in ("/usr/lib", "/usr/local/lib") for path in Path(root).rglob("liboclgrind-rt-icd.so")), None
)
KERNELS = """
import sys
import numpy as np
from reference import known_answers
from mauvecl import Engine
from mauvecl.device import selftest
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


def under_oclgrind(code: str, folder: Path, *arguments: str) -> tuple[str, str]:
    """Run Python with Oclgrind as an OpenCL device; return what it prints and its log, since its exit code is 0."""
    (folder / "oclgrind.icd").write_text(f"{ICD}\n")
    log = folder / "log"
    settings = {"OCL_ICD_VENDORS": str(folder), "OCLGRIND_DATA_RACES": "1", "OCLGRIND_LOG": str(log)}
    said = python(code, *arguments, PYTHONPATH=os.pathsep.join(sys.path), **settings).stdout
    return said, log.read_text() if log.exists() else ""


@pytest.mark.long
@pytest.mark.skipif(ICD is None, reason="Oclgrind is not installed (Debian: apt-get install oclgrind)")
@pytest.mark.parametrize("width", ["16", "1"])
def test_kernels_have_no_races_or_invalid_accesses_and_equal_reference(tmp_path: Path, width: str) -> None:
    said, log = under_oclgrind(KERNELS, tmp_path, width)
    assert int(said.split()[-1]) >= (24 if width == "16" else 10)
    assert log == ""
    assert "data race" in under_oclgrind(RACE, tmp_path)[1].lower(), "a race would be in the log"
