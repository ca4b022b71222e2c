"""Tabs of observations: measured flares, stares, light curves, calibrations, changes between visits, and campaigns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from bokeh.models import FixedTicker, HoverTool, LinearColorMapper
from bokeh.palettes import interp_palette

from mauvecl.answers.measure import COLUMNS as MEASURED_COLUMNS
from mauvecl.answers.measure import expected_measurements, models_of
from mauvecl.answers.plan import COLUMNS as PLAN_COLUMNS
from mauvecl.charts import chart, light_curves, spectra
from mauvecl.charts.chart import Area, Chart, ChartData, Custom, Dots, Line, OwnMarker, PlotAxis, Rule, Targets
from mauvecl.charts.spectra import FACTORS, RISES
from mauvecl.fits.flare_model import FlareModel
from mauvecl.host.arrays import PER_MAD, Float
from mauvecl.host.stars.source import Source
from mauvecl.schema.columns import View, chance_text, records
from mauvecl.schema.errors import InputError
from mauvecl.study.observation import KNOWN, NuisanceChoice
from mauvecl.web.closed_forms import Answers, short
from mauvecl.web.sandboxed_reader import read_limited
from mauvecl.web.tab import Tab, target_words
from mauvecl.web.uploads import MOST_VALUES, VisitorFile, read_frames_of, unzipped

if TYPE_CHECKING:
    from bokeh.models.sources import ColumnDataSource

    from mauvecl.answers.change import ChangeAnswer
    from mauvecl.answers.measure import ExpectedMeasurement
    from mauvecl.answers.plan import PlanAnswer
    from mauvecl.answers.visible import VisibleAnswer
    from mauvecl.fits.spectrum import Forecast
    from mauvecl.observations.analysis import Analysis
    from mauvecl.observations.frames import Frames
    from mauvecl.web.closed_forms import ClosedForms, FieldValues
    from mauvecl.web.tab import Canvas
    from mauvecl.web.uploads import Observations

#: Unknowns of an observer, by name on the page, as the study's section of nuisances.
ASSUMED = {
    "everything known": KNOWN,
    "usual unknowns": NuisanceChoice(),
    "dark and star free": NuisanceChoice.model_validate({"usual": False, "dark": "free", "light": "free"}),
}
NAMES = ("known", "usual", "free")  # names of the curves
NEAR = (2.0, 6.0)  # half-widths before and after the peak of a flare in a stare that are shown
MOST_DOTS = 500  # largest number of simulated fits that are shown


@lru_cache(maxsize=4)
def forecast(closed: ClosedForms) -> dict[str, ExpectedMeasurement]:
    """Return the forecast with the flare's own model for each of `ASSUMED`."""
    case = closed.case
    own_model = dict(list(models_of(case).items())[-1:])
    measurements = {}
    for name, nuisances in ASSUMED.items():
        assumed = case.with_sections(nuisances=nuisances)
        (measurements[name],) = expected_measurements(assumed, case.amplitudes[0], closed.flare, own_model)
    return measurements


@Chart(
    "errors", "Error of the temperature for smaller and larger flares", PlotAxis("flare amplitude (%)", log=True),
    PlotAxis("error of the temperature (%)", log=True, limits=(0.1, 1000)),
    (
        # Errors with other unknowns may be the same: dashes show the curve below.
        *(
            Line(label, colour, name, width=2, dash="dashed" * (name == "free"), tips=("amplitude (%)", f"{label} (%)"))
            for label, name, colour in zip(ASSUMED, NAMES, ("flare", "star", "sky"), strict=True)
        ),
        OwnMarker(),
    ),
    sets="amplitude_percent=x", pins="known",
).data()  # fmt: skip
def temperature_errors(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the relative error of the temperature against the amplitude of the flare."""
    # Fewer amplitudes than in files suffice.
    percent, factors, series = 100 * closed.case.amplitudes[0], FACTORS[::3], dict[str, Any]()
    for name, measurement in zip(NAMES, forecast(closed).values(), strict=True):
        ahead = measurement.forecasts(factors, measurement.unknown)
        series[name] = percent * factors, [100 * f.errors[0] / f.values[0] for f in ahead]
    all_known, *_, free = forecast(closed).values()
    quantity = "temperature" if isinstance(all_known.fitted, FlareModel) else "lower temperature"
    series["own"] = [percent], [100 * all_known.ahead.errors[0] / all_known.ahead.values[0]]
    text = (
        f"With everything known the {quantity} has a standard error of {short(all_known.ahead.errors[0])} K, with dark "
        f"level and star unknown one of {short(free.ahead.errors[0])} K."
    )
    return ChartData(text, series)


@Chart(
    "region", "Temperature and amplitude: 95 % confidence region", PlotAxis("temperature (K)"),
    PlotAxis("amplitude of the blackbody (%)"),
    (
        Area("dark and star free", "sky", "free", alpha=0.3),
        Area("everything known", "flare", "known", alpha=0.5),
        Dots("simulated fits", name="fits", size=3),
        OwnMarker("the flare"),
    ),
    logs=("x",),
).data()  # fmt: skip
def region(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the confidence region of temperature and amplitude."""
    all_known, *_, free = forecast(closed).values()
    # A fit without noise stands for a flare without these quantities, such as one from a file.
    true, without_noise = all_known.truth[:2], all_known.perfect.estimates[0, :2]
    best = true if np.isfinite(true).all() else without_noise
    series: dict[str, Any] = {"own": ([best[0]], [100 * best[1]])}
    if "measure" in answers:
        # The last fits are those of the flare's own model.
        estimates = answers["measure"].flares[-1].found.estimates[:MOST_DOTS]
        series["fits"] = estimates[:, 0], 100 * estimates[:, 1]
    one_temperature = isinstance(all_known.fitted, FlareModel)
    for name, measurement in (("known", all_known), ("free", free)):
        kelvin, low, high = measurement.region(RISES["95 %"]) if one_temperature else _ellipse(best, measurement.ahead)
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
    along = np.sqrt(RISES["95 %"] * spread[0, 0]) * np.sin(angle)
    half = np.sqrt(RISES["95 %"] * (spread[1, 1] - slope * spread[0, 1])) * np.cos(angle)
    low, high = (best[1] * np.exp(slope * along + side) for side in (-half, half))
    return best[0] * np.exp(along), low, high


@Chart(
    "course", "Temperature of the flare along a stare", PlotAxis("time from the start of the stare (s)"),
    PlotAxis("temperature (K)", log=True),
    (
        Area("bins of frames: 95 % interval", "star", "bins", alpha=0.3),
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
        fits = stare_fit.joint.found
        rows = zip(fits.names[:4], fits.units, fits.estimates[0], fits.errors[0], strict=False)
        words += [f"{name} {short(best)} +- {short(error)} {unit}".strip() for name, unit, best, error in rows]
    if stare_fit.unmeasured:
        words.append(stare_fit.unmeasured)
    elif stare_fit.drawn is not None:
        bins, fits = stare_fit.drawn, stare_fit.drawn.found
        x, kelvin = (bins.start_s + bins.end_s) / 2, fits.estimates[:, 0]
        ends = (np.where(np.isfinite(end), end, kelvin) for end in (fits.low[-1, :, 0], fits.high[-1, :, 0]))
        series |= {"estimates": (x, kelvin), "bins": (x, *ends)}
        two = not isinstance(next(iter(forecast(closed).values())).fitted, FlareModel)
        words.append(f"{x.size} bins of frames{', each fitted with one temperature' if two else ''}")
    return ChartData(f"One simulated stare: {'; '.join(words)}.", series)


def measured(closed: ClosedForms, answers: Answers) -> View:
    """Return the errors of each quantity, and the counts of simulated fits."""
    measurements = forecast(closed)
    first, *_ = measurements.values()
    errors = [measurement.ahead.errors for measurement in measurements.values()]
    rows = zip(first.ahead.names, first.ahead.units, first.truth, *errors, strict=True)
    table = [dict(zip(("quantity", "unit", "truth", *measurements), row, strict=True)) for row in rows]
    verb = {column.name: column for column in MEASURED_COLUMNS}
    of_error = [replace(verb["error"], name=name, heading=f"error, {name}") for name in measurements]
    columns = [verb["quantity"], verb["unit"], verb["truth"], *of_error]
    if "measure" in answers:
        counts = records(answers["measure"].flares[-1].rows())
        table = [row | counted for row, counted in zip(table, counts, strict=True)]
        columns += [verb["scatter"], verb["coverage_95"]]
    return View("", columns, table)


MEASUREMENT = Tab(
    verb="measure",
    # Fits along a flare have no pointing losses.
    never=("pointing_rate", "pointing_duration", "pointing_depth"),
    about="What is measured of the flare once it is detected: its temperature, size and light, with errors in closed "
    "form; simulated fits count how often their intervals hold the truth.",
    pictures=(temperature_errors, region, course),
    simulations={"measure": "Simulate fits"},
    files=dict.fromkeys(("measure", "fits", "temperatures", "joint"), "measure"),
    own_view=measured,
)


LENGTHS = ("shortest", "middle", "longest")  # half-widths of injected flares, one per line of the picture


@Chart(
    "shares", "Share of flares that a search of a stare finds",
    PlotAxis("peak amplitude of the flare (%)", log=True, limits=(0.01, 100)),
    PlotAxis("share of flares found", limits=(-0.03, 1.05)),
    (
        *(
            series
            for k, length in enumerate(LENGTHS)
            for series in (
                Area(f"{length} flares", length, f"band {k}", listed=False),
                Line(f"{length} flares", length, f"line {k}", width=2,
                     tips=("amplitude (%)", f"found of the {length}")),
            )
        ),
        Rule("amplitude of your question", "own", "own"),
    ),
).data()  # fmt: skip
def shares(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the fraction of injected flares that the search finds against their amplitude."""
    series: dict[str, Any] = {"own": closed.question.amplitude_percent}
    if "completeness" not in answers:
        text = (
            "Nothing is injected yet: Inject flares puts flares of several lengths and sizes into a stare of one "
            "orbit, and searches it."
        )
        return ChartData(text, series)
    injected, clauses = answers["completeness"].stars[0].injected, []
    for k, width in enumerate(injected.half_widths_s):
        x, share = 100 * injected.sizes, injected.completeness[k]
        series[f"line {k}"] = x, share
        series[f"band {k}"] = x, injected.completeness_low[k], injected.completeness_high[k]
        completeness = float(np.interp(np.log(closed.question.amplitude_percent), np.log(x), share))
        clauses.append(f"{chance_text(completeness)} of those of half-width {short(width)} s")
    peak = f"{closed.question.amplitude_percent:g} %"
    return ChartData(f"Of flares that peak at {peak} the search finds {'; '.join(clauses)}.", series)


COMPLETENESS = Tab(
    name="completeness",
    title="Stare",
    about="One exposure sees a flare at its peak; a stare sees it rise and fade. This tab shows which flares a search "
    "of one orbit finds at the chosen rate of false alarms, with losses while the star drifts out of the fibre.",
    pictures=(shares,),
    chance=False,
    # The picture reads off the share of flares of this size.
    also=("amplitude_percent",),
    simulations={"completeness": "Inject flares"},
    answer="completeness",
    view=1,
    files={"completeness": "completeness", "limits": "completeness"},
)


#: Largest numbers of points of a light curve, and of columns and rows of a dynamic spectrum.
MOST_POINTS, MOST_COLUMNS, MOST_ROWS = 8000, 600, 300
BLUE, MIDDLE, RED = "#0072B2", "#F7F7F7", "#D55E00"  # colours of the dynamic spectrum, from low to high
#: Limits of the energy axes, erg, the same for all questions; columns of `PlannedTarget.by_energy` in the pictures.
ENERGIES, BY_ENERGY = (1e28, 1e37), ("energy", "recovered", "rate_above")
NO_FRAMES = "Choose a file of frames: a light curve or a sequence of spectra."


@light_curves.LIGHT_CURVE.data()
def light_curve(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the light curve, its quiescent level, and the events."""
    frames: Frames | None = closed.inputs.get("frames")
    if frames is None:
        return ChartData(NO_FRAMES)
    text, answer = f"{frames.n_frames} frames of {frames.name}. Analyse searches them for flares.", None
    if "analyse" in answers:
        answer = answers["analyse"]
        verdicts = [row.verdict for row in answer.rows]
        named = [verdict for verdict in light_curves.VERDICTS if verdict != "undecided" or verdict in verdicts]
        counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in named)
        text = f"Events in {short(answer.analysis.days)} star-days: {counts}; detected above an S/N of "
        text += f"{answer.analysis.threshold:.2f}."
    series = light_curves.light_curve_series(frames, answer, most=MOST_POINTS)
    return ChartData(text, series, {"y axis": {"axis_label": f"flux ({frames.unit})" if frames.unit else "flux"}})


def _image(canvas: Canvas, source: ColumnDataSource) -> None:
    colours = interp_palette((BLUE, MIDDLE, RED), 255)
    mapper = LinearColorMapper(palette=colours, name="deviation", low=-5, high=5, nan_color=canvas.ink["grid"])
    image = canvas.plot.image("image", "x", "y", "dw", "dh", source=source, color_mapper=mapper)
    shown = [("standard deviations", "@image{0.0}"), ("minute", "$x{0.0}"), ("nm", "$y{0.0}")]
    canvas.plot.add_tools(HoverTool(renderers=[image], tooltips=shown))


@Chart(
    "dynamic", "Dynamic spectrum", PlotAxis("time from the first frame (min)"), PlotAxis("wavelength (nm)"),
    (
        Custom("dynamic", columns=("image", "x", "y", "dw", "dh"), draw=_image),
        chart.Contours("events", "star", "marks", show="if any", width=5),
        chart.LegendEntry("brighter than the median", RED, form="bar"),
        chart.LegendEntry("fainter", BLUE, form="bar"),
    ),
).data()  # fmt: skip
def dynamic_spectrum(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return every spectrum against time, in standard deviations from the median."""
    frames: Frames | None = closed.inputs.get("frames")
    if frames is None or frames.wavelength_nm is None:
        return ChartData("A light curve has no spectra." if frames else NO_FRAMES)
    nm = frames.wavelength_nm
    # Columns without frames are 0 / 0.
    with np.errstate(invalid="ignore", divide="ignore"):
        sums, counts, _ = light_curves.column_sums(frames.flux, frames.numbers, MOST_COLUMNS)
        sums, counts, _ = light_curves.column_sums((sums / counts).T, np.arange(nm.size), MOST_ROWS)
        image = sums / counts
        image = image - np.nanmedian(image, axis=1, keepdims=True)
        steps = np.diff(image, axis=1)
        # Differences of neighbouring columns hold noise alone.
        image = image / (PER_MAD / np.sqrt(2.0) * np.nanmedian(np.abs(steps), axis=1, keepdims=True))
    reach = max(3.0, float(np.nanpercentile(np.abs(image), 99.5)))
    length = float(frames.time_s[-1] + frames.cadence_s - frames.time_s[0]) / 60.0
    series: dict[str, Any] = {"dynamic": (image[None], [0.0], [nm[0]], [length], [max(nm[-1] - nm[0], 1.0)])}
    if "analyse" in answers:
        analysis: Analysis = answers["analyse"].analysis
        minutes = (analysis.survey.time_s - frames.time_s[0]) / 60.0
        ends = [minutes[[event.first, event.last]].tolist() for event in analysis.events]
        above = float(nm[-1] + 0.02 * (nm[-1] - nm[0]))
        series["marks"] = ends, [[above, above]] * len(ends)
    text = f"{frames.n_frames} spectra of {nm.size} pixels, {nm[0]:.0f} to {nm[-1]:.0f} nm."
    return ChartData(text, series, {"deviation": {"low": -reach, "high": reach}})


def read_frames(question: FieldValues) -> dict[str, Any]:
    """Read the visitor's frames, as an argument of the verb; raises InputError if they hold too many values."""
    files = question.uploads
    frames = read_frames_of(files["frames"], files.get("mapping"), quality_bits=question.quality_bits)
    if frames.flux.size > MOST_VALUES:
        raise InputError.of("frames", frames.flux.size, f"at most {MOST_VALUES} values, or the command line")
    return {"frames": frames}


def name_of(field: str, otherwise: str) -> Callable[[FieldValues], str]:
    """Return the words of a question about a file: its name, or other words without one."""
    return lambda question: question.uploads[field].name if field in question.uploads else otherwise


ANALYSE = Tab(
    verb="analyse",
    about="Flares in your own light curve or spectra: the noise is checked first, and every event has its false-alarm "
    "rate in the noise as measured. The star's fields are for spectra of Mauve.",
    chance=False,
    pictures=(light_curve, dynamic_spectrum, light_curves.scatter_of_means),
    files=dict.fromkeys(("events", "measured", "frames", "noise", "limits", "completeness"), "analyse"),
    documents={"analyse.html": "analyse"},
    needs="frames",
    read_inputs=read_frames,
    words=name_of("frames", "no file of frames yet"),
)


def read_observations(question: FieldValues) -> dict[str, Any]:
    """Read the raw frames and spectra of the visitor's archive, as arguments of the verb.

    Raises InputError if all frames together hold too many values.
    """
    archive: Observations = question.uploads["observations"]
    files = {name: VisitorFile(name, content) for name, content in unzipped(archive.content).items()}
    frames, stars = [], []
    for row in archive.rows:
        mapping = files[str(row.mapping)] if row.mapping else None
        frames.append(read_frames_of(files[str(row.frames)], mapping))
        if sum(file.flux.size for file in frames) > MOST_VALUES:
            fault = f"the archive holds more than {MOST_VALUES} raw values; give fewer, or use the command line"
            raise InputError(fault, key="observations")
        if row.spectrum is None:
            stars.append(row.source())
            continue
        star = read_limited(Source, Source.read, {"upload": files[str(row.spectrum)].content})
        stars.append(star if row.magnitude is None else star.at_magnitude(row.magnitude, row.band))
    return {"frames": tuple(frames), "stars": tuple(stars)}


CALIBRATE = Tab(
    verb="calibrate",
    about="The instrument from frames of standard stars and of no light: throughput with its errors, dark current, "
    "gain and line width, next to the nominal values.",
    chance=False,
    pictures=(spectra.calibrated_throughput, spectra.residuals_of_stars, spectra.variances_of_frames),
    files=dict.fromkeys(("calibrate", "fits", "throughput", "dark"), "calibrate"),
    documents={"instrument.zip": "calibrate"},
    needs="observations",
    read_inputs=read_observations,
    words=name_of("observations", "no observations yet"),
)


def _against_magnitude(name: str, title: str, label: str, units: Mapping[str, float]) -> Chart:
    """Return the chart of the smallest detected changes against the star's magnitude.

    It shows the changes in one of `units`, which hold the factor from each unit to that of the axis.
    """

    def along(closed: ClosedForms, answer: ChangeAnswer) -> ChartData:
        rows = [row for row in answer.changes if row.change.unit in units]
        sizes = [units[row.change.unit] * row.smallest.one for row in rows]
        words = [f"{spectra.shown_name(row.change.name)} {'hidden' if np.isinf(size) else f'{size:.3g}'}"
                 for row, size in zip(rows, sizes, strict=True)]  # fmt: skip
        finite = [size for size in sizes if not np.isinf(size)]
        text = (
            f"Smallest changes between {answer.study.change.visits} visits, in {label}: "
            f"{'; '.join(words) or 'none of this kind'}."
        )
        lines = spectra.along_magnitude(answer, units)
        return ChartData(text, {name: lines, "own": ([closed.question.magnitude] * len(finite), finite)})

    axis = PlotAxis(f"smallest change ({label})", log=True)
    lines = Targets(name, tips=(label,)), OwnMarker("this star")
    changes = Chart(name, title, PlotAxis("magnitude"), axis, lines, sets="magnitude=x")
    return changes.data("change", "Change computes which differences between visits are detected.")(along)


CHANGE = Tab(
    verb="change",
    about="How small a difference between visits is seen: of lines, bands, the Balmer jump and the colour.",
    pictures=(
        _against_magnitude(
            "changes", "Smallest change of the star's own light", "% or 0.01 mag", {"": 100, "mag": 100}
        ),
        _against_magnitude("fluxes", "Smallest change of the flux of lines", "erg/s/cm²", {"erg / (s cm2)": 1.0}),
    ),
    chance=False,
    # Visits are evenly spaced, without an orbit, and the seed is that of periods.
    never=("targets", "start", "days", "shortest_d", "longest_d", "seed"),
    files={"change": "change", "indices": "change"},
)


def _cells(canvas: Canvas, source: ColumnDataSource) -> None:
    plot, mapper = canvas.plot, canvas.share_colours("recovered")
    cells = plot.quad("left", "right", "bottom", "top", source=source, line_color=None,
                      fill_color={"field": "share", "transform": mapper})  # fmt: skip
    cells.name = "recovered"
    shown = [("recovered", "@share{0 %}"), ("period", "@period{0.[00]} d"), ("amplitude", "@amplitude{0.00}")]
    plot.add_tools(HoverTool(renderers=[cells], tooltips=shown))
    plot.xaxis.ticker = FixedTicker(ticks=[0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200])
    plot.yaxis.ticker = FixedTicker(ticks=[0.5, 1, 2, 4])


@Chart(
    "periods", "Share of periods that visits recover", PlotAxis("period (d)", log=True),
    PlotAxis("semi-amplitude (errors of a visit)", log=True),
    (Custom("cells", columns=("left", "right", "bottom", "top", "period", "amplitude", "share"), draw=_cells),),
).data("periods", "For each period and amplitude, how often it is found in visits that the orbit allows.")  # fmt: skip
def recovered_periods(closed: ClosedForms, answer: ChangeAnswer) -> ChartData:
    """Return the share of recovered periods over period and semi-amplitude."""
    row, *_ = answer.periods
    r = row.recovery
    x, y = (values.ravel() for values in np.meshgrid(r.periods_d, r.amplitudes))
    wide, high = (np.sqrt(points[1] / points[0]) for points in (r.periods_d, r.amplitudes))
    share = row.shares("value").ravel()
    errors = "; ".join(
        f"{spectra.shown_name(row.change.name)} {row.error * (1 if row.change.unit else 100):.3g} "
        f"{row.change.unit or '%'}"
        for row in answer.periods
    )
    text = (
        f"{r.time_d.size} visits within {np.ptp(r.time_d):.0f} days recover {100 * np.mean(share):.0f} % of the "
        f"map's periods. The error of a visit is {errors}."
    )
    return ChartData(text, {"cells": (x / wide, x * wide, y / high, y * high, x, y, share)})


PERIODS = Tab(
    verb="change",
    name="periods",
    title="Periods",
    about="Which periods of the star are found in visits to the first target, at times that the orbit allows, by a "
    "Lomb-Scargle periodogram with a false-alarm probability of 1 %.",
    pictures=(recovered_periods,),
    chance=False,
    simulations={"periods": "Map periods"},
    needs="targets",
    answer="periods",
    view=2,
    # The power is that of differences.
    never=("power", "fap"),
    files={"periods": "periods"},
)


def _energy(value: Any) -> str:
    """Format an energy for readers."""
    return f"{value.value:.2g} erg" if np.isfinite(value) else "no energy"


def _columns(answer: PlanAnswer) -> list[tuple[str, Any, Any, Any]]:
    """Return name, energies, recovered fraction at each, and flares above each in the campaign, of seen targets."""
    columns = []
    for star in answer.planned:
        # Beyond the pictures' ends there is nothing to see.
        rows = star.by_energy
        energies, recovered, above = (rows[name][rows["energy"] <= ENERGIES[1]] for name in BY_ENERGY)
        columns.append((star.name, energies, recovered, above * star.hours / 24))
    return columns


ENERGY = PlotAxis("bolometric energy of the flare (erg)", log=True, limits=ENERGIES)


@Chart(
    "recovered", "Share of flares that the search recovers", ENERGY, PlotAxis("share recovered", limits=(-0.03, 1.05)),
    (Targets("recovered", tips=("share recovered",)),),
).data("plan", "The share of flares that are found on each target, against their energy.")  # fmt: skip
def recovered(closed: ClosedForms, answer: PlanAnswer) -> ChartData:
    """Return the fraction of flares that the search recovers against their energy."""
    clauses = [
        f"{row['target']}: half of the flares at {_energy(row['E50'])}, 90 % at {_energy(row['E90'])}"
        if row["seen"] > 0
        else f"{row['target']} is never seen"
        for row in answer.table
    ]
    return ChartData(f"Recovered: {'; '.join(clauses)}.", {"recovered": [columns[:3] for columns in _columns(answer)]})


@Chart(
    "expected", "Recovered flares above an energy, in the whole campaign", ENERGY,
    PlotAxis("flares", log=True, limits=(1e-3, 1e4)), (Targets("found", tips=("recovered flares",)),),
).data("plan", "The number of flares expected to be found on each target.")  # fmt: skip
def expected(closed: ClosedForms, answer: PlanAnswer) -> ChartData:
    """Return the numbers of recovered flares above an energy."""
    lines, clauses = [], []
    for row, (name, energy, recovered, above) in zip(answer.table, _columns(answer), strict=True):
        # Each step of the rate is recovered as at its middle.
        steps = (above[:-1] - above[1:]) * (recovered[:-1] + recovered[1:]) / 2
        flares = np.append(np.cumsum(steps[::-1])[::-1], 0.0) + (above[-1] * recovered[-1] if above.size else 0.0)
        lines.append((name, energy, np.where(flares > 0, flares, np.nan)[: energy.size]))
        number = f"{row['expected']:.3g} flares" if np.isfinite(row["expected"]) else "no rates are known"
        text = f"{row['target']} in {short(row['hours'].value)} h: {number}"
        clauses.append(text if row["seen"] > 0 else f"{row['target']} is never seen")
    return ChartData(f"Expected to be recovered: {'; '.join(clauses)}.", {"found": lines})


def columns_of_plan(question: FieldValues) -> list[list[str]]:
    """Return the targets, and the columns that a plan will have."""
    names = [target["name"] for target in question.targets] or ["each target"]
    headings = [column.heading for column in PLAN_COLUMNS if column.heading and column.when is None]
    return [headings, *([name, *("·" for _ in headings[1:])] for name in names)]


PLAN = Tab(
    verb="plan",
    about="What a campaign would find: hours, energies recovered, flares expected. Spectrum and flare rates are those "
    "of each target's type; completeness is in closed form, and assumptions have a table.",
    chance=False,
    # The page has no star-time of a campaign's false alarms: one a month. Flares of all sizes are expected.
    never=("false_alarms", "as_observed"),
    pictures=(recovered, expected),
    files=dict.fromkeys(("plan", "stars", "energies", "assumptions"), "plan"),
    words=lambda question: f"{target_words(question)}, {question.hours:g} h each at most",
    rows_before=columns_of_plan,
    needs="targets",
)


@Chart(
    "hours", "Hours in which targets are seen, day by day", PlotAxis(kind="dates"),
    PlotAxis("hours in the day", limits=(-0.5, 24.5)), (Targets("hours", tips=("hours",)),),
).data("visible", "For each target, how many hours of each day it is seen.")  # fmt: skip
def hours(closed: ClosedForms, answer: VisibleAnswer) -> ChartData:
    """Return the daily hours of visibility."""
    table = answer.by_day
    lines, clauses = [], []
    for target in closed.question.targets:
        name = target["name"]
        rows = table[np.asarray(table["target"]) == name]
        hours = np.asarray(rows["hours"].to_value("h"))
        # Milliseconds, as browsers count time.
        lines.append((name, np.asarray(rows["day"], "datetime64[ms]").astype(float), hours))
        clauses.append(
            f"{name} on {np.count_nonzero(hours)} of {hours.size} days, {short(float(hours.sum()))} h in all and "
            f"{hours.max():.3g} h on its best day"
        )
    return ChartData(f"From {closed.question.start} on are seen: {'; '.join(clauses)}.", {"hours": lines})


VISIBILITY = Tab(
    verb="visible",
    name="visibility",
    title="Visibility",
    about="When the satellite can look at targets: clear of Earth, Sun, Moon and radiation.",
    chance=False,
    pictures=(hours,),
    simulations={"visible": "Find when"},
    needs="targets",
    view=1,
    files=dict.fromkeys(("visible", "months", "days"), "visible"),
    words=target_words,
)
