"""Visibility of targets: windows, and exposure time per orbit, day and month."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from . import constraints
from .constraints import Flags
from .earth import Vectors
from .observing_limits import Limits
from .orbit import Orbit, Track
from .radiation import proton_map
from .time_grid import TimeGrid

#: A limit as a function of a slice of steps that returns which targets are allowed, shape (steps or 1, k or 1).
Rule = Callable[[slice], Flags]
#: Steps evaluated at once, which keeps the arrays of a hundred targets within tens of MB.
CHUNK = 1 << 16


@dataclass(frozen=True, eq=False)
class Windows:
    """Intervals in which one target is visible; arrays of shape (n_window,)."""

    start_s: NDArray[np.float64]  # since the start of the plan, as stop_s
    stop_s: NDArray[np.float64]
    in_shadow_s: NDArray[np.float64]  # part of the window in the Earth's shadow

    @property
    def length_s(self) -> NDArray[np.float64]:
        """Length of each window."""
        return self.stop_s - self.start_s


@dataclass(frozen=True, eq=False)
class Visibility:
    """Visibility of targets at the times of a plan.

    The positions of a year take a hundred times the memory of the visibility. They are computed again when they are
    needed, so that answers stay small.
    """

    orbit: Orbit
    grid: TimeGrid
    target: Vectors  # unit vectors, shape (k, 3)
    limits: Limits
    seen: Flags  # shape (n, k), without windows that are too short
    kept_by: dict[str, NDArray[np.float64]]  # fraction of time that each limit alone allows, shape (k,)

    @classmethod
    def of(cls, track: Track, target: Vectors, limits: Limits | None = None) -> Visibility:
        """Compute the visibility of targets, unit vectors in the frame of star catalogues of shape (k, 3)."""
        limits = limits or Limits()
        n, k = track.times.n, len(target)
        seen, kept = np.ones((n, k), bool), {}
        for name, rule in _rules(track, target, limits).items():
            count = np.zeros(k)
            for first in range(0, n, CHUNK):
                part = slice(first, min(first + CHUNK, n))
                flags = rule(part)
                seen[part] &= flags
                count += np.broadcast_to(flags, (part.stop - part.start, k)).sum(axis=0)
            kept[name] = count / n
        if limits.shortest_s > 0:
            _drop_short(seen, track.times.step_s, limits.shortest_s)
        # The track's own grid holds its times as arrays.
        return cls(track.orbit, replace(track.times), target, limits, seen, kept)

    @property
    def track(self) -> Track:
        """Positions at the times of the plan."""
        return self.orbit.track(self.grid)

    @cached_property
    def shadow(self) -> Flags:
        """True where the satellite is in the Earth's shadow, shape (n,)."""
        return in_shadow(self.track)

    @cached_property
    def share(self) -> NDArray[np.float64]:
        """Fraction of the time in which each target is visible, without the duty cycle, shape (k,)."""
        return np.asarray(self.seen.mean(axis=0))

    @property
    def hours(self) -> NDArray[np.float64]:
        """Exposure time of each target with the duty cycle, shape (k,)."""
        return np.asarray(self.share * self.track.times.n * self.track.times.step_s / 3600 * self.limits.duty_cycle)

    def windows(self, k: int) -> Windows:
        """Return the windows of one target in order, with ends accurate to one step."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], self.seen[:, k], [False]])))
        first, last = edges[::2], edges[1::2]
        dark = np.concatenate([[0], np.cumsum(self.shadow)])
        step = np.float64(self.track.times.step_s)
        return Windows(first * step, last * step, (dark[last] - dark[first]) * step)

    def by_day(self, k: int) -> NDArray[np.float64]:
        """Return the hours of exposure on each UTC day from the day of the start, shape (n_day,)."""
        _, days = self.track.times.julian
        number = np.floor(days).astype(int)
        return np.asarray(np.bincount(number, self.seen[:, k]) * self._step_h)

    def by_month(self) -> tuple[list[str], NDArray[np.float64]]:
        """Return the calendar months (UTC), such as "2027-01", and the hours of exposure, shape (n_month, k)."""
        times = self.track.times
        _, days = times.julian
        day = np.datetime64(times.iso(0.0)[:10], "D") + np.arange(int(np.floor(days[-1])) + 1)
        month = day.astype("datetime64[M]")
        names, place = np.unique(month, return_inverse=True)
        starts = np.searchsorted(np.floor(days).astype(int), np.arange(day.size))
        per_day = np.add.reduceat(self.seen, starts, axis=0, dtype=np.int64) * self._step_h
        hours = np.zeros((names.size, len(self.target)))
        np.add.at(hours, place, per_day)
        return [str(name) for name in names], hours

    def by_orbit(self, k: int) -> NDArray[np.float64]:
        """Return the minutes of exposure between ascending nodes, shape (n_orbit,).

        The first and last orbit may be incomplete.
        """
        z = self.track.of_date_km[:, 2]
        number = np.concatenate([[0], np.cumsum((z[:-1] < 0) & (z[1:] >= 0))])
        return np.asarray(np.bincount(number, self.seen[:, k]) * self._step_h * 60)

    @property
    def _step_h(self) -> float:
        return self.track.times.step_s / 3600 * self.limits.duty_cycle


def in_shadow(track: Track) -> Flags:
    """Return whether more than half of the Sun's disk is hidden, shape (n,)."""
    return np.asarray(constraints.sunlight(track.position_km, track.bodies.sun, track.bodies.sun_km) < 0.5)


def _rules(track: Track, target: Vectors, limits: Limits) -> dict[str, Rule]:
    """Return the limits in force by name."""
    at, bodies, rules = track.position_km, track.bodies, dict[str, Rule]()
    if (earth := limits.earth_limb_deg) is not None:
        rules["earth_limb"] = lambda part: constraints.clear_of_earth(at[part], target, earth)
    if (sun := limits.sun_deg) is not None:
        rules["sun"] = lambda part: constraints.clear_of_sun(bodies.sun[part], target, sun)
    if (moon := limits.moon_deg) is not None:
        rules["moon"] = lambda part: constraints.clear_of_moon(bodies.moon_km[part], at[part], target, moon)
    if (regard := limits.declination_deg) is not None:
        inside = constraints.in_declinations(target, *regard)
        rules["declination"] = lambda part: inside[None, :]
    if (cone := limits.normal_cone_deg) is not None:
        rules["normal_cone"] = lambda part: (
            constraints.in_cone(track.normal[part], target, cone)
            | constraints.in_cone(-track.normal[part], target, cone)
        )
    if limits.eclipse != "any":
        allowed = in_shadow(track) == (limits.eclipse == "only")
        rules["eclipse"] = lambda part: allowed[part, None]
    if limits.anomaly or limits.proton_flux is not None:
        if limits.anomaly:
            outside = ~constraints.in_polygon(*track.subsatellite_deg, np.array(limits.anomaly))
        else:
            outside = proton_map().at(*track.subsatellite_deg) <= (limits.proton_flux or 0.0)
        rules["anomaly"] = lambda part: outside[part, None]
    return rules


def _drop_short(seen: Flags, step_s: float, shortest_s: float) -> None:
    """Clear intervals shorter than `shortest_s` in each column, in place."""
    for column in seen.T:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], column, [False]])))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            if (last - first) * step_s < shortest_s:
                column[first:last] = False
