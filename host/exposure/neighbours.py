"""Neighbouring stars, whose light enters the fibre together with the target's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.exposure.response import Order, electrons_per_second
from mauvecl.host.stars.library import embedded, known_band, library_table, nearest_spectrum
from mauvecl.host.stars.source import Source
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import Share

if TYPE_CHECKING:
    from mauvecl.host.instrument.instrument import Instrument

Float = NDArray[np.float64]

#: Distance up to which a row of a table may be the target itself, which a message then says, arcsec.
SAME_STAR_ARCSEC = 2.0
#: Largest number of neighbours that a message names.
MOST_NAMED = 4


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A star near the target; its spectrum is chosen only if its light enters the fibre."""

    name: str
    separation_arcsec: float  # from the target
    magnitude: float | None = None  # in `band`; None if unknown
    band: str = "V"  # as the table names it if its passband is unknown
    spectral_type: str = ""  # empty if unknown; the nearest spectrum of the library is used
    file: Path | None = None  # spectrum file, in place of a type
    temperature_k: float | None = None  # effective temperature, which chooses the spectrum if the type is unknown
    bp_rp: float | None = None  # Gaia colour, which chooses the spectrum if type and temperature are unknown

    @cached_property
    def spectrum(self) -> tuple[str, str]:
        """Name of the spectrum, and the statement on its choice, empty if it is the star's own.

        Raises InputError if nothing tells the spectrum.
        """
        if self.file is not None:
            return self.file.name, ""
        if self.spectral_type:
            entry = embedded(self.spectral_type)
            if entry is not None:
                return entry["name"], ""
            nearest = nearest_spectrum(self.spectral_type)
            return nearest, f"of type {self.spectral_type}: {nearest}, the nearest type of the library"
        if self.temperature_k is not None:
            wanted = self.temperature_k
            nearest, (kelvin, _) = min(_typical().items(), key=lambda item: abs(np.log(item[1][0] / wanted)))
            return nearest, f"of {wanted:.0f} K: {nearest} ({kelvin:.0f} K), the nearest of the library"
        if self.bp_rp is not None:
            wanted = self.bp_rp
            nearest, (_, colour) = min(_typical().items(), key=lambda item: abs(item[1][1] - wanted))
            return nearest, f"of BP - RP = {wanted:.2f}: {nearest} ({colour:.2f}), the nearest colour of the library"
        needed = "needs a spectral type, spectrum file, temperature or colour, since its light enters the fibre"
        raise InputError(f"{self._place} {needed}", key="neighbours")

    @property
    def _place(self) -> str:
        return f"neighbour {self.name}, {self.separation_arcsec:.3g} arcsec away"

    @cached_property
    def source(self) -> Source:
        """Spectrum at the telescope. Raises InputError if spectrum or magnitude is unknown."""
        name, _ = self.spectrum
        if self.magnitude is None and self.file is None:
            raise InputError(f"{self._place}, needs a magnitude, since its light enters the fibre", key="neighbours")
        star = Source.from_library(name) if self.file is None else Source.read(self.file)
        if self.magnitude is not None:
            try:
                star = star.at_magnitude(self.magnitude, known_band(self.band))
            except InputError as error:
                raise error.within(self._place) from error
        check_level(star, f"neighbour {self.name}", "neighbours")
        return star


def check_level(source: Source, name: str, key: str) -> None:
    """Raise InputError, which calls a star by `name`, if its spectrum is not as bright as the star is seen."""
    if source.unscaled:
        fault = f"the spectrum of {name} is not as bright as the star is seen: {source.unscaled}"
        raise InputError(f"{fault}; give a magnitude as well", key=key)


@validated
@dataclass(frozen=True, eq=False)
class Neighbours:
    """Neighbours of one target."""

    stars: tuple[Neighbour, ...]
    share: Share = 1.0  # share of the light that enters the fibre, of stars within its radius; an assumption
    notes: tuple[str, ...] = ()  # statements on how the table was read

    def within(self, instrument: Instrument) -> list[Neighbour]:
        """Return the neighbours within the radius of the fibre."""
        return [star for star in self.stars if star.separation_arcsec <= instrument.field_of_view_radius_arcsec]

    def electrons_per_second(self, instrument: Instrument, order: Order = "paper") -> Float:
        """Return the mean electrons per second of all neighbours in the fibre, shape (n_pixel,)."""
        rates = (self.share * rate_of(neighbour, instrument, order) for neighbour in self.within(instrument))
        return sum(rates, np.zeros(instrument.wavelength_nm.size))

    def provenance(self, instrument: Instrument) -> dict[str, str]:
        """Return the neighbours in the fibre with their spectra, for the record of an expectation."""
        inside = [
            f"{star.name} ({star.separation_arcsec:.6g} arcsec, {star.spectrum[0]}, {star.source.digest})"
            for star in self.within(instrument)
        ]
        return {"neighbours": "; ".join(inside), "share of neighbours": f"{self.share:g} (assumption)"}

    def messages(self, target: str, instrument: Instrument) -> list[str]:
        """Return the messages on the neighbours of a target."""
        radius, inside = instrument.field_of_view_radius_arcsec, self.within(instrument)
        outside = len(self.stars) - len(inside)
        beyond = f"{_stars(outside)} beyond {'does' if outside == 1 else 'do'} not enter"
        if not inside:
            return [f"NEIGHBOURS of {target}: none within {radius:g} arcsec; {beyond}.", *self.notes]
        named = [f"{star.name} at {star.separation_arcsec:.3g} arcsec" for star in inside[:MOST_NAMED]]
        more = len(inside) - MOST_NAMED
        text = (
            f"NEIGHBOURS of {target}: the light of {_stars(len(inside))} within {radius:g} arcsec is in the fibre "
            f"({', '.join(named)}{f' and {more} more' if more > 0 else ''}); assumption: {100 * self.share:g} % of it "
            "enters"
        )
        chosen = [f"Light of {star.name}, {star.spectrum[1]}." for star in inside if star.spectrum[1]]
        if len(chosen) > MOST_NAMED:
            chosen = [*chosen[:MOST_NAMED], f"Spectra of {len(chosen) - MOST_NAMED} more neighbours are chosen alike."]
        same = [
            f"{star.name} is {star.separation_arcsec:.2g} arcsec from {target} and counts as a neighbour: if it is the "
            "star itself, name its row in star.neighbours_of."
            for star in inside
            if star.separation_arcsec < SAME_STAR_ARCSEC
        ]
        return [f"{text}; {beyond}." if outside else f"{text}.", *same, *chosen, *self.notes]


#: Cached since flares and sweep values of a star have the same neighbours.
@lru_cache(maxsize=4096)
def rate_of(neighbour: Neighbour, instrument: Instrument, order: Order) -> Float:
    """Return the mean electrons per second of a neighbour if all of its light enters, shape (n_pixel,)."""
    source = neighbour.source
    rate = electrons_per_second(instrument, source.wavelength_nm, source.flux_flam, order)
    rate = np.maximum(rate * instrument.per_pixel("response", 1.0), 0.0)
    rate.setflags(write=False)
    return rate


def _stars(n: int) -> str:
    return "1 star" if n == 1 else f"{n} stars"


@cache
def _typical() -> dict[str, tuple[float, float]]:
    """Return temperature and synthetic Gaia colour BP - RP of the embedded spectra that represent a spectral type."""
    rows = [row for row in library_table() if row["kept"] == "embedded" and row["name"] == row["spectral_type"]]
    stars = [Source.from_library(str(row["name"])) for row in rows]
    colours = [star.magnitude("Gaia BP") - star.magnitude("Gaia RP") for star in stars]
    return {star.name: (star.temperature_k or np.nan, colour) for star, colour in zip(stars, colours, strict=True)}
