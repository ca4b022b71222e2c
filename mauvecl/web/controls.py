"""The controls: a widget for each value of the question, named for screen readers too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel as pn
import param

from mauvecl.host.errors import InputError
from mauvecl.web.question import ENDINGS, UPLOADED, Question, star_names

#: Arrows beside numbers have no name for a screen reader; the keyboard's do the same.
NO_ARROWS = ".bk-spin-btn { display: none !important; }"
# Labels that screen readers meet too are the widgets' names.
FIELDS = (
    ("Star", ("magnitude", "band")),
    ("Observation", ("exposure_s", "temperature_c", "instrument", "sky", "sky_brightness", "target", "time")),
    ("Flare", ("amplitude_percent", "flare_temperature_k")),
    ("Detection", ("statistic", "fap", "realisations", "seed")),
)


def controls(question: Question, complain: Callable[[str], None]) -> Any:
    """A column of controls that change the question, and follow it.

    Parameters
    ----------
    question : Question
    complain : callable
        Tells the visitor what is wrong with an upload.
    """
    widgets: dict[str, Any] = {}
    for name in (name for _, fields in FIELDS for name in fields):
        about = question.param[name]
        how = {"name": about.doc, "sizing_mode": "stretch_width", "description": None}
        widgets[name] = _kind(about).from_param(about, **how)
        widgets[name].stylesheets = [NO_ARROWS]

    def asked(name: str) -> Callable[[str], bool]:
        return lambda sky: sky == {"sky_brightness": "brightness"}.get(name, "target and time")

    for name in ("sky_brightness", "target", "time"):
        widgets[name].visible = pn.bind(asked(name), question.param.sky)
    upload = "or upload nm and erg/s/cm²/Å (text, ECSV, FITS; up to 4 MiB)"
    rows = [pn.pane.Markdown("## Star"), _star(question), pn.pane.Markdown(upload), _upload(question, complain)]
    for title, fields in FIELDS:
        if title != "Star":
            rows.append(pn.pane.Markdown(f"## {title}"))
        rows += [widgets[name] for name in fields]
    return pn.Column(*rows, sizing_mode="stretch_width")


def _star(question: Question) -> Any:
    """The library, searched as one types."""
    found = pn.widgets.AutocompleteInput(
        name="Library star",
        options=[*star_names(), UPLOADED],
        value=question.star,
        case_sensitive=False,
        restrict=True,
        min_characters=1,
        search_strategy="includes",
        placeholder="type to search, such as K or HD",
        sizing_mode="stretch_width",
    )

    def chosen(event: Any) -> None:
        if event.new:
            question.star = event.new

    found.param.watch(chosen, "value")
    question.param.watch(lambda event: setattr(found, "value", event.new), "star")
    return found


def _upload(question: Question, complain: Callable[[str], None]) -> Any:
    found = pn.widgets.FileInput(
        accept=",".join(ENDINGS), name="Your own spectrum", sizing_mode="stretch_width", multiple=False
    )

    def came(event: Any) -> None:
        if event.new is None:
            return
        try:
            question.upload(str(found.filename), event.new)
        except InputError as error:
            complain(str(error))

    found.param.watch(came, "value")
    return found


def _kind(about: Any) -> Any:
    """The control for a kind of value."""
    kinds = ((param.Integer, pn.widgets.IntInput), (param.Number, pn.widgets.FloatInput))
    others = ((param.Selector, pn.widgets.Select), (param.String, pn.widgets.TextInput))
    return next(widget for kind, widget in (*kinds, *others) if isinstance(about, kind))
