"""Departures of the simulation from the closed form: each cause is predicted where it dominates."""

from typing import Any

import pytest
from answers import STATISTICS
from scenes import instrument, star

from mauvecl import Comparison, Engine, departures

N = 500_000
FAP = 1e-3


def found(engine: Engine, *, magnitude: float = 7.4, exposure: float = 5.0, **options: object) -> dict[str, Any]:
    """Return the departures of a faint flare on a part of the pixels, by statistic."""
    comparison = options.pop("comparison", Comparison())
    statistics = options.pop("statistics", ("chi2", "chi2_element", "uv_excess"))
    payload = instrument(part=True, **options)
    quiet, flare = star(magnitude=magnitude, amplitudes=(0.3,), exposure=exposure, payload=payload)
    kind = {"realisations": N, "seed": 3, "statistics": statistics, "comparison": comparison}
    return {d.statistic: d for d in departures(engine.detect(quiet, [flare], **kind), FAP)}


@pytest.mark.long
def test_nominal_payload_is_gaussian(engine: Engine) -> None:
    """Check that nothing differs at 50 s; six values exceed 4 standard errors once in 2500 seeds."""
    for d in found(engine, exposure=50.0, statistics=tuple(STATISTICS)).values():
        assert not d.differs
        assert d.why == ""
        assert max(abs(d.skew), abs(d.rounding), abs(d.clipping)) < 0.01


def test_skew_is_predicted(engine: Engine) -> None:
    """Predict Poisson's tail for few dark counts and little read noise, to a fifth of its effect."""
    d = found(engine, read_noise_dn=1.0, dark_scale_dn_per_s=0.2, magnitude=14.0)["chi2"]
    assert d.why == "skew of the noise"
    assert d.ratio - 1 == pytest.approx(d.skew, rel=0.2, abs=4 * d.error)
    assert d.skew > 0.3


def test_clipping_is_predicted(engine: Engine) -> None:
    """Predict the effect of clipping at zero, for a bias of 5 DN and a read noise of 12 DN."""
    rows = found(engine, bias_dn=5.0, dark_scale_dn_per_s=0.0, magnitude=12.0)
    assert {d.why for d in rows.values()} == {"clipping"}
    assert rows["uv_excess"].ratio - 1 == pytest.approx(rows["uv_excess"].clipping, rel=0.05)
    assert rows["chi2"].ratio < 0.1
    assert rows["chi2"].clipping < -0.9


def test_rounding_is_predicted(engine: Engine) -> None:
    """Predict the effect of rounding, for noise below the ADC's step."""
    range_nm = {"output_min_nm": 200.0, "output_max_nm": 260.0}
    d = found(engine, read_noise_dn=0.35, dark_scale_dn_per_s=0.0, magnitude=20.0, **range_nm)["chi2"]
    assert d.why == "rounding"
    assert d.ratio < 0.2
    assert d.rounding < -0.5


def test_estimated_variances_are_predicted(engine: Engine) -> None:
    """Predict chi-squared's null for estimated variances, where low counts have low variances."""
    kind = {"read_noise_dn": 3.0, "dark_scale_dn_per_s": 0.0, "magnitude": 6.0}
    assert found(engine, **kind, comparison=Comparison(0, True))["chi2"].why == "variances estimated from the counts"
    assert not found(engine, **kind)["chi2"].differs


def test_undrawn_unknowns_are_reported(engine: Engine) -> None:
    """Report fewer false alarms than in the closed form if a prior is not drawn."""
    quiet, flare = star(amplitudes=(0.24,))
    found = engine.detect(quiet, [flare], realisations=100_000, seed=1, nuisances={"dark": 0.1})
    rows = {d.statistic: d for d in departures(found, 0.01)}
    # One of 48 squares is missing: 0.7 of the false alarms, and 4 standard errors of 100 000 are 0.13.
    assert 0.55 < rows["chi2_element"].ratio < 0.85
    assert rows["chi2_element"].why == "unknowns that are marginalised over and not drawn"
