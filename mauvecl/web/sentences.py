"""Messages for visitors, with the labels of fields in place of keys of the study."""

from __future__ import annotations

import re
from functools import cache

from mauvecl.schema.errors import InputError
from mauvecl.study.keys import keys_with_flags
from mauvecl.web.fields import FIELDS

#: A remedy in a message, such as `magnitude=7.4`.
_REMEDY = re.compile(r"`(?P<key>[a-z][\w.]*)(?:=(?P<quote>'?)(?P<value>[^`]*?)(?P=quote))?`")
#: A value at the beginning of a message, such as fap = 0.001.
_VALUE = re.compile(r"^(?:page: )?(?P<key>[a-z][\w.]*) = (?P<empty>''(?=,|$))?")
#: A flag of the command line.
_FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
#: A key within a message: words of prose hold no underscore.
_KEY = re.compile(r"(?<![\w.'])(?:[a-z]+\.)*[a-z0-9]+(?:_[a-z0-9]+)+(?![\w.]*')")


@cache
def _fields() -> dict[str, str]:
    """Return the field of each key of the study, whole and without its section, and of each own name."""
    names = {
        part: name for name, field in FIELDS.items() if field.path for part in (".".join(field.path), field.path[-1])
    }
    return names | {name: name for name in FIELDS} | {"tails": "realisations", "plan.targets": "targets"}


@cache
def _flags() -> dict[str, str]:
    """Return the field of each flag whose key has one."""
    names = {".".join(field.path): name for name, field in FIELDS.items() if field.path}
    return {flag: names[key] for key, _, one in keys_with_flags() if key in names for flag in one.names}


def field_of(key: str | None) -> str | None:
    """Return the name of the field that sets a key of the study, or None."""
    return _fields().get(key or "")


def sentence(error: InputError) -> str:
    """Return the message of an error as the page says it."""
    text = _VALUE.sub(lambda found: f"{_label(found['key'])} {'is empty' if found['empty'] else '= '}", str(error))
    return note(text.removeprefix("page: "))


def note(text: str) -> str:
    """Return a message with the labels of fields in place of keys and flags."""
    text = _FLAG.sub(lambda found: f"“{FIELDS[_flags()[found[0]]].label}”" if found[0] in _flags() else found[0], text)
    text = _REMEDY.sub(_remedy, text)
    return _KEY.sub(lambda found: _label(found[0]), text)


def _remedy(found: re.Match[str]) -> str:
    label = _label(found["key"])
    if label == found["key"]:
        return label
    return f"{label} {found['value']}" if found["value"] else f"“{label}”"


def remedies(error: InputError) -> list[tuple[str, str]]:
    """Return the values that a message proposes for fields, as pairs of field and text."""
    named = ((field_of(found["key"]), found["value"]) for found in _REMEDY.finditer(str(error)))
    return [(name, value) for name, value in named if name is not None and value]


def _label(key: str) -> str:
    name = field_of(key)
    return key if name is None else FIELDS[name].label
