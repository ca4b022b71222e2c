"""Plans of campaigns: yields of flares for each target, in tables and in words."""

from __future__ import annotations

import calendar
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from mauvecl.answers.answer import IF_KNOWN, Answer, TableOf, reported, share_column
from mauvecl.answers.closed_forms import throughput_cases
from mauvecl.answers.inject import inject
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.answers.visible import VisibleAnswer, assumption_columns, visible_targets
from mauvecl.detection.nuisances import Nuisances
from mauvecl.device.stares import Stares
from mauvecl.flares import Curve
from mauvecl.flares.energies import BOLOMETRIC, EnergyScale, Rates, quiescent_luminosity
from mauvecl.host.arrays import Arrays, Float
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.host.orbit.orbit import Target
from mauvecl.host.orbit.visibility import PARTICLES_SOURCE, THERMAL_SOURCE, Particles, Thermal
from mauvecl.host.stars.library import nearest_spectrum
from mauvecl.noise.unknowns import COURSES
from mauvecl.runs.checkpoint import checkpointed
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.columns import Column, interval_columns, number, percent
from mauvecl.schema.errors import InputError, Message, of_kind, printable, together
from mauvecl.schema.fields import DAY_S
from mauvecl.schema.section import given_keys
from mauvecl.search.completeness import PER_DECADE, SMALL, Completeness, Yield, frame_signal, recovered_per_day
from mauvecl.search.search import frame_nuisances
from mauvecl.study.cases import SATURATED, Case, collect_messages
from mauvecl.study.observation import SkyLight
from mauvecl.study.plan import RATES, PlanTarget
from mauvecl.study.star import Star
from mauvecl.study.stare import InjectionQuestion
from mauvecl.study.study import Study


def two_digits(value: float) -> str:
    """Format a number with two significant digits, or without decimals if it is large."""
    return f"{value:.0f}" if value == 0 or value >= 9.95 else f"{value:#.2g}"


def energy(value: float) -> str:
    """Format an energy with two significant digits, or "none" if it is not finite."""
    return f"{value:.1e}" if math.isfinite(value) else "none"


def months(names: str) -> str:
    """Return months such as 2027-01 by name, with their years."""
    years: dict[str, list[str]] = {}
    for name in names.split():
        years.setdefault(name[:4], []).append(calendar.month_abbr[int(name[5:])])
    return ", ".join(f"{' '.join(of_year)} {year}" for year, of_year in years.items())


@dataclass(frozen=True, eq=False)
class TargetObservation:
    """Target as observed by the satellite."""

    number: int  # of the target in the study's plan
    target: Target
    case: Case  # of one frame, with the sky and the conditions below
    window_s: float  # median length of its windows; 0 if it is never visible
    sky: float | None = None  # zodiacal light, V mag arcsec^-2; None for the study's sky
    # Time (s) and deviation of the detector from its mean temperature (deg C), for one orbit from the start of a window
    # of median length; empty for the study's temperature.
    swing: tuple[tuple[float, float], ...] = ()

    @property
    def quiet(self) -> Expectation:
        """Expectation of one frame."""
        return self.case.quiet

    @cached_property
    def signal_per_frame(self) -> float:
        """S/N of a frame with a flare of amplitude 1; 0 if every pixel saturates.

        What is unknown in each frame is marginalised over; slower changes are left to the level of the search.
        """
        return self.signal_with(frame_nuisances(self.quiet, self.case.stare))

    def signal_with(self, unknown: Nuisances | None) -> float:
        """Return the S/N of such a frame with other unknowns, or with everything but the noise known."""
        (flare,) = self.case.expect(self.case.flaring(SMALL))
        added = [process.variance_dn2(self.quiet) for process in self.case.study.processes.additive.values()]
        hits = np.sum(added, axis=0) if added else None
        return frame_signal(self.quiet, flare, SMALL, added_variance_dn2=hits, unknown=unknown)

    @cached_property
    def scale(self) -> EnergyScale:
        """Bolometric energy of flares."""
        scale = self.case.energy_scale("bolometric")
        assert scale is not None
        return scale


#: Completeness for a star that saturates every pixel.
NOTHING = Completeness(np.array([1e24, 1e40]), np.zeros(2), BOLOMETRIC, "every pixel saturates: no flare is recovered")
#: Computes a target's completeness for bolometric energies.
CompletenessOf = Callable[[TargetObservation], Completeness]


@dataclass(frozen=True, eq=False)
class PlannedTarget:
    """Target of a plan with its expected flares."""

    observation: TargetObservation
    seen_h: float  # visible time, times the duty cycle
    hours: float  # observed time
    completeness: Completeness | None  # None if the target is never visible
    rates: Rates | None  # of bolometric energies; None if unknown
    recovered: Yield | None  # recovered flares; None if rates are unknown
    best_months: tuple[str, ...]
    no_rates: str = ""  # reason for unknown rates
    of_throughput: tuple[float, float] | None = None  # relative errors of E50 and yield by a calibrated throughput
    # Recovered flares by the closed form if everything but the noise is known; NaN if it is.
    ideal: float = math.nan

    @property
    def name(self) -> str:
        """Name of the target."""
        return self.observation.target.name

    def energy_at(self, probability: float) -> float:
        """Return the bolometric energy above which flares are recovered with a probability, erg; infinite if none."""
        return math.inf if self.completeness is None else self.completeness.energy_at(probability)

    @property
    def by_energy(self) -> dict[str, Any]:
        """Rows of the table of energies by column: none of a target that is never visible."""
        if self.completeness is None:
            return {"target": self.name, "energy": np.zeros(0), "recovered": np.zeros(0), "rate_above": np.zeros(0)}
        energies, p = self.completeness.energy_erg, self.completeness.probability
        first = max(int(np.argmax(p > 0)) - 1, 0)
        rows = slice(first, first + 161)
        rate = np.full(p[rows].size, np.nan) if self.rates is None else self.rates.per_day_above(energies[rows])
        return {"target": self.name, "energy": energies[rows], "recovered": p[rows], "rate_above": rate}

    @property
    def published(self) -> str:
        """Energies at which the rates were measured, for sentences; empty if rates are unknown."""
        return "" if self.rates is None else "published for {:.2g} to {:.2g} erg".format(*self.rates.measured_erg)


def closed_form(observation: TargetObservation, *, ideal: bool = False) -> Completeness:
    """Return the completeness of a bank of matched filters in white noise; see `Completeness.of_search`.

    `ideal` takes everything but the noise as known.
    """
    study = observation.case.study
    signal = observation.signal_with(None) if ideal else observation.signal_per_frame
    return Completeness.of_search(
        signal, observation.scale, window_s=observation.window_s, false_alarms_per_day=study.search.rate,
        bank=study.search.white_bank(observation.quiet.frame_s), law=study.plan.law(),
    )  # fmt: skip


def errors_of_throughput(observation: TargetObservation, rates: Rates | None) -> tuple[float, float] | None:
    """Return the relative errors of E50 and of the recovered flares by a calibrated throughput, to first order.

    They are those of the closed form; None if the throughput is not calibrated, or nothing is recovered.
    """
    calibrated = throughput_cases(observation.case)
    if not calibrated or not observation.signal_per_frame > 0 or not observation.window_s > 0:
        return None
    forms = [closed_form(replace(observation, case=case)) for case in (observation.case, *calibrated)]
    values = [(form.energy_at(0.5), np.nan if rates is None else recovered_per_day(rates, form)) for form in forms]
    # Errors of an infinite E50 and of a yield of zero are NaN.
    with np.errstate(divide="ignore", invalid="ignore"):
        nominal, *moved = np.log(values)
        energy, number = np.sqrt(((np.array(moved) - nominal) ** 2).sum(axis=0))
    return float(energy), float(number)


def rates_of(observation: TargetObservation) -> tuple[Rates | None, str]:
    """Return a target's flare rates by bolometric energy, or None and the reason why they are unknown."""
    case, flare = observation.case, observation.case.study.flare
    row = case.study.plan.targets[observation.number]
    try:
        rates = row.distribution(observation.target.spectral_type or "")
    except InputError as error:
        if given_keys(row, RATES):
            raise
        return None, str(error)
    if rates.definition == "light":
        return rates.in_band(BOLOMETRIC, flare=flare.light()), ""
    band, distance_pc = rates.amplitude_band, case.star.distance_pc
    assert distance_pc is not None
    measured = case.with_sections(flare=flare.model_copy(update={"band": band}))
    erg_per_s = replace(observation, case=measured).scale.erg_per_s
    return rates.of_light(erg_per_s, quiescent_luminosity(case.source, distance_pc, band)), ""


def star_of(row: PlanTarget, target: Target) -> Star:
    """Return the library star for a target; raises InputError if its type, magnitude or distance is not known."""
    properties: dict[str, Any] = {name: getattr(target, name) for name in ("spectral_type", "magnitude", "distance_pc")}
    missing = [name for name, value in properties.items() if value is None]
    if missing:
        gaia = [name for name in row.unused if name.casefold() == "phot_g_mean_mag" and "magnitude" in missing]
        gaia_text = f", and {gaia[0]} is a magnitude in G, not in V" if gaia else ""
        raise InputError(
            f"target {row.name!r} has no {' and no '.join(missing)}; give them in the table of targets, since it is "
            f"not in the embedded list{gaia_text}",
            key="plan.targets",
        )
    library = nearest_spectrum(properties.pop("spectral_type"))
    properties |= {name: getattr(row, name) for name in ("neighbours", "neighbours_of", "neighbour_share")}
    return Star(library=library, **properties)


def observe(
    case: Case, k: int, star: Star, visible: VisibleAnswer, along: tuple[Float, Float] | None
) -> TargetObservation:
    """Return the observation of target `k`, with the sky behind it and the conditions while it is visible.

    `along` has the detector's temperature (deg C) and the particle hits (cm-2 s-1) at each time of the orbit, or is
    None for those of the study.
    """
    target, study, when = visible.targets[k], case.study, visible.visibility.seen[:, k]
    windows, zodiacal = visible.windows[k], visible.zodiacal[k]
    changes: dict[str, Any] = {"star": (star,)}
    sky, window_s, swing = None, 0.0, tuple[tuple[float, float], ...]()
    has_sky = np.isfinite(zodiacal)
    if has_sky.any():
        # The median over the days on which the target is visible, or over all.
        used = has_sky & (visible.visibility.by_day(k) > 0)
        sky = float(np.median(zodiacal[used if used.any() else has_sky]))
        changes["sky"] = SkyLight(surface_brightness=sky)
    if when.any():
        window_s = float(np.median(windows.length_s))
    if when.any() and along is not None:
        temperature_c, hits = along
        mean_c, step_s = float(temperature_c[when].mean()), visible.times.step_s
        # The first window if several have the median length.
        typical = int(np.argmin(np.abs(windows.length_s - window_s)))
        first = round(float(windows.start_s[typical]) / step_s)
        orbit_c = temperature_c[first : first + int(np.ceil(study.orbit.orbit().elements.period_s / step_s))] - mean_c
        # Temperatures are those at the ends of steps.
        swing = tuple((float(n * step_s), float(value)) for n, value in enumerate(orbit_c, 1))
        changes["processes"] = study.processes.with_particles(float(hits[when].mean()))
        if study.observation.temperature_c is None:
            changes["observation"] = study.observation.model_copy(update={"temperature_c": mean_c})
    return TargetObservation(k, target, case.with_sections(**changes).one_frame, window_s, sky, swing)


#: Orbits of a stare; the baseline window of a search spans several of them.
ORBITS = 3
#: Number and range of injected half-widths, and number of their peak times.
WIDTHS, WIDTH_RANGE_S, POSITIONS = 10, (5.0, 3000.0), 20


def inject_target(observation: TargetObservation, engine: Stares | Pool | None = None) -> Completeness:
    """Compute the share of injected flares that the study's search finds, by bolometric energy.

    Each orbit of the stare has one window of the target's median length. The checkpoint of a pool keeps the result.
    """
    study = observation.case.study
    orbit_s = study.orbit.orbit().elements.period_s
    gap = max(orbit_s - observation.window_s, 0.0)
    changes: dict[str, Any] = {"duration_s": ORBITS * orbit_s, "orbit_s": orbit_s, "orbit_gap_s": gap, "gaps": (),
                               "along_orbit": False}  # fmt: skip
    swing = [(t, value) for t, value in observation.swing if t < orbit_s]
    if swing and study.stare.thermal is None:
        changes["thermal"] = Curve(points=tuple((n * orbit_s + t, value) for n in range(ORBITS) for t, value in swing))
    injections = InjectionQuestion(
        of="energy", sizes=2, widths=WIDTHS, half_width_low_s=WIDTH_RANGE_S[0], half_width_high_s=WIDTH_RANGE_S[1],
        count=study.plan.injections, positions=min(POSITIONS, study.plan.injections), fitted=0,
    )  # fmt: skip
    stare, search = study.stare.model_copy(update=changes), study.search.model_copy(update={"nulls": 0})
    question = observation.case.with_sections(stare=stare, search=search, injections=injections).study
    energy_erg = 10 ** np.arange(24.0, 40.0, 1 / PER_DECADE)

    def computed() -> Arrays:
        star = inject(question, engine).stars[0]
        probability = star.injected.by_energy(energy_erg, study.plan.law())
        return {
            "probability": probability,
            "threshold": np.array(star.threshold.value),
            "shifted": np.array(star.shifted),
        }

    depends_on = ("completeness of a target", question.text(), observation.quiet, observation.scale)
    arrays = checkpointed(engine.checkpoint if isinstance(engine, Pool) else None, depends_on, computed)
    method = (
        f"{question.injections.count} injections of each of {WIDTHS} half-widths into stretches of "
        f"{observation.window_s / 60:.0f} min, found above {float(arrays['threshold']):.2f} sigma, "
        f"{study.search.false_alarms:g} false alarms per {study.search.per}"
        + (", allowing for unknowns that the search leaves in" if arrays["shifted"] else "")
    )
    return Completeness(energy_erg, arrays["probability"], BOLOMETRIC, method)


def _throughput_column(name: str, k: int, of: str, heading: str) -> Column:
    """Return the column of errors by a calibrated throughput, for answers that have such an error."""
    return Column(
        name, lambda row: row.of_throughput[k] if row.of_throughput else np.nan, "",
        f"relative standard error of {of} by the calibration of the throughput", heading, percent(".2g"),
        when=lambda answer: any(target.of_throughput is not None for target in answer.planned),
    )  # fmt: skip


COLUMNS = (
    Column("target", "name", "", "name of the target", "target"),
    Column("seen", "seen_h", "h", "time in which the target is seen, times the duty cycle", "seen (h)", ".0f",
           detail=True),
    Column("hours", "", "h", "part of it that is observed", "observed (h)", ".0f"),
    Column("E50", lambda row: row.energy_at(0.5), "erg",
           "bolometric energy from which on half of the flares are recovered", "E50 (erg)", energy),
    Column("E90", lambda row: row.energy_at(0.9), "erg",
           "bolometric energy from which on 90 % of the flares are recovered", "E90 (erg)", energy, detail=True),
    Column("expected", lambda row: row.recovered.expected if row.recovered else np.nan, "",
           "flares recovered, by the rates as they are", "flares",
           lambda expected: two_digits(expected) if expected == expected else "not known"),
    Column("ideal", "", "", "the same by the closed form if everything but the noise were known", "ideal",
           lambda expected: two_digits(expected) if expected == expected else ""),
    *interval_columns("{}", lambda row: (row.recovered.low, row.recovered.high) if row.recovered else (None, None), "",
                      "the 95 % interval: scatter of the rates and Poisson noise", "95 %",
                      lambda low, high: "" if low is None else f"{low} to {high}", kind=int),
    Column("at_least_one", lambda row: row.recovered.at_least_one if row.recovered else np.nan, "",
           "probability of recovering any", "P(>= 1)", number(".2f"), detail=True),
    Column("false_alarms", lambda row: row.observation.case.study.search.rate * row.hours / 24, "",
           "expected from noise", "false alarms", two_digits, detail=True),
    share_column("observation.quiet.target_share"),
    _throughput_column("E50_error", 0, "E50", "E50 by throughput"),
    _throughput_column("expected_error", 1, "the recovered flares", "flares by throughput"),
    Column("best_months", lambda row: " ".join(row.best_months), "", "months with the most hours", "best months",
           months, detail=True),
)  # fmt: skip
STAR_COLUMNS = (
    Column("target", "name", "", "name of the target"),
    Column("ra", "observation.target.ra_deg", "deg", "right ascension"),
    Column("dec", "observation.target.dec_deg", "deg", "declination"),
    Column("position", "observation.target.source", "", "source of the position"),
    Column("spectral_type", lambda row: row.observation.target.spectral_type or ""),
    Column("spectrum", lambda row: row.observation.case.star.library or "", "",
           "embedded spectrum that stands for the star"),
    Column("V", lambda row: row.observation.case.star.magnitude or 0.0, "mag"),
    Column("distance", lambda row: row.observation.case.star.distance_pc or 0.0, "pc"),
    Column("sky", lambda row: np.nan if row.observation.sky is None else row.observation.sky, "mag / arcsec2",
           "zodiacal light behind it, median over the days on which it is seen"),
    Column("signal_per_frame", "observation.signal_per_frame", "", "S/N of one frame with a flare of amplitude 1"),
    Column("energy_per_second", "observation.scale.erg_per_s", "erg / s",
           "bolometric energy of a second of equivalent duration"),
    Column("temperature", lambda row: row.observation.quiet.conditions["temperature_c"], "deg_C",
           "of the detector, mean while it is seen"),
    Column("hits", "observation.case.study.processes.particles_per_cm2_s", "1 / (s cm2)",
           "of cosmic rays and trapped protons, mean while it is seen"),
    Column("window", lambda row: row.observation.window_s / 60, "min", "median stretch in which it is seen"),
    Column("saturated", lambda row: int(row.observation.quiet.saturated.sum()), "",
           "pixels left out since they saturate"),
    Column("rates", lambda row: row.no_rates if row.rates is None else row.rates.source, "",
           "source of its flare rates, or the reason why there are none"),
    Column("recovered_per_day",
           lambda row: np.nan if row.rates is None or row.completeness is None
           else recovered_per_day(row.rates, row.completeness), "", "flares recovered in a day of exposure"),
    Column("scatter", lambda row: np.nan if row.rates is None else row.rates.scatter_dex, "",
           "standard deviation of the rate's logarithm, dex"),
)  # fmt: skip
ENERGY_COLUMNS = (
    Column("target", description="name of the target", kind=str),
    Column("energy", "", "erg", "bolometric"),
    Column("recovered", "", "", "share of flares of this energy that is recovered"),
    Column("rate_above", "", "1 / day", "flares of this energy or more, a day"),
)


@dataclass(frozen=True, eq=False)
class PlanAnswer(Answer):
    """Answer of `plan`: hours, recovered flares and false alarms of each target, and everything that is assumed."""

    USES = ("instrument", "flare", "orbit", "processes", "stare", "seed")

    study: Study
    seen: VisibleAnswer
    planned: tuple[PlannedTarget, ...]

    #: One row per target.
    table = TableOf("plan", COLUMNS, "planned", title=lambda answer: answer.heading, meta=lambda answer: {
        "start": answer.seen.times.iso(0.0), "days": answer.seen.times.days,
        "false_alarms_per_day": answer.study.search.rate, "study": answer.study.text()})  # fmt: skip
    #: Inputs, one row per target.
    stars = TableOf("stars", STAR_COLUMNS, "planned")
    #: Recovered fraction and rate by energy, one row per target and energy where either changes.
    by_energy = TableOf("energies", ENERGY_COLUMNS, lambda answer: [target.by_energy for target in answer.planned])
    months = TableOf("months", (), "seen.months")
    days = TableOf("days", (), "seen.by_day")
    #: All assumptions with their sources.
    assumptions = TableOf("assumptions", assumption_columns("assumption"), "_assumptions", meta=())

    @property
    def headline(self) -> str:
        """The expected flares of the target with most of them."""
        with_rates = [target for target in self.planned if target.recovered is not None]
        if not with_rates:
            return f"No flares are predicted for {self.planned[0].name}: its flare rates are not known."
        best = max(with_rates, key=lambda target: target.recovered.expected if target.recovered else 0.0)
        assert best.recovered is not None
        ideal = "" if np.isnan(best.ideal) else f"; {two_digits(best.ideal)} {IF_KNOWN}"
        known = "targets" if len(with_rates) == len(self.planned) else "targets with known flare rates"
        most = f", the most of {len(with_rates)} {known}" if len(with_rates) > 1 else ""
        return (
            f"{self.instrument_name} would recover {two_digits(best.recovered.expected)} flares of "
            f"{best.name} in {best.hours:.0f} h (95 % of campaigns: {best.recovered.low} to {best.recovered.high}"
            f"{ideal}){most}."
        )

    @property
    def heading(self) -> str:
        """Number of targets and time of the plan."""
        times = self.seen.times
        targets = "1 target" if len(self.planned) == 1 else f"{len(self.planned)} targets"
        return f"{targets}, {times.days:g} days from {times.iso(0.0)[:10]} (UTC)"

    @property
    def _assumptions(self) -> list[tuple[str, str, str]]:
        """Quantity, value and source of every assumption."""
        study, orbit, law = self.study, self.study.orbit.orbit(), self.study.plan.law()
        e = orbit.elements
        elements = f"{e.source}, epoch {e.epoch}; mean is a Sun-synchronous orbit through them"
        scale = f"{law.half_width_s:g} s (E / {law.at_erg:g} erg)^{law.exponent:g}"
        half_width = f"t_1/2 = {scale}, {law.scatter_dex:g} dex"
        maehara = "; exponent of Maehara et al. 2015" if law.exponent == type(law)().exponent else ""
        light = ("blackbody of " if study.flare.is_blackbody else "") + study.flare.light().describe()
        alarms = f"{study.search.false_alarms:g} per {study.search.per} of exposure"
        return [
            *self.seen.visibility.limits.assumptions,
            ("stray light", "none", "not modelled"),
            ("orbit", orbit.resolved(self.seen.times), elements),
            ("throughput", study.observation.instrument, study.observation.load_instrument().notice),
            ("sky", "zodiacal light", "median over the days on which a target is seen; table of the MauveSim paper"),
            ("duration of flares", half_width, f"assumption{maehara}"),
            ("shape of flares", study.search.shape, "every flare alike, no bursts"),
            ("light of flares", light,
             "assumption; energies are those of all its light, emitted equally in all directions"),
            ("noise of a stare", "white", "in addition to the study's unknowns of a stare; see completeness"),
            *self._along_orbit,
            ("false alarms", alarms, "sets the threshold; of noise, not of hits by particles that look like flares"),
            ("stars known by name", "V, spectral type",
             "V of the Hipparcos catalogue (variable stars to 0.2 mag), rounded types (to some two subtypes)"),
            ("spectra", "library", "the embedded spectrum of the nearest type stands for the star, scaled to its V"),
            *(
                (f"flare rates of {target.name}", target.rates.source,
                 f"{target.published}, bolometric; scatter {target.rates.scatter_dex:g} dex (assumption)")
                for target in self.planned
                if target.rates
            ),
            *(("where the satellite will be", "", text) for text in orbit.messages(self.seen.times)),
            *(
                (f"completeness of {target.name}", "", target.completeness.how)
                for target in self.planned
                if target.completeness
            ),
        ]  # fmt: skip

    @property
    def _along_orbit(self) -> list[tuple[str, str, str]]:
        """Assumptions on what changes along the orbit."""
        if not self.study.plan.along_orbit:
            return [("temperature and particles", "the study's", "the same for all targets")]
        hits, mean_c = self.study.processes.with_particles(0.0).particle_processes, self.study.observation.temperature_c
        about = "" if mean_c is None else f", about the study's mean of {mean_c:g} deg C"
        return [
            ("temperature", f"along the orbit{about}", THERMAL_SOURCE),
            ("hits by particles", "along the orbit", PARTICLES_SOURCE),
            *(process.assumption for process in hits),
        ]

    @property
    def observed(self) -> list[Case]:
        """One frame of each target."""
        return [target.observation.case for target in self.planned]

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        return self.report("plan", self.study.plan.report)

    @property
    def inputs(self) -> list[Expectation]:
        """One frame of each star."""
        return [target.observation.quiet for target in self.planned]

    @property
    def messages(self) -> list[str]:
        """Messages on saturation, targets without an answer, extrapolations and visibility."""
        study, lines = self.study, of_kind(collect_messages(self.inputs), SATURATED)
        if len(self.planned) > 1:
            lines.append("Each target is planned by itself: the hours of different targets may coincide.")
        for case in self.observed:
            if case.neighbours is not None:
                lines += case.neighbours.messages(case.label, case.instrument)
        if no_sky := [target.name for target in self.planned if target.observation.sky is None and target.seen_h]:
            lines.append(
                f"The zodiacal light behind {', '.join(no_sky)} is unknown so near the Sun: the study's sky is used."
            )
        lines += self._messages_on_rates
        slow = any(getattr(study.stare, name) for name in (*COURSES, "pointing"))
        if study.plan.completeness == "closed form" and (slow or study.nuisances.usual):
            text = (
                "FALSE ALARMS may be more than stated: the closed form marginalises over what is unknown in each "
                "frame, and takes slower changes for known; `plan.completeness='injections'` allows for them."
            )
            lines.append(Message(text, "false alarms"))
        if study.plan.along_orbit and study.processes.particle_processes:
            lines.append("The rate of particles in [processes] is not used: it follows the orbit (plan.along_orbit).")
        unused = dict.fromkeys(name for target in study.plan.targets for name in target.unused)
        if unused:
            lines.append(f"Columns of the table of targets that are not used: {printable(', '.join(unused), 300)}.")
        return list(dict.fromkeys([*lines, *self.seen.messages]))

    @property
    def _messages_on_rates(self) -> list[str]:
        """Messages on targets whose flare rates are typical, unknown or extrapolated."""
        planned, lines = self.planned, list[str]()
        typical = [target.name for target in planned if target.rates is not None and "typical" in target.rates.source]
        if typical:
            lines.append(
                f"Flare rates of {', '.join(typical)} are those typical of their types at 1000 Myr: mass_msun and "
                "age_myr, or their own rates, are more accurate."
            )
        for why in (target.no_rates for target in planned if target.no_rates):
            lines.append(f"{why[0].upper()}{why[1:]}; its expected flares are not given.")
        beyond = []
        for target in planned:
            if target.completeness is not None and target.rates is not None:
                e50, (low, high) = target.energy_at(0.5), target.rates.measured_erg
                beyond += [] if low <= e50 <= high else [f"{target.name} ({e50:.2g} erg, {target.published})"]
        return [*lines, *([f"Flare rates are extrapolated to E50 of {', '.join(beyond)}."] if beyond else [])]


@by_keywords("targets")
def plan(
    study: Study,
    engine: Stares | Pool | None = None,
    progress: Progress = None,
    *,
    completeness: CompletenessOf | None = None,
) -> PlanAnswer:
    """Plan a campaign on a study's targets: its ``plan`` defines them, its ``orbit`` time and position.

    Parameters
    ----------
    completeness : callable, optional
        Recovered fraction of flares by bolometric energy. By default the study's ``plan.completeness`` decides between
        injections into drawn noise and the closed form.

    Examples
    --------
    >>> from mauvecl import Study, plan
    >>> study = Study().with_settings(["plan.targets=[{name = 'eps Eri'}]", "orbit.days=31", "plan.hours=100"])
    >>> answer = plan(study.with_settings(["plan.completeness='closed form'"]))
    >>> answer.table["hours"].value.tolist()
    [100.0]
    """
    if not study.plan.targets:
        in_study = "plan.targets=['eps Eri'] in a study"
        raise InputError(f"the plan needs targets, such as `targets='targets.csv'` or {in_study}", key="plan.targets")
    if study.orbit.targets:
        raise InputError("both orbit.targets and plan.targets are given; use plan.targets alone", key="orbit.targets")
    if completeness is None and study.plan.completeness == "closed form":
        completeness = closed_form
        for name, _ in study.processes.modulations:
            raise InputError(
                f"processes.{name} needs plan.completeness = 'injections', since 'closed form' takes the stare for "
                "known", key=f"processes.{name}",
            )  # fmt: skip
    targets, stars, errors = list[Target](), list[Star](), list[InputError]()
    for row in study.plan.targets:
        try:
            targets.append(row.target(study.orbit.simbad))
            stars.append(star_of(row, targets[-1]))
        except InputError as error:
            errors.append(error)
    if errors:
        # One error names all targets without a star.
        raise together(errors)
    if progress is not None:
        progress(0, len(stars))
    visible, base, along = visible_targets(study, targets), Case(study), None
    if study.plan.along_orbit:
        track = visible.visibility.track
        along = Thermal().temperature_c(track.sunlight, track.times.step_s), Particles().rate_per_cm2_s(track)
    observed = (observe(base, k, star, visible, along) for k, star in enumerate(stars))
    planned_for = partial(_planned, visible, completeness or partial(inject_target, engine=engine or Stares()))
    # With a pool, the noise of a target is drawn while the threshold of the next one is sampled.
    planned = tuple(reported(map_in_order(engine, planned_for, observed), len(stars), progress))
    return PlanAnswer(study, visible, planned)


def _planned(visible: VisibleAnswer, completeness: CompletenessOf, target: TargetObservation) -> PlannedTarget:
    """Return the plan of an observed target."""
    study, k, share = visible.study, target.number, None
    if target.window_s > 0:
        share = completeness(target) if target.signal_per_frame > 0 else NOTHING
    exposed, (names, hours) = float(visible.visibility.hours[k]), visible.by_month
    observed = exposed if study.plan.hours is None else min(exposed, study.plan.hours)
    days = observed * 3600 / DAY_S
    # The months in which it is seen for the most hours, in order.
    most = sorted(np.argsort(-hours[:, k], kind="stable")[: study.plan.best_months])
    best = tuple(names[i] for i in most if hours[i, k] > 0)
    rates, why = rates_of(target)
    recovered, ideal = None, float("nan")
    if rates is not None:
        recovered = Yield.of_expected(0.0, 0.0) if share is None else Yield.of(rates, share, days)
        if study.nuisances.usual and share not in (None, NOTHING):
            ideal = recovered_per_day(rates, closed_form(target, ideal=True)) * days
    errors = errors_of_throughput(target, rates)
    return PlannedTarget(target, exposed, observed, share, rates, recovered, best, why, errors, ideal)
