"""Scenes: the arrays of expectations that the kernels and their NumPy reference read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.host.arrays import Float
from mauvecl.noise import layout
from mauvecl.noise.drawing import Drawing, Factors, choose_method, factor_on_light, nodes, polynomial, sky_share
from mauvecl.noise.layout import LARGEST_MEAN, SMALLEST_EXPANDED, AliasTable, alias_table, alias_table_of
from mauvecl.noise.unknowns import NOISE_FREE, PROCESSES, Comparison, Processes, SignalPart
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.noise.drawing import Cumulants, DrawingOptions, DrawMethod

#: Number of nodes of the trapezoidal rule over a prior's normal score, and its range. The rule converges exponentially
#: for functions that are smooth over a step (Trefethen & Weideman 2014, doi 10.1137/130932132).
NODES, REACH = 281, 7.0
SCORE = np.linspace(-REACH, REACH, NODES)
WEIGHTS = np.exp(-(SCORE**2) / 2) / np.exp(-(SCORE**2) / 2).sum()
#: Sums of squares use every tenth node, since they are wide; weighted sums may be much narrower than a prior.
COARSE = 10
#: Nodes of the Gauss-Hermite rule for factors after the first.
HERMITE_NODES = 7
#: A factor is treated as a normal amplitude of a known spectrum if one standard deviation changes no pixel's variance
#: by more than this fraction (for weighted sums, and for sums of squares), and its values deviate from a linear
#: function of the score by less than `STRAIGHT` standard deviations, root mean square.
VARIANCE_FRACTION = {True: 1e-2, False: 1e-3}
STRAIGHT = 0.01


@dataclass(frozen=True, eq=False)
class FactorDistribution:
    """Distribution of a factor as quadrature nodes."""

    values: Float  # at the scores `SCORE`, whose probabilities are `WEIGHTS`

    @property
    def mean(self) -> float:
        return float(WEIGHTS @ self.values)

    @property
    def sd(self) -> float:
        return float(np.sqrt(WEIGHTS @ (self.values - self.mean) ** 2))

    @property
    def normal(self) -> bool:
        """True if the factor is a linear function of a normal score."""
        off = self.values - self.mean - self.sd * SCORE
        return float(np.sqrt(WEIGHTS @ off**2)) <= STRAIGHT * self.sd


@dataclass(frozen=True, eq=False)
class Nodes:
    """Quadrature nodes, which are sets of factors on dark, light and sky, and spectra of normal amplitudes."""

    probability: Float  # shape (n,)
    amounts: Float  # amounts of the changes of `changes_of`, shape (n, 3)
    scores: dict[str, Float]  # normal scores of each factor, shape (n,)
    spectra: Float  # of factors that are treated as normal amplitudes, DN per standard deviation, shape (k, n_pixel)


def changes_of(x: Expectation) -> tuple[Float, Float]:
    """Return changes by factors of an exposure's means (DN) and variances (DN^2), each shape (3, n_pixel).

    Rows are for all light, which includes the sky's, for the sky's alone, and for the dark current. A pixel that
    saturates records a change only in frames that are not clipped, and its variance changes by the same fraction as
    without saturation, so that no factor makes it negative.
    """
    light, dark = np.array([x.light_dn, x.sky_dn]), x.n_frames * x.dark_dn
    variances = np.array([*(x.gain_dn_per_electron * light), x.n_frames * x.dark_variance_dn2])
    means = np.array([*light, dark]) * (1 - x.cut_share)
    return means, variances * (x.variance_dn2 / x.unsaturated_variance_dn2)


def drawn_factors(processes: Processes, quiet: Expectation) -> dict[SignalPart, FactorDistribution]:
    """Return the distributions of the factors on light, dark and sky that processes draw, averaged over an exposure.

    A product of several independent factors is treated as normal.
    """
    factors, n_frames = Factors.of(processes, quiet.conditions), quiet.n_frames
    by_part = dict[SignalPart, list[FactorDistribution]]()
    for (name, part), table in zip(processes.modulations, factors.tables, strict=True):
        # Relative to the factor at the median, as the table is.
        factor = FactorDistribution(1.0 + quantile_at_score(table, SCORE))
        if PROCESSES[name].when == "frame" and n_frames > 1:
            factor = FactorDistribution(factor.mean + factor.sd / np.sqrt(n_frames) * SCORE)
        by_part.setdefault(part, []).append(factor)
    products = {}
    for part, several in by_part.items():
        values = several[0].values
        if len(several) > 1:
            mean = np.prod([factor.mean for factor in several])
            square = np.prod([factor.mean**2 + factor.sd**2 for factor in several])
            values = mean + np.sqrt(square - mean**2) * SCORE
        products[part] = FactorDistribution(factors.medians[part] * values)
    return products


def factor_nodes(factors: Mapping[SignalPart, FactorDistribution], x: Expectation, *, weighted: bool) -> Nodes:
    """Return the nodes over which a statistic of an exposure, a weighted sum or a sum of squares, is integrated."""
    light, sky, dark = zip(*changes_of(x), strict=True)
    changes: dict[SignalPart, tuple[Float, Float]] = {"dark": dark, "light": light, "sky": sky}
    # Nodes of each factor: weight, value of the factor, and normal score.
    grids, spectra = list[list[tuple[float, float, float]]](), list[Float]()
    step, (hermite, hermite_weight) = 1 if weighted else COARSE, np.polynomial.hermite_e.hermegauss(HERMITE_NODES)
    score, weight = SCORE[::step], WEIGHTS[::step] / WEIGHTS[::step].sum()
    for part, (mean_change, variance_change) in changes.items():
        factor = factors.get(part)
        if factor is None:
            grids.append([(1.0, 1.0, 0.0)])
        elif factor.normal and (factor.sd * variance_change <= VARIANCE_FRACTION[weighted] * x.variance_dn2).all():
            grids.append([(1.0, factor.mean, 0.0)])
            if factor.sd:
                spectra.append(factor.sd * mean_change)
        else:
            values = np.interp(score, SCORE, factor.values)
            grids.append(list(zip(weight.tolist(), values.tolist(), score.tolist(), strict=True)))
            # Further factors have fewer nodes.
            score, weight = hermite, hermite_weight / hermite_weight.sum()
    # Each of shape (n_factor, n).
    weights, (dark, light, sky), scores = np.ascontiguousarray(np.array([*product(*grids)]).T)
    amounts = np.column_stack([light - 1.0, light * (sky - 1.0), dark - 1.0])
    of_normal = np.array(spectra).reshape(len(spectra), x.variance_dn2.size)
    return Nodes(math.prod(weights), amounts, dict(zip(changes, scores, strict=True)), of_normal)


def quantile_at_score(table: NDArray[np.float32], score: Float) -> Float:
    """Interpolate a device's quantile table at standard normal scores; the result has the shape of `score`."""
    below, above = special.ndtr(score), special.ndtr(-score)
    tail, (low, high) = nodes(), np.split(table.astype(np.float64), 2)
    return np.asarray(np.where(below < 0.5, np.interp(below, tail, low), np.interp(above, tail, high)))


#: Pixels are padded to a multiple of this with pixels that do not contribute.
PIXEL_BLOCK = 32
#: Variance, DN^2, that replaces zero.
NO_VARIANCE = 1e-12


def padded(n_pixel: int) -> int:
    """Return the number of pixels including padding."""
    return -(-n_pixel // PIXEL_BLOCK) * PIXEL_BLOCK


def fill_poisson_counts(out: NDArray[np.void], mean: Float, gain: Float, tables: list[AliasTable]) -> Float:
    """Fill `out` for draws of Poisson counts, and append their alias tables to `tables`.

    Return the integers to which counts are relative, shape (n_pixel,).
    """
    centre = np.rint(mean)
    # A pair of pixels shares two words. A table uses one and the expansion both, so a pair must use the same method.
    expanded = _both_of_a_pair(mean >= SMALLEST_EXPANDED)
    if (mean[~expanded] > LARGEST_MEAN).any():
        pixel = int(np.argmax(np.where(expanded, 0.0, mean)))
        raise InputError(
            f"pixel {pixel} must have a Poisson mean of at most {LARGEST_MEAN:g} in one draw next to a pixel of less "
            f"than {SMALLEST_EXPANDED:g}, not {mean[pixel]:.3g}: draw frame by frame",
            key="mode",
        )
    # Equal means share a table; tables are contiguous on the device.
    means, number = np.unique(mean[~expanded], return_inverse=True)
    alias = [*map(alias_table, means.tolist())]
    starts = np.cumsum([sum(t.entries.size for t in tables), *(t.entries.size for t in alias)])
    tables += alias
    out["table"][~expanded] = starts[number]
    out["bits"][~expanded], low = (np.array([getattr(t, name) for t in alias])[number] for name in ("bits", "low"))
    out["low"][~expanded] = low - centre[~expanded]
    root = np.sqrt(mean[expanded])
    out["offset"][expanded] = (mean - centre)[expanded] - 1 / 6
    out["slope"][expanded] = root - 1 / (36 * root)
    out["cubic"][expanded] = -1 / (72 * root)
    out["gain"] = gain
    return centre


def _both_of_a_pair(chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return pixels 2i and 2i + 1 if both are chosen; a last pixel without a neighbour is decided alone."""
    pairs = np.append(chosen, chosen[-1:]) if chosen.size % 2 else chosen
    return np.repeat(pairs.reshape(-1, 2).all(axis=1), 2)[: chosen.size]


def fill_responses(out: NDArray[np.void], x: Expectation, c: Cumulants, factors: Factors) -> None:
    """Fill `out` with a draw's response to factors on light, dark and sky, relative to the priors' medians."""
    on_light, dark, on_sky = factors.medians.values()
    light = factor_on_light(on_light, on_sky, x)
    # The sky's light follows both factors.
    out["sky_share"] = on_light * on_sky * sky_share(x) / light
    out["light"], out["dark"] = light * c.light_dn, dark * c.dark_dn
    out["light_variance"], out["dark_variance"] = light * c.light_variance, dark * c.dark_variance
    # A lower limit avoids 0 / 0 in pixels without noise.
    out["other_variance"] = np.maximum(c.variance - c.light_variance - c.dark_variance, NO_VARIANCE)
    for order, name in enumerate(layout.CUMULANTS[1:], 3):
        out[f"light_{name}"] = light * c.photon_cumulant(order)
        out[f"dark_{name}"] = dark * c.dark_cumulant(order)


#: Distance of a count from its base up to which the device rounds to whole DN.
REACH_DN = 2.0**22


def _check_reach(x: Expectation, c: Cumulants, factors: Factors) -> None:
    """Raise InputError if the priors allow counts beyond the range in which the device rounds correctly."""
    faint, bright = (c.scaled(x, *at_end) for at_end in zip(*factors.ends.values(), strict=True))
    middle = c.scaled(x, *factors.medians.values())
    reach = np.maximum(bright.mean - middle.mean, middle.mean - faint.mean) + 8.0 * np.sqrt(bright.variance)
    if (reach >= REACH_DN).any():
        pixel = int(np.argmax(reach))
        raise InputError(
            f"the priors must move pixel {pixel} of {x.name} less than {REACH_DN:g} DN away from its mean, not "
            f"{reach[pixel]:.3g}: shorten the exposure or draw frame by frame",
            key="priors",
        )


#: Largest number of scenarios per launch for stacks, and frame by frame (True), which needs more registers.
BATCH = {False: 16, True: 8}


@dataclass(frozen=True, eq=False)
class Scene:
    """Scenarios on common draws, as arrays for the kernels."""

    n_pixel: int  # number of pixels; the arrays are padded to a multiple of `PIXEL_BLOCK`
    n_frames: int  # number of frames of the exposure
    frames: bool  # whether each frame is drawn, rounded and clipped, instead of their sum at once
    joint: bool  # whether all noise of a draw comes from one normal, instead of separate Poisson counts
    quartic: bool  # whether a joint draw needs the fourth power of its normal and, if factors vary, fifth cumulants
    photons: bool  # whether photon counts are also drawn separately
    processes: Processes  # optional processes that are drawn
    job: NDArray[np.void]  # shape (); parameters of a launch without the seed
    pixels: NDArray[np.void]  # shape (n_padded,)
    levels: NDArray[np.void]  # shape (n_scenario, n_padded)
    edges: NDArray[np.void]  # shape (n_scenario, n_padded)
    dark_counts: NDArray[np.void]  # shape (n_padded,)
    photon_counts: NDArray[np.void]  # shape (n_scenario, n_padded); empty if not needed
    responses: NDArray[np.void]  # shape (n_scenario, n_padded); empty if not needed
    tables: NDArray[np.uint32]  # concatenated alias tables
    priors: NDArray[np.float32]  # shape (n_modulation, 2 * PRIOR_NODES); quantile tables
    medians: tuple[float, ...]  # factors on light, dark and sky at the priors' medians
    #: Shape (n_scenario, n_padded); reference, the mean of the first scenario, rounded to whole DN minus the reference;
    #: zero for noisy references.
    fraction: Float
    estimates: NDArray[np.void]  # shape (n_scenario, n_padded); for estimated variances; empty for the model's
    comparison: Comparison
    base_dn: NDArray[np.int64]  # shape (n_scenario, n_pixel); whole DN of one draw's mean that the kernels omit
    used: NDArray[np.bool_]  # shape (n_pixel,); pixels of the statistics, those that the reference does not saturate

    @property
    def n_draws(self) -> int:
        """Number of draws that are summed in a realisation of a pixel."""
        return self.n_frames if self.frames else 1

    @property
    def clip(self) -> bool:
        """Whether each draw is a single frame, which the limits of the ADC clip."""
        return self.n_draws == self.n_frames

    @property
    def additive(self) -> tuple[str, ...]:
        """Names of the additive processes that are drawn."""
        return tuple(self.processes.additive)

    @property
    def modulations(self) -> tuple[tuple[str, SignalPart], ...]:
        """Priors that change light, dark or sky."""
        return self.processes.modulations

    def constants(
        self, weights: NDArray[np.float32], linear_end: NDArray[np.uint32], pixels_end: NDArray[np.uint32]
    ) -> NDArray[np.float32]:
        """Compute what the reference's fractions of a DN add to chi-squared and to each linear statistic.

        Sums of resolution elements include them already, as does every pixel that is divided by an estimated variance.
        The shape is (n_scenario + n_linear,).
        """
        chi2 = np.sum(self.levels["inverse_variance"] * self.fraction**2, axis=1) * (not self.comparison.estimated)
        scenario = np.searchsorted(linear_end, np.arange(len(weights)), side="right")
        linear = [float(weights[i] @ self.fraction[k]) if i < pixels_end[k] else 0.0 for i, k in enumerate(scenario)]
        return np.array([*chi2, *linear], np.float32)

    def part(self, scenarios: Sequence[int]) -> Scene:
        """Return the scene with some of its scenarios, in the given order, which must begin with the first."""
        job = self.job.copy()
        job["scenario_count"] = len(scenarios)
        per_scenario = {
            name: array[[*scenarios]] if len(array := getattr(self, name)) else array
            for name in ("levels", "edges", "photon_counts", "responses", "fraction", "estimates", "base_dn")
        }
        return replace(self, job=job, **per_scenario)


def prepare(
    scenarios: Sequence[Expectation], drawing: Drawing | None = None, *, comparison: Comparison = NOISE_FREE,
    first_group: int = 0, **options: Unpack[DrawingOptions],
) -> Scene:  # fmt: skip
    """Compute the arrays of scenarios for the device, from expectations that differ only in their light.

    Options of the draw can also be given as keywords. All scenarios are compared with the first, the quiescent star;
    `first_group` is the number of the first group of four pixels in the generator's counter. Raises InputError if the
    scenarios cannot be drawn as requested, or not together.
    """
    drawing, quiet = drawing or Drawing(**options), scenarios[0]
    method, used, tables = choose_method(scenarios, drawing), ~quiet.saturated, list[AliasTable]()
    dark_dn, step, darks = np.zeros(used.size), quiet.dark_step_dn, np.zeros(padded(used.size), layout.POISSON)
    if not method.joint:
        # Separate dark counts are relative to integers.
        mean = method.frames_per_draw * quiet.dark_dn / step
        dark_dn = step * fill_poisson_counts(darks[: used.size], mean, step, tables)
    pixels = np.zeros(darks.size, layout.PIXEL)
    pixels["used"][: used.size], pixels["electron_gain"][: used.size] = used, quiet.gain_dn_per_electron
    pixels["element_end"][: used.size] = np.append(np.diff(quiet.element) > 0, True)
    # Groups of four used pixels in one element are summed without tests of single pixels.
    uneven = (pixels["element_end"] > 0) | (pixels["used"] == 0)
    pixels["four_uneven"] = np.repeat(uneven.reshape(-1, 4).any(axis=1), 4)
    arrays = _padding(scenarios, method, comparison, modulated=bool(drawing.processes.modulations))
    for k, x in enumerate(scenarios):
        _fill_draw(arrays, k, x, method, dark_dn, tables)
    _fill_comparison(arrays, quiet, quiet.n_frames // method.frames_per_draw, comparison, used)
    job = _job(scenarios, drawing, method, comparison, first_group, tables)
    entries = np.concatenate([np.zeros(0, np.uint32), *(table.entries for table in tables)])
    return Scene(
        used.size, quiet.n_frames, method.frames, method.joint, method.quartic, method.photons,
        processes=drawing.processes, job=job, pixels=pixels, dark_counts=darks, tables=entries,
        priors=method.factors.tables, medians=tuple(method.factors.medians.values()), comparison=comparison,
        used=used, **arrays,
    )  # fmt: skip


#: Arrays of a `Scene` with a row for each scenario, by the names of its fields.
PerScenario = dict[str, NDArray[Any]]


def _padding(
    scenarios: Sequence[Expectation], method: DrawMethod, comparison: Comparison, *, modulated: bool
) -> PerScenario:
    """Return arrays filled with the values of padding."""
    n_pixel = scenarios[0].wavelength_nm.size
    shape = (len(scenarios), padded(n_pixel))
    arrays: PerScenario = {
        "levels": np.zeros(shape, layout.LEVEL),
        "edges": np.zeros(shape, layout.EDGE),
        "photon_counts": np.zeros(shape if method.photons else 0, layout.POISSON),
        "responses": np.zeros(shape if modulated else 0, layout.RESPONSE),
        "fraction": np.zeros(shape),
        "estimates": np.zeros(shape if comparison.estimated else 0, layout.ESTIMATE),
        "base_dn": np.zeros((len(scenarios), n_pixel), np.int64),
    }
    arrays["responses"]["other_variance"] = NO_VARIANCE
    arrays["levels"]["shift"] = arrays["edges"]["low"] = arrays["edges"]["high"] = layout.MAGIC
    return arrays


def _fill_draw(
    arrays: PerScenario, k: int, x: Expectation, method: DrawMethod, dark_dn: Float, tables: list[AliasTable]
) -> None:
    """Fill the arrays for the draw of scenario k, whose dark counts are relative to `dark_dn`; append its `tables`."""
    c, factors, n_pixel, gain = method.cumulants[k], method.factors, dark_dn.size, x.gain_dn_per_electron
    level = arrays["levels"][k, :n_pixel]
    # The mean to which a draw is relative; separate Poisson counts are relative to integers.
    if method.joint:
        mean = c.scaled(x, *factors.medians.values()).mean
        if arrays["responses"].size:
            fill_responses(arrays["responses"][k, :n_pixel], x, c, factors)
            _check_reach(x, c, factors)
        else:
            for power, coefficient in enumerate(polynomial(c)):
                level[f"c{power}"] = coefficient
    else:
        photons = c.photons
        if method.photons:
            photons = fill_poisson_counts(arrays["photon_counts"][k, :n_pixel], c.photons, gain, tables)
        mean = method.frames_per_draw * x.bias_dn + dark_dn + gain * photons
        level["c1"] = np.sqrt(c.gaussian)
    base = arrays["base_dn"][k] = np.clip(np.rint(mean), 0, x.highest_dn if method.frames_per_draw == 1 else np.inf)
    level["c0"] += mean - base


def _fill_comparison(
    arrays: PerScenario, quiet: Expectation, n_draws: int, comparison: Comparison, used: NDArray[np.bool_]
) -> None:
    """Fill the arrays for the comparison of all scenarios with the quiescent star."""
    base, n_pixel = arrays["base_dn"], used.size
    mean_sum = quiet.recorded_dn
    level, edge, fraction = (arrays[name][:, :n_pixel] for name in ("levels", "edges", "fraction"))
    offset_dn = n_draws * base - np.rint(mean_sum)
    if not comparison.exposures:
        fraction[:] = np.rint(mean_sum) - mean_sum
    level["shift"] = layout.MAGIC - offset_dn
    variance = (1.0 + comparison.added_variance) * quiet.variance_dn2
    level["inverse_variance"] = used / variance
    level["twice"] = 2.0 * fraction * level["inverse_variance"]
    edge["base"], edge["whole"] = base, offset_dn
    edge["low"], edge["high"] = layout.MAGIC - base, layout.MAGIC + (quiet.highest_dn - base)
    if comparison.estimated:
        # An observer knows the detector; padding has a variance of 1.
        estimate = arrays["estimates"]
        estimate["variance"], estimate["fraction"] = 1.0, arrays["fraction"]
        estimate, detector = estimate[:, :n_pixel], quiet.read_noise_dn**2 + quiet.dark_variance_dn2 + 1 / 12
        estimate["net_offset"] = np.rint(mean_sum) - quiet.n_frames * (quiet.bias_dn + quiet.dark_dn)
        estimate["gain"] = quiet.gain_dn_per_electron
        estimate["variance"] = np.maximum(quiet.n_frames * detector, NO_VARIANCE)
    # The last pixel of each element.
    ends = np.append(np.diff(quiet.element) > 0, True)
    element_variance = np.bincount(quiet.element, variance * used)
    with np.errstate(divide="ignore"):
        edge["inverse_element_variance"][:, ends] = np.where(element_variance > 0, 1.0 / element_variance, 0.0)
    edge["element_offset"][:, ends] = np.bincount(quiet.element, fraction[0] * used)


def _job(
    scenarios: Sequence[Expectation], drawing: Drawing, method: DrawMethod, comparison: Comparison, first_group: int,
    tables: list[AliasTable],
) -> NDArray[np.void]:  # fmt: skip
    """Return the parameters of a launch, layout.JOB, shape (); append the `tables` of additive processes."""
    quiet, job = scenarios[0], np.zeros((), layout.JOB)
    n_pixel = quiet.wavelength_nm.size
    job["pixel_count"], job["padded_count"] = n_pixel, padded(n_pixel)
    job["scenario_count"] = len(scenarios)
    job["draw_count"], job["frame_count"] = quiet.n_frames if method.frames else 1, quiet.n_frames
    job["first_frame"], job["first_group"] = drawing.first_frame, first_group
    job["reference_count"], job["reference_weight"] = comparison.exposures, comparison.added_variance
    job["pair_scale"] = (1.0 + comparison.added_variance) / 2.0
    for name, process in drawing.processes.additive.items():
        table = alias_table_of(process.charge(method.frames_per_draw * quiet.frame_s))
        job[f"{name}_table"] = sum(earlier.entries.size for earlier in tables)
        job[f"{name}_bits"], job[f"{name}_low"] = table.bits, table.low
        tables.append(table)
    return job
