"""Many flares in one answer: bounded memory for each, and tables of a bounded size."""

import tracemalloc

import numpy as np
import pytest
from answers import small
from scenes import instrument, star

from mauvecl import Detection, Engine, detect


@pytest.mark.long
def test_memory_per_flare_is_bounded(engine: Engine) -> None:
    """Include bright flares, which fill many bins, and faint ones; a full histogram would take 2 MB."""
    payload = instrument(part=True, output_min_nm=300.0, output_max_nm=340.0)

    def seen(amplitudes: np.ndarray) -> Detection:
        quiet, *flares = star("G2V", 7.4, amplitudes=tuple(amplitudes), exposure=50.0, payload=payload)
        statistics = ("chi2", "chi2_element", "matched", "paper")
        return engine.detect(quiet, flares, realisations=20_000, seed=4, statistics=statistics)

    sizes = {}
    seen(np.array([0.1])).table(0.01)
    for number in (6, 22):
        tracemalloc.start()
        found = seen(np.geomspace(0.001, 3.0, number))
        found.table(0.01)
        for statistic in found.statistics:
            for flare in range(number):
                found.roc(statistic, flare)
        sizes[number] = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
    # The distributions of a flare have a few thousand filled bins each, of 32768.
    assert (sizes[22] - sizes[6]) / 16 < 700_000


@pytest.mark.long
def test_many_flares_share_table_rows(engine: Engine) -> None:
    """Sixty flares have fewer rows each, so that the tables have no more than 100 000."""
    amplitudes = np.linspace(0.01, 0.03, 60)
    study = small(
        star=[{"library": "G2V", "magnitude": 7.4}],
        flare={"amplitudes": amplitudes.tolist()},
        run={"realisations": 10_000, "fap": 0.01, "statistics": ["chi2", "matched"]},
    )
    answer = detect(study, engine)
    # chi2 has a null and sixty flares, matched a null for each of its sixty; rows are shared among 2 x (60 + 60).
    assert len(answer.tails) == 100_000 // 240 * (61 + 120)
    assert len(answer.roc) <= 100_000
    assert set(answer.roc["amplitude"]) == set(amplitudes)
    for rows in answer.roc.group_by(["statistic", "amplitude"]).groups:
        assert (rows["fap"].min(), rows["fap"].max()) == (0.0, 1.0)
    assert answer.plot() is not None
