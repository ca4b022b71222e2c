"""Linear statistics of a user's own, from files of weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened
from mauvecl.host.files.parsed import LARGEST, SMALLEST, parsing, read_text
from mauvecl.statistics.linear import Linear


def read_weights(name: str, path: Path, wavelength_nm: NDArray[np.float64]) -> Linear:
    """A linear statistic from a file of wavelengths, nm, and weights per DN: straight between them, zero beyond.

    Parameters
    ----------
    name : str
        The statistic's.
    path : Path
    wavelength_nm : ndarray, shape (n_pixel,)
        Of the pixels.

    Raises
    ------
    InputError
        If the file holds no such columns, a number that cannot be, or no weight for any pixel.
    """
    what = f"weights {shortened(path.name)} of {shortened(name)}"
    text = read_text(path, "weights")
    with parsing(what, "two columns"):
        columns = np.array([[float(word) for word in row] for line in text.splitlines() if (row := _words(line))])
    if columns.ndim != 2 or columns.shape[1] != 2 or not np.all(np.diff(columns[:, 0]) > 0):
        raise InputError(
            f"{what} have {columns.shape[1] if columns.ndim == 2 else 'no'} columns, expected ascending wavelengths in "
            "nm and weights"
        )
    sizes = np.abs(columns)
    bad = ~((columns == 0) | ((sizes >= SMALLEST) & (sizes <= LARGEST)))
    if bad.any():
        raise InputError(f"{what} hold {columns[bad][0]!r}, expected 0 or a size from {SMALLEST:g} to {LARGEST:g}")
    weights = np.interp(wavelength_nm, columns[:, 0], columns[:, 1], left=0.0, right=0.0)
    if not weights.any():
        raise InputError(
            f"{what} are 0 at every pixel, expected some light of {wavelength_nm.min():.0f}-{wavelength_nm.max():.0f} "
            "nm weighed"
        )
    return Linear(name, weights)


def _words(line: str) -> list[str]:
    return line.split("#", 1)[0].split()
