"""Registry of unknowns, whose rows are keys, streams and defaults, and distributions of their factors."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import instrument, star

from mauvecl import Normal, Processes, Stare, Study, Uniform
from mauvecl.noise import layout, unknowns
from mauvecl.noise.scene import FactorDistributions, changes_of, prepare

ROWS = [
    *unknowns.PROCESSES.values(),
    *unknowns.NUISANCES.values(),
    *unknowns.INSTRUMENT_VALUES.values(),
    *(row for rows in unknowns.STARE_CHANGES.values() for row in rows.values()),
]


def test_keys_of_studies_are_the_registry() -> None:
    """Compare names and order of the processes' fields and of the keys of each section with the registry."""
    sections = Study().model_dump()
    assert list(Processes.model_fields) == [*unknowns.ADDITIVE, *unknowns.PROCESSES]
    assert list(sections["nuisances"]) == ["usual", *unknowns.NUISANCES, "own"]
    assert list(sections["unknowns"]) == ["draws", *unknowns.INSTRUMENT_VALUES, "known"]
    assert {*unknowns.COURSES, *unknowns.STARE_PROCESSES} <= sections["stare"].keys()


def test_every_default_prior_has_a_source_or_documentation() -> None:
    for row in ROWS:
        if row.prior is not None and not isinstance(row, unknowns.InstrumentValue | unknowns.Nuisance):
            assert row.source, row.name
    for row in unknowns.DOCUMENTED_NUISANCES:
        assert row.marginalised
        assert row.scatter > 0
        assert unknowns.PROCESSES[row.process].of == row.of


def test_streams_of_processes_are_those_of_the_rows() -> None:
    rows = [*unknowns.ADDITIVE.items(), *unknowns.PROCESSES.items()]
    rows += [(f"stare_{name}", process) for name, process in unknowns.STARE_PROCESSES.items()]
    assert all(layout.STREAMS[name] == row.stream for name, row in rows)


@pytest.mark.parametrize("row", [row for rows in unknowns.STARE_CHANGES.values() for row in rows.values()], ids=str)
def test_stares_take_every_change_of_the_registry(row: object) -> None:
    stare = Stare.of(6000.0, **{row.course: {row.name: 0.01}})  # type: ignore[attr-defined]
    assert any(stare.jitters.values()) or stare.unknowns


def drawn(**priors: Normal | Uniform) -> tuple[FactorDistributions, float]:
    """Return the distributions for a few pixels, and the slope of the dark with temperature."""
    quiet, *_ = star(payload=instrument(part=True))
    found = FactorDistributions.of(prepare([quiet], processes=Processes(**priors)))
    return found, quiet.conditions["dark_slope_per_c"]


def test_moments_equal_those_of_priors() -> None:
    """Compare the exponential of a normal temperature, a uniform loss and the mean jitter of ten frames, to float32."""
    found, slope = drawn(detector_temperature=Normal(21.0, 0.5, 17.0, 25.0))
    dark, s2 = found.spreads["dark"], (slope * 0.5) ** 2
    assert dark.mean == pytest.approx(np.exp(s2 / 2), rel=2e-6)
    assert dark.sd == pytest.approx(np.exp(s2 / 2) * np.sqrt(np.expm1(s2)), rel=2e-4)
    assert not dark.normal
    found, _ = drawn(qe_scale=Uniform(0.7, 1.1))
    light = found.spreads["light"]
    assert light.mean == pytest.approx(0.9, rel=1e-5)
    assert light.sd == pytest.approx(0.4 / np.sqrt(12), rel=1e-3)
    assert not light.normal
    found, _ = drawn(jitter=Uniform(0.0, 0.05), qe_scale=Normal(1.0, 0.01, 0.9, 1.1))
    light = found.spreads["light"]
    assert light.mean == pytest.approx(0.975, rel=1e-5)
    assert light.sd == pytest.approx(np.hypot(0.05 / np.sqrt(120), 0.975 * 0.01), rel=1e-3)
    assert light.normal


@pytest.mark.parametrize("weighted", [True, False])
def test_nodes_sum_to_one_and_have_mean_of_factors(weighted: bool) -> None:
    """Check the sum of probabilities and the means of factors."""
    quiet, *_ = star("K3V", 3.7, payload=instrument(part=True))
    how = Processes(
        jitter=Uniform(0.0, 0.05),
        detector_temperature=Uniform(20.0, 23.0),
        light_loss=Uniform(0.2, 0.5),
        sky_level=Normal(1.0, 0.1, 0.5, 1.5),
    )
    found = FactorDistributions.of(prepare([quiet], processes=how))
    nodes, rows = found.nodes(quiet, weighted=weighted)
    share = np.array([node.probability for node in nodes])
    assert share.sum() == pytest.approx(1.0, abs=1e-12)
    for name in ("light", "dark", "sky"):
        assert share @ [getattr(node, name) for node in nodes] == pytest.approx(found.spreads[name].mean, rel=1e-4)
    # The sky alone is faint enough to be an amplitude.
    assert rows.shape == (1, quiet.wavelength_nm.size)
    assert rows[0] == pytest.approx(found.spreads["sky"].sd * quiet.sky_dn)


@pytest.mark.parametrize("magnitude", [-2.0, -1.2, -1.0, 2.0])
def test_changes_are_slopes_of_recorded_moments(magnitude: float) -> None:
    """Compare with a star whose light, or dark, is larger by 1e-5, where no, some and most pixels saturate."""
    quiet, *_ = star("K3V", magnitude, payload=instrument(part=True))
    means, variances = changes_of(quiet)
    step = 1e-5
    light = ("source_electrons", "sky_electrons", "neighbour_electrons")
    for row, names in ((0, light), (1, light[1:2]), (2, ("dark_dn",))):
        moved = replace(quiet, **{name: getattr(quiet, name) * (1 + step) for name in names})
        slope, unclipped = (
            (moved.recorded_dn - quiet.recorded_dn) / step,
            (moved.mean_raw_dn - quiet.mean_raw_dn) / step,
        )
        # The width of the distribution changes too, by much less than its mean.
        assert slope / quiet.n_frames == pytest.approx(means[row] / quiet.n_frames, abs=5e-3 * unclipped.max())
    # Dark and light together are all of what factors change: without them the variance is not negative.
    assert (quiet.variance_dn2 - variances[0] - variances[2] >= 0).all()
    assert (means >= 0).all()
    assert (quiet.cut_share.max() > 0.1) == (magnitude < 0)
