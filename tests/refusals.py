"""Refusals of bad input: tests check the key and facts in the sentence."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from mauvecl import InputError


@contextmanager
def refused(key: str | None, *facts: str) -> Iterator[pytest.ExceptionInfo]:
    """Check that the block raises an InputError of one sentence about a key, with these numbers and names."""
    with pytest.raises(InputError) as caught:
        yield caught
    error = caught.value
    assert error.key == key, f"{error.key}: {error}"
    assert says_what_is_accepted(str(error)), f"nothing is expected in: {error}"
    for fact in facts:
        assert fact in str(error), str(error)
    assert "\n" not in str(error)


@contextmanager
def failed(kind: str, *facts: str) -> Iterator[None]:
    """Check that the block raises a RuntimeError of a kind, whose sentence gives these facts."""
    with pytest.raises(RuntimeError) as caught:
        yield
    assert caught.value.kind == kind
    for fact in facts:
        assert fact in str(caught.value), str(caught.value)


def says_what_is_accepted(message: str) -> bool:
    """Return whether the sentence of an error says what is accepted."""
    return bool(re.search(r"\b(expected|needs?|must|may|give|use|try|wait|start|install|did you mean)\b", message))
