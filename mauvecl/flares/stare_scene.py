"""Stares as arrays that kernels read, requests for them, and the cumulants of their sums.

Weighted sums of a frame are drawn from their joint cumulants, without drawing pixels. The cumulants of independent
counts add up, so those of the sums are exact. A frame is drawn as the Cholesky factor of the sums times normals. A
quadratic function of all normals is added to each, which reproduces the third cumulants, and if needed a cubic function
(Cornish & Fisher 1938, doi 10.2307/1400905, in several dimensions).
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.detection.requests import ShardedRequest
from mauvecl.flares.frames import MOST_STATISTICS, ROUNDING, STEADY, Components
from mauvecl.flares.stare import Stare
from mauvecl.host.arrays import Arrays, Float
from mauvecl.noise import layout
from mauvecl.noise.disturbances import ADDITIVE
from mauvecl.noise.drawing import Cumulants, joint_is_exact, truncation_distance
from mauvecl.noise.scene import REACH_DN, Scene, padded, prepare
from mauvecl.noise.unknowns import CHANGING, NONE, Processes
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Realisations, Seed

Floats = NDArray[np.float32]

#: Deviation of conditions from their known values up to which frames are checked, in standard deviations.
REACH_SIGMA = 7.0
#: Largest number of unknowns of a stare, and of scenarios on common draws.
MOST_UNKNOWNS, MOST_SCENARIOS = 32, 16
#: Largest amplitude of a flare.
LARGEST = 1e12


@dataclass(frozen=True, eq=False)
class Flares:
    """Flares that are added to stares."""

    # Amplitude of each flare spectrum in each frame, shape (n_row, n_frame, n_flare), with one row or one per stare.
    coefficients: NDArray[Any]
    amplitudes: Floats  # factors on `coefficients`, shape (n_scenario, n_amplitude_row)

    @classmethod
    def of(cls, components: Components, stare: Stare, flare: Any, amplitudes: Any, count: int) -> Self:
        """Validate the arguments of `Stares.frames`; raises InputError for wrong shapes and negative values."""
        n_frames, n_flares = stare.n_frames, components.n_flares
        coefficients = np.zeros((1, n_frames, n_flares), np.float32) if flare is None else np.asarray(flare)
        if coefficients.ndim == 2:
            coefficients = coefficients[None]
        if coefficients.shape[1:] != (n_frames, n_flares) or coefficients.shape[0] not in (1, count):
            raise InputError(
                f"flare coefficients must have the shape ({count}, {n_frames}, {n_flares}), or one row for all stares, "
                f"not {coefficients.shape}",
                key="flare",
            )
        factors = np.ones((1, 1)) if amplitudes is None else np.asarray(amplitudes)
        if factors.ndim != 2 or factors.shape[1] not in (1, count) or not 1 <= len(factors) <= MOST_SCENARIOS:
            raise InputError(
                f"amplitudes must have the shape (n, {count}) or (n, 1) with n from 1 to {MOST_SCENARIOS} scenarios, "
                f"not {factors.shape}",
                key="amplitudes",
            )
        for name, values in (("flare coefficients", coefficients), ("amplitudes", factors)):
            # The ends of values that include NaN are NaN.
            for end in (values.min(initial=0.0), values.max(initial=0.0)):
                if not 0 <= end <= LARGEST:
                    raise InputError.of(name, end, f"between 0 and {LARGEST:g}")
        return cls(coefficients, factors.astype(np.float32))

    @cached_property
    def rows(self) -> Floats:
        """Amplitudes for the kernels, shape (n_row, n_flare, n_padded_frame)."""
        n_row, n_frames, n_flares = self.coefficients.shape
        rows = np.zeros((n_row, n_flares, padded_frames(n_frames)), np.float32)
        rows[:, :, :n_frames] = np.moveaxis(self.coefficients, 2, 1)
        return rows

    def part(self, first: int, count: int) -> Flares:
        """Return the flares of some stares."""
        part = slice(first, first + count)
        amplitudes = self.amplitudes if self.amplitudes.shape[1] == 1 else self.amplitudes[:, part]
        coefficients = self.coefficients if len(self.coefficients) == 1 else self.coefficients[part]
        return Flares(coefficients, np.ascontiguousarray(amplitudes))

    @cached_property
    def most(self) -> Float:
        """Largest coefficient of each spectrum, shape (n_flare,)."""
        return np.asarray(self.coefficients.max(axis=(0, 1)) * np.float64(self.amplitudes.max()))


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
    kinds: NDArray[np.uint32]  # indices of `CHANGING`, shape (n_unknown,)
    mixtures: NDArray[np.void]  # of `layout.MIXTURE`, shape (n_padded,)
    spectra: Floats  # DN of flares of unit amplitude, shape (n_flare, n_padded)
    weights: Floats  # shape (n_statistic, n_padded)
    constants: Floats  # added to each sum, since kernels omit whole DN, shape (n_statistic,)

    @classmethod
    def of(cls, components: Components, stare: Stare, processes: Processes = NONE) -> Self:
        """Build the arrays; raises InputError for frames that are not drawn jointly, or too many sums or unknowns."""
        x, n_pixel = components.quiet, components.quiet.wavelength_nm.size
        if abs(stare.frame_s - x.frame_s) > 1e-9 * x.frame_s:
            raise InputError.of("frame_s", stare.frame_s, f"the instrument's {x.frame_s:g} s")
        if components.n_statistics > MOST_STATISTICS:
            raise InputError.of("weights", components.n_statistics, f"at most {MOST_STATISTICS} spectral weights")
        if len(stare.unknowns) > MOST_UNKNOWNS:
            raise InputError.of("unknowns", len(stare.unknowns), f"at most {MOST_UNKNOWNS} of a stare")
        for name, _ in processes.modulations:
            raise InputError(f"{name} is a prior of exposures; use an unknown of the stare", key=name)
        scene = prepare([x], processes=processes)
        if not scene.joint:
            raise _not_joint_error(x.name)
        size = padded(n_pixel)
        spectra = np.zeros((components.n_flares, size), np.float32)
        spectra[:, :n_pixel] = components.mean_dn[len(STEADY) :]
        weights = np.zeros((components.n_statistics, size), np.float32)
        weights[:, :n_pixel] = components.weights
        constants = weights[:, :n_pixel].astype(np.float64) @ (scene.base_dn[0] - x.mean_raw_dn)
        curves = np.reshape([u.sd * u.curve for u in stare.unknowns], (len(stare.unknowns), stare.n_frames))
        factors = [part for row in components.coefficients(stare).T[: len(STEADY)] for part in (row, row - 1.0)]
        return cls(
            components, stare, scene, numbers=_padded(stare.numbers, np.uint32),
            known=_padded(np.stack([*factors, stare.light]), np.float32), curves=_padded(curves, np.float32),
            kinds=np.array([CHANGING.index(u.of) for u in stare.unknowns], np.uint32),
            mixtures=_mixtures(components, scene.base_dn[0]), spectra=spectra, weights=weights,
            constants=constants.astype(np.float32),
        )  # fmt: skip

    @property
    def counts(self) -> bool:
        """True if photons are Poisson counts."""
        return self.components.quiet.photon_noise == "poisson"

    def stare_struct(self, flares: Flares) -> NDArray[np.void]:
        """Return the `layout.STARE_JOB` structure, shape (1,)."""
        job, stare = np.zeros(1, layout.STARE_JOB), self.stare
        job["frame_count"], job["padded_frames"] = stare.n_frames, padded_frames(stare.n_frames)
        job["unknown_count"], job["jittered"] = len(stare.unknowns), any(stare.jitters.values())
        job["light_jitter"], job["sky_jitter"] = stare.light_jitter, stare.sky_jitter
        job["temperature_jitter"] = stare.temperature_jitter_c
        job["dark_slope"] = self.components.quiet.conditions["dark_slope_per_c"]
        job["scenario_count"], job["amplitude_rows"] = flares.amplitudes.shape
        job["flare_rows"] = len(flares.coefficients)
        return job

    def losses(self, numbers: NDArray[np.uint64], seed: int) -> Floats:
        """Return the share of all light that padded frames of stares lose, shape (n_stare, n_padded_frame)."""
        return np.asarray(_padded(self.stare.pointing_losses(numbers, seed), np.float32))

    def conditions(self, flares: Flares) -> tuple[Float, Float]:
        """Return conditions that the frames may have, in steps of at most a factor of 2.

        These are the photons of each pixel in DN, (n_condition, n_pixel), and factors on the dark, (n_condition, 1).
        """
        low, high = self._ends
        mean = self.components.mean_dn
        darkest = np.maximum(low[0] * mean[0] + low[1] * mean[1] + low[3] * mean[3], 1e-30)
        lit = mean[3] + flares.most @ mean[len(STEADY) :]
        brightest = np.maximum(high[0] * mean[0] + high[1] * mean[1] + high[3] * lit, 1e-30)
        span = float(np.max(brightest / darkest, initial=1.0, where=brightest > 1e-9))
        part = np.linspace(0.0, 1.0, 2 + int(np.ceil(np.log2(min(span, 2.0**20)))))[:, None]
        dark = np.geomspace(low[2], high[2], 2 + int(np.log2(high[2] / low[2])))
        photons_dn = np.repeat(darkest ** (1 - part) * brightest**part, dark.size, axis=0)
        return photons_dn, np.tile(dark, part.size)[:, None]

    @property
    def _ends(self) -> tuple[Float, Float]:
        """Smallest and largest factors on star, sky, dark, and neighbours and flares."""
        stare, spread, quiet = self.stare, self._spreads, self.components.quiet
        ends = []
        for sign, extreme in ((-1.0, np.min), (1.0, np.max)):
            light, star, sky = (1.0 + sign * REACH_SIGMA * spread[name] for name in ("light", "star", "sky"))
            if sign < 0 and stare.pointing is not None:
                light = light * (1.0 - stare.pointing.depth)
            warm = np.exp(sign * REACH_SIGMA * abs(quiet.conditions["dark_slope_per_c"]) * spread["temperature"])
            lights = (stare.light * stare.star * light * star, stare.light * stare.sky * light * sky)
            dark = stare.dark_factor(quiet) * warm
            ends.append(np.array([float(extreme(values)) for values in (*lights, dark, stare.light * light)]))
        return ends[0], ends[1]

    @property
    def _spreads(self) -> dict[str, Float]:
        """Standard deviations of the conditions that are drawn for each frame, shape (n_frame,) each."""
        variances = {of: np.full(self.stare.n_frames, self.stare.jitters.get(of, 0.0) ** 2) for of in CHANGING}
        for unknown in self.stare.unknowns:
            variances[unknown.of] += (unknown.sd * unknown.curve) ** 2
        return {of: np.sqrt(variance) for of, variance in variances.items()}

    def check(self, flares: Flares) -> None:
        """Raise InputError if light may be negative, counts exceed the range of rounding, or noise is not joint."""
        spread = self._spreads
        for of in ("light", "star", "sky"):
            if (REACH_SIGMA * spread[of] >= 1.0).any():
                raise InputError(
                    f"the {of} of a frame scatters by {float(spread[of].max()):.3g}, but must scatter by less than "
                    f"{1 / REACH_SIGMA:.3g}, so that it is never drawn below zero",
                    key=of,
                )
        x, mean = self.components.quiet, self.components.mean_dn
        _, high = self._ends
        lit = mean[3] + flares.most @ mean[len(STEADY) :]
        reach = high[0] * mean[0] + high[1] * mean[1] + high[2] * mean[2] + high[3] * lit
        if not (reach < REACH_DN).all():
            pixel = int(np.argmax(~(reach < REACH_DN)))
            raise InputError(
                f"the stare carries pixel {pixel} of {x.name} to {reach[pixel]:.3g} DN in a frame, but must stay below "
                f"{REACH_DN:g} DN",
                key="flare",
            )
        photons_dn, dark = self.conditions(flares)
        other = x.read_noise_dn**2 + (0.0 if self.counts else x.gain_dn_per_electron * photons_dn)
        cumulants, photons = Cumulants.of(x, 1), photons_dn / x.gain_dn_per_electron
        moved = replace(cumulants, gaussian=other, photons=photons, dark_dn=dark * cumulants.dark_dn)
        if not joint_is_exact(moved).all():
            raise _not_joint_error(x.name)


def padded_frames(n_frames: int) -> int:
    """Return the number of frames including padding."""
    return -(-n_frames // layout.FRAME_BLOCK) * layout.FRAME_BLOCK


def unique(n: int, order: int) -> list[tuple[int, ...]]:
    """Return the unique indices of a symmetric tensor in the order of the kernels: (0, 0), (1, 0), (1, 1), ..."""
    return sorted(tuple(sorted(key, reverse=True)) for key in itertools.combinations_with_replacement(range(n), order))


def _padded(values: NDArray[Any], kind: type) -> NDArray[Any]:
    """Pad with zeros to full blocks of frames."""
    padding = padded_frames(values.shape[-1]) - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, padding)]).astype(kind)


def _mixtures(components: Components, base_dn: NDArray[np.int64]) -> NDArray[np.void]:
    """Return the `layout.MIXTURE` structures, shape (n_padded,)."""
    x, n_pixel = components.quiet, components.quiet.wavelength_nm.size
    mixtures = np.zeros(padded(n_pixel), layout.MIXTURE)
    mixtures["variance"] = 1.0
    mixtures["rest"][:n_pixel] = x.mean_raw_dn - base_dn
    for row, name in enumerate(STEADY):
        mixtures[name][:n_pixel] = components.mean_dn[row]
    for order, name in enumerate(layout.CUMULANTS, 2):
        constant, by_component = components.pixel_cumulants(order)
        # Rounding is done by the kernels.
        constant = constant - ROUNDING.get(order, 0.0)
        mixtures[name][:n_pixel] = constant + by_component[: len(STEADY)].sum(axis=0)
        mixtures[f"dark_{name}"][:n_pixel] = by_component[2]
        mixtures[f"photon_{name}"][:n_pixel] = (
            x.gain_dn_per_electron ** (order - 1) if order == 2 or x.photon_noise == "poisson" else 0.0
        )
    return mixtures


def _not_joint_error(name: str) -> InputError:
    """Return the error of frames whose noise is not Gaussian enough."""
    return InputError(
        f"the noise of a frame of {name} cannot be drawn jointly under all conditions of the stare: it must be "
        "Gaussian with the variance of at least 1.5 Poisson counts in each pixel, and more where counts are few",
        key="recipe",
    )


Method = Literal["pixels", "cumulants"]
StareNumber = Annotated[int, Range(0, 2**64 - 1)]

#: Approximate cost of reducing a frame of a scenario by Fourier transforms, in draws of a pixel.
REDUCED = 500


class Reduction(Protocol):
    """Reduction of stares to results: a frozen dataclass, which can be pickled and identified by its content.

    It is called as ``reduction(values, first)`` and returns arrays by name for stares from `first` on, which do not
    depend on each other. ``values`` are float32, (n_stare, n_frame, n_statistic), preceded by an
    axis of scenarios if there are several; they are valid only during the call. If the request has `glow`, it is
    called as ``reduction(values, first, glow)`` with an array of shape (n_stare, n_frame, n_statistic + 1).
    """

    #: True if results are integers that are summed over stares; otherwise, arrays are joined in the order of stares.
    adds: ClassVar[bool]

    @property
    def __call__(self) -> Callable[..., Mapping[str, NDArray[Any]]]:
        """Reduce stares; see the class."""


@validated
@dataclass(frozen=True, eq=False)
class StaresRequest(ShardedRequest):
    """Request for stares; flares and amplitudes as for `Stares.frames`."""

    components: Components
    stare: Stare
    realisations: Realisations  #: number of stares
    seed: Seed
    flare: NDArray[Any] | None = None
    amplitudes: NDArray[Any] | None = None
    start: StareNumber = 0  #: number of the first stare
    method: Method = "cumulants"
    processes: Processes = NONE
    reduction: Reduction | None = None  #: by default, statistics are returned as they are
    #: Whether the reduction also receives the draws for flares that it adds: a standard normal per statistic, for their
    #: photon noise, and the factor on all light minus one.
    glow: bool = False
    #: Number of the stare of the first row of flares and amplitudes, if these differ between stares.
    rows_from: int = field(init=False, default=0)

    least: ClassVar[int] = 64

    def __post_init__(self) -> None:
        if len(self.flares.coefficients) > 1 or self.flares.amplitudes.shape[1] > 1:
            object.__setattr__(self, "rows_from", self.start)

    @cached_property
    def flares(self) -> Flares:
        """Flares of all stares."""
        return Flares.of(self.components, self.stare, self.flare, self.amplitudes, self.realisations)

    @property
    def work(self) -> int:
        """Approximate cost of a stare, in draws of a pixel."""
        drawn = (
            self.components.quiet.wavelength_nm.size if self.method == "pixels" else 4 * self.components.n_statistics
        )
        return self.stare.n_frames * (drawn + len(self.flares.amplitudes) * (REDUCED if self.reduction else 0))

    @property
    def reducing(self) -> Reduction:
        """The reduction, or what returns statistics as they are."""
        return self.reduction or IdentityReduction()


@dataclass(frozen=True)
class IdentityReduction:
    """Reduction that returns the statistics, and the draws for flares if there are any, as they are."""

    adds: ClassVar[bool] = False

    def __call__(self, values: Floats, first: int, glow: Floats | None = None) -> Arrays:
        """Return one row per stare, with scenarios on the second axis."""
        arrays = {"values": np.moveaxis(values, 0, 1).copy() if values.ndim == 4 else values.copy()}
        return arrays if glow is None else arrays | {"glow": glow.copy()}


def joined(request: StaresRequest, parts: Sequence[Arrays]) -> Arrays:
    """Join the results of parts or shards of a request, which are in the order of stares."""
    together = (lambda arrays: np.sum(arrays, axis=0)) if request.reducing.adds else np.concatenate
    return {name: np.asarray(together([part[name] for part in parts])) for name in parts[0] if name != "start"}


#: Number of frames after which Pearson's test would notice the neglected cumulants at five sigma: sixteen thousand
#: star-years of 5 s.
FRAMES_TO_NOTICE = 1e11
#: Number of classes of that test: range in standard deviations that contains all but 1e-14.
CLASSES = 15.3
#: Smallest distance of a pixel's mean from zero and saturation, in standard deviations.
RAIL_SIGMA = 8.0
#: Smallest variance of a pixel, DN^2; below it, rounding is not like noise of variance 1/12.
LEAST_VARIANCE = 1.0


@dataclass(frozen=True, eq=False)
class SumTable:
    """Cumulants of whitened sums, which are independent and have unit variance at coefficients of one."""

    #: Shape (4 + n_flare, n); total at coefficients of one, then star, sky, dark, neighbours and each flare: means (0
    #: for the total), then the unique second, third and, if needed, fourth cumulants, in the order of
    #: `stare_scene.unique`; fourth ones are multiplied by their multiplicity.
    rows: Floats
    #: Shape (n_statistic * (n_statistic + 1) / 2,); lower triangular matrix that converts whitened sums to the
    #: statistics.
    lower: Floats
    fourths: bool  # whether fourth cumulants are needed

    @classmethod
    def of(cls, components: Components) -> Self:
        """Compute the table.

        Raises InputError if weights are linearly dependent, or counts are too few for the expansion.
        """
        n = components.n_statistics
        constant, by_component = components.sum_cumulants(2)
        covariance = constant + by_component[: len(STEADY)].sum(axis=0)
        sd = np.sqrt(np.diag(covariance))
        if (sd == 0).any() or np.linalg.eigvalsh(covariance / np.outer(sd, sd))[0] < 1e-9:
            raise InputError(f"the {n} spectral weights must be independent, but one is a sum of others", key="weights")
        lower = np.linalg.cholesky(covariance)
        white = replace(components, weights=np.asarray(np.linalg.solve(lower, components.weights), np.float64))
        fourths = _fourths_are_needed(components) or _fourths_are_needed(white)
        columns = []
        for order in range(1, 5 if fourths else 4):
            constant, by_component = white.sum_cumulants(order)
            reference = constant + (0.0 if order == 1 else by_component[: len(STEADY)].sum(axis=0))
            for key in unique(n, order):
                multiplicity = 1
                if order == 4:
                    multiplicity = math.factorial(4) // math.prod(math.factorial(m) for m in Counter(key).values())
                columns.append(multiplicity * np.array([tensor[key] for tensor in (reference, *by_component)]))
        return cls(np.array(columns, np.float32).T.copy(), lower[np.tril_indices(n)].astype(np.float32), fourths)


def check_cumulants(scene: StareScene, flares: Flares) -> None:
    """Raise InputError if cumulants do not describe frames: clipping, pixels without noise, or rare large hits."""
    for name in scene.scene.additive:
        raise InputError(f"{ADDITIVE[name].label} must be drawn with method 'pixels', not 'cumulants'", key="method")
    x = scene.components.quiet
    used = (scene.components.weights != 0).any(axis=0)
    photons_dn, dark = scene.conditions(flares)
    mean = x.bias_dn + photons_dn + dark * x.dark_dn
    variance = x.read_noise_dn**2 + x.gain_dn_per_electron * photons_dn + dark * x.dark_variance_dn2
    sd = np.sqrt(variance)
    near = used & ((mean - RAIL_SIGMA * sd < 0.0) | (mean + RAIL_SIGMA * sd > x.highest_dn))
    for wrong, fault in (
        (near, f"comes within {RAIL_SIGMA:g} sigma of zero or saturation and has a weight; use method 'pixels', "
               "which clips, or give the pixel the weight 0"),
        (used & (variance < LEAST_VARIANCE), "scatters by {:.2g} DN, too little for its rounding to be noise; use "
                                             "method 'pixels'"),
    ):  # fmt: skip
        if wrong.any():
            condition, pixel = np.argwhere(wrong)[0]
            raise InputError(f"pixel {pixel} of {x.name} {fault.format(sd[condition, pixel])}", key="method")


def method_for(components: Components, stare: Stare, processes: Processes = NONE) -> Method:
    """Return the method for frames without flares: cumulants if these describe them, otherwise pixels."""
    scene = StareScene.of(components, stare, processes)
    try:
        check_cumulants(scene, Flares.of(components, stare, None, None, 1))
        SumTable.of(components)
    except InputError:
        return "pixels"
    return "cumulants"


def _fourths_are_needed(components: Components) -> bool:
    """Return whether neglecting cumulants beyond the third could be noticed.

    Raises InputError if neglecting those beyond the fourth could be noticed.
    """
    x, w = components.quiet, components.weights
    photons, dark = components.mean_dn[:2].sum(axis=0), components.mean_dn[2]
    sd = np.sqrt(np.sum(w**2 * (x.unsaturated_variance_dn2), axis=1))
    # Standardised third to seventh cumulants of each sum, (n_statistic,) each.
    shapes = []
    for order in range(3, 8):
        cumulant = x.dark_step_dn ** (order - 1) * dark
        if x.photon_noise == "poisson":
            cumulant = cumulant + x.gain_dn_per_electron ** (order - 1) * photons
        shapes.append(np.sum(w**order * cumulant, axis=1) / sd**order)
    least = 5.0 * np.sqrt(2.0 * CLASSES) / FRAMES_TO_NOTICE
    beyond = truncation_distance(shapes, fourth_power=False)
    if (beyond > least).any():
        row = int(np.argmax(beyond))
        raise InputError(
            f"the sum with spectral weight {row} has a skewness of {abs(shapes[0][row]):.2g} in a frame "
            f"of {x.name}, too much for method 'cumulants'; use method 'pixels'",
            key="method",
        )
    g3, g4 = shapes[0], shapes[1]
    cubic, linear = g4 / 24 - g3**2 / 18, g3**2 * (5 / 36 - 6 / 36)
    return bool((24 * cubic**2 + 2 * linear**2 > least).any())
