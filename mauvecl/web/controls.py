"""The controls: a widget for each field, named for screen readers too; each shows what is entered, right or wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import panel as pn
import param
from bokeh.models.widgets import Div

from mauvecl.web.fields import FIELDS, UPLOADED, Choice, star_names
from mauvecl.web.state import State

WRONG = ":host(.wrong) input, :host(.wrong) select { border: 2px solid #b00020 !important; }"
GROUPS = (
    ("Star", ("star", "magnitude", "band")),
    ("Observation", ("exposure_s", "temperature_c", "instrument", "sky", "sky_brightness", "target", "time")),
    ("Flare", ("amplitude_percent", "flare_temperature_k")),
    ("Detection", ("statistic", "fap", "unknown", "own_unknown", "realisations", "seed")),
)
#: Fields that ask for something under one sky only.
ASKED_UNDER = {"sky_brightness": "brightness", "target": "target and time", "time": "target and time"}
UPLOAD = "or upload nm and erg/s/cm²/Å (text, ECSV, FITS; up to 4 MiB)"


class Controls:
    """A column of controls.

    Parameters
    ----------
    state : State
        What they show after `show`.
    enter : callable
        Told what a visitor enters, by field.
    upload : callable
        Told a file's name and content.
    """

    def __init__(
        self, state: State, enter: Callable[[Mapping[str, str]], None], upload: Callable[[str, bytes], None]
    ) -> None:
        self._state, self._enter = state, enter
        self._widgets = {name: _widget(name) for name in FIELDS}
        for name, widget in self._widgets.items():
            widget.param.watch(lambda event, name=name: self._entered(name, event.new), "value")
        self._file = pn.widgets.FileInput(name="Your own spectrum", sizing_mode="stretch_width", multiple=False)
        self._file.param.watch(lambda *_: self._chosen(upload), ["value", "filename"])
        self._taken: tuple[str | None, bytes | None] = None, None
        self._faults: dict[str, Any] = {}
        rows: list[Any] = []
        for title, names in GROUPS:
            rows.append(Div(text=f"<h2>{title}</h2>"))
            rows += [self._widgets[name] for name in names]
            if title == "Star":
                rows[2:2] = [Div(text=UPLOAD), self._file]
        self.column = pn.Column(*rows, sizing_mode="stretch_width")
        self.show()

    def _entered(self, name: str, value: Any) -> None:
        text = "" if value is None else str(value)
        if text != self._state.entered[name]:
            self._enter({name: text})

    def _chosen(self, upload: Callable[[str, bytes], None]) -> None:
        """A file has come: its name and content come one after the other, and an empty one has no content."""

        def look() -> None:
            file = self._file
            if file.filename is None:
                self._taken = None, None
            elif (file.filename, file.value) != self._taken:
                self._taken = file.filename, file.value
                upload(str(file.filename), file.value or b"")

        document = pn.state.curdoc
        if document is None:
            look()
        else:
            document.add_next_tick_callback(look)

    def show(self) -> None:
        """Each field's text and fault."""
        state = self._state
        for name, widget in self._widgets.items():
            text = state.entered[name]
            read = FIELDS[name].read
            if isinstance(read, Choice):
                # A choice that a link holds and that does not exist is shown for what it is.
                options = [*read.options] if text in read.options else [text, *read.options]
                if widget.options != options:
                    widget.param.update(options=options, value=text)
            if widget.value != text:
                widget.value = text
            if name in ASKED_UNDER:
                widget.visible = state.entered["sky"] == ASKED_UNDER[name] or name in state.faults
            self._tell(name, state.faults.get(name))
        if state.entered["star"] not in ("", UPLOADED) and self._file.filename is not None:
            # The name of a file does not stand beside another star.
            with param.parameterized.discard_events(self._file):
                self._file.param.update(value=None, filename=None)
            self._taken = None, None
            self._file.clear()

    def _tell(self, name: str, fault: str | None) -> None:
        """The sentence below its field, as plain text."""
        widget, shown = self._widgets[name], self._faults.get(name)
        if fault is None:
            if shown is not None:
                self.column.remove(self._faults.pop(name))
                widget.css_classes = []
        elif shown is None:
            told = Div(
                text=fault, render_as_text=True, styles={"color": "#b00020"}, html_attributes={"role": "alert"},
                sizing_mode="stretch_width",
            )  # fmt: skip
            self._faults[name] = pn.pane.Bokeh(told, sizing_mode="stretch_width")
            self.column.insert(self.column.index(widget) + 1, self._faults[name])
            widget.css_classes = ["wrong"]
        else:
            shown.object.text = fault


def _widget(name: str) -> Any:
    """The control of a field; numbers are text until they are read, so that nothing is dropped in silence."""
    field = FIELDS[name]
    how = {"name": field.label, "value": field.first, "sizing_mode": "stretch_width", "stylesheets": [WRONG]}
    if isinstance(field.read, Choice):
        return pn.widgets.Select(options=[*field.read.options], **how)
    if name == "star":
        return pn.widgets.AutocompleteInput(
            options=[*star_names(), UPLOADED],
            case_sensitive=False,
            restrict=False,
            min_characters=1,
            search_strategy="includes",
            placeholder="type to search, such as K or HD",
            **how,
        )
    return pn.widgets.TextInput(**how)
