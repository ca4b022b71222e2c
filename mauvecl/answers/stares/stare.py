"""Simulated stares: light curves in bands, a spectrum of every frame, and the flares."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from mauvecl.answers.answer import Answer
from mauvecl.answers.progress import reported
from mauvecl.answers.stares.light_curve_file import light_curve_file
from mauvecl.answers.stares.star_stare import SearchResult, StareFlare, StarStare
from mauvecl.flares.energies import Kind
from mauvecl.flares.events import Event, coefficients, temperatures_of
from mauvecl.flares.frames import Draw, draw_light_curves
from mauvecl.runs.checkpoint import kept
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.messages import Message
from mauvecl.schema.tables import Column, View, number, percent, records, table_of
from mauvecl.search.alarms import alarms
from mauvecl.search.false_alarms import sampled_rate
from mauvecl.study.cases import Case, cases
from mauvecl.study.labels import place_columns
from mauvecl.study.messages import collect_messages
from mauvecl.study.questions import check_sweep
from mauvecl.study.stare_expectation import energy_of, orbit_lines, threshold_line, unused_lines
from mauvecl.study.study import Study
from mauvecl.study.surveys import survey_star

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.detection.snr import Arrays
    from mauvecl.device.stare_engine import Stares
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.checkpoint import Checkpoint
    from mauvecl.search.flare_fits import Factor, FittedFlares
    from mauvecl.study.assumptions import Use

Float = NDArray[np.float64]
KINDS: tuple[Kind, ...] = ("band", "bolometric")
#: Largest number of frames of light curves in text files; longer ones are in FITS files only.
MOST_ROWS = 100_000
#: Largest number of frames: 115 days, with spectra of 1.2 GB.
MOST_SHOWN = 2_000_000


def _with_error(value: float, error: float) -> str:
    """Format a value to its error's two leading digits: 9979 ± 120, not 1e+02."""
    if value != value:
        return ""
    if not (math.isfinite(error) and error > 0):
        return f"{value:.3g}"
    digits = max(1 - math.floor(math.log10(error)), 0)
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def _percent_with_error(value: float, error: float) -> str:
    text = _with_error(100 * value, 100 * error)
    return f"{text} %" if text else ""


#: Columns of the table of stares.
COLUMNS = (
    Column("frames", "staring.stare.n_frames", "", "frames of the stare", "frames"),
    Column("observed", "staring.stare.observed_s", "s", "time in them", "recorded (s)", "g"),
    Column("intervals", lambda one: len(one.staring.stare.gtis), "",
           "good time intervals: runs of frames without a gap", "intervals"),
    Column("flux", lambda one: float(np.median(one.light.mean[:, 0])), "DN / s",
           "median net light of a frame, sky included, without bias and dark", "light (DN/s)", ".4g"),
    Column("frame_noise", lambda one: float(np.median(one.light.sd[:, 0] / one.light.mean[:, 0])), "",
           "standard deviation of a frame's own noise, relative to its light", "noise of a frame", percent(".3g")),
    Column("flares", lambda one: len(one.flares), "", "flares put into it"),
)  # fmt: skip
#: Additional columns if stares are searched.
SEARCHED_COLUMNS = (
    Column("threshold", lambda one: one.search.threshold if isinstance(one.search, SearchResult) else np.nan, "",
           "value of the search's statistic from which on it alarms"),
    Column("found", lambda one: len(one.search.alarms) if isinstance(one.search, SearchResult) else -1, "",
           "flares found; -1: not searched"),
)  # fmt: skip
SATURATED_COLUMN = Column(
    "saturated_frames", lambda one: int(np.count_nonzero(one.staring.quality)), "",
    "frames in which the mean of a used pixel reaches saturation", "saturated",
)  # fmt: skip
POINTING_COLUMN = Column(
    "drifting_frames", lambda one: int(np.count_nonzero(one.pointing_loss)), "",
    "frames that lost light in pointing drifts, which are assumptions", "drifting",
)  # fmt: skip
#: Columns of the table of flares, for `StareFlare`.
EVENT_COLUMNS = (
    Column("peak_time", "event.peak_s", "s", "from the start of the stare; tau = 0 of the shape", "peak at (s)", ".6g",
           kind=float),
    Column("half_width", "event.half_width_s", "s", "t_1/2 of the shape's publication", "half-width (s)", "g",
           kind=float),
    Column("amplitude", "event.amplitude", "", "the shape's own, in the flare's band", kind=float),
    Column("peak", "event.peak", "", "highest relative rise of the photons in the flare's band", "peak",
           percent(".3g"), kind=float),
    Column("temperature", "event.hottest_k", "K", "blackbody temperature, at the peak", kind=float),
    Column("equivalent_duration", "event.equivalent_duration_s", "s", "in the flare's band", "ED (s)", ".4g",
           kind=float),
    Column("energy_band", "band_erg", "erg", "in the flare's band; nan: star of unknown size", kind=float),
    Column("energy_bolometric", "bolometric_erg", "erg", "of all of its light", "bolometric (erg)", number(".3g"),
           kind=float),
    Column("snr", "snr", "", "of one who knows all but whether the flare is there", "S/N", ".3g", kind=float),
    Column("shape", "event.form.name", kind=str),
)  # fmt: skip


def _fitted(name: str, key: str, unit: str, text: str, heading: str = "", form: Any = "", *more: str) -> list[Column]:
    """Return the columns of a fitted quantity: value, standard error, and ends of its 68 % interval."""
    error = key.replace("_s", "_error_s").replace("_k", "_error_k") if key[-2:] in ("_s", "_k") else f"{key}_error"
    return [
        Column(name, lambda one: float(getattr(one.alarm.recovered, key)[0]), unit, text, heading, form, more, float),
        Column(f"{name}_error", lambda one: float(getattr(one.alarm.recovered, error)[0]), unit,
               f"{text}; standard error by curvature", kind=float),
        *_interval(name, key, unit),
    ]  # fmt: skip


def _interval(name: str, key: str, unit: str) -> list[Column]:
    return [
        Column(f"{name}_low", lambda one: one.alarm.intervals[key][0], unit, "lower end of its 68 % interval",
               kind=float),
        Column(f"{name}_high", lambda one: one.alarm.intervals[key][1], unit, "higher end of its 68 % interval",
               kind=float),
    ]  # fmt: skip


#: Columns of the table of flares that a search found, for `FoundFlare`.
FOUND_COLUMNS = (
    *_fitted("peak_time", "peak_s", "s", "from the start of the stare", "peak at (s)", number(".6g", "not measured")),
    *_fitted("amplitude", "amplitude", "", "in the flare's band", "amplitude", _percent_with_error, "amplitude_error"),
    *_fitted("half_width", "half_width_s", "s", "t_1/2 of the search's shape", "half-width (s)", _with_error,
             "half_width_error"),
    *_fitted("temperature", "temperature_k", "K", "blackbody temperature", "temperature (K)", _with_error,
             "temperature_error"),
    *_fitted("equivalent_duration", "equivalent_duration_s", "s", "in the flare's band"),
    Column("energy_bolometric", "bolometric_erg", "erg", "", "bolometric (erg)", number(".3g"), kind=float),
    *_interval("energy_bolometric", "energy", "erg"),
    Column("value", "alarm.rho", "", "the search's statistic when it was found: S/N of the template that fits best",
           "value", ".2f", kind=float),
    Column("event", "", "", "row of the star's flares that it is nearest to, from 1 on; 0: none near", "flare",
           lambda event: str(event) if event else "none", kind=int),
    Column("window", "alarm.block", "",
           "number of the window that it was fitted in; flares of one number were fitted together", kind=int),
    Column("chi2", "alarm.chi2", "", "of this fit", kind=float),
    Column("dof", "alarm.dof", "", "degrees of freedom of this fit", kind=int),
    Column("p_value", "alarm.p_value", "", "probability of a chi-squared at least as large where the model is right",
           kind=float),
    Column("note", "alarm.note", "",
           "what is special: a flare that is not measured, an interval that ends where the fit does", kind=str),
)  # fmt: skip
#: Columns of a light curve for every frame; those of the light follow for each band.
FRAME_COLUMNS = (
    Column("time", "stare.middle_s", "s", "middle of the frame, from the start of the stare"),
    Column("frame", "stare.numbers", "", "number of the frame, gaps included"),
    Column("quality", "quality", "", "1 where the mean of a used pixel reaches saturation"),
)
LOSS_COLUMN = Column(
    "pointing_loss", "", "",
    "share of all light that the frame lost in pointing drifts, as drawn; an observer does not know it",
)  # fmt: skip
LIGHT = {
    "flux": "net light, bias and known dark taken off",
    "flux_err": "standard deviation of its photons, dark and reading",
    "mean": "the same without any noise",
}


@dataclass(eq=False)
class StareAnswer(Answer):
    """The answer of `mauvecl stare`.

    Attributes
    ----------
    study : Study
    stares : list of StarStare
        One per star and cell of the sweep.
    messages : list of str
    """

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "flare", "processes", "stare", "seed")
    JSON = MappingProxyType({"stares": "table", "events": "events"})

    study: Study
    stares: list[StarStare]
    messages: list[str] = field(default_factory=list)

    @property
    def table(self) -> QTable:
        """One row per star and cell: frames, gaps, light and noise of a frame, flares."""
        return self._table(self._columns, self.stares)

    @property
    def _columns(self) -> tuple[Column, ...]:
        searched = SEARCHED_COLUMNS if self.study.stare.search else ()
        drifting = () if self.study.stare.pointing is None else (POINTING_COLUMN,)
        return (*place_columns(self.study.sweep), *COLUMNS, *searched, SATURATED_COLUMN, *drifting)

    @property
    def events(self) -> QTable:
        """One row per flare: peak, half-width, amplitude, temperature, energies, and the S/N of its matched filter."""
        rows = [(one, flare) for one in self.stares for flare in one.flares]
        return self._table(self._after_place(EVENT_COLUMNS), rows)

    @property
    def found(self) -> QTable:
        """One row per flare that the search found: fitted values with errors, and the number of the flare in the stare.

        Values are NaN where the fit does not measure the flare: `note` says why.
        """
        rows = [(one, alarm) for one in self.stares for alarm in one.found]
        return self._table(self._after_place(FOUND_COLUMNS), rows)

    def _after_place(self, columns: Iterable[Column]) -> list[Column]:
        """Return columns of the second part of rows after those of the star and cell, which are the first part."""
        place = place_columns(self.study.sweep)
        return [*(one.of(itemgetter(0)) for one in place), *(one.of(itemgetter(1)) for one in columns)]

    def _table(self, columns: Iterable[Column], rows: Iterable[object]) -> QTable:
        return table_of(columns, rows, study=self.study.text(), seed=self.study.run.seed)

    @property
    def views(self) -> list[View]:
        place, asked = place_columns(self.study.sweep), self.study.search
        alarms = "false alarm" if asked.false_alarms == 1 else "false alarms"
        return [
            View("One stare each", self._columns, self.table),
            View(
                "Flares in them; S/N of one who knows all but whether the flare is there",
                (*place, *EVENT_COLUMNS),
                self.events,
            ),
            *(
                View(
                    f"Found at {one.title} above {one.search.threshold:.2f}, {asked.false_alarms:g} {alarms} per "
                    f"star-{asked.per}",
                    FOUND_COLUMNS,
                    table_of(FOUND_COLUMNS, one.found),
                )
                for one in self.stares
                if isinstance(one.search, SearchResult)
            ),
        ]

    def light_curve(self, number: int = 0) -> QTable:
        """Return the frames of a star in a cell: time, cadence number, quality, and light in every band."""
        one = self.stares[number]
        suffixes = ["", *("_" + name.removesuffix(" nm").replace("-", "_") for name in one.light.bands[1:])]
        bands = (
            Column(kind + suffix, unit="DN / s", description=f"{band}: {text}")
            for band, suffix in zip(one.light.bands, suffixes, strict=True)
            for kind, text in LIGHT.items()
        )
        light = {"flux": one.light.flux, "flux_err": one.light.sd, "mean": one.light.mean}
        values = {kind + suffix: light[kind][:, k] for k, suffix in enumerate(suffixes) for kind in LIGHT}
        about = {"star": one.label, "study": self.study.text(), "seed": self.study.run.seed, **one.at}
        frames = [column.of(itemgetter("stare")) for column in FRAME_COLUMNS]
        if one.pointing_loss is not None:
            frames.append(replace(LOSS_COLUMN, get=lambda _: one.pointing_loss))
        return table_of((*frames, *bands), [{"stare": one.staring, **values}], **about)

    @property
    def tables(self) -> dict[str, Table]:
        """The stares, their flares, and a light curve of each."""
        curves = {
            f"light-curve-{n}": self.light_curve(n - 1)
            for n, one in enumerate(self.stares, 1)
            if one.staring.stare.n_frames <= MOST_ROWS
        }
        searched = {"found": self.found} if self.study.stare.search else {}
        return {"stare": self.table, "events": self.events} | searched | curves

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        """A FITS file of each star and cell: light curve, good time intervals, dynamic spectrum."""
        study = self.study
        of = partial(light_curve_file, sky=study.sky, seed=study.run.seed, number=study.stare.number)
        return {f"light-curve-{n}.fits": partial(of, one) for n, one in enumerate(self.stares, 1)}

    @property
    def inputs(self) -> list[Expectation]:
        return [one.staring.quiet for one in self.stares]

    @property
    def remarks(self) -> list[str]:
        long = [one.title for one in self.stares if one.staring.stare.n_frames > MOST_ROWS]
        return (
            [f"More than {MOST_ROWS} frames: light curves of {', '.join(long)} are in FITS files alone."]
            if long
            else []
        )

    def as_json(self) -> dict[str, Any]:
        found = {"found": records(self.found)} if self.study.stare.search else {}
        return super().as_json() | found


@validated
def stare(
    study: Study,
    engine: Stares | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    checkpoint: Checkpoint | None = None,
) -> StareAnswer:
    """Simulate one stare for every star and sweep value of a study.

    Parameters
    ----------
    study : Study
        Its section `stare`, `events`, star, flare, sky, observation; `run.seed` and `stare.number` select the stare.
    engine : Stares, optional
        Simulator; by default that of the default device.
    progress : callable, optional
        Called as ``progress(done, total)`` in stares.
    checkpoint : Checkpoint, optional
        Keeps the frames that are drawn and the thresholds of searches.
    """
    check_sweep(study.sweep, study.stare, study.events)
    prepared = cases(study)
    # Sweeps do not change the frames.
    frames = prepared[0].stare.n_frames
    if frames > MOST_SHOWN:
        raise InputError(
            f"a stare of {frames} frames, each with a spectrum",
            f"at most {MOST_SHOWN}",
            key="stare.duration_s",
            value=frames,
        )
    # Bad input is refused before anything is drawn.
    quiet = [case.stare_expectation.quiet for case in prepared]
    if engine is None:
        from mauvecl.device.stare_engine import Stares as Default

        engine = Default()
    drawn = [_draw(case, engine, checkpoint) for case in reported(prepared, len(prepared), progress)]
    messages = collect_messages(quiet) + orbit_lines(study.stare, study.orbit, prepared[0].instrument.frame_s)
    messages += dict.fromkeys(
        line for case in prepared for line in unused_lines(case.study.observation.exposure_s, case.stare, case.events)
    )
    messages += [one.search for one in drawn if isinstance(one.search, str)]
    messages += [
        threshold_line(one.title, one.search.threshold)
        for one in drawn
        if isinstance(one.search, SearchResult) and one.search.shifted
    ]
    messages += [line for one in drawn for line in _pointing_lines(one)]
    for one in drawn:
        cut = int(np.count_nonzero(one.staring.quality))
        if cut:
            text = f"SATURATED: {cut} frames of the stare at {one.title}; their quality is 1."
            messages.insert(0, Message(text, "saturated"))
    return StareAnswer(study, drawn, messages)


def _pointing_lines(one: StarStare) -> list[str]:
    """Return the message about frames that lost light in pointing drifts, if drifts are drawn."""
    lost, drifts = one.pointing_loss, one.staring.stare.pointing
    if lost is None or drifts is None:
        return []
    many = int(np.count_nonzero(lost))
    return [
        f"POINTING DRIFTS: {many} of {lost.size} frames at {one.title} lose light, up to {100 * lost.max():.3g} %; "
        f"assumed: {drifts.rate_per_h:g} per hour, {drifts.duration_s:g} s long on average, with up to "
        f"{100 * drifts.depth:g} % of the light lost. The search marginalises over the level of each frame."
    ]


def _draw(case: Case, stares: Stares, checkpoint: Checkpoint | None) -> StarStare:
    """Draw and search the stare of a case."""
    q, seed, processes = case.study.stare, case.study.run.seed, case.study.processes.additive_only
    staring = case.stare_expectation

    def draw(components: Any) -> Any:
        def computed() -> Arrays:
            what = components, staring.stare, staring.flare
            return {"frames": stares.frames(*what, first=q.number, count=1, seed=seed, processes=processes)[0]}

        depends_on = ("frames", components, staring.stare, staring.flare, q.number, seed, processes)
        return kept(checkpoint, depends_on, computed)["frames"]

    light = draw_light_curves(staring, q.bands_nm, draw)
    searched = _search(case, draw, checkpoint) if q.search else None
    lost = None
    if staring.stare.pointing is not None:
        lost = staring.stare.pointing_losses(np.array([q.number], np.uint64), seed)[0]
    return StarStare(case.label, case.at, staring, _flares(case), light, searched, lost)


def _search(case: Case, draw: Draw, checkpoint: Checkpoint | None) -> SearchResult | str:
    """Search the stare of a case for flares, or return a message if no search is possible."""
    study, staring, events = case.study, case.stare_expectation, case.events
    try:
        known = survey_star(case)
        survey = replace(known.survey, components=staring.components(known.templates.weights))

        def computed() -> Arrays:
            tail = sampled_rate(survey, study.run.seed)
            return {"threshold": np.array(tail.threshold(study.search.rate).value), "shifted": np.array(tail.shifted)}

        tail = kept(checkpoint, ("threshold", survey, study.text()), computed)
        threshold = float(tail["threshold"])
    except InputError as error:
        return Message(f"{case.label} is not searched: {error}.", "not searched")
    scale = _log_energy(case, known.templates.temperatures_k)
    raised = alarms(survey, known.templates, draw(survey.components), threshold, scale)
    energies, nearest = [], []
    for alarm in raised:
        fit = alarm.recovered
        if not alarm.measured:
            energies.append(float("nan"))
            nearest.append(0)
            continue
        event = _event_of(case, fit)
        energies.append(_found_energy(case, event))
        away = [abs(one.peak_s - event.peak_s) for one in events]
        near = int(np.argmin(away)) if away else -1
        close = near >= 0 and away[near] <= events[near].half_width_s + 2 * staring.stare.frame_s
        nearest.append(near + 1 if close else 0)
    return SearchResult(threshold, raised, tuple(energies), tuple(nearest), bool(tail["shifted"]))


def _event_of(case: Case, fit: FittedFlares) -> Event:
    """Return a fitted flare as an event."""
    kelvin = float(np.nan_to_num(fit.temperature_k[0], nan=case.study.flare.temperature_k))
    values = (float(fit.peak_s[0]), float(fit.half_width_s[0]), float(fit.amplitude[0]))
    return Event(*values, kelvin, case.study.search.shape)


def _log_energy(case: Case, kelvin: Sequence[float]) -> Factor | None:
    """Return the logarithm of the energy per second of equivalent duration as a function of log temperature.

    It is a spline through the energies at temperatures, K.

    Returns None if the star's size is unknown, or a template's temperature gives no energy.
    """
    one = Event(0.0, 1.0, 1.0, kelvin[0], case.study.search.shape)
    events = [replace(one, temperature=k) for k in kelvin]
    energies = np.array([_found_energy(case, event) for event in events])
    if len(kelvin) < 2 or not (np.isfinite(energies) & (energies > 0)).all():
        return None
    spline = CubicSpline(np.log(kelvin), np.log(energies / one.equivalent_duration_s))
    return lambda x: (float(spline(x)), float(spline(x, 1)))


def _found_energy(case: Case, event: Event) -> float:
    """Return the bolometric energy of a detected flare, erg; NaN if the star's size is unknown.

    Also NaN if flares replace photosphere and the fitted temperature is not above the photosphere's.
    """
    flare = case.study.flare
    photosphere = flare.photosphere_temperature_k or case.source.temperature_k
    if flare.geometry == "replaces" and photosphere is not None and event.hottest_k <= photosphere:
        return float("nan")
    energy = energy_of(case.study, case.source, event, "bolometric")
    return float("nan") if energy is None else energy


def _flares(case: Case) -> tuple[StareFlare, ...]:
    """Return the flares of a case's stare with their energies and S/N."""
    staring, kelvin, frames = case.stare_expectation, temperatures_of(case.events), case.stare
    flares = []
    for event in case.events:
        energies = [energy_of(case.study, case.source, event, kind, kelvin) for kind in KINDS]
        band, bolometric = (float("nan") if energy is None else energy for energy in energies)
        own = coefficients([event], frames.start_s, frames.frame_s, kelvin)
        flares.append(StareFlare(event, band, bolometric, staring.snr(own)))
    return tuple(flares)
