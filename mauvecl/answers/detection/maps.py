"""Detection probability over two quantities, all cells on common draws."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.answer import Answer
from mauvecl.answers.detection.unknown_cost import cost_lines, marginal_lines, unknown_cost
from mauvecl.detection.distributions import Interval
from mauvecl.detection.fap_checks import check_fap
from mauvecl.schema.calls import validated
from mauvecl.schema.messages import Message, of_kind
from mauvecl.schema.tables import Column, View, table_of
from mauvecl.study.cases import Case, cases
from mauvecl.study.labels import label, quantity_column
from mauvecl.study.messages import SATURATED, collect_messages, worst_first
from mauvecl.study.nuisances import NuisanceChoice
from mauvecl.study.quantities import QUANTITIES
from mauvecl.study.study import Study
from mauvecl.study.unknowns import average, describe_shares, drawn, shares

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.device.engine import Engine
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool
    from mauvecl.study.assumptions import Use
    from mauvecl.study.questions import MapQuestion
    from mauvecl.study.sections import Run

#: Quantities of the flare alone: cells that differ in them share their quiescent star, and one launch.
OF_FLARE = tuple(name for name, one in QUANTITIES.items() if one.path[0] == "flare")


#: Columns of the table of cells, after those of the two axes.
COLUMNS = (
    Column("statistic", description="detection statistic"),
    Column("probability", description="detection probability"),
    Column("low", description="its 95 % interval, lower end, with the threshold's own"),
    Column("high", description="its 95 % interval, upper end, with the threshold's own"),
    Column("closed_form", description="the same for Gaussian noise"),
)


@dataclass(frozen=True, eq=False)
class MapAnswer(Answer):
    """Answer of `detection_map`, for the study's first star.

    Attributes
    ----------
    study : Study
    star : str
    x, y : tuple
        Values of both axes.
    statistics : tuple of str
    probability, low, high, closed_form : ndarray, shape (n_statistic, n_y, n_x)
        Detection probability, its 95 % interval including that of the threshold, and the probability for Gaussian
        noise; NaN if every pixel saturates.
    messages : list of str
    shares : dict of dict of float
        For maps averaged over unknowns, by statistic: the share of the variance of the mean probability that each
        unknown explains, largest first.
    quiet : Expectation, optional
        The star of the first cell.
    """

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "flare", "processes", "nuisances", "values", "seed")

    study: Study
    star: str
    x: tuple[float | str, ...]
    y: tuple[float | str, ...]
    statistics: tuple[str, ...]
    probability: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    closed_form: NDArray[np.float64]
    messages: list[str]
    shares: dict[str, dict[str, float]] = field(default_factory=dict)
    quiet: Expectation | None = None

    @property
    def table(self) -> QTable:
        """One row per cell and statistic."""
        s, j, i = (index.ravel() for index in np.indices(self.probability.shape))
        x, y = self.study.map.x.quantity, self.study.map.y.quantity
        values = {x: np.array(self.x)[i], y: np.array(self.y)[j], "statistic": np.array(self.statistics)[s]}
        values |= {column.name: getattr(self, column.name).ravel() for column in COLUMNS[1:]}
        columns = (quantity_column(x, x), quantity_column(y, y), *COLUMNS)
        run = {"fap": self.study.run.fap, "realisations": self.study.run.realisations}
        return table_of(columns, [values], star=self.star, **run, study=self.study.text())

    @property
    def views(self) -> list[View]:
        """Map of each statistic, with a row per value of y and a column per value of x."""
        draws = f"{self.study.unknowns.draws} draws of what is unknown"
        lines = [
            View(f"{statistic}, averaged over {draws}: its scatter is from {describe_shares(parts)}.")
            for statistic, parts in self.shares.items()
        ]
        axes = f"{self.study.map.y.quantity}, {self.study.map.x.quantity}"
        columns = [
            Column("y", heading=axes, format=_shown),
            *(Column(f"x{k}", heading=_shown(x), format=lambda p: f"{100 * p:.0f}") for k, x in enumerate(self.x)),
        ]
        maps = []
        for statistic, probability in zip(self.statistics, self.probability, strict=True):
            rows = [
                {"y": y} | {f"x{k}": p for k, p in enumerate(row)} for y, row in zip(self.y, probability, strict=True)
            ]
            title = f"{self.star}: detection probability in percent, {statistic}, fap {self.study.run.fap:g} per test"
            maps.append(View(title, columns, table_of(columns, rows)))
        return [*lines, *maps]

    ENDINGS = ("ecsv", "fits")

    @property
    def assumed(self) -> str:
        """One line with the study's assumptions apart from the two quantities of the map."""
        from mauvecl.study.assumptions import assumption_line

        return assumption_line(self.study, self.uses, (self.study.map.x.quantity, self.study.map.y.quantity))

    @property
    def tables(self) -> dict[str, Table]:
        """The only table."""
        return {"map": self.table}

    @property
    def inputs(self) -> list[Expectation]:
        """The star without a flare in the first cell."""
        return [] if self.quiet is None else [self.quiet]


@validated
def map(
    study: Study, engine: Engine | Pool | None = None, progress: Callable[[int, int], None] | None = None
) -> MapAnswer:
    """Compute the detection probability of the study's first star and flare over two quantities.

    Parameters
    ----------
    study : Study
        Its ``map`` defines the axes; other quantities have the study's values.
    engine : Engine or Pool, optional
    progress : callable, optional
        Called as ``progress(done, total)`` in cells.
    """
    from mauvecl.device.engine import Engine as Default

    engine = engine or Default()
    check_fap(study.run.fap, study.run.realisations, study.run.tails)
    study = study.model_copy(update={"star": study.star[:1]}).at("amplitude", study.flare.amplitudes[0])
    axes = study.map.x, study.map.y
    x, y = (axis.points() for axis in axes)
    (case,) = cases(study, swept=False)
    unknown = drawn(case.study) if study.unknowns.draws else None
    draws = [case] if unknown is None else [replace(case, study=one) for one in unknown.studies]
    seen: list[Expectation] = []
    of_flares: list[str] = []
    lowered: set[Lowered] = set()
    maps = []
    for number, one in enumerate(draws):

        def report(done: int, number: int = number) -> None:
            if progress is not None:
                cells = len(x) * len(y)
                progress(number * cells + done, len(draws) * cells)

        maps.append(_map(one, x, y, engine, seen, of_flares, lowered, report))
    values, parts = maps[0], {}
    if unknown is not None:
        values = _averaged(maps)
        for s, statistic in enumerate(study.run.statistics):
            means = [float(np.nanmean(one["probability"][s])) for one in maps]
            parts[statistic] = shares(unknown, np.array(means))
    quiet = seen[0]
    names = {axis.quantity for axis in axes}
    star = study.star[0]
    if "magnitude" in names:
        star = star.model_copy(update={"magnitude": None})
    return MapAnswer(
        study=study,
        star="stars of the axis" if "star" in names else label(star, quiet),
        x=x,
        y=y,
        statistics=study.run.statistics,
        messages=[
            *_blinded(values),
            *_without_threshold(study.run, values),
            *_wrong_sign(case, lowered, len(x) * len(y)),
            *worst_first([*collect_messages(seen, study.processes), *of_flares]),
            *marginal_lines(study.nuisances),
            *_cost(case, x, y),
        ],
        shares=parts,
        quiet=quiet,
        **values,
    )


def _cost(case: Case, x: tuple[float | str, ...], y: tuple[float | str, ...]) -> list[str]:
    """Return the sentence on the cost of unknowns in the middle of the map."""
    middle, study = (x[len(x) // 2], y[len(y) // 2]), case.study
    there = _cell(case, *middle)
    (flare,) = there.flares
    names = (axis.quantity.replace("_", " ") for axis in (study.map.x, study.map.y))
    at = " and ".join(f"{name} {_shown(value)}" for name, value in zip(names, middle, strict=True))
    cost = unknown_cost(f"the cell of {at}", there.quiet, flare, study.nuisances, study.run.comparison())
    return cost_lines([cost], study.nuisances)


def _shown(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.3g}"


Arrays = dict[str, NDArray[np.float64]]
#: A statistic, and the indices of a cell in which the flare lowers it.
Lowered = tuple[str, int, int]


def _blinded(values: Arrays) -> list[str]:
    """Return the sentence on cells where every pixel saturates, if any."""
    form = values["closed_form"][0]
    cells = int(np.isnan(form).sum())
    if not cells:
        return []
    text = f"SATURATED: every pixel that counts saturates in {cells} of {form.size} cells: no number there."
    return [Message(text, SATURATED)]


def _without_threshold(run: Run, values: Arrays) -> list[str]:
    """Return a sentence for each statistic on cells where no threshold has the false-alarm probability, if any."""
    missing = np.isnan(values["probability"]) & ~np.isnan(values["closed_form"])
    return [
        Message(
            f"NO THRESHOLD: in {int(there.sum())} of {there.size} cells no threshold of {statistic} has a false-alarm "
            f"probability of {run.fap:g}, because one value is more probable, as saturated pixels give it: no number "
            "there; `mauvecl detect` names the probabilities that thresholds have.",
            "no threshold",
        )
        for statistic, there in zip(run.statistics, missing, strict=True)
        if there.any()
    ]


def _wrong_sign(case: Case, lowered: set[Lowered], cells: int) -> list[str]:
    """Return a sentence for each weighted sum on the cells whose flare lowers it, if any."""
    how = "marginalised over unknowns, " if case.study.nuisances != NuisanceChoice() else ""
    return [
        Message(
            f"WRONG SIGN: {how}{statistic} falls with the flare in {number} of {cells} cells, and only higher values "
            "are alarms: its detection probability says nothing of the flare there.",
            "wrong sign",
        )
        for statistic in case.study.run.statistics
        if (number := sum(name == statistic for name, *_ in lowered))
    ]


def _map(
    case: Case,
    x: tuple[float | str, ...],
    y: tuple[float | str, ...],
    engine: Engine | Pool,
    seen: list[Expectation],
    of_flares: list[str],
    lowered: set[Lowered],
    report: Callable[[int], None],
) -> Arrays:
    """Compute the map on one instrument.

    Add quiescent stars to `seen`, flares' saturation to `of_flares`, and sums that flares lower to `lowered`.
    """
    from mauvecl.runs.pool import map_in_order

    shape = (len(case.study.run.statistics), len(y), len(x))
    values = {name: np.full(shape, np.nan) for name in ("probability", "low", "high", "closed_form")}

    def filled(cells: list[tuple[int, int]]) -> tuple[Expectation, int, list[str]]:
        group = [_cell(case, x[i], y[j]) for i, j in cells]
        quiet, flares = group[0].quiet, group[0].expect(*(one.flaring(one.amplitudes[0]) for one in group))
        if not quiet.saturated.all():
            lowered.update(_fill(values, cells, group[0], flares, engine))
        return quiet, len(cells), of_kind(collect_messages(flares), SATURATED)

    done = 0
    for quiet, count, texts in map_in_order(engine, filled, _groups(case.study.map, x, y)):
        seen.append(quiet)
        of_flares.extend(texts)
        done += count
        report(done)
    return values


def _averaged(maps: list[Arrays]) -> Arrays:
    """Return the mean over draws of the unknown, with its interval; NaN if a draw has none."""
    values = {name: np.mean([one[name] for one in maps], axis=0) for name in ("probability", "closed_form")}
    values |= {name: np.full_like(values["probability"], np.nan) for name in ("low", "high")}
    for at in zip(*np.nonzero(np.isfinite(values["probability"])), strict=True):
        p = average([Interval(*(float(one[name][at]) for name in ("probability", "low", "high"))) for one in maps])
        values["low"][at], values["high"][at] = p.low, p.high
    return values


def _groups(
    question: MapQuestion, x: tuple[float | str, ...], y: tuple[float | str, ...]
) -> list[list[tuple[int, int]]]:
    """Return the cells (i, j) in groups that share a quiescent star."""
    flare_x, flare_y = (axis.quantity in OF_FLARE for axis in (question.x, question.y))
    every = [[(i, j) for i in range(len(x))] for j in range(len(y))]
    if flare_x and flare_y:
        return [[cell for row in every for cell in row]]
    if flare_x:
        return every
    if flare_y:
        return [list(column) for column in zip(*every, strict=True)]
    return [[cell] for row in every for cell in row]


def _cell(case: Case, x: float | str, y: float | str) -> Case:
    """Return the case of a cell."""
    question = case.study.map
    return case.with_value(question.x.quantity, x).with_value(question.y.quantity, y)


def _fill(
    values: dict[str, NDArray[np.float64]],
    cells: list[tuple[int, int]],
    case: Case,
    flares: list[Expectation],
    engine: Engine | Pool,
) -> list[Lowered]:
    """Compute cells that share the quiescent star of a case, and return the weighted sums that their flares lower."""
    run, lowered = case.study.run, []
    result = engine.detect(case.quiet, flares, seed=run.seed, **case.detect_options())
    for s, statistic in enumerate(run.statistics):
        probabilities = result.detection_probability(run.fap, statistic)
        for k, ((i, j), p) in enumerate(zip(cells, probabilities, strict=True)):
            at = (s, j, i)
            values["probability"][at], values["low"][at], values["high"][at] = p.value, p.low, p.high
            limit = result.closed_form(statistic, template=k).isf(run.fap)
            if k not in result.blinding:
                values["closed_form"][at] = result.closed_form(statistic, k).sf(limit)
            if result.fall(statistic, k):
                lowered.append((statistic, i, j))
    return lowered


#: The older name, which does not hide Python's own `map`.
detection_map = map
