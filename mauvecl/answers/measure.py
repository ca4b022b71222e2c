"""Measurement of a study's flares: forecast errors, simulated fits, and the bias of models that are too simple."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, product
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from astropy.table import QTable
from numpy.typing import NDArray

from mauvecl.answers import measurements
from mauvecl.answers.answer import IF_KNOWN, Answer, TableOf, reported
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.detection.distributions import Interval, clopper_pearson, clopper_pearson_ends
from mauvecl.detection.nuisances import fitted_amplitudes, join_names
from mauvecl.device.engine import Engine
from mauvecl.fits.flare_model import usable_variance
from mauvecl.fits.spectrum import LEVELS, Measurement
from mauvecl.noise.scene import drawn_factors
from mauvecl.runs.checkpoint import kept
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.columns import Column, View, interval_columns, number, percent, table_of
from mauvecl.schema.errors import InputError, Message
from mauvecl.study.cases import Case, amplitude_column, cases, collect_messages
from mauvecl.study.questions import check_sweep
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from mauvecl.detection.snr import Arrays
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.cases import Use

Float = NDArray[np.float64]

#: Number of exposures drawn and fitted at once, which limits the memory and the time until a fit can be cancelled.
BATCH = 256
#: S/N below which the coverage of intervals differs from the nominal one (bench/coverage.py).
WILKS_SNR = 10.0
#: p-value below which a fit is rejected.
REJECTED = 0.01


@dataclass(frozen=True, eq=False)
class MeasuredFlare(measurements.ExpectedMeasurement):
    """Model fitted to simulated exposures of a flare."""

    found: Measurement  # fits to simulated exposures
    selected: NDArray[np.bool_]  # exposures that a matched filter detects at the study's false-alarm probability
    frame: Float  # the first exposure, DN, less the quiescent mean; shape (n_pixel,)

    def fitted_dn(self) -> tuple[Float, Float]:
        """Return the mean of the fitted flare in the first exposure, and the best values of unknowns, DN."""
        mean = self.fitted.counts(np.exp(self.found.log_k[0]), self.found.factor[0] * self.found.amplitudes[0])
        if self.unknown is None:
            return mean, np.zeros_like(mean)
        unknown, expected = self.unknown.around(mean), self.unknown.mean_dn
        variance, used = usable_variance(self.quiet, mean, self.skipped_nm, unknown)
        variance, left = np.where(used, variance, np.inf), self.frame - mean - expected
        return mean, expected + fitted_amplitudes(unknown.spectra, unknown.sd, left, variance) @ unknown.spectra

    def rows(self) -> QTable:
        """Return one row per quantity."""
        return table_of(COLUMNS, [self])

    @cached_property
    def coverages(self) -> dict[str, Float]:
        """Shares of intervals that hold the truth, with 95 % intervals, by their columns; shape (3, n_derived) each."""
        found, covers = self.found, dict[str, Float]()
        exposures = {"": np.ones(self.selected.size, np.bool_), "_selected": self.selected}
        for (suffix, which), (k, level) in product(exposures.items(), enumerate(found.levels)):
            inside = ((found.low[k] <= self.truth) & (self.truth <= found.high[k]))[which]
            cover = covers[f"coverage_{100 * level:.0f}{suffix}"] = np.full((3, self.truth.size), np.nan)
            known = np.isfinite(self.truth) & bool(len(inside))
            cover[:, known] = clopper_pearson_ends(inside[:, known].sum(axis=0), max(len(inside), 1))
        return covers

    @property
    def bias_selected(self) -> Float:
        """Median of the estimates of detected flares less the truth, shape (n_derived,); NaN if none is detected."""
        estimates = self.found.estimates[self.selected]
        return (np.median(estimates, axis=0) if len(estimates) else np.nan) - self.truth

    @property
    def scatter(self) -> Float:
        """Half of the width of the central 68.27 % of the estimates, shape (n_derived,); NaN for a single estimate."""
        low, high = np.quantile(self.found.estimates, [0.15865, 0.84135], axis=0)
        return np.asarray((high - low) / 2 if len(self.found.estimates) > 1 else np.full_like(low, np.nan))

    @cached_property
    def rejected(self) -> Interval:
        """Share of fits that are rejected, with its 95 % interval."""
        return clopper_pearson(int((self.found.p_value < REJECTED).sum()), self.found.p_value.size)

    @cached_property
    def detected(self) -> Interval:
        """Share of exposures in which the flare is detected, with its 95 % interval."""
        return clopper_pearson(int(self.selected.sum()), self.selected.size)


def _coverage_columns(level: float, suffix: str, whose: str, heading: str = "") -> list[Column]:
    """Return the columns of the coverage of intervals of a level."""
    name = f"coverage_{100 * level:.0f}{suffix}"
    text = f"share of {100 * level:.0f} % intervals that hold the truth, {whose}"
    return [
        Column(name, lambda row: row.coverages[name][0], "", text, heading, percent(".1f"), detail=bool(suffix)),
        *interval_columns(f"{name}_{{}}", lambda row: row.coverages[name][1:], "", f"the 95 % interval of the {text}"),
    ]


#: Columns of the measured quantities of a `MeasuredFlare`.
COLUMNS = (
    Column("quantity", "found.names", "", "what is measured", "quantity",
           lambda name, unit: f"{name} ({unit})" if unit else name, ("unit",)),
    Column("unit", "found.units", "", "of truth, estimates and errors"),
    Column("truth", "", "", "true value; undefined where the flare has none", "truth", number(".4g")),
    Column("error_known", "known.errors", "", "standard error in advance, everything known", "ideal", number(".3g")),
    Column("error", "ahead.errors", "", "standard error in advance, unknowns marginalised over", "error",
           number(".3g")),
    Column("perfect", lambda row: row.perfect.estimates[0], "", "estimate from an exposure without noise",
           "fit without noise", number(".4g"), detail=True),
    *interval_columns("{}_68", lambda row: (row.perfect.low[0, 0], row.perfect.high[0, 0]), "",
                      "the 68 % interval of that fit; infinite if there is none"),
    Column("low_95", lambda row: row.perfect.low[1, 0], "", "lower end of the 95 % interval of that fit", "95 % from",
           number(".4g"), detail=True),
    Column("high_95", lambda row: row.perfect.high[1, 0], "", "its upper end", "to", number(".4g"), detail=True),
    Column("median", lambda row: np.median(row.found.estimates, axis=0), "", "median of the estimates"),
    Column("bias", lambda row: np.median(row.found.estimates, axis=0) - row.truth, "",
           "median of the estimates less the truth", "bias", number(".4g"), detail=True),
    Column("scatter", "", "", "half of the central 68.27 % of the estimates",
           "scatter", number(".4g"), detail=True),
    *_coverage_columns(LEVELS[0], "", "of all"),
    *_coverage_columns(LEVELS[1], "", "of all", "in 95 %"),
    *_coverage_columns(LEVELS[0], "_selected", "of detected flares"),
    *_coverage_columns(LEVELS[1], "_selected", "of detected flares", "if detected"),
    Column("bias_selected", "", "", "median of the estimates of detected flares less the truth", detail=True),
    Column("one_sided", lambda row: row.found.one_sided[-1].mean(axis=0), "", "share of 95 % intervals with one end",
           "one-sided", percent(".0f"), detail=True),
)  # fmt: skip
#: Column of errors that all exposures share, after the standard errors of one exposure.
THROUGHPUT_COLUMN = Column("error_throughput", "of_throughput", "",
                           "standard error by the calibration of the throughput, which all exposures share",
                           "by throughput", number(".4g"))  # fmt: skip


FIT_COLUMNS = (
    Column("snr", lambda row: row.snr[0], "", "S/N of the flare in one exposure, everything known", "ideal S/N", ".2f"),
    Column("snr_marginal", lambda row: row.snr[1], "", "the same, unknowns marginalised over", "S/N", ".2f"),
    Column("dof", "found.dof", "", "degrees of freedom of chi-squared"),
    Column("chi2", lambda row: float(np.mean(row.found.chi2)), "", "mean chi-squared of the fits", "chi-squared / dof",
           lambda chi2, dof: f"{chi2:.1f} / {dof}", ("dof",), detail=True),
    Column("chi2_perfect", lambda row: float(row.perfect.chi2[0]), "",
           "what the model cannot fit of an exposure without noise"),
    Column("rejected", "rejected.value", "", f"share of fits with a p-value below {REJECTED:g}", "p < 0.01",
           percent(".1f")),
    *interval_columns("rejected_{}", "rejected.{}"),
    Column("detected", "detected.value", "", "share that a matched filter for the true flare detects", "detected",
           percent(".1f")),
    *interval_columns("detected_{}", "detected.{}"),
)  # fmt: skip
MODEL_COLUMN = Column("model", description="model that is fitted", heading="model", detail=True)


def _quantity_columns(answer: MeasureAnswer) -> tuple[Column, ...]:
    place = [column.name for column in COLUMNS].index("error") + 1
    calibrated = any(flare.of_throughput is not None for flare in answer.flares)
    by_throughput = (THROUGHPUT_COLUMN,) if calibrated else ()
    return (amplitude_column(), MODEL_COLUMN, *COLUMNS[:place], *by_throughput, *COLUMNS[place:])


#: Columns of joint fits of shape and spectrum.
JOINT_COLUMNS = (
    Column("quantity", "joint.found.names", "", "what is measured", "quantity"),
    Column("unit", "joint.found.units", "", "of truth, estimate and intervals", "unit"),
    Column("truth", "joint.truth", "", "true value; undefined where the flare has none", "truth", number(".4g")),
    Column("estimate", lambda row: row.joint.found.estimates[0], "", "of maximum likelihood", "estimate", ".4g"),
    Column("error", lambda row: row.joint.found.errors[0], "", "its standard error", "error", ".2g"),
    *interval_columns("{}_68", lambda row: (row.joint.found.low[0, 0], row.joint.found.high[0, 0]), "",
                      "its 68 % interval; infinite if there is none"),
    Column("low_95", lambda row: row.joint.found.low[1, 0], "", "lower end of its 95 % interval", "95 % from", ".4g"),
    Column("high_95", lambda row: row.joint.found.high[1, 0], "", "higher end", "to", ".4g"),
    Column("p_value", "joint.found.p_value", "",
           "probability of a chi-squared of the fit at least as large where the model is right"),
)  # fmt: skip


def _bin_columns(stare: measurements.MeasuredStare) -> list[Column]:
    """Return the columns of measurements along a stare."""
    assert stare.drawn is not None
    columns = [column.of(attrgetter("drawn")) for column in stare.drawn.columns]
    exact = Column("temperature_without_noise", lambda row: row.perfect.found.estimates[:, 0], "K",
                   "temperature fitted to the means of these frames", "without noise", ".0f")  # fmt: skip
    place = [column.name for column in columns].index("temperature") + 1
    return [*columns[:place], exact, *columns[place:]]


@dataclass(eq=False)
class MeasureAnswer(Answer):
    """Answer of `measure`."""

    USES = ("instrument", "sky", "flare", "processes", "nuisances", "seed")

    study: Study
    flares: list[MeasuredFlare]  # all models of each flare of each star and cell of the sweep
    messages: list[str]
    # One stare per star and cell, if the study requests bins of a stare or a joint fit.
    stares: list[measurements.MeasuredStare] = field(default_factory=list)

    #: Errors, bias and coverage; one row per star, cell, flare, model and quantity.
    table = TableOf("measure", _quantity_columns, "flares", place=True, key="rows")
    #: Goodness of fit and detection; one row per star, cell, flare and model.
    fits = TableOf("fits", (amplitude_column(), MODEL_COLUMN, *FIT_COLUMNS), "flares", place=True, key="fits")
    #: Measurements against time; one row per star, cell and bin of its stare.
    temperatures = TableOf(
        "temperatures", (MODEL_COLUMN,), lambda answer: answer.binned or QTable(), place=True, key="temperatures",
        of=lambda _, stare: table_of(_bin_columns(stare), [stare]),
        when="study.measure.snr_per_bin",
    )  # fmt: skip
    #: Joint fits of shape and spectrum; one row per star, cell and quantity.
    joint = TableOf("joint", JOINT_COLUMNS, "stares", place=True, key="joint",
                    when="study.measure.joint_fit")  # fmt: skip

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses: the stare only if it is measured."""
        return (*self.USES, "stare") if self.stares else self.USES

    @property
    def binned(self) -> list[measurements.MeasuredStare]:
        """Stares in which some bin has the requested S/N."""
        return [stare for stare in self.stares if stare.drawn is not None]

    @property
    def headline(self) -> str:
        """The error of the first measured quantity of the first flare."""
        flare = self.flares[0]
        name, unit = flare.found.names[0], flare.found.units[0]
        error, known = flare.ahead.errors[0], flare.known.errors[0]
        ideal = "" if self.study.nuisances.none else f" ({known:.3g} {unit} {IF_KNOWN})"
        return (
            f"{self.instrument_name} would measure the {name.replace('_', ' ')} of a flare of "
            f"{100 * flare.amplitude:g} % on {flare.title} in {flare.quiet.exposure_s:g} s with a standard error of "
            f"{error:.3g} {unit}{ideal}."
        )

    @property
    def views(self) -> list[View]:
        title = f"Measured in one exposure; {self.study.measure.fits} simulated fits of each flare"
        views = [MeasureAnswer.table.view(self, title, self.table[self.table["unit"] != "erg / s"])]
        if self.binned:
            title = f"Measured along the stare, in bins of S/N {self.study.measure.snr_per_bin:g}"
            views.append(View(title, self.placed(_bin_columns(self.binned[0])), self.temperatures))
        if self.study.measure.joint_fit:
            title = "One stare: shape and spectrum of the flare, fitted to all frames together"
            shown = self.joint[self.joint["unit"] != "erg / cm2"]
            views.append(MeasureAnswer.joint.view(self, title, shown))
        return [*views, MeasureAnswer.fits.view(self, "Goodness of fit")]

    @property
    def inputs(self) -> list[Expectation]:
        return list({id(flare.quiet): flare.quiet for flare in self.flares}.values())


@by_keywords("flares")
def measure(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> MeasureAnswer:
    """Forecast and simulate the measurement of a study's flares in one exposure."""
    if study.flare.geometry != "added":
        raise InputError.of("flare.geometry", "replaces", "'added', since fits take light for added")
    if study.measure.along_stare:
        check_sweep(study.sweep, study.stare, study.events)
    prepared = cases(study)
    if any(not amplitude > 0.0 for case in prepared for amplitude in case.amplitudes):
        raise InputError.of("flare.amplitudes", 0, "above 0 in a measurement")
    expectations = [x for case in prepared for x in case.expectations]
    engine = engine or Engine()
    asked = [(case, *flare, engine) for case in prepared for flare in zip(case.amplitudes, case.flares, strict=True)]
    measured = reported(map_in_order(engine, lambda row: _measured(*row), asked), len(asked), progress)
    flares = list(chain.from_iterable(measured))
    stares = [measurements.measured_stare(case, engine) for case in prepared] if study.measure.along_stare else []
    messages = collect_messages(expectations)
    messages += [stare.unmeasured for stare in stares if stare.unmeasured]
    messages += dict.fromkeys(line for case in prepared for line in _not_marginalised(case))
    return MeasureAnswer(study, flares, [*messages, *_doubtful(flares)], stares)


def _measured(case: Case, amplitude: float, flare: Expectation, engine: Engine | Pool) -> list[MeasuredFlare]:
    """Fit all models to simulated exposures of a flare."""
    study, quiet = case.study, case.quiet
    expected = measurements.expected_measurements(case, amplitude, flare)
    models, unknown = [forecast.fitted for forecast in expected], expected[0].unknown
    skipped = study.measure.skipped_nm
    weights = measurements.matched_filter(quiet, flare, case.unknowns(), None, skipped)[0]

    def fitted(start: int, count: int) -> Arrays:
        raw = engine.realise(flare, start=start, count=count, seed=study.run.seed, **case.draw_options)
        excess = raw - quiet.recorded_dn
        arrays: Arrays = {"first": excess[0], "detected": excess @ weights >= scipy.stats.norm.isf(study.run.fap)}
        for k, model in enumerate(models):
            measurement = measurements.fit_model(raw, quiet, model, unknown, skipped)
            arrays |= {f"{k} {key}": value for key, value in measurement.arrays().items()}
        return arrays

    checkpoint = engine.checkpoint if isinstance(engine, Pool) else None
    parts: list[Arrays] = []
    for start in range(0, study.measure.fits, BATCH):
        count = min(BATCH, study.measure.fits - start)
        # The number changes with the arrays that a fit keeps.
        depends_on = ("measure", 2, quiet, flare, unknown, models, study.text(), start, count)
        parts.append(kept(checkpoint, depends_on, partial(fitted, start, count)))
    selected = np.concatenate([arrays["detected"] for arrays in parts])
    measured = []
    for k, forecast in enumerate(expected):
        own: list[dict[str, Any]] = [
            {key.removeprefix(f"{k} "): x for key, x in part.items() if key.startswith(f"{k} ")} for part in parts
        ]
        batches = [replace(forecast.perfect, **arrays | {"dof": int(arrays["dof"])}) for arrays in own]
        found = Measurement.joined(batches)
        measured.append(MeasuredFlare(**vars(forecast), found=found, selected=selected, frame=parts[0]["first"]))
    return measured


def _not_marginalised(case: Case) -> list[str]:
    """Return a message on drawn factors over which fits do not marginalise."""
    drawn, unknown = drawn_factors(case.processes, case.quiet), case.unknowns_of_fits()
    names = [name for name in drawn if unknown is None or name not in unknown.names]
    if not names:
        return []
    text = (
        f"NOT MARGINALISED: {join_names(names)}. Exposures are drawn with other levels than fits expect, so that "
        f"intervals miss the truth; `nuisances.{names[0]}` marginalises over one."
    )
    return [Message(text, "not marginalised")]


def _doubtful(flares: Sequence[MeasuredFlare]) -> list[str]:
    """Return messages on faint flares, whose intervals are approximate, and on models that do not fit."""
    faint, wrong = dict[str, None](), []
    for flare in flares:
        name, truth = f"{flare.title}, flare of {100 * flare.amplitude:g} %", flare.truth[0]
        if flare.snr[1] < WILKS_SNR:
            text = (
                f"{name}: of an S/N of {flare.snr[1]:.2g} with unknowns marginalised over; below {WILKS_SNR:g} "
                "intervals of 95 % cover 93 to 99 %: the table counts how often they do."
            )
            faint[text] = None
        if flare.perfect.chi2[0] >= 1.0:
            kelvin, error = flare.perfect.estimates[0, 0], flare.ahead.errors[0]
            against = f" where the flare has {truth:.0f} K" if np.isfinite(truth) else ""
            wrong.append(
                f"{name}: the model {flare.model!r} gives {kelvin:.0f} +- {error:.0f} K{against}; its goodness of fit "
                f"rejects it in {100 * flare.rejected.value:.0f} % of exposures."
            )
    return [*faint, *wrong]
