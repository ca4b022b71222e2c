"""Limits, maps and exposures have the requested power or S/N, by theory and by simulation, and are monotone."""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from answers import expectations
from marks import long_but
from scenes import paper, study_of_g2v
from tables import toml

import mauvecl
from mauvecl import Engine, Study, exposure_for, shortest_exposure

STATISTICS = ("chi2", "chi2_element", "matched", "uv_excess")


def study(**changes: Any) -> Study:
    """Return the paper's G2V star with a 24 % flare, 1e5 realisations at 1e-2."""
    run = {"realisations": 100_000, "statistics": STATISTICS} | changes.pop("run", {})
    return study_of_g2v(run=run, **changes).paper()


@pytest.mark.long
@pytest.mark.parametrize("power", [0.5, 0.9])
def test_limiting_magnitude_has_the_requested_power(engine: Engine, power: float) -> None:
    """Compare with the 95 % interval of a fresh simulation, which each of 4 limits leaves in 5 % of seeds."""
    asked = study(limit={"power": power})
    result = mauvecl.limit(asked, engine)
    assert [limit.statistic for limit in result.limits] == list(STATISTICS)
    for limit in result.limits:
        assert limit.value.low <= limit.value.value <= limit.value.high
        assert limit.check.probability.low <= power <= limit.check.probability.high
        assert limit.verdict == "confirms it"
        assert limit.check.seed != asked.run.seed
        # Far from the rails the closed form is right to the skew of the dark.
        assert abs(limit.value.value - limit.closed_form) < 0.03
        # The curve of the closed form, nearest to the limit, is the power.
        values, theory = np.array(sorted(pickle.loads(pickle.dumps(limit)).curve)).T
        assert np.interp(limit.closed_form, values, theory) == pytest.approx(power, abs=0.01)


def test_limit_inverts_detect(engine: Engine) -> None:
    """Check that the smallest amplitude and the shortest exposure at the limiting magnitude are those given."""
    only = {"statistics": ("matched",)}
    (limit,) = mauvecl.limit(study(run=only), engine).limits
    there = study(run=only, star=[{"library": "G2V", "magnitude": limit.value.value}])
    (back,) = mauvecl.smallest_amplitude(there, engine).limits
    assert back.value.value == pytest.approx(0.24, rel=0.03)
    (shortest,) = shortest_exposure(there, engine).limits
    assert shortest.value.value % 5 == 0
    assert abs(shortest.value.value - 50) <= 5
    assert shortest.value.low <= shortest.value.value <= shortest.value.high
    # An interval of the second simulation, and the verdicts for a limit that is no exposure, and for one that is.
    for p, verdicts in (((0.8, 0.91), ["confirms it"] * 2), ((0.905, 0.91), ["misses it narrowly", "exceeds it"]),
                        ((0.8, 0.81), ["DIFFERS"] * 2)):  # fmt: skip
        check = replace(shortest.check, probability=replace(shortest.value, low=p[0], high=p[1]))
        assert [replace(x, check=check).verdict for x in (limit, shortest)] == verdicts


def test_assumptions_move_the_limit_as_predicted(engine: Engine) -> None:
    """Compare an end with the limit of a changed instrument; `test_golden_python.py` has the values of all."""
    asked = study(run={"statistics": ("matched",), "realisations": 20_000})
    rows = {row["assumption"]: row for row in mauvecl.what_matters(asked)}
    lossy = asked.with_instrument({"light_loss": 0.44})
    assert lossy.observation.load_instrument().light_loss == 0.44
    (limit,) = mauvecl.limit(lossy, engine).limits
    assert rows["light loss"]["at_high_end"] == pytest.approx(limit.closed_form, abs=1e-3)
    assert Study.build(lossy.model_dump(), "again") == lossy


@pytest.mark.parametrize(("star", "least"), long_but([("M3V", 0.02), ("B2IV", 0.02), ("G2V", 1e-6)], ("M3V", 0.02)))
def test_map_without_magnitudes_has_those_over_which_flares_are_lost(star: str, least: float, engine: Engine) -> None:
    """The least flares of the G2V star are lost where it saturates; the answer's study gives the same map again."""
    y = f'map.y={{quantity="amplitude", values=[{least}, 0.5]}}'
    asked = paper(f'star=[{{library="{star}"}}]', y, "run.realisations=10000", "run.fap=0.01")
    found = mauvecl.map(asked, engine)
    chances = found.closed_form[found.statistics.index("matched")]
    assert chances[1, -1] < 0.1 < chances[1, -2]
    assert found.x == found.study.map.axes[0].points()
    assert [float(column.heading) for column in found.views[0].columns[1:]] == list(found.x)
    assert not found.inputs[0].saturated.any()
    assert not np.isnan(found.probability).any()
    if star == "G2V":
        assert expectations(asked.at("magnitude", found.x[0] - 1))[0].saturated.any()
    else:
        assert chances[0, 0] > 0.9


@pytest.mark.parametrize("axes", toml("studies/maps.toml").values(), ids=toml("studies/maps.toml"))
def test_each_cell_equals_its_own_detection(engine: Engine, axes: dict[str, Any]) -> None:
    """Compare all bits, which agree because all cells share their draws."""
    run = {"statistics": ("chi2", "matched"), "seed": 9}
    asked = study_of_g2v(flare={"amplitudes": [0.1]}, run=run, map=axes).paper()
    found = mauvecl.map(asked, engine)
    assert found.probability.shape == (2, len(found.y), len(found.x))
    for j, i in ((0, 0), (len(found.y) - 1, 0), (1, len(found.x) - 1)):
        there = asked.at(axes["x"]["quantity"], found.x[i]).at(axes["y"]["quantity"], found.y[j])
        quiet, flare = expectations(there)
        alone = engine.detect(quiet, [flare], realisations=20_000, seed=9, statistics=found.statistics)
        expected = [alone.detection_probability(1e-2, statistic)[0].value for statistic in found.statistics]
        assert list(found.probability[:, j, i]) == expected
        np.testing.assert_allclose(found.closed_form[:, j, i], alone.table(1e-2)["closed_form_probability"])
    assert (found.low <= found.probability).all()
    assert (found.probability <= found.high).all()


@pytest.mark.parametrize("per", ["pixel", "element"])
@pytest.mark.parametrize("frames", long_but([1, 2, 7, 120], 1, 2, 7))
@pytest.mark.parametrize("wavelength", [280.0, 450.0])
def test_exposure_inverts_snr(per: str, frames: int, wavelength: float) -> None:
    """Check that the S/N of an exposure asks for that exposure, and that one frame more is a little longer."""
    asked = paper("star=[{library='G2V', magnitude=7.4}]", f"observation.exposure_s={5 * frames}")
    x = expectations(asked)[0]
    pixel = int(np.argmin(np.abs(x.wavelength_nm - wavelength)))
    snr = float(x.snr()[pixel] if per == "pixel" else x.snr_per_element()[x.element[pixel]])
    (same,) = exposure_for(asked, snr * (1 - 1e-9), wavelength, per=per).exposures
    assert (same.frames, same.exposure_s) == (frames, 5.0 * frames)
    assert same.snr_one_frame_less < snr <= same.snr * (1 + 1e-9)
    (more,) = exposure_for(asked, snr * (1 + 1e-9), wavelength, per=per).exposures
    assert more.frames == frames + 1
