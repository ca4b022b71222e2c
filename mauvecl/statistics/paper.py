"""The MauveSim paper's comparison as a statistic."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from mauvecl.statistics.distributions import QuadraticForm
from mauvecl.statistics.smoothing import Smoothing
from mauvecl.statistics.statistic import Differences, Float, QuadraticStatistic, Setting, Tilt

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation


class Paper(QuadraticStatistic):
    """Sum of (F - Q)^2 / F of smoothed spectra, where F is an exposure with a flare and Q one without."""

    name = "paper"
    definition: ClassVar[str] = (
        "the MauveSim paper's sum of (F - Q)^2 / F on smoothed spectra in DN/s, Q a noisy exposure, F flaring; a few "
        "faint pixels make most of it (see `effective_terms`)"
    )
    label: ClassVar[str] = "the paper's sum on smoothed spectra"
    shaped: ClassVar[bool] = True
    paired: ClassVar[bool] = True
    marginal: ClassVar[bool] = False

    def smoothing(self, setting: Setting) -> Smoothing:
        """Return the paper's smoothing of the used pixels."""
        return setting.cached("smoothing", lambda: Smoothing.of(setting.quiet, setting.used, setting.flares))

    def scale(self, setting: Setting, flare: Expectation | None) -> Float:
        """Return the factors of the squares of smoothed DN, shape (n_centre,)."""
        assert flare is not None
        return self.smoothing(setting).scale(flare)

    def dof(self, setting: Setting) -> int:
        return int(setting.used.sum())

    def form(self, setting: Setting, seen: Differences, flare: Expectation | None = None) -> QuadraticForm:
        return self.smoothing(setting).form(self.scale(setting, flare), seen.mean, seen.variance)

    def values(self, setting: Setting, x: Float, variance: Float, flare: Expectation | None = None) -> Float:
        return np.asarray((x @ self.smoothing(setting).rows.T) ** 2 @ self.scale(setting, flare))

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> Tilt:
        sd = np.sqrt(self.variance(setting)) * setting.used
        square, modes = self.smoothing(setting).modes(self.scale(setting, flare), sd**2)
        return Tilt(modes * sd / np.sqrt(square)[:, None], square)

    def square_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        return np.asarray(self.scale(setting, flare) @ self.smoothing(setting).rows ** 2)
