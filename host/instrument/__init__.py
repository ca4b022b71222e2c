"""Instruments, and the names and paths of their files, which studies read without importing NumPy."""

from __future__ import annotations

import difflib
import warnings
from importlib import resources
from pathlib import Path

from mauvecl.host.tables.files import is_file
from mauvecl.schema.errors import InputError, shortened

#: Instrument where none is named.
DEFAULT_INSTRUMENT = "mauve"
#: Former names of embedded instruments, with those of version 2 and later.
FORMER_NAMES = {"mauve-electrons": "mauve"}
#: What "mauve" meant before version 2.
FORMERLY_MAUVE = "mauvesim"


def shipped_names() -> tuple[str, ...]:
    """Return the names of the instruments that the package contains."""
    files = resources.files(__package__).joinpath("instruments").iterdir()
    return tuple(sorted(file.name.removesuffix(".toml") for file in files if file.name.endswith(".toml")))


def current_name(name: str) -> str:
    """Return today's name of an embedded instrument, and warn if version 2 renamed it; return other names unchanged."""
    if name not in FORMER_NAMES:
        return name
    warnings.warn(f"The instrument {name} is called {FORMER_NAMES[name]} since version 2.", stacklevel=2)
    return FORMER_NAMES[name]


def instrument_path(name: str | Path, folder: Path) -> Path:
    """Return the path of an embedded instrument or of a user's file, relative to `folder`."""
    if not isinstance(name, str | Path):
        raise InputError.of("instrument", name, "a name or the path of a TOML file")
    names = shipped_names()
    name = current_name(name) if isinstance(name, str) else name
    if name in names:
        # setuptools installs real files; a zipped package would have to be extracted.
        return Path(str(resources.files(__package__).joinpath("instruments", f"{name}.toml")))
    path = folder / name
    if is_file(path):
        return path
    if path.is_dir():
        raise InputError(f"instrument {shortened(str(path))} is a folder; give a name or a TOML file", key="instrument")
    if path.suffix == ".toml":
        remedy = "give the name of an instrument or the path of a TOML file"
        raise InputError(f"instrument file {shortened(str(path))} does not exist; {remedy}", key="instrument")
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.0)[0]
    remedy = f"use {' or '.join(names)} (nearest: {near!r}) or the path of a TOML file"
    raise InputError(f"instrument {shortened(str(name))} is unknown; {remedy}", key="instrument")
