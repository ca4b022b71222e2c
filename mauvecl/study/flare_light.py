"""Study section for the spectrum of a flare; `host.stars.flare_spectra` computes the spectrum."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import Field, model_validator

from mauvecl.schema import parsing
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Quantity, Range, Unit, Widget
from mauvecl.schema.physical import AreaRatio, BalmerJump, LineFraction, LineScale, Temperature
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    from mauvecl.host.stars.flare_spectra import FlareSpectrum

#: Keys, other than `file`, that only apply to a spectrum from a file.
FILE_KEYS = ("quiescent", "wavelength_unit", "flux_unit", "continue_at_k", "as_observed")
#: Keys that do not apply to a spectrum from a file.
BLACKBODY_KEYS = ("second_temperature_k", "second_area", "balmer_jump")
#: Keys that hold paths, relative to the folder of the study file.
PATH_KEYS = ("file", "quiescent")


class FlareLight(Section):
    """Spectrum of a flare; by default a blackbody of `flare.temperature_k`."""

    balmer_jump: Annotated[
        BalmerJump | None,
        Help("Ratio of the flare's flux just below the Balmer edge to that just above", default="1"),
        Flag("--balmer-jump"),
        Widget(
            label="Balmer jump",
            hint="Flux just below 364.6 nm over that just above, by hydrogen recombination: 1 to 4 in most flares. "
            "Nothing: a plain blackbody.",
            group="Flare's spectrum",
        ),
        Quantity(
            "balmer_jump", "flux of the flare just below the Balmer edge over that just above", "Balmer jump ratio"
        ),
    ] = None
    electron_temperature_k: Annotated[Temperature, Help("Electron temperature of the Balmer continuum")] = 10_000.0
    second_temperature_k: Annotated[
        Temperature | None,
        Help("Temperature of a second blackbody of the flare", "needs its area"),
        Flag("--second-temperature"),
        Widget(
            label="Second temperature",
            hint="A second blackbody in the flare, instead of a Balmer jump. Nothing: there is none.",
            group="Flare's spectrum",
        ),
        Quantity("second_temperature", "temperature of the flare's second blackbody", "second temperature (K)"),
    ] = None
    second_area: Annotated[
        AreaRatio | None,
        Help("Area of the second blackbody over that of the first"),
        Flag("--second-area"),
        Widget(
            label="Second area",
            hint="Area at the second temperature over that at the first, if there is one.",
            group="Flare's spectrum",
            first="0.05",
        ),
        Quantity("second_area", "area of the flare's second blackbody over that of the first", "second area"),
    ] = None
    lines: Annotated[
        dict[str, LineFraction],
        Help(
            "Emission line as a fraction of the continuum in 200-700 nm, by name or wavelength in nm",
            "as in 'Mg II=0.05'",
        ),
        Flag("--line", kind=list[str], read=parsing.line_fluxes),
    ] = Field(default_factory=dict)
    line_fluxes: Annotated[
        dict[str, Annotated[float, Unit("erg / (s cm2)"), Range(0)]],
        Help("Emission line at the telescope, by name or wavelength in nm", "as in '280=1e-12'"),
        Flag("--line-flux", kind=list[str], read=parsing.line_fluxes),
    ] = Field(default_factory=dict)
    line_scale: Annotated[
        LineScale,
        Help("Factor on all line fluxes"),
        Quantity("line_scale", "factor of all line fluxes of the flare", "line fluxes"),
    ] = 1.0
    file: Annotated[
        Path | None,
        Help("Spectrum file of an observed or computed flare"),
        Flag("--flare-file"),
        Widget(
            label="Own flare spectrum",
            hint="Spectrum of an observed or computed flare without its star, in place of a blackbody. The amplitude "
            "scales it.",
            group="Flare's spectrum",
            name="flare_file",
            place=2,
            kind="file",
        ),
    ] = None
    quiescent: Annotated[
        Path | None,
        Help("Spectrum file of its star without the flare, which is subtracted"),
        Flag("--flare-quiescent"),
        Widget(
            label="Star without the flare",
            hint="Spectrum of the same star without the flare, on the same scale and in the same units. It is "
            "subtracted. Nothing: the file holds the flare alone.",
            group="Own flare",
            name="flare_quiescent",
            place=1,
            kind="file",
        ),
    ] = None
    wavelength_unit: Annotated[
        str | None,
        Help("Unit of the wavelengths of the flare's files"),
        Flag("--flare-wavelength-unit"),
        Widget(
            label="Flare: unit of wavelengths",
            hint="Such as Angstrom or Angstrom air. Nothing: what the file says.",
            group="Own flare",
            name="flare_wavelength_unit",
            suggestions=("nm", "Angstrom", "um", "nm air", "Angstrom air"),
        ),
    ] = None
    flux_unit: Annotated[
        str | None,
        Help("Unit of the fluxes of the flare's files"),
        Flag("--flare-flux-unit"),
        Widget(
            label="Flare: unit of fluxes",
            hint="Such as W m-2 nm-1 or Jy. Nothing: what the file says.",
            group="Own flare",
            name="flare_flux_unit",
            suggestions=("erg s-1 cm-2 Angstrom-1", "W m-2 nm-1", "Jy"),
        ),
    ] = None
    continue_at_k: Annotated[
        Temperature | None,
        Help("Temperature of a blackbody that continues the flare's file beyond its ends"),
        Flag("--continue-at"),
        Widget(
            label="Continue at",
            hint="Temperature of a blackbody that continues the flare's spectrum beyond its ends. Nothing: it must "
            "cover what the instrument sees.",
            group="Own flare",
        ),
    ] = None
    as_observed: Annotated[
        bool,
        Help("Take the flare for as bright at the telescope as its file states, in place of amplitudes"),
        Flag("--as-observed"),
        Widget(
            label="As bright as observed",
            hint="Whether the flare has the flux of its file at the telescope, in place of the amplitude above.",
            group="Own flare",
            place=2,
        ),
    ] = False

    @model_validator(mode="after")
    def _one_model(self) -> Self:
        given = [key for key in BLACKBODY_KEYS if getattr(self, key) is not None]
        if self.file is not None and given:
            raise InputError(f"the spectrum of a flare needs either file or {given[0]}, but has both", key="file")
        own = [key for key in FILE_KEYS if getattr(self, key)]
        if self.file is None and own:
            raise InputError(f"the spectrum of a flare has {own[0]}, which needs a file as well", key=own[0])
        if (self.second_temperature_k is None) != (self.second_area is None):
            raise InputError(
                "the spectrum of a flare needs both second_temperature_k and second_area, or neither, but has only one",
                key="second_area",
            )
        if self.balmer_jump is not None and self.second_area is not None:
            raise InputError(
                "the spectrum of a flare needs either balmer_jump or second_area, but has both", key="balmer_jump"
            )
        if self.file is None and self != FlareLight.model_construct():
            self.at_temperature(10_000.0)
        return self

    def at_temperature(self, temperature_k: float) -> FlareSpectrum:
        """Return the spectrum at a temperature, which a spectrum from a file ignores."""
        from mauvecl.host.stars.flare_spectra import (
            BalmerFlare,
            Blackbody,
            FlareWithLines,
            ObservedFlare,
            TwoBlackbodies,
        )

        light: FlareSpectrum = Blackbody(temperature_k)
        if self.file is not None:
            light = ObservedFlare.read(
                self.file,
                self.quiescent,
                wavelength_unit=self.wavelength_unit,
                flux_unit=self.flux_unit,
                continue_at_k=self.continue_at_k,
            )
        elif self.second_temperature_k is not None and self.second_area is not None:
            light = TwoBlackbodies(temperature_k, self.second_temperature_k, self.second_area)
        elif self.balmer_jump is not None:
            light = BalmerFlare(temperature_k, self.balmer_jump, self.electron_temperature_k)
        if not (self.lines or self.line_fluxes):
            return light
        scaled = ({name: self.line_scale * value for name, value in each.items()} for each in self._lines)
        return FlareWithLines(light, *scaled)

    def with_value(self, path: Sequence[str], value: Any) -> Self:
        """Return a copy with another value of one key; raises InputError if the key has no effect."""
        (key,) = path
        if key == "line_scale" and not (self.lines or self.line_fluxes):
            raise InputError(
                f"line_scale = {value} has no effect on a flare without lines",
                "lines in flare.spectrum.lines",
                key="line_scale",
            )
        return type(self)(**(self.model_dump() | {key: value}))

    @property
    def _lines(self) -> tuple[dict[str, float], dict[str, float]]:
        return self.lines, self.line_fluxes


def drop_default_spectrum(data: dict[str, Any], light: FlareLight) -> None:
    """Remove default values of the flare's spectrum from a study's data, in place."""
    if light == FlareLight():
        del data["flare"]["spectrum"]
        return
    spectrum = data["flare"]["spectrum"]
    for key in ("lines", "line_fluxes"):
        if not spectrum[key]:
            del spectrum[key]
