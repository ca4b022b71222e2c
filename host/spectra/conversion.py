"""Conversion of a spectrum from the units of its file to vacuum nm and erg s-1 cm-2 A-1, with messages."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.spectra.column_roles import Role
from mauvecl.host.spectra.selection import RawSpectrum
from mauvecl.host.spectra.wavelength_range import check_assumed_unit
from mauvecl.host.tables.medium import Medium, unit_and_medium, vacuum_wavelengths
from mauvecl.host.tables.units import flux_kind, is_spectral, is_stated, linear, unit_of
from mauvecl.schema.errors import InputError

Float = NDArray[np.float64]

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
    #: Remarks for run records.
    notes: tuple[str, ...] = ()
    #: Assumptions, conversions and mergers, which answers must report.
    messages: tuple[str, ...] = ()
    #: Reason why the flux is not that at the telescope, so that a magnitude is needed; otherwise empty.
    unscaled: str = ""
    #: Unit of the wavelengths in the file.
    axis_unit: str = "nm"


def converted(raw: RawSpectrum, wavelength_unit: Any = None, flux_unit: Any = None) -> ReadSpectrum:
    """Convert a spectrum.

    Parameters
    ----------
    wavelength_unit, flux_unit : str or Unit, optional
        Units that override those of the file. A unit of wavelength may end in "air" or "vacuum".
    """
    messages = list(raw.messages)
    medium: Medium | None = None
    if isinstance(wavelength_unit, str):
        wavelength_unit, medium = unit_and_medium(wavelength_unit)
    stated, in_unit = unit_and_medium(raw.wavelength_role.unit or "")
    role = replace(raw.wavelength_role, unit=stated) if in_unit else raw.wavelength_role
    implied = raw.table.implied_units or (None, None)
    axis = _scale("wavelength", raw.wavelength_name, role, wavelength_unit, implied[0])
    flux = _scale("flux", raw.flux_name, raw.flux_role, flux_unit, implied[1])
    messages += [*axis.messages, *flux.messages]
    if axis.is_assumed:
        check_assumed_unit(axis.linear_values(np.concatenate([values for values, _ in raw.segments])), axis.name)
    segments = []
    for values, fluxes in raw.segments:
        nm, kept = _in_nm(values, fluxes, axis)
        order = slice(None, None, -1 if nm.size > 1 and nm[0] > nm[-1] else 1)
        segments.append((nm[order], _in_flam(kept, nm, flux)[order]))
    nm, flam = _joined(segments, messages)
    if flux.is_assumed:
        _check_assumed_flux(flam, raw)
    nm, said = vacuum_wavelengths(nm, raw.wavelength_name, raw.table.remarks, medium or in_unit, raw.table.medium)
    messages += said
    nm, flam = _merged(nm, flam, messages)
    unscaled = raw.table.unscaled or (
        "its header says that it is the flux at the star's surface"
        if re.search(r"surface\s+flux", raw.table.remarks, re.I)
        else ""
    )
    notes = raw.table.notes
    if re.search(r"dereddened", raw.table.remarks, re.I) and not any("dereddened" in note for note in notes):
        notes += ("dereddened, as its header says: counts need it reddened again",)
    return ReadSpectrum(nm, flam, raw.table.name, raw.table.origin, notes, tuple(messages), unscaled, axis.name)


@dataclass(frozen=True)
class _Scale:
    """Scale of a column's numbers: linear, logarithmic or magnitudes."""

    unit: Any
    is_assumed: bool
    messages: tuple[str, ...]
    linear_values: Callable[[Float], Float]

    @property
    def name(self) -> str:
        return str(linear(self.unit))


def _scale(what: str, column: str, role: Role, asked: Any, implied: str | None) -> _Scale:
    """Return the scale of a column: as given by the user, stated by the file, or implied by its format."""
    unit, messages = _stated(what, column, role.unit, asked)
    is_bare_logarithm = unit is not None and str(unit) in ("dex", "dex(1)")
    is_assumed = unit is None or is_bare_logarithm
    if is_assumed:
        if implied is None:
            usual = "nm" if what == "wavelength" else "erg / (s cm2 Angstrom)"
            raise InputError(
                f"column {column} names no unit", f"one such as {usual}: `{what}_unit` names it", key=f"{what}_unit"
            )
        # Logarithms of wavelength are of Angstrom everywhere (SDSS, LAMOST, DESI).
        is_logarithm = is_bare_logarithm or role.logarithm
        per_frequency = what == "flux" and role.per_frequency
        unit = unit_of("Angstrom" if what == "wavelength" and is_logarithm else "fnu" if per_frequency else implied)
        why = f", and {column} is one per frequency" if per_frequency else ""
        messages.append(f"ASSUMED: {what} in {unit}, because its file states no unit{why}; --{what}-unit names another")
    if what == "flux":
        _check_flux_unit(unit, role)
    elif not is_spectral(unit):
        raise InputError.of("wavelength_unit", str(unit), "a length or a frequency")
    base = role.logarithm or ("10" if is_bare_logarithm or str(unit).startswith("dex") else "")
    if base:
        values, power = "wavelengths" if what == "wavelength" else "fluxes", "e" if base == "e" else "ten"
        messages.append(f"its {values} are logarithms ({column}), raised to powers of {power}")
        limits = LOG_WAVELENGTHS if what == "wavelength" else LOG_FLUXES
        return _Scale(linear(unit), is_assumed, tuple(messages), lambda x: _power(x, base, limits, column))
    if unit is not linear(unit):
        messages.append(f"its magnitudes ({unit}) are converted to fluxes")
        return _Scale(linear(unit), is_assumed, tuple(messages), unit.to_physical)
    return _Scale(unit, is_assumed, tuple(messages), lambda x: x)


def _stated(what: str, column: str, stated: str | None, asked: Any) -> tuple[Any, list[str]]:
    """Return the user's unit, else that of the file, else None; and messages."""
    try:
        if asked is None:
            return (unit_of(stated) if stated is not None and is_stated(stated) else None), []
        unit = unit_of(asked) if isinstance(asked, str) else asked
    except InputError as error:
        raise error.within(f"{what} ({column})") from error
    if not is_stated(stated) or _is_same(stated, unit):
        return unit, []
    return unit, [f"the unit of its {what} is {unit} as asked, not {stated!s:.40} as its file says"]


def _is_same(stated: object, unit: Any) -> bool:
    try:
        return bool(unit_of(str(stated)) == unit)
    except InputError:
        return False


def _power(values: Float, base: str, limits: tuple[float, float], column: str) -> Float:
    logarithms = values * np.log10(np.e) if base == "e" else values
    finite = logarithms[np.isfinite(logarithms)]
    # Linear fluxes under a wrong name are all but zero.
    if finite.size and (finite.min() < limits[0] or finite.max() > limits[1] or np.abs(finite).max() < 1e-3):
        low, high = values[np.isfinite(values)].min(), values[np.isfinite(values)].max()
        fault = f"column {column} is named as a logarithm and holds {low:g} to {high:g}"
        raise InputError(fault, f"logarithms from {limits[0]:g} to {limits[1]:g}", key=column, value=(low, high))
    with np.errstate(over="ignore"):
        return np.asarray(10.0**logarithms)


def _check_flux_unit(unit: Any, role: Role) -> None:
    kind = flux_kind(unit)
    usual = "one such as erg / (s cm2 Angstrom)"
    if kind == "other":
        raise InputError.of("flux_unit", str(unit), usual)
    if kind == "total" and not role.total:
        fault = f"the unit {unit} is not a flux density (it is not per wavelength or frequency)"
        expected = f"{usual}, or a column whose name says lambda F_lambda, such as lamFlam"
    elif kind == "density" and role.total:
        fault = f"the column's name says lambda F_lambda and its unit {unit} a flux density"
        expected = "them to agree"
    elif kind == "surface brightness":
        fault = f"the unit {unit} is per solid angle"
        expected = "the flux of the whole star, such as erg / (s cm2 Angstrom)"
    else:
        return
    raise InputError(fault, expected, key="flux_unit", value=unit)


def _in_nm(values: Float, flux: Float, scale: _Scale) -> tuple[Float, Float]:
    """Return wavelengths in nm, and the fluxes of points with a wavelength."""
    import astropy.units as u

    with np.errstate(all="ignore"):
        nm = np.asarray(u.Quantity(scale.linear_values(values), scale.unit).to_value(u.nm, u.spectral()), np.float64)
    bad = np.flatnonzero(~np.isfinite(nm))
    if bad.size == 0:
        return nm, flux
    if bad.size < nm.size and not np.isfinite(flux[bad]).any():
        # A row without wavelength or flux is not a point.
        return np.delete(nm, bad), np.delete(flux, bad)
    raise InputError.of("wavelength", nm[bad[0]], "a finite number", where=f"point {bad[0] + 1}")


def _in_flam(flux: Float, nm: Float, scale: _Scale) -> Float:
    import astropy.units as u

    flam = u.erg / (u.s * u.cm**2 * u.AA)
    with np.errstate(all="ignore"):
        quantity = u.Quantity(scale.linear_values(flux), scale.unit)
        return np.asarray(quantity.to_value(flam, u.spectral_density(u.Quantity(nm, u.nm))), np.float64)


def _joined(segments: list[tuple[Float, Float]], messages: list[str]) -> tuple[Float, Float]:
    """Join segments in order of wavelength; overlaps are cut in the middle."""
    segments = sorted((s for s in segments if s[0].size), key=lambda segment: (segment[0][0], segment[0][-1]))
    nm, flux = segments[0]
    for more, added in segments[1:]:
        if more[-1] <= nm[-1]:
            fault = f"a segment of {more[0]:g}-{more[-1]:g} nm lies within another, which ends at {nm[-1]:g} nm"
            expected = "segments side by side: choose one by its name, as in FILE[name]"
            raise InputError(fault, expected, key="table", value=(more[0], more[-1]))
        if more[0] <= nm[-1]:
            middle = (more[0] + nm[-1]) / 2
            messages.append(f"two segments overlap at {more[0]:g}-{nm[-1]:g} nm and are cut at {middle:g} nm")
            nm, flux = nm[nm <= middle], flux[: int(np.count_nonzero(nm <= middle))]
            more, added = more[more > middle], added[added.size - int(np.count_nonzero(more > middle)) :]
        nm, flux = np.append(nm, more), np.append(flux, added)
    return nm, flux


def _check_assumed_flux(flux: Float, raw: RawSpectrum) -> None:
    """Raise InputError if numbers of an assumed unit are more likely magnitudes or a throughput."""
    finite = flux[np.isfinite(flux)]
    if not finite.size:
        return
    low, high = float(finite.min()), float(finite.max())
    said = _THROUGHPUT.search(f"{raw.table.remarks}\n{raw.table.origin}".replace("_", " "))
    if low >= LIKELY_MAGNITUDES[0] and high <= LIKELY_MAGNITUDES[1]:
        fault, expected = f"fluxes of {low:g} to {high:g} without a unit look like magnitudes", "a flux density"
    elif said and low >= 0.0 and 1e-3 <= high <= 1.0:
        fault = f"values of {low:g} to {high:g} without a unit and the word {said[0]!r} speak of a throughput"
        expected = "a star's flux"
    else:
        return
    raise InputError(fault, f"{expected}: `flux_unit` names its unit", key="flux_unit", value=(low, high))


def _merged(nm: Float, flux: Float, messages: list[str]) -> tuple[Float, Float]:
    """Merge points of equal wavelength into one with their mean flux."""
    if nm.size < 2 or (np.diff(nm) > 0).all() or (np.diff(nm) < 0).any():
        return nm, flux
    kept, first, count = np.unique(nm, return_index=True, return_counts=True)
    total = np.add.reduceat(flux, first)
    least, most = np.minimum.reduceat(flux, first), np.maximum.reduceat(flux, first)
    with np.errstate(invalid="ignore"):
        unequal = int(np.count_nonzero(most - least > 1e-9 * np.abs(most)))
    shown = f"; {unequal} of them differ in flux and are averaged" if unequal else ", equal in flux"
    messages.append(f"{int((count > 1).sum())} wavelengths that occur more than once are merged{shown}")
    return kept, np.where(count > 1, total / count, flux[first])
