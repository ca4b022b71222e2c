"""What differs from pixel to pixel of a detector: dark, response, gain, bias and read noise, hot pixels included."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import astropy.units as u
import numpy as np
from numpy.typing import NDArray

from ..arguments import public
from ..content import ByContent
from ..errors import InputError
from ..files.ecsv import read_numbers
from ..quantities import count

Float = NDArray[np.float64]

#: Pixels of an array, at most.
MOST_PIXELS = 65_536
#: Columns of a map's file, and their units: factors on the instrument's value, or values in place of it.
COLUMNS = {
    "response": u.dimensionless_unscaled,
    "dark": u.dimensionless_unscaled,
    "gain": u.dimensionless_unscaled,
    "bias_dn": u.DN,
    "read_noise_dn": u.DN,
}


@public
@dataclass(frozen=True, eq=False)
class PixelMap(ByContent):
    """One value per pixel of the whole array; None leaves the instrument's value.

    Attributes
    ----------
    response, dark, gain : ndarray, shape (n_pixel,), optional
        Factors on the electrons per photon, the dark current and the DN per electron. A hot pixel is one with a large
        factor on its dark.
    bias_dn, read_noise_dn : ndarray, shape (n_pixel,), optional
        DN, and DN rms per frame, in place of the instrument's.
    source : str
    """

    response: Float | None = None
    dark: Float | None = None
    gain: Float | None = None
    bias_dn: Float | None = None
    read_noise_dn: Float | None = None
    source: str = "A: assumed, no source given"

    def __post_init__(self) -> None:
        sizes = set()
        for name in COLUMNS:
            if getattr(self, name) is None:
                continue
            values = np.array(getattr(self, name), np.float64)
            if values.ndim != 1:
                raise InputError(f"{name} of the pixel map has the shape {values.shape}, expected one value per pixel")
            bad = ~(np.isfinite(values) & (values >= 0))
            if name == "gain":
                bad |= values == 0
            if bad.any():
                pixel = int(np.argmax(bad))
                above = "above 0" if name == "gain" else "0 or more"
                raise InputError(
                    f"{name} of pixel {pixel} in the map is {values[pixel]:g}, expected finite and {above}"
                )
            values.setflags(write=False)
            object.__setattr__(self, name, values)
            sizes.add(values.size)
        if len(sizes) != 1:
            raise InputError(f"the pixel map has columns of {sorted(sizes) or 'no'} pixels, expected one length")

    @property
    def size(self) -> int:
        """Pixels."""
        return next(int(v.size) for name in COLUMNS if (v := getattr(self, name)) is not None)

    @property
    def digest(self) -> str:
        """SHA-256 of the values."""
        hashed = hashlib.sha256()
        for name in COLUMNS:
            if (values := getattr(self, name)) is not None:
                hashed.update(name.encode() + values.tobytes())
        return hashed.hexdigest()

    def __repr__(self) -> str:
        # The instrument's digest is made of representations.
        return f"PixelMap({self.digest})"

    @classmethod
    def read(cls, path: str | Path) -> PixelMap:
        """Read an ECSV table: one row per pixel of the array, in order, some of the columns of `COLUMNS`.

        Raises
        ------
        InputError
            If the file is missing, is not such a table, or holds a value that cannot be.
        """
        table = read_numbers(path, "pixel map")
        unknown = [name for name in table.columns if name not in COLUMNS and name != "pixel"]
        if unknown or list(table.columns) in ([], ["pixel"]):
            what = f"the column {unknown[0]!r}" if unknown else "no column of values"
            raise InputError(f"pixel map {path} has {what}, expected some of {', '.join(COLUMNS)}")
        if "pixel" in table.columns and not np.array_equal(table["pixel"], np.arange(table["pixel"].size)):
            raise InputError(f"pixel map {path}: the column 'pixel' is not 0, 1, 2, ..., expected every pixel in order")
        values = {}
        for name in table.columns:
            if name == "pixel":
                continue
            unit = u.Unit(table.units[name], parse_strict="silent")
            if not unit.is_equivalent(COLUMNS[name]):
                wanted = str(COLUMNS[name]) or "none"
                raise InputError(f"pixel map {path}: {name} has the unit {str(unit) or 'none'!r}, expected {wanted}")
            values[name] = table[name]
        source = f"{table.meta.get('tag', 'A')}: {table.meta.get('source', f'assumed, no source in {Path(path).name}')}"
        try:
            return cls(**values, source=source)
        except InputError as error:
            raise InputError(f"pixel map {path}: {error}") from None

    @classmethod
    def made_up(
        cls,
        pixels: int,
        *,
        seed: int,
        response_rms: float = 0.03,
        dark_rms: float = 0.1,
        hot_share: float = 0.001,
        hot_dark: float = 10.0,
    ) -> PixelMap:
        """A map with assumed scatter, for pipelines that must meet one; no flight detector looks exactly so.

        Parameters
        ----------
        pixels : int
        seed : int
        response_rms, dark_rms : float
            Relative scatter, log-normal.
        hot_share, hot_dark : float
            Share of hot pixels, and the factor on their dark.
        """
        pixels, seed = count("pixels", pixels, low=1, high=MOST_PIXELS), count("seed", seed)
        generator = np.random.default_rng(seed)
        response = np.exp(generator.normal(0.0, response_rms, pixels) - response_rms**2 / 2)
        dark = np.exp(generator.normal(0.0, dark_rms, pixels) - dark_rms**2 / 2)
        dark[generator.random(pixels) < hot_share] *= hot_dark
        return cls(response=response, dark=dark, source=f"A: made up, seed {seed}")

    def write(self, path: str | Path) -> None:
        """Write the table that `read` reads."""
        from astropy.table import Table

        tag, source = self.source.split(": ", 1)
        table = Table({"pixel": np.arange(self.size)}, meta={"tag": tag, "source": source})
        for name, unit in COLUMNS.items():
            if (values := getattr(self, name)) is not None:
                table[name] = values
                table[name].unit = None if unit == u.dimensionless_unscaled else unit
        table.write(path, format="ascii.ecsv", overwrite=True)

    def _line(self) -> str:
        return f"of {self.size} pixels, {self.source}"

    def over(self, name: str, chosen: slice, nominal: float) -> Float:
        """One column over a range of pixels: the instrument's value times the factor, or what stands in its place."""
        values = getattr(self, name)
        size = len(range(*chosen.indices(self.size)))
        if values is None:
            return np.full(size, nominal)
        part = values[chosen]
        return np.asarray(part if COLUMNS[name] == u.DN else nominal * part)
