"""Families of flare shapes over which energies are averaged.

A shape is a weighted sum of a few parts, so that the fits of all shapes of a family follow from those of its parts. The
general family has flares with other rises and decays than the published shapes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from mauvecl.flares.shapes import SHAPES, Davenport2014, Integrable, Shape

Float = NDArray[np.float64]

#: Published shapes that are averaged, besides that of the search.
AVERAGED = ("davenport2014", "tovarmendoza2022")
#: Departures of flares from their shape that are averaged with equal weights (assumed). A flare of the general family
#: is never exactly one of its shapes.
EPSILON, GENERAL_EPSILON = (0.0, 0.02, 0.06, 0.2), (0.04, 0.1, 0.2)
#: Widths of the Gaussian rises and decays of the general family from half maximum to maximum, in half-widths (assumed).
GAUSSIAN_RISES, GAUSSIAN_DECAY = (0.15, 0.5, 1.5), 0.5
#: Shares of slow exponentials in the decay, and their rates, per half-width (assumed; Davenport's are 0.30 and 0.28).
SLOW_SHARES, SLOW_RATES = (0.08, 0.16, 0.3, 0.45), tuple(np.geomspace(0.1, 0.9, 24).tolist())
#: Name of the general family.
GENERAL = "general"
#: Prior weight of the general family (assumed); published shapes share the rest.
GENERAL_WEIGHT = 0.5


class Rise(ABC):
    """Rise of a flare that ends at the peak."""

    @abstractmethod
    def before(self, tau: ArrayLike) -> Float:
        """Return the integral up to tau."""

    def after(self, tau: ArrayLike) -> Float:
        """Return the integral from tau to the peak."""
        t = np.asarray(tau, np.float64)
        return self.before(0.0) - self.before(t) if (t < 0).any() else np.zeros(t.shape)


class Decay(ABC):
    """Decay of a flare that begins at the peak."""

    def before(self, tau: ArrayLike) -> Float:
        """Return the integral from the peak to tau."""
        t = np.asarray(tau, np.float64)
        return self.after(0.0) - self.after(t) if (t > 0).any() else np.zeros(t.shape)

    @abstractmethod
    def after(self, tau: ArrayLike) -> Float:
        """Return the integral from tau to the end."""


@dataclass(frozen=True)
class PublishedRise(Rise):
    """The rise of Davenport et al. (2014)."""

    def before(self, tau: ArrayLike) -> Float:
        return SHAPES["davenport2014"].before(np.minimum(tau, 0.0))


@dataclass(frozen=True)
class GaussianRise(Rise):
    """First half of a Gaussian; `width` is from half maximum to maximum, in half-widths."""

    width: float

    def before(self, tau: ArrayLike) -> Float:
        return _gaussian_tail(-np.minimum(tau, 0.0), self.width)


@dataclass(frozen=True)
class GaussianDecay(Decay):
    """Second half of a Gaussian; `width` is from maximum to half maximum, in half-widths."""

    width: float

    def after(self, tau: ArrayLike) -> Float:
        return _gaussian_tail(np.maximum(tau, 0.0), self.width)


@dataclass(frozen=True)
class Exponential(Decay):
    """Exponential decay; `rate` per half-width."""

    rate: float

    def after(self, tau: ArrayLike) -> Float:
        return np.asarray(np.exp(-self.rate * np.maximum(tau, 0.0)) / self.rate)


def _gaussian_tail(tau: ArrayLike, width: float) -> Float:
    """Return the integral of a Gaussian from tau to the end, for a half-width at half maximum of `width`."""
    root = float(np.sqrt(np.log(2)))
    return np.asarray(np.sqrt(np.pi) / 2 * width / root * scipy.special.erfc(np.asarray(tau) * root / width))


@dataclass(frozen=True)
class WeightedSum:
    """Shape of a family: a weighted sum of its parts."""

    name: str
    parts: tuple[tuple[float, Integrable], ...]

    def before(self, tau: ArrayLike) -> Float:
        """Return the integral up to tau."""
        return np.asarray(sum(weight * part.before(tau) for weight, part in self.parts))

    def after(self, tau: ArrayLike) -> Float:
        """Return the integral from tau to the end."""
        return np.asarray(sum(weight * part.after(tau) for weight, part in self.parts))

    @property
    def equivalent_duration(self) -> float:
        """Total integral, in half-widths."""
        return float(self.before(0.0) + self.after(0.0))


@dataclass(frozen=True, eq=False)
class Family:
    """Shapes that are weighted sums of the same parts, with equal prior weights."""

    name: str
    parts: tuple[Integrable, ...]
    weights: Float  # shape (n_shape, n_part)
    epsilon: tuple[float, ...]  # departures from the shapes that are averaged
    prior: float  # weight of the family

    @classmethod
    def of(cls, shape: Shape, prior: float) -> Family:
        """Return the family of a single shape."""
        return cls(shape.name, (shape,), np.ones((1, 1)), EPSILON, prior)

    @classmethod
    @cache
    def general(cls) -> Family:
        """Return the general family, the same object in all calls: rises and decays in all combinations."""
        rises: list[Integrable] = [PublishedRise(), *(GaussianRise(width) for width in GAUSSIAN_RISES)]
        fast: list[Integrable] = [Exponential(Davenport2014.DECAY[0][1]), GaussianDecay(GAUSSIAN_DECAY)]
        slow = [Exponential(rate) for rate in SLOW_RATES]
        choices = [(0.0, 0), *((share, rate) for share in SLOW_SHARES for rate in range(len(slow)))]
        rows = []
        for rise, start, (share, rate) in product(range(len(rises)), range(len(fast)), choices):
            row = np.zeros(len(rises) + len(fast) + len(slow))
            row[rise], row[len(rises) + start] = 1.0, 1.0 - share
            row[len(rises) + len(fast) + rate] = share
            rows.append(row)
        return cls(GENERAL, (*rises, *fast, *slow), np.array(rows), GENERAL_EPSILON, GENERAL_WEIGHT)

    @property
    def durations(self) -> Float:
        """Equivalent duration of each shape for unit amplitude and half-width."""
        return np.asarray(self.weights @ [float(part.before(0.0) + part.after(0.0)) for part in self.parts])

    def shape(self, k: int) -> WeightedSum:
        """Return one of the shapes."""
        return WeightedSum(self.name, tuple((float(w), part) for w, part in zip(self.weights[k], self.parts,
                                                                                 strict=True) if w))  # fmt: skip


def families(searched: Shape) -> Sequence[Family]:
    """Return the families that are averaged for a search with some shape, that of many shapes last."""
    published = {shape.name: shape for shape in (searched, *(SHAPES[name] for name in AVERAGED))}
    prior = (1 - GENERAL_WEIGHT) / len(published)
    return [*(Family.of(shape, prior) for shape in published.values()), Family.general()]
