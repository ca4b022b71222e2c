"""Measurement of a study's flares: forecast errors, simulated fits, and the bias of models that are too simple."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, product
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from astropy.table import QTable
from numpy.typing import NDArray

from mauvecl.answers.answer import IF_KNOWN, Answer, StarInCell, TableOf, reported
from mauvecl.answers.closed_forms import throughput_cases
from mauvecl.answers.verbs import Progress, by_keywords
from mauvecl.detection.distributions import Interval, clopper_pearson, clopper_pearson_ends
from mauvecl.detection.nuisances import Nuisances, fitted_amplitudes, join_names
from mauvecl.device.engine import Engine
from mauvecl.fits.flare_model import FlareModel, Ranges, ReducedSums, usable_variance, variance_of
from mauvecl.fits.profile import BestFit, Profile
from mauvecl.fits.spectrum import LEVELS, Measurement, TwoTemperatures, fit, fit_two_temperatures, forecast_model
from mauvecl.host.arrays import Arrays, Float, true_runs
from mauvecl.host.stars import flare as spectra
from mauvecl.host.stars.spectrum import photons
from mauvecl.noise.scene import drawn_factors
from mauvecl.runs.checkpoint import checkpointed
from mauvecl.runs.pool import Pool, map_in_order
from mauvecl.schema.columns import Column, interval_columns, number, percent, table_of
from mauvecl.schema.errors import InputError, Message
from mauvecl.study.cases import Case, Use, amplitude_column, cases, collect_messages
from mauvecl.study.questions import check_sweep, fitted_models
from mauvecl.study.study import Study

if TYPE_CHECKING:
    from mauvecl.fits.spectrum import Forecast
    from mauvecl.fits.time_course import CoolingCourse, MeasuredBins
    from mauvecl.flares.frames import Components, StareExpectation
    from mauvecl.flares.stare import Event
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.stars.flare import FlareSpectrum


#: Number of exposures drawn and fitted at once, which limits the memory and the time until a fit can be cancelled.
BATCH = 256
#: S/N below which the coverage of intervals differs from the nominal one (bench/coverage.py).
WILKS_SNR = 10.0
#: p-value below which a fit is rejected.
REJECTED = 0.01


def true_values(case: Case, amplitude: float, names: Iterable[str]) -> dict[str, float]:
    """Return the true values of a case's flare by the names of fitted quantities; NaN where it has none."""
    star, quiet, lit = case.star, case.source, case.flaring(amplitude)
    band, light, nm = case.study.flare.band, case.study.flare.light(), lit.wavelength_nm
    added = lit.flux_flam - np.interp(nm, quiet.wavelength_nm, quiet.flux_flam)
    added = added - light.flux_at_telescope(nm)
    # Ratio of the flux at the telescope to that of the flare's spectrum.
    scale = float(np.trapezoid(added, nm) / np.trapezoid(light.flux(nm), nm))
    continuum = light.continuum if isinstance(light, spectra.FlareWithLines) else light
    two, kelvin = continuum if isinstance(continuum, spectra.TwoBlackbodies) else None, continuum.temperature_k
    far = np.nan if star.distance_pc is None else star.distance_pc * spectra.PARSEC_CM
    radius = np.nan if star.radius_rsun is None else star.radius_rsun * spectra.SUN_CM
    area = np.pi * far**2 * scale if continuum.surface else np.nan
    area *= 1.0 if two is None else 1.0 + two.second_area
    values = {"area": area, "filling factor": float(area / (np.pi * radius**2))}
    if kelvin is not None:
        # Flux of the blackbodies without recombination.
        body, at = continuum if two else spectra.Blackbody(kelvin), quiet.wavelength_nm
        hot = scale * photons(at, body.flux(at), band)
        values |= {"temperature": kelvin, "amplitude": hot / photons(at, quiet.flux_flam, band)}
    if kelvin is not None and two is not None:
        # The first temperature is the lower one.
        (low, first), (high, second) = sorted([(kelvin, 1.0), (two.second_temperature_k, two.second_area)])
        values |= {"temperature": low, "second temperature": high, "second area": second / first}
    if continuum.surface:
        values["jump"] = continuum.jump if isinstance(continuum, spectra.BalmerFlare) else 1.0
    sphere = 4 * np.pi * far**2
    factors = {"flux": 1.0, "luminosity": sphere, "energy": sphere * case.quiet.exposure_s}
    for kind, _, of in (name.partition(" ") for name in names):
        if kind in factors:
            values[f"{kind} {of}"] = factors[kind] * _flux(light, scale, of)
        elif kind == "line":
            values[f"line {of}"] = _line_flux(light, scale, of)
    return {name: values.get(name, np.nan) for name in names}


def _flux(light: FlareSpectrum, scale: float, of: str) -> float:
    """Return a flare's flux at the telescope in a range of wavelengths, or all of it; `scale` is that over `light`."""
    if of == "bolometric":
        lines = light.fluxes_cgs.values() if isinstance(light, spectra.FlareWithLines) else ()
        return scale * light.bolometric_flux() + sum(lines)
    low, high = (float(end) for end in of.removesuffix(" nm").split("-"))
    nm = light.grid(np.linspace(low, high, 4001))
    return 10.0 * float(np.trapezoid(scale * light.flux(nm) + light.flux_at_telescope(nm), nm))


def _line_flux(light: FlareSpectrum, scale: float, of: str) -> float:
    """Return the flux of a line at the telescope."""
    if not isinstance(light, spectra.FlareWithLines):
        return 0.0 if light.surface else np.nan
    relative = scale * light.continuum_flux
    lines = dict(light.fluxes_cgs) | {line: relative * share for line, share in light.fractions.items()}
    name = spectra.EmissionLine.named(of).name
    return next((flux for line, flux in lines.items() if spectra.EmissionLine.named(line).name == name), 0.0)


@dataclass(frozen=True, eq=False)
class ExpectedMeasurement(StarInCell):
    """Model and flare with true values and expected errors of a fit."""

    amplitude: float  # of the study's flare
    model: str
    snr: tuple[float, float]  # of the flare in one exposure: everything known, and unknowns marginalised
    truth: Float  # shape (n_derived,); NaN where the flare has no such quantity
    known: Forecast  # everything known
    ahead: Forecast  # unknowns of the study marginalised
    perfect: Measurement  # the fit to the mean exposure: estimates without noise
    fitted: FlareModel | TwoTemperatures
    quiet: Expectation
    unknown: Nuisances | None  # of the fits
    of_throughput: Float | None  # standard errors by the calibration of the throughput, which exposures share
    skipped_nm: Ranges  # wavelength ranges that are not used

    @property
    def name(self) -> str:
        """The star, the flare and the model, for pictures."""
        return f"{self.title}, flare {100 * self.amplitude:g} %, {self.model}"

    def forecasts(self, factors: Float, unknown: Nuisances | None) -> list[Forecast]:
        """Return the expected errors for the flare times factors, with unknowns marginalised or all of them known.

        Errors of a flare that leaves too few pixels below saturation are undefined.
        """
        kelvin, ahead = np.exp(self.perfect.log_k[0]), []
        for linear in factors[:, None] * self.perfect.amplitudes[0]:
            try:
                ahead.append(forecast_model(self.quiet, self.fitted, kelvin, linear, unknown, self.skipped_nm))
            except InputError:
                ahead.append(replace(self.ahead, errors=np.full_like(self.ahead.errors, np.nan)))
        return ahead

    def region(self, rise: float, n: int = 161) -> tuple[Float, Float, Float]:
        """Return temperatures (K) of the expected confidence region, with the smallest and largest amplitude at each.

        A `rise` of chi-squared bounds the region; everything else is profiled. The arrays have the shape (n,). Only for
        models of one temperature.
        """
        assert isinstance(self.fitted, FlareModel)
        best, linear = self.perfect.log_k, self.perfect.factor[0] * self.perfect.amplitudes[0]
        mean_dn = self.fitted.counts(float(np.exp(best[0])), linear)
        reduction = ReducedSums.of(self.fitted, self.quiet, mean_dn, self.unknown, self.skipped_nm)
        mean, light = linear[0] * reduction.spline(best) + linear[1:] @ reduction.fixed, reduction.light
        of_light = None
        if light is not None:
            # The sum of the factor on light for the fitted flare.
            flare = linear[0] * light.spline(best)[:, 0] + linear[1:] @ light.fixed[:, 0]
            of_light = light.scale * (self.perfect.factor - light.expected) + flare
        profile = Profile(reduction, mean, of_light)
        gain = float(mean[0] @ mean[0])
        amplitude = self.fitted.splines[self.fitted.names.index("amplitude")]
        assert amplitude is not None

        fit = BestFit(best, linear[None], np.array([gain]))
        low, high = (float(end[0]) for end in profile.ends(fit, profile.gain_at_nodes(), rise))
        low, high = np.nan_to_num(low, nan=profile.nodes[0]), np.nan_to_num(high, nan=profile.nodes[-1])
        # Dense at the ends, where the two amplitudes converge like a root.
        log_k = (low + high) / 2 + (high - low) / 2 * np.sin(np.linspace(-np.pi / 2, np.pi / 2, n))
        *_, face = profile.faces(log_k[None])
        ratio = face.ratio(np.moveaxis(amplitude(log_k[None]), -1, 0), profile.factor_at(log_k[None]))
        least, most = (ratio.end(rise - gain + face.gain, sign)[0] for sign in (-1.0, 1.0))
        return np.exp(log_k), np.maximum(least, 0.0), most


def fit_model(
    frames: Float, quiet: Expectation, model: FlareModel | TwoTemperatures, unknown: Nuisances | None, skipped: Ranges
) -> Measurement:
    """Fit a model of one or two temperatures to exposures."""
    if isinstance(model, TwoTemperatures):
        return fit_two_temperatures(frames, quiet, model.single, unknown, skipped_nm=skipped)
    return fit(frames, quiet, model, unknown, skipped_nm=skipped)


def model_of(case: Case, *, jump: bool = False, lines: tuple[str, ...] = ()) -> FlareModel:
    """Return the model of a blackbody at the star of a case, with a Balmer continuum and lines if they are fitted."""
    study, star = case.study, case.star
    return FlareModel.of(
        case.source, case.instrument, case.quiet, jump=jump, lines=lines, band=study.flare.band,
        electron_temperature_k=study.flare.spectrum.electron_temperature_k, distance_pc=star.distance_pc,
        radius_rsun=star.radius_rsun, bands_nm=study.measure.bands_nm, order=study.observation.order,
    )  # fmt: skip


def models_of(case: Case) -> dict[str, FlareModel | TwoTemperatures]:
    """Return the models that are fitted to exposures of a case, the simplest first."""
    fitted = fitted_models(case.study.measure, case.study.flare)
    models = {name: model_of(case, jump=jump, lines=lines) for name, jump, lines in fitted}
    return {name: TwoTemperatures(model) if name == "two-temperatures" else model for name, model in models.items()}


def expected_measurements(
    case: Case, amplitude: float, flare: Expectation, models: dict[str, FlareModel | TwoTemperatures] | None = None
) -> list[ExpectedMeasurement]:
    """Forecast the measurement of a flare with each model, by default those of `models_of`."""
    quiet, unknown, skipped = case.quiet, case.unknowns_of_fits(), case.study.measure.skipped_nm
    models = models or models_of(case)
    truth = true_values(case, amplitude, {name: None for model in models.values() for name in model.names})
    lit = flare.recorded_dn - quiet.recorded_dn
    known_snr, snr = (matched_filter(quiet, flare, nuisances, lit, skipped)[1] for nuisances in (None, case.unknowns()))
    # Exposures with each mode of the throughput's own errors at one standard deviation.
    calibrated = [
        _mean_exposure(quiet, moved.expect(moved.flaring(amplitude))[0].recorded_dn - moved.quiet.recorded_dn, unknown)
        for moved in throughput_cases(case)
    ]
    # A fit in few pixels may differ from the flare in runs of them that saturate, which its errors must not use.
    nm = flare.wavelength_nm
    saturated = true_runs(~variance_of(flare)[1])
    lost = (*skipped, *((float(nm[first]), float(nm[end - 1])) for first, end in saturated))
    expected = []
    for name, model in models.items():
        perfect = fit_model(_mean_exposure(quiet, lit, unknown), quiet, model, unknown, skipped)
        known, ahead = (
            forecast_model(quiet, model, np.exp(perfect.log_k[0]), perfect.amplitudes[0], nuisances, lost)
            for nuisances in (None, unknown)
        )
        true = np.array([truth[quantity] for quantity in model.names])
        of_throughput = None
        if calibrated:
            # The observer knows the quiescent exposure from other frames, and fits with the calibrated throughput.
            moved = [fit_model(exposure, quiet, model, unknown, skipped).estimates[0] for exposure in calibrated]
            of_throughput = np.asarray(np.sqrt(np.sum(np.square(moved - perfect.estimates[0]), axis=0)))
        results = (known_snr, snr), true, known, ahead, perfect, model, quiet, unknown, of_throughput, skipped
        expected.append(ExpectedMeasurement(case.label, case.at, amplitude, name, *results))
    return expected


def _mean_exposure(quiet: Expectation, added_dn: Float, unknown: Nuisances | None) -> Float:
    """Return the mean of an exposure with a flare at the prior mean of the factor on all light, DN."""
    factor = unknown.mean_factor if unknown else 1.0
    return np.asarray(quiet.recorded_dn + (factor - 1.0) * quiet.recorded_light_dn + factor * added_dn)


def matched_filter(
    quiet: Expectation, flare: Expectation, unknown: Nuisances | None, added_dn: Float | None, skipped_nm: Ranges
) -> tuple[Float, float]:
    """Return the weights of a matched filter of variance one, per DN, shape (n_pixel,), and its mean with the flare.

    The variance is that of the quiescent star, or of one with some light added (DN). The mean is 0 if the used pixels
    have no light of the flare that unknowns leave.
    """
    variance, used = usable_variance(quiet, added_dn, skipped_nm)
    delta = (flare.recorded_dn - quiet.recorded_dn) * used
    weights = np.divide(delta, variance, out=np.zeros_like(delta), where=used)
    if unknown:
        rows = unknown.rows(variance, unknown.spectra * used)
        weights = weights - (rows @ delta) @ rows
    power = float(weights @ delta)
    return (weights / np.sqrt(power), float(np.sqrt(power))) if power > 0 else (weights, 0.0)


def _quantiles(estimates: Float, shares: float | list[float]) -> Float:
    """Return quantiles of estimates, (n, n_derived), along their first axis; NaN where no fit has the quantity.

    A fit in which one blackbody is best has no second temperature, and is left out.
    """
    quantiles = np.full((*np.shape(shares), estimates.shape[1]), np.nan)
    has = np.isfinite(estimates).any(axis=0)
    quantiles[..., has] = np.nanquantile(estimates[:, has], shares, axis=0)
    return quantiles


@dataclass(frozen=True, eq=False)
class MeasuredFlare(ExpectedMeasurement):
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
        variance, residual = np.where(used, variance, np.inf), self.frame - mean - expected
        return mean, expected + fitted_amplitudes(unknown.spectra, unknown.sd, residual, variance) @ unknown.spectra

    def rows(self) -> QTable:
        """Return one row per quantity."""
        return table_of(COLUMNS, [self])

    @cached_property
    def coverages(self) -> dict[str, Float]:
        """Shares of intervals that hold the truth, with 95 % intervals, by their columns; shape (3, n_derived) each."""
        found, covers = self.found, dict[str, Float]()
        exposures = {"": np.ones(self.selected.size, np.bool_), "_selected": self.selected}
        for (suffix, chosen), (k, level) in product(exposures.items(), enumerate(found.levels)):
            inside = ((found.low[k] <= self.truth) & (self.truth <= found.high[k]))[chosen]
            cover = covers[f"coverage_{100 * level:.0f}{suffix}"] = np.full((3, self.truth.size), np.nan)
            has_truth = np.isfinite(self.truth) & bool(len(inside))
            cover[:, has_truth] = clopper_pearson_ends(inside[:, has_truth].sum(axis=0), max(len(inside), 1))
        return covers

    @property
    def bias_selected(self) -> Float:
        """Median of the estimates of detected flares less the truth, shape (n_derived,); NaN if none is detected."""
        return _quantiles(self.found.estimates[self.selected], 0.5) - self.truth

    @property
    def scatter(self) -> Float:
        """Half of the width of the central 68.27 % of the estimates, shape (n_derived,); NaN for a single estimate."""
        low, high = _quantiles(self.found.estimates, [0.15865, 0.84135])
        return np.asarray((high - low) / 2 if len(self.found.estimates) > 1 else np.full_like(low, np.nan))

    @cached_property
    def rejected(self) -> Interval:
        """Share of fits that are rejected, with its 95 % interval."""
        return clopper_pearson(int((self.found.p_value < REJECTED).sum()), self.found.p_value.size)

    @cached_property
    def detected(self) -> Interval:
        """Share of exposures in which the flare is detected, with its 95 % interval."""
        return clopper_pearson(int(self.selected.sum()), self.selected.size)


@dataclass(frozen=True, eq=False)
class JointFit:
    """Fit of shape and spectrum to all frames, with the drawn flare."""

    found: Measurement
    truth: Float  # shape (n_derived,)
    true: CoolingCourse
    fitted: CoolingCourse


@dataclass(frozen=True, eq=False)
class MeasuredStare(StarInCell):
    """Flares of a simulated stare, measured in bins of frames with one model, and by a joint fit."""

    model: str
    staring: StareExpectation
    events: tuple[Event, ...]
    drawn: MeasuredBins | None
    perfect: MeasuredBins | None  # the same bins without noise
    joint: JointFit | None
    unmeasured: str = ""  # why no bin reaches the S/N


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
    Column("error_throughput", "of_throughput", "",
           "standard error by the calibration of the throughput, which all exposures share", "by throughput",
           number(".4g"), when=lambda answer: any(flare.of_throughput is not None for flare in answer.flares)),
    Column("perfect", lambda row: row.perfect.estimates[0], "", "estimate from an exposure without noise",
           "fit without noise", number(".4g"), detail=True),
    *interval_columns("{}_68", lambda row: (row.perfect.low[0, 0], row.perfect.high[0, 0]), "",
                      "the 68 % interval of that fit; infinite if there is none"),
    Column("low_95", lambda row: row.perfect.low[1, 0], "", "lower end of the 95 % interval of that fit", "95 % from",
           number(".4g"), detail=True),
    Column("high_95", lambda row: row.perfect.high[1, 0], "", "its upper end", "to", number(".4g"), detail=True),
    Column("median", lambda row: _quantiles(row.found.estimates, 0.5), "", "median of the estimates"),
    Column("bias", lambda row: _quantiles(row.found.estimates, 0.5) - row.truth, "",
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


def _bin_columns(stare: MeasuredStare) -> list[Column]:
    """Return the columns of measurements along a stare."""
    assert stare.drawn is not None
    columns = [column.of_part("drawn") for column in stare.drawn.columns]
    exact = Column("temperature_without_noise", lambda row: row.perfect.found.estimates[:, 0], "K",
                   "temperature fitted to the means of these frames", "without noise", ".0f")  # fmt: skip
    place = [column.name for column in columns].index("temperature") + 1
    return [*columns[:place], exact, *columns[place:]]


@dataclass(eq=False)
class MeasureAnswer(Answer):
    """Answer of `measure`: forecast errors, simulated fits and their coverage, and measurements along stares."""

    USES = ("instrument", "sky", "flare", "processes", "nuisances", "seed", "sweep")

    study: Study
    flares: list[MeasuredFlare]  # all models of each flare of each star and cell of the sweep
    messages: list[str]
    # One stare per star and cell, if the study requests bins of a stare or a joint fit.
    stares: list[MeasuredStare] = field(default_factory=list)

    #: Errors, bias and coverage; one row per star, cell, flare, model and quantity.
    table = TableOf(
        "measure", (amplitude_column(), MODEL_COLUMN, *COLUMNS), "flares", by_star=True, key="rows",
        title=lambda answer: f"Measured in one exposure; {answer.study.measure.fits} simulated fits of each flare",
        shown=lambda table: table[table["unit"] != "erg / s"],
    )  # fmt: skip
    #: Measurements against time; one row per star, cell and bin of its stare.
    temperatures = TableOf(
        "temperatures",
        lambda answer: [replace(MODEL_COLUMN, heading=""), *chain(*map(_bin_columns, answer.binned[:1]))],
        lambda answer: answer.binned or QTable(), by_star=True, key="temperatures", when="study.measure.snr_per_bin",
        row_table=lambda _, stare: table_of(_bin_columns(stare), [stare]),
        title=lambda answer: answer.binned and f"Measured along the stare, in bins of S/N "
        f"{answer.study.measure.snr_per_bin:g}",
    )  # fmt: skip
    #: Joint fits of shape and spectrum; one row per star, cell and quantity.
    joint = TableOf(
        "joint", JOINT_COLUMNS, "stares", by_star=True, key="joint", when="study.measure.joint_fit",
        title="One stare: shape and spectrum of the flare, fitted to all frames together",
        shown=lambda table: table[table["unit"] != "erg / cm2"],
    )  # fmt: skip
    #: Goodness of fit and detection; one row per star, cell, flare and model.
    fits = TableOf("fits", (amplitude_column(), MODEL_COLUMN, *FIT_COLUMNS), "flares", by_star=True, key="fits",
                   title="Goodness of fit")  # fmt: skip

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses: the stare only if it is measured."""
        return (*self.USES, "stare") if self.stares else self.USES

    @property
    def binned(self) -> list[MeasuredStare]:
        """Stares in which some bin has the requested S/N."""
        return [stare for stare in self.stares if stare.drawn is not None]

    @property
    def headline(self) -> str:
        """The error of the first measured quantity of the first flare."""
        flare = self.flares[0]
        name, unit = flare.found.names[0], flare.found.units[0]
        error, known_error = flare.ahead.errors[0], flare.known.errors[0]
        ideal = "" if self.study.nuisances.none else f" ({known_error:.3g} {unit} {IF_KNOWN})"
        return (
            f"{self.instrument_name} would measure the {name.replace('_', ' ')} of a flare of "
            f"{100 * flare.amplitude:g} % on {flare.subject} in {flare.quiet.exposure_s:g} s with a standard error of "
            f"{error:.3g} {unit}{ideal}."
        )

    @property
    def inputs(self) -> list[Expectation]:
        return list({id(flare.quiet): flare.quiet for flare in self.flares}.values())


@by_keywords("flares")
def measure(study: Study, engine: Engine | Pool | None = None, progress: Progress = None) -> MeasureAnswer:
    """Forecast and simulate the measurement of a study's flares in one exposure.

    The study's ``measure`` gives the models, the number of fits, and whether flares of a stare are measured as well.
    Raises InputError for flares that replace photosphere, and for amplitudes of 0.
    """
    if study.flare.geometry != "added":
        raise InputError.of("flare.geometry", "replaces", "'added', since fits take light for added")
    if study.measure.along_stare:
        check_sweep(study.sweep, study.stare, study.events)
    prepared = cases(study)
    if any(not amplitude > 0.0 for case in prepared for amplitude in case.amplitudes):
        raise InputError.of("flare.amplitudes", 0, "above 0 in a measurement")
    expectations = [x for case in prepared for x in case.expectations]
    engine = engine or Engine()
    questions = [(case, *flare) for case in prepared for flare in zip(case.amplitudes, case.flares, strict=True)]
    measured = reported(map_in_order(engine, lambda row: _measured(*row, engine), questions), len(questions), progress)
    flares = list(chain.from_iterable(measured))
    stares = [measured_stare(case, engine) for case in prepared] if study.measure.along_stare else []
    messages = collect_messages(expectations) + [stare.unmeasured for stare in stares if stare.unmeasured]
    drawn = dict[str, None]()
    for case in prepared:
        unknown = case.unknowns_of_fits()
        names = [name for name in drawn_factors(case.processes, case.quiet) if not unknown or name not in unknown.names]
        if names:
            text = (
                f"NOT MARGINALISED: {join_names(names)}. Exposures are drawn with other levels than fits expect, so "
                f"that intervals miss the truth; `nuisances.{names[0]}` marginalises over one."
            )
            drawn[Message(text, "not marginalised")] = None
    return MeasureAnswer(study, flares, [*messages, *drawn, *_doubtful(flares)], stares)


def _measured(case: Case, amplitude: float, flare: Expectation, engine: Engine | Pool) -> list[MeasuredFlare]:
    """Fit all models to simulated exposures of a flare."""
    study, quiet = case.study, case.quiet
    expected = expected_measurements(case, amplitude, flare)
    models, unknown = [forecast.fitted for forecast in expected], expected[0].unknown
    skipped = study.measure.skipped_nm
    weights = matched_filter(quiet, flare, case.unknowns(), None, skipped)[0]

    def fitted(start: int, count: int) -> Arrays:
        raw = engine.realise(flare, start=start, count=count, seed=study.run.seed, **case.draw_options)
        excess = raw - quiet.recorded_dn
        arrays: Arrays = {"first": excess[0], "detected": excess @ weights >= scipy.stats.norm.isf(study.run.fap)}
        for k, model in enumerate(models):
            measurement = fit_model(raw, quiet, model, unknown, skipped)
            arrays |= {f"{k} {key}": value for key, value in measurement.arrays().items()}
        return arrays

    checkpoint = engine.checkpoint if isinstance(engine, Pool) else None
    batches: list[Arrays] = []
    for start in range(0, study.measure.fits, BATCH):
        count = min(BATCH, study.measure.fits - start)
        # Another number than 2 is needed if fits keep other arrays, so that older checkpoints are not read.
        depends_on = ("measure", 2, quiet, flare, unknown, models, study.text(), start, count)
        batches.append(checkpointed(checkpoint, depends_on, partial(fitted, start, count)))
    selected = np.concatenate([arrays["detected"] for arrays in batches])
    measured = []
    for k, forecast in enumerate(expected):
        fits = list[Measurement]()
        for batch in batches:
            arrays: dict[str, Any] = {name: batch[f"{k} {name}"] for name in forecast.perfect.arrays()}
            fits.append(replace(forecast.perfect, **arrays | {"dof": int(arrays["dof"])}))
        joined = Measurement.joined(fits)
        measured.append(MeasuredFlare(**vars(forecast), found=joined, selected=selected, frame=batches[0]["first"]))
    return measured


def measured_stare(case: Case, engine: Engine | Pool) -> MeasuredStare:
    """Draw the stare of a case, and measure its flares with the last model of a single temperature."""
    # Single exposures do not need the modules of stares.
    from mauvecl.device.stares import Stares
    from mauvecl.fits.time_course import fit_bins, measure_along
    from mauvecl.flares.stare_scene import StaresRequest

    study, question = case.study, case.study.measure
    staring, events = case.stare_expectation, case.events
    if question.joint_fit and len(events) != 1:
        fault = f"a joint fit needs a stare with a single flare, but it has {len(events)}"
        raise InputError(fault, key="measure.joint_fit")
    quiet, stare, seed = staring.quiet, staring.stare, study.run.seed
    models = models_of(case.one_frame)
    # Where only two temperatures are fitted, the model of one of them, with its lines.
    single = [("blackbody", double.single) for double in models.values() if isinstance(double, TwoTemperatures)]
    single += [(name, model) for name, model in models.items() if isinstance(model, FlareModel)]
    name, model = single[-1]
    unknown = case.unknowns_of_fits(quiet, stare)
    processes = study.processes.additive_only

    def draw(components: Components) -> Float:
        request = StaresRequest(components, stare, 1, seed, staring.flare, start=study.stare.number, method="pixels",
                                processes=processes)  # fmt: skip
        reduced = engine.stares if isinstance(engine, Pool) else Stares(engine.open_device).reduced
        return np.asarray(reduced(request)["values"][0], np.float64)

    checkpoint = engine.checkpoint if isinstance(engine, Pool) else None
    depends_on = ("pixels", quiet, staring.flare_electrons, stare, staring.flare, study.stare.number, seed, processes)
    raw = checkpointed(checkpoint, depends_on, lambda: {"frames": staring.raw(draw)})["frames"]
    joint = _joint_fit(case, raw, unknown) if question.joint_fit else None
    bins, perfect, unmeasured, skipped = None, None, "", question.skipped_nm
    if (snr := question.snr_per_bin) is not None:
        try:
            bins = measure_along(raw, quiet, model, unknown, snr_per_bin=snr, stare=stare, skipped_nm=skipped)
        except InputError as error:
            unmeasured = f"No flare of {case.label} is measured along the stare: {error}."
        else:
            mean = staring.mean_raw
            perfect = fit_bins(mean, quiet, model, unknown, stare, bins.first, bins.count, skipped_nm=skipped)
    return MeasuredStare(case.label, case.at, name, staring, tuple(events), bins, perfect, joint, unmeasured)


def _joint_fit(case: Case, raw: Float, unknown: Nuisances | None) -> JointFit:
    """Fit a blackbody to the one flare of a stare; the search for the best fit starts from the true flare."""
    from mauvecl.fits.time_course import cooling_course, cooling_event, fit_cooling
    from mauvecl.flares import Cooling

    staring, (event,), model = case.stare_expectation, case.events, model_of(case.one_frame)
    quiet, stare, skipped = staring.quiet, staring.stare, case.study.measure.skipped_nm
    measurement = fit_cooling(
        raw, quiet, model, unknown, peak_s=event.peak_s, half_width_s=event.half_width_s, shape=event.form,
        cooling=isinstance(event.temperature, Cooling), stare=stare, skipped_nm=skipped,
    )  # fmt: skip
    true, fitted = (
        cooling_course(flare_event, measurement, raw, quiet, model, stare, skipped)
        for flare_event in (event, cooling_event(measurement, event.form))
    )
    truth = true.values
    if not case.study.flare.is_blackbody:
        # Only the shape is that of the model.
        truth = np.where(np.arange(truth.size) < 2, truth, np.nan)
    return JointFit(measurement, truth, true, fitted)


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
