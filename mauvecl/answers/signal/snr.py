"""Signal-to-noise ratios of a study's stars in each cell of the sweep: distributions and noise budgets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

from mauvecl.answers.answer import Answer, InCell
from mauvecl.answers.progress import reported
from mauvecl.answers.signal.exposures import Per, place_of
from mauvecl.detection.snr import COLUMNS
from mauvecl.device.engine import Engine
from mauvecl.host.exposure.expectation import BUDGET_COLUMNS
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.calls import validated
from mauvecl.schema.tables import View, stacked
from mauvecl.study.cases import Case, cases
from mauvecl.study.labels import place_columns
from mauvecl.study.messages import collect_messages
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.detection.snr import SnrResult
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.assumptions import Use


#: Wavelengths of the elements that terminal and pictures show, nm; the tables hold all of them.
SHOWN_NM = (250.0, 300.0, 400.0, 550.0)


@dataclass(frozen=True, eq=False)
class StarSnr(InCell):
    """A star in a cell of the sweep."""

    result: SnrResult
    asked_nm: float | None = None

    @property
    def shown_nm(self) -> list[float]:
        """The requested wavelength, or those of `SHOWN_NM` within the spectrum."""
        if self.asked_nm is not None:
            return [self.asked_nm]
        first, last = self.result.expectation.wavelength_nm[[0, -1]]
        return [wavelength for wavelength in SHOWN_NM if first <= wavelength <= last]


@dataclass(eq=False)
class SnrAnswer(Answer):
    """The answer of `mauvecl snr`."""

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "processes", "seed")
    JSON = MappingProxyType({"snr-element": "element", "noise-budget": "noise_budget"})

    study: Study
    stars: list[StarSnr]  # one per star and cell of the sweep
    messages: list[str]

    @property
    def pixel(self) -> QTable:
        """S/N per pixel, one row per star, cell and pixel."""
        return self.together(lambda result: result.pixel)

    @property
    def element(self) -> QTable:
        """S/N per resolution element of 10.5 nm, one row per star, cell and element."""
        return self.together(lambda result: result.element)

    @property
    def noise_budget(self) -> QTable:
        """Noise by origin, DN rms per pixel, one row per star, cell and pixel."""
        return self.together(lambda result: result.expectation.noise_budget())

    @property
    def tables(self) -> dict[str, Table]:
        """S/N per element and per pixel, and the noise by origin."""
        return {"snr-element": self.element, "snr-pixel": self.pixel, "noise-budget": self.noise_budget}

    @property
    def inputs(self) -> list[Expectation]:
        return [star.result.expectation for star in self.stars]

    @property
    def views(self) -> list[View]:
        """S/N and noise at some wavelengths; all of them are in the files."""
        place = place_columns(self.study.sweep)

        def at(star: StarSnr, per: Per) -> list[int]:
            return [place_of(star.result.expectation, nm, per) for nm in star.shown_nm]

        parts = [(star, star.result.element[at(star, "element")]) for star in self.stars]
        budgets = [(star, star.result.expectation.noise_budget()[at(star, "pixel")]) for star in self.stars]
        noise = stacked(place, budgets)
        sources = [one for one in BUDGET_COLUMNS if one.name in noise.colnames]
        return [
            View("S/N per 10.5 nm element; all of them in the files", (*place, *COLUMNS), stacked(place, parts)),
            View("Noise of a pixel by origin, DN rms", (*place, *sources), noise),
        ]

    def together(self, table_of: Callable[[SnrResult], QTable]) -> QTable:
        """Stack the tables of all stars and cells, with columns of the star and the swept values."""
        parts = ((star, table_of(star.result)) for star in self.stars)
        run = self.study.run
        return stacked(place_columns(self.study.sweep), parts, realisations=run.realisations, study=self.study.text())


@validated
def snr(
    study: Study, engine: Engine | Pool | None = None, progress: Callable[[int, int], None] | None = None
) -> SnrAnswer:
    """Simulate the S/N of every star of a study without flares, for every sweep value.

    Parameters
    ----------
    study : Study
    engine : Engine or Pool, optional
    progress : callable, optional
        Called as ``progress(done, total)`` in stars.
    """
    # Invalid input raises an error before anything is drawn.
    prepared, run, asked = cases(study), study.run, study.signal.wavelength_nm
    quiet = [case.quiet for case in prepared]
    if asked is not None:
        for x in quiet:
            place_of(x, asked, "element")

    engine = engine or Engine()

    def answered(case: Case) -> StarSnr:
        result = engine.snr(case.quiet, realisations=run.realisations, seed=run.seed, **case.draw_options)
        return StarSnr(case.label, case.at, result, asked)

    if isinstance(engine, Pool):
        engine.expect(len(prepared) * run.realisations)
    stars = list(reported(map_in_order(engine, answered, prepared), len(prepared), progress))
    return SnrAnswer(
        study,
        stars,
        [
            *collect_messages(quiet, study.processes),
            *filter(None, map(_cut_off, stars)),
        ],
    )


def _cut_off(star: StarSnr) -> str:
    """Return a message on pixels that saturated in the simulation, or an empty text."""
    result = star.result
    cut = result.counts.clipped[:, 1]
    clipped = cut[cut > 0]
    if not clipped.size:
        return ""
    share = 100 * clipped.mean() / (result.counts.n * result.expectation.n_frames)
    return (
        f"{star.title}: saturation cut off {clipped.size} of {cut.size} pixels in the simulation, each of them in "
        f"{share:.3g} % of its frames on average."
    )
