"""Where the satellite is: by SGP4 near the epoch of its elements, by a mean Sun-synchronous orbit far from it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .bodies import Bodies
from .earth import GRAVITY, Vectors, below, to_j2000, unit
from .elements import Elements
from .moments import Moments

Kind = Literal["auto", "tle", "mean"]
#: Days from the epoch within which SGP4 is taken at its word: after a fortnight the answer tells how far it may be off.
TRUSTED_D = 14.0
#: Days from the epoch from which "auto" takes the mean orbit: by then drag may have moved the satellite by a tenth of
#: an orbit (assumption; see `along_track_km`).
MEAN_FROM_D = 60.0
#: Along-track error of public elements near their epoch, km (about one in low orbit: Kelso 2007, AAS 07-127), and its
#: growth, km a day (1 to 3: documentation of the package sgp4).
AT_EPOCH_KM, PER_DAY_KM = 1.0, 2.0
#: By how much the drag of the days to come may differ from that of the elements (assumption: the density of the upper
#: atmosphere follows the Sun, and halves or doubles within weeks).
DRAG_SHARE = 0.5


@dataclass(frozen=True)
class Orbit:
    """Where the satellite is.

    Attributes
    ----------
    elements : Elements
    kind : {"auto", "tle", "mean"}
        SGP4 from the elements; a mean circular Sun-synchronous orbit through them, which keeps the local time of its
        node for years; or the first to `MEAN_FROM_D` days from the epoch and the second beyond.
    """

    elements: Elements = field(default_factory=Elements.embedded)
    kind: Kind = "auto"

    def __post_init__(self) -> None:
        if self.kind not in ("auto", "tle", "mean"):
            raise InputError(f"kind of orbit = {self.kind!r}, expected auto, tle or mean")

    @classmethod
    def load(cls, file: str | Path | None = None, kind: Kind = "auto") -> Orbit:
        """By a file of two-line elements, or the embedded ones.

        Raises
        ------
        InputError
            As `Elements.read`.
        """
        return cls(Elements.embedded() if file is None else Elements.read(file), kind)

    def resolved(self, moments: Moments) -> Literal["tle", "mean"]:
        """Which of the two is used for a plan."""
        if self.kind == "auto":
            return "mean" if self.farthest_d(moments) > MEAN_FROM_D else "tle"
        return self.kind

    def farthest_d(self, moments: Moments) -> float:
        """Days from the elements' epoch to the end of a plan that is farther from it."""
        _, days = moments.julian
        ends = moments.first[0] + days[[0, -1]]
        return float(np.abs(ends - self.elements.epoch_jd).max())

    def along_track_km(self, days: float) -> float:
        """How far along its track the satellite may be from where SGP4 has it, km.

        The error of public elements and its growth, and drag that differs from what the elements foresee by
        `DRAG_SHARE`, which grows with the square of the time. An assumption, not a covariance.

        Parameters
        ----------
        days : float
            From the epoch.
        """
        days = abs(days)
        # The elements' first number is half of the mean motion's rate, revolutions a day squared.
        half_rate = abs(float(self.elements.satellite.ndot)) * 1440.0**2 / (2 * np.pi)
        drag = DRAG_SHARE * half_rate * days**2 * 2 * np.pi * self.elements.axis_km
        return float(AT_EPOCH_KM + PER_DAY_KM * days + drag)

    def messages(self, moments: Moments) -> list[str]:
        """What the reader of a plan must be told of the orbit."""
        elements, days = self.elements, self.farthest_d(moments)
        source = f"{elements.source}, epoch {elements.epoch[:10]}"
        if self.resolved(moments) == "mean":
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
                f"satellite may be off by about {off:.0f} km, {late:.0f} s; newer elements by --tle FILE."
            ]
        return []

    def track(self, moments: Moments) -> Track:
        """The satellite's places at the times of a plan.

        Raises
        ------
        InputError
            If SGP4 cannot follow the elements that far.
        """
        midnight, days = moments.julian
        if self.resolved(moments) == "mean":
            position, velocity = self._mean(midnight, days)
        else:
            error, position, velocity = self.elements.satellite.sgp4_array(midnight, days)
            if np.any(error):
                raise InputError(
                    f"orbital elements of epoch {self.elements.epoch} cannot be followed to "
                    f"{moments.iso(float(moments.seconds[np.argmax(error != 0)]))} (SGP4 error "
                    f"{int(error[np.argmax(error != 0)])}), expected newer ones or the mean orbit"
                )
        return Track(moments, np.asarray(position), np.asarray(velocity))

    def _mean(
        self, midnight: NDArray[np.float64], days: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """A circular orbit whose node keeps its local mean time."""
        e, since = self.elements, (midnight - self.elements.epoch_jd) + days
        node = e.satellite.nodeo + 2 * np.pi / 365.2421897 * since
        along = e.satellite.argpo + e.satellite.mo + np.radians(e.latitude_rate_deg_per_day) * since
        return circular(e.axis_km, e.satellite.inclo, node, along)


def circular(
    axis_km: float, inclination_rad: float, node_rad: NDArray[np.float64] | float, along_rad: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions (km) and velocities (km/s) in a circular orbit, (n, 3) each.

    Parameters
    ----------
    axis_km : float
    inclination_rad : float
    node_rad : float or ndarray, shape (n,)
        Right ascension of the ascending node.
    along_rad : ndarray, shape (n,)
        Argument of latitude.
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
    """Where the satellite is at the times of a plan.

    Attributes
    ----------
    moments : Moments
    of_date_km : ndarray, shape (n, 3)
        In SGP4's frame: true equator and mean equinox of date.
    velocity_km_s : ndarray, shape (n, 3)
        In the same frame.
    """

    moments: Moments
    of_date_km: NDArray[np.float64]
    velocity_km_s: NDArray[np.float64]

    @cached_property
    def _to_j2000(self) -> NDArray[np.float64]:
        return to_j2000(self.moments.first[0], self.moments.julian[1])

    @cached_property
    def position_km(self) -> Vectors:
        """In the frame of star catalogues, (n, 3)."""
        return np.asarray(np.einsum("nij,nj->ni", self._to_j2000, self.of_date_km))

    @cached_property
    def normal(self) -> Vectors:
        """Unit vectors along the orbit's angular momentum, in the frame of star catalogues, (n, 3)."""
        return unit(np.einsum("nij,nj->ni", self._to_j2000, np.cross(self.of_date_km, self.velocity_km_s)))

    @cached_property
    def below_deg(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Geodetic longitude (-180 to 180) and latitude of the place below, (n,) each."""
        return below(self.of_date_km, *self.moments.julian)

    @cached_property
    def bodies(self) -> Bodies:
        """Sun and Moon."""
        return Bodies.at(self.moments)

    @property
    def beta_deg(self) -> NDArray[np.float64]:
        """Angle of the Sun from the orbit's plane, positive on the side of the angular momentum, (n,)."""
        return np.asarray(np.degrees(np.arcsin(np.einsum("ni,ni->n", self.normal, self.bodies.sun))))

    @property
    def local_time_h(self) -> NDArray[np.float64]:
        """Local mean solar time of the descending node, hours, (n,)."""
        momentum = np.cross(self.of_date_km, self.velocity_km_s)
        ascending = np.arctan2(momentum[:, 0], -momentum[:, 1])
        midnight, days = self.moments.julian
        # Mean longitude of the Sun, from the mean equinox of date (Meeus, Astronomical Algorithms, chapter 25).
        sun = np.radians(280.46646 + 0.98564736 * (midnight - 2_451_545.0 + days))
        return np.asarray((np.degrees(ascending + np.pi - sun) / 15.0 + 12.0) % 24.0)

    @property
    def period_s(self) -> float:
        """Of a circular orbit at the mean distance."""
        axis = float(np.linalg.norm(self.of_date_km, axis=1).mean())
        return float(2 * np.pi * np.sqrt(axis**3 / GRAVITY))
