"""FITS files: sizes, checksums, and the values of columns as the standard defines them."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.files.parsing import parsing
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from astropy.io import fits

#: Bytes of a block (FITS standard 4.0, section 3.1), and largest numbers of cards of a header and of extensions.
BLOCK, MAX_CARDS, MAX_EXTENSIONS = 2880, 100_000, 1000
#: Largest number of bytes after the last extension.
MAX_AFTER = 2**20
WHOLE = "a whole FITS file"
#: astropy's classes of extensions whose headers it cannot interpret.
DAMAGED = ("_ValidHDU", "_NonstandardHDU", "_CorruptedHDU")
#: Bytes that are summed at a time.
PIECE = 2**12 * BLOCK


class Content(Protocol):
    """Bytes, or a file that is read where it is sliced."""

    def __len__(self) -> int:
        """Return the size in bytes."""

    def __getitem__(self, part: slice, /) -> bytes:
        """Return bytes from `part.start` to `part.stop`."""


def check_sizes(content: Content) -> None:
    """Raise InputError for headers whose sizes are impossible or larger than the file.

    astropy's reader would never end for a negative size.
    """
    place = 0
    for number in range(MAX_EXTENSIONS + 1):
        if content[place : place + 8] not in (b"SIMPLE  ", b"XTENSION"):
            if len(content) - place > MAX_AFTER:
                # astropy would search all of it for the end of a header.
                fault = f"has {len(content) - place} bytes after its extension {number - 1}"
                raise InputError(fault, f"at most {MAX_AFTER}", key="file", value=len(content) - place)
            return
        if number == MAX_EXTENSIONS:
            break
        cards: dict[bytes, bytes] = {}
        at = place
        while content[at : at + 8] != b"END     ":
            card = content[at : at + 80]
            if len(card) < 80 or at - place > 80 * MAX_CARDS:
                raise InputError(f"has a header {number} without an end", WHOLE, key="file", value=number)
            cards.setdefault(card[:8].strip(), card[10:].split(b"/")[0].strip())
            at += 80
        start = place + -(-(at + 80 - place) // BLOCK) * BLOCK
        try:
            axes = [int(cards[b"NAXIS%d" % (k + 1)]) for k in range(min(int(cards[b"NAXIS"]), 999))]
            bits, extra, groups = (
                int(cards.get(k, d)) for k, d in ((b"BITPIX", b""), (b"PCOUNT", b"0"), (b"GCOUNT", b"1"))
            )
        except (KeyError, ValueError) as error:
            raise InputError(
                f"has a header {number} whose sizes are not numbers", WHOLE, key="file", value=number
            ) from error
        if axes[:1] == [0] and len(axes) > 1:
            # Random groups.
            axes = axes[1:]
        if min([extra, groups, *axes]) < 0 or abs(bits) > 64:
            raise InputError(f"has a header {number} with impossible sizes", WHOLE, key="file", value=number)
        size = abs(bits) // 8 * groups * (extra + math.prod(axes) if axes else 0)
        if start + size > len(content):
            fault = (
                f"is truncated: its extension {number} should have {size} bytes, of which "
                f"{max(0, len(content) - start)} are present"
            )
            raise InputError(fault, "a whole file", key="file", value=len(content))
        place = start + -(-size // BLOCK) * BLOCK
    raise InputError(f"has more than {MAX_EXTENSIONS} extensions", "fewer", key="file", value=MAX_EXTENSIONS)


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Convert any fault of astropy's reader to InputError, and keep its warnings quiet.

    astropy warns of the headers of old archive files that it can read.
    """
    with parsing(what, WHOLE), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def open_fits(file: IO[bytes], what: str = "", *, check: bool = True) -> fits.HDUList:
    """Open a FITS file after a check of its sizes and checksums; its data are read on access.

    Parameters
    ----------
    what : str
        The file, for messages.
    check : bool
        Whether to verify checksums, for which the whole file is read.
    """
    from astropy.io import fits

    content = FileContent(file)
    try:
        check_sizes(content)
        file.seek(0)
        with reading("it"):
            hdus = fits.open(file, mode="readonly", memmap=False, lazy_load_hdus=False, disable_image_compression=True)
        with reading("it"):
            check_extensions(hdus)
        if check:
            check_sums(hdus, content)
    except InputError as error:
        raise (error.within(what) if what else error) from error
    return hdus


def check_extensions(hdus: Any) -> None:
    """Raise InputError for an extension whose header is damaged, such as a second primary header.

    astropy reads rows by the formats of their columns, also where they do not take NAXIS1 bytes.
    """
    from astropy.io import fits

    for number, hdu in enumerate(hdus):
        if type(hdu).__name__ in DAMAGED or (number > 0 and "SIMPLE" in hdu.header):
            raise InputError(f"has a damaged header in extension {number}", WHOLE, key="file", value=number)
        if not isinstance(hdu, fits.BinTableHDU):
            continue
        names = hdu.columns.names
        if odd := next((name for name in names if name is not None and names.count(name) > 1), None):
            fault = f"has several columns named {odd!r} in extension {number}"
            raise InputError(fault, "another name for each", key="columns", value=odd)
        if None in names:
            fault = f"has a column whose TTYPE{names.index(None) + 1} is empty in extension {number}"
            raise InputError(fault, "a name for each column", key="columns", value=number)
        size = sum(np.dtype(column.format.recformat).itemsize for column in hdu.columns)
        if size != hdu.header["NAXIS1"]:
            fault = f"has rows of {hdu.header['NAXIS1']} bytes in extension {number}, whose columns take {size}"
            raise InputError(fault, WHOLE, key="file", value=number)


class FileContent:
    """Bytes of a file that are read on access."""

    def __init__(self, file: IO[bytes]) -> None:
        self.file = file
        self.size = file.seek(0, io.SEEK_END)

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, part: slice) -> bytes:
        self.file.seek(part.start)
        return self.file.read(part.stop - part.start)


def check_sums(hdus: Any, content: Content) -> None:
    """Raise InputError if DATASUM or CHECKSUM (FITS standard 4.0, section 4.4.2.7) contradict the bytes.

    The sum of all words of a header and its data is zero, as is the complement of zero, with or without DATASUM.
    astropy's check leaves the data out where there is no DATASUM.
    """
    for number, hdu in enumerate(hdus):
        stated = {key: text_at(hdu.header, key) for key in ("DATASUM", "CHECKSUM")}
        if not any(stated.values()):
            continue
        place = hdu.fileinfo()
        header, data = place["hdrLoc"], place["datLoc"]
        data_sum = _sum(content, data, data + place["datSpan"])
        if stated["DATASUM"].isdigit() and int(stated["DATASUM"]) % 0xFFFFFFFF != data_sum % 0xFFFFFFFF:
            raise _damaged("DATASUM", "data are", number)
        # A blank value is that of a sum which is not defined; one of zeros is that before the sum was computed.
        if len(stated["CHECKSUM"]) == 16 and set(stated["CHECKSUM"]) != {"0"}:
            total = data_sum + _sum(content, header, data)
            if total % 0xFFFFFFFF:
                raise _damaged("CHECKSUM", "header or data are", number)


def _damaged(key: str, part: str, number: int) -> InputError:
    return InputError(
        f"differs from its {key} in extension {number}: its {part} damaged or were edited",
        "the file as it was written, or `ignore_checksum=True` after an intended change", key=key, value=number,
    )  # fmt: skip


def _sum(content: Content, start: int, stop: int) -> int:
    """Return the sum of the 32-bit words of a part of a file, with carries; see appendix J of the standard."""
    total = 0
    for place in range(start, stop, PIECE):
        part = content[place : min(place + PIECE, stop)]
        words = np.frombuffer(part + b"\0" * (-len(part) % 4), ">u4")
        total += int(words.sum(dtype=np.uint64))
    while total > 0xFFFFFFFF:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def text_at(header: Any, key: str) -> str:
    """Return a keyword's value as text; empty if it is missing or cannot be parsed."""
    try:
        value = header.get(key, "")
    except Exception:  # unparsable cards
        return ""
    return "" if value is None else str(value).strip()


def column_values(data: Any, column: Any) -> Any:
    """Return a column of a table, masked where it is undefined; bits are numbers.

    TNULL is compared with the stored numbers, before TSCAL and TZERO (standard 4.0, section 7.3.2); astropy compares
    it with the result, and reads zero for it in ASCII tables. Bits (``16X``) are the number that they are in an
    integer, the first being the most significant.
    """
    stored: NDArray[Any] = np.asarray(data.view(np.ndarray)[column.name])
    scale, zero = (
        float(value) if value not in (None, "") else plain for value, plain in ((column.bscale, 1), (column.bzero, 0))
    )
    if (scale, zero) != (1.0, 0.0) and stored.dtype.kind in "iuf":
        # astropy cannot scale integers of 64 bits by fractions.
        values: Any = stored * scale + zero
    else:
        values = data.field(column.name)
    if str(column.format).strip().upper().rstrip("0123456789").endswith("X") and np.ndim(values) == 2:
        weights = 1 << np.arange(values.shape[1] - 1, -1, -1, dtype=np.int64)
        return values.astype(np.int64) @ weights
    if column.null is None or (isinstance(column.null, str) and not column.null.strip()):
        return values
    if stored.dtype.kind in "SU":
        text = np.char.strip(stored.astype(str))
        return (
            np.ma.masked_array(values, text == str(column.null).strip()) if np.shape(values) == text.shape else values
        )
    if stored.dtype.kind not in "iuf" or stored.shape != np.shape(values):
        return values
    try:
        null = float(column.null)
    except (TypeError, ValueError):
        return values
    # Single precision rounds the values but not the mark in the header.
    same = stored == null if stored.dtype.kind in "iu" else np.isclose(stored, null, rtol=1e-6, atol=0.0)
    return np.ma.masked_array(values, same)
