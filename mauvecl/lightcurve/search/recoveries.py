"""How well found flares are recovered: fits of injected ones, held against what was injected.

Each injected flare is fitted alone (`recovery`), with standard errors by curvature. Flares that `stare` finds are
fitted together and have intervals by profile likelihood (`alarms`), which hold the truth more often near the threshold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.places import Place
    from mauvecl.lightcurve.search.recovery import Fit, Recovered

Float = NDArray[np.float64]

#: What is kept of each fit: its value over the injected one, peaks in half-widths, and whether the equivalent duration
#: is within its own standard error.
KEPT = ("energy", "amplitude", "half_width", "temperature", "peak", "covered")


@dataclass(frozen=True, eq=False)
class Refit:
    """Which injected flares are fitted.

    Attributes
    ----------
    fit : Fit
    amplitudes : ndarray, shape (n_half_width, n_amplitude)
        Of the flares, which are fitted where they are found.
    temperature_k : float
        Of the flares.
    count : int
        Stares of each peak whose flares are: the first ones.
    """

    fit: Fit
    amplitudes: Float
    temperature_k: float
    count: int

    @property
    def kelvin(self) -> Float:
        """Temperatures that the bank looks for, shape (n_temperature,)."""
        templates = self.fit.templates
        return np.array(templates.temperatures_k)[list(templates.chosen)]

    def compared(self, recovered: Recovered, amplitude: Float, place: Place) -> dict[str, NDArray[Any]]:
        """What was recovered of flares of some amplitudes at a place, by the names of `KEPT`, shape (n_amplitude,)."""
        duration = amplitude * place.half_width_s * self.fit.bank.shape.equivalent_duration
        off = np.abs(recovered.equivalent_duration_s - duration)
        return {
            "energy": recovered.equivalent_duration_s / duration,
            "amplitude": recovered.amplitude / amplitude,
            "half_width": recovered.half_width_s / place.half_width_s,
            "temperature": recovered.temperature_k / self.temperature_k,
            "peak": (recovered.peak_s - place.peak_s) / place.half_width_s,
            "covered": off <= recovered.equivalent_duration_error_s,
        }


@dataclass(frozen=True, eq=False)
class Fitted:
    """How well the found flares of each cell are recovered; arrays of shape (n_half_width, n_size), NaN for none found.

    Attributes are named and described by `COLUMNS`.
    """

    fitted: Float
    energy_ratio: Float
    energy_ratio_low: Float
    energy_ratio_high: Float
    amplitude_ratio: Float
    half_width_ratio: Float
    temperature_ratio: Float
    peak_offset: Float
    peak_scatter: Float
    energy_covered: Float

    COLUMNS: ClassVar[dict[str, str]] = {
        "fitted": "flares that were found and fitted",
        "energy_ratio": "recovered over injected energy, median of those found",
        "energy_ratio_low": "the same, 16 % quantile",
        "energy_ratio_high": "the same, 84 % quantile",
        "amplitude_ratio": "recovered over injected amplitude, median",
        "half_width_ratio": "recovered over injected half-width, median",
        "temperature_ratio": "recovered over injected temperature, median",
        "peak_offset": "recovered less injected time of the peak, half-widths, median",
        "peak_scatter": "half of the range of the middle 68 % of it, half-widths",
        "energy_covered": "share of energies within their own standard error of the injected one",
    }

    @classmethod
    def of(cls, parts: Sequence[Mapping[str, NDArray[Any]]]) -> Self:
        """From the fits of all positions, by the names of `KEPT`, shape (n_stare, n_half_width, n_size) each."""
        each = {name: np.moveaxis(np.concatenate([part[name] for part in parts]), 0, 2) for name in KEPT}
        count = np.isfinite(each["energy"]).sum(axis=2)
        none = count == 0

        def quantile(name: str, q: float) -> Float:
            filled = np.where(none[:, :, None], 0.0, each[name])
            return np.where(none, np.nan, np.nanquantile(filled, q, axis=2))

        peak = [quantile("peak", q) for q in (0.16, 0.5, 0.84)]
        return cls(
            fitted=count.astype(np.float64),
            energy_ratio=quantile("energy", 0.5),
            energy_ratio_low=quantile("energy", 0.16),
            energy_ratio_high=quantile("energy", 0.84),
            amplitude_ratio=quantile("amplitude", 0.5),
            half_width_ratio=quantile("half_width", 0.5),
            temperature_ratio=_quiet_median(each["temperature"], none),
            peak_offset=peak[1],
            peak_scatter=(peak[2] - peak[0]) / 2,
            energy_covered=np.where(none, np.nan, np.nanmean(np.where(none[:, :, None], 0.0, each["covered"]), axis=2)),
        )


def _quiet_median(values: NDArray[Any], none: NDArray[np.bool_]) -> Float:
    """The median, where a temperature is fitted at all."""
    blank = none | ~np.isfinite(values).any(axis=2)
    return np.where(blank, np.nan, np.nanmedian(np.where(blank[:, :, None], 0.0, values), axis=2))
