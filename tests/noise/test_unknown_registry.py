"""Registry of unknowns, whose rows are keys, streams and defaults, and changes of what is recorded."""

from dataclasses import replace

import pytest
from scenes import instrument, star

from mauvecl import Processes, Stare, Study
from mauvecl.noise import unknowns
from mauvecl.noise.scene import changes_of


def test_keys_of_studies_are_the_registry() -> None:
    """Compare names and order of the processes' fields and of the keys of each section with the registry."""
    sections = Study().model_dump()
    assert list(Processes.model_fields) == ["cosmic_rays", *unknowns.PROCESSES]
    assert list(sections["nuisances"]) == ["usual", *unknowns.NUISANCES, "own"]
    assert list(sections["unknowns"]) == ["draws", *unknowns.INSTRUMENT_VALUES, "known"]
    assert {*unknowns.COURSES, *unknowns.STARE_PROCESSES} <= sections["stare"].keys()


def test_every_default_prior_has_a_source_or_documentation() -> None:
    assert all(row.source for row in unknowns.PROCESSES.values() if row.prior is not None)
    for row in unknowns.DOCUMENTED_NUISANCES:
        assert row.marginalised
        assert row.scatter > 0


@pytest.mark.parametrize(
    ("course", "name"), [(key, name) for key, row in unknowns.STARE_CHANGES.items() for name in row]
)
def test_stares_take_every_change_of_the_registry(course: str, name: str) -> None:
    stare = Stare.of(6000.0, **{course: {name: 0.01}})
    assert any(stare.jitters.values()) or stare.unknowns


@pytest.mark.parametrize("magnitude", [-2.0, -1.2, -1.0, 2.0])
def test_changes_are_slopes_of_recorded_moments(magnitude: float) -> None:
    """Compare with a star whose light, or dark, is larger by 1e-5, where no, some and most pixels saturate."""
    quiet, *_ = star("K3V", magnitude, payload=instrument(part=True))
    means, variances = changes_of(quiet)
    step = 1e-5
    light = ("source_electrons", "sky_electrons", "neighbour_electrons")
    for row, names in ((0, light), (1, light[1:2]), (2, ("dark_dn",))):
        moved = replace(quiet, **{name: getattr(quiet, name) * (1 + step) for name in names})
        slope = (moved.recorded_dn - quiet.recorded_dn) / step
        unclipped = (moved.mean_raw_dn - quiet.mean_raw_dn) / step
        # The width of the distribution changes too, by much less than its mean.
        assert slope / quiet.n_frames == pytest.approx(means[row] / quiet.n_frames, abs=5e-3 * unclipped.max())
    # Dark and light together are all of what factors change: without them the variance is not negative.
    assert (quiet.variance_dn2 - variances[0] - variances[2] >= 0).all()
    assert (means >= 0).all()
    assert (quiet.cut_share.max() > 0.1) == (magnitude < 0)
