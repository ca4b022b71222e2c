"""Statistics that are weighted sums: matched filter, ultraviolet excess and user-defined statistics."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.distributions import Form, Gaussian, Mixture, QuadraticForm
from mauvecl.detection.nuisances import Nuisances, join_names
from mauvecl.host.arrays import ContentEquality, Float
from mauvecl.noise.scene import FactorDistribution, changes_of, drawn_factors, factor_nodes
from mauvecl.noise.unknowns import NOISE_FREE, NONE, Comparison, Processes, SignalPart
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Setting:
    """Common input of the statistics of one detection."""

    quiet: Expectation  # the quiescent star: the reference and the model of the variances
    used: NDArray[np.bool_]  # pixels that statistics use, shape (n_pixel,)
    comparison: Comparison = NOISE_FREE  # the subtracted reference and the choice of variances
    flares: Sequence[Expectation] = ()  # possible templates
    nuisances: Nuisances | None = None  # parameters that statistics marginalise over
    processes: Processes = NONE  # drawn factors over which closed forms of marginalised statistics integrate
    _cache: dict[tuple[str, int], Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        # Keys of the cache hold identities of objects, which are valid in this process only.
        return vars(self) | {"_cache": {}}

    @property
    def n_free(self) -> int:
        """Number of projected-out parameters."""
        return self.nuisances.free if self.nuisances else 0

    @property
    def drawn(self) -> dict[SignalPart, FactorDistribution]:
        """Distributions of the drawn factors on parts of the signal."""
        return self.cached("drawn", lambda: drawn_factors(self.processes, self.quiet))

    @property
    def integrates(self) -> bool:
        """Whether closed forms integrate over the drawn factors."""
        return bool(self.nuisances and self.drawn and not self.comparison.exposures)

    def cached(self, name: str, make: Callable[[], T], flare: Expectation | None = None) -> T:
        """Cache an expensive intermediate result, of a flare if it depends on one."""
        # The cached value holds the flare, so that no other object can get its identity.
        if (name, id(flare)) not in self._cache:
            self._cache[name, id(flare)] = flare, make()
        return cast("T", self._cache[name, id(flare)][1])


class DetectionForms(NamedTuple):
    """Distributions of a statistic without and with a flare for Gaussian noise, and its threshold."""

    null: Form
    flaring: Form
    threshold: float

    @property
    def probability(self) -> float:
        return self.flaring.sf(self.threshold)


@dataclass(frozen=True, eq=False)
class Differences:
    """Distribution of each pixel's difference from the quiescent star."""

    mean: Float  # DN, shape (n_pixel,)
    variance: Float  # true variance, DN^2, shape (n_pixel,)
    estimated: bool = False  # whether a statistic divides by the true variances instead of the model's
    # Standard deviations of normal amplitudes, DN, shape (k, n_pixel); None means the finite priors of the nuisances.
    scatter: Float | None = None


class Statistic(ABC):
    """A detection statistic without data, so that one object serves every detection.

    The argument `flare` of its methods is the template; statistics that are not `shaped` have none.
    """

    #: Name in studies, tables and flags.
    name: str
    #: Definition for users.
    definition: ClassVar[str]
    #: Label of axes in plots.
    label: ClassVar[str]
    #: Whether the statistic uses a flare as template, so that each flare has its own null distribution.
    shaped: ClassVar[bool] = False
    #: Whether the reference is always one noisy quiescent exposure, which excludes marginalising over unknowns.
    paired: ClassVar[bool] = False
    #: Whether the statistic uses sums over resolution elements instead of pixels.
    by_element: ClassVar[bool] = False

    def added_variance(self, setting: Setting) -> float:
        """Return the variance of the subtracted reference relative to that of one exposure."""
        return 1.0 if self.paired else setting.comparison.added_variance

    def variance(self, setting: Setting) -> Float:
        """Return the variance of each pixel's difference without a flare, DN^2, shape (n_pixel,)."""
        return np.asarray((1.0 + self.added_variance(setting)) * setting.quiet.variance_dn2)

    def check(self, setting: Setting) -> None:
        """Raise InputError if the statistic is undefined in this setting."""
        if setting.nuisances and (setting.comparison.estimated or self.paired):
            why = "which compares with one noisy exposure" if self.paired else "with estimated variances"
            raise InputError(
                f"statistic {self.name!r} {why} cannot be marginalised over {join_names(setting.nuisances.names)}; use "
                "no unknowns, as with `nuisances.usual=false`, or another statistic by the model's variances",
                key="statistic",
            )

    def closed_form(self, setting: Setting, observed: Expectation, flare: Expectation | None = None) -> Form:
        """Return the distribution for Gaussian noise (METHODS section 6).

        `observed` is the quiescent star for the null distribution, else a flare. Estimated variances are replaced by
        the true ones, which they equal on average. Nuisance parameters scatter as they are drawn, and so do the
        variances. Parameters that are not drawn scatter by their Gaussian priors, as do all parameters if noisy
        exposures are subtracted, since these share the factors of a realisation.
        """
        delta = np.where(setting.used, observed.recorded_light_dn - setting.quiet.recorded_light_dn, 0.0)
        true = observed.variance_dn2 + self.added_variance(setting) * setting.quiet.variance_dn2
        return self.integrate_drawn(setting, observed, Differences(delta, true, setting.comparison.estimated), flare)

    def detection_forms(self, setting: Setting, flare: Expectation, fap: float) -> DetectionForms:
        """Return the closed forms without and with a flare, and the threshold at a false-alarm probability."""
        template, quiet = flare if self.shaped else None, setting.quiet
        null = setting.cached(f"null of {self.name}", lambda: self.closed_form(setting, quiet, template), template)
        threshold = setting.cached(f"threshold of {self.name} at {fap!r}", lambda: null.isf(fap), template)
        return DetectionForms(null, self.closed_form(setting, flare, template), threshold)

    def integrate_drawn(
        self, setting: Setting, observed: Expectation, seen: Differences, flare: Expectation | None, *,
        priors: bool = True,
    ) -> Form:  # fmt: skip
        """Return `form` integrated over those nuisance parameters that are drawn.

        Without `priors`, nuisance parameters that are not drawn do not scatter.
        """
        if not setting.integrates:
            if not priors:
                seen = replace(seen, scatter=np.zeros((0, seen.mean.size)))
            return self.form(setting, seen, flare)
        assert setting.nuisances
        nodes = factor_nodes(setting.drawn, observed, weighted=isinstance(self, LinearStatistic))
        rows = nodes.spectra
        if priors:
            # Parameters that are not drawn keep their Gaussian priors.
            fixed = setting.nuisances.without(tuple(setting.drawn))
            rows = np.vstack([rows, fixed.finite(fixed.spectra)])
        means, variances = changes_of(observed)
        moved = Differences(seen.mean, seen.variance, scatter=rows)
        forms = self.moved_forms(setting, moved, nodes.amounts, means * setting.used, variances, flare)
        return forms[0] if len(forms) == 1 else Mixture(tuple(forms), nodes.probability)

    def moved_forms(
        self, setting: Setting, seen: Differences, amounts: Float, means: Float, variances: Float,
        flare: Expectation | None,
    ) -> Sequence[QuadraticForm | Gaussian]:  # fmt: skip
        """Return `form` for several amounts of changes of the means and variances.

        `amounts` has the shape (n, k), `means` and `variances` the shape (k, n_pixel).
        """
        moved = ((seen.mean + amount @ means, seen.variance + amount @ variances) for amount in amounts)
        return [self.form(setting, Differences(*moments, scatter=seen.scatter), flare) for moments in moved]

    @abstractmethod
    def dof(self, setting: Setting) -> int:
        """Return the degrees of freedom without a flare."""

    @abstractmethod
    def form(self, setting: Setting, seen: Differences, flare: Expectation | None = None) -> QuadraticForm | Gaussian:
        """Return the distribution for Gaussian differences."""

    @abstractmethod
    def values(self, setting: Setting, x: Float, variance: Float, flare: Expectation | None = None) -> Float:
        """Compute the statistic of differences, DN, divided by variances, DN^2, both (n, n_pixel), shape (n,)."""

    @abstractmethod
    def tilt(self, setting: Setting, flare: Expectation | None = None) -> tuple[Any, Float | None]:
        """Return the directions along which importance sampling shifts or stretches the noise, and their squares.

        The directions, dense or sparse and of the shape (n_direction, n_pixel), are orthonormal in standard deviations
        of each pixel's difference. A quadratic statistic has coefficients of squared standard normals along them.
        """


class LinearStatistic(Statistic):
    """A weighted sum of the differences, which is normal for Gaussian noise."""

    #: Whether the weights are scaled to unit variance without a flare.
    normalised: ClassVar[bool] = True

    @abstractmethod
    def plain_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        """Return the weights per DN without nuisance parameters, shape (n_pixel,); zero for unused pixels."""

    def weights_per_dn(self, setting: Setting, flare: Expectation | None = None) -> Float:
        """Return the weights per DN, shape (n_pixel,); zero for unused pixels.

        Plain weights w search for the spectrum V w. Marginalised weights are C^-1 V w (generalised least squares),
        which for the matched filter is C^-1 delta. Raises InputError if the nuisance spectra span V w.
        """
        return setting.cached(f"weights of {self.name}", lambda: self._weights_per_dn(setting, flare), flare)

    def _weights_per_dn(self, setting: Setting, flare: Expectation | None) -> Float:
        weights = self.plain_weights(setting, flare)
        if not setting.nuisances:
            return weights
        variance = self.variance(setting) * setting.used
        sought = variance * weights
        rows = setting.nuisances.rows(variance, setting.nuisances.spectra * setting.used)
        residual = weights - (rows @ sought) @ rows
        power = float(residual @ sought)
        if power <= 1e-10 * float(weights @ sought):
            used, n_pixel = int(np.count_nonzero(setting.used)), setting.used.size
            where = f" in the {used} of {n_pixel} pixels that are used" if used < n_pixel else ""
            raise InputError(
                f"the flare that {self.name!r} looks for cannot be distinguished from "
                f"{join_names(setting.nuisances.names)}{where}; use fewer unknowns or smaller standard deviations, "
                "such as `nuisances.usual=false`",
                key="statistic",
            )
        return np.asarray(residual / np.sqrt(power) if self.normalised else residual)

    def dof(self, setting: Setting) -> int:
        return 1

    def form(self, setting: Setting, seen: Differences, flare: Expectation | None = None) -> Gaussian:
        none = np.zeros((0, seen.mean.size))
        return self.moved_forms(setting, seen, np.zeros((1, 0)), none, none, flare)[0]

    def moved_forms(
        self, setting: Setting, seen: Differences, amounts: Float, means: Float, variances: Float,
        flare: Expectation | None,
    ) -> Sequence[Gaussian]:  # fmt: skip
        # The sums over pixels are linear in the amounts.
        weights, scatter = self.weights_per_dn(setting, flare), seen.scatter
        mean = weights @ seen.mean + amounts @ (means @ weights)
        variance = weights**2 @ seen.variance + amounts @ (variances @ weights**2)
        if scatter is None and setting.nuisances:
            scatter = setting.nuisances.finite(setting.nuisances.spectra)
        if scatter is not None:
            variance += np.sum((scatter @ weights) ** 2)
        spread = np.sqrt(variance)
        if seen.estimated:
            # In units of its standard deviation.
            mean, spread = mean / spread, np.ones(mean.size)
        return [Gaussian(*moments) for moments in zip(mean.tolist(), spread.tolist(), strict=True)]

    def values(self, setting: Setting, x: Float, variance: Float, flare: Expectation | None = None) -> Float:
        weights = self.weights_per_dn(setting, flare)
        total = x @ weights
        return np.asarray(total / np.sqrt(variance @ weights**2) if setting.comparison.estimated else total)

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> tuple[Any, None]:
        along = self.weights_per_dn(setting, flare) * np.sqrt(self.variance(setting))
        return (along / np.linalg.norm(along))[None], None


#: Range of `uv_excess`, nm.
UV_NM = (200.0, 360.0)


class Matched(LinearStatistic):
    """Matched filter with weights delta / v / sqrt(lambda), where delta is the flare and lambda = sum delta^2 / v.

    The statistic has unit variance without a flare and mean sqrt(lambda) with it. The variance v of the difference
    includes that of the subtracted reference.
    """

    name = "matched"
    definition: ClassVar[str] = "weighted sum with the flare's own shape as template, in standard deviations"
    label: ClassVar[str] = "matched filter (standard deviations)"
    shaped: ClassVar[bool] = True

    def plain_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        assert flare is not None
        delta = np.where(setting.used, flare.recorded_light_dn - setting.quiet.recorded_light_dn, 0.0)
        variance = self.variance(setting)
        strength = float(np.sqrt(np.sum(delta**2 / variance)))
        return np.asarray(delta / variance / (strength or 1.0))


class UvExcess(LinearStatistic):
    """Net counts in the ultraviolet divided by the noise of their sum."""

    name = "uv_excess"
    definition: ClassVar[str] = f"net counts from {UV_NM[0]:g} to {UV_NM[1]:g} nm, in standard deviations"
    label: ClassVar[str] = "UV excess (standard deviations)"

    def check(self, setting: Setting) -> None:
        super().check(setting)
        if not self._inside(setting).any():
            raise InputError(
                f"'uv_excess' needs used pixels at {UV_NM[0]:g}-{UV_NM[1]:g} nm, but {setting.quiet.name} has none",
                key="statistic",
            )

    def plain_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        inside = self._inside(setting)
        return np.asarray(inside / (np.sqrt(np.sum(self.variance(setting)[inside])) or 1.0))

    def _inside(self, setting: Setting) -> NDArray[np.bool_]:
        wavelength = setting.quiet.wavelength_nm
        return np.asarray(setting.used & (wavelength >= UV_NM[0]) & (wavelength <= UV_NM[1]))


@validated
@dataclass(frozen=True, eq=False)
class Linear(ContentEquality, LinearStatistic):
    """A user-defined statistic: the sum over pixels of weight times (observed - reference), DN of the exposure.

    Its `weights` per DN have the shape (n_pixel,); pixels that saturate in the reference are not used.
    """

    name: str
    weights: Float

    definition: ClassVar[str] = "user-defined weighted sum"
    label: ClassVar[str] = ""
    normalised: ClassVar[bool] = False

    def __post_init__(self) -> None:
        weights = np.array(self.weights, np.float64)
        object.__setattr__(self, "weights", weights)
        bad = int((~np.isfinite(weights)).sum())
        if weights.ndim != 1 or bad or not weights.any():
            raise InputError(
                f"statistic {self.name!r} must have one finite weight per pixel, not all zero, but has weights of the "
                f"shape {weights.shape}, {bad} of them not finite",
                key="weights",
            )

    def check(self, setting: Setting) -> None:
        super().check(setting)
        if self.weights.size != setting.used.size:
            raise InputError(
                f"statistic {self.name!r} must have {setting.used.size} weights, one for each pixel, not "
                f"{self.weights.size}",
                key="weights",
            )
        if not (self.weights * setting.used).any():
            raise InputError(
                f"statistic {self.name!r} weights only saturated pixels, but must weight others", key="weights"
            )

    def plain_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        return np.asarray(self.weights * setting.used)
