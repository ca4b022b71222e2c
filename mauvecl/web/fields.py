"""The fields of the page: what each is called, what stands in it at first, and how its text is read."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened
from mauvecl.host.stars.bands import ALIASES
from mauvecl.host.stars.catalogue import embedded, library_table
from mauvecl.statistics.registry import STATISTICS

UPLOADED = "uploaded star"
#: Realisations that a visitor may ask for.
REALISATIONS = (10_000, 100_000, 1_000_000, 4_000_000)
#: What is taken for unknown on the page.
UNKNOWN = ("nothing", "the usual")
SKIES = ("brightness", "target and time", "none")
TABS = ("observation", "snr", "noise", "detection", "limit")
#: What may be simulated on the page.
SIMULATIONS = ("detection", "limit", "map")
#: Characters of a field that are looked at.
MOST_CHARACTERS = 200


@dataclass(frozen=True)
class Number:
    """A number in a range, written with a point."""

    low: float
    high: float
    whole: bool = False

    def __call__(self, text: str) -> float | int:
        """The number, or the sentence of what is accepted."""
        kind = "a whole number" if self.whole else "a number"
        accepted = f"expected {kind} from {self.low:.15g} to {self.high:.15g}"
        form = r"[+-]?\d+" if self.whole else r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?"
        if not text.strip():
            raise InputError(f"nothing is entered, {accepted}")
        if re.fullmatch(form, text.strip(), flags=re.ASCII) is None:
            point = ", with a point for decimals" if "," in text else ""
            raise InputError(f"{shortened(text)} is not {kind}, {accepted}{point}")
        value = int(text) if self.whole else float(text)
        if not self.low <= value <= self.high:
            raise InputError(f"{shortened(text.strip())} is out of range, {accepted}")
        return value


@dataclass(frozen=True)
class Choice:
    """One of some words."""

    options: tuple[str, ...]
    made: Callable[[str], Any] = str

    def __call__(self, text: str) -> Any:
        """The value, or the sentence of what is accepted."""
        if text not in self.options:
            raise InputError(f"{shortened(text)} is no choice here, expected one of {', '.join(self.options)}")
        return self.made(text)


def several(text: str) -> tuple[str, ...]:
    """Names of simulations, each once."""
    names = [name for name in text.split(",") if name]
    if len(names) > len(SIMULATIONS) or not set(names) <= set(SIMULATIONS):
        raise InputError(f"{shortened(text)} is no simulation, expected some of {', '.join(SIMULATIONS)}")
    return tuple(dict.fromkeys(names))


def points(text: str) -> tuple[tuple[float, float], ...]:
    """A spectrum as pairs of nm and DN of the exposure; none where nothing is entered."""
    number = Number(-1e30, 1e30)
    pairs = [pair.split() for pair in text.split(",") if text.strip()]
    if any(len(pair) != 2 for pair in pairs):
        raise InputError(f"{shortened(text)} is no spectrum, expected pairs of nm and DN with commas between them")
    found = tuple((float(number(nm)), float(number(dn))) for nm, dn in pairs)
    if any(low >= high for (low, _), (high, _) in itertools.pairwise(found)):
        raise InputError(f"{shortened(text)} does not ascend in nm, expected pairs of nm and DN that do")
    return found


def star_name(text: str) -> str:
    """The library's name of a star, found by any of its names in any case; a server's own kept stars are not here."""
    if text == UPLOADED:
        return UPLOADED
    if not text.strip():
        raise InputError("no star is chosen, expected a name of the library, or an upload")
    entry = embedded(text)
    if entry is None:
        raise InputError(f"{shortened(text)} is not in the library, expected a name such as G2V, HD 40307 or Vega")
    return entry["name"]


def star_names() -> list[str]:
    """Every name of every embedded star, once."""
    rows = [row for row in library_table() if row["kept"] == "embedded"]
    names = [str(row[column]) for row in rows for column in ("name", "alias", "star")]
    # A collection's name in front of a type says nothing that the type does not.
    return [name for name in dict.fromkeys(names) if name and not name.startswith("Pickles ")]


@dataclass(frozen=True)
class Field:
    """One field.

    Attributes
    ----------
    label : str
    first : str
        What stands in it at first.
    read : callable
        Text to value; raises InputError with what is accepted.
    """

    label: str
    first: str
    read: Callable[[str], Any]


#: By name, as links and `Question` have them; the default is the paper's G2V star with a flare of 24 %.
FIELDS = {
    "star": Field("Library star", "G2V", star_name),
    "magnitude": Field("Magnitude of the star", "7.4", Number(-2, 25)),
    "band": Field("Band of the magnitude", "V", Choice(tuple(ALIASES))),
    "exposure_s": Field("Exposure, s; whole frames of 5 s", "50", Number(0.1, 86_400)),
    "temperature_c": Field("Detector temperature, deg C", "21", Number(-50, 60)),
    "instrument": Field("Payload", "mauve", Choice(("mauve", "mauve-electrons"))),
    "sky": Field("Sky", "brightness", Choice(SKIES)),
    "sky_brightness": Field("Sky brightness, V mag / arcsec2", "22.1", Number(10, 30)),
    "target": Field("Target: coordinates such as 290.68 +11.12", "", str),
    "time": Field("Time, UTC, such as 2026-09-01T12:00", "", str),
    "amplitude_percent": Field("Flare amplitude, %", "24", Number(0.0001, 1e5)),
    "flare_temperature_k": Field("Flare temperature, K", "10000", Number(1000, 100_000)),
    "statistic": Field("Detection statistic", "matched", Choice(tuple(STATISTICS))),
    "fap": Field("False-alarm probability per test", "0.001", Number(1e-6, 0.5)),
    "realisations": Field("Realisations", "100000", Choice(tuple(map(str, REALISATIONS)), int)),
    "unknown": Field("Unknown, drawn and marginalised over", UNKNOWN[0], Choice(UNKNOWN)),
    "own_unknown": Field("Also unknown: DN at nm, such as 200 1, 450 3, 700 1", "", points),
    "seed": Field("Seed", "1", Number(0, 2**31, whole=True)),
}
#: What a link holds beside the question.
SEEN = {
    "tab": Field("Tab", TABS[0], Choice(TABS)),
    "simulated": Field("Simulated", "", several),
}
