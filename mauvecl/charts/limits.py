"""Charts for planning: maps, limits, noise budgets, S/N over a sweep, exposures, and errors of measured flares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.charts import matplotlib as figures
from mauvecl.charts.chart import WAVELENGTH, Axis, Chart, Dots, Levels, Line, Mesh, Panel, Picture, Rule, Series, Strips
from mauvecl.charts.matplotlib import COLOURS, picture_of
from mauvecl.detection.requests import statistic_label
from mauvecl.schema.columns import First, note_of
from mauvecl.study.cases import full_label
from mauvecl.study.questions import QUANTITIES

if TYPE_CHECKING:
    from mauvecl.answers.gaussian import GaussianAnswer
    from mauvecl.answers.limit import LimitAnswer
    from mauvecl.answers.map import MapAnswer
    from mauvecl.answers.measure import JointFit, MeasureAnswer, MeasuredFlare, MeasuredStare
    from mauvecl.answers.signal import ExposureAnswer, SnrAnswer
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.study import Study


MARKS = "osD^vPX"


def quantity_axis(study: Study, name: str, **how: Any) -> Axis:
    """Return the axis of a quantity, with the band of magnitudes if all stars have the same."""
    bands = {star.band for star in study.star}
    band = f" ({bands.pop()})" if name == "magnitude" and len(bands) == 1 else ""
    return Axis(QUANTITIES[name].label + band, **how)


@picture_of("MapAnswer", "map")
def detection_map(answer: MapAnswer) -> Picture:
    """Plot the detection probability over two quantities, one panel per statistic."""
    question, study, places, axes = answer.study.map, answer.study, list[Any](), list[Axis]()
    for sweep, values in zip(question.axes, (answer.x, answer.y), strict=True):
        named = isinstance(values[0], str)
        places.append(np.arange(len(values)) if named else np.array(values, float))
        ticks = (places[-1], values) if named else None
        axes.append(quantity_axis(study, sweep.quantity, log=sweep.log and not named, ticks=ticks))
    (x, y), (x_axis, y_axis) = places, axes
    contoured, row = bool(question.contours) and min(x.size, y.size) > 1, []
    for statistic, p in zip(answer.statistics, answer.probability, strict=True):
        series: list[Series] = [Mesh("detection probability", at=(x, y, p))]
        if contoured:
            series.append(Levels("detected", levels=tuple(question.contours), at=(x, y, p)))
        title = statistic_label(statistic).partition(" (")[0]
        row.append(Panel(x_axis, y_axis, series, title))
    names = {axis.quantity for axis in question.axes}
    exposure = "" if "exposure" in names else f", {study.observation.exposure_s:g} s"
    flare = "" if "amplitude" in names else f", flare of {100 * study.flare.amplitudes[0]:g} %"
    title = f"{answer.star}{exposure}{flare}, false-alarm probability {study.run.fap:g} per test; nominal throughput"
    empty = "grey: no answer" if np.isnan(answer.probability).any() else ""
    return Picture([row], (figures.COLUMN * len(row) + 0.5, 3.4), title, (empty,), below=contoured, share_y=True)


@picture_of("LimitAnswer", "limit")
def limits(answer: LimitAnswer) -> Picture:
    """Plot the detection probability at every simulated value, and the limits."""
    of, power = answer.study.limit.of, answer.study.limit.power
    series, several = list[Series](), len({limit.statistic for limit in answer.limits}) > 1
    for k, limit in enumerate(answer.limits):
        colour, marker = COLOURS[k % len(COLOURS)], MARKS[k // len(COLOURS) % len(MARKS)]
        points = sorted((*limit.points, limit.check), key=lambda p: p.value)
        p, low, high = np.array([(q.value, q.low, q.high) for q in (point.probability for point in points)]).T
        flare = "" if np.isnan(limit.amplitude) else f", flare {100 * limit.amplitude:g} %"
        statistic = f", {limit.statistic}" if several else ""
        value = f"{limit.value.value:.2f}" if of == "magnitude" else figures.written(float(f"{limit.value.value:.3g}"))
        text = f"{limit.label}{flare}{statistic}: {value}{QUANTITIES[of].suffix}"
        at = [point.value for point in points], p, (p - low, high - p)
        series += [
            Dots(text, colour, marker=marker, size=6, at=at),
            Line("", colour, width=1.2, at=tuple(zip(*sorted(limit.curve), strict=True))),
            Strips("", colour, alpha=0.25, at=([limit.value.low], [limit.value.high])),
        ]
    series.append(Rule(colour="text", along="y", at=power))
    exposure = "" if of == "exposure" else f", {answer.study.observation.exposure_s:g}{figures.UNBROKEN}s"
    title = (
        f"Limits at a detection probability of {power:g}{exposure}, false-alarm probability "
        f"{answer.study.run.fap:g} per test; points: simulated, 95 %; lines: Gaussian noise; nominal throughput"
    )
    x, y = quantity_axis(answer.study, of, log=of != "magnitude"), Axis("detection probability", limits=(-0.02, 1.02))
    return Picture([[Panel(x, y, series)]], (figures.COLUMN, 3.0 + 0.17 * len(answer.limits)), title, below=True)


#: Panels of noise budgets in a picture.
MOST_BUDGETS = 12
#: Noise by origin, as on the page and in files.
BUDGET = Chart(
    "budget", "Noise of a pixel by origin", WAVELENGTH, Axis("noise (DN rms per pixel)", log=True),
    (
        # A broad pale line below the others does not hide the largest of them.
        Line("all together", "total", "total", width=6, alpha=0.25, tips=("wavelength (nm)", "all together (DN)")),
        Line("photons of the star", "star", "source_photon", width=2, tips=("photons of the star (DN)",)),
        Line("photons of neighbours", "flare", "neighbour_photon", "if any", width=2,
             tips=("photons of neighbours (DN)",)),
        Line("photons of the sky", "sky", "zodiacal_photon", width=2, tips=("photons of the sky (DN)",)),
        Line("dark current", "dark", "dark", width=2, dash="dashed", tips=("dark current (DN)",)),
        Line("read noise", "read", "read", width=2, dash="dotted", tips=("read noise (DN)",)),
    ),
    logs=("Y",), pins="source_photon",
)  # fmt: skip


def budget_series(x: Expectation) -> dict[str, Any]:
    """Return the data of `BUDGET`; logarithms show nothing of zero."""
    table = x.noise_budget()
    values = {name: np.asarray(table[name].value) for name in table.colnames if name != "wavelength"}
    return {name: (x.wavelength_nm, np.where(v > 0, v, np.nan)) for name, v in values.items()}


@picture_of("SnrAnswer", "noise-budget")
def noise_budgets(answer: SnrAnswer) -> Picture:
    """Plot pixel noise by origin against wavelength, one panel per star and cell, as in the paper."""
    each, observed = answer.study.sweep.size, list[tuple[str, Any]]()
    for star in answer.stars:
        x = star.result.expectation
        observed.append((star.title if star.at else f"{star.title}, {x.exposure_s:g} s", x))

    def finish(axis: Any) -> None:
        # Zodiacal light can be far below everything else.
        axis.set_ylim(bottom=max(axis.get_ylim()[0], axis.get_ylim()[1] * 1e-4))

    shown = First(observed, MOST_BUDGETS, "observations")
    panels = [replace(BUDGET.panel(budget_series(x), title), finish=finish) for title, x in shown]
    # A column for each cell, unless these are too many.
    across = len(observed) // each if each <= figures.MAX_COLUMNS and len(shown) == len(observed) else 0
    rows = [panels[k::across] for k in range(across)] or figures.in_rows(panels, figures.MAX_COLUMNS)
    size = figures.COLUMN * max(len(row) for row in rows), 2.3 * len(rows) + 0.7
    title = "Noise budgets; nominal throughput, not a flight calibration"
    return Picture(rows, size, title, (shown.note,), below=True, share_x=True, share_y="col" if across else True)


@picture_of("SnrAnswer", "snr-sweep", when=lambda answer: answer.study.sweep.axes)
def snr_sweep(answer: SnrAnswer) -> Picture:
    """Plot the S/N of some elements against the first swept quantity, a line per value of the others."""
    from mauvecl.answers.signal import place_of

    first, row = answer.study.sweep.axes[0].quantity, []
    for wavelength in answer.stars[0].shown_nm:
        lines: dict[str, list[Any]] = {}
        for star in answer.stars:
            name = star.label if first != "magnitude" else star.label.split(" V = ")[0]
            rest = full_label(name, {k: v for k, v in star.at.items() if k != first})
            element = star.result.element[place_of(star.result.expectation, wavelength, "element")]
            ends = (max(element[q], 1e-3) for q in ("q2.5", "q97.5"))
            lines.setdefault(rest, []).append((star.at[first], element["expected"], *ends))
        series: list[Series] = []
        for (name, points), colour in zip(lines.items(), cycle(COLOURS), strict=False):
            x, expected, low, high = zip(*points, strict=True)
            lengths = np.maximum(np.subtract(expected, low), 0), np.maximum(np.subtract(high, expected), 0)
            series += [Line(name, colour, at=(x, expected)), Dots("", colour, size=7, at=(x, expected, lengths))]
        y_axis = Axis("S/N per 10.5 nm element", log=True, limits=(0.1, None))
        x_axis = quantity_axis(answer.study, first, log=first == "exposure")
        row.append(Panel(x_axis, y_axis, series, f"{wavelength:g} nm"))
    title = "S/N in closed form; bars: 95 % of realisations; nominal throughput"
    return Picture([row], (figures.COLUMN if len(row) == 1 else 2.6 * len(row), 3.2), title, below=True, share_y=True)


@picture_of("GaussianAnswer", "gaussian")
def gaussian(answer: GaussianAnswer) -> Picture:
    """Plot how well each prediction of the Gaussian formula holds in every cell."""
    from matplotlib.ticker import MaxNLocator

    cells, labels = answer.cells, [full_label(s.label, s.at) for s in answer.signal.stars]
    rows = np.arange(len(cells))

    def panel(text: str, predicted: float, least: float, series: Series) -> Panel:
        """Return a panel whose x axis reaches at least so far on both sides of the prediction."""

        def finish(axis: Any) -> None:
            low, high = axis.get_xlim()
            axis.set_xlim(min(low, predicted - 1.2 * least), max(high, predicted + 1.2 * least))
            axis.xaxis.set_major_locator(MaxNLocator(3, steps=(1, 2, 5, 10)))
            axis.grid(axis="y", linewidth=0.3)

        y = Axis(limits=(len(rows) - 0.5, -0.5), ticks=(rows, labels))
        return Panel(Axis(text), y, [series, Rule(dash="-", at=predicted)], finish=finish)

    def dots(name: str) -> Dots:
        return Dots("", "star", size=7, at=(np.asarray(cells[name]), rows))

    low, high = (np.asarray(cells[f"coverage_{end}"]) for end in ("low", "high"))
    coverage = Dots("", "star", marker="", width=5, at=((low + high) / 2, rows, 0 * low, (high - low) / 2))
    row = [
        panel("S/N: simulated\nless predicted", 0.0, 0.1, dots("snr_off_by")),
        panel("coverage of\n1-sigma intervals", 0.6827, 0.03, coverage),
        panel("5-sigma pixels\nover predicted", 1.0, 0.5, dots("five_sigma_above")),
        panel("false alarms\nover predicted", 1.0, 0.2, dots("fap_ratio")),
    ]
    title = "Simulation and root-of-N formula; vertical lines: as the formula predicts; nominal throughput"
    return Picture([row], (2 * figures.COLUMN, 0.22 * len(cells) + 1.5), title, share_y=True)


@picture_of("ExposureAnswer", "exposure")
def exposures(answer: ExposureAnswer) -> Picture:
    """Plot the S/N of each star against exposure."""
    first, series = answer.exposures[0], list[Series]()
    for e, colour in zip(answer.exposures, cycle(COLOURS), strict=False):
        x = np.geomspace(e.exposure_s / e.frames, 4 * e.exposure_s, 50)
        text = f"{e.star}: {figures.written(float(f'{e.exposure_s:.4g}'))} s"
        series.append(Line(text, colour, at=(x, e.snr * np.sqrt(x / e.exposure_s))))
        series.append(Dots("", colour, size=8, at=([e.exposure_s], [e.snr])))
    series.append(Rule(f"wanted S/N of {first.wanted:g}", along="y", at=first.wanted))
    per = "10.5 nm element" if first.per == "element" else first.per
    panel = Panel(Axis("exposure (s)", log=True), Axis(f"S/N per {per}", log=True), series)
    title = f"S/N at {first.wavelength_nm:g} nm against exposure; nominal throughput"
    return Picture([[panel]], (figures.COLUMN, 3.0 + 0.17 * len(answer.exposures)), title, below=True)


#: Increases of chi-squared that enclose 68 and 95 % in two dimensions.
RISES = {"68 %": 2.30, "95 %": 5.99}
#: Factors on the amplitude over which errors are plotted.
FACTORS = np.geomspace(0.1, 10.0, 25)
#: Half-widths before and after the peak of a flare that are plotted.
BEFORE, AFTER = 3.0, 15.0
#: Largest number of flares in a picture.
MOST_FLARES = 4
#: Number of fits from which histograms of pulls have narrow bins.
MANY_FITS = 1000


def _few(answer: MeasureAnswer) -> tuple[Any, ...]:
    """Return the first flares."""
    return (First(answer.flares, MOST_FLARES, "flares"),)


def _single(answer: MeasureAnswer) -> tuple[Any, ...]:
    """Return the first flares whose model has a single temperature."""
    return (First([flare for flare in answer.flares if flare.model != "two-temperatures"], MOST_FLARES, "flares"),)


@picture_of("MeasureAnswer", "fit", given=_few)
def fits(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot the first exposure minus unknowns with the fitted flare, and the residuals, with a column per fit."""
    from mauvecl.fits.flare_model import usable_variance

    above, below = list[Panel](), list[Panel]()
    for flare in flares:
        quiet, measurement = flare.quiet, flare.found
        mean, unknown = flare.fitted_dn()
        kelvin = " and ".join(f"{x:.0f} K" for x in np.atleast_1d(np.exp(measurement.log_k[0])))
        variance, used = usable_variance(quiet, mean, flare.skipped_nm)
        sums = [quiet.per_element(np.where(used, values, 0.0)) for values in (flare.frame - unknown, mean, variance)]
        # Resolution elements of which some pixels are not used are not shown.
        pixels = quiet.per_element(np.ones(used.size))
        whole = quiet.per_element(used.astype(np.float64)) == pixels
        data, fit, variance = (np.where(whole, values, np.nan) for values in sums)
        nm, noise = quiet.element_wavelength_nm, np.sqrt(variance)
        x = Axis("wavelength (nm)")
        # Elements differ in their number of pixels, means hardly.
        dots = Dots("exposure less star and fitted unknowns", size=4, at=(nm, data / pixels, noise / pixels))
        line = Line(f"fit: {kelvin}", "star", at=(nm, fit / pixels))
        above.append(Panel(x, Axis("mean of an element (DN per pixel)"), [dots, line], flare.name))
        residuals = Dots("", "star", size=4, at=(nm, (data - fit) / noise))
        below.append(Panel(x, Axis("residual / noise"), [residuals, Rule(along="y", dash="-", at=0.0)]))
    size = 3.6 * len(flares), 4.6
    return Picture([above, below], size, notes=(note_of(flares),), share_x=True, heights=(2, 1))


def _each(flares: Sequence[MeasuredFlare], panel: Callable[[MeasuredFlare], Panel]) -> Picture:
    """Return a picture with a panel per flare."""
    row = [panel(flare) for flare in flares]
    return Picture([row], (3.4 * len(flares), 3.6), notes=(note_of(flares),), below=True)


@picture_of("MeasureAnswer", "contours", given=_single, when=lambda answer: bool(_single(answer)[0]))
def contours(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot expected confidence regions of temperature and amplitude, with unknowns marginalised."""

    def panel(flare: MeasuredFlare) -> Panel:
        series: list[Series] = []
        for (share, rise), dash in zip(RISES.items(), ("-", "dashed"), strict=True):
            kelvin, low, high = flare.region(rise)
            around = np.concatenate([kelvin, kelvin[::-1], kelvin[:1]]), np.concatenate([low, high[::-1], low[:1]])
            series.append(Line(f"{share} of estimates", "star", dash=dash, at=around))
        series.append(Dots("estimate without noise", "flare", marker="+", size=14, at=flare.perfect.estimates[0, :2]))
        if np.isfinite(flare.truth[:2]).all():
            series.append(Dots("simulated flare", "text", marker="x", size=8, at=flare.truth[:2]))
        return Panel(Axis("flare temperature (K)"), Axis("flare amplitude"), series, flare.name)

    return _each(flares, panel)


@picture_of("MeasureAnswer", "pulls", given=_few)
def pulls(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot the pulls of estimates, (estimate - truth) / standard error, and the standard normal."""
    # Few fits need wide bins.
    most = max(len(flare.found.estimates) for flare in flares)
    x, edges = np.linspace(-5.0, 5.0, 201), np.linspace(-5.0, 5.0, 41 if most >= MANY_FITS else 21)

    def panel(flare: MeasuredFlare) -> Panel:
        series: list[Series] = []
        # Temperature, amplitude and the next one; an observed flare has only fluxes.
        for colour, q in zip(COLOURS, np.flatnonzero(np.isfinite(flare.truth))[:3], strict=False):
            with np.errstate(invalid="ignore", divide="ignore"):
                pull = (flare.found.estimates[:, q] - flare.truth[q]) / flare.found.errors[:, q]
            density, _ = np.histogram(np.clip(pull[np.isfinite(pull)], -5, 5), edges, density=True)
            series.append(Line(flare.found.names[q], colour, step=True, at=((edges[1:] + edges[:-1]) / 2, density)))
        normal = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
        series.append(Line("standard normal", "text", dash="dashed", at=(x, normal)))
        x_axis = Axis("(estimate \N{MINUS SIGN} truth) / standard error")
        return Panel(x_axis, Axis("probability density"), series, flare.name)

    return _each(flares, panel)


@picture_of("MeasureAnswer", "errors", given=_few)
def errors(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot forecast errors of temperature and amplitude against the amplitude, with and without unknowns."""

    def panel(flare: MeasuredFlare) -> Panel:
        amplitudes, series = FACTORS * flare.perfect.estimates[0, 1], list[Series]()
        for unknown, dash in {None: "dashed", flare.unknown: "-"}.items():
            ahead = flare.forecasts(FACTORS, unknown)
            whose = "everything else known" if unknown is None else "with unknowns"
            for colour, q in zip(COLOURS, range(2), strict=False):
                relative = [f.errors[q] / f.values[q] for f in ahead]
                series.append(Line(f"{flare.fitted.names[q]}, {whose}", colour, dash=dash, at=(amplitudes, relative)))
        x, y = Axis("flare amplitude", log=True), Axis("relative standard error", log=True)
        return Panel(x, y, series, flare.name)

    return _each(flares, panel)


@picture_of("MeasureAnswer", "temperatures", each=lambda answer: [(star,) for star in answer.stares if star.perfect])
def temperatures(star: MeasuredStare) -> Picture:
    """Plot temperature, size and light of the flares of a stare against time, with 95 % intervals.

    Lines are the fits to the same frames without noise.
    """
    drawn, perfect, rows = star.drawn, star.perfect, list[list[Panel]]()
    assert drawn is not None
    assert perfect is not None
    measurement = drawn.found
    sized = "area" in measurement.names
    size, light = ("area", "luminosity bolometric") if sized else ("amplitude", "flux bolometric")
    middle, reach = (drawn.start_s + drawn.end_s) / 2, (drawn.end_s - drawn.start_s) / 2
    for name in ("temperature", size, light):
        q = measurement.column(name)
        estimate, low, high = measurement.estimates[:, q], measurement.low[-1, :, q], measurement.high[-1, :, q]
        ends = np.where(np.isfinite([low, high]), np.abs([estimate - low, high - estimate]), 0.0)
        limits, true = ~np.isfinite(high), perfect.found.estimates[:, q]
        series = [
            Dots("fit, 95 %", "star", size=4, at=(middle, estimate, ends, reach)),
            Line("fit to the same frames without noise", step=True, at=(middle, true)),
        ]
        if limits.any():
            series.append(Dots("lower limit", "star", size=10, marker="^", at=(middle[limits], low[limits])))
        positive = [value for value in (*estimate, *true) if value > 0]
        unit = f" ({figures.in_figure(measurement.units[q])})" if measurement.units[q] else ""
        label = " ".join(name.split(" ")[::-1]) + unit
        y = Axis(label, log=True, limits=(0.5 * min(positive), 2 * max(positive)))
        rows.append([Panel(Axis("time from the start of the stare (s)"), y, series)])
    title = f"{star.title}: one simulated stare; nominal throughput"
    return Picture(rows, (7.2, 6.7), title, below=True, share_x=True)


@picture_of("MeasureAnswer", "joint", each=lambda answer: [(star, star.joint) for star in answer.stares if star.joint])
def joint(star: MeasuredStare, fit: JointFit) -> Picture:
    """Plot the light of a flare in each frame, the joint fit of its shape and spectrum, residuals and temperature."""
    stare, (event,), (drawn, mean) = star.staring.stare, star.events, (fit.fitted.drawn_dn, fit.fitted.mean_dn)
    since = (stare.middle_s - event.peak_s) / event.half_width_s
    near = (since > -BEFORE) & (since < AFTER)
    x, time = Axis("time from the start of the stare (s)"), stare.middle_s[near]
    dots = Dots("frames less star, sky, dark and unknowns", size=4, at=(time, drawn[near]))
    off = Dots("", "star", size=4, at=(time, (drawn - mean)[near]))
    true, fitted = fit.true.kelvin[near], fit.fitted.kelvin[near]
    simulated = Line("simulated flare", "text", dash="dashed", at=(time, true))
    kelvin = Axis("temperature (K)", limits=(0.8 * min(true.min(), fitted.min()), 1.2 * max(true.max(), fitted.max())))
    rows = [
        [Panel(x, Axis("light (DN per frame)"), [dots, Line("joint fit", "star", at=(time, mean[near]))])],
        [Panel(x, Axis("residual (DN)"), [off, Rule(along="y", dash="-", at=0.0)])],
        [Panel(x, kelvin, [Line("joint fit", "star", at=(time, fitted)), simulated])],
    ]
    title = f"{star.title}: one simulated stare; nominal throughput"
    return Picture(rows, (7.2, 6.7), title, below=True, share_x=True, heights=(2, 1, 1.5))
