"""Stars by any of their names: spectra of the library, the user's own, and the list of well-known stars."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from mauvecl.schema.errors import InputError

from . import catalogue, own_stars, well_known
from .model_stars import EXAMPLES, ModelStar
from .spectral_types import as_type, nearest_spectrum
from .well_known import WellKnown, name_key


@dataclass(frozen=True)
class NamedStar:
    """Star or spectral type that was found by name."""

    name: str
    spectrum: str | None  # name of its own spectrum, in the library or among the user's
    known: WellKnown | None  # its entry in the list of well-known stars

    @property
    def nearest(self) -> str:
        """Library spectrum that represents it: its own, or that of the nearest type."""
        if self.spectrum is not None:
            return self.spectrum
        return nearest_spectrum(self.name if self.known is None else self.known.spectral_type)


def resolve(text: str, *, own: bool = True) -> NamedStar | None:
    """Find a star or spectral type by any name, in any case and spacing, or return None.

    Parameters
    ----------
    text : str
        A name of the library ("M3V", short "M3"), a star ("GJ 581", "Proxima", "HD 1835"), any other spectral type, or
        a formula ("blackbody 9000 K", "power law -2").
    own : bool
        Whether to search among the user's own stars.
    """
    model = ModelStar.named(text)
    if model is not None:
        return NamedStar(model.name, model.name, None)
    entry, known = catalogue.embedded(text), well_known.by_key().get(name_key(text))
    if entry is None and known is not None:
        # The library has the star under another of its names.
        entries = (catalogue.embedded(name) for name in (known.name, *known.others))
        entry = next((one for one in entries if one is not None), None)
    mine = own_stars.find(text) if own and entry is None else None
    spectrum = entry["name"] if entry is not None else None if mine is None else mine.name
    if known is not None:
        return NamedStar(known.name, spectrum, known)
    if spectrum is not None:
        return NamedStar(spectrum, spectrum, None)
    spectral_type = as_type(text)
    return None if spectral_type is None else NamedStar(spectral_type, None, None)


def spectrum_name(text: str, key: str = "star", *, own: bool = True) -> str:
    """Return the name of the spectrum of a star.

    Raises InputError if the star has no spectrum; the message proposes one and, for a well-known star, its magnitude.

    Parameters
    ----------
    key : str
        Key of the error.
    own : bool
        Whether to search among the user's own stars.
    """
    star = resolve(text, own=own)
    if star is None:
        raise InputError(
            f"star {text.strip()!r} is unknown", f"a name such as {', '.join(near_names(text))}", key=key, value=text
        )
    if star.spectrum is not None:
        return star.spectrum
    proposed = f"`{key}={star.nearest!r}`"
    if star.known is None:
        raise InputError(
            f"spectral type {text.strip()!r} has no spectrum in the library",
            f"the nearest, {proposed}, or a name such as {', '.join(near_names(text))}",
            key=key,
            value=text,
        )
    raise InputError(
        f"star {text.strip()!r} has no spectrum in the library",
        f"that of the nearest type and its V: {proposed} with `magnitude={star.known.magnitude:g}` "
        f"({star.name}: {star.known.about})",
        key=key,
        value=text,
    )


def all_names() -> list[str]:
    """Return the names of all embedded spectra and well-known stars, without designations, and of two formulas."""
    return list(dict.fromkeys([*catalogue.names(), *EXAMPLES, *(star.name for star in well_known.stars())]))


def near_names(text: str, *, stars_only: bool = False) -> list[str]:
    """Return up to four known names that resemble a text, or a few examples.

    Parameters
    ----------
    stars_only : bool
        Whether names must be of stars with known coordinates.
    """
    known = {key: star.name for key, star in well_known.by_key().items()}
    if not stars_only:
        known |= {name_key(name): name for name in catalogue.names()}
        known |= {name_key(star.name): star.name for star in own_stars.kept()}
    near = difflib.get_close_matches(name_key(text), known, n=4, cutoff=0.5)
    return list(dict.fromkeys(known[one] for one in near)) or ["eps Eri", "AU Mic"] + ["G2V"] * (not stars_only)
