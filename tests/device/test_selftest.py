"""The self-test passes on correct kernels and fails on wrong ones, for the strict and the weaker promise."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run
from reference import known_answers

from mauvecl import Engine
from mauvecl.device import build, drivers, selftest

WEAKER = "same draws to float rounding: no fused multiply-add"


def rendered_otherwise(monkeypatch: pytest.MonkeyPatch, change: Callable[[str], str]) -> None:
    """Change the source of kernels after rendering."""
    render = build.render

    def changed(rooms: tuple[str, ...], variant: build.Variant) -> str:
        source = render(rooms, variant)
        other = change(source)
        assert other != source
        return other

    monkeypatch.setattr(build, "render", changed)


def unfused(source: str) -> str:
    """Return the source for a device without fused multiply-add."""
    return source.replace("#define FMA(a, b, c) fused((a), (b), (c))", "#define FMA(a, b, c) ((a) * (b) + (c))")


def rough_roots(source: str) -> str:
    """Return the source for a device whose square roots err by some units in the last place."""
    return source.replace("floatv root(floatv a) { return ", "floatv root(floatv a) { return 1.0000003f * ")


def another_key_schedule(source: str) -> str:
    return source.replace("0x9E3779B9u", "0x9E3779BBu")


@pytest.mark.long
def test_self_test_passes(engine: Engine) -> None:
    """Pass on a correct device; limits of p = 1e-6 and 5 standard errors fail for one in 1e5 seeds."""
    reported: list[selftest.Check] = []
    checks = selftest.run(engine, reported.append)
    assert reported == checks
    assert len(checks) > 20
    assert [check.name for check in checks if not check.passed] == []


def test_known_answers_are_those_of_the_numpy_reference() -> None:
    stored, computed = selftest.known_arrays(), known_answers.every_result(selftest.COUNT)
    assert stored.keys() == computed.keys()
    for name, array in computed.items():
        assert stored[name].dtype == array.dtype
        np.testing.assert_array_equal(stored[name], array, name)


def few_cases(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Restrict the self-test to a few cases, since building their kernels is slow."""
    for cases in ("CASES", "STARE_CASES"):
        monkeypatch.setattr(selftest, cases, {k: v for k, v in getattr(selftest, cases).items() if k in names})


# A joint draw and separate ones; square roots, whose errors have one sign, need two cases.
@pytest.mark.long
@pytest.mark.parametrize(
    ("weakness", "cases"),
    [
        (unfused, ("stack", "priors, frames", "skewed stares")),
        (rough_roots, ("apart, tables", "marginalised, the sky unknown")),
    ],
)
def test_weaker_promise_is_checked_and_marked(
    monkeypatch: pytest.MonkeyPatch, weakness: Callable[[str], str], cases: tuple[str, ...]
) -> None:
    few_cases(monkeypatch, *cases)
    rendered_otherwise(monkeypatch, weakness)
    weak = Engine()
    strict = list(selftest.check_results(weak))
    assert not all(check.passed for check in strict), "a device that promises the same bits must give them"
    weak.open_device.record = replace(weak.device, promise=WEAKER)
    checks = list(selftest.check_results(weak))
    assert [check.name for check in checks if not check.passed] == []
    marked = [check for check in checks if "weaker promise" in check.result]
    assert len(marked) == sum(not check.passed for check in strict) > 0


@pytest.mark.long
def test_wrong_kernel_fails_both_promises(monkeypatch: pytest.MonkeyPatch) -> None:
    few_cases(monkeypatch, "stack")
    rendered_otherwise(monkeypatch, another_key_schedule)
    wrong = Engine()
    assert not selftest.known_answers(wrong).passed
    wrong.open_device.record = replace(wrong.device, promise=WEAKER)
    assert not any(check.passed for check in selftest.check_results(wrong))


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
    assert "PASS" in good
    assert "All 1 checks passed" in good
    kept = json.loads((tmp_path / "selftest.json").read_text())
    assert kept["passed"] is True
    assert kept["checks"][0]["name"] == "one thing"
    run("detect", "-n", "1000", "--fap", "0.1", "--no-pictures", "--output", tmp_path / "out", folder=tmp_path)
    assert json.loads((tmp_path / "out" / "run.json").read_text())["selftest"] == [kept]
    checks.append(selftest.Check("another", False, "wrong"))
    bad = run("selftest", "--quiet", folder=tmp_path, code=1).stdout
    assert "FAIL" in bad
    assert "1 of 2 checks FAILED" in bad
    assert json.loads(run("selftest", "--quiet", "--json", folder=tmp_path, code=1).stdout)["passed"] is False
