"""One observation of every star of a study, taken apart."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mauvecl.host.plotting import picture
from mauvecl.noise.components import components
from mauvecl.study.labels import described, label, told
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation


@dataclass(eq=False)
class SimulateAnswer:
    """What `mauvecl simulate` answers: one table of components per star and stage."""

    study: Study
    observations: list[tuple[str, Expectation, QTable]]
    messages: list[str]

    def plot(self, path: str | Path | None = None, *, number: int = 0) -> object:
        """One of the observations and what it is made of; needs matplotlib."""
        title, _, table = self.observations[number]
        return picture("answers.observation", title, table, path)


def simulate(study: Study, *, realisation: int = 0, flaring: bool = False) -> SimulateAnswer:
    """One observation of every star of a study, taken apart; with its flares too where asked."""
    observations, everything = [], []
    for star in study.star:
        xs = study.expectations(star) if flaring else study.expect([star.source()])
        for i, x in enumerate(xs):
            title = label(star, x) + (f", flare {100 * study.flare.amplitudes[i - 1]:g} %" if i else "")
            table = components(x, realisation=realisation, seed=study.run.seed, **study.drawing)
            table.meta["study"] = study.text()
            observations.append((title, x, described(table)))
        everything += xs
    return SimulateAnswer(study, observations, told(everything))
