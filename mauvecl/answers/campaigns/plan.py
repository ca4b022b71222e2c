"""Plan of a campaign: visibility of targets, recovered and expected flares, and false alarms."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from mauvecl.answers.answer import Answer
from mauvecl.answers.campaigns.conditions import OrbitConditions
from mauvecl.answers.campaigns.plan_text import energy, months, two_digits
from mauvecl.answers.campaigns.planned import (
    NOTHING,
    CompletenessOf,
    Planned,
    TargetObservation,
    closed_form,
    errors_of_throughput,
    observe,
    rates_of,
    star_of,
)
from mauvecl.answers.campaigns.visible import VisibleAnswer, assumption_columns, visible
from mauvecl.answers.neighbour_list import share_columns
from mauvecl.answers.progress import reported
from mauvecl.device.stare_engine import Stares
from mauvecl.host.orbit.visibility import PARTICLES_SOURCE, THERMAL_SOURCE
from mauvecl.runs.pool import map_in_order
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.messages import Message, of_kind
from mauvecl.schema.physical import DAY_S
from mauvecl.schema.tables import Column, View, number, percent, table_of
from mauvecl.schema.text import printable
from mauvecl.search.completeness import Yield, recovered_per_day
from mauvecl.study.cases import Case
from mauvecl.study.messages import SATURATED, collect_messages
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool
    from mauvecl.study.assumptions import Use
    from mauvecl.study.orbits import PlanQuestion


def _interval(low: int | None, high: int | None) -> str:
    return "" if low is None else f"{low} to {high}"


#: Columns of the table of targets, without false alarms, which precede the last.
COLUMNS = (
    Column("target", "name", "", "name of the target", "target"),
    Column("seen", "seen_h", "h", "time in which the target is seen", "seen (h)", ".0f"),
    Column("hours", "", "h", "of it observed", "observed (h)", ".0f"),
    Column("E50", lambda one: one.energy_at(0.5), "erg",
           "bolometric energy from which on half of the flares are recovered", "E50 (erg)", energy),
    Column("E90", lambda one: one.energy_at(0.9), "erg",
           "bolometric energy from which on 90 % of the flares are recovered", "E90 (erg)", energy),
    Column("expected", lambda one: one.recovered.expected if one.recovered else np.nan, "",
           "flares recovered, by the rates as they are", "flares",
           lambda expected: two_digits(expected) if expected == expected else "not known"),
    Column("low", lambda one: one.recovered.low if one.recovered else None, "",
           "lower end of the 95 % interval: scatter of the rates and Poisson noise", "95 %", _interval,
           ("high",), int),
    Column("high", lambda one: one.recovered.high if one.recovered else None, "",
           "upper end of the 95 % interval", kind=int),
    Column("at_least_one", lambda one: one.recovered.at_least_one if one.recovered else np.nan, "",
           "probability of recovering any", "P(>= 1)", number(".2f")),
    Column("best_months", lambda one: " ".join(one.best_months), "", "those with most hours", "best months", months),
)  # fmt: skip
#: Columns of errors by a calibrated throughput.
THROUGHPUT_COLUMNS = (
    Column("E50_error", lambda one: one.of_throughput[0] if one.of_throughput else np.nan, "",
           "relative standard error of E50 by the calibration of the throughput", "E50 by throughput", percent(".2g")),
    Column("expected_error", lambda one: one.of_throughput[1] if one.of_throughput else np.nan, "",
           "relative standard error of the recovered flares by the calibration of the throughput",
           "flares by throughput", percent(".2g")),
)  # fmt: skip
#: Columns of the table of inputs.
STAR_COLUMNS = (
    Column("target", "name", "", "name of the target"),
    Column("ra", "observation.target.ra_deg", "deg", "right ascension"),
    Column("dec", "observation.target.dec_deg", "deg", "declination"),
    Column("position", "observation.target.source", "", "who says so"),
    Column("spectral_type", lambda one: one.observation.target.spectral_type or ""),
    Column("spectrum", lambda one: one.observation.star.library or "", "",
           "embedded spectrum that stands for the star"),
    Column("V", lambda one: one.observation.star.magnitude or 0.0, "mag"),
    Column("distance", lambda one: one.observation.star.distance_pc or 0.0, "pc"),
    Column("sky", lambda one: np.nan if one.observation.sky is None else one.observation.sky, "mag / arcsec2",
           "zodiacal light behind it, median over the days on which it is seen"),
    Column("signal_per_frame", "observation.signal_per_frame", "", "S/N of one frame with a flare of amplitude 1"),
    Column("energy_per_second", "observation.scale.erg_per_s", "erg / s",
           "bolometric energy of a second of equivalent duration"),
    Column("temperature", lambda one: one.observation.quiet.conditions["temperature_c"], "deg_C",
           "of the detector, mean while it is seen"),
    Column("hits", "observation.hits_per_cm2_s", "1 / (s cm2)",
           "of cosmic rays and trapped protons, mean while it is seen"),
    Column("window", lambda one: one.observation.window_s / 60, "min", "median stretch in which it is seen"),
    Column("saturated", lambda one: int(one.observation.quiet.saturated.sum()), "",
           "pixels left out since they saturate"),
    Column("rates", lambda one: one.no_rates if one.rates is None else one.rates.source, "",
           "where its flare rates are from, or why there are none"),
    Column("recovered_per_day",
           lambda one: np.nan if one.rates is None or one.completeness is None
           else recovered_per_day(one.rates, one.completeness), "", "flares recovered in a day of exposure"),
    Column("scatter", lambda one: np.nan if one.rates is None else one.rates.scatter_dex, "",
           "standard deviation of the rate's logarithm, dex"),
)  # fmt: skip
#: Columns of the table of recovered fractions and rates by energy.
ENERGY_COLUMNS = (
    Column("target", description="name of the target", kind=str),
    Column("energy", "", "erg", "bolometric"),
    Column("recovered", "", "", "share of flares of this energy that is recovered"),
    Column("rate_above", "", "1 / day", "flares of this energy or more, a day"),
)


@dataclass(frozen=True, eq=False)
class PlanAnswer(Answer):
    """Answer of `plan`."""

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "flare", "orbit", "processes", "stare", "seed")

    study: Study
    seen: VisibleAnswer
    planned: tuple[Planned, ...]

    @property
    def columns(self) -> tuple[Column, ...]:
        """Columns of the table of targets."""
        alarms = Column("false_alarms", lambda one: self.study.search.rate * one.hours / 24, "", "expected of noise",
                        "false alarms", two_digits)  # fmt: skip
        share = share_columns(self.study.has_neighbours, "observation.quiet.target_share")
        calibrated = any(one.of_throughput is not None for one in self.planned)
        return (*COLUMNS[:-1], alarms, *share, *(THROUGHPUT_COLUMNS if calibrated else ()), COLUMNS[-1])

    @property
    def table(self) -> QTable:
        """One row per target."""
        about = {"start": self.seen.times.iso(0.0), "days": self.seen.times.days}
        about |= {"false_alarms_per_day": self.study.search.rate}
        return table_of(self.columns, self.planned, **about, study=self.study.text())

    @property
    def heading(self) -> str:
        """Number of targets and time of the plan."""
        times = self.seen.times
        targets = "1 target" if len(self.planned) == 1 else f"{len(self.planned)} targets"
        return f"{targets}, {times.days:g} days from {times.iso(0.0)[:10]} (UTC)"

    @property
    def views(self) -> list[View]:
        return [View(self.heading, self.columns, self.table)]

    @property
    def stars(self) -> QTable:
        """Inputs, one row per target."""
        return table_of(STAR_COLUMNS, self.planned, study=self.study.text())

    @property
    def by_energy(self) -> QTable:
        """Recovered fraction and rate by energy, one row per target and energy where either changes."""
        rows = []
        for one in self.planned:
            if one.completeness is None:
                continue
            energies, p = one.completeness.energy_erg, one.completeness.probability
            first = max(int(np.argmax(p > 0)) - 1, 0)
            part = slice(first, min(first + 161, energies.size))
            rate = np.full(p[part].size, np.nan) if one.rates is None else one.rates.per_day_above(energies[part])
            rows.append({"target": one.name, "energy": energies[part], "recovered": p[part], "rate_above": rate})
        return table_of(ENERGY_COLUMNS, rows, study=self.study.text())

    @property
    def assumptions(self) -> Table:
        """All assumptions with their sources."""
        law = self.study.plan.law()
        orbit = self.study.orbit.orbit()
        rows = list(self.seen.visibility.limits.assumptions)
        rows += [
            ("stray light", "none", "not modelled"),
            (
                "orbit",
                orbit.resolved(self.seen.times),
                f"{orbit.elements.source}, epoch {orbit.elements.epoch}; mean is a Sun-synchronous orbit through them",
            ),
            ("throughput", self.study.observation.instrument, self.study.observation.load_instrument().notice),
            ("sky", "zodiacal light", "median over the days on which a target is seen; table of the MauveSim paper"),
            (
                "duration of flares",
                f"t_1/2 = {law.half_width_s:g} s (E / {law.at_erg:g} erg)^{law.exponent:g}, {law.scatter_dex:g} dex",
                "assumption; exponent of Maehara et al. 2015",
            ),
            ("shape of flares", self.study.search.shape, "every flare alike, no bursts"),
            (
                "light of flares",
                ("blackbody of " if self.study.flare.is_blackbody else "") + self.study.flare.light().describe(),
                "assumption; energies are those of all its light, spread alike in all directions",
            ),
            ("noise of a stare", "white", "in addition to the study's unknowns of a stare; see completeness"),
            *self._along_orbit,
            (
                "false alarms",
                f"{self.study.search.false_alarms:g} per {self.study.search.per} of exposure",
                "sets the threshold; of noise, not of hits by particles that look like flares",
            ),
            (
                "stars known by name",
                "V, spectral type",
                "V of the Hipparcos catalogue (variable stars to 0.2 mag), rounded types (to some two subtypes)",
            ),
            (
                "spectra",
                "library",
                "the embedded spectrum of the nearest type stands for the star, scaled to its V",
            ),
        ]
        rows += [(f"flare rates of {one.name}", one.rates.source, _measured(one)) for one in self.planned if one.rates]
        rows += [("where the satellite will be", "", text) for text in orbit.messages(self.seen.times)]
        rows += [(f"completeness of {one.name}", "", one.completeness.how) for one in self.planned if one.completeness]
        return table_of(assumption_columns("assumption"), rows)

    @property
    def _along_orbit(self) -> list[tuple[str, str, str]]:
        if not self.study.plan.along_orbit:
            return [("temperature and particles", "the study's", "the same for all targets")]
        hits = self.study.processes.with_particles(0.0).particle_processes
        return [
            ("temperature", "along the orbit", THERMAL_SOURCE),
            ("hits by particles", "along the orbit", PARTICLES_SOURCE),
            *(process.assumption for process in hits),
        ]

    @property
    def tables(self) -> dict[str, Table]:
        """Targets, inputs, fractions and rates by energy, months, days, assumptions."""
        return {
            "plan": self.table,
            "stars": self.stars,
            "energies": self.by_energy,
            "months": self.seen.months,
            "days": self.seen.by_day,
            "assumptions": self.assumptions,
        }

    @property
    def observed(self) -> list[Case]:
        """One frame of each target."""
        return [one.observation.case for one in self.planned]

    @cached_property
    def inputs(self) -> list[Expectation]:
        """One frame of each star."""
        return [one.observation.quiet for one in self.planned]

    @property
    def messages(self) -> list[str]:
        """Messages on saturation, targets without an answer, extrapolations and visibility."""
        lines = of_kind(collect_messages(self.inputs), SATURATED)
        if len(self.planned) > 1:
            lines.append("Each target is planned by itself: the hours of different targets may coincide.")
        for case in self.observed:
            if case.neighbours is not None:
                lines += case.neighbours.messages(case.label, case.instrument)
        typical = [one.name for one in self.planned if one.rates is not None and "typical" in one.rates.source]
        if typical:
            lines.append(
                f"Flare rates of {', '.join(typical)} are those typical of their types at 1000 Myr: mass_msun and "
                "age_myr, or their own rates, are more accurate."
            )
        for one in self.planned:
            if one.no_rates:
                lines.append(f"{one.no_rates[0].upper()}{one.no_rates[1:]}; its expected flares are not given.")
            if one.rates is not None and one.completeness is not None and one.extrapolated:
                low, high = one.rates.measured_erg
                lines.append(
                    f"E50 of {one.name}, {one.energy_at(0.5):.2g} erg, lies outside the {low:.2g} to {high:.2g} erg "
                    "for which its flare rates are published: they are extrapolated."
                )
        study = self.study
        if study.plan.completeness == "closed form" and (study.stare.has_unknowns or study.nuisances.usual):
            text = (
                "FALSE ALARMS may be more than stated: the closed form takes the stare for known, and it has unknowns; "
                "plan.completeness = 'injections' allows for them."
            )
            lines.append(Message(text, "false alarms"))
        if study.plan.along_orbit and study.processes.particle_processes:
            lines.append("The rate of particles in [processes] is not used: it follows the orbit (plan.along_orbit).")
        unused = dict.fromkeys(name for one in study.plan.targets for name in one.unused)
        if unused:
            lines.append(f"Columns of the table of targets that are not used: {printable(', '.join(unused), 300)}.")
        lines += self.seen.messages
        return list(dict.fromkeys(lines))


def _measured(one: Planned) -> str:
    assert one.rates is not None
    low, high = one.rates.measured_erg
    return f"published for {low:.2g} to {high:.2g} erg, bolometric; scatter {one.rates.scatter_dex:g} dex (assumption)"


@validated
def plan(
    study: Study,
    engine: Stares | Pool | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    completeness: CompletenessOf | None = None,
) -> PlanAnswer:
    """Plan a campaign on a study's targets.

    Parameters
    ----------
    study : Study
        Its ``plan`` defines the targets, its ``orbit`` time and position.
    engine : Stares or Pool, optional
        Simulator of injections; by default that of the default device. The checkpoint of a pool keeps finished targets.
    progress : callable, optional
        Called as ``progress(done, total)`` in targets.
    completeness : callable, optional
        Recovered fraction of flares by bolometric energy. By default the study's ``plan.completeness`` decides between
        injections into drawn noise and the closed form.

    Raises
    ------
    InputError
        If there are no targets, or a target's position, type, magnitude or distance is unknown.

    Examples
    --------
    >>> from mauvecl import Study, plan
    >>> study = Study().with_settings(["plan.targets=[{name = 'eps Eri'}]", "orbit.days=31", "plan.hours=100"])
    >>> answer = plan(study.with_settings(["plan.completeness='closed form'"]))
    >>> answer.table["hours"].value.tolist()
    [100.0]
    """
    if not study.plan.targets:
        raise InputError("the plan has no targets", "some, such as `plan.targets='targets.csv'`", key="plan.targets")
    if study.orbit.targets:
        raise InputError("both orbit.targets and plan.targets are given", "plan.targets alone", key="orbit.targets")
    completeness = completeness or _completeness(study.plan, engine)
    closed = completeness is closed_form
    for name, _ in study.processes.modulations if closed else ():
        raise InputError(
            f"processes.{name} with plan.completeness = 'closed form', which takes the stare for known",
            "'injections'",
            key=f"processes.{name}",
        )
    stars = [star_of(text, study.orbit.simbad) for text in study.plan.targets]
    if progress is not None:
        progress(0, len(stars))
    seen = visible(study)
    names, hours = seen.visibility.by_month()
    along = OrbitConditions.along(seen.visibility.track) if study.plan.along_orbit else None

    base = Case(study)

    def observations() -> Iterator[tuple[int, TargetObservation]]:
        for k, (text, star) in enumerate(zip(study.plan.targets, stars, strict=True)):
            yield k, observe(base, text, star, seen, k, along)

    def planned_for(item: tuple[int, TargetObservation]) -> Planned:
        k, one = item
        exposed = float(seen.visibility.hours[k])
        observed = exposed if study.plan.hours is None else min(exposed, study.plan.hours)
        order = np.argsort(-hours[:, k], kind="stable")[: study.plan.best_months]
        best = tuple(names[i] for i in sorted(order) if hours[i, k] > 0)
        its = None
        if one.window_s > 0:
            its = completeness(one) if one.signal_per_frame > 0 else NOTHING
        rates, why = rates_of(study.plan.targets[k], one)
        recovered = None
        if rates is not None:
            days = observed * 3600 / DAY_S
            recovered = Yield.of_expected(0.0, 0.0) if its is None else Yield.of(rates, its, days)
        of_throughput = errors_of_throughput(one, rates)
        return Planned(one, exposed, observed, its, rates, recovered, best, why, of_throughput)

    # With a pool, the noise of a target is drawn while the threshold of the next one is sampled.
    planned = tuple(reported(map_in_order(engine, planned_for, observations()), len(stars), progress))
    return PlanAnswer(study, seen, planned)


def _completeness(question: PlanQuestion, engine: Stares | Pool | None) -> CompletenessOf:
    """Return the function for the completeness that a plan requests."""
    if question.completeness == "closed form":
        return closed_form
    from mauvecl.answers.campaigns.planned_injections import inject_target

    return partial(inject_target, engine=engine or Stares())
