"""Measurement of a study's flares: forecast errors, simulated fits, and the bias of models that are too simple."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import scipy
from astropy.table import QTable
from numpy.typing import NDArray

from mauvecl.answers.answer import Answer
from mauvecl.answers.measurements.along import JOINT_COLUMNS, MeasuredStare, measured_stare
from mauvecl.answers.measurements.expected import ExpectedMeasurement, expected_measurements, fit_model, matched_filter
from mauvecl.answers.progress import reported
from mauvecl.detection.distributions import Interval, clopper_pearson
from mauvecl.detection.nuisances import join_names
from mauvecl.device.engine import Engine
from mauvecl.fits.flare_model import usable_variance
from mauvecl.fits.spectrum import LEVELS, Measurement
from mauvecl.fits.time_course import MeasuredBins
from mauvecl.noise.scene import FactorDistributions
from mauvecl.runs.checkpoint import kept
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.tables import Column, View, number, percent, records, stacked, table_of
from mauvecl.study.cases import Case, cases
from mauvecl.study.labels import amplitude_column, place_columns
from mauvecl.study.messages import collect_messages
from mauvecl.study.questions import check_sweep
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.detection.snr import Arrays
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.assumptions import Use

Float = NDArray[np.float64]

#: Number of exposures drawn and fitted at once, which limits the memory and the time until a fit can be cancelled.
BATCH = 256
#: S/N below which the coverage of intervals differs from the nominal one (bench/coverage.py).
WILKS_SNR = 10.0
#: p-value below which a fit is rejected.
REJECTED = 0.01


@dataclass(frozen=True, eq=False)
class MeasuredFlare(ExpectedMeasurement):
    """Model fitted to simulated exposures of a flare."""

    found: Measurement  # fits to simulated exposures
    selected: NDArray[np.bool_]  # exposures that a matched filter detects at the study's false-alarm probability
    frame: Float  # the first exposure, DN, less the quiescent mean; shape (n_pixel,)

    def fitted_dn(self) -> tuple[Float, Float]:
        """Return the mean of the fitted flare in the first exposure, and the best values of unknowns, DN."""
        found = self.found
        mean = self.fitted.counts(np.exp(found.log_k[0]), found.factor[0] * found.amplitudes[0])
        if self.unknown is None:
            return mean, np.zeros_like(mean)
        unknown, expected = self.unknown.around(mean), self.unknown.mean_dn
        variance, used = usable_variance(self.quiet, mean, self.skipped_nm, unknown)
        spectra = unknown.spectra * used
        weighted = np.divide(spectra, variance, out=np.zeros_like(spectra), where=used)
        information = np.diag(unknown.sd**-2.0) + weighted @ spectra.T
        left = self.frame - mean - expected
        return mean, expected + np.linalg.solve(information, weighted @ left) @ unknown.spectra

    def rows(self) -> QTable:
        """Return one row per quantity."""
        found, truth, chosen = self.found, self.truth, self.selected
        values = {
            "quantity": list(found.names),
            "unit": list(found.units),
            "truth": truth,
            "error_known": self.known.errors,
            "error": self.ahead.errors,
            "perfect": self.perfect.estimates[0],
            **{
                f"{side}_{100 * level:.0f}": getattr(self.perfect, side)[k, 0]
                for k, level in enumerate(found.levels)
                for side in ("low", "high")
            },
            "median": np.median(found.estimates, axis=0),
            "bias": np.median(found.estimates, axis=0) - truth,
            "scatter": _scatter(found.estimates),
            "one_sided": found.one_sided[-1].mean(axis=0),
        }
        middle = np.median(found.estimates[chosen], axis=0) if chosen.any() else np.full(truth.size, np.nan)
        values["bias_selected"] = middle - truth
        for which, suffix in ((np.ones(chosen.size, np.bool_), ""), (chosen, "_selected")):
            for k, level in enumerate(found.levels):
                name = f"coverage_{100 * level:.0f}{suffix}"
                values |= dict(
                    zip((name, f"{name}_low", f"{name}_high"), _coverage(found, truth, k, which), strict=True)
                )
        if self.of_throughput is not None:
            values["error_throughput"] = self.of_throughput
        return table_of(columns_of([self]), [values])

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
    name, text = f"coverage_{100 * level:.0f}{suffix}", f"share of {100 * level:.0f} % intervals that hold the truth, "
    return [
        Column(name, "", "", f"{text}{whose}", heading, percent(".1f")),
        Column(f"{name}_low", "", "", f"{text}{whose}: 95 % interval, lower end"),
        Column(f"{name}_high", "", "", f"{text}{whose}: 95 % interval, upper end"),
    ]


#: Columns of the table of measured quantities.
COLUMNS = (
    Column("quantity", "", "", "what is measured", "quantity"),
    Column("unit", "", "", "of truth, estimates and errors", "unit"),
    Column("truth", "", "", "true value; undefined where the flare has none", "truth", number(".4g")),
    Column("error_known", "", "", "standard error in advance, everything known", "error, all known", number(".4g")),
    Column("error", "", "", "standard error in advance, unknowns marginalised over", "error", number(".4g")),
    Column("perfect", "", "", "estimate from an exposure without noise", "fit without noise", number(".4g")),
    Column("low_68", "", "", "lower end of the 68 % interval of that fit; infinite if there is none"),
    Column("high_68", "", "", "its upper end"),
    Column("low_95", "", "", "lower end of the 95 % interval of that fit", "95 % from", number(".4g")),
    Column("high_95", "", "", "its upper end", "to", number(".4g")),
    Column("median", "", "", "median of the estimates"),
    Column("bias", "", "", "median of the estimates less the truth", "bias", number(".4g")),
    Column("scatter", "", "", "half of the central 68.27 % of the estimates", "scatter", number(".4g")),
    *_coverage_columns(LEVELS[0], "", "of all"),
    *_coverage_columns(LEVELS[1], "", "of all", "95 % covers"),
    *_coverage_columns(LEVELS[0], "_selected", "of detected flares"),
    *_coverage_columns(LEVELS[1], "_selected", "of detected flares", "if detected"),
    Column("bias_selected", "", "", "median of the estimates of detected flares less the truth"),
    Column("one_sided", "", "", "share of 95 % intervals with one end", "one-sided", percent(".0f")),
)
#: Column of errors that all exposures share, after the standard errors of one exposure.
THROUGHPUT_COLUMN = Column("error_throughput", "", "", "standard error by the calibration of the throughput, which all "
                           "exposures share", "by throughput", number(".4g"))  # fmt: skip


def columns_of(flares: Sequence[MeasuredFlare]) -> tuple[Column, ...]:
    """Return the columns of measured quantities, with that of the throughput if it is calibrated."""
    place = [column.name for column in COLUMNS].index("error") + 1
    calibrated = any(one.of_throughput is not None for one in flares)
    return (*COLUMNS[:place], *((THROUGHPUT_COLUMN,) if calibrated else ()), *COLUMNS[place:])


#: Columns of the table of fits.
FIT_COLUMNS = (
    Column("snr", lambda one: one.snr[0], "", "S/N of the flare in one exposure, everything known", "S/N, all known",
           ".2f"),
    Column("snr_marginal", lambda one: one.snr[1], "", "the same, unknowns marginalised over", "S/N", ".2f"),
    Column("dof", "found.dof", "", "degrees of freedom of chi-squared"),
    Column("chi2", lambda one: float(np.mean(one.found.chi2)), "", "mean chi-squared of the fits", "chi-squared / dof",
           lambda chi2, dof: f"{chi2:.1f} / {dof}", ("dof",)),
    Column("chi2_perfect", lambda one: float(one.perfect.chi2[0]), "",
           "what the model cannot fit of an exposure without noise"),
    Column("rejected", "rejected.value", "", f"share of fits with a p-value below {REJECTED:g}", "p < 0.01",
           percent(".1f")),
    Column("rejected_low", "rejected.low", "", "95 % interval, lower end"),
    Column("rejected_high", "rejected.high", "", "95 % interval, upper end"),
    Column("detected", "detected.value", "", "share that a matched filter for the true flare detects", "detected",
           percent(".1f")),
    Column("detected_low", "detected.low", "", "95 % interval, lower end"),
    Column("detected_high", "detected.high", "", "95 % interval, upper end"),
)  # fmt: skip
MODEL_COLUMN = Column("model", description="model that is fitted", heading="model")


@dataclass(eq=False)
class MeasureAnswer(Answer):
    """Answer of `mauvecl measure`.

    Attributes
    ----------
    study : Study
    flares : list of MeasuredFlare
        All models of each flare of each star and cell of the sweep.
    messages : list of str
    stares : list of MeasuredStare
        One stare per star and cell, if the study requests bins of a stare or a joint fit.
    """

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "flare", "processes", "nuisances", "seed")
    JSON = MappingProxyType({"rows": "table", "fits": "fits"})

    study: Study
    flares: list[MeasuredFlare]
    messages: list[str]
    stares: list[MeasuredStare] = field(default_factory=list)

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses: the stare only if it is measured."""
        return (*self.USES, "stare") if self.stares else self.USES

    @cached_property
    def table(self) -> QTable:
        """Errors, bias and coverage; one row per star, cell, flare, model and quantity."""
        return stacked(self._first, ((one, one.rows()) for one in self.flares), study=self.study.text())

    @cached_property
    def fits(self) -> QTable:
        """Goodness of fit and detection; one row per star, cell, flare and model."""
        return table_of((*self._first, *FIT_COLUMNS), self.flares, study=self.study.text())

    @property
    def _first(self) -> tuple[Column, ...]:
        return (*place_columns(self.study.sweep, "amplitude"), amplitude_column(), MODEL_COLUMN)

    @property
    def tables(self) -> dict[str, Table]:
        """Measured quantities, fits, and measurements along stares."""
        return {"measure": self.table, "fits": self.fits} | self._along

    @cached_property
    def _along(self) -> dict[str, QTable]:
        """Tables of measurements along stares, those that the study requests."""
        asked = self.study.measure
        binned = {"temperatures": self.temperatures} if asked.snr_per_bin is not None else {}
        return binned | ({"joint": self.joint} if asked.joint_fit else {})

    @cached_property
    def joint(self) -> QTable:
        """Joint fits of shape and spectrum; one row per star, cell and quantity."""
        parts = [(one, table_of(JOINT_COLUMNS, [one.joint])) for one in self.stares if one.joint is not None]
        return stacked(place_columns(self.study.sweep), parts, study=self.study.text())

    @cached_property
    def temperatures(self) -> QTable:
        """Measurements against time; one row per star, cell and bin of its stare."""
        first = (*place_columns(self.study.sweep), MODEL_COLUMN)
        parts = [
            (one, table_of(_bin_columns(one.drawn), [one]))
            for one in self.stares
            if isinstance(one.drawn, MeasuredBins)
        ]
        return stacked(first, parts, study=self.study.text()) if parts else QTable()

    @property
    def views(self) -> list[View]:
        measured = self.table[self.table["unit"] != "erg / s"]
        title = f"Measured in one exposure; {self.study.measure.fits} simulated fits of each flare"
        views = [View(title, (*self._first, *columns_of(self.flares)), measured)]
        drawn = [one.drawn for one in self.stares if isinstance(one.drawn, MeasuredBins)]
        if drawn:
            columns = (*place_columns(self.study.sweep), *_bin_columns(drawn[0]))
            title = f"Measured along the stare, in bins of S/N {self.study.measure.snr_per_bin:g}"
            views.append(View(title, columns, self.temperatures))
        if self.study.measure.joint_fit:
            title = "One stare: shape and spectrum of the flare, fitted to all frames together"
            shown = self.joint[self.joint["unit"] != "erg / cm2"]
            views.append(View(title, (*place_columns(self.study.sweep), *JOINT_COLUMNS), shown))
        return [*views, View("Goodness of fit", (*self._first, *FIT_COLUMNS), self.fits)]

    @property
    def inputs(self) -> list[Expectation]:
        return list({id(one.quiet): one.quiet for one in self.flares}.values())

    def as_json(self) -> dict[str, Any]:
        return super().as_json() | {name: records(table) for name, table in self._along.items()}


def _bin_columns(bins: MeasuredBins) -> list[Column]:
    """Return the columns of measurements along a stare, for a `MeasuredStare`."""
    columns = [column.of(attrgetter("drawn")) for column in bins.columns]
    exact = Column("temperature_without_noise", lambda one: one.perfect.found.estimates[:, 0], "K",
                   "temperature fitted to the means of these frames", "without noise", ".0f")  # fmt: skip
    place = [column.name for column in columns].index("temperature") + 1
    return [*columns[:place], exact, *columns[place:]]


@validated
def measure(
    study: Study, engine: Engine | Pool | None = None, progress: Callable[[int, int], None] | None = None
) -> MeasureAnswer:
    """Forecast and simulate the measurement of a study's flares in one exposure.

    Parameters
    ----------
    study : Study
    engine : Engine or Pool, optional
        Simulator of the exposures; by default that of the default device. The checkpoint of a pool keeps finished fits.
    progress : callable, optional
        Called as ``progress(done, total)`` in flares.
    """
    if study.flare.geometry != "added":
        raise InputError.of("flare.geometry", "replaces", "'added': fits take light for added")
    if study.measure.along_stare:
        check_sweep(study.sweep, study.stare, study.events)
    prepared = cases(study)
    if any(not amplitude > 0.0 for case in prepared for amplitude in case.amplitudes):
        raise InputError("flare amplitude = 0 in a measurement", "one above 0", key="flare.amplitudes", value=0)
    expectations = [x for case in prepared for x in case.expectations]
    engine = engine or Engine()
    asked = [(case, *flare, engine) for case in prepared for flare in zip(case.amplitudes, case.flares, strict=True)]
    flares: list[MeasuredFlare] = []
    for some in reported(map_in_order(engine, lambda one: _measured(*one), asked), len(asked), progress):
        flares += some
    stares = [measured_stare(case, engine) for case in prepared if study.measure.along_stare]
    messages = collect_messages(expectations)
    messages += [one.drawn for one in stares if isinstance(one.drawn, str)]
    messages += dict.fromkeys(line for case in prepared for line in _not_marginalised(case))
    return MeasureAnswer(study, flares, [*messages, *_faint(flares), *_wrong(flares)], stares)


def _measured(case: Case, amplitude: float, flare: Expectation, engine: Engine | Pool) -> list[MeasuredFlare]:
    """Fit all models to simulated exposures of a flare."""
    study, quiet = case.study, case.quiet
    expected = expected_measurements(case, amplitude, flare)
    models, unknown = [one.fitted for one in expected], expected[0].unknown
    skipped = study.measure.skipped_nm
    weights = matched_filter(quiet, flare, case.unknowns(), skipped_nm=skipped)[0]

    def fitted(start: int, count: int) -> Arrays:
        raw = engine.realise(flare, start=start, count=count, seed=study.run.seed, **case.draw_options)
        excess = raw - quiet.recorded_dn
        arrays: Arrays = {"first": excess[0], "detected": excess @ weights >= scipy.stats.norm.isf(study.run.fap)}
        for k, model in enumerate(models):
            found = fit_model(raw, quiet, model, unknown, skipped)
            arrays |= {f"{k} {key}": value for key, value in found.arrays().items()}
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
    for k, one in enumerate(expected):
        own = [{key.removeprefix(f"{k} "): x for key, x in part.items() if key.startswith(f"{k} ")} for part in parts]
        model = one.fitted
        of_batch = partial(
            Measurement.of_arrays, levels=LEVELS, names=model.names, units=model.units, bounds=model.bounds
        )
        found = Measurement.joined(list(map(of_batch, own)))
        measured.append(MeasuredFlare(**vars(one), found=found, selected=selected, frame=parts[0]["first"]))
    return measured


def _coverage(found: Measurement, truth: Float, level: int, which: NDArray[np.bool_]) -> Float:
    """Return coverage and its 95 % interval for each quantity, shape (3, n_derived); NaN without a truth."""
    inside = (found.low[level] <= truth) & (truth <= found.high[level])
    cover = np.full((3, truth.size), np.nan)
    n = int(which.sum())
    for q in np.flatnonzero(np.isfinite(truth)) if n else ():
        interval = clopper_pearson(int(inside[which, q].sum()), n)
        cover[:, q] = interval.value, interval.low, interval.high
    return cover


def _scatter(estimates: Float) -> Float:
    """Return half of the central 68.27 % of the estimates, shape (n_derived,); undefined for a single one."""
    if len(estimates) < 2:
        return np.full(estimates.shape[1], np.nan)
    low, high = np.quantile(estimates, [0.15865, 0.84135], axis=0)
    return np.asarray((high - low) / 2)


def _not_marginalised(case: Case) -> list[str]:
    """Return a message on drawn factors over which fits do not marginalise."""
    drawn = FactorDistributions.from_processes(case.processes, case.quiet)
    unknown = case.unknowns_of_fits()
    names = [name for name in (drawn.spreads if drawn else ()) if unknown is None or name not in unknown.names]
    if not names:
        return []
    return [
        f"NOT MARGINALISED: {join_names(names)}. Exposures are drawn with other levels than fits expect, so that "
        f"intervals miss the truth; `nuisances.{names[0]}` marginalises over one."
    ]


def _faint(flares: Sequence[MeasuredFlare]) -> list[str]:
    """Return a message for each flare whose intervals are approximate because it is faint."""
    found = {f"{one.title}, flare of {100 * one.amplitude:g} %": one.snr[1] for one in flares}
    return [
        f"{title}: of an S/N of {snr:.2g} with unknowns marginalised over; below {WILKS_SNR:g} intervals of 95 % cover "
        "93 to 99 %: the table counts how often they do."
        for title, snr in found.items()
        if snr < WILKS_SNR
    ]


def _wrong(flares: Sequence[MeasuredFlare]) -> list[str]:
    """Return messages on models that do not fit, with the temperature that they give."""
    lines = []
    for one in flares:
        lost, truth = float(one.perfect.chi2[0]), one.truth[0]
        if lost < 1.0:
            continue
        kelvin, error = one.perfect.estimates[0, 0], one.ahead.errors[0]
        against = f" where the flare has {truth:.0f} K" if np.isfinite(truth) else ""
        rejected = 100 * float((one.found.p_value < REJECTED).mean())
        lines.append(
            f"{one.title}, flare of {100 * one.amplitude:g} %: the model {one.model!r} gives {kelvin:.0f} +- "
            f"{error:.0f} K{against}; its goodness of fit rejects it in {rejected:.0f} % of exposures."
        )
    return lines
