"""Validation of the arguments of public functions by their annotations.

Checks are stricter than pydantic's own: text, True and NaN are refused as numbers. They accept what astronomers pass:
NumPy's scalars and arrays, Quantities, and whole numbers such as 1e5. Objects are checked by `isinstance` and never
copied.
"""

from __future__ import annotations

import builtins
import inspect
import os
import sys
from collections import ChainMap
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cache, cached_property, partial, wraps
from itertools import chain, repeat
from pathlib import Path
from pkgutil import resolve_name
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, cast, get_args, get_origin

from pydantic_core import CoreSchema, PydanticCustomError, SchemaValidator, ValidationError, core_schema

from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import as_quantity, is_quantity, is_truth, or_error, whole_number, without_mask, without_unit

#: Place of an error inside an alternative of a union.
ALTERNATIVE = "|"
#: Annotations of containers whose items are validated one by one; functions receive a tuple.
SEQUENCES = (tuple, Sequence, Collection, Iterable)


def schema_of(hint: Any) -> CoreSchema:
    """Return the core schema of an annotation; raises TypeError if it has none, so that every argument is checked."""
    origin, args = _origin(hint), get_args(hint)
    if origin is Annotated:
        schema = schema_of(args[0])
        for metadata in args[1:]:
            schema = metadata.__get_pydantic_core_schema__(args[0], lambda _, inner=schema: inner)
        return schema
    if origin in (Union, UnionType) and NoneType in args:
        kinds = tuple(kind for kind in args if kind is not NoneType)
        return core_schema.nullable_schema(schema_of(Union[kinds]))  # noqa: UP007
    if numpy := sys.modules.get("numpy"):
        if hint == numpy.typing.ArrayLike:
            return _leaf(_array, "numbers")
        if origin is numpy.ndarray:
            return _leaf(_real_array, "an array of numbers")
    if origin in (Union, UnionType):
        choices: Any = [(schema_of(kind), ALTERNATIVE) for kind in args]
        return core_schema.union_schema(choices, mode="left_to_right")
    if origin is Literal:
        return core_schema.literal_schema(list(args))
    if origin in LEAVES:
        return LEAVES[origin]
    if origin in SEQUENCES or origin is list:
        return _sequence(origin, args)
    if origin in (dict, Mapping):
        return core_schema.dict_schema(*map(schema_of, args))
    # Methods of a protocol are checked when they are called.
    if origin in (Any, object) or getattr(origin, "_is_protocol", False):
        return core_schema.any_schema()
    if inspect.isclass(origin):
        article = "an" if origin.__name__[0] in "AEIOU" else "a"
        return or_error(core_schema.is_instance_schema(origin), f"{article} {origin.__name__}")
    raise TypeError(f"arguments of the type {hint} cannot be validated")


def _leaf(take: Callable[[Any], Any], words: str) -> CoreSchema:
    """Return the schema of a function's argument, whose errors state the accepted values."""
    return or_error(core_schema.no_info_plain_validator_function(take), words)


def _number(value: Any) -> float:
    if type(value) not in (float, int):
        value = without_unit(value, "") if is_quantity(value) else value
        _require(not getattr(value, "ndim", 0) and _kind(value) in tuple("iuf"))
    try:
        plain = float(value)
    except OverflowError as error:
        raise ValueError from error
    # NaN differs from itself.
    _require(plain == plain)
    return plain


def _truth(value: Any) -> bool:
    _require(is_truth(value))
    return bool(value)


def _array(value: Any) -> Any:
    if is_quantity(value):
        return without_unit(value, "")
    _require(_kind(value) in tuple("iufb"))
    return without_mask(value)


def _real_array(value: Any) -> Any:
    _require(bool(getattr(value, "ndim", isinstance(value, list | tuple))))
    return _array(value)


def _items(value: Any, size: int | None = None) -> Any:
    is_single = (
        isinstance(value, str | bytes | Mapping) or not isinstance(value, Iterable) or getattr(value, "ndim", 1) == 0
    )
    items = () if is_single else tuple(as_quantity(value))
    if is_single or size not in (None, len(items)):
        raise PydanticCustomError("expected", f"Input should be a sequence{'' if size is None else f' of {size}'}")
    return items


#: Schemas of annotations of single values.
LEAVES: dict[Any, CoreSchema] = {
    float: _leaf(_number, "a number"),
    int: _leaf(whole_number, "a whole number"),
    bool: _leaf(_truth, "true or false"),
    str: or_error(core_schema.is_instance_schema(str), "text"),
    Path: or_error(core_schema.is_instance_schema((str, os.PathLike)), "a path"),
    Callable: or_error(core_schema.callable_schema(), "a function"),
}


def _sequence(origin: Any, args: tuple[Any, ...]) -> CoreSchema:
    items = [schema_of(kind) for kind in args if kind is not ...]
    if origin is tuple and ... not in args:
        schema = core_schema.tuple_positional_schema(items)
        return core_schema.no_info_before_validator_function(partial(_items, size=len(items)), schema)
    schema_of_items = core_schema.list_schema if origin is list else core_schema.tuple_variable_schema
    return core_schema.no_info_before_validator_function(_items, schema_of_items(items[0]))


def _origin(hint: Any) -> Any:
    """Return the class of an annotation without its arguments; NumPy 2.5 defines its own by `type` statements."""
    origin = get_origin(hint) or hint
    return _origin(origin.__value__) if hasattr(origin, "__value__") else origin


def _kind(value: Any) -> str:
    """Return NumPy's letter for the type of a number or array, without reading arrays on a disk."""
    if type(value) is int:
        return "i"
    if not hasattr(value, "dtype"):
        import numpy as np

        value = np.asarray(value)
    return str(getattr(value.dtype, "kind", ""))


def _require(condition: bool) -> None:
    if not condition:
        raise ValueError


Public = TypeVar("Public", bound=Callable[..., Any])


def validated(target: Public) -> Public:
    """Validate the arguments of a function, or of a class's constructor and public methods, when they are called.

    Arguments are checked against the annotations; `schema_of` and `fields.Unit` state what is converted. Defaults
    are not checked. A wrong argument raises InputError.
    """
    if not inspect.isclass(target):
        return _validated(target)
    for name, member in list(vars(target).items()):
        if name.startswith("_") and name != "__init__":
            continue
        if isinstance(member, classmethod | staticmethod):
            setattr(target, name, type(member)(_validated(member.__func__)))
        elif inspect.isfunction(member):
            setattr(target, name, _validated(member, target))
    return target


def _validated(function: Public, owner: type | None = None) -> Public:
    """Return a function that validates its arguments; `owner` is the class of a method."""
    parameters = list(inspect.signature(function).parameters.values())
    in_order = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    variadic = next((p.name for p in parameters if p.kind is p.VAR_POSITIONAL), "")
    checks = {p.name: _Parameter(function, p, owner) for p in parameters if p.kind is not p.VAR_KEYWORD}

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        # Python itself reports missing, unknown and superfluous arguments.
        names = chain(in_order, repeat(variadic))
        return function(
            *[checks[name](value) if name else value for name, value in zip(names, args, strict=False)],
            **{name: checks[name](value) if name in checks else value for name, value in named.items()},
        )

    vars(call)["__validated__"] = checks
    return cast(Public, call)


def checked(kind: Any, name: str, value: Any) -> Any:
    """Return a value as its annotation, such as `Magnitude`, converts it; raises InputError for a wrong one."""
    return _converted(_validator(kind), name, value)


@cache
def _validator(kind: Any) -> Callable[[Any], Any]:
    return SchemaValidator(schema_of(kind)).validate_python


def _converted(validate: Callable[[Any], Any], name: str, value: Any) -> Any:
    """Return a validated value; raises InputError that names the innermost wrong part of it."""
    try:
        return validate(value)
    except ValidationError as error:
        faults = [(tuple(step for step in fault["loc"] if step != ALTERNATIVE), fault) for fault in error.errors()]
    # The innermost wrong value, with the alternatives that it may be.
    place, first = max(faults, key=lambda item: len(item[0]))
    expected = dict.fromkeys(fault["msg"].removeprefix("Input should be ") for at, fault in faults if at == place)
    path = name + "".join(f"[{step!r}]" for step in place if step != "[key]")
    refused = InputError.of(path, first["input"], " or ".join(expected))
    refused.key = InputError.of(name, value, "").key
    raise refused


class _Parameter:
    """A parameter, whose annotation is resolved when it is first given an argument."""

    def __init__(self, function: Callable[..., Any], parameter: inspect.Parameter, owner: type | None) -> None:
        self.name, self.default, self.text = parameter.name, parameter.default, parameter.annotation
        self.modules = [function.__globals__]
        if owner is not None and function.__name__ == "__init__":
            # A dataclass inherits fields, whose annotations belong to the module of the base class.
            self.modules += [vars(sys.modules[base.__module__]) for base in owner.__mro__[1:-1]]

    @cached_property
    def validate(self) -> Callable[[Any], Any]:
        """Validate a value."""
        return SchemaValidator(schema_of(self.annotation())).validate_python

    def __call__(self, value: Any) -> Any:
        if value is self.default or self.text is inspect.Parameter.empty:
            return value
        return _converted(self.validate, self.name, value)

    def annotation(self) -> Any:
        """Return the resolved annotation."""
        return eval(self.text, {}, _Names(*self.modules)) if isinstance(self.text, str) else self.text


#: Types that modules import for type checkers only, and that are not public.
FOREIGN = {
    "ArrayLike": "numpy.typing:ArrayLike",
    "Float": "mauvecl.host.arrays:Float",
    "NDArray": "numpy.typing:NDArray",
    "StaresRequest": "mauvecl.flares.stare_scene:StaresRequest",
    "SkyCoord": "astropy.coordinates:SkyCoord",
    "Time": "astropy.time:Time",
    "np": "numpy",
    "u": "astropy.units",
}


class _Names(ChainMap[str, Any]):
    """Names of modules; further types are those of `FOREIGN` and the public ones of mauvecl."""

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        return resolve_name(FOREIGN.get(name, f"mauvecl:{name}"))
