"""Spectra in text, ECSV, VOTable and FITS, recognised by content instead of name.

The headers of spectra in text mix names and units of columns with prose. A line names columns if it has as many cells
as the data have columns, and names a wavelength and another known column; "vacuum wavelengths" over two columns is
prose.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.host.spectra.columns import AXES, Role, divided, is_unit, listed, role_of, words_of
from mauvecl.host.spectra.conversion import ReadSpectrum, SpectrumTable, converted, spectrum_in
from mauvecl.host.spectra.units import stated_units
from mauvecl.host.tables import fits_tables, text_tables
from mauvecl.host.tables.files import check_size, parsing, reading, without_columns
from mauvecl.host.tables.fits_tables import FLUX_UNITS, WAVE_UNITS, FitsTables, open_fits, text_at, unit_at
from mauvecl.host.tables.opening import Content, open_content, text_in, votables
from mauvecl.host.tables.table import MemoryTable, Values, number_in
from mauvecl.host.tables.text_tables import NumberLines, divided_names, keywords_of, text_table
from mauvecl.host.tables.units import is_stated, time_in_name
from mauvecl.schema.errors import InputError, shortened

if TYPE_CHECKING:
    import astropy.units as u

#: Units of a text file without stated units (the paper's rule).
TEXT_UNITS = ("nm", "erg / (s cm2 Angstrom)")
#: Gaia DR3's sampled mean spectra: 343 fluxes at 336 + 2 i nm (documentation of gaiadr3.xp_sampled_mean_spectrum).
GAIA_NM, GAIA_FLUX = 336.0 + 2.0 * np.arange(343), "W m-2 nm-1"


def table_of_text(
    text: str, name: str, origin: str, asked: Sequence[str], wavelength: bool, flux: bool
) -> SpectrumTable:
    """Read the table of a text file.

    The user's words in `asked` are the numbers of columns if these have no names. The units of wavelength and flux are
    searched in the header if requested.
    """
    lines = NumberLines(text, "wavelength and flux")
    if lines.holds_arrays:
        return _table_of_arrays(MemoryTable(text_table(text, "it", commas=True), "it"), name, origin)
    names, units = _names(lines)
    titles = names or [str(k + 1) for k in range(max(lines.n, 2))]
    columns = [lines.column(k, title, units[k] if units else "") for k, title in enumerate(titles)]
    roles = [role_of(one.name, one.unit) for one in columns] if names else _roles_by_number(lines, asked)
    if [one.name for one in columns[:2]] == ["wavelength", "flux"] and np.array_equal(columns[0].numbers(), GAIA_NM):
        roles = [replace(roles[0], unit="nm"), replace(roles[1], unit=GAIA_FLUX), *roles[2:]]
    roles = _with_units_of(lines.comments, roles, wavelength, flux, is_named=bool(names))
    keywords = keywords_of([f"# {line}" for line, _ in lines.header])
    return SpectrumTable(
        columns, name, origin, implied_units=TEXT_UNITS, remarks=lines.comments, messages=tuple(lines.messages),
        headers=(keywords,), known_roles=roles,
    )  # fmt: skip


def _roles_by_number(lines: NumberLines, asked: Sequence[str]) -> list[Role]:
    """Return the roles of columns without names: the first two are the spectrum, or those selected by the user."""
    n = lines.n
    indices = [int(one) - 1 for one in asked if one.isascii() and one.isdigit() and 1 <= int(one[:6]) <= n]
    if len(indices) != len(asked) or len(indices) > 2:
        raise InputError.of("columns", asked, f"their numbers, 1 to {n}")
    if not asked and n > 2:
        lines.messages.append(f"the first two of its {n} columns are used, which have no names")
    wave, value = indices if len(indices) == 2 else (0, *(indices or [1]))
    roles = {wave: Role("wavelength", 1), value: Role("flux", 1)}
    return [roles.get(k, Role("unknown")) for k in range(max(n, 2))]


def _with_units_of(remarks: str, roles: Sequence[Role], wavelength: bool, flux: bool, is_named: bool) -> list[Role]:
    """Return roles with units from remarks if the names and headers of columns state none."""
    # A column with an unknown name may be the flux if none is recognised.
    fluxes = ("flux", "model") if any(role.kind in ("flux", "model") for role in roles) else ("unknown",)
    has_axis = any(role.kind in AXES and role.unit for role in roles)
    has_flux = any(role.kind in fluxes and role.unit for role in roles)
    axis_unit, flux_unit = stated_units(
        remarks, wavelength=wavelength and not has_axis, flux=flux and not has_flux, is_named=is_named
    )
    units = [axis_unit if role.kind in AXES else flux_unit if role.kind in fluxes else None for role in roles]
    return [role if role.unit else replace(role, unit=unit) for role, unit in zip(roles, units, strict=True)]


def _table_of_arrays(file: MemoryTable, name: str, origin: str) -> SpectrumTable:
    """Return a table whose cells contain arrays, with a spectrum per row, as in Gaia's files."""
    columns = [_with_arrays(file.find(one)) for one in file.names]
    known = {column.name.lower(): column for column in columns}
    if not {"source_id", "flux"} <= {*known} or "wavelength" in known or known["flux"].shape[1:] != GAIA_NM.shape:
        return SpectrumTable(columns, name, origin, implied_units=TEXT_UNITS)
    columns = [known["source_id"], Values.of("wavelength", GAIA_NM, "nm"), replace(known["flux"], unit=GAIA_FLUX)]
    return SpectrumTable(
        columns, name, f"{origin}, Gaia DR3 sampled XP spectrum", row_title="Gaia DR3 {}",
        notes=("wavelengths 336 + 2 i nm, W m-2 nm-1: Gaia DR3's documentation",),
    )  # fmt: skip


def _with_arrays(column: Values) -> Values:
    """Return a column of texts such as ``(1.0, 2.0)`` as arrays, and others unchanged."""
    texts = column.cells.tolist()
    if not all(text[:1] in ("(", "[") for text in texts):
        return column
    rows = [np.array([number_in(one) for one in re.split(r"\s*,\s*|\s+", text.strip("()[] \t"))]) for text in texts]
    is_image = len({row.size for row in rows}) == 1
    return Values.of(column.name, np.array(rows) if is_image else np.array([*rows, None], object)[:-1], column.unit)


def _names(lines: NumberLines) -> tuple[list[str], list[str]]:
    """Return the names of columns and the units below them; empty if there are none."""
    # Lines such as "column 2: flux"; columns without such a line are named by number.
    found = text_tables.numbered_names((line for line, _ in lines.header), lines.n)
    numbered = [found.get(k, str(k + 1)) for k in range(lines.n)]
    if len(found) > 1 and _recognised(numbered):
        return numbered, []
    rows = {k: cells for k, (line, _) in enumerate(lines.header) if (cells := divided_names(line, lines.n))}
    # The last of the lines that name most columns.
    score, k = max(((_recognised(cells), k) for k, cells in rows.items()), default=(0, 0))
    if score > 0:
        return rows[k], _units(lines, k)
    unmarked = [k for k, (line, is_comment) in enumerate(lines.header) if not is_comment and line]
    if len(unmarked) == 1 and _may_name(lines.header[unmarked[0]][0], cells := rows.get(unmarked[0], [])):
        return cells, _units(lines, unmarked[0])
    return _of_another_length(lines), []


def _may_name(line: str, cells: Sequence[str]) -> bool:
    """Return whether the only line that is no comment names columns, some of them unknown."""
    is_marked = bool(re.search(r"[,;|\t]", line.strip()))
    kinds = {role_of(cell).kind for cell in cells}
    if len(cells) == 2:
        # A light curve has no wavelengths.
        is_time = any(
            cell.lower() == "phase" or time_in_name(f"time {cell}") or "time" in words_of(cell) for cell in cells
        )
        return is_marked and (bool(kinds & set(AXES)) or is_time)
    return is_marked or (kinds > {"unknown"} and all(re.match(r"[^\W\d]", cell) for cell in cells))


def _recognised(cells: Sequence[str]) -> int:
    """Count the cells that name a spectrum's columns; 0 without a wavelength and another column."""
    kinds = [role_of(cell).kind for cell in cells]
    is_named = any(kind in AXES and not is_unit(cell) for cell, kind in zip(cells, kinds, strict=True))
    # "resolution 5 nm" does not name columns; "nm error flux" does.
    others = {*kinds} - {*AXES, "unknown"} if is_named else {*kinds} & {"flux", "model", "magnitude", "counts"}
    if not others or not {*kinds} & {*AXES}:
        return 0
    # Names have precedence over the units below them.
    return sum(1 if is_unit(cell) else 2 for cell, kind in zip(cells, kinds, strict=True) if kind != "unknown")


def _units(lines: NumberLines, names_at: int) -> list[str]:
    """Return the cells of the line of units below the names, if any; IPAC tables have types in between."""
    for k, (line, _) in enumerate(lines.header[names_at + 1 : names_at + 3]):
        cells = divided_names(line, lines.n)
        is_all = any(is_unit(cell) for cell in cells) and all(is_unit(c) or not is_stated(c) for c in cells)
        # "A star" is not a unit, and "nm banana" contains an unknown unit.
        is_some = any(len(cell) > 1 and is_unit(cell) for cell in cells) and not any(c.endswith(":") for c in cells)
        if is_all or (k == 0 and is_some):
            return cells
    return []


def _of_another_length(lines: NumberLines) -> list[str]:
    """Return the names of a line with fewer cells than the rows, for the columns from the left.

    Raises InputError if a line that is no comment has another number of names than columns.
    """
    for line, is_comment in reversed(lines.header):
        cells = [cell.strip("\"' ") for cell in re.split(r"[,;\t|]", line)]
        cells = cells if len(cells) > 1 else text_tables.bracketed(line)
        if not all(cells) or text_tables.PROSE.search(line) or not 1 < len(cells) <= lines.n + 8:
            continue
        kinds = [role_of(cell).kind if words_of(divided(cell)[0]) else "unknown" for cell in cells]
        if "flux" not in kinds or not any(kind in AXES for kind in kinds):
            continue
        is_plain = set(kinds) <= {"wavelength", "flux", "unknown"} and not any(role_of(c).logarithm for c in cells)
        in_order = is_plain and kinds.index("flux") > kinds.index("wavelength")
        if is_comment and len(cells) < lines.n:
            lines.messages.append(
                f"its {len(cells)} names ({listed(cells)}) are those of the first of {lines.n} columns"
            )
            return [*cells, *(str(k + 1) for k in range(len(cells), lines.n))]
        if not is_comment or not in_order:
            fault = f"its line of names has {len(cells)} ({listed(cells)}) for {lines.n} columns"
            raise InputError(f"{fault}, but needs one for each", key="columns")
    return []


#: Units implied by the archives' tables, those of CALSPEC.
FITS_UNITS = ("Angstrom", "erg / (s cm2 Angstrom)")
#: Keywords whose text may mention air, vacuum, the star's surface or its dust.
_REMARKS = ("COMMENT", "HISTORY", "DESCRIP")


class _Reader:
    """Reader of the tables of an open FITS file, including images of spectra."""

    def __init__(self, hdus: Any, name: str, origin: str, asked: Sequence[str]) -> None:
        self.hdus, self.name, self.origin, self.asked = hdus, name, origin, asked
        self.file = FitsTables(hdus, "it")
        self.primary = hdus[0].header

    def tables(self) -> list[SpectrumTable]:
        """Return the tables that may have the spectrum; raise InputError if there is none."""
        pairs = fits_tables.paired_images(self.hdus)
        if pairs:
            rows = self._row_names()
            return [self._of_pair(*pair, rows) for pair in pairs]
        tables = [self._of_table(number, self.hdus[number]) for number in self.file.tables]
        if fits_tables.is_survey_image(self.hdus[0], text_at(self.primary, "TELESCOP")):
            # SDSS keeps lines and redshifts of the spectrum in tables.
            return [self._of_image(0, self.hdus[0])]
        kinds = [{role.kind for role in table.roles} for table in tables]
        images, errors = self._images()
        labels = {image.label.strip().lower() for image in images}
        named = labels & {word.lower() for word in self.asked}
        if any("flux" in kind and kind & {"wavelength", "lower edge"} for kind in kinds) and not named:
            return tables
        is_bare = not any(kind & {"flux", "model", "magnitude"} for kind in kinds)
        if errors and not images and (not tables or (is_bare and not self.asked)):
            raise errors[0]
        if not tables and not images:
            raise InputError("it has no table and no image; give a table with WAVELENGTH and FLUX", key="table")
        if images and not self.asked and is_bare:
            # A table of wavelengths, of lines or of a log is no spectrum.
            return images
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
            FITS_UNITS,
            remarks=self._remarks(header) + more.pop("remarks", ""),
            headers=(self.primary, header),
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
        stated = {key: text_at(self.primary, key) or text_at(header, key) for key in ("DATAQUAL", "OFFSETPX")}
        notes = [f"{key} = {text[:60]}" for key, text in stated.items() if text]
        if "lowlib" in self.origin.lower():
            notes.append("dereddened and at zero velocity: counts need it reddened again")
        return tuple(notes)

    def _of_table(self, number: int, hdu: Any) -> SpectrumTable:
        header = hdu.header
        # The units of the file apply to columns that state none (SDSS).
        flux, wave = (unit_at(keys, self.primary, header) for keys in (FLUX_UNITS, WAVE_UNITS))
        whole = dict.fromkeys(("flux", "model"), flux) | dict.fromkeys(AXES, wave)
        columns = []
        for column in self._columns(number):
            role = role_of(column.name)
            own = column.unit or role.unit
            columns.append(column if own else replace(column, unit=whole.get(role.kind, "")))
        ucds = " ".join(column.ucd for column in columns if column.ucd)
        return self._table(header, columns, self._label(number, hdu), remarks=f"\n{ucds}")

    def _columns(self, number: int) -> list[Values]:
        found = [self.file.column(number, str(title)) for title in self.hdus[number].columns.names]
        return [one for one in found if one is not None]

    def _images(self) -> tuple[list[SpectrumTable], list[InputError]]:
        """Return the images with an axis of wavelengths, and the faults of others."""
        images, errors = [], []
        for number, hdu in enumerate(self.hdus):
            if fits_tables.is_spectrum_image(hdu):
                try:
                    images.append(self._of_image(number, hdu))
                except InputError as error:
                    errors.append(error)
        flux = [one for one in images if one.label.strip().lower() in ("flux", "sci", "spectrum")]
        return (flux if flux and not self.asked else images), errors

    def _axis_beside(self, n: int) -> Values | None:
        """Return the only column of wavelengths in a table that has one for each of `n` pixels, or None."""
        held = [one for number in self.file.tables for one in self._columns(number)]
        axes = [one for one in held if role_of(one.name).kind == "wavelength" and np.prod(one.shape) == n]
        return Values.of(axes[0].name, axes[0].numbers().ravel(), axes[0].unit) if len(axes) == 1 else None

    def _of_image(self, number: int, hdu: Any) -> SpectrumTable:
        header = hdu.header
        if (found := fits_tables.spextool_spectra(header, hdu.data)) is not None:
            wave, light, orders = found
            columns = [Values.of("wavelength", wave if len(wave) > 1 else wave[0], text_at(header, "XUNITS")),
                       Values.of("flux", light if len(light) > 1 else light[0], text_at(header, "YUNITS"))]  # fmt: skip
            if int(header["NAPS"]) == 1:
                columns.append(Values.of("order", np.array(orders)))
            return self._table(header, columns, self._label(number, hdu), row_names=orders)
        flux, names, note = fits_tables.rows_of(hdu, text_at(self.primary, "TELESCOP"), bool(self.asked))
        is_bare = not {"CRVAL1", "COEFF0", "PS1_0", "WAT2_001"} & {*header, *self.primary}
        axis, remarks = self._axis_beside(flux.shape[-1]) if is_bare else None, ""
        if axis is None:
            own, notes = self.file.wavelengths(number)
            axis, note, remarks = replace(own, name="wavelength"), (*notes, *note), f"\n{own.name}"
        # SDSS-I/II writes erg/cm/s/Ang for erg/cm2/s/Ang.
        flux_unit = re.sub(r"erg/cm/s/", "erg/cm2/s/", unit_at(FLUX_UNITS, header, self.primary))
        columns = [axis, Values.of("flux", flux, flux_unit)]
        return self._table(header, columns, self._label(number, hdu), remarks=remarks, notes=note, row_names=names)

    def _of_pair(self, arm: str, axis: Any, flux: Any, rows: Sequence[str]) -> SpectrumTable:
        """Return the table of an image of fluxes whose wavelengths are in another image (DESI, PFS, APOGEE)."""
        name = text_at(axis.header, "EXTNAME").removeprefix(f"{arm}_")
        columns = [replace(self.file.image(self.hdus.index(hdu)), name=title)
                   for hdu, title in ((axis, name), (flux, "flux"))]  # fmt: skip
        group = "arms" if arm else None
        return self._table(flux.header, columns, arm or "flux", row_names=rows, group=group)

    def _row_names(self) -> tuple[str, ...]:
        """Return the targets of the rows of images, from a fibre map (DESI data model, coadd: FIBERMAP)."""
        found = self.file.named("FIBERMAP/TARGETID")
        return () if found is None else tuple(map(str, found.cells.tolist()))


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
    place, asked = without_columns(path)
    check_size(place, "spectrum file")
    shown = place.name if len(place.name) <= 80 else shortened(place.name)
    units = (wavelength_unit is None, flux_unit is None)
    try:
        # Overflows become infinities, which the check of points rejects.
        with (
            parsing("it", "give a spectrum"),
            open_content(place, "it", "spectrum file") as content,
            np.errstate(all="ignore"),
        ):
            # The name without the extensions of compression and format.
            stem = re.sub(r"\.(gz|bz2|xz)$", "", place.name, flags=re.I).rsplit(".", 1)[0][:80]
            tables = _tables(content, stem or place.name, f"file {shown}", asked, units, not ignore_checksum)
            return converted(spectrum_in(tables, asked), wavelength_unit, flux_unit)
    except InputError as error:
        raise error.within(shown) from error


def _tables(
    content: Content, name: str, origin: str, asked: Sequence[str], units: tuple[bool, bool], check: bool
) -> list[SpectrumTable]:
    if content.form == "FITS":
        hdus = open_fits(content.file, check=check)
        with reading("it", fits_tables.WHOLE):
            return _Reader(hdus, name, origin, asked).tables()
    if content.form == "VOTable":
        tables = enumerate(votables(content.bytes, "it"), 1)
        return [_in_memory(one, name, origin, str(one.header.get("name") or one.header.get("ID") or number))
                for number, one in tables]  # fmt: skip
    text = text_in(content, "it")
    if content.form == "ECSV" or text_tables.is_described(text):
        table = MemoryTable(text_table(text, "it", commas=False), "it")
        own = table.header.get("name")
        return [_in_memory(table, own.strip()[:80] if isinstance(own, str) and own.strip() else name, origin)]
    return [table_of_text(text, name, f"text {origin}", asked, *units)]


def _in_memory(file: MemoryTable, name: str, origin: str, label: str = "") -> SpectrumTable:
    """Return the table of an ECSV file or a VOTable."""
    columns = [file.find(one) for one in file.names]
    said = [f"{one.ucd} {one.description}" for one in columns]
    return SpectrumTable(
        columns, name, origin, label, remarks="\n".join((*_texts(file.header.get("comments")), *said))[:MAX_REMARKS],
        headers=(file.header,), messages=_texts(file.header.get("told")),
    )  # fmt: skip


def _texts(given: Any) -> tuple[str, ...]:
    """Return the short texts of a list; an empty tuple for anything else."""
    held = given[:MAX_NOTES] if isinstance(given, list) else ()
    return tuple(one for one in held if isinstance(one, str) and len(one) <= MAX_NOTE_LENGTH)
