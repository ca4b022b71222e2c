"""The study: a question as data, read from TOML, changed by flags and converted to expectations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, ValidationError, model_validator

from mauvecl.host.files.parsing import possible, read_text, toml
from mauvecl.host.orbit.observing_limits import Limits
from mauvecl.noise.processes import NONE, Processes
from mauvecl.noise.unknowns import COURSES
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import AnyUnit
from mauvecl.schema.records import input_error
from mauvecl.schema.section import Section
from mauvecl.schema.text import shortened
from mauvecl.study.calibrations import CalibrateQuestion
from mauvecl.study.changes import ChangeQuestion
from mauvecl.study.data import DataChoice
from mauvecl.study.flare_light import drop_default_spectrum
from mauvecl.study.measurements import MeasureQuestion
from mauvecl.study.nuisances import NuisanceChoice
from mauvecl.study.orbits import OrbitQuestion, PlanQuestion
from mauvecl.study.quantities import QUANTITIES
from mauvecl.study.questions import (
    Axis,
    BulkQuestion,
    CampaignQuestion,
    LimitQuestion,
    MapQuestion,
    SignalQuestion,
    Sweep,
)
from mauvecl.study.searches import InjectionQuestion, SearchChoice
from mauvecl.study.sections import Flare, Observation, Run, SkyLight, Star, Unknowns
from mauvecl.study.stare_section import EventChoice, StareQuestion
from mauvecl.study.study_text import (
    locate_files,
    parse_toml_value,
    read_embedded_study,
    set_key,
    with_file_digests,
    with_paths,
)

#: Sections that a study's text leaves out if they have their default values.
OMITTED = (
    "bulk", "nuisances", "stare", "events", "search", "injections", "orbit", "plan", "measure", "data", "calibrate",
    "change",
)  # fmt: skip
#: The paper's two stars.
PAPER_STARS = (Star(library="K3V", magnitude=3.7), Star(library="G2V", magnitude=7.4))


@validated
class Study(Section):
    """Everything that an answer depends on; the default is the paper's question.

    Examples
    --------
    >>> import tomllib
    >>> from mauvecl import Study
    >>> study = Study().with_settings(["run.fap=0.01", "star.0.magnitude=6"])
    >>> study.run.fap, study.star[0].library, study.star[0].magnitude
    (0.01, 'K3V', 6.0)
    >>> study == Study.build(tomllib.loads(study.toml()), "text")
    True
    """

    star: Annotated[tuple[Star, ...], Field(min_length=1)] = PAPER_STARS
    flare: Flare = Flare()
    observation: Observation = Observation()
    sky: SkyLight = SkyLight()
    processes: Processes = NONE
    nuisances: NuisanceChoice = NuisanceChoice()
    run: Run = Run()
    campaign: CampaignQuestion = CampaignQuestion()
    signal: SignalQuestion = SignalQuestion()
    limit: LimitQuestion = LimitQuestion()
    map: MapQuestion = MapQuestion()
    bulk: BulkQuestion = BulkQuestion()
    sweep: Sweep = Sweep()
    unknowns: Unknowns = Unknowns()
    stare: StareQuestion = StareQuestion()
    events: tuple[EventChoice, ...] = ()
    search: SearchChoice = SearchChoice()
    injections: InjectionQuestion = InjectionQuestion()
    orbit: OrbitQuestion = OrbitQuestion()
    plan: PlanQuestion = PlanQuestion()
    measure: MeasureQuestion = MeasureQuestion()
    data: DataChoice = DataChoice()
    calibrate: CalibrateQuestion = CalibrateQuestion()
    change: ChangeQuestion = ChangeQuestion()

    @model_validator(mode="after")
    def _one_photosphere(self) -> Self:
        own = [number for number, star in enumerate(self.star) if star.effective_temperature_k is not None]
        if own and self.flare.geometry == "replaces" and self.flare.photosphere_temperature_k is not None:
            raise InputError(
                f"flare.photosphere_temperature_k and star.{own[0]}.effective_temperature_k are both given",
                "one of them",
                key="flare.photosphere_temperature_k",
                value=self.flare.photosphere_temperature_k,
            )
        return self

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a study file, or the study in an answer's ECSV table."""
        path = Path(path)
        text = read_embedded_study(path) if path.suffix == ".ecsv" else read_text(path, "study file")
        data = toml(text, f"study file {shortened(path.name)}")
        if not _has_values(data):
            raise InputError(
                f"study file {shortened(path.name)} sets nothing",
                "at least one key, such as magnitude in [[star]]; a verb without a study file answers "
                "the paper's question",
                key="study_file",
                value=path.name,
            )
        if path.suffix == ".ecsv":
            locate_files(data, path)
        # Paths are relative to the study file.
        data = with_paths(data, cls, lambda file: path.parent / file)
        return cls.build(data, path.name)

    @classmethod
    def build(cls, data: dict[str, Any], where: str) -> Self:
        """Validate nested data; raises InputError for the first invalid value."""
        possible(data, where)
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise input_error(where, cls, error) from error

    def with_changes(
        self, changes: dict[str, dict[str, Any]], stars: list[dict[str, Any]] | None, where: str = "changes"
    ) -> Self:
        """Return a copy with other values, by sections such as "orbit.limits"; None leaves a value unchanged."""
        data = self.model_dump()
        for section, values in changes.items():
            given = {key: value for key, value in values.items() if value is not None}
            if section == "sky" and given:
                # A new sky replaces all keys of the old one.
                data[section] = {}
            place = data
            for part in section.split("."):
                place = place[part]
            place.update(given)
        if stars is not None:
            data["star"] = stars
        return self.build(data, where)

    def with_settings(self, settings: Sequence[str], where: str = "settings") -> Self:
        """Return a copy with keys set from text, such as ``run.fap=0.01`` or ``star.0.magnitude=6``."""
        data = self.model_dump(exclude_none=True)
        for text in settings:
            path, equals, value = (part.strip() for part in text.partition("="))
            if not (path and equals):
                raise InputError(f"setting = {text!r}", "key=value, such as run.fap=0.01", key="setting", value=text)
            set_key(data, path.split("."), parse_toml_value(value), text)
        return self.build(data, where)

    def toml(self) -> str:
        """Return the study as TOML, without sections that have their default values."""
        import tomli_w

        data = with_paths(self.model_dump(mode="json", exclude_none=True), type(self), Path.resolve)
        if not self.sky.none:
            del data["sky"]["none"]
        if not data["observation"]["changes"]:
            del data["observation"]["changes"]
        if not self.sweep.axes:
            del data["sweep"]
        if not self.unknowns.draws:
            del data["unknowns"]
        if self.signal.snr is None:
            del data["signal"]
        for section in OMITTED:
            if getattr(self, section) == type(self).model_fields[section].default:
                del data[section]
        for course in COURSES:
            if "stare" in data and not data["stare"][course]:
                del data["stare"][course]
        if "search" in data and not data["search"]["frame"]:
            del data["search"]["frame"]
        if "orbit" in data and self.orbit.limits == Limits():
            del data["orbit"]["limits"]
        drop_default_spectrum(data, self.flare.spectrum)
        for section in ("processes", "campaign"):
            if not data[section]:
                del data[section]
        if not data["run"]["weights"]:
            del data["run"]["weights"]
        for star in data["star"]:
            if "neighbours" not in star:
                del star["neighbour_share"]
        return tomli_w.dumps(data)

    def __repr__(self) -> str:
        o, swept = self.observation, [axis.quantity for axis in self.sweep.axes]
        stars = [
            f"{star.library or star.file}" + ("" if star.magnitude is None else f" {star.band} = {star.magnitude:g}")
            for star in self.star
        ]
        over = f", over {', '.join(swept)}" if swept else ""
        flares = ", ".join(f"{100 * amplitude:g} %" for amplitude in self.flare.amplitudes)
        flares = "the observed brightness" if self.flare.spectrum.as_observed else flares
        return f"<Study of {', '.join(stars)}; flares of {flares}; {o.exposure_s:g} s on {o.instrument}{over}>"

    __str__ = __repr__

    def text(self) -> str:
        """Return the study as TOML for an answer's table, with spectrum files by name and digest."""
        return with_file_digests(self.toml())

    def with_instrument(self, changes: Mapping[str, Any]) -> Self:
        """Return a copy with other values of the instrument; see `Instrument.with_`."""
        o = self.observation
        update: dict[str, Any] = {"changes": o.changes | dict(changes)}
        if "temperature_c" in changes:
            update["temperature_c"] = None
        return self.model_copy(update={"observation": o.model_copy(update=update)})

    def at(self, quantity: str, value: Annotated[float, AnyUnit()] | str) -> Self:
        """Return a copy with another value of one quantity, for all stars.

        Parameters
        ----------
        quantity : str
            A key of `QUANTITIES`.
        value : float, Quantity or str
            For "star", a name of the library.
        """
        if quantity not in QUANTITIES:
            raise InputError(
                f"quantity {shortened(str(quantity))!r} is unknown",
                f"one of {', '.join(QUANTITIES)}",
                key="quantity",
                value=quantity,
            )
        one = QUANTITIES[quantity]
        return self.with_value(one.path, one.checked(value))

    @property
    def has_neighbours(self) -> bool:
        """True if a star or a target of a plan has a table of neighbours."""
        targets = any(target.neighbours is not None for target in self.plan.targets)
        return targets or any(star.neighbours is not None for star in self.star)


def _has_values(data: Any) -> bool:
    """Return whether nested tables contain any key."""
    return any(map(_has_values, data.values())) if isinstance(data, dict) else True


#: The paper's noise budgets (its section "Noise"): the Be star HD 37202 and both flare stars, 50 s and 600 s.
PAPER_BUDGETS = Study(
    star=(Star(library="B2IV", magnitude=3.03), *PAPER_STARS),
    run=Run(realisations=100_000),
    sweep=Sweep(axes=(Axis(quantity="exposure", values=(50.0, 600.0)),)),
)
