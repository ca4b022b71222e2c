"""Flags' values as people write them: numbers, counts such as 1e6, lists such as 7,8; one sentence for what is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, get_args, get_origin

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened


def number(text: str, flag: str) -> float:
    """A number.

    Raises
    ------
    InputError
    """
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{flag} {shortened(text)}, expected a number") from error


def count(text: str, flag: str) -> int:
    """A whole number, also as 1e6.

    Raises
    ------
    InputError
    """
    try:
        exact = Decimal(text)
        # More digits than any count has would take for ever to write out.
        whole = int(exact) if exact.is_finite() and exact.adjusted() < 40 else None
    except InvalidOperation:
        exact, whole = Decimal(0), None
    if whole is None or whole != exact:
        raise InputError(f"{flag} {shortened(text)}, expected a whole number, such as 1000000 or 1e6")
    return whole


def several(texts: Sequence[str], flag: str, read: Callable[[str, str], Any]) -> list[Any]:
    """Values one by one or with commas between them."""
    return [read(word.strip(), flag) for text in texts for word in text.split(",")]


def as_text(kind: Any) -> tuple[Any, str, Callable[[str, str], Any] | None]:
    """A flag's kind as the command line takes it, what it is called, and what reads its value where that is a number.

    Parameters
    ----------
    kind : Annotated
        A type and a `typer.Option`, whose own limits are kept for the reader.
    """
    if get_origin(kind) is not Annotated:
        return kind, "", None
    wanted, option, *_ = get_args(kind)
    (inner, *_) = [one for one in (get_args(wanted) or (wanted,)) if one is not NoneType]
    many = get_origin(inner) is list or get_origin(wanted) is list
    each = get_args(inner)[0] if get_origin(inner) is list else inner
    if each not in (float, int):
        return kind, "", None
    option, low, high = copy(option), option.min, option.max
    option.min = option.max = None
    option.metavar = ("NUMBER" if each is float else "INTEGER") + (",..." if many else "")
    flag = next((one for one in option.param_decls or () if one.startswith("--")), "")
    read = partial(within, read=number if each is float else count, low=low, high=high)
    texts: Any = list[str] if many else str
    return Annotated[texts | None, option], flag, partial(several, read=read) if many else read


def within(text: str, flag: str, *, read: Callable[[str, str], Any], low: float | None, high: float | None) -> Any:
    """A number between two ends, either of which may be missing.

    Raises
    ------
    InputError
    """
    value = read(text, flag)
    if (low is not None and not value >= low) or (high is not None and not value <= high):
        reach = f"at least {low:g}" if high is None else f"{low:g} to {high:g}"
        raise InputError(f"{flag} {shortened(text)}, expected {reach}")
    return value


def axis_of(text: str, flag: str) -> dict[str, Any]:
    """An axis as a word: magnitude:4:10:16, amplitude:0.01:1:16:log, or exposure=5,50,600."""
    if "=" in text:
        quantity, _, values = text.partition("=")
        words = [word.strip() for word in values.split(",")]
        try:
            return {"quantity": quantity, "values": words if quantity == "star" else [float(word) for word in words]}
        except ValueError as error:
            raise InputError(f"{flag} {text!r}, expected numbers, such as {quantity}=5,50,600") from error
    parts = text.split(":")
    try:
        quantity, start, stop, steps, *rest = parts
        axis = {"quantity": quantity, "start": float(start), "stop": float(stop), "steps": int(steps)}
    except ValueError as error:
        raise InputError(
            f"{flag} {text!r}, expected quantity:start:stop:steps, with :log behind it if wanted, or quantity=a,b,c"
        ) from error
    if rest not in ([], ["log"]):
        raise InputError(f"{flag} {text!r} ends in {':'.join(rest)!r}, expected log or nothing")
    return axis | {"log": bool(rest)}


def lines_of(texts: Sequence[str], flag: str) -> dict[str, float]:
    """Read fluxes of emission lines, as in 'Mg II=0.05'."""
    lines = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.rpartition("="))
        if not (name and equals):
            raise InputError(f"{flag} {shortened(text)}, expected NAME=FLUX, such as 'Mg II=0.05'")
        lines[name] = number(value, f"{flag} {shortened(text)}:")
    return lines


def gap_of(text: str) -> tuple[float, float]:
    """A gap as a word: 1000:2000."""
    try:
        first, last = (float(word) for word in text.split(":"))
    except ValueError as error:
        raise InputError(f"--gap {text!r}, expected two times in s, such as 1000:2000") from error
    return first, last


def amplitudes_of(path: Path) -> list[float]:
    """Those of a table of flares, each once."""
    from mauvecl.host.stars.flare_table import read_flares

    return sorted({float(value) for value in read_flares(path)["amplitude"]})


def frames_of(text: str) -> str | list[int]:
    """Which frames are kept, as a word: stack, all, or 0,4,9."""
    if text in ("stack", "all"):
        return text
    return several([text], "--frames", _frame)


def _frame(text: str, flag: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise InputError(f"{flag} {shortened(text)}, expected stack, all, or numbers such as 0,4,9") from error


def names_of(texts: Sequence[str]) -> list[str]:
    """Names one by one or with commas between them."""
    return several(texts, "", lambda word, _: word)
