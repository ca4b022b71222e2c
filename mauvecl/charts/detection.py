"""Charts of detections, limits and maps, S/N, and the instrument's unknowns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.charts import chart
from mauvecl.charts.chart import WAVELENGTH, Area, Chart, Dots, Line, Panel, Picture, PlotAxis, Rule, Series, Strips
from mauvecl.charts.matplotlib import COLOURS, COLUMN, MAX_COLUMNS, UNBROKEN, cell_edges, in_rows, numeral, picture_of
from mauvecl.detection import NoThresholdError
from mauvecl.detection.nuisances import join_names
from mauvecl.detection.requests import statistic_label
from mauvecl.detection.statistics import LinearStatistic
from mauvecl.schema.columns import first_items, part_note
from mauvecl.study.cases import full_label
from mauvecl.study.questions import QUANTITIES

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.answers.closed_forms import UnknownAnswer
    from mauvecl.answers.detect import DetectAnswer
    from mauvecl.answers.limit import LimitAnswer
    from mauvecl.answers.map import MapAnswer
    from mauvecl.answers.signal import ExposureAnswer, GaussianAnswer, SnrAnswer
    from mauvecl.detection.detection import Detection, Roc
    from mauvecl.detection.snr import SnrResult
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.study import Study

# Largest numbers of stars, of flares of a star, and of panels of noise budgets in a picture.
MOST_STARS, MOST_FLARES, MOST_BUDGETS = 6, 16, 12
MARKS = "osD^vPX"  # markers of limits with the same colour
MARGIN = 0.04  # share of the axis of a statistic that stays empty on either side
#: Length of the axis of a weighted sum, in the inverse hyperbolic sine, above which few of its ticks have a number.
WIDE = 5.0
#: Components of a raw spectrum, as in the paper's figure.
COMPONENTS = {
    "raw": "raw spectrum", "source": "star", "sky": "zodiacal light", "photon_noise": "photon noise",
    "dark": "dark current", "bias": "bias", "read_noise": "read noise",
}  # fmt: skip
#: Title of a star, its detection, and the names of its flares.
DetectedStar = tuple[str, "Detection", Sequence[str]]


def _detected_stars(answer: DetectAnswer) -> list[DetectedStar]:
    """Return the stars of an answer as pictures need them."""
    return [
        (star.title, star.detection, [f"flare {100 * amplitude:g} %" for amplitude in star.amplitudes])
        for star in answer.stars
    ]


@picture_of("DetectAnswer", "detection", given=lambda answer: (_detected_stars(answer), answer.study.run.fap))
@picture_of(
    "Detection",
    "detection",
    given=lambda outcome: ([(outcome.quiet.name, outcome, [f"flare {k + 1}" for k in range(len(outcome.flares))])],),
)
def detection(all_stars: Sequence[DetectedStar], fap: float = 1e-3) -> Picture:
    """Plot null and flare distributions, with a row for each of the first stars and a column per statistic."""
    stars, note = first_items(all_stars, MOST_STARS, "stars")
    first, rows = stars[0][1], list[Sequence[Panel]]()
    columns = min(len(first.statistics), MAX_COLUMNS)
    for star in stars:
        rows += in_rows([_distributions(*star, statistic, fap) for statistic in first.statistics], columns)
    exposures = _exposures(outcome.quiet for _, outcome, _ in stars)
    title = (
        f"Detection statistics without and with a flare, {exposures}, {first.realisations:,} realisations each; "
        f"thresholds at a false-alarm probability of {fap:g} per test"
    )
    return Picture(rows, (COLUMN * columns, 2.6 * len(rows) + 0.4), title, _notes(stars, note), below=True)


def _exposures(expectations: Iterable[Expectation]) -> str:
    """Return the exposure times of expectations for a title, each once and in order."""
    return join_names([f"{exposure_s:g}{UNBROKEN}s" for exposure_s in sorted({x.exposure_s for x in expectations})])


def _drawn_flares(names: Sequence[str]) -> list[int]:
    """Return the indices of the flares that a picture shows: all, or evenly spread from the first to the last."""
    return [round(k) for k in np.linspace(0, len(names) - 1, min(len(names), MOST_FLARES))]


def _notes(stars: Sequence[DetectedStar], note: str) -> tuple[str, ...]:
    """Return the notes on the throughput and on the numbers of drawn stars and flares; `note` is that on the stars."""
    most = max(len(names) for *_, names in stars)
    throughput = chart.throughput_of(outcome.quiet for _, outcome, _ in stars)
    return throughput, note, part_note(min(MOST_FLARES, most), most, "flares")


def _distributions(title: str, outcome: Detection, flares: Sequence[str], statistic: str, fap: float) -> Panel:
    """Return the histograms of a statistic without and with each flare, and its thresholds."""
    kind = outcome.statistic(statistic)
    linear, chosen = isinstance(kind, LinearStatistic), _drawn_flares(flares)
    shapes: list[tuple[int | None, str, str]] = [(None, "drawn", "no flare")]
    shapes += [(k, colour, flares[k]) for k, colour in zip(chosen, cycle(COLOURS), strict=False)]
    series, ends = list[Series](), list[float]()
    for flare, colour, name in shapes:
        edges, counts = outcome.histogram(statistic, flare, bins=120)
        middle, height = (edges[1:] + edges[:-1]) / 2, counts / counts.max()
        ends += [edges[0], edges[-1]]
        series.append(Area("", colour, alpha=0.3, step=True, at=(middle, 0 * height, height)))
        series.append(Line(name, colour, step=True, at=(middle, height)))
    # Statistics that are scaled by the flare have a threshold per flare.
    thresholded, cuts = chosen if kind.shaped and not linear else [0], list[float]()
    for k, colour in zip(thresholded, cycle(COLOURS if len(thresholded) > 1 else ["text"]), strict=False):
        try:
            cut = outcome.threshold(fap, statistic, template=k).value
        except NoThresholdError:
            continue
        cuts.append(cut)
        series.append(Rule("threshold", colour, listed=len(thresholded) == 1, at=cut))
    above = f"{title}: a threshold per flare" if len(thresholded) > 1 else title
    if len(thresholded) == len(cuts) == 1:
        above = f"{title}: threshold {numeral(cuts[0], 3)}"
    low, high = min(ends + cuts), max(ends + cuts)
    x, y = PlotAxis(statistic_label(statistic)), PlotAxis("realisations / peak", limits=(0, 1.05))
    if linear:
        return Panel(x, y, series, above, finish=partial(_asinh, ends=(low, high)))
    margin = (high / low) ** MARGIN
    return Panel(replace(x, log=True, limits=(low / margin, high * margin)), y, series, above)


def _asinh(axis: Any, ends: tuple[float, float]) -> None:
    """Scale the axis of a weighted sum, whose means differ by decades, and show the values between two ends."""
    from matplotlib.ticker import FixedLocator

    axis.set_xscale("asinh", linear_width=2)
    low, high = np.arcsinh(np.array(ends) / 2)
    axis.set_xlim(*2 * np.sinh([low - MARGIN * (high - low), high + MARGIN * (high - low)]))
    decades = 10.0 ** np.arange(1, 10)
    few = range(-10, 10, 2) if high - low < WIDE else (-10, -4, 0, 4)
    axis.xaxis.set_major_locator(FixedLocator([*few, 10, 30, *decades[1:]]))
    axis.xaxis.set_minor_locator(FixedLocator([*range(-10, 10), *np.outer(decades, range(1, 10)).ravel()]))
    axis.xaxis.set_major_formatter(lambda value, _: numeral(value))


def roc_columns(curve: Roc) -> tuple[Any, ...]:
    """Return false-alarm and detection probabilities with the ends of their intervals, where there are alarms."""
    points = curve.points()
    alarms = points["fap"] > 0
    return tuple(points[name][alarms] for name in ("fap", "probability", "probability_low", "probability_high"))


@picture_of("Roc", "roc")
def roc(curves: Roc | Sequence[tuple[str, Roc]], *, name: str = "") -> Panel:
    """Plot receiver operating characteristics with their areas: one with its name, or several with theirs."""
    from mauvecl.detection.detection import Roc

    series: list[Series] = []
    named = [(name, curves)] if isinstance(curves, Roc) else curves
    for colour, (title, curve) in zip(cycle(COLOURS), named, strict=False):
        fap, probability, low, high = roc_columns(curve)
        text = f"{title}: area {curve.area.value:.4f}".removeprefix(": ")
        series += [Line(text, colour, at=(fap, probability)), Area("", colour, alpha=0.3, at=(fap, low, high))]
    x, y = PlotAxis("false-alarm probability per test", log=True), PlotAxis("detection probability", limits=(0, 1.02))
    return Panel(x, y, series)


@picture_of("DetectAnswer", "spectra")
def spectra(answer: DetectAnswer) -> Picture:
    """Plot mean spectra per second with pixel noise and, below, the flares in sigma of an element's noise."""

    def finish(axis: Any) -> None:
        axis.set_ylim(bottom=max(axis.get_ylim()[0], 0.03))

    stars, note = first_items(_detected_stars(answer), MOST_STARS, "stars")
    above, below = list[Panel](), list[Panel]()
    for title, outcome, names in stars:
        quiet, complete, nm = outcome.quiet, _complete_elements(outcome.quiet), outcome.quiet.wavelength_nm
        sigma = np.sqrt(quiet.per_element(quiet.variance_dn2))
        drawn = [(names[k], outcome.flares[k], COLOURS[i % len(COLOURS)]) for i, k in enumerate(_drawn_flares(names))]
        mean, noise = quiet.signal_dn / quiet.exposure_s, np.sqrt(quiet.variance_dn2) / quiet.exposure_s
        spectra = [Line(name, colour, at=(nm, x.signal_dn / x.exposure_s)) for name, x, colour in drawn[::-1]]
        band = Area("1 sigma of a pixel", alpha=0.35, at=(nm, mean - noise, mean + noise))
        series = [*spectra, band, Line("no flare", "text", dash="dashed", at=(nm, mean))]
        y = PlotAxis("net signal (DN s$^{-1}$ pixel$^{-1}$)")
        above.append(Panel(WAVELENGTH, y, series, f"{title}, {quiet.exposure_s:g} s"))
        risen = [(x.per_element(x.signal_dn - quiet.signal_dn) / sigma, colour) for _, x, colour in drawn[::-1]]
        lines = [Line("", colour, at=(quiet.element_wavelength_nm[complete], rise[complete])) for rise, colour in risen]
        y = PlotAxis("flare less quiet\n(sigma per element)", log=True)
        below.append(Panel(WAVELENGTH, y, [*lines, Rule(along="y", at=1.0)], finish=finish))
    size = COLUMN * len(stars), 5.0
    return Picture([above, below], size, "Mean spectra", _notes(stars, note), below=True, share_x=True, heights=(3, 2))


def _complete_elements(x: Expectation) -> NDArray[np.bool_]:
    """Return the complete elements; the last one of the spectrum may have fewer pixels."""
    pixels = np.bincount(x.element, minlength=x.element_wavelength_nm.size)
    return np.asarray(pixels >= np.median(pixels) - 1)


@picture_of("SimulateAnswer", "observation", each=lambda answer: answer.observations)
def observation(title: str, expectation: Expectation, table: QTable) -> Picture:
    """Plot a raw spectrum and its components, as the paper's figure of components."""
    nm, rows = table["wavelength"].to_value("nm"), list[list[Panel]]()
    for letter, (name, text), colour in zip("abcdefg", COMPONENTS.items(), COLOURS, strict=True):
        line = Line("", colour, width=0.9, at=(nm, table[name].value))
        rows.append([Panel(WAVELENGTH, PlotAxis("DN"), [line], f"({letter}) {text}")])
    title = f"{title}: one observation of {table.meta['exposure_s']:g} s"
    return Picture(rows, (7.2, 9.5), title, (chart.throughput_of([expectation]),), share_x=True)


@picture_of("SnrAnswer", "snr", given=lambda answer: ([(star.title, star.result) for star in answer.stars],))
@picture_of("SnrResult", "snr", given=lambda result: ([(result.expectation.name, result)],))
def signal_to_noise(all_stars: Sequence[tuple[str, SnrResult]]) -> Picture:
    """Plot the closed-form S/N per pixel and resolution element, and the spread of realisations."""
    (stars, note), rows = first_items(all_stars, MOST_STARS, "stars"), list[list[Panel]]()
    for title, result in stars:
        x, complete = result.expectation, _complete_elements(result.expectation)
        title = title if f"{x.exposure_s:g} s" in title else f"{title}, {x.exposure_s:g} s"
        nm, snr = x.element_wavelength_nm[complete], x.snr_per_element()[complete]
        rows.append([_snr_panel(title, "per pixel", x.wavelength_nm, x.snr(), result.pixel),
                     _snr_panel(title, "per resolution element", nm, snr, result.element[complete])])  # fmt: skip
    notes = chart.throughput_of(result.expectation for _, result in stars), note
    return Picture(rows, (7.6, 2.6 * len(rows) + 0.4), "S/N of one exposure", notes, below=True, share_x=True)


def _snr_panel(title: str, per: str, nm: Any, expected: Any, table: QTable) -> Panel:
    """Return the S/N in closed form, over the ranges of realisations."""
    series: list[Series] = [
        Area("95 % of realisations", "star", alpha=0.25, at=(nm, table["q2.5"], table["q97.5"])),
        Area("68 % of realisations", "star", alpha=0.45, at=(nm, table["q16"], table["q84"])),
        Line("closed form", "text", width=1.2, at=(nm, expected)),
    ]
    return Panel(WAVELENGTH, PlotAxis(f"S/N {per}"), series, title)


@picture_of("UnknownAnswer", "unknowns")
def unknowns(answer: UnknownAnswer) -> Picture:
    """Plot closed-form power per star (dashed plain, solid marginalised), and the smallest amplitudes."""
    from scipy.special import ndtri

    from mauvecl.answers.closed_forms import power

    stars, fap = list(dict.fromkeys(row["star"] for row in answer.rows)), answer.study.run.fap
    needed, above, below = ndtri(answer.study.limit.power) - ndtri(fap), list[Panel](), list[Panel]()
    for star in stars:
        # The curves are those of the star's first flare.
        of_star = [row for row in answer.rows if row["star"] == star]
        snr, amplitude = of_star[0]["known"], of_star[0]["amplitude"]
        least = amplitude * needed / snr if snr > 0 else float("inf")
        relative = np.geomspace(0.03, 300.0, 200) * least
        at = relative, power(snr * relative / amplitude, fap)
        series: list[Series] = [Line("everything known", "text", width=4, at=at)]
        smallest = [Dots("", "text", size=12, at=([0], [least]))]
        first = [row for row in of_star if row["amplitude"] == amplitude]
        for k, (colour, row) in enumerate(zip(cycle(COLOURS), first, strict=False), 1):
            marginal, plain = (power(row[name] * relative / amplitude, fap) for name in ("marginal", "plain"))
            series.append(Line(row["unknown"].replace("+-", "±"), colour, at=(relative, marginal)))
            series.append(Line("", colour, dash="dashed", at=(relative, plain)))
            smallest.append(Dots("", colour, size=12, at=([k], [row["smallest"]])))
        y = PlotAxis("detection probability", limits=(-0.02, 1.02))
        above.append(Panel(PlotAxis(QUANTITIES["amplitude"].label, log=True), y, series, star))
        below.append(Panel(PlotAxis(ticks=((), ())), PlotAxis("smallest flare amplitude", log=True), smallest))
    title = (
        f"Above: solid marginalised, dashed plain; below: detected with a probability of {answer.study.limit.power:g}, "
        f"marginalised over each unknown; false-alarm probability {fap:g} per test"
    )
    return Picture([above, below], (2.6 * len(stars) + 1.6, 5.6), title, below=True)


def quantity_axis(study: Study, name: str, **options: Any) -> PlotAxis:
    """Return the axis of a quantity, with the band of magnitudes if all stars have the same."""
    bands = {star.band for star in study.star}
    band = f" ({bands.pop()})" if name == "magnitude" and len(bands) == 1 else ""
    return PlotAxis(QUANTITIES[name].label + band, **options)


@picture_of("MapAnswer", "map")
def detection_map(answer: MapAnswer) -> Picture:
    """Plot the detection probability over two quantities, one panel per statistic."""
    question, study, places, edges, axes = answer.study.map, answer.study, list[Any](), list[Any](), list[PlotAxis]()
    for sweep, values in zip(question.axes, (answer.x, answer.y), strict=True):
        named = isinstance(values[0], str)
        places.append(np.arange(len(values)) if named else np.array(values, float))
        ticks, log = (places[-1], values) if named else None, sweep.log and not named
        edges.append(cell_edges(np.sort(places[-1]), log=log))
        axes.append(quantity_axis(study, sweep.quantity, log=log, ticks=ticks))
    # Values may be given in any order.
    (columns, rows), (x, y), (x_axis, y_axis) = map(np.argsort, places), map(np.sort, places), axes
    contoured, row = bool(question.contours) and min(x.size, y.size) > 1, []
    for statistic, p in zip(answer.statistics, answer.probability[:, rows[:, None], columns], strict=True):
        series: list[Series] = [chart.Mesh("detection probability", at=(*edges, p))]
        if contoured:
            series.append(chart.Levels("detected", levels=tuple(question.contours), at=(x, y, p)))
        title = statistic_label(statistic).partition(" (")[0]
        row.append(Panel(x_axis, y_axis, series, title))
    names = {axis.quantity for axis in question.axes}
    exposure = "" if "exposure" in names else f", {study.observation.exposure_s:g} s"
    flare = "" if "amplitude" in names else f", flare of {100 * study.flare.amplitudes[0]:g} %"
    title = f"{answer.star}{exposure}{flare}, false-alarm probability {study.run.fap:g} per test"
    empty = "grey: no answer" if np.isnan(answer.probability).any() else ""
    notes = chart.throughput_of(answer.inputs), empty
    return Picture([row], (COLUMN * len(row) + 0.5, 3.4), title, notes, below=contoured, share_y=True)


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
        value = f"{limit.value.value:.2f}" if of == "magnitude" else numeral(limit.value.value, 3)
        text = f"{limit.title}{flare}{statistic}: {value}{QUANTITIES[of].suffix}"
        at = [point.value for point in points], p, (p - low, high - p)
        series += [
            Dots(text, colour, marker=marker, size=6, at=at),
            Line("", colour, width=1.2, at=tuple(zip(*sorted(limit.curve), strict=True))),
            Strips("", colour, alpha=0.25, at=([limit.value.low], [limit.value.high])),
        ]
    series.append(Rule(colour="text", along="y", at=power))
    exposure = "" if of == "exposure" else f", {_exposures(answer.inputs)}"
    title = (
        f"Limits at a detection probability of {power:g}{exposure}, false-alarm probability "
        f"{answer.study.run.fap:g} per test; points: simulated, 95 %; lines: Gaussian noise"
    )
    y, notes = PlotAxis("detection probability", limits=(-0.02, 1.02)), (chart.throughput_of(answer.inputs),)
    panel = Panel(quantity_axis(answer.study, of, log=of != "magnitude"), y, series)
    return Picture([[panel]], (COLUMN, 3.0 + 0.17 * len(answer.limits)), title, notes, below=True)


#: Noise by origin, as on the page and in files.
BUDGET = Chart(
    "budget", "Noise of a pixel by origin", WAVELENGTH, PlotAxis("noise (DN rms per pixel)", log=True),
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
    number_of_cells, expectations = answer.study.sweep.size, [(star, star.result.expectation) for star in answer.stars]
    observed = [(star.title if star.at else f"{star.title}, {x.exposure_s:g} s", x) for star, x in expectations]

    def finish(axis: Any) -> None:
        # Zodiacal light can be far below everything else.
        axis.set_ylim(bottom=max(axis.get_ylim()[0], axis.get_ylim()[1] * 1e-4))

    shown, note = first_items(observed, MOST_BUDGETS, "observations")
    panels = [replace(BUDGET.panel(budget_series(x), title), finish=finish) for title, x in shown]
    # A column for each cell, unless these are too many.
    across = len(observed) // number_of_cells if number_of_cells <= MAX_COLUMNS and len(shown) == len(observed) else 0
    rows = [panels[k::across] for k in range(across)] or in_rows(panels, MAX_COLUMNS)
    size = COLUMN * max(len(row) for row in rows), 2.3 * len(rows) + 0.7
    notes = chart.throughput_of(answer.inputs), note
    return Picture(rows, size, "Noise budgets", notes, below=True, share_x=True, share_y="col" if across else True)


@picture_of("SnrAnswer", "snr-sweep", when=lambda answer: answer.study.sweep.axes)
def snr_sweep(answer: SnrAnswer) -> Picture:
    """Plot the S/N of some elements against the first swept quantity, a line per value of the others."""
    from mauvecl.answers.signal import index_at

    first, row = answer.study.sweep.axes[0].quantity, []
    # The axis names the band, unless stars have different ones.
    bands = {star.band for star in answer.study.star}
    band = f" {min(bands)}" if len(bands) == 1 else ""
    for wavelength in answer.shown_nm:
        lines: dict[str, list[Any]] = {}
        for star in answer.stars:
            name = star.label.replace(f"{band} = {star.at[first]:g}", "") if first == "magnitude" else star.label
            name_of_line = full_label(name, {k: v for k, v in star.at.items() if k != first})
            element = star.result.element[index_at(star.result.expectation, wavelength, "element")]
            ends = (max(element[q], 1e-3) for q in ("q2.5", "q97.5"))
            lines.setdefault(name_of_line, []).append((star.at[first], element["expected"], *ends))
        series: list[Series] = []
        for (name, points), colour in zip(lines.items(), cycle(COLOURS), strict=False):
            x, expected, low, high = zip(*(points if first == "star" else sorted(points)), strict=True)
            lengths = np.maximum(np.subtract(expected, low), 0), np.maximum(np.subtract(high, expected), 0)
            series += [Line(name, colour, at=(x, expected)), Dots("", colour, size=7, at=(x, expected, lengths))]
        y_axis = PlotAxis("S/N per resolution element", log=True, limits=(0.1, None))
        x_axis = quantity_axis(answer.study, first, log=first == "exposure")
        row.append(Panel(x_axis, y_axis, series, f"{wavelength:g} nm"))
    title, size = "S/N in closed form; bars: 95 % of realisations", (COLUMN if len(row) == 1 else 2.6 * len(row), 3.2)
    return Picture([row], size, title, (chart.throughput_of(answer.inputs),), below=True, share_y=True)


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

        y = PlotAxis(limits=(len(rows) - 0.5, -0.5), ticks=(rows, labels))
        return Panel(PlotAxis(text), y, [series, Rule(dash="-", at=predicted)], finish=finish)

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
    title = "Simulation and root-of-N formula; vertical lines: as the formula predicts"
    notes = (chart.throughput_of(answer.inputs),)
    return Picture([row], (2 * COLUMN, 0.22 * len(cells) + 1.5), title, notes, share_y=True)


@picture_of("ExposureAnswer", "exposure")
def exposures(answer: ExposureAnswer) -> Picture:
    """Plot the S/N of each star against exposure."""
    first, series = answer.exposures[0], list[Series]()
    for e, colour in zip(answer.exposures, cycle(COLOURS), strict=False):
        x = np.geomspace(e.exposure_s / e.frames, 4 * e.exposure_s, 50)
        text = f"{e.star}: {numeral(e.exposure_s, 4)} s"
        series.append(Line(text, colour, at=(x, e.snr * np.sqrt(x / e.exposure_s))))
        series.append(Dots("", colour, size=8, at=([e.exposure_s], [e.snr])))
    series.append(Rule(f"wanted S/N of {first.wanted:g}", along="y", at=first.wanted))
    per = "resolution element" if first.per == "element" else first.per
    panel = Panel(PlotAxis("exposure (s)", log=True), PlotAxis(f"S/N per {per}", log=True), series)
    title, notes = f"S/N at {first.wavelength_nm:g} nm against exposure", (chart.throughput_of(answer.inputs),)
    return Picture([[panel]], (COLUMN, 3.0 + 0.17 * len(answer.exposures)), title, notes, below=True)
