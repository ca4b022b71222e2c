"""Negative fluxes are measured noise: how much of it a pixel's mean takes over, and whether that explains the mean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .instrument.line import Line
from .response import Order, electrons_per_second
from .spectra.scatter import point_noise

if TYPE_CHECKING:
    from .instrument.instrument import Instrument
    from .stars.source import Source

Float = NDArray[np.float64]

#: A mean may lie so many of its errors below zero: by chance one of 740 independent ones does.
ERRORS = 3.0
#: Means so far below zero, in parts of the largest, are rounding: quadrature leaves -1e-30 where there is no light.
ROUNDING = 1e-12


def error_per_second(source: Source, instrument: Instrument, order: Order) -> Float:
    """Standard error of each pixel's mean by the noise of the points, electrons per second, shape (n_pixel,).

    A pixel weighs the points by its response r and their spacing d; its variance, the sum of (r d sigma)^2, is taken
    as mean(r) times the sum of r d (d sigma^2), the mean weighted by r itself: right where the noise changes slowly.
    """
    nm = source.wavelength_nm
    variance = np.gradient(nm) * point_noise(source.flux_flam) ** 2
    mean = Line.of(instrument).mean_density * electrons_per_second(instrument, nm, np.ones_like(nm), order)
    return np.sqrt(mean * electrons_per_second(instrument, nm, variance, order))


def below_zero(source: Source, instrument: Instrument, electrons: Float, drawn: Float, order: Order) -> tuple[str, ...]:
    """The sentence on pixels whose mean lies below zero, within their error; such means are taken as no light.

    Parameters
    ----------
    source : Source
    instrument : Instrument
    electrons, drawn : ndarray, shape (n_pixel,)
        Mean electrons per frame as they come, and the exposure's own noise on them.
    order : {"paper", "physical"}

    Raises
    ------
    InputError
        If a mean lies farther below zero than the spectrum's noise and the exposure's explain.
    """
    below = electrons < -ROUNDING * max(float(electrons.max()), 0.0)
    if not below.any() or not (source.flux_flam < 0.0).any():
        return ()
    own = error_per_second(source, instrument, order) * instrument.frame_s
    # The exposure's noise hides what lies below it.
    error = np.hypot(own, drawn)
    worst = int(np.argmin(electrons + ERRORS * error))
    nm = instrument.wavelength_nm
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
