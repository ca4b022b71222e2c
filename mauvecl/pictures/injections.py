"""Pictures of completeness: maps over half-width and size, curves and recovered energies."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import COLOURS, MAX_COLUMNS, STYLE, canvas, headline, legend_below, save_or_return
from mauvecl.study.parts import First, part_note

if TYPE_CHECKING:
    from mauvecl.answers.stares.inject import InjectAnswer

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
CONTOURS = (0.1, 0.5, 0.9)


def _panels(answer: InjectAnswer) -> tuple[Any, First[Any], list[Any]]:
    stars = First(answer.stars, MOST_MAPS, "stars")
    columns = min(len(stars), MAX_COLUMNS)
    rows = -(-len(stars) // columns)
    figure, axes = canvas().subplots(rows, columns, figsize=(3.6 * columns + 0.8, 3.2 * rows), squeeze=False)
    for axis in axes.flat[len(stars) :]:
        axis.set_visible(False)
    return figure, stars, list(axes.flat)


def _titled(figure: Any, answer: InjectAnswer, *notes: str) -> None:
    choice, flare = answer.study.search, answer.study.flare
    alarms = "false alarm" if choice.false_alarms == 1 else "false alarms"
    headline(
        figure,
        f"Flares of {flare.light().describe()}, {choice.false_alarms:g} {alarms} per star-{choice.per}; nominal "
        "throughput",
        *notes,
    )


@picture_of("InjectAnswer", "completeness")
def maps(answer: InjectAnswer, path: str | Path | None) -> Any:
    """Plot completeness over half-width and size, one panel per star; without a path, return the figure."""
    with canvas().rc_context(STYLE):
        figure, stars, axes = _panels(answer)
        mesh = None
        for star, axis in zip(stars, axes, strict=False):
            x, y, z = np.array(star.injected.half_widths_s), star.injected.sizes, star.injected.completeness.T
            axis.set(xscale="log", yscale="log", xlabel="half-width (s)", ylabel=SIZES[star.sizes.of], title=star.title)
            if x.size < 2:
                # A single half-width defines no cell width.
                axis.plot(star.injected.completeness[0], y)
                axis.set(xscale="linear", xlabel="completeness")
                continue
            mesh = axis.pcolormesh(_edges(x), _edges(y), z, cmap="cividis", vmin=0, vmax=1)
            lines = axis.contour(x, y, z, levels=CONTOURS, colors="white", linewidths=1)
            axis.clabel(lines, fmt=lambda level: f"{100 * level:g} %", fontsize=7)
        if mesh is not None:
            figure.colorbar(mesh, ax=axes, label="completeness")
        _titled(figure, answer, stars.note)
        return save_or_return(figure, path)


@picture_of("InjectAnswer", "curves")
def curves(answer: InjectAnswer, path: str | Path | None) -> Any:
    """Plot completeness over size at some half-widths, with 95 % intervals; without a path, return the figure."""
    with canvas().rc_context(STYLE):
        figure, stars, axes = _panels(answer)
        widths = len(stars[0].injected.half_widths_s)
        for star, axis in zip(stars, axes, strict=False):
            f = star.injected
            picked = np.unique(np.linspace(0, len(f.half_widths_s) - 1, MOST_CURVES).round().astype(int))
            for k, colour in zip(picked, cycle(COLOURS), strict=False):
                axis.fill_between(
                    f.sizes, f.completeness_low[k], f.completeness_high[k], color=colour, alpha=0.25, linewidth=0
                )
                axis.plot(f.sizes, f.completeness[k], color=colour, label=f"half-width {f.half_widths_s[k]:.0f} s")
            for power in (0.5, 0.9):
                axis.axhline(power, color="black", linewidth=0.6, linestyle="--")
            axis.set(
                xscale="log", xlabel=SIZES[star.sizes.of], ylabel="completeness", ylim=(-0.02, 1.02), title=star.title
            )
        legend_below(figure, *axes[0].get_legend_handles_labels())
        _titled(figure, answer, stars.note, part_note(min(MOST_CURVES, widths), widths, "half-widths"))
        return save_or_return(figure, path)


@picture_of("InjectAnswer", "energies", when=lambda answer: all(star.fitted for star in answer.stars))
def energies(answer: InjectAnswer, path: str | Path | None) -> Any:
    """Plot recovered over injected energy of found flares; without a path, return the figure."""
    with canvas().rc_context(STYLE):
        figure, stars, axes = _panels(answer)
        mesh = None
        for star, axis in zip(stars, axes, strict=False):
            x, y = np.array(star.injected.half_widths_s), star.injected.sizes
            axis.set(xscale="log", yscale="log", xlabel="half-width (s)", ylabel=SIZES[star.sizes.of], title=star.title)
            if x.size > 1:
                z = np.log10(star.fitted.energy_ratio.T)
                mesh = axis.pcolormesh(_edges(x), _edges(y), z, cmap="RdBu_r", vmin=-0.3, vmax=0.3)
        if mesh is not None:
            figure.colorbar(mesh, ax=axes, label="recovered over injected energy, median (dex)")
        _titled(figure, answer, stars.note)
        return save_or_return(figure, path)


def _edges(middles: Any) -> Any:
    """Return the edges of cells whose centres are about evenly spaced in the logarithm."""
    steps = np.sqrt(middles[1:] / middles[:-1])
    return np.concatenate([[middles[0] / steps[0]], middles[:-1] * steps, [middles[-1] * steps[-1]]])
