"""Study sections for star, flare, observation, sky, noise processes, run and unknown instrument values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, create_model, field_validator, model_validator

from mauvecl.detection.names import DEFAULT_STATISTICS, RECOMMENDED, STATISTIC_NAMES
from mauvecl.host.exposure import DEFAULT_SKY
from mauvecl.host.instrument import DEFAULT_INSTRUMENT, current_name
from mauvecl.host.stars.library import ALIASES, listed_values
from mauvecl.noise.disturbances import Prior, PriorField
from mauvecl.noise.unknowns import INSTRUMENT_VALUES, Comparison, values_of
from mauvecl.schema import parsing
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Quantity, Range, Slider, Widget
from mauvecl.schema.physical import (
    DEFAULT_SEED,
    Amplitude,
    BinWidth,
    DetectorTemperature,
    Distance,
    Exposure,
    Magnitude,
    Probability,
    Radius,
    Reddening,
    Share,
    SkyBrightness,
    Temperature,
)
from mauvecl.schema.section import Section
from mauvecl.study.flare_light import FlareLight

if TYPE_CHECKING:
    from mauvecl.host.exposure.sky import Sky
    from mauvecl.host.exposure.star import Neighbours
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.flare_spectra import FlareSpectrum
    from mauvecl.host.stars.source import Source


def amplitudes_in(path: Path, _: str) -> list[float]:
    """Read the amplitudes of a table of flares, each value once, and warn of columns that are not used."""
    import warnings

    from mauvecl.host.stars.flare import read_flares

    flares = read_flares(path)
    for remark in flares.meta["comments"]:
        warnings.warn(remark, stacklevel=2)
    return sorted({float(value) for value in flares["amplitude"]})


#: Keys that only apply to a star from a file.
FILE_KEYS = ("file", "wavelength_unit", "flux_unit", "extend", "ignore_checksum")
#: Keys that describe one star and are dropped when another star replaces it.
STAR_KEYS = (
    *FILE_KEYS, "distance_pc", "radius_rsun", "effective_temperature_k", "neighbours", "neighbours_of"
)  # fmt: skip


class Star(Section):
    """Spectrum, extinction and magnitude of a star; distance or radius for flare energies."""

    library: Annotated[
        str | None,
        Help("Library name or spectrum file", "as in G2V,M3V"),
        Flag("--star", "-s", kind=list[str]),
        Quantity("star", "library name or file, with its magnitude", "star"),
    ] = None
    file: Annotated[Path | None, Help("Spectrum file, instead of a name of the library")] = None
    magnitude: Annotated[
        Magnitude | None,
        Help("Magnitude", "one for all stars or one each, as in 7,8"),
        Flag("--magnitude", "-m", kind=list[float]),
        Widget(
            label="Magnitude",
            hint="How bright the star is without the flare, in the band of the next field.",
            first="8.5",
            unit="",
            slider=Slider(0, 15, 0.1),
        ),
        Quantity("magnitude", "magnitude of the star in its band", "magnitude"),
    ] = None
    band: Annotated[
        str,
        Help("Band of the magnitude", choices=", ".join(ALIASES)),
        Flag("--band"),
        Widget(
            label="Band",
            hint="The band of the magnitude. In V, Vega has 0.03, as in catalogues.",
            choices=tuple(ALIASES),
        ),
    ] = "V"
    magnitude_system: Annotated[
        Literal["catalogue", "vega", "ab"],
        Help("Zero point of the magnitude", choices="catalogue, vega (Vega is 0 in every band) or ab"),
        Flag("--magnitude-system"),
    ] = "catalogue"
    ebv: Annotated[
        Reddening | None,
        Help("Dust in front of the star, E(B-V)", "needs mauvecl[extinction]"),
        Flag("--ebv"),
        Widget(
            label="Reddening",
            hint="Dust in front of the star, E(B-V) in magnitudes. The magnitude above is that of the reddened star. "
            "Nothing: no dust.",
            group="Star",
        ),
    ] = None
    wavelength_unit: Annotated[
        str | None,
        Help("Unit of a spectrum file's wavelengths", "as in Angstrom, or 'nm air'"),
        Flag("--wavelength-unit"),
        Widget(
            label="Unit of wavelengths",
            hint="That of the file's wavelengths, such as Angstrom or Angstrom air. Nothing: what the file says.",
            group="Own spectrum",
            suggestions=("nm", "Angstrom", "um", "nm air", "Angstrom air", "Hz", "eV"),
        ),
    ] = None
    flux_unit: Annotated[
        str | None,
        Help("Unit of a spectrum file's fluxes", "as in 'W m-2 nm-1'"),
        Flag("--flux-unit"),
        Widget(
            label="Unit of fluxes",
            hint="That of the file's fluxes, such as W m-2 nm-1 or Jy. Nothing: what the file says.",
            group="Own spectrum",
            suggestions=("erg s-1 cm-2 Angstrom-1", "W m-2 nm-1", "W m-2 um-1", "Jy", "photon s-1 cm-2 Angstrom-1"),
        ),
    ] = None
    extend: Annotated[
        str | None,
        Help("Library spectrum that continues a spectrum file beyond its ends, scaled to it"),
        Flag("--extend"),
        Widget(
            label="Continue with",
            hint="Library spectrum that continues the file beyond its ends, scaled to it, such as G2V. Nothing: none.",
            group="Own spectrum",
            kind="library",
        ),
    ] = None
    ignore_checksum: Annotated[
        bool | None,
        Help("Read FITS files although their CHECKSUM or DATASUM differs"),
        Flag("--ignore-checksum"),
    ] = None
    bin_nm: Annotated[BinWidth | None, Help("Width of bins over which the spectrum is averaged"), Flag("--bin-nm")] = (
        None
    )
    distance_pc: Annotated[
        Distance | None,
        Help("Distance of the star", "for energies"),
        Flag("--distance"),
        Widget(
            label="Distance",
            hint="With it, measured flares have luminosities and energies. Nothing: fluxes at the telescope alone.",
            group="Measurement",
            place=-1,
        ),
    ] = None
    radius_rsun: Annotated[Radius | None, Help("Radius of the star", "for energies"), Flag("--radius")] = None
    effective_temperature_k: Annotated[
        Temperature | None, Help("Effective temperature of the star", "for energies"), Flag("--star-temperature")
    ] = None
    neighbours: Annotated[
        Path | None,
        Help("Table of other stars near the star", "with separation, magnitude and spectral type, or of a Gaia query"),
        Flag("--neighbours"),
        Widget(
            label="Neighbours",
            hint="Other stars near the star, as CSV: name, separation (arcsec), magnitude and spectral_type, or the "
            "columns of a Gaia query. The light of those within 47 arcsec enters.",
            group="Neighbours",
            kind="table",
            placeholder="name,separation,magnitude,spectral_type",
        ),
    ] = None
    neighbours_of: Annotated[
        str | None,
        Help("The star's own row in that table, by name, or its coordinates"),
        Flag("--neighbours-of"),
        Widget(
            label="The star itself",
            hint="Its own row in that table, by name, or its coordinates, such as 290.68 +11.12; needed if the table "
            "has positions but no separations.",
            group="Neighbours",
            place=1,
        ),
    ] = None
    neighbour_share: Annotated[
        Share,
        Help("Share of the light of neighbours within the fibre's radius that enters it", "an assumption"),
        Flag("--neighbour-share"),
        Widget(
            label="Share that enters",
            hint="Share of the light of neighbours within 47 arcsec that enters the fibre; an assumption, since it is "
            "not published.",
            group="Neighbours",
            place=2,
        ),
    ] = 1.0

    @model_validator(mode="before")
    @classmethod
    def _as_listed(cls, given: Any) -> Any:
        """Add the V magnitude and the distance of a star of the embedded list, unless others are given."""
        if not isinstance(given, dict) or not isinstance(given.get("library"), str):
            return given
        listed = listed_values(given["library"])
        if given.get("band", "V") != "V" or given.get("magnitude_system", "catalogue") != "catalogue":
            listed.pop("magnitude", None)
        return given | {key: value for key, value in listed.items() if given.get(key) is None}

    @model_validator(mode="after")
    def _one_spectrum(self) -> Self:
        if (self.library is None) == (self.file is None):
            raise InputError("a star needs either library or file, but has neither or both", key="library")
        given = [key for key in FILE_KEYS if getattr(self, key) is not None]
        if self.file is None and given:
            raise InputError(
                f"a star of the library has {' and '.join(given)}, which only a star from a file may have", key=given[0]
            )
        if self.neighbours is None and self.neighbours_of is not None:
            raise InputError(
                "a star has neighbours_of, which needs the table of its neighbours as well", key="neighbours_of"
            )
        return self

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return a copy with another value; another library star drops values that describe this one."""
        changed = super().with_value(path, value)
        if path[0] != "library":
            return changed
        listed = listed_values(str(value))
        if self.magnitude not in (None, listed_values(self.library or "").get("magnitude")):
            # A given magnitude is that of every star.
            listed.pop("magnitude", None)
        return changed.model_copy(update=dict.fromkeys(STAR_KEYS) | listed)

    def near(self) -> Neighbours | None:
        """Read the star's neighbours, or return None if it has none."""
        if self.neighbours is None:
            return None
        from mauvecl.host.exposure.star import Neighbours, read_neighbours

        stars, notes = read_neighbours(self.neighbours, self.neighbours_of)
        return Neighbours(stars, self.neighbour_share, notes)

    def source(self) -> Source:
        """Load the spectrum and scale it to the magnitude, if one is given."""
        from mauvecl.host.stars.library import spectrum_name
        from mauvecl.host.stars.source import Source, with_listed_note

        if self.library is not None:
            spectrum_name(self.library)
            in_v = self.magnitude if (self.band, self.magnitude_system) == ("V", "catalogue") else None
            source = Source.from_library(self.library)
            source = with_listed_note(source, self.library, magnitude=in_v, distance_pc=self.distance_pc)
        else:
            source = Source.read(
                self.file or "", wavelength_unit=self.wavelength_unit, flux_unit=self.flux_unit, extend=self.extend,
                ignore_checksum=bool(self.ignore_checksum),
            )  # fmt: skip
        return self.applied(source)

    def applied(self, source: Source) -> Source:
        """Return a spectrum with the star's temperature, bins, dust and magnitude."""
        from dataclasses import replace

        if self.effective_temperature_k is not None:
            source = replace(source, temperature_k=self.effective_temperature_k)
        if self.bin_nm is not None:
            source = source.binned(self.bin_nm)
        if self.ebv is not None:
            source = source.reddened(self.ebv)
        if self.magnitude is None:
            return source
        return source.at_magnitude(self.magnitude, self.band, self.magnitude_system)


class Flare(Section):
    """Amplitudes, spectrum and geometry of flares."""

    amplitudes: Annotated[
        tuple[Amplitude, ...],
        Field(min_length=1),
        Help("Flare amplitude", "0.24 is a rise of 24 % in the flare's band"),
        Flag(
            "--flares",
            kind=Path,
            read=amplitudes_in,
            help=Help("Table of flares with their amplitudes", "CSV, ECSV or FITS, as AltaiPony's ampl_rec"),
        ),
        Flag("--amplitude", "-a"),
        Widget(
            label="Flare amplitude",
            hint="By how much the flare at its peak brightens the star in the band of the Kepler satellite. In the "
            "ultraviolet the rise is many times as large.",
            name="amplitude_percent",
            first="2",
            unit="%",
            scale=100.0,
            slider=Slider(0.01, 1000, 10**0.1, log=True),
        ),
        Quantity("amplitude", "flare amplitude: relative rise of the photons in the flare's band", "flare amplitude"),
    ] = (0.0076, 0.02, 0.081, 0.24)
    temperature_k: Annotated[
        Temperature,
        Help("Flare temperature"),
        Flag("--flare-temperature"),
        Widget(
            label="Flare temperature",
            hint="The flare shines as a blackbody of this temperature. The hotter, the more of its light is "
            "ultraviolet.",
            group="Flare's spectrum",
            name="flare_temperature_k",
            slider=Slider(5000, 30_000, 500),
        ),
        Quantity("flare_temperature", "blackbody temperature of the flare", "flare temperature (K)"),
    ] = 10_000.0
    band: Annotated[str, Help("Band of the amplitude", choices=", ".join(ALIASES)), Flag("--flare-band")] = "Kepler"
    geometry: Annotated[
        Literal["added", "replaces"],
        Help("Whether a flare is added to the star or replaces part of its photosphere"),
        Flag("--geometry"),
    ] = "added"
    photosphere_temperature_k: Annotated[
        Temperature | None,
        Help("Temperature of the photosphere that a flare replaces", default="the star's"),
        Flag("--photosphere-temperature"),
    ] = None
    spectrum: FlareLight = FlareLight()

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return a copy with another value; raises InputError for an amplitude of a flare as it was observed."""
        if path[0] == "amplitudes" and self.spectrum.as_observed:
            raise InputError(
                f"amplitude = {value} has no effect on a flare that is as bright as observed; it "
                f"needs flare.spectrum.as_observed = false",
                key="amplitude",
            )
        return super().with_value(path, value)

    def light(self, temperature_k: float | None = None) -> FlareSpectrum:
        """Return the spectrum of a flare, by default at the study's temperature."""
        return self.spectrum.at_temperature(self.temperature_k if temperature_k is None else temperature_k)

    @property
    def is_blackbody(self) -> bool:
        """True if the spectrum is a single blackbody."""
        return self.spectrum == FlareLight()


class Observation(Section):
    """Instrument, exposure, and how the detector is modelled."""

    exposure_s: Annotated[
        Exposure,
        Help("Exposure time", "rounded up to whole frames of 5 s"),
        Flag("--exposure", "-t"),
        Widget(
            label="Exposure",
            hint="Time on the star; whole frames of 5 s are added up.",
            place=1,
            slider=Slider(5, 3600, 5),
        ),
        Quantity("exposure", "length of the exposure", "exposure (s)"),
    ] = 50.0
    instrument: Annotated[
        str,
        Help(
            "Instrument", choices="mauve, mauvesim (with the conventions of the MauveSim paper), or your own TOML file"
        ),
        Flag("--instrument"),
        Widget(
            label="Payload",
            hint="mauve: dark counts are Poisson in electrons, as in physics. mauvesim: Poisson in DN, as in the "
            "MauveSim paper, which makes the dark noise 1.3 times as large.",
            place=2,
            choices=("mauve", "mauvesim"),
        ),
    ] = DEFAULT_INSTRUMENT
    temperature_c: Annotated[
        DetectorTemperature | None,
        Help("Detector temperature", default="the instrument's"),
        Flag("--temperature"),
        Widget(
            label="Detector temperature",
            hint="The dark current doubles every few degrees.",
            group="Detector",
            placeholder="21, or along the orbit in plans",
            slider=Slider(-10, 40, 1),
        ),
        Quantity("detector_temperature", "temperature of the detector", "detector temperature (deg C)"),
    ] = None
    order: Annotated[
        Literal["paper", "physical"],
        Help("Order of efficiency and line spread function"),
    ] = "paper"
    signal: Annotated[
        Literal["net", "paper"],
        Help("Signal of an S/N", choices="net (the star alone) or paper (with the zodiacal light)"),
        Flag("--signal"),
        Widget(
            label="Counted as signal",
            hint="In the S/N: the light of the star alone (net), or that of the sky too, as in the MauveSim paper. It "
            "moves no detection.",
            group="Sky",
            place=2,
        ),
    ] = "net"
    mode: Annotated[Literal["auto", "frames", "stacked"], Help("How the frames of an exposure are drawn")] = "auto"
    recipe: Annotated[Literal["auto", "joint", "apart"], Help("How the noise of a frame is drawn")] = "auto"
    changes: Annotated[dict[str, float | int | str], Help("Changed values of the instrument, by name")] = Field(
        default_factory=dict
    )

    @field_validator("instrument")
    @classmethod
    def _current_name(cls, given: str) -> str:
        return current_name(given)

    def load_instrument(self) -> Instrument:
        """Load the instrument and apply `changes` and the detector temperature."""
        from mauvecl.host.instrument.instrument import Instrument

        return self.changed(Instrument.load(self.instrument))

    def changed(self, instrument: Instrument) -> Instrument:
        """Return an instrument with `changes` and the detector temperature."""
        changes = self.changes | ({} if self.temperature_c is None else {"temperature_c": self.temperature_c})
        return instrument.with_(**changes) if changes else instrument


class SkyLight(Section):
    """Sky background: a surface brightness, that of a target at a time, or none."""

    surface_brightness: Annotated[
        SkyBrightness | None,
        Help("Surface brightness of the sky in V", "or none", default=f"{DEFAULT_SKY:g}"),
        Flag("--sky", kind=str),
        Widget(
            label="Sky brightness",
            hint="Zodiacal light, V magnitudes per square arc second.",
            group="Sky",
            place=1,
            name="sky_brightness",
            first=f"{DEFAULT_SKY:g}",
            unit="mag/arcsec²",
            slider=Slider(20, 24, 0.1),
        ),
        Quantity("sky", "zodiacal surface brightness in V", "sky brightness (V mag / arcsec²)"),
    ] = None
    target: Annotated[
        str | None,
        Help("Target whose zodiacal light is the sky, with the time", "a star such as 'AU Mic', or '290.68 +11.12'"),
        Flag("--target"),
        Widget(
            label="Sky target",
            hint="A star by name, such as AU Mic, or coordinates in degrees such as 290.68 +11.12.",
            group="Sky",
            place=1,
        ),
    ] = None
    time: Annotated[
        str | None,
        Help("Time of the observation, UTC, with the target"),
        Flag("--time"),
        Widget(label="Time, UTC", hint="Such as 2026-09-01T12:00.", group="Sky", place=1),
    ] = None
    none: Annotated[bool, Help("Whether there is no sky")] = False

    @model_validator(mode="before")
    @classmethod
    def _default_brightness(cls, given: Any) -> Any:
        return given or {"surface_brightness": DEFAULT_SKY}

    @model_validator(mode="after")
    def _one_sky(self) -> Self:
        if (self.target is None) != (self.time is None):
            raise InputError("the sky needs both target and time, or neither, but has only one", key="time")
        if (self.surface_brightness is not None) + (self.target is not None) + self.none > 1:
            raise InputError(
                "the sky is given twice",
                "one of surface_brightness, target with time, and none",
                key="surface_brightness",
            )
        return self

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return the sky of one value, which replaces all others."""
        return type(self)(**{path[0]: value})

    def sky(self) -> Sky:
        """Return the sky for the host."""
        from mauvecl.host.exposure.sky import Sky

        if self.none:
            return Sky.none()
        if self.target is not None and self.time is not None:
            return Sky.at(self.target, self.time)
        return Sky.none() if self.surface_brightness is None else Sky.of_brightness(self.surface_brightness)


class Run(Section):
    """Number of realisations, seed, statistics and false-alarm probability."""

    realisations: Annotated[int, Range(1), Help("Noise realisations"), Flag("--realisations", "-n")] = 1_000_000
    seed: Annotated[
        int,
        Range(0, 2**64 - 1),
        Help("Seed"),
        Flag("--seed"),
        Widget(label="Seed", hint="The same seed gives the same noise, to the bit.", group="Detection", place=3),
    ] = DEFAULT_SEED
    statistics: Annotated[
        tuple[str, ...],
        Field(min_length=1),
        Help("Detection statistic", choices=f"{', '.join(STATISTIC_NAMES)}, or all"),
        Flag("--statistic", read=parsing.words),
        Flag(
            "--all-statistics",
            kind=bool,
            read=lambda *_: DEFAULT_STATISTICS,
            help=Help(f"Answer by {', '.join(DEFAULT_STATISTICS)} instead of {RECOMMENDED} alone"),
        ),
    ] = (RECOMMENDED,)
    fap: Annotated[
        Probability,
        Help("False-alarm probability per test"),
        Flag("--fap"),
        Widget(
            label="False-alarm probability",
            hint="How often noise alone passes for a flare, per test: it sets the threshold.",
            group="Detection",
            unit="per test",
            slider=Slider(1e-6, 0.1, 10**0.1, log=True),
        ),
    ] = 1e-3
    tails: Annotated[
        Literal["counted", "sampled"],
        Help(
            "Thresholds with fewer than 100 draws beyond them",
            choices="counted rejects them, sampled finds them by importance sampling",
        ),
        Flag("--tails"),
    ] = "counted"
    reference: Annotated[
        str,
        Help("Spectrum that is subtracted", choices="template (noise-free), exposure (noisy), or stack:N of them"),
        Flag("--reference"),
    ] = "template"
    variances: Annotated[
        Literal["model", "estimated"],
        Help("Variances", choices="model, or estimated from the counts as an observer must"),
        Flag("--variances"),
    ] = "model"
    template_temperatures_k: Annotated[
        tuple[Temperature, ...],
        Help("Temperature of a flare that is also looked for", "shows what a wrong template costs"),
        Flag("--template"),
    ] = ()
    weights: Annotated[dict[str, Path], Help("Files with weights of your own statistics, by name")] = Field(
        default_factory=dict
    )

    @field_validator("statistics")
    @classmethod
    def _expand_all(cls, given: tuple[str, ...]) -> tuple[str, ...]:
        return STATISTIC_NAMES if "all" in given else given

    @model_validator(mode="after")
    def _comparable(self) -> Self:
        self.comparison()
        return self

    def comparison(self) -> Comparison:
        """Return the reference of the comparison for the engine."""
        return Comparison.of(self.reference, self.variances)


Draws = Annotated[
    int,
    Range(0, 4096),
    Help("Draws of unknown instrument values over which the answer is averaged"),
    Flag("--unknown"),
]
Known = Annotated[
    tuple[str, ...],
    Help("Instrument value that is known", "as in temperature_c,light_loss"),
    Flag("--known", read=parsing.words),
]
#: Number of draws, priors by name, and names of known values.
_unknown_keys: Any = (
    {"draws": (Draws, 0)}
    | {name: (PriorField | None, value.prior) for name, value in INSTRUMENT_VALUES.items()}
    | {"known": (Known, ())}
)


class Unknowns(create_model("_InstrumentValues", __base__=Section, **_unknown_keys)):  # type: ignore[misc]
    """Priors of instrument values that are unknown but constant; ignored unless `draws` is positive.

    The documentation page on nominal values explains the default priors.
    """

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.draws == 1:
            raise InputError.of("unknowns.draws", self.draws, "0 or at least 2")
        other = next((name for name in self.known if name not in INSTRUMENT_VALUES), None)
        if other is not None:
            raise InputError(f"unknowns.known names {other!r}", f"some of {', '.join(INSTRUMENT_VALUES)}", key="known")
        return self

    def priors(self, instrument: Instrument) -> dict[str, Prior]:
        """Return the priors of an instrument's unknown values by name, as in `noise.unknowns.values_of`."""
        rows = {name: row for name, row in values_of(instrument).items() if name not in self.known}
        given: dict[str, Any] = {name: getattr(self, name, row.prior) for name, row in rows.items()}
        return {name: prior for name, prior in given.items() if prior is not None}
