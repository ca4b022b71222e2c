"""Expectations of one study as the arrays that the kernels and their twin read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise import layout, pixels
from mauvecl.noise.choice import Choice, check_reach, choose
from mauvecl.noise.comparison import NOISE_FREE, Comparison
from mauvecl.noise.cumulants import polynomial
from mauvecl.noise.drawing import Drawing, DrawingWords
from mauvecl.noise.poisson import AliasTable, table_of
from mauvecl.noise.processes import Factors
from mauvecl.noise.varied import Modulated

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

#: Scenarios in one launch: drawn as stacks, or frame by frame, which needs room for each.
BATCH = {False: 16, True: 8}
Float = NDArray[np.float64]


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
    references : ndarray of uint32, shape (n_scenario,)
        For each scenario the one whose mean and variance it is compared with.
    fraction : ndarray, shape (n_scenario, n_padded)
        Reference rounded to whole DN less the reference; zero where noisy exposures take its place.
    estimates : ndarray of layout.ESTIMATE, shape (n_scenario, n_padded)
        Empty where variances are the model's.
    comparison : Comparison
    base_dn : ndarray of int64, shape (n_scenario, n_pixel)
        Whole DN of one draw's mean that the kernels leave out.
    used : ndarray of bool, shape (n_pixel,)
        Pixels that enter the statistics: those no reference saturates.
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
    references: NDArray[np.uint32]
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

    def constants(
        self, weights: NDArray[np.float32], linear_end: NDArray[np.uint32], pixels_end: NDArray[np.uint32]
    ) -> NDArray[np.float32]:
        """What the reference's fractions add to each sum: chi-squared per scenario, then each linear statistic.

        Sums of resolution elements hold them already.

        Returns
        -------
        ndarray of float32, shape (n_scenario + n_linear,)
        """
        chi2 = np.sum(self.levels["inverse_variance"] * self.fraction**2, axis=1)
        scenario = np.searchsorted(linear_end, np.arange(len(weights)), side="right")
        linear = [float(weights[i] @ self.fraction[k]) if i < pixels_end[k] else 0.0 for i, k in enumerate(scenario)]
        return np.array([*chi2, *linear], np.float32)

    def part(self, scenarios: Sequence[int]) -> Scene:
        """The same scene with some of its scenarios, in the order given; their references must be among them."""
        chosen = list(scenarios)
        job = self.job.copy()
        job["scenario_count"] = len(chosen)
        per_scenario = {
            name: array[chosen] if len(array := getattr(self, name)) else array
            for name in ("levels", "edges", "photon_counts", "responses", "fraction", "estimates", "base_dn")
        }
        references = np.array([chosen.index(t) for t in self.references[chosen]], np.uint32)
        return replace(self, job=job, references=references, **per_scenario)


def prepare(
    scenarios: Sequence[Expectation],
    drawing: Drawing | None = None,
    *,
    references: Sequence[int] | None = None,
    comparison: Comparison = NOISE_FREE,
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
    references : sequence of int, optional
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
    quiet = scenarios[0]
    factors = drawing.processes.factors(quiet.conditions)
    choice = choose(scenarios, drawing, factors)
    compared = np.zeros(len(scenarios), np.uint32) if references is None else np.array(references, np.uint32)
    used = ~np.any([scenarios[t].saturated for t in np.unique(compared)], axis=0)
    n_pixel, tables = used.size, list[AliasTable]()

    darks, dark_centre = np.zeros(pixels.padded(n_pixel), layout.POISSON), np.zeros(n_pixel)
    if not choice.joint:
        step = quiet.dark_step_dn
        dark_centre = pixels.poisson_counts(darks[:n_pixel], choice.each * quiet.dark_dn / step, step, tables)
    arrays = _PerScenario.empty(scenarios, choice, comparison, modulated=bool(drawing.processes.modulations))
    for k, x in enumerate(scenarios):
        arrays.fill_draw(k, x, choice, factors, quiet.dark_step_dn * dark_centre, tables)
        arrays.fill_comparison(k, x, scenarios[compared[k]], choice, comparison, used)
    job = _job(scenarios, drawing, choice, comparison, first_group, tables)
    return Scene(
        n_pixel=n_pixel,
        n_frames=quiet.n_frames,
        frames=choice.frames,
        joint=choice.joint,
        quartic=choice.quartic,
        photons=choice.photons,
        clip=choice.each == 1,
        modulations=drawing.processes.modulations,
        job=job,
        pixels=pixels.of_detector(quiet, used),
        dark_counts=darks,
        tables=np.concatenate([np.zeros(0, np.uint32), *(t.entries for t in tables)]).astype(np.uint32),
        priors=factors.tables,
        medians=(factors.light, factors.dark, factors.sky),
        references=compared,
        comparison=comparison,
        used=used,
        **vars(arrays),
    )


@dataclass(eq=False)
class _PerScenario:
    """Arrays of a `Scene` with a row for each scenario, as they are filled."""

    levels: NDArray[np.void]
    edges: NDArray[np.void]
    photon_counts: NDArray[np.void]
    responses: NDArray[np.void]
    fraction: Float
    estimates: NDArray[np.void]
    base_dn: NDArray[np.int64]

    @classmethod
    def empty(
        cls, scenarios: Sequence[Expectation], choice: Choice, comparison: Comparison, *, modulated: bool
    ) -> _PerScenario:
        """All that padding needs."""
        n_pixel = scenarios[0].wavelength_nm.size
        shape = (len(scenarios), pixels.padded(n_pixel))
        arrays = cls(
            levels=np.zeros(shape, layout.LEVEL),
            edges=np.zeros(shape, layout.EDGE),
            photon_counts=np.zeros(shape if choice.photons else 0, layout.POISSON),
            responses=np.zeros(shape if modulated else 0, layout.RESPONSE),
            fraction=np.zeros(shape),
            estimates=np.zeros(shape if comparison.estimated else 0, layout.ESTIMATE),
            base_dn=np.zeros((len(scenarios), n_pixel), np.int64),
        )
        arrays.responses["other_variance"] = pixels.NO_VARIANCE
        for name, array in (("shift", arrays.levels), ("low", arrays.edges), ("high", arrays.edges)):
            array[name] = layout.MAGIC
        return arrays

    def fill_draw(
        self, k: int, x: Expectation, choice: Choice, factors: Factors, dark_dn: Float, tables: list[AliasTable]
    ) -> None:
        """How scenario k is drawn; `dark_dn` is what its dark counts are relative to."""
        c, level = choice.cumulants[k], self.levels[k, : dark_dn.size]
        mean = self._mean(k, x, choice, factors, dark_dn, tables)
        base = self.base_dn[k] = np.clip(np.rint(mean), 0, x.highest_dn if choice.each == 1 else np.inf)
        if self.responses.size:
            pixels.respond(self.responses[k, : dark_dn.size], x, c, factors)
            check_reach(x, c, factors)
        elif choice.joint:
            for name, coefficient in zip(("c0", "c1", "c2", "c3", "c4"), polynomial(c), strict=True):
                level[name] = coefficient
        else:
            level["c1"] = np.sqrt(c.gaussian)
        level["c0"] += mean - base

    def _mean(
        self, k: int, x: Expectation, choice: Choice, factors: Factors, dark_dn: Float, tables: list[AliasTable]
    ) -> Float:
        """DN that a draw is relative to: of Poisson counts drawn apart, whole ones."""
        c, gain = choice.cumulants[k], x.gain_dn_per_electron
        if choice.joint:
            light = factors.on_light(factors.light, factors.sky, pixels.sky_share(x))
            return np.asarray(c.mean + (light - 1.0) * c.light_dn + (factors.dark - 1.0) * c.dark_dn)
        mean = choice.each * x.bias_dn + dark_dn
        if choice.photons:
            out = self.photon_counts[k, : dark_dn.size]
            return np.asarray(mean + gain * pixels.poisson_counts(out, c.photons, gain, tables))
        return np.asarray(mean + gain * c.photons)

    def fill_comparison(
        self,
        k: int,
        x: Expectation,
        reference: Expectation,
        choice: Choice,
        comparison: Comparison,
        used: NDArray[np.bool_],
    ) -> None:
        """What scenario k is compared with."""
        base, n_pixel = self.base_dn[k], used.size
        level, edge, fraction = self.levels[k, :n_pixel], self.edges[k, :n_pixel], self.fraction[k, :n_pixel]
        mean_sum = reference.recorded_dn
        whole = (x.n_frames // choice.each) * base - np.rint(mean_sum)
        if not comparison.exposures:
            fraction[:] = np.rint(mean_sum) - mean_sum
        level["shift"] = layout.MAGIC - whole
        variance = noisier(comparison) * reference.variance_dn2
        level["inverse_variance"] = used / variance
        level["twice"] = 2.0 * fraction * level["inverse_variance"]
        edge["base"], edge["whole"] = base, whole
        edge["low"] = layout.MAGIC - base
        edge["high"] = layout.MAGIC + (x.highest_dn - base)
        if comparison.estimated:
            pixels.estimate(self.estimates[k], reference, self.fraction[k], np.rint(mean_sum))
        ends = pixels.element_ends(x)
        element_variance = np.bincount(x.element, variance * used)
        with np.errstate(divide="ignore"):
            edge["inverse_element_variance"][ends] = np.where(element_variance > 0, 1.0 / element_variance, 0.0)
        edge["element_offset"][ends] = np.bincount(x.element, fraction * used)


def noisier(comparison: Comparison) -> float:
    """By how much what is subtracted adds its noise to the null's variance."""
    return 1.0 + comparison.added_variance


def _job(
    scenarios: Sequence[Expectation],
    drawing: Drawing,
    choice: Choice,
    comparison: Comparison,
    first_group: int,
    tables: list[AliasTable],
) -> NDArray[np.void]:
    """What a launch reads once: layout.JOB, shape (); the table of cosmic rays comes behind the others."""
    quiet = scenarios[0]
    job = np.zeros((), layout.JOB)
    n_pixel = quiet.wavelength_nm.size
    job["pixel_count"], job["padded_count"], job["scenario_count"] = n_pixel, pixels.padded(n_pixel), len(scenarios)
    job["draw_count"], job["frame_count"] = quiet.n_frames if choice.frames else 1, quiet.n_frames
    job["first_frame"], job["first_group"] = drawing.first_frame, first_group
    job["reference_count"], job["reference_weight"] = comparison.exposures, comparison.added_variance
    job["pair_scale"] = noisier(comparison) / 2.0
    rays = drawing.processes.cosmic_rays
    if rays is not None:
        table = table_of(rays.charge(choice.each * quiet.frame_s))
        job["cosmic_table"] = sum(t.entries.size for t in tables)
        job["cosmic_bits"], job["cosmic_low"] = table.bits, table.low
        tables.append(table)
    return job
