"""Measurement of the flare's spectrum: errors in closed form, and simulated fits."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.answers.measurements.expected import expected_measurements, models_of
from mauvecl.answers.measurements.measure import COLUMNS
from mauvecl.fits.flare_model import FlareModel
from mauvecl.schema.tables import View, records
from mauvecl.study.nuisances import NuisanceChoice
from mauvecl.web.closed_forms import short
from mauvecl.web.figures import Canvas
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from mauvecl.answers.measurements.expected import ExpectedMeasurement
    from mauvecl.answers.measurements.measure import MeasuredFlare
    from mauvecl.fits.spectrum import Forecast
    from mauvecl.web.closed_forms import ClosedForms

Float = NDArray[np.float64]

#: Unknowns of an observer, by name on the page, as the study's section of nuisances.
ASSUMED = {
    "everything known": NuisanceChoice(),
    "usual unknowns": NuisanceChoice(usual=True),
    "dark and star free": NuisanceChoice.model_validate({"dark": "free", "light": "free"}),
}
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
    found = {}
    for name, nuisances in ASSUMED.items():
        assumed = case.with_sections(nuisances=nuisances)
        (found[name],) = expected_measurements(assumed, case.amplitudes[0], closed.flare, own)
    return found


def simulated(answers: Answers) -> MeasuredFlare | None:
    """Return the simulated fits of the flare's own model, if there are any."""
    return answers["measure"].flares[-1] if "measure" in answers else None


class Errors(Picture):
    """Relative error of the temperature against the amplitude of the flare."""

    name, title = "errors", "Error of the temperature for smaller and larger flares"
    sets = "amplitude_percent=x"
    pins = "known"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(
            ink, "flare amplitude (%)", "error of the temperature (%)", logs | {"x", "y"}, y_range=(0.1, 1000)
        )
        for name, colour in zip(("known", "usual", "free"), ("flare", "star", "sky"), strict=True):
            called = list(ASSUMED)[("known", "usual", "free").index(name)]
            # Errors with other unknowns may be the same: dashes show the curve below.
            dash: dict[str, Any] = {"line_dash": "dashed"} if name == "free" else {}
            curve = canvas.line(name, called, colour, line_width=2, **dash)
            canvas.tooltips(curve, ("amplitude (%)", "x"), (f"{called} (%)", "y"))
        canvas.pinned()
        canvas.own_point()
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        own = 100 * closed.study.flare.amplitudes[0]
        sources: dict[str, Any] = {}
        for name, one in zip(("known", "usual", "free"), expected(closed).values(), strict=True):
            ahead = one.forecasts(FACTORS, one.unknown)
            sources[name] = {"x": own * FACTORS, "y": [100 * f.errors[0] / f.values[0] for f in ahead]}
        known, *_, free = expected(closed).values()
        which = "temperature" if isinstance(known.fitted, FlareModel) else "lower temperature"
        sources["own"] = {"x": [own], "y": [100 * known.ahead.errors[0] / known.ahead.values[0]]}
        text = (
            f"With everything known the {which} has a standard error of {_error(known)}, with dark level and star "
            f"unknown one of {_error(free)}."
        )
        return PictureData(text, sources)


def _error(one: ExpectedMeasurement) -> str:
    return f"{short(one.ahead.errors[0])} K"


class Region(Picture):
    """Confidence region of temperature and amplitude."""

    name, title = "region", "Temperature and amplitude: 95 % confidence region"
    logs = ("x",)

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "temperature (K)", "amplitude of the blackbody (%)", logs)
        canvas.band("free", "dark and star free", "sky", alpha=0.3)
        canvas.band("known", "everything known", "flare", alpha=0.5)
        canvas.dots("fits", "simulated fits", "drawn", size=3)
        canvas.own_point("the flare")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        all_known, *_, free = expected(closed).values()
        sources: dict[str, Any] = {name: {"x": [], "y": []} for name in ("fits", "own")}
        # A fit without noise stands for a flare without these quantities, such as one from a file.
        true, without_noise = all_known.truth[:2], all_known.perfect.estimates[0, :2]
        best = true if np.isfinite(true).all() else without_noise
        sources["own"] = {"x": [best[0]], "y": [100 * best[1]]}
        fits = simulated(answers)
        if fits is not None:
            some = fits.found.estimates[:MOST_DOTS]
            sources["fits"] = {"x": some[:, 0], "y": 100 * some[:, 1]}
        one_temperature = isinstance(all_known.fitted, FlareModel)
        for name, one in (("known", all_known), ("free", free)):
            kelvin, low, high = one.region(RISE_95) if one_temperature else _ellipse(best, one.ahead)
            sources[name] = {"x": kelvin, "low": 100 * low, "high": 100 * high}
        x = np.asarray(sources["free"]["x"])
        text = (
            f"With dark level and star unknown the 95 % region reaches from {short(x[0])} to {short(x[-1])} K: hotter "
            "flares of smaller area look alike."
            if one_temperature
            else "The flare has two temperatures, of which this is the lower one. Regions follow from its standard "
            "errors where these are below 100 %; simulated fits need no such limit."
        )
        return PictureData(text, sources)


def _ellipse(best: Float, ahead: Forecast, n: int = 161) -> tuple[Float, Float, Float]:
    """Return the confidence region of the first two quantities, of normal errors of their logarithms.

    Its temperatures, with the smallest and largest amplitude at each, are empty for errors of 100 % or more.
    """
    spread = ahead.covariance[:2, :2] / np.outer(best, best)
    if not (np.diag(spread) < 1.0).all():
        return np.empty(0), np.empty(0), np.empty(0)
    angle, slope = np.linspace(-np.pi / 2, np.pi / 2, n), spread[0, 1] / spread[0, 0]
    along = np.sqrt(RISE_95 * spread[0, 0]) * np.sin(angle)
    half = np.sqrt(RISE_95 * (spread[1, 1] - slope * spread[0, 1])) * np.cos(angle)
    low, high = (best[1] * np.exp(slope * along + side) for side in (-half, half))
    return best[0] * np.exp(along), low, high


class Course(Picture):
    """Temperature along a simulated stare."""

    name, title = "course", "Temperature of the flare along a stare"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "time from the start of the stare (s)", "temperature (K)", logs | {"y"})
        canvas.band("bins", "bins of frames: 95 % interval", "star", alpha=0.3)
        canvas.dots("estimates", "bins of frames", "star")
        canvas.line("true", "simulated flare", "total", line_dash="dashed")
        canvas.line("joint", "joint fit", "flare", line_width=2)
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        sources: dict[str, Any] = {name: {"x": [], "y": []} for name in ("estimates", "true", "joint")}
        sources["bins"] = {"x": [], "low": [], "high": []}
        stares = answers["measure"].stares if "measure" in answers else []
        if not stares:
            text = "No stare is measured yet: choose a joint fit or the S/N of bins, and simulate fits."
            return PictureData(text, sources)
        (one,), words = stares, []
        if one.joint is not None:
            (event,), stare = one.events, one.staring.stare
            since = (stare.middle_s - event.peak_s) / event.half_width_s
            near = (since > -NEAR[0]) & (since < NEAR[1])
            for name, course in (("true", one.joint.true), ("joint", one.joint.fitted)):
                sources[name] = {"x": stare.middle_s[near], "y": course.kelvin[near]}
            found = one.joint.found
            each = zip(found.names[:4], found.units, found.estimates[0], found.errors[0], strict=False)
            words += [f"{name} {short(best)} +- {short(error)} {unit}".strip() for name, unit, best, error in each]
        if isinstance(one.drawn, str):
            words.append(one.drawn)
        elif one.drawn is not None:
            bins = one.drawn
            x, kelvin = (bins.start_s + bins.end_s) / 2, bins.found.estimates[:, 0]
            ends = [
                np.where(np.isfinite(end), end, kelvin) for end in (bins.found.low[-1, :, 0], bins.found.high[-1, :, 0])
            ]
            sources["estimates"] = {"x": x, "y": kelvin}
            sources["bins"] = dict(zip(("x", "low", "high"), (x, *ends), strict=True))
            two = not isinstance(next(iter(expected(closed).values())).fitted, FlareModel)
            words.append(f"{x.size} bins of frames{', each fitted with one temperature' if two else ''}")
        return PictureData(f"One simulated stare: {'; '.join(words)}.", sources)


class Measurement(Tab):
    """Measurement of the flare's spectrum."""

    verb = "measure"
    # Fits along a flare have no pointing losses.
    never = ("pointing_rate", "pointing_duration", "pointing_depth")
    about = (
        "What is measured of the flare once it is detected: its temperature, size and light, with errors in closed "
        "form; simulated fits count how often their intervals hold the truth."
    )
    pictures = (Errors(), Region(), Course())
    simulations = {"measure": "Simulate fits"}  # noqa: RUF012
    files = dict.fromkeys(("measure", "fits", "temperatures", "joint"), "measure")

    def offers(self, name: str, answers: Answers) -> bool:
        # Measurements along a stare are made on request.
        return super().offers(name, answers) and name in answers["measure"].tables

    def shown(self, closed: ClosedForms, answers: Answers) -> View:
        each, fits = expected(closed), simulated(answers)
        known = next(iter(each.values()))
        table = [
            {"quantity": name, "unit": unit, "truth": value, **dict(zip(each, errors, strict=True))}
            for name, unit, value, *errors in zip(
                known.fitted.names,
                known.fitted.units,
                known.truth,
                *(one.ahead.errors for one in each.values()),
                strict=True,
            )
        ]
        counted = () if fits is None else ("scatter", "coverage_95")
        if fits is not None:
            table = [row | counts for row, counts in zip(table, records(fits.rows()), strict=True)]
        verb = {one.name: one for one in COLUMNS}
        errors = [replace(verb["error"], name=name, heading=f"error, {name}") for name in each]
        columns = [verb["quantity"], verb["unit"], verb["truth"], *errors, *(verb[name] for name in counted)]
        return View(self.title, columns, table)
