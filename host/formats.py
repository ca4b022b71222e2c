"""Read a spectrum from the files that users bring."""

from __future__ import annotations

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
        ``.txt``, ``.dat`` or ``.csv``: nm and erg s-1 cm-2 A-1 (the paper's rule); ``.ecsv``: any units; ``.fits``,
        also gzipped: CALSPEC, NGSL or HST-library tables, Angstrom and erg s-1 cm-2 A-1 where no unit is named.

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
        lines = path.read_text(encoding="utf-8").splitlines()
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(f"spectrum file {path.name} is not text ({error}), expected two columns of numbers") from error
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
    return _from_columns(
        table.colnames, lambda c: (table[c].data, table[c].unit), path, str(table.meta.get("name", path.stem))
    )


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
    except InputError:
        raise
    except Exception as error:  # truncated and foreign files fail in many ways
        raise InputError(f"{path.name} cannot be read as FITS ({error}), expected a FITS table") from error
    name = str(header.get("TARGNAME") or header.get("TARGETID") or header.get("OBJECT") or path.stem).strip()
    notes = tuple(f"{key} = {header[key]}" for key in ("DATAQUAL", "OFFSETPX") if key in header)
    if "lowlib" in path.name.lower():
        notes += ("dereddened and at zero velocity: counts need it reddened again",)
    return _from_columns(columns, columns.__getitem__, path, name, notes)


def _archive_unit(name: str | None) -> Any:
    """Units as the space telescope archives write them."""
    import astropy.units as u

    if not name:
        return None
    known = {
        "angstroms": u.AA,
        "angstrom": u.AA,
        "flam": u.erg / (u.s * u.cm**2 * u.AA),
        "fnu": u.erg / (u.s * u.cm**2 * u.Hz),
    }
    return known.get(name.strip().lower()) or name


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
        found.append(column(match))
    (wavelength, wavelength_unit), (flux, flux_unit) = found
    flam = u.erg / (u.s * u.cm**2 * u.AA)
    try:
        wave = u.Quantity(np.ravel(wavelength).astype(float), wavelength_unit or u.AA)
        nm = wave.to_value(u.nm, u.spectral())
        values = u.Quantity(np.ravel(flux).astype(float), flux_unit or flam).to_value(flam, u.spectral_density(wave))
    except (u.UnitConversionError, ValueError, TypeError) as error:
        raise InputError(f"{path.name}: {error}, expected a wavelength and a flux density") from error
    if wave.unit.physical_type != "length":
        # Frequencies run the other way.
        nm, values = nm[::-1], values[::-1]
    return ReadSpectrum(np.asarray(nm), np.asarray(values), name, f"file {path.name}", notes)
