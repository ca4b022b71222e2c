"""Scenes: the arrays of expectations that the kernels and their NumPy reference read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise import layout, pixel_tables
from mauvecl.noise.comparison import NOISE_FREE, Comparison
from mauvecl.noise.cumulants import polynomial
from mauvecl.noise.draw_method import DrawMethod, check_reach, choose_method
from mauvecl.noise.drawing import Drawing, DrawingOptions
from mauvecl.noise.factor_tables import Factors
from mauvecl.noise.poisson import AliasTable, table_of
from mauvecl.noise.unknowns import ADDITIVE, SignalPart

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

#: Largest number of scenarios per launch for stacks, and frame by frame (True), which needs more registers.
BATCH = {False: 16, True: 8}
Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Scene:
    """Scenarios on common draws, as arrays for the kernels."""

    n_pixel: int  # number of pixels; the arrays are padded to a multiple of `PIXEL_BLOCK`
    n_frames: int  # number of frames of the exposure
    frames: bool  # whether each frame is drawn, rounded and clipped, instead of their sum at once
    #: Whether all noise of a draw comes from one normal through its cumulants, instead of separate Poisson counts.
    joint: bool
    quartic: bool  # whether a joint draw needs the fourth power of its normal and, if factors vary, fifth cumulants
    photons: bool  # whether photon counts are also drawn separately
    clip: bool  # whether single draws are clipped at the ADC's rails
    modulations: tuple[tuple[str, SignalPart], ...]  # priors that change light, dark or sky; see `Processes`
    job: NDArray[np.void]  # shape (); parameters of a launch without the seed
    pixels: NDArray[np.void]  # shape (n_padded,)
    #: Shape (n_scenario, n_padded); structs layout.LEVEL, EDGE, POISSON and RESPONSE; the last two are empty if not
    #: needed.
    levels: NDArray[np.void]
    edges: NDArray[np.void]  # shape (n_scenario, n_padded)
    dark_counts: NDArray[np.void]  # shape (n_padded,)
    photon_counts: NDArray[np.void]  # shape (n_scenario, n_padded)
    responses: NDArray[np.void]  # shape (n_scenario, n_padded)
    tables: NDArray[np.uint32]  # concatenated alias tables
    priors: NDArray[np.float32]  # shape (n_modulation, 2 * PRIOR_NODES); quantile tables
    medians: tuple[float, float, float]  # factors on light, dark and sky at the priors' medians
    #: Shape (n_scenario,); for each scenario, the scenario with whose mean and variance it is compared.
    references: NDArray[np.uint32]
    #: Shape (n_scenario, n_padded); reference rounded to whole DN minus the reference; zero for noisy reference
    #: exposures.
    fraction: Float
    #: Shape (n_scenario, n_padded); parameters of estimated variances; empty for the model's.
    estimates: NDArray[np.void]
    comparison: Comparison
    base_dn: NDArray[np.int64]  # shape (n_scenario, n_pixel); whole DN of one draw's mean that the kernels omit
    used: NDArray[np.bool_]  # shape (n_pixel,); pixels that enter the statistics, those that no reference saturates

    @property
    def n_draws(self) -> int:
        """Number of draws that are summed in a realisation of a pixel."""
        return self.n_frames if self.frames else 1

    @property
    def additive(self) -> tuple[str, ...]:
        """Names of the additive processes that are drawn."""
        return tuple(name for name in ADDITIVE if self.job[f"{name}_bits"])

    def constants(
        self, weights: NDArray[np.float32], linear_end: NDArray[np.uint32], pixels_end: NDArray[np.uint32]
    ) -> NDArray[np.float32]:
        """Compute the contribution of the reference's fractions of a DN to chi-squared and to each linear statistic.

        Sums of resolution elements include them already.

        Returns
        -------
        ndarray of float32, shape (n_scenario + n_linear,)
        """
        chi2 = np.sum(self.levels["inverse_variance"] * self.fraction**2, axis=1)
        scenario = np.searchsorted(linear_end, np.arange(len(weights)), side="right")
        linear = [float(weights[i] @ self.fraction[k]) if i < pixels_end[k] else 0.0 for i, k in enumerate(scenario)]
        return np.array([*chi2, *linear], np.float32)

    def part(self, scenarios: Sequence[int]) -> Scene:
        """Return the scene with some of its scenarios, in the given order, which must include their references."""
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
    **words: Unpack[DrawingOptions],
) -> Scene:
    """Compute the arrays of scenarios for the device.

    Raises InputError if scenarios differ in more than their light, stacked draws are requested near a rail, or a
    process needs joint draws that are not exact.

    Parameters
    ----------
    scenarios : sequence of Expectation
        Expectations that differ only in their light.
    drawing : Drawing, optional
        Options of the draw, which can also be given as keywords.
    references : sequence of int, optional
        For each scenario, the quiescent one with which it is compared; by default the first.
    comparison : Comparison
        Subtracted reference and variances.
    first_group : int
        Number of the first group of four pixels in the generator's counter.
    """
    drawing = drawing or Drawing(**words)
    quiet = scenarios[0]
    factors = Factors.of(drawing.processes, quiet.conditions)
    method = choose_method(scenarios, drawing, factors)
    compared = np.zeros(len(scenarios), np.uint32) if references is None else np.array(references, np.uint32)
    used = ~np.any([scenarios[t].saturated for t in np.unique(compared)], axis=0)
    n_pixel, tables = used.size, list[AliasTable]()

    darks, dark_centre = np.zeros(pixel_tables.padded(n_pixel), layout.POISSON), np.zeros(n_pixel)
    if not method.joint:
        step = quiet.dark_step_dn
        dark_dn = method.each * quiet.dark_dn
        dark_centre = pixel_tables.fill_poisson_counts(darks[:n_pixel], dark_dn / step, step, tables)
    arrays = _PerScenario.empty(scenarios, method, comparison, modulated=bool(drawing.processes.modulations))
    for k, x in enumerate(scenarios):
        arrays.fill_draw(k, x, method, factors, quiet.dark_step_dn * dark_centre, tables)
        arrays.fill_comparison(k, x, scenarios[compared[k]], method, comparison, used)
    job = _job(scenarios, drawing, method, comparison, first_group, tables)
    return Scene(
        n_pixel=n_pixel,
        n_frames=quiet.n_frames,
        frames=method.frames,
        joint=method.joint,
        quartic=method.quartic,
        photons=method.photons,
        clip=method.each == 1,
        modulations=drawing.processes.modulations,
        job=job,
        pixels=pixel_tables.detector_pixels(quiet, used),
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
    """Arrays of a `Scene` with a row for each scenario."""

    levels: NDArray[np.void]
    edges: NDArray[np.void]
    photon_counts: NDArray[np.void]
    responses: NDArray[np.void]
    fraction: Float
    estimates: NDArray[np.void]
    base_dn: NDArray[np.int64]

    @classmethod
    def empty(
        cls, scenarios: Sequence[Expectation], method: DrawMethod, comparison: Comparison, *, modulated: bool
    ) -> _PerScenario:
        """Return arrays filled with the values of padding."""
        n_pixel = scenarios[0].wavelength_nm.size
        shape = (len(scenarios), pixel_tables.padded(n_pixel))
        arrays = cls(
            levels=np.zeros(shape, layout.LEVEL),
            edges=np.zeros(shape, layout.EDGE),
            photon_counts=np.zeros(shape if method.photons else 0, layout.POISSON),
            responses=np.zeros(shape if modulated else 0, layout.RESPONSE),
            fraction=np.zeros(shape),
            estimates=np.zeros(shape if comparison.estimated else 0, layout.ESTIMATE),
            base_dn=np.zeros((len(scenarios), n_pixel), np.int64),
        )
        arrays.responses["other_variance"] = pixel_tables.NO_VARIANCE
        for name, array in (("shift", arrays.levels), ("low", arrays.edges), ("high", arrays.edges)):
            array[name] = layout.MAGIC
        return arrays

    def fill_draw(
        self, k: int, x: Expectation, method: DrawMethod, factors: Factors, dark_dn: Float, tables: list[AliasTable]
    ) -> None:
        """Fill the arrays for the draw of scenario k, whose dark counts are relative to `dark_dn`."""
        c, level = method.cumulants[k], self.levels[k, : dark_dn.size]
        mean = self._mean(k, x, method, factors, dark_dn, tables)
        base = self.base_dn[k] = np.clip(np.rint(mean), 0, x.highest_dn if method.each == 1 else np.inf)
        if self.responses.size:
            pixel_tables.fill_responses(self.responses[k, : dark_dn.size], x, c, factors)
            check_reach(x, c, factors)
        elif method.joint:
            for name, coefficient in zip(("c0", "c1", "c2", "c3", "c4"), polynomial(c), strict=True):
                level[name] = coefficient
        else:
            level["c1"] = np.sqrt(c.gaussian)
        level["c0"] += mean - base

    def _mean(
        self, k: int, x: Expectation, method: DrawMethod, factors: Factors, dark_dn: Float, tables: list[AliasTable]
    ) -> Float:
        """Return the mean, DN, to which a draw is relative; separate Poisson counts are relative to integers."""
        c, gain = method.cumulants[k], x.gain_dn_per_electron
        if method.joint:
            light = factors.on_light(factors.light, factors.sky, pixel_tables.sky_share(x))
            return np.asarray(c.mean + (light - 1.0) * c.light_dn + (factors.dark - 1.0) * c.dark_dn)
        mean = method.each * x.bias_dn + dark_dn
        if method.photons:
            out = self.photon_counts[k, : dark_dn.size]
            return np.asarray(mean + gain * pixel_tables.fill_poisson_counts(out, c.photons, gain, tables))
        return np.asarray(mean + gain * c.photons)

    def fill_comparison(
        self,
        k: int,
        x: Expectation,
        reference: Expectation,
        method: DrawMethod,
        comparison: Comparison,
        used: NDArray[np.bool_],
    ) -> None:
        """Fill the arrays for the comparison of scenario k with its reference."""
        base, n_pixel = self.base_dn[k], used.size
        level, edge, fraction = self.levels[k, :n_pixel], self.edges[k, :n_pixel], self.fraction[k, :n_pixel]
        mean_sum = reference.recorded_dn
        whole = (x.n_frames // method.each) * base - np.rint(mean_sum)
        if not comparison.exposures:
            fraction[:] = np.rint(mean_sum) - mean_sum
        level["shift"] = layout.MAGIC - whole
        variance = variance_factor(comparison) * reference.variance_dn2
        level["inverse_variance"] = used / variance
        level["twice"] = 2.0 * fraction * level["inverse_variance"]
        edge["base"], edge["whole"] = base, whole
        edge["low"] = layout.MAGIC - base
        edge["high"] = layout.MAGIC + (x.highest_dn - base)
        if comparison.estimated:
            pixel_tables.fill_estimates(self.estimates[k], reference, self.fraction[k], np.rint(mean_sum))
        ends = pixel_tables.element_ends(x)
        element_variance = np.bincount(x.element, variance * used)
        with np.errstate(divide="ignore"):
            edge["inverse_element_variance"][ends] = np.where(element_variance > 0, 1.0 / element_variance, 0.0)
        edge["element_offset"][ends] = np.bincount(x.element, fraction * used)


def variance_factor(comparison: Comparison) -> float:
    """Return the factor by which the noise of the subtracted reference increases the null's variance."""
    return 1.0 + comparison.added_variance


def _job(
    scenarios: Sequence[Expectation],
    drawing: Drawing,
    method: DrawMethod,
    comparison: Comparison,
    first_group: int,
    tables: list[AliasTable],
) -> NDArray[np.void]:
    """Return the parameters of a launch, layout.JOB, shape (); append the tables of additive processes to `tables`."""
    quiet = scenarios[0]
    job = np.zeros((), layout.JOB)
    n_pixel = quiet.wavelength_nm.size
    job["pixel_count"], job["padded_count"] = n_pixel, pixel_tables.padded(n_pixel)
    job["scenario_count"] = len(scenarios)
    job["draw_count"], job["frame_count"] = quiet.n_frames if method.frames else 1, quiet.n_frames
    job["first_frame"], job["first_group"] = drawing.first_frame, first_group
    job["reference_count"], job["reference_weight"] = comparison.exposures, comparison.added_variance
    job["pair_scale"] = variance_factor(comparison) / 2.0
    for name, process in drawing.processes.additive.items():
        table = table_of(process.charge(method.each * quiet.frame_s))
        job[f"{name}_table"] = sum(t.entries.size for t in tables)
        job[f"{name}_bits"], job[f"{name}_low"] = table.bits, table.low
        tables.append(table)
    return job
