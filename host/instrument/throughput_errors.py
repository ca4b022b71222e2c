"""Uncertainty of a calibrated throughput, as modes with independent normal amplitudes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Unit

from ..content_equality import ContentEquality
from ..files.ecsv import read_numbers

Float = NDArray[np.float64]

#: Start of the names of columns with modes.
MODE = "mode_"


@validated
@dataclass(frozen=True, eq=False)
class ThroughputErrors(ContentEquality):
    """Covariance of the logarithm of the throughput: the sum of the outer products of modes.

    Attributes
    ----------
    wavelength_nm : ndarray, shape (n,)
        Ascending; modes are linear between these wavelengths and constant beyond them.
    modes : ndarray, shape (n_mode, n)
        Changes of the natural logarithm of the throughput for amplitudes of one standard deviation, largest first.
    source : str
        "tag: source" of the values.
    """

    wavelength_nm: Annotated[Float, Unit("nm")]
    modes: Float
    source: str = "A: assumed, no source given"

    def __post_init__(self) -> None:
        nm, modes = np.array(self.wavelength_nm, np.float64), np.array(self.modes, np.float64)
        if nm.ndim != 1 or nm.size < 2 or not np.isfinite(nm).all() or not (np.diff(nm) > 0).all():
            raise InputError.of("wavelength_nm", nm.shape, "at least two finite, ascending wavelengths")
        if modes.ndim != 2 or modes.shape[1] != nm.size or not np.isfinite(modes).all():
            raise InputError.of("modes", modes.shape, f"finite values of the shape (n_mode, {nm.size})")
        for name, values in (("wavelength_nm", nm), ("modes", modes)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)

    @classmethod
    def of_covariance(
        cls, wavelength_nm: ArrayLike, covariance: ArrayLike, source: str, lost: float = 1e-4
    ) -> ThroughputErrors:
        """Return the modes of a covariance of log throughput, without those that hold a share `lost` of its trace.

        Parameters
        ----------
        wavelength_nm : array_like, shape (n,)
        covariance : array_like, shape (n, n)
        source : str
        lost : float
        """
        values, vectors = np.linalg.eigh(np.asarray(covariance, np.float64))
        values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
        left = 1.0 - np.cumsum(values) / max(values.sum(), np.finfo(float).tiny)
        kept = int((left > lost).sum()) + 1
        return cls(np.asarray(wavelength_nm), (vectors * np.sqrt(values)).T[:kept], source)

    @classmethod
    def read(cls, path: str | Path) -> ThroughputErrors:
        """Read an ECSV table with the columns wavelength (nm) and mode_1, mode_2 and so on."""
        table = read_numbers(path, "throughput errors")
        names = [name for name in table.columns if name.startswith(MODE)]
        if "wavelength" not in table.columns or not names or len(names) + 1 != len(table.columns):
            raise InputError(
                f"throughput errors {path} have the columns {', '.join(table.columns)}",
                f"wavelength, {MODE}1, {MODE}2 and so on",
                key="columns",
                value=table.columns,
            )
        if table.units["wavelength"] != "nm":
            raise InputError.of("unit", table.units["wavelength"], "nm", where=f"throughput errors {path}")
        source = f"{table.meta.get('tag', 'A')}: {table.meta.get('source', f'assumed, no source in {Path(path).name}')}"
        try:
            return cls(table["wavelength"], np.array([table[name] for name in names]), source)
        except InputError as error:
            raise error.within(f"throughput errors {path}") from None

    @property
    def digest(self) -> str:
        """SHA-256 of the values."""
        return hashlib.sha256(self.wavelength_nm.tobytes() + self.modes.tobytes()).hexdigest()

    def __repr__(self) -> str:
        # The instrument's digest is computed from representations.
        return f"ThroughputErrors({self.digest})"

    def _line(self) -> str:
        return f"{len(self.modes)} modes, {self.source}"

    def at(self, wavelength_nm: ArrayLike) -> Float:
        """Return the modes at wavelengths in nm, one row per mode."""
        nm = np.asarray(wavelength_nm, np.float64)
        return np.array([np.interp(nm, self.wavelength_nm, mode) for mode in self.modes]).reshape(-1, *nm.shape)

    def sd(self, wavelength_nm: ArrayLike) -> Float:
        """Return the standard deviation of the logarithm of the throughput, shape of `wavelength_nm`."""
        return np.asarray(np.sqrt((self.at(wavelength_nm) ** 2).sum(axis=0)))
