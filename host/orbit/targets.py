"""Targets by name or coordinates: the embedded list, and SIMBAD on request."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from ..sky.helioecliptic import parse_position
from ..stars import well_known
from ..stars.star_names import near_names
from ..stars.well_known import by_key, name_key
from ..tables.coordinates import EXPECTED
from ..tables.ecsv import parse_ecsv
from ..tables.missing import is_missing_position
from ..tables.times import offline
from .earth import direction

if TYPE_CHECKING:
    from astropy.table import Table

#: Timeout of a SIMBAD query, s.
TIMEOUT_S = 10.0


@dataclass(frozen=True)
class Target:
    """A position on the sky and the known properties of the star there."""

    name: str
    ra_deg: float  # ICRS, as the declination
    dec_deg: float
    source: str  # origin of the position
    distance_pc: float | None = None
    magnitude: float | None = None  # in V
    spectral_type: str | None = None

    @classmethod
    def of(cls, text: str, *, name: str | None = None, simbad: bool = False) -> Target:
        """Resolve a name of the embedded list or coordinates.

        Parameters
        ----------
        text : str
            A name, or ICRS coordinates: degrees ("290.0 -11.2") or sexagesimal ("19h22m00s -11d12m00s").
        name : str, optional
            Name of the target in reports. The default is the list's name, or `text`.
        simbad : bool
            Whether to query SIMBAD for a name that is not embedded (needs `mauvecl[names]` and a network).
        """
        if is_missing_position(text):
            raise InputError(
                f"target {shortened(text)} is a pair of missing values", EXPECTED, key="target", value=text
            )
        star = by_key().get(name_key(text))
        if star is not None:
            return cls(name or star.name, star.ra_deg, star.dec_deg, f"embedded list ({star.source})",
                       star.distance_pc, star.magnitude, star.spectral_type)  # fmt: skip
        if re.match(r"\s*[^\W\d]", text) and not re.match(r"\s*ra\W*\d", text, re.IGNORECASE):
            if simbad:
                return _from_simbad(text, name)
            like = ", ".join(near_names(text, stars_only=True))
            raise InputError(
                f"target {shortened(text)} is not in the embedded list",
                f"a name such as {like}, coordinates such as '290.0 -11.2', or `simbad=True` to ask SIMBAD",
                key="target",
                value=text,
            )
        with offline():
            place = parse_position(text).icrs
        return cls(name or text.strip(), float(place.ra.deg), float(place.dec.deg), "given")

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector, ICRS, shape (3,)."""
        return direction(self.ra_deg, self.dec_deg)


@cache
def _list() -> Table:
    return parse_ecsv(well_known.text(), "the embedded list of stars")


def target_table() -> Table:
    """Return the embedded stars.

    Returns
    -------
    Table
        Columns name, ra, dec (deg, ICRS), distance (pc), V, spectral_type, other_names and source.
    """
    return _list().copy()


#: ADQL query of SIMBAD (tried with astroquery 0.4.11). The left join keeps stars without a V magnitude.
SIMBAD_QUERY = (
    'SELECT basic.ra, basic.dec, basic.plx_value, basic.sp_type, allfluxes."V" FROM ident JOIN basic '
    "ON ident.oidref = basic.oid LEFT JOIN allfluxes ON allfluxes.oidref = basic.oid WHERE ident.id = '{}'"
)


def _from_simbad(text: str, name: str | None) -> Target:
    """Query SIMBAD, with a timeout."""
    try:
        from astroquery.simbad import Simbad
    except ImportError:
        raise InputError(
            f"target {shortened(text)} is not in the embedded list and astroquery is missing",
            "coordinates, or `pip install 'mauvecl[names]'`",
            key="target",
            value=text,
        ) from None
    query = SIMBAD_QUERY.format(text.strip().replace("'", "''"))
    try:
        table = _within(TIMEOUT_S, lambda: Simbad.query_tap(query))
    except Exception as error:  # astroquery raises many kinds for a network failure
        raise InputError(
            f"target {shortened(text)} is not in the embedded list and SIMBAD did not answer within {TIMEOUT_S:g}"
            f" s ({type(error).__name__})",
            "a network, or coordinates",
            key="target",
            value=text,
        ) from error
    if table is None or len(table) == 0:
        raise InputError(
            f"target {shortened(text)} is unknown to SIMBAD", "another name, or coordinates", key="target", value=text
        )
    row = table[0]

    def number(column: str) -> float | None:
        value = row[column]
        return None if np.ma.is_masked(value) or not np.isfinite(float(value)) else float(value)

    parallax, ra, dec = number("plx_value"), number("ra"), number("dec")
    if ra is None or dec is None:
        raise InputError(
            f"target {shortened(text)} has no coordinates in SIMBAD", "another name", key="target", value=text
        )
    distance = None if parallax is None or parallax <= 0 else 1000 / parallax
    kind = None if np.ma.is_masked(row["sp_type"]) else str(row["sp_type"]).strip() or None
    return Target(name or text.strip(), ra, dec, "SIMBAD", distance, number("V"), kind)


def _within(seconds: float, ask: Callable[[], Any]) -> Any:
    """Call a function and raise TimeoutError if it takes too long, since astroquery's requests may never return."""
    answers: list[Any] = []
    failed: list[BaseException] = []

    def run() -> None:
        try:
            answers.append(ask())
        except Exception as error:
            failed.append(error)

    # A daemon thread does not delay the exit of the program.
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    if failed:
        raise failed[0]
    if not answers:
        raise TimeoutError
    return answers[0]
