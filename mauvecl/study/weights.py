"""What a user brings in two columns: weights of a linear statistic, or the spectrum of something unknown."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.host.files.bounded import shortened
from mauvecl.host.files.parsed import LARGEST, SMALLEST, parsing, read_text

if TYPE_CHECKING:
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
    from mauvecl.statistics.linear import Linear

    what = f"weights {shortened(path.name)} of {shortened(name)}"
    return Linear(name, _read_values(what, "weights", path, wavelength_nm))


def read_spectrum(name: str, path: Path, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """What an unknown amplitude of one adds to each pixel: wavelengths, nm, and DN of the exposure, as `read_weights`.

    Returns
    -------
    ndarray, shape (n_pixel,)
    """
    return _read_values(f"spectrum {shortened(path.name)} of {shortened(name)}", "DN", path, wavelength_nm)


def _read_values(what: str, kind: str, path: Path, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    return at_pixels(what, kind, _columns(what, kind if kind == "weights" else "spectrum", path), wavelength_nm)


def read_columns(what: str, kind: str, path: Path) -> NDArray[np.float64]:
    """Times and values from a file, shape (n, 2); # starts a comment.

    Parameters
    ----------
    what, kind : str
        What the file holds, and what its values are, for messages.
    path : Path

    Raises
    ------
    InputError
        If it cannot be read or holds no two columns of numbers.
    """
    pairs = _columns(f"{what} {shortened(path.name)}", what, path)
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise InputError(f"{what} {shortened(path.name)} has no two columns, expected times and {kind}")
    return pairs


def _columns(what: str, kind: str, path: Path) -> NDArray[np.float64]:
    text = read_text(path, kind)
    return columns(what, text)


def columns(what: str, text: str) -> NDArray[np.float64]:
    """Numbers of a text's rows, shape (n, 2) where each has two.

    Raises
    ------
    InputError
        If there are no such rows.
    """
    with parsing(what, "two columns"):
        return np.array([[float(word) for word in row] for line in text.splitlines() if (row := _words(line))])


def at_pixels(
    what: str, kind: str, rows: NDArray[np.float64], wavelength_nm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Values between rows of wavelengths, nm, and values, straight between them, zero beyond; shape (n_pixel,).

    Parameters
    ----------
    what, kind : str
        What holds them and what they are, for messages.
    rows : ndarray, shape (n, 2)
    wavelength_nm : ndarray, shape (n_pixel,)

    Raises
    ------
    InputError
        If there are other columns, a number that cannot be, or nothing for any pixel.
    """
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.all(np.diff(rows[:, 0]) > 0):
        raise InputError(
            f"{what} have {rows.shape[1] if rows.ndim == 2 else 'no'} columns, expected ascending wavelengths in "
            f"nm and {kind}"
        )
    sizes = np.abs(rows)
    bad = ~((rows == 0) | ((sizes >= SMALLEST) & (sizes <= LARGEST)))
    if bad.any():
        raise InputError(f"{what} hold {rows[bad][0]!r}, expected 0 or a size from {SMALLEST:g} to {LARGEST:g}")
    values = np.interp(wavelength_nm, rows[:, 0], rows[:, 1], left=0.0, right=0.0)
    if not values.any():
        raise InputError(
            f"{what} are 0 at every pixel, expected some of {wavelength_nm.min():.0f}-{wavelength_nm.max():.0f} nm to "
            "count"
        )
    return np.asarray(values)


def _words(line: str) -> list[str]:
    return line.split("#", 1)[0].split()
