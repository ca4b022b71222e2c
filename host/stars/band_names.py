"""Names of photometric bands, for whoever asks for one; `bands` has what is behind them, and takes longer to load."""

from __future__ import annotations

from ..errors import InputError

#: Band names and what else they answer to.
ALIASES = {
    "B": ("Johnson B",),
    "V": ("Johnson V",),
    "Kepler": ("Kp", "Kepler Kp"),
    "TESS": ("T",),
    "Gaia G": ("G", "Gaia DR2 G"),
    "Gaia BP": ("BP", "Gaia DR2 BP"),
    "Gaia RP": ("RP", "Gaia DR2 RP"),
    "GALEX NUV": ("NUV",),
    "GALEX NUV Vega": ("NUV Vega",),
}


def known_band(name: str) -> str:
    """A band's own name, by name or alias.

    Raises
    ------
    InputError
        If there is none of that name.
    """
    wanted = name.strip().casefold()
    for known, others in ALIASES.items():
        if wanted in (known.casefold(), *(other.casefold() for other in others)):
            return known
    raise InputError(f"band {name!r} is unknown, expected one of {', '.join(ALIASES)}")
