"""Rows of spectra in FITS images, and the wavelengths of their pixels."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from mauvecl.host.tables.fits import text_at
from mauvecl.schema.errors import InputError

#: Names of extensions with images that are not fluxes.
_NO_FLUX = re.compile(r"err|sig|var|ivar|qual|mask|dq|snr|cont|sky|back|wave|lambda|lam$", re.IGNORECASE)
_AXIS_NAME = re.compile(r"(?:(.+)_)?(?:WAVELENGTH|WAVE|WAVELEN|LAMBDA|LOGLAM)", re.IGNORECASE)
_FLUX_NAMES = ("FLUX", "SCI", "SPECTRUM", "SPEC")
#: Largest number of rows of a single spectrum with its errors and masks, as in SDSS (spSpec) and LAMOST.
MAX_PLANES = 6


def is_spectrum_image(hdu: Any, label: str) -> bool:
    """Return whether an extension is an image that may contain fluxes."""
    return bool(getattr(hdu, "is_image", False) and hdu.header.get("NAXIS", 0) and not _NO_FLUX.search(label))


def paired_images(hdus: Any) -> list[tuple[str, Any, Any]]:
    """Return pairs of images of wavelengths and fluxes, and the common prefix of their names.

    DESI's B_WAVELENGTH and B_FLUX (https://desidatamodel.readthedocs.io, coadd-SURVEY-PROGRAM-PIXNUM.fits).
    """
    named = {text_at(hdu.header, "EXTNAME").upper(): hdu for hdu in hdus if getattr(hdu, "is_image", False)}
    pairs = []
    for name, hdu in named.items():
        if (match := _AXIS_NAME.fullmatch(name)) is None:
            continue
        arm = match[1] or ""
        fluxes = [named[one] for kind in _FLUX_NAMES if (one := f"{arm}_{kind}".lstrip("_")) in named]
        if len(fluxes) == 1:
            pairs.append((arm, hdu, fluxes[0]))
    return pairs


def is_survey_image(hdu: Any, telescope: str) -> bool:
    """Return whether an image holds one spectrum with its errors and masks, as files of LAMOST and SDSS-I/II do.

    https://dr5.lamost.org/v3/doc/data-production-description and https://classic.sdss.org/dr7/dm/flatFiles/spSpec.html:
    the first row is the flux; the others are its inverse variance or error, wavelengths and masks.
    """
    header = hdu.header
    known = re.match(r"LAMOST|SDSS", telescope, re.IGNORECASE) and "COEFF0" in header
    return bool(known and header.get("NAXIS", 0) == 2 and header.get("NAXIS2", 0) <= MAX_PLANES)


def rows_of(hdu: Any, telescope: str, asked: bool) -> tuple[Any, tuple[str, ...], tuple[str, ...]]:
    """Return the fluxes of an image, the names of its rows if it has several, and a note.

    Of IRAF's bands (`apall`: spectrum, raw, background, sigma) the first is the flux, unless the user asks for a part.
    Raises InputError for an image of more dimensions than rows and wavelengths.
    """
    header = hdu.header
    shape = [int(header.get(f"NAXIS{k + 1}", 0)) for k in range(int(header["NAXIS"]))]
    if sum(n > 1 for n in shape) > 2 or shape[0] < 2:
        fault = f"holds an image of {' x '.join(map(str, shape))} pixels"
        raise InputError(fault, "a spectrum of one dimension, rows of spectra, or a table", key="table", value=shape)
    flux = np.asanyarray(hdu.data).reshape(-1, shape[0])
    if len(flux) == 1:
        return flux[0], (), ()
    if is_survey_image(hdu, telescope):
        return flux[0], (), (f"the first of {len(flux)} rows is its flux",)
    bands = shape[2] if len(shape) > 2 else shape[1]
    if not asked and text_at(header, "BANDID1").lower().startswith("spectrum") and len(flux) == bands:
        return flux[0], (), (f"the first of {bands} bands (BANDID1) is its flux",)
    return flux, tuple(text_at(header, f"BANDID{k + 1}") for k in range(len(flux))), ()


def axis_of(header: Any, primary: Any, n: int) -> tuple[Any, str | None, str, tuple[str, ...]]:
    """Return the values of an image's first axis, their unit, their kind (WAVE, AWAV, ...) and notes."""

    def number(*keys: str) -> float | None:
        for key in keys:
            for one in (header, primary):
                value = one.get(key)
                if isinstance(value, int | float) and not isinstance(value, bool):
                    return float(value)
        return None

    first, slope = number("COEFF0"), number("COEFF1")
    if first is not None and slope is not None and 1.0 < first < 6.0:
        return 10.0 ** (first + slope * np.arange(n)), "Angstrom", "", ("wavelengths from COEFF0 and COEFF1",)
    start, step = number("CRVAL1"), number("CD1_1", "CDELT1")
    if start is None or step is None or step == 0:
        raise InputError(
            "has an image without CRVAL1 and CDELT1 or CD1_1", "the wavelengths of its pixels", key="CRVAL1"
        )
    if number("CDELT1") is not None and number("CD1_1") is None and (scale := number("PC1_1")) is not None:
        step *= scale
    # A missing CRPIX1 is 0 by the FITS standard, but archives' spectra without it start at their first pixel.
    reference = number("CRPIX1")
    pixel = np.arange(1, n + 1) - (1.0 if reference is None else reference)
    kind = (text_at(header, "CTYPE1") or text_at(primary, "CTYPE1")).upper()
    unit = text_at(header, "CUNIT1") or text_at(primary, "CUNIT1") or None
    value = start + step * pixel
    name, _, algorithm = kind.partition("-")
    if algorithm.strip("-") not in ("", "LOG", "LAMBDA", "LINEAR") or (
        name not in ("", "WAVE", "AWAV", "FREQ", "ENER", "LINEAR", "LAMBDA", "WAVELENGTH", "LOGLAM", "LOG", "LOG10")
        and not name.startswith(("WAVELEN", "LAM", "ANGSTROM", "ALOG"))
    ):
        raise InputError.of("CTYPE1", kind, "linear or logarithmic wavelengths")
    flag = number("DC-FLAG")
    if unit is not None and re.match(r"\s*log|\s*dex", unit, re.IGNORECASE):
        flag, unit = 1, re.sub(r"^\s*(log|dex)\w*[\s(\[]*|[)\]\s]+$", "", unit, flags=re.IGNORECASE) or None
    if flag != 1 and "LOG" not in kind:
        if unit is None and start < 10.0 and abs(step) < 0.01:
            fault = f"has an axis from {start:g} in steps of {step:g} without a unit or type"
            raise InputError(fault, "CTYPE1 and CUNIT1", key="CUNIT1", value=(start, step))
        return value, unit, name, ()
    if algorithm == "LOG" and name in ("WAVE", "AWAV", "FREQ", "ENER") and flag != 1 and start > 20.0:
        # Greisen et al. 2006 (A&A 446, 747), equation 5: the value at the reference pixel times an exponential.
        with np.errstate(over="ignore"):
            return start * np.exp(step * pixel / start), unit, name, (f"logarithmic axis {kind}",)
    if not 1.0 < start < 6.0:
        fault = f"has a logarithmic axis from {start:g}"
        raise InputError(fault, f"logarithms to base ten or the form {name}-LOG", key="CTYPE1", value=start)
    with np.errstate(over="ignore"):
        return 10.0**value, unit, name, ("wavelengths from logarithms to base ten",)
