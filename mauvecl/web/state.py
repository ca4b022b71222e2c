"""State of the page: the text of all fields, their errors, and the question if all are valid.

The state is independent of the page's appearance: the page enters text, and shows `entered` and `faults`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, urlencode

from mauvecl.results.requests.fap_checks import check_fap
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened
from mauvecl.web.fields import FIELDS, MOST_CHARACTERS, UPLOADED, UPLOADED_UNKNOWN, Choice, Field, several
from mauvecl.web.question import Points, Question
from mauvecl.web.tabs import TABS

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source

#: Largest number of characters of a link that are parsed.
MOST_LINKED = 4096
#: Entries of a link in addition to the question.
SEEN = {"tab": Field("Tab", next(iter(TABS)), Choice(tuple(TABS))), "simulated": Field("Simulated", "", several)}


class State:
    """State of a page.

    Attributes
    ----------
    entered : dict
        Text of each field of `FIELDS` and `SEEN` by name, valid or not.
    faults : dict
        Error message by name of the field; empty if there is a question.
    stray : str
        Message on entries of the last link that are not fields, or empty.
    uploaded : Source or None
        Spectrum of the star if "uploaded star" is entered.
    unknown : tuple of pairs or None
        Spectrum of the unknown if "uploaded spectrum" is entered.
    """

    def __init__(self, uploaded: Source | None = None, unknown: Points | None = None) -> None:
        self._fields = FIELDS | SEEN
        self.entered = {name: field.first for name, field in self._fields.items()}
        self._values = {name: field.read(field.first) for name, field in self._fields.items()}
        self.faults: dict[str, str] = {}
        self.stray = ""
        self.uploaded, self.unknown = uploaded, unknown

    def enter(self, given: Mapping[str, str]) -> None:
        """Enter text into fields and collect errors in `faults`."""
        for name, text in given.items():
            self.entered[name] = text[:MOST_CHARACTERS]
            self.faults.pop(name, None)
            try:
                if len(text) > MOST_CHARACTERS:
                    raise InputError(
                        f"{shortened(text)} is too long", f"at most {MOST_CHARACTERS} characters", key=name, value=text
                    )
                value = self._fields[name].read(text)
                if (text == UPLOADED and self.uploaded is None) or (text == UPLOADED_UNKNOWN and self.unknown is None):
                    raise InputError(
                        f"the {text} is not here", "its file again: links do not hold it", key=name, value=text
                    )
                self._values[name] = value
            except InputError as error:
                self.faults[name] = str(error)
        if given.keys() & {"fap", "realisations"}:
            self._settled()
        if given.keys() & {"sky", "target", "time"}:
            self._placed()

    def _settled(self) -> None:
        """Check that the realisations suffice for the false-alarm probability."""
        if "fap" not in self.faults and self.faults.get("realisations", "fap = ").startswith("fap = "):
            self.faults.pop("realisations", None)
            try:
                check_fap(self._values["fap"], *self._values["realisations"])
            except InputError as error:
                self.faults["realisations"] = str(error)

    def _placed(self) -> None:
        """Check target and time if the sky depends on them."""
        from mauvecl.host.sky.helioecliptic import offline, parse_position, parse_time

        read: tuple[tuple[str, Callable[[str], Any]], ...] = (("target", parse_position), ("time", parse_time))
        for name, understood in read:
            if not self.faults.get(name, name).startswith(name):
                continue
            self.faults.pop(name, None)
            if self.entered["sky"] != "target and time":
                continue
            try:
                with offline():
                    understood(self.entered[name])
            except InputError as error:
                self.faults[name] = str(error)

    @property
    def asked(self) -> tuple[str, ...]:
        """Text of all fields on which an answer depends."""
        return tuple(self.entered[name] for name in FIELDS)

    @property
    def fault(self) -> str:
        """All errors in one text, empty if there is none."""
        return "; ".join(f"{self._fields[name].label}: {why}" for name, why in self.faults.items())

    def question(self) -> Question:
        """Return the question.

        Raises
        ------
        InputError
            If a field is invalid, with the accepted values of each.
        """
        if self.faults:
            fault, _, expected = self.fault.partition(", expected ")
            raise InputError(fault, expected or None, key=next(iter(self.faults)))
        values = {name: self._values[name] for name in FIELDS}
        if values["own_unknown"] is None:
            values["own_unknown"] = self.unknown
        return Question(values, uploaded=self.uploaded if values["star"] == UPLOADED else None)

    @property
    def simulated(self) -> tuple[str, ...]:
        """Simulations of the page."""
        return tuple(self._values["simulated"])

    # Links

    @property
    def link(self) -> str:
        """Return all entries as the query of a URL."""
        return "?" + urlencode({name: text for name, text in self.entered.items() if text or self._fields[name].first})

    def follow(self, link: str) -> None:
        """Enter the values of a link, and defaults for all others."""
        query = link.removeprefix("?")
        self.stray = ""
        if len(query) > MOST_LINKED:
            query, self.stray = "", f"The link has more than {MOST_LINKED} characters and was left out."
        pairs = parse_qsl(query, keep_blank_values=True, errors="replace")
        strange = sorted({name for name, _ in pairs} - set(self._fields))
        if strange:
            self.stray = f"The link holds {shortened(', '.join(strange))}, which is no field here; it was left out."
        first = {name: field.first for name, field in self._fields.items()}
        self.enter(first | {name: text for name, text in pairs if name in self._fields})
        for name in SEEN.keys() & self.faults.keys():
            # The page has no field to correct them.
            self.stray += f" The link's {name}: {self.faults[name]}; it was left out."
            self.enter({name: SEEN[name].first})
