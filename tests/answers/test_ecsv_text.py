"""Tables as text equal those that astropy writes, to the last byte."""

from __future__ import annotations

import io

import astropy.units as u
import numpy as np
import pytest
from astropy.table import MaskedColumn, QTable, Table

from mauvecl.answers.files import ecsv_text

FLOATS = [0.1, -0.0, 1e-5, 9.9999e-5, 1e16, 123456789012345680.0, 1e22, 5e-324, 1.7976931348623157e308, 1 / 3, 2.0]
WORDS = ["G2V", "", "K3V V = 3.7", 'said "so"', "a,b", "#", "-", "two  spaces", "tab\there", "\u03bb", "0.1"]
TABLES = {
    "numbers": Table({"x": FLOATS, "y": np.array(FLOATS) > 1, "n": np.arange(11)}),
    "short floats": Table({"x": np.array([0.1, 1e-5, 9741.536, 3e38, 1e-45], np.float32), "h": np.float16([0.1] * 5)}),
    "no numbers": Table({"x": [np.nan, np.inf, -np.inf]}),
    "large": Table({"n": np.array([2**64 - 1, 0], np.uint64), "m": np.array([-(2**63), 2**63 - 1])}),
    "words": Table({"word": WORDS, "other": WORDS[::-1]}, meta={"study": "star = 1\n"}),
    "one column of words": Table({"word": WORDS}),
    "quantities": QTable({"t": [1.5, 2.5] * u.s, "f": np.float32([1.1, 2.2]) * u.DN}),
    "masked": Table({"x": MaskedColumn([1.0, 2.0], mask=[True, False]), "word": ["a", "b"]}),
    "nothing masked": Table({"x": MaskedColumn([1.0, 2.0])}, masked=True),
    "pairs": Table({"p": np.arange(6.0).reshape(3, 2), "n": [1, 2, 3]}),
    "objects": Table({"o": np.array([{"a": 1}, [2]], object)}),
    "no rows": Table({"x": np.empty(0), "word": np.empty(0, "U3")}),
    "nothing": Table(),
}


@pytest.mark.parametrize("name", TABLES)
def test_ecsv_text_equals_that_of_astropy(name: str) -> None:
    table, exact = TABLES[name], io.StringIO()
    table.write(exact, format="ascii.ecsv")
    assert ecsv_text(table) == exact.getvalue()
