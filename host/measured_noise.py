"""Propagation of a measured spectrum's noise to pixel means, and the check of negative means against it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError

from .instrument.line_spread import LineSpread
from .response import Order, electrons_per_second
from .spectra.point_noise import point_noise

if TYPE_CHECKING:
    from .instrument.instrument import Instrument
    from .stars.source import Source

Float = NDArray[np.float64]

#: Accepted distance of a mean below zero, in standard errors; noise exceeds it in one of 740 independent pixels.
MAX_SIGMA_BELOW_ZERO = 3.0
#: Negative means up to this fraction of the largest mean are rounding errors of the quadrature.
ROUNDING = 1e-12


def standard_error_per_second(source: Source, instrument: Instrument, order: Order) -> Float:
    """Return the standard error of each pixel's mean due to the noise of the points, electrons/s, shape (n_pixel,).

    A pixel weights the points by its response r and their spacing d. Its variance, the sum of (r d sigma)^2, is
    approximated by mean(r) times the sum of r d (d sigma^2), where the mean is weighted by r. The approximation holds
    where the noise changes slowly.
    """
    nm = source.wavelength_nm
    variance = np.gradient(nm) * point_noise(source.flux_flam) ** 2
    mean = LineSpread.of(instrument).mean_density * electrons_per_second(instrument, nm, np.ones_like(nm), order)
    return np.sqrt(mean * electrons_per_second(instrument, nm, variance, order))


def negative_means_message(
    source: Source, instrument: Instrument, electrons: Float, drawn: Float, order: Order
) -> tuple[str, ...]:
    """Return the message on pixels with a negative mean, which counts as no light.

    `electrons` and `drawn`, shape (n_pixel,), are the mean electrons per frame and their standard deviation in the
    exposure. Raises InputError if a mean is more negative than the noise of spectrum and exposure explains.
    """
    below = electrons < -ROUNDING * max(float(electrons.max()), 0.0)
    if not below.any() or not (source.flux_flam < 0.0).any():
        return ()
    own = standard_error_per_second(source, instrument, order) * instrument.frame_s
    # A negative mean below the exposure's noise does not matter.
    error = np.hypot(own, drawn)
    worst = int(np.argmin(electrons + MAX_SIGMA_BELOW_ZERO * error))
    nm = instrument.wavelength_nm
    if electrons[worst] < -MAX_SIGMA_BELOW_ZERO * error[worst]:
        raise InputError(
            f"the spectrum of {source.name} gives a mean of {electrons[worst]:.3g} electrons per frame at "
            f"{nm[worst]:.1f} nm, beyond {MAX_SIGMA_BELOW_ZERO:g} times its error of {error[worst]:.2g}",
            "non-negative light: bin the spectrum (`bin_nm`) or correct it",
            key="bin_nm",
            value=source.name,
        )
    return (
        f"{source.name}: the means of {int(below.sum())} of {below.size} pixels, from {nm[below][0]:.1f} to "
        f"{nm[below][-1]:.1f} nm, lie below zero, within their error (measured noise of the spectrum), and are "
        "taken as no light.",
    )
