"""Charts of light curves: stares, observed frames, and injected flares."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from mauvecl.charts import matplotlib as figures
from mauvecl.charts.chart import INK, Area, Axis, Chart, Dots, Levels, Line, Mesh, Panel, Picture, Rule, Series, Strips
from mauvecl.charts.matplotlib import COLOURS, picture_of, styled_picture
from mauvecl.host.arrays import Float
from mauvecl.schema.columns import First, part_note

if TYPE_CHECKING:
    from mauvecl.answers.analyse import AnalyseAnswer
    from mauvecl.answers.inject import InjectAnswer
    from mauvecl.answers.stare import StareAnswer, StarStare
    from mauvecl.flares.stare import Stare
    from mauvecl.observations.analysis import Analysis
    from mauvecl.observations.events import ObservedEvent

#: Labels of the size axes.
SIZES = {
    "amplitude": "flare amplitude",
    "duration": "equivalent duration (s)",
    "energy": "bolometric energy (erg)",
    "band_energy": "energy in the band (erg)",
}
#: Largest number of half-widths with a curve each.
MOST_CURVES = 6
#: Largest number of maps in a picture.
MOST_MAPS = 6
HALF_WIDTH = Axis("half-width (s)", log=True)


def _stars(answer: InjectAnswer, panel: Callable[[Any], Panel], *notes: str, below: bool = False) -> Picture:
    """Return a picture with a panel per star, the first ones if there are many."""
    stars, study = First(answer.stars, MOST_MAPS, "stars"), answer.study
    columns = min(len(stars), figures.MAX_COLUMNS)
    rows = figures.in_rows([panel(star) for star in stars], columns)
    title = f"Flares of {study.flare.light().describe()}, {study.search.rate_text}; nominal throughput"
    return Picture(rows, (3.6 * columns + 0.8, 3.2 * len(rows)), title, (stars.note, *notes), below)


@picture_of("InjectAnswer", "completeness")
def maps(answer: InjectAnswer) -> Picture:
    """Plot completeness over half-width and size, one panel per star."""

    def panel(star: Any) -> Panel:
        f, size = star.injected, Axis(SIZES[star.sizes.of], log=True)
        x, y, z = np.array(f.half_widths_s), f.sizes, f.completeness.T
        if x.size < 2:
            # A single half-width defines no cell width.
            return Panel(Axis("completeness"), size, [Line("", "star", at=(f.completeness[0], y))], star.title)

        mesh = Mesh("completeness", at=(_edges(x), _edges(y), z))
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
        y = Axis("completeness", limits=(-0.02, 1.02))
        return Panel(Axis(SIZES[star.sizes.of], log=True), y, series, star.title)

    widths = len(answer.stars[0].injected.half_widths_s)
    notes = "shaded: 95 % intervals", part_note(min(MOST_CURVES, widths), widths, "half-widths")
    return _stars(answer, panel, *notes, below=True)


@picture_of("InjectAnswer", "energies", when=lambda answer: all(star.fitted for star in answer.stars))
def energies(answer: InjectAnswer) -> Picture:
    """Plot recovered over injected energy of found flares."""

    def panel(star: Any) -> Panel:
        x, y, meshes = np.array(star.injected.half_widths_s), star.injected.sizes, list[Series]()
        if x.size > 1:
            at = _edges(x), _edges(y), np.log10(star.fitted["energy_ratio"].T)
            label = "recovered / injected energy (dex)"
            meshes.append(Mesh(label, low=-0.3, high=0.3, palette="RdBu_r", at=at))
        return Panel(HALF_WIDTH, Axis(SIZES[star.sizes.of], log=True), meshes, star.title)

    return _stars(answer, panel, "medians; grey: none found")


def _edges(middles: Any) -> Any:
    """Return the edges of cells whose centres are about evenly spaced in the logarithm."""
    steps = np.sqrt(middles[1:] / middles[:-1])
    return np.concatenate([[middles[0] / steps[0]], middles[:-1] * steps, [middles[-1] * steps[-1]]])


#: Largest number of points of a light curve, and of rows of a dynamic spectrum; longer stares are averaged.
MOST_POINTS, MOST_ROWS = 4000, 600
#: Units of time: longest duration that is shown in it, its length, s, and its name.
TIME_UNITS = ((600.0, 1.0, "s"), (4 * 3600.0, 60.0, "min"), (3 * 86_400.0, 3600.0, "h"), (np.inf, 86_400.0, "d"))


@picture_of("StareAnswer", "light-curve", each=lambda answer: [(star,) for star in answer.stares])
def light_curves(star: StarStare) -> Picture:
    """Plot light curves in all bands, relative to the quiescent star, with injected and found flares."""
    stare, light, rows = star.staring.stare, star.light, list[list[Panel]]()
    scale, unit = time_unit(stare.duration_s)
    level, gaps = np.median(light.mean, axis=0), _runs(stare.numbers)
    lost = stare.numbers[:0] if star.pointing_loss is None else stare.numbers[star.pointing_loss > 0]
    ends = [(lost[part[0]] * stare.frame_s, (lost[part[-1]] + 1) * stare.frame_s) for part in _runs(lost) if part.size]
    always = [
        Strips("light lost in pointing drifts", alpha=0.2, at=np.reshape(ends, (-1, 2)).T / scale),
        Rule("injected flare", dash="dotted", at=[flare.event.peak_s / scale for flare in star.flares]),
    ]
    peaks = [float(flare.alarm.recovered.peak_s[0]) / scale for flare in star.found if flare.alarm.measured]

    def finish(axis: Any) -> None:
        label = {"label": "found flare"} if peaks else {}
        axis.plot(peaks, [1.03] * len(peaks), "v", color=INK["flare"], transform=axis.get_xaxis_transform(),
                  markersize=4, clip_on=False, **label)  # fmt: skip

    for k, band in enumerate(light.bands):
        series = list[Series](always)
        for number, part in enumerate(gaps):
            # Means of groups of frames, of which the last may be smaller.
            edges = np.arange(0, part.size, -(-stare.n_frames // MOST_POINTS))
            columns = (stare.middle_s / scale, light.flux[:, k] / level[k], light.mean[:, k] / level[k])
            sums = (np.add.reduceat(values[part], edges) for values in columns)
            time, flux, mean = (values / np.diff(np.append(edges, part.size)) for values in sums)
            series += [
                Dots("simulated frames", "star", size=2, alpha=0.6, listed=not number, at=(time, flux)),
                Line("star and flares alone", "text", width=1.1, listed=not number, at=(time, mean)),
            ]
        x, y = Axis(f"time from the start of the stare ({unit})"), Axis("flux / quiescent")
        rows.append([Panel(x, y, series, band, finish)])
    title = f"{star.title}: one simulated stare; nominal throughput"
    return Picture(rows, (7.2, 1.5 * len(rows) + 0.9), title, below=True, share_x=True)


@styled_picture
def compare_light_curves(answers: Sequence[tuple[str, StareAnswer]], band: int = 0) -> Picture:
    """Plot light curves of titled answers, a row per star and a column per answer; band 0 is the whole range."""
    rows: list[list[Panel]] = [[] for _ in answers[0][1].stares]
    for title, answer in answers:
        for row, star in zip(rows, answer.stares, strict=True):
            light, stare = star.light, star.staring.stare
            scale, unit = time_unit(stare.duration_s)
            level, time = np.median(light.mean[:, band]), stare.middle_s / scale
            series = [
                Dots("", "star", size=1.3, at=(time, light.flux[:, band] / level)),
                Line("", width=1.1, at=(time, light.mean[:, band] / level)),
            ]
            above = f"{title}\n" if row is rows[0] else ""
            heading = f"{above}{star.title}, {light.bands[band]}"
            row.append(Panel(Axis(f"time ({unit})"), Axis("flux / quiescent"), series, heading))
    return Picture(rows, (3.7 * len(answers), 1.5 * len(rows) + 0.8), share_x=True, share_y="row")


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
    scale, unit = time_unit(stare.duration_s)
    # The stare is shown on a regular grid with empty gaps.
    numbers = stare.numbers - stare.numbers[0]
    step = -(-(int(numbers[-1]) + 1) // MOST_ROWS)
    rows = numbers // step
    n_rows = int(rows[-1]) + 1

    def summed(values: NDArray[Any]) -> Float:
        return np.array([np.bincount(rows, column, minlength=n_rows) for column in values.T]).T

    # Columns without frames are 0 / 0.
    with np.errstate(invalid="ignore", divide="ignore"):
        image = summed(spectra - np.median(spectra, axis=0)) / np.sqrt(summed(sd.astype(np.float64) ** 2))
    reach = max(3.0, float(np.nanpercentile(np.abs(image), 99.5)))
    half = (wavelength_nm[1] - wavelength_nm[0]) / 2 if wavelength_nm.size > 1 else 5.0
    time = np.arange(n_rows + 1) * step * stare.frame_s / scale
    nm = np.linspace(wavelength_nm[0] - half, wavelength_nm[-1] + half, wavelength_nm.size + 1)
    label = "standard deviations from the median"
    mesh = Mesh(label, low=-reach, high=reach, palette="RdBu_r", at=(time, nm, image.T))

    def finish(axis: Any) -> None:
        for ends, colour in marks:
            axis.plot(ends, [1.02, 1.02], transform=axis.get_xaxis_transform(), color=INK[colour], linewidth=3,
                      clip_on=False, solid_capstyle="butt")  # fmt: skip

    x = Axis(f"time from the start of the stare ({unit})", limits=(time[0], time[-1]))
    panel = Panel(x, Axis("wavelength (nm)", limits=(nm[0], nm[-1])), [mesh], finish=finish)
    return panel, step * stare.frame_s


def time_unit(duration_s: float) -> tuple[float, str]:
    """Return the length of the unit in which a duration is shown, and its name."""
    return next((length_s, name) for longest_s, length_s, name in TIME_UNITS if duration_s <= longest_s)


def _runs(numbers: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Return the runs of frames between gaps."""
    return np.split(np.arange(numbers.size), np.flatnonzero(np.diff(numbers) > 1) + 1)


#: Names of events by their colours.
EVENTS = {"star": "event", "drawn": "candidate", "flare": "look-alike"}
INKS = {"star": "blue", "drawn": "grey", "flare": "red"}
#: Flux in standard deviations above which the light curve has a second panel near the level.
BRIGHT = 30.0


def _since(analysis: Analysis, time_s: Any) -> tuple[Any, str]:
    """Return times from the first frame in the unit of the analysis's pictures, and this unit."""
    length_s, name = time_unit(float(np.ptp(analysis.frames.time_s)))
    return (time_s - analysis.frames.time_s[0]) / length_s, name


@picture_of("AnalyseAnswer", "light-curve")
def observed_light_curve(answer: AnalyseAnswer) -> Picture:
    """Plot the observed light curve with its level and the level's band of 95 %, events, and frames not searched.

    If there are bright events, a second panel shows the flux less the level.
    """
    analysis, used = answer.analysis, answer.analysis.level.used
    time, unit = _since(analysis, analysis.frames.time_s)
    level, error, off = analysis.level.level, analysis.level.error, 2 * analysis.level.level_error
    left_out, strips = ~used & np.isfinite(analysis.flux), list[Series]()
    for colour, name in EVENTS.items():
        events = [event for event in analysis.events if _colour(analysis, event) == colour]
        if events:
            frames = np.transpose([(event.first, event.last) for event in events])
            strips.append(Strips(name, colour, alpha=0.2, at=_since(analysis, analysis.survey.time_s[frames])[0]))

    def series(flux: Any, middle: Any, reach: Any) -> list[Series]:
        parts: list[Series] = [
            *strips,
            Dots("frames", "text", size=2.5, alpha=0.7, at=(time[used], flux[used])),
            Area("95 % of the level", "sky", alpha=0.3, at=(time, middle - reach, middle + reach)),
            Line("level without flares", "sky", width=1.6, at=(time, middle)),
        ]
        if left_out.any():
            parts.append(Dots("not searched", COLOURS[3], size=8, marker="x", at=(time[left_out], flux[left_out])))
        return parts

    x = Axis(f"time ({unit}) from {analysis.frames.date(float(analysis.frames.time_s[0]))[:19]}")
    label = f"flux ({analysis.frames.unit})" if analysis.frames.unit else "flux"
    around = float(np.min((analysis.flux - error)[used])), float(np.max((analysis.flux + error)[used]))
    # Frames that are left out may be far off.
    reach = around[1] - around[0]
    beside = [flux for flux in analysis.flux[left_out] if around[0] - reach < flux < around[1] + reach]
    around = min(*around, *beside) - 0.05 * reach, max(*around, *beside) + 0.05 * reach
    rows, excess = [[Panel(x, Axis(label, limits=around), series(analysis.flux, level, off))]], (analysis.flux - level)
    if (excess / error)[used].max() > BRIGHT:
        y = Axis("(flux \N{MINUS SIGN} level) / noise", limits=(-6, BRIGHT / 2))
        rows.append([Panel(x, y, series(excess / error, 0 * level, off / error))])
    title = f"{analysis.frames.name}: observed light curve; threshold of events {analysis.threshold:.2f}"
    return Picture(rows, (7.2, 1.4 + 1.8 * len(rows)), title, below=True, share_x=True)


def _colour(analysis: Analysis, event: ObservedEvent) -> str:
    """Return the colour of an event."""
    if event.kind != "flare":
        return "flare"
    return "star" if event.value >= analysis.threshold else "drawn"


@picture_of("AnalyseAnswer", "dynamic-spectrum", when=lambda answer: answer.analysis.spectra is not None)
def observed_dynamic_spectrum(answer: AnalyseAnswer) -> Picture:
    """Plot the searched spectra, in standard deviations from their median, and mark the events."""
    analysis, spectra = answer.analysis, answer.analysis.spectra
    assert spectra is not None
    stare, noise = analysis.survey.stare, spectra.noise
    sd = np.broadcast_to(noise.used, spectra.excess.shape)
    marks = []
    for event in analysis.events:
        first, last = (stare.start_s[k] - stare.start_s[0] for k in (event.first, event.last))
        ends = np.array([first, last + stare.frame_s]) / time_unit(stare.duration_s)[0]
        marks.append((ends, _colour(analysis, event)))
    panel, _ = spectra_panel(stare, spectra.excess, sd, noise.wavelength_nm, marks)
    shown = {_colour(analysis, event) for event in analysis.events}
    marked = ", ".join(f"{EVENTS[colour]}s ({INKS[colour]})" for colour in EVENTS if colour in shown)
    return Picture([[panel]], (7.2, 3.6), analysis.frames.name, (f"marked above: {marked}" if marked else "",))


@picture_of("AnalyseAnswer", "noise-per-pixel", when=lambda answer: answer.analysis.spectra is not None)
def observed_pixel_noise(answer: AnalyseAnswer) -> Picture:
    """Plot the measured over the stated noise of each pixel, with the range of 95 % of normal noise."""
    spectra = answer.analysis.spectra
    assert spectra is not None
    noise = spectra.noise
    nm, series = noise.wavelength_nm, list[Series]()
    series.append(Area("95 % of normal noise", at=(nm, noise.low / noise.stated, noise.high / noise.stated)))
    for name, which, colour in (("measured", ~noise.departs, "star"), ("measured, departs", noise.departs, "flare")):
        if which.any():
            series.append(Dots(name, colour, size=4, at=(nm[which], (noise.measured / noise.stated)[which])))
    panel = Panel(Axis("wavelength (nm)"), Axis("measured / stated noise"), series)
    return Picture([[panel]], (4.6, 3.5), f"{answer.analysis.frames.name}: noise of quiescent frames", below=True)


@picture_of("AnalyseAnswer", "residuals")
def observed_residuals(answer: AnalyseAnswer) -> Picture:
    """Plot the residuals of the fitted process against time, their autocorrelation, and their quantiles."""
    analysis = answer.analysis
    residual, likeness = analysis.residual[:, 0], analysis.likeness
    time, unit = _since(analysis, analysis.survey.time_s[analysis.quiet])
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
        Panel(Axis(f"time ({unit})"), Axis("residual (standard deviations)"), course),
        Panel(Axis("lag (frames)"), Axis("autocorrelation"), correlation,
              finish=lambda axis: axis.xaxis.get_major_locator().set_params(integer=True)),
        Panel(Axis("normal quantile"), Axis("quantile of the residuals"), quantiles),
    ]  # fmt: skip
    title = f"{analysis.frames.name}: residuals of the fitted process, {analysis.level.process.name}"
    return Picture([row], (9.6, 2.9), title, ("grey: 95 % of independent, normal noise",), widths=(2, 1, 1))


SCATTER = Chart(
    "scatter", "Noise of quiescent frames", Axis("frames in a mean", log=True),
    Axis("scatter (noise of one frame)", log=True),
    (
        Area("95 % of independent frames", name="range", alpha=0.4),
        Line("independent frames", name="white"),
        Dots("measured", "star", size=8, tips=("frames", "scatter")),
    ),
)  # fmt: skip


def scatter_series(answer: AnalyseAnswer) -> dict[str, Any]:
    """Return the data of `SCATTER`, or nothing if there are too few quiescent frames."""
    rows = answer.analysis.scatter
    if len(rows) < 2:
        return {}
    x, low, high, white, measured = np.array([(r.frames, r.low, r.high, r.white, r.measured) for r in rows]).T
    return {"range": (x, low, high), "white": (x, white), "measured": (x, measured)}


@picture_of("AnalyseAnswer", "noise", when=lambda answer: len(answer.analysis.scatter) > 1)
def observed_noise(answer: AnalyseAnswer) -> Picture:
    """Plot the scatter of means of quiescent frames against their number, and that of independent frames."""
    panel, title = SCATTER.panel(scatter_series(answer)), f"{answer.analysis.frames.name}: quiescent frames"
    panel = replace(panel, x=replace(panel.x, ticks=([row.frames for row in answer.analysis.scatter],)))
    return Picture([[panel]], (4.6, 3.2), title)
