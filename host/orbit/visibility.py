"""Visibility of targets: windows, seasons, and the detector's temperature and particle hits along the orbit."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from importlib import resources
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.arrays import Bool, Float, true_runs
from mauvecl.host.exposure.background import zodiacal_brightness
from mauvecl.host.orbit import Limits
from mauvecl.host.orbit.orbit import Bodies, Orbit, TimeGrid, Track, Vectors, unit
from mauvecl.host.tables.files import parse_ecsv
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import DetectorTemperature, Duration, NotNegative, Share


@cache
def _proton_map(above_mev: int) -> Callable[[Float], Float]:
    """Return the map of AP8 at solar maximum, at an altitude of 510 km (see `tools/build_flux_map.py`)."""
    from scipy.interpolate import RegularGridInterpolator

    text = resources.files(__package__).joinpath("protons.ecsv").read_text(encoding="utf-8")
    table = parse_ecsv(text, "the embedded map of protons")
    step = float(table.meta["step_deg"])
    latitude, longitude = (np.arange(-end, end + step / 2, step) for end in (90.0, 180.0))
    row = np.round((np.asarray(table["latitude"]) + 90) / step).astype(int)
    column = np.round((np.asarray(table["longitude"]) + 180) / step).astype(int)
    flux = np.zeros((latitude.size, longitude.size))
    flux[row, column] = table[f"above_{above_mev}_mev"]
    flux[:, -1] = flux[:, 0]
    return RegularGridInterpolator((latitude, longitude), flux)


def proton_flux(track: Track, *, above_mev: Literal[10, 30]) -> Float:
    """Return the omnidirectional flux of trapped protons above an energy along a track, cm^-2 s^-1, shape (n,)."""
    longitude, latitude = track.subsatellite_deg
    return np.asarray(_proton_map(above_mev)(np.stack([latitude, longitude], axis=-1)))


@validated
@dataclass(frozen=True)
class Thermal:
    """First-order thermal model of the detector: dT/dt = (T_end - T) / tau.

    The model is an assumption. With the defaults the temperature varies by 3 deg C in every orbit, within the 13 to
    21 deg C of the payload's documents.
    """

    sunlit_c: DetectorTemperature = 21.0  #: Equilibrium temperature in sunlight.
    shadow_c: DetectorTemperature = 13.0  #: Equilibrium temperature in shadow.
    time_constant_s: Duration = 3000.0

    def temperature_c(self, sunlight: Float, step_s: float, start_c: float | None = None) -> Float:
        """Return the temperature at the end of each step, deg C, shape (n,).

        Sunlight, the visible fraction of the Sun's disk, shape (n,), is constant within a step, for which the solution
        is exact. The temperature before the first step is by default the equilibrium for the mean sunlight.
        """
        from scipy.signal import lfilter

        end = self.shadow_c + (self.sunlit_c - self.shadow_c) * sunlight
        keep = float(np.exp(-step_s / self.time_constant_s))
        start = float(end.mean()) if start_c is None else start_c
        temperature, _ = lfilter([1 - keep], [1, -keep], end, zi=[keep * start])
        return np.asarray(temperature)


@validated
@dataclass(frozen=True)
class Particles:
    """Particles that hit the detector: cosmic rays, and trapped protons that penetrate the shielding (assumption)."""

    cosmic_per_cm2_s: NotNegative = 1.0  #: Rate of cosmic rays outside the South Atlantic Anomaly.
    #: Fraction of the omnidirectional flux of trapped protons above 30 MeV that reaches the detector: a quarter of it
    #: crosses either face of a thin plate.
    share: Share = 0.5

    def rate_per_cm2_s(self, track: Track) -> Float:
        """Return the rate of hits along a track, cm^-2 s^-1, shape (n,)."""
        return np.asarray(self.cosmic_per_cm2_s + self.share * proton_flux(track, above_mev=30))


#: Sources of the default values.
THERMAL_SOURCE = "assumption: first-order heating and cooling between 13 and 21 deg C, the ends that are documented"
PARTICLES_SOURCE = (
    "assumption: 1 cm^-2 s^-1 of cosmic rays, and half of AP8's omnidirectional protons above 30 MeV, which some 4 mm "
    "of aluminium let through"
)


def elongation_deg(sun: Vectors, target: Float) -> Float:
    """Return the angle between target and Sun, shape (n,), from unit vectors of shapes (3,) and (n, 3)."""
    return np.asarray(np.degrees(np.arccos(np.clip(sun @ target, -1, 1))))


def zodiacal_light(bodies: Bodies, target: Float) -> Float:
    """Return the zodiacal light behind a target, V mag arcsec^-2, shape (n,).

    The value is NaN near the Sun, where the table has none. One time per day samples a year well enough.
    """
    # Sines of the ecliptic latitudes; the longitude follows from the spherical law of cosines, arbitrary at the pole.
    sun, star = bodies.sun @ bodies.ecliptic_pole, float(np.clip(target @ bodies.ecliptic_pole, -1, 1))
    cosine = (bodies.sun @ target - sun * star) / np.sqrt(np.maximum((1 - sun**2) * (1 - star**2), 1e-18))
    longitude, latitude = np.degrees(np.arccos(np.clip(cosine, -1, 1))), abs(float(np.degrees(np.arcsin(star))))
    light = np.full(sun.size, np.nan)
    for k, separation in enumerate(elongation_deg(bodies.sun, target)):
        with contextlib.suppress(InputError):
            light[k] = zodiacal_brightness(float(longitude[k]), latitude, float(separation))
    return light


#: A limit as a function of a target's unit vector that returns the steps in which it allows the target, shape (n,).
Rule = Callable[[Float], Bool]


@dataclass(frozen=True, eq=False)
class Windows:
    """Intervals in which one target is visible; arrays of shape (n_window,)."""

    start_s: Float  # since the start of the plan, as stop_s
    stop_s: Float
    in_shadow_s: Float  # part of the window in the Earth's shadow

    @property
    def length_s(self) -> Float:
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
    seen: Bool  # shape (n, k), without windows that are too short
    kept_by: dict[str, Float]  # fraction of time that each limit alone allows, shape (k,)

    @classmethod
    def of(cls, track: Track, target: Vectors, limits: Limits | None = None) -> Visibility:
        """Compute the visibility of targets, unit vectors in the frame of star catalogues of shape (k, 3)."""
        limits = limits or Limits()
        rules = _rules(track, limits)
        seen, kept_by = np.ones((len(target), track.times.n), bool), {name: np.empty(len(target)) for name in rules}
        for k, (star, steps) in enumerate(zip(target, seen, strict=True)):
            for name, rule in rules.items():
                allowed = rule(star)
                steps &= allowed
                kept_by[name][k] = np.count_nonzero(allowed) / allowed.size
            runs = true_runs(steps)
            for first, last in runs[np.diff(runs)[:, 0] * track.times.step_s < limits.shortest_s]:
                steps[first:last] = False
        # The grid of the track caches its times as arrays, which would be stored with answers.
        return cls(track.orbit, replace(track.times), target, limits, seen.T, kept_by)

    @property
    def track(self) -> Track:
        """Positions at the times of the plan."""
        return self.orbit.track(self.grid)

    @cached_property
    def shadow(self) -> Bool:
        """True where the satellite is in the Earth's shadow, which hides more than half of the Sun, shape (n,)."""
        return np.asarray(self.track.sunlight < 0.5)

    @cached_property
    def share(self) -> Float:
        """Fraction of the time in which each target is visible, without the duty cycle, shape (k,)."""
        return np.asarray(self.seen.mean(axis=0))

    @property
    def hours(self) -> Float:
        """Exposure time of each target with the duty cycle, shape (k,)."""
        return np.asarray(self.share * self.track.times.n * self.track.times.step_s / 3600 * self.limits.duty_cycle)

    def windows(self, k: int) -> Windows:
        """Return the windows of one target in order, with ends accurate to one step."""
        first, last = true_runs(self.seen[:, k]).T
        dark = np.concatenate([[0], np.cumsum(self.shadow)])
        step = np.float64(self.track.times.step_s)
        return Windows(first * step, last * step, (dark[last] - dark[first]) * step)

    def by_day(self, k: int) -> Float:
        """Return the hours of exposure on each UTC day from the day of the start, shape (n_day,)."""
        _, days = self.track.times.julian
        number = np.floor(days).astype(int)
        return np.asarray(np.bincount(number, self.seen[:, k]) * self._step_h)

    def by_month(self) -> tuple[list[str], Float]:
        """Return the calendar months (UTC), such as "2027-01", and the hours of exposure, shape (n_month, k)."""
        times = self.track.times
        day = times.first_day + np.floor(times.julian[1]).astype(int)
        months, starts = np.unique(day.astype("datetime64[M]"), return_index=True)
        hours = np.add.reduceat(self.seen, starts, axis=0, dtype=np.int64) * self._step_h
        return [str(month) for month in months], hours

    @property
    def _step_h(self) -> float:
        return self.track.times.step_s / 3600 * self.limits.duty_cycle


def _by_axis(directions: Vectors) -> NDArray[np.float32]:
    """Return unit vectors as an array of shape (3, n), whose products with a target are several times as fast."""
    return np.ascontiguousarray(directions.T, np.float32)


def _rules(track: Track, limits: Limits) -> dict[str, Rule]:
    """Return the limits in force by name."""
    at, rules = track.position_km, dict[str, Rule]()

    def far_from(directions: Vectors, angle_rad: Float | np.float64) -> Rule:
        """Return the rule that a target is at least an angle from directions, unit vectors of shape (n, 3)."""
        axes, cosine = _by_axis(directions), np.cos(angle_rad).astype(np.float32)
        return lambda star: star.astype(np.float32) @ axes <= cosine

    if limits.earth_limb_deg is not None:
        rules["earth_limb"] = far_from(-unit(at), track.limb_angle_rad + np.radians(limits.earth_limb_deg))
    if limits.sun_deg is not None:
        rules["sun"] = far_from(track.bodies.sun, np.radians(limits.sun_deg))
    if limits.moon_deg is not None:
        rules["moon"] = far_from(unit(track.bodies.moon_km - at), np.radians(limits.moon_deg))
    if limits.declination_deg is not None:
        low, high = np.sin(np.radians(limits.declination_deg))
        rules["declination"] = lambda star: np.array(low <= star[2] <= high)
    if limits.normal_cone_deg is not None:
        normal, cone = _by_axis(track.normal), np.cos(np.radians(limits.normal_cone_deg))
        rules["normal_cone"] = lambda star: np.abs(star.astype(np.float32) @ normal) >= cone
    if limits.eclipse != "any":
        in_light = (track.sunlight < 0.5) == (limits.eclipse == "only")
        rules["eclipse"] = lambda star: in_light
    if limits.anomaly or limits.proton_flux is not None:
        if limits.anomaly:
            outside = ~_in_polygon(*track.subsatellite_deg, np.array(limits.anomaly))
        else:
            outside = proton_flux(track, above_mev=10) <= (limits.proton_flux or 0.0)
        rules["anomaly"] = lambda star: outside
    return rules


def _in_polygon(longitude_deg: Float, latitude_deg: Float, corners: Vectors) -> Bool:
    """Return whether positions lie inside a polygon of longitudes and latitudes, deg, of shape (m, 2); shape (n,)."""
    # Longitudes are relative to the first corner, since the polygon may cross longitude 180.
    x = (longitude_deg - corners[0, 0] + 180) % 360 - 180
    around = np.concatenate([[0.0], np.cumsum((np.diff(corners[:, 0]) + 180) % 360 - 180)])
    inside = np.zeros(np.shape(x), bool)
    for turn in (-360.0, 0.0, 360.0):
        xs, ys = around + turn, corners[:, 1]
        for x1, y1, x2, y2 in zip(xs, ys, np.roll(xs, -1), np.roll(ys, -1), strict=True):
            if y1 == y2:
                continue
            crosses = (y1 > latitude_deg) != (y2 > latitude_deg)
            inside ^= crosses & (x < x1 + (latitude_deg - y1) / (y2 - y1) * (x2 - x1))
    return inside
