"""Tabs of exposures: spectra, signals, noise, detection of the flare and its limits, and unknowns of the instrument."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from bokeh.models import FixedTicker, HoverTool, LinearColorMapper
from contourpy import contour_generator
from scipy import special
from scipy.interpolate import PchipInterpolator

from mauvecl.answers.closed_forms import UNKNOWN_COLUMNS as COLUMNS
from mauvecl.answers.closed_forms import Cost, power, spoken, unknown_cost
from mauvecl.answers.signal import simulate
from mauvecl.charts import chart
from mauvecl.charts.chart import WAVELENGTH, Area, Bars, Chart, ChartData, Dots, Line, OwnMarker, PlotAxis, Rule
from mauvecl.charts.detection import BUDGET, budget_series, roc_columns
from mauvecl.detection.requests import statistic_label
from mauvecl.host.arrays import Float
from mauvecl.noise.unknowns import NUISANCES
from mauvecl.schema.columns import View, chance_text, stacked, with_error
from mauvecl.study.cases import star_column
from mauvecl.study.observation import NuisanceChoice
from mauvecl.web.closed_forms import LIMITS, Answers, short
from mauvecl.web.tab import SATURATED, Tab, strips
from mauvecl.web.uploads import RESULTS

if TYPE_CHECKING:
    from bokeh.models.sources import ColumnDataSource

    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.tab import Canvas

T = TypeVar("T")


@BUDGET.data()
def budget(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the noise of a pixel by origin."""
    series = budget_series(closed.quiet)
    powers = {line: float(np.nansum(series[line.key][1] ** 2)) for line in BUDGET.series[1:] if line.key in series}
    largest = max(powers, key=lambda line: powers[line])
    share = 100 * powers[largest] / (sum(powers.values()) or 1.0)
    return ChartData(f"Most of the noise's power comes from {largest.called}: {share:.0f} % over all pixels.", series)


NOISE = Tab(
    name="noise",
    title="Noise",
    about="Where the noise comes from, pixel by pixel, without a flare; for pinned scenarios, the photons of the star.",
    pictures=(budget,),
    questions=("snr",),
    files={"noise-budget": None},
    # The closed-form table of `mauvecl snr`.
    own_table=lambda closed, answers: stacked(
        [star_column()],
        [({"star": closed.case.label}, closed.quiet.noise_budget())],
        realisations=closed.study.run.realisations,
        study=closed.study.ideal().text(),
    ),
)


@Chart(
    "snr", "Signal to noise without a flare", WAVELENGTH, PlotAxis("S/N"),
    (
        Area("95 % of realisations, per element", name="spread", alpha=0.4),
        SATURATED,
        Line("per pixel", "sky", "pixel", tips=("S/N per pixel",)),
        Line("per resolution element", "star", "element", width=2, tips=("wavelength (nm)", "S/N per element")),
    ),
    logs=("y",), pins="element",
).data()  # fmt: skip
def signal_to_noise(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the closed form of the S/N per pixel and element, and the spread of realisations."""
    x = closed.quiet
    pixel, element = x.snr(), x.snr_per_element()
    series: dict[str, Any] = {
        "pixel": (x.wavelength_nm, pixel),
        "element": (x.element_wavelength_nm, element),
        "saturated": strips(x.wavelength_nm, x.saturated),
    }
    if "snr" in answers:
        table = answers["snr"].element
        series["spread"] = table["wavelength"].to_value("nm"), np.asarray(table["q2.5"]), np.asarray(table["q97.5"])
    best = int(np.argmax(element))
    text = (
        f"The S/N is at most {pixel.max():.3g} a pixel, and {element.max():.3g} a resolution element, at "
        f"{x.element_wavelength_nm[best]:.0f} nm."
    )
    return ChartData(text, series)


SIGNAL = Tab(
    name="snr",
    title="S/N",
    about="How well the star itself is measured, wavelength by wavelength.",
    pictures=(signal_to_noise,),
    simulations={"detection": "Simulate"},
    questions=("snr",),
    files={"snr": "detection"},
    own_table=lambda closed, answers: answers["snr"].element,
)


@Chart(
    "recorded", "One exposure, less bias and dark", WAVELENGTH, PlotAxis("DN in the exposure"),
    (
        Area("95 % of draws with the flare", "flare", "spread"),
        SATURATED,
        Line("drawn exposure", name="drawn", width=1),
        Line("sky", "sky"),
        Line("dark", "dark", show="pedestals"),
        Line("bias", "bias", show="pedestals"),
        Line("star", "star", width=2, tips=("wavelength (nm)", "star (DN)")),
        Line("star with flare", "flare", "flare", width=2, tips=("with flare (DN)",)),
    ),
    logs=("y",), pins="flare", shows={"pedestals": "Bias and dark"},
).data()  # fmt: skip
def recorded(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return one exposure with the flare and its components, without pedestals."""
    x, y = closed.quiet, closed.flare
    w, gain = x.wavelength_nm, x.n_frames * x.gain_dn_per_electron
    sky, spread = gain * x.sky_electrons, 1.96 * np.sqrt(y.variance_dn2)
    behind = sky + gain * x.neighbour_electrons
    star, flare = gain * x.source_electrons + behind, gain * y.source_electrons + behind
    pedestal = x.n_frames * (x.dark_dn + x.bias_dn)
    mean = y.recorded_dn - pedestal
    series: dict[str, Any] = {
        "star": (w, star),
        "flare": (w, flare),
        "sky": (w, sky),
        "dark": (w, x.n_frames * x.dark_dn),
        "bias": (w, x.n_frames * x.bias_dn),
        "spread": (w, mean - spread, mean + spread),
        "saturated": strips(w, x.saturated | y.saturated),
    }
    if "draw" in answers:
        series["drawn"] = w, answers["draw"] - pedestal
    peak = int(np.argmax(flare))
    text = (
        f"Star and sky give up to {short(star.max())} DN in the exposure, with the flare {short(flare.max())} DN "
        f"at {w[peak]:.0f} nm; 95 % of draws lie within ±{short(spread[peak])} DN there."
    )
    return ChartData(text, series)


@Chart(
    "telescope", "Spectrum at the telescope", WAVELENGTH, PlotAxis("flux (erg / s / cm² / Å)"),
    (
        Line("star with flare", "flare", "flare", tips=("with flare",)),
        Line("star", "star", tips=("wavelength (nm)", "star")),
    ),
    logs=("Y",), pins="flare",
).data()  # fmt: skip
def telescope(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the star's spectrum at the telescope, without and with the flare."""
    star, flare = closed.case.source, closed.case.flaring(closed.case.amplitudes[0])
    # A jump or line of the flare adds wavelengths.
    nm = flare.wavelength_nm[(flare.wavelength_nm >= 190) & (flare.wavelength_nm <= 710)]
    light = [np.interp(nm, source.wavelength_nm, source.flux_flam) for source in (star, flare)]
    # Logarithmic axes cannot show zeros.
    quiet, flaring = (np.where(flux > 0, flux, np.nan) for flux in light)
    rise = np.nanmax(flaring / quiet)
    text = f"The flare multiplies the star's light by up to {short(rise)} between 190 and 710 nm."
    return ChartData(text, {"star": (nm, quiet), "flare": (nm, flaring)})


SPECTRUM = Tab(
    name="spectrum",
    title="Spectrum",
    about="What the detector records, and the light that comes to the telescope.",
    pictures=(recorded, telescope),
    questions=("simulate",),
    files={"observation": None},
    # One observation with the flare and its components.
    own_table=lambda closed, answers: simulate(closed.study, flaring=True).observations[1][2],
)


@Chart(
    "excess", "Flare minus quiet, in sigma of the noise", WAVELENGTH, PlotAxis("sigma of the noise"),
    (
        Area("95 % of the noise", name="noise", alpha=0.16),
        SATURATED,
        Dots("drawn exposure", name="drawn"),
        Line("expected per pixel", "sky", "pixel", width=1.2),
        Line("expected per element", "flare", "element", step=True, width=2.2,
             tips=("wavelength (nm)", "sigma per element")),
    ),
    pins="element",
).data()  # fmt: skip
def excess(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the flare minus quiet in standard deviations of the noise."""
    x, saturated = closed.quiet, closed.quiet.saturated | closed.flare.saturated
    rise = np.where(x.saturated, 0.0, closed.flare.signal_dn - x.signal_dn)
    noise = np.sqrt(x.per_element(np.where(x.saturated, 0.0, x.variance_dn2)))
    element = np.divide(x.per_element(rise), noise, out=np.zeros(noise.size), where=noise > 0)
    series: dict[str, Any] = {
        "pixel": (x.wavelength_nm, rise / np.sqrt(x.variance_dn2)),
        "element": (x.element_wavelength_nm, element),
        "noise": ([190.0, 710.0], [-1.96] * 2, [1.96] * 2),
        "saturated": strips(x.wavelength_nm, saturated),
    }
    drawn = ""
    if "draw" in answers:
        raw = np.where(saturated, 0.0, answers["draw"] - x.recorded_dn)
        if unknown := closed.case.unknowns(x):
            variance, flare_dn = np.where(saturated, np.inf, x.variance_dn2), closed.flare.recorded_dn - x.recorded_dn
            raw = np.where(saturated, 0.0, raw - unknown.fitted_dn(raw, variance, flare_dn))
            drawn = " The drawn exposure is shown less the levels of what is unknown, fitted to it."
        shown = np.divide(x.per_element(raw), noise, out=np.full(noise.size, np.nan), where=noise > 0)
        series["drawn"] = x.element_wavelength_nm, shown
    best, lost = int(np.argmax(element)), int(np.count_nonzero(saturated))
    text = (
        f"The flare stands out most at {x.element_wavelength_nm[best]:.0f} nm, by {element[best]:.3g} sigma of an "
        f"element's noise; {np.count_nonzero(element > 1.96)} of {element.size} elements rise above 95 % of the noise."
    )
    return ChartData(text + drawn + (f" {lost} pixels saturate." if lost else ""), series)


@Chart(
    "distributions", "The statistic without and with the flare", PlotAxis("statistic"),
    PlotAxis("density, each peak = 1", limits=(0, 1.06), log_limits=(1e-4, 1.5)),
    (
        Bars("simulated", "star", "null bars", listed=False),
        Bars("simulated", "flare", "flare bars", listed=False),
        chart.LegendEntry("simulated", form="bars", show="if any"),
        Area("no flare", "star", "null area", alpha=0.18, listed=False),
        Line("no flare", "star", "null", width=2, tips=("statistic", "density")),
        Area("flare", "flare", "flare area", alpha=0.18, listed=False),
        Line("flare", "flare", width=2, tips=("statistic", "density")),
        Rule("threshold", "threshold"),
    ),
    logs=("y",), pins="flare", alike=("statistic",),
).data()  # fmt: skip
def distributions(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the distributions of the statistic without and with the flare, and the threshold."""
    q, threshold, chance = closed.question, closed.odds.threshold, closed.chance
    series, (null, flaring) = dict[str, Any](), closed.forms
    for name, form in (("null", null), ("flare", flaring)):
        edges = np.linspace(form.mean - 5 * form.std, form.mean + 5 * form.std, 161)
        beyond = form.sf(edges)
        density = np.maximum(beyond[:-1] - beyond[1:], 0.0)
        density = density / density.max()
        middle = (edges[1:] + edges[:-1]) / 2
        series |= {name: (middle, density), f"{name} area": (middle, np.full(middle.size, 1e-9), density)}
    if "detection" in answers:
        (star,) = answers["detection"].stars
        for name, flare in (("null bars", None), ("flare bars", 0)):
            edges, counts = star.detection.histogram(q.statistic, flare, bins=80)
            series[name] = edges[:-1], edges[1:], counts / max(counts.max(), 1)
        (row,) = (row for row in answers["detection"].table if row["statistic"] == q.statistic)
        threshold, chance = float(row["threshold"]), float(row["probability"])
    series["threshold"] = threshold if threshold == threshold else None
    share = f"{chance_text(chance)} of flares lie above the threshold of {threshold:.4g}"
    text = (
        f"Without a flare {q.statistic} lies at {with_error(null.mean, null.std)}, with it at "
        f"{with_error(flaring.mean, flaring.std)}; "
        f"{share if threshold == threshold else 'no threshold has this false-alarm probability'}."
    )
    return ChartData(text, series, {"x axis": {"axis_label": statistic_label(q.statistic)}})


@Chart(
    "roc", "Receiver operating characteristic",
    PlotAxis("false-alarm probability per test", log=True, limits=(1e-6, 1)),
    PlotAxis("detection probability", limits=(-0.02, 1.03)),
    (
        Area("simulated, 95 %", name="simulated", alpha=0.4),
        Line("closed form", "flare", width=2, tips=("false-alarm probability", "detection probability")),
        OwnMarker(),
    ),
    sets="fap=x", pins="closed form",
).data()  # fmt: skip
def trade(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the detection probability against the false-alarm probability."""
    q, (null, flaring) = closed.question, closed.forms
    faps = np.logspace(-6, 0, 121)[:-1]
    chances = flaring.sf(null.isf(faps))
    series: dict[str, Any] = {"closed form": (faps, chances), "own": ([q.fap], [closed.chance])}
    if "detection" in answers:
        fap, _, *ends = roc_columns(answers["detection"].stars[0].detection.roc(q.statistic))
        series["simulated"] = fap, *ends
    half = int(np.searchsorted(chances, 0.5))
    where = "half of them at " if half else "half of them still below "
    text = (
        f"At a false-alarm probability of {q.fap:g} {chance_text(closed.chance)} are detected; {where}"
        f"{faps[min(half, faps.size - 1)]:.2g}."
    )
    return ChartData(text, series)


DETECTION = Tab(
    name="detection",
    title="Detection",
    about="The flare relative to the noise, and the statistic with and without the flare.",
    pictures=(excess, distributions, trade),
    simulations={"detection": "Simulate"},
    answer="detection",
    files={"detection": "detection", "roc": "detection"},
)


@lru_cache(maxsize=4)
def costs(closed: ClosedForms) -> list[Cost]:
    """Return the flare's matched S/N with unknowns, alone and together."""
    # Without a sky its brightness is no unknown. Those without a default prior are projected out.
    choices = {}
    for name, row in NUISANCES.items():
        if np.any(row.spectrum(closed.quiet)):
            spread = "free" if row.sd is None or np.isinf(row.sd) else row.sd
            choice = NuisanceChoice.model_validate({"usual": False, name: spread})
            choices[spoken(choice).removeprefix("the ")] = choice
    choices["all the usual together"] = NuisanceChoice()
    if closed.study.nuisances.own:
        choices["your own spectrum"] = NuisanceChoice(usual=False, own=closed.study.nuisances.own)
    flare, comparison = closed.flare, closed.study.run.comparison()
    return [unknown_cost(name, closed.quiet, flare, choice, comparison) for name, choice in choices.items()]


def _bars(canvas: Canvas, source: ColumnDataSource) -> None:
    for column, label, colour, width, alpha, form in (
        ("known", "everything known", "flare", 0.85, 0.35, "band"),
        ("marginal", "marginalised over it", "flare", 0.55, 1.0, "bar"),
        ("plain", "unknown, and not looked for", "text", 0.2, 1.0, "bar"),
    ):
        style: dict[str, Any] = {"color": canvas.ink[colour], "alpha": alpha, "name": label}
        bars = canvas.plot.hbar("name", right=column, height=width, source=source, **style)
        canvas.legend.append((label, canvas.ink[colour], form, ""))
        canvas.tooltips(bars, (label, column), along="hline")
    canvas.plot.x_range.start = 0


@Chart(
    "cost", "What each unknown costs: the flare's S/N by the matched statistic", PlotAxis("S/N of the flare"),
    PlotAxis(kind="names"), (chart.Custom("bars", columns=("name", "plain", "marginal", "known"), draw=_bars),),
).data()  # fmt: skip
def unknown_costs(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the matched S/N with each unknown, plain and marginalised."""
    rows = costs(closed)
    bars = zip(*((row.of, row.plain, row.marginal, row.known) for row in rows[::-1]), strict=True)
    worst = min(rows, key=lambda row: row.marginal)
    text = (
        f"With everything known the flare has a matched S/N of {worst.known:.3g}; {worst.of} leaves "
        f"{worst.marginal:.3g} of it, the least of these."
    )
    return ChartData(text, {"bars": tuple(bars)}, {"y range": {"factors": [row.of for row in rows[::-1]]}})


def table_of_costs(closed: ClosedForms, answers: Answers) -> View:
    """Return the S/N of the flare with each unknown, and the chance to detect it."""
    rows, fap = costs(closed), closed.question.fap
    without = Cost("nothing: everything is known", *[rows[0].known] * 3)
    cells = [(row.of, row.plain, row.marginal, float(power(row.marginal, fap))) for row in (without, *rows)]
    names = ("unknown", "plain", "marginalised", "detected")
    table = [dict(zip(names, row, strict=True)) for row in cells]
    return View("", [column for column in COLUMNS if column.name in names], table)


UNKNOWN = Tab(
    name="unknowns",
    title="Unknowns",
    about="What it costs not to know the detector's temperature, the light lost, or the sky: a statistic that is blind "
    "to them sees less of the flare; one that ignores them is fooled by them.",
    pictures=(unknown_costs,),
    own_view=table_of_costs,
)


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
    """Return magnitudes and probabilities of detection, shape (241,), interpolated between points of the closed form.

    There are more of these points where the probability changes.
    """

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
    q, power = closed.question, closed.study.limit.power
    series: dict[str, Any] = {"own": ([q.magnitude], [closed.chance]), "power": power}
    text = f"The closed form of {q.statistic} takes too long for a curve: simulate it."
    if not closed.slow:
        x, y = series["closed form"] = _cached(_curve, closed, q.amplitude_percent)
        text = f"{100 * power:g} % of such flares are detected {_reach(x, y, power, q.band)}"
    if "limit" in answers:
        before, in_words, *_ = LIMITS[closed.study.limit.of]
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
        chart.Custom("map", columns=("image", "percent", "x", "y", "dw", "dh"), draw=_draw_map),
        chart.Contours("contours", "#ffffff", width=1.2, listed=False),
        chart.Contours("half", "#ffffff", width=2.2, listed=False),
        chart.Custom("simulated", columns=("x", "y", "p"), draw=_draw_cells),
        chart.Custom("labels", columns=("x", "y", "text"), draw=_draw_labels),
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
