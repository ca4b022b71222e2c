"""Measurement of the flare's spectrum: errors in closed form, and simulated fits."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.measure import COLUMNS
from mauvecl.answers.measurements import expected_measurements, models_of
from mauvecl.charts.chart import Axis, Band, Chart, ChartData, Dots, Line, Own
from mauvecl.fits.flare_model import FlareModel
from mauvecl.schema.columns import View, records
from mauvecl.study.nuisances import NuisanceChoice
from mauvecl.web.closed_forms import Answers, short
from mauvecl.web.tabs.tab import Tab

if TYPE_CHECKING:
    from mauvecl.answers.measure import MeasuredFlare
    from mauvecl.answers.measurements import ExpectedMeasurement
    from mauvecl.fits.spectrum import Forecast
    from mauvecl.web.closed_forms import ClosedForms

Float = NDArray[np.float64]

#: Unknowns of an observer, by name on the page, as the study's section of nuisances.
ASSUMED = {
    "everything known": NuisanceChoice(),
    "usual unknowns": NuisanceChoice(usual=True),
    "dark and star free": NuisanceChoice.model_validate({"dark": "free", "light": "free"}),
}
#: Names of the curves.
NAMES = ("known", "usual", "free")
#: Increase of chi-squared that encloses 95 % in two dimensions.
RISE_95 = 5.99
#: Factors on the amplitude at which errors are computed.
FACTORS = np.geomspace(0.1, 10.0, 9)
#: Half-widths before and after the peak of a flare in a stare that are shown.
NEAR = (2.0, 6.0)
#: Largest number of simulated fits that are shown.
MOST_DOTS = 500


@lru_cache(maxsize=4)
def expected(closed: ClosedForms) -> dict[str, ExpectedMeasurement]:
    """Return the forecast with the flare's own model for each of `ASSUMED`."""
    case = closed.case
    own = dict(list(models_of(case).items())[-1:])
    measurements = {}
    for name, nuisances in ASSUMED.items():
        assumed = case.with_sections(nuisances=nuisances)
        (measurements[name],) = expected_measurements(assumed, case.amplitudes[0], closed.flare, own)
    return measurements


def simulated(answers: Answers) -> MeasuredFlare | None:
    """Return the simulated fits of the flare's own model, if there are any."""
    return answers["measure"].flares[-1] if "measure" in answers else None


@Chart(
    "errors", "Error of the temperature for smaller and larger flares", Axis("flare amplitude (%)", log=True),
    Axis("error of the temperature (%)", log=True, limits=(0.1, 1000)),
    (
        # Errors with other unknowns may be the same: dashes show the curve below.
        *(
            Line(called, colour, name, width=2, dash="dashed" * (name == "free"),
                 tips=("amplitude (%)", f"{called} (%)"))
            for called, name, colour in zip(ASSUMED, NAMES, ("flare", "star", "sky"), strict=True)
        ),
        Own(),
    ),
    sets="amplitude_percent=x", pins="known",
).data()  # fmt: skip
def temperature_errors(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the relative error of the temperature against the amplitude of the flare."""
    own = 100 * closed.study.flare.amplitudes[0]
    series: dict[str, Any] = {}
    for name, measurement in zip(NAMES, expected(closed).values(), strict=True):
        ahead = measurement.forecasts(FACTORS, measurement.unknown)
        series[name] = own * FACTORS, [100 * f.errors[0] / f.values[0] for f in ahead]
    all_known, *_, free = expected(closed).values()
    which = "temperature" if isinstance(all_known.fitted, FlareModel) else "lower temperature"
    series["own"] = [own], [100 * all_known.ahead.errors[0] / all_known.ahead.values[0]]
    text = (
        f"With everything known the {which} has a standard error of {_error(all_known)}, with dark level and star "
        f"unknown one of {_error(free)}."
    )
    return ChartData(text, series)


def _error(measurement: ExpectedMeasurement) -> str:
    return f"{short(measurement.ahead.errors[0])} K"


@Chart(
    "region", "Temperature and amplitude: 95 % confidence region", Axis("temperature (K)"),
    Axis("amplitude of the blackbody (%)"),
    (
        Band("dark and star free", "sky", "free", alpha=0.3),
        Band("everything known", "flare", "known", alpha=0.5),
        Dots("simulated fits", name="fits", size=3),
        Own("the flare"),
    ),
    logs=("x",),
).data()  # fmt: skip
def region(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the confidence region of temperature and amplitude."""
    all_known, *_, free = expected(closed).values()
    # A fit without noise stands for a flare without these quantities, such as one from a file.
    true, without_noise = all_known.truth[:2], all_known.perfect.estimates[0, :2]
    best = true if np.isfinite(true).all() else without_noise
    series: dict[str, Any] = {"own": ([best[0]], [100 * best[1]])}
    fits = simulated(answers)
    if fits is not None:
        some = fits.found.estimates[:MOST_DOTS]
        series["fits"] = some[:, 0], 100 * some[:, 1]
    one_temperature = isinstance(all_known.fitted, FlareModel)
    for name, measurement in (("known", all_known), ("free", free)):
        kelvin, low, high = measurement.region(RISE_95) if one_temperature else _ellipse(best, measurement.ahead)
        series[name] = kelvin, 100 * low, 100 * high
    x = np.asarray(series["free"][0])
    text = (
        f"With dark level and star unknown the 95 % region reaches from {short(x[0])} to {short(x[-1])} K: hotter "
        "flares of smaller area look alike."
        if one_temperature
        else "The flare has two temperatures, of which this is the lower one. Regions follow from its standard "
        "errors where these are below 100 %; simulated fits need no such limit."
    )
    return ChartData(text, series)


def _ellipse(best: Float, ahead: Forecast) -> tuple[Float, Float, Float]:
    """Return the confidence region of the first two quantities, of normal errors of their logarithms.

    Its temperatures, with the smallest and largest amplitude at each, are empty for errors of 100 % or more.
    """
    spread = ahead.covariance[:2, :2] / np.outer(best, best)
    if not (np.diag(spread) < 1.0).all():
        return np.empty(0), np.empty(0), np.empty(0)
    angle, slope = np.linspace(-np.pi / 2, np.pi / 2, 161), spread[0, 1] / spread[0, 0]
    along = np.sqrt(RISE_95 * spread[0, 0]) * np.sin(angle)
    half = np.sqrt(RISE_95 * (spread[1, 1] - slope * spread[0, 1])) * np.cos(angle)
    low, high = (best[1] * np.exp(slope * along + side) for side in (-half, half))
    return best[0] * np.exp(along), low, high


@Chart(
    "course", "Temperature of the flare along a stare", Axis("time from the start of the stare (s)"),
    Axis("temperature (K)", log=True),
    (
        Band("bins of frames: 95 % interval", "star", "bins", alpha=0.3),
        Dots("bins of frames", "star", "estimates"),
        Line("simulated flare", "total", "true", dash="dashed"),
        Line("joint fit", "flare", "joint", width=2),
    ),
).data()  # fmt: skip
def course(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the temperature along a simulated stare."""
    stares = answers["measure"].stares if "measure" in answers else []
    if not stares:
        return ChartData("No stare is measured yet: choose a joint fit or the S/N of bins, and simulate fits.")
    (stare_fit,), words, series = stares, list[str](), dict[str, Any]()
    if stare_fit.joint is not None:
        (event,), stare = stare_fit.events, stare_fit.staring.stare
        since = (stare.middle_s - event.peak_s) / event.half_width_s
        near = (since > -NEAR[0]) & (since < NEAR[1])
        for name, fit in (("true", stare_fit.joint.true), ("joint", stare_fit.joint.fitted)):
            series[name] = stare.middle_s[near], fit.kelvin[near]
        measurement = stare_fit.joint.found
        each = zip(
            measurement.names[:4], measurement.units, measurement.estimates[0], measurement.errors[0], strict=False
        )
        words += [f"{name} {short(best)} +- {short(error)} {unit}".strip() for name, unit, best, error in each]
    if isinstance(stare_fit.drawn, str):
        words.append(stare_fit.drawn)
    elif stare_fit.drawn is not None:
        bins = stare_fit.drawn
        x, kelvin = (bins.start_s + bins.end_s) / 2, bins.found.estimates[:, 0]
        ends = (
            np.where(np.isfinite(end), end, kelvin) for end in (bins.found.low[-1, :, 0], bins.found.high[-1, :, 0])
        )
        series |= {"estimates": (x, kelvin), "bins": (x, *ends)}
        two = not isinstance(next(iter(expected(closed).values())).fitted, FlareModel)
        words.append(f"{x.size} bins of frames{', each fitted with one temperature' if two else ''}")
    return ChartData(f"One simulated stare: {'; '.join(words)}.", series)


class Measurement(Tab):
    """Measurement of the flare's spectrum."""

    verb = "measure"
    # Fits along a flare have no pointing losses.
    never = ("pointing_rate", "pointing_duration", "pointing_depth")
    about = (
        "What is measured of the flare once it is detected: its temperature, size and light, with errors in closed "
        "form; simulated fits count how often their intervals hold the truth."
    )
    pictures = (temperature_errors, region, course)
    simulations = {"measure": "Simulate fits"}  # noqa: RUF012
    files = dict.fromkeys(("measure", "fits", "temperatures", "joint"), "measure")

    def offers(self, name: str, answers: Answers) -> bool:
        # Measurements along a stare are made on request.
        return super().offers(name, answers) and name in answers["measure"].tables

    def shown(self, closed: ClosedForms, answers: Answers) -> View:
        each, fits = expected(closed), simulated(answers)
        first = next(iter(each.values()))
        table = [
            {"quantity": name, "unit": unit, "truth": value, **dict(zip(each, errors, strict=True))}
            for name, unit, value, *errors in zip(
                first.fitted.names,
                first.fitted.units,
                first.truth,
                *(measurement.ahead.errors for measurement in each.values()),
                strict=True,
            )
        ]
        counted = () if fits is None else ("scatter", "coverage_95")
        if fits is not None:
            table = [row | counts for row, counts in zip(table, records(fits.rows()), strict=True)]
        verb = {column.name: column for column in COLUMNS}
        errors = [replace(verb["error"], name=name, heading=f"error, {name}") for name in each]
        columns = [verb["quantity"], verb["unit"], verb["truth"], *errors, *(verb[name] for name in counted)]
        return View(self.title, columns, table)
