"""Exception for bad input."""

from __future__ import annotations

from typing import Any

from mauvecl.schema.text import shown


class InputError(ValueError):
    """Bad input from a user.

    The message is one sentence that names the input, its value and what is accepted. It names parameters of functions
    and keys of studies, with remedies in backticks, as in ```extend``` or ```resume=True```; the command line writes
    flags in their place and exits with code 2.

    Parameters
    ----------
    fault : str
        What is wrong.
    expected : str, optional
        What is accepted; ends the sentence.
    key : str, optional
        The parameter, or the key of a study such as ``run.fap``.
    value : object, optional
        The value of the key.

    Attributes
    ----------
    key : str or None
        The parameter, or the key of a study such as ``run.fap``; None for a fault that is not in one value.
    value : object
        As it was given, or as the message shows it.
    expected : str or None
        What is accepted.
    """

    def __init__(
        self, fault: str = "", expected: str | None = None, *, key: str | None = None, value: Any = None
    ) -> None:
        super().__init__(f"{fault}, expected {expected}" if expected else fault)
        self.key, self.value, self.expected = key, value, expected

    def within(self, place: str) -> InputError:
        """Return the same error with a place before its sentence, such as the name of a file."""
        return reworded(self, f"{place}: {self}")

    @classmethod
    def of(cls, key: str, value: Any, expected: str, *, unit: str = "", where: str = "") -> InputError:
        """Return the error of one value: ``where: key = value unit, expected this``.

        Parameters
        ----------
        key : str
            The parameter or key. Words such as "flare amplitude" name the parameter `flare_amplitude`.
        value : object
            Shown on one line, shortened.
        expected : str
            What is accepted.
        unit : str, optional
            Unit of a plain number.
        where : str, optional
            File or section that holds the value.
        """
        place, after = f"{where}: " if where else "", f" {unit}" if unit else ""
        return cls(f"{place}{key} = {shown(value)}{after}", expected, key=key.replace(" ", "_"), value=value)


def reworded(error: InputError, sentence: str) -> InputError:
    """Return the same error with another sentence."""
    found = InputError(sentence, key=error.key, value=error.value)
    found.expected = error.expected
    return found
