"""Required wavelength range of a star's spectrum, and the likely unit of wavelengths without one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError

Float = NDArray[np.float64]

#: Range of the nominal instrument, nm (the paper's abstract).
NEEDED_NM = (200.0, 700.0)
#: The same, extended by the reach of the line spread function (the paper, section "Preparing the input spectrum").
SPAN_NM = (180.0, 750.0)
#: Fraction of `NEEDED_NM` that a spectrum must cover; with less, nearly all of the light would be another star's.
MIN_MEASURED = 1 / 3
#: Range of wavelengths, nm, outside which an assumed unit is unlikely.
PLAUSIBLE_NM = (50.0, 10_000.0)
#: A step between points is a gap if it exceeds this width, nm, and this multiple of the usual spacing.
GAP_NM, GAP_TIMES = 10.5, 10.0
#: Likely units of wavelengths without a stated unit, in nm.
_USUAL_UNITS = {"nm": 1.0, "Angstrom": 0.1, "um": 1000.0}


def measured_part(nm: Float) -> float:
    """Return the fraction of `NEEDED_NM` that wavelengths cover, without gaps."""
    if nm.size < 2:
        return 0.0
    inside = np.clip(nm, *NEEDED_NM)
    steps = np.diff(nm)
    return float(np.diff(inside)[~is_gap(steps)].sum() / (NEEDED_NM[1] - NEEDED_NM[0]))


def is_gap(steps: Float) -> NDArray[np.bool_]:
    """Return which of the steps between wavelengths, nm, are gaps."""
    wide: NDArray[np.bool_] = (steps > GAP_NM) & (steps > GAP_TIMES * np.median(steps))
    return wide


def _part(low: float, high: float) -> float:
    shared = min(high, NEEDED_NM[1]) - max(low, NEEDED_NM[0])
    return max(0.0, shared / (NEEDED_NM[1] - NEEDED_NM[0]))


def likely_unit(low: float, high: float, unit: str) -> str | None:
    """Return the only unit other than `unit` in which the numbers cover the required range, or None."""
    parts = {other: _part(low * factor, high * factor) for other, factor in _USUAL_UNITS.items() if other != unit}
    fitting = [other for other, part in parts.items() if part >= MIN_MEASURED and low > 0.0]
    # Short ultraviolet spectra cover part of the range in Angstrom, but would start in the infrared in nm.
    if not fitting and parts.get("Angstrom", 0.0) > 0.0 and low > 900.0:
        fitting = ["Angstrom"]
    return fitting[0] if len(fitting) == 1 else None


def check_assumed_unit(values: Float, unit: str) -> None:
    """Raise InputError if another unit of the wavelengths is as likely as the assumed one."""
    finite = values[np.isfinite(values)]
    factor = _USUAL_UNITS.get(unit)
    if not finite.size or factor is None:
        return
    low, high = float(finite.min()), float(finite.max())
    own = _part(low * factor, high * factor)
    other = likely_unit(low, high, unit)
    elsewhere = 0.0 if other is None else _part(low * _USUAL_UNITS[other], high * _USUAL_UNITS[other])
    named = "their unit: `wavelength_unit` names it"
    if own < MIN_MEASURED and other is not None:
        fault, expected = f"look like {other}", f"their unit: `wavelength_unit={other!r}`"
    elif other is not None and elsewhere >= max(own, 1.0 - 1e-9):
        fault = f"cover {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm in {other} as well as in {unit}"
        expected = f"their unit: `wavelength_unit={unit!r}` or `wavelength_unit={other!r}`"
    elif own < MIN_MEASURED:
        fault = f"would hold {own:.0%} of {NEEDED_NM[0]:g}-{NEEDED_NM[1]:g} nm in {unit}"
        expected = f"at least a third, or {named}"
    elif low * factor < PLAUSIBLE_NM[0] or high * factor > PLAUSIBLE_NM[1]:
        fault, expected = f"would extend beyond {PLAUSIBLE_NM[0]:g}-{PLAUSIBLE_NM[1]:g} nm in {unit}", named
    else:
        return
    numbers = f"wavelengths from {low:g} to {high:g} without a stated unit"
    raise InputError(f"{numbers} {fault}", expected, key="wavelength_unit", value=unit)
