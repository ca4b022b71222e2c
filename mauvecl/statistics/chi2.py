"""Chi-squared over pixels, over resolution elements, and against one noisy exposure."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from mauvecl.statistics.distributions import QuadraticForm
from mauvecl.statistics.statistic import Float, QuadraticStatistic, Setting, Tilt

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation


class Chi2(QuadraticStatistic):
    """Sum over pixels of the squared difference over its variance."""

    name = "chi2"
    definition: ClassVar[str] = "sum over pixels of (observed - template)^2 / variance"
    label: ClassVar[str] = "chi2 over pixels"
    kernel_sum: ClassVar[str | None] = "chi2"

    def dof(self, setting: Setting) -> int:
        return int(setting.used.sum())

    def form(
        self, setting: Setting, delta: Float, true: Float, flare: Expectation | None = None, *, estimated: bool = False
    ) -> QuadraticForm:
        true = true * setting.used
        model = true if estimated else self.variance(setting) * setting.used
        delta, model, true = (self._grouped(setting, values) for values in (delta, model, true))
        counts = (model > 0) & (true > 0)
        delta, model, true = delta[counts], model[counts], true[counts]
        return QuadraticForm(true / model, delta / np.sqrt(true))

    def values(self, setting: Setting, x: Float, variance: Float, flare: Expectation | None = None) -> Float:
        x, variance = (self._grouped(setting, values * setting.used) for values in (x, variance))
        return np.asarray(np.sum(np.divide(x**2, variance, out=np.zeros_like(x), where=variance > 0), axis=-1))

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> Tilt:
        from scipy.sparse import eye_array

        directions = eye_array(setting.used.size, format="csr")[setting.used]
        return Tilt(directions, np.ones(directions.shape[0]))

    def own(self, setting: Setting, flare: Expectation | None = None) -> Float:
        return np.asarray(setting.used / self.variance(setting))

    def _grouped(self, setting: Setting, values: Float) -> Float:
        """What is squared, from values per pixel along the last axis."""
        return values


class Chi2Element(Chi2):
    """The same over sums of resolution elements."""

    name = "chi2_element"
    definition: ClassVar[str] = "the same over sums of 10.5 nm resolution elements"
    label: ClassVar[str] = "chi2 over 10.5 nm elements"
    kernel_sum: ClassVar[str | None] = "chi2_element"

    def dof(self, setting: Setting) -> int:
        return int(np.unique(setting.quiet.element[setting.used]).size)

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> Tilt:
        element = setting.quiet.element
        member = element[None, :] == np.unique(element[setting.used])[:, None]
        directions = member * np.sqrt(self.variance(setting)) * setting.used
        return Tilt(directions / np.linalg.norm(directions, axis=1)[:, None], np.ones(len(directions)))

    def own(self, setting: Setting, flare: Expectation | None = None) -> Float:
        element = setting.quiet.element
        summed = self._grouped(setting, self.variance(setting) * setting.used)[
            np.unique(element, return_inverse=True)[1]
        ]
        return np.asarray(np.divide(setting.used, summed, out=np.zeros_like(summed), where=summed > 0))

    def _grouped(self, setting: Setting, values: Float) -> Float:
        starts = np.flatnonzero(np.append(True, np.diff(setting.quiet.element) > 0))
        return np.asarray(np.add.reduceat(values, starts, axis=-1))


class Chi2Pair(Chi2):
    """Chi-squared over pixels of the difference of two exposures."""

    name = "chi2_pair"
    definition: ClassVar[str] = "against a noisy quiescent exposure: twice the variance"
    label: ClassVar[str] = "chi2 against a noisy exposure"
    kernel_sum: ClassVar[str | None] = "chi2_pair"
    paired: ClassVar[bool] = True
