"""Names of the statistics, and of what they are marginalised over, for whoever asks for some.

`registry` and `nuisances` have what is behind them, and take longer to load.
"""

from __future__ import annotations

from mauvecl.host.errors import InputError

#: In the order of tables and pictures.
STATISTIC_NAMES = ("chi2", "chi2_element", "chi2_pair", "matched", "uv_excess", "paper")
#: Computed where nobody names any.
USUAL_STATISTICS = ("chi2", "chi2_element", "matched")
#: Spectra of the unknowns that a setting brings along, and the unit of their amplitudes.
NUISANCES = {
    "dark": "detector temperature, deg C",
    "light": "throughput, pointing or the star's own level, relative",
    "sky": "brightness of the sky, relative",
    "tilt": "colour of the response, relative at 200 and 700 nm",
}


def check_statistic(name: str) -> None:
    """Refuse what is no statistic's name.

    Raises
    ------
    InputError
        With the names that there are.
    """
    if name not in STATISTIC_NAMES:
        raise InputError(f"statistic {name!r} is unknown, expected one of {', '.join(STATISTIC_NAMES)}")
