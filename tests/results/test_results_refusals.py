"""Bad input of detections, campaigns and fits: each row is a call, the key of its error, and facts of its sentence."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from refusals import Row, check
from scenes import instrument, star

from mauvecl import (
    Comparison,
    Detection,
    Engine,
    FlareModel,
    Instrument,
    Linear,
    Processes,
    Source,
    Study,
    Uniform,
    detect,
    expect,
    fit,
    fit_two_temperatures,
)
from mauvecl.results.detection.campaign import campaign

PAYLOAD = instrument(part=True)
MAUVE = Instrument.load("mauve")


@cache
def detection(statistics: Any = ("matched",), realisations: int = 1000, **how: Any) -> Detection:
    quiet, flare = star(amplitudes=(0.24,), payload=PAYLOAD)
    return Engine().detect(quiet, [flare], realisations=realisations, seed=1, statistics=statistics, **how)


def weighted(weights: np.ndarray, name: str = "mine") -> None:
    detection((Linear(name, weights),))


def tilted(**how: Any) -> None:
    """Sample a rare tail."""
    detection(("chi2",), 100, tails="sampled", **how).threshold(1e-6)


def without_ultraviolet() -> None:
    quiet, flare = star(amplitudes=(0.1,), payload=instrument(output_min_nm=400.0, output_max_nm=500.0))
    Engine().detect(quiet, [flare], realisations=10, seed=1, statistics=("uv_excess",))


def campaign_of(**asked: Any) -> None:
    detect(Study.build({"campaign": asked}, "test"), Engine())


@cache
def source() -> Source:
    return Source.from_library("M3V").at_magnitude(9.0)


@cache
def quiet() -> Any:
    return expect(source(), MAUVE, exposure=50.0)


def model(**how: Any) -> FlareModel:
    return FlareModel.of(source(), MAUVE, quiet(), **how)


def shape(*n_frames: int) -> np.ndarray:
    return np.zeros((*n_frames, quiet().wavelength_nm.size))


DETECTIONS: list[Row] = [
    (lambda: detection().threshold(0.5, "chi2"), "statistic", "'chi2'"),
    (lambda: detection().distribution("matched", 1), "flare", "1"),
    (lambda: detection().threshold(1e-5, "matched"), "fap"),
    *[(lambda fap=fap: detection().threshold(fap, "matched"), "fap") for fap in (0.0, 1.0, -1.0, np.nan)],
    (lambda: detection(("chi3",)), "statistic", "'chi3'"),
    (without_ultraviolet, "statistic", "200-360"),
    (lambda: weighted(np.ones(5)), "weights", "5"),
    (lambda: weighted(np.zeros(198)), "weights"),
    (lambda: weighted(np.full(198, np.nan)), "weights", "198"),
    (lambda: weighted(np.ones((2, 99))), "weights", "2", "99"),
    (lambda: weighted(np.ones(198), "chi2"), "statistics"),
    (lambda: tilted(recipe="apart"), "tails", "apart"),
    (lambda: tilted(mode="frames"), "tails", "frames"),
    (lambda: tilted(processes=Processes(jitter=Uniform(0.0, 0.05))), "tails", "priors"),
    (lambda: tilted(comparison=Comparison(40)), "tails", "40"),
    (lambda: detection(("chi2",), 100, tails="sampled").threshold(1e-12), "fap", "1e-12"),
]
CAMPAIGNS: list[Row] = [
    (lambda: campaign(0.0, 10), "fap"),
    (lambda: campaign(0.1, 10, 20, step=1), "step"),
    (lambda: campaign(0.1, 10, 2, step=3), "step"),
    (lambda: campaign(0.1, 10, 2, step=0), "step"),
    (lambda: campaign_of(fap=0.01), "campaign.fap"),
    (lambda: campaign_of(frames=10, fap=2.0), "campaign.fap", "2"),
    (lambda: campaign_of(frames=17_280, alarms=1e5), "campaign.alarms", "100000", "1728"),
]
FITS: list[Row] = [
    (lambda: fit(np.zeros((2, 7)), quiet(), model()), "frames", "2", "7"),
    (lambda: fit(shape(0), quiet(), model()), "frames", "0"),
    (lambda: fit(shape() * np.nan, quiet(), model()), "frames"),
    (lambda: fit(quiet().recorded_dn, quiet(), model(), levels=(95.0,)), "levels"),
    (lambda: model(lines=("X",)), "lines", "'X'"),
    (lambda: model(distance_pc=-1.0), "distance_pc", "-1"),
    (lambda: model(bands_nm=((300.0, 200.0),)), "bands_nm"),
    (lambda: model().counts(100.0, [0.1]), "temperature_k", "100"),
    (lambda: model().counts(9000.0, [0.1, 0.2]), "amplitudes"),
    (lambda: model().amplitudes(9000.0, 0.1, jump=2.0), "jump"),
    (lambda: fit_two_temperatures(quiet().recorded_dn, quiet(), model(jump=True)), "model"),
]


@pytest.mark.parametrize("row", [*DETECTIONS, *CAMPAIGNS, *FITS], ids=lambda row: row[1])
def test_bad_input_raises(row: Row) -> None:
    check(row)
