"""Distributions of the S/N of pixels and resolution elements over realisations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.counts import RowCounts, steps_of
from mauvecl.detection.requests import SnrRequest
from mauvecl.host.arrays import Arrays, ContentEquality, Float
from mauvecl.noise import layout
from mauvecl.noise.reference import Floats, fma
from mauvecl.noise.scene import Scene
from mauvecl.schema.columns import Column, Drawable, table_of
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.exposure.expectation import Expectation

#: Bins per standard deviation of an element's S/N, which cover +-8 standard deviations.
BINS_PER_SIGMA = 128.0
#: Percentages of the reported quantiles: the median and one, two and three sigma.
PERCENTAGES = (0.135, 2.5, 16.0, 50.0, 84.0, 97.5, 99.865)
COLUMNS = (
    Column("wavelength", unit="nm", description="vacuum wavelength, the middle of the pixel or element", heading="nm",
           format=".1f"),
    Column("expected", description="closed-form S/N of the mean spectrum", heading="closed form", format=".2f"),
    Column("mean", description="mean S/N of the realisations", heading="mean", format=".2f"),
    Column("std", description="standard deviation of the S/N of the realisations", heading="std", format=".2f"),
    *(
        Column(f"q{percentage:g}", description=f"{percentage:g} % quantile of the realisations",
               heading=f"{percentage:g} %" if percentage in (2.5, 50.0, 97.5) else "", format=".2f")
        for percentage in PERCENTAGES
    ),
)  # fmt: skip
#: Columns that the table of pixels has as well.
CLIPPED_COLUMNS = tuple(
    Column(f"clipped_{end}", description="share of frames cut off at this end: zero or saturation")
    for end in ("low", "high")
)


def observers(x: Expectation, scene: Scene) -> NDArray[np.void]:
    """Return the `layout.OBSERVER` structures: subtracted bias and dark, and noise model, shape (n_padded,).

    The sky is subtracted per resolution element.
    """
    table = np.zeros(len(scene.pixels), layout.OBSERVER)
    table["variance"] = 1.0  # padding: 0 / 1
    real = table[: scene.n_pixel]
    real["net_offset"] = scene.n_draws * scene.base_dn[0] - x.n_frames * (x.bias_dn + x.dark_dn)
    real["gain"] = x.gain_dn_per_electron
    real["variance"] = x.n_frames * (x.read_noise_dn**2 + x.dark_variance_dn2)
    # The narrowest bins of whole DN that cover +-8 sigma: sigma / 128 to sigma / 64.
    width = 16.0 * np.sqrt(x.variance_dn2) / layout.OBSERVER_BINS
    real["bin_shift"] = np.ceil(np.log2(np.maximum(width, 1.0)))
    return table


def elements(x: Expectation) -> NDArray[np.void]:
    """Return the `layout.ELEMENT` structures of the resolution elements, shape (n_element,).

    Bins are centred on the closed-form S/N and scaled to its linearised spread.
    """
    first = np.searchsorted(x.element, np.arange(x.element_wavelength_nm.size))
    table = np.zeros(first.size, layout.ELEMENT)
    table["first"], table["end"] = first, np.append(first[1:], x.element.size)
    table["sky"] = x.per_element(x.subtracted_dn)
    signal, light = x.per_element(x.signal_dn), x.per_element(x.recorded_light_dn)
    shot = x.per_element(x.gain_dn_per_electron * x.recorded_light_dn)
    noise = np.sqrt(shot + x.per_element(x.n_frames * (x.read_noise_dn**2 + x.dark_variance_dn2)))
    gain = np.divide(shot, light, out=np.zeros_like(light), where=light > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = 1.0 / noise - signal * gain / (2.0 * noise**3)
        table["centre"] = np.nan_to_num(signal / noise)
        # The bins of a noiseless element do not matter.
        table["bins_per_unit"] = np.nan_to_num(BINS_PER_SIGMA / (np.sqrt(x.per_element(x.variance_dn2)) * slope))
    return table


#: Limit of the absolute value of bin numbers, of which 0 contains the expected value.
MAX_BIN = 2**31
#: First and last bin of the device's histograms, whose first and last columns only mark values outside.
FIRST_BIN, LAST_BIN = 1 - layout.OBSERVER_BINS // 2, layout.OBSERVER_BINS // 2 - 2


class Counts:
    """Accumulator of the histograms of all pixels and elements."""

    def __init__(self, n_pixel: int, n_element: int) -> None:
        self.shapes = {"pixel": (n_pixel, layout.OBSERVER_BINS), "element": (n_element, layout.OBSERVER_BINS)}
        # Filled bins of each pixel or element; bin 0 contains the expected value.
        self.bins = {"pixel": RowCounts(), "element": RowCounts()}
        # Frames clipped at zero and at saturation.
        self.clipped = np.zeros((n_pixel, 2), np.int64)
        self.n = 0

    def add(
        self, pixel: NDArray[np.integer], element: NDArray[np.integer], clipped: NDArray[np.integer], n: int
    ) -> None:
        """Add the device's histograms of one or more tiles."""
        for kind, dense in (("pixel", pixel), ("element", element)):
            row, column = np.nonzero(dense[:, 1:-1])
            self.bins[kind].add(row, FIRST_BIN + column, dense[row, 1 + column])
        self.clipped += clipped
        self.n += n

    def add_far(
        self, dn: NDArray[np.integer], observers: NDArray[np.void], elements: NDArray[np.void], rows: NDArray[np.intp]
    ) -> None:
        """Count the values outside the dense bins of some elements and their pixels.

        `dn`, shape (n_pixel, n), holds raw DN minus the scene's base, and `rows` the indices of the elements.
        """
        for e in rows:
            element = elements[e]
            first, end = int(element["first"]), int(element["end"])
            for p in range(first, end):
                self._count_far("pixel", p, dn[p].astype(np.int64) >> int(observers[p]["bin_shift"]))
            ratio = signal_to_noise(dn[first:end], observers[first:end], element["sky"])
            steps = np.rint((ratio - element["centre"]) * element["bins_per_unit"])
            if not (np.abs(steps) < MAX_BIN).all():
                raise InputError(
                    f"the S/N of resolution element {e} is {ratio[np.abs(steps).argmax()]:g} in a realisation, but "
                    f"must be nearer to its closed form of {element['centre']:g}",
                    key="expectation",
                )
            self._count_far("element", e, steps.astype(np.int64))

    def _count_far(self, kind: str, row: int, bins: NDArray[np.int64]) -> None:
        self.bins[kind].count(row, bins[(bins < FIRST_BIN) | (bins > LAST_BIN)])

    def dense(self, kind: str) -> NDArray[np.int64]:
        """Return the histograms in the device's columns, without values beyond, shape (n, OBSERVER_BINS)."""
        dense, inner = np.zeros(self.shapes[kind], np.int64), self.within(kind)
        rows, bins, counts = (values[inner] for values in self.bins[kind].rows())
        dense[rows, bins - FIRST_BIN + 1] = counts
        return dense

    def within(self, kind: str) -> NDArray[np.bool_]:
        """Return the mask of the filled bins that are among the device's."""
        _, bins, _ = self.bins[kind].rows()
        return (bins >= FIRST_BIN) & (bins <= LAST_BIN)

    def pack(self) -> Arrays:
        """Return the counts as arrays."""
        packed = self.bins["pixel"].pack("pixel") | self.bins["element"].pack("element")
        return packed | {"clipped": self.clipped, "n": np.array(self.n)}

    def merge(self, packed: Arrays) -> None:
        """Add packed counts of other realisations."""
        for kind, bins in self.bins.items():
            bins.merge(kind, packed)
        self.clipped += packed["clipped"]
        self.n += int(packed["n"])


def signal_to_noise(dn: NDArray[np.integer], observers: NDArray[np.void], sky: np.float32) -> Floats:
    """Compute an element's S/N in the device's order, shape (n,), from DN above the base, shape (n_pixel, n)."""
    signal, variance = (np.zeros(dn.shape[1], np.float32) for _ in range(2))
    for n, observer in zip(dn, observers, strict=True):
        net = n.astype(np.float32) + observer["net_offset"]
        signal = signal + net
        variance = variance + fma(np.maximum(net, np.float32(0.0)), observer["gain"], observer["variance"])
    signal = signal - sky
    # The ratio is zero if the estimated noise is zero.
    return np.divide(signal, np.sqrt(variance), out=np.zeros_like(signal), where=variance > 0)


@dataclass(frozen=True, eq=False)
class SnrResult(Drawable, ContentEquality):
    """Distributions of the S/N over realisations."""

    expectation: Expectation
    scene: Scene
    counts: Counts

    @cached_property
    def observers(self) -> NDArray[np.void]:
        """Structures of `observers`."""
        return observers(self.expectation, self.scene)

    @cached_property
    def pixel(self) -> QTable:
        """S/N per pixel: wavelength, closed form, simulated mean, standard deviation, quantiles, clipped frames.

        The histogram counts whole DN, of which the S/N is a function, in bins of at most 1/64 of a standard deviation.
        """
        x, table = self.expectation, self.observers[: self.scene.n_pixel]
        width, offset, sky = 2.0 ** table["bin_shift"].astype(float), table["net_offset"].astype(float), x.subtracted_dn

        def snr(row: int, bin_number: NDArray[np.number]) -> Float:
            # A bin contains the whole DN from its lower edge up to the next.
            dn = width[row] * bin_number - 0.5
            net = dn + offset[row]
            noise2 = np.maximum(net, 0.0) * table["gain"][row] + table["variance"][row]
            return np.asarray(np.divide(net - sky[row], np.sqrt(noise2), out=np.zeros_like(net), where=noise2 > 0))

        low, high = self.counts.clipped.T / (self.counts.n * x.n_frames)
        return self._table("pixel", x.wavelength_nm, x.snr(), snr, clipped_low=low, clipped_high=high)

    @cached_property
    def element(self) -> QTable:
        """S/N per resolution element, with the columns of `pixel` except clipped frames."""
        x, table = self.expectation, elements(self.expectation)
        step = np.divide(1.0, table["bins_per_unit"], out=np.zeros(len(table)), where=table["bins_per_unit"] > 0)

        def snr(row: int, bin_number: NDArray[np.number]) -> Float:
            return np.asarray(table["centre"][row] + step[row] * (bin_number - 0.5))

        return self._table("element", x.element_wavelength_nm, x.snr_per_element(), snr)

    def _line(self) -> str:
        return f"of {self.expectation.name!r}, {self.counts.n} realisations"

    def _table(
        self, kind: str, wavelength_nm: Float, expected: Float, snr: Callable[[int, NDArray[np.number]], Float],
        **clipped: Float,
    ) -> QTable:  # fmt: skip
        """Return the table of pixels or elements; `snr` converts fractional bin numbers to ratios."""
        rows = []
        for row in range(len(expected)):
            filled, counts = self.counts.bins[kind].in_row(row)
            middle = snr(row, filled + 0.5)
            mean = counts @ middle / self.counts.n
            edges = np.column_stack([snr(row, filled), snr(row, filled + 1)]).ravel()
            quantiles = np.interp(np.array(PERCENTAGES) / 100, steps_of(counts) / self.counts.n, edges)
            rows.append((mean, np.sqrt(counts @ (middle - mean) ** 2 / self.counts.n), *quantiles))
        arrays = np.column_stack([wavelength_nm, expected, np.array(rows)]).T
        values = dict(zip((column.name for column in COLUMNS), arrays, strict=True)) | clipped
        columns = (*COLUMNS, *CLIPPED_COLUMNS) if clipped else COLUMNS
        x = self.expectation
        metadata = {"exposure_s": x.exposure_s, "name": x.name, "signal": x.signal}
        return table_of(columns, [values], realisations=self.counts.n, **metadata)


def counts_of(request: SnrRequest) -> Counts:
    """Return the empty histograms of a request."""
    return Counts(request.scene.n_pixel, request.expectation.element_wavelength_nm.size)
