"""Spectra of observed frames: noise of each pixel as measured, sums weighted for flares, and spectra of events.

The weights are those of the marginalised matched filter (METHODS section 7) for flares of 6000 to 30 000 K, with the
noise of each pixel. The level of each frame is free: pointing losses change it, and a faint star does not show them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.detection.nuisances import Nuisances
from mauvecl.fits.spectrum import Measurement, fit
from mauvecl.flares.shapes import Shape
from mauvecl.host.arrays import Bool, Float
from mauvecl.noise.unknowns import PROCESSES
from mauvecl.observations import frame_model as models
from mauvecl.observations.detector import variance_of_steps
from mauvecl.observations.events import Kind
from mauvecl.observations.frames import Frames, Reason
from mauvecl.observations.level import QuiescentLevel, check_usable, guess_flares, single_frames
from mauvecl.observations.light_curve import fit_quiet_light, quiescent_light
from mauvecl.observations.process import UNREPORTED, Steps
from mauvecl.observations.search import MIN_BASELINE, DetectedEvent, SeriesSurvey
from mauvecl.schema.errors import InputError
from mauvecl.search.search import TEMPERATURES_K, Templates

#: Differences, in standard errors, above which measured noise replaces stated noise.
DEPARTS = 4.0
#: Largest number of alternations of weights and events, and share of the frames in events that may change in the last.
ROUNDS, SETTLED_EVENTS = 3, 0.01
#: Number of frames in means that show slow changes.
SLOW_FRAMES = 12
#: Range of nine tenths of the slow changes of the dark current above which the search leaves it out (assumed): in
#: standard errors of a frame, and relative to the range of means of frames that change independently.
DARK_DRIFTS, BEYOND_JITTER = 5.0, 2.0
#: Range of nine tenths of normal values, in standard deviations.
NINE_TENTHS = float(scipy.stats.norm.ppf(0.95) - scipy.stats.norm.ppf(0.05))
#: Frames of one block of computations, which bounds the memory.
BLOCK = 1024


@dataclass(frozen=True, eq=False)
class PixelNoise:
    """Noise of each pixel in quiescent frames, without the light and dark current that all pixels share."""

    wavelength_nm: Float  # shape (n_pixel,)
    stated: Float  # standard deviations of a frame, like `measured`
    measured: Float
    low: Float  # shape (n_pixel,), like `high`; range of `measured` for 95 % of normal noise of the stated size
    high: Float
    count: int  # number of differences of neighbouring frames

    @property
    def departs(self) -> Bool:
        """True for pixels whose measured noise differs significantly from the stated one."""
        return np.asarray(np.abs(self.measured / self.stated - 1.0) > DEPARTS * relative_error(self.count))

    @property
    def used(self) -> Float:
        """Noise by which pixels are weighted: as stated, or as measured where it departs from that."""
        return np.where(self.departs, self.measured, self.stated)


@dataclass(frozen=True, eq=False)
class SpectralSeries:
    """Spectra of the searched frames."""

    excess: Float  # shape (n_frame, n_pixel); spectra less that of the quiescent star
    light: Float  # shape (n_pixel,); spectrum of the quiescent star
    noise: PixelNoise
    cleaned: models.CleanedSpectra
    jitters: Mapping[str, float]  # standard deviations of unknowns of frames; infinite if they are projected out
    changes: list[models.LightChange]  # sudden changes of the light that all pixels share
    snr_kept: float  # S/N of flares over that with a steady level of the frames
    dark_drift: float  # range of the slow changes of the dark current over the light in the sum; 0 if they are small

    @property
    def star_level(self) -> float:
        """Light of the star in the sum over wavelength, relative to `light`, by the shape of its spectrum.

        It excludes dark current and sky that the light includes; NaN if the star is not known.
        """
        model = self.cleaned.model
        if not model.star_is_known:
            return float("nan")
        quiet = model.quiet
        dn = quiet.n_frames * quiet.source_electrons * quiet.gain_dn_per_electron
        star = model.bins @ dn * model.per_dn
        unknowns = [spectrum for name, spectrum in model.unknowns(self.light).items() if name != "light"]
        columns = np.array([star, *unknowns]).T / self.noise.used[:, None]
        amplitude = np.linalg.lstsq(columns, self.light / self.noise.used, rcond=None)[0][0]
        return float(amplitude * star.sum() / abs(self.light.sum()))


def relative_error(differences: int) -> float:
    """Return the relative standard error of a standard deviation from successive differences (von Neumann 1941)."""
    return 0.5 * float(np.sqrt(3.0 / max(differences, 1)))


def measure_noise(excess: Float, pairs: NDArray[np.intp], stated: Float, shared: Float, nm: Float) -> PixelNoise:
    """Measure the noise of each pixel from differences of the quiescent frames of `pairs` and their successors."""
    blocks = [pairs[first : first + BLOCK] for first in range(0, pairs.size, BLOCK)]
    variances = [variance_of_steps(excess[block + 1] - excess[block], stated, shared) for block in blocks]
    measured = np.sqrt(np.average(variances, axis=0, weights=[block.size for block in blocks]))
    reach = float(scipy.stats.norm.isf(0.025)) * relative_error(pairs.size)
    return PixelNoise(nm, stated, measured, stated * (1 - reach), stated * (1 + reach), int(pairs.size))


def survey_spectra(
    frames: Frames, model: models.FrameModel, shape: Shape, rank: int, seed: int,
    jitters: Mapping[str, float] | None = None, steps: Steps = UNREPORTED,
) -> tuple[SeriesSurvey, SpectralSeries, QuiescentLevel]:  # fmt: skip
    """Prepare the search of spectra that is weighted for flares; `rank` and `jitters` are those of `analyse_frames`.

    Slow changes of what the weights let through are processes of the weighted sums. The level that is returned is that
    of the sum over wavelength, with flags of single frames that only the weighted sums show.
    """
    fits, cleaned = steps.part(0.0, 0.9), models.clean_spectra(frames, model)
    frames = cleaned.frames
    flux, error = frames.white_light
    assert error is not None
    reasons = frames.faults | np.where(cleaned.saturated, Reason.SATURATED, 0)
    check_usable(frames, reasons)
    used = reasons == 0
    in_events = np.zeros(flux.size, np.bool_)
    in_events[used] = guess_flares(frames.numbers[used], flux[used])
    for _ in range(ROUNDS):
        quiet = used & ~in_events
        series, templates, sums = _weighted_sums(cleaned, reasons, quiet, rank, jitters or {})
        lit, level = np.maximum(series.light, 0.0), float(np.median(flux[quiet]))
        # Frames without light, such as dark frames, have no photon noise that could weight the gains.
        photon = float(np.average(cleaned.model.gain, weights=lit if lit.any() else None))
        # The noise of the sums follows that of the whole light in time.
        survey = SeriesSurvey.of(frames, flux, error**2, used, level, photon, shape, weighted=(templates, sums))
        survey, searched_in_events = fit_quiet_light(survey, in_events[used], None, fits)
        before, in_events, sigmas = in_events, np.zeros(flux.size, np.bool_), np.zeros(flux.size)
        in_events[used] = searched_in_events
        sigmas[used] = survey.along(len(survey.bank.directions) // 2, ~searched_in_events)
        single = single_frames(frames.numbers, sigmas, used)
        if not single.any() and float((in_events ^ before).mean()) <= SETTLED_EVENTS:
            break
        reasons = np.where(single, reasons | Reason.SPIKE, reasons)
        used = reasons == 0
    survey = survey.frames(reasons[np.searchsorted(frames.time_s, survey.time_s)] == 0)
    series = replace(series, excess=series.excess[used])
    return survey, series, quiescent_light(frames, survey, reasons, ~in_events, seed, steps.part(0.9, 1.0))


def _weighted_sums(
    cleaned: models.CleanedSpectra, reasons: NDArray[np.int64], quiet: Bool, rank: int, jitters: Mapping[str, float]
) -> tuple[SpectralSeries, Templates, Float]:
    """Return the spectra less that of the quiescent star, the weights for flares, and the weighted sums of each frame.

    Sums have unit covariance from frame to frame, and change independently over longer times.
    """
    frames, model = cleaned.frames, cleaned.model
    light = frames.flux[quiet].mean(axis=0)
    unknown, excess = model.unknowns(light), frames.flux - light
    pairs = np.flatnonzero(quiet[:-1] & quiet[1:] & (np.diff(frames.numbers) == 1))
    if not pairs.size:
        fault = "needs neighbouring frames without a flare, from which the noise follows"
        raise InputError(f"{frames.name} {fault}", key="frames")
    assert frames.wavelength_nm is not None
    shared = np.array([unknown["light"], unknown["dark"]])
    noise = measure_noise(excess, pairs, cleaned.stated, shared, frames.wavelength_nm)
    flares = model.flares(TEMPERATURES_K)
    compared = np.flatnonzero(reasons == 0)
    alternatives = np.vstack([flares, *(spectrum for name, spectrum in unknown.items() if name != "light")])
    changes = models.light_changes(excess, compared, frames.numbers, light, alternatives, noise.used)
    dark, drift = _dark_changes(excess, pairs, quiet, noise.used, shared)
    deviations = {"light": np.inf} | ({"dark": dark} if dark > 0 else {}) | dict(jitters)
    nuisances = _nuisances(unknown, deviations)
    # Flares that double the light of the star, in the sum over wavelength.
    flares *= abs(float(light.sum())) / flares.sum(axis=1, keepdims=True)
    templates_for = partial(Templates.of, noise.used**2, flares, model.gain, TEMPERATURES_K, rank=rank)
    templates = templates_for(nuisances=nuisances)
    steady = templates_for(nuisances=nuisances.without(["light"]))
    snr_kept = float(np.median(templates.best / steady.best))
    sums = np.concatenate([excess[i : i + BLOCK] @ templates.weights.T for i in range(0, len(excess), BLOCK)])
    mixing = _independent(sums, pairs, quiet)
    templates, sums = templates.mixed(mixing), sums @ mixing.T
    drift *= abs(float(unknown["dark"].sum() / light.sum()))
    return SpectralSeries(excess, light, noise, cleaned, deviations, changes, snr_kept, drift), templates, sums


def _nuisances(spectra: Mapping[str, Float], deviations: Mapping[str, float]) -> Nuisances:
    """Return the unknowns with a spectrum and a standard deviation."""
    names = tuple(name for name in deviations if name in spectra)
    return Nuisances(names, np.array([spectra[name] for name in names]), np.array([deviations[name] for name in names]))


def _independent(sums: Float, pairs: NDArray[np.intp], quiet: Bool) -> Float:
    """Return the matrix of sums of unit covariance, as measured, along the axes on which they change slowly."""
    n, steps = sums.shape[1], sums[pairs + 1] - sums[pairs]
    mixing = np.eye(n)
    covariance = steps.T @ steps / (2 * pairs.size)
    if (np.abs(covariance - mixing) > DEPARTS * 2 * relative_error(pairs.size)).any():
        mixing = np.linalg.inv(np.linalg.cholesky(covariance))
    means = _slow_means(sums[quiet] @ mixing.T)
    if len(means) >= 2 * n:
        mixing = np.linalg.eigh(np.cov(means.T).reshape(n, n))[1].T[::-1] @ mixing
    return np.asarray(mixing)


def _slow_means(values: Float) -> Float:
    """Return the means of each `SLOW_FRAMES` values along the first axis."""
    n = len(values) // SLOW_FRAMES
    return np.asarray(values[: n * SLOW_FRAMES].reshape(n, SLOW_FRAMES, *values.shape[1:]).mean(axis=1))


def fit_changes(excess: Float, spectra: Float, sd: Float) -> tuple[Float, Float]:
    """Fit amplitudes of spectra, (n_frame, k), together to frames of noise `sd`; return them and their covariance."""
    white = spectra / sd
    covariance: Float = np.asarray(np.linalg.inv(white @ white.T), np.float64)
    return excess @ (covariance @ white / sd).T, covariance


def _dark_changes(excess: Float, pairs: NDArray[np.intp], quiet: Bool, sd: Float, shared: Float) -> tuple[float, float]:
    """Measure changes of the dark current, which is fitted together with the light; both spectra are `shared`.

    Return its standard deviation from frame to frame beyond noise, 0 if it is not significant and infinite if the dark
    current drifts, and the range of nine tenths of its slow changes, 0 unless it drifts.
    """
    amplitudes, covariance = fit_changes(excess, shared, sd)
    amplitude, error = amplitudes[:, 1], float(np.sqrt(covariance[1, 1]))
    variance = float(np.mean((amplitude[pairs + 1] - amplitude[pairs]) ** 2)) / 2
    beyond = variance - error**2
    is_significant = beyond > DEPARTS * 2 * relative_error(pairs.size) * error**2
    jitter = float(np.sqrt(beyond)) if is_significant else 0.0
    means = _slow_means(amplitude[quiet])
    if len(means) < 2:
        return jitter, 0.0
    drift = float(np.ptp(np.quantile(means, [0.05, 0.95])))
    independent = NINE_TENTHS * float(np.sqrt(variance / SLOW_FRAMES))
    return (np.inf, drift) if drift > max(DARK_DRIFTS * error, BEYOND_JITTER * independent) else (jitter, 0.0)


def event_colour(spectra: Float, error: Float, event: Bool, quiet: Bool) -> tuple[float, float, float]:
    """Return the relative rise in the blue half of the pixels over that in the red, its error, and a p-value.

    The rise is 1 and the p-value, of chi-squared, is even for a multiple of the quiescent spectrum. Pixels are in order
    of wavelength; those that are not finite in a frame are left out.
    """
    fine = np.isfinite(spectra).all(axis=0) & np.isfinite(error).all(axis=0) & (error > 0).all(axis=0)
    spectra, error = spectra[:, fine], error[:, fine]
    star = spectra[quiet].mean(axis=0)
    excess = spectra[event].mean(axis=0) - star
    n_event, n_quiet = np.count_nonzero(event), np.count_nonzero(quiet)
    variance = (error[event] ** 2).sum(axis=0) / n_event**2 + (error[quiet] ** 2).sum(axis=0) / n_quiet**2
    scale, half = _multiple(excess, star, variance)[0], fine.sum() // 2
    chi2 = ((excess - scale * star) ** 2 / variance).sum()
    blue, red = (_multiple(excess[k], star[k], variance[k]) for k in (slice(None, half), slice(half, None)))
    ratio = blue[0] / red[0]
    relative = np.hypot(blue[1] / blue[0], red[1] / red[0])
    return float(ratio), float(abs(ratio) * relative), float(scipy.stats.chi2.sf(chi2, fine.sum() - 1))


def _multiple(excess: Float, star: Float, variance: Float) -> tuple[float, float]:
    """Return the best multiple of the star in a spectrum, and its standard error."""
    information = float((star**2 / variance).sum())
    return float((excess * star / variance).sum()) / information, information**-0.5


#: Kinds of events that unknowns of the frames may cause.
CAUSES: dict[str, Kind] = {"light": "throughput", "dark": "dark current", "sky": "sky"}
#: S/N of a flare, next to unknown changes of star, dark current and sky, from which an event is a flare.
FLARE_SNR = 4.0
#: Share of an event's chi-squared in a single pixel from which it is that of a cosmic ray.
RAY_SHARE = 0.5
#: Smallest number of means of quiescent frames from which drifts are measured.
MIN_PARTS = 8
#: Share of the frames of a mean that must be quiescent.
QUIET_SHARE = 0.5
#: Probability of a worse fit below which no spectrum that is known explains an event.
NO_FIT = 1e-6


@dataclass(frozen=True, eq=False)
class EventSpectrum:
    """Spectrum of an event and its fits."""

    cause: Kind  # explanation of the spectrum: a flare, or a change that resembles one
    snr: float  # S/N of a flare whose amplitude is fitted together with changes of star, dark current and sky
    chi2: dict[Kind, float]  # of single causes, with the best amplitude, and of flares of the best temperature
    # Probability of a chi-squared at least as large as that of a flare whose amplitude is fitted with those changes.
    p_together: float

    @property
    def ambiguous(self) -> bool:
        """True if a flare explains the spectrum best, but hardly better than a change of the instrument does."""
        rival = min(value for cause, value in self.chi2.items() if cause != "flare")
        return self.cause == "flare" and rival < self.chi2["flare"] + models.CLEARLY

    @property
    def reason(self) -> str:
        """Reason why the event is not a flare, or is doubtful; empty for a clear flare."""
        if self.cause == "cosmic ray":
            return "its light is in a single pixel, as that of a cosmic ray"
        if self.cause != "flare":
            gain = self.chi2["flare"] - self.chi2[self.cause]
            return f"its spectrum is that of a change of the {self.cause}: chi-squared is {gain:.3g} below a flare's"
        if self.ambiguous and self.snr >= FLARE_SNR:
            fault = "a change of the instrument alone fits its spectrum as well as a flare alone"
            return f"{fault}; next to such changes a flare has an S/N of {self.snr:.3g}"
        if self.ambiguous:
            return "its spectrum does not distinguish it from a change of the instrument"
        return "no flare of one temperature fits its spectrum" if self.p_together < NO_FIT else ""


def event_spectrum(
    survey: SeriesSurvey, series: SpectralSeries, in_events: Bool, event: DetectedEvent
) -> EventSpectrum:
    """Compare the spectrum of an event with those of flares and of changes that resemble them.

    Its spectrum is that of the template of the search, which is fitted to each pixel with a straight line.
    """
    model, at = series.cleaned.model, _surroundings(survey, in_events, event)[0]
    start = survey.stare.start_s[at]
    edges = np.column_stack([start, start + survey.stare.frame_s])
    shape = survey.bank.shape.mean_over(edges, event.peak_s, event.half_width_s)
    middle = (start - start.mean()) / max(float(np.ptp(start)), 1.0)
    weights = np.linalg.pinv(np.column_stack([shape, np.ones(at.size), middle]))[0]
    spectrum = np.asarray(weights @ series.excess[at])
    photons = model.gain * np.maximum(spectrum, 0.0) * float((weights**2) @ np.maximum(shape, 0.0))
    variance = (weights**2).sum() * series.noise.used**2 + photons
    flares, unknown = model.flares(TEMPERATURES_K), model.unknowns(series.light)
    causes: dict[Kind, Float] = {"flare": flares}
    causes |= {CAUSES[name]: row[None] for name, row in unknown.items()}
    fits = {cause: models.chi2_of_each(spectrum, variance, rows) for cause, rows in causes.items()}
    chi2 = {cause: float(values.min()) for cause, values in fits.items()}
    # Light is added, never taken away.
    rises = flares @ (spectrum / variance) > 0
    chi2["flare"] = float(np.where(rises, fits["flare"], (spectrum**2 / variance).sum()).min())
    together = _nuisances(unknown, dict.fromkeys(unknown, np.inf))
    rows = together.rows(variance, together.spectra)
    optimal = flares / variance - (flares @ rows.T) @ rows
    snr = float(((optimal @ spectrum) / np.sqrt(np.einsum("kp,kp->k", optimal, flares))).max())
    left = float((spectrum**2 / variance).sum() - ((rows @ spectrum) ** 2).sum() - max(snr, 0.0) ** 2)
    p_together = float(scipy.stats.chi2.sf(left, spectrum.size - 1 - len(unknown)))
    cause: Kind = min(chi2, key=lambda name: chi2[name])
    least, row = chi2[cause], causes[cause][fits[cause].argmin()]
    residual = spectrum - (row @ (spectrum / variance)) / (row @ (row / variance)) * row
    is_unexplained = scipy.stats.chi2.sf(least, spectrum.size - 1) < NO_FIT
    if is_unexplained and (residual**2 / variance).max() > RAY_SHARE * least:
        cause = "cosmic ray"
    elif cause != "flare" and (chi2["flare"] - least < models.CLEARLY or snr >= FLARE_SNR):
        cause = "flare"
    return EventSpectrum(cause, snr, chi2, p_together)


def _surroundings(survey: SeriesSurvey, in_events: Bool, event: DetectedEvent) -> tuple[NDArray[np.intp], Bool]:
    """Return the frames of an event and of its surroundings without other events, and which of them are its own."""
    lead, tail = survey.bank.window(event.half_width_s)
    numbers = survey.stare.numbers
    inside = np.zeros(numbers.size, np.bool_)
    inside[event.first : event.last + 1] = True
    near = (numbers >= numbers[event.first] - lead) & (numbers <= numbers[event.last] + tail)
    at = np.flatnonzero(near & (inside | ~in_events))
    return at, inside[at]


def drifts(survey: SeriesSurvey, series: SpectralSeries, in_events: Bool, n_frames: int) -> dict[str, float]:
    """Return the standard deviations by which star, dark current and sky differ in an event from its surroundings.

    They follow from means of `n_frames` quiescent frames, compared with those before and after: the scatter in excess
    of noise, and what noise may hide. With fewer than `MIN_PARTS` means, shorter ones are taken, and changes are
    assumed to grow in proportion to time. The sky has its documented prior.
    """
    unknown, names = series.cleaned.model.unknowns(series.light), ("light", "dark")
    spectra = np.array([unknown[name] for name in names])
    amplitudes, covariance = fit_changes(series.excess, spectra, series.noise.used)
    drift = dict.fromkeys(names, np.inf)
    size, means, counts = n_frames, list[Float](), np.zeros(0, np.intp)
    while size > 0 and len(means) < MIN_PARTS:
        segment = survey.stare.numbers // size
        counts = np.bincount(segment[~in_events], minlength=int(segment[-1]) + 1)
        # A mean without the frames of a short event still shows the drift.
        enough = np.flatnonzero(counts > QUIET_SHARE * size)
        means, counts = [amplitudes[(segment == k) & ~in_events].mean(axis=0) for k in enough], counts[enough]
        size = size if len(means) >= MIN_PARTS else size // 2
    if len(means) >= MIN_PARTS:
        bends, share = np.diff(np.array(means), 2, axis=0) / 2, 1.0 / counts
        for k, name in enumerate(names):
            # A mean less that of its neighbours has 3/2 of the variance of a mean, where all are of as many frames.
            expected = float(covariance[k, k]) * float((share[:-2] / 4 + share[1:-1] + share[2:] / 4).mean())
            beyond = max(float(np.mean(bends[:, k] ** 2)) - expected, 0.0)
            drift[name] = n_frames / size * float(np.sqrt(beyond + 2 * expected * np.sqrt(2 / len(bends))))
    return drift | ({"sky": PROCESSES["sky_level"].moments[1]} if "sky" in unknown else {})


def measure_flare(
    survey: SeriesSurvey, series: SpectralSeries, in_events: Bool, event: DetectedEvent
) -> Measurement | str:
    """Fit a flare to the sum of the spectra of an event, or return the reason why none is fitted.

    Star, dark current and sky may differ from the surroundings as much as other parts of the frames do; see `drifts`.
    """
    at, inside = _surroundings(survey, in_events, event)
    n, base = int(inside.sum()), int((~inside).sum())
    if base < MIN_BASELINE:
        return f"{base} frames around it show the quiescent star, {MIN_BASELINE} are needed"
    excess, model = series.excess[at], series.cleaned.model
    summed = excess[inside].sum(axis=0) - n * excess[~inside].mean(axis=0)
    # The level is that of a finite number of frames.
    exposure = model.exposure(series.light, series.noise.used**2 * (1 + n / base), n)
    unknown = {name: row * n / model.per_dn for name, row in model.unknowns(series.light).items()}
    nuisances = _nuisances(unknown, drifts(survey, series, in_events, n))
    # A change of the throughput changes the light of the flare as much as that of the star.
    of_flare = np.array([np.full(summed.size, float(name == "light")) for name in nuisances.names])
    nuisances = replace(nuisances, of_flare=of_flare)
    # In the sum of the frames, with one pixel for each value.
    flares = replace(model.flare, hot=model.flare.hot @ model.bins.T, fixed=model.flare.fixed @ model.bins.T)
    try:
        return fit((summed / model.per_dn + exposure.recorded_dn)[None], exposure, flares.stacked(n), nuisances)
    except InputError as error:
        return str(error)
