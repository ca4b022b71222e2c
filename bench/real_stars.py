"""How `analyse` does on light as real stars and satellites make it: false alarms, noise, energies, completeness.

    python bench/real_stars.py                                     every part, 20 trials of each kind
    python bench/real_stars.py --only quiet --number 100 --processes 2
    python bench/real_stars.py --only short --kind pair --number 300 --seed 7 --records short.jsonl
    python bench/real_stars.py --only files --files lightcurves/ --cases shared/data/cases

NumPy draws the light curves here, with shapes of flares written a second time and integrated over the frames, and not
mauvecl's own simulator. Only the spectra of a star and of the dark current are mauvecl's. Each trial is written to FITS
and read by the command line in this process, or goes to Python's `analyse` with `--python`. The table has a row for
each kind and quantity; `--records` keeps every trial. Rows of other parts and kinds that the table has stay.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import multiprocessing
import os
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

# Two processes with many threads of linear algebra each would only wait for one another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, toeplitz
from scipy.special import erfcx
from scipy.stats import poisson

Float = NDArray[np.float64]
DAY_S = 86_400.0
ORBIT_S = 95 * 60.0
#: S/N in thresholds of the search below which a found flare is selected by its noise and is reported apart.
BRIGHT = 1.5
#: Largest distance from an event to the peak of a flare that it is, in half-widths, as where the peak is in a gap.
NEAR = 6.0


# ---- flares -------------------------------------------------------------------------------------------------------


def davenport(tau: Float, slow: float = 0.278318) -> Float:
    """Compute the flare of Davenport et al. (2014), with another rate of its slow decay if wanted."""
    rise = 1 + tau * (1.94053 + tau * (-0.175084 + tau * (-2.24588 - 1.12498 * tau)))
    late = np.maximum(tau, 0.0)
    decay = 0.689008 * np.exp(-1.60053 * late) + 0.302963 * np.exp(-slow * late)
    return np.where(tau > 0, decay, np.where(tau > -1, rise, 0.0))


def tovar_mendoza(tau: Float) -> Float:
    """Compute the flare of Tovar Mendoza et al. (2022)."""
    a, b, c = 0.9687734504375167, -0.251299705922117, 0.22675974948468916
    total = np.zeros_like(tau)
    for share, d in ((0.12695865022878844, 0.15551880775110513), (1 - 0.12695865022878844, 1.2150539528490194)):
        x = (b - tau) / c + c * d / 2
        # exp(-d tau + (b/c + c d/2)^2) erfc(x), as exp(... - x^2) erfcx(x) where the product would overflow.
        power = -d * tau + (b / c + c * d / 2) ** 2
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = np.where(x > 0, np.exp(power - x * x) * erfcx(x), 0.0)
            direct = np.exp(np.minimum(power, 700.0)) * (2 - np.exp(-x * x) * erfcx(np.abs(x)))
        total += share * np.where(x > 0, scaled, direct)
    return np.sqrt(np.pi) / 2 * a * c * total


#: Shapes of flares, with the range of tau = (time from the peak) / half-width in which they are not zero.
SHAPES: dict[str, tuple[Callable[[Float], Float], float, float]] = {
    "davenport": (davenport, -1.0, 100.0),
    "tovar-mendoza": (tovar_mendoza, -3.0, 100.0),
    "gaussian": (lambda tau: np.exp(-4 * np.log(2) * tau**2), -4.0, 4.0),
    "slow-rise": (lambda tau: np.where(tau < 0, 1 + tau / 3, np.maximum(1 - tau, 0.0)), -3.0, 1.0),
    "long-tail": (lambda tau: davenport(tau, 0.14), -1.0, 150.0),
    "short-tail": (lambda tau: davenport(tau, 0.6), -1.0, 40.0),
}


@cache
def integral(shape: str) -> tuple[Float, Float]:
    """Return a fine grid of tau and the integral of a shape up to each of its points."""
    function, first, last = SHAPES[shape]
    tau = np.arange(first, last, 0.002)
    values = function(tau)
    return tau, np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(tau))])


@dataclass
class Flare:
    """A flare that was put in; energies are equivalent durations in seconds."""

    shape: str
    peak_s: float
    half_width_s: float
    amplitude: float = 1.0
    snr: float = 0.0

    def light(self, time_s: Float, exposure_s: float) -> Float:
        """Return its mean over each frame, relative to the quiescent star."""
        tau, total = integral(self.shape)
        ends = (time_s[:, None] + np.array([-0.5, 0.5]) * exposure_s - self.peak_s) / self.half_width_s
        return self.amplitude * self.half_width_s / exposure_s * np.diff(np.interp(ends, tau, total))[:, 0]

    @property
    def total_s(self) -> float:
        """Its whole equivalent duration."""
        return self.amplitude * self.half_width_s * float(integral(self.shape)[1][-1])


# ---- trials -------------------------------------------------------------------------------------------------------


@dataclass
class Trial:
    """Frames to analyse, and the truth about them."""

    part: str
    kind: str
    seed: int
    time_s: Float = field(default_factory=lambda: np.zeros(0))
    exposure_s: float = 0.0
    flux: Float = field(default_factory=lambda: np.zeros(0))
    level: Float | float = 1.0  # quiescent light of each frame, in the unit of the flux
    noise: float = np.nan  # standard deviation of the white noise, likewise
    flares: list[Flare] = field(default_factory=list)
    wavelength_nm: Float | None = None
    star: tuple[str, float] | None = None  # library name and V magnitude, for spectra
    path: Path | None = None  # a file that exists, in place of the arrays
    mapping: Path | None = None
    expected: int | None = None  # number of detected flares, where it is known without a list of them
    lost: NDArray[np.bool_] | None = None  # frames that have lost more light than the noise of a frame

    def energies(self, flare: Flare, start_s: float, stop_s: float) -> tuple[float, float, float]:
        """Return a flare's equivalent duration: the whole, within the frames, and in the frames from start to stop."""
        local = np.broadcast_to(self.level, self.time_s.shape) / np.mean(self.level)
        light = flare.light(self.time_s, self.exposure_s) * self.exposure_s / local
        near = float(np.interp(flare.peak_s, self.time_s, local))
        chosen = (self.time_s > start_s - self.exposure_s / 2) & (self.time_s < stop_s + self.exposure_s / 2)
        return flare.total_s / near, float(light.sum()), float(light[chosen].sum())


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number with a uniform logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def gapped(rng: np.random.Generator, n: int, most: int = 5) -> NDArray[np.bool_]:
    """Draw the frames that are left by up to a few gaps of 0.2 to 5 % of the frames each."""
    kept = np.ones(n, np.bool_)
    for _ in range(rng.integers(0, most + 1)):
        first = int(rng.integers(0, n))
        kept[first : first + max(1, int(n * between(rng, 0.002, 0.05)))] = False
    return kept


def rotation(
    rng: np.random.Generator, time_s: Float, period_s: float, amplitude: float, harmonic: float, orders: int = 2
) -> Float:
    """Draw the light of a spotted star that turns, relative to its mean; phase and size drift for every other one.

    Each harmonic is smaller than the one before by the same factor.
    """
    turns = time_s / period_s
    drift = bool(rng.integers(2))
    total = np.zeros_like(time_s)
    for order in range(1, orders + 1):
        size = amplitude * harmonic ** (order - 1)
        # A cycle of spots takes some ten turns.
        slow = np.sin(2 * np.pi * (turns[:, None] * rng.uniform(0.03, 0.12, 2) + rng.uniform(size=2)))
        phase = turns * order + rng.uniform() + drift * 0.15 * slow[:, 0]
        total += size * (1 + drift * 0.3 * slow[:, 1]) * np.sin(2 * np.pi * phase)
    return total


def red_power(n: int, slope: float) -> Float:
    """Return the power of each mode of 4 n frames of red noise with unit variance."""
    modes = np.arange(2 * n + 1, dtype=float)
    power = np.where(modes > 0, np.maximum(modes, 1.0) ** -slope, 0.0)
    return power / (2 * power.sum())


def red_noise(rng: np.random.Generator, n: int, slope: float) -> Float:
    """Draw red noise of unit variance: a quarter of a periodic series, so that its ends do not meet."""
    power = red_power(n, slope)
    modes = np.sqrt(power / 2) * (rng.normal(size=power.size) + 1j * rng.normal(size=power.size))
    return np.fft.irfft(modes * 4 * n, 4 * n)[:n]


def thermal_cycle(rng: np.random.Generator, time_s: Float) -> Float:
    """Draw a bump in each orbit between 0 and 1, of changing size."""
    phase = time_s / ORBIT_S + rng.uniform()
    sharp = rng.uniform(0.5, 4.0)
    bump = np.exp(sharp * (np.cos(2 * np.pi * phase) - 1))
    return bump * (1 + 0.2 * np.sin(2 * np.pi * (phase * rng.uniform(0.05, 0.2) + rng.uniform())))


def pointing_loss(rng: np.random.Generator, time_s: Float, most: float = 0.05, rate_per_h: float = 0.7) -> Float:
    """Draw losses of light: drifts out of the fibre within minutes and exponential returns, one after another."""
    loss = np.zeros_like(time_s)
    for start in rng.uniform(time_s[0], time_s[-1], rng.poisson(rate_per_h * np.ptp(time_s) / 3600)):
        length, out, back = rng.uniform(60, 1200), between(rng, 20, 400), between(rng, 20, 400)
        gone = 1 - np.exp(-np.clip(time_s - start, 0, length) / out)
        loss = np.maximum(loss, rng.uniform(0, most) * gone * np.exp(-np.clip(time_s - start - length, 0, None) / back))
    return loss


def quiet(number: int, seed: int) -> Iterator[Trial]:
    """Draw light curves without a flare: rotators, red noise, thermal cycles, pointing losses, white noise.

    Sharp rotators have three to five harmonics.
    """
    for k in range(number):
        for index, kind in enumerate(("rotator", "red", "thermal", "pointing", "white", "sharp")):
            rng = np.random.default_rng([seed, 1, index, k])
            n = int(rng.integers(1000, 4001))
            cadences = (
                [20.0, 60.0, 120.0, 600.0, 1800.0]
                if kind in ("rotator", "red", "white", "sharp")
                else [5.0, 20.0, 60.0]
            )
            cadence, noise = float(rng.choice(cadences)), between(rng, 1e-4, 5e-3)
            time_s = np.arange(n) * cadence
            level, loss = np.ones(n), np.zeros(n)
            if kind == "rotator":
                level += rotation(rng, time_s, between(rng, 0.2, 12) * DAY_S, between(rng, 1e-3, 0.05),
                                  rng.uniform(0, 0.7))  # fmt: skip
            elif kind == "sharp":
                level += rotation(rng, time_s, between(rng, 0.2, 12) * DAY_S, between(rng, 1e-3, 0.05),
                                  rng.uniform(0.3, 0.7), int(rng.integers(3, 6)))  # fmt: skip
            elif kind == "red":
                level += noise * between(rng, 0.1, 2) * red_noise(rng, n, rng.uniform(0.5, 2))
            elif kind == "thermal":
                level += between(rng, 1e-3, 0.02) * thermal_cycle(rng, time_s)
            elif kind == "pointing":
                loss = pointing_loss(rng, time_s)
                level *= 1 - loss
            flux, kept = level + noise * rng.normal(size=n), gapped(rng, n)
            yield Trial(
                "quiet", kind, k, time_s[kept], cadence, flux[kept], level[kept], noise, lost=loss[kept] > noise
            )


#: Kinds of flares in short windows, with the shape of each.
SHORT = {
    "whole": "davenport", "rise-in-gap": "davenport", "cut-end": "davenport", "cut-start": "davenport",
    "pair": "davenport", "four": "davenport", "tovar-mendoza": "tovar-mendoza", "gaussian": "gaussian",
    "slow-rise": "slow-rise", "long-tail": "long-tail", "short-tail": "short-tail",
}  # fmt: skip


def short(number: int, seed: int) -> Iterator[Trial]:
    """Draw windows that end 1.2 to 20 half-widths after the last peak of flares of S/N 5 to 10 000."""
    for k in range(number):
        for index, (kind, shape) in enumerate(SHORT.items()):
            rng = np.random.default_rng([seed, 2, index, k])
            after = rng.uniform(0.2, 1.2) if kind == "cut-end" else between(rng, 1.2, 20)
            before = -rng.uniform(0.1, 1.5) if kind == "cut-start" else between(rng, 2, 10)
            # A window that begins after the peak ends half a half-width later at least.
            after = max(after, 0.5 - before)
            # At least 60 frames, of 5 s.
            cadence, least = 5.0, 5 * 60 / (before + after)
            half_width = between(rng, max(20.0, least), max(600.0, 1.5 * least))
            peak = before * half_width
            flares = [Flare(shape, peak, half_width)]
            for _ in range({"pair": 1, "four": 3}.get(kind, 0)):
                later = flares[-1].peak_s + half_width * rng.uniform(0.7, 3)
                flares.append(Flare(shape, later, half_width * between(rng, 0.6, 1.6), between(rng, 0.3, 1)))
            n = round((flares[-1].peak_s + after * half_width) / cadence)
            time_s = (np.arange(n) + 0.5) * cadence
            kept = np.ones(n, np.bool_)
            if kind == "rise-in-gap":
                kept = ~((time_s > peak - 1.5 * half_width) & (time_s < peak + rng.uniform(0, 1) * half_width))
            noise, snr = between(rng, 5e-4, 2e-2), between(rng, 5, 10_000)
            yield with_flares("short", kind, k, time_s[kept], cadence, noise, flares, snr, rng)


def with_flares(part: str, kind: str, k: int, time_s: Float, cadence: float, noise: float, flares: list[Flare],
                snr: float, rng: np.random.Generator, level: float = 1.0) -> Trial:  # fmt: skip
    """Scale flares to an S/N in white noise about a known level, and draw frames with them."""
    light = np.sum([one.light(time_s, cadence) for one in flares], axis=0)
    scale = snr * noise / np.sqrt((light**2).sum())
    for one in flares:
        one.amplitude *= scale
        one.snr = snr
    flux = level * (1 + scale * light + noise * rng.normal(size=time_s.size))
    return Trial(part, kind, k, time_s, cadence, flux, level, level * noise, flares)


def rotating_flares(number: int, seed: int) -> Iterator[Trial]:
    """Draw the same flares, of the same S/N under the covariance, in white and red noise and on (sharp) rotators."""
    for k in range(number):
        common = np.random.default_rng([seed, 3, 0, k])
        n, cadence = int(common.integers(1000, 1601)), float(common.choice([20.0, 60.0, 120.0]))
        noise, snr = between(common, 1e-4, 5e-3), common.uniform(4, 15)
        time_s = np.arange(n) * cadence
        flare = Flare("davenport", common.uniform(0.1, 0.9) * time_s[-1], between(common, 1.5, 15) * cadence)
        for index, kind in enumerate(("white", "rotator", "red", "sharp")):
            rng = np.random.default_rng([seed, 3, 1 + index, k])
            level, vary = np.ones(n), np.ones((n, 1))
            covariance = noise**2 * np.eye(n)
            if kind in ("rotator", "sharp"):
                period, orders = between(rng, 0.2, 12) * DAY_S, 2 if kind == "rotator" else 4
                size, ratio = between(rng, 1e-3, 0.05), rng.uniform(0.0 if kind == "rotator" else 0.3, 0.7)
                level += rotation(rng, time_s, period, size, ratio, orders)
                angle = 2 * np.pi * time_s[:, None] / period * np.arange(1, orders + 1)
                waves = np.hstack([np.sin(angle), np.cos(angle)])
                slow = np.linspace(-1, 1, n)[:, None] ** np.arange(3)
                vary = np.hstack([vary, *(waves * slow[:, [j]] for j in range(3))])
            elif kind == "red":
                slope, size = rng.uniform(0.5, 2), noise * between(rng, 0.1, 2)
                level += size * red_noise(rng, n, slope)
                covariance += size**2 * toeplitz(np.fft.irfft(red_power(n, slope) * 4 * n, 4 * n)[:n])
            unit = Flare(flare.shape, flare.peak_s, flare.half_width_s)
            light = unit.light(time_s, cadence)
            # The level and the rotation may have any size: they are marginalised over with a wide prior.
            factor = cho_factor(covariance + 0.03**2 * vary @ vary.T)
            unit.amplitude, unit.snr = snr / float(np.sqrt(light @ cho_solve(factor, light))), snr
            flux = level + unit.amplitude * light + noise * rng.normal(size=n)
            yield Trial("rotating-flares", kind, k, time_s, cadence, flux, level, noise, [unit])


def poisson_counts(number: int, seed: int) -> Iterator[Trial]:
    """Draw counts with a mean of 2 to 20 per frame, with and without a flare."""
    for k in range(number):
        for index, kind in enumerate(("quiet", "flare")):
            rng = np.random.default_rng([seed, 4, index, k])
            n, mean, cadence = int(rng.integers(500, 3001)), between(rng, 2, 20), 10.0
            yield counts("poisson", kind, k, rng, n, mean, cadence, between(rng, 8, 100) if kind == "flare" else 0.0)


def counts(part: str, kind: str, k: int, rng: np.random.Generator, n: int, mean: float, cadence: float,
           snr: float) -> Trial:  # fmt: skip
    """Draw a light curve of counts, with a flare of an S/N in the noise of the quiescent star."""
    time_s = np.arange(n) * cadence
    flare = Flare("davenport", rng.uniform(0.2, 0.7) * time_s[-1], between(rng, 2, 20) * cadence, snr=snr)
    light = flare.light(time_s, cadence)
    flare.amplitude = snr / np.sqrt(mean * (light**2).sum())
    flux = rng.poisson(mean * (1 + flare.amplitude * light)).astype(float)
    return Trial(part, kind, k, time_s, cadence, flux, mean, float(np.sqrt(mean)), [flare] if snr else [])


@cache
def exposure_of(star: str, magnitude: float) -> Any:
    """Return mauvecl's expectation of one frame, from which only spectra of star and dark current are taken."""
    from mauvecl import Instrument, Source, expect

    return expect(Source.from_library(star).at_magnitude(magnitude), Instrument.load("mauvesim"), exposure=5.0)


def spectra(number: int, seed: int) -> Iterator[Trial]:
    """Draw spectra without a flare: thermal cycle of 0.5 deg C, pointing loss of 0 to 5 %, drift of 1 % per hour."""
    for k in range(number):
        for index, kind in enumerate(("white", "thermal", "pointing", "drift", "all")):
            rng = np.random.default_rng([seed, 5, index, k])
            star = (str(rng.choice(["G2V", "K3V", "M3V"])), round(rng.uniform(6.0, 9.0), 1))
            one = exposure_of(*star)
            n = int(rng.integers(300, 1100))
            time_s = (np.arange(n) + 0.5) * 5.0
            grey, dark = np.ones(n), np.ones(n)
            if kind in ("pointing", "all"):
                grey *= 1 - pointing_loss(rng, time_s, rate_per_h=3.0)
            if kind in ("drift", "all"):
                grey *= 1 + 0.01 * time_s / 3600
            if kind in ("thermal", "all"):
                # 0.5 deg C are 3.5 % of the dark current.
                dark = np.exp(0.035 * np.sin(2 * np.pi * (time_s / ORBIT_S + rng.uniform())))
            gain = one.gain_dn_per_electron
            light = rng.poisson(np.outer(grey, one.source_electrons) + one.sky_electrons) * gain
            # Dark current is Poisson in its own unit.
            step = np.where(one.dark_unit == "DN", 1.0, gain)
            offset = rng.poisson(np.outer(dark, one.dark_dn / step)) * step
            read = rng.normal(one.bias_dn, one.read_noise_dn, (n, gain.size))
            dn = np.clip(np.rint(light + offset + read), 0, one.adc_max_dn)
            yield Trial("spectra", kind, k, time_s, 5.0, dn, wavelength_nm=one.wavelength_nm, star=star)


def observed(
    kind: str,
    k: int,
    n: int,
    cadence: float,
    level: float,
    noise: float,
    *flares: Flare,
    vary: Callable[[Float], Float] = np.ones_like,
    without: tuple[float, float] = (0.0, 0.0),
) -> Trial:
    """Draw a light curve of the issue: a level that varies, flares, white noise, and frames that are missing."""
    rng = np.random.default_rng([OPTIONS.seed, 6, k, *kind.encode()])
    time_s = (np.arange(n) + 0.5) * cadence
    local = level * vary(time_s)
    flux = local + noise * rng.normal(size=n)
    kept = (time_s < without[0]) | (time_s >= without[1])
    for one in flares:
        light = level * one.light(time_s, cadence)
        one.snr = float(np.sqrt((light[kept] ** 2).sum())) / noise
        flux += light
    return Trial("issue", kind, k, time_s[kept], cadence, flux[kept], local[kept], noise, list(flares))


def issue(number: int, seed: int) -> Iterator[Trial]:
    """Draw the light curves that the issue on real stars describes, with its numbers."""

    def wave(amplitude: float, days: float) -> Callable[[Float], Float]:
        return lambda time_s: 1 + amplitude * np.sin(2 * np.pi * time_s / (days * DAY_S) + 1)

    for k in range(number):
        rng = np.random.default_rng([seed, 6, k])
        bright, many = Flare("davenport", 528, 60, 10), [
            Flare("davenport", peak * DAY_S, between(rng, 600, 3000), between(rng, 0.01, 0.5))
            for peak in rng.uniform(1, 30, 10)
        ]  # fmt: skip
        red = 1 + 0.5 * 2e-3 * red_noise(rng, 500, 1.0)
        four = [Flare("davenport", 1000 + 90 * j, 50, size) for j, size in enumerate((0.2, 0.15, 0.3, 0.1))]
        yield observed("264 frames", k, 264, 5.0, 1e6, 2500.0, bright)
        yield observed("1136 frames", k, 1136, 5.0, 1e6, 2500.0, bright)
        yield observed("340 frames", k, 340, 5.0, 30.4, 5.5, Flare("davenport", 900, 90, 120))
        yield observed("sinusoid of 1 %", k, 3000, 120.0, 1.0, 1e-4, vary=wave(0.01, 1.0))
        yield observed("30 min", k, 1500, 1800.0, 1.0, 1e-4, vary=wave(0.02, 3.0))
        yield observed("30 min, flares", k, 1500, 1800.0, 1.0, 3e-4, *many, vary=wave(0.02, 1.3))
        yield observed("1/f of 0.5 sigma", k, 500, 5.0, 1.0, 2e-3, vary=lambda _, red=red: red)
        yield observed("rise in a gap", k, 600, 5.0, 1e4, 50.0, Flare("davenport", 1500, 80, 0.5), without=(1380, 1530))
        yield observed("Tovar Mendoza", k, 720, 5.0, 1e4, 50.0, Flare("tovar-mendoza", 1200, 60, 0.2))
        yield observed("four peaks", k, 720, 5.0, 1e4, 50.0, *four)
        yield counts("issue", "3.64 counts", k, rng, 1500, 3.64, 10.0, 30.0)


def files(number: int, seed: int) -> Iterator[Trial]:
    """List the files that `--files` and `--cases` name, with the number of flares where it is known."""
    known = {"fast-2min": 0, "slow-30min": 0, "lc": 3}
    folders = ("rotating-star", "analyse-fault", "flags-on-flares") if OPTIONS.cases else ()
    cases = [path for folder in folders for path in sorted((OPTIONS.cases / folder).glob("*.fits"))]
    places = [sorted(place.rglob("*lc*.fits")) if place.is_dir() else [place] for place in OPTIONS.files]
    for path in (*cases, *(path for paths in places for path in paths)):
        mapping, name = path.with_suffix(".toml"), f"{path.parent.name}/{path.name}"
        flares = known.get(path.stem) if path in cases else None
        mapped = mapping if mapping.exists() else None
        yield Trial("files", name, 0, path=path, mapping=mapped, expected=flares)


PARTS: dict[str, Callable[[int, int], Iterator[Trial]]] = {
    "quiet": quiet, "short": short, "rotating-flares": rotating_flares, "poisson": poisson_counts, "spectra": spectra,
    "issue": issue, "files": files,
}  # fmt: skip


# ---- analysis -----------------------------------------------------------------------------------------------------

#: Energies of the answer: value, ends of the 68 % and of the 95 % interval, each a column or two with a factor.
ESTIMATES: dict[str, tuple[str, str, str, str, str]] = {
    "ed": ("ed", "ed_low", "ed_high", "ed_low_95", "ed_high_95"),
    "ed_rec": ("ed_rec", "ed_rec -1 ed_rec_err", "ed_rec +1 ed_rec_err", "ed_rec -1.96 ed_rec_err",
               "ed_rec +1.96 ed_rec_err"),
    "ed_fit": ("ed_fit", "ed_fit_low", "ed_fit_high", "ed_fit_low_95", "ed_fit_high_95"),
}  # fmt: skip


def column(row: dict[str, Any], words: str) -> float:
    """Return the value of a column, or of a column plus a multiple of another; NaN if the answer lacks it."""
    name, *more = words.split()
    value = float(row.get(name, np.nan))
    return value + float(more[0]) * float(row.get(more[1], np.nan)) if more else value


def plain(table: Any) -> list[dict[str, Any]]:
    """Return the rows of a table as dictionaries of numbers and text."""
    return [{name: getattr(row[name], "value", row[name]) for name in table.colnames} for row in table]


@dataclass
class Answer:
    """What `analyse` answers."""

    code: int
    message: str
    seconds: float
    events: list[dict[str, Any]] = field(default_factory=list)
    frames: Any = None
    threshold: float = np.nan


def written(trial: Trial, folder: Path) -> tuple[Path, Path | None]:
    """Write the frames of a trial to FITS; spectra need a mapping."""
    if trial.path is not None:
        return trial.path, trial.mapping
    path, mapping = folder / "frames.fits", None
    seconds = fits.Column("TIME", "D", unit="s", array=trial.time_s)
    length = fits.Column("EXPOSURE", "D", unit="s", array=np.full(trial.time_s.size, trial.exposure_s))
    if trial.wavelength_nm is None:
        table = [fits.BinTableHDU.from_columns([seconds, length, fits.Column("FLUX", "D", array=trial.flux)])]
    else:
        table = [
            fits.BinTableHDU.from_columns([seconds, length], name="FRAMES"),
            fits.BinTableHDU.from_columns([fits.Column("WAVELENGTH", "D", "nm", array=trial.wavelength_nm)], name="W"),
            fits.ImageHDU(trial.flux.astype(np.float32), name="SPECTRA"),
        ]
        mapping = folder / "frames.toml"
        mapping.write_text('time = "FRAMES/TIME"\nexposure = "FRAMES/EXPOSURE"\nflux = "SPECTRA"\n'
                           'flux_unit = "adu"\nwavelength = "W/WAVELENGTH"\n')  # fmt: skip
    fits.HDUList([fits.PrimaryHDU(), *table]).writeto(path)
    return path, mapping


def by_command_line(trial: Trial, flags: list[str]) -> Answer:
    """Analyse a trial by the command line, in this process."""
    from mauvecl.cli.app import app
    from mauvecl.cli.console import guarded

    with tempfile.TemporaryDirectory() as name:
        folder, said = Path(name), io.StringIO()
        path, mapping = written(trial, folder)
        star = ["--star", trial.star[0], "-m", str(trial.star[1])] if trial.star else []
        mapped = ["--mapping", str(mapping)] if mapping else []
        sys.argv = ["mauvecl", "analyse", str(path), *mapped, *star, "-o", str(folder / "out"), "--no-pictures", *flags]
        start = time.process_time()
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            code = guarded(app)
        seconds = time.process_time() - start
        if code:
            return Answer(code, said.getvalue().strip()[-400:], seconds)
        events = Table.read(folder / "out" / "events.ecsv", fill_values=None)
        frames = Table.read(folder / "out" / "frames.ecsv", fill_values=None)
        return Answer(0, said.getvalue(), seconds, plain(events), frames, float(events.meta["threshold"]))


def by_python(trial: Trial, flags: list[str]) -> Answer:
    """Analyse a trial by the Python interface."""
    from mauvecl import Frames, InputError, Study, analyse, read_frames

    given = dict(zip(flags[::2], flags[1::2], strict=True))
    search = {"false_alarms": float(given.get("--false-alarms", 1)), "per": given.get("--alarms-per", "month")}
    star = [{"library": trial.star[0], "magnitude": trial.star[1]}] if trial.star else None
    start = time.process_time()
    try:
        if trial.path is not None:
            frames = read_frames(trial.path, trial.mapping)
        else:
            what = {"wavelength_nm": trial.wavelength_nm, "unit": "adu"} if trial.star else {}
            frames = Frames.of(trial.time_s, trial.flux, exposure_s=trial.exposure_s, **what)
        answer = analyse(Study(search=search, **({"star": star} if star else {})), frames=frames)
    except InputError as error:
        return Answer(2, str(error), time.process_time() - start)
    except Exception:
        return Answer(70, traceback.format_exc()[-400:], time.process_time() - start)
    seconds, said = time.process_time() - start, "\n".join(answer.messages)
    return Answer(0, said, seconds, plain(answer.events), answer.frames, float(answer.events.meta["threshold"]))


def record_of(trial: Trial, answer: Answer) -> dict[str, Any]:
    """Compare an answer with the truth."""
    record: dict[str, Any] = {
        "part": trial.part, "kind": trial.kind, "seed": trial.seed, "code": answer.code, "seconds": answer.seconds,
        "n_frames": int(trial.time_s.size), "cadence": trial.exposure_s, "threshold": answer.threshold,
        "message": answer.message if answer.code else "", "snr": max((one.snr for one in trial.flares), default=np.nan),
        "flares": [asdict(one) for one in trial.flares], "events": [], "further": 0, "candidates": 0, "missed": 0,
        "expected": np.nan if trial.expected is None else trial.expected,
    }  # fmt: skip
    if answer.code:
        return record
    searched = np.array([not str(reason) for reason in answer.frames["reason"]])
    good = ~trial.lost if trial.lost is not None and trial.lost.size == searched.size else np.ones_like(searched)
    time_d, level, error = (
        np.asarray(getattr(answer.frames[name], "value", answer.frames[name]), float)
        for name in ("time", "level", "error")
    )
    cadence = trial.exposure_s or float(np.median(np.diff(time_d))) * DAY_S
    same = trial.wavelength_nm is None and level.size == trial.time_s.size
    record |= {
        "searched": float(searched.mean()), "searched_good": float(searched[good].mean()),
        "days": float(searched.sum()) * cadence / DAY_S,
        "noise": float(np.nanmedian(error)) / trial.noise,
        "level": float(np.nanmedian(level / trial.level)) if same else np.nan,
        "no_verdict": "no verdict" in answer.message.lower()
        or any("no verdict" in str(event["verdict"]) for event in answer.events),
    }  # fmt: skip
    # Times of the answer count from time zero of the file, which for generated files is that of the trial.
    for event in answer.events:
        event["flares"] = []
    for flare in trial.flares:
        close = [
            (max(0.0, one["tstart"] * DAY_S - flare.peak_s, flare.peak_s - one["tstop"] * DAY_S), -one["value"], k)
            for k, one in enumerate(answer.events)
        ]
        distance, _, best = min(close, default=(np.inf, 0.0, -1))
        if distance <= NEAR * flare.half_width_s + 2 * trial.exposure_s:
            answer.events[best]["flares"].append(flare)
        else:
            record["missed"] += 1
    for event in answer.events:
        verdict = str(event["verdict"])
        if not event["flares"]:
            record["further"] += verdict == "detected"
            record["candidates"] += verdict == "candidate"
        ends = [event[name] * DAY_S for name in ("tstart", "tstop")]
        truths = np.sum([trial.energies(one, *ends) for one in event["flares"]] or [[np.nan] * 3], axis=0)
        record["events"].append(
            {"verdict": verdict, "flares": len(event["flares"]), "snr": float(event["value"]), "start_s": ends[0],
             "stop_s": ends[1], "kind": str(event["kind"]), "note": str(event["note"]),
             "truth": dict(zip(("total", "inside", "event"), truths.tolist(), strict=True)),
             **{name: [column(event, each) for each in columns] for name, columns in ESTIMATES.items()}}
        )  # fmt: skip
    return record


def run(work: tuple[Trial, list[str], bool, int]) -> dict[str, Any]:
    """Analyse one trial, for at most some time."""
    trial, flags, python, limit = work

    def late(*_: Any) -> None:
        raise RuntimeError(f"took longer than {limit} s")

    signal.signal(signal.SIGALRM, late)
    signal.alarm(limit)
    try:
        return record_of(trial, (by_python if python else by_command_line)(trial, flags))
    finally:
        signal.alarm(0)


# ---- sums ---------------------------------------------------------------------------------------------------------


#: Columns of the table of results, and what they say.
RESULTS = {
    "part": "", "kind": "", "quantity": "",
    "value": "number, share, or median",
    "low": "lower end: 95 % of Poisson counts, smallest value, 16 % of ratios, or one error",
    "high": "upper end, likewise",
    "holds_68": "share of 68 % intervals that hold the truth",
    "holds_95": "share of 95 % intervals",
    "pull_sd": "standard deviation of (value - truth) / (half of the 68 % interval)",
    "of": "number of trials or events",
}  # fmt: skip
#: Bins of S/N for completeness where flares are faint.
SNR_BINS = ((4, 5), (5, 6), (6, 8), (8, 15))


def rows_of(part: str, kind: str, records: list[dict[str, Any]], promise_per_d: float) -> Iterator[tuple[Any, ...]]:
    """Yield what the trials of a kind amount to, in the columns of `RESULTS`."""
    done = [one for one in records if one["code"] == 0]

    def row(quantity: str, value: float, of: int, *more: float) -> tuple[Any, ...]:
        return part, kind, quantity, float(value), *(float(one) for one in (*more, *[np.nan] * 5)[:5]), of

    def spread(quantity: str, name: str) -> Iterator[tuple[Any, ...]]:
        values = np.array([one[name] for one in done], float)
        values = values[np.isfinite(values)]
        if values.size:
            yield row(quantity, np.median(values), values.size, values.min(), values.max())

    def complete(quantity: str, some: list[dict[str, Any]]) -> Iterator[tuple[Any, ...]]:
        if some:
            share = np.mean([any(e["verdict"] == "detected" and e["flares"] for e in one["events"]) for one in some])
            error = np.sqrt(max(share * (1 - share), 0.25 / len(some)) / len(some))
            yield row(quantity, share, len(some), share - error, share + error)

    yield row("refused", sum(one["code"] == 2 for one in records), len(records))
    yield row("faults", sum(one["code"] not in (0, 2) for one in records), len(records))
    if not done:
        return
    yield from spread("seconds", "seconds")
    yield from spread("share searched", "searched")
    yield from spread("share of frames without losses searched", "searched_good")
    yield from spread("noise / truth", "noise")
    yield from spread("level / truth", "level")
    yield row("without a verdict", sum(one["no_verdict"] for one in done), len(done))
    promised = promise_per_d * sum(one["days"] for one in done)
    name = "detections" if part == "files" else "false detections"
    yield row(f"promised {name}", promised, len(done), *poisson.ppf([0.025, 0.975], promised))
    yield row(name, sum(one["further"] for one in done), len(done), *[done[0]["expected"]] * 2)
    yield row("further candidates", sum(one["candidates"] for one in done), len(done))
    flaring = [one for one in records if one["flares"]]
    yield from complete("completeness", flaring)
    for low, high in SNR_BINS if part == "rotating-flares" else ():
        yield from complete(f"completeness, S/N {low}-{high}", [one for one in flaring if low <= one["snr"] < high])
    for faint, bright in (("", True), (", faint", False)):
        some = [one for one in flaring if (one["snr"] >= BRIGHT * one["threshold"]) is bright]
        main = [event for one in some for event in one["events"] if event["flares"] and event["verdict"] == "detected"]
        for estimate in ESTIMATES:
            for truth in ("total", "inside", "event"):
                table = np.array([[*event[estimate], event["truth"][truth]] for event in main]).reshape(-1, 6)
                table = table[np.isfinite(table[:, 0])]
                if not len(table):
                    continue
                value, low_68, high_68, low_95, high_95, true = table.T
                holds = [
                    np.mean(((low <= true) & (true <= high))[np.isfinite(low + high)])
                    if np.isfinite(low + high).any() else np.nan
                    for low, high in ((low_68, high_68), (low_95, high_95))
                ]  # fmt: skip
                pulls = (value - true) / ((high_68 - low_68) / 2)
                pull_sd = np.nanstd(pulls) if np.isfinite(pulls).sum() > 2 else np.nan
                low, ratio, high = np.percentile(value / true, [16, 50, 84])
                yield row(f"{estimate} / {truth}{faint}", ratio, len(table), low, high, *holds, pull_sd)


def table_of(rows: list[tuple[Any, ...]]) -> Table:
    """Build the table of results."""
    table = Table(rows=rows, names=list(RESULTS))
    for name, text in RESULTS.items():
        table[name].description = text or None
        if table[name].dtype.kind == "f":
            table[name].format = ".4g"
    return table


def trials() -> Iterator[Trial]:
    """Yield the trials that the options choose."""
    for part in OPTIONS.only or PARTS:
        for one in PARTS[part](OPTIONS.number, OPTIONS.seed):
            if not OPTIONS.kind or one.kind in OPTIONS.kind:
                yield one


def options(given: list[str] | None = None) -> argparse.Namespace:
    """Read the options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=PARTS, action="append", help="a part; may be repeated")
    parser.add_argument("--kind", action="append", help="a kind of its trials; may be repeated")
    parser.add_argument("--number", type=int, default=20, help="trials of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--python", action="store_true", help="call analyse() rather than the command line")
    parser.add_argument("--false-alarms", default="1")
    parser.add_argument("--alarms-per", default="month", choices=("day", "month", "year"))
    parser.add_argument("--limit", type=int, default=600, help="seconds after which a trial counts as a fault")
    parser.add_argument(
        "--files", type=Path, nargs="+", default=[], help="light curves or folders of *lc*.fits, with NAME.toml"
    )
    parser.add_argument("--cases", type=Path, help="folder with rotating-star, analyse-fault and flags-on-flares")
    parser.add_argument("--records", type=Path, help="JSON lines, one for each trial")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "real_stars.ecsv")
    return parser.parse_args(given)


def main() -> None:
    """Run the trials, print what each kind amounts to, and write the table."""
    flags = ["--false-alarms", OPTIONS.false_alarms, "--alarms-per", OPTIONS.alarms_per]
    work = ((trial, flags, OPTIONS.python, OPTIONS.limit) for trial in trials())
    records: dict[tuple[str, str], list[dict[str, Any]]] = {}
    with multiprocessing.get_context("spawn").Pool(OPTIONS.processes) if OPTIONS.processes > 1 else (
        contextlib.nullcontext()) as pool, (
        OPTIONS.records.open("w") if OPTIONS.records else contextlib.nullcontext()) as lines:  # fmt: skip
        for one in pool.imap_unordered(run, work) if pool else map(run, work):
            records.setdefault((one["part"], one["kind"]), []).append(one)
            if lines:
                print(json.dumps(one), file=lines, flush=True)
            print(one["part"], one["kind"], one["seed"], f"exit {one['code']}", f"{one['seconds']:.1f} s",
                  *(f"{each['verdict']} {each['snr']:.1f}" for each in one["events"]), one["message"][-200:],
                  flush=True)  # fmt: skip
    promise = float(OPTIONS.false_alarms) / {"day": 1.0, "month": 365.25 / 12, "year": 365.25}[OPTIONS.alarms_per]
    rows = [row for (part, kind), some in records.items() for row in rows_of(part, kind, some, promise)]
    for part in () if OPTIONS.kind else [one for one in PARTS if one not in ("issue", "files")]:
        whole = [one for (of, _), some in records.items() for one in some if of == part]
        rows += rows_of(part, "all", whole, promise) if whole else []
    new = {row[:2] for row in rows}
    old = Table.read(OPTIONS.output) if OPTIONS.output.exists() else []
    table = table_of([tuple(row) for row in old if (row["part"], row["kind"]) not in new] + rows)
    table.meta = {"date_utc": datetime.now(UTC).date().isoformat(), "false_alarms_per_day": promise}
    table.write(OPTIONS.output, format="ascii.ecsv", overwrite=True)
    table_of(rows).pprint_all()


# Processes that `spawn` starts import this file too, but have no options of their own.
OPTIONS = options() if __name__ == "__main__" else options([])

if __name__ == "__main__":
    main()
