"""Pixel maps of a detector: dark, response, gain, bias and read noise, including hot pixels."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import astropy.units as u
import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit

from ..content_equality import ContentEquality
from ..tables.ecsv import read_numbers

Float = NDArray[np.float64]

#: Largest number of pixels of an array.
MAX_PIXELS = 65_536
#: Columns of a map and their units. Dimensionless ones are factors on the instrument's value, others replace it.
COLUMNS = {
    "response": u.dimensionless_unscaled,
    "dark": u.dimensionless_unscaled,
    "gain": u.dimensionless_unscaled,
    "bias_dn": u.DN,
    "read_noise_dn": u.DN,
}


@validated
@dataclass(frozen=True, eq=False)
class PixelMap(ContentEquality):
    """Properties of each pixel of the whole array; None keeps the instrument's value.

    Attributes
    ----------
    response, dark, gain : ndarray, shape (n_pixel,), optional
        Factors on the electrons per photon, the dark current and the DN per electron. A hot pixel has a large factor
        on its dark current.
    bias_dn, read_noise_dn : ndarray, shape (n_pixel,), optional
        DN and DN rms per frame, which replace the instrument's values.
    source : str
        "tag: source" of the values.
    """

    response: Float | None = None
    dark: Float | None = None
    gain: Float | None = None
    bias_dn: Annotated[Float, Unit("DN")] | None = None
    read_noise_dn: Annotated[Float, Unit("DN")] | None = None
    source: str = "A: assumed, no source given"

    def __post_init__(self) -> None:
        sizes = set()
        for name in COLUMNS:
            if getattr(self, name) is None:
                continue
            values = np.array(getattr(self, name), np.float64)
            if values.ndim != 1:
                raise InputError(
                    f"{name} of the pixel map has the shape {values.shape}",
                    "one value per pixel",
                    key=name,
                    value=values.shape,
                )
            bad = ~(np.isfinite(values) & (values >= 0))
            if name == "gain":
                bad |= values == 0
            if bad.any():
                pixel = int(np.argmax(bad))
                above = "above 0" if name == "gain" else "0 or more"
                raise InputError.of(name, values[pixel], f"finite and {above}", where=f"pixel map, pixel {pixel}")
            values.setflags(write=False)
            object.__setattr__(self, name, values)
            sizes.add(values.size)
        if len(sizes) != 1:
            raise InputError(
                f"the pixel map has columns of {sorted(sizes) or 'no'} pixels",
                "one length",
                key="pixel_map",
                value=sizes,
            )

    @property
    def size(self) -> int:
        """Number of pixels."""
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
        # The instrument's digest is computed from representations.
        return f"PixelMap({self.digest})"

    @classmethod
    def read(cls, path: str | Path) -> PixelMap:
        """Read an ECSV table with one row per pixel of the array, in order, and any of the columns of `COLUMNS`."""
        table = read_numbers(path, "pixel map")
        unknown = [name for name in table.columns if name not in COLUMNS and name != "pixel"]
        if unknown or list(table.columns) in ([], ["pixel"]):
            what = f"the column {unknown[0]!r}" if unknown else "no column of values"
            raise InputError(f"pixel map {path} has {what}", f"some of {', '.join(COLUMNS)}", key="pixel_map")
        if "pixel" in table.columns and not np.array_equal(table["pixel"], np.arange(table["pixel"].size)):
            raise InputError(
                f"pixel map {path}: the column 'pixel' is not 0, 1, 2, ...", "every pixel in order", key="pixel"
            )
        values = {}
        for name in table.columns:
            if name == "pixel":
                continue
            unit = u.Unit(table.units[name], parse_strict="silent")
            if not unit.is_equivalent(COLUMNS[name]):
                wanted = str(COLUMNS[name]) or "none"
                raise InputError(
                    f"pixel map {path}: {name} has the unit {str(unit) or 'none'!r}", wanted, key=name, value=unit
                )
            values[name] = table[name]
        source = f"{table.meta.get('tag', 'A')}: {table.meta.get('source', f'assumed, no source in {Path(path).name}')}"
        try:
            return cls(**values, source=source)
        except InputError as error:
            raise error.within(f"pixel map {path}") from None

    @classmethod
    def made_up(
        cls,
        pixels: Annotated[int, Range(1, MAX_PIXELS)],
        *,
        seed: Annotated[int, Range(0)],
        response_rms: Annotated[float, Range(0)] = 0.03,
        dark_rms: Annotated[float, Range(0)] = 0.1,
        hot_share: Annotated[float, Range(0, 1)] = 0.001,
        hot_dark: Annotated[float, Range(0)] = 10.0,
    ) -> PixelMap:
        """Draw a map with assumed scatter, to test pipelines; it describes no real detector.

        Parameters
        ----------
        pixels, seed : int
        response_rms, dark_rms : float
            Relative scatter, log-normal.
        hot_share, hot_dark : float
            Fraction of hot pixels, and the factor on their dark current.
        """
        generator = np.random.default_rng(seed)
        response = np.exp(generator.normal(0.0, response_rms, pixels) - response_rms**2 / 2)
        dark = np.exp(generator.normal(0.0, dark_rms, pixels) - dark_rms**2 / 2)
        dark[generator.random(pixels) < hot_share] *= hot_dark
        return cls(response=response, dark=dark, source=f"A: made up, seed {seed}")

    def write(self, path: str | Path) -> None:
        """Write an ECSV table for `read`."""
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
        """Return a column over a range of pixels: factors times `nominal`, or the values that replace it."""
        values = getattr(self, name)
        size = len(range(*chosen.indices(self.size)))
        if values is None:
            return np.full(size, nominal)
        part = values[chosen]
        return np.asarray(part if COLUMNS[name] == u.DN else nominal * part)
