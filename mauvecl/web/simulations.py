"""Simulations that buttons of the page start."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.verbs import VERBS
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.runs.pool import Pool
    from mauvecl.study.study import Study

#: Name of the detection with the other choice of unknowns; the card shows both.
OTHER = "detection otherwise"
#: Cells along each axis of the page's map, and realisations per cell.
MAP_STEPS, MAP_REALISATIONS = 8, 20_000
#: Injected flares: numbers of sizes and half-widths, flares of each, and positions.
INJECTED = {"of": "amplitude", "sizes": 12, "widths": 3, "count": 200, "positions": 4, "fitted": 0}
#: Largest number of simulated fits, and of those of two temperatures, which take fifty times as long.
MOST_FITS, MOST_OF_TWO = 10_000, 1000


def _map_around(study: Study) -> Study:
    """Return the study of a coarse map around the question's star."""
    star, amplitude = study.star[0], study.flare.amplitudes[0]
    middle = 7.0 if star.magnitude is None else star.magnitude
    x = {"quantity": "magnitude", "start": middle - 2.5, "stop": middle + 2.5, "steps": MAP_STEPS}
    y = {"quantity": "amplitude", "start": amplitude / 10, "stop": amplitude * 3, "steps": MAP_STEPS, "log": True}
    # One statistic and the fewest realisations that the false-alarm probability allows keep the map fast.
    fewest = int(np.ceil(100 / study.run.fap))
    n = min(max(MAP_REALISATIONS, fewest), study.run.realisations)
    return _changed(study, map={"x": x, "y": y}, run={"realisations": n, "statistics": [study.run.statistics[-1]]})


def _changed(study: Study, **sections: dict[str, Any]) -> Study:
    """Return a study with other values of keys, by section."""
    return study.with_changes(sections, None, "page")


def _tabulated(answers: dict[str, Any]) -> dict[str, Any]:
    """Add the tables of a visibility, which are slow to make and read repeatedly."""
    answer = answers["visible"]
    return answers | {"seen": {name: getattr(answer, name) for name in ("table", "months", "by_day")}}


@dataclass(frozen=True)
class Simulation:
    """Question that a button of the page asks."""

    # Verbs that answer it, by the names under which the page keeps their answers; the first is the main one.
    verbs: Mapping[str, str]
    asked: Callable[[Study], Study] = lambda study: study  # makes the study that is asked from that of the page
    # Adds to the answers what the page reads repeatedly.
    completed: Callable[[dict[str, Any]], dict[str, Any]] = lambda answers: answers
    # Further answers of the main verb by name, with what makes their study; a refused one is left out.
    others: Mapping[str, Callable[[Study], Study]] = field(default_factory=dict)
    needs: str = ""  # field without which it cannot start

    def __call__(
        self,
        study: Study,
        pool: Pool,
        progress: Callable[[int, int], None] | None = None,
        *,
        given: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Return the answers by name; the main verb reports its progress and takes the contents of files."""
        asked = self.asked(study)
        main = next(iter(self.verbs.values()))
        wanted = [(name, verb, asked) for name, verb in self.verbs.items()]
        wanted += [(name, main, change(asked)) for name, change in self.others.items()]
        counted = sum(VERBS[verb].counts == "realisations" for _, verb, _ in wanted)
        if counted > 1:
            pool.expect(counted * asked.run.realisations)
        answers: dict[str, Any] = {}
        for name, verb, question in wanted:
            try:
                answers[name] = VERBS[verb].ask(question, pool, progress, **(given or {} if verb == main else {}))
            except InputError:
                if name not in self.others:
                    raise
        return self.completed(answers)


def _fits(study: Study) -> Study:
    """Return the study of fits of the flare's spectrum."""
    most = MOST_FITS if study.flare.spectrum.second_area is None else MOST_OF_TWO
    return _changed(study, measure={"fits": min(study.run.realisations, most)})


def _other_unknowns(study: Study) -> Study:
    """Return the study with the usual unknowns if it has none, or without."""
    return _changed(study, nuisances={"usual": not study.nuisances.usual})


#: Simulations that change the study or have another name than their verb.
_OWN_SIMULATIONS = {
    "detection": Simulation({"detection": "detect", "snr": "snr"}, others={OTHER: _other_unknowns}),
    "map": Simulation({"map": "map"}, _map_around),
    "measure": Simulation({"measure": "measure"}, _fits),
    "completeness": Simulation({"completeness": "inject"}, partial(_changed, injections=INJECTED, search={"nulls": 0})),
    "visible": Simulation({"visible": "visible"}, completed=_tabulated, needs="targets"),
    "plan": Simulation({"plan": "plan"}, partial(_changed, plan={"completeness": "closed form"}), needs="targets"),
    "analyse": Simulation({"analyse": "analyse"}, needs="frames"),
    "calibrate": Simulation({"calibrate": "calibrate"}, needs="observations"),
    "periods": Simulation({"periods": "change"}, partial(_changed, change={"periods": True}), needs="targets"),
}
#: All simulations by name: those above, and the verbs that have a tab.
SIMULATIONS = {name: Simulation({name: name}) for name, verb in VERBS.items() if verb.tab} | _OWN_SIMULATIONS


def asked(name: str, study: Study) -> tuple[str, Study]:
    """Return the verb of a simulation, or the verb of that name, with its study derived from the page's."""
    if name not in SIMULATIONS:
        return name, study
    simulation = SIMULATIONS[name]
    return next(iter(simulation.verbs.values())), simulation.asked(study)


def verbs_of(name: str) -> tuple[str, ...]:
    """Return the verbs that answer a simulation, or the verb of that name."""
    return tuple(SIMULATIONS[name].verbs.values()) if name in SIMULATIONS else (name,)


#: Simulations that use the pool's devices.
DRAWING = {"detection", "map"} | {name for name in SIMULATIONS.keys() - _OWN_SIMULATIONS.keys() if VERBS[name].counts}
