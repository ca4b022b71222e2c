"""Values on which priors can be set; processes, study keys and kernel tables follow this list.

The module imports no large package, so that wrong keys are reported immediately.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Float = NDArray[np.float64]

Conditions = Mapping[str, float]
SignalPart = Literal["light", "dark", "sky"]


@dataclass(frozen=True)
class PriorTarget:
    """Value on which a prior can be set.

    Attributes
    ----------
    low, high : float
        Range of allowed values.
    change : callable
        Function of an expectation's conditions and drawn values that returns the factor minus one.
    of : {"light", "dark", "sky"}
        Part of the signal that the factor multiplies.
    expected : str or float
        Value in the expectation, or its key in the expectation's conditions.
    """

    low: float
    high: float
    change: Callable[[Conditions, Float], Float]
    of: SignalPart = "light"
    expected: str | float = 1.0

    def expected_in(self, conditions: Conditions) -> float:
        """Return the value in an expectation."""
        return conditions[self.expected] if isinstance(self.expected, str) else self.expected


def _dark_follows(at: Conditions, temperature_c: Float) -> Float:
    import numpy as np

    return np.asarray(np.expm1(at["dark_slope_per_c"] * (temperature_c - at["temperature_c"])))


#: All targets in the order of their tables in kernels; fields of `Processes` and keys of studies have these names.
PRIOR_TARGETS = {
    "jitter": PriorTarget(0.0, 0.5, lambda _, lost: -lost, expected=0.0),
    "detector_temperature": PriorTarget(-100.0, 100.0, _dark_follows, "dark", "temperature_c"),
    "light_loss": PriorTarget(
        0.0, 0.99, lambda at, lost: (at["light_loss"] - lost) / (1.0 - at["light_loss"]), expected="light_loss"
    ),
    "pointing_loss": PriorTarget(
        0.0, 0.99, lambda at, lost: (at["pointing_loss"] - lost) / (1.0 - at["pointing_loss"]), expected="pointing_loss"
    ),
    "qe_scale": PriorTarget(0.01, 100.0, lambda _, scale: scale - 1.0),
    "sky_level": PriorTarget(0.01, 100.0, lambda _, level: level - 1.0, "sky"),
}
