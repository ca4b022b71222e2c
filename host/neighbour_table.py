"""Reader of tables of neighbours, such as the result of a Gaia query."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened, shown

from .files.tables import read_table
from .neighbours import Neighbour
from .stars.band_names import known_band

Float = NDArray[np.float64]

#: Names of columns in lower case: those of the Gaia archive, astroquery, VizieR and CDS X-Match, and plain ones.
NAMES = ("name", "designation", "source_id", "source", "main_id", "id", "dr3name")
SEPARATIONS = (
    "separation",
    "separation_arcsec",
    "sep",
    "sep_arcsec",
    "angdist",
    "target_separation (deg)",
    "dist",
    "_r",
)
RIGHT_ASCENSIONS = ("ra", "ra_deg", "ra_icrs", "_raj2000", "raj2000")
DECLINATIONS = ("dec", "dec_deg", "de_icrs", "_dej2000", "dej2000")
#: Columns of magnitudes, with their bands; the first that a row has counts. Gmag is Gaia's in VizieR.
MAGNITUDES = {"magnitude": "", "mag": "", "v": "V", "vmag": "V", "phot_g_mean_mag": "Gaia G", "gmag": "Gaia G"}
TYPES = ("spectral_type", "sptype", "sp_type", "type")
FILES = ("file", "spectrum", "spectrum_file")
TEMPERATURES = ("teff_gspphot", "teff", "teff_val", "temperature", "temperature_k")
COLOURS = ("bp_rp", "bp-rp", "bprp")
#: All names of columns that are read, with that of a magnitude's band.
KNOWN = (*NAMES, *SEPARATIONS, *RIGHT_ASCENSIONS, *DECLINATIONS, *MAGNITUDES, "band", *TYPES, *FILES, *TEMPERATURES,
         *COLOURS)  # fmt: skip
#: Units of separations without a stated unit: ADQL's DISTANCE is in degrees.
UNSTATED = {"dist": "deg", "target_separation (deg)": "deg"}
#: Largest number of rows; a fibre holds far fewer stars.
MOST_ROWS = 100_000


def read_neighbours(path: str | Path, target: str | None = None) -> tuple[tuple[Neighbour, ...], tuple[str, ...]]:
    """Read neighbours, nearest first, and return them with statements on how the table was read.

    Raises InputError if the table has no separations and no positions, or a cell is invalid.

    Parameters
    ----------
    path : str or Path
        CSV, ECSV, FITS or VOTable with a row per star. A separation, or right ascension and declination, and for stars
        within the fibre a magnitude and a spectral type, spectrum file, temperature or Gaia colour, in columns of any
        of the names in this module, in any case. Files of spectra are relative to the table.
    target : str, optional
        Name of the row that is the target itself, which is left out, or coordinates such as "290.68 +11.12". Positions
        are measured from it; it is needed if there are no separations.
    """
    path = Path(path)
    named = f"table of neighbours {shortened(path.name)}"
    table = _Columns(read_table(path, "table of neighbours", "CSV, ECSV, FITS or VOTable"), named)
    if not 1 <= table.n <= MOST_ROWS:
        raise InputError(f"{named} holds {table.n} stars", f"1 to {MOST_ROWS}", key="neighbours", value=table.n)
    names = table.names()
    own = None if target is None else next((k for k, name in enumerate(names) if name == target.strip()), None)
    separations, notes = table.separations(own, target)
    stars = [
        Neighbour(name, float(separations[k]), *table.magnitude(k), table.text(TYPES, k), _file(table, k, path.parent),
                  table.number(TEMPERATURES, k, above=0.0), table.number(COLOURS, k))
        for k, name in enumerate(names)
        if k != own
    ]  # fmt: skip
    return tuple(sorted(stars, key=lambda star: star.separation_arcsec)), notes


def _file(table: _Columns, row: int, folder: Path) -> Path | None:
    name = table.text(FILES, row)
    return folder / name if name else None


class _Columns:
    """Columns of a table by their names in lower case."""

    def __init__(self, table: Any, named: str) -> None:
        self.table, self.named, self.n = table, named, len(table)
        self.title = {str(name).strip().lower(): name for name in table.colnames}

    def first(self, names: tuple[str, ...]) -> str | None:
        """Return the first of some names that the table has."""
        return next((name for name in names if name in self.title), None)

    def text(self, names: tuple[str, ...], row: int) -> str:
        """Return the text of a cell, empty if there is none."""
        name = self.first(names)
        if name is None:
            return ""
        value = self.table[self.title[name]][row]
        text = "" if np.ma.is_masked(value) else str(value).strip()
        return "" if text.lower() in ("nan", "--", "none") else text

    def number(self, names: tuple[str, ...], row: int, above: float = -np.inf) -> float | None:
        """Return the number of a cell, None if there is none; raises InputError for anything else."""
        text = self.text(names, row).removesuffix(" mag").removesuffix(" K")
        if not text:
            return None
        try:
            value = float(text)
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and above < value < 1e6):
            raise InputError(
                f"{self.named}: row {row + 1} has {self.first(names)} = {shortened(text)}",
                "a number" if np.isinf(above) else f"a number above {above:g}",
                key="neighbours",
                value=text,
            )
        return value

    def names(self) -> list[str]:
        """Return the names of the stars; rows without one are numbered."""
        return [self.text(NAMES, row) or f"row {row + 1}" for row in range(self.n)]

    def magnitude(self, row: int) -> tuple[float | None, str]:
        """Return magnitude and band of a star; None if it has none."""
        for name, band in MAGNITUDES.items():
            if name in self.title and not (name == "gmag" and self.title[name] != "Gmag"):
                value = self.number((name,), row)
                if value is not None:
                    return value, band or known_band(self.text(("band",), row) or "V")
        return None, "V"

    def separations(self, own: int | None, target: str | None) -> tuple[Float, tuple[str, ...]]:
        """Return the separations from the target, arcsec, shape (n_row,), and statements on how they were found."""
        ra, dec = self.first(RIGHT_ASCENSIONS), self.first(DECLINATIONS)
        if ra is not None and dec is not None and target is not None:
            return self._from_positions(ra, dec, own, target), ()
        name = self.first(SEPARATIONS)
        if name is None:
            raise InputError(
                f"{self.named} has the columns {shown(', '.join(self.title), 300)}"
                + ("" if ra is None else " and no position of the star itself"),
                "separation (arcsec)" + (", or ra and dec" if ra is None else "")
                + ("" if ra is None else ", or star.neighbours_of: the star's own row by name, or its coordinates"),
                key="neighbours" if ra is None else "neighbours_of",
                value=target,
            )  # fmt: skip
        if target is not None and own is None:
            raise InputError(
                f"{self.named} has no row named {shortened(target)}, and no positions",
                "the name of a row, which is then left out",
                key="neighbours_of",
                value=target,
            )
        return self._stated(name)

    def _stated(self, name: str) -> tuple[Float, tuple[str, ...]]:
        import astropy.units as u

        column = self.table[self.title[name]]
        stated = None if getattr(column, "unit", None) is None else str(column.unit)
        if stated is None and name == "_r":
            raise InputError(
                f"{self.named}: the column _r states no unit",
                "a table with units (ECSV, FITS, VOTable), or the column separation, arcsec",
                key="neighbours",
                value=name,
            )
        unit = stated or UNSTATED.get(name, "arcsec")
        try:
            factor = float(u.Unit(unit).to(u.arcsec))
        except (u.UnitConversionError, ValueError) as error:
            raise InputError(
                f"{self.named}: {name} has the unit {shortened(unit)}", "an angle", key="neighbours", value=unit
            ) from error
        values = self._numbers(name) * factor
        negative = ~(values >= 0)
        if negative.any():
            row = int(np.argmax(negative))
            raise InputError(
                f"{self.named}: row {row + 1} has {name} = {values[row] / factor:g}",
                "an angle of 0 and above",
                key="neighbours",
                value=float(values[row] / factor),
            )
        note = f"Separations are the column {name} of {self.named}, read as degrees since it states no unit."
        return values, (note,) if stated is None and name == "dist" else ()

    def _from_positions(self, ra: str, dec: str, own: int | None, target: str) -> Float:
        from astropy.coordinates import angular_separation

        east, north = np.radians(self._numbers(ra)), np.radians(self._numbers(dec))
        place = _coordinates(target, self.named) if own is None else (float(east[own]), float(north[own]))
        return np.asarray(np.degrees(angular_separation(*place, east, north)) * 3600.0)

    def _numbers(self, name: str) -> Float:
        values = [self.number((name,), row) for row in range(self.n)]
        missing = next((row for row, value in enumerate(values) if value is None), None)
        if missing is not None:
            raise InputError(
                f"{self.named}: row {missing + 1} has no {name}", "one", key="neighbours", value=missing + 1
            )
        return np.array(values, np.float64)


def _coordinates(text: str, named: str) -> tuple[float, float]:
    """Return right ascension and declination in radians. Raises InputError unless the text is coordinates."""
    from .sky.helioecliptic import parse_position

    try:
        place = parse_position(text)
    except InputError as error:
        raise InputError(
            f"{named} has no row named {shortened(text)}, and it is not a position",
            "the name of the star's own row, or coordinates such as '290.68 +11.12'",
            key="neighbours_of",
            value=text,
        ) from error
    return float(place.ra.rad), float(place.dec.rad)
