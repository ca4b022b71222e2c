"""Records and sections of a study: validation with errors in one style, and readers of written values."""

from __future__ import annotations

import contextlib
import difflib
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, Self, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic.fields import FieldInfo

from mauvecl.schema import fields
from mauvecl.schema.errors import REMEDY, InputError, shortened, shown, together


class Record(BaseModel):
    """Frozen pydantic model that rejects unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def __init__(self, /, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise input_error(type(self).__name__, type(self), error) from None

    # Nested records are not built by this method, so that the outer one names the full path of a wrong value.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]

    def __setattr__(self, name: str, value: Any) -> None:
        try:
            super().__setattr__(name, value)
        except ValidationError:
            fault = f"{type(self).__name__}.{name} cannot be set in place"
            raise InputError(f"{fault}; use a changed copy: with_, with_settings, at", key=name) from None


Model = TypeVar("Model", bound=BaseModel)


def built(model: type[Model], values: Any, where: str) -> Model:
    """Validate the values of a model; the message of an error begins with the place where they are."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise input_error(where, model, error) from None


#: Words for what pydantic calls a valid string, path, tuple and dictionary.
TYPE_WORDS = {"string_type": "text", "path_type": "a path", "tuple_type": "a list", "dict_type": "a table"}
#: Largest number of wrong values that one message names.
MOST_FAULTS = 5


def input_error(where: str, model: type[BaseModel], error: ValidationError) -> InputError:
    """Return the faults as one InputError whose message begins with the place where they are."""
    faults: dict[tuple[int | str, ...], Any] = {}
    for fault in error.errors():
        # A list of which an entry is wrong counts as too short.
        if not any(place[: len(fault["loc"])] == fault["loc"] for place in faults):
            faults[fault["loc"]] = fault
    errors = [_input_error_of(model, fault) for fault in [*faults.values()][:MOST_FAULTS]]
    errors[0] = errors[0].within(where)
    if len(faults) > MOST_FAULTS:
        errors.append(InputError(f"and {len(faults) - MOST_FAULTS} more values are wrong", key=errors[0].key))
    return together(errors)


def _input_error_of(model: type[BaseModel], fault: Any) -> InputError:
    """Return a fault that pydantic finds in a model as an InputError."""
    path = [str(step) for step in fault["loc"] if step != "[key]"]
    key = ".".join(path) or model.__name__.lower()
    value, message = fault.get("input"), fault["msg"]
    match fault["type"]:
        case "extra_forbidden":
            names = list(_fields(model, path[:-1]))
            near = difflib.get_close_matches(path[-1], names, n=1)
            remedy = f", did you mean {near[0]!r}?" if near else f": use one of {', '.join(names)}"
            return InputError(f"unknown key {shortened(key)}{remedy}", key=key)
        case "missing":
            return InputError(f"{key!r} is missing, but needs a value", key=key)
        case "value_error":
            return _error_of_validator(model, path, fault)
        case "too_long" | "too_short":
            expected = message.partition("should have ")[2].partition(" after")[0]
        case _:
            expected = TYPE_WORDS.get(fault["type"], message.removeprefix("Input should be "))
            if expected == message:
                return InputError(f"{key} = {shown(value)}: {message.lower()}", key=key)
    return InputError.of(key, value, expected)


def _error_of_validator(model: type[BaseModel], path: list[str], fault: Any) -> InputError:
    """Return the error that a validator raised, with the key where its sentence does not name it."""
    key, field = ".".join(path), _fields(model, path[:-1]).get(path[-1]) if path else None
    is_value = field is not None and model_in(field.annotation) is None
    error = fault["ctx"]["error"]
    if not isinstance(error, InputError):
        error = InputError(str(error))
    name = error.key
    # A record's own error names the key; that of a single value's validator may not.
    if is_value and path[-1] not in str(error):
        error = error.within(key)
    if name is None or path[-1:] == [name]:
        error.key = key or None
    elif name in _fields(model, path) or (is_value and isinstance(fault.get("input"), dict)):
        # Validators of records, and of tables that are no records, name a key of them.
        error.key = ".".join([*path, name])
    return error


def _fields(model: type[BaseModel], path: list[str]) -> Any:
    for key in path:
        if key in model.model_fields:
            model = model_in(model.model_fields[key].annotation) or model
    return model.model_fields


def model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the model in a type such as `Star | None` or `tuple[Star, ...]`, or None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for inner in get_args(annotation) if (model := model_in(inner))), None)


def plain(value: Any) -> Any:
    """Convert arrays, dates, times and coordinates to the lists, numbers and text that a study stores.

    Quantities remain, since the type of a number converts them to its unit.
    """
    value = fields.date_text(value)
    is_array = bool(getattr(value, "ndim", 0))
    if isinstance(value, list | tuple) or (is_array and (fields.is_date(value) or hasattr(value, "icrs"))):
        return (tuple if isinstance(value, tuple) else list)(map(plain, value))
    if fields.is_quantity(value):
        return list(map(plain, fields.as_quantity(value))) if is_array else value
    if hasattr(value, "tolist"):
        return value.tolist()
    if hasattr(value, "icrs") and hasattr(value, "to_string"):
        return str(value.icrs.to_string("decimal", precision=6))
    return value


class Section(Record):
    """A section of a study."""

    @model_validator(mode="after")
    def _checked(self) -> Self:
        self._check_values()
        return self

    def _check_values(self) -> None:
        """Raise InputError if values contradict each other."""

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return a copy with another value at a path of sections and a key.

        Each record of a list, such as stars, takes the value; a list of numbers is replaced by it.
        """
        key, *inner = path
        old = getattr(self, key)
        if not inner:
            new = (value,) if isinstance(old, tuple) else value
        elif isinstance(old, tuple):
            new = tuple(section.with_value(inner, value) for section in old)
        else:
            new = old.with_value(inner, value)
        return self.model_copy(update={key: new})

    _plain = field_validator("*", mode="before")(plain)


def setting(
    default: Any,
    text: str | fields.Help,
    *,
    flag: str | fields.Flag | tuple[fields.Flag, ...] = (),
    usual: str = "",
    choices: str | tuple[str, ...] = "",
    quantity: tuple[str, str, str] | None = None,
    min_length: int | None = None,
    **page: Any,
) -> Any:
    """Return the field of a key with its default (``dict`` for an empty table), and what is stated besides its type.

    `text` is that of `Help`, with its explanation after a semicolon; `usual` and `choices` are its words for the
    default and for the accepted values. `flag` holds the names of a flag with blanks between them, or flags that
    convert values, `quantity` name, description and label of a `Quantity`, and `page` the values of a `Widget`; its
    choices are `options`, or those of a tuple of `choices`.
    """
    flags = flag if isinstance(flag, tuple) else (fields.Flag(*flag.split()) if isinstance(flag, str) else flag,)
    if isinstance(text, str):
        noun, _, explanation = text.partition("; ")
        text = fields.Help(noun, explanation, usual, choices if isinstance(choices, str) else ", ".join(choices))
    if page:
        page["choices"] = page.pop("options", () if isinstance(choices, str) else choices)
    field: FieldInfo = Field(default_factory=dict) if default is dict else Field(default=default, min_length=min_length)
    field.metadata += [text, *flags]
    field.metadata += [fields.Widget(**page)] if page else []
    field.metadata += [fields.Quantity(*quantity)] if quantity else []
    return field


def fields_of(section: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], FieldInfo]]:
    """Yield the path and the field of every key of a section and of the sections in it."""
    for key, field in section.model_fields.items():
        yield (*path, key), field
        inner = model_in(field.annotation)
        if inner is not None:
            yield from fields_of(inner, (*path, key))


def given_keys(section: Section, keys: Sequence[str]) -> list[str]:
    """Return those of `keys` that a section gives."""
    return [key for key in keys if (value := getattr(section, key)) is not None and value is not False]


@contextlib.contextmanager
def reading_for(section: Section, path: str) -> Iterator[None]:
    """Name keys of a section by their path in the study where an error in the block proposes them.

    Readers of files propose their own parameters, which several sections have as keys.
    """

    def with_path(match: re.Match[str]) -> str:
        return f"`{path}.{match[0][1:]}" if match["key"] in type(section).model_fields else match[0]

    try:
        yield
    except InputError as error:
        raise InputError(REMEDY.sub(with_path, str(error)), key=error.key) from error


def check_one(section: Section, subject: str, *keys: str, needed: bool = False) -> None:
    """Raise InputError if several of these keys are given or, where one is needed, none."""
    present = given_keys(section, keys)
    if len(present) > 1 or (needed and not present):
        has, number = " and ".join(present) or "none", "one" if needed else "only one"
        raise InputError(f"{subject} needs {number} of {', '.join(keys)}, but has {has}", key=[*present, *keys][0])


def check_all(section: Section, subject: str, *keys: str) -> None:
    """Raise InputError if only a part of these keys is given."""
    present = given_keys(section, keys)
    if 0 < len(present) < len(keys):
        needed = f"{subject} needs all of {', '.join(keys)} or none"
        raise InputError(f"{needed}, but has only {' and '.join(present)}", key=present[0])


def check_needs(section: Section, subject: str, keys: Sequence[str], needed: str) -> None:
    """Raise InputError if one of these keys is given without the key that it needs."""
    present = given_keys(section, keys)
    if present and getattr(section, needed) is None:
        raise InputError(f"{subject} has {' and '.join(present)}, which needs {needed} as well", key=present[0])


def check_different(names: Sequence[str], subject: str, key: str) -> None:
    """Raise InputError if a name is given twice; its sentence begins with what is named."""
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{subject} {shortened(twice)} is named twice, but must be given once", key=key)


# Readers of values that are written as text, as on the command line; each receives the value's name for messages.


def number_or_text(text: str) -> float | str:
    """Return the finite number that a text states, or the text itself, which may have a unit."""
    with contextlib.suppress(ValueError):
        return int(text)
    with contextlib.suppress(ValueError):
        if math.isfinite(value := float(text)):
            return value
    return text


def read_words(texts: Sequence[str], _: str) -> list[str]:
    """Read names from several texts, each with one name or names with commas between them."""
    return [word.strip() for text in texts for word in text.split(",")]


def read_axis(text: str, name: str) -> dict[str, Any]:
    """Read an axis: magnitude:4:10:16, amplitude:0.01:1:16:log, or exposure=5,50,600."""
    if "=" in text:
        quantity, _, values = text.partition("=")
        words = [word.strip() for word in values.split(",")]
        return {"quantity": quantity, "values": words if quantity == "star" else list(map(number_or_text, words))}
    try:
        quantity, start, stop, steps, *ending = text.split(":")
        spaced = {"start": number_or_text(start), "stop": number_or_text(stop), "steps": int(steps)}
    except ValueError as error:
        raise InputError.of(name, text, "quantity:start:stop:steps, the same with :log, or quantity=a,b,c") from error
    if ending not in ([], ["log"]):
        raise InputError.of(name, text, "quantity:start:stop:steps with :log or nothing at its end")
    return {"quantity": quantity, "log": bool(ending)} | spaced


def read_assignment(text: str, name: str, expected: str) -> tuple[str, str]:
    """Read a name and its value, with an equals sign between them."""
    key, _, value = map(str.strip, text.rpartition("="))
    if not (key and value):
        raise InputError.of(name, text, expected)
    return key, value


def read_line_fluxes(texts: Sequence[str], name: str) -> dict[str, float | str]:
    """Read fluxes of emission lines, such as 'Mg II=0.05'."""
    lines = {}
    for text in texts:
        line, value = read_assignment(text, name, "NAME=FLUX, such as 'Mg II=0.05'")
        lines[line] = number_or_text(value)
    return lines


def read_ranges(texts: Sequence[str], name: str, *, expected: str, unit: str) -> list[tuple[float, float]]:
    """Read ranges, such as 322:368."""
    return [_pair(text, name, expected, unit) for text in texts]


def read_declinations(text: str, name: str) -> tuple[float, float] | str:
    """Read a range of declinations such as -46.4:31.8, or none."""
    if fields.says_none(text):
        return "none"
    return _pair(text, name, "low:high in degrees, or none", "deg")


def _pair(text: str, name: str, expected: str, unit: str) -> tuple[float, float]:
    """Read two numbers, each of which may have a unit of its own."""
    try:
        measures = ((word, fields.with_unit(word, unit)) for word in text.split(":"))
        low, high = (float(word) if value is None else value for word, value in measures)
    except ValueError as error:
        raise InputError.of(name, text, expected) from error
    return low, high


def read_frame_choice(text: str, name: str) -> str | list[int]:
    """Read which frames are stored: stack, all, or numbers such as 0,4,9."""
    if text in ("stack", "all"):
        return text
    try:
        return [int(word) for word in text.split(",")]
    except ValueError as error:
        raise InputError.of(name, text, "stack, all, or numbers such as 0,4,9") from error
