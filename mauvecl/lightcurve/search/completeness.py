"""Completeness of a search by flare energy, from a table or from the closed form for matched filters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, stats

from mauvecl.host.expectation import Expectation
from mauvecl.lightcurve.defaults import HALF_WIDTHS_S as BANK_S
from mauvecl.lightcurve.flares.energies import EnergyScale
from mauvecl.lightcurve.flares.shapes import Shape, consecutive_integrals, shape_of
from mauvecl.lightcurve.search.bank import Bank, white_bank
from mauvecl.lightcurve.search.false_alarm_rate import TemplateGrid
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S, Duration, DurationExponent, DurationScatter, Energy, Positive

Float = NDArray[np.float64]

#: Energies per decade of the closed form, and its numbers of half-widths and peak times.
PER_DECADE, WIDTHS, PEAKS = 20, 40, 24
HALF_WIDTHS_S = (2.0, 20_000.0)
#: Range of thresholds, sigma.
THRESHOLDS = (2.0, 20.0)


@validated
@dataclass(frozen=True)
class DurationLaw:
    """Assumed half-widths by energy: t_1/2 = half_width_s (E / at_erg)^exponent, with a normal scatter in dex.

    The exponent is that of superflares on G dwarfs (Maehara et al. 2015); the default scale gives minutes at 1e34 erg
    and tens of seconds at 1e31 erg.

    Attributes
    ----------
    half_width_s, at_erg : float
        Bolometric energy.
    exponent, scatter_dex : float
    """

    half_width_s: Duration = 100.0
    at_erg: Energy = 1e33
    exponent: DurationExponent = 0.39
    scatter_dex: DurationScatter = 0.3

    def half_width(self, energy_erg: ArrayLike) -> Float:
        """Return the median half-width, s, shape of the energy."""
        return np.asarray(self.half_width_s * (np.asarray(energy_erg, float) / self.at_erg) ** self.exponent)


@dataclass(frozen=True, eq=False)
class Completeness:
    """Probability that a flare is recovered, by energy.

    Attributes
    ----------
    energy_erg : ndarray, shape (n,)
        Energies in the band, ascending.
    probability : ndarray, shape (n,)
    band : str
        Name of the band, or "bolometric".
    how : str
        Description of the method.
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
            raise InputError.of("probability", p.size, f"one for each of {energy.size} energies, at least 2")
        if not ((energy > 0).all() and (np.diff(energy) > 0).all() and np.isfinite(energy).all()):
            raise InputError("energies of a completeness do not ascend", "ascending ones above 0", key="energy_erg")
        if not ((p >= 0) & (p <= 1)).all():
            raise InputError.of("probability", (float(p.min()), float(p.max())), "0 to 1")

    def at(self, energy_erg: ArrayLike) -> Float:
        """Return the interpolated probability, constant outside the table, shape of the energy."""
        return np.asarray(np.interp(np.log10(energy_erg), np.log10(self.energy_erg), self.probability))

    @property
    def decades(self) -> tuple[float, float]:
        """Logarithms of the first and last energy."""
        return float(np.log10(self.energy_erg[0])), float(np.log10(self.energy_erg[-1]))

    def energy_at(self, probability: float) -> float:
        """Return the energy above which the probability is reached, erg; infinite if it never is."""
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
    @validated
    def of_search(
        cls,
        signal_per_frame: Positive,
        scale: EnergyScale,
        *,
        window_s: Duration,
        false_alarms_per_day: float,
        bank: Bank | None = None,
        law: DurationLaw | None = None,
    ) -> Self:
        """Compute the closed form for a bank of matched filters in observing windows of equal length.

        Offset and slope of each window are unknown, so that only the deviation of a flare from a straight line counts;
        peaks are distributed uniformly over the window. Flares with an S/N below half of the threshold count as lost.
        The closed form neglects the photon noise of flares, the mismatch between templates (about 1 %), and the effect
        of several temperatures on the threshold.

        Parameters
        ----------
        signal_per_frame : float
            S/N of one frame with a flare of amplitude 1 and optimal spectral weights; see `frame_signal`.
        scale : EnergyScale
            Bolometric energies by amplitude.
        window_s : float
            Length of a window without gaps.
        false_alarms_per_day : float
            False alarms per day of frames, which set the threshold.
        bank : Bank, optional
            Shape, half-widths and baseline; `default_bank` by default.
        law : DurationLaw, optional
        """
        if scale.kind != "bolometric":
            raise InputError.of("kind", scale.kind, "bolometric")
        law, bank = law or DurationLaw(), bank or default_bank()
        threshold = search_threshold(false_alarms_per_day, bank)
        widths, gain = _gains(bank.shape, window_s, bank.frame_s)
        # From undetectable energies to those that are always detected.
        log_energy = np.arange(24.0, 40.0, 1 / PER_DECADE)
        nodes, weights = np.polynomial.hermite_e.hermegauss(15)
        half = law.half_width(10**log_energy)[:, None] * 10 ** (law.scatter_dex * nodes)
        duration = scale.equivalent_duration(1.0) * 10**log_energy
        amplitude = duration[:, None] / (half * bank.shape.equivalent_duration)
        place = np.clip(np.log(half / widths[0]) / np.log(widths[-1] / widths[0]), 0, 1) * (WIDTHS - 1)
        i = np.minimum(place.astype(int), WIDTHS - 2)
        # The logarithm of the gain is interpolated linearly between half-widths.
        part = (place - i)[..., None]
        one = np.exp((1 - part) * np.log(gain[i]) + part * np.log(gain[i + 1]))
        signal = amplitude[..., None] * signal_per_frame * one
        # Small flares that noise lifts above the threshold, about 1 % of them, count as false alarms, since small
        # flares are arbitrarily frequent.
        p = np.where(signal > threshold / 2, stats.norm.sf(threshold - signal), 0.0).mean(axis=-1)
        probability = p @ (weights / weights.sum())
        how = (
            f"closed form of a bank of matched filters, {bank.shape.name}, threshold {threshold:.2f} sigma for "
            f"{false_alarms_per_day:g} false alarms a day, stretches of {window_s / 60:.0f} min"
        )
        return cls(10**log_energy, np.clip(probability, 0, 1), "bolometric", how)


def default_bank() -> Bank:
    """Return the bank of a default search with one sum per frame."""
    return white_bank(BANK_S, shape_of("davenport2014"), 5.0)


@validated
def search_threshold(false_alarms_per_day: Positive, bank: Bank | None = None) -> float:
    """Return the threshold of a bank in white noise, sigma, for a number of false alarms per day of frames.

    The threshold follows from `TemplateGrid` and is about 1 % too high at one alarm per day, and less at lower rates.
    Raises InputError if it is not between 2 and 20 sigma.
    """
    return _search_threshold(false_alarms_per_day, bank or default_bank())


# A plan asks for the threshold and the gains of each target and each mode of a calibrated throughput.
@lru_cache(maxsize=8)
def _search_threshold(false_alarms_per_day: float, bank: Bank) -> float:
    grid = TemplateGrid.from_bank(bank)

    def over(threshold: float) -> float:
        return float(np.log(grid.false_alarms_per_second(threshold) * DAY_S / false_alarms_per_day))

    if over(THRESHOLDS[0]) < 0 or over(THRESHOLDS[1]) > 0:
        most, least = (grid.false_alarms_per_second(u) * DAY_S for u in THRESHOLDS)
        raise InputError.of("false_alarms_per_day", false_alarms_per_day, f"{least:.2g} to {most:.3g}")
    return float(optimize.brentq(over, *THRESHOLDS, xtol=1e-9))


def frame_signal(
    quiet: Expectation, flare: Expectation, amplitude: float = 1.0, *, added_variance_dn2: Float | None = None
) -> float:
    """Return the S/N of one frame with a flare of amplitude 1, with optimal weights.

    Parameters
    ----------
    quiet, flare : Expectation
        One frame each; pixels that saturate without a flare are excluded.
    amplitude : float
        Amplitude of the flare in `flare`.
    added_variance_dn2 : ndarray, shape (n_pixel,), optional
        Additional variance, such as that of particle hits.
    """
    if quiet.n_frames != 1 or flare.n_frames != 1:
        raise InputError.of("n_frames", (quiet.n_frames, flare.n_frames), "one frame each")
    light = (flare.source_electrons - quiet.source_electrons) * quiet.gain_dn_per_electron / amplitude
    variance = quiet.unsaturated_variance_dn2 + (0.0 if added_variance_dn2 is None else added_variance_dn2)
    used = ~quiet.saturated
    return float(np.sqrt(np.sum(light[used] ** 2 / variance[used])))


@lru_cache(maxsize=32)
def _gains(shape: Shape, window_s: float, frame_s: float) -> tuple[Float, Float]:
    """Return half-widths, (WIDTHS,), and the norm of detrended shapes by half-width and peak time, (WIDTHS, PEAKS)."""
    n = max(3, round(window_s / frame_s))
    edges = np.arange(n + 1) * frame_s
    line = np.stack([np.ones(n), np.linspace(-1, 1, n)])
    line /= np.linalg.norm(line, axis=1)[:, None]
    widths = np.geomspace(*HALF_WIDTHS_S, WIDTHS)
    # Peaks have irregular phases within frames, which averages over the phase of short flares.
    peaks = (np.arange(PEAKS) + 0.5) / PEAKS * n * frame_s + frame_s * ((np.arange(PEAKS) * 0.618034) % 1.0 - 0.5)
    gain = np.empty((WIDTHS, PEAKS))
    for i, half in enumerate(widths):
        tau = (edges[None, :] - peaks[:, None]) / half
        frames = consecutive_integrals(shape, tau) * half / frame_s
        rest = frames - (frames @ line.T) @ line
        gain[i] = np.linalg.norm(rest, axis=1)
    gain = np.maximum(gain, 1e-12)
    for shared in (widths, gain):
        shared.setflags(write=False)
    return widths, gain
