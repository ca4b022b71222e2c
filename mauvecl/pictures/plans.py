"""Pictures for planning: maps, limits, noise budgets, S/N over a sweep, exposures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.detection.requests import label
from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import (
    COLOURS,
    COLUMN,
    NULL,
    UNBROKEN,
    headline,
    legend_below,
    plain_numbers,
    styled_picture,
)
from mauvecl.study.labels import full_label
from mauvecl.study.quantities import QUANTITIES

if TYPE_CHECKING:
    from mauvecl.answers.detection.gaussian import GaussianAnswer
    from mauvecl.answers.detection.maps import MapAnswer
    from mauvecl.answers.limits.limits import LimitAnswer
    from mauvecl.answers.signal.exposures import ExposureAnswer
    from mauvecl.answers.signal.snr import SnrAnswer
    from mauvecl.host.exposure.expectation import Expectation


#: Probabilities of contours, in ascending order.
STROKES = (":", "--", "-", "-.")


@picture_of("MapAnswer", "map")
@styled_picture
def detection_map(plt: Any, answer: MapAnswer) -> Any:
    """Plot the detection probability over two quantities, one panel per statistic."""
    question = answer.study.map
    figure, axes = plt.subplots(
        1, len(answer.statistics), figsize=(COLUMN * len(answer.statistics) + 0.5, 3.4), squeeze=False, sharey=True
    )
    lines = {}
    x, y = (
        np.arange(len(values)) if isinstance(values[0], str) else np.array(values, float)
        for values in (answer.x, answer.y)
    )
    for axis, statistic, probability in zip(axes[0], answer.statistics, answer.probability, strict=True):
        mesh = axis.pcolormesh(x, y, probability, cmap="cividis", vmin=0, vmax=1, shading="nearest")
        if min(probability.shape) > 1:
            # Lines are close where a map is steep, so line styles distinguish them instead of labels.
            levels = sorted(question.contours)
            strokes = [STROKES[k % len(STROKES)] for k in range(len(levels))]
            axis.contour(x, y, probability, levels=levels, colors="white", linewidths=2.4)
            axis.contour(x, y, probability, levels=levels, colors="black", linewidths=1.2, linestyles=strokes)
            lines = {f"{100 * level:g} %": stroke for level, stroke in zip(levels, strokes, strict=True)}
        for which, values, place in (("x", answer.x, x), ("y", answer.y, y)):
            described = getattr(question, which)
            if isinstance(values[0], str):
                getattr(axis, f"set_{which}ticks")(place, values)
            elif described.log:
                getattr(axis, f"set_{which}scale")("log")
        axis.set_xlabel(QUANTITIES[question.x.quantity].label)
        axis.set_title(label(statistic))
        plain_numbers(axis)
    axes[0][0].set_ylabel(QUANTITIES[question.y.quantity].label)
    figure.colorbar(mesh, ax=list(axes[0]), label="detection probability")
    if lines:
        shown = [plt.Line2D([], [], color="black", linewidth=1.2, linestyle=stroke) for stroke in lines.values()]
        legend_below(figure, shown, [f"detected in {name}" for name in lines])
    names = {question.x.quantity, question.y.quantity}
    exposure = "" if "exposure" in names else f", {answer.study.observation.exposure_s:g} s"
    flare = "" if "amplitude" in names else f", flare of {100 * answer.study.flare.amplitudes[0]:g} %"
    headline(
        figure,
        f"{answer.star}{exposure}{flare}, false-alarm probability {answer.study.run.fap:g} per test; nominal "
        "throughput",
    )
    return figure


@picture_of("LimitAnswer", "limit")
@styled_picture
def limits(plt: Any, answer: LimitAnswer) -> Any:
    """Plot the detection probability at every simulated value, and the limits."""
    of, power = answer.study.limit.of, answer.study.limit.power
    figure, axis = plt.subplots(figsize=(COLUMN, 3.0 + 0.17 * len(answer.limits)))
    for k, limit in enumerate(answer.limits):
        colour, marker = COLOURS[k % len(COLOURS)], "osD^vPX"[k // len(COLOURS) % 7]
        points = sorted((*limit.points, limit.check), key=lambda p: p.value)
        p = [point.probability for point in points]
        error = [[q.value - q.low for q in p], [q.high - q.value for q in p]]
        flare = "" if np.isnan(limit.amplitude) else f", {100 * limit.amplitude:g} %"
        text = f"{limit.star}{flare}, {limit.statistic}: {limit.value.value:.4g}"
        axis.errorbar(
            [point.value for point in points],
            [q.value for q in p],
            error,
            fmt=marker,
            ms=4,
            color=colour,
            label=text,
        )
        axis.plot(*zip(*sorted(limit.curve), strict=True), color=colour, linewidth=0.9)
        axis.axvspan(limit.value.low, limit.value.high, color=colour, alpha=0.25, linewidth=0)
    axis.axhline(power, color="black", linewidth=0.8, linestyle="--")
    if of != "magnitude":
        axis.set_xscale("log")
    axis.set(xlabel=QUANTITIES[of].label, ylabel="detection probability", ylim=(-0.02, 1.02))
    plain_numbers(axis)
    exposure = "" if of == "exposure" else f", {answer.study.observation.exposure_s:g}{UNBROKEN}s"
    headline(
        figure,
        f"Limits at a power of {power:g}{exposure}, false-alarm probability {answer.study.run.fap:g} per test; "
        "points: simulated, 95 %; lines: Gaussian noise; nominal throughput",
    )
    legend_below(figure, *axis.get_legend_handles_labels())
    return figure


#: Labels and colours of noise by origin: the paper's colours where colour-blind readers can distinguish them.
ORIGINS = {
    "source_photon": ("source photons", "#009E73"),
    "dark": ("dark current", "#CC79A7"),
    "read": ("read noise", "#E69F00"),
    "zodiacal_photon": ("zodiacal photons", "#0072B2"),
    "neighbour_photon": ("neighbours' photons", "#D55E00"),
    "total": ("total", "#000000"),
}


@picture_of("SnrAnswer", "noise-budget")
def noise_budgets(answer: SnrAnswer, path: str | Path | None = None) -> Any:
    """Plot pixel noise by origin against wavelength, one panel per star and cell, as in the paper."""
    each = answer.study.sweep.size
    observed = [(star, star.result.expectation) for star in answer.stars]
    named = [(star.title if star.at else f"{star.title}, {x.exposure_s:g} s", x) for star, x in observed]
    return noise_budget(named, each=each, path=path)


@styled_picture
def noise_budget(plt: Any, observed: Sequence[tuple[str, Expectation]], *, each: int = 1) -> Any:
    """Plot pixel noise by origin against wavelength for titled expectations, in `each` columns."""
    stars = len(observed) // each
    figure, axes = plt.subplots(
        stars, each, figsize=(COLUMN * min(each, 6), 2.3 * stars + 0.7), squeeze=False, sharex=True, sharey="col"
    )
    for k, (title, x) in enumerate(observed):
        axis, budget = axes[k % stars][k // stars], x.noise_budget()
        for name, (text, colour) in ORIGINS.items():
            if name not in budget.colnames:
                continue
            axis.plot(budget["wavelength"].value, budget[name].value, color=colour, label=text, linewidth=1.0)
        axis.set_title(title)
        axis.set_yscale("log")
        axis.set_xlim(200, 700)
    # The axis is limited, since zodiacal light can be far below everything else.
    for axis in axes.ravel():
        axis.set_ylim(bottom=max(axis.get_ylim()[0], axis.get_ylim()[1] * 1e-4))
    for axis in axes[:, 0]:
        axis.set_ylabel("noise (DN rms per pixel)")
    for axis in axes[-1]:
        axis.set_xlabel("wavelength (nm)")
    handles, names = axes[0][0].get_legend_handles_labels()
    legend_below(figure, handles, names)
    headline(figure, "Noise budgets; nominal throughput, not a flight calibration")
    return figure


@picture_of("SnrAnswer", "snr-sweep", when=lambda answer: answer.study.sweep.axes)
@styled_picture
def snr_sweep(plt: Any, answer: SnrAnswer) -> Any:
    """Plot the S/N of some elements against the first swept quantity, a line per value of the others."""
    from mauvecl.answers.signal.exposures import place_of

    first = answer.study.sweep.axes[0].quantity
    shown = answer.stars[0].shown_nm
    tables = [star.result.element for star in answer.stars]
    figure, axes = plt.subplots(
        1, len(shown), figsize=(COLUMN if len(shown) == 1 else 2.6 * len(shown), 3.2), squeeze=False, sharey=True
    )
    for axis, wavelength in zip(axes[0], shown, strict=True):
        lines: dict[str, list[tuple[Any, Any]]] = {}
        for star, table in zip(answer.stars, tables, strict=True):
            name = star.label if first != "magnitude" else star.label.split(" V = ")[0]
            rest = full_label(name, {k: v for k, v in star.at.items() if k != first})
            row = table[place_of(star.result.expectation, wavelength, "element")]
            lines.setdefault(rest, []).append((star.at[first], row))
        for k, (name, points) in enumerate(lines.items()):
            x = [value for value, _ in points]
            low, high = ([max(row[q], 1e-3) for _, row in points] for q in ("q2.5", "q97.5"))
            colour = COLOURS[k % len(COLOURS)]
            axis.fill_between(x, low, high, color=colour, alpha=0.25, linewidth=0)
            axis.plot(x, [row["expected"] for _, row in points], "o-", color=colour, ms=3, label=name)
        axis.set_yscale("log")
        if first == "exposure":
            axis.set_xscale("log")
        axis.set_title(f"{wavelength:g} nm")
        axis.set_xlabel(QUANTITIES[first].label)
    # The common scale is set after all panels are drawn.
    axes[0][0].set_ylim(bottom=0.1)
    for axis in axes[0]:
        plain_numbers(axis)
    axes[0][0].set_ylabel("S/N per 10.5 nm element")
    handles, names = axes[0][0].get_legend_handles_labels()
    legend_below(figure, handles, names)
    headline(figure, "S/N: closed form, and 95 % of realisations; nominal throughput")
    return figure


@picture_of("GaussianAnswer", "gaussian")
@styled_picture
def gaussian(plt: Any, answer: GaussianAnswer) -> Any:
    """Plot how well each prediction of the Gaussian formula holds in every cell."""
    from matplotlib.ticker import MaxNLocator

    cells = answer.cells
    # Column, label, predicted value, and smallest range of the axis on either side of it.
    panels = (
        ("snr_off_by", "mean S/N\nless formula", 0.0, 0.1),
        ("coverage_low", "share of 1-sigma\nintervals right", 0.6827, 0.03),
        ("five_sigma_above", "pixels 5 sigma above,\nover normal", 1.0, 0.5),
        ("fap_ratio", "false alarms\nover promised", 1.0, 0.2),
    )
    figure, axes = plt.subplots(1, len(panels), figsize=(2 * COLUMN, 0.22 * len(cells) + 1.5), sharey=True)
    rows = np.arange(len(cells))
    for axis, (column, text, promised, least) in zip(axes, panels, strict=True):
        if column == "coverage_low":
            axis.hlines(rows, cells["coverage_low"], cells["coverage_high"], color=COLOURS[0], linewidth=3)
        else:
            axis.plot(cells[column], rows, "o", color=COLOURS[0], ms=4)
        axis.axvline(promised, color=NULL, linewidth=1)
        low, high = axis.get_xlim()
        axis.set_xlim(min(low, promised - least), max(high, promised + least))
        axis.set_xlabel(text)
        axis.xaxis.set_major_locator(MaxNLocator(3, prune="both"))
        axis.grid(axis="y", linewidth=0.3)
    axes[0].set_yticks(rows, [full_label(s.label, s.at) for s in answer.signal.stars])
    axes[0].invert_yaxis()
    headline(figure, "The root-of-N formula and the simulation; grey: as promised; nominal throughput")
    return figure


@picture_of("ExposureAnswer", "exposure")
@styled_picture
def exposures(plt: Any, answer: ExposureAnswer) -> Any:
    """Plot the S/N of each star against exposure."""
    figure, axis = plt.subplots(figsize=(COLUMN, 2.9 + 0.17 * len(answer.exposures)))
    for k, e in enumerate(answer.exposures):
        colour = COLOURS[k % len(COLOURS)]
        x = np.geomspace(e.exposure_s / e.frames, 4 * e.exposure_s, 50)
        axis.plot(x, e.snr * np.sqrt(x / e.exposure_s), color=colour, label=f"{e.star}: {e.exposure_s:g} s")
        axis.plot([e.exposure_s], [e.snr], "o", color=colour, ms=5)
    first = answer.exposures[0]
    axis.axhline(first.wanted, color=NULL, linestyle="--", linewidth=1)
    axis.set(xscale="log", yscale="log", xlabel="exposure (s)", ylabel=f"S/N per {first.per}")
    plain_numbers(axis)
    headline(figure, f"S/N at {first.wavelength_nm:g} nm; dashed: the one wanted; nominal throughput")
    legend_below(figure, *axis.get_legend_handles_labels())
    return figure
