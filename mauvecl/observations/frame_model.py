"""Pixels of spectra: their model in quiescent frames, single bad values, and changes of the light that all share."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.detection.nuisances import spectrum_of
from mauvecl.fits.flare_model import FlareModel
from mauvecl.host.arrays import PER_MAD, Bool, Float
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.host.tables.units import counts_in, unit_of
from mauvecl.observations.frames import Frames
from mauvecl.schema.errors import InputError

#: Share of bias and dark current below which the median of a pixel cannot include them.
LEAST_OF_OFFSET = 0.5
#: Largest distance of a wavelength from that of the instrument, as a share of the step between pixels.
MAX_OFFSET = 0.5
#: Largest relative difference between exposure times.
SAME_EXPOSURE = 0.01
#: Level above all counts, for pixels whose saturation is excluded before.
NO_CEILING_DN = 2**31 - 1


@dataclass(frozen=True, eq=False)
class FrameModel:
    """Frames of spectra of the instrument: its pixels or resolution elements."""

    quiet: Expectation  # one frame of the quiescent star in the instrument's pixels
    flare: FlareModel  # flares in one frame in the instrument's pixels
    bins: Float  # shape (n_value, n_pixel); weights of the instrument's pixels in each value of a frame: 0 or 1
    per_dn: Float  # shape (n_value,); values per DN of an exposure; for flux densities, those of a flat spectrum
    raw: bool  # true if the frames include bias and dark current
    star_is_known: bool = False  # true if `quiet` is of the observed star, not of another in its place

    @classmethod
    def of(cls, frames: Frames, quiet: Expectation, flare: FlareModel, flux_per_dn: Float) -> Self:
        """Match frames with the pixels or resolution elements of an instrument.

        `flux_per_dn` is the flux density, erg s-1 cm-2 nm-1, for one DN of the exposure in each of its pixels. Raises
        InputError if wavelengths differ from the instrument's, or the unit is neither counts nor a flux density.
        """
        assert frames.wavelength_nm is not None
        counts, per_flam = counts_in(frames.unit), _per_flam(frames.unit, frames.wavelength_nm)
        if counts is None and per_flam is None:
            raise InputError.of("unit", frames.unit, "one of adu, DN, adu / s, DN / s, or a flux density")
        exposure = float(np.median(frames.exposure_s))
        if np.ptp(frames.exposure_s) > SAME_EXPOSURE * exposure:
            ends = f"{frames.exposure_s.min():g} to {frames.exposure_s.max():g} s"
            fault = f"the exposure times of all frames must be the same, but range from {ends}"
            raise InputError(fault, key="exposure_s")
        bins = _bins(frames.wavelength_nm, quiet)
        if per_flam is not None:
            # A flux density is that of a flat spectrum with as many DN in all pixels of the value.
            per_flux = np.divide(1.0, flux_per_dn, out=np.zeros_like(flux_per_dn), where=flux_per_dn > 0)
            return cls(quiet, flare, bins, per_flam / (bins @ per_flux), False)
        assert counts is not None
        # Rates have no bias and dark current, as those of `stare`; counts may have them.
        per_count, is_rate = counts
        per_dn = np.full(len(bins), per_count)
        if is_rate:
            return cls(quiet, flare, bins, per_dn / exposure, False)
        raw = cls(quiet, flare, bins, per_dn, True)
        # Where the values of a pixel are far below bias and dark current, these were subtracted.
        included = np.nanmedian(frames.flux, axis=0) >= LEAST_OF_OFFSET * raw.offset
        return raw if included.all() and not frames.net else replace(raw, raw=False)

    @cached_property
    def offset(self) -> Float:
        """Bias and dark current in the frames, shape (n_value,)."""
        dark = self.quiet.n_frames * (self.quiet.bias_dn + self.quiet.dark_dn)
        return self.bins @ dark * self.per_dn if self.raw else np.zeros(len(self.bins))

    @cached_property
    def gain(self) -> Float:
        """Rise of the variance with the light, shape (n_value,)."""
        return np.asarray(self.bins @ self.quiet.gain_dn_per_electron / self.bins.sum(axis=1) * self.per_dn)

    def flares(self, temperatures_k: tuple[float, ...]) -> Float:
        """Return the light of flares of unit amplitude, shape (n_temperature, n_value)."""
        return np.asarray(self.flare.hot_spline(np.log(temperatures_k)) @ self.bins.T * self.per_dn)

    def unknowns(self, light: Float) -> dict[str, Float]:
        """Return the changes of frames by light, dark current and sky, in their unit, shape (n_value,) each.

        They are those by all `light` of the quiescent star, which pointing and throughput scale, by 1 deg C of the
        detector, and by the nominal light of the sky, if there is any.
        """
        spectra = {"light": light, "dark": self.bins @ spectrum_of("dark", self.quiet) * self.per_dn}
        sky = self.bins @ spectrum_of("sky", self.quiet) * self.per_dn
        return spectra | ({"sky": sky} if sky.any() else {})

    def variance(self, light: Float) -> Float:
        """Return the instrument's variance of a frame with this light, shape (n_value,)."""
        quiet = self.quiet
        fixed = quiet.unsaturated_variance_dn2 - quiet.gain_dn_per_electron * quiet.light_dn
        return self.bins @ fixed * self.per_dn**2 + self.gain * np.maximum(light, 0.0)

    def exposure(self, light: Float, variance: Float, n_frames: int) -> Expectation:
        """Return the expectation of some frames, with one pixel for each value, as measured.

        Light of a quiescent frame and its variance are in the frames' unit.
        """
        gain = self.gain / self.per_dn
        electrons = np.maximum(light / self.per_dn, 0.0) / gain / self.quiet.n_frames
        total = variance / self.per_dn**2 / self.quiet.n_frames
        read_variance = np.maximum(total - gain**2 * electrons - 1 / 12, 0.0)
        nm, none = self.bins @ self.quiet.wavelength_nm / self.bins.sum(axis=1), np.zeros(electrons.size)
        dark: dict[str, Any] = dict.fromkeys(("sky_electrons", "neighbour_electrons", "dark_dn", "bias_dn"), none)
        return replace(
            self.quiet, **dark, source_electrons=electrons, gain_dn_per_electron=gain, wavelength_nm=nm,
            read_noise_dn=np.sqrt(read_variance), element=np.arange(nm.size, dtype=np.int32),
            element_wavelength_nm=nm, n_frames=self.quiet.n_frames * n_frames,
            adc_max_dn=NO_CEILING_DN, saturation_dn=float(NO_CEILING_DN), messages=(),
        )  # fmt: skip


def _per_flam(text: str, wavelength_nm: Float) -> Float | None:
    """Return a flux density of 1 erg s-1 cm-2 nm-1 in a unit, shape (n_value,); None if it is not one."""
    import astropy.units as u

    flux = np.ones(wavelength_nm.size) * u.Unit("erg / (s cm2 nm)")
    try:
        unit = unit_of(text)
        # Magnitudes are not linear.
        is_linear = isinstance(unit, u.UnitBase)
        return np.asarray(flux.to_value(unit, u.spectral_density(wavelength_nm * u.nm))) if is_linear else None
    except (ValueError, TypeError):
        return None


def _bins(wavelengths: Float, quiet: Expectation) -> Float:
    """Return the pixels of an instrument in each wavelength of frames, shape (n_value, n_pixel): 0 or 1.

    The wavelengths are those of its pixels or of its resolution elements.
    """
    if (pixels := _matched(wavelengths, quiet.wavelength_nm)) is not None:
        return np.eye(quiet.wavelength_nm.size)[pixels]
    if (elements := _matched(wavelengths, quiet.element_wavelength_nm)) is not None:
        return np.asarray(~quiet.saturated * (quiet.element == elements[:, None]), np.float64)
    expected = f"{quiet.wavelength_nm.size} pixels or {quiet.element_wavelength_nm.size} resolution elements"
    given = f"{wavelengths.size} wavelengths from {wavelengths[0]:.1f} nm"
    fault = f"the spectra must have the {expected} of {quiet.instrument}, but have {given}"
    raise InputError(fault, key="wavelength_nm")


def _matched(wavelengths: Float, instrument_nm: Float) -> NDArray[np.intp] | None:
    """Return the index of each wavelength among those of an instrument, or None if one is not there."""
    nearest = np.array([int(np.argmin(np.abs(instrument_nm - nm))) for nm in wavelengths])
    step = float(np.median(np.diff(instrument_nm)))
    same = np.abs(instrument_nm[nearest] - wavelengths) < MAX_OFFSET * step
    # Pixels and elements correspond only if they have the same width.
    alike = wavelengths.size < 2 or abs(float(np.median(np.diff(wavelengths))) / step - 1.0) < MAX_OFFSET
    return nearest if same.all() and alike and np.unique(nearest).size == nearest.size else None


#: Numbers of frames before and after a change whose means are compared.
WIDTHS = (2, 4, 8, 16, 32, 64)
#: Expected number of false changes in a light curve, due to noise.
CHANCE = 0.001
#: Fall of chi-squared by which one cause must fit better than another: 3 standard deviations for one parameter.
CLEARLY = 9.0
#: Frames that may be missing in the frames that are compared.
MISSING = 3


@dataclass(frozen=True)
class LightChange:
    """Change of the light that all pixels share."""

    frame: int  # first frame after the change
    width: int  # number of frames before and after it that are compared
    change: float  # light after the change less that before, relative to the quiescent star
    error: float


def chi2_of_each(spectrum: Float, variance: Float, rows: Float) -> Float:
    """Return chi-squared of a spectrum less each of the rows alone, whose amplitude is fitted, shape (n_row,)."""
    along = rows @ (spectrum / variance)
    total = float((spectrum**2 / variance).sum())
    return np.asarray(total - along**2 / np.einsum("kp,kp->k", rows, rows / variance))


def light_changes(
    excess: Float, frames: NDArray[np.intp], numbers: NDArray[np.int64], light: Float, alternatives: Float, sd: Float
) -> list[LightChange]:  # fmt: skip
    """Find sudden changes of the light that all pixels share, in order of time.

    The light is fitted to some frames, ascending, and its means before and after each are compared. The spectrum of a
    change must clearly be that of the star rather than one of the `alternatives`: flares, dark current and sky.
    `excess` are all frames less the star's `light`, with their `numbers` on the regular grid and the noise `sd`.
    """
    weights = light / sd**2 / float(((light / sd) ** 2).sum())
    amplitude, places = excess[frames] @ weights, numbers[frames]
    noise = PER_MAD * float(np.median(np.abs(np.diff(amplitude)))) / np.sqrt(2.0)
    widths = [width for width in WIDTHS if 4 * width <= amplitude.size]
    if not widths or not noise > 0:
        return []
    limit = float(scipy.stats.norm.isf(CHANCE / 2 / amplitude.size / len(widths)))
    total = np.concatenate([[0.0], np.cumsum(amplitude)])
    sizes = np.zeros((len(widths), amplitude.size))
    for row, width in zip(sizes, widths, strict=True):
        k = np.arange(width, amplitude.size - width + 1)
        gapless = places[k + width - 1] - places[k - width] <= 2 * width - 1 + MISSING
        row[k[gapless]] = ((total[k + width] - 2 * total[k] + total[k - width]) / width)[gapless]
    errors = noise * np.sqrt(2.0 / np.array(widths))[:, None]
    significance = np.abs(sizes) / errors
    changes = []
    while significance.max() > limit:
        best, place = divmod(int(significance.argmax()), amplitude.size)
        width = widths[best]
        step = excess[frames[place : place + width]].mean(axis=0) - excess[frames[place - width : place]].mean(axis=0)
        variance = 2 * sd**2 / width
        if chi2_of_each(step, variance, light[None])[0] < chi2_of_each(step, variance, alternatives).min() - CLEARLY:
            changes.append(LightChange(int(frames[place]), width, float(sizes[best, place]), float(errors[best, 0])))
        # Windows that overlap this one see the same change.
        for values, wide in zip(significance, widths, strict=True):
            values[max(0, place - width - wide + 1) : place + width + wide] = 0.0
    return sorted(changes, key=lambda change: change.frame)


#: Expected number of values in all frames that are mistaken for cosmic rays in normal noise.
CHANCE_RAYS = 0.01
#: Flares that explain the light of many pixels at once, K; their residual in one pixel of one frame is a cosmic ray.
RAY_FLARES_K = (6_000.0, 12_000.0, 30_000.0)
#: Largest number of rounds of replacing bad values, and the change in standard deviations at which they end.
RAY_ROUNDS, SETTLED = 50, 0.05


@dataclass(frozen=True, eq=False)
class CleanedSpectra:
    """Frames whose single bad values are replaced."""

    frames: Frames  # without bias and dark current, in the pixels that are used
    model: FrameModel  # of these pixels
    rays: NDArray[np.int64]  # shape (n_frame,); number of values of each frame that are replaced
    stated: Float  # shape (n_pixel,); standard deviation of a quiescent frame
    has_errors: bool  # whether the file states errors; otherwise `stated` is that of the instrument's noise model
    saturated: Bool  # shape (n_frame,)


def clean_spectra(frames: Frames, model: FrameModel) -> CleanedSpectra:
    """Replace single bad values of spectra, as of particles, by a fit to the other pixels of their frame.

    Flares, and changes of the star, the dark current and the sky, change many pixels. Resolution elements whose pixels
    all saturate are left out.
    """
    usable = frames.faults == 0
    recorded = model.bins.sum(axis=1) > 0
    model = replace(model, bins=model.bins[recorded], per_dn=model.per_dn[recorded])
    assert frames.wavelength_nm is not None
    flux = frames.flux[:, recorded]
    # Sums of pixels do not saturate.
    single = model.raw & (model.bins.sum(axis=1) == 1)
    ceiling = np.where(single, model.quiet.n_frames * model.quiet.ceiling_dn, np.inf)
    saturated = usable & (flux >= ceiling).any(axis=1)
    flux = flux - model.offset
    good = usable & ~saturated
    if not good.any() or not recorded.any():
        fault = "at least one frame must be without a fault and below saturation, but none is"
        raise InputError(f"{frames.name}: {fault}", key="frames")
    light = np.median(flux[good], axis=0)
    if frames.error is None:
        noise = np.sqrt(model.variance(light))
        error = np.broadcast_to(noise, flux.shape)
    else:
        error = frames.error[:, recorded]
        noise = np.median(error[good], axis=0)
    rays = np.zeros(frames.n_frames, np.int64)
    rays[good] = _replace_rays(flux, np.flatnonzero(good), light, noise, model, frames.numbers)
    cleaned = replace(frames, flux=flux, error=error, wavelength_nm=frames.wavelength_nm[recorded])
    return CleanedSpectra(cleaned, model, rays, noise, frames.error is not None, saturated)


def _replace_rays(
    flux: Float, at: NDArray[np.intp], light: Float, noise: Float, model: FrameModel, numbers: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Replace bad values in some frames of `flux`, in place, and return their number in each of these frames."""
    excess = flux[at] - light
    # A robust measurement, so that errors that are stated too small make no rays.
    sd = np.maximum(noise, PER_MAD * np.median(np.abs(np.diff(excess, axis=0)), axis=0) / np.sqrt(2.0))
    spectra = np.vstack([*model.unknowns(light).values(), model.flares(RAY_FLARES_K)])
    basis = np.linalg.svd(spectra / np.linalg.norm(spectra, axis=1, keepdims=True) / sd, full_matrices=False)[2]
    limit = float(scipy.stats.norm.isf(CHANCE_RAYS / 2 / excess.size))
    bad, rows = np.zeros(excess.shape, np.bool_), np.arange(at.size)
    for _ in range(RAY_ROUNDS):
        fit = (excess[rows] / sd) @ basis.T @ basis * sd
        residual = np.abs(excess[rows] - fit) / np.sqrt(sd**2 + model.gain * np.maximum(fit, 0.0))
        residual[bad[rows]] = 0.0
        # Only the largest residual is replaced, since it moves the fit away from the other pixels.
        worst = residual.argmax(axis=1)
        far = residual[np.arange(rows.size), worst] > limit
        bad[rows[far], worst[far]] = True
        moved = np.where(bad[rows], fit - excess[rows], 0.0)
        excess[rows] += moved
        rows = rows[far | (np.abs(moved) > SETTLED * sd).any(axis=1)]
        if not rows.size:
            break
    # An excess in the same pixel of a neighbouring frame as well is not a ray, but light that the fit does not include.
    persistent = bad[1:] & bad[:-1] & (np.diff(numbers[at]) == 1)[:, None]
    bad[1:] &= ~persistent
    bad[:-1] &= ~persistent
    frame, pixel = np.nonzero(bad)
    flux[at[frame], pixel] = (excess + light)[bad]
    return np.asarray(bad.sum(axis=1), np.int64)
