"""Distributions of the random factors on light, dark and sky, as quadrature nodes for closed forms."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.noise.factor_tables import Factors
from mauvecl.noise.prior_tables import nodes

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.noise.processes import Processes
    from mauvecl.noise.scene import Scene
    from mauvecl.noise.unknowns import SignalPart

Float = NDArray[np.float64]

#: Number of nodes of the trapezoidal rule over a prior's normal score, and its range. The rule converges exponentially
#: for functions that are smooth over a step (Trefethen & Weideman 2014, doi 10.1137/130932132).
NODES, REACH = 281, 7.0
SCORE = np.linspace(-REACH, REACH, NODES)
WEIGHTS = np.exp(-(SCORE**2) / 2) / np.exp(-(SCORE**2) / 2).sum()
#: Sums of squares use every tenth node, since they are wide; weighted sums may be much narrower than a prior.
COARSE = 10
#: Nodes of the Gauss-Hermite rule for factors after the first.
FEW = 7
#: A factor is treated as a normal amplitude of a known spectrum if one standard deviation changes no pixel's variance
#: by more than this fraction (for weighted sums, and for sums of squares), and its values deviate from a linear
#: function of the score by less than `STRAIGHT` standard deviations, root mean square.
VARIANCE_FRACTION = {True: 1e-2, False: 1e-3}
STRAIGHT = 0.01


@dataclass(frozen=True, eq=False)
class FactorDistribution:
    """Distribution of a factor as quadrature nodes."""

    values: Float  # shape (n,)
    weights: Float  # shape (n,), sum one

    @property
    def mean(self) -> float:
        return float(self.weights @ self.values)

    @property
    def sd(self) -> float:
        return float(np.sqrt(self.weights @ (self.values - self.mean) ** 2))

    @property
    def normal(self) -> bool:
        """Whether the factor is a linear function of a normal score."""
        if self.values.size == 1:
            return True
        off = self.values - self.mean - self.sd * SCORE
        return float(np.sqrt(self.weights @ off**2)) <= STRAIGHT * self.sd


UNIT_FACTOR = FactorDistribution(np.ones(1), np.ones(1))


@dataclass(frozen=True)
class Node:
    """Quadrature node: a set of factors on dark, light and sky."""

    probability: float
    dark: float
    light: float
    sky: float
    scores: dict[str, float]  # normal score of each factor

    @property
    def amounts(self) -> tuple[float, float, float]:
        """Amounts of the changes of `changes_of`."""
        return self.light - 1.0, self.light * (self.sky - 1.0), self.dark - 1.0


def changes_of(x: Expectation) -> tuple[Float, Float]:
    """Return changes by factors of an exposure's means (DN) and variances (DN^2), each shape (3, n_pixel).

    Rows are for all light, which includes the sky's, for the sky's alone, and for the dark current, each for an amount
    of one. A pixel that saturates records a change only in those frames that are not clipped, and its variance changes
    by the same fraction as without saturation, so that no factor makes it negative.
    """
    light, dark = np.array([x.light_dn, x.sky_dn]), x.n_frames * x.dark_dn
    variances = np.array([*(x.gain_dn_per_electron * light), x.n_frames * x.dark_variance_dn2])
    means = np.array([*light, dark]) * (1 - x.cut_share)
    return means, variances * (x.variance_dn2 / x.unsaturated_variance_dn2)


@dataclass(frozen=True, eq=False)
class FactorDistributions:
    """Distributions of the drawn factors on light, dark and sky, averaged over an exposure."""

    spreads: Mapping[str, FactorDistribution]

    @classmethod
    def of(cls, scene: Scene) -> FactorDistributions | None:
        """Return the distributions of a scene, or None if it draws no factors."""
        return cls._of(scene.modulations, scene.priors, scene.medians, scene.n_frames)

    @classmethod
    def from_processes(cls, processes: Processes, quiet: Expectation) -> FactorDistributions | None:
        """Return the distributions of processes for a star, or None if they draw no factors."""
        if not processes.modulations:
            return None
        factors = Factors.of(processes, quiet.conditions)
        medians = factors.light, factors.dark, factors.sky
        return cls._of(processes.modulations, factors.tables, medians, quiet.n_frames)

    @classmethod
    def _of(
        cls,
        modulations: Sequence[tuple[str, SignalPart]],
        tables: NDArray[np.float32],
        medians: tuple[float, float, float],
        n_frames: int,
    ) -> FactorDistributions | None:
        spreads: dict[str, list[FactorDistribution]] = {}
        for (name, factor), table in zip(modulations, tables, strict=True):
            one = _of_table(table)
            if name == "jitter" and n_frames > 1:
                one = _normal(one.mean, one.sd / np.sqrt(n_frames))
            spreads.setdefault(factor, []).append(one)
        median = dict(zip(("light", "dark", "sky"), medians, strict=True))
        return cls({name: _product(ones, median[name]) for name, ones in spreads.items()}) if spreads else None

    def nodes(self, x: Expectation, *, weighted: bool) -> tuple[list[Node], Float]:
        """Return the nodes over which a statistic of an exposure is integrated.

        Parameters
        ----------
        weighted : bool
            Whether the statistic is a weighted sum instead of a sum of squares.

        Returns
        -------
        nodes : list of Node
        rows : ndarray, shape (k, n_pixel)
            Spectra of factors treated as normal amplitudes, DN per standard deviation.
        """
        light, sky, dark = zip(*changes_of(x), strict=True)
        moved = {"dark": dark, "light": light, "sky": sky}
        grids, rows = [], []
        every, few = 1 if weighted else COARSE, np.polynomial.hermite_e.hermegauss(FEW)
        score, weight = SCORE[::every], WEIGHTS[::every] / WEIGHTS[::every].sum()
        for name, (part, variance) in moved.items():
            spread = self.spreads.get(name, UNIT_FACTOR)
            if spread.normal and (spread.sd * variance <= VARIANCE_FRACTION[weighted] * x.variance_dn2).all():
                if spread.sd:
                    rows.append(spread.sd * part)
                grids.append([(1.0, spread.mean, 0.0)])
                continue
            values = np.interp(score, SCORE, spread.values)
            grids.append(list(zip(weight.tolist(), values.tolist(), score.tolist(), strict=True)))
            score, weight = few[0], few[1] / few[1].sum()
        nodes = []
        for chosen in product(*grids):
            weights, (dark, light, sky), scores = zip(*chosen, strict=True)
            nodes.append(Node(math.prod(weights), dark, light, sky, dict(zip(moved, scores, strict=True))))
        return nodes, np.array(rows).reshape(len(rows), x.variance_dn2.size)


def _normal(mean: float, sd: float) -> FactorDistribution:
    return FactorDistribution(mean + sd * SCORE, WEIGHTS)


def _of_table(table: NDArray[np.float32]) -> FactorDistribution:
    """Return the distribution given by a device's quantile table, relative to the factor at the median."""
    return FactorDistribution(1.0 + quantile_at_score(table, SCORE), WEIGHTS)


def quantile_at_score(table: NDArray[np.float32], score: Float) -> Float:
    """Interpolate a device's quantile table at standard normal scores; the result has the shape of `score`."""
    below, above = special.ndtr(score), special.ndtr(-score)
    tail, (low, high) = nodes(), np.split(table.astype(np.float64), 2)
    return np.asarray(np.where(below < 0.5, np.interp(below, tail, low), np.interp(above, tail, high)))


def _product(ones: list[FactorDistribution], median: float) -> FactorDistribution:
    """Return the distribution of a product of independent factors, which is normal if there are several."""
    if len(ones) == 1:
        return FactorDistribution(median * ones[0].values, ones[0].weights)
    mean = np.prod([one.mean for one in ones])
    square = np.prod([one.mean**2 + one.sd**2 for one in ones])
    return _normal(float(median * mean), float(median * np.sqrt(square - mean**2)))
