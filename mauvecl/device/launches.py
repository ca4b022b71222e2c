"""Buffers and kernel launches of a scene."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.counts import Grid, Tally
from mauvecl.detection.snr import Counts
from mauvecl.device.device import Device
from mauvecl.device.errors import DeviceError
from mauvecl.device.program import out_of_memory
from mauvecl.device.tiles import Tile
from mauvecl.noise import layout
from mauvecl.noise.scene import PIXEL_BLOCK, Scene

if TYPE_CHECKING:
    from mauvecl.device.program import Variant

#: Realisations times frames counted on the device before its 32-bit bins and 64-bit sums are moved to the host.
MAX_COUNTED = 2**25
#: Raw spectra processed at once on the host.
RAW_BATCH = 4096
#: Kernel files of a detection: for comparisons with more than the expectation, and for the expectation alone.
COMPARED, DETECTION = ("sums", "comparison", "tally", "marginal"), ("sums", "statistics", "tally", "marginal")
#: Work-items per element or channel of a histogram on a GPU.
ITEMS = 1024


class Launches:
    """Buffers and launches of a scene; the buffers are released at the end of the `with` block."""

    def __init__(self, device: Device, scene: Scene, variant: Variant, seed: int) -> None:
        self._device, self._scene, self.variant = device, scene, variant
        self._cl, self._queue = device.cl, device.queue
        self._buffers: list[Any] = []
        self._named: dict[str, Any] = {}
        self._kernels: dict[str, Any] = {}
        self._counted = 0
        self._subtractions: list[Any] = []
        job = scene.job.copy()
        job["seed_low"], job["seed_high"] = seed & 0xFFFFFFFF, seed >> 32
        self._arguments = [
            self.upload(job.reshape(1)),
            *(
                self.upload(padded(array))
                for array in (
                    scene.pixels,
                    scene.levels,
                    scene.edges,
                    scene.dark_counts,
                    scene.photon_counts,
                    scene.responses,
                )
            ),
            self.upload(scene.tables),
            self.upload(scene.priors),
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.finish()
        for buffer in self._buffers:
            buffer.release()

    def upload(self, array: NDArray[Any]) -> Any:
        """Copy an array to a new device buffer. Raises DeviceError if the memory does not suffice."""
        flags = self._cl.mem_flags
        data = np.ascontiguousarray(array if array.size else np.zeros(1, array.dtype))
        try:
            buffer = self._cl.Buffer(self._device.context, flags.READ_WRITE | flags.COPY_HOST_PTR, hostbuf=data)
        except self._cl.Error as error:
            if not out_of_memory(error):
                raise
            raise DeviceError(
                f"{self._device.name} has too little memory for {data.nbytes} bytes of a scene: {error}", "memory"
            ) from error
        self._buffers.append(buffer)
        return buffer

    def _scratch(self, name: str, size: int) -> Any:
        """Return a buffer of at least `size` bytes that is reused from launch to launch."""
        buffer = self._named.get(name)
        if buffer is None or buffer.size < size:
            if buffer is not None:
                self._buffers.remove(buffer)
                buffer.release()
            buffer = self._cl.Buffer(self._device.context, self._cl.mem_flags.READ_WRITE, size)
            self._named[name] = buffer
            self._buffers.append(buffer)
        return buffer

    @contextlib.contextmanager
    def _output(self, name: str, out: NDArray[Any]) -> Iterator[Any]:
        """Yield a buffer whose contents are in `out` at the end of the block; CPUs write to `out` without a copy."""
        if self._device.record.kind != "cpu":
            buffer = self._scratch(name, out.nbytes)
            yield buffer
            self._cl.enqueue_copy(self._queue, out, buffer)
            return
        flags = self._cl.mem_flags
        buffer = self._cl.Buffer(self._device.context, flags.WRITE_ONLY | flags.USE_HOST_PTR, hostbuf=out)
        try:
            yield buffer
            mapped, _ = self._cl.enqueue_map_buffer(
                self._queue, buffer, self._cl.map_flags.READ, 0, out.shape, out.dtype
            )
            mapped.base.release(self._queue)
            self._queue.finish()
        finally:
            buffer.release()

    def _launch(self, name: str, items: tuple[int, ...], *arguments: Any) -> None:
        if name not in self._kernels:
            # Kernels that are always used together are built together.
            detection = COMPARED if self.variant.compared else DETECTION
            kernel_files = detection if name in (detection[1], "tally", "marginalise") else (name,)
            self._kernels[name] = self._device.kernel(kernel_files, self.variant, name)
        local = (1,) * len(items) if self.variant.width > 1 else None
        self._kernels[name](self._queue, items, local, *arguments)

    def realise(self, tile: Tile, out: NDArray[Any]) -> NDArray[np.uint32]:
        """Draw the raw spectra of a tile into `out`.

        Parameters
        ----------
        out : ndarray of uint16 or int32, shape (tile.wanted, n_pixel)

        Returns
        -------
        ndarray of uint32, shape (tile.wanted,)
            Number of samples (pixels times frames) clipped at zero or saturation.
        """
        clipped = np.empty(tile.wanted, np.uint32)
        counts, items = self._scratch("clipped", clipped.nbytes), (tile.size // self.variant.width,)
        with self._output("rows", out) as rows:
            self._launch("realise", items, *self._arguments, *tile.address(), *tile.rows(), counts, rows)
        self._cl.enqueue_copy(self._queue, clipped, counts)
        return clipped

    def observe(self, observers: NDArray[np.void], elements: NDArray[np.void]) -> None:
        """Upload the observer's subtraction and variances, and the resolution elements."""
        self._n_element = len(elements)
        self._observers, self._elements = self.upload(padded(observers)), self.upload(elements)
        shape = (self._scene.n_pixel + PIXEL_BLOCK, layout.OBSERVER_BINS)
        self._pixel_counts = self.upload(np.zeros(shape, np.uint32))
        self._element_counts = self.upload(np.zeros((len(elements), layout.OBSERVER_BINS), np.uint32))
        self._clipped = self.upload(np.zeros((shape[0], 2), np.uint32))
        self._outside = self.upload(np.zeros(len(elements), np.uint32))
        self._observed = observers, elements

    def histogram(self, tile: Tile, counts: Counts) -> None:
        """Add each pixel's DN and each element's S/N of a tile to the device's histograms."""
        width = self.variant.width
        items = (self._n_element,) if width > 1 else (self._n_element, min(tile.wanted, ITEMS))
        self._launch(
            "histogram",
            items,
            *self._arguments,
            *tile.address(),
            *tile.rows(),
            self._observers,
            self._elements,
            self._pixel_counts,
            self._element_counts,
            self._clipped,
            self._outside,
        )
        self._queue.finish()
        self._counted += tile.wanted
        outside = np.empty(self._n_element, np.uint32)
        self._cl.enqueue_copy(self._queue, outside, self._outside)
        if outside.any():
            self._cl.enqueue_copy(self._queue, self._outside, np.zeros_like(outside))
            self._add_far_snr(tile, counts, np.flatnonzero(outside))
        if self._counted * self._scene.n_draws > MAX_COUNTED:
            self.flush_counts(counts)

    def _add_far_snr(self, tile: Tile, counts: Counts, elements: NDArray[np.intp]) -> None:
        """Count values outside the device's bins on the host, from the raw spectra of the same realisations."""
        for piece in tile.pieces(RAW_BATCH):
            raw = np.empty((piece.wanted, self._scene.n_pixel), np.int32)
            self.realise(piece, raw)
            base = self._scene.n_draws * self._scene.base_dn[0]
            counts.add_far(np.ascontiguousarray(raw.T) - base[:, None], *self._observed, elements)

    def flush_counts(self, counts: Counts) -> None:
        """Move the device's histograms to the host."""
        n = self._scene.n_pixel
        pixels, elements, clipped = (
            self._take(buffer, shape)
            for buffer, shape in (
                (self._pixel_counts, (n, layout.OBSERVER_BINS)),
                (self._element_counts, (self._n_element, layout.OBSERVER_BINS)),
                (self._clipped, (n, 2)),
            )
        )
        counts.add(pixels, elements, clipped, self._counted)
        self._counted = 0

    def _take(self, buffer: Any, shape: tuple[int, ...], dtype: type = np.uint32) -> NDArray[Any]:
        """Copy a buffer to the host and fill it with zeros."""
        host: NDArray[Any] = np.empty(shape, dtype)
        self._cl.enqueue_copy(self._queue, host, buffer)
        self._cl.enqueue_copy(self._queue, buffer, np.zeros(shape, dtype))
        return host

    def weigh(
        self, weights: NDArray[np.float32], linear_end: NDArray[np.uint32], pixels_end: NDArray[np.uint32]
    ) -> None:
        """Upload the linear statistics' weights and the end of each scenario's; see `ChannelPlan`."""
        scene = self._scene
        # A final row of zeros serves scenarios without linear statistics.
        behind = np.concatenate([weights, np.zeros((1, len(scene.pixels)), np.float32)])
        constants = scene.constants(weights, linear_end, pixels_end)
        self._weighing = [*map(self.upload, (constants, behind, linear_end, pixels_end))]
        self._rows = len(layout.FIXED_STATISTICS) * len(scene.levels) + len(weights)

    def marginalise(self, subtractions: NDArray[np.uint32]) -> None:
        """Upload which squares are subtracted from which rows; see `ChannelPlan`."""
        self._subtractions = [np.uint32(subtractions.shape[1]), *map(self.upload, subtractions)]

    def compare(
        self,
        bands: NDArray[np.float32],
        finished: NDArray[np.uint32],
        scales: NDArray[np.float32],
        scale_end: NDArray[np.uint32],
    ) -> None:
        """Upload the additional arguments of the kernel `comparison`; call after `weigh`.

        Parameters
        ----------
        bands : ndarray of float32, shape (n_chunk, n_slot, chunk)
        finished : ndarray of uint32, shape (n_chunk,)
            See `smoothing.Smoothing.bands`.
        scales : ndarray of float32, shape (n_smoothed, n_centre)
        scale_end : ndarray of uint32, shape (n_scenario,)
            One past the last smoothed statistic of each scenario.
        """
        scene = self._scene
        more = map(self.upload, (padded(scene.estimates), bands, finished, scales, scale_end))
        self._weighing = [self.upload(scene.references), *self._weighing, *more, np.uint32(scales.shape[1])]
        self._rows += len(scales)

    def statistics(self, tile: Tile) -> None:
        """Compute every channel of a tile on the device."""
        values = self._scratch("values", 4 * self._rows * tile.size)
        kernel = (COMPARED if self.variant.compared else DETECTION)[1]
        items = (tile.size // (self.variant.width * self.variant.vectors),)
        self._launch(kernel, items, *self._arguments, *tile.address(), *self._weighing, np.uint32(tile.size), values)
        if self._subtractions:
            items = (tile.size // self.variant.width,)
            self._launch("marginalise", items, *self._subtractions, np.uint32(tile.size), values)

    def values(self, tile: Tile) -> NDArray[np.float32]:
        """Return the channels of the last computed tile, shape (n_channel, tile.wanted)."""
        host = np.empty((self._rows, tile.size), np.float32)
        self._cl.enqueue_copy(self._queue, host, self._named["values"])
        return host[:, tile.start : tile.stop]

    def channel(self, tile: Tile, number: int) -> NDArray[np.float32]:
        """Return one channel of the last computed tile, shape (tile.wanted,)."""
        host = np.empty(tile.wanted, np.float32)
        offset = 4 * (number * tile.size + tile.start)
        self._cl.enqueue_copy(self._queue, host, self._named["values"], src_offset=offset)
        return host

    def tally(self, tile: Tile, tally: Tally) -> None:
        """Add the channels of a tile to the histograms and integer sums on the device."""
        count = len(tally.grids)
        items = 1 if self.variant.width > 1 else ITEMS
        if "grids" not in self._named:
            self._named["grids"] = self.upload(Grid.pack(tally.grids))
            self._named["histogram"] = self.upload(np.zeros((count, layout.BINS), np.uint32))
            self._named["sums"] = self.upload(np.zeros((count, items, 2), np.int64))
            self._named["outside"] = self.upload(np.zeros(count, np.uint32))
        named = self._named
        self._launch(
            "tally",
            (count,) if items == 1 else (count, items),
            *tile.rows(),
            np.uint32(tile.size),
            named["values"],
            named["grids"],
            named["histogram"],
            named["sums"],
            named["outside"],
        )
        self._queue.finish()
        self._counted += tile.wanted
        self._add_far(tile, tally)
        if self._counted > MAX_COUNTED:
            self.flush(tally)

    def _add_far(self, tile: Tile, tally: Tally) -> None:
        """Count values outside the device's bins on the host."""
        outside = np.empty(len(tally.grids), np.uint32)
        self._cl.enqueue_copy(self._queue, outside, self._named["outside"])
        if not outside.any():
            return
        self._cl.enqueue_copy(self._queue, self._named["outside"], np.zeros_like(outside))
        for index in np.flatnonzero(outside):
            outlying = tally.add_far(int(index), self.channel(tile, tally.grids[index].channel))
            if outlying != outside[index]:
                raise DeviceError(
                    f"{self._device.name} has {outside[index]} values outside a histogram where the host has "
                    f"{outlying}, expected the same arithmetic"
                )

    def flush(self, tally: Tally) -> None:
        """Move the device's histograms and sums to the host."""
        count = len(tally.grids)
        histogram = self._take(self._named["histogram"], (count, layout.BINS))
        sums = self._take(self._named["sums"], (count, self._named["sums"].size // (16 * count), 2), np.int64)
        tally.add(histogram, sums.sum(axis=1), self._counted)
        self._counted = 0


def padded(array: NDArray[np.void]) -> NDArray[np.void]:
    """Flatten per-pixel structs and append a block, since kernels may read, but not use, pixels past the last one."""
    return np.concatenate([array.ravel(), np.zeros(PIXEL_BLOCK, array.dtype)])
