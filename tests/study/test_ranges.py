"""Every quantity has one range, wherever it can be given."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from pydantic.fields import FieldInfo
from refusals import refused

from mauvecl import Instrument, Sky, Source, expect
from mauvecl.host.stars.flare_spectra import BalmerFlare, TwoBlackbodies
from mauvecl.noise.unknowns import PROCESSES
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit, first
from mauvecl.schema.section import fields_of
from mauvecl.study.quantities import QUANTITIES
from mauvecl.study.study import Study
from mauvecl.web.fields import FIELDS, Number

NUMERIC = {name: one for name, one in QUANTITIES.items() if not one.is_name}
#: Names in the page's links.
PAGE = {
    "magnitude": "magnitude",
    "amplitude": "amplitude_percent",
    "exposure": "exposure_s",
    "flare_temperature": "flare_temperature_k",
    "detector_temperature": "temperature_c",
    "sky": "sky_brightness",
}


def star() -> Source:
    return Source.from_library("G2V")


#: Python functions that take the quantity.
CALLS: dict[str, Callable[[float], Any]] = {
    "magnitude": lambda v: star().at_magnitude(v),
    "amplitude": lambda v: star().flaring(v),
    "flare_temperature": lambda v: star().flaring(0.1, v),
    "balmer_jump": lambda v: BalmerFlare(1e4, v),
    "second_temperature": lambda v: TwoBlackbodies(1e4, v, 0.1),
    "second_area": lambda v: TwoBlackbodies(1e4, 2e4, v),
    "exposure": lambda v: expect(star().at_magnitude(7.0), Instrument.load("mauve"), exposure=v),
    "detector_temperature": lambda v: Instrument.load("mauve").with_(temperature_c=v),
    "sky": Sky.of_brightness,
}
#: Lines cannot be scaled by an argument.
NO_CALL = {"line_scale"}


def outside(reach: Range) -> list[float]:
    """Return values just outside of both ends of a range."""
    below = reach.low if reach.open_low else reach.low - 1e-9 * max(abs(reach.low), 1.0)
    above = reach.high if reach.open_high else reach.high * (1 + 1e-9)
    return [below, above]


def ends(reach: Range) -> list[float]:
    return [1e-3 if reach.open_low else reach.low, 0.999 if reach.open_high else reach.high]


def refuses(call: Callable[[], Any]) -> bool:
    try:
        call()
    except InputError as error:
        # Other errors, such as one of a spectrum that needs another key, do not name a range.
        return "expected" in str(error) and any(
            word in (error.expected or "") for word in (" to ", "above", "at least", "up to")
        )
    return False


def test_all_quantities_are_tested() -> None:
    assert len(NUMERIC) >= 10
    assert set(NUMERIC) == set(CALLS) | NO_CALL
    assert all(first(field_at(one.path), Range) is not None for one in NUMERIC.values())


def field_at(path: tuple[str, ...]) -> FieldInfo:
    return next(field for found, field in fields_of(Study) if found == path)


@pytest.mark.parametrize("name", NUMERIC)
def test_keys_sweeps_and_maps_have_the_range(name: str) -> None:
    one = NUMERIC[name]
    key = ".".join(one.path).replace("star.", "star.0.")
    for value in outside(one.range):
        text = f"[{value!r}]" if name == "amplitude" else repr(value)
        assert refuses(lambda: Study().with_settings([f"{key}={text}"])), (key, value)  # noqa: B023
        for axis, place in (
            (f"sweep.axes=[{{quantity={name!r},values=[{value!r}]}}]", "sweep.axes.0"),
            (f"map.x={{quantity={name!r},values=[{value!r}]}}", "map.x"),
        ):
            with refused(f"{place}.values", value=value):
                Study().with_settings(["map.y={quantity='star',values=['G2V']}", axis])
        if name != "line_scale":
            assert refuses(lambda: Study().at(name, value))  # noqa: B023
    for value in ends(one.range):
        swept = Study().with_settings([f"sweep.axes=[{{quantity={name!r},values=[{value!r}]}}]"])
        assert swept.sweep.axes[0].points() == (value,)


@pytest.mark.parametrize("name", CALLS)
def test_python_arguments_have_the_range(name: str) -> None:
    for value in outside(NUMERIC[name].range):
        assert refuses(lambda: CALLS[name](value)), value  # noqa: B023
    for value in ends(NUMERIC[name].range):
        assert not refuses(lambda: CALLS[name](value)), value  # noqa: B023


@pytest.mark.parametrize("name", PAGE)
def test_page_has_the_range(name: str) -> None:
    read, reach = FIELDS[PAGE[name]].read, NUMERIC[name].range
    assert isinstance(read, Number)
    scale = 100 if name == "amplitude" else 1
    assert read.range == Range(scale * reach.low, scale * reach.high, reach.open_low, reach.open_high)


def test_fields_of_one_unit_and_name_share_a_range() -> None:
    """All magnitudes, star and detector temperatures of a study have the range of their kind."""
    temperatures = {
        (reach.low, reach.high)
        for _, field in fields_of(Study)
        if (unit := first(field, Unit)) is not None and unit.name == "K" and (reach := first(field, Range)) is not None
    }
    assert temperatures == {(1_000, 200_000)}
    reach = NUMERIC["detector_temperature"].range
    assert (PROCESSES["detector_temperature"].low, PROCESSES["detector_temperature"].high) == (reach.low, reach.high)
