"""Simulations that the page requests from a pool."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.campaigns.plan import PlanAnswer, plan
from mauvecl.answers.campaigns.visible import visible
from mauvecl.answers.detection import maps
from mauvecl.answers.detection.detect import DetectAnswer, detect
from mauvecl.answers.measurements.measure import MeasureAnswer, measure
from mauvecl.answers.signal.snr import SnrAnswer, snr
from mauvecl.answers.stares.inject import InjectAnswer, inject
from mauvecl.answers.verbs import VERBS
from mauvecl.host.orbit.targets import Target
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from mauvecl.runs.pool import Pool

#: Cells along each axis of the page's map, and realisations per cell.
MAP_STEPS, MAP_REALISATIONS = 8, 20_000
#: Injected flares: numbers of sizes and half-widths, flares of each, and positions.
INJECTED = {"of": "amplitude", "sizes": 12, "widths": 3, "count": 200, "positions": 4, "fitted": 0}
#: Largest number of simulated fits, and of those of two temperatures, which take fifty times as long.
MOST_FITS, MOST_OF_TWO = 10_000, 1000


def detect_and_snr(study: Study, pool: Pool) -> tuple[DetectAnswer, SnrAnswer]:
    """Run the simulations of the button *Simulate*."""
    pool.expect(2 * study.run.realisations)
    return detect(study, pool), snr(study, pool)


def map_around(study: Study, pool: Pool) -> maps.MapAnswer:
    """Simulate a coarse map around the question's star."""
    star, amplitude = study.star[0], study.flare.amplitudes[0]
    middle = 7.0 if star.magnitude is None else star.magnitude
    x = {"quantity": "magnitude", "start": middle - 2.5, "stop": middle + 2.5, "steps": MAP_STEPS}
    y = {"quantity": "amplitude", "start": amplitude / 10, "stop": amplitude * 3, "steps": MAP_STEPS, "log": True}
    # One statistic and the fewest realisations that the false-alarm probability allows keep the map fast.
    fewest = int(np.ceil(100 / study.run.fap))
    n = min(max(MAP_REALISATIONS, fewest), study.run.realisations)
    run = {"realisations": n, "statistics": [study.run.statistics[-1]]}
    data = study.model_dump()
    data["map"] |= {"x": x, "y": y}
    data["run"] |= run
    return maps.map(Study.build(data, "page"), pool)


def completeness(study: Study, pool: Pool) -> InjectAnswer:
    """Simulate the completeness of a search of one orbit's stare on a coarse grid."""
    data = study.model_dump()
    data["injections"] |= INJECTED
    data["search"] |= {"nulls": 0}
    return inject(Study.build(data, "page"), pool)


def fits(study: Study, pool: Pool) -> MeasureAnswer:
    """Simulate fits of the flare's spectrum."""
    data = study.model_dump()
    most = MOST_FITS if study.flare.spectrum.second_area is None else MOST_OF_TWO
    data["measure"] |= {"fits": min(study.run.realisations, most)}
    return measure(Study.build(data, "page"), pool)


def campaign_plan(study: Study) -> PlanAnswer:
    """Compute the yield of a campaign on the target, without injections."""
    for name in study.orbit.targets:
        if Target.of(name).spectral_type is None:
            raise InputError(
                f"neither type nor magnitude nor distance of {shortened(name)} are known",
                "a target of the list, such as eps Eri or AU Mic",
                key="see",
                value=name,
            )
    data = study.model_dump()
    data["plan"] |= {"targets": [{"name": name} for name in study.orbit.targets], "completeness": "closed form"}
    data["orbit"]["targets"] = ()
    return plan(Study.build(data, "page"))


def _detection(study: Study, pool: Pool) -> dict[str, Any]:
    return dict(zip(("detection", "snr"), detect_and_snr(study, pool), strict=True))


def _visible(study: Study) -> dict[str, Any]:
    """Compute the visibility with its tables, which are slow to make and read repeatedly."""
    answer = visible(study)
    return {"visible": answer, "seen": {name: getattr(answer, name) for name in ("table", "months", "by_day")}}


def _answer(verb: str, study: Study, pool: Pool) -> dict[str, Any]:
    return {verb: VERBS[verb].ask(study, pool)}


#: Functions of simulations that change the study or make several answers; they return answers by name.
_ADAPTED: dict[str, Callable[[Study, Pool], dict[str, Any]]] = {
    "detection": _detection,
    "map": lambda study, pool: {"map": map_around(study, pool)},
    "measure": lambda study, pool: {"measure": fits(study, pool)},
    "completeness": lambda study, pool: {"completeness": completeness(study, pool)},
    "visible": lambda study, pool: _visible(study),
    "plan": lambda study, pool: {"plan": campaign_plan(study)},
}
#: Functions of all simulations by name: the adapted ones, and the verbs that have a tab.
SIMULATIONS = {name: partial(_answer, name) for name, verb in VERBS.items() if verb.tab} | _ADAPTED
#: Simulations that use the pool's devices.
DRAWING = {"detection", "map"} | {name for name in SIMULATIONS.keys() - _ADAPTED.keys() if VERBS[name].counts}
