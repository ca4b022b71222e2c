"""The value of one quantity at which a flare is detected with a wanted probability, with its interval."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.detection import Detection, check_fap
from mauvecl.host.errors import InputError
from mauvecl.labels import described, label, stacked
from mauvecl.scene import prepare
from mauvecl.statistics import Interval
from mauvecl.study import QUANTITIES, UNITS, Star, Study
from mauvecl.unknowns import Draws, average, drawn, draws_table, shares

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.engine import Engine
    from mauvecl.host.expectation import Expectation
    from mauvecl.pool import Pool

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
    draws : Draws
    limits : ndarray, shape (n_draw,)
        The closed-form limit of each draw; NaN where there is none.
    shares : dict of float
        Share of the limits' variance that each unknown explains, the largest first.
    """

    draws: Draws
    limits: NDArray[np.float64]
    shares: dict[str, float]

    @property
    def range(self) -> tuple[float, float]:
        """The central 95 % of the limits."""
        low, high = np.nanquantile(self.limits, (0.025, 0.975))
        return float(low), float(high)


@dataclass(frozen=True)
class Limit:
    """One limit.

    Attributes
    ----------
    star : str
    amplitude : float
        Of the flare; NaN where the amplitude is asked for.
    of, statistic : str
    fap, power : float
    value : Interval
        With the simulation's own 95 % interval, that of the threshold included.
    closed_form : float
        The same for Gaussian noise.
    check : Point
        Detection probability at the value, simulated again with another seed.
    points : tuple of Point
        What was simulated on the way.
    curve : tuple of (value, probability)
        The closed form around the limit.
    at : mapping
        What the study sweeps over.
    unknown : Unknown, optional
        Where the limit is averaged over what is unknown.
    """

    star: str
    amplitude: float
    of: str
    statistic: str
    fap: float
    power: float
    value: Interval
    closed_form: float
    check: Point
    points: tuple[Point, ...]
    curve: tuple[tuple[float, float], ...]
    at: Mapping[str, float | str] = field(default_factory=dict)
    unknown: Unknown | None = None

    @property
    def agrees(self) -> bool:
        """Whether the fresh simulation's interval reaches the wanted power, or passes it by less than its own width."""
        p = self.check.probability
        reach = p.high - p.low
        return p.low - reach <= self.power <= p.high + reach or (self.of == "exposure" and p.high >= self.power)


@dataclass(eq=False)
class LimitResult:
    """What `limiting_magnitude` and its relatives answer.

    Attributes
    ----------
    study : Study
    limits : list of Limit
    """

    study: Study
    limits: list[Limit] = field(default_factory=list)

    @property
    def table(self) -> QTable:
        """One row per star, flare and statistic."""
        import astropy.units as u
        from astropy.table import QTable

        of = self.study.limit.of
        unit = UNITS.get(of)
        rows = self.limits
        table = QTable()
        table["star"] = [r.star for r in rows]
        for axis in self.study.sweep.axes:
            if axis.quantity != "amplitude":
                swept = np.array([r.at[axis.quantity] for r in rows])
                table[axis.quantity] = swept * u.Unit(UNITS[axis.quantity]) if axis.quantity in UNITS else swept
        if of != "amplitude":
            table["amplitude"] = [r.amplitude for r in rows]
        table["statistic"] = [r.statistic for r in rows]
        for name, values, text in (
            (of, [r.value.value for r in rows], "where the flare is detected with the wanted probability"),
            ("low", [r.value.low for r in rows], "its 95 % interval, lower end, with the threshold's own"),
            ("high", [r.value.high for r in rows], "its 95 % interval, upper end, with the threshold's own"),
            ("closed_form", [r.closed_form for r in rows], "the same for Gaussian noise"),
        ):
            table[name] = values if unit is None else np.array(values) * u.Unit(unit)
            table[name].info.description = text
        for name, value in (("check", "value"), ("check_low", "low"), ("check_high", "high")):
            table[name] = [getattr(r.check.probability, value) for r in rows]
            table[name].info.description = "detection probability there, with a fresh seed" + (
                "" if name == "check" else f"; 95 % interval, {name[6:]}er end"
            )
        if self.study.unknowns.draws:
            unknowns = [r.unknown for r in rows if r.unknown is not None]
            table["unknown_low"], table["unknown_high"] = np.array([one.range for one in unknowns]).T
            table["unknown_low"].info.description = "central 95 % of the limits over what is unknown, lower end"
            table["unknown_high"].info.description = "central 95 % of the limits over what is unknown, upper end"
            table["matters_most"] = [next(iter(one.shares)) for one in unknowns]
            table["its_share"] = [next(iter(one.shares.values())) for one in unknowns]
            table["its_share"].info.description = "share of the limits' variance that this unknown explains"
        table.meta |= {
            "power": self.study.limit.power,
            "fap": self.study.run.fap,
            "realisations": self.study.run.realisations,
            "study": self.study.toml(),
        }
        return described(table)

    @property
    def draws(self) -> QTable:
        """One row per limit and draw of the unknown: its values and the closed-form limit."""
        parts = []
        for one in self.limits:
            assert one.unknown is not None
            table = draws_table(one.unknown.draws, {self.study.limit.of: one.unknown.limits})
            amplitude = {} if np.isnan(one.amplitude) else {"amplitude": one.amplitude}
            swept = {k: v for k, v in one.at.items() if k != "amplitude"}
            parts.append(({"star": one.star, **swept, **amplitude, "statistic": one.statistic}, table))
        return stacked(parts, study=self.study.toml())

    def _repr_html_(self) -> str:
        return str(self.table._repr_html_())

    def write(self, folder: str | Path) -> list[Path]:
        """The table as ECSV, that of the unknown's draws where there are any, and the study that gives them again."""
        from mauvecl.report import make_folder, write_study, write_table

        place = make_folder(Path(folder))
        files = [write_table(self.table, place / "limit.ecsv")]
        if self.study.unknowns.draws:
            files.append(write_table(self.draws, place / "unknowns.ecsv"))
        return [*files, write_study(self.study, place)]

    def plot(self, path: str | Path | None = None) -> object:
        """Detection probability against the quantity: every simulated point and the limits; needs matplotlib."""
        from mauvecl.pictures import limits

        return limits(self, None if path is None else Path(path))


class Question:
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
        scene = prepare([quiet, flare], comparison=self.study.run.comparison())
        if not scene.used.any():
            return 0.0
        found = Detection(quiet, (flare,), (self.statistic,), scene, self.study.run.realisations)
        limit = found.closed_form(self.statistic).isf(self.fap)
        return found.closed_form(self.statistic, 0).sf(limit)

    def simulated(self, value: float, seed: int) -> Interval:
        """Detection probability with its interval, by the engine."""
        assert self.engine is not None
        quiet, flare = self.pair(value)
        found = self.engine.detect(
            quiet, [flare], seed=seed, **self.study.detecting | {"statistics": (self.statistic,)}
        )
        (probability,) = found.detection_probability(self.fap, self.statistic)
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
        """Where the closed form crosses the power, seen from where the flare is hardest to see; or near a value."""
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
        raise self._beyond(value, "does not reach")

    @cached_property
    def frame_s(self) -> float:
        """Seconds of one frame."""
        return self.study.load_instrument().frame_s

    def _beyond(self, value: float, verb: str) -> InputError:
        return InputError(
            f"the detection probability of {self.study.star[0].library or self.study.star[0].file} {verb} "
            f"{self.power:g} at {self.of} = {value:g}, expected a limit between {_span(self.of)}"
        )

    def slope(self, value: float) -> float:
        """Of the closed form's probit, per unit of `_coordinate`, towards easier."""
        at, width = _coordinate(self.of, value), 0.02
        values = (_value(self.of, at - width), _value(self.of, at + width))
        below, above = (special.ndtri(np.clip(self.theory(v), 1e-9, 1 - 1e-9)) for v in values)
        return float((above - below) / (2 * width))


class MarginalQuestion(Question):
    """The same, averaged over what is unknown of the instrument."""

    def __init__(
        self, study: Study, star: Star, amplitude: float | None, statistic: str, engine: Engine | Pool | None = None
    ) -> None:
        super().__init__(study, star, amplitude, statistic, engine)
        self.draws = drawn(study)
        self.each = [Question(one, star, amplitude, statistic, engine) for one in self.draws.studies]

    def theory(self, value: float) -> float:
        """Mean over the draws of the unknown."""
        return float(np.mean([one.theory(value) for one in self.each]))

    def simulated(self, value: float, seed: int) -> Interval:
        """Mean over the draws of the unknown, each with its own template and threshold."""
        found = average([one.simulated(value, seed) for one in self.each])
        self.points.append(Point(value, found, seed))
        return found

    def unknown(self, near: float) -> Unknown:
        """The closed-form limit of each draw, and which unknown moves it most."""
        limits = []
        for one in self.each:
            try:
                limits.append(one.root(near=near))
            except InputError:
                limits.append(float("nan"))
        found = np.array(limits)
        return Unknown(self.draws, found, shares(self.draws, found))


def _further(of: str) -> Callable[[float, float], float]:
    return (lambda value, step: value + step) if of == "magnitude" else (lambda value, step: value * step)


def _span(of: str) -> str:
    hardest, easiest = SEARCH[of]
    ends = sorted(e for e in (hardest if hardest is not None else QUANTITIES[of][0], easiest))
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


def solve(
    study: Study,
    star: Star,
    amplitude: float | None,
    statistic: str,
    engine: Engine | Pool,
    at: Mapping[str, float | str] | None = None,
) -> Limit:
    """One limit: the closed form's root, moved by what is simulated, and simulated again there.

    Averaged over what is unknown of the instrument where the study asks for draws of it.

    Raises
    ------
    InputError
        If the power is not crossed in the range searched, or the false-alarm probability cannot be settled.
    """
    check_fap(study.run.fap, study.run.realisations, study.run.tails)
    kind = MarginalQuestion if study.unknowns.draws else Question
    question = kind(study, star, amplitude, statistic, engine)
    # The nominal instrument's root is near, and quickly found.
    theory = question.root(near=Question(study, star, amplitude, statistic).root() if study.unknowns.draws else None)
    settle = _settle_frames if question.of == "exposure" else _settle
    value = settle(question, theory)
    simulated = tuple(question.points)
    # Another seed, far from any that a user would take for a neighbour.
    fresh = (study.run.seed + 0x9E3779B97F4A7C15) % 2**64
    check = Point(value.value, question.simulated(value.value, fresh), fresh)
    quiet, _ = question.pair(value.value)
    shown = question.study.star[0]
    named = star.model_copy(update={"magnitude": None}) if question.of == "magnitude" else shown
    return Limit(
        star=label(named, quiet),
        amplitude=float("nan") if amplitude is None else amplitude,
        of=question.of,
        statistic=statistic,
        fap=question.fap,
        power=question.power,
        value=value,
        closed_form=theory,
        check=check,
        points=simulated,
        curve=question.curve(value.value),
        at=at or {},
        unknown=question.unknown(theory) if isinstance(question, MarginalQuestion) else None,
    )


def _settle(question: Question, start: float) -> Interval:
    """Newton's steps in the probit, with the closed form's slope; then the interval by the same slope."""
    of, seed = question.of, question.study.run.seed
    slope, goal = question.slope(start), float(special.ndtri(question.power))
    if not slope > 0:
        raise InputError(
            f"the detection probability does not rise towards an easier {of} at {start:g}, expected a slope there"
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
    raise InputError(f"the limit of {of} did not settle in {MOST_EVALUATIONS} simulations near {_value(of, at):g}")


def _settle_frames(question: Question, start: float) -> Interval:
    """Whole frames: the fewest that reach the power, and the fewest by either end of the interval."""
    seed, frame_s = question.study.run.seed, question.frame_s
    known: dict[int, Interval] = {}

    def at(frames: int) -> Interval:
        if frames not in known:
            known[frames] = question.simulated(frames * frame_s, seed)
        return known[frames]

    def fewest(which: str) -> int:
        frames = max(round(start / frame_s), 1)
        while getattr(at(frames), which) < question.power:
            frames += 1
        while frames > 1 and getattr(at(frames - 1), which) >= question.power:
            frames -= 1
        return frames

    value, low, high = (fewest(which) * frame_s for which in ("value", "high", "low"))
    return Interval(value, low, high)


def limiting_magnitude(study: Study, engine: Engine | Pool | None = None) -> LimitResult:
    """Limits of a study's stars and flares, by every statistic it names.

    Parameters
    ----------
    study : Study
        Its ``limit`` says of what (magnitude, amplitude or exposure) and at which power.
    engine : Engine or Pool, optional

    Raises
    ------
    InputError
        As `solve`.
    """
    from mauvecl.engine import Engine as Default
    from mauvecl.pool import together

    engine = engine or Default()
    result = LimitResult(study)
    if any(axis.quantity == study.limit.of for axis in study.sweep.axes):
        raise InputError(f"the sweep runs over the {study.limit.of} that is asked for, expected other quantities")
    asked = [
        (cell, star, amplitude, statistic, at)
        for at, cell in study.cells()
        for star in cell.star
        for amplitude in ((None,) if study.limit.of == "amplitude" else cell.flare.amplitudes)
        for statistic in study.run.statistics
    ]

    def solved(one: tuple[Study, Star, float | None, str, Mapping[str, float | str]]) -> Limit:
        cell, star, amplitude, statistic, at = one
        return solve(cell, star, amplitude, statistic, engine, at)

    result.limits.extend(together(engine, solved, asked))
    return result


def smallest_amplitude(study: Study, engine: Engine | Pool | None = None) -> LimitResult:
    """The smallest flare that is detected; as `limiting_magnitude`."""
    return limiting_magnitude(_asking(study, "amplitude"), engine)


def shortest_exposure(study: Study, engine: Engine | Pool | None = None) -> LimitResult:
    """The shortest exposure in which the flares are detected; as `limiting_magnitude`."""
    return limiting_magnitude(_asking(study, "exposure"), engine)


def _asking(study: Study, of: str) -> Study:
    return study.model_copy(update={"limit": study.limit.model_copy(update={"of": of})})
