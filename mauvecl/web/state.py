"""State of the page: the text of all fields, their errors, and the question if all are valid.

The state is independent of the page's appearance: the page enters text, and shows `entered` and `faults`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any
from urllib.parse import parse_qsl, urlencode

from mauvecl.detection.fap_checks import check_fap
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened
from mauvecl.web.fields import FIELDS, Choice, Field, several
from mauvecl.web.question import Question
from mauvecl.web.sentences import sentence
from mauvecl.web.tabs import TABS
from mauvecl.web.upload import UPLOADS

#: Largest number of characters of a link that are parsed.
MOST_LINKED = 8192
#: Entries of a link in addition to the question.
SEEN = {"tab": Field("Tab", next(iter(TABS)), Choice(tuple(TABS))), "simulated": Field("Simulated", "", several)}


class State:
    """State of a page.

    Attributes
    ----------
    entered : dict
        Text of each field of `FIELDS` and `SEEN` by name, valid or not.
    stray : str
        Message on entries of the last link that are not fields, or empty.
    uploads : mapping
        Contents of the visitor's files by field.
    """

    def __init__(self, uploads: Mapping[str, Any] | None = None) -> None:
        self._fields = FIELDS | SEEN
        self.entered = {name: field.first for name, field in self._fields.items()}
        self._values = {name: field.read(field.first) for name, field in self._fields.items()}
        self._invalid: dict[str, str] = {}
        self.stray = ""
        self.uploads = dict(uploads or {})

    def enter(self, given: Mapping[str, str]) -> None:
        """Enter text into fields."""
        for name, text in given.items():
            field = self._fields[name]
            self.entered[name] = text[: field.most]
            self._invalid.pop(name, None)
            try:
                if len(text) > field.most:
                    raise InputError(
                        f"{shortened(text)} is too long", f"at most {field.most} characters", key=name, value=text
                    )
                value = field.read(text)
                if self._holds_file(name) and name not in self.uploads:
                    raise InputError(
                        f"the {text} is not here", "its file again: links do not hold it", key=name, value=text
                    )
                self._values[name] = value
            except InputError as error:
                self._invalid[name] = sentence(error)

    def _holds_file(self, name: str) -> bool:
        return name in UPLOADS and self.entered[name] == UPLOADS[name].entered

    @property
    def faults(self) -> dict[str, str]:
        """Error message by name of the field; empty if there is a question."""
        return self.faults_of(self._fields)

    def faults_of(self, names: Collection[str]) -> dict[str, str]:
        """Return the error messages of some fields, with those of values that cannot be together."""
        faults = {name: why for name, why in self._invalid.items() if name in names}
        for name, check in (
            ("realisations", self._check_fap),
            ("target", self._check_target),
            ("time", self._check_time),
        ):
            if name in names and name not in faults:
                try:
                    check()
                except InputError as error:
                    faults[name] = sentence(error)
        return faults

    def values_of(self, names: Collection[str]) -> dict[str, Any]:
        """Return the values of fields by name; raises InputError if one is invalid."""
        for name in names:
            if name in self._invalid:
                raise InputError(f"{self._fields[name].label}: {self._invalid[name]}", key=name)
        return {name: self._values[name] for name in names}

    def _check_fap(self) -> None:
        """Raise InputError if the realisations do not suffice for the false-alarm probability."""
        if "fap" not in self._invalid:
            check_fap(self._values["fap"], *self._values["realisations"])

    def _check_target(self) -> None:
        """Raise InputError if the sky depends on a target without a position."""
        from mauvecl.host.exposure.sky import parse_position
        from mauvecl.host.tables.times import offline

        if self.entered["sky"] == "target and time":
            with offline():
                parse_position(self.entered["target"])

    def _check_time(self) -> None:
        """Raise InputError if the sky depends on an invalid time."""
        from mauvecl.host.exposure.sky import parse_time
        from mauvecl.host.tables.times import offline

        if self.entered["sky"] == "target and time":
            with offline():
                parse_time(self.entered["time"])

    def asked(self, names: Collection[str] = tuple(FIELDS)) -> tuple[str, ...]:
        """Return the text of the named fields on which an answer depends, by default of all."""
        return tuple(self.entered[name] for name in FIELDS if name in names)

    def question(self, names: Collection[str] = tuple(FIELDS)) -> Question:
        """Return the question.

        Raises InputError with the accepted values if a requested field is invalid.

        Parameters
        ----------
        names : collection of str
            Requested fields; the others have their first values.
        """
        faults = self.faults_of(names)
        if faults:
            all_of_them = "; ".join(f"{self._fields[name].label}: {why}" for name, why in faults.items())
            fault, _, expected = all_of_them.partition(", expected ")
            raise InputError(fault, expected or None, key=next(iter(faults)))
        first = State()
        values = {name: (self if name in names else first)._values[name] for name in FIELDS}
        return Question(
            values, {name: self.uploads[name] for name in UPLOADS if name in names and self._holds_file(name)}
        )

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
        for name in SEEN.keys() & self._invalid.keys():
            # The page has no field to correct them.
            self.stray += f" The link's {name}: {self._invalid[name]}; it was left out."
            self.enter({name: SEEN[name].first})
