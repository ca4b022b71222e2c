"""Tail probabilities of weighted sums of squared normals to full precision, by a contour integral.

The probability is the Bromwich integral of exp(K(s) - s x) / s with the cumulant generating function K. The contour
passes through the saddle point, where the integrand is largest (Daniels 1954, doi 10.1214/aoms/1177728652), and bends
around the branch cut in the direction of steepest descent, so that exp(-s x) decays even for a few terms (as in Talbot
1979, doi 10.1093/imamat/23.1.97). The trapezoidal rule on this contour converges exponentially.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

Float = NDArray[np.float64]

#: Relative change of the integral at which refinement stops.
TOLERANCE = 1e-11
#: First step and largest number of halvings; sinh(t) distributes the points over all scales of an uneven sum.
STEP, HALVINGS = 0.25, 9
#: Growth of the integrand's logarithm along the contour beyond which the contour is bent less.
GROWTH = 1.0
#: Decrease of the integrand's logarithm at which the sum ends.
NEGLIGIBLE = 40.0
#: Points computed at once, and the largest value of t.
BLOCK, MAX_T = 32, 80.0
#: Largest number of Newton steps, and their tolerance in the logarithm of a quantile.
MAX_STEPS, STEP_TOLERANCE = 200, 1e-10


@dataclass(frozen=True, eq=False)
class Squares:
    """Weighted sum of squared normals, sum_i weight_i (z_i + shift_i)^2, with equal weights grouped."""

    weight: Float  # distinct, positive, the largest is 1; shape (n,)
    count: Float  # number of squares of each weight
    push: Float  # sum of their squared shifts
    unit: float  # unit of the weights and of the arguments `value`

    @classmethod
    def of(cls, weight: Float, shift: Float) -> Squares:
        """Group weights and shifts, shape (n,) each."""
        unit = float(weight.max())
        values, member = np.unique(weight / unit, return_inverse=True)
        push = np.bincount(member, shift**2, values.size)
        count = np.bincount(member, minlength=values.size).astype(np.float64)
        return cls(values, count, push.astype(np.float64), unit)

    def tail(self, value: float, *, upper: bool) -> tuple[float, float]:
        """Return the natural logarithm of the probability above or below a positive value, and density / probability.

        The result has full precision in the tail that does not contain the mean.
        """
        gap = self._saddle(value, upper)
        left = self._factors(np.array(gap))
        bend = self._derivative(left, 3) / (6.0 * self._derivative(left, 2))
        scale = 1.0 / np.sqrt(self._derivative(left, 2) + 1.0 / (0.5 - gap) ** 2)
        top = float(self._exponent(np.array([gap + 0j]), value, upper)[0].real)
        while True:
            mass = self._integral(value, upper, (gap, bend, scale), top)
            if mass is not None:
                break
            bend = bend / 4 if bend * scale > 1e-6 else 0.0
        probability, density = mass
        return top + float(np.log(probability / np.pi)), density / probability

    def quantile(self, probability: float, *, upper: bool) -> float:
        """Return the quantile of an upper or lower tail probability, by bracketed Newton steps in logarithms."""
        goal = float(np.log(probability))
        # Start from a gamma distribution of the same mean and variance.
        mean = float(self.weight @ (self.count + self.push))
        variance = float(self.weight**2 @ (2.0 * self.count + 4.0 * self.push))
        shape = mean**2 / variance
        start = (special.gammainccinv if upper else special.gammaincinv)(shape, probability) * variance / mean
        at = float(np.log(max(start, 1e-300)))
        low, high = -700.0, 700.0
        for _ in range(MAX_STEPS):
            mass, ratio = self.tail(float(np.exp(at)), upper=upper)
            off = mass - goal
            if (off > 0) == upper:
                low = at
            else:
                high = at
            # Derivative of the logarithm of the tail with respect to that of the value.
            slope = ratio * float(np.exp(at)) * (-1.0 if upper else 1.0)
            step = -off / slope if slope else np.inf
            if abs(step) <= STEP_TOLERANCE:
                return float(np.exp(at + step))
            after = at + float(np.clip(step, -3.0, 3.0))
            at = after if low < after < high else (max(low, at - 3.0) + min(high, at + 3.0)) / 2
        raise ArithmeticError(f"no quantile at {probability!r} after {MAX_STEPS} steps")

    def _integral(
        self, value: float, upper: bool, path: tuple[float, float, float], top: float
    ) -> tuple[float, float] | None:
        """Integrate probability and density divided by exp(top); return None if the integrand grows on the contour."""
        step, total = STEP, self._sum(value, upper, path, top, 0.0, STEP)
        before = None
        for _ in range(HALVINGS):
            if total is None:
                return None
            if before is not None and abs(total[0] * step - before) <= TOLERANCE * before:
                break
            before = total[0] * step
            more = self._sum(value, upper, path, top, step / 2, step)
            total, step = None if more is None else total + more, step / 2
        return None if total is None else (total[0] * step, total[1] * step)

    def _sum(
        self, value: float, upper: bool, path: tuple[float, float, float], top: float, first: float, step: float
    ) -> Float | None:
        """Sum both integrands over points first, first + step, ... until they are negligible."""
        gap, bend, scale = path
        total = np.zeros(2)
        while True:
            t = first + step * np.arange(BLOCK)
            y = scale * np.sinh(t)
            s_gap = gap - bend * y**2 - 1j * y
            exponent = self._exponent(s_gap, value, upper) - top
            if exponent.real.max() > GROWTH:
                return None
            size = np.exp(exponent) * (1.0 - 2j * bend * y) * scale * np.cosh(t)
            size[t == 0.0] /= 2
            total += np.sum(size.real), np.sum((size * (0.5 - s_gap if upper else s_gap - 0.5)).real)
            died = exponent[-1].real + 2 * t[-1] < -NEGLIGIBLE
            if died or t[-1] > MAX_T:
                return total
            first = t[-1] + step

    def _factors(self, gap: NDArray[Any]) -> NDArray[Any]:
        """Return 1 - 2 weight s for s = 1/2 - gap, without cancellation near the branch point."""
        return np.asarray((1.0 - self.weight) + 2.0 * np.multiply.outer(gap, self.weight))

    def _exponent(self, gap: NDArray[np.complex128], value: float, upper: bool) -> NDArray[np.complex128]:
        """Return K(s) - s x - log(+-s)."""
        left, s = self._factors(gap), 0.5 - gap
        # Real logarithms and angles are several times faster than complex ones.
        square = left.real**2 + left.imag**2
        log = 0.5 * (np.log(square) @ self.count) + 1j * (np.arctan2(left.imag, left.real) @ self.count)
        turn = (left.real / square) @ self.push - self.push.sum() - 1j * ((left.imag / square) @ self.push)
        return np.asarray(-0.5 * log + 0.5 * turn - s * value - np.log(s if upper else -s))

    def _derivative(self, left: Float, order: int) -> float:
        """Return a derivative of K of order 1 to 3."""
        factor = (0.0, 1.0, 2.0, 8.0)[order]
        return factor * float(((self.weight / left) ** order * (self.count + order * self.push / left)).sum())

    def _saddle(self, value: float, upper: bool) -> float:
        """Return 1/2 - s at the minimum of K(s) - s x - log(+-s) on the real axis.

        The minimum lies between 0 and the branch point for the upper tail, and below 0 for the lower tail.
        """
        from scipy.optimize import brentq

        # The parameter v is logarithmic in the distance from 0 and in that from the branch point.
        def gap(v: float) -> float:
            return 0.5 * float(special.expit(-v)) if upper else 0.5 + float(np.exp(v))

        def slope(v: float) -> float:
            s = 0.5 * float(special.expit(v)) if upper else -float(np.exp(v))
            return self._derivative(self._factors(np.array(gap(v))), 1) - value - 1.0 / s

        sign = 1.0 if upper else -1.0
        low, high = -1.0, 1.0
        while sign * slope(low) > 0:
            low *= 2
        while sign * slope(high) < 0:
            high *= 2
        return gap(float(brentq(slope, low, high, rtol=1e-10)))
