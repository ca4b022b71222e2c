"""Tile a request over an OpenCL device and bring back only what was reduced there."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl import layout, program
from mauvecl.detection import Detection, plan_channels
from mauvecl.host.errors import InputError
from mauvecl.program import DeviceError, DeviceRecord, Variant, devices
from mauvecl.scene import Mode, Scene, prepare
from mauvecl.snr import OBSERVER_BINS, OBSERVER_FINE_BITS, SnrResult, observers, plan_snr
from mauvecl.tally import Grid, Tally

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

__all__ = ["DeviceError", "DeviceRecord", "Engine", "devices"]

Progress = Callable[[int, int], None]

#: Device memory for the values of one tile; tiles change no result.
TILE_BYTES = 48 * 2**20
LARGEST_TILE = 2**16
#: Realisations counted on the device before its 32-bit bins and 64-bit sums are emptied.
MOST_COUNTED = 2**25


@dataclass(frozen=True)
class Tile:
    """Realisations from `first` on, a multiple of the vector width; [start, stop) of these `size` are wanted."""

    first: int
    size: int
    start: int
    stop: int


class Engine:
    """Draws realisations on an OpenCL device and reduces them there.

    Parameters
    ----------
    device : str, optional
        Number, or part of a platform's or device's name, as `devices` lists them; PoCL on the CPU by default.
    progress : callable, optional
        Called as ``progress(done, total)`` between tiles, in realisations. It may raise to stop the work.
    tile : int, optional
        Realisations in one launch, for tests; chosen from the device and the work by default. Never changes a result.

    Raises
    ------
    DeviceError
        If there is no such device, or PoCL cannot work here.
    """

    def __init__(self, device: str | None = None, *, progress: Progress | None = None, tile: int | None = None) -> None:
        self._cl = program.load_opencl()
        handle, self.device = program.choose_device(device)
        self._context = self._cl.Context([handle])
        self._queue = self._cl.CommandQueue(self._context)
        self._progress = progress
        self._tile = tile
        self._programs: dict[str, Any] = {}
        self._pid = os.getpid()
        cpu = self.device.kind == "cpu"
        self._width = 16 if cpu else 1
        self._vector_forms = cpu and self.device.platform == program.POCL

    @property
    def device_name(self) -> str:
        """Platform and device."""
        return self.device.label

    @property
    def driver(self) -> str:
        """The driver's version."""
        return self.device.driver

    @property
    def kernel_digest(self) -> str:
        """Short sha256 of the kernels rendered so far, for run records."""
        return program.digest("\n".join(sorted(self._programs)))

    def realise(
        self, expectation: Expectation, *, start: int = 0, count: int, seed: int, mode: Mode = "auto"
    ) -> NDArray[np.int32]:
        """Raw spectra, each addressed by its realisation index alone.

        Parameters
        ----------
        expectation : Expectation
        start, count : int
            Realisations start to start + count - 1.
        seed : int
            0 to 2**64 - 1.
        mode : {"auto", "frames", "stacked"}

        Returns
        -------
        ndarray of int32, shape (count, n_pixel)
            Raw DN summed over the exposure's frames.

        Raises
        ------
        InputError
            For an impossible range, seed or mode.
        """
        self._check(start, count, seed)
        scene = prepare([expectation], mode)
        out = np.empty((count, scene.n_pixel), np.int32)
        base = scene.base_dn[0] * scene.n_draws
        with self._scene(scene) as run:
            done = 0
            for tile in self._tiles(start, count, len(scene.pixels)):
                run.realise(tile, seed)
                rows = run.read(tile, scene.n_pixel)
                out[done : done + rows.shape[1]] = (base[:, None] + rows.astype(np.int64)).T
                done += rows.shape[1]
                self._report(done, count)
        return out

    def snr(
        self, expectation: Expectation, *, realisations: int, seed: int, mode: Mode = "auto", start: int = 0
    ) -> SnrResult:
        """Distributions of the S/N per pixel and per resolution element (METHODS section 5).

        Parameters
        ----------
        expectation : Expectation
        realisations : int
        seed : int
            0 to 2**64 - 1.
        mode : {"auto", "frames", "stacked"}
        start : int
            First realisation.

        Raises
        ------
        InputError
            For an impossible number, seed or mode.
        """
        self._check(start, realisations, seed)
        scene = prepare([expectation], mode)
        grids = plan_snr(expectation, scene)
        tally = Tally(grids, bins=OBSERVER_BINS, fine_bits=OBSERVER_FINE_BITS)
        rows = len(scene.pixels) + expectation.element_wavelength_nm.size
        with self._scene(scene, rows=rows, bins=OBSERVER_BINS, fine_bits=OBSERVER_FINE_BITS) as run:
            run.observe(observers(expectation, scene))
            done = 0
            for tile in self._tiles(start, realisations, rows):
                run.realise(tile, seed)
                run.signal_to_noise(tile)
                run.tally(tile, tally)
                done += tile.stop - tile.start
                self._report(done, realisations)
            run.flush(tally)
        return SnrResult(expectation, tally)

    def detect(
        self,
        quiet: Expectation,
        flares: Sequence[Expectation],
        *,
        realisations: int,
        seed: int,
        statistics: Sequence[str] = ("chi2", "chi2_element", "matched"),
        mode: Mode = "auto",
        start: int = 0,
    ) -> Detection:
        """Null and flare distributions of detection statistics, all on common draws (METHODS section 6).

        Parameters
        ----------
        quiet : Expectation
            The star without a flare; its mean is the template.
        flares : sequence of Expectation
            The same star, instrument and exposure with flares.
        realisations : int
            Of each scenario.
        seed : int
            0 to 2**64 - 1.
        statistics : sequence of {"chi2", "chi2_element", "chi2_pair", "matched"}
        mode : {"auto", "frames", "stacked"}
        start : int
            First realisation.

        Raises
        ------
        InputError
            For an unknown statistic, scenarios that do not belong together, or an impossible number, seed or mode.
        """
        self._check(start, realisations, seed)
        scene = prepare([quiet, *flares], mode)
        batch_size = 7 if scene.frames else 15
        result = Detection(quiet, tuple(flares), tuple(statistics), scene, realisations)
        batches = [range(i, min(i + batch_size, len(flares))) for i in range(0, len(flares), batch_size)] or [range(0)]
        for number, batch in enumerate(batches):
            plan = plan_channels(result, batch, first=number == 0)
            tally = Tally(plan.grids)
            with self._scene(
                scene.part([0, *(k + 1 for k in batch)]),
                rows=plan.n_rows,
                pair="chi2_pair" in statistics,
                elements="chi2_element" in statistics,
                scenarios=batch_size + 1,
            ) as run:
                run.weigh(plan.weights, plan.linear_end)
                done = 0
                for tile in self._tiles(start, realisations, plan.n_rows):
                    run.statistics(tile, seed)
                    run.tally(tile, tally)
                    done += tile.stop - tile.start
                    self._report(number * realisations + done, len(batches) * realisations)
                run.flush(tally)
            result.collect(plan, tally)
        return result

    def _check(self, start: int, count: int, seed: int) -> None:
        if os.getpid() != self._pid:
            # PoCL's threads do not survive a fork; its next call would wait for them for ever.
            raise DeviceError("this Engine was made before a fork, expected an Engine made in this process (use spawn)")
        if count < 1:
            raise InputError(f"realisations = {count}, expected at least 1")
        if not 0 <= start < 2**63 - count:
            raise InputError(f"start = {start}, expected 0 to 2**63 - 1")
        if not 0 <= seed < 2**64:
            raise InputError(f"seed = {seed}, expected 0 to 2**64 - 1")

    def _report(self, done: int, total: int) -> None:
        if self._progress is not None:
            self._progress(done, total)

    def _tiles(self, start: int, count: int, rows: int) -> Iterator[Tile]:
        """Tiles cut at multiples of their own size, so that none crosses a multiple of 2**32."""
        fit = max(TILE_BYTES // (4 * rows), self._width)
        size = min(self._tile or LARGEST_TILE, LARGEST_TILE, 1 << (fit.bit_length() - 1))
        size = max(1 << (size.bit_length() - 1), self._width)
        stop = start + count
        first = start - start % size
        while first < stop:
            wanted = (max(start - first, 0), min(stop - first, size))
            # A short last tile computes only the vectors it needs.
            need = -(-wanted[1] // self._width) * self._width
            skip = wanted[0] - wanted[0] % self._width
            yield Tile(first + skip, need - skip, wanted[0] - skip, wanted[1] - skip)
            first += size

    def _program(self, room: str, variant: Variant) -> Any:
        source = program.render((room,), variant)
        if source not in self._programs:
            self._programs[source] = program.build(self._context, source)
        return self._programs[source]

    def _scene(
        self,
        scene: Scene,
        *,
        rows: int = 0,
        pair: bool = False,
        elements: bool = True,
        scenarios: int = 16,
        bins: int = layout.BINS,
        fine_bits: int = layout.FINE_BITS,
    ) -> _Run:
        variant = Variant(
            width=self._width,
            vector_forms=self._vector_forms,
            chunk=32 if self._width > 1 else 4,
            scenarios=scenarios,
            linears=2 * scenarios,
            frames=scene.frames,
            clip=scene.clip,
            pair=pair,
            elements=elements,
            expansion=scene.expansion,
            bins=bins,
            fine_bits=fine_bits,
        )
        return _Run(self, scene, variant, rows or len(scene.pixels))


class _Run:
    """One scene on the device: its buffers and launches, released at the end of the `with` block."""

    def __init__(self, engine: Engine, scene: Scene, variant: Variant, rows: int) -> None:
        self._engine, self._scene, self._variant, self._rows = engine, scene, variant, rows
        self._buffers: list[Any] = []
        self._cl, self._queue = engine._cl, engine._queue
        self._pixels = self._upload(scene.pixels)
        self._levels = self._upload(scene.levels)
        self._tables = self._upload(scene.tables)
        self._values: Any = None
        self._stride = 0
        self._counted = 0
        self._kernels: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.finish()
        for buffer in self._buffers:
            buffer.release()

    def _upload(self, array: NDArray[Any]) -> Any:
        flags = self._cl.mem_flags
        data = np.ascontiguousarray(array if array.size else np.zeros(1, array.dtype))
        buffer = self._cl.Buffer(self._engine._context, flags.READ_WRITE | flags.COPY_HOST_PTR, hostbuf=data)
        self._buffers.append(buffer)
        return buffer

    def _kernel(self, room: str, name: str) -> Any:
        if name not in self._kernels:
            self._kernels[name] = self._cl.Kernel(self._engine._program(room, self._variant), name)
        return self._kernels[name]

    def _launch(self, room: str, name: str, items: int, *arguments: Any) -> None:
        kernel = self._kernel(room, name)
        local = (1,) if self._variant.width > 1 else None
        kernel(self._queue, (items,), local, *arguments)

    def _make_room(self, tile: Tile) -> None:
        if tile.size > self._stride:
            self._stride = tile.size
            self._values = self._cl.Buffer(
                self._engine._context, self._cl.mem_flags.READ_WRITE, 4 * self._rows * tile.size
            )
            self._buffers.append(self._values)

    @staticmethod
    def _address(tile: Tile, seed: int) -> list[np.uint32]:
        numbers = (seed & 0xFFFFFFFF, seed >> 32, tile.first & 0xFFFFFFFF, tile.first >> 32)
        return [np.uint32(number) for number in numbers]

    def realise(self, tile: Tile, seed: int) -> None:
        """Draw DN above the base of scenario 0 into values[pixel][realisation]."""
        self._make_room(tile)
        self._launch(
            "realise",
            "realise",
            tile.size // self._variant.width,
            *self._address(tile, seed),
            np.uint32(len(self._scene.pixels)),
            np.uint32(self._scene.n_draws),
            self._pixels,
            self._levels,
            self._tables,
            np.uint32(self._stride),
            self._values,
        )

    def read(self, tile: Tile, rows: int) -> NDArray[np.float32]:
        """The wanted realisations of the first rows of values, shape (rows, n)."""
        host = np.empty((rows, self._stride), np.float32)
        self._cl.enqueue_copy(self._queue, host, self._values)
        return host[:, tile.start : tile.stop]

    def observe(self, observers: NDArray[np.void]) -> None:
        """Upload what the observer subtracts and assumes."""
        self._observers = self._upload(observers)

    def signal_to_noise(self, tile: Tile) -> None:
        """Replace DN by S/N, and append the resolution elements."""
        self._launch(
            "realise",
            "signal_to_noise",
            tile.size // self._variant.width,
            np.uint32(len(self._scene.pixels)),
            self._pixels,
            self._observers,
            np.uint32(self._stride),
            self._values,
        )

    def weigh(self, weights: NDArray[np.float32], linear_end: NDArray[np.uint32]) -> None:
        """Upload the linear statistics' weights, and where each scenario's end."""
        self._weights = self._upload(weights)
        self._linear_end = self._upload(linear_end)

    def statistics(self, tile: Tile, seed: int) -> None:
        """Compute every channel of a tile into values[channel][realisation]."""
        self._make_room(tile)
        self._launch(
            "statistics",
            "statistics",
            tile.size // self._variant.width,
            *self._address(tile, seed),
            np.uint32(len(self._scene.pixels)),
            np.uint32(len(self._scene.levels)),
            np.uint32(self._scene.n_draws),
            self._pixels,
            self._levels,
            self._tables,
            self._weights,
            self._linear_end,
            np.uint32(self._stride),
            self._values,
        )

    def tally(self, tile: Tile, tally: Tally) -> None:
        """Add a tile's channels to the histograms and integer sums on the device."""
        if not self._counted:
            self._grids = self._upload(Grid.pack(tally.grids))
            self._histogram = self._upload(np.zeros((len(tally.grids), tally.bins), np.uint32))
            self._sums = self._upload(np.zeros((len(tally.grids), 2), np.int64))
        self._launch(
            "tally",
            "tally",
            len(tally.grids),
            np.uint32(tile.start),
            np.uint32(tile.stop),
            np.uint32(self._stride),
            self._values,
            self._grids,
            self._histogram,
            self._sums,
        )
        self._queue.finish()
        self._counted += tile.stop - tile.start
        if self._counted > MOST_COUNTED:
            self.flush(tally)

    def flush(self, tally: Tally) -> None:
        """Move the device's histograms and sums to the host."""
        histogram = np.empty((len(tally.grids), tally.bins), np.uint32)
        sums = np.empty((len(tally.grids), 2), np.int64)
        self._cl.enqueue_copy(self._queue, histogram, self._histogram)
        self._cl.enqueue_copy(self._queue, sums, self._sums)
        tally.add(histogram, sums, self._counted)
        for buffer in (self._grids, self._histogram, self._sums):
            self._buffers.remove(buffer)
            buffer.release()
        self._counted = 0
