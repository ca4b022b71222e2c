"""Pictures of changes between visits: against magnitude, line indices, and recovered periods."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import COLOURS, NULL, headline, plain_numbers, styled_picture
from mauvecl.study.parts import First

if TYPE_CHECKING:
    from mauvecl.answers.observations.change import ChangeAnswer

#: Changes whose periods are drawn, at most.
MOST = 3
#: Nanometres on both sides of an index that are drawn.
AROUND_NM = 15.0


@picture_of("ChangeAnswer", "change", when=lambda answer: bool(answer.along))
@styled_picture
def change_against_magnitude(plt: Any, answer: ChangeAnswer) -> Any:
    """Plot the smallest detectable changes against the magnitude of the star, one panel for each unit."""
    units = list(dict.fromkeys(row.change.unit for row in answer.along))
    figure, axes = plt.subplots(1, len(units), figsize=(1.0 + 3.3 * len(units), 3.6), squeeze=False)
    titles = First(list(dict.fromkeys(row.title for row in answer.changes)), 1, "stars")
    (title,) = titles
    for axis, unit in zip(axes[0], units, strict=True):
        names = list(dict.fromkeys(row.change.name for row in answer.along if row.change.unit == unit))
        for colour, name in zip(cycle(COLOURS), names, strict=False):
            own = [one for one in answer.along if one.change.name == name]
            own = own[: len(own) // answer.many]
            x = np.array([row.magnitude for row in own])
            y = np.array([row.smallest.one for row in own]) * (1 if unit else 100)
            if np.isfinite(y).any():
                axis.plot(x[np.isfinite(y)], y[np.isfinite(y)], color=colour, label=name)
        magnitude = answer.study.star[0].magnitude
        if magnitude is not None:
            axis.axvline(magnitude, color=NULL, linewidth=0.8, linestyle=":")
        axis.set(xlabel=f"magnitude ({answer.study.star[0].band})", ylabel=f"smallest change ({unit or '%'})")
        # Without a pixel that does not saturate there is nothing to show.
        if axis.get_legend_handles_labels()[1]:
            axis.set(yscale="log")
            plain_numbers(axis)
            axis.legend()
    visits, exposure = answer.study.change.visits, answer.study.observation.exposure_s
    headline(figure, f"{title}: smallest change between {visits} visits of {exposure:g} s", titles.note)
    return figure


@picture_of("ChangeAnswer", "periods", when=lambda answer: bool(answer.periods))
@styled_picture
def recovered_periods(plt: Any, answer: ChangeAnswer) -> Any:
    """Plot the share of recovered periods over period and semi-amplitude, for the first changes."""
    first = First(answer.periods, MOST, "changes")
    some = list(first)
    figure, axes = plt.subplots(1, len(some), figsize=(1.0 + 2.9 * len(some), 3.2), squeeze=False)
    for axis, row in zip(axes[0], some, strict=True):
        r = row.recovery
        shares = row.shares("value").reshape(r.amplitudes.size, r.periods_d.size)
        scale = row.error * (1 if row.change.unit else 100)
        mesh = axis.pcolormesh(r.periods_d, scale * r.amplitudes, 100 * shares, vmin=0, vmax=100, shading="nearest",
                               cmap="viridis")  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel="period (d)", ylabel=f"semi-amplitude ({row.change.unit or '%'})",
                 title=row.change.name)  # fmt: skip
        plain_numbers(axis)
    figure.colorbar(mesh, ax=list(axes[0]), label="recovered (%)")
    time = some[0].recovery.time_d
    text = f"{some[0].title}: periods that {time.size} visits within {np.ptp(time):.0f} days recover"
    headline(figure, text, first.note)
    return figure


@picture_of("ChangeAnswer", "indices", when=lambda answer: bool(answer.indices))
@styled_picture
def line_indices(plt: Any, answer: ChangeAnswer) -> Any:
    """Plot the mean calibrated spectrum around each line index, with its band and continuum."""
    title = answer.indices[0].title
    some = [row for row in answer.indices if row.title == title]
    figure, axes = plt.subplots(1, len(some), figsize=(1.0 + 2.3 * len(some), 2.8), squeeze=False)
    for axis, row in zip(axes[0], some, strict=True):
        index, nm, flux = row.value.index, row.wavelength_nm, row.flux
        low, high = index.continuum_nm[0][0] - AROUND_NM, index.continuum_nm[-1][1] + AROUND_NM
        near = (nm > low) & (nm < high)
        axis.plot(nm[near], flux[near], color=COLOURS[0])
        axis.axvspan(*index.band_nm, color=COLOURS[3], alpha=0.3, linewidth=0)
        for window in index.continuum_nm:
            axis.axvspan(*window, color=NULL, alpha=0.2, linewidth=0)
        axis.set(xlabel="nm", title=index.name)
    axes[0, 0].set_ylabel("erg / (s cm² nm)")
    headline(figure, f"{title}: bands (orange) and continua (grey) of the line indices, mean spectrum")
    return figure
