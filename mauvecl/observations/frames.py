"""Observed frames: times, fluxes, errors and quality flags, and their times at the barycentre."""

from __future__ import annotations

import contextlib
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntFlag
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.arrays import Float
from mauvecl.host.orbit.orbit import Orbit, Target
from mauvecl.host.tables.units import SCALES, mission_of, offline
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import DAY_S, AnyUnit, Moment, Unit, date_text, is_quantity, without_unit

if TYPE_CHECKING:
    from astropy.time import Time

#: Bits of SAP_QUALITY by number: Kepler Archive Manual (KDMC-10008-006, table 2-3), K2 Archive Manual.
KEPLER = {
    1: "AttitudeTweak", 2: "SafeMode", 4: "CoarsePoint", 8: "EarthPoint", 16: "ZeroCrossing", 32: "Desat",
    64: "Argabrightening", 128: "ApertureCosmic", 256: "ManualExclude", 1024: "SensitivityDropout",
    2048: "ImpulsiveOutlier", 4096: "ArgabrighteningOnCCD", 8192: "CollateralCosmic", 16384: "DetectorAnomaly",
    32768: "NoFinePoint", 65536: "NoData", 131072: "RollingBandInAperture", 262144: "RollingBandInMask",
    524288: "PossibleThrusterFiring", 1048576: "ThrusterFiring",
}  # fmt: skip
#: Bits of QUALITY by number: TESS Science Data Products Description (EXP-TESS-ARC-ICD-0014 Rev F, table 32).
TESS = {
    1: "AttitudeTweak", 2: "SafeMode", 4: "CoarsePoint", 8: "EarthPoint", 16: "Argabrightening", 32: "Desat",
    64: "ApertureCosmic", 128: "ManualExclude", 256: "Discontinuity", 512: "ImpulsiveOutlier",
    1024: "CollateralCosmic", 2048: "Straylight", 4096: "Straylight2", 8192: "PlanetSearchExclude",
    16384: "BadCalibrationExclude", 32768: "InsufficientTargets",
}  # fmt: skip
NAMES: Mapping[str, Mapping[int, str]] = {"Kepler": KEPLER, "TESS": TESS}
#: Bits that exclude a frame by default, as in lightkurve 2.6, and bits that are noted. ImpulsiveOutlier of TESS, which
#: lightkurve excludes, is only noted, because it can mark flares.
DEFAULTS, NOTED = {"Kepler": 1_130_799, "TESS": 17_087 & ~512}, {"TESS": 512}
ALL_BITS = 2**62 - 1


@dataclass(frozen=True)
class QualityBits:
    """Bits of a quality flag that exclude a frame."""

    mask: int = ALL_BITS
    mission: str = ""  # whose names the bits have; empty if they have none
    noted: int = 0  # bits that are reported, though they do not exclude a frame

    @classmethod
    def of(cls, header: Mapping[str, Any], chosen: str | int | None, label: str) -> QualityBits:
        """Return the bits that are chosen for a file, or its mission's defaults; see `FrameMapping.quality_bits`."""
        mission = {"KEPLER": "Kepler", "K2": "Kepler", "TESS": "TESS"}.get(mission_of(header), "")
        if chosen is None or str(chosen).strip().lower() == "default":
            return cls(DEFAULTS.get(mission, ALL_BITS), mission, NOTED.get(mission, 0))
        names, mask = NAMES.get(mission, {}), 0
        by_name = {name.lower(): bit for bit, name in names.items()} | {"all": ALL_BITS, "none": 0}
        words = [word for word in re.split(r"[\s,;|+]+", str(chosen).strip()) if word]
        for word in words or [str(chosen)]:
            if word.isascii() and word.isdigit() and len(word) < 19:
                mask |= int(word)
            elif word.lower() in by_name and (len(words) == 1 or word.lower() not in ("all", "none")):
                mask |= by_name[word.lower()]
            else:
                usual = f"names among {', '.join(names.values())}" if names else "for Kepler, K2 and TESS names"
                raise InputError.of("quality_bits", word, f"all, none, default, or numbers, and {usual}", where=label)
        return cls(mask, mission)

    def excluded(self, quality: NDArray[Any]) -> NDArray[np.bool_]:
        """Return whether a chosen bit excludes each frame, shape of `quality`."""
        return np.asarray((np.asarray(quality, np.int64) & self.mask) != 0)

    def words(self, value: int) -> str:
        """Return the bits of a flag that exclude the frame, as in "Desat (32), NoData (65536)"."""
        value = int(value) & self.mask
        names = NAMES.get(self.mission, {})
        bits = [1 << k for k in range(value.bit_length()) if value >> k & 1]
        return ", ".join(f"{names[bit]} ({bit})" if bit in names else str(bit) for bit in bits)

    def remarks(self, quality: NDArray[Any] | None, name: str) -> tuple[str, ...]:
        """Return the remark on frames that have a noted bit and are kept."""
        flags = np.asarray(0 if quality is None else quality, np.int64)
        n = int(np.count_nonzero((flags & self.noted != 0) & ~self.excluded(flags)))
        if not n:
            return ()
        bits = QualityBits(self.noted, self.mission).words(self.noted)
        frames, verb = ("1 frame", "is") if n == 1 else (f"{n} frames", "are")
        return (f"{frames} of {name} with the quality flag {bits} {verb} kept, because it can mark flares",)


#: Smallest number of frames from which level and noise can be estimated.
MIN_FRAMES = 20
#: Largest number of frames, for which a search needs some 2 GiB.
MAX_FRAMES = 2**22
#: Largest time from the first to the last frame in median steps, the grid of searches: 42 years of 20 s.
MAX_SPAN = 2**26
#: Largest flux, whose square and sums of squares are finite numbers.
MAX_FLUX = 1e100
#: Share of frames in which a pixel must be finite; others are left out of every frame.
LIVE_SHARE = 0.5
#: Shortest time between frames as a share of the cadence; frames that are closer overlap.
MIN_STEP = 0.5


class Reason(IntFlag):
    """Why a frame is not searched, as bits of a quality flag."""

    QUALITY = 1  #: the file's own quality flag has a bit that excludes the frame
    NOT_FINITE = 2  #: flux or error is not a finite number, or the error is not positive
    BELOW = 4  #: far below the quiescent level, where no flare can be
    SPIKE = 8  #: a single frame far above both of its neighbours, such as a cosmic ray
    SATURATED = 16  #: a pixel reaches saturation
    LOSS = 32  #: light is suddenly lost for some frames, as by pointing losses and eclipses

    @classmethod
    def words(cls, values: NDArray[Any]) -> NDArray[np.str_]:
        """Return the reasons of frames in words."""
        distinct, place = np.unique(values, return_inverse=True)
        names = {reason: str(reason.name).lower().replace("_", " ") for reason in cls}
        words = [", ".join(name for reason, name in names.items() if value & reason) for value in distinct]
        return np.array(words, np.str_)[place]


def _in_one_unit(flux: ArrayLike, error: ArrayLike | None, unit: str, name: str) -> tuple[Any, Any, str]:
    """Return fluxes and errors as plain numbers in `unit`, or else in that of the fluxes, and this unit."""
    unit = unit or str(getattr(flux, "unit", None) or "")
    try:
        light, spread = (without_unit(values, unit) if is_quantity(values) else values for values in (flux, error))
    except ValueError as fault:
        raise InputError(f"{name} needs fluxes and errors in units that convert: {fault}", key="flux") from fault
    return light, spread, unit


def _cadence_of(name: str, time: Float, light: Float) -> float:
    """Return the median step of times; raise InputError for wrong shapes and sizes, and for frames too near or far."""
    n, refused = time.size, partial(InputError.of, where=name)
    if time.ndim != 1 or light.ndim not in (1, 2) or len(light) != n:
        raise refused("shape", (time.shape, light.shape), "times of shape (n,), flux of (n,) or (n, n_pixel)")
    if not MIN_FRAMES <= n <= MAX_FRAMES:
        raise refused("frames", n, f"{MIN_FRAMES} to {MAX_FRAMES} frames")
    if (beyond := light[np.isfinite(light) & (np.abs(light) > MAX_FLUX)]).size:
        raise refused("flux", f"{beyond[0]:g}", f"values between -{MAX_FLUX:g} and {MAX_FLUX:g}")
    if not np.isfinite(time).all():
        row = int(np.argmin(np.isfinite(time)))
        raise refused("time", f"{time[row]} in row {row}", "a finite number in each row")
    step = np.diff(np.sort(time))
    cadence = float(np.median(step))
    if not cadence > 0 or (step < MIN_STEP * cadence).any():
        expected = f"frames that are at least {MIN_STEP:g} of the median step of {cadence:g} s apart"
        expected = expected if cadence > 0 else "a different time for each frame"
        raise refused("time", f"{step.min():g} s from one frame to the next", expected)
    if not (span := float(np.ptp(time))) <= MAX_SPAN * cadence:
        expected = f"at most {MAX_SPAN} of the median step of {cadence:g} s"
        raise refused("time", f"{span:g} s from the first frame to the last", expected)
    return cadence


def _in_order(key: str, column: Any, light: Float, order: NDArray[np.intp], name: str) -> Any:
    """Return the values of frames in order of time, or None if there are none; one error applies to all frames."""
    if column is None:
        return None
    values = np.asarray(column, np.int64 if key == "quality" else np.float64)
    shape = light.shape if key == "error" else order.shape
    values = np.full(shape, values) if key == "error" and values.ndim == 0 else values
    if values.shape != shape:
        given, expected = f"those of shape {values.shape}", f"values of shape {shape}"
        raise InputError.of(key.removesuffix("_c"), given, expected, where=name)
    return values[order]


def _with_mjd(reference: Any, scale: str) -> dict[str, Any]:
    """Return the attributes of a reference that is a time or a date, on a time scale; nothing for others."""
    if isinstance(reference, str) or not isinstance(text := date_text(reference), str):
        return {}
    from astropy.time import Time

    with offline(), contextlib.suppress(ValueError):
        moment = reference if isinstance(reference, Time) else Time(text, scale="utc")
        # A time that is masked in a table is none.
        return {"reference_mjd": float(np.ma.filled(getattr(moment, scale).mjd, np.nan)), "scale": scale}
    return {}


Degrees = Annotated[float, Unit("deg")]


@validated
@dataclass(frozen=True, eq=False)
class Frames:
    """Observed frames of one star."""

    time_s: Annotated[Float, Unit("s")]  #: middle of each frame from `reference_mjd`, shape (n_frame,); ascending
    exposure_s: Annotated[Float, Unit("s")]  #: of each frame, shape (n_frame,)
    flux: Float  #: light in `unit`, shape (n_frame,) or (n_frame, n_pixel)
    error: Float | None = None  #: standard deviation of each value, if known
    quality: NDArray[np.int64] | None = None  #: shape (n_frame,); zero for frames without a known fault
    quality_mask: int = ALL_BITS  #: bits of `quality` that exclude a frame; by default all
    mission: str = ""  #: whose names the bits have, "Kepler" (and K2) or "TESS"; empty for other files
    wavelength_nm: Annotated[Float, Unit("nm")] | None = None  #: shape (n_pixel,), of spectra
    temperature_c: Annotated[Float, Unit("deg_C")] | None = None  #: of the detector, shape (n_frame,)
    unit: str = ""  #: of the flux, in astropy's notation; empty if it is relative or unknown
    reference_mjd: float | None = None  #: Modified Julian date of time zero; None if the times have no date
    scale: str = ""  #: of the dates, such as "utc" or "tdb"; empty if unknown
    position: str = ""  #: where the times hold, in words of FITS TREFPOS, as "TOPOCENTER"; empty if unknown
    direction_deg: tuple[Degrees, Degrees] | None = None  #: right ascension and declination (ICRS) of barycentric times
    name: str = "frames"  #: of the star or the file
    instrument: str = ""  #: empty if unknown
    net: bool = False  #: whether bias and dark current are known to be subtracted, as by `mauvecl realise`
    remarks: tuple[str, ...] = ()  #: what was done while reading, such as sorting

    @classmethod
    def of(
        cls,
        time_s: Annotated[ArrayLike, Unit("s")],
        flux: Annotated[ArrayLike, AnyUnit()],
        error: Annotated[ArrayLike, AnyUnit()] | None = None,
        *,
        exposure_s: Annotated[ArrayLike, Unit("s")] | None = None,
        quality: ArrayLike | None = None,
        wavelength_nm: Annotated[ArrayLike, Unit("nm")] | None = None,
        temperature_c: Annotated[ArrayLike, Unit("deg_C")] | None = None,
        name: str = "frames",
        **how: Any,
    ) -> Self:
        """Build frames from arrays in any order of time.

        Parameters
        ----------
        time_s : array_like, shape (n_frame,)
            Middle of each frame, also as a TimeDelta; `mauvecl.observations.frame_files.frames_of` reads dates.
        flux, error : array_like, shape (n_frame,) or (n_frame, n_pixel)
            Plain numbers, or Quantities and columns in units that convert to each other; one error applies to all.
        exposure_s : array_like, optional
            One exposure time, or one for each frame; by default the median time between frames.
        quality : array_like, shape (n_frame,), optional
        wavelength_nm : array_like, shape (n_pixel,), optional
            Middle of each pixel of spectra, in any order.
        temperature_c : array_like, shape (n_frame,), optional
            Temperature of the detector.
        name : str
        **how
            Other attributes; ``reference_mjd`` may be a Time, or a date in UTC.
        """
        if (scale := how.get("scale") or "utc") in SCALES.values():
            how |= _with_mjd(how.get("reference_mjd"), scale)
        flux, error, how["unit"] = _in_one_unit(flux, error, how.get("unit", ""), name)
        time, light = np.asarray(time_s, np.float64), np.asarray(flux, np.float64)
        cadence, refused = _cadence_of(name, time, light), partial(InputError.of, where=name)
        n, order = time.size, np.argsort(time, kind="stable")
        if quality is not None and not np.isfinite(np.asarray(quality, np.float64)).all():
            raise refused("quality", "a value that is not finite", "whole numbers")
        if exposure_s is not None and np.shape(exposure_s) not in ((), (1,), (n,)):
            raise refused("exposure", np.shape(exposure_s), f"one exposure time, or one for each of {n} frames")
        exposure = np.broadcast_to(np.asarray(cadence if exposure_s is None else exposure_s, np.float64), (n,))
        if not (np.isfinite(exposure) & (exposure > 0)).all():
            raise refused("exposure", f"{exposure[np.argmin(exposure)]:g} s", "exposure times above 0")
        flags = np.zeros(n) if quality is None else quality
        columns = {"error": error, "temperature_c": temperature_c, "quality": flags}
        by_frame = {key: _in_order(key, column, light, order, name) for key, column in columns.items()}
        nm = None if wavelength_nm is None else np.asarray(wavelength_nm, np.float64)
        frames = cls(time[order], exposure[order], light[order], wavelength_nm=nm, name=name, **by_frame, **how)
        if (np.diff(time) < 0).any():
            frames = frames.with_remarks((f"the times of {name} are not ascending; its frames were sorted by time",))
        if (None if nm is None else nm.shape) != (None if light.ndim == 1 else light.shape[1:]):
            expected = "one wavelength for each pixel of spectra, none for a light curve"
            raise refused("wavelength", None if nm is None else nm.shape, expected)
        return frames if nm is None else frames._with_sorted_live_pixels(nm)

    def _with_sorted_live_pixels(self, wavelength: Float) -> Self:
        """Return spectra in order of wavelength, without the pixels that are not finite in most frames."""
        if not (np.isfinite(wavelength).all() and (wavelength > 0).all()):
            raise InputError.of("wavelength", float(wavelength.min()), "wavelengths above 0 nm", where=self.name)
        finite = np.isfinite(self.flux) if self.error is None else np.isfinite(self.flux) & np.isfinite(self.error)
        live, remarks = live_pixels(finite.sum(axis=0), self.n_frames, self.name)
        order = np.argsort(wavelength, kind="stable")
        chosen = order[live[order]]
        if np.array_equal(chosen, np.arange(wavelength.size)):
            return self
        error = None if self.error is None else self.error[:, chosen]
        frames = replace(self, flux=self.flux[:, chosen], error=error, wavelength_nm=wavelength[chosen])
        return frames.with_remarks(remarks)

    @property
    def white_light(self) -> tuple[Float, Float | None]:
        """Light curve and its errors, shape (n_frame,): of spectra, the sum over wavelength.

        Frames with a value that is not finite are not finite.
        """
        if self.flux.ndim == 1:
            return self.flux, self.error
        return self.flux.sum(axis=1), None if self.error is None else np.sqrt((self.error**2).sum(axis=1))

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return self.time_s.size

    @cached_property
    def cadence_s(self) -> float:
        """Median time between frames."""
        return float(np.median(np.diff(self.time_s)))

    @cached_property
    def numbers(self) -> NDArray[np.int64]:
        """Number of each frame on a regular grid of the cadence, with gaps, shape (n_frame,).

        Steps are rounded one by one, so that slowly changing times such as barycentric ones stay on the grid.
        """
        steps = np.maximum(1, np.rint(np.diff(self.time_s) / self.cadence_s)).astype(np.int64)
        return np.concatenate([[0], np.cumsum(steps)])

    @cached_property
    def faults(self) -> NDArray[np.int64]:
        """Reasons that the file itself gives not to search a frame, shape (n_frame,); see `Reason`."""
        values = self.flux.reshape(self.n_frames, -1)
        finite = np.isfinite(values).all(axis=1)
        if self.error is not None:
            errors = self.error.reshape(self.n_frames, -1)
            # An error below the rounding of the number is not an error.
            finite &= (np.isfinite(errors) & (errors > 1e-16 * np.abs(values))).all(axis=1)
        flagged = self.quality is not None and QualityBits(self.quality_mask).excluded(self.quality)
        return np.asarray(np.where(flagged, Reason.QUALITY, 0) | np.where(finite, 0, Reason.NOT_FINITE), np.int64)

    @property
    def flags(self) -> list[str]:
        """Bits of the quality flag that exclude each frame, as in "Desat (32)"; empty for others."""
        if self.quality is None:
            return [""] * self.n_frames
        return [*map(cache(QualityBits(self.quality_mask, self.mission).words), self.quality.tolist())]

    def shifted(self, by_s: Annotated[ArrayLike, Unit("s")]) -> Self:
        """Return the frames with other times: all `by_s` later, or each by its own time, shape (n_frame,)."""
        return replace(self, time_s=self.time_s + np.asarray(by_s, np.float64))

    def with_remarks(self, remarks: tuple[str, ...]) -> Self:
        """Return the frames with additional remarks."""
        return replace(self, remarks=(*self.remarks, *remarks))

    @property
    def time_keywords(self) -> dict[str, str | float]:
        """Keywords of FITS (standard 4.0, section 9) for epoch, scale and place of the times; those that are known."""
        keywords: dict[str, str | float | None] = {
            "MJDREF": self.reference_mjd, "TIMESYS": self.scale.upper(), "TREFPOS": self.position,
        }  # fmt: skip
        if self.direction_deg is not None:
            ra, dec = self.direction_deg
            keywords |= {"TREFDIR": "RA_OBJ,DEC_OBJ", "RA_OBJ": ra, "DEC_OBJ": dec}
        return {key: value for key, value in keywords.items() if value not in (None, "")}

    def date(self, time_s: Moment) -> str:
        """Return a time as an ISO 8601 date, or as seconds if the times have no date."""
        if self.reference_mjd is None:
            return f"{time_s:.1f} s"
        from astropy.time import Time

        scale = self.scale if self.scale in ("utc", "tdb", "tai", "tt") else "tdb"
        return str(Time(self.reference_mjd, time_s / DAY_S, format="mjd", scale=scale).isot)


def live_pixels(finite: NDArray[np.int64], n_frames: int, name: str) -> tuple[NDArray[np.bool_], tuple[str, ...]]:
    """Return the pixels that are finite in most frames, from the frames in which each of them is, and a remark."""
    live = finite > LIVE_SHARE * n_frames
    if not live.any():
        raise InputError(f"{name}: at least one pixel must be finite in most frames, but none is", key="flux")
    number = int((~live).sum())
    words = "1 pixel is" if number == 1 else f"{number} pixels are"
    return live, (f"{words} not finite in most frames of {name} and left out",) if number else ()


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
    from astropy.constants import c
    from astropy.time import Time

    name = frames.name
    if frames.reference_mjd is None:
        raise InputError(f"{name}: its times have no date; give a mapping with epoch", key="epoch")
    if frames.position == "BARYCENTER":
        return frames.with_remarks((f"the times of {name} are barycentric already",))
    if frames.scale not in SCALES.values():
        scales = ", ".join(sorted(set(SCALES.values())))
        raise InputError.of("scale", frames.scale, f"one of {scales}, as a mapping states", where=name)
    if frames.position not in ("GEOCENTER", "TOPOCENTER"):
        raise InputError.of("position", frames.position, "TOPOCENTER or GEOCENTER, as a mapping states", where=name)
    if frames.position == "TOPOCENTER" and orbit is None:
        whose = frames.instrument or "its satellite"
        raise InputError(f"{name}: the orbit of {whose} needs two-line elements in `orbit.tle`", key="orbit.tle")
    with offline():
        when = Time(frames.reference_mjd, frames.time_s / DAY_S, format="mjd", scale=frames.scale)
        pieces = [when[k : k + PIECE] for k in range(0, frames.n_frames, PIECE)]
        place = None if frames.position == "GEOCENTER" else orbit
        delay = np.concatenate([_light_travel_s(times, target, place) for times in pieces])
        first = when[0].tdb + delay[0] * u.s
        seconds = (when.tdb - first).to_value(u.s) + delay
    remark = f"times are at the Solar System's barycentre (TDB) for {target.name} ({target.source})"
    if place is not None:
        days = float(np.abs(when.utc.jd - place.elements.epoch_jd).max())
        if place.resolved_at(days) == "mean":
            error_ms = (place.elements.axis_km * u.km / c).to_value(u.ms)
            remark += f", good to {error_ms:.0f} ms: the place in the orbit is not known"
        else:
            error_ms = (place.along_track_km(days) * u.km / c).to_value(u.ms)
            remark += f", good to {error_ms:.2g} ms along the track of {place.elements.source}"
    return replace(
        frames, time_s=seconds, reference_mjd=float(first.mjd), scale="tdb", position="BARYCENTER",
        direction_deg=(target.ra_deg, target.dec_deg),
    ).with_remarks((remark,))  # fmt: skip


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
