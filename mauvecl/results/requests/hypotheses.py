"""Null hypothesis and flares with their statistics, weights and closed forms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.expectation import Expectation
from mauvecl.noise.factor_distributions import FactorDistributions
from mauvecl.noise.scene import Scene
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.messages import Message
from mauvecl.statistics.distributions import Form
from mauvecl.statistics.linear import Linear, Matched
from mauvecl.statistics.nuisances import Nuisances
from mauvecl.statistics.registry import statistics_by_name
from mauvecl.statistics.statistic import LinearStatistic, Setting, Statistic

#: Standard deviations by which a flare lowers a weighted sum before it is reported; less is rounding.
LEAST_SHIFT = 1e-3


@validated
@dataclass(eq=False)
class Hypotheses:
    """The null hypothesis, the flares, and the statistics that distinguish them."""

    quiet: Expectation
    flares: tuple[Expectation, ...]
    asked: Sequence[str | Linear]  # requested statistics
    scene: Scene
    _: KW_ONLY
    nuisances: Nuisances | None = None  # parameters over which the statistics are marginalised
    statistics: tuple[str, ...] = field(init=False)  # names of the statistics
    setting: Setting = field(init=False, repr=False)
    _chosen: dict[str, Statistic] = field(init=False, repr=False)
    _forms: dict[tuple[str, int | None, int], Form] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        self._chosen = statistics_by_name(self.asked)
        self.statistics = tuple(self._chosen)
        drawn = FactorDistributions.of(self.scene) if self.nuisances else None
        self.setting = Setting(self.quiet, self.scene.used, self.scene.comparison, self.flares, self.nuisances, drawn)
        shaped = next((name for name, one in self._chosen.items() if one.shaped), None)
        if shaped is not None and not self.flares:
            raise InputError("no flare given", f"at least one for the statistic {shaped!r}", key="flares", value=shaped)
        if not self.scene.used.any():
            raise InputError(
                f"every pixel of {self.quiet.name} is saturated", "a fainter star", key="quiet", value=self.quiet.name
            )
        for one in self._chosen.values():
            one.check(self.setting)
        if "matched" in self._chosen:
            self._check_shapes()

    def _check_shapes(self) -> None:
        """Raise InputError for a flare without effect, unless it saturates every pixel, which `messages` report."""
        for k, flare in enumerate(self.flares):
            if k not in self.blinding:
                check_shape(self.quiet, flare, self.scene.used, k)

    def statistic(self, name: str) -> Statistic:
        """Return a statistic by name; raises InputError if it was not requested."""
        if name not in self._chosen:
            raise InputError.of("statistic", name, f"one of {', '.join(self.statistics)}")
        return self._chosen[name]

    def shape(self, statistic: str, template: int = 0) -> Expectation | None:
        """Return the flare that a shaped statistic uses as template; None for other statistics."""
        self._check(statistic, None, template)
        return self.flares[template] if self.statistic(statistic).shaped else None

    def weights(self, statistic: str, template: int = 0) -> NDArray[np.float64] | None:
        """Return the weights per DN of a linear statistic, shape (n_pixel,); None for others.

        Parameters
        ----------
        template : int
            Index of the flare that shaped statistics use as template.
        """
        one = self.statistic(statistic)
        return (
            one.weights_per_dn(self.setting, self.shape(statistic, template))
            if isinstance(one, LinearStatistic)
            else None
        )

    @cached_property
    def blinding(self) -> tuple[int, ...]:
        """Indices of flares that saturate every used pixel."""
        used = self.scene.used
        return tuple(k for k, x in enumerate(self.flares) if x.saturated[used].all())

    @property
    def messages(self) -> tuple[Message, ...]:
        """Remarks on saturating flares."""
        return tuple(
            Message(
                f"SATURATED: flare {k + 1} saturates every pixel of {self.quiet.name} that counts: what is recorded no "
                "longer depends on the flare, and no number is given.",
                "saturated",
            )
            for k in self.blinding
        )

    @cached_property
    def lowered(self) -> tuple[Message, ...]:
        """Sentences on weighted sums that a flare lowers, so that it is never detected however bright it is."""
        sentences = []
        for name in self.statistics:
            if not isinstance(self.statistic(name), LinearStatistic):
                continue
            for k, flare in enumerate(self.flares):
                falls = self.fall(name, k)
                if falls:
                    matched = Matched().closed_form(self.setting, flare, flare)
                    how = "marginalised over unknowns, " if self.nuisances else ""
                    text = (
                        f"WRONG SIGN: {how}{name} falls by {falls:.3g} standard deviations with flare {k + 1} of "
                        f"{self.quiet.name}, and only higher values are alarms: its detection probability says nothing "
                        f"of the flare, which matched has at {matched.mean / matched.std:.3g}."
                    )
                    sentences.append(Message(text, "wrong sign"))
        return tuple(sentences)

    def fall(self, statistic: str, flare: int) -> float:
        """Return the standard deviations by which a flare lowers a weighted sum, or 0 if it does not."""
        if flare in self.blinding or not isinstance(self.statistic(statistic), LinearStatistic):
            return 0.0
        return fall_between(self.closed_form(statistic, template=flare), self.closed_form(statistic, flare))

    def closed_form(self, statistic: str, flare: int | None = None, *, template: int = 0) -> Form:
        """Return a statistic's distribution for Gaussian noise; parameters as for `Detection.distribution`."""
        self._check(statistic, flare, template)
        # Only the nulls of shaped statistics depend on the template.
        key = statistic, flare, template if flare is None and self.statistic(statistic).shaped else 0
        if key not in self._forms:
            self._forms[key] = self._closed_form(statistic, flare, template)
        return self._forms[key]

    def _closed_form(self, statistic: str, flare: int | None, template: int) -> Form:
        observed = self.quiet if flare is None else self.flares[flare]
        looked_for = self.shape(statistic, template if flare is None else flare)
        return self.statistic(statistic).closed_form(self.setting, observed, looked_for)

    def dof(self, statistic: str) -> int:
        """Return the degrees of freedom without a flare: pixels, resolution elements, or one."""
        return self.statistic(statistic).dof(self.setting)

    def _check(self, statistic: str, flare: int | None, template: int = 0) -> None:
        if self.statistic(statistic).shaped and flare is None:
            flare = template
        if flare is not None and not 0 <= flare < len(self.flares):
            raise InputError.of("flare", flare, f"0 to {len(self.flares) - 1}")


def fall_between(null: Form, flare: Form) -> float:
    """Return the standard deviations by which a flare lowers the mean of a statistic, or 0 if it does not."""
    shift = (flare.mean - null.mean) / null.std
    return -shift if shift < -LEAST_SHIFT else 0.0


def check_shape(quiet: Expectation, flare: Expectation, used: NDArray[np.bool_], number: int = 0) -> None:
    """Raise InputError if a flare changes no used pixel, since it cannot be a template."""
    if not (flare.recorded_light_dn != quiet.recorded_light_dn)[used].any():
        raise InputError(
            f"flare {number + 1} of {quiet.name} changes no pixel that counts",
            "an amplitude above 0 for the statistic 'matched', which looks for its shape",
            key="amplitude",
            value=number + 1,
        )
