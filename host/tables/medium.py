"""Detection of wavelengths in air, and their conversion to vacuum."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.tables.fits import text_at
from mauvecl.schema.errors import InputError

Float = NDArray[np.float64]
Medium = Literal["air", "vacuum"]

#: Keywords that name the medium: of IRAF (AIRORVAC), MAST, surveys and users; and those that are true for one medium.
NAMED = ("AIRORVAC", "WAVEMED", "WAVETYPE", "MEDIUM", "WAVEREF", "WLTYPE", "LAMTYPE", "AIR_VAC", "AIRVAC", "VACORAIR",
         "VAC_AIR", "WAVELENGTH_MEDIUM", "WAVELENGTH_TYPE")  # fmt: skip
LOGICAL: dict[str, Medium] = {
    **dict.fromkeys(
        ("VACUUM", "VACWAVE", "VACLAM", "ISVAC", "INVAC", "IN_VACUUM", "VAC", "WAVE_VAC", "WAVEVAC", "VACWL"), "vacuum"
    ),
    **dict.fromkeys(("AIR", "AIRWAVE", "AIRLAM", "ISAIR", "IN_AIR", "WAVE_AIR", "WAVEAIR", "AIRWL"), "air"),
}
_OTHER: dict[Medium, Medium] = {"air": "vacuum", "vacuum": "air"}
_TRUE, _FALSE = ("true", "t", "yes", "y", "1", "1.0"), ("false", "f", "no", "n", "0", "0.0")

#: Words for air, including those of IVOA's UCD (em.wl;obs.atmos) and of FITS (AWAV).
_AIR = re.compile(
    r"\b(?:in|are|is|standard)\s+air\b|\bair\s+wavelengths?|wavelengths?\W{0,3}(?:\(|in\s+)?air\b|\bawav"
    r"|\bem\.wl;obs\.a|_air(?:\b|_)|\bair_|\(air\)",
    re.IGNORECASE,
)
_VACUUM = re.compile(r"(?:\b|_)vac(?:uum)?(?:\b|_)|\bvacuum", re.IGNORECASE)


def medium_of(*headers: Mapping[str, Any]) -> Medium | None:
    """Return the medium of wavelengths that keywords of headers state, or None.

    Raises InputError if keywords contradict each other, or one that states the medium has another value.
    """
    found: dict[str, Medium] = {}
    for header in headers:
        for key in map(str, header):
            name = re.sub(r"[\s-]+", "_", key.strip().upper())
            if name not in NAMED and name not in LOGICAL:
                continue
            medium = _stated(name, text_at(header, key).lower())
            if medium is not None:
                found[name] = medium
    if len(set(found.values())) > 1:
        words = " and ".join(f"{key} says {medium}" for key, medium in sorted(found.items()))
        raise InputError(f"its header contradicts itself: {words}", "one medium: `wavelength_unit='nm air'` says which",
                         key="wavelength_unit")  # fmt: skip
    return next(iter(found.values()), None)


def _stated(name: str, text: str) -> Medium | None:
    """Return the medium that a keyword's value states; None for no value, and for words on something else."""
    word: Medium | None = (
        "vacuum" if re.match(r"vac", text) else "air" if re.match(r"(?:in |standard )?air", text) else None
    )
    if name in NAMED or word is not None:
        return word
    if text in _TRUE:
        return LOGICAL[name]
    if text in _FALSE:
        return _OTHER[LOGICAL[name]]
    if not text or name in ("AIR", "VAC"):
        # Some observatories keep a pressure or a pump under these names.
        return None
    raise InputError.of(name, text, "true or false, or air or vacuum", where="its header")


def unit_and_medium(unit: str) -> tuple[str | None, Medium | None]:
    """Divide ``nm air`` or ``Angstrom (vacuum)`` into unit and medium."""
    match = re.fullmatch(r"\s*(.*?)[\s,;(\[_]*(?<![a-z])(?:in )?(air|vac(?:uum)?)[)\].]?\s*", unit, re.IGNORECASE)
    if match is None:
        return unit or None, None
    return match[1] or None, "air" if match[2].lower() == "air" else "vacuum"


def vacuum_wavelengths(
    nm: Float, column: str, remarks: str, given: Medium | None, keyword: Callable[[], Medium | None]
) -> tuple[Float, tuple[str, ...]]:
    """Return vacuum wavelengths, nm, and messages about them.

    Parameters
    ----------
    nm : ndarray, shape (n,)
    column : str
        Name of their column, which takes precedence over the header.
    remarks : str
        Text of the file's header.
    given : {"air", "vacuum"} or None
        Medium given by the user, or with the unit, which takes precedence over everything else.
    keyword : callable
        Function that returns the medium of keywords, which takes precedence over remarks.
    """
    messages: tuple[str, ...] = ()
    named, said = _words(column), _words(remarks)
    medium = given or (named if named != "both" else None) or keyword() or (said if said != "both" else None)
    if medium is None and "both" in (named, said):
        messages = ("its header speaks of air and of vacuum: ASSUMED vacuum; `wavelength_unit='nm air'` says air",)
    if medium != "air":
        return nm, messages
    return vacuum_from_air(nm), ("its wavelengths are in air, converted to vacuum (Ciddor 1996, above 200 nm)",)


def _words(text: str) -> Medium | Literal["both"] | None:
    """Return the medium that a text speaks of."""
    air, vacuum = bool(_AIR.search(text)), bool(_VACUUM.search(text))
    return "both" if air and vacuum else "air" if air else "vacuum" if vacuum else None


def vacuum_from_air(air_nm: Float) -> Float:
    """Return vacuum wavelengths, nm, of wavelengths in standard air (15 C, 101325 Pa, dry, 450 ppm CO2).

    Ciddor 1996, Applied Optics 35, 1566, equation 1, doi 10.1364/AO.35.001566. Wavelengths below 200 nm are vacuum
    wavelengths by convention and remain unchanged (Morton 1991, ApJS 77, 119).
    """
    vacuum = air_nm.copy()
    there = np.isfinite(air_nm) & (air_nm >= 200.0)
    for _ in range(4):
        # Squared wavenumber, um-2. The index hardly changes over the shift, so the iteration converges at once.
        wavenumber2 = (1000.0 / vacuum[there]) ** 2
        index = 1.0 + 0.05792105 / (238.0185 - wavenumber2) + 0.00167917 / (57.362 - wavenumber2)
        vacuum[there] = air_nm[there] * index
    return vacuum
