"""Read a spectrum from the files that users bring."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import InputError

WAVELENGTH_NAMES = ("wavelength", "wave", "lambda", "wl", "lam")
FLUX_NAMES = ("flux", "flam", "flux_density", "fluxdensity", "f_lambda", "spectral_flux_density")


@dataclass(frozen=True, eq=False)
class ReadSpectrum:
    """A spectrum as read: vacuum nm, erg s-1 cm-2 A-1, and what its file says of it."""

    wavelength_nm: NDArray[np.float64]
    flux_flam: NDArray[np.float64]
    name: str
    origin: str
    notes: tuple[str, ...] = ()


def read_spectrum(path: Path) -> ReadSpectrum:
    """Read two-column text, ECSV, or a FITS table.

    Parameters
    ----------
    path : Path
        ``.txt``, ``.dat`` or ``.csv``: nm and erg s-1 cm-2 A-1 (the paper's rule); ``.ecsv``: any units, but named;
        ``.fits``, also gzipped: CALSPEC, NGSL or HST-library tables, Angstrom and erg s-1 cm-2 A-1 where no unit is
        named.

    Raises
    ------
    InputError
        If there is no such file, or it cannot be read as one of these.
    """
    if not path.is_file():
        raise InputError(f"spectrum file {str(path)!r} does not exist, expected a text, ECSV or FITS file")
    name = path.name.lower()
    if name.endswith((".fits", ".fit", ".fits.gz", ".fit.gz")):
        return _read_fits(path)
    if name.endswith(".ecsv"):
        return _read_ecsv(path)
    return _read_text(path)


def _read_text(path: Path) -> ReadSpectrum:
    try:
        # Editors on Windows start a file with a byte-order mark.
        text = path.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(f"spectrum file {path.name} is not text ({error}), expected two columns of numbers") from error
    if "\0" in text:
        raise InputError(
            f"spectrum file {path.name} is not text (it holds null bytes), expected two columns of numbers"
        )
    lines = text.splitlines()
    rows = []
    for number, line in enumerate(lines, 1):
        fields = line.split("#", 1)[0].replace(",", " ").split()
        if not fields:
            continue
        if len(fields) < 2:
            raise InputError(
                f"{path.name} line {number}: {line.strip()!r} has one column, expected wavelength and flux"
            )
        try:
            rows.append((float(fields[0]), float(fields[1])))
        except ValueError as error:
            raise InputError(
                f"{path.name} line {number}: {line.strip()[:60]!r} is not numeric, expected wavelength in nm and flux"
            ) from error
    if not rows:
        raise InputError(f"{path.name} holds no numbers, expected two columns: wavelength in nm and flux")
    values = np.array(rows)
    return ReadSpectrum(values[:, 0], values[:, 1], path.stem, f"text file {path.name}")


def _read_ecsv(path: Path) -> ReadSpectrum:
    from astropy.table import Table

    try:
        table = Table.read(path, format="ascii.ecsv")
    except Exception as error:  # astropy raises many kinds
        raise InputError(
            f"{path.name} cannot be read as ECSV ({str(error).splitlines()[0]}), expected an ECSV table"
        ) from error

    def column(name: str) -> tuple[Any, Any]:
        if table[name].unit is None:
            raise InputError(
                f"{path.name}: column {name} names no unit, expected one such as nm or erg / (s cm2 Angstrom)"
            )
        values = table[name].data
        if isinstance(values, np.ma.MaskedArray):
            # What lies under a mask is no measurement.
            values = np.ma.filled(values.astype(float), np.nan)
        return values, table[name].unit

    return _from_columns(table.colnames, column, path, str(table.meta.get("name", path.stem)))


def _read_fits(path: Path) -> ReadSpectrum:
    import warnings

    from astropy.io import fits

    try:
        # Old archive files carry headers that astropy warns of and reads all the same.
        with warnings.catch_warnings(), fits.open(path) as hdus:
            warnings.simplefilter("ignore")
            table = next((hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)), None)
            if table is None:
                raise InputError(f"{path.name} has no table, expected a FITS table with WAVELENGTH and FLUX")
            header = hdus[0].header + table.header
            columns = {c.name: (np.array(table.data[c.name]), _archive_unit(c.unit)) for c in table.columns}
    except InputError as error:
        raise InputError(str(error) if path.name in str(error) else f"{path.name}: {error}") from error
    except Exception as error:  # truncated and foreign files fail in many ways
        raise InputError(f"{path.name} cannot be read as FITS ({error}), expected a FITS table") from error
    name = str(header.get("TARGNAME") or header.get("TARGETID") or header.get("OBJECT") or path.stem).strip()
    notes = tuple(f"{key} = {header[key]}" for key in ("DATAQUAL", "OFFSETPX") if key in header)
    if "lowlib" in path.name.lower():
        notes += ("dereddened and at zero velocity: counts need it reddened again",)
    return _from_columns(columns, columns.__getitem__, path, name, notes)


def _archive_unit(name: str | None) -> Any:
    """Units as the archives write them: in capitals, in the plural, with A for Angstrom (to astropy it is ampere)."""
    import astropy.units as u

    if not name or not name.strip():
        return None
    known = {"flam": u.erg / (u.s * u.cm**2 * u.AA), "fnu": u.erg / (u.s * u.cm**2 * u.Hz)}
    if name.strip().lower() in known:
        return known[name.strip().lower()]
    words = {
        "a": "Angstrom", "aa": "Angstrom", "ang": "Angstrom", "angstrom": "Angstrom", "angstroms": "Angstrom",
        "erg": "erg", "ergs": "erg", "s": "s", "sec": "s", "cm": "cm", "hz": "Hz", "nm": "nm", "um": "um",
        "micron": "um", "microns": "um", "nanometer": "nm", "nanometers": "nm",
    }  # fmt: skip
    plain = re.sub(r"[A-Za-z]+", lambda word: words.get(word[0].lower(), word[0]), name.strip())
    for spelling in (plain, name):
        try:
            return u.Unit(spelling)
        except ValueError:
            continue
    raise InputError(f"unit {name.strip()!r} is unknown, expected one such as Angstrom or erg / (s cm2 Angstrom)")


def _from_columns(
    names: Iterable[str], column: Any, path: Path, name: str, notes: tuple[str, ...] = ()
) -> ReadSpectrum:
    """Find, convert and shape the two columns that matter."""
    import astropy.units as u

    lower = {n.lower(): n for n in names}
    found = []
    for what, candidates in (("wavelength", WAVELENGTH_NAMES), ("flux", FLUX_NAMES)):
        match = next((lower[c] for c in candidates if c in lower), None)
        if match is None:
            raise InputError(
                f"{path.name} has no {what} column, only {', '.join(lower)}, expected one named {what.upper()}"
            )
        found.append(match)
    (wavelength, wavelength_unit), (flux, flux_unit) = map(column, found)
    flam = u.erg / (u.s * u.cm**2 * u.AA)
    try:
        wave = u.Quantity(np.ravel(wavelength).astype(float), wavelength_unit or u.AA)
        nm = wave.to_value(u.nm, u.spectral())
        values = u.Quantity(np.ravel(flux).astype(float), flux_unit or flam).to_value(flam, u.spectral_density(wave))
    except (u.UnitConversionError, ValueError, TypeError) as error:
        raise InputError(f"{path.name}: {error}, expected a wavelength and a flux density") from error
    if wave.unit.physical_type != "length" and nm.size and nm[0] > nm[-1]:
        # Rising frequencies are falling wavelengths.
        nm, values = nm[::-1], values[::-1]
    return ReadSpectrum(np.asarray(nm), np.asarray(values), name, f"file {path.name}", notes)
