"""Study sections for orbit, visibility limits, targets and their flare rates, and campaign plans."""

from __future__ import annotations

import contextlib
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import field_validator, model_validator

from mauvecl.host.orbit import Limits, OrbitKind
from mauvecl.host.tables import names
from mauvecl.schema import fields
from mauvecl.schema.errors import InputError, shortened, shown
from mauvecl.schema.fields import Flag, Help, Range, Slider, Unit, first
from mauvecl.schema.section import Section, built, check_all, check_different, check_one, number_or_text, setting
from mauvecl.study.observation import utc_time

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.flares.energies import Rates
    from mauvecl.host.orbit.orbit import Orbit, Target, TimeGrid
    from mauvecl.host.tables.table import Rows
    from mauvecl.search.completeness import DurationLaw

#: Largest number of rows of a table of targets; a plan has a page for each.
MAX_TARGETS = 500


class OrbitQuestion(Section):
    """Orbit, time grid, targets and visibility limits."""

    start: str = setting(
        "2027-01-01",
        "First day or time, UTC",
        flag="--start",
        label="First day",
        hint="The first day of the time that is looked at, UTC.",
        kind="day",
    )
    days: fields.Days = setting(
        365.0,
        "Length of time",
        flag="--days",
        hint="How many days from the first one on are looked at: 365 show every season.",
        most=1000,
        slider=Slider(5, 730, 5),
    )
    step_s: fields.Duration = setting(60.0, "Time between the computed positions", flag="--step")
    tle: Path | None = setting(None, "File of two-line elements, newer than the embedded ones", flag="--tle")
    kind: OrbitKind = setting(
        "auto", "Model of the orbit", flag="--orbit", choices="tle, mean, or auto (mean far from the elements' epoch)"
    )
    targets: tuple[str, ...] = setting((), "Name of a target, or coordinates such as '290.0 -11.2'", flag="--look-at")
    simbad: bool = setting(False, "Ask SIMBAD for names that are not embedded; needs mauvecl[names]", flag="--simbad")
    limits: Limits = Limits()

    _time = field_validator("start")(utc_time)

    def _check_values(self) -> None:
        if self.step_s > self.days * fields.DAY_S:
            raise InputError.of("step_s", self.step_s, f"at most the {self.days:g} days that are looked at", unit="s")

    def orbit(self) -> Orbit:
        """Load the orbit."""
        from mauvecl.host.orbit.orbit import Orbit

        return Orbit.load(self.tle, self.kind)

    def times(self) -> TimeGrid:
        """Return the time grid, with steps that are shortened where the last one would end after the days."""
        from mauvecl.host.orbit.orbit import TimeGrid

        times = TimeGrid(self.start, self.days, self.step_s)
        step_s = self.days * fields.DAY_S / times.n
        return times if math.isclose(step_s, self.step_s) else replace(times, step_s=step_s)


#: Keys of a target that hold paths, relative to its table or the study file.
PATH_KEYS = ("rates_file", "neighbours")

#: Keys of flare rates, each of another distribution.
RATES = ("rates", "mass_msun", "alpha", "rates_file")


class PlanTarget(Section):
    """Position, spectrum and flare rates of a star in a plan.

    Missing values are looked up by name in the embedded list of stars, or follow from the spectral type.
    """

    name: Annotated[str, Help("Name of the target")]
    coordinates: str | None = setting(None, "Coordinates, which replace those of the name")
    spectral_type: str | None = setting(None, "Spectral type, such as M3V; the nearest spectrum of the library is used")
    magnitude: fields.Magnitude | None = setting(None, "V magnitude")
    distance_pc: fields.Distance | None = setting(None, "Distance")
    rates: Literal["G", "K", "M", "sunlike"] | None = setting(
        None, "Published flare rates", usual="the spectral type's"
    )
    mass_msun: Annotated[float, Unit("solMass"), Range(0, open_low=True)] | None = setting(
        None, "Mass, for the rates of Davenport et al. 2019; needs the age"
    )
    age_myr: Annotated[float, Unit("Myr"), Range(0, open_low=True)] | None = setting(None, "Age")
    alpha: fields.RateExponent | None = setting(None, "Exponent of a power law of bolometric energies")
    rate_per_day: Annotated[float, Unit("1 / d"), Range(0, open_low=True)] | None = setting(
        None, "Rate of flares above an energy, for the power law"
    )
    at_erg: fields.Energy | None = setting(None, "That energy")
    rates_file: Path | None = setting(None, "File with a cumulative distribution of energies")
    rates_band: str = setting("bolometric", "Band of the energies in that file")
    neighbours: Path | None = setting(None, "Table of other stars near the target, as for a star")
    neighbours_of: str | None = setting(None, "The target's own row in that table, or its coordinates")
    neighbour_share: fields.Share = setting(
        1.0, "Share of the light of neighbours within the fibre's radius that enters it; an assumption"
    )

    unused: tuple[str, ...] = setting((), "Columns of its table that are not read")

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, data: Any) -> Any:
        return {"name": data} if isinstance(data, str) else data

    def _check_values(self) -> None:
        check_all(self, self.name, "mass_msun", "age_myr")
        check_all(self, self.name, "alpha", "rate_per_day", "at_erg")
        check_one(self, self.name, *RATES)

    def target(self, simbad: bool) -> Target:
        """Look up the target; values that are given replace those that are known by its name."""
        from mauvecl.host.orbit.orbit import Target

        if self.coordinates is None:
            try:
                target = Target.of(self.name, name=self.name, simbad=simbad)
            except InputError as error:
                if simbad or not self.unused:
                    raise
                fault = f"target {shortened(self.name)} is not in the embedded list, and its table has no coordinates"
                remedy = f"give columns ra and dec, or coordinates, besides {shown(', '.join(self.unused), 200)}"
                raise InputError(f"{fault}; {remedy}", key="coordinates") from error
        else:
            target = Target.of(self.coordinates, name=self.name)
            with contextlib.suppress(InputError):
                position: dict[str, Any] = {"ra_deg": target.ra_deg, "dec_deg": target.dec_deg, "source": "given"}
                target = replace(Target.of(self.name), name=self.name, **position)
        values = {name: getattr(self, name) for name in ("spectral_type", "magnitude", "distance_pc")}
        return replace(target, **{name: value for name, value in values.items() if value not in (None, "")})

    def distribution(self, spectral_type: str) -> Rates:
        """Return the flare rates; raises InputError if none are given and the spectral type has no preset."""
        from mauvecl.flares.energies import BOLOMETRIC, EXPONENTS, TYPICAL, PowerLaw, RateTable, davenport2019, preset

        if self.mass_msun is not None and self.age_myr is not None:
            return davenport2019(mass_msun=self.mass_msun, age_myr=self.age_myr)
        if self.alpha is not None and self.rate_per_day is not None and self.at_erg is not None:
            return PowerLaw.through(self.alpha, self.at_erg, self.rate_per_day, band=BOLOMETRIC)
        if self.rates_file is not None:
            return RateTable.read(self.rates_file, self.rates_band)
        kind = self.rates or spectral_type.strip()[:1].upper()
        if kind not in (*TYPICAL, "sunlike"):
            alpha = EXPONENTS.get(kind)
            exception = "" if alpha is None else f" except for an exponent of {alpha} (Althukair & Tsiklauri 2023)"
            fault = f"flare rates of {self.name}, of the type {shortened(spectral_type)}, are unknown{exception}"
            remedy = "give alpha with rate_per_day and at_erg, rates, mass_msun and age_myr, or rates_file"
            raise InputError(f"{fault}; {remedy}", key="rates")
        return preset(kind)


class PlanQuestion(Section):
    """Campaign: targets, exposure time per target, durations of flares, and how completeness is computed."""

    targets: tuple[PlanTarget, ...] = setting(
        (),
        "Targets of the campaign",
        flag=Flag(
            "--targets",
            kind=Path,
            read=lambda path, _: read_targets(path),
            help=Help("Table of targets (CSV, ECSV, FITS, VOTable)", "name, and what is known of each"),
        ),
    )
    hours: Annotated[float, Unit("h"), Range(0, open_low=True)] | None = setting(
        None,
        "Exposure of each target at most",
        flag="--hours",
        usual="all",
        label="Hours on each target",
        hint="How long each target is observed, at most: never longer than it is seen.",
        first="100",
        slider=Slider(10, 1000, 10),
    )
    half_width_s: fields.Duration = setting(100.0, "Half-width of flares of the energy at_erg")
    at_erg: fields.Energy = setting(1e33, "That energy")
    exponent: fields.DurationExponent = setting(0.39, "Exponent with which half-widths grow with energy")
    scatter_dex: fields.DurationScatter = setting(0.3, "Scatter of half-widths about that law, dex")
    completeness: Literal["injections", "closed form"] = setting(
        "closed form",
        "Completeness",
        flag="--completeness",
        choices="injections (into simulated noise) or 'closed form' (at once)",
    )
    along_orbit: bool = setting(True, "Whether frames have the detector temperature and particle flux along the orbit")
    injections: Annotated[int, Range(20, 1_000_000)] = setting(100, "Injections of each half-width")
    best_months: Annotated[int, Range(1, 12)] = setting(3, "Number of best months in the report")
    report: Literal["pdf", "html"] = setting("pdf", "Form of the report", flag="--report")

    def _check_values(self) -> None:
        check_different([target.name for target in self.targets], "the plan's target", "targets")

    def law(self) -> DurationLaw:
        """Return the relation between energy and duration of flares."""
        from mauvecl.search.completeness import DurationLaw

        return DurationLaw(self.half_width_s, self.at_erg, self.exponent, self.scatter_dex)


def targets_of(orbit: OrbitQuestion, plan: PlanQuestion) -> list[Target]:
    """Look up the targets of `orbit`, or else those of `plan`."""
    from mauvecl.host.orbit.orbit import Target

    targets = [Target.of(text, simbad=orbit.simbad) for text in orbit.targets]
    targets = targets or [target.target(orbit.simbad) for target in plan.targets]
    if not targets:
        remedy = "give names or coordinates, such as `look_at='eps Eri'` or orbit.targets=['eps Eri'] in a study"
        raise InputError(f"there are no targets; {remedy}", key="orbit.targets")
    check_different([target.name for target in targets], "the target", "orbit.targets")
    return targets


def read_targets(path: str | Path | Table | Any) -> list[dict[str, Any]]:
    """Read targets from a table of any format or in memory; see `targets_in`.

    Paths in a file are relative to its folder, those in a table in memory to the working folder.
    """
    from mauvecl.host.tables.opening import read_table

    if fields.is_table(path):
        return targets_in(read_table(path, "table of targets"), "table of targets", Path())
    named = f"table of targets {shortened(Path(path).name)}"
    return targets_in(read_table(Path(path), "table of targets"), named, Path(path).parent)


#: Names of columns of targets, in any case, by the keys of `PlanTarget`; keys themselves are names as well.
TARGET_COLUMNS = {
    "name": (*names.STARS, "hostname"), "ra": names.RIGHT_ASCENSIONS, "dec": names.DECLINATIONS,
    "spectral_type": names.SPECTRAL_TYPES,
    "magnitude": ("V", "vmag", "mag_v", "v_mag", "johnson_v", "flux_v", "sy_vmag", "mag"),
    "distance_pc": ("distance", "dist", "d_pc", "dist_pc", "sy_dist"),
    "parallax": ("parallax", "plx", "plx_value", "parallax_mas", "plx_mas"),
    "mass_msun": ("mass", "st_mass"), "age_myr": ("age",),
    "coordinates": ("coord", "coords", "position", "coord1", "radec", "ra_dec", "ra/dec"),
}  # fmt: skip


def targets_in(table: Table, named: str, folder: Path | None = None) -> list[dict[str, Any]]:
    """Return the targets of a table with a column ``name`` and any other keys of `PlanTarget`, in any case.

    ``ra`` and ``dec`` in degrees, or in the unit that they state, replace ``coordinates``; ``V`` replaces ``magnitude``
    and ``parallax`` a distance. Empty cells are ignored, and other columns are left out. Messages call the table
    `named`; paths in it are relative to a folder, without which columns of paths are refused.
    """
    from mauvecl.host.tables.table import Rows

    rows = Rows(table, named)
    keys = [key for key in PlanTarget.model_fields if key != "unused"]
    columns = {key: rows.first((key, *TARGET_COLUMNS.get(key, ()))) for key in (*keys, "ra", "dec", "parallax")}
    if columns["alpha"] is not None and columns["ra"] == columns["alpha"]:
        # Next to a declination it is a right ascension, otherwise the exponent of a distribution.
        columns["alpha" if columns["dec"] is not None else "ra"] = None
    if columns["name"] is None:
        raise InputError(f"{named} needs a column called name, but has {shown(', '.join(rows.names), 200)}", key="name")
    for key in PATH_KEYS if folder is None else ():
        if column := columns[key]:
            raise InputError(f"{named} has the column {shortened(column)}, but must not name files", key=column)
    for key in ("distance_pc", "mass_msun", "age_myr"):
        column = columns[key]
        if column and names.key_of(column) in ("distance", "dist", "mass", "age") and not rows.unit(column):
            # Without its unit, a distance, mass or age is unknown.
            columns[key] = None
    if not 1 <= rows.n <= MAX_TARGETS:
        raise InputError(f"{named} must hold 1 to {MAX_TARGETS} targets, but holds {rows.n}", key="name")
    unused = tuple(name for name in rows.names if name not in columns.values())
    return [_target(rows, columns, row, folder, unused) for row in range(rows.n)]


def _target(
    rows: Rows, columns: dict[str, str | None], row: int, folder: Path | None, unused: tuple[str, ...]
) -> dict[str, Any]:
    """Return the data of a target from the cells of its row."""
    named = f"{rows.label}: row {row + 1}"
    target: dict[str, Any] = {}
    for key, field in PlanTarget.model_fields.items():
        column = columns.get(key)
        text = rows.text(column, row)
        if column is None or not text or (key == "coordinates" and names.is_missing_position(text)):
            continue
        unit = first(field, Unit)
        # The field itself refuses text that is not a number, in its own words.
        is_number = (unit or first(field, Range)) and not isinstance(number_or_text(text), str)
        target[key] = rows.number(column, row, unit.name if unit else "") if is_number else text
    _check_band(rows, columns["magnitude"], row)
    parallax = columns["parallax"]
    if parallax is not None and "distance_pc" not in target:
        value = rows.number(parallax, row, "mas")
        target |= {"distance_pc": 1000.0 / value} if value is not None and value > 0 else {}
    if (coordinates := _coordinates(rows, columns, row, target)) is not None:
        target["coordinates"] = coordinates
    for key in PATH_KEYS:
        if folder is not None and isinstance(target.get(key), str):
            target[key] = folder / target[key]
    of_rates = [key for key in ("mass_msun", "age_myr") if key in target]
    if len(of_rates) == 1 and (column := columns[of_rates[0]]) and names.key_of(column) != of_rates[0]:
        # Catalogues have the mass of most stars and the age of few.
        del target[of_rates[0]]
        unused += (column,)
    if unused:
        target["unused"] = unused
    built(PlanTarget, target, named)
    return target


def _check_band(rows: Rows, column: str | None, row: int) -> None:
    """Raise InputError if brackets or another column state a band other than V for a magnitude of no named band."""
    if column is None or not rows.text(column, row):
        return
    if names.key_of(names.divided_unit(column)[0]) not in ("mag", "magnitude"):
        return
    bands = (names.band_in_name(column), rows.text(rows.first(names.BANDS), row))
    if odd := next((band for band in bands if band and not re.fullmatch(r"(?i)(?:johnson[\s_]*)?v", band)), None):
        raise rows.error(f"row {row + 1} has {column} in the band {shortened(odd)}; give a magnitude in V", column)


def _coordinates(rows: Rows, columns: dict[str, str | None], row: int, target: dict[str, Any]) -> str | None:
    """Return the coordinates of a target in degrees from the columns ra and dec, or None if it has none there.

    Raises InputError if only one of the two is given, if sexagesimal ones differ, and if a star without any is not in
    the embedded list.
    """
    from mauvecl.host.stars.library import by_key, name_key

    ra, dec = columns["ra"], columns["dec"]
    n_angles = sum(bool(rows.text(name, row)) for name in (ra, dec))
    if n_angles == 1 or (n_angles and "coordinates" in target):
        raise InputError(f"{rows.label}: row {row + 1} needs either coordinates, or both ra and dec", key="coordinates")
    if ra is not None and dec is not None and n_angles:
        east, north = (rows.degrees(name, row, right_ascension=name == ra) for name in (ra, dec))
        second = rows.first(names.SEXAGESIMAL)
        other_east = None if second in (None, ra) else rows.degrees(second, row, right_ascension=True)
        if other_east is not None and east is not None and abs((other_east - east + 180) % 360 - 180) > 0.1:
            cells = f"{ra} = {rows.text(ra, row)} and {second} = {rows.text(second, row)}"
            fault = f"row {row + 1} has {cells}, which differ"
            raise rows.error(f"{fault}; give numbers in degrees, or only one of these columns", ra)
        return f"{east!r} {north!r}"
    if "coordinates" not in target and name_key(name := target.get("name", "")) not in by_key():
        for column in filter(None, (ra, columns["coordinates"])):
            text = str(rows.table[column][row])
            # The cell is not empty, but says that a coordinate or a pair of them is not a number.
            if text.strip().lower() == "nan" or names.is_missing_position(text):
                fault = f"row {row + 1} has no coordinates ({column} = {' '.join(text.split())}), and {shortened(name)}"
                remedy = "give its coordinates, or a name of the list"
                raise rows.error(f"{fault} is not in the embedded list; {remedy}", column)
    return None
