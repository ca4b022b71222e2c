"""Weighted sums: matched filter, ultraviolet excess and user-defined statistics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.content_equality import ContentEquality
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.statistics.statistic import Float, LinearStatistic, Setting

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

#: Range of `uv_excess`, nm.
UV_NM = (200.0, 360.0)


class Matched(LinearStatistic):
    """Matched filter with weights delta / v / sqrt(lambda), where delta is the flare and lambda = sum delta^2 / v.

    The statistic has unit variance without a flare and mean sqrt(lambda) with it. The variance v of the difference
    includes that of the subtracted reference.
    """

    name = "matched"
    definition: ClassVar[str] = "weighted sum with the flare's own shape as template, in standard deviations"
    label: ClassVar[str] = "matched filter (standard deviations)"
    shaped: ClassVar[bool] = True

    def plain_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        assert flare is not None
        delta = np.where(setting.used, flare.recorded_light_dn - setting.quiet.recorded_light_dn, 0.0)
        variance = self.variance(setting)
        strength = float(np.sqrt(np.sum(delta**2 / variance)))
        return np.asarray(delta / variance / (strength or 1.0))


class UvExcess(LinearStatistic):
    """Net counts in the ultraviolet divided by the noise of their sum."""

    name = "uv_excess"
    definition: ClassVar[str] = f"net counts from {UV_NM[0]:g} to {UV_NM[1]:g} nm, in standard deviations"
    label: ClassVar[str] = "UV excess (standard deviations)"

    def check(self, setting: Setting) -> None:
        super().check(setting)
        if not self._inside(setting).any():
            raise InputError(
                f"{setting.quiet.name} has no used pixel at {UV_NM[0]:g}-{UV_NM[1]:g} nm",
                "used pixels there for the statistic 'uv_excess'",
                key="statistic",
                value="uv_excess",
            )

    def plain_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        inside = self._inside(setting)
        return np.asarray(inside / (np.sqrt(np.sum(self.variance(setting)[inside])) or 1.0))

    def _inside(self, setting: Setting) -> NDArray[np.bool_]:
        wavelength = setting.quiet.wavelength_nm
        return np.asarray(setting.used & (wavelength >= UV_NM[0]) & (wavelength <= UV_NM[1]))


@validated
@dataclass(frozen=True, eq=False)
class Linear(ContentEquality, LinearStatistic):
    """A user-defined statistic: the sum over pixels of weight times (observed - reference), DN of the exposure.

    Attributes
    ----------
    name : str
    weights : ndarray, shape (n_pixel,)
        Weights per DN; pixels that saturate in the reference are not used.
    """

    name: str
    weights: NDArray[np.float64]

    definition: ClassVar[str] = "user-defined weighted sum"
    label: ClassVar[str] = ""
    normalised: ClassVar[bool] = False

    def __post_init__(self) -> None:
        weights = np.array(self.weights, np.float64)
        object.__setattr__(self, "weights", weights)
        if weights.ndim != 1 or not np.isfinite(weights).all() or not weights.any():
            bad = int((~np.isfinite(weights)).sum())
            raise InputError(
                f"statistic {self.name!r} has weights of the shape {weights.shape}, {bad} of them not finite",
                "one finite value per pixel, not all zero",
                key="weights",
                value=weights.shape,
            )

    def check(self, setting: Setting) -> None:
        super().check(setting)
        if self.weights.size != setting.used.size:
            raise InputError(
                f"statistic {self.name!r} has {self.weights.size} weights",
                f"one for each of the {setting.used.size} pixels",
                key="weights",
                value=self.weights.size,
            )
        if not (self.weights * setting.used).any():
            raise InputError(
                f"statistic {self.name!r} weights only saturated pixels", "weights of other pixels", key="weights"
            )

    def plain_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        return np.asarray(self.weights * setting.used)
