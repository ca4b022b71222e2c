"""Records and sections of a study, validated by pydantic, with errors in one style, and their reference."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self, Union, cast, get_args, get_origin

from pydantic import (
    BaseModel,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError, PydanticUndefined

from mauvecl.schema.errors import InputError, shortened, shown, together
from mauvecl.schema.fields import Flag, Help, Range, Unit, as_typed, first, found, is_quantity, is_truth, numbers

if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)


class _InputErrorMeta(ModelMetaclass):
    """Metaclass that raises InputError for invalid arguments.

    Validation of a nested record does not pass `__call__`, so the outer record names the full path of the value.
    """

    def __call__(cls, *args: Any, **values: Any) -> Any:  # noqa: N805
        try:
            return super().__call__(*args, **values)
        except ValidationError as error:
            raise input_error(cls.__name__, cast(type[BaseModel], cls), error) from None


class Record(BaseModel, metaclass=_InputErrorMeta):
    """Frozen pydantic model that rejects unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="wrap")
    @classmethod
    def _no_truth_as_number(cls, given: Any, validate: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        """Refuse true and false where a number or text is expected; pydantic takes them for 1 and 0."""
        annotation = cls.model_fields[str(info.field_name)].annotation
        values = list(given.values()) if isinstance(given, dict) and not model_in(annotation) else given
        if holds_truth(values) and not _takes_truth(annotation):
            raise PydanticCustomError("truth", "Input should be no truth value")
        return validate(given)

    def __setattr__(self, name: str, value: Any) -> None:
        try:
            super().__setattr__(name, value)
        except ValidationError:
            raise InputError(
                f"{type(self).__name__}.{name} is not set in place",
                "a changed copy: with_, with_settings, at",
                key=name,
            ) from None


def holds_truth(given: Any) -> bool:
    """Return whether a value is true or false, or a list that has one; nested records check their own."""
    if isinstance(given, list | tuple):
        return any(map(holds_truth, given))
    return is_truth(given)


def _takes_truth(annotation: Any) -> bool:
    return annotation in (bool, Any) or any(map(_takes_truth, get_args(annotation)))


#: Largest number of wrong values that one message names.
MOST_FAULTS = 5


def input_error(where: str, model: type[BaseModel], error: ValidationError) -> InputError:
    """Return the faults as one InputError whose message begins with the place where they are."""
    faults: dict[tuple[str, ...], Any] = {}
    for fault in error.errors():
        # A key of several types has an error for each of them.
        key = _key_of(model, fault["loc"])
        # A list of which an entry is wrong counts as too short.
        if not any(other[: len(key)] == key for other in faults):
            faults[key] = fault
    first, *others = (_input_error_of(model, fault) for fault in [*faults.values()][:MOST_FAULTS])
    left = len(faults) - MOST_FAULTS
    more = [InputError(f"and {left} more values are wrong", key=first.key)] if left > 0 else []
    return together([first.within(where), *others, *more])


def _key_of(model: type[BaseModel], location: tuple[int | str, ...]) -> tuple[str, ...]:
    """Return the part of an error's location that names a key, with the numbers of entries in lists."""
    path: list[str] = []
    inner: type[BaseModel] | None = model
    for part in location:
        if isinstance(part, str):
            if inner is None:
                break
            field = inner.model_fields.get(part)
            inner = None if field is None else model_in(field.annotation)
        path.append(str(part))
    return tuple(path)


def _input_error_of(model: type[BaseModel], first: Any) -> InputError:
    path = [str(part) for part in first["loc"]]
    key, value, message = ".".join(path) or model.__name__.lower(), first.get("input"), first["msg"]
    match first["type"]:
        case "extra_forbidden":
            fields = list(_fields(model, path[:-1]))
            unknown = f"unknown key {shortened(key)}"
            if not (near := difflib.get_close_matches(path[-1], fields, n=1)):
                return InputError(unknown, f"one of {', '.join(fields)}", key=key)
            fault = InputError(f"{unknown}, did you mean {near[0]!r}?", key=key)
            fault.expected = near[0]
            return fault
        case "missing":
            return InputError(f"{key!r} is missing", "a value", key=key)
        case "value_error":
            return _own_error(model, path, key, first)
        case "too_long" | "too_short":
            expected = message.partition("should have ")[2].partition(" after")[0]
        case "truth":
            expected = "a number or text, not true or false"
        case "path_type":
            expected = "a path"
        case _:
            expected = message.removeprefix("Input should be ")
            if expected == message:
                return InputError(f"{key} = {shown(value)}: {message.lower()}", key=key)
    return InputError.of(key, value, expected)


def _own_error(model: type[BaseModel], path: list[str], key: str, first: Any) -> InputError:
    """Return the error that a validator raised, with the key where its sentence does not name it."""
    inner = first["ctx"]["error"]
    message, field = str(inner), _fields(model, path[:-1]).get(path[-1]) if path else None
    # A record's own error names the key; that of a single value's validator may not.
    own = field is None or model_in(field.annotation) is not None or path[-1] in message
    if not isinstance(inner, InputError):
        fault, _, expected = message.partition(", expected ")
        inner = InputError(fault, expected or None, key=key if path else None)
    # The message of the value's reader is more precise than its location.
    found = inner if own else inner.within(key)
    found.key = _full_key(model, path, inner.key)
    if field is not None and model_in(field.annotation) is None and isinstance(first.get("input"), dict) and inner.key:
        # The validator of a table that is no record names a key of it.
        found.key = ".".join([*path, inner.key]) if found.key == inner.key else found.key
    return found


def _full_key(model: type[BaseModel], path: list[str], inner: str | None) -> str | None:
    """Return the path of a nested record and the field that its own error names; any other key as it is."""
    if inner is None or path[-1:] == [inner]:
        return ".".join(path) or None
    return ".".join([*path, inner]) if inner in _fields(model, path) else inner


def _fields(model: type[BaseModel], path: list[str]) -> Any:
    for part in path:
        if part in model.model_fields:
            model = model_in(model.model_fields[part].annotation) or model
    return model.model_fields


def model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the model in a type such as `Star | None` or `tuple[Star, ...]`, or None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for part in get_args(annotation) if (model := model_in(part))), None)


def plain(key: str, given: Any, unit: str) -> Any:
    """Convert Quantities, times and coordinates to the numbers and text that a study stores."""
    if is_quantity(given):
        return numbers(key, given, unit).tolist()
    if isinstance(given, list | tuple) and any(map(is_quantity, given)):
        return [plain(key, item, unit) for item in given]
    if hasattr(given, "tolist"):
        return given.tolist()
    if hasattr(given, "utc") and hasattr(given, "isot"):
        return str(given.utc.isot)
    if hasattr(given, "icrs") and hasattr(given, "to_string"):
        return str(given.icrs.to_string("decimal", precision=6))
    return given


class Section(Record):
    """A section of a study."""

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return a copy with another value at a path of sections and a key.

        Each record of a list, such as stars, takes the value; a list of numbers is replaced by it.
        """
        key, *inner = path
        old = getattr(self, key)
        new = value
        if inner:
            many = tuple(section.with_value(inner, value) for section in (old if isinstance(old, tuple) else (old,)))
            new = many if isinstance(old, tuple) else many[0]
        elif isinstance(old, tuple):
            new = (value,)
        return self.model_copy(update={key: new})

    @field_validator("*", mode="before")
    @classmethod
    def _in_its_unit(cls, given: Any, info: ValidationInfo) -> Any:
        """Convert a Quantity to the unit of the key, and times and coordinates to text."""
        key = str(info.field_name)
        unit = _unit_of(cls, key)
        if unit is not None and not getattr(given, "ndim", 0):
            # The annotation converts it.
            return given
        return plain(key, given, "" if unit is None else unit.name)


@cache
def _unit_of(section: type[Section], key: str) -> Unit | None:
    return first(section.model_fields[key], Unit)


def fields_of(section: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], FieldInfo]]:
    """Yield the path and the field of every key of a section and of the sections in it."""
    for key, field in section.model_fields.items():
        yield (*path, key), field
        inner = model_in(field.annotation)
        if inner is not None:
            yield from fields_of(inner, (*path, key))


class Key(NamedTuple):
    """Row of the reference."""

    path: str
    meaning: str
    accepted: str
    default: str
    flags: str


def keys_of(section: type[BaseModel]) -> list[Key]:
    """Return the reference of every key of a section and of the sections in it, in the order of their declaration."""
    keys = []
    for path, field in fields_of(section):
        if (help := first(field, Help)) is None:
            continue
        meaning = help.text + (f": {help.choices}" if help.choices else "") + (f", {help.more}" if help.more else "")
        accepted = _accepted(field.annotation, (first(field, Unit) or Unit("")).name, first(field, Range) or Range())
        value = field.get_default(call_default_factory=True)
        default = help.default or ("required" if value is PydanticUndefined else _text(value))
        flags = ", ".join(name for flag in found(field, Flag) for name in flag.names)
        keys.append(Key(".".join(path), meaning, accepted, default, flags))
    return keys


def _accepted(annotation: Any, unit: str, reach: Range) -> str:
    """Describe the values of a type in words."""
    parts = get_args(annotation)
    if get_origin(annotation) is Annotated:
        return _accepted(parts[0], unit, reach)
    if get_origin(annotation) in (Union, UnionType):
        return " or ".join(dict.fromkeys(_accepted(part, unit, reach) for part in parts if part is not NoneType))
    if get_origin(annotation) is Literal:
        return ", ".join(map(str, parts))
    if get_origin(annotation) is tuple:
        several = parts[-1] is Ellipsis
        return f"list of {_accepted(parts[0], unit, reach)}" if several else f"{len(parts)} numbers"
    if get_origin(annotation) is dict:
        return f"table of {_accepted(parts[1], unit, reach)}"
    if model_in(annotation) is not None:
        return "table"
    if annotation in (float, int):
        return reach.words(unit, whole=annotation is int)
    return {str: "text", bool: "true or false", Path: "path"}.get(annotation, "file")


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_text, value))}]"
    return as_typed(value)
