"""Completeness of a search for flares: of injected ones over size and half-width, and how well they are recovered."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import astuple, dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.answer import Answer, InCell
from mauvecl.host.doors import public
from mauvecl.host.errors import InputError
from mauvecl.host.tables import tabled
from mauvecl.lightcurve.search.injected import Fitted, InjectedShares, fitted
from mauvecl.lightcurve.search.injections import Injections
from mauvecl.lightcurve.search.null import DAY_S, Counted, counted, in_a_row_rate, sampled
from mauvecl.results.requests.requests import Shard
from mauvecl.results.sums import Arrays
from mauvecl.statistics.intervals import Interval
from mauvecl.study.labels import described, label, stacked, told
from mauvecl.study.staring import orbit_lines
from mauvecl.study.study import Study
from mauvecl.study.surveys import Sizes, Surveyed, sizes_of, surveyed

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.device.stares import Stares
    from mauvecl.host.expectation import Expectation
    from mauvecl.lightcurve.search.survey import Survey
    from mauvecl.runs.checkpoint import Checkpoint
    from mauvecl.study.sections import Star

Float = NDArray[np.float64]

#: Powers at which limits are given.
POWERS = (0.5, 0.9)
#: Units of sizes, as astropy reads them.
SIZE_UNITS = {"amplitude": "", "duration": "s", "energy": "erg", "band_energy": "erg"}
#: Standard errors of the number of alarms beyond which the two differ.
DIFFERS = 4.0
#: Star-days of a stare that importance sampling looks at, at most.
SAMPLED_DAYS = 2.0
#: Maps in one picture.
MOST_DRAWN = 6


@dataclass(frozen=True, eq=False)
class StarCompleteness(InCell):
    """One star in one cell of the sweep.

    Attributes
    ----------
    surveyed : Surveyed
    sizes : Sizes
    threshold : Interval
    simulated : Interval
        False alarms per star-day of drawn stares at the value `checked`, which a few in ten exceed, with 4 standard
        errors; NaN where none are drawn.
    asked : float
        What it should be there by importance sampling.
    checked : float
    in_a_row : float
        False alarms per star-day of the common rule in white noise.
    found : InjectedShares
    fitted : Fitted, optional
    """

    surveyed: Surveyed
    sizes: Sizes
    threshold: Interval
    simulated: Interval
    asked: float
    checked: float
    in_a_row: float
    found: InjectedShares
    fitted: Fitted | None

    @property
    def message(self) -> str | None:
        """Where drawn stares alarm more or less often than normal noise."""
        if np.isnan(self.simulated.value) or self.simulated.low <= self.asked <= self.simulated.high:
            return None
        return (
            f"FALSE ALARMS of {self.title} are not those of normal noise: {self.simulated.value:.3g} per star-day at "
            f"{self.checked:.2f} in drawn stares, {self.asked:.3g} by importance sampling: the search does not "
            "marginalise over what changes in the stare (see [search] frame, cycle, window_s), or set search.null = "
            '"counted".'
        )


@dataclass(eq=False)
class InjectAnswer(Answer):
    """What `mauvecl inject` answers.

    Attributes
    ----------
    study : Study
    stars : list of StarCompleteness
    messages : list of str
    """

    study: Study
    stars: list[StarCompleteness]
    messages: list[str] = field(default_factory=list)

    @cached_property
    def table(self) -> QTable:
        """One row per star, cell of the sweep, and what is found of all half-widths and of each: sizes E50 and E90."""
        return self._together(_limits)

    @cached_property
    def completeness(self) -> QTable:
        """One row per star, cell of the sweep, half-width and size."""
        return self._together(_cells)

    @cached_property
    def search(self) -> QTable:
        """One row per star and cell of the sweep: thresholds, false alarms."""
        return self._together(_search)

    def _together(self, make: Callable[[StarCompleteness], QTable]) -> QTable:
        parts = (({**star.at, "star": star.label}, make(star)) for star in self.stars)
        choice = self.study.search
        meta = {
            "false_alarms": f"{choice.false_alarms:g} per star-{choice.per}",
            "flare": f"{self.study.flare.temperature_k:g} K, {choice.shape}, amplitudes in {self.study.flare.band}",
            "study": self.study.text(),
        }
        return stacked(parts, **meta)

    @property
    def tables(self) -> dict[str, Table]:
        """Limits, completeness of every cell, thresholds."""
        return {"limits": self.table, "completeness": self.completeness, "search": self.search}

    @property
    def inputs(self) -> list[Expectation]:
        return [star.surveyed.quiet for star in self.stars]

    @property
    def pictures(self) -> dict[str, tuple[Any, ...]]:
        """Maps of completeness, curves over size, and where flares are fitted a map of the energies recovered."""
        fitted = {"energies": ("injections.energies", self)} if all(star.fitted for star in self.stars) else {}
        return {"completeness": ("injections.maps", self), "curves": ("injections.curves", self), **fitted}


def _limits(star: StarCompleteness) -> QTable:
    found, unit = star.found, SIZE_UNITS[star.sizes.of]
    every = (None, *range(len(found.half_widths_s)))
    widths, told = [np.nan, *found.half_widths_s], "half-width of the injected flares; NaN for all of them alike"
    columns: list[tuple[object, ...]] = [("half_width", widths, told, "s")]
    for power in POWERS:
        name, limits = f"e{100 * power:.0f}", np.array([astuple(found.limit(power, k)) for k in every]).T
        columns += [
            (name, limits[0], f"{star.sizes.of} at which the completeness is {power:g}", unit),
            (f"{name}_low", limits[1], "its 95 % interval, lower end", unit),
            (f"{name}_high", limits[2], "its 95 % interval, upper end", unit),
        ]
    text = "share of flares for which no template fits into what is observed"
    return described(tabled([*columns, ("never", np.array([found.never(k) for k in every]), text)]))


def _cells(star: StarCompleteness) -> QTable:
    found, of, unit = star.found, star.sizes.of, SIZE_UNITS[star.sizes.of]
    d, s = (index.ravel() for index in np.indices((len(found.half_widths_s), len(found.sizes))))
    columns = [
        ("half_width", np.array(found.half_widths_s)[d], "half-width of the injected flares", "s"),
        ("size", found.sizes[s], f"{of} of the injected flares", unit),
        ("amplitude", found.amplitudes[d, s], "their amplitude: relative rise of the photons in the flare's band"),
        ("completeness", found.completeness[d, s], "share of injected flares that the search finds"),
        ("completeness_low", found.completeness_low[d, s], "its 95 % interval, lower end"),
        ("completeness_high", found.completeness_high[d, s], "its 95 % interval, upper end"),
        ("injections", np.full(d.size, found.count)),
    ]
    if star.fitted is not None:
        columns += [(name, getattr(star.fitted, name)[d, s], text) for name, text in Fitted.COLUMNS.items()]
    return described(tabled(columns))


def _search(star: StarCompleteness) -> QTable:
    s = star.surveyed.survey
    rows = (
        ("threshold", star.threshold.value, "S/N from which on a template is an alarm"),
        ("threshold_low", star.threshold.low, "its 95 % interval, lower end"),
        ("threshold_high", star.threshold.high, "its 95 % interval, upper end"),
        ("checked_at", star.checked, "S/N at which drawn stares are held against normal noise"),
        ("alarms_sampled", star.asked, "false alarms per star-day there, normal noise"),
        ("alarms_simulated", star.simulated.value, "false alarms per star-day there, drawn stares"),
        ("alarms_low", star.simulated.low, "lower end: 4 standard errors"),
        ("alarms_high", star.simulated.high, "upper end: 4 standard errors"),
        ("in_a_row", star.in_a_row, "false alarms per star-day of the common rule, white noise"),
        ("templates", s.search.n_filters, "templates of the bank"),
        ("sums", s.components.n_statistics, "weighted sums of a frame"),
        ("spectral_loss", float(star.surveyed.templates.loss.max()), "largest share of S/N lost to so few sums"),
        ("star_days", s.stare.observed_s / DAY_S, "star-days of a stare"),
    )
    return described(tabled((name, [value], text) for name, value, text in rows))


@public
def inject(
    study: Study,
    stares: Stares | None = None,
    *,
    checkpoint: Checkpoint | None = None,
    progress: Callable[[int, int], None] | None = None,
    threads: int | None = None,
) -> InjectAnswer:
    """Completeness of a study's search at each of its stars, in every cell of its sweep.

    Parameters
    ----------
    study : Study
    stares : Stares, optional
        Who draws stares without flares; the default device.
    checkpoint : Checkpoint, optional
        Where finished positions are kept, and looked for.
    progress : callable, optional
        Called as ``progress(done, total)`` in injections.
    threads : int, optional
        As many as there are processors by default.

    Raises
    ------
    InputError
        For anything in the study that cannot be.
    """
    idle = next((axis.quantity for axis in study.sweep.axes if axis.quantity in ("amplitude", "exposure")), None)
    if idle is not None:
        raise InputError(f"the sweep has the quantity {idle!r}, which injections have none of, expected another")
    cells = [(values, one, star) for values, one in study.cells() for star in one.star]
    q = study.injections
    each = q.count * q.sizes * q.widths
    answer = InjectAnswer(study, [])
    for number, (values, one, star) in enumerate(cells):

        def told_of(share: float, number: int = number) -> None:
            if progress is not None:
                progress(round((number + share) * each), len(cells) * each)

        told_of(0.0)
        answer.stars.append(_star(one, star, values, stares, checkpoint, told_of, threads))
    told_of(1.0)
    answer.messages = [
        *(text for text in (star.message for star in answer.stars) if text is not None),
        *told(answer.inputs),
        *orbit_lines(study),
    ]
    return answer


def _star(
    study: Study,
    star: Star,
    at: Mapping[str, float | str],
    stares: Stares | None,
    checkpoint: Checkpoint | None,
    told_of: Callable[[float], None],
    threads: int | None,
) -> StarCompleteness:
    choice, asked, seed = study.search, study.injections, study.run.seed
    known = surveyed(study, star)
    survey = known.survey
    drawn = _null(survey, study, stares)
    short = survey.of_days(SAMPLED_DAYS)
    tail = sampled(short.search, seed=seed)
    threshold = (
        tail.threshold(choice.rate) if choice.null == "sampled" or drawn is None else drawn.threshold(choice.rate)
    )
    sizes = Sizes.chosen(study, star, known.source)
    values = sizes_of(study, sizes, known.unit_snr, threshold.value)
    positions = min(asked.positions, asked.count)
    injections = Injections(
        survey,
        0,
        asked.half_widths_s,
        threshold.value,
        study.flare.temperature_k,
        seed,
        positions,
        -(-asked.count // positions),
    )
    widths = np.array(injections.half_widths_s)
    amplitudes = np.asarray(sizes.amplitude(values[None], widths[:, None]))
    to_fit = -(-asked.fitted // positions)
    work = partial(_position, injections, known, amplitudes, to_fit)
    parts = _kept(work, positions, _name(study, star, threshold.value, amplitudes), checkpoint, told_of, threads)
    critical = np.stack([part["critical"] for part in parts], axis=1)
    found = InjectedShares(
        injections.half_widths_s, values, amplitudes, sizes.of_amplitude(critical, widths[:, None, None])
    )
    # Where a few stares in ten have an alarm, drawn ones say most of whether the two agree.
    checked, likely, error = tail.likely
    simulated, expected = _checked(drawn, checked, likely, error, survey.stare.observed_s / short.stare.observed_s)
    return StarCompleteness(
        label(star, known.quiet),
        at,
        known,
        sizes,
        threshold,
        simulated,
        expected,
        checked,
        in_a_row_rate(choice.points, choice.sigma, survey.stare.frame_s),
        found,
        Fitted.of(parts) if to_fit else None,
    )


def _position(injections: Injections, known: Surveyed, amplitudes: Float, to_fit: int, position: int) -> Arrays:
    """Everything at one peak."""
    places = injections.places(position)
    blocks = [injections.critical(places, p, k, n) for p, k, n in injections.blocks() if p == position]
    part: Arrays = {"critical": np.concatenate(blocks, axis=1)}
    return part | fitted(injections, known.fit, places, position, to_fit, amplitudes) if to_fit else part


def _kept(
    work: Callable[[int], Arrays],
    positions: int,
    name: str,
    checkpoint: Checkpoint | None,
    told_of: Callable[[float], None],
    threads: int | None,
) -> list[Arrays]:
    """What comes of each position, worked out by some threads or kept from before."""
    found: dict[int, Arrays] = {}
    if checkpoint is not None:
        kept = {p: checkpoint.get(f"{name}-{Shard(0, p, 1).name}") for p in range(positions)}
        found = {p: part for p, part in kept.items() if part is not None}
    todo = [p for p in range(positions) if p not in found]
    pool = ThreadPoolExecutor(threads or os.cpu_count())
    # One thread is the caller's own, which may be told to end.
    each = map(work, todo) if threads == 1 else pool.map(work, todo)
    try:
        for position, part in zip(todo, each, strict=True):
            found[position] = part
            if checkpoint is not None:
                checkpoint.put(f"{name}-{Shard(0, position, 1).name}", part)
            told_of(len(found) / positions)
    finally:
        # What nobody waits for any longer is not begun.
        pool.shutdown(cancel_futures=True)
    return [found[position] for position in range(positions)]


def _name(study: Study, star: Star, threshold: float, amplitudes: Float) -> str:
    """What shards of one star are kept under."""
    text = f"{study.toml()}|{star!r}|{threshold.hex()}|".encode() + amplitudes.tobytes()
    return hashlib.sha256(text).hexdigest()[:32]


def _null(survey: Survey, study: Study, stares: Stares | None) -> Counted | None:
    """Largest values of drawn stares without a flare."""
    if not study.search.nulls:
        return None
    from mauvecl.device.stares import Stares as Default

    drawing = stares or Default()

    def draw(first: int, count: int) -> NDArray[np.float32]:
        sums = drawing.frames(
            survey.components, survey.stare, first=first, count=count, seed=study.run.seed, method="cumulants"
        )
        return survey.net(sums)

    return counted(survey.search, draw, study.search.nulls, batch=survey.batch)


def _checked(
    drawn: Counted | None, value: float, probability: float, error: float, longer: float
) -> tuple[Interval, float]:
    """False alarms per star-day of drawn stares at a value, within 4 standard errors, and what was expected."""
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
