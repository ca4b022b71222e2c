"""Times of frames at the Solar System's barycentre, from the position of the satellite that took them."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.orbit.orbit import Orbit, Target
from mauvecl.host.tables.times import SCALES, offline
from mauvecl.observations.frames import Frames
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S

if TYPE_CHECKING:
    from astropy.time import Time

Float = NDArray[np.float64]

#: Speed of light, km/s (exact).
LIGHT_KM_S = 299_792.458
#: Times that are converted at once.
PIECE = 50_000


def barycentric(frames: Frames, target: Target, orbit: Orbit | None = None) -> Frames:
    """Return frames whose times are those at the Solar System's barycentre, in TDB.

    The light travel time is astropy's, for a plane wave from the target (no parallax) and its built-in ephemeris,
    which is good to some microseconds. A remark states how well the satellite's position is known.

    Parameters
    ----------
    frames : Frames
        Dated, at ``GEOCENTER`` or ``TOPOCENTER``; barycentric ones are returned as they are, with a remark.
    target : Target
    orbit : Orbit, optional
        Orbit of the satellite, for ``TOPOCENTER``.
    """
    import astropy.units as u
    from astropy.time import Time

    name = frames.name
    if frames.reference_mjd is None:
        raise InputError(f"{name}: its times have no date", "a mapping with epoch", key="epoch")
    if frames.position == "BARYCENTER":
        return frames.with_remarks((f"the times of {name} are barycentric already",))
    if frames.scale not in SCALES.values():
        known = ", ".join(sorted(set(SCALES.values())))
        raise InputError.of("scale", frames.scale, f"a mapping with scale, one of {known}", where=name)
    if frames.position not in ("GEOCENTER", "TOPOCENTER"):
        raise InputError.of("position", frames.position, "a mapping with position, TOPOCENTER or GEOCENTER", where=name)
    if frames.position == "TOPOCENTER" and orbit is None:
        raise InputError(f"{name}: the orbit of {frames.instrument or 'its satellite'} is not known",
                         "two-line elements in `orbit.tle`", key="orbit.tle")  # fmt: skip
    with offline():
        when = Time(frames.reference_mjd, frames.time_s / DAY_S, format="mjd", scale=frames.scale)
        parts = [when[k : k + PIECE] for k in range(0, frames.n_frames, PIECE)]
        place = None if frames.position == "GEOCENTER" else orbit
        late = np.concatenate([_light_travel_s(part, target, place) for part in parts])
        first = when[0].tdb + late[0] * u.s
        seconds = (when.tdb - first).to_value(u.s) + late
        reference = float(first.mjd)
    remark = f"times are at the Solar System's barycentre (TDB) for {target.name} ({target.source})"
    if place is not None:
        remark += f", {_accuracy(place, when)}"
    made = replace(
        frames, time_s=seconds, reference_mjd=reference, scale="tdb", position="BARYCENTER",
        direction_deg=(target.ra_deg, target.dec_deg),
    )  # fmt: skip
    return made.with_remarks((remark,))


def _light_travel_s(when: Time, target: Target, orbit: Orbit | None) -> Float:
    """Return the delay of light from the observer to the barycentre, s, shape (n,); call inside `offline`."""
    import astropy.units as u
    from astropy.coordinates import ITRS, TEME, CartesianRepresentation, EarthLocation, SkyCoord
    from astropy.utils import iers

    # Old tables of the Earth's rotation do no harm: it is used twice, in opposite directions.
    with (
        iers.conf.set_temp("iers_degraded_accuracy", "ignore"),
        iers.conf.set_temp("auto_max_age", None),
        warnings.catch_warnings(),
    ):
        warnings.filterwarnings("ignore", message=".*polar motions.*")
        utc = when.utc
        if orbit is None:
            observer = EarthLocation.from_geocentric(0.0, 0.0, 0.0, unit=u.m)
        else:
            days = np.abs(utc.jd - orbit.elements.epoch_jd).max()
            position, _ = orbit.states(utc.jd1, utc.jd2, orbit.resolved_at(float(days)))
            earth_fixed = TEME(CartesianRepresentation(position.T * u.km), obstime=utc).transform_to(ITRS(obstime=utc))
            observer = EarthLocation(*earth_fixed.cartesian.xyz)
        star = SkyCoord(target.ra_deg, target.dec_deg, unit="deg")
        return np.asarray(utc.light_travel_time(star, "barycentric", location=observer).to_value(u.s))


def _accuracy(orbit: Orbit, when: Time) -> str:
    """Return the accuracy of the satellite's position, as a part of a sentence."""
    days = float(np.abs(when.utc.jd - orbit.elements.epoch_jd).max())
    if orbit.resolved_at(days) == "mean":
        return f"good to {1e3 * orbit.elements.axis_km / LIGHT_KM_S:.0f} ms: the place in the orbit is not known"
    off = 1e3 * orbit.along_track_km(days) / LIGHT_KM_S
    return f"good to {off:.2g} ms along the track of {orbit.elements.source}"
