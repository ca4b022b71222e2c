"""Analysis of observed frames: flares, their energies, and those that a neighbour would explain."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np

from mauvecl.answers.answer import Answer, TableOf, answer_metadata
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.fits.flare_model import FlareModel
from mauvecl.fits.spectrum import Measurement
from mauvecl.host.orbit.orbit import Target
from mauvecl.host.stars.flare import check_scales
from mauvecl.observations.analysis import CANDIDATES, Analysis, analyse_frames
from mauvecl.observations.events import GAP_FRAMES, ObservedEvent
from mauvecl.observations.frame_files import read_frames
from mauvecl.observations.frame_model import FrameModel
from mauvecl.observations.frames import Frames, Reason, barycentric
from mauvecl.observations.spectra import EventSpectrum, event_colour
from mauvecl.observations.visits import flux_per_dn
from mauvecl.schema.columns import Column, View, formatted, interval, interval_columns, number, percent
from mauvecl.schema.errors import InputError, counted
from mauvecl.schema.fields import DAY_S
from mauvecl.study.cases import Case, Use, cases
from mauvecl.study.star import Star

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.device.engine import Engine
    from mauvecl.runs.pool import Pool
    from mauvecl.study.study import Study


def blended_stars(cases: Sequence[Case]) -> list[tuple[str, float, float]]:
    """Return the stars in the fibre of the observed star, itself first: name, separation in arcsec, and rise.

    The rise is that of all stars' light by a flare of unit amplitude on this star, relative to their light. Raises
    InputError for several cases.
    """
    if len(cases) != 1:
        raise InputError(
            "neighbours of observed frames need the one star that was observed, such as `star=G2V` with its magnitude, "
            f"not {len(cases)} stars",
            key="star",
        )
    (case,) = cases
    flare, near, quiet = case.study.flare, case.neighbours, case.quiet
    check_scales(flare.light())
    assert near is not None
    total = float((quiet.source_electrons + quiet.neighbour_electrons).sum())
    # The observed star, and its neighbours as if all of their light entered.
    stars = [(case.label, 0.0, 1.0, case.source)]
    stars += [(star.name, star.separation_arcsec, near.share, star.source) for star in near.within(case.instrument)]
    rises = []
    for name, separation_arcsec, share, source in stars:
        flaring, without = case.expect(source.flaring(1.0, spectrum=flare.light(), band=flare.band), source)
        added = float((flaring.source_electrons - without.source_electrons).sum())
        rises.append((name, separation_arcsec, share * added / total))
    return rises


#: Columns of flares on the stars in the fibre that would look like an observed event.
COLUMNS = (
    Column("date", "", "", "of the brightest frame of the event", "event at", lambda text: text[:22], kind=str),
    Column("ampl_rec", "", "", "largest rise of the light of all stars", "rise of all light", percent(".3g")),
    Column("star", "", "", "star on which the flare would be", "star", kind=str),
    Column("separation", "", "arcsec", "from the observed star", "arcsec", ".4g"),
    Column("amplitude", "", "", "rise of this star alone, in the flare's band, at the brightest frame, for a "
           "flare that looks like the event", "flare of the star", percent(".4g")),
    Column("equivalent_duration", "", "s", "of that flare, in the flare's band; nan: no flare", "ED (s)",
           number(".4g")),
)  # fmt: skip

#: Name of the bolometric energy among measured quantities.
ENERGY = "energy bolometric"
#: Star that replaces one that is not named, far from saturation; fluxes of flares do not depend on it.
ANY_STAR = Star(library="G2V", magnitude=12.0)


@dataclass(frozen=True, eq=False)
class EventRow:
    """An event with the analysis that it belongs to."""

    analysis: Analysis
    event: ObservedEvent
    spectrum: EventSpectrum | None  # in spectra that are searched with weights for flares
    measured: Measurement | str  # the flare fitted to its spectrum, or the reason why none is

    @property
    def unmeasured(self) -> str:
        """Why temperature or energy are not measured; empty if they are."""
        if isinstance(self.measured, str):
            return self.measured
        if ENERGY in self.measured.names:
            return ""
        need = "name the star that was observed, and its distance (star.distance_pc)"
        return f"the distance of the star is not known: {need}"

    def quantity(self, name: str) -> tuple[float, float, float]:
        """Return estimate and 68 % interval of a measured quantity; NaN if it is not measured."""
        fit = self.measured
        if isinstance(fit, str) or name not in fit.names:
            return (float("nan"),) * 3
        k = fit.column(name)
        return float(fit.estimates[0, k]), float(fit.low[0, 0, k]), float(fit.high[0, 0, k])

    def time_d(self, frame: int) -> float:
        """Return the time of a searched frame, in days."""
        return float(self.analysis.survey.time_s[frame]) / DAY_S

    @property
    def date(self) -> str:
        """Date of the brightest frame."""
        return self.analysis.frames.date(float(self.analysis.survey.time_s[self.event.brightest]))

    @property
    def significant(self) -> bool:
        """True if noise reaches the statistic at most as often as the study allows."""
        return self.event.value >= self.analysis.threshold

    @property
    def verdict(self) -> str:
        """Judgement of the event: a detected flare, a candidate, rejected as an event of another kind, or undecided.

        Where the throughput changes, only a spectrum that is clearly that of a flare makes an event a detection, and in
        a light curve its peak must not be in a gap. Where the fitted process does not describe the light, or most
        frames are in events, its false-alarm rate is not known.
        """
        if self.analysis.crowded:
            return "undecided"
        if self.event.kind != "flare":
            return "rejected"
        if not self.analysis.likeness.alike:
            return "undecided"
        if self.spectrum is None:
            # The light of many instruments is wrong for hours after a gap, and decays.
            doubtful = self.peak_in_gap
        else:
            doubtful = self.spectrum.ambiguous and self.analysis.light_misleads
        return "detected" if self.significant and not doubtful and not self.unclear else "candidate"

    @property
    def peak_in_gap(self) -> bool:
        """True if the peak of the largest fitted flare is in a gap, or before or after all frames."""
        if self.event.peak_observed:
            return False
        stare = self.analysis.survey.stare
        after = int(np.searchsorted(stare.start_s, self.event.flares[0].peak_s))
        around = stare.numbers[max(after - 1, 0) : after + 1]
        return around.size < 2 or int(np.ptp(around)) > GAP_FRAMES

    @property
    def unclear(self) -> bool:
        """True if the frames of an event in a light curve are together fainter than the star."""
        return self.event.unclear and not self.analysis.survey.weighted

    @property
    def fitted_s(self) -> tuple[float, float, float, float, float]:
        """Equivalent duration of the whole flare and the ends of its 68 and 95 % intervals; NaN if it is no flare."""
        event = self.event
        if event.kind != "flare":
            return (float("nan"),) * 5
        # The level at the peak is that of the sum over wavelength.
        times = event.level * self.analysis.level_ratio if self.analysis.dark_misleads else 1.0
        (low, low_95), (high, high_95) = event.low_s, event.high_s
        return times * event.fitted_s, times * low, times * high, times * low_95, times * high_95

    def in_white_light(self, value: float) -> float:
        """Return a value that follows from the sum over wavelength; NaN if the dark current changes this."""
        return float("nan") if self.analysis.dark_misleads else value

    @cached_property
    def colour(self) -> tuple[float, float, float]:
        """Blue over red rise with its error, and the p-value of no colour; NaN without spectra with errors."""
        analysis, frames = self.analysis, self.analysis.frames
        if frames.flux.ndim == 1 or frames.error is None:
            return (np.nan,) * 3
        used = np.flatnonzero(analysis.level.used)
        inside, quiet = np.zeros((2, frames.n_frames), np.bool_)
        inside[used[self.event.first : self.event.last + 1]] = True
        quiet[used] = analysis.level.quiet[used] & ~analysis.inside
        return event_colour(frames.flux, frames.error, inside, quiet)

    @property
    def note(self) -> str:
        """Statements about the event that a reader must know."""
        event = self.event
        reasons = {"step": "a step of the level fits better than a flare",
                   "dip": "its frames lack the light of a flare: the star becomes fainter in them"}  # fmt: skip
        notes = [reasons.get(event.kind, ""), self.spectrum.reason if self.spectrum is not None else ""]
        if event.is_limit:
            notes.append("a gap or an end of the frames cuts it: the summed ED is a lower limit")
        elif event.cut:
            notes.append("it reaches a gap or an end of the frames")
        frames = "1 missing frame is" if event.missing == 1 else f"{event.missing} missing frames are"
        notes += [f"{frames} interpolated"] if event.missing else []
        if event.kind == "flare" and event.poor:
            notes.append("no shape fits it within its noise: its interval includes other shapes but may be too narrow")
        if event.kind == "flare" and self.unclear:
            notes.append("its frames are together fainter than the level by more than its error")
        if event.kind == "flare" and not event.peak_observed:
            looks = ": light that settles after a gap looks alike" if self.peak_in_gap else ""
            notes.append(f"no frame shows its peak{looks}")
        elif event.kind == "flare" and event.gap_at_peak:
            notes.append("frames next to its brightest one are missing: they may have held its peak")
        return "; ".join(filter(None, notes))


#: Columns of the table of events; names as in AltaiPony's flare tables where it has the quantity.
EVENTS = (
    Column("date", description="of the brightest frame, in the time scale of the file", heading="brightest at",
           format=lambda text: text[:19], kind=str),
    Column("tstart", lambda row: row.time_d(row.event.first), "d", "middle of the first frame, from time zero"),
    Column("tpeak", lambda row: row.time_d(row.event.brightest), "d", "middle of the brightest frame"),
    Column("tstop", lambda row: row.time_d(row.event.last), "d", "middle of the last frame"),
    Column("istart", lambda row: row.event.first, "", "first frame, counted among the searched frames", kind=int),
    Column("istop", lambda row: row.event.last, "", "last frame, inclusive", kind=int),
    Column("cstart", lambda row: row.analysis.frames.numbers[row.analysis.level.used][row.event.first], "",
           "first frame, counted on the grid of the cadence with gaps", kind=int),
    Column("cstop", lambda row: row.analysis.frames.numbers[row.analysis.level.used][row.event.last], "",
           "last frame, likewise", kind=int),
    Column("total_n_valid_data_points", lambda row: row.analysis.survey.stare.n_frames, "", "searched frames",
           kind=int),
    Column("dur", lambda row: row.time_d(row.event.last) - row.time_d(row.event.first) + row.analysis.frames.cadence_s
           / DAY_S, "d", "from the start of the first frame to the end of the last", "duration (min)",
           lambda days: formatted(1440 * days, ".3g"), detail=True),
    Column("ampl_rec", lambda row: row.in_white_light(row.event.amplitude), "", "largest flux above the level, "
           "relative to the level; nan: the dark current changes the level", "peak", percent(".3g")),
    Column("ed", lambda row: row.fitted_s[0], "s", "recommended equivalent duration, of the whole flare: the light "
           "that is observed, and the shape where it is not; proportional to the energy; nan: no flare", "ED (s)",
           number(".4g")),
    *interval_columns("ed_{}", lambda row: row.fitted_s[1:3], "s", "its 68 % interval, which includes the errors of "
                      "level and shape", "68 %", interval(".4g")),
    *interval_columns("ed_{}_95", lambda row: row.fitted_s[3:], "s"),
    Column("ed_rec", lambda row: row.in_white_light(row.event.summed_s), "s", "equivalent duration in the "
           "frames of the event: sum of the flux above the level, relative to the level at the peak; nan: the dark "
           "current changes the level", "ED in frames (s)", number(".4g"), detail=True),
    Column("ed_rec_err", lambda row: row.in_white_light(row.event.summed_error_s), "s", "its standard error, "
           "with that of the level", "error (s)", number(".2g"), detail=True),
    Column("ed_rec_limit", "event.is_limit", "", "whether it is a lower limit, because a gap or an end cuts the flare",
           kind=bool),
    Column("ed_fit", lambda row: row.fitted_s[0], "s", "the same as ed, by its older name"),
    *interval_columns("ed_fit_{}", lambda row: row.fitted_s[1:3], "s", "its 68 % interval"),
    Column("shape", "event.shape", "", "shape of the flares that fits best", kind=str),
    Column("half_width", lambda row: row.event.flares[0].half_width_s, "s",
           "t_1/2 of the largest flare fitted to it; nan: none", "half-width (s)", number(".3g"), detail=True),
    Column("components", lambda row: len(row.event.flares), "", "flares fitted together", kind=int),
    Column("value", "event.value", "", "statistic of the search: S/N of the best template", "S/N", number(".4g")),
    Column("rate_normal", lambda row: row.analysis.false_alarms(row.event)[0], "1 / d",
           "false alarms per star-day above this statistic in light curves of the fitted process"),
    Column("rate_measured", lambda row: row.analysis.false_alarms(row.event)[1], "1 / d",
           "the same with residuals resampled from quiescent frames"),
    Column("probability", lambda row: float(-np.expm1(-max(row.analysis.false_alarms(row.event)) * row.analysis.days)),
           "", "probability of such an event from noise anywhere in these frames, by the larger rate", "from noise",
           lambda p: f"{p:.1e}" if p < 0.01 else f"{p:.2g}", detail=True),
    Column("significant", "significant", "", "whether the rate is at most the wanted one", kind=bool),
    Column("verdict", "verdict", "", "detected: a flare with at most the wanted rate; candidate: a flare with a larger "
           "one, one like the changes of throughput in these frames, one of a light curve whose peak is in a gap, "
           "or one whose frames are together not brighter than the level; rejected: it resembles a flare, but its "
           "spectrum or shape is of another kind; undecided: the false-alarm rate is not known", "verdict", kind=str),
    Column("blue_over_red", lambda row: row.colour[0], "", "rise relative to the star in the blue half of the pixels "
           "over that in the red half: 1 for a change of throughput; nan: no spectra", "blue/red", number(".3g"),
           detail=True),
    Column("blue_over_red_error", lambda row: row.colour[1], "", "its standard error"),
    Column("p_no_colour", lambda row: row.colour[2], "", "probability of a spectrum at least as different from the "
           "star's if the event has no colour, as a change of throughput"),
    Column("temperature", lambda row: row.quantity("temperature")[0], "K", "temperature of a blackbody fitted to the "
           "summed spectra of the event; nan: not measured", "temperature (K)", number(".4g"), detail=True),
    *interval_columns("temperature_{}", lambda row: row.quantity("temperature")[1:], "K", "its 68 % interval"),
    Column("energy", lambda row: row.quantity(ENERGY)[0], "erg", "bolometric energy in the frames of the event",
           "energy (erg)", number(".3g"), detail=True),
    *interval_columns("energy_{}", lambda row: row.quantity(ENERGY)[1:], "erg", "its 68 % interval"),
    Column("unmeasured", "unmeasured", "", "why temperature or energy are not measured", kind=str),
    Column("snr_flare", lambda row: float("nan") if row.spectrum is None else row.spectrum.snr, "", "S/N of a flare in "
           "the event's spectrum if star, dark current and sky changed by any amount"),
    Column("kind", "event.kind", "", "flare, or what resembles one: step of the level, edge of a dip, change of "
           "throughput, dark current or sky, cosmic ray", "kind", kind=str, detail=True),
    Column("note", "note", "", "remarks on the event", kind=str),
)  # fmt: skip
#: Columns of the table of frames, one row for all frames of an analysis.
FRAMES = (
    Column("time", lambda row: row.frames.time_s / DAY_S, "d", "middle of the frame, from time zero"),
    Column("flux", "flux", "", "light in the unit of the file; for spectra, the sum over wavelength"),
    Column("level", "level.level", "", "quiescent level"),
    Column("level_error", "level.level_error", "", "standard error of the level"),
    Column("error", "level.error", "", "standard deviation of a quiescent frame"),
    Column("reason", lambda row: Reason.words(row.level.reasons), "",
           "why the frame is not searched; empty if it is"),
    Column("quality", lambda row: np.zeros(row.frames.n_frames, np.int64) if row.frames.quality is None
           else row.frames.quality, "", "quality flag of the file"),
    Column("excluded_by", lambda row: np.array(row.frames.flags), "", "bits of the flag that exclude the frame"),
    Column("rays", lambda row: np.zeros(row.frames.n_frames, np.int64) if row.spectra is None
           else row.spectra.cleaned.rays, "", "single values that a fit to the other pixels replaces, such as those of "
           "cosmic rays"),
)  # fmt: skip
#: Columns of the measured quantities of an event, one row for each.
MEASURED = (
    Column("date", "", "", "brightest frame of the event", "event", lambda text: text[:22], kind=str),
    Column("quantity", "measured.names", "", "what is measured", "quantity", kind=str),
    Column("unit", "measured.units", "", "of estimate and intervals", "unit", kind=str),
    Column("estimate", lambda row: row.measured.estimates[0], "", "of maximum likelihood", "estimate", number(".4g")),
    *interval_columns("{}", lambda row: (row.measured.low[0, 0], row.measured.high[0, 0]), "", "the 68 % interval",
                      "68 %", interval(".4g")),
    *interval_columns("{}_95", lambda row: (row.measured.low[1, 0], row.measured.high[1, 0])),
    Column("p_value", "measured.p_value", "", "probability of a worse fit of a blackbody"),
)  # fmt: skip
#: Columns of the noise per pixel, one row for all pixels.
PIXELS = (
    Column("wavelength", "wavelength_nm", "nm", "middle of the pixel"),
    Column("stated", "stated", "", "standard deviation of a quiescent frame, as stated or by the instrument's model"),
    Column("measured", "measured", "", "from differences of neighbouring quiescent frames, without changes of light "
           "and dark current that all pixels share"),
    *interval_columns("{}", of="the range of 95 % of noise of the stated size"),
    Column("departs", "departs", "", "whether the search uses the measured noise"),
)  # fmt: skip
#: Columns of the changes of throughput, one row per change.
THROUGHPUT = (
    Column("date", lambda row: row[0].date(row[0].time_s[row[1].frame]), "", "first frame after the change", kind=str),
    Column("time", lambda row: row[0].time_s[row[1].frame] / DAY_S, "d", "middle of this frame, from time zero"),
    Column("frames", lambda row: row[1].width, "", "frames before and after the change whose means are compared",
           kind=int),
    Column("change", lambda row: row[1].change, "", "of the light that all pixels share, relative to the quiescent "
           "star"),
    Column("error", lambda row: row[1].error, "", "standard error of the change"),
)  # fmt: skip
#: Columns of the completeness, one row per half-width and equivalent duration.
COMPLETENESS = (
    Column("half_width", lambda row: row.completeness.half_widths_s[:, None], "s", "t_1/2 of the injected flares"),
    Column("equivalent_duration", lambda row: row.level_ratio * row.completeness.equivalent_durations_s, "s",
           "of the injected flares"),
    Column("injected", "completeness.injected", "", "number of injections"),
    Column("detected", "completeness.detected", "", "number that the search detects"),
)  # fmt: skip
#: Columns of the limits, one row per half-width.
LIMITS = (
    Column("half_width", "completeness.half_widths_s", "s", "t_1/2 of the flares", "half-width (s)", number(".3g")),
    Column("limit", lambda row: row.level_ratio * np.array([row.completeness.limit(k) for k in
                                                            range(len(row.completeness.detected))]), "s",
           "equivalent duration of flares that are detected with a probability of 90 %; nan: above the largest "
           "injected", "ED detected at 90 % (s)", number(".4g", "not reached")),
)  # fmt: skip
#: Columns of the models of the quiescent light, one row per combination of terms.
PROCESS = (
    Column("terms", lambda row: row[0], "", "terms of the process, and independent noise",
           "model of the quiescent light", kind=str),
    Column("bic", lambda row: row[1], "", "Bayesian information criterion less the smallest; the smallest is used",
           "BIC above the least", number(".3g")),
)  # fmt: skip
#: Columns of the noise, one row per number of frames.
NOISE = (
    Column("frames", "frames", "", "frames in a mean", "frames in a mean", kind=int),
    Column("count", "count", "", "number of means", "means", kind=int),
    Column("measured", "measured", "", "standard deviation of the means, in units of the noise of one frame",
           "scatter", number(".3g")),
    Column("white", "white", "", "the same for independent frames", "independent", number(".3g")),
    *interval_columns("{}", "", "", "the range of 95 % of light curves of independent frames", "95 % of independent",
                      interval(".3g")),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class AnalyseAnswer(Answer):
    """Answer of `analyse`: events in observed frames, what is measured of them, noise and limits of the search."""

    USES = ("templates", "seed")

    study: Study
    analysis: Analysis
    why_summed: str = ""  # why spectra are searched as their sum over wavelength; empty if they are not

    #: One row per event, in order of time.
    events = TableOf("events", EVENTS, "rows", key="events", meta=lambda answer: {
        **answer_metadata(answer, "study"), **answer.analysis.frames.time_keywords, "star": answer.analysis.frames.name,
        **answer_metadata(answer, "analysis.frames.unit", "analysis.threshold")})  # fmt: skip
    #: One row per frame: flux, level, noise, and why it is not searched.
    frames = TableOf("frames", FRAMES, "analysis", meta=lambda answer: {
        "star": answer.analysis.frames.name, "unit": answer.analysis.frames.unit,
        **answer.analysis.frames.time_keywords})  # fmt: skip
    #: One row per event and measured quantity, with intervals.
    measured = TableOf(
        "measured", MEASURED, lambda answer: [row for row in answer.rows if not isinstance(row.measured, str)],
        when="analysis.spectra", meta=(),
        title=lambda answer: "Measured in the summed spectra of each event" if len(answer.measured) else "",
    )  # fmt: skip
    #: One row per event and star in the fibre: the flare of that star which would look like the event.
    neighbour_flares = TableOf(
        "neighbour-flares", COLUMNS, "_flares_of_stars", when="study.has_neighbours",
        title=lambda answer: answer.analysis.events and "Flares of each star in the fibre that would look like these "
        f"events: {answer.study.flare.light().describe()}, amplitudes in the {answer.study.flare.band} band, for light "
        "that is that of all stars in the fibre",
    )  # fmt: skip
    #: One row per half-width and size of injected flares.
    completeness = TableOf("completeness", COMPLETENESS, "analysis", when="_has_level",
                           meta=("analysis.threshold",))  # fmt: skip
    #: One row per half-width: the smallest flare that the search detects with a probability of 90 %.
    limits = TableOf("limits", LIMITS, "analysis", key="limits", when="_has_level", meta=(),
                     title="Smallest flares that would have been detected, by injecting into these frames")  # fmt: skip
    #: One row per number of frames: scatter of their means.
    noise = TableOf("noise", NOISE, "analysis.scatter", key="noise", meta=(),
                    title="Noise of quiescent frames, less the fitted process")  # fmt: skip
    #: One row per combination of terms that was tried for the quiescent light, with its criterion.
    process = TableOf(
        "process", PROCESS, lambda answer: sorted(answer.analysis.level.process.bic, key=itemgetter(1)), meta=(),
        title="What was tried for the quiescent light",
    )  # fmt: skip
    #: One row per pixel of spectra: noise as stated and as measured.
    pixels = TableOf("noise-per-pixel", PIXELS, "analysis.spectra.noise", when="analysis.spectra",
                     meta=("analysis.frames.unit",))  # fmt: skip
    #: One row per sudden change of the light that all pixels of spectra share.
    throughput = TableOf("throughput", THROUGHPUT, lambda answer: [
        (answer.analysis.spectra.cleaned.frames, change) for change in answer.analysis.spectra.changes
    ], when="analysis.spectra", meta=())  # fmt: skip

    @property
    def _has_level(self) -> bool:
        """True unless a changing dark current and an unknown star leave the level of the light unknown."""
        return bool(np.isfinite(self.analysis.level_ratio))

    @property
    def _flares_of_stars(self) -> Iterator[dict[str, object]]:
        """Rows of `neighbour_flares`."""
        stars = blended_stars(cases(self.study, swept=False))
        for row, (name, separation_arcsec, rise) in product(self.rows, stars):
            amplitude, times = row.in_white_light(row.event.amplitude), 1.0 / rise if rise else float("inf")
            yield {
                "date": row.date, "ampl_rec": amplitude, "star": name, "separation": separation_arcsec,
                "amplitude": times * amplitude, "equivalent_duration": times * row.fitted_s[0],
            }  # fmt: skip

    @property
    def messages(self) -> list[str]:
        near = list[str]()
        for case in self.observed if self.study.has_neighbours else ():
            near += case.neighbours.messages(case.label, case.instrument) if case.neighbours is not None else []
        return [*near, *filter(None, [self.why_summed]), *self.analysis.messages]

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses: the instrument only for spectra of its pixels."""
        if self.study.has_neighbours:
            return (*self.USES, "instrument", "sky", "flare")
        return (*self.USES, "instrument", "sky") if self.analysis.spectra is not None else self.USES

    @property
    def rows(self) -> list[EventRow]:
        """Events in order of time."""
        analysis = self.analysis
        columns = zip(analysis.events, analysis.event_spectra, analysis.measurements, strict=True)
        return [EventRow(analysis, *values) for values in columns]

    @property
    def json_tables(self) -> dict[str, Table]:
        """Tables in JSON by key; light curves have no measured quantities."""
        return super().json_tables | {"measured": self.measured}

    @property
    def headline(self) -> str:
        """The number of detected flares, with the expected false alarms."""
        verdicts = [row.verdict for row in self.rows]
        number, undetected = verdicts.count("detected"), len(verdicts) - verdicts.count("detected")
        flares = f"{counted(number, 'flare')} {'is' if number == 1 else 'are'}" if number else "No flare is"
        more = f", and {counted(undetected, 'more event')} listed" if undetected else ""
        # Dips raise the threshold, and simulated light curves do not show the rates of many alarms in each.
        analysis = self.analysis
        reached = max(alarms.rate(analysis.threshold) for alarms in (analysis.modelled, analysis.measured))
        expected = min(analysis.rate, reached) * analysis.days
        return (
            f"{flares} detected in {self.analysis.days:.3g} star-days of {self.analysis.frames.name}, where "
            f"{expected:.2g} are expected from noise alone{more}."
        )

    @property
    def views(self) -> list[View]:
        analysis = self.analysis
        where = f"in {analysis.days:.3g} star-days of {analysis.frames.name}"
        rate, frequent = (
            f"at most {counted(rate, 'false alarm', spec='.3g')} per star-day"
            for rate in (analysis.rate, max(analysis.rate, CANDIDATES))
        )
        candidates = f"{analysis.candidates:.2f} ({frequent})"
        if not analysis.events:
            return [View(f"Nothing above {candidates} {where}."), *super().views]
        title = f"Events {where}; detected above {analysis.threshold:.2f} ({rate}), candidates above {candidates}"
        return [AnalyseAnswer.events.view(self, title), *super().views]

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        return self.report("analyse", self.study.data.report)

    @property
    def remarks(self) -> list[str]:
        return [f"{row.date[:19]}: {row.note}." for row in self.rows if row.note]


@by_keywords("frames, as the share of the work that is done")
def analyse(
    study: Study, engine: Engine | Pool | None = None, progress: Progress = None, *, frames: Frames | None = None
) -> AnalyseAnswer:
    """Find the flares in observed frames, with false-alarm rates from the noise as measured.

    The study's `data.file` is read, and its `search.false_alarms` are allowed for a detection; fainter events are
    candidates, down to one false alarm per star-day. With `data.barycentric` times become those at the Solar System's
    barycentre, by the satellite's orbit.

    Parameters
    ----------
    frames : Frames, optional
        Frames in memory, in place of the file.
    """
    if frames is None:
        if study.data.file is None:
            raise InputError("no observed frames are given; use data.file, or frames", key="data.file")
        frames = read_frames(study.data.file, study.data.mapping, quality_bits=study.data.quality_bits,
                             ignore_checksum=study.data.ignore_checksum)  # fmt: skip
    if study.data.barycentric is not None:
        has_orbit = study.orbit.tle is not None or "mauve" in frames.instrument.lower()
        frames = barycentric(frames, Target.of(study.data.barycentric), study.orbit.orbit() if has_orbit else None)
    search, model = study.search, frame_model(study, frames)
    if study.has_neighbours:
        # Errors of the star or its neighbours are reported before the search.
        blended_stars(cases(study, swept=False))
    total, last = frames.n_frames, -1

    def report(share: float) -> None:
        """Report the share of the work in whole frames, whenever their number rises."""
        nonlocal last
        frame = round(share * total)
        if progress is not None and frame > last:
            last = frame
            progress(frame, total)

    report(0.0)
    analysis = analyse_frames(
        frames, rate=search.rate, shape=search.shape, seed=study.run.seed,
        model=model if isinstance(model, FrameModel) else None, rank=search.sums, jitters=search.spreads() or None,
        temperature_k=study.flare.temperature_k, report=report,
    )  # fmt: skip
    return AnalyseAnswer(study, analysis, model if isinstance(model, str) else "")


def frame_model(study: Study, frames: Frames) -> FrameModel | str:
    """Return the model of frames' pixels, or the reason why it is not known, which is empty for a light curve.

    The star is known if the study names exactly one. Otherwise a faint one replaces it: the fluxes of flares do not
    depend on it, and the light of the star is measured.
    """
    if frames.flux.ndim == 1:
        return ""
    (case, *_), named = cases(study, swept=False), len(study.star) == 1
    exposure_s, changes = float(np.median(frames.exposure_s)), study.observation.changes
    # An exposure consists of as many frames of equal length as come nearest to those of the instrument.
    n_frames = max(1, round(exposure_s / case.instrument.frame_s))
    if exposure_s != n_frames * case.instrument.frame_s:
        changes = changes | {"frame_s": exposure_s / n_frames}
    observation = study.observation.model_copy(update={"exposure_s": exposure_s, "changes": changes})
    case = case.with_sections(observation=observation, star=study.star if named else (ANY_STAR,))
    source = case.source
    try:
        quiet = case.quiet
        flare = FlareModel.of(
            source, case.instrument, quiet, band=study.flare.band, bands_nm=study.measure.bands_nm,
            distance_pc=case.star.distance_pc, radius_rsun=case.star.radius_rsun, order=study.observation.order,
        )  # fmt: skip
        if not named:
            # An amplitude is relative to the star.
            derived = tuple(quantity for quantity in flare.derived if quantity.name != "amplitude")
            flare = replace(flare, derived=derived)
        model = FrameModel.of(frames, quiet, flare, flux_per_dn(quiet, case.instrument))
        return replace(model, star_is_known=named)
    except InputError as error:
        return f"Spectra are searched as their sum over wavelength: {error}."
