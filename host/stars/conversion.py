"""Spectra of tables: selection of one, and conversion to wavelengths in vacuum and flux densities.

Users select with ``FILE[word, ...]``: a table by its label, columns by their names, and a row by its identifier if the
cells of a table contain entire spectra.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import astropy.units as u
import numpy as np

from mauvecl.host.arrays import Float
from mauvecl.host.stars.columns import Role, choose, flux_kind, index_of, is_spectral, join, linear, role_of, selector
from mauvecl.host.stars.spectrum import FLUX_UNIT, check_assumed_unit
from mauvecl.host.tables.names import divided_unit, key_of
from mauvecl.host.tables.table import Values, ends_of, marks_in, without_indefinite
from mauvecl.host.tables.units import Medium, is_stated, unit_and_medium, unit_of, vacuum_wavelengths
from mauvecl.schema.errors import InputError

UNKNOWN = Role("", "unknown")


@dataclass(frozen=True)
class SpectrumTable:
    """Table of a file with its metadata."""

    columns: Sequence[Values]
    name: str
    origin: str
    label: str = ""  # name by which users select it among the tables of a file
    #: Units of wavelength and flux that the format implies if none is stated.
    implied_units: tuple[str | None, str | None] = (None, None)
    remarks: str = ""  # text of the header that may mention air, the star's surface or its dust
    headers: Sequence[Mapping[str, Any]] = ()  # whose keywords may state the medium of the wavelengths
    notes: tuple[str, ...] = ()
    messages: tuple[str, ...] = ()
    group: str | None = None  # tables of the same group are parts of one spectrum
    unscaled: str = ""  # reason why fluxes need a magnitude; empty if they are those at the telescope
    row_names: Sequence[str] = ()  # identifiers of its rows, if stored in another table
    row_title: str = ""  # format of a spectrum's name from the identifier of its row, as in ``Gaia DR3 {}``
    known_roles: Sequence[Role] = ()  # roles of the columns, if known from more than their names, units and descriptors
    #: Of the selected spectrum: wavelengths and fluxes of each segment, shape (n,) each, and the roles of both.
    segments: Sequence[tuple[Float, Float]] = ()
    axis: Role = UNKNOWN
    light: Role = UNKNOWN

    @property
    def roles(self) -> Sequence[Role]:
        """Roles of the columns."""
        return self.known_roles or [role_of(column.name, column.unit, column.ucd) for column in self.columns]


#: Names of columns that qualify arrays: their step, their length, and the validity of points.
STEPS = ("deltaw", "delta_w", "delta_wavelength", "step", "dlam", "dlambda")
#: Number, from 1, of the first valid point, to which a start refers (IUE's high dispersion, NEWSIPS manual 2.0).
STARTS = ("startpix",)
LENGTHS = ("npoints", "n_points", "nelem", "npts")
#: Zero for invalid points (COS Data Handbook 5.1, section 2.4.3).
WEIGHTS = ("dq_wgt",)


def select_spectrum(tables: Sequence[SpectrumTable], words: Sequence[str]) -> SpectrumTable:
    """Return the table with the spectrum of a file, or with the one of several that the user's words select."""
    if not tables:
        raise InputError("it has no table and no image, but needs one with a wavelength and a flux", key="table")
    labels = [table.label.strip().lower() for table in tables]
    selected: list[int] = []
    of_columns_and_rows: list[str] = []
    for word in words:
        index = index_of("table", word, len(tables))
        matches = [i for i, label in enumerate(labels) if label == word.lower()] if index is None else [index]
        selected += matches
        of_columns_and_rows += [] if matches else [word]
    spectra: list[SpectrumTable] = []
    errors: list[InputError] = []
    for table in [tables[i] for i in dict.fromkeys(selected)] or tables:
        try:
            spectra.append(_spectrum_of(table, of_columns_and_rows))
        except InputError as error:
            errors.append(error)
    if errors and any(spectrum.group for spectrum in spectra):
        # A missing part would go unnoticed.
        raise errors[0]
    if not spectra:
        # A message that offers a choice is the most helpful.
        raise next((error for error in errors if "FILE[" in str(error)), errors[0])
    if not selected:
        # SDSS: the sum of all exposures, next to each of them.
        spectra = [spectrum for spectrum in spectra if spectrum.label.strip().lower() == "coadd"] or spectra
        # A legend beside the spectrum has no column of fluxes.
        spectra = [spectrum for spectrum in spectra if spectrum.light.kind == "flux"] or spectra
    first = spectra[0]
    if len(spectra) == 1:
        return first
    titles = [spectrum.label for spectrum in spectra]
    if first.group is not None and len({spectrum.group for spectrum in spectra}) == 1:
        segments = [segment for spectrum in spectra for segment in spectrum.segments]
        message = f"its parts {join(titles)} are joined"
        return replace(first, segments=segments, messages=(*first.messages, message))
    example = selector(titles[0], "table", labels.index(titles[0].strip().lower()), labels)
    raise InputError(f"{len(titles)} tables have a spectrum: {join(titles)}; give one as in {example}", key="table")


def _spectrum_of(table: SpectrumTable, words: Sequence[str]) -> SpectrumTable:
    """Return a table with the spectrum, and its segments, in the columns and the row that the user's words select."""
    roles = table.roles
    names = [role.name for role in roles]
    columns = {key_of(name) for name in names} | {key_of(f"column {i + 1}") for i in range(len(names))}
    # Words that do not name a column may name a row.
    of_rows = [word for word in words if key_of(word) not in columns]
    try:
        axes, light = choose(roles, [word for word in words if key_of(word) in columns])
    except InputError as error:
        raise (_no_such(of_rows[0], names) if of_rows else error) from error
    messages = list(table.messages)
    if len(axes) == 2:
        edges = " and ".join(names[i] for i in axes)
        if len({roles[i].unit for i in axes}) > 1:
            raise InputError.of("wavelength_unit", edges, "one unit")
        messages.append(f"its wavelengths are the middles of bins, from {edges}")
    cells = [table.columns[i].cells for i in (*axes, light)]
    rows = [cells]
    if np.ndim(cells[-1]) > 1 or any(np.ndim(cell) > 0 for cell in cells[-1][:1]):
        rows, identifier = _selected_rows(table, {*axes, light}, cells, of_rows, messages)
        if table.row_title and identifier:
            table = replace(table, name=table.row_title.format(identifier[:30]))
    elif of_rows:
        raise _no_such(of_rows[0], names)
    segments = []
    for row in rows:
        *waves, flux = (_numbers(cell, names[i].strip()) for cell, i in zip(row, (*axes, light), strict=True))
        if flux.ndim != 1 or waves[0].shape != flux.shape:
            fault = f"it needs one spectrum with as many wavelengths as fluxes, but has {waves[0].shape} for"
            raise InputError(f"{fault} {flux.shape}", key="flux")
        segments.append((sum(waves[1:], waves[0]) / len(waves), flux))
    if sum(flux.size for _, flux in segments) < 2:
        raise InputError("it must have at least two points to be a spectrum", key="flux")
    return replace(table, segments=segments, axis=roles[axes[0]], light=roles[light], messages=tuple(messages))


def _numbers(cells: Any, name: str) -> Float:
    """Return cells as numbers; NaN for missing measurements."""
    if np.asanyarray(cells).dtype.kind == "b":
        raise InputError(f"{name} must contain real numbers, not true and false", key=name)
    return without_indefinite(Values.of(name, cells, label="its table").numbers())


def _no_such(word: str, names: Sequence[str]) -> InputError:
    """Return the error for a word that does not name anything in the file."""
    return InputError.of("columns", word, f"one of {join(names)}")


def _selected_rows(
    table: SpectrumTable, chosen: set[int], cells: list[Any], words: Sequence[str], messages: list[str]
) -> tuple[list[list[Any]], str]:
    """Return the selected row of the chosen columns and its name, or all if they are segments of one spectrum."""
    n, shape = len(cells[-1]), np.shape(cells[-1])
    if len(shape) == 2:
        # One array of wavelengths applies to all rows of fluxes.
        cells = [np.broadcast_to(cell, shape) if np.shape(cell) == shape[1:] else cell for cell in cells]
    if len({len(cell) for cell in cells}) > 1:
        raise InputError(f"it needs {n} rows of wavelengths, as many as of fluxes, not {len(cells[0])}", key="flux")
    columns = {key_of(column.name): column for column in reversed(table.columns)}
    identifiers = _identifiers(table, chosen, n)
    identifier = ""
    if n > 1 and not words and {*columns} & {"segment", "sporder", "order", "stripe"}:
        # The segments of a detector, or echelle orders.
        rows = list(range(n))
        labels = [(identifiers[row] or [str(row + 1)])[0] for row in rows]
        messages.append(f"its {n} segments ({join(labels)}) are joined")
    else:
        rows = [_selected_row(identifiers, words, [*columns])]
        identifier = (identifiers[rows[0]] or [""])[0]
    spectra = []
    for row in rows:
        step, start, length, weight = (
            next((columns[name].cells[row] for name in names if name in columns), None)
            for names in (STEPS, STARTS, LENGTHS, WEIGHTS)
        )
        first = 0 if start is None else max(0, int(np.ravel(start)[0]) - 1)
        arrays = _arrays([cell[row] for cell in cells], step, first)
        valid = np.arange(arrays[-1].size) >= first
        if length is not None and 1 < (count := int(np.ravel(length)[0])) < valid.size:
            valid[first + count :] = False
        if weight is not None and np.shape(weight) == valid.shape:
            valid &= np.asarray(weight) != 0
        if valid.any():
            spectra.append([array[valid] for array in arrays])
    if not spectra:
        raise InputError("its rows contain no valid point, but need at least one", key="rows")
    return spectra, identifier


def _arrays(cells: list[Any], step: Any, first: int) -> list[Any]:
    """Return a row's cells as arrays of equal length; a step and the start, at point `first`, are expanded."""
    *axes, flux = (np.ma.asanyarray(cell).squeeze() for cell in cells)
    if flux.ndim == 1 and axes[0].size == 1 < flux.size and step is not None:
        axes = [float(axes[0]) + float(np.ravel(step)[0]) * (np.arange(flux.size) - first)]
    if flux.ndim != 1 or any(axis.shape != flux.shape for axis in axes):
        fault = f"its row needs as many wavelengths as fluxes, or a step, but has {axes[0].shape} for {flux.shape}"
        raise InputError(fault, key="flux")
    return [*axes, flux]


def _identifiers(table: SpectrumTable, without: set[int], n: int) -> list[list[str]]:
    """Return the possible names of each row: its short texts and integers, the most specific first."""
    columns = [list(table.row_names)] if len(table.row_names) == n else []
    for i, column in enumerate(table.columns):
        if i in without:
            continue
        values = column.cells
        if np.shape(values) == (n,) and np.asarray(values).dtype.kind in "SUiuO" and np.ndim(values[0]) == 0:
            columns.append(column.texts() or [str(value) for value in values])
    columns.sort(key=lambda texts: len(set(texts)) < n)
    return [[texts[row] for texts in columns] for row in range(n)]


def _selected_row(identifiers: Sequence[Sequence[str]], words: Sequence[str], names: Sequence[str]) -> int:
    """Return the selected row: the only one, the one with the requested identifier, or ``row 3``."""
    fitting = list(range(len(identifiers)))
    for word in words:
        index = index_of("row", word, len(identifiers))
        fitting = [row for row in fitting if (word.strip() in identifiers[row] if index is None else row == index)]
        if not fitting:
            raise _no_such(word, names)
    if len(fitting) == 1:
        return fitting[0]
    numbers = [f"row {row + 1}" for row in fitting]
    labels = [(identifiers[row] or [""])[0] or number for row, number in zip(fitting, numbers, strict=True)]
    labels = labels if len(set(labels)) == len(labels) else numbers
    fault = f"it contains {len(fitting)} spectra, one in each row ({join(labels)})"
    raise InputError(f"{fault}; give one as in {selector(labels[0], 'row', fitting[0], labels)}", key="rows")


#: Range of decimal logarithms of any wavelength in nm, Angstrom, um or Hz, and of any flux.
LOG_WAVELENGTHS, LOG_FLUXES = (-2.0, 20.0), (-60.0, 60.0)
#: Range of values without a unit that are more likely magnitudes than fluxes.
LIKELY_MAGNITUDES = (2.0, 40.0)
_THROUGHPUT = re.compile(
    r"throughput|transmission|transmittance|passband|bandpass|filter\s+(?:curve|profile)", re.IGNORECASE
)


@dataclass(frozen=True, eq=False)
class ReadSpectrum:
    """Spectrum in vacuum nm and erg s-1 cm-2 A-1, with the metadata of its file."""

    wavelength_nm: Float  # shape (n,)
    flux_flam: Float  # shape (n,)
    name: str
    origin: str
    notes: tuple[str, ...] = ()  # remarks for run records
    messages: tuple[str, ...] = ()  # assumptions, conversions and mergers, which answers must report
    #: Reason why the flux is not that at the telescope, so that a magnitude is needed; otherwise empty.
    unscaled: str = ""
    #: Unit of the wavelengths in the file; empty for arrays.
    axis_unit: str = ""


def convert_spectrum(table: SpectrumTable, wavelength_unit: Any, flux_unit: Any) -> ReadSpectrum:
    """Convert the spectrum of a table; given units override its own; one of wavelength may end in "air" or "vacuum"."""
    messages = list(table.messages)
    medium: Medium | None = None
    if isinstance(wavelength_unit, str):
        wavelength_unit, medium = unit_and_medium(wavelength_unit)
    axis_unit, in_unit = unit_and_medium(table.axis.unit or "")
    implied, implied_flux = table.implied_units
    axis, is_assumed = _scale("wavelength", replace(table.axis, unit=axis_unit), wavelength_unit, implied, messages)
    light, is_assumed_flux = _scale("flux", table.light, flux_unit, implied_flux, messages)
    waves, fluxes = (np.concatenate(arrays) for arrays in zip(*table.segments, strict=True))
    wavelengths = axis(waves)
    if is_assumed:
        check_assumed_unit(wavelengths.value, str(wavelengths.unit))
    marks, remarks = marks_in(Values.of("flux", fluxes), ends_of(fluxes), "flux", "fluxes")
    messages += remarks
    segments = []
    for values, flux in table.segments:
        unmarked = np.where(np.isin(flux, marks), np.nan, flux)
        nm = np.asarray(axis(values).to_value(u.nm, u.spectral()), np.float64)
        bad = np.flatnonzero(~np.isfinite(nm))
        if bad.size and (bad.size == nm.size or np.isfinite(unmarked[bad]).any()):
            raise InputError.of("wavelength", nm[bad[0]], "a finite number", where=f"point {bad[0] + 1}")
        # A row without wavelength or flux is not a point.
        nm, unmarked = np.delete(nm, bad), np.delete(unmarked, bad)
        # Fluxes per frequency or photon refer to wavelengths in vacuum.
        nm, added = vacuum_wavelengths(nm, table.axis.name, table.remarks, medium or in_unit, table.headers)
        order = slice(None, None, -1 if nm.size > 1 and nm[0] > nm[-1] else 1)
        flam = np.asarray(light(unmarked).to_value(FLUX_UNIT, u.spectral_density(u.Quantity(nm, u.nm))), np.float64)
        segments.append((nm[order], flam[order]))
    nm, flam = _join_segments(segments, messages)
    if is_assumed_flux:
        _check_assumed_flux(flam, f"{table.remarks}\n{table.origin}")
    messages += added
    nm, flam = _merge_points(nm, flam, messages)
    unscaled, notes = table.unscaled, table.notes
    if re.search(r"surface\s+flux", table.remarks, re.I):
        unscaled = unscaled or "its header states that it is the flux at the star's surface"
    if re.search(r"dereddened", table.remarks, re.I) and not any("dereddened" in note for note in notes):
        notes += ("dereddened, as its header states: counts need it reddened again",)
    return ReadSpectrum(nm, flam, table.name, table.origin, notes, tuple(messages), unscaled, str(wavelengths.unit))


#: Conversion of a column's numbers to quantities on a linear scale.
Scale = Callable[[Float], u.Quantity]


def _scale(quantity: str, role: Role, user_unit: Any, implied: str | None, messages: list[str]) -> tuple[Scale, bool]:
    """Return the scale of a column, and whether its unit is assumed: neither the user's nor stated by the file."""
    unit = _stated_unit(quantity, role, user_unit, messages)
    is_bare_logarithm = str(unit) in ("dex", "dex(1)")
    is_assumed = unit is None or is_bare_logarithm
    if is_assumed:
        if implied is None:
            usual = "nm" if quantity == "wavelength" else "erg / (s cm2 Angstrom)"
            fault = f"column {role.name} names no unit; use `{quantity}_unit` to give one such as {usual}"
            raise InputError(fault, key=f"{quantity}_unit")
        # Logarithms of wavelength are of Angstrom everywhere (SDSS, LAMOST, DESI).
        is_logarithm = is_bare_logarithm or role.logarithm
        per_frequency = quantity == "flux" and role.per_frequency
        is_angstrom = quantity == "wavelength" and is_logarithm
        unit = unit_of("Angstrom" if is_angstrom else "fnu" if per_frequency else implied)
        reason = f", and {role.name} is one per frequency" if per_frequency else ""
        suffix = divided_unit(role.name)[1]
        reason += f" ({suffix!r} in the name of its column is not one)" if suffix and not is_bare_logarithm else ""
        assumed = f"ASSUMED: {quantity} in {unit}, because its file states no unit{reason}"
        messages.append(f"{assumed}; --{quantity}-unit names another")
    if quantity == "flux":
        _check_flux_unit(unit, role)
    elif not is_spectral(unit):
        raise InputError.of("wavelength_unit", str(unit), "a length or a frequency")
    base = role.logarithm or ("10" if is_bare_logarithm or str(unit).startswith("dex") else "")
    to_linear: Callable[[Float], Float] = np.asarray
    if base:
        values, limits = ("wavelengths", LOG_WAVELENGTHS) if quantity == "wavelength" else ("fluxes", LOG_FLUXES)
        power = "e" if base == "e" else "ten"
        messages.append(f"its {values} are logarithms ({role.name}), raised to powers of {power}")
        to_linear = partial(_power, base=base, limits=limits, column=role.name)
    elif unit is not linear(unit):
        messages.append(f"its magnitudes ({unit}) are converted to fluxes")
        to_linear = unit.to_physical
    return (lambda numbers: u.Quantity(to_linear(numbers), linear(unit))), is_assumed


def _stated_unit(quantity: str, role: Role, user_unit: Any, messages: list[str]) -> Any:
    """Return the user's unit, with a message if it contradicts the file; else that of the file, or None."""
    try:
        if user_unit is None:
            return unit_of(role.unit) if role.unit is not None and is_stated(role.unit) else None
        unit = unit_of(user_unit) if isinstance(user_unit, str) else user_unit
    except InputError as error:
        raise error.within(f"{quantity} ({role.name})") from error
    with contextlib.suppress(InputError):
        if not is_stated(role.unit) or unit_of(str(role.unit)) == unit:
            return unit
    messages.append(f"the unit of its {quantity} is {unit} as requested, not {role.unit!s:.40} as its file states")
    return unit


def _power(values: Float, base: str, limits: tuple[float, float], column: str) -> Float:
    """Return the values whose logarithms a column holds; raises InputError if they cannot be logarithms."""
    logarithms = values * np.log10(np.e) if base == "e" else values
    finite = logarithms[np.isfinite(logarithms)]
    # Linear fluxes under a wrong name are all but zero.
    if finite.size and (finite.min() < limits[0] or finite.max() > limits[1] or np.abs(finite).max() < 1e-3):
        low, high = values[np.isfinite(values)].min(), values[np.isfinite(values)].max()
        fault = f"column {column} is named as a logarithm and has values from {low:g} to {high:g}"
        raise InputError(f"{fault}, but must have logarithms from {limits[0]:g} to {limits[1]:g}", key=column)
    return np.asarray(10.0**logarithms)


def _check_flux_unit(unit: Any, role: Role) -> None:
    """Raise InputError unless a unit is that of a flux density, or of a flux if the name of its column says so."""
    kind, usual = flux_kind(unit), "such as erg / (s cm2 Angstrom)"
    fault = ""
    if kind == "other":
        raise InputError.of("flux_unit", str(unit), f"one {usual}")
    if kind == "total" and not role.total:
        fault = f"the unit {unit} is not a flux density (it is not per wavelength or frequency)"
        fault += f"; use one {usual}, or a column whose name means lambda F_lambda, such as lamFlam"
    elif kind == "density" and role.total:
        fault = f"the column's name means lambda F_lambda and its unit {unit} a flux density, but they must agree"
    elif kind == "surface brightness":
        fault = f"the unit {unit} is per solid angle; use the flux of the whole star, {usual}"
    if fault:
        raise InputError(fault, key="flux_unit")


def _join_segments(segments: list[tuple[Float, Float]], messages: list[str]) -> tuple[Float, Float]:
    """Join segments in order of wavelength; overlaps are cut in the middle."""
    segments = sorted((s for s in segments if s[0].size), key=lambda segment: (segment[0][0], segment[0][-1]))
    nm, flux = segments[0]
    for more, added in segments[1:]:
        if more[-1] <= nm[-1]:
            fault = f"a segment of {more[0]:g}-{more[-1]:g} nm lies within another, which ends at {nm[-1]:g} nm"
            raise InputError(f"{fault}; give one of them by its name, as in FILE[name]", key="table")
        if more[0] <= nm[-1]:
            middle = (more[0] + nm[-1]) / 2
            messages.append(f"two segments overlap at {more[0]:g}-{nm[-1]:g} nm and are cut at {middle:g} nm")
            below, above = nm <= middle, more > middle
            nm, flux, more, added = nm[below], flux[below], more[above], added[above]
        nm, flux = np.append(nm, more), np.append(flux, added)
    return nm, flux


def _check_assumed_flux(flux: Float, remarks: str) -> None:
    """Raise InputError if numbers of an assumed unit are more likely magnitudes or, as remarks say, a throughput."""
    finite = flux[np.isfinite(flux)]
    if not finite.size:
        return
    low, high = float(finite.min()), float(finite.max())
    mention = _THROUGHPUT.search(remarks.replace("_", " "))
    if low >= LIKELY_MAGNITUDES[0] and high <= LIKELY_MAGNITUDES[1]:
        fault = f"fluxes of {low:g} to {high:g} without a unit look like magnitudes, but must be a flux density"
    elif mention and low >= 0.0 and 1e-3 <= high <= 1.0:
        fault = f"values of {low:g} to {high:g} without a unit and the word {mention[0]!r} suggest a throughput"
        fault += ", but must be a star's flux"
    else:
        return
    raise InputError(f"{fault}: `flux_unit` names its unit", key="flux_unit")


def _merge_points(nm: Float, flux: Float, messages: list[str]) -> tuple[Float, Float]:
    """Merge points of equal wavelength into one with their mean flux."""
    if nm.size < 2 or (np.diff(nm) > 0).all() or (np.diff(nm) < 0).any():
        return nm, flux
    distinct, first, count = np.unique(nm, return_index=True, return_counts=True)
    total = np.add.reduceat(flux, first)
    least, most = np.minimum.reduceat(flux, first), np.maximum.reduceat(flux, first)
    unequal = int(np.count_nonzero(most - least > 1e-9 * np.abs(most)))
    differ = "differs in flux and is" if unequal == 1 else "differ in flux and are"
    difference = f"; {unequal} of them {differ} averaged" if unequal else ", equal in flux"
    n = int((count > 1).sum())
    words = "1 wavelength that occurs" if n == 1 else f"{n} wavelengths that occur"
    messages.append(f"{words} more than once {'is' if n == 1 else 'are'} merged{difference}")
    return distinct, np.where(count > 1, total / count, flux[first])
