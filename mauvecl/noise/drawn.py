"""What priors draw, as nodes with weights: closed forms integrate over them where the engine draws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.noise.prior_tables import nodes

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.noise.processes import Processes
    from mauvecl.noise.scene import Scene
    from mauvecl.noise.varied import Modulated

Float = NDArray[np.float64]

#: Nodes of the trapezoidal rule over a prior's normal score, and how far they reach. It converges exponentially for
#: what is smooth over a step (Trefethen & Weideman 2014, doi 10.1137/130932132).
NODES, REACH = 281, 7.0
SCORE = np.linspace(-REACH, REACH, NODES)
WEIGHTS = np.exp(-(SCORE**2) / 2) / np.exp(-(SCORE**2) / 2).sum()
#: Every so many of them do for sums of squares, which are wide; a weighted sum may be narrower than a prior by far.
COARSE = 10
#: Nodes of Gauss and Hermite's rule for factors beside the first.
FEW = 7
#: A factor counts as a normal amplitude of a known spectrum if one standard deviation of it moves no pixel's variance
#: by more than this fraction, in weighted sums and in sums of squares, and its values lie this near a straight line of
#: the score, root mean square in standard deviations.
VARIANCE_FRACTION = {True: 1e-2, False: 1e-3}
STRAIGHT = 0.01


@dataclass(frozen=True, eq=False)
class Spread:
    """A factor's distribution.

    Attributes
    ----------
    values, weights : ndarray, shape (n,)
        Nodes and their weights, which sum to one.
    """

    values: Float
    weights: Float

    @property
    def mean(self) -> float:
        return float(self.weights @ self.values)

    @property
    def sd(self) -> float:
        return float(np.sqrt(self.weights @ (self.values - self.mean) ** 2))

    @property
    def normal(self) -> bool:
        """Whether the factor is a straight line of a normal score."""
        if self.values.size == 1:
            return True
        off = self.values - self.mean - self.sd * SCORE
        return float(np.sqrt(self.weights @ off**2)) <= STRAIGHT * self.sd


NOTHING = Spread(np.ones(1), np.ones(1))


@dataclass(frozen=True)
class Node:
    """One set of factors.

    Attributes
    ----------
    probability : float
        Of it.
    dark, light, sky : float
        Factors.
    scores : dict of str to float
        Their normal scores.
    """

    probability: float
    dark: float
    light: float
    sky: float
    scores: dict[str, float]

    def on(self, x: Expectation) -> tuple[Float, Float]:
        """DN and DN^2 added to means and variances of an exposure, each shape (n_pixel,)."""
        # The sky's light follows the factors on all light, too.
        more = (self.light - 1.0) * x.recorded_light_dn + self.light * (self.sky - 1.0) * x.sky_dn
        dark = (self.dark - 1.0) * x.n_frames
        return more + dark * x.dark_dn, x.gain_dn_per_electron * more + dark * x.dark_variance_dn2


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
        return cls._of(scene.modulations, scene.priors, scene.medians, scene.n_frames)

    @classmethod
    def by(cls, processes: Processes, quiet: Expectation) -> Drawn | None:
        """What a scene of a star would hold, without its arrays; None where nothing is drawn."""
        if not processes.modulations:
            return None
        factors = processes.factors(quiet.conditions)
        medians = factors.light, factors.dark, factors.sky
        return cls._of(processes.modulations, factors.tables, medians, quiet.n_frames)

    @classmethod
    def _of(
        cls,
        modulations: Sequence[tuple[str, Modulated]],
        tables: NDArray[np.float32],
        medians: tuple[float, float, float],
        n_frames: int,
    ) -> Drawn | None:
        spreads: dict[str, list[Spread]] = {}
        for (name, factor), table in zip(modulations, tables, strict=True):
            one = _of_table(table)
            if name == "jitter" and n_frames > 1:
                one = _normal(one.mean, one.sd / np.sqrt(n_frames))
            spreads.setdefault(factor, []).append(one)
        median = dict(zip(("light", "dark", "sky"), medians, strict=True))
        return cls({name: _together(ones, median[name]) for name, ones in spreads.items()}) if spreads else None

    def nodes(self, x: Expectation, *, weighted: bool) -> tuple[list[Node], Float]:
        """What the factors do to an exposure.

        Parameters
        ----------
        x : Expectation
        weighted : bool
            For a weighted sum, or for a sum of squares.

        Returns
        -------
        nodes : list of Node
        rows : ndarray, shape (k, n_pixel)
            Of normal amplitudes beside them: DN of one standard deviation.
        """
        gain, light, sky = x.gain_dn_per_electron, x.recorded_light_dn, x.sky_dn
        dark, dark_variance = x.n_frames * x.dark_dn, x.n_frames * x.dark_variance_dn2
        moved = {"dark": (dark, dark_variance), "light": (light, gain * light), "sky": (sky, gain * sky)}
        grids, rows = [], []
        every, few = 1 if weighted else COARSE, np.polynomial.hermite_e.hermegauss(FEW)
        score, weight = SCORE[::every], WEIGHTS[::every] / WEIGHTS[::every].sum()
        for name, (part, variance) in moved.items():
            spread = self.spreads.get(name, NOTHING)
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
            weights, (warm, lit, grey), scores = zip(*chosen, strict=True)
            nodes.append(Node(float(np.prod(weights)), warm, lit, grey, dict(zip(moved, scores, strict=True))))
        return nodes, np.array(rows).reshape(len(rows), light.size)


def _normal(mean: float, sd: float) -> Spread:
    return Spread(mean + sd * SCORE, WEIGHTS)


def _of_table(table: NDArray[np.float32]) -> Spread:
    """Of a device's table of quantiles: a factor over that at the median."""
    return Spread(1.0 + at_score(table, SCORE), WEIGHTS)


def at_score(table: NDArray[np.float32], score: Float) -> Float:
    """What a device's table of quantiles holds where a standard normal has a value; shape as given."""
    below, above = special.ndtr(score), special.ndtr(-score)
    tail, (low, high) = nodes(), np.split(table.astype(np.float64), 2)
    return np.asarray(np.where(below < 0.5, np.interp(below, tail, low), np.interp(above, tail, high)))


def _together(ones: list[Spread], median: float) -> Spread:
    """The product of independent factors; of several by its mean and variance."""
    if len(ones) == 1:
        return Spread(median * ones[0].values, ones[0].weights)
    mean = np.prod([one.mean for one in ones])
    square = np.prod([one.mean**2 + one.sd**2 for one in ones])
    return _normal(float(median * mean), float(median * np.sqrt(square - mean**2)))
