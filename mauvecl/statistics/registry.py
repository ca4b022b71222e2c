"""Every statistic by its name; a new one is added here."""

from __future__ import annotations

from collections.abc import Sequence

from mauvecl.host.errors import InputError
from mauvecl.statistics.chi2 import Chi2, Chi2Element, Chi2Pair
from mauvecl.statistics.linear import Linear, Matched, UvExcess
from mauvecl.statistics.names import check_statistic
from mauvecl.statistics.paper import Paper
from mauvecl.statistics.statistic import Statistic

#: In the order of tables and pictures.
STATISTICS: dict[str, Statistic] = {
    one.name: one for one in (Chi2(), Chi2Element(), Chi2Pair(), Matched(), UvExcess(), Paper())
}


def chosen(asked: Sequence[str | Linear]) -> dict[str, Statistic]:
    """The statistics asked for, by name, each once.

    Parameters
    ----------
    asked : sequence of str or Linear
        Names of `STATISTICS`, and statistics of one's own.

    Raises
    ------
    InputError
        If none is asked for, a name is unknown, or one's own has the name of another.
    """
    named: dict[str, Statistic] = {}
    own: set[str] = set()
    for one in asked:
        if isinstance(one, str):
            check_statistic(one)
            named.setdefault(one, STATISTICS[one])
            continue
        if one.name in STATISTICS:
            raise InputError(f"statistic {one.name!r} is one of mauvecl's own, expected another name")
        if one.name in own:
            raise InputError(f"statistic {one.name!r} is given twice, expected different names")
        own.add(one.name)
        named[one.name] = one
    if not named:
        raise InputError(f"no statistic named, expected some of {', '.join(STATISTICS)}")
    return named


def label(name: str) -> str:
    """What the axis of a statistic's values is called; one's own go by their names."""
    return STATISTICS[name].label if name in STATISTICS else name
