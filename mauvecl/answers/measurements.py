"""Measurements of flares that are expected or simulated, in single exposures and along a stare."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.answers.answer import InCell
from mauvecl.answers.closed_forms import throughput_cases
from mauvecl.fits.flare_model import FlareModel, Ranges, Ratio, ReducedSums, usable_variance, variance_of
from mauvecl.fits.profile import Profile
from mauvecl.fits.spectrum import Forecast, Measurement, TwoTemperatures, fit, fit_two_temperatures, forecast_model
from mauvecl.host.arrays import true_runs
from mauvecl.host.stars import flare as spectra
from mauvecl.host.stars.bands import photons
from mauvecl.runs.checkpoint import kept
from mauvecl.runs.pool import Pool
from mauvecl.schema.errors import InputError
from mauvecl.study.questions import fitted_models

if TYPE_CHECKING:
    from mauvecl.detection.nuisances import Nuisances
    from mauvecl.device.engine import Engine
    from mauvecl.fits.time_course import CoolingCourse, MeasuredBins
    from mauvecl.flares.frames import Components, StareExpectation
    from mauvecl.flares.stare import Event
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.host.stars.flare import FlareSpectrum
    from mauvecl.host.stars.source import Source
    from mauvecl.study.cases import Case
    from mauvecl.study.star import Star

Float = NDArray[np.float64]


class Truth:
    """True values of a flare that was added to a star."""

    def __init__(self, star: Star, quiet: Source, lit: Source, light: FlareSpectrum, band: str, exposure_s: float):
        self._light, self._star, self._exposure_s = light, star, exposure_s
        nm = lit.wavelength_nm
        added = lit.flux_flam - np.interp(nm, quiet.wavelength_nm, quiet.flux_flam)
        added = added - light.flux_at_telescope(nm)
        # Ratio of the flux at the telescope to that of the flare's spectrum.
        self._scale = float(np.trapezoid(added, nm) / np.trapezoid(light.flux(nm), nm))
        continuum = light.continuum if isinstance(light, spectra.FlareWithLines) else light
        self._values = dict.fromkeys(("temperature", "second temperature", "second area", "amplitude", "jump"), np.nan)
        two, kelvin = continuum if isinstance(continuum, spectra.TwoBlackbodies) else None, continuum.temperature_k
        if kelvin is not None:
            # Flux of the blackbodies without recombination.
            body, at = continuum if two else spectra.Blackbody(kelvin), quiet.wavelength_nm
            hot = self._scale * photons(at, body.flux(at), band)
            self._values |= {"temperature": kelvin, "amplitude": hot / photons(at, quiet.flux_flam, band)}
        if kelvin is not None and two is not None:
            # The first is the cooler one.
            (low, area), (high, hot_area) = sorted([(kelvin, 1.0), (two.second_temperature_k, two.second_area)])
            self._values |= {"temperature": low, "second temperature": high, "second area": hot_area / area}
        if continuum.surface:
            self._values["jump"] = continuum.jump if isinstance(continuum, spectra.BalmerFlare) else 1.0
        self._far = np.nan if star.distance_pc is None else star.distance_pc * spectra.PARSEC_CM
        self._area = np.pi * self._far**2 * self._scale if continuum.surface else np.nan
        self._area *= 1.0 if two is None else 1.0 + two.second_area

    def value(self, name: str) -> float:
        """Return the true value of a quantity by its name in fits; NaN if the flare has none."""
        first, _, rest = name.partition(" ")
        if name in self._values:
            return self._values[name]
        if first in ("flux", "luminosity", "energy"):
            sphere = 4 * np.pi * self._far**2
            factor = {"flux": 1.0, "luminosity": sphere, "energy": sphere * self._exposure_s}
            return factor[first] * self._flux(rest)
        if first == "line":
            return self._line(rest)
        radius = np.nan if self._star.radius_rsun is None else self._star.radius_rsun * spectra.SUN_CM
        return self._area if name == "area" else float(self._area / (np.pi * radius**2))

    def _flux(self, where: str) -> float:
        if where == "bolometric":
            lines = self._light.fluxes_cgs.values() if isinstance(self._light, spectra.FlareWithLines) else ()
            return self._scale * self._light.bolometric_flux() + sum(lines)
        low, high = (float(end) for end in where.removesuffix(" nm").split("-"))
        nm = self._light.grid(np.linspace(low, high, 4001))
        return 10.0 * float(np.trapezoid(self._scale * self._light.flux(nm) + self._light.flux_at_telescope(nm), nm))

    def _line(self, name: str) -> float:
        if not isinstance(self._light, spectra.FlareWithLines):
            return 0.0 if self._light.surface else np.nan
        relative = self._scale * self._light.continuum_flux
        lines = [(line, relative * share) for line, share in self._light.fractions.items()]
        lines += self._light.fluxes_cgs.items()
        wanted = spectra.EmissionLine.named(name).name
        return next((flux for line, flux in lines if spectra.EmissionLine.named(line).name == wanted), 0.0)


@dataclass(frozen=True, eq=False)
class ExpectedMeasurement(InCell):
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
        kelvin, linear = np.exp(self.perfect.log_k[0]), self.perfect.amplitudes[0]

        ahead = []
        for factor in factors:
            try:
                one = forecast_model(self.quiet, self.fitted, kelvin, factor * linear, unknown, self.skipped_nm)
            except InputError:
                one = replace(self.ahead, errors=np.full_like(self.ahead.errors, np.nan))
            ahead.append(one)
        return ahead

    def region(self, rise: float, n: int = 161) -> tuple[Float, Float, Float]:
        """Return temperatures of the expected confidence region, with the smallest and largest amplitude at each.

        A `rise` of chi-squared bounds the region; everything else is profiled. Only for models of one temperature.
        """
        assert isinstance(self.fitted, FlareModel)
        best, linear = self.perfect.log_k, self.perfect.factor[0] * self.perfect.amplitudes[0]
        mean_dn = self.fitted.counts(float(np.exp(best[0])), linear)
        reduction = ReducedSums.of(self.fitted, self.quiet, mean_dn, self.unknown, self.skipped_nm)
        mean, light = linear[0] * reduction.spline(best) + linear[1:] @ reduction.fixed, reduction.light
        of_light = None
        if light is not None:
            # The sum of the factor on light for the fitted flare.
            flare = linear[0] * light.spline(best) + linear[1:] @ light.fixed
            of_light = light.scale * (self.perfect.factor - light.expected) + flare
        profile = Profile(reduction, mean, of_light)
        gain = float(mean[0] @ mean[0])
        amplitude = self.fitted.splines[self.fitted.names.index("amplitude")]
        assert amplitude is not None

        def at(log_k: Float) -> tuple[Float, Ratio]:
            """Return what is left of the rise at temperatures, and the amplitude there."""
            x = log_k[None]
            face = profile.face(x)
            return rise - gain + face.gain, face.ratio(np.moveaxis(amplitude(x), -1, 0), profile.factor_at(x))

        nodes = np.linspace(reduction.log_k[0], reduction.log_k[-1], 8 * reduction.log_k.size)
        inside = np.flatnonzero(at(nodes)[0][0] >= 0.0)
        # From the outermost node inside to the next one, where the region ends, or from the fit.
        known = nodes[inside[[0, -1]]] if inside.size else np.array([best[0], best[0]])
        beyond = np.searchsorted(nodes, known[0]) - 1, np.searchsorted(nodes, known[1], side="right")
        ends = [
            scipy.optimize.brentq(lambda x: float(at(np.array([x]))[0][0, 0]), inner, nodes[k])
            if 0 <= k < nodes.size else inner
            for inner, k in zip(known, beyond, strict=True)
        ]  # fmt: skip
        # Dense at the ends, where the two amplitudes converge like a root.
        log_k = (ends[0] + ends[1]) / 2 + (ends[1] - ends[0]) / 2 * np.sin(np.linspace(-np.pi / 2, np.pi / 2, n))
        left, ratio = at(log_k)
        low, high = (ratio.end(left, sign)[0] for sign in (-1.0, 1.0))
        return np.exp(log_k), np.maximum(low, 0.0), high


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
    asked = fitted_models(case.study.measure, case.study.flare)
    models = {name: model_of(case, jump=jump, lines=lines) for name, jump, lines in asked}
    return {name: TwoTemperatures(model) if name == "two-temperatures" else model for name, model in models.items()}


def expected_measurements(
    case: Case, amplitude: float, flare: Expectation, models: dict[str, FlareModel | TwoTemperatures] | None = None
) -> list[ExpectedMeasurement]:
    """Forecast the measurement of a flare with each model, by default those of `models_of`."""
    quiet, own, unknown, skipped = case.quiet, case.study.flare, case.unknowns_of_fits(), case.study.measure.skipped_nm
    truth = Truth(case.star, case.source, case.flaring(amplitude), own.light(), own.band, quiet.exposure_s)
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
    for name, model in (models or models_of(case)).items():
        perfect = fit_model(_mean_exposure(quiet, lit, unknown), quiet, model, unknown, skipped)
        known, ahead = (
            forecast_model(quiet, model, np.exp(perfect.log_k[0]), perfect.amplitudes[0], nuisances, lost)
            for nuisances in (None, unknown)
        )
        true = np.array([truth.value(quantity) for quantity in model.names])
        of_throughput = None
        if calibrated:
            # The observer knows the quiescent exposure from other frames, and fits with the calibrated throughput.
            moved = [fit_model(exposure, quiet, model, unknown, skipped).estimates[0] for exposure in calibrated]
            of_throughput = np.asarray(np.sqrt(np.sum(np.square(moved - perfect.estimates[0]), axis=0)))
        found = (known_snr, snr), true, known, ahead, perfect, model, quiet, unknown, of_throughput, skipped
        expected.append(ExpectedMeasurement(case.label, case.at, amplitude, name, *found))
    return expected


def _mean_exposure(quiet: Expectation, added_dn: Float, unknown: Nuisances | None) -> Float:
    """Return the mean of an exposure with a flare at the prior mean of the factor on all light, DN."""
    factor = unknown.mean_factor if unknown else 1.0
    return np.asarray(quiet.recorded_dn + (factor - 1.0) * quiet.recorded_light_dn + factor * added_dn)


def matched_filter(
    quiet: Expectation, flare: Expectation, unknown: Nuisances | None, added_dn: Float | None, skipped_nm: Ranges
) -> tuple[Float, float]:
    """Return the weights of a matched filter of variance one, and its mean with the flare.

    The variance is that of the quiescent star, or of one with some light added.
    """
    variance, used = usable_variance(quiet, added_dn, skipped_nm)
    delta = (flare.recorded_dn - quiet.recorded_dn) * used
    weights = np.divide(delta, variance, out=np.zeros_like(delta), where=used)
    if unknown:
        rows = unknown.rows(variance, unknown.spectra * used)
        weights = weights - (rows @ delta) @ rows
    power = float(weights @ delta)
    return (weights / np.sqrt(power), float(np.sqrt(power))) if power > 0 else (weights, 0.0)


@dataclass(frozen=True, eq=False)
class JointFit:
    """Fit of shape and spectrum to all frames, with the drawn flare."""

    found: Measurement
    truth: Float  # shape (n_derived,)
    true: CoolingCourse
    fitted: CoolingCourse


@dataclass(frozen=True, eq=False)
class MeasuredStare(InCell):
    """Flares of a simulated stare, measured in bins of frames with one model, and by a joint fit."""

    model: str
    staring: StareExpectation
    events: tuple[Event, ...]
    drawn: MeasuredBins | None
    perfect: MeasuredBins | None  # the same bins without noise
    joint: JointFit | None
    unmeasured: str = ""  # why no bin reaches the S/N


def measured_stare(case: Case, engine: Engine | Pool) -> MeasuredStare:
    """Draw the stare of a case, and measure its flares with the last model of a single temperature."""
    # Single exposures do not need the modules of stares.
    from mauvecl.device.stares import Stares
    from mauvecl.fits.time_course import fit_bins, measure_along
    from mauvecl.flares.stare_scene import StaresRequest

    study, asked = case.study, case.study.measure
    staring, events = case.stare_expectation, case.events
    if asked.joint_fit and len(events) != 1:
        fault = f"a joint fit needs a stare with a single flare, but it has {len(events)}"
        raise InputError(fault, key="measure.joint_fit")
    quiet, stare, seed = staring.quiet, staring.stare, study.run.seed
    models = models_of(case.one_frame)
    single = [(name, one) for name, one in models.items() if isinstance(one, FlareModel)]
    # Where only two temperatures are fitted, the model of one of them, with its lines.
    single += [("blackbody", one.single) for one in models.values() if isinstance(one, TwoTemperatures) and not single]
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
    raw = kept(checkpoint, depends_on, lambda: {"frames": staring.raw(draw)})["frames"]
    joint = _joint_fit(case, raw, unknown) if asked.joint_fit else None
    bins, perfect, unmeasured, skipped = None, None, "", asked.skipped_nm
    if asked.snr_per_bin is not None:
        try:
            bins = measure_along(raw, quiet, model, unknown, snr_per_bin=asked.snr_per_bin, stare=stare,
                                 skipped_nm=skipped)  # fmt: skip
        except InputError as error:
            unmeasured = f"No flare of {case.label} is measured along the stare: {error}."
    if bins is not None:
        mean = staring.mean_raw
        perfect = fit_bins(mean, quiet, model, unknown, stare, bins.first, bins.count, skipped_nm=skipped)
    return MeasuredStare(case.label, case.at, name, staring, tuple(events), bins, perfect, joint, unmeasured)


def _joint_fit(case: Case, raw: Float, unknown: Nuisances | None) -> JointFit:
    """Fit a blackbody to the one flare of a stare; the search for the best fit starts from the true flare."""
    from mauvecl.fits.time_course import cooling_course, cooling_event, fit_cooling
    from mauvecl.flares.settings import Cooling

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
