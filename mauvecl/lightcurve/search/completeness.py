"""The share of flares that a search recovers, by energy: a table, or a matched filter's closed form."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, stats

from mauvecl.host.errors import InputError
from mauvecl.host.expectation import Expectation
from mauvecl.lightcurve.flares.energies import EnergyScale
from mauvecl.lightcurve.flares.shapes import Shape, shape_of
from mauvecl.lightcurve.search.bank import Bank
from mauvecl.lightcurve.search.null import DAY_S
from mauvecl.lightcurve.search.trials import Trials
from mauvecl.lightcurve.usual import HALF_WIDTHS_S as BANK_S

Float = NDArray[np.float64]

#: Energies of a table, per decade, and half-widths and peak times that the closed form looks at.
PER_DECADE, WIDTHS, PEAKS = 20, 40, 24
HALF_WIDTHS_S = (2.0, 20_000.0)
#: Thresholds that are answered, sigma.
THRESHOLDS = (2.0, 20.0)


@dataclass(frozen=True)
class DurationLaw:
    """How long flares of an energy last: t_1/2 = half_width_s (E / at_erg)^exponent, with a normal scatter in dex.

    An assumption. The exponent is that of superflares on G dwarfs (duration with E^0.39, Maehara et al. 2015); the
    level gives minutes at 1e34 erg and tens of seconds at 1e31.

    Attributes
    ----------
    half_width_s, at_erg : float
        Bolometric energy.
    exponent, scatter_dex : float
    """

    half_width_s: float = 100.0
    at_erg: float = 1e33
    exponent: float = 0.39
    scatter_dex: float = 0.3

    def __post_init__(self) -> None:
        for name in ("half_width_s", "at_erg"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"{name} = {getattr(self, name)}, expected above 0")
        if not 0 <= self.exponent < 1:
            raise InputError(f"exponent = {self.exponent}, expected 0 to 1: amplitudes rise with energy")
        if not 0 <= self.scatter_dex <= 2:
            raise InputError(f"scatter_dex = {self.scatter_dex}, expected 0 to 2")

    def half_width(self, energy_erg: ArrayLike) -> Float:
        """Its middle, s, shape of the energy."""
        return np.asarray(self.half_width_s * (np.asarray(energy_erg, float) / self.at_erg) ** self.exponent)


@dataclass(frozen=True, eq=False)
class Completeness:
    """Probability that a flare is recovered, by its energy.

    Attributes
    ----------
    energy_erg : ndarray, shape (n,)
        Ascending; of the band.
    probability : ndarray, shape (n,)
    band : str
        Or "bolometric".
    how : str
        What it was made of.
    """

    energy_erg: Float
    probability: Float
    band: str
    how: str

    def __post_init__(self) -> None:
        for name in ("energy_erg", "probability"):
            kept = np.array(getattr(self, name), np.float64)
            kept.setflags(write=False)
            object.__setattr__(self, name, kept)
        energy, p = self.energy_erg, self.probability
        if energy.ndim != 1 or energy.shape != p.shape or energy.size < 2:
            raise InputError(f"completeness of {energy.size} energies and {p.size} probabilities, expected as many")
        if not ((energy > 0).all() and (np.diff(energy) > 0).all() and np.isfinite(energy).all()):
            raise InputError("energies of a completeness do not ascend, expected ascending ones above 0")
        if not ((p >= 0) & (p <= 1)).all():
            raise InputError(f"completeness from {p.min():g} to {p.max():g}, expected probabilities")

    def at(self, energy_erg: ArrayLike) -> Float:
        """Shape of the energy; the ends' values beyond them."""
        return np.asarray(np.interp(np.log10(energy_erg), np.log10(self.energy_erg), self.probability))

    @property
    def decades(self) -> tuple[float, float]:
        """Logarithms of its first and last energy."""
        return float(np.log10(self.energy_erg[0])), float(np.log10(self.energy_erg[-1]))

    def energy_at(self, probability: float) -> float:
        """The smallest energy from which on the probability is reached, erg; infinite where it never is."""
        reached = self.probability >= probability
        if not reached[-1]:
            return float("inf")
        if reached.all():
            return float(self.energy_erg[0])
        first = int(np.flatnonzero(~reached)[-1])
        low, high = self.probability[first : first + 2]
        part = (probability - low) / (high - low)
        e0, e1 = np.log10(self.energy_erg[first : first + 2])
        return float(10 ** (e0 + part * (e1 - e0)))

    @classmethod
    def of_search(
        cls,
        signal_per_frame: float,
        scale: EnergyScale,
        *,
        window_s: float,
        false_alarms_per_day: float,
        bank: Bank | None = None,
        law: DurationLaw | None = None,
    ) -> Self:
        """A bank of matched filters in stretches of one length, in closed form.

        In each stretch an offset and a slope are not known, so that of a flare only what differs from a straight line
        counts; its peak may be anywhere in the stretch. A flare whose own S/N is less than half of the threshold is
        taken for lost. The noise of the flare's own light is left out, as is what a bank loses between its templates
        (some 1 %), and what its several temperatures add to the threshold.

        Parameters
        ----------
        signal_per_frame : float
            S/N of one frame with a flare of amplitude 1, by its best spectral weights; see `frame_signal`.
        scale : EnergyScale
            From amplitudes to energies; bolometric, for the law of durations is.
        window_s : float
            Length of a stretch without a gap.
        false_alarms_per_day : float
            Of a day of frames: sets the threshold.
        bank : Bank, optional
            Its shape, half-widths and level; `default_bank` unless given.
        law : DurationLaw, optional
        """
        if scale.kind != "bolometric":
            raise InputError(f"an energy scale of the kind {scale.kind!r}, expected a bolometric one")
        for name, value in (("signal_per_frame", signal_per_frame), ("window_s", window_s)):
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} = {value}, expected above 0")
        law, bank = law or DurationLaw(), bank or default_bank()
        threshold = search_threshold(false_alarms_per_day, bank)
        widths, gain = _gains(bank.shape, window_s, bank.frame_s)
        # From energies that no stretch shows to those that every one does.
        log_energy = np.arange(24.0, 40.0, 1 / PER_DECADE)
        nodes, weights = np.polynomial.hermite_e.hermegauss(15)
        half = law.half_width(10**log_energy)[:, None] * 10 ** (law.scatter_dex * nodes)
        duration = scale.equivalent_duration(1.0) * 10**log_energy
        amplitude = duration[:, None] / (half * bank.shape.equivalent_duration)
        place = np.clip(np.log(half / widths[0]) / np.log(widths[-1] / widths[0]), 0, 1) * (WIDTHS - 1)
        i = np.minimum(place.astype(int), WIDTHS - 2)
        # Between half-widths the logarithm of the gain is taken as a line.
        part = (place - i)[..., None]
        one = np.exp((1 - part) * np.log(gain[i]) + part * np.log(gain[i + 1]))
        signal = amplitude[..., None] * signal_per_frame * one
        # What noise lifts over the threshold with little help, some 1 % of such flares, is left to the false alarms:
        # small flares are without number.
        p = np.where(signal > threshold / 2, stats.norm.sf(threshold - signal), 0.0).mean(axis=-1)
        probability = p @ (weights / weights.sum())
        how = (
            f"closed form of a bank of matched filters, {bank.shape.name}, threshold {threshold:.2f} sigma for "
            f"{false_alarms_per_day:g} false alarms a day, stretches of {window_s / 60:.0f} min"
        )
        return cls(10**log_energy, np.clip(probability, 0, 1), "bolometric", how)


def default_bank(shape: Shape | str = "davenport2014", frame_s: float = 5.0) -> Bank:
    """That of a search which is not told otherwise, of one sum of each frame."""
    return Bank(BANK_S, np.ones((1, 1)), shape_of(shape), frame_s)


def search_threshold(false_alarms_per_day: float, bank: Bank | None = None) -> float:
    """Where a bank's largest value is cut for so many false alarms in a day of frames, sigma of white noise.

    By `Trials`: some 1 % above the threshold of as many alarms at one a day, less farther out.

    Raises
    ------
    InputError
        For a rate that is not above 0, or that no threshold of 2 to 20 sigma has.
    """
    if not (np.isfinite(false_alarms_per_day) and false_alarms_per_day > 0):
        raise InputError(f"false_alarms_per_day = {false_alarms_per_day}, expected above 0")
    trials = Trials.of(bank or default_bank())

    def over(threshold: float) -> float:
        return float(np.log(trials.per_second(threshold) * DAY_S / false_alarms_per_day))

    if over(THRESHOLDS[0]) < 0 or over(THRESHOLDS[1]) > 0:
        most, least = (trials.per_second(u) * DAY_S for u in THRESHOLDS)
        raise InputError(f"false_alarms_per_day = {false_alarms_per_day:g}, expected {least:.2g} to {most:.3g}")
    return float(optimize.brentq(over, *THRESHOLDS, xtol=1e-9))


def frame_signal(
    quiet: Expectation, flare: Expectation, amplitude: float = 1.0, *, added_variance_dn2: Float | None = None
) -> float:
    """S/N of one frame with a flare of amplitude 1 against the quiescent star, by weights light / variance.

    Parameters
    ----------
    quiet, flare : Expectation
        One frame each; pixels that saturate without a flare are left out.
    amplitude : float
        That of the flare.
    added_variance_dn2 : ndarray, shape (n_pixel,), optional
        Beside what is expected: of hits by particles.
    """
    if quiet.n_frames != 1 or flare.n_frames != 1:
        raise InputError(f"expectations of {quiet.n_frames} and {flare.n_frames} frames, expected one frame each")
    light = (flare.source_electrons - quiet.source_electrons) * quiet.gain_dn_per_electron / amplitude
    variance = quiet.unsaturated_variance_dn2 + (0.0 if added_variance_dn2 is None else added_variance_dn2)
    used = ~quiet.saturated
    return float(np.sqrt(np.sum(light[used] ** 2 / variance[used])))


def _gains(shape: Shape, window_s: float, frame_s: float) -> tuple[Float, Float]:
    """Root of the sum of squares of a shape's frames without their straight line, by half-width and place of the peak.

    Returns
    -------
    half_width_s : ndarray, shape (WIDTHS,)
    gain : ndarray, shape (WIDTHS, PEAKS)
    """
    n = max(3, round(window_s / frame_s))
    edges = np.arange(n + 1) * frame_s
    line = np.stack([np.ones(n), np.linspace(-1, 1, n)])
    line /= np.linalg.norm(line, axis=1)[:, None]
    widths = np.geomspace(*HALF_WIDTHS_S, WIDTHS)
    # Peaks at odd places of a frame, so that short flares are averaged over where they fall in it.
    peaks = (np.arange(PEAKS) + 0.5) / PEAKS * n * frame_s + frame_s * ((np.arange(PEAKS) * 0.618034) % 1.0 - 0.5)
    gain = np.empty((WIDTHS, PEAKS))
    for i, half in enumerate(widths):
        tau = (edges[None, :] - peaks[:, None]) / half
        frames = shape.integral(tau[:, :-1], tau[:, 1:]) * half / frame_s
        rest = frames - (frames @ line.T) @ line
        gain[i] = np.linalg.norm(rest, axis=1)
    return widths, np.maximum(gain, 1e-12)
