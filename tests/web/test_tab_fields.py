"""Fields of each tab: those that it shows change its answer, and others do not."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("tornado")
pytest.importorskip("bokeh")

from mauvecl.web.closed_forms import ClosedForms
from mauvecl.web.fields import FIELDS
from mauvecl.web.state import State
from mauvecl.web.tabs import TABS
from mauvecl.web.visitor import shown

#: Another valid text for every field.
OTHER = {
    "star": "K5V", "magnitude": "9", "band": "B", "amplitude_percent": "3", "exposure_s": "100", "fap": "0.01",
    "statistic": "chi2", "realisations": "1000000", "flare_temperature_k": "12000", "balmer_jump": "2",
    "lines": "Mg II=0.03", "second_temperature_k": "20000", "second_area": "0.3", "temperature_c": "5", "sky": "none",
    "sky_brightness": "21", "target": "53.2 -9", "time": "2027-01-20", "unknown": "the usual",
    "own_unknown": "200 1, 700 2", "see": "AU Mic", "hours": "50", "seed": "7", "signal": "paper",
    "instrument": "mauve-electrons", "visits": "5",
}  # fmt: skip
#: What must be entered first for a field to apply.
BEFORE = {
    "target": {"sky": "target and time", "target": "eps Eri", "time": "2027-01-15"},
    "time": {"sky": "target and time", "target": "eps Eri", "time": "2027-01-15"},
    "second_area": {"second_temperature_k": "20000"},
}


@cache
def pictures(tab: str, given: tuple[tuple[str, str], ...], folder: Path) -> str:
    """Return what a tab shows without a simulation."""
    return json.dumps(shown(tab, forms(given, folder), {}), default=str)


@cache
def forms(given: tuple[tuple[str, str], ...], folder: Path) -> ClosedForms:
    state = State()
    state.enter(dict(given))
    return ClosedForms.of(state.question(), folder)


def test_every_field_has_another_text() -> None:
    assert OTHER.keys() == FIELDS.keys()


@pytest.mark.parametrize("name", OTHER)
def test_every_tab_is_drawn_for_every_field(name: str, tmp_path: Path) -> None:
    given: dict[str, Any] = BEFORE.get(name, {}) | {name: OTHER[name]}
    for tab in TABS:
        assert pictures(tab, tuple(given.items()), tmp_path)
