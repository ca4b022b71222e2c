"""Which unknown limits which star: S/N of every flare under each of several unknowns, by closed forms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.answers.answer import Answer
from mauvecl.answers.detection.unknown_cost import Cost, spoken, unknown_cost
from mauvecl.schema.tables import Column, View, percent, table_of
from mauvecl.study.cases import cases
from mauvecl.study.labels import amplitude_column, star_column
from mauvecl.study.messages import collect_messages
from mauvecl.study.nuisances import NuisanceChoice

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.assumptions import Use
    from mauvecl.study.study import Study

#: Default unknowns, which include those of the table in METHODS.
SHOWN: dict[str, NuisanceChoice] = {
    spoken(choice): choice
    for choice in (
        NuisanceChoice(dark=0.1),
        NuisanceChoice(light=0.01),
        NuisanceChoice(dark="free", light="free"),
        NuisanceChoice(sky=0.1),
        NuisanceChoice(tilt=0.01),
    )
}

#: Columns of the table.
COLUMNS = (
    star_column(),
    amplitude_column(),
    Column("unknown", description="what is unknown", heading="unknown"),
    Column("known", description="S/N of the matched statistic with everything known", heading="S/N, all known",
           format=".3g"),
    Column("plain", description="the same where it is unknown and the statistic does not know of it",
           heading="S/N, not looked for", format=".3g"),
    Column("marginalised", description="the same, marginalised", heading="S/N, marginalised", format=".3g"),
    Column("detected", description="detection probability of the marginalised statistic at the header's false alarms",
           heading="then detected", format=percent(".3g")),
    Column("smallest", description="flare amplitude that is detected, marginalised, at the header's power and false "
           "alarms", heading="smallest flare", format=percent(".3g")),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class UnknownAnswer(Answer):
    """The answer of `unknown_table`."""

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "flare", "nuisances", "seed")

    study: Study
    costs: dict[tuple[str, float], dict[str, Cost]]  # by (star, amplitude), then by unknown
    quiets: tuple[Expectation, ...] = ()  # the stars without a flare

    def smallest(self, star: str, unknown: str | None) -> float:
        """Return the flare amplitude detected with the study's power at its false-alarm probability, marginalised.

        Parameters
        ----------
        unknown : str or None
            None for everything known.

        Notes
        -----
        S/N grows with the amplitude; the flare's own photon noise is left out.
        """
        (amplitude, costs), *_ = ((a, c) for (name, a), c in self.costs.items() if name == star)
        cost = next(iter(costs.values())) if unknown is None else costs[unknown]
        snr = cost.known if unknown is None else cost.marginal
        needed = special.ndtri(self.study.limit.power) - special.ndtri(self.study.run.fap)
        return float(amplitude * needed / snr) if snr > 0 else float("inf")

    @property
    def table(self) -> QTable:
        """One row per star, flare and unknown."""
        names = [column.name for column in COLUMNS]
        rows = [
            dict(zip(names, (star, amplitude, unknown, c.known, c.plain, c.marginal,
                             float(power(c.marginal, self.study.run.fap)), self.smallest(star, unknown)), strict=True))
            for (star, amplitude), costs in self.costs.items()
            for unknown, c in costs.items()
        ]  # fmt: skip
        return table_of(COLUMNS, rows, fap=self.study.run.fap, power=self.study.limit.power, study=self.study.toml())

    @property
    def views(self) -> list[View]:
        return [View("What unknowns cost: S/N of the matched statistic, by closed forms", COLUMNS, self.table)]

    @property
    def tables(self) -> dict[str, Table]:
        """The only table."""
        return {"unknowns": self.table}

    @property
    def messages(self) -> list[str]:
        return collect_messages(list(self.quiets))

    @property
    def inputs(self) -> list[Expectation]:
        return list(self.quiets)


def unknown_table(study: Study, unknowns: Mapping[str, NuisanceChoice] = SHOWN) -> UnknownAnswer:
    """Compute the S/N of a study's flares under each of several unknowns, which are given by name."""
    costs: dict[tuple[str, float], dict[str, Cost]] = {}
    quiets = []
    comparison = study.run.comparison()
    for case in cases(study, swept=False):
        quiets.append(case.quiet)
        for amplitude, flare in zip(case.amplitudes, case.flares, strict=True):
            costs[case.label, amplitude] = {
                unknown: unknown_cost(case.label, case.quiet, flare, choice, comparison)
                for unknown, choice in unknowns.items()
            }
    return UnknownAnswer(study, costs, tuple(quiets))


def power(snr: float | NDArray[np.float64], fap: float) -> NDArray[np.float64]:
    """Return the detection probability of a normal statistic with some S/N, shape of the S/N."""
    return np.asarray(special.ndtr(snr + special.ndtri(fap)))
