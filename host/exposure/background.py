"""Light that enters the fibre besides the star's: zodiacal light by position and time, and neighbouring stars."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from mauvecl.host.arrays import Float
from mauvecl.host.exposure.response import Order, electrons_per_second
from mauvecl.host.stars import library
from mauvecl.host.stars.source import Source
from mauvecl.host.tables import names
from mauvecl.host.tables.files import parse_numbers
from mauvecl.host.tables.units import offline
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, shortened, shown
from mauvecl.schema.fields import DateText, Share, SkyBrightness, SolidAngle, date_text

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.tables.table import Rows


#: Calendar years in which errors of UTC and ephemeris are far smaller than a cell of the zodiacal table.
YEARS = (1990, 2100)


def parse_time(time: Time | str, name: str = "time") -> Time:
    """Return a single finite time between 1990 and 2100; text is ISO 8601, UTC.

    Messages call the argument by `name`. The function must be called inside `offline`.
    """
    from astropy.time import Time

    moment = time if isinstance(time, Time) else date_text(time)
    if isinstance(moment, str):
        with contextlib.suppress(ValueError):
            moment = Time(moment.strip().removesuffix("Z"), scale="utc")
    if isinstance(moment, Time) and not moment.isscalar:
        raise InputError(f"{name} must be a single time, but contains {moment.size} times", key=name)
    if not isinstance(moment, Time) or np.ma.is_masked(moment.jd) or not np.isfinite(moment.jd):
        raise InputError.of(name, time, "a UTC time such as '2026-03-01T12:00:00'")
    year = float(moment.decimalyear)
    if not YEARS[0] <= year < YEARS[1]:
        raise InputError.of(name, moment.utc.isot, f"between {YEARS[0]} and {YEARS[1]}")
    return moment


def parse_position(target: SkyCoord | str) -> SkyCoord:
    """Return a single finite position; text is a name, or ICRS in degrees or sexagesimal hours and degrees."""
    from astropy.coordinates import SkyCoord
    from astropy.coordinates.baseframe import BaseCoordinateFrame

    if isinstance(target, str):
        if (star := library.by_key().get(library.name_key(target))) is not None:
            return SkyCoord(star.ra_deg, star.dec_deg, unit="deg")
        try:
            return SkyCoord(*names.position(target), unit="deg")
        except InputError as error:
            if not re.match(r"\s*[^\W\d]", target):
                raise
            like = ", ".join(library.near_names(target, stars_only=True))
            expected = f"a name such as {like}, or {names.EXPECTED_POSITION}"
            raise InputError.of("target", target, expected) from error
    position = SkyCoord(target) if isinstance(target, SkyCoord | BaseCoordinateFrame) else None
    if position is not None and not position.isscalar:
        raise InputError(f"target must be a single position, but contains {position.size} positions", key="target")
    if position is None or not np.isfinite([position.spherical.lon.deg, position.spherical.lat.deg]).all():
        raise InputError.of("target", target, names.EXPECTED_POSITION)
    return position


Lookup = Literal["bilinear", "nearest"]


@validated
@dataclass(frozen=True)
class Sky:
    """Zodiacal light of uniform surface brightness.

    Examples
    --------
    >>> from mauvecl import Sky
    >>> round(Sky.at("290.68 +11.12", "2026-09-01T12:00").surface_brightness, 2)
    22.96
    """

    surface_brightness: SkyBrightness | None  #: V mag arcsec^-2 (Vega); None means no sky.
    description: str  #: Origin of the value, for reports.

    @classmethod
    def none(cls) -> Sky:
        """Return a sky without light."""
        return cls(None, "no sky")

    @classmethod
    def of_brightness(cls, brightness: SkyBrightness) -> Sky:
        """Return a sky of fixed surface brightness, 5 to 35 V mag arcsec^-2."""
        return cls(brightness, f"fixed V = {brightness:.2f} mag/arcsec2")

    @classmethod
    def at(cls, target: SkyCoord | str, time: Time | DateText, lookup: Lookup = "bilinear") -> Sky:
        """Return the zodiacal light towards a target, from the table of the MauveSim paper (COS Instrument Handbook).

        The table has a cell every 15 deg. Magnitudes are interpolated bilinearly, or taken from the nearest cell as in
        the paper. Cells in the solar avoidance zone have no value: the other corners share their weight, which makes
        the sky next to the zone up to 0.4 mag too faint (0.1 DN/s per pixel). Positions nearest to those are refused.

        Parameters
        ----------
        target : SkyCoord or str
            Single position; a string is a well-known star ("AU Mic"), or ICRS in degrees ("290.0 -11.2") or sexagesimal
            ("19h22m00s -11d12m00s").
        time : Time or str
            Single time in 1990-2100; a string is ISO 8601, UTC, and so are dates of Python, NumPy and pandas.
        lookup : {"bilinear", "nearest"}
        """
        with offline():
            from astropy.coordinates import GeocentricTrueEcliptic, get_sun

            moment, position = parse_time(time), parse_position(target)
            frame = GeocentricTrueEcliptic(equinox=moment, obstime=moment)
            sun = get_sun(moment).transform_to(frame)
            try:
                star = position.transform_to(frame)
            except Exception:  # frames that cannot be transformed (AltAz without a location) raise many kinds
                fault = f"target in the frame {position.frame.name!r} cannot be turned to the ecliptic; use ICRS"
                raise InputError(fault, key="target") from None
            longitude = abs(float((star.lon - sun.lon).wrap_at("180d").deg))
            latitude, separation = abs(float(star.lat.deg)), float(star.separation(sun).deg)
        brightness = zodiacal_brightness(longitude, latitude, separation, lookup)
        return cls(
            brightness,
            f"zodiacal light V = {brightness:.2f} mag/arcsec2 at helio-ecliptic longitude {longitude:.1f} deg, "
            f"latitude {latitude:.1f} deg, {separation:.1f} deg from the Sun ({lookup})",
        )

    def total_magnitude(self, field_of_view_arcsec2: SolidAngle) -> float | None:
        """Return the V magnitude of the whole field of view, or None without a sky."""
        if self.surface_brightness is None:
            return None
        return float(self.surface_brightness - 2.5 * np.log10(field_of_view_arcsec2))

    def spectrum(self, field_of_view_arcsec2: SolidAngle) -> Source | None:
        """Return the spectrum of the whole field of view, or None without a sky.

        Zodiacal light is scattered sunlight with little reddening, so the spectrum is that of the Sun (CALSPEC) at the
        total magnitude. The paper uses HD 87646, a G2V star.
        """
        total = self.total_magnitude(field_of_view_arcsec2)
        return None if total is None else _sunlight(total)


@lru_cache(maxsize=16)
def _sunlight(magnitude: float) -> Source:
    return Source.from_library("Sun").at_magnitude(magnitude)


#: Steps of helio-ecliptic longitude and latitude in the table of the zodiacal light, deg.
STEP_DEG = 15.0


@lru_cache(maxsize=1)
def zodiacal_table() -> Float:
    """Return the table of the MauveSim paper, V mag arcsec^-2, shape (13, 7); NaN in the solar avoidance zone.

    Rows are longitudes from 0 to 180 deg, columns are latitudes from 0 to 90 deg.
    """
    text = resources.files(__package__).joinpath("zodiacal.ecsv").read_text(encoding="utf-8")
    table = parse_numbers(text, "the embedded table of the zodiacal light")
    return np.stack([table[name] for name in table.columns if name.startswith("latitude_")], axis=1)


def zodiacal_brightness(
    longitude_deg: float, latitude_deg: float, separation_deg: float, lookup: Lookup = "bilinear"
) -> float:
    """Return the surface brightness of the zodiacal light, V mag arcsec^-2, at a position relative to the Sun.

    Longitude, 0-180 deg, and latitude are absolute, in the true geocentric ecliptic of date. The nearest cell (of two
    equally near, the one farther from the Sun) must be outside the solar avoidance zone.
    """
    table = zodiacal_table()
    row, column = longitude_deg / STEP_DEG, latitude_deg / STEP_DEG
    nearest = float(table[int(np.floor(row + 0.5)), int(np.floor(column + 0.5))])
    if np.isnan(nearest):
        position = f"helio-ecliptic longitude {longitude_deg:.1f} deg, latitude {latitude_deg:.1f} deg"
        needed = "which must be outside the zone of solar avoidance, some 50 deg"
        raise InputError(f"the Sun is {separation_deg:.1f} deg from the target ({position}), {needed}", key="target")
    if lookup == "nearest":
        return nearest
    i, j = (min(int(at), size - 2) for at, size in zip((row, column), table.shape, strict=True))
    along, across = row - i, column - j
    weights = np.outer([1 - along, along], [1 - across, across])
    corners = table[i : i + 2, j : j + 2]
    weights[np.isnan(corners)] = 0.0
    return float(np.sum(weights * np.nan_to_num(corners)) / weights.sum())


#: Distance up to which a message warns that a row of a table may be the target itself, arcsec.
SAME_STAR_ARCSEC = 2.0
#: Largest number of neighbours that a message names.
MAX_NAMED = 4


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
        """Name of the spectrum, and the statement on its choice, empty if it is the star's own."""
        if self.file is not None:
            return self.file.name, ""
        if self.spectral_type:
            entry = library.embedded(self.spectral_type)
            if entry is not None:
                return entry["name"], ""
            nearest = library.nearest_spectrum(self.spectral_type)
            return nearest, f"of type {self.spectral_type}: {nearest}, the nearest type of the library"
        if self.temperature_k is not None:
            star_k = self.temperature_k
            nearest, (kelvin, _) = min(_typical().items(), key=lambda item: abs(np.log(item[1][0] / star_k)))
            return nearest, f"of {star_k:.0f} K: {nearest} ({kelvin:.0f} K), the nearest of the library"
        if self.bp_rp is not None:
            bp_rp = self.bp_rp
            nearest, (_, colour) = min(_typical().items(), key=lambda item: abs(item[1][1] - bp_rp))
            return nearest, f"of BP - RP = {bp_rp:.2f}: {nearest} ({colour:.2f}), the nearest colour of the library"
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
                star = star.at_magnitude(self.magnitude, library.known_band(self.band))
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
        named = ", ".join(f"{star.name} at {star.separation_arcsec:.3g} arcsec" for star in inside[:MAX_NAMED])
        named += f" and {len(inside) - MAX_NAMED} more" if len(inside) > MAX_NAMED else ""
        stars = "1 star" if len(inside) == 1 else f"{len(inside)} stars"
        text = f"NEIGHBOURS of {target}: the light of {stars} within {radius:g} arcsec is in the fibre ({named})"
        text += f"; assumption: {100 * self.share:g} % of it enters"
        chosen = [f"Light of {star.name}, {star.spectrum[1]}." for star in inside if star.spectrum[1]]
        if len(chosen) > MAX_NAMED:
            chosen = [*chosen[:MAX_NAMED], f"Spectra of {len(chosen) - MAX_NAMED} more neighbours are chosen alike."]
        same = [
            f"{star.name} is {star.separation_arcsec:.2g} arcsec from {target} and counts as a neighbour: if it is the "
            "star itself, name its row in star.neighbours_of."
            for star in inside
            if star.separation_arcsec < SAME_STAR_ARCSEC
        ]
        return [f"{text}; {beyond}." if outside else f"{text}.", *same, *chosen, *self.notes]


# Cached, since the flares and sweep values of a star have the same neighbours.
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
    rows = [row for row in library.library_table() if row["kept"] == "embedded" and row["name"] == row["spectral_type"]]
    stars = [Source.from_library(str(row["name"])) for row in rows]
    colours = [star.magnitude("Gaia BP") - star.magnitude("Gaia RP") for star in stars]
    return {star.name: (star.temperature_k or np.nan, colour) for star, colour in zip(stars, colours, strict=True)}


#: Names of columns of neighbours: those of the Gaia archive, astroquery, VizieR and CDS X-Match, and plain ones.
SEPARATIONS = ("separation", "separation_arcsec", "sep", "sep_arcsec", "angdist", "dstarcsec",
               "target_separation (deg)", "dist", "_r")  # fmt: skip
#: Columns of magnitudes, with their bands; the first that a row has counts. Gmag is Gaia's in VizieR.
MAGNITUDES = {"magnitude": "", "mag": "", "v": "V", "vmag": "V", "flux_v": "V", "phot_g_mean_mag": "Gaia G",
              "gmag": "Gaia G"}  # fmt: skip
TYPES = (*names.SPECTRAL_TYPES, "type")
SPECTRUM_FILES = ("file", "spectrum", "spectrum_file")
TEMPERATURES = ("teff_gspphot", "teff", "teff_val", "temperature", "temperature_k")
COLOURS = ("bp_rp", "bp-rp", "bprp")
#: All names of columns of neighbours that are read, with that of a magnitude's band.
NEIGHBOUR_COLUMNS = (
    *names.STARS, *SEPARATIONS, *names.RIGHT_ASCENSIONS, *names.DECLINATIONS, *MAGNITUDES, *names.BANDS, *TYPES,
    *SPECTRUM_FILES, *TEMPERATURES, *COLOURS,
)  # fmt: skip
_KEYS = {names.key_of(name) for name in (*NEIGHBOUR_COLUMNS, "target_separation")}
#: Largest number of rows; a fibre holds far fewer stars.
MAX_ROWS = 100_000


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
    if not 1 <= table.n <= MAX_ROWS:
        raise InputError(f"{named} must contain 1 to {MAX_ROWS} stars, not {table.n}", key="neighbours")
    name = table.first(names.STARS)
    titles = [table.text(name, row) or f"row {row + 1}" for row in range(table.n)]
    target_row = None if target is None or target.strip() not in titles else titles.index(target.strip())
    separations, notes = _separations(table, target_row, target)
    bands, kind, file, temperature, colour = map(
        table.first, (names.BANDS, TYPES, SPECTRUM_FILES, TEMPERATURES, COLOURS)
    )
    # Gmag is Gaia's in VizieR, gmag that of other surveys; a table may have both.
    gaia = next((name for name in table.names if names.divided_unit(name)[0] == "Gmag"), None)
    magnitudes = {
        column: band
        for name, band in MAGNITUDES.items()
        if (column := gaia if name == "gmag" else table.first((name,)))
    }
    stars = []
    for k, title in enumerate(titles):
        if k != target_row:
            spectrum = table.text(file, k)
            stars.append(Neighbour(
                title, float(separations[k]), *_magnitude(table, k, magnitudes, bands), table.text(kind, k),
                path.parent / spectrum if spectrum else None, table.number(temperature, k, "K", above=0.0),
                table.number(colour, k, "mag"),
            ))  # fmt: skip
    keys = {name: {names.key_of(name), names.key_of(names.divided_unit(name)[0])} for name in table.names}
    notes += table.unused([name for name in table.names if not keys[name] & _KEYS])
    return tuple(sorted(stars, key=lambda star: star.separation_arcsec)), notes


def _magnitude(table: Rows, row: int, columns: dict[str, str], bands: str | None) -> tuple[float | None, str]:
    """Return magnitude, None if unknown, and band of a star, from the first of `columns` (with bands) with a value."""
    for name, band in columns.items():
        value = table.number(name, row, "mag")
        if value is not None:
            band = band or names.band_in_name(name) or table.text(bands, row) or "V"
            # Only stars within the fibre need a band with a passband.
            with contextlib.suppress(InputError):
                band = library.known_band(band)
            return value, band
    return None, "V"


def _separations(table: Rows, target_row: int | None, target: str | None) -> tuple[Float, tuple[str, ...]]:
    """Return the separations from the target, arcsec, shape (n_row,), and statements on how they were found."""
    ra, dec = table.first(names.RIGHT_ASCENSIONS), table.first(names.DECLINATIONS)
    if ra is not None and dec is not None and target is not None:
        return _from_positions(table, ra, dec, target_row, target), ()
    name = table.first(SEPARATIONS)
    if name is None:
        fault, key = f"{table.label} has the columns {shown(', '.join(table.names), 300)}", "neighbours"
        needed = "ra and dec"
        if ra is not None:
            fault, key = f"{fault} and no position of the star itself", "neighbours_of"
            needed = "star.neighbours_of: the star's own row by name, or its coordinates"
        raise InputError(f"{fault}, but needs separation (arcsec), or {needed}", key=key)
    if target is not None and target_row is None:
        fault = f"{table.label} has no row named {shortened(target)}, and no positions"
        raise InputError(f"{fault}; give the name of a row, which is then left out", key="neighbours_of")
    has_unit, key = getattr(table.table[name], "unit", None) is not None, names.key_of(name)
    if not has_unit and key == "_r":
        remedy = "use a table with units (ECSV, FITS, VOTable), or the column separation, arcsec"
        raise table.error(f"the column {name} states no unit; {remedy}", name)
    values = _column(table, name, lambda row: table.number(name, row, "arcsec"))
    if (negative := ~(values >= 0)).any():
        row = int(np.argmax(negative))
        raise table.error(f"{name} in row {row + 1} must be 0 or above, not {table.text(name, row)}", name)
    if has_unit or key != "dist":
        return values, ()
    # ADQL's DISTANCE is in degrees.
    note = f"Separations are the column {name} of {table.label}, read as degrees since it states no unit."
    return values * 3600.0, (note,)


def _from_positions(table: Rows, ra: str, dec: str, target_row: int | None, target: str) -> Float:
    """Return the separations of the rows' positions from the target's row or coordinates, arcsec, shape (n_row,)."""
    from astropy.coordinates import angular_separation

    east = np.radians(_column(table, ra, lambda row: table.degrees(ra, row, right_ascension=True)))
    north = np.radians(_column(table, dec, lambda row: table.degrees(dec, row, right_ascension=False)))
    if target_row is not None:
        place = float(east[target_row]), float(north[target_row])
    else:
        try:
            position = parse_position(target)
        except InputError as error:
            fault = f"{table.label} has no row named {shortened(target)}, and it is not a position"
            remedy = "give the name of the star's own row, or coordinates such as '290.68 +11.12'"
            raise InputError(f"{fault}; {remedy}", key="neighbours_of") from error
        place = float(position.ra.rad), float(position.dec.rad)
    return np.asarray(np.degrees(angular_separation(*place, east, north)) * 3600.0)


def _column(table: Rows, name: str, read: Callable[[int], float | None]) -> Float:
    """Return the values of a column that must have one in each row."""
    values = list(map(read, range(table.n)))
    if None in values:
        raise table.error(f"row {values.index(None) + 1} needs a {name}", name)
    return np.array(values, np.float64)
