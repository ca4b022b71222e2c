"""Tabs of exposures: spectra, signals, noise, detection of the flare, and unknowns of the instrument."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.closed_forms import Cost, spoken, unknown_cost
from mauvecl.answers.detect import UNKNOWN_COLUMNS as COLUMNS
from mauvecl.answers.detect import power
from mauvecl.answers.signal import simulate
from mauvecl.charts import chart
from mauvecl.charts.chart import WAVELENGTH, Area, Bars, Chart, ChartData, Dots, Line, OwnMarker, PlotAxis, Rule
from mauvecl.charts.detection import BUDGET, budget_series, roc_columns
from mauvecl.detection.requests import statistic_label
from mauvecl.noise.unknowns import NUISANCES
from mauvecl.schema.columns import View, chance_text, stacked, with_error
from mauvecl.study.cases import star_column, star_label
from mauvecl.study.observation import NuisanceChoice
from mauvecl.web.closed_forms import Answers, short
from mauvecl.web.tab import SATURATED, Tab, strips

if TYPE_CHECKING:
    from bokeh.models.sources import ColumnDataSource

    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.tab import Canvas


@BUDGET.data()
def budget(closed: ClosedForms, answers: Answers) -> ChartData:
    """Return the noise of a pixel by origin."""
    series = budget_series(closed.quiet)
    power = {line: float(np.nansum(series[line.key][1] ** 2)) for line in BUDGET.series[1:] if line.key in series}
    largest = max(power, key=lambda line: power[line])
    share = 100 * power[largest] / (sum(power.values()) or 1.0)
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
        [({"star": star_label(closed.case.study.star[0], closed.quiet)}, closed.quiet.noise_budget())],
        realisations=closed.case.study.run.realisations,
        study=closed.case.study.ideal().text(),
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
    own_table=lambda closed, answers: simulate(closed.case.study, flaring=True).observations[1][2],
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
    if closed.case.study.nuisances.own:
        choices["your own spectrum"] = NuisanceChoice(usual=False, own=closed.case.study.nuisances.own)
    flare, comparison = closed.flare, closed.case.study.run.comparison()
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
