"""Frames that are changed while they are read: weighted sums of spectra, and times at the barycentre."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.orbit.orbit import Orbit, Target
from mauvecl.host.tables.files import limit_bytes
from mauvecl.host.tables.table import Values
from mauvecl.host.tables.units import SCALES, offline
from mauvecl.observations.frames import Frames, dead_pixel_remarks, live_pixels
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


#: Light, errors and quality of frames, and remarks.
Light = tuple[Float, Float | None, Float | None, tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class PixelStatistics:
    """Light and noise of each pixel over the frames without a fault, arrays of shape (n_pixel,).

    Attributes
    ----------
    count : ndarray of int
        Frames in which the pixel is finite.
    mean : ndarray
    scatter : ndarray
        Standard deviation of a frame, from differences of neighbouring frames: slow changes have no part in it.
    stated : ndarray or None
        Root of the mean of the squared errors that the file states.
    """

    count: NDArray[np.int64]
    mean: Float
    scatter: Float
    stated: Float | None


@dataclass(frozen=True, eq=False)
class WeightedSums:
    """Weighted sums of the pixels of each frame."""

    sums: Float  # shape (n_frame, n_weight); NaN for frames with a pixel that is not finite
    errors: Float | None  # from the stated errors of the pixels, which are taken to be independent
    pixels: PixelStatistics
    dead: int  # number of pixels that are left out, because they are not finite in most frames

    def light(self, number: int, what: str, quality: Values | None) -> Light:
        """Return the sums of one weight with their errors, the quality of the frames and remarks."""
        error = None if self.errors is None else self.errors[:, number]
        return self.sums[:, number], error, _flags(quality), dead_pixel_remarks(self.dead, what)


def weighted_sums(
    flux: Values, error: Values | None, quality: Values | None, weights: Float | None = None
) -> WeightedSums:
    """Reduce spectra to weighted sums, by default the sum over all pixels, reading them twice in pieces.

    Quality has the shape of the flux or of its frames, and is zero where nothing is wrong.
    """
    n, n_pixel = flux.shape
    given = np.ones((1, n_pixel)) if weights is None else np.atleast_2d(np.asarray(weights, np.float64))
    if given.shape[1] != n_pixel or not np.isfinite(given).all():
        raise InputError.of("weights", given.shape, f"finite numbers of shape (n_weight, {n_pixel})", where=flux.what)
    statistics, finite = _statistics(flux, error, quality)
    live = live_pixels(finite, n, flux.what)
    sums = np.empty((n, len(given)))
    errors = None if error is None else np.empty_like(sums)
    for part in flux.pieces:
        sums[part] = _piece(flux, quality, part)[:, live] @ given[:, live].T
        if error is not None and errors is not None:
            errors[part] = np.sqrt(error.rows(part.start, part.stop)[:, live] ** 2 @ given[:, live].T ** 2)
    return WeightedSums(sums, errors, statistics, int((~live).sum()))


def _piece(flux: Values, quality: Values | None, part: slice) -> Float:
    """Return rows of spectra, NaN in pixels with their own quality flag."""
    values = flux.rows(part.start, part.stop)
    if quality is not None and len(quality.shape) == 2:
        flags = quality.rows(part.start, part.stop) != 0
        values[flags & ~flags.all(axis=1, keepdims=True)] = np.nan
    return values


def _flags(quality: Values | None) -> Float | None:
    """Return one flag for each frame; of flags for each pixel those of frames in which every pixel has one."""
    if quality is None:
        return None
    if len(quality.shape) == 1:
        return quality.numbers()
    rows = (quality.rows(part.start, part.stop) for part in quality.pieces)
    return np.concatenate([np.where((one != 0).all(axis=1), np.abs(one).max(axis=1), 0.0) for one in rows])


def _statistics(
    flux: Values, error: Values | None, quality: Values | None
) -> tuple[PixelStatistics, NDArray[np.int64]]:
    """Return statistics of frames without a fault, and how often each pixel is finite in any frame."""
    n_pixel = flux.shape[1]
    finite, count, pairs = np.zeros((3, n_pixel), np.int64)
    total, squares, stated = np.zeros((3, n_pixel))
    before = np.full((1, n_pixel), np.nan)
    for part in flux.pieces:
        values = _piece(flux, quality, part)
        finite += np.isfinite(values).sum(axis=0)
        if quality is not None and len(quality.shape) == 1:
            values[quality.rows(part.start, part.stop) != 0] = np.nan
        fine = np.isfinite(values)
        values[~fine] = np.nan
        count += fine.sum(axis=0)
        total += values.sum(axis=0, where=fine)
        steps = np.diff(values, axis=0, prepend=before)
        before = values[-1:].copy()
        del values
        known = np.isfinite(steps)
        pairs += known.sum(axis=0)
        squares += np.square(steps, out=steps).sum(axis=0, where=known)
        if error is not None:
            stated += np.where(fine, error.rows(part.start, part.stop) ** 2, 0.0).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, scatter = total / count, np.sqrt(squares / pairs / 2.0)
        return PixelStatistics(count, mean, scatter, None if error is None else np.sqrt(stated / count)), finite


def whole_or_reduced(flux: Values, error: Values | None, quality: Values | None) -> Light:
    """Read light whole if it fits into memory, else reduced to its sum over wavelength."""
    n_bytes = 8 * int(np.prod(flux.shape)) * (1 if error is None else 2)
    limit = limit_bytes("MAUVECL_LARGEST_CONTENT_MIB")
    if len(flux.shape) == 1 or n_bytes <= limit:
        light = np.empty(flux.shape)
        for part in flux.pieces:
            light[part] = _piece(flux, quality, part)
        return light, None if error is None else error.numbers(), _flags(quality), ()
    found = weighted_sums(flux, error, quality)
    remarks = (
        f"{flux.what} has {n_bytes / 2**20:.0f} MiB of spectra, more than {limit >> 20} MiB: they were summed over "
        "wavelength while they were read; MAUVECL_LARGEST_CONTENT_MIB sets the limit",
    )
    light, sd, flags, more = found.light(0, flux.what, quality)
    return light, sd, flags, (*remarks, *more)
