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


#: Paths of the quantities that sweeps, maps and limits vary, except names.
NUMERIC = {
    quantity.name: path
    for path, field in fields()
    if (quantity := metadata(field, "Quantity")) is not None and quantity.name != "star"
}


def reach(name: str) -> Any:
    return metadata(dict(fields())[NUMERIC[name]], "Range")


def outside(name: str) -> list[float]:
    """Return values just outside of both ends of a range."""
    one = reach(name)
    below = one.low if one.open_low else one.low - 1e-9 * max(abs(one.low), 1.0)
    return [below, one.high if one.open_high else one.high * (1 + 1e-9)]


def ends(name: str) -> list[float]:
    one = reach(name)
    return [1e-3 if one.open_low else one.low, 0.999 if one.open_high else one.high]
