"""Disturbances of frames: priors of unknown values, cosmic rays, drifts out of the fibre, and additive charge.

Studies contain priors, so this module imports NumPy only when a quantile is computed, to keep start-up fast.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from itertools import chain
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import BeforeValidator, PlainSerializer, PlainValidator, WithJsonSchema

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Duration, Number, Range, Unit, is_quantity, without_unit
from mauvecl.schema.section import Section, setting

if TYPE_CHECKING:
    from mauvecl.host.arrays import Float
    from mauvecl.host.exposure.expectation import Expectation

#: Events in a pixel and draw with a smaller probability are neglected.
NEGLIGIBLE = 2.0**-40


@validated
class AdditiveProcess(Section, ABC):
    """Charge that each pixel collects independently in each draw, and the study section that describes it.

    Kernels draw it from a table of `charge` in a separate stream, multiply it by the gain, and add it to the other
    noise of the pixel. Subclasses are listed in `ADDITIVE` by their study keys.
    """

    #: Number of the random stream in `layout.STREAMS`, and name in messages and tables.
    stream: ClassVar[int]
    label: ClassVar[str]

    @abstractmethod
    def charge(self, seconds: float) -> Float:
        """Return the probabilities of 0, 1, 2, ... electrons in a pixel in a time, shape (n,).

        The omitted tail has a probability below `NEGLIGIBLE`.
        """

    @abstractmethod
    def most_electrons(self, seconds: float) -> int:
        """Return the charge that a pixel exceeds in a time with a probability of at most `NEGLIGIBLE`."""

    def variance_dn2(self, quiet: Expectation) -> Float:
        """Return the added variance of each pixel in a frame, DN^2, shape (n_pixel,)."""
        import numpy as np

        charge = self.charge(quiet.frame_s)
        electrons = np.arange(charge.size)
        variance = float(charge @ electrons**2 - (charge @ electrons) ** 2)
        return np.asarray(variance * quiet.gain_dn_per_electron**2)

    @property
    def particles_per_cm2_s(self) -> float | None:
        """Rate of incident particles, or None if the process is not caused by particles from outside."""
        return None

    def with_particles(self, rate_per_cm2_s: float) -> Self:
        """Return the process at another rate of incident particles."""
        return self

    @property
    def assumption(self) -> tuple[str, str, str]:
        """Row of a table of assumptions: quantity, value and source."""
        return (self.label, "", "the study")


#: Rate of hits per area.
ParticleRate = Annotated[float, Unit("1 / (cm2 s)"), Range(0, 1e6)]


@validated
class CosmicRays(AdditiveProcess):
    """Hits by charged particles; the defaults are assumptions (INSTRUMENT.md: outside the South Atlantic Anomaly).

    Attributes
    ----------
    rate_per_cm2_s : float
        Hits per area and time.
    area_cm2, pixels : float and int
        Area of the whole detector, 2048 pixels of 14 x 200 um, and number of pixels; a hit affects one of them.
    electrons : tuple of float, shape (2,)
        Smallest and largest number of electrons of a hit.
    weights : tuple of float, optional
        Relative probabilities of the integers in this range; equal by default.
    """

    stream: ClassVar[int] = 3
    label: ClassVar[str] = "cosmic rays"

    rate_per_cm2_s: ParticleRate = 1.0
    area_cm2: Annotated[float, Unit("cm2"), Range(0, 1e4, open_low=True)] = 0.057
    pixels: Annotated[int, Range(1)] = 2048
    electrons: tuple[Number, Number] = (500.0, 1000.0)
    weights: tuple[Number, ...] | None = None

    def _check_values(self) -> None:
        low, high = self.electrons
        if not 1 <= low <= high <= 100_000:
            raise InputError.of("electrons", (low, high), "between 1 and 100000, ascending", where="cosmic rays")
        if self.weights is not None:
            size = int(high) - int(low) + 1
            if len(self.weights) != size or min(self.weights) < 0 or not sum(self.weights) > 0:
                raise InputError.of("weights", self.weights, f"{size} numbers of at least 0", where="cosmic rays")

    def charge(self, seconds: Annotated[float, Unit("s"), Range(0)]) -> Float:
        """Return the distribution of the charge that a pixel collects in a time, a compound Poisson distribution."""
        import numpy as np

        low, high = (int(e) for e in self.electrons)
        hits, most = self._hits(seconds), self.most_electrons(seconds)
        size = 1 << (most + 1).bit_length()
        if size > 2**24:
            raise InputError(
                f"cosmic rays may free at most {2**23} electrons in a pixel and draw, not {most}: lower the rate, the "
                "charge or the exposure",
                key="rate_per_cm2_s",
            )
        charge = np.zeros(size)
        charge[low : high + 1] = 1.0 if self.weights is None else self.weights
        # This is the generating function of a Poisson number of hits; charges beyond `size` would alias.
        spectrum = np.exp(hits * (np.fft.rfft(charge / charge.sum()) - 1.0))
        return np.asarray(np.maximum(np.fft.irfft(spectrum, size)[: most + 1], 0.0))

    def most_electrons(self, seconds: Annotated[float, Unit("s"), Range(0)]) -> int:
        from scipy import special

        hits = self._hits(seconds)
        most = max(1, int(hits))
        while special.pdtrc(most, hits) > NEGLIGIBLE:
            most += 1
        return most * int(self.electrons[1])

    def _hits(self, seconds: float) -> float:
        """Return the mean number of hits in one pixel."""
        return self.rate_per_cm2_s * self.area_cm2 / self.pixels * seconds

    @property
    def particles_per_cm2_s(self) -> float:
        """Rate of incident particles."""
        return self.rate_per_cm2_s

    def with_particles(self, rate_per_cm2_s: ParticleRate) -> Self:
        return self.model_copy(update={"rate_per_cm2_s": rate_per_cm2_s})

    @property
    def assumption(self) -> tuple[str, str, str]:
        low, high = self.electrons
        return ("charge of a hit", f"{low:g} to {high:g} electrons in one pixel", "assumption; adds to the noise")


#: Additive processes: fields of `Processes`, keys of studies' ``processes``.
ADDITIVE: dict[str, type[AdditiveProcess]] = {"cosmic_rays": CosmicRays}


@validated
class PointingDrifts(Section):
    """Drifts out of the fibre during a stare, each ended by a re-acquisition; all values are assumptions.

    The target is in place at the start of a stare. The time until a drift begins and the duration of the drift are
    exponentially distributed. In a drift, the lost share of all light (of star, flare, neighbours and sky) rises
    linearly from zero. The target is then acquired again, and the light returns at once.
    """

    stream: ClassVar[int] = 20
    label: ClassVar[str] = "pointing drifts"
    #: For messages and tables of assumptions.
    source: ClassVar[str] = "assumption: rate, depth and duration of drifts are not published"

    rate_per_h: Annotated[float, Unit("1 / h"), Range(0, 3600, open_low=True)] = setting(
        0.5,
        "Drifts per hour of good pointing; an assumption",
        label="Pointing losses",
        hint="Drifts of the star out of the fibre, each ended by a new acquisition, per hour of good pointing. "
        "Nothing: none. How often they happen is not published.",
        name="pointing_rate",
        first="",
        unit="per hour",
        most=60.0,
    )
    duration_s: Duration = setting(
        300.0,
        "Mean duration of a drift; exponential; an assumption",
        label="Duration of a loss",
        hint="Mean time from the start of a drift to the new acquisition; an assumption.",
        name="pointing_duration",
    )
    depth: Annotated[float, Range(0, 1, open_low=True)] = setting(
        0.5,
        "Largest share of the light lost at the end of a drift; uniform from 0; an assumption",
        label="Depth of a loss",
        hint="Largest share of the light that is lost at the end of a drift; an assumption.",
        name="pointing_depth",
        unit="%",
    )


#: Largest distance of a cut from the mean in standard deviations; beyond it, the logarithm of the tail loses precision.
MAX_CUT_SD = 1e5


def _in_celsius(value: Any) -> Any:
    """Convert a Quantity of temperature to deg C, which prior values have; return others unchanged."""
    is_temperature = is_quantity(value) and value.unit.physical_type == "temperature"
    return without_unit(value, "deg_C") if is_temperature else value


PriorValue = Annotated[float, Range(), BeforeValidator(_in_celsius)]


@validated
@dataclass(frozen=True)
class Uniform:
    """Uniform prior between two values; temperatures may be Quantities and are stored in deg C."""

    low: PriorValue
    high: PriorValue

    def __post_init__(self) -> None:
        if not self.low <= self.high:
            raise InputError.of("low", self.low, f"at most high = {self.high:g}")

    def quantile(self, below: Float, above: Float | None = None) -> Float:
        """Return the quantiles at probabilities `below`; see `Normal.quantile`."""
        import numpy as np

        from_low = self.low + (self.high - self.low) * below
        if above is None:
            return np.asarray(from_low)
        return np.asarray(np.where(below < above, from_low, self.high - (self.high - self.low) * above))


@validated
@dataclass(frozen=True)
class Normal:
    """Normal prior truncated at `low` and `high`; values as for `Uniform`, with a plain `sd` in deg C."""

    mean: PriorValue
    sd: Annotated[float, Range()]
    low: PriorValue
    high: PriorValue

    def __post_init__(self) -> None:
        if not (self.sd > 0 and self.low < self.high):
            raise InputError(
                f"a normal prior must have sd > 0 and low < high, not mean {self.mean:g}, sd {self.sd:g}, low "
                f"{self.low:g} and high {self.high:g}",
                key="sd",
            )
        away = max(self.low - self.mean, self.mean - self.high) / self.sd
        if away > MAX_CUT_SD:
            raise InputError(
                f"a normal prior of mean {self.mean:g} and sd {self.sd:g} must be cut at most {MAX_CUT_SD:g} sd from "
                f"its mean, not at {self.low:g} and {self.high:g}, {away:g} sd from it",
                key="low",
            )

    def is_wide(self, least_sd: float) -> bool:
        """Return whether both cuts are at least this many standard deviations from the mean."""
        return min(self.mean - self.low, self.high - self.mean) >= least_sd * self.sd * (1.0 - 1e-12)

    def quantile(self, below: Float, above: Float | None = None) -> Float:
        """Return the quantiles at probabilities `below`; `above` is 1 - below, if subtraction would lose precision."""
        import numpy as np
        from scipy import special

        above = 1.0 - below if above is None else above
        with np.errstate(divide="ignore", over="ignore"):
            low, high = np.log(below), np.log(above)
            a, b = ((np.array([self.low, self.high]) - self.mean) / self.sd).tolist()
            # Each side of the mean uses the logarithm of its own tail, which does not underflow.
            negative = special.ndtri_exp(np.logaddexp(special.log_ndtr(a) + high, special.log_ndtr(b) + low))
            positive = -special.ndtri_exp(np.logaddexp(special.log_ndtr(-a) + high, special.log_ndtr(-b) + low))
        score = np.where(negative < 0.0, negative, positive)
        return np.asarray(np.clip(self.mean + self.sd * score, self.low, self.high))


Prior = Uniform | Normal

#: Keys of a prior in a study, each with two values.
_FORMS: dict[type[Prior], tuple[str, ...]] = {Uniform: ("uniform",), Normal: ("normal", "between")}
_PAIR = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}


def _from_study(value: Any) -> Prior:
    """Return the prior that a study gives as a table; raises InputError otherwise."""
    if isinstance(value, Uniform | Normal):
        return value
    table = value if isinstance(value, Mapping) else {}
    for kind, form in _FORMS.items():
        if {key for key in table if table[key] is not None} == {*form}:
            for key in form:
                if not isinstance(table[key], list | tuple) or len(table[key]) != 2:
                    raise InputError.of(key, table[key], "2 numbers")
            return kind(*(_number(number) for key in form for number in table[key]))
    keys = [*chain.from_iterable(_FORMS.values())]
    if unknown := next((key for key in table if key not in keys), None):
        raise InputError(f"unknown key {unknown!r} of a prior; use some of {', '.join(keys)}", key=unknown)
    raise InputError(
        "a prior must be { uniform = [low, high] } or { normal = [mean, sd], between = [low, high] }", key="uniform"
    )


def _number(value: Any) -> Any:
    """Convert a number in quotes, which other fields accept as well; return others unchanged."""
    with contextlib.suppress(ValueError):
        return float(value) if isinstance(value, str) else value
    return value


def _to_study(prior: Prior) -> dict[str, tuple[float, ...]]:
    """Return the table that a study contains."""
    values = astuple(prior)
    return {key: values[2 * k : 2 * k + 2] for k, key in enumerate(_FORMS[type(prior)])}


_SCHEMA = [
    {"type": "object", "properties": dict.fromkeys(form, _PAIR), "required": [*form], "additionalProperties": False}
    for form in _FORMS.values()
]
#: Prior as a field of a study's section.
PriorField = Annotated[
    Prior, PlainValidator(_from_study), PlainSerializer(_to_study), WithJsonSchema({"anyOf": _SCHEMA})
]
