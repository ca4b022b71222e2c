"""Study sections for star, flare, observation, sky, noise processes, run and unknown instrument values."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, create_model, field_validator, model_validator

from mauvecl.host.sky import DEFAULT_SKY
from mauvecl.noise.priors import Normal, Uniform
from mauvecl.noise.unknowns import INSTRUMENT_VALUES, PROCESSES
from mauvecl.schema.section import Section as Section
from mauvecl.statistics.names import DEFAULT_STATISTICS, STATISTIC_NAMES
from mauvecl.study.flare_light import FlareLight

if TYPE_CHECKING:
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.sky.zodiacal import Sky
    from mauvecl.host.stars.flare_spectra import FlareSpectrum
    from mauvecl.host.stars.source import Source
    from mauvecl.noise.comparison import Comparison
    from mauvecl.noise.priors import Prior
    from mauvecl.noise.processes import CosmicRays, Processes


#: Keys that only apply to a star from a file.
FILE_KEYS = ("file", "wavelength_unit", "flux_unit", "extend")
#: Keys that describe one star and are dropped when another star replaces it.
STAR_KEYS = (*FILE_KEYS, "distance_pc", "radius_rsun", "effective_temperature_k")


class Star(Section):
    """Spectrum, extinction and magnitude of a star; distance or radius for flare energies."""

    library: str | None = None
    file: Path | None = None
    magnitude: float | None = None
    band: str = "V"
    magnitude_system: Literal["catalogue", "vega", "ab"] = "catalogue"
    ebv: float | None = None
    wavelength_unit: str | None = None
    flux_unit: str | None = None
    extend: str | None = None
    bin_nm: float | None = None
    distance_pc: Annotated[float, Field(gt=0)] | None = None
    radius_rsun: Annotated[float, Field(gt=0)] | None = None
    effective_temperature_k: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _one_spectrum(self) -> Self:
        if (self.library is None) == (self.file is None):
            raise ValueError("a star has neither or both of library and file, expected one of them")
        given = [key for key in FILE_KEYS if getattr(self, key) is not None]
        if self.file is None and given:
            raise ValueError(f"a star of the library has {' and '.join(given)}, expected a star from a file")
        return self

    def source(self) -> Source:
        """Load the spectrum and scale it to the magnitude, if one is given."""
        from dataclasses import replace

        from mauvecl.host.stars.source import Source
        from mauvecl.study.star_names import check_spectrum

        if self.library is not None:
            check_spectrum(self.library)
            source = Source.from_library(self.library)
        else:
            source = Source.read(
                self.file or "", wavelength_unit=self.wavelength_unit, flux_unit=self.flux_unit, extend=self.extend
            )
        if self.effective_temperature_k is not None:
            source = replace(source, temperature_k=self.effective_temperature_k)
        if self.bin_nm is not None:
            source = source.binned(self.bin_nm)
        if self.ebv is not None:
            source = source.reddened(self.ebv)
        if self.magnitude is None:
            return source
        return source.at_magnitude(self.magnitude, self.band, self.magnitude_system)


class Flare(Section):
    """Amplitudes, spectrum and geometry of flares."""

    amplitudes: Annotated[tuple[float, ...], Field(min_length=1)] = (0.0076, 0.02, 0.081, 0.24)
    temperature_k: float = 10_000.0
    band: str = "Kepler"
    geometry: Literal["added", "replaces"] = "added"
    photosphere_temperature_k: float | None = None
    spectrum: FlareLight = FlareLight()

    def light(self, temperature_k: float | None = None) -> FlareSpectrum:
        """Return the spectrum of a flare, by default at the study's temperature."""
        return self.spectrum.at_temperature(self.temperature_k if temperature_k is None else temperature_k)

    @property
    def is_blackbody(self) -> bool:
        """True if the spectrum is a single blackbody."""
        return self.spectrum == FlareLight()

    def with_spectrum(self, key: str, value: Any) -> Self:
        """Return a copy with one key of the spectrum changed."""
        return self.model_copy(update={"spectrum": self.spectrum.with_value(key, value)})


class Observation(Section):
    """Instrument, exposure, and how the detector is modelled."""

    exposure_s: float = 50.0
    instrument: str = "mauve"
    temperature_c: float | None = None
    order: Literal["paper", "physical"] = "paper"
    signal: Literal["net", "paper"] = "net"
    mode: Literal["auto", "frames", "stacked"] = "auto"
    recipe: Literal["auto", "joint", "apart"] = "auto"
    changes: dict[str, float | int | str] = Field(default_factory=dict)

    def load_instrument(self) -> Instrument:
        """Load the instrument and apply `changes` and the detector temperature."""
        from mauvecl.host.instrument.instrument import Instrument

        instrument = Instrument.load(self.instrument)
        changes = self.changes | ({} if self.temperature_c is None else {"temperature_c": self.temperature_c})
        return instrument.with_(**changes) if changes else instrument


class SkyLight(Section):
    """Sky background: a surface brightness, that of a target at a time, or none."""

    surface_brightness: float | None = None
    target: str | None = None
    time: str | None = None
    none: bool = False

    @model_validator(mode="before")
    @classmethod
    def _default_brightness(cls, given: Any) -> Any:
        return given or {"surface_brightness": DEFAULT_SKY}

    @model_validator(mode="after")
    def _one_sky(self) -> Self:
        if (self.target is None) != (self.time is None):
            raise ValueError("the sky has only one of target and time, expected both or neither")
        if (self.surface_brightness is not None) + (self.target is not None) + self.none > 1:
            raise ValueError("the sky is given twice, expected one of surface_brightness, target with time, and none")
        return self

    def sky(self) -> Sky:
        """Return the sky for the host."""
        from mauvecl.host.sky.zodiacal import Sky

        if self.none:
            return Sky.none()
        if self.target is not None and self.time is not None:
            return Sky.at(self.target, self.time)
        return Sky.none() if self.surface_brightness is None else Sky.of_brightness(self.surface_brightness)


class PriorText(Section):
    """Prior of a value that varies between realisations: uniform or truncated normal."""

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

    @classmethod
    def of(cls, prior: Prior) -> Self:
        """Return the text of a prior."""
        if isinstance(prior, Uniform):
            return cls(uniform=(prior.low, prior.high))
        return cls(normal=(prior.mean, prior.sd), between=(prior.low, prior.high))

    def prior(self) -> Prior:
        """Return the prior for the engine."""
        if self.normal is not None and self.between is not None:
            return Normal(*self.normal, *self.between)
        return Uniform(*(self.uniform or (0.0, 0.0)))  # the validator ensures that one of them is given


class Rays(Section):
    """Cosmic-ray hits; see `noise.processes.CosmicRays`."""

    rate_per_cm2_s: float = 1.0
    area_cm2: float = 0.057
    electrons: tuple[float, float] = (500.0, 1000.0)
    weights: tuple[float, ...] | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        self.rays()
        return self

    def rays(self) -> CosmicRays:
        """Return the process for the engine."""
        from mauvecl.noise.processes import CosmicRays

        return CosmicRays(**self.model_dump())


#: Cosmic rays, and a prior for each quantity that may vary.
_keys: Any = {"cosmic_rays": (Rays | None, None)} | dict.fromkeys(PROCESSES, (PriorText | None, None))


class NoiseProcesses(create_model("_Priors", __base__=Section, **_keys)):  # type: ignore[misc]
    """Optional noise processes, disabled by default; see `unknowns.PROCESSES` and `processes.CosmicRays`."""

    def processes(self) -> Processes:
        """Return the processes for the engine."""
        from mauvecl.noise.processes import Processes

        rays = None if self.cosmic_rays is None else self.cosmic_rays.rays()
        given = {name: getattr(self, name) for name in PROCESSES}
        return Processes(rays, **{name: None if text is None else text.prior() for name, text in given.items()})


class Run(Section):
    """Number of realisations, seed, statistics and false-alarm probability."""

    realisations: Annotated[int, Field(ge=1)] = 1_000_000
    seed: Annotated[int, Field(ge=0, lt=2**64)] = 1
    statistics: Annotated[tuple[str, ...], Field(min_length=1)] = DEFAULT_STATISTICS
    fap: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    tails: Literal["counted", "sampled"] = "counted"
    reference: str = "template"
    variances: Literal["model", "estimated"] = "model"
    template_temperatures_k: tuple[float, ...] = ()
    weights: dict[str, Path] = Field(default_factory=dict)

    @field_validator("statistics")
    @classmethod
    def _expand_all(cls, given: tuple[str, ...]) -> tuple[str, ...]:
        return STATISTIC_NAMES if "all" in given else given

    @model_validator(mode="after")
    def _comparable(self) -> Self:
        self.comparison()
        return self

    def comparison(self) -> Comparison:
        """Return the reference of the comparison for the engine."""
        from mauvecl.noise.comparison import Comparison

        return Comparison.of(self.reference, self.variances)


#: Number of draws, priors by name, and names of known values.
_unknown_keys: Any = (
    {"draws": (Annotated[int, Field(ge=0, le=4096)], 0)}
    | {
        name: (PriorText | None, PriorText.of(row.prior))
        for name, row in INSTRUMENT_VALUES.items()
        if isinstance(row.prior, Uniform | Normal)
    }
    | {"known": (tuple[str, ...], ())}
)


class Unknowns(create_model("_InstrumentValues", __base__=Section, **_unknown_keys)):  # type: ignore[misc]
    """Priors of instrument values that are unknown but constant; ignored unless `draws` is positive.

    The documentation page on nominal values explains the default priors.
    """

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.draws == 1:
            raise ValueError("unknowns.draws = 1, expected 0 or at least 2")
        other = next((name for name in self.known if name not in INSTRUMENT_VALUES), None)
        if other is not None:
            raise ValueError(f"unknowns.known names {other!r}, expected some of {', '.join(INSTRUMENT_VALUES)}")
        self.priors()
        return self

    def priors(self) -> dict[str, Prior]:
        """Return the priors of unknown values by the instrument's names, and of `qe_scale`."""
        given = {name: getattr(self, name) for name in INSTRUMENT_VALUES if name not in self.known}
        return {name: text.prior() for name, text in given.items() if text is not None}
