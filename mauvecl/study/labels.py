"""What rows of answers are called, and what their readers must be told."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from mauvecl.noise.cumulants import Cumulants, stack_is_exact
from mauvecl.noise.varied import VARIED
from mauvecl.study.quantities import QUANTITIES, UNITS
from mauvecl.study.sections import Star

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation
    from mauvecl.noise.processes import Processes


#: Read noise, DN, from which rounding is like noise whatever the light: the wave that it leaves of the sawtooth's first
#: harmonic is exp(-2 pi^2), 3e-9, or less.
NOISY_DN = 1.0
#: Rounding of a prior's ends.
TINY = 1e-9
#: How messages on saturation begin, and how many of them an answer has at most.
SATURATED = "SATURATED"
MOST_SATURATED = 12


def label(star: Star, x: Expectation) -> str:
    """A star's name with its magnitude, for tables and pictures."""
    name = star.library or x.name
    system = {"catalogue": "", "vega": " (Vega = 0)", "ab": " (AB)"}[star.magnitude_system]
    return name if star.magnitude is None else f"{name} {star.band} = {star.magnitude:g}{system}"


def told(expectations: list[Expectation], processes: Processes | None = None) -> list[str]:
    """Return their messages and where closed forms do not hold, as `worst_first` has them.

    Every answer reports the saturation of its stars and flares through this function.
    """
    texts = [message for x in expectations for message in (*x.messages, *_coarse(x))]
    return worst_first([*(_off_centre(expectations, processes) if processes else ()), *texts])


def _off_centre(expectations: list[Expectation], processes: Processes) -> list[str]:
    """Return a sentence for each prior that does not contain what an expectation has, which the observer expects."""
    sentences = []
    for name, _ in processes.modulations:
        first, last = getattr(processes, name).quantile(np.array([0.0, 1.0]))
        values = {VARIED[name].expected_in(x.conditions) for x in expectations}
        outside = sorted(value for value in values if not first - TINY <= value <= last + TINY)
        if outside:
            sentences.append(
                f"OUTSIDE THE PRIOR: {name} is drawn from {first:g} to {last:g}, and the expectation, which is "
                f"subtracted, has {', '.join(f'{value:g}' for value in outside)}: every exposure differs from it, and "
                "thresholds hold that difference."
            )
    return sentences


def worst_first(messages: Iterable[str]) -> list[str]:
    """Return messages once each, those on saturation first; of many of these, as a large map has, the rest as one."""
    once = list(dict.fromkeys(messages))
    saturated = [text for text in once if text.startswith(SATURATED)]
    rest = len(saturated) - MOST_SATURATED
    if rest > 0:
        more = f"{SATURATED}: pixels of {rest} more stars, flares or exposures of this answer saturate."
        saturated = [*saturated[:MOST_SATURATED], more]
    return saturated + [text for text in once if not text.startswith(SATURATED)]


def _coarse(x: Expectation) -> tuple[str, ...]:
    """The sentence on pixels that rounding rules, if any."""
    if float(np.min(x.read_noise_dn)) >= NOISY_DN:
        return ()
    pixels = int(np.count_nonzero(~stack_is_exact(Cumulants.of(x, 1), x)))
    if not pixels:
        return ()
    return (
        f"In {pixels} of {x.wavelength_nm.size} pixels of {x.name} a frame has too little noise for its rounding to "
        "whole DN to be like noise: closed forms take it for noise, and are wrong there; simulations round each frame.",
    )


def put_first(table: QTable, values: Mapping[str, float | str]) -> None:
    """Columns of one value each in front of a table, with their units."""
    import astropy.units as u

    for place, (name, value) in enumerate(values.items()):
        column = np.full(len(table), value)
        table.add_column(column * u.Unit(UNITS[name]) if name in UNITS else column, name=name, index=place)


def stacked(parts: Iterable[tuple[Mapping[str, float | str], QTable]], **meta: object) -> QTable:
    """One table of many, each with columns of its own values in front; of their meta data what all agree on.

    Parameters
    ----------
    parts : iterable of (mapping, QTable)
    **meta
        Meta data of the whole.
    """
    from astropy.table import vstack

    tables = []
    for values, table in parts:
        put_first(table, values)
        tables.append(table)
    shared = {k: v for k, v in tables[0].meta.items() if all(k in t.meta and t.meta[k] == v for t in tables)}
    for table in tables:
        table.meta = {}
    whole = vstack(tables)
    whole.meta |= shared | meta
    return described(whole)


def titled(name: str, at: Mapping[str, float | str]) -> str:
    """A star with the values of its cell, for pictures; its magnitude and name are there already."""
    parts = [
        f"{quantity.replace('_', ' ')} {value:g}{QUANTITIES[quantity].suffix}"
        for quantity, value in at.items()
        if quantity not in ("magnitude", "star") and not isinstance(value, str)
    ]
    return ", ".join([name, *parts])


#: What columns hold that many tables have.
COLUMNS = (
    {name: quantity.description for name, quantity in QUANTITIES.items()}
    | {
        "statistic": "detection statistic",
        "template": "amplitude of the flare that the statistic looks for",
        "wavelength": "vacuum wavelength, the middle of the pixel or element",
        "threshold": "value at and above which a detection is claimed",
        "fap_low": "95 % interval of the false-alarm probability, lower end",
        "fap_high": "95 % interval of the false-alarm probability, upper end",
        "probability_low": "95 % interval of the detection probability, lower end",
        "probability_high": "95 % interval of the detection probability, upper end",
        "area_low": "95 % interval of the area, lower end",
        "area_high": "95 % interval of the area, upper end",
        "realisation": "number of the realisation, by which it can be drawn again",
        "source_photon": "photon noise of the star, rms",
        "zodiacal_photon": "photon noise of the zodiacal light, rms",
        "dark": "noise of the dark current, rms",
        "read": "read noise, rms",
        "total": "all of them in quadrature, without the ADC's rounding",
        "why": "main cause of a difference from the closed form",
        "per": "pixel, or resolution element of 10.5 nm",
        "wanted": "wanted S/N",
        "frames": "frames of the exposure",
        "snr": "closed-form S/N reached",
        "snr_one_frame_less": "closed-form S/N of one frame less",
        "matters_most": "unknown that explains most of the limits' variance",
        "assumption": "what is assumed of the instrument",
        "low_end": "lower end of its sensible range",
        "high_end": "upper end of its sensible range",
        "at_low_end": "closed-form limit with the assumption at its lower end",
        "at_high_end": "closed-form limit with the assumption at its upper end",
        "temperature_c": "detector temperature of the draw, deg C",
        "light_loss": "light loss of the draw",
        "pointing_loss": "pointing loss of the draw",
        "qe_scale": "factor on the quantum efficiency of the draw",
        "conversion_uv_per_electron": "charge conversion of the draw, uV per electron",
        "read_noise_dn": "read noise of the draw, DN",
    }
    | {f"q{p}": f"{p} % quantile of the realisations" for p in ("0.135", "2.5", "16", "50", "84", "97.5", "99.865")}
)


def described(table: QTable) -> QTable:
    """The table, its common columns described where they are not yet."""
    for name in table.colnames:
        if not table[name].info.description:
            table[name].info.description = COLUMNS.get(name)
    return table
