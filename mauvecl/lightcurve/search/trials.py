"""How often the largest of a bank's values exceeds a threshold in noise, in closed form.

Templates lie on a grid: onsets of each half-width, half-widths beside each other, temperatures. An alarm is a local
maximum of that grid above the threshold, so that the rate of these bounds that of alarms from above, and nears it as
the threshold rises (Taylor, Worsley & Gosselin 2007, doi 10.1093/biomet/asm004):

    rate = sum over templates of integral_u^inf phi(z) product over axes of P(both neighbours < z | z) dz.

Given z, the neighbours along an axis are two normal variables of known correlations, whose joint probability is by
Owen's function (Owen 1956, doi 10.1214/aoms/1177728074). Those in half-width are taken at the onset where they resemble
the template most, so that they do not depend on those in time to first order; those in temperature do not at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.lightcurve.search.bank import Bank, Template

Float = NDArray[np.float64]

#: Nodes of the integral over z, in (z^2 - u^2) / 2.
NODES = 32
#: Threshold whose local maxima weigh templates.
WEIGHED_AT = 5.0
#: Largest correlation that is told from one.
ALIKE = 1 - 1e-12


@dataclass(frozen=True)
class Filter:
    """A template of unit length, its level taken out.

    Attributes
    ----------
    values : ndarray, shape (n,)
    first : int
        Frame of the first value, counted from the peak's.
    """

    values: Float
    first: int

    def moved(self, frames: int) -> Filter:
        """Later by so many frames."""
        return Filter(self.values, self.first + frames)

    def nearest(self, other: Filter) -> tuple[float, Filter]:
        """The largest correlation with another at any onset, and the other there."""
        every = np.correlate(self.values, other.values, "full")
        best = int(np.argmax(every))
        return float(every[best]), other.moved(self.first - other.first + best - other.values.size + 1)

    def __matmul__(self, other: Filter) -> float:
        low = max(self.first, other.first)
        high = min(self.first + self.values.size, other.first + other.values.size)
        return float(
            self.values[low - self.first : high - self.first] @ other.values[low - other.first : high - other.first]
        )


@dataclass(frozen=True)
class Trials:
    """The grid of a bank in white noise without gaps, each sum of a frame for itself.

    Attributes
    ----------
    frame_s : float
    per_frame : ndarray, shape (n_row,)
        Templates of each half-width and phase in a frame: the inverse of its stride.
    in_time, in_width : tuple of tuple, length n_row
        Correlations of each row's template with its neighbours, and theirs with each other: (before, after, mutual), or
        (one,) at the ends of the bank, or ().
    in_temperature : tuple of tuple, length n_temperature
        The same of each direction.
    """

    frame_s: float
    per_frame: Float
    in_time: tuple[tuple[float, ...], ...]
    in_width: tuple[tuple[float, ...], ...]
    in_temperature: tuple[tuple[float, ...], ...]

    @classmethod
    def of(cls, bank: Bank) -> Trials:
        """Of a bank."""
        rows = [
            [_filter(template, shape, bank.level.powers) for shape in template.shapes] for template in bank.templates
        ]
        per_frame, in_time, in_width = [], [], []
        for k, (template, filters) in enumerate(zip(bank.templates, rows, strict=True)):
            beside = rows[max(k - 1, 0) : k] + rows[k + 1 : k + 2]
            # Phases follow each other within a frame, then those of the next onset.
            onsets = [one.moved(n * template.stride) for n in (-1, 0, 1) for one in filters]
            for p, one in enumerate(filters, len(filters)):
                per_frame.append(1 / template.stride)
                in_time.append(_around(one, [onsets[p - 1], onsets[p + 1]]))
                near = [max((one.nearest(other) for other in row), key=lambda pair: pair[0])[1] for row in beside]
                in_width.append(_around(one, near))
        sums = [Filter(direction, 0) for direction in bank.directions]
        in_temperature = [_around(one, sums[max(k - 1, 0) : k] + sums[k + 1 : k + 2]) for k, one in enumerate(sums)]
        return cls(bank.frame_s, np.array(per_frame), tuple(in_time), tuple(in_width), tuple(in_temperature))

    def per_second(self, threshold: float) -> float:
        """False alarms a second of frames above a threshold, in standard deviations."""
        density, chances, warmer = self._chances(threshold)
        return float(self.per_frame @ chances @ (density * sum(warmer))) / self.frame_s

    def peaked(self, threshold: float) -> Float:
        """Return each template's chance to be a local maximum above a threshold, of one, (n_row, n_temperature)."""
        density, chances, warmer = self._chances(threshold)
        return np.asarray(np.einsum("z,rz,tz->rt", density / density.sum(), chances, warmer))

    def _chances(self, threshold: float) -> tuple[Float, Float, Float]:
        """Return the density at nodes z, and the chances there: of each row, and of each temperature, (n, n_node)."""
        x, weights = np.polynomial.laguerre.laggauss(NODES)
        z = np.sqrt(threshold**2 + 2 * x)
        density = weights / z * np.exp(-(threshold**2) / 2) / np.sqrt(2 * np.pi)
        chances = [_least(z, t) * _least(z, w) for t, w in zip(self.in_time, self.in_width, strict=True)]
        return density, np.array(chances), np.array([_least(z, one) for one in self.in_temperature])

    def per_frame_above(self, threshold: float) -> float:
        """Independent tests to a frame that would alarm as often."""
        return self.per_second(threshold) * self.frame_s / float(scipy.special.ndtr(-threshold))


def _filter(template: Template, shape: Float, powers: tuple[int, ...]) -> Filter:
    if powers:
        columns = np.stack([template.time**power for power in powers], axis=1)
        shape = shape - columns @ np.linalg.lstsq(columns, shape, rcond=None)[0]
    return Filter(shape / np.linalg.norm(shape), template.first)


def _around(one: Filter, near: list[Filter]) -> tuple[float, ...]:
    alike = [one @ other for other in near]
    return (*alike, near[0] @ near[1]) if len(near) == 2 else tuple(alike)


def _least(z: Float, correlations: tuple[float, ...]) -> Float:
    """P(the neighbours' values < z) where the value itself is z, shape of z."""
    if not correlations:
        return np.ones_like(z)
    # A neighbour of correlation r is normal about r z, of variance 1 - r^2.
    correlations = tuple(float(np.clip(r, -ALIKE, ALIKE)) for r in correlations)
    limits = [z * np.sqrt((1 - r) / (1 + r)) for r in correlations[:2]]
    one = scipy.special.ndtr(limits[0])
    if len(correlations) == 1:
        return np.asarray(one)
    a, b, mutual = correlations
    left = np.sqrt((1 - a * a) * (1 - b * b))
    r = np.clip((mutual - a * b) / left, -ALIKE, ALIKE)
    rest = np.sqrt(1 - r * r)
    h, k = limits
    owen = scipy.special.owens_t
    return np.asarray((one + scipy.special.ndtr(k)) / 2 - owen(h, (k / h - r) / rest) - owen(k, (h / k - r) / rest))
