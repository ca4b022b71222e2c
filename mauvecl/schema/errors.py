"""Errors for invalid input, messages of answers, and text in them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

#: How a message on one value begins, as `InputError.of` writes it: its place and its key, and what follows them.
SUBJECT = re.compile(r"^(?P<place>[^:=]*: )?(?P<key>[a-z][\w. ]*?) (?P<verb>= |must be )")
#: A remedy in a message: `extend`, `resume=True`, `wavelength_unit='Angstrom'`, `fap=0.001`.
REMEDY = re.compile(r"`(?P<key>[a-z][\w.]*)(?:=(?P<quote>'?)(?P<value>[^`]*?)(?P=quote))?`")


class Message(str):
    """A sentence with its kind."""

    __slots__ = ("kind",)
    kind: str  # what the sentence is about, such as "saturated" or "wrong sign"; programs compare it, not the sentence

    def __new__(cls, text: str, kind: str = "") -> Message:
        """Make a message from its sentence and its kind."""
        self = super().__new__(cls, text)
        self.kind = kind
        return self

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]
        """Return the arguments of the constructor, for pickle."""
        return str(self), self.kind

    def about(self, subject: str) -> Message:
        """Return the message with its subject in parentheses at its end."""
        return Message(f"{self[:-1]} ({subject}).", self.kind)


def of_kind(messages: Iterable[str], kind: str) -> list[str]:
    """Return the messages of a kind."""
    return [message for message in messages if isinstance(message, Message) and message.kind == kind]


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


def counted(number: float, noun: str, *, spec: str = "") -> str:
    """Return a number with its noun, as in "1 frame" and "3 frames"."""
    return f"{number:{spec}} {noun}{'' if number == 1 else 's'}"


class InputError(ValueError):
    """Bad input from a user.

    The message is one sentence that names the input, its value and what is accepted. It names parameters of functions
    and keys of studies, with remedies in backticks, as in ```extend``` or ```resume=True```; the command line writes
    flags in their place and exits with code 2.

    Parameters
    ----------
    sentence : str
        What is wrong, with the value and what is accepted.
    key : str, optional
        The parameter, or the key of a study such as ``run.fap``; None for a fault that is not in one value.

    Attributes
    ----------
    parts : tuple of InputError
        The errors of which this one consists, if several values are wrong; its key is that of the first.
    """

    def __init__(self, sentence: str = "", *, key: str | None = None) -> None:
        super().__init__(sentence)
        #: The parameter, or the key of a study such as ``run.fap``; None for a fault that is not in one value.
        self.key = key
        #: The errors of which this one consists, if several values are wrong; its key is that of the first.
        self.parts: tuple[InputError, ...] = ()

    def within(self, place: str) -> InputError:
        """Return the same error with a place before its sentence, such as the name of a file."""
        return InputError(f"{place}: {self}", key=self.key)

    @classmethod
    def of(cls, key: str, value: Any, expected: str, *, unit: str = "", where: str = "") -> InputError:
        """Return the error of one value: ``where: key must be expected, not value unit``.

        Words such as "flare amplitude", and a flag, name the parameter `flare_amplitude`; the value is shown on one
        line, shortened.
        """
        place, after = f"{where}: " if where else "", f" {unit}" if unit else ""
        parameter = re.sub("[ -]", "_", key.strip("-"))
        return cls(f"{place}{key} must be {expected}, not {shown(value)}{after}", key=parameter)


def missing_package(package: str, purpose: str, extra: str) -> InputError:
    """Return the error of a package that is not installed, with the extra of mauvecl that brings it."""
    return InputError(f"{purpose} needs {package}, which is missing: `pip install 'mauvecl[{extra}]'`", key=package)


def together(errors: Sequence[InputError]) -> InputError:
    """Join the errors of several wrong values in one, with them as its `parts`; a single error is returned as it is."""
    if len(errors) == 1:
        return errors[0]
    joint = InputError("; ".join(map(str, errors)), key=errors[0].key)
    joint.parts = tuple(errors)
    return joint
