"""Every number of an answer of random studies, most far from Gaussian noise, compared with sorting the same draws."""

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
import pytest
from answers import STATISTICS
from marks import long_but
from refusals import refused
from scenes import instrument, star
from scipy import stats

import mauvecl
from mauvecl import Comparison, CosmicRays, Detection, Engine, Expectation, Linear, Normal, Processes, Uniform

N, FAP = 4000, 0.05
#: The first realisation.
START = 70


def study(number: int) -> tuple[list[Expectation], dict]:
    """Return a star with two flares, and how it is drawn and compared."""
    rng = np.random.default_rng([14, number])
    low = float(rng.uniform(205.0, 600.0))
    payload = instrument(
        str(rng.choice(["mauvesim", "mauve"])),
        temperature_c=float(rng.uniform(0.0, 22.0)),
        output_min_nm=low,
        output_max_nm=low + 25.0,
    )
    bright = number % 6 == 5
    scenario = star(
        str(rng.choice(["A0V", "G2V", "K3V", "M0V"])),
        1.5 if bright else float(rng.uniform(3.0, 10.0)),
        amplitudes=(float(rng.uniform(0.01, 0.1)), float(rng.uniform(0.2, 2.0))),
        exposure=5.0 * int(rng.integers(1, 20)),
        payload=payload,
    )
    warm = float(payload.temperature_c)
    priors = {
        "detector_temperature": Uniform(warm - float(rng.uniform(0.05, 1.0)), warm + float(rng.uniform(0.05, 1.0))),
        "light_loss": Normal(0.34, float(rng.uniform(0.002, 0.05)), 0.1, 0.6),
        "qe_scale": Uniform(1.0 - float(rng.uniform(0.0, 0.2)), 1.0 + float(rng.uniform(0.0, 0.2))),
        "jitter": Uniform(0.0, 0.05),
    }
    names = [str(x) for x in rng.permutation(list(priors))[: int(rng.integers(0, 3))]]
    rays = CosmicRays(rate_per_cm2_s=300.0) if rng.random() < 0.4 else None
    own = Linear("own", rng.normal(size=scenario[0].wavelength_nm.size) * 10.0 ** rng.uniform(-25, 25))
    how = {
        "statistics": (*(name for name in STATISTICS if name != "uv_excess" or low < 330.0), own),
        "processes": Processes(cosmic_rays=rays, **{name: priors[name] for name in names}),
        "comparison": Comparison(int(rng.choice([0, 0, 1, 3])), bool(rng.random() < 0.3)),
    }
    return scenario, how


class Sorted:
    """The values that a distribution was made of, and how wide its bins may be there."""

    def __init__(self, values: np.ndarray, sigma: float, centre: float) -> None:
        self.values = np.sort(values.astype(float))
        # Steps are taken in float32.
        self.sigma, self.slack = sigma, 1e-6 * (abs(centre) + sigma)

    def bin(self, value: float) -> float:
        return max(self.sigma / 512, abs(value) * 2.0**-13) + self.slack

    def at_or_above(self, value: float) -> int:
        return int(self.values.size - np.searchsorted(self.values, value))

    def close(self, value: float) -> int:
        """Count the values so close to an edge that float32 may move them to either side."""
        return int(np.sum(np.abs(self.values - value) <= self.slack))


def central_counts(n: int, p: float) -> tuple[int, int]:
    """Return the ranks of the order statistics that enclose a quantile with a confidence of 95 %."""
    return int(stats.binom.ppf(0.025, n, p)), int(stats.binom.ppf(0.975, n, p))


def rows_of(statistics: tuple[str, ...], n_flares: int) -> dict[tuple[str, int, int], int]:
    """Return the row of `statistic_values` of each statistic, scenario and template, in the documented order."""
    squares = ("chi2", "chi2_element", "chi2_pair")
    place = count(len(squares) * (1 + n_flares))
    rows = {(name, scenario, 0): 3 * scenario + k for k, name in enumerate(squares) for scenario in range(1 + n_flares)}
    for names in ((*(n for n in statistics if n not in (*squares, "paper")),), ("paper",)):
        for scenario in range(1 + n_flares):
            for name in sorted(names, key=lambda name: name != "matched"):
                shaped = name in ("matched", "paper")
                for template in (range(n_flares) if scenario == 0 else [scenario - 1]) if shaped else [0]:
                    rows[name, scenario, template] = next(place)
    return rows


def check_distribution(d: Any, exact: Sorted) -> None:
    n, values = exact.values.size, exact.values
    widest = max(exact.bin(values[0]), exact.bin(values[-1]))
    assert d.mean == pytest.approx(values.mean(), rel=1e-7, abs=exact.sigma / 2048 + exact.slack)
    assert d.std == pytest.approx(values.std(), rel=1e-5, abs=exact.sigma / 2048 + exact.slack)
    assert d.bins[0][0] - exact.slack <= values[0]
    assert values[-1] <= d.bins[1][-1] + exact.slack
    for p in (0.01, 0.16, 0.5, 0.84, 0.99):
        found = d.quantile_interval(p)
        assert values[int(p * n) - 1] - widest <= found.value <= values[int(p * n)] + widest
        low, high = central_counts(n, p)
        assert values[low - 1] - exact.bin(values[low - 1]) <= found.low <= values[low - 1] + exact.slack
        assert values[high] - exact.slack <= found.high <= values[high] + exact.bin(values[high])
    edges, counts = d.histogram(40)
    assert counts.sum() == n
    direct = np.histogram(values, edges)[0]
    # A picture's edge may cut a bin.
    near = [np.sum(np.abs(values - edge) <= exact.bin(edge)) for edge in edges]
    assert (np.abs(np.cumsum(direct) - np.cumsum(counts)) <= np.array(near[1:]) + 1).all()


@pytest.mark.parametrize("number", long_but(range(8), 0))
def test_numbers_equal_those_of_sorting(engine: Engine, number: int) -> None:
    (quiet, *flares), how = study(number)
    found = engine.detect(quiet, flares, realisations=N, seed=14, start=START, **how)
    values = engine.statistic_values(quiet, flares, count=N, seed=14, start=START, **how)
    rows = rows_of(found.statistics, len(flares))
    for statistic in found.statistics:
        for k in range(len(flares)):
            shaped = k if (statistic, 0, k) in rows else 0
            null, flare = found.closed_form(statistic, template=k), found.closed_form(statistic, k)
            of_quiet, of_flare = (values[rows[statistic, scenario, shaped]] for scenario in (0, k + 1))
            quiet_values, own = Sorted(of_quiet, null.std, null.mean), Sorted(of_flare, flare.std, flare.mean)
            on_null = Sorted(of_flare, null.std, null.mean)
            check_distribution(found.distribution(statistic, template=k), quiet_values)
            check_distribution(found.distribution(statistic, k), own)
            check_answers(found, statistic, k, quiet_values, on_null)
            largest, smallest = found.tail_samples(statistic, template=k), found.tail_samples(statistic, k)
            for tail, exact in ((largest, quiet_values.values[::-1]), (smallest, own.values)):
                np.testing.assert_array_equal(tail["value"], exact[:1000])
            np.testing.assert_array_equal(of_quiet[largest["realisation"] - START], largest["value"])


def check_answers(found: Detection, statistic: str, k: int, null: Sorted, flare: Sorted) -> None:
    wanted = int(FAP * N)
    cut = found.threshold(FAP, statistic, template=k)
    low, high = central_counts(N, FAP)
    for edge, above in ((cut.value, wanted), (cut.low, high), (cut.high, low - 1)):
        exact = null.values[N - 1 - above]
        assert exact - null.slack <= edge <= exact + null.bin(exact)
    back = found.false_alarm_probability(cut.value, statistic, template=k)
    assert abs(round(back.value * N) - null.at_or_above(cut.value)) <= null.close(cut.value)
    for value in (null.values[0] - null.sigma, null.values.mean(), cut.value, null.values[-1] + null.sigma):
        back = found.false_alarm_probability(value, statistic, template=k)
        # A threshold within a bin of the histogram shares its values out.
        above = round(back.value * N, 6)
        few, many = (stats.binomtest(int(count), N).proportion_ci() for count in (np.floor(above), np.ceil(above)))
        assert (back.low, back.high) == pytest.approx((few.low, many.high), rel=1e-9)
    p = found.detection_probability(FAP, statistic)[k]
    assert abs(round(p.value * N) - flare.at_or_above(cut.value)) <= flare.close(cut.value)
    assert p.low <= p.value <= p.high
    curve = found.roc(statistic, k)
    assert (curve.fap[0], curve.probability[0], curve.fap[-1], curve.probability[-1]) == (1.0, 1.0, 0.0, 0.0)
    table = curve.table()
    assert len(table) <= 201
    for name in ("fap", "probability"):
        assert ((table[f"{name}_low"] <= table[name]) & (table[name] <= table[f"{name}_high"])).all()
    for i in np.linspace(0, curve.fap.size - 1, 30).astype(int):
        x = curve.threshold[i]
        assert abs(round(curve.fap[i] * N) - null.at_or_above(x)) <= null.close(x)
        assert abs(round(curve.probability[i] * N) - flare.at_or_above(x)) <= flare.close(x)
    # Of all pairs, those that the flare wins; a bin cannot tell its own apart, and counts them half.
    beaten = np.searchsorted(null.values, flare.values, side="left") + np.searchsorted(
        null.values, flare.values, "right"
    )
    reach = np.array([null.bin(x) for x in flare.values])
    unsure = np.searchsorted(null.values, flare.values + reach) - np.searchsorted(null.values, flare.values - reach)
    assert abs(curve.area.value - beaten.sum() / (2 * N**2)) <= unsure.sum() / (2 * N**2) + 1e-12


STARS, SCENES = ("B2IV", "A0V", "F5V", "G2V", "K3V", "K5V", "M0V"), 80
#: Of the thresholds, and again of the false alarms counted with other draws.
NULLS = 300_000


def scene(number: int) -> list[Expectation]:
    """Draw a star, magnitude, exposure, temperature, sky, instrument and 12 nm of spectrum at random."""
    rng = np.random.default_rng([2026, number])
    low, name, celsius = rng.uniform(200.0, 330.0), str(rng.choice(["mauvesim", "mauve"])), rng.uniform(-10.0, 25.0)
    payload = instrument(name, temperature_c=float(celsius), output_min_nm=float(low), output_max_nm=float(low + 12.0))
    quiet = mauvecl.Source.from_library(str(rng.choice(STARS))).at_magnitude(float(rng.uniform(3.0, 10.0)))
    sky, exposure = mauvecl.Sky.of_brightness(float(rng.uniform(18.0, 23.0))), 5.0 * int(rng.integers(1, 60))
    flaring = quiet.flaring(float(rng.uniform(0.01, 1.0)))
    return [mauvecl.expect(one, payload, exposure=exposure, sky=sky) for one in (quiet, flaring)]


@pytest.mark.long
def test_false_alarms_are_as_requested(engine: Engine) -> None:
    """Check eighteen sums and their scatter, which notice errors of 16 % at 1e-4; once in 1e6 runs they fail."""
    # A threshold is an order statistic of null draws, so that the number of fresh ones beyond it is beta-binomial.
    z: dict[tuple[str, float], list[float]] = {(s, fap): [] for s in STATISTICS for fap in (1e-2, 1e-3, 1e-4)}
    drawn_frames = 0
    for number in range(SCENES):
        quiet, flare = scene(number)
        # A few frames are drawn one by one, rounded and clipped each.
        how: dict[str, Any] = {"statistics": STATISTICS, "mode": "frames" if quiet.n_frames <= 5 else "auto"}
        drawn = [engine.detect(quiet, [flare], realisations=NULLS, seed=number, start=k, **how) for k in (0, NULLS)]
        drawn_frames += drawn[0].scene.frames
        for (statistic, fap), values in z.items():
            ours, theirs = (one.distribution(statistic) for one in drawn)
            cut = ours.edge_with_at_most(int(fap * NULLS))
            # Whole bins: the threshold's own count, which is at most fap NULLS.
            expected = NULLS * (ours.above(cut) + 0.5) / (NULLS + 1)
            values.append((theirs.above(cut) - expected) / np.sqrt(2 * expected))
    # Both ways of drawing are among the scenes.
    assert 0 < drawn_frames < SCENES
    tests = 2 * len(z)
    for values in z.values():
        assert 2 * stats.norm.sf(abs(np.sum(values)) / np.sqrt(len(values))) > 1e-6 / tests
        scatter = stats.chi2.cdf(np.sum(np.square(values)), len(values))
        assert 2 * min(scatter, 1 - scatter) > 1e-6 / tests


@pytest.mark.parametrize(("width", "number", "signal"), long_but(
    [*((16, k, "net") for k in (0, 1, 2, 5)), (1, 0, "net"), (1, 1, "net"), (16, 3, "net"), (16, 3, "paper")],
    (16, 3, "net"), (16, 3, "paper"),
))  # fmt: skip
def test_snr_equals_that_of_sorting(width: int, number: int, signal: Any) -> None:
    (quiet, *_), how = study(number)
    if number == 3:
        # A sky as bright as the star.
        quiet = replace(quiet, signal=signal, sky_electrons=quiet.source_electrons)
    n = 1000
    few = (
        Processes(cosmic_rays=CosmicRays(rate_per_cm2_s=300.0)),
        Processes(detector_temperature=Uniform(15.0, 24.0)),
        Processes(light_loss=Uniform(0.2, 0.5)),
    )
    processes = few[number] if number < 3 else how["processes"]
    engine = Engine(width=width)
    found = engine.snr(quiet, realisations=n, seed=3, processes=processes)
    raw = engine.realise(quiet, count=n, seed=3, processes=processes).astype(float)
    light = raw - quiet.n_frames * (quiet.bias_dn + quiet.dark_dn)
    net = light - (quiet.sky_dn if signal == "net" else 0.0)
    known = quiet.n_frames * (quiet.read_noise_dn**2 + quiet.dark_variance_dn2)
    noise2 = np.maximum(light, 0.0) * quiet.gain_dn_per_electron + known
    per_pixel = net / np.sqrt(noise2)
    per_element = np.array(
        [quiet.per_element(x) / np.sqrt(quiet.per_element(y)) for x, y in zip(net, noise2, strict=True)]
    )
    assert found.element.meta["signal"] == signal
    assert number > 2 or not all(found.counts.within(kind).all() for kind in ("pixel", "element"))
    for table, exact, sd in (
        (found.pixel, per_pixel, np.sqrt(quiet.variance_dn2 / noise2.mean(axis=0))),
        (found.element, per_element, np.ones(per_element.shape[1])),
    ):
        # A bin is 1/64 of a standard deviation or less; its own changes with the S/N's slope, at most twofold.
        width_ = 2 * sd / 64
        np.testing.assert_allclose(table["mean"], exact.mean(axis=0), rtol=1e-4, atol=width_.max())
        np.testing.assert_allclose(table["std"], exact.std(axis=0), rtol=1e-3, atol=width_.max())
        ordered = np.sort(exact, axis=0)
        percentages = [float(name[1:]) for name in table.colnames if name[0] == "q"]
        assert len(percentages) >= 3
        for percentage in percentages:
            place = percentage / 100 * n
            low, high = ordered[max(int(place) - 1, 0)], ordered[min(int(place) + 1, n - 1)]
            q = table[f"q{percentage:g}"]
            assert ((q >= low - width_ - 1e-4 * abs(low)) & (q <= high + width_ + 1e-4 * abs(high))).all()


def test_nan_values_are_refused(engine: Engine) -> None:
    """Use weights for which float32 overflows in the flare: the null is answered, numbers of the flare are refused."""
    quiet, flare = star(magnitude=5.0, amplitudes=(2.0,), payload=instrument(part=True))
    delta = (flare.signal_dn - quiet.signal_dn).sum()
    own = Linear("own", np.full(quiet.wavelength_nm.size, 1e38 / delta * 5))
    found = engine.detect(quiet, [flare], realisations=1000, seed=1, statistics=("matched", own))
    assert np.isfinite(found.threshold(0.2, "own").value)
    for read in (
        lambda: found.detection_probability(0.2, "own"),
        lambda: found.distribution("own", 0),
        lambda: found.roc("own"),
        lambda: found.table(0.2),
        lambda: found.tail_samples("own", 0),
    ):
        with refused("statistic", "'own'", "1", "1000"):
            read()
    assert found.detection_probability(0.2, "matched")[0].value == 1.0
