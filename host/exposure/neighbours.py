"""Neighbouring stars, whose light enters the fibre together with the target's, and tables of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.exposure.response import Order, electrons_per_second
from mauvecl.host.exposure.sky import parse_position
from mauvecl.host.stars.library import embedded, known_band, library_table, nearest_spectrum
from mauvecl.host.stars.source import Source
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
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, shortened, shown
from mauvecl.schema.physical import Share

if TYPE_CHECKING:
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.tables.table import Rows

Float = NDArray[np.float64]

#: Distance up to which a row of a table may be the target itself, which a message then says, arcsec.
SAME_STAR_ARCSEC = 2.0
#: Largest number of neighbours that a message names.
MOST_NAMED = 4


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A star near the target; its spectrum is chosen only if its light enters the fibre."""

    name: str
    separation_arcsec: float  # from the target
    magnitude: float | None = None  # in `band`; None if unknown
    band: str = "V"  # as the table names it if its passband is unknown
    spectral_type: str = ""  # empty if unknown; the nearest spectrum of the library is used
    file: Path | None = None  # spectrum file, in place of a type
    temperature_k: float | None = None  # effective temperature, which chooses the spectrum if the type is unknown
    bp_rp: float | None = None  # Gaia colour, which chooses the spectrum if type and temperature are unknown

    @cached_property
    def spectrum(self) -> tuple[str, str]:
        """Name of the spectrum, and the statement on its choice, empty if it is the star's own.

        Raises InputError if nothing tells the spectrum.
        """
        if self.file is not None:
            return self.file.name, ""
        if self.spectral_type:
            entry = embedded(self.spectral_type)
            if entry is not None:
                return entry["name"], ""
            nearest = nearest_spectrum(self.spectral_type)
            return nearest, f"of type {self.spectral_type}: {nearest}, the nearest type of the library"
        if self.temperature_k is not None:
            wanted = self.temperature_k
            nearest, (kelvin, _) = min(_typical().items(), key=lambda item: abs(np.log(item[1][0] / wanted)))
            return nearest, f"of {wanted:.0f} K: {nearest} ({kelvin:.0f} K), the nearest of the library"
        if self.bp_rp is not None:
            wanted = self.bp_rp
            nearest, (_, colour) = min(_typical().items(), key=lambda item: abs(item[1][1] - wanted))
            return nearest, f"of BP - RP = {wanted:.2f}: {nearest} ({colour:.2f}), the nearest colour of the library"
        needed = "needs a spectral type, spectrum file, temperature or colour, since its light enters the fibre"
        raise InputError(f"{self._place}, {needed}", key="neighbours")

    @property
    def _place(self) -> str:
        return f"neighbour {self.name}, {self.separation_arcsec:.3g} arcsec away"

    @cached_property
    def source(self) -> Source:
        """Spectrum at the telescope. Raises InputError if spectrum or magnitude is unknown."""
        name, _ = self.spectrum
        if self.magnitude is None and self.file is None:
            raise InputError(f"{self._place}, needs a magnitude, since its light enters the fibre", key="neighbours")
        star = Source.from_library(name) if self.file is None else Source.read(self.file)
        if self.magnitude is not None:
            try:
                star = star.at_magnitude(self.magnitude, known_band(self.band))
            except InputError as error:
                raise error.within(self._place) from error
        check_level(star, f"neighbour {self.name}", "neighbours")
        return star


def check_level(source: Source, name: str, key: str) -> None:
    """Raise InputError, which calls a star by `name`, if its spectrum is not as bright as the star is seen."""
    if source.unscaled:
        fault = f"the spectrum of {name} is not as bright as the star is seen: {source.unscaled}"
        raise InputError(f"{fault}; give a magnitude as well", key=key)


@validated
@dataclass(frozen=True, eq=False)
class Neighbours:
    """Neighbours of one target."""

    stars: tuple[Neighbour, ...]
    share: Share = 1.0  # share of the light that enters the fibre, of stars within its radius; an assumption
    notes: tuple[str, ...] = ()  # statements on how the table was read

    def within(self, instrument: Instrument) -> list[Neighbour]:
        """Return the neighbours within the radius of the fibre."""
        return [star for star in self.stars if star.separation_arcsec <= instrument.field_of_view_radius_arcsec]

    def electrons_per_second(self, instrument: Instrument, order: Order = "paper") -> Float:
        """Return the mean electrons per second of all neighbours in the fibre, shape (n_pixel,)."""
        rates = (self.share * rate_of(neighbour, instrument, order) for neighbour in self.within(instrument))
        return sum(rates, np.zeros(instrument.wavelength_nm.size))

    def provenance(self, instrument: Instrument) -> dict[str, str]:
        """Return the neighbours in the fibre with their spectra, for the record of an expectation."""
        inside = [
            f"{star.name} ({star.separation_arcsec:.6g} arcsec, {star.spectrum[0]}, {star.source.digest})"
            for star in self.within(instrument)
        ]
        return {"neighbours": "; ".join(inside), "share of neighbours": f"{self.share:g} (assumption)"}

    def messages(self, target: str, instrument: Instrument) -> list[str]:
        """Return the messages on the neighbours of a target."""
        radius, inside = instrument.field_of_view_radius_arcsec, self.within(instrument)
        outside = len(self.stars) - len(inside)
        beyond = "1 star beyond does not enter" if outside == 1 else f"{outside} stars beyond do not enter"
        if not inside:
            return [f"NEIGHBOURS of {target}: none within {radius:g} arcsec; {beyond}.", *self.notes]
        named = [f"{star.name} at {star.separation_arcsec:.3g} arcsec" for star in inside[:MOST_NAMED]]
        more = len(inside) - MOST_NAMED
        stars = "1 star" if len(inside) == 1 else f"{len(inside)} stars"
        text = (
            f"NEIGHBOURS of {target}: the light of {stars} within {radius:g} arcsec is in the fibre "
            f"({', '.join(named)}{f' and {more} more' if more > 0 else ''}); assumption: {100 * self.share:g} % of it "
            "enters"
        )
        chosen = [f"Light of {star.name}, {star.spectrum[1]}." for star in inside if star.spectrum[1]]
        if len(chosen) > MOST_NAMED:
            chosen = [*chosen[:MOST_NAMED], f"Spectra of {len(chosen) - MOST_NAMED} more neighbours are chosen alike."]
        same = [
            f"{star.name} is {star.separation_arcsec:.2g} arcsec from {target} and counts as a neighbour: if it is the "
            "star itself, name its row in star.neighbours_of."
            for star in inside
            if star.separation_arcsec < SAME_STAR_ARCSEC
        ]
        return [f"{text}; {beyond}." if outside else f"{text}.", *same, *chosen, *self.notes]


#: Cached since flares and sweep values of a star have the same neighbours.
@lru_cache(maxsize=4096)
def rate_of(neighbour: Neighbour, instrument: Instrument, order: Order) -> Float:
    """Return the mean electrons per second of a neighbour if all of its light enters, shape (n_pixel,)."""
    source = neighbour.source
    rate = electrons_per_second(instrument, source.wavelength_nm, source.flux_flam, order)
    rate = np.maximum(rate * instrument.per_pixel("response", 1.0), 0.0)
    rate.setflags(write=False)
    return rate


@cache
def _typical() -> dict[str, tuple[float, float]]:
    """Return temperature and synthetic Gaia colour BP - RP of the embedded spectra that represent a spectral type."""
    rows = [row for row in library_table() if row["kept"] == "embedded" and row["name"] == row["spectral_type"]]
    stars = [Source.from_library(str(row["name"])) for row in rows]
    colours = [star.magnitude("Gaia BP") - star.magnitude("Gaia RP") for star in stars]
    return {star.name: (star.temperature_k or np.nan, colour) for star, colour in zip(stars, colours, strict=True)}


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
    # Only questions with such a table load the readers of files.
    from mauvecl.host.tables.opening import read_table
    from mauvecl.host.tables.table import Rows

    path = Path(path)
    named = f"table of neighbours {shortened(path.name)}"
    table = Rows(read_table(path, "table of neighbours"), named, "neighbours")
    if not 1 <= table.n <= MOST_ROWS:
        raise InputError(f"{named} must hold 1 to {MOST_ROWS} stars, not {table.n}", key="neighbours")
    name = table.first(STARS)
    names = [table.text(name, row) or f"row {row + 1}" for row in range(table.n)]
    own = None if target is None else next((k for k, name in enumerate(names) if name == target.strip()), None)
    separations, notes = _separations(table, own, target)
    bands, kind, file, temperature, colour = map(table.first, (BANDS, TYPES, FILES, TEMPERATURES, COLOURS))
    # Gmag is Gaia's in VizieR, gmag that of other surveys.
    magnitudes = {
        column: band
        for name, band in MAGNITUDES.items()
        if (column := table.first((name,))) and (name != "gmag" or column == "Gmag")
    }
    stars = []
    for k, name in enumerate(names):
        if k != own:
            spectrum = table.text(file, k)
            stars.append(Neighbour(
                name, float(separations[k]), *_magnitude(table, k, magnitudes, bands), table.text(kind, k),
                path.parent / spectrum if spectrum else None, table.number(temperature, k, "K", above=0.0),
                table.number(colour, k, "mag"),
            ))  # fmt: skip
    notes += table.unused([name for name in table.names if not {key_of(name), key_of(divided_unit(name)[0])} & _KEYS])
    return tuple(sorted(stars, key=lambda star: star.separation_arcsec)), notes


def _magnitude(table: Rows, row: int, columns: dict[str, str], bands: str | None) -> tuple[float | None, str]:
    """Return magnitude and band of a star from the first column that has a value; None if it has none.

    `columns` gives the columns' bands, empty for those that tell none, and `bands` is the column of bands.
    """
    for name, band in columns.items():
        value = table.number(name, row, "mag")
        if value is not None:
            stated = band or band_in_name(name) or table.text(bands, row) or "V"
            # Only stars within the fibre need a band with a passband.
            with contextlib.suppress(InputError):
                return value, known_band(stated)
            return value, stated
    return None, "V"


def _separations(table: Rows, own: int | None, target: str | None) -> tuple[Float, tuple[str, ...]]:
    """Return the separations from the target, arcsec, shape (n_row,), and statements on how they were found."""
    ra, dec = table.first(RIGHT_ASCENSIONS), table.first(DECLINATIONS)
    if ra is not None and dec is not None and target is not None:
        return _from_positions(table, ra, dec, own, target), ()
    name = table.first(SEPARATIONS)
    if name is None:
        fault = f"{table.named} has the columns {shown(', '.join(table.names), 300)}"
        needed, key = "separation (arcsec), or ra and dec", "neighbours"
        if ra is not None:
            fault += " and no position of the star itself"
            own_place = "star.neighbours_of: the star's own row by name, or its coordinates"
            needed, key = f"separation (arcsec), or {own_place}", "neighbours_of"
        raise InputError(f"{fault}, but needs {needed}", key=key)
    if target is not None and own is None:
        fault = f"{table.named} has no row named {shortened(target)}, and no positions"
        raise InputError(f"{fault}; give the name of a row, which is then left out", key="neighbours_of")
    stated, key = getattr(table.table[name], "unit", None) is not None, key_of(name)
    if not stated and key == "_r":
        remedy = "use a table with units (ECSV, FITS, VOTable), or the column separation, arcsec"
        raise table.error(f"the column {name} states no unit; {remedy}", name)
    values = _column(table, name, lambda row: table.number(name, row, "arcsec"))
    if (negative := ~(values >= 0)).any():
        row = int(np.argmax(negative))
        raise table.error(f"{name} in row {row + 1} must be 0 or above, not {table.text(name, row)}", name)
    if stated or key != "dist":
        return values, ()
    # ADQL's DISTANCE is in degrees.
    return values * 3600.0, (
        f"Separations are the column {name} of {table.named}, read as degrees since it states no unit.",
    )


def _from_positions(table: Rows, ra: str, dec: str, own: int | None, target: str) -> Float:
    """Return the separations of the rows' positions from the target's row or coordinates, arcsec, shape (n_row,)."""
    from astropy.coordinates import angular_separation

    east = np.radians(_column(table, ra, lambda row: table.degrees(ra, row, right_ascension=True)))
    north = np.radians(_column(table, dec, lambda row: table.degrees(dec, row, right_ascension=False)))
    if own is not None:
        place = float(east[own]), float(north[own])
    else:
        try:
            position = parse_position(target)
        except InputError as error:
            fault = f"{table.named} has no row named {shortened(target)}, and it is not a position"
            remedy = "give the name of the star's own row, or coordinates such as '290.68 +11.12'"
            raise InputError(f"{fault}; {remedy}", key="neighbours_of") from error
        place = float(position.ra.rad), float(position.dec.rad)
    return np.asarray(np.degrees(angular_separation(*place, east, north)) * 3600.0)


def _column(table: Rows, name: str, read: Callable[[int], float | None]) -> Float:
    """Return the values of a column that must have one in each row."""
    values = []
    for row in range(table.n):
        value = read(row)
        if value is None:
            raise table.error(f"row {row + 1} needs a {name}", name)
        values.append(value)
    return np.array(values)
