"""What `measure` states where unknowns are drawn, and `gaussian` for flags that state a magnitude or an exposure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.table import QTable
from scipy import stats

from mauvecl import Engine, Study, measure
from mauvecl.study.cases import Case
from mauvecl.study.questions import EXPOSURES_S, MAGNITUDES
from tests.commands import run
from tests.refusals import refused


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


def test_fits_take_the_factor_on_light_as_it_is_drawn() -> None:
    """Compare mean and scatter with those of ten uniform losses, and of what a study states itself."""
    usual = Case(study_of("nuisances.usual=true")).unknowns_of_fits()
    assert usual is not None
    light = usual.names.index("light")
    assert usual.mean[light] == pytest.approx(-0.025, rel=1e-3)
    assert usual.sd[light] == pytest.approx(0.05 / np.sqrt(120), rel=1e-3)
    assert np.isinf(usual.sd[usual.names.index("star")])
    stated = Case(study_of("nuisances.usual=true", "nuisances.light=0.04")).unknowns_of_fits()
    assert stated is not None
    assert "star" not in stated.names
    assert stated.sd[stated.names.index("light")] == 0.04
    assert stated.mean[stated.names.index("light")] == pytest.approx(-0.025, rel=1e-3)
    free = Case(study_of("nuisances.light='free'")).unknowns_of_fits()
    assert free is not None
    assert free.names == ("light",)
    assert free.mean[0] == 0.0
    assert Case(study_of()).unknowns_of_fits() is None


def test_what_is_drawn_and_not_marginalised_is_said(engine: Engine) -> None:
    settings = ["flare.amplitudes=[0.5]", "processes.pointing_loss={uniform=[0, 0.05]}"]
    for more, said in (([], True), (["nuisances.light='free'"], False)):
        answer = measure(study_of(*settings, *more, fits=10), engine)
        assert any("NOT MARGINALISED: light" in text for text in answer.messages) == said


def test_single_fits_have_no_scatter(engine: Engine) -> None:
    rows = measure(study_of("flare.amplitudes=[0.5]", fits=1), engine).flares[0].rows()
    assert np.isnan(rows["scatter"]).all()
    assert np.isfinite(rows["bias"]).all()


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


def test_measurements_in_one_pixel_are_refused(engine: Engine) -> None:
    with refused("skipped_nm", value=1):
        measure(study_of("flare.amplitudes=[0.5]", "measure.skipped_nm=[[190, 699.5]]", fits=10), engine)


@pytest.mark.parametrize(
    ("flags", "magnitudes", "exposures"),
    [
        (["-m", "9", "-t", "5"], [], [5.0]),
        (["-m", "9"], [], list(EXPOSURES_S)),
        (["-t", "5"], list(MAGNITUDES), [5.0]),
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
