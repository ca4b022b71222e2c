"""Limit of a quantity: the value at which a flare is detected with a given probability."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from threading import Lock
from typing import TYPE_CHECKING, Any, ClassVar

from mauvecl.answers.answer import Answer
from mauvecl.answers.detection.unknown_cost import Cost, cost_lines, marginal_lines, unknown_cost
from mauvecl.answers.limits.assumptions import assumption_columns
from mauvecl.answers.limits.search import LimitSearch, MarginalLimitSearch, Point, Unknown, settle, single_flares
from mauvecl.answers.neighbour_list import share_columns
from mauvecl.detection.distributions import Interval
from mauvecl.detection.fap_checks import check_fap
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.messages import Message, of_kind
from mauvecl.schema.tables import INTERVAL, Column, View, interval, records, table_of
from mauvecl.study.cases import Case, cases
from mauvecl.study.labels import amplitude_column, label, place_columns
from mauvecl.study.messages import SATURATED, collect_messages, worst_first
from mauvecl.study.quantities import UNITS
from mauvecl.study.study import Study
from mauvecl.study.unknowns import describe_shares, draw_columns

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.device.engine import Engine
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool
    from mauvecl.study.assumptions import Use


#: Steps in which the progress of a limit is reported, since its number of simulations is not known beforehand.
STEPS = 100


@dataclass(frozen=True)
class Limit:
    """Limit of a quantity."""

    star: str
    amplitude: float  # amplitude of the flare; NaN if the amplitude is the limit
    of: str
    statistic: str
    fap: float
    power: float
    value: Interval  # limit with its 95 % interval, including that of the threshold
    closed_form: float  # limit for Gaussian noise
    check: Point  # detection probability at the value, simulated again with another seed
    points: tuple[Point, ...]  # simulations of the search
    curve: tuple[tuple[float, float], ...]  # the closed form around the limit
    at: Mapping[str, float | str] = field(default_factory=dict)  # sweep values
    unknown: Unknown | None = None  # for limits averaged over unknown instrument values
    messages: tuple[str, ...] = ()  # saturation at the limit, without and with the flare
    cost: Cost | None = None  # loss of S/N to unknowns at the limit
    # The star at the limit, without the flare.
    quiet: Expectation | None = field(default=None, compare=False, repr=False)

    @property
    def agrees(self) -> bool:
        """True if the 95 % interval of the second simulation contains the power."""
        p = self.check.probability
        return p.low <= self.power <= p.high

    @property
    def verdict(self) -> str:
        """Verdict of the second simulation on the limit.

        It is "confirms it" if its interval contains the power, "exceeds it" if exposures of whole frames have more
        power, and "DIFFERS" if the interval misses the power by more than its width. It is empty in between, which
        happens by chance for one limit in six.
        """
        p = self.check.probability
        if self.agrees:
            return "confirms it"
        if self.of == "exposure" and p.low > self.power:
            return "exceeds it"
        away = max(p.low - self.power, self.power - p.high)
        return "DIFFERS" if away > p.high - p.low else ""


@dataclass(eq=False)
class LimitAnswer(Answer):
    """Answer of `limit`.

    Attributes
    ----------
    study : Study
    limits : list of Limit
    assumptions : QTable, optional
        Change of the limits with assumptions about the instrument (`assumptions.what_matters`).
    failed : tuple of str
        Reasons for missing limits.
    """

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "flare", "processes", "nuisances", "values", "seed")

    study: Study
    limits: list[Limit] = field(default_factory=list)
    assumptions: QTable | None = None
    failed: tuple[str, ...] = ()

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of the table of limits."""
        of = self.study.limit.of
        unit, digits = UNITS.get(of, ""), {"magnitude": ".3f", "amplitude": ".4g", "exposure": ".0f"}[of]
        check = "detection probability there, with a fresh seed"
        columns = (
            *self._place,
            *share_columns(self.study.has_neighbours, "quiet.target_share"),
            Column(of, "value.value", unit, "where the flare is detected with the wanted probability",
                   "exposure (s)" if of == "exposure" else of, digits),
            Column("low", "value.low", unit, "its 95 % interval, lower end, with the threshold's own", INTERVAL,
                   interval(digits), ("high",)),
            Column("high", "value.high", unit, "its 95 % interval, upper end, with the threshold's own"),
            Column("closed_form", "", unit, "the same for Gaussian noise", "closed form", digits),
            Column("check", "check.probability.value", "", check, "detected there, simulated again", ".4f"),
            Column("check_low", "check.probability.low", "", f"{check}; 95 % interval, lower end", INTERVAL,
                   interval(".4f"), ("check_high",)),
            Column("check_high", "check.probability.high", "", f"{check}; 95 % interval, higher end"),
        )  # fmt: skip
        if not self.study.unknowns.draws:
            return columns
        return (
            *columns,
            Column("unknown_low", lambda one: one.unknown.range[0],
                   description="central 95 % of the limits over what is unknown, lower end", heading="95 % of limits",
                   format=lambda low, high: f"{low:{digits}} to {high:{digits}}", others=("unknown_high",)),
            Column("unknown_high", lambda one: one.unknown.range[1],
                   description="central 95 % of the limits over what is unknown, upper end"),
            Column("matters_most", lambda one: next(iter(one.unknown.shares)),
                   description="unknown that explains most of the limits' variance"),
            Column("its_share", lambda one: next(iter(one.unknown.shares.values())),
                   description="share of the limits' variance that this unknown explains"),
        )  # fmt: skip

    @property
    def _place(self) -> tuple[Column, ...]:
        """Columns of star, sweep, flare and statistic."""
        amplitude = () if self.study.limit.of == "amplitude" else (amplitude_column(),)
        statistic = Column("statistic", description="detection statistic", heading="statistic")
        return (*place_columns(self.study.sweep, "amplitude", star="star"), *amplitude, statistic)

    @property
    def table(self) -> QTable:
        """One row per star, flare and statistic."""
        run = {"fap": self.study.run.fap, "realisations": self.study.run.realisations}
        return table_of(self.columns, self.limits, power=self.study.limit.power, **run, study=self.study.text())

    @property
    def draws(self) -> QTable:
        """One row per limit and draw of the unknown: its values and the closed-form limit."""
        of = self.study.limit.of
        drawn = (one.unknown.draws for one in self.limits if one.unknown is not None)
        limit = Column(of, "unknown.limits", description="closed-form limit")
        values = (column.of(attrgetter("unknown")) for column in draw_columns(next(drawn)))
        return table_of((*self._place, *values, limit), self.limits, study=self.study.text())

    @property
    def views(self) -> list[View]:
        of, run, draws = self.study.limit.of, self.study.run, self.study.unknowns.draws
        verdict = Column("verdict", heading="verdict")
        columns = (*(column for column in self.columns if column.name != "unknown_low"), verdict)
        title = (
            f"Limit of {of} at a detection probability of {self.study.limit.power:g}, false-alarm probability "
            f"{run.fap:g} per test, {run.realisations:,} realisations"
        )
        views = [View(title, columns, table_of(columns, self.limits))]
        if draws:
            shares = Column("shares", lambda one: describe_shares(one.unknown.shares),
                            heading="matters most, share of the variance")  # fmt: skip
            title = f"Averaged over {draws} draws of what is unknown of the instrument: the limits of each, and what "
            found = (column for column in self.columns if column.name.startswith("unknown"))
            columns = (*self._place, *found, shares)
            views.append(View(f"{title}explains their scatter", columns, table_of(columns, self.limits)))
        if self.assumptions is not None:
            title = f"What is assumed, and how far it moves the closed-form limit of {of}, the largest first"
            views.append(View(title, assumption_columns(of), self.assumptions))
        return views

    @property
    def tables(self) -> dict[str, Table]:
        """Tables of the limits and, if requested, of draws of unknowns and of assumptions."""
        more = {"unknowns": self.draws} if self.study.unknowns.draws else {}
        return {"limit": self.table} | more | ({} if self.assumptions is None else {"assumptions": self.assumptions})

    @cached_property
    def inputs(self) -> list[Expectation]:
        """Each star at its limits."""
        return [one.quiet for one in self.limits if one.quiet is not None]

    @property
    def messages(self) -> list[str]:
        """Messages about failed limits, the stars, and unknowns."""
        stars = worst_first(
            [
                *(text for one in self.limits for text in one.messages),
                *collect_messages(self.inputs, self.study.processes),
            ]
        )
        costs = [one.cost for one in self.limits if one.cost is not None]
        failed = [Message(f"NO LIMIT: {text}.", "no limit") for text in self.failed]
        return [*failed, *stars, *marginal_lines(self.study.nuisances), *cost_lines(costs, self.study.nuisances)]

    def as_json(self) -> dict[str, Any]:
        more = {} if self.assumptions is None else {"assumptions": records(self.assumptions)}
        return super().as_json() | more


def solve(case: Case, statistic: str, engine: Engine | Pool, report: Callable[[int], None] | None = None) -> Limit:
    """Return the limit of a case's first flare, or of its amplitude, and simulate it again with another seed.

    Averages over draws of unknown instrument values if the study has some. Raises InputError if the power is not
    crossed in the searched range, or too few realisations lie beyond the threshold. Calls `report` with the number of
    simulations after each of them.
    """
    study = case.study
    check_fap(study.run.fap, study.run.realisations, study.run.tails)
    kind = MarginalLimitSearch if study.unknowns.draws else LimitSearch
    question = kind(case, statistic, engine, report)
    # The root of the nominal instrument is near and found quickly.
    theory = question.root(near=LimitSearch(case, statistic).root() if study.unknowns.draws else None)
    value = settle(question, theory)
    simulated = tuple(question.points)
    # Users are unlikely to choose a seed with this distance from another.
    fresh = (study.run.seed + 0x9E3779B97F4A7C15) % 2**64
    check = Point(value.value, question.simulated(value.value, fresh), fresh)
    quiet, flare = question.pair(value.value)
    named = case.star.model_copy(update={"magnitude": None}) if question.of == "magnitude" else case.star
    rise = value.value if question.of == "amplitude" else case.amplitudes[0]
    there = f"exposure {value.value:.0f} s" if question.of == "exposure" else f"{question.of} {value.value:.4g}"
    where = f"{label(named, quiet)} at {there}, flare of {100 * rise:.4g} %"
    return Limit(
        star=label(named, quiet),
        amplitude=float("nan") if question.of == "amplitude" else case.amplitudes[0],
        of=question.of,
        statistic=statistic,
        fap=question.fap,
        power=question.power,
        value=value,
        closed_form=theory,
        check=check,
        points=simulated,
        curve=question.curve(value.value),
        at=case.at,
        unknown=question.unknown(theory) if isinstance(question, MarginalLimitSearch) else None,
        messages=tuple(of_kind(collect_messages([quiet, flare]), SATURATED)),
        quiet=quiet,
        cost=unknown_cost(where, quiet, flare, study.nuisances, study.run.comparison()),
    )


@validated
def limit(
    study: Study, engine: Engine | Pool | None = None, progress: Callable[[int, int], None] | None = None
) -> LimitAnswer:
    """Compute the limits of a study's stars and flares, by every statistic.

    Parameters
    ----------
    study : Study
        Its ``limit`` defines the quantity (magnitude, amplitude or exposure) and the power.
    engine : Engine or Pool, optional
    progress : callable, optional
        Called as ``progress(done, total)`` in steps, `STEPS` for each limit.

    Raises
    ------
    InputError
        As for `solve`, if all limits fail; otherwise see `LimitAnswer.failed`.
    """
    from mauvecl.device.engine import Engine as Default
    from mauvecl.runs.pool import map_in_order

    engine = engine or Default()
    result = LimitAnswer(study)
    if any(axis.quantity == study.limit.of for axis in study.sweep.axes):
        raise InputError(
            f"the sweep runs over the {study.limit.of}, of which the limit is requested",
            "other quantities",
            key="sweep",
            value=study.limit.of,
        )
    asked = [
        (one, statistic) for case in cases(study) for one in single_flares(case) for statistic in study.run.statistics
    ]

    steps, lock = [0] * len(asked), Lock()

    def report(number: int, done: int) -> None:
        with lock:
            steps[number] = done
            if progress is not None:
                progress(sum(steps), STEPS * len(asked))

    def solved(number: int) -> Limit | InputError:
        outcome: Limit | InputError
        try:
            # At least one more simulation follows each, until the limit is found.
            outcome = solve(*asked[number], engine, lambda count: report(number, STEPS * count // (count + 1)))
        except InputError as error:
            # The limits of other stars are still computed.
            outcome = error
        report(number, STEPS)
        return outcome

    outcomes = list(map_in_order(engine, solved, range(len(asked))))
    errors = [one for one in outcomes if isinstance(one, InputError)]
    if len(errors) == len(outcomes):
        raise errors[0]
    result.limits.extend(one for one in outcomes if isinstance(one, Limit))
    result.failed = tuple(dict.fromkeys(map(str, errors)))
    return result


#: Former name.
limiting_magnitude = limit


@validated
def smallest_amplitude(study: Study, engine: Engine | Pool | None = None) -> LimitAnswer:
    """Compute the smallest flare that is detected; see `limit`."""
    return limit(_asking(study, "amplitude"), engine)


@validated
def shortest_exposure(study: Study, engine: Engine | Pool | None = None) -> LimitAnswer:
    """Compute the shortest exposure in which the flares are detected; see `limit`."""
    return limit(_asking(study, "exposure"), engine)


def _asking(study: Study, of: str) -> Study:
    return study.model_copy(update={"limit": study.limit.model_copy(update={"of": of})})
