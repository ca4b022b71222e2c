"""Keys of studies and instruments with what their annotations say, by their public fields alone."""

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from mauvecl import Study


def fields(model: type[BaseModel] = Study, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], FieldInfo]]:
    """Yield the path and the field of every key, those of sections in it as well."""
    for name, field in model.model_fields.items():
        path = (*above, name)
        yield path, field
        for inner in models_in(field.annotation):
            yield from fields(inner, path)


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the sections that a value may hold."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from models_in(part)


def metadata(field: FieldInfo, kind: str, *, every: bool = False) -> Any:
    """Return the first piece of metadata of a kind, by the name of its class, or all of them."""
    found = [one for one in (*field.metadata, *_within(field.annotation)) if type(one).__name__ == kind]
    return found if every else next(iter(found), None)


def _within(annotation: Any) -> Iterator[Any]:
    """Yield the metadata of parts of an annotation, such as of the values of a tuple."""
    yield from getattr(annotation, "__metadata__", ())
    for part in get_args(annotation):
        yield from _within(part)
