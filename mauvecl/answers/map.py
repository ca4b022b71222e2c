"""Detection probability over two quantities, all cells on common draws."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from mauvecl.answers import closed_forms as forms
from mauvecl.answers.answer import IF_KNOWN, Answer, TableOf
from mauvecl.answers.limit import SEARCH, LimitSearch
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.detection import RECOMMENDED, check_fap
from mauvecl.device.engine import Engine
from mauvecl.host.arrays import Float
from mauvecl.host.exposure.expectation import Expectation
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.columns import Column, View, interval_columns, table_of
from mauvecl.schema.errors import InputError, Message, of_kind
from mauvecl.study.cases import (
    SATURATED,
    Case,
    assumptions_of,
    cases,
    collect_messages,
    quantity_column,
    star_label,
    worst_first,
)
from mauvecl.study.questions import QUANTITIES, Axis, LimitQuestion
from mauvecl.study.study import Study

#: Quantities of the flare alone: cells that differ in them share their quiescent star, and one launch.
OF_FLARE = tuple(name for name, quantity in QUANTITIES.items() if quantity.path[0] == "flare")
#: Magnitude from which that of saturation is computed.
MIDDLE = 10.0
#: Steps of the magnitudes of a map, and their largest number.
STEPS, MOST_MAGNITUDES = (0.1, 0.2, 0.25, 0.5, 1.0), 16
#: Columns of the table of cells, after those of the two axes.
COLUMNS = (
    Column("statistic", lambda answer: np.array(answer.statistics)[:, None, None], description="detection statistic"),
    Column("probability", description="detection probability"),
    *interval_columns("{}", of="its 95 % interval, with the threshold's own"),
    Column("closed_form", description="the same for Gaussian noise"),
    forms.IDEAL,
)
#: Fields of `MapAnswer` with arrays: the probability, the ends of its interval, the closed form, and the ideal one.
NUMBERS = ("probability", "low", "high", "closed_form", "ideal")


def _cell_columns(answer: MapAnswer) -> tuple[Column, ...]:
    """Return the columns of `MapAnswer.table`, whose values are broadcast to (n_statistic, n_y, n_x)."""
    x, y = (axis.quantity for axis in answer.study.map.axes)
    return (
        quantity_column(x, lambda answer: np.array(answer.x)),
        quantity_column(y, lambda answer: np.array(answer.y)[:, None]),
        *COLUMNS,
    )


@dataclass(frozen=True, eq=False)
class MapAnswer(Answer):
    """Answer of `map`, for the study's first star.

    Arrays have the shape (n_statistic, n_y, n_x) and are NaN where every pixel saturates.
    """

    USES = ("instrument", "sky", "flare", "processes", "nuisances", "values", "seed")
    ENDINGS = ("ecsv", "fits")

    study: Study
    star: str
    x: tuple[float | str, ...]  # values of the horizontal axis
    y: tuple[float | str, ...]  # values of the vertical axis
    statistics: tuple[str, ...]
    probability: Float  # detection probability
    low: Float  # lower end of its 95 % interval, with that of the threshold
    high: Float
    closed_form: Float  # probability for Gaussian noise
    ideal: Float  # the same if everything but the noise were known; NaN if it is
    messages: list[str]
    # For maps averaged over unknowns: shares of the variance of the mean probability by unknown, for each statistic.
    shares: dict[str, dict[str, float]] = field(default_factory=dict)
    inputs: tuple[Expectation, ...] = ()  # the star without a flare in the first cell

    #: One row per cell and statistic.
    table = TableOf("map", _cell_columns, lambda answer: answer,
                    meta=("star", "study.run.fap", "study.run.realisations", "study"))  # fmt: skip

    @property
    def headline(self) -> str:
        """The share of the map in which a flare is rather seen than not, by the recommended statistic if computed."""
        statistic = RECOMMENDED if RECOMMENDED in self.statistics else self.statistics[0]
        chances, ideal = (values[self.statistics.index(statistic)] for values in (self.probability, self.ideal))
        bound = "" if self.study.nuisances.none else f" ({np.count_nonzero(ideal >= 0.5)} {IF_KNOWN})"
        return (
            f"{self.instrument_name} would see a flare on {self.star} with a chance of at least 50 % in "
            f"{np.count_nonzero(chances >= 0.5)} of {chances.size} cells of the map{bound}."
        )

    @property
    def views(self) -> list[View]:
        """Map of each statistic, with a row per value of y and a column per value of x."""
        draws = f"{self.study.unknowns.draws} draws of what is unknown"
        lines = [
            View(f"{statistic}, averaged over {draws}: its scatter is from {forms.describe_shares(shares)}.")
            for statistic, shares in self.shares.items()
        ]
        axes = ", ".join(axis.quantity for axis in self.study.map.axes[::-1])
        columns = [
            Column("y", heading=axes, format=_shown),
            *(Column(f"x{k}", heading=_shown(x), format=lambda p: f"{100 * p:.0f}") for k, x in enumerate(self.x)),
        ]
        kinds = {"": self.probability} | ({} if self.study.nuisances.none else {", ideal": self.ideal})
        for (number, statistic), (kind, chances) in product(enumerate(self.statistics), kinds.items()):
            rows = [
                {"y": y} | {f"x{k}": p for k, p in enumerate(row)}
                for y, row in zip(self.y, chances[number], strict=True)
            ]
            title = f"detection probability in percent, {statistic}{kind}, fap {self.study.run.fap:g} per test"
            lines.append(View(f"{self.star}: {title}", columns, table_of(columns, rows)))
        return lines

    @property
    def premises(self) -> list[str]:
        """The study's assumptions apart from the two quantities of the map."""
        return assumptions_of(self.study, self.uses, tuple(axis.quantity for axis in self.study.map.axes))


@by_keywords("cells")
def map(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> MapAnswer:
    """Compute the detection probability of the study's first star and flare over two quantities.

    The study's ``map`` defines the axes; other quantities have the study's values. Without a horizontal axis, it has
    the magnitudes over which the flares of the vertical one are lost.
    """
    check_fap(study.run.fap, study.run.realisations, study.run.tails)
    study = study.model_copy(update={"star": study.star[:1]}).at("amplitude", study.flare.amplitudes[0])
    (case,) = cases(study, swept=False)
    if study.map.x is None:
        study = study.model_copy(update={"map": study.map.model_copy(update={"x": magnitudes_of(case)})})
        case = case.with_sections(map=study.map)
    unknown = forms.draw_studies(case.study) if study.unknowns.draws else None
    draws = [case] if unknown is None else [replace(case, study=draw) for draw in unknown.studies]
    x, y = study.map.axes
    total = len(draws) * len(x.points()) * len(y.points())
    report = (lambda done: None) if progress is None else (lambda done: progress(done, total))
    cells = MapCells(x.points(), y.points(), engine or Engine(), report)
    maps = np.stack([cells.map_of(draw) for draw in draws], axis=1)
    # Means over the draws; NaN if a draw has none.
    values, shares = maps.mean(axis=1), dict[str, dict[str, float]]()
    if unknown is not None:
        values[:3] = forms.average(*maps[:3])
        for s, statistic in enumerate(study.run.statistics):
            shares[statistic] = forms.shares(unknown, np.nanmean(maps[0, :, s], axis=(1, 2)))
    quiet, star, names = cells.quiet[0], study.star[0], {x.quantity, y.quantity}
    if "magnitude" in names:
        star = star.model_copy(update={"magnitude": None})
    label = "stars of the axis" if "star" in names else star_label(star, quiet)
    return MapAnswer(study, label, cells.x, cells.y, study.run.statistics, messages=_messages(case, cells, values),
                     shares=shares, inputs=(quiet,), **dict(zip(NUMBERS, values, strict=True)))  # fmt: skip


def _messages(case: Case, cells: MapCells, values: Float) -> list[str]:
    """Return messages on the cells of a map, the most important first."""
    study, run, number_of_cells, messages = case.study, case.study.run, len(cells.x) * len(cells.y), list[str]()
    probability, _, _, closed_form, _ = values
    lost = np.isnan(closed_form[0])
    for i, j in (cell for missing in cells.failed.values() for cell in missing):
        lost[j, i] = False
    if lost.any():
        text = f"SATURATED: every pixel that counts saturates in {lost.sum()} of {lost.size} cells: no number there."
        messages.append(Message(text, SATURATED))
    missing = np.isnan(probability) & ~np.isnan(closed_form)
    for statistic, cells_without in zip(run.statistics, missing, strict=True):
        if cells_without.any():
            messages.append(Message(
                f"NO THRESHOLD: in {cells_without.sum()} of {cells_without.size} cells no threshold of {statistic} has "
                f"a false-alarm probability of {run.fap:g}, because one value is more probable, as saturated pixels "
                "give it: no number there; `mauvecl detect` names the probabilities that thresholds have.",
                "no threshold",
            ))  # fmt: skip
    for reason, failed in cells.failed.items():
        messages.append(Message(f"NO ANSWER in {len(failed)} of {number_of_cells} cells: {reason}.", "no answer"))
    marginalised = "" if study.nuisances.none else "marginalised over unknowns, "
    lowered = Counter(statistic for statistic, *_ in cells.lowered)
    for statistic in (name for name in run.statistics if lowered[name]):
        messages.append(Message(
            f"WRONG SIGN: {marginalised}{statistic} falls with the flare in {lowered[statistic]} of {number_of_cells} "
            "cells, and only higher values are alarms: its detection probability says nothing about the flare there.",
            "wrong sign",
        ))  # fmt: skip
    messages += worst_first([*collect_messages(cells.quiet, study.processes), *cells.saturated])
    # What unknowns cost in the middle of the map.
    middle = cells.x[len(cells.x) // 2], cells.y[len(cells.y) // 2]
    cell, axes = _cell(case, *middle), zip(study.map.axes, middle, strict=True)
    values_of_axes = " and ".join(f"{axis.quantity.replace('_', ' ')} {_shown(value)}" for axis, value in axes)
    name, comparison = f"the cell of {values_of_axes}", study.run.comparison()
    cost = forms.unknown_cost(name, cell.quiet, cell.flares[0], study.nuisances, comparison)
    return [*messages, *forms.unknown_lines([cost], study.nuisances)]


def magnitudes_of(case: Case) -> Axis:
    """Return the magnitudes over which a star's flares are lost, by the closed form.

    They reach from where the least visible flare of the vertical axis is detected, or the star's brightest pixel
    saturates, to where the most visible one hardly is.
    """
    question, statistics = case.study.map, case.study.run.statistics
    statistic = RECOMMENDED if RECOMMENDED in statistics else statistics[0]
    values, powers = question.y.points(), (*question.contours, 0.5)
    ends, saturating, faint = list[float](), list[float](), SEARCH["magnitude"][0]
    for value in values if isinstance(values[0], str) else (values[0], values[-1]):
        for power in (min(powers), max(powers)):
            question_of_power = case.with_sections(limit=LimitQuestion(of="magnitude", power=power))
            search = LimitSearch(question_of_power.with_value(question.y.quantity, value), statistic)
            quiet = search.scaled(MIDDLE)[0]
            star = quiet.gain_dn_per_electron * quiet.source_electrons
            room = quiet.ceiling_dn - (quiet.mean_raw_dn - star)
            # Pixels that their dark current alone saturates have no room, whatever the magnitude.
            brightest = np.max(star[room > 0] / room[room > 0], initial=0.0)
            saturating.append(MIDDLE + (2.5 * float(np.log10(brightest)) if brightest > 0 else 0.0))
            try:
                ends.append(search.root())
            except InputError:
                # The flare is detected on the faintest star, or not even on one that saturates.
                ends.append(faint if search.theory(faint) >= power else saturating[-1])
    for step in STEPS:
        low = max(np.floor(min(ends) / step), np.ceil(max(saturating) / step))
        high = np.ceil(max(ends) / step)
        if high - low < MOST_MAGNITUDES:
            break
    high = max(high, low + 1)
    start, stop = (round(float(end * step), 2) for end in (low, high))
    return Axis(quantity="magnitude", start=start, stop=stop, steps=int(high - low) + 1)


def _shown(value: float | str) -> str:
    """Format a value of an axis."""
    return value if isinstance(value, str) else f"{value:.4g}"


@dataclass(eq=False)
class MapCells:
    """Cells of a map, and what their computation finds for messages."""

    x: tuple[float | str, ...]
    y: tuple[float | str, ...]
    engine: Engine | Pool
    progress: Callable[[int], None]  # called with the number of cells that are done, of all maps
    done: int = 0
    quiet: list[Expectation] = field(default_factory=list)
    saturated: list[str] = field(default_factory=list)  # messages on flares that saturate
    # Weighted sums that flares lower: the statistic and the indices of the cell.
    lowered: set[tuple[str, int, int]] = field(default_factory=set)
    # Indices of the cells without an answer by the reason; several draws of unknown values may lack that of one cell.
    failed: defaultdict[str, set[tuple[int, int]]] = field(default_factory=lambda: defaultdict(set))

    def map_of(self, case: Case) -> Float:
        """Compute the map on the instrument of a case, shape (n_number, n_statistic, n_y, n_x)."""
        values = np.full((len(NUMBERS), len(case.study.run.statistics), len(self.y), len(self.x)), np.nan)

        def filled(cells: list[tuple[int, int]]) -> tuple[Expectation, int, list[str]]:
            group = [_cell(case, self.x[i], self.y[j]) for i, j in cells]
            quiet, flares = group[0].quiet, group[0].expect(*(cell.flaring(cell.amplitudes[0]) for cell in group))
            if not quiet.saturated.all():
                try:
                    self._fill(values, cells, group[0], flares)
                except InputError as error:
                    # Too few pixels may be left in some cells; the others have an answer.
                    self.failed[str(error)].update(cells)
                    if len(self.failed[str(error)]) == len(self.x) * len(self.y):
                        raise
            return quiet, len(cells), of_kind(collect_messages(flares), SATURATED)

        # Cells (i, j) in groups that share a quiescent star.
        flare_x, flare_y = (axis.quantity in OF_FLARE for axis in case.study.map.axes)
        groups = defaultdict[tuple[int, int], list[tuple[int, int]]](list)
        for j, i in np.ndindex(len(self.y), len(self.x)):
            groups[0 if flare_x else i, 0 if flare_y else j].append((i, j))
        for quiet, count, texts in map_in_order(self.engine, filled, list(groups.values())):
            self.quiet.append(quiet)
            self.saturated.extend(texts)
            self.done += count
            self.progress(self.done)
        return values

    def _fill(self, values: Float, cells: list[tuple[int, int]], case: Case, flares: list[Expectation]) -> None:
        """Compute cells that share the quiescent star of a case."""
        run = case.study.run
        result = self.engine.detect(case.quiet, flares, seed=run.seed, **case.detect_options())
        ideal = forms.ideal_chances(case, flares, [result.statistic(name) for name in run.statistics])
        for s, statistic in enumerate(run.statistics):
            probabilities = result.detection_probability(run.fap, statistic)
            for k, ((i, j), p) in enumerate(zip(cells, probabilities, strict=True)):
                limit = result.closed_form(statistic, template=k).isf(run.fap)
                chance = np.nan if k in result.blinding else result.closed_form(statistic, k).sf(limit)
                values[:, s, j, i] = p.value, p.low, p.high, chance, np.nan if ideal is None else ideal[k, s]
                if result.fall(statistic, k):
                    self.lowered.add((statistic, i, j))


def _cell(case: Case, x: float | str, y: float | str) -> Case:
    """Return the case of a cell."""
    across, along = case.study.map.axes
    return case.with_value(across.quantity, x).with_value(along.quantity, y)
