"""What all detection statistics have in common: a definition, weights or sums, a distribution for Gaussian noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.noise.comparison import NOISE_FREE, Comparison
from mauvecl.noise.drawn import Drawn
from mauvecl.statistics.distributions import Form, Gaussian, Mixture, QuadraticForm
from mauvecl.statistics.nuisances import Nuisances, joined

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

Float = NDArray[np.float64]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Setting:
    """What the statistics of one detection look at.

    Attributes
    ----------
    quiet : Expectation
        The star without a flare: the reference, and the model of the variances.
    used : ndarray of bool, shape (n_pixel,)
        Pixels that count.
    comparison : Comparison
        What is subtracted, and by whose variances.
    flares : sequence of Expectation
        What may be looked for.
    nuisances : Nuisances, optional
        What is marginalised over.
    drawn : Drawn, optional
        Factors on light, dark and sky that scatter, which closed forms of marginalised statistics integrate over.
    """

    quiet: Expectation
    used: NDArray[np.bool_]
    comparison: Comparison = NOISE_FREE
    flares: Sequence[Expectation] = ()
    nuisances: Nuisances | None = None
    drawn: Drawn | None = None
    _kept: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        # What is remembered is known by where it lies in this process's memory.
        return vars(self) | {"_kept": {}}

    @property
    def integrates(self) -> bool:
        """Whether closed forms integrate over what is drawn."""
        return bool(self.nuisances and self.drawn and not self.comparison.exposures)

    def remembered(self, name: str, make: Callable[[], T]) -> T:
        """What is dear to make and asked for again."""
        if name not in self._kept:
            self._kept[name] = make()
        return cast("T", self._kept[name])


@dataclass(frozen=True, eq=False)
class Tilt:
    """Directions along which importance sampling moves or stretches the noise.

    Attributes
    ----------
    directions : ndarray or sparse array, shape (n_direction, n_pixel)
        Orthonormal, in standard deviations of each pixel's difference.
    square : ndarray, shape (n_direction,), optional
        What the square of a standard normal along each direction adds to a quadratic statistic; none for a linear one.
    per_sigma : float
        What a linear statistic gains by one standard deviation along its direction.
    """

    directions: Any
    square: Float | None = None
    per_sigma: float = 1.0


@dataclass(frozen=True, eq=False)
class Odds:
    """What a statistic makes of one flare, for Gaussian noise.

    Attributes
    ----------
    null, seen : Form
        Its distribution without and with the flare.
    threshold : float
    """

    null: Form
    seen: Form
    threshold: float

    @property
    def probability(self) -> float:
        """Of detection."""
        return self.seen.sf(self.threshold)


@dataclass(frozen=True, eq=False)
class Differences:
    """Of each pixel from the quiescent star.

    Attributes
    ----------
    mean, variance : ndarray, shape (n_pixel,)
        DN, and the true one, DN^2.
    estimated : bool
        Whether a statistic divides by the true variances or by the model's.
    scatter : ndarray, shape (k, n_pixel), optional
        Standard deviations of normal amplitudes that they hold, DN; by default those of the finite priors that are
        marginalised over.
    """

    mean: Float
    variance: Float
    estimated: bool = False
    scatter: Float | None = None


class Statistic(ABC):
    """One detection statistic; it holds no data, so that one object serves every detection.

    `flare` is the expectation whose shape is looked for; statistics that are not `shaped` take none.
    """

    #: As studies, tables and flags call it.
    name: str
    #: What it is, for users.
    definition: ClassVar[str]
    #: For the axes of pictures.
    label: ClassVar[str]
    #: Whether it looks for one flare's shape: each flare then has a null of its own.
    shaped: ClassVar[bool] = False
    #: Whether it compares with one noisy quiescent exposure, whatever the others are compared with.
    paired: ClassVar[bool] = False
    #: Which of the sums that kernels always know it is (`layout.FIXED_STATISTICS`); none where it brings weights.
    kernel_sum: ClassVar[str | None] = None
    #: Whether it looks at sums of resolution elements, not at pixels.
    by_element: ClassVar[bool] = False
    #: Whether it can be marginalised over what is unknown.
    marginal: ClassVar[bool] = True

    def added_variance(self, setting: Setting) -> float:
        """Variance of what is subtracted, in that of one exposure."""
        return 1.0 if self.paired else setting.comparison.added_variance

    def variance(self, setting: Setting) -> Float:
        """Of a pixel's difference without a flare, DN^2, shape (n_pixel,)."""
        return np.asarray((1.0 + self.added_variance(setting)) * setting.quiet.variance_dn2)

    def check(self, setting: Setting) -> None:
        """Refuse a setting in which the statistic says nothing.

        Raises
        ------
        InputError
        """
        if setting.nuisances and (setting.comparison.estimated or not self.marginal):
            why = "with estimated variances" if self.marginal else "which compares with one noisy exposure"
            raise InputError(
                f"statistic {self.name!r} {why} cannot be marginalised over {joined(setting.nuisances.names)}, "
                "expected no unknowns, or another statistic by the model's variances"
            )

    def closed_form(self, setting: Setting, observed: Expectation, flare: Expectation | None = None) -> Form:
        """The distribution for Gaussian noise (METHODS section 6).

        Parameters
        ----------
        setting : Setting
        observed : Expectation
            What is on the sky; the quiescent star for the null.
        flare : Expectation, optional

        Notes
        -----
        Estimated variances are taken for the true ones, which is what they are on average. What is marginalised over
        scatters as it is drawn, the variances with it; by its Gaussian prior where it is not drawn, or where noisy
        exposures are subtracted, which share the factors of a realisation.
        """
        delta = np.where(setting.used, observed.recorded_light_dn - setting.quiet.recorded_light_dn, 0.0)
        true = observed.variance_dn2 + self.added_variance(setting) * setting.quiet.variance_dn2
        return self.as_drawn(setting, observed, Differences(delta, true, setting.comparison.estimated), flare)

    def odds(self, setting: Setting, flare: Expectation, fap: float) -> Odds:
        """Closed forms without and with a flare, and the threshold of a false-alarm probability between them."""
        shape = flare if self.shaped else None

        def cut() -> tuple[Form, float]:
            null = self.closed_form(setting, setting.quiet, shape)
            return null, null.isf(fap)

        null, threshold = cut() if self.shaped else setting.remembered(f"cut of {self.name} at {fap!r}", cut)
        return Odds(null, self.closed_form(setting, flare, shape), threshold)

    def as_drawn(
        self,
        setting: Setting,
        observed: Expectation,
        seen: Differences,
        flare: Expectation | None,
        *,
        priors: bool = True,
    ) -> Form:
        """`form`, integrated over what is drawn where that is marginalised over.

        Without `priors` what is marginalised over and not drawn does not scatter.
        """
        if not setting.integrates:
            return self.form(setting, seen if priors else replace(seen, scatter=np.zeros((0, seen.mean.size))), flare)
        assert setting.nuisances
        assert setting.drawn
        nodes, rows = setting.drawn.nodes(observed, weighted=isinstance(self, LinearStatistic))
        # Other unknowns keep their Gaussian priors.
        others = setting.nuisances.without(tuple(setting.drawn.spreads))
        if priors:
            rows = np.vstack([rows, others.finite(others.spectra)])
        parts = []
        for node in nodes:
            shift, more = node.on(observed)
            moved = Differences(seen.mean + shift * setting.used, seen.variance + more, scatter=rows)
            parts.append(self.form(setting, moved, flare))
        return parts[0] if len(parts) == 1 else Mixture(tuple(parts), np.array([node.probability for node in nodes]))

    @abstractmethod
    def dof(self, setting: Setting) -> int:
        """Degrees of freedom without a flare."""

    @abstractmethod
    def form(self, setting: Setting, seen: Differences, flare: Expectation | None = None) -> QuadraticForm | Gaussian:
        """The distribution for differences that are Gaussian."""

    @abstractmethod
    def values(self, setting: Setting, x: Float, variance: Float, flare: Expectation | None = None) -> Float:
        """The statistic of given differences, on the host.

        Parameters
        ----------
        setting : Setting
        x, variance : ndarray, shape (n, n_pixel)
            Differences, DN, and the variances that are divided by, DN^2.
        flare : Expectation, optional

        Returns
        -------
        ndarray, shape (n,)
        """

    @abstractmethod
    def tilt(self, setting: Setting, flare: Expectation | None = None) -> Tilt:
        """Where importance sampling looks for alarms."""


class LinearStatistic(Statistic):
    """A weighted sum of the differences: normal for Gaussian noise."""

    #: Whether its weights are scaled such that it has variance one without a flare.
    normalised: ClassVar[bool] = True

    @abstractmethod
    def plain_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        """Weights per DN where all is known, shape (n_pixel,); zero for pixels that do not count."""

    def weights_per_dn(self, setting: Setting, flare: Expectation | None = None) -> Float:
        """Weights per DN, shape (n_pixel,); zero for pixels that do not count.

        Raises
        ------
        InputError
            If what is looked for cannot be told from what is unknown.

        Notes
        -----
        Plain weights w look for the spectrum V w. Marginalised they are C^-1 V w (generalised least squares), which for
        the matched filter is C^-1 delta.
        """
        # The flare is kept with them, so that no other has its identity.
        made = setting.remembered(
            f"weights of {self.name} for {id(flare)}", lambda: (flare, self._weights_per_dn(setting, flare))
        )
        return made[1]

    def _weights_per_dn(self, setting: Setting, flare: Expectation | None) -> Float:
        weights = self.plain_weights(setting, flare)
        if not setting.nuisances:
            return weights
        variance = self.variance(setting) * setting.used
        sought = variance * weights
        rows = setting.nuisances.rows(variance, setting.nuisances.spectra * setting.used)
        left = weights - (rows @ sought) @ rows
        power = float(left @ sought)
        if power <= 1e-10 * float(weights @ sought):
            raise InputError(
                f"statistic {self.name!r} looks for what cannot be told from {joined(setting.nuisances.names)}, "
                "expected fewer unknowns or smaller standard deviations"
            )
        return np.asarray(left / np.sqrt(power) if self.normalised else left)

    def dof(self, setting: Setting) -> int:
        return 1

    def form(self, setting: Setting, seen: Differences, flare: Expectation | None = None) -> Gaussian:
        weights, scatter = self.weights_per_dn(setting, flare), seen.scatter
        mean, variance = float(weights @ seen.mean), float(weights**2 @ seen.variance)
        if scatter is None and setting.nuisances:
            scatter = setting.nuisances.finite(setting.nuisances.spectra)
        if scatter is not None:
            variance += float(np.sum((scatter @ weights) ** 2))
        spread = float(np.sqrt(variance))
        # By estimated variances a linear statistic comes in its own standard deviations.
        return Gaussian(mean / spread, 1.0) if seen.estimated else Gaussian(mean, spread)

    def values(self, setting: Setting, x: Float, variance: Float, flare: Expectation | None = None) -> Float:
        weights = self.weights_per_dn(setting, flare)
        total = x @ weights
        return np.asarray(total / np.sqrt(variance @ weights**2) if setting.comparison.estimated else total)

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> Tilt:
        along = self.weights_per_dn(setting, flare) * np.sqrt(self.variance(setting))
        length = float(np.linalg.norm(along))
        return Tilt((along / length)[None], per_sigma=1.0 if setting.comparison.estimated else length)


class QuadraticStatistic(Statistic):
    """A sum of squares of the differences: a generalised chi-squared for Gaussian noise."""

    @abstractmethod
    def own(self, setting: Setting, flare: Expectation | None = None) -> Float:
        """What multiplies each pixel's own square, per DN^2, shape (n_pixel,)."""

    def subtracted(self, setting: Setting) -> Float:
        """Weights per DN of the sums whose squares are subtracted to marginalise, shape (k, n_pixel).

        They apply to pixels that count, and are the same for all of an element where the statistic is `by_element`.
        """
        return np.zeros((0, setting.used.size))
