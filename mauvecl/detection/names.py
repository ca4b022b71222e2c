"""Names of statistics; `requests`, which defines them, takes longer to import."""

from __future__ import annotations

from mauvecl.schema.errors import InputError

#: All statistics in the order of tables and plots.
STATISTIC_NAMES = ("chi2", "chi2_element", "chi2_pair", "matched", "uv_excess", "paper")
#: Statistics computed by default.
DEFAULT_STATISTICS = ("chi2", "chi2_element", "matched")


def check_statistic(name: str) -> None:
    """Raise InputError for an unknown statistic."""
    if name not in STATISTIC_NAMES:
        raise InputError.of("statistic", name, f"one of {', '.join(STATISTIC_NAMES)}")
