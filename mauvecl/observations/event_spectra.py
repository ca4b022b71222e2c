"""Spectra of events: their colour, which tells flares from changes of throughput, and fitted flares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.detection.nuisances import Nuisances
from mauvecl.fits.spectrum import Measurement, fit
from mauvecl.noise.unknowns import NUISANCES, Amplitude
from mauvecl.observations.frame_model import CLEARLY, chi2_of_one
from mauvecl.observations.search import MIN_BASELINE, Detection, SeriesSurvey
from mauvecl.observations.spectra import SpectralSeries, fit_changes
from mauvecl.schema.errors import InputError
from mauvecl.search.templates import TEMPERATURES_K

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Colour:
    """Spectrum of an event against the spectrum of the quiescent star."""

    # chi2, dof: chi-squared of the event's spectrum as a multiple of the quiescent one.
    chi2: float
    dof: int
    # Probability of a chi-squared at least as large for an event without colour, such as a step of the throughput.
    p_value: float
    # Rise relative to the quiescent star in the blue half of the pixels over that in the red half: 1 without colour.
    blue_over_red: float
    blue_over_red_error: float


def event_colour(spectra: Float, error: Float, event: NDArray[np.bool_], quiet: NDArray[np.bool_]) -> Colour:
    """Compare the mean spectrum of the frames of an event with that of the quiescent star near it.

    Pixels are in order of wavelength; those that are not finite in a frame are left out.
    """
    fine = np.isfinite(spectra).all(axis=0) & np.isfinite(error).all(axis=0) & (error > 0).all(axis=0)
    spectra, error = spectra[:, fine], error[:, fine]
    star = spectra[quiet].mean(axis=0)
    excess = spectra[event].mean(axis=0) - star
    count, base = np.count_nonzero(event), np.count_nonzero(quiet)
    variance = (error[event] ** 2).sum(axis=0) / count**2 + (error[quiet] ** 2).sum(axis=0) / base**2
    scale = _multiple(excess, star, variance)
    chi2 = float(((excess - scale[0] * star) ** 2 / variance).sum())
    dof = int(fine.sum()) - 1
    half = fine.sum() // 2
    blue, red = (_multiple(excess[part], star[part], variance[part]) for part in (slice(None, half), slice(half, None)))
    ratio = blue[0] / red[0]
    relative = np.hypot(blue[1] / blue[0], red[1] / red[0])
    return Colour(chi2, dof, float(scipy.stats.chi2.sf(chi2, dof)), float(ratio), float(abs(ratio) * relative))


def _multiple(excess: Float, star: Float, variance: Float) -> tuple[float, float]:
    """Return the best multiple of the star in a spectrum, and its standard error."""
    information = float((star**2 / variance).sum())
    return float((excess * star / variance).sum()) / information, information**-0.5


Cause = Literal["flare", "throughput", "dark current", "sky", "cosmic ray"]
#: Words for the unknowns of frames that may cause an event.
CAUSES: dict[str, Cause] = {"light": "throughput", "dark": "dark current", "sky": "sky"}
#: S/N of a flare, next to unknown changes of star, dark current and sky, from which an event is a flare.
FLARE_SNR = 4.0
#: Share of an event's chi-squared in a single pixel from which it is that of a cosmic ray.
RAY_SHARE = 0.5
#: Smallest number of means of quiescent frames from which drifts are measured.
MIN_PARTS = 8
#: Share of the frames of such a part that must be quiescent.
QUIET_SHARE = 0.5
#: Probability of a worse fit below which no spectrum that is known explains an event.
NO_FIT = 1e-6


@dataclass(frozen=True, eq=False)
class EventSpectrum:
    """Spectrum of an event and its fits."""

    cause: Cause  # explanation of the spectrum: a flare, or a change that resembles one
    snr: float  # S/N of a flare whose amplitude is fitted together with changes of star, dark current and sky
    # Chi-squared of single causes, each with its best amplitude, and flares with their best temperature.
    chi2: dict[Cause, float]
    dof: int
    p_value: float  # probability of a chi-squared at least as large as the smallest, if its cause is right

    @property
    def ambiguous(self) -> bool:
        """True if a flare explains the spectrum best, but hardly better than a change of the instrument does."""
        others = min(value for cause, value in self.chi2.items() if cause != "flare")
        return self.cause == "flare" and others < self.chi2["flare"] + CLEARLY

    @property
    def reason(self) -> str:
        """Reason why the event is not a flare, or is doubtful; empty for a clear flare."""
        if self.cause == "cosmic ray":
            return "its light is in a single pixel, as that of a cosmic ray"
        if self.cause != "flare":
            gain = self.chi2["flare"] - self.chi2[self.cause]
            return f"its spectrum is that of a change of the {self.cause}: chi-squared is {gain:.3g} below a flare's"
        if self.ambiguous:
            return "its spectrum does not distinguish it from a change of the instrument"
        return "no flare of one temperature fits its spectrum" if self.p_value < NO_FIT else ""


def event_spectrum(
    survey: SeriesSurvey, series: SpectralSeries, taken: NDArray[np.bool_], one: Detection
) -> EventSpectrum:
    """Compare the spectrum of an event with those of flares and of changes that resemble them."""
    spectrum, variance = _weighted(survey, series, taken, one)
    flares = series.model.flares(TEMPERATURES_K)
    unknown = series.model.unknowns(series.light)
    whole = float((spectrum**2 / variance).sum())
    # Light is added, never taken away.
    rises = flares @ (spectrum / variance) > 0
    chi2: dict[Cause, float] = {"flare": float(np.where(rises, chi2_of_one(spectrum, variance, flares), whole).min())}
    chi2 |= {CAUSES[name]: float(chi2_of_one(spectrum, variance, row[None])[0]) for name, row in unknown.items()}
    together = Nuisances(tuple(unknown), np.array(list(unknown.values())), np.full(len(unknown), np.inf))
    rows = together.rows(variance, together.spectra)
    optimal = flares / variance - (flares @ rows.T) @ rows
    values = (optimal @ spectrum) / np.sqrt(np.einsum("kp,kp->k", optimal, flares))
    snr = float(values.max())
    cause: Cause = min(chi2, key=lambda name: chi2[name])
    dof = spectrum.size - 1
    least = chi2[cause]
    left = spectrum - _fitted(cause, spectrum, variance, flares, unknown)
    p_value = float(scipy.stats.chi2.sf(least, dof))
    if p_value < NO_FIT and (left**2 / variance).max() > RAY_SHARE * least:
        cause = "cosmic ray"
    elif cause != "flare" and (chi2["flare"] - least < CLEARLY or snr >= FLARE_SNR):
        cause = "flare"
    return EventSpectrum(cause, snr, chi2, dof, p_value)


def _fitted(cause: Cause, spectrum: Float, variance: Float, flares: Float, unknown: dict[str, Float]) -> Float:
    """Return the best fit of a single cause, shape (n_pixel,)."""
    rows = flares if cause == "flare" else np.array([row for name, row in unknown.items() if CAUSES[name] == cause])
    amplitudes = (rows @ (spectrum / variance)) / np.einsum("kp,kp->k", rows, rows / variance)
    chi2 = (((spectrum - amplitudes[:, None] * rows) ** 2) / variance).sum(axis=1)
    k = int(np.argmin(chi2))
    return np.asarray(amplitudes[k] * rows[k])


def _window(
    survey: SeriesSurvey, taken: NDArray[np.bool_], one: Detection
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the frames of an event and of its surroundings without other events, and which belong to the event."""
    lead, tail = survey.bank.window(one.half_width_s)
    numbers = survey.stare.numbers
    inside = np.zeros(numbers.size, np.bool_)
    inside[one.first : one.last + 1] = True
    near = (numbers >= numbers[one.first] - lead) & (numbers <= numbers[one.last] + tail)
    at = np.flatnonzero(near & (inside | ~taken))
    return at, inside[at]


def _weighted(
    survey: SeriesSurvey, series: SpectralSeries, taken: NDArray[np.bool_], one: Detection
) -> tuple[Float, Float]:
    """Return the spectrum of an event, of the size of its peak, and its variance.

    The template of the search is fitted to each pixel, with a straight line.
    """
    at, _ = _window(survey, taken, one)
    start = survey.stare.start_s[at]
    edges = np.column_stack([start, start + survey.stare.frame_s])
    shape = survey.bank.shape.mean_over(edges, one.peak_s, one.half_width_s)
    middle = (start - start.mean()) / max(float(np.ptp(start)), 1.0)
    weights = np.linalg.pinv(np.column_stack([shape, np.ones(at.size), middle]))[0]
    spectrum = weights @ series.excess[at]
    quiet = (weights**2).sum() * series.noise.used**2
    photons = series.model.gain * np.maximum(spectrum, 0.0) * float((weights**2) @ np.maximum(shape, 0.0))
    return np.asarray(spectrum), np.asarray(quiet + photons)


def drifts(survey: SeriesSurvey, series: SpectralSeries, taken: NDArray[np.bool_], n_frames: int) -> dict[str, float]:
    """Return the differences of star, dark current and sky between parts of the frames and their surroundings.

    They are standard deviations, by name, and follow from means of `n_frames` quiescent frames, compared with the means
    before and after: the scatter in excess of noise, and the part that noise may hide. If there are fewer than
    `MIN_PARTS` such means, shorter ones are taken, and changes are assumed to grow in proportion to time. The sky
    changes by its documented prior.
    """
    unknown = series.model.unknowns(series.light)
    names = ("light", "dark")
    spectra = np.array([unknown[name] for name in names])
    amplitudes, covariance = fit_changes(series.excess, spectra, series.noise.used)
    found = dict.fromkeys(names, np.inf)
    size, means, counts = n_frames, list[Float](), np.zeros(0, np.intp)
    while size > 0 and len(means) < MIN_PARTS:
        part = survey.stare.numbers // size
        counts = np.bincount(part[~taken], minlength=int(part[-1]) + 1)
        # A part without the frames of a short event still shows the drift.
        enough = np.flatnonzero(counts > QUIET_SHARE * size)
        means, counts = [amplitudes[(part == k) & ~taken].mean(axis=0) for k in enough], counts[enough]
        size = size if len(means) >= MIN_PARTS else size // 2
    if len(means) >= MIN_PARTS:
        bends = np.diff(np.array(means), 2, axis=0) / 2
        for k, name in enumerate(names):
            share = 1.0 / counts
            # A mean less that of its neighbours has 3/2 of the variance of a mean, where all are of as many frames.
            expected = float(covariance[k, k]) * float((share[:-2] / 4 + share[1:-1] + share[2:] / 4).mean())
            beyond = max(float(np.mean(bends[:, k] ** 2)) - expected, 0.0)
            found[name] = n_frames / size * float(np.sqrt(beyond + 2 * expected * np.sqrt(2 / len(bends))))
    if "sky" in unknown and isinstance(NUISANCES["sky"].prior, Amplitude):
        found["sky"] = NUISANCES["sky"].prior.sd
    return found


def measure_flare(
    survey: SeriesSurvey, series: SpectralSeries, taken: NDArray[np.bool_], one: Detection
) -> Measurement | str:
    """Fit a flare to the sum of the spectra of an event, or return the reason why none is.

    The level of each pixel is the mean of the surroundings of the event. Star, dark current and sky may differ from
    these during the event, by as much as between other parts of the frames that are as long; see `drifts`.
    """
    at, inside = _window(survey, taken, one)
    n, base = int(inside.sum()), int((~inside).sum())
    if base < MIN_BASELINE:
        return f"{base} frames around it show the quiescent star, {MIN_BASELINE} are needed"
    excess = series.excess[at]
    summed = excess[inside].sum(axis=0) - n * excess[~inside].mean(axis=0)
    model = series.model
    # The level is that of a finite number of frames.
    variance = series.noise.used**2 * (1 + n / base)
    exposure = model.exposure(series.light, variance, n)
    unknown = {name: row * n / model.per_dn for name, row in model.unknowns(series.light).items()}
    sd = drifts(survey, series, taken, n)
    spectra, errors = np.array(list(unknown.values())), np.array([sd[name] for name in unknown])
    # What changes the light of the star changes that of the flare alike.
    of_flare = np.array([np.full(summed.size, float(name == "light")) for name in unknown])
    nuisances = Nuisances(tuple(unknown), spectra, errors, of_flare)
    try:
        return fit((summed / model.per_dn + exposure.recorded_dn)[None], exposure, model.flares_of(n), nuisances)
    except InputError as error:
        return str(error)
