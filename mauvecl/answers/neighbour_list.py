"""Table of the neighbours of an answer's stars: which of them enter the fibre, and how much light they add."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mauvecl.host.exposure.star import Neighbour, rate_of
from mauvecl.schema.tables import Column, percent, table_of

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.study.cases import Case


@dataclass(frozen=True, eq=False)
class NeighbourRow:
    """A neighbour of a case's star."""

    case: Case
    star: str
    neighbour: Neighbour

    @property
    def enters(self) -> bool:
        """True if the neighbour is within the fibre's radius."""
        return self.neighbour.separation_arcsec <= self.case.instrument.field_of_view_radius_arcsec

    @property
    def spectrum(self) -> str:
        """Spectrum that represents the neighbour; empty beyond the fibre, where none is needed."""
        return self.neighbour.spectrum[0] if self.enters else ""

    @property
    def share(self) -> float:
        """Share of the electrons of all stars in the fibre."""
        if not self.enters:
            return 0.0
        x, near = self.case.quiet, self.case.neighbours
        assert near is not None
        rate = rate_of(self.neighbour, self.case.instrument, self.case.study.observation.order)
        own = near.share * float(rate.sum()) * x.frame_s
        return own / float((x.source_electrons + x.neighbour_electrons).sum())


#: Columns of the table of neighbours.
COLUMNS = (
    Column("star", description="star that is observed", heading="star", kind=str),
    Column("name", "neighbour.name", description="neighbour", heading="neighbour", kind=str),
    Column("separation", "neighbour.separation_arcsec", "arcsec", "from the star", "arcsec", ".4g"),
    Column("magnitude", lambda row: float("nan") if row.neighbour.magnitude is None else row.neighbour.magnitude,
           "mag", "in the band", "magnitude", ".2f"),
    Column("band", "neighbour.band", heading="band", kind=str),
    Column("spectrum", description="spectrum that represents it; empty if its light does not enter",
           heading="spectrum", kind=str),
    Column("enters", description="whether it is within the fibre's radius, so that the assumed share of its light "
           "enters", heading="enters", format=lambda value: "yes" if value else "no", kind=bool),
    Column("share", description="share of the electrons of all stars in the fibre, without a flare",
           heading="of all stars", format=percent(".3g")),
)  # fmt: skip


def neighbour_table(cases: Iterable[Case], **meta: object) -> QTable | None:
    """Return the table of the neighbours of several stars, or None if no star has any."""
    rows = [
        NeighbourRow(case, case.label, one)
        for case in cases
        if case.neighbours is not None
        for one in case.neighbours.stars
    ]
    if not rows:
        return None
    shares = sorted({row.case.star.neighbour_share for row in rows})
    return table_of(COLUMNS, rows, assumed_share=shares[0] if len(shares) == 1 else shares, **meta)


def share_columns(has_neighbours: bool, get: str | Callable[[Any], Any]) -> tuple[Column, ...]:
    """Return the column of the dilution, or nothing without neighbours; `get` returns it from a row."""
    text = "share of the star in the electrons of all stars in the fibre, without a flare (dilution)"
    return (Column("target_share", get, "", text, "star's share", percent(".3g")),) if has_neighbours else ()
