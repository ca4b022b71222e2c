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
        for inner in _parts(field.annotation):
            if isinstance(inner, type) and issubclass(inner, BaseModel):
                yield from fields(inner, path)


def metadata(field: FieldInfo, kind: str, *, every: bool = False) -> Any:
    """Return the first piece of metadata of a kind, by the name of its class, or all of them."""
    found = [one for one in (*field.metadata, *_parts(field.annotation)) if type(one).__name__ == kind]
    return found if every else next(iter(found), None)


def _parts(annotation: Any) -> Iterator[Any]:
    """Yield the parts of an annotation, such as sections, or the metadata of the values of a tuple."""
    metadata = getattr(annotation, "__metadata__", ())
    yield from (annotation, *metadata)
    for part in get_args(annotation)[: 1 if metadata else None]:
        yield from _parts(part)


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
