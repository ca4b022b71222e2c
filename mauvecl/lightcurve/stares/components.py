"""What each frame of a stare is made of: a few spectra, so that no frame needs an expectation of its own.

Counts are sums of what does not know of each other: the star, the sky, the dark, flares of some temperatures. Whatever
the frame, each has the same spectrum and only another strength, its coefficient; so the mean and every higher cumulant
of a pixel, and of a weighted sum of pixels, is linear in a frame's few coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.lightcurve.stares.stare import Stare

Float = NDArray[np.float64]

#: What every frame holds; flares, one for each temperature, follow.
STEADY = ("star", "sky", "dark")
#: Temperatures of flares, and weighted sums, that one launch follows.
MOST_FLARES, MOST_STATISTICS = 8, 8
#: Fourth cumulant of the rounding error, DN^4; its variance is 1/12.
ROUNDING_FOURTH = -1.0 / 120.0


@dataclass(frozen=True, eq=False)
class Components:
    """The spectra of a stare's frames, and the weights of the sums that are kept of each frame.

    A frame's statistics are y_k = sum_p weights_kp (raw_p - mean_raw_p), with the quiescent star's mean raw counts at
    the expectation's own conditions.

    Attributes
    ----------
    quiet : Expectation
        ONE frame of the quiescent star: what coefficients of one stand for.
    flare_electrons : ndarray, shape (n_flare, n_pixel)
        Mean electrons per frame of flares of one amplitude, each of another temperature; at most `MOST_FLARES`.
    weights : ndarray, shape (n_statistic, n_pixel)
        Zero in pixels that saturate; linearly independent.

    Raises
    ------
    InputError
        For shapes that do not belong together, an exposure of several frames, or weights that cannot be used.
    """

    quiet: Expectation
    flare_electrons: Float
    weights: Float

    def __post_init__(self) -> None:
        n_pixel = self.quiet.wavelength_nm.size
        if self.quiet.n_frames != 1:
            raise InputError(
                f"an exposure of {self.quiet.n_frames} frames",
                "one frame of the stare",
                key="n_frames",
                value=self.quiet.n_frames,
            )
        for name, what, least in (("flare_electrons", "flare spectra", 0), ("weights", "spectral weights", 1)):
            kept = np.array(getattr(self, name), np.float64)
            if kept.ndim != 2 or kept.shape[1] != n_pixel or len(kept) < least:
                raise InputError(f"{what} have the shape {kept.shape}", f"(n, {n_pixel})", key=name, value=kept.shape)
            if not np.isfinite(kept).all():
                raise InputError(
                    f"{what} of pixel {int(np.argmin(np.isfinite(kept).all(axis=0)))} are not finite",
                    "finite numbers",
                    key=name,
                )
            kept.setflags(write=False)
            object.__setattr__(self, name, kept)
        if (self.flare_electrons < 0).any():
            pixel = int(np.argmax((self.flare_electrons < 0).any(axis=0)))
            raise InputError(
                f"a flare takes light from pixel {pixel}",
                "flare spectra of 0 and above",
                key="flare_electrons",
                value=pixel,
            )
        if len(self.flare_electrons) > MOST_FLARES:
            raise InputError(
                f"{len(self.flare_electrons)} flare spectra",
                f"at most {MOST_FLARES}",
                key="flare_electrons",
                value=len(self.flare_electrons),
            )
        unusable = self.quiet.saturated & (self.weights != 0).any(axis=0)
        if unusable.any():
            raise InputError(
                f"pixel {int(np.argmax(unusable))} saturates and has a weight",
                "0 there",
                key="weights",
                value=int(np.argmax(unusable)),
            )

    @classmethod
    def of(cls, quiet: Expectation, flares: Sequence[Expectation], weights: Float) -> Self:
        """From one frame of the quiescent star and of the same star with flares of one amplitude each."""
        more = [flare.source_electrons - quiet.source_electrons for flare in flares]
        return cls(quiet, np.reshape(more, (len(flares), quiet.wavelength_nm.size)), weights)

    @property
    def n_statistics(self) -> int:
        """Sums that are kept of each frame."""
        return len(self.weights)

    @property
    def n_flares(self) -> int:
        """Temperatures."""
        return len(self.flare_electrons)

    @cached_property
    def mean_dn(self) -> Float:
        """Mean of each component at a coefficient of one, DN, shape (3 + n_flare, n_pixel); rows as `STEADY`."""
        x = self.quiet
        light = np.vstack([x.source_electrons, x.sky_electrons, np.zeros_like(x.dark_dn), self.flare_electrons])
        light *= x.gain_dn_per_electron
        light[2] = x.dark_dn
        return light

    def pixel_cumulants(self, order: int) -> tuple[Float, Float]:
        """Cumulants of order 1 to 5 of each pixel's count.

        Returns
        -------
        constant : ndarray, shape (n_pixel,)
            Whatever the coefficients: read noise and rounding.
        each : ndarray, shape (3 + n_flare, n_pixel)
            Of each component at a coefficient of one.
        """
        x = self.quiet
        photon = x.gain_dn_per_electron ** (order - 1)
        if order > 2 and x.photon_noise == "gaussian":
            photon = np.zeros_like(photon)
        each = self.mean_dn * photon
        each[2] = x.dark_step_dn ** (order - 1) * x.dark_dn
        constant = np.zeros_like(photon)
        if order == 2:
            constant += x.read_noise_dn**2 + 1 / 12
        elif order == 4:
            constant += ROUNDING_FOURTH
        return constant, each

    def sum_cumulants(self, order: int) -> tuple[Float, Float]:
        """Joint cumulants of the weighted sums.

        Returns
        -------
        constant : ndarray, shape (n_statistic,) * order
        each : ndarray, shape (3 + n_flare,) + (n_statistic,) * order
        """
        constant, each = self.pixel_cumulants(order)
        rows = np.vstack([constant, each])
        letters = "ijklm"[:order]
        sums = np.einsum(
            ",".join(f"{a}p" for a in letters) + f",cp->c{letters}", *[self.weights] * order, rows, optimize=True
        )
        return sums[0], sums[1:]

    @cached_property
    def _sums(self) -> dict[int, tuple[Float, Float]]:
        return {order: self.sum_cumulants(order) for order in (1, 2, 3, 4)}

    def coefficients(self, stare: Stare, flare: Float | None = None) -> Float:
        """What is known of each frame.

        Parameters
        ----------
        stare : Stare
        flare : ndarray, shape (n_frame, n_flare), optional
            Amplitude of each flare spectrum in each frame.

        Returns
        -------
        ndarray, shape (n_frame, 3 + n_flare)
            Coefficients of star, sky, dark and flares.
        """
        factors = np.zeros((stare.n_frames, len(STEADY) + self.n_flares))
        factors[:, 0], factors[:, 1] = stare.light * stare.star, stare.light * stare.sky
        factors[:, 2] = stare.dark_factor(self.quiet)
        if flare is not None:
            if np.shape(flare) != (stare.n_frames, self.n_flares):
                raise InputError(
                    f"flare coefficients have the shape {np.shape(flare)}",
                    f"{(stare.n_frames, self.n_flares)}",
                    key="flare",
                    value=np.shape(flare),
                )
            factors[:, 3:] = stare.light[:, None] * flare
        return factors

    def means(self, coefficients: Float) -> Float:
        """Mean statistics of frames: (..., 3 + n_flare) to (..., n_statistic)."""
        reference = np.zeros(len(STEADY) + self.n_flares)
        reference[:3] = 1.0
        return np.asarray((coefficients - reference) @ self._sums[1][1])

    def covariance(self, coefficients: Float) -> Float:
        """Covariances of a frame's statistics: (..., 3 + n_flare) to (..., n_statistic, n_statistic)."""
        return self._of(2, coefficients)

    def third(self, coefficients: Float) -> Float:
        """Joint third cumulants: (..., 3 + n_flare) to (..., n_statistic, n_statistic, n_statistic)."""
        return self._of(3, coefficients)

    def fourth(self, coefficients: Float) -> Float:
        """Joint fourth cumulants, as `third` with one axis more."""
        return self._of(4, coefficients)

    def _of(self, order: int, coefficients: Float) -> Float:
        constant, each = self._sums[order]
        return np.asarray(constant + np.tensordot(coefficients, each, 1))

    def directions(self, coefficients: Float) -> dict[str, Float]:
        """What a small change moves the mean statistics by, each shape (..., n_statistic).

        Of one in the star's level, all light, the sky's level (relative to the frame's own), and of 1 deg C.
        """
        mean = self._sums[1][1]
        light = coefficients[..., [0, 1, *range(3, coefficients.shape[-1])]] @ np.delete(mean, 2, axis=0)
        slope = self.quiet.conditions["dark_slope_per_c"]
        return {
            "star": coefficients[..., :1] * mean[0],
            "light": light,
            "sky": coefficients[..., 1:2] * mean[1],
            "temperature": slope * coefficients[..., 2:3] * mean[2],
        }
