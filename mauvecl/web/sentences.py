"""Messages for visitors, with the labels of fields in place of keys of the study."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from types import MappingProxyType

from mauvecl.schema.errors import InputError
from mauvecl.study.keys import keys_with_flags
from mauvecl.web.fields import FIELDS

NO_KEYS: Mapping[str, str] = MappingProxyType({})
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


def sentence(error: InputError, keys: Mapping[str, str] = NO_KEYS) -> str:
    """Return the message of an error as the page shows it; `keys` maps other names of its keys to fields."""
    text = _VALUE.sub(
        lambda found: f"{_label(found['key'], keys)} {'is empty' if found['empty'] else '= '}", str(error)
    )
    return note(text.removeprefix("page: "), keys)


def note(text: str, keys: Mapping[str, str] = NO_KEYS) -> str:
    """Return a message with the labels of fields in place of keys and flags."""
    text = _FLAG.sub(lambda found: f"“{FIELDS[_flags()[found[0]]].label}”" if found[0] in _flags() else found[0], text)
    text = _REMEDY.sub(lambda found: _remedy(found, keys), text)
    return _KEY.sub(lambda found: _label(found[0], keys), text)


def _remedy(found: re.Match[str], keys: Mapping[str, str]) -> str:
    label = _label(found["key"], keys)
    if label == found["key"]:
        return label
    return f"{label} {found['value']}" if found["value"] else f"“{label}”"


def remedies(error: InputError, keys: Mapping[str, str] = NO_KEYS) -> list[tuple[str, str]]:
    """Return the values that a message proposes for fields, as pairs of field and text."""
    each = _REMEDY.finditer(str(error))
    named = ((field_of(keys.get(found["key"], found["key"])), found["value"]) for found in each)
    return [(name, value) for name, value in named if name is not None and value]


def _label(key: str, keys: Mapping[str, str]) -> str:
    name = field_of(keys.get(key, key))
    return key if name is None else FIELDS[name].label
