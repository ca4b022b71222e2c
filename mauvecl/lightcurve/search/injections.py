"""Injections: flares put into drawn frames, and the smallest amplitude at which the search finds each.

A template's value is a + A b + sqrt(A) c for a flare of amplitude A: a from the frames without it, as the engine draws
them, b from its mean, c from its own photons. Templates are found for all A above the root, so that one pass over the
templates gives, for one draw of all noise, the amplitude from which on the flare is found, and with it every amplitude
of a map. All half-widths and amplitudes share their draws.

The flare's own photons are taken for normal: their skewness is to that of the frame's other noise as their number is.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.lightcurve.search.places import Place, places_of
from mauvecl.lightcurve.search.recoveries import KEPT, Refit
from mauvecl.lightcurve.search.survey import net_of, part_of
from mauvecl.lightcurve.stares.components import STEADY, Components
from mauvecl.lightcurve.stares.requests import Method, StaresRequest
from mauvecl.lightcurve.stares.sums import method_for

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.survey import Survey
    from mauvecl.lightcurve.search.trend import Trend
    from mauvecl.noise.processes import CosmicRays

Float = NDArray[np.float64]
Single = NDArray[np.float32]

#: Stares that are looked at at once.
BLOCK = 64
#: Frames, and the mean of a flare, are multiples of these where filters weigh them, and filters of `places.STEP`: few
#: enough bits for sums that are exact in float64, and so the same on every machine.
NOISE_STEP, MEAN_STEP = 2.0**-11, 2.0**-20
#: Second half of the key of the generator that places peaks.
INJECT_KEY = 0x696E6A65
#: Stares of one peak are numbered from the next multiple of this on: no others have these draws.
NUMBERS = 2**32
#: Half-widths after a flare's peak beyond which its photons' noise is left out; its light is not.
GLOW = 15.0


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
    seed : int
    positions : int
        Times of peaks, evenly spread over the recorded frames, at random in each part.
    draws : int
        Of each position.
    cosmic_rays : CosmicRays, optional
        In frames that are then drawn pixel by pixel.
    """

    survey: Survey
    flare: int
    half_widths_s: tuple[float, ...]
    threshold: float
    seed: int
    positions: int
    draws: int
    cosmic_rays: CosmicRays | None = None

    def __post_init__(self) -> None:
        if not self.half_widths_s or not all(np.isfinite(w) and w > 0 for w in self.half_widths_s):
            raise InputError(f"half-widths of injections {list(self.half_widths_s)} s, expected times above 0")
        if self.positions < 1 or not 1 <= self.draws <= NUMBERS:
            raise InputError(
                f"{self.positions} x {self.draws} injections, expected at least one of each and at most {NUMBERS} draws"
            )

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

    @property
    def saturates(self) -> float:
        """Amplitude at which the mean of a used pixel reaches saturation in a frame at the flare's peak."""
        components, light = self.survey.components, float(self.survey.stare.light.max())
        flare = light * components.mean_dn[len(STEADY) + self.flare] * (components.weights != 0).any(axis=0)
        room = components.quiet.highest_dn - components.quiet.mean_raw_dn
        return float(np.min(room[flare > 0] / flare[flare > 0], initial=np.inf))

    @cached_property
    def photons(self) -> Float:
        """Root of the covariance that a flare of one amplitude adds to a frame's sums, shape (n_sum, n_sum)."""
        with_it, without = np.zeros((2, len(STEADY) + self.survey.components.n_flares))
        with_it[len(STEADY) + self.flare] = 1.0
        covariance = self.survey.components.covariance(with_it) - self.survey.components.covariance(without)
        values, vectors = np.linalg.eigh(covariance)
        return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))

    @cached_property
    def quiescent(self) -> Components:
        """What frames are drawn of."""
        components = self.survey.components
        return Components(components.quiet, components.flare_electrons[:0], components.weights)

    @cached_property
    def method(self) -> Method:
        """How frames are drawn."""
        return method_for(self.quiescent, self.survey.stare, self.cosmic_rays)

    def places(self, position: int) -> tuple[Place, ...]:
        """Every half-width at one of the peaks."""
        return places_of(self.survey, self.half_widths_s, float(self.peaks_s[position]), self.response)

    def request(self, position: int, refit: Refit | None = None) -> StaresRequest:
        """The stares with flares at one of the peaks, what is found in them, and fits of the first ones.

        Parameters
        ----------
        position : int
        refit : Refit, optional
        """
        survey = self.survey
        places = self.places(position)
        reached = [place.frames for place in places if len(place.filters)]
        # Where no template fits, a frame is drawn all the same: a request is of some.
        first = min((part.start for part in reached), default=0)
        window = slice(first, max((part.stop for part in reached), default=1))
        start = (1 + position) * NUMBERS
        stare = part_of(survey.stare, window)
        injecting = Injecting(
            tuple(place.within(first) for place in places),
            self.threshold,
            survey.bank.directions,
            self.response,
            self.photons,
            survey.known[window].astype(np.float32),
            stare.start_s,
            stare.frame_s,
            survey.variance[window],
            None if survey.curves is None else survey.curves[:, window],
            start,
            refit,
            None if survey.trend is None else survey.trend.part(window),
        )
        return StaresRequest(
            self.quiescent,
            stare,
            self.draws,
            self.seed,
            start=start,
            method=self.method,
            cosmic_rays=self.cosmic_rays,
            reduction=injecting,
            glow=True,
        )


@dataclass(frozen=True, eq=False)
class Injecting:
    """What comes of stares into which flares are put at one time.

    Attributes
    ----------
    places : tuple of Place
        In these frames.
    threshold : float
    directions : ndarray, shape (n_temperature, n_sum)
        Of the bank.
    response, photons : ndarray
        As `Injections` has them.
    known : ndarray of float32, shape (n_frame, n_sum)
        Mean of the frames without a flare.
    start_s : ndarray, shape (n_frame,)
    frame_s : float
    variance : ndarray, shape (n_frame,)
        Of each frame's sums, as the search takes it.
    curves : ndarray, shape (n_curve, n_frame), optional
    start : int
        Number of the first stare.
    refit : Refit, optional
        Which flares are fitted, and how.
    trend : Trend, optional
        What unknowns of these frames do beyond first order.
    """

    adds: ClassVar[bool] = False

    places: tuple[Place, ...]
    threshold: float
    directions: Float
    response: Float
    photons: Float
    known: Single
    start_s: Float
    frame_s: float
    variance: Float
    curves: Float | None
    start: int
    refit: Refit | None = None
    trend: Trend | None = None

    def __call__(self, values: Single, first: int, glow: Single) -> dict[str, NDArray[Any]]:
        """The amplitude from which on each flare is found, (n_stare, n_half_width), and fits where they are asked for.

        Infinite if no template fits into what is observed; zero where there is an alarm without it.
        """
        critical = np.full((len(values), len(self.places)), np.inf, np.float32)
        for begin in range(0, len(values), BLOCK):
            part = slice(begin, begin + BLOCK)
            drawn = self.drawn(values[part], glow[part])
            for column, place in zip(critical[part].T, self.places, strict=True):
                if len(place.filters):
                    column[:] = self._critical(place, self.values(place, drawn))
        kept: dict[str, NDArray[Any]] = {"critical": critical}
        if self.refit is not None:
            # One stare at a time: a fit knows nothing of what is fitted beside it.
            these = range(min(len(values), max(0, self.start + self.refit.count - first)))
            each = [self._fitted(self.drawn(values[k : k + 1], glow[k : k + 1]), self.refit) for k in these]
            none = np.zeros((0, *self.refit.amplitudes.shape), np.float32)
            kept |= {name: np.array([one[name] for one in each]) if each else none for name in KEPT}
        return kept

    def drawn(self, values: Single, glow: Single) -> Drawn:
        """A few stares."""
        n_sum = values.shape[2]
        noise = np.moveaxis(net_of(values, self.known, self.trend), 2, 0)
        own, light = np.ascontiguousarray(np.moveaxis(glow[:, :, :n_sum], 2, 0)), glow[:, :, n_sum]
        return Drawn(_multiple(noise, NOISE_STEP).astype(np.float64), own, light if light.any() else None)

    def values(self, place: Place, drawn: Drawn) -> tuple[Single, Single, Single]:
        """a, b and c of the module's formula, shapes (n_temperature, n_draw or 1, n_filter)."""
        filters, here = place.weights, place.frames
        mean = np.atleast_2d(place.mean if drawn.light is None else place.mean * (1 + drawn.light[:, here]))
        start, width = self.start_s[here], place.half_width_s
        shining = (start > place.peak_s - width - self.frame_s) & (start < place.peak_s + GLOW * width)
        ends = np.flatnonzero(shining)[[0, -1]] if shining.any() else np.array([0, -1])
        lit = slice(int(ends[0]), int(ends[1]) + 1)
        own = drawn.own[:, :, here][:, :, lit] * np.sqrt(np.maximum(place.mean[lit], 0))
        return (
            _combined(self.directions, drawn.noise[:, :, here] @ filters),
            _combined((self.directions @ self.response)[:, None], (_multiple(mean, MEAN_STEP) @ filters)[None]),
            _combined(self.directions @ self.photons, _multiple(own, NOISE_STEP) @ filters[lit]),
        )

    def best(self, place: Place, drawn: Drawn, amplitudes: Float) -> tuple[Float, NDArray[np.int64], NDArray[np.int64]]:
        """The largest value among the templates that count, and which: arrays (n_amplitude, n_draw).

        Parameters
        ----------
        place : Place
        drawn : Drawn
        amplitudes : ndarray, shape (n_amplitude,)

        Returns
        -------
        value, temperature, template : ndarray
        """
        a, b, c = self.values(place, drawn)
        values = np.array([a + x * b + np.sqrt(x) * c for x in amplitudes.astype(np.float32)])
        values[:, ~place.counts[:, None].repeat(a.shape[1], axis=1)] = -np.inf
        flat = np.moveaxis(values, 2, 1).reshape(len(amplitudes), a.shape[1], -1)
        which = flat.argmax(axis=2)
        largest = np.take_along_axis(flat, which[:, :, None], axis=2)[:, :, 0]
        temperature, template = np.divmod(which, a.shape[2])
        return largest.astype(np.float64), temperature, template

    def sums(self, place: Place, drawn: Drawn, amplitudes: Float) -> Single:
        """Frames with the flare, less what is known of them, shape (n_amplitude, n_draw, n_frame, n_sum)."""
        here = place.frames
        mean = np.atleast_2d(place.mean if drawn.light is None else place.mean * (1 + drawn.light[:, here]))
        glow = np.sqrt(np.maximum(place.mean, 0))
        own = np.einsum("kj,jmt->mtk", self.photons.astype(np.float32), drawn.own[:, :, here] * glow)
        rise = mean[:, :, None] * self.response.astype(np.float32)
        noise = np.moveaxis(drawn.noise[:, :, here], 0, 2)
        return np.asarray([noise + x * rise + np.sqrt(x) * own for x in amplitudes.astype(np.float32)])

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
        root[~((b > 0) & place.counts[:, None]).repeat(root.shape[1] // b.shape[1], axis=1)] = np.inf
        np.copyto(root, 0, where=(left <= 0) & place.counts[:, None])
        return np.asarray(root.min(axis=(0, 2)) ** 2)

    def _fitted(self, drawn: Drawn, refit: Refit) -> dict[str, Single]:
        """Of one stare: arrays (n_half_width, n_amplitude), NaN where a flare is not found."""
        kept = {name: np.full(refit.amplitudes.shape, np.nan, np.float32) for name in KEPT}
        for d, (place, row) in enumerate(zip(self.places, refit.amplitudes, strict=True)):
            if not len(place.filters):
                continue
            value, temperature, template = (each[:, 0] for each in self.best(place, drawn, row))
            alarm = value >= self.threshold
            if not alarm.any():
                continue
            here, which = place.frames, template[alarm]
            recovered = refit.fit.recover(
                self.sums(place, drawn, row[alarm])[:, 0],
                self.start_s[here],
                peak_s=place.peaks_s[which],
                half_width_s=place.widths_s[which],
                temperature_k=refit.kelvin[temperature[alarm]],
                variance=self.variance[here],
                curves=None if self.curves is None else self.curves[:, here],
            )
            for name, values in refit.compared(recovered, row[alarm], place).items():
                kept[name][d, alarm] = values
        return kept


@dataclass(frozen=True, eq=False)
class Drawn:
    """Everything random in the frames of a few stares.

    Attributes
    ----------
    noise : ndarray, shape (n_sum, n_draw, n_frame)
        The sums without a flare, less what is known of them.
    own : ndarray of float32, shape (n_sum, n_draw, n_frame)
        Standard normal, for the flare's photons.
    light : ndarray of float32, shape (n_draw, n_frame), optional
        Relative change of all light, where there is any.
    """

    noise: Float
    own: Single
    light: Single | None


def _multiple(values: Single, step: float) -> Single:
    """The nearest multiples of a power of two."""
    values = values * np.float32(1 / step)
    return np.asarray(np.rint(values, out=values) * np.float32(step))


def _combined(rows: Float, values: Float) -> Single:
    """Sums over the first axis of values (n_sum, n_draw, n_filter), one after the other, (n_row, n_draw, n_filter)."""
    small = values.astype(np.float32)
    combined = np.empty((len(rows), *values.shape[1:]), np.float32)
    for row, out in zip(rows.astype(np.float32), combined, strict=True):
        np.multiply(row[0], small[0], out=out)
        for weight, value in zip(row[1:], small[1:], strict=True):
            out += weight * value
    return combined
