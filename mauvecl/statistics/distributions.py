"""Distributions of detection statistics for Gaussian noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.statistics.inversion import Squares

#: Limits of the precomputed transform: distance from the mean in standard deviations, least number of effective terms,
#: least probability.
NEAR, MANY, RARE = 40.0, 30.0, 1e-9


@dataclass(frozen=True, eq=False)
class QuadraticForm:
    """Generalised chi-squared variable: sum_i weight_i (z_i + shift_i)^2 with independent standard normals z_i."""

    weight: NDArray[np.float64]  # positive, shape (n,)
    shift: NDArray[np.float64]  # means in standard deviations, shape (n,)

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
        """Number of equal terms with the same relative scatter: (sum of weights)^2 / sum of squared weights."""
        return float(self.weight.sum() ** 2 / np.sum(self.weight**2))

    def sf(self, value: float) -> float:
        """Return the probability of exceeding `value`.

        Notes
        -----
        For many terms and values near the mean, the characteristic function is inverted by a trapezoidal sum (Davies
        1973, doi 10.1093/biomet/60.2.415), whose terms are computed once for all values. Its aliasing error is the
        probability of a distance above 2 pi / spacing. The spacing makes this distance 40 standard deviations, for an
        error below 1e-15 with ten terms or more, and the sum ends when its terms are below 1e-15. Otherwise the
        integral of `inversion` is used, which is accurate far in the tail.
        """
        if value <= 0.0:
            return 1.0
        if self._is_chi_squared():
            if not self.shift.any():
                return float(special.chdtrc(self.weight.size, value))
            # scipy.stats takes a second to import, and most studies do not need it.
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
        """Frequencies, and modulus and phase of the characteristic function, for values near the mean."""
        spacing = 2.0 * np.pi / ((40.0 + NEAR) * self.std)
        weight, count, pull = self.weight, np.ones(self.weight.size), self.shift**2 * self.weight
        values, member = np.unique(weight, return_inverse=True)
        if values.size < weight.size / 2:
            # Most weights of marginalised statistics are equal.
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
        """Return the value that is exceeded with a probability in (0, 1)."""
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
    """A normal distribution with the interface of `QuadraticForm`."""

    mean: float
    std: float
    third: ClassVar[float] = 0.0

    def sf(self, value: float) -> float:
        """Return the probability of exceeding `value`."""
        return float(special.ndtr((self.mean - value) / self.std))

    def isf(self, probability: float) -> float:
        """Return the value that is exceeded with a probability in (0, 1)."""
        return float(self.mean - self.std * special.ndtri(probability))


@dataclass(frozen=True, eq=False)
class Mixture:
    """A mixture of distributions, for statistics whose noise depends on drawn factors."""

    parts: tuple[QuadraticForm | Gaussian, ...]
    weights: NDArray[np.float64]  # probability of each part, shape (n,)

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
        """Return the probability of exceeding `value`."""
        normal = self._normal
        if normal is None:
            each = np.array([part.sf(value) for part in self.parts])
        else:
            mean, std = normal
            each = special.ndtr((mean - value) / std)
        return min(float(self.weights @ each), 1.0)

    @cached_property
    def _normal(self) -> NDArray[np.float64] | None:
        """Means and standard deviations if all parts are normal, shape (2, n)."""
        if not all(isinstance(part, Gaussian) for part in self.parts):
            return None
        return np.array([(part.mean, part.std) for part in self.parts]).T

    def isf(self, probability: float) -> float:
        """Return the value that is exceeded with a probability in (0, 1)."""
        from scipy.optimize import brentq

        low, high = self.mean - self.std, self.mean + self.std
        while self.sf(low) < probability:
            low -= self.std
        while self.sf(high) > probability:
            high += self.std
        return float(brentq(lambda x: np.log(self.sf(x) / probability), low, high, xtol=1e-9 * self.std))


#: Closed form of a statistic's distribution.
Form = QuadraticForm | Gaussian | Mixture
