"""Position of the satellite: SGP4 near the epoch of its elements, a mean Sun-synchronous orbit far from it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError

from .earth import GRAVITY, Vectors, subsatellite_point, to_j2000, unit
from .elements import Elements
from .sun_and_moon import Bodies
from .time_grid import TimeGrid, utc_text

Kind = Literal["auto", "tle", "mean"]
#: Days from the epoch beyond which reports state the possible error of SGP4.
TRUSTED_D = 14.0
#: Days from the epoch beyond which "auto" uses the mean orbit: by then drag may have moved the satellite by a tenth of
#: an orbit (assumption; see `along_track_km`).
MEAN_FROM_D = 60.0
#: Along-track error of public elements near their epoch, km (about one in low orbit: Kelso 2007, AAS 07-127), and its
#: growth, km per day (1 to 3: documentation of the package sgp4).
AT_EPOCH_KM, PER_DAY_KM = 1.0, 2.0
#: Relative uncertainty of the drag after the epoch (assumption: the density of the upper atmosphere follows solar
#: activity and halves or doubles within weeks).
DRAG_SHARE = 0.5


@dataclass(frozen=True)
class Orbit:
    """The satellite's orbit and its propagation.

    Attributes
    ----------
    elements : Elements
    kind : {"auto", "tle", "mean"}
        ``tle`` propagates the elements with SGP4. ``mean`` is a circular Sun-synchronous orbit through the elements,
        whose node keeps its local time for years. ``auto`` uses SGP4 up to `MEAN_FROM_D` days from the epoch, and the
        mean orbit beyond.
    """

    elements: Elements = field(default_factory=Elements.embedded)
    kind: Kind = "auto"

    def __post_init__(self) -> None:
        if self.kind not in ("auto", "tle", "mean"):
            raise InputError.of("kind", self.kind, "auto, tle or mean")

    @classmethod
    def load(cls, file: str | Path | None = None, kind: Kind = "auto") -> Orbit:
        """Read an orbit from a file of two-line elements; the default is the embedded set."""
        return cls(Elements.embedded() if file is None else Elements.read(file), kind)

    def resolved(self, times: TimeGrid) -> Literal["tle", "mean"]:
        """Return the kind of propagation that a plan uses."""
        return self.resolved_at(self.farthest_d(times))

    def resolved_at(self, days: float) -> Literal["tle", "mean"]:
        """Return the kind of propagation for times up to `days` from the elements' epoch."""
        if self.kind == "auto":
            return "mean" if abs(days) > MEAN_FROM_D else "tle"
        return self.kind

    def farthest_d(self, times: TimeGrid) -> float:
        """Return the largest distance of a plan's times from the elements' epoch, days."""
        _, days = times.julian
        ends = times.first[0] + days[[0, -1]]
        return float(np.abs(ends - self.elements.epoch_jd).max())

    def along_track_km(self, days: float) -> float:
        """Return the possible along-track error of SGP4 `days` from the epoch, km.

        The estimate adds the error of public elements, its linear growth, and the quadratic effect of a drag that
        differs by `DRAG_SHARE` from the elements'. It is an assumption, not a covariance.
        """
        days = abs(days)
        # The elements give half of the mean motion's derivative, in revolutions per day^2.
        half_rate = abs(float(self.elements.satellite.ndot)) * 1440.0**2 / (2 * np.pi)
        drag = DRAG_SHARE * half_rate * days**2 * 2 * np.pi * self.elements.axis_km
        return float(AT_EPOCH_KM + PER_DAY_KM * days + drag)

    def messages(self, times: TimeGrid) -> list[str]:
        """Return the remarks on the orbit's accuracy that a plan must report."""
        elements, days = self.elements, self.farthest_d(times)
        source = f"{elements.source}, epoch {elements.epoch[:10]}"
        if self.resolved(times) == "mean":
            return [
                f"The orbit is a mean Sun-synchronous one through the elements ({source}): shares of time and seasons "
                f"hold, but where the satellite stands in its orbit {days:.0f} days from the epoch is not known: times "
                "of single windows may be off by an orbit."
            ]
        if days > TRUSTED_D:
            off = self.along_track_km(days)
            late = off / (2 * np.pi * elements.axis_km) * elements.period_s
            return [
                f"The plan reaches {days:.0f} days from the epoch of the elements ({source}): along its track the "
                f"satellite may be off by about {off:.0f} km, {late:.0f} s; `tle='FILE'` reads newer elements."
            ]
        return []

    def track(self, times: TimeGrid) -> Track:
        """Propagate the orbit to the times of a plan; raises InputError if SGP4 fails at one of them.

        The last track is kept, since a year of minutes takes a second and a hundred MB.
        """
        return _track(self, times)

    def states(
        self, midnight: NDArray[np.float64], days: NDArray[np.float64], kind: Literal["tle", "mean"]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions (km) and velocities (km/s) in SGP4's frame, shape (n, 3) each.

        Parameters
        ----------
        midnight, days : ndarray, shape (n,)
            Parts of the Julian date, UTC.
        kind : {"tle", "mean"}
            Propagation by SGP4, or the mean orbit.

        Raises InputError if SGP4 fails at one of the times.
        """
        if kind == "mean":
            return self._mean(midnight, days)
        error, position, velocity = self.elements.satellite.sgp4_array(midnight, days)
        if np.any(error):
            first = int(np.argmax(error != 0))
            raise InputError(
                f"orbital elements of epoch {self.elements.epoch} cannot be followed to "
                f"{utc_text(float(midnight[first] + days[first]))} (SGP4 error {int(error[first])})",
                "newer ones or the mean orbit",
                key="elements",
                value=self.elements.epoch,
            )
        return np.asarray(position), np.asarray(velocity)

    def _mean(
        self, midnight: NDArray[np.float64], days: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions and velocities in a circular orbit whose node keeps its local mean time."""
        e, since = self.elements, (midnight - self.elements.epoch_jd) + days
        node = e.satellite.nodeo + 2 * np.pi / 365.2421897 * since
        along = e.satellite.argpo + e.satellite.mo + np.radians(e.latitude_rate_deg_per_day) * since
        return circular(e.axis_km, e.satellite.inclo, node, along)


@lru_cache(maxsize=1)
def _track(orbit: Orbit, times: TimeGrid) -> Track:
    midnight, days = times.julian
    return Track(orbit, times, *orbit.states(midnight, days, orbit.resolved(times)))


def circular(
    axis_km: float, inclination_rad: float, node_rad: NDArray[np.float64] | float, along_rad: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return positions (km) and velocities (km/s) in a circular orbit, shape (n, 3) each.

    `node_rad` is the right ascension of the ascending node, `along_rad` the argument of latitude, shape (n,).
    """
    node = np.broadcast_to(node_rad, along_rad.shape)
    ascending = np.stack([np.cos(node), np.sin(node), np.zeros_like(node)], axis=1)
    c, s = np.cos(inclination_rad), np.sin(inclination_rad)
    north = np.stack([-c * np.sin(node), c * np.cos(node), np.full_like(node, s)], axis=1)
    cosine, sine = np.cos(along_rad)[:, None], np.sin(along_rad)[:, None]
    speed = float(np.sqrt(GRAVITY / axis_km))
    return axis_km * (cosine * ascending + sine * north), speed * (cosine * north - sine * ascending)


@dataclass(frozen=True, eq=False)
class Track:
    """The satellite's positions at the times of a plan."""

    orbit: Orbit
    times: TimeGrid
    # Position and velocity in SGP4's frame (true equator, mean equinox of date), shape (n, 3).
    of_date_km: NDArray[np.float64]
    velocity_km_s: NDArray[np.float64]

    @cached_property
    def _to_j2000(self) -> NDArray[np.float64]:
        return to_j2000(self.times.first[0], self.times.julian[1])

    @cached_property
    def position_km(self) -> Vectors:
        """Position in the frame of star catalogues (J2000), shape (n, 3)."""
        return np.asarray(np.einsum("nij,nj->ni", self._to_j2000, self.of_date_km))

    @cached_property
    def normal(self) -> Vectors:
        """Unit vectors along the orbit's angular momentum in the frame of star catalogues, shape (n, 3)."""
        return unit(np.einsum("nij,nj->ni", self._to_j2000, np.cross(self.of_date_km, self.velocity_km_s)))

    @cached_property
    def subsatellite_deg(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Geodetic longitude (-180 to 180) and latitude of the sub-satellite point, shape (n,) each."""
        return subsatellite_point(self.of_date_km, *self.times.julian)

    @cached_property
    def bodies(self) -> Bodies:
        """Positions of Sun and Moon."""
        return Bodies.at(self.times)

    @property
    def beta_deg(self) -> NDArray[np.float64]:
        """Angle of the Sun from the orbital plane, positive towards the angular momentum, shape (n,)."""
        return np.asarray(np.degrees(np.arcsin(np.einsum("ni,ni->n", self.normal, self.bodies.sun))))

    @property
    def local_time_h(self) -> NDArray[np.float64]:
        """Local mean solar time of the descending node, hours, shape (n,)."""
        momentum = np.cross(self.of_date_km, self.velocity_km_s)
        ascending = np.arctan2(momentum[:, 0], -momentum[:, 1])
        midnight, days = self.times.julian
        # Mean longitude of the Sun from the mean equinox of date (Meeus, Astronomical Algorithms, chapter 25).
        sun = np.radians(280.46646 + 0.98564736 * (midnight - 2_451_545.0 + days))
        return np.asarray((np.degrees(ascending + np.pi - sun) / 15.0 + 12.0) % 24.0)

    @property
    def period_s(self) -> float:
        """Period of a circular orbit at the mean distance, s."""
        axis = float(np.linalg.norm(self.of_date_km, axis=1).mean())
        return float(2 * np.pi * np.sqrt(axis**3 / GRAVITY))
