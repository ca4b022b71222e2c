"""Hundreds of flares: bounded memory for each, and equal results however they are divided."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from answers import small
from scenes import instrument, star

from mauvecl import Detection, Engine, detect
from mauvecl import detect as module
from mauvecl.pictures import answers as pictures
from mauvecl.results.requests.requests import DetectRequest, Shard
from mauvecl.results.shard_sums import DetectionSums, pack_detection

PAYLOAD = instrument(part=True, output_min_nm=300.0, output_max_nm=340.0)
KIND = {"realisations": 20_000, "seed": 4, "statistics": ("chi2", "chi2_element", "matched", "paper")}
#: Bytes that a flare may keep: its distributions have a few thousand filled bins each, of 32768.
MOST_OF_A_FLARE = 700_000


def seen(engine: Engine, amplitudes: np.ndarray) -> Detection:
    quiet, *flares = star("G2V", 7.4, amplitudes=tuple(amplitudes), exposure=50.0, payload=PAYLOAD)
    return engine.detect(quiet, flares, **KIND)


@pytest.mark.long
def test_batches_of_flares_equal_all_at_once(engine: Engine) -> None:
    amplitudes = np.geomspace(0.001, 3.0, 40)
    table = seen(engine, amplitudes).table(0.01)
    n = len(KIND["statistics"])
    for first in range(0, 40, 7):
        part = seen(engine, amplitudes[first : first + 7]).table(0.01)
        whole = table[n * first : n * (first + 7)]
        for name in part.colnames:
            np.testing.assert_array_equal(part[name], whole[name])


@pytest.mark.long
def test_memory_per_flare_is_bounded(engine: Engine) -> None:
    """Include bright flares, which fill many bins, and faint ones; a full histogram would take 2 MB."""
    sizes = {}
    seen(engine, np.array([0.1])).table(0.01)
    for number in (6, 22):
        tracemalloc.start()
        found = seen(engine, np.geomspace(0.001, 3.0, number))
        found.table(0.01)
        for statistic in found.statistics:
            for flare in range(number):
                found.roc(statistic, flare)
        sizes[number] = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
    assert (sizes[22] - sizes[6]) / 16 < MOST_OF_A_FLARE


def test_sparse_shards_are_restored(engine: Engine) -> None:
    """Add shards in any order and repeatedly; distributions are the same."""
    quiet, *flares = star("G2V", 7.4, amplitudes=(0.01, 1.0), exposure=50.0, payload=PAYLOAD)
    request = DetectRequest(quiet, flares, 20_000, 4)
    sums = DetectionSums(request)
    whole = engine.detect(quiet, flares, realisations=20_000, seed=4)
    for start, count in ((8192, 11_808), (0, 8192)):
        sums.add(0, pack_detection(*engine._detection(request, Shard(0, start, count))))
    for statistic in whole.statistics:
        for flare in (None, 0, 1):
            ours, theirs = (x.distribution(statistic, flare) for x in (sums.answer(), whole))
            np.testing.assert_array_equal(ours.counts, theirs.counts)
            assert ours.counts.sum() + ours.far.n == 20_000


@pytest.mark.parametrize("most", [100_000, 120])
def test_many_flares_share_table_rows(engine: Engine, monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    monkeypatch.setattr(module, "MOST_ROWS", most)
    study = small(
        star=[{"library": "G2V", "magnitude": 7.4}],
        flare={"amplitudes": [0.01, 0.02, 0.03]},
        run={"realisations": 10_000, "fap": 0.01, "statistics": ["chi2", "matched"]},
    )
    answer = detect(study, engine)
    # chi2 has a null and three flares, matched a null for each of its three.
    assert len(answer.tails) == min(1000, most // 12) * (4 + 6)
    assert len(answer.tails) <= most
    assert len(answer.roc) <= most
    assert set(answer.roc["amplitude"]) == {0.01, 0.02, 0.03}
    for _, rows in zip(range(6), answer.roc.group_by(["statistic", "amplitude"]).groups, strict=True):
        assert (rows["fap"].min(), rows["fap"].max()) == (0.0, 1.0)


def test_pictures_show_a_selection_of_many_flares() -> None:
    for n in (1, 4, 16, 17, 500):
        chosen = pictures._drawn_flares([str(k) for k in range(n)])
        assert len(chosen) == len(set(chosen)) == min(n, 16)
        assert (chosen[0], chosen[-1]) == (0, n - 1)
