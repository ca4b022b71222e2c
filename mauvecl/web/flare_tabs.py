"""Tabs of flares: limits of detection, errors with which spectra are measured, and the share that a search finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from bokeh.models import FixedTicker, HoverTool, LinearColorMapper
from contourpy import contour_generator
from scipy import special
from scipy.interpolate import PchipInterpolator

from mauvecl.answers.measure import COLUMNS, expected_measurements, models_of
from mauvecl.charts import chart
from mauvecl.charts.chart import Area, Chart, ChartData, Custom, Dots, Line, OwnMarker, PlotAxis, Rule
from mauvecl.charts.spectra import FACTORS, RISES
from mauvecl.fits.flare_model import FlareModel
from mauvecl.host.arrays import Float
from mauvecl.schema.columns import View, chance_text, records
from mauvecl.study.observation import KNOWN, NuisanceChoice
from mauvecl.web.closed_forms import LIMITS, Answers, short
from mauvecl.web.tab import Tab
from mauvecl.web.uploads import RESULTS

if TYPE_CHECKING:
    from bokeh.models.sources import ColumnDataSource

    from mauvecl.answers.measure import ExpectedMeasurement
    from mauvecl.fits.spectrum import Forecast
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.tab import Canvas


T = TypeVar("T")

#: Ranges of the pictures: magnitudes, and amplitudes in per cent, fixed for all questions.
MAGNITUDES, PERCENTS = (2.0, 14.0), (0.1, 100.0)
STEPS = 9, 5  # columns and rows of a map in closed form; smooth quantities are interpolated between them
LABELLED = {0.1: 0.25, 0.5: 0.5, 0.9: 0.75}  # contours, with the part of the line at which the label stands
#: Initial number of points of a curve, number of times that steps are halved, and change above which they are halved.
FIRST, HALVINGS, CHANGE = 9, 5, 0.1
#: Fields on which a map does not depend; an upload is identified by its content.
FREE = {"magnitude", "amplitude_percent", "realisations", "seed", "targets", "start", "days", "hours"}


def _cached(make: Callable[[ClosedForms], T], closed: ClosedForms, *more: float) -> T:
    """Return a map or curve, cached for the values of the question, and `more`, on which it depends."""
    question = closed.question
    values = (value for name, value in question.values.items() if name not in FREE)
    key = (*values, *(star.digest for name, star in question.uploads.items() if name == "star"), *more)
    # Of all visitors, without the closed forms, which take tens of MB.
    value: T | None = RESULTS.get(None, make.__name__, key)
    if value is None:
        value = make(closed)
        RESULTS.keep(None, make.__name__, key, value, 32)
    return value


def _curve(closed: ClosedForms) -> tuple[Float, Float]:
    """Return magnitudes and probabilities, with more points where these change."""

    def exact(magnitudes: Float) -> list[float]:
        lights = 10 ** (-0.4 * (magnitudes - closed.question.magnitude))
        return [forms[0].probability if (forms := closed.at(light, np.ones(1))) else 0.0 for light in lights]

    x = np.linspace(*MAGNITUDES, FIRST)
    y = np.array(exact(x))
    for _ in range(HALVINGS):
        steep = np.nonzero(np.abs(np.diff(y)) > CHANGE)[0]
        new = (x[steep] + x[steep + 1]) / 2
        x, y = np.insert(x, steep + 1, new), np.insert(y, steep + 1, exact(new))
    fine = np.linspace(*MAGNITUDES, 241)
    # Probits are smooth, but infinite for probabilities that round to 0 or 1.
    probits = special.ndtri(np.clip(y, 1e-15, 1 - 1e-15))
    return fine, np.asarray(special.ndtr(PchipInterpolator(x, probits)(fine)))


def _map(closed: ClosedForms) -> tuple[Float, Float, Float]:
    """Return magnitudes, logarithms of amplitudes in per cent, and probabilities.

    The interpolated quantities are, in standard deviations without a flare: logarithms of the flare's part of the
    statistic and of its spread, the threshold and the skewness. A gamma distribution of these moments (Pearson's type
    III) is within 0.05 of the closed forms where they are steepest.
    """
    (columns, rows), (low, high) = STEPS, np.log10(PERCENTS)
    x, y = np.linspace(*MAGNITUDES, columns), np.linspace(low, high, rows)
    # A saturated star has no detectable flare.
    forms = np.zeros((4, rows, columns))
    forms[0], forms[2] = -30.0, 3.0
    for i, light in enumerate(10 ** (-0.4 * (x - closed.question.magnitude))):
        for j, outcome in enumerate(closed.at(light, 10**y / closed.question.amplitude_percent)):
            null, flaring = outcome.null, outcome.flaring
            rise = max((flaring.mean - null.mean) / null.std, 1e-9)
            threshold = (outcome.threshold - null.mean) / null.std
            forms[:, j, i] = np.log(rise), np.log(flaring.std / null.std), threshold, flaring.third / flaring.std**3
    fine = np.linspace(*MAGNITUDES, 97), np.linspace(low, high, 61)
    along_x = PchipInterpolator(x, forms, axis=2)(fine[0])
    rise, spread, threshold, skewness = PchipInterpolator(y, along_x, axis=1)(fine[1])
    # At low skewness the distribution is normal.
    shape = 4 / np.maximum(skewness, 1e-4) ** 2
    offset = np.sqrt(shape) * (threshold - np.exp(rise)) / np.exp(spread)
    return *fine, special.gammaincc(shape, np.maximum(shape + offset, 0.0))


@Chart(
    "limit", "How faint a star: this flare is detected", PlotAxis("magnitude", limits=MAGNITUDES),
    PlotAxis("detection probability", limits=(-0.03, 1.05)),
    (
        Line("closed form", "flare", width=2, tips=("magnitude", "detected")),
        Rule("wanted probability", "threshold", "power", along="y"),
        Dots("simulated", size=8),
        OwnMarker(),
    ),
    sets="magnitude=x", pins="closed form", alike=("band",),
).data()  # fmt: skip
def curve(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the detection probability against the star's magnitude."""
    q, power = closed.question, closed.case.study.limit.power
    series: dict[str, Any] = {"own": ([q.magnitude], [closed.chance]), "power": power}
    text = f"The closed form of {q.statistic} takes too long for a curve: simulate it."
    if not closed.slow:
        x, y = series["closed form"] = _cached(_curve, closed, q.amplitude_percent)
        text = f"{100 * power:g} % of such flares are detected {_reach(x, y, power, q.band)}"
    if "limit" in answers:
        before, in_words, *_ = LIMITS[closed.case.study.limit.of]
        for limit in answers["limit"].limits:
            if limit.statistic != q.statistic:
                continue
            # Points of another quantity than the axis's are reported in words only.
            if limit.of == "magnitude":
                points = [(p.value, p.probability.value) for p in (*limit.points, limit.check)]
                series["simulated"] = np.array(points).T
            value, low, high = map(in_words, (limit.value.value, limit.value.low, limit.value.high))
            interval = f"{before.format(band=q.band)} {value} [{low} to {high}]"
            text += f" Simulated: {100 * power:g} % are detected {interval}."
    return ChartData(text, series)


def _reach(x: Float, y: Float, power: float, band: str) -> str:
    """Return the words for the faintest magnitude at which a probability is reached."""
    detected = np.nonzero(y >= power)[0]
    if not detected.size:
        return f"at no magnitude from {MAGNITUDES[0]:g} to {MAGNITUDES[1]:g}."
    last = int(detected[-1])
    if last == x.size - 1:
        return f"at least to {band} = {MAGNITUDES[1]:g}."
    fraction = (y[last] - power) / (y[last] - y[last + 1])
    return f"to {band} = {x[last] + fraction * (x[last + 1] - x[last]):.2f}, in closed form."


def _draw_map(canvas: Canvas, source: ColumnDataSource) -> None:
    plot, mapper = canvas.plot, canvas.share_colours("detected")
    image = plot.image("image", "x", "y", "dw", "dh", source=source, color_mapper=mapper)
    shown = [("detected", "@image{0.000}"), ("magnitude", "$x{0.00}"), ("amplitude", "@percent{0.[00]} %")]
    plot.add_tools(HoverTool(renderers=[image], tooltips=shown))
    plot.yaxis.ticker = FixedTicker(ticks=[-1, 0, 1, 2])
    plot.yaxis.major_label_overrides = {-1: "0.1 %", 0: "1 %", 1: "10 %", 2: "100 %"}


def _draw_cells(canvas: Canvas, source: ColumnDataSource) -> None:
    colour = {"field": "p", "transform": LinearColorMapper(palette="Cividis256", low=0, high=1)}
    cells = canvas.plot.scatter("x", "y", source=source, size=10, marker="square", fill_color=colour,
                                line_color="#ffffff")  # fmt: skip
    cells.name = "simulated"


def _draw_labels(canvas: Canvas, source: ColumnDataSource) -> None:
    canvas.plot.text(
        "x", "y", "text", source=source, text_align="center", text_baseline="middle",
        text_font={"value": "system-ui"}, text_font_size="11px", text_color="#1b2733", level="annotation",
        background_fill_color="#ffffff", background_fill_alpha=0.85, padding=2,
    ).name = "labels"  # fmt: skip


@Chart(
    "map", "How faint a star, how small a flare", PlotAxis("magnitude", limits=MAGNITUDES),
    PlotAxis("flare amplitude", limits=tuple(np.log10(PERCENTS))),
    (
        Custom("map", columns=("image", "percent", "x", "y", "dw", "dh"), draw=_draw_map),
        chart.Contours("contours", "#ffffff", width=1.2, listed=False),
        chart.Contours("half", "#ffffff", width=2.2, listed=False),
        Custom("simulated", columns=("x", "y", "p"), draw=_draw_cells),
        Custom("labels", columns=("x", "y", "text"), draw=_draw_labels),
        chart.LegendEntry("10, 50 (bold) and 90 % in closed form", "#b8c0c8"),
        chart.LegendEntry("simulated", "#8a8678", show="if any", form="dot", name="entry"),
        OwnMarker(),
    ),
    sets="magnitude=x,amplitude_percent=10^y", pins="half", alike=("band",),
).data()  # fmt: skip
def detection_map(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the detection probability over magnitude and amplitude."""
    q = closed.question
    series: dict[str, Any] = {"own": ([q.magnitude], [np.log10(q.amplitude_percent)])}
    text = f"The closed form of {q.statistic} takes too long for a map: simulate it."
    if not closed.slow:
        x, y, p = _cached(_map, closed)
        series |= _map_series(x, y, p)
        share = 100 * float(np.mean(p >= 0.5))
        text = (
            f"At least half of the flares are detected in {share:.0f} % of the map, which spans {q.band} = "
            f"{MAGNITUDES[0]:g} to {MAGNITUDES[1]:g} and amplitudes of {PERCENTS[0]:g} to {PERCENTS[1]:g} %."
        )
    if "map" in answers:
        simulated = answers["map"]
        at_x, at_y = np.meshgrid(np.array(simulated.x, float), np.log10(100 * np.array(simulated.y, float)))
        series["simulated"] = at_x.ravel(), at_y.ravel(), simulated.probability[0].ravel()
        text += f" {at_x.size} cells are simulated."
    return ChartData(text, series)


def _map_series(x: Float, y: Float, p: Float) -> dict[str, Any]:
    """Return the data of a map, of its contours, and of their labels, which stand at different parts of the lines."""
    half_x, half_y = 0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0])
    wide, high = x[-1] - x[0] + 2 * half_x, y[-1] - y[0] + 2 * half_y
    percent = np.repeat(10 ** y[:, None], x.size, axis=1)
    generator, labels = contour_generator(x, y, p), []
    lines: dict[float, list[Any]] = {level: list(generator.lines(level)) for level in LABELLED}
    for level, position in LABELLED.items():
        if lines[level]:
            longest = max(lines[level], key=len)
            point = longest[np.argsort(longest[:, 0])][int(position * (len(longest) - 1))]
            labels.append((float(point[0]), float(point[1]), f"{100 * level:g} %"))

    def columns(*levels: float) -> list[list[list[float]]]:
        contours = [line for level in levels for line in lines[level]]
        return [[line[:, axis].tolist() for line in contours] for axis in (0, 1)]

    return {
        "map": ([p], [percent], [x[0] - half_x], [y[0] - half_y], [wide], [high]),
        "contours": columns(0.1, 0.9),
        "half": columns(0.5),
        "labels": tuple(zip(*labels, strict=True)) or ([], [], []),
    }


LIMIT = Tab(
    verb="limit",
    title="Limit and map",
    about="How faint a star and how small a flare one would still see.",
    pictures=(curve, detection_map),
    simulations={"limit": "Simulate the limit", "map": "Simulate the map"},
    files={"limit": "limit", "map": "map"},
)


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
def expected(closed: ClosedForms) -> dict[str, ExpectedMeasurement]:
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
    percent, factors, series = 100 * closed.case.study.flare.amplitudes[0], FACTORS[::3], dict[str, Any]()
    for name, measurement in zip(NAMES, expected(closed).values(), strict=True):
        ahead = measurement.forecasts(factors, measurement.unknown)
        series[name] = percent * factors, [100 * f.errors[0] / f.values[0] for f in ahead]
    all_known, *_, free = expected(closed).values()
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
    all_known, *_, free = expected(closed).values()
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
        two = not isinstance(next(iter(expected(closed).values())).fitted, FlareModel)
        words.append(f"{x.size} bins of frames{', each fitted with one temperature' if two else ''}")
    return ChartData(f"One simulated stare: {'; '.join(words)}.", series)


def measured(closed: ClosedForms, answers: Answers) -> View:
    """Return the errors of each quantity, and the counts of simulated fits."""
    measurements = expected(closed)
    first, *_ = measurements.values()
    errors = [measurement.ahead.errors for measurement in measurements.values()]
    rows = zip(first.ahead.names, first.ahead.units, first.truth, *errors, strict=True)
    table = [dict(zip(("quantity", "unit", "truth", *measurements), row, strict=True)) for row in rows]
    verb = {column.name: column for column in COLUMNS}
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
