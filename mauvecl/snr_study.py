"""Signal to noise of a study's stars, over whatever the study sweeps: distributions and noise budgets."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mauvecl.labels import described, label, put_first, titled, told
from mauvecl.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.engine import Engine
    from mauvecl.snr import SnrResult


@dataclass(frozen=True, eq=False)
class StarSnr:
    """One star in one cell of the sweep."""

    label: str
    at: Mapping[str, float | str]
    result: SnrResult

    @property
    def title(self) -> str:
        """The star and what is swept, for pictures."""
        return titled(self.label, self.at)


@dataclass(eq=False)
class SnrAnswer:
    """What `mauvecl snr` answers.

    Attributes
    ----------
    study : Study
    stars : list of StarSnr
        Every star in every cell of the sweep.
    messages : list of str
    """

    study: Study
    stars: list[StarSnr]
    messages: list[str]

    @property
    def pixel(self) -> QTable:
        """S/N per pixel, one row per star, cell and pixel."""
        return self._together(lambda result: result.pixel)

    @property
    def element(self) -> QTable:
        """S/N per resolution element of 10.5 nm, one row per star, cell and element."""
        return self._together(lambda result: result.element)

    @property
    def noise_budget(self) -> QTable:
        """Noise by origin, DN rms per pixel, one row per star, cell and pixel."""
        return self._together(lambda result: result.expectation.noise_budget())

    def _together(self, table_of: Callable[[SnrResult], QTable]) -> QTable:
        from astropy.table import vstack

        parts = []
        for star in self.stars:
            table = table_of(star.result)
            table.meta = {}
            put_first(table, {"star": star.label, **star.at})
            parts.append(table)
        found = vstack(parts)
        found.meta |= {"realisations": self.study.run.realisations, "study": self.study.toml()}
        return described(found)


def snr(study: Study, engine: Engine) -> SnrAnswer:
    """S/N distributions of every star of a study, without flares, in every cell of its sweep.

    Raises
    ------
    InputError
        For anything in the study that cannot be.
    """
    # Everything is looked at before anything is drawn: bad input shows at once.
    prepared = [
        (label(star, x), at, x)
        for at, cell in study.cells()
        for star in cell.star
        for x in cell.expect([star.source()])
    ]
    run = study.run
    stars = [
        StarSnr(name, at, engine.snr(x, realisations=run.realisations, seed=run.seed, **study.drawing))
        for name, at, x in prepared
    ]
    return SnrAnswer(study, stars, told([x for _, _, x in prepared]))
