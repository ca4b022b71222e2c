"""The distributions that detection statistics have for Gaussian noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.statistics.inversion import Squares

#: Standard deviations from the mean within which a transform is computed once for all values, if there are as many
#: effective terms and the probability is as large.
NEAR, MANY, RARE = 40.0, 30.0, 1e-9


@dataclass(frozen=True, eq=False)
class QuadraticForm:
    """sum_i weight_i (z_i + shift_i)^2 with independent standard normals z_i: a generalised chi-squared.

    Attributes
    ----------
    weight : ndarray, shape (n,)
        Positive.
    shift : ndarray, shape (n,)
        Means in standard deviations.
    """

    weight: NDArray[np.float64]
    shift: NDArray[np.float64]

    @property
    def mean(self) -> float:
        return float(np.sum(self.weight * (1.0 + self.shift**2)))

    @property
    def std(self) -> float:
        return float(np.sqrt(np.sum(self.weight**2 * (2.0 + 4.0 * self.shift**2))))

    @property
    def third(self) -> float:
        """Third central moment."""
        return 8.0 * float(np.sum(self.weight**3 * (1.0 + 3.0 * self.shift**2)))

    @property
    def effective_terms(self) -> float:
        """How many equal terms would scatter as much for their sum: (sum of weights)^2 / sum of their squares."""
        return float(self.weight.sum() ** 2 / np.sum(self.weight**2))

    def sf(self, value: float) -> float:
        """Probability of exceeding `value`.

        Notes
        -----
        Of many terms, and not far out, Davies's inversion of the characteristic function (1973, doi
        10.1093/biomet/60.2.415), computed once for all values: a trapezoidal sum whose aliasing error is the
        probability of lying more than 2 pi / spacing away. The spacing puts that 40 standard deviations out, below
        1e-15 for ten terms or more; the sum stops where its terms have fallen below 1e-15. Of few terms, and far out,
        the integral of `inversion`, which keeps its digits.
        """
        if value <= 0.0:
            return 1.0
        if self._is_chi_squared():
            if not self.shift.any():
                return float(special.chdtrc(self.weight.size, value))
            # scipy.stats takes a second to load, and is not needed by most studies.
            from scipy.stats import ncx2

            return float(ncx2.sf(value, self.weight.size, np.sum(self.shift**2)))
        if self.effective_terms >= MANY and abs(value - self.mean) <= NEAR * self.std:
            u, size, phase = self._near
            above = 0.5 + float(np.sum(size * np.sin(phase - u * value))) / np.pi
            if above >= RARE:
                return min(above, 1.0)
        upper = value > self.mean
        tail = float(np.exp(self._squares.tail(value / self._squares.unit, upper=upper)[0]))
        return tail if upper else 1.0 - tail

    @cached_property
    def _squares(self) -> Squares:
        return Squares.of(self.weight, self.shift)

    @cached_property
    def _near(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Frequencies, and the characteristic function's modulus and phase there, for all values that are near."""
        spacing = 2.0 * np.pi / ((40.0 + NEAR) * self.std)
        weight, count, pull = self.weight, np.ones(self.weight.size), self.shift**2 * self.weight
        values, member = np.unique(weight, return_inverse=True)
        if values.size < weight.size / 2:
            # Equal weights count together: of marginalised statistics most are.
            weight, count = values, np.bincount(member).astype(np.float64)
            pull = np.bincount(member, pull).astype(np.float64)
        parts = []
        k = 0.5 + np.arange(256)
        while True:
            u = k * spacing
            turn = 2.0 * np.outer(u, weight)
            spread = 1.0 + turn**2
            log_size = -0.25 * (np.log(spread) * count).sum(axis=1) - (u[:, None] * turn * pull / spread).sum(axis=1)
            phase = 0.5 * (np.arctan(turn) * count).sum(axis=1) + (u[:, None] * pull / spread).sum(axis=1)
            parts.append((u, np.exp(log_size) / k, phase))
            k = k + 256
            if log_size[-1] < np.log(1e-15 * k[0]):
                us, sizes, phases = zip(*parts, strict=True)
                return np.concatenate(us), np.concatenate(sizes), np.concatenate(phases)

    def isf(self, probability: float) -> float:
        """The value exceeded with this probability, 0 < probability < 1."""
        if self._is_chi_squared() and not self.shift.any():
            return float(special.chdtri(self.weight.size, probability))
        if self.effective_terms >= MANY and RARE < probability < 1.0 - RARE:
            from scipy.optimize import brentq

            low, high = max(self.mean - 12 * self.std, 0.0), self.mean + 40 * self.std
            return float(brentq(lambda x: self.sf(x) - probability, low, high, xtol=1e-9 * self.std))
        upper = probability <= 0.5
        wanted = probability if upper else 1.0 - probability
        return self._squares.unit * self._squares.quantile(wanted, upper=upper)

    def _is_chi_squared(self) -> bool:
        return bool(np.all(self.weight == 1.0))


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution, with the same face as `QuadraticForm`."""

    mean: float
    std: float
    third: ClassVar[float] = 0.0

    def sf(self, value: float) -> float:
        """Probability of exceeding `value`."""
        return float(special.ndtr((self.mean - value) / self.std))

    def isf(self, probability: float) -> float:
        """The value exceeded with this probability."""
        return float(self.mean - self.std * special.ndtri(probability))


@dataclass(frozen=True, eq=False)
class Mixture:
    """One of several distributions, with the same face: what a statistic is where the noise depends on what is drawn.

    Attributes
    ----------
    parts : tuple of QuadraticForm or Gaussian
    weights : ndarray, shape (n,)
        Probability of each.
    """

    parts: tuple[QuadraticForm | Gaussian, ...]
    weights: NDArray[np.float64]

    @cached_property
    def mean(self) -> float:
        return float(self.weights @ [part.mean for part in self.parts])

    @cached_property
    def std(self) -> float:
        return float(np.sqrt(self.weights @ [part.std**2 + (part.mean - self.mean) ** 2 for part in self.parts]))

    @cached_property
    def third(self) -> float:
        """Third central moment."""
        away = [part.mean - self.mean for part in self.parts]
        each = [part.third + 3.0 * d * part.std**2 + d**3 for part, d in zip(self.parts, away, strict=True)]
        return float(self.weights @ each)

    def sf(self, value: float) -> float:
        """Probability of exceeding `value`."""
        return min(float(self.weights @ [part.sf(value) for part in self.parts]), 1.0)

    def isf(self, probability: float) -> float:
        """The value exceeded with this probability, 0 < probability < 1."""
        from scipy.optimize import brentq

        low, high = self.mean - self.std, self.mean + self.std
        while self.sf(low) < probability:
            low -= self.std
        while self.sf(high) > probability:
            high += self.std
        return float(brentq(lambda x: np.log(self.sf(x) / probability), low, high, xtol=1e-9 * self.std))


#: What a closed form is.
Form = QuadraticForm | Gaussian | Mixture
