"""Values that an observer does not know, how draws and statistics treat them, and the noise that studies enable.

Study keys, random streams, kernel tables, nuisance spectra and the documented set that `--with-unknowns` selects follow
from the rows of this module. References and variances remain those of the expectation. The module imports no large
package, so that wrong keys are reported immediately.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, TypeVar, cast, get_args

from pydantic import create_model

from mauvecl.noise.disturbances import ADDITIVE, AdditiveProcess, Normal, ParticleRate, Prior, PriorField, Uniform
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import DetectorTemperature, Range, range_of
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    from mauvecl.host.arrays import Float
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.instrument.instrument import Instrument

Conditions = Mapping[str, float]
SignalPart = Literal["light", "dark", "sky"]
SIGNAL_PARTS: tuple[SignalPart, ...] = get_args(SignalPart)
#: Quantities of a stare that change: the quiescent level of the star; the throughput for the light of star, flare and
#: sky; the brightness of the sky; the temperature of the detector.
Changing = Literal["star", "light", "sky", "temperature"]
#: In the order of their numbers in kernels.
CHANGING: tuple[Changing, ...] = get_args(Changing)
#: Part of the signal that each of them changes; a nuisance parameter of this name takes its place in a frame.
CHANGED_PART: dict[Changing, str] = {"star": "star", "light": "light", "sky": "sky", "temperature": "dark"}
#: Sections of a stare's unknowns: independent from frame to frame; constant; a change per hour; an orbital cycle.
Course = Literal["jitters", "offsets", "drifts", "cycles"]
COURSES: tuple[Course, ...] = get_args(Course)
#: Half-width and middle of the output range, nm, which normalise the spectrum of `tilt`.
TILT_NM, MIDDLE_NM = 250.0, 450.0


@dataclass(frozen=True, kw_only=True)
class Unknown:
    """Value that an observer does not know."""

    name: str  # its key in a section of studies
    prior: Prior | None = None  # default prior; None if it is known by default
    label: str = ""  # description in messages and tables


@dataclass(frozen=True, kw_only=True)
class UnknownProcess(Unknown):
    """Unknown factor on a part of the signal, drawn per frame or exposure."""

    of: SignalPart = "light"
    when: Literal["frame", "exposure"] = "exposure"
    source: str = ""  # source of the default prior, or "assumption"
    stream: int  # its number in `layout.STREAMS`
    #: Range of allowed values.
    low: float
    high: float
    #: Function of an expectation's conditions and drawn values that returns the factor minus one.
    change: Callable[[Conditions, Float], Float]
    expected: str | float = 1.0  # value in the expectation, or its key in the expectation's conditions
    drawn: str = ""  # description of the default prior for messages and documentation

    @property
    def moments(self) -> tuple[float, float]:
        """Mean of the default prior relative to the expected value, and standard deviation, both without its cuts."""
        # A default prior of a value that depends on the instrument is relative to that value.
        expected = 0.0 if isinstance(self.expected, str) else self.expected
        if isinstance(self.prior, Normal):
            return self.prior.mean - expected, self.prior.sd
        assert self.prior is not None
        return (self.prior.low + self.prior.high) / 2 - expected, (self.prior.high - self.prior.low) / 12**0.5


@dataclass(frozen=True, kw_only=True)
class Nuisance(Unknown):
    """Unknown amplitude of a known spectrum, which statistics marginalise over."""

    #: Standard deviation of its normal prior of zero mean, infinite for a flat one; None if it is known by default.
    sd: float | None = None
    #: Function of a quiescent expectation that returns DN of the exposure for unit amplitude, shape (n_pixel,).
    spectrum: Callable[[Expectation], Float]
    #: Function that returns the relative change of a flare's light for unit amplitude; None if it does not change.
    of_flare: Callable[[Expectation], Float] | None = None
    unit: str = "%"  # unit in messages; relative amplitudes are shown in per cent
    process: str = ""  # process that draws it in the documented set
    marginalised: str = ""  # description of the default prior for messages and documentation

    @property
    def scatter(self) -> float:
        """Root mean square of the amplitude that its process draws."""
        return math.hypot(*PROCESSES[self.process].moments)


@dataclass(frozen=True, kw_only=True)
class InstrumentValue(Unknown):
    """Unknown but constant value of the instrument, over which answers are averaged."""

    #: Value of the instrument that the unknown multiplies; by default it replaces the value of its own name.
    scales: str | None = None
    #: Whether it changes the throughput alone, so that modes of a calibrated throughput take its place.
    of_throughput: bool = False
    mode: int | None = None  # number of the mode of a calibration of which this is the amplitude, from 0
    #: Changes of the logarithm of other values than the throughput for an amplitude of one of a mode, by name.
    slopes: Mapping[str, float] = field(default_factory=dict)

    def changes(self, nominal: Instrument, value: float) -> dict[str, Any]:
        """Return the changes of an instrument that set a value, of which those of other modes are kept."""
        if self.mode is None:
            return {self.name: value} if self.scales is None else {self.scales: value * getattr(nominal, self.scales)}
        amplitudes = [*nominal.throughput_amplitudes]
        amplitudes += [0.0] * (self.mode + 1 - len(amplitudes))
        value, amplitudes[self.mode] = value - amplitudes[self.mode], value
        scaled = {name: getattr(nominal, name) * math.exp(slope * value) for name, slope in self.slopes.items()}
        return {"throughput_amplitudes": tuple(amplitudes)} | scaled


Row = TypeVar("Row", bound=Unknown)


def _dark_follows(at: Conditions, temperature_c: Float) -> Float:
    """Return the relative change of the dark current at other temperatures than the expectation's."""
    import numpy as np

    return np.asarray(np.expm1(at["dark_slope_per_c"] * (temperature_c - at["temperature_c"])))


def _lost(key: str) -> Callable[[Conditions, Float], Float]:
    """Return the change of light by a loss that replaces the expectation's."""
    return lambda at, lost: (at[key] - lost) / (1.0 - at[key])


def _tilt(quiet: Expectation) -> Float:
    """Return the relative change of each pixel's light for unit tilt, from -1 to 1 over the output range."""
    return (quiet.wavelength_nm - MIDDLE_NM) / TILT_NM


def _by_name(*rows: Row) -> dict[str, Row]:
    return {row.name: row for row in rows}


#: Processes in the order of their tables in kernels: fields of `Processes`, keys of studies' ``processes``.
PROCESSES = _by_name(
    UnknownProcess(
        name="jitter", when="frame", stream=4, low=0.0, high=0.5, change=lambda _, lost: -lost, expected=0.0,
        prior=Uniform(0.0, 0.05), drawn="share of the light lost in each frame, uniform, 0-5 %",
        source="the paper: light lost by pointing errors stays below 5 %; uniform and anew in each frame: assumption",
    ),
    UnknownProcess(
        name="detector_temperature", of="dark", stream=5, low=range_of(DetectorTemperature).low,
        high=range_of(DetectorTemperature).high, change=_dark_follows, expected="temperature_c",
        # Relative to the nominal temperature; see `default_processes`.
        prior=Normal(0.0, 0.5, -2.5, 2.5),
        drawn="detector temperature, normal, +-0.5 deg C around the nominal one, cut at 2.5 deg C",
        source="assumption: the thermal cycle of one orbit",
    ),
    UnknownProcess(name="light_loss", stream=6, low=0.0, high=0.99, change=_lost("light_loss"), expected="light_loss"),
    UnknownProcess(
        name="pointing_loss", stream=7, low=0.0, high=0.99, change=_lost("pointing_loss"), expected="pointing_loss",
    ),
    UnknownProcess(name="qe_scale", stream=8, low=0.01, high=100.0, change=lambda _, scale: scale - 1.0),
    UnknownProcess(
        name="sky_level", of="sky", stream=11, low=0.01, high=100.0, change=lambda _, level: level - 1.0,
        prior=Normal(1.0, 0.1, 0.5, 1.5), drawn="factor on the sky's light, normal, 1 +- 0.1, cut at 0.5 and 1.5",
        source="assumption: the scatter of the zodiacal light about its model",
    ),
)  # fmt: skip

#: Nuisance parameters with built-in spectra; keys of studies' ``nuisances``.
NUISANCES = _by_name(
    Nuisance(
        name="dark", label="the dark level", unit="deg C", process="detector_temperature", sd=math.inf,
        spectrum=lambda quiet: quiet.n_frames * quiet.dark_dn * quiet.conditions["dark_slope_per_c"],
        marginalised="free: the dark current follows the temperature by an exponential, which is no normal amplitude",
    ),
    Nuisance(
        name="light", label="the light level", process="jitter", sd=math.inf,
        spectrum=lambda quiet: quiet.recorded_light_dn, of_flare=lambda quiet: 1.0 + 0.0 * quiet.wavelength_nm,
        marginalised="free: the mean loss is unknown too, and so is the star's own level",
    ),
    Nuisance(
        name="sky", label="the sky level", process="sky_level", sd=PROCESSES["sky_level"].moments[1],
        spectrum=lambda quiet: quiet.sky_dn, marginalised="10 %",
    ),
    Nuisance(
        name="tilt", label="the response's colour", spectrum=lambda quiet: quiet.recorded_light_dn * _tilt(quiet),
        of_flare=_tilt,
    ),
)  # fmt: skip
#: Nuisance parameters of the documented set.
DOCUMENTED_NUISANCES = tuple(row for row in NUISANCES.values() if row.sd is not None)

if TYPE_CHECKING:
    NuisanceName = str
else:
    NuisanceName = Literal[tuple(NUISANCES)]


#: Quantities with unknown changes during a stare, by course; keys of studies' ``stare``. No jitter of the star alone is
#: drawn.
STARE_CHANGES: dict[Course, tuple[Changing, ...]] = {
    course: tuple(name for name in CHANGING if (course, name) != ("jitters", "star")) for course in COURSES
}
#: Documented standard deviations of a stare's unknowns, most of them those of processes.
DEFAULT_SPREADS: dict[Course, dict[Changing, float]] = {
    "jitters": {"light": PROCESSES["jitter"].moments[1]},
    "offsets": {"sky": PROCESSES["sky_level"].moments[1]},
    # Assumption: slow variability of the star.
    "drifts": {"star": 0.01},
    "cycles": {"temperature": PROCESSES["detector_temperature"].moments[1]},
}

#: Constant instrument values of which a campaign knows only priors; keys of studies' ``unknowns``. The documentation
#: page on nominal values explains the default priors.
INSTRUMENT_VALUES = _by_name(
    InstrumentValue(name="temperature_c", label="detector temperature (C)", prior=Uniform(13.0, 21.0)),
    InstrumentValue(name="light_loss", label="light loss", prior=Normal(0.34, 0.10, 0.04, 0.64), of_throughput=True),
    InstrumentValue(name="pointing_loss", label="pointing loss", prior=Uniform(0.0, 0.05), of_throughput=True),
    # The collecting area has the same effect as the scale of the quantum efficiency.
    InstrumentValue(name="qe_scale", label="quantum efficiency, scale", prior=Normal(1.0, 0.3, 0.3, 1.7),
                    scales="collecting_area_cm2", of_throughput=True),
    InstrumentValue(name="conversion_uv_per_electron", label="charge conversion (uV per electron)",
                    prior=Uniform(20.0, 25.0)),
    InstrumentValue(name="read_noise_dn", label="read noise (DN)", prior=Normal(12.0, 1.0, 9.0, 15.0)),
)  # fmt: skip

#: Largest number of modes of a calibration that are unknown: of the light in eight bands and seven other values.
MAX_MODES = 15
#: Prior of the amplitude of a mode, which has unit variance by definition.
MODE_PRIOR = Normal(0.0, 1.0, -5.0, 5.0)


def unknown_values_of(instrument: Instrument) -> dict[str, InstrumentValue]:
    """Return the unknown values of an instrument by name.

    These are `INSTRUMENT_VALUES`. If the throughput is calibrated, its modes replace those that change the throughput,
    and values that were fitted as well are known.
    """
    errors = instrument.throughput_errors
    if errors is None:
        return dict(INSTRUMENT_VALUES)
    fitted = {name for name, source in instrument.sources.items() if source.startswith("C: fitted")}
    measured = fitted.union(errors.values)
    values = {name: row for name, row in INSTRUMENT_VALUES.items() if not row.of_throughput and name not in measured}
    for k in range(min(len(errors.modes), MAX_MODES)):
        slopes = {name: steps[k] for name, steps in errors.values.items() if k < len(steps) and steps[k]}
        name, label = f"throughput_{k + 1}", f"calibration, mode {k + 1}"
        values[name] = InstrumentValue(name=name, label=label, prior=MODE_PRIOR, mode=k, slopes=slopes)
    return values


def default_processes(temperature_c: float) -> dict[str, Prior]:
    """Return the documented priors of the processes, for the detector's nominal temperature."""
    priors = {row.name: row.prior for row in PROCESSES.values() if row.prior is not None}
    warm, t = priors["detector_temperature"], temperature_c
    assert isinstance(warm, Normal)
    # Its row is relative to the nominal temperature.
    return priors | {"detector_temperature": Normal(t + warm.mean, warm.sd, t + warm.low, t + warm.high)}


_keys: Any = {name: (kind | None, None) for name, kind in ADDITIVE.items()} | dict.fromkeys(
    PROCESSES, (PriorField | None, None)
)


@validated
class Processes(create_model("_Processes", __base__=Section, **_keys)):  # type: ignore[misc]
    """Optional noise processes, and the study section that enables them; those that are None are disabled.

    Attributes
    ----------
    cosmic_rays : CosmicRays, optional
        Hits by charged particles.
    jitter : Prior, optional
        Fraction of the light that a frame loses by pointing jitter, in addition to the expectation's losses; drawn per
        frame. The paper expects ``Uniform(0, 0.05)``.
    detector_temperature : Prior, optional
        Temperature in deg C, drawn per realisation; the dark current follows the instrument's law.
    light_loss, pointing_loss : Prior, optional
        Replacements of the instrument's values, drawn per realisation.
    qe_scale, sky_level : Prior, optional
        Factors on the quantum efficiency and on the sky's light, drawn per realisation.
    """

    @property
    def additive(self) -> dict[str, AdditiveProcess]:
        """Enabled additive processes by name."""
        return {name: process for name in ADDITIVE if (process := getattr(self, name)) is not None}

    @property
    def modulations(self) -> tuple[tuple[str, SignalPart], ...]:
        """Names of the enabled priors and the part of the signal that each changes."""
        return tuple((name, varied.of) for name, varied in PROCESSES.items() if getattr(self, name) is not None)

    @property
    def additive_only(self) -> Self:
        """The processes without priors."""
        return cast("Self", self.model_copy(update=dict.fromkeys(PROCESSES)))

    @property
    def particle_processes(self) -> list[AdditiveProcess]:
        """Enabled processes that incident particles cause."""
        return [process for process in self.additive.values() if process.particles_per_cm2_s is not None]

    @property
    def particles_per_cm2_s(self) -> float:
        """Largest rate of incident particles of the enabled processes; zero without any."""
        return max((process.particles_per_cm2_s or 0.0 for process in self.particle_processes), default=0.0)

    def with_particles(self, rate_per_cm2_s: ParticleRate) -> Self:
        """Return a copy in which all processes caused by incident particles have this rate, enabled if necessary."""
        processes = {name: getattr(self, name) or kind() for name, kind in ADDITIVE.items()}
        caused = {name: process for name, process in processes.items() if process.particles_per_cm2_s is not None}
        update = {name: process.with_particles(rate_per_cm2_s) for name, process in caused.items()}
        return cast("Self", self.model_copy(update=update))


NONE = Processes()

#: Largest number of quiescent exposures in a stack.
MAX_EXPOSURES = 1000


@validated
@dataclass(frozen=True)
class Comparison:
    """Subtracted quiescent spectrum and the variances that weight the residuals.

    Attributes
    ----------
    exposures : int
        Number of noisy quiescent exposures whose mean is subtracted; 0 for the noise-free expectation.
    estimated : bool
        Whether variances are estimated from the counts, as an observer must, instead of taken from the model.
    """

    exposures: Annotated[int, Range(0, MAX_EXPOSURES)] = 0
    estimated: bool = False

    @classmethod
    def of(cls, reference: str = "template", variances: Literal["model", "estimated"] = "model") -> Self:
        """Create a comparison from its names in a study.

        `reference` is ``"template"`` for the expectation, ``"exposure"`` for one exposure, or ``"stack:n"`` for n of
        them.
        """
        word, colon, number = reference.partition(":")
        if not colon and word in ("template", "exposure"):
            exposures = int(word == "exposure")
        elif word == "stack" and number.isdecimal() and 1 <= int(number) <= MAX_EXPOSURES:
            exposures = int(number)
        else:
            expected = f"'template', 'exposure' or 'stack:n' with n from 1 to {MAX_EXPOSURES}"
            raise InputError.of("reference", reference, expected)
        return cls(exposures, variances == "estimated")

    @property
    def added_variance(self) -> float:
        """Variance of the subtracted spectrum, relative to that of one exposure."""
        return 1.0 / self.exposures if self.exposures else 0.0

    @property
    def plain(self) -> bool:
        """True if the comparison uses only the expectation and the variances of the model."""
        return not (self.exposures or self.estimated)


#: Comparison with the expectation by the model's variances.
NOISE_FREE = Comparison()
