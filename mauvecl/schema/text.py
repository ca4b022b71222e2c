"""Values and foreign text for messages: on one line, printable, of bounded length."""

from __future__ import annotations

from typing import Any


def shortened(text: str, most: int = 80) -> str:
    """Return foreign text for a message: quoted, on one line, of bounded length."""
    return repr(text if len(text) <= most else f"{text[: most - 23]}...{text[-20:]}")


def shown(value: Any, most: int = 80) -> str:
    """Return any value for a message, however large or deep."""
    if hasattr(value, "unit"):
        return printable(str(value), most)
    if hasattr(value, "dtype") and getattr(value, "ndim", 1) == 0:
        # NumPy's numbers print their type as well.
        value = value.item()
    try:
        return printable(" ".join(repr(value).split()) if hasattr(value, "dtype") else repr(value), most)
    except (ValueError, RecursionError):
        # Python does not print integers of more than some thousand digits.
        return f"a value of the type {type(value).__name__}"


def printable(text: str, most: int) -> str:
    """Return text on one line, of bounded length, in printable characters."""
    if len(text) > most:
        text = f"{text[: most - 23]}...{text[-20:]}"
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
