"""Realisations cut into launches, as the device's memory and the generator's counter allow."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mauvecl.device.errors import DeviceError
from mauvecl.device.opened import Device
from mauvecl.device.program import out_of_memory

Progress = Callable[[int, int], None]

#: Device memory for what one tile writes; tiles change no result.
TILE_BYTES = 64 * 2**20
LARGEST_TILE = 2**16


@dataclass(frozen=True)
class Tile:
    """Realisations from `first` on, a multiple of the vector width; [start, stop) of these `size` are wanted."""

    first: int
    size: int
    start: int
    stop: int

    @property
    def wanted(self) -> int:
        """How many are wanted."""
        return self.stop - self.start

    def address(self) -> tuple[np.uint32, np.uint32]:
        """Both words of the first index."""
        return np.uint32(self.first & 0xFFFFFFFF), np.uint32(self.first >> 32)

    def rows(self) -> tuple[np.uint32, np.uint32]:
        """Which of the tile are wanted."""
        return np.uint32(self.start), np.uint32(self.stop)

    def narrow(self, width: int) -> Tile:
        """The same realisations in as few vectors of a width as hold them."""
        skip = self.start - self.start % width
        return Tile(self.first + skip, -(-self.stop // width) * width - skip, self.start - skip, self.stop - skip)

    def pieces(self, size: int) -> Iterator[Tile]:
        """The same realisations in tiles of at most so many, a multiple of what a work-item follows."""
        for begin in range(0, self.size, size):
            length = min(size, self.size - begin)
            start, stop = max(self.start - begin, 0), min(self.stop - begin, length)
            if start < stop:
                yield Tile(self.first + begin, length, start, stop)


class Tiles:
    """How one device's work is cut.

    Parameters
    ----------
    device : Device
    progress : callable, optional
        Called as ``progress(done, total)`` before and between tiles, in realisations. It may raise to stop the work.
    largest : int, optional
        Realisations in one tile, at most.
    """

    def __init__(self, device: Device, *, progress: Progress | None = None, largest: int | None = None) -> None:
        self._device, self._progress, self._largest, self._step = device, progress, largest, device.step

    def over(
        self,
        start: int,
        count: int,
        bytes_each: int,
        work: Callable[[Tile, int], None],
        *,
        before: int = 0,
        total: int | None = None,
    ) -> None:
        """Work through realisations tile by tile, with smaller ones where the device's memory does not suffice."""
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
                        f"{self._device.name} has too little memory for {self._step} realisations of it: {error}"
                    ) from error
                size //= 2
                continue
            done += tile.wanted
            if self._progress is not None:
                self._progress(before + done, count if total is None else total)

    def size(self, bytes_each: int) -> int:
        """Realisations in a tile: a power of two, from the device's memory and what each needs."""
        memory = min(TILE_BYTES, self._device.record.global_memory // 8)
        fit = memory // bytes_each if bytes_each else LARGEST_TILE
        size = min(self._largest or LARGEST_TILE, LARGEST_TILE, max(fit, 1))
        return int(max(1 << (size.bit_length() - 1), self._step))

    def at(self, index: int, left: int, size: int) -> Tile:
        """The tile that `index` lies in, cut at multiples of its size, so that none crosses a multiple of 2**32."""
        first = index - index % size
        start, stop = index - first, min(index - first + left, size)
        # A short tile computes only the vectors it needs.
        skip = start - start % self._step
        need = -(-stop // self._step) * self._step
        return Tile(first + skip, need - skip, start - skip, stop - skip)
