"""Instruments: optics, spectrograph, line spread and detector, in Python and in TOML files."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import astropy.units as u
import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, ConfigDict, Field
from pydantic_core import PydanticCustomError
from scipy.special import ndtr

from mauvecl.host.arrays import Float
from mauvecl.host.instrument import FORMERLY_MAUVE, instrument_path, shipped_names
from mauvecl.host.instrument.curves import MAX_PIXELS, PixelMap, SpectralCurve, ThroughputErrors
from mauvecl.host.tables.files import read_text, toml
from mauvecl.schema import fields
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.fields import Help, Range, Unit, whole_number, word_of
from mauvecl.schema.section import Section, built

if TYPE_CHECKING:
    from astropy.table import QTable


#: Tags of sources: paper, datasheet, computation, assumption, user.
TAGS = ("P", "D", "C", "A", "U")
#: Version of instrument files; files without one are of version 1.
FILE_VERSION = 2
#: Largest number of files of which each extends the next.
MAX_EXTENDED = 16


def _entry(name: str, entry: Any, path: Path) -> tuple[Any, str]:
    """Return value and source of an entry, which is a value or a table of value, tag and source.

    The source of a path is empty, since the file states it.
    """
    source = f"A: assumed, no source in {path.name}"
    if isinstance(entry, dict):
        unknown = [key for key in entry if key not in ("value", "tag", "source")]
        if unknown or "value" not in entry:
            fault = f"the unknown key {unknown[0]!r}" if unknown else "no 'value'"
            raise InputError(f"{path.name}: the table {name} has {fault}; use value, tag and source", key=name)
        tag = entry.get("tag", "A")
        if tag not in TAGS:
            raise InputError.of("tag", tag, f"one of {', '.join(TAGS)}", where=f"{path.name}, {name}")
        source = f"{tag}: {entry.get('source', f'no source in {path.name}')}"
        entry = entry["value"]
    return (path.parent / entry, "") if name in PATHS and isinstance(entry, str) else (entry, source)


#: Energy of a photon times its wavelength, J nm, and the charge of an electron, C (exact SI values).
HC_J_NM = 6.62607015e-34 * 299_792_458.0 * 1e9
ELECTRON_C = 1.602176634e-19


def _as_curve(value: Any, unit: str) -> Any:
    """Convert a path, or one number or Quantity for all wavelengths, to a curve."""
    try:
        plain = Unit(unit).plain(value)
    except ValueError:
        expected = f"a curve, a path or {word_of(unit)}"
        raise PydanticCustomError("expected", "Input should be {expected}", {"expected": expected}) from None
    if isinstance(plain, int | float) and not isinstance(plain, bool):
        return SpectralCurve.flat(float(plain))
    return _read_path(plain, SpectralCurve)


def _read_path(value: Any, kind: type[SpectralCurve | PixelMap | ThroughputErrors]) -> Any:
    """Read a path as an object of a class; return other values unchanged."""
    return kind.read(value) if isinstance(value, str | Path) else value


Efficiency = Annotated[SpectralCurve, BeforeValidator(partial(_as_curve, unit=""))]
Responsivity = Annotated[SpectralCurve, BeforeValidator(partial(_as_curve, unit="A / W"))]
Loss = Annotated[float, Range(0, 1, open_high=True)]
Whole = Annotated[int, BeforeValidator(whole_number)]
Count = Annotated[Whole, Range(0, 20)]
#: Width of a line spread function; 0 for none.
Width = Annotated[float, Unit("nm"), Range(0, 500)]
Wavelengths = Annotated[ArrayLike, Unit("nm")]


@validated
class Instrument(Section):
    """A frozen description of an instrument, with units in the names.

    `Instrument.load` reads an instrument, and `with_` returns a changed copy. The values of the nominal payload, each
    with source and tag, are in `instruments/mauve.toml`; none is a flight calibration. The dark current is
    dark_scale_dn_per_s * exp(dark_slope_per_c * temperature_c). The line spread function is a top hat convolved with a
    Gaussian, either of which may have no width.

    Examples
    --------
    >>> from mauvecl import Instrument
    >>> mauve = Instrument.load("mauve")
    >>> round(mauve.dark_dn_per_s, 2), round(mauve.with_(temperature_c=13.0).dark_dn_per_s, 2)
    (445.53, 257.77)
    >>> mauve.sources["light_loss"]
    'P: table of the payload performance'
    """

    model_config = ConfigDict(strict=True, arbitrary_types_allowed=True)

    name: Annotated[str, Field(min_length=1), Help("Name")]
    notice: Annotated[str, Help("Remark on the values that every report repeats")]
    sources: Annotated[
        dict[str, str],
        Field(repr=False),
        Help("Tag and source of each value by name", "P paper, D datasheet, C computed, A assumption, U user"),
    ] = Field(default_factory=dict)

    collecting_area_cm2: Annotated[fields.Positive, Unit("cm2"), Help("Collecting area")]
    field_of_view_radius_arcsec: Annotated[fields.Positive, Unit("arcsec"), Help("Radius of the field of view")]
    pointing_loss: Annotated[Loss, Help("Fraction of the light that is lost by pointing")]

    grating_efficiency: Annotated[Efficiency, Help("Efficiency of the grating")]
    fibre_efficiency: Annotated[Efficiency, Help("Efficiency of the fibre")]
    telescope_mirror_reflectivity: Annotated[Efficiency, Help("Reflectivity of a mirror of the telescope")]
    telescope_mirrors: Annotated[Count, Help("Number of mirrors of the telescope")]
    spectrometer_mirror_reflectivity: Annotated[Efficiency, Help("Reflectivity of a mirror of the spectrometer")]
    spectrometer_mirrors: Annotated[Count, Help("Number of mirrors of the spectrometer")]
    collection_lens_efficiency: Annotated[Efficiency, Help("Efficiency of the collection lens")]
    window_efficiency: Annotated[Efficiency, Help("Efficiency of the detector's window")]
    coupling_loss: Annotated[Loss, Help("Fraction of the light that is lost at a coupling")]
    couplings: Annotated[Count, Help("Number of couplings")]
    light_loss: Annotated[Loss, Help("Fraction of the light that is lost elsewhere")]

    pixels: Annotated[Whole, Range(1, MAX_PIXELS), Help("Number of pixels")]
    pixel_zero_nm: Annotated[float, Unit("nm"), Range(), Help("Wavelength of the centre of pixel 0")]
    dispersion_nm_per_pixel: Annotated[fields.Positive, Unit("nm / pix"), Help("Linear dispersion")]
    output_min_nm: Annotated[fields.Wavelength, Help("Smallest wavelength of the centre of a pixel that is read")]
    output_max_nm: Annotated[fields.Wavelength, Help("Largest wavelength of the centre of a pixel that is read")]
    top_hat_width_nm: Annotated[Width, Help("Full width of the top hat of the line spread function")]
    gaussian_fwhm_nm: Annotated[Width, Help("Full width at half maximum of its Gaussian")]
    resolution_element_nm: Annotated[fields.Wavelength, Help("Width of a resolution element")]

    quantum_efficiency_a_per_w: Annotated[Responsivity, Help("Responsivity of the detector, A/W")]
    conversion_uv_per_electron: Annotated[fields.Positive, Unit("uV / electron"), Help("Voltage per electron")]
    adc_bits: Annotated[Whole, Range(1, 24), Help("Bits of the converter")]
    adc_range_v: Annotated[fields.Positive, Unit("V"), Help("Voltage of the converter's full range")]
    saturation_v: Annotated[fields.Positive, Unit("V"), Help("Voltage at which the detector saturates")]
    temperature_c: Annotated[fields.DetectorTemperature, Help("Temperature of the detector")]
    dark_scale_dn_per_s: Annotated[fields.NotNegative, Unit("DN / s"), Help("Dark current at 0 deg C")]
    dark_slope_per_c: Annotated[
        float, Unit("1 / K"), Range(-1, 1), Help("Relative change of the dark current per degree")
    ]
    dark_unit: Annotated[
        Literal["DN", "electrons"], Help("Unit in which the dark counts follow a Poisson distribution")
    ]
    photon_noise: Annotated[Literal["gaussian", "poisson"], Help("Distribution of the photons about their mean")] = (
        "gaussian"
    )
    read_noise_dn: Annotated[fields.NotNegative, Unit("DN"), Help("Read noise of a frame")]
    bias_dn: Annotated[fields.NotNegative, Unit("DN"), Help("Bias")]
    frame_s: Annotated[fields.Exposure, Help("Length of a frame")]
    pixel_map: Annotated[
        PixelMap | None,
        BeforeValidator(partial(_read_path, kind=PixelMap)),
        Help("Deviations of single pixels from these values"),
    ] = None
    throughput_factor: Annotated[
        Efficiency | None,
        Help("Calibrated throughput over that of the curves and losses above, with the end values beyond its knots"),
    ] = None
    throughput_errors: Annotated[
        ThroughputErrors | None,
        BeforeValidator(partial(_read_path, kind=ThroughputErrors)),
        Help("Uncertainty of the calibrated throughput"),
    ] = None
    throughput_amplitudes: Annotated[
        tuple[fields.Number, ...],
        Help("Amplitudes of the first modes of `throughput_errors`, by which the throughput is not the calibrated"),
    ] = ()

    @classmethod
    def load(cls, name: str | Path) -> Instrument:
        """Read an embedded instrument ("mauve", or "mauvesim" with the conventions of the paper) or a TOML file.

        Paths of curves are relative to the file. With `version = 2` and `extends = "mauve"` the file gives only the
        values that differ.
        """
        # Embedded files do not change during a run; a user's file may.
        return _embedded(name) if name in shipped_names() else _from_file(name)

    @classmethod
    def build(cls, values: dict[str, Any], where: str) -> Instrument:
        """Validate values by name; error messages begin with `where`, such as a file name."""
        return built(cls, values, where)

    def with_(self, **changes: Any) -> Instrument:
        """Return a copy with changed values, each marked as the user's in `sources`.

        Values are Quantities, or plain numbers in the unit of the name. A curve may be a `Curve`, a path or one number.
        """
        changed = Instrument.build({**self._values(), **changes}, self.name)
        marks = {name: "U: set by the user" for name in changes if name not in LABELS}
        for name, value in changes.items():
            if isinstance(value, str | Path) and isinstance(curve := getattr(changed, name), SpectralCurve):
                marks[name] = curve.source
        sources = {**self.sources, **changes.get("sources", {}), **marks}
        return changed.model_copy(update={"sources": sources})

    def _values(self) -> dict[str, Any]:
        # Iterating over the instrument would yield its cached properties as well.
        return {name: getattr(self, name) for name in type(self).model_fields}

    def _check_values(self) -> None:
        low, high = self.output_min_nm, self.output_max_nm
        if not high > low:
            raise InputError.of("output_max_nm", high, f"more than output_min_nm = {low:g}")
        if self.wavelength_nm.size == 0:
            fault = f"the output range {low:g}-{high:g} nm needs at least one pixel, but contains none"
            raise InputError(fault, key="output_min_nm")
        self._check_curves(low, high)
        if self.top_hat_width_nm == self.gaussian_fwhm_nm == 0:
            fault = "top_hat_width_nm and gaussian_fwhm_nm are both 0, but at least one of them must be above 0"
            raise InputError(fault, key="top_hat_width_nm")
        for name in ("top_hat_width_nm", "gaussian_fwhm_nm"):
            # A width far below a pixel has no effect, but costs time and digits.
            if 0 < getattr(self, name) < 0.1:
                raise InputError.of(name, getattr(self, name), "0 (none) or at least 0.1")
        if self.resolution_element_nm < self.dispersion_nm_per_pixel:
            expected = f"at least a pixel ({self.dispersion_nm_per_pixel:g})"
            raise InputError.of("resolution_element_nm", self.resolution_element_nm, expected)
        if self.bias_dn >= min(self.saturation_dn, self.adc_max_dn):
            raise InputError.of("bias_dn", self.bias_dn, "below saturation")
        if self.pixel_map is not None and self.pixel_map.size != self.pixels:
            fault = f"pixel_map must have the array's {self.pixels} pixels, not {self.pixel_map.size}"
            raise InputError(fault, key="pixel_map")
        modes = 0 if self.throughput_errors is None else len(self.throughput_errors.modes)
        if (amplitudes := len(self.throughput_amplitudes)) > modes:
            raise InputError.of("throughput_amplitudes", amplitudes, f"at most {modes}, one for each mode")
        if not (self.throughput(self.wavelength_nm) * self.per_pixel("response", 1.0) > 0).any():
            dark = [name for name in CURVES if not (getattr(self, name).at(self.wavelength_nm) > 0).any()]
            fault = f"{' and '.join(dark) or 'the throughput'} = 0 from {low:g} to {high:g} nm, and all S/N are 0"
            raise InputError(f"some pixel must have a throughput above 0, but {fault}", key="throughput")

    def _check_curves(self, low: float, high: float) -> None:
        """Raise InputError unless all curves cover the output range with possible values."""
        for name in OPTICS:
            largest = max(getattr(self, name).value)
            if largest > 1:
                raise InputError.of(name, largest, "a fraction between 0 and 1")
        for name in CURVES:
            curve: SpectralCurve = getattr(self, name)
            first, last = curve.wavelength_nm[0], curve.wavelength_nm[-1]
            if len(curve.value) > 1 and (first > low or last < high):
                needed = f"at least the output range {low:g}-{high:g} nm"
                raise InputError(f"{name} must cover {needed}, but covers {first:g}-{last:g} nm", key=name)
        if (most := float(self.quantum_efficiency(self.wavelength_nm).max())) > 1:
            fault = f"quantum_efficiency_a_per_w must correspond to at most 1 electron per photon, not {most:.3g}"
            raise InputError(fault, key="quantum_efficiency_a_per_w")

    @cached_property
    def wavelength_nm(self) -> Float:
        """Centres of the pixels that are read, nm, shape (n_pixel,)."""
        chosen = self._centres_nm[self.read_pixels].copy()
        chosen.setflags(write=False)
        return chosen

    @property
    def _centres_nm(self) -> Float:
        return np.asarray(self.pixel_zero_nm + self.dispersion_nm_per_pixel * np.arange(self.pixels), np.float64)

    @cached_property
    def read_pixels(self) -> slice:
        """Range of the array's pixels whose centres lie in the output range."""
        inside = np.flatnonzero((self._centres_nm >= self.output_min_nm) & (self._centres_nm <= self.output_max_nm))
        return slice(int(inside[0]), int(inside[-1]) + 1) if inside.size else slice(0, 0)

    def per_pixel(self, name: str, nominal: float) -> Float:
        """Return a column of the pixel map over the pixels that are read, or `nominal` in each; shape (n_pixel,)."""
        if self.pixel_map is None:
            return np.full(self.wavelength_nm.size, nominal)
        return self.pixel_map.over(name, self.read_pixels, nominal)

    @property
    def knots_nm(self) -> tuple[float, ...]:
        """Wavelengths at which the slope of a curve may jump, nm."""
        curves = [getattr(self, name) for name in CURVES]
        curves += [] if self.throughput_factor is None else [self.throughput_factor]
        return tuple(sorted({knot for curve in curves if len(curve.value) > 1 for knot in curve.wavelength_nm}))

    @property
    def _dn_v(self) -> float:
        """Voltage of one DN, V."""
        return float(self.adc_range_v / 2**self.adc_bits)

    @property
    def gain_dn_per_electron(self) -> float:
        """Gain, DN per electron: charge conversion divided by the voltage of one DN."""
        return self.conversion_uv_per_electron * 1e-6 / self._dn_v

    @property
    def adc_max_dn(self) -> int:
        """Largest output of the ADC, DN."""
        return int(2**self.adc_bits - 1)

    @property
    def saturation_dn(self) -> float:
        """Raw level at which the detector saturates, DN."""
        return self.saturation_v / self._dn_v

    @property
    def dark_dn_per_s(self) -> float:
        """Dark current at the detector's temperature, DN/s."""
        return float(self.dark_scale_dn_per_s * np.exp(self.dark_slope_per_c * self.temperature_c))

    @property
    def field_of_view_arcsec2(self) -> float:
        """Solid angle of the field of view, arcsec^2."""
        return float(np.pi * self.field_of_view_radius_arcsec**2)

    @cached_property
    def curves_nm(self) -> tuple[float, float]:
        """Range in which every curve has values, nm; flat curves have no ends."""
        curves = [curve for name in CURVES if len((curve := getattr(self, name)).value) > 1]
        first = max((curve.wavelength_nm[0] for curve in curves), default=self.output_min_nm)
        last = min((curve.wavelength_nm[-1] for curve in curves), default=self.output_max_nm)
        return first, last

    def _in_range(self, wavelength_nm: ArrayLike, held: bool = False) -> Float:
        """Return wavelengths as an array; raise InputError outside the curves, or if `held` for impossible ones."""
        low, high = (0.0, np.inf) if held else self.curves_nm
        nm = np.asarray(wavelength_nm, np.float64)
        outside = ~((nm >= low) & (nm <= high) & np.isfinite(nm))
        if outside.any():
            raise InputError.of("wavelength_nm", float(nm[outside][0]), Range(low, high).words("nm"), unit="nm")
        return nm

    def efficiency(self, wavelength_nm: Wavelengths) -> Float:
        """Return the fraction of the light that reaches the detector, without the quantum efficiency.

        This is the paper's efficiency times (1 - pointing_loss), in the shape of the wavelengths, a Quantity or numbers
        in nm. Raises InputError outside the curves (`curves_nm`).
        """
        return self._optics(self._in_range(wavelength_nm))

    def _optics(self, wavelength_nm: Float) -> Float:
        losses = (1 - self.coupling_loss) ** self.couplings * (1 - self.light_loss) * (1 - self.pointing_loss)
        calibration = 1.0 if self.throughput_factor is None else self.throughput_factor.at(wavelength_nm)
        if self.throughput_errors is not None and self.throughput_amplitudes:
            modes = self.throughput_errors.at(wavelength_nm)[: len(self.throughput_amplitudes)]
            calibration = calibration * np.exp(np.tensordot(self.throughput_amplitudes, modes, 1))
        return np.asarray(
            losses
            * self.grating_efficiency.at(wavelength_nm)
            * self.fibre_efficiency.at(wavelength_nm)
            * self.telescope_mirror_reflectivity.at(wavelength_nm) ** self.telescope_mirrors
            * self.spectrometer_mirror_reflectivity.at(wavelength_nm) ** self.spectrometer_mirrors
            * self.collection_lens_efficiency.at(wavelength_nm)
            * self.window_efficiency.at(wavelength_nm)
            * calibration
        )

    def quantum_efficiency(self, wavelength_nm: Wavelengths) -> Float:
        """Return the electrons per photon that reaches the detector.

        This is the sensitivity in A/W times the photon's energy divided by the electron's charge. Parameters and errors
        as for `efficiency`.
        """
        nm = self._in_range(wavelength_nm)
        return np.asarray(self.quantum_efficiency_a_per_w.at(nm) * (HC_J_NM / nm) / ELECTRON_C)

    def throughput(self, wavelength_nm: Wavelengths) -> Float:
        """Return the end-to-end throughput, electrons per photon, including the quantum efficiency.

        Wavelengths and errors as for `efficiency`.

        Examples
        --------
        >>> import astropy.units as u
        >>> from mauvecl import Instrument
        >>> mauve = Instrument.load("mauve")
        >>> float(mauve.throughput(300).round(3)), float(mauve.throughput(0.3 * u.um).round(3))
        (0.133, 0.133)
        """
        return self.efficiency(wavelength_nm) * self.quantum_efficiency(wavelength_nm)

    def effective_area_cm2(self, wavelength_nm: Wavelengths) -> Float:
        """Return the effective area, cm^2: collecting area times throughput.

        Wavelengths and errors as for `efficiency`.
        """
        return self.collecting_area_cm2 * self.throughput(wavelength_nm)

    def electrons_per_joule_cm2(self, wavelength_nm: Wavelengths, *, held: bool = False) -> Float:
        """Return the electrons per fluence at the telescope, e- / (J cm^-2): area * efficiency * QE[A/W] / e.

        Wavelengths and errors as for `efficiency`; if `held`, curves keep their end values beyond their ends (an
        assumption) instead of raising InputError.
        """
        nm = self._in_range(wavelength_nm, held)
        per_joule = self._optics(nm) * self.quantum_efficiency_a_per_w.at(nm) / ELECTRON_C
        return self.collecting_area_cm2 * per_joule

    @property
    def table(self) -> QTable:
        """Wavelength, throughput and effective area of each pixel that is read, with units."""
        from astropy.table import QTable

        table = QTable({"wavelength": self.wavelength_nm * u.nm, "throughput": self.throughput(self.wavelength_nm)})
        table["effective_area"] = self.effective_area_cm2(self.wavelength_nm) * u.cm**2
        table.meta |= {"name": self.name, "notice": self.notice}
        return table

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all values that affect a measurement, so without names and sources."""
        values = {
            name: (value.wavelength_nm, value.value) if isinstance(value, SpectralCurve) else value
            for name, value in self._values().items()
            # Files without a calibration keep the digest that they had before calibrations were added.
            if name not in LABELS and not (name.startswith("throughput_") and not value)
        }
        return hashlib.sha256(repr(sorted(values.items())).encode()).hexdigest()

    def __repr__(self) -> str:
        low, high, pixels = self.output_min_nm, self.output_max_nm, self.wavelength_nm.size
        return f"<Instrument {self.name!r}, {pixels} pixels at {low:g}-{high:g} nm, {self.temperature_c:g} deg C>"

    __str__ = __repr__

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Instrument) and self.digest == other.digest


def _from_file(name: str | Path) -> Instrument:
    """Read a file, whose values and sources have precedence over those of the file that it extends."""
    path = file = instrument_path(name, Path())
    entries: dict[str, tuple[Any, str]] = {}
    for _ in range(MAX_EXTENDED):
        content = toml(read_text(path, "instrument file"), f"instrument file {shortened(str(path))}")
        version, extended = content.pop("version", None), content.pop("extends", None)
        if version not in (None, FILE_VERSION):
            raise InputError.of("version", version, f"{FILE_VERSION}, or none in files of version 1", where=path.name)
        if "sources" in content:
            fault = f"{path.name}: unknown key 'sources'; give each value's source in the value's own table"
            raise InputError(fault, key="sources")
        entries = {name: _entry(name, entry, path) for name, entry in content.items()} | entries
        if extended is None:
            break
        if version is None and extended == "mauve":
            extended = FORMERLY_MAUVE
            warnings.warn(
                f"{path.name} is read as in version 1, in which mauve was the payload of the paper, now mauvesim; with "
                f"`version = {FILE_VERSION}` it extends the one that counts electrons.",
                stacklevel=2,
            )
        path = instrument_path(extended, path.parent)
    else:
        fault = f"{path.name} is extended by {MAX_EXTENDED} files one after another, or by itself; the chain must end"
        raise InputError(fault, key="extends")
    read = Instrument.build({name: value for name, (value, _) in entries.items()}, file.name)
    sources = {name: text or getattr(read, name).source for name, (_, text) in entries.items() if name not in LABELS}
    return read.model_copy(update={"sources": sources})


_embedded = cache(_from_file)

#: Fields that do not affect a measurement.
LABELS = ("name", "notice", "sources")
#: Names of the curves, and of those that are fractions.
CURVES = tuple(name for name, field in Instrument.model_fields.items() if field.annotation is SpectralCurve)
OPTICS = tuple(name for name in CURVES if name != "quantum_efficiency_a_per_w")
#: Values that instrument files may give as paths.
PATHS = (*CURVES, "throughput_factor", "pixel_map", "throughput_errors")


#: Cut-off of the Gaussian's tails, in sigma; less than 1e-15 lies beyond.
REACH_SIGMA = 8.0
#: Largest width of a panel in which a polynomial describes a pixel's fraction of a line, in sigma of the Gaussian.
PANEL_SIGMA = 0.5


@dataclass(frozen=True)
class LineSpread:
    """Line spread function, a top hat convolved with a Gaussian, and the pixels that sample it; all in nm."""

    centres: tuple[float, ...]  # of the pixels
    pixel: float  # width of a pixel
    top_hat: float  # full width of the top hat
    sigma: float  # of the Gaussian

    @classmethod
    def of(cls, instrument: Instrument) -> LineSpread:
        """Return the line spread function of an instrument."""
        return cls(
            tuple(instrument.wavelength_nm.tolist()),
            instrument.dispersion_nm_per_pixel,
            instrument.top_hat_width_nm,
            instrument.gaussian_fwhm_nm / np.sqrt(8 * np.log(2)),
        )

    @property
    def reach(self) -> float:
        """Largest distance of a line from a pixel's centre at which light reaches the pixel."""
        return (self.top_hat + self.pixel) / 2 + REACH_SIGMA * self.sigma

    def landing(self, offset_nm: Float) -> Float:
        """Return the fraction of a line's light that falls on a pixel whose centre is `offset_nm` from the line."""
        # The function is even; on the left of the line no digits cancel.
        x = -np.abs(offset_nm)
        half = self.pixel / 2
        return np.asarray(self.below(x + half) - self.below(x - half))

    def below(self, x: Float) -> Float:
        """Return the fraction of a line's light that falls below x."""
        if self.top_hat == 0:
            return np.asarray(ndtr(x / self.sigma))
        half = self.top_hat / 2
        return (self._ramp(x + half) - self._ramp(x - half)) / self.top_hat

    def _ramp(self, x: Float) -> Float:
        """Integrate the Gaussian's distribution function from minus infinity to x."""
        if self.sigma == 0:
            return np.maximum(x, 0.0)
        z = x / self.sigma
        return np.asarray(self.sigma * (z * ndtr(z) + np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)))

    def panel_edges(self, knots: Float) -> Float:
        """Return the edges of panels, also at `knots`, in which each pixel's `landing` is smooth, (n_panel + 1,)."""
        low, high = self.centres[0] - self.reach, self.centres[-1] + self.reach
        corners = [np.array([low, high]), knots[(knots > low) & (knots < high)]]
        if self.sigma > 0:
            corners.append(np.linspace(low, high, int(np.ceil((high - low) / (PANEL_SIGMA * self.sigma))) + 1))
        else:
            # Without a Gaussian `landing` is a trapezoid, linear between these corners.
            ends = np.append(np.asarray(self.centres) - self.pixel / 2, self.centres[-1] + self.pixel / 2)
            corners += [ends - self.top_hat / 2, ends + self.top_hat / 2]
        edges = np.unique(np.concatenate(corners))
        # Knots that differ only by rounding would make empty panels.
        distinct: Float = edges[np.append(True, np.diff(edges) > 1e-9)]
        return distinct
