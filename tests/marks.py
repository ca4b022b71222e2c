"""Which cases of a test `make test` leaves to `make test-long`."""

from collections.abc import Iterable
from typing import Any

import pytest


def long_but(cases: Iterable[Any], *short: Any) -> list[Any]:
    """Mark all parameters, or tuples of them, as long except for some."""
    cases = list(cases)
    assert all(case in cases for case in short)
    given = [case if isinstance(case, tuple) else (case,) for case in cases]
    marks = [() if case in short else pytest.mark.long for case in cases]
    return [pytest.param(*case, marks=mark) for case, mark in zip(given, marks, strict=True)]
