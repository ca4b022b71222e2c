"""Exception for bad input."""

from __future__ import annotations

import re
from typing import Any

#: The usual sentence: ``key = value, expected this``, after the name of a file or section where there is one.
_SENTENCE = re.compile(
    r"(?:[^:=]*: )?(?P<key>[A-Za-z_][\w. ]*?) = (?P<value>.+?)(?:, expected (?P<expected>.+))?$", re.S
)


class InputError(ValueError):
    """Bad input from a user.

    The message is one sentence that names the input, its value and what is accepted. It names parameters of functions
    and keys of studies, with remedies in backticks, as in ```extend``` or ```resume=True```; the command line writes
    flags in their place and exits with code 2.

    Attributes
    ----------
    key : str or None
        The parameter, or the key of a study such as ``run.fap``; None where the fault is not in one value.
    value : object
        As it was given, or as the message shows it.
    expected : str or None
        What is accepted.
    """

    def __init__(
        self, message: str = "", *, key: str | None = None, value: Any = None, expected: str | None = None
    ) -> None:
        super().__init__(message)
        shown = _SENTENCE.match(message)
        if key is None and shown is not None:
            key, value = shown["key"].replace(" ", "_"), shown["value"] if value is None else value
        if expected is None and ", expected " in message:
            expected = message.partition(", expected ")[2]
        self.key, self.value, self.expected = key, value, expected
