"""Unit and range of a number in an annotation."""

from __future__ import annotations

from typing import Annotated, Any

import astropy.units as u
import pytest

from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit
from mauvecl.schema.section import Section


class Example(Section):
    exposure: Annotated[float, Unit("s"), Range(0, 86_400, open_low=True)] = 50.0
    temperature: Annotated[float | None, Unit("deg_C"), Range(-40, 60)] = None
    width: Annotated[float, Unit("nm"), Range(0)] = 1.0
    loss: Annotated[float, Range(0, 1, open_high=True)] = 0.1
    size: Annotated[int, Range(1, 5)] = 1
    count: Annotated[int, Range(1)] = 1
    value: Annotated[float, Range()] = 1.0
    band: Annotated[tuple[float, float], Unit("nm")] = (1.0, 2.0)


@pytest.mark.parametrize(
    ("key", "value", "plain"),
    [
        ("exposure", 1 * u.min, 60.0),
        ("exposure", 86_400, 86_400.0),
        ("temperature", 300 * u.K, 26.85),
        ("temperature", None, None),
        ("width", 1 * u.PHz, 299.792458),
        ("size", 5.0, 5),
        ("loss", 10 * u.percent, 0.1),
        ("band", [1, 2] * u.um, (1000.0, 2000.0)),
        ("band", [1 * u.um, 2 * u.um], (1000.0, 2000.0)),
    ],
)
def test_values_in_range_are_plain_numbers(key: str, value: Any, plain: Any) -> None:
    assert getattr(Example(**{key: value}), key) == (plain if plain is None else pytest.approx(plain))


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("exposure", 0, "seconds above 0 and up to 86400"),
        ("exposure", 3 * u.kg, "seconds above 0 and up to 86400"),
        ("exposure", "a minute", "seconds above 0 and up to 86400"),
        ("exposure", float("nan"), "seconds above 0 and up to 86400"),
        ("temperature", 61, "-40 to 60 deg C"),
        ("width", -1 * u.um, "nm of at least 0"),
        ("loss", 1, "a number of at least 0 and below 1"),
        ("size", 6, "a whole number from 1 to 5"),
        ("size", 1.5, "a whole number from 1 to 5"),
        ("count", 0, "a whole number of at least 1"),
        ("value", float("inf"), "a number"),
        ("band", [1, 2] * u.s, "nm"),
    ],
)
def test_other_values_raise(key: str, value: Any, expected: str) -> None:
    with pytest.raises(InputError) as error:
        Example(**{key: value})
    assert (error.value.key, error.value.expected) == (key, expected)
