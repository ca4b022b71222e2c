"""Sudden changes of the light that all pixels share, in spectra with a known truth."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from mauvecl.observations import frame_model as module

Float = NDArray[np.float64]
N, PIXELS = 720, 48
NM = np.linspace(205.0, 700.0, PIXELS)
STAR = 20.0 * np.exp((NM - 700.0) / 100.0)
OTHERS = np.array([np.exp((450.0 - NM) / 150.0), (NM / 450.0) ** -2, np.ones(PIXELS)])
SD = np.full(PIXELS, 2.0)


def found(rng: np.random.Generator, added: Float | float = 0.0, numbers: NDArray[np.int64] | None = None,
          frames: NDArray[np.intp] | None = None) -> list[Any]:  # fmt: skip
    excess = np.broadcast_to(np.asarray(added, np.float64), (N, PIXELS)) + SD * rng.standard_normal((N, PIXELS))
    numbers = np.arange(N) if numbers is None else numbers
    return module.light_changes(excess, np.arange(N) if frames is None else frames, numbers, STAR, OTHERS, SD)


def lost(start: int, stop: int, share: float) -> Float:
    return -share * np.where((np.arange(N) >= start) & (np.arange(N) < stop), 1.0, 0.0)[:, None] * STAR


def test_noise_feigns_changes_as_rarely_as_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """With 0.3 expected changes in a series; fails by chance once in a thousand times."""
    monkeypatch.setattr(module, "CHANCE", 0.3)
    # A change of noise alone has the colour of anything.
    monkeypatch.setattr(module, "CLEARLY", -np.inf)
    rng, many = np.random.default_rng(400), 100
    count = sum(bool(found(rng)) for _ in range(many))
    # Neighbouring frames and widths share noise, so that the bound of independent values is not reached.
    assert 0 < count <= stats.binom.ppf(0.999, many, 0.3)


def test_loss_and_return_are_found_at_their_frames_with_their_size() -> None:
    """Changes of 14 standard errors; within 5 standard errors, one seed in a million fails."""
    down, up = found(np.random.default_rng(401), lost(200, 400, 0.3))
    assert down.change < 0 < up.change
    for one, truth in ((down, 200), (up, 400)):
        assert abs(one.frame - truth) <= 2
        assert abs(one.change) == pytest.approx(0.3, abs=5 * one.error)


@pytest.mark.parametrize("row", range(len(OTHERS)))
def test_changes_of_another_colour_are_none(row: int) -> None:
    size = 5 * float(STAR.sum() / OTHERS[row].sum())
    added = size * np.exp(-np.maximum(np.arange(N) - 300.0, 0) / 40.0) * (np.arange(N) >= 300)
    assert found(np.random.default_rng(402), added[:, None] * OTHERS[row]) == []


def test_gaps_are_not_bridged_and_frames_left_out_are_not_compared() -> None:
    later = np.arange(N) + np.where(np.arange(N) >= 400, 1000, 0)
    assert found(np.random.default_rng(403), lost(400, N, 0.3), numbers=later) == []
    kept = np.delete(np.arange(N), slice(398, 402))
    assert len(found(np.random.default_rng(403), lost(398, 402, 0.9), frames=kept)) == 0
    # Neither have few frames.
    assert module.light_changes(np.zeros((5, PIXELS)), np.arange(5), np.arange(5), STAR, OTHERS, SD) == []
