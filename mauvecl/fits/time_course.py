"""Fits of flares along a stare: in bins of frames, and with a temperature that falls.

A joint fit finds a flare's shape and spectrum, with a temperature that falls. Frames are reduced to weighted sums that
are sufficient for spectra of all temperatures (`flare_model`). The model of their means is one `Event` with `Cooling`.
Their covariances depend on the fitted flare, so that each fit is repeated with the covariances of the previous one.
Unknown levels that are constant over the stare, and the unknown changes and jitters of the stare, are marginalised
over. Those of all light change that of the flare as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import product
from typing import TYPE_CHECKING, Annotated, NamedTuple, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mauvecl.detection.nuisances import Nuisances, fitted_amplitudes, spectrum_of
from mauvecl.fits.flare_model import NODE_STRIDE, FlareModel, Ranges, RawCounts, ReducedSums
from mauvecl.fits.least_squares import interval_end, parameter_covariance
from mauvecl.fits.spectrum import LEVELS, Measurement, clipped_pixels, fit
from mauvecl.flares import Cooling
from mauvecl.flares.frames import Components, known_strengths
from mauvecl.flares.shapes import Shape, shape_of
from mauvecl.flares.stare import Event, Stare
from mauvecl.host.arrays import Float, array_cache
from mauvecl.noise.unknowns import CHANGED_PART, CHANGING, Changing
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Column, table_of
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Amplitude, Duration, Moment, Probability, Range, Wavelength, range_of

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.exposure.expectation import Expectation


#: Bins span at most this many frames, which bounds the time that the search for them takes.
MOST_FRAMES_PER_BIN = 4096
#: Every n-th temperature of the model is tried for the filter that chooses the bins.
BINS_EVERY = 8
#: Bins whose known conditions agree to this many digits are fitted together.
DIGITS = 6

#: Heading, format and heading of the error of quantities in printed tables.
SHOWN = {
    "temperature": ("temperature (K)", ".0f", "error"),
    "flux_bolometric": ("bolometric flux (erg/s/cm2)", ".3g", ""),
}


@dataclass(frozen=True, eq=False)
class MeasuredBins:
    """Flares measured in bins of consecutive frames; arrays have the shape (n_bin,)."""

    first: NDArray[np.intp]  #: first frame of each bin
    count: NDArray[np.intp]  #: number of frames in it
    start_s: Float
    end_s: Float
    #: One row per bin. Amplitudes, fluxes and luminosities are means over the bin; energies are those within it.
    found: Measurement

    def table(self) -> QTable:
        """Return times, estimates, errors and intervals, one row per bin."""
        return table_of(self.columns, [self])

    @property
    def columns(self) -> list[Column]:
        """Columns of the table; those of the quantities depend on the model."""
        found = self.found
        return [
            Column("start", "start_s", "s", "start of the bin, from the start of the stare", "from (s)", "g"),
            Column("end", "end_s", "s", "end of the bin", "to (s)", "g"),
            Column("frames", "count", "", "frames of the bin"),
            Column("snr", "found.snr", "", "S/N of the flare in the bin", "S/N", ".1f"),
            *(column for q in range(len(found.names)) for column in _columns_of(found, q)),
            Column("chi2", "found.chi2", "", f"chi-squared of the fit, of {found.dof} degrees of freedom"),
            Column("p_value", "found.p_value", "",
                   "probability of a chi-squared at least as large if the model is correct", "p-value", ".2g"),
        ]  # fmt: skip


def _columns_of(measured: Measurement, q: int) -> list[Column]:
    """Return the columns of a quantity's estimates, errors and intervals."""
    from astropy import units

    name = measured.names[q]
    column, unit = name.replace(" ", "_"), str(units.Unit(measured.units[q]))
    heading, spec, error = SHOWN.get(column, ("", "", ""))
    columns = [
        Column(column, lambda _: measured.estimates[:, q], unit, f"{name} of the flare", heading, spec),
        Column(f"{column}_error", lambda _: measured.errors[:, q], unit, "its standard error", error, spec),
    ]
    for level, *ends in zip(measured.levels, measured.low, measured.high, strict=True):
        text = f"end of its {100 * level:.4g} % interval; infinite where there is none"
        for side, values in zip(("lower", "higher"), ends, strict=True):
            named = f"{column}_{side.removesuffix('er')}_{100 * level:.0f}"
            columns.append(Column(named, partial(lambda ends, _: ends[:, q], values), unit, f"{side} {text}"))
    return columns


@validated
def measure_along(
    frames: RawCounts,
    quiet: Expectation,
    model: FlareModel,
    nuisances: Nuisances | None = None,
    *,
    snr_per_bin: Annotated[float, Range(0, open_low=True)] = 20.0,
    stare: Stare | None = None,
    levels: Sequence[Probability] = LEVELS,
    skipped_nm: Sequence[tuple[Wavelength, Wavelength]] = (),
) -> MeasuredBins:
    """Measure a flare against time, in bins of consecutive frames in which it reaches an S/N.

    Each bin is the shortest run of frames after the previous bin in which a matched filter reaches `snr_per_bin`; its
    frames are added up and fitted as one exposure (`fit`). Frames without enough light before, between and after
    flares are not in any bin. The filter has the temperature that fits the brightest part of the stare. Since noise
    also decides where a bin ends, amplitudes are biased high by about one standard error over `snr_per_bin`; below an
    S/N of 8, noise alone occasionally produces bins.

    Parameters
    ----------
    frames : array_like, shape (n_frame, n_pixel)
        Raw DN of single frames.
    quiet : Expectation
        One frame of the quiescent star.
    model : FlareModel
        Model of one frame.
    nuisances : Nuisances, optional
        Unknown amplitudes of known spectra, for one frame; each bin has its own constant amplitudes.
    snr_per_bin : float
    stare : Stare, optional
        Times, known conditions and unknown changes of the frames; frames without gaps and changes by default. An
        unknown change of the stare has its prior in each bin, unless `nuisances` has one of the same name. Bins do
        not extend over gaps.
    levels : sequence of float
        Nominal coverage of the intervals.
    skipped_nm : sequence of tuple
        Wavelength ranges of pixels that are not used.

    Raises
    ------
    InputError
        If the frames have another shape, the expectation has several frames, or no bin reaches the S/N.
    """
    raw, stare = checked_frames(frames, quiet, stare)
    reduction = ReducedSums.of(model, quiet, nuisances=nuisances, skipped_nm=skipped_nm)
    sums = excess_sums(raw, quiet, known_strengths(stare, quiet), reduction.weights)
    total = np.vstack([np.zeros(sums.shape[1]), np.cumsum(sums, axis=0)])
    shapes = reduction.hot[::BINS_EVERY] / np.linalg.norm(reduction.hot[::BINS_EVERY], axis=1)[:, None]
    widths = 2 ** np.arange(int(np.log2(len(raw))) + 1)
    best = [((total[w:] - total[:-w]) @ shapes.T).max(axis=0) / np.sqrt(w) for w in widths]
    node = int(np.argmax(np.max(best, axis=0)))
    light = model.hot[::BINS_EVERY][node]
    weights = shapes[node] @ reduction.weights
    # The variance of a frame's value is one plus that of the flare's photons, which is proportional to its light.
    per_value = float(weights**2 @ (quiet.gain_dn_per_electron * light) / (weights @ light))
    value = total @ shapes[node]
    bins = []
    gaps = np.flatnonzero(np.diff(stare.numbers) > 1) + 1
    for begin, stop in zip([0, *gaps], [*gaps, len(raw)], strict=True):
        start = int(begin)
        for end in range(int(begin) + 1, int(stop) + 1):
            earliest = max(start, end - MOST_FRAMES_PER_BIN)
            gain = value[end] - value[earliest:end]
            variance = np.arange(end - earliest, 0, -1) + per_value * np.maximum(gain, 0.0)
            reached = np.flatnonzero(gain >= snr_per_bin * np.sqrt(variance))
            if reached.size:
                bins.append((earliest + int(reached[-1]), end))
                start = end
    if not bins:
        raise InputError.of("snr_per_bin", snr_per_bin, "an S/N that a bin of the stare reaches")
    first, end = np.array(bins).T
    return fit_bins(raw, quiet, model, nuisances, stare, first, end - first, levels, skipped_nm)


def checked_frames(frames: ArrayLike, quiet: Expectation, stare: Stare | None) -> tuple[Float, Stare]:
    """Return raw frames, (n_frame, n_pixel), and their stare, by default one without gaps and changes.

    Raises InputError unless frames, stare and expectation agree.
    """
    raw = np.asarray(frames, np.float64)
    if raw.ndim != 2:
        raise InputError(f"frames must have two dimensions, frames and pixels, not the shape {raw.shape}", key="frames")
    if stare is None:
        celsius = quiet.conditions["temperature_c"]
        stare = Stare.of(max(len(raw), 1) * quiet.frame_s, frame_s=quiet.frame_s, temperature_c=celsius)
    n_pixel = quiet.wavelength_nm.size
    if raw.shape != (stare.n_frames, n_pixel):
        raise InputError(f"frames must have the shape {(stare.n_frames, n_pixel)}, not {raw.shape}", key="frames")
    if not np.isfinite(raw).all():
        raise InputError("frames must hold finite numbers, but some are undefined", key="frames")
    if quiet.n_frames != 1:
        raise InputError.of("n_frames", quiet.n_frames, "one frame of the quiescent star")
    return raw, stare


def fit_bins(
    raw: Float, quiet: Expectation, model: FlareModel, nuisances: Nuisances | None, stare: Stare,
    first: NDArray[np.intp], count: NDArray[np.intp], levels: Sequence[float] = LEVELS, skipped_nm: Ranges = (),
) -> MeasuredBins:  # fmt: skip
    """Fit bins of frames; parameters as for `measure_along`, with the first frames of bins and their numbers."""
    strengths, end = known_strengths(stare, quiet), first + count
    alike: dict[tuple[float, ...], list[int]] = {}
    for k, (a, b) in enumerate(zip(first, end, strict=True)):
        # Variances of the unknown changes, averaged over the bin.
        variances = {of: sd**2 / (b - a) for of, sd in stare.jitters.items()} | {"star": 0.0}
        for unknown in stare.unknowns:
            variances[unknown.of] += (unknown.sd * float(unknown.curve[a:b].mean())) ** 2
        if stare.pointing is not None:
            variances["light"] += stare.pointing.depth**2
        mean = [*strengths[a:b].mean(axis=0), *(float(np.sqrt(variances[of])) for of in CHANGING)]
        alike.setdefault((float(b - a), *np.round(mean, DIGITS).tolist()), []).append(k)
    measurements = []
    for (length, star, sky, dark, light, *spreads), rows in alike.items():
        n = int(length)
        stacked = replace(
            quiet, n_frames=n, source_electrons=star * quiet.source_electrons,
            sky_electrons=sky * quiet.sky_electrons, dark_dn=dark * quiet.dark_dn,
            neighbour_electrons=light * quiet.neighbour_electrons,
        )  # fmt: skip
        unknowns = Nuisances.of(stacked, {})
        if nuisances is not None:
            unknowns = replace(nuisances, spectra=n * nuisances.spectra)
        for of, sd in zip(CHANGING, spreads, strict=True):
            name = CHANGED_PART[of]
            if not sd > 0.0 or name in unknowns.names:
                continue
            if name == "star":
                unknowns = unknowns.with_spectrum(name, stacked.net_source_dn, sd)
            elif spectrum_of(name, stacked).any():
                unknowns = unknowns.joined(Nuisances.of(stacked, {name: sd}))
        added = np.array([raw[first[k] : end[k]].sum(axis=0) for k in rows])
        nuisances_of_bins = unknowns if unknowns.names else None
        stacked_model = model.stacked(n, light)
        measurements.append(fit(added, stacked, stacked_model, nuisances_of_bins, levels=levels, skipped_nm=skipped_nm))
    measurement = Measurement.joined(measurements, list(alike.values()))
    return MeasuredBins(first, count, stare.start_s[first], stare.start_s[end - 1] + stare.frame_s, measurement)


def excess_sums(raw: Float, quiet: Expectation, known: Float, weights: Float) -> Float:
    """Return weighted sums, (n_frame, n_sum), of frames less their means without a flare for `known_strengths`."""
    means = np.vstack([quiet.net_source_dn, quiet.sky_dn, quiet.dark_dn, quiet.neighbour_dn, quiet.bias_dn])
    strengths = np.column_stack([known, np.ones(len(known))])
    return np.asarray(raw @ weights.T - strengths @ (means @ weights.T))


#: Whitens sums, (n, n_frame, n_sum), to the shape (n, n_frame n_sum), or to more columns if levels are unknown.
Whiten = Callable[[Float], Float]

#: Places of the parameters: peak time in s; logarithms of half-width in s, amplitude, and temperature at the peak in K;
#: logarithm of the end temperature, as the share of the way from that of the coolest temperature of the model to that
#: at the peak; and logarithm of the cooling time in s.
PEAK, WIDTH, AMPLITUDE, KELVIN, END, FOLD = range(6)
N_PARAMETERS = 6
#: Number of fits after the first, each with the covariances of the previous fit.
REFITS = 3


@dataclass(frozen=True, eq=False)
class _Level:
    """Unknown amplitude of known changes of the frames."""

    sd: float  # of its prior
    sums: Float  # change of the frames without a flare for unit amplitude, shape (n_frame, n_sum)
    curve: Float  # change of the flare's light, shape (n_frame,); zero if it does not change
    # Sums of a blackbody of amplitude 1 for a curve of 1, over log temperature.
    flare: scipy.interpolate.CubicSpline

    def around(self, flare: tuple[Float, Float] | None) -> Float:
        """Return the changes for unit amplitude next to a flare of known strengths, shape (n_frame, n_sum)."""
        if flare is None or not self.curve.any():
            return self.sums
        rise, log_k = flare
        return np.asarray(self.sums + (self.curve * rise)[:, None] * self.flare(log_k))


@dataclass(frozen=True, eq=False)
class _Data:
    """Sums of frames less their known means, and their covariances."""

    sums: Float  # shape (n_frame, n_sum)
    edges: Float  # starts and ends of frames, s, shape (n_frame, 2)
    light: Float  # known factors on the light of the flare, shape (n_frame,)
    quiet_covariance: Float  # shape (n_frame, n_sum, n_sum)
    unknown: tuple[_Level, ...]  # levels of the stare
    jitters: tuple[_Level, ...]  # levels that differ from frame to frame
    reduction: ReducedSums
    model: FlareModel
    shape: Shape
    spread: scipy.interpolate.CubicSpline  # covariance that a blackbody of amplitude 1 adds, over log temperature

    def intrinsic(self, values: Float) -> Float:
        """Return values of the frames that are proportional to the light, before the known losses of it."""
        return np.asarray(values / np.where(self.light > 0, self.light, 1.0))

    @cached_property
    def flare(self) -> Callable[[Float], tuple[Float, Float, Float, Float]]:
        """Function of the parameters: amplitude and log temperature of each frame, and their slopes, (6, n_frame)."""
        return array_cache(2)(self._flare)

    def _flare(self, theta: Float) -> tuple[Float, Float, Float, Float]:
        """Compute the values of `flare`."""
        peak_s, log_peak_k, end_share = theta[[PEAK, KELVIN, END]]
        width, amplitude, fold = np.exp(theta[[WIDTH, AMPLITUDE, FOLD]])
        rise = amplitude * self.light * self.shape.mean_over(self.edges, peak_s, width)
        since, (coolest, hottest) = np.maximum(self.edges.mean(axis=1) - peak_s, 0.0), self.model.log_k[[0, -1]]
        # Temperatures over that at the peak, as in `Cooling`.
        left, above = np.exp(-since / fold), log_peak_k - coolest
        end = float(np.exp((end_share - 1.0) * above))
        cooled = end + (1.0 - end) * left
        log_k, falling, ended = log_peak_k + np.log(cooled), (1.0 - end) * left / cooled, end * (1.0 - left) / cooled
        tau, span = (self.edges - peak_s) / width, np.diff(self.edges, axis=1)[:, 0]
        at, factor = self.shape.at(tau), amplitude * self.light / span
        of_rise, of_log_k = np.zeros((2, N_PARAMETERS, rise.size))
        of_rise[PEAK] = factor * (at[:, 0] - at[:, 1])
        of_rise[WIDTH] = rise - factor * width * np.diff(at * tau, axis=1)[:, 0]
        of_rise[AMPLITUDE] = rise
        of_log_k[PEAK], of_log_k[FOLD] = (since > 0.0) * falling / fold, falling * since / fold
        of_log_k[KELVIN], of_log_k[END] = 1.0 + (end_share - 1.0) * ended, above * ended
        of_log_k *= (log_k > coolest) & (log_k < hottest)
        return rise, np.clip(log_k, coolest, hottest), of_rise, of_log_k

    def whitening(self, theta: Float | None, *, none: bool = False) -> Whiten:
        """Return the whitening of residuals for the covariances of a flare, or of frames without one.

        The best unknown levels are subtracted; with `none`, those of frames without a flare.
        """
        covariance, flare = self.quiet_covariance, None
        if theta is not None:
            flare = self.flare(theta)[:2]
            covariance = covariance + flare[0][:, None, None] * self.spread(flare[1])
        for jitter in self.jitters:
            changes = jitter.sd * jitter.around(flare)
            covariance = covariance + changes[:, :, None] * changes[:, None, :]
        inverse = np.linalg.inv(np.linalg.cholesky(covariance))

        def plain(values: Float) -> Float:
            return np.asarray((inverse @ values.transpose(1, 2, 0)).transpose(2, 0, 1).reshape(len(values), -1))

        if not self.unknown:
            return plain
        spectra = plain(np.array([unknown.around(None if none else flare) for unknown in self.unknown]))
        roots = np.array([1.0 / unknown.sd for unknown in self.unknown])
        best = np.linalg.solve(spectra @ spectra.T + np.diag(roots**2), spectra)

        def marginalised(values: Float) -> Float:
            sums = plain(values)
            levels = sums @ best.T
            # The prior acts as one more datum of each level.
            return np.hstack([sums - levels @ spectra, levels * roots])

        return marginalised

    def linearised(self, theta: Float, whiten: Whiten) -> tuple[Float, Float]:
        """Return residuals, (n,), and their derivatives with respect to the parameters, (n, 6).

        The squares of the residuals add up to chi-squared with the unknown levels marginalised over.
        """
        rise, log_k, of_rise, of_log_k = self.flare(theta)
        hot, slope = self.reduction.spline(log_k), self.reduction.spline(log_k, 1)
        changes = of_rise[..., None] * hot + (rise * of_log_k)[..., None] * slope
        residuals, *jacobian = whiten(np.concatenate([(self.sums - rise[:, None] * hot)[None], -changes]))
        return residuals, np.transpose(jacobian)


@dataclass(frozen=True)
class _Quantity:
    """Quantity that a joint fit reports."""

    name: str
    unit: str
    place: int  # its parameter, or the amplitude
    spline: scipy.interpolate.CubicSpline | None = None  # light per amplitude over log temperature
    factor: float = 1.0

    def at(self, theta: Float, data: _Data) -> tuple[float, Float]:
        """Return the quantity of some parameters, and the derivatives of its logarithm, or of the peak time, (6,)."""
        if self.spline is not None:
            rise, log_k, of_rise, of_log_k = data.flare(theta)
            light, change = self.spline(log_k)[:, 0], self.spline(log_k, 1)[:, 0]
            total = float(np.sum(data.intrinsic(rise) * light))
            slope = data.intrinsic(of_rise * light + rise * of_log_k * change).sum(axis=1)
            return self.factor * total, slope / (total if total > 0.0 else np.nan)
        value, gradient = theta[self.place], np.eye(N_PARAMETERS)[self.place]
        if self.place == END:
            coolest = data.model.log_k[0]
            gradient[KELVIN], gradient[END] = theta[END], theta[KELVIN] - coolest
            value = coolest + theta[END] * (theta[KELVIN] - coolest)
        return float(value if self.place == PEAK else np.exp(value)), gradient


class CoolingCourse(NamedTuple):
    """A flare in the quantities of a fit, and frame by frame, added up over the pixels that are used."""

    values: Float  # shape (n_derived,)
    # Of the frames less their known mean without a flare and the levels of what is unknown, shape (n_frame,).
    drawn_dn: Float
    mean_dn: Float  # of the flare
    kelvin: Float


@validated
def fit_cooling(
    frames: RawCounts,
    quiet: Expectation,
    model: FlareModel,
    nuisances: Nuisances | None = None,
    *,
    peak_s: Moment,
    half_width_s: Duration,
    shape: Shape | str = "davenport2014",
    cooling: bool = True,
    stare: Stare | None = None,
    levels: Sequence[Probability] = LEVELS,
    skipped_nm: Sequence[tuple[Wavelength, Wavelength]] = (),
) -> Measurement:
    """Fit the shape of one flare and a blackbody whose temperature falls to all frames of a stare together.

    Parameters
    ----------
    frames : array_like, shape (n_frame, n_pixel)
        Raw DN of single frames.
    quiet : Expectation
        One frame of the quiescent star.
    model : FlareModel
        A blackbody, of one frame.
    nuisances : Nuisances, optional
        Unknown amplitudes of known spectra, for one frame; they are constant over the stare.
    peak_s, half_width_s : float
        Starting point of the fit, such as the result of a search.
    shape : Shape or str
    cooling : bool
        Whether the temperature falls after the peak, as in `Cooling`; constant otherwise.
    stare : Stare, optional
        Times, known conditions and unknown changes of the frames; frames without gaps and changes by default.
    levels : sequence of float
        Nominal coverage of the intervals, by profile likelihood.
    skipped_nm : sequence of tuple
        Wavelength ranges of pixels that are not used.

    Returns
    -------
    Measurement
        One row with peak time, half-width, amplitude, and temperature at the peak; with `cooling`, also the final
        temperature and the cooling time; fluences within the frames, and energies if the model has a distance.
        Chi-squared is that of the frames' sums.

    Raises
    ------
    InputError
        If the frames have another shape, the model has a jump or lines, the stare contains no light of the flare, or
        every pixel is near saturation in a frame.
    """
    if len(model.linear) > 1:
        raise InputError(f"the model must be a blackbody alone, but consists of {', '.join(model.linear)}", key="model")
    raw, stare = checked_frames(frames, quiet, stare)
    data = _data(raw, quiet, model, nuisances, stare, shape_of(shape), skipped_nm)
    fit = _BestFit.of(data, stare.frame_s, peak_s, half_width_s, cooling=cooling)
    theta, free, best = fit.theta, fit.free, fit.chi2
    jacobian = data.linearised(theta, fit.whiten)[1][:, free]
    quantities = _quantities(data, stare, cooling)
    estimates, slopes = (np.array(values) for values in zip(*(q.at(theta, data) for q in quantities), strict=True))
    scale = np.where([quantity.place == PEAK for quantity in quantities], 1.0, estimates)
    slopes = scale[:, None] * slopes[:, free]
    spread = slopes @ parameter_covariance(jacobian) @ slopes.T
    # Nothing is known of quantities of a flare without light, or of the cooling time of one that does not cool.
    unknown = (slopes[:, ~jacobian.any(axis=0)] != 0.0).any(axis=1)
    spread[unknown], spread[:, unknown] = np.nan, np.nan
    rises = [float(scipy.stats.chi2.ppf(level, 1)) for level in levels]
    ends = [fit.end(sign * rise, quantity) for sign, rise, quantity in product((-1.0, 1.0), rises, quantities)]
    low, high = np.reshape(ends, (2, len(rises), 1, len(quantities)))
    dof = data.sums.size - free.size - sum(np.isinf(unknown.sd) for unknown in data.unknown)
    none = float(np.sum(data.whitening(theta, none=True)(data.sums[None]) ** 2))
    return Measurement(
        tuple(quantity.name for quantity in quantities), tuple(quantity.unit for quantity in quantities),
        (-np.inf,) + (0.0,) * (len(quantities) - 1),
        estimates[None], spread[None], tuple(levels), low, high,
        chi2=np.array([best]), p_value=np.array([float(scipy.stats.chi2.sf(best, dof))]), dof=dof,
        snr=np.array([np.sqrt(max(none - best, 0.0))]),
        log_k=theta[[KELVIN]], amplitudes=np.exp(theta[[AMPLITUDE]])[None], factor=np.ones(1),
    )  # fmt: skip


def cooling_course(
    event: Event, measurement: Measurement, frames: Float, quiet: Expectation, model: FlareModel, stare: Stare,
    skipped_nm: Ranges = (),
) -> CoolingCourse:  # fmt: skip
    """Return a flare in the quantities of a fit and in each frame; parameters as for `fit_cooling`."""
    data = _data(frames, quiet, model, None, stare, event.form, skipped_nm)
    cooling = event.temperature
    if not isinstance(cooling, Cooling):
        cooling = Cooling(cooling, cooling, stare.frame_s)
    width, amplitude, peak, end, fold = np.log(
        [event.half_width_s, event.amplitude, cooling.peak_k, cooling.end_k, cooling.fold_s]
    )
    coolest = model.log_k[0]
    share = 1.0 if end == peak else (end - coolest) / (peak - coolest)
    theta = np.array([event.peak_s, width, amplitude, peak, share, fold])
    values = {quantity.name: quantity.at(theta, data)[0] for quantity in _quantities(data, stare, cooling=True)}
    rise, log_k, *_ = data.flare(theta)
    used = (data.reduction.variance > 0).astype(np.float64)
    strengths = known_strengths(stare, quiet)
    drawn_dn = excess_sums(frames, quiet, strengths, used[None])[:, 0]
    mean_dn = rise * (model.hot_spline(log_k) @ used)
    if stare.unknowns:
        # What the unknown changes add to the sum over pixels follows from its residuals.
        components = Components(quiet, np.zeros((0, used.size)), used[None])
        changes, variance = components.directions(strengths), components.covariance(strengths)[:, 0, 0]
        slopes = {of: change[:, 0] + (mean_dn if of == "light" else 0.0) for of, change in changes.items()}
        levels = np.array([unknown.sd * unknown.curve * slopes[unknown.of] for unknown in stare.unknowns])
        drawn_dn = drawn_dn - fitted_amplitudes(levels, np.ones(len(levels)), drawn_dn - mean_dn, variance) @ levels
    return CoolingCourse(np.array([values[name] for name in measurement.names]), drawn_dn, mean_dn, np.exp(log_k))


def cooling_event(measurement: Measurement, shape: Shape) -> Event:
    """Return the flare that `fit_cooling` found."""
    best = dict(zip(measurement.names, measurement.estimates[0].tolist(), strict=True))
    kelvin: float | Cooling = best["temperature"]
    if "cooling time" in best:
        kelvin = Cooling(best["temperature"], min(best["end temperature"], best["temperature"]), best["cooling time"])
    return Event(best["peak time"], best["half width"], best["amplitude"], kelvin, shape)


def _data(
    raw: Float, quiet: Expectation, model: FlareModel, nuisances: Nuisances | None, stare: Stare, shape: Shape,
    skipped_nm: Ranges,
) -> _Data:  # fmt: skip
    """Return the data of a fit to a stare, with its unknowns as parameters."""
    # The unknowns are parameters of the stare, so the weights of single frames do not remove them.
    clipped = clipped_pixels(raw, quiet)
    reduction = ReducedSums.of(model, quiet, skipped_nm=skipped_nm, clipped=clipped)
    weights, strengths = reduction.weights, known_strengths(stare, quiet)
    sums = excess_sums(raw, quiet, strengths, weights)
    components = Components(quiet, np.zeros((0, weights.shape[1])), weights)
    covariance, changes = components.covariance(strengths), components.directions(strengths)
    edges = np.column_stack([stare.start_s, stare.start_s + stare.frame_s])
    light, ones, jitters = strengths[:, 3], np.ones(stare.n_frames), dict(stare.jitters)

    def level(of: Changing, sd: float, curve: Float) -> _Level:
        of_flare = curve if of == "light" else np.zeros_like(curve)
        return _Level(sd, curve[:, None] * changes[of], of_flare, reduction.spline)

    if stare.pointing is not None:
        jitters["light"] = float(np.hypot(jitters["light"], stare.pointing.depth))
    unknown = [level(change.of, change.sd, change.curve) for change in stare.unknowns]
    if nuisances is not None:
        sums, light = sums - weights @ nuisances.mean_dn, nuisances.mean_factor * light
        for sd, spectrum, of_flare in zip(nuisances.sd, nuisances.spectra, nuisances.of_flare, strict=True):
            spline = scipy.interpolate.CubicSpline(model.log_k, (model.hot * of_flare) @ weights.T)
            constant = np.tile(weights @ spectrum, (stare.n_frames, 1))
            unknown.append(_Level(float(sd), constant, ones * float(of_flare.any()), spline))
    each_frame = tuple(level(of, sd, ones) for of, sd in jitters.items() if sd > 0.0)
    added = np.einsum("ip,jp,tp->tij", weights, weights, model.hot * quiet.gain_dn_per_electron, optimize=True)
    spread = scipy.interpolate.CubicSpline(model.log_k, added)
    return _Data(
        sums=sums, edges=edges, light=light, quiet_covariance=covariance, unknown=tuple(unknown), jitters=each_frame,
        reduction=reduction, model=model, shape=shape, spread=spread,
    )  # fmt: skip


def _start(data: _Data, whiten: Whiten, peak_s: float, half_width_s: float, cooling: bool) -> Float:
    """Return starting parameters, (6,): the best amplitude and temperature at the given peak and half-width."""
    rise = data.light * data.shape.mean_over(data.edges, peak_s, half_width_s)
    if not rise.any():
        raise InputError.of("peak_s", peak_s, "the peak of a flare with light in the stare")
    nodes = slice(None, None, NODE_STRIDE)
    templates = whiten(rise[:, None] * data.reduction.hot[nodes, None])
    power, along = np.sum(templates**2, axis=1), templates @ whiten(data.sums[None])[0]
    best = int(np.argmax(np.maximum(along, 0.0) ** 2 / power))
    amplitude, log_k = max(float(along[best] / power[best]), 1e-6), data.reduction.log_k[nodes][best]
    # A flare that cools is somewhat hotter at the peak than on average.
    log_k, end = (log_k + 0.1, log_k - 0.2) if cooling else (log_k, log_k)
    coolest = data.model.log_k[0]
    share = (end - coolest) / (log_k - coolest) if cooling else 1.0
    return np.array([peak_s, np.log(half_width_s), np.log(amplitude), log_k, share, np.log(2.0 * half_width_s)])


def _quantities(data: _Data, stare: Stare, cooling: bool) -> list[_Quantity]:
    """Return the quantities that a fit reports."""
    quantities = [
        _Quantity("peak time", "s", PEAK), _Quantity("half width", "s", WIDTH), _Quantity("amplitude", "", AMPLITUDE),
        _Quantity("temperature", "K", KELVIN),
    ]  # fmt: skip
    if cooling:
        quantities += [_Quantity("end temperature", "K", END), _Quantity("cooling time", "s", FOLD)]
    for derived, spline in zip(data.model.derived, data.model.splines, strict=True):
        kind, _, band = derived.name.partition(" ")
        if kind == "flux":
            quantities.append(_Quantity(f"fluence {band}", "erg / cm2", AMPLITUDE, spline, stare.frame_s))
        elif kind == "energy":
            quantities.append(_Quantity(derived.name, derived.unit, AMPLITUDE, spline))
    return quantities


@dataclass(frozen=True, eq=False)
class _BestFit:
    """Best fit of a flare to all frames, and the ends of intervals from profiles of chi-squared about it."""

    data: _Data
    whiten: Whiten
    theta: Float  # shape (n_parameter,)
    free: NDArray[np.intp]  # places of fitted parameters
    limits: tuple[Float, Float]
    chi2: float

    @classmethod
    def of(cls, data: _Data, frame_s: float, peak_s: float, half_width_s: float, *, cooling: bool) -> Self:
        """Fit a flare from a starting point, with the covariance of the frames at the fit before."""
        free = np.arange(N_PARAMETERS if cooling else END)
        first, last = data.edges[0, 0], data.edges[-1, 0]
        duration_s, coolest, hottest = last - first + frame_s, data.model.log_k[0], data.model.log_k[-1]
        limits = (
            np.array([first - duration_s, *np.log([0.1 * frame_s, 1e-9]), coolest + 1e-9, 0.0, np.log(frame_s)]),
            np.array([first + 2 * duration_s, *np.log([duration_s, range_of(Amplitude).high]), hottest - 1e-9, 1.0,
                      np.log(100 * duration_s)]),
        )  # fmt: skip
        whiten = data.whitening(None)
        theta = np.clip(_start(data, whiten, peak_s, half_width_s, cooling), *limits)

        def with_free(values: Float) -> Float:
            return np.concatenate([values, theta[free.size :]])

        def residuals(values: Float) -> Float:
            return data.linearised(with_free(values), whiten)[0]

        def jacobian(values: Float) -> Float:
            return data.linearised(with_free(values), whiten)[1][:, free]

        low, high = (end[free] for end in limits)
        for refits in range(REFITS + 1):
            whiten = data.whitening(theta) if refits else whiten
            start = np.clip(theta[free], low + 1e-9, high - 1e-9)
            scale = np.where(free == PEAK, np.exp(theta[WIDTH]), 1.0)
            solution = scipy.optimize.least_squares(residuals, start, jacobian, bounds=(low, high), x_scale=scale)
            theta = with_free(solution.x)
        return cls(data, whiten, theta, free, limits, 2 * float(solution.cost))

    def end(self, rise: float, quantity: _Quantity) -> float:
        """Return the end of an interval at a rise of chi-squared, as `interval_end` does; infinite if it is open."""
        linearised, value = partial(self.data.linearised, whiten=self.whiten), partial(quantity.at, data=self.data)
        end, share = interval_end(linearised, value, self.theta, self.limits, self.chi2, rise, self.free)
        return end if share >= 1.0 else float(np.copysign(np.inf, rise))
