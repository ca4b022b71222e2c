"""Charts of light curves: stares, observed frames, and injected flares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from mauvecl.charts import chart
from mauvecl.charts import matplotlib as figures
from mauvecl.charts.chart import Area, Chart, Dots, Levels, Line, Mesh, Panel, Picture, PlotAxis, Rule, Series, Strips
from mauvecl.charts.matplotlib import COLOURS, cell_edges, picture_of
from mauvecl.host.arrays import Bool, Float
from mauvecl.schema.columns import first_items, part_note

if TYPE_CHECKING:
    from mauvecl.answers.analyse import AnalyseAnswer
    from mauvecl.answers.inject import InjectAnswer
    from mauvecl.answers.stare import StarStare
    from mauvecl.flares.stare import Stare
    from mauvecl.observations.frames import Frames

#: Labels of the size axes.
SIZES = {
    "amplitude": "flare amplitude", "duration": "equivalent duration (s)", "energy": "bolometric energy (erg)",
    "band_energy": "energy in the band (erg)",
}  # fmt: skip
# Largest numbers of half-widths with a curve each, and of maps in a picture.
MOST_CURVES, MOST_MAPS = 6, 6
#: Largest number of points of a light curve, and of rows of a dynamic spectrum; longer stares are averaged.
MOST_POINTS, MOST_ROWS = 4000, 600
LONG_GAP = 0.005  # shortest gap in which the level is not drawn, as a share of the whole time
BRIGHT = 30.0  # flux, in standard deviations, above which the light curve has a second panel near the level
#: Units of time: the longest duration that is shown in the unit (s), its length (s), and its name.
TIME_UNITS = ((600.0, 1.0, "s"), (4 * 3600.0, 60.0, "min"), (3 * 86_400.0, 3600.0, "h"), (np.inf, 86_400.0, "d"))
HALF_WIDTH = PlotAxis("half-width (s)", log=True)


def _stars(answer: InjectAnswer, panel: Callable[[Any], Panel], *notes: str, below: bool = False) -> Picture:
    """Return a picture with a panel per star, the first ones if there are many."""
    (stars, note), study = first_items(answer.stars, MOST_MAPS, "stars"), answer.study
    columns = min(len(stars), figures.MAX_COLUMNS)
    rows = figures.in_rows([panel(star) for star in stars], columns)
    light = "swept temperature" if "flare_temperature" in stars[0].at else study.flare.light().describe()
    title = f"Flares of {light}, {study.search.rate_text}"
    all_notes = chart.throughput_of(answer.inputs), note, *notes
    return Picture(rows, (3.6 * columns + 0.8, 3.2 * len(rows)), title, all_notes, below)


@picture_of("InjectAnswer", "completeness")
def maps(answer: InjectAnswer) -> Picture:
    """Plot completeness over half-width and size, one panel per star."""

    def panel(star: Any) -> Panel:
        f, size = star.injected, PlotAxis(SIZES[star.size], log=True)
        x, y, z = np.array(f.half_widths_s), f.sizes, f.completeness.T
        if x.size < 2:
            # A single half-width defines no cell width.
            return Panel(PlotAxis("completeness"), size, [Line("", "star", at=(f.completeness[0], y))], star.title)

        mesh = Mesh("completeness", at=(cell_edges(x, log=True), cell_edges(y, log=True), z))
        return Panel(HALF_WIDTH, size, [mesh, Levels("found", at=(x, y, z))], star.title)

    return _stars(answer, panel, below=True)


@picture_of("InjectAnswer", "curves")
def curves(answer: InjectAnswer) -> Picture:
    """Plot completeness over size at some half-widths, with 95 % intervals."""

    def panel(star: Any) -> Panel:
        f, series = star.injected, list[Series]()
        picked = np.unique(np.linspace(0, len(f.half_widths_s) - 1, MOST_CURVES).round().astype(int))
        for k, colour in zip(picked, cycle(COLOURS), strict=False):
            name = f"half-width {f.half_widths_s[k]:.0f} s"
            series += [
                Area("", colour, alpha=0.25, at=(f.sizes, f.completeness_low[k], f.completeness_high[k])),
                Line(name, colour, at=(f.sizes, f.completeness[k])),
            ]
        series.append(Rule("50 % and 90 %", "text", along="y", at=(0.5, 0.9)))
        y = PlotAxis("completeness", limits=(-0.02, 1.02))
        return Panel(PlotAxis(SIZES[star.size], log=True), y, series, star.title)

    widths = len(answer.stars[0].injected.half_widths_s)
    notes = "shaded: 95 % intervals", part_note(min(MOST_CURVES, widths), widths, "half-widths")
    return _stars(answer, panel, *notes, below=True)


@picture_of("InjectAnswer", "energies", when=lambda answer: all(star.fitted for star in answer.stars))
def energies(answer: InjectAnswer) -> Picture:
    """Plot recovered over injected energy of found flares."""

    def panel(star: Any) -> Panel:
        x, y, meshes = np.array(star.injected.half_widths_s), star.injected.sizes, list[Series]()
        if x.size > 1:
            at = cell_edges(x, log=True), cell_edges(y, log=True), np.log10(star.fitted["energy_ratio"].T)
            label = "recovered / injected energy (dex)"
            meshes.append(Mesh(label, low=-0.3, high=0.3, palette="RdBu_r", at=at))
        return Panel(HALF_WIDTH, PlotAxis(SIZES[star.size], log=True), meshes, star.title)

    return _stars(answer, panel, "medians; grey: none found")


@picture_of("StareAnswer", "light-curve", each=lambda answer: [(star,) for star in answer.stares])
def light_curves(star: StarStare) -> Picture:
    """Plot light curves in all bands, relative to the quiescent star, with injected and found flares."""
    stare, bands, rows = star.staring.stare, star.light.bands, list[list[Panel]]()
    scale, unit = shown_time_unit(stare.duration_s)
    lost = stare.numbers[:0] if star.pointing_loss is None else stare.numbers[star.pointing_loss > 0]
    ends = [(lost[run[0]] * stare.frame_s, (lost[run[-1]] + 1) * stare.frame_s) for run in _runs(lost) if run.size]
    always = [
        Strips("light lost in pointing drifts", alpha=0.2, at=np.reshape(ends, (-1, 2)).T / scale),
        Rule("injected flare", dash="dotted", at=[flare.event.peak_s / scale for flare in star.flares]),
    ]
    peaks = [float(flare.alarm.recovered.peak_s[0]) / scale for flare in star.found if flare.alarm.measured]

    def finish(axis: Any) -> None:
        axis.plot(peaks, [1.03] * len(peaks), "v", color=chart.INK["flare"], transform=axis.get_xaxis_transform(),
                  markersize=4, clip_on=False, label="found flare")  # fmt: skip

    for k, band in enumerate(bands):
        frames, mean = _stare_points(star, k)
        series = [
            *always,
            Dots("simulated frames", "star", size=2, alpha=0.6, at=frames),
            Line("star and flares alone", "text", width=1.1, at=mean),
        ]
        x, y = PlotAxis(f"time from the start of the stare ({unit})"), PlotAxis("flux / quiescent")
        # Markers outside the axes that have no place would make matplotlib give up the layout of the figure.
        rows.append([Panel(x, y, series, band, finish if peaks else None)])
    title, notes = f"{star.title}: one simulated stare", (chart.throughput_of([star.staring.quiet]),)
    return Picture(rows, (7.2, 1.5 * len(rows) + 0.9), title, notes, below=True, share_x=True)


def _stare_points(star: StarStare, band: int) -> tuple[tuple[Float, Float], tuple[Float, Float]]:
    """Return times and relative fluxes of a band, as drawn and without noise; the latter have no value in gaps.

    Each point of a long stare is the mean of a group of frames, of which the last before a gap may be smaller.
    """
    stare, light, runs = star.staring.stare, star.light, _runs(star.staring.stare.numbers)
    starts = np.concatenate([np.arange(run[0], run[-1] + 1, -(-stare.n_frames // MOST_POINTS)) for run in runs])
    counts = np.diff(np.append(starts, stare.n_frames))
    columns = stare.middle_s, light.flux[:, band], light.mean[:, band]
    time, flux, mean = (np.add.reduceat(values, starts) / counts for values in columns)
    time, level = time / shown_time_unit(stare.duration_s)[0], light.quiescent[band]
    at, is_gap = _with_gaps(np.arange(starts.size), np.searchsorted(starts, [run[0] for run in runs[1:]]))
    return (time, flux / level), (time[at], np.where(is_gap, np.nan, mean[at] / level))


def _with_gaps(at: NDArray[np.int64], after: NDArray[np.int64]) -> tuple[NDArray[np.int64], Bool]:
    """Return indices of points with both ends of each gap once more, and whether each of them is such an end.

    Gaps precede the indices at the places `after`.
    """
    ends = np.column_stack([at[after - 1], at[after]]).ravel()
    places = np.repeat(after, 2)
    return np.insert(at, places, ends), np.insert(np.zeros(at.size, np.bool_), places, True)


@picture_of("StareAnswer", "dynamic-spectrum", each=lambda answer: [(star,) for star in answer.stares])
def dynamic_spectrum(star: StarStare) -> Picture:
    """Plot each resolution element and frame, in standard deviations from the median over the stare."""
    light = star.light
    panel, column_s = spectra_panel(star.staring.stare, light.spectrum, light.spectrum_sd, light.element_nm)
    return Picture([[panel]], (7.2, 3.6), f"{star.title}: dynamic spectrum, {column_s:g} s to a column")


def spectra_panel(
    stare: Stare, spectra: NDArray[Any], sd: NDArray[Any], wavelength_nm: Float, marks: Sequence[tuple[Any, str]] = ()
) -> tuple[Panel, float]:
    """Return spectra, of shape (n_frame, n_pixel), in standard deviations from their median, and the s of a column.

    The ends of events in time are marked above the spectra in colours.
    """
    scale, unit = shown_time_unit(stare.duration_s)
    # The stare is shown on a regular grid with empty gaps.
    numbers = stare.numbers - stare.numbers[0]
    excess, _, step = column_sums(spectra - np.median(spectra, axis=0), numbers, MOST_ROWS)
    variance = column_sums(sd.astype(np.float64) ** 2, numbers, MOST_ROWS)[0]
    # Columns without frames are 0 / 0.
    with np.errstate(invalid="ignore", divide="ignore"):
        image = excess / np.sqrt(variance)
    reach = max(3.0, float(np.nanpercentile(np.abs(image), 99.5)))
    half = (wavelength_nm[1] - wavelength_nm[0]) / 2 if wavelength_nm.size > 1 else 5.0
    time = (stare.numbers[0] + np.arange(len(image) + 1) * step) * stare.frame_s / scale
    nm = np.linspace(wavelength_nm[0] - half, wavelength_nm[-1] + half, wavelength_nm.size + 1)
    label = "standard deviations from the median"
    mesh = Mesh(label, low=-reach, high=reach, palette="RdBu_r", at=(time, nm, image.T))

    def finish(axis: Any) -> None:
        for ends, colour in marks:
            axis.plot(ends, [1.02, 1.02], transform=axis.get_xaxis_transform(), color=chart.INK[colour], linewidth=3,
                      clip_on=False, solid_capstyle="butt")  # fmt: skip

    x = PlotAxis(f"time from the start of the stare ({unit})", limits=(time[0], time[-1]))
    panel = Panel(x, PlotAxis("wavelength (nm)", limits=(nm[0], nm[-1])), [mesh], finish=finish)
    return panel, step * stare.frame_s


def column_sums(values: Float, numbers: NDArray[np.int64], most: int) -> tuple[Float, Float, int]:
    """Return sums of the finite values of rows by their numbers, their counts, and the numbers in each of `most` sums.

    Sums and counts have the shape (n_sum, n_column).
    """
    step = -(-(int(numbers[-1]) + 1) // most)
    sums, counts = np.zeros((2, int(numbers[-1]) // step + 1, values.shape[1]))
    finite = np.isfinite(values)
    np.add.at(sums, numbers // step, np.where(finite, values, 0.0))
    np.add.at(counts, numbers // step, finite)
    return sums, counts, step


def shown_time_unit(duration_s: float) -> tuple[float, str]:
    """Return the length of the unit in which a duration is shown, and its name."""
    return next((length_s, name) for longest_s, length_s, name in TIME_UNITS if duration_s <= longest_s)


def _runs(numbers: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Return the runs of frames between gaps."""
    return np.split(np.arange(numbers.size), np.flatnonzero(np.diff(numbers) > 1) + 1)


#: Verdicts on events, with their colours, and these in words.
VERDICTS = {"detected": "star", "candidate": "drawn", "rejected": "own", "undecided": "dark"}
WORDS = {"star": "blue", "drawn": "grey", "own": "red", "dark": "pink"}
LIGHT_CURVE = Chart(
    "frames", "Light curve", PlotAxis("time from the first frame (min)"), PlotAxis("flux"),
    (
        *(Strips(verdict, colour, f"{verdict} events") for verdict, colour in VERDICTS.items()),
        Area("95 % of the level", "sky", "range", alpha=0.3),
        Line("quiescent level", "sky", "level"),
        # A bad frame far away does not compress the others.
        Dots("frames", "text", "searched", size=3, tips=("minute", "flux"), alone=True),
        Dots("not searched", "own", "left out", size=6, marker="x"),
    ),
    logs=("y",),
)  # fmt: skip


def thinned(values: Float, most: int | None) -> NDArray[np.int64]:
    """Return the indices of at most `most` values, including the smallest and largest of each part."""
    if most is None or values.size <= most:
        return np.arange(values.size)
    parts = np.array_split(np.arange(values.size), most // 2)
    ends = [(part[np.argmin(values[part])], part[np.argmax(values[part])]) for part in parts]
    return np.unique(np.array(ends))


def light_curve_series(
    frames: Frames, answer: AnalyseAnswer | None = None, unit_s: float = 60.0, most: int | None = None, *,
    in_noise: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Return the data of `LIGHT_CURVE`, with at most `most` points in each series.

    Only an analysis has events and a level. With `in_noise` the flux is that above the level, in units of the noise.
    """
    time, series = (frames.time_s - frames.time_s[0]) / unit_s, dict[str, Any]()
    flux, used = frames.white_light[0], frames.faults == 0
    if answer is not None:
        # Only an answer that has loaded it already needs this module.
        from mauvecl.observations.events import GAP_FRAMES

        level, half_s = answer.analysis.level, frames.cadence_s / 2
        flux, used, middle, off = answer.analysis.flux, level.used, level.level, 2 * level.level_error
        if in_noise:
            flux, middle, off = (flux - middle) / level.error, 0 * middle, off / level.error
        for verdict in VERDICTS:
            ends = [(row.event.first, row.event.last) for row in answer.rows if row.verdict == verdict]
            ends_s = answer.analysis.survey.time_s[np.array(ends, int).reshape(-1, 2)] + [-half_s, half_s]
            series[f"{verdict} events"] = (ends_s - frames.time_s[0]).T / unit_s
        long_s = max(GAP_FRAMES * frames.cadence_s, LONG_GAP * float(np.ptp(frames.time_s)))
        stretch = np.cumsum(np.diff(frames.time_s, prepend=frames.time_s[0]) > long_s)
        at = thinned(middle, most)
        at, is_gap = _with_gaps(at, np.flatnonzero(np.diff(stretch[at])) + 1)
        # In a gap the band has no width, since pages cannot interrupt an area.
        x, y, off = time[at], middle[at], np.where(is_gap, 0.0, off[at])
        series |= {"range": (x, y - off, y + off), "level": (x, np.where(is_gap, np.nan, y))}
    for name, chosen in (("searched", used), ("left out", ~used & np.isfinite(flux))):
        at = np.flatnonzero(chosen)
        at = at[thinned(flux[at], most)]
        series[name] = time[at], flux[at]
    return series


@picture_of("AnalyseAnswer", "light-curve")
def observed_light_curve(answer: AnalyseAnswer) -> Picture:
    """Plot the observed light curve with its level and the level's band of 95 %, events, and frames not searched.

    If there are bright events, a second panel shows the flux less the level.
    """
    analysis, used = answer.analysis, answer.analysis.level.used
    frames, flux, error = analysis.frames, analysis.flux, analysis.level.error
    unit_s, unit = shown_time_unit(float(np.ptp(frames.time_s)))
    x = PlotAxis(f"time ({unit}) from {frames.date(float(frames.time_s[0]))[:19]}")
    label = f"flux ({frames.unit})" if frames.unit else "flux"
    around = float(np.min((flux - error)[used])), float(np.max((flux + error)[used]))
    # Frames that are left out may be far off.
    reach = around[1] - around[0]
    beside = [value for value in flux[~used & np.isfinite(flux)] if around[0] - reach < value < around[1] + reach]
    limits = min(*around, *beside) - 0.05 * reach, max(*around, *beside) + 0.05 * reach
    shown = [(PlotAxis(label, limits=limits), False)]
    if ((flux - analysis.level.level) / error)[used].max() > BRIGHT:
        shown.append((PlotAxis("(flux \N{MINUS SIGN} level) / noise", limits=(-6, BRIGHT / 2)), True))
    rows = []
    for y, in_noise in shown:
        series = light_curve_series(frames, answer, unit_s, in_noise=in_noise)
        panel = LIGHT_CURVE.panel({name: at for name, at in series.items() if len(at[0])})
        rows.append([replace(panel, x=x, y=y)])
    title = f"{frames.name}: observed light curve; threshold of events {analysis.threshold:.2f}"
    return Picture(rows, (7.2, 1.4 + 1.8 * len(rows)), title, below=True, share_x=True)


@picture_of("AnalyseAnswer", "dynamic-spectrum", when=lambda answer: answer.analysis.spectra is not None)
def observed_dynamic_spectrum(answer: AnalyseAnswer) -> Picture:
    """Plot the searched spectra, in standard deviations from their median, and mark the events."""
    analysis, spectra = answer.analysis, answer.analysis.spectra
    assert spectra is not None
    stare, noise = analysis.survey.stare, spectra.noise
    sd = np.broadcast_to(noise.used, spectra.excess.shape)
    marks, verdicts = [], [row.verdict for row in answer.rows]
    for event, verdict in zip(analysis.events, verdicts, strict=True):
        first, last = stare.start_s[[event.first, event.last]]
        ends = np.array([first, last + stare.frame_s]) / shown_time_unit(stare.duration_s)[0]
        marks.append((ends, VERDICTS[verdict]))
    panel, _ = spectra_panel(stare, spectra.excess, sd, noise.wavelength_nm, marks)
    marked = ", ".join(f"{name} ({WORDS[colour]})" for name, colour in VERDICTS.items() if name in verdicts)
    return Picture([[panel]], (7.2, 3.6), analysis.frames.name, (f"marked above: {marked}" if marked else "",))


@picture_of("AnalyseAnswer", "noise-per-pixel", when=lambda answer: answer.analysis.spectra is not None)
def observed_pixel_noise(answer: AnalyseAnswer) -> Picture:
    """Plot the measured over the stated noise of each pixel, with the range of 95 % of normal noise."""
    spectra = answer.analysis.spectra
    assert spectra is not None
    noise = spectra.noise
    nm, series = noise.wavelength_nm, list[Series]()
    series.append(Area("95 % of normal noise", at=(nm, noise.low / noise.stated, noise.high / noise.stated)))
    for name, chosen, colour in (("measured", ~noise.departs, "star"), ("measured, departs", noise.departs, "flare")):
        if chosen.any():
            series.append(Dots(name, colour, size=4, at=(nm[chosen], (noise.measured / noise.stated)[chosen])))
    panel = Panel(PlotAxis("wavelength (nm)"), PlotAxis("measured / stated noise"), series)
    return Picture([[panel]], (4.6, 3.5), f"{answer.analysis.frames.name}: noise of quiescent frames", below=True)


@picture_of("AnalyseAnswer", "residuals")
def observed_residuals(answer: AnalyseAnswer) -> Picture:
    """Plot the residuals of the fitted process against time, their autocorrelation, and their quantiles."""
    analysis = answer.analysis
    residual, likeness = analysis.residual[:, 0], analysis.likeness
    unit_s, unit = shown_time_unit(float(np.ptp(analysis.frames.time_s)))
    time = (analysis.survey.time_s[analysis.quiet] - analysis.frames.time_s[0]) / unit_s
    size = 1.7 if time.size > 1000 else 4

    lags = np.arange(1, likeness.correlations.size + 1)
    normal = ndtri((np.arange(residual.size) + 0.5) / residual.size)
    course = [Dots("", "text", size=size, alpha=0.7, at=(time, residual))]
    correlation = [
        Strips(along="y", alpha=0.4, at=([-2 * likeness.errors[0]], [2 * likeness.errors[0]])),
        Line("", "star", marker="o", at=(lags, likeness.correlations)),
    ]
    quantiles = [
        Line(at=(normal[[0, -1]], normal[[0, -1]])),
        Dots("", "star", size=size, at=(normal, np.sort(residual))),
    ]
    row = [
        Panel(PlotAxis(f"time ({unit})"), PlotAxis("residual (standard deviations)"), course),
        Panel(PlotAxis("lag (frames)"), PlotAxis("autocorrelation"), correlation,
              finish=lambda axis: axis.xaxis.get_major_locator().set_params(integer=True)),
        Panel(PlotAxis("normal quantile"), PlotAxis("quantile of the residuals"), quantiles),
    ]  # fmt: skip
    title = f"{analysis.frames.name}: residuals of the fitted process, {analysis.level.process.name}"
    return Picture([row], (9.6, 2.9), title, ("grey: 95 % of independent, normal noise",), widths=(2, 1, 1))


@Chart(
    "scatter", "Noise of quiescent frames", PlotAxis("frames in a mean", log=True),
    PlotAxis("scatter (noise of one frame)", log=True),
    (
        Area("95 % of independent frames", name="range", alpha=0.4),
        Line("independent frames", name="white"),
        Dots("measured", "star", size=8, tips=("frames", "scatter")),
    ),
).data("analyse", "Analyse checks the noise.")  # fmt: skip
def scatter_of_means(closed: Any, answer: AnalyseAnswer) -> chart.ChartData:
    """Return the scatter of means of quiescent frames against that of independent ones."""
    rows = answer.analysis.scatter
    if len(rows) < 2:
        return chart.ChartData("Too few consecutive quiescent frames for means.")
    text = "Quiescent frames are independent."
    if red := next((row for row in rows if row.red), None):
        of = "Single frames" if red.frames == 1 else f"Means of {red.frames} frames"
        text = f"{of} scatter {red.measured / red.white:.2f} times as much as independent frames."
    x, low, high, white, measured = np.array([(r.frames, r.low, r.high, r.white, r.measured) for r in rows]).T
    return chart.ChartData(text, {"range": (x, low, high), "white": (x, white), "measured": (x, measured)})


@picture_of("AnalyseAnswer", "noise", when=lambda answer: len(answer.analysis.scatter) > 1)
def observed_noise(answer: AnalyseAnswer) -> Picture:
    """Plot the scatter of means of quiescent frames against their number, and that of independent frames."""
    panel = scatter_of_means.panel(scatter_of_means.series_of(answer))
    panel = replace(panel, x=replace(panel.x, ticks=([row.frames for row in answer.analysis.scatter],)))
    return Picture([[panel]], (4.6, 3.2), f"{answer.analysis.frames.name}: quiescent frames")
