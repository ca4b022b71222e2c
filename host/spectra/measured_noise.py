"""Negative fluxes are measured noise: how much of it a pixel's mean takes over, and whether that explains the mean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..response import Line, Order, electrons_per_second

if TYPE_CHECKING:
    from ..expectation import Expectation
    from ..instrument.instrument import Instrument
    from ..stars.source import Source

Float = NDArray[np.float64]

#: A mean may lie so many of its errors below zero: by chance one of 740 independent ones does.
ERRORS = 3.0
#: Points whose scatter tells the noise of one.
WINDOW = 51
#: Means so far below zero, in parts of the largest, are rounding: quadrature leaves -1e-30 where there is no light.
ROUNDING = 1e-12


def point_noise(flux_flam: Float) -> Float:
    """Standard deviation of each point, from the scatter of those around it, shape (n,).

    The median of |2 F_i - F_(i-2) - F_(i+2)| is 1.4826^-1 sqrt(6) of a point's error (Stoehr et al. 2008, ASP
    Conf. Ser. 394, 505); leaving out the neighbours spares what is correlated.
    """
    from scipy.ndimage import median_filter

    if flux_flam.size < 5:
        return np.zeros_like(flux_flam)
    second = np.abs(2 * flux_flam[2:-2] - flux_flam[:-4] - flux_flam[4:])
    scatter = median_filter(np.pad(second, 2, mode="edge"), size=WINDOW, mode="nearest")
    return np.asarray(1.482602 / np.sqrt(6.0) * scatter)


def error_per_second(source: Source, instrument: Instrument, order: Order) -> Float:
    """Standard error of each pixel's mean by the noise of the points, electrons per second, shape (n_pixel,).

    A pixel weighs the points by its response r and their spacing d; its variance, the sum of (r d sigma)^2, is taken
    as mean(r) times the sum of r d (d sigma^2), the mean weighted by r itself: right where the noise changes slowly.
    """
    nm = source.wavelength_nm
    variance = np.gradient(nm) * point_noise(source.flux_flam) ** 2
    mean = Line.of(instrument).mean_density * electrons_per_second(instrument, nm, np.ones_like(nm), order)
    return np.sqrt(mean * electrons_per_second(instrument, nm, variance, order))


def below_zero(
    source: Source, instrument: Instrument, expected: Expectation, electrons: Float, order: Order
) -> tuple[str, ...]:
    """The sentence on pixels whose mean lies below zero, within their error; such means are taken as no light.

    Parameters
    ----------
    source : Source
    instrument : Instrument
    expected : Expectation
        Without them.
    electrons : ndarray, shape (n_pixel,)
        Mean electrons per frame as they come.
    order : {"paper", "physical"}

    Raises
    ------
    InputError
        If a mean lies farther below zero than the spectrum's noise and the exposure's explain.
    """
    below = electrons < -ROUNDING * max(float(electrons.max()), 0.0)
    if not below.any() or not (source.flux_flam < 0.0).any():
        return ()
    own = error_per_second(source, instrument, order) * expected.frame_s
    # The exposure's noise hides what lies below it.
    drawn = np.sqrt(expected.variance_dn2) / (expected.n_frames * expected.gain_dn_per_electron)
    error = np.hypot(own, drawn)
    worst = int(np.argmin(electrons + ERRORS * error))
    nm = expected.wavelength_nm
    if electrons[worst] < -ERRORS * error[worst]:
        raise InputError(
            f"the spectrum of {source.name} makes a mean of {electrons[worst]:.3g} electrons a frame at "
            f"{nm[worst]:.1f} nm, beyond {ERRORS:g} times its error of {error[worst]:.2g}, expected light: bin the "
            "spectrum (--bin-nm) or mend it"
        )
    return (
        f"{source.name}: the means of {int(below.sum())} of {below.size} pixels, from {nm[below][0]:.1f} to "
        f"{nm[below][-1]:.1f} nm, lie below zero, within their error (measured noise of the spectrum), and are "
        "taken as no light.",
    )
