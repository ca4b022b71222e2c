"""Targets of a plan: their frames, flare rates, and the flares that are recovered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.campaigns.conditions import Conditions, OrbitConditions
from mauvecl.flares.energies import BOLOMETRIC, EnergyScale, Rates, quiescent_luminosity
from mauvecl.host.orbit.orbit import Target
from mauvecl.host.stars.library import nearest_spectrum
from mauvecl.schema.errors import InputError
from mauvecl.search.completeness import Completeness, Yield, frame_signal, recovered_per_day
from mauvecl.study.cases import Case
from mauvecl.study.orbits import PlanTarget
from mauvecl.study.sections import SkyLight, Star
from mauvecl.study.stare_expectation import energy_scale
from mauvecl.study.unknowns import throughput_cases

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.visible import VisibleAnswer
    from mauvecl.host.exposure.expectation import Expectation

#: Amplitude of the flare from which the signal per amplitude follows; its own photon noise is neglected.
SMALL = 0.01


@dataclass(frozen=True, eq=False)
class TargetObservation:
    """Target as observed by the satellite."""

    target: Target
    case: Case  # of one frame, with the sky and the conditions below
    window_s: float  # median length of its windows; 0 if it is never visible
    sky: float | None = None  # zodiacal light, V mag arcsec^-2; None for the study's sky
    conditions: Conditions | None = None  # along the orbit; None for the study's

    @property
    def star(self) -> Star:
        """Library star that represents the target."""
        return self.case.star

    @property
    def quiet(self) -> Expectation:
        """Expectation of one frame."""
        return self.case.quiet

    @property
    def hits_per_cm2_s(self) -> float:
        """Rate of particle hits."""
        return float(self.case.study.processes.particles_per_cm2_s)

    @cached_property
    def signal_per_frame(self) -> float:
        """S/N of a frame with a flare of amplitude 1; 0 if every pixel saturates."""
        (flare,) = self.case.expect(self.case.flaring(SMALL))
        added = [process.variance_dn2(self.quiet) for process in self.case.study.processes.additive.values()]
        hits = np.sum(added, axis=0) if added else None
        return frame_signal(self.quiet, flare, SMALL, added_variance_dn2=hits)

    @cached_property
    def scale(self) -> EnergyScale:
        """Bolometric energy of flares."""
        scale = energy_scale(self.case.study, self.case.source, "bolometric", self.case.study.flare.temperature_k)
        assert scale is not None
        return scale


#: Completeness for a star that saturates every pixel.
NOTHING = Completeness(np.array([1e24, 1e40]), np.zeros(2), BOLOMETRIC, "every pixel saturates: no flare is recovered")
#: Computes a target's completeness for bolometric energies.
CompletenessOf = Callable[[TargetObservation], Completeness]


@dataclass(frozen=True, eq=False)
class Planned:
    """Target of a plan with its expected flares."""

    observation: TargetObservation
    seen_h: float  # visible time
    hours: float  # observed time
    completeness: Completeness | None  # None if the target is never visible
    rates: Rates | None  # of bolometric energies; None if unknown
    recovered: Yield | None  # recovered flares; None if rates are unknown
    best_months: tuple[str, ...]
    no_rates: str = ""  # reason for unknown rates
    of_throughput: tuple[float, float] | None = None  # relative errors of E50 and yield by a calibrated throughput

    @property
    def name(self) -> str:
        """Name of the target."""
        return self.observation.target.name

    def energy_at(self, probability: float) -> float:
        """Return the bolometric energy above which flares are recovered with a probability, erg; infinite if none."""
        return float("inf") if self.completeness is None else self.completeness.energy_at(probability)

    @property
    def extrapolated(self) -> bool:
        """Whether flares of E50 lie outside the energies at which the rates were measured."""
        if self.rates is None:
            return False
        low, high = self.rates.measured_erg
        return not low <= self.energy_at(0.5) <= high


def closed_form(observation: TargetObservation) -> Completeness:
    """Return the completeness of a bank of matched filters in white noise; see `Completeness.of_search`."""
    study = observation.case.study
    return Completeness.of_search(
        observation.signal_per_frame,
        observation.scale,
        window_s=observation.window_s,
        false_alarms_per_day=study.search.rate,
        bank=study.search.white_bank(observation.quiet.frame_s),
        law=study.plan.law(),
    )


def errors_of_throughput(observation: TargetObservation, rates: Rates | None) -> tuple[float, float] | None:
    """Return the relative errors of E50 and of the recovered flares by a calibrated throughput, to first order.

    They are those of the closed form; None if the throughput is not calibrated, or nothing is recovered.
    """
    calibrated = throughput_cases(observation.case)
    if not calibrated or not observation.signal_per_frame > 0 or not observation.window_s > 0:
        return None

    def logarithms(case: Case) -> tuple[float, float]:
        its = closed_form(replace(observation, case=case))
        number = np.nan if rates is None else recovered_per_day(rates, its)
        return float(np.log(its.energy_at(0.5))), float(np.log(number))

    moved = np.array([logarithms(case) for case in calibrated]) - logarithms(observation.case)
    energy, number = np.sqrt((moved**2).sum(axis=0))
    return float(energy), float(number)


def rates_of(text: PlanTarget, observation: TargetObservation) -> tuple[Rates | None, str]:
    """Return a target's flare rates by bolometric energy, or None and the reason why they are unknown."""
    case, flare = observation.case, observation.case.study.flare
    try:
        rates = text.distribution(observation.target.spectral_type or "")
    except InputError as error:
        if any(getattr(text, name) is not None for name in ("mass_msun", "alpha", "rates_file", "rates")):
            raise
        return None, str(error)
    if rates.definition == "light":
        return rates.in_band(BOLOMETRIC, flare=flare.light()), ""
    band, distance_pc = rates.amplitude_band, case.star.distance_pc
    measured = case.with_sections(flare=flare.model_copy(update={"band": band}))
    scale = energy_scale(measured.study, measured.source, "bolometric", flare.temperature_k)
    assert scale is not None
    assert distance_pc is not None
    return rates.of_light(scale.erg_per_s, quiescent_luminosity(case.source, distance_pc, band)), ""


def star_of(text: PlanTarget, simbad: bool) -> Star:
    """Return the library star that represents a target.

    Raises InputError if its type, magnitude or distance is neither given nor known.
    """
    known = text.target(simbad)
    given: dict[str, Any] = {
        "spectral_type": text.spectral_type or known.spectral_type,
        "magnitude": known.magnitude if text.magnitude is None else text.magnitude,
        "distance_pc": known.distance_pc if text.distance_pc is None else text.distance_pc,
    }
    missing = [name for name, value in given.items() if value is None]
    if missing:
        raise InputError(
            f"target {text.name!r} has no {' and no '.join(missing)}",
            "them in the table of targets: it is not in the embedded list",
            key="plan.targets",
            value=text.name,
        )
    library = nearest_spectrum(given.pop("spectral_type"))
    given |= {name: getattr(text, name) for name in ("neighbours", "neighbours_of", "neighbour_share")}
    return Star(library=library, **given)


def observe(
    case: Case, text: PlanTarget, star: Star, seen: VisibleAnswer, k: int, along: OrbitConditions | None = None
) -> TargetObservation:
    """Return the observation of target `k`, with the sky behind it and the conditions along the orbit."""
    target, study = seen.targets[k], case.study
    if text.spectral_type is not None:
        target = replace(target, spectral_type=text.spectral_type)
    conditions = None if along is None else along.of(seen.visibility, k, study.orbit.orbit().elements.period_s)
    lengths = seen.windows[k].length_s
    window, sky = float(np.median(lengths)) if lengths.size else 0.0, sky_behind(seen, k)
    changes: dict[str, Any] = {"star": (star,)}
    if sky is not None:
        changes["sky"] = SkyLight(surface_brightness=sky)
    if conditions is not None:
        changes["processes"] = study.processes.with_particles(conditions.hits_per_cm2_s)
        if study.observation.temperature_c is None:
            at = {"temperature_c": conditions.temperature_c}
            changes["observation"] = study.observation.model_copy(update=at)
    return TargetObservation(target, case.with_sections(**changes).one_frame, window, sky, conditions)


def sky_behind(seen: VisibleAnswer, k: int) -> float | None:
    """Return the median sky brightness, V mag arcsec^-2, over the days on which a target is visible, or over all."""
    light, hours = seen.zodiacal[k], seen.visibility.by_day(k)
    used = np.isfinite(light) & (hours > 0)
    used = used if used.any() else np.isfinite(light)
    return float(np.median(light[used])) if used.any() else None
