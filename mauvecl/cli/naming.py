"""Replacement of parameters of functions and keys of studies by flags in messages."""

from __future__ import annotations

import ast
import re
import shlex
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import typer

    from mauvecl.schema.errors import InputError

#: A remedy in a message: `extend`, `resume=True`, `wavelength_unit='Angstrom'`, `fap=0.001`.
_REMEDY = re.compile(r"`(?P<name>[a-z][a-z0-9_.]*)(?:=(?P<value>[^`]+))?`")
#: Parameters with flags of other names that are not keys of the study.
_OTHERWISE = {"setting": "--set"}

#: The command line whose flags messages name, alone in a list.
_app: list[typer.Typer] = []


def name_flags_of(app: typer.Typer) -> None:
    """Set the command line whose flags messages name."""
    _app[:] = [app]


def _commands() -> Iterator[Any]:
    """Yield the called command, then all others."""
    from typer.main import get_command

    called: Any = get_command(_app[0])
    others = [called]
    for word in sys.argv[1:]:
        called = getattr(called, "commands", {}).get(word, called)
    yield called
    while others:
        one = others.pop()
        yield one
        others += getattr(one, "commands", {}).values()


def _flags(name: str, command: Any) -> list[str]:
    """Return the flags that set a parameter or a key of the study, the long one first."""
    from mauvecl.study.keys import keys_with_flags

    # If a key has several flags, the last takes its value unchanged.
    parameters = {key: flag.parameter for key, _, flag in keys_with_flags()}
    wanted = {name} | {parameter for key, parameter in parameters.items() if f".{key}".endswith(f".{name}")}
    for parameter in command.params:
        if parameter.name in wanted:
            return sorted((one for one in parameter.opts if one.startswith("-")), key=len, reverse=True)
    return []


def with_flags(text: str) -> str:
    """Return a message with flags instead of the remedies in backticks."""
    return _REMEDY.sub(_as_flag, text) if "`" in text else text


def _as_flag(found: re.Match[str]) -> str:
    name = found["name"]
    flag = _OTHERWISE.get(name) or next((flags[0] for one in _commands() if (flags := _flags(name, one))), None)
    if flag is None:
        return found[0]
    if found["value"] is None:
        return flag
    try:
        value = ast.literal_eval(found["value"])
    except (ValueError, SyntaxError):
        value = found["value"]
    return flag if value is True else f"{flag} {shlex.quote(str(value))}"


def name_flag(error: InputError) -> str:
    """Return the error's message with a flag instead of its key, if that flag gave the value."""
    text, key = with_flags(str(error)), error.key
    if key is None:
        return text
    name = re.sub(r"\.\d+(?=\.|$)", "", key)
    flags = [_OTHERWISE[name]] if name in _OTHERWISE else _flags(name, command := next(_commands()))
    if not flags:
        # "flare amplitude" is the amplitude of a flare.
        flags = _flags(name.removeprefix("flare_"), command)
    if not any(_gives(word, flags) for word in sys.argv[1:]):
        return text
    # The key as written, which may contain blanks, after its location.
    section, _, own = re.escape(key).replace("_", "[_ ]").rpartition(r"\.")
    shown = rf"(?:{section}\.)?{own}" if section else own
    return re.sub(rf"^(?:[^:=]*: )?{shown} = ", lambda _: f"{flags[0]} ", text)


def _gives(word: str, flags: list[str]) -> bool:
    return any(word.partition("=")[0] == one if one.startswith("--") else word.startswith(one) for one in flags)
