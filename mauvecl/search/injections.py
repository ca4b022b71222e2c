"""Injection of flares into simulated frames, their sites, and the accuracy of fits to them.

Each injected flare is fitted alone, from the template that detected it, with standard errors from the curvature.
Flares that `stare` detects are fitted together and have intervals from the profile likelihood (`alarms`), which have
better coverage near the threshold.

The statistic of a template is a + A b + sqrt(A) c for a flare of amplitude A: a follows from simulated frames without
the flare, b from its mean, and c from its photon noise. The flare is detected for all A above the root, so that one
pass over the templates gives the critical amplitude of each realisation, and thereby the completeness at every
amplitude. All half-widths and amplitudes share their realisations.

The photon noise of the flare is approximated as normal; its skewness is small as long as flares add few photons.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mauvecl.flares.frames import STEADY, Components
from mauvecl.flares.stare import select_frames
from mauvecl.flares.stare_scene import Method, StaresRequest, method_for
from mauvecl.host.arrays import Float
from mauvecl.noise.unknowns import Processes
from mauvecl.schema.columns import Column
from mauvecl.search.search import Bank, Search
from mauvecl.search.survey import WIDTH, FittedFlares, SearchedFrames, SummedStare, Survey

#: Quantities of each fit: ratios of fitted to injected values, the peak offset in half-widths, and whether the
#: equivalent duration is within its standard error.
FIT_QUANTITIES = ("energy", "amplitude", "half_width", "temperature", "peak", "covered")

#: Columns of the accuracy of fits, for values by name.
ACCURACY_COLUMNS = (
    Column("fitted", description="flares that were found and fitted"),
    Column("energy_ratio", description="recovered over injected energy, median of those found"),
    Column("energy_ratio_low", description="the same, 16 % quantile"),
    Column("energy_ratio_high", description="the same, 84 % quantile"),
    Column("amplitude_ratio", description="recovered over injected amplitude, median"),
    Column("half_width_ratio", description="recovered over injected half-width, median"),
    Column("temperature_ratio", description="recovered over injected temperature, median"),
    Column("peak_offset", description="recovered less injected time of the peak, half-widths, median"),
    Column("peak_scatter", description="half of the range of the middle 68 % of it, half-widths"),
    Column("energy_covered", description="share of energies within their own standard error of the injected one"),
)


def fit_accuracy(parts: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, Float]:
    """Summarise the fits of all positions, arrays by `FIT_QUANTITIES` of shape (n_stare, n_half_width, n_size).

    Values of each cell, by the names of `ACCURACY_COLUMNS`, have the shape (n_half_width, n_size); NaN without
    detections.
    """
    ratios = {name: np.moveaxis(np.concatenate([part[name] for part in parts]), 0, 2) for name in FIT_QUANTITIES}
    # NumPy warns of cells without detections.
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        low, middle, high = (
            {name: np.nanquantile(values, q, axis=2) for name, values in ratios.items()} for q in (0.16, 0.5, 0.84)
        )
        covered = np.nanmean(ratios["covered"], axis=2)
    return {
        "fitted": np.isfinite(ratios["energy"]).sum(axis=2).astype(np.float64),
        "energy_ratio_low": low["energy"],
        "energy_ratio_high": high["energy"],
        **{f"{name}_ratio": middle[name] for name in ("energy", "amplitude", "half_width", "temperature")},
        "peak_offset": middle["peak"],
        "peak_scatter": (high["peak"] - low["peak"]) / 2,
        "energy_covered": covered,
    }


Single = NDArray[np.float32]

#: Smallest share of the best template's S/N for which a template counts as a detection.
OVERLAP = 0.3
#: Filters are multiples of this, so that sums are exact.
STEP = 2.0**-18
#: Largest ratio of half-widths of template and flare, and half-widths before and after the peak with templates.
WIDEST, BEFORE, AFTER = 10.0, 3.0, 5.0
#: Number of frames up to which the whole stare is searched; its search exists, and a part would hardly be smaller.
WHOLE = 20_000


@dataclass(frozen=True, eq=False)
class InjectionSite:
    """Site of an injected flare, which is a half-width and a time, with the templates that can detect it."""

    half_width_s: float
    peak_s: float
    first: int  # first frame of the stare that a template covers
    filters: Single  # weights of frames in the statistic of each template, shape (n_filter, n_frame)
    mean: Single  # mean of the flare in these frames at unit amplitude, shape (n_frame,)
    widths_s: Float  # half-widths of the templates, shape (n_filter,)
    peaks_s: Float  # peak times of the templates, shape (n_filter,)
    counts: NDArray[np.bool_]  # templates that count as a detection, shape (n_temperature, n_filter)

    @property
    def frames(self) -> slice:
        """Frames of the stare that templates cover."""
        return slice(self.first, self.first + self.mean.size)

    @cached_property
    def weights(self) -> Float:
        """Transposed filters in double precision, shape (n_frame, n_filter)."""
        return np.ascontiguousarray(self.filters.T, np.float64)


def sites_of(survey: Survey, widths_s: Sequence[float], peak_s: float) -> tuple[InjectionSite, ...]:
    """Return the sites of flares of several half-widths that peak at one time."""
    bank, ranges = survey.bank, [_template_range(survey.bank, width, peak_s) for width in widths_s]
    search, first = survey.search, 0
    if survey.stare.n_frames > WHOLE:
        # Only the frames that templates cover are searched; those of the widest flare reach farthest.
        farthest = ranges[int(np.argmax(widths_s))]
        lead, tail = (frames * bank.frame_s for frames in bank.window(farthest.half_widths_s[-1]))
        limits = farthest.first_peak_s - lead, farthest.last_peak_s + tail + bank.frame_s
        first, last = np.searchsorted(survey.stare.start_s, limits).tolist()
        tried = tuple(sorted({width for tried_range in ranges for width in tried_range.half_widths_s}))
        search = survey.frames.part(slice(first, last)).search(replace(bank, half_widths_s=tried))
    stare = search.stare
    edges = np.column_stack([stare.start_s, stare.start_s + bank.frame_s])
    means = np.array([stare.light * bank.shape.mean_over(edges, peak_s, width) for width in widths_s])
    detecting = _detecting_templates(search, ranges, means, bank.directions @ survey.response)
    # Flares of several half-widths share templates.
    places, index = np.unique(np.concatenate([site_places for site_places, _, _ in detecting]), return_inverse=True)
    numbers, onsets = np.divmod(places, search.n_grid)
    filters = np.empty((places.size, stare.n_frames), np.float32)
    for number in np.unique(numbers):
        in_row = numbers == number
        filters[in_row] = np.rint(search.in_time(search.grid[number], onsets[in_row]) / STEP) * STEP
    filter_widths_s = np.array([row.template.half_width_s for row in search.grid])[numbers]
    sites = []
    for width, mean, (site_places, peaks_s, counts) in zip(widths_s, means, detecting, strict=True):
        rows, index = np.split(index, [site_places.size])
        site_filters = filters[rows]
        used = np.flatnonzero(site_filters.any(axis=0))
        ends = slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0, 0)
        arrays = np.ascontiguousarray(site_filters[:, ends]), mean[ends].astype(np.float32), filter_widths_s[rows]
        sites.append(InjectionSite(width, peak_s, first + ends.start, *arrays, peaks_s, counts))
    return tuple(sites)


class TemplateRange(NamedTuple):
    """Templates that are tried for a flare."""

    half_widths_s: list[float]  # ascending
    first_peak_s: float
    last_peak_s: float


def _template_range(bank: Bank, width_s: float, peak_s: float) -> TemplateRange:
    """Return the templates of a bank that are tried for a flare."""
    near = [w for w in bank.half_widths_s if width_s / WIDEST <= w <= width_s * WIDEST]
    near = near or [min(bank.half_widths_s, key=lambda w: abs(np.log(w / width_s)))]
    return TemplateRange(near, peak_s - (BEFORE * near[-1] + width_s), peak_s + AFTER * max(width_s, near[-1]))


def _detecting_templates(
    search: Search, ranges: Sequence[TemplateRange], means: Float, along: Float
) -> list[tuple[NDArray[np.int64], Float, NDArray[np.bool_]]]:
    """Return the templates that may detect each flare, of those in its range.

    These are their rows in the search times `n_grid` plus their onsets, (n_template,), the times of their peaks, s,
    likewise, and whether they count as a detection, (n_temperature, n_template). `means` are the flares' shapes in the
    frames, (n_flare, n_frame), and `along` is their light along the bank's directions, (n_temperature,).
    """
    responding: list[list[tuple[NDArray[np.int64], Float, Float]]] = [[] for _ in ranges]
    # A flare's sums are the product of its shape and the response, so that one correlation serves all temperatures.
    for number, (row, correlated) in enumerate(search.correlations(means[:, :, None])):
        peaks = search.peaks_s(row)
        for templates, tried, value in zip(responding, ranges, correlated[:, 0], strict=True):
            if row.template.half_width_s in tried.half_widths_s:
                values = along[:, None] * value
                inside = (peaks >= tried.first_peak_s) & (peaks <= tried.last_peak_s) & (row.per_amplitude > 0)
                onsets = np.flatnonzero(inside & (values.max(axis=0) > 0))
                templates.append((number * search.n_grid + onsets, peaks[onsets], values[:, onsets]))
    detecting = []
    for templates in responding:
        places, times, values = (np.concatenate(part, axis=-1) for part in zip(*templates, strict=True))
        counts = values >= OVERLAP * values.max(initial=0)
        used = counts.any(axis=0)
        detecting.append((places[used], times[used], counts[:, used]))
    return detecting


#: Number of stares per batch.
BLOCK = 64
#: Frames and flare means are rounded to multiples of these, so that sums are exact in float64 and independent of the
#: machine; filters are rounded likewise.
NOISE_STEP, MEAN_STEP = 2.0**-11, 2.0**-20
#: Second half of the key of the random generator for peak times.
INJECT_KEY = 0x696E6A65
#: Stares of each peak start at another multiple of this, so that peaks have independent realisations.
NUMBERS = 2**32
#: Half-widths after the peak beyond which the photon noise of a flare is neglected.
GLOW = 15.0
#: Frames of a fit are averaged if at least this many averages remain per half-width.
FINE = 25


@dataclass(frozen=True, eq=False)
class Injections:
    """Flares of one temperature and several half-widths in a stare."""

    survey: Survey  # its components have the spectrum of the flares
    half_widths_s: tuple[float, ...]
    threshold: float
    seed: int
    positions: int  # number of peak times, stratified over the recorded frames
    draws: int  # realisations per position
    processes: Processes  # additive ones require frames that are drawn by pixel
    amplitudes: Float  # amplitudes of the flares that are fitted if they are detected, (n_half_width, n_amplitude)
    fitted: int  # number of realisations per position with fits, the first ones
    temperature_k: float  # temperature of the flares

    @cached_property
    def peaks_s(self) -> Float:
        """Times of the peaks, s, shape (n_position,)."""
        rng = np.random.Generator(np.random.Philox(key=[self.seed % 2**64, INJECT_KEY], counter=[0, 0, 0, 2**63]))
        stare = self.survey.stare
        along = (np.arange(self.positions) + rng.random(self.positions)) / self.positions * stare.n_frames
        frame = np.minimum(along.astype(np.int64), stare.n_frames - 1)
        return np.asarray(stare.start_s[frame] + (along - frame) * stare.frame_s)

    @property
    def saturates(self) -> float:
        """Amplitude at which the mean of a used pixel reaches saturation in a frame at the flare's peak."""
        components, light = self.survey.components, float(self.survey.stare.light.max())
        flare = light * components.mean_dn[len(STEADY)] * (components.weights != 0).any(axis=0)
        room = components.quiet.highest_dn - components.quiet.mean_raw_dn
        return float(np.min(room[flare > 0] / flare[flare > 0], initial=np.inf))

    @cached_property
    def quiescent(self) -> tuple[Components, Method]:
        """Components of the frames without flares, and the method of drawing them."""
        components = self.survey.components
        quiescent = replace(components, flare_electrons=components.flare_electrons[:0])
        return quiescent, method_for(quiescent, self.survey.stare, self.processes)

    def request(self, position: int) -> StaresRequest:
        """Return the request for the critical amplitudes at a peak time and fits of detected flares."""
        survey = self.survey
        sites = sites_of(survey, self.half_widths_s, float(self.peaks_s[position]))
        # Without templates, one frame is drawn, since requests cannot be empty.
        reached = [site.frames for site in sites if len(site.filters)] or [slice(0, 1)]
        first = min(part.start for part in reached)
        frames = survey.frames.part(slice(first, max(part.stop for part in reached)))
        start, (quiescent, method) = (1 + position) * NUMBERS, self.quiescent
        injecting = CriticalAmplitudes(
            survey=replace(survey, stare=frames.stare),
            sites=tuple(replace(site, first=site.first - first) for site in sites), threshold=self.threshold,
            frames=replace(frames, mean=frames.mean.astype(np.float32)), amplitudes=self.amplitudes,
            temperature_k=self.temperature_k, fits_before=start + self.fitted,
        )  # fmt: skip
        return StaresRequest(
            quiescent, frames.stare, self.draws, self.seed, start=start, method=method,
            processes=self.processes, reduction=injecting, glow=True,
        )  # fmt: skip


#: Random part of the frames of some stares: sums without a flare less their known mean, (n_sum, n_draw, n_frame);
#: standard normals for the photon noise of the flare, likewise; and the relative change of all light,
#: (n_draw, n_frame), or (1, n_frame) if there is none.
FrameNoise = tuple[Float, Single, Single]


@dataclass(frozen=True, eq=False)
class CriticalAmplitudes:
    """Reduction of stares to the critical amplitudes of flares at one peak time."""

    adds: ClassVar[bool] = False

    survey: Survey  # of the frames
    sites: tuple[InjectionSite, ...]  # in the frames
    threshold: float
    frames: SearchedFrames
    amplitudes: Float  # see `Injections.amplitudes`
    temperature_k: float
    fits_before: int  # number of the first stare without fits

    @cached_property
    def photons(self) -> Float:
        """Root of the covariance that a flare of unit amplitude adds to a frame's sums, shape (n_sum, n_sum)."""
        values, vectors = np.linalg.eigh(self.survey.response_noise)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    @cached_property
    def surveys(self) -> tuple[Survey, ...]:
        """Surveys of the frames of each site; that of all frames where no template detects the flare."""
        return tuple(
            replace(self.survey, stare=select_frames(self.survey.stare, site.frames))
            if len(site.filters)
            else self.survey
            for site in self.sites
        )

    def __call__(self, values: Single, first: int, glow: Single) -> dict[str, NDArray[Any]]:
        """Return the smallest detected amplitude of each flare, (n_stare, n_half_width), and the fits of some stares.

        It is infinite if no template covers the flare, and zero if there is an alarm without it.
        """
        critical = np.full((len(values), len(self.sites)), np.inf, np.float32)
        for begin in range(0, len(values), BLOCK):
            part = slice(begin, begin + BLOCK)
            drawn = self.frame_noise(values[part], glow[part])
            for column, site in zip(critical[part].T, self.sites, strict=True):
                if len(site.filters):
                    column[:] = self._critical(site, self.values(site, drawn))
        # Stares are processed one at a time, so that fits do not depend on the batch.
        fitted = max(0, min(len(values), self.fits_before - first))
        fits = {name: np.full((fitted, *self.amplitudes.shape), np.nan, np.float32) for name in FIT_QUANTITIES}
        for k in range(fitted):
            estimates = {name: fit[k] for name, fit in fits.items()}
            self._fit(self.frame_noise(values[k : k + 1], glow[k : k + 1]), estimates)
        return {"critical": critical, **fits}

    def frame_noise(self, values: Single, glow: Single) -> FrameNoise:
        """Prepare the random part of some stares."""
        n_sum = values.shape[2]
        noise = np.moveaxis(self.frames.net(values), 2, 0)
        normals, light = np.ascontiguousarray(np.moveaxis(glow[:, :, :n_sum], 2, 0)), glow[:, :, n_sum]
        return _multiple(noise, NOISE_STEP).astype(np.float64), normals, light if light.any() else light[:1]

    def values(self, site: InjectionSite, drawn: FrameNoise) -> tuple[Single, Single, Single]:
        """Return a, b and c of the module's formula, shapes (n_temperature, n_draw or 1, n_filter)."""
        (noise, normals, light), filters, frames = drawn, site.weights, site.frames
        mean, stare, width = site.mean * (1 + light[:, frames]), self.frames.stare, site.half_width_s
        since = stare.start_s[frames] - site.peak_s
        lit = slice(np.searchsorted(since, -width - stare.frame_s, "right"), np.searchsorted(since, GLOW * width))
        photons = normals[:, :, frames][:, :, lit] * np.sqrt(np.maximum(site.mean[lit], 0))
        directions = self.survey.bank.directions
        return (
            _combined(directions, noise[:, :, frames] @ filters),
            _combined((directions @ self.survey.response)[:, None], (_multiple(mean, MEAN_STEP) @ filters)[None]),
            _combined(directions @ self.photons, _multiple(photons, NOISE_STEP) @ filters[lit]),
        )

    def _critical(self, site: InjectionSite, values: tuple[Single, Single, Single]) -> Single:
        """Return the smallest detected amplitude in each draw, (n_draw,), from a, b and c of the module's formula."""
        a, b, c = values
        missing = np.float32(self.threshold) - a
        # Root of b x^2 + c x = missing in its numerically stable form; zero if there is an alarm without the flare.
        root = np.multiply(missing, 4 * b)
        root += c * c
        np.sqrt(np.maximum(root, 0, out=root), out=root)
        root += c
        with np.errstate(divide="ignore", invalid="ignore"):
            np.divide(2 * missing, root, out=root)
        root[~((b > 0) & site.counts[:, None]).repeat(root.shape[1] // b.shape[1], axis=1)] = np.inf
        np.copyto(root, 0, where=(missing <= 0) & site.counts[:, None])
        return np.asarray(root.min(axis=(0, 2)) ** 2)

    def _fit(self, drawn: FrameNoise, estimates: Mapping[str, Single]) -> None:
        """Fit the detected flares of one stare, and set their estimates, shape (n_half_width, n_amplitude) each."""
        noise, normals, light = (array[..., 0, :] for array in drawn)
        for d, (site, survey) in enumerate(zip(self.sites, self.surveys, strict=True)):
            if not len(site.filters):
                continue
            a, b, c = (term[:, 0] for term in self.values(site, drawn))
            # Sums of the frames, (n_frame, n_sum): noise, and what a flare of unit amplitude and its photons add.
            frames, shining = site.frames, np.sqrt(np.maximum(site.mean, 0))
            glow = np.einsum("kj,jt->tk", self.photons.astype(np.float32), normals[:, frames] * shining)
            rise = (site.mean * (1 + light[frames]))[:, None] * survey.response.astype(np.float32)
            for s, amplitude in enumerate(self.amplitudes[d].astype(np.float32)):
                values = np.where(site.counts, a + amplitude * b + np.sqrt(amplitude) * c, -np.inf)
                direction, template = np.unravel_index(int(values.argmax()), values.shape)
                if values[direction, template] < self.threshold:
                    continue
                sums = noise[:, frames].T + amplitude * rise + np.sqrt(amplitude) * glow
                kelvin = survey.templates.temperatures_k[survey.templates.chosen[direction]]
                size, width = values[direction, template] / b[direction, template], site.widths_s[template]
                start = np.array([[np.log(size), site.peaks_s[template], np.log(width), np.log(kelvin)]])
                comparison = self._comparison(site, self.amplitudes[d, s], _fitted(survey, sums, start))
                for name, values in comparison.items():
                    estimates[name][d, s] = values[0]

    def _comparison(self, site: InjectionSite, amplitude: float, fit: FittedFlares) -> dict[str, NDArray[Any]]:
        """Compare a fit with the injected flare; the keys are `FIT_QUANTITIES`."""
        duration = amplitude * site.half_width_s * self.survey.bank.shape.equivalent_duration
        return {
            "energy": fit.equivalent_duration_s / duration,
            "amplitude": fit.amplitude / amplitude,
            "half_width": fit.half_width_s / site.half_width_s,
            "temperature": fit.temperature_k / self.temperature_k,
            "peak": (fit.peak_s - site.peak_s) / site.half_width_s,
            "covered": np.abs(fit.equivalent_duration_s - duration) <= fit.equivalent_duration_error_s,
        }


def _fitted(survey: Survey, sums: Single, start: Float) -> FittedFlares:
    """Fit one flare to sums of frames less their mean, (n_frame, n_sum), from starting parameters, (1, 4)."""
    per_group = max(1, int(np.exp(start[0, WIDTH]) / survey.bank.frame_s / FINE))
    block = SummedStare(survey, sums.astype(np.float64)).block(start, per_group=per_group)
    best = block.fit(start)
    snr = np.sqrt(max(block.without(best, 0).chi2 - best.chi2, 0.0))
    covariance = block.covariance(best.theta)[:, :, 0].transpose(0, 2, 1)
    return FittedFlares.of(best.theta, covariance, survey, np.array([snr]))


def _multiple(values: Single, step: float) -> Single:
    """Round to multiples of a power of two."""
    values = values * np.float32(1 / step)
    return np.asarray(np.rint(values, out=values) * np.float32(step))


def _combined(rows: Float, values: Float) -> Single:
    """Multiply rows (n_row, n_sum) with values (n_sum, n_draw, n_filter), summing in a fixed order."""
    small = values.astype(np.float32)
    combined = np.empty((len(rows), *values.shape[1:]), np.float32)
    for row, out in zip(rows.astype(np.float32), combined, strict=True):
        np.multiply(row[0], small[0], out=out)
        for weight, value in zip(row[1:], small[1:], strict=True):
            out += weight * value
    return combined
