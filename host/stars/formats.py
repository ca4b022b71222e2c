"""Spectra in text, ECSV, VOTable and FITS, recognised by content instead of name.

The headers of spectra in text mix names and units of columns with prose. A line names columns if it has as many cells
as the data have columns, and names a wavelength and another known column; "vacuum wavelengths" over two columns is
prose.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.host.stars.columns import AXES, Role, divide_name, is_unit, join, role_of, stated_units, words_of
from mauvecl.host.stars.conversion import ReadSpectrum, SpectrumTable, convert_spectrum, select_spectrum
from mauvecl.host.tables import text_tables
from mauvecl.host.tables.files import check_size, parsing, reading, without_columns
from mauvecl.host.tables.fits_tables import FLUX_UNITS, WAVE_UNITS, WHOLE, FitsTables, open_fits, unit_at
from mauvecl.host.tables.names import text_at
from mauvecl.host.tables.opening import open_content, text_in, votables
from mauvecl.host.tables.table import MemoryTable, Values, number_in
from mauvecl.host.tables.units import is_stated, time_in_name
from mauvecl.schema.errors import InputError, shortened

if TYPE_CHECKING:
    import astropy.units as u

#: Units of a text file without stated units (the paper's rule).
TEXT_UNITS = ("nm", "erg / (s cm2 Angstrom)")
#: Gaia DR3's sampled mean spectra: 343 fluxes at 336 + 2 i nm (documentation of gaiadr3.xp_sampled_mean_spectrum).
GAIA_NM, GAIA_FLUX = 336.0 + 2.0 * np.arange(343), "W m-2 nm-1"


def table_of_text(
    text: str, name: str, origin: str, words: Sequence[str], wavelength: bool, flux: bool
) -> SpectrumTable:
    """Read the table of a text file; `wavelength` and `flux` say whether its header is searched for their units."""
    lines = text_tables.NumberLines(text, "wavelength and flux")
    if any(cell[:1] in ("(", "[") for cell in lines.cells[0]):
        return _table_of_arrays(MemoryTable(text_tables.text_table(text, "it", commas=True), "it"), name, origin)
    names, units = _names(lines)
    titles = names or [str(k + 1) for k in range(max(lines.n, 2))]
    columns = [lines.column(k, title, units[k] if units else "") for k, title in enumerate(titles)]
    roles = [role_of(c.name, c.unit) for c in columns] if names else _roles_by_number(lines, words)
    if titles[:2] == ["wavelength", "flux"] and np.array_equal(columns[0].numbers(), GAIA_NM):
        roles = [replace(roles[0], unit="nm"), replace(roles[1], unit=GAIA_FLUX), *roles[2:]]
    # The header may state the units that are not next to the names; an unknown column may be the flux.
    lights = ("flux", "model") if any(role.kind in ("flux", "model") for role in roles) else ("unknown",)
    has_axis, has_flux = (any(role.kind in kinds and role.unit for role in roles) for kinds in (AXES, lights))
    axis_unit, flux_unit = stated_units(
        lines.comments, wavelength=wavelength and not has_axis, flux=flux and not has_flux, is_named=bool(names)
    )
    units_by_kind = dict.fromkeys(AXES, axis_unit) | dict.fromkeys(lights, flux_unit)
    roles = [role if role.unit else replace(role, unit=units_by_kind.get(role.kind)) for role in roles]
    keywords = text_tables.keywords_of([f"# {line}" for line, _ in lines.header])
    return SpectrumTable(
        columns, name, origin, implied_units=TEXT_UNITS, remarks=lines.comments, messages=tuple(lines.messages),
        headers=(keywords,), known_roles=roles,
    )  # fmt: skip


def _roles_by_number(lines: text_tables.NumberLines, words: Sequence[str]) -> list[Role]:
    """Return the roles of columns without names: the spectrum is the first two, or those that the user numbers."""
    n = lines.n
    indices = [int(word) - 1 for word in words if word.isascii() and word.isdigit() and 1 <= int(word[:6]) <= n]
    if len(indices) != len(words) or len(indices) > 2:
        raise InputError.of("columns", words, f"their numbers, 1 to {n}")
    if not words and n > 2:
        lines.messages.append(f"the first two of its {n} columns are used, which have no names")
    wave, value = indices if len(indices) == 2 else (0, *(indices or [1]))
    roles = [Role(str(k + 1), "unknown") for k in range(max(n, 2))]
    roles[wave] = replace(roles[wave], kind="wavelength", score=1)
    roles[value] = replace(roles[value], kind="flux", score=1)
    return roles


def _table_of_arrays(file: MemoryTable, name: str, origin: str) -> SpectrumTable:
    """Return a table whose cells contain arrays such as ``(1.0, 2.0)``, with a spectrum per row, as in Gaia's files."""
    columns = [file.find(title) for title in file.names]
    for k, column in enumerate(columns):
        texts = column.cells.tolist()
        if all(text[:1] in ("(", "[") for text in texts):
            cells = [re.split(r"\s*,\s*|\s+", text.strip("()[] \t")) for text in texts]
            rows = [np.array(list(map(number_in, row))) for row in cells]
            is_image = len({row.size for row in rows}) == 1
            arrays = np.array(rows) if is_image else np.array([*rows, None], object)[:-1]
            columns[k] = Values.of(column.name, arrays, column.unit)
    by_name = {column.name.lower(): column for column in columns}
    if not {"source_id", "flux"} <= {*by_name} or "wavelength" in by_name or by_name["flux"].shape[1:] != GAIA_NM.shape:
        return SpectrumTable(columns, name, origin, implied_units=TEXT_UNITS)
    columns = [by_name["source_id"], Values.of("wavelength", GAIA_NM, "nm"), replace(by_name["flux"], unit=GAIA_FLUX)]
    return SpectrumTable(
        columns, name, f"{origin}, Gaia DR3 sampled XP spectrum", row_title="Gaia DR3 {}",
        notes=("wavelengths 336 + 2 i nm, W m-2 nm-1: Gaia DR3's documentation",),
    )  # fmt: skip


def _names(lines: text_tables.NumberLines) -> tuple[list[str], list[str]]:
    """Return the names of columns and the units below them; empty if there are none."""
    # Lines such as "column 2: flux"; columns without such a line are named by number.
    by_number = text_tables.names_by_number((line for line, _ in lines.header), lines.n)
    numbered = [by_number.get(k, str(k + 1)) for k in range(lines.n)]
    if len(by_number) > 1 and _recognised(numbered):
        return numbered, []
    rows = {k: cells for k, (line, _) in enumerate(lines.header) if (cells := text_tables.divide_names(line, lines.n))}
    # The last of the lines that name most columns.
    score, k = max(((_recognised(cells), k) for k, cells in rows.items()), default=(0, 0))
    if score > 0:
        return rows[k], _units(lines, k)
    unmarked = [k for k, (line, is_comment) in enumerate(lines.header) if not is_comment and line]
    if len(unmarked) == 1:
        # The only line that is not a comment may name columns, some of them unknown.
        cells = rows.get(unmarked[0], [])
        is_marked = bool(re.search(r"[,;|\t]", lines.header[unmarked[0]][0].strip()))
        kinds = {role_of(cell).kind for cell in cells}
        if len(cells) == 2:
            # A light curve has no wavelengths.
            is_named = is_marked and (bool(kinds & set(AXES)) or any(map(_is_time, cells)))
        else:
            is_named = is_marked or (kinds > {"unknown"} and all(re.match(r"[^\W\d]", cell) for cell in cells))
        if is_named:
            return cells, _units(lines, unmarked[0])
    return _of_another_length(lines), []


def _is_time(name: str) -> bool:
    """Return whether a column's name is that of times."""
    return name.lower() == "phase" or "time" in words_of(name) or time_in_name(f"time {name}") is not None


def _recognised(cells: Sequence[str]) -> int:
    """Count the cells that name a spectrum's columns; 0 without a wavelength and another column."""
    kinds = [role_of(cell).kind for cell in cells]
    is_named = any(kind in AXES and not is_unit(cell) for cell, kind in zip(cells, kinds, strict=True))
    # "resolution 5 nm" does not name columns; "nm error flux" does.
    companions = {*kinds} - {*AXES, "unknown"} if is_named else {*kinds} & {"flux", "model", "magnitude", "counts"}
    if not companions or not {*kinds} & {*AXES}:
        return 0
    # Names have precedence over the units below them.
    return sum(1 if is_unit(cell) else 2 for cell, kind in zip(cells, kinds, strict=True) if kind != "unknown")


def _units(lines: text_tables.NumberLines, names_at: int) -> list[str]:
    """Return the cells of the line of units below the names, if any; IPAC tables have types in between."""
    for k, (line, _) in enumerate(lines.header[names_at + 1 : names_at + 3]):
        cells = text_tables.divide_names(line, lines.n)
        is_all = any(is_unit(cell) for cell in cells) and all(is_unit(c) or not is_stated(c) for c in cells)
        # "A star" is not a unit, and "nm banana" contains an unknown unit.
        is_some = any(len(cell) > 1 and is_unit(cell) for cell in cells) and not any(c.endswith(":") for c in cells)
        if is_all or (k == 0 and is_some):
            return cells
    return []


def _of_another_length(lines: text_tables.NumberLines) -> list[str]:
    """Return the names of a comment with fewer cells than the rows; raise InputError for another number of names."""
    for line, is_comment in reversed(lines.header):
        cells = [cell.strip("\"' ") for cell in re.split(r"[,;\t|]", line)]
        cells = cells if len(cells) > 1 else text_tables.divide_outside_brackets(line)
        if not all(cells) or text_tables.PROSE.search(line) or not 1 < len(cells) <= lines.n + 8:
            continue
        kinds = [role_of(cell).kind if words_of(divide_name(cell)[0]) else "unknown" for cell in cells]
        if "flux" not in kinds or not any(kind in AXES for kind in kinds):
            continue
        is_plain = set(kinds) <= {"wavelength", "flux", "unknown"} and not any(role_of(c).logarithm for c in cells)
        in_order = is_plain and kinds.index("flux") > kinds.index("wavelength")
        if is_comment and len(cells) < lines.n:
            message = f"its {len(cells)} names ({join(cells)}) are those of the first of {lines.n} columns"
            lines.messages.append(message)
            return [*cells, *(str(k + 1) for k in range(len(cells), lines.n))]
        if not is_comment or not in_order:
            fault = f"its line of names has {len(cells)} ({join(cells)}) for {lines.n} columns"
            raise InputError(f"{fault}, but needs one for each", key="columns")
    return []


#: Units implied by the archives' tables, those of CALSPEC.
FITS_UNITS = ("Angstrom", "erg / (s cm2 Angstrom)")
#: Keywords whose text may mention air, vacuum, the star's surface or its dust.
_REMARKS = ("COMMENT", "HISTORY", "DESCRIP")
#: Names of extensions with images that are not fluxes.
_NO_FLUX = re.compile(r"err|unc|std|wgt|weight|sig|var|qual|mask|dq|snr|cont|sky|back|wave|lambda|lam$", re.IGNORECASE)
_AXIS_NAME = re.compile(r"(?:(.+)_)?(?:WAVELENGTH|WAVE|WAVELEN|LAMBDA|LOGLAM)", re.IGNORECASE)
_FLUX_NAMES = ("FLUX", "SCI", "SPECTRUM", "SPEC")


class _FitsReader:
    """Reader of the tables of an open FITS file, including images of spectra."""

    def __init__(self, hdus: Any, name: str, origin: str, words: Sequence[str]) -> None:
        self.hdus, self.name, self.origin, self.words = hdus, name, origin, words
        self.file = FitsTables(hdus, "it")
        self.primary = hdus[0].header
        self.telescope = text_at(self.primary, "TELESCOP").upper()

    def tables(self) -> list[SpectrumTable]:
        """Return the tables that may have the spectrum; raise InputError if there is none."""
        if pairs := self._pairs():
            return pairs
        tables = [self._of_table(number) for number in self.file.tables]
        if self._is_survey_image(self.primary):
            # SDSS keeps lines and redshifts of the spectrum in tables.
            return [self._of_image(0)]
        images: list[SpectrumTable] = []
        errors: list[InputError] = []
        for number in filter(self._may_hold_fluxes, range(len(self.hdus))):
            try:
                images.append(self._of_image(number))
            except InputError as error:
                errors.append(error)
        if not self.words:
            images = [image for image in images if image.label.strip().lower() in ("flux", "sci", "spectrum")] or images
        kinds = [{role.kind for role in table.roles} for table in tables]
        selected = {image.label.strip().lower() for image in images} & {word.lower() for word in self.words}
        if any("flux" in kind and kind & {"wavelength", "lower edge"} for kind in kinds) and not selected:
            return tables
        is_bare = not any(kind & {"flux", "model", "magnitude"} for kind in kinds)
        if errors and not images and (not tables or (is_bare and not self.words)):
            raise errors[0]
        # A table of wavelengths, of lines or of a log is not a spectrum.
        return images if images and not self.words and is_bare else [*tables, *images]

    def _table(
        self, number: int, columns: Sequence[Values], label: str = "", remarks: str = "",
        notes: tuple[str, ...] = (), row_names: Sequence[str] = (), group: str | None = None,
    ) -> SpectrumTable:  # fmt: skip
        """Return the table of an extension, whose label is its number if the user selects it so, or else its name."""
        header, primary = self.hdus[number].header, self.primary
        headers = [primary] if primary is header else [primary, header]
        comments = [text_at(source, key) for source in headers for key in _REMARKS]
        # Comments beside the names and units of columns and axes, as in "TTYPE1 = 'WAVE' / in air".
        cards = [key for key in header if re.fullmatch(r"T(?:TYPE|UNIT)\d+|C(?:TYPE|UNIT|RVAL)1", key)]
        comments += [str(header.comments[key]) for key in cards]
        comments += [text_at(header, key) for key in header if "TCOMM" in key]
        quality = {key: text_at(primary, key) or text_at(header, key) for key in ("DATAQUAL", "OFFSETPX")}
        header_notes = [f"{key} = {text[:60]}" for key, text in quality.items() if text]
        if "lowlib" in self.origin.lower():
            header_notes.append("dereddened and at zero velocity: counts need it reddened again")
        titles = [text_at(keys, key)[:80] for key in ("TARGNAME", "TARGETID", "OBJECT") for keys in (primary, header)]
        # LAMOST DR5, "Data production description", section 1: fluxes are calibrated relatively.
        unscaled = "LAMOST calibrates fluxes relative to each other" if self.telescope.startswith("LAMOST") else ""
        label = label or (str(number) if str(number) in self.words else text_at(header, "EXTNAME") or str(number))
        return SpectrumTable(
            columns, next(filter(None, titles), self.name), self.origin, label, FITS_UNITS,
            remarks="\n".join(comments)[:100_000] + remarks, headers=(primary, header), notes=(*header_notes, *notes),
            group=group, unscaled=unscaled, row_names=row_names,
        )  # fmt: skip

    def _columns(self, number: int) -> list[Values]:
        columns = [self.file.column(number, str(title)) for title in self.hdus[number].columns.names]
        return [column for column in columns if column is not None]

    def _of_table(self, number: int) -> SpectrumTable:
        """Return the spectrum of a table of the file."""
        # The units of the file apply to columns that state none (SDSS).
        flux, wave = (unit_at(keys, self.primary, self.hdus[number].header) for keys in (FLUX_UNITS, WAVE_UNITS))
        units_by_kind = dict.fromkeys(("flux", "model"), flux) | dict.fromkeys(AXES, wave)
        columns = []
        for column in self._columns(number):
            role = role_of(column.name)
            has_unit = column.unit or role.unit
            columns.append(column if has_unit else replace(column, unit=units_by_kind.get(role.kind, "")))
        return self._table(number, columns, remarks="\n" + " ".join(column.ucd for column in columns if column.ucd))

    def _may_hold_fluxes(self, number: int) -> bool:
        """Return whether an extension is an image that may contain fluxes."""
        hdu = self.hdus[number]
        is_filled = getattr(hdu, "is_image", False) and hdu.header.get("NAXIS", 0)
        return bool(is_filled and not _NO_FLUX.search(text_at(hdu.header, "EXTNAME")))

    def _is_survey_image(self, header: Any) -> bool:
        """Return whether the first row of an image is a flux, and others are its errors and masks."""
        # dr5.lamost.org/v3/doc/data-production-description, classic.sdss.org/dr7/dm/flatFiles/spSpec.html
        is_plane = header.get("NAXIS", 0) == 2 and header.get("NAXIS2", 0) <= 6
        return self.telescope.startswith(("LAMOST", "SDSS")) and "COEFF0" in header and is_plane

    def _pairs(self) -> list[SpectrumTable]:
        """Return the tables of images of fluxes whose wavelengths are in another image (DESI, PFS, APOGEE)."""
        images = [k for k, hdu in enumerate(self.hdus) if getattr(hdu, "is_image", False)]
        named = {text_at(self.hdus[k].header, "EXTNAME").upper(): k for k in images}
        tables: list[SpectrumTable] = []
        for name, axis in named.items():
            if (match := _AXIS_NAME.fullmatch(name)) is None:
                continue
            # DESI's arms have B_WAVELENGTH and B_FLUX (https://desidatamodel.readthedocs.io, coadd files).
            arm = match[1] or ""
            titles = [f"{arm}_{kind}".lstrip("_") for kind in _FLUX_NAMES]
            fluxes = [named[title] for title in titles if title in named]
            if not arm and not fluxes and name != "LAMBDA":
                # An image of as many pixels without wavelengths of its own, such as the first of the file.
                n = self.hdus[axis].header.get("NAXIS1")
                alike = [k for k, hdu in enumerate(self.hdus) if hdu.header.get("NAXIS1") == n]
                fluxes = [k for k in alike if self._may_hold_fluxes(k) and "CRVAL1" not in self.hdus[k].header]
            if len(fluxes) == 1:
                title = text_at(self.hdus[axis].header, "EXTNAME").removeprefix(f"{arm}_")
                columns = [replace(self.file.image(axis), name=title), replace(self.file.image(fluxes[0]), name="flux")]
                # The targets of the rows are in a fibre map.
                rows = self.file.named("FIBERMAP/TARGETID")
                names = () if rows is None else tuple(map(str, rows.cells.tolist()))
                group = "arms" if arm else None
                tables.append(self._table(fluxes[0], columns, arm or "flux", row_names=names, group=group))
        return tables

    def _of_image(self, number: int) -> SpectrumTable:
        """Return the spectrum of an image of the file, with wavelengths from its header."""
        hdu = self.hdus[number]
        header = hdu.header
        if (orders := _spextool_orders(header, hdu.data)) is not None:
            cube = np.asarray(hdu.data).reshape(-1, *hdu.data.shape[-2:])
            cube = cube if len(cube) > 1 else cube[0]
            columns = [Values.of("wavelength", cube[..., 0, :], text_at(header, "XUNITS")),
                       Values.of("flux", cube[..., 1, :], text_at(header, "YUNITS"))]  # fmt: skip
            if int(header["NAPS"]) == 1:
                columns.append(Values.of("order", np.array(orders)))
            return self._table(number, columns, row_names=orders)
        flux, names, notes = self._rows(hdu)
        # SDSS-I/II writes erg/cm/s/Ang for erg/cm2/s/Ang.
        unit = re.sub(r"erg/cm/s/", "erg/cm2/s/", unit_at(FLUX_UNITS, header, self.primary))
        light = Values.of("flux", flux, unit)
        if not {"CRVAL1", "COEFF0", "PS1_0", "WAT2_001"} & {*header, *self.primary}:
            # The wavelengths may be the only column of a table with one row for each pixel.
            columns = [column for table in self.file.tables for column in self._columns(table)]
            axes = [column for column in columns if role_of(column.name).kind == "wavelength"]
            if len(fit := [axis for axis in axes if np.prod(axis.shape) == flux.shape[-1]]) == 1:
                wave = Values.of(fit[0].name, fit[0].numbers().ravel(), fit[0].unit)
                return self._table(number, [wave, light], notes=notes, row_names=names)
        wave, remarks = self.file.wavelengths(number)
        columns = [replace(wave, name="wavelength"), light]
        return self._table(number, columns, remarks=f"\n{wave.name}", notes=(*remarks, *notes), row_names=names)

    def _rows(self, hdu: Any) -> tuple[Any, tuple[str, ...], tuple[str, ...]]:
        """Return the fluxes of an image, the names of its rows if it has several, and a note."""
        header = hdu.header
        shape = [int(header.get(f"NAXIS{k + 1}", 0)) for k in range(int(header["NAXIS"]))]
        if sum(n > 1 for n in shape) > 2 or shape[0] < 2:
            fault = f"it contains an image of {' x '.join(map(str, shape))} pixels"
            raise InputError(f"{fault}; use a spectrum of one dimension, rows of spectra, or a table", key="table")
        flux = np.asanyarray(hdu.data).reshape(-1, shape[0])
        if len(flux) == 1:
            return flux[0], (), ()
        if self._is_survey_image(header):
            return flux[0], (), (f"the first of {len(flux)} rows is its flux",)
        # Bands of IRAF's `apall` are spectrum, raw, background and sigma.
        bands = shape[2] if len(shape) > 2 else shape[1]
        if not self.words and text_at(header, "BANDID1").lower().startswith("spectrum") and len(flux) == bands:
            return flux[0], (), (f"the first of {bands} bands (BANDID1) is its flux",)
        return flux, tuple(text_at(header, f"BANDID{k + 1}") for k in range(len(flux))), ()


def _spextool_orders(header: Any, data: Any) -> list[str] | None:
    """Return the names of the orders and apertures of Spextool's images, one for each; None for other images.

    Rows are wavelength, flux, error and, since 2014, flags (Cushing et al. 2004, PASP 116, 362; `mc_mkspexhdr.pro`).
    """
    if not {"NAPS", "NORDERS", "XUNITS", "YUNITS"} <= {*header} or np.ndim(data) < 2 or data.shape[-2] not in (3, 4):
        return None
    n, n_apertures = math.prod(data.shape[:-2]), int(header["NAPS"])
    orders = [word.strip() for word in text_at(header, "ORDERS").split(",")]
    if int(header["NORDERS"]) * n_apertures == n != len(orders) * n_apertures:
        # Merged orders are one, whatever their list says.
        orders = [str(k + 1) for k in range(int(header["NORDERS"]))]
    if len(orders) * n_apertures != n:
        fault = f"it must have a spectrum for each of {len(orders)} orders and {n_apertures} apertures (NAPS)"
        raise InputError(f"{fault}, but has {n}", key="NAPS")
    if n_apertures > 1:
        orders = [f"{order} aperture {k + 1}" for order in orders for k in range(n_apertures)]
    return orders


#: Largest number and length of messages in the table of a kept star, and length of the remarks on columns.
MAX_NOTES, MAX_NOTE_LENGTH, MAX_REMARKS = 20, 400, 20_000


def read_spectrum(
    path: Path,
    *,
    wavelength_unit: str | u.UnitBase | None = None,
    flux_unit: str | u.UnitBase | None = None,
    ignore_checksum: bool = False,
) -> ReadSpectrum:
    """Read a spectrum from text, ECSV, VOTable or FITS, which may be compressed by gzip, bzip2 or xz.

    The path may end in words that select one of several spectra: a column, ``grid.fits[g45]``, two columns, an
    extension, the identifier of a row, or ``row 3``. Text without stated units is in nm and erg s-1 cm-2 A-1 (the
    paper's rule), FITS in Angstrom and erg s-1 cm-2 A-1, which `ReadSpectrum.messages` reports; ECSV and VOTable must
    state their units. Given units override those of the file; one of wavelength may end in " air" or " vacuum". With
    `ignore_checksum`, a FITS file is read that its CHECKSUM or DATASUM contradicts.
    """
    file, words = without_columns(path)
    check_size(file, "spectrum file")
    title = file.name if len(file.name) <= 80 else shortened(file.name)
    try:
        # Overflows become infinities, which the check of points rejects.
        with (
            parsing("it", "give a spectrum"),
            open_content(file, "it", "spectrum file") as (form, content),
            np.errstate(all="ignore"),
        ):
            # The name without the extensions of compression and format.
            name = re.sub(r"\.(gz|bz2|xz)$", "", file.name, flags=re.I).rsplit(".", 1)[0][:80] or file.name
            origin = f"file {title}"
            if form == "FITS":
                hdus = open_fits(content, check=not ignore_checksum)
                with reading("it", WHOLE):
                    tables = _FitsReader(hdus, name, origin, words).tables()
            elif form == "VOTable":
                tables = []
                for number, table in enumerate(votables(content.read(), "it"), 1):
                    label = table.header.get("name") or table.header.get("ID") or number
                    tables.append(_in_memory(table, name, origin, str(label)))
            else:
                text = text_in(form, content.read(), "it")
                if form == "ECSV" or text_tables.is_described(text):
                    table = MemoryTable(text_tables.text_table(text, "it", commas=False), "it")
                    header_name = table.header.get("name")
                    name = (header_name.strip()[:80] if isinstance(header_name, str) else "") or name
                    tables = [_in_memory(table, name, origin)]
                else:
                    no_units = wavelength_unit is None, flux_unit is None
                    tables = [table_of_text(text, name, f"text {origin}", words, *no_units)]
            return convert_spectrum(select_spectrum(tables, words), wavelength_unit, flux_unit)
    except InputError as error:
        raise error.within(title) from error


def _in_memory(file: MemoryTable, name: str, origin: str, label: str = "") -> SpectrumTable:
    """Return the table of an ECSV file or a VOTable."""
    columns = [file.find(title) for title in file.names]
    remarks = [*_texts(file.header.get("comments")), *(f"{column.ucd} {column.description}" for column in columns)]
    return SpectrumTable(
        columns, name, origin, label, remarks="\n".join(remarks)[:MAX_REMARKS],
        headers=(file.header,), messages=_texts(file.header.get("told")),
    )  # fmt: skip


def _texts(entry: Any) -> tuple[str, ...]:
    """Return the short texts of a list; an empty tuple for anything else."""
    texts = entry[:MAX_NOTES] if isinstance(entry, list) else ()
    return tuple(text for text in texts if isinstance(text, str) and len(text) <= MAX_NOTE_LENGTH)
