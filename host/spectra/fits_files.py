"""Spectra in FITS: tables of any extension, and one-dimensional images with a linear or logarithmic scale."""

from __future__ import annotations

import io
import math
import re
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.bounded import shortened
from .columns import Columns, numbers
from .tables import columns_of, first_fitting

#: Units of the archives' tables without a word about them: CALSPEC's.
USUAL = ("Angstrom", "erg / (s cm2 Angstrom)")
#: Bytes of a block (FITS standard 4.0, section 3.1); cards of a header and extensions of a file that are read.
BLOCK, MOST_CARDS, MOST_EXTENSIONS = 2880, 100_000, 1000
#: Keywords whose words may speak of air, vacuum, the star's surface or its dust.
_WORDS = ("AIRORVAC", "VACUUM", "WAVEMED", "WAVETYPE", "VACWAVE", "COMMENT", "HISTORY", "DESCRIP")
#: Images that are no fluxes, by their extension's name.
_NO_FLUX = re.compile(r"err|sig|var|ivar|qual|mask|dq|snr|cont|sky|back|wave|lambda", re.IGNORECASE)


def read_fits(content: bytes, name: str, origin: str, asked: Sequence[str]) -> Columns:
    """Two columns of a FITS table, or an image with a scale of wavelengths.

    Raises
    ------
    InputError
        If it is no such file, is cut short, or holds no spectrum or several.
    """
    from astropy.io import fits

    check_sizes(content)
    try:
        # Old archive files carry headers that astropy warns of and reads all the same.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            hdus = fits.open(io.BytesIO(content), memmap=False, lazy_load_hdus=False, disable_image_compression=True)
            with hdus:
                return _read(hdus, name, origin, asked)
    except InputError:
        raise
    except Exception as error:  # truncated and foreign files fail in many ways
        reason = str(error) or type(error).__name__
        raise InputError(f"cannot be read as FITS ({shortened(reason)}), expected a whole FITS file") from error


def check_sizes(content: bytes) -> None:
    """Refuse headers whose sizes are impossible or beyond the file, before anyone believes them.

    A negative size sends astropy's reader back and around for ever.

    Raises
    ------
    InputError
    """
    place = 0
    for number in range(MOST_EXTENSIONS + 1):
        if content[place : place + 8] not in (b"SIMPLE  ", b"XTENSION"):
            return
        if number == MOST_EXTENSIONS:
            break
        cards: dict[bytes, bytes] = {}
        at = place
        while content[at : at + 8] != b"END     ":
            card = content[at : at + 80]
            if len(card) < 80 or at - place > 80 * MOST_CARDS:
                raise InputError(f"has a header {number} without an end, expected a whole FITS file")
            cards.setdefault(card[:8].strip(), card[10:].split(b"/")[0].strip())
            at += 80
        start = place + -(-(at + 80 - place) // BLOCK) * BLOCK
        try:
            axes = [int(cards[b"NAXIS%d" % (k + 1)]) for k in range(min(int(cards[b"NAXIS"]), 999))]
            bits, extra, groups = (
                int(cards.get(k, d)) for k, d in ((b"BITPIX", b""), (b"PCOUNT", b"0"), (b"GCOUNT", b"1"))
            )
        except (KeyError, ValueError) as error:
            raise InputError(f"has a header {number} whose sizes are no numbers, expected a whole FITS file") from error
        if axes[:1] == [0] and len(axes) > 1:
            # Random groups.
            axes = axes[1:]
        if min([extra, groups, *axes]) < 0 or abs(bits) > 64:
            raise InputError(f"has a header {number} with impossible sizes, expected a whole FITS file")
        size = abs(bits) // 8 * groups * (extra + math.prod(axes) if axes else 0)
        if start + size > len(content):
            raise InputError(
                f"is cut short: its extension {number} is to hold {size} bytes, of which "
                f"{max(0, len(content) - start)} are there, expected a whole file"
            )
        place = start + -(-size // BLOCK) * BLOCK
    raise InputError(f"has more than {MOST_EXTENSIONS} extensions, expected fewer")


def _read(hdus: Any, name: str, origin: str, asked: Sequence[str]) -> Columns:
    from astropy.io import fits

    primary = hdus[0].header
    tables, images = [], []
    for place, hdu in enumerate(hdus):
        label = _text(hdu.header, "EXTNAME") or str(place)
        # An extension may be asked for by its name or its number.
        label = str(place) if str(place) in asked else label
        if isinstance(hdu, fits.BinTableHDU | fits.TableHDU):
            tables.append((label, lambda rest, hdu=hdu: _table(hdu, primary, name, origin, rest)))
        elif getattr(hdu, "is_image", False) and hdu.header.get("NAXIS", 0) and not _NO_FLUX.search(label):
            images.append((label, lambda rest, hdu=hdu: _image(hdu, primary, name, origin, rest)))
    if not tables and not images:
        raise InputError("has no table and no image, expected a FITS table with WAVELENGTH and FLUX")
    if not tables:
        return _first(images, asked)
    try:
        return first_fitting(tables, asked)
    except InputError:
        if not images:
            raise
        try:
            return _first(images, asked)
        except InputError:
            pass
        raise


def _first(images: list[tuple[str, Any]], asked: Sequence[str]) -> Columns:
    """Of several images the one named flux, or what all but one are not."""
    flux = [one for one in images if one[0].strip().lower() in ("flux", "sci", "spectrum")]
    return first_fitting(flux if flux and not asked else images, asked)


def _text(header: Any, key: str) -> str:
    """A keyword's value as text, empty where there is none or it cannot be read."""
    try:
        value = header.get(key, "")
        return str(value).strip()
    except Exception:  # unparsable cards
        return ""


def _named(primary: Any, header: Any, name: str) -> str:
    for key in ("TARGNAME", "TARGETID", "OBJECT"):
        for one in (primary, header):
            if title := _text(one, key)[:80]:
                return title
    return name


def _words(primary: Any, header: Any) -> str:
    words = [_text(one, key) for one in ([primary] if primary is header else [primary, header]) for key in _WORDS]
    for one in (primary, header):
        # AIRORVAC = 'air', VACUUM = T
        if _text(one, "AIRORVAC").lower() == "air" or _text(one, "VACUUM") == "False":
            words.append("in air")
        if _text(one, "VACUUM") == "True":
            words.append("vacuum")
    return "\n".join(words)[:100_000]


def _notes(primary: Any, header: Any, origin: str) -> tuple[str, ...]:
    notes = []
    for key in ("DATAQUAL", "OFFSETPX"):
        if value := _text(primary, key) or _text(header, key):
            notes.append(f"{key} = {value[:60]}")
    if "lowlib" in origin.lower():
        notes.append("dereddened and at zero velocity: counts need it reddened again")
    return tuple(notes)


def _table(hdu: Any, primary: Any, name: str, origin: str, asked: Sequence[str]) -> Columns:
    header = hdu.header
    if _text(header, "ZIMAGE") == "True":
        raise InputError("holds a compressed image, expected a table with WAVELENGTH and FLUX")
    names = [str(one) for one in hdu.columns.names]
    given = [(one.unit or "").strip() or None for one in hdu.columns]
    # The whole file's unit stands for the flux where its column has none (SDSS).
    whole = _text(primary, "BUNIT") or _text(header, "BUNIT") or None
    ucds = " ".join(_text(header, f"TUCD{k + 1}") for k in range(len(names)) if _text(header, f"TUCD{k + 1}"))

    def none(place: int) -> Any:
        value = header.get(f"TNULL{place + 1}")
        return value if isinstance(value, int | float) and not isinstance(value, bool) else None

    columns = columns_of(
        names,
        given,
        lambda k: hdu.data.field(names[k]),
        _named(primary, header, name),
        origin,
        asked,
        usual=USUAL,
        words=_words(primary, header) + "\n" + ucds,
        notes=_notes(primary, header, origin),
        none=none,
    )
    if columns.flux_unit is None and whole is not None:
        return Columns(**{**columns.__dict__, "flux_unit": whole})
    return columns


def _image(hdu: Any, primary: Any, name: str, origin: str, asked: Sequence[str]) -> Columns:
    if asked:
        raise InputError(f"no column named {shortened(asked[0])} in an image, expected none")
    header = hdu.header
    shape = [int(header.get(f"NAXIS{k + 1}", 0)) for k in range(int(header["NAXIS"]))]
    if sum(n > 1 for n in shape) != 1 or shape[0] < 2:
        raise InputError(
            f"holds an image of {' x '.join(map(str, shape))} pixels, expected a spectrum of one dimension, or a table"
        )
    flux = np.ravel(hdu.data)
    axis, unit, kind, notes = _axis(header, primary, flux.size)
    flux_unit = _text(header, "BUNIT") or _text(primary, "BUNIT") or None
    words = _words(primary, header) + ("\nair wavelength" if kind == "AWAV" else "\nvacuum" if kind == "WAVE" else "")
    return Columns(
        numbers(axis, "its axis"), numbers(flux, "its image"), _named(primary, header, name), origin, unit, flux_unit,
        USUAL, words=words, notes=(*_notes(primary, header, origin), *notes),
    )  # fmt: skip


def _axis(header: Any, primary: Any, n: int) -> tuple[Any, str | None, str, tuple[str, ...]]:
    """Values of an image's first axis, its unit and what it is."""

    def number(*keys: str) -> float | None:
        for key in keys:
            for one in (header, primary):
                value = one.get(key)
                if isinstance(value, int | float) and not isinstance(value, bool):
                    return float(value)
        return None

    start, step = number("CRVAL1"), number("CD1_1", "CDELT1")
    if start is None or step is None or step == 0:
        raise InputError("has an image without CRVAL1 and CDELT1 or CD1_1, expected the wavelengths of its pixels")
    if number("CDELT1") is not None and number("CD1_1") is None and (scale := number("PC1_1")) is not None:
        step *= scale
    # By the FITS standard a missing CRPIX1 is 0; the archives' spectra without it begin at their first pixel.
    reference = number("CRPIX1")
    pixel = np.arange(1, n + 1) - (1.0 if reference is None else reference)
    kind = (_text(header, "CTYPE1") or _text(primary, "CTYPE1")).upper()
    unit = _text(header, "CUNIT1") or _text(primary, "CUNIT1") or None
    value = start + step * pixel
    flag = number("DC-FLAG")
    name, _, algorithm = kind.partition("-")
    if algorithm.strip("-") not in ("", "LOG", "LAMBDA", "LINEAR") or (
        name not in ("", "WAVE", "AWAV", "FREQ", "ENER", "LINEAR", "LAMBDA", "WAVELENGTH", "LOGLAM", "LOG", "LOG10")
        and not name.startswith(("WAVELEN", "LAM", "ANGSTROM", "ALOG"))
    ):
        raise InputError(f"has an axis of the type {shortened(kind)}, expected linear or logarithmic wavelengths")
    if unit is not None and re.match(r"\s*log|\s*dex", unit, re.IGNORECASE):
        flag, unit = 1, re.sub(r"^\s*(log|dex)\w*[\s(\[]*|[)\]\s]+$", "", unit, flags=re.IGNORECASE) or None
    logarithm = flag == 1 or "LOG" in kind
    if not logarithm:
        if unit is None and start < 10.0 and abs(step) < 0.01:
            raise InputError(
                f"has an axis from {start:g} in steps of {step:g} without a unit or type, expected CTYPE1 and CUNIT1"
            )
        return value, unit, name, ()
    if algorithm == "LOG" and name in ("WAVE", "AWAV", "FREQ", "ENER") and flag != 1 and start > 20.0:
        # Greisen et al. 2006 (A&A 446, 747), equation 5: the value at the reference pixel times an exponential.
        with np.errstate(over="ignore"):
            return start * np.exp(step * pixel / start), unit, name, (f"logarithmic axis {kind}",)
    if not 1.0 < start < 6.0:
        raise InputError(
            f"has a logarithmic axis from {start:g}, expected logarithms to base ten or the form {name}-LOG"
        )
    with np.errstate(over="ignore"):
        return 10.0**value, unit, name, ("wavelengths from logarithms to base ten",)
