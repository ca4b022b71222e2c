"""Study sections of a star, of the spectrum of its flares, and of their amplitudes."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import model_validator

from mauvecl.host.stars.library import ALIASES, listed_values
from mauvecl.schema import fields
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Range, Slider, Unit
from mauvecl.schema.section import Section, check_all, check_needs, check_one, read_line_fluxes, reading_for, setting

if TYPE_CHECKING:
    from mauvecl.host.exposure.background import Neighbours
    from mauvecl.host.stars.flare import FlareSpectrum
    from mauvecl.host.stars.source import Source

#: Units of a spectrum file: what has them, examples in a sentence, and suggestions.
UNITS = {
    "wavelength": ("wavelengths", "Angstrom or Angstrom air", ("nm", "Angstrom", "um", "nm air", "Angstrom air")),
    "flux": ("fluxes", "W m-2 nm-1 or Jy", ("erg s-1 cm-2 Angstrom-1", "W m-2 nm-1", "Jy")),
}
#: Keys that only apply to a star from a file.
FILE_KEYS = ("file", "wavelength_unit", "flux_unit", "extend", "ignore_checksum")
#: Keys that describe one star and are dropped when another star replaces it.
STAR_KEYS = (
    *FILE_KEYS, "distance_pc", "radius_rsun", "effective_temperature_k", "neighbours", "neighbours_of"
)  # fmt: skip


def unit_of_file(quantity: Literal["wavelength", "flux"], prefix: str, whose: str, label: str) -> Any:
    """Return the field of the unit of a spectrum other than the star's.

    Its flag begins with `prefix` and its label on the page with `label`; `whose` names the spectrum in its help.
    """
    noun, examples, units = UNITS[quantity]
    return setting(
        None,
        f"Unit of the {noun} of {whose}",
        flag=f"--{prefix}-{quantity}-unit",
        label=f"{label}: unit of {noun}",
        hint=f"Such as {examples}. Nothing: what the file says.",
        suggestions=units,
    )


def _listed(name: str, band: Any, system: Any) -> dict[str, float]:
    """Return the distance of a listed star, and its V if magnitudes are those of catalogues in V."""
    listed = listed_values(name)
    if band not in ("V", *ALIASES["V"]) or system != "catalogue":
        listed.pop("magnitude", None)
    return listed


class Star(Section):
    """Spectrum, extinction and magnitude of a star; distance or radius for flare energies."""

    library: str | None = setting(
        None,
        "Library name or spectrum file; as in G2V,M3V",
        flag=Flag("--star", "-s", kind=list[str]),
        quantity=("star", "library name or file, with its magnitude", "star"),
    )
    file: Path | None = setting(None, "Spectrum file, instead of a name of the library")
    magnitude: fields.Magnitude | None = setting(
        None,
        "Magnitude; one for all stars or one each, as in 7,8",
        flag=Flag("--magnitude", "-m", kind=list[float]),
        hint="How bright the star is without the flare, in the band of the next field.",
        first="8.5",
        unit="",
        slider=Slider(0, 15, 0.1),
        quantity=("magnitude", "magnitude of the star in its band", "magnitude"),
    )
    band: str = setting(
        "V",
        "Band of the magnitude",
        flag="--band",
        choices=tuple(ALIASES),
        hint="The band of the magnitude. In V, Vega has 0.03, as in catalogues.",
    )
    magnitude_system: Literal["catalogue", "vega", "ab"] = setting(
        "catalogue",
        "Zero point of the magnitude",
        flag="--magnitude-system",
        choices="catalogue, vega (Vega is 0 in every band) or ab",
    )
    ebv: fields.Reddening | None = setting(
        None,
        "Dust in front of the star, E(B-V); needs mauvecl[extinction]",
        flag="--ebv",
        label="Reddening",
        hint="Dust in front of the star, E(B-V) in magnitudes. The magnitude above is that of the reddened star. "
        "Nothing: no dust.",
    )
    wavelength_unit: str | None = setting(
        None,
        "Unit of a spectrum file's wavelengths; as in Angstrom, or 'nm air'",
        flag="--wavelength-unit",
        label="Unit of wavelengths",
        hint="That of the file's wavelengths, such as Angstrom or Angstrom air. Nothing: what the file says.",
        suggestions=("nm", "Angstrom", "um", "nm air", "Angstrom air", "Hz", "eV"),
    )
    flux_unit: str | None = setting(
        None,
        "Unit of a spectrum file's fluxes; as in 'W m-2 nm-1'",
        flag="--flux-unit",
        label="Unit of fluxes",
        hint="That of the file's fluxes, such as W m-2 nm-1 or Jy. Nothing: what the file says.",
        suggestions=("erg s-1 cm-2 Angstrom-1", "W m-2 nm-1", "W m-2 um-1", "Jy", "photon s-1 cm-2 Angstrom-1"),
    )
    extend: str | None = setting(
        None,
        "Library spectrum that continues a spectrum file beyond its ends, scaled to it",
        flag="--extend",
        label="Continue with",
        hint="Library spectrum that continues the file beyond its ends, scaled to it, such as G2V. Nothing: none.",
        kind="library",
    )
    ignore_checksum: bool | None = setting(
        None, "Read FITS files although their CHECKSUM or DATASUM differs", flag="--ignore-checksum"
    )
    bin_nm: fields.BinWidth | None = setting(None, "Width of bins over which the spectrum is averaged", flag="--bin-nm")
    distance_pc: fields.Distance | None = setting(
        None,
        "Distance of the star; for energies",
        flag="--distance",
        hint="With it, measured flares have luminosities and energies. Nothing: fluxes at the telescope alone.",
    )
    radius_rsun: fields.Radius | None = setting(None, "Radius of the star; for energies", flag="--radius")
    effective_temperature_k: fields.Temperature | None = setting(
        None, "Effective temperature of the star; for energies", flag="--star-temperature"
    )
    neighbours: Path | None = setting(
        None,
        "Table of other stars near the star; with separation, magnitude and spectral type, or of a Gaia query",
        flag="--neighbours",
        hint="Other stars near the star, as CSV: name, separation (arcsec), magnitude and spectral_type, or the "
        "columns of a Gaia query. The light of those within 47 arcsec enters.",
        kind="table",
        placeholder="name,separation,magnitude,spectral_type",
    )
    neighbours_of: str | None = setting(
        None,
        "The star's own row in that table, by name, or its coordinates",
        flag="--neighbours-of",
        label="The star itself",
        hint="Its own row in that table, by name, or its coordinates, such as 290.68 +11.12; needed if the table "
        "has positions but no separations.",
    )
    neighbour_share: fields.Share = setting(
        1.0,
        "Share of the light of neighbours within the fibre's radius that enters it; an assumption",
        flag="--neighbour-share",
        label="Share that enters",
        hint="Share of the light of neighbours within 47 arcsec that enters the fibre; an assumption, since it is "
        "not published.",
    )

    @model_validator(mode="before")
    @classmethod
    def _as_listed(cls, data: Any) -> Any:
        """Add the V magnitude and the distance of a star of the embedded list, unless others are given."""
        if not isinstance(data, dict) or not isinstance(data.get("library"), str):
            return data
        listed = _listed(data["library"], data.get("band", "V"), data.get("magnitude_system", "catalogue"))
        return data | {key: value for key, value in listed.items() if data.get(key) is None}

    def _check_values(self) -> None:
        check_one(self, "a star", "library", "file", needed=True)
        check_needs(self, "a star of the library", FILE_KEYS, "file")
        check_needs(self, "a star", ["neighbours_of"], "neighbours")

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return a copy with another value; another library star drops values that describe this one."""
        changed = super().with_value(path, value)
        if path[0] != "library":
            return changed
        before = _listed(self.library or "", self.band, self.magnitude_system)
        listed = _listed(str(value), self.band, self.magnitude_system)
        if self.magnitude not in (None, before.get("magnitude")):
            # A magnitude that is not from the list was set by the user, for every star.
            listed.pop("magnitude", None)
        return changed.model_copy(update=dict.fromkeys(STAR_KEYS) | listed)

    def near(self) -> Neighbours | None:
        """Read the star's neighbours, or return None if it has none."""
        if self.neighbours is None:
            return None
        from mauvecl.host.exposure.background import Neighbours, read_neighbours

        stars, notes = read_neighbours(self.neighbours, self.neighbours_of)
        return Neighbours(stars, self.neighbour_share, notes)

    def source(self) -> Source:
        """Load the spectrum and scale it to the magnitude, if one is given."""
        from mauvecl.host.stars.library import named_star
        from mauvecl.host.stars.source import Source, with_listed_note

        if self.library is not None:
            named_star(self.library)
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
        if self.effective_temperature_k is not None:
            source = replace(source, temperature_k=self.effective_temperature_k)
        if self.bin_nm is not None:
            source = source.binned(self.bin_nm)
        if self.ebv is not None:
            source = source.reddened(self.ebv)
        if self.magnitude is None:
            return source
        return source.at_magnitude(self.magnitude, self.band, self.magnitude_system)


#: Keys, other than `file`, that only apply to a flare from a file.
FLARE_FILE_KEYS = ("quiescent", "wavelength_unit", "flux_unit", "continue_at_k", "as_observed")


class FlareLight(Section):
    """Spectrum of a flare; by default a blackbody of `flare.temperature_k`."""

    balmer_jump: fields.BalmerJump | None = setting(
        None,
        "Ratio of the flare's flux just below the Balmer edge to that just above",
        flag="--balmer-jump",
        usual="1",
        hint="Flux just below 364.6 nm over that just above, by hydrogen recombination: 1 to 4 in most flares. "
        "Nothing: a plain blackbody.",
        quantity=(
            "balmer_jump",
            "flux of the flare just below the Balmer edge over that just above",
            "Balmer jump ratio",
        ),
    )
    electron_temperature_k: fields.Temperature = setting(10_000.0, "Electron temperature of the Balmer continuum")
    second_temperature_k: fields.Temperature | None = setting(
        None,
        "Temperature of a second blackbody of the flare; needs its area",
        flag="--second-temperature",
        hint="A second blackbody in the flare, instead of a Balmer jump. Nothing: there is none.",
        quantity=("second_temperature", "temperature of the flare's second blackbody", "second temperature (K)"),
    )
    second_area: fields.AreaRatio | None = setting(
        None,
        "Area of the second blackbody over that of the first",
        flag="--second-area",
        hint="Area at the second temperature over that at the first, if there is one.",
        first="0.05",
        quantity=("second_area", "area of the flare's second blackbody over that of the first", "second area"),
    )
    lines: dict[str, fields.LineFraction] = setting(
        dict,
        "Emission line as a fraction of the continuum in 200-700 nm, by name or wavelength in nm; as in 'Mg II=0.05'",
        flag=Flag("--line", kind=list[str], read=read_line_fluxes),
    )
    line_fluxes: dict[str, Annotated[float, Unit("erg / (s cm2)"), Range(0)]] = setting(
        dict,
        "Emission line at the telescope, by name or wavelength in nm; as in '280=1e-12'",
        flag=Flag("--line-flux", kind=list[str], read=read_line_fluxes),
    )
    line_scale: fields.LineScale = setting(
        1.0,
        "Factor on all line fluxes",
        quantity=("line_scale", "factor of all line fluxes of the flare", "line fluxes"),
    )
    file: Path | None = setting(
        None,
        "Spectrum file of an observed or computed flare",
        flag="--flare-file",
        label="Own flare spectrum",
        hint="Spectrum of an observed or computed flare without its star, in place of a blackbody. The amplitude "
        "scales it.",
        place=2,
        kind="file",
    )
    quiescent: Path | None = setting(
        None,
        "Spectrum file of its star without the flare, which is subtracted",
        flag="--flare-quiescent",
        label="Star without the flare",
        hint="Spectrum of the same star without the flare, on the same scale and in the same units. It is "
        "subtracted. Nothing: the file holds the flare alone.",
        place=1,
        kind="file",
    )
    wavelength_unit: str | None = unit_of_file("wavelength", "flare", "the flare's files", "Flare")
    flux_unit: str | None = unit_of_file("flux", "flare", "the flare's files", "Flare")
    continue_at_k: fields.Temperature | None = setting(
        None,
        "Temperature of a blackbody that continues the flare's file beyond its ends",
        flag="--continue-at",
        hint="Temperature of a blackbody that continues the flare's spectrum beyond its ends. Nothing: it must "
        "cover what the instrument sees.",
    )
    as_observed: bool = setting(
        False,
        "Take the flare for as bright at the telescope as its file states, in place of amplitudes",
        flag="--as-observed",
        label="As bright as observed",
        hint="Whether the flare has the flux of its file at the telescope, in place of the amplitude above.",
        place=2,
    )

    def _check_values(self) -> None:
        subject = "the spectrum of a flare"
        for key in ("second_temperature_k", "second_area", "balmer_jump"):
            check_one(self, subject, "file", key)
        check_needs(self, subject, FLARE_FILE_KEYS, "file")
        check_all(self, subject, "second_temperature_k", "second_area")
        check_one(self, subject, "balmer_jump", "second_area")
        if self.file is None and self != FlareLight.model_construct():
            self.at_temperature(10_000.0)

    def at_temperature(self, temperature_k: float) -> FlareSpectrum:
        """Return the spectrum at a temperature, which a spectrum from a file ignores."""
        from mauvecl.host.stars import flare as spectra

        light: FlareSpectrum = spectra.Blackbody(temperature_k)
        if self.file is not None:
            units = {"wavelength_unit": self.wavelength_unit, "flux_unit": self.flux_unit}
            with reading_for(self, "flare.spectrum"):
                light = spectra.ObservedFlare.read(self.file, self.quiescent, continue_at_k=self.continue_at_k, **units)
        elif self.second_temperature_k is not None and self.second_area is not None:
            light = spectra.TwoBlackbodies(temperature_k, self.second_temperature_k, self.second_area)
        elif self.balmer_jump is not None:
            light = spectra.BalmerFlare(temperature_k, self.balmer_jump, self.electron_temperature_k)
        if not (self.lines or self.line_fluxes):
            return light
        lines = {name: self.line_scale * fraction for name, fraction in self.lines.items()}
        fluxes = {name: self.line_scale * flux for name, flux in self.line_fluxes.items()}
        return spectra.FlareWithLines(light, lines, fluxes)

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return a copy with another value of one key; raises InputError if the key has no effect."""
        (key,) = path
        if key == "line_scale" and not (self.lines or self.line_fluxes):
            fault = f"line_scale = {value} has no effect on a flare without lines; give lines in flare.spectrum.lines"
            raise InputError(fault, key="line_scale")
        return type(self)(**(self.model_dump() | {key: value}))


def amplitudes_in(path: Path | Any, _: str) -> list[float]:
    """Read the amplitudes of a table of flares, each value once, and warn of columns that are not used."""
    from mauvecl.host.stars.flare import read_flares

    flares = read_flares(path)
    for remark in flares.meta["comments"]:
        warnings.warn(remark, stacklevel=2)
    return sorted({float(value) for value in flares["amplitude"]})


class Flare(Section):
    """Amplitudes, spectrum and geometry of flares."""

    amplitudes: tuple[fields.Amplitude, ...] = setting(
        (0.0076, 0.02, 0.081, 0.24),
        "Flare amplitude; 0.24 is a rise of 24 % in the flare's band",
        min_length=1,
        flag=(
            Flag(
                "--flares",
                kind=Path,
                read=amplitudes_in,
                help=Help("Table of flares with their amplitudes", "CSV, ECSV or FITS, as AltaiPony's ampl_rec"),
            ),
            Flag("--amplitude", "-a"),
        ),
        label="Flare amplitude",
        hint="By how much the flare at its peak brightens the star in the band of the Kepler satellite. In the "
        "ultraviolet the rise is many times as large.",
        name="amplitude_percent",
        first="2",
        unit="%",
        slider=Slider(0.01, 1000, 10**0.1, log=True),
        quantity=("amplitude", "flare amplitude: relative rise of the photons in the flare's band", "flare amplitude"),
    )
    temperature_k: fields.Temperature = setting(
        10_000.0,
        "Flare temperature",
        flag="--flare-temperature",
        hint="The flare shines as a blackbody of this temperature. The hotter, the more of its light is ultraviolet.",
        slider=Slider(5000, 30_000, 500),
        quantity=("flare_temperature", "blackbody temperature of the flare", "flare temperature (K)"),
    )
    band: str = setting("Kepler", "Band of the amplitude", flag="--flare-band", choices=", ".join(ALIASES))
    geometry: Literal["added", "replaces"] = setting(
        "added", "Whether a flare is added to the star or replaces part of its photosphere", flag="--geometry"
    )
    photosphere_temperature_k: fields.Temperature | None = setting(
        None,
        "Temperature of the photosphere that a flare replaces",
        flag="--photosphere-temperature",
        usual="the star's",
    )
    spectrum: FlareLight = FlareLight()

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return a copy with another value; raises InputError for an amplitude of a flare as it was observed."""
        if path[0] == "amplitudes" and self.spectrum.as_observed:
            fault = f"amplitude = {value} has no effect on a flare that is as bright as observed"
            raise InputError(f"{fault}; it needs flare.spectrum.as_observed = false", key="amplitude")
        return super().with_value(path, value)

    def light(self, temperature_k: float | None = None) -> FlareSpectrum:
        """Return the spectrum of a flare, by default at the study's temperature."""
        return self.spectrum.at_temperature(self.temperature_k if temperature_k is None else temperature_k)

    @property
    def is_blackbody(self) -> bool:
        """True if the spectrum is a single blackbody."""
        return self.spectrum == FlareLight()
