"""A study's flares measured against time along one simulated stare."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.answer import InCell
from mauvecl.answers.measurements.expected import models_of
from mauvecl.lightcurve.stares.measured_bins import MeasuredBins, fit_bins, measure_along
from mauvecl.lightcurve.stares.stare_requests import Arrays, StaresRequest
from mauvecl.runs.checkpoint import kept
from mauvecl.runs.pool import Pool
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.device.engine import Engine
    from mauvecl.lightcurve.flares.events import Event
    from mauvecl.lightcurve.stares.frame_components import Components
    from mauvecl.lightcurve.stares.light_curves import StareExpectation
    from mauvecl.study.cases import Case

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MeasuredStare(InCell):
    """The flares of one simulated stare, measured in bins of its frames by one model."""

    model: str
    staring: StareExpectation
    events: tuple[Event, ...]
    drawn: MeasuredBins | str  # a sentence if no bin reaches the S/N
    perfect: MeasuredBins | None  # the same bins without noise


def measured_stare(case: Case, engine: Engine | Pool, snr_per_bin: float) -> MeasuredStare:
    """Draw the stare of a case, and measure its flares with the model of the flare's spectrum."""
    study = case.study
    staring, events = case.stare_expectation, case.events
    quiet, stare, seed = staring.quiet, staring.stare, study.run.seed
    processes = study.processes.additive_only
    name, model = list(models_of(case.one_frame).items())[-1]
    unknown = case.unknowns(quiet)

    def draw(components: Components) -> Float:
        request = StaresRequest(components, stare, 1, seed, staring.flare, start=study.stare.number, method="pixels",
                                processes=processes)  # fmt: skip
        if isinstance(engine, Pool):
            return np.asarray(engine.stares(request)["values"][0], np.float64)
        from mauvecl.device.stare_engine import Stares

        return np.asarray(Stares(engine.open_device).reduced(request)["values"][0], np.float64)

    def drawn() -> Arrays:
        return {"frames": staring.raw(draw)}

    checkpoint = engine.checkpoint if isinstance(engine, Pool) else None
    depends_on = ("pixels", quiet, staring.flare_electrons, stare, staring.flare, study.stare.number, seed, processes)
    raw = kept(checkpoint, depends_on, drawn)["frames"]
    where = case.label, case.at, name, staring, tuple(events)
    try:
        bins = measure_along(raw, quiet, model, unknown, snr_per_bin=snr_per_bin, stare=stare)
    except InputError as error:
        return MeasuredStare(*where, f"No flare of {case.label} is measured along the stare: {error}.", None)
    return MeasuredStare(*where, bins, fit_bins(staring.mean_raw, quiet, model, unknown, stare, bins.first, bins.count))
