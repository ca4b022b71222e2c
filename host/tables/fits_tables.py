"""FITS files: their headers, tables and images."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from functools import partial
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.tables import table
from mauvecl.host.tables.files import check_content, limit_bytes, reading
from mauvecl.host.tables.names import match_name, text_at
from mauvecl.host.tables.table import TableFile, Values, as_one_array, dates_in, number_in
from mauvecl.host.tables.units import SCALES
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from astropy.io import fits

#: Bytes of a block (FITS standard 4.0, section 3.1).
BLOCK = 2880
#: Largest numbers of cards of a header, of extensions and of columns (section 7.2.1).
MAX_CARDS, MAX_EXTENSIONS, MAX_FIELDS = 100_000, 1000, 999
#: Largest number of bytes after the last extension.
MAX_AFTER = 2**20
WHOLE = "give a whole FITS file"
#: Bytes that are summed at a time.
PIECE = 2**12 * BLOCK


def check_sizes(file: IO[bytes]) -> None:
    """Raise InputError for headers whose sizes are impossible or larger than the file."""
    place, length = 0, file.seek(0, io.SEEK_END)
    for number in range(MAX_EXTENSIONS + 1):
        if _bytes_at(file, place, place + 8) not in (b"SIMPLE  ", b"XTENSION"):
            if length - place > MAX_AFTER:
                # astropy would search all of it for the end of a header.
                fault = f"it has {length - place} bytes after its extension {number - 1}"
                raise InputError(f"{fault}, but may have at most {MAX_AFTER}", key="file")
            return
        cards: dict[bytes, bytes] = {}
        at = place
        while (card := _bytes_at(file, at, at + 80))[:8] != b"END     ":
            if len(card) < 80 or at - place > 80 * MAX_CARDS:
                raise InputError(f"its header {number} has no end; {WHOLE}", key="file")
            cards.setdefault(card[:8].strip(), card[10:].split(b"/")[0].strip())
            at += 80
        start = place + -(-(at + 80 - place) // BLOCK) * BLOCK
        try:
            axes = [int(cards[b"NAXIS%d" % (k + 1)]) for k in range(min(int(cards[b"NAXIS"]), 999))]
            bits, extra, groups, fields = (
                int(cards.get(k, d))
                for k, d in ((b"BITPIX", b""), (b"PCOUNT", b"0"), (b"GCOUNT", b"1"), (b"TFIELDS", b"0"))
            )
        except (KeyError, ValueError) as error:
            raise InputError(f"its header {number} has sizes that are not numbers; {WHOLE}", key="file") from error
        if axes[:1] == [0] and len(axes) > 1:
            # Random groups.
            axes = axes[1:]
        # astropy's reader would never end for a negative size.
        if min([extra, groups, *axes]) < 0 or abs(bits) > 64 or not 0 <= fields <= MAX_FIELDS:
            raise InputError(f"its header {number} has impossible sizes; {WHOLE}", key="file")
        size = abs(bits) // 8 * groups * (extra + math.prod(axes) if axes else 0)
        if start + size > length:
            present = max(0, length - start)
            fault = f"it is truncated: its extension {number} must have {size} bytes, of which {present} are present"
            raise InputError(fault, key="file")
        place = start + -(-size // BLOCK) * BLOCK
    raise InputError(f"it must have at most {MAX_EXTENSIONS} extensions", key="file")


def open_fits(file: IO[bytes], label: str = "", *, check: bool = True) -> fits.HDUList:
    """Open a FITS file after a check of its sizes and checksums; its data are read on access.

    To `check` the checksums, the whole file is read. Messages name the file by its label.
    """
    from astropy.io import fits

    options: dict[str, Any] = {"mode": "readonly", "memmap": False, "lazy_load_hdus": False}
    try:
        with reading("it", WHOLE):
            check_sizes(file)
            file.seek(0)
            hdus = fits.open(file, **options, disable_image_compression=True)
            check_extensions(hdus)
            if check:
                check_sums(hdus, file)
            if packed := [hdu for hdu in hdus if text_at(hdu.header, "ZIMAGE") == "True"]:
                check_images(packed)
                file.seek(0)
                hdus = fits.open(file, **options)
    except InputError as error:
        raise (error.within(label) if label else error) from error
    return hdus


def check_extensions(hdus: Any) -> None:
    """Raise InputError for an extension whose header is damaged, such as a second primary header."""
    from astropy.io import fits

    for number, hdu in enumerate(hdus):
        # astropy's classes of extensions whose headers it cannot interpret.
        is_damaged = type(hdu).__name__ in ("_ValidHDU", "_NonstandardHDU", "_CorruptedHDU")
        if is_damaged or (number > 0 and "SIMPLE" in hdu.header):
            raise InputError(f"its extension {number} has a damaged header; {WHOLE}", key="file")
        if not isinstance(hdu, fits.BinTableHDU):
            continue
        if text_at(hdu.header, "ZTABLE") == "True":
            fault = f"its extension {number} has a table compressed by `fpack`; use the file after `funpack`"
            raise InputError(fault, key="file")
        names = hdu.columns.names
        if (odd := next((name for name in names if name is None or names.count(name) > 1), "")) != "":
            fault = f"an empty TTYPE{names.index(None) + 1}" if odd is None else f"several columns named {odd!r}"
            raise InputError(f"its extension {number} has {fault}; give each column a name of its own", key="columns")
        # astropy reads rows by the formats of their columns alone.
        size = sum(np.dtype(column.format.recformat).itemsize for column in hdu.columns)
        if size != hdu.header["NAXIS1"]:
            fault = f"its extension {number} has rows of {hdu.header['NAXIS1']} bytes, whose columns take {size}"
            raise InputError(f"{fault}; {WHOLE}", key="file")


def check_images(packed: Sequence[Any]) -> None:
    """Raise InputError for images in compressed tiles (standard 4.0, section 10.1) that are large or damaged."""
    for hdu in packed:
        header = hdu.header
        axes = [int(header[f"ZNAXIS{k + 1}"]) for k in range(int(header["ZNAXIS"]))]
        tiles = [int(header.get(f"ZTILE{k + 1}", axes[0] if k == 0 else 1)) for k in range(len(axes))]
        size = abs(int(header["ZBITPIX"])) // 8 * max(math.prod(axes), math.prod(tiles))
        if min(*axes, *tiles) < 1:
            fault = f"it has a compressed image of {axes} pixels in tiles of {tiles}; {WHOLE}"
            raise InputError(fault, key="file")
        check_content(size, "its compressed image must unpack to at most")


def _bytes_at(file: IO[bytes], start: int, stop: int) -> bytes:
    file.seek(start)
    return file.read(stop - start)


def check_sums(hdus: Any, file: IO[bytes]) -> None:
    """Raise InputError if DATASUM or CHECKSUM (FITS standard 4.0, section 4.4.2.7) contradict the bytes.

    In the standard's arithmetic the words of a header with CHECKSUM and of its data add up to zero, with or without
    DATASUM. astropy's check leaves the data out if there is no DATASUM.
    """
    for number, hdu in enumerate(hdus):
        keywords = {key: text_at(hdu.header, key) for key in ("DATASUM", "CHECKSUM")}
        if not any(keywords.values()):
            continue
        place = hdu.fileinfo()
        header, data = place["hdrLoc"], place["datLoc"]
        data_sum, key = _sum(file, data, data + place["datSpan"]), ""
        if keywords["DATASUM"].isdigit() and (int(keywords["DATASUM"]) - data_sum) % 0xFFFFFFFF:
            key = "DATASUM"
        # A blank value means that the sum is not defined, and zeros that it has not been computed yet.
        elif len(keywords["CHECKSUM"]) == 16 and set(keywords["CHECKSUM"]) != {"0"}:
            key = "CHECKSUM" if (data_sum + _sum(file, header, data)) % 0xFFFFFFFF else ""
        if key:
            fault = f"it differs from its {key} in extension {number}: it is damaged or was edited"
            remedy = "use the file as it was written, or `ignore_checksum=True` after an intended change"
            raise InputError(f"{fault}; {remedy}", key=key)


def _sum(file: IO[bytes], start: int, stop: int) -> int:
    """Return the sum of the 32-bit words of a part of a file, without the carries that appendix J adds back to it."""
    total = 0
    for place in range(start, stop, PIECE):
        words = _bytes_at(file, place, min(place + PIECE, stop))
        total += int(np.frombuffer(words + b"\0" * (-len(words) % 4), ">u4").sum(dtype=np.uint64))
    return total


#: Keywords of the units of wavelengths and of fluxes: of the standard, of Spextool, and of others.
WAVE_UNITS, FLUX_UNITS = ("CUNIT1", "XUNITS", "WAVEUNIT"), ("BUNIT", "YUNITS", "FLUXUNIT")


def unit_at(keys: Sequence[str], *headers: Any) -> str:
    """Return the unit that the first of some keywords states; empty if none does."""
    unit = next((text for key in keys for header in headers if (text := text_at(header, key))), "")
    # APOGEE: Flux (10^-17 erg/s/cm^2/Ang).
    return re.sub(r"(?i)^flux(?: density)?\s*\((.*)\)$", r"\1", unit)


def column_values(data: Any, column: Any) -> Any:
    """Return a column of a table, masked where it is undefined; bits are numbers.

    TNULL is compared with the stored numbers, before TSCAL and TZERO (standard 4.0, section 7.3.2); astropy compares
    it with the result, and reads zero for it in ASCII tables. Bits (``16X``) are the number that they are in an
    integer, the first being the most significant.
    """
    stored: NDArray[Any] = np.asarray(data.view(np.ndarray)[column.name])
    kind, null = stored.dtype.kind, "" if column.null is None else str(column.null).strip()
    scale, zero = float(column.bscale or 1.0), float(column.bzero or 0.0)
    # Unsigned integers keep all digits; others of 64 bits cannot be scaled by astropy.
    if (scale, zero) not in ((1.0, 0.0), (1.0, 2.0 ** (8 * stored.dtype.itemsize - 1))) and kind in "iuf":
        values: Any = stored * scale + zero
    else:
        values = data.field(column.name)
    if str(column.format).strip().upper().rstrip("0123456789").endswith("X") and np.ndim(values) == 2:
        weights = 1 << np.arange(values.shape[1] - 1, -1, -1, dtype=np.int64)
        return values.astype(np.int64) @ weights
    if not null or kind not in "SUiuf" or stored.shape != np.shape(values):
        return values
    if kind in "SU":
        return np.ma.masked_array(values, np.char.strip(stored.astype(str)) == null)
    # Single precision rounds the values but not the mark in the header.
    same = np.isclose(stored, number_in(null), rtol=1e-6 if kind == "f" else 0.0, atol=0.0)
    return np.ma.masked_array(values, same)


#: Names of axes by their type, which say the medium.
_AXIS_NAMES = {"AWAV": "air wavelength", "WAVE": "vacuum wavelength"}


def _number_at(headers: Sequence[Any], *keys: str) -> float | None:
    """Return the first number under one of the keys, of which each header is searched in turn; None without one."""
    for header in headers:
        for key in keys:
            value = header.get(key)
            if isinstance(value, int | float) and not isinstance(value, bool):
                return float(value)
    return None


#: Types of axes that are wavelengths, or frequencies and energies that become them, and beginnings of others.
AXIS_TYPES = ("", "WAVE", "AWAV", "FREQ", "ENER", "LINEAR", "LAMBDA", "WAVELENGTH", "LOGLAM", "LOG", "LOG10")
AXIS_BEGINNINGS = ("WAVELEN", "LAM", "ANGSTROM", "ALOG")


def axis_of(header: Any, primary: Any) -> tuple[Any, str | None, str, tuple[str, ...]]:
    """Return the values of an image's first axis, their unit, their kind (WAVE, AWAV, ...) and notes."""
    # The axis of the primary's own image is not that of an extension.
    primary = header if "CRVAL1" in header and "CRVAL1" in primary else primary
    number, n = partial(_number_at, (header, primary)), int(header["NAXIS1"])
    first, slope = number("COEFF0"), number("COEFF1")
    if first is not None and slope is not None and 1.0 < first < 6.0:
        return 10.0 ** (first + slope * np.arange(n)), "Angstrom", "", ("wavelengths from COEFF0 and COEFF1",)
    start, step = number("CRVAL1"), number("CD1_1", "CDELT1")
    if start is None or step is None or step == 0:
        raise InputError("its image needs wavelengths of its pixels: CRVAL1, and CDELT1 or CD1_1", key="CRVAL1")
    step *= number("PC1_1") or 1.0 if number("CD1_1") is None else 1.0
    # A missing CRPIX1 is 0 by the FITS standard, but archives' spectra without it start at their first pixel.
    reference = number("CRPIX1")
    pixel = np.arange(1, n + 1) - (1.0 if reference is None else reference)
    kind = (text_at(header, "CTYPE1") or text_at(primary, "CTYPE1")).upper()
    unit = unit_at(WAVE_UNITS, header, primary) or _iraf_unit(header) or None
    value = start + step * pixel
    name, _, algorithm = kind.partition("-")
    is_known = name in AXIS_TYPES or name.startswith(AXIS_BEGINNINGS)
    if algorithm.strip("-") not in ("", "LOG", "LAMBDA", "LINEAR", "WAV") or not is_known:
        raise InputError.of("CTYPE1", kind, "linear or logarithmic wavelengths")
    flag = number("DC-FLAG")
    if unit is not None and re.match(r"\s*log|\s*dex", unit, re.IGNORECASE):
        flag, unit = 1, re.sub(r"^\s*(log|dex)\w*[\s(\[]*|[)\]\s]+$", "", unit, flags=re.IGNORECASE) or None
    if flag != 1 and "LOG" not in kind:
        if unit is None and start < 10.0 and abs(step) < 0.01:
            fault = f"its axis from {start:g} in steps of {step:g} has no unit or type; give CTYPE1 and CUNIT1"
            raise InputError(fault, key="CUNIT1")
        return value, unit, name, ()
    if algorithm == "LOG" and name in ("WAVE", "AWAV", "FREQ", "ENER") and flag != 1 and not 1.0 < start <= 20.0:
        # Greisen et al. 2006 (A&A 446, 747), equation 5: the value at the reference pixel times an exponential.
        with np.errstate(over="ignore"):
            return start * np.exp(step * pixel / start), unit, name, (f"logarithmic axis {kind}",)
    if algorithm == "LOG" and flag != 1 and 6.0 <= start < 12.0:
        # PHOENIX's library at medium resolution (Husser et al. 2013) has natural logarithms of Angstrom.
        return np.exp(value), unit, name, ("wavelengths from natural logarithms",)
    if not 1.0 < start < 6.0:
        fault = f"its logarithmic axis from {start:g} must have logarithms to base ten or the form {name}-LOG"
        raise InputError(fault, key="CTYPE1")
    with np.errstate(over="ignore"):
        return 10.0**value, unit, name, ("wavelengths from logarithms to base ten",)


def multispec_axis(header: Any) -> Values:
    """Return the wavelengths of each row of an image of IRAF's multispec system; raise InputError if they are curved.

    An attribute has aperture, beam, type (0 linear, 1 logarithmic), first wavelength, step, number of pixels and
    redshift (https://iraf.net/irafdocs/specwcs.php).
    """
    rows = []
    for text in re.findall(r"spec\d+\s*=\s*\"([^\"]*)\"", _attributes(header, 2)):
        _, _, kind, first, step, _, redshift = map(float, text.split()[:7])
        if kind not in (0.0, 1.0):
            fault = f"its wavelengths of the type {kind:g} in IRAF's multispec system must be linear or logarithmic"
            raise InputError(f"{fault}, as IRAF's `dispcor` makes them", key="CTYPE1")
        values = first + step * np.arange(int(header["NAXIS1"]))
        rows.append((10.0**values if kind else values) / (1.0 + redshift))
    if len(rows) != int(header.get("NAXIS2", 1)):
        raise InputError(f"its attributes WAT2 must describe each row, but describe {len(rows)}", key="CTYPE1")
    return Values.of("wavelength", np.array(rows) if len(rows) > 1 else rows[0], _iraf_unit(header))


def _attributes(header: Any, axis: int) -> str:
    """Return IRAF's attributes of an axis, whose cards have 68 characters each with blanks at their ends."""
    keys = [key for key in sorted(header) if re.fullmatch(rf"WAT{axis}_\d{{3}}", key)]
    return "".join(str(header[key]).ljust(68) for key in keys)


def _iraf_unit(header: Any) -> str:
    """Return the unit of the first axis in IRAF's attributes, as in ``wtype=linear units=Angstroms``."""
    match = re.search(r"\bunits=(?:\"([^\"]*)\"|(\S+))", _attributes(header, 1))
    return "" if match is None else match[1] or match[2]


def _times(header: Any, number: int) -> tuple[bool, dict[str, Any]]:
    """Return whether a column has Julian dates in two parts, as astropy writes times, and its keywords of times."""
    # The scale and the place of a column (standard 4.0, section 9.2).
    scale, place = (text_at(header, f"{key}{number}") for key in ("TCTYP", "TRPOS"))
    if scale.lower() not in SCALES.values():
        return False, {}
    is_pair = text_at(header, f"TFORM{number}") == "2D"
    keywords = dates_in(scale) if is_pair else {"TIMESYS": scale.upper()}
    return is_pair, keywords | ({"TREFPOS": place} if place else {})


class FitsTables(TableFile):
    """An open FITS file.

    The columns of an extension, by its name or number, are searched first; by default those of the first table with a
    column of each of the `groups` of names, or else of the first table. Next to an extension that has no columns, such
    as an image, only images and ``EXTENSION/COLUMN`` are found.
    """

    def __init__(
        self, hdus: fits.HDUList, label: str, name: str | None = None, groups: Sequence[Sequence[str]] = ()
    ) -> None:
        self.hdus = hdus
        self.tables = [k for k, hdu in enumerate(hdus) if hasattr(hdu, "columns") and not hdu.is_image]
        self.images = [k for k, hdu in enumerate(hdus) if hdu.is_image and hdu.header.get("NAXIS")]
        titles = {k: [str(title) for title in hdus[k].columns.names] for k in self.tables}
        lower = {k: {title.lower() for title in titles[k]} for k in self.tables}
        fitting = [k for k in self.tables if all(lower[k] & {title.lower() for title in group} for group in groups)]
        at = None if name is None else self._number(name)
        if name is not None and at is None:
            extensions = ", ".join(map(self._label, self.tables or range(len(hdus))))
            raise InputError.of("hdu", name, f"one of {extensions}", where=label)
        #: Name of an extension without columns that is chosen instead of a table; empty for others.
        self.columnless = "" if name is None or at in self.tables or not self.tables else name
        by_default = None if self.columnless else next(iter(fitting or self.tables), None)
        self.chosen = at if at in self.tables else by_default
        header: dict[str, Any] = {}
        for number in (0, at, self.chosen):
            header |= {} if number is None else dict(hdus[number].header)
        columns = [] if self.chosen is None else titles[self.chosen]
        elsewhere = [f"{self._label(k)}/{title}" for k in self.tables if k != self.chosen for title in titles[k]]
        super().__init__(label, header, [*columns, *map(self._label, self.images), *elsewhere], columns=columns)

    def named(self, name: str) -> Values | None:
        """Return a column of the chosen table, an image, ``EXTENSION/COLUMN``, or a column of one other table."""
        if self.chosen is not None and (values := self.column(self.chosen, name)) is not None:
            return values
        at = self._number(name)
        if at in self.images:
            return self.image(at)
        extension, _, column = name.partition("/")
        if column and (number := self._number(extension)) in self.tables:
            return self.column(number, column)
        columns = [values for k in self.tables if (values := self.column(k, name)) is not None]
        if columns:
            self.check_choice()
        if len(columns) > 1:
            fault = f"{self.label} has {len(columns)} columns called {name!r}"
            raise InputError(f"{fault}; give EXTENSION/COLUMN", key=name)
        return columns[0] if columns else None

    def check_choice(self) -> None:
        """Raise InputError if the chosen extension has no columns, although others have."""
        if self.columnless:
            expected = f"an extension with a table ({', '.join(map(self._label, self.tables))})"
            raise InputError.of("hdu", self.columnless, expected, where=self.label)

    def axis(self, name: str, dimension: int) -> Values:
        """Return the coordinates along an axis of an image, dimension 1 being that of pixels."""
        at = self._number(name)
        if at not in self.images:
            raise InputError.of("flux", name, "an image, whose header has the coordinates", where=self.label)
        if dimension == 1:
            try:
                return self.wavelengths(at)[0]
            except InputError as error:
                raise error.within(self.label) from error
        header = self.hdus[at].header
        first, step, reference = (_number_at([header], f"{key}2") for key in ("CRVAL", "CDELT", "CRPIX"))
        if first is None or step is None or reference is None:
            fault = f"{self.label}: the image {name!r} needs the times of its rows: CRVAL2, CDELT2 and CRPIX2"
            raise InputError(fault, key="time")
        times = first + step * (np.arange(1, int(header["NAXIS2"]) + 1) - reference)
        return Values.of(name, times, header.get("CUNIT2"), self.label)

    def wavelengths(self, number: int) -> tuple[Values, tuple[str, ...]]:
        """Return the wavelengths of the pixels of an image, whose name may say their medium, and notes."""
        header, notes = self.hdus[number].header, tuple[str, ...]()
        kind = text_at(header, "CTYPE1").upper()
        if kind.startswith("MULTISPE"):
            return multispec_axis(header), ()
        if kind.endswith("-TAB"):
            # The axis refers to the column of a table (FITS standard 4.0, section 8.3).
            axis = self.named(f"{text_at(header, 'PS1_0')}/{text_at(header, 'PS1_1')}")
            if axis is None:
                fault = "it lacks the table of its wavelengths: it needs the column that PS1_0 and PS1_1 name"
                raise InputError(fault, key="wavelength")
            kind, values, unit = kind[:4], axis.numbers().ravel(), axis.unit or header.get("CUNIT1")
        else:
            values, unit, kind, notes = axis_of(header, self.hdus[0].header)
        return Values.of(_AXIS_NAMES.get(kind, "wavelength"), values, unit, self.label), notes

    def _label(self, number: int) -> str:
        return str(self.hdus[number].name) or str(number)

    def _number(self, name: str) -> int | None:
        """Return the number of an extension by its name or number."""
        labels = [str(hdu.name).upper() for hdu in self.hdus]
        if name.upper() in labels and name:
            return labels.index(name.upper())
        return int(name) if name.isascii() and name.isdigit() and int(name[:6]) < len(self.hdus) else None

    def image(self, number: int) -> Values:
        """Return the image of an extension."""
        hdu = self.hdus[number]
        shape = tuple(hdu.shape)

        def read(piece: slice) -> Any:
            with reading(self.label, WHOLE):
                return hdu.section[piece]

        return Values(self._label(number), shape, read, text_at(hdu.header, "BUNIT"), self.label)

    def column(self, number: int, name: str) -> Values | None:
        """Return a column of the table in an extension, or None."""
        hdu = self.hdus[number]
        title = match_name(name, map(str, hdu.columns.names), self.label)
        if title is None:
            return None
        column = hdu.columns[title]
        n_rows = int(hdu.header["NAXIS2"])
        heap = int(hdu.header.get("PCOUNT", 0))
        size = int(hdu.header["NAXIS1"]) * n_rows + heap
        # Tables of text, and columns of variable length, cannot be read in pieces.
        is_whole = heap > 0 or hdu.header.get("XTENSION") == "TABLE"
        small = size <= table.PIECE_BYTES or is_whole
        if is_whole and size > limit_bytes("MAUVECL_LARGEST_FILE_MIB"):
            fault = f"{self.label}: the table {self._label(number)} has text or columns of variable length"
            raise InputError(f"{fault} and {size >> 20} MiB; use columns of fixed length", key="hdu")
        place = hdu.columns.names.index(column.name) + 1
        is_pair, keywords = _times(hdu.header, place)

        def read(piece: slice) -> Any:
            with reading(self.label, WHOLE):
                values = column_values(hdu.data[piece] if small else _rows(hdu, piece), column)
            return (values[:, 0] - 2_400_000.5) + values[:, 1] if is_pair else values

        ucd, unit = text_at(hdu.header, f"TUCD{place}"), str(column.unit or "").strip()
        if column.format.format in ("P", "Q"):
            with reading(self.label, WHOLE):
                return Values.of(column.name, as_one_array(_arrays(hdu, place)), unit, self.label, ucd)
        row_shape = np.shape(read(slice(0, min(1, n_rows))))
        width = 0 if small else 2 * int(hdu.header["NAXIS1"])
        return Values(column.name, (n_rows, *row_shape[1:]), read, unit, self.label, width, ucd, keywords=keywords)


def _arrays(hdu: Any, number: int) -> Any:
    """Return the arrays of variable length of a column; astropy keeps scaled integers as integers and ignores TNULL."""
    from astropy.io import fits

    header, place = hdu.header.copy(), hdu.fileinfo()
    scale, zero, null = (header.pop(f"{key}{number}", None) for key in ("TSCAL", "TZERO", "TNULL"))
    if scale is zero is null is None:
        return hdu.data.field(number - 1)
    place["file"].seek(place["datLoc"])
    raw = fits.BinTableHDU.fromstring(header.tostring().encode() + place["file"].read(place["datSpan"])).data
    marked = (row if null is None else np.ma.masked_equal(row, null) for row in raw.field(number - 1))
    return np.fromiter((row * float(scale or 1) + float(zero or 0) for row in marked), object)


def _rows(hdu: Any, piece: slice) -> Any:
    """Read some rows of a table."""
    from astropy.io import fits

    place, width, n = hdu.fileinfo(), int(hdu.header["NAXIS1"]), piece.stop - piece.start
    place["file"].seek(place["datLoc"] + piece.start * width)
    raw = place["file"].read(n * width)
    header = hdu.header.copy()
    header["NAXIS2"] = n
    return fits.BinTableHDU.fromstring(header.tostring().encode() + raw + b"\0" * (-len(raw) % BLOCK)).data
