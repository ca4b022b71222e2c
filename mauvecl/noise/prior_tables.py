"""Quantile tables with which the device draws from priors."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise import layout
from mauvecl.noise.priors import Prior

Float = NDArray[np.float64]


@cache
def nodes() -> Float:
    """Return the probabilities of the table's nodes from an end of a prior to its median.

    Returns
    -------
    ndarray, shape (layout.PRIOR_NODES,)
        Octaves from 2**-56 to 1/2 with 2**PRIOR_BITS cells each; the last node is repeated for words that float32
        rounds up.
    """
    cells = 2**layout.PRIOR_BITS
    number = np.arange(layout.PRIOR_NODES - 1)
    probability = np.ldexp(1.0 + (number % cells) / cells, number // cells - layout.PRIOR_FINEST)
    probability = np.append(probability, probability[-1])
    probability.flags.writeable = False
    return probability


@lru_cache(32)
def _quantiles(prior: Prior) -> tuple[Float, Float]:
    """Return a prior's values at the nodes from the low end, then from the high end, and its median."""
    tail = nodes()
    values = np.append(prior.quantile(tail, 1.0 - tail), prior.quantile(1.0 - tail, tail))
    values.flags.writeable = False
    return values, prior.quantile(np.array([0.5]))


def table_of(prior: Prior, change: Callable[[Float], Float]) -> tuple[NDArray[np.float32], float]:
    """Compute the quantile table of a prior.

    Parameters
    ----------
    change : callable
        Function that converts the prior's values to a factor minus one.

    Returns
    -------
    table : ndarray of float32, shape (2 * PRIOR_NODES,)
        Factors at `nodes` from the low end, then from the high end, divided by the factor at the median, minus one.
        In this form float32 resolves priors of any width and location.
    centre : float
        Factor at the median, minus one.
    """
    at_nodes, median = _quantiles(prior)
    values, centre = change(at_nodes), float(change(median)[0])
    return ((values - centre) / (1.0 + centre)).astype(np.float32), centre
