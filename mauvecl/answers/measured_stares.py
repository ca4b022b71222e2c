"""Measurements of the flares of a simulated stare: in bins of frames, and by a fit to all frames together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.answer import InCell
from mauvecl.answers.measurements import last_of_one_temperature, model_of, models_of
from mauvecl.device.stares import Stares
from mauvecl.fits.time_course import MeasuredBins, cooling_course, cooling_event, fit_bins, fit_cooling, measure_along
from mauvecl.flares.settings import Cooling
from mauvecl.flares.stare_scene import StaresRequest
from mauvecl.runs.checkpoint import kept
from mauvecl.runs.pool import Pool
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.detection.nuisances import Nuisances
    from mauvecl.device.engine import Engine
    from mauvecl.fits.spectrum import Measurement
    from mauvecl.fits.time_course import CoolingCourse
    from mauvecl.flares.frames import Components, StareExpectation
    from mauvecl.flares.stare import Event
    from mauvecl.study.cases import Case

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class JointFit:
    """Fit of shape and spectrum to all frames, with the drawn flare."""

    found: Measurement
    truth: Float  # shape (n_derived,)
    true: CoolingCourse
    fitted: CoolingCourse


@dataclass(frozen=True, eq=False)
class MeasuredStare(InCell):
    """Flares of a simulated stare, measured in bins of frames with one model, and by a joint fit."""

    model: str
    staring: StareExpectation
    events: tuple[Event, ...]
    drawn: MeasuredBins | None
    perfect: MeasuredBins | None  # the same bins without noise
    joint: JointFit | None
    unmeasured: str = ""  # why no bin reaches the S/N


def measured_stare(case: Case, engine: Engine | Pool) -> MeasuredStare:
    """Draw the stare of a case, and measure its flares."""
    study, asked = case.study, case.study.measure
    staring, events = case.stare_expectation, case.events
    if asked.joint_fit and len(events) != 1:
        raise InputError(
            f"a joint fit needs a stare with a single flare, but it has {len(events)}", key="measure.joint_fit"
        )
    quiet, stare, seed = staring.quiet, staring.stare, study.run.seed
    name, model = last_of_one_temperature(models_of(case.one_frame))
    unknown = case.unknowns_of_fits(quiet, stare)
    processes = study.processes.additive_only

    def draw(components: Components) -> Float:
        request = StaresRequest(components, stare, 1, seed, staring.flare, start=study.stare.number, method="pixels",
                                processes=processes)  # fmt: skip
        reduced = engine.stares if isinstance(engine, Pool) else Stares(engine.open_device).reduced
        return np.asarray(reduced(request)["values"][0], np.float64)

    checkpoint = engine.checkpoint if isinstance(engine, Pool) else None
    depends_on = ("pixels", quiet, staring.flare_electrons, stare, staring.flare, study.stare.number, seed, processes)
    raw = kept(checkpoint, depends_on, lambda: {"frames": staring.raw(draw)})["frames"]
    where = case.label, case.at, name, staring, tuple(events)
    joint = _joint_fit(case, raw, unknown) if asked.joint_fit else None
    if asked.snr_per_bin is None:
        return MeasuredStare(*where, None, None, joint)
    try:
        bins = measure_along(raw, quiet, model, unknown, snr_per_bin=asked.snr_per_bin, stare=stare,
                             skipped_nm=asked.skipped_nm)  # fmt: skip
    except InputError as error:
        sentence = f"No flare of {case.label} is measured along the stare: {error}."
        return MeasuredStare(*where, None, None, joint, sentence)
    perfect = fit_bins(
        staring.mean_raw, quiet, model, unknown, stare, bins.first, bins.count, skipped_nm=asked.skipped_nm
    )
    return MeasuredStare(*where, bins, perfect, joint)


def _joint_fit(case: Case, raw: Float, unknown: Nuisances | None) -> JointFit:
    """Fit a blackbody to the one flare of a stare; the search for the best fit starts from the true flare."""
    staring, (event,), model = case.stare_expectation, case.events, model_of(case.one_frame)
    quiet, stare, skipped = staring.quiet, staring.stare, case.study.measure.skipped_nm
    measurement = fit_cooling(
        raw, quiet, model, unknown, peak_s=event.peak_s, half_width_s=event.half_width_s, shape=event.form,
        cooling=isinstance(event.temperature, Cooling), stare=stare, skipped_nm=skipped,
    )  # fmt: skip
    true, fitted = (
        cooling_course(flare_event, measurement, raw, quiet, model, stare, skipped)
        for flare_event in (event, cooling_event(measurement, event.form))
    )
    truth = true.values
    if not case.study.flare.is_blackbody:
        # Only the shape is that of the model.
        truth = np.where(np.arange(truth.size) < 2, truth, np.nan)
    return JointFit(measurement, truth, true, fitted)
