"""Flares of neighbours that look like an observed event."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mauvecl import Frames, Instrument, Source, Study, analyse, expect
from mauvecl.answers.observations.neighbour_flares import NeighbourFlare, blended_stars
from mauvecl.study.cases import cases

SHARE = 0.8


@pytest.fixture
def study(tmp_path: Path) -> Study:
    (tmp_path / "near.csv").write_text("name,separation,magnitude,spectral_type\nB,8,10,M4V\nC,30,12,G2V\nD,60,1,A0V\n")
    star = {"library": "M3V", "magnitude": 9.0, "neighbours": tmp_path / "near.csv", "neighbour_share": SHARE}
    return Study.model_validate({"star": [star]})


def electrons(source: Source) -> float:
    return float(expect(source, Instrument.load("mauve"), exposure=50.0).source_electrons.sum())


def test_amplitudes_are_those_that_raise_the_light_as_much(study: Study) -> None:
    """The light of a flare of 60 % of each star, made by hand, needs a flare of 60 % of that star."""
    own, b, c = (Source.from_library(x).at_magnitude(m) for x, m in (("M3V", 9.0), ("M4V", 10.0), ("G2V", 12.0)))
    total = electrons(own) + SHARE * (electrons(b) + electrons(c))
    stars = blended_stars(cases(study, swept=False))
    assert [one.name for one in stars] == ["M3V V = 9", "B", "C"]
    for one, source, share in zip(stars, (own, b, c), (1.0, SHARE, SHARE), strict=True):
        rise = share * (electrons(source.flaring(0.6)) - electrons(source)) / total
        event: Any = SimpleNamespace(amplitude=rise, equivalent_duration_s=10 * rise)
        assert one.amplitude(event) == pytest.approx(0.6, rel=1e-9)
        assert NeighbourFlare("", event, one).equivalent_duration_s == pytest.approx(6.0, rel=1e-9)


def test_analyse_lists_stars_for_each_event(study: Study) -> None:
    rng = np.random.default_rng(3)
    time = np.arange(400) * 60.0
    flux = rng.normal(1000.0, 5.0, 400)
    flux[200:206] += [400, 300, 200, 120, 60, 30]
    answer = analyse(study, frames=Frames.of(time, flux, np.full(400, 5.0)))
    n = len(answer.events)
    assert n >= 1
    assert answer.tables["neighbour-flares"]["star"].tolist() == ["M3V V = 9", "B", "C"] * n
    assert len(answer.tables["events"]) == n
    assert "neighbours.ecsv" in answer.files
    assert any("assumption: 80 % of it enters" in text for text in answer.messages)
