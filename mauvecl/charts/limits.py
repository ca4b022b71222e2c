"""Charts for planning: maps, limits, noise budgets, S/N over a sweep, exposures, and errors of measured flares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.charts.chart import (
    WAVELENGTH,
    Axis,
    Band,
    Chart,
    Dots,
    Line,
    Mesh,
    Panel,
    Picture,
    Rule,
    Series,
    Strips,
    picture_of,
)
from mauvecl.charts.matplotlib import COLOURS, COLUMN, UNBROKEN, styled_picture
from mauvecl.detection.requests import statistic_label
from mauvecl.fits.flare_model import FlareModel, usable_variance
from mauvecl.schema.columns import First, note_of
from mauvecl.study.cases import full_label
from mauvecl.study.questions import QUANTITIES

if TYPE_CHECKING:
    from mauvecl.answers.gaussian import GaussianAnswer
    from mauvecl.answers.limit import LimitAnswer
    from mauvecl.answers.map import MapAnswer
    from mauvecl.answers.measure import MeasureAnswer, MeasuredFlare
    from mauvecl.answers.measurements import JointFit, MeasuredStare
    from mauvecl.answers.signal import ExposureAnswer, SnrAnswer
    from mauvecl.host.exposure.expectation import Expectation


#: Styles of contours, by ascending probability.
STROKES = ("dotted", "dashed", "-", "dashdot")
MARKS = "osD^vPX"


@picture_of("MapAnswer", "map")
@styled_picture
def detection_map(answer: MapAnswer) -> Picture:
    """Plot the detection probability over two quantities, one panel per statistic."""
    question, study = answer.study.map, answer.study
    named = {which: isinstance(getattr(answer, which)[0], str) for which in "xy"}
    x, y = (
        np.arange(len(values)) if named[which] else np.array(values, float)
        for which, values in (("x", answer.x), ("y", answer.y))
    )
    # Lines are close where a map is steep, so line styles distinguish them instead of labels.
    levels = dict(zip(sorted(question.contours), cycle(STROKES), strict=False)) if min(x.size, y.size) > 1 else {}

    def finish(axis: Any, probability: Any) -> None:
        if levels:
            axis.contour(x, y, probability, levels=list(levels), colors="white", linewidths=2.4)
            strokes = list(levels.values())
            axis.contour(x, y, probability, levels=list(levels), colors="black", linewidths=1.2, linestyles=strokes)

    x_axis, y_axis = (
        Axis(QUANTITIES[sweep.quantity].label, log=sweep.log and not named[which],
             ticks=(place, getattr(answer, which)) if named[which] else None)
        for which, sweep, place in (("x", question.x, x), ("y", question.y, y))
    )  # fmt: skip
    lines = [Line(f"detected in {100 * level:g} %", "text", dash=dash, at=([], [])) for level, dash in levels.items()]
    row = [
        Panel(x_axis, y_axis, [Mesh("detection probability", at=(x, y, p)), *lines], statistic_label(statistic),
              partial(finish, probability=p))
        for statistic, p in zip(answer.statistics, answer.probability, strict=True)
    ]  # fmt: skip
    names = {question.x.quantity, question.y.quantity}
    exposure = "" if "exposure" in names else f", {study.observation.exposure_s:g} s"
    flare = "" if "amplitude" in names else f", flare of {100 * study.flare.amplitudes[0]:g} %"
    title = f"{answer.star}{exposure}{flare}, false-alarm probability {study.run.fap:g} per test; nominal throughput"
    return Picture([row], (COLUMN * len(row) + 0.5, 3.4), title, below=bool(levels), share_y=True)


@picture_of("LimitAnswer", "limit")
@styled_picture
def limits(answer: LimitAnswer) -> Picture:
    """Plot the detection probability at every simulated value, and the limits."""
    of, power = answer.study.limit.of, answer.study.limit.power
    series: list[Series] = []
    for k, limit in enumerate(answer.limits):
        colour, marker = COLOURS[k % len(COLOURS)], MARKS[k // len(COLOURS) % len(MARKS)]
        points = sorted((*limit.points, limit.check), key=lambda p: p.value)
        p, low, high = np.array([(q.value, q.low, q.high) for q in (point.probability for point in points)]).T
        flare = "" if np.isnan(limit.amplitude) else f", {100 * limit.amplitude:g} %"
        text = f"{limit.star}{flare}, {limit.statistic}: {limit.value.value:.4g}"
        at = [point.value for point in points], p, (p - low, high - p)
        series += [
            Dots(text, colour, marker=marker, size=6, at=at),
            Line("", colour, width=1.2, at=tuple(zip(*sorted(limit.curve), strict=True))),
            Strips("", colour, alpha=0.25, at=([limit.value.low], [limit.value.high])),
        ]
    series.append(Rule(colour="text", along="y", at=power))
    exposure = "" if of == "exposure" else f", {answer.study.observation.exposure_s:g}{UNBROKEN}s"
    title = (
        f"Limits at a power of {power:g}{exposure}, false-alarm probability {answer.study.run.fap:g} per test; "
        "points: simulated, 95 %; lines: Gaussian noise; nominal throughput"
    )
    x, y = Axis(QUANTITIES[of].label, log=of != "magnitude"), Axis("detection probability", limits=(-0.02, 1.02))
    return Picture([[Panel(x, y, series)]], (COLUMN, 3.0 + 0.17 * len(answer.limits)), title, below=True)


#: Noise by origin, as on the page and in files.
BUDGET = Chart(
    "budget", "Noise of a pixel by origin", WAVELENGTH, Axis("noise (DN rms per pixel)", log=True),
    (
        Line("photons of the star", "star", "source_photon", width=2, tips=("photons of the star (DN)",)),
        Line("photons of neighbours", "flare", "neighbour_photon", "if any", width=2,
             tips=("photons of neighbours (DN)",)),
        Line("photons of the sky", "sky", "zodiacal_photon", width=2, tips=("photons of the sky (DN)",)),
        Line("dark current", "dark", "dark", width=2, tips=("dark current (DN)",)),
        Line("read noise", "read", "read", width=2, tips=("read noise (DN)",)),
        # The largest part stays visible behind the sum.
        Line("all together", "total", "total", width=2, dash="dashed", tips=("wavelength (nm)", "all together (DN)")),
    ),
    logs=("Y",), pins="source_photon",
)  # fmt: skip


def budget_series(x: Expectation) -> dict[str, Any]:
    """Return the data of `BUDGET`; logarithms show nothing of zero."""
    table = x.noise_budget()
    values = {name: np.asarray(table[name].value) for name in table.colnames if name != "wavelength"}
    return {name: (x.wavelength_nm, np.where(v > 0, v, np.nan)) for name, v in values.items()}


@picture_of("SnrAnswer", "noise-budget")
def noise_budgets(answer: SnrAnswer, path: str | Path | None = None) -> Any:
    """Plot pixel noise by origin against wavelength, one panel per star and cell, as in the paper."""
    observed = [(star, star.result.expectation) for star in answer.stars]
    named = [(star.title if star.at else f"{star.title}, {x.exposure_s:g} s", x) for star, x in observed]
    return noise_budget(named, each=answer.study.sweep.size, path=path)


@styled_picture
def noise_budget(observed: Sequence[tuple[str, Expectation]], *, each: int = 1) -> Picture:
    """Plot pixel noise by origin against wavelength for titled expectations, in `each` columns."""

    def finish(axis: Any) -> None:
        # Zodiacal light can be far below everything else.
        axis.set_ylim(bottom=max(axis.get_ylim()[0], axis.get_ylim()[1] * 1e-4))

    stars = len(observed) // each
    panels = [replace(BUDGET.panel(budget_series(x), title), finish=finish) for title, x in observed]
    rows, size = [panels[k::stars] for k in range(stars)], (COLUMN * min(each, 6), 2.3 * stars + 0.7)
    title = "Noise budgets; nominal throughput, not a flight calibration"
    return Picture(rows, size, title, below=True, share_x=True, share_y="col")


@picture_of("SnrAnswer", "snr-sweep", when=lambda answer: answer.study.sweep.axes)
@styled_picture
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
            series += [
                Band("", colour, alpha=0.25, at=(x, low, high)), Line(name, colour, marker="o", at=(x, expected)),
            ]  # fmt: skip
        x_axis = Axis(QUANTITIES[first].label, log=first == "exposure")
        y_axis = Axis("S/N per 10.5 nm element", log=True, limits=(0.1, None))
        row.append(Panel(x_axis, y_axis, series, f"{wavelength:g} nm"))
    size = (COLUMN if len(row) == 1 else 2.6 * len(row), 3.2)
    title = "S/N: closed form, and 95 % of realisations; nominal throughput"
    return Picture([row], size, title, below=True, share_y=True)


@picture_of("GaussianAnswer", "gaussian")
@styled_picture
def gaussian(answer: GaussianAnswer) -> Picture:
    """Plot how well each prediction of the Gaussian formula holds in every cell."""
    from matplotlib.ticker import MaxNLocator

    cells, labels = answer.cells, [full_label(s.label, s.at) for s in answer.signal.stars]
    rows = np.arange(len(cells))

    def panel(text: str, predicted: float, least: float, series: Series) -> Panel:
        """Return a panel whose x axis reaches at least so far on both sides of the prediction."""

        def finish(axis: Any) -> None:
            low, high = axis.get_xlim()
            axis.set_xlim(min(low, predicted - least), max(high, predicted + least))
            axis.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
            axis.grid(axis="y", linewidth=0.3)

        y = Axis(limits=(len(rows) - 0.5, -0.5), ticks=(rows, labels))
        return Panel(Axis(text), y, [series, Rule(dash="-", at=predicted)],
                     finish=finish)  # fmt: skip

    half = (np.asarray(cells["coverage_high"]) - np.asarray(cells["coverage_low"])) / 2
    coverage = Dots("", "star", marker="", width=5, at=(np.asarray(cells["coverage_low"]) + half, rows, 0 * half, half))
    dots = {name: Dots("", "star", size=7, at=(np.asarray(cells[name]), rows))
            for name in ("snr_off_by", "five_sigma_above", "fap_ratio")}  # fmt: skip
    row = [
        panel("mean S/N\nless formula", 0.0, 0.1, dots["snr_off_by"]),
        panel("share of 1-sigma\nintervals right", 0.6827, 0.03, coverage),
        panel("pixels 5 sigma above,\nover normal", 1.0, 0.5, dots["five_sigma_above"]),
        panel("false alarms\nover promised", 1.0, 0.2, dots["fap_ratio"]),
    ]
    title = "The root-of-N formula and the simulation; grey: as promised; nominal throughput"
    return Picture([row], (2 * COLUMN, 0.22 * len(cells) + 1.5), title, share_y=True)


@picture_of("ExposureAnswer", "exposure")
@styled_picture
def exposures(answer: ExposureAnswer) -> Picture:
    """Plot the S/N of each star against exposure."""
    first, series = answer.exposures[0], list[Series]()
    for e, colour in zip(answer.exposures, cycle(COLOURS), strict=False):
        x = np.geomspace(e.exposure_s / e.frames, 4 * e.exposure_s, 50)
        series += [
            Line(f"{e.star}: {e.exposure_s:g} s", colour, at=(x, e.snr * np.sqrt(x / e.exposure_s))),
            Dots("", colour, size=8, at=([e.exposure_s], [e.snr])),
        ]
    series.append(Rule(along="y", at=first.wanted))
    panel = Panel(Axis("exposure (s)", log=True), Axis(f"S/N per {first.per}", log=True), series)
    title = f"S/N at {first.wavelength_nm:g} nm; dashed: the one wanted; nominal throughput"
    return Picture([[panel]], (COLUMN, 2.9 + 0.17 * len(answer.exposures)), title, below=True)


#: Increases of chi-squared that enclose 68.27 and 95 % in two dimensions.
RISES = (2.30, 5.99)
#: Factors on the amplitude over which errors are plotted.
FACTORS = np.geomspace(0.1, 10.0, 25)
#: Half-widths before and after the peak of a flare that are plotted.
BEFORE, AFTER = 3.0, 15.0
#: Largest number of flares in a picture.
MOST_FLARES = 4


def _few(answer: MeasureAnswer) -> tuple[Any, ...]:
    return (First(answer.flares, MOST_FLARES, "flares"),)


@picture_of("MeasureAnswer", "fit", given=_few)
@styled_picture
def fits(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot the first exposure minus unknowns with the fitted flare, and the residuals, with a column per fit."""
    above, below = list[Panel](), list[Panel]()
    for flare in flares:
        quiet, measurement = flare.quiet, flare.found
        mean, unknown = flare.fitted_dn()
        kelvin = " and ".join(f"{x:.0f} K" for x in np.atleast_1d(np.exp(measurement.log_k[0])))
        variance, used = usable_variance(quiet, mean, flare.skipped_nm)
        sums = [quiet.per_element(np.where(used, values, 0.0)) for values in (flare.frame - unknown, mean, variance)]
        # Resolution elements of which some pixels are not used are not shown.
        whole = quiet.per_element(used.astype(np.float64)) == quiet.per_element(np.ones(used.size))
        data, fit, variance = (np.where(whole, values, np.nan) for values in sums)
        nm, noise = quiet.element_wavelength_nm, np.sqrt(variance)
        x = Axis("wavelength (nm)")
        dots = Dots("exposure less star and unknowns", size=4, at=(nm, data, noise))
        line = Line(f"fit: {kelvin}", "star", at=(nm, fit))
        above.append(Panel(x, Axis("DN per resolution element"), [dots, line], flare.name))
        residuals = Dots("", "star", size=4, at=(nm, (data - fit) / noise))
        below.append(Panel(x, Axis("residual / noise"), [residuals, Rule(along="y", dash="-", at=0.0)]))
    size = 3.6 * len(flares), 4.6
    return Picture([above, below], size, notes=(note_of(flares),), share_x=True, heights=(2, 1))


def _each(flares: Sequence[MeasuredFlare], panel: Callable[[MeasuredFlare], Panel]) -> Picture:
    """Return a picture with a panel per flare."""
    return Picture([[panel(flare) for flare in flares]], (3.4 * len(flares), 3.1), notes=(note_of(flares),))


def _single(answer: MeasureAnswer) -> tuple[Any, ...]:
    single = [flare for flare in answer.flares if isinstance(flare.fitted, FlareModel)]
    return (First(single, MOST_FLARES, "flares"),)


@picture_of("MeasureAnswer", "contours", given=_single, when=lambda answer: bool(_single(answer)[0]))
@styled_picture
def contours(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot expected confidence regions of temperature and amplitude, with unknowns marginalised."""

    def panel(flare: MeasuredFlare) -> Panel:
        series: list[Series] = []
        for rise, dash in zip(RISES, ("-", "dashed"), strict=True):
            kelvin, low, high = flare.region(rise)
            around = np.concatenate([kelvin, kelvin[::-1], kelvin[:1]]), np.concatenate([low, high[::-1], low[:1]])
            series.append(Line("", "star", dash=dash, at=around))
        series.append(Dots("", "flare", marker="+", size=10, at=flare.perfect.estimates[0, :2]))
        if np.isfinite(flare.truth[:2]).all():
            series.append(Dots("", "text", marker="x", size=10, at=flare.truth[:2]))
        return Panel(Axis("temperature (K)"), Axis("amplitude"), series, flare.name)

    return _each(flares, panel)


@picture_of("MeasureAnswer", "pulls", given=_few)
@styled_picture
def pulls(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot the pulls of estimates, (estimate - truth) / standard error, and the standard normal."""
    x, edges = np.linspace(-5.0, 5.0, 201), np.linspace(-5.0, 5.0, 41)

    def panel(flare: MeasuredFlare) -> Panel:
        series: list[Series] = []
        # Temperature, amplitude and the next one; an observed flare has only fluxes.
        for colour, q in zip(COLOURS, np.flatnonzero(np.isfinite(flare.truth))[:3], strict=False):
            with np.errstate(invalid="ignore", divide="ignore"):
                pull = (flare.found.estimates[:, q] - flare.truth[q]) / flare.found.errors[:, q]
            density, _ = np.histogram(np.clip(pull[np.isfinite(pull)], -5, 5), edges, density=True)
            series.append(Line(flare.found.names[q], colour, step=True, at=((edges[1:] + edges[:-1]) / 2, density)))
        normal = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
        series.append(Line("normal", dash="dashed", at=(x, normal)))
        return Panel(Axis("(estimate - truth) / error"), Axis("density"), series, flare.name)

    return _each(flares, panel)


@picture_of("MeasureAnswer", "errors", given=_few)
@styled_picture
def errors(flares: Sequence[MeasuredFlare]) -> Picture:
    """Plot forecast errors of temperature and amplitude against the amplitude, with and without unknowns."""

    def panel(flare: MeasuredFlare) -> Panel:
        amplitudes, series = FACTORS * flare.perfect.estimates[0, 1], list[Series]()
        for unknown, dash in {None: "dashed", flare.unknown: "-"}.items():
            ahead, whose = flare.forecasts(FACTORS, unknown), "all known" if unknown is None else "unknowns free"
            for colour, q in zip(COLOURS, range(2), strict=False):
                relative = [f.errors[q] / f.values[q] for f in ahead]
                series.append(Line(f"{flare.fitted.names[q]}, {whose}", colour, dash=dash, at=(amplitudes, relative)))
        return Panel(Axis("amplitude", log=True), Axis("relative error", log=True), series, flare.name)

    return _each(flares, panel)


@picture_of("MeasureAnswer", "temperatures", each=lambda answer: [(star,) for star in answer.stares if star.perfect])
@styled_picture
def temperatures(star: MeasuredStare) -> Picture:
    """Plot temperature, size and light of the flares of a stare against time, with 95 % intervals.

    Lines are the fits to the same frames without noise.
    """
    drawn, perfect, rows = star.drawn, star.perfect, list[list[Panel]]()
    assert drawn is not None
    assert not isinstance(drawn, str)
    assert perfect is not None
    measurement = drawn.found
    size = "area" if "area" in measurement.names else "amplitude"
    light = "luminosity bolometric" if "area" in measurement.names else "flux bolometric"
    middle, reach = (drawn.start_s + drawn.end_s) / 2, (drawn.end_s - drawn.start_s) / 2
    for name, colour in zip(("temperature", size, light), COLOURS, strict=False):
        q = measurement.column(name)
        estimate, low, high = measurement.estimates[:, q], measurement.low[-1, :, q], measurement.high[-1, :, q]
        ends = np.where(np.isfinite([low, high]), np.abs([estimate - low, high - estimate]), 0.0)
        limits, true = ~np.isfinite(high), perfect.found.estimates[:, q]
        series = [
            Dots("", colour, size=4, at=(middle, estimate, ends, reach)),
            Dots("", colour, size=10, marker="^", at=(middle[limits], low[limits])),
            Line("", step=True, at=(middle, true)),
        ]
        positive = [value for value in (*estimate, *true) if value > 0]
        label = f"{name} ({measurement.units[q]})" if measurement.units[q] else name
        y = Axis(label, log=True, limits=(0.5 * min(positive), 2 * max(positive)))
        rows.append([Panel(Axis("time from the start of the stare (s)"), y, series)])
    return Picture(rows, (7.2, 6.4), f"{star.title}: one simulated stare; nominal throughput", share_x=True)


@picture_of("MeasureAnswer", "joint", each=lambda answer: [(star, star.joint) for star in answer.stares if star.joint])
@styled_picture
def joint(star: MeasuredStare, fit: JointFit) -> Picture:
    """Plot the light of a flare in each frame, the joint fit of its shape and spectrum, residuals and temperature."""
    stare, (event,), (drawn, mean) = star.staring.stare, star.events, (fit.fitted.drawn_dn, fit.fitted.mean_dn)
    since = (stare.middle_s - event.peak_s) / event.half_width_s
    near = (since > -BEFORE) & (since < AFTER)
    x, time = Axis("time from the start of the stare (s)"), stare.middle_s[near]
    light: list[Series] = [
        Dots("frames less star, sky and dark", size=4, at=(time, drawn[near])),
        Line("joint fit", "star", at=(time, mean[near])),
    ]
    off = Dots("", "star", size=4, at=(time, (drawn - mean)[near]))
    kelvin: list[Series] = [
        Line("simulated flare", dash="dashed", at=(time, fit.true.kelvin[near])),
        Line("joint fit", "star", at=(time, fit.fitted.kelvin[near])),
    ]
    axes = {"DN per frame": light, "residual (DN)": [off, Rule(along="y", dash="-", at=0.0)], "temperature (K)": kelvin}
    rows = [[Panel(x, Axis(label), series)] for label, series in axes.items()]
    title = f"{star.title}: one simulated stare; nominal throughput"
    return Picture(rows, (7.2, 6.4), title, share_x=True, heights=(2, 1, 1.5))
