"""Text files with columns of numbers, such as curves and shapes of flares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

from ..files.parsing import parsing, read_text


def read_columns(what: str, kind: str, path: Path) -> NDArray[np.float64]:
    """Read times and values from a file, shape (n, 2); # starts a comment.

    `what` names the content and `kind` the values in messages.
    """
    named = f"{what} {shortened(path.name)}"
    pairs = columns(named, read_text(path, what))
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise InputError(f"{named} has no two columns", f"times and {kind}", key=what)
    return pairs


def columns(what: str, text: str) -> NDArray[np.float64]:
    """Parse rows of numbers, shape (n, 2) if each row has two."""
    with parsing(what, "two columns"):
        rows = [line.split("#", 1)[0].split() for line in text.splitlines()]
        return np.array([[float(word) for word in row] for row in rows if row])
