"""Periods of the star that are recovered from visits to a target."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from bokeh.models import FixedTicker, HoverTool, LinearColorMapper
from bokeh.models.annotations import ColorBar

from mauvecl.web.figures import Canvas
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import ClosedForms


class Recovered(Picture):
    """Share of recovered periods over period and semi-amplitude."""

    name, title = "periods", "Share of periods that visits recover"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "period (d)", "semi-amplitude (errors of a visit)", logs | {"x", "y"})
        plot: Any = canvas.plot
        mapper = LinearColorMapper(palette="Cividis256", low=0, high=1)
        source = canvas.source("cells", "left", "right", "bottom", "top", "period", "amplitude", "share")
        cells = plot.quad("left", "right", "bottom", "top", source=source, line_color=None,
                          fill_color={"field": "share", "transform": mapper})  # fmt: skip
        cells.name = "recovered"
        shown = [("recovered", "@share{0 %}"), ("period", "@period{0.[00]} d"), ("amplitude", "@amplitude{0.00}")]
        plot.add_tools(HoverTool(renderers=[cells], tooltips=shown))
        plot.xaxis.ticker = FixedTicker(ticks=[0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200])
        plot.yaxis.ticker = FixedTicker(ticks=[0.5, 1, 2, 4])
        plot.add_layout(ColorBar(color_mapper=mapper, width=10, title="recovered", **canvas.bar_text), "right")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        names = ("left", "right", "bottom", "top", "period", "amplitude", "share")
        cells: dict[str, Any] = {name: [] for name in names}
        if "periods" not in answers:
            text = "For each period and amplitude, how often it is found in visits that the orbit allows."
            return PictureData(text, {"cells": cells})
        row, *_ = answers["periods"].periods
        r = row.recovery
        x, y = np.meshgrid(r.periods_d, r.amplitudes)
        for place, (values, points) in enumerate(((x, r.periods_d), (y, r.amplitudes))):
            half = np.sqrt(points[1] / points[0])
            cells[names[2 * place]], cells[names[2 * place + 1]] = (values / half).ravel(), (values * half).ravel()
        share = row.shares("value")
        cells |= {"period": x.ravel(), "amplitude": y.ravel(), "share": share}
        errors = "; ".join(
            f"{one.change.name} {(one.error if one.change.unit else 100 * one.error):.3g} {one.change.unit or '%'}"
            for one in answers["periods"].periods
        )
        text = (
            f"{r.time_d.size} visits within {np.ptp(r.time_d):.0f} days recover {100 * np.mean(share):.0f} % of the "
            f"map's periods. The error of a visit is {errors}."
        )
        return PictureData(text, {"cells": cells})


class Periods(Tab):
    """Recovered periods."""

    verb, name, title = "change", "periods", "Periods"
    about = (
        "Which periods of the star are found in visits to the first target, at times that the orbit allows, by a "
        "Lomb-Scargle periodogram with a false-alarm probability of 1 %."
    )
    pictures = (Recovered(),)
    headline = False
    simulations = {"periods": "Map periods"}  # noqa: RUF012
    answer, view = "periods", 2
    # The power is that of differences.
    never = ("power", "fap")
    files = {"periods": "periods"}  # noqa: RUF012
