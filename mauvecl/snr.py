"""Signal-to-noise distributions: what the device is asked, and the tables made of its answer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl import layout
from mauvecl.scene import Scene

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation

#: Bins of an element's S/N to its standard deviation: +-8 of these.
BINS_PER_SIGMA = 128.0
#: Percentages of the quantiles reported: the median and one, two and three sigma.
PERCENTAGES = (0.135, 2.5, 16.0, 50.0, 84.0, 97.5, 99.865)


def observers(x: Expectation, scene: Scene) -> NDArray[np.void]:
    """What an observer subtracts and assumes in each pixel, for the device.

    Returns
    -------
    ndarray of layout.OBSERVER, shape (n_padded,)
    """
    table = np.zeros(len(scene.pixels), layout.OBSERVER)
    table["variance"] = 1.0  # padding: 0 / 1
    real = table[: scene.n_pixel]
    real["net_offset"] = scene.n_draws * scene.base_dn[0] - x.n_frames * (x.bias_dn + x.dark_dn)
    real["gain"] = x.gain_dn_per_electron
    real["variance"] = x.n_frames * (x.read_noise_dn**2 + x.dark_variance_dn2)
    # The fewest whole DN to a bin that still reach +-8 sigma: sigma / 128 to sigma / 64.
    wanted = 16.0 * np.sqrt(x.variance_dn2) / layout.OBSERVER_BINS
    real["bin_shift"] = np.ceil(np.log2(np.maximum(wanted, 1.0)))
    return table


def elements(x: Expectation) -> NDArray[np.void]:
    """The resolution elements, each with bins around its closed-form S/N, scaled to its linearised spread.

    Returns
    -------
    ndarray of layout.ELEMENT, shape (n_element,)
    """
    first = np.searchsorted(x.element, np.arange(x.element_wavelength_nm.size))
    table = np.zeros(first.size, layout.ELEMENT)
    table["first"], table["end"] = first, np.append(first[1:], x.element.size)
    signal = x.per_element(x.signal_dn)
    shot = x.per_element(x.gain_dn_per_electron * x.signal_dn)
    noise = np.sqrt(shot + x.per_element(x.n_frames * (x.read_noise_dn**2 + x.dark_variance_dn2)))
    gain = np.divide(shot, signal, out=np.zeros_like(signal), where=signal > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = 1.0 / noise - signal * gain / (2.0 * noise**3)
        table["centre"] = np.nan_to_num(signal / noise)
        # A noiseless element has no S/N to speak of; its bins do not matter.
        table["bins_per_unit"] = np.nan_to_num(BINS_PER_SIGMA / (np.sqrt(x.per_element(x.variance_dn2)) * slope))
    return table


class Counts:
    """Histograms of all pixels and elements, added up tile by tile.

    Attributes
    ----------
    pixel : ndarray of int64, shape (n_pixel, OBSERVER_BINS)
    element : ndarray of int64, shape (n_element, OBSERVER_BINS)
    clipped : ndarray of int64, shape (n_pixel, 2)
        Frames below zero and above saturation.
    n : int
        Realisations.
    """

    def __init__(self, n_pixel: int, n_element: int) -> None:
        self.pixel = np.zeros((n_pixel, layout.OBSERVER_BINS), np.int64)
        self.element = np.zeros((n_element, layout.OBSERVER_BINS), np.int64)
        self.clipped = np.zeros((n_pixel, 2), np.int64)
        self.n = 0

    def add(
        self, pixel: NDArray[np.integer], element: NDArray[np.integer], clipped: NDArray[np.integer], n: int
    ) -> None:
        """Add what one or more tiles counted."""
        self.pixel += pixel
        self.element += element
        self.clipped += clipped
        self.n += n


@dataclass(frozen=True, eq=False)
class SnrResult:
    """Distributions of the S/N over realisations.

    Attributes
    ----------
    expectation : Expectation
    scene : Scene
    observers : ndarray of layout.OBSERVER, shape (n_padded,)
    elements : ndarray of layout.ELEMENT, shape (n_element,)
    counts : Counts
    """

    expectation: Expectation
    scene: Scene
    observers: NDArray[np.void]
    elements: NDArray[np.void]
    counts: Counts

    @property
    def pixel(self) -> QTable:
        """S/N per pixel: wavelength, closed form, simulated mean, standard deviation, quantiles, clipped frames.

        The histogram is of whole DN, of which the S/N is a function; its bins are 1/64 of a standard deviation or less.
        """
        x, seen = self.expectation, self.observers[: self.scene.n_pixel]
        width = 2.0 ** seen["bin_shift"].astype(float)
        steps = np.arange(layout.OBSERVER_BINS + 1) - layout.OBSERVER_BINS // 2

        def snr(dn: NDArray[np.float64]) -> NDArray[np.float64]:
            net = dn + seen["net_offset"].astype(float)[:, None]
            noise2 = np.maximum(net, 0.0) * seen["gain"][:, None] + seen["variance"][:, None]
            return np.asarray(np.divide(net, np.sqrt(noise2), out=np.zeros_like(net), where=noise2 > 0))

        # A bin holds the whole DN from its lower edge to one below the next.
        centres, edges = snr(width[:, None] * (steps[:-1] + 0.5) - 0.5), snr(width[:, None] * steps - 0.5)
        table = self._table(x.wavelength_nm, x.snr(), self.counts.pixel, centres, edges)
        frames = self.counts.n * x.n_frames
        for name, column in (("clipped_low", 0), ("clipped_high", 1)):
            table[name] = self.counts.clipped[:, column] / frames
            table[name].info.description = "share of frames cut off at this end: zero or saturation"
        return table

    @property
    def element(self) -> QTable:
        """The same per resolution element of 10.5 nm, without the clipped frames."""
        x = self.expectation
        step = np.divide(
            1.0,
            self.elements["bins_per_unit"],
            out=np.zeros(len(self.elements)),
            where=self.elements["bins_per_unit"] > 0,
        )
        steps = np.arange(layout.OBSERVER_BINS + 1) - layout.OBSERVER_BINS // 2
        centres = self.elements["centre"][:, None] + step[:, None] * steps[:-1]
        edges = self.elements["centre"][:, None] + step[:, None] * (steps - 0.5)
        return self._table(x.element_wavelength_nm, x.snr_per_element(), self.counts.element, centres, edges)

    def plot(self, path: str | Path | None = None) -> object:
        """S/N per pixel and element, closed form and realisations; needs matplotlib."""
        from mauvecl.pictures.answers import signal_to_noise

        return signal_to_noise([(self.expectation.name, self)], path)

    def _table(
        self,
        wavelength_nm: NDArray[np.float64],
        expected: NDArray[np.float64],
        counts: NDArray[np.int64],
        centres: NDArray[np.float64],
        edges: NDArray[np.float64],
    ) -> QTable:
        import astropy.units as u
        from astropy.table import QTable

        share = counts / self.counts.n
        mean = np.sum(share * centres, axis=1)
        table = QTable()
        table["wavelength"] = wavelength_nm * u.nm
        table["expected"] = expected
        table["mean"] = mean
        table["std"] = np.sqrt(np.sum(share * (centres - mean[:, None]) ** 2, axis=1))
        cumulative = np.concatenate([np.zeros((len(counts), 1)), np.cumsum(counts, axis=1)], axis=1) / self.counts.n
        quantiles = np.array([_quantiles(c, e) for c, e in zip(cumulative, edges, strict=True)])
        for i, percentage in enumerate(PERCENTAGES):
            table[f"q{percentage:g}"] = quantiles[:, i]
        table["expected"].info.description = "closed-form S/N of the mean spectrum"
        table["mean"].info.description = "mean S/N of the realisations"
        table["std"].info.description = "standard deviation of the S/N of the realisations"
        table.meta["realisations"] = self.counts.n
        table.meta["exposure_s"] = self.expectation.exposure_s
        table.meta["name"] = self.expectation.name
        return table


def _quantiles(cumulative: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quantiles of one histogram, linear within a bin."""
    filled = np.flatnonzero(np.diff(cumulative))
    span = slice(filled[0], filled[-1] + 2)
    return np.asarray(np.interp(np.array(PERCENTAGES) / 100, cumulative[span], edges[span]))
