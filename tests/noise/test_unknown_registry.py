"""Registry of unknowns: study keys, streams and defaults are views of its rows."""

from __future__ import annotations

import pytest

from mauvecl import Processes, Stare, Study
from mauvecl.noise import layout, unknowns

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
        if row.prior is not None and row.name not in unknowns.INSTRUMENT_VALUES and row.treatment == "drawn":
            assert row.source, row.name
    for row in unknowns.DOCUMENTED_NUISANCES:
        assert row.marginalised
        assert row.scatter > 0
        assert unknowns.PROCESSES[row.process].of == row.of


def test_streams_of_processes_are_those_of_the_rows() -> None:
    rows = [*unknowns.ADDITIVE.items(), *unknowns.PROCESSES.items()]
    rows += [(f"stare_{name}", process) for name, process in unknowns.STARE_PROCESSES.items()]
    assert all(layout.STREAMS[name] == row.stream for name, row in rows)


def test_default_values_of_documented_set() -> None:
    """The documented values, written out: the views must not change them."""
    priors = {name: vars(prior) for name, prior in unknowns.default_processes(21.0).items()}
    assert priors == {
        "jitter": {"low": 0.0, "high": 0.05},
        "detector_temperature": {"mean": 21.0, "sd": 0.5, "low": 18.5, "high": 23.5},
        "sky_level": {"mean": 1.0, "sd": 0.1, "low": 0.5, "high": 1.5},
    }
    assert unknowns.default_spreads() == {
        "jitters": {"light": 0.05 / 12**0.5},
        "offsets": {"sky": 0.1},
        "drifts": {"star": 0.01},
        "cycles": {"temperature": 0.5},
    }
    dumped = Study().model_dump()["unknowns"]
    assert {name: dumped[name] for name in unknowns.INSTRUMENT_VALUES} == {
        "temperature_c": {"uniform": (13.0, 21.0)},
        "light_loss": {"normal": (0.34, 0.10), "between": (0.04, 0.64)},
        "pointing_loss": {"uniform": (0.0, 0.05)},
        "qe_scale": {"normal": (1.0, 0.3), "between": (0.3, 1.7)},
        "conversion_uv_per_electron": {"uniform": (20.0, 25.0)},
        "read_noise_dn": {"normal": (12.0, 1.0), "between": (9.0, 15.0)},
    }


@pytest.mark.parametrize("row", [row for rows in unknowns.STARE_CHANGES.values() for row in rows.values()], ids=str)
def test_stares_take_every_change_of_the_registry(row: object) -> None:
    stare = Stare.of(6000.0, **{row.course: {row.name: 0.01}})  # type: ignore[attr-defined]
    assert any(stare.jitters.values()) or stare.unknowns
