"""Readers of ECSV and VOTable files."""

from __future__ import annotations

import operator
from functools import partial
from typing import Any

from ..tables.ecsv import parse_ecsv
from ..tables.medium import medium_of
from ..tables.opening import votable_in
from .file_table import Column, FileTable

#: Largest number and length of messages in the table of a kept star.
MAX_NOTES, MAX_NOTE_LENGTH = 20, 400


def ecsv_tables(text: str, name: str, origin: str) -> list[FileTable]:
    """Read the table of an ECSV file."""
    table = parse_ecsv(text, "it")
    meta = table.meta if isinstance(table.meta, dict) else {}
    own = meta.get("name")
    return [
        FileTable(
            [
                # As text, because astropy keeps unknown units as objects without a dimension.
                Column(one, partial(getattr, table[one], "data"), str(table[one].unit or "") or None)
                for one in table.colnames
            ],
            own.strip()[:80] if isinstance(own, str) and own.strip() else name,
            origin,
            remarks="\n".join(
                (*_texts(meta.get("comments")), *(table[one].info.description or "" for one in table.colnames))
            ),
            medium=partial(medium_of, meta),
            messages=_texts(meta.get("told")),
        )
    ]


def _texts(given: Any) -> tuple[str, ...]:
    """Return the short texts of a list; an empty tuple for anything else."""
    if not isinstance(given, list):
        return ()
    return tuple(one for one in given[:MAX_NOTES] if isinstance(one, str) and len(one) <= MAX_NOTE_LENGTH)


def votable_tables(content: bytes, name: str, origin: str) -> list[FileTable]:
    """Read the tables of a VOTable file."""
    file = votable_in(content, "it")
    tables = list(file.iter_tables())
    shared = {param.name or param.ID: param.value for one in file.resources for param in one.params}
    return [
        FileTable(
            [
                Column(
                    field.name or field.ID,
                    partial(operator.getitem, table.array, field.ID),
                    None if field.unit is None else field.unit.to_string(),
                    ucd=field.ucd or "",
                )
                for field in table.fields
            ],
            name,
            origin,
            label=str(table.name or table.ID or i + 1),
            remarks="\n".join(f"{field.ucd or ''} {field.description or ''}" for field in table.fields)[:5000],
            medium=partial(medium_of, shared, {param.name or param.ID: param.value for param in table.params}),
        )
        for i, table in enumerate(tables)
    ]
