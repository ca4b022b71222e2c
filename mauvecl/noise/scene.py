"""Expectations of one study as the arrays that the kernels and their twin read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.noise import layout
from mauvecl.noise.comparison import TEMPLATE, Comparison
from mauvecl.noise.cumulants import Cumulants, joint_is_exact, needs_fourth_power, polynomial, stack_is_exact
from mauvecl.noise.drawing import Drawing, DrawingWords, Mode, Recipe
from mauvecl.noise.poisson import LARGEST_MEAN, SMALLEST_EXPANDED, AliasTable, table_of, table_set
from mauvecl.noise.processes import CosmicRays, Factors, Modulated

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

#: Scenarios in one launch: drawn as stacks, or frame by frame, which needs room for each.
BATCH = {False: 16, True: 8}
Float = NDArray[np.float64]

#: Pixels are padded to a multiple of this with ones that never contribute.
PIXEL_BLOCK = 32
#: `frames` is chosen where a pixel's mean is within this many sigma of a rail.
RAIL_SIGMA = 8.0
#: Counts further from their base than this are not rounded to whole DN by the device.
REACH_DN = 2.0**22
#: DN^2 in place of none at all.
NO_VARIANCE = 1e-12
#: Groups of four pixels have 24 bits in the counter.
MOST_PIXELS = 65_536


@dataclass(frozen=True, eq=False)
class Scene:
    """Scenarios on common draws.

    Attributes
    ----------
    n_pixel : int
        Real pixels; the arrays are padded to a multiple of `PIXEL_BLOCK`.
    n_frames : int
        Frames of the exposure.
    frames : bool
        Each frame drawn, rounded and clipped (True), or their sum drawn at once.
    joint : bool
        Whether all noise of a draw comes from one normal, through its cumulants, or Poisson counts are drawn apart.
    quartic : bool
        Whether a joint draw needs the fourth power of its normal and, where factors vary, fifth cumulants.
    photons : bool
        Whether photon counts are drawn apart as well.
    clip : bool
        Whether single draws meet the ADC's rails.
    modulations : tuple of (name, factor)
        Priors that change light, dark or sky; see `Processes`.
    job : ndarray of layout.JOB, shape ()
        Without the seed.
    pixels : ndarray of layout.PIXEL, shape (n_padded,)
    levels, edges, photon_counts, responses : ndarray, shape (n_scenario, n_padded)
        Of layout.LEVEL, EDGE, POISSON and RESPONSE; the last two are empty where not needed.
    dark_counts : ndarray of layout.POISSON, shape (n_padded,)
    tables : ndarray of uint32
        Alias tables, end to end.
    priors : ndarray of float32, shape (n_modulation, 2 * PRIOR_NODES)
    medians : tuple of float, shape (3,)
        Factors on light, dark and sky of priors at their medians.
    templates : ndarray of uint32, shape (n_scenario,)
        For each scenario the one whose mean and variance it is compared with.
    fraction : ndarray, shape (n_scenario, n_padded)
        Template rounded to whole DN less the template; zero where noisy exposures take its place.
    estimates : ndarray of layout.ESTIMATE, shape (n_scenario, n_padded)
        Empty where variances are the model's.
    comparison : Comparison
    base_dn : ndarray of int64, shape (n_scenario, n_pixel)
        Whole DN of one draw's mean that the kernels leave out.
    used : ndarray of bool, shape (n_pixel,)
        Pixels that enter the statistics: those no template saturates.
    """

    n_pixel: int
    n_frames: int
    frames: bool
    joint: bool
    quartic: bool
    photons: bool
    clip: bool
    modulations: tuple[tuple[str, Modulated], ...]
    job: NDArray[np.void]
    pixels: NDArray[np.void]
    levels: NDArray[np.void]
    edges: NDArray[np.void]
    dark_counts: NDArray[np.void]
    photon_counts: NDArray[np.void]
    responses: NDArray[np.void]
    tables: NDArray[np.uint32]
    priors: NDArray[np.float32]
    medians: tuple[float, float, float]
    templates: NDArray[np.uint32]
    fraction: Float
    estimates: NDArray[np.void]
    comparison: Comparison
    base_dn: NDArray[np.int64]
    used: NDArray[np.bool_]

    @property
    def n_draws(self) -> int:
        """Draws summed into one realisation of a pixel."""
        return self.n_frames if self.frames else 1

    @property
    def cosmic(self) -> bool:
        """Whether cosmic rays are drawn."""
        return bool(self.job["cosmic_bits"])

    def constants(self, weights: NDArray[np.float32], linear_end: NDArray[np.uint32]) -> NDArray[np.float32]:
        """What the template's fractions add to each sum: chi-squared per scenario, then each linear statistic.

        Returns
        -------
        ndarray of float32, shape (n_scenario + n_linear,)
        """
        chi2 = np.sum(self.levels["inverse_variance"] * self.fraction**2, axis=1)
        scenario = np.searchsorted(linear_end, np.arange(len(weights)), side="right")
        linear = [float(weights[i] @ self.fraction[k]) for i, k in enumerate(scenario)]
        return np.array([*chi2, *linear], np.float32)

    def part(self, scenarios: Sequence[int]) -> Scene:
        """The same scene with some of its scenarios, in the order given; their templates must be among them."""
        chosen = list(scenarios)
        job = self.job.copy()
        job["scenario_count"] = len(chosen)
        per_scenario = {
            name: array[chosen] if len(array := getattr(self, name)) else array
            for name in ("levels", "edges", "photon_counts", "responses", "fraction", "estimates", "base_dn")
        }
        templates = np.array([chosen.index(t) for t in self.templates[chosen]], np.uint32)
        return replace(self, job=job, templates=templates, **per_scenario)


def near_rail(x: Expectation, factors: Factors, rays: CosmicRays | None) -> NDArray[np.bool_]:
    """Pixels whose single frame comes within `RAIL_SIGMA` of zero or of saturation, shape (n_pixel,).

    With priors wherever they carry it, and with a cosmic ray's hit.
    """
    variance, light = x.unsaturated_variance_dn2 / x.n_frames, x.light_dn / x.n_frames
    mean = x.mean_raw_dn
    ends = []
    for end_light, more_dark, sky in zip(factors.light_ends, factors.dark_ends, factors.sky_ends, strict=True):
        more_light = factors.on_light(end_light, sky, sky_share(x))
        there = mean + (more_light - 1.0) * light + (more_dark - 1.0) * x.dark_dn
        more = (more_light - 1.0) * x.gain_dn_per_electron * light + (more_dark - 1.0) * x.dark_variance_dn2
        ends.append((there, RAIL_SIGMA * np.sqrt(variance + np.maximum(more, 0.0))))
    hit = 0.0 if rays is None else x.gain_dn_per_electron * rays.electrons[1]
    low: NDArray[np.bool_] = ends[0][0] - ends[0][1] < 0.0
    high: NDArray[np.bool_] = ends[1][0] + ends[1][1] + hit > x.highest_dn
    return low | high


def prepare(
    scenarios: Sequence[Expectation],
    drawing: Drawing | None = None,
    *,
    templates: Sequence[int] | None = None,
    comparison: Comparison = TEMPLATE,
    first_group: int = 0,
    **words: Unpack[DrawingWords],
) -> Scene:
    """Lay out scenarios for the device.

    Parameters
    ----------
    scenarios : sequence of Expectation
        On one instrument and exposure.
    drawing : Drawing, optional
        Or its fields by their names.
    templates : sequence of int, optional
        For each scenario the quiescent one it is compared with; the first for all by default.
    comparison : Comparison
        What is subtracted, and by whose variances.
    first_group : int
        Where groups of four pixels begin to be counted in the generator's counter.

    Raises
    ------
    InputError
        If the scenarios differ in anything but their light, stacked draws are asked for near a rail, or a process
        needs joint draws where there are none.
    """
    drawing = drawing or Drawing(**words)
    processes = drawing.processes
    quiet = scenarios[0]
    if quiet.wavelength_nm.size > MOST_PIXELS:
        raise InputError(f"{quiet.wavelength_nm.size} pixels, expected at most {MOST_PIXELS}")
    for other in scenarios[1:]:
        _check_same_detector(quiet, other)
    factors = processes.factors(quiet.conditions)
    compared = np.zeros(len(scenarios), np.uint32) if templates is None else np.array(templates, np.uint32)
    modulations = processes.modulations
    corners = _corners(factors)
    frames = _draw_frames(scenarios, drawing.mode, factors, processes.cosmic_rays, corners)
    each = 1 if frames else quiet.n_frames
    n_pixel = quiet.wavelength_nm.size
    padded = -(-n_pixel // PIXEL_BLOCK) * PIXEL_BLOCK
    cumulants = [Cumulants.of(x, each) for x in scenarios]
    varied = [[_scaled(x, c, corner) for corner in corners] for x, c in zip(scenarios, cumulants, strict=True)]
    joint = _joint(scenarios, varied, drawing.recipe)
    shapes = [polynomial(c) for c in cumulants] if joint and not modulations else []
    quartic = joint and any(needs_fourth_power(c, varying=bool(modulations)) for row in varied for c in row)
    photons = not joint and quiet.photon_noise == "poisson"
    if modulations and not joint:
        raise InputError(
            f"{modulations[0][0]} varies within a run, and the noise of {quiet.name} cannot be drawn jointly, expected "
            "Gaussian noise of 1.5 Poisson counts and more in each pixel, more where counts are few, or no such process"
        )
    tables: list[AliasTable] = []
    used = ~np.any([scenarios[t].saturated for t in np.unique(compared)], axis=0)

    pixels = np.zeros(padded, layout.PIXEL)
    pixels["used"][:n_pixel] = used
    ends = np.append(np.diff(quiet.element) > 0, True)
    pixels["element_end"][:n_pixel] = ends
    # Fours within one element that all count need no look at each pixel.
    uneven = (pixels["element_end"] > 0) | (pixels["used"] == 0)
    pixels["four_uneven"] = np.repeat(uneven.reshape(-1, 4).any(axis=1), 4)
    pixels["cosmic_gain"][:n_pixel] = quiet.gain_dn_per_electron
    darks, dark_centre = np.zeros(padded, layout.POISSON), np.zeros(n_pixel)
    if not joint:
        step = quiet.dark_step_dn
        dark_centre = _counts(darks[:n_pixel], each * quiet.dark_dn / step, step, tables)

    shape = (len(scenarios), padded)
    levels, edges = np.zeros(shape, layout.LEVEL), np.zeros(shape, layout.EDGE)
    counts = np.zeros(shape if photons else 0, layout.POISSON)
    responses = np.zeros(shape if modulations else 0, layout.RESPONSE)
    responses["other_variance"] = NO_VARIANCE
    fraction, base = np.zeros(shape), np.zeros((len(scenarios), n_pixel), np.int64)
    estimates = np.zeros(shape if comparison.estimated else 0, layout.ESTIMATE)
    # What is subtracted adds its noise to the null's variance.
    noisier = 1.0 + comparison.share
    levels["shift"] = edges["low"] = edges["high"] = layout.MAGIC
    for k, (x, c) in enumerate(zip(scenarios, cumulants, strict=True)):
        light = factors.on_light(factors.light, factors.sky, sky_share(x))
        mean = c.mean + (light - 1.0) * c.light_dn + (factors.dark - 1.0) * c.dark_dn
        if not joint:
            mean = each * x.bias_dn + quiet.dark_step_dn * dark_centre
            if photons:
                mean += x.gain_dn_per_electron * _counts(counts[k, :n_pixel], c.photons, x.gain_dn_per_electron, tables)
            else:
                mean += x.gain_dn_per_electron * c.photons
        base[k] = np.clip(np.rint(mean), 0, x.highest_dn if each == 1 else np.inf)
        level = levels[k, :n_pixel]
        if modulations:
            _respond(responses[k, :n_pixel], x, c, factors)
            _check_reach(x, c, factors)
        elif joint:
            for name, coefficient in zip(("c0", "c1", "c2", "c3", "c4"), shapes[k], strict=True):
                level[name] = coefficient
        else:
            level["c1"] = np.sqrt(c.gaussian)
        level["c0"] += mean - base[k]
        template = scenarios[compared[k]]
        mean_sum = template.recorded_dn
        whole = (quiet.n_frames // each) * base[k] - np.rint(mean_sum)
        if not comparison.exposures:
            fraction[k, :n_pixel] = np.rint(mean_sum) - mean_sum
        level["shift"] = layout.MAGIC - whole
        variance = noisier * template.variance_dn2
        level["inverse_variance"] = used / variance
        level["twice"] = 2.0 * fraction[k, :n_pixel] * level["inverse_variance"]
        edge = edges[k, :n_pixel]
        edge["base"], edge["whole"] = base[k], whole
        edge["low"] = layout.MAGIC - base[k]
        edge["high"] = layout.MAGIC + (x.highest_dn - base[k])
        if comparison.estimated:
            _estimate(estimates[k], template, fraction[k], np.rint(mean_sum))
        element_variance = np.bincount(quiet.element, variance * used)
        with np.errstate(divide="ignore"):
            edge["inverse_element_variance"][ends] = np.where(element_variance > 0, 1.0 / element_variance, 0.0)
        edge["element_offset"][ends] = np.bincount(quiet.element, fraction[k, :n_pixel] * used)

    job = np.zeros((), layout.JOB)
    job["pixel_count"], job["padded_count"], job["scenario_count"] = n_pixel, padded, len(scenarios)
    job["draw_count"], job["frame_count"] = quiet.n_frames if frames else 1, quiet.n_frames
    job["first_frame"], job["first_group"] = drawing.first_frame, first_group
    job["reference_count"], job["reference_share"] = comparison.exposures, comparison.share
    job["pair_scale"] = noisier / 2.0
    if processes.cosmic_rays is not None:
        table = table_of(processes.cosmic_rays.charge(each * quiet.frame_s))
        job["cosmic_table"] = sum(t.entries.size for t in tables)
        job["cosmic_bits"], job["cosmic_low"] = table.bits, table.low
        tables.append(table)
    return Scene(
        n_pixel=n_pixel,
        n_frames=quiet.n_frames,
        frames=frames,
        joint=joint,
        quartic=quartic,
        photons=photons,
        clip=each == 1,
        modulations=modulations,
        job=job,
        pixels=pixels,
        levels=levels,
        edges=edges,
        dark_counts=darks,
        photon_counts=counts,
        responses=responses,
        tables=np.concatenate([np.zeros(1, np.uint32)[:0], *(t.entries for t in tables)]).astype(np.uint32),
        priors=factors.tables,
        medians=(factors.light, factors.dark, factors.sky),
        templates=compared,
        fraction=fraction,
        estimates=estimates,
        comparison=comparison,
        base_dn=base,
        used=used,
    )


def sky_share(x: Expectation) -> Float:
    """The sky's share of the light of each pixel, shape (n_pixel,); zero where there is none."""
    light = x.source_electrons + x.sky_electrons
    return np.divide(x.sky_electrons, light, out=np.zeros_like(light), where=light > 0)


def _corners(factors: Factors) -> list[tuple[float, float, float]]:
    """Factors on light, dark and sky over all that the priors allow, neighbours at most a factor of 2 apart."""
    ends = (factors.light_ends, factors.dark_ends, factors.sky_ends)
    grids = [np.geomspace(low, high, 1 + int(np.ceil(np.log2(high / low)))) for low, high in ends]
    return [(float(light), float(dark), float(sky)) for light in grids[0] for dark in grids[1] for sky in grids[2]]


def _scaled(x: Expectation, c: Cumulants, corner: tuple[float, float, float]) -> Cumulants:
    light, dark, sky = corner
    return c.scaled(light if sky == 1.0 else Factors.on_light(light, sky, sky_share(x)), dark)


def _joint(scenarios: Sequence[Expectation], varied: Sequence[Sequence[Cumulants]], recipe: Recipe) -> bool:
    """Whether every pixel's noise may come from one normal, whatever the factors on light and dark."""
    if recipe == "apart":
        return False
    for x, c in ((x, c) for x, row in zip(scenarios, varied, strict=True) for c in row):
        exact = joint_is_exact(c)
        if not exact.all():
            if recipe == "joint":
                pixel = int(np.argmin(exact))
                raise InputError(
                    f"recipe = 'joint', and pixel {pixel} of {x.name} has {np.sqrt(c.gaussian[pixel]):.3g} DN of "
                    "Gaussian noise beside Poisson counts, expected recipe 'apart' or 'auto'"
                )
            return False
    return True


def _counts(out: NDArray[np.void], mean: Float, gain: Float, tables: list[AliasTable]) -> Float:
    """Fill in how Poisson counts are drawn; returns the whole numbers they are relative to, shape (n_pixel,)."""
    centre = np.rint(mean)
    # A pair shares two words: a table takes one, the expansion both. Two of a pair never go different ways.
    expanded = _both_of_a_pair(mean >= SMALLEST_EXPANDED)
    if (mean[~expanded] > LARGEST_MEAN).any():
        pixel = int(np.argmax(np.where(expanded, 0.0, mean)))
        raise InputError(
            f"pixel {pixel} has a Poisson mean of {mean[pixel]:.3g} in one draw beside a pixel of less than "
            f"{SMALLEST_EXPANDED:g}, expected at most {LARGEST_MEAN:g} there: draw frame by frame"
        )
    found, starts = table_set(mean[~expanded].tolist(), tables)
    out["table"][~expanded] = starts
    out["bits"][~expanded] = [t.bits for t in found]
    out["low"][~expanded] = np.array([t.low for t in found]) - centre[~expanded]
    root = np.sqrt(mean[expanded])
    out["offset"][expanded] = (mean - centre)[expanded] - 1 / 6
    out["slope"][expanded] = root - 1 / (36 * root)
    out["cubic"][expanded] = -1 / (72 * root)
    out["gain"] = gain
    return centre


def _both_of_a_pair(chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels 2i and 2i + 1 where both are chosen; a last one without a neighbour decides alone."""
    pairs = np.append(chosen, chosen[-1:]) if chosen.size % 2 else chosen
    return np.repeat(pairs.reshape(-1, 2).all(axis=1), 2)[: chosen.size]


def _estimate(out: NDArray[np.void], template: Expectation, fraction: Float, mean_sum: Float) -> None:
    """How an observer who knows the detector estimates variances; padding has some, to divide by."""
    n_pixel, known = template.wavelength_nm.size, template.read_noise_dn**2 + template.dark_variance_dn2 + 1 / 12
    out["variance"] = 1.0
    out["fraction"] = fraction
    out["net_offset"][:n_pixel] = mean_sum - template.n_frames * (template.bias_dn + template.dark_dn)
    out["gain"][:n_pixel] = template.gain_dn_per_electron
    out["variance"][:n_pixel] = np.maximum(template.n_frames * known, NO_VARIANCE)


def _respond(out: NDArray[np.void], x: Expectation, c: Cumulants, factors: Factors) -> None:
    """How a draw follows factors on light, dark and sky, from what they are at the priors' medians."""
    share, dark = sky_share(x), factors.dark
    light = factors.on_light(factors.light, factors.sky, share)
    # The sky's light follows both factors.
    out["sky_share"] = factors.light * factors.sky * share / light
    out["light"], out["dark"] = light * c.light_dn, dark * c.dark_dn
    out["light_variance"], out["dark_variance"] = light * c.light_variance, dark * c.dark_variance
    # A pixel without any noise must not divide zero by zero.
    out["other_variance"] = np.maximum(c.variance - c.light_variance - c.dark_variance, NO_VARIANCE)
    for order, name in ((3, "third"), (4, "fourth"), (5, "fifth")):
        out[f"light_{name}"] = light * c.photon_cumulant(order)
        out[f"dark_{name}"] = dark * c.dark_cumulant(order)


def _check_reach(x: Expectation, c: Cumulants, factors: Factors) -> None:
    """Refuse what the priors could carry further than the device rounds."""
    share = sky_share(x)
    least, most = (factors.on_light(*ends, share) for ends in zip(factors.light_ends, factors.sky_ends, strict=True))
    middle = factors.on_light(factors.light, factors.sky, share)
    light = np.maximum(most - middle, middle - least)
    dark = max(factors.dark_ends[1] - factors.dark, factors.dark - factors.dark_ends[0])
    variance = c.variance + most * c.light_variance + factors.dark_ends[1] * c.dark_variance
    reach = light * c.light_dn + dark * c.dark_dn + 8.0 * np.sqrt(variance)
    if (reach >= REACH_DN).any():
        pixel = int(np.argmax(reach))
        raise InputError(
            f"the priors carry pixel {pixel} of {x.name} {reach[pixel]:.3g} DN away from its mean, expected less than "
            f"{REACH_DN:g}: shorten the exposure or draw frame by frame"
        )


def _draw_frames(
    scenarios: Sequence[Expectation],
    mode: Mode,
    factors: Factors,
    rays: CosmicRays | None,
    corners: Sequence[tuple[float, float, float]],
) -> bool:
    if scenarios[0].n_frames == 1 or mode == "frames":
        # One frame is its own stack: the same draws either way.
        return mode == "frames" and scenarios[0].n_frames > 1
    for x in scenarios:
        near = near_rail(x, factors, rays)
        # The less light and dark, the less the rounding is noise.
        coarse = ~stack_is_exact(_scaled(x, Cumulants.of(x, 1), corners[0]), x)
        for found, why in (
            (near, f"cannot clip, and a frame comes within {RAIL_SIGMA:g} sigma of zero or saturation"),
            (coarse, "takes rounding for noise, and a frame has too little noise of its own for that"),
        ):
            if found.any():
                if mode == "stacked":
                    where = float(x.wavelength_nm[found][0])
                    raise InputError(
                        f"mode = 'stacked' {why} in the pixel at {where:.1f} nm of {x.name}, expected mode 'frames' or "
                        "'auto'"
                    )
                return True
    return False


def _check_same_detector(quiet: Expectation, other: Expectation) -> None:
    for name in (
        "wavelength_nm",
        "dark_dn",
        "bias_dn",
        "read_noise_dn",
        "gain_dn_per_electron",
        "element",
        "n_frames",
        "frame_s",
        "dark_unit",
        "photon_noise",
        "adc_max_dn",
        "saturation_dn",
    ):
        if not np.array_equal(getattr(quiet, name), getattr(other, name)):
            raise InputError(
                f"{name} of {other.name} differs from that of {quiet.name}, expected scenarios of one study "
                "to share instrument and exposure"
            )
