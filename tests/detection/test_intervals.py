"""Intervals of probabilities have their coverage, by plain normals, and their ends, by scipy."""

import numpy as np
import pytest
from marks import long_but
from scenes import instrument, star
from scipy import optimize, stats

from mauvecl import Engine
from mauvecl.detection import distributions

#: Of the chi-squared statistic here.
DOF = 48


def exact(k: int, n: int) -> tuple[float, float]:
    found = stats.binomtest(int(k), n).proportion_ci(method="exact")
    return found.low, found.high


def strength(kind: str, fap: float, probability: float) -> tuple[float, float]:
    """Return the true threshold, and what a flare must add to be detected with a probability."""
    if kind == "matched":
        cut = float(stats.norm.isf(fap))
        return cut, cut - float(stats.norm.isf(probability))
    cut = float(stats.chi2.isf(fap, DOF))
    return cut, optimize.brentq(lambda push: stats.ncx2.sf(cut, DOF, push) - probability, 1e-6, 1e3)


def intervals(
    kind: str, fap: float, probability: float, n: int, seeds: int
) -> tuple[np.ndarray, list[distributions.Interval]]:
    """Count flares above a simulated threshold and the ends of its interval; return counts and interval per seed."""
    rng = np.random.default_rng([round(1e4 * fap), round(1e4 * probability), n, len(kind)])
    _, push = strength(kind, fap, probability)
    low, high = (int(count) for count in stats.binom.ppf([0.025, 0.975], n, fap))
    ranks = [int(np.floor(fap * n * (1 + 1e-12))), max(low - 1, 1), high]
    above, shared = np.empty((seeds, 3), int), np.zeros(seeds)
    for seed in range(seeds):
        z = rng.standard_normal(n)
        if kind == "matched":
            null, flare = z, z + push
        else:
            rest = rng.chisquare(DOF - 1, n)
            null, flare = z**2 + rest, (z + np.sqrt(push)) ** 2 + rest
            if kind == "other draws":
                flare = rng.noncentral_chisquare(DOF, push, n)
        ordered = np.partition(null, [n - rank for rank in ranks])
        above[seed] = [(flare >= ordered[n - rank]).sum() for rank in ranks]
        if kind != "other draws":
            shared[seed] = min(null.std() / flare.std(), 1.0)
    return above, [
        distributions.detection_interval([int(k) for k in row], n, fap, float(r))
        for row, r in zip(above, shared, strict=True)
    ]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["matched", "chi2", "other draws"])
@pytest.mark.parametrize(
    ("fap", "n", "seeds", "probabilities"),
    [(0.1, 1000, 2000, (0.3, 0.7, 0.97)), (0.01, 10_000, 1000, (0.05, 0.3, 0.97)), (1e-3, 100_000, 100, (0.3,))],
)
def test_interval_has_nominal_coverage(kind: str, fap: float, n: int, seeds: int, probabilities: tuple) -> None:
    """Check 94-97 % within 5 standard errors of the seeds; one of the 21 fails in 8e4 runs.

    The interval that it takes the place of is wider in all of them, and up to twice as wide.
    """
    for probability in probabilities:
        above, found = intervals(kind, fap, probability, n, seeds)
        covered = np.mean([x.low <= probability <= x.high for x in found])
        error = 5 * np.sqrt(0.05 * 0.95 / seeds)
        assert 0.94 - error < covered < 0.97 + error
        ends = [(exact(few, n)[0], exact(many, n)[1]) for _, few, many in above[:100]]
        assert np.mean([x.high - x.low for x in found[:100]]) < 0.95 * np.mean([high - low for low, high in ends])


@pytest.mark.parametrize("probability", long_but([0.15, 0.5, 0.99, 0.998, 0.9995], 0.5, 0.998))
def test_interval_covers_near_the_ends(probability: float) -> None:
    """Include few missed flares of 1000, and hardly more detections than false alarms; fails in 3e-7 of seeds."""
    for kind in ("matched", "chi2"):
        _, found = intervals(kind, 0.1, probability, 1000, 1000)
        covered = np.mean([x.low <= probability <= x.high for x in found])
        assert covered > 0.94 - 5 * np.sqrt(0.05 * 0.95 / 1000)


def test_ends_of_the_counts() -> None:
    """Compare no and all detections with Clopper and Pearson's interval, which an uncertain threshold widens."""
    sure = distributions.detection_interval((1000, 1000, 1000), 1000, 1e-3)
    assert (sure.value, sure.high) == (1.0, 1.0)
    assert 0.99 < sure.low < exact(1000, 1000)[0] + 1e-9
    less = distributions.detection_interval((1000, 990, 1000), 1000, 1e-3)
    assert less.low < sure.low
    none = distributions.detection_interval((0, 0, 0), 1000, 1e-3)
    assert (none.value, none.low) == (0.0, 0.0)
    assert none.high == pytest.approx(1 - sure.low, rel=1e-9)
    plain = distributions.detection_interval((300, 300, 300), 1000, 1e-3)
    jeffreys = stats.beta.ppf([0.025, 0.975], 300.5, 700.5)
    assert (plain.low, plain.high) == pytest.approx(tuple(jeffreys), rel=1e-3)


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.96, 0.9999, 1.0])
def test_ends_combine_three_errors_that_are_correlated(correlation: float) -> None:
    """Compare with Jeffreys's interval, the threshold's and scipy's bivariate normal, on the scale of quantiles."""
    n = 1000
    for fap, above in ((0.1, (500, 460, 545)), (0.01, (300, 270, 325)), (0.001, (30, 17, 48))):
        middle, few, many = (stats.norm.ppf((k + 0.5) / (n + 1)) for k in above)
        low, high = stats.norm.ppf(stats.beta.ppf([0.025, 0.975], above[0] + 0.5, n - above[0] + 0.5))
        p = stats.norm.cdf(middle)
        cov = [[1, correlation], [correlation, 1]]
        corner = [stats.norm.ppf(fap), middle]
        both = stats.multivariate_normal.cdf(corner, cov=cov, allow_singular=True, abseps=1e-10)
        shared = (both - fap * p) / np.sqrt(fap * (1 - fap) * p * (1 - p))
        ends = [
            middle + sign * np.sqrt(one**2 + other**2 - 2 * shared * one * other)
            for sign, one, other in ((-1, middle - low, middle - few), (1, high - middle, many - middle))
        ]
        found = distributions.detection_interval(above, n, fap, correlation)
        assert (found.low, found.high) == pytest.approx(tuple(stats.norm.cdf(ends)), abs=1e-7)


def test_false_alarms_have_the_exact_interval(engine: Engine) -> None:
    """Compare with scipy's interval of Clopper and Pearson, also for none and all."""
    n = 2000
    quiet, flare = star(amplitudes=(0.24,), payload=instrument(part=True))
    found = engine.detect(quiet, [flare], realisations=n, seed=3, statistics=("chi2",))
    null = found.distribution("chi2")
    for sigmas in (-10, 0, 2, 20):
        cut = null.mean + sigmas * null.std
        ours, above = found.false_alarm_probability(cut, "chi2"), null.above(cut)
        assert ours.value == above / n
        # A threshold within a bin of the histogram shares its values out.
        ends = exact(int(np.floor(above)), n)[0], exact(int(np.ceil(above)), n)[1]
        assert (ours.low, ours.high) == pytest.approx(ends, rel=1e-9)
