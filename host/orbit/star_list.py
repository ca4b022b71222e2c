"""Embedded list of well-known stars, read without astropy so that a misspelt star is reported fast."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from functools import cache
from importlib import resources

#: Abbreviations of Greek letters in catalogues.
_GREEK = {"alpha": "alp", "beta": "bet", "gamma": "gam", "delta": "del", "epsilon": "eps", "zeta": "zet", "iota": "iot",
          "kappa": "kap", "sigma": "sig", "omicron": "omi"}  # fmt: skip


def text() -> str:
    """Return the list as ECSV."""
    return resources.files(__package__).joinpath("targets.ecsv").read_text(encoding="utf-8")


@cache
def rows_by_name() -> Mapping[str, Mapping[str, str]]:
    """Return the row of every star by each of its normalised names."""
    lines = [line for line in text().splitlines() if not line.startswith("#")]
    rows = {}
    for row in csv.DictReader(lines, delimiter=" "):
        for name in (row["name"], *row["other_names"].split(",")):
            rows[name_key(name)] = row
    return rows


def name_key(name: str) -> str:
    """Normalise a name: lower case, no separators, abbreviated Greek letters."""
    key = re.sub(r"[\s_*.']+", "", name).casefold()
    for long, short in _GREEK.items():
        if key.startswith(long):
            return short + key.removeprefix(long)
    return key
