"""Names of stars in studies, and suggestions for well-known stars without a library spectrum."""

from __future__ import annotations

from collections.abc import Mapping

from mauvecl.schema.errors import InputError


def has_spectrum(name: str) -> bool:
    """Return whether a spectrum of the library or of the user has this name."""
    from mauvecl.host.stars import catalogue, own_stars

    return catalogue.embedded(name) is not None or own_stars.find(name) is not None


def well_known(name: str) -> Mapping[str, str] | None:
    """Return the row of a star in the embedded list of well-known stars, or None."""
    from mauvecl.host.orbit.star_list import name_key, rows_by_name

    return rows_by_name().get(name_key(name))


def check_spectrum(name: str) -> None:
    """Raise InputError if a name has no spectrum; for well-known stars, the message suggests one."""
    if has_spectrum(name):
        return
    from mauvecl.host.stars import catalogue

    row = well_known(name)
    if row is None:
        catalogue.find(name)
        return
    from mauvecl.host.stars.spectral_types import nearest_spectrum

    raise InputError(
        f"star {name!r} has no spectrum of its own in the library",
        f"that of the nearest type and its V: `star={nearest_spectrum(row['spectral_type'])!r}` with "
        f"`magnitude={float(row['V']):g}` ({row['name']} is of type {row['spectral_type']}, "
        f"{float(row['distance']):g} pc away; {row['source']})",
        key="star",
        value=name,
    )
