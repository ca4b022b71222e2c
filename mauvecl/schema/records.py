"""Pydantic models whose validation errors become an InputError of one sentence."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, Any, cast, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
)
from pydantic_core import PydanticCustomError

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened, shown

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
        values = list(given.values()) if isinstance(given, dict) and not _model_in(annotation) else given
        if holds_truth(values) and not _takes_truth(annotation):
            raise PydanticCustomError("truth", "Input should be no truth value")
        return validate(given)

    def __setattr__(self, name: str, value: Any) -> None:
        try:
            super().__setattr__(name, value)
        except ValidationError:
            raise InputError(
                f"{type(self).__name__}.{name} is not set in place, expected a changed copy: with_, with_settings, at"
            ) from None


def holds_truth(given: Any) -> bool:
    """Return whether a value is true or false, or a list that has one; records within look at their own."""
    if isinstance(given, list | tuple):
        return any(map(holds_truth, given))
    # NumPy's own too, which need not be loaded.
    return type(given).__name__ in ("bool", "bool_")


def _takes_truth(annotation: Any) -> bool:
    return annotation in (bool, Any) or any(map(_takes_truth, get_args(annotation)))


def input_error(where: str, model: type[BaseModel], error: ValidationError) -> InputError:
    """Return the first fault as an InputError whose message begins with the place where it is."""
    first = error.errors()[0]
    message = f"{where}: {_sentence(model, error)}"
    key, value = ".".join(map(str, first["loc"])) or None, first.get("input")
    inner = first.get("ctx", {}).get("error")
    if isinstance(inner, InputError):
        # What read the value knows more of it than where it stands.
        known = InputError(message, key=inner.key or key, value=inner.value)
        known.expected = inner.expected
        return known
    return InputError(message, key=key, value=None if first["type"] == "missing" else value)


def _sentence(model: type[BaseModel], error: ValidationError) -> str:
    """Return the first validation error as a sentence: key = value, expected ..."""
    first = error.errors()[0]
    path = [str(part) for part in first["loc"]]
    key = ".".join(path) or model.__name__.lower()
    if first["type"] == "extra_forbidden":
        fields = list(_fields(model, path[:-1]))
        near = difflib.get_close_matches(path[-1], fields, n=1)
        expected = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(fields)}"
        return f"unknown key {shortened(key)}, {expected}"
    if first["type"] == "missing":
        return f"{key!r} is missing, expected a value"
    if first["type"] == "value_error":
        told = str(first["ctx"]["error"])
        field = _fields(model, path[:-1]).get(path[-1]) if path else None
        # A record's own error names the key; that of a single value's validator may not.
        own = field is None or _model_in(field.annotation) is not None or path[-1] in told
        return told if own else f"{key}: {told}"
    told = first["msg"].removeprefix("Input should be ")
    value = f"{key} = {shown(first['input'])}"
    if first["type"] in ("too_long", "too_short"):
        return f"{value}, expected {told.partition('should have ')[2].partition(' after')[0]}"
    if first["type"] == "truth":
        return f"{value}, expected a number or text, not true or false"
    if first["type"] == "path_type":
        return f"{value}, expected a path"
    return f"{value}: {told.lower()}" if told == first["msg"] else f"{value}, expected {told}"


def _fields(model: type[BaseModel], path: list[str]) -> Any:
    for part in path:
        if part in model.model_fields:
            model = _model_in(model.model_fields[part].annotation) or model
    return model.model_fields


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """Return the model in a type such as `Star | None` or `tuple[Star, ...]`, or None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((model for part in get_args(annotation) if (model := _model_in(part))), None)
