"""Reader of spectra in FITS files: binary and ASCII tables, and images."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from functools import partial
from typing import Any

from mauvecl.host.spectra.column_roles import role_of
from mauvecl.host.spectra.spectrum_table import SpectrumTable
from mauvecl.host.tables.fits import column_values, open_fits, reading, text_at
from mauvecl.host.tables.fits_images import axis_of, is_spectrum_image, is_survey_image, paired_images, rows_of
from mauvecl.host.tables.medium import medium_of
from mauvecl.host.tables.table import Values
from mauvecl.schema.errors import InputError

#: Units implied by the archives' tables, those of CALSPEC.
IMPLIED_UNITS = ("Angstrom", "erg / (s cm2 Angstrom)")
#: Keywords whose text may mention air, vacuum, the star's surface or its dust.
_REMARKS = ("COMMENT", "HISTORY", "DESCRIP")


def fits_tables(
    content: bytes, name: str, origin: str, asked: Sequence[str], check: bool = True
) -> list[SpectrumTable]:
    """Read the tables of a FITS file, including images of spectra.

    Raises InputError if the content is not FITS, is truncated, contradicts its checksums, or has no tables or images.
    """
    hdus = open_fits(io.BytesIO(content), check=check)
    with reading("it"):
        return _Reader(hdus, name, origin, asked).tables()


class _Reader:
    """Reader of the extensions of an open file."""

    def __init__(self, hdus: Any, name: str, origin: str, asked: Sequence[str]) -> None:
        self.hdus, self.name, self.origin, self.asked = hdus, name, origin, asked
        self.primary = hdus[0].header

    def tables(self) -> list[SpectrumTable]:
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
        if is_survey_image(self.hdus[0], text_at(self.primary, "TELESCOP")):
            # SDSS keeps lines and redshifts of the spectrum in tables.
            return [self._of_image(0, self.hdus[0])]
        kinds = [{role.kind for role in table.roles} for table in tables]
        images, errors = self._images()
        labels = {image.label.strip().lower() for image in images}
        named = labels & {word.lower() for word in self.asked}
        if any("flux" in kind and kind & {"wavelength", "lower edge"} for kind in kinds) and not named:
            return tables
        if errors and not tables and not images:
            raise errors[0]
        if not tables and not images:
            raise InputError("has no table and no image", "a FITS table with WAVELENGTH and FLUX", key="table")
        return [*tables, *images]

    def _label(self, number: int, hdu: Any) -> str:
        """Return the name by which users select an extension: its number if requested, else its name."""
        return str(number) if str(number) in self.asked else text_at(hdu.header, "EXTNAME") or str(number)

    def _table(self, header: Any, columns: Sequence[Values], label: str, **more: Any) -> SpectrumTable:
        is_relative = text_at(self.primary, "TELESCOP").upper().startswith("LAMOST")
        return SpectrumTable(
            columns,
            next((t for key in ("TARGNAME", "TARGETID", "OBJECT") for one in (self.primary, header)
                  if (t := text_at(one, key)[:80])), self.name),
            self.origin,
            label,
            IMPLIED_UNITS,
            remarks=self._remarks(header) + more.pop("remarks", ""),
            medium=partial(medium_of, self.primary, header),
            notes=(*self._notes(header), *more.pop("notes", ())),
            # LAMOST DR5, "Data production description", section 1: fluxes are calibrated relatively.
            unscaled="LAMOST calibrates fluxes relative to each other" if is_relative else "",
            **more,
        )  # fmt: skip

    def _remarks(self, header: Any) -> str:
        headers = [self.primary] if self.primary is header else [self.primary, header]
        texts = [text_at(one, key) for one in headers for key in _REMARKS]
        # Comments beside the names and units of columns and axes, as in "TTYPE1 = 'WAVE' / in air".
        cards = [key for key in header if re.fullmatch(r"T(?:TYPE|UNIT)\d+|C(?:TYPE|UNIT|RVAL)1", key)]
        texts += [str(header.comments[key]) for key in cards] + [
            text_at(header, key) for key in header if "TCOMM" in key
        ]
        return "\n".join(texts)[:100_000]

    def _notes(self, header: Any) -> tuple[str, ...]:
        notes = []
        for key in ("DATAQUAL", "OFFSETPX"):
            if value := text_at(self.primary, key) or text_at(header, key):
                notes.append(f"{key} = {value[:60]}")
        if "lowlib" in self.origin.lower():
            notes.append("dereddened and at zero velocity: counts need it reddened again")
        return tuple(notes)

    def _of_table(self, number: int, hdu: Any) -> SpectrumTable:
        header = hdu.header
        if text_at(header, "ZIMAGE") == "True":
            raise InputError("holds a compressed image", "a table with WAVELENGTH and FLUX", key="table", value=number)
        # The unit of the file applies to flux and model if their columns state none (SDSS).
        whole = text_at(self.primary, "BUNIT") or text_at(header, "BUNIT")
        columns = []
        for k, column in enumerate(hdu.columns):
            unit = (column.unit or "").strip()
            role = role_of(str(column.name))
            if not unit and role.kind in ("flux", "model") and role.unit is None:
                unit = whole
            columns.append(_values(hdu, str(column.name), unit, column, text_at(header, f"TUCD{k + 1}")))
        ucds = " ".join(column.ucd for column in columns if column.ucd)
        return self._table(header, columns, self._label(number, hdu), remarks=f"\n{ucds}")

    def _images(self) -> tuple[list[SpectrumTable], list[InputError]]:
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

    def _of_image(self, number: int, hdu: Any) -> SpectrumTable:
        header = hdu.header
        flux, names, note = rows_of(hdu, text_at(self.primary, "TELESCOP"), bool(self.asked))
        axis, unit, kind, notes = axis_of(header, self.primary, flux.shape[-1])
        # SDSS-I/II writes erg/cm/s/Ang for erg/cm2/s/Ang.
        flux_unit = re.sub(r"erg/cm/s/", "erg/cm2/s/", text_at(header, "BUNIT") or text_at(self.primary, "BUNIT"))
        columns = [Values.of("wavelength", axis, unit), Values.of("flux", flux, flux_unit)]
        remarks = "\nair wavelength" if kind == "AWAV" else "\nvacuum" if kind == "WAVE" else ""
        return self._table(
            header, columns, self._label(number, hdu), remarks=remarks, notes=(*notes, *note), row_names=names
        )

    def _of_pair(self, arm: str, axis: Any, flux: Any, rows: Sequence[str]) -> SpectrumTable:
        """Return the table of an image of fluxes whose wavelengths are in another image (DESI, PFS, APOGEE)."""
        name = text_at(axis.header, "EXTNAME").removeprefix(f"{arm}_")
        columns = [_values(hdu, title, text_at(hdu.header, "BUNIT")) for hdu, title in ((axis, name), (flux, "flux"))]
        group = "arms" if arm else None
        return self._table(flux.header, columns, arm or "flux", row_names=rows, group=group)

    def _row_names(self) -> tuple[str, ...]:
        """Return the targets of the rows of images, from a fibre map (DESI data model, coadd: FIBERMAP)."""
        for hdu in self.hdus:
            if text_at(hdu.header, "EXTNAME").upper() == "FIBERMAP" and "TARGETID" in getattr(hdu.columns, "names", ()):
                return tuple(str(one) for one in hdu.data.field("TARGETID"))
        return ()


def _values(hdu: Any, name: str, unit: str, column: Any = None, ucd: str = "") -> Values:
    """Return an extension's data or column, which is read on access; that raises InputError for damaged content."""

    def read(start: int, stop: int) -> Any:
        with reading("it"):
            return hdu.data[start:stop] if column is None else column_values(hdu.data[start:stop], column)

    return Values(name, (int(hdu.header[f"NAXIS{hdu.header['NAXIS']}"]),), read, unit, ucd=ucd)
