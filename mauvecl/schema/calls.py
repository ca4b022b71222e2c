"""Validation of the arguments of public functions against their annotations."""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, wraps
from itertools import chain, repeat
from textwrap import dedent
from types import CodeType
from typing import Any, TypeVar, cast

from pydantic_core import ValidationError

from mauvecl.schema.core_schemas import ALTERNATIVE, validator
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shown

Public = TypeVar("Public", bound=Callable[..., Any])


def validated(thing: Public) -> Public:
    """Validate the arguments of a function, or of a class's constructor and public methods, when they are called.

    Arguments are checked against the annotations; `core_schemas` and `fields.Unit` state what is converted. Defaults
    are not checked. A wrong argument raises InputError.
    """
    if not inspect.isclass(thing):
        return _validated(thing)
    for name, member in list(vars(thing).items()):
        if name.startswith("_") and name != "__init__":
            continue
        if isinstance(member, classmethod | staticmethod):
            setattr(thing, name, type(member)(_validated(member.__func__)))
        elif inspect.isfunction(member):
            setattr(thing, name, _validated(member, thing))
    return thing


def _validated(function: Public, owner: type | None = None) -> Public:
    parameters = list(inspect.signature(function).parameters.values())
    in_order = [p.name for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    rest = next((p.name for p in parameters if p.kind is p.VAR_POSITIONAL), "")
    checks = {p.name: _Parameter(function, p, owner) for p in parameters if p.kind is not p.VAR_KEYWORD}

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        # Python itself reports missing, unknown and superfluous arguments.
        names = chain(in_order, repeat(rest))
        return function(
            *[checks[name](value) if name else value for name, value in zip(names, args, strict=False)],
            **{name: checks[name](value) if name in checks else value for name, value in named.items()},
        )

    vars(call)["__validated__"] = checks
    return cast(Public, call)


class _Parameter:
    """A parameter, whose annotation is resolved when it is first given an argument."""

    def __init__(self, function: Callable[..., Any], known: inspect.Parameter, owner: type | None) -> None:
        self.name, self.default = known.name, known.default
        self.text = known.annotation
        self.modules = [function.__globals__]
        if owner is not None and function.__name__ == "__init__":
            # A dataclass inherits fields, whose annotations belong to the module of the base class.
            self.modules += [vars(sys.modules[base.__module__]) for base in owner.__mro__[1:-1]]
        self.validate: Callable[[Any], Any] | None = None

    def __call__(self, value: Any) -> Any:
        if value is self.default or self.text is inspect.Parameter.empty:
            return value
        if self.validate is None:
            self.validate = validator(self.annotation()).validate_python
        try:
            return self.validate(value)
        except ValidationError as error:
            raise _input_error(self.name, error) from None

    def annotation(self) -> Any:
        """Return the resolved annotation; names that modules import for type checkers only are imported now."""
        if not isinstance(self.text, str):
            return self.text
        for module in self.modules:
            with suppress(NameError):
                return eval(self.text, module, _TypeCheckingNames(module))
        raise TypeError(f"the annotation {self.text} of {self.name} names nothing known")


def _input_error(name: str, error: ValidationError) -> InputError:
    """Return the error of the innermost wrong value, with the alternatives that it may be."""
    faults = [
        (tuple(part for part in fault["loc"] if part != ALTERNATIVE), fault)
        for fault in error.errors(include_url=False)
    ]
    place, first = max(faults, key=lambda one: len(one[0]))
    expected = dict.fromkeys(fault["msg"].removeprefix("Input should be ") for at, fault in faults if at == place)
    where = name + "".join(f"[{part!r}]" for part in place if part != "[key]")
    return InputError(f"{where} = {shown(first['input'])}", " or ".join(expected), key=name, value=first["input"])


class _TypeCheckingNames(dict[str, Any]):
    """Names that a module defines in its block `if TYPE_CHECKING`; each is defined when it is looked up."""

    def __init__(self, module: dict[str, Any]) -> None:
        super().__init__()
        self.module = module

    def __missing__(self, name: str) -> Any:
        if name in self.module:
            raise KeyError(name)
        exec(_type_checking_statements(self.module["__name__"])[name], self.module, self)
        return self[name]


@cache
def _type_checking_statements(module: str) -> dict[str, CodeType]:
    """Return the statement that defines each name of a module's block `if TYPE_CHECKING`."""
    source = inspect.getsource(sys.modules[module])
    block = re.search(r"^if TYPE_CHECKING:\n((?: .*\n|\n)+)", source, re.MULTILINE)
    statements: dict[str, CodeType] = {}
    for statement in ast.parse(dedent(block[1])).body if block else ():
        code = compile(ast.Module([statement], []), module, "exec")
        if isinstance(statement, ast.Import | ast.ImportFrom):
            statements |= {one.asname or one.name: code for one in statement.names}
        elif isinstance(statement, ast.Assign):
            statements |= {one.id: code for one in statement.targets if isinstance(one, ast.Name)}
    return statements
