"""Embedded list of well-known stars, read without astropy so that a misspelt star is reported fast."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources

#: Abbreviations of Greek letters in catalogues.
_GREEK = {"alpha": "alp", "beta": "bet", "gamma": "gam", "delta": "del", "epsilon": "eps", "zeta": "zet", "iota": "iot",
          "kappa": "kap", "sigma": "sig", "omicron": "omi"}  # fmt: skip


@dataclass(frozen=True)
class WellKnown:
    """Star of the embedded list."""

    name: str
    others: tuple[str, ...]  # its other names
    ra_deg: float  # ICRS, as the declination
    dec_deg: float
    distance_pc: float
    magnitude: float  # in V
    spectral_type: str
    source: str

    @property
    def about(self) -> str:
        """Its type, distance and magnitude with their source, in words."""
        return f"{self.spectral_type}, {self.distance_pc:g} pc, V = {self.magnitude:g}; {self.source.partition(',')[0]}"


def text() -> str:
    """Return the list as ECSV."""
    return resources.files(__package__).joinpath("library", "well_known.ecsv").read_text(encoding="utf-8")


@cache
def stars() -> tuple[WellKnown, ...]:
    """Return the stars of the list."""
    lines = [line for line in text().splitlines() if not line.startswith("#")]
    return tuple(
        WellKnown(
            row["name"], tuple(name.strip() for name in row["other_names"].split(",")), float(row["ra"]),
            float(row["dec"]), float(row["distance"]), float(row["V"]), row["spectral_type"], row["source"],
        )
        for row in csv.DictReader(lines, delimiter=" ")
    )  # fmt: skip


@cache
def by_key() -> Mapping[str, WellKnown]:
    """Return every star by each of its normalised names."""
    return {name_key(name): star for star in stars() for name in (star.name, *star.others)}


def name_key(name: str) -> str:
    """Normalise a name: lower case, no separators but decimal points, abbreviated Greek letters."""
    key = re.sub(r"[\s_*']+|(?<!\d)\.|\.(?!\d)", "", name).casefold()
    for long, short in _GREEK.items():
        if key.startswith(long):
            return short + key.removeprefix(long)
    return key
