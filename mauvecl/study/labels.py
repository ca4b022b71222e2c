"""Labels of stars and cells, and columns that many tables share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from mauvecl.schema.tables import Column, percent, short
from mauvecl.study.quantities import QUANTITIES, UNITS
from mauvecl.study.sections import Star

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation
    from mauvecl.study.study import Study


def label(star: Star, x: Expectation) -> str:
    """Return a star's name and magnitude, for tables and plots."""
    name = star.library or x.name
    system = {"catalogue": "", "vega": " (Vega = 0)", "ab": " (AB)"}[star.magnitude_system]
    return name if star.magnitude is None else f"{name} {star.band} = {star.magnitude:g}{system}"


def prepend_columns(table: QTable, values: Mapping[str, float | str]) -> None:
    """Insert columns with constant values at the start of a table, in place."""
    import astropy.units as u

    for place, (name, value) in enumerate(values.items()):
        column = np.full(len(table), value)
        table.add_column(column * u.Unit(UNITS[name]) if name in UNITS else column, name=name, index=place)


def stack_tables(parts: Iterable[tuple[Mapping[str, float | str], QTable]], **meta: object) -> QTable:
    """Stack tables, each with columns of its own constant values; keep metadata that all share, and add `meta`."""
    from astropy.table import vstack

    tables = []
    for values, table in parts:
        prepend_columns(table, values)
        tables.append(table)
    shared = {k: v for k, v in tables[0].meta.items() if all(k in t.meta and t.meta[k] == v for t in tables)}
    for table in tables:
        table.meta = {}
    whole = vstack(tables)
    whole.meta |= shared | meta
    return describe_columns(whole)


def place_columns(study: Study, *own: str, star: str = "label") -> tuple[Column, ...]:
    """Return the columns of the star and of what a study sweeps, for rows with the values `at` a cell of the sweep.

    `own` names quantities for which a table has columns of its own, and `star` the attribute with the star's label.
    """
    return (
        star_column(star),
        *(quantity_column(axis.quantity) for axis in study.sweep.axes if axis.quantity not in own),
    )


def star_column(get: str = "star") -> Column:
    """Return the column of a star's label."""
    return Column("star", get, description=QUANTITIES["star"].description, heading="star", kind=str)


def quantity_column(name: str, get: str | Callable[[Any], Any] = "", description: str = "") -> Column:
    """Return the column of a quantity, by default of its value `at` a cell of the sweep."""
    quantity = QUANTITIES[name]
    return Column(
        name, get or (lambda row: row.at[name]), quantity.unit, description or quantity.description, name, short
    )


def amplitude_column(get: str | Callable[[Any], Any] = "amplitude", description: str = "") -> Column:
    """Return the column of a flare's amplitude, which people read in per cent."""
    return replace(quantity_column("amplitude", get, description), heading="flare", format=percent("g"))


def full_label(name: str, at: Mapping[str, float | str]) -> str:
    """Return a star's label with the swept values that the label does not contain, for plots."""
    parts = [
        f"{quantity.replace('_', ' ')} {value:g}{QUANTITIES[quantity].suffix}"
        for quantity, value in at.items()
        if quantity not in ("magnitude", "star") and not isinstance(value, str)
    ]
    return ", ".join([name, *parts])


#: Descriptions of columns that several tables share.
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


def describe_columns(table: QTable) -> QTable:
    """Add descriptions to the common columns of a table that have none, and return the table."""
    for name in table.colnames:
        if not table[name].info.description:
            table[name].info.description = COLUMNS.get(name)
    return table
