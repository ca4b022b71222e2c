"""What `measure` states where unknowns are drawn, and `gaussian` for flags that state a magnitude or an exposure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.table import QTable
from commands import run
from scipy import stats

from mauvecl import Engine, Study, measure

#: Magnitudes of `gaussian` where none is stated.
MAGNITUDES = [4.0, 6.0, 8.0, 10.0, 12.0]


def study_of(*settings: str, star: str = "M3V", magnitude: float = 7.0, fits: int = 400) -> Study:
    return Study().with_settings(
        [f"star=[{{library='{star}', magnitude={magnitude}}}]", f"measure.fits={fits}", "run.seed=42", *settings]
    )


@pytest.mark.parametrize(
    ("star", "magnitude", "settings"),
    [
        ("M3V", 7.0, ["flare.amplitudes=[0.5]", "nuisances.usual=true"]),
        ("G2V", 4.0, ["flare.amplitudes=[0.1]", "nuisances.usual=true"]),
        ("M3V", 9.0, ["flare.amplitudes=[20]", "nuisances.usual=true", "observation.exposure_s=5"]),
        ("M3V", 8.0, ["flare.amplitudes=[0.5]", "nuisances.usual=true", "nuisances.light='free'"]),
        ("M3V", 9.0, ["flare.amplitudes=[2]", "nuisances.usual=true", "flare.spectrum.balmer_jump=2",
                      "processes.pointing_loss={uniform=[0, 0.2]}"]),
    ],
    ids=["M dwarf", "Sun-like", "single frame", "free light", "large losses"],
)  # fmt: skip
def test_intervals_cover_with_unknowns_drawn(star: str, magnitude: float, settings: list[str], engine: Engine) -> None:
    """Count 400 fits: 5 or 6 quantities may have a coverage of 93 to 97 %; each fails in 2e-6 of seeds."""
    answer = measure(study_of(*settings, star=star, magnitude=magnitude), engine)
    rows = answer.flares[-1].rows()
    covered = np.rint(400 * np.array(rows["coverage_95"])).astype(int)
    low, high = stats.binom.ppf(1e-6, 400, 0.93), stats.binom.isf(1e-6, 400, 0.97)
    assert ((low <= covered) & (covered <= high)).all(), dict(zip(rows["quantity"], covered / 400, strict=True))
    # The exposure without noise has the mean loss, so that its fit gives the truth.
    np.testing.assert_allclose(rows["perfect"], rows["truth"], rtol=2e-3)
    # 5 standard errors of the scatter of 400 fits, and some of the interval.
    np.testing.assert_allclose(rows["scatter"] / rows["error"], 1.0, atol=0.25)


def test_fits_take_the_factor_on_light_as_it_is_drawn(engine: Engine) -> None:
    """Compare mean and scatter with those of ten uniform losses, and of what a study states itself."""
    found = {}
    for settings in (
        ["nuisances.usual=true"],
        ["nuisances.usual=true", "nuisances.light=0.04"],
        [],
        ["nuisances.light='free'"],
    ):
        unknown = measure(study_of("flare.amplitudes=[0.5]", *settings, fits=1), engine).flares[0].unknown
        found[len(found)] = unknown and {
            n: (m, s) for n, m, s in zip(unknown.names, unknown.mean, unknown.sd, strict=True)
        }
    usual, stated, none, free = found.values()
    assert usual["light"] == pytest.approx((-0.025, 0.05 / np.sqrt(120)), rel=1e-3)
    assert np.isinf(usual["star"][1])
    assert "star" not in stated
    assert stated["light"] == pytest.approx((-0.025, 0.04), rel=1e-3)
    assert none is None
    assert free == {"light": (0.0, np.inf)}


def test_what_is_drawn_and_not_marginalised_is_said(engine: Engine) -> None:
    settings = ["flare.amplitudes=[0.5]", "processes.pointing_loss={uniform=[0, 0.05]}"]
    for more, said in (([], True), (["nuisances.light='free'"], False)):
        answer = measure(study_of(*settings, *more, fits=10), engine)
        assert any("NOT MARGINALISED: light" in text for text in answer.messages) == said


def test_hottest_flares_are_measured(engine: Engine) -> None:
    rows = measure(study_of("flare.amplitudes=[0.1]", "flare.temperature_k=2e5", fits=20), engine).flares[0].rows()
    assert rows["truth"][0] == 2e5
    assert rows["perfect"][0] == pytest.approx(2e5, rel=1e-3)


@pytest.mark.parametrize("usual", ["true", "false"])
def test_flares_that_saturate_most_pixels_are_measured(usual: str, engine: Engine) -> None:
    """Measure a flare that leaves 60 pixels, with their errors in advance; ten times the flare leaves none.

    A coverage of 95 % is below 88 % in 200 fits in 1e-4 of seeds, for each of five correlated quantities.
    """
    settings = ["flare.amplitudes=[5]", f"nuisances.usual={usual}"]
    answer = measure(study_of(*settings, star="K2.5V", magnitude=2.0, fits=200), engine)
    rows = answer.flares[0].rows()
    assert rows["coverage_95"].min() >= 0.88
    assert answer.flares[0].found.dof < 100
    if usual == "false":
        np.testing.assert_allclose(rows["scatter"] / rows["error"], 1.0, atol=0.25)
    own = answer.flares[0]
    assert np.isnan(own.forecasts(np.array([1000.0]), own.unknown)[0].errors).all()


@pytest.mark.parametrize(
    ("flags", "magnitudes", "exposures"),
    [
        (["-m", "9", "-t", "5"], [], [5.0]),
        (["-m", "9"], [], [5.0, 50.0, 600.0]),
        (["-t", "5"], MAGNITUDES, [5.0]),
        (["-m", "9", "-t", "50"], [], [50.0]),
    ],
)
def test_gaussian_answers_for_what_flags_state(
    flags: list[str], magnitudes: list[float], exposures: list[float], tmp_path: Path
) -> None:
    run("gaussian", "-n", "10000", "--fap", "0.01", "--star", "G2V", *flags, "-o", "found", folder=tmp_path)
    table = QTable.read(tmp_path / "found" / "gaussian.ecsv")
    stars = {"G2V V = 9"} if "-m" in flags else {f"G2V V = {v:g}" for v in MAGNITUDES}
    assert set(table["star"]) == stars
    if magnitudes:
        assert sorted(set(table["magnitude"].value.tolist())) == magnitudes
    else:
        assert "magnitude" not in table.colnames
    assert sorted(set(table["exposure"].value.tolist())) == exposures
