"""Cost of unknown properties of the instrument."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.answers.detection.unknown_cost import spoken, unknown_cost
from mauvecl.answers.detection.unknown_table import COLUMNS, power
from mauvecl.noise.unknowns import NUISANCES, Amplitude
from mauvecl.schema.tables import View
from mauvecl.study.nuisances import NuisanceChoice
from mauvecl.web.figures import Canvas
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import ClosedForms

#: Name of an unknown, and the matched S/N plain and marginalised.
Row = tuple[str, float, float]


@lru_cache(maxsize=4)
def costs(closed: ClosedForms) -> tuple[float, list[Row]]:
    """Return the flare's matched S/N with everything known, and with unknowns alone and together."""
    # Without a sky its brightness is no unknown. Those without a default prior are projected out.
    there = {name: row for name, row in NUISANCES.items() if np.any(row.spectrum(closed.quiet))}
    alone = [NuisanceChoice.model_validate({name: _spread(row.prior)}) for name, row in there.items()]
    chosen = {spoken(choice).removeprefix("the "): choice for choice in alone}
    chosen["all the usual together"] = NuisanceChoice(usual=True)
    if closed.study.nuisances.own:
        chosen["your own spectrum"] = NuisanceChoice(own=closed.study.nuisances.own)
    rows, known = list[Row](), 0.0
    for name, choice in chosen.items():
        cost = unknown_cost(name, closed.quiet, closed.flare, choice, closed.study.run.comparison())
        known = cost.known or known
        rows.append((name, cost.plain, cost.marginal))
    return known, rows


def _spread(prior: object) -> float | str:
    return prior.sd if isinstance(prior, Amplitude) and np.isfinite(prior.sd) else "free"


class Cost(Picture):
    """Matched S/N with each unknown, plain and marginalised."""

    name, title = "cost", "What each unknown costs: the flare's S/N by the matched statistic"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "S/N of the flare", "", logs, y_range=["nothing"])
        source = canvas.source("bars", "name", "plain", "marginal", "known")
        plot: Any = canvas.plot
        for column, called, colour, width, alpha, form in (
            ("known", "everything known", "flare", 0.85, 0.35, "band"),
            ("marginal", "marginalised over it", "flare", 0.55, 1.0, "bar"),
            ("plain", "unknown, and not looked for", "text", 0.2, 1.0, "bar"),
        ):
            how = {"color": ink[colour], "alpha": alpha, "name": called}
            made = plot.hbar("name", right=column, height=width, source=source, **how)
            canvas.legend.append((called, ink[colour], form, ""))
            canvas.tooltips(made, (called, column), mode="hline")
        plot.x_range.start = 0
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        known, rows = costs(closed)
        names = [name for name, *_ in rows][::-1]
        columns: dict[str, Any] = {"name": names}
        columns["plain"], columns["marginal"] = (np.array([row[k] for row in rows[::-1]]) for k in (1, 2))
        columns["known"] = np.full(len(rows), known)
        worst = min(rows, key=lambda row: row[2])
        text = (
            f"With everything known the flare has a matched S/N of {known:.3g}; {worst[0]} leaves {worst[2]:.3g} "
            "of it, the least of these."
        )
        return PictureData(text, {"bars": columns}, {"y range": {"factors": names}})


class Unknown(Tab):
    """Cost of unknown properties of the instrument."""

    name, title = "unknowns", "Unknowns"
    about = (
        "What it costs not to know the detector's temperature, the light lost, or the sky: a statistic that is blind "
        "to them sees less of the flare; one that ignores them is fooled by them."
    )
    pictures = (Cost(),)

    def shown(self, closed: ClosedForms, answers: Answers) -> View:
        known, rows = costs(closed)
        given: list[Row] = [("nothing: everything is known", known, known), *rows]
        fap = closed.question.fap
        table = [
            {"unknown": name, "plain": plain, "marginalised": marginal, "detected": float(power(marginal, fap))}
            for name, plain, marginal in given
        ]
        return View(self.title, [one for one in COLUMNS if one.name in table[0]], table)
