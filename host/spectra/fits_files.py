"""Reader of spectra in FITS files: binary and ASCII tables, and images."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from mauvecl.schema.errors import InputError

from ..files.parsing import parsing
from .column_roles import role_of
from .file_table import Column, FileTable
from .fits_images import axis_of, is_spectrum_image, paired_images, rows_of

#: Units implied by the archives' tables, those of CALSPEC.
IMPLIED_UNITS = ("Angstrom", "erg / (s cm2 Angstrom)")
#: Bytes of a block (FITS standard 4.0, section 3.1), and largest numbers of cards of a header and of extensions.
BLOCK, MAX_CARDS, MAX_EXTENSIONS = 2880, 100_000, 1000
#: Largest number of bytes after the last extension.
MAX_AFTER = 2**20
#: Keywords whose text may mention air, vacuum, the star's surface or its dust.
_REMARKS = ("AIRORVAC", "VACUUM", "WAVEMED", "WAVETYPE", "VACWAVE", "COMMENT", "HISTORY", "DESCRIP")
WHOLE = "a whole FITS file"


def fits_tables(content: bytes, name: str, origin: str, asked: Sequence[str]) -> list[FileTable]:
    """Read the tables of a FITS file, including images of spectra.

    Raises InputError if the content is not FITS, is truncated, contradicts its checksums, or has no tables or images.
    """
    from astropy.io import fits

    check_sizes(content)
    with parsing("it", WHOLE), warnings.catch_warnings():
        # astropy warns of the headers of old archive files that it can read.
        warnings.simplefilter("ignore")
        hdus = fits.open(io.BytesIO(content), memmap=False, lazy_load_hdus=False, disable_image_compression=True)
        check_extensions(hdus)
        check_sums(hdus)
        return _Reader(hdus, name, origin, asked).tables()


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
            raise InputError(
                f"is truncated: its extension {number} should have {size} bytes, of which "
                f"{max(0, len(content) - start)} are present",
                "a whole file",
                key="file",
                value=len(content),
            )
        place = start + -(-size // BLOCK) * BLOCK
    raise InputError(f"has more than {MAX_EXTENSIONS} extensions", "fewer", key="file", value=MAX_EXTENSIONS)


#: astropy's classes of extensions whose headers it cannot interpret.
DAMAGED = ("_ValidHDU", "_NonstandardHDU", "_CorruptedHDU")


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
            raise InputError(
                f"has a column whose TTYPE{names.index(None) + 1} is empty in extension {number}",
                "a name for each column",
                key="columns",
                value=number,
            )
        size = sum(np.dtype(column.format.recformat).itemsize for column in hdu.columns)
        if size != hdu.header["NAXIS1"]:
            raise InputError(
                f"has rows of {hdu.header['NAXIS1']} bytes in extension {number}, whose columns take {size}",
                WHOLE,
                key="file",
                value=number,
            )


def check_sums(hdus: Any) -> None:
    """Raise InputError if DATASUM or CHECKSUM (FITS standard 4.0, section 4.4.2.7) contradict the content."""
    for number, hdu in enumerate(hdus):
        for key, verify in (("DATASUM", hdu.verify_datasum), ("CHECKSUM", hdu.verify_checksum)):
            if hdu.header.get(key) not in (None, "") and verify() == 0:
                part = "data" if key == "DATASUM" else "header or data"
                raise InputError(
                    f"differs from its {key} in extension {number}: its {part} are damaged or were edited",
                    "the file as it was written; after an intended change, remove the keyword",
                    key=key,
                    value=number,
                )


class _Reader:
    """Reader of the extensions of an open file."""

    def __init__(self, hdus: Any, name: str, origin: str, asked: Sequence[str]) -> None:
        self.hdus, self.name, self.origin, self.asked = hdus, name, origin, asked
        self.primary = hdus[0].header

    def tables(self) -> list[FileTable]:
        from astropy.io import fits

        pairs = paired_images(self.hdus)
        if pairs:
            rows = self._row_names()
            return [self._of_pair(*pair, rows) for pair in pairs]
        tables = [
            self._of_table(number, hdu)
            for number, hdu in enumerate(self.hdus)
            if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)
        ]
        kinds = [{role_of(c.name, c.unit, c.ucd).kind for c in table.columns} for table in tables]
        if any("flux" in kind and kind & {"wavelength", "lower edge"} for kind in kinds):
            return tables
        images, errors = self._images()
        if errors and not tables and not images:
            raise errors[0]
        if not tables and not images:
            raise InputError("has no table and no image", "a FITS table with WAVELENGTH and FLUX", key="table")
        return [*tables, *images]

    def _label(self, number: int, hdu: Any) -> str:
        """Return the name by which users select an extension: its number if requested, else its name."""
        return str(number) if str(number) in self.asked else text_at(hdu.header, "EXTNAME") or str(number)

    def _table(self, header: Any, columns: Sequence[Column], label: str, **more: Any) -> FileTable:
        is_relative = text_at(self.primary, "TELESCOP").upper().startswith("LAMOST")
        return FileTable(
            columns,
            next((t for key in ("TARGNAME", "TARGETID", "OBJECT") for one in (self.primary, header)
                  if (t := text_at(one, key)[:80])), self.name),
            self.origin,
            label,
            IMPLIED_UNITS,
            remarks=self._remarks(header) + more.pop("remarks", ""),
            notes=(*self._notes(header), *more.pop("notes", ())),
            # LAMOST DR5, "Data production description", section 1: fluxes are calibrated relatively.
            unscaled="LAMOST calibrates fluxes relative to each other" if is_relative else "",
            **more,
        )  # fmt: skip

    def _remarks(self, header: Any) -> str:
        headers = [self.primary] if self.primary is header else [self.primary, header]
        words = [text_at(one, key) for one in headers for key in _REMARKS]
        for one in headers:
            # AIRORVAC = 'air', VACUUM = T
            if text_at(one, "AIRORVAC").lower() == "air" or text_at(one, "VACUUM") == "False":
                words.append("in air")
            if text_at(one, "VACUUM") == "True":
                words.append("vacuum")
        return "\n".join(words)[:100_000]

    def _notes(self, header: Any) -> tuple[str, ...]:
        notes = []
        for key in ("DATAQUAL", "OFFSETPX"):
            if value := text_at(self.primary, key) or text_at(header, key):
                notes.append(f"{key} = {value[:60]}")
        if "lowlib" in self.origin.lower():
            notes.append("dereddened and at zero velocity: counts need it reddened again")
        return tuple(notes)

    def _of_table(self, number: int, hdu: Any) -> FileTable:
        header = hdu.header
        if text_at(header, "ZIMAGE") == "True":
            raise InputError("holds a compressed image", "a table with WAVELENGTH and FLUX", key="table", value=number)
        # The unit of the file applies to the flux if its column states none (SDSS).
        whole = text_at(self.primary, "BUNIT") or text_at(header, "BUNIT") or None
        columns = []
        for k, column in enumerate(hdu.columns):
            unit = (column.unit or "").strip() or None
            if unit is None and role_of(str(column.name)).kind == "flux" and role_of(str(column.name)).unit is None:
                unit = whole
            missing = header.get(f"TNULL{k + 1}")
            columns.append(
                Column(
                    str(column.name),
                    _reader(hdu, k),
                    unit,
                    missing if isinstance(missing, int | float) and not isinstance(missing, bool) else None,
                    text_at(header, f"TUCD{k + 1}"),
                )
            )
        ucds = " ".join(column.ucd for column in columns if column.ucd)
        return self._table(header, columns, self._label(number, hdu), remarks=f"\n{ucds}")

    def _images(self) -> tuple[list[FileTable], list[InputError]]:
        """Return the images with an axis of wavelengths, and the faults of others."""
        images, errors = [], []
        for number, hdu in enumerate(self.hdus):
            if is_spectrum_image(hdu, text_at(hdu.header, "EXTNAME")):
                try:
                    images.append(self._of_image(number, hdu))
                except InputError as error:
                    errors.append(error)
        flux = [one for one in images if one.label.strip().lower() in ("flux", "sci", "spectrum")]
        return (flux if flux and not self.asked else images), errors

    def _of_image(self, number: int, hdu: Any) -> FileTable:
        header = hdu.header
        flux, names, note = rows_of(hdu, text_at(self.primary, "TELESCOP"))
        axis, unit, kind, notes = axis_of(header, self.primary, flux.shape[-1])
        columns = [
            Column("wavelength", lambda: axis, unit),
            Column("flux", lambda: flux, text_at(header, "BUNIT") or text_at(self.primary, "BUNIT") or None),
        ]
        remarks = "\nair wavelength" if kind == "AWAV" else "\nvacuum" if kind == "WAVE" else ""
        return self._table(
            header, columns, self._label(number, hdu), remarks=remarks, notes=(*notes, *note), row_names=names
        )

    def _of_pair(self, arm: str, axis: Any, flux: Any, rows: Sequence[str]) -> FileTable:
        """Return the table of an image of fluxes whose wavelengths are in another image (DESI, PFS, APOGEE)."""
        name = text_at(axis.header, "EXTNAME").removeprefix(f"{arm}_")
        columns = [
            Column(name, _reader(axis), text_at(axis.header, "BUNIT") or None),
            Column("flux", _reader(flux), text_at(flux.header, "BUNIT") or None),
        ]
        group = "arms" if arm else None
        return self._table(flux.header, columns, arm or "flux", row_names=rows, group=group)

    def _row_names(self) -> tuple[str, ...]:
        """Return the targets of the rows of images, from a fibre map (DESI data model, coadd: FIBERMAP)."""
        for hdu in self.hdus:
            if text_at(hdu.header, "EXTNAME").upper() == "FIBERMAP" and "TARGETID" in getattr(hdu.columns, "names", ()):
                return tuple(str(one) for one in hdu.data.field("TARGETID"))
        return ()


def text_at(header: Any, key: str) -> str:
    """Return a keyword's value as text; empty if it is missing or cannot be parsed."""
    try:
        return str(header.get(key, "")).strip()
    except Exception:  # unparsable cards
        return ""


def _reader(hdu: Any, column: int | None = None) -> Callable[[], Any]:
    """Return a reader of an extension's data or column that raises InputError for damaged content."""

    def values() -> Any:
        with parsing("it", WHOLE), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return hdu.data if column is None else hdu.data.field(column)

    return values
