"""Changes of a limit with assumptions about the instrument."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from mauvecl.answers.limits.search import LimitSearch, single_flares
from mauvecl.noise.disturbances import Uniform
from mauvecl.noise.unknowns import values_of
from mauvecl.schema.calls import validated
from mauvecl.schema.tables import Column, table_of
from mauvecl.study.cases import Case, cases
from mauvecl.study.labels import amplitude_column, star_column
from mauvecl.study.quantities import QUANTITIES
from mauvecl.study.sections import Unknowns
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from collections.abc import Mapping

    from astropy.table import QTable

    from mauvecl.host.instrument.instrument import Instrument


@dataclass(frozen=True)
class Assumption:
    """Uncertain value of the payload with both ends of its range (documentation: what is nominal)."""

    name: str
    ends: tuple[str, str]
    changes: tuple[Mapping[str, Any], Mapping[str, Any]]


def assumptions(nominal: Instrument) -> tuple[Assumption, ...]:
    """Return the uncertain values of the payload and their ranges; normal priors extend to one standard deviation."""
    rows = []
    values = values_of(nominal)
    for name, prior in Unknowns().priors(nominal).items():
        ends = (prior.low, prior.high) if isinstance(prior, Uniform) else (prior.mean - prior.sd, prior.mean + prior.sd)
        value = values[name]
        low, high = (value.changes(nominal, float(f"{end:.12g}")) for end in ends)
        rows.append(Assumption(value.label, (f"{ends[0]:g}", f"{ends[1]:g}"), (low, high)))
    dark = Assumption(
        "dark counts are Poisson in", ("DN", "electrons"), ({"dark_unit": "DN"}, {"dark_unit": "electrons"})
    )
    return (*rows, dark)


@dataclass(frozen=True)
class Moved:
    """Limit with one assumption at both ends of its range."""

    star: str
    amplitude: float
    statistic: str
    assumption: Assumption
    nominal: float
    at_ends: tuple[float, float]

    @property
    def span(self) -> float:
        """Difference between the ends."""
        return abs(self.at_ends[1] - self.at_ends[0])


@validated
def what_matters(study: Study) -> QTable:
    """Compute the closed-form limits of a study with each assumption at both ends of its range.

    Returns
    -------
    QTable
        One row per star, flare, statistic and assumption; for each limit, the assumption that changes it most first.
    """
    rows: list[Moved] = []
    for case in cases(study, swept=False):
        for one in single_flares(case):
            for statistic in study.run.statistics:
                rows += sorted(_moves(one, statistic), key=lambda m: -m.span)
    columns = assumption_columns(study.limit.of)
    table = table_of(columns, rows, power=study.limit.power, fap=study.run.fap, study=study.text())
    for column in columns:
        if column.format == LIMIT:
            table[column.name].info.format = LIMIT
    return table


#: Format of limits.
LIMIT = ".3f"


def assumption_columns(of: str) -> tuple[Column, ...]:
    """Return the columns of the table of assumptions, for limits of a quantity."""
    return (
        star_column(),
        *(() if of == "amplitude" else (amplitude_column(),)),
        Column("statistic", description="detection statistic", heading="statistic"),
        Column("assumption", "assumption.name", "", "what is assumed of the instrument", "assumption"),
        Column("low_end", lambda row: row.assumption.ends[0], "", "lower end of its sensible range", "from"),
        Column("high_end", lambda row: row.assumption.ends[1], "", "upper end of its sensible range", "to"),
        Column(of, "nominal", description=QUANTITIES[of].description, format=LIMIT),
        Column("at_low_end", lambda row: row.at_ends[0], "", "closed-form limit with the assumption at its lower end",
               "limit from", LIMIT),
        Column("at_high_end", lambda row: row.at_ends[1], "", "closed-form limit with the assumption at its upper end",
               "to", LIMIT),
        Column("span", "", "", f"how far the closed-form limit of {of} moves from end to end", "moves by", LIMIT),
    )  # fmt: skip


def _moves(case: Case, statistic: str) -> list[Moved]:
    """Return the change of a limit with each assumption."""
    nominal = LimitSearch(case, statistic).root()
    moves = []
    for assumption in assumptions(case.instrument):
        ends = [
            LimitSearch(replace(case, study=case.study.with_instrument(change)), statistic).root(near=nominal)
            for change in assumption.changes
        ]
        moves.append(
            Moved(
                star=case.star.library or str(case.star.file),
                amplitude=float("nan") if case.study.limit.of == "amplitude" else case.amplitudes[0],
                statistic=statistic,
                assumption=assumption,
                nominal=nominal,
                at_ends=(ends[0], ends[1]),
            )
        )
    return moves
