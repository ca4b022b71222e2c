"""Where a detection probability crosses a power: the closed form's root, then steps of simulation from there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.results.requests.hypotheses import check_shape, fall_between
from mauvecl.schema.errors import InputError
from mauvecl.schema.ranges import DAY_S
from mauvecl.statistics.intervals import Interval
from mauvecl.statistics.registry import STATISTICS
from mauvecl.statistics.statistic import LinearStatistic
from mauvecl.study.messages import off_centre
from mauvecl.study.quantities import QUANTITIES
from mauvecl.study.sections import Star
from mauvecl.study.study import Study
from mauvecl.study.unknowns import DrawnStudies, average, drawn, shares

if TYPE_CHECKING:
    from mauvecl.device.engine import Engine
    from mauvecl.host.expectation import Expectation
    from mauvecl.runs.pool import Pool

#: The search for the closed form's root begins where a flare is hardest to see, in steps of this.
STEPS = {"magnitude": -0.5, "amplitude": 2.0, "exposure": 2.0}
#: Ends of that search: hardest, easiest.
SEARCH = {"magnitude": (20.0, -2.0), "amplitude": (1e-5, 1e3), "exposure": (None, 1e6)}
#: Simulated evaluations at most; each moves by the closed form's slope, so that two or three suffice.
MOST_EVALUATIONS = 8


@dataclass(frozen=True)
class Point:
    """One simulated evaluation."""

    value: float
    probability: Interval
    seed: int


@dataclass(frozen=True, eq=False)
class Unknown:
    """What the unknown does to a limit.

    Attributes
    ----------
    draws : DrawnStudies
    limits : ndarray, shape (n_draw,)
        The closed-form limit of each draw; NaN where there is none.
    shares : dict of float
        Share of the limits' variance that each unknown explains, the largest first.
    """

    draws: DrawnStudies
    limits: NDArray[np.float64]
    shares: dict[str, float]

    @property
    def range(self) -> tuple[float, float]:
        """The central 95 % of the limits."""
        low, high = np.nanquantile(self.limits, (0.025, 0.975))
        return float(low), float(high)


class LimitSearch:
    """One star, flare and statistic: detection probability as a function of the quantity."""

    def __init__(
        self, study: Study, star: Star, amplitude: float | None, statistic: str, engine: Engine | Pool | None = None
    ) -> None:
        self.study, self.statistic, self.engine = study.model_copy(update={"star": (star,)}), statistic, engine
        self.of, self.power, self.fap = study.limit.of, study.limit.power, study.run.fap
        if amplitude is not None:
            self.study = self.study.at("amplitude", amplitude)
        self.points: list[Point] = []
        self._base: tuple[float, Expectation, Expectation] | None = None

    def pair(self, value: float) -> tuple[Expectation, Expectation]:
        """Without and with the flare."""
        if self.of == "exposure" and value > DAY_S:
            # Several exposures added up.
            return self.scaled(value)
        study = self.study.at(self.of, value)
        quiet, flare = study.expectations(study.star[0])
        return quiet, flare

    def scaled(self, value: float) -> tuple[Expectation, Expectation]:
        """`pair` for the closed form: light is linear, so that one pair gives all others without reading anything."""
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
        """Detection probability for Gaussian noise; 0 where no pixel is left unsaturated."""
        quiet, flare = self.scaled(value)
        setting, one = self.study.setting(quiet, flare), STATISTICS[self.statistic]
        if not setting.used.any():
            return 0.0
        one.check(setting)
        if one.shaped and not flare.saturated[setting.used].all():
            check_shape(quiet, flare, setting.used)
        return one.detection_forms(setting, flare, self.fap).probability

    def simulated(self, value: float, seed: int) -> Interval:
        """Detection probability with its interval, by the engine."""
        assert self.engine is not None
        quiet, flare = self.pair(value)
        detection = self.engine.detect(
            quiet, [flare], seed=seed, **self.study.detecting(quiet) | {"statistics": (self.statistic,)}
        )
        for message in detection.messages:
            raise InputError(f"at a {self.of} of {value:g}: {message} Expected a limit where some pixel tells")
        # Raises InputError where no threshold has the false-alarm probability.
        detection.threshold(self.fap, self.statistic)
        (probability,) = detection.detection_probability(self.fap, self.statistic)
        self.points.append(Point(value, probability, seed))
        return probability

    def curve(self, value: float) -> tuple[tuple[float, float], ...]:
        """The closed form around a value, whole frames where an exposure is asked for."""
        at = _coordinate(self.of, value)
        values = [_value(self.of, at + step) for step in np.linspace(-0.75, 0.75, 25)]
        if self.of == "exposure":
            frame_s = self.frame_s
            values = sorted({max(round(v / frame_s), 1) * frame_s for v in values})
        return tuple((v, self.theory(v)) for v in values)

    def root(self, near: float | None = None) -> float:
        """Where the closed form first reaches the power, from faint to bright, small to large; or near a value."""
        from scipy.optimize import brentq

        if near is not None and self.of != "exposure":
            at = _coordinate(self.of, near)
            ends = [_value(self.of, at + step) for step in (-1.0, 1.0)]
            if self.theory(ends[0]) < self.power <= self.theory(ends[1]):
                low, high = sorted(ends)
                return float(brentq(lambda v: self.theory(v) - self.power, low, high, rtol=1e-5))
        hardest, easiest = SEARCH[self.of]
        value = self.frame_s if hardest is None else hardest
        if self.theory(value) >= self.power:
            if self.of == "exposure":
                return value
            raise self._beyond(value, "already exceeds")
        step, further = STEPS[self.of], _further(self.of)
        while (easiest - value) * (further(value, step) - value) > 0:
            nearer = further(value, step)
            if self.theory(nearer) >= self.power:
                if self.of == "exposure":
                    # Whole frames: the closed form is a staircase.
                    return _bisect_frames(lambda v: self.theory(v) >= self.power, value, nearer, self.frame_s)
                low, high = sorted((value, nearer))
                return float(brentq(lambda v: self.theory(v) - self.power, low, high, xtol=1e-6 * abs(high - low)))
            value = nearer
        raise self._beyond(easiest, "does not reach")

    @cached_property
    def frame_s(self) -> float:
        """Seconds of one frame."""
        return self.study.observation.load_instrument().frame_s

    def _beyond(self, value: float, verb: str) -> InputError:
        star = self.study.star[0]
        name = f"{star.library or star.file}" + (f" {star.band} = {star.magnitude:g}" if self._bright(star) else "")
        flare = "" if self.of == "amplitude" else f" with a flare of {100 * self.study.flare.amplitudes[0]:.3g} %"
        return InputError(
            f"the detection probability of {name}{flare} by {self.statistic} {verb} {self.power:g} at {self.of} = "
            f"{value:g}, expected a limit between {_span(self.of)}{self.saturation_clause(value)}"
            f"{self.sign_clause(value)}"
        )

    def sign_clause(self, value: float) -> str:
        """Return what a refusal says of a weighted sum that the flare lowers at a value."""
        quiet, flare = self.scaled(value)
        setting, one = self.study.setting(quiet, flare), STATISTICS[self.statistic]
        if not isinstance(one, LinearStatistic) or not setting.used.any() or flare.saturated[setting.used].all():
            return ""
        shape = flare if one.shaped else None
        falls = fall_between(*(one.closed_form(setting, x, shape) for x in (quiet, flare)))
        if not falls:
            return ""
        return (
            f"; WRONG SIGN: there {self.statistic} falls by {falls:.3g} standard deviations with the flare, and only "
            "higher values are alarms"
        )

    def prior_clause(self, value: float) -> str:
        """Return what a refusal says of priors that exclude the values that the expectation has."""
        outside = off_centre([self.pair(value)[0]], self.study.drawing["processes"])
        return "".join(f"; {text}" for text in outside)

    def saturation_clause(self, value: float) -> str:
        """Return what a refusal says of saturation at a value, of the star or else of the flare."""
        quiet, flare = self.scaled(value)
        return quiet.saturation_clause or flare.saturation_clause.replace(" saturate ", " saturate with the flare ")

    def _bright(self, star: Star) -> bool:
        return self.of != "magnitude" and star.magnitude is not None

    def slope(self, value: float) -> float:
        """Of the closed form's probit, per unit of `_coordinate`, towards easier."""
        at, width = _coordinate(self.of, value), 0.02
        values = (_value(self.of, at - width), _value(self.of, at + width))
        below, above = (special.ndtri(np.clip(self.theory(v), 1e-9, 1 - 1e-9)) for v in values)
        return float((above - below) / (2 * width))


class MarginalLimitSearch(LimitSearch):
    """The same, averaged over what is unknown of the instrument."""

    def __init__(
        self, study: Study, star: Star, amplitude: float | None, statistic: str, engine: Engine | Pool | None = None
    ) -> None:
        super().__init__(study, star, amplitude, statistic, engine)
        self.draws = drawn(study)
        self.each = [LimitSearch(one, star, amplitude, statistic, engine) for one in self.draws.studies]

    def theory(self, value: float) -> float:
        """Mean over the draws of the unknown."""
        return float(np.mean([one.theory(value) for one in self.each]))

    def simulated(self, value: float, seed: int) -> Interval:
        """Mean over the draws of the unknown, each with its own reference and threshold."""
        probability = average([one.simulated(value, seed) for one in self.each])
        self.points.append(Point(value, probability, seed))
        return probability

    def unknown(self, near: float) -> Unknown:
        """The closed-form limit of each draw, and which unknown moves it most."""
        limits = []
        for one in self.each:
            try:
                limits.append(one.root(near=near))
            except InputError:
                limits.append(float("nan"))
        roots = np.array(limits)
        return Unknown(self.draws, roots, shares(self.draws, roots))


def _further(of: str) -> Callable[[float, float], float]:
    return (lambda value, step: value + step) if of == "magnitude" else (lambda value, step: value * step)


def _span(of: str) -> str:
    hardest, easiest = SEARCH[of]
    ends = sorted(e for e in (hardest if hardest is not None else QUANTITIES[of].low, easiest))
    return f"{ends[0]:g} and {ends[1]:g}"


def _coordinate(of: str, value: float) -> float:
    """Towards easier, and even: magnitudes, or 2.5 log10 of the others."""
    return -value if of == "magnitude" else 2.5 * float(np.log10(value))


def _value(of: str, coordinate: float) -> float:
    return -coordinate if of == "magnitude" else float(10 ** (0.4 * coordinate))


def _bisect_frames(seen: Callable[[float], bool], low: float, high: float, frame_s: float) -> float:
    """The fewest frames' exposure that is seen, between one that is not and one that is."""
    few, many = round(low / frame_s), round(high / frame_s)
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (few, middle) if seen(middle * frame_s) else (middle, many)
    return many * frame_s


def settle(question: LimitSearch, start: float) -> Interval:
    """The value at which the power is simulated, with its interval, searched from a start near it.

    Raises
    ------
    InputError
        If the probability does not rise there, or the search does not settle.
    """
    try:
        return (_settle_frames if question.of == "exposure" else _settle)(question, start)
    except InputError as error:
        outside = question.prior_clause(start)
        if outside:
            raise InputError(f"{error}{outside}") from error
        raise


def _settle(question: LimitSearch, start: float) -> Interval:
    """Newton's steps in the probit, with the closed form's slope; then the interval by the same slope."""
    of, seed = question.of, question.study.run.seed
    slope, goal = question.slope(start), float(special.ndtri(question.power))
    if not slope > 0:
        raise InputError(
            f"the detection probability does not rise towards an easier {of} at {start:g}, expected a slope there"
            f"{question.saturation_clause(start)}{question.sign_clause(start)}"
        )
    at = _coordinate(of, start)
    n = question.study.run.realisations
    for _ in range(MOST_EVALUATIONS):
        p = question.simulated(_value(of, at), seed)
        kept = (min(max(q, 0.5 / n), 1 - 0.5 / n) for q in (p.value, p.low, p.high))
        here, low, high = (float(special.ndtri(q)) for q in kept)
        move = (goal - here) / slope
        # Half the interval's width away the slope's own error no longer counts.
        near = abs(goal - here) <= max(0.5 * (high - low), 0.02)
        if near:
            ends = [_value(of, at + (goal - q) / slope) for q in (low, high)]
            return Interval(_value(of, at + move), min(ends), max(ends))
        at += float(np.clip(move, -0.75, 0.75))
    raise InputError(
        f"the limit of {of} did not settle in {MOST_EVALUATIONS} simulations near {_value(of, at):g}"
        f"{question.saturation_clause(_value(of, at))}"
    )


def _settle_frames(question: LimitSearch, start: float) -> Interval:
    """Whole frames: the fewest that reach the power, and the fewest by either end of the interval."""
    seed, frame_s = question.study.run.seed, question.frame_s
    known: dict[int, Interval] = {}

    def at(frames: int) -> Interval:
        if frames not in known:
            known[frames] = question.simulated(frames * frame_s, seed)
        return known[frames]

    def fewest(which: str) -> int:
        """Where it is crossed near the start: steps that double until it lies between, then halving."""

        def reaches(frames: int) -> bool:
            return frames > 0 and getattr(at(frames), which) >= question.power

        many = max(round(start / frame_s), 1)
        few, step = many - 1, 1
        while not reaches(many):
            few, many, step = many, many + step, 2 * step
        step = 1
        while reaches(few):
            few, many, step = max(few - step, 0), few, 2 * step
        while many - few > 1:
            middle = (few + many) // 2
            few, many = (few, middle) if reaches(middle) else (middle, many)
        return many

    value, low, high = (fewest(which) * frame_s for which in ("value", "high", "low"))
    return Interval(value, low, high)
