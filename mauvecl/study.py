"""A question as data: read from TOML, changed by flags, turned into expectations."""

from __future__ import annotations

import difflib
import itertools
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from mauvecl.host.errors import InputError

if TYPE_CHECKING:
    from mauvecl.comparison import Comparison
    from mauvecl.host.expectation import Expectation
    from mauvecl.host.instrument import Instrument
    from mauvecl.host.sky import Sky
    from mauvecl.host.source import Source
    from mauvecl.processes import Prior, Processes


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Star(_Part):
    """Which spectrum, behind how much dust, how bright then."""

    library: str | None = None
    file: Path | None = None
    magnitude: float | None = None
    band: str = "V"
    ebv: float | None = None

    @model_validator(mode="after")
    def _one_spectrum(self) -> Self:
        if (self.library is None) == (self.file is None):
            raise ValueError("a star has neither or both of library and file, expected one of them")
        return self

    def source(self) -> Source:
        """The star's spectrum at its magnitude; as stored where none is given."""
        from mauvecl.host.source import Source

        found = Source.from_library(self.library) if self.library is not None else Source.read(self.file or "")
        if self.ebv is not None:
            found = found.reddened(self.ebv)
        return found if self.magnitude is None else found.at_magnitude(self.magnitude, self.band)


class Flare(_Part):
    """Which flares."""

    amplitudes: Annotated[tuple[float, ...], Field(min_length=1)] = (0.0076, 0.02, 0.081, 0.24)
    temperature_k: float = 10_000.0
    band: str = "Kepler"
    geometry: Literal["added", "replaces"] = "added"
    photosphere_temperature_k: float | None = None


class Observation(_Part):
    """How it is observed."""

    exposure_s: float = 50.0
    instrument: str = "mauve"
    temperature_c: float | None = None
    order: Literal["paper", "physical"] = "paper"
    mode: Literal["auto", "frames", "stacked"] = "auto"
    recipe: Literal["auto", "joint", "apart"] = "auto"
    changes: dict[str, float | int | str] = Field(default_factory=dict)


#: V mag arcsec-2 where a study says nothing of the sky: the ecliptic opposite the Sun.
DEFAULT_SKY = 22.1


class SkyLight(_Part):
    """What is behind the star: a surface brightness, a target and a time, or nothing."""

    surface_brightness: float | None = None
    target: str | None = None
    time: str | None = None
    none: bool = False

    @model_validator(mode="before")
    @classmethod
    def _something(cls, given: Any) -> Any:
        return given or {"surface_brightness": DEFAULT_SKY}

    @model_validator(mode="after")
    def _one_sky(self) -> Self:
        if (self.target is None) != (self.time is None):
            raise ValueError("the sky has only one of target and time, expected both or neither")
        if (self.surface_brightness is not None) + (self.target is not None) + self.none > 1:
            raise ValueError("the sky is given twice, expected one of surface_brightness, target with time, and none")
        return self

    def sky(self) -> Sky:
        """What the host needs of it."""
        from mauvecl.host.sky import Sky

        if self.none:
            return Sky.none()
        if self.target is not None and self.time is not None:
            return Sky.at(self.target, self.time)
        return Sky.none() if self.surface_brightness is None else Sky.of_brightness(self.surface_brightness)


class PriorText(_Part):
    """What is known of a value that differs from realisation to realisation: flat, or normal and cut."""

    uniform: tuple[float, float] | None = None
    normal: tuple[float, float] | None = None
    between: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _one_shape(self) -> Self:
        if (self.uniform is None) == (self.normal is None) or (self.normal is None) != (self.between is None):
            raise ValueError(
                "a prior is neither { uniform = [low, high] } nor { normal = [mean, sd], between = [low, high] }, "
                "expected one of them"
            )
        self.prior()
        return self

    def prior(self) -> Prior:
        """As the engine takes it."""
        from mauvecl.processes import Normal, Uniform

        if self.normal is not None and self.between is not None:
            return Normal(*self.normal, *self.between)
        return Uniform(*(self.uniform or (0.0, 0.0)))  # one of the two is there


class Rays(_Part):
    """Cosmic-ray hits; see `processes.CosmicRays`."""

    rate_per_cm2_s: float = 1.0
    area_cm2: float = 0.057
    electrons: tuple[float, float] = (500.0, 1000.0)
    weights: tuple[float, ...] | None = None


class NoiseProcesses(_Part):
    """Optional noise processes, all off unless named; see `processes.Processes`."""

    cosmic_rays: Rays | None = None
    jitter: PriorText | None = None
    detector_temperature: PriorText | None = None
    light_loss: PriorText | None = None
    pointing_loss: PriorText | None = None
    qe_scale: PriorText | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        self.processes()
        return self

    def processes(self) -> Processes:
        """As the engine takes them."""
        from mauvecl.processes import CosmicRays, Processes

        rays = None if self.cosmic_rays is None else CosmicRays(**self.cosmic_rays.model_dump())
        names = [name for name in type(self).model_fields if name != "cosmic_rays"]
        given = {name: getattr(self, name) for name in names}
        return Processes(rays, **{name: None if text is None else text.prior() for name, text in given.items()})


class Run(_Part):
    """How much is drawn, and what is asked of it."""

    realisations: Annotated[int, Field(ge=1)] = 1_000_000
    seed: Annotated[int, Field(ge=0, lt=2**64)] = 1
    statistics: Annotated[tuple[str, ...], Field(min_length=1)] = ("chi2", "chi2_element", "matched")
    fap: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    tails: Literal["counted", "sampled"] = "counted"
    reference: str = "template"
    variances: Literal["model", "estimated"] = "model"
    template_temperatures_k: tuple[float, ...] = ()
    weights: dict[str, Path] = Field(default_factory=dict)

    @field_validator("statistics")
    @classmethod
    def _all(cls, given: tuple[str, ...]) -> tuple[str, ...]:
        from mauvecl.statistics import STATISTICS

        return tuple(STATISTICS) if "all" in given else given

    @model_validator(mode="after")
    def _comparable(self) -> Self:
        self.comparison()
        return self

    def comparison(self) -> Comparison:
        """What an observed spectrum is compared with, as the engine takes it."""
        from mauvecl.comparison import Comparison

        return Comparison.of(self.reference, self.variances)


#: What a limit is asked for, or an axis of a map runs over, and where it may lie.
QUANTITIES: dict[str, tuple[float, float]] = {
    "magnitude": (-2.0, 25.0),
    "amplitude": (1e-6, 1e4),
    "flare_temperature": (1_000.0, 100_000.0),
    "exposure": (1e-3, 1e7),
    "detector_temperature": (-100.0, 60.0),
    "sky": (10.0, 30.0),
}
#: Units of these, where they have any.
UNITS = {
    "magnitude": "mag",
    "flare_temperature": "K",
    "exposure": "s",
    "detector_temperature": "deg_C",
    "sky": "mag / arcsec2",
}


class CampaignQuestion(_Part):
    """How many tests a search makes: frames in all, and from one stack to the next."""

    frames: Annotated[int, Field(ge=1)] | None = None
    step: Annotated[int, Field(ge=1)] | None = None


class SignalQuestion(_Part):
    """The S/N that an exposure is wanted for."""

    snr: Annotated[float, Field(gt=0)] | None = None
    wavelength_nm: float | None = None
    per: Literal["element", "pixel"] = "element"


class BulkQuestion(_Part):
    """What is kept of each realisation: the exposure's sum, or its frames; and the mean components beside it."""

    frames: Literal["stack", "all"] | Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = "stack"
    components: bool = False

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        if not isinstance(self.frames, str) and list(self.frames) != sorted(set(self.frames)):
            raise ValueError(f"bulk.frames = {list(self.frames)}, expected ascending numbers")
        return self

    def chosen(self, n_frames: int) -> tuple[int, ...] | None:
        """Frames kept apart, of so many; None where they are summed.

        Raises
        ------
        InputError
            If one of them is not there.
        """
        if self.frames == "stack":
            return None
        if isinstance(self.frames, str):
            return tuple(range(n_frames))
        if self.frames[-1] >= n_frames:
            raise InputError(f"bulk.frames names frame {self.frames[-1]}, expected 0 to {n_frames - 1}")
        return self.frames


class LimitQuestion(_Part):
    """The value of one quantity at which a flare is detected with a wanted probability."""

    of: Literal["magnitude", "amplitude", "exposure"] = "magnitude"
    power: Annotated[float, Field(gt=0, lt=1)] = 0.9


class Unknowns(_Part):
    """What is unknown of the instrument and the same in every exposure; nothing unless draws are asked for.

    The priors are those of the documentation's page on what is nominal.
    """

    draws: Annotated[int, Field(ge=0, le=4096)] = 0
    temperature_c: PriorText | None = PriorText(uniform=(13.0, 21.0))
    light_loss: PriorText | None = PriorText(normal=(0.34, 0.10), between=(0.04, 0.64))
    pointing_loss: PriorText | None = PriorText(uniform=(0.0, 0.05))
    qe_scale: PriorText | None = PriorText(normal=(1.0, 0.3), between=(0.3, 1.7))
    conversion_uv_per_electron: PriorText | None = PriorText(uniform=(20.0, 25.0))
    read_noise_dn: PriorText | None = PriorText(normal=(12.0, 1.0), between=(9.0, 15.0))
    known: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _enough(self) -> Self:
        if self.draws == 1:
            raise ValueError("unknowns.draws = 1, expected 0 or at least 2")
        other = next((name for name in self.known if name not in self._names()), None)
        if other is not None:
            raise ValueError(f"unknowns.known names {other!r}, expected some of {', '.join(self._names())}")
        self.priors()
        return self

    @classmethod
    def _names(cls) -> list[str]:
        return [name for name in cls.model_fields if name not in ("draws", "known")]

    def priors(self) -> dict[str, Prior]:
        """The priors of what is not known, by the instrument's names, and `qe_scale`."""
        given = {name: getattr(self, name) for name in self._names() if name not in self.known}
        return {name: text.prior() for name, text in given.items() if text is not None}


class Axis(_Part):
    """One axis of a map: values, or so many steps from start to stop."""

    quantity: Literal["magnitude", "amplitude", "flare_temperature", "exposure", "detector_temperature", "sky", "star"]
    values: tuple[float | str, ...] | None = None
    start: float | None = None
    stop: float | None = None
    steps: Annotated[int, Field(ge=2, le=1000)] | None = None
    log: bool = False

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        spaced = (self.start, self.stop, self.steps)
        if (self.values is None) == (None in spaced) or (self.values is not None and spaced != (None, None, None)):
            raise ValueError(
                f"the axis {self.quantity!r} has neither or both of values and start, stop, steps, expected one of them"
            )
        if self.values is not None and len(self.values) == 0:
            raise ValueError(f"the axis {self.quantity!r} has no values, expected some")
        for value in self.points():
            if (self.quantity == "star") != isinstance(value, str):
                raise ValueError(f"the axis {self.quantity!r} has the value {value!r}, expected {self._expected()}")
            if not isinstance(value, str):
                low, high = QUANTITIES[self.quantity]
                if not low <= value <= high:
                    raise ValueError(f"the axis {self.quantity!r} reaches {value:g}, expected {low:g} to {high:g}")
        return self

    def _expected(self) -> str:
        return "names of the library" if self.quantity == "star" else "numbers"

    def points(self) -> tuple[float | str, ...]:
        """Its values."""
        if self.values is not None:
            return self.values
        assert self.start is not None
        assert self.stop is not None
        assert self.steps is not None
        if self.log and min(self.start, self.stop) <= 0:
            raise ValueError(
                f"the axis {self.quantity!r} is logarithmic from {self.start:g} to {self.stop:g}, expected > 0"
            )
        share = [i / (self.steps - 1) for i in range(self.steps)]
        if self.log:
            return tuple(self.start * (self.stop / self.start) ** s for s in share)
        return tuple(self.start + (self.stop - self.start) * s for s in share)


class MapQuestion(_Part):
    """Detection probability over two quantities."""

    x: Axis = Axis(quantity="magnitude", start=4.0, stop=10.0, steps=16)
    y: Axis = Axis(quantity="amplitude", start=0.01, stop=1.0, steps=16, log=True)
    contours: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = (0.1, 0.5, 0.9)

    @model_validator(mode="after")
    def _two(self) -> Self:
        if self.x.quantity == self.y.quantity:
            raise ValueError(f"both axes of the map are {self.x.quantity!r}, expected two quantities")
        return self


class Sweep(_Part):
    """Quantities that take several values: in every combination, or side by side as a list."""

    how: Literal["product", "list"] = "product"
    axes: tuple[Axis, ...] = ()

    @model_validator(mode="after")
    def _fits(self) -> Self:
        names = [axis.quantity for axis in self.axes]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"the sweep has the quantity {twice!r} twice, expected different ones")
        lengths = {axis.quantity: len(axis.points()) for axis in self.axes}
        if self.how == "list" and len(set(lengths.values())) > 1:
            told = ", ".join(f"{n} of {name}" for name, n in lengths.items())
            raise ValueError(f"the sweep is a list of {told}, expected as many of each")
        return self

    def cells(self) -> list[dict[str, float | str]]:
        """The values of each cell; one cell without any where nothing is swept."""
        values = [axis.points() for axis in self.axes]
        together = zip(*values, strict=True) if self.how == "list" and values else itertools.product(*values)
        return [{a.quantity: v for a, v in zip(self.axes, cell, strict=True)} for cell in together]


#: The paper's two stars.
PAPER_STARS = (Star(library="K3V", magnitude=3.7), Star(library="G2V", magnitude=7.4))


class Study(_Part):
    """Everything that an answer depends on; the default is the paper's question."""

    star: Annotated[tuple[Star, ...], Field(min_length=1)] = PAPER_STARS
    flare: Flare = Flare()
    observation: Observation = Observation()
    sky: SkyLight = SkyLight()
    processes: NoiseProcesses = NoiseProcesses()
    run: Run = Run()
    campaign: CampaignQuestion = CampaignQuestion()
    signal: SignalQuestion = SignalQuestion()
    limit: LimitQuestion = LimitQuestion()
    map: MapQuestion = MapQuestion()
    bulk: BulkQuestion = BulkQuestion()
    sweep: Sweep = Sweep()
    unknowns: Unknowns = Unknowns()

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """A study file, or the study that an answer's ECSV table was made by.

        Raises
        ------
        InputError
            If it is missing, not TOML (naming the line), or holds an unknown key or an impossible value.
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
            data = tomllib.loads(_study_of(path) if path.suffix == ".ecsv" else text)
        except OSError as error:
            raise InputError(
                f"study file {str(path)!r} cannot be read ({error.strerror}), expected a TOML file"
            ) from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"study file {path.name} is not TOML: {error}") from error
        for star in data.get("star", []) if isinstance(data.get("star"), list) else []:
            # Files are named as seen from the study.
            if isinstance(star, dict) and isinstance(star.get("file"), str):
                star["file"] = str(path.parent / star["file"])
        run = data.get("run")
        if isinstance(run, dict) and isinstance(run.get("weights"), dict):
            run["weights"] = {k: str(path.parent / v) if isinstance(v, str) else v for k, v in run["weights"].items()}
        return cls.build(data, path.name)

    @classmethod
    def build(cls, data: dict[str, Any], where: str) -> Self:
        """Validate nested data, with one sentence for the first fault."""
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise InputError(f"{where}: {_sentence(cls, error)}") from error

    def with_changes(
        self, changes: dict[str, dict[str, Any]], stars: list[dict[str, Any]] | None, where: str = "command line"
    ) -> Self:
        """The study with a section's values replaced where they are not None, and with other stars."""
        data = self.model_dump()
        for section, values in changes.items():
            given = {key: value for key, value in values.items() if value is not None}
            if section == "sky" and given:
                # A new sky takes the place of the old one whole.
                data[section] = {}
            data[section].update(given)
        if stars is not None:
            data["star"] = stars
        return self.build(data, where)

    def with_settings(self, settings: Sequence[str]) -> Self:
        """The study with keys set as text, such as ``run.fap=0.01`` or ``star.0.magnitude=6``.

        Raises
        ------
        InputError
            For text without "=", or a key or value that cannot be.
        """
        data = self.model_dump(exclude_none=True)
        for text in settings:
            path, equals, value = (part.strip() for part in text.partition("="))
            if not (path and equals):
                raise InputError(f"--set {text!r}, expected key=value, such as run.fap=0.01")
            _put(data, path.split("."), _toml_value(value), text)
        return self.build(data, "--set")

    def toml(self) -> str:
        """The study as TOML that `read` reads back."""
        import tomli_w

        data = self.model_dump(mode="json", exclude_none=True)
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
        if self.bulk == BulkQuestion():
            del data["bulk"]
        for section in ("processes", "campaign"):
            if not data[section]:
                del data[section]
        data["run"]["weights"] = {name: str(Path(file).resolve()) for name, file in data["run"]["weights"].items()}
        if not data["run"]["weights"]:
            del data["run"]["weights"]
        for star in data["star"]:
            if "file" in star:
                star["file"] = str(Path(star["file"]).resolve())
        return tomli_w.dumps(data)

    def load_instrument(self) -> Instrument:
        """The instrument with what the study changes of it: its ``changes``, and the detector's temperature."""
        from mauvecl.host.instrument import Instrument

        found, o = Instrument.load(self.observation.instrument), self.observation
        changes = o.changes | ({} if o.temperature_c is None else {"temperature_c": o.temperature_c})
        return found.with_(**changes) if changes else found

    def with_instrument(self, changes: Mapping[str, Any]) -> Self:
        """The study with some values of the instrument changed; see `Instrument.with_`."""
        o = self.observation
        update: dict[str, Any] = {"changes": o.changes | dict(changes)}
        if "temperature_c" in changes:
            update["temperature_c"] = None
        return self.model_copy(update={"observation": o.model_copy(update=update)})

    def at(self, quantity: str, value: float | str) -> Self:
        """The study with one quantity at another value, for all its stars.

        Parameters
        ----------
        quantity : str
            A key of `QUANTITIES`, or "star" with a library name.
        value : float or str
        """
        change: dict[str, Any]
        if quantity in ("magnitude", "star"):
            change = {"magnitude": value} if quantity == "magnitude" else {"library": value, "file": None}
            return self.model_copy(update={"star": tuple(star.model_copy(update=change) for star in self.star)})
        if quantity in ("amplitude", "flare_temperature"):
            change = {"amplitudes": (value,)} if quantity == "amplitude" else {"temperature_k": value}
            return self.model_copy(update={"flare": self.flare.model_copy(update=change)})
        if quantity == "sky":
            return self.model_copy(update={"sky": SkyLight(surface_brightness=float(value))})
        change = {{"exposure": "exposure_s", "detector_temperature": "temperature_c"}[quantity]: value}
        return self.model_copy(update={"observation": self.observation.model_copy(update=change)})

    def unknown_priors(self) -> dict[str, Prior]:
        """Priors of what is unknown of the instrument; what the study states of it is known.

        Raises
        ------
        InputError
            If nothing is left unknown, and draws are asked for.
        """
        stated = {*self.observation.changes, *(() if self.observation.temperature_c is None else ("temperature_c",))}
        found = {name: prior for name, prior in self.unknowns.priors().items() if name not in stated}
        if self.unknowns.draws and not found:
            raise InputError("everything is known of the instrument, expected a prior, or unknowns.draws = 0")
        return found

    def cells(self) -> list[tuple[dict[str, float | str], Self]]:
        """The values that the study sweeps over, and the study at each; itself where it sweeps over nothing."""
        found = []
        for values in self.sweep.cells():
            study = self.model_copy(update={"sweep": Sweep()})
            for quantity, value in values.items():
                study = study.at(quantity, value)
            found.append((values, study))
        return found

    @property
    def drawing(self) -> dict[str, Any]:
        """How the engine is to draw: mode, recipe, processes."""
        o = self.observation
        return {"mode": o.mode, "recipe": o.recipe, "processes": self.processes.processes()}

    @property
    def detecting(self) -> dict[str, Any]:
        """How the engine is to draw and compare: everything that `Engine.detect` takes but stars and seed."""
        run = self.run
        how = {"realisations": run.realisations, "statistics": run.statistics, "tails": run.tails}
        return self.drawing | how | {"comparison": run.comparison()}

    def expectations(self, star: Star) -> list[Expectation]:
        """A star without a flare, then with each of the flares."""
        source = star.source()
        flares = [self.flaring(source, amplitude) for amplitude in self.flare.amplitudes]
        return self.expect([source, *flares])

    def flaring(self, source: Source, amplitude: float) -> Source:
        """The star with one of the study's flares."""
        f = self.flare
        return source.flaring(
            amplitude,
            f.temperature_k,
            band=f.band,
            geometry=f.geometry,
            photosphere_temperature=f.photosphere_temperature_k,
        )

    def expect(self, sources: list[Source]) -> list[Expectation]:
        """Expectations of sources on the study's instrument, sky and exposure."""
        from mauvecl.host.expectation import expect

        instrument, sky, o = self.load_instrument(), self.sky.sky(), self.observation
        return [expect(s, instrument, exposure=o.exposure_s, sky=sky, order=o.order) for s in sources]


#: The paper's noise budgets (its section "Noise"): the Be star HD 37202 and both flare stars, 50 s and 600 s.
PAPER_BUDGETS = Study(
    star=(Star(library="B2IV", magnitude=3.03), *PAPER_STARS),
    run=Run(realisations=100_000),
    sweep=Sweep(axes=(Axis(quantity="exposure", values=(50.0, 600.0)),)),
)


def _study_of(path: Path) -> str:
    """The study in an answer's meta data."""
    from astropy.table import Table

    try:
        study = Table.read(path, format="ascii.ecsv").meta["study"]
    except (ValueError, KeyError) as error:
        raise InputError(f"{path.name} holds no study, expected an answer's ECSV table") from error
    return str(study)


def _toml_value(text: str) -> Any:
    """A value as TOML has it; a bare word is text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _put(data: Any, path: list[str], value: Any, text: str) -> None:
    *parents, last = path
    for part in parents:
        if isinstance(data, list | tuple):
            if not (part.isdigit() and int(part) < len(data)):
                raise InputError(f"--set {text!r}: no entry {part!r}, expected 0 to {len(data) - 1}")
            data = data[int(part)]
        else:
            data = data.setdefault(part, {})
    if not isinstance(data, dict):
        raise InputError(f"--set {text!r}: {'.'.join(parents)} holds no keys, expected one that does")
    data[last] = value


def _sentence(model: type[BaseModel], error: ValidationError) -> str:
    """The first fault as: key = value, what was expected."""
    first = error.errors()[0]
    path = [str(part) for part in first["loc"]]
    key = ".".join(path) or "study"
    if first["type"] == "extra_forbidden":
        fields = list(_fields(model, path[:-1]))
        near = difflib.get_close_matches(path[-1], fields, n=1)
        expected = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(fields)}"
        return f"unknown key {key!r}, {expected}"
    if first["type"] == "value_error":
        return str(first["ctx"]["error"])
    return f"{key} = {first['input']!r}: {first['msg'].lower()}"


def _fields(model: type[BaseModel], path: list[str]) -> Any:
    for part in path:
        if not part.isdigit():
            model = _model_in(model.model_fields[part].annotation) or model
    return model.model_fields


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model in a type such as `Star | None` or `tuple[Star, ...]`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for part in get_args(annotation) if (model := _model_in(part))), None)
