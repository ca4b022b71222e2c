"""Means and noise of the pixels of an exposure, before anything is drawn."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import astropy.units as u
import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.host.arrays import Bool, ContentEquality, Float, set_read_only, true_runs
from mauvecl.host.exposure import DEFAULT_SKY
from mauvecl.host.exposure.background import Neighbours, Sky, check_level
from mauvecl.host.exposure.response import Order, electrons_per_second, negative_means_message
from mauvecl.host.instrument import DEFAULT_INSTRUMENT
from mauvecl.host.instrument.instrument import Instrument, LineSpread
from mauvecl.host.stars.source import Source, check_covers, listed_star
from mauvecl.host.stars.spectrum import continue_ends
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Column, Drawable, number, table_of
from mauvecl.schema.errors import InputError, Message, counted, missing_package
from mauvecl.schema.fields import Duration, Exposure, SkyBrightness, Unit

if TYPE_CHECKING:
    from astropy.table import QTable


#: Kinds of remarks on the throughput: of an instrument as published or assumed, and of one that `calibrate` has fitted.
THROUGHPUTS = ("nominal throughput", "calibrated throughput")
#: Distance of a mean below saturation, in standard deviations of a frame, beyond which saturation is neglected.
CUT_SIGMA = 8.0
#: Largest number of frames of an exposure: a day of 5 ms each, a thousandth of the payload's.
MAX_FRAMES = 2**24
#: Definition of the signal: the star alone ("net"), or the star and the zodiacal light, as in the MauveSim paper.
Signal = Literal["net", "paper"]

#: Origins of noise: name, heading and description of their columns.
ORIGINS = (
    ("source_photon", "source photons", "photon noise of the star, rms"),
    ("zodiacal_photon", "zodiacal photons", "photon noise of the zodiacal light, rms"),
    ("neighbour_photon", "neighbours' photons", "photon noise of neighbours in the fibre, rms"),
    ("dark", "dark", "noise of the dark current, rms"),
    ("read", "read", "read noise, rms"),
    ("total", "total", "all of them in quadrature, without the ADC's rounding"),
)
#: Columns of the table of noise by origin.
BUDGET_COLUMNS = (
    Column("wavelength", unit="nm", description="vacuum wavelength, the middle of the pixel or element", heading="nm",
           format=".1f"),
    *(Column(name, unit="DN", description=text, heading=title, format=number(".2f")) for name, title, text in ORIGINS),
)  # fmt: skip


@validated
@dataclass(frozen=True, eq=False)
class Expectation(Drawable, ContentEquality):
    """Means and noise per pixel of an exposure; the arrays are read-only and refer to a single frame.

    They have the shape (n_pixel,), apart from `element_wavelength_nm`.
    """

    wavelength_nm: Annotated[Float, Unit("nm")]  #: Centres of the pixels.
    source_electrons: Float  #: Mean electrons per frame.
    sky_electrons: Float  #: Mean electrons per frame of the sky.
    dark_dn: Annotated[Float, Unit("DN")]  #: Mean dark counts per frame, independent of `dark_unit`.
    #: Unit in which the dark counts follow a Poisson distribution; their mean in electrons is dark_dn / gain.
    dark_unit: Literal["DN", "electrons"]
    bias_dn: Annotated[Float, Unit("DN")]
    read_noise_dn: Annotated[Float, Unit("DN")]  #: Read noise per frame, rms.
    gain_dn_per_electron: Float
    n_frames: int
    frame_s: Duration  #: Length of a frame; the exposure is n_frames * frame_s.
    #: Index of each pixel's resolution element, ascending from 0: half-open bins from the start of the output range.
    element: NDArray[np.int32]
    #: Centres of the resolution elements, shape (n_element,); the last may hold fewer pixels.
    element_wavelength_nm: Annotated[Float, Unit("nm")]
    adc_max_dn: int
    saturation_dn: Annotated[float, Unit("DN")]  #: Raw level at which the detector saturates.
    name: str
    instrument: str
    #: Origin of all inputs: digests, order, sky, history of the source, requested exposure.
    provenance: Mapping[str, str]
    #: Distribution of the photons about their mean; the variance is the same.
    photon_noise: Literal["gaussian", "poisson"] = "gaussian"
    #: The instrument's values that priors may vary: temperature_c, dark_slope_per_c, light_loss and pointing_loss.
    conditions: Mapping[str, float] = field(default_factory=dict)
    messages: tuple[str, ...] = ()  #: Remarks for the user, saturation first.
    #: With ``net`` the signal is the star alone: the sky is subtracted like bias and dark, and only its noise remains.
    #: With ``paper`` it includes the zodiacal light, as in the MauveSim paper. The noise is the same.
    signal: Signal = "net"
    #: Mean electrons per frame of other stars in the fibre, zero by default. They are no signal: their mean is
    #: subtracted like that of the sky.
    neighbour_electrons: Float = field(default_factory=lambda: np.zeros(0))

    def to_specutils(self) -> Any:
        """Convert the exposure's mean signal and noise, DN, to a specutils Spectrum (needs the extra ``spectra``)."""
        try:
            from astropy.nddata import StdDevUncertainty
            from specutils import Spectrum
        except ImportError as error:
            raise missing_package("specutils", "a `Spectrum`", "spectra") from error
        return Spectrum(
            spectral_axis=self.wavelength_nm * u.nm,
            flux=self.signal_dn * u.adu,
            uncertainty=StdDevUncertainty(np.sqrt(self.variance_dn2)),
            mask=self.saturated,
            meta=dict(self.provenance),
        )

    @property
    def notice(self) -> Message:
        """The instrument's remark on its throughput, of the kind "nominal throughput" or "calibrated throughput"."""
        of_throughput = (text for text in self.messages if isinstance(text, Message) and text.kind in THROUGHPUTS)
        return next(of_throughput, Message(""))

    def _line(self) -> str:
        exposure = f"{self.exposure_s:g} s in {self.n_frames} frames of {self.wavelength_nm.size} pixels"
        return f"{self.name!r} on {self.instrument}, {exposure}"

    def _repr_html_(self) -> str:
        remarks = "".join(f"<br><small>{html.escape(text)}</small>" for text in self.messages)
        name, where = html.escape(self.name), html.escape(self.instrument)
        return (
            f"<b>{name}</b> on {where}, {self.exposure_s:g} s in {self.n_frames} frames: best "
            f"S/N {self.snr().max():.3g} per pixel, {self.snr_per_element().max():.3g} an element{remarks}"
        )

    def __post_init__(self) -> None:
        if not self.neighbour_electrons.size:
            object.__setattr__(self, "neighbour_electrons", np.zeros(self.wavelength_nm.shape))
        arrays = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        element = arrays.pop("element").astype(np.int32)
        element.setflags(write=False)
        object.__setattr__(self, "element", element)
        set_read_only(self, **arrays)
        n_pixel = self.wavelength_nm.shape
        for name in PER_PIXEL:
            values = getattr(self, name)
            if values.shape != n_pixel:
                raise ValueError(f"{name} must have the shape {n_pixel}, not {values.shape}")
            bad = ~((values >= 0) & (values <= MAX_PER_FRAME))
            if bad.any():
                pixel = int(np.argmax(bad))
                raise InputError.of(name, values[pixel], f"between 0 and {MAX_PER_FRAME:g}", where=f"pixel {pixel}")
        object.__setattr__(self, "provenance", dict(self.provenance))

    @property
    def table(self) -> QTable:
        """Wavelength, signal, noise (rms) and S/N of the exposure, one row per pixel, with units."""
        return self._table(self.wavelength_nm, self.signal_dn, self._noise_dn2, self.snr())

    @property
    def element_table(self) -> QTable:
        """The columns of `table`, one row per resolution element."""
        signal, variance = self.per_element(self.signal_dn), self.per_element(self._noise_dn2)
        return self._table(self.element_wavelength_nm, signal, variance, self.snr_per_element())

    def _table(self, wavelength_nm: Float, signal: Float, variance: Float, snr: Float) -> QTable:
        from astropy.table import QTable

        table = QTable({"wavelength": wavelength_nm * u.nm, "signal": signal * u.DN, "noise": np.sqrt(variance) * u.DN})
        table["snr"] = snr
        table["signal"].info.description = "mean signal: the star's" + (" and the sky's" * (self.signal == "paper"))
        table["noise"].info.description = "standard deviation, without the ADC's rounding"
        table.meta |= {"name": self.name, "instrument": self.instrument, "exposure_s": self.exposure_s}
        return table

    @property
    def exposure_s(self) -> float:
        """Length of the exposure, s."""
        return self.n_frames * self.frame_s

    @cached_property
    def net_source_dn(self) -> Float:
        """Mean signal of the source alone in the exposure, DN, shape (n_pixel,)."""
        return self.n_frames * self.gain_dn_per_electron * self.source_electrons

    @property
    def light_electrons(self) -> Float:
        """Mean electrons per frame of all light: source, neighbours and sky, shape (n_pixel,)."""
        return self.source_electrons + self.sky_electrons + self.neighbour_electrons

    @property
    def target_share(self) -> float:
        """Share of the source in the electrons of all stars in the fibre, 1 without neighbours."""
        source, neighbours = float(self.source_electrons.sum()), float(self.neighbour_electrons.sum())
        return source / (source + neighbours) if neighbours else 1.0

    @cached_property
    def light_dn(self) -> Float:
        """Mean signal of the exposure before saturation, source, neighbours and sky, DN, shape (n_pixel,)."""
        return self.n_frames * self.gain_dn_per_electron * self.light_electrons

    @cached_property
    def neighbour_dn(self) -> Float:
        """Mean signal of neighbours in the exposure, DN, shape (n_pixel,)."""
        return self.n_frames * self.gain_dn_per_electron * self.neighbour_electrons

    @cached_property
    def sky_dn(self) -> Float:
        """Mean signal of the sky in the exposure, DN, shape (n_pixel,)."""
        return self.n_frames * self.gain_dn_per_electron * self.sky_electrons

    @cached_property
    def recorded_light_dn(self) -> Float:
        """Mean recorded light of the exposure, DN: `light_dn` minus the loss by saturation."""
        return self.light_dn - self._cut[0]

    @cached_property
    def subtracted_dn(self) -> Float:
        """Mean of neighbours and, unless it counts as signal, of the sky, which observers subtract, DN, (n_pixel,)."""
        return self.neighbour_dn + self.sky_dn if self.signal == "net" else self.neighbour_dn

    @cached_property
    def signal_dn(self) -> Float:
        """Mean recorded signal of the exposure, DN, shape (n_pixel,): `recorded_light_dn` minus `subtracted_dn`."""
        return self.recorded_light_dn - self.subtracted_dn

    @cached_property
    def mean_raw_dn(self) -> Float:
        """Mean raw level of a frame before saturation and ADC: light, dark and bias, DN, shape (n_pixel,)."""
        return self.light_dn / self.n_frames + self.dark_dn + self.bias_dn

    @cached_property
    def recorded_dn(self) -> Float:
        """Mean raw value of the exposure, DN, shape (n_pixel,)."""
        return self.n_frames * self.mean_raw_dn - self._cut[0]

    @cached_property
    def dark_step_dn(self) -> Float:
        """DN per dark count, shape (n_pixel,): one, or the gain if the dark counts are electrons."""
        return self.gain_dn_per_electron if self.dark_unit == "electrons" else np.ones_like(self.dark_dn)

    @cached_property
    def dark_variance_dn2(self) -> Float:
        """Variance of the dark counts of a frame, DN^2, shape (n_pixel,)."""
        return np.asarray(self.dark_dn * self.dark_step_dn)

    @cached_property
    def variance_dn2(self) -> Float:
        """Variance of the recorded exposure, DN^2, including the rounding of each frame (1/12), shape (n_pixel,).

        Saturation reduces the variance, but not below that of rounding. Rounding acts as noise of mean 0 and variance
        1/12 only if the noise of a frame is at least about 1 DN. For a nearly noiseless detector this assumption, and
        every closed form based on it, fails, and draws differ.
        """
        return self._cut[1]

    @cached_property
    def unsaturated_variance_dn2(self) -> Float:
        """Variance of the exposure without saturation, DN^2, shape (n_pixel,)."""
        return self._noise_of(self.light_dn) + self.n_frames / 12

    @cached_property
    def _noise_dn2(self) -> Float:
        return self._noise_of(self.recorded_light_dn)

    def _noise_of(self, light_dn: Float) -> Float:
        photon = self.gain_dn_per_electron * light_dn
        return photon + self.n_frames * (self.read_noise_dn**2 + self.dark_variance_dn2)

    @cached_property
    def _cut(self) -> tuple[Float, Float]:
        """Mean lost to saturation and remaining variance, for normally distributed frames that are clipped above."""
        lost, variance = np.zeros_like(self.light_dn), self.unsaturated_variance_dn2.copy()
        sd = np.sqrt(variance / self.n_frames)
        near = self.mean_raw_dn + CUT_SIGMA * sd > self.highest_dn
        if near.any():
            mean, sd = self.mean_raw_dn[near], sd[near]
            a = (self.highest_dn - mean) / sd
            below, density = special.ndtr(a), np.exp(-(a**2) / 2) / np.sqrt(2 * np.pi)
            # First and second moment of min(z, a) - a.
            first = -(a * below + density)
            second = (a**2 + 1) * below + a * density
            lost[near] = self.n_frames * (mean - self.highest_dn - sd * first)
            variance[near] = self.n_frames * np.maximum(sd**2 * (second - first**2), 1 / 12)
        return lost, variance

    @cached_property
    def cut_share(self) -> Float:
        """Probability that saturation clips a frame of a pixel, shape (n_pixel,)."""
        sd = np.sqrt(self.unsaturated_variance_dn2 / self.n_frames)
        return np.asarray(special.ndtr((self.mean_raw_dn - self.highest_dn - 0.5) / sd))

    @property
    def saturation_clause(self) -> str:
        """End of an error message, ``; N of M pixels of NAME saturate ...``; empty if none does."""
        many = int(self.saturated.sum())
        if not many:
            return ""
        return f"; {many} of {self.saturated.size} pixels of {self.name} saturate in a frame of {self.frame_s:g} s"

    def snr(self) -> Float:
        """Return the signal-to-noise ratio per pixel, shape (n_pixel,).

        The ratio is S / sqrt(sigma_L^2 + sigma_R^2 + sigma_D^2), all in DN, where S is `signal_dn` and sigma_L is the
        gain times the root of all electrons of light, of neighbours and sky as well, without the ADC's rounding.
        """
        return _ratio(self.signal_dn, self._noise_dn2)

    def snr_per_element(self) -> Float:
        """Return the signal-to-noise ratio per resolution element, shape (n_element,), with noise in quadrature."""
        return _ratio(self.per_element(self.signal_dn), self.per_element(self._noise_dn2))

    def per_element(self, values: Float) -> Float:
        """Sum the values of pixels over resolution elements, from shape (n_pixel,) to (n_element,)."""
        if np.shape(values) != self.element.shape:
            raise InputError.of("values", np.shape(values), f"of the shape {self.element.shape}, one for each pixel")
        return np.asarray(np.bincount(self.element, values, minlength=self.element_wavelength_nm.size), np.float64)

    def noise_budget(self) -> QTable:
        """Return the noise of the exposure by origin, DN rms per pixel.

        The columns are `wavelength`, `source_photon`, `zodiacal_photon`, with neighbours `neighbour_photon`, `dark`,
        `read` and `total`. The total is their quadratic sum, so `snr` is signal_dn / total. The ADC's rounding, 0.29 DN
        per frame, is not included.
        """
        n, gain = self.n_frames, self.gain_dn_per_electron
        # Fraction of the light that saturation leaves.
        passed = np.divide(self.recorded_light_dn, self.light_dn, out=np.ones_like(gain), where=self.light_dn > 0)
        light = self.source_electrons, self.sky_electrons, self.neighbour_electrons
        variances = [n * gain**2 * electrons * passed for electrons in light]
        variances += [n * self.dark_variance_dn2, n * self.read_noise_dn**2, self._noise_dn2]
        noise = {name: np.sqrt(variance) for (name, *_), variance in zip(ORIGINS, variances, strict=True)}
        columns = [c for c in BUDGET_COLUMNS if c.name != "neighbour_photon" or self.neighbour_electrons.any()]
        row = {"wavelength": self.wavelength_nm} | noise
        return table_of(columns, [row], exposure_s=self.exposure_s, name=self.name)

    @property
    def ceiling_dn(self) -> float:
        """Raw level at which a pixel saturates, DN: the lower of the detector's and the ADC's."""
        return min(self.saturation_dn, float(self.adc_max_dn))

    @property
    def highest_dn(self) -> int:
        """Largest recorded value of a frame: the last whole DN up to `ceiling_dn`."""
        return int(np.floor(self.ceiling_dn))

    @cached_property
    def saturated(self) -> Bool:
        """True for pixels whose mean raw level in a frame reaches `ceiling_dn`, shape (n_pixel,)."""
        return np.asarray(self.mean_raw_dn >= self.ceiling_dn)

    @property
    def longest_safe_frame_s(self) -> float:
        """Longest frame in which no pixel's mean raw level reaches saturation, s; infinite without light and dark."""
        rise = (self.mean_raw_dn - self.bias_dn) / self.frame_s
        with np.errstate(divide="ignore"):
            return float(np.min(np.where(rise > 0, (self.ceiling_dn - self.bias_dn) / rise, np.inf)))


#: Largest electrons or DN per pixel and frame, far beyond any detector.
MAX_PER_FRAME = 1e12
#: Arrays with one value per pixel, from 0 to `MAX_PER_FRAME`.
PER_PIXEL = ("source_electrons", "sky_electrons", "neighbour_electrons", "dark_dn", "bias_dn", "read_noise_dn",
             "gain_dn_per_electron")  # fmt: skip


def _ratio(signal: Float, variance: Float) -> Float:
    # A noiseless detector without light has a ratio of 0 by definition.
    return np.divide(signal, np.sqrt(variance), out=np.zeros_like(signal), where=variance > 0)


@validated
def expect(
    source: Source | str,
    instrument: Instrument | str | Path = DEFAULT_INSTRUMENT,
    *,
    exposure: Exposure,
    sky: Sky | SkyBrightness | None = None,
    order: Order = "paper",
    signal: Signal = "net",
    neighbours: Neighbours | None = None,
) -> Expectation:
    """Compute the expectation of an exposure: means and noise per pixel, without drawing anything.

    Raises InputError if the source does not cover the output range, or its flux has no absolute scale.

    Parameters
    ----------
    source : Source or str
        A source, which emits no light beyond its wavelengths, or a name of the library. A well-known star,
        such as AU Mic, has the V magnitude of the embedded list.
    instrument : Instrument, str or Path, optional
        An instrument, or a name or file for `Instrument.load`; "mauve" by default.
    exposure : Quantity or float
        Exposure time, up to one day; plain numbers are seconds. It is rounded up to whole frames, with a message.
    sky : Sky, Quantity or float, optional
        Plain numbers are mag arcsec^-2. The default is zodiacal light of V = 22.1 mag arcsec^-2, as on the command
        line; `Sky.none()` means no sky.
    order : {"paper", "physical"}
        Whether efficiencies act after or before the line spread function; see `response_matrix`.
    signal : {"net", "paper"}
        Whether the signal in an S/N is the star alone, or includes the zodiacal light as in the MauveSim paper.
    neighbours : Neighbours, optional
        Other stars in the fibre; none by default.

    Examples
    --------
    >>> from mauvecl import Instrument, Sky, Source, expect
    >>> star = Source.from_library("G2V").at_magnitude(7.4)
    >>> quiet = expect(star, Instrument.load("mauve"), exposure=48, sky=Sky.of_brightness(22.1))
    >>> quiet.n_frames, quiet.exposure_s
    (10, 50.0)
    >>> float(round(quiet.snr().max(), 2)), float(round(quiet.snr_per_element().max(), 1))
    (10.33, 61.0)
    """
    source = listed_star(source) if isinstance(source, str) else source
    instrument = instrument if isinstance(instrument, Instrument) else Instrument.load(instrument)
    sky = sky if isinstance(sky, Sky) else Sky.of_brightness(DEFAULT_SKY if sky is None else sky)
    # The margin makes 0.1 + 0.2 s three frames of 0.1 s despite rounding.
    n_frames = max(1, int(np.ceil(exposure / instrument.frame_s * (1 - 1e-12))))
    if n_frames > MAX_FRAMES:
        raise InputError.of("exposure", exposure, f"at most {MAX_FRAMES} frames of {instrument.frame_s:g} s", unit="s")
    check_covers(source, (instrument.output_min_nm, instrument.output_max_nm), f"{instrument.name}'s output range ")
    check_level(source, source.name, "magnitude")
    source = continued_to_reach(source, instrument)
    zodiacal = sky.spectrum(instrument.field_of_view_arcsec2)
    electrons = _electrons_per_frame(source, instrument, order)
    nothing = np.zeros(electrons.shape)
    near = nothing if neighbours is None else instrument.frame_s * neighbours.electrons_per_second(instrument, order)
    provenance = _provenance(source, instrument, sky, zodiacal)
    provenance |= {"order": order, "signal": signal, "requested exposure": f"{exposure:g} s",
                   "exposure": f"{n_frames} x {instrument.frame_s:g} s"}  # fmt: skip
    provenance |= {} if neighbours is None else neighbours.provenance(instrument)
    x = Expectation(
        **_detector(instrument),
        source_electrons=_check_brightness(np.maximum(electrons, 0.0), source.name),
        sky_electrons=nothing if zodiacal is None else _electrons_per_frame(zodiacal, instrument, order).clip(0.0),
        neighbour_electrons=_check_brightness(near, "a neighbour"),
        n_frames=n_frames, signal=signal, name=source.name, provenance=provenance,
    )  # fmt: skip
    drawn = np.sqrt(x.variance_dn2) / (n_frames * x.gain_dn_per_electron)
    messages = [*_saturation(x), *(f"{source.name}: {text}." for text in source.messages)]
    messages += [] if neighbours is None else neighbours.messages(source.name, instrument)
    messages += negative_means_message(source, instrument, electrons, drawn, order)
    return replace(x, messages=(*messages, *_remarks(x, exposure, source, instrument)))


def _electrons_per_frame(light: Source, instrument: Instrument, order: Order) -> Float:
    """Return the mean electrons of a frame, shape (n_pixel,); negative where the fluxes are."""
    rate = electrons_per_second(instrument, light.wavelength_nm, light.flux_flam, order)
    return rate * instrument.frame_s * instrument.per_pixel("response", 1.0)


def _detector(instrument: Instrument) -> dict[str, Any]:
    """Return the fields of an expectation that follow from the instrument alone."""
    same = ("wavelength_nm", "dark_unit", "frame_s", "photon_noise", "adc_max_dn", "saturation_dn")
    conditions = ("temperature_c", "dark_slope_per_c", "light_loss", "pointing_loss")
    width = instrument.resolution_element_nm
    bins = np.floor((instrument.wavelength_nm - instrument.output_min_nm) / width)
    # An array that starts above the output range leaves the first bins empty.
    filled, element = np.unique(bins, return_inverse=True)
    return {name: getattr(instrument, name) for name in same} | {
        "dark_dn": instrument.per_pixel("dark", instrument.dark_dn_per_s * instrument.frame_s),
        "bias_dn": instrument.per_pixel("bias_dn", instrument.bias_dn),
        "read_noise_dn": instrument.per_pixel("read_noise_dn", instrument.read_noise_dn),
        "gain_dn_per_electron": instrument.per_pixel("gain", instrument.gain_dn_per_electron),
        "element": element.astype(np.int32),
        "element_wavelength_nm": instrument.output_min_nm + (filled + 0.5) * width,
        "conditions": {name: getattr(instrument, name) for name in conditions},
        "instrument": instrument.name,
    }


def _provenance(source: Source, instrument: Instrument, sky: Sky, zodiacal: Source | None) -> dict[str, str]:
    """Return names, origins and digests of what an expectation is computed from."""
    return {
        "source": source.name,
        "source origin": source.origin,
        "source notes": "; ".join(source.notes),
        "source history": "; ".join(source.history),
        "source remarks": "; ".join(source.messages),
        "source digest": source.digest,
        "sky": sky.description,
        "sky digest": "" if zodiacal is None else zodiacal.digest,
        "instrument": instrument.name,
        "instrument digest": instrument.digest,
        "detector temperature": f"{instrument.temperature_c:g} C",
    }


def _remarks(x: Expectation, exposure: float, source: Source, instrument: Instrument) -> Iterator[str]:
    """Yield messages on signal and exposure, and on what source and instrument assume."""
    if x.signal == "paper" and x.sky_electrons.any():
        yield Message("S/N counts the zodiacal light as signal, as the MauveSim paper does.", "paper signal")
    if x.exposure_s > exposure * (1 + 1e-9):
        frames = f"{counted(x.n_frames, 'frame')} of {x.frame_s:g} s"
        text = f"The exposure of {exposure:g} s is rounded up to {x.exposure_s:g} s, {frames}."
        yield Message(text, "rounded up")
    below = special.ndtr(-(x.mean_raw_dn + 0.5) / np.sqrt(x.unsaturated_variance_dn2 / x.n_frames)) > REPORTED_CLIPPING
    if below.any():
        yield (
            f"{source.name}: frames of {int(below.sum())} of {below.size} pixels fall below 0 DN by noise and are "
            "recorded as 0. The stated means, noise and S/N ignore this; the bias of the instrument is too small."
        )
    if any(note.startswith("dereddened") for note in source.notes) and not any("redden" in h for h in source.history):
        yield (
            f"{source.name} was dereddened by its archive: it is brighter in the ultraviolet than as observed, unless "
            "it is reddened again (ebv)."
        )
    nominal, calibrated = THROUGHPUTS
    notice = Message(instrument.notice, nominal if instrument.throughput_errors is None else calibrated)
    yield from filter(None, (notice, source.scale))


def continued_to_reach(source: Source, instrument: Instrument) -> Source:
    """Continue the dark ends of a source as far as the instrument's line spread function reaches."""
    range_nm, line = (instrument.output_min_nm, instrument.output_max_nm), LineSpread.of(instrument)
    nm, flux, messages = continue_ends(source.name, source.wavelength_nm, source.flux_flam, range_nm, line)
    if not messages:
        return source
    return replace(source, wavelength_nm=nm, flux_flam=flux, messages=(*source.messages, *messages))


#: Fraction of exposures with a saturated frame, and of frames below zero, from which a message reports it.
REPORTED_CLIPPING = 1e-4
#: Largest number of runs of saturated pixels that a message names one by one.
MAX_RUNS = 3


def entirely_saturated(x: Expectation, key: str) -> InputError:
    """Return the error of an exposure of which every pixel saturates."""
    fault = f"every pixel of {x.name} is saturated in a frame of {x.frame_s:g} s"
    return InputError(f"{fault}; use a fainter star, or frames of at most {_safe_frame_s(x):g} s", key=key)


def _safe_frame_s(x: Expectation) -> float:
    """Return the longest frame without a saturated pixel, rounded down to milliseconds or three digits."""
    per_s = max(1000.0, 10.0 ** (2 - np.floor(np.log10(x.longest_safe_frame_s))))
    return float(np.floor(x.longest_safe_frame_s * per_s) / per_s)


def _saturation(x: Expectation) -> list[str]:
    """Return the message on saturation, if any."""
    touched = float(-np.expm1(x.n_frames * np.sum(np.log1p(-np.minimum(x.cut_share, 1 - 1e-16)))))
    if not x.saturated.any() and touched < REPORTED_CLIPPING:
        return []
    safe_s = _safe_frame_s(x)
    flares = [text for text in x.provenance.get("source history", "").split("; ") if text.startswith("flare")]
    name = f"{x.name} with a {flares[-1].removesuffix(', added')}" if flares else x.name
    if not x.saturated.any():
        near = f"SATURATED at times: pixels of {name} come near {x.ceiling_dn:.0f} DN, and reach it in"
        safe = f"in frames of up to {safe_s:g} s none does on average"
        return [Message(f"{near} {100 * touched:.3g} % of exposures; {safe}.", "saturated")]
    # First and last wavelength of each run of saturated pixels.
    runs = [f"{x.wavelength_nm[a]:.1f}-{x.wavelength_nm[b - 1]:.1f}" for a, b in true_runs(x.saturated)]
    where = ", ".join(runs)
    if len(runs) > MAX_RUNS:
        where = f"{len(runs)} intervals between {runs[0].partition('-')[0]} and {runs[-1].partition('-')[2]}"
    pixels = f"SATURATED: {int(x.saturated.sum())} of {x.saturated.size} pixels of {name} at {where} nm reach"
    reached = f"{x.ceiling_dn:.0f} DN in a {x.frame_s:g} s frame; the longest safe frame is {safe_s:g} s"
    return [Message(f"{pixels} {reached}.", "saturated")]


def _check_brightness(electrons: Float, name: str) -> Float:
    """Return the mean electrons of a frame; raise InputError if a star is too bright for any pixel."""
    if (electrons > MAX_PER_FRAME).any():
        remark = " (at 1 au it has V = -26.76, Willmer 2018)" if name == "Sun" else ""
        fault = f"{name} is too bright: a pixel may have at most {MAX_PER_FRAME:g} electrons in a frame"
        remedy = "`magnitude` makes it a star at a distance, as in `magnitude=7.4`"
        raise InputError(f"{fault}, not {float(electrons.max()):.3g}{remark}; {remedy}", key="magnitude")
    return electrons
