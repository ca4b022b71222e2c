"""A stare as a FITS file: light curve, good time intervals, dynamic spectrum.

The names and units of the first table are those that lightkurve recognises (`lightkurve.read`), and with
it AltaiPony: TIME in days, FLUX, FLUX_ERR, QUALITY, CADENCENO.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.host.exposure.sky import parse_position, parse_time
from mauvecl.host.tables.times import offline
from mauvecl.host.version import VERSION
from mauvecl.schema.physical import DAY_S

if TYPE_CHECKING:
    from astropy.io import fits

    from mauvecl.answers.stares.star_stare import StarStare
    from mauvecl.study.sections import SkyLight

#: Start of a stare whose study names no time: 2026-01-01, MJD. Any would do.
NO_TIME_MJD = 61_041


def light_curve_file(one: StarStare, sky: SkyLight, *, seed: int, number: int) -> bytes:
    """Return the FITS file of a star's stare.

    Parameters
    ----------
    sky : SkyLight
        The study's section with position and time.
    number : int
        Number of the stare.
    """
    from astropy.io import fits

    when = sky.time
    first, comment = (NO_TIME_MJD, "arbitrary: no time was named") if when is None else (_mjd(when), "start of stare")
    primary = fits.PrimaryHDU()
    named: tuple[tuple[str, str | float, str], ...] = (
        ("OBJECT", one.label, "star, simulated"),
        ("TELESCOP", "Mauve", "simulated"),
        ("INSTRUME", one.staring.quiet.instrument, ""),
        ("CCD-TEMP", one.staring.quiet.conditions["temperature_c"], "[Celsius] detector, where nothing heats it"),
        ("CREATOR", f"mauvecl {VERSION}", ""),
        ("SEED", str(seed), "of the draws"),
        ("STARENO", number, "number of the stare"),
    )
    for key, value, text in named:
        primary.header[key] = (value, text)
    if sky.target is not None:
        with offline():
            place = parse_position(sky.target).icrs
        primary.header["RADESYS"] = "ICRS"
        primary.header["RA_OBJ"], primary.header["DEC_OBJ"] = (place.ra.deg, "[deg]"), (place.dec.deg, "[deg]")
    hdus = fits.HDUList([primary, _table(one), _intervals(one), *_spectra(one)])
    stare = one.staring.stare
    times: tuple[tuple[str, str | float, str], ...] = (
        ("TIMESYS", "UTC", ""),
        ("TREFPOS", "TOPOCENTER", "at the satellite"),
        ("TIMEPIXR", 0.5, "times are middles of frames"),
        ("MJDREFI", int(first), comment),
        ("MJDREFF", float(first - int(first)), ""),
        ("TIMEUNIT", "d", ""),
        ("TIMEDEL", stare.frame_s / DAY_S, "one frame"),
        ("EXPOSURE", stare.observed_s / DAY_S, "d in frames"),
        ("TSTART", 0.0, ""),
        ("TSTOP", stare.duration_s / DAY_S, ""),
    )
    for hdu in hdus[1:3]:
        for word, number_or_text, text in times:
            hdu.header[word] = (number_or_text, text)
    held = io.BytesIO()
    hdus.writeto(held)
    return held.getvalue()


def _mjd(when: str) -> float:
    return float(parse_time(when).utc.mjd)


def _table(one: StarStare) -> fits.BinTableHDU:
    from astropy.io import fits

    stare, light = one.staring.stare, one.light
    columns: list[tuple[str, str, str | None, Any]] = [
        ("TIME", "D", "d", stare.middle_s / DAY_S),
        ("CADENCENO", "J", None, stare.numbers),
        ("QUALITY", "J", None, one.staring.quality),
    ]
    for k, name in enumerate(light.bands):
        suffix = "" if k == 0 else "_" + name.removesuffix(" nm").replace("-", "_")
        for column, values in (("FLUX", light.flux), ("FLUX_ERR", light.sd), ("MEAN", light.mean)):
            columns.append((column + suffix, "E", "adu/s", values[:, k]))
    if one.pointing_loss is not None:
        columns.append(("POINTING_LOSS", "E", None, one.pointing_loss))
    made = [fits.Column(name=n, format=form, unit=unit, array=values) for n, form, unit, values in columns]
    hdu = fits.BinTableHDU.from_columns(made, name="LIGHTCURVE")
    hdu.header["BANDS"] = ", ".join(light.bands)
    hdu.header["COMMENT"] = "FLUX: star and sky, bias and known dark taken off. MEAN: the same without noise."
    hdu.header["COMMENT"] = "TIME: middle of the frame, days after MJDREF. QUALITY 1: saturated pixels. 0: none."
    if one.pointing_loss is not None:
        lost = int(np.count_nonzero(one.pointing_loss))
        hdu.header["LOSTFRMS"] = (lost, "frames that lost light, assumed drifts")
        hdu.header["COMMENT"] = "POINTING_LOSS: share of all light lost in the frame, as drawn."
    return hdu


def _intervals(one: StarStare) -> fits.BinTableHDU:
    from astropy.io import fits

    start, stop = one.staring.stare.gtis.T / DAY_S
    columns = [fits.Column(name="START", format="D", unit="d", array=start), fits.Column("STOP", "D", "d", array=stop)]
    return fits.BinTableHDU.from_columns(columns, name="GTI")


def _spectra(one: StarStare) -> list[Any]:
    from astropy.io import fits

    light = one.light
    images = []
    for name, values in (("SPECTRUM", light.spectrum), ("SPECTRUM_ERR", light.spectrum_sd)):
        image = fits.ImageHDU(np.asarray(values, np.float32), name=name)
        image.header["BUNIT"] = ("adu/s", "of a resolution element; rows are frames")
        images.append(image)
    column = fits.Column(name="WAVELENGTH", format="D", unit="nm", array=light.element_nm)
    return [*images, fits.BinTableHDU.from_columns([column], name="WAVELENGTH")]
