"""Calibration of the detector: dark current, gain and read noise from exposures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.arrays import Float
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.host.stars.source import Source
from mauvecl.observations.frames import Frames
from mauvecl.schema.errors import InputError

#: Share of saturation above which a mean raw level is not used, since clipping then changes mean and variance.
MOST_OF_SATURATION = 0.98


@dataclass(frozen=True, eq=False)
class CalibrationFrames:
    """Raw frames of one observation that have no fault."""

    name: str
    raw_dn: Float  # shape (n_frame, n_pixel); with bias and dark
    exposure_s: float  # of each frame
    temperature_c: Float  # shape (n_frame,); of the detector
    star: Source | None = None  # the known spectrum at its brightness; None for frames without light

    @classmethod
    def of(cls, frames: Frames, nominal: Instrument, star: Source | None, temperature_c: float | None = None) -> Self:
        """Select the good frames of spectra that a detector recorded: raw DN of each pixel that the instrument reads.

        `temperature_c` is that of the detector where the frames do not state it.
        """
        name, nm, own_nm = frames.name, frames.wavelength_nm, nominal.wavelength_nm
        if nm is None or nm.shape != own_nm.shape:
            expected = f"spectra of the {own_nm.size} pixels that {nominal.name} reads"
            raise InputError.of("frames", frames.flux.shape, expected, where=name)
        offset, limit = float(np.abs(nm - own_nm).max()), nominal.resolution_element_nm
        if offset > limit:
            ends = f"within {limit:g} nm of those of {nominal.name}, but differ by {offset:.3g} nm"
            fault = f"the wavelengths must be {ends}"
            raise InputError(f"{name}: {fault}", key="wavelength")
        if frames.unit.strip().casefold() not in ("dn", "adu", "ct", "count"):
            raise InputError.of("unit", frames.unit or "none", "that of raw DN, with bias and dark", where=name)
        if frames.net:
            fault = "dark current and bias are subtracted; use read_frames(..., raw=True)"
            raise InputError(f"{name}: {fault}", key="frames")
        temperatures = frames.temperature_c
        if temperatures is None and temperature_c is None:
            raise InputError(f"{name} needs a column of detector temperatures, or temperature_c", key="temperature_c")
        temperatures = np.full(frames.n_frames, temperature_c) if temperatures is None else temperatures
        good = (frames.faults == 0) & np.isfinite(temperatures)
        lengths = np.unique(frames.exposure_s[good].round(6))
        if good.sum() < 3 or lengths.size != 1:
            fault = f"needs at least 3 good frames of one exposure time, not {good.sum()} of {lengths.size}"
            raise InputError(f"{name} {fault}", key="frames")
        if (frames.flux[good] == frames.flux[good][0]).all():
            raise InputError(f"{name}: frames must differ by their noise, but all are the same", key="frames")
        return cls(name, frames.flux[good], float(lengths[0]), temperatures[good], star)

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.raw_dn)

    def usable(self, nominal: Instrument) -> NDArray[np.bool_]:
        """Return the pixels that stay below saturation in every frame, shape (n_pixel,)."""
        ceiling = min(nominal.saturation_dn, nominal.adc_max_dn)
        return np.asarray(self.raw_dn.max(axis=0) < MOST_OF_SATURATION * ceiling)


class GoodnessOfFit:
    """Chi-squared of a fit."""

    chi2: float
    dof: float

    @property
    def p_value(self) -> float:
        """Probability of a chi-squared at least as large."""
        return float(scipy.stats.chi2.sf(self.chi2, self.dof))


#: Change of temperature, deg C, within which consecutive dark frames are compared for their variance.
SAME_TEMPERATURE_C = 0.05
#: Variance of rounding to whole DN.
ROUNDING = 1.0 / 12.0
#: Iterations of the weights, which follow the fitted variances.
ITERATIONS = 20
#: Difference of chi-squared above which the unit of the dark counts is determined (5 %).
MIN_CHI2_DIFFERENCE = 3.84
#: Smallest S/N of the gain with which it is reported.
MIN_SNR = 5.0
#: Relative error of a gain that is not measured: the rms deviation of the quoted 20 to 25 uV per electron from 20.
ASSUMED_GAIN_ERROR = 0.14


@dataclass(frozen=True)
class NoiseModel:
    """Variance of a pixel in a frame: read_variance + dark_factor * dark + gain * light, all in DN."""

    read_variance: float  # DN^2, rounding included
    dark_factor: float  # DN: 1 if dark counts are DN, the gain if they are electrons
    gain: float  # DN per electron

    @classmethod
    def nominal(cls, instrument: Instrument) -> NoiseModel:
        """Return the noise of an instrument."""
        gain = instrument.gain_dn_per_electron
        factor = gain if instrument.dark_unit == "electrons" else 1.0
        return cls(instrument.read_noise_dn**2 + ROUNDING, factor, gain)

    def variance(self, light_dn: ArrayLike, dark_dn: ArrayLike) -> Float:
        """Return the variance of frames with this mean light and dark, DN^2."""
        light, dark = np.maximum(light_dn, 0.0), np.maximum(dark_dn, 0.0)
        return np.asarray(self.read_variance + self.dark_factor * dark + self.gain * light)


@dataclass(frozen=True, eq=False)
class PhotonTransfer(GoodnessOfFit):
    """Fit of measured variances."""

    noise: NoiseModel
    covariance: Float  # shape (2, 2); of read variance and gain, for known dark counts
    read_noise_error: float  # standard error, DN, with that of the dark counts
    dark_unit: Literal["DN", "electrons"]
    chi2: float
    dof: int
    mean_dn: Float  # shape (n_value,), like all means of light, measured and fitted variances
    variance: Float
    model: Float
    assumed: tuple[str, ...] = ()  # quantities that these frames do not determine

    @property
    def read_noise_dn(self) -> float:
        """Read noise without the rounding, DN."""
        return float(np.sqrt(max(self.noise.read_variance - ROUNDING, 0.0)))

    @property
    def gain_error(self) -> float:
        """Standard error of the gain, DN per electron."""
        return float(np.sqrt(self.covariance[1, 1]))

    @property
    def relative_gain_error(self) -> float:
        """Standard error of the gain over its value."""
        return self.gain_error / self.noise.gain


def variance_of_steps(steps: Float, scale: Float, shared: Float) -> Float:
    """Return the variance of each pixel from differences of frames, shape (n_step, n_pixel), without drifts.

    Changes that all pixels share, with some spectra, are fitted to each difference in units of the `scale` of pixels.
    """
    basis = np.linalg.svd(shared[shared.any(axis=1)] / scale, full_matrices=False)[2]
    white = steps / scale
    white = white - (white @ basis.T) @ basis
    # The fit takes its share of the noise of each pixel.
    return np.asarray(np.mean(white**2, axis=0) / (1.0 - np.sum(basis**2, axis=0)) * scale**2 / 2)


def measured_variances(observations: Sequence[CalibrationFrames], dark: DarkFit, nominal: Instrument) -> Float:
    """Measure the variance of frames from differences of consecutive ones, where light and dark may jitter.

    The rows of the result, shape (6, n_value), are the variance, light and dark of each usable pixel of each
    observation (of dark frames, at each temperature), the degrees of freedom of the variance, and, by the nominal map,
    the gain of the pixel and the variance of its read noise over the mean.
    """
    measured, gains = [], nominal.per_pixel("gain", 1.0)
    read_variances = nominal.per_pixel("read_noise_dn", nominal.read_noise_dn) ** 2 + ROUNDING
    shares = read_variances / read_variances.mean()
    for frames in observations:
        breaks = np.flatnonzero(np.abs(np.diff(frames.temperature_c)) > SAME_TEMPERATURE_C) + 1
        for rows in np.split(np.arange(frames.n_frames), breaks if frames.star is None else []):
            if rows.size < 3:
                continue
            same = replace(frames, raw_dn=frames.raw_dn[rows], temperature_c=frames.temperature_c[rows])
            # A pixel that never changes is dead.
            usable = frames.usable(nominal) & np.any(same.raw_dn != same.raw_dn[0], axis=0)
            mean, steps = dark.mean_dn(same)[usable], np.diff(same.raw_dn[:, usable], axis=0)
            light = np.zeros(mean.size) if frames.star is None else same.raw_dn[:, usable].mean(axis=0) - mean
            counts, n = mean - dark.bias_dn[usable], len(steps)
            variance = variance_of_steps(steps, np.sqrt(np.mean(steps**2, axis=0)), np.array([light, counts]))
            # Degrees of freedom of the mean square of consecutive differences of normal values (von Neumann 1941).
            dof = np.full(light.size, 2 * n**2 / (3 * n - 1))
            measured.append([variance, light, counts, dof, gains[usable], shares[usable]])
    return np.concatenate(measured, axis=1)


def fit_photon_transfer(measured: Float, nominal: Instrument, dark_error_dn: float = 0.0) -> PhotonTransfer:
    """Fit gain, read noise and the unit of dark counts to `measured_variances` by weighted least squares.

    Values that the data do not determine stay nominal. The standard error of the dark of a mean frame, `dark_error_dn`,
    adds to that of the read noise.
    """
    variance, light, dark, dof, gains, shares = measured
    fits = {"DN": _fit(shares, gains * light, dark, variance, dof),
            "electrons": _fit(shares, gains * (light + dark), np.zeros_like(dark), variance, dof)}  # fmt: skip
    better, unit, assumed = fits["DN"][2] - fits["electrons"][2], nominal.dark_unit, ["unit of the dark counts"]
    if abs(better) > MIN_CHI2_DIFFERENCE:
        unit, assumed = "electrons" if better > 0 else "DN", []
    (read, gain), covariance, chi2, model = fits[unit]
    errors = np.sqrt(np.diag(covariance))
    if not gain > MIN_SNR * errors[1]:
        before, unknown = NoiseModel.nominal(nominal), ("gain", "read noise", "unit of the dark counts")
        assumed_error = np.diag([0.0, (ASSUMED_GAIN_ERROR * before.gain) ** 2])
        return PhotonTransfer(before, assumed_error, 0.0, nominal.dark_unit, np.nan, 0, light, variance,
                              before.variance(gains * light, dark), unknown)  # fmt: skip
    read = max(float(read), ROUNDING)
    noise = NoiseModel(read, float(gain) if unit == "electrons" else 1.0, float(gain))
    read_error = np.hypot(errors[0], noise.dark_factor * dark_error_dn) / (2 * np.sqrt(max(read - ROUNDING, errors[0])))
    return PhotonTransfer(noise, covariance, float(read_error), unit, float(chi2),
                          variance.size - 2, light, variance, model, tuple(assumed))  # fmt: skip


def _fit(share: Float, column: Float, fixed: Float, variance: Float, dof: Float) -> tuple[Float, Float, float, Float]:
    """Fit variance = fixed + read * share + gain * column; return values, covariance, chi-squared and the model."""
    design = np.column_stack([share, column])
    model = np.maximum(variance, 1.0)
    fitted, covariance = np.zeros(2), np.eye(2)
    for _ in range(ITERATIONS):
        weighted = design * (dof / (2 * model**2))[:, None]
        covariance = np.linalg.pinv(weighted.T @ design)
        fitted = covariance @ (weighted.T @ (variance - fixed))
        model = np.maximum(fixed + design @ fitted, ROUNDING)
    # The cube roots of chi-squared variables are nearly normal (Wilson & Hilferty 1931).
    spread = 2 / (9 * dof)
    normal = (np.cbrt(variance / model) - (1 - spread)) / np.sqrt(spread)
    return fitted, covariance, float(np.sum(normal**2)), model


#: Smallest range of temperatures, deg C, from which the slope is fitted, and from which the bias is as well.
SLOPE_RANGE_C, BIAS_RANGE_C = 0.5, 3.0
#: Relative error of the dark current where it is not measured: an assumption, as that of the quantum efficiency.
ASSUMED_DARK_ERROR = 0.3
#: Smallest ratio of exposure times from which the bias is fitted.
EXPOSURE_RATIO = 2.0


@dataclass(frozen=True, eq=False)
class DarkFit(GoodnessOfFit):
    """Dark current as level_p exp(slope (T - reference)), and bias."""

    reference_c: float  # temperature at which the levels hold
    level_dn_per_s: Float  # shape (n_pixel,)
    bias_dn: Float  # shape (n_pixel,)
    covariance: Float  # shape (n_pixel, 2, 2); of bias and level of each pixel, independent between pixels
    shared: Float  # shape (3, 3); covariance of bias, level and slope of the mean pixel, which all pixels share
    slope_per_c: float  # common to all pixels
    pixel_slope_per_c: Float  # shape (n_pixel,); of each pixel alone; NaN if it is not determined
    pixel_slope_error: Float
    assumed: tuple[str, ...]  # quantities that these frames do not determine
    chi2: float = np.nan
    dof: int = 0
    slopes_p_value: float = np.nan  # of pixel slopes at least as different if all are equal

    @property
    def bias_error(self) -> Float:
        """Standard errors of the biases, shape (n_pixel,): of each, or of all together; 0 if they are assumed."""
        variance = self.covariance[:, 0, 0]
        return np.asarray(np.sqrt(np.where(variance > 0, variance, self.shared[0, 0])))

    @property
    def level_error(self) -> Float:
        """Standard errors of the levels, shape (n_pixel,)."""
        return np.asarray(np.sqrt(self.covariance[:, 1, 1]))

    @property
    def slope_error(self) -> float:
        """Standard error of the slope; 0 if it is assumed."""
        return float(np.sqrt(self.shared[2, 2]))

    def growth(self, temperature_c: Float) -> Float:
        """Return the dark current at temperatures over that at the reference."""
        return np.asarray(np.exp(self.slope_per_c * (temperature_c - self.reference_c)))

    def terms(self, frames: CalibrationFrames) -> tuple[float, float]:
        """Return the seconds of dark current at the reference in a mean frame, and their change with the slope."""
        seconds = frames.exposure_s * self.growth(frames.temperature_c)
        return float(seconds.mean()), float((seconds * (frames.temperature_c - self.reference_c)).mean())

    def mean_dn(self, frames: CalibrationFrames) -> Float:
        """Return bias and dark of a mean frame, DN, shape (n_pixel,)."""
        return self.bias_dn + self.level_dn_per_s * self.terms(frames)[0]


def fit_dark(dark: Sequence[CalibrationFrames], nominal: Instrument, noise: NoiseModel) -> DarkFit:
    """Fit bias, dark level of each pixel and a common slope to frames without light, by weighted least squares.

    The slope is assumed for temperatures within `SLOPE_RANGE_C`. Each pixel's bias is fitted if exposure times differ
    by `EXPOSURE_RATIO`, and one for all pixels if temperatures span `BIAS_RANGE_C`; otherwise it is the instrument's.
    Without frames all are the instrument's.
    """
    bias = nominal.per_pixel("bias_dn", nominal.bias_dn)
    level = nominal.per_pixel("dark", nominal.dark_dn_per_s)
    if not dark:
        return _assumed_dark(nominal, level, bias)
    covariance, (change, error) = np.zeros((level.size, 2, 2)), np.full((2, level.size), np.nan)
    raw = np.concatenate([frames.raw_dn for frames in dark])
    temperature = np.concatenate([frames.temperature_c for frames in dark])
    exposure = np.concatenate([np.full(frames.n_frames, frames.exposure_s) for frames in dark])
    n_pixel, reference, spread = raw.shape[1], float(temperature.mean()), float(np.ptp(temperature))
    offset = temperature - reference
    fits_slope, by_pixel = spread >= SLOPE_RANGE_C, float(exposure.max() / exposure.min()) >= EXPOSURE_RATIO
    shares_bias = not by_pixel and spread >= BIAS_RANGE_C
    fits_bias = by_pixel or shares_bias
    # The mean pixel gives what all pixels share: bias, slope, and their errors.
    free = np.array([fits_bias, True, fits_slope])
    common, shared, typical = _mean_dark(raw, exposure, offset, free, nominal, noise)
    slope, bias = float(common[2]), np.full(n_pixel, common[0]) if shares_bias else bias
    # With the slope known, each pixel is linear in its level and bias.
    seconds = exposure * np.exp(slope * offset)
    columns = np.column_stack([np.ones_like(seconds), seconds, seconds * offset])
    values, used = (raw, [0, 1]) if by_pixel else (raw - bias, [1])
    fitted, errors = _fit_pixels(columns[:, used], 1.0 / typical, values, noise)
    level, bias = fitted[-1], fitted[0] if by_pixel else bias
    covariance[:, -len(used) :, -len(used) :] = errors
    if fits_slope:
        fitted, errors = _fit_pixels(columns[:, [*used, 2]], 1.0 / typical, values, noise, (seconds, level))
        change, error = fitted[-1] / level, np.sqrt(errors[:, -1, -1]) / np.abs(level)
    mean = seconds[:, None] * level
    return DarkFit(
        reference, level, bias, covariance, shared, slope, pixel_slope_per_c=slope + change, pixel_slope_error=error,
        chi2=float(np.sum((raw - bias - mean) ** 2 / noise.variance(0.0, mean))),
        dof=raw.size - len(used) * n_pixel - int(fits_slope) - int(shares_bias),
        slopes_p_value=float(scipy.stats.chi2.sf(np.sum((change / error) ** 2), n_pixel - 1)),
        assumed=tuple(name for name, fits in (("dark slope", fits_slope), ("bias", fits_bias)) if not fits),
    )  # fmt: skip


def _assumed_dark(nominal: Instrument, level: Float, bias: Float) -> DarkFit:
    """Return the instrument's dark current, with an assumed error of its level."""
    shared = np.diag([0.0, (ASSUMED_DARK_ERROR * level.mean()) ** 2, 0.0])
    unknown, assumed = np.full(level.size, np.nan), ("dark current", "dark slope", "bias")
    return DarkFit(nominal.temperature_c, level, bias, np.zeros((level.size, 2, 2)), shared,
                   nominal.dark_slope_per_c, unknown, unknown, assumed)  # fmt: skip


def _mean_dark(
    raw: Float, exposure: Float, offset: Float, free: NDArray[np.bool_], nominal: Instrument, noise: NoiseModel
) -> tuple[Float, Float, Float]:
    """Fit bias, level and slope of the mean pixel; return them, their covariance, and the variance of a pixel.

    Offsets are temperatures above the reference. Values that are not `free` are nominal, with no variance.
    """
    series, bias = raw.mean(axis=1), nominal.per_pixel("bias_dn", nominal.bias_dn).mean()
    start = np.array([bias, (series - bias).mean() / exposure.mean(), nominal.dark_slope_per_c])
    typical = noise.variance(0.0, start[1] * exposure * np.exp(start[2] * offset))

    def residuals(values: Float) -> Float:
        bias, level, slope = np.where(free, values, start)
        return np.asarray((series - bias - level * exposure * np.exp(slope * offset)) / np.sqrt(typical / raw.shape[1]))

    best_fit = scipy.optimize.least_squares(residuals, start, x_scale=np.maximum(np.abs(start), 1e-3), xtol=1e-14)
    covariance, jacobian = np.zeros((3, 3)), np.asarray(best_fit.jac)[:, free]
    covariance[np.ix_(free, free)] = np.linalg.inv(jacobian.T @ jacobian)
    return np.where(free, best_fit.x, start), covariance, typical


def _fit_pixels(
    columns: Float, weight: Float, values: Float, noise: NoiseModel, dark: tuple[Float, Float] | None = None
) -> tuple[Float, Float]:
    """Fit a linear model to each pixel with the weights of a typical one.

    The last column is the signal of the level unless `dark` has exposure times and levels of the dark current. Return
    the values, shape (n_column, n_pixel), and their covariance, shape (n_pixel, n_column, n_column).
    """
    weighted = columns * weight[:, None]
    hat = np.linalg.solve(weighted.T @ columns, weighted.T)
    fitted = np.asarray(hat @ values)
    seconds, level = (columns[:, -1], fitted[-1]) if dark is None else dark
    photons = noise.dark_factor * level[:, None, None] * ((hat * seconds) @ hat.T)
    return fitted, noise.read_variance * hat @ hat.T + photons
