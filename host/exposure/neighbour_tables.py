"""Tables of neighbouring stars: names of their columns, separations from the target, magnitudes and spectra."""

from __future__ import annotations

import contextlib
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.exposure.neighbours import Neighbour
from mauvecl.host.exposure.sky import parse_position
from mauvecl.host.stars.library import known_band
from mauvecl.host.tables.names import (
    BANDS,
    DECLINATIONS,
    RIGHT_ASCENSIONS,
    SPECTRAL_TYPES,
    STARS,
    band_in_name,
    divided_unit,
    key_of,
)
from mauvecl.host.tables.opening import read_table
from mauvecl.host.tables.table import Rows
from mauvecl.schema.errors import InputError, shortened, shown

Float = NDArray[np.float64]

#: Names of columns: those of the Gaia archive, astroquery, VizieR and CDS X-Match, and plain ones.
SEPARATIONS = ("separation", "separation_arcsec", "sep", "sep_arcsec", "angdist", "dstarcsec",
               "target_separation (deg)", "dist", "_r")  # fmt: skip
#: Columns of magnitudes, with their bands; the first that a row has counts. Gmag is Gaia's in VizieR.
MAGNITUDES = {"magnitude": "", "mag": "", "v": "V", "vmag": "V", "flux_v": "V", "phot_g_mean_mag": "Gaia G",
              "gmag": "Gaia G"}  # fmt: skip
TYPES = (*SPECTRAL_TYPES, "type")
FILES = ("file", "spectrum", "spectrum_file")
TEMPERATURES = ("teff_gspphot", "teff", "teff_val", "temperature", "temperature_k")
COLOURS = ("bp_rp", "bp-rp", "bprp")
#: All names of columns that are read, with that of a magnitude's band.
KNOWN = (*STARS, *SEPARATIONS, *RIGHT_ASCENSIONS, *DECLINATIONS, *MAGNITUDES, *BANDS, *TYPES, *FILES, *TEMPERATURES,
         *COLOURS)  # fmt: skip
_KEYS = {key_of(name) for name in KNOWN} | {key_of("target_separation")}
#: Largest number of rows; a fibre holds far fewer stars.
MOST_ROWS = 100_000


def read_neighbours(path: str | Path, target: str | None = None) -> tuple[tuple[Neighbour, ...], tuple[str, ...]]:
    """Read neighbours, nearest first, and return them with statements on how the table was read.

    The file is a CSV, ECSV, FITS or VOTable with a row per star. A separation, or right ascension and declination, and
    for stars within the fibre a magnitude and a spectral type, spectrum file, temperature or Gaia colour, are in
    columns of any of the names in this module, in any case. Files of spectra are relative to the table. The target is
    the name of the row that is the target itself, which is left out, or coordinates such as "290.68 +11.12". Positions
    are measured from it; it is needed if there are no separations. Raises InputError if the table has no separations
    and no positions, or a cell is invalid.
    """
    path = Path(path)
    named = f"table of neighbours {shortened(path.name)}"
    table = _Neighbours(read_table(path, "table of neighbours"), named, "neighbours")
    if not 1 <= table.n <= MOST_ROWS:
        raise InputError(f"{named} must hold 1 to {MOST_ROWS} stars, not {table.n}", key="neighbours")
    name = table.first(STARS)
    names = [table.text(name, row) or f"row {row + 1}" for row in range(table.n)]
    own = None if target is None else next((k for k, name in enumerate(names) if name == target.strip()), None)
    separations, notes = table.separations(own, target)
    kind, file, temperature, colour = map(table.first, (TYPES, FILES, TEMPERATURES, COLOURS))
    stars = []
    for k, name in enumerate(names):
        if k != own:
            spectrum = table.text(file, k)
            stars.append(Neighbour(
                name, float(separations[k]), *table.magnitude(k), table.text(kind, k),
                path.parent / spectrum if spectrum else None, table.number(temperature, k, "K", above=0.0),
                table.number(colour, k, "mag"),
            ))  # fmt: skip
    notes += table.unused([name for name in table.names if not {key_of(name), key_of(divided_unit(name)[0])} & _KEYS])
    return tuple(sorted(stars, key=lambda star: star.separation_arcsec)), notes


class _Neighbours(Rows):
    """Rows of a table of neighbours."""

    @cached_property
    def magnitudes(self) -> list[tuple[str, str]]:
        """Columns of magnitudes, and their bands."""
        held = [(self.first((name,)), name, band) for name, band in MAGNITUDES.items()]
        # Gmag is Gaia's in VizieR, gmag that of other surveys.
        return [(column, band) for column, name, band in held if column and (name != "gmag" or column == "Gmag")]

    @cached_property
    def band(self) -> str | None:
        """Column of bands."""
        return self.first(BANDS)

    def magnitude(self, row: int) -> tuple[float | None, str]:
        """Return magnitude and band of a star; None if it has none."""
        for name, band in self.magnitudes:
            value = self.number(name, row, "mag")
            if value is not None:
                stated = band or band_in_name(name) or self.text(self.band, row) or "V"
                # Only stars within the fibre need a band with a passband.
                with contextlib.suppress(InputError):
                    return value, known_band(stated)
                return value, stated
        return None, "V"

    def separations(self, own: int | None, target: str | None) -> tuple[Float, tuple[str, ...]]:
        """Return the separations from the target, arcsec, shape (n_row,), and statements on how they were found."""
        ra, dec = self.first(RIGHT_ASCENSIONS), self.first(DECLINATIONS)
        if ra is not None and dec is not None and target is not None:
            return self._from_positions(ra, dec, own, target), ()
        name = self.first(SEPARATIONS)
        if name is None:
            fault = f"{self.named} has the columns {shown(', '.join(self.names), 300)}"
            needed, key = "separation (arcsec), or ra and dec", "neighbours"
            if ra is not None:
                fault += " and no position of the star itself"
                own_place = "star.neighbours_of: the star's own row by name, or its coordinates"
                needed, key = f"separation (arcsec), or {own_place}", "neighbours_of"
            raise InputError(f"{fault}, but needs {needed}", key=key)
        if target is not None and own is None:
            fault = f"{self.named} has no row named {shortened(target)}, and no positions"
            raise InputError(f"{fault}; give the name of a row, which is then left out", key="neighbours_of")
        return self._stated(name)

    def _stated(self, name: str) -> tuple[Float, tuple[str, ...]]:
        stated, key = getattr(self.table[name], "unit", None) is not None, key_of(name)
        if not stated and key == "_r":
            remedy = "use a table with units (ECSV, FITS, VOTable), or the column separation, arcsec"
            raise self.error(f"the column {name} states no unit; {remedy}", name)
        # ADQL's DISTANCE is in degrees.
        degrees = key == "dist" and not stated
        values = np.array([self._given(name, row, self.number(name, row, "arcsec")) for row in range(self.n)])
        values *= 3600.0 if degrees else 1.0
        if (negative := ~(values >= 0)).any():
            row = int(np.argmax(negative))
            raise self.error(f"{name} in row {row + 1} must be 0 or above, not {self.text(name, row)}", name)
        note = f"Separations are the column {name} of {self.named}, read as degrees since it states no unit."
        return values, (note,) if degrees else ()

    def _from_positions(self, ra: str, dec: str, own: int | None, target: str) -> Float:
        from astropy.coordinates import angular_separation

        east, north = (
            np.radians([self._given(name, row, self.degrees(name, row, right_ascension=name == ra))
                        for row in range(self.n)]) for name in (ra, dec)
        )  # fmt: skip
        place = _coordinates(target, self.named) if own is None else (float(east[own]), float(north[own]))
        return np.asarray(np.degrees(angular_separation(*place, east, north)) * 3600.0)

    def _given(self, name: str, row: int, value: float | None) -> float:
        if value is None:
            raise self.error(f"row {row + 1} needs a {name}", name)
        return value


def _coordinates(text: str, named: str) -> tuple[float, float]:
    """Return right ascension and declination in radians. Raises InputError unless the text is coordinates."""
    try:
        place = parse_position(text)
    except InputError as error:
        fault = f"{named} has no row named {shortened(text)}, and it is not a position"
        remedy = "give the name of the star's own row, or coordinates such as '290.68 +11.12'"
        raise InputError(f"{fault}; {remedy}", key="neighbours_of") from error
    return float(place.ra.rad), float(place.dec.rad)
