"""Stares drawn by the kernels of a device, and reduced there or on the host."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.requests import Shard
from mauvecl.device.build import Device, Variant
from mauvecl.device.launches import TILE_BYTES, Launches, Progress, Tile, Tiles, contiguous, with_padding
from mauvecl.flares import stare_scene
from mauvecl.flares.frames import Components
from mauvecl.flares.stare import Stare
from mauvecl.host.arrays import Arrays
from mauvecl.noise.unknowns import NONE, Processes
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import DEFAULT_SEED, Realisations, Seed

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
    progress, tile, width : optional
        As for `Engine`, in stares instead of realisations.
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
    >>> from mauvecl.device.stares import Stares
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

    def __repr__(self) -> str:
        return f"<Stares on {self.open_device.record.label}>"

    def frames(
        self,
        components: Components,
        stare: Stare,
        flare: NDArray[Any] | None = None,
        *,
        first: stare_scene.StareNumber = 0,
        count: Realisations = 1,
        seed: Seed = DEFAULT_SEED,
        method: stare_scene.Method = "pixels",
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
            Weighted sums over pixels of raw counts minus the quiescent mean. With `amplitudes`, the shape is
            (n_scenario, count, n_frame, n_statistic).
        """
        request = stare_scene.StaresRequest(components, stare, count, seed, flare, amplitudes, first, method, processes)
        values: Floats = self.reduced(request)["values"]
        return values if amplitudes is None else np.moveaxis(values, 0, 1)

    def reduced(self, request: stare_scene.StaresRequest, shard: Shard | None = None) -> Arrays:
        """Draw the stares of a request, or of a shard of it, and reduce them a few at a time.

        Return the joined results of the request's reduction, and of a shard with its ``start``.
        """
        start, count = (shard.start, shard.count) if shard else (request.start, request.realisations)
        if start + count > 2**64:
            raise InputError.of("first", start, f"at most {2**64 - count} for {count} stares")
        n_frames = request.stare.n_frames
        scenarios = slice(None) if request.amplitudes is not None else 0
        parts = list[Arrays]()
        shape = (request.components.n_statistics, stare_scene.padded_frames(n_frames))
        values_per_stare = len(request.flares.amplitudes) * shape[0] * shape[1]
        # Pieces are small enough for a processor's cache; the cumulants need no full vector of long stares.
        step = 1 if request.method == "cumulants" else self.open_device.width
        piece_size = max(step, REDUCED_BYTES // (4 * values_per_stare) // step * step)
        buffer = np.empty(values_per_stare * piece_size, np.float32)
        glow = np.empty((1, piece_size, shape[0] + 1, shape[1]) if request.glow else 0, np.float32)
        with StareLaunches(self.open_device, request) as launches:

            def work(tile: Tile, done: int) -> None:
                reduced = []
                for piece in tile.pieces(piece_size):
                    out = buffer[: values_per_stare * piece.count].reshape(-1, piece.count, *shape)
                    flares = request.flares.part(piece.begin - request.start, piece.count)
                    launches.upload_flares(flares, piece.begin, piece.count)
                    launches.draw(piece, out)
                    draws = [np.moveaxis(out[..., :n_frames], 2, 3)[scenarios]]
                    if request.glow:
                        launches.glow(piece, glow)
                        draws.append(np.moveaxis(glow[0, : piece.count, :, :n_frames], 1, 2))
                    reduced.append(dict(request.reducing(draws[0], piece.begin, *draws[1:])))
                # Results are added last, since a tile that fails is drawn again.
                parts.extend(reduced)

            self._tiles.for_each(start, count, 4 * values_per_stare, work)
        arrays = stare_scene.joined(request, parts)
        return arrays | {"start": np.array(start)} if shard else arrays


#: Frames per work-item of the kernels whose lanes are frames.
FRAMES_EACH = 1024
#: Cached because callers draw a few stares of the same star, with the same weights, at a time.
_scene_of, _table_of = lru_cache(maxsize=4)(stare_scene.StareScene.of), lru_cache(maxsize=4)(stare_scene.SumTable.of)


class StareLaunches(Launches):
    """Buffers and launches of a stare; the buffers are released at the end of the `with` block."""

    def __init__(self, device: Device, request: stare_scene.StaresRequest) -> None:
        stare = _scene_of(request.components, request.stare, request.processes)
        stare.check(request.flares)
        self._by_sums = request.method == "cumulants"
        if self._by_sums:
            stare_scene.check_cumulants(stare, request.flares)
        table = _table_of(stare.components) if self._by_sums else None
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
        super().__init__(device, scene, variant, request.seed)
        self._seed = request.seed
        self._stare, self._local = stare, (1, 1) if variant.width > 1 else None
        self._stare_buffers = [*map(self.upload, (stare.numbers, stare.known, stare.curves, stare.kinds))]
        if table is None:
            by_pixels = (with_padding(stare.mixtures), stare.spectra, stare.weights, stare.constants)
            # Only the range of pixels that a sum weights is drawn.
            chunks = np.flatnonzero(stare.weights.reshape(len(stare.weights), -1, variant.chunk).any(axis=(0, 2)))
            first, last = (chunks[0], chunks[-1] + 1) if chunks.size else (0, 0)
            ends = np.uint32(first * variant.chunk), np.uint32(last * variant.chunk)
            self._method_arguments = [*map(self.upload, by_pixels), *ends]
        else:
            self._method_arguments = [self.upload(np.concatenate([table.rows.ravel(), table.lower]))]

    def upload_flares(self, flares: stare_scene.Flares, first: int, count: int) -> None:
        """Upload the flares and the pointing losses of the next `count` stares."""
        self._scenarios, losses = len(flares.amplitudes), np.zeros(0, np.float32)
        if self.variant.pointing:
            losses = self._stare.losses(np.arange(count, dtype=np.uint64) + np.uint64(first), self._seed)
        self._flares = [
            self._fill("stare_job", self._stare.stare_struct(flares)),
            *self._stare_buffers,
            self._fill("flares", flares.rows),
            self._fill("amplitudes", flares.amplitudes),
            self._fill("losses", losses),
        ]

    def _fill(self, name: str, array: NDArray[Any]) -> Any:
        """Copy an array to a reused buffer."""
        data = contiguous(array)
        buffer = self._scratch(name, data.nbytes)
        self._cl.enqueue_copy(self._queue, buffer, data)
        return buffer

    def draw(self, tile: Tile, out: Floats) -> None:
        """Draw the statistics of a tile's frames into `out`, shape (n_scenario, n_stare, n_statistic, n_padded)."""
        if self._by_sums:
            self._in_frames("stare_sums", self.variant, self._method_arguments, tile, out)
            return
        # Pixels are drawn a few frames of all stares at a time.
        tile = replace(tile, width=self.variant.width)
        n_frames, values_per_frame = self._stare.stare.n_frames, self._scenarios * self.variant.sums * tile.size
        block = max(1, TILE_BYTES // (4 * values_per_frame))
        # The number of scenarios is rounded up to a power of two, so that few programs are built.
        variant = replace(self.variant, scenarios=1 << (self._scenarios - 1).bit_length())
        kernel = self._device.kernel(("stare", "stare_pixels"), variant, "stare_pixels")
        common = (*self._arguments, *self._flares, *tile.address(), *tile.rows())
        for begin in range(0, n_frames, block):
            size = min(block, n_frames - begin)
            items = (tile.size // self.variant.width, size)
            values = self._scratch("values", 4 * values_per_frame * size)
            arguments = (np.uint32(begin), *self._method_arguments, np.uint32(tile.size), values)
            kernel(self._queue, items, self._local, *common, *arguments)
            host = np.empty((size, self._scenarios, self.variant.sums, tile.size), np.float32)
            self._cl.enqueue_copy(self._queue, host, values)
            out[..., begin : begin + size] = host[..., tile.start : tile.start + tile.count].transpose(1, 3, 2, 0)

    def glow(self, tile: Tile, out: Floats) -> None:
        """Compute what `Injections` need to add flares, into `out`, shape (1, n_stare, n_statistic + 1, n_padded)."""
        self._in_frames("stare_glow", replace(self.variant, in_time=True), [], tile, out)

    def _in_frames(self, name: str, variant: Variant, arguments: list[Any], tile: Tile, out: Floats) -> None:
        """Launch a kernel whose lanes are frames, and which fills the first stares of `out`."""
        frames_per_item = FRAMES_EACH if variant.width > 1 else 1
        kernel = self._device.kernel(("stare", name), variant, name)
        items, n_stare = (tile.count, -(-out.shape[3] // frames_per_item)), np.uint32(out.shape[1])
        common = (self._arguments[0], *self._flares, *replace(tile, width=1).address(), np.uint32(frames_per_item))
        with self._output("values", out) as values:
            kernel(self._queue, items, self._local, *common, *arguments, n_stare, values)
