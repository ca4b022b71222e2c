"""Targets of a plan: their observations, completeness, and yields."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.closed_forms import throughput_cases
from mauvecl.answers.inject import inject
from mauvecl.flares.energies import BOLOMETRIC, EnergyScale, Rates, quiescent_luminosity
from mauvecl.flares.settings import Curve
from mauvecl.host.orbit.orbit import Target
from mauvecl.host.stars.library import nearest_spectrum
from mauvecl.runs.checkpoint import kept
from mauvecl.runs.pool import Pool
from mauvecl.schema.errors import InputError
from mauvecl.schema.section import given_keys
from mauvecl.search.completeness import PER_DECADE, SMALL, Completeness, frame_signal, recovered_per_day
from mauvecl.search.templates import frame_nuisances
from mauvecl.study.cases import Case
from mauvecl.study.observation import SkyLight
from mauvecl.study.plan import RATES, PlanTarget
from mauvecl.study.star import Star
from mauvecl.study.stare import InjectionQuestion
from mauvecl.study.stares import energy_scale

if TYPE_CHECKING:
    from mauvecl.answers.visible import VisibleAnswer
    from mauvecl.detection.nuisances import Nuisances
    from mauvecl.detection.snr import Arrays
    from mauvecl.device.stares import Stares
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.search.completeness import DurationLaw, Yield

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TargetObservation:
    """Target as observed by the satellite."""

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
    def published(self) -> str:
        """Energies at which the rates were measured, for sentences; empty if rates are unknown."""
        return "" if self.rates is None else "published for {:.2g} to {:.2g} erg".format(*self.rates.measured_erg)


def closed_form(observation: TargetObservation, *, known: bool = False) -> Completeness:
    """Return the completeness of a bank of matched filters in white noise; see `Completeness.of_search`.

    `known` takes everything but the noise as known.
    """
    study = observation.case.study
    signal = observation.signal_with(None) if known else observation.signal_per_frame
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
    answers = [closed_form(replace(observation, case=case)) for case in (observation.case, *calibrated)]
    values = [(its.energy_at(0.5), np.nan if rates is None else recovered_per_day(rates, its)) for its in answers]
    nominal, *moved = np.log(values)
    energy, number = np.sqrt(((np.array(moved) - nominal) ** 2).sum(axis=0))
    return float(energy), float(number)


def rates_of(text: PlanTarget, observation: TargetObservation) -> tuple[Rates | None, str]:
    """Return a target's flare rates by bolometric energy, or None and the reason why they are unknown."""
    case, flare = observation.case, observation.case.study.flare
    try:
        rates = text.distribution(observation.target.spectral_type or "")
    except InputError as error:
        if given_keys(text, RATES):
            raise
        return None, str(error)
    if rates.definition == "light":
        return rates.in_band(BOLOMETRIC, flare=flare.light()), ""
    band, distance_pc = rates.amplitude_band, case.star.distance_pc
    assert distance_pc is not None
    measured = case.with_sections(flare=flare.model_copy(update={"band": band}))
    erg_per_s = replace(observation, case=measured).scale.erg_per_s
    return rates.of_light(erg_per_s, quiescent_luminosity(case.source, distance_pc, band)), ""


def star_of(text: PlanTarget, simbad: bool) -> Star:
    """Return the library star that represents a target.

    Raises InputError if its type, magnitude or distance is neither given nor known.
    """
    target = text.target(simbad)
    given: dict[str, Any] = {
        "spectral_type": text.spectral_type or target.spectral_type,
        "magnitude": target.magnitude if text.magnitude is None else text.magnitude,
        "distance_pc": target.distance_pc if text.distance_pc is None else text.distance_pc,
    }
    missing = [name for name, value in given.items() if value is None]
    if missing:
        gaia = [name for name in text.unused if name.casefold() == "phot_g_mean_mag" and "magnitude" in missing]
        other = f", and {gaia[0]} is a magnitude in G, not in V" if gaia else ""
        raise InputError(
            f"target {text.name!r} has no {' and no '.join(missing)}; give them in the table of targets, since it is "
            f"not in the embedded list{other}",
            key="plan.targets",
        )
    library = nearest_spectrum(given.pop("spectral_type"))
    given |= {name: getattr(text, name) for name in ("neighbours", "neighbours_of", "neighbour_share")}
    return Star(library=library, **given)


def observe(
    case: Case, text: PlanTarget, star: Star, seen: VisibleAnswer, k: int, along: tuple[Float, Float] | None
) -> TargetObservation:
    """Return the observation of target `k`, with the sky behind it and the conditions while it is visible.

    `along` has the detector's temperature (deg C) and the particle hits (cm-2 s-1) at each time of the orbit, or is
    None for those of the study.
    """
    target, study, visible = seen.targets[k], case.study, seen.visibility.seen[:, k]
    if text.spectral_type is not None:
        target = replace(target, spectral_type=text.spectral_type)
    windows, zodiacal = seen.windows[k], seen.zodiacal[k]
    changes: dict[str, Any] = {"star": (star,)}
    sky, window_s, swing = None, 0.0, tuple[tuple[float, float], ...]()
    known = np.isfinite(zodiacal)
    if known.any():
        # The median over the days on which the target is visible, or over all.
        used = known & (seen.visibility.by_day(k) > 0)
        sky = float(np.median(zodiacal[used if used.any() else known]))
        changes["sky"] = SkyLight(surface_brightness=sky)
    if visible.any():
        window_s = float(np.median(windows.length_s))
    if visible.any() and along is not None:
        temperature_c, hits = along
        mean_c, step_s = float(temperature_c[visible].mean()), seen.times.step_s
        # The first window if several have the median length.
        typical = int(np.argmin(np.abs(windows.length_s - window_s)))
        first = round(float(windows.start_s[typical]) / step_s)
        orbit_c = temperature_c[first : first + int(np.ceil(study.orbit.orbit().elements.period_s / step_s))] - mean_c
        swing = tuple((float((n + 0.5) * step_s), float(value)) for n, value in enumerate(orbit_c))
        changes["processes"] = study.processes.with_particles(float(hits[visible].mean()))
        if study.observation.temperature_c is None:
            changes["observation"] = study.observation.model_copy(update={"temperature_c": mean_c})
    return TargetObservation(target, case.with_sections(**changes).one_frame, window_s, sky, swing)


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
    if observation.swing and study.stare.thermal is None:
        swing = [(t, value) for t, value in observation.swing if t < orbit_s]
        changes["thermal"] = Curve(points=tuple((n * orbit_s + t, value) for n in range(ORBITS) for t, value in swing))
    injections = InjectionQuestion(
        of="energy", sizes=2, widths=WIDTHS, half_width_low_s=WIDTH_RANGE_S[0], half_width_high_s=WIDTH_RANGE_S[1],
        count=study.plan.injections, positions=min(POSITIONS, study.plan.injections), fitted=0,
    )  # fmt: skip
    stare, search = study.stare.model_copy(update=changes), study.search.model_copy(update={"nulls": 0})
    question = observation.case.with_sections(stare=stare, search=search, injections=injections).study
    energy = 10 ** np.arange(24.0, 40.0, 1 / PER_DECADE)

    def computed() -> Arrays:
        star = inject(question, engine).stars[0]
        widths = np.array(star.injected.half_widths_s)
        found = found_by_energy(star.injected.critical.reshape(widths.size, -1), widths, energy, study.plan.law())
        return {"probability": found, "threshold": np.array(star.threshold.value), "shifted": np.array(star.shifted)}

    depends_on = ("completeness of a target", question.text(), observation.quiet, observation.scale)
    arrays = kept(engine.checkpoint if isinstance(engine, Pool) else None, depends_on, computed)
    how = (
        f"{question.injections.count} injections of each of {WIDTHS} half-widths into stretches of "
        f"{observation.window_s / 60:.0f} min, found above {float(arrays['threshold']):.2f} sigma, "
        f"{study.search.false_alarms:g} false alarms per {study.search.per}"
        + (", allowing for unknowns that the search leaves in" if arrays["shifted"] else "")
    )
    return Completeness(energy, arrays["probability"], BOLOMETRIC, how)


def found_by_energy(critical_erg: Float, half_widths_s: Float, energy_erg: Float, law: DurationLaw) -> Float:
    """Return the completeness by energy, averaged over the half-widths of an energy, shape (n_energy,).

    `critical_erg` holds the smallest detected energy of each injection, shape (n_half_width, n_draw). It is zero if
    there is an alarm without the flare; these injections are ignored, since false alarms are counted separately.
    """
    of_width = np.empty((half_widths_s.size, energy_erg.size))
    for row, energies in zip(of_width, critical_erg, strict=True):
        counted = np.sort(energies[energies > 0])
        row[:] = np.searchsorted(counted, energy_erg, side="right") / max(counted.size, 1)
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    half = np.log(law.half_width(energy_erg)[:, None] * 10 ** (law.scatter_dex * nodes))
    place = np.interp(half, np.log(half_widths_s), np.arange(half_widths_s.size))
    i = np.minimum(place.astype(int), half_widths_s.size - 2)
    part, column = place - i, np.arange(energy_erg.size)[:, None]
    p = (1 - part) * of_width[i, column] + part * of_width[i + 1, column]
    return np.asarray(np.clip(p @ (weights / weights.sum()), 0.0, 1.0))
