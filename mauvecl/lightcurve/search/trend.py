"""Non-linear trends in the sums of a stare, fitted to the sums and subtracted.

A search marginalises over the baseline of a window to first order: offset, slope and cycles. But dark current is
exponential in temperature, so that a temperature drift is curved, and drifts of light and star multiply. This part
follows from the amplitudes of the unknowns, which are well measured if they matter: over a whole stare, each changes
the sums by many standard deviations. The amplitudes are fitted, and their effect beyond first order is subtracted. An
error of one standard deviation in the baseline then leaves a few per cent of it, the relative change of the dark
current.

The fit uses the Gauss-Newton method on means over half a minute, with the distribution of the unknowns as prior. Means
with flares have less weight (Huber 1964, doi 10.1214/aoms/1177703732), so that flares hardly affect the fit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from mauvecl.lightcurve.stares.stare import StareUnknown
    from mauvecl.noise.unknowns import Changing

Float = NDArray[np.float64]

#: Averaging time of the fit, s; the curvature within it is neglected.
BLOCK_S = 30.0
#: Residual in standard deviations above which a mean has less weight.
HUBER = 3.0
#: Number of Gauss-Newton steps.
STEPS = 6
#: Standard deviations of an unknown at which its effect is evaluated, and smallest significant S/N of the effect.
REACH, LEAST = 4.0, 0.01


@dataclass(frozen=True, eq=False)
class Trend:
    """Effect of a stare's unknowns on the sums of its frames."""

    frames: NDArray[np.int64]  # frame numbers including gaps, shape (n_frame,)
    frame_s: float
    variance: Float  # of each frame's sums, shape (n_frame,)
    of: tuple[Changing, ...]  # quantity that each unknown changes
    curves: Float  # change per standard deviation of each unknown, shape (n_unknown, n_frame)
    star: Float  # known mean, shape (n_frame, n_sum)
    sky: Float  # known mean, shape (n_frame, n_sum)
    neighbours: Float  # known mean, shape (n_frame, n_sum)
    dark: Float  # known mean, shape (n_frame, n_sum)
    slope_per_c: float  # relative change of the dark current per deg C

    @classmethod
    def of_unknowns(
        cls,
        unknowns: Sequence[StareUnknown],
        directions: Mapping[Changing, Float],
        variance: Float,
        frames: NDArray[np.int64],
        frame_s: float,
        slope_per_c: float,
    ) -> Trend | None:
        """Return the trend of a stare's unknowns, or None without unknowns; for `directions`, see `Survey`."""
        if not unknowns:
            return None
        star, sky = directions["star"], directions["sky"]
        neighbours = directions["light"] - star - sky
        dark = directions["temperature"] / slope_per_c if slope_per_c else np.zeros_like(sky)
        curves = np.array([one.sd * one.curve for one in unknowns])
        of = tuple(one.of for one in unknowns)
        return cls(frames, frame_s, variance, of, curves, star, sky, neighbours, dark, slope_per_c)

    @cached_property
    def extremes(self) -> Float:
        """Amplitudes of `REACH` standard deviations, together and each alone, with both signs, (n, n_unknown)."""
        rows = np.vstack([np.eye(len(self.of)), np.ones(len(self.of))])
        return np.asarray(REACH * np.vstack([rows, -rows]))

    @cached_property
    def is_nonlinear(self) -> bool:
        """True if the effect of unknowns beyond first order is significant."""
        nonlinear = self.nonlinear_effect(self.extremes)
        return bool((np.sum(nonlinear**2 / self.variance[:, None], axis=(1, 2)) > LEAST**2).any())

    def effect(self, amplitudes: Float) -> Float:
        """Return the effect of unknowns on the sums, (n_stare, n_frame, n_sum).

        Parameters
        ----------
        amplitudes : ndarray, shape (n_stare, n_unknown)
            In standard deviations.
        """
        return self._moved(self._changes(amplitudes))

    def part(self, part: slice) -> Trend:
        """Return the trend of some frames."""
        names = ("frames", "variance", "star", "sky", "neighbours", "dark")
        return replace(self, curves=self.curves[:, part], **{name: getattr(self, name)[part] for name in names})

    def subtracted(self, sums: NDArray[Any]) -> NDArray[np.float64]:
        """Fit the unknowns to sums and subtract their effect beyond first order.

        Parameters
        ----------
        sums : ndarray, shape (n_stare, n_frame, n_sum)
            Sums less their known mean.
        """
        left = np.array(sums, np.float64)
        # One stare at a time, since the rounding of matrix products may depend on the number of stares.
        for one in left:
            one -= self.nonlinear_effect(self.fitted(one[None]))[0]
        return left

    def nonlinear_effect(self, amplitudes: Float) -> Float:
        """Return the effect of unknowns less its linear part, (n_stare, n_frame, n_sum).

        Parameters
        ----------
        amplitudes : ndarray, shape (n_stare, n_unknown)
            In standard deviations.
        """
        linear = np.array([self._linear[of] for of in self.of])
        first = np.einsum("nu,ut,uk->ntk", amplitudes, self.curves, linear, optimize=True)
        return np.asarray(self.effect(amplitudes) - first)

    def fitted(self, sums: Float) -> Float:
        """Return the most likely amplitudes, shape (n_stare, n_unknown), in standard deviations."""
        blocks, weight, means = self._blocks
        y = np.add.reduceat(sums / self.variance[:, None], blocks, axis=1) / weight[:, None]
        n, n_unknown = len(y), len(self.of)
        amplitudes = np.zeros((n, n_unknown))
        for _ in range(STEPS):
            changes = means._changes(amplitudes)
            left = y - means._moved(changes)
            size = np.sqrt(np.sum(left**2, axis=2) * weight)
            trusted = weight * np.minimum(1.0, HUBER / np.maximum(size, 1e-300))
            gradient = means._gradient(changes)
            weighted = gradient * trusted[:, None, :, None]
            information = np.einsum("nutk,nvtk->nuv", weighted, gradient, optimize=True) + np.eye(n_unknown)
            pull = np.einsum("nutk,ntk->nu", weighted, left, optimize=True) - amplitudes
            amplitudes = amplitudes + np.linalg.solve(information, pull[:, :, None])[:, :, 0]
        return amplitudes

    @cached_property
    def _linear(self) -> dict[str, Float]:
        """Mean response of the sums to each kind of change, shape (n_sum,)."""
        star, sky, near, dark = (x.mean(axis=0) for x in (self.star, self.sky, self.neighbours, self.dark))
        return {"star": star, "light": star + sky + near, "sky": sky, "temperature": self.slope_per_c * dark}

    @cached_property
    def _blocks(self) -> tuple[NDArray[np.int64], Float, Trend]:
        """The first frame of each block, its weight, and the trend of the blocks' means."""
        number = self.frames // max(1, round(BLOCK_S / self.frame_s))
        first = np.flatnonzero(np.diff(number, prepend=-1))
        weight = np.add.reduceat(1.0 / self.variance, first)

        def mean(values: Float, axis: int = 0) -> Float:
            over = self.variance if axis else self.variance[:, None]
            return np.asarray(np.add.reduceat(values / over, first, axis=axis) / (weight if axis else weight[:, None]))

        means = replace(
            self,
            frames=number[first],
            variance=1.0 / weight,
            curves=mean(self.curves, 1),
            star=mean(self.star),
            sky=mean(self.sky),
            neighbours=mean(self.neighbours),
            dark=mean(self.dark),
        )
        return first, weight, means

    def _changes(self, amplitudes: Float) -> dict[str, Float]:
        """Return the relative changes of star, light and sky, and that of the temperature, (n_stare, n_frame)."""
        changes: dict[str, Float] = {}
        for of in ("star", "light", "sky", "temperature"):
            these = [k for k, name in enumerate(self.of) if name == of]
            changes[of] = amplitudes[:, these] @ self.curves[these]
        return changes

    def _moved(self, changes: Mapping[str, Float]) -> Float:
        """Return the effect of changes on the sums, (n_stare, n_frame, n_sum)."""
        light = changes["light"] + 1
        star, sky = light * (1 + changes["star"]) - 1, light * (1 + changes["sky"]) - 1
        warm = np.expm1(self.slope_per_c * changes["temperature"])
        lit = star[..., None] * self.star + sky[..., None] * self.sky + changes["light"][..., None] * self.neighbours
        return np.asarray(lit + warm[..., None] * self.dark)

    def _gradient(self, changes: Mapping[str, Float]) -> Float:
        """Return the derivatives of `_moved` by the amplitudes, (n_stare, n_unknown, n_frame, n_sum)."""
        light, star, sky = (1 + changes[of][..., None] for of in ("light", "star", "sky"))
        warm = np.exp(self.slope_per_c * changes["temperature"])[..., None]
        each = {
            "star": light * self.star,
            "light": star * self.star + sky * self.sky + self.neighbours,
            "sky": light * self.sky,
            "temperature": self.slope_per_c * warm * self.dark,
        }
        return np.stack([each[of] * curve[:, None] for of, curve in zip(self.of, self.curves, strict=True)], axis=1)
