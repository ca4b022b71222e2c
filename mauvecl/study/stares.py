"""Stare of a study at a star: frames, unknown changes, and flares with their sizes."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from mauvecl.flares.energies import EnergyScale, Kind, amplitude_of
from mauvecl.flares.settings import Cooling
from mauvecl.flares.shapes import Shape, TableShape, shape_of
from mauvecl.flares.stare import Event, Stare, check_contributions, temperatures_of
from mauvecl.host.arrays import Float
from mauvecl.host.tables.text_tables import read_columns
from mauvecl.noise.disturbances import Normal, Prior
from mauvecl.noise.unknowns import CHANGING, COURSES, DEFAULT_SPREADS, PROCESSES, Changing, Course
from mauvecl.schema.errors import InputError, Message, shortened
from mauvecl.schema.fields import DAY_S
from mauvecl.study.stare import KNOWN_CHANGES, EventChoice, StareQuestion

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.source import Source
    from mauvecl.study.plan import OrbitQuestion
    from mauvecl.study.study import Study


#: Smallest distance of a prior's cuts from its mean, in standard deviations, for a normal distribution to replace it:
#: 6e-7 of the values lie beyond.
NEGLIGIBLE_CUT_SD = 5.0


def _stare_prior(name: str, prior: Prior, instrument: Instrument) -> tuple[Course, Changing, float, float]:
    """Return the course of a process of exposures in a stare, what it changes, and its standard deviation and mean.

    The stare's quiescent level is measured in the stare itself, so the mean is a known factor on light or sky, or shift
    of the temperature in deg C; the standard deviation is relative to it, or in deg C.
    """
    if not isinstance(prior, Normal) or not prior.is_wide(NEGLIGIBLE_CUT_SD):
        raise InputError(
            f"processes.{name} is drawn from a normal distribution in a stare; give a normal prior whose cuts are "
            f"{NEGLIGIBLE_CUT_SD:g} sd or more from its mean, or jitters, offsets, drifts or cycles in [stare]",
            key=f"processes.{name}",
        )
    process = PROCESSES[name]
    course: Course = "jitters" if process.when == "frame" else "offsets"
    if process.of == "dark":
        return course, "temperature", prior.sd, prior.mean - instrument.temperature_c
    at = {"light_loss": instrument.light_loss, "pointing_loss": instrument.pointing_loss}
    # The factors on light and sky are linear in their values.
    mean, upper = (1.0 + float(process.change(at, np.array(x))) for x in (prior.mean, prior.mean + prior.sd))
    return course, process.of, abs(upper - mean) / mean, mean


def stare_of(study: Study, instrument: Instrument) -> Stare:
    """Return the stare of a study."""
    q = study.stare
    priors = [_stare_prior(name, getattr(study.processes, name), instrument) for name, _ in study.processes.modulations]
    spreads: dict[Course, dict[Changing, float]] = {how: dict(getattr(q, how)) for how in COURSES}
    for course, changed, sd, _ in priors:
        # Independent normal amplitudes of one change add up to one.
        spreads[course][changed] = math.hypot(spreads[course].get(changed, 0.0), sd)
    spreads = {how: {of: given[of] for of in CHANGING if of in given} for how, given in spreads.items()}
    if study.nuisances.usual:
        spreads = {how: documented | spreads[how] for how, documented in DEFAULT_SPREADS.items()}

    names = (*KNOWN_CHANGES, "pointing", "orbit_s")
    changes: dict[str, Any] = {name: getattr(q, name) for name in names} | spreads
    if q.along_orbit:
        stare = _along_orbit(study, instrument.frame_s, changes)
    else:
        n_orbits = math.ceil(q.duration_s / q.orbit_s) if q.orbit_gap_s else 0
        ends = [(n + 1) * q.orbit_s for n in range(n_orbits)]
        gaps = [*q.gaps, *((end - q.orbit_gap_s, end) for end in ends)]
        changes |= {"frame_s": instrument.frame_s, "temperature_c": instrument.temperature_c, "gaps": gaps}
        stare = Stare.of(q.duration_s, **changes)
    for _, changed, _, mean in priors:
        name = "temperature_c" if changed == "temperature" else changed
        value: Any = getattr(stare, name)
        stare = replace(stare, **{name: value + mean if changed == "temperature" else value * mean})
    return stare


def _along_orbit(study: Study, frame_s: float, changes: dict[str, Any]) -> Stare:
    """Return the stare at the target of the study's ``orbit``, with gaps and temperatures along the orbit."""
    from mauvecl.flares.stare import stare_along
    from mauvecl.study.plan import targets_of

    q, o = study.stare, study.orbit
    if q.gaps or q.orbit_gap_s or q.thermal is not None:
        fault = "stare.along_orbit needs neither gaps nor a thermal curve, since both follow from the orbit"
        raise InputError(fault, key="stare.along_orbit")
    targets = targets_of(study.orbit, study.plan)
    if len(targets) != 1:
        fault = f"stare.along_orbit needs a single target in orbit.targets, but has {len(targets)}"
        raise InputError(fault, key="stare.along_orbit")
    return stare_along(o.orbit(), targets[0], o.start, q.duration_s, frame_s=frame_s, limits=o.limits, **changes).stare


def unused_lines(exposure_s: float, stare: Stare, events: Sequence[Event]) -> list[str]:
    """Return messages about settings without effect on the stare: the exposure, and flares that peak outside it."""
    lines = check_contributions(events, stare.start_s, stare.frame_s)
    if exposure_s == stare.frame_s:
        return lines
    frames = f"A stare consists of frames of {stare.frame_s:g} s"
    return [Message(f"{frames}: observation.exposure_s = {exposure_s:g} s is not used.", "not used"), *lines]


def orbit_lines(stare: StareQuestion, orbit: OrbitQuestion, frame_s: float) -> list[str]:
    """Return messages about the orbit of a stare with `along_orbit`."""
    from mauvecl.host.orbit.orbit import TimeGrid

    if not stare.along_orbit:
        return []
    times = TimeGrid(orbit.start, stare.duration_s / DAY_S, frame_s)
    assumed = "Limits, temperatures and windows of a stare along the orbit are assumptions"
    return [*orbit.orbit().messages(times), f"{assumed}; stray light is not modelled."]


def threshold_line(title: str, threshold: float) -> str:
    """Return the message for a threshold that is raised because of trends that the search does not remove."""
    return Message(
        f"FALSE ALARMS of {title} come from what is unknown of the stare, too: the search does not marginalise over "
        "all of it (see search.cycle, slope, offset and window_s). The threshold of "
        f"{threshold:.2f} allows for it, so that alarms are as often as asked for to a factor of 1.5.",
        "false alarms",
    )


def energy_scale(study: Study, source: Source, kind: Kind, flare_k: float) -> EnergyScale | None:
    """Return the energy of flares of a temperature on the study's star per second of equivalent duration.

    It follows from the star's distance or else from its radius and temperature; None if neither is known.
    """
    flare, star = study.flare, study.star[0]
    how: dict[str, Any] = {
        "band": flare.band, "flare": flare.light(flare_k), "kind": kind, "geometry": flare.geometry,
        "photosphere_k": flare.photosphere_temperature_k,
    }  # fmt: skip
    if star.distance_pc is not None:
        return EnergyScale.of_star(source, star.distance_pc, **how)
    if star.radius_rsun is not None and star.effective_temperature_k is not None:
        return EnergyScale.of_blackbody(star.radius_rsun, star.effective_temperature_k, **how)
    return None


def energy_of(study: Study, source: Source, event: Event, kind: Kind, temperatures_k: Float | None = None) -> float:
    """Return the energy of a flare, erg; NaN if the star's distance and radius are unknown.

    `temperatures_k` are the temperatures between which flare spectra are interpolated; see `Event.total_energy`.
    """
    if energy_scale(study, source, kind, event.hottest_k) is None:
        return float("nan")
    scale_of = cast("Callable[[float], EnergyScale]", partial(energy_scale, study, source, kind))
    return event.total_energy(scale_of, temperatures_k)


def events_of(study: Study, source: Source) -> list[Event]:
    """Return the flares of a study's star: `events`, or one per energy or amplitude, evenly spaced over the stare."""
    choices: Sequence[EventChoice] = study.events
    if not choices:
        q = study.stare
        sizes = [{"energy_erg": e} for e in q.energies_erg] or [{"amplitude": a} for a in study.flare.amplitudes]
        # The time before the first flare equals the spacing.
        step = q.duration_s / (len(sizes) + 1)
        choices = [EventChoice(peak_s=step * (n + 1), **size) for n, size in enumerate(sizes)]
    events = [_event(study, choice) for choice in choices]
    # The spectrum of a cooling flare is interpolated between the temperatures of all flares.
    kelvin = temperatures_of(events)
    for n, (choice, event) in enumerate(zip(choices, events, strict=True)):
        if choice.energy_erg is None:
            continue
        energy = energy_of(study, source, event, choice.energy, kelvin)
        if np.isnan(energy):
            raise InputError(
                f"the amplitude of a flare of {choice.energy_erg:g} erg on {source.name} needs the star's distance_pc, "
                "or radius_rsun and effective_temperature_k",
                key="events.energy_erg",
            )
        # The energy is linear in the amplitude.
        events[n] = replace(event, amplitude=choice.energy_erg / energy)
    return events


def _event(study: Study, choice: EventChoice) -> Event:
    """Return a flare, with amplitude 1 if its energy is given."""
    flare, file, cooling = study.flare, choice.shape_file, choice.cooling
    if file is None:
        shape: Shape = shape_of(choice.shape or study.stare.shape)
    else:
        columns = read_columns("flare shape", "values", file)
        shape = TableShape(columns[:, 0], columns[:, 1], file.stem, shortened(file.name))
    half = study.stare.half_width_s if choice.half_width_s is None else choice.half_width_s
    kelvin = flare.temperature_k if choice.temperature_k is None else choice.temperature_k
    if cooling is not None and flare.spectrum.file is not None:
        fault = "events.cooling needs a flare that has a temperature, but its spectrum is from a file"
        raise InputError(fault, key="events.cooling")
    temperature = kelvin if cooling is None else Cooling(kelvin, cooling.end_k, cooling.fold_s)
    amplitude = flare.amplitudes[0] if choice.amplitude is None else choice.amplitude
    if choice.peak is not None:
        amplitude = choice.peak / shape_of(shape).peak
    elif choice.equivalent_duration_s is not None:
        amplitude = amplitude_of(choice.equivalent_duration_s, half, shape)
    elif choice.energy_erg is not None:
        amplitude = 1.0
    return Event(choice.peak_s, half, amplitude, temperature, shape)
