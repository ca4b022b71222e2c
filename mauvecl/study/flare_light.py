"""Study section for the spectrum of a flare; `host.stars.flare_spectra` computes the spectrum."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import Field, model_validator

from mauvecl.schema.errors import InputError
from mauvecl.schema.section import Section

if TYPE_CHECKING:
    from mauvecl.host.stars.flare_spectra import FlareSpectrum

#: Keys, other than `file`, that only apply to a spectrum from a file.
FILE_KEYS = ("quiescent", "wavelength_unit", "flux_unit", "continue_at_k")
#: Keys that do not apply to a spectrum from a file.
BLACKBODY_KEYS = ("second_temperature_k", "second_area", "balmer_jump")
#: Keys that hold paths, relative to the folder of the study file.
PATH_KEYS = ("file", "quiescent")


class FlareLight(Section):
    """Spectrum of a flare; by default a blackbody of `flare.temperature_k`.

    Attributes
    ----------
    balmer_jump : float, optional
        Ratio of the flux just below the Balmer edge to the flux just above it.
    electron_temperature_k : float
        Electron temperature of the Balmer continuum.
    second_temperature_k, second_area : float, optional
        Temperature of a second blackbody, and the ratio of its area to that of the first.
    lines, line_fluxes : dict
        Line fluxes by name or wavelength in nm: as a fraction of the continuum flux in 200-700 nm, or at the telescope
        in erg s-1 cm-2.
    line_scale : float
        Factor applied to all line fluxes.
    file, quiescent : Path, optional
        Spectrum of the star during a flare, and its quiescent spectrum, which is subtracted.
    wavelength_unit, flux_unit : str, optional
        Units of these files; override the units that the files state.
    continue_at_k : float, optional
        Temperature of a blackbody that extends the spectrum of the file.
    """

    balmer_jump: Annotated[float, Field(ge=1, le=100)] | None = None
    electron_temperature_k: float = 10_000.0
    second_temperature_k: float | None = None
    second_area: Annotated[float, Field(ge=0)] | None = None
    lines: dict[str, Annotated[float, Field(ge=0)]] = Field(default_factory=dict)
    line_fluxes: dict[str, Annotated[float, Field(ge=0)]] = Field(default_factory=dict)
    line_scale: Annotated[float, Field(ge=0)] = 1.0
    file: Path | None = None
    quiescent: Path | None = None
    wavelength_unit: str | None = None
    flux_unit: str | None = None
    continue_at_k: float | None = None

    @model_validator(mode="after")
    def _one_model(self) -> Self:
        given = [key for key in BLACKBODY_KEYS if getattr(self, key) is not None]
        if self.file is not None and given:
            raise ValueError(f"a flare's spectrum has file and {given[0]}, expected one of them")
        own = [key for key in FILE_KEYS if getattr(self, key) is not None]
        if self.file is None and own:
            raise ValueError(f"a flare's spectrum has {own[0]} without a file, expected both or neither")
        if (self.second_temperature_k is None) != (self.second_area is None):
            raise ValueError(
                "a flare's spectrum has only one of second_temperature_k and second_area, expected both or neither"
            )
        if self.balmer_jump is not None and self.second_area is not None:
            raise ValueError("a flare's spectrum has balmer_jump and second_area, expected one of them")
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

    def with_value(self, key: str, value: Any) -> Self:
        """Return a copy with one key changed; raises InputError if the key has no effect."""
        if key == "line_scale" and not (self.lines or self.line_fluxes):
            raise InputError(
                f"line_scale = {value} has no effect on a flare without lines, expected lines in flare.spectrum.lines"
            )
        return type(self)(**(self.model_dump() | {key: value}))

    @property
    def _lines(self) -> tuple[dict[str, float], dict[str, float]]:
        return self.lines, self.line_fluxes


def resolve_spectrum_paths(data: dict[str, Any], folder: Path) -> None:
    """Resolve the paths of the flare's files against a folder, in place."""
    flare = data.get("flare")
    spectrum = flare.get("spectrum") if isinstance(flare, dict) else None
    if isinstance(spectrum, dict):
        for key in PATH_KEYS:
            if isinstance(spectrum.get(key), str):
                spectrum[key] = str(folder / spectrum[key])


def drop_default_spectrum(data: dict[str, Any], light: FlareLight) -> None:
    """Remove default values of the flare's spectrum from a study's data and make its paths absolute, in place."""
    if light == FlareLight():
        del data["flare"]["spectrum"]
        return
    spectrum = data["flare"]["spectrum"]
    for key in ("lines", "line_fluxes"):
        if not spectrum[key]:
            del spectrum[key]
    for key in PATH_KEYS:
        if key in spectrum:
            spectrum[key] = str(Path(spectrum[key]).resolve())
