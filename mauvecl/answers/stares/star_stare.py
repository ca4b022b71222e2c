"""A simulated stare at one star, with its flares and the result of its search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.answer import InCell
from mauvecl.flares.events import Event
from mauvecl.flares.frames import LightCurves, StareExpectation
from mauvecl.search.alarms import Alarm

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class StareFlare:
    """A flare of a stare, with its energies and S/N."""

    event: Event
    band_erg: float  # NaN if the star's size is unknown
    bolometric_erg: float  # likewise
    snr: float  # of the matched filter for this flare


@dataclass(frozen=True, eq=False)
class SearchResult:
    """Result of the search of a stare."""

    threshold: float  # from importance sampling of normal noise
    alarms: list[Alarm]  # in descending order of value
    bolometric_erg: tuple[float, ...]  # of each alarm's fit; NaN if the star's size is unknown
    # Number of the nearest flare of the stare within a half-width and two frames, from 1 on; 0 if there is none.
    events: tuple[int, ...]
    shifted: bool = False  # whether the threshold is raised for trends that the search does not remove


@dataclass(frozen=True, eq=False)
class FoundFlare:
    """A flare that a search found: its bolometric energy, erg, and the number of the nearest flare of the stare."""

    alarm: Alarm
    bolometric_erg: float
    event: int


@dataclass(frozen=True, eq=False)
class StarStare(InCell):
    """A stare at one star in one cell of the sweep; `search` is a message if no search is possible."""

    staring: StareExpectation
    flares: tuple[StareFlare, ...]
    light: LightCurves
    search: SearchResult | str | None = None
    # Share of all light that each frame lost in pointing drifts, shape (n_frame,); None unless drifts are drawn.
    pointing_loss: Float | None = None

    @property
    def found(self) -> list[FoundFlare]:
        """Flares that the search found."""
        one = self.search
        if not isinstance(one, SearchResult):
            return []
        return [FoundFlare(*parts) for parts in zip(one.alarms, one.bolometric_erg, one.events, strict=True)]
