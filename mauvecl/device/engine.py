"""Tile a request over an OpenCL device and bring back only what was reduced there."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.device import program
from mauvecl.device.launches import Run, Tile
from mauvecl.device.program import DeviceError, DeviceRecord, Variant, devices
from mauvecl.host.errors import InputError
from mauvecl.noise.comparison import TEMPLATE, Comparison
from mauvecl.noise.processes import NONE, Processes
from mauvecl.noise.scene import BATCH, PIXEL_BLOCK, Mode, Recipe, Scene, prepare
from mauvecl.results.channels import ChannelPlan, plan_channels
from mauvecl.results.detection import Detection, Tails
from mauvecl.results.hypotheses import Hypotheses
from mauvecl.results.requests import Countable, DetectRequest, RealiseRequest, Share, SnrRequest
from mauvecl.results.snr import Counts, SnrResult, elements, observers
from mauvecl.results.sums import Arrays, DetectionSums, SnrSums, packed_detection, packed_snr
from mauvecl.results.tally import TailSamples, Tally
from mauvecl.statistics.linear import Linear
from mauvecl.statistics.nuisances import Nuisances, known
from mauvecl.statistics.paper import Paper
from mauvecl.statistics.registry import USUAL_STATISTICS

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

__all__ = ["DeviceError", "DeviceRecord", "Engine", "devices"]

Progress = Callable[[int, int], None]

#: Device memory for what one tile writes; tiles change no result.
TILE_BYTES = 64 * 2**20
LARGEST_TILE = 2**16
#: Vectors of realisations that one work-item of `statistics` follows on a processor.
VECTORS = 4


class Engine:
    """Draws realisations on an OpenCL device and reduces them there.

    Parameters
    ----------
    device : str, optional
        Number, or part of a platform's or device's name, as `devices` lists them; PoCL on the CPU by default.
    progress : callable, optional
        Called as ``progress(done, total)`` before and between tiles, in realisations. It may raise to stop the work.
    tile : int, optional
        Realisations in one launch, for tests; chosen from the device and the work by default. Never changes a result.
    width : int, optional
        Realisations in one work-item, for tests: 16 on CPUs, 1 elsewhere. Never changes a result.

    Raises
    ------
    DeviceError
        If there is no such device, or PoCL cannot work here.

    Examples
    --------
    >>> from mauvecl import Engine, Instrument, Source, expect
    >>> star, mauve = Source.from_library("G2V").at_magnitude(7.4), Instrument.load("mauve")
    >>> quiet, flare = (expect(s, mauve, exposure=50.0) for s in (star, star.flaring(0.02)))
    >>> engine = Engine()
    >>> raw = engine.realise(quiet, count=3, seed=1)
    >>> bool((engine.realise(quiet, start=2, count=1, seed=1) == raw[2:]).all())
    True
    >>> found = engine.detect(quiet, [flare], realisations=100_000, seed=1)
    >>> found.statistics
    ('chi2', 'chi2_element', 'matched')
    >>> found.detection_probability(fap=1e-3, statistic="matched")[0].value
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
        self.cl = program.load_opencl()
        handle, self.device = program.choose_device(device)
        self.context = self.cl.Context([handle])
        self.queue = self.cl.CommandQueue(self.context)
        self._progress = progress
        self._tile = tile
        self._programs: dict[str, Any] = {}
        self._kernels: dict[tuple[str, str], Any] = {}
        self._pid = os.getpid()
        cpu = self.device.kind == "cpu"
        self._width = width or (16 if cpu else 1)
        # Launches are cut at multiples of what one work-item of any kernel follows.
        self._step = VECTORS * self._width if self._width > 1 else 1
        self._vector_forms = self._width == 16 and self.device.platform == program.POCL

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
        self,
        expectation: Expectation,
        *,
        start: int = 0,
        count: int,
        seed: int,
        mode: Mode = "auto",
        processes: Processes = NONE,
        recipe: Recipe = "auto",
        first_frame: int = 0,
        out: NDArray[Any] | None = None,
    ) -> NDArray[Any]:
        """Raw spectra, each addressed by its realisation index alone.

        Parameters
        ----------
        expectation : Expectation
        start, count : int
            Realisations start to start + count - 1.
        seed : int
            0 to 2**64 - 1.
        mode : {"auto", "frames", "stacked"}
        processes : Processes
        recipe : {"auto", "joint", "apart"}
            See `scene.prepare`.
        first_frame : int
            Where frames are counted from: one frame k of an exposure is drawn with an expectation of one frame and
            ``first_frame=k``.
        out : ndarray, shape (count, n_pixel), optional
            Where to write, contiguous and of the type below.

        Returns
        -------
        ndarray of uint16 or int32, shape (count, n_pixel)
            Raw DN, summed over the exposure's frames: 16 bits where it is one frame of a 16-bit ADC.

        Raises
        ------
        InputError
            For an impossible range, seed or mode.
        """
        return self.realise_and_count(
            expectation,
            start=start,
            count=count,
            seed=seed,
            mode=mode,
            processes=processes,
            recipe=recipe,
            first_frame=first_frame,
            out=out,
        )[0]

    def realise_and_count(
        self,
        expectation: Expectation,
        *,
        start: int = 0,
        count: int,
        seed: int,
        mode: Mode = "auto",
        processes: Processes = NONE,
        recipe: Recipe = "auto",
        first_frame: int = 0,
        out: NDArray[Any] | None = None,
    ) -> tuple[NDArray[Any], NDArray[np.uint32]]:
        """`realise`, with the number of clipped samples of each realisation: pixels times frames that met a rail.

        Returns
        -------
        raw : ndarray of uint16 or int32, shape (count, n_pixel)
        clipped : ndarray of uint32, shape (count,)
        """
        self._check(start, count, seed)
        scene = prepare([expectation], mode, processes=processes, recipe=recipe, first_frame=first_frame)
        narrow = scene.n_frames == 1 and expectation.adc_max_dn < 2**16
        shape, dtype = (count, scene.n_pixel), np.dtype(np.uint16 if narrow else np.int32)
        if scene.n_frames * expectation.adc_max_dn >= 2**31:
            raise InputError(
                f"{scene.n_frames} frames of up to {expectation.adc_max_dn} DN overflow 32 bits, "
                f"expected at most {2**31 // expectation.adc_max_dn} frames"
            )
        if out is None:
            out = np.empty(shape, dtype)
        elif out.shape != shape or out.dtype != dtype or not out.flags.c_contiguous or not out.flags.writeable:
            raise InputError(
                f"out is {out.dtype} of shape {out.shape}, expected writable contiguous {dtype} of {shape}"
            )
        clipped = np.empty(count, np.uint32)
        rows = out

        def work(run: Run, tile: Tile, done: int) -> None:
            there = slice(done, done + tile.wanted)
            clipped[there] = run.realise(tile, rows[there])

        with self._scene(scene, seed, row_type="ushort" if narrow else "int") as run:
            self._over(start, count, scene.n_pixel * dtype.itemsize, lambda tile, done: work(run, tile, done))
        return out, clipped

    def snr(
        self,
        expectation: Expectation,
        *,
        realisations: int,
        seed: int,
        mode: Mode = "auto",
        start: int = 0,
        processes: Processes = NONE,
        recipe: Recipe = "auto",
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
        processes : Processes
        recipe : {"auto", "joint", "apart"}
            See `scene.prepare`.

        Raises
        ------
        InputError
            For an impossible number, seed or mode.
        """
        request = SnrRequest(expectation, realisations, seed, mode, start, processes, recipe)
        sums = SnrSums(request)
        sums.add(0, packed_snr(self._snr(request, Share(0, start, realisations))))
        return sums.answer()

    def count(self, request: Countable, share: Share, *, out: NDArray[Any] | None = None) -> Arrays:
        """What a share of a request comes to, as `sums` adds it up.

        Parameters
        ----------
        request : DetectRequest, SnrRequest or RealiseRequest
        share : Share
            `shards.shares` cuts requests into them.
        out : ndarray, optional
            As for `realise`.

        Returns
        -------
        dict of str to ndarray
            Raw spectra as ``rows``.
        """
        match request:
            case DetectRequest():
                return packed_detection(*self._detection(request, share))
            case SnrRequest():
                return packed_snr(self._snr(request, share))
            case RealiseRequest():
                rows = self.realise(
                    request.expectation,
                    start=share.start,
                    count=share.count,
                    seed=request.seed,
                    mode=request.mode,
                    processes=request.processes,
                    recipe=request.recipe,
                    first_frame=request.first_frame,
                    out=out,
                )
                return {"rows": rows}

    def _snr(self, request: SnrRequest, share: Share) -> Counts:
        self._check(share.start, share.count, request.seed)
        scene, observed = request.scene, elements(request.expectation)
        counts = Counts(scene.n_pixel, len(observed))
        with self._scene(scene, request.seed) as run:
            run.observe(observers(request.expectation, scene), observed)
            self._over(share.start, share.count, 0, lambda tile, done: run.histogram(tile, counts))
            run.flush_counts(counts)
        return counts

    def detect(
        self,
        quiet: Expectation,
        flares: Sequence[Expectation],
        *,
        realisations: int,
        seed: int,
        statistics: Sequence[str | Linear] = USUAL_STATISTICS,
        mode: Mode = "auto",
        start: int = 0,
        processes: Processes = NONE,
        recipe: Recipe = "auto",
        comparison: Comparison = TEMPLATE,
        tails: Tails = "counted",
        nuisances: Nuisances | Mapping[str, float] | None = None,
    ) -> Detection:
        """Null and flare distributions of detection statistics, all on common draws (METHODS section 6).

        Parameters
        ----------
        quiet : Expectation
            The star without a flare; its mean is the template.
        flares : sequence of Expectation
            The same star, instrument and exposure with flares; without any only the null is drawn.
        realisations : int
            Of each scenario.
        seed : int
            0 to 2**64 - 1.
        statistics : sequence of str or Linear
            Names of `statistics.STATISTICS`, and statistics of one's own.
        mode : {"auto", "frames", "stacked"}
        start : int
            First realisation.
        processes : Processes
        recipe : {"auto", "joint", "apart"}
            See `scene.prepare`.
        comparison : Comparison
            What is subtracted, and by whose variances; the template and the model's by default.
        tails : {"counted", "sampled"}
            Thresholds beyond what is drawn: refused, or by importance sampling (`tails.tail`).
        nuisances : Nuisances or mapping of str to float, optional
            What the statistics are marginalised over: standard deviations by name (`nuisances.NUISANCES`), infinite for
            what is projected out.

        Raises
        ------
        InputError
            For an unknown statistic, scenarios that do not belong together, or an impossible number, seed or mode.
        """
        how = (mode, start, processes, recipe, comparison, tails, nuisances)
        request = DetectRequest(quiet, tuple(flares), realisations, seed, statistics, *how)
        sums, total = DetectionSums(request), request.parts * realisations
        for part in range(request.parts):
            share = Share(part, start, realisations)
            sums.add(part, packed_detection(*self._detection(request, share, before=part * realisations, total=total)))
        return sums.answer()

    def _detection(
        self, request: DetectRequest, share: Share, *, before: int = 0, total: int | None = None
    ) -> tuple[Tally, list[TailSamples | None]]:
        self._check(share.start, share.count, request.seed)
        plan, scene = request.plans[share.part]
        tally, samples = Tally(plan.grids), plan.tails()

        def work(run: Run, tile: Tile, done: int) -> None:
            run.statistics(tile)
            run.tally(tile, tally)
            for grid, kept in zip(tally.grids, samples, strict=True):
                if kept is not None:
                    kept.add(run.channel(tile, grid.channel), share.start + done)

        with self._statistics(scene, request.seed, plan, request.hypotheses) as run:
            each = 4 * plan.n_rows
            self._over(
                share.start, share.count, each, lambda tile, done: work(run, tile, done), before=before, total=total
            )
            run.flush(tally)
        return tally, samples

    def statistic_values(
        self,
        quiet: Expectation,
        flares: Sequence[Expectation],
        *,
        start: int = 0,
        count: int,
        seed: int,
        statistics: Sequence[str | Linear] = USUAL_STATISTICS,
        mode: Mode = "auto",
        processes: Processes = NONE,
        recipe: Recipe = "auto",
        comparison: Comparison = TEMPLATE,
        nuisances: Nuisances | Mapping[str, float] | None = None,
    ) -> NDArray[np.float32]:
        """What `detect` counts, realisation by realisation, for up to 15 flares (7 drawn frame by frame).

        Parameters
        ----------
        quiet, flares, seed, statistics, mode, processes, recipe, comparison, nuisances
            As for `detect`.
        start, count : int
            Realisations start to start + count - 1.

        Returns
        -------
        ndarray of float32, shape (n_channel, count)
            For each scenario chi2, chi2_element and chi2_pair, zero where not asked for; then the linear ones, scenario
            by scenario: ``matched`` (without a flare for each flare's template) and the others in the order asked for,
            among them the sums that a marginalised chi2 takes away; then ``paper``, as ``matched``.

        Raises
        ------
        InputError
            As `detect`, and for more flares than one launch holds.
        """
        self._check(start, count, seed)
        scene = prepare([quiet, *flares], mode, processes=processes, recipe=recipe, comparison=comparison)
        if len(flares) >= BATCH[scene.frames]:
            raise InputError(f"{len(flares)} flares, expected at most {BATCH[scene.frames] - 1} in one launch")
        asked = Hypotheses(quiet, tuple(flares), statistics, scene, nuisances=known(nuisances, quiet))
        plan = plan_channels(asked, range(len(flares)), first=True)
        out = np.empty((plan.n_rows, count), np.float32)

        def work(run: Run, tile: Tile, done: int) -> None:
            run.statistics(tile)
            out[:, done : done + tile.wanted] = run.values(tile)

        with self._statistics(scene, seed, plan, asked) as run:
            self._over(start, count, 4 * plan.n_rows, lambda tile, done: work(run, tile, done))
        return out

    def _statistics(self, scene: Scene, seed: int, plan: ChannelPlan, asked: Hypotheses) -> Run:
        bands, finished = np.zeros((1, 0, 1), np.float32), np.zeros(1, np.uint32)
        if len(plan.scales):
            bands, finished = Paper().smoothing(asked.setting).bands(len(scene.pixels), self.variant.chunk)
        sums = {asked.statistic(name).kernel_sum for name in asked.statistics}
        run = self._scene(
            scene,
            seed,
            pair="chi2_pair" in sums,
            elements="chi2_element" in sums,
            linears=len(plan.weights),
            smooths=len(plan.scales),
            slots=bands.shape[1],
        )
        run.weigh(plan.weights, plan.linear_end)
        if plan.subtractions.size:
            run.marginalise(plan.subtractions)
        if run.variant.compared:
            run.compare(bands, finished, plan.scales, plan.scale_end)
        return run

    @property
    def variant(self) -> Variant:
        """How kernels are rendered for this device, whatever the scene."""
        return Variant(width=self._width, vector_forms=self._vector_forms, chunk=PIXEL_BLOCK if self._width > 1 else 4)

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

    def _over(
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
        size = self._tile_size(bytes_each)
        done = 0
        if self._progress is not None and not before:
            self._progress(0, count if total is None else total)
        while done < count:
            tile = self._tile_at(start + done, count - done, size)
            try:
                work(tile, done)
            except self.cl.Error as error:
                if not program.out_of_memory(error):
                    raise
                if size <= self._step:
                    raise DeviceError(
                        f"{self.device_name} has too little memory for {self._step} realisations of it: {error}"
                    ) from error
                size //= 2
                continue
            done += tile.wanted
            if self._progress is not None:
                self._progress(before + done, count if total is None else total)

    def _tile_size(self, bytes_each: int) -> int:
        """Realisations in a tile: a power of two, from the device's memory and what each needs."""
        memory = min(TILE_BYTES, self.device.global_memory // 8)
        fit = memory // bytes_each if bytes_each else LARGEST_TILE
        size = min(self._tile or LARGEST_TILE, LARGEST_TILE, max(fit, 1))
        return int(max(1 << (size.bit_length() - 1), self._step))

    def _tile_at(self, index: int, left: int, size: int) -> Tile:
        """The tile that `index` lies in, cut at multiples of its size, so that none crosses a multiple of 2**32."""
        first = index - index % size
        start, stop = index - first, min(index - first + left, size)
        # A short tile computes only the vectors it needs.
        skip = start - start % self._step
        need = -(-stop // self._step) * self._step
        return Tile(first + skip, need - skip, start - skip, stop - skip)

    def kernel(self, rooms: tuple[str, ...], variant: Variant, name: str) -> Any:
        """A kernel of the built program of some templates; both are made once."""
        source = program.render(rooms, variant)
        if source not in self._programs:
            self._programs[source] = program.build(self.context, source)
        if (source, name) not in self._kernels:
            self._kernels[source, name] = self.cl.Kernel(self._programs[source], name)
        return self._kernels[source, name]

    def _scene(
        self,
        scene: Scene,
        seed: int,
        *,
        pair: bool = False,
        elements: bool = True,
        linears: int = 0,
        smooths: int = 0,
        slots: int = 0,
        row_type: str = "int",
    ) -> Run:
        variant = replace(
            self.variant,
            scenarios=BATCH[scene.frames],
            linears=_room_for(linears),
            frames=scene.frames,
            clip=scene.clip,
            pair=pair,
            noisy=scene.comparison.exposures > 0,
            estimated=scene.comparison.estimated,
            smooths=_room_for(smooths),
            slots=slots,
            elements=elements,
            joint=scene.joint,
            quartic=scene.quartic,
            photons=scene.photons,
            cosmic=scene.cosmic,
            modulations=scene.modulations,
            row_type=row_type,
        )
        alone = self._width == 1 or scene.frames or variant.compared
        return Run(self, scene, replace(variant, vectors=1 if alone else VECTORS), seed)


def _room_for(count: int) -> int:
    """Room in a kernel for so many statistics: a power of two, so that few programs are built."""
    return max(32, 1 << (count - 1).bit_length()) if count else 0
