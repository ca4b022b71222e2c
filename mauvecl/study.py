"""A question as data: read from TOML, changed by flags, turned into expectations."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mauvecl.host.errors import InputError

if TYPE_CHECKING:
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

    @classmethod
    def read(cls, path: Path) -> Self:
        """A study file.

        Raises
        ------
        InputError
            If it is missing, not TOML (naming the line), or holds an unknown key or an impossible value.
        """
        try:
            text = path.read_text(encoding="utf-8")
            data = tomllib.loads(text)
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
        return cls.build(data, path.name)

    @classmethod
    def build(cls, data: dict[str, Any], where: str) -> Self:
        """Validate nested data, with one sentence for the first fault."""
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise InputError(f"{where}: {_sentence(cls, error)}") from error

    def with_changes(self, changes: dict[str, dict[str, Any]], stars: list[dict[str, Any]] | None) -> Self:
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
        return self.build(data, "command line")

    def toml(self) -> str:
        """The study as TOML that `read` reads back."""
        import tomli_w

        data = self.model_dump(mode="json", exclude_none=True)
        if not self.sky.none:
            del data["sky"]["none"]
        if not data["processes"]:
            del data["processes"]
        for star in data["star"]:
            if "file" in star:
                star["file"] = str(Path(star["file"]).resolve())
        return tomli_w.dumps(data)

    def load_instrument(self) -> Instrument:
        """The instrument at the study's detector temperature."""
        from mauvecl.host.instrument import Instrument

        found = Instrument.load(self.observation.instrument)
        wanted = self.observation.temperature_c
        return found if wanted is None else found.with_(temperature_c=wanted)

    @property
    def drawing(self) -> dict[str, Any]:
        """How the engine is to draw: mode, recipe, processes."""
        o = self.observation
        return {"mode": o.mode, "recipe": o.recipe, "processes": self.processes.processes()}

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
