"""A study's plan: from which orbit and when, what must hold for a target to be seen, targets and how they flare."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened
from mauvecl.host.files.parsed import shown
from mauvecl.host.files.text_table import read_text_table
from mauvecl.host.records import holds_truth, input_error
from mauvecl.study.sections import Part

if TYPE_CHECKING:
    from mauvecl.host.orbit.limits import Limits
    from mauvecl.host.orbit.orbit import Orbit
    from mauvecl.host.orbit.targets import Target
    from mauvecl.host.orbit.time_grid import TimeGrid
    from mauvecl.lightcurve.flares.rates import Rates
    from mauvecl.lightcurve.search.completeness import DurationLaw
    from mauvecl.study.study import Study

#: A number, or the word for no limit.
Limit = float | Literal["none"]
#: Rows of a table of targets, at most: a page each.
MOST_TARGETS = 500


class LimitsText(Part):
    """What must hold for a target to be seen; "none" is no limit. See `host.orbit.limits.Limits`."""

    earth_limb_deg: Limit = 25.0
    sun_deg: Limit = 46.0
    moon_deg: Limit = 25.0
    declination_deg: tuple[float, float] | Literal["none"] = (-46.4, 31.8)
    normal_cone_deg: Limit = "none"
    eclipse: Literal["any", "only", "never"] = "any"
    proton_flux: Limit = 10.0
    anomaly: tuple[tuple[float, float], ...] = ()
    shortest_s: Annotated[float, Field(ge=0)] = 0.0
    duty_cycle: Annotated[float, Field(gt=0, le=1)] = 1.0

    @field_validator("earth_limb_deg", "sun_deg", "moon_deg", "normal_cone_deg", "proton_flux", mode="before")
    @classmethod
    def _number_or_none(cls, given: Any, info: ValidationInfo) -> Any:
        if isinstance(given, str) and given.strip().lower() == "none":
            return "none"
        if holds_truth(given):
            # Refused by `Record`.
            return given
        try:
            return float(given)
        except (TypeError, ValueError):
            raise ValueError(f"orbit.limits.{info.field_name} = {shown(given)}, expected a number, or none") from None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        self.limits()
        return self

    def limits(self) -> Limits:
        """As the host takes them."""
        from mauvecl.host.orbit.limits import Limits

        given = {name: getattr(self, name) for name in type(self).model_fields}
        values: dict[str, Any] = {name: None if value == "none" else value for name, value in given.items()}
        return Limits(**values)


class OrbitQuestion(Part):
    """Which orbit, when, which targets.

    Attributes
    ----------
    tle : Path, optional
        Two-line elements in place of the embedded ones.
    kind : {"auto", "tle", "mean"}
        See `host.orbit.orbit.Orbit`.
    start : str
        UTC.
    days, step_s : float
    targets : tuple of str
        Names or coordinates; those of `plan` where there are none.
    simbad : bool
        Ask SIMBAD for names that are not embedded.
    limits : LimitsText
    """

    tle: Path | None = None
    kind: Literal["auto", "tle", "mean"] = "auto"
    start: str = "2027-01-01"
    days: Annotated[float, Field(gt=0)] = 365.0
    step_s: Annotated[float, Field(gt=0)] = 60.0
    targets: tuple[str, ...] = ()
    simbad: bool = False
    limits: LimitsText = LimitsText()

    @field_validator("start", mode="before")
    @classmethod
    def _as_text(cls, given: Any) -> Any:
        """TOML has dates of its own."""
        if isinstance(given, datetime.datetime) and given.tzinfo is not None:
            given = given.astimezone(datetime.UTC).replace(tzinfo=None)
        return given.isoformat() if isinstance(given, datetime.date) else given

    def orbit(self) -> Orbit:
        """As the host takes it."""
        from mauvecl.host.orbit.orbit import Orbit

        return Orbit.load(self.tle, self.kind)

    def times(self) -> TimeGrid:
        """The times that are looked at."""
        from mauvecl.host.orbit.time_grid import TimeGrid

        return TimeGrid(self.start, self.days, self.step_s)


class PlanTarget(Part):
    """A star of a plan: where it is, what it shines like, how often it flares.

    What is not given is looked up by its name in the embedded list, and follows from its type.

    Attributes
    ----------
    name : str
    coordinates : str, optional
        In place of the name's.
    spectral_type : str, optional
        Such as "M3V": the nearest spectrum of the library stands for it.
    magnitude : float, optional
        V.
    distance_pc : float, optional
    rates : str, optional
        "G", "K", "M" or "sunlike"; by type unless given.
    mass_msun, age_myr : float, optional
        Both: rates by Davenport et al. 2019.
    alpha, rate_per_day, at_erg : float, optional
        All three: a power law of bolometric energies, through so many flares a day of `at_erg` or more.
    rates_file : Path, optional
        A cumulative distribution of one's own, in `rates_band`.
    rates_band : str
    """

    name: str
    coordinates: str | None = None
    spectral_type: str | None = None
    magnitude: float | None = None
    distance_pc: Annotated[float, Field(gt=0)] | None = None
    rates: Literal["G", "K", "M", "sunlike"] | None = None
    mass_msun: Annotated[float, Field(gt=0)] | None = None
    age_myr: Annotated[float, Field(gt=0)] | None = None
    alpha: Annotated[float, Field(gt=1)] | None = None
    rate_per_day: Annotated[float, Field(gt=0)] | None = None
    at_erg: Annotated[float, Field(gt=0)] | None = None
    rates_file: Path | None = None
    rates_band: str = "bolometric"

    @model_validator(mode="after")
    def _one_distribution(self) -> Self:
        for names in (("mass_msun", "age_myr"), ("alpha", "rate_per_day", "at_erg")):
            given = [name for name in names if getattr(self, name) is not None]
            if given and len(given) < len(names):
                raise ValueError(f"{self.name} has {' and '.join(given)}, expected all of {', '.join(names)} or none")
        ways = [
            name
            for name, key in (("rates", "rates"), ("mass and age", "mass_msun"), ("alpha", "alpha"),
                              ("rates_file", "rates_file"))
            if getattr(self, key) is not None
        ]  # fmt: skip
        if len(ways) > 1:
            raise ValueError(f"{self.name} has flare rates by {' and by '.join(ways)}, expected one of them")
        return self

    def target(self, simbad: bool) -> Target:
        """Its place and what is known of it."""
        from dataclasses import replace

        from mauvecl.host.orbit.targets import Target

        if self.coordinates is None:
            return Target.of(self.name, name=self.name, simbad=simbad)
        place = Target.of(self.coordinates, name=self.name)
        try:
            known = Target.of(self.name)
        except InputError:
            return place
        return replace(known, name=self.name, ra_deg=place.ra_deg, dec_deg=place.dec_deg, source="given")

    def distribution(self, spectral_type: str) -> Rates:
        """How often it flares.

        Raises
        ------
        InputError
            For a type that no preset stands for.
        """
        from mauvecl.lightcurve.flares.rates import BOLOMETRIC, EXPONENTS, PowerLaw, RateTable, davenport2019, preset

        if self.mass_msun is not None and self.age_myr is not None:
            return davenport2019(mass_msun=self.mass_msun, age_myr=self.age_myr)
        if self.alpha is not None and self.rate_per_day is not None and self.at_erg is not None:
            return PowerLaw.through(self.alpha, self.at_erg, self.rate_per_day, band=BOLOMETRIC)
        if self.rates_file is not None:
            return RateTable.read(self.rates_file, self.rates_band)
        kind = self.rates or spectral_type.strip()[:1].upper()
        if kind not in ("G", "K", "M", "sunlike"):
            alpha = EXPONENTS.get(kind)
            told = "" if alpha is None else f" beside an exponent of {alpha} (Althukair & Tsiklauri 2023)"
            raise InputError(
                f"flare rates of {self.name}, of the type {shortened(spectral_type)}, are not known{told}, expected "
                "alpha with rate_per_day and at_erg, rates, mass_msun and age_myr, or rates_file"
            )
        return preset(kind)


class PlanQuestion(Part):
    """A campaign: targets, how long each is observed at most, how long flares last; `search` says how they are found.

    Attributes
    ----------
    targets : tuple of PlanTarget
    hours : float, optional
        Of exposure for each target; all that it is seen unless given.
    half_width_s, at_erg, exponent, scatter_dex : float
        See `lightcurve.completeness.DurationLaw`.
    completeness : {"injections", "closed form"}
        By flares put into drawn noise and searched for, or at once, for white noise.
    along_orbit : bool
        Whether each target's frames have the temperature and the hits by particles that the orbit gives them; those of
        the study otherwise.
    injections : int
        Of each half-width.
    best_months : int
    report : {"pdf", "html"}
    """

    targets: tuple[PlanTarget, ...] = ()
    hours: Annotated[float, Field(gt=0)] | None = None
    half_width_s: Annotated[float, Field(gt=0)] = 100.0
    at_erg: Annotated[float, Field(gt=0)] = 1e33
    exponent: Annotated[float, Field(ge=0, lt=1)] = 0.39
    scatter_dex: Annotated[float, Field(ge=0, le=2)] = 0.3
    completeness: Literal["injections", "closed form"] = "injections"
    along_orbit: bool = True
    injections: Annotated[int, Field(ge=20, le=1_000_000)] = 100
    best_months: Annotated[int, Field(ge=1, le=12)] = 3
    report: Literal["pdf", "html"] = "pdf"

    @model_validator(mode="after")
    def _some(self) -> Self:
        names = [target.name for target in self.targets]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"the plan has the target {twice!r} twice, expected different ones")
        return self

    def law(self) -> DurationLaw:
        """How long flares last."""
        from mauvecl.lightcurve.search.completeness import DurationLaw

        return DurationLaw(self.half_width_s, self.at_erg, self.exponent, self.scatter_dex)


def targets_of(study: Study) -> list[Target]:
    """Where a study's targets are: those of `orbit`, or those of `plan`.

    Raises
    ------
    InputError
        If there are none, or one is unknown.
    """
    from mauvecl.host.orbit.targets import Target

    o = study.orbit
    targets = [Target.of(text, simbad=o.simbad) for text in o.targets] or [
        t.target(o.simbad) for t in study.plan.targets
    ]
    if not targets:
        raise InputError("no targets, expected names or coordinates, such as `orbit.targets='eps Eri'`")
    names = [one.name for one in targets]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"the target {twice!r} is named twice, expected different ones")
    return targets


def read_targets(path: Path) -> list[dict[str, Any]]:
    """Targets of a table, CSV or ECSV: a column ``name``, and any other key of `PlanTarget`.

    ``ra`` and ``dec`` in degrees stand for coordinates, ``V`` for the magnitude. Empty cells are not given.

    Raises
    ------
    InputError
        If it cannot be read, has no names, or other columns.
    """
    import numpy as np

    table = read_text_table(path, "table of targets")
    named = f"table of targets {shortened(path.name)}"
    columns = {str(name).strip(): name for name in table.colnames}
    if "V" in columns:
        columns["magnitude"] = columns.pop("V")
    if "name" not in columns:
        raise InputError(f"{named} has the columns {shown(', '.join(columns), 200)}, expected one called name")
    keys = {*PlanTarget.model_fields, "ra", "dec"}
    other = next((name for name in columns if name not in keys), None)
    if other is not None:
        raise InputError(f"{named} has the column {shortened(other)}, expected some of {', '.join(sorted(keys))}")
    if not 1 <= len(table) <= MOST_TARGETS:
        raise InputError(f"{named} holds {len(table)} targets, expected 1 to {MOST_TARGETS}")
    targets = []
    for number, row in enumerate(table, 1):
        one: dict[str, Any] = {}
        for key, name in columns.items():
            value = row[name]
            if not np.ma.is_masked(value) and str(value).strip():
                one[key] = value.item() if hasattr(value, "item") else value
        if ("ra" in one) != ("dec" in one) or ("ra" in one and "coordinates" in one):
            raise InputError(
                f"{named}: row {number} has only one of ra and dec, or coordinates too, expected both or none"
            )
        odd = next((key for key in ("ra", "dec") if key in one and not _is_number(one[key])), None)
        if odd is not None:
            raise InputError(
                f"{named}: row {number} has {odd} = {shortened(str(one[odd]))}, expected degrees; sexagesimal ones go "
                "into a column coordinates"
            )
        if "ra" in one:
            one["coordinates"] = f"{one.pop('ra')} {one.pop('dec')}"
        if "name" in one:
            one["name"] = str(one["name"])
        file = one.get("rates_file")
        if isinstance(file, str):
            one["rates_file"] = path.parent / file
        try:
            PlanTarget.model_validate(one)
        except ValidationError as error:
            raise input_error(f"{named}: row {number}", PlanTarget, error) from error
        targets.append(one)
    return targets


def _is_number(cell: Any) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def find_plan_files(data: dict[str, Any], folder: Path) -> None:
    """Put the folder of a study before the names of its orbit's and rates' files."""
    orbit, plan = data.get("orbit"), data.get("plan")
    if isinstance(orbit, dict) and isinstance(orbit.get("tle"), str):
        orbit["tle"] = str(folder / orbit["tle"])
    targets = plan.get("targets") if isinstance(plan, dict) else None
    for one in targets if isinstance(targets, list) else ():
        if isinstance(one, dict) and isinstance(one.get("rates_file"), str):
            one["rates_file"] = str(folder / one["rates_file"])


def without_usual_plan(data: dict[str, Any], study: Study) -> None:
    """Leave out of a study's text what it does not say of orbit and plan; files by their full names."""
    for name, usual in (("orbit", OrbitQuestion()), ("plan", PlanQuestion())):
        if getattr(study, name) == usual:
            del data[name]
    if "orbit" in data and study.orbit.limits == LimitsText():
        del data["orbit"]["limits"]
    find_plan_files(data, Path.cwd())
