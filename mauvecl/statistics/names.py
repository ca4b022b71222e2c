"""Names of the statistics, for whoever asks for some; `registry` has what is behind them, and takes longer to load."""

from __future__ import annotations

from mauvecl.host.errors import InputError

#: In the order of tables and pictures.
STATISTIC_NAMES = ("chi2", "chi2_element", "chi2_pair", "matched", "uv_excess", "paper")
#: Computed where nobody names any.
USUAL_STATISTICS = ("chi2", "chi2_element", "matched")


def check_statistic(name: str) -> None:
    """Refuse what is no statistic's name.

    Raises
    ------
    InputError
        With the names that there are.
    """
    if name not in STATISTIC_NAMES:
        raise InputError(f"statistic {name!r} is unknown, expected one of {', '.join(STATISTIC_NAMES)}")
