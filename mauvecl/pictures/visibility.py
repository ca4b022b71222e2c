"""Pictures of the visibility of targets from the orbit."""

from __future__ import annotations

import calendar as months_of_years
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import STYLE, canvas, headline, save_or_return

if TYPE_CHECKING:
    from mauvecl.answers.campaigns.visible import VisibleAnswer

#: Largest number of targets with a calendar each; more targets are rows of one picture.
MOST_CALENDARS = 6


@picture_of("VisibleAnswer", "visible")
def calendar(answer: VisibleAnswer, path: str | Path | None) -> Any:
    """Plot daily hours of exposure: a calendar per target or, for many targets, a row."""
    plt = canvas()
    draw = _calendars if len(answer.targets) <= MOST_CALENDARS else _rows
    with plt.rc_context(STYLE):
        figure = draw(plt, answer)
        kind = "mean orbit" if answer.study.orbit.orbit().resolved(answer.times) == "mean" else "SGP4"
        headline(figure, f"Hours of exposure a day ({kind}); limits are assumptions, no stray light")
        return save_or_return(figure, path)


def _calendars(plt: Any, answer: VisibleAnswer) -> Any:
    """Plot calendars with days of the month across and months down."""
    n = len(answer.targets)
    across = 1 if n == 1 else 2
    down = -(-n // across)
    months = sorted({day[:7] for day in answer.days})
    height = max(1.3, 0.17 * len(months) + 0.8)
    figure, axes = plt.subplots(down, across, figsize=(3.9 * across + 0.8, height * down + 0.4), squeeze=False)
    hours = np.array([answer.visibility.by_day(k) for k in range(n)])
    most = max(float(hours.max()), 0.1)
    mesh = None
    for k, one in enumerate(answer.targets):
        axis = axes.flat[k]
        grid = np.full((len(months), 31), np.nan)
        for day, value in zip(answer.days, hours[k], strict=True):
            grid[months.index(day[:7]), int(day[8:]) - 1] = value
        mesh = axis.pcolormesh(np.arange(1, 32), np.arange(len(months)), grid, cmap="cividis", vmin=0, vmax=most,
                               shading="nearest", edgecolors="white", linewidth=0.2)  # fmt: skip
        step = max(1, len(months) // 14)
        axis.set_yticks(np.arange(0, len(months), step), [_month(name) for name in months[::step]], fontsize=7)
        axis.set_xticks([1, 8, 15, 22, 29])
        axis.invert_yaxis()
        total = answer.visibility.hours[k]
        axis.set_title(f"{one.name}: {total:.0f} h in {answer.times.days:g} d")
    for axis in axes.flat[n:]:
        axis.set_visible(False)
    for axis in axes[-1]:
        axis.set_xlabel("day of the month (UTC)")
    figure.colorbar(mesh, ax=list(axes.flat[:n]), label="hours a day")
    return figure


def _rows(plt: Any, answer: VisibleAnswer) -> Any:
    """Plot targets as rows and days as columns."""
    n = len(answer.targets)
    figure, axis = plt.subplots(figsize=(7.4, min(0.16 * n + 1.4, 20.0)))
    hours = np.array([answer.visibility.by_day(k) for k in range(n)])
    mesh = axis.pcolormesh(np.arange(len(answer.days)), np.arange(n), hours, cmap="cividis", vmin=0, shading="nearest",
                           rasterized=True)  # fmt: skip
    step = max(1, n // 60)
    axis.set_yticks(np.arange(0, n, step), [one.name for one in answer.targets[::step]], fontsize=6)
    firsts = [i for i, day in enumerate(answer.days) if day.endswith("-01")]
    step = max(1, len(firsts) // 13)
    axis.set_xticks(firsts[::step], [_month(answer.days[i]) for i in firsts[::step]], fontsize=7)
    axis.invert_yaxis()
    figure.colorbar(mesh, ax=axis, label="hours a day")
    return figure


def _month(day: str) -> str:
    return f"{months_of_years.month_abbr[int(day[5:7])]} {day[2:4]}"
