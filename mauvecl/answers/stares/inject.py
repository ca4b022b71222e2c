"""Completeness of a search for flares over size and half-width, and the accuracy of fits, from injected flares."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.answers.answer import Answer, InCell
from mauvecl.answers.neighbour_list import share_columns
from mauvecl.detection.distributions import Interval
from mauvecl.device.stare_engine import Stares
from mauvecl.flares.stare_scene import Arrays
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.messages import Message
from mauvecl.schema.physical import DAY_S
from mauvecl.schema.tables import INTERVAL, Column, View, interval, number, percent, stacked, table_of
from mauvecl.search.completeness import InjectedCompleteness
from mauvecl.search.false_alarms import CountedRate, consecutive_alarm_rate, sampled_rate
from mauvecl.search.injections import FitAccuracy, Injections, Refit
from mauvecl.study.cases import Case, cases
from mauvecl.study.labels import place_columns
from mauvecl.study.messages import collect_messages
from mauvecl.study.stare_expectation import orbit_lines, threshold_line
from mauvecl.study.study import Study
from mauvecl.study.surveys import Sizes, StarSurvey, injected_sizes, survey_star

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.flares.stare_scene import StaresRequest
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.assumptions import Use

Float = NDArray[np.float64]

#: Powers at which limits are given.
POWERS = (0.5, 0.9)
#: Units of sizes, in astropy's notation.
SIZE_UNITS = {"amplitude": "", "duration": "s", "energy": "erg", "band_energy": "erg"}
#: Difference between drawn and expected alarms that is reported, in standard errors.
DIFFERS = 4.0
#: Probability of the observed number of alarms below which it is reported as too large.
LEAST_CHANCE = 1e-5


def limit_columns(of: str) -> tuple[Column, ...]:
    """Return the columns of the table of limits of a kind of size."""
    unit, columns = SIZE_UNITS[of], list[Column]()
    size, ends = (percent(".4g"), interval(".4g", 100)) if of == "amplitude" else (".4g", interval(".4g"))
    for power in POWERS:
        name = f"e{100 * power:.0f}"
        columns += [
            Column(name, "", unit, f"{of} at which the completeness is {power:g}", name.upper(), size),
            Column(f"{name}_low", "", unit, "its 95 % interval, lower end", INTERVAL, ends,
                   (f"{name}_high",)),
            Column(f"{name}_high", "", unit, "its 95 % interval, upper end"),
        ]  # fmt: skip
    return (
        Column("half_width", "", "s", "half-width of the injected flares; NaN for all of them alike", "half-width (s)",
               number(".4g", "all")),
        *columns,
        Column("never", "", "", "share of flares for which no template fits into what is observed", "no template fits",
               percent(".3g")),
    )  # fmt: skip


def cell_columns(of: str) -> tuple[Column, ...]:
    """Return the columns of the table of completeness over half-width and a kind of size."""
    text = "their amplitude: relative rise of the photons in the flare's band"
    return (
        Column("half_width", "", "s", "half-width of the injected flares"),
        Column("size", "", SIZE_UNITS[of], f"{of} of the injected flares"),
        Column("amplitude", "", "", text),
        Column("completeness", "", "", "share of injected flares that the search finds"),
        Column("completeness_low", "", "", "its 95 % interval, lower end"),
        Column("completeness_high", "", "", "its 95 % interval, upper end"),
        Column("injections", "", "", "number of injected flares"),
    )


#: Columns of the table of searches.
SEARCH_COLUMNS = (
    Column("threshold", "threshold.value", "", "S/N from which on a template is an alarm", "threshold", ".3f"),
    Column("threshold_low", "threshold.low", "", "its 95 % interval, lower end", INTERVAL, interval(".3f"),
           ("threshold_high",)),
    Column("threshold_high", "threshold.high", "", "its 95 % interval, upper end"),
    Column("checked_at", "checked", "", "S/N at which drawn stares are held against normal noise",
           "alarms a day above", ".2f"),
    Column("alarms_sampled", "asked", "", "false alarms per star-day there, normal noise", "sampled", ".3g"),
    Column("alarms_simulated", "simulated.value", "", "false alarms per star-day there, drawn stares", "drawn", ".3g"),
    Column("alarms_low", "simulated.low", "", "lower end: 4 standard errors"),
    Column("alarms_high", "simulated.high", "", "upper end: 4 standard errors"),
    Column("alarmed", "", "", "drawn stares with a false alarm at the threshold"),
    Column("alarmed_expected", "expected", "", "how many should have one"),
    Column("in_a_row", "", "", "false alarms per star-day of the common rule, white noise"),
    Column("templates", "surveyed.survey.search.n_filters", "", "templates of the bank", "templates"),
    Column("sums", "surveyed.survey.components.n_statistics", "", "weighted sums of a frame", "sums of a frame"),
    Column("spectral_loss", lambda one: float(one.surveyed.templates.loss.max()), "",
           "largest share of S/N lost because only these sums are searched"),
    Column("star_days", lambda one: one.surveyed.survey.stare.observed_s / DAY_S, "", "star-days of a stare"),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class StarCompleteness(InCell):
    """Completeness at one star in one cell of the sweep."""

    surveyed: StarSurvey
    sizes: Sizes
    threshold: Interval
    # False alarms per star-day of drawn stares at `checked`, with 4 standard errors; NaN if none are drawn.
    simulated: Interval
    asked: float  # the same by importance sampling
    checked: float  # value that the maximum of a few stares in ten exceeds
    alarmed: int  # drawn stares with an alarm at the threshold
    expected: float  # their expected number; NaN if none are drawn
    shifted: bool  # whether the threshold is raised for trends that the search does not remove
    saturates: float  # amplitude at which flares saturate a used pixel, which injections ignore
    in_a_row: float  # false alarms per star-day of the conventional rule in white noise
    injected: InjectedCompleteness
    fitted: FitAccuracy | None

    @property
    def limits(self) -> QTable:
        """Sizes of which 50 % and 90 % are found, for all half-widths together and for each."""
        injected = self.injected
        every = (None, *range(len(injected.half_widths_s)))
        values = {"half_width": np.array([np.nan, *injected.half_widths_s])}
        for power in POWERS:
            name = f"e{100 * power:.0f}"
            limits = np.array([astuple(injected.limit(power, k)) for k in every]).T
            values |= dict(zip((name, f"{name}_low", f"{name}_high"), limits, strict=True))
        values["never"] = np.array([injected.never(k) for k in every])
        return table_of(limit_columns(self.sizes.of), [values])

    @property
    def cells(self) -> QTable:
        """Completeness at each half-width and size, and how well the flares are recovered."""
        injected = self.injected
        d, s = (index.ravel() for index in np.indices((len(injected.half_widths_s), len(injected.sizes))))
        values = {
            "half_width": np.array(injected.half_widths_s)[d],
            "size": injected.sizes[s],
            "amplitude": injected.amplitudes[d, s],
            "completeness": injected.completeness[d, s],
            "completeness_low": injected.completeness_low[d, s],
            "completeness_high": injected.completeness_high[d, s],
            "injections": np.full(d.size, injected.count),
        }
        columns = cell_columns(self.sizes.of)
        if self.fitted is not None:
            columns = (*columns, *FitAccuracy.COLUMNS)
            values |= {one.name: one.value(self.fitted)[d, s] for one in FitAccuracy.COLUMNS}
        return table_of(columns, [values])

    @property
    def messages(self) -> list[str]:
        """Messages on stares whose false-alarm rate differs from that of normal noise, and on saturated flares."""
        messages: list[str] = []
        if not np.isnan(self.simulated.value) and not self.simulated.low <= self.asked <= self.simulated.high:
            text = (
                f"FALSE ALARMS of {self.title} are not those of normal noise: {self.simulated.value:.3g} per star-day "
                f"at {self.checked:.2f} in drawn stares, {self.asked:.3g} by importance sampling: the search does not "
                "marginalise over what changes in the stare (see [search] frame, cycle, window_s), or set "
                'search.null = "counted".'
            )
            messages.append(Message(text, "false alarms"))
        # The probability of at least this many alarms if the expected number is right.
        if scipy.special.gammainc(max(self.alarmed, 1e-300), self.expected) < LEAST_CHANCE:
            text = (
                f"FALSE ALARMS of {self.title} exceed the requested rate: {self.alarmed} of the drawn stares have "
                f"one at the threshold, {self.expected:.2g} should: set search.null = 'counted' with more search.nulls."
            )
            messages.append(Message(text, "false alarms"))
        if self.shifted:
            messages.append(threshold_line(self.title, self.threshold.value))
        if self.injected.amplitudes.max() > self.saturates:
            text = (
                f"SATURATED: flares of {self.title} with an amplitude above {self.saturates:.3g} saturate a pixel, "
                "which injections leave out."
            )
            messages.append(Message(text, "saturated"))
        return messages


@dataclass(eq=False)
class InjectAnswer(Answer):
    """The answer of `mauvecl inject`."""

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "flare", "processes", "stare", "seed")

    study: Study
    stars: list[StarCompleteness]
    messages: list[str] = field(default_factory=list)

    @cached_property
    def table(self) -> QTable:
        """Sizes E50 and E90: per star and cell of the sweep, one row for all half-widths and one for each."""
        return stacked(self._place, ((one, one.limits) for one in self.stars), **self._about)

    @cached_property
    def completeness(self) -> QTable:
        """One row per star, cell of the sweep, half-width and size."""
        return stacked(self._place, ((one, one.cells) for one in self.stars), **self._about)

    @cached_property
    def search(self) -> QTable:
        """One row per star and cell of the sweep: thresholds, false alarms."""
        return table_of((*self._place, *SEARCH_COLUMNS), self.stars, **self._about)

    @property
    def _place(self) -> tuple[Column, ...]:
        """Columns of the star, the sweep and the dilution."""
        share = share_columns(self.study.has_neighbours, "surveyed.quiet.target_share")
        return (*place_columns(self.study.sweep), *share)

    @property
    def views(self) -> list[View]:
        choice = self.study.search
        alarms = "false alarm" if choice.false_alarms == 1 else "false alarms"
        title = f"The search: {choice.false_alarms:g} {alarms} per star-{choice.per} of frames"
        limits = []
        for one in self.stars:
            unit = f" ({SIZE_UNITS[one.sizes.of]})" if SIZE_UNITS[one.sizes.of] else ""
            found = f"{one.title}: {one.sizes.of}{unit} of which a half (E50) and nine tenths (E90) are found"
            limits.append(View(found, limit_columns(one.sizes.of), one.limits))
        return [View(title, (*self._place, *SEARCH_COLUMNS), self.search), *limits]

    @property
    def _about(self) -> dict[str, object]:
        choice = self.study.search
        return {
            "false_alarms": f"{choice.false_alarms:g} per star-{choice.per}",
            "flare": f"{self.study.flare.light().describe()}, {choice.shape}, amplitudes in {self.study.flare.band}",
            "study": self.study.text(),
        }

    @property
    def tables(self) -> dict[str, Table]:
        """Limits, completeness of every cell, thresholds."""
        return {"limits": self.table, "completeness": self.completeness, "search": self.search}

    @property
    def inputs(self) -> list[Expectation]:
        return [star.surveyed.quiet for star in self.stars]


@validated
def inject(
    study: Study, engine: Stares | Pool | None = None, progress: Callable[[int, int], None] | None = None
) -> InjectAnswer:
    """Compute the completeness of a study's search for every star and sweep value.

    Parameters
    ----------
    study : Study
    engine : Stares or Pool, optional
        Simulator; by default that of the default device.
    progress : callable, optional
        Called as ``progress(done, total)`` in injections; may raise to stop the work.
    """
    idle = next((axis.quantity for axis in study.sweep.axes if axis.quantity in ("amplitude", "exposure")), None)
    if idle is not None:
        raise InputError(
            f"the sweep has the quantity {idle!r}, which injections have none of", "another", key="sweep", value=idle
        )
    engine = engine or Stares()
    prepared = cases(study)
    for case in prepared:
        # Raise InputError for energies of stars of unknown size before the first search.
        Sizes.chosen(case)
    q = study.injections
    each = q.count * q.sizes * q.widths
    answer = InjectAnswer(study, [])
    for done, case in enumerate(prepared):

        def report(part: float, done: int = done) -> None:
            if progress is not None:
                progress(round((done + part) * each), len(prepared) * each)

        report(0.0)
        answer.stars.append(_completeness(case, engine, report))
    report(1.0)
    answer.messages = [
        *(text for star in answer.stars for text in star.messages),
        *collect_messages(answer.inputs),
        *orbit_lines(study.stare, study.orbit, prepared[0].instrument.frame_s),
    ]
    return answer


def _completeness(case: Case, engine: Stares | Pool, report: Callable[[float], None]) -> StarCompleteness:
    """Inject flares into the stare of a case and search for them; `report` receives the share that is done."""
    choice, asked, seed = case.study.search, case.study.injections, case.study.run.seed
    processes = case.study.processes.additive_only
    known = survey_star(case)
    survey = known.survey
    drawn = None
    if choice.nulls:
        maxima = _reduced(engine, survey.largest_value_request(choice.nulls, seed, processes))["maximum"]
        drawn = CountedRate(np.sort(maxima), survey.stare.observed_s / DAY_S)
    tail = sampled_rate(survey, seed)
    threshold = (
        tail.threshold(choice.rate) if choice.null == "sampled" or drawn is None else drawn.threshold(choice.rate)
    )
    sizes = Sizes.chosen(case)
    values = injected_sizes(case, sizes, known.unit_snr, threshold.value)
    positions = min(asked.positions, asked.count)
    injections = Injections(
        survey, 0, asked.half_widths_s, threshold.value, seed, positions, -(-asked.count // positions), processes
    )
    widths = np.array(injections.half_widths_s)
    amplitudes = np.asarray(sizes.amplitude(values[None], widths[:, None]))
    refit = Refit(known.fit, amplitudes, case.study.flare.temperature_k, -(-asked.fitted // positions))

    def at_one_peak(position: int) -> Arrays:
        return _reduced(engine, injections.request(position, refit if refit.count else None))

    parts: list[Arrays] = []
    for part in map_in_order(engine, at_one_peak, range(positions)):
        parts.append(part)
        report(len(parts) / positions)
    critical = np.stack([part["critical"].T for part in parts], axis=1)
    # The comparison with drawn stares has most power where a few in ten have an alarm.
    checked, likely, error = tail.likely
    simulated, expected = _checked(drawn, checked, likely, error, survey.stare.observed_s / DAY_S / tail.days)
    alarmed = 0 if drawn is None else int(np.sum(drawn.maxima >= threshold.value))
    should = float("nan") if drawn is None else drawn.maxima.size * -np.expm1(-choice.rate * drawn.days)
    return StarCompleteness(
        case.label,
        case.at,
        known,
        sizes,
        threshold,
        simulated,
        expected,
        checked,
        alarmed,
        float(should),
        tail.shifted and choice.null == "sampled",
        injections.saturates,
        consecutive_alarm_rate(choice.points, choice.sigma, survey.stare.frame_s),
        InjectedCompleteness(
            injections.half_widths_s, values, amplitudes, sizes.of_amplitude(critical, widths[:, None, None])
        ),
        FitAccuracy.of(parts) if refit.count else None,
    )


def _reduced(engine: Stares | Pool, request: StaresRequest) -> Arrays:
    return engine.stares(request) if isinstance(engine, Pool) else engine.reduced(request)


def _checked(
    drawn: CountedRate | None, value: float, probability: float, error: float, longer: float
) -> tuple[Interval, float]:
    """Return false alarms per star-day of drawn stares at a value, within 4 standard errors, and the expected rate."""
    if drawn is None:
        return Interval(np.nan, np.nan, np.nan), float("nan")
    n = drawn.maxima.size
    # Drawn stares may be longer than those of importance sampling.
    none = (1 - probability) ** longer
    reach = DIFFERS * np.hypot(np.sqrt(none * (1 - none) / n), longer * none / (1 - probability) * error)
    p = float(np.mean(drawn.maxima >= value))
    with np.errstate(divide="ignore"):
        ends = [-np.log1p(-np.clip(x, 0.0, 1.0)) / drawn.days for x in (p, p - reach, p + reach)]
        return Interval(*(float(x) for x in ends)), float(-np.log(none) / drawn.days)
