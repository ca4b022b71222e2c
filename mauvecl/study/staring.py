"""What a study's stare and flares come to for a star: frames, what is drawn of them, events with their sizes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.host.stars.flare import check_scales
from mauvecl.lightcurve.flares.energies import EnergyScale, Kind, amplitude_of, amplitude_of_peak
from mauvecl.lightcurve.flares.events import Cooling, Event, check_seen, coefficients, temperatures_of
from mauvecl.lightcurve.stares.observed import Staring
from mauvecl.lightcurve.stares.stare import Stare
from mauvecl.lightcurve.usual import CHANGING, Changing
from mauvecl.study.stares import EventText

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mauvecl.host.stars.source import Source
    from mauvecl.lightcurve.stares.curves import Curve
    from mauvecl.study.sections import Star
    from mauvecl.study.stares import CurveText
    from mauvecl.study.study import Study

Float = NDArray[np.float64]

#: What `nuisances.usual` draws of a stare, each with the reasons of `noise.usual.USUAL`: a thermal cycle of the orbit,
#: light lost by pointing in each frame (uniform 0-5 %), the sky's level; and the star's own slow change, an assumption.
USUAL_STARE: dict[str, dict[str, float]] = {
    "jitters": {"light": 0.05 / 12**0.5},
    "offsets": {"sky": 0.1},
    "drifts": {"star": 0.01},
    "cycles": {"temperature": 0.5},
}


def stare_of(study: Study) -> Stare:
    """A study's stare: its frames, with everything that is known and unknown of them.

    Raises
    ------
    InputError
        For a stare that cannot be, or processes that a stare has in a form of its own.
    """
    processes = study.processes.processes()
    if processes.modulations:
        name, _ = processes.modulations[0]
        raise InputError(
            f"processes.{name} is of single exposures, expected jitters, offsets, drifts or cycles of [stare]"
        )
    q, instrument = study.stare, study.load_instrument()
    spreads: dict[str, dict[Changing, float]] = {
        how: {of: getattr(q, how)[of] for of in CHANGING if of in getattr(q, how)}
        for how in ("jitters", "offsets", "drifts", "cycles")
    }
    if study.nuisances.usual:
        for how, usual in USUAL_STARE.items():
            spreads[how] = {**usual, **spreads[how]}  # type: ignore[dict-item]

    def curve(name: str) -> Curve | None:
        text: CurveText | None = getattr(q, name)
        return None if text is None else text.curve(name, q.orbit_s)

    what: dict[str, Any] = {name: curve(name) for name in ("variability", "throughput", "sky")} | spreads
    what["orbit_s"] = q.orbit_s
    if q.along_orbit:
        return _along(study, instrument.frame_s, what)
    return Stare.of(
        q.duration_s,
        frame_s=instrument.frame_s,
        gaps=q.all_gaps(),
        temperature_c=instrument.temperature_c,
        thermal=curve("thermal"),
        **what,
    )


def _along(study: Study, frame_s: float, what: dict[str, Any]) -> Stare:
    """The stare as the orbit gives it, at the one target of the study's ``orbit`` from its start on.

    Raises
    ------
    InputError
        If there is not one target, or the study tells gaps or a thermal curve as well.
    """
    from mauvecl.study.orbits import targets_of

    q, o = study.stare, study.orbit
    if q.gaps or q.orbit_gap_s or q.thermal is not None:
        raise InputError("stare.along_orbit beside gaps or a thermal curve, expected the orbit to give them")
    targets = targets_of(study)
    if len(targets) != 1:
        raise InputError(f"stare.along_orbit with {len(targets)} targets, expected one in orbit.targets")
    return Stare.along(o.orbit(), targets[0], o.start, q.duration_s, frame_s=frame_s, limits=o.limits.limits(), **what)


def staring_of(study: Study, star: Star) -> tuple[Staring, list[Event]]:
    """A star of a study, its stare and its flares, and what frames are made of; the flares beside it.

    Raises
    ------
    InputError
        For anything of it that cannot be.
    """
    source, stare = star.source(), stare_of(study)
    events = events_of(study, star, source)
    check_seen(events, stare.start_s, stare.frame_s)
    check_scales(study.flare.light())
    kelvin = temperatures_of(events)
    frames = study.model_copy(
        update={"observation": study.observation.model_copy(update={"exposure_s": stare.frame_s})}
    )
    # A flare that takes the place of photosphere is as linear in its amplitude, but not up to one.
    unit = 1.0 if study.flare.geometry == "added" else 0.01
    flares = [
        frames.model_copy(update={"flare": study.flare.model_copy(update={"temperature_k": float(k)})}) for k in kelvin
    ]
    quiet, *flaring = frames.expect([source, *(one.flaring(source, unit) for one in flares)])
    electrons = [(x.source_electrons - quiet.source_electrons) / unit for x in flaring]
    spectra = np.reshape(electrons, (kelvin.size, quiet.wavelength_nm.size))
    return Staring(quiet, stare, spectra, coefficients(events, stare.start_s, stare.frame_s, kelvin)), events


def unused_lines(study: Study, staring: Staring, events: Sequence[Event]) -> list[str]:
    """Return what a study asks for that its stare does not show: an exposure, and flares that peak outside."""
    exposure_s, frame_s = study.observation.exposure_s, staring.stare.frame_s
    lines = check_seen(events, staring.stare.start_s, frame_s)
    if exposure_s != frame_s:
        lines.insert(
            0, f"A stare is made of frames of {frame_s:g} s: observation.exposure_s = {exposure_s:g} s is not used."
        )
    return lines


def orbit_lines(study: Study) -> list[str]:
    """What must be told of the orbit that a study's stare is along, if it is."""
    from mauvecl.host.orbit.time_grid import DAY_S, TimeGrid

    if not study.stare.along_orbit:
        return []
    o = study.orbit
    times = TimeGrid(o.start, study.stare.duration_s / DAY_S, study.load_instrument().frame_s)
    assumed = (
        "Limits, temperatures and windows of a stare along the orbit are assumptions; stray light is not modelled."
    )
    return [*o.orbit().messages(times), assumed]


def shifted_line(title: str, threshold: float) -> str:
    """Return what must be told where a threshold allows for trends that the search leaves in."""
    return (
        f"FALSE ALARMS of {title} come from what is unknown of the stare, too: the search does not marginalise over "
        "all of it (see search.cycle, slope, offset and window_s). The threshold of "
        f"{threshold:.2f} allows for it, so that alarms are as often as asked for to a factor of 1.5."
    )


def energy_scale(study: Study, star: Star, source: Source, kind: Kind, flare_k: float) -> EnergyScale | None:
    """Return the energy of flares of a temperature per second of equivalent duration.

    By the star's distance where it is known, by its radius and temperature otherwise; None where neither is.
    """
    flare = study.flare
    how: dict[str, Any] = {
        "band": flare.band, "flare": flare.light(flare_k), "kind": kind, "geometry": flare.geometry,
        "photosphere_k": flare.photosphere_temperature_k,
    }  # fmt: skip
    if star.distance_pc is not None:
        return EnergyScale.of_star(source, star.distance_pc, **how)
    if star.radius_rsun is not None and star.effective_temperature_k is not None:
        return EnergyScale.of_blackbody(star.radius_rsun, star.effective_temperature_k, **how)
    return None


def energy_of(
    study: Study, star: Star, source: Source, event: Event, kind: Kind, temperatures_k: Float | None = None
) -> float | None:
    """Return the energy of a flare at a star, erg; None where the star's size and distance are unknown.

    `temperatures_k` are those from which the stare's flares are mixed, as `Event.total_energy` takes them.
    """
    if energy_scale(study, star, source, kind, event.hottest_k) is None:
        return None

    def scale_of(kelvin: float) -> EnergyScale:
        scale = energy_scale(study, star, source, kind, kelvin)
        assert scale is not None
        return scale

    return event.total_energy(scale_of, temperatures_k)


def events_of(study: Study, star: Star, source: Source) -> list[Event]:
    """A study's flares at one of its stars: its `events`, or one of each energy or amplitude, evenly over the stare.

    Raises
    ------
    InputError
        For an energy where neither the star's size nor its distance is known, or a flare that cannot be.
    """
    texts = study.events or _spread(study)
    events = [_event(study, text) for text in texts]
    # What a flare that cools is mixed from depends on the temperatures of all flares.
    kelvin = temperatures_of(events)
    return [_of_energy(study, star, source, text, event, kelvin) for text, event in zip(texts, events, strict=True)]


def _spread(study: Study) -> Sequence[EventText]:
    q = study.stare
    sizes = [{"energy_erg": e} for e in q.energies_erg] or [{"amplitude": a} for a in study.flare.amplitudes]
    # As much before the first as from one to the next.
    step = q.duration_s / (len(sizes) + 1)
    return [EventText(peak_s=step * (n + 1), **size) for n, size in enumerate(sizes)]


def _event(study: Study, text: EventText) -> Event:
    """Return a flare as it is given; of amplitude 1 where its energy is."""
    shape, flare = text.form(study.stare.shape), study.flare
    half = study.stare.half_width_s if text.half_width_s is None else text.half_width_s
    kelvin = flare.temperature_k if text.temperature_k is None else text.temperature_k
    if text.cooling is not None and flare.spectrum.file is not None:
        raise InputError("events.cooling with a flare's spectrum from a file, expected a flare that has a temperature")
    temperature = kelvin if text.cooling is None else Cooling(kelvin, text.cooling.end_k, text.cooling.fold_s)
    amplitude = flare.amplitudes[0] if text.amplitude is None else text.amplitude
    if text.peak is not None:
        amplitude = amplitude_of_peak(text.peak, shape)
    elif text.equivalent_duration_s is not None:
        amplitude = amplitude_of(text.equivalent_duration_s, half, shape)
    elif text.energy_erg is not None:
        amplitude = 1.0
    return Event(text.peak_s, half, amplitude, temperature, shape)


def _of_energy(study: Study, star: Star, source: Source, text: EventText, event: Event, temperatures_k: Float) -> Event:
    """Return the flare with the amplitude for its energy, where that is given."""
    if text.energy_erg is None:
        return event
    # Any energy is linear in the amplitude.
    one = energy_of(study, star, source, event, text.energy, temperatures_k)
    if one is None:
        raise InputError(
            f"a flare of {text.energy_erg:g} erg at {source.name} of unknown size, expected the star's distance_pc "
            "or radius_rsun and effective_temperature_k"
        )
    return replace(event, amplitude=text.energy_erg / one)
