"""Names of stars in studies: spectra of the library, and what stands for well-known stars that have none there."""

from __future__ import annotations

from mauvecl.host.errors import InputError


def has_spectrum(name: str) -> bool:
    """Return whether the library, or a star that the user keeps, has that name."""
    from mauvecl.host.stars import catalogue, own_stars

    return catalogue.embedded(name) is not None or own_stars.find(name) is not None


def check_spectrum(name: str) -> None:
    """Raise InputError if a name has no spectrum; for a well-known star the message says which one stands for it."""
    if has_spectrum(name):
        return
    from mauvecl.host.orbit.targets import known_target
    from mauvecl.host.stars import catalogue
    from mauvecl.study.spectral_types import nearest_spectrum

    star = known_target(name)
    if star is None or star.spectral_type is None:
        catalogue.find(name)
        return
    raise InputError(
        f"star {name!r} has no spectrum of its own in the library, expected that of the nearest type and its V: "
        f"`star={nearest_spectrum(star.spectral_type)!r}` with `magnitude={star.magnitude:g}` ({star.name} is of type "
        f"{star.spectral_type}, {star.distance_pc:g} pc away; {star.source})",
        key="star",
        value=name,
    )
