"""Two-column files of users: weights of linear statistics and nuisance spectra."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.files.parsing import LARGEST, SMALLEST, read_text
from mauvecl.host.tables.text_lines import columns
from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

if TYPE_CHECKING:
    from mauvecl.statistics.linear import Linear


def read_weights(name: str, path: Path, wavelength_nm: NDArray[np.float64]) -> Linear:
    """Read a linear statistic from a file of wavelengths, nm, and weights per DN.

    Weights are interpolated linearly and are 0 outside the file's range.
    """
    from mauvecl.statistics.linear import Linear

    what = f"weights {shortened(path.name)} of {shortened(name)}"
    return Linear(name, _read_values(what, "weights", path, wavelength_nm))


def read_spectrum(name: str, path: Path, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Read a nuisance spectrum from a file of wavelengths, nm, and DN per exposure, and interpolate it to pixels."""
    return _read_values(f"spectrum {shortened(path.name)} of {shortened(name)}", "DN", path, wavelength_nm)


def _read_values(what: str, kind: str, path: Path, wavelength_nm: NDArray[np.float64]) -> NDArray[np.float64]:
    rows = columns(what, read_text(path, kind if kind == "weights" else "spectrum"))
    return at_pixels(what, kind, rows, wavelength_nm)


def at_pixels(
    what: str, kind: str, rows: NDArray[np.float64], wavelength_nm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Interpolate values linearly to pixels, 0 outside their range, shape (n_pixel,).

    Parameters
    ----------
    what, kind : str
        Names of the source and of its values, for messages.
    rows : ndarray, shape (n, 2)
        Wavelengths, nm, and values.
    wavelength_nm : ndarray, shape (n_pixel,)
    """
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.all(np.diff(rows[:, 0]) > 0):
        raise InputError(
            f"{what} have {rows.shape[1] if rows.ndim == 2 else 'no'} columns",
            f"ascending wavelengths in nm and {kind}",
            key=what,
        )
    sizes = np.abs(rows)
    bad = ~((rows == 0) | ((sizes >= SMALLEST) & (sizes <= LARGEST)))
    if bad.any():
        raise InputError(
            f"{what} hold {rows[bad][0]!r}",
            f"0 or a size from {SMALLEST:g} to {LARGEST:g}",
            key=what,
            value=rows[bad][0].tolist(),
        )
    values = np.interp(wavelength_nm, rows[:, 0], rows[:, 1], left=0.0, right=0.0)
    if not values.any():
        raise InputError(
            f"{what} are 0 at every pixel",
            f"some of {wavelength_nm.min():.0f}-{wavelength_nm.max():.0f} nm to count",
            key=what,
        )
    return np.asarray(values)
