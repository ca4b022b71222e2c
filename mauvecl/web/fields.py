"""Fields of the page: labels, defaults and parsers."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

from mauvecl.host.stars.band_names import ALIASES
from mauvecl.host.stars.catalogue import embedded, library_table
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, first, range_of, unit_of
from mauvecl.schema.physical import (
    Amplitude,
    AreaRatio,
    BalmerJump,
    DetectorTemperature,
    Exposure,
    LineFraction,
    Magnitude,
    Probability,
    SkyBrightness,
    Temperature,
)
from mauvecl.schema.text import shortened
from mauvecl.statistics.registry import STATISTICS
from mauvecl.study.orbits import PlanQuestion
from mauvecl.study.sections import Run
from mauvecl.web.simulations import SIMULATIONS

UPLOADED, UPLOADED_UNKNOWN = "uploaded star", "uploaded spectrum"
#: Realisations that a visitor may ask for, and with a tail by importance sampling.
REALISATIONS, SAMPLED = (10_000, 100_000, 1_000_000, 4_000_000), (100_000, 1_000_000)

#: Amplitudes in percent.
PERCENT = Range(100 * range_of(Amplitude).low, 100 * range_of(Amplitude).high)
#: Choices of what is unknown.
UNKNOWN = ("nothing", "the usual")
SKIES = ("brightness", "target and time", "none")
#: Characters of a field that are looked at.
MOST_CHARACTERS = 200


@dataclass(frozen=True)
class Number:
    """Number in a range, written with a decimal point."""

    range: Range
    whole: bool = False
    unit: str = ""

    def __call__(self, text: str) -> float | int:
        """Parse the number; an error states what is accepted."""
        kind = "a whole number" if self.whole else "a number"
        accepted = self.range.words(self.unit, whole=self.whole)
        form = r"[+-]?\d+" if self.whole else r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?"
        if not text.strip():
            raise InputError("nothing is entered", accepted, key="number", value=text)
        if re.fullmatch(form, text.strip(), flags=re.ASCII) is None:
            point = ", with a point for decimals" if "," in text else ""
            raise InputError(f"{shortened(text)} is not {kind}", f"{accepted}{point}", key="number", value=text)
        value = int(text) if self.whole else float(text)
        if value not in self.range:
            raise InputError(f"{shortened(text.strip())} is out of range", accepted, key="number", value=value)
        return value


def number_of(kind: Any) -> Number:
    """Return the parser of a number in the unit and range of an annotation."""
    return Number(range_of(kind), unit=unit_of(kind))


@dataclass(frozen=True)
class Choice:
    """One of several words."""

    options: tuple[str, ...]
    made: Callable[[str], Any] = str

    def __call__(self, text: str) -> Any:
        """Parse the value; an error states what is accepted."""
        if text not in self.options:
            raise InputError(
                f"{shortened(text)} is no choice here", f"one of {', '.join(self.options)}", key="choice", value=text
            )
        return self.made(text)


def several(text: str) -> tuple[str, ...]:
    """Parse names of simulations, without repetitions."""
    names = [name for name in text.split(",") if name]
    if len(names) > len(SIMULATIONS) or not set(names) <= SIMULATIONS.keys():
        raise InputError(
            f"{shortened(text)} is no simulation", f"some of {', '.join(SIMULATIONS)}", key="simulated", value=text
        )
    return tuple(dict.fromkeys(names))


def points(text: str) -> tuple[tuple[float, float], ...] | None:
    """Parse a spectrum as pairs of nm and DN of the exposure; None for an uploaded one."""
    if text == UPLOADED_UNKNOWN:
        return None
    number = Number(Range(-1e30, 1e30))
    pairs = [pair.split() for pair in text.split(",") if text.strip()]
    if any(len(pair) != 2 for pair in pairs):
        raise InputError(
            f"{shortened(text)} is no spectrum",
            "pairs of nm and DN with commas between them",
            key="own_unknown",
            value=text,
        )
    spectrum = tuple((float(number(nm)), float(number(dn))) for nm, dn in pairs)
    if any(low >= high for (low, _), (high, _) in itertools.pairwise(spectrum)):
        raise InputError(
            f"{shortened(text)} does not ascend in nm", "pairs of nm and DN that do", key="own_unknown", value=text
        )
    return spectrum


def optional(number: Number) -> Callable[[str], float | int | None]:
    """Return a parser that takes nothing entered for None."""
    return lambda text: number(text) if text.strip() else None


def line_fluxes(text: str) -> tuple[tuple[str, float], ...]:
    """Parse emission lines such as "Mg II = 0.03, Balmer = 0.1"."""
    from mauvecl.host.stars.flare_spectra import EmissionLine

    pairs = [pair.partition("=") for pair in text.split(",") if text.strip()]
    fractions = tuple(
        (EmissionLine.named(name).name, float(number_of(LineFraction)(value))) for name, _, value in pairs
    )
    if len(dict(fractions)) < len(fractions):
        raise InputError(f"{shortened(text)} holds a line twice", "each once", key="lines", value=text)
    return fractions


class Draws(NamedTuple):
    """Number of realisations, and whether the tail beyond them is sampled."""

    number: int
    tails: str


def draws(text: str) -> Draws:
    """Parse a choice such as "100000" or "100000 sampled"."""
    number, _, tails = text.partition(" ")
    return Draws(int(number), tails or "counted")


def star_name(text: str) -> str:
    """Return the library's name of a star from any of its names, except stars stored on the server."""
    if text == UPLOADED:
        return UPLOADED
    if not text.strip():
        raise InputError("no star is chosen", "a name of the library, or an upload", key="star", value=text)
    entry = embedded(_spaced().get(_key(text), text))
    if entry is None:
        raise InputError(
            f"{shortened(text)} is not in the library", "a name such as G2V, HD 40307 or Vega", key="star", value=text
        )
    return entry["name"]


def seen_target(text: str) -> str:
    """Parse a target: empty, a name of the embedded list, or coordinates."""
    from mauvecl.host.orbit.targets import Target

    try:
        if text.strip():
            Target.of(text)
    except InputError as error:
        raise InputError(
            f"{shortened(text)} is neither a target of the list nor coordinates",
            "a name such as eps Eri or AU Mic, or coordinates such as 53.23 -9.46",
            key="see",
            value=text,
        ) from error
    return text


def star_names() -> list[str]:
    """Return the distinct names of all embedded stars."""
    rows = [row for row in library_table() if row["kept"] == "embedded"]
    names = [str(row[column]) for row in rows for column in ("name", "alias", "star")]
    # A collection's name in front of a type says nothing that the type does not.
    return [name for name in dict.fromkeys(names) if name and not name.startswith("Pickles ")]


def _key(name: str) -> str:
    return "".join(name.split()).casefold()


@cache
def _spaced() -> dict[str, str]:
    """Normalise the case and spacing of a name, as in GJ581, gj 581 and GJ  581."""
    return {_key(name): name for name in star_names()}


def star_words(name: str) -> str:
    """Describe a star of the library by its type and the star of its spectrum."""
    entry = embedded(name)
    star = name if entry is None else entry["star"]
    if star == name:
        return f"a star like {'the ' if name == 'Sun' else ''}{name}"
    article = "an" if name[0] in "AFM" else "a"
    return f"{article} {name} star" + ("" if star.startswith("Pickles ") else f" (spectrum of {star})")


@dataclass(frozen=True)
class Slider:
    """Range and step of a slider, additive or by factors; exposures move by whole frames."""

    low: float
    high: float
    step: float
    log: bool = False


@dataclass(frozen=True)
class Field:
    """Field of the page.

    Attributes
    ----------
    label : str
    first : str
        What stands in it at first.
    read : callable
        Text to value; raises InputError with what is accepted.
    told : str
        What it means, for who asks.
    unit : str
    slider : Slider, optional
    """

    label: str
    first: str
    read: Callable[[str], Any]
    told: str = ""
    unit: str = ""
    slider: Slider | None = None


#: By name, as links and `Question` have them; the default is a flare at the edge of detection.
FIELDS = {
    "star": Field(
        "Star", "G2V", star_name,
        "Whose spectrum: a spectral type of the library, one of its stars by any name (GJ 581, HD 40307), or your own "
        "file.",
    ),
    "magnitude": Field(
        "Magnitude", "8.5", number_of(Magnitude), "How bright the star is without the flare, in the band beside it.",
        slider=Slider(0, 15, 0.1),
    ),
    "band": Field(
        "Band", "V", Choice(tuple(ALIASES)), "The band of the magnitude. In V, Vega has 0.03, as in catalogues."
    ),
    "amplitude_percent": Field(
        "Flare amplitude", "2", Number(PERCENT),
        "By how much the flare at its peak brightens the star in the band of the Kepler satellite. In the ultraviolet "
        "the rise is many times as large.",
        "%", Slider(0.01, 1000, 10**0.1, log=True),
    ),
    "exposure_s": Field(
        "Exposure", "50", number_of(Exposure), "Time on the star; whole frames of 5 s are added up.", "s",
        Slider(5, 3600, 5),
    ),
    "flare_temperature_k": Field(
        "Flare temperature", "10000", number_of(Temperature),
        "The flare shines as a blackbody of this temperature. The hotter, the more of its light is ultraviolet.", "K",
        Slider(5000, 30_000, 500),
    ),
    "balmer_jump": Field(
        "Balmer jump", "", optional(number_of(BalmerJump)),
        "Flux just below 364.6 nm over that just above, by hydrogen recombination: 1 to 4 in most flares. Nothing: a "
        "plain blackbody.",
    ),
    "second_temperature_k": Field(
        "Second temperature", "", optional(number_of(Temperature)),
        "A second blackbody in the flare, instead of a Balmer jump. Nothing: there is none.", "K",
    ),
    "second_area": Field(
        "Second area", "0.05", number_of(AreaRatio),
        "Area at the second temperature over that at the first, if there is one.",
    ),
    "lines": Field(
        "Emission lines", "", line_fluxes,
        "Flux of lines as a fraction of the continuum's in 200-700 nm, such as Mg II=0.03, Ca II=0.02, Balmer=0.1, or "
        "280=0.03 for one at 280 nm.",
    ),
    "temperature_c": Field(
        "Detector temperature", "21", number_of(DetectorTemperature), "The dark current doubles every few degrees.",
        "deg C", Slider(-10, 40, 1),
    ),
    "instrument": Field(
        "Payload", "mauve", Choice(("mauve", "mauve-electrons")),
        "mauve as its paper has it, or with the dark current counted in electrons.",
    ),
    "signal": Field(
        "Counted as signal", "net", Choice(("net", "paper")),
        "In the S/N: the light of the star alone (net), or that of the sky too, as in the MauveSim paper. It moves no "
        "detection.",
    ),
    "sky": Field("Sky", "brightness", Choice(SKIES), "Zodiacal light behind the star."),
    "sky_brightness": Field(
        "Sky brightness", "22.1", number_of(SkyBrightness),
        "Of the zodiacal light, V magnitudes per square arc second.",
        "mag/arcsec²", Slider(20, 24, 0.1),
    ),
    "target": Field("Target", "", str, "Coordinates in degrees such as 290.68 +11.12."),
    "time": Field("Time, UTC", "", str, "Such as 2026-09-01T12:00."),
    "statistic": Field(
        "Detection statistic", "matched", Choice(tuple(STATISTICS)),
        "; ".join(f"{name}: {one.definition}" for name, one in STATISTICS.items()) + ".",
    ),
    "fap": Field(
        "False-alarm probability", "0.001", number_of(Probability),
        "How often noise alone passes for a flare, per test: it sets the threshold.", "per test",
        Slider(1e-6, 0.1, 10**0.1, log=True),
    ),
    "unknown": Field(
        "Unknown", UNKNOWN[0], Choice(UNKNOWN),
        "What differs from exposure to exposure and is not known: the usual are detector temperature, light lost and "
        "sky. They are drawn, and the statistic is made blind to them.",
    ),
    "own_unknown": Field(
        "Own unknown spectrum", "", points,
        "Something else of known shape and unknown strength, such as stray light: pairs of nm and DN, as in "
        "200 1, 450 3, 700 1, or a file of two columns.",
    ),
    "see": Field(
        "Target to see", "", seen_target,
        "When it can be seen is on the tab Visibility: a name such as eps Eri or AU Mic, or coordinates such as "
        "53.23 -9.46.",
    ),
    "hours": Field(
        "Hours of the campaign", "100", Number(first(PlanQuestion.model_fields["hours"], Range) or Range(), unit="h"),
        "How long the target is observed, at most: what would be found is on the tab Plan.", "h", Slider(10, 1000, 10),
    ),
    "realisations": Field(
        "Realisations", "100000",
        Choice((*map(str, REALISATIONS), *(f"{count} sampled" for count in SAMPLED)), draws),
        "How many noisy exposures a simulation draws. At least 100 must lie beyond the threshold; a sampled tail "
        "(importance sampling) needs fewer.",
    ),
    "seed": Field(
        "Seed", "1", Number(first(Run.model_fields["seed"], Range) or Range(), whole=True),
        "The same seed gives the same noise, to the bit.",
    ),
}  # fmt: skip
#: Fields that show at once, and the others by what they are about.
ASKED = ("star", "magnitude", "band", "amplitude_percent", "exposure_s")
ADVANCED = {
    "Detection": ("fap", "statistic", "realisations", "seed"),
    "Flare's spectrum": ("flare_temperature_k", "balmer_jump", "second_temperature_k", "second_area", "lines"),
    "Detector": ("temperature_c", "instrument"),
    "Sky": ("sky", "sky_brightness", "target", "time", "signal"),
    "Unknown": ("unknown", "own_unknown"),
    "Visibility and plan": ("see", "hours"),
}
#: Fields that ask for something under one sky only.
ASKED_UNDER = {"sky_brightness": "brightness", "target": "target and time", "time": "target and time"}
#: Questions to begin with; the amplitudes of the first two are the paper's smallest, the others are examples (assumed).
PRESETS: dict[str, dict[str, str]] = {
    "Edge of detection": {},
    "Paper: G2V, V = 7.4": {"magnitude": "7.4", "amplitude_percent": "0.76"},
    "Paper: K3V, V = 3.7": {"star": "K3V", "magnitude": "3.7", "amplitude_percent": "0.76"},
    "M dwarf": {"star": "GJ 581", "magnitude": "10.6", "amplitude_percent": "10"},
    "Active G star": {"star": "G8V", "magnitude": "6.5", "amplitude_percent": "0.5", "exposure_s": "100"},
}
