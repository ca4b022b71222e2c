"""Smallest detectable changes of stars between visits, line indices, and periods that are recovered."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.answer import IF_KNOWN, Answer, StarInCell, TableOf, reported
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.host.orbit.visibility import Visibility
from mauvecl.observations import visits
from mauvecl.schema.columns import Column, formatted, interval_columns, number, percent
from mauvecl.study.cases import Case, Use, cases, collect_messages
from mauvecl.study.plan import targets_of

if TYPE_CHECKING:
    from mauvecl.device.engine import Engine
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.stars.source import Source
    from mauvecl.runs.pool import Pool
    from mauvecl.study.study import Study

#: Magnitudes around that of the star at which changes are computed.
MAGNITUDES = np.arange(-4.0, 4.01, 0.5)
#: Semi-amplitudes of the map of periods, in standard errors of a visit.
AMPLITUDES = (0.4, 4.0)


@dataclass(frozen=True, eq=False)
class ChangeRow(StarInCell):
    """One change of one star."""

    change: visits.Change
    error: float  # standard error of one visit, unknowns marginalised over
    error_known: float  # the same with everything known
    smallest: visits.SmallestChanges  # in the unit of the change
    ideal: float  # smallest difference of one visit if everything but the noise is known
    magnitude: float | None  # of the star
    saturated: tuple[int, int]  # pixels near saturation, and all that the change concerns

    @property
    def hidden(self) -> bool:
        """Whether what is unknown hides the change."""
        return bool(np.isinf(self.error) and np.isfinite(self.error_known))

    @property
    def note(self) -> str:
        """What limits the row, in a few words."""
        lost, total = self.saturated
        hidden = "hidden by what is unknown" if self.hidden else ""
        return "; ".join(filter(None, [_lost_pixels(lost, total), "" if total else "no light", hidden]))


@dataclass(frozen=True, eq=False)
class IndexRow(StarInCell):
    """One line index of one star, with its errors in one exposure."""

    index: visits.Index
    weights: NDArray[np.float64]  # shape (n_pixel,); the index, erg s-1 cm-2, for one DN of the exposure in each pixel
    value: float  # of the mean exposure; NaN, as its width, if a pixel saturates
    equivalent_width_nm: float  # positive in emission
    captured: float  # share of a line's flux that the index holds at the instrument's resolution
    error: float
    error_known: float
    wavelength_nm: NDArray[np.float64]  # of the pixels
    flux: NDArray[np.float64]  # mean of the exposure, erg s-1 cm-2 nm-1
    saturated: tuple[int, int]  # pixels near saturation, and all of the index

    @property
    def note(self) -> str:
        """Why the index has no value; empty if it has one."""
        return _lost_pixels(*self.saturated)


@dataclass(frozen=True, eq=False)
class PeriodRow(StarInCell):
    """Recovered periods of one change of one star."""

    change: visits.Change
    error: float
    recovery: visits.PeriodRecovery

    def shares(self, end: str) -> NDArray[np.float64]:
        """Return the recovered shares or the ends of their intervals, shape (n_amplitude, n_period)."""
        return np.array([[getattr(share, end) for share in row] for row in self.recovery.recovered])


def _lost_pixels(lost: int, total: int) -> str:
    """Return how many pixels saturate, or nothing if none do."""
    text = "every pixel saturates" if lost == total else f"{lost} of {total} pixels saturate"
    return text if lost else ""


def _amount(value: float, unit: str) -> str:
    """Format a change or its error with the unit, or as a percentage if it is relative."""
    if not np.isfinite(value):
        return "" if np.isnan(value) else "hidden"
    return f"{value:.3g} {unit}" if unit else f"{formatted(100 * value, '.3g')} %"


COLUMNS = (
    Column("change", "change.name", "", "what changes", "change", kind=str),
    Column("unit", "change.unit", "", "unit of the change and its errors; empty if relative", kind=str),
    Column("error", "error", "", "standard error of one visit, unknowns marginalised; inf: hidden by them; nan: none",
           "error of a visit", _amount, ("unit",), detail=True),
    Column("error_known", "error_known", "", "the same with everything known", "error, all known", _amount,
           ("unit",), detail=True),
    Column("smallest", "smallest.one", "", "smallest detected difference of one visit from the others",
           "smallest change", _amount, ("unit",)),
    Column("smallest_ideal", "ideal", "", "the same if everything but the noise were known", "ideal", _amount,
           ("unit",)),
    Column("smallest_scatter", "smallest.scatter", "", "smallest detected standard deviation between visits",
           "smallest scatter", _amount, ("unit",), detail=True),
    Column("meaning", "change.meaning", "", "what a change of one unit is", "of", kind=str, detail=True),
    Column("note", "note", "", "what limits the row: saturated pixels or unknowns", "note", kind=str),
)  # fmt: skip
INDEX_COLUMNS = (
    Column("index", "index.name", "", "line or lines", "index", kind=str),
    Column("flux", "value", "erg / (s cm2)", "flux in the band above the continuum; absorption is negative",
           "flux", number(".3g")),
    Column("error", "error", "erg / (s cm2)", "standard deviation in one exposure with unknowns of finite spread; inf: "
           "a free unknown changes it", "error", lambda value: "free" if np.isinf(value) else number(".2g")(value)),
    Column("error_known", "error_known", "erg / (s cm2)", "the same with everything known", "ideal", number(".2g")),
    Column("snr", lambda row: row.value / row.error_known, "", "index over its error with everything known; "
           "negative in absorption", "ideal S/N", number(".3g"), detail=True),
    Column("equivalent_width", "equivalent_width_nm", "nm", "positive in emission", "EW (nm)", number(".3g")),
    Column("captured", "captured", "", "share of a line's flux that the index holds at this resolution",
           "captured", percent(".0f"), detail=True),
    *interval_columns("band_{}", lambda row: row.index.band_nm, "nm", "the band"),
    Column("published", "index.published", "", "usual definition at higher resolution, with its source",
           kind=str),
    Column("note", "note", "", "saturated pixels of the index, which has no value then", "note", kind=str),
)  # fmt: skip
MAGNITUDE_COLUMNS = (Column("magnitude", "magnitude", "mag", "of the star in its band"), *COLUMNS[:2], COLUMNS[4])
PERIOD_COLUMNS = (
    Column("change", "change.name", "", "what varies", "change", kind=str),
    Column("unit", "change.unit", "", "of the amplitude; empty if relative", kind=str),
    Column("period", "recovery.periods_d", "d", "of the sinusoid", "period (d)", number(".3g")),
    Column("amplitude", lambda row: row.error * row.recovery.amplitudes[:, None], "", "semi-amplitude",
           "semi-amplitude", _amount, ("unit",)),
    Column("amplitude_errors", lambda row: row.recovery.amplitudes[:, None], "",
           "the same in standard errors of a visit", "in errors", ".3g", detail=True),
    Column("recovered", lambda row: row.shares("value"), "", "share of periods that are recovered", "recovered",
           percent(".0f")),
    *interval_columns("recovered_{}", lambda row: [row.shares(end) for end in ("low", "high")]),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ChangeAnswer(Answer):
    """Answer of `change`: smallest detected changes, line indices, and periods that are recovered."""

    USES = ("instrument", "sky", "nuisances", "sweep")

    study: Study
    changes: list[ChangeRow]  # every change of every star in every cell of the sweep
    indices: list[IndexRow]
    along: list[ChangeRow]  # changes of stars at other magnitudes
    periods: list[PeriodRow]  # empty unless the study asks for them
    inputs: list[Expectation]

    #: One row per star, cell and change.
    table = TableOf(
        "change", COLUMNS, "changes", by_star=True, key="rows",
        title=lambda answer: f"Smallest changes between {answer.visits}, at a false-alarm probability of "
        f"{answer.study.run.fap:g} and a power of {answer.study.limit.power:g}",
        meta=("study.change.visits", "study.run.fap", "study.limit.power", "study"),
    )  # fmt: skip
    #: One row per star, cell and line index.
    index_table = TableOf(
        "indices", INDEX_COLUMNS, "indices", by_star=True, key="indices", meta=(),
        title=lambda answer: f"Line indices in {answer.exposure}" if answer.exposure else "Line indices",
    )  # fmt: skip
    #: One row per star, cell, change and magnitude.
    magnitude_table = TableOf("magnitudes", MAGNITUDE_COLUMNS, "along", by_star=True, meta=(),
                              when="along")  # fmt: skip
    #: One row per star, cell, change, amplitude and period.
    period_table = TableOf(
        "periods", PERIOD_COLUMNS, "periods", by_star=True, when="periods",
        meta=lambda answer: {"fap": answer.study.change.period_fap},
        title=lambda answer: f"Periods of {answer.periods[0].change.name} that {answer.study.change.visits} visits "
        "recover",
        shown=lambda table: table[table["change"] == table["change"][0]],
    )  # fmt: skip

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses: orbit and seed only for periods."""
        return (*self.USES, "orbit", "seed") if self.periods else self.USES

    @property
    def exposure(self) -> str:
        """Exposure of a visit, in words; empty if it is swept."""
        exposures = {quiet.exposure_s for quiet in self.inputs}
        return f"{exposures.pop():g} s" if len(exposures) == 1 else ""

    @property
    def visits(self) -> str:
        """Number and exposure of the visits, in words."""
        visits = self.study.change.visits
        return f"{'two' if visits == 2 else visits} visits{self.exposure and f' of {self.exposure}'}"

    @property
    def headline(self) -> str:
        """The smallest change of the first row that is not hidden."""
        row = next((row for row in self.changes if np.isfinite(row.smallest.one)), self.changes[0])
        unit, instrument = row.change.unit, self.instrument_name
        where = f"{row.change.name} of {row.title} between {self.visits}"
        if not np.isfinite(row.smallest.one):
            return f"{instrument} would see no change in {where}: {row.note or 'there is no light'}."
        ideal = "" if self.study.nuisances.none else f" ({_amount(row.ideal, unit)} {IF_KNOWN})"
        return (
            f"{instrument} would see a change of {_amount(row.smallest.one, unit)}{ideal} in {where} with a chance of "
            f"{100 * self.study.limit.power:g} %; one visit measures it to {_amount(row.error, unit)}."
        )

    @property
    def messages(self) -> list[str]:
        lines = collect_messages(self.inputs)
        hidden = dict.fromkeys(f"{row.title}: {row.change.name}" for row in self.changes if row.hidden)
        lines += [f"HIDDEN by what is unknown: {text}." for text in hidden]
        missing = [name for name in visits.INDICES if name not in {row.index.name for row in self.indices}]
        if missing:
            lines.append(f"The pixels do not cover the line indices {', '.join(missing)}.")
        lines.append(
            "Bands of the line indices are wider than published ones, for the 13 nm that Mauve resolves: their widths "
            "are an assumption; the table of indices names the published ones."
        )
        return lines


@by_keywords("stars and cells of the sweep")
def change(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> ChangeAnswer:
    """Compute the smallest changes of a study's stars between visits that are detected.

    The study's ``change`` gives the changes and the number of visits, ``run.fap`` and ``limit.power`` the
    probabilities, and ``nuisances`` the unknowns of each visit. Errors are closed forms, and periodograms are simulated
    on the host.

    Examples
    --------
    >>> from mauvecl import Study, change
    >>> settings = ["star=[{library='M3V', magnitude=9}]", "observation.exposure_s=600", "change.of=['200-320']"]
    >>> answer = change(Study().with_settings(settings))
    >>> answer.table["change"].tolist()
    ['200-320']
    """
    question = study.change
    file = question.light()
    prepared = cases(study)
    recovery = None
    if question.periods:
        o, target = study.orbit, targets_of(study.orbit, study.plan)[0]
        longest_s = max(case.study.observation.exposure_s for case in prepared)
        visibility = Visibility.of(o.orbit().track(o.times()), np.array([target.direction]), o.limits)
        # The recovery depends on the amplitude in errors alone, so that one map serves all changes.
        recovery = visits.recover_periods(
            visits.visit_times_d(visibility.windows(0), question.visits, longest_s, study.run.seed),
            np.geomspace(question.shortest_d, question.longest_d, question.steps),
            np.geomspace(*AMPLITUDES, question.steps),
            fap=question.period_fap, trials=question.trials, seed=study.run.seed,
        )  # fmt: skip
    rows, indices, along, periods = [], [], list[ChangeRow](), []
    for case in reported(prepared, len(prepared), progress):
        changes = _changes(case, file)
        rows += changes
        indices += _indices(case)
        for step in () if case.star.magnitude is None else case.star.magnitude + MAGNITUDES:
            along += _changes(case.with_value("magnitude", float(step)), file)
        if recovery is not None:
            periods += [PeriodRow(row.label, row.at, row.change, row.error, recovery)
                        for row in changes if not np.isnan(row.error)]  # fmt: skip
    return ChangeAnswer(study, rows, indices, along, periods, [case.quiet for case in prepared])


def _changes(case: Case, file: Source | None) -> list[ChangeRow]:
    """Return the smallest detectable changes of a case's star."""
    study, quiet, unknown = case.study, case.quiet, case.unknowns()
    unit = visits.smallest_change(1.0, study.change.visits, study.run.fap, study.limit.power)
    rows = []
    for name in study.change.of:
        order, band = study.observation.order, study.change.band
        change = visits.Change.named(name, case.source, quiet, case.instrument, order, file, band)
        error, known_error = (visits.error_of_change(change.counts_dn, quiet, unknowns) for unknowns in (unknown, None))
        smallest = visits.SmallestChanges(change.size(error * unit.one), change.size(error * unit.scatter))
        ideal = change.size(known_error * unit.one)
        lost, errors = visits.pixels_of(change.counts_dn, quiet), (change.size(error), change.size(known_error))
        rows.append(ChangeRow(case.label, case.at, change, *errors, smallest, ideal, case.star.magnitude, lost))
    return rows


def _indices(case: Case) -> list[IndexRow]:
    """Return the line indices of a case's star whose bands and continua the instrument covers."""
    quiet, instrument, unknown, rows = case.quiet, case.instrument, case.unknowns(), []
    nm, flux_per_dn = quiet.wavelength_nm, visits.flux_per_dn(quiet, instrument)
    for index in visits.INDICES.values():
        low, high = index.continuum_nm[0][0], index.continuum_nm[-1][1]
        if not nm[0] <= low < high <= nm[-1]:
            continue
        # The index is linear in the pixels near it.
        near = (nm > low - 1.0) & (nm < high + 1.0)
        find = partial(visits.line_index, nm[near], band_nm=index.band_nm, continuum_nm=index.continuum_nm)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Pixels of the band alone have no continuum, and no equivalent width.
            per_pixel = find(np.eye(int(near.sum())))
        weights = np.zeros(nm.size)
        weights[near] = per_pixel.flux * flux_per_dn[near]
        flux = flux_per_dn * quiet.signal_dn
        mean, lost = find(flux[near]), visits.pixels_of(weights, quiet)
        order, band = case.study.observation.order, case.study.change.band
        line = visits.Change.named(index.name, case.source, quiet, instrument, order, None, band)
        error, known_error = (visits.error_of_index(weights, quiet, nuisances) for nuisances in (unknown, None))
        rows.append(IndexRow(
            case.label, case.at, index, weights, value=np.nan if lost[0] else float(mean.flux),
            equivalent_width_nm=np.nan if lost[0] else float(mean.equivalent_width_nm),
            captured=float(weights @ line.counts_dn), error=error, error_known=known_error, wavelength_nm=nm, flux=flux,
            saturated=lost,
        ))  # fmt: skip
    return rows
