"""Closed forms looked up quickly, for pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import special
from scipy.interpolate import PchipInterpolator

from mauvecl.statistics.distributions import Gaussian

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mauvecl.statistics.distributions import Form


class Smooth:
    """A closed form looked up quickly: exact at some points, smooth in the probit between them, for pictures.

    Parameters
    ----------
    form : Form
    """

    def __init__(self, form: Form) -> None:
        self.mean, self.std = form.mean, form.std
        if isinstance(form, Gaussian):
            self._probit = lambda value: (form.mean - value) / form.std
            self._inverse = lambda probit: form.mean + form.std * probit
            return
        at = np.linspace(form.mean - 5 * form.std, form.mean + 6 * form.std, 14)
        beyond = np.array([form.sf(value) for value in at])
        # Where it is 0 or 1 to the last digit there is nothing to draw.
        kept = (beyond > 1e-12) & (beyond < 1 - 1e-12)
        self._probit = PchipInterpolator(at[kept], special.ndtri(beyond[kept]), extrapolate=True)
        self._inverse = PchipInterpolator(-special.ndtri(beyond[kept]), at[kept], extrapolate=True)

    def sf(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """Probabilities of exceeding values."""
        return np.asarray(special.ndtr(self._probit(value)))

    def isf(self, probability: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values exceeded with probabilities."""
        return np.asarray(self._inverse(-special.ndtri(probability)))
