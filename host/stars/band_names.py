"""Names of photometric bands; `bands`, which holds the bands themselves, takes longer to import."""

from __future__ import annotations

from mauvecl.schema.errors import InputError

#: Aliases by band name.
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
    """Return the name of a band, given its name or alias in any case."""
    wanted = name.strip().casefold()
    for band, others in ALIASES.items():
        if wanted in (band.casefold(), *(other.casefold() for other in others)):
            return band
    raise InputError(f"band {name!r} is unknown", f"one of {', '.join(ALIASES)}", key="band")
