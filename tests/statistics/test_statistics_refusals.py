"""Bad input of statistics and their comparisons: each row is a call, the key that its error names, and facts of it."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import Row, check
from scenes import instrument, star

from mauvecl import Comparison, Expectation, Nuisances
from mauvecl.statistics.linear import Matched
from mauvecl.statistics.registry import STATISTICS
from mauvecl.statistics.statistic import Setting

FREE = float("inf")
QUIET, FLARE = star(amplitudes=(0.02,), payload=instrument(part=True))
SIGNAL = FLARE.signal_dn - QUIET.signal_dn


def setting(quiet: Expectation, spectrum: np.ndarray | None = None, **sd: float) -> Setting:
    nuisances = Nuisances.of(quiet, sd, None if spectrum is None else {"own": spectrum})
    return Setting(quiet, ~quiet.saturated, nuisances=nuisances)


ROWS: list[Row] = [
    (lambda: Nuisances.of(QUIET, {"dust": 1.0}), "nuisances", "'dust'"),
    (lambda: Nuisances.of(QUIET, {"dark": 0.0}), "sd", "0"),
    (lambda: Nuisances.of(QUIET, {"dark": -1.0}), "sd", "-1"),
    (lambda: Nuisances.of(QUIET, {"dark": float("nan")}), "sd", "nan"),
    (lambda: Nuisances.of(QUIET, {"own": 1.0}, {"own": np.zeros(SIGNAL.size)}), "own"),
    (lambda: Nuisances.of(QUIET, {"own": 1.0}, {"own": np.ones(3)}), "own"),
    # A nuisance that repeats another, and one that is the flare.
    (
        lambda: STATISTICS["chi2"].subtracted_rows(setting(QUIET, 2.0 * QUIET.recorded_light_dn, light=FREE, own=FREE)),
        "nuisances",
    ),
    (lambda: Matched().weights_per_dn(setting(QUIET, SIGNAL, own=FREE), FLARE), "statistic"),
    (lambda: STATISTICS["chi2_pair"].check(setting(QUIET, dark=1.0)), "statistic"),
    (lambda: STATISTICS["paper"].check(setting(QUIET, dark=1.0)), "statistic"),
    (lambda: Comparison.of("stack"), "reference", "'stack'"),
    (lambda: Comparison.of("stack:0"), "reference", "'stack:0'"),
    (lambda: Comparison.of("mean"), "reference", "'mean'"),
    (lambda: Comparison.of("exposure:2"), "reference", "'exposure:2'"),
    (lambda: Comparison.of("template", "guessed"), "variances", "'guessed'"),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[1])
def test_bad_input_raises(row: Row) -> None:
    check(row)
