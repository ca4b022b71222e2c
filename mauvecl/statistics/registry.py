"""Registry of the statistics by name."""

from __future__ import annotations

from collections.abc import Sequence

from mauvecl.schema.errors import InputError
from mauvecl.statistics.chi2 import Chi2, Chi2Element, Chi2Pair
from mauvecl.statistics.linear import Linear, Matched, UvExcess
from mauvecl.statistics.names import check_statistic
from mauvecl.statistics.paper import Paper
from mauvecl.statistics.statistic import Statistic

#: All statistics in the order of tables and plots; add a new one here.
STATISTICS: dict[str, Statistic] = {
    one.name: one for one in (Chi2(), Chi2Element(), Chi2Pair(), Matched(), UvExcess(), Paper())
}


def statistics_by_name(asked: Sequence[str | Linear]) -> dict[str, Statistic]:
    """Return the requested statistics by name.

    `asked` holds names of `STATISTICS` and user-defined statistics. Raises InputError if it is empty, or a name is
    unknown or not unique.
    """
    named: dict[str, Statistic] = {}
    own: set[str] = set()
    for one in asked:
        if isinstance(one, str):
            check_statistic(one)
            named.setdefault(one, STATISTICS[one])
            continue
        if one.name in STATISTICS:
            raise InputError(
                f"statistic {one.name!r} is one of mauvecl's own", "another name", key="statistics", value=one.name
            )
        if one.name in own:
            raise InputError.of("statistics", one.name, "different names")
        own.add(one.name)
        named[one.name] = one
    if not named:
        raise InputError("no statistic named", f"some of {', '.join(STATISTICS)}", key="statistics")
    return named


def label(name: str) -> str:
    """Return the axis label of a statistic; that of a user-defined one is its name."""
    return STATISTICS[name].label if name in STATISTICS else name
