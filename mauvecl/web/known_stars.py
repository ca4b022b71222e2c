"""Facts about the stars that a visitor enters, from the list of well-known stars."""

from __future__ import annotations

from typing import Any

from mauvecl.host.stars.library import resolve
from mauvecl.schema.errors import InputError
from mauvecl.study.orbits import PlanTarget
from mauvecl.web.fields import UPLOADED, targets
from mauvecl.web.sentences import sentence
from mauvecl.web.state import State


def known(state: State) -> dict[str, Any]:
    """Return the known values of the star and of each target, and the values that can be entered for it.

    Returns
    -------
    dict
        ``star`` with ``about`` in words, ``given``, texts of fields, and ``offer``, the words of a button that enters
        them; ``targets``, for each row texts by the columns of the table.
    """
    return {"star": _star(state.entered["star"]), "targets": [_target(row) for row in _rows(state.entered["targets"])]}


def _star(text: str) -> dict[str, Any]:
    star = None if text == UPLOADED else resolve(text, own=False)
    if star is None:
        return {"about": "", "given": {}, "offer": ""}
    given: dict[str, str] = {}
    about = "" if star.known is None else star.known.about
    if star.known is not None:
        given |= {"magnitude": f"{star.known.magnitude:g}", "band": "V", "target": star.name}
    if star.spectrum is None:
        given["star"] = star.nearest
        at = "" if star.known is None else f" at V = {star.known.magnitude:g}"
        return {"about": about, "given": given, "offer": f"Use {star.nearest}{at}"}
    return {"about": about, "given": given, "offer": f"Use V = {star.known.magnitude:g}" if star.known else ""}


def _rows(text: str) -> list[dict[str, Any]]:
    """Return the rows of a table, without the check of their names."""
    try:
        return list(targets(text, check=False))
    except InputError:
        return []


def _target(row: dict[str, Any]) -> dict[str, str]:
    try:
        star = PlanTarget.model_validate(row).target(simbad=False)
    except InputError as error:
        return {"fault": sentence(error)}
    facts = {"spectral_type": star.spectral_type, "V": star.magnitude, "distance_pc": star.distance_pc}
    found = {
        key: "" if value is None else f"{value:g}" if isinstance(value, float) else value
        for key, value in facts.items()
    }
    return found | {"coordinates": f"{star.ra_deg:.3f} {star.dec_deg:+.3f}", "about": star.source}
