"""Messages for visitors, with the labels of fields in place of keys of the study."""

from __future__ import annotations

import re
from functools import cache

from mauvecl.schema.errors import InputError
from mauvecl.web.fields import FIELDS

#: A remedy in a message, such as `magnitude=7.4`.
_REMEDY = re.compile(r"`(?P<key>[a-z][\w.]*)(?:=(?P<quote>'?)(?P<value>[^`]*?)(?P=quote))?`")
#: A value at the beginning of a message, such as fap = 0.001.
_VALUE = re.compile(r"^(?:page: )?(?P<key>[a-z][\w.]*) = (?P<empty>''(?=,|$))?")
#: A key within a message: words of prose hold no underscore.
_KEY = re.compile(r"(?<![\w.'])(?:[a-z]+\.)*[a-z0-9]+(?:_[a-z0-9]+)+(?![\w.]*')")


@cache
def _fields() -> dict[str, str]:
    """Return the field of each key of the study, whole and without its section, and of each own name."""
    names = {
        part: name for name, field in FIELDS.items() if field.path for part in (".".join(field.path), field.path[-1])
    }
    return names | {name: name for name in FIELDS} | {"tails": "realisations", "plan.targets": "targets"}


def field_of(key: str | None) -> str | None:
    """Return the name of the field that sets a key of the study, or None."""
    return _fields().get(key or "")


def sentence(error: InputError) -> str:
    """Return the message of an error as the page says it."""
    text = _VALUE.sub(lambda found: f"{_label(found['key'])} {'is empty' if found['empty'] else '= '}", str(error))
    text = _REMEDY.sub(lambda found: " ".join(filter(None, (_label(found["key"]), found["value"]))), text)
    return _KEY.sub(lambda found: _label(found[0]), text.removeprefix("page: "))


def _label(key: str) -> str:
    name = field_of(key)
    return key if name is None else FIELDS[name].label
