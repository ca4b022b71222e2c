"""Smallest change between visits that is detected with a false-alarm probability and a power.

A visit gives an estimate with a normal error, by generalised least squares with its unknowns marginalised over. Visits
are compared by chi-squared about their mean; for two visits this is the two-sided test of their difference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.fits.flare_model import variance_of
from mauvecl.schema.calls import validated
from mauvecl.schema.fields import Range
from mauvecl.schema.physical import Positive, Probability

if TYPE_CHECKING:
    from typing import Annotated

    from mauvecl.detection.nuisances import Nuisances
    from mauvecl.host.exposure.expectation import Expectation

Float = NDArray[np.float64]

#: Share of the information on a change that must be left by what is unknown; less is rounding.
LEAST_KEPT = 1e-10
#: Share of the largest change of a pixel above which a change concerns a pixel.
LEAST_LIGHT = 1e-3


@dataclass(frozen=True)
class Smallest:
    """Smallest detectable changes, in the unit of the error of a visit."""

    one: float  # difference of one visit from all others
    scatter: float  # standard deviation of a star that differs normally in each visit


@validated
def smallest_change(
    error: Positive, visits: Annotated[int, Range(2)], fap: Probability, power: Probability
) -> Smallest:
    """Compute the smallest detectable changes among visits with equal errors.

    Parameters
    ----------
    error : float
        Standard error of a visit.
    visits : int
    fap : float
        False-alarm probability of the test of all visits.
    power : float
        Detection probability.

    Examples
    --------
    >>> from mauvecl.observations.changes.smallest import smallest_change
    >>> round(smallest_change(1.0, 2, 0.05, 0.9).one, 3)
    4.584
    """
    dof = visits - 1
    cut = float(scipy.stats.chi2.isf(fap, dof))
    rest = float(scipy.stats.chi2.isf(power, dof))
    if power <= fap:
        return Smallest(0.0, 0.0)
    # The non-centrality grows the probability from fap to 1.
    high = 1.0
    while scipy.stats.ncx2.sf(cut, dof, high) < power:
        high *= 2.0
    centre = scipy.optimize.brentq(lambda value: scipy.stats.ncx2.sf(cut, dof, value) - power, 1e-12, high, xtol=1e-10)
    return Smallest(float(error * np.sqrt(centre * visits / dof)), float(error * np.sqrt(cut / rest - 1.0)))


def pixels_of(counts_dn: Float, quiet: Expectation) -> tuple[int, int]:
    """Return how many of the pixels that a change of the light concerns are near saturation, and how many these are."""
    concerned = np.abs(counts_dn) > LEAST_LIGHT * np.abs(counts_dn).max(initial=0.0)
    return int((concerned & ~variance_of(quiet)[1]).sum()), int(concerned.sum())


def error_of_change(counts_dn: Float, quiet: Expectation, unknown: Nuisances | None) -> float:
    """Return the standard error of the amplitude of a change in one exposure, from pixels that do not saturate.

    It is infinite if the unknowns hide the change, and NaN if no pixel is left.

    Parameters
    ----------
    counts_dn : ndarray, shape (n_pixel,)
        DN of the exposure for an amplitude of one.
    """
    variance, used = variance_of(quiet)
    lost, concerned = pixels_of(counts_dn, quiet)
    if lost == concerned:
        return float("nan")
    delta = np.where(used, counts_dn, 0.0)
    weights = np.divide(delta, variance, out=np.zeros_like(delta), where=used)
    information = whole = float(weights @ delta)
    if unknown:
        information -= float(np.sum((unknown.rows(variance * used, unknown.spectra * used) @ delta) ** 2))
    return information**-0.5 if information > LEAST_KEPT * whole > 0 else float("inf")


def error_of_index(weights: Float, quiet: Expectation, unknown: Nuisances | None) -> float:
    """Return the standard deviation of a weighted sum of an exposure.

    It is infinite if a free unknown changes the sum, and NaN if a pixel with a weight is near saturation.

    Parameters
    ----------
    weights : ndarray, shape (n_pixel,)
    """
    if (weights[~variance_of(quiet)[1]] != 0.0).any():
        return float("nan")
    variance = float(np.sum(weights**2 * quiet.variance_dn2))
    if unknown:
        moved = unknown.spectra @ weights
        free = np.isinf(unknown.sd)
        if np.any(np.abs(moved[free]) > 0):
            return float("inf")
        variance += float(np.sum((moved[~free] * unknown.sd[~free]) ** 2))
    return float(np.sqrt(variance))
