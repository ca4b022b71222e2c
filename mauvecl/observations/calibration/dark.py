"""Dark current of each pixel against temperature, and bias, from frames without light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.host.instrument.instrument import Instrument
from mauvecl.observations.calibration.exposures import CalibrationFrames
from mauvecl.observations.calibration.photon_transfer import NoiseModel

Float = NDArray[np.float64]

#: Smallest range of temperatures, deg C, from which the slope is fitted, and from which the bias is as well.
SLOPE_RANGE_C, BIAS_RANGE_C = 0.5, 3.0
#: Relative error of the dark current where it is not measured: an assumption, as that of the quantum efficiency.
ASSUMED_ERROR = 0.3
#: Smallest ratio of exposure times from which the bias is fitted.
EXPOSURE_RATIO = 2.0


@dataclass(frozen=True, eq=False)
class DarkFit:
    """Dark current as level_p exp(slope (T - reference)), and bias."""

    reference_c: float  # temperature at which the levels hold
    # level_dn_per_s, level_error: shape (n_pixel,).
    level_dn_per_s: Float
    level_error: Float
    # bias_dn, bias_error: shape (n_pixel,); the error is 0 if the bias is assumed.
    bias_dn: Float
    bias_error: Float
    covariance: Float  # shape (n_pixel, 2, 2); of bias and level of each pixel, independent between pixels
    shared: Float  # shape (3, 3); covariance of bias, level and slope of the mean pixel, which all pixels share
    # slope_per_c, slope_error: common to all pixels; the error is 0 if the slope is assumed.
    slope_per_c: float
    slope_error: float
    # pixel_slope_per_c, pixel_slope_error: shape (n_pixel,); of each pixel alone; NaN if it is not determined.
    pixel_slope_per_c: Float
    pixel_slope_error: Float
    chi2: float
    dof: int
    # Probability of pixel slopes at least as different if all are equal; NaN if they are not determined.
    slopes_p_value: float
    assumed: tuple[str, ...]  # quantities that these frames do not determine

    @property
    def p_value(self) -> float:
        """Probability of a chi-squared at least as large."""
        return float(scipy.stats.chi2.sf(self.chi2, self.dof))

    def growth(self, temperature_c: Float) -> Float:
        """Return the dark current at temperatures over that at the reference."""
        return np.asarray(np.exp(self.slope_per_c * (temperature_c - self.reference_c)))

    def terms(self, frames: CalibrationFrames) -> tuple[float, float]:
        """Return the seconds of dark current at the reference in a mean frame, and their change with the slope."""
        growth = self.growth(frames.temperature_c)
        seconds = frames.exposure_s * growth
        return float(seconds.mean()), float((seconds * (frames.temperature_c - self.reference_c)).mean())

    def mean_dn(self, frames: CalibrationFrames) -> Float:
        """Return bias and dark of a mean frame, DN, shape (n_pixel,)."""
        return self.bias_dn + self.level_dn_per_s * self.terms(frames)[0]


def assumed_dark(nominal: Instrument, n_pixel: int) -> DarkFit:
    """Return the dark current and bias of an instrument, where there are no frames without light."""
    zero, nothing = np.zeros(n_pixel), np.full(n_pixel, np.nan)
    level = nominal.per_pixel("dark", nominal.dark_dn_per_s)
    return DarkFit(
        reference_c=nominal.temperature_c,
        level_dn_per_s=level,
        level_error=zero,
        bias_dn=nominal.per_pixel("bias_dn", nominal.bias_dn),
        bias_error=zero,
        covariance=np.zeros((n_pixel, 2, 2)),
        shared=np.diag([0.0, (ASSUMED_ERROR * level.mean()) ** 2, 0.0]),
        slope_per_c=nominal.dark_slope_per_c,
        slope_error=0.0,
        pixel_slope_per_c=nothing,
        pixel_slope_error=nothing,
        chi2=np.nan,
        dof=0,
        slopes_p_value=np.nan,
        assumed=("dark current", "dark slope", "bias"),
    )


def fit_dark(dark: Sequence[CalibrationFrames], nominal: Instrument, noise: NoiseModel) -> DarkFit:
    """Fit bias, dark level of each pixel and a common slope to frames without light, by weighted least squares.

    The slope is assumed if the temperatures span less than `SLOPE_RANGE_C`. Each pixel's bias is fitted if exposure
    times differ by `EXPOSURE_RATIO`, and one for all pixels if the temperatures span `BIAS_RANGE_C`; otherwise it is
    the instrument's.

    Parameters
    ----------
    dark : sequence of CalibrationFrames
        At least one.
    noise : NoiseModel
        Its variances are the weights.
    """
    raw = np.concatenate([one.raw_dn for one in dark])
    temperature = np.concatenate([one.temperature_c for one in dark])
    exposure = np.concatenate([np.full(one.n_frames, one.exposure_s) for one in dark])
    n_pixel = raw.shape[1]
    reference, spread = float(temperature.mean()), float(np.ptp(temperature))
    offset = temperature - reference
    fits_slope, by_pixel = spread >= SLOPE_RANGE_C, float(exposure.max() / exposure.min()) >= EXPOSURE_RATIO
    fits_bias = by_pixel or spread >= BIAS_RANGE_C
    bias = nominal.per_pixel("bias_dn", nominal.bias_dn)

    # The mean pixel gives what all pixels share: bias, slope, and their errors.
    series = raw.mean(axis=1)
    start = np.array([bias.mean(), (series - bias.mean()).mean() / exposure.mean(), nominal.dark_slope_per_c])
    typical = noise.variance(0.0, start[1] * exposure * np.exp(start[2] * offset))
    free = np.array([fits_bias, True, fits_slope])

    def left(values: Float) -> Float:
        at = start.copy()
        at[free] = values
        return np.asarray((series - at[0] - at[1] * exposure * np.exp(at[2] * offset)) / np.sqrt(typical / n_pixel))

    found = scipy.optimize.least_squares(left, start[free], x_scale=np.maximum(np.abs(start[free]), 1e-3), xtol=1e-14)
    shared = np.zeros((3, 3))
    jacobian = np.asarray(found.jac)
    shared[np.ix_(free, free)] = np.linalg.inv(jacobian.T @ jacobian)
    common = start.copy()
    common[free] = found.x
    slope = float(common[2])
    if fits_bias and not by_pixel:
        bias = np.full(n_pixel, common[0])

    # With the slope known, each pixel is linear in its level and bias.
    seconds = exposure * np.exp(slope * offset)
    weight = 1.0 / typical
    columns = np.column_stack([np.ones_like(seconds), seconds, seconds * offset])
    own_bias = np.zeros_like(bias) if by_pixel else bias
    used = np.array([0, 1] if by_pixel else [1])
    hat, own = _solved(columns[:, used], weight, raw - own_bias)
    level = own[-1]
    bias = own[0] if by_pixel else bias
    # Variances of the pixels differ from the typical ones of the weights.
    covariance = np.zeros((n_pixel, 2, 2))
    covariance[np.ix_(np.arange(n_pixel), used, used)] = noise.read_variance * hat @ hat.T + noise.dark_factor * level[
        :, None, None
    ] * ((hat * seconds) @ hat.T)
    pixel_slope, pixel_error, slopes = np.full(n_pixel, np.nan), np.full(n_pixel, np.nan), np.nan
    if fits_slope:
        hat, own = _solved(columns[:, [*used, 2]], weight, raw - own_bias)
        pixel_slope = slope + own[-1] / level
        variance = noise.read_variance * hat[-1] @ hat[-1] + noise.dark_factor * level * ((hat[-1] * seconds) @ hat[-1])
        pixel_error = np.sqrt(variance) / np.abs(level)
        slopes = float(scipy.stats.chi2.sf(np.sum(((pixel_slope - slope) / pixel_error) ** 2), n_pixel - 1))
    mean = seconds[:, None] * level
    chi2 = float(np.sum((raw - bias - mean) ** 2 / noise.variance(0.0, mean)))
    dof = raw.size - len(used) * n_pixel - int(fits_slope) - int(fits_bias and not by_pixel)
    assumed = [*(() if fits_slope else ("dark slope",)), *(() if fits_bias else ("bias",))]
    bias_error = np.sqrt(covariance[:, 0, 0]) if by_pixel else np.full(n_pixel, np.sqrt(shared[0, 0]))
    return DarkFit(
        reference_c=reference,
        level_dn_per_s=level,
        level_error=np.sqrt(covariance[:, 1, 1]),
        bias_dn=bias,
        bias_error=bias_error,
        covariance=covariance,
        shared=shared,
        slope_per_c=slope,
        slope_error=float(np.sqrt(shared[2, 2])),
        pixel_slope_per_c=pixel_slope,
        pixel_slope_error=pixel_error,
        chi2=chi2,
        dof=dof,
        slopes_p_value=slopes,
        assumed=tuple(assumed),
    )


def _solved(columns: Float, weight: Float, values: Float) -> tuple[Float, Float]:
    """Return the weights of a least-squares fit, shape (n_column, n_frame), and its solution for each pixel."""
    weighted = columns * weight[:, None]
    hat = np.linalg.solve(weighted.T @ columns, weighted.T)
    return np.asarray(hat), np.asarray(hat @ values)
