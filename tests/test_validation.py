"""Every public function validates every argument: the cases follow from the annotations."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any, get_args, get_origin

import astropy.units as u
import numpy as np
import pytest
from numpy.typing import ArrayLike

import mauvecl
from mauvecl import bulk
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import AnyUnit, Range, Unit
from mauvecl.schema.records import Record

#: Modules below the validation, and the inner interface of statistics, whose methods public classes inherit.
INNER = ("mauvecl.drawable", "mauvecl.schema.records", "mauvecl.schema.section", "mauvecl.statistics.statistic")
#: Other units in which a parameter of each unit is given.
EQUIVALENT = {"nm": ("um", "THz"), "K": ("kK", "deg_C"), "deg_C": ("K",), "s": ("min",), "mag": ("mmag",)}


def public_functions() -> Iterator[tuple[str, Callable[..., Any]]]:
    """Yield all functions, constructors and methods of the public names that are defined in the package."""
    for name in mauvecl.__all__:
        thing = getattr(mauvecl, name)
        if inspect.isfunction(thing):
            yield name, thing
        elif inspect.isclass(thing) and thing is not InputError:
            if not issubclass(thing, Record):
                yield name, thing.__init__
            for method in dir(thing):
                found = inspect.getattr_static(thing, method)
                found = found.__func__ if isinstance(found, classmethod | staticmethod) else found
                inside = inspect.isfunction(found) and found.__module__.startswith("mauvecl")
                if inside and not method.startswith("_") and found.__module__ not in INNER:
                    yield f"{name}.{method}", found
    for name, thing in vars(bulk).items():
        if inspect.isfunction(thing) and thing.__module__ == bulk.__name__ and not name.startswith("_"):
            yield f"bulk.{name}", thing


FUNCTIONS = dict(public_functions())


def arguments(function: Callable[..., Any]) -> list[inspect.Parameter]:
    return [
        p
        for p in inspect.signature(function).parameters.values()
        if p.name not in ("self", "cls") and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    ]


PARAMETERS = [(path, p.name) for path, function in FUNCTIONS.items() for p in arguments(function)]


@cache
def annotation(path: str, name: str) -> Any:
    return FUNCTIONS[path].__validated__[name].annotation()  # type: ignore[attr-defined]


def parts(hint: Any) -> Iterator[Any]:
    """Yield an annotation and all that it consists of, metadata included."""
    yield hint
    if hint == ArrayLike or get_origin(hint) is np.ndarray:
        return
    for part in get_args(hint):
        yield from parts(part)


def accepted(hint: Any, *kinds: Any) -> bool:
    return any(part in kinds or get_origin(part) in kinds for part in parts(hint) if part.__hash__)


def anything(hint: Any) -> bool:
    return accepted(hint, Any, object) or any(getattr(part, "_is_protocol", False) for part in parts(hint))


def holds_arrays(hint: Any) -> bool:
    return any(part == ArrayLike or get_origin(part) is np.ndarray for part in parts(hint))


def having(condition: Callable[[Any], bool]) -> list[tuple[str, str]]:
    """Return the parameters whose annotations meet a condition."""
    checked = [(path, name) for path, name in PARAMETERS if hasattr(FUNCTIONS[path], "__validated__")]
    return [(path, name) for path, name in checked if condition(annotation(path, name))]


def wrong_values(path: str, name: str) -> Iterator[tuple[str, Any]]:
    """Yield values that a parameter must refuse, by its annotation."""
    hint, arrays = annotation(path, name), holds_arrays(annotation(path, name))
    if anything(hint):
        return
    yield "an object", object()
    yield "a list of two kinds", [1, object()]
    if not any(isinstance(part, AnyUnit) for part in parts(hint)):
        yield "a mass", 3 * u.kg
    if not accepted(hint, str, __import__("pathlib").Path):
        yield "text", "no such thing"
    if not accepted(hint, bool) and not arrays:
        yield "a truth", True
    if not arrays:
        yield "NaN", np.nan
        yield "an array", np.ones((2, 3))
    if not accepted(hint, type(None)):
        yield "nothing", None
    for part in parts(hint):
        if inspect.isclass(part) and part.__module__.startswith("mauvecl"):
            yield "a class of the same name", type(part.__name__, (), {})()


def test_every_public_function_is_validated() -> None:
    assert len(PARAMETERS) > 300
    assert not [path for path, f in FUNCTIONS.items() if arguments(f) and not hasattr(f, "__validated__")]


@pytest.mark.parametrize("path", [path for path, f in FUNCTIONS.items() if arguments(f)])
def test_wrong_arguments_raise(path: str) -> None:
    """The wrong argument is given alone: it is refused before others are missed."""
    function = FUNCTIONS[path]
    own = [None] if next(iter(inspect.signature(function).parameters)) in ("self", "cls") else []
    for name in (name for there, name in PARAMETERS if there == path):
        for kind, value in wrong_values(path, name):
            with pytest.raises(InputError) as error:
                function(*own, **{name: value})
            assert error.value.key == name, kind
            assert error.value.expected, (name, kind)
            assert "\n" not in str(error.value)


def example(hint: Any) -> Any:
    """Return a plain number in the middle of a parameter's range, or an array where it takes one."""
    known = next((part for part in parts(hint) if isinstance(part, Range)), Range(1.0, 3.0))
    low, high = max(known.low, -1e3), min(known.high, 1e6)
    middle = low + (high - low) / 3
    return np.array([middle, middle]) if holds_arrays(hint) else middle


@pytest.mark.parametrize(("path", "name"), having(lambda hint: any(isinstance(part, Unit) for part in parts(hint))))
def test_quantities_are_plain_numbers(path: str, name: str) -> None:
    check = FUNCTIONS[path].__validated__[name]  # type: ignore[attr-defined]
    hint = annotation(path, name)
    unit = next(part.name for part in parts(hint) if isinstance(part, Unit))
    value: Any = example(hint)
    if accepted(hint, tuple):
        value = (value, value)
        if accepted(hint, Sequence):
            value = (value,)
    plain = check(value)
    for other in (unit, *EQUIVALENT.get(unit, ())):
        equivalent = u.spectral() if unit == "nm" else u.temperature()
        given = (np.asarray(value) * u.Unit(unit)).to(u.Unit(other), equivalent)
        np.testing.assert_allclose(np.asarray(check(given), float), np.asarray(plain, float), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("path", "name"), having(lambda hint: int in (hint, *get_args(hint))))
def test_whole_numbers_may_be_floats(path: str, name: str) -> None:
    check = FUNCTIONS[path].__validated__[name]  # type: ignore[attr-defined]
    for value in (7.0, np.int64(7), np.float32(7), 7 * u.one):
        assert check(value) == 7
        assert type(check(value)) is int
    with pytest.raises(InputError):
        check(7.5)
