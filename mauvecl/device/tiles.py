"""Division of realisations into launches that fit the device's memory and the generator's counter."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mauvecl.device.device import Device
from mauvecl.device.errors import DeviceError
from mauvecl.device.program import out_of_memory

Progress = Callable[[int, int], None]

#: Device memory for the output of a tile. The size of tiles does not affect results.
TILE_BYTES = 64 * 2**20
LARGEST_TILE = 2**16


@dataclass(frozen=True)
class Tile:
    """Range of realisations computed in one launch."""

    first: int  # a multiple of the vector width
    size: int
    start: int  # the requested realisations are [start, stop), relative to first
    stop: int

    @property
    def wanted(self) -> int:
        """Number of requested realisations."""
        return self.stop - self.start

    def address(self) -> tuple[np.uint32, np.uint32]:
        """Return both words of the first index."""
        return np.uint32(self.first & 0xFFFFFFFF), np.uint32(self.first >> 32)

    def rows(self) -> tuple[np.uint32, np.uint32]:
        """Return the requested range, relative to the first realisation."""
        return np.uint32(self.start), np.uint32(self.stop)

    def narrow(self, width: int) -> Tile:
        """Return the tile of the same requested realisations with the fewest vectors of this width."""
        skip = self.start - self.start % width
        return Tile(self.first + skip, -(-self.stop // width) * width - skip, self.start - skip, self.stop - skip)

    def pieces(self, size: int) -> Iterator[Tile]:
        """Yield tiles of at most `size` realisations, a multiple of those per work-item."""
        for begin in range(0, self.size, size):
            length = min(size, self.size - begin)
            start, stop = max(self.start - begin, 0), min(self.stop - begin, length)
            if start < stop:
                yield Tile(self.first + begin, length, start, stop)


class Tiles:
    """Division of a device's work into tiles.

    Parameters
    ----------
    progress : callable, optional
        Called as ``progress(done, total)`` before and between tiles, in realisations. It may raise to stop the work.
    largest : int, optional
        Largest number of realisations per tile.
    """

    def __init__(self, device: Device, *, progress: Progress | None = None, largest: int | None = None) -> None:
        self._device, self._progress, self._largest, self._step = device, progress, largest, device.step

    def for_each(
        self,
        start: int,
        count: int,
        bytes_each: int,
        work: Callable[[Tile, int], None],
        *,
        before: int = 0,
        total: int | None = None,
    ) -> None:
        """Call `work(tile, done)` for each tile, with smaller tiles if the device's memory does not suffice."""
        size = self.size(bytes_each)
        done = 0
        if self._progress is not None and not before:
            self._progress(0, count if total is None else total)
        while done < count:
            tile = self.at(start + done, count - done, size)
            try:
                work(tile, done)
            except self._device.cl.Error as error:
                if not out_of_memory(error):
                    raise
                if size <= self._step:
                    raise DeviceError(
                        f"{self._device.name} has too little memory for {self._step} realisations of it: {error}",
                        "memory",
                    ) from error
                size //= 2
                continue
            done += tile.wanted
            if self._progress is not None:
                self._progress(before + done, count if total is None else total)

    def size(self, bytes_each: int) -> int:
        """Return the number of realisations per tile, a power of two, from the memory of the device."""
        memory = min(TILE_BYTES, self._device.record.global_memory // 8)
        fit = memory // bytes_each if bytes_each else LARGEST_TILE
        size = min(self._largest or LARGEST_TILE, LARGEST_TILE, max(fit, 1))
        return int(max(1 << (size.bit_length() - 1), self._step))

    def at(self, index: int, left: int, size: int) -> Tile:
        """Return the tile from `index` to a multiple of `size`, so that no tile crosses a multiple of 2**32."""
        first = index - index % size
        start, stop = index - first, min(index - first + left, size)
        # A short tile computes only the vectors that it needs.
        skip = start - start % self._step
        need = -(-stop // self._step) * self._step
        return Tile(first + skip, need - skip, start - skip, stop - skip)
