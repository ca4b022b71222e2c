"""Tabs of observations: light curves, calibrations, changes between visits, and campaigns."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from bokeh.models import FixedTicker, HoverTool, LinearColorMapper
from bokeh.palettes import interp_palette

from mauvecl.answers.plan import COLUMNS
from mauvecl.charts import chart, light_curves, spectra
from mauvecl.charts.chart import Chart, ChartData, Custom, OwnMarker, PlotAxis, Targets
from mauvecl.host.arrays import PER_MAD
from mauvecl.host.stars.source import Source
from mauvecl.schema.errors import InputError
from mauvecl.web.closed_forms import Answers, short
from mauvecl.web.sandboxed_reader import read_limited
from mauvecl.web.tab import Tab, target_words
from mauvecl.web.uploads import MOST_VALUES, VisitorFile, read_frames_of, unzipped

if TYPE_CHECKING:
    from bokeh.models.sources import ColumnDataSource

    from mauvecl.answers.change import ChangeAnswer
    from mauvecl.answers.plan import PlanAnswer
    from mauvecl.answers.visible import VisibleAnswer
    from mauvecl.observations.analysis import Analysis
    from mauvecl.observations.frames import Frames
    from mauvecl.web.closed_forms import ClosedForms, FieldValues
    from mauvecl.web.tab import Canvas
    from mauvecl.web.uploads import Observations

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
    """Read the frames."""
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
    """Read frames and spectra."""
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
    """Return the chart of the smallest changes of some units, with the factor from each to that of the axis."""

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
    headings = [column.heading for column in COLUMNS if column.heading and column.when is None]
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
