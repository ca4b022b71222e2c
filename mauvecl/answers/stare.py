"""Stares: light curves of one star with flares, and their FITS files.

A FITS file has a light curve, good time intervals and the dynamic spectrum. The names and units of its first
table are those that lightkurve recognises (`lightkurve.read`), and with it AltaiPony: TIME in days, FLUX, FLUX_ERR,
QUALITY, CADENCENO.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, product
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicSpline

from mauvecl.answers.answer import Answer, StarInCell, TableOf, answer_metadata, first_of_several, reported
from mauvecl.answers.inject import survey_star
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.device.stares import Stares
from mauvecl.flares.frames import Draw, LightCurves, StareExpectation, draw_light_curves
from mauvecl.flares.stare import Event, Stare, check_contributions, coefficients, temperatures_of
from mauvecl.flares.stare_scene import StaresRequest
from mauvecl.host import VERSION
from mauvecl.host.arrays import Arrays, Float
from mauvecl.host.exposure.background import parse_position, parse_time
from mauvecl.host.tables.names import header_text
from mauvecl.host.tables.units import offline
from mauvecl.runs.checkpoint import Checkpoint, checkpointed
from mauvecl.schema.columns import Column, View, interval_columns, number, percent, table_of, with_error
from mauvecl.schema.errors import InputError, Message, counted
from mauvecl.schema.fields import DAY_S
from mauvecl.search import false_alarms
from mauvecl.search.alarms import Alarm, alarms
from mauvecl.study.cases import Case, cases, collect_messages, place_columns
from mauvecl.study.plan import targets_of
from mauvecl.study.questions import check_sweep
from mauvecl.study.stare import orbit_lines, threshold_line
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.io import fits
    from astropy.table import QTable, Table

    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.search.survey import Factor
    from mauvecl.study.observation import SkyLight

#: Start of a stare whose study names no time: 2026-01-01, MJD. The choice is arbitrary.
NO_TIME_MJD = 61_041.0


def light_curve_file(star: StarStare, sky: SkyLight, *, seed: int, number: int) -> bytes:
    """Return the FITS file of the stare of some number at a star; `sky` has its position and time."""
    from astropy.io import fits

    primary, times = fits.PrimaryHDU(), _times(star.staring.stare, sky)
    instrument = header_text(star.staring.quiet.instrument)
    primary.header.update({
        "OBJECT": (header_text(star.label), "star, simulated"),
        "TELESCOP": (instrument, "simulated"),
        "INSTRUME": (instrument, ""),
        "CCD-TEMP": (float(star.staring.stare.temperature_c.mean()), "[Celsius] detector, mean of the frames"),
        "CREATOR": (f"mauvecl {VERSION}", ""),
        "SEED": (str(seed), "of the draws"),
        "STARENO": (number, "number of the stare"),
    })  # fmt: skip
    if sky.target is not None:
        with offline():
            place = parse_position(sky.target).icrs
        position = {"RA_OBJ": (place.ra.deg, "[deg]"), "DEC_OBJ": (place.dec.deg, "[deg]")}
        primary.header.update({"RADESYS": "ICRS", **position})
    start, stop = star.staring.stare.gtis.T / DAY_S
    gti = [fits.Column("START", "D", "d", array=start), fits.Column("STOP", "D", "d", array=stop)]
    hdus = [primary, _table(star), fits.BinTableHDU.from_columns(gti, name="GTI")]
    for table in hdus[1:]:
        table.header.update(times)
    for name, values in (("SPECTRUM", star.light.spectrum), ("SPECTRUM_ERR", star.light.spectrum_sd)):
        hdus.append(fits.ImageHDU(np.asarray(values, np.float32), name=name))
        hdus[-1].header["BUNIT"] = ("adu/s", "of a resolution element; rows are frames")
    nm = fits.Column("WAVELENGTH", "D", "nm", array=star.light.element_nm)
    content = io.BytesIO()
    fits.HDUList([*hdus, fits.BinTableHDU.from_columns([nm], name="WAVELENGTH")]).writeto(content)
    return content.getvalue()


def _times(stare: Stare, sky: SkyLight) -> dict[str, tuple[str | float, str]]:
    """Return the keywords that state the times of a stare."""
    start, comment = NO_TIME_MJD, "arbitrary: no time was named"
    if sky.time is not None:
        start, comment = float(parse_time(sky.time).utc.mjd), "start of stare"
    return {
        "TIMESYS": ("UTC", ""),
        "TREFPOS": ("TOPOCENTER", "at the satellite"),
        "TIMEPIXR": (0.5, "times are middles of frames"),
        "MJDREFI": (int(start), comment),
        "MJDREFF": (float(start - int(start)), ""),
        "TIMEUNIT": ("d", ""),
        "TIMEDEL": (stare.frame_s / DAY_S, "one frame"),
        "EXPOSURE": (stare.observed_s / DAY_S, "d in frames"),
        "TSTART": (0.0, ""),
        "TSTOP": (stare.duration_s / DAY_S, ""),
    }


def _table(star: StarStare) -> fits.BinTableHDU:
    """Return the light curve in all bands."""
    from astropy.io import fits

    stare, light = star.staring.stare, star.light
    columns = [
        fits.Column("TIME", "D", "d", array=stare.middle_s / DAY_S),
        fits.Column("CADENCENO", "J", array=stare.numbers),
        fits.Column("QUALITY", "J", array=star.staring.quality),
    ]
    for (k, band), (kind, (attribute, _)) in product(enumerate(light.bands), LIGHT.items()):
        name = kind.upper() + band_suffix(band, k)
        columns.append(fits.Column(name, "E", "adu/s", array=getattr(light, attribute)[:, k]))
    if star.pointing_loss is not None:
        columns.append(fits.Column("POINTING_LOSS", "E", array=star.pointing_loss))
    hdu = fits.BinTableHDU.from_columns(columns, name="LIGHTCURVE")
    hdu.header["BANDS"] = ", ".join(light.bands)
    hdu.header["COMMENT"] = "FLUX: star and sky, bias and known dark taken off. MEAN: the same without noise."
    hdu.header["COMMENT"] = "TIME: middle of the frame, days after MJDREF. QUALITY 1: saturated pixels. 0: none."
    if star.pointing_loss is not None:
        hdu.header["LOSTFRMS"] = (star.drifting_frames, "frames that lost light, assumed drifts")
        hdu.header["COMMENT"] = "POINTING_LOSS: share of all light lost in the frame, as drawn."
    return hdu


@dataclass(frozen=True, eq=False)
class StareFlare(StarInCell):
    """A flare of a stare, with its energies and S/N."""

    event: Event
    band_erg: float  # NaN if the star's size is unknown
    bolometric_erg: float  # NaN if the star's size is unknown
    snr: float  # of the matched filter for this flare


@dataclass(frozen=True, eq=False)
class FoundFlare(StarInCell):
    """A flare that the search of a stare found."""

    alarm: Alarm
    bolometric_erg: float  # of the fit; NaN if the star's size is unknown
    # Number of the nearest flare of the stare within a half-width and two frames, from 1 on; 0 if there is none, and -1
    # if the fit gives no time.
    event: int


@dataclass(frozen=True, eq=False)
class StarStare(StarInCell):
    """A stare at one star in one cell of the sweep."""

    staring: StareExpectation
    flares: Sequence[StareFlare]
    light: LightCurves
    # Share of all light that each frame lost in pointing drifts, shape (n_frame,); None unless drifts are drawn.
    pointing_loss: Float | None
    unsearched: str = ""  # message if no search is possible
    threshold: float = float("nan")  # of the search, from importance sampling of normal noise; NaN if there is none
    shifted: bool = False  # whether it is raised for trends that the search does not remove
    found: Sequence[FoundFlare] = ()  # in descending order of the statistic

    @property
    def drifting_frames(self) -> int:
        """Number of frames that lost light in pointing drifts."""
        return 0 if self.pointing_loss is None else int(np.count_nonzero(self.pointing_loss))


#: Largest number of frames of light curves in text files; longer ones are in FITS files only.
MOST_ROWS = 100_000
#: Largest number of frames: 115 days, with spectra of 1.2 GB.
MOST_SHOWN = 2_000_000

COLUMNS = (
    Column("frames", "staring.stare.n_frames", "", "frames of the stare", "frames"),
    Column("observed", "staring.stare.observed_s", "s", "time in them", "recorded (s)", "g", detail=True),
    Column("intervals", lambda row: len(row.staring.stare.gtis), "",
           "good time intervals: runs of frames without a gap", "intervals", detail=True),
    Column("flux", lambda row: float(np.median(row.light.mean[:, 0])), "DN / s",
           "median net light of a frame, sky included, without bias and dark", "light (DN/s)", ".4g"),
    Column("frame_noise", lambda row: float(np.median(row.light.sd[:, 0] / row.light.mean[:, 0])), "",
           "standard deviation of a frame's own noise, relative to its light", "noise of a frame", percent(".3g")),
    Column("flares", lambda row: len(row.flares), "", "flares that it contains"),
    Column("threshold", "", "", "value of the search's statistic from which on it alarms",
           when=lambda answer: answer.study.stare.search),
    Column("found", lambda row: -1 if np.isnan(row.threshold) else len(row.found), "",
           "flares found; -1: not searched", when=lambda answer: answer.study.stare.search),
    Column("saturated_frames", lambda row: np.count_nonzero(row.staring.quality), "",
           "frames in which the mean of a used pixel reaches saturation", "saturated"),
    Column("drifting_frames", "", "", "frames that lost light in pointing drifts, which are assumptions",
           "drifting", when=lambda answer: answer.study.stare.pointing is not None),
)  # fmt: skip
EVENT_COLUMNS = (
    Column("peak_time", "event.peak_s", "s", "from the start of the stare; tau = 0 of the shape", "peak at (s)", ".6g"),
    Column("half_width", "event.half_width_s", "s", "t_1/2 of the shape's publication", "half-width (s)", "g",
           detail=True),
    Column("amplitude", "event.amplitude", "", "the shape's own, in the flare's band"),
    Column("peak", "event.peak", "", "highest relative rise of the photons in the flare's band", "peak",
           percent(".3g")),
    Column("temperature", "event.hottest_k", "K", "blackbody temperature, at the peak"),
    Column("equivalent_duration", "event.equivalent_duration_s", "s", "in the flare's band", "ED (s)", ".4g"),
    Column("energy_band", "band_erg", "erg", "in the flare's band; nan: star of unknown size"),
    Column("energy_bolometric", "bolometric_erg", "erg", "of all of its light", "bolometric (erg)", number(".3g")),
    Column("snr", "snr", "", "if everything but the presence of the flare is known", "S/N", ".3g"),
    Column("shape", "event.form.name", kind=str),
)  # fmt: skip


def _fitted(
    name: str, key: str, unit: str, text: str, heading: str = "", form: Any = "", *more: str, detail: bool = False
) -> list[Column]:
    """Return the columns of a fitted quantity: value, standard error, and ends of its 68 % interval."""
    # The unit of a value is the end of its name, as in `peak_s` and `peak_error_s`.
    error = re.sub("(_[sk])?$", r"_error\1", key, count=1)
    return [
        Column(name, lambda row: float(getattr(row.alarm.recovered, key)[0]), unit, text, heading, form, more,
               detail=detail),
        Column(f"{name}_error", lambda row: float(getattr(row.alarm.recovered, error)[0]), unit,
               f"{text}; standard error by curvature"),
        *interval_columns(f"{name}_{{}}", lambda row: row.alarm.intervals[key], unit, "its 68 % interval"),
    ]  # fmt: skip


FOUND_COLUMNS = (
    *_fitted("peak_time", "peak_s", "s", "from the start of the stare", "peak at (s)", number(".6g", "not measured")),
    *_fitted("amplitude", "amplitude", "", "in the flare's band", "amplitude",
             lambda value, error: f"{with_error(100 * value, 100 * error)} %" if value == value else "",
             "amplitude_error"),
    *_fitted("half_width", "half_width_s", "s", "t_1/2 of the search's shape", "half-width (s)", with_error,
             "half_width_error", detail=True),
    *_fitted("temperature", "temperature_k", "K", "blackbody temperature; one sum of a frame tells none, and fits take "
             "that of the study's flare", "temperature (K)", with_error, "temperature_error"),
    *_fitted("equivalent_duration", "equivalent_duration_s", "s", "in the flare's band"),
    Column("energy_bolometric", "bolometric_erg", "erg", "", "bolometric (erg)", number(".3g")),
    *interval_columns("energy_bolometric_{}", lambda row: row.alarm.intervals["energy"], "erg", "its 68 % interval"),
    Column("value", "alarm.rho", "", "the search's statistic when it was found: S/N of the template that fits best",
           "value", ".2f", detail=True),
    Column("event", "", "", "row of the star's flares that it is nearest to, from 1 on; 0: none near; -1: not measured",
           "flare", lambda event: str(event) if event > 0 else "" if event else "none", kind=int),
    Column("window", "alarm.block", "",
           "number of the window that it was fitted in; flares of one number were fitted together", kind=int),
    Column("chi2", "alarm.chi2", "", "of this fit"),
    Column("dof", "alarm.dof", "", "degrees of freedom of this fit", kind=int),
    Column("p_value", "alarm.p_value", "", "probability of a chi-squared at least as large where the model is right"),
    Column("note", "alarm.note", "",
           "remarks: a flare that is not measured, an interval that ends where the fit does", kind=str),
)  # fmt: skip
#: Columns of a light curve for every frame; those of the light follow for each band.
FRAME_COLUMNS = (
    Column("time", "staring.stare.middle_s", "s", "middle of the frame, from the start of the stare"),
    Column("frame", "staring.stare.numbers", "", "number of the frame, gaps included"),
    Column("quality", "staring.quality", "", "1 where the mean of a used pixel reaches saturation"),
)
LOSS_COLUMN = Column(
    "pointing_loss",
    description="share of all light that the frame lost in pointing drifts, as drawn; an observer does not know it",
)
#: Attributes of light curves and descriptions of them, by the names of columns.
LIGHT = {
    "flux": ("flux", "net light, bias and known dark taken off"),
    "flux_err": ("sd", "standard deviation of its photons, dark and reading"),
    "mean": ("mean", "the same without any noise"),
}


def band_suffix(name: str, number: int) -> str:
    """Return what the columns of a band are called after the kind of their values; nothing for the first band."""
    return "" if number == 0 else "_" + name.removesuffix(" nm").replace("-", "_")


#: Metadata of the tables.
SEED = ("study", "study.run.seed")


@dataclass(eq=False)
class StareAnswer(Answer):
    """Answer of `stare`: light curves and spectra of each stare, its flares, and those that a search finds."""

    USES = ("instrument", "sky", "flare", "processes", "stare", "seed", "sweep")

    study: Study
    stares: list[StarStare]  # one per star and cell of the sweep
    messages: list[str] = field(default_factory=list)

    #: One row per star and cell: frames, gaps, light and noise of a frame, flares.
    table = TableOf("stare", COLUMNS, "stares", by_star=True, title="One stare each", key="stares", meta=SEED)
    #: One row per flare: peak, half-width, amplitude, temperature, energies, and the S/N of its matched filter.
    events = TableOf(
        "events", EVENT_COLUMNS, lambda answer: chain.from_iterable(stare.flares for stare in answer.stares),
        by_star=True, title="Flares in them; S/N if everything but the presence of the flare is known",
        key="events", meta=SEED,
    )  # fmt: skip
    #: One row per flare that the search found: fitted values with errors, and the number of the flare in the stare.
    #: Values are NaN where the fit does not measure the flare: `note` says why.
    found = TableOf(
        "found", FOUND_COLUMNS, lambda answer: chain.from_iterable(stare.found for stare in answer.stares),
        by_star=True, key="found", when="study.stare.search", meta=SEED,
    )  # fmt: skip

    def with_star(self, columns: Sequence[Column]) -> tuple[Column, ...]:
        """Return columns after those of the star and of all swept quantities; the amplitude is that of each flare."""
        return (*place_columns(self.study.sweep), *columns)

    @property
    def headline(self) -> str:
        """The number of flares that the search of the first stare finds, or what is drawn."""
        stare = self.stares[0]
        frames, flares = stare.staring.stare.n_frames, len(stare.flares)
        of_several = first_of_several(len(self.stares), "stares")
        drawn = f"{counted(flares, 'flare')} in {counted(frames, 'frame')} of {stare.title}"
        if np.isnan(stare.threshold):
            return f"The stare has {drawn}, which {'is' if flares == 1 else 'are'} not searched for{of_several}."
        events = [flare.event for flare in stare.found]
        number_found, false, unknown = len({*events} - {0, -1}), events.count(0), events.count(-1)
        alarms = counted(false, "false alarm") if false else "no false alarms"
        rest = f"; {counted(unknown, 'alarm')} {'is' if unknown == 1 else 'are'} not measured" if unknown else ""
        return f"The search finds {number_found} of {drawn} and raises {alarms}{of_several}{rest}."

    @property
    def views(self) -> list[View]:
        views = super().views
        for stare in self.stares:
            if not np.isnan(stare.threshold):
                above = f"{stare.threshold:.2f}, {self.study.search.rate_text}"
                table = table_of(FOUND_COLUMNS, stare.found)
                views.append(View(f"Found at {stare.title} above an S/N of {above}", FOUND_COLUMNS, table))
        return views

    def light_curve(self, number: int = 0) -> QTable:
        """Return the frames of a star in a cell: time, cadence number, quality, and light in every band."""
        star = self.stares[number]
        columns = [*FRAME_COLUMNS, *(() if star.pointing_loss is None else (LOSS_COLUMN,))]
        for (k, band), (kind, (attribute, text)) in product(enumerate(star.light.bands), LIGHT.items()):
            column = Column(kind + band_suffix(band, k), itemgetter(k), "DN / s", f"{band}: {text}")
            columns.append(column.of_part(f"light.{attribute}.T"))
        return table_of(columns, [star], star=star.label, **answer_metadata(self, *SEED), **star.at)

    @property
    def tables(self) -> dict[str, Table]:
        """The stares, their flares, and a light curve of each."""
        curves = {
            f"light-curve-{n}": self.light_curve(n - 1)
            for n, star in enumerate(self.stares, 1)
            if star.staring.stare.n_frames <= MOST_ROWS
        }
        return super().tables | curves

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        """A FITS file of each star and cell: light curve, good time intervals, dynamic spectrum."""
        study, sky = self.study, self.study.sky
        if study.stare.along_orbit:
            (target,) = targets_of(study.orbit, study.plan)
            place = f"{target.ra_deg} {target.dec_deg}"
            sky = sky.model_copy(update={"time": study.orbit.start, "target": place})
        of = partial(light_curve_file, sky=sky, seed=study.run.seed, number=study.stare.number)
        return {f"light-curve-{n}.fits": partial(of, star) for n, star in enumerate(self.stares, 1)}

    @property
    def inputs(self) -> list[Expectation]:
        return [stare.staring.quiet for stare in self.stares]

    @property
    def remarks(self) -> list[str]:
        long = ", ".join(stare.title for stare in self.stares if stare.staring.stare.n_frames > MOST_ROWS)
        return [f"More than {MOST_ROWS} frames: light curves of {long} are in FITS files alone."] if long else []


@by_keywords("stares")
def stare(
    study: Study, engine: Stares | None = None, progress: Progress = None, *, checkpoint: Checkpoint | None = None
) -> StareAnswer:
    """Simulate one stare for every star and sweep value of a study; `run.seed` and `stare.number` select it.

    Parameters
    ----------
    checkpoint : Checkpoint, optional
        Keeps the frames that are drawn and the thresholds of searches.
    """
    check_sweep(study.sweep, study.stare, study.events)
    prepared = cases(study)
    # Sweeps do not change the frames.
    frames = prepared[0].stare.n_frames
    if frames > MOST_SHOWN:
        raise InputError(
            f"a stare with a spectrum for each frame must have at most {MOST_SHOWN} frames, not {frames}",
            key="stare.duration_s",
        )
    # Invalid input raises an error before anything is drawn.
    quiet = [case.stare_expectation.quiet for case in prepared]
    engine = engine or Stares()
    drawn = [_draw(case, engine, checkpoint) for case in reported(prepared, len(prepared), progress)]
    messages = collect_messages(quiet) + orbit_lines(study.stare, study.orbit, prepared[0].instrument.frame_s)
    messages += dict.fromkeys(chain.from_iterable(map(_unused_lines, prepared)))
    messages += [star.unsearched for star in drawn if star.unsearched]
    messages += [threshold_line(star.title, star.threshold) for star in drawn if star.shifted]
    for star in drawn:
        lost, drifts = star.pointing_loss, star.staring.stare.pointing
        if lost is not None and drifts is not None:
            messages.append(
                f"POINTING DRIFTS: {star.drifting_frames} of {lost.size} frames at {star.title} "
                f"{'loses' if star.drifting_frames == 1 else 'lose'} light, up to "
                f"{100 * lost.max():.3g} %; assumed: {drifts.rate_per_h:g} per hour, {drifts.duration_s:g} s long on "
                f"average, with up to {100 * drifts.depth:g} % of the light lost. The search marginalises over the "
                "level of each frame."
            )
        saturated = int(np.count_nonzero(star.staring.quality))
        if saturated:
            frames_of = f"{counted(saturated, 'frame')} of the stare at {star.title}"
            text = f"SATURATED: {frames_of}, marked by a quality of 1."
            messages.insert(0, Message(text, "saturated"))
    return StareAnswer(study, drawn, messages)


def _unused_lines(case: Case) -> list[str]:
    """Return messages about settings without effect on the stare: the exposure, and flares that peak outside it."""
    exposure_s, frame_s = case.study.observation.exposure_s, case.stare.frame_s
    frames = f"A stare consists of frames of {frame_s:g} s: observation.exposure_s = {exposure_s:g} s is not used."
    unused = [] if exposure_s == frame_s else [Message(frames, "not used")]
    return [*unused, *check_contributions(case.events, case.stare.start_s, frame_s)]


def _draw(case: Case, stares: Stares, checkpoint: Checkpoint | None) -> StarStare:
    """Draw and search the stare of a case."""
    q, seed, processes = case.study.stare, case.study.run.seed, case.study.processes.additive_only
    staring = case.stare_expectation

    def draw(components: Any) -> Any:
        arguments = components, staring.stare, 1, seed, staring.flare
        request = StaresRequest(*arguments, start=q.number, method="pixels", processes=processes)
        return checkpointed(checkpoint, ("frames", request), lambda: stares.reduced(request))["values"][0]

    light = draw_light_curves(staring, q.bands_nm, draw)
    searched = _search(case, draw, checkpoint) if q.search else {}
    drifting, numbers = staring.stare.pointing is not None, np.array([q.number], np.uint64)
    lost = staring.stare.pointing_losses(numbers, seed)[0] if drifting else None
    kelvin, flares = temperatures_of(case.events), list[StareFlare]()
    for event in case.events:
        band, bolometric = (case.energy(event, kind, kelvin) for kind in ("band", "bolometric"))
        of_flare = coefficients([event], case.stare.start_s, case.stare.frame_s, kelvin)
        flares.append(StareFlare(case.label, case.at, event, band, bolometric, staring.snr(of_flare)))
    return StarStare(case.label, case.at, staring, flares, light, lost, **searched)


def _search(case: Case, draw: Draw, checkpoint: Checkpoint | None) -> dict[str, Any]:
    """Search the stare of a case for flares, and return what it gives by the fields of `StarStare`."""
    study, staring = case.study, case.stare_expectation
    try:
        survey = survey_star(case)

        def computed() -> Arrays:
            tail = false_alarms.sampled_rate(survey, study.run.seed)
            return {"threshold": np.array(tail.threshold(study.search.rate).value), "shifted": np.array(tail.shifted)}

        tail = checkpointed(checkpoint, ("threshold", survey, study.text()), computed)
    except InputError as error:
        return {"unsearched": Message(f"{case.label} is not searched: {error}.", "not searched")}
    threshold = float(tail["threshold"])
    coloured = survey.templates.coloured
    scale = log_energy(case, survey.templates.temperatures_k if coloured else (study.flare.temperature_k,))
    raised = alarms(survey, draw(staring.components(survey.templates.weights)), threshold, scale)
    flares = [_found_flare(case, alarm) for alarm in raised]
    return {"threshold": threshold, "shifted": bool(tail["shifted"]), "found": flares}


def _found_flare(case: Case, alarm: Alarm) -> FoundFlare:
    """Return an alarm with the energy of its flare and the number of the nearest flare of the stare."""
    if not alarm.measured:
        return FoundFlare(case.label, case.at, alarm, float("nan"), -1)
    fit = alarm.recovered
    kelvin = float(np.nan_to_num(fit.temperature_k[0], nan=case.study.flare.temperature_k))
    values = (float(fit.peak_s[0]), float(fit.half_width_s[0]), float(fit.amplitude[0]))
    event = Event(*values, kelvin, case.study.search.shape)
    reach = 2 * case.stare_expectation.stare.frame_s
    away = {k: abs(injected.peak_s - event.peak_s) for k, injected in enumerate(case.events, 1)}
    nearest = min(away, key=lambda k: away[k], default=0)
    near = nearest > 0 and away[nearest] <= case.events[nearest - 1].half_width_s + reach
    return FoundFlare(case.label, case.at, alarm, _found_energy(case, event), nearest if near else 0)


def log_energy(case: Case, kelvin: Sequence[float]) -> Factor | None:
    """Return the logarithm of the energy per second of equivalent duration as a function of log temperature.

    It is a spline through the energies at temperatures, K; None if the star's size is unknown, or a template's
    temperature gives no energy.
    """
    unit = Event(0.0, 1.0, 1.0, kelvin[0], case.study.search.shape)
    events = [replace(unit, temperature=k) for k in kelvin]
    energies = np.array([_found_energy(case, event) for event in events])
    if not (np.isfinite(energies) & (energies > 0)).all():
        return None
    logs = np.log(energies / unit.equivalent_duration_s)
    if logs.size == 1:
        return lambda _: (float(logs[0]), 0.0)
    spline = CubicSpline(np.log(kelvin), logs)
    return lambda x: (float(spline(x)), float(spline(x, 1)))


def _found_energy(case: Case, event: Event) -> float:
    """Return the bolometric energy of a detected flare, erg; NaN if the star's size is unknown.

    Also NaN if flares replace photosphere and the fitted temperature is not above the photosphere's.
    """
    flare = case.study.flare
    photosphere = flare.photosphere_temperature_k or case.source.temperature_k
    if flare.geometry == "replaces" and photosphere is not None and event.hottest_k <= photosphere:
        return float("nan")
    return case.energy(event, "bolometric")
