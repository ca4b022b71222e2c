"""Refusals of bad input: tests check the key, the value and what is expected, not the sentence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from mauvecl import InputError

_ANY = object()


@contextmanager
def refused(
    key: str | None, *facts: str, value: Any = _ANY, expected: str | None = None
) -> Iterator[pytest.ExceptionInfo]:
    """Check that the block raises an InputError of one sentence about a key.

    Parameters
    ----------
    key : str or None
        The parameter, or key of a study, that the error names.
    facts : str
        Numbers and names that the sentence must give.
    value : object, optional
        The error's value.
    expected : str, optional
        What the error says is accepted, or the part of it that matters.
    """
    with pytest.raises(InputError) as caught:
        yield caught
    error = caught.value
    assert error.key == key, f"{error.key}: {error}"
    if value is not _ANY:
        assert error.value == value, str(error)
    assert error.expected, f"nothing is expected in: {error}"
    if expected is not None:
        assert expected in error.expected, str(error)
    for fact in facts:
        assert fact in str(error), str(error)
    assert "\n" not in str(error)


#: A call that raises, the key that its error names, and numbers and names of its sentence.
Row = tuple[Callable[[], object], str, *tuple[str, ...]]


def check(row: Row) -> None:
    """Check that the call of a row raises its error."""
    call, key, *facts = row
    with refused(key, *facts):
        call()
