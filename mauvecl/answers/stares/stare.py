"""One simulated stare at every star of a study: light curves in bands, a spectrum of every frame, the flares in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from scipy.interpolate import CubicSpline

from mauvecl.answers.answer import Answer, InCell
from mauvecl.lightcurve.flares.energies import Kind
from mauvecl.lightcurve.flares.events import Event, coefficients, temperatures_of
from mauvecl.lightcurve.search.alarms import Alarm, alarms
from mauvecl.lightcurve.stares.observed import Draw, Light, StareExpectation, seen
from mauvecl.runs.checkpoint import kept
from mauvecl.schema.calls import public
from mauvecl.schema.errors import InputError
from mauvecl.schema.tables import make_table
from mauvecl.study.labels import describe_columns, label, stack_tables
from mauvecl.study.messages import collect_messages
from mauvecl.study.stare_expectation import energy_of, expect_stare, orbit_lines, stare_of, threshold_line, unused_lines
from mauvecl.study.stare_section import check_sweep
from mauvecl.study.study import Study
from mauvecl.study.surveys import survey_star

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.device.stares import Stares
    from mauvecl.host.expectation import Expectation
    from mauvecl.host.stars.source import Source
    from mauvecl.lightcurve.search.blends import Factor
    from mauvecl.lightcurve.search.flare_fit import FittedFlares
    from mauvecl.results.sums import Arrays
    from mauvecl.runs.checkpoint import Checkpoint
    from mauvecl.study.assumptions import Use
    from mauvecl.study.sections import Star
    from mauvecl.study.surveys import StarSurvey

KINDS: tuple[Kind, ...] = ("band", "bolometric")
#: Light curves in text, at most; longer ones are in their FITS files alone.
MOST_ROWS = 100_000
#: Frames whose spectra are kept, at most: 115 days, 1.2 GB.
MOST_SHOWN = 2_000_000


@dataclass(frozen=True, eq=False)
class Flaring:
    """One flare of a stare, with its energies, erg (NaN where the star's size is unknown), and its S/N.

    `snr` is that of a search which knows everything but whether the flare is there.
    """

    event: Event
    band_erg: float
    bolometric_erg: float
    snr: float


@dataclass(frozen=True, eq=False)
class Searched:
    """What a search of one stare found, and the threshold that it was searched with.

    Attributes
    ----------
    threshold : float
        By importance sampling of normal noise.
    alarms : list of Alarm
        By falling value.
    bolometric_erg : tuple of float
        Of each, by its fit; NaN where the star's size is unknown.
    events : tuple of int
        The flare put in that each is nearest to, from 1 on, within a half-width and two frames; 0 for none.
    shifted : bool
        Whether the threshold allows for what the search neither subtracts nor marginalises over.
    """

    threshold: float
    alarms: list[Alarm]
    bolometric_erg: tuple[float, ...]
    events: tuple[int, ...]
    shifted: bool = False


@dataclass(frozen=True, eq=False)
class StarStare(InCell):
    """One star in one cell of the sweep; `searched` is a sentence where no search was possible."""

    staring: StareExpectation
    flares: tuple[Flaring, ...]
    light: Light
    searched: Searched | str | None = None


@dataclass(eq=False)
class StareAnswer(Answer):
    """What `mauvecl stare` answers.

    Attributes
    ----------
    study : Study
    stares : list of StarStare
        Every star in every cell of the sweep.
    messages : list of str
    """

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "flare", "unknowns", "seed")

    study: Study
    stares: list[StarStare]
    messages: list[str] = field(default_factory=list)

    @property
    def table(self) -> QTable:
        """One row per star and cell: frames, gaps, light and noise of a frame, flares."""

        def row(one: StarStare) -> QTable:
            stare, light, told = one.staring.stare, one.light, one.searched
            columns: list[tuple[object, ...]] = [
                ("frames", [stare.n_frames], "frames of the stare"),
                ("observed", [stare.observed_s], "time in them", "s"),
                ("intervals", [len(stare.gtis)], "good time intervals: runs of frames without a gap"),
                ("flux", [float(np.median(light.mean[:, 0]))],
                 "median net light of a frame, sky included, without bias and dark", "DN / s"),
                ("frame_noise", [float(np.median(light.sd[:, 0] / light.mean[:, 0]))],
                 "standard deviation of a frame's own noise, relative to its light"),
                ("flares", [len(one.flares)], "flares put into it"),
            ]  # fmt: skip
            if self.study.stare.search:
                threshold, alarms = (told.threshold, len(told.alarms)) if isinstance(told, Searched) else (np.nan, -1)
                columns += [
                    ("threshold", [threshold], "value of the search's statistic from which on it alarms"),
                    ("found", [alarms], "flares found; -1: not searched"),
                ]
            saturated = int(np.count_nonzero(one.staring.quality))
            told_of = "frames in which the mean of a used pixel reaches saturation"
            return make_table([*columns, ("saturated_frames", [saturated], told_of)])

        return self._together(row)

    @property
    def events(self) -> QTable:
        """One row per flare: when, how long, how large, how hot, and the S/N of one who looks for just this one."""

        def rows(one: StarStare) -> QTable:
            flares, events = one.flares, [flare.event for flare in one.flares]
            numbers = (
                ("peak_time", [e.peak_s for e in events], "from the start of the stare; tau = 0 of the shape", "s"),
                ("half_width", [e.half_width_s for e in events], "t_1/2 of the shape's publication", "s"),
                ("amplitude", [e.amplitude for e in events], "the shape's own, in the flare's band", ""),
                ("peak", [e.peak for e in events], "highest relative rise of the photons in the flare's band", ""),
                ("temperature", [e.hottest_k for e in events], "blackbody temperature, at the peak", "K"),
                ("equivalent_duration", [e.equivalent_duration_s for e in events], "in the flare's band", "s"),
                ("energy_band", [f.band_erg for f in flares], "in the flare's band; nan: star of unknown size", "erg"),
                ("energy_bolometric", [f.bolometric_erg for f in flares], "of all of its light", "erg"),
                ("snr", [f.snr for f in flares], "of one who knows all but whether the flare is there", ""),
            )
            shapes = np.array([e.form.name for e in events], dtype="U32")
            plain = ((name, np.array(values, np.float64), *more) for name, values, *more in numbers)
            return make_table([*plain, ("shape", shapes)])

        return self._together(rows)

    @property
    def found(self) -> QTable:
        """One row per flare that the search found: what it was by a fit, with 68 % intervals, and which was put in.

        Values are NaN where the fit does not measure the flare: `note` says why.
        """

        def rows(one: StarStare) -> QTable:
            searched = one.searched if isinstance(one.searched, Searched) else Searched(np.nan, [], (), ())
            raised = searched.alarms
            fits = [alarm.recovered for alarm in raised]
            fitted = (
                ("peak_time", "peak{}_s", "from the start of the stare", "s"),
                ("amplitude", "amplitude{}", "in the flare's band", ""),
                ("half_width", "half_width{}_s", "t_1/2 of the search's shape", "s"),
                ("temperature", "temperature{}_k", "blackbody temperature", "K"),
                ("equivalent_duration", "equivalent_duration{}_s", "in the flare's band", "s"),
            )
            best = "the search's statistic when it was found: S/N of the template that fits best"
            nearest = "row of the star's flares that it is nearest to, from 1 on; 0: none near"
            columns: list[tuple[object, ...]] = []

            def interval(name: str, key: str, unit: str) -> list[tuple[object, ...]]:
                ends = np.array([alarm.intervals[key] for alarm in raised], np.float64).reshape(len(raised), 2)
                return [
                    (f"{name}_{end}", ends[:, k], f"{end}er end of its 68 % interval", unit)
                    for k, end in enumerate(("low", "high"))
                ]

            for name, key, text, unit in fitted:
                for end, more in (("", ""), ("_error", "; standard error by curvature")):
                    values = [float(getattr(fit, key.format(end))[0]) for fit in fits]
                    columns.append((name + end, np.array(values, np.float64), text + more, unit))
                columns += interval(name, key.format(""), unit)
            columns += [
                ("energy_bolometric", np.array(searched.bolometric_erg, np.float64), "", "erg"),
                *interval("energy_bolometric", "energy", "erg"),
                ("value", np.array([alarm.rho for alarm in raised], np.float64), best),
                ("event", np.array(searched.events, np.int64), nearest),
                ("window", np.array([alarm.block for alarm in raised], np.int64),
                 "number of the window that it was fitted in; flares of one number were fitted together"),
                ("chi2", np.array([alarm.chi2 for alarm in raised], np.float64), "of this fit"),
                ("dof", np.array([alarm.dof for alarm in raised], np.int64), "degrees of freedom of this fit"),
                ("p_value", np.array([alarm.p_value for alarm in raised], np.float64),
                 "probability of a chi-squared at least as large where the model is right"),
                ("note", np.array([alarm.note for alarm in raised], dtype="U160"),
                 "what is special: a flare that is not measured, an interval that ends where the fit does"),
            ]  # fmt: skip
            return make_table(columns)

        return self._together(rows)

    def light_curve(self, number: int = 0) -> QTable:
        """Frames of one star and cell: time, cadence number, quality, and light in every band."""
        one = self.stares[number]
        stare, light = one.staring.stare, one.light
        kinds = (
            ("flux", light.flux, "net light, bias and known dark taken off"),
            ("flux_err", light.sd, "standard deviation of its photons, dark and reading"),
            ("mean", light.mean, "the same without any noise"),
        )
        suffixes = ["", *("_" + name.removesuffix(" nm").replace("-", "_") for name in light.bands[1:])]
        return make_table(
            [
                ("time", stare.middle_s, "middle of the frame, from the start of the stare", "s"),
                ("frame", stare.numbers, "number of the frame, gaps included"),
                ("quality", one.staring.quality, "1 where the mean of a used pixel reaches saturation"),
                *(
                    (column + suffix, values[:, k], f"{name}: {text}", "DN / s")
                    for k, (name, suffix) in enumerate(zip(light.bands, suffixes, strict=True))
                    for column, values, text in kinds
                ),
            ],
            **{"star": one.label, "study": self.study.text(), "seed": self.study.run.seed, **one.at},
        )

    def _together(self, table_of: Callable[[StarStare], QTable]) -> QTable:
        parts = (({"star": one.label, **one.at}, table_of(one)) for one in self.stares)
        return stack_tables(parts, study=self.study.text(), seed=self.study.run.seed)

    @property
    def tables(self) -> dict[str, Table]:
        """The stares, their flares, and a light curve of each."""
        curves = {
            f"light-curve-{n}": describe_columns(self.light_curve(n - 1))
            for n, one in enumerate(self.stares, 1)
            if one.staring.stare.n_frames <= MOST_ROWS
        }
        searched = {"found": self.found} if self.study.stare.search else {}
        return {"stare": self.table, "events": self.events} | searched | curves

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        """A FITS file of each star and cell: light curve, good time intervals, dynamic spectrum."""
        from mauvecl.answers.stares.light_curve_file import light_curve_file

        return {f"light-curve-{n}.fits": partial(light_curve_file, self, n - 1) for n in range(1, len(self.stares) + 1)}

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
        from mauvecl.answers.report import rows

        tables = {"stares": self.table, "events": self.events} | (
            {"found": self.found} if self.study.stare.search else {}
        )
        return {"messages": self.messages} | {name: rows(table) for name, table in tables.items()}


@public
def stare(
    study: Study,
    engine: Stares | None = None,
    progress: Callable[[int, int], None] | None = None,
    *,
    checkpoint: Checkpoint | None = None,
) -> StareAnswer:
    """One simulated stare at every star of a study, in every cell of its sweep.

    Parameters
    ----------
    study : Study
        Its section `stare`, `events`, star, flare, sky, observation; `run.seed` and `stare.number` say which stare.
    engine : Stares, optional
        Draws it; the default device.
    progress : callable, optional
        Called as ``progress(done, total)`` in stares.
    checkpoint : Checkpoint, optional
        Keeps the frames that are drawn and the thresholds of searches.

    Raises
    ------
    InputError
        For anything in the study that cannot be.
    """
    check_sweep(study)
    # What is swept changes no frame.
    frames = stare_of(study).n_frames
    if frames > MOST_SHOWN:
        raise InputError(f"a stare of {frames} frames, each with a spectrum, expected at most {MOST_SHOWN}")
    # Everything is looked at before anything is drawn: bad input shows at once.
    prepared = [(star, at, cell, *expect_stare(cell, star)) for at, cell in study.cells() for star in cell.star]
    if engine is None:
        from mauvecl.device.stares import Stares as Default

        engine = Default()
    drawn: list[StarStare] = []
    for one_star in prepared:
        drawn.append(_drawn(study, engine, checkpoint, *one_star))
        if progress is not None:
            progress(len(drawn), len(prepared))
    messages = collect_messages([staring.quiet for _, _, _, staring, _ in prepared]) + orbit_lines(study)
    messages += dict.fromkeys(
        line for *_, cell, staring, events in prepared for line in unused_lines(cell, staring, events)
    )
    messages += [one.searched for one in drawn if isinstance(one.searched, str)]
    messages += [
        threshold_line(one.title, one.searched.threshold)
        for one in drawn
        if isinstance(one.searched, Searched) and one.searched.shifted
    ]
    for one in drawn:
        cut = int(np.count_nonzero(one.staring.quality))
        if cut:
            messages.insert(0, f"SATURATED: {cut} frames of the stare at {one.title}; their quality is 1.")
    return StareAnswer(study, drawn, messages)


def _drawn(
    study: Study,
    stares: Stares,
    checkpoint: Checkpoint | None,
    star: Star,
    at: Mapping[str, float | str],
    cell: Study,
    staring: StareExpectation,
    events: list[Event],
) -> StarStare:
    q, rays = study.stare, study.processes.processes().cosmic_rays

    def draw(components: Any) -> Any:
        def computed() -> Arrays:
            what = components, staring.stare, staring.flare
            return {"frames": stares.frames(*what, first=q.number, count=1, seed=study.run.seed, cosmic_rays=rays)[0]}

        depends_on = ("frames", components, staring.stare, staring.flare, q.number, study.run.seed, rays)
        return kept(checkpoint, depends_on, computed)["frames"]

    light = seen(staring, q.bands_nm, draw)
    searched = _searched(cell, star, staring, events, draw, checkpoint) if q.search else None
    return StarStare(label(star, staring.quiet), at, staring, _flares(cell, star, staring, events), light, searched)


def _searched(
    study: Study, star: Star, staring: StareExpectation, events: list[Event], draw: Draw, checkpoint: Checkpoint | None
) -> Searched | str:
    """What the study's search finds, or why it cannot be made."""
    try:
        known = survey_star(study, star)
        survey = replace(known.survey, components=staring.components(known.templates.weights))

        def computed() -> Arrays:
            tail = survey.tail(study.run.seed)
            return {"threshold": np.array(tail.threshold(study.search.rate).value), "shifted": np.array(tail.shifted)}

        tail = kept(checkpoint, ("threshold", survey, study.text()), computed)
        threshold = float(tail["threshold"])
    except InputError as error:
        return f"{label(star, staring.quiet)} is not searched: {error}."
    scale = _log_energy(study, star, known)
    raised = alarms(survey, known.templates, draw(survey.components), threshold, scale)
    energies, nearest = [], []
    for alarm in raised:
        fit = alarm.recovered
        if not alarm.measured:
            energies.append(float("nan"))
            nearest.append(0)
            continue
        event = _event_of(study, fit)
        energies.append(_found_energy(study, star, known.source, event))
        away = [abs(one.peak_s - event.peak_s) for one in events]
        near = int(np.argmin(away)) if away else -1
        close = near >= 0 and away[near] <= events[near].half_width_s + 2 * staring.stare.frame_s
        nearest.append(near + 1 if close else 0)
    return Searched(threshold, raised, tuple(energies), tuple(nearest), bool(tail["shifted"]))


def _event_of(study: Study, fit: FittedFlares) -> Event:
    """Return a fitted flare as an event."""
    kelvin = float(np.nan_to_num(fit.temperature_k[0], nan=study.flare.temperature_k))
    return Event(float(fit.peak_s[0]), float(fit.half_width_s[0]), float(fit.amplitude[0]), kelvin, study.search.shape)


def _log_energy(study: Study, star: Star, known: StarSurvey) -> Factor | None:
    """Return the logarithm of the energy of a second of equivalent duration over that of the temperature, or None.

    None where the star's size is unknown, or a template's temperature gives no energy.
    """
    kelvin = known.templates.temperatures_k
    one = Event(0.0, 1.0, 1.0, kelvin[0], study.search.shape)
    events = [replace(one, temperature=k) for k in kelvin]
    energies = np.array([_found_energy(study, star, known.source, event) for event in events])
    if len(kelvin) < 2 or not (np.isfinite(energies) & (energies > 0)).all():
        return None
    spline = CubicSpline(np.log(kelvin), np.log(energies / one.equivalent_duration_s))
    return lambda x: (float(spline(x)), float(spline(x, 1)))


def _found_energy(study: Study, star: Star, source: Source, event: Event) -> float:
    """Return the bolometric energy of a flare that was found, erg; NaN where the star's size is unknown.

    NaN also where flares replace photosphere and the fitted temperature is no higher than the photosphere's.
    """
    photosphere = study.flare.photosphere_temperature_k or source.temperature_k
    if study.flare.geometry == "replaces" and photosphere is not None and event.hottest_k <= photosphere:
        return float("nan")
    energy = energy_of(study, star, source, event, "bolometric")
    return float("nan") if energy is None else energy


def _flares(study: Study, star: Star, staring: StareExpectation, events: list[Event]) -> tuple[Flaring, ...]:
    source, kelvin, frames = star.source(), temperatures_of(events), staring.stare
    flares = []
    for event in events:
        energies = [energy_of(study, star, source, event, kind, kelvin) for kind in KINDS]
        band, bolometric = (float("nan") if energy is None else energy for energy in energies)
        own = coefficients([event], frames.start_s, frames.frame_s, kelvin)
        flares.append(Flaring(event, band, bolometric, staring.snr(own)))
    return tuple(flares)
