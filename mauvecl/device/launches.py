"""Launches of kernels: variants, buffers, and tiles of realisations."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.chi2 import Paper
from mauvecl.detection.counts import Tally
from mauvecl.detection.requests import ChannelPlan
from mauvecl.detection.snr import Counts
from mauvecl.device.build import VECTORS, Device, Variant, out_of_memory
from mauvecl.device.drivers import DeviceError
from mauvecl.noise import layout
from mauvecl.noise.scene import BATCH, PIXEL_BLOCK, Scene

Progress = Callable[[int, int], None]

#: Device memory for the output of a tile. The size of tiles does not affect results.
TILE_BYTES = 64 * 2**20
LARGEST_TILE = 2**16


@dataclass(frozen=True)
class Tile:
    """Range of requested realisations that one launch computes, in whole vectors of `width` realisations."""

    begin: int  # first requested realisation
    count: int  # number of requested realisations
    width: int

    @property
    def start(self) -> int:
        """Number of realisations that are computed before the requested ones."""
        return self.begin % self.width

    @property
    def size(self) -> int:
        """Number of computed realisations."""
        return -(-(self.start + self.count) // self.width) * self.width

    def address(self) -> tuple[np.uint32, np.uint32]:
        """Return both words of the number of the first computed realisation."""
        first = self.begin - self.start
        return np.uint32(first & 0xFFFFFFFF), np.uint32(first >> 32)

    def rows(self) -> tuple[np.uint32, np.uint32]:
        """Return the requested range, relative to the first computed realisation."""
        return np.uint32(self.start), np.uint32(self.start + self.count)

    def pieces(self, size: int) -> Iterator[Tile]:
        """Yield tiles of at most `size` realisations, which are divided at the multiples of `size`."""
        end = self.begin + self.count
        for multiple in range(self.begin - self.begin % size, end, size):
            begin = max(multiple, self.begin)
            yield Tile(begin, min(multiple + size, end) - begin, self.width)


class Tiles:
    """Division of a device's work into tiles of at most `largest` realisations; progress as for `Engine`."""

    def __init__(self, device: Device, *, progress: Progress | None = None, largest: int | None = None) -> None:
        self._device, self._progress, self._largest, self._step = device, progress, largest, device.step

    def for_each(
        self, start: int, count: int, bytes_each: int, work: Callable[[Tile, int], None], *,
        before: int = 0, total: int | None = None,
    ) -> None:  # fmt: skip
        """Call `work(tile, done)` for each tile, with smaller tiles if the device's memory does not suffice.

        A realisation needs `bytes_each` on the device. `before` and `total` report the progress of several ranges: the
        realisations of earlier ones, and of all.
        """
        memory = min(TILE_BYTES, self._device.record.global_memory // 8)
        fit = memory // bytes_each if bytes_each else LARGEST_TILE
        fit = min(self._largest or LARGEST_TILE, LARGEST_TILE, max(fit, 1))
        size, done = max(1 << (fit.bit_length() - 1), self._step), 0
        report: Progress = self._progress or (lambda done, total: None)
        if not before:
            report(0, total or count)
        while done < count:
            tile = self.at(start + done, count - done, size)
            try:
                work(tile, done)
            except self._device.cl.Error as error:
                if not out_of_memory(error):
                    raise
                if size <= self._step:
                    raise DeviceError(
                        f"{self._device.record.label} has too little memory for {self._step} realisations of it: "
                        f"{error}",
                        "memory",
                    ) from error
                size //= 2
                continue
            done += tile.count
            report(before + done, total or count)

    def at(self, index: int, count: int, size: int) -> Tile:
        """Return the tile from `index` to a multiple of `size`, so that no tile crosses a multiple of 2**32."""
        return Tile(index, min(size - index % size, count), self._step)


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
        if os.getpid() != device.pid:
            # PoCL's threads do not survive a fork: its next call would wait forever.
            raise DeviceError("this Engine was made before a fork; make one in this process (use spawn)")
        self._device, self._scene, self.variant = device, scene, variant
        self._cl, self._queue = device.cl, device.queue
        self._buffers: list[Any] = []
        self._named: dict[str, Any] = {}
        # Buffers to which kernels add, and the zeros with which they begin.
        self._sums: dict[str, tuple[Any, NDArray[Any]]] = {}
        self._counted = 0
        self._subtractions: list[Any] = []
        job = scene.job.copy()
        job["seed_low"], job["seed_high"] = seed & 0xFFFFFFFF, seed >> 32
        per_pixel = (scene.pixels, scene.levels, scene.edges, scene.dark_counts, scene.photon_counts, scene.responses)
        self._arguments = [
            *map(self.upload, (job.reshape(1), *map(with_padding, per_pixel), scene.tables, scene.priors))
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
        data = contiguous(array)
        try:
            buffer = self._cl.Buffer(self._device.context, flags.READ_WRITE | flags.COPY_HOST_PTR, hostbuf=data)
        except self._cl.Error as error:
            if not out_of_memory(error):
                raise
            raise DeviceError(
                f"{self._device.record.label} has too little memory for {data.nbytes} bytes of a scene: {error}",
                "memory",
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
        """Yield a buffer whose contents are in `out` at the end of the block.

        CPUs write to `out` without a copy, which saves a third of the time of raw spectra.
        """
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
        # Kernels that are always used together are built together.
        detection = COMPARED if self.variant.compared else DETECTION
        kernel_files = detection if name in (detection[1], "tally", "marginalise") else (name,)
        local = (1,) * len(items) if self.variant.width > 1 else None
        self._device.kernel(kernel_files, self.variant, name)(self._queue, items, local, *arguments)

    def realise(self, tile: Tile, out: NDArray[Any]) -> NDArray[np.uint32]:
        """Draw the raw spectra of a tile into `out`, of uint16 or int32 and shape (tile.count, n_pixel).

        Return the number of samples (pixels times frames) clipped at zero or saturation, shape (tile.count,).
        """
        clipped = np.empty(tile.count, np.uint32)
        counts, items = self._scratch("clipped", clipped.nbytes), (tile.size // self.variant.width,)
        with self._output("rows", out) as rows:
            self._launch("realise", items, *self._arguments, *tile.address(), *tile.rows(), counts, rows)
        self._cl.enqueue_copy(self._queue, clipped, counts)
        return clipped

    def observe(self, observers: NDArray[np.void], elements: NDArray[np.void]) -> None:
        """Upload the observer's subtraction and variances, and the resolution elements."""
        n_pixel, n_element, bins = self._scene.n_pixel + PIXEL_BLOCK, len(elements), layout.OBSERVER_BINS
        self._observing = [self.upload(with_padding(observers)), self.upload(elements)]
        self._begin(pixels=(n_pixel, bins), elements=(n_element, bins), clipped=(n_pixel, 2), outside=(n_element,))
        self._observed = observers, elements

    def histogram(self, tile: Tile, counts: Counts) -> None:
        """Add each pixel's DN and each element's S/N of a tile to the device's histograms."""
        n_element = len(self._observed[1])
        items = (n_element,) if self.variant.width > 1 else (n_element, min(tile.count, ITEMS))
        sums = (buffer for buffer, _ in self._sums.values())
        self._launch("histogram", items, *self._arguments, *tile.address(), *tile.rows(), *self._observing, *sums)
        self._queue.finish()
        self._counted += tile.count
        outside = np.flatnonzero(self._take("outside"))
        # The host counts values outside the device's bins, from the raw spectra of the same realisations.
        for piece in tile.pieces(RAW_BATCH) if outside.size else ():
            raw = np.empty((piece.count, self._scene.n_pixel), np.int32)
            self.realise(piece, raw)
            base = self._scene.n_draws * self._scene.base_dn[0]
            counts.add_far(np.ascontiguousarray(raw.T) - base[:, None], *self._observed, outside)
        if self._counted * self._scene.n_draws > MAX_COUNTED:
            self.flush_counts(counts)

    def flush_counts(self, counts: Counts) -> None:
        """Move the device's histograms to the host."""
        n = self._scene.n_pixel
        counts.add(self._take("pixels")[:n], self._take("elements"), self._take("clipped")[:n], self._counted)
        self._counted = 0

    def _begin(self, dtype: type = np.uint32, **shapes: tuple[int, ...]) -> None:
        """Make buffers of zeros to which kernels add."""
        zeros: dict[str, NDArray[Any]] = {name: np.zeros(shape, dtype) for name, shape in shapes.items()}
        self._sums |= {name: (self.upload(array), array) for name, array in zeros.items()}

    def _take(self, name: str) -> NDArray[Any]:
        """Copy a buffer of sums to the host and fill it with zeros."""
        buffer, zeros = self._sums[name]
        host = np.empty_like(zeros)
        self._cl.enqueue_copy(self._queue, host, buffer)
        self._cl.enqueue_copy(self._queue, buffer, zeros)
        return host

    def weigh(self, plan: ChannelPlan, bands: NDArray[np.float32], finished: NDArray[np.uint32]) -> None:
        """Upload the weights and scales of all statistics, and which squares are subtracted from which rows.

        `bands`, shape (n_chunk, n_slot, chunk), and `finished`, shape (n_chunk,), are those of `Smoothing.bands`.
        """
        scene, self._rows = self._scene, plan.n_rows
        # A final row of zeros serves scenarios without linear statistics.
        weights = np.concatenate([plan.weights, np.zeros((1, len(scene.pixels)), np.float32)])
        constants = scene.constants(plan.weights, plan.linear_end, plan.pixels_end)
        self._weighing = [*map(self.upload, (constants, weights, plan.linear_end, plan.pixels_end))]
        if self.variant.compared:
            compared = map(self.upload, (with_padding(scene.estimates), bands, finished, plan.scales, plan.scale_end))
            # All scenarios are compared with the first.
            references = self.upload(np.zeros(len(scene.levels), np.uint32))
            self._weighing = [references, *self._weighing, *compared, np.uint32(plan.scales.shape[1])]
        if plan.subtractions.size:
            self._subtractions = [np.uint32(plan.subtractions.shape[1]), *map(self.upload, plan.subtractions)]

    def statistics(self, tile: Tile) -> None:
        """Compute every channel of a tile on the device."""
        values = self._scratch("values", 4 * self._rows * tile.size)
        kernel = (COMPARED if self.variant.compared else DETECTION)[1]
        items = (tile.size // (self.variant.width * self.variant.vectors),)
        self._launch(kernel, items, *self._arguments, *tile.address(), *self._weighing, np.uint32(tile.size), values)
        if self._subtractions:
            items = (tile.size // self.variant.width,)
            self._launch("marginalise", items, *self._subtractions, np.uint32(tile.size), values)

    def channel(self, tile: Tile, number: int) -> NDArray[np.float32]:
        """Return one channel of the last computed tile, shape (tile.count,)."""
        host = np.empty(tile.count, np.float32)
        offset = 4 * (number * tile.size + tile.start)
        self._cl.enqueue_copy(self._queue, host, self._named["values"], src_offset=offset)
        return host

    def tally(self, tile: Tile, tally: Tally) -> None:
        """Add the channels of a tile to the histograms and integer sums on the device."""
        count = len(tally.grids)
        items = 1 if self.variant.width > 1 else ITEMS
        if not self._sums:
            self._named["grids"] = self.upload(tally.grids)
            self._begin(histogram=(count, layout.BINS))
            self._begin(np.int64, sums=(count, items, 2))
            self._begin(outside=(count,))
        buffers = (self._named["values"], self._named["grids"], *(buffer for buffer, _ in self._sums.values()))
        self._launch("tally", (count,) if items == 1 else (count, items), *tile.rows(), np.uint32(tile.size), *buffers)
        self._queue.finish()
        self._counted += tile.count
        # The host counts values outside the device's bins.
        outside = self._take("outside")
        for index in np.flatnonzero(outside).tolist():
            outlying = tally.add_far(index, self.channel(tile, int(tally.grids["channel"][index])))
            if outlying != outside[index]:
                raise DeviceError(
                    f"{self._device.record.label} must have {outlying} values outside a histogram as the host, but has "
                    f"{outside[index]}"
                )
        if self._counted > MAX_COUNTED:
            self.flush(tally)

    def flush(self, tally: Tally) -> None:
        """Move the device's histograms and sums to the host."""
        tally.add(self._take("histogram"), self._take("sums").sum(axis=1), self._counted)
        self._counted = 0


def contiguous(array: NDArray[Any]) -> NDArray[Any]:
    """Return a contiguous array of at least one value, since buffers cannot be empty."""
    return np.ascontiguousarray(array if array.size else np.zeros(1, array.dtype))


def with_padding(array: NDArray[np.void]) -> NDArray[np.void]:
    """Flatten per-pixel structs and append a block, since kernels may read, but not use, pixels past the last one."""
    return np.concatenate([array.ravel(), np.zeros(PIXEL_BLOCK, array.dtype)])


#: Vectors of realisations per work-item with sums other than chi-squared, limited by the number of registers.
FEW_VECTORS = 2
#: Pixels drawn at once for resolution elements, which have about 35 pixels and start at any pixel.
ELEMENT_CHUNK = 8


def scene_launches(
    device: Device, scene: Scene, seed: int, *, linears: int = 0, smooths: int = 0, chunk: int | None = None,
    **options: Any,
) -> Launches:  # fmt: skip
    """Return the launches of a scene, with the smallest kernel variant that suits it and has these options."""
    of_scene = ("frames", "clip", "joint", "quartic", "photons", "additive", "modulations")
    variant = replace(
        device.variant,
        scenarios=BATCH[scene.frames],
        linears=_capacity(linears),
        smooths=_capacity(smooths),
        noisy=scene.comparison.exposures > 0,
        estimated=scene.comparison.estimated,
        chunk=min(chunk or device.variant.chunk, device.variant.chunk),
        **{name: getattr(scene, name) for name in of_scene},
        **options,
    )
    single = device.width == 1 or scene.frames or variant.compared
    vectors = FEW_VECTORS if variant.elements or variant.linears else VECTORS
    return Launches(device, scene, replace(variant, vectors=1 if single else vectors), seed)


def detection_launches(device: Device, plan: ChannelPlan, seed: int) -> Launches:
    """Return the launches of a batch of flares, with the weights and scales of all statistics of a detection."""
    statistics, setting = plan.hypotheses.statistics, plan.hypotheses.setting
    bands, finished = np.zeros((1, 0, 1), np.float32), np.zeros(1, np.uint32)
    if len(plan.scales):
        bands, finished = Paper().smoothing(setting).bands(len(plan.scene.pixels), device.variant.chunk)
    launches = scene_launches(
        device,
        plan.scene,
        seed,
        pair="chi2_pair" in statistics,
        elements="chi2_element" in statistics,
        linears=len(plan.weights),
        smooths=len(plan.scales),
        slots=bands.shape[1],
    )
    launches.weigh(plan, bands, finished)
    return launches


def _capacity(count: int) -> int:
    """Round a number of statistics up to a power of two, so that few programs are built."""
    return max(32, 1 << (count - 1).bit_length()) if count else 0
