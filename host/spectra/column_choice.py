"""Choice of the columns of wavelength and flux by their roles; ambiguous choices raise InputError."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from mauvecl.host.spectra.column_roles import Role
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

#: Largest number of names in a message.
MAX_LISTED = 12
#: Names that can be typed between the brackets of ``FILE[name]``.
TYPED = re.compile(r"[^\[\],\"'\s](?:[^\[\],\"'\n\r\t]{0,38}[^\[\],\"'\s])?")
AXES = ("wavelength", "lower edge", "upper edge")


def plain(name: str) -> str:
    """Normalise a column's name for comparison: lower case, without quotes and repeated blanks."""
    return " ".join(name.strip().strip("\"'").lower().split())


def numbered(kind: str, word: str) -> int | None:
    """Return the index in a word such as ``row 3``, or None."""
    match = re.fullmatch(rf"{kind}\s+(\d{{1,9}})", word.strip(), re.IGNORECASE)
    return int(match[1]) - 1 if match and int(match[1]) > 0 else None


def listed(names: Sequence[str]) -> str:
    """Join names for a message; a long list ends with the number of omitted names."""
    shown = [name.strip()[:40] for name in names]
    return ", ".join(shown[:MAX_LISTED]) + (f" and {len(shown) - MAX_LISTED} more" if len(shown) > MAX_LISTED else "")


def as_typed(name: str, kind: str, place: int, names: Sequence[str] = ()) -> str:
    """Return ``FILE[name]`` for a message, or ``FILE[row 3]`` where the name cannot be typed or is not the only one."""
    word = name.strip()
    typed = TYPED.fullmatch(word) is not None and word.isprintable()
    alone = sum(plain(one) == plain(word) for one in names) < 2
    return f"FILE[{word}]" if typed and alone else f"FILE[{kind} {place + 1}]"


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
    if not indices and (place := numbered("column", name)) is not None and place < len(names):
        return place
    indices = indices or [i for i, one in enumerate(names) if plain(one) == plain(name)]
    if len(indices) != 1:
        fault = f"{'several columns are' if indices else 'no column is'} named {shortened(name)}"
        raise InputError(fault, f"one of {listed(names)}", key="columns", value=name)
    return indices[0]


def _wavelength(names: Sequence[str], roles: Sequence[Role]) -> tuple[int, ...]:
    if best := _best([(role.score, i) for i, role in enumerate(roles) if role.kind == "wavelength"]):
        return (_only("wavelength", names, best),)
    low, high = ([i for i, role in enumerate(roles) if role.kind == f"{side} edge"] for side in ("lower", "upper"))
    if low or high:
        return _only("lower edge of the bins", names, low), _only("upper edge of the bins", names, high)
    fault = f"no column is recognised as the wavelength among {listed(names) or 'none'}"
    raise InputError(
        fault, "one named wavelength: name two columns as in FILE[wavelength,flux]", key="columns", value=names
    )


def _flux(names: Sequence[str], roles: Sequence[Role], wavelength: tuple[int, ...]) -> int:
    rest = [i for i in range(len(names)) if i not in wavelength]
    for kind in ("flux", "model"):
        if best := _best([(roles[i].score, i) for i in rest if roles[i].kind == kind]):
            return _only("flux", names, best)
    unknown = [i for i in rest if roles[i].kind == "unknown"]
    if len(rest) == len(unknown) == 1:
        return unknown[0]
    shown = (unknown or rest or [0])[0]
    held = [f"{names[i].strip()[:40]} ({roles[i].kind})" for i in rest]
    fault = f"no column is recognised as a star's flux, only {listed(held) or 'the wavelength'}"
    expected = f"one named flux: name the column as in {as_typed(names[shown], 'column', shown, names)}"
    raise InputError(fault, expected, key="columns", value=held)


def _best(scored: list[tuple[int, int]]) -> list[int]:
    most = max((score for score, _ in scored), default=0)
    return [i for score, i in scored if score == most]


def _only(what: str, names: Sequence[str], indices: Sequence[int]) -> int:
    if len(indices) == 1:
        return indices[0]
    if not indices:
        fault = f"no column is the {what} among {listed(names) or 'none'}"
        raise InputError(fault, "both edges or the wavelength itself", key="columns", value=names)
    several = [names[i].strip() for i in indices]
    fault = f"{len(several)} columns may be the {what}: {listed(several)}"
    raise InputError(
        fault, f"one: name it as in {as_typed(several[-1], 'column', indices[-1], names)}", key="columns", value=several
    )
