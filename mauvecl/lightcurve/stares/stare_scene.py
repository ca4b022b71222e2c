"""Arrays that the stare kernels and their reference implementation read."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.stares.frame_components import MOST_STATISTICS, STEADY, Components
from mauvecl.noise import layout
from mauvecl.noise.cumulants import Cumulants, joint_is_exact
from mauvecl.noise.pixel_tables import padded
from mauvecl.noise.processes import NONE, Processes
from mauvecl.noise.scene import Scene, prepare
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.lightcurve.stares.stare import Stare

Float = NDArray[np.float64]
Floats = NDArray[np.float32]

#: Deviation of conditions from their known values up to which frames are checked, in standard deviations.
REACH_SIGMA = 7.0
#: Largest number of unknowns of a stare, and of scenarios on common draws.
MOST_UNKNOWNS, MOST_SCENARIOS = 32, 16
#: Largest amplitude of a flare.
LARGEST = 1e12
#: Distance of a count from its base up to which the device rounds to whole DN.
REACH_DN = 2.0**22


@dataclass(frozen=True, eq=False)
class Flares:
    """Flares that are added to stares."""

    # Amplitude of each flare spectrum in each frame, shape (n_row, n_frame, n_flare), with one row or one per stare.
    given: NDArray[Any]
    amplitudes: Floats  # factors on `given`, shape (n_scenario, n_amplitude_row)

    @classmethod
    def of(cls, components: Components, stare: Stare, flare: Any, amplitudes: Any, count: int) -> Self:
        """Validate the arguments of `Stares.frames`; raises InputError for wrong shapes and negative values."""
        n_frames, n_flares = stare.n_frames, components.n_flares
        given = np.zeros((1, n_frames, n_flares), np.float32) if flare is None else np.asarray(flare)
        if given.ndim == 2:
            given = given[None]
        if given.shape[1:] != (n_frames, n_flares) or given.shape[0] not in (1, count):
            raise InputError(
                f"flare coefficients have the shape {given.shape}",
                f"({count}, {n_frames}, {n_flares}), or one row for all stares",
                key="flare",
                value=given.shape,
            )
        factors = np.ones((1, 1)) if amplitudes is None else np.asarray(amplitudes)
        if factors.ndim != 2 or factors.shape[1] not in (1, count) or not 1 <= len(factors) <= MOST_SCENARIOS:
            raise InputError(
                f"amplitudes have the shape {factors.shape}",
                f"(n, {count}) or (n, 1) with n of 1 to {MOST_SCENARIOS} scenarios",
                key="amplitudes",
                value=factors.shape,
            )
        # The minimum of values that include NaN is NaN.
        ends = [("flare coefficients", given.min(initial=0.0)), ("amplitudes", factors.min(initial=0.0))]
        ends += [("flare coefficients", most) for most in _largest(given)] + [("amplitudes", factors.max())]
        for what, end in ends:
            if not 0 <= end <= LARGEST:
                raise InputError.of(what, end, f"0 to {LARGEST:g}")
        return cls(given, factors.astype(np.float32))

    @cached_property
    def rows(self) -> Floats:
        """Amplitudes for the kernels, shape (n_row, n_flare, n_padded_frame)."""
        n_row, n_frames, n_flares = self.given.shape
        rows = np.zeros((n_row, n_flares, padded_frames(n_frames)), np.float32)
        rows[:, :, :n_frames] = np.moveaxis(self.given, 2, 1)
        return rows

    def part(self, first: int, count: int) -> Flares:
        """Return the flares of some stares."""
        there = slice(first, first + count)
        amplitudes = self.amplitudes if self.amplitudes.shape[1] == 1 else self.amplitudes[:, there]
        return Flares(self.given if len(self.given) == 1 else self.given[there], np.ascontiguousarray(amplitudes))

    @cached_property
    def most(self) -> Float:
        """Largest coefficient of each spectrum, shape (n_flare,)."""
        return np.array(_largest(self.given), np.float64) * float(self.amplitudes.max())


@dataclass(frozen=True, eq=False)
class StareScene:
    """Arrays of a stare that a launch reads."""

    components: Components
    stare: Stare
    scene: Scene  # of one quiescent frame, for addresses, clipping and additive processes
    numbers: NDArray[np.uint32]  # of frames, including gaps, shape (n_padded_frame,)
    #: Star, sky, dark and neighbours, each followed by its value minus one; then all light. Shape (9, n_padded_frame).
    known: Floats
    curves: Floats  # of the stare's unknowns, times their standard deviations, shape (n_unknown, n_padded_frame)
    kinds: NDArray[np.uint32]  # rows of `layout.MOVED`, shape (n_unknown,)
    stare_job: NDArray[np.void]  # of `layout.STARE_JOB`, without the values of flares, shape ()
    mixtures: NDArray[np.void]  # of `layout.MIXTURE`, shape (n_padded,)
    spectra: Floats  # DN of flares of unit amplitude, shape (n_flare, n_padded)
    weights: Floats  # shape (n_statistic, n_padded)
    constants: Floats  # added to each sum, since kernels omit whole DN, shape (n_statistic,)

    @classmethod
    def of(cls, components: Components, stare: Stare, processes: Processes = NONE) -> Self:
        """Build the arrays.

        Raises InputError if the quiescent frame cannot be drawn jointly, or there are too many sums or unknowns.
        """
        x, n_pixel = components.quiet, components.quiet.wavelength_nm.size
        if abs(stare.frame_s - x.frame_s) > 1e-9 * x.frame_s:
            raise InputError.of("frame_s", stare.frame_s, f"the instrument's {x.frame_s:g} s")
        if components.n_statistics > MOST_STATISTICS:
            raise InputError.of("weights", components.n_statistics, f"at most {MOST_STATISTICS} spectral weights")
        if len(stare.unknowns) > MOST_UNKNOWNS:
            raise InputError.of("unknowns", len(stare.unknowns), f"at most {MOST_UNKNOWNS} of a stare")
        for name, _ in processes.modulations:
            raise InputError(f"{name} is a prior of exposures", "an unknown of the stare", key=name)
        scene = prepare([x], processes=processes)
        if not scene.joint:
            raise _not_joint_error(x.name)
        size = padded(n_pixel)
        mixtures = np.zeros(size, layout.MIXTURE)
        mixtures["variance"] = 1.0
        mixtures["rest"][:n_pixel] = x.mean_raw_dn - scene.base_dn[0]
        for row, name in enumerate(STEADY):
            mixtures[name][:n_pixel] = components.mean_dn[row]
        for order, name in ((2, "variance"), (3, "third"), (4, "fourth"), (5, "fifth")):
            constant, each = components.pixel_cumulants(order)
            # Rounding is done by the kernels.
            constant = constant - {2: 1 / 12, 4: -1 / 120}.get(order, 0.0)
            mixtures[name][:n_pixel] = constant + each[: len(STEADY)].sum(axis=0)
            mixtures[f"dark_{name}"][:n_pixel] = each[2]
            mixtures[f"photon_{name}"][:n_pixel] = (
                x.gain_dn_per_electron ** (order - 1) if order == 2 or x.photon_noise == "poisson" else 0.0
            )
        spectra = np.zeros((components.n_flares, size), np.float32)
        spectra[:, :n_pixel] = components.mean_dn[len(STEADY) :]
        weights = np.zeros((components.n_statistics, size), np.float32)
        weights[:, :n_pixel] = components.weights
        constants = weights[:, :n_pixel].astype(np.float64) @ (scene.base_dn[0] - x.mean_raw_dn)
        stare_job = np.zeros((), layout.STARE_JOB)
        stare_job["frame_count"], stare_job["padded_frames"] = stare.n_frames, padded_frames(stare.n_frames)
        stare_job["unknown_count"], stare_job["jittered"] = len(stare.unknowns), any(stare.jitters.values())
        stare_job["light_jitter"], stare_job["sky_jitter"] = stare.light_jitter, stare.sky_jitter
        stare_job["temperature_jitter"] = stare.temperature_jitter_c
        stare_job["dark_slope"] = x.conditions["dark_slope_per_c"]
        curves = np.reshape([u.sd * u.curve for u in stare.unknowns], (len(stare.unknowns), stare.n_frames))
        return cls(
            components,
            stare,
            scene,
            _padded(stare.numbers, np.uint32),
            _known(components, stare),
            _padded(curves, np.float32),
            np.array([layout.MOVED.index(u.of) for u in stare.unknowns], np.uint32),
            stare_job,
            mixtures,
            spectra,
            weights,
            constants.astype(np.float32),
        )

    @property
    def counts(self) -> bool:
        """True if photons are Poisson counts."""
        return self.components.quiet.photon_noise == "poisson"

    def stare_struct(self, flares: Flares) -> NDArray[np.void]:
        """Return the `layout.STARE_JOB` structure with the values of flares, shape (1,)."""
        stare_job = self.stare_job.copy()
        stare_job["scenario_count"], stare_job["amplitude_rows"] = flares.amplitudes.shape
        stare_job["flare_rows"] = len(flares.given)
        return stare_job.reshape(1)

    def losses(self, numbers: NDArray[np.uint64], seed: int) -> Floats:
        """Return the share of all light that padded frames of stares lose, shape (n_stare, n_padded_frame)."""
        return np.asarray(_padded(self.stare.pointing_losses(numbers, seed), np.float32))

    def job(self, seed: int) -> NDArray[np.void]:
        """Return the job of a frame with a seed, shape (1,)."""
        job = self.scene.job.copy()
        job["seed_low"], job["seed_high"] = seed & 0xFFFFFFFF, seed >> 32
        return job.reshape(1)

    def conditions(self, flares: Flares) -> Conditions:
        """Return the range of the frames' conditions."""
        low, high = self._ends
        mean = self.components.mean_dn
        darkest = low[0] * mean[0] + low[1] * mean[1] + low[3] * mean[3]
        brightest = high[0] * mean[0] + high[1] * mean[1] + high[3] * (mean[3] + flares.most @ mean[len(STEADY) :])
        return Conditions(darkest.tobytes(), brightest.tobytes(), float(low[2]), float(high[2]))

    @property
    def _ends(self) -> tuple[Float, Float]:
        """Smallest and largest factors on star, sky, dark, and neighbours and flares."""
        stare, spread = self.stare, self._spreads
        ends = []
        for sign, of in ((-1.0, np.min), (1.0, np.max)):
            light, star, sky = (1.0 + sign * REACH_SIGMA * spread[name] for name in ("light", "star", "sky"))
            if sign < 0 and stare.pointing is not None:
                light = light * (1.0 - stare.pointing.depth)
            warm = np.exp(sign * REACH_SIGMA * abs(self.stare_job["dark_slope"]) * spread["temperature"])
            known = (stare.light * stare.star * light * star, stare.light * stare.sky * light * sky)
            dark = stare.dark_factor(self.components.quiet) * warm
            ends.append(np.array([float(of(values)) for values in (*known, dark, stare.light * light)]))
        return ends[0], ends[1]

    @property
    def _spreads(self) -> dict[str, Float]:
        """Standard deviations of the conditions that are drawn for each frame, shape (n_frame,) each."""
        variances = {of: np.full(self.stare.n_frames, self.stare.jitters.get(of, 0.0) ** 2) for of in layout.MOVED}
        for unknown in self.stare.unknowns:
            variances[unknown.of] += (unknown.sd * unknown.curve) ** 2
        return {of: np.sqrt(variance) for of, variance in variances.items()}

    def check(self, flares: Flares) -> None:
        """Raise InputError if light may be negative, counts exceed the range of rounding, or noise is not joint."""
        spread = self._spreads
        for of in ("light", "star", "sky"):
            if (REACH_SIGMA * spread[of] >= 1.0).any():
                raise InputError(
                    f"the {of} of a frame scatters by {float(spread[of].max()):.3g}",
                    f"less than {1 / REACH_SIGMA:.3g}, so that it is never drawn below zero",
                    key=of,
                    value=float(spread[of].max()),
                )
        x, mean = self.components.quiet, self.components.mean_dn
        _, high = self._ends
        lit = mean[3] + flares.most @ mean[len(STEADY) :]
        reach = high[0] * mean[0] + high[1] * mean[1] + high[2] * mean[2] + high[3] * lit
        if not (reach < REACH_DN).all():
            pixel = int(np.argmax(~(reach < REACH_DN)))
            raise InputError(
                f"the stare carries pixel {pixel} of {x.name} to {reach[pixel]:.3g} DN in a frame",
                f"less than {REACH_DN:g}",
                key="flare",
                value=float(reach[pixel]),
            )
        if not _joint_throughout(x, self.conditions(flares)):
            raise _not_joint_error(x.name)


@dataclass(frozen=True)
class Conditions:
    """Range of the conditions of frames; hashable, so that what holds for all of them is computed once."""

    darkest: bytes  # photons in DN of each pixel, float64
    brightest: bytes
    least_dark: float  # factor on the dark
    most_dark: float

    def __iter__(self) -> Iterator[tuple[Float, float]]:
        """Yield photons in DN of each pixel and factors on the dark, in steps of at most a factor of 2."""
        darkest, brightest = np.frombuffer(self.darkest), np.frombuffer(self.brightest)
        span = float(np.max(brightest / np.maximum(darkest, 1e-30), initial=1.0, where=brightest > 1e-9))
        steps = 1 + int(np.ceil(np.log2(min(span, 2.0**20))))
        for part in np.linspace(0.0, 1.0, steps + 1):
            light = np.maximum(darkest, 1e-30) ** (1 - part) * np.maximum(brightest, 1e-30) ** part
            number = 2 + int(np.log2(self.most_dark / self.least_dark))
            for dark in np.geomspace(self.least_dark, self.most_dark, number):
                yield light, float(dark)


# The pixels of a stare are drawn in many parts.
@lru_cache(maxsize=4)
def _joint_throughout(x: Expectation, conditions: Conditions) -> bool:
    one, counts = Cumulants.of(x, 1), x.photon_noise == "poisson"
    for light, dark in conditions:
        photons = light / x.gain_dn_per_electron
        other = x.read_noise_dn**2 + (0.0 if counts else x.gain_dn_per_electron * light)
        if not joint_is_exact(replace(one, gaussian=other, photons=photons, dark_dn=dark * one.dark_dn)).all():
            return False
    return True


def padded_frames(n_frames: int) -> int:
    """Return the number of frames including padding."""
    return -(-n_frames // layout.FRAME_BLOCK) * layout.FRAME_BLOCK


def unique(n: int, order: int) -> list[tuple[int, ...]]:
    """Return the unique indices of a symmetric tensor in the order of the kernels: (0, 0), (1, 0), (1, 1), ..."""
    return sorted(tuple(sorted(key, reverse=True)) for key in itertools.combinations_with_replacement(range(n), order))


def _largest(given: NDArray[Any]) -> list[float]:
    """Return the maximum of each spectrum, one by one since NumPy is slow over the other axes."""
    return [float(given[..., j].max()) for j in range(given.shape[-1])]


def _padded(values: NDArray[Any], kind: type) -> NDArray[Any]:
    """Pad with zeros to whole blocks of frames."""
    more = padded_frames(values.shape[-1]) - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, more)]).astype(kind)


def _known(components: Components, stare: Stare) -> Floats:
    rows = components.coefficients(stare)[:, : len(STEADY)].T
    changes = [part for row in rows for part in (row, row - 1.0)]
    return np.asarray(_padded(np.stack([*changes, stare.light]), np.float32))


def _not_joint_error(name: str) -> InputError:
    return InputError(
        f"the noise of a frame of {name} cannot be drawn jointly under all conditions of the stare",
        "Gaussian noise with the variance of at least 1.5 Poisson counts in each pixel, and more where counts are few",
        key="recipe",
        value="joint",
    )
