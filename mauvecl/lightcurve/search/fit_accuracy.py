"""Accuracy of fits to detected injections.

Each injected flare is fitted alone (`flare_fit`), with standard errors from the curvature. Flares that `stare` detects
are fitted together and have intervals from the profile likelihood (`alarms`), which have better coverage near the
threshold.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.tables import Column

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.flare_fit import FittedFlares, SingleFlareFit
    from mauvecl.lightcurve.search.injection_sites import InjectionSite

Float = NDArray[np.float64]

#: Quantities of each fit: ratios of fitted to injected values, the peak offset in half-widths, and whether the
#: equivalent duration is within its standard error.
FIT_QUANTITIES = ("energy", "amplitude", "half_width", "temperature", "peak", "covered")


@dataclass(frozen=True, eq=False)
class Refit:
    """Injected flares to fit if they are detected."""

    fit: SingleFlareFit
    amplitudes: Float  # injected amplitudes, shape (n_half_width, n_amplitude)
    temperature_k: float  # temperature of the injected flares
    count: int  # number of stares per peak time with fits, the first ones

    def compared(self, recovered: FittedFlares, amplitude: Float, site: InjectionSite) -> dict[str, NDArray[Any]]:
        """Compare fits with the injected flares, by the names of `FIT_QUANTITIES`, shape (n_amplitude,) each."""
        duration = amplitude * site.half_width_s * self.fit.bank.shape.equivalent_duration
        off = np.abs(recovered.equivalent_duration_s - duration)
        return {
            "energy": recovered.equivalent_duration_s / duration,
            "amplitude": recovered.amplitude / amplitude,
            "half_width": recovered.half_width_s / site.half_width_s,
            "temperature": recovered.temperature_k / self.temperature_k,
            "peak": (recovered.peak_s - site.peak_s) / site.half_width_s,
            "covered": off <= recovered.equivalent_duration_error_s,
        }


@dataclass(frozen=True, eq=False)
class FitAccuracy:
    """Accuracy of fits in each cell; arrays of shape (n_half_width, n_size), NaN without detections.

    `COLUMNS` are the attributes as columns of a table.
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

    COLUMNS: ClassVar[tuple[Column, ...]] = (
        Column("fitted", description="flares that were found and fitted"),
        Column("energy_ratio", description="recovered over injected energy, median of those found"),
        Column("energy_ratio_low", description="the same, 16 % quantile"),
        Column("energy_ratio_high", description="the same, 84 % quantile"),
        Column("amplitude_ratio", description="recovered over injected amplitude, median"),
        Column("half_width_ratio", description="recovered over injected half-width, median"),
        Column("temperature_ratio", description="recovered over injected temperature, median"),
        Column("peak_offset", description="recovered less injected time of the peak, half-widths, median"),
        Column("peak_scatter", description="half of the range of the middle 68 % of it, half-widths"),
        Column("energy_covered", description="share of energies within their own standard error of the injected one"),
    )

    @classmethod
    def of(cls, parts: Sequence[Mapping[str, NDArray[Any]]]) -> Self:
        """Summarise the fits of all positions, arrays by `FIT_QUANTITIES` of shape (n_stare, n_half_width, n_size)."""
        each = {name: np.moveaxis(np.concatenate([part[name] for part in parts]), 0, 2) for name in FIT_QUANTITIES}
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
    """Return the median over stares, NaN for cells without fitted temperatures."""
    blank = none | ~np.isfinite(values).any(axis=2)
    return np.where(blank, np.nan, np.nanmedian(np.where(blank[:, :, None], 0.0, values), axis=2))
