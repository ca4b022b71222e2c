"""Flares of neighbours that would look like an observed event."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mauvecl.host.stars.flare import check_scales
from mauvecl.schema.errors import InputError
from mauvecl.schema.tables import Column, number, percent

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source
    from mauvecl.observations.events import ObservedEvent
    from mauvecl.study.cases import Case


@dataclass(frozen=True, eq=False)
class BlendedStar:
    """A star in the fibre: the target itself, or a neighbour within the fibre's radius."""

    name: str
    separation_arcsec: float
    rise: float  # rise of all stars' light by a flare of unit amplitude on this star, relative to their light

    def amplitude(self, event: ObservedEvent) -> float:
        """Return the amplitude of a flare on this star that raises the light as much as an event."""
        return event.amplitude / self.rise if self.rise else float("inf")


def blended_stars(cases: Sequence[Case]) -> list[BlendedStar]:
    """Return the stars in the fibre of the observed star, itself first; raises InputError for several cases."""
    if len(cases) != 1:
        raise InputError(
            f"neighbours of observed frames with {len(cases)} stars",
            "the star that was observed, such as `star=G2V` with its magnitude",
            key="star",
            value=[case.star.library or str(case.star.file) for case in cases],
        )
    (case,) = cases
    check_scales(case.study.flare.light())
    near, quiet = case.neighbours, case.quiet
    assert near is not None
    total = float((quiet.source_electrons + quiet.neighbour_electrons).sum())
    stars = [BlendedStar(case.label, 0.0, _electrons(case, case.source) / total)]
    for one in near.within(case.instrument):
        rise = near.share * _electrons(case, one.source) / total
        stars.append(BlendedStar(one.name, one.separation_arcsec, rise))
    return stars


def _electrons(case: Case, source: Source) -> float:
    """Return the electrons per frame that a flare of unit amplitude adds to a star if all of its light enters."""
    f = case.study.flare
    flaring = source.flaring(1.0, spectrum=f.light(), band=f.band)
    with_it, without = case.expect(flaring, source)
    return float((with_it.source_electrons - without.source_electrons).sum())


@dataclass(frozen=True, eq=False)
class NeighbourFlare:
    """A flare on a star in the fibre that would look like an observed event."""

    date: str  # of the brightest frame of the event
    event: ObservedEvent
    star: BlendedStar

    @property
    def amplitude(self) -> float:
        """Rise of this star alone."""
        return self.star.amplitude(self.event)

    @property
    def equivalent_duration_s(self) -> float:
        """Equivalent duration of the flare."""
        return self.event.equivalent_duration_s / self.event.amplitude * self.amplitude


#: Columns of the table.
COLUMNS = (
    Column("date", "date", "", "of the brightest frame of the event", "event at", lambda text: text[:22], kind=str),
    Column("ampl_rec", "event.amplitude", "", "largest rise of the light of all stars", "rise of all light",
           percent(".3g")),
    Column("star", "star.name", "", "star on which the flare would be", "star", kind=str),
    Column("separation", "star.separation_arcsec", "arcsec", "from the observed star", "arcsec", ".4g"),
    Column("amplitude", "amplitude", "", "rise of this star alone, in the flare's band, at the brightest frame, for a "
           "flare that looks like the event", "flare of the star", percent(".4g")),
    Column("equivalent_duration", "equivalent_duration_s", "s", "of that flare, in the flare's band", "ED (s)",
           number(".4g")),
)  # fmt: skip
