"""Closed-form false-alarm rate of a template bank in white noise.

The templates of a bank form a grid over onset, half-width and temperature. An alarm is a local maximum of the statistic
on that grid, so the rate of local maxima above a threshold bounds the rate of alarms from above and approaches it for
high thresholds (Taylor, Worsley & Gosselin 2007, doi 10.1093/biomet/asm004):

    rate(u) = sum over templates of  integral_u^inf phi(z) * prod over axes of P(both neighbours < z | z) dz

Given z, the two neighbours along an axis are jointly normal with known correlations, and their joint probability
follows from Owen's T function (Owen 1956, doi 10.1214/aoms/1177728074). Neighbours in half-width are compared at the
onset of maximum correlation, which makes them independent of neighbours in onset to first order; neighbours in
temperature are independent of both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.lightcurve.search.bank import Bank, Template

Float = NDArray[np.float64]

#: Gauss-Laguerre nodes for the integral over z, in the variable (z^2 - u^2) / 2.
N_NODES = 32
#: Threshold at which `TemplateGrid.peak_probabilities` weights templates.
WEIGHTING_THRESHOLD = 5.0
#: Correlations are clipped here to keep 1 - r^2 positive.
MAX_CORRELATION = 1 - 1e-12


@dataclass(frozen=True)
class UnitFilter:
    """A detrended template, normalised to unit length."""

    values: Float  # shape (n,)
    first_frame: int  # frame of values[0] relative to the peak

    def shifted(self, n_frames: int) -> UnitFilter:
        """Return the filter delayed by `n_frames`."""
        return UnitFilter(self.values, self.first_frame + n_frames)

    def correlation(self, other: UnitFilter) -> float:
        """Return the correlation with another filter at their present positions."""
        first = max(self.first_frame, other.first_frame)
        end = min(self.first_frame + self.values.size, other.first_frame + other.values.size)
        return float(
            self.values[first - self.first_frame : end - self.first_frame]
            @ other.values[first - other.first_frame : end - other.first_frame]
        )

    def best_alignment(self, other: UnitFilter) -> tuple[float, UnitFilter]:
        """Return the largest correlation over all shifts of `other`, and `other` at that shift."""
        correlations = np.correlate(self.values, other.values, "full")
        best = int(np.argmax(correlations))
        shift = self.first_frame - other.first_frame + best - other.values.size + 1
        return float(correlations[best]), other.shifted(shift)


@dataclass(frozen=True)
class TemplateGrid:
    """Correlations between neighbouring templates of a bank.

    Each correlation tuple is ``(previous, next, between them)``, ``(only,)`` at the edge of the bank, or ``()`` if the
    template has no neighbour along that axis.
    """

    frame_s: float
    templates_per_frame: Float  # shape (n_row,); one row per half-width and sub-frame phase
    onset_correlations: tuple[tuple[float, ...], ...]  # one per row
    width_correlations: tuple[tuple[float, ...], ...]  # one per row
    temperature_correlations: tuple[tuple[float, ...], ...]  # one per temperature

    @classmethod
    def from_bank(cls, bank: Bank) -> TemplateGrid:
        """Compute the correlations between all neighbouring templates of a bank."""
        rows = [
            [_detrended(template, shape, bank.baseline.powers) for shape in template.shapes]
            for template in bank.templates
        ]
        per_frame, onset, width = [], [], []
        for k, (template, filters) in enumerate(zip(bank.templates, rows, strict=True)):
            adjacent_rows = rows[max(k - 1, 0) : k] + rows[k + 1 : k + 2]
            # The phases within a frame are followed by those of the next onset.
            onsets = [one.shifted(n * template.stride) for n in (-1, 0, 1) for one in filters]
            for p, one in enumerate(filters, len(filters)):
                per_frame.append(1 / template.stride)
                onset.append(_neighbour_correlations(one, [onsets[p - 1], onsets[p + 1]]))
                aligned = [
                    max((one.best_alignment(other) for other in row), key=lambda pair: pair[0])[1]
                    for row in adjacent_rows
                ]
                width.append(_neighbour_correlations(one, aligned))
        directions = [UnitFilter(direction, 0) for direction in bank.directions]
        temperature = [
            _neighbour_correlations(one, directions[max(k - 1, 0) : k] + directions[k + 1 : k + 2])
            for k, one in enumerate(directions)
        ]
        return cls(bank.frame_s, np.array(per_frame), tuple(onset), tuple(width), tuple(temperature))

    def false_alarms_per_second(self, threshold: float) -> float:
        """Return the rate of local maxima above `threshold`, in standard deviations of the statistic."""
        density, row_probabilities, temperature_probabilities = self._probabilities(threshold)
        rate = self.templates_per_frame @ row_probabilities @ (density * sum(temperature_probabilities))
        return float(rate) / self.frame_s

    def trials_per_frame(self, threshold: float) -> float:
        """Return the number of independent trials per frame with the same false-alarm rate."""
        rate = self.false_alarms_per_second(threshold)
        return rate * self.frame_s / float(scipy.special.ndtr(-threshold))

    def peak_probabilities(self, threshold: float) -> Float:
        """Return each template's probability that a value above `threshold` is a local maximum.

        The shape is (n_row, n_temperature).
        """
        density, row_probabilities, temperature_probabilities = self._probabilities(threshold)
        weights = density / density.sum()
        return np.asarray(np.einsum("z,rz,tz->rt", weights, row_probabilities, temperature_probabilities))

    def _probabilities(self, threshold: float) -> tuple[Float, Float, Float]:
        """Return the weighted density at nodes z, and the probabilities of rows and temperatures, (n, n_node)."""
        x, weights = np.polynomial.laguerre.laggauss(N_NODES)
        z = np.sqrt(threshold**2 + 2 * x)
        density = weights / z * np.exp(-(threshold**2) / 2) / np.sqrt(2 * np.pi)
        rows = [
            _probability_neighbours_below(z, onset) * _probability_neighbours_below(z, width)
            for onset, width in zip(self.onset_correlations, self.width_correlations, strict=True)
        ]
        temperatures = [_probability_neighbours_below(z, one) for one in self.temperature_correlations]
        return density, np.array(rows), np.array(temperatures)


def _detrended(template: Template, shape: Float, powers: tuple[int, ...]) -> UnitFilter:
    """Remove the fitted baseline polynomial from a template and normalise it."""
    if powers:
        columns = np.stack([template.time**power for power in powers], axis=1)
        shape = shape - columns @ np.linalg.lstsq(columns, shape, rcond=None)[0]
    return UnitFilter(shape / np.linalg.norm(shape), template.first)


def _neighbour_correlations(one: UnitFilter, neighbours: list[UnitFilter]) -> tuple[float, ...]:
    """Return the correlations with the neighbours and, if there are two, between them."""
    correlations = [one.correlation(other) for other in neighbours]
    if len(neighbours) == 2:
        correlations.append(neighbours[0].correlation(neighbours[1]))
    return tuple(correlations)


def _probability_neighbours_below(z: Float, correlations: tuple[float, ...]) -> Float:
    """Return P(all neighbours < z | z), shape of `z`."""
    if not correlations:
        return np.ones_like(z)
    # A neighbour with correlation r is normal with mean r z and variance 1 - r^2.
    correlations = tuple(float(np.clip(r, -MAX_CORRELATION, MAX_CORRELATION)) for r in correlations)
    limits = [z * np.sqrt((1 - r) / (1 + r)) for r in correlations[:2]]
    first = scipy.special.ndtr(limits[0])
    if len(correlations) == 1:
        return np.asarray(first)
    a, b, between = correlations
    scale = np.sqrt((1 - a * a) * (1 - b * b))
    r = np.clip((between - a * b) / scale, -MAX_CORRELATION, MAX_CORRELATION)
    root = np.sqrt(1 - r * r)
    h, k = limits
    owen = scipy.special.owens_t
    return np.asarray((first + scipy.special.ndtr(k)) / 2 - owen(h, (k / h - r) / root) - owen(k, (h / k - r) / root))
