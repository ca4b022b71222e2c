"""What priors draw, as a few nodes with weights: closed forms integrate over them where the engine draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.noise import priors

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.noise.scene import Scene

Float = NDArray[np.float64]

#: Nodes of Gauss and Hermite's rule over a prior's normal score.
NODES = 15
#: A factor that moves no pixel's variance by more than this share, one standard deviation of it, and that is normal to
#: `STRAIGHT` of its standard deviation, counts as a normal amplitude of a known spectrum.
VARIANCE_SHARE, STRAIGHT = 1e-3, 0.01


@dataclass(frozen=True, eq=False)
class Spread:
    """A factor's distribution.

    Attributes
    ----------
    values, shares : ndarray, shape (n,)
        Nodes and their weights, which sum to one.
    """

    values: Float
    shares: Float

    @property
    def mean(self) -> float:
        return float(self.shares @ self.values)

    @property
    def sd(self) -> float:
        return float(np.sqrt(self.shares @ (self.values - self.mean) ** 2))

    @property
    def normal(self) -> bool:
        """Whether the factor is a straight line of a normal score."""
        if self.values.size == 1:
            return True
        off = self.values - self.mean - self.sd * _score()[0]
        return float(np.sqrt(self.shares @ off**2)) <= STRAIGHT * self.sd


NOTHING = Spread(np.ones(1), np.ones(1))


@dataclass(frozen=True, eq=False)
class Drawn:
    """What is drawn of the factors on light, dark and sky, averaged over an exposure.

    Attributes
    ----------
    spreads : mapping of str to Spread
        Of those that are drawn.
    """

    spreads: Mapping[str, Spread]

    @classmethod
    def of(cls, scene: Scene) -> Drawn | None:
        """Of a scene; None where nothing is drawn."""
        found: dict[str, list[Spread]] = {}
        for (name, factor), table in zip(scene.modulations, scene.priors, strict=True):
            one = _of_table(table)
            if name == "jitter" and scene.n_frames > 1:
                one = _normal(one.mean, one.sd / np.sqrt(scene.n_frames))
            found.setdefault(factor, []).append(one)
        medians = dict(zip(("light", "dark", "sky"), scene.medians, strict=True))
        return cls({name: _together(ones, medians[name]) for name, ones in found.items()}) if found else None

    def nodes(self, x: Expectation) -> tuple[list[tuple[float, Float, Float]], Float]:
        """What the factors do to an exposure.

        Parameters
        ----------
        x : Expectation

        Returns
        -------
        nodes : list of (share, shift, more)
            Probability of each; DN and DN^2 that it adds to means and variances, each shape (n_pixel,).
        rows : ndarray, shape (k, n_pixel)
            Of normal amplitudes beside them: DN of one standard deviation.
        """
        gain, light, sky = x.gain_dn_per_electron, x.recorded_light_dn, x.sky_dn
        dark, dark_variance = x.n_frames * x.dark_dn, x.n_frames * x.dark_variance_dn2
        moved = {"light": (light, gain * light), "sky": (sky, gain * sky), "dark": (dark, dark_variance)}
        grids, rows = [], []
        for name, (part, variance) in moved.items():
            spread = self.spreads.get(name, NOTHING)
            if spread.normal and (spread.sd * variance <= VARIANCE_SHARE * x.variance_dn2).all():
                if spread.sd:
                    rows.append(spread.sd * part)
                spread = Spread(np.array([spread.mean]), np.ones(1))
            grids.append(list(zip(spread.shares.tolist(), spread.values.tolist(), strict=True)))
        nodes = []
        for (a, lit), (b, grey), (c, warm) in product(*grids):
            # The sky's light follows the factors on all light, too.
            more = (lit - 1.0) * light + lit * (grey - 1.0) * sky
            shift = more + (warm - 1.0) * dark
            nodes.append((a * b * c, shift, gain * more + (warm - 1.0) * dark_variance))
        return nodes, np.array(rows).reshape(len(rows), light.size)


def _score() -> tuple[Float, Float]:
    """Nodes of a standard normal and their weights."""
    score, weight = np.polynomial.hermite_e.hermegauss(NODES)
    return score, weight / weight.sum()


def _normal(mean: float, sd: float) -> Spread:
    score, weight = _score()
    return Spread(mean + sd * score, weight)


def _of_table(table: NDArray[np.float32]) -> Spread:
    """Of a device's table of quantiles: a factor over that at the median."""
    score, weight = _score()
    below, above = special.ndtr(score), special.ndtr(-score)
    tail, (low, high) = priors.nodes(), np.split(table.astype(np.float64), 2)
    values = np.where(below < 0.5, np.interp(below, tail, low), np.interp(above, tail, high))
    return Spread(1.0 + values, weight)


def _together(ones: list[Spread], median: float) -> Spread:
    """The product of independent factors; of several by its mean and variance."""
    if len(ones) == 1:
        return Spread(median * ones[0].values, ones[0].shares)
    mean = np.prod([one.mean for one in ones])
    square = np.prod([one.mean**2 + one.sd**2 for one in ones])
    return _normal(float(median * mean), float(median * np.sqrt(square - mean**2)))
