"""Estimate of the noise of a measured spectrum from its scatter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

#: Number of neighbouring points from whose scatter the noise of a point is estimated.
WINDOW = 51


def point_noise(flux_flam: Float) -> Float:
    """Return the standard deviation of each point from the scatter around it, shape (n,).

    The median of |2 F_i - F_(i-2) - F_(i+2)| is 1.4826^-1 sqrt(6) of a point's error (Stoehr et al. 2008, ASP
    Conf. Ser. 394, 505). Adjacent points are not used, since their errors are correlated.
    """
    from scipy.ndimage import median_filter

    if flux_flam.size < 5:
        return np.zeros_like(flux_flam)
    second = np.abs(2 * flux_flam[2:-2] - flux_flam[:-4] - flux_flam[4:])
    scatter = median_filter(np.pad(second, 2, mode="edge"), size=WINDOW, mode="nearest")
    return np.asarray(1.482602 / np.sqrt(6.0) * scatter)
