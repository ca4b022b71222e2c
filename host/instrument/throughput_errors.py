"""Uncertainty of a calibrated instrument, as modes with independent normal amplitudes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Unit

from ..content_equality import ContentEquality
from ..tables.ecsv import read_numbers

Float = NDArray[np.float64]

#: Start of the names of columns with modes.
MODE = "mode_"
#: Values of an instrument that modes may change in addition to the throughput, in words.
CALIBRATED = {
    "conversion_uv_per_electron": "gain",
    "read_noise_dn": "read noise",
    "dark_scale_dn_per_s": "dark current",
    "dark_slope_per_c": "dark slope",
    "pixel_zero_nm": "wavelength zero point",
    "dispersion_nm_per_pixel": "dispersion",
    "gaussian_fwhm_nm": "line width",
}


@validated
@dataclass(frozen=True, eq=False)
class ThroughputErrors(ContentEquality):
    """Covariance of the logarithm of the throughput: the sum of the outer products of modes.

    Attributes
    ----------
    wavelength_nm : ndarray, shape (n,)
        Ascending; modes are linear between these wavelengths and constant beyond them.
    modes : ndarray, shape (n_mode, n)
        Changes of the natural logarithm of the throughput for amplitudes of one standard deviation, those that matter
        most first.
    source : str
        "tag: source" of the values.
    values : mapping of tuple
        Changes of the natural logarithm of other values in the first modes, by name: `CALIBRATED`. Counts determine the
        product of gain and throughput, for instance, so that an error of the gain changes both.
    """

    wavelength_nm: Annotated[Float, Unit("nm")]
    modes: Float
    source: str = "A: assumed, no source given"
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        nm, modes = np.array(self.wavelength_nm, np.float64), np.array(self.modes, np.float64)
        if nm.ndim != 1 or nm.size < 2 or not np.isfinite(nm).all() or not (np.diff(nm) > 0).all():
            raise InputError.of("wavelength_nm", nm.shape, "at least two finite, ascending wavelengths")
        if modes.ndim != 2 or modes.shape[1] != nm.size or not np.isfinite(modes).all():
            raise InputError.of("modes", modes.shape, f"finite values of the shape (n_mode, {nm.size})")
        for name, values in (("wavelength_nm", nm), ("modes", modes)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        others = self.values
        if not isinstance(others, Mapping) or not set(others) <= set(CALIBRATED):
            raise InputError.of("values", others, f"some of {', '.join(CALIBRATED)}")
        for name, changes in others.items():
            given = np.asarray(changes)
            if (
                given.ndim != 1
                or given.size > len(modes)
                or given.dtype.kind not in "fi"
                or not np.isfinite(given).all()
            ):
                raise InputError.of(
                    f"values.{name}", changes, f"at most {len(modes)} finite numbers, one for each mode"
                )
        object.__setattr__(self, "values", {name: tuple(map(float, changes)) for name, changes in others.items()})

    @classmethod
    def of_covariance(
        cls,
        wavelength_nm: ArrayLike,
        covariance: ArrayLike,
        source: str,
        *,
        names: Sequence[str] = (),
        sums: Float | None = None,
        lost: float = 1e-4,
    ) -> ThroughputErrors:
        """Return the modes of a covariance of log throughput and of the logarithms of other values.

        Parameters
        ----------
        wavelength_nm : array_like, shape (n,)
        covariance : array_like, shape (n + n_name, n + n_name)
        source : str
        names : sequence of str
            Of the other values.
        sums : ndarray, shape (n_sum, n), optional
            Weighted sums of the curve, such as the light in bands. The first modes hold all errors of these sums and of
            the other values.
        lost : float
            Share of the variances that is lost by leaving out the smallest modes.
        """
        nm, total = np.asarray(wavelength_nm, np.float64), np.asarray(covariance, np.float64)
        sd = np.sqrt(np.diag(total))
        scale = np.where(sd > 0, sd, 1.0)
        variances, vectors = np.linalg.eigh(total / np.outer(scale, scale))
        variances, vectors = np.maximum(variances[::-1], 0.0), vectors[:, ::-1]
        left = 1.0 - np.cumsum(variances) / max(variances.sum(), np.finfo(float).tiny)
        kept = int((left > lost).sum()) + 1
        modes = scale[:, None] * (vectors * np.sqrt(variances))[:, :kept]
        first = np.vstack([np.zeros((0, nm.size)) if sums is None else sums]) @ modes[: nm.size]
        first = np.vstack([first, modes[nm.size :] / scale[nm.size :, None]])
        if len(first):
            # Any rotation of the modes has the same covariance.
            modes = modes @ np.linalg.svd(first)[2].T
        others = {
            name: tuple(row[: len(first)]) for name, row in zip(names, modes[nm.size :], strict=True) if row.any()
        }
        return cls(nm, modes[: nm.size].T, source, others)

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
            modes = np.array([table[name] for name in names])
            return cls(table["wavelength"], modes, source, table.meta.get("values", {}))
        except InputError as error:
            raise error.within(f"throughput errors {path}") from None

    @property
    def digest(self) -> str:
        """SHA-256 of the values."""
        others = repr(sorted(self.values.items())).encode() if self.values else b""
        return hashlib.sha256(self.wavelength_nm.tobytes() + self.modes.tobytes() + others).hexdigest()

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
