"""Gain and read noise by photon transfer: variance of frames against their mean (Janesick 2007, Photon Transfer)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.instrument.instrument import Instrument

Float = NDArray[np.float64]

#: Variance of rounding to whole DN.
ROUNDING = 1.0 / 12.0
#: Iterations of the weights, which follow the fitted variances.
ITERATIONS = 20
#: Difference of chi-squared above which the unit of the dark counts is determined (5 %).
TELLS = 3.84
#: Smallest S/N of the gain with which it is reported.
MIN_SNR = 5.0
#: Relative error of a gain that is not measured: the root mean square deviation of 20 to 25 uV per electron, the values
#: that are quoted of the detector, from the nominal 20.
ASSUMED_ERROR = 0.14


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
class MeasuredVariance:
    """Variance of the frames of one observation, for each usable pixel."""

    # variance, light_dn, dark_dn: shape (n_pixel,); of a frame.
    variance: Float
    light_dn: Float
    dark_dn: Float
    dof: float  # degrees of freedom of each variance


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """Fit of measured variances."""

    noise: NoiseModel
    # Shape (2, 2); of read variance and gain, for known dark counts; from `ASSUMED_ERROR` if the gain is assumed.
    covariance: Float
    read_noise_error: float  # standard error, DN, with that of the dark counts
    dark_unit: Literal["DN", "electrons"]
    dark_unit_chi2: float  # chi-squared with dark counts in DN, less that with electrons
    chi2: float
    dof: int
    # mean_dn, variance, model: shape (n_value,); all means of light, measured and fitted variances.
    mean_dn: Float
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

    @property
    def p_value(self) -> float:
        """Probability of a chi-squared at least as large."""
        return float(scipy.stats.chi2.sf(self.chi2, self.dof))


def measured_variance(raw_dn: Float, light_dn: Float, dark_dn: Float, usable: NDArray[np.bool_]) -> MeasuredVariance:
    """Measure the variance of frames from differences of consecutive ones, without drifts.

    From each difference the best multiples of light and dark are subtracted, since jitter of the pointing and of the
    temperature change all pixels together.

    Parameters
    ----------
    raw_dn : ndarray, shape (n_frame, n_pixel)
    light_dn, dark_dn : ndarray, shape (n_pixel,)
        Mean of a frame.
    usable : ndarray of bool, shape (n_pixel,)
    """
    # A pixel that never changes is dead.
    usable = usable & np.any(raw_dn != raw_dn[0], axis=0)
    steps = np.diff(raw_dn[:, usable], axis=0)
    light, dark = light_dn[usable], dark_dn[usable]
    scale = np.sqrt(np.mean(steps**2, axis=0))
    shared = np.column_stack([part for part in (light, dark) if part.any()]) / scale[:, None]
    basis, _ = np.linalg.qr(shared)
    white = steps / scale
    white = white - (white @ basis) @ basis.T
    kept = 1.0 - np.sum(basis**2, axis=1)
    n = len(steps)
    # The mean square of consecutive differences of normal values has this many degrees of freedom (von Neumann 1941).
    return MeasuredVariance(np.mean(white**2, axis=0) / kept * scale**2 / 2, light, dark, 2 * n**2 / (3 * n - 1))


def fit_photon_transfer(
    measured: Sequence[MeasuredVariance], nominal: Instrument, dark_error_dn: float = 0.0
) -> PhotonTransfer:
    """Fit gain, read noise and the unit of dark counts to measured variances, by iterated weighted least squares.

    Parameters
    ----------
    measured : sequence of MeasuredVariance
        At least one.
    nominal : Instrument
        Instrument whose values are kept where the data determine none.
    dark_error_dn : float
        Standard error of the dark of a mean frame, which moves the read noise.
    """
    variance, light, dark = (
        np.concatenate([getattr(one, key) for one in measured]) for key in ("variance", "light_dn", "dark_dn")
    )
    dof = np.concatenate([np.full(one.variance.size, one.dof) for one in measured])
    fits = {}
    for name, column in (("DN", light), ("electrons", light + dark)):
        fixed = dark if name == "DN" else np.zeros_like(dark)
        fits[name] = _fit(column, fixed, variance, dof)
    better = fits["DN"][2] - fits["electrons"][2]
    assumed: list[str] = []
    unit: Literal["DN", "electrons"] = nominal.dark_unit
    if abs(better) > TELLS:
        unit = "electrons" if better > 0 else "DN"
    else:
        assumed.append("unit of the dark counts")
    (read, gain), covariance, chi2, model = fits[unit]
    errors = np.sqrt(np.diag(covariance))
    if not gain > MIN_SNR * errors[1]:
        before, unknown = NoiseModel.nominal(nominal), ("gain", "read noise", "unit of the dark counts")
        model, assumed_error = before.variance(light, dark), np.diag([0.0, (ASSUMED_ERROR * before.gain) ** 2])
        return PhotonTransfer(before, assumed_error, 0.0, nominal.dark_unit, better, np.nan, 0, light, variance, model,
                              unknown)  # fmt: skip
    read = max(float(read), ROUNDING)
    noise = NoiseModel(read, float(gain) if unit == "electrons" else 1.0, float(gain))
    read_error = np.hypot(errors[0], noise.dark_factor * dark_error_dn) / (2 * np.sqrt(max(read - ROUNDING, errors[0])))
    return PhotonTransfer(noise, covariance, float(read_error), unit, float(better), float(chi2),
                          variance.size - 2, light, variance, model, tuple(assumed))  # fmt: skip


def _fit(column: Float, fixed: Float, variance: Float, dof: Float) -> tuple[Float, Float, float, Float]:
    """Fit variance = fixed + read + gain * column; return the values, covariance, chi-squared and the model."""
    design = np.column_stack([np.ones_like(column), column])
    model = np.maximum(variance, 1.0)
    found, covariance = np.zeros(2), np.eye(2)
    for _ in range(ITERATIONS):
        weight = dof / (2 * model**2)
        weighted = design * weight[:, None]
        covariance = np.linalg.pinv(weighted.T @ design)
        found = covariance @ (weighted.T @ (variance - fixed))
        model = np.maximum(fixed + design @ found, ROUNDING)
    # The cube roots of chi-squared variables are nearly normal (Wilson & Hilferty 1931).
    spread = 2 / (9 * dof)
    normal = (np.cbrt(variance / model) - (1 - spread)) / np.sqrt(spread)
    return found, covariance, float(np.sum(normal**2)), model
