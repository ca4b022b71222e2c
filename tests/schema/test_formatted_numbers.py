"""Numbers of tables as people read them."""

from __future__ import annotations

import numpy as np
import pytest

from mauvecl.schema.tables import Column, formatted, interval, number


@pytest.mark.parametrize(
    ("value", "spec", "text"),
    [
        (10_000.0, ".4g", "10000"),
        (16_976.4, ".4g", "16980"),
        (999_999.0, ".3g", "1e+06"),
        (123_456.0, ".3g", "123000"),
        (-40_123.0, ".3g", "-40100"),
        (1.5e-11, ".3g", "1.5e-11"),
        (3.3e12, ".3g", "3.3e+12"),
        (10_000.0, ".1e", "1.0e+04"),
        (np.float64(200_000.0), "g", "200000"),
        (7, "", "7"),
    ],
)
def test_numbers_below_a_million_have_no_power_of_ten(value: float, spec: str, text: str) -> None:
    assert formatted(value, spec) == text
    assert Column("value", format=spec).text({"value": value}) == text


def test_undefined_numbers_are_empty() -> None:
    assert number(".4g")(float("nan")) == ""
    assert number(".4g")(12_345.0) == "12340"
    assert interval(".3g")(9_876.0, 12_345.0) == "[9880, 12300]"
