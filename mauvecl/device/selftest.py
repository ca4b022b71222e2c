"""Self-test of a device against known answers, the NumPy reference, probabilities and closed forms."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.detection import reference as numpy_kernels
from mauvecl.detection.counts import Tally
from mauvecl.detection.nuisances import as_nuisances
from mauvecl.detection.requests import STATISTICS, ChannelPlan, Hypotheses, plan_channels
from mauvecl.detection.snr import Counts, elements, observers
from mauvecl.device.engine import Engine
from mauvecl.device.probes import Probes
from mauvecl.device.program import SAME_BITS
from mauvecl.device.selftest_outcome import Check
from mauvecl.device.selftest_stares import stares
from mauvecl.device.toy_exposure import toy
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.noise import layout, reference
from mauvecl.noise.comparison import Comparison
from mauvecl.noise.processes import CosmicRays, Processes, Uniform
from mauvecl.noise.scene import Scene, prepare

if TYPE_CHECKING:
    pass

#: Probability that a statistical check fails on a correct device.
FALSE_FAILURE_PROBABILITY = 1e-6

#: Known answers of Random123: counter, key, output.
PHILOX_VECTORS = (
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
)


_RAYS = CosmicRays(rate_per_cm2_s=300.0)
#: Small scenes that run every branch of every kernel: options of `toy`, and of the draw and comparison.
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "stack": ({}, {}),
    "one frame": ({"frames": 1, "unit": "electrons", "photon_noise": "poisson"}, {}),
    "fourth power": ({"frames": 1, "dark": 288.0}, {}),
    "frames at the rail": ({"frames": 3, "light": 107_000.0}, {}),
    "apart": ({}, {"recipe": "apart"}),
    "apart, tables": ({"frames": 2, "dark": 30.0, "read": 0.4, "photon_noise": "poisson"}, {"mode": "frames"}),
    "apart, pairs of two ways": ({"frames": 1, "read": 1.0, "light": 1000.0, "photon_noise": "poisson"}, {}),
    "cosmic rays": ({}, {"processes": Processes(cosmic_rays=_RAYS)}),
    "noisy references": ({"frames": 4}, {"comparison": Comparison(3)}),
    "estimated variances": ({"frames": 2}, {"mode": "frames", "comparison": Comparison(1, estimated=True)}),
    "priors": (
        {"frames": 5},
        {
            "processes": Processes(
                cosmic_rays=_RAYS,
                jitter=Uniform(0.0, 0.05),
                detector_temperature=Uniform(13.0, 21.0),
                light_loss=Uniform(0.24, 0.44),
            )
        },
    ),
    "priors, fourth power": ({"frames": 1, "dark": 288.0}, {"processes": Processes(jitter=Uniform(0.0, 0.05))}),
    "priors, frames": (
        {"frames": 5, "photon_noise": "poisson"},
        {
            "mode": "frames",
            "processes": Processes(jitter=Uniform(0.0, 0.05), detector_temperature=Uniform(13.0, 21.0)),
        },
    ),
    "marginalised, the sky unknown": (
        {"frames": 5},
        {
            "processes": Processes(jitter=Uniform(0.0, 0.05), sky_level=Uniform(0.5, 1.5)),
            "nuisances": {"dark": 0.1, "light": 0.02, "tilt": float("inf")},
        },
    ),
}
#: Statistics of the fast kernel, which compares with the expectation only.
FAST = tuple(name for name, one in STATISTICS.items() if not one.paired)
#: Realisations that cross the boundary of the counter's first word.
START, COUNT, SEED = 2**40 - 13, 40, 2**63 + 20_261_121


def digests(engine: Engine, name: str) -> dict[str, str]:
    """Return short digests of a device's raw counts, statistics and histograms for a case."""
    options, how = CASES[name]
    quiet, flare = toy(**options), toy(flare=0.3, **options)
    place: dict[str, Any] = {"start": START, "seed": SEED}
    raw, clipped = engine.realise_and_count(quiet, count=COUNT, **place, **_drawing(how))
    seen = engine.snr(quiet, realisations=COUNT, **place, **_drawing(how))
    values, fast = (
        engine.statistic_values(quiet, [flare], count=COUNT, statistics=names, **place, **how)
        for names in (_statistics_of(how), _statistics_of(how, FAST))
    )
    detection = engine.detect(quiet, [flare], realisations=COUNT, statistics=_statistics_of(how, FAST), **place, **how)
    null = detection.distribution("chi2")
    return {
        "raw": _digest(raw.astype(np.int64), clipped),
        "statistics": _digest(values.view(np.uint32)),
        "fast statistics": _digest(fast.view(np.uint32)),
        "histograms": _histograms(seen.counts),
        "tally": _digest(null.counts, np.array([null.first, null.second]), null.far.keys, null.far.counts),
    }


def reference_digests(name: str) -> dict[str, str]:
    """Return the digests that the NumPy reference gives for a case."""
    options, how = CASES[name]
    quiet, flare = toy(**options), toy(flare=0.3, **options)
    scene, index = prepare([quiet], **_scene_options(how)), np.arange(START, START + COUNT, dtype=np.uint64)
    both = prepare([quiet, flare], **_scene_options(how))
    raw = reference.realise(scene, index, SEED)
    clipped = reference.clipped(scene, index, SEED)
    seen = numpy_kernels.histograms(scene, observers(quiet, scene), elements(quiet), index, SEED)
    values, plan = _statistics(name, both)
    tally = Tally(plan.grids[plan.keys.index(("chi2", "null", 0)) :][:1])
    counts, sums, _ = numpy_kernels.tally(values, tally.packed)
    tally.add(counts, sums, COUNT)
    tally.add_far(0, values[tally.grids[0].channel])
    null = tally.distribution(0)
    return {
        "raw": _digest(raw.astype(np.int64), clipped.sum(axis=(1, 2)).astype(np.uint32)),
        "statistics": _digest(values.view(np.uint32)),
        "fast statistics": _digest(_fast(values, plan).view(np.uint32)),
        "histograms": _histograms(seen),
        "tally": _digest(null.counts, np.array([null.first, null.second]), null.far.keys, null.far.counts),
    }


def _statistics(name: str, scene: Scene) -> tuple[NDArray[np.float32], ChannelPlan]:
    """Compute every statistic of a case with the NumPy reference; return values and the plan of their channels."""
    options, how = CASES[name]
    quiet, flare = toy(**options), toy(flare=0.3, **options)
    unknown = as_nuisances(how.get("nuisances"), quiet)
    hypotheses = Hypotheses(quiet, (flare,), _statistics_of(how), scene, nuisances=unknown)
    plan = plan_channels(hypotheses, range(1), first=True)
    index = np.arange(START, START + COUNT, dtype=np.uint64)
    smoothed = numpy_kernels.Smoothed.of(hypotheses, plan) if len(plan.scales) else None
    paired = "chi2_pair" in _statistics_of(how)
    sums = numpy_kernels.statistics(scene, index, SEED, plan, pair=paired, smoothed=smoothed)
    return numpy_kernels.marginalise(sums, plan.subtractions), plan


def _drawing(how: dict[str, Any]) -> dict[str, Any]:
    """Return the options of the draw, without those of the comparison."""
    return {key: value for key, value in how.items() if key not in ("comparison", "nuisances")}


def _scene_options(how: dict[str, Any]) -> dict[str, Any]:
    """Return the options that `prepare` accepts."""
    return {key: value for key, value in how.items() if key != "nuisances"}


def _statistics_of(how: dict[str, Any], names: tuple[str, ...] = tuple(STATISTICS)) -> tuple[str, ...]:
    """Return the statistics of a case; if it marginalises, only those that support this."""
    return tuple(n for n in names if STATISTICS[n].marginal) if "nuisances" in how else names


def _fast(values: NDArray[np.float32], plan: ChannelPlan) -> NDArray[np.float32]:
    """Select the channels of the fast kernel, with zeros for statistics that it does not compute."""
    known = values[: plan.n_rows - len(plan.scales)].copy()
    known[[2, 5]] = 0.0
    return known


def _histograms(counts: Counts) -> str:
    far = (array for each in counts.far.values() for array in (each.keys, each.counts))
    return _digest(counts.pixel, counts.element, counts.clipped, *far)


def _digest(*arrays: NDArray[Any]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:12]


def known_answers(engine: Engine) -> Check:
    """Compare Philox on the device with Random123's vectors."""
    counters, keys, answers = (np.array([row[i] for row in PHILOX_VECTORS], np.uint32) for i in range(3))
    out = Probes(device=engine.open_device).philox(counters, keys)
    right = np.array_equal(out[:, :4], answers) and np.array_equal(out[:, 4:], answers)
    return Check("Philox4x32-10, known answers", right, f"{len(PHILOX_VECTORS)} vectors of Random123")


def check_against_reference(engine: Engine) -> Iterator[Check]:
    """Compare every branch of every kernel with the NumPy reference."""
    for name in CASES:
        ours, slow = digests(engine, name), reference_digests(name)
        differ = [part for part in ours if ours[part] != slow[part]]
        if not differ:
            passed, text = True, "digests " + " ".join(ours.values())
        elif engine.device.promise == SAME_BITS:
            passed, text = False, f"{', '.join(differ)} differ from the reference's"
        else:
            passed, text = _check_weaker_promise(engine, name)
        yield Check(f"same bits as the NumPy reference: {name}", passed, text)


def _check_weaker_promise(engine: Engine, name: str) -> tuple[bool, str]:
    """Check the weaker promise of devices without strict arithmetic.

    Fewer than 1 % of the counts differ from the reference's, by 1 DN, and statistics by less than 0.2 of their standard
    deviation.
    """
    options, how = CASES[name]
    quiet, flare = toy(**options), toy(flare=0.3, **options)
    index = np.arange(START, START + COUNT, dtype=np.uint64)
    raw = engine.realise(quiet, start=START, count=COUNT, seed=SEED, **_drawing(how)).astype(np.int64)
    off = np.abs(raw - reference.realise(prepare([quiet], **_scene_options(how)), index, SEED))
    share = float(np.mean(off > 0))
    ours = engine.statistic_values(
        quiet, [flare], start=START, count=COUNT, seed=SEED, statistics=_statistics_of(how), **how
    )
    slow = _statistics(name, prepare([quiet, flare], **_scene_options(how)))[0]
    apart = float(np.max(np.abs(ours - slow).max(axis=1) / np.maximum(slow.std(axis=1), 1e-3)))
    return (
        bool(off.max() <= 1 and share < 1e-2 and apart < 0.2),
        f"weaker promise: {share:.2g} of counts off, by {off.max()} DN at most; statistics by {apart:.2g} sigma",
    )


def pearson(counts: NDArray[np.int64], probability: NDArray[np.float64]) -> float:
    """Return the two-sided p-value of Pearson's statistic, with rare outcomes in one bin."""
    n = counts.sum()
    expected = n * probability
    common = expected > 20
    observed = np.append(counts[common], counts[~common].sum())
    wanted = np.append(expected[common], n - expected[common].sum())
    if wanted[-1] < 20:
        observed, wanted = observed[:-1], wanted[:-1]
    statistic = float(np.sum((observed - wanted) ** 2 / wanted))
    upper = float(special.chdtrc(observed.size - 1, statistic))
    return 2 * min(upper, 1 - upper)


def counts_of(engine: Engine, x: Expectation, realisations: int, recipe: Any) -> tuple[NDArray[np.int64], int]:
    """Return the histogram of raw counts over all pixels, which are equal, and the count of its first bin."""
    signal = engine.snr(x, realisations=realisations, seed=SEED, recipe=recipe)
    first = int(signal.scene.base_dn[0, 0]) - layout.OBSERVER_BINS // 2
    return signal.counts.pixel.sum(axis=0), first


def exact_counts(x: Expectation, first: int) -> NDArray[np.float64]:
    """Return the bins' probabilities for Poisson dark, Gaussian read and photon noise, and rounding."""
    mean, step = x.dark_dn[0], x.dark_step_dn[0]
    sd = float(np.sqrt(x.read_noise_dn[0] ** 2 + x.gain_dn_per_electron[0] * x.recorded_light_dn[0] / x.n_frames))
    expected = mean / step
    reach = 9.0 * np.sqrt(expected) + 20.0
    k = np.arange(max(int(expected - reach), 0), int(expected + reach))
    p = np.exp(special.xlogy(k, expected) - expected - special.gammaln(k + 1.0))
    edges = first + np.arange(layout.OBSERVER_BINS + 1) - 0.5
    offset = x.bias_dn[0] + x.recorded_light_dn[0] / x.n_frames
    u = (edges[:, None] - offset - step * k[None, :]) / sd
    below, above = special.ndtr(u) @ p, special.ndtr(-u) @ p
    return np.asarray(np.where(below[1:] < 0.5, np.diff(below), -np.diff(above)))


def chance(engine: Engine) -> Iterator[Check]:
    """Test raw counts of every recipe with Pearson's statistic."""
    for title, dark, read, recipe in (
        ("joint draw, dark of 2225", 2225.0, 12.0, "joint"),
        ("joint draw, dark of 30", 30.0, 12.0, "joint"),
        ("alias table, dark of 64", 64.0, 0.8, "apart"),
        ("expansion, dark of 2225", 2225.0, 0.8, "apart"),
    ):
        x = toy(512, 1, dark=dark, read=read, light=0.0)
        counts, first = counts_of(engine, x, 100_000, recipe)
        p = pearson(counts, exact_counts(x, first))
        passed = bool(p > FALSE_FAILURE_PROBABILITY)
        yield Check(f"Pearson, {title}", passed, f"p = {p:.3g} of {counts.sum():.2g} counts")


def closed_forms(engine: Engine) -> Iterator[Check]:
    """Compare S/N and statistics with their closed forms, in standard errors."""
    n = 40_000
    quiet, flare = toy(256), toy(256, flare=0.4)
    table = engine.snr(quiet, realisations=n, seed=SEED).element
    z = (table["mean"] - table["expected"]) / table["std"]
    # The curvature of the square root biases the mean by about noise / (8 signal) of an element, 2 % here.
    worst = float(np.abs(z).max())
    yield Check("S/N per element, closed form", bool(worst < 0.03 + 5 / np.sqrt(n)), f"means within {worst:.3f} sigma")
    detection = engine.detect(quiet, [flare], realisations=n, seed=SEED, statistics=tuple(STATISTICS))
    for statistic in STATISTICS:
        for which in (None, 0):
            ours, theory = detection.distribution(statistic, which), detection.closed_form(statistic, which)
            error = (ours.mean - theory.mean) / (theory.std / np.sqrt(n))
            name = f"{statistic}, mean {'with a flare' if which is not None else 'without'}"
            yield Check(f"{name}, closed form", bool(abs(error) < 5), f"{error:+.1f} standard errors")


def tiles(engine: Engine) -> Check:
    """Compare realisations drawn at once with the same ones drawn in pieces."""
    quiet = toy()
    whole = engine.realise(quiet, start=0, count=500, seed=SEED)
    parts = [engine.realise(quiet, start=a, count=b - a, seed=SEED) for a, b in ((0, 1), (1, 77), (77, 500))]
    return Check("same bits in pieces", bool(np.array_equal(whole, np.concatenate(parts))), "500 realisations in 3")


def run(engine: Engine, report: Callable[[Check], None] = lambda check: None) -> list[Check]:
    """Run all checks and call `report` with each outcome."""
    checks: list[Check] = []

    def note(check: Check) -> None:
        checks.append(check)
        report(check)

    note(known_answers(engine))
    for group in (
        check_against_reference(engine),
        stares(engine, START, COUNT, SEED),
        chance(engine),
        closed_forms(engine),
    ):
        for check in group:
            note(check)
    note(tiles(engine))
    return checks
