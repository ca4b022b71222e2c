"""One observation of every star of a study, taken apart."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from mauvecl.answers.answer import Answer
from mauvecl.noise.components import components
from mauvecl.schema.calls import public
from mauvecl.schema.quantities import count
from mauvecl.study.cases import cases
from mauvecl.study.labels import describe_columns, label
from mauvecl.study.messages import collect_messages
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from collections.abc import Callable

    from astropy.table import QTable, Table

    from mauvecl.device.engine import Engine
    from mauvecl.host.expectation import Expectation
    from mauvecl.runs.pool import Pool
    from mauvecl.study.assumptions import Use


@dataclass(eq=False)
class SimulateAnswer(Answer):
    """What `mauvecl simulate` answers: one table of components per star and stage."""

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "unknowns", "seed")

    ENDINGS = ("ecsv", "fits")

    study: Study
    observations: list[tuple[str, Expectation, QTable]]
    messages: list[str]

    @property
    def assumed(self) -> str:
        """One line with what the study assumes, of flares too where the observations have any."""
        from mauvecl.study.assumptions import assumption_line

        flaring = len(self.observations) > len(self.study.star)
        return assumption_line(self.study, (*self.USES, "flare") if flaring else self.USES)

    @property
    def tables(self) -> dict[str, Table]:
        """One per observation."""
        return {f"observation-{n}": table for n, (_, _, table) in enumerate(self.observations, 1)}

    @property
    def inputs(self) -> list[Expectation]:
        return [x for _, x, _ in self.observations]

    @property
    def summary(self) -> list[dict[str, Any]]:
        """Peak, best closed-form S/N and saturated pixels of each observation."""
        rows = []
        for title, x, _ in self.observations:
            peak = int(x.signal_dn.argmax())
            rows.append(
                {
                    "observation": title,
                    "frames": x.n_frames,
                    "peak_nm": float(x.wavelength_nm[peak]),
                    "peak_dn": float(x.signal_dn[peak]),
                    "snr_pixel": float(x.snr().max()),
                    "snr_element": float(x.snr_per_element().max()),
                    "saturated_pixels": int(x.saturated.sum()),
                }
            )
        return rows

    def as_json(self) -> dict[str, Any]:
        return {"messages": self.messages, "observations": self.summary}

    def plot(self, path: str | Path | None = None, *, number: int = 0, ax: Any = None) -> Any:
        """One of the observations and what it is made of; needs matplotlib."""
        return list(self.pictures.values())[number](path, ax=ax)


@public
def simulate(
    study: Study,
    engine: Engine | Pool | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    realisation: int = 0,
    flaring: bool = False,
) -> SimulateAnswer:
    """One observation of every star of a study, taken apart; with its flares too where asked.

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
    realisation = count("realisation", realisation)
    observations, everything = [], []
    prepared = cases(study, swept=False)
    for done, case in enumerate(prepared, 1):
        xs = case.expectations if flaring else [case.quiet]
        for i, x in enumerate(xs):
            title = label(case.star, x) + (f", flare {100 * case.amplitudes[i - 1]:g} %" if i else "")
            table = components(x, realisation=realisation, seed=study.run.seed, **case.draw_options)
            table.meta["study"] = study.text()
            observations.append((title, x, describe_columns(table)))
        everything += xs
        if progress is not None:
            progress(done, len(prepared))
    return SimulateAnswer(study, observations, collect_messages(everything, study.processes.processes()))
