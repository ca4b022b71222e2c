"""Light curves with a process: level, norms and covariances of its matrices; the analysis reports its progress."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from mauvecl import SHAPES, Frames, Study, analyse
from mauvecl.observations.level import process_level
from mauvecl.observations.process import Process, ProcessTerm

Float = NDArray[np.float64]
SHAPE = SHAPES["davenport2014"]
CADENCE_S, LEVEL, SD = 20.0, 10_000.0, 10.0
SMOOTH = Process((ProcessTerm("smooth", (np.log(2.0), np.log(40_000.0))),), 1.0)


@pytest.mark.parametrize(
    "term",
    [ProcessTerm("rotation", (1.0, 8.0, 1.0, 0.1, -0.5)), ProcessTerm("correlated", (0.5, 6.0)), *SMOOTH.terms],
    ids=lambda term: term.kind,
)
def test_level_norms_and_covariances_are_those_of_the_matrices(term: ProcessTerm) -> None:
    rng = np.random.default_rng(8)
    time = np.sort(rng.choice(900, 500, replace=False)) * CADENCE_S
    model = Process((ProcessTerm("smooth", (np.log(3.0), np.log(2000.0))), term), 1.1)
    variance = rng.uniform(0.8, 1.3, time.size)
    quiet = rng.random(time.size) < 0.8
    values = rng.normal(1000.0, 2.0, (time.size, 2))
    noise = variance * model.excess**2
    between = model.at(time[:, None] - time)
    inverse = np.linalg.inv(between[np.ix_(quiet, quiet)] + np.diag(noise[quiet]))
    mean = inverse.sum(axis=0) @ values[quiet] / inverse.sum()
    expected = mean + between[:, quiet] @ inverse @ (values[quiet] - mean)
    found = process_level(model, time, values, variance, quiet)
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    weights = np.where(np.arange(time.size) % 90 < 20, rng.random(time.size), 0.0)
    np.testing.assert_allclose(model.times(time, weights), between @ weights, rtol=1e-9)
    columns = rng.normal(size=(40, 3))
    padded = np.pad(columns, [(30, time.size - 70), (0, 0)])
    exact = np.einsum("ik,ik->k", padded, np.linalg.solve(between + np.diag(noise), padded))
    np.testing.assert_allclose(model.covariance(time, noise).squared_norms(columns, 30, time.size), exact, rtol=1e-9)


def few_frames() -> Frames:
    rng = np.random.default_rng(6)
    time = np.arange(500) * 60.0
    edges = np.column_stack([time, time + 60.0])
    flux = LEVEL * (1 + 0.05 * SHAPE.mean_over(edges, 12_000.0, 300.0)) + rng.normal(0.0, SD, time.size)
    return Frames.of(time, flux, np.full(time.size, SD))


def test_progress_rises_to_the_number_of_frames() -> None:
    reported: list[tuple[int, int]] = []
    answer = analyse(Study(), progress=lambda done, total: reported.append((done, total)), frames=few_frames())
    assert max(row.event.value for row in answer.rows) > 20
    done, totals = (list(each) for each in zip(*reported, strict=True))
    assert set(totals) == {500}
    assert done[0] == 0
    assert done[-1] == 500
    assert (np.diff(done) > 0).all()
    assert len(done) > 20


class StoppedError(Exception):
    """Raised by a report to stop the work."""


def test_a_report_may_stop_the_analysis() -> None:
    def stop(done: int, total: int) -> None:
        if done:
            raise StoppedError

    with pytest.raises(StoppedError):
        analyse(Study(), progress=stop, frames=few_frames())
