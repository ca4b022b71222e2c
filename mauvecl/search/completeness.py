"""Completeness of a search, the number of flares that a campaign recovers, and rates that follow from them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import interpolate, optimize, stats

from mauvecl.detection.distributions import Interval, central_counts, clopper_pearson, smallest_integer
from mauvecl.detection.nuisances import Nuisances
from mauvecl.flares import HALF_WIDTHS_S
from mauvecl.flares.energies import EnergyScale, PowerLaw, Rates
from mauvecl.flares.shapes import Shape, consecutive_integrals, shape_of
from mauvecl.host.arrays import Float, set_read_only
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import DAY_S, Duration, DurationExponent, DurationScatter, Energy, NotNegative, Positive
from mauvecl.search.false_alarms import TemplateGrid
from mauvecl.search.search import Bank, white_bank

#: Energies per decade of the closed form, and its numbers of half-widths and peak times.
PER_DECADE, WIDTHS, PEAKS = 20, 40, 24
#: Range of its half-widths, s.
WIDTH_RANGE_S = (2.0, 20_000.0)
#: Range of thresholds, sigma.
THRESHOLDS = (2.0, 20.0)


@validated
@dataclass(frozen=True)
class DurationLaw:
    """Assumed half-widths by energy: t_1/2 = half_width_s (E / at_erg)^exponent, with a normal scatter in dex.

    The exponent is that of superflares on G dwarfs (Maehara et al. 2015); the default scale gives minutes at 1e34 erg
    and tens of seconds at 1e31 erg.
    """

    half_width_s: Duration = 100.0
    at_erg: Energy = 1e33  #: bolometric
    exponent: DurationExponent = 0.39
    scatter_dex: DurationScatter = 0.3

    def half_width(self, energy_erg: ArrayLike) -> Float:
        """Return the median half-width, s, shape of the energy."""
        return np.asarray(self.half_width_s * (np.asarray(energy_erg, float) / self.at_erg) ** self.exponent)

    def quantiles(self, energy_erg: Float) -> tuple[Float, Float]:
        """Return half-widths of each energy, shape (n_energy, n_node), and their weights in a mean, (n_node,)."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(15)
        half_widths = self.half_width(energy_erg)[:, None] * 10 ** (self.scatter_dex * nodes)
        return half_widths, weights / weights.sum()


@dataclass(frozen=True, eq=False)
class Completeness:
    """Probability that a flare is recovered, by energy."""

    energy_erg: Float  #: in the band, ascending, shape (n,)
    probability: Float  #: shape (n,)
    band: str  #: or "bolometric"
    how: str  #: description of the method

    def __post_init__(self) -> None:
        set_read_only(self, energy_erg=self.energy_erg, probability=self.probability)
        energy, p = self.energy_erg, self.probability
        ascending = np.isfinite(energy).all() and (np.diff(energy, prepend=0.0) > 0).all()
        if not (energy.shape == p.shape == (p.size,) and p.size > 1 and ascending):
            raise InputError(
                "a completeness needs a probability for each of at least 2 ascending energies above 0", key="energy_erg"
            )
        if not ((p >= 0) & (p <= 1)).all():
            raise InputError.of("probability", (float(p.min()), float(p.max())), "between 0 and 1")

    def at(self, energy_erg: ArrayLike) -> Float:
        """Return the interpolated probability, constant outside the table, shape of the energy."""
        return np.asarray(np.interp(np.log10(energy_erg), np.log10(self.energy_erg), self.probability))

    @property
    def decades(self) -> tuple[float, float]:
        """Logarithms of the first and last energy."""
        return float(np.log10(self.energy_erg[0])), float(np.log10(self.energy_erg[-1]))

    def energy_at(self, probability: float) -> float:
        """Return the energy above which the probability is reached, erg; infinite if it never is."""
        return size_at(self.energy_erg, self.probability, probability)

    @classmethod
    @validated
    def of_search(
        cls,
        signal_per_frame: Positive,
        scale: EnergyScale,
        *,
        window_s: Duration,
        false_alarms_per_day: float,
        bank: Bank | None = None,
        law: DurationLaw | None = None,
    ) -> Self:
        """Compute the closed form for a bank of matched filters in observing windows of equal length.

        Offset and slope of each window are unknown, so that only the deviation of a flare from a straight line counts;
        peaks are distributed uniformly over the window. Flares with an S/N below half of the threshold count as lost.
        The closed form neglects the photon noise of flares, the mismatch between templates (about 1 %), and the effect
        of several temperatures on the threshold.

        Parameters
        ----------
        signal_per_frame : float
            S/N of one frame with a flare of amplitude 1 and optimal spectral weights; see `frame_signal`.
        scale : EnergyScale
            Bolometric energies by amplitude.
        window_s : float
            Length of a window without gaps.
        false_alarms_per_day : float
            False alarms per day of frames, which set the threshold.
        bank : Bank, optional
            Shape, half-widths and baseline; by default those of a search with one sum per frame.
        law : DurationLaw, optional
        """
        if scale.kind != "bolometric":
            raise InputError.of("kind", scale.kind, "bolometric")
        law, bank = law or DurationLaw(), bank or white_bank(HALF_WIDTHS_S, shape_of("davenport2014"), 5.0)
        threshold = search_threshold(false_alarms_per_day, bank)
        widths, gain = _gains(bank.shape, window_s, bank.frame_s)
        # From undetectable energies to those that are always detected.
        log_energy = np.arange(24.0, 40.0, 1 / PER_DECADE)
        half, weights = law.quantiles(10**log_energy)
        duration = scale.equivalent_duration(1.0) * 10**log_energy
        amplitude = duration[:, None] / (half * bank.shape.equivalent_duration)
        log_gain = interpolate.make_interp_spline(np.log(widths), np.log(gain), k=1)
        growth = np.exp(log_gain(np.log(np.clip(half, widths[0], widths[-1]))))
        signal = amplitude[..., None] * signal_per_frame * growth
        # Small flares that noise lifts above the threshold, about 1 % of them, count as false alarms, since small
        # flares are arbitrarily frequent.
        p = np.where(signal > threshold / 2, stats.norm.sf(threshold - signal), 0.0).mean(axis=-1)
        probability = p @ weights
        how = (
            f"closed form of a bank of matched filters, {bank.shape.name}, threshold {threshold:.2f} sigma for "
            f"{false_alarms_per_day:g} false alarms a day, stretches of {window_s / 60:.0f} min"
        )
        return cls(10**log_energy, np.clip(probability, 0, 1), "bolometric", how)


def size_at(sizes: Float, shares: Float, share: float) -> float:
    """Return the size above which a share of flares is found, between ascending sizes; infinite if it never is."""
    missed = np.flatnonzero(shares < share)
    if not missed.size:
        return float(sizes[0])
    if missed[-1] == sizes.size - 1:
        return float("inf")
    around = slice(missed[-1], missed[-1] + 2)
    return float(np.exp(np.interp(share, shares[around], np.log(sizes[around]))))


# A plan asks for the threshold and the gains of each target and each mode of a calibrated throughput.
@lru_cache(maxsize=8)
@validated
def search_threshold(false_alarms_per_day: Positive, bank: Bank) -> float:
    """Return the threshold of a bank in white noise, sigma, for a number of false alarms per day of frames.

    The threshold follows from `TemplateGrid` and is about 1 % too high at one alarm per day, and less at lower rates.
    Raises InputError if it is not between 2 and 20 sigma.
    """
    grid = TemplateGrid.from_bank(bank)

    def over(threshold: float) -> float:
        return float(np.log(grid.false_alarms_per_second(threshold) * DAY_S / false_alarms_per_day))

    if over(THRESHOLDS[0]) < 0 or over(THRESHOLDS[1]) > 0:
        most, least = (grid.false_alarms_per_second(u) * DAY_S for u in THRESHOLDS)
        raise InputError.of("false_alarms_per_day", false_alarms_per_day, f"between {least:.2g} and {most:.3g}")
    return float(optimize.brentq(over, *THRESHOLDS, xtol=1e-9))


#: Amplitude of the flare from which the signal per amplitude follows; its own photon noise is neglected.
SMALL = 0.01


def frame_signal(
    quiet: Expectation,
    flare: Expectation,
    amplitude: float = 1.0,
    *,
    added_variance_dn2: Float | None = None,
    unknown: Nuisances | None = None,
) -> float:
    """Return the S/N of one frame with a flare of amplitude 1, with optimal weights.

    `amplitude` is that of the flare in `flare`, and `added_variance_dn2`, (n_pixel,), additional variance such as that
    of particle hits. Pixels that saturate without a flare are excluded. `unknown` is marginalised over.
    """
    light = (flare.source_electrons - quiet.source_electrons) * quiet.gain_dn_per_electron / amplitude
    variance = quiet.unsaturated_variance_dn2 + (0.0 if added_variance_dn2 is None else added_variance_dn2)
    light = np.where(quiet.saturated, 0.0, light)
    power = float(light @ (light / variance))
    if unknown is not None:
        rows = unknown.rows(variance, np.where(quiet.saturated, 0.0, unknown.spectra))
        power -= float(np.sum((rows @ light) ** 2))
    return float(np.sqrt(max(power, 0.0)))


@lru_cache(maxsize=32)
def _gains(shape: Shape, window_s: float, frame_s: float) -> tuple[Float, Float]:
    """Return half-widths, (WIDTHS,), and the norm of detrended shapes by half-width and peak time, (WIDTHS, PEAKS)."""
    n = max(3, round(window_s / frame_s))
    edges = np.arange(n + 1) * frame_s
    line = np.stack([np.ones(n), np.linspace(-1, 1, n)])
    line /= np.linalg.norm(line, axis=1)[:, None]
    widths = np.geomspace(*WIDTH_RANGE_S, WIDTHS)
    # Peaks have irregular phases within frames, which averages over the phase of short flares.
    peaks = (np.arange(PEAKS) + 0.5) / PEAKS * n * frame_s + frame_s * ((np.arange(PEAKS) * 0.618034) % 1.0 - 0.5)
    gain = np.empty((WIDTHS, PEAKS))
    for i, half in enumerate(widths):
        tau = (edges[None, :] - peaks[:, None]) / half
        frames = consecutive_integrals(shape, tau) * half / frame_s
        gain[i] = np.linalg.norm(frames - (frames @ line.T) @ line, axis=1)
    return widths, np.maximum(gain, 1e-12)


@dataclass(frozen=True, eq=False)
class InjectedCompleteness:
    """Detection of injected flares."""

    half_widths_s: tuple[float, ...]
    sizes: Float  # shape (n_size,)
    amplitudes: Float  # shape (n_half_width, n_size)
    critical: Float  # smallest size that is detected in each draw, shape (n_half_width, n_position, n_draw)
    completeness: Float = field(init=False)  # detected fraction, shape (n_half_width, n_size)
    completeness_low: Float = field(init=False)  # ends of its 95 % interval
    completeness_high: Float = field(init=False)

    def __post_init__(self) -> None:
        cells = np.empty((3, len(self.half_widths_s), self.sizes.size))
        for d, s in np.ndindex(cells.shape[1:]):
            by_position = np.mean(self.critical[d] <= self.sizes[s], axis=1)
            # Intervals are those for the effective number of independent draws.
            fraction, trials = float(by_position.mean()), self._independent(by_position, self.count)
            around = clopper_pearson(round(fraction * trials), trials)
            cells[:, d, s] = fraction, min(around.low, fraction), max(around.high, fraction)
        set_read_only(self, completeness=cells[0], completeness_low=cells[1], completeness_high=cells[2])

    @property
    def count(self) -> int:
        """Injections per cell."""
        return int(self.critical[0].size)

    @staticmethod
    def _independent(fractions: Float, count: int) -> int:
        """Return the effective number of independent draws, reduced if positions differ (Kish's design effect)."""
        fraction = float(fractions.mean())
        binomial = fraction * (1 - fraction) / count
        if not binomial > 0 or fractions.size < 2:
            return count
        return max(1, int(count * min(1.0, binomial / max(float(fractions.var(ddof=1)) / fractions.size, 1e-300))))

    def limit(self, power: float, half_width: int | None) -> Interval:
        """Return the size at which the fraction `power` is detected, with a 95 % interval; infinite if never reached.

        `half_width` is the index of a half-width; None averages over all.
        """
        critical = self.critical if half_width is None else self.critical[half_width : half_width + 1]
        by_position = np.moveaxis(critical, 1, 0).reshape(critical.shape[1], -1)
        ordered = np.sort(by_position, axis=None)
        value = float(ordered[min(int(np.ceil(power * ordered.size)), ordered.size) - 1])
        trials = self._independent(np.mean(by_position <= value, axis=1), ordered.size)
        # Half-widths share draws and do not add independent ones.
        trials = max(1, min(trials, self.count))
        ranks = [int(k / trials * ordered.size) for k in central_counts(trials, power)]
        low, high = (float(ordered[min(max(k, 0), ordered.size - 1)]) for k in ranks)
        return Interval(value, min(low, value), max(high, value))

    def never(self, half_width: int | None) -> float:
        """Return the fraction that no template can detect because of gaps."""
        critical = self.critical if half_width is None else self.critical[half_width]
        return float(np.mean(np.isinf(critical)))

    def by_energy(self, energy_erg: Float, law: DurationLaw) -> Float:
        """Return the detected fraction of flares by energy, averaged over their half-widths, shape (n_energy,).

        Sizes are energies. Injections with an alarm without the flare, whose critical size is zero, are ignored, since
        false alarms are counted separately.
        """
        fractions = np.empty((len(self.half_widths_s), energy_erg.size))
        for row, critical in zip(fractions, self.critical, strict=True):
            counted = np.sort(critical[critical > 0])
            row[:] = np.searchsorted(counted, energy_erg, side="right") / max(counted.size, 1)
        half_widths, weights = law.quantiles(energy_erg)
        place = np.interp(np.log(half_widths), np.log(self.half_widths_s), np.arange(len(fractions)))
        below = np.minimum(place.astype(int), len(fractions) - 2)
        part, column = place - below, np.arange(energy_erg.size)[:, None]
        fraction = (1 - part) * fractions[below, column] + part * fractions[below + 1, column]
        return np.asarray(np.clip(fraction @ weights, 0.0, 1.0))


#: Energy steps per decade for sums of rates.
ENERGIES_PER_DECADE = 100
#: Number of quantiles of the scatter of a rate.
NODES = 1000
#: Range of fitted exponents, and number of energies of the grid for sums of flares.
EXPONENTS, GRID = (1.01, 6.0), 1200


@dataclass(frozen=True)
class Yield:
    """Number of flares that a campaign recovers, with the scatter of the rate and Poisson noise."""

    expected: float  #: mean at the nominal rate
    low: int  #: ends of the central 95 % of campaigns
    high: int
    at_least_one: float  #: probability of at least one flare

    @classmethod
    @validated
    def of(cls, rates: Rates, completeness: Completeness, days: NotNegative) -> Yield:
        """Compute the yield from flare rates, completeness and observed days; energies must be in the same band."""
        return cls.of_expected(recovered_per_day(rates, completeness) * days, rates.scatter_dex)

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
    edges = 10 ** np.linspace(low, high, max(2, round((high - low) * ENERGIES_PER_DECADE)))
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
    error_dex: NotNegative = 0.0,
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

    Raises
    ------
    InputError
        For fewer than 3 flares, energies that are not above 0, or a completeness that is zero at all energies.
    """
    energy = np.asarray(energy_erg, np.float64)
    if energy.size < 3 or not (np.isfinite(energy) & (energy > 0)).all():
        raise InputError(f"energy_erg has {energy.size} flares, but needs at least 3, all above 0", key="energy_erg")
    if not completeness.probability.any():
        raise InputError("the completeness must be above 0 at some energy, as flares are recovered", key="completeness")
    logs = np.log10(energy)
    pivot = float(np.median(logs))
    x = np.linspace(*completeness.decades, GRID)
    step = float(x[1] - x[0])
    chance = completeness.at(10**x)
    recovered = logs - bias_dex
    # The density is unconstrained where the completeness is zero, and may be huge there.
    used = chance > 0
    x, chance = x[used], chance[used]
    blur = stats.norm.pdf(recovered[:, None], x, error_dex) * step if error_dex > 0 else None

    def density(alpha: float) -> Float:
        """Return recovered flares per day and dex of true energy, for a rate of 1 above the pivot."""
        return np.asarray((alpha - 1) * np.log(10) * 10 ** ((1 - alpha) * (x - pivot)) * chance)

    def best_rate(alpha: float) -> float:
        """Return the logarithm of the most likely rate for an exponent."""
        return float(np.log10(logs.size / (days * step * density(alpha).sum())))

    def cost(alpha: float) -> float:
        """Return the negative log likelihood at the best rate for an exponent, less a constant."""
        flares = density(alpha)
        at = np.interp(recovered, x, flares) if blur is None else blur @ flares
        return float(-np.sum(np.log(np.maximum(at, 1e-300))) - logs.size * np.log(10) * best_rate(alpha))

    alpha = float(optimize.minimize_scalar(cost, bounds=EXPONENTS, method="bounded", options={"xatol": 1e-7}).x)
    # The curvature of the profile likelihood gives the error of the exponent; that of the rate has a part that is
    # independent of it, by Poisson's law, and one by the best rate that changes with the exponent.
    h = 1e-3
    alpha_sd = h / float(np.sqrt(cost(alpha + h) - 2 * cost(alpha) + cost(alpha - h)))
    along = (best_rate(alpha + h) - best_rate(alpha - h)) / (2 * h) * alpha_sd
    log10_rate_sd = float(np.hypot(along, 1 / (np.log(10) * np.sqrt(logs.size))))
    return FittedPowerLaw(alpha, alpha_sd, best_rate(alpha), log10_rate_sd, 10**pivot, logs.size)
