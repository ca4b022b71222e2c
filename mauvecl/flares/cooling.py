"""Flares whose temperature falls exponentially after the peak."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Help, Unit
from mauvecl.schema.physical import Duration, Temperature
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

#: Temperatures that differ by less are treated as equal, K.
SAME_K = 0.5


class CoolingLaw(Section):
    """Exponential cooling of a flare from the temperature of its peak."""

    end_k: Annotated[Temperature, Help("Final temperature")]
    fold_s: Annotated[Duration, Help("Time in which the temperature excess falls by a factor of e")]


@validated
class Cooling(CoolingLaw):
    """Temperature that is constant before the peak, and end + (peak - end) exp(-(t - t_peak) / fold) after it."""

    peak_k: Temperature

    def __init__(self, peak_k: Temperature, end_k: Temperature, fold_s: Duration) -> None:
        super().__init__(peak_k=peak_k, end_k=end_k, fold_s=fold_s)  # type: ignore[call-arg]
        if end_k > peak_k:
            raise InputError.of("end_k", end_k, f"at most the temperature of the peak, {peak_k:g} K", unit="K")

    def at(self, since_peak_s: Annotated[ArrayLike, Unit("s")]) -> NDArray[np.float64]:
        """Return the temperature at times since the peak, K, shape of the time."""
        import numpy as np

        cooled = np.exp(-np.maximum(since_peak_s, 0.0) / self.fold_s)
        return np.asarray(self.end_k + (self.peak_k - self.end_k) * cooled)

    @property
    def steady(self) -> bool:
        """True if the temperature hardly changes."""
        return self.peak_k - self.end_k < SAME_K
