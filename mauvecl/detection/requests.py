"""Requests to an engine as plain data: statistics by name, hypotheses, channels and shards.

Every worker computes the same result from a request. The counts of a shard are integers, and its extreme values carry
their realisations, so shards can be counted in any order, on any device, and more than once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields
from functools import cached_property
from itertools import product
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection import DEFAULT_STATISTICS, Tails, check_statistic
from mauvecl.detection.chi2 import Chi2, Chi2Element, Chi2Pair, Paper
from mauvecl.detection.counts import TailSamples, Tally, grids_of
from mauvecl.detection.distributions import Form
from mauvecl.detection.nuisances import Nuisances
from mauvecl.detection.statistics import Linear, LinearStatistic, Matched, Setting, Statistic, UvExcess
from mauvecl.host.arrays import Float
from mauvecl.host.exposure.expectation import Expectation, entirely_saturated
from mauvecl.noise.drawing import AUTOMATIC, Drawing, DrawingOptions
from mauvecl.noise.layout import FIXED_STATISTICS
from mauvecl.noise.scene import BATCH, Scene, prepare
from mauvecl.noise.unknowns import NOISE_FREE, Comparison
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, Message
from mauvecl.schema.fields import FirstRealisation, OneOrMore, Realisations, Seed

#: All statistics in the order of tables and plots; add a new one here.
STATISTICS: dict[str, Statistic] = {
    statistic.name: statistic for statistic in (Chi2(), Chi2Element(), Chi2Pair(), Matched(), UvExcess(), Paper())
}


def statistic_label(name: str) -> str:
    """Return the axis label of a statistic; that of a user-defined one is its name."""
    return STATISTICS[name].label if name in STATISTICS else name


@validated
@dataclass(eq=False)
class Hypotheses:
    """The null hypothesis, the flares, and the statistics that distinguish them."""

    quiet: Expectation
    flares: tuple[Expectation, ...]
    requested: Sequence[str | Linear]  # names of statistics, and user-defined ones
    scene: Scene
    _: KW_ONLY
    nuisances: Nuisances | None = None  # parameters over which the statistics are marginalised
    statistics: tuple[str, ...] = field(init=False)  # names of the statistics
    setting: Setting = field(init=False, repr=False)
    _chosen: dict[str, Statistic] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._chosen = {}
        for statistic in self.requested:
            if isinstance(statistic, str):
                check_statistic(statistic)
                self._chosen[statistic] = STATISTICS[statistic]
            elif statistic.name in STATISTICS:
                raise InputError(f"statistic {statistic.name!r} is mauvecl's own; use another name", key="statistics")
            elif statistic.name in self._chosen:
                raise InputError.of("statistics", statistic.name, "different names")
            else:
                self._chosen[statistic.name] = statistic
        if not self._chosen:
            raise InputError(f"no statistic is named; give some of {', '.join(STATISTICS)}", key="statistics")
        self.statistics = tuple(self._chosen)
        scene = self.scene
        self.setting = Setting(self.quiet, scene.used, scene.comparison, self.flares, self.nuisances, scene.processes)
        shaped = [name for name, kind in self._chosen.items() if kind.shaped]
        if shaped and not self.flares:
            raise InputError(f"the statistic {shaped[0]!r} needs at least one flare, but none is given", key="flares")
        if not scene.used.any():
            raise entirely_saturated(self.quiet, "quiet")
        for kind in self._chosen.values():
            kind.check(self.setting)
        for k, flare in enumerate(self.flares if "matched" in self._chosen else ()):
            # `messages` report a flare that saturates every pixel.
            if k not in self.blinding:
                check_template(self.quiet, flare, scene.used, k)

    def statistic(self, name: str) -> Statistic:
        """Return a statistic by name; raises InputError if it was not requested."""
        if name not in self._chosen:
            raise InputError.of("statistic", name, f"one of {', '.join(self.statistics)}")
        return self._chosen[name]

    def shape(self, statistic: str, template: int = 0) -> Expectation | None:
        """Return the flare that a shaped statistic uses as template; None for other statistics."""
        self._check(statistic, None, template)
        return self.flares[template] if self.statistic(statistic).shaped else None

    def weights(self, statistic: str, template: int = 0) -> Float | None:
        """Return the weights per DN of a linear statistic, shape (n_pixel,), with a flare as template; else None."""
        kind = self.statistic(statistic)
        if not isinstance(kind, LinearStatistic):
            return None
        return kind.weights_per_dn(self.setting, self.shape(statistic, template))

    @cached_property
    def blinding(self) -> tuple[int, ...]:
        """Indices of flares that saturate every used pixel."""
        used = self.scene.used
        return tuple(k for k, x in enumerate(self.flares) if x.saturated[used].all())

    @property
    def messages(self) -> tuple[Message, ...]:
        """Remarks on saturating flares."""
        text = (
            f"saturates every pixel of {self.quiet.name} that counts: what is recorded no longer depends on the flare, "
            "and no number is given."
        )
        return tuple(Message(f"SATURATED: flare {k + 1} {text}", "saturated") for k in self.blinding)

    @cached_property
    def lowered(self) -> tuple[Message, ...]:
        """Sentences on weighted sums that a flare lowers, so that it is never detected however bright it is."""
        sentences, treatment = [], "marginalised over unknowns, " if self.nuisances else ""
        for name, k in product(self.statistics, range(len(self.flares))):
            if falls := self.fall(name, k):
                snr = matched_snr(self.setting, self.flares[k])
                sentences.append(Message(
                    f"WRONG SIGN: {treatment}{name} falls by {falls:.3g} standard deviations with flare {k + 1} of "
                    f"{self.quiet.name}, and only higher values are alarms: its detection probability says nothing "
                    f"about the flare, whose matched S/N is {snr:.3g}.", "wrong sign",
                ))  # fmt: skip
        return tuple(sentences)

    def fall(self, statistic: str, flare: int) -> float:
        """Return the standard deviations by which a flare lowers a weighted sum, or 0 if it does not."""
        if flare in self.blinding or not isinstance(self.statistic(statistic), LinearStatistic):
            return 0.0
        return fall_between(self.closed_form(statistic, template=flare), self.closed_form(statistic, flare))

    def closed_form(self, statistic: str, flare: int | None = None, *, template: int = 0) -> Form:
        """Return a statistic's distribution for Gaussian noise; parameters as for `Detection.distribution`."""
        self._check(statistic, flare, template)
        observed = self.quiet if flare is None else self.flares[flare]
        # Only the nulls of shaped statistics depend on the template.
        shape = self.shape(statistic, template if flare is None else flare)
        kind, name = self.statistic(statistic), f"form of {statistic} with flare {flare}"
        return self.setting.cached(name, lambda: kind.closed_form(self.setting, observed, shape), shape)

    def dof(self, statistic: str) -> int:
        """Return the degrees of freedom without a flare: pixels, resolution elements, or one."""
        return self.statistic(statistic).dof(self.setting)

    def _check(self, statistic: str, flare: int | None, template: int = 0) -> None:
        """Raise InputError unless the statistic was requested and the flare, or the template that it needs, exists."""
        if self.statistic(statistic).shaped and flare is None:
            flare = template
        if flare is not None and not 0 <= flare < len(self.flares):
            raise InputError.of("flare", flare, f"between 0 and {len(self.flares) - 1}")


def shift_between(null: Form, flare: Form) -> float:
    """Return the change of a statistic's mean by a flare, in standard deviations without it."""
    return (flare.mean - null.mean) / null.std


def matched_snr(setting: Setting, flare: Expectation) -> float:
    """Return the change of the mean of `matched` by a flare, in standard deviations without it."""
    return shift_between(*(Matched().closed_form(setting, x, flare) for x in (setting.quiet, flare)))


def fall_between(null: Form, flare: Form) -> float:
    """Return the standard deviations by which a flare lowers the mean of a statistic, or 0 if it does not."""
    shift = shift_between(null, flare)
    # Less than a thousandth is rounding.
    return -shift if shift < -1e-3 else 0.0


def check_template(quiet: Expectation, flare: Expectation, used: NDArray[np.bool_], number: int = 0) -> None:
    """Raise InputError if a flare changes no used pixel, since it cannot be a template."""
    if not (flare.recorded_light_dn != quiet.recorded_light_dn)[used].any():
        raise InputError(
            f"flare {number + 1} of {quiet.name} changes no pixel that counts; the statistic 'matched', which looks "
            "for its shape, needs an amplitude above 0",
            key="amplitude",
        )


#: Distributions: without a flare, with a flare in the bins of the null, with a flare in bins around its mean.
Role = Literal["null", "flare_on_null_grid", "flare"]
Key = tuple[str, Role, int]


@dataclass(frozen=True)
class ChannelPlan:
    """Channels that a launch computes for a batch of flares."""

    hypotheses: Hypotheses
    scene: Scene  # the quiescent star and the flares of the batch
    weights: NDArray[np.float32]  # shape (n_linear, n_padded)
    linear_end: NDArray[np.uint32]  # one past the last linear statistic of each scenario, shape (n_scenario,)
    # One past the last linear statistic with weights per pixel, shape (n_scenario,). Later ones have weights per
    # resolution element, stored at the element's last pixel.
    pixels_end: NDArray[np.uint32]
    scales: NDArray[np.float32]  # of the statistic `paper` (see `Smoothing`), shape (n_smoothed, n_centre)
    scale_end: NDArray[np.uint32]  # one past the last smoothed statistic of each scenario, shape (n_scenario,)
    grids: NDArray[np.void]  # layout.GRID, shape (n_grid,)
    keys: list[Key]  # distribution that each grid counts
    # Row of chi-squared, and first and one past the last row whose squares are subtracted from it, shape (3, n).
    subtractions: NDArray[np.uint32]

    def tally(self) -> Tally:
        """Return the empty tally of the grids, with the largest values of nulls and the smallest of flares."""
        roles = {index: role for index, (_, role, _) in enumerate(self.keys) if role != "flare_on_null_grid"}
        return Tally(self.grids, {index: TailSamples(largest=role == "null") for index, role in roles.items()})

    @property
    def n_rows(self) -> int:
        """Number of channels."""
        return len(FIXED_STATISTICS) * len(self.linear_end) + len(self.weights) + len(self.scales)


#: Rows of weights by statistic, scenario, and template (of chi-squared, the number of the row), ordered by scenario.
Rows = dict[tuple[str, int, int], Float]


def _rows(
    hypotheses: Hypotheses, statistics: Sequence[Statistic], batch: range
) -> tuple[Rows, Rows, NDArray[np.uint32]]:
    """Return the weights of sums, and the scales of the paper's statistic, in the kernel's order, and ends of rows.

    The ends are those of linear rows, of those with weights per pixel, and of smoothed rows, shape (3, n_scenario).
    """
    weighted, smoothed, ends = Rows(), Rows(), []
    for scenario in range(1 + len(batch)):
        # Quiescent draws are compared with every flare's template, draws of a flare only with its own.
        shapes = [flare for i, flare in enumerate(batch) if scenario in (0, i + 1)]
        of_pixels = len(weighted)
        # Shaped statistics come first, since the kernel fuses the first row, and sums over elements last.
        for statistic in sorted(statistics, key=lambda s: (s.by_element, not s.shaped)):
            name, setting = statistic.name, hypotheses.setting
            for flare in shapes if statistic.shaped else [0]:
                shape = hypotheses.shape(name, flare)
                if isinstance(statistic, LinearStatistic):
                    weighted[name, scenario, flare] = statistic.weights_per_dn(setting, shape)
                elif isinstance(statistic, Chi2):
                    weighted |= {(name, scenario, k): row for k, row in enumerate(statistic.subtracted_rows(setting))}
                elif isinstance(statistic, Paper):
                    smoothed[name, scenario, flare] = statistic.scale(setting, shape)
            of_pixels = of_pixels if statistic.by_element else len(weighted)
        ends.append((len(weighted), of_pixels, len(smoothed)))
    return weighted, smoothed, np.array(ends, np.uint32).T.copy()


def plan_channels(hypotheses: Hypotheses, batch: range) -> ChannelPlan:
    """Plan the channels of a batch of flares; scenario 0 is always the quiescent one.

    The first batch also counts the null distributions that all batches share.
    """
    statistics = [hypotheses.statistic(name) for name in hypotheses.statistics]
    weighted, smoothed, (linear_end, pixels_end, scale_end) = _rows(hypotheses, statistics, batch)
    n_scenario, fixed = 1 + len(batch), len(FIXED_STATISTICS)
    channels = {key: fixed * n_scenario + number for number, key in enumerate([*weighted, *smoothed])}

    def channel_of(statistic: Statistic, scenario: int, flare: int) -> int:
        if statistic.name in FIXED_STATISTICS:
            return fixed * scenario + FIXED_STATISTICS.index(statistic.name)
        return channels[statistic.name, scenario, flare if statistic.shaped else 0]

    subtractions: list[tuple[int, int, int]] = []
    if hypotheses.nuisances:
        sums = [statistic for statistic in statistics if isinstance(statistic, Chi2)]
        for chi2, scenario in product(sums, range(n_scenario)):
            begin = channels[chi2.name, scenario, 0]
            subtractions.append((channel_of(chi2, scenario, 0), begin, begin + len(hypotheses.nuisances.names)))
    counted: list[tuple[Key, int, Form]] = []
    for statistic in statistics:
        name = statistic.name
        if batch.start == 0 and not statistic.shaped:
            counted.append(((name, "null", 0), channel_of(statistic, 0, 0), hypotheses.closed_form(name)))
        for i, flare in enumerate(batch):
            null = hypotheses.closed_form(name, template=flare)
            if statistic.shaped:
                counted.append(((name, "null", flare), channel_of(statistic, 0, flare), null))
            channel = channel_of(statistic, i + 1, flare)
            counted.append(((name, "flare_on_null_grid", flare), channel, null))
            counted.append(((name, "flare", flare), channel, hypotheses.closed_form(name, flare)))
    keys, of_grids, forms = zip(*counted, strict=True)
    scene = hypotheses.scene.part([0, *(k + 1 for k in batch)])
    weights = np.zeros((len(weighted), len(scene.pixels)), np.float32)
    weights[:, : scene.n_pixel] = np.reshape([*weighted.values()], (len(weighted), scene.n_pixel))
    scales = np.array([*smoothed.values()], np.float32) if smoothed else np.zeros((0, 1), np.float32)
    return ChannelPlan(
        hypotheses, scene, weights, linear_end, pixels_end, scales, scale_end,
        grids=grids_of(of_grids, [form.mean for form in forms], [form.std for form in forms]), keys=[*keys],
        subtractions=np.array(subtractions, np.uint32).reshape(len(subtractions), 3).T,
    )  # fmt: skip


@dataclass(frozen=True)
class Shard:
    """Range of realisations, `start` to `start + count - 1`, of one part of a request."""

    part: int
    start: int
    count: int

    @property
    def name(self) -> str:
        """Name in files."""
        return f"{self.part}-{self.start}-{self.count}"

    def __str__(self) -> str:
        return f"realisations {self.start} to {self.start + self.count - 1}"


def check_last(start: int, realisations: int) -> None:
    """Raise InputError if the last realisation has no number of 63 bits."""
    if start + realisations >= 2**63:
        raise InputError.of("start", start, f"at most {2**63 - 1 - realisations} for {realisations} realisations")


class ShardedRequest:
    """Base class of requests, which are divided into shards, and pickled without cached results."""

    #: Smallest number of realisations of a shard, a power of two.
    least: ClassVar[int] = 2**12

    realisations: int
    start: int

    @property
    def parts(self) -> int:
        """Number of parts, whose launches differ."""
        return 1

    @property
    def work(self) -> int:
        """Approximate work per realisation: pixels times scenarios."""
        raise NotImplementedError

    @classmethod
    def of(cls, *arguments: Any, **keywords: Any) -> Self:
        """Make a request from keywords that may include the fields of a `Drawing`."""
        options = {name: keywords.pop(name) for name in DrawingOptions.__annotations__ if name in keywords}
        return cls(*arguments, **keywords | {"drawing": Drawing(**options)})

    def __post_init__(self) -> None:
        check_last(self.start, self.realisations)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle: request fields only, no caches."""
        return {row.name: getattr(self, row.name) for row in fields(self)}  # type: ignore[arg-type]


@validated
@dataclass(frozen=True, eq=False)
class DetectRequest(ShardedRequest):
    """Arguments of `Engine.detect`."""

    quiet: Expectation
    flares: Annotated[tuple[Expectation, ...], OneOrMore((Expectation,))]
    realisations: Realisations
    seed: Seed
    statistics: Annotated[Sequence[str | Linear], OneOrMore((str, Linear))] = DEFAULT_STATISTICS
    start: FirstRealisation = 0
    drawing: Drawing = AUTOMATIC
    comparison: Comparison = NOISE_FREE
    tails: Tails = "counted"
    nuisances: Nuisances | Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.nuisances, Mapping):
            unknown = Nuisances.of(self.quiet, self.nuisances) if self.nuisances else None
            object.__setattr__(self, "nuisances", unknown)

    @cached_property
    def hypotheses(self) -> Hypotheses:
        """Scene and statistics of the request."""
        scene = prepare([self.quiet, *self.flares], self.drawing, comparison=self.comparison)
        assert not isinstance(self.nuisances, Mapping)
        return Hypotheses(self.quiet, self.flares, self.statistics, scene, nuisances=self.nuisances)

    @cached_property
    def plans(self) -> list[ChannelPlan]:
        """Channels of each part, with as many flares as a launch can process."""
        count, size = len(self.flares), BATCH[self.hypotheses.scene.frames] - 1
        batches = [range(i, min(i + size, count)) for i in range(0, max(count, 1), size)]
        return [plan_channels(self.hypotheses, batch) for batch in batches]

    @property
    def parts(self) -> int:
        return len(self.plans)

    @property
    def work(self) -> int:
        return self.hypotheses.scene.n_pixel * max(len(plan.scene.levels) for plan in self.plans)


@validated
@dataclass(frozen=True, eq=False)
class RealiseRequest(ShardedRequest):
    """Arguments of `Engine.realise`, computed as a single shard, so callers limit the number of realisations."""

    expectation: Expectation
    realisations: Realisations
    seed: Seed
    start: FirstRealisation = 0
    drawing: Drawing = AUTOMATIC


@validated
@dataclass(frozen=True, eq=False)
class SnrRequest(RealiseRequest):
    """Arguments of `Engine.snr`."""

    @cached_property
    def scene(self) -> Scene:
        """Scene to draw."""
        return prepare([self.expectation], self.drawing)

    @property
    def work(self) -> int:
        return self.scene.n_pixel
