"""Number of flares that a campaign recovers, and the flare rates that follow from recovered energies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from mauvecl.lightcurve.flares.rates import PowerLaw, Rates
from mauvecl.lightcurve.search.completeness import Completeness
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import NotNegative, Positive
from mauvecl.statistics.bisection import smallest_integer

Float = NDArray[np.float64]

#: Energy steps per decade for sums of rates.
PER_DECADE = 100
#: Number of quantiles of the scatter of a rate.
NODES = 1000
#: Range of fitted exponents, and number of energies of the grid for sums of flares.
EXPONENTS, GRID = (1.01, 6.0), 1200


@dataclass(frozen=True)
class Yield:
    """Number of flares that a campaign recovers.

    Attributes
    ----------
    expected : float
        Mean at the nominal rate.
    low, high : int
        Central 95 % of campaigns, with the scatter of the rate and Poisson noise.
    at_least_one : float
        Probability of at least one flare, with the same scatter.
    """

    expected: float
    low: int
    high: int
    at_least_one: float

    @classmethod
    @validated
    def of(cls, rates: Rates, completeness: Completeness, days: NotNegative) -> Yield:
        """Compute the yield from flare rates, completeness and observed days; energies must be in the same band."""
        expected = recovered_per_day(rates, completeness) * days
        return cls.of_expected(expected, rates.scatter_dex)

    @classmethod
    def of_expected(cls, expected: float, scatter_dex: float) -> Yield:
        """Compute the yield from the expected number and the scatter of its logarithm."""
        # Many quantiles are needed, since the Poisson distribution may be narrower than the scatter.
        nodes = stats.norm.ppf((np.arange(NODES) + 0.5) / NODES) if scatter_dex > 0 else np.zeros(1)
        means = expected * 10.0 ** (scatter_dex * nodes)
        largest = float(means.max())
        most = int(largest + 20 * np.sqrt(largest) + 20)

        def quantile(probability: float) -> int:
            return smallest_integer(lambda n: float(np.mean(stats.poisson.cdf(n, means))) >= probability, -1, most)

        return cls(expected, quantile(0.025), quantile(0.975), float(np.abs(np.expm1(-means)).mean()))


def recovered_per_day(rates: Rates, completeness: Completeness) -> float:
    """Return the recovered flares per day, the integral of rate times completeness over energy."""
    if rates.band != completeness.band:
        raise InputError.of("band", rates.band, f"{completeness.band!r}, the band of the completeness")
    low, high = completeness.decades
    edges = 10 ** np.linspace(low, high, max(2, round((high - low) * PER_DECADE)))
    above = rates.per_day_above(edges)
    chance = completeness.at(np.sqrt(edges[1:] * edges[:-1]))
    # The completeness is constant above the table.
    return float(np.sum((above[:-1] - above[1:]) * chance) + above[-1] * completeness.probability[-1])


@dataclass(frozen=True)
class FittedPowerLaw:
    """Power law fitted to recovered flares."""

    alpha: float
    alpha_sd: float
    log10_rate: float  # of flares per day with energies of at least `pivot_erg`
    log10_rate_sd: float
    pivot_erg: float
    flares: int

    def law(self, band: str = "Kepler") -> PowerLaw:
        """Return the power law as flare rates."""
        return PowerLaw.through(self.alpha, self.pivot_erg, 10**self.log10_rate, band=band, source="fitted")


@validated
def fit_power_law(
    energy_erg: Float,
    completeness: Completeness,
    days: Positive,
    *,
    error_dex: float = 0.0,
    bias_dex: float = 0.0,
) -> FittedPowerLaw:
    """Estimate exponent and rate of flares from recovered energies by maximum likelihood.

    Recovered energies are a Poisson process of density days * dN/dlogE * completeness, blurred by the error of a
    recovered energy; standard errors follow from the curvature of the likelihood.

    Parameters
    ----------
    energy_erg : ndarray, shape (n,)
        Recovered energies, at least 3.
    completeness : Completeness
        Completeness by true energy.
    days : float
        Observed time.
    error_dex, bias_dex : float
        Standard deviation and mean of the normal error of the logarithm of a recovered energy.
    """
    logs = np.log10(np.asarray(energy_erg, np.float64))
    if logs.size < 3 or not np.isfinite(logs).all():
        raise InputError(
            f"energy_erg has {logs.size} flares", "at least 3 with energies above 0", key="energy_erg", value=logs.size
        )
    pivot = float(np.median(logs))
    x = np.linspace(*completeness.decades, GRID)
    step = float(x[1] - x[0])
    chance = completeness.at(10**x)
    recovered = logs - bias_dex
    # The density is unconstrained where the completeness is zero, and may be huge there.
    used = chance > 0
    x, chance = x[used], chance[used]
    blur = None
    if error_dex > 0:
        blur = stats.norm.pdf(recovered[:, None], x, error_dex) * step

    def seen(alpha: float) -> Float:
        """Return recovered flares per day and dex of true energy, for a rate of 1 above the pivot."""
        return np.asarray((alpha - 1) * np.log(10) * 10 ** ((1 - alpha) * (x - pivot)) * chance)

    def cost(alpha: float, log10_rate: float | None = None) -> float:
        """Return the negative log likelihood, by default at the best rate for the exponent."""
        flares = seen(alpha)
        at = np.interp(recovered, x, flares) if blur is None else blur @ flares
        mean = days * step * flares.sum()
        rate = logs.size / mean if log10_rate is None else 10**log10_rate
        return float(mean * rate - np.sum(np.log(np.maximum(at, 1e-300))) - logs.size * np.log(rate * days))

    alpha = float(optimize.minimize_scalar(cost, bounds=EXPONENTS, method="bounded", options={"xatol": 1e-7}).x)
    log10_rate = float(np.log10(logs.size / (days * step * seen(alpha).sum())))
    covariance = np.linalg.inv(_curvature(lambda one: cost(one[0], one[1]), np.array([alpha, log10_rate])))
    return FittedPowerLaw(
        alpha=alpha,
        alpha_sd=float(np.sqrt(covariance[0, 0])),
        log10_rate=log10_rate,
        log10_rate_sd=float(np.sqrt(covariance[1, 1])),
        pivot_erg=10**pivot,
        flares=int(logs.size),
    )


def _curvature(cost: Callable[[Float], float], at: Float) -> Float:
    """Return second derivatives by central differences, (2, 2)."""
    h = 1e-3
    second = np.empty((2, 2))
    steps = h * np.eye(2)
    for i in range(2):
        for j in range(2):
            second[i, j] = (
                cost(at + steps[i] + steps[j]) - cost(at + steps[i] - steps[j])
                - cost(at - steps[i] + steps[j]) + cost(at - steps[i] - steps[j])
            ) / (4 * h * h)  # fmt: skip
    return second
