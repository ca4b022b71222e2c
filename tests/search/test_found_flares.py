"""Flares that the search of a drawn stare finds: each once, overlapping ones apart, with intervals that cover."""

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from astropy.table import QTable
from marks import long_but
from scenes import paper
from scipy.stats import binom, chi2

from mauvecl import Event, Study, stare
from mauvecl.search import false_alarms

#: One false alarm in a star-month is at 4.9.
FAINT: tuple[str, ...] = ('star=[{library="M3V", magnitude=9}]',)
BRIGHT = ('star=[{library="G2V", magnitude=7.4}]', "search.half_widths_s=[22, 42, 77, 144]")


@pytest.fixture(autouse=True, scope="module")
def one_threshold_per_star() -> Iterator[None]:
    """Sample the false alarms of each star once: they depend on neither flares nor, but for the sampling, seeds."""
    rates: dict[str, Any] = {}
    sampled = false_alarms.sampled_rate

    def sampled_once(survey: Any, seed: int) -> Any:
        name = survey.components.quiet.name
        rates[name] = rates.get(name) or sampled(survey, seed)
        return rates[name]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(false_alarms, "sampled_rate", sampled_once)
        yield


def found(events: list[Event], seed: int, settings: tuple[str, ...] = FAINT) -> QTable:
    """Return the flares that are found in a stare with some flares of 10 000 K."""
    given = ", ".join(
        f"{{peak_s={one.peak_s}, half_width_s={one.half_width_s}, amplitude={one.amplitude}, shape='{one.form.name}'}}"
        for one in events
    )
    return stare(paper(*settings, f"run.seed={seed}", f"events=[{given}]")).found


@cache
def amplitude_of_one() -> float:
    """Return the amplitude of a flare with a half-width of 1 s and an S/N of 1 against the noise of the star."""
    event = "events=[{peak_s=1000.0, half_width_s=100.0, amplitude=1e-4}]"
    return 1e-3 / float(stare(paper(*FAINT, "stare.search=false", event)).events["snr"][0])


@pytest.mark.long
def test_bright_flare_is_found_once_and_another_shape_leaves_at_most_a_small_residual() -> None:
    """S/N of 400, and of 120 beside it, which is fitted apart: no further alarm. A false alarm: once in 7e4 runs."""
    events = [Event(3000.0, 60.0, 1.0), Event(3800.0, 60.0, 0.3)]
    for number in (1, 2):
        rows = found(events[:number], number, BRIGHT)
        assert rows["event"].tolist() == [1, 2][:number]
        for row, event in zip(rows, events[:number], strict=True):
            assert abs(row["peak_time"].value - event.peak_s) < 5.0
            assert row["value"] > 300 * event.amplitude
            # The light of the other flare is subtracted, once: five standard errors.
            assert (
                abs(row["equivalent_duration"].value - event.equivalent_duration_s)
                < 5 * row["equivalent_duration_error"].value
            )
            assert row["p_value"] > 1e-6
    # The fit of the other published shape is wrong, but its rests are no flares.
    several = found([Event(3000.0, 60.0, 1.0, shape="tovarmendoza2022")], 1, BRIGHT)
    assert several["value"][0] > 300
    assert len(several) <= 2
    assert all(several["value"][1:] > 0.04 * several["value"][0])


@pytest.mark.parametrize(
    ("number", "seed"), long_but([*((2, seed) for seed in range(100, 105)), (3, 200), (3, 201), (3, 202)], (2, 100))
)
def test_random_pairs_and_triples_are_separated(number: int, seed: int) -> None:
    """S/N of 30 to 120, peaks one to five half-widths apart; a false alarm comes once in 50 runs at most."""
    rng = np.random.default_rng(seed)
    peak, events = float(rng.uniform(1500, 3000)), []
    for _ in range(number):
        width, snr = float(10 ** rng.uniform(1.3, 2.3)), float(10 ** rng.uniform(1.5, 2.1))
        events.append(Event(peak, width, amplitude_of_one() * snr / width**0.5))
        peak += float(rng.uniform(1.0, 5.0) * width + 40.0)
    several = sorted(found(events, seed), key=lambda row: row["peak_time"])
    assert len(several) == number, events
    for row, event in zip(several, events, strict=True):
        # A normal error exceeds five standard errors once in 2e6 times.
        assert abs(row["peak_time"].value - event.peak_s) < 5 * row["peak_time_error"].value
        for name in ("half_width", "equivalent_duration"):
            value, truth = row[name].value, getattr(event, f"{name}_s")
            assert abs(np.log(value / truth)) < 5 * row[f"{name}_error"].value / value, name
        assert row["p_value"] > 1e-6


@pytest.mark.long
def test_flares_outside_of_stare_or_bank_are_not_measured() -> None:
    last, widths, unmeasured = Study().stare.duration_s, Study().search.half_widths_s, 0
    early, late = Event(-150.0, 200.0, 0.5), Event(last + 20.0, 60.0, 2.0)
    narrow, wide, unusual = Event(2800.0, 2.0, 8.0), Event(2500.0, 8000.0, 0.3), Event(5600.0, 500.0, 0.2)
    for seed, event in enumerate((early, late, narrow, wide, unusual)):
        for row in found([event], seed):
            if "not measured" not in row["note"]:
                assert 0 <= row["peak_time"].value <= last
                assert widths[0] / 1.26 < row["half_width"].value < widths[-1] * 1.26
                continue
            unmeasured += 1
            assert row["note"].startswith("detected but not measured: its ")
            for name in ("peak_time", "half_width", "amplitude", "equivalent_duration", "energy_bolometric"):
                assert np.isnan(row[f"{name}_low"])
                assert np.isnan(row[f"{name}_high"])
            assert np.isnan(row["equivalent_duration"])
    assert unmeasured >= 3


@pytest.mark.long
def test_intervals_cover() -> None:
    """68 % intervals near the threshold and above it: each count and sum of squared pulls fails once in 1000 runs."""
    quantities = {"peak_time": "peak_s", "half_width": "half_width_s", "equivalent_duration": "equivalent_duration_s"}
    measured, pulls = {6.0: 0, 12.0: 0}, list[list[float]]()
    for snr, seed in (*((6.0, one) for one in range(400, 410)), *((12.0, one) for one in range(300, 306))):
        rng, events = np.random.default_rng(seed), []
        for low, high in ((2000, 3500),) if snr < 12 else ((1000, 1800), (3800, 4600)):
            width = float(10 ** rng.uniform(np.log10(25), np.log10(250)))
            events.append(Event(float(rng.uniform(low, high)), width, amplitude_of_one() * snr / width**0.5))
        rows = [row for row in found(events, seed) if not row["note"]]
        for event in events:
            near = [row for row in rows if abs(row["peak_time"].value - event.peak_s) < 3 * event.half_width_s]
            for row in near[:1]:
                measured[snr] += 1
                pulls.append([])
                for name, of in quantities.items():
                    truth, value = getattr(event, of), row[name].value
                    end = row[f"{name}_high" if truth > value else f"{name}_low"].value
                    pulls[-1].append((truth - value) / (end - value))
    seen, squares = sum(measured.values()), np.square(pulls)
    held = (squares <= 1.0).sum(axis=0)
    assert measured[12.0] == 12
    assert measured[6.0] >= 1
    assert (binom.cdf(held, seen, 0.65) > 1e-3).all(), (held, seen)
    assert (binom.sf(held - 1, seen, 0.75) > 1e-3).all(), (held, seen)
    assert (squares.sum(axis=0) < chi2.isf(1e-3, seen)).all(), pulls
