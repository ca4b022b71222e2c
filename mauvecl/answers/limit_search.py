"""Search for the value at which a detection probability crosses a power: root of the closed form, then simulations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from mauvecl.answers.closed_forms import average
from mauvecl.detection.distributions import Interval, smallest_integer
from mauvecl.detection.requests import STATISTICS, check_shape, fall_between
from mauvecl.detection.statistics import LinearStatistic
from mauvecl.schema.errors import InputError, reworded
from mauvecl.schema.physical import DAY_S
from mauvecl.study.cases import Case, off_centre

if TYPE_CHECKING:
    from mauvecl.device.engine import Engine
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool

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
        self.draws = draws
        self.of, self.power, self.fap = case.study.limit.of, case.study.limit.power, case.study.run.fap
        self.points: list[Point] = []
        self._report = report
        self._base: tuple[float, Expectation, Expectation] | None = None

    def pair(self, value: float) -> tuple[Expectation, Expectation]:
        """Return the expectations without and with the flare."""
        if self.of == "exposure" and value > DAY_S:
            # The sum of several exposures.
            return self.scaled(value)
        quiet, flare = self.case.with_value(self.of, value).expectations
        return quiet, flare

    def scaled(self, value: float) -> tuple[Expectation, Expectation]:
        """Return `pair` by scaling one pair, since expectations are linear in light."""
        if self._base is None:
            at = {"magnitude": 10.0, "amplitude": 0.1, "exposure": self.frame_s}[self.of]
            self._base = at, *self.pair(at)
        at, quiet, flare = self._base
        if self.of == "exposure":
            frames = max(round(value / self.frame_s), 1)
            return replace(quiet, n_frames=frames), replace(flare, n_frames=frames)
        if self.of == "amplitude":
            more = value / at * (flare.source_electrons - quiet.source_electrons)
            return quiet, replace(flare, source_electrons=quiet.source_electrons + more)
        fainter = 10 ** (-0.4 * (value - at))
        dimmed = (replace(x, source_electrons=fainter * x.source_electrons) for x in (quiet, flare))
        return next(dimmed), next(dimmed)

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
            check_shape(quiet, flare, setting.used)
        return statistic.detection_forms(setting, flare, self.fap).probability

    def simulated(self, value: float, seed: int) -> Interval:
        """Simulate the detection probability, report the number of simulations, and return it with its interval.

        Each draw of unknown values has its own reference and threshold.
        """
        if self.draws:
            probability = average([draw.simulated(value, seed) for draw in self.draws])
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
        values = [_value(self.of, _coordinate(self.of, value) + step) for step in np.linspace(-0.75, 0.75, 25)]
        if self.of == "exposure":
            values = sorted({max(round(v / self.frame_s), 1) * self.frame_s for v in values})
        return tuple((v, self.theory(v)) for v in values)

    def root(self, near: float | None = None) -> float:
        """Return the first value at which the closed form reaches the power, from the hardest or near one."""
        from scipy.optimize import brentq

        def crossing(*ends: float, **tolerance: Any) -> float:
            return float(brentq(lambda v: self.theory(v) - self.power, min(ends), max(ends), **tolerance))

        if near is not None and self.of != "exposure":
            ends = [_value(self.of, _coordinate(self.of, near) + step) for step in (-1.0, 1.0)]
            if self.theory(ends[0]) < self.power <= self.theory(ends[1]):
                return crossing(*ends, rtol=1e-5)
        hardest, easiest = SEARCH[self.of]
        first = hardest or self.frame_s
        if self.of == "magnitude":
            values = np.arange(first, easiest - 0.1, -0.5).tolist()
        else:
            values = (first * 2.0 ** np.arange(np.ceil(np.log2(easiest / first)) + 1)).tolist()
        exceeds = self.theory(first) >= self.power
        if exceeds and self.of == "exposure":
            return first
        if exceeds:
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

    @property
    def frame_s(self) -> float:
        """Seconds of one frame."""
        return self.case.instrument.frame_s

    def _beyond(self, value: float, verb: str) -> InputError:
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
        if falls:
            text += (
                f"; WRONG SIGN: there {self.statistic} falls by {falls:.3g} standard deviations with the flare, and "
                "only higher values are alarms"
            )
        return text

    def slope(self, value: float) -> float:
        """Return the slope of the closed form's probit, per unit of `_coordinate`."""
        at, width = _coordinate(self.of, value), 0.02
        values = (_value(self.of, at - width), _value(self.of, at + width))
        below, above = (special.ndtri(np.clip(self.theory(v), 1e-9, 1 - 1e-9)) for v in values)
        return float((above - below) / (2 * width))


def _coordinate(of: str, value: float) -> float:
    """Return a coordinate that increases towards easier detection: minus the magnitude, or 2.5 log10 of the value."""
    return -value if of == "magnitude" else 2.5 * float(np.log10(value))


def _value(of: str, coordinate: float) -> float:
    return -coordinate if of == "magnitude" else float(10 ** (0.4 * coordinate))


def settle(question: LimitSearch, start: float) -> Interval:
    """Return the value at which the simulation reaches the power, with its interval, searched from a start near it.

    Raises InputError if the probability does not rise there, or the search does not settle.
    """
    try:
        return (_settle_frames if question.of == "exposure" else _settle)(question, start)
    except InputError as error:
        outside = off_centre([question.pair(start)[0]], question.case.processes)
        if outside:
            raise reworded(error, "; ".join([str(error), *outside])) from error
        raise


def _settle(question: LimitSearch, start: float) -> Interval:
    """Find the limit by Newton's steps in the probit, and its interval, with the slope of the closed form."""
    of, seed = question.of, question.case.study.run.seed
    slope, goal = question.slope(start), float(special.ndtri(question.power))
    if not slope > 0:
        fault = f"the detection probability must rise towards an easier {of}, but does not at {start:g}"
        raise InputError(f"{fault}{question.clauses(start)}", key="limit.of")
    at, n = _coordinate(of, start), question.case.study.run.realisations
    for _ in range(MOST_EVALUATIONS):
        p = question.simulated(_value(of, at), seed)
        clipped = (min(max(q, 0.5 / n), 1 - 0.5 / n) for q in (p.value, p.low, p.high))
        here, low, high = (float(special.ndtri(q)) for q in clipped)
        move = (goal - here) / slope
        # Half the interval's width away the slope's own error no longer counts.
        if abs(goal - here) <= max(0.5 * (high - low), 0.02):
            ends = [_value(of, at + (goal - q) / slope) for q in (low, high)]
            return Interval(_value(of, at + move), min(ends), max(ends))
        at += float(np.clip(move, -0.75, 0.75))
    fault = f"the limit of {of} must settle within {MOST_EVALUATIONS} simulations, but did not near {_value(of, at):g}"
    raise InputError(f"{fault}{question.clauses(_value(of, at))}", key="limit.of")


def _settle_frames(question: LimitSearch, start: float) -> Interval:
    """Find the fewest frames that reach the power, by the probability and by either end of its interval."""
    seed, frame_s = question.case.study.run.seed, question.frame_s

    @cache
    def at(frames: int) -> Interval:
        return question.simulated(frames * frame_s, seed)

    def fewest(which: str) -> int:
        """Return the fewest frames that reach the power, by doubling steps and then bisection."""

        def reaches(frames: int) -> bool:
            return frames > 0 and getattr(at(frames), which) >= question.power

        many = max(round(start / frame_s), 1)
        few, step = many - 1, 1
        while not reaches(many):
            few, many, step = many, many + step, 2 * step
        step = 1
        while reaches(few):
            few, many, step = max(few - step, 0), few, 2 * step
        return smallest_integer(reaches, few, many)

    value, low, high = (fewest(which) * frame_s for which in ("value", "high", "low"))
    return Interval(value, low, high)
