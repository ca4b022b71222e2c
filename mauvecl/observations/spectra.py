"""Spectra of observed frames: single bad pixels, noise of each pixel as measured, and sums weighted for flares.

The weights are those of the marginalised matched filter (METHODS section 7) for flares of 6000 to 30 000 K, with the
noise of each pixel. The level of each frame is free: pointing losses change it, and a faint star does not show them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.detection.nuisances import Nuisances
from mauvecl.observations.detection import fit_quiet_light
from mauvecl.observations.frame_model import FrameModel, LightChange, light_changes
from mauvecl.observations.frames import Reason
from mauvecl.observations.level import PER_MAD, QuiescentLevel, guess_flares, single_frames
from mauvecl.observations.light_curve import check_usable, quiescent_light, searched_among
from mauvecl.observations.process import Steps
from mauvecl.observations.search import WHITE, SeriesSurvey, bank_of, stare_of
from mauvecl.schema.errors import InputError
from mauvecl.search.templates import TEMPERATURES_K, Templates

if TYPE_CHECKING:
    from mauvecl.flares.shapes import Shape
    from mauvecl.observations.frames import Frames

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

#: Expected number of values of normal noise in all frames that are mistaken for cosmic rays.
CHANCE_RAYS = 0.01
#: Flares that explain the light of many pixels at once, K; their residual in one pixel of one frame is a cosmic ray.
RAY_FLARES_K = (6_000.0, 12_000.0, 30_000.0)
#: Largest number of rounds of replacing bad values by the fit to the others, which end where the values change by less
#: than this share of a standard deviation.
RAY_ROUNDS, SETTLED = 50, 0.05
#: Differences, in standard errors, above which measured noise replaces stated noise.
DEPARTS = 4.0
#: Largest number of times that weights and events are found in alternation, and the share of the frames in events that
#: may change in the last.
ROUNDS, SETTLED_EVENTS = 3, 0.01
#: Number of frames in means that show slow changes.
SLOW_FRAMES = 12
#: Range of nine tenths of the slow changes of the dark current above which the search leaves it out, because flares
#: would be measured with a part of it: in standard errors of a frame, and relative to the range of means of frames that
#: change independently (assumed).
DARK_DRIFTS, BEYOND_JITTER = 5.0, 2.0
#: Range of nine tenths of normal values, in standard deviations.
NINE_TENTHS = float(scipy.stats.norm.ppf(0.95) - scipy.stats.norm.ppf(0.05))
#: Frames of one block of computations, which bounds the memory.
BLOCK = 1024


@dataclass(frozen=True, eq=False)
class CleanedSpectra:
    """Frames whose single bad values are replaced."""

    frames: Frames  # without bias and dark current, in the pixels that are used
    model: FrameModel  # of these pixels
    rays: NDArray[np.int64]  # shape (n_frame,); number of values of each frame that are replaced
    # Shape (n_pixel,); standard deviation of a quiescent frame, as the file states it or else by the noise model of the
    # instrument.
    stated: Float
    stated_by: str
    saturated: Bool  # shape (n_frame,)


@dataclass(frozen=True, eq=False)
class PixelNoise:
    """Noise of each pixel in quiescent frames, without the light and dark current that all pixels share."""

    # wavelength_nm, stated, measured: shape (n_pixel,); standard deviations of a frame.
    wavelength_nm: Float
    stated: Float
    measured: Float
    # low, high: shape (n_pixel,); range of `measured` for 95 % of normal noise of the stated size.
    low: Float
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
    model: FrameModel
    # Standard deviations of the unknowns that change from frame to frame; infinite for those that are projected out.
    jitters: Mapping[str, float]
    changes: list[LightChange]  # sudden changes of the light that all pixels share
    kept: float  # S/N of flares over that with a steady level of the frames
    # Range of nine tenths of the slow changes of the dark current, relative to the light in the sum over wavelength; 0
    # if they are small for the noise.
    dark_drift: float

    @property
    def left_out(self) -> list[str]:
        """Names of the unknowns whose changes from frame to frame the search leaves out."""
        return [name for name, sd in self.jitters.items() if np.isinf(sd)]

    @property
    def star_level(self) -> float:
        """Light of the star in the sum over wavelength, relative to `light`, by the shape of its spectrum.

        It excludes dark current and sky that the light includes; NaN if the star is not known.
        """
        if not self.model.star_is_known:
            return float("nan")
        star = self.model.star
        others = [spectrum for name, spectrum in self.model.unknowns(self.light).items() if name != "light"]
        columns = np.array([star, *others]).T / self.noise.used[:, None]
        amplitude = np.linalg.lstsq(columns, self.light / self.noise.used, rcond=None)[0][0]
        return float(amplitude * star.sum() / abs(self.light.sum()))


def relative_error(differences: int) -> float:
    """Return the relative standard error of a standard deviation from successive differences (von Neumann 1941)."""
    return 0.5 * float(np.sqrt(3.0 / max(differences, 1)))


def clean_spectra(frames: Frames, model: FrameModel) -> CleanedSpectra:
    """Replace single bad values of spectra by a fit to the other pixels of their frame.

    Flares, and changes of the star, the dark current and the sky, change many pixels. A single pixel that deviates in
    one frame was hit by a particle or read incorrectly. Pixels that are not finite in a frame without a fault are
    left out of all frames.
    """
    usable = frames.faults == 0
    fine = np.isfinite(frames.flux[usable]).all(axis=0) & (model.bins.sum(axis=1) > 0)
    if not fine.any() or not usable.any():
        raise InputError.of("flux", "no pixel that is finite in every frame", "pixels with light in every frame",
                            where=frames.name)  # fmt: skip
    model = model.part(fine)
    assert frames.wavelength_nm is not None
    flux = frames.flux[:, fine]
    saturated = usable & (flux >= model.ceiling).any(axis=1)
    flux = flux - model.offset
    good = usable & ~saturated
    if not good.any():
        raise InputError.of("flux", "saturated pixels in every frame", "frames below saturation", where=frames.name)
    light = np.median(flux[good], axis=0)
    error = None if frames.error is None else frames.error[:, fine]
    stated = np.sqrt(model.variance(light)) if error is None else np.median(error[good], axis=0)
    rays = np.zeros(frames.n_frames, np.int64)
    rays[good] = _replace_rays(flux, np.flatnonzero(good), light, stated, model, frames.numbers)
    made = replace(
        frames, flux=flux, error=np.broadcast_to(stated, flux.shape) if error is None else error,
        wavelength_nm=frames.wavelength_nm[fine],
    )  # fmt: skip
    return CleanedSpectra(made, model, rays, stated, "instrument" if error is None else "file", saturated)


def _replace_rays(
    flux: Float, at: NDArray[np.intp], light: Float, stated: Float, model: FrameModel, numbers: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Replace bad values in some frames of `flux`, in place, and return their number in each of these frames."""
    excess = flux[at] - light
    # Measured robustly, so that a wrong statement makes no rays.
    scatter = PER_MAD * np.median(np.abs(np.diff(excess, axis=0)), axis=0) / np.sqrt(2.0)
    sd = np.maximum(stated, scatter)
    spectra = np.vstack([*model.unknowns(light).values(), model.flares(RAY_FLARES_K)])
    basis = np.linalg.svd(spectra / np.linalg.norm(spectra, axis=1, keepdims=True) / sd, full_matrices=False)[2]
    limit = float(scipy.stats.norm.isf(CHANCE_RAYS / 2 / excess.size))
    bad = np.zeros(excess.shape, np.bool_)
    rows = np.arange(at.size)
    for _ in range(RAY_ROUNDS):
        fit = (excess[rows] / sd) @ basis.T @ basis * sd
        left = np.abs(excess[rows] - fit) / np.sqrt(sd**2 + model.gain * np.maximum(fit, 0.0))
        left[bad[rows]] = 0.0
        # The farthest alone: a large one moves the fit away from the others.
        worst = left.argmax(axis=1)
        far = left[np.arange(rows.size), worst] > limit
        bad[rows[far], worst[far]] = True
        moved = np.where(bad[rows], fit - excess[rows], 0.0)
        excess[rows] += moved
        rows = rows[far | (np.abs(moved) > SETTLED * sd).any(axis=1)]
        if not rows.size:
            break
    # An excess in the same pixel of a neighbouring frame as well is not a ray, but light that the fit does not include.
    adjacent = np.diff(numbers[at]) == 1
    both = bad[1:] & bad[:-1] & adjacent[:, None]
    bad[1:] &= ~both
    bad[:-1] &= ~both
    where = np.nonzero(bad)
    flux[at[where[0]], where[1]] = (excess + light)[where]
    return np.asarray(bad.sum(axis=1), np.int64)


def measure_noise(excess: Float, pairs: NDArray[np.intp], stated: Float, shared: Float, nm: Float) -> PixelNoise:
    """Measure the noise of each pixel from differences of neighbouring quiescent frames.

    The frames of `pairs` and their successors are quiescent and next to each other. The noise of a frame is expected to
    be as `stated`. Amplitudes of changes that all pixels share, with the spectra `shared`, are fitted to each frame.
    """
    basis = np.linalg.svd(shared / stated, full_matrices=False)[2]
    total = np.zeros(stated.size)
    for first in range(0, pairs.size, BLOCK):
        some = pairs[first : first + BLOCK]
        steps = (excess[some + 1] - excess[some]) / stated
        total += ((steps - steps @ basis.T @ basis) ** 2).sum(axis=0)
    # The fit takes its share of the noise of each pixel.
    left = 1.0 - (basis**2).sum(axis=0)
    measured = stated * np.sqrt(total / (2.0 * pairs.size * left))
    reach = float(scipy.stats.norm.isf(0.025)) * relative_error(pairs.size)
    return PixelNoise(nm, stated, measured, stated * (1 - reach), stated * (1 + reach), int(pairs.size))


def survey_spectra(
    cleaned: CleanedSpectra,
    shape: Shape,
    rank: int,
    seed: int,
    jitters: Mapping[str, float] | None = None,
    steps: Steps | None = None,
) -> tuple[SeriesSurvey, SpectralSeries, QuiescentLevel]:
    """Prepare the search of spectra that is weighted for flares.

    Slow changes of the dark current and of what else the weights let through are processes of the weighted sums; the
    level of the light in each frame is free, so that pointing losses take no part. The level that is returned is that
    of the sum over wavelength, with flags of single frames that only the weighted sums show.

    Parameters
    ----------
    rank : int
        Largest number of sums of a frame.
    seed : int
        Seed of the standard error of the level.
    jitters : mapping of str to float, optional
        Standard deviations of unknowns of each frame, infinite for those that are projected out. Where they do not
        state it, that of the light is infinite and that of the dark current as measured.
    steps : Steps, optional
        Reports fits, searches and draws.
    """
    steps = steps or Steps()
    fits = steps.part(0.0, 0.9)
    frames = cleaned.frames
    flux, error = frames.white_light
    assert error is not None
    reasons = frames.faults | np.where(cleaned.saturated, Reason.SATURATED, 0)
    check_usable(frames, reasons)
    used = reasons == 0
    events = np.zeros(flux.size, np.bool_)
    events[used] = guess_flares(frames.numbers[used], flux[used])
    for _ in range(ROUNDS):
        series, templates, sums = _weighted_sums(cleaned, reasons, used & ~events, rank, jitters)
        directions = templates.directions[list(templates.chosen)]
        stare = stare_of(frames, used)
        scale = float(np.median(error[used]))
        # The noise follows that of the whole light in time.
        variance = (error[used] / scale) ** 2
        light = series.light
        lit = np.maximum(light, 0.0)
        # Frames without light, such as dark frames, have no photon noise to weight by.
        photon = float(np.average(series.model.gain, weights=lit if lit.any() else None))
        survey = SeriesSurvey(
            stare, bank_of(stare, directions, shape), templates, sums[used], variance, (WHITE,) * sums.shape[1],
            flux[used] / scale, variance, WHITE, scale, abs(float(np.median(flux[used & ~events]))), photon,
            frames.time_s[used], weighted=True,
        )  # fmt: skip
        survey, taken = fit_quiet_light(survey, events[used], None, fits)
        now = np.zeros(flux.size, np.bool_)
        now[used] = taken
        sigmas = np.zeros(flux.size)
        sigmas[used] = survey.along(len(survey.bank.directions) // 2, ~taken)
        single = single_frames(frames.numbers, sigmas, used)
        settled = not single.any() and float((now ^ events).mean()) <= SETTLED_EVENTS
        events = now
        if settled:
            break
        reasons = np.where(single, reasons | Reason.SPIKE, reasons)
        used = reasons == 0
    kept = reasons[searched_among(survey, frames)] == 0
    survey = survey.frames(kept)
    series = replace(series, excess=series.excess[used])
    draws = steps.part(0.9, 1.0)
    level = quiescent_light(frames, flux, frames.error, survey, used, used & ~events, reasons, seed, draws)
    return survey, series, level


def _weighted_sums(
    cleaned: CleanedSpectra, reasons: NDArray[np.int64], quiet: Bool, rank: int, jitters: Mapping[str, float] | None
) -> tuple[SpectralSeries, Templates, Float]:
    """Return the spectra less that of the quiescent star, the weights for flares, and the weighted sums of each frame.

    Sums have unit covariance from frame to frame, and are independent of each other over longer times as well. Frames
    that belong to no event are `quiet`.
    """
    frames, model = cleaned.frames, cleaned.model
    light = frames.flux[quiet].mean(axis=0)
    unknown = model.unknowns(light)
    excess = frames.flux - light
    neighbours = np.diff(frames.numbers) == 1
    pairs = np.flatnonzero(quiet[:-1] & quiet[1:] & neighbours)
    if not pairs.size:
        raise InputError.of("frames", 0, "neighbouring frames without a flare, from which the noise follows",
                            where=frames.name)  # fmt: skip
    assert frames.wavelength_nm is not None
    shared = np.array([unknown["light"], unknown["dark"]])
    noise = measure_noise(excess, pairs, cleaned.stated, shared, frames.wavelength_nm)
    flares = model.flares(TEMPERATURES_K)
    compared = np.flatnonzero(reasons == 0)
    others = np.vstack([flares, *(spectrum for name, spectrum in unknown.items() if name != "light")])
    changes = light_changes(excess, compared, frames.numbers, light, others, noise.used)
    dark, drift = _dark_changes(excess, pairs, quiet, noise.used, shared)
    known = {"light": np.inf} | dark | dict(jitters or {})
    names = tuple(name for name in known if name in unknown)
    nuisances = Nuisances(names, np.array([unknown[name] for name in names]).reshape(len(names), light.size),
                          np.array([known[name] for name in names]))  # fmt: skip
    # Flares that double the light of the star, in the sum over wavelength.
    flares *= abs(float(light.sum())) / flares.sum(axis=1, keepdims=True)
    templates, steady = (
        Templates.of_spectra(noise.used**2, flares, model.gain, TEMPERATURES_K, nuisances=some, rank=rank)
        for some in (nuisances, nuisances.without(["light"]))
    )
    kept = float(np.median(templates.best / steady.best))
    sums = np.concatenate([excess[i : i + BLOCK] @ templates.weights.T for i in range(0, len(excess), BLOCK)])
    mixing = _whitening(sums, pairs)
    if mixing is not None:
        templates, sums = templates.mixed(mixing), sums @ mixing.T
    turn = _slow_axes(sums, quiet)
    templates, sums = templates.mixed(turn), sums @ turn.T
    drift *= abs(float(unknown["dark"].sum() / light.sum()))
    return SpectralSeries(excess, light, noise, model, known, changes, kept, drift), templates, sums


def _slow_axes(sums: Float, quiet: Bool) -> Float:
    """Return the rotation of sums to the axes along which they change slowly, shape (n_sum, n_sum).

    The noise, of unit covariance, stays so.
    """
    means = _slow_means(sums[quiet])
    if len(means) < 2 * sums.shape[1]:
        return np.eye(sums.shape[1])
    return np.asarray(np.linalg.eigh(np.cov(means.T).reshape(sums.shape[1], -1))[1].T[::-1])


def _slow_means(values: Float) -> Float:
    """Return the means of each `SLOW_FRAMES` values along the first axis."""
    n = len(values) // SLOW_FRAMES
    return np.asarray(values[: n * SLOW_FRAMES].reshape(n, SLOW_FRAMES, *values.shape[1:]).mean(axis=1))


def fit_changes(excess: Float, spectra: Float, sd: Float) -> tuple[Float, Float]:
    """Fit the amplitudes of spectra together to each frame; return them, shape (n_frame, k), and their covariance.

    The noise of a frame is `sd`.
    """
    white = spectra / sd
    covariance: Float = np.asarray(np.linalg.inv(white @ white.T), np.float64)
    return excess @ (covariance @ white / sd).T, covariance


def _dark_changes(
    excess: Float, pairs: NDArray[np.intp], quiet: Bool, sd: Float, shared: Float
) -> tuple[dict[str, float], float]:
    """Measure changes of the dark current, which is fitted together with the light; both spectra are `shared`.

    Returns
    -------
    dict of str to float
        Standard deviation of the dark current from frame to frame beyond that of noise; infinite if it drifts, and none
        if it does not change significantly.
    float
        Range of nine tenths of slow changes if it drifts, or else 0.
    """
    amplitudes, covariance = fit_changes(excess, shared, sd)
    amplitude, error = amplitudes[:, 1], float(np.sqrt(covariance[1, 1]))
    variance = float(np.mean((amplitude[pairs + 1] - amplitude[pairs]) ** 2)) / 2
    beyond = variance - error**2
    significant = beyond > DEPARTS * 2 * relative_error(pairs.size) * error**2
    jitter = {"dark": float(np.sqrt(beyond))} if significant else {}
    means = _slow_means(amplitude[quiet])
    if len(means) < 2:
        return jitter, 0.0
    drift = float(np.ptp(np.quantile(means, [0.05, 0.95])))
    independent = NINE_TENTHS * float(np.sqrt(variance / SLOW_FRAMES))
    return ({"dark": np.inf}, drift) if drift > max(DARK_DRIFTS * error, BEYOND_JITTER * independent) else (jitter, 0.0)


def _whitening(sums: Float, pairs: NDArray[np.intp]) -> Float | None:
    """Return the matrix that gives the sums unit covariance, as measured; None if they have it already."""
    steps = sums[pairs + 1] - sums[pairs]
    covariance = steps.T @ steps / (2 * pairs.size)
    error = 2 * relative_error(pairs.size)
    departs = np.abs(covariance - np.eye(len(covariance))) > DEPARTS * error
    return np.linalg.inv(np.linalg.cholesky(covariance)) if departs.any() else None
