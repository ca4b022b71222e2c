"""Stars with and without flares as statistics see them: definitions, weights, closed forms. Nothing is counted here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.arguments import public
from mauvecl.host.errors import InputError
from mauvecl.host.expectation import Expectation
from mauvecl.noise.drawn import Drawn
from mauvecl.noise.scene import Scene
from mauvecl.statistics.distributions import Form
from mauvecl.statistics.linear import Linear
from mauvecl.statistics.nuisances import Nuisances
from mauvecl.statistics.registry import statistics_by_name
from mauvecl.statistics.statistic import LinearStatistic, Setting, Statistic


@public
@dataclass(eq=False)
class Hypotheses:
    """The null hypothesis, the flares, and what tells them apart.

    Attributes
    ----------
    quiet : Expectation
    flares : tuple of Expectation
    asked : sequence of str or Linear
        Statistics.
    scene : Scene
    nuisances : Nuisances, optional
        What the statistics are marginalised over.
    statistics : tuple of str
        Their names.

    Raises
    ------
    InputError
        For an unknown statistic, one that needs a flare where there is none, or a star that saturates every pixel.
    """

    quiet: Expectation
    flares: tuple[Expectation, ...]
    asked: Sequence[str | Linear]
    scene: Scene
    _: KW_ONLY
    nuisances: Nuisances | None = None
    statistics: tuple[str, ...] = field(init=False)
    setting: Setting = field(init=False, repr=False)
    _chosen: dict[str, Statistic] = field(init=False, repr=False)
    _forms: dict[tuple[str, int | None, int], Form] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._chosen = statistics_by_name(self.asked)
        self.statistics = tuple(self._chosen)
        drawn = Drawn.of(self.scene) if self.nuisances else None
        self.setting = Setting(self.quiet, self.scene.used, self.scene.comparison, self.flares, self.nuisances, drawn)
        shaped = next((name for name, one in self._chosen.items() if one.shaped), None)
        if shaped is not None and not self.flares:
            raise InputError(f"no flare given, expected at least one for the statistic {shaped!r}")
        if not self.scene.used.any():
            raise InputError(f"every pixel of {self.quiet.name} is saturated, expected a fainter star")
        for one in self._chosen.values():
            one.check(self.setting)
        if "matched" in self._chosen:
            self._check_shapes()

    def _check_shapes(self) -> None:
        """A flare that changes nothing has no shape to look for; one that saturates every pixel is told of."""
        for k, flare in enumerate(self.flares):
            if k not in self.blinding:
                check_shape(self.quiet, flare, self.scene.used, k)

    def statistic(self, name: str) -> Statistic:
        """One of those computed.

        Raises
        ------
        InputError
            If it was not.
        """
        if name not in self._chosen:
            raise InputError(f"statistic {name!r} was not simulated, expected one of {', '.join(self.statistics)}")
        return self._chosen[name]

    def shape(self, statistic: str, template: int = 0) -> Expectation | None:
        """The flare whose shape a statistic looks for; None for those that look for none."""
        self._check(statistic, None, template)
        return self.flares[template] if self.statistic(statistic).shaped else None

    def weights(self, statistic: str, template: int = 0) -> NDArray[np.float64] | None:
        """Weights per DN of a linear statistic, shape (n_pixel,); None for the others.

        Parameters
        ----------
        statistic : str
        template : int
            For shaped statistics: the flare whose shape is looked for.
        """
        one = self.statistic(statistic)
        return (
            one.weights_per_dn(self.setting, self.shape(statistic, template))
            if isinstance(one, LinearStatistic)
            else None
        )

    @cached_property
    def blinding(self) -> tuple[int, ...]:
        """Flares that saturate every pixel that counts."""
        used = self.scene.used
        return tuple(k for k, x in enumerate(self.flares) if x.saturated[used].all())

    @property
    def messages(self) -> tuple[str, ...]:
        """What the reader must be told of these flares."""
        return tuple(
            f"SATURATED: flare {k + 1} saturates every pixel of {self.quiet.name} that counts: what is recorded no "
            "longer depends on the flare, and no number is given."
            for k in self.blinding
        )

    def closed_form(self, statistic: str, flare: int | None = None, *, template: int = 0) -> Form:
        """A statistic's distribution for Gaussian noise; parameters as for `Detection.distribution`."""
        self._check(statistic, flare, template)
        # Only the null of what looks for a shape depends on whose shape that is.
        key = statistic, flare, template if flare is None and self.statistic(statistic).shaped else 0
        if key not in self._forms:
            self._forms[key] = self._closed_form(statistic, flare, template)
        return self._forms[key]

    def _closed_form(self, statistic: str, flare: int | None, template: int) -> Form:
        observed = self.quiet if flare is None else self.flares[flare]
        looked_for = self.shape(statistic, template if flare is None else flare)
        return self.statistic(statistic).closed_form(self.setting, observed, looked_for)

    def dof(self, statistic: str) -> int:
        """Degrees of freedom without a flare: pixels, resolution elements, or one."""
        return self.statistic(statistic).dof(self.setting)

    def _check(self, statistic: str, flare: int | None, template: int = 0) -> None:
        if self.statistic(statistic).shaped and flare is None:
            flare = template
        if flare is not None and not 0 <= flare < len(self.flares):
            raise InputError(f"flare = {flare}, expected 0 to {len(self.flares) - 1}")


def check_shape(quiet: Expectation, flare: Expectation, used: NDArray[np.bool_], number: int = 0) -> None:
    """Refuse a flare that changes no pixel that counts: it has no shape to look for.

    Raises
    ------
    InputError
    """
    if not (flare.recorded_light_dn != quiet.recorded_light_dn)[used].any():
        raise InputError(
            f"flare {number + 1} of {quiet.name} changes no pixel that counts, expected an amplitude above 0 for the "
            "statistic 'matched', which looks for its shape"
        )
