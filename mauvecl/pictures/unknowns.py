"""Pictures of the cost of unknowns: power against amplitude, and the unknown that limits each star."""

from __future__ import annotations

from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.pictures.registry import picture_of
from mauvecl.pictures.style import COLOURS, styled_picture
from mauvecl.study.quantities import QUANTITIES

if TYPE_CHECKING:
    from mauvecl.answers.detection.unknown_table import UnknownAnswer


@picture_of("UnknownAnswer", "unknowns")
@styled_picture
def unknowns(plt: Any, answer: UnknownAnswer) -> Any:
    """Plot closed-form power per star (dashed plain, solid marginalised), and the smallest amplitudes."""
    from mauvecl.answers.detection.unknown_table import power

    stars = list(dict.fromkeys(star for star, _ in answer.costs))
    names = list(next(iter(answer.costs.values())))
    fap = answer.study.run.fap
    figure = plt.figure(figsize=(2.6 * len(stars) + 1.6, 5.2))
    grid = figure.add_gridspec(2, len(stars))
    for k, star in enumerate(stars):
        axis = figure.add_subplot(grid[0, k])
        amplitude, costs = next((a, c) for (s, a), c in answer.costs.items() if s == star)
        relative = np.geomspace(0.03, 300.0, 200) * answer.smallest(star, None)
        known = next(iter(costs.values())).known
        axis.plot(
            relative, power(known * relative / amplitude, fap), color="black", linewidth=3, label="everything known"
        )
        for colour, (unknown, cost) in zip(cycle(COLOURS), costs.items(), strict=False):
            axis.plot(relative, power(cost.marginal * relative / amplitude, fap), color=colour, label=unknown)
            axis.plot(relative, power(cost.plain * relative / amplitude, fap), color=colour, linestyle="--")
        axis.set(xscale="log", xlabel=QUANTITIES["amplitude"].label, ylim=(-0.02, 1.02), title=star)
        if k == 0:
            axis.set_ylabel("detection probability")
    axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title="solid: marginalised\ndashed: plain")
    below = figure.add_subplot(grid[1, :])
    width = 0.8 / (len(names) + 1)
    every: list[str | None] = [None, *names]
    for i, name in enumerate(every):
        values = [answer.smallest(star, name) for star in stars]
        place = np.arange(len(stars)) + (i - len(names) / 2) * width
        below.bar(place, values, width, color="black" if name is None else COLOURS[(i - 1) % len(COLOURS)])
    below.set(yscale="log", ylabel="smallest flare amplitude", xticks=range(len(stars)), xticklabels=stars)
    below.set_title(
        f"Detected with a probability of {answer.study.limit.power:g}, marginalised over each unknown; "
        f"false-alarm probability {fap:g} per test"
    )
    return figure
