"""What the page asks of a pool."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.campaigns.plan import PlanAnswer, plan
from mauvecl.answers.campaigns.visible import visible
from mauvecl.answers.detection import maps
from mauvecl.answers.detection.detect import DetectAnswer, detect
from mauvecl.answers.limits.limits import limit
from mauvecl.answers.signal.snr import SnrAnswer, snr
from mauvecl.answers.stares.inject import InjectAnswer, inject
from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened
from mauvecl.host.orbit.targets import Target
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from mauvecl.runs.pool import Pool

#: The map of the page: cells along each axis, and realisations of each.
MAP_STEPS, MAP_REALISATIONS = 8, 20_000
#: Flares that are injected: sizes, half-widths, how many of each, and at how many places.
INJECTED = {"of": "amplitude", "sizes": 12, "widths": 3, "count": 200, "positions": 4, "fitted": 0}


def detect_and_snr(study: Study, pool: Pool) -> tuple[DetectAnswer, SnrAnswer]:
    """Everything that *Simulate* refines."""
    pool.expect(2 * study.run.realisations)
    return detect(study, pool), snr(study, pool)


def map_around(study: Study, pool: Pool) -> maps.MapResult:
    """A coarse map around the question's own star."""
    star, amplitude = study.star[0], study.flare.amplitudes[0]
    middle = 7.0 if star.magnitude is None else star.magnitude
    x = {"quantity": "magnitude", "start": middle - 2.5, "stop": middle + 2.5, "steps": MAP_STEPS}
    y = {"quantity": "amplitude", "start": amplitude / 10, "stop": amplitude * 3, "steps": MAP_STEPS, "log": True}
    # A statistic alone, and as few realisations as the false-alarm probability allows.
    fewest = int(np.ceil(100 / study.run.fap))
    n = min(max(MAP_REALISATIONS, fewest), study.run.realisations)
    run = {"realisations": n, "statistics": [study.run.statistics[-1]]}
    data = study.model_dump()
    data["map"] |= {"x": x, "y": y}
    data["run"] |= run
    return maps.map(Study.build(data, "page"), pool)


def completeness(study: Study, pool: Pool) -> InjectAnswer:
    """What a search of a stare of one orbit finds, coarsely."""
    data = study.model_dump()
    data["injections"] |= INJECTED
    data["search"] |= {"nulls": 0}
    return inject(Study.build(data, "page"), pool)


def planned(study: Study) -> PlanAnswer:
    """What a campaign on the target would find, without injections."""
    for name in study.orbit.targets:
        if Target.of(name).spectral_type is None:
            raise InputError(
                f"neither type nor magnitude nor distance of {shortened(name)} are known, expected a target of the "
                "list, such as eps Eri or AU Mic"
            )
    data = study.model_dump()
    data["plan"] |= {"targets": [{"name": name} for name in study.orbit.targets], "completeness": "closed form"}
    data["orbit"]["targets"] = ()
    return plan(Study.build(data, "page"))


def _detection(study: Study, pool: Pool) -> dict[str, Any]:
    return dict(zip(("detection", "snr"), detect_and_snr(study, pool), strict=True))


def _visible(study: Study) -> dict[str, Any]:
    """The answer with its tables, which are dear to make and looked at again and again."""
    answer = visible(study)
    return {"visible": answer, "seen": {name: getattr(answer, name) for name in ("table", "months", "by_day")}}


#: What may be computed on demand, by name: what is then known, by name.
SIMULATED: dict[str, Callable[[Study, Pool], dict[str, Any]]] = {
    "detection": _detection,
    "limit": lambda study, pool: {"limit": limit(study, pool)},
    "map": lambda study, pool: {"map": map_around(study, pool)},
    "completeness": lambda study, pool: {"completeness": completeness(study, pool)},
    "visible": lambda study, pool: _visible(study),
    "plan": lambda study, pool: {"plan": planned(study)},
}
#: Those that draw by the pool.
DRAWING = {"detection", "limit", "map"}
