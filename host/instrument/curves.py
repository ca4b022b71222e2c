"""Curves of an instrument against wavelength, maps of its pixels, and the uncertainty of its calibration."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import astropy.units as u
import numpy as np
from numpy.typing import ArrayLike

from mauvecl.host.arrays import ContentEquality, Float, set_read_only
from mauvecl.host.tables.files import Numbers, parse_numbers, text_and_label
from mauvecl.host.tables.units import unit_of
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range, Unit


@contextmanager
def _opened(path: str | Path, title: str) -> Iterator[tuple[Numbers, str]]:
    """Read an ECSV table of numbers, and the origin of its values, "tag: source", from its metadata.

    Errors that are raised in the block begin with the name of the file.
    """
    table = parse_numbers(*text_and_label(path, title))
    source = table.meta.get("source", f"assumed, no source in {Path(path).name}")
    try:
        yield table, f"{table.meta.get('tag', 'A')}: {source}"
    except InputError as error:
        raise error.within(f"{title} {path}") from None


@dataclass(frozen=True)
class SpectralCurve:
    """A quantity against wavelength, linear between knots."""

    wavelength_nm: tuple[float, ...]  # knots, strictly increasing; a single knot makes the curve flat
    value: tuple[float, ...]  # at each knot, >= 0: a fraction, or A/W for a quantum efficiency
    source: str = "A: assumed, no source given"  # "tag: source" of the values

    def __post_init__(self) -> None:
        wavelength, value = np.asarray(self.wavelength_nm, np.float64), np.asarray(self.value, np.float64)
        if wavelength.ndim != 1 or wavelength.size == 0 or wavelength.shape != value.shape:
            sizes = f"{wavelength.size} wavelengths and {value.size} values"
            raise InputError(f"the curve needs one value per wavelength, but has {sizes}", key="value")
        if not (np.isfinite(wavelength).all() and (np.diff(wavelength) > 0).all()):
            raise InputError("the wavelengths of the curve must be finite and strictly increasing", key="wavelength_nm")
        bad = ~(np.isfinite(value) & (value >= 0))
        if bad.any():
            where = f"curve at {wavelength[bad][0]:g} nm"
            raise InputError.of("value", value[bad][0], "finite and at least 0", where=where)

    @classmethod
    def flat(cls, value: float) -> SpectralCurve:
        """Return a curve with the same value at every wavelength."""
        return cls((0.0,), (value,))

    @classmethod
    def read(cls, path: str | Path) -> SpectralCurve:
        """Read an ECSV table of two columns with units: wavelength, and the value (A/W, per cent or dimensionless).

        The table's metadata give the values' origin: `tag` (P, D, C or A) and `source`. Raises InputError if the file
        is missing or is not such a table.
        """
        with _opened(path, "curve file") as (table, source):
            if "wavelength" not in table.columns or len(table.columns) != 2:
                fault = f"the columns must be 'wavelength' and one value, not {', '.join(table.columns)}"
                raise InputError(fault, key="columns")
            (name,) = {*table.columns} - {"wavelength"}
            wavelength = _converted(table, "wavelength", u.nm)
            value = _converted(table, name, u.A / u.W, u.dimensionless_unscaled)
            return cls(tuple(wavelength.tolist()), tuple(value.tolist()), source)

    def at(self, wavelength_nm: ArrayLike) -> Float:
        """Return the values at wavelengths in nm, shape of `wavelength_nm`; the end values hold beyond the knots."""
        return np.asarray(np.interp(np.asarray(wavelength_nm, np.float64), self.wavelength_nm, self.value))


def _converted(table: Numbers, name: str, *units: u.UnitBase) -> Float:
    """Return a column's numbers in the first of `units` that its unit converts to."""
    text = table.units[name]
    # A is ampere, except in a length.
    unit = unit_of(text) if text and units == (u.nm,) else u.Unit(text.replace("percent", "%"), parse_strict="silent")
    for target in units:
        if unit.is_equivalent(target):
            return np.asarray((table[name] * unit).to_value(target))
    expected = str(units[0]) or "none"
    raise InputError(f"the unit of column {name!r} must be {expected}, not {str(unit) or 'none'!r}", key=name)


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
    """Properties of each pixel of the whole array, shape (n_pixel,) each; None keeps the instrument's value."""

    response: Float | None = None  #: Factor on the electrons per photon.
    dark: Float | None = None  #: Factor on the dark current; a hot pixel has a large one.
    gain: Float | None = None  #: Factor on the DN per electron.
    bias_dn: Annotated[Float, Unit("DN")] | None = None  #: Replaces the instrument's value.
    read_noise_dn: Annotated[Float, Unit("DN")] | None = None  #: Replaces the instrument's value; rms per frame.
    source: str = "A: assumed, no source given"  #: Tag and source of the values.

    def __post_init__(self) -> None:
        sizes = set()
        for name in COLUMNS:
            if getattr(self, name) is None:
                continue
            values = np.asarray(getattr(self, name), np.float64)
            if values.ndim != 1:
                fault = f"{name} of the pixel map must have one value per pixel, not the shape {values.shape}"
                raise InputError(fault, key=name)
            bad = ~(np.isfinite(values) & (values > 0 if name == "gain" else values >= 0))
            if bad.any():
                pixel, above = int(np.argmax(bad)), "above 0" if name == "gain" else "0 or more"
                raise InputError.of(name, values[pixel], f"finite and {above}", where=f"pixel map, pixel {pixel}")
            set_read_only(self, **{name: values})
            sizes.add(values.size)
        if len(sizes) != 1:
            fault = f"the columns of the pixel map must have the same length, but have {sorted(sizes) or 'no'} pixels"
            raise InputError(fault, key="pixel_map")

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
        with _opened(path, "pixel map") as (table, source):
            names = [name for name in table.columns if name != "pixel"]
            unknown = [name for name in names if name not in COLUMNS]
            if unknown or not names:
                fault = f"the column {unknown[0]!r}" if unknown else "no column of values"
                raise InputError(f"the table has {fault}; use some of {', '.join(COLUMNS)}", key="pixel_map")
            if "pixel" in table.columns and not np.array_equal(table["pixel"], np.arange(table["pixel"].size)):
                raise InputError("the column 'pixel' must be 0, 1, 2, ..., every pixel in order", key="pixel")
            return cls(**{name: _converted(table, name, COLUMNS[name]) for name in names}, source=source)

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

        Response and dark have a relative scatter, log-normal. `hot_share` is the fraction of hot pixels, and `hot_dark`
        the factor on their dark current.
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

    def over(self, name: str, chosen: slice, nominal: float) -> Float:
        """Return a column over a range of pixels: factors times `nominal`, or the values that replace it."""
        if (values := getattr(self, name)) is None:
            return np.full(len(range(*chosen.indices(self.size))), nominal)
        return np.asarray(values[chosen] if COLUMNS[name] == u.DN else nominal * values[chosen])


#: Share of the variances of a covariance that is lost by leaving out the smallest modes.
LOST_VARIANCE = 1e-4
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
    """Covariance of the logarithm of the throughput: the sum of the outer products of modes."""

    #: Ascending, shape (n,); modes are linear between these wavelengths and constant beyond them.
    wavelength_nm: Annotated[Float, Unit("nm")]
    #: Changes of the natural logarithm of the throughput for amplitudes of one standard deviation, shape (n_mode, n);
    #: those that matter most first.
    modes: Float
    source: str = "A: assumed, no source given"  #: Tag and source of the values.
    #: Changes of the natural logarithm of other values in the first modes, by name: `CALIBRATED`. Counts determine the
    #: product of gain and throughput, for instance, so that an error of the gain changes both.
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        nm, modes = np.asarray(self.wavelength_nm, np.float64), np.asarray(self.modes, np.float64)
        if nm.ndim != 1 or nm.size < 2 or not np.isfinite(nm).all() or not (np.diff(nm) > 0).all():
            raise InputError.of("wavelength_nm", nm.shape, "at least two finite, ascending wavelengths")
        if modes.ndim != 2 or modes.shape[1] != nm.size or not np.isfinite(modes).all():
            raise InputError.of("modes", modes.shape, f"finite values of the shape (n_mode, {nm.size})")
        set_read_only(self, wavelength_nm=nm, modes=modes)
        if not set(self.values) <= set(CALIBRATED):
            raise InputError.of("values", self.values, f"some of {', '.join(CALIBRATED)}")
        for name, changes in self.values.items():
            if len(changes) > len(modes) or not np.isfinite(changes).all():
                expected = f"at most {len(modes)} finite numbers, one for each mode"
                raise InputError.of(f"values.{name}", changes, expected)

    @classmethod
    def of_covariance(
        cls, wavelength_nm: Float, covariance: Float, source: str, *, names: Sequence[str], sums: Float
    ) -> ThroughputErrors:
        """Return the modes of a covariance of log throughput and of the logarithms of other values.

        The covariance has the shape (n + n_name, n + n_name) for n wavelengths and the names of the other values. The
        first modes contain all errors of weighted sums of the curve, (n_sum, n), such as the light in bands, and of
        these values.
        """
        n, sd = wavelength_nm.size, np.sqrt(np.diag(covariance))
        scale = np.where(sd > 0, sd, 1.0)
        variances, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
        variances, vectors = np.maximum(variances[::-1], 0.0), vectors[:, ::-1]
        lost = 1.0 - np.cumsum(variances) / max(variances.sum(), np.finfo(float).tiny)
        n_modes = int((lost > LOST_VARIANCE).sum()) + 1
        modes = scale[:, None] * (vectors * np.sqrt(variances))[:, :n_modes]
        first = np.vstack([sums @ modes[:n], modes[n:] / scale[n:, None]])
        # Any rotation of the modes has the same covariance.
        modes = modes @ np.linalg.svd(first)[2].T
        values = {name: tuple(row[: len(first)]) for name, row in zip(names, modes[n:], strict=True) if row.any()}
        return cls(wavelength_nm, modes[:n].T, source, values)

    @classmethod
    def read(cls, path: str | Path) -> ThroughputErrors:
        """Read an ECSV table with the columns wavelength (nm) and mode_1, mode_2 and so on."""
        with _opened(path, "throughput errors") as (table, source):
            names = [name for name in table.columns if name.startswith(MODE)]
            if "wavelength" not in table.columns or not names or len(names) + 1 != len(table.columns):
                fault = f"the columns must be wavelength, {MODE}1, {MODE}2 and so on, not {', '.join(table.columns)}"
                raise InputError(fault, key="columns")
            if table.units["wavelength"] != "nm":
                raise InputError.of("unit", table.units["wavelength"], "nm")
            modes = np.array([table[name] for name in names])
            return cls(table["wavelength"], modes, source, table.meta.get("values", {}))

    @property
    def digest(self) -> str:
        """SHA-256 of the values."""
        values = repr(sorted(self.values.items())).encode() if self.values else b""
        return hashlib.sha256(self.wavelength_nm.tobytes() + self.modes.tobytes() + values).hexdigest()

    def __repr__(self) -> str:
        # The instrument's digest is computed from representations.
        return f"ThroughputErrors({self.digest})"

    def at(self, wavelength_nm: ArrayLike) -> Float:
        """Return the modes at wavelengths in nm, shape (n_mode, ...) with that of `wavelength_nm`."""
        nm = np.asarray(wavelength_nm, np.float64)
        return np.array([np.interp(nm, self.wavelength_nm, mode) for mode in self.modes]).reshape(-1, *nm.shape)

    def sd(self, wavelength_nm: ArrayLike) -> Float:
        """Return the standard deviation of the logarithm of the throughput, shape of `wavelength_nm`."""
        return np.asarray(np.sqrt((self.at(wavelength_nm) ** 2).sum(axis=0)))
