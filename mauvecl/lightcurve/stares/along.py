"""A stare as the orbit gives it: frames while the target is seen, the detector's temperature, hits of particles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.orbit.conditions import Particles, Thermal
from mauvecl.host.orbit.constraints import sunlight
from mauvecl.host.orbit.limits import Limits
from mauvecl.host.orbit.orbit import Orbit, Track
from mauvecl.host.orbit.targets import Target
from mauvecl.host.orbit.time_grid import DAY_S, TimeGrid
from mauvecl.host.orbit.visibility import Visibility
from mauvecl.lightcurve.stares.stare import MOST_FRAMES, Stare
from mauvecl.schema.errors import InputError

Float = NDArray[np.float64]

#: Time constants of the detector's temperature that are followed before the first frame: its start is forgotten.
SETTLING = 8.0
#: Seconds between the places that are computed for the temperature's past.
PAST_STEP_S = 30.0


@dataclass(frozen=True, eq=False)
class OrbitStare:
    """A stare along the orbit, and what else the orbit does to its frames.

    Attributes
    ----------
    stare : Stare
        Its clock starts with the plan; frames in which the target is not seen are absent.
    hits_per_cm2_s : ndarray, shape (n_frame,)
        Cosmic rays and trapped protons.
    in_shadow : ndarray of bool, shape (n_frame,)
    start : str
        Of the stare's clock, ISO 8601, UTC.
    messages : tuple of str
        What must be told of the orbit.
    """

    stare: Stare
    hits_per_cm2_s: Float
    in_shadow: NDArray[np.bool_]
    start: str
    messages: tuple[str, ...]

    @property
    def mean_hits_per_cm2_s(self) -> float:
        """Over the frames: what `CosmicRays` takes for all of them."""
        return float(self.hits_per_cm2_s.mean())


def stare_along(
    orbit: Orbit,
    target: Target | str,
    start: str,
    duration_s: float,
    *,
    frame_s: float = 5.0,
    limits: Limits | None = None,
    thermal: Thermal | None = None,
    particles: Particles | None = None,
    **unknowns: Any,
) -> OrbitStare:
    """A stare at a target from the orbit.

    Parameters
    ----------
    orbit : Orbit
    target : Target or str
        A name of the embedded list, or coordinates.
    start : str
        ISO 8601, UTC.
    duration_s : float
        From the first frame on, seen or not.
    frame_s : float
    limits : Limits, optional
        What must hold for the target to be seen.
    thermal : Thermal, optional
        How sunlight and shadow move the detector's temperature; assumed unless given.
    particles : Particles, optional
    **unknowns
        As `Stare.of` takes them: variability, throughput, sky, jitters, offsets, drifts, cycles.

    Raises
    ------
    InputError
        If the target is never seen, or for anything that cannot be.
    """
    for name in ("gaps", "temperature_c", "thermal"):
        if name in unknowns:
            raise InputError.of(name, unknowns[name], "none, since the orbit gives it")
    if not (np.isfinite(duration_s) and 0 < duration_s <= MOST_FRAMES * frame_s):
        raise InputError.of("duration_s", duration_s, "a time above 0", unit="s")
    place = target if isinstance(target, Target) else Target.of(target)
    thermal, particles = thermal or Thermal(), particles or Particles()
    count = int(np.ceil(duration_s / frame_s * (1 - 1e-12)))
    times = TimeGrid(start, count * frame_s / DAY_S, frame_s)
    track = orbit.track(times)
    visible = Visibility.of(track, place.direction[None], limits)
    seen = visible.seen[:, 0]
    if not seen.any():
        raise InputError(
            f"target {place.name!r} is never seen in {duration_s / 3600:g} h from {times.iso(0.0)}",
            "another time or other limits",
            key="target",
            value=place.name,
        )
    # Everything about the frames but the temperature is the whole stare's with frames left out.
    whole = Stare.of(count * frame_s, frame_s=frame_s, **unknowns)
    temperature = _temperature(orbit, track, thermal)
    stare = replace(
        whole,
        start_s=whole.start_s[seen],
        star=whole.star[seen],
        light=whole.light[seen],
        sky=whole.sky[seen],
        temperature_c=temperature[seen],
        unknowns=tuple(replace(one, curve=one.curve[seen]) for one in whole.unknowns),
    )
    hits = particles.rate_per_cm2_s(track)[seen]
    return OrbitStare(stare, hits, visible.shadow[seen], times.iso(0.0), tuple(orbit.messages(times)))


def _temperature(orbit: Orbit, track: Track, thermal: Thermal) -> Float:
    """Of the detector at each step, deg C, with its past of some time constants before the first."""
    times = track.times
    past = TimeGrid(
        times.iso(-SETTLING * thermal.time_constant_s, 3),
        SETTLING * thermal.time_constant_s / DAY_S,
        PAST_STEP_S,
    )
    # The whole of it by one kind of orbit, whichever the plan has.
    before = Orbit(orbit.elements, orbit.resolved(times)).track(past)
    first = float(thermal.temperature_c(_light(before), PAST_STEP_S)[-1])
    return thermal.temperature_c(_light(track), times.step_s, first)


def _light(track: Track) -> Float:
    return sunlight(track.position_km, track.bodies.sun, track.bodies.sun_km)
