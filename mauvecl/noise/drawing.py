"""Drawing of realisations: the user's options, cumulants of the noise, and tables of drawn factors.

The noise of one draw is a polynomial of one normal deviate. Gaussian and Poisson noise of a pixel reach the ADC as a
sum, whose cumulants are the sums of theirs. The Cornish-Fisher expansion (1938, doi 10.2307/1400905; Abramowitz &
Stegun 26.2.49) turns a normal deviate into a draw with these cumulants. If Gaussian noise smooths the Poisson steps, no
realistic number of draws reveals the difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from itertools import product
from typing import TYPE_CHECKING, Literal, Self, TypedDict

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.arrays import Float
from mauvecl.noise import layout
from mauvecl.noise.disturbances import Prior
from mauvecl.noise.unknowns import NONE, PROCESSES, SIGNAL_PARTS, Conditions, Processes, SignalPart
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation

#: Gaussian noise with a standard deviation of this many Poisson steps reduces them to 2 exp(-2 pi^2 1.5^2) = 1e-19.
SMOOTH_STEPS = 1.5
#: Up to this skewness, the first omitted terms, which `truncation_distance` includes, dominate the expansion's error.
MAX_SKEW = 0.04
#: Estimated number of draws of one pixel after which Pearson's test of whole DN would detect, at five sigma, that they
#: are not drawn frame by frame and count by count. By exact convolution, the worst allowed case needs 4e13 draws
#: (tests/kernels/test_words.py, tests/noise/test_correlations.py). The payload's fastest draws satisfy this at every
#: temperature and exposure, some with only 5e13 to 1e14.
DRAWS_TO_NOTICE = 4.2e13
#: Largest number of harmonics of the rounding error's sawtooth; Gaussian noise of 0.02 DN suppresses all others.
HARMONICS = 64


@dataclass(frozen=True, eq=False)
class Cumulants:
    """Cumulants of one draw of a scenario, DN; arrays have the shape (n_pixel,)."""

    mean: Float  # mean, including bias
    gaussian: Float  # variance of read noise, rounding of a stack's frames, and Gaussian photon noise
    photons: Float  # mean electrons of light
    photon_step: Float  # DN per Poisson count; 0 for Gaussian photon noise
    dark_step: Float
    dark_dn: Float  # mean of the dark
    light_dn: Float  # mean of the light
    light_variance: Float  # variance of the light, Gaussian or Poisson

    @staticmethod
    def of(x: Expectation, n_frames: int) -> Cumulants:
        """Compute the cumulants of a draw of `n_frames` frames."""
        gain = x.gain_dn_per_electron
        photons = n_frames * x.light_electrons
        poisson = x.photon_noise == "poisson"
        # A stack of n rounded frames has a rounding variance of n/12; the rounding of the draw adds the last 1/12.
        read_variance = n_frames * x.read_noise_dn**2 + (n_frames - 1) / 12
        return Cumulants(
            mean=n_frames * x.mean_raw_dn, photons=photons,
            gaussian=read_variance if poisson else read_variance + gain**2 * photons,
            photon_step=gain if poisson else np.zeros_like(gain), dark_step=x.dark_step_dn,
            dark_dn=n_frames * x.dark_dn, light_dn=gain * photons, light_variance=gain**2 * photons,
        )  # fmt: skip

    def photon_cumulant(self, order: int) -> Float:
        """Return a cumulant of the photons, for orders of 3 and above."""
        return np.asarray(self.photon_step**order * self.photons)

    def dark_cumulant(self, order: int) -> Float:
        """Return a cumulant of the dark, for orders of 2 and above."""
        return np.asarray(self.dark_step ** (order - 1) * self.dark_dn)

    @property
    def dark_variance(self) -> Float:
        return self.dark_cumulant(2)

    @property
    def variance(self) -> Float:
        """Total variance before the draw's own rounding."""
        return self.gaussian + self.photon_cumulant(2) + self.dark_variance

    def over_sd(self) -> list[Float]:
        """Return the third to seventh cumulants divided by powers of the standard deviation."""
        sd = np.sqrt(self.variance)
        return [
            np.divide(self.photon_cumulant(r) + self.dark_cumulant(r), sd**r, out=np.zeros_like(sd), where=sd > 0)
            for r in range(3, 8)
        ]

    def scaled(self, x: Expectation, on_light: float, dark: float, sky: float) -> Cumulants:
        """Return the cumulants with factors on all light, on the dark and on the sky of the scenario."""
        light = on_light if sky == 1.0 else factor_on_light(on_light, sky, x)
        gaussian_light = np.where(self.photon_step > 0, 0.0, self.light_variance)
        return replace(
            self, mean=self.mean + (light - 1.0) * self.light_dn + (dark - 1.0) * self.dark_dn,
            gaussian=self.gaussian + (light - 1.0) * gaussian_light, photons=light * self.photons,
            dark_dn=dark * self.dark_dn, light_dn=light * self.light_dn, light_variance=light * self.light_variance,
        )  # fmt: skip


def is_noticeable(distance: Float, variance: Float) -> NDArray[np.bool_]:
    """Return whether Pearson's test detects the distance sum (p - q)^2 / p within `DRAWS_TO_NOTICE` draws.

    The limit is five standard deviations of chi-squared, whose degrees of freedom are the whole DN within 7.65 standard
    deviations of the mean, those with a probability above 1e-14.
    """
    steps = np.maximum(15.3 * np.sqrt(variance), 1.0)
    return np.asarray(distance * DRAWS_TO_NOTICE > 5.0 * np.sqrt(2.0 * steps))


def truncation_distance(over_sd: Sequence[Float], *, fourth_power: bool, varying: bool = False) -> Float:
    """Estimate Pearson's distance between a draw and its polynomial from the next terms, shape (n_pixel,).

    `over_sd` holds the draw's standardised third to seventh cumulants. A term a He_k(z) changes the density by a
    He_(k + 1)(z) times the normal's, and the squares of these integrate to a^2 (k + 1)!. Rounding to whole DN can only
    reduce the distance. `fourth_power` tells whether the polynomial includes z^4, and `varying` selects the kernels'
    polynomial for factors on light and dark instead of `polynomial`; without the fourth power, it has no terms of
    gamma_5.
    """
    g3, g4, g5, g6, g7 = over_sd
    g3_3 = g3 * g3 * g3
    g3_4 = g3_3 * g3
    # The terms of Abramowitz & Stegun 26.2.49 after those of `polynomial`; their gamma_1 is g3.
    fifth = g6 / 720 - 3 * g4**2 / 384 - 2 * g3 * g5 / 180 + 14 * g3**2 * g4 / 288 - 252 * g3_4 / 7776
    third = -6 * g4**2 / 384 - 3 * g3 * g5 / 180 + 37 * g3**2 * g4 / 288 - 832 * g3_4 / 7776
    first = -2 * g4**2 / 384 + 8 * g3**2 * g4 / 288 - 227 * g3_4 / 7776
    loss = 720 * fifth**2 + 24 * third**2 + 2 * first**2 + g7**2 / 5040
    if not fourth_power:
        second = 19 * g3_3 / 324 - g3 * g4 / 24
        fourth = g5 / 120 - g3 * g4 / 24 + g3_3 / 27
        # Without gamma_5, both Hermite terms are missing; `polynomial` lacks only z^4 = He_4 + 6 He_2 + 3.
        loss = loss + (120 * fourth**2 + 6 * second**2 if varying else 345 * fourth**2)
    return np.asarray(loss)


def joint_is_exact(c: Cumulants) -> NDArray[np.bool_]:
    """Return the pixels whose noise can be drawn from one normal, shape (n_pixel,)."""
    step = np.maximum(np.where(c.dark_dn > 0, c.dark_step, 0.0), np.where(c.photons > 0, c.photon_step, 0.0))
    smooth = np.sqrt(c.gaussian) >= SMOOTH_STEPS * step
    over_sd = c.over_sd()
    cut_off = is_noticeable(truncation_distance(over_sd, fourth_power=True), c.variance)
    return np.asarray(smooth & (over_sd[0] <= MAX_SKEW) & ~cut_off)


def stack_is_exact(c: Cumulants, x: Expectation) -> NDArray[np.bool_]:
    """Return the pixels whose frames can be drawn as one stack, from the cumulants of ONE frame.

    A stack treats each frame's rounding error as noise of mean 0 and variance 1/12 that is Gaussian in the sum. The
    error is a sawtooth, the sum over k of sin(2 pi k x) / (pi k), which depends on the frame's noise through its
    characteristic function at 2 pi k (Widrow, Kollar & Liu 1996, doi 10.1109/19.492748): its modulus f_k and the slope
    l_k of its logarithm. Given the sum of N frames of variance v, the conditional mean of a frame's sine is at most f_k
    exp(u_k / 2) with u_k = l_k^2 / (N v), which changes the density of the sum by Pearson's distance below. Counts of
    whole DN do not smooth the rounding. The sum of N uniform errors has the fourth cumulant -N / 120.

    Poisson counts whose steps are visible in the sum are ignored: given the counts, only the remaining noise smooths
    the rounding, and a mixture is never easier to distinguish than its components.
    """
    n = x.n_frames
    blur = np.sqrt(n * (c.gaussian + 1 / 12))
    dark = np.divide(c.dark_dn, c.dark_step, out=np.zeros_like(c.dark_dn), where=c.dark_dn > 0)
    steps = np.stack([c.photon_step, c.dark_step])
    counts = np.where(blur >= SMOOTH_STEPS * steps, np.stack([c.photons, dark]), 0.0)
    frame = c.gaussian + (counts * steps**2).sum(axis=0) + 1 / 12
    # The factors of two, here and below, account for the Poisson counts' skewness and the square of the sawtooth.
    loss = 2 * ((n - 1) / (120 * n**2 * frame**2)) ** 2 / 24
    quietest = float(np.sqrt(c.gaussian.min()))
    last = HARMONICS if HARMONICS * quietest < 1.5 else int(np.ceil(1.5 / quietest))
    for k in range(1, last + 1):
        turned = np.abs(np.sin(np.pi * k * steps))
        size = 2 * np.pi**2 * k**2 * c.gaussian + 2 * (counts * turned**2).sum(axis=0)
        slope = 2 * np.pi * k * c.gaussian + 2 * (counts * steps * turned).sum(axis=0)
        ripple = slope**2 / (n * frame)
        loss += 2 * n / (np.pi**2 * k**2 * frame) * (1 + ripple) * np.exp(np.minimum(ripple - 2 * size, 0.0))
    # Bound on the harmonics beyond `last`, from the Gaussian noise.
    loss += n / frame * np.exp(-4 * np.pi**2 * last**2 * c.gaussian)
    return ~is_noticeable(loss, n * frame)


def polynomial(c: Cumulants) -> tuple[Float, Float, Float, Float, Float]:
    """Return the coefficients of z^0 to z^4 of a draw minus its mean, DN, each shape (n_pixel,)."""
    g1, g2, g3, *_ = c.over_sd()
    sd = np.sqrt(c.variance)
    return (
        sd * (-g1 / 6 + g3 / 40 - g1 * g2 / 12 + 17 * g1**3 / 324),
        sd * (1 - g2 / 8 + 5 * g1**2 / 36),
        sd * (g1 / 6 - g3 / 20 + 5 * g1 * g2 / 24 - 53 * g1**3 / 324),
        sd * (g2 / 24 - g1**2 / 18),
        sd * (g3 / 120 - g1 * g2 / 24 + g1**3 / 27),
    )


Mode = Literal["auto", "frames", "stacked"]
Recipe = Literal["auto", "joint", "apart"]


class DrawingOptions(TypedDict, total=False):
    """Fields of a `Drawing` as keyword arguments."""

    mode: Mode
    recipe: Recipe
    processes: Processes
    first_frame: int


@validated
@dataclass(frozen=True)
class Drawing:
    """Options for the drawing of realisations."""

    # Whether to draw each frame, or their sum at once. "auto" draws frames only near zero or saturation, and if a frame
    # has too little noise to treat its rounding as noise.
    mode: Mode = "auto"
    # Whether to draw all noise of a pixel from one normal, or Poisson counts separately, as "auto" does only if the
    # joint draw is not exact.
    recipe: Recipe = "auto"
    processes: Processes = NONE  # optional noise processes
    first_frame: int = 0  # frame k of an exposure is drawn with an expectation of one frame and ``first_frame=k``


#: Options that follow from the noise.
AUTOMATIC = Drawing()


@cache
def nodes() -> Float:
    """Return the probabilities of the table's nodes from an end of a prior to its median, (layout.PRIOR_NODES,).

    There are octaves from 2**-56 to 1/2 with 2**PRIOR_BITS cells each; the last node is repeated for words that float32
    rounds up.
    """
    cells = 2**layout.PRIOR_BITS
    number = np.arange(layout.PRIOR_NODES - 1)
    probability = np.ldexp(1.0 + (number % cells) / cells, number // cells - layout.PRIOR_FINEST)
    probability = np.append(probability, probability[-1])
    probability.flags.writeable = False
    return probability


@lru_cache(32)
def _quantiles(prior: Prior) -> tuple[Float, Float]:
    """Return a prior's values at the nodes from the low end, then from the high end, and its median."""
    tail = nodes()
    values = np.append(prior.quantile(tail, 1.0 - tail), prior.quantile(1.0 - tail, tail))
    values.flags.writeable = False
    return values, prior.quantile(np.array([0.5]))


@dataclass(frozen=True, eq=False)
class Factors:
    """Factors of priors on light, dark and sky; factors on light include the sky's light."""

    #: Quantile tables, shape (n_modulation, 2 * layout.PRIOR_NODES): factors at `nodes` from the low end of a prior,
    #: then from the high end, divided by the factor at its median, minus one. In this form float32 resolves priors of
    #: any width and location.
    tables: NDArray[np.float32]
    medians: dict[SignalPart, float]  # factors at the priors' medians, in the order of `SIGNAL_PARTS`
    ends: dict[SignalPart, tuple[float, float]]  # smallest and largest factors of all priors together

    @classmethod
    def of(cls, processes: Processes, conditions: Conditions) -> Self:
        """Compute the quantile tables of the priors' factors for the conditions of an expectation."""
        tables = np.empty((len(processes.modulations), 2 * layout.PRIOR_NODES), np.float32)
        ends, centre = dict.fromkeys(SIGNAL_PARTS, (1.0, 1.0)), dict.fromkeys(SIGNAL_PARTS, 1.0)
        for row, (name, factor) in enumerate(processes.modulations):
            prior, varied = getattr(processes, name), PROCESSES[name]
            change = partial(varied.change, conditions)
            first, last = prior.quantile(np.array([0.0, 1.0]))
            if not (varied.low <= first and last <= varied.high):
                raise InputError.of(
                    name, [float(first), float(last)], f"a prior between {varied.low:g} and {varied.high:g}"
                )
            at_nodes, median = _quantiles(prior)
            middle = float(change(median)[0])
            tables[row] = (change(at_nodes) - middle) / (1.0 + middle)
            centre[factor] *= 1.0 + middle
            least, most = sorted(1.0 + change(np.array([first, last])))
            ends[factor] = ends[factor][0] * float(least), ends[factor][1] * float(most)
        return cls(tables, centre, ends)


def factor_on_light(light: float, sky: float, x: Expectation) -> Float:
    """Return the factor on each pixel's total light, which includes the sky's, shape (n_pixel,)."""
    return np.asarray(light * (1.0 + (sky - 1.0) * sky_share(x)))


#: Frames are drawn one by one if a pixel's mean is within this many standard deviations of a rail.
RAIL_SIGMA = 8.0
#: Limit of the counter's 24 bits for groups of four pixels.
MAX_PIXELS = 65_536

#: Fields of an expectation that scenarios on common draws share.
OF_DETECTOR = ("wavelength_nm", "dark_dn", "bias_dn", "read_noise_dn", "gain_dn_per_electron", "element", "n_frames",
               "frame_s", "dark_unit", "photon_noise", "adc_max_dn", "saturation_dn")  # fmt: skip


@dataclass(frozen=True, eq=False)
class DrawMethod:
    """Method by which scenarios are drawn; see `Scene` for the switches."""

    factors: Factors  # of the priors that are drawn
    frames: bool
    joint: bool
    quartic: bool
    photons: bool
    frames_per_draw: int
    cumulants: list[Cumulants]  # of one draw of each scenario


def choose_method(scenarios: Sequence[Expectation], drawing: Drawing) -> DrawMethod:
    """Choose the method for scenarios. Raises InputError if they cannot be drawn as requested, or not together."""
    quiet, modulations = scenarios[0], drawing.processes.modulations
    factors = Factors.of(drawing.processes, quiet.conditions)
    if quiet.wavelength_nm.size > MAX_PIXELS:
        raise InputError.of("pixels", quiet.wavelength_nm.size, f"at most {MAX_PIXELS}")
    for x, name in product(scenarios[1:], OF_DETECTOR):
        if not np.array_equal(getattr(quiet, name), getattr(x, name)):
            raise InputError(
                f"scenarios of one study must share instrument and exposure, but {name} of {x.name} differs from "
                f"that of {quiet.name}",
                key=name,
            )
    # A grid of factors on light, dark and sky that spans the priors in steps of at most 2.
    grids = [np.geomspace(low, high, 1 + int(np.ceil(np.log2(high / low)))) for low, high in factors.ends.values()]
    corners = [*product(*(grid.tolist() for grid in grids))]
    frames = _draw_frames(scenarios, drawing, factors, corners)
    frames_per_draw = 1 if frames else quiet.n_frames
    cumulants = [Cumulants.of(x, frames_per_draw) for x in scenarios]
    varied = [(x, c.scaled(x, *at)) for (x, c), at in product(zip(scenarios, cumulants, strict=True), corners)]
    joint = _joint(varied, drawing.recipe)
    if modulations and not joint:
        raise InputError(
            f"the noise of {quiet.name} must be drawn jointly if {modulations[0][0]} varies within a run: it needs "
            "Gaussian noise of at least 1.5 Poisson counts in each pixel and more for few counts, or no such process",
            key=modulations[0][0],
        )
    quartic = joint and any(
        is_noticeable(truncation_distance(c.over_sd(), fourth_power=False, varying=bool(modulations)), c.variance).any()
        for _, c in varied
    )
    photons = not joint and quiet.photon_noise == "poisson"
    return DrawMethod(factors, frames, joint, quartic, photons, frames_per_draw, cumulants)


def near_rail(x: Expectation, factors: Factors, processes: Processes) -> NDArray[np.bool_]:
    """Return the pixels whose frames come within `RAIL_SIGMA` of zero or saturation, shape (n_pixel,).

    The limits include all values allowed by the priors and the largest charge of additive processes per frame.
    """
    frame = Cumulants.of(x, 1)
    faint, bright = (frame.scaled(x, *at_end) for at_end in zip(*factors.ends.values(), strict=True))
    # Even the faint end scatters as the expectation does.
    low, high = (RAIL_SIGMA * np.sqrt(np.maximum(end.variance, frame.variance) + 1 / 12) for end in (faint, bright))
    added = x.gain_dn_per_electron * sum(process.most_electrons(x.frame_s) for process in processes.additive.values())
    return np.asarray((faint.mean < low) | (bright.mean + high + added > x.highest_dn))


def _joint(varied: Sequence[tuple[Expectation, Cumulants]], recipe: Recipe) -> bool:
    """Return whether each pixel's noise can be drawn from one normal for all factors on light and dark."""
    if recipe == "apart":
        return False
    for x, c in varied:
        exact = joint_is_exact(c)
        if exact.all():
            continue
        if recipe == "auto":
            return False
        pixel = int(np.argmin(exact))
        raise InputError(
            f"recipe must be 'apart' or 'auto', not 'joint', since pixel {pixel} of {x.name} has "
            f"{np.sqrt(c.gaussian[pixel]):.3g} DN of Gaussian noise next to Poisson counts",
            key="recipe",
        )
    return True


def _draw_frames(
    scenarios: Sequence[Expectation], drawing: Drawing, factors: Factors, corners: Sequence[tuple[float, float, float]]
) -> bool:
    """Return whether frames are drawn one by one; raises InputError if they would have to be, but must be stacked."""
    if scenarios[0].n_frames == 1:
        # Both modes give the same draws.
        return False
    if drawing.mode == "frames":
        return True
    for x in scenarios:
        near = near_rail(x, factors, drawing.processes)
        # The approximation of rounding as noise is worst for the least light and dark.
        coarse = ~stack_is_exact(Cumulants.of(x, 1).scaled(x, *corners[0]), x)
        for pixels, why in (
            (near, f"cannot clip, and a frame comes within {RAIL_SIGMA:g} sigma of zero or saturation"),
            (coarse, "treats rounding as noise, and a frame has too little noise for that"),
        ):
            if pixels.any() and drawing.mode == "stacked":
                where = f"in the pixel at {x.wavelength_nm[pixels][0]:.1f} nm of {x.name}"
                raise InputError(f"mode must be 'frames' or 'auto': 'stacked' {why} {where}", key="mode")
            if pixels.any():
                return True
    return False


def sky_share(x: Expectation) -> Float:
    """Return the sky's share of each pixel's light, shape (n_pixel,); zero without light."""
    light = x.light_electrons
    return np.divide(x.sky_electrons, light, out=np.zeros_like(light), where=light > 0)
