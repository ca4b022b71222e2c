"""Measurement of a study's flares: forecast errors, simulated fits, and the bias of models that are too simple."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.answers.answer import Answer, InCell
from mauvecl.answers.measurements.truth import Truth
from mauvecl.results.measurements.fit import LEVELS, Forecast, Measurement, fit, forecast
from mauvecl.results.measurements.model import FlareModel
from mauvecl.results.measurements.reduction import Reduction, variance_of
from mauvecl.runs.checkpoint import kept
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.calls import public
from mauvecl.schema.errors import InputError
from mauvecl.schema.tables import make_table
from mauvecl.statistics.intervals import clopper_pearson
from mauvecl.study.labels import label, stack_tables
from mauvecl.study.measurements import fitted_models
from mauvecl.study.messages import collect_messages
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.device.engine import Engine
    from mauvecl.host.expectation import Expectation
    from mauvecl.results.sums import Arrays
    from mauvecl.statistics.nuisances import Nuisances
    from mauvecl.study.assumptions import Use
    from mauvecl.study.sections import Star

Float = NDArray[np.float64]

#: Exposures drawn and fitted at once, which bounds the memory.
BATCH = 4096
#: A good fit is rejected where one of its p-value is less probable.
REJECTED = 0.01


@dataclass(frozen=True, eq=False)
class MeasuredFlare(InCell):
    """One model, fitted to simulated exposures of one flare.

    Attributes
    ----------
    amplitude : float
        Of the study's flare.
    model : str
    snr : tuple of float
        Of the true flare in one exposure: everything known, and unknowns marginalised over.
    truth : ndarray, shape (n_derived,)
        NaN where the flare has no such quantity.
    known, ahead : Forecast
        With everything known, and with what the study says is unknown; of the flare that the model takes for this one.
    perfect : Measurement
        The fit to the mean exposure: estimates without noise.
    found : Measurement
        Fits to simulated exposures.
    selected : ndarray of bool, shape (n,)
        Exposures that a matched filter for the true flare detects at the study's false-alarm probability.
    fitted : FlareModel
    frame : ndarray, shape (n_pixel,)
        The first exposure, DN, less the quiescent mean.
    quiet : Expectation
    unknown : Nuisances, optional
        What the fits marginalise over.
    """

    amplitude: float
    model: str
    snr: tuple[float, float]
    truth: Float
    known: Forecast
    ahead: Forecast
    perfect: Measurement
    found: Measurement
    selected: NDArray[np.bool_]
    fitted: FlareModel
    frame: Float
    quiet: Expectation
    unknown: Nuisances | None

    @property
    def name(self) -> str:
        """The star, the flare and the model, for pictures."""
        return f"{self.title}, flare {100 * self.amplitude:g} %, {self.model}"

    def fitted_dn(self) -> tuple[Float, Float]:
        """Return the mean of the fitted flare in the first exposure, and the best values of what is unknown, DN."""
        mean = self.fitted.counts(float(np.exp(self.found.log_k[0])), self.found.amplitudes[0])
        if self.unknown is None:
            return mean, np.zeros_like(mean)
        variance, used = variance_of(self.quiet, mean)
        spectra = self.unknown.spectra * used
        weighted = np.divide(spectra, variance, out=np.zeros_like(spectra), where=used)
        information = np.diag(self.unknown.sd**-2.0) + weighted @ spectra.T
        return mean, np.linalg.solve(information, weighted @ (self.frame - mean)) @ self.unknown.spectra

    def rows(self) -> QTable:
        """One row per quantity."""
        found, truth, chosen = self.found, self.truth, self.selected
        columns: list[tuple[Any, ...]] = [
            ("quantity", list(found.names), "what is measured"),
            ("unit", list(found.units), "of truth, estimates and errors"),
            ("truth", truth, "true value; undefined where the flare has none"),
            ("error_known", self.known.errors, "standard error in advance, everything known"),
            ("error", self.ahead.errors, "standard error in advance, unknowns marginalised over"),
            ("perfect", self.perfect.estimates[0], "estimate from an exposure without noise"),
            ("median", np.median(found.estimates, axis=0), "median of the estimates"),
            ("bias", np.median(found.estimates, axis=0) - truth, "median of the estimates less the truth"),
            ("scatter", _scatter(found.estimates), "half of the central 68.27 % of the estimates"),
        ]
        for name, which in (("", np.ones(chosen.size, np.bool_)), ("_selected", chosen)):
            whose = "of detected flares" if name else "of all"
            for k, level in enumerate(found.levels):
                cover = _coverage(found, truth, k, which)
                percent = f"{100 * level:.0f}"
                text = f"share of {percent} % intervals that hold the truth, {whose}"
                columns.append((f"coverage_{percent}{name}", cover[0], text))
                columns.append((f"coverage_{percent}{name}_low", cover[1], f"{text}: 95 % interval, lower end"))
                columns.append((f"coverage_{percent}{name}_high", cover[2], f"{text}: 95 % interval, upper end"))
            if name:
                middle = np.median(found.estimates[which], axis=0) if which.any() else np.full(truth.size, np.nan)
                columns.append(
                    ("bias_selected", middle - truth, "median of the estimates of detected flares less the truth")
                )
        columns.append(("one_sided", found.one_sided[-1].mean(axis=0), "share of 95 % intervals with one end"))
        return make_table(columns)

    def quality(self) -> QTable:
        """One row: goodness of fit and detection."""
        found = self.found
        rejected = clopper_pearson(int((found.p_value < REJECTED).sum()), found.p_value.size)
        detected = clopper_pearson(int(self.selected.sum()), self.selected.size)
        return make_table(
            [
                ("snr", [self.snr[0]], "S/N of the flare in one exposure, everything known"),
                ("snr_marginal", [self.snr[1]], "the same, unknowns marginalised over"),
                ("dof", [found.dof], "degrees of freedom of chi-squared"),
                ("chi2", [float(np.mean(found.chi2))], "mean chi-squared of the fits"),
                (
                    "chi2_perfect",
                    [float(self.perfect.chi2[0])],
                    "what the model cannot fit of an exposure without noise",
                ),
                ("rejected", [rejected.value], f"share of fits with a p-value below {REJECTED:g}"),
                ("rejected_low", [rejected.low], "95 % interval, lower end"),
                ("rejected_high", [rejected.high], "95 % interval, upper end"),
                ("detected", [detected.value], "share that a matched filter for the true flare detects"),
                ("detected_low", [detected.low], "95 % interval, lower end"),
                ("detected_high", [detected.high], "95 % interval, upper end"),
            ]
        )


@dataclass(eq=False)
class MeasureAnswer(Answer):
    """The answer of `mauvecl measure`.

    Attributes
    ----------
    study : Study
    flares : list of MeasuredFlare
        Every model of every flare of every star in every cell of the sweep.
    messages : list of str
    """

    USES: ClassVar[tuple[Use, ...]] = ("instrument", "sky", "flare", "unknowns", "seed")

    study: Study
    flares: list[MeasuredFlare]
    messages: list[str]

    @cached_property
    def table(self) -> QTable:
        """Errors, bias and coverage; one row per star, cell, flare, model and quantity."""
        return self._together(MeasuredFlare.rows)

    @cached_property
    def fits(self) -> QTable:
        """Goodness of fit and detection; one row per star, cell, flare and model."""
        return self._together(MeasuredFlare.quality)

    @property
    def tables(self) -> dict[str, Table]:
        """Measured quantities, and fits."""
        return {"measure": self.table, "fits": self.fits}

    @property
    def inputs(self) -> list[Expectation]:
        return list({id(one.quiet): one.quiet for one in self.flares}.values())

    def as_json(self) -> dict[str, Any]:
        from mauvecl.answers.report import rows

        return {"messages": self.messages, "rows": rows(self.table), "fits": rows(self.fits)}

    def _together(self, table_of: Callable[[MeasuredFlare], QTable]) -> QTable:
        parts = []
        for one in self.flares:
            swept = {name: value for name, value in one.at.items() if name != "amplitude"}
            first: dict[str, Any] = {"star": one.label, **swept, "amplitude": one.amplitude, "model": one.model}
            parts.append((first, table_of(one)))
        return stack_tables(parts, study=self.study.text())


@public
def measure(
    study: Study, engine: Engine | Pool | None = None, progress: Callable[[int, int], None] | None = None
) -> MeasureAnswer:
    """Forecast and simulate what is measured of a study's flares in one exposure.

    Parameters
    ----------
    study : Study
    engine : Engine or Pool, optional
        Draws the exposures; the default device. The checkpoint of a pool keeps the fits that are finished.
    progress : callable, optional
        Receives the flares that are done, and all of them.

    Raises
    ------
    InputError
        For anything in the study that cannot be.
    """
    if study.flare.geometry != "added":
        raise InputError("flare.geometry = 'replaces' in a measurement, expected 'added': fits take light for added")
    if any(not amplitude > 0.0 for _, cell in study.cells() for amplitude in cell.flare.amplitudes):
        raise InputError("flare amplitude = 0 in a measurement, expected one above 0")
    prepared = [(at, cell, star, cell.expectations(star)) for at, cell in study.cells() for star in cell.star]
    if engine is None:
        from mauvecl.device.engine import Engine as Default

        engine = Default()
    asked = [
        (cell, star, quiet, flare, amplitude, InCell(label(star, quiet), at), engine)
        for at, cell, star, (quiet, *lit) in prepared
        for amplitude, flare in zip(cell.flare.amplitudes, lit, strict=True)
    ]
    flares: list[MeasuredFlare] = []
    for done, some in enumerate(map_in_order(engine, lambda one: _measured(*one), asked), 1):
        flares += some
        if progress is not None:
            progress(done, len(asked))
    messages = collect_messages([x for *_, group in prepared for x in group])
    return MeasureAnswer(study, flares, [*messages, *_wrong(flares)])


def _measured(
    study: Study,
    star: Star,
    quiet: Expectation,
    flare: Expectation,
    amplitude: float,
    where: InCell,
    engine: Engine | Pool,
) -> list[MeasuredFlare]:
    source, asked = star.source(), study.measure
    light = study.flare.light()
    truth = Truth(star, source, study.flaring(source, amplitude), light, study.flare.band, quiet.exposure_s)
    unknown = study.nuisances.marginalised(quiet)
    models = {
        name: FlareModel.of(
            source,
            study.observation.load_instrument(),
            quiet,
            jump=jump,
            lines=lines,
            band=study.flare.band,
            electron_temperature_k=study.flare.spectrum.electron_temperature_k,
            distance_pc=star.distance_pc,
            radius_rsun=star.radius_rsun,
            bands_nm=asked.bands_nm,
            order=study.observation.order,
        )
        for name, jump, lines in fitted_models(study)
    }
    found: dict[str, list[Measurement]] = {name: [] for name in models}
    detected: list[NDArray[np.bool_]] = []
    first: Float = np.zeros(quiet.wavelength_nm.size)
    weights = _matched(quiet, flare, unknown)[0]
    lit = flare.recorded_dn - quiet.recorded_dn
    snr = _matched(quiet, flare, None, lit)[1], _matched(quiet, flare, unknown, lit)[1]

    def fitted(start: int, count: int) -> Arrays:
        raw = engine.realise(flare, start=start, count=count, seed=study.run.seed, **study.drawing)
        excess = raw - quiet.recorded_dn
        arrays: Arrays = {"first": excess[0], "detected": excess @ weights >= scipy.stats.norm.isf(study.run.fap)}
        for k, model in enumerate(models.values()):
            arrays |= {f"{k} {key}": value for key, value in fit(raw, quiet, model, unknown).arrays().items()}
        return arrays

    checkpoint = engine.checkpoint if isinstance(engine, Pool) else None
    for start in range(0, asked.fits, BATCH):
        count = min(BATCH, asked.fits - start)
        depends_on = ("measure", quiet, flare, unknown, list(models.values()), study.text(), start, count)
        arrays = kept(checkpoint, depends_on, partial(fitted, start, count))
        first = arrays["first"] if start == 0 else first
        detected.append(arrays["detected"])
        for k, (name, model) in enumerate(models.items()):
            own = {key.removeprefix(f"{k} "): value for key, value in arrays.items() if key.startswith(f"{k} ")}
            found[name].append(Measurement.of_arrays(model, LEVELS, own))
    measured = []
    for name, model in models.items():
        perfect = fit(flare.recorded_dn, quiet, model, unknown, levels=LEVELS)
        kelvin, linear = float(np.exp(perfect.log_k[0])), perfect.amplitudes[0]
        ahead = [forecast(quiet, model, kelvin, linear, u) for u in (None, unknown)]
        true = np.array([truth.value(quantity) for quantity in model.names])
        measured.append(
            MeasuredFlare(
                where.label, where.at, amplitude, name, snr, true, ahead[0], ahead[1], perfect,
                Measurement.joined(found[name]), np.concatenate(detected), model, first, quiet, unknown,
            )
        )  # fmt: skip
    return measured


def _matched(
    quiet: Expectation, flare: Expectation, unknown: Nuisances | None, added_dn: Float | None = None
) -> tuple[Float, float]:
    """Return the weights of a matched filter of variance one, and its mean with the flare.

    The variance is that of the quiescent star, or of one with some light added.
    """
    variance, used = variance_of(quiet, added_dn)
    delta = (flare.recorded_dn - quiet.recorded_dn) * used
    weights = np.divide(delta, variance, out=np.zeros_like(delta), where=used)
    if unknown:
        rows = unknown.rows(variance, unknown.spectra * used)
        weights = weights - (rows @ delta) @ rows
    power = float(weights @ delta)
    return (weights / np.sqrt(power), float(np.sqrt(power))) if power > 0 else (weights, 0.0)


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
    low, high = np.quantile(estimates, [0.15865, 0.84135], axis=0)
    return np.asarray((high - low) / 2)


def _wrong(flares: Sequence[MeasuredFlare]) -> list[str]:
    """Say which models do not fit, and what they make of the temperature."""
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


def contour(one: MeasuredFlare, n: int = 81) -> tuple[Float, Float, Float]:
    """Return temperatures, amplitudes and the expected rise of chi-squared above its minimum, (n_amplitude, n_t)."""
    best, linear = one.perfect.log_k[0], one.perfect.amplitudes[0]
    reduction = Reduction.of(one.fitted, one.quiet, one.fitted.counts(float(np.exp(best)), linear), one.unknown)
    mean = linear[0] * reduction.spline(best) + linear[1:] @ reduction.fixed
    low, high = one.perfect.low[-1, 0], one.perfect.high[-1, 0]
    spread = np.exp(reduction.log_k[[0, -1]])
    ends = np.clip([max(low[0] * 0.9, spread[0]), min(high[0] * 1.1, 5 * np.exp(best))], *spread)
    kelvin = np.geomspace(float(ends[0]), float(ends[1]), n)
    amplitude = np.geomspace(max(low[1] * 0.8, linear[0] / 30), high[1] * 1.2, n)
    basis, _ = reduction.basis
    hot = reduction.spline(np.log(kelvin))
    rest = mean - amplitude[:, None, None] * hot
    rest = rest - (rest @ basis.T) @ basis
    return kelvin, amplitude, np.einsum("atk,atk->at", rest, rest)
