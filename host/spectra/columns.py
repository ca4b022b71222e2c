"""From two chosen columns to a spectrum: units, air and vacuum, order, duplicates, and what has to be told of them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..files.bounded import shortened
from .units import unit_of

Float = NDArray[np.float64]

#: Wavelengths believed where the file states no unit: beyond them another unit is more likely.
PLAUSIBLE_NM = (50.0, 10_000.0)
#: What a spectrum must hold in the unit assumed, nm; where another unit holds it too, nothing is assumed.
NEEDED_NM = (200.0, 700.0)
#: Values at and above this are IRAF's and others' sign for no measurement (1.6e38).
INDEFINITE = 1e38
#: Most names that a message lists.
LISTED = 12

_UNIT_BEHIND = r"(?:[\s_]*[\[(/].*|_(?:nm|a|aa|ang|angstroms?|um|micron|flam|vacuum|vac|air|obs|erg.*|w_.*))*"
_WAVE = re.compile(
    r"(?:log_?(?:10)?[_ (]*)?(?:wavelengths?|waves?|lambda|lam|wl|wlen|wav|wvl|awav|λ|frequency|freq)\)?"
    r"(?:[_ ]?(?:air|vac|vacuum))?"
    rf"{_UNIT_BEHIND}|loglam\w*"
)
_FLUX = re.compile(
    r"(?:flux|fluxes|flam|flux_?density|f_?lambda|f_?lam|spectral_flux_density|fnu|f_nu|flux_lambda|sflux|intensity|irradiance)"
    + _UNIT_BEHIND
)
_ERROR = re.compile(r"err|sig|unc|std|var|sys|qual|cont|back|sky|snr|mask", re.IGNORECASE)
_STEPS = ("deltaw", "delta_w", "delta_wavelength", "step", "dlam", "dlambda")


@dataclass(frozen=True, eq=False)
class Columns:
    """Wavelengths and fluxes as a file has them, and what it says of them.

    Attributes
    ----------
    wavelength, flux : ndarray
    wavelength_unit, flux_unit : str or Unit or None
        As stated; None where nothing is.
    usual : tuple of str
        Units that the form of the file takes for granted where it states none, or nothing.
    wavelength_name, flux_name : str
    name, origin : str
    words : str
        Remarks of the header: air or vacuum, at the star's surface, freed of dust.
    notes : tuple of str
        For the record.
    told : tuple of str
        For the user.
    """

    wavelength: Float
    flux: Float
    name: str
    origin: str
    wavelength_unit: Any = None
    flux_unit: Any = None
    usual: tuple[str, str] | None = None
    wavelength_name: str = "wavelength"
    flux_name: str = "flux"
    words: str = ""
    notes: tuple[str, ...] = ()
    told: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ReadSpectrum:
    """A spectrum as read: vacuum nm, erg s-1 cm-2 A-1, and what its file says of it.

    Attributes
    ----------
    wavelength_nm, flux_flam : ndarray, shape (n,)
    name, origin : str
    notes : tuple of str
        For the record.
    told : tuple of str
        What an answer must say of it: what was assumed, converted or merged.
    unscaled : str
        Why its flux is not that at the telescope, so that it needs a magnitude; empty where it is.
    """

    wavelength_nm: Float
    flux_flam: Float
    name: str
    origin: str
    notes: tuple[str, ...] = ()
    told: tuple[str, ...] = ()
    unscaled: str = ""


def numbers(values: ArrayLike, what: str, none: Any = None) -> Float:
    """Values as floats; what a mask hides, or stands for no measurement, is not a number.

    Raises
    ------
    InputError
        If they are none.
    """
    try:
        if isinstance(values, np.ma.MaskedArray):
            plain = np.ma.filled(values.astype(np.float64), np.nan)
        else:
            plain = np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what} holds no plain numbers, expected one number in each cell") from error
    if none is not None:
        with np.errstate(invalid="ignore", over="ignore"):
            plain[plain == float(none)] = np.nan
            if plain.dtype == np.float64 and abs(float(none)) > 1e30:
                plain[np.isclose(plain, float(none), rtol=1e-6)] = np.nan
    plain[~(np.abs(plain) < INDEFINITE)] = np.nan
    return plain


def plain(name: str) -> str:
    """A column's name as it is compared."""
    return " ".join(name.strip().strip("\"'").lower().split())


def chosen(names: Sequence[str], asked: Sequence[str], units: Sequence[Any] = ()) -> tuple[int, int]:
    """Places of the wavelength and the flux among named columns.

    Parameters
    ----------
    names : sequence of str
    asked : sequence of str
        Names that the user gave.
    units : sequence, optional
        Their units as stated: a flux density may be known by its unit alone.

    Raises
    ------
    InputError
        If there is no such column, or several fit; with their names.
    """
    compared = [plain(name) for name in names]
    wanted = []
    for one in asked:
        places = [i for i, name in enumerate(names) if name.strip() == one] or [
            i for i, name in enumerate(compared) if name == plain(one)
        ]
        if len(places) != 1:
            raise InputError(
                f"{'several columns are' if places else 'no column is'} named {shortened(one)}, expected one of "
                f"{listed(names)}"
            )
        wanted.append(places[0])
    waves = [i for i, name in enumerate(compared) if _WAVE.fullmatch(name)]
    given = [i for i in wanted if i in waves]
    wave = given[0] if given else _one("wavelength", names, _best(compared, waves, ("wavelength", "wave", "lambda")))
    others = [i for i in wanted if i != wave]
    if len(others) > 1:
        raise InputError(f"columns {listed(asked)} are asked for, expected one flux, and one wavelength at most")
    if others:
        return wave, others[0]
    fluxes = [i for i, name in enumerate(compared) if _FLUX.fullmatch(name) or _may_be_flux(name)]
    if not fluxes:
        fluxes = [
            i
            for i, name in enumerate(compared)
            if i != wave and not _ERROR.search(name) and i < len(units) and _is_flux_density(units[i])
        ]
    if not fluxes and len(names) == 2:
        fluxes = [1 - wave]
    return wave, _one("flux", names, _best(compared, fluxes, ("flux", "flam")))


def _may_be_flux(name: str) -> bool:
    return name.startswith("flux") and not _ERROR.search(name)


def _best(compared: Sequence[str], places: list[int], usual: tuple[str, ...]) -> list[int]:
    """Those with the most usual name, where there are any."""
    for name in usual:
        if same := [i for i in places if compared[i] == name]:
            return same
    # Of both, vacuum is what is needed.
    return [i for i in places if "vac" in compared[i]] or places


def _one(what: str, names: Sequence[str], places: list[int]) -> int:
    if not places:
        raise InputError(f"no {what} column, only {listed(names)}, expected one named {what.upper()}")
    if len(places) > 1:
        several = [names[i].strip() for i in places]
        raise InputError(
            f"{len(several)} columns may be the {what}: {listed(several)}, expected one: name it as in "
            f"FILE[{several[-1][:40]}]"
        )
    return places[0]


def listed(names: Sequence[str]) -> str:
    """Names for a message, not too many."""
    shown = [name.strip()[:40] for name in names]
    return ", ".join(shown[:LISTED]) + (f" and {len(shown) - LISTED} more" if len(shown) > LISTED else "")


def _is_flux_density(unit: Any) -> bool:
    import astropy.units as u

    try:
        physical = unit_of(unit) if isinstance(unit, str) else unit
        return bool(physical is not None and physical.is_equivalent(u.W / u.m**3, u.spectral_density(500 * u.nm)))
    except (InputError, AttributeError):
        return False


def row_of(wavelength: Any, flux: Any, step: Any, where: str) -> tuple[Any, Any]:
    """A row's cells as columns: two arrays, or an array that starts at a wavelength and goes in steps.

    Raises
    ------
    InputError
        If they are not that.
    """
    wavelength, flux = np.ma.asanyarray(wavelength), np.ma.asanyarray(flux)
    if flux.ndim > 1:
        flux = flux.squeeze()
    if wavelength.ndim > 1:
        wavelength = wavelength.squeeze()
    if flux.ndim != 1:
        raise InputError(f"{where}: the flux has the shape {flux.shape}, expected one spectrum")
    if wavelength.ndim == 0 or (wavelength.size == 1 < flux.size):
        if step is None:
            raise InputError(
                f"{where}: one wavelength for {flux.size} fluxes, expected as many, or a column of the step"
            )
        wavelength = float(np.ravel(wavelength)[0]) + float(np.ravel(step)[0]) * np.arange(flux.size)
    if wavelength.shape != flux.shape:
        raise InputError(f"{where}: {wavelength.size} wavelengths for {flux.size} fluxes, expected as many")
    return wavelength, flux


def step_among(names: Sequence[str]) -> int | None:
    """The column that holds the step of arrays which start at a wavelength."""
    return next((i for i, name in enumerate(names) if plain(name) in _STEPS), None)


def spectrum_of(columns: Columns, wavelength_unit: Any = None, flux_unit: Any = None) -> ReadSpectrum:
    """The spectrum that two columns hold.

    Parameters
    ----------
    columns : Columns
    wavelength_unit, flux_unit : str or Unit, optional
        What the user says; stands above what the file does. A wavelength's may end in "air" or "vacuum".

    Raises
    ------
    InputError
        If units are missing, unlikely or no wavelength and flux density, or points do not make a spectrum.
    """
    import astropy.units as u

    told = list(columns.told)
    medium: str | None = None
    if isinstance(wavelength_unit, str) and (
        match := re.fullmatch(r"\s*(.*?)\s*\b(air|vacuum)\s*", wavelength_unit, re.I)
    ):
        wavelength_unit, medium = match[1] or None, match[2].lower()
    logarithmic = _logarithm(columns)
    length, assumed_length = _unit(columns, 0, wavelength_unit, logarithmic, told)
    density, assumed_flux = _unit(columns, 1, flux_unit, False, told)
    values = columns.wavelength
    if logarithmic:
        with np.errstate(over="ignore"):
            values = 10.0**values
        told.append(f"its wavelengths are logarithms ({columns.wavelength_name}), raised to powers of ten")
    flam = u.erg / (u.s * u.cm**2 * u.AA)
    with np.errstate(all="ignore"):
        try:
            nm = u.Quantity(values, length).to_value(u.nm, u.spectral())
        except u.UnitConversionError as error:
            raise InputError(f"wavelengths in {length} are none, expected a length or a frequency") from error
        try:
            flux = u.Quantity(columns.flux, density).to_value(flam, u.spectral_density(u.Quantity(nm, u.nm)))
        except u.UnitConversionError as error:
            raise InputError(
                f"the unit {density} is no flux density, expected one such as erg / (s cm2 Angstrom)"
            ) from error
    nm, flux = np.asarray(nm, np.float64), np.asarray(flux, np.float64)
    nm, flux = _in_order(nm, flux, told)
    if assumed_length:
        _likely(nm, columns, length)
    if assumed_flux and flux.size and np.nanmin(flux) >= 2.0 and np.nanmax(flux) <= 40.0:
        raise InputError(
            f"fluxes of {np.nanmin(flux):g} to {np.nanmax(flux):g} without a unit look like magnitudes, expected a "
            "flux density: --flux-unit names its unit"
        )
    nm = _in_vacuum(nm, columns, medium, told)
    nm, flux = _merged(nm, flux, told)
    unscaled = "its header says that it is the flux at the star's surface" if re.search(
        r"surface\s+flux", columns.words, re.I
    ) else ""  # fmt: skip
    notes = columns.notes
    if re.search(r"dereddened", columns.words, re.I) and not any("dereddened" in note for note in notes):
        notes += ("dereddened, as its header says: counts need it reddened again",)
    return ReadSpectrum(nm, flux, columns.name, columns.origin, notes, tuple(told), unscaled)


def _logarithm(columns: Columns) -> bool:
    name, unit = columns.wavelength_name.lower(), str(columns.wavelength_unit or "").lower()
    return bool(re.match(r"\s*log", name) or re.match(r"\s*(log|dex)", unit))


def _unit(columns: Columns, which: int, said: Any, logarithmic: bool, told: list[str]) -> tuple[Any, bool]:
    """A column's unit, and whether it is assumed."""
    what = ("wavelength", "flux")[which]
    stated = (columns.wavelength_unit, columns.flux_unit)[which]
    column = (columns.wavelength_name, columns.flux_name)[which]
    if logarithmic and isinstance(stated, str):
        # "log(Angstrom)", "log10 nm"
        stated = re.sub(r"^\s*(log|dex)\w*[\s(\[]*|[)\]\s]+$", "", stated, flags=re.IGNORECASE) or None
    try:
        if said is not None:
            unit = unit_of(said) if isinstance(said, str) else said
            if stated:
                told.append(f"the unit of its {what} is {unit} as asked, not {stated!s:.40} as its file says")
            return unit, False
        if stated is not None and str(stated).strip():
            return (unit_of(stated) if isinstance(stated, str) else stated), False
    except InputError as error:
        raise InputError(f"{what} ({column}): {error}") from error
    if not which and logarithmic:
        return unit_of("Angstrom"), True
    if columns.usual is None:
        raise InputError(
            f"column {column} names no unit, expected one such as {('nm', 'erg / (s cm2 Angstrom)')[which]}: "
            f"--{what}-unit names it"
        )
    unit = unit_of(columns.usual[which])
    told.append(f"ASSUMED: {what} in {unit}, because its file states no unit; --{what}-unit names another")
    return unit, True


def _likely(nm: Float, columns: Columns, unit: Any) -> None:
    """Refuse an assumed unit of the wavelength where another is as likely."""
    finite = nm[np.isfinite(nm)]
    if not finite.size:
        return
    low, high = float(finite.min()), float(finite.max())
    if low < PLAUSIBLE_NM[0] or high > PLAUSIBLE_NM[1]:
        raise InputError(
            f"wavelengths of {low:g}-{high:g} nm, assumed to be in {unit} for want of a stated unit, are beyond "
            f"{PLAUSIBLE_NM[0]:g}-{PLAUSIBLE_NM[1]:g} nm, expected their unit: --wavelength-unit names "
            f"it{_guess(low, high)}"
        )
    as_nm = f"{unit}" == "nm"
    factor = 0.1 if as_nm else 10.0
    if covers(low, high) and covers(low * factor, high * factor):
        raise InputError(
            f"wavelengths of {low:g}-{high:g} nm without a stated unit cover {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm in "
            f"{'Angstrom' if as_nm else 'nm'} as well as in {unit}, expected their unit: --wavelength-unit names it"
        )


def covers(low: float, high: float) -> bool:
    """Whether a range of wavelengths holds what is needed."""
    return low <= NEEDED_NM[0] and high >= NEEDED_NM[1]


def _guess(low: float, high: float) -> str:
    for unit, factor in (("Angstrom", 0.1), ("micrometres", 1000.0), ("nm", 10.0)):
        # At least half of what is needed would be there.
        shared = min(high * factor, NEEDED_NM[1]) - max(low * factor, NEEDED_NM[0])
        if shared > (NEEDED_NM[1] - NEEDED_NM[0]) / 2:
            return f" (these look like {unit})"
    return ""


def looks_like(low: float, high: float) -> str:
    """What unit wavelengths in nm may have been meant in, for a message."""
    return _guess(low, high) if low > 300.0 or high < 100.0 or low < 50.0 else ""


def _in_order(nm: Float, flux: Float, told: list[str]) -> tuple[Float, Float]:
    bad = np.flatnonzero(~np.isfinite(nm))
    if bad.size:
        if (bad.size < nm.size) and not np.isfinite(flux[bad]).any():
            # A row without either is no point.
            return _in_order(np.delete(nm, bad), np.delete(flux, bad), told)
        raise InputError(f"wavelength {nm[bad[0]]} at point {bad[0] + 1}, expected a finite number")
    if nm.size > 1 and nm[0] > nm[-1]:
        return nm[::-1], flux[::-1]
    return nm, flux


def _merged(nm: Float, flux: Float, told: list[str]) -> tuple[Float, Float]:
    """Points of one wavelength as one, with their mean flux."""
    if nm.size < 2 or (np.diff(nm) > 0).all() or (np.diff(nm) < 0).any():
        return nm, flux
    kept, first, count = np.unique(nm, return_index=True, return_counts=True)
    total = np.add.reduceat(flux, first)
    least, most = np.minimum.reduceat(flux, first), np.maximum.reduceat(flux, first)
    with np.errstate(invalid="ignore"):
        unequal = int(np.count_nonzero(most - least > 1e-9 * np.abs(most)))
    shown = f"; {unequal} of them differ in flux and are averaged" if unequal else ", equal in flux"
    told.append(f"{int((count > 1).sum())} wavelengths that stand more than once are merged{shown}")
    return kept, np.where(count > 1, total / count, flux[first])


#: Words for air, among them those of IVOA's UCD (em.wl;obs.atmos) and of FITS (AWAV).
_AIR = re.compile(
    r"\b(?:in|are|is|standard)\s+air\b|\bair\s+wavelengths?|wavelengths?\W{0,3}(?:\(|in\s+)?air\b|\bawav"
    r"|\bem\.wl;obs\.a|_air(?:\b|_)|\bair_|\(air\)",
    re.IGNORECASE,
)
_VACUUM = re.compile(r"(?:\b|_)vac(?:uum)?(?:\b|_)|\bvacuum", re.IGNORECASE)


def _in_vacuum(nm: Float, columns: Columns, medium: str | None, told: list[str]) -> Float:
    """Vacuum wavelengths, from air where the file says so."""
    if medium is None:
        for text in (columns.wavelength_name, columns.words):
            air, vacuum = bool(_AIR.search(text)), bool(_VACUUM.search(text))
            if air and vacuum:
                told.append(
                    "its header speaks of air and of vacuum: ASSUMED vacuum; --wavelength-unit 'nm air' says air"
                )
            if air or vacuum:
                medium = "vacuum" if vacuum else "air"
                break
    if medium != "air":
        return nm
    told.append("its wavelengths are in air, converted to vacuum (Ciddor 1996, above 200 nm)")
    return vacuum_from_air(nm)


def vacuum_from_air(air_nm: Float) -> Float:
    """Vacuum wavelengths, nm, of wavelengths in standard air (15 C, 101325 Pa, dry, 450 ppm CO2).

    Ciddor 1996, Applied Optics 35, 1566, equation 1, doi 10.1364/AO.35.001566. Below 200 nm spectroscopists give
    vacuum wavelengths, which are left as they are (Morton 1991, ApJS 77, 119).
    """
    vacuum = air_nm.copy()
    there = np.isfinite(air_nm) & (air_nm >= 200.0)
    for _ in range(4):
        # Squared wavenumber, um-2; the index hardly changes along the step, so this settles at once.
        wavenumber2 = (1000.0 / vacuum[there]) ** 2
        index = 1.0 + 0.05792105 / (238.0185 - wavenumber2) + 0.00167917 / (57.362 - wavenumber2)
        vacuum[there] = air_nm[there] * index
    return vacuum
