"""Piecewise linear curves of an instrument against wavelength."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.schema.errors import InputError

from ..tables.ecsv import read_numbers
from ..tables.units import unit_of


@dataclass(frozen=True)
class Curve:
    """A quantity against wavelength, linear between knots."""

    wavelength_nm: tuple[float, ...]  # knots, strictly increasing; a single knot makes the curve flat
    value: tuple[float, ...]  # at each knot, >= 0: a fraction, or A/W for a quantum efficiency
    source: str = "A: assumed, no source given"  # "tag: source" of the values

    def __post_init__(self) -> None:
        wavelength = np.asarray(self.wavelength_nm, dtype=np.float64)
        value = np.asarray(self.value, dtype=np.float64)
        if wavelength.ndim != 1 or wavelength.size == 0 or wavelength.shape != value.shape:
            raise InputError(
                f"a curve has {wavelength.size} wavelengths and {value.size} values",
                "as many, one or more",
                key="value",
                value=value.size,
            )
        if not (np.isfinite(wavelength).all() and (np.diff(wavelength) > 0).all()):
            raise InputError(
                "a curve's wavelengths are not finite and strictly increasing",
                "nm in order",
                key="wavelength_nm",
                value=wavelength,
            )
        bad = ~(np.isfinite(value) & (value >= 0))
        if bad.any():
            knot = int(np.argmax(bad))
            raise InputError.of("value", value[knot], "finite and >= 0", where=f"curve at {wavelength[knot]:g} nm")

    @classmethod
    def flat(cls, value: float, source: str = "A: assumed, no source given") -> Curve:
        """Return a curve with the same value at every wavelength."""
        return cls((0.0,), (value,), source)

    @classmethod
    def read(cls, path: str | Path) -> Curve:
        """Read an ECSV table of two columns with units: wavelength, and the value (A/W, per cent or dimensionless).

        The table's metadata give the values' origin: `tag` (P, D, C or A) and `source`. Raises InputError if the file
        is missing or is not such a table.
        """
        table = read_numbers(path, "curve file")
        if "wavelength" not in table.columns or len(table.columns) != 2:
            raise InputError(
                f"curve file {path} has the columns {', '.join(table.columns)}",
                "'wavelength' and one value",
                key="columns",
                value=table.columns,
            )
        name = next(column for column in table.columns if column != "wavelength")
        meta = table.meta
        try:
            length = unit_of(table.units["wavelength"]) if table.units["wavelength"] else None
            wavelength = _converted(table["wavelength"], "wavelength", length, [u.nm])
            # Here A is ampere, not Angstrom.
            unit = u.Unit(table.units[name].replace("percent", "%"), parse_strict="silent")
            value = _converted(table[name], name, unit, [u.A / u.W, u.dimensionless_unscaled])
            return cls(
                tuple(wavelength.tolist()),
                tuple(value.tolist()),
                f"{meta.get('tag', 'A')}: {meta.get('source', f'assumed, no source in {Path(path).name}')}",
            )
        except InputError as error:
            raise error.within(f"curve file {path}") from None

    def at(self, wavelength_nm: ArrayLike) -> NDArray[np.float64]:
        """Return the values at wavelengths in nm, shape of `wavelength_nm`; the end values hold beyond the knots."""
        return np.asarray(np.interp(np.asarray(wavelength_nm, np.float64), self.wavelength_nm, self.value))

    def covers(self, low_nm: float, high_nm: float) -> bool:
        """Return whether the knots reach from one wavelength to the other; a flat curve always does."""
        return len(self.value) == 1 or (self.wavelength_nm[0] <= low_nm and self.wavelength_nm[-1] >= high_nm)


def _converted(values: NDArray[np.float64], name: str, unit: u.UnitBase | None, units: list[u.UnitBase]) -> Any:
    """Return a column's numbers in the first of `units` that its unit converts to."""
    for wanted in units:
        if unit is not None and unit.is_equivalent(wanted):
            return (values * unit).to_value(wanted)
    raise InputError(f"column {name!r} has the unit {str(unit or '') or 'none'!r}", str(units[0]), key=name, value=unit)
