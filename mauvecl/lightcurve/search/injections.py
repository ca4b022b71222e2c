"""Injections: flares put into drawn frames, and the smallest amplitude at which the search finds each.

A template's value is a + A b + sqrt(A) c for a flare of amplitude A: a from the noise without it, b from its mean, c
from its own photons. Templates are found for all A above the root, so that one pass over the templates gives, for one
draw of all noise, the amplitude from which on the flare is found, and with it every amplitude of a map. All half-widths
and amplitudes share their draws.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.lightcurve.search.search import Search
from mauvecl.lightcurve.search.survey import part_of
from mauvecl.lightcurve.stares.components import STEADY

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.survey import Survey

Float = NDArray[np.float64]
Single = NDArray[np.float32]

#: Draws at once.
BLOCK = 128
#: Second half of the generator's key: draws of injections are no others.
INJECT_KEY = 0x696E6A65
#: A template counts as finding a flare if it finds this share of the S/N that the best one does.
OVERLAP = 0.3
#: Half-widths by which templates may differ from a flare's, and templates before and after its peak that are tried.
WIDEST, BEFORE, AFTER = 10.0, 3.0, 5.0
#: Half-widths after a flare's peak beyond which its photons' noise is left out; its light is not.
GLOW = 15.0


@dataclass(frozen=True, eq=False)
class Place:
    """A flare's half-width and time in a stare, and the templates that can find it.

    Attributes
    ----------
    half_width_s, peak_s : float
    frames : ndarray of int, shape (n,)
        Of the stare, to which templates reach.
    filters : ndarray of float32, shape (n_filter, n)
        What the value of each template weighs frames with: times a row of the bank's directions, summed.
    mean : ndarray of float32, shape (n,)
        The flare's mean in these frames for an amplitude of one.
    widths_s, peaks_s, per_amplitude : ndarray, shape (n_filter,)
        The templates' own.
    found : ndarray of bool, shape (n_temperature, n_filter)
        Those that count as finding it.
    """

    half_width_s: float
    peak_s: float
    frames: NDArray[np.int64]
    filters: Single
    mean: Single
    widths_s: Float
    peaks_s: Float
    per_amplitude: Float
    found: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Injections:
    """Flares of one temperature and some half-widths in a searched stare.

    Attributes
    ----------
    survey : Survey
    flare : int
        Which of the components' flare spectra.
    half_widths_s : tuple of float
    threshold : float
    temperature_k : float
        Of the flare.
    seed : int
    positions : int
        Times of peaks, evenly spread over the recorded frames, at random in each part.
    draws : int
        Of each position.
    """

    survey: Survey
    flare: int
    half_widths_s: tuple[float, ...]
    threshold: float
    temperature_k: float
    seed: int
    positions: int
    draws: int

    def __post_init__(self) -> None:
        if not self.half_widths_s or not all(np.isfinite(w) and w > 0 for w in self.half_widths_s):
            raise InputError(f"half-widths of injections {list(self.half_widths_s)} s, expected times above 0")
        if self.positions < 1 or self.draws < 1:
            raise InputError(f"{self.positions} x {self.draws} injections, expected at least one of each")

    @cached_property
    def peaks_s(self) -> Float:
        """Times of the peaks, s, shape (n_position,)."""
        rng = np.random.Generator(np.random.Philox(key=[self.seed % 2**64, INJECT_KEY], counter=[0, 0, 0, 2**63]))
        stare = self.survey.stare
        along = (np.arange(self.positions) + rng.random(self.positions)) / self.positions * stare.n_frames
        frame = np.minimum(along.astype(np.int64), stare.n_frames - 1)
        return np.asarray(stare.start_s[frame] + (along - frame) * stare.frame_s)

    @cached_property
    def response(self) -> Float:
        """Mean sums of a flare of one amplitude in a frame, shape (n_sum,)."""
        unit = np.zeros(len(STEADY) + self.survey.components.n_flares)
        unit[:3] = 1.0
        unit[len(STEADY) + self.flare] = 1.0
        return self.survey.components.means(unit)

    @cached_property
    def photons(self) -> Float:
        """Root of the covariance that a flare of one amplitude adds to a frame's sums, shape (n_sum, n_sum)."""
        with_it, without = np.zeros((2, len(STEADY) + self.survey.components.n_flares))
        with_it[len(STEADY) + self.flare] = 1.0
        covariance = self.survey.components.covariance(with_it) - self.survey.components.covariance(without)
        values, vectors = np.linalg.eigh(covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    @cached_property
    def noise(self) -> Single:
        """Cholesky factors of each frame's covariance, but for light's jitter, shape (n_frame, n_sum, n_sum)."""
        return np.linalg.cholesky(self.survey.covariance(jittered=("sky", "temperature"))).astype(np.float32)

    def places(self, position: int) -> list[Place]:
        """Every half-width at one of the peaks."""
        return [self._place(width, float(self.peaks_s[position])) for width in self.half_widths_s]

    def _place(self, width: float, peak_s: float) -> Place:
        survey, bank = self.survey, self.survey.bank
        stare, frame_s = survey.stare, bank.frame_s
        near = [w for w in bank.half_widths_s if width / WIDEST <= w <= width * WIDEST]
        if not near:
            near = [min(bank.half_widths_s, key=lambda w: abs(np.log(w / width)))]
        bank = replace(bank, half_widths_s=tuple(near))
        widest = bank.templates[-1]
        before = BEFORE * near[-1] + width - widest.first * frame_s
        after = AFTER * max(width, near[-1]) + (widest.first + widest.time.size) * frame_s
        first, last = np.searchsorted(stare.start_s, [peak_s - before, peak_s + after])
        part = slice(int(first), int(last))
        curves = None if survey.curves is None else survey.curves[:, part]
        search = Search(bank, part_of(stare, part), curves, survey.variance[part])
        start = stare.start_s[part]
        edges = np.column_stack([start, start + frame_s])
        mean = stare.light[part] * bank.shape.mean_over(edges, peak_s, width)
        reach = (BEFORE * near[-1] + width, AFTER * max(width, near[-1]))
        chosen: list[tuple[Any, int, Float]] = []
        sums = (mean[:, None] * self.response).astype(np.float32)
        length = float(np.linalg.norm(self.response))
        for row, rho in search.values(sums[None]):
            times = (search.stare.numbers[0] + row.peaks + row.template.phases[row.phase]) * frame_s
            inside = (times >= peak_s - reach[0]) & (times <= peak_s + reach[1])
            values = np.where(inside, rho[0], -np.inf) / length
            chosen += [(row, int(k), values[:, k]) for k in np.flatnonzero(values.max(axis=0) > 0)]
        values = np.array([v for _, _, v in chosen]).reshape(len(chosen), len(bank.directions))
        counts = values >= OVERLAP * values.max() if len(chosen) else values > 0
        kept = np.flatnonzero(counts.any(axis=1))
        filters = np.array([search.in_time(chosen[k][0], chosen[k][1]) for k in kept], np.float32)
        filters = filters.reshape(len(kept), start.size)
        used = np.flatnonzero(filters.any(axis=0))
        ends = slice(int(used[0]), int(used[-1]) + 1) if used.size else slice(0, 0)
        return Place(
            width,
            peak_s,
            np.arange(part.start, part.stop)[ends],
            np.ascontiguousarray(filters[:, ends]),
            mean[ends].astype(np.float32),
            np.array([chosen[k][0].template.half_width_s for k in kept]),
            np.array([self._time(search, *chosen[k][:2]) for k in kept]),
            np.array([chosen[k][0].per_amplitude[chosen[k][1]] for k in kept]),
            counts[kept].T,
        )

    @staticmethod
    def _time(search: Search, row: Any, onset: int) -> float:
        number = search.stare.numbers[0] + row.peaks[onset] + row.template.phases[row.phase]
        return float(number * search.bank.frame_s)

    def blocks(self) -> list[tuple[int, int, int]]:
        """Parts of the work: position, first draw, draws."""
        cuts = range(0, self.draws, BLOCK)
        return [(p, k, min(BLOCK, self.draws - k)) for p in range(self.positions) for k in cuts]

    def draw(self, position: int, first: int, count: int, frames: NDArray[np.int64]) -> Drawn:
        """Everything random in some frames, by position and draw: the same whatever the half-width or amplitude."""
        survey = self.survey
        key = [self.seed % 2**64, INJECT_KEY]
        rng = np.random.Generator(np.random.Philox(key=key, counter=[0, 0, first, position]))
        stare, n_sum = survey.stare, survey.components.n_statistics
        shape = (n_sum, count, frames.size)
        unknown = rng.standard_normal((count, len(stare.unknowns)))
        noise = rng.standard_normal(shape, np.float32)
        own = rng.standard_normal(shape, np.float32)
        low = self.noise[frames]
        mixed = np.empty_like(noise)
        for k in range(n_sum):
            mixed[k] = sum(noise[j] * low[:, k, j] for j in range(k + 1))
        light = None
        if stare.light_jitter > 0:
            light = np.float32(stare.light_jitter) * rng.standard_normal(shape[1:], np.float32)
        for z, one in zip(unknown.T, stare.unknowns, strict=True):
            moved = one.sd * z[:, None] * one.curve[frames]
            if one.of == "light":
                light = moved.astype(np.float32) if light is None else light + moved.astype(np.float32)
            elif one.of == "temperature":
                # The dark's law to all orders.
                slope = survey.components.quiet.conditions["dark_slope_per_c"]
                mixed += _along(np.expm1(slope * moved) / slope, survey.directions[one.of][frames])
            else:
                mixed += _along(moved, survey.directions[one.of][frames])
        if light is not None:
            mixed += _along(light, survey.directions["light"][frames])
        return Drawn(mixed, own, light)

    def critical(self, places: list[Place], position: int, first: int, count: int) -> Single:
        """Amplitude from which on each flare is found, shape (n_half_width, count).

        Infinite if no template fits into what is observed; zero where there is an alarm without it.
        """
        frames = self.frames(places)
        drawn = self.draw(position, first, count, frames)
        critical = np.full((len(places), count), np.inf, np.float32)
        for row, place in zip(critical, places, strict=True):
            if len(place.filters):
                row[:] = self._critical(place, self.values(place, drawn.within(frames, place.frames)))
        return critical

    @staticmethod
    def frames(places: list[Place]) -> NDArray[np.int64]:
        """Frames that any of the places needs."""
        return np.unique(np.concatenate([place.frames for place in places]))

    def best(self, place: Place, drawn: Drawn, amplitudes: Float) -> tuple[Float, NDArray[np.int64], NDArray[np.int64]]:
        """The largest value among the templates that count, and which: arrays (n_amplitude, n_draw).

        Parameters
        ----------
        place : Place
        drawn : Drawn
            Of the place's frames.
        amplitudes : ndarray, shape (n_amplitude,)

        Returns
        -------
        value, temperature, template : ndarray
        """
        a, b, c = self.values(place, drawn)
        values = np.array([a + x * b + np.sqrt(x) * c for x in amplitudes.astype(np.float32)])
        values[:, ~place.found[:, None].repeat(a.shape[1], axis=1)] = -np.inf
        flat = np.moveaxis(values, 2, 1).reshape(len(amplitudes), a.shape[1], -1)
        which = flat.argmax(axis=2)
        largest = np.take_along_axis(flat, which[:, :, None], axis=2)[:, :, 0]
        temperature, template = np.divmod(which, a.shape[2])
        return largest.astype(np.float64), temperature, template

    def sums(self, place: Place, drawn: Drawn, amplitudes: Float) -> Single:
        """Frames with the flare, less what is known of them, shape (n_amplitude, n_draw, n_frame, n_sum)."""
        mean = np.atleast_2d(place.mean if drawn.light is None else place.mean * (1 + drawn.light))
        glow = np.sqrt(np.maximum(place.mean, 0))
        own = np.einsum("kj,jmt->mtk", self.photons.astype(np.float32), drawn.own * glow)
        rise = mean[:, :, None] * self.response.astype(np.float32)
        noise = np.moveaxis(drawn.noise, 0, 2)
        return np.asarray([noise + x * rise + np.sqrt(x) * own for x in amplitudes.astype(np.float32)])

    def values(self, place: Place, drawn: Drawn) -> tuple[Single, Single, Single]:
        """a, b and c of the module's formula, shapes (n_temperature, n_draw or 1, n_filter)."""
        directions = self.survey.bank.directions
        filters = place.filters.T
        noise = _combined(directions, drawn.noise @ filters)
        along = (directions @ self.response).astype(np.float32)
        mean = place.mean if drawn.light is None else place.mean * (1 + drawn.light)
        rise = along[:, None, None] * (np.atleast_2d(mean) @ filters)[None]
        scale = self.survey.bank.frame_s
        start = self.survey.stare.start_s[place.frames]
        shining = (start > place.peak_s - place.half_width_s - scale) & (
            start < place.peak_s + GLOW * place.half_width_s
        )
        ends = np.flatnonzero(shining)[[0, -1]] if shining.any() else np.array([0, -1])
        lit = slice(int(ends[0]), int(ends[1]) + 1)
        glow = np.sqrt(np.maximum(place.mean[lit], 0))
        own = _combined(directions @ self.photons, (drawn.own[:, :, lit] * glow) @ filters[lit])
        return noise, rise, own

    def _critical(self, place: Place, values: tuple[Single, Single, Single]) -> Single:
        a, b, c = values
        left = np.float32(self.threshold) - a
        # The root of b x^2 + c x = left, in the form that keeps its digits; zero where there is an alarm without it.
        root = np.multiply(left, 4 * b)
        root += c * c
        np.sqrt(np.maximum(root, 0, out=root), out=root)
        root += c
        with np.errstate(divide="ignore", invalid="ignore"):
            np.divide(2 * left, root, out=root)
        root[~((b > 0) & place.found[:, None]).repeat(root.shape[1] // b.shape[1], axis=1)] = np.inf
        np.copyto(root, 0, where=(left <= 0) & place.found[:, None])
        return np.asarray(root.min(axis=(0, 2)) ** 2)


@dataclass(frozen=True, eq=False)
class Drawn:
    """Everything random in some frames.

    Attributes
    ----------
    noise : ndarray of float32, shape (n_sum, n_draw, n_frame)
        Of the sums without a flare, and what is unknown of the stare.
    own : ndarray of float32, shape (n_sum, n_draw, n_frame)
        Standard normal, for the flare's photons.
    light : ndarray of float32, shape (n_draw, n_frame), optional
        Relative change of all light, where there is any.
    """

    noise: Single
    own: Single
    light: Single | None

    def first(self, count: int) -> Drawn:
        """The first draws alone."""
        return Drawn(self.noise[:, :count], self.own[:, :count], None if self.light is None else self.light[:count])

    def within(self, held: NDArray[np.int64], wanted: NDArray[np.int64]) -> Drawn:
        """The same in some of the frames that it holds, which follow each other."""
        first = int(np.searchsorted(held, wanted[0]))
        part = slice(first, first + wanted.size)
        light = None if self.light is None else self.light[:, part]
        return Drawn(self.noise[:, :, part], self.own[:, :, part], light)


def _along(amount: Any, direction: Float) -> Single:
    """Amounts (n_draw, n_frame) along directions (n_frame, n_sum), shape (n_sum, n_draw, n_frame)."""
    return np.asarray(amount[None] * direction.T[:, None], np.float32)


def _combined(rows: Float, values: Single) -> Single:
    """Sums over the first axis of values (n_sum, n_draw, n_filter), shape (n_row, n_draw, n_filter)."""
    flat = values.reshape(values.shape[0], -1)
    return np.asarray((rows.astype(np.float32) @ flat).reshape(len(rows), *values.shape[1:]))
