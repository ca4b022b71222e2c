"""What priors may be put on: one list, which processes, the study's keys and kernels' tables follow.

Read before anything large is loaded: a wrong key is told at once.
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
Modulated = Literal["light", "dark", "sky"]


@dataclass(frozen=True)
class Varied:
    """What a prior may be put on.

    Attributes
    ----------
    low, high : float
        Ends of what it may be.
    change : callable
        From an expectation's conditions and values drawn to the factor less one.
    of : {"light", "dark", "sky"}
        What the factor is on.
    expected : str or float
        What the expectation has: a key of its conditions, or a value.
    """

    low: float
    high: float
    change: Callable[[Conditions, Float], Float]
    of: Modulated = "light"
    expected: str | float = 1.0

    def expected_in(self, conditions: Conditions) -> float:
        """Return the value that an expectation has."""
        return conditions[self.expected] if isinstance(self.expected, str) else self.expected


def _dark_follows(at: Conditions, temperature_c: Float) -> Float:
    import numpy as np

    return np.asarray(np.expm1(at["dark_slope_per_c"] * (temperature_c - at["temperature_c"])))


#: The one list of them, in the order of their tables in kernels; `Processes` and the study's section have these names.
VARIED = {
    "jitter": Varied(0.0, 0.5, lambda _, lost: -lost, expected=0.0),
    "detector_temperature": Varied(-100.0, 100.0, _dark_follows, "dark", "temperature_c"),
    "light_loss": Varied(
        0.0, 0.99, lambda at, lost: (at["light_loss"] - lost) / (1.0 - at["light_loss"]), expected="light_loss"
    ),
    "pointing_loss": Varied(
        0.0, 0.99, lambda at, lost: (at["pointing_loss"] - lost) / (1.0 - at["pointing_loss"]), expected="pointing_loss"
    ),
    "qe_scale": Varied(0.01, 100.0, lambda _, scale: scale - 1.0),
    "sky_level": Varied(0.01, 100.0, lambda _, level: level - 1.0, "sky"),
}
