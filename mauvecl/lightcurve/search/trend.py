"""What a stare's unknowns do to its sums beyond first order, as the sums themselves tell.

A search marginalises over the level of a window to first order: an offset, a slope, cycles. But the dark is exponential
in the temperature, so that a drift bends the level, and a drift of light multiplies that of the star. That part follows
from the amplitudes of the unknowns, and these are measured well where it matters: over the whole stare, each moves the
sums by many standard deviations. They are fitted, and what they do beyond first order is subtracted. An error of one
standard deviation in the level then leaves a share of it as large as the relative change of the dark: some hundredths.

The fit is by Gauss and Newton, with the unknowns' own distribution as prior, of means over half a minute. Those with
flares count less (Huber 1964, doi 10.1214/aoms/1177703732), so that a flare hardly moves the fit.
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
    from mauvecl.lightcurve.usual import Changing

Float = NDArray[np.float64]

#: Time over which the fit takes means, s: the bend within it is left out.
BLOCK_S = 30.0
#: Standard deviations of a mean from which on it counts less.
HUBER = 3.0
#: Steps of the fit: each gains as many digits as the change of the dark is small.
STEPS = 6
#: Standard deviations of an unknown at which its effect is looked at, and S/N of the stare below which it has none.
REACH, LEAST = 4.0, 0.01


@dataclass(frozen=True, eq=False)
class Trend:
    """The unknowns of a stare, and what they do to the sums of its frames.

    Attributes
    ----------
    frames : ndarray of int, shape (n_frame,)
        Their numbers, gaps included.
    frame_s : float
    variance : ndarray, shape (n_frame,)
        Of each frame's sums.
    of : tuple of {"star", "light", "sky", "temperature"}
        What each unknown changes.
    curves : ndarray, shape (n_unknown, n_frame)
        What one standard deviation of each does to every frame.
    star, sky, dark : ndarray, shape (n_frame, n_sum)
        Known means of the components.
    slope_per_c : float
        Relative change of the dark for 1 deg C.
    """

    frames: NDArray[np.int64]
    frame_s: float
    variance: Float
    of: tuple[Changing, ...]
    curves: Float
    star: Float
    sky: Float
    dark: Float
    slope_per_c: float

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
        """Return the trend of a stare's unknowns; None where there are none.

        Parameters
        ----------
        unknowns : sequence of StareUnknown
        directions : mapping of str to ndarray
            As `Survey.directions`: what a small change of each does to the sums of every frame.
        variance, frames, frame_s, slope_per_c
            As the attributes.
        """
        if not unknowns:
            return None
        sky = directions["light"] - directions["star"]
        dark = directions["temperature"] / slope_per_c if slope_per_c else np.zeros_like(sky)
        curves = np.array([one.sd * one.curve for one in unknowns])
        of = tuple(one.of for one in unknowns)
        return cls(frames, frame_s, variance, of, curves, directions["star"], sky, dark, slope_per_c)

    @cached_property
    def far(self) -> Float:
        """Amplitudes that are far out: all together and each alone, with either sign, (n, n_unknown)."""
        rows = np.vstack([np.eye(len(self.of)), np.ones(len(self.of))])
        return np.asarray(REACH * np.vstack([rows, -rows]))

    @cached_property
    def bends(self) -> bool:
        """Whether unknowns do anything to be seen beyond first order."""
        beyond = self.beyond(self.far)
        return bool((np.sum(beyond**2 / self.variance[:, None], axis=(1, 2)) > LEAST**2).any())

    def moved(self, amplitudes: Float) -> Float:
        """Return what unknowns do to the sums, (n_stare, n_frame, n_sum).

        Parameters
        ----------
        amplitudes : ndarray, shape (n_stare, n_unknown)
            In standard deviations.
        """
        return self._moved(self._changes(amplitudes))

    def part(self, part: slice) -> Trend:
        """Return that of some frames."""
        names = ("frames", "variance", "star", "sky", "dark")
        return replace(self, curves=self.curves[:, part], **{name: getattr(self, name)[part] for name in names})

    def subtracted(self, sums: NDArray[Any]) -> NDArray[np.float64]:
        """Return sums less what their unknowns do beyond first order.

        Parameters
        ----------
        sums : ndarray, shape (n_stare, n_frame, n_sum)
            Less what is known of them.
        """
        left = np.array(sums, np.float64)
        # One at a time: sums of products may be rounded otherwise beside others.
        for one in left:
            one -= self.beyond(self.fitted(one[None]))[0]
        return left

    def beyond(self, amplitudes: Float) -> Float:
        """Return what unknowns do but for constant multiples of their curves, (n_stare, n_frame, n_sum).

        Parameters
        ----------
        amplitudes : ndarray, shape (n_stare, n_unknown)
            In standard deviations.
        """
        linear = np.array([self._linear[of] for of in self.of])
        first = np.einsum("nu,ut,uk->ntk", amplitudes, self.curves, linear, optimize=True)
        return np.asarray(self.moved(amplitudes) - first)

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
        """The sums' mean response to each kind of change, shape (n_sum,)."""
        star, sky, dark = (x.mean(axis=0) for x in (self.star, self.sky, self.dark))
        return {"star": star, "light": star + sky, "sky": sky, "temperature": self.slope_per_c * dark}

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
        """Return what changes do to the sums, (n_stare, n_frame, n_sum)."""
        light = changes["light"] + 1
        star, sky = light * (1 + changes["star"]) - 1, light * (1 + changes["sky"]) - 1
        warm = np.expm1(self.slope_per_c * changes["temperature"])
        return np.asarray(star[..., None] * self.star + sky[..., None] * self.sky + warm[..., None] * self.dark)

    def _gradient(self, changes: Mapping[str, Float]) -> Float:
        """Return the derivatives of `_moved` by the amplitudes, (n_stare, n_unknown, n_frame, n_sum)."""
        light, star, sky = (1 + changes[of][..., None] for of in ("light", "star", "sky"))
        warm = np.exp(self.slope_per_c * changes["temperature"])[..., None]
        each = {
            "star": light * self.star,
            "light": star * self.star + sky * self.sky,
            "sky": light * self.sky,
            "temperature": self.slope_per_c * warm * self.dark,
        }
        return np.stack([each[of] * curve[:, None] for of, curve in zip(self.of, self.curves, strict=True)], axis=1)
