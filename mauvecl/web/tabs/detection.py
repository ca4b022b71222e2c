"""Detection: the flare relative to the noise, distributions of the statistic, and the ROC."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.detection.requests import label
from mauvecl.web.closed_forms import percent
from mauvecl.web.figures import Canvas, strips
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import ClosedForms


class Excess(Picture):
    """Flare minus quiet in standard deviations of the noise."""

    name, title = "excess", "Flare minus quiet, in sigma of the noise"
    pins = "element"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "wavelength (nm)", "sigma of the noise", logs, wavelength=True)
        canvas.band("noise", "95 % of the noise", "drawn", alpha=0.16)
        canvas.saturated()
        canvas.dots("drawn", "drawn exposure", "drawn", size=5)
        canvas.line("pixel", "expected per pixel", "sky", line_width=1.2)
        curve = canvas.line("element", "expected per element of 10.5 nm", "flare", step=True, line_width=2.2)
        canvas.pinned(partial(canvas.plot.step, mode="center"))
        canvas.tooltips(curve, ("wavelength (nm)", "x"), ("sigma per element", "y"))
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        x = closed.quiet
        pixel, element = closed.excess
        sources: dict[str, Any] = {
            "pixel": {"x": x.wavelength_nm, "y": pixel},
            "element": {"x": x.element_wavelength_nm, "y": element},
            "noise": {"x": [190.0, 710.0], "low": [-1.96] * 2, "high": [1.96] * 2},
            "drawn": {"x": [], "y": []},
            "saturated": strips(x.wavelength_nm, x.saturated | closed.flare.saturated),
        }
        if "draw" in answers:
            raw = np.where(x.saturated, 0.0, answers["draw"] - x.recorded_dn)
            noise = np.sqrt(x.per_element(np.where(x.saturated, 0.0, x.variance_dn2)))
            shown = np.divide(x.per_element(raw), noise, out=np.full(noise.size, np.nan), where=noise > 0)
            sources["drawn"] = {"x": x.element_wavelength_nm, "y": shown}
        best = int(np.argmax(element))
        saturated = int(np.count_nonzero(x.saturated | closed.flare.saturated))
        text = (
            f"The flare stands out most at {x.element_wavelength_nm[best]:.0f} nm, by {element[best]:.3g} sigma of an "
            f"element's noise; {np.count_nonzero(element > 1.96)} of {element.size} elements rise above 95 % of the "
            f"noise."
        )
        return PictureData(text + (f" {saturated} pixels saturate." if saturated else ""), sources)


class Distributions(Picture):
    """Distributions of the statistic without and with the flare, and the threshold."""

    name, title = "distributions", "The statistic without and with the flare"
    logs = ("y",)
    pins, alike = "flare", ("statistic",)

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        how = {"y_range": (1e-4, 1.5)} if "y" in logs else {"y_range": (0, 1.06)}
        canvas = Canvas(ink, "statistic", "density, each peak = 1", logs, **how)
        plot = canvas.plot
        for name, colour in (("null bars", "star"), ("flare bars", "flare")):
            bars = plot.quad(
                "left", "right", "top", 1e-9 if "y" in logs else 0, source=canvas.source(name, "left", "right", "top"),
                fill_color=ink[colour], fill_alpha=0.45, line_color=None,
            )  # fmt: skip
            bars.name = "simulated"
        canvas.legend.append(("simulated", ink.drawn, "bars", "if any"))
        for name, called, colour in (("null", "no flare", "star"), ("flare", "flare", "flare")):
            canvas.band(f"{name} area", called, colour, alpha=0.18)
            canvas.legend.pop()
            curve = canvas.line(name, called, colour, line_width=2)
            canvas.tooltips(curve, ("statistic", "x"), ("density", "y"))
        canvas.pinned()
        canvas.rule("threshold", "threshold", "x")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        q, cut, chance = closed.question, closed.odds.threshold, closed.chance
        sources: dict[str, Any] = {}
        for name, form in (("null", closed.null), ("flare", closed.seen)):
            edges = np.linspace(form.mean - 5 * form.std, form.mean + 5 * form.std, 161)
            beyond = form.sf(edges)
            density = np.maximum(beyond[:-1] - beyond[1:], 0.0)
            density = density / density.max()
            middle = (edges[1:] + edges[:-1]) / 2
            sources[name] = {"x": middle, "y": density}
            sources[f"{name} area"] = {"x": middle, "low": np.full(middle.size, 1e-9), "high": density}
        empty: dict[str, Any] = {"left": [], "right": [], "top": []}
        sources |= {"null bars": empty, "flare bars": empty}
        if "detection" in answers:
            (star,) = answers["detection"].stars
            for name, flare in (("null bars", None), ("flare bars", 0)):
                edges, counts = star.detection.histogram(q.statistic, flare, bins=80)
                sources[name] = {"left": edges[:-1], "right": edges[1:], "top": counts / max(counts.max(), 1)}
            (row,) = (row for row in answers["detection"].table if row["statistic"] == q.statistic)
            cut, chance = float(row["threshold"]), float(row["probability"])
        share = f"{percent(chance)} of flares lie above the threshold of {cut:.4g}"
        text = (
            f"Without a flare {q.statistic} lies at {closed.null.mean:.4g} ± {closed.null.std:.3g}, with it at "
            f"{closed.seen.mean:.4g} ± {closed.seen.std:.3g}; "
            f"{share if cut == cut else 'no threshold has this false-alarm probability'}."
        )
        return PictureData(
            text,
            sources,
            {"threshold": {"location": cut if cut == cut else None}, "x axis": {"axis_label": label(q.statistic)}},
        )


class Trade(Picture):
    """Detection probability against false-alarm probability."""

    name, title = "roc", "Receiver operating characteristic"
    sets = "fap=x"
    pins = "closed form"

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(
            ink, "false-alarm probability per test", "detection probability", logs | {"x"}, x_range=(1e-6, 1),
            y_range=(-0.02, 1.03),
        )  # fmt: skip
        canvas.band("simulated", "simulated, 95 %", "drawn", alpha=0.4)
        curve = canvas.line("closed form", "closed form", "flare", line_width=2)
        canvas.pinned()
        canvas.own_point()
        canvas.tooltips(curve, ("false-alarm probability", "x"), ("detection probability", "y"))
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        q = closed.question
        faps = np.logspace(-6, 0, 121)[:-1]
        chances = closed.seen.sf(closed.null.isf(faps))
        sources: dict[str, Any] = {
            "closed form": {"x": faps, "y": chances},
            "own": {"x": [q.fap], "y": [closed.chance]},
            "simulated": {"x": [], "low": [], "high": []},
        }
        if "detection" in answers:
            curve = answers["detection"].stars[0].detection.roc(q.statistic).table()
            seen = np.asarray(curve["fap"], float) > 0
            columns = {"x": "fap", "low": "probability_low", "high": "probability_high"}
            sources["simulated"] = {to: np.asarray(curve[name], float)[seen] for to, name in columns.items()}
        half = int(np.searchsorted(chances, 0.5))
        where = "half of them at " if half else "half of them still below "
        text = (
            f"At a false-alarm probability of {q.fap:g} {percent(closed.chance)} are detected; {where}"
            f"{faps[min(half, faps.size - 1)]:.2g}."
        )
        return PictureData(text, sources)


class Detection(Tab):
    """Tab of the detection, the first one."""

    name, title = "detection", "Detection"
    about = "The flare relative to the noise, and the statistic with and without the flare."
    pictures = (Excess(), Distributions(), Trade())
    simulations = {"detection": "Simulate"}  # noqa: RUF012
    answer = "detection"
    files = {"detection": "detection", "roc": "detection"}  # noqa: RUF012
