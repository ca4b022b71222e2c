"""Smallest detectable changes of stars between visits, line indices, and periods that are recovered."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.answer import Answer, InCell
from mauvecl.answers.progress import reported
from mauvecl.host.orbit.visibility import Visibility
from mauvecl.observations.changes.indices import INDICES, Change, IndexValue, covered_indices, flux_per_dn
from mauvecl.observations.changes.periods import Recovery, recover_periods, visit_times_d
from mauvecl.observations.changes.smallest import Smallest, error_of_change, error_of_index, pixels_of, smallest_change
from mauvecl.schema.calls import validated
from mauvecl.schema.tables import Column, View, number, percent, table_of
from mauvecl.study.cases import Case, cases
from mauvecl.study.labels import place_columns
from mauvecl.study.messages import collect_messages
from mauvecl.study.orbits import targets_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from astropy.table import QTable, Table

    from mauvecl.device.engine import Engine
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.stars.source import Source
    from mauvecl.runs.pool import Pool
    from mauvecl.study.assumptions import Use
    from mauvecl.study.study import Study

#: Magnitudes around that of the star at which changes are computed.
MAGNITUDES = np.arange(-4.0, 4.01, 0.5)
#: Semi-amplitudes of the map of periods, in standard errors of a visit.
AMPLITUDES = (0.4, 4.0)


@dataclass(frozen=True, eq=False)
class ChangeRow(InCell):
    """One change of one star."""

    change: Change
    # error, error_known: standard error of one visit, with unknowns marginalised over and with everything known.
    error: float
    error_known: float
    smallest: Smallest  # in the unit of the change
    magnitude: float | None  # of the star
    saturated: tuple[int, int]  # pixels near saturation, and all that the change concerns

    @property
    def hidden(self) -> bool:
        """Whether what is unknown hides the change."""
        return bool(np.isinf(self.error) and np.isfinite(self.error_known))

    @property
    def note(self) -> str:
        """What limits the row, in a few words."""
        lost, every = self.saturated
        notes = [_lost_pixels(lost, every)] if lost else []
        if not every:
            notes.append("no light")
        if self.hidden:
            notes.append("hidden by what is unknown")
        return "; ".join(notes)


@dataclass(frozen=True, eq=False)
class IndexRow(InCell):
    """One line index of one star, with its errors in one exposure."""

    value: IndexValue
    error: float
    error_known: float
    wavelength_nm: NDArray[np.float64]  # of the pixels
    flux: NDArray[np.float64]  # mean of the exposure, erg s-1 cm-2 nm-1
    saturated: tuple[int, int]  # pixels near saturation, and all of the index

    @property
    def note(self) -> str:
        """Why the index has no value; empty if it has one."""
        lost, every = self.saturated
        return _lost_pixels(lost, every) if lost else ""

    @property
    def snr(self) -> float:
        """Index over its error; negative in absorption."""
        return self.value.value / self.error_known


@dataclass(frozen=True, eq=False)
class PeriodRow(InCell):
    """Recovered periods of one change of one star."""

    change: Change
    error: float
    recovery: Recovery

    def shares(self, which: str) -> NDArray[np.float64]:
        """Return a value of the intervals of all cells, one row of periods after the other."""
        return np.array([[getattr(one, which) for one in part] for part in self.recovery.recovered]).ravel()


def _lost_pixels(lost: int, every: int) -> str:
    return "every pixel saturates" if lost == every else f"{lost} of {every} pixels saturate"


def _amount(value: float, unit: str) -> str:
    if np.isnan(value):
        return ""
    if np.isinf(value):
        return "hidden"
    return f"{100 * value:.3g} %" if not unit else f"{value:.3g} {unit}"


#: Columns of the table of changes.
COLUMNS = (
    Column("change", "change.name", "", "what changes", "change", kind=str),
    Column("unit", "change.unit", "", "unit of the change and its errors; empty if relative", kind=str),
    Column("error", "error", "", "standard error of one visit, unknowns marginalised; inf: hidden by them; nan: none",
           "error of a visit", _amount, ("unit",)),
    Column("error_known", "error_known", "", "the same with everything known", "all known", _amount, ("unit",)),
    Column("smallest", "smallest.one", "", "smallest detected difference of one visit from the others",
           "smallest change", _amount, ("unit",)),
    Column("smallest_scatter", "smallest.scatter", "", "smallest detected standard deviation between visits",
           "smallest scatter", _amount, ("unit",)),
    Column("meaning", "change.meaning", "", "what a change of one unit is", "of", kind=str),
    Column("note", "note", "", "what limits the row: saturated pixels or unknowns", "note", kind=str),
)  # fmt: skip
#: Columns of the table of indices.
INDEX_COLUMNS = (
    Column("index", "value.index.name", "", "line or lines", "index", kind=str),
    Column("flux", "value.value", "erg / (s cm2)", "flux in the band above the continuum; absorption is negative",
           "flux", number(".3g")),
    Column("error", "error", "erg / (s cm2)", "standard deviation in one exposure with unknowns of finite spread; inf: "
           "a free unknown changes it", "error", lambda value: "free" if np.isinf(value) else number(".2g")(value)),
    Column("error_known", "error_known", "erg / (s cm2)", "the same with everything known", "all known",
           number(".2g")),
    Column("snr", "snr", "", "index over its error with everything known", "S/N, all known", number(".3g")),
    Column("equivalent_width", "value.equivalent_width_nm", "nm", "positive in emission", "EW (nm)", number(".3g")),
    Column("captured", "value.captured", "", "share of a line's flux that the index holds at this resolution",
           "captured", percent(".0f")),
    Column("band_low", lambda row: row.value.index.band_nm[0], "nm", "lower end of the band"),
    Column("band_high", lambda row: row.value.index.band_nm[1], "nm", "upper end"),
    Column("published", "value.index.published", "", "usual definition at higher resolution, with its source",
           kind=str),
    Column("note", "note", "", "saturated pixels of the index, which has no value then", "note", kind=str),
)  # fmt: skip
#: Columns of the changes against magnitude.
MAGNITUDE_COLUMNS = (Column("magnitude", "magnitude", "mag", "of the star in its band"), *COLUMNS[:2], COLUMNS[4])
#: Columns of the recovered periods.
PERIOD_COLUMNS = (
    Column("change", "change.name", "", "what varies", "change", kind=str),
    Column("unit", "change.unit", "", "of the amplitude; empty if relative", kind=str),
    Column("period", lambda row: np.tile(row.recovery.periods_d, row.recovery.amplitudes.size), "d", "of the sinusoid",
           "period (d)", number(".3g")),
    Column("amplitude", lambda row: row.error * np.repeat(row.recovery.amplitudes, row.recovery.periods_d.size), "",
           "semi-amplitude", "semi-amplitude", _amount, ("unit",)),
    Column("amplitude_errors", lambda row: np.repeat(row.recovery.amplitudes, row.recovery.periods_d.size), "",
           "the same in standard errors of a visit", "in errors", ".3g"),
    Column("recovered", lambda row: row.shares("value"), "", "share of periods that are recovered", "recovered",
           percent(".0f")),
    Column("recovered_low", lambda row: row.shares("low"), "", "its 95 % interval, lower end"),
    Column("recovered_high", lambda row: row.shares("high"), "", "upper end"),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ChangeAnswer(Answer):
    """The answer of `change`.

    Attributes
    ----------
    study : Study
    changes : list of ChangeRow
        Every change of every star in every cell of the sweep.
    indices : list of IndexRow
    along : list of ChangeRow
        Changes of stars at other magnitudes.
    periods : list of PeriodRow
        Empty unless the study asks for them.
    expectations : list of Expectation
    """

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "nuisances")
    JSON: ClassVar[Mapping[str, str]] = {"rows": "table", "indices": "index_table"}

    study: Study
    changes: list[ChangeRow]
    indices: list[IndexRow]
    along: list[ChangeRow]
    periods: list[PeriodRow]
    expectations: list[Expectation]

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses: orbit and seed only for periods."""
        return (*self.USES, "orbit", "seed") if self.periods else self.USES

    @property
    def many(self) -> int:
        """Number of stars at other magnitudes: all with a magnitude, in every cell of the sweep."""
        return len(self.along) // (MAGNITUDES.size * len(self.study.change.of))

    @property
    def _place(self) -> tuple[Column, ...]:
        return place_columns(self.study.sweep)

    @cached_property
    def table(self) -> QTable:
        """One row per star, cell and change."""
        about = {"visits": self.study.change.visits, "fap": self.study.run.fap, "power": self.study.limit.power}
        return table_of((*self._place, *COLUMNS), self.changes, **about, study=self.study.text())

    @cached_property
    def index_table(self) -> QTable:
        """One row per star, cell and line index."""
        return table_of((*self._place, *INDEX_COLUMNS), self.indices)

    @cached_property
    def magnitude_table(self) -> QTable:
        """One row per star, cell, change and magnitude."""
        place = (column for column in self._place if column.name != "magnitude")
        return table_of((*place, *MAGNITUDE_COLUMNS), self.along)

    @cached_property
    def period_table(self) -> QTable:
        """One row per star, cell, change, amplitude and period."""
        return table_of((*self._place, *PERIOD_COLUMNS), self.periods, fap=self.study.change.period_fap)

    @property
    def tables(self) -> dict[str, Table]:
        """Changes, indices, changes against magnitude, and periods."""
        found: dict[str, Table] = {"change": self.table, "indices": self.index_table}
        if self.along:
            found["magnitudes"] = self.magnitude_table
        if self.periods:
            found["periods"] = self.period_table
        return found

    @property
    def views(self) -> list[View]:
        asked, o = self.study.change, self.study.observation
        visits = "two visits" if asked.visits == 2 else f"{asked.visits} visits"
        title = (
            f"Smallest changes between {visits} of {o.exposure_s:g} s, at a false-alarm probability of "
            f"{self.study.run.fap:g} and a power of {self.study.limit.power:g}"
        )
        views = [
            View(title, (*self._place, *COLUMNS), self.table),
            View(f"Line indices in {o.exposure_s:g} s", (*self._place, *INDEX_COLUMNS), self.index_table),
        ]
        if self.periods:
            first = self.period_table[self.period_table["change"] == self.periods[0].change.name]
            title = f"Periods of {self.periods[0].change.name} that {asked.visits} visits recover"
            views.append(View(title, (*self._place, *PERIOD_COLUMNS), first))
        return views

    @property
    def messages(self) -> list[str]:
        lines = collect_messages(self.expectations)
        hidden = dict.fromkeys(f"{one.title}: {one.change.name}" for one in self.changes if one.hidden)
        lines += [f"HIDDEN by what is unknown: {text}." for text in hidden]
        left = [name for name in INDICES if name not in {one.value.index.name for one in self.indices}]
        if left:
            lines.append(f"The pixels do not cover the line indices {', '.join(left)}.")
        lines.append(
            "Bands of the line indices are wider than published ones, since Mauve resolves 13 nm: their widths are an "
            "assumption; the table of indices names the published ones."
        )
        return lines

    @property
    def inputs(self) -> list[Expectation]:
        return self.expectations


@validated
def change(
    study: Study, engine: Engine | Pool | None = None, progress: Callable[[int, int], None] | None = None
) -> ChangeAnswer:
    """Compute the smallest changes of a study's stars between visits that are detected.

    Parameters
    ----------
    study : Study
        Its ``change`` gives the changes and the number of visits, ``run.fap`` and ``limit.power`` the probabilities,
        and ``nuisances`` the unknowns of each visit.
    engine : Engine or Pool, optional
        Not used: errors are closed forms, and periodograms are simulated on the host.
    progress : callable, optional
        Called as ``progress(done, total)`` in stars and cells of the sweep.

    Raises
    ------
    InputError
        For an unknown change, or periods without a target.

    Examples
    --------
    >>> from mauvecl import Study, change
    >>> settings = ["star=[{library='M3V', magnitude=9}]", "observation.exposure_s=600", "change.of=['200-320']"]
    >>> answer = change(Study().with_settings(settings))
    >>> answer.table["change"].tolist()
    ['200-320']
    """
    asked = study.change
    file = asked.light()
    prepared = cases(study)
    times = _visits(study) if asked.periods else None
    rows, indices, along, periods = [], [], list[ChangeRow](), []
    for case in reported(prepared, len(prepared), progress):
        own = _changes(case, file)
        rows += own
        indices += _indices(case)
        magnitude = case.star.magnitude
        if magnitude is not None:
            for step in MAGNITUDES:
                along += _changes(case.with_value("magnitude", float(magnitude + step)), file)
        if times is not None:
            recovery = recover_periods(
                times, np.geomspace(asked.shortest_d, asked.longest_d, asked.steps),
                np.geomspace(*AMPLITUDES, asked.steps), fap=asked.period_fap, trials=asked.trials, seed=study.run.seed,
            )  # fmt: skip
            # The recovery depends on the amplitude in errors alone, so that one map serves all changes.
            periods += [PeriodRow(one.label, one.at, one.change, one.error, recovery)
                        for one in own if not np.isnan(one.error)]  # fmt: skip
    return ChangeAnswer(study, rows, indices, along, periods, [case.quiet for case in prepared])


def _changes(case: Case, file: Source | None) -> list[ChangeRow]:
    """Return the smallest detectable changes of a case's star."""
    study, quiet, unknown = case.study, case.quiet, case.unknowns()
    unit = smallest_change(1.0, study.change.visits, study.run.fap, study.limit.power)
    rows = []
    for name in study.change.of:
        one = Change.named(name, case.source, quiet, case.instrument, study.observation.order, file, study.change.band)
        error, known = error_of_change(one.counts_dn, quiet, unknown), error_of_change(one.counts_dn, quiet, None)
        smallest = Smallest(one.size(error * unit.one), one.size(error * unit.scatter))
        lost, own = pixels_of(one.counts_dn, quiet), (one.size(error), one.size(known))
        rows.append(ChangeRow(case.label, case.at, one, *own, smallest, case.star.magnitude, lost))
    return rows


def _indices(case: Case) -> list[IndexRow]:
    quiet, unknown = case.quiet, case.unknowns()
    rows = []
    for index in covered_indices(quiet):
        value = IndexValue.of(index, quiet, case.instrument, case.study.observation.order)
        error, known = (error_of_index(value.weights, quiet, one) for one in (unknown, None))
        lost = pixels_of(value.weights, quiet)
        if lost[0]:
            value = replace(value, value=np.nan, equivalent_width_nm=np.nan)
        flux = flux_per_dn(quiet, case.instrument) * quiet.signal_dn
        rows.append(IndexRow(case.label, case.at, value, error, known, quiet.wavelength_nm, flux, lost))
    return rows


def _visits(study: Study) -> NDArray[np.float64]:
    """Draw the times of visits to the first target of a study's orbit."""
    o, target = study.orbit, targets_of(study.orbit, study.plan)[0]
    seen = Visibility.of(o.orbit().track(o.times()), np.array([target.direction]), o.limits)
    return visit_times_d(seen.windows(0), study.change.visits, study.observation.exposure_s, study.run.seed)
