"""Drawing of stares on a device, where each frame is reduced to a few weighted sums."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.requests import Shard
from mauvecl.device.device import Device
from mauvecl.device.stare_launches import StareLaunches
from mauvecl.device.tiles import Progress, Tile, Tiles
from mauvecl.flares.frames import Components
from mauvecl.flares.stare import Stare
from mauvecl.flares.stare_scene import (
    Arrays,
    Flares,
    KeepStatistics,
    Method,
    StareNumber,
    StareScene,
    StaresRequest,
    check_sums,
    joined,
    padded_frames,
)
from mauvecl.noise.processes import NONE, Processes
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import Realisations, Seed

Floats = NDArray[np.float32]

#: Memory of stares that are drawn and reduced at once.
REDUCED_BYTES = 4 * 2**20


@validated
class Stares:
    """Simulator of stares on an OpenCL device.

    Parameters
    ----------
    device : str or Device, optional
        Number or name, as for `Engine`, or an open device.
    progress : callable, optional
        Called as ``progress(done, total)`` before and between tiles, in stares. It may raise to stop the work.
    tile : int, optional
        Stares per launch, for tests; by default chosen from the device and the work. Does not affect results.
    width : int, optional
        Stares or frames per work-item, for tests; by default 16 on CPUs and 1 elsewhere. Does not affect results.
    tiles : Tiles, optional
        Division of the work, instead of `progress` and `tile`.

    Raises
    ------
    DeviceError
        If there is no such device, or its driver does not work.

    Examples
    --------
    >>> import numpy as np
    >>> from mauvecl import Instrument, Source, expect
    >>> from mauvecl.device.stare_engine import Stares
    >>> from mauvecl.flares.frames import Components
    >>> from mauvecl.flares.stare import Stare
    >>> star, mauve = Source.from_library("G2V").at_magnitude(7.4), Instrument.load("mauve")
    >>> quiet, flare = (expect(s, mauve, exposure=5.0) for s in (star, star.flaring(1.0)))
    >>> near_uv = (quiet.wavelength_nm < 360).astype(float)
    >>> components = Components.of(quiet, [flare], near_uv[None])
    >>> stare = Stare.of(600.0, jitters={"light": 0.01})
    >>> y = Stares().frames(components, stare, first=7, count=3, seed=1)
    >>> y.shape
    (3, 120, 1)
    >>> bool((Stares().frames(components, stare, first=8, count=1, seed=1) == y[1]).all())
    True
    """

    def __init__(
        self,
        device: str | Device | None = None,
        *,
        progress: Progress | None = None,
        tile: int | None = None,
        width: int | None = None,
        tiles: Tiles | None = None,
    ) -> None:
        self.open_device = device if isinstance(device, Device) else Device(device, width=width)
        self._tiles = tiles or Tiles(self.open_device, progress=progress, largest=tile)

    def frames(
        self,
        components: Components,
        stare: Stare,
        flare: NDArray[Any] | None = None,
        *,
        first: StareNumber = 0,
        count: Realisations = 1,
        seed: Seed,
        method: Method = "pixels",
        amplitudes: NDArray[Any] | None = None,
        processes: Processes = NONE,
    ) -> Floats:
        """Draw the statistics of each frame of stares `first` to `first + count - 1`.

        Parameters
        ----------
        components : Components
        stare : Stare
        flare : ndarray, shape (n_frame, n_flare) or (count, n_frame, n_flare), optional
            Amplitude of each flare spectrum in each frame, common to all stares or per stare.
        first, count : int
            Range of stares; each stare depends only on the seed and its number.
        seed : int
            0 to 2**64 - 1.
        method : {"pixels", "cumulants"}
            Draw every pixel, or the sums directly from their cumulants. The conditions of frames are equal for both.
        amplitudes : ndarray, shape (n_scenario, count) or (n_scenario, 1), optional
            Factors on `flare`, for several scenarios on common draws.
        processes : Processes
            Additive processes, supported by the method "pixels" only; the priors of a stare are its `unknowns`.

        Returns
        -------
        ndarray of float32, shape (count, n_frame, n_statistic)
            Weighted sums over pixels of raw counts minus the quiescent mean; frames of a statistic are contiguous in
            memory. With `amplitudes`, the shape is (n_scenario, count, n_frame, n_statistic).
        """
        _check_last(first, count)
        flares = Flares.of(components, stare, flare, amplitudes, count)
        shape = (len(flares.amplitudes), count, components.n_statistics, padded_frames(stare.n_frames))
        out = np.empty(shape, np.float32)
        with self._launches(components, stare, flares, seed, method, processes) as launches:

            def work(tile: Tile, done: int) -> None:
                launches.upload_flares(flares.part(done, tile.wanted), first + done, tile.wanted)
                launches.draw(tile, out, done)

            self._tiles.for_each(first, count, out[:, 0].nbytes, work)
        frames = np.moveaxis(out[..., : stare.n_frames], 2, 3)
        return frames[0] if amplitudes is None else frames

    def reduced(self, request: StaresRequest, shard: Shard | None = None) -> Arrays:
        """Draw the stares of a request, or of a shard of it, and reduce them a few at a time.

        Parameters
        ----------
        request : StaresRequest
        shard : Shard, optional

        Returns
        -------
        dict of str to ndarray
            Joined results of the request's reduction; for a shard with its ``start``, as `StareSums` requires.
        """
        there = shard or Shard(0, request.start, request.realisations)
        _check_last(there.start, there.count)
        components, stare, reduction = request.components, request.stare, request.reduction or KeepStatistics()
        how = (request.seed, request.method, request.processes)
        scenarios = slice(None) if request.amplitudes is not None else 0
        parts = list[Arrays]()
        shape = (components.n_statistics, padded_frames(stare.n_frames))
        each = 4 * len(request.flares.amplitudes) * shape[0] * shape[1]
        # Pieces are small enough for a processor's cache; the cumulants need no full vector of long stares.
        step = 1 if request.method == "cumulants" else self.open_device.width
        piece = max(step, REDUCED_BYTES // each // step * step)
        room = np.empty(each * piece // 4, np.float32)
        glow = np.empty((1, piece, shape[0] + 1, shape[1]) if request.glow else 0, np.float32)
        with self._launches(components, stare, request.flares, *how) as launches:

            def work(tile: Tile, done: int) -> None:
                reduced = []
                for few in tile.pieces(piece):
                    out = room[: each * few.wanted // 4].reshape(-1, few.wanted, *shape)
                    first = few.first + few.start
                    launches.upload_flares(request.flares.part(first - request.start, few.wanted), first, few.wanted)
                    launches.draw(few, out, 0)
                    values = np.moveaxis(out[..., : stare.n_frames], 2, 3)[scenarios]
                    more = []
                    if request.glow:
                        launches.glow(few, glow, 0)
                        more = [np.moveaxis(glow[0, : few.wanted, :, : stare.n_frames], 1, 2)]
                    reduced.append(dict(reduction(values, first, *more)))
                # Results are added last, since a tile that fails is drawn again.
                parts.extend(reduced)

            self._tiles.for_each(there.start, there.count, each, work)
        kept = joined(parts, adds=reduction.adds)
        return kept | {"start": np.array(there.start)} if shard else kept

    def _launches(
        self,
        components: Components,
        stare: Stare,
        flares: Flares,
        seed: int,
        method: Method,
        processes: Processes,
    ) -> StareLaunches:
        self.open_device.check_process()
        scene = _scene_of(components, stare, processes)
        scene.check(flares)
        if method == "cumulants":
            check_sums(scene, flares)
        return StareLaunches(self.open_device, scene, seed, method)


#: Cached because callers draw a few stares of the same star at a time.
_scene_of = lru_cache(maxsize=4)(StareScene.of)


def _check_last(first: int, count: int) -> None:
    """Raise InputError if the last stare has no number of 64 bits."""
    if first + count > 2**64:
        raise InputError.of("first", first, f"at most {2**64 - count} for {count} stares")
