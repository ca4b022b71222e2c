"""The tables by which the device draws from priors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise import layout
from mauvecl.noise.priors import Prior

Float = NDArray[np.float64]


def nodes() -> Float:
    """Probabilities between an end of a prior and its median, those of the device's table.

    Returns
    -------
    ndarray, shape (layout.PRIOR_NODES,)
        Octaves from 2**-56 to 1/2, each cut into 2**PRIOR_BITS cells; the last once more, for a word that float32
        rounds up.
    """
    cells = 2**layout.PRIOR_BITS
    number = np.arange(layout.PRIOR_NODES - 1)
    probability = np.ldexp(1.0 + (number % cells) / cells, number // cells - layout.PRIOR_FINEST)
    return np.append(probability, probability[-1])


def table_of(prior: Prior, change: Callable[[Float], Float]) -> tuple[NDArray[np.float32], float]:
    """What the device draws of a prior: its values from both ends to the median.

    Parameters
    ----------
    prior : Prior
    change : callable
        From the prior's values to a factor on light or dark, less one.

    Returns
    -------
    table : ndarray of float32, shape (2 * PRIOR_NODES,)
        Factors at `nodes` from the low end, then from the high end, over the factor at the median, less one: float32
        resolves the spread of a prior however narrow, and however far from one.
    centre : float
        The factor at the median, less one.
    """
    tail = nodes()
    values = change(np.append(prior.quantile(tail, 1.0 - tail), prior.quantile(1.0 - tail, tail)))
    centre = float(change(prior.quantile(np.array([0.5])))[0])
    return ((values - centre) / (1.0 + centre)).astype(np.float32), centre
