"""Rates of false alarms of a search: counted, in closed form, and by importance sampling.

*Counted rates.* Rates are false alarms per star-day, 86 400 s of frames (gaps do not count). Alarms occur in clusters,
of which a search reports the largest value, so that the probability of no alarm in t star-days is exp(-rate t).
Importance sampling covers rates that are too small to count.

*Closed form in white noise.* The templates of a bank form a grid over onset, half-width and temperature. An alarm is a
local maximum of the statistic on that grid, so the rate of local maxima above a threshold bounds the rate of alarms
from above and approaches it for high thresholds (Taylor, Worsley & Gosselin 2007, doi 10.1093/biomet/asm004):

    rate(u) = sum over templates of  integral_u^inf phi(z) * prod over axes of P(both neighbours < z | z) dz

Given z, the two neighbours along an axis are jointly normal with known correlations, and their joint probability
follows from Owen's T function (Owen 1956, doi 10.1214/aoms/1177728074). Neighbours in half-width are compared at the
onset of maximum correlation, which makes them independent of neighbours in onset to first order; neighbours in
temperature are independent of both.

*Importance sampling in normal noise* (docs/completeness.md, "False alarms"). One of the correlated values rho_j, i, is
chosen with a probability proportional to w_i, and the noise is drawn except for z = rho_i, so that every value is
r_j + c_ij z. Then, without bias and for any function G that is not zero above u,

    P(max > u) = sum(w) E[integral phi(z) G(z) 1(max_j rho_j > u) / sum_j w_j G(rho_j) dz].

Here G(z) = exp(u z) from slightly below u, so that the sum over a cluster follows its maximum, and the integral is
computed by quadrature. The weights w are the probabilities that a template is a local maximum, so that all clusters
contribute equally.

*Unknowns of a survey's stare* are drawn from a widened distribution and weighted accordingly. Where they increase the
scatter of a template's value by a factor r, it exceeds u as often as u / r is exceeded otherwise; where they shift it,
as often as u less the shift is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.detection.distributions import CONFIDENCE_SD, Interval, central_counts
from mauvecl.flares.frames import STEADY
from mauvecl.flares.stare import select_frames
from mauvecl.host.arrays import Bool, Float
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import DAY_S
from mauvecl.search.search import Bank, Search
from mauvecl.search.survey import Survey

#: Smallest number of alarms for a counted threshold.
MIN_ALARMS = 10


def counted_threshold(maxima: Float, days: float, rate: float) -> Interval:
    """Return the threshold for a number of false alarms per star-day, with a 95 % interval, from counts.

    `maxima`, ascending, are the largest values of stares of some star-days without a flare. Raises InputError if it is
    expected that fewer than 10 stares alarm, or fewer than 10 do not.
    """
    n = maxima.size
    alarmed = -np.expm1(-rate * days)
    if min(alarmed, 1 - alarmed) * n < MIN_ALARMS:
        raise InputError(
            f"{rate:g} false alarms per star-day occur in {alarmed * n:.3g} of {n} simulated stares, but a "
            f"threshold needs at least {MIN_ALARMS} with an alarm and as many without",
            key="false_alarms",
        )
    low, high = central_counts(n, 1 - alarmed)
    ranks = np.clip([round(n * (1 - alarmed)), low, high], 0, n - 1)
    return Interval(*(float(maxima[k]) for k in ranks))


def consecutive_alarm_rate(points: int, sigma: float, frame_s: float) -> float:
    """Return the false alarms per star-day of the rule of consecutive points in white noise."""
    above = float(scipy.special.ndtr(-sigma))
    frames = DAY_S / frame_s
    # A run starts at the first frame or after a frame that is not above sigma.
    return above**points * (1 + (frames - points) * (1 - above))


#: Gauss-Laguerre nodes for the integral over z, in the variable (z^2 - u^2) / 2.
N_NODES = 32
#: Threshold at which `TemplateGrid.peak_probabilities` weights templates.
WEIGHTING_THRESHOLD = 5.0
#: Correlations are clipped here to keep 1 - r^2 positive.
MAX_CORRELATION = 1 - 1e-12


@dataclass(frozen=True, eq=False)
class TemplateGrid:
    """Correlations between neighbouring templates of a bank.

    Rows of correlations are those with both neighbours along an axis and that between these; the correlation with a
    neighbour that does not exist is -1.
    """

    frame_s: float
    templates_per_frame: Float  # shape (n_row,); one row per half-width and sub-frame phase
    onset: Float  # shape (n_row, 3)
    width: Float  # shape (n_row, 3)
    temperature: Float  # shape (n_temperature, 3)

    @classmethod
    def from_bank(cls, bank: Bank) -> TemplateGrid:
        """Compute the correlations between all neighbouring templates of a bank."""
        # Detrended templates of unit length on common frames, (n_phase, n_frame), for each half-width. Zeros on both
        # sides leave room for shifts.
        room = max(-template.first for template in bank.templates)
        size = 2 * room + max(template.first + template.time.size for template in bank.templates)
        rows = [np.zeros((len(template.phases), size + room)) for template in bank.templates]
        for template, filters in zip(bank.templates, rows, strict=True):
            begin = 2 * room + template.first
            for phase, row in enumerate(filters):
                shape = template.detrended(phase, bank.baseline.powers)
                row[begin : begin + shape.size] = shape / np.linalg.norm(shape)
        per_frame, onset, width = [], [], []
        for k, (template, filters) in enumerate(zip(bank.templates, rows, strict=True)):
            # The phases within a frame are followed by those of the next onset.
            onsets = np.concatenate([np.roll(filters, n * template.stride, axis=1) for n in (-1, 0, 1)])
            for p, vector in enumerate(filters, len(filters)):
                per_frame.append(1 / template.stride)
                onset.append(_neighbour_correlations(vector, [onsets[p - 1], onsets[p + 1]]))
                aligned = []
                for neighbours in _next_to(rows, k):
                    # The filter, of the neighbours at any shift, that has the largest correlation with this one.
                    products = np.array([scipy.signal.correlate(vector, row, method="fft") for row in neighbours])
                    best_row, shift = np.unravel_index(int(np.argmax(products)), products.shape)
                    aligned.append(np.roll(neighbours[best_row], int(shift) - vector.size + 1))
                width.append(_neighbour_correlations(vector, aligned))
        directions = list(bank.directions)
        temperature = [_neighbour_correlations(vector, _next_to(directions, k)) for k, vector in enumerate(directions)]
        return cls(bank.frame_s, *map(np.array, (per_frame, onset, width, temperature)))

    def false_alarms_per_second(self, threshold: float) -> float:
        """Return the rate of local maxima above `threshold`, in standard deviations of the statistic."""
        return float(np.sum(self.templates_per_frame @ self.peak_probabilities(threshold))) / self.frame_s

    def peak_probabilities(self, threshold: float) -> Float:
        """Return the probability that each template has a local maximum above `threshold`, (n_row, n_temperature)."""
        x, weights = np.polynomial.laguerre.laggauss(N_NODES)
        z = np.sqrt(threshold**2 + 2 * x)
        density = weights / z * np.exp(-(threshold**2) / 2) / np.sqrt(2 * np.pi)
        onset, width, temperature = (_below(z, rows) for rows in (self.onset, self.width, self.temperature))
        return np.asarray(np.einsum("z,rz,tz->rt", density, onset * width, temperature))


def _next_to(values: list[Float], k: int) -> list[Float]:
    """Return the neighbours of an element."""
    return values[max(k - 1, 0) : k] + values[k + 1 : k + 2]


def _neighbour_correlations(vector: Float, neighbours: list[Float]) -> tuple[float, float, float]:
    """Return the correlations with two neighbours and between them; without one, those with its opposite."""
    before, after = [*neighbours, -vector, -vector][:2]
    return float(vector @ before), float(vector @ after), float(before @ after)


def _below(z: Float, correlations: Float) -> Float:
    """Return P(both neighbours < z | z), shape (n, n_node), for correlations of shape (n, 3)."""
    a, b, between = np.clip(correlations.T[:, :, None], -MAX_CORRELATION, MAX_CORRELATION)
    # A neighbour with correlation r is normal with mean r z and variance 1 - r^2.
    h, k = (z * np.sqrt((1 - r) / (1 + r)) for r in (a, b))
    r = np.clip((between - a * b) / np.sqrt((1 - a * a) * (1 - b * b)), -MAX_CORRELATION, MAX_CORRELATION)
    root = np.sqrt(1 - r * r)
    owen, ndtr = scipy.special.owens_t, scipy.special.ndtr
    return np.asarray((ndtr(h) + ndtr(k)) / 2 - owen(h, (k / h - r) / root) - owen(k, (h / k - r) / root))


#: Sampled thresholds; between them, the logarithm of the number of independent templates is a cubic polynomial.
STEP = 0.25
LADDER = tuple(float(u) for u in np.arange(3.0, 8.01, STEP))
#: Number of coefficients of that polynomial.
POWERS = 4
#: Number of draws, for a standard error of the rate of 3-4 % at one false alarm per star-month.
DRAWS = 160
#: Largest probability of an alarm in a stare for which importance sampling is used.
MAX_PROBABILITY = 0.7
#: Number of thresholds at which rates are tabulated for interpolation, and change of scatter that is neglected.
FINE, NEGLIGIBLE = 20_000, 1e-6
#: Second half of the generator's key, which makes the draws independent of others.
NULL_KEY = 0x6E756C6C
#: G is zero below u - BELOW / u.
BELOW = 4.0
#: Nodes of the integral over the chosen template's value.
NODES = 6
#: Smallest weight of a template relative to the largest.
MIN_WEIGHT = 1e-3
#: Smallest correlation with the chosen template for which a value's crossing of the threshold is computed.
MIN_CORRELATION = 0.05


@dataclass(frozen=True, eq=False)
class SampledRate:
    """False-alarm rate in normal noise from importance sampling."""

    thresholds: Float  # shape (n,)
    probability: Float  # P(max > threshold) of a stare, shape (n,)
    error: Float  # standard error of `probability`
    days: float  # star-days of the stare
    shifted: bool = False  # stares have trends that the search neither subtracts nor marginalises over

    @property
    def likely(self) -> tuple[float, float, float]:
        """Threshold that about three stares in ten exceed, its probability, and the standard error."""
        k = int(np.argmin(np.abs(self.probability - 0.3)))
        return float(self.thresholds[k]), float(self.probability[k]), float(self.error[k])

    @property
    def _trusted(self) -> NDArray[np.bool_]:
        """True for thresholds that few enough stares exceed, shape (n,)."""
        return np.asarray(self.probability <= MAX_PROBABILITY)

    @property
    def _relative(self) -> Float:
        """Relative standard error of the rate at each trusted threshold: d(-ln(1 - P)) = dP / (1 - P)."""
        p = self.probability[self._trusted]
        return np.asarray(self.error[self._trusted] / (1 - p) / -np.log1p(-p))

    def _fit(self) -> np.polynomial.Polynomial:
        """Fit a polynomial to log(rate / Q) as a function of the threshold."""
        u, p = self.thresholds[self._trusted], self.probability[self._trusted]
        logs = np.log(-np.log1p(-p) / self.days) - scipy.special.log_ndtr(-u)
        return np.polynomial.Polynomial.fit(u, logs, min(POWERS, u.size) - 1, w=1 / self._relative)

    def under(self, scales: Float, weights: Float, shifts: Float, shares: Float) -> SampledRate:
        """Return the rate for stares whose noise differs from that which the search assumes; see `draw_shifts`."""
        shifted = bool(shifts.any())
        if np.abs(scales - 1).max() < NEGLIGIBLE and not shifted:
            return self
        # The rate is tabulated finely enough for linear interpolation.
        low, high = self.thresholds[0] / scales.max(), self.thresholds[-1] / scales.min()
        # Shifted values exceed a threshold as often as unshifted ones exceed a much lower one.
        fine = np.linspace(0.0 if shifted else low, high, FINE)
        rates = np.exp(scipy.special.log_ndtr(-fine) + self._fit()(fine))
        largest = np.where(shares > 0, shifts, -np.inf).max(axis=1)
        probability, error = np.zeros((2, self.thresholds.size))
        for k, threshold in enumerate(self.thresholds):
            # Probability of an alarm in each draw of a stare.
            per_day = np.zeros(weights.size)
            for shift, share in zip(shifts, shares.T, strict=True):
                per_day += share * np.interp((threshold - shift) / scales, fine, rates).mean(axis=1)
            alarm = -np.expm1(-self.days * per_day)
            if shifted:
                # A few templates with a large mean suffice for an alarm.
                alarm = 1 - np.exp(-self.days * per_day) * scipy.special.ndtr(threshold - largest)
            probability[k] = weights @ alarm
            spread = np.sqrt(np.sum((weights * (alarm - probability[k])) ** 2))
            error[k] = np.hypot(spread, probability[k] * self.error[k] / self.probability[k])
        return SampledRate(self.thresholds, probability, error, self.days, shifted)

    def log_rate(self, threshold: float) -> tuple[float, float]:
        """Return the logarithm of false alarms per star-day, and its standard error."""
        trusted = self._trusted
        # All thresholds share draws, so that their errors are correlated and do not average out.
        error = float(np.interp(threshold, self.thresholds[trusted], self._relative))
        if self.shifted:
            logs = np.log(-np.log1p(-self.probability[trusted]) / self.days)
            return float(scipy.interpolate.PchipInterpolator(self.thresholds[trusted], logs)(threshold)), error
        return float(scipy.special.log_ndtr(-threshold) + self._fit()(threshold)), error

    def threshold(self, rate: float) -> Interval:
        """Return the threshold for a number of false alarms per star-day, with a 95 % interval.

        Raises InputError if it is outside the sampled range, or if trends cause more alarms at all sampled thresholds.
        """
        most = float(self.probability[-1])
        if self.shifted and most >= -np.expm1(-rate * self.days):
            least = -np.log1p(-min(most, 1 - 1e-16)) / self.days
            raise InputError(
                f"false alarms per star-day must be at least {least:.2g}, not {rate:g}: what is unknown of the stare "
                "moves the level in ways that the search does not marginalise over (see search.cycle, slope, offset "
                "and window_s)",
                key="false_alarms",
            )
        # From one step below the lowest trusted threshold.
        low, high = float(self.thresholds[self._trusted][0] - STEP), float(self.thresholds[-1])
        goal = np.log(rate)
        if not self.log_rate(high)[0] <= goal <= self.log_rate(low)[0]:
            ends = [float(np.exp(self.log_rate(u)[0])) for u in (high, low)]
            raise InputError(
                f"false alarms per star-day must be {ends[0]:.2g} to {ends[1]:.2g} for importance sampling of stares "
                f"of {self.days:.3g} star-days, not {rate:g}",
                key="false_alarms",
            )
        value = float(scipy.optimize.brentq(lambda u: self.log_rate(u)[0] - goal, low, high, xtol=1e-6))
        # The rate falls by about a factor exp(-u) per unit of u.
        reach = CONFIDENCE_SD * self.log_rate(value)[1] / value
        return Interval(value, value - reach, value + reach)


def normal_noise_rate(search: Search, *, seed: int, draws: int = DRAWS) -> SampledRate:
    """Estimate the false-alarm rate of a search in normal noise of the assumed variance.

    The stare should not exceed a few days, since every draw evaluates all templates.
    """
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, NULL_KEY]))
    rows, n_sum = search.grid, search.bank.directions.shape[1]
    tried = [np.flatnonzero(row.per_amplitude > 0) for row in rows]
    sizes = np.array([t.size for t in tried])
    if not sizes.any():
        raise InputError.of("half_widths_s", search.bank.half_widths_s, "templates that fit into the stare")
    weights = TemplateGrid.from_bank(search.bank).peak_probabilities(WEIGHTING_THRESHOLD)
    weights = np.maximum(weights, MIN_WEIGHT * weights.max())
    shares = np.cumsum(weights * sizes[:, None])
    estimates = np.empty((draws, len(LADDER)))
    directions, noise_sd = search.bank.directions, np.sqrt(search.variance)
    for n in range(draws):
        chosen = int(np.searchsorted(shares, rng.random() * shares[-1], "right"))
        number, direction = divmod(chosen, len(directions))
        template = search.in_time(rows[number], np.array([int(rng.choice(tried[number]))]))[0]
        noise = noise_sd[:, None] * rng.standard_normal((search.stare.n_frames, n_sum))
        value, along = template @ noise @ directions[direction], directions @ directions[direction]
        # One more sum holds the response that changes the chosen template's value by one, since it is proportional to
        # the template in time.
        sums, values = np.column_stack([noise, template * search.variance]), list[Float]()
        for (row, (correlated,)), weight in zip(search.correlations(sums[None]), weights, strict=True):
            at = row.per_amplitude > 0
            c = along[:, None] * correlated[n_sum, at]
            r = directions @ correlated[:n_sum, at] - value * c
            near, w = np.flatnonzero(_is_near(r, c, LADDER[0])), np.broadcast_to(weight[:, None], r.shape)
            values.append(np.array([terms.ravel()[near] for terms in (r, c, w)]))
        estimates[n] = _estimates(np.concatenate(values, axis=1))
    estimates *= shares[-1]
    error = estimates.std(axis=0, ddof=1) / np.sqrt(draws)
    return SampledRate(np.array(LADDER), estimates.mean(axis=0), error, search.stare.observed_s / DAY_S)


#: Nodes and weights of an integral over exp(-x).
_X, _W = np.polynomial.laguerre.laggauss(NODES)


def _is_near(r: Float, c: Float, u: float) -> Bool:
    """Return whether G may be positive for values at a node of the integral for a threshold u, or for a higher one."""
    least = u - BELOW / u
    return np.asarray(r + np.abs(c) * (u + _X[-1] / least) > least)


def _estimates(values: Float) -> Float:
    """Return one draw's estimates of P / sum(w) at each threshold, from r, c and w of its values."""
    estimates = np.zeros(len(LADDER))
    for k, u in enumerate(LADDER):
        least = u - BELOW / u
        r, c, w = values = values[:, _is_near(values[0], values[1], u)]
        # Value z at which each template exceeds the threshold; the chosen one (r = 0, c = 1) does at z = u.
        crossing = np.divide(u - r, c, out=np.full(r.size, u), where=c > MIN_CORRELATION)
        z = max(least, min(u, float(crossing.min())))
        if ((r + least * c) > u).any():
            z = least
        nodes = z + _X / z
        rho = r + nodes[:, None] * c
        total = (np.exp(u * (rho - u)) * (rho > least)) @ w
        # The tolerance allows for rounding of the crossing value.
        exceeds = rho.max(axis=1) > u * (1 - 1e-12)
        density = np.exp(-(nodes**2) / 2 + u * (nodes - u) + _X) / np.sqrt(2 * np.pi) / z
        estimates[k] = np.sum(_W * density * np.divide(exceeds, total, out=np.zeros(NODES), where=exceeds))
    return estimates


#: Largest length of the part of a stare that importance sampling uses, star-days.
SAMPLED_DAYS = 2.0
#: Number of draws of the unknowns, and of times in the stare at which the noise is evaluated.
RATE_DRAWS, POINTS = 500, 16
#: Factor by which half of the proposals are widened.
WIDENING = 1.5
#: Second half of the generator's key.
CONDITIONS_KEY = 0x636F6E64
#: Shift that is neglected, bin width of shifts, and number of draws of which one is used for shifts.
MIN_SHIFT, SHIFT_STEP, ONE_IN = 0.2, 0.1, 4
#: Largest shift; larger ones are counted in the last bin.
MAX_SHIFT = 60.0


def sampled_rate(survey: Survey, seed: int) -> SampledRate:
    """Estimate the false-alarm rate of a survey by importance sampling, including the unknowns of its stare."""
    part, n = survey, int(SAMPLED_DAYS * DAY_S / survey.stare.frame_s)
    if survey.stare.n_frames > n:
        part = replace(survey, stare=select_frames(survey.stare, slice(0, n)))
    return normal_noise_rate(part.search, seed=seed).under(*draw_shifts(survey, seed, part))


def draw_shifts(survey: Survey, seed: int, part: Survey) -> tuple[Float, Float, Float, Float]:
    """Draw the unknowns of a stare and compute scatter and, in a part of the stare, shift of templates' values.

    Returns the standard deviations of values at some times and all temperatures, nominally 1, (n_draw, n); the weights
    of the draws, of sum 1; means of values, ascending, (n_shift,); and the shares of templates with each mean,
    (n_draw, n_shift).
    """
    rows, at = survey.bank.directions, np.zeros(survey.stare.n_frames, np.bool_)
    at[np.linspace(0, at.size - 1, POINTS).astype(int)] = True
    sample = replace(survey, stare=select_frames(survey.stare, at))
    rng = np.random.Generator(np.random.Philox(key=[seed % 2**64, CONDITIONS_KEY]))
    n = len(survey.stare.unknowns)
    z = rng.standard_normal((RATE_DRAWS, n))
    z[RATE_DRAWS // 2 :] *= WIDENING
    log = -np.sum(z**2, axis=1) / 2
    weights = np.exp(log - np.logaddexp(log, log / WIDENING**2 - n * np.log(WIDENING)))
    coefficients = np.tile(sample.coefficients, (RATE_DRAWS, 1, 1))
    coefficients[..., : len(STEADY)] *= np.moveaxis(sample.unknowns.factors(z), 0, 2)
    covariance = sample.components.jittered_covariance(coefficients, sample.stare)
    variance = np.einsum("dk,ntkl,dl->ntd", rows, covariance, rows, optimize=True) / sample.variance[:, None]
    scales = np.sqrt(np.maximum(variance, 1e-12)).reshape(RATE_DRAWS, -1)
    # Unknowns of several standard deviations may shift a template's value.
    if part.search.largest(part.unsubtracted(part.unknowns.extremes)).max() <= MIN_SHIFT:
        return scales, weights / weights.sum(), np.zeros(1), np.ones((RATE_DRAWS, 1))
    # The same share of draws from both halves.
    draws = slice(None, None, ONE_IN)
    weights = weights[draws]
    return scales[draws], weights / weights.sum(), *_shifts(part, z[draws])


def _shifts(survey: Survey, amplitudes: Float) -> tuple[Float, Float]:
    """Return binned means of templates' values, (n_shift,), and the share of templates in each, (n_draw, n_shift)."""
    bins = np.arange(-MAX_SHIFT, MAX_SHIFT + SHIFT_STEP, SHIFT_STEP)
    shares = np.zeros((len(amplitudes), bins.size))
    weights = TemplateGrid.from_bank(survey.bank).peak_probabilities(WEIGHTING_THRESHOLD)
    for draw, amplitude in enumerate(amplitudes):
        for (row, rho), weight in zip(survey.search.values(survey.unsubtracted(amplitude[None])), weights, strict=True):
            means = rho[0][:, row.per_amplitude > 0]
            place = np.clip(np.rint((means + MAX_SHIFT) / SHIFT_STEP), 0, bins.size - 1).astype(np.int64)
            weight_of_each = np.broadcast_to(weight[:, None], means.shape)
            shares[draw] += np.bincount(place.ravel(), weight_of_each.ravel(), bins.size)
    shares /= shares.sum(axis=1, keepdims=True)
    used = shares.any(axis=0)
    return bins[used], shares[:, used]
