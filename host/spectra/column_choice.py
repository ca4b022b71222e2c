"""Choice of the columns of wavelength and flux by their roles; ambiguous choices raise InputError."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from ..files.parsing import part_to_name
from .column_roles import Role

#: Largest number of names in a message.
MAX_LISTED = 12
AXES = ("wavelength", "lower edge", "upper edge")


def plain(name: str) -> str:
    """Normalise a column's name for comparison: lower case, without quotes and repeated blanks."""
    return " ".join(name.strip().strip("\"'").lower().split())


def listed(names: Sequence[str]) -> str:
    """Join names for a message; a long list ends with the number of omitted names."""
    shown = [name.strip()[:40] for name in names]
    return ", ".join(shown[:MAX_LISTED]) + (f" and {len(shown) - MAX_LISTED} more" if len(shown) > MAX_LISTED else "")


@dataclass(frozen=True)
class Choice:
    """Indices of the columns of a spectrum: one wavelength or both edges of each bin, and the flux."""

    wavelength: tuple[int, ...]
    flux: int


def choose(names: Sequence[str], roles: Sequence[Role], asked: Sequence[str] = ()) -> Choice:
    """Choose the columns of wavelength and flux.

    Parameters
    ----------
    roles : sequence of Role
        Role of each column.
    asked : sequence of str
        Columns named by the user: a flux, a wavelength, or both.
    """
    wanted = [_named(name, names) for name in asked]
    if len(wanted) > 2:
        raise InputError.of("columns", asked, "one flux, and one wavelength at most")
    axes = [i for i in wanted if roles[i].kind in AXES]
    if len(wanted) == 2 and not axes:
        axes = wanted[:1]
    wavelength = (axes[0],) if axes else _wavelength(names, roles)
    rest = [i for i in wanted if i not in wavelength]
    if len(rest) > 1:
        raise InputError.of("columns", asked, "one flux, and one wavelength at most")
    return Choice(wavelength, rest[0] if rest else _flux(names, roles, wavelength))


def _named(name: str, names: Sequence[str]) -> int:
    indices = [i for i, one in enumerate(names) if one.strip() == name]
    indices = indices or [i for i, one in enumerate(names) if plain(one) == plain(name)]
    if len(indices) != 1:
        raise InputError(
            f"{'several columns are' if indices else 'no column is'} named {shortened(name)}",
            f"one of {listed(names)}",
            key="columns",
            value=name,
        )
    return indices[0]


def _wavelength(names: Sequence[str], roles: Sequence[Role]) -> tuple[int, ...]:
    if best := _best([(role.score, i) for i, role in enumerate(roles) if role.kind == "wavelength"]):
        return (_only("wavelength", names, best),)
    low, high = ([i for i, role in enumerate(roles) if role.kind == f"{side} edge"] for side in ("lower", "upper"))
    if low or high:
        return _only("lower edge of the bins", names, low), _only("upper edge of the bins", names, high)
    raise InputError(
        f"no column is recognised as the wavelength among {listed(names) or 'none'}",
        "one named wavelength: name two columns as in FILE[wavelength,flux]",
        key="columns",
        value=names,
    )


def _flux(names: Sequence[str], roles: Sequence[Role], wavelength: tuple[int, ...]) -> int:
    rest = [i for i in range(len(names)) if i not in wavelength]
    for kind in ("flux", "model"):
        if best := _best([(roles[i].score, i) for i in rest if roles[i].kind == kind]):
            return _only("flux", names, best)
    unknown = [i for i in rest if roles[i].kind == "unknown"]
    if len(rest) == len(unknown) == 1:
        return unknown[0]
    held = [f"{names[i].strip()[:40]} ({roles[i].kind})" for i in rest]
    raise InputError(
        f"no column is recognised as a star's flux, only {listed(held) or 'the wavelength'}",
        part_to_name([names[i] for i in unknown or rest or [0]], "one named flux"),
        key="columns",
        value=held,
    )


def _best(scored: list[tuple[int, int]]) -> list[int]:
    most = max((score for score, _ in scored), default=0)
    return [i for score, i in scored if score == most]


def _only(what: str, names: Sequence[str], indices: Sequence[int]) -> int:
    if len(indices) == 1:
        return indices[0]
    if not indices:
        raise InputError(
            f"no column is the {what} among {listed(names) or 'none'}",
            "both edges or the wavelength itself",
            key="columns",
            value=names,
        )
    several = [names[i].strip() for i in indices]
    raise InputError(
        f"{len(several)} columns may be the {what}: {listed(several)}",
        part_to_name(reversed(several), "a file with one of them, or names without commas and brackets"),
        key="columns",
        value=several,
    )
