"""Self-test of a device against known answers of the NumPy reference and closed forms, and its speed."""

from __future__ import annotations

import contextlib
import hashlib
import resource
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.detection.counts import FAR, Distribution
from mauvecl.detection.requests import STATISTICS
from mauvecl.detection.snr import Counts
from mauvecl.device import drivers
from mauvecl.device.build import SAME_BITS, choose_device
from mauvecl.device.drivers import DeviceError
from mauvecl.device.engine import Engine, devices
from mauvecl.device.stares import Stares
from mauvecl.flares.frames import Components
from mauvecl.flares.stare import Stare
from mauvecl.flares.stare_scene import StaresRequest
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.noise import layout, reference
from mauvecl.noise.disturbances import CosmicRays, Uniform
from mauvecl.noise.scene import prepare
from mauvecl.noise.unknowns import NONE, Comparison, Processes
from mauvecl.schema.columns import Column


@dataclass(frozen=True)
class Check:
    """Outcome of one check, a line of the table."""

    name: str
    passed: bool
    result: str


CHECK_COLUMNS = (
    Column("passed", heading="result", format=lambda passed: "PASS" if passed else "FAIL"),
    Column("name", heading="check"),
    Column("result", heading="found"),
)


def toy(
    pixels: int = 64, frames: int = 10, *, flare: float = 0.0, dark: float = 2225.0, read: float = 12.0,
    light: float = 40.0, unit: Any = "DN", photon_noise: Any = "gaussian",
) -> Expectation:  # fmt: skip
    """Return a small exposure of a smooth spectrum on a uniform detector; dark in DN, light in electrons per frame."""
    shape = light * (1.0 + 0.5 * np.sin(np.arange(pixels) / 9.0))
    uniform = np.ones(pixels)
    element = np.arange(pixels, dtype=np.int32) // 10
    return Expectation(
        wavelength_nm=np.arange(200.0, 200.0 + pixels),
        source_electrons=shape * (1.0 + flare * np.linspace(1.0, 0.2, pixels)),
        sky_electrons=0.4 * uniform,
        dark_dn=dark * uniform,
        dark_unit=unit,
        bias_dn=600.0 * uniform,
        read_noise_dn=read * uniform,
        gain_dn_per_electron=0.6 * uniform,
        n_frames=frames,
        frame_s=5.0,
        element=element,
        element_wavelength_nm=205.0 + 10.0 * np.arange(element[-1] + 1),
        adc_max_dn=65_535,
        saturation_dn=59_578.0,
        name="toy",
        instrument="toy",
        provenance={},
        photon_noise=photon_noise,
        conditions={"temperature_c": 21.0, "dark_slope_per_c": 0.0684, "light_loss": 0.34, "pointing_loss": 0.0},
    )


PIXELS = 1600
#: Shortest measurement of a rate, s.
RATE_S = 0.125


def chi2_rate(engine: Engine) -> float:
    """Measure chi2's pixel-realisations per second, for a quiescent and a flaring scenario on common draws."""
    quiet, flare = toy(PIXELS), toy(PIXELS, flare=0.1)

    def work(count: int) -> float:
        start = time.perf_counter()
        engine.detect(quiet, [flare], realisations=count, seed=1, statistics=("chi2",))
        return time.perf_counter() - start

    # The first call builds the kernels.
    work(64)
    count = 256
    while (spent := work(count)) < RATE_S:
        count *= 4
    return count * PIXELS / min(spent, work(count))


DEVICE_COLUMNS = (
    Column("number", heading="number"),
    Column("platform", heading="device", format=lambda platform, name: f"{platform}: {name}", others=("name",)),
    Column("driver", heading="driver"),
    Column("kind", heading="kind"),
    Column("compute_units", heading="units"),
    Column("global_memory", unit="byte", heading="GiB", format=lambda size: f"{size / 2**30:.1f}"),
    Column("promise", heading="promise"),
    Column("rate", unit="1 / s", heading="rate", others=("error",),
           format=lambda rate, error: error or ("" if rate is None else f"{rate:.2g} /s")),
    Column("default", heading="chosen", format=lambda chosen: "default" if chosen else ""),
)  # fmt: skip


def list_devices(*, measure: bool = True) -> list[dict[str, Any]]:
    """List all devices with their promise and, if `measure` is true, their speed.

    Each has the fields of `DeviceRecord`, ``rate`` (None if not measured) and ``error`` (the reason for a failure,
    or "").
    """
    rates = []
    for number, record in enumerate(devices()):
        rate, error = None, ""
        if measure:
            try:
                rate = chi2_rate(Engine(str(number)))
            except DeviceError as failure:
                error = str(failure).splitlines()[0]
        rates.append(asdict(record) | {"rate": rate, "error": error})
    return rates


def child(request: dict[str, Any]) -> None:
    """Draw a small scene within the limits; print the reason for a failure and exit with code 1."""
    limit(request)
    name, number = request["name"], str(request["number"])
    try:
        handle, record = choose_device(number)
        if record.label != request["label"]:
            raise DeviceError(f"device {number} is {record.label} in a new process, not {request['label']}")
        if name is not None and not drivers.set_processor_name(handle, name):
            raise DeviceError("PoCL's record of the device is not understood")
        drivers.settled[int(handle.int_ptr)] = name
        engine, quiet, flare = Engine(number), toy(), toy(flare=0.3)
        raw = engine.realise(quiet, count=64, seed=1)
        engine.detect(quiet, [flare], realisations=64, seed=1)
        same = np.array_equal(raw, reference.realise(prepare([quiet]), np.arange(64, dtype=np.uint64), 1))
        if not same and record.promise == SAME_BITS:
            raise DeviceError("draws other counts than NumPy")
    except Exception as error:
        print(str(error).splitlines()[0] if str(error) else type(error).__name__)
        sys.exit(1)


def limit(request: dict[str, Any]) -> None:
    """Set the limits of this process."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    seconds = max(1, round(request["limit_s"]))
    # The hard limit ends the process even if the compiler handles the signal of the soft one.
    _lower(resource.RLIMIT_CPU, seconds, seconds + 5)
    # The alarm ends this process if the parent is killed.
    signal.alarm(max(1, round(drivers.CLOCK * request["limit_s"])))
    if request["memory"] is not None:
        _lower(resource.RLIMIT_DATA, request["memory"], request["memory"])


def _lower(kind: int, soft: int, hard: int) -> None:
    """Lower a resource limit, unless it is lower already."""
    present = resource.getrlimit(kind)[1]
    most = hard if present == resource.RLIM_INFINITY else min(hard, present)
    # macOS defines some limits without enforcing them.
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(kind, (min(soft, most), most))


#: Small stares that run every branch: options of `toy`, unknowns of the stare, number of sums.
STARE_CASES: dict[str, tuple[dict[str, Any], dict[str, Any], int]] = {
    "stares that wobble": (
        {"pixels": 8, "unit": "electrons"},
        {"jitters": {"light": 0.02, "sky": 0.02, "temperature": 0.1}, "offsets": {"star": 0.02, "temperature": 0.2}},
        3,
    ),
    "skewed stares": ({"pixels": 4, "dark": 120.0, "photon_noise": "poisson"}, {}, 1),
}
_RAYS = CosmicRays(rate_per_cm2_s=300.0)
#: Processes of each method of drawing stares: sums by cumulants have none.
METHODS: dict[Any, Processes] = {"pixels": Processes(cosmic_rays=_RAYS), "cumulants": NONE}


def stare_case(name: str, count: int) -> tuple[Components, Stare, NDArray[np.float64]]:
    """Return the components of the light of a case, its stare, and the light curves of its flares."""
    payload, wobble, n_sums = STARE_CASES[name]
    quiet, flare = toy(frames=1, **payload), toy(frames=1, flare=1.0, **payload)
    components = Components.of(quiet, [flare], np.vander(np.linspace(0.1, 1.0, payload["pixels"]), n_sums).T)
    stare = Stare.of(100.0, gaps=[(10.0, 40.0)], **wobble)
    return components, stare, np.linspace(0.0, 2.0, count * stare.n_frames).reshape(count, stare.n_frames, 1)


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
        {"mode": "frames", "processes": Processes(jitter=Uniform(0.0, 0.05), detector_temperature=Uniform(13.0, 21.0))},
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
FAST = tuple(name for name, statistic in STATISTICS.items() if not statistic.paired)
#: Realisations that cross the boundary of the counter's first word.
START, COUNT, SEED = 2**40 - 13, 40, 2**63 + 20_261_121


def results(engine: Engine, name: str, count: int) -> dict[str, NDArray[Any]]:
    """Return a device's results of a case: raw counts, statistics, histograms and tallies.

    Those of stares are the sums of every frame with flares by each method, and the noise factors of the flares.
    """
    if name in STARE_CASES:
        stares, (components, stare, flares) = Stares(engine.open_device), stare_case(name, count)
        keywords: dict[str, Any] = {"first": START, "count": count, "seed": SEED}
        sums = {
            method: stares.frames(components, stare, flares, method=method, processes=processes, **keywords)
            for method, processes in METHODS.items()
        }
        request = StaresRequest(components, stare, count, SEED, start=START, glow=True)
        return sums | {"noise of flares": stares.reduced(request)["glow"]}
    options, keywords = CASES[name]
    quiet, flare = toy(**options), toy(flare=0.3, **options)
    place: dict[str, Any] = {"start": START, "seed": SEED}
    drawing = {key: value for key, value in keywords.items() if key not in ("comparison", "nuisances")}
    raw, clipped = engine.realise_and_count(quiet, count=count, **place, **drawing)
    result = engine.snr(quiet, realisations=count, **place, **drawing)
    keywords = keywords | place
    names = statistics_of(keywords), statistics_of(keywords, FAST)
    values, fast = (engine.statistic_values(quiet, [flare], count=count, statistics=s, **keywords) for s in names)
    detection = engine.detect(quiet, [flare], realisations=count, statistics=names[1], **keywords)
    return {
        "raw": raw.astype(np.int32),
        "clipped": clipped.astype(np.uint32),
        "statistics": values,
        "fast statistics": fast,
        "histograms": histograms_of(result.counts),
        "tally": tally_of(detection.distribution("chi2")),
    }


def histograms_of(counts: Counts) -> NDArray[np.int64]:
    """Return all counts of histograms as one array."""
    far = [array[~counts.within(k)] for k, bins in counts.bins.items() for array in bins.totals()]
    return np.concatenate([np.ravel(array) for array in (*map(counts.dense, counts.bins), counts.clipped, *far)])


def tally_of(distribution: Distribution) -> NDArray[np.int64]:
    """Return all counts and sums of a tally as one array."""
    moments, far = np.array(distribution.sums[:2]), ~distribution.is_fine
    keys, counts = distribution.numbers[far], distribution.filled[far]
    # The known answers number the bins below the fine ones without an offset.
    keys = np.where(keys < 0, keys + FAR, keys)
    return np.concatenate([array.astype(np.int64) for array in (distribution.counts, moments, keys, counts)])


@cache
def known_arrays() -> dict[str, NDArray[Any]]:
    """Return the results of the NumPy reference for every case, by the names of case and part.

    `python tests/reference/known_answers.py` computes them.
    """
    with resources.files(__package__).joinpath("known_answers.npz").open("rb") as file, np.load(file) as arrays:
        return dict(arrays)


def statistics_of(keywords: dict[str, Any], names: tuple[str, ...] = tuple(STATISTICS)) -> tuple[str, ...]:
    """Return the statistics of a case; if it marginalises, only those that support this."""
    return tuple(n for n in names if not STATISTICS[n].paired) if "nuisances" in keywords else names


def known_answers(engine: Engine) -> Check:
    """Compare Philox on the device, plain and in its loop-invariant form, with Random123's vectors."""
    device = engine.open_device
    wide, flags = device.width > 1, device.cl.mem_flags
    counters, keys, answers = (np.array([row[i] for row in PHILOX_VECTORS], np.uint32) for i in range(3))
    kernel = device.kernel(("probes",), replace(device.variant, chunk=32 if wide else 4), "probe_philox")
    flag = flags.READ_ONLY | flags.COPY_HOST_PTR
    inputs = [device.cl.Buffer(device.context, flag, hostbuf=array) for array in (counters, keys)]
    out = np.empty((len(counters), 8), np.uint32)
    words = device.cl.Buffer(device.context, flags.WRITE_ONLY, out.nbytes)
    kernel(device.queue, (len(counters),), (1,) if wide else None, np.uint32(len(counters)), *inputs, words)
    device.cl.enqueue_copy(device.queue, out, words)
    right = np.array_equal(out, np.hstack([answers, answers]))
    return Check("Philox4x32-10, known answers", right, f"{len(PHILOX_VECTORS)} vectors of Random123")


#: Axes over which statistics vary by chance: realisations, or stares and their frames.
_CHANCE = {"statistics": 1} | dict.fromkeys(METHODS, (0, 1))


def check_results(engine: Engine) -> Iterator[Check]:
    """Compare every branch of every kernel, and every frame of some stares, with the known answers."""
    arrays = known_arrays()
    for name in (*CASES, *STARE_CASES):
        computed = results(engine, name, COUNT)
        expected = {part: arrays[f"{name}: {part}"] for part in computed}
        differ = [part for part in computed if computed[part].tobytes() != expected[part].tobytes()]
        if name in STARE_CASES:
            # Zeros may have either sign.
            differ = [part for part in differ if not np.array_equal(computed[part], expected[part])]
        if not differ:
            digests = (hashlib.sha256(array.tobytes()).hexdigest()[:12] for array in computed.values())
            passed, text = True, f"digests {' '.join(digests)}"
        elif engine.device.promise == SAME_BITS:
            passed, text = False, f"{', '.join(differ)} differ from the reference's"
        else:
            # Fewer than 1 % of the counts differ, by 1 DN. Statistics differ by less than 0.2 of their standard
            # deviation, and noise factors of flares by less than 0.2.
            off = np.abs(computed["raw"] - expected["raw"]) if "raw" in computed else np.zeros(1, int)
            share, apart = float(np.mean(off > 0)), 0.0
            for part in computed.keys() & {*_CHANCE, "noise of flares"}:
                scale = np.maximum(expected[part].std(axis=_CHANCE[part]), 1e-3) if part in _CHANCE else 1.0
                largest = np.abs(computed[part] - expected[part]).max(axis=_CHANCE.get(part))
                apart = max(apart, float(np.max(largest / scale)))
            passed = bool(off.max() <= 1 and share < 1e-2 and apart < 0.2)
            text = f"{share:.2g} of counts off, by {off.max()} DN at most; statistics by {apart:.2g} sigma"
            text = f"weaker promise: {text}"
        yield Check(f"same bits as the NumPy reference: {name}", passed, text)


def pearson(counts: NDArray[np.int64], probability: NDArray[np.float64]) -> float:
    """Return the two-sided p-value of Pearson's statistic, with rare outcomes in one bin."""
    n = counts.sum()
    expected = n * probability
    common = expected > 20
    observed = np.append(counts[common], counts[~common].sum())
    expected = np.append(expected[common], n - expected[common].sum())
    if expected[-1] < 20:
        observed, expected = observed[:-1], expected[:-1]
    statistic = float(np.sum((observed - expected) ** 2 / expected))
    upper = float(special.chdtrc(observed.size - 1, statistic))
    return 2 * min(upper, 1 - upper)


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
    cases: tuple[tuple[str, float, float, Any], ...] = (
        ("joint draw, dark of 2225", 2225.0, 12.0, "joint"),
        ("joint draw, dark of 30", 30.0, 12.0, "joint"),
        ("alias table, dark of 64", 64.0, 0.8, "apart"),
        ("expansion, dark of 2225", 2225.0, 0.8, "apart"),
    )
    for title, dark, read, recipe in cases:
        x = toy(512, 1, dark=dark, read=read, light=0.0)
        signal = engine.snr(x, realisations=100_000, seed=SEED, recipe=recipe)
        # All pixels are equal.
        counts = signal.counts.dense("pixel").sum(axis=0)
        first = int(signal.scene.base_dn[0, 0]) - layout.OBSERVER_BINS // 2
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
        for flare_index in (None, 0):
            drawn, theory = (f(statistic, flare_index) for f in (detection.distribution, detection.closed_form))
            error = (drawn.mean - theory.mean) / (theory.std / np.sqrt(n))
            name = f"{statistic}, mean {'without' if flare_index is None else 'with a flare'}"
            yield Check(f"{name}, closed form", bool(abs(error) < 5), f"{error:+.1f} standard errors")


def tiles(engine: Engine) -> Iterator[Check]:
    """Compare realisations drawn at once with the same ones drawn in pieces."""
    quiet = toy()
    at_once = engine.realise(quiet, start=0, count=500, seed=SEED)
    pieces = [engine.realise(quiet, start=a, count=b - a, seed=SEED) for a, b in ((0, 1), (1, 77), (77, 500))]
    yield Check("same bits in pieces", bool(np.array_equal(at_once, np.concatenate(pieces))), "500 realisations in 3")


def run(engine: Engine) -> list[Check]:
    """Run all checks."""
    groups = (check_results, chance, closed_forms, tiles)
    return [known_answers(engine), *(check for group in groups for check in group(engine))]
