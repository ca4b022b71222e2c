"""Signal and noise: a simulated spectrum, S/N and exposure times, and how far the root-of-N formula is right.

The formula promises three things: the S/N of a spectrum, that the true signal lies within one estimated standard
deviation of the observed one in 68.27 % of all spectra, and the false-alarm probability of a threshold.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from scipy import special

from mauvecl.answers.answer import Answer, StarInCell, TableOf, first_of_several, reported
from mauvecl.answers.detect import DetectAnswer, detect
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.detection.counts import steps_of
from mauvecl.detection.distributions import smallest_integer
from mauvecl.detection.snr import COLUMNS, SnrResult
from mauvecl.device.engine import Engine
from mauvecl.host.arrays import Float
from mauvecl.host.exposure.expectation import BUDGET_COLUMNS, Expectation
from mauvecl.noise.drawing import Cumulants
from mauvecl.noise.reference import components
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Column, number, table_of
from mauvecl.schema.errors import InputError, Message, counted
from mauvecl.schema.fields import DAY_S, FirstRealisation, Wavelength
from mauvecl.study.cases import Case, Use, cases, collect_messages, star_column, star_label
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable, Table


Per = Literal["pixel", "element"]
#: Longest time that is considered, s: many exposures, added up.
LONGEST_S = 1e7


@dataclass(frozen=True)
class Exposure:
    """Exposure time, in whole frames, that reaches an S/N."""

    star: str
    wavelength_nm: float
    per: Per
    wanted: float
    exposure_s: float
    frames: int
    snr: float
    snr_one_frame_less: float
    saturated: bool


EXPOSURE_COLUMNS = (
    star_column(),
    Column("wavelength", "wavelength_nm", "nm", "vacuum wavelength, the middle of the pixel or element"),
    Column("per", description="pixel, or element: a resolution element of the instrument"),
    Column("wanted", description="wanted S/N"),
    Column("exposure", "exposure_s", "s", "the fewest frames whose closed-form S/N reaches the wanted one",
           "exposure (s)", ".10g"),
    Column("frames", description="frames of the exposure", heading="frames"),
    Column("snr", description="closed-form S/N reached", heading="S/N", format=".3f"),
    # Rounded down, so that an insufficient S/N does not appear sufficient.
    Column("snr_one_frame_less", description="closed-form S/N of one frame less", heading="a frame less",
           format=lambda snr: f"{math.floor(1000 * snr) / 1000:.3f}"),
    Column("saturated", description="whether the pixel, or one of the element, saturates in a single frame",
           heading="saturation", format=lambda saturated: "SATURATED" if saturated else ""),
)  # fmt: skip


@dataclass(frozen=True)
class ExposureAnswer(Answer):
    """Answer of `exposure`: the shortest exposure of each star."""

    USES = ("instrument", "sky")

    study: Study
    exposures: tuple[Exposure, ...]
    messages: tuple[str, ...]
    inputs: tuple[Expectation, ...]  # each star at its exposure

    #: One row per star.
    table = TableOf(
        "exposure", EXPOSURE_COLUMNS, "exposures",
        title=lambda answer: f"Exposure for an S/N of {answer.study.signal.snr:g} per {answer.study.signal.per} at "
        f"{answer.study.signal.wavelength_nm:g} nm (closed form, whole frames)",
    )  # fmt: skip

    @property
    def headline(self) -> str:
        """The exposure of the first star."""
        first, of_several = self.exposures[0], first_of_several(len(self.exposures), "stars")
        return (
            f"{first.star} reaches an S/N of {first.wanted:g} per {first.per} at {first.wavelength_nm:g} nm in "
            f"{first.exposure_s:g} s, {counted(first.frames, 'frame')}{of_several}."
        )


def index_at(x: Expectation, wavelength_nm: float, per: Per) -> int:
    """Return the index of the pixel or element at a wavelength; raises InputError outside the spectrum."""
    first, last = float(x.wavelength_nm[0]), float(x.wavelength_nm[-1])
    if not first <= wavelength_nm <= last:
        raise InputError.of("wavelength", wavelength_nm, f"between {first:.1f} and {last:.1f} nm", unit="nm")
    pixel = int(np.argmin(np.abs(x.wavelength_nm - wavelength_nm)))
    return int(x.element[pixel]) if per == "element" else pixel


@by_keywords("stars")
def exposure(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> ExposureAnswer:
    """Compute the fewest frames whose closed-form S/N at a wavelength reaches a wanted one.

    The study's ``signal`` gives S/N and wavelength; its exposure is not used. An S/N that no exposure up to 1e7 s
    reaches, or a wavelength outside the spectrum, raises InputError if it holds of every star; of some it is reported
    by a message.
    """
    snr, wavelength_nm, per = study.signal.snr, study.signal.wavelength_nm, study.signal.per
    if snr is None or wavelength_nm is None:
        missing, key = ("S/N", "signal.snr") if snr is None else ("wavelength", "signal.wavelength_nm")
        raise InputError(f"no wanted {missing} is given; use `signal.snr` and `signal.wavelength_nm`", key=key)
    answered, failed = [], []
    prepared = cases(study, swept=False)
    for case in reported(prepared, len(prepared), progress):
        try:
            answered.append(_shortest_exposure(case, snr, wavelength_nm, per))
        except InputError as error:
            # The exposures of other stars are still computed.
            failed.append(error)
    if not answered:
        raise failed[0]
    exposures, expectations = zip(*answered, strict=True)
    messages = [Message(f"NO ANSWER: {error}.", "no answer") for error in failed] + collect_messages(list(expectations))
    for e in exposures:
        if e.exposure_s > DAY_S:
            days = f"{np.ceil(e.exposure_s / DAY_S):.0f} exposures of a day at most, added up"
            messages.append(Message(f"{e.star} needs more than a day: {days}.", "long exposure"))
    return ExposureAnswer(study, exposures, tuple(messages), expectations)


@validated
def exposure_for(
    study: Study, snr: float | None = None, wavelength_nm: Wavelength | None = None, *, per: Per | None = None
) -> ExposureAnswer:
    """Compute `exposure` for another S/N or wavelength (nm or Quantity) than those of the study's ``signal``.

    `per` is "element", a resolution element of the instrument, or "pixel".
    """
    study = study.with_changes({"signal": {"snr": snr, "wavelength_nm": wavelength_nm, "per": per}}, None, "exposure")
    return exposure(study)


def _shortest_exposure(case: Case, snr: float, wavelength_nm: float, per: Per) -> tuple[Exposure, Expectation]:
    """Return the fewest frames for an S/N, and the expectation of as many."""
    frame = case.one_frame.quiet
    place = index_at(frame, wavelength_nm, per)

    def after(frames: int) -> float:
        """Return the closed-form S/N of some frames, which may exceed one exposure."""
        x = replace(frame, n_frames=frames)
        return float((x.snr_per_element() if per == "element" else x.snr())[place])

    single = after(1)
    if not single > 0 or (snr / single) ** 2 * case.instrument.frame_s > LONGEST_S:
        fault = (
            f"{case.one_frame.label} has an S/N of {single:.3g} per {per} at {wavelength_nm:g} nm in one frame, but "
            f"must reach {snr:g} within {LONGEST_S:g} s{frame.saturation_clause}"
        )
        raise InputError(fault, key="signal.snr")
    # S/N is proportional to the root of the number of frames, so only rounding has to be corrected.
    near = int(np.ceil((snr / single) ** 2))
    frames = smallest_integer(lambda n: after(n) >= snr, max(near - 2, 0), near + 1)
    x = replace(frame, n_frames=frames)
    saturated = x.saturated[x.element == place] if per == "element" else x.saturated[[place]]
    reached, less = after(frames), after(frames - 1) if frames > 1 else 0.0
    wanted = case.one_frame.label, wavelength_nm, per, snr
    return Exposure(*wanted, x.exposure_s, frames, reached, less, bool(saturated.any())), x


def _best(title: str, x: Expectation, number: int) -> str:
    """Return the sentence on the best S/N of the first of several observations."""
    snr = x.snr_per_element()
    at = float(x.wavelength_nm[x.element == int(np.argmax(snr))].mean())
    saturated = int(x.saturated.sum())
    without = f"; {saturated} of {x.saturated.size} pixels saturate" if saturated else ""
    best = f"{title} has an S/N of up to {snr.max():.3g} per resolution element in {x.exposure_s:g} s, at {at:.0f} nm"
    return f"{best}{without}{first_of_several(number, 'cases')}."


class SimulatedObservation(NamedTuple):
    """A simulated observation."""

    title: str
    expectation: Expectation
    table: QTable  # of its components


SUMMARY_COLUMNS = (
    Column("observation", "title", description="star, and flare", heading="observation"),
    Column("frames", "expectation.n_frames", description="frames of the exposure", heading="frames", detail=True),
    Column("peak_nm", lambda row: row.expectation.wavelength_nm[row.expectation.signal_dn.argmax()], "nm",
           "wavelength of the largest mean signal", "peak (nm)", ".1f"),
    Column("peak_dn", lambda row: row.expectation.signal_dn.max(), "DN", "largest mean signal of a pixel",
           "peak (DN)", ".0f"),
    Column("snr_pixel", lambda row: row.expectation.snr().max(), "", "largest closed-form S/N of a pixel",
           "S/N pixel", ".2f"),
    Column("snr_element", lambda row: row.expectation.snr_per_element().max(), "",
           "largest closed-form S/N of an element", "S/N element", ".1f"),
    Column("saturated_pixels", lambda row: row.expectation.saturated.sum(), "", "pixels that saturate",
           "saturated", detail=True),
)  # fmt: skip


@dataclass(eq=False)
class SimulateAnswer(Answer):
    """Answer of `simulate`: one table of components per star and stage."""

    USES = ("instrument", "sky", "processes", "seed")

    ENDINGS = ("ecsv", "fits")

    study: Study
    observations: list[SimulatedObservation]
    messages: list[str]

    #: Peak, best closed-form S/N and saturated pixels of each observation.
    summary = TableOf("", SUMMARY_COLUMNS, "observations", title="One observation each (closed-form S/N)",
                      key="observations", meta=())  # fmt: skip

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses: flares only if observations have any."""
        return (*self.USES, "flare") if len(self.observations) > len(self.study.star) else self.USES

    @property
    def headline(self) -> str:
        """The best S/N of the first observation."""
        return _best(self.observations[0].title, self.observations[0].expectation, len(self.observations))

    @property
    def tables(self) -> dict[str, Table]:
        """One per observation."""
        return {f"observation-{n}": observation.table for n, observation in enumerate(self.observations, 1)}

    @property
    def inputs(self) -> list[Expectation]:
        return [observation.expectation for observation in self.observations]

    def plot(self, path: str | Path | None = None, *, number: int = 0, ax: Any = None) -> Any:
        """Plot an observation and its components; requires matplotlib."""
        return list(self.pictures.values())[number](path, ax=ax)


@by_keywords("stars")
def simulate(
    study: Study, engine: Engine | Pool | None = None, progress: Progress = None, *,
    realisation: FirstRealisation = 0, flaring: bool = False,
) -> SimulateAnswer:  # fmt: skip
    """Simulate one observation of every star of a study, by component.

    The NumPy reference draws the `realisation` of this number; if `flaring`, the flares of the study are observed, too.
    Usual unknowns are left out: the question is about the noise.
    """
    study, observations = study.ideal(), []
    prepared = cases(study, swept=False)
    for case in reported(prepared, len(prepared), progress):
        for i, x in enumerate(case.expectations if flaring else [case.quiet]):
            title = star_label(case.star, x) + (f", flare {100 * case.amplitudes[i - 1]:g} %" if i else "")
            table = components(x, realisation=realisation, seed=study.run.seed, **case.draw_options)
            table.meta["study"] = study.text()
            observations.append(SimulatedObservation(title, x, table))
    messages = collect_messages([observation.expectation for observation in observations], study.processes)
    return SimulateAnswer(study, observations, messages)


#: Wavelengths of the elements that terminal and pictures show, nm; the tables hold all of them.
SHOWN_NM = (250.0, 300.0, 400.0, 550.0)


@dataclass(frozen=True, eq=False)
class StarSnr(StarInCell):
    """S/N of a star in a cell of the sweep."""

    result: SnrResult


#: Metadata of tables of realisations.
REALISATIONS = ("study.run.realisations", "study")


@dataclass(eq=False)
class SnrAnswer(Answer):
    """Answer of `snr`: S/N of pixels and resolution elements, closed form and simulated, and noise by origin."""

    USES = ("instrument", "sky", "processes", "seed", "sweep")

    study: Study
    stars: list[StarSnr]  # one per star and cell of the sweep
    messages: list[str]

    #: S/N per resolution element, one row per star, cell and element.
    element = TableOf("snr-element", (), "stars", row_table="result.element", by_star=True, key="snr-element",
                      meta=REALISATIONS)  # fmt: skip
    #: S/N per pixel, one row per star, cell and pixel.
    pixel = TableOf("snr-pixel", (), "stars", row_table="result.pixel", by_star=True, meta=REALISATIONS)
    #: Noise by origin, DN rms per pixel, one row per star, cell and pixel.
    noise_budget = TableOf(
        "noise-budget", (), "stars", row_table=lambda _, star: star.result.expectation.noise_budget(), by_star=True,
        key="noise-budget", meta=REALISATIONS,
    )  # fmt: skip
    _shown_elements = TableOf(
        "", COLUMNS, "stars", row_table=lambda answer, star: star.result.element[answer.shown_indices(star, "element")],
        by_star=True, meta=(), title="S/N per resolution element; all of them in the files",
    )  # fmt: skip
    _shown_noise = TableOf(
        "", lambda answer: [column for column in BUDGET_COLUMNS if column.name in answer.noise_budget.colnames],
        "stars", by_star=True, meta=(), title="Noise of a pixel by origin, DN rms",
        row_table=lambda answer, star: star.result.expectation.noise_budget()[answer.shown_indices(star, "pixel")],
    )  # fmt: skip

    @property
    def headline(self) -> str:
        """The best S/N of the first star."""
        return _best(self.stars[0].subject, self.stars[0].result.expectation, len(self.stars))

    @property
    def shown_nm(self) -> list[float]:
        """The requested wavelength, those of `SHOWN_NM` within the spectrum, or its middle if it has none of them."""
        wavelength_nm, (first, last) = self.study.signal.wavelength_nm, self.inputs[0].wavelength_nm[[0, -1]].tolist()
        if wavelength_nm is not None:
            return [wavelength_nm]
        return [nm for nm in SHOWN_NM if first <= nm <= last] or [(first + last) / 2]

    def shown_indices(self, star: StarSnr, per: Per) -> list[int]:
        """Return the indices of the pixels or elements of a star at the shown wavelengths."""
        return [index_at(star.result.expectation, nm, per) for nm in self.shown_nm]

    @property
    def inputs(self) -> list[Expectation]:
        return [star.result.expectation for star in self.stars]


@by_keywords("stars")
def snr(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> SnrAnswer:
    """Simulate the S/N of every star of a study without flares, for every sweep value.

    Usual unknowns are left out: the question is about the noise.
    """
    study = study.ideal()
    prepared, run, wavelength_nm = cases(study), study.run, study.signal.wavelength_nm
    quiet, engine = [case.quiet for case in prepared], engine or Engine()
    if wavelength_nm is not None:
        # Invalid input raises an error before anything is drawn.
        for x in quiet:
            index_at(x, wavelength_nm, "element")

    def answered(case: Case) -> StarSnr:
        result = engine.snr(case.quiet, realisations=run.realisations, seed=run.seed, **case.draw_options)
        return StarSnr(case.label, case.at, result)

    if isinstance(engine, Pool):
        engine.expect(len(prepared) * run.realisations)
    stars = list(reported(map_in_order(engine, answered, prepared), len(prepared), progress))
    messages = collect_messages(quiet, study.processes)
    for star in stars:
        cut = star.result.counts.clipped[:, 1]
        clipped = cut[cut > 0]
        if clipped.size:
            share = 100 * clipped.mean() / (star.result.counts.n * star.result.expectation.n_frames)
            messages.append(
                f"{star.title}: saturation cut off {clipped.size} of {cut.size} pixels in the simulation, each of them "
                f"in {share:.3g} % of its frames on average."
            )
    return SnrAnswer(study, stars, messages)


#: Significance of reported differences, and width of a 95 % interval, in standard errors.
SURE, ERRORS_IN_INTERVAL = 4, 3.92
#: Smallest ratio of false-alarm probabilities that is distinguished.
SMALLEST_RATIO = 1e-3
_SNR_COLUMNS = {column.name: column for column in COLUMNS}
ELEMENT_COLUMNS = (
    _SNR_COLUMNS["wavelength"],
    Column("expected", description="S/N by the formula"),
    _SNR_COLUMNS["mean"],
    _SNR_COLUMNS["std"],
    Column("error", description="standard error of the mean"),
    Column("bias", description="mean over expected S/N, less one"),
    Column("coverage", description="share of 1-sigma intervals of its pixels that hold the truth; 0.6827 promised"),
)
#: Columns of the largest error of each prediction.
WORST_COLUMNS = (
    Column("best_snr", "", "", "largest S/N per element by the formula", "best S/N", ".2f", detail=True),
    Column("snr_off_by", "", "", "largest significant (4 standard errors) difference of the mean S/N from it; 0 if "
           "none", "S/N off by", "+.3f"),
    Column("at_nm", description="where", heading="at nm", format=number(".0f"), detail=True),
    Column("coverage_low", description="smallest share of 1-sigma intervals that hold the truth, of all elements",
           heading="1-sigma intervals", format=lambda low, high: f"{100 * low:.2f}-{100 * high:.2f} %",
           others=("coverage_high",), detail=True),
    Column("coverage_high", description="largest"),
    Column("five_sigma_above", description="how often a pixel lies 5 sigma above its mean, over the normal 2.9e-7; "
           "the most", heading="5 sigma above, below", format=lambda above, below: f"{above:.2f}, {below:.2f}",
           others=("five_sigma_below",), detail=True),
    Column("five_sigma_below",
           description="how often a pixel lies 5 sigma below its mean, over the normal 2.9e-7; the least"),
    Column("fap_ratio", description="most wrong false-alarm probability over the promised one; 1 if none differs, NaN "
           "if they are too rare to be counted", heading="false alarms", format=number(".3f")),
    Column("statistic", description="detection statistic", heading="statistic", detail=True),
    Column("why", description="main cause of a difference from the closed form", heading="why", detail=True),
    Column("probability_off_by", "", "", "largest significant difference of a detection probability from the closed "
           "form", "detection off by", "+.4f"),
)  # fmt: skip


def coverage(result: SnrResult) -> Float:
    """Return the coverage of intervals of one estimated standard deviation about the observed signal, shape (n_pixel,).

    The standard deviation is estimated from the observed photons and the known dark and read noise. Values are
    interpolated within the bins of the histogram of counts, 1/64 of a standard deviation or less.
    """
    observers = result.observers[: result.scene.n_pixel]
    signal = result.expectation.light_dn
    gain, variance = observers["gain"].astype(float), observers["variance"].astype(float)
    # Ends of the observed signals whose interval reaches the true one: net -+ sqrt(gain max(net, 0) + known) = signal.
    root = np.sqrt(gain**2 / 4 + gain * signal + variance)
    high = signal + gain / 2 + root
    low = signal + gain / 2 - root
    low = np.where(low < 0, signal - np.sqrt(variance), low)
    width = 2.0 ** observers["bin_shift"].astype(float)
    shares = np.empty(signal.size)
    for p in range(signal.size):
        filled, counts = result.counts.bins["pixel"].in_row(p)
        edges = width[p] * np.column_stack([filled, filled + 1]).ravel() - 0.5
        edges += float(observers["net_offset"][p])
        ends = np.interp([low[p], high[p]], edges, steps_of(counts) / result.counts.n)
        shares[p] = ends[1] - ends[0]
    return shares


def tail_probability(x: Expectation, sigmas: float) -> Float:
    """Return the probability that a pixel is more than `sigmas` standard deviations above or (negative) below its mean.

    The result has the shape (n_pixel,); for normal noise it would be the same in every pixel. It is the saddle-point
    approximation (Lugannani & Rice 1980, doi 10.2307/1426607) for Gaussian and Poisson parts together, right to 3e-3
    of the probability.
    """
    c = Cumulants.of(x, x.n_frames)
    photons = np.where(c.photon_step > 0, c.photons, 0.0)
    steps = ((c.photon_step, photons), (c.dark_step, c.dark_dn / c.dark_step))

    def cumulants(u: Float) -> tuple[Float, ...]:
        """Return the cumulant generating function of the deviation and its first two derivatives at u."""
        value, first, second = c.gaussian * u**2 / 2, c.gaussian * u, c.gaussian.copy()
        for step, mean in steps:
            value = value + mean * (np.expm1(step * u) - step * u)
            first = first + mean * step * np.expm1(step * u)
            second = second + mean * step**2 * np.exp(step * u)
        return value, first, second

    sd = np.sqrt(c.variance)
    goal, u = sigmas * sd, sigmas / sd
    for _ in range(50):
        _, first, second = cumulants(u)
        u = u - (first - goal) / second
    value, _, second = cumulants(u)
    w, v = np.sqrt(2 * (u * goal - value)), np.abs(u) * np.sqrt(second)
    return np.asarray(special.ndtr(-w) + np.exp(-(w**2) / 2) / np.sqrt(2 * np.pi) * (1 / v - 1 / w))


def _promises(result: SnrResult) -> QTable:
    """Return S/N and intervals of the formula and of the simulation, one row per resolution element."""
    table, x = result.element, result.expectation
    values = {name: np.asarray(table[name].value) for name in ("wavelength", "expected", "mean", "std")}
    values["error"] = values["std"] / np.sqrt(result.counts.n)
    with np.errstate(divide="ignore", invalid="ignore"):
        values["bias"] = values["mean"] / values["expected"] - 1.0
    values["coverage"] = x.per_element(coverage(result)) / x.per_element(np.ones(x.wavelength_nm.size))
    return table_of(ELEMENT_COLUMNS, [values], **table.meta)


@dataclass(eq=False)
class GaussianAnswer(Answer):
    """Answer of `gaussian`: errors of the predicted S/N, intervals and false alarms."""

    USES = ("instrument", "sky", "flare", "processes", "nuisances", "seed", "sweep")

    study: Study
    signal: SnrAnswer
    detection: DetectAnswer

    #: Largest error of each prediction, one row per star and cell.
    cells = TableOf(
        "gaussian", WORST_COLUMNS, "_largest_errors", by_star=True, meta=("study.run.fap", "study"),
        title=lambda answer: f"The root-of-N formula and {answer.study.run.realisations:,} realisations; promised: no "
        "difference in S/N, 68.3 % of 1-sigma intervals, as many 5-sigma pixels and false alarms "
        f"({answer.study.run.fap:g}) as normal noise has",
    )  # fmt: skip
    #: Predictions and simulation, one row per star, cell and resolution element.
    elements = TableOf("elements", (), "signal.stars", row_table=lambda _, star: _promises(star.result),
                       by_star=True, meta=("study.run.realisations", "study"))  # fmt: skip
    #: One row per star, cell and statistic: false-alarm probabilities at the formula's thresholds, with reasons.
    thresholds = TableOf("thresholds", (), "detection.departures")

    @property
    def headline(self) -> str:
        """The largest errors of the formula."""
        cells = self.cells
        snr = float(np.abs(cells["snr_off_by"]).max())
        worst = float(cells["fap_ratio"][_most_wrong(cells["fap_ratio"])])
        many = f"{'as many' if worst == 1.0 else f'up to {worst:.3g} times as many'} as promised"
        return (
            f"The root-of-N formula is {f'off by at most {snr:.2g}' if snr else 'right'} in S/N, and its false alarms "
            f"are {'too rare to be counted' if np.isnan(worst) else many}, in {counted(len(cells), 'case')}."
        )

    @property
    def messages(self) -> list[str]:
        return self.detection.messages

    @property
    def inputs(self) -> list[Expectation]:
        return self.signal.inputs

    @property
    def _largest_errors(self) -> Iterator[dict[str, Any]]:
        """Rows of `cells`."""
        stars, rare = self.signal.stars, special.ndtr(-5.0)
        for k, star in enumerate(stars):
            # Each star has as many rows as the others.
            elements, tested, flares = (
                table[k * len(table) // len(stars) : (k + 1) * len(table) // len(stars)]
                for table in (self.elements, self.thresholds, self.detection.table)
            )
            wrong = elements[np.abs(elements["mean"] - elements["expected"]) > SURE * elements["error"]]
            worst = wrong[np.argmax(np.abs(wrong["mean"] - wrong["expected"]))] if len(wrong) else None
            differing = tested[tested["differs"]]
            right = {"ratio": 1.0 if len(tested) else np.nan, "statistic": "", "why": ""}
            threshold: Any = differing[_most_wrong(differing["ratio"])] if len(differing) else right
            error = flares["probability"] - flares["closed_form_probability"]
            # The interval includes the error of the threshold.
            is_sure = np.abs(error) > (flares["high"] - flares["low"]) * SURE / ERRORS_IN_INTERVAL
            error = np.where(is_sure, error, 0.0)
            yield vars(star) | {
                "best_snr": float(elements["expected"].max()),
                "snr_off_by": 0.0 if worst is None else float(worst["mean"] - worst["expected"]),
                "at_nm": np.nan if worst is None else float(worst["wavelength"].value),
                "coverage_low": float(elements["coverage"].min()),
                "coverage_high": float(elements["coverage"].max()),
                "five_sigma_above": float((tail_probability(star.result.expectation, 5.0) / rare).max()),
                "five_sigma_below": float((tail_probability(star.result.expectation, -5.0) / rare).min()),
                "fap_ratio": float(threshold["ratio"]), "statistic": str(threshold["statistic"]),
                "why": str(threshold["why"]), "probability_off_by": float(error[np.argmax(np.abs(error))]),
            }  # fmt: skip


def _most_wrong(ratios: Any) -> int:
    """Return the index of the ratio that is furthest from 1, up or down."""
    return int(np.argmax(np.abs(np.log(np.maximum(ratios, SMALLEST_RATIO)))))


@by_keywords("stars, each of which is drawn for its S/N and then for its flares")
def gaussian(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> GaussianAnswer:
    """Compare the usual formula with the simulation, for every star and sweep value of a study.

    Without a study, and unless keywords state a sweep, magnitude or exposure: magnitudes from 4 to 12 and exposures of
    5, 50 and 600 s. Usual unknowns are left out: the question is about the noise.
    """
    engine, study = engine or Engine(), study.ideal()

    def report(stage: int, number: int, total: int) -> None:
        if progress is not None:
            progress(stage * total + number, 2 * total)

    return GaussianAnswer(study, snr(study, engine, partial(report, 0)), detect(study, engine, partial(report, 1)))
