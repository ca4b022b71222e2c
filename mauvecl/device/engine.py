"""Engines: histograms, sums and raw frames of exposures, computed by the kernels of a device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection import DEFAULT_STATISTICS, Tails, requests, snr
from mauvecl.detection.counts import Tally
from mauvecl.detection.detection import Detection, detection_of
from mauvecl.detection.nuisances import Nuisances
from mauvecl.detection.snr import Counts, SnrResult
from mauvecl.detection.statistics import Linear
from mauvecl.device.build import Device, DeviceRecord, devices
from mauvecl.device.drivers import DeviceError
from mauvecl.device.launches import ELEMENT_CHUNK, Progress, Tile, Tiles, detection_launches, scene_launches
from mauvecl.host.arrays import Arrays
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.noise.drawing import Drawing, DrawingOptions
from mauvecl.noise.scene import BATCH, prepare
from mauvecl.noise.unknowns import NOISE_FREE, Comparison
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import DEFAULT_SEED, FirstRealisation, OneOrMore, Realisations, Seed

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
        requests.check_last(start, count)
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
        clipped, rows = np.empty(count, np.uint32), out
        with scene_launches(self.open_device, scene, seed, row_type="ushort" if narrow else "int") as launches:

            def work(tile: Tile, done: int) -> None:
                place = slice(done, done + tile.count)
                clipped[place] = launches.realise(tile, rows[place])

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
        request = requests.SnrRequest(expectation, realisations, seed, start, Drawing(**drawing))
        counts = self._snr(request, requests.Shard(0, request.start, request.realisations))
        return SnrResult(request.expectation, request.scene, counts)

    def _snr(self, request: requests.SnrRequest, shard: requests.Shard) -> Counts:
        """Count the S/N of pixels and elements in a shard."""
        x, scene, counts = request.expectation, request.scene, snr.counts_of(request)
        with scene_launches(self.open_device, scene, request.seed, chunk=ELEMENT_CHUNK) as launches:
            launches.observe(snr.observers(x, scene), snr.elements(x))
            self._tiles.for_each(shard.start, shard.count, 0, lambda tile, _: launches.histogram(tile, counts))
            launches.flush_counts(counts)
        return counts

    def count(
        self, request: requests.ShardedRequest, shard: requests.Shard, *, out: NDArray[Any] | None = None
    ) -> Arrays:
        """Compute the sums of one shard of a request; raw spectra are ``rows``, filled into `out` if it is given."""
        match request:
            case requests.DetectRequest():
                return self._detection(request, shard).pack()
            case requests.SnrRequest():
                return self._snr(request, shard).pack()
            case requests.RealiseRequest():
                x, seed, options = request.expectation, request.seed, vars(request.drawing)
                return {"rows": self.realise(x, start=shard.start, count=shard.count, seed=seed, out=out, **options)}
        # Exposures do not need the modules of stares.
        from mauvecl.device.stares import Stares
        from mauvecl.flares.stare_scene import StaresRequest

        if isinstance(request, StaresRequest):
            return Stares(self.open_device, tiles=self._tiles).reduced(request, shard)
        raise TypeError(f"a request is needed, not {type(request).__name__}")

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
        options = (start, Drawing(**drawing), comparison, tails, nuisances)
        request = requests.DetectRequest(quiet, flares, realisations, seed, statistics, *options)  # type: ignore[arg-type]
        n = request.realisations
        shards = [requests.Shard(part, request.start, n) for part in range(request.parts)]
        tallies = (self._detection(request, shard, before=shard.part * n, total=len(shards) * n) for shard in shards)
        return detection_of(request, tallies)

    def _detection(
        self, request: requests.DetectRequest, shard: requests.Shard, *, before: int = 0, total: int | None = None
    ) -> Tally:
        """Count the statistics of a shard; `before` and `total` as for `Tiles.for_each`."""
        plan = request.plans[shard.part]
        tally = plan.tally()
        with detection_launches(self.open_device, plan, request.seed) as launches:

            def work(tile: Tile, done: int) -> None:
                launches.statistics(tile)
                launches.tally(tile, tally)
                for index, extremes in tally.tails.items():
                    extremes.add(launches.channel(tile, int(plan.grids["channel"][index])), shard.start + done)

            self._tiles.for_each(shard.start, shard.count, 4 * plan.n_rows, work, before=before, total=total)
            launches.flush(tally)
        return tally

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
        options = (start, Drawing(**drawing), comparison, "counted", nuisances)
        # The request validates the arguments and turns a single flare into a sequence.
        request = requests.DetectRequest(quiet, flares, count, seed, statistics, *options)  # type: ignore[arg-type]
        if request.parts > 1:
            most = BATCH[request.hypotheses.scene.frames] - 1
            raise InputError.of("flares", len(request.flares), f"at most {most} in one launch")
        plan = request.plans[0]
        out = np.empty((plan.n_rows, count), np.float32)
        with detection_launches(self.open_device, plan, seed) as launches:

            def work(tile: Tile, done: int) -> None:
                launches.statistics(tile)
                for number, row in enumerate(out):
                    row[done : done + tile.count] = launches.channel(tile, number)

            self._tiles.for_each(start, count, 4 * plan.n_rows, work)
        return out
