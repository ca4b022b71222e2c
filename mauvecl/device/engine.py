"""Engines: histograms, sums and raw frames of exposures and of stares, computed by the kernels of a device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.counts import TailSamples, Tally
from mauvecl.detection.detection import Detection
from mauvecl.detection.names import DEFAULT_STATISTICS, Tails
from mauvecl.detection.nuisances import Nuisances, as_nuisances
from mauvecl.detection.requests import (
    Countable,
    DetectRequest,
    Hypotheses,
    RealiseRequest,
    Shard,
    SnrRequest,
    check_last,
    plan_channels,
)
from mauvecl.detection.snr import (
    Arrays,
    Counts,
    DetectionSums,
    SnrResult,
    SnrSums,
    elements,
    observers,
    pack_detection,
    pack_snr,
)
from mauvecl.detection.statistics import Linear
from mauvecl.device.build import Device, DeviceRecord, devices
from mauvecl.device.drivers import DeviceError
from mauvecl.device.launches import (
    ELEMENT_CHUNK,
    Progress,
    StareLaunches,
    Tile,
    Tiles,
    detection_launches,
    scene_launches,
)
from mauvecl.flares.frames import Components
from mauvecl.flares.stare import Stare
from mauvecl.flares.stare_scene import (
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
from mauvecl.noise.drawing import Drawing, DrawingOptions
from mauvecl.noise.scene import BATCH, prepare
from mauvecl.noise.unknowns import NOISE_FREE, NONE, Comparison, Processes
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import OneOrMore
from mauvecl.schema.physical import DEFAULT_SEED, FirstRealisation, Realisations, Seed

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation

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
    >>> from mauvecl.device.engine import Stares
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
        first: StareNumber = 0,
        count: Realisations = 1,
        seed: Seed = DEFAULT_SEED,
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
                        launches.glow(few, glow)
                        more = [np.moveaxis(glow[0, : few.wanted, :, : stare.n_frames], 1, 2)]
                    reduced.append(dict(reduction(values, first, *more)))
                # Results are added last, since a tile that fails is drawn again.
                parts.extend(reduced)

            self._tiles.for_each(there.start, there.count, each, work)
        arrays = joined(parts, adds=reduction.adds)
        return arrays | {"start": np.array(there.start)} if shard else arrays

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


__all__ = ["DeviceError", "DeviceRecord", "Engine", "devices"]


@validated
class Engine:
    """Engine that draws realisations on an OpenCL device and reduces them there.

    Parameters
    ----------
    device : str, optional
        Number, or part of the platform's or device's name, as listed by `devices`; PoCL on the CPU by default.
    progress : callable, optional
        Called as ``progress(done, total)`` before and between tiles, in realisations. It may raise to stop the work.
    tile : int, optional
        Realisations per launch, for tests; by default chosen from the device and the work. Does not affect results.
    width : int, optional
        Realisations per work-item, for tests; by default 16 on CPUs and 1 elsewhere. Does not affect results.

    Raises
    ------
    DeviceError
        If there is no such device, or its driver does not work.

    Examples
    --------
    >>> from mauvecl import Engine, Instrument, Source, expect
    >>> star, mauve = Source.from_library("G2V").at_magnitude(7.4), Instrument.load("mauve")
    >>> quiet, flare = (expect(s, mauve, exposure=50.0) for s in (star, star.flaring(0.02)))
    >>> engine = Engine()
    >>> raw = engine.realise(quiet, count=3, seed=1)
    >>> bool((engine.realise(quiet, start=2, count=1, seed=1) == raw[2:]).all())
    True
    >>> detection = engine.detect(quiet, [flare], realisations=100_000, seed=1)
    >>> detection.statistics
    ('chi2', 'chi2_element', 'matched')
    >>> detection.detection_probability(fap=1e-3, statistic="matched")[0].value
    1.0
    """

    def __init__(
        self,
        device: str | None = None,
        *,
        progress: Progress | None = None,
        tile: int | None = None,
        width: int | None = None,
    ) -> None:
        self.open_device = Device(device, width=width)
        self._tiles = Tiles(self.open_device, progress=progress, largest=tile)

    def __repr__(self) -> str:
        return f"<Engine on {self.device_name}>"

    @property
    def device(self) -> DeviceRecord:
        """Record of the device, for run records."""
        return self.open_device.record

    @property
    def device_name(self) -> str:
        """Platform and device name."""
        return self.device.label

    @property
    def driver(self) -> str:
        """Version of the driver."""
        return self.device.driver

    @property
    def kernel_digest(self) -> str:
        """Short sha256 of the kernels rendered so far, for run records."""
        return self.open_device.kernel_digest

    def realise(
        self,
        expectation: Expectation,
        *,
        start: FirstRealisation = 0,
        count: Realisations,
        seed: Seed = DEFAULT_SEED,
        out: NDArray[Any] | None = None,
        **drawing: Unpack[DrawingOptions],
    ) -> NDArray[Any]:
        """Draw raw spectra, each of which depends only on the seed and its realisation index.

        Parameters
        ----------
        expectation : Expectation
        start, count : int
            Range of realisations, `start` to `start + count - 1`.
        seed : int
            0 to 2**64 - 1.
        out : ndarray, shape (count, n_pixel), optional
            Contiguous array to fill, of the type below.
        mode, recipe, processes, first_frame
            See `Drawing`.

        Returns
        -------
        ndarray of uint16 or int32, shape (count, n_pixel)
            Raw DN, summed over the exposure's frames: 16 bits for one frame of a 16-bit ADC.
        """
        return self.realise_and_count(expectation, start=start, count=count, seed=seed, out=out, **drawing)[0]

    def realise_and_count(
        self,
        expectation: Expectation,
        *,
        start: FirstRealisation = 0,
        count: Realisations,
        seed: Seed = DEFAULT_SEED,
        out: NDArray[Any] | None = None,
        **drawing: Unpack[DrawingOptions],
    ) -> tuple[NDArray[Any], NDArray[np.uint32]]:
        """Draw raw spectra and count their clipped samples; parameters as for `realise`.

        Returns
        -------
        raw : ndarray of uint16 or int32, shape (count, n_pixel)
            Raw DN.
        clipped : ndarray of uint32, shape (count,)
            Number of samples (pixels times frames) clipped at zero or saturation.
        """
        self.open_device.check_process()
        check_last(start, count)
        scene = prepare([expectation], **drawing)
        narrow = scene.n_frames == 1 and expectation.adc_max_dn < 2**16
        shape, dtype = (count, scene.n_pixel), np.dtype(np.uint16 if narrow else np.int32)
        if scene.n_frames * expectation.adc_max_dn >= 2**31:
            raise InputError(
                f"{scene.n_frames} frames of up to {expectation.adc_max_dn} DN overflow 32 bits; use at most "
                f"{2**31 // expectation.adc_max_dn} frames",
                key="frames",
            )
        if out is None:
            out = np.empty(shape, dtype)
        elif out.shape != shape or out.dtype != dtype or not out.flags.c_contiguous or not out.flags.writeable:
            raise InputError(
                f"out must be writable contiguous {dtype} of {shape}, not {out.dtype} of {out.shape}", key="out"
            )
        clipped = np.empty(count, np.uint32)
        rows = out
        with scene_launches(self.open_device, scene, seed, row_type="ushort" if narrow else "int") as launches:

            def work(tile: Tile, done: int) -> None:
                there = slice(done, done + tile.wanted)
                clipped[there] = launches.realise(tile, rows[there])

            self._tiles.for_each(start, count, scene.n_pixel * dtype.itemsize, work)
        return out, clipped

    def snr(
        self,
        expectation: Expectation,
        *,
        realisations: Realisations,
        seed: Seed = DEFAULT_SEED,
        start: FirstRealisation = 0,
        **drawing: Unpack[DrawingOptions],
    ) -> SnrResult:
        """Simulate the distributions of S/N per pixel and per resolution element (METHODS section 5).

        Parameters
        ----------
        expectation : Expectation
        realisations : int
        seed : int
            0 to 2**64 - 1.
        start : int
            First realisation.
        mode, recipe, processes, first_frame
            See `Drawing`.
        """
        request = SnrRequest(expectation, realisations, seed, start, Drawing(**drawing))
        sums = SnrSums(request)
        sums.add(0, pack_snr(self._snr(request, Shard(0, request.start, request.realisations))))
        return sums.answer()

    def count(self, request: Countable, shard: Shard, *, out: NDArray[Any] | None = None) -> Arrays:
        """Compute the sums of one shard of a request, as accumulated by `results.shard_sums`.

        Parameters
        ----------
        request : DetectRequest, SnrRequest, RealiseRequest or StaresRequest
        shard : Shard
            One of the shards into which `shards.shards` divides the request.
        out : ndarray, optional
            As for `realise`.

        Returns
        -------
        dict of str to ndarray
            Raw spectra are ``rows``.
        """
        match request:
            case DetectRequest():
                return pack_detection(*self._detection(request, shard))
            case SnrRequest():
                return pack_snr(self._snr(request, shard))
            case RealiseRequest():
                x, seed = request.expectation, request.seed
                how = request.drawing.options
                rows = self.realise(x, start=shard.start, count=shard.count, seed=seed, out=out, **how)
                return {"rows": rows}
            case StaresRequest():
                return Stares(self.open_device, tiles=self._tiles).reduced(request, shard)
        raise TypeError(f"a request is needed, not {type(request).__name__}")

    def _snr(self, request: SnrRequest, shard: Shard) -> Counts:
        self.open_device.check_process()
        scene, observed = request.scene, elements(request.expectation)
        counts = Counts(scene.n_pixel, len(observed))
        with scene_launches(self.open_device, scene, request.seed, chunk=ELEMENT_CHUNK) as launches:
            launches.observe(observers(request.expectation, scene), observed)
            self._tiles.for_each(shard.start, shard.count, 0, lambda tile, done: launches.histogram(tile, counts))
            launches.flush_counts(counts)
        return counts

    def detect(
        self,
        quiet: Expectation,
        flares: Sequence[Expectation] | Expectation,
        *,
        realisations: Realisations,
        seed: Seed = DEFAULT_SEED,
        statistics: Annotated[Sequence[str | Linear], OneOrMore((str, Linear))] = DEFAULT_STATISTICS,
        start: FirstRealisation = 0,
        comparison: Comparison = NOISE_FREE,
        tails: Tails = "counted",
        nuisances: Nuisances | Mapping[str, float] | None = None,
        **drawing: Unpack[DrawingOptions],
    ) -> Detection:
        """Simulate null and flare distributions of detection statistics on common draws (METHODS section 6).

        Parameters
        ----------
        quiet : Expectation
            The quiescent star, whose mean is the reference.
        flares : sequence of Expectation, or one
            The same star, instrument and exposure with flares. If empty, only the null is drawn.
        realisations : int
            Number of realisations per scenario.
        seed : int
            0 to 2**64 - 1.
        statistics : sequence of str or Linear, or one
            Names of `statistics.STATISTICS`, and user-defined linear statistics.
        start : int
            First realisation.
        mode, recipe, processes, first_frame
            See `Drawing`.
        comparison : Comparison
            Subtracted reference and variances that weight residuals; by default the expectation and the model's.
        tails : {"counted", "sampled"}
            Thresholds beyond the drawn realisations raise InputError, or come from importance sampling (`tails.tail`).
        nuisances : Nuisances or mapping of str to float, optional
            Nuisance parameters to marginalise: standard deviations by name (`nuisances.NUISANCES`), infinite for those
            that are projected out.
        """
        how = (start, Drawing(**drawing), comparison, tails, nuisances)
        request = DetectRequest(quiet, flares, realisations, seed, statistics, *how)  # type: ignore[arg-type]
        sums, each = DetectionSums(request), request.realisations
        total = request.parts * each
        for part in range(request.parts):
            shard = Shard(part, request.start, each)
            sums.add(part, pack_detection(*self._detection(request, shard, before=part * each, total=total)))
        return sums.answer()

    def _detection(
        self, request: DetectRequest, shard: Shard, *, before: int = 0, total: int | None = None
    ) -> tuple[Tally, list[TailSamples | None]]:
        self.open_device.check_process()
        plan, scene = request.plans[shard.part]
        tally, samples = Tally(plan.grids), plan.tails()
        with detection_launches(self.open_device, scene, request.seed, plan, request.hypotheses) as launches:

            def work(tile: Tile, done: int) -> None:
                launches.statistics(tile)
                launches.tally(tile, tally)
                for grid, samples_of_grid in zip(tally.grids, samples, strict=True):
                    if samples_of_grid is not None:
                        samples_of_grid.add(launches.channel(tile, grid.channel), shard.start + done)

            self._tiles.for_each(shard.start, shard.count, 4 * plan.n_rows, work, before=before, total=total)
            launches.flush(tally)
        return tally, samples

    def statistic_values(
        self,
        quiet: Expectation,
        flares: Sequence[Expectation] | Expectation,
        *,
        start: FirstRealisation = 0,
        count: Realisations,
        seed: Seed = DEFAULT_SEED,
        statistics: Annotated[Sequence[str | Linear], OneOrMore((str, Linear))] = DEFAULT_STATISTICS,
        comparison: Comparison = NOISE_FREE,
        nuisances: Nuisances | Mapping[str, float] | None = None,
        **drawing: Unpack[DrawingOptions],
    ) -> NDArray[np.float32]:
        """Compute the statistics of each realisation, for up to 15 flares (7 if drawn frame by frame).

        Parameters
        ----------
        quiet, flares, seed, statistics, comparison, nuisances, mode, recipe, processes, first_frame
            As for `detect`.
        start, count : int
            Range of realisations, `start` to `start + count - 1`.

        Returns
        -------
        ndarray of float32, shape (n_channel, count)
            First chi2, chi2_element and chi2_pair of each scenario, zero if not requested. Then the linear statistics
            of each scenario: ``matched`` (the null's for each flare's template) and the others in the requested order,
            including the sums that a marginalised chi2 subtracts. Finally ``paper``, in the order of ``matched``.
        """
        self.open_device.check_process()
        check_last(start, count)
        # The request validates the arguments and turns a single flare into a sequence.
        request = DetectRequest(quiet, flares, count, seed, statistics)  # type: ignore[arg-type]
        flares, statistics = request.flares, request.statistics
        scene = prepare([quiet, *flares], comparison=comparison, **drawing)
        if len(flares) >= BATCH[scene.frames]:
            raise InputError.of("flares", len(flares), f"at most {BATCH[scene.frames] - 1} in one launch")
        hypotheses = Hypotheses(quiet, flares, statistics, scene, nuisances=as_nuisances(nuisances, quiet))
        plan = plan_channels(hypotheses, range(len(flares)), first=True)
        out = np.empty((plan.n_rows, count), np.float32)

        with detection_launches(self.open_device, scene, seed, plan, hypotheses) as launches:

            def work(tile: Tile, done: int) -> None:
                launches.statistics(tile)
                out[:, done : done + tile.wanted] = launches.values(tile)

            self._tiles.for_each(start, count, 4 * plan.n_rows, work)
        return out
