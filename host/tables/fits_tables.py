"""Frames in FITS files: tables with a row for each frame, and images with their axes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.host.tables.fits import BLOCK, column_values, reading, text_at
from mauvecl.host.tables.fits_images import axis_of
from mauvecl.host.tables.names import matched
from mauvecl.host.tables.table import PIECE_BYTES, TableFile, Values
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from astropy.io import fits

#: Scales that astropy writes for a column of times (TCTYPn), which then holds two parts of a Julian date.
SCALES = ("UTC", "TAI", "TT", "TDB", "TCG", "TCB", "UT1")


class FitsTables(TableFile):
    """An open FITS file.

    Parameters
    ----------
    what : str
        The file, for messages.
    hdu : str or int, optional
        Name or number of the extension whose columns are searched first; by default the first table.
    wanted : tuple of tuple of str
        Groups of names; without `hdu`, the first table with a column of each group is used.
    """

    def __init__(
        self, hdus: fits.HDUList, what: str, hdu: str | None = None, wanted: tuple[tuple[str, ...], ...] = ()
    ) -> None:
        self.hdus = hdus
        self.tables = [k for k, one in enumerate(hdus) if hasattr(one, "columns") and not one.is_image]
        self.images = [
            k for k, one in enumerate(hdus) if getattr(one, "is_image", False) and one.header.get("NAXIS", 0)
        ]
        columns = {k: {str(name).lower() for name in hdus[k].columns.names} for k in self.tables}
        fitting = [k for k in self.tables if all(columns[k] & {name.lower() for name in names} for names in wanted)]
        self.chosen = next(iter(fitting or self.tables), None)
        header = dict(hdus[0].header)
        if hdu is not None:
            at = self._number(hdu)
            if at is None:
                held = ", ".join(self._label(k) for k in range(len(hdus)))
                raise InputError.of("hdu", hdu, f"one of {held}", where=what)
            self.chosen = at if at in self.tables else self.chosen
            header |= dict(hdus[at].header)
        if self.chosen is not None:
            header |= dict(hdus[self.chosen].header)
        super().__init__(what, header)
        for k in range(1, 1 + len(hdus[self.chosen].columns) if self.chosen is not None else 1):
            scale = str(header.get(f"TCTYP{k}", "")).upper()
            if scale in SCALES and str(header.get(f"TFORM{k}", "")) == "2D":
                self.header |= {"MJDREFI": 0, "MJDREFF": 0.0, "TIMESYS": scale,
                                "TREFPOS": header.get(f"TRPOS{k}", header.get("TREFPOS", ""))}  # fmt: skip

    @property
    def columns(self) -> list[str]:
        """Names of the columns of the chosen table."""
        return [] if self.chosen is None else [str(name) for name in self.hdus[self.chosen].columns.names]

    @property
    def names(self) -> list[str]:
        """Names of the columns of the chosen table, of images, and of the columns of other tables."""
        others = [f"{self._label(k)}/{name}" for k in self.tables if k != self.chosen
                  for name in self.hdus[k].columns.names]  # fmt: skip
        return [*self.columns, *(self._label(k) for k in self.images), *others]

    def named(self, name: str) -> Values | None:
        """Return a column of the chosen table, an image, ``EXTENSION/COLUMN``, or a column of one other table."""
        if self.chosen is not None and (found := self._column(self.chosen, name)) is not None:
            return found
        at = self._number(name)
        if at in self.images:
            return self._image(at)
        extension, _, column = name.partition("/")
        if column and (table := self._number(extension)) in self.tables:
            return self._column(table, column)
        others = [found for k in self.tables if (found := self._column(k, name)) is not None]
        if len(others) > 1:
            raise InputError(f"{self.what} has {len(others)} columns called {name!r}", "EXTENSION/COLUMN", key=name)
        return others[0] if others else None

    def axis(self, name: str, dimension: int) -> Values:
        """Return the coordinates along an axis of an image, dimension 1 being that of pixels."""
        at = self._number(name)
        if at not in self.images:
            raise InputError.of("flux", name, "an image, whose header has the coordinates", where=self.what)
        header = self.hdus[at].header
        n = int(header[f"NAXIS{dimension}"])
        if dimension == 2:
            try:
                first, step, reference = (float(header[f"{key}2"]) for key in ("CRVAL", "CDELT", "CRPIX"))
            except (KeyError, ValueError) as error:
                raise InputError(f"{self.what}: the image {name!r} has no CRVAL2, CDELT2 and CRPIX2",
                                 "the times of its rows", key="time") from error  # fmt: skip
            return Values.of(name, first + step * (np.arange(1, n + 1) - reference), header.get("CUNIT2"), self.what)
        if text_at(header, "CTYPE1").upper() == "WAVE-TAB":
            return self._tabulated(header)
        try:
            values, unit, kind, _ = axis_of(header, self.hdus[0].header, n)
        except InputError as error:
            raise error.within(self.what) from error
        # The name says the medium.
        name = {"AWAV": "air wavelength", "WAVE": "vacuum wavelength"}.get(kind, "wavelength")
        return Values.of(name, values, unit, self.what)

    def _tabulated(self, header: Any) -> Values:
        """Return an axis that refers to the column of a table (-TAB, FITS standard 4.0, section 8.3)."""
        found = self.named(f"{text_at(header, 'PS1_0')}/{text_at(header, 'PS1_1')}")
        if found is None:
            raise InputError(f"{self.what} lacks the table of its wavelengths", "the column that PS1_0 and PS1_1 name",
                             key="wavelength")  # fmt: skip
        return Values.of(found.name, found.numbers().ravel(), found.unit or header.get("CUNIT1"), self.what)

    def _label(self, number: int) -> str:
        return str(self.hdus[number].name) or str(number)

    def _number(self, name: str) -> int | None:
        """Return the number of an extension by its name or number."""
        labels = [str(one.name).upper() for one in self.hdus]
        if name.upper() in labels and name:
            return labels.index(name.upper())
        return int(name) if name.isascii() and name.isdigit() and int(name[:6]) < len(self.hdus) else None

    def _image(self, number: int) -> Values:
        hdu = self.hdus[number]
        shape = tuple(hdu.shape)

        def read(start: int, stop: int) -> Any:
            with reading(self.what):
                return hdu.section[start:stop]

        return Values(self._label(number), shape, read, text_at(hdu.header, "BUNIT"), self.what)

    def _column(self, number: int, name: str) -> Values | None:
        hdu = self.hdus[number]
        title = matched(name, map(str, hdu.columns.names), self.what)
        if title is None:
            return None
        found = hdu.columns[title]
        n_rows = int(hdu.header["NAXIS2"])
        small = int(hdu.header["NAXIS1"]) * n_rows + int(hdu.header.get("PCOUNT", 0)) <= PIECE_BYTES
        if not small and int(hdu.header.get("PCOUNT", 0)):
            raise InputError(f"{self.what}: the table {self._label(number)} has columns of variable length and more "
                             f"than {PIECE_BYTES >> 20} MiB", "columns of fixed length", key="hdu")  # fmt: skip
        pair = str(self.header.get(f"TCTYP{hdu.columns.names.index(found.name) + 1}", "")).upper() in SCALES

        def read(start: int, stop: int) -> Any:
            with reading(self.what):
                values = column_values(hdu.data[start:stop] if small else _piece(hdu, start, stop), found)
            if pair and values.ndim == 2 and number == self.chosen:
                return (values[:, 0] - 2_400_000.5) + values[:, 1]
            return values

        one = np.shape(read(0, min(1, n_rows)))
        width = 0 if small else 2 * int(hdu.header["NAXIS1"])
        return Values(found.name, (n_rows, *one[1:]), read, str(found.unit or "").strip(), self.what, width)


def _piece(hdu: Any, start: int, stop: int) -> Any:
    """Read some rows of a table."""
    from astropy.io import fits

    place, width = hdu.fileinfo(), int(hdu.header["NAXIS1"])
    place["file"].seek(place["datLoc"] + start * width)
    raw = place["file"].read((stop - start) * width)
    header = hdu.header.copy()
    header["NAXIS2"] = stop - start
    for key in ("CHECKSUM", "DATASUM"):
        header.remove(key, ignore_missing=True)
    return fits.BinTableHDU.fromstring(header.tostring().encode() + raw + b"\0" * (-len(raw) % BLOCK)).data
