"""What public functions are given: each argument is of the kind that its annotation names, or one sentence says so."""

from __future__ import annotations

import ast
import operator
import os
from collections.abc import Callable, Iterable, Mapping
from functools import cache, wraps
from inspect import Signature, isclass, isfunction, signature
from typing import Any, NamedTuple, TypeVar, cast

from mauvecl.schema.errors import InputError
from mauvecl.schema.quantities import is_quantity, numbers, unit_of, word_of

Given = TypeVar("Given", bound=Callable[..., Any])

#: Annotations that stand for one of some words: which, is the function's own matter.
TEXTS = (
    "str",
    "Literal",
    "System",
    "Order",
    "Signal",
    "Geometry",
    "Per",
    "Kind",
    "Tails",
    "Weighted",
    "Lookup",
    "Method",
)
#: Those of one number as well.
ARRAYS = ("Float", "ArrayLike")
SEVERAL = ("tuple", "list", "Sequence", "Collection", "Iterable")
#: Annotations that are short for others.
SHORT = {"Prior": "Uniform | Normal", "Curve": "Sinusoid | Table", "Progress": "Callable", "CompletenessOf": "Callable"}
#: Classes that are told apart by their names, since rooms below know none above.
CLASSES = (
    "Checkpoint", "Comparison", "Cooling", "CosmicRays", "Detection", "Device", "EnergyScale", "Engine",
    "Expectation", "FlareModel", "FlareSpectrum", "Linear", "Normal", "Nuisances", "Pool", "Shape", "Sinusoid",
    "Sky", "Source", "Star", "Stare", "Stares", "Study", "Table", "Tiles", "Uniform",
)  # fmt: skip
#: What arguments are called in a sentence where their own names would not tell.
CALLED = {"quiet": "the quiescent star"}


class _Kind(NamedTuple):
    """What a sentence calls it, and what makes one of a value, or raises a TypeError."""

    words: str
    take: Callable[[str, Any], Any]


def public(thing: Given) -> Given:
    """Let a function, or a class in its constructor and public methods, take what its annotations say and nothing else.

    Quantities become plain numbers in the unit that a parameter's name means (`quantities.UNITS`), 1e5 a whole number.
    What an annotation says with a Quantity or a class not in `CLASSES` is the function's own matter; so are ranges.

    Raises
    ------
    InputError
        By what it returns, for an argument of another kind, and for NaN.
    """
    if not isclass(thing):
        return _taking(thing)
    for name, member in list(vars(thing).items()):
        if name.startswith("_") and name != "__init__":
            continue
        if isinstance(member, classmethod | staticmethod):
            setattr(thing, name, type(member)(_taking(member.__func__)))
        elif isfunction(member):
            setattr(thing, name, _taking(member))
    return thing


def _taking(function: Given) -> Given:
    @wraps(function)
    def taking(*args: Any, **words: Any) -> Any:
        known, kinds = _read(function)
        try:
            bound = known.bind(*args, **words)
        except TypeError:
            # Python's own sentence for too few or too many.
            return function(*args, **words)
        for name, value in bound.arguments.items():
            if name in kinds:
                bound.arguments[name] = _taken(name, value, kinds[name])
        return function(*bound.args, **bound.kwargs)

    return cast(Given, taking)


@cache
def _read(function: Callable[..., Any]) -> tuple[Signature, dict[str, tuple[_Kind, ...]]]:
    """A function's parameters and what they may be, once it is called."""
    known = signature(function)
    plain = (one for one in known.parameters.values() if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD))
    return known, {one.name: kinds for one in plain if (kinds := _kinds(str(one.annotation)))}


def _taken(name: str, value: Any, kinds: tuple[_Kind, ...]) -> Any:
    for kind in kinds:
        try:
            return kind.take(name, value)
        except (TypeError, ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
    expected = " or ".join(
        dict.fromkeys(kind.words or word_of(unit_of(name)) for kind in kinds if kind.words != "None")
    )
    if any(word in expected for word in CLASSES):
        called = CALLED.get(name, name if name[-1:].isdigit() else f"the {name}")
        raise InputError(f"{called} is of the type {type(value).__name__}", expected, key=name, value=value)
    raise InputError.of(name, value, expected)


@cache
def _kinds(annotation: str) -> tuple[_Kind, ...]:
    """The alternatives of an annotation; none where one of them is not looked at here."""
    try:
        tree = ast.parse(annotation, mode="eval").body
    except SyntaxError:
        return ()
    kinds = [_kind(one) for one in _alternatives(tree)]
    return () if None in kinds else tuple(kind for kind in kinds if kind is not None)


def _alternatives(tree: ast.expr) -> Iterable[ast.expr]:
    if isinstance(tree, ast.BinOp):
        yield from (*_alternatives(tree.left), *_alternatives(tree.right))
    elif isinstance(tree, ast.Name) and tree.id in SHORT:
        yield from _alternatives(ast.parse(SHORT[tree.id], mode="eval").body)
    else:
        yield tree


def _kind(tree: ast.expr) -> _Kind | None:
    if isinstance(tree, ast.Constant) and tree.value is None:
        return _Kind("None", _nothing)
    inner = tree.slice if isinstance(tree, ast.Subscript) else None
    plain = tree.value if isinstance(tree, ast.Subscript) else tree
    name = plain.attr if isinstance(plain, ast.Attribute) else plain.id if isinstance(plain, ast.Name) else ""
    if name in SEVERAL:
        each = inner.elts[0] if isinstance(inner, ast.Tuple) else inner
        kinds = _kinds(ast.unparse(each)) if each is not None else ()
        words = " or ".join(kind.words for kind in kinds)
        return _Kind(f"several of {words}" if words else "several", lambda what, value: _several(what, value, kinds))
    if name in CLASSES:
        how = ", as `expect(source, instrument)` makes" if name == "Expectation" else ""
        article = "an" if name[0] in "AEIO" else "a"
        return _Kind(f"{article} {name}{how}", lambda what, value: _instance(name, value))
    if name in TEXTS:
        return _Kind("text", _text)
    if name in ARRAYS:
        return _Kind("numbers", _array)
    if name == "NDArray":
        return _Kind(
            "an array of numbers",
            lambda what, value: _is(bool(getattr(value, "ndim", isinstance(value, list | tuple))), _array(what, value)),
        )
    kinds_by_name = {
        "float": _Kind("", _float),
        "int": _Kind("a whole number", _whole),
        "bool": _Kind("true or false", _truth),
        "Path": _Kind("a path", _path),
        "Mapping": _Kind("a dictionary", _mapping),
        "dict": _Kind("a dictionary", _mapping),
        "Callable": _Kind("a function", _callable),
    }
    return kinds_by_name.get(name)


def _is(condition: bool, value: Any) -> Any:
    if not condition:
        raise TypeError
    return value


def _nothing(_: str, value: Any) -> Any:
    return _is(value is None, value)


def _float(name: str, value: Any) -> Any:
    if is_quantity(value):
        plain = numbers(name, value, unit_of(name))
        return float(_is(plain.ndim == 0, plain))
    if type(value) not in (float, int):
        _is(not getattr(value, "ndim", 0) and _dtype(value) in tuple("iuf"), value)
    # Comparison with itself: no NaN.
    return _is(value == value, value)


def _whole(_: str, value: Any) -> int:
    _is(not (isinstance(value, str) or _true_or_false(value)), value)
    try:
        return operator.index(value)
    except TypeError:
        plain = float(value.to_value("") if is_quantity(value) else _is(not getattr(value, "ndim", 0), value))
        return int(_is(plain.is_integer(), plain))


def _truth(_: str, value: Any) -> Any:
    return _is(_true_or_false(value), value)


def _text(_: str, value: Any) -> Any:
    return _is(isinstance(value, str), value)


def _path(_: str, value: Any) -> Any:
    return _is(isinstance(value, str | os.PathLike), value)


def _mapping(_: str, value: Any) -> Any:
    return _is(isinstance(value, Mapping), value)


def _callable(_: str, value: Any) -> Any:
    return _is(callable(value), value)


def _array(name: str, value: Any) -> Any:
    if is_quantity(value):
        return numbers(name, value, unit_of(name))
    return _is(_dtype(value) in tuple("iufb"), value)


def _dtype(value: Any) -> str:
    """NumPy's letter; what is large, or on a disk, is not read for it."""
    if not hasattr(value, "dtype"):
        import numpy as np

        value = np.asarray(value)
    return str(getattr(value.dtype, "kind", ""))


def _true_or_false(value: Any) -> bool:
    # NumPy's own too, which need not be loaded.
    return type(value).__name__ in ("bool", "bool_")


def _several(name: str, value: Any, kinds: tuple[_Kind, ...]) -> Any:
    if isinstance(value, str) and any(kind.take is _text for kind in kinds):
        # One word where several may be given.
        return value
    if isinstance(value, str | bytes | Mapping) or is_quantity(value):
        raise TypeError
    values = value if isinstance(value, list | tuple) or hasattr(value, "dtype") else tuple(value)
    one = name.removesuffix("s")
    taken = [_taken(f"{one} {i + 1}", each, kinds) for i, each in enumerate(values)] if kinds else values
    return values if all(a is b for a, b in zip(taken, values, strict=True)) else type(values)(taken)


def _instance(name: str, value: Any) -> Any:
    return _is(any(one.__name__ == name for one in type(value).__mro__), value)
