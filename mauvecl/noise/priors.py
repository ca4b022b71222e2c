"""Prior distributions of unknown values.

Studies contain priors, so this module imports NumPy only when a quantile is computed, to keep start-up fast.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import PlainSerializer, PlainValidator, WithJsonSchema

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range
from mauvecl.schema.quantities import is_quantity, without_unit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from pydantic import GetCoreSchemaHandler
    from pydantic_core import CoreSchema

    Float = NDArray[np.float64]

#: Largest distance of a cut from the mean in standard deviations; beyond it, the logarithm of the tail loses precision.
MAX_CUT_SD = 1e5


class PriorUnit:
    """Unit of a value with a prior: deg C of temperatures, none of others."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        from pydantic_core import core_schema

        return core_schema.no_info_before_validator_function(self._plain, handler(source))

    @staticmethod
    def _plain(value: Any) -> Any:
        is_temperature = is_quantity(value) and value.unit.physical_type == "temperature"
        return without_unit(value, "deg_C") if is_temperature else value


PriorValue = Annotated[float, PriorUnit(), Range()]


@validated
@dataclass(frozen=True)
class Uniform:
    """Uniform prior between two values; temperatures may be Quantities and are stored in deg C."""

    low: PriorValue
    high: PriorValue

    def __post_init__(self) -> None:
        if not self.low <= self.high:
            raise InputError.of("low", self.low, "low <= high")

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
                f"a normal prior of mean {self.mean:g}, sd {self.sd:g}, cut at {self.low:g} and {self.high:g}",
                "sd > 0 and low < high",
                key="sd",
                value=self.sd,
            )
        away = max(self.low - self.mean, self.mean - self.high) / self.sd
        if away > MAX_CUT_SD:
            raise InputError(
                f"a normal prior of mean {self.mean:g} and sd {self.sd:g} is cut at {self.low:g} and "
                f"{self.high:g}, {away:g} sd from its mean",
                f"at most {MAX_CUT_SD:g}",
                key="low",
                value=(self.low, self.high),
            )

    def is_wide(self, least_sd: float) -> bool:
        """Return whether both cuts are at least this many standard deviations from the mean."""
        return min(self.mean - self.low, self.high - self.mean) >= least_sd * self.sd * (1.0 - 1e-12)

    def quantile(self, below: Float, above: Float | None = None) -> Float:
        """Return the quantiles at probabilities `below`.

        Parameters
        ----------
        below : ndarray
        above : ndarray, same shape, optional
            1 - below, if the subtraction would lose precision.
        """
        import numpy as np
        from scipy import special

        above = 1.0 - below if above is None else above
        with np.errstate(divide="ignore", over="ignore"):
            low, high = np.log(below), np.log(above)
            a, b = ((np.array([self.low, self.high]) - self.mean) / self.sd).tolist()
            # Each side of the mean uses the logarithm of its own tail, which does not underflow.
            left = special.ndtri_exp(np.logaddexp(special.log_ndtr(a) + high, special.log_ndtr(b) + low))
            right = -special.ndtri_exp(np.logaddexp(special.log_ndtr(-a) + high, special.log_ndtr(-b) + low))
        inside = np.where(left < 0.0, left, right)
        return np.asarray(np.clip(self.mean + self.sd * inside, self.low, self.high))


Prior = Uniform | Normal

#: Keys of a prior in a study, each with the number of its values.
_FORMS: dict[type[Prior], dict[str, int]] = {Uniform: {"uniform": 2}, Normal: {"normal": 2, "between": 2}}


def _from_study(given: Any) -> Prior:
    """Return the prior that a study gives as a table; raises InputError otherwise."""
    if isinstance(given, Uniform | Normal):
        return given
    for kind, form in _FORMS.items():
        if isinstance(given, Mapping) and {key for key in given if given[key] is not None} == form.keys():
            return kind(*(value for key, n in form.items() for value in _values(key, given[key], n)))
    known = [key for form in _FORMS.values() for key in form]
    if isinstance(given, Mapping) and (other := next((key for key in given if key not in known), None)):
        raise InputError(
            f"unknown key {other!r} of a prior", f"some of {', '.join(known)}", key=other, value=given[other]
        )
    raise InputError(
        "a prior is neither { uniform = [low, high] } nor { normal = [mean, sd], between = [low, high] }",
        "one of them",
        key="uniform",
        value=given.get("uniform") if isinstance(given, Mapping) else given,
    )


def _values(key: str, given: Any, n: int) -> list[float]:
    if not isinstance(given, list | tuple) or len(given) != n:
        raise InputError.of(key, given, f"{n} numbers")
    # Numbers in quotes are accepted, as in other fields.
    return [float(value) if isinstance(value, int) or _is_number(value) else value for value in given]


def _is_number(text: Any) -> bool:
    with contextlib.suppress(ValueError):
        return isinstance(text, str) and float(text) is not None
    return False


def _to_study(prior: Prior) -> dict[str, tuple[float, ...]]:
    """Return the table that a study contains."""
    if isinstance(prior, Uniform):
        return {"uniform": (prior.low, prior.high)}
    return {"normal": (prior.mean, prior.sd), "between": (prior.low, prior.high)}


def _json_schema() -> dict[str, Any]:
    def pair(keys: Mapping[str, int]) -> dict[str, Any]:
        several = {"type": "array", "items": {"type": "number"}}
        lists = {key: several | {"minItems": n, "maxItems": n} for key, n in keys.items()}
        return {"type": "object", "properties": lists, "required": [*keys], "additionalProperties": False}

    return {"anyOf": [pair(form) for form in _FORMS.values()]}


#: Prior as a field of a study's section.
PriorField = Annotated[Prior, PlainValidator(_from_study), PlainSerializer(_to_study), WithJsonSchema(_json_schema())]
