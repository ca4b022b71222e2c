"""Readers of values that are written as text, as on the command line; each receives the value's name for messages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from decimal import Decimal, InvalidOperation
from typing import Any

from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.fields import Unit, is_measure, with_unit


def refusal(name: str, text: str, expected: str, more: str = "") -> InputError:
    """Return the error of a value's text; its key is the parameter that a flag sets, or else the value's name."""
    parameter = name.split()[0].strip("-").replace("-", "_")
    return InputError(f"{name} {shortened(text)}{more}", expected, key=parameter)


def number(text: str, name: str, unit: str = "") -> float:
    """Read a number in a unit, which may be followed by another one, as in "10 min" or "24%"."""
    try:
        value = with_unit(text, unit)
        return float(text) if value is None else value
    except ValueError as error:
        accepted = f" in {Unit(unit).written}, or in a unit of the same kind" if unit else ""
        raise refusal(name, text, f"a number{accepted}") from error


def count(text: str, name: str) -> int:
    """Read a whole number, also in the form 1e6."""
    try:
        exact = Decimal(text)
        # Writing out more digits than any count has would take forever.
        whole = int(exact) if exact.is_finite() and exact.adjusted() < 40 else None
    except InvalidOperation:
        exact, whole = Decimal(0), None
    if whole is None or whole != exact:
        raise refusal(name, text, "a whole number, such as 1000000 or 1e6")
    return whole


def several(texts: Sequence[str], name: str, read: Callable[[str, str], Any]) -> list[Any]:
    """Read values from several texts, each with one value or values with commas between them."""
    return [read(word.strip(), name) for text in texts for word in text.split(",")]


def words(texts: Sequence[str], name: str) -> list[str]:
    """Read names from several texts, each with one name or names with commas between them."""
    return several(texts, name, lambda word, _: word)


def axis(text: str, name: str) -> dict[str, Any]:
    """Read an axis: magnitude:4:10:16, amplitude:0.01:1:16:log, or exposure=5,50,600."""
    if "=" in text:
        quantity, _, values = text.partition("=")
        parts = [part.strip() for part in values.split(",")]
        try:
            return {"quantity": quantity, "values": parts if quantity == "star" else list(map(_measure, parts))}
        except ValueError as error:
            raise refusal(name, text, f"numbers, such as {quantity}=5,50,600") from error
    parts = text.split(":")
    try:
        quantity, start, stop, steps, *rest = parts
        spaced = {"quantity": quantity, "start": _measure(start), "stop": _measure(stop), "steps": int(steps)}
    except ValueError as error:
        raise refusal(name, text, "quantity:start:stop:steps, the same with :log, or quantity=a,b,c") from error
    if rest not in ([], ["log"]):
        raise refusal(name, text, "log or nothing", f" ends in {':'.join(rest)!r}")
    return spaced | {"log": bool(rest)}


def _measure(text: str) -> float | str:
    """Read a number; return a text with a unit unchanged, since the axis converts it."""
    return text if is_measure(text) else float(text)


def axes(texts: Sequence[str], name: str) -> list[dict[str, Any]]:
    """Read several axes."""
    return [axis(text, name) for text in texts]


def assignment(text: str, name: str, expected: str) -> tuple[str, str]:
    """Read a name and its value, with an equals sign between them."""
    key, _, value = (part.strip() for part in text.rpartition("="))
    if not (key and value):
        raise refusal(name, text, expected)
    return key, value


def line_fluxes(texts: Sequence[str], name: str) -> dict[str, float]:
    """Read fluxes of emission lines, such as 'Mg II=0.05'."""
    lines = {}
    for text in texts:
        line, value = assignment(text, name, "NAME=FLUX, such as 'Mg II=0.05'")
        lines[line] = number(value, f"{name} {shortened(text)}:")
    return lines


def gaps(texts: Sequence[str], name: str) -> list[tuple[float, float]]:
    """Read ranges of time such as 1000:2000."""
    return [_pair(text, name, "two times in s, such as 1000:2000", "s") for text in texts]


def wavelengths(texts: Sequence[str], name: str) -> list[tuple[float, float]]:
    """Read ranges of wavelengths such as 322:368."""
    return [_pair(text, name, "two wavelengths in nm, such as 322:368", "nm") for text in texts]


def declinations(text: str, name: str) -> tuple[float, float] | str:
    """Read a range of declinations such as -46.4:31.8, or none."""
    if text.strip().lower() == "none":
        return "none"
    return _pair(text, name, "low:high in degrees, or none", "deg")


def _pair(text: str, name: str, expected: str, unit: str) -> tuple[float, float]:
    """Read two numbers, each of which may have a unit of its own."""
    try:
        low, high = (number(part, name, unit) for part in text.split(":"))
    except ValueError as error:
        raise refusal(name, text, expected) from error
    return low, high


def frames(text: str, name: str) -> str | list[int]:
    """Read which frames are kept: stack, all, or numbers such as 0,4,9."""
    return text if text in ("stack", "all") else several([text], name, _frame)


def _frame(text: str, name: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise refusal(name, text, "stack, all, or numbers such as 0,4,9") from error
