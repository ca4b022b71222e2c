"""What injections say: completeness over size and half-width with intervals, limits, and how flares are recovered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.search.injections import BLOCK, Injections, Place
from mauvecl.statistics.intervals import Interval, central_counts, clopper_pearson

if TYPE_CHECKING:
    from collections.abc import Mapping

    from mauvecl.lightcurve.search.recovery import Fit

Float = NDArray[np.float64]

#: What is kept of each fit: its value over the injected one, peaks in half-widths, and whether the equivalent duration
#: is within its own standard error.
KEPT = ("energy", "amplitude", "half_width", "temperature", "peak", "covered")


@dataclass(frozen=True, eq=False)
class InjectedShares:
    """Shares of injected flares that a search finds.

    Attributes
    ----------
    half_widths_s : tuple of float
    sizes : ndarray, shape (n_size,)
    amplitudes : ndarray, shape (n_half_width, n_size)
    critical : ndarray, shape (n_half_width, n_position, n_draw)
        Size from which on each draw is found.
    """

    half_widths_s: tuple[float, ...]
    sizes: Float
    amplitudes: Float
    critical: Float

    @property
    def count(self) -> int:
        """Injections of each cell."""
        return int(self.critical[0].size)

    @cached_property
    def _cells(self) -> tuple[Float, Float, Float]:
        found = np.empty((3, len(self.half_widths_s), self.sizes.size))
        for d, critical in enumerate(self.critical):
            for s, size in enumerate(self.sizes):
                p = self._share(critical, float(size))
                found[:, d, s] = p.value, p.low, p.high
        return found[0], found[1], found[2]

    @property
    def completeness(self) -> Float:
        """Share found, shape (n_half_width, n_size)."""
        return self._cells[0]

    @property
    def completeness_low(self) -> Float:
        """Lower ends of its 95 % intervals."""
        return self._cells[1]

    @property
    def completeness_high(self) -> Float:
        """Upper ends of its 95 % intervals."""
        return self._cells[2]

    def _share(self, critical: Float, size: float) -> Interval:
        """Share found at a size; the interval is of as many independent draws as positions that differ leave."""
        each = np.mean(critical <= size, axis=1)
        share, trials = float(each.mean()), self._independent(each, critical.size)
        around = clopper_pearson(round(share * trials), trials)
        return Interval(share, min(around.low, share), max(around.high, share))

    @staticmethod
    def _independent(each: Float, count: int) -> int:
        """Independent draws that scatter as much: fewer than `count` where positions differ (Kish's design effect)."""
        share = float(each.mean())
        binomial = share * (1 - share) / count
        if not binomial > 0 or each.size < 2:
            return count
        return max(1, int(count * min(1.0, binomial / max(float(each.var(ddof=1)) / each.size, 1e-300))))

    def limit(self, power: float, half_width: int | None) -> Interval:
        """The size of which a share `power` is found, with 95 %; infinite where that many never are.

        Parameters
        ----------
        power : float
        half_width : int, optional
            Which; all of them alike, evenly in the logarithm, by default.
        """
        critical = self.critical if half_width is None else self.critical[half_width : half_width + 1]
        by_position = np.moveaxis(critical, 1, 0).reshape(critical.shape[1], -1)
        ordered = np.sort(by_position, axis=None)
        value = float(ordered[min(int(np.ceil(power * ordered.size)), ordered.size) - 1])
        trials = self._independent(np.mean(by_position <= value, axis=1), ordered.size)
        # Half-widths share their draws: they are no draws more.
        trials = max(1, min(trials, self.count))
        ranks = [int(k / trials * ordered.size) for k in central_counts(trials, power)]
        low, high = (float(ordered[min(max(k, 0), ordered.size - 1)]) for k in ranks)
        return Interval(value, min(low, value), max(high, value))

    def never(self, half_width: int | None) -> float:
        """Share for which no template fits into what is observed."""
        critical = self.critical if half_width is None else self.critical[half_width]
        return float(np.mean(np.isinf(critical)))


def fitted(
    injections: Injections, fit: Fit, places: Sequence[Place], position: int, count: int, amplitudes: Float
) -> dict[str, NDArray[Any]]:
    """Fits of the first draws of a position, where they are found.

    Parameters
    ----------
    injections : Injections
    fit : Fit
    places : sequence of Place
        Of the position.
    position, count : int
    amplitudes : ndarray, shape (n_half_width, n_amplitude)

    Returns
    -------
    dict of ndarray, shape (n_half_width, n_amplitude, count)
        By the names of `KEPT`; NaN where a flare is not found.
    """
    survey = injections.survey
    frames = injections.frames(list(places))
    drawn = injections.draw(position, 0, min(BLOCK, injections.draws), frames)
    count = min(count, drawn.noise.shape[1])
    drawn = drawn.first(count)
    kept = {name: np.full((*amplitudes.shape, count), np.nan, np.float32) for name in KEPT}
    kelvin = np.array(fit.templates.temperatures_k)[list(fit.templates.chosen)]
    injected_k = injections.temperature_k
    for d, (place, row) in enumerate(zip(places, amplitudes, strict=True)):
        if not len(place.filters):
            continue
        here = drawn.within(frames, place.frames)
        value, temperature, template = injections.best(place, here, row)
        found = value >= injections.threshold
        if not found.any():
            continue
        recovered = fit.recover(
            injections.sums(place, here, row)[found],
            survey.stare.start_s[place.frames],
            peak_s=place.peaks_s[template[found]],
            half_width_s=place.widths_s[template[found]],
            temperature_k=kelvin[temperature[found]],
            variance=survey.variance[place.frames],
            curves=None if survey.curves is None else survey.curves[:, place.frames],
        )
        injected = np.broadcast_to(row[:, None], found.shape)[found]
        duration = injected * place.half_width_s * fit.bank.shape.equivalent_duration
        off = np.abs(recovered.equivalent_duration_s - duration)
        for name, values in (
            ("energy", recovered.equivalent_duration_s / duration),
            ("amplitude", recovered.amplitude / injected),
            ("half_width", recovered.half_width_s / place.half_width_s),
            ("temperature", recovered.temperature_k / injected_k),
            ("peak", (recovered.peak_s - place.peak_s) / place.half_width_s),
            ("covered", off <= recovered.equivalent_duration_error_s),
        ):
            kept[name][d][found] = values
    return kept


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
        """From the fits of all positions."""
        each = {name: np.concatenate([part[name] for part in parts], axis=2) for name in KEPT}
        found = np.isfinite(each["energy"]).sum(axis=2)
        none = found == 0

        def quantile(name: str, q: float) -> Float:
            filled = np.where(none[:, :, None], 0.0, each[name])
            return np.where(none, np.nan, np.nanquantile(filled, q, axis=2))

        peak = [quantile("peak", q) for q in (0.16, 0.5, 0.84)]
        return cls(
            fitted=found.astype(np.float64),
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
