"""The engine against the NumPy reference, its own splits and closed forms; its self-test fails on wrong kernels."""

import json
import os
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest
from answers import same
from commands import run, started
from marks import long_but
from processes import python
from reference import known_answers
from reference import statistics as numpy_kernels
from scenes import instrument, prepare, star

from mauvecl import Comparison, CosmicRays, Engine, Linear, Normal, PixelMap, Processes, Uniform
from mauvecl.detection import counts, requests
from mauvecl.device import build, drivers, selftest
from mauvecl.device.launches import scene_launches
from mauvecl.noise import layout, reference

RAYS = CosmicRays(rate_per_cm2_s=200.0)
PRIORS = Processes(
    jitter=Uniform(0.0, 0.05),
    detector_temperature=Uniform(13.0, 21.0),
    light_loss=Normal(0.34, 0.1, 0.1, 0.6),
    pointing_loss=Uniform(0.0, 0.05),
    qe_scale=Normal(1.0, 0.3, 0.4, 1.6),
)
#: Options of the noise model beyond those of the self-test, which runs every branch on equal pixels: a payload at each
#: end of its temperatures, a rail, quiet readouts, priors of every kind, uneven pixels.
CASES = {
    "stack": {},
    "cold": {"temperature_c": -30.0, "exposure": 5.0},
    "cold electrons": {"name": "mauve", "temperature_c": -20.0, "exposure": 10.0},
    "frames": {"exposure": 15.0, "mode": "frames"},
    "at the rail": {"exposure": 10.0, "magnitude": -0.7},
    "apart, quiet readout": {"read_noise_dn": 0.5, "name": "mauve", "exposure": 5.0, "magnitude": 14.0},
    "apart, electrons, frames": {"recipe": "apart", "name": "mauve", "exposure": 10.0, "mode": "frames"},
    "noiseless": {"read_noise_dn": 0.0, "dark_scale_dn_per_s": 0.0, "magnitude": 30.0, "exposure": 5.0},
    "uneven": {"pixel_map": PixelMap.made_up(2048, seed=5, hot_share=0.05)},
    "uneven, apart": {"pixel_map": PixelMap.made_up(2048, seed=5), "recipe": "apart", "temperature_c": -9.0,
                      "exposure": 5.0},
    "uneven, pairs of two ways": {"pixel_map": PixelMap.made_up(2048, seed=1), "read_noise_dn": 1.0,
                                  "temperature_c": 9.0, "exposure": 5.0},
    "cosmic rays, frames": {"processes": Processes(cosmic_rays=RAYS), "mode": "frames", "exposure": 10.0},
    "priors": {"processes": PRIORS},
    "priors, electrons, frames": {"processes": PRIORS, "name": "mauve", "mode": "frames", "exposure": 25.0},
    "jitter, one frame, rays": {"processes": Processes(cosmic_rays=RAYS, jitter=Uniform(0.0, 0.05)), "exposure": 5.0},
}  # fmt: skip
#: Cases and further options of the statistics: comparisons with noisy exposures and estimated variances, and
#: marginalised unknowns, of which the last is in `make test`.
COMPARED: list[tuple[str, dict[str, Any]]] = [
    ("uneven", {}),
    ("priors, electrons, frames", {}),
    ("stack", {"comparison": Comparison(1)}),
    ("stack", {"comparison": Comparison(0, True)}),
    ("at the rail", {"comparison": Comparison(2, True)}),
    ("apart, electrons, frames", {"comparison": Comparison(2, True)}),
    ("cold", {"nuisances": {"dark": 0.1, "light": 0.02, "tilt": float("inf")}}),
    ("stack", {"nuisances": {"dark": 0.1, "light": 0.02, "tilt": float("inf")}}),
]


def case(name: str) -> tuple[list, dict]:
    options = dict(CASES[name])
    how = {key: options.pop(key) for key in ("mode", "recipe", "processes") if key in options}
    exposure, magnitude = options.pop("exposure", 50.0), options.pop("magnitude", 7.4)
    payload = instrument(options.pop("name", "mauvesim"), part=True, **options)
    return star(magnitude=magnitude, amplitudes=(0.081, 0.24), exposure=exposure, payload=payload), how


@pytest.fixture(scope="module", params=["vectors", pytest.param("scalar", marks=pytest.mark.long)])
def any_width(request: pytest.FixtureRequest, engine: Engine, one_by_one: Engine) -> Engine:
    """Return the engine as CPUs run it, and as GPUs do, with one realisation per work-item."""
    return engine if request.param == "vectors" else one_by_one


#: Realisations that cross the boundary of the counter's first word.
START = 2**32 - 24
INDEX = np.arange(START, START + 40, dtype=np.uint64)
SEED = 2**63 + 12345


@cache
def _reference_raw(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Compute raw counts and each realisation's number of clipped samples with the reference, once for both widths."""
    (quiet, *_), how = case(name)
    scene = prepare([quiet], **how)
    return reference.realise(scene, INDEX, SEED), numpy_kernels.clipped(scene, INDEX, SEED).sum(axis=(1, 2))


@pytest.mark.parametrize("name", long_but(CASES, "stack", "apart, electrons, frames"))
def test_raw_spectra_equal_reference(any_width: Engine, name: str) -> None:
    """`make test` has a joint draw, and separate draws frame by frame."""
    (quiet, *_), how = case(name)
    raw, clipped = any_width.realise_and_count(quiet, start=START, count=INDEX.size, seed=SEED, **how)
    for ours, expected in zip((raw, clipped), _reference_raw(name), strict=True):
        np.testing.assert_array_equal(ours, expected)
    assert (raw.dtype == np.uint16) == (quiet.n_frames == 1)


@pytest.mark.long
def test_raw_sums_above_float32_integers_are_exact(engine: Engine) -> None:
    """Sum 400 frames that lose up to 48 000 DN each."""
    how = {"mode": "frames", "processes": Processes(light_loss=Uniform(0.0, 0.9))}
    quiet = selftest.toy(20, 400, light=90_000.0)
    raw, scene = engine.realise(quiet, count=40, seed=SEED, **how), prepare([quiet], **how)
    assert np.abs(raw - 400 * scene.base_dn[0]).max() > 2**24
    np.testing.assert_array_equal(raw, reference.realise(scene, np.arange(40, dtype=np.uint64), SEED))


@pytest.mark.parametrize(("name", "more"), long_but(COMPARED, COMPARED[-1]))
def test_statistics_equal_reference(any_width: Engine, name: str, more: dict[str, Any]) -> None:
    """Compare all statistics of two flares; the self-test compares their histograms and tallies as well."""
    (quiet, *flares), how = case(name)
    names: tuple[Any, ...] = tuple(requests.STATISTICS)
    if "nuisances" in more:
        # Of those that can be marginalised, `uv_excess` would be degenerate with a flat dark and the star's light.
        own = Linear("own", np.linspace(0.0, 1.0, quiet.wavelength_nm.size))
        names = (*(one for one in names if not requests.STATISTICS[one].paired and one != "uv_excess"), own)
    kind = {"statistics": names, "start": START, "seed": SEED, **how, **more}
    asked = requests.DetectRequest.of(quiet, tuple(flares), INDEX.size, **kind).hypotheses
    plan = requests.plan_channels(asked, range(len(flares)))
    sums = numpy_kernels.statistics(asked, plan, INDEX, SEED)
    values = any_width.statistic_values(quiet, flares, count=INDEX.size, **kind)
    np.testing.assert_array_equal(values, numpy_kernels.marginalise(sums, plan.subtractions))
    if "nuisances" in more:
        assert (values[0] < sums[0]).all(), "the subtraction changes the statistics"
    if more == {"comparison": Comparison(1)}:
        # Against one exposure, chi2 and chi2_pair differ only in the order of summation.
        np.testing.assert_allclose(values[0], values[2], rtol=1e-5)


def test_tally_counts_values_at_the_ends_of_its_bins(any_width: Engine) -> None:
    """Give the kernel values on each side of each end of the fine bins, which draws of chi2 seldom meet."""
    # Each stands once in a block of the kernel's loop and once after it; the host counts steps of the last bin.
    half, fine = layout.BINS // 2, 2**layout.FINE_BITS
    inner, end = (half - 1) * fine, half * fine
    # Halves are rounded to even steps.
    steps = [inner - 1, inner - 0.5, inner, -inner, -inner - 0.5, -inner - 1, end - 1, end, -end, -end - 1, 0]
    far = [np.nan, np.inf, -np.inf]
    values = np.array([*steps, *far, 0, 0, *steps, *far], np.float32)
    tally = counts.Tally(counts.grids_of([0], [0.0], [layout.STEPS_PER_SIGMA]))
    tile = any_width._tiles.at(0, values.size, 4096)
    with scene_launches(any_width.open_device, prepare([selftest.toy()]), 1) as launches:
        launches._named["values"] = launches.upload(np.resize(values, tile.size))
        launches.tally(tile, tally)
        launches.flush(tally)
    found, step = tally.distribution(0), np.rint(values)
    inside = step[(step >= -inner) & (step < inner)].astype(np.int64)
    np.testing.assert_array_equal(found.counts, np.bincount(inside // fine + half, minlength=layout.BINS))
    assert found.sums[:2] == (inside.sum(), (inside**2).sum())
    assert (found.n_far, found.undefined) == (values.size - inside.size - 6, 6)
    histogram, sums, outside = numpy_kernels.tally(values[None], tally.grids)
    np.testing.assert_array_equal(histogram[0, 1:-1], found.counts[1:-1])
    assert (*sums[0], outside[0]) == (*found.sums[:2], values.size - inside.size)


@pytest.mark.parametrize("tile", [16, 64, 1024, 4096])
def test_tile_size_does_not_affect_results(engine: Engine, tile: int) -> None:
    """Progress is reported before the first tile and after each, and may stop the work, after which others work."""
    (quiet, *flares), _ = case("stack")
    how = {"realisations": 3001, "start": 77, "seed": 6, "statistics": tuple(requests.STATISTICS)}
    tiled = Engine(tile=tile, progress=(seen := Mock()))
    same(tiled.detect(quiet, flares, **how), engine.detect(quiet, flares, **how))
    assert (seen.call_args_list[0], seen.call_args) == (call(0, 3001), call(3001, 3001))
    # Tiles end at multiples of their size, which is at least 64.
    assert seen.call_count == 2 + 3077 // max(tile, 64) - 77 // max(tile, 64)
    seen.side_effect = [KeyboardInterrupt, None, None]
    with pytest.raises(KeyboardInterrupt):
        tiled.realise(quiet, count=5000, seed=1)
    assert tiled.realise(quiet, count=3, seed=1).shape[0] == 3


@pytest.mark.long
def test_number_of_threads_does_not_affect_results(tmp_path: Path) -> None:
    for threads in ("1", "2"):
        words = f"detect -s G2V -m 7.4 -a 0.081,0.24 -n 20000 --fap 0.01 --no-pictures --output {threads}".split()
        started(*words, folder=tmp_path, POCL_MAX_PTHREAD_COUNT=threads)
    one, two = ((tmp_path / threads / "detection.ecsv").read_bytes() for threads in ("1", "2"))
    assert one == two


def test_flares_in_batches_equal_single_flares(engine: Engine) -> None:
    quiet, *flares = star(amplitudes=tuple(np.linspace(0.01, 0.3, 18)), payload=instrument(part=True))
    together = engine.detect(quiet, flares, realisations=2000, seed=8)
    for k in (0, 14, 15, 17):
        alone = engine.detect(quiet, [flares[k]], realisations=2000, seed=8)
        for statistic in ("chi2", "chi2_element", "matched"):
            for flare in (None, 0):
                wanted = alone.distribution(statistic, flare)
                ours = together.distribution(statistic, None if flare is None else k, template=k)
                np.testing.assert_array_equal(ours.counts, wanted.counts)


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
