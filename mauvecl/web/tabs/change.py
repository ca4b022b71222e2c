"""Smallest changes of the star between visits that are detected."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from mauvecl.web.figures import Canvas, curves, target_names
from mauvecl.web.tabs.tab import Answers, Picture, PictureData, Tab

if TYPE_CHECKING:
    from mauvecl.web.closed_forms import ClosedForms


class AgainstMagnitude(Picture):
    """Smallest changes against the magnitude of the star, of one kind."""

    sets = "magnitude=x"
    #: Factor from the value to that of the axis, by the unit of the change.
    units: ClassVar[Mapping[str, float]]
    label: ClassVar[str]

    def figure(self, ink: Any, logs: frozenset[str]) -> Canvas:
        canvas = Canvas(ink, "magnitude", f"smallest change ({self.label})", logs | {"y"})
        canvas.targets(self.name, self.label)
        canvas.own_point("this star")
        return canvas

    def drawn(self, closed: ClosedForms, answers: Answers) -> PictureData:
        nothing: dict[str, Any] = {"own": {"x": [], "y": []}}
        if "change" not in answers:
            text = "Change computes which differences between visits are detected."
            return PictureData(text, curves(self.name, []) | nothing)
        answer = answers["change"]
        here = [row for row in answer.changes if row.change.unit in self.units]
        found, words, own = [], [], []
        for row in here:
            name, scale = row.change.name, self.units[row.change.unit]
            along = np.array([(one.magnitude, one.smallest.one) for one in answer.along if one.change.name == name])
            x, y = along[np.isfinite(along[:, 1])].T
            found.append((x, scale * y))
            hidden = np.isinf(row.smallest.one)
            words.append(f"{name} {'hidden' if hidden else f'{scale * row.smallest.one:.3g}'}")
            own += [] if hidden else [scale * row.smallest.one]
        text = (
            f"Smallest changes between {answer.study.change.visits} visits, in {self.label}: "
            f"{'; '.join(words) or 'none of this kind'}."
        )
        sources = curves(self.name, found) | {"own": {"x": [closed.question.magnitude] * len(own), "y": own}}
        return PictureData(text, sources, names=target_names([row.change.name for row in here]))


class Relative(AgainstMagnitude):
    """Changes relative to the star's own light."""

    name, title = "changes", "Smallest change of the star's own light"
    units: ClassVar[Mapping[str, float]] = {"": 100.0, "mag": 100.0}
    label = "% or 0.01 mag"


class Fluxes(AgainstMagnitude):
    """Changes of the flux of lines."""

    name, title = "fluxes", "Smallest change of the flux of lines"
    units: ClassVar[Mapping[str, float]] = {"erg / (s cm2)": 1.0}
    label = "erg/s/cm²"


class Change(Tab):
    """Changes between visits."""

    verb = "change"
    about = "How small a difference between visits is seen: of lines, bands, the Balmer jump and the colour."
    pictures = (Relative(), Fluxes())
    headline = False
    # Visits are evenly spaced, without an orbit, and the seed is that of periods.
    never = ("targets", "start", "days", "shortest_d", "longest_d", "seed")
    files = {"change": "change", "indices": "change"}  # noqa: RUF012
