"""Names of statistics and nuisance parameters; `registry` and `nuisances`, which define them, take longer to import."""

from __future__ import annotations

from mauvecl.schema.errors import InputError

#: All statistics in the order of tables and plots.
STATISTIC_NAMES = ("chi2", "chi2_element", "chi2_pair", "matched", "uv_excess", "paper")
#: Statistics computed by default.
DEFAULT_STATISTICS = ("chi2", "chi2_element", "matched")
#: Nuisance parameters with built-in spectra, and the units of their amplitudes.
NUISANCES = {
    "dark": "detector temperature, deg C",
    "light": "throughput, pointing or the star's own level, relative",
    "sky": "brightness of the sky, relative",
    "tilt": "colour of the response, relative at 200 and 700 nm",
}


def check_statistic(name: str) -> None:
    """Raise InputError for an unknown statistic."""
    if name not in STATISTIC_NAMES:
        raise InputError(f"statistic {name!r} is unknown, expected one of {', '.join(STATISTIC_NAMES)}")
