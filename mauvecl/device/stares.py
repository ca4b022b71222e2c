"""Stares on a device: every frame drawn, and reduced there to a few weighted sums."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from mauvecl.device.opened import Device
from mauvecl.device.stare_launches import StareLaunches
from mauvecl.device.tiles import Progress, Tile, Tiles
from mauvecl.host.arguments import public
from mauvecl.host.errors import InputError
from mauvecl.lightcurve.stares.components import Components
from mauvecl.lightcurve.stares.requests import Arrays, Kept, Method, StaresRequest, joined
from mauvecl.lightcurve.stares.scene import Flares, StareScene, padded_frames
from mauvecl.lightcurve.stares.stare import Stare
from mauvecl.lightcurve.stares.sums import check_sums
from mauvecl.noise.processes import CosmicRays
from mauvecl.results.requests.requests import Shard

Floats = NDArray[np.float32]

#: Of stares that are drawn and reduced at once.
REDUCED_BYTES = 4 * 2**20


@public
class Stares:
    """Draws stares on an OpenCL device.

    Parameters
    ----------
    device : str or Device, optional
        As `Engine` takes it, or a device that is open already.
    progress : callable, optional
        Called as ``progress(done, total)`` before and between tiles, in stares. It may raise to stop the work.
    tile : int, optional
        Stares in one launch, for tests; chosen from the device and the work by default. Never changes a result.
    width : int, optional
        Stares or frames in one work-item, for tests: 16 on CPUs, 1 elsewhere. Never changes a result.
    tiles : Tiles, optional
        How the work is cut, in place of `progress` and `tile`.

    Raises
    ------
    DeviceError
        If there is no such device, or PoCL cannot work here.

    Examples
    --------
    >>> import numpy as np
    >>> from mauvecl import Instrument, Source, expect
    >>> from mauvecl.device.stares import Stares
    >>> from mauvecl.lightcurve.stares.components import Components
    >>> from mauvecl.lightcurve.stares.stare import Stare
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
        self.opened = device if isinstance(device, Device) else Device(device, width=width)
        self._tiles = tiles or Tiles(self.opened, progress=progress, largest=tile)

    def frames(
        self,
        components: Components,
        stare: Stare,
        flare: NDArray[Any] | None = None,
        *,
        first: int = 0,
        count: int = 1,
        seed: int,
        method: Method = "pixels",
        amplitudes: NDArray[Any] | None = None,
        cosmic_rays: CosmicRays | None = None,
    ) -> Floats:
        """Statistics of each frame of stares `first` to `first + count - 1`.

        Parameters
        ----------
        components : Components
        stare : Stare
        flare : ndarray, shape (n_frame, n_flare) or (count, n_frame, n_flare), optional
            Amplitude of each flare spectrum in each frame, of all stares alike or of each.
        first, count : int
            Numbers of stares: what they hold follows from seed and number alone.
        seed : int
            0 to 2**64 - 1.
        method : {"pixels", "cumulants"}
            Every pixel drawn, or the sums at once from their cumulants. Conditions of frames are the same either way.
        amplitudes : ndarray, shape (n_scenario, count) or (n_scenario, 1), optional
            Factors on `flare`: as many scenarios on common draws.
        cosmic_rays : CosmicRays, optional
            By method "pixels".

        Returns
        -------
        ndarray of float32, shape (count, n_frame, n_statistic)
            Sums over pixels of weights times raw counts less the quiescent star's mean; frames of one statistic lie
            side by side in memory. With `amplitudes` one axis more in front, (n_scenario, ...).

        Raises
        ------
        InputError
            For an impossible range, seed or method, or what cannot be drawn by it.
        """
        _check(first, count, seed, method)
        flares = Flares.of(components, stare, flare, amplitudes, count)
        shape = (len(flares.amplitudes), count, components.n_statistics, padded_frames(stare.n_frames))
        out = np.empty(shape, np.float32)
        with self._launches(components, stare, flares, seed, method, cosmic_rays) as launches:

            def work(tile: Tile, done: int) -> None:
                launches.give(flares.part(done, tile.wanted))
                launches.draw(tile, out, done)

            self._tiles.over(first, count, out[:, 0].nbytes, work)
        frames = np.moveaxis(out[..., : stare.n_frames], 2, 3)
        return frames[0] if amplitudes is None else frames

    def reduced(self, request: StaresRequest, shard: Shard | None = None) -> Arrays:
        """What is kept of a request's stares, or of a shard of them, which are drawn and reduced a few at a time.

        Parameters
        ----------
        request : StaresRequest
        shard : Shard, optional

        Returns
        -------
        dict of str to ndarray
            What the request's reduction gives, joined; of a shard with its ``start``, as `StareSums` takes it.

        Raises
        ------
        InputError
            As `frames`.
        """
        there = shard or Shard(0, request.start, request.realisations)
        _check(there.start, there.count, request.seed, request.method)
        components, stare, reduction = request.components, request.stare, request.reduction or Kept()
        how = (request.seed, request.method, request.cosmic_rays)
        scenarios = slice(None) if request.amplitudes is not None else 0
        parts = list[Arrays]()
        shape = (components.n_statistics, padded_frames(stare.n_frames))
        each = 4 * len(request.flares.amplitudes) * shape[0] * shape[1]
        # Few enough to stay in a processor's cache while they are looked at, and never a vector's worth of months.
        alone = 1 if request.method == "cumulants" else self.opened.width
        piece = max(alone, REDUCED_BYTES // each // alone * alone)
        room = np.empty(each * piece // 4, np.float32)
        beside = np.empty((1, piece, shape[0] + 1, shape[1]) if request.glow else 0, np.float32)
        with self._launches(components, stare, request.flares, *how) as launches:

            def work(tile: Tile, done: int) -> None:
                reduced = []
                for few in tile.pieces(piece):
                    out = room[: each * few.wanted // 4].reshape(-1, few.wanted, *shape)
                    first = few.first + few.start
                    launches.give(request.flares.part(first - request.start, few.wanted))
                    launches.draw(few, out, 0)
                    values = np.moveaxis(out[..., : stare.n_frames], 2, 3)[scenarios]
                    more = []
                    if request.glow:
                        launches.glow(few, beside, 0)
                        more = [np.moveaxis(beside[0, : few.wanted, :, : stare.n_frames], 1, 2)]
                    reduced.append(dict(reduction(values, first, *more)))
                # A tile that fails half way is drawn again.
                parts.extend(reduced)

            self._tiles.over(there.start, there.count, each, work)
        kept = joined(parts, adds=reduction.adds)
        return kept | {"start": np.array(there.start)} if shard else kept

    def _launches(
        self,
        components: Components,
        stare: Stare,
        flares: Flares,
        seed: int,
        method: Method,
        cosmic_rays: CosmicRays | None,
    ) -> StareLaunches:
        self.opened.check_process()
        scene = _laid_out(components, stare, cosmic_rays)
        scene.check(flares)
        if method == "cumulants":
            check_sums(scene, flares)
        return StareLaunches(self.opened, scene, seed, method)


#: Callers ask for a few stares at a time, of the same star.
_laid_out = lru_cache(maxsize=4)(StareScene.of)


def _check(first: int, count: int, seed: int, method: str) -> None:
    if not (first >= 0 and count >= 1 and first + count <= 2**64):
        raise InputError(f"{count} stares from number {first}, expected at least 1, numbered 0 to 2**64 - 1")
    if not 0 <= seed < 2**64:
        raise InputError(f"seed = {seed}, expected 0 to 2**64 - 1")
    if method not in get_args(Method):
        raise InputError(f"method = {method!r}, expected 'pixels' or 'cumulants'")
