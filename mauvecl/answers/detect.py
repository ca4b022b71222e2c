"""Detection of flares: probabilities at a fixed rate of false alarms, with unknowns of the instrument."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from operator import attrgetter, methodcaller
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers import closed_forms as forms
from mauvecl.answers.answer import IF_KNOWN, Answer, StarInCell, TableOf, name_of_instrument, reported, share_column
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.detection import RECOMMENDED, check_fap, countable
from mauvecl.detection.chi2 import Paper
from mauvecl.detection.detection import AREA_COLUMNS, COLUMNS, DEPARTURE_COLUMNS, ROC_COLUMNS, ROC_ROWS, departure_table
from mauvecl.detection.distributions import Interval, QuadraticForm
from mauvecl.detection.nuisances import read_at_pixels
from mauvecl.detection.requests import matched_snr, shift_between
from mauvecl.detection.statistics import Linear, Matched, Setting
from mauvecl.detection.tails import campaign, per_test
from mauvecl.device.engine import Engine
from mauvecl.host.arrays import Float
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.columns import Column, View, chance_range, chance_text
from mauvecl.schema.errors import InputError, Message, counted
from mauvecl.study.cases import Case, amplitude_column, cases, collect_messages
from mauvecl.study.study import PAPER_STARS, Study

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.detection.detection import Detection
    from mauvecl.host.exposure.expectation import Expectation

#: Largest number of rows of the tables of ROC curves and extremes, divided among flares.
MOST_ROWS = 100_000


@dataclass(frozen=True, eq=False)
class StarDetection(StarInCell):
    """Detection of the flares of a star in a cell of the sweep."""

    amplitudes: tuple[float, ...]
    detection: Detection
    #: Closed-form chances if everything but the noise were known, shape (n_flare, n_statistic); None if it is known.
    ideal: Float | None = None


def _detection_columns(answer: DetectAnswer) -> tuple[Column, ...]:
    """Return the columns of `DetectAnswer.table`, with the ideal probability next to the detection probability."""
    amplitude = amplitude_column(
        lambda star: np.repeat(star.amplitudes, len(star.detection.statistics)),
        f"relative rise of the photons in the band {answer.study.flare.band}",
    )
    after_interval = [column.name for column in COLUMNS].index("high") + 1
    share = share_column("detection.quiet.target_share")
    return (share, amplitude, *COLUMNS[1:after_interval], forms.IDEAL, *COLUMNS[after_interval:])


def _rows_of(star: StarDetection, fap: float) -> QTable:
    """Return the table of a star's detection with the ideal probabilities, if it has any."""
    table = star.detection.table(fap)[[column.name for column in COLUMNS[1:]]]
    if star.ideal is not None:
        table.add_column(star.ideal.ravel(), name=forms.IDEAL.name, index=table.colnames.index("high") + 1)
        table[forms.IDEAL.name].info.description = forms.IDEAL.description
    return table


#: Columns of a statistic and of the flare that it looks at, before those of its curve or its extremes.
FLARE_COLUMNS = (Column("statistic", description="detection statistic"), amplitude_column())
TEMPLATE_COLUMN = Column("template", description="amplitude of the flare that the statistic looks for")


def chance_of_flare(study: Study, star: str, amplitude: float, quiet: Expectation, chance: str) -> str:
    """Return the sentence on the chance that a flare is seen, without what follows it."""
    saturated, without = int(quiet.saturated.sum()), ""
    if saturated:
        lost = f"{saturated} of {quiet.saturated.size} pixels that saturate"
        without = f", without the {lost} in a frame of more than {quiet.longest_safe_frame_s:.3g} s"
    flare = f"{name_of_instrument(study)} would see a flare of {100 * amplitude:g} % on {star}"
    return f"{flare} in {quiet.exposure_s:g} s with a chance of {chance}{without}"


@dataclass(eq=False)
class DetectAnswer(Answer):
    """Answer of `detect`: thresholds and probabilities, departures from closed forms, ROC curves and extreme values."""

    USES = ("instrument", "sky", "flare", "processes", "nuisances", "seed", "sweep")

    study: Study
    stars: list[StarDetection]  # one per star and cell of the sweep
    messages: list[str] = field(default_factory=list)  # messages for users, the most severe first
    paper: list[str] = field(default_factory=list)  # comparison with the paper's values, if the study has its G2V star

    #: One row per star, cell, flare and statistic.
    table = TableOf(
        "detection", _detection_columns, "stars", by_star=True, key="rows",
        row_table=lambda answer, star: _rows_of(star, answer.study.run.fap),
    )  # fmt: skip
    #: One row per star, cell and statistic, and per flare for shaped statistics; see `Departure`. The table is empty if
    #: thresholds are not counted.
    departures = TableOf(
        "departures", DEPARTURE_COLUMNS, "stars", by_star=True, key="departures",
        row_table=lambda answer, star: departure_table(star.detection, star.amplitudes, answer.study.run.fap),
    )  # fmt: skip
    #: All receiver operating characteristics with their areas; see `Roc`. Many flares share `MOST_ROWS` rows, so that
    #: each curve has fewer than its 200.
    roc = TableOf(
        "roc", (*FLARE_COLUMNS, *ROC_COLUMNS, *(column.of_part("roc") for column in AREA_COLUMNS)), "_curves",
        by_star=True, meta=("study.run.realisations", "study"),
    )  # fmt: skip
    #: The extremes of every null (amplitude 0) and flare, with their realisations. Many flares share `MOST_ROWS` rows,
    #: so that each distribution has fewer than its 1000.
    tails = TableOf("tails", (*FLARE_COLUMNS, TEMPLATE_COLUMN), "_extremes", row_table=lambda _, row: row["tail"],
                    by_star=True, meta=("study.run.seed", "study"))  # fmt: skip

    @property
    def headline(self) -> str:
        """The chance of the flare whose detection is least certain, by the recommended statistic if it is computed."""
        statistics = self.stars[0].detection.statistics
        statistic = RECOMMENDED if RECOMMENDED in statistics else statistics[0]
        rows = self.table[self.table["statistic"] == statistic]
        chances = np.asarray(rows["probability"])
        known = int(np.isfinite(chances).sum())
        if not known:
            never = f"no threshold has a false-alarm probability of {self.study.run.fap:g}"
            why = never if np.isnan(rows["threshold"]).any() else "every pixel saturates"
            return f"{self.instrument_name} would see none of these flares: {why}."
        index = int(np.nanargmin(np.abs(chances - 0.5)))
        row, star = rows[index], self.stars[index // len(self.stars[0].amplitudes)]
        ideal = f"; {chance_text(row['ideal'])} {IF_KNOWN}" if "ideal" in rows.colnames else ""
        least = f", the least certain of {known} flares" if known > 1 else ""
        chance = f"{chance_text(row['probability'])} ({chance_range(row['low'], row['high'])}{ideal})"
        sentence = chance_of_flare(self.study, star.subject, row["amplitude"], star.detection.quiet, chance)
        return f"{sentence}{least}."

    @property
    def views(self) -> list[View]:
        run, quiet = self.study.run, [star.detection.quiet for star in self.stars]
        frames = {x.exposure_s: "1 frame" if x.n_frames == 1 else f"{x.n_frames} frames" for x in quiet}
        exposures = " and ".join(f"{exposure_s:g} s ({text})" for exposure_s, text in frames.items())
        exposure = f"{exposures}, {run.realisations:,} realisations"
        title = f"Detection at a false-alarm probability of {run.fap:g} per test, {exposure}"
        detected = DetectAnswer.table.view(self, title)
        if not len(self.departures):
            return [detected]
        differing = self.departures[self.departures["differs"]]
        if len(differing):
            threshold = f"false-alarm probability at the threshold that should give {run.fap:g}"
            title = f"Where the simulation differs from the closed form: {threshold}"
            return [detected, DetectAnswer.departures.view(self, title, differing)]
        line = (
            f"At the thresholds for Gaussian noise the simulated false-alarm probability is {run.fap:g} within 4 "
            "standard errors, for every statistic."
        )
        return [detected, View(line)]

    @property
    def _curves(self) -> Iterator[dict[str, Any]]:
        """Rows of `roc`, each with all points of a curve."""
        n_points = min(ROC_ROWS, self._row_limit(1))
        for star in self.stars:
            for statistic, (flare, amplitude) in product(star.detection.statistics, enumerate(star.amplitudes)):
                roc = star.detection.roc(statistic, flare)
                yield vars(star) | {"statistic": statistic, "amplitude": amplitude, "roc": roc} | roc.points(n_points)

    @property
    def _extremes(self) -> Iterator[dict[str, Any]]:
        """Rows of `tails`, each with the extremes of a distribution."""
        n_values = self._row_limit(2)
        for star in self.stars:
            detection = star.detection
            for statistic, (flare, template) in product(detection.statistics, enumerate(star.amplitudes)):
                samples = [(template, detection.tail_samples(statistic, flare))]
                if detection.statistic(statistic).shaped or flare == 0:
                    samples.append((0.0, detection.tail_samples(statistic, template=flare)))
                for amplitude, tail in samples:
                    yield vars(star) | {"statistic": statistic, "amplitude": amplitude, "template": template,
                                        "tail": tail[:n_values]}  # fmt: skip

    def _row_limit(self, n_tables: int) -> int:
        """Return the number of rows of each curve or distribution, of which flares and statistics have `n_tables`."""
        number = sum(len(star.detection.statistics) * len(star.amplitudes) for star in self.stars)
        return max(MOST_ROWS // (n_tables * number), 2)

    @property
    def inputs(self) -> list[Expectation]:
        return [x for star in self.stars for x in (star.detection.quiet, *star.detection.flares)]

    @property
    def remarks(self) -> list[str]:
        """The comparison with the paper's values."""
        return self.paper

    def as_json(self) -> dict[str, Any]:
        return {"paper": self.paper} | super().as_json()


@by_keywords("stars")
def detect(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> DetectAnswer:
    """Simulate the detection of every flare of a study, for every star and sweep value.

    The study's ``run`` gives statistics, false-alarm probability and realisations. Raises InputError if these are too
    few to count the thresholds, unless ``run.tails`` allows for importance sampling.

    Examples
    --------
    >>> from mauvecl import detect
    >>> answer = detect(star="G2V", magnitude=7.4, amplitude=0.24, exposure=50, realisations=100_000)
    >>> answer.headline.partition(" with ")[0]
    'Mauve would see a flare of 24 % on G2V V = 7.4 in 50 s'
    """
    # Invalid input raises an error before anything is drawn.
    run = study.run
    check_fap(run.fap, run.realisations, run.tails)
    prepared = cases(study)
    campaigns = [text for case in prepared for text in _campaign(case)]
    engine = engine or Engine()

    def detected(case: Case) -> StarDetection:
        nm = case.quiet.wavelength_nm
        linear = [Linear(name, read_at_pixels("weights", name, path, nm)) for name, path in run.weights.items()]
        # Matched statistics that search for flares of other temperatures than the study's.
        setting = Setting(case.quiet, ~case.quiet.saturated, run.comparison())
        for kelvin in run.template_temperatures_k:
            (shape,) = case.expect(case.with_value("flare_temperature", kelvin).flaring(case.amplitudes[0]))
            linear.append(Linear(f"matched {kelvin:g} K", Matched().weights_per_dn(setting, shape)))
        options = case.detect_options() | {"statistics": (*run.statistics, *linear)}
        detection = engine.detect(case.quiet, case.flares, seed=run.seed, **options)
        statistics = [detection.statistic(name) for name in detection.statistics]
        return StarDetection(
            case.label, case.at, case.amplitudes, detection, forms.ideal_chances(case, case.flares, statistics)
        )

    if isinstance(engine, Pool):
        engine.expect(len(prepared) * run.realisations)
    stars: list[StarDetection] = []
    paper: list[str] = []
    for star in reported(map_in_order(engine, detected, prepared), len(prepared), progress):
        if not stars:
            # Meanwhile, the devices count the next star.
            paper = _paper(prepared)
        stars.append(star)
    answer = DetectAnswer(study, stars, paper=paper)
    answer.messages = list(dict.fromkeys(_messages(answer, prepared, campaigns)))
    return answer


def _messages(answer: DetectAnswer, prepared: Sequence[Case], campaigns: Sequence[str]) -> list[str]:
    """Return messages on lost pixels, on thresholds, of the expectations, on campaigns, templates and unknowns."""
    study, run = answer.study, answer.study.run
    finders = attrgetter("messages"), methodcaller("without_threshold", run.fap), attrgetter("lowered")
    messages: list[str] = [
        message.about(star.title) for find in finders for star in answer.stars for message in find(star.detection)
    ]
    messages += collect_messages([x for case in prepared for x in case.expectations], study.processes)
    errors = answer.table["fap_error"][np.isfinite(answer.table["fap_error"])]
    if not countable(run.fap, run.realisations) and errors.size:
        messages.append(Message(
            f"Thresholds at a false-alarm probability of {run.fap:g} come from importance sampling, right to "
            f"{100 * errors.max():.1f} % of it: {run.realisations} realisations leave fewer than 100 beyond them.",
            "sampled",
        ))  # fmt: skip
    messages += campaigns
    messages += _statistic_lines(prepared, answer.stars)
    # One sentence on unknowns: their effect on the chance, or on the S/N where they are taken into account.
    chance, costs = forms.chance_with_unknowns(prepared), list[forms.Cost]()
    for case in prepared if not chance else ():
        for amplitude, flare in zip(case.amplitudes, case.flares, strict=True):
            name = f"{case.label}, flare of {100 * amplitude:g} %"
            costs.append(forms.unknown_cost(name, case.quiet, flare, study.nuisances, run.comparison()))
    return [*messages, *forms.unknown_lines(costs, study.nuisances), *chance]


def _statistic_lines(prepared: Sequence[Case], stars: Sequence[StarDetection]) -> list[str]:
    """Return sentences on S/N lost to templates of another temperature, and on squares of the paper's sum, if any."""
    lines, terms = list[str](), list[float]()
    for case, star in zip(prepared, stars, strict=True):
        detection, light = star.detection, case.study.flare.light().describe()
        for kelvin in case.study.run.template_temperatures_k:
            right, name = matched_snr(detection.setting, detection.flares[0]), f"matched {kelvin:g} K"
            share = shift_between(detection.closed_form(name), detection.closed_form(name, 0)) / right if right else 0.0
            text = f"keeps {100 * share:.1f} % of the matched statistic's S/N"
            lines.append(f"{star.label}: looking for a flare of {kelvin:g} K in one of {light} {text}.")
        for k in range(len(star.amplitudes) if "paper" in detection.statistics else 0):
            form = detection.closed_form("paper", template=k)
            terms += [form.effective_terms] if isinstance(form, QuadraticForm) else []
    if terms:
        squares = " to ".join(dict.fromkeys(f"{end:.1f}" for end in (min(terms), max(terms))))
        lines.append(
            f"The paper's sum over {stars[0].detection.dof('paper')} pixels scatters like one of {squares} independent "
            "squares: its faintest pixels make most of it."
        )
    return lines


def _campaign(case: Case) -> list[str]:
    """Return sentences on the false alarms of a study's campaign, if any, and on the probability per test it wants."""
    question, run, stack = case.study.campaign, case.study.run, case.quiet.n_frames
    if question.frames is None:
        return []
    chances = campaign(run.fap, question.frames, stack, step=question.step, seed=run.seed)

    def overlap(interval: Interval | None, before: str, after: str = "") -> str:
        if interval is None:
            return ""
        ends = f"[{interval.low:.3g}, {interval.high:.3g}]"
        return f"{before} with the overlap of its stacks {interval.value:.3g} {ends}{after}"

    tests, count = chances.tests, counted(chances.tests, "test")
    lines = [
        f"A campaign of {counted(question.frames, 'frame')} makes {count}: at {run.fap:g} per test "
        f"{tests * run.fap:.3g} false alarms are expected, and the chance of any is {chances.independent:.3g} if tests "
        f"are independent, at most {chances.bound:.3g}{overlap(chances.overlapping, ';', ' for a linear statistic')}."
    ]
    if question.fap is not None:
        needed = per_test(question.fap, question.frames, stack, step=question.step, seed=run.seed)
        lines.append(
            f"For a chance of {question.fap:g} of any false alarm in the campaign each of its {count} may have "
            f"{needed.independent:.4g} if they are independent, {needed.bound:.4g} in any case"
            f"{overlap(needed.overlapping, ', and')}: `fap={needed.bound:.4g}`."
        )
    if question.alarms is not None:
        if not question.alarms < tests:
            raise InputError.of("campaign.alarms", question.alarms, f"fewer than the {tests} tests")
        lines.append(
            f"For {counted(question.alarms, 'false alarm', spec='g')} expected in the campaign each of its {count} may "
            f"have {question.alarms / tests:.4g} for any dependence between them: `fap={question.alarms / tests:.4g}`."
        )
    return lines


#: Chi-squared and reduced chi-squared by amplitude, for the G2V star, V = 7.4, 50 s (the paper, section "G2V star").
PAPER_G2V = {0.24: (6159.88, 3.75), 0.081: (1078.36, 0.66)}
WHY = (
    "The paper's values are no calibrated chi-squared: with 1643 points a reduced value scatters by 0.035 about one, "
    "so 0.66 lies ten standard deviations below. Divided by the smoothed flare spectrum in DN/s instead of the noise's "
    "variance they are reproduced; only its simulated null tells what such a number means (`statistic='paper'`)."
)


def _paper(prepared: Sequence[Case]) -> list[str]:
    """Return the paper's G2V values with their reconstruction, if its star is observed with its conventions.

    The paper does not define its chi-squared. Among the definitions that were tried, this one is nearest to its two G2V
    values: both noisy spectra are smoothed with a Gaussian of 10.5 nm FWHM, as stated in its figure, and compared as in
    `scipy.stats.chisquare`, with the flare's mean as expected values.
    """
    case = next((case for case in prepared if case.star == PAPER_STARS[1] and not case.at), None)
    if case is None or case.study.observation.exposure_s != 50.0 or case.study != case.study.paper():
        return []
    lines, quiet = [], case.quiet
    for amplitude, flare in zip(case.amplitudes, case.flares, strict=True):
        if amplitude not in PAPER_G2V:
            continue
        chi2, reduced = PAPER_G2V[amplitude]
        setting = Setting(quiet, np.ones(quiet.wavelength_nm.size, bool), flares=(flare,))
        form = Paper().closed_form(setting, flare, flare)
        middle, low, high = (form.isf(p) / quiet.wavelength_nm.size for p in (0.5, 0.975, 0.025))
        lines.append(
            f"G2V, {100 * amplitude:g} % flare: the paper has chi2 = {chi2:g}, reduced {reduced:g}; "
            f"reconstructed here {middle:.2f} ({low:.2f}-{high:.2f})"
        )
    return [*lines, WHY] if lines else []
