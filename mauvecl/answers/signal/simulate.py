"""Single simulated observations of a study's stars, by component."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

from mauvecl.answers.answer import Answer
from mauvecl.answers.progress import reported
from mauvecl.noise.reference import components
from mauvecl.schema.calls import validated
from mauvecl.schema.physical import FirstRealisation
from mauvecl.schema.tables import Column, View, table_of
from mauvecl.study.cases import cases
from mauvecl.study.labels import label
from mauvecl.study.messages import collect_messages
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from collections.abc import Callable

    from astropy.table import QTable, Table

    from mauvecl.device.engine import Engine
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool
    from mauvecl.study.assumptions import Use


#: An observation: its title, its expectation, and the table of its components.
Observation = tuple[str, "Expectation", "QTable"]


def _peak(observation: Observation) -> int:
    """Return the pixel with most signal."""
    return int(observation[1].signal_dn.argmax())


#: Columns of the summary of observations.
SUMMARY_COLUMNS = (
    Column("observation", lambda one: one[0], description="star, and flare", heading="observation"),
    Column("frames", lambda one: one[1].n_frames, description="frames of the exposure", heading="frames"),
    Column("peak_nm", lambda one: one[1].wavelength_nm[_peak(one)], "nm", "wavelength of the largest mean signal",
           "peak (nm)", ".1f"),
    Column("peak_dn", lambda one: one[1].signal_dn[_peak(one)], "DN", "largest mean signal of a pixel",
           "peak signal (DN)", ".0f"),
    Column("snr_pixel", lambda one: one[1].snr().max(), "", "largest closed-form S/N of a pixel", "best S/N pixel",
           ".2f"),
    Column("snr_element", lambda one: one[1].snr_per_element().max(), "", "largest closed-form S/N of an element",
           "best S/N element", ".1f"),
    Column("saturated_pixels", lambda one: one[1].saturated.sum(), "", "pixels that saturate", "saturated"),
)  # fmt: skip


@dataclass(eq=False)
class SimulateAnswer(Answer):
    """The answer of `mauvecl simulate`: one table of components per star and stage."""

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "processes", "seed")

    JSON = MappingProxyType({"observations": "summary"})
    ENDINGS = ("ecsv", "fits")

    study: Study
    observations: list[Observation]
    messages: list[str]

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses: flares only if observations have any."""
        return (*self.USES, "flare") if len(self.observations) > len(self.study.star) else self.USES

    @property
    def tables(self) -> dict[str, Table]:
        """One per observation."""
        return {f"observation-{n}": table for n, (_, _, table) in enumerate(self.observations, 1)}

    @property
    def inputs(self) -> list[Expectation]:
        return [x for _, x, _ in self.observations]

    @property
    def summary(self) -> QTable:
        """Peak, best closed-form S/N and saturated pixels of each observation."""
        return table_of(SUMMARY_COLUMNS, self.observations)

    @property
    def views(self) -> list[View]:
        return [View("One observation each (closed-form S/N)", SUMMARY_COLUMNS, self.summary)]

    def plot(self, path: str | Path | None = None, *, number: int = 0, ax: Any = None) -> Any:
        """Plot an observation and its components; requires matplotlib."""
        return list(self.pictures.values())[number](path, ax=ax)


@validated
def simulate(
    study: Study,
    engine: Engine | Pool | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    realisation: FirstRealisation = 0,
    flaring: bool = False,
) -> SimulateAnswer:
    """Simulate one observation of every star of a study, by component.

    Parameters
    ----------
    study : Study
    engine : Engine or Pool, optional
        Not used: the NumPy reference implementation draws.
    progress : callable, optional
        Called as ``progress(done, total)`` in stars.
    realisation : int
        Number of the realisation.
    flaring : bool
        Whether the flares of the study are observed, too.
    """
    observations, everything = [], []
    prepared = cases(study, swept=False)
    for case in reported(prepared, len(prepared), progress):
        xs = case.expectations if flaring else [case.quiet]
        for i, x in enumerate(xs):
            title = label(case.star, x) + (f", flare {100 * case.amplitudes[i - 1]:g} %" if i else "")
            table = components(x, realisation=realisation, seed=study.run.seed, **case.draw_options)
            table.meta["study"] = study.text()
            observations.append((title, x, table))
        everything += xs
    return SimulateAnswer(study, observations, collect_messages(everything, study.processes))
