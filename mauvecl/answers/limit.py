"""Limits: smallest amplitudes, faintest stars and shortest exposures, and what moves them.

A limit is the value at which a detection probability crosses a power: the root of the closed form, then simulations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import pairwise, product
from operator import itemgetter
from threading import Lock
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from scipy import special

from mauvecl.answers import closed_forms as forms
from mauvecl.answers.answer import IF_KNOWN, Answer, StarInCell, TableOf, first_of_several, share_column
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.detection import RECOMMENDED, check_fap
from mauvecl.detection.distributions import Interval, smallest_integer
from mauvecl.detection.requests import STATISTICS, check_template, fall_between
from mauvecl.detection.statistics import LinearStatistic
from mauvecl.device.engine import Engine
from mauvecl.host.arrays import Float
from mauvecl.noise.disturbances import Uniform
from mauvecl.noise.unknowns import unknown_values_of
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import INTERVAL, Column, View, interval, interval_columns, number, table_of
from mauvecl.schema.errors import InputError, Message, of_kind
from mauvecl.schema.fields import DAY_S
from mauvecl.study.cases import (
    SATURATED,
    Case,
    amplitude_column,
    cases,
    collect_messages,
    off_centre,
    star_column,
    star_label,
    worst_first,
)
from mauvecl.study.observation import KNOWN, Unknowns
from mauvecl.study.questions import QUANTITIES
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.instrument.instrument import Instrument

#: Ends of the search for the root of the closed form, hardest and easiest; the shortest exposure is a frame.
SEARCH = {"magnitude": (20.0, -2.0), "amplitude": (1e-5, 1e3), "exposure": (0.0, 1e6)}
#: Largest number of simulations; two or three usually suffice, since each moves by the closed form's slope.
MOST_EVALUATIONS = 8


@dataclass(frozen=True)
class Point:
    """A simulated detection probability."""

    value: float
    probability: Interval
    seed: int


class LimitSearch:
    """Detection probability of a case's first flare by one statistic, as a function of the limit's quantity.

    It is the mean over other searches if there are any: those of draws of unknown instrument values.
    """

    def __init__(
        self, case: Case, statistic: str, engine: Engine | Pool | None = None,
        report: Callable[[int], None] = lambda count: None, draws: Sequence[LimitSearch] = (),
    ) -> None:  # fmt: skip
        # `report` is called with the number of simulations after each of them.
        self.case, self.statistic, self.engine = case.with_value("amplitude", case.amplitudes[0]), statistic, engine
        self.draws, self.frame_s = draws, case.instrument.frame_s
        self.of, self.power, self.fap = case.study.limit.of, case.study.limit.power, case.study.run.fap
        self.points: list[Point] = []
        self._report = report

    def easier(self, value: float, magnitudes: float) -> float:
        """Return a value at which detection is easier, by some magnitudes or by the factor that they are."""
        return value - magnitudes if self.of == "magnitude" else value * float(10 ** (0.4 * magnitudes))

    def pair(self, value: float) -> tuple[Expectation, Expectation]:
        """Return the expectations without and with the flare."""
        if self.of == "exposure" and value > DAY_S:
            # The sum of several exposures.
            return self.scaled(value)
        quiet, flare = self.case.with_value(self.of, value).expectations
        return quiet, flare

    def scaled(self, value: float) -> tuple[Expectation, Expectation]:
        """Return `pair` by scaling one pair, since expectations are linear in light."""
        at, quiet, flare = self._base
        if self.of == "exposure":
            frames = max(round(value / self.frame_s), 1)
            return replace(quiet, n_frames=frames), replace(flare, n_frames=frames)
        if self.of == "amplitude":
            more = value / at * (flare.source_electrons - quiet.source_electrons)
            return quiet, replace(flare, source_electrons=quiet.source_electrons + more)
        fainter = 10 ** (-0.4 * (value - at))
        quiet, flare = (replace(x, source_electrons=fainter * x.source_electrons) for x in (quiet, flare))
        return quiet, flare

    @cached_property
    def _base(self) -> tuple[float, Expectation, Expectation]:
        """The value from which pairs are scaled, and its pair."""
        at = {"magnitude": 10.0, "amplitude": 0.1, "exposure": self.frame_s}[self.of]
        return at, *self.pair(at)

    def theory(self, value: float) -> float:
        """Return the detection probability for Gaussian noise; 0 if every pixel saturates."""
        if self.draws:
            return float(np.mean([draw.theory(value) for draw in self.draws]))
        quiet, flare = self.scaled(value)
        setting, statistic = self.case.setting(quiet, flare), STATISTICS[self.statistic]
        if not setting.used.any():
            return 0.0
        statistic.check(setting)
        if statistic.shaped and not flare.saturated[setting.used].all():
            check_template(quiet, flare, setting.used)
        return statistic.detection_forms(setting, flare, self.fap).probability

    def simulated(self, value: float, seed: int) -> Interval:
        """Simulate the detection probability; each draw of unknown values has its own reference and threshold."""
        if self.draws:
            intervals = [draw.simulated(value, seed) for draw in self.draws]
            values = np.array([(interval.value, interval.low, interval.high) for interval in intervals])
            probability = Interval(*map(float, forms.average(*values.T)))
        else:
            assert self.engine is not None
            quiet, flare = self.pair(value)
            options = self.case.detect_options(quiet) | {"statistics": (self.statistic,)}
            detection = self.engine.detect(quiet, [flare], seed=seed, **options)
            for message in detection.messages:
                fault = f"{message.rstrip('.')}; some pixel must not be saturated at a limit"
                raise InputError(f"at a {self.of} of {value:g}: {fault}", key="limit.of")
            # Raises InputError where no threshold has the false-alarm probability.
            detection.threshold(self.fap, self.statistic)
            (probability,) = detection.detection_probability(self.fap, self.statistic)
        self.points.append(Point(value, probability, seed))
        self._report(len(self.points))
        return probability

    def curve(self, value: float) -> tuple[tuple[float, float], ...]:
        """Return the closed form around a value; exposures are whole frames."""
        values = [self.easier(value, step) for step in np.linspace(-0.75, 0.75, 25).tolist()]
        if self.of == "exposure":
            values = sorted({max(round(v / self.frame_s), 1) * self.frame_s for v in values})
        return tuple((v, self.theory(v)) for v in values)

    def root(self, near: float | None = None) -> float:
        """Return the first value at which the closed form reaches the power, from the hardest or near one."""
        from scipy.optimize import brentq

        def crossing(*ends: float, **tolerance: Any) -> float:
            return float(brentq(lambda v: self.theory(v) - self.power, min(ends), max(ends), **tolerance))

        if near is not None and self.of != "exposure":
            ends = [self.easier(near, step) for step in (-1.0, 1.0)]
            if self.theory(ends[0]) < self.power <= self.theory(ends[1]):
                return crossing(*ends, rtol=1e-5)
        hardest, easiest = SEARCH[self.of]
        first = hardest or self.frame_s
        if self.of == "magnitude":
            values = np.arange(first, easiest - 0.1, -0.5).tolist()
        else:
            values = (first * 2.0 ** np.arange(np.ceil(np.log2(easiest / first)) + 1)).tolist()
        if self.theory(first) >= self.power:
            if self.of == "exposure":
                return first
            raise self._beyond(first, "already exceeds")
        for before, value in pairwise(values):
            if self.theory(value) < self.power:
                continue
            if self.of == "exposure":
                # Whole frames: the closed form is a staircase.
                few, many = (round(end / self.frame_s) for end in (before, value))
                return self.frame_s * smallest_integer(lambda n: self.theory(n * self.frame_s) >= self.power, few, many)
            return crossing(before, value, xtol=1e-6 * abs(value - before))
        raise self._beyond(easiest, "does not reach")

    def root_or_nan(self, near: float) -> float:
        """Return the root near a value, or NaN if there is none."""
        try:
            return self.root(near=near)
        except InputError:
            return float("nan")

    def _beyond(self, value: float, verb: str) -> InputError:
        """Return the error of a limit that lies beyond the searched range."""
        star, (low, high) = self.case.star, sorted(SEARCH[self.of])
        name = str(star.library or star.file)
        if self.of != "magnitude" and star.magnitude is not None:
            name += f" {star.band} = {star.magnitude:g}"
        flare = "" if self.of == "amplitude" else f" with a flare of {100 * self.case.amplitudes[0]:.3g} %"
        fault = (
            f"the detection probability of {name}{flare} by {self.statistic} {verb} {self.power:g} at "
            f"{self.of} = {value:g}; a limit must lie between {low:g} and {high:g}{self.clauses(value)}"
        )
        return InputError(fault, key="limit.of")

    def clauses(self, value: float) -> str:
        """Return the clauses of an error message on saturation, and on a weighted sum that the flare lowers."""
        quiet, flare = self.scaled(value)
        text = quiet.saturation_clause or flare.saturation_clause.replace(" saturate ", " saturate with the flare ")
        setting, statistic = self.case.setting(quiet, flare), STATISTICS[self.statistic]
        if not isinstance(statistic, LinearStatistic) or not setting.used.any() or flare.saturated[setting.used].all():
            return text
        shape = flare if statistic.shaped else None
        falls = fall_between(*(statistic.closed_form(setting, x, shape) for x in (quiet, flare)))
        if not falls:
            return text
        wrong = f"WRONG SIGN: there {self.statistic} falls by {falls:.3g} standard deviations with the flare"
        return f"{text}; {wrong}, and only higher values are alarms"

    def slope(self, value: float) -> float:
        """Return the slope of the closed form's probit, per magnitude towards easier detection."""
        chances = (self.theory(self.easier(value, step)) for step in (-0.02, 0.02))
        below, above = (special.ndtri(np.clip(chance, 1e-9, 1 - 1e-9)) for chance in chances)
        return float((above - below) / 0.04)


def settle(question: LimitSearch, start: float) -> Interval:
    """Return the value at which the simulation reaches the power, with its interval, searched from a start near it."""
    try:
        return (_settle_frames if question.of == "exposure" else _settle)(question, start)
    except InputError as error:
        outside = off_centre([question.pair(start)[0]], question.case.processes)
        if outside:
            raise InputError("; ".join([str(error), *outside]), key=error.key) from error
        raise


def _settle(question: LimitSearch, start: float) -> Interval:
    """Find the limit by Newton's steps in the probit, and its interval, with the slope of the closed form."""
    of, seed = question.of, question.case.study.run.seed
    slope, goal = question.slope(start), float(special.ndtri(question.power))
    if not slope > 0:
        fault = f"the detection probability must rise towards an easier {of}, but does not at {start:g}"
        raise InputError(f"{fault}{question.clauses(start)}", key="limit.of")
    at, n = start, question.case.study.run.realisations
    for _ in range(MOST_EVALUATIONS):
        p = question.simulated(at, seed)
        clipped = (min(max(q, 0.5 / n), 1 - 0.5 / n) for q in (p.value, p.low, p.high))
        probit, low, high = (float(special.ndtri(q)) for q in clipped)
        move = (goal - probit) / slope
        # Within half the width of the interval, the error of the slope does not matter.
        if abs(goal - probit) <= max(0.5 * (high - low), 0.02):
            ends = [question.easier(at, (goal - q) / slope) for q in (low, high)]
            return Interval(question.easier(at, move), min(ends), max(ends))
        at = question.easier(at, float(np.clip(move, -0.75, 0.75)))
    fault = f"the limit of {of} must settle within {MOST_EVALUATIONS} simulations, but did not near {at:g}"
    raise InputError(f"{fault}{question.clauses(at)}", key="limit.of")


def _settle_frames(question: LimitSearch, start: float) -> Interval:
    """Find the fewest frames that reach the power, by the probability and by either end of its interval."""
    seed, frame_s = question.case.study.run.seed, question.frame_s

    @cache
    def at(frames: int) -> Interval:
        return question.simulated(frames * frame_s, seed)

    def fewest(end: str) -> int:
        """Return the fewest frames that reach the power, by doubling steps and then bisection."""

        def reaches(frames: int) -> bool:
            return frames > 0 and getattr(at(frames), end) >= question.power

        many = max(round(start / frame_s), 1)
        few, step = many - 1, 1
        while not reaches(many):
            few, many, step = many, many + step, 2 * step
        step = 1
        while reaches(few):
            few, many, step = max(few - step, 0), few, 2 * step
        return smallest_integer(reaches, few, many)

    value, low, high = (fewest(end) * frame_s for end in ("value", "high", "low"))
    return Interval(value, low, high)


@validated
def what_matters(study: Study) -> QTable:
    """Compute the closed-form limits of a study with each assumption at both ends of its range.

    The table has one row per star, flare, statistic and assumption; for each limit, that which changes it most first.
    Normal priors extend to one standard deviation (documentation: what is nominal).
    """
    rows = list[dict[str, Any]]()
    for case, statistic in product(_single_flares(cases(study, swept=False)), study.run.statistics):
        nominal, rows_of_case = LimitSearch(case, statistic).root(), list[dict[str, Any]]()
        for label, changes in _changes_at_ends(case.instrument).items():
            changed = (replace(case, study=case.study.with_instrument(change)) for change in changes.values())
            low, high = (LimitSearch(moved, statistic).root(near=nominal) for moved in changed)
            low_end, high_end = changes
            rows_of_case.append({
                "star": case.star.library or str(case.star.file), "amplitude": case.amplitudes[0],
                "statistic": statistic, "assumption": label, "low_end": low_end, "high_end": high_end,
                "nominal": nominal, "at_low_end": low, "at_high_end": high, "span": abs(high - low),
            })  # fmt: skip
        rows += sorted(rows_of_case, key=lambda row: -row["span"])
    columns = limit_assumption_columns(study.limit.of)
    table = table_of(columns, rows, power=study.limit.power, fap=study.run.fap, study=study.text())
    for name in (study.limit.of, "at_low_end", "at_high_end", "span"):
        table[name].info.format = LIMIT
    return table


def _changes_at_ends(instrument: Instrument) -> dict[str, dict[str, Mapping[str, Any]]]:
    """Return the changes of an instrument at both ends of each assumption's range, by assumption and by end."""
    values, changes = unknown_values_of(instrument), dict[str, dict[str, Mapping[str, Any]]]()
    for name, prior in Unknowns().priors(instrument).items():
        ends = (prior.low, prior.high) if isinstance(prior, Uniform) else (prior.mean - prior.sd, prior.mean + prior.sd)
        value = values[name]
        changes[value.label] = {f"{end:g}": value.changes(instrument, float(f"{end:.12g}")) for end in ends}
    return changes | {"dark counts are Poisson in": {unit: {"dark_unit": unit} for unit in ("DN", "electrons")}}


def _single_flares(prepared: Sequence[Case]) -> list[Case]:
    """Return a case for each flare of which a limit is computed: one of each case if its amplitude is the limit."""
    if prepared[0].study.limit.of == "amplitude":
        return list(prepared)
    return [case.with_value("amplitude", amplitude) for case in prepared for amplitude in case.amplitudes]


#: Format of limits.
LIMIT = ".3f"


def limit_assumption_columns(of: str) -> tuple[Column, ...]:
    """Return the columns of the table of assumptions, for limits of a quantity."""
    return (
        star_column(),
        *(() if of == "amplitude" else (amplitude_column(),)),
        STATISTIC_COLUMN,
        Column("assumption", "", "", "what is assumed of the instrument", "assumption"),
        Column("low_end", "", "", "lower end of its sensible range", "from"),
        Column("high_end", "", "", "upper end of its sensible range", "to"),
        Column(of, "nominal", description=QUANTITIES[of].description, format=LIMIT),
        Column("at_low_end", "", "", "closed-form limit with the assumption at its lower end", "limit from", LIMIT),
        Column("at_high_end", "", "", "closed-form limit with the assumption at its upper end", "to", LIMIT),
        Column("span", "", "", f"how far the closed-form limit of {of} moves from end to end", "moves by", LIMIT),
    )  # fmt: skip


#: Steps in which the progress of a limit is reported, since its number of simulations is not known beforehand.
STEPS = 100


@dataclass(frozen=True, eq=False)
class UnknownEffect:
    """Effect of unknown instrument values on a limit."""

    draws: forms.DrawnStudies
    limits: Float  # closed-form limit of each draw, NaN if it has none, shape (n_draw,)
    shares: dict[str, float]  # share of the limits' variance that each unknown explains, largest first

    @property
    def range(self) -> tuple[float, float]:
        """Central 95 % of the limits."""
        low, high = np.nanquantile(self.limits, (0.025, 0.975))
        return float(low), float(high)


@dataclass(frozen=True)
class Limit(StarInCell):
    """Limit of a quantity."""

    amplitude: float  # amplitude of the flare; NaN if the amplitude is the limit
    of: str
    statistic: str
    power: float
    value: Interval  # limit with its 95 % interval, including that of the threshold
    closed_form: float  # limit for Gaussian noise
    ideal: float  # the same if everything but the noise were known; NaN if it is, or if there is none
    check: Point  # detection probability at the value, simulated again with another seed
    points: tuple[Point, ...]  # simulations of the search
    curve: tuple[tuple[float, float], ...] = field(compare=False, repr=False)  # the closed form around the limit
    unknown: UnknownEffect | None  # for limits averaged over unknown instrument values
    messages: tuple[str, ...]  # saturation at the limit, without and with the flare
    cost: forms.Cost  # loss of S/N to unknowns at the limit
    quiet: Expectation = field(compare=False, repr=False)  # the star at the limit, without the flare

    @property
    def verdict(self) -> str:
        """Verdict of the second simulation on the limit.

        It is "confirms it" if its interval contains the power, "exceeds it" if exposures of whole frames have more
        power, "DIFFERS" if the interval misses the power by more than its width, and "misses it narrowly" in between,
        which happens by chance for one limit in six.
        """
        p = self.check.probability
        if p.low <= self.power <= p.high:
            return "confirms it"
        if self.of == "exposure" and p.low > self.power:
            return "exceeds it"
        away = max(p.low - self.power, self.power - p.high)
        return "DIFFERS" if away > p.high - p.low else "misses it narrowly"


#: Words before a limit in a sentence, and how it is said, by quantity.
SPOKEN: dict[str, tuple[str, Callable[[float], str]]] = {
    "magnitude": ("down to a magnitude of", lambda value: f"{value:.2f}"),
    "amplitude": ("from an amplitude of", lambda value: f"{100 * value:.3g} %"),
    "exposure": ("in", lambda value: f"{value:g} s"),
}
#: Formats of limits by quantity.
DIGITS = {"magnitude": ".2f", "amplitude": ".4g", "exposure": ".0f"}
STATISTIC_COLUMN = Column("statistic", description="detection statistic", heading="statistic")


def _limit_columns(answer: LimitAnswer) -> tuple[Column, ...]:
    """Return the columns of `LimitAnswer.table`."""
    of, digits, unit = answer.study.limit.of, DIGITS[answer.study.limit.of], QUANTITIES[answer.study.limit.of].unit
    unknown = _unknown_columns(of) if answer.study.unknowns.draws else ()
    return (
        *answer.flare_columns,
        share_column("quiet.target_share"),
        Column(of, "value.value", unit, "where the flare is detected with the wanted probability",
               "exposure (s)" if of == "exposure" else of, digits),
        *interval_columns("{}", "value.{}", unit, "its 95 % interval, with the threshold's own", INTERVAL,
                          interval(digits)),
        Column("ideal", "", unit, "the same for Gaussian noise if everything but the noise were known", "ideal",
               number(digits), when=forms.IDEAL.when),
        Column("closed_form", "", unit, "the same for Gaussian noise", "closed form", digits, detail=True),
        Column("check", "check.probability.value", "", "detection probability there, with a fresh seed",
               "detected there, simulated again", ".4f", detail=True),
        *interval_columns("check_{}", "check.probability.{}", heading=INTERVAL, format=interval(".4f"), detail=True),
        *unknown,
    )  # fmt: skip


def _unknown_columns(of: str) -> tuple[Column, ...]:
    """Return the columns of limits over draws of what is unknown of the instrument."""
    digits, unit = DIGITS[of], QUANTITIES[of].unit

    def largest(row: Limit) -> tuple[str, float]:
        name, share = next(iter(cast("UnknownEffect", row.unknown).shares.items()))
        return ("" if np.isnan(share) else name), share

    return (
        *interval_columns("unknown_{}", lambda row: row.unknown.range, unit, "the central 95 % of the limits",
                          "95 % of limits", lambda low, high: f"{low:{digits}} to {high:{digits}}"),
        Column("matters_most", lambda row: largest(row)[0],
               description="unknown that explains most of the limits' variance; empty if too few draws tell"),
        Column("its_share", lambda row: largest(row)[1],
               description="share of the limits' variance that this unknown explains"),
    )  # fmt: skip


def _draws(answer: LimitAnswer) -> forms.DrawnStudies:
    """Return the draws of what is unknown of the instrument, which are the same for all limits."""
    return next(limit.unknown.draws for limit in answer.limits if limit.unknown is not None)


def _draw_columns(answer: LimitAnswer) -> tuple[Column, ...]:
    """Return the columns of `LimitAnswer.draws`, with one for each unknown value."""
    draws = _draws(answer)
    values = (
        Column(name, itemgetter(k), description=f"drawn {label}").of_part("unknown.draws.values.T")
        for k, (name, label) in enumerate(zip(draws.names, draws.labels, strict=True))
    )
    of = answer.study.limit.of
    return (*answer.flare_columns, *values, Column(of, "unknown.limits", QUANTITIES[of].unit, "closed-form limit"))


@dataclass(eq=False)
class LimitAnswer(Answer):
    """Answer of `limit`: limits with their closed forms and simulations, and what unknowns and assumptions change."""

    USES = ("instrument", "sky", "flare", "processes", "nuisances", "values", "seed", "sweep")

    study: Study
    limits: list[Limit]
    failed: tuple[str, ...]  # reasons for missing limits
    assumptions: QTable | None = None  # change of the limits with assumptions about the instrument; see `what_matters`

    #: One row per star, flare and statistic.
    table = TableOf("limit", _limit_columns, "limits", by_star=True, key="rows",
                    meta=("study.limit.power", "study.run.fap", "study.run.realisations", "study"))  # fmt: skip
    #: One row per limit and draw of the unknown: its values and the closed-form limit.
    draws = TableOf("unknowns", _draw_columns, "limits", by_star=True, when="study.unknowns.draws")
    _assumptions = TableOf(
        "assumptions", lambda answer: limit_assumption_columns(answer.study.limit.of), "assumptions", key="assumptions",
        title=lambda answer: f"What is assumed, and how far it moves the closed-form limit of {answer.study.limit.of}, "
        "the largest first",
        when="assumptions",
    )  # fmt: skip

    @property
    def flare_columns(self) -> tuple[Column, ...]:
        """Columns of flare and statistic."""
        return (*(() if self.study.limit.of == "amplitude" else (amplitude_column(),)), STATISTIC_COLUMN)

    @property
    def headline(self) -> str:
        """The limit of the first star and flare, by the recommended statistic if it is computed."""
        question = self.study.limit
        limit = next((limit for limit in self.limits if limit.statistic == RECOMMENDED), self.limits[0])
        before, number = SPOKEN[question.of]
        flare = "flares" if question.of == "amplitude" else f"a flare of {100 * limit.amplitude:g} %"
        within = "" if question.of == "exposure" else f" in {limit.quiet.exposure_s:g} s"
        ideal = "" if np.isnan(limit.ideal) else f"; {number(limit.ideal)} {IF_KNOWN}"
        of_several = first_of_several(len(self.limits), "limits")
        return (
            f"{self.instrument_name} would see {flare} on {limit.subject}{within} with a "
            f"chance of {100 * question.power:g} % {before} {number(limit.value.value)} "
            f"({number(limit.value.low)} to {number(limit.value.high)}{ideal}){of_several}."
        )

    @property
    def views(self) -> list[View]:
        of, run, draws = self.study.limit.of, self.study.run, self.study.unknowns.draws
        columns = LimitAnswer.table.columns_of(self)
        shown = (*(column for column in columns if column.name != "unknown_low"), Column("verdict", heading="verdict"))
        run = _draws(self).studies[0].run if draws else run
        title = (
            f"Limit of {of} at a detection probability of {self.study.limit.power:g}, false-alarm probability "
            f"{run.fap:g} per test, {run.realisations:,} realisations{' of each draw' if draws else ''}"
        )
        views = [View(title, shown, table_of(shown, self.limits))]
        if draws:
            heading = "matters most, share of the variance"
            column = Column("shares", lambda row: forms.describe_shares(row.unknown.shares), heading=heading)
            shown = (*self.with_star(self.flare_columns), *_unknown_columns(of)[:2], column)
            unknown = "what is unknown of the instrument: the limits of each, and what explains their scatter"
            views.append(View(f"Averaged over {draws} draws of {unknown}", shown, table_of(shown, self.limits)))
        return [*views, *super().views]

    @cached_property
    def inputs(self) -> list[Expectation]:
        """Each star at its limits."""
        return [limit.quiet for limit in self.limits]

    @property
    def messages(self) -> list[str]:
        """Messages about failed limits, the stars, and unknowns."""
        at_limits = [text for limit in self.limits for text in limit.messages]
        stars = worst_first([*at_limits, *collect_messages(self.inputs, self.study.processes)])
        costs = [limit.cost for limit in self.limits]
        failed = [Message(f"NO LIMIT: {text}.", "no limit") for text in self.failed]
        return [*failed, *stars, *forms.unknown_lines(costs, self.study.nuisances)]


def solve(case: Case, statistic: str, engine: Engine | Pool, report: Callable[[int], None]) -> Limit:
    """Return the limit of a case's first flare, or of its amplitude, and simulate it again with another seed.

    Averages over draws of unknown instrument values if the study has some. Calls `report` with the number of
    simulations after each of them.
    """
    study = case.study
    check_fap(study.run.fap, study.run.realisations, study.run.tails)
    draws = forms.draw_studies(study) if study.unknowns.draws else None
    searches = [LimitSearch(replace(case, study=drawn), statistic, engine) for drawn in draws.studies] if draws else []
    question = LimitSearch(case, statistic, engine, report, searches)
    # The root of the nominal instrument is near and found quickly.
    theory = question.root(near=LimitSearch(case, statistic).root() if searches else None)
    roots = np.array([draw.root_or_nan(theory) for draw in searches])
    value = settle(question, theory)
    # Users are unlikely to choose a seed with this distance from another.
    question.simulated(value.value, (study.run.seed + 0x9E3779B97F4A7C15) % 2**64)
    *points, check = question.points
    quiet, flare = question.pair(value.value)
    is_ideal, ideal = study.nuisances.none, case.with_sections(nuisances=KNOWN)
    star = case.star.model_copy(update={"magnitude": None}) if question.of == "magnitude" else case.star
    label, rise = star_label(star, quiet), value.value if question.of == "amplitude" else case.amplitudes[0]
    limit_text = f"exposure {value.value:.0f} s" if question.of == "exposure" else f"{question.of} {value.value:.4g}"
    flare_text = f"{label} at {limit_text}, flare of {100 * rise:.4g} %"
    amplitude = float("nan") if question.of == "amplitude" else case.amplitudes[0]
    return Limit(
        label, case.at, amplitude, question.of, statistic, question.power, value, closed_form=theory,
        ideal=float("nan") if is_ideal else LimitSearch(ideal, statistic).root_or_nan(theory),
        check=check, points=tuple(points), curve=question.curve(value.value),
        unknown=UnknownEffect(draws, roots, forms.shares(draws, roots)) if draws else None,
        messages=tuple(of_kind(collect_messages([quiet, flare]), SATURATED)), quiet=quiet,
        cost=forms.unknown_cost(flare_text, quiet, flare, study.nuisances, study.run.comparison()),
    )  # fmt: skip


@by_keywords("steps, 100 for each limit")
def limit(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> LimitAnswer:
    """Compute the limits of a study's stars and flares, by every statistic.

    The study's ``limit`` defines the quantity (magnitude, amplitude or exposure) and the power. Raises InputError as
    for `solve` if all limits fail; otherwise see `LimitAnswer.failed`.
    """
    engine = engine or Engine()
    if any(axis.quantity == study.limit.of for axis in study.sweep.axes):
        fault = f"the sweep must run over other quantities than the {study.limit.of}, of which the limit is requested"
        raise InputError(fault, key="sweep")
    questions = list(product(_single_flares(cases(study)), study.run.statistics))
    steps, lock = [0] * len(questions), Lock()

    def report(number: int, percent: int) -> None:
        with lock:
            steps[number] = percent
            if progress is not None:
                progress(sum(steps), STEPS * len(questions))

    def solved(number: int) -> Limit | InputError:
        try:
            # At least one more simulation follows each, until the limit is found.
            return solve(*questions[number], engine, lambda count: report(number, STEPS * count // (count + 1)))
        except InputError as error:
            # The limits of other stars are still computed.
            return error
        finally:
            report(number, STEPS)

    outcomes = list(map_in_order(engine, solved, range(len(questions))))
    errors = [outcome for outcome in outcomes if isinstance(outcome, InputError)]
    limits = [outcome for outcome in outcomes if isinstance(outcome, Limit)]
    if not limits:
        raise errors[0]
    return LimitAnswer(study, limits, tuple(dict.fromkeys(map(str, errors))))


@validated
def smallest_amplitude(study: Study, engine: Engine | Pool | None = None) -> LimitAnswer:
    """Compute the smallest flare that is detected; see `limit`."""
    return limit(study.with_changes({"limit": {"of": "amplitude"}}, None), engine)


@validated
def shortest_exposure(study: Study, engine: Engine | Pool | None = None) -> LimitAnswer:
    """Compute the shortest exposure in which the flares are detected; see `limit`."""
    return limit(study.with_changes({"limit": {"of": "exposure"}}, None), engine)
