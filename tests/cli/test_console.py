"""Progress on the terminal: one unit, a rate, and a credible remaining time."""

from __future__ import annotations

import re
import time

import pytest

from mauvecl.cli.console import Meter


class Clock:
    """A clock that a test advances."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1e6
        monkeypatch.setattr(time, "monotonic", lambda: self.now)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return Clock(monkeypatch)


def test_time_left_is_unknown_after_few_realisations(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    """Wait for more than the first tile, by whose rate 1e12 realisations would take 348 000 years."""
    with Meter() as meter:
        for done in (0, 1):
            meter(done, 10**12)
            clock.now += 11.0
        meter(2, 10**12)
    reported = capsys.readouterr().err
    assert "2 of 1000000000000 realisations" in reported
    assert "time left unknown" in reported
    assert not re.search(r"\d s left", reported)


@pytest.mark.parametrize(
    ("done", "left"), [(100, "99 s left"), (20, "9 min left"), (50, "3 min left"), (2, "time left unknown")]
)
def test_time_left_is_estimated(done: int, left: str, clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Meter(unit="cells") as meter:
        meter(0, 1000)
        clock.now += 11.0
        meter(done, 1000)
    assert capsys.readouterr().err.rstrip().endswith(left)


def test_late_progress_is_ignored(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    """Ignore a smaller number than before; the rate continues from the start."""
    with Meter() as meter:
        meter(0, 1000)
        for done in (400, 390, 500):
            clock.now += 10.0
            meter(done, 1000)
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "500 of 1000 realisations, 16.7 a second, 30 s left"


def test_meter_restarts_for_the_next_star(clock: Clock, capsys: pytest.CaptureFixture[str]) -> None:
    with Meter() as meter:
        for total in (1000, 2000):
            meter(0, total)
            clock.now += 10.0
            meter(total // 2, total)
    assert capsys.readouterr().err.splitlines() == [
        "500 of 1000 realisations, 50 a second, 10 s left",
        "1000 of 2000 realisations, 100 a second, 10 s left",
    ]
