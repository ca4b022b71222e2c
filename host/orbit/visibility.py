"""When targets can be seen: windows, and how long by day and month."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from . import constraints as must
from .constraints import Flags
from .earth import Vectors
from .limits import Limits
from .orbit import Track
from .radiation import proton_map

#: One limit: which targets some steps leave, (steps or 1, k or 1).
Rule = Callable[[slice], Flags]
#: Steps looked at together, so that what is held for a hundred targets stays in some tens of MB.
CHUNK = 1 << 16


@dataclass(frozen=True, eq=False)
class Windows:
    """Stretches of time in which one target is seen.

    Attributes
    ----------
    start_s, stop_s : ndarray, shape (n_window,)
        Since the start of the plan.
    in_shadow_s : ndarray, shape (n_window,)
        Of each, in the Earth's shadow.
    """

    start_s: NDArray[np.float64]
    stop_s: NDArray[np.float64]
    in_shadow_s: NDArray[np.float64]

    @property
    def length_s(self) -> NDArray[np.float64]:
        """(n_window,)."""
        return self.stop_s - self.start_s


@dataclass(frozen=True, eq=False)
class Visibility:
    """When targets are seen over a plan.

    Attributes
    ----------
    track : Track
    target : ndarray, shape (k, 3)
        Unit vectors.
    limits : Limits
    seen : ndarray of bool, shape (n, k)
        By step and target, before windows that are too short are left out.
    kept_by : dict of str to ndarray, shape (k,)
        Share of the time that each limit alone leaves to each target.
    """

    track: Track
    target: Vectors
    limits: Limits
    seen: Flags
    kept_by: dict[str, NDArray[np.float64]]

    @classmethod
    def of(cls, track: Track, target: Vectors, limits: Limits | None = None) -> Visibility:
        """Look from each place of a track.

        Parameters
        ----------
        track : Track
        target : ndarray, shape (k, 3)
            Unit vectors in the frame of star catalogues.
        limits : Limits, optional
        """
        limits = limits or Limits()
        n, k = track.moments.n, len(target)
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
            _drop_short(seen, track.moments.step_s, limits.shortest_s)
        return cls(track, target, limits, seen, kept)

    @cached_property
    def shadow(self) -> Flags:
        """Whether the satellite is in the Earth's shadow, (n,)."""
        return in_shadow(self.track)

    @property
    def share(self) -> NDArray[np.float64]:
        """Of the time, (k,), before the duty cycle."""
        return np.asarray(self.seen.mean(axis=0))

    @property
    def hours(self) -> NDArray[np.float64]:
        """Of exposure, with the duty cycle, (k,)."""
        return np.asarray(self.share * self.track.moments.n * self.track.moments.step_s / 3600 * self.limits.duty_cycle)

    def windows(self, k: int) -> Windows:
        """Of one target, one after the other; limits are met at steps, so ends are good to a step."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], self.seen[:, k], [False]])))
        first, last = edges[::2], edges[1::2]
        dark = np.concatenate([[0], np.cumsum(self.shadow)])
        step = np.float64(self.track.moments.step_s)
        return Windows(first * step, last * step, (dark[last] - dark[first]) * step)

    def by_day(self, k: int) -> NDArray[np.float64]:
        """Hours of exposure of each UTC day, from the day of the start, (n_day,)."""
        _, days = self.track.moments.julian
        number = np.floor(days).astype(int)
        return np.asarray(np.bincount(number, self.seen[:, k]) * self._step_h)

    def by_month(self) -> tuple[list[str], NDArray[np.float64]]:
        """Calendar months (UTC), such as "2027-01", and hours of exposure in them, (n_month, k)."""
        moments = self.track.moments
        _, days = moments.julian
        day = np.datetime64(moments.iso(0.0)[:10], "D") + np.arange(int(np.floor(days[-1])) + 1)
        month = day.astype("datetime64[M]")
        names, place = np.unique(month, return_inverse=True)
        starts = np.searchsorted(np.floor(days).astype(int), np.arange(day.size))
        per_day = np.add.reduceat(self.seen, starts, axis=0, dtype=np.int64) * self._step_h
        hours = np.zeros((names.size, len(self.target)))
        np.add.at(hours, place, per_day)
        return [str(name) for name in names], hours

    def by_orbit(self, k: int) -> NDArray[np.float64]:
        """Minutes of exposure in each orbit, from one ascending node to the next, (n_orbit,); the ends may be parts."""
        z = self.track.of_date_km[:, 2]
        number = np.concatenate([[0], np.cumsum((z[:-1] < 0) & (z[1:] >= 0))])
        return np.asarray(np.bincount(number, self.seen[:, k]) * self._step_h * 60)

    @property
    def _step_h(self) -> float:
        return self.track.moments.step_s / 3600 * self.limits.duty_cycle


def in_shadow(track: Track) -> Flags:
    """Whether half of the Sun's disk or more is hidden, (n,)."""
    return np.asarray(must.sunlight(track.position_km, track.bodies.sun, track.bodies.sun_km) < 0.5)


def _rules(track: Track, target: Vectors, limits: Limits) -> dict[str, Rule]:
    """The limits in force, each as a function of a slice of steps."""
    at, bodies, rules = track.position_km, track.bodies, dict[str, Rule]()
    if (earth := limits.earth_limb_deg) is not None:
        rules["earth_limb"] = lambda part: must.clear_of_earth(at[part], target, earth)
    if (sun := limits.sun_deg) is not None:
        rules["sun"] = lambda part: must.clear_of_sun(bodies.sun[part], target, sun)
    if (moon := limits.moon_deg) is not None:
        rules["moon"] = lambda part: must.clear_of_moon(bodies.moon_km[part], at[part], target, moon)
    if (regard := limits.declination_deg) is not None:
        inside = must.in_declinations(target, *regard)
        rules["declination"] = lambda part: inside[None, :]
    if (cone := limits.normal_cone_deg) is not None:
        rules["normal_cone"] = lambda part: (
            must.in_cone(track.normal[part], target, cone) | must.in_cone(-track.normal[part], target, cone)
        )
    if limits.eclipse != "any":
        allowed = in_shadow(track) == (limits.eclipse == "only")
        rules["eclipse"] = lambda part: allowed[part, None]
    if limits.anomaly or limits.proton_flux is not None:
        if limits.anomaly:
            outside = ~must.in_polygon(*track.below_deg, np.array(limits.anomaly))
        else:
            outside = proton_map().at(*track.below_deg) <= (limits.proton_flux or 0.0)
        rules["anomaly"] = lambda part: outside[part, None]
    return rules


def _drop_short(seen: Flags, step_s: float, shortest_s: float) -> None:
    """Take out of each column the stretches that are too short."""
    for column in seen.T:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], column, [False]])))
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            if (last - first) * step_s < shortest_s:
                column[first:last] = False
