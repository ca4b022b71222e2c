"""Parsers of text, TOML and JSON from files and flags, which raise InputError for invalid content."""

from __future__ import annotations

import contextlib
import json
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mauvecl.host.files.size_limits import read_bytes
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import printable, shortened

#: Range of absolute values of numbers from users, apart from 0; products of several stay within double precision.
SMALLEST, LARGEST = 1e-30, 1e30
#: Largest energy in erg, since flares reach 1e38, and the ending of keys of energies.
ERG, LARGEST_ERG = "_erg", 1e45
#: Other keys of energies.
ENERGIES = ("injections.low", "injections.high")
#: Range of integers of 64 bits, signed or unsigned.
WHOLE = (-(2**63), 2**64 - 1)
#: Longest text and deepest nesting of a study or an instrument.
LONGEST, DEEPEST = 4096, 32
#: Place in a file, in messages of parsers.
PLACE = re.compile(r"\b(?:line|row|column) \d{1,9}(?:,? (?:line|row|column) \d{1,9})*")
#: Largest number of parts of a dotted TOML key.
MOST_PARTS = 512


@contextlib.contextmanager
def parsing(what: str, expected: str) -> Iterator[None]:
    """Convert any exception of a parser of foreign content to InputError with a one-sentence message.

    Parsers of TOML, YAML, FITS and tables raise many kinds of exceptions on damaged content: their own, those of Python
    (RecursionError, OverflowError) and of NumPy (MemoryError for sizes that a header claims).

    Parameters
    ----------
    what : str
        Description of the content, including its name.
    expected : str
        Expected content.
    """
    try:
        yield
    except InputError:
        raise
    except RecursionError as error:
        raise InputError(f"{what} is nested too deeply", expected, key="file") from error
    except MemoryError as error:
        raise InputError(f"{what} needs more memory than is available", expected, key="file") from error
    except Exception as error:
        # Other libraries' messages are for their programmers, but may state the place.
        place = PLACE.search(str(error))
        fault = f"{what} cannot be read{f' ({place[0]})' if place else ''}"
        raise InputError(fault, expected, key="file", value=str(error)[:200] or type(error).__name__) from error


def read_text(path: Path, what: str) -> str:
    """Read a regular file of limited size as UTF-8 text, with or without a byte-order mark."""
    return as_text(read_bytes(path, what), f"{what} {shortened(str(path))}")


def as_text(content: bytes, what: str) -> str:
    """Decode UTF-8; raise InputError whose message begins with `what` if the bytes are not UTF-8."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{what} is not text (byte {error.start + 1} is not UTF-8)", "text in UTF-8", key="file"
        ) from error


def is_file(path: Path) -> bool:
    """Return whether a path exists and is not a folder; False for impossible paths."""
    try:
        return path.exists() and not path.is_dir()
    except (OSError, ValueError):
        return False


def toml(text: str, what: str) -> dict[str, Any]:
    """Parse TOML; raise InputError if it is invalid, or as `possible`."""
    parts = max(part.count(".") for part in re.split(r"[=,{}\[\]\n#]", text))
    if parts > MOST_PARTS:
        # The memory of Python's parser grows with the square of this number.
        raise InputError(f"{what} has a key of {parts} parts", f"at most {MOST_PARTS}", key="file", value=parts)
    with parsing(what, "TOML"):
        try:
            tree = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"{what}: {printable(str(error), 160)}", "valid TOML", key="file") from error
    possible(tree, what)
    return tree


def json_data(text: str, what: str) -> Any:
    """Parse JSON; raise InputError if it is invalid or nested too deeply."""
    with parsing(what, "JSON"):
        return json.loads(text)


def possible(data: Any, what: str) -> None:
    """Check nested data for values that are impossible in any study or instrument.

    Raises InputError for a number beyond `SMALLEST` to `LARGEST` (energies in erg: `LARGEST_ERG`),
    an integer beyond 64 bits, text that is too long or contains impossible characters, or nesting that is too deep.
    """
    waiting: list[tuple[str, Any, int]] = [("", data, 0)]
    while waiting:
        key, value, depth = waiting.pop()
        energy = key in ENERGIES or any(part.endswith(ERG) for part in key.split("."))
        fault = _fault(value, LARGEST_ERG if energy else LARGEST)
        if depth > DEEPEST:
            fault = f"is nested more than {DEEPEST} deep", "less"
            key = shortened(key, 40)
        if fault:
            named = printable(key, 80)
            raise InputError(f"{what}: {named or 'the value'} {fault[0]}", fault[1], key=named or None, value=value)
        if isinstance(value, Mapping):
            for name, item in value.items():
                if isinstance(name, str) and (bad := _fault(name)):
                    raise InputError(f"{what}: a key {bad[0]}", bad[1], key=printable(name, 80), value=item)
                waiting.append((f"{key}.{name}" if key else str(name), item, depth + 1))
        elif isinstance(value, list | tuple):
            waiting += [(f"{key}.{i}", item, depth + 1) for i, item in enumerate(value)]


def _fault(value: Any, largest: float = LARGEST) -> tuple[str, str] | None:
    """Return the fault of a value and the expected range, or None if the value is possible."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int):
        if not WHOLE[0] <= value <= WHOLE[1]:
            return f"is a whole number of {value.bit_length()} bits", "at most 64"
    elif isinstance(value, float):
        # NaN and infinity are checked where the meaning of the value is known.
        if math.isfinite(value) and value and not SMALLEST <= abs(value) <= largest:
            return f"= {value!r}", f"0 or a size from {SMALLEST:g} to {largest:g}"
    elif isinstance(value, str | Path):
        text = str(value)
        if len(text) > LONGEST:
            return f"is a text of {len(text)} characters", f"at most {LONGEST}"
        if not text.isprintable() and (bad := next((c for c in text if c == "\0" or "\ud800" <= c <= "\udfff"), None)):
            return f"= {shortened(text)} holds the character {bad!r}", "text"
    return None
