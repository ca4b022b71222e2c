"""Orbits of the satellite, its positions and those of Sun and Moon at the times of a plan, and its targets."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import erfa
import numpy as np

from mauvecl.host.arrays import Float
from mauvecl.host.exposure.background import parse_position, parse_time
from mauvecl.host.orbit import OrbitKind
from mauvecl.host.stars.library import by_key, library_text, name_key, near_names
from mauvecl.host.tables.files import parse_ecsv, read_text
from mauvecl.host.tables.names import EXPECTED_POSITION, is_missing_position
from mauvecl.host.tables.units import offline
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import records
from mauvecl.schema.errors import InputError, printable, shortened
from mauvecl.schema.fields import DAY_S, DateText, Days, Duration

if TYPE_CHECKING:
    from astropy.table import Table
    from astropy.time import Time

#: Equatorial radius, km, gravitational parameter, km^3 s^-2, and oblateness of WGS 72, as SGP4 uses (Hoots & Roehrich
#: 1980).
RADIUS_KM, GRAVITY, J2 = 6378.135, 398_600.8, 1.082616e-3
#: Equatorial radius of WGS 84, km: radius of the sphere that defines the limb.
LIMB_KM = 6378.137
#: Radius of the Sun, km (IAU 2015 resolution B3).
SUN_KM = 695_700.0

Vectors = Float


def unit(vectors: Vectors) -> Vectors:
    """Normalise vectors, shape (..., 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


#: Largest number of steps of a plan: eight years of minutes.
MAX_STEPS = 4_300_000


@validated
@dataclass(frozen=True)
class TimeGrid:
    """Evenly spaced times in UTC, which stands in for UT1 (they differ by less than a second).

    Raises InputError if the start is outside 1990-2100 or the number of steps is outside 1 to `MAX_STEPS`.
    """

    start: DateText  # ISO 8601, UTC
    days: Days  # length of the plan
    step_s: Duration = 60.0  # length of a step; conditions are evaluated at its middle

    def __post_init__(self) -> None:
        if not 1 <= self.n <= MAX_STEPS:
            fault = f"{self.days:g} days in steps of {self.step_s:g} s must be 1 to {MAX_STEPS} steps"
            raise InputError(f"{fault}, not {self.days * DAY_S / self.step_s:.3g}", key="step_s")
        _ = self.first  # raises InputError for an invalid start

    @property
    def n(self) -> int:
        """Number of steps; the last may be shorter than the others."""
        return int(np.ceil(self.days * DAY_S / self.step_s - 1e-9))

    @cached_property
    def first(self) -> tuple[float, float]:
        """Julian date of the start, UTC: the preceding midnight and the fraction of the day."""
        with offline():
            time = parse_time(self.start, "start").utc
        midnight = float(np.floor(time.jd - 0.5)) + 0.5
        return midnight, float((time.jd1 - midnight) + time.jd2)

    @property
    def first_day(self) -> np.datetime64:
        """UTC day of the start."""
        return np.datetime64(utc_text(self.first[0])[:10], "D")

    @cached_property
    def seconds(self) -> Float:
        """Middles of the steps, s since the start, shape (n,)."""
        middles = np.asarray((np.arange(self.n, dtype=np.float64) + 0.5) * float(self.step_s))
        middles.setflags(write=False)
        return middles

    @property
    def julian(self) -> tuple[Float, Float]:
        """Julian dates, UTC: the midnight before the start and the days since, shape (n,) each."""
        midnight, fraction = self.first
        return np.full(self.n, midnight, np.float64), np.asarray(fraction + self.seconds / DAY_S)

    def iso(self, seconds: float, digits: int = 0) -> str:
        """Return a time since the start in ISO 8601, UTC."""
        return utc_text(sum(self.first) + seconds / DAY_S, digits)


def utc_text(julian: float, digits: int = 0) -> str:
    """Return a Julian date in ISO 8601, UTC, accurate to a tenth of a millisecond."""
    # Neither numpy's calendar nor these Julian dates count leap seconds.
    micro = round((julian - 2_440_587.5) * DAY_S * 10**digits) * 10 ** (6 - digits)
    text = str(np.datetime64(micro, "us"))
    return text[:19] if digits == 0 else text[: 20 + digits]


#: Days between computed positions. Cubic splines interpolate to 0.1 arcsec for the Sun and 1 arcsec for the Moon
#: (tested).
SUN_STEP_D, MOON_STEP_D = 0.5, 1 / 12


@dataclass(frozen=True, eq=False)
class Bodies:
    """Geocentric positions of Sun and Moon in the frame of star catalogues (J2000)."""

    # Unit vectors, shape (n, 3); the parallax at the satellite is below 10 arcsec.
    sun: Vectors
    sun_km: Float  # distance, shape (n,)
    # Shape (n, 3). The parallax reaches a degree: subtract the satellite's position to get its view.
    moon_km: Vectors
    ecliptic_pole: Float  # north pole at the middle of the plan, shape (3,)

    @classmethod
    def at(cls, times: TimeGrid) -> Bodies:
        """Compute the positions at the times of a plan."""
        from scipy.interpolate import CubicSpline

        midnight, days = times.first[0], times.julian[1]
        with offline():
            from astropy.coordinates import GeocentricTrueEcliptic, SkyCoord, get_body, get_sun
            from astropy.time import Time

            def time(days: Float) -> Time:
                return Time(np.full(days.shape, midnight), days, format="jd", scale="utc")

            def position_km(body: str, step_d: float) -> Vectors:
                low = days[0] - step_d
                # One more node at either end, where a cubic spline is least accurate.
                nodes = low + step_d * np.arange(int(np.ceil((days[-1] - low) / step_d)) + 3)
                at_nodes = get_sun(time(nodes)) if body == "sun" else get_body(body, time(nodes))
                return np.asarray(CubicSpline(nodes, at_nodes.cartesian.xyz.to_value("km").T)(days))

            sun, moon = position_km("sun", SUN_STEP_D), position_km("moon", MOON_STEP_D)
            middle = time(days[[days.size // 2]])[0]
            pole = SkyCoord(lon=0, lat=90, unit="deg", frame=GeocentricTrueEcliptic(equinox=middle, obstime=middle))
            north = unit(pole.gcrs.cartesian.xyz.value)
        return cls(unit(sun), np.linalg.norm(sun, axis=1), moon, north)


#: NORAD catalogue number of Mauve.
MAUVE = "66756"


@dataclass(frozen=True)
class Elements:
    """A two-line element set."""

    first: str  # line 1
    second: str  # line 2
    source: str  # origin of the set, for reports

    def __post_init__(self) -> None:
        for number, line in enumerate((self.first, self.second), 1):
            if len(line) < 69 or not line.isascii() or not line.startswith(f"{number} "):
                raise InputError.of("elements", line, f"line {number} with 69 characters")
            # Digits plus 1 per minus sign, modulo 10.
            checksum = sum(int(c) if c.isdigit() else c == "-" for c in line[:68]) % 10
            if line[68] != str(checksum):
                fault = f"orbital elements {shortened(line)} must end in the checksum {checksum}, not {line[68]!r}"
                raise InputError(f"{fault}; one is wrong", key="elements")
        if self.first[2:7] != self.second[2:7]:
            numbers = f"{self.first[2:7]!r} and {self.second[2:7]!r}"
            fault = f"both lines of the orbital elements must be of one satellite, but are of {numbers}"
            raise InputError(fault, key="elements")
        if self.satellite.error:
            fault = f"orbital elements {shortened(self.second)} must be those of an orbit around the Earth"
            raise InputError(f"{fault}, but SGP4 refuses them (error {self.satellite.error})", key="elements")

    @classmethod
    def read(cls, path: str | Path | None = None) -> Elements:
        """Read the newest set of Mauve in a file, or of its only satellite; titles and comments are ignored.

        Without a path it is the public set that the package contains. Raises InputError if the file has no set or
        those of several other satellites, or a line's checksum is wrong.
        """
        if path is None:
            text = resources.files(__package__).joinpath("mauve.tle").read_text(encoding="utf-8")
            source, named = "public catalogue, object 66756, embedded", "the embedded elements"
        else:
            path = Path(path)
            text, source, named = read_text(path, "orbit file"), f"file {path.name}", shortened(str(path))
        lines = [line.rstrip() for line in text.splitlines()]
        sets = [pair for pair in pairwise(lines) if pair[0].startswith("1 ") and pair[1].startswith("2 ")]
        if not sets:
            raise InputError(f"orbit file {named} must contain a line '1 ...' before a line '2 ...'", key="elements")
        sets = [(first, second) for first, second in sets if first[2:7] == MAUVE] or sets
        if len(numbers := sorted({first[2:7] for first, _ in sets})) > 1:
            satellites = f"{len(numbers)} satellites ({printable(', '.join(numbers), 80)})"
            fault = f"orbit file {named} must have elements of Mauve, {MAUVE}, or of one satellite, not of {satellites}"
            raise InputError(fault, key="elements")
        return max((cls(first, second, source) for first, second in sets), key=lambda elements: elements.epoch_jd)

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes without the record of `sgp4`, which cannot be pickled."""
        return {name: value for name, value in vars(self).items() if name != "satellite"}

    @cached_property
    def satellite(self) -> Any:
        """Satellite record of `sgp4`."""
        from sgp4.api import WGS72, Satrec

        return Satrec.twoline2rv(self.first, self.second, WGS72)

    @property
    def epoch_jd(self) -> float:
        """Epoch as a Julian date, UTC."""
        return float(self.satellite.jdsatepoch + self.satellite.jdsatepochF)

    @property
    def epoch(self) -> str:
        """Epoch in ISO 8601, UTC, to the second."""
        return utc_text(self.epoch_jd)

    @property
    def revolutions_per_day(self) -> float:
        """Mean motion."""
        return float(self.satellite.no_kozai) * 1440 / (2 * np.pi)

    @property
    def period_s(self) -> float:
        """Anomalistic period, s."""
        return DAY_S / self.revolutions_per_day

    @property
    def axis_km(self) -> float:
        """Semi-major axis, from the mean motion by Kepler's third law."""
        return float((GRAVITY / (2 * np.pi / self.period_s) ** 2) ** (1 / 3))


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


@validated
@dataclass(frozen=True)
class Orbit:
    """The satellite's orbit and its propagation.

    The kind ``tle`` propagates the elements with SGP4. ``mean`` is a circular Sun-synchronous orbit through the
    elements, whose node keeps its local time for years. ``auto`` uses SGP4 up to `MEAN_FROM_D` days from the epoch, and
    the mean orbit beyond.
    """

    elements: Elements = field(default_factory=Elements.read)
    kind: OrbitKind = "auto"

    @classmethod
    def load(cls, file: str | Path | None = None, kind: OrbitKind = "auto") -> Orbit:
        """Read an orbit from a file of two-line elements; the default is the embedded set."""
        return cls(Elements.read(file), kind)

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
                f"are valid, but the satellite's place in its orbit {days:.0f} days from the epoch is unknown, so that "
                "times of single windows may be off by an orbit."
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

    def states(self, midnight: Float, days: Float, kind: Literal["tle", "mean"]) -> tuple[Vectors, Vectors]:
        """Return positions (km) and velocities (km/s) in SGP4's frame by SGP4 or in the mean orbit, shape (n, 3) each.

        `midnight` and `days` are parts of the Julian dates, UTC, of shape (n,).
        """
        e, record = self.elements, self.elements.satellite
        if kind == "tle":
            error, position, velocity = record.sgp4_array(midnight, days)
            if np.any(error):
                first = int(np.argmax(error != 0))
                end = f"{utc_text(float(midnight[first] + days[first]))} (SGP4 error {int(error[first])})"
                fault = f"orbital elements of epoch {e.epoch} cannot be followed to {end}"
                raise InputError(f"{fault}: give newer ones, or use the mean orbit", key="elements")
            return np.asarray(position), np.asarray(velocity)
        # The mean argument of latitude turns with the mean motion and the secular drift of the perigee due to J2, and
        # the node with the mean Sun.
        oblate = 2 * np.pi / e.period_s * J2 * (RADIUS_KM / (e.axis_km * (1 - record.ecco**2))) ** 2
        perigee = 0.75 * oblate * (5 * np.cos(record.inclo) ** 2 - 1)
        rate_deg = 360.0 * e.revolutions_per_day + float(np.degrees(perigee)) * DAY_S
        since = (midnight - e.epoch_jd) + days
        node = record.nodeo + 2 * np.pi / 365.2421897 * since
        along = record.argpo + record.mo + np.radians(rate_deg) * since
        c, s = np.cos(record.inclo), np.sin(record.inclo)
        ascending = np.stack([np.cos(node), np.sin(node), np.zeros_like(node)], axis=1)
        north = np.stack([-c * np.sin(node), c * np.cos(node), np.full_like(node, s)], axis=1)
        cosine, sine = np.cos(along)[:, None], np.sin(along)[:, None]
        speed = float(np.sqrt(GRAVITY / e.axis_km))
        return e.axis_km * (cosine * ascending + sine * north), speed * (cosine * north - sine * ascending)


@lru_cache(maxsize=1)
def _track(orbit: Orbit, times: TimeGrid) -> Track:
    midnight, days = times.julian
    return Track(orbit, times, *orbit.states(midnight, days, orbit.resolved(times)))


@dataclass(frozen=True, eq=False)
class Track:
    """The satellite's positions at the times of a plan."""

    orbit: Orbit
    times: TimeGrid
    # Position and velocity in SGP4's frame (true equator, mean equinox of date), shape (n, 3).
    of_date_km: Float
    velocity_km_s: Float

    @cached_property
    def _from_j2000(self) -> Float:
        """Matrices from J2000 to SGP4's frame (true equator, mean equinox of date), shape (n, 3, 3).

        Precession and nutation of 1976 and 1980 (Vallado et al. 2006, AIAA 2006-6753) are computed once a day and
        interpolated linearly.
        """
        midnight, days = self.times.first[0], self.times.julian[1]
        low = np.floor(days.min())
        nodes = np.arange(low, np.ceil(days.max()) + 2)
        terrestrial = nodes + 69.2 / DAY_S
        # The equation of the equinoxes turns from the true to the mean equinox of date.
        at_nodes = erfa.rz(erfa.eqeq94(midnight, terrestrial), erfa.pnm80(midnight, terrestrial))
        day = np.clip((days - low).astype(int), 0, nodes.size - 2)
        fraction = (days - low - day)[:, None, None]
        return np.asarray((1 - fraction) * at_nodes[day] + fraction * at_nodes[day + 1])

    @cached_property
    def position_km(self) -> Vectors:
        """Position in the frame of star catalogues (J2000), shape (n, 3)."""
        return np.asarray(np.einsum("nji,nj->ni", self._from_j2000, self.of_date_km))

    @cached_property
    def normal(self) -> Vectors:
        """Unit vectors along the orbit's angular momentum in the frame of star catalogues, shape (n, 3)."""
        return unit(np.einsum("nji,nj->ni", self._from_j2000, np.cross(self.of_date_km, self.velocity_km_s)))

    @cached_property
    def subsatellite_deg(self) -> tuple[Float, Float]:
        """Geodetic longitude (-180 to 180) and latitude of the sub-satellite point, shape (n,) each."""
        # The angle from SGP4's frame to the Earth-fixed frame.
        theta = erfa.gmst82(*self.times.julian)
        x, y, z = self.of_date_km.T
        fixed = np.stack([np.cos(theta) * x + np.sin(theta) * y, -np.sin(theta) * x + np.cos(theta) * y, z], axis=1)
        longitude, latitude, _ = erfa.gc2gd(1, fixed * 1e3)
        return np.degrees(longitude), np.degrees(latitude)

    @cached_property
    def bodies(self) -> Bodies:
        """Positions of Sun and Moon."""
        return Bodies.at(self.times)

    @property
    def limb_angle_rad(self) -> Float:
        """Angular radius of the Earth, a sphere of its equatorial radius, at the satellite, shape (n,)."""
        return np.asarray(np.arcsin(LIMB_KM / np.linalg.norm(self.position_km, axis=-1)))

    @property
    def sunlight(self) -> Float:
        """Fraction of the Sun's disk that the Earth does not hide, 0 to 1, shape (n,).

        The fraction is linear in angle between the two contacts of the penumbra, which are eight seconds apart.
        """
        distance = np.linalg.norm(self.position_km, axis=1)
        cosine = -np.einsum("ni,ni->n", self.position_km, self.bodies.sun) / distance
        disk = np.arcsin(SUN_KM / self.bodies.sun_km)
        visible = np.arccos(np.clip(cosine, -1, 1)) - self.limb_angle_rad + disk
        return np.asarray(np.clip(visible / (2 * disk), 0, 1))

    @property
    def beta_deg(self) -> Float:
        """Angle of the Sun from the orbital plane, positive towards the angular momentum, shape (n,)."""
        return np.asarray(np.degrees(np.arcsin(np.einsum("ni,ni->n", self.normal, self.bodies.sun))))

    @property
    def local_time_h(self) -> Float:
        """Local mean solar time of the descending node, hours, shape (n,)."""
        momentum = np.cross(self.of_date_km, self.velocity_km_s)
        ascending = np.arctan2(momentum[:, 0], -momentum[:, 1])
        midnight, days = self.times.julian
        # Mean longitude of the Sun from the mean equinox of date (Meeus, Astronomical Algorithms, chapter 25).
        sun = np.radians(280.46646 + 0.98564736 * (midnight - 2_451_545.0 + days))
        return np.asarray((np.degrees(ascending + np.pi - sun) / 15.0 + 12.0) % 24.0)


#: Timeout of a SIMBAD query, s.
TIMEOUT_S = 10.0


@dataclass(frozen=True)
class Target:
    """A position on the sky and the known properties of the star there."""

    name: str
    ra_deg: float  # ICRS, as the declination
    dec_deg: float
    source: str  # origin of the position
    distance_pc: float | None = None
    magnitude: float | None = None  # in V
    spectral_type: str | None = None

    @classmethod
    def of(cls, text: str, *, name: str | None = None, simbad: bool = False) -> Target:
        """Resolve a name of the embedded list, or ICRS coordinates: "290.0 -11.2" (deg) or "19h22m00s -11d12m00s".

        Reports call it by `name`, by default that of the list or the text. With `simbad`, SIMBAD is asked for a name
        that is not embedded, which needs `mauvecl[names]` and a network.
        """
        if is_missing_position(text):
            raise InputError(f"target {shortened(text)} holds missing values; give {EXPECTED_POSITION}", key="target")
        star = by_key().get(name_key(text))
        if star is not None:
            return cls(name or star.name, star.ra_deg, star.dec_deg, f"embedded list ({star.source})",
                       star.distance_pc, star.magnitude, star.spectral_type)  # fmt: skip
        if re.match(r"\s*[^\W\d]", text) and not re.match(r"\s*ra\W*\d", text, re.IGNORECASE):
            if simbad:
                return _from_simbad(text, name)
            like = ", ".join(near_names(text, stars_only=True))
            remedy = f"give a name such as {like}, coordinates such as '290.0 -11.2', or `simbad=True` to ask SIMBAD"
            raise InputError(f"target {shortened(text)} is not in the embedded list; {remedy}", key="target")
        with offline():
            position = parse_position(text).icrs
        return cls(name or text.strip(), float(position.ra.deg), float(position.dec.deg), "given")

    @property
    def direction(self) -> Float:
        """Unit vector, ICRS, shape (3,)."""
        a, d = np.radians([self.ra_deg, self.dec_deg])
        return np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])


def target_table() -> Table:
    """Return the embedded stars: name, ra, dec (deg, ICRS), distance (pc), V, spectral_type, other_names and source."""
    return parse_ecsv(library_text("well_known.ecsv"), "the embedded list of stars")


#: ADQL query of SIMBAD (tried with astroquery 0.4.11). The left join keeps stars without a V magnitude.
SIMBAD_QUERY = (
    'SELECT basic.ra, basic.dec, basic.plx_value, basic.sp_type, allfluxes."V" FROM ident JOIN basic '
    "ON ident.oidref = basic.oid LEFT JOIN allfluxes ON allfluxes.oidref = basic.oid WHERE ident.id = '{}'"
)


def _from_simbad(text: str, name: str | None) -> Target:
    """Query SIMBAD, with a timeout."""
    try:
        from astroquery.simbad import Simbad
    except ImportError:
        fault = f"target {shortened(text)} is not in the embedded list and astroquery is missing"
        raise InputError(f"{fault}; give coordinates, or `pip install 'mauvecl[names]'`", key="target") from None
    query = SIMBAD_QUERY.format(text.strip().replace("'", "''"))
    try:
        table = _within(TIMEOUT_S, lambda: Simbad.query_tap(query))
    except Exception as error:  # astroquery raises many kinds for a network failure
        fault = f"target {shortened(text)} is not in the embedded list and SIMBAD did not answer within {TIMEOUT_S:g} s"
        remedy = "this needs a network, or give coordinates"
        raise InputError(f"{fault} ({type(error).__name__}); {remedy}", key="target") from error
    if table is None or len(table) == 0:
        raise InputError(f"SIMBAD knows no target {shortened(text)}; give another name, or coordinates", key="target")
    # NaN differs from itself.
    star = {name: value if value == value else None for name, value in records(table)[0].items()}
    if star["ra"] is None or star["dec"] is None:
        raise InputError(f"target {shortened(text)} has no coordinates in SIMBAD; give another name", key="target")
    parallax, kind = star["plx_value"], (star["sp_type"] or "").strip() or None
    distance = 1000 / parallax if parallax is not None and parallax > 0 else None
    return Target(name or text.strip(), star["ra"], star["dec"], "SIMBAD", distance, star["V"], kind)


def _within(seconds: float, ask: Callable[[], Any]) -> Any:
    """Call a function and raise TimeoutError if it takes too long, since astroquery's requests may never return."""
    answer: Future[Any] = Future()

    def run() -> None:
        try:
            answer.set_result(ask())
        except Exception as error:
            answer.set_exception(error)

    # A daemon thread does not delay the exit of the program.
    threading.Thread(target=run, daemon=True).start()
    return answer.result(seconds)
