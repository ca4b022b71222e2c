"""Buffers and kernel launches of stares."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.device.device import Device
from mauvecl.device.launches import Launches, padded
from mauvecl.device.program import Variant
from mauvecl.device.tiles import TILE_BYTES, Tile
from mauvecl.flares.stare_scene import Flares, Method, StareScene, SumTable

Floats = NDArray[np.float32]

#: Frames per work-item of the kernels whose lanes are frames.
FRAMES_EACH = 1024
#: Cached because callers draw a few stares at a time with the same weights.
table_of = lru_cache(maxsize=4)(SumTable.of)


class StareLaunches(Launches):
    """Buffers and launches of a stare; the buffers are released at the end of the `with` block."""

    def __init__(self, device: Device, stare: StareScene, seed: int, method: Method) -> None:
        self._by_sums = method == "cumulants"
        table = table_of(stare.components) if self._by_sums else None
        scene = stare.scene
        variant = replace(
            device.variant,
            clip=scene.clip,
            additive=scene.additive,
            sums=stare.components.n_statistics,
            spectra=stare.components.n_flares,
            unknown_groups=-(-len(stare.kinds) // 4),
            counts=stare.counts,
            neighbours=bool(stare.components.quiet.neighbour_electrons.any()),
            pointing=stare.stare.pointing is not None,
            fourths=table is not None and table.fourths,
            jittered=any(stare.stare.jitters.values()),
            in_time=self._by_sums,
        )
        super().__init__(device, scene, variant, seed)
        self._seed = seed
        self._held: Any = None
        self._stare, self._local = stare, (1, 1) if variant.width > 1 else None
        self._known = [*map(self.upload, (stare.numbers, stare.known, stare.curves, stare.kinds))]
        if table is None:
            more = (padded(stare.mixtures), stare.spectra, stare.weights, stare.constants)
            self._own = [*map(self.upload, more)]
        else:
            self._own = [self.upload(table.packed)]

    def __exit__(self, *_: object) -> None:
        super().__exit__()
        if self._held is not None:
            self._held.release()

    def upload_flares(self, flares: Flares, first: int, count: int) -> None:
        """Upload the flares and the pointing losses of the next `count` stares."""
        self._scenarios = len(flares.amplitudes)
        self._flares = [
            self._fill("stare_job", self._stare.stare_struct(flares)),
            *self._known,
            self._shared(flares.rows) if self._device.record.kind == "cpu" else self._fill("flares", flares.rows),
            self._fill("amplitudes", flares.amplitudes),
            self._fill("losses", self._losses(first, count)),
        ]

    def _losses(self, first: int, count: int) -> Floats:
        if not self.variant.pointing:
            return np.zeros(0, np.float32)
        return self._stare.losses(np.arange(count, dtype=np.uint64) + np.uint64(first), self._seed)

    def _shared(self, array: NDArray[Any]) -> Any:
        """Return a buffer that shares the host's memory, valid until the next flares are uploaded."""
        if self._held is not None:
            self._held.release()
        flags = self._cl.mem_flags
        self._given = np.ascontiguousarray(array if array.size else np.zeros(1, array.dtype))
        self._held = self._cl.Buffer(self._device.context, flags.READ_ONLY | flags.USE_HOST_PTR, hostbuf=self._given)
        return self._held

    def _fill(self, name: str, array: NDArray[Any]) -> Any:
        """Copy an array to a reused buffer."""
        data = np.ascontiguousarray(array if array.size else np.zeros(1, array.dtype))
        buffer = self._scratch(name, data.nbytes)
        self._cl.enqueue_copy(self._queue, buffer, data)
        return buffer

    def draw(self, tile: Tile, out: Floats, row: int) -> None:
        """Draw the statistics of a tile's frames into `out`.

        Parameters
        ----------
        out : ndarray of float32, shape (n_scenario, n_stare, n_statistic, n_padded_frame)
        row : int
            Index in `out` of the tile's first stare.
        """
        if self._by_sums:
            self._in_frames("stare_sums", self.variant, self._own, tile, out, row)
        else:
            self._by_pixels(tile, out[:, row : row + tile.wanted])

    def _by_pixels(self, tile: Tile, out: Floats) -> None:
        """Draw pixels, a few frames of all stares at a time."""
        tile = tile.narrow(self.variant.width)
        n_frames, each = self._stare.stare.n_frames, self._scenarios * self.variant.sums * tile.size
        block = max(1, TILE_BYTES // (4 * each))
        # The number of scenarios is rounded up to a power of two, so that few programs are built.
        variant = replace(self.variant, scenarios=1 << (self._scenarios - 1).bit_length())
        kernel = self._device.kernel(("stare", "stare_pixels"), variant, "stare_pixels")
        for begin in range(0, n_frames, block):
            size = min(block, n_frames - begin)
            values = self._scratch("values", 4 * each * size)
            kernel(
                self._queue,
                (tile.size // self.variant.width, size),
                self._local,
                *self._arguments,
                *self._flares,
                *tile.address(),
                *tile.rows(),
                np.uint32(begin),
                *self._own,
                np.uint32(tile.size),
                values,
            )
            host = np.empty((size, self._scenarios, self.variant.sums, tile.size), np.float32)
            self._cl.enqueue_copy(self._queue, host, values)
            out[..., begin : begin + size] = host[..., tile.start : tile.stop].transpose(1, 3, 2, 0)

    def glow(self, tile: Tile, out: Floats, row: int) -> None:
        """Compute the values with which `Injections` add flares to a tile's frames.

        `out` has the shape (1, n_stare, n_statistic + 1, n_padded_frame).
        """
        self._in_frames("stare_glow", replace(self.variant, in_time=True), [], tile, out, row)

    def _in_frames(self, name: str, variant: Variant, own: list[Any], tile: Tile, out: Floats, row: int) -> None:
        """Launch a kernel whose lanes are frames."""
        first, each = tile.first + tile.start, FRAMES_EACH if variant.width > 1 else 1
        kernel = self._device.kernel(("stare", name), variant, name)
        # A CPU writes to `out`; a buffer of another device contains only this tile.
        shares_memory = self._device.record.kind == "cpu"
        place = (out.shape[1], row) if shares_memory else (tile.wanted, 0)
        host = out if shares_memory else np.empty((len(out), tile.wanted, *out.shape[2:]), np.float32)
        with self._output("values", host) as values:
            kernel(
                self._queue,
                (tile.wanted, -(-out.shape[3] // each)),
                self._local,
                self._arguments[0],
                *self._flares,
                np.uint32(first & 0xFFFFFFFF),
                np.uint32(first >> 32),
                np.uint32(each),
                *own,
                *map(np.uint32, place),
                values,
            )
        if not shares_memory:
            out[:, row : row + tile.wanted] = host
