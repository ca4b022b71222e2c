"""The reference of keys is complete."""

from __future__ import annotations

from mauvecl.schema.fields import Help, Range, first
from mauvecl.schema.records import model_in
from mauvecl.schema.reference import keys_of
from mauvecl.schema.section import fields_of
from mauvecl.study.study import Study


def test_every_key_has_a_description() -> None:
    """Every key that holds a value has one; sections are described by their keys."""
    missing = {
        ".".join(path)
        for path, field in fields_of(Study)
        if first(field, Help) is None
        and model_in(field.annotation) is None
        # The registry of unknowns describes these keys.
        and path[0] not in ("processes", "unknowns")
    }
    assert missing == set()


def test_rows_state_unit_range_default_and_flag() -> None:
    rows = {key.path: key for key in keys_of(Study)}
    assert rows["observation.exposure_s"][1:] == (
        "Exposure time, rounded up to whole frames of 5 s",
        "seconds above 0 and up to 86400",
        "50",
        "--exposure, -t",
    )
    assert rows["observation.temperature_c"].accepted == "-40 to 65 deg C"
    assert rows["flare.amplitudes"].default == "[0.0076, 0.02, 0.081, 0.24]"
    assert rows["flare.geometry"].accepted == "added, replaces"
    assert rows["orbit.limits.sun_deg"].flags == "--sun"
    assert len(rows) > 120


def test_numbers_have_no_other_bounds() -> None:
    """Bounds of numbers are `Range` metadata, which messages, flags and the page read."""
    from annotated_types import Ge, Gt, Le, Lt

    bounded = [
        ".".join(path)
        for path, field in fields_of(Study)
        for bound in (Ge, Gt, Le, Lt)
        if path[0] != "processes" and first(field, bound)
    ]
    assert bounded == []
    assert first(dict(fields_of(Study))[("run", "seed")], Range) == Range(0, 2**64 - 1)
