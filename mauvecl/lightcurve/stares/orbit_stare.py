"""Stares along an orbit: frames while the target is visible, detector temperature, and particle hits."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.orbit.conditions import Particles, Thermal
from mauvecl.host.orbit.constraints import sunlight
from mauvecl.host.orbit.observing_limits import Limits
from mauvecl.host.orbit.orbit import Orbit, Track
from mauvecl.host.orbit.targets import Target
from mauvecl.host.orbit.time_grid import TimeGrid
from mauvecl.host.orbit.visibility import Visibility
from mauvecl.lightcurve.stares.stare import MOST_FRAMES, Stare
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S, Duration

Float = NDArray[np.float64]

#: Time before the first frame for which the detector temperature is computed, in its time constants.
SETTLING = 8.0
#: Time step before the first frame, s.
PAST_STEP_S = 30.0


@dataclass(frozen=True, eq=False)
class OrbitStare:
    """A stare along the orbit, with the conditions of its frames."""

    stare: Stare  # without the frames in which the target is not visible
    hits_per_cm2_s: Float  # cosmic rays and trapped protons, shape (n_frame,)
    in_shadow: NDArray[np.bool_]  # shape (n_frame,)
    start: str  # of the stare, ISO 8601, UTC
    messages: tuple[str, ...]  # about the orbit

    @property
    def mean_hits_per_cm2_s(self) -> float:
        """Mean over the frames, the rate for `CosmicRays`."""
        return float(self.hits_per_cm2_s.mean())


@validated
def stare_along(
    orbit: Orbit,
    target: Target | str,
    start: str,
    duration_s: Duration,
    *,
    frame_s: Duration = 5.0,
    limits: Limits | None = None,
    thermal: Thermal | None = None,
    particles: Particles | None = None,
    **unknowns: Any,
) -> OrbitStare:
    """Compute the stare at a target along an orbit.

    Parameters
    ----------
    orbit : Orbit
    target : Target or str
        A name of the embedded list, or coordinates.
    start : str
        ISO 8601, UTC.
    duration_s : float
        From the first frame, including times at which the target is not visible.
    frame_s : float
    limits : Limits, optional
        Conditions for the target to be visible.
    thermal : Thermal, optional
        Response of the detector temperature to sunlight and shadow; assumed by default.
    particles : Particles, optional
    **unknowns
        Arguments of `Stare.of`: variability, throughput, sky, jitters, offsets, drifts, cycles.

    Raises
    ------
    InputError
        If the target is never visible.
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
    # All but the temperature follow from a stare without gaps.
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
    """Return the detector temperature at each step, deg C, computed from several time constants before the first."""
    times = track.times
    past = TimeGrid(
        times.iso(-SETTLING * thermal.time_constant_s, 3),
        SETTLING * thermal.time_constant_s / DAY_S,
        PAST_STEP_S,
    )
    # The same kind of orbit as that of the plan.
    before = Orbit(orbit.elements, orbit.resolved(times)).track(past)
    first = float(thermal.temperature_c(_light(before), PAST_STEP_S)[-1])
    return thermal.temperature_c(_light(track), times.step_s, first)


def _light(track: Track) -> Float:
    return sunlight(track.position_km, track.bodies.sun, track.bodies.sun_km)
