"""Injection of flares into simulated stares: completeness and accuracy of a search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from mauvecl.answers.answer import IF_KNOWN, Answer, StarInCell, TableOf, first_of_several, reported, share_column
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.detection.distributions import Interval
from mauvecl.device.stares import Stares
from mauvecl.flares.frames import Components
from mauvecl.flares.shapes import shape_of
from mauvecl.host.arrays import Arrays, Float
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.columns import INTERVAL, Column, View, interval, interval_columns, number, percent, table_of
from mauvecl.schema.errors import InputError, Message
from mauvecl.schema.fields import DAY_S
from mauvecl.search.completeness import SMALL, InjectedCompleteness, frame_signal
from mauvecl.search.false_alarms import consecutive_alarm_rate, counted_threshold, sampled_rate
from mauvecl.search.injections import ACCURACY_COLUMNS, Injections, fit_accuracy
from mauvecl.search.search import TEMPERATURES_K, Bank, Templates, frame_nuisances
from mauvecl.search.survey import Survey
from mauvecl.study.cases import Case, cases, collect_messages
from mauvecl.study.star import FlareLight
from mauvecl.study.stare import orbit_lines, threshold_line
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.flares.energies import Kind
    from mauvecl.flares.stare_scene import StaresRequest
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.stare import Size

    Reduced = Callable[[StaresRequest], Arrays]

#: Default range of injected sizes, in units of the size with a completeness of one half.
DEFAULT_RANGE = (0.3, 3.0)


def survey_star(case: Case) -> Survey:
    """Build the search of a case's stare; its only flare component is the study's flare."""
    frame, stare, choice, flare = case.one_frame, case.stare, case.study.search, case.study.flare
    electrons_of_flare = frame.flare_electrons((flare.temperature_k,))
    # Templates are blackbodies if the study's flare has no temperature to vary.
    blackbody = flare.model_copy(update={"spectrum": FlareLight()})
    hot = frame if flare.spectrum.file is None else frame.with_sections(flare=blackbody)
    quiet, electrons, used = frame.quiet, hot.flare_electrons(TEMPERATURES_K), ~frame.quiet.saturated
    nuisances = frame_nuisances(quiet, stare, choice.spreads())
    if not used.any():
        raise InputError.of("quiet", quiet.name, "a star that does not saturate every pixel")
    variance, gain = np.where(used, quiet.variance_dn2, 0.0), quiet.gain_dn_per_electron
    signal = electrons * gain * used
    templates = Templates.of(variance, signal, gain, TEMPERATURES_K, nuisances=nuisances, rank=choice.sums)
    level = choice.baseline(stare, case.study.stare.orbit_s)
    bank = Bank(
        choice.half_widths_s, templates.directions[list(templates.chosen)], shape_of(choice.shape), stare.frame_s, level
    )
    survey = Survey(Components(quiet, electrons_of_flare, templates.weights), stare, bank, templates)
    if level.cycle and not len(survey.curves):
        raise InputError("search.cycle needs an unknown cycle of the stare: stare.cycles", key="search.cycle")
    return survey


def measure_of_size(case: Case) -> tuple[Size, float]:
    """Return the measure of flare size that a study chooses, and the size of a flare of unit amplitude and 1 s.

    All but amplitudes are proportional to the half-width, too. Raises InputError for energies at an unknown size of
    the star.
    """
    measure, area = case.study.injections.of, shape_of(case.study.search.shape).equivalent_duration
    kind: Kind = "band" if measure == "band_energy" else "bolometric"
    scale = case.energy_scale(kind)
    if measure == "amplitude" or (measure is None and scale is None):
        return "amplitude", 1.0
    if measure == "duration":
        return "duration", area
    if scale is None:
        raise InputError(
            f"injections.of = {measure!r}, but the size of {case.source.name} is unknown; give the star's "
            "distance_pc, or radius_rsun and effective_temperature_k",
            key="injections.of",
        )
    return measure or "energy", area * scale.erg_per_s


def injected_sizes(case: Case, per_amplitude: Callable[[Float], Float], unit_snr: float, threshold: float) -> Float:
    """Return the sizes of injected flares, ascending; by default around a completeness of one half in the survey."""
    question = case.study.injections
    widths = np.array([question.half_width_low_s, question.half_width_high_s])
    frames = widths / case.instrument.frame_s
    # S/N of a known flare on a known baseline: (A / sigma) sqrt(square integral x half-width in frames).
    amplitude = threshold / unit_snr / np.sqrt(shape_of(case.study.search.shape).square_integral * frames)
    half = amplitude * per_amplitude(widths)
    low = DEFAULT_RANGE[0] * half.min() if question.low is None else question.low
    high = DEFAULT_RANGE[1] * half.max() if question.high is None else question.high
    if not low < high:
        raise InputError(
            f"injected sizes must rise from low to high, but run from {low:.3g} to {high:.3g}", key="injections.low"
        )
    return np.geomspace(low, high, question.sizes)


#: Completeness at which limits are given, by the names of their columns.
POWERS = {"e50": 0.5, "e90": 0.9}
#: Units of sizes, in astropy's notation.
SIZE_UNITS = {"amplitude": "", "duration": "s", "energy": "erg", "band_energy": "erg"}
#: Difference between drawn and expected alarms that is reported, in standard errors.
DIFFERS = 4.0
#: Probability of the observed number of alarms below which it is reported as too large.
LEAST_CHANCE = 1e-5

SHARE = share_column("survey.components.quiet.target_share")
SEARCH_COLUMNS = (
    SHARE,
    Column("threshold", "threshold.value", "", "S/N from which on a template is an alarm", "threshold", ".3f"),
    *interval_columns("threshold_{}", "threshold.{}", heading=INTERVAL, format=interval(".3f")),
    Column("checked_at", "checked", "", "S/N at which drawn stares are compared with normal noise",
           "alarms a day above", ".2f", detail=True),
    Column("alarms_sampled", "sampled", "", "false alarms per star-day there, normal noise", "sampled", ".3g",
           detail=True),
    Column("alarms_simulated", "simulated.value", "", "false alarms per star-day there, drawn stares",
           "drawn", ".3g", detail=True),
    *interval_columns("alarms_{}", "simulated.{}", of="their interval of 4 standard errors"),
    Column("alarmed", "", "", "drawn stares with a false alarm at the threshold"),
    Column("alarmed_expected", "expected", "", "their expected number"),
    Column("in_a_row", "", "", "false alarms per star-day of the common rule, white noise"),
    Column("templates", "survey.search.n_filters", "", "templates of the bank", "templates"),
    Column("sums", "survey.components.n_statistics", "", "weighted sums of a frame", "sums of a frame", detail=True),
    Column("spectral_loss", lambda row: float(row.survey.templates.loss.max()), "",
           "largest share of S/N lost because only these sums are searched"),
    Column("star_days", lambda row: row.survey.stare.observed_s / DAY_S, "", "star-days of a stare"),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class StarCompleteness(StarInCell):
    """Completeness at one star in one cell of the sweep."""

    survey: Survey
    size: Size  # its measure, see `measure_of_size`
    threshold: Interval
    # False alarms per star-day of drawn stares at `checked`, with 4 standard errors; NaN if none are drawn.
    simulated: Interval
    sampled: float  # the same by importance sampling
    checked: float  # value that the maximum of a few stares in ten exceeds
    alarmed: int  # drawn stares with an alarm at the threshold
    expected: float  # their expected number; NaN if none are drawn
    shifted: bool  # whether the threshold is raised for trends that the search does not remove
    saturates: float  # amplitude at which flares saturate a used pixel, which injections ignore
    in_a_row: float  # false alarms per star-day of the conventional rule in white noise
    injected: InjectedCompleteness
    fitted: dict[str, Float] | None  # see `fit_accuracy`; None if no flare is to be fitted
    # Size that is found if everything but the noise is known, over the size that is found: the inverse ratio of the S/N
    # of a frame; NaN if everything is known.
    ideal_share: float

    @property
    def limit_columns(self) -> tuple[Column, ...]:
        """Columns of `limits`; the ideal one unless everything but the noise is known."""
        of, unit, columns = self.size, SIZE_UNITS[self.size], list[Column]()
        size, ends = (percent(".4g"), interval(".4g", 100)) if of == "amplitude" else (".4g", interval(".4g"))
        for name, power in POWERS.items():
            limit = Column(name, "value", unit, f"{of} at which the completeness is {power:g}", name.upper(), size)
            around = interval_columns(f"{name}_{{}}", "{}", unit, heading=INTERVAL, format=ends, detail=power != 0.5)
            columns += [column.of_part(name) for column in (limit, *around)]
        text = "E50 if everything but the noise were known: E50 times the ratio of the S/N of a frame"
        ideal = Column("e50_ideal", lambda row: row["e50"].value * row["share"], unit, text, "ideal E50", size)
        return (
            Column("half_width", "", "s", "half-width of the injected flares; NaN for all of them alike",
                   "half-width (s)", number(".4g", "all")),
            *columns,
            Column("never", "", "", "share of flares for which no template fits into what is observed",
                   "no template fits", percent(".3g"), detail=True),
            *(() if np.isnan(self.ideal_share) else (ideal,)),
        )  # fmt: skip

    @property
    def limits(self) -> QTable:
        """Sizes of which 50 % and 90 % are found, for all half-widths together and for each."""
        rows = [
            {"half_width": half_width, "never": self.injected.never(k), "share": self.ideal_share}
            | {name: self.injected.limit(power, k) for name, power in POWERS.items()}
            for k, half_width in ((None, np.nan), *enumerate(self.injected.half_widths_s))
        ]
        return table_of(self.limit_columns, rows)

    @property
    def cells(self) -> QTable:
        """Completeness at each half-width and size, and how well the flares are recovered."""
        cell_columns = (
            Column("half_width", lambda x: np.array(x.half_widths_s)[:, None], "s", "half-width of injected flares"),
            Column("size", "sizes", SIZE_UNITS[self.size], f"{self.size} of the injected flares"),
            Column("amplitude", "amplitudes", "", "relative rise of the photons in the flare's band by them"),
            Column("completeness", "", "", "share of injected flares that the search finds"),
            *interval_columns("completeness_{}"),
            Column("injections", "count", "", "number of injected flares"),
        )
        columns = [column.of_part("injected") for column in cell_columns]
        if self.fitted is not None:
            columns += [column.of_part("fitted") for column in ACCURACY_COLUMNS]
        return table_of(columns, [self])

    @property
    def messages(self) -> list[str]:
        """Messages on stares whose false-alarm rate differs from that of normal noise, and on saturated flares."""
        messages: list[str] = []
        if not np.isnan(self.simulated.value) and not self.simulated.low <= self.sampled <= self.simulated.high:
            messages.append(Message(
                f"FALSE ALARMS of {self.title} are not those of normal noise: {self.simulated.value:.3g} per star-day "
                f"at {self.checked:.2f} in drawn stares, {self.sampled:.3g} by importance sampling: the search does "
                "not marginalise over what changes in the stare (see [search] frame, cycle, window_s), or set "
                'search.null = "counted".', "false alarms",
            ))  # fmt: skip
        # The probability of at least this many alarms if the expected number is right.
        if scipy.special.gammainc(max(self.alarmed, 1e-300), self.expected) < LEAST_CHANCE:
            messages.append(Message(
                f"FALSE ALARMS of {self.title} exceed the requested rate: {self.alarmed} of the drawn stares have one "
                f"at the threshold, {self.expected:.2g} should: set search.null = 'counted' with more search.nulls.",
                "false alarms",
            ))  # fmt: skip
        if self.shifted:
            messages.append(threshold_line(self.title, self.threshold.value))
        if self.injected.amplitudes.max() > self.saturates:
            text = f"flares of {self.title} with an amplitude above {self.saturates:.3g} saturate a pixel"
            messages.append(Message(f"SATURATED: {text}, which injections leave out.", "saturated"))
        return messages


def _metadata(answer: InjectAnswer) -> dict[str, object]:
    """Return the metadata of the tables: what is searched for."""
    choice, flare = answer.study.search, answer.study.flare
    return {
        "false_alarms": f"{choice.false_alarms:g} per star-{choice.per}",
        "flare": f"{flare.light().describe()}, {choice.shape}, amplitudes in {flare.band}",
        "study": answer.study.text(),
    }


@dataclass(eq=False)
class InjectAnswer(Answer):
    """Answer of `inject`: completeness by half-width and size, recovered values, thresholds and false alarms."""

    USES = ("instrument", "sky", "flare", "processes", "stare", "seed", "sweep")

    study: Study
    stars: list[StarCompleteness]
    messages: list[str]

    #: Sizes E50 and E90: per star and cell of the sweep, one row for all half-widths and one for each.
    table = TableOf("limits", (SHARE,), "stars", row_table="limits", by_star=True, meta=_metadata)
    #: One row per star, cell of the sweep, half-width and size.
    completeness = TableOf("completeness", (SHARE,), "stars", row_table="cells", by_star=True, meta=_metadata)
    #: One row per star and cell of the sweep: thresholds, false alarms.
    search = TableOf("search", SEARCH_COLUMNS, "stars", by_star=True, meta=_metadata)

    @property
    def headline(self) -> str:
        """The size of which half of the flares of the first star are found."""
        star = self.stars[0]
        unit, half = SIZE_UNITS[star.size], star.injected.limit(POWERS["e50"], None)
        scale, unit = (100, "%") if star.size == "amplitude" else (1, unit)
        of = star.size.replace("_", " ")
        ideal = "" if np.isnan(star.ideal_share) else f"; {scale * half.value * star.ideal_share:.3g} {IF_KNOWN}"
        of_several = first_of_several(len(self.stars), "cases")
        if not np.isfinite(half.value):
            return f"Fewer than half of the injected flares on {star.title} are found at any {of}{of_several}."
        return (
            f"A search of {self.instrument_name}'s frames of {star.title} would find half of the flares of "
            f"{of} {scale * half.value:.3g} {unit} ({scale * half.low:.3g} to {scale * half.high:.3g}{ideal}), "
            f"with {self.study.search.rate_text}{of_several}."
        )

    @property
    def views(self) -> list[View]:
        views = [InjectAnswer.search.view(self, f"The search: {self.study.search.rate_text} of frames")]
        for star in self.stars:
            size = star.size.replace("_", " ") + (f" ({SIZE_UNITS[star.size]})" if SIZE_UNITS[star.size] else "")
            title = f"{star.title}: {size} of which a half (E50) and nine tenths (E90) are found"
            views.append(View(title, star.limit_columns, star.limits))
        return views

    @property
    def inputs(self) -> list[Expectation]:
        return [star.survey.components.quiet for star in self.stars]


@by_keywords("injections")
def inject(study: Study, engine: Stares | Pool | None = None, progress: Progress = None) -> InjectAnswer:
    """Compute the completeness of a study's search for every star and sweep value.

    The study's ``search`` defines templates and false alarms, its ``injections`` the flares. Raises InputError for
    sweeps of amplitude or exposure, which injections do not have, and if only some stars have a known size.
    """
    idle = next((axis.quantity for axis in study.sweep.axes if axis.quantity in ("amplitude", "exposure")), None)
    if idle is not None:
        raise InputError(f"the sweep needs quantities that injections have, but has {idle!r}", key="sweep")
    engine = engine or Stares()
    prepared = cases(study)
    # Raise InputError for energies of stars of unknown size before the first search.
    chosen = {measure_of_size(case)[0]: case.source.name for case in prepared}
    if len(chosen) > 1:
        raise InputError(
            "injections.of must be 'amplitude' for stars of which some have no known size, such as "
            f"{chosen['amplitude']}; or give its distance_pc",
            key="injections.of",
        )
    q = study.injections
    per_case = q.count * q.sizes * q.widths

    def report(number: int, share: float) -> None:
        if progress is not None:
            progress(round((number + share) * per_case), len(prepared) * per_case)

    report(0, 0.0)
    stars = [_completeness(case, engine, partial(report, number)) for number, case in enumerate(prepared)]
    report(len(stars), 0.0)
    messages = [text for star in stars for text in star.messages]
    messages += collect_messages([star.survey.components.quiet for star in stars])
    messages += orbit_lines(study.stare, study.orbit, prepared[0].instrument.frame_s)
    return InjectAnswer(study, stars, messages)


def _completeness(case: Case, engine: Stares | Pool, report: Callable[[float], None]) -> StarCompleteness:
    """Inject flares into the stare of a case and search for them; `report` receives the share that is done."""
    choice, question, survey = case.study.search, case.study.injections, survey_star(case)
    reduced: Reduced = engine.stares if isinstance(engine, Pool) else engine.reduced
    false_alarms = _false_alarms(case, survey, reduced)
    (size, unit), threshold = measure_of_size(case), false_alarms["threshold"].value

    def size_of_unit(half_width_s: Float) -> Float:
        return unit * (np.ones_like(half_width_s) if size == "amplitude" else half_width_s)

    values = injected_sizes(case, size_of_unit, survey.unit_snr, threshold)
    positions = min(question.positions, question.count)
    per_amplitude = size_of_unit(np.array(question.half_widths_s))[:, None]
    amplitudes = values / per_amplitude
    injections = Injections(
        survey, question.half_widths_s, threshold, case.study.run.seed, positions, -(-question.count // positions),
        case.study.processes.additive_only, amplitudes, -(-question.fitted // positions),
        case.study.flare.temperature_k,
    )  # fmt: skip

    def at_one_peak(position: int) -> Arrays:
        return reduced(injections.request(position))

    peaks = map_in_order(engine, at_one_peak, range(positions))
    arrays = list(reported(peaks, positions, lambda done, total: report(done / total)))
    known_snr = 0.0
    if frame_nuisances(survey.components.quiet, case.stare, choice.spreads()) is not None:
        (flare,) = case.one_frame.expect(case.one_frame.flaring(SMALL))
        known_snr = frame_signal(survey.components.quiet, flare, SMALL)
    critical = np.stack([array["critical"].T for array in arrays], axis=1) * per_amplitude[:, None]
    return StarCompleteness(
        case.label, case.at, survey, size, **false_alarms, saturates=injections.saturates,
        in_a_row=consecutive_alarm_rate(choice.points, choice.sigma, survey.stare.frame_s),
        injected=InjectedCompleteness(injections.half_widths_s, values, amplitudes, critical),
        fitted=fit_accuracy(arrays) if question.fitted else None,
        ideal_share=survey.unit_snr / known_snr if known_snr > 0 else float("nan"),
    )  # fmt: skip


def _false_alarms(case: Case, survey: Survey, reduced: Reduced) -> dict[str, Any]:
    """Return threshold and false alarms, drawn and by importance sampling, by the fields of `StarCompleteness`."""
    choice, seed, days = case.study.search, case.study.run.seed, survey.stare.observed_s / DAY_S
    maxima = np.zeros(0)
    if choice.nulls:
        request = survey.largest_value_request(choice.nulls, seed, case.study.processes.additive_only)
        maxima = np.sort(reduced(request)["maximum"])
    tail, n = sampled_rate(survey, seed), maxima.size
    counted = n and choice.null == "counted"
    threshold = counted_threshold(maxima, days, choice.rate) if counted else tail.threshold(choice.rate)
    # The comparison with drawn stares has most power where a few in ten have an alarm.
    checked, likely, error = tail.likely
    shifted = tail.shifted and choice.null == "sampled"
    values: dict[str, Any] = {"threshold": threshold, "checked": checked, "shifted": shifted}
    if not n:
        nothing = Interval(np.nan, np.nan, np.nan)
        return values | {"simulated": nothing, "sampled": np.nan, "alarmed": 0, "expected": np.nan}
    # Drawn stares may be longer than those of importance sampling.
    ratio = days / tail.days
    p_no_alarm = (1 - likely) ** ratio
    errors = np.sqrt(p_no_alarm * (1 - p_no_alarm) / n), ratio * p_no_alarm / (1 - likely) * error
    alarmed_share, half_width = float(np.mean(maxima >= checked)), DIFFERS * np.hypot(*errors)
    with np.errstate(divide="ignore"):
        shares = (alarmed_share, alarmed_share - half_width, alarmed_share + half_width)
        ends = [-np.log1p(-np.clip(share, 0.0, 1.0)) / days for share in shares]
        sampled = float(-np.log(p_no_alarm) / days)
    alarms = {"alarmed": int(np.sum(maxima >= threshold.value)), "expected": float(n * -np.expm1(-choice.rate * days))}
    return values | {"simulated": Interval(*map(float, ends)), "sampled": sampled} | alarms
