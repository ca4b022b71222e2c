"""Tables of `data/`, which hold the cases of tests."""

import tomllib
from pathlib import Path
from typing import Any

DATA = Path(__file__).parent / "data"


def toml(name: str) -> dict[str, Any]:
    """Return the content of a TOML file by its path in `data/`."""
    return tomllib.loads((DATA / name).read_text(encoding="utf-8"))
