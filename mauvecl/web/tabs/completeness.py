"""Completeness of a search of a stare for flares of several durations and sizes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.web.closed_forms import percent, short
from mauvecl.web.figures import Canvas
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import ClosedForms

#: Half-widths of the flares: as many as there are lines.
LENGTHS = ("shortest", "middle", "longest")


class Shares(Picture):
    """Fraction of injected flares that the search finds against their amplitude."""

    name, title = "shares", "Share of flares that a search of a stare finds"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(
            ink,
            "peak amplitude of the flare (%)",
            "share of flares found",
            logs | {"x"},
            x_range=(0.01, 100),
            y_range=(-0.03, 1.05),
        )
        for k, (called, colour) in enumerate(zip(LENGTHS, ink.lengths, strict=True)):
            canvas.band(f"band {k}", f"{called} flares", colour)
            canvas.legend.pop()
            curve = canvas.line(f"line {k}", f"{called} flares", colour, line_width=2)
            canvas.tooltips(curve, ("amplitude (%)", "x"), (f"found of the {called}", "y"))
        canvas.rule("own", "amplitude of your question", "x", "own")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        sources: dict[str, Any] = {}
        for k in range(len(LENGTHS)):
            sources |= {f"band {k}": {"x": [], "low": [], "high": []}, f"line {k}": {"x": [], "y": []}}
        own = {"own": {"location": closed.question.amplitude_percent}}
        if "completeness" not in answers:
            text = (
                "Nothing is injected yet: Inject flares puts flares of several lengths and sizes into a stare of one "
                "orbit, and searches it."
            )
            return PictureData(text, sources, own)
        table, parts = answers["completeness"].completeness, []
        for k, width in enumerate(np.unique(np.asarray(table["half_width"].value))):
            rows = table[np.asarray(table["half_width"].value) == width]
            x = 100 * np.asarray(rows["amplitude"], float)
            share = np.asarray(rows["completeness"], float)
            ends = (np.asarray(rows[f"completeness_{end}"], float) for end in ("low", "high"))
            sources[f"band {k}"] = dict(zip(("x", "low", "high"), (x, *ends), strict=True))
            sources[f"line {k}"] = {"x": x, "y": share}
            seen = float(np.interp(np.log(closed.question.amplitude_percent), np.log(x), share))
            parts.append(f"{percent(seen)} of those of half-width {short(width)} s")
        peak = f"{closed.question.amplitude_percent:g} %"
        return PictureData(f"Of flares that peak at {peak} the search finds {'; '.join(parts)}.", sources, own)


class Completeness(Tab):
    """Tab of completeness."""

    name, title = "completeness", "Stare"
    about = (
        "One exposure sees a flare at its peak; a stare sees it rise and fade. This tab shows which flares a search of "
        "one orbit finds at the chosen rate of false alarms, with losses while the star drifts out of the fibre."
    )
    pictures = (Shares(),)
    headline = False
    # The picture reads off the share of flares of this size.
    also = ("amplitude_percent",)
    simulations = {"completeness": "Inject flares"}  # noqa: RUF012
    answer, view = "completeness", 1
    files = {"completeness": "completeness", "limits": "completeness"}  # noqa: RUF012
