"""Interpolated closed forms for pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import special
from scipy.interpolate import PchipInterpolator

from mauvecl.detection.distributions import Gaussian

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mauvecl.detection.distributions import Form


class InterpolatedForm:
    """Closed form that is exact at some points and interpolated in the probit between them."""

    def __init__(self, form: Form) -> None:
        self.mean, self.std = form.mean, form.std
        if isinstance(form, Gaussian):
            self._probit = lambda value: (form.mean - value) / form.std
            self._inverse = lambda probit: form.mean + form.std * probit
            return
        at = np.linspace(form.mean - 5 * form.std, form.mean + 6 * form.std, 14)
        beyond = np.array([form.sf(value) for value in at])
        # Probabilities that round to 0 or 1 have no finite probit.
        kept = (beyond > 1e-12) & (beyond < 1 - 1e-12)
        self._probit = PchipInterpolator(at[kept], special.ndtri(beyond[kept]), extrapolate=True)
        self._inverse = PchipInterpolator(-special.ndtri(beyond[kept]), at[kept], extrapolate=True)

    def sf(self, value: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the probabilities of exceeding values."""
        return np.asarray(special.ndtr(self._probit(value)))

    def isf(self, probability: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values that are exceeded with given probabilities."""
        return np.asarray(self._inverse(-special.ndtri(probability)))
