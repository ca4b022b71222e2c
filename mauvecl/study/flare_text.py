"""The spectrum of a study's flare as data; `host.stars.flare_spectra` computes it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import Field, model_validator

from mauvecl.host.errors import InputError
from mauvecl.study.part import Part

if TYPE_CHECKING:
    from mauvecl.host.stars.flare_spectra import FlareSpectrum

#: What only a spectrum from a file has, beside `file` itself.
OF_FILE = ("quiescent", "wavelength_unit", "flux_unit", "continue_at_k")
#: What only a blackbody has.
OF_BLACKBODY = ("second_temperature_k", "second_area", "balmer_jump")
#: Files that a study names; relative to its folder.
FILES = ("file", "quiescent")


class FlareLight(Part):
    """The light of a flare: one blackbody of `flare.temperature_k` unless something else is given.

    Attributes
    ----------
    balmer_jump : float, optional
        Flux just below the Balmer edge over that just above.
    electron_temperature_k : float
        Of the Balmer continuum.
    second_temperature_k, second_area : float, optional
        A second blackbody, and its area over that of the first.
    lines, line_fluxes : dict
        Fluxes of lines by name or wavelength in nm: as a fraction of the continuum's flux in 200-700 nm, or at the
        telescope in erg s-1 cm-2.
    line_scale : float
        Factor of all lines.
    file, quiescent : Path, optional
        Spectrum of a flare, and of its star without it, which is subtracted.
    wavelength_unit, flux_unit : str, optional
        Override what these files state.
    continue_at_k : float, optional
        Temperature of a blackbody that continues the file's spectrum where it ends.
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
        given = [key for key in OF_BLACKBODY if getattr(self, key) is not None]
        if self.file is not None and given:
            raise ValueError(f"a flare's spectrum has file and {given[0]}, expected one of them")
        own = [key for key in OF_FILE if getattr(self, key) is not None]
        if self.file is None and own:
            raise ValueError(f"a flare's spectrum has {own[0]} without a file, expected both or neither")
        if (self.second_temperature_k is None) != (self.second_area is None):
            raise ValueError(
                "a flare's spectrum has only one of second_temperature_k and second_area, expected both or neither"
            )
        if self.balmer_jump is not None and self.second_area is not None:
            raise ValueError("a flare's spectrum has balmer_jump and second_area, expected one of them")
        if self.file is None and self != FlareLight.model_construct():
            self.form(10_000.0)
        return self

    def form(self, temperature_k: float) -> FlareSpectrum:
        """Return the spectrum of a flare of a temperature, K, which that of a file has not.

        Raises
        ------
        InputError
            For a value that cannot be, or a file that holds no spectrum.
        """
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
        """Return the spectrum with one key changed.

        Raises
        ------
        InputError
            For a value that cannot be with the others, or one that changes nothing.
        """
        if key == "line_scale" and not (self.lines or self.line_fluxes):
            raise InputError(f"line_scale = {value} of a flare without lines, expected some in flare.spectrum.lines")
        return type(self)(**(self.model_dump() | {key: value}))

    @property
    def _lines(self) -> tuple[dict[str, float], dict[str, float]]:
        return self.lines, self.line_fluxes


def find_spectrum_files(data: dict[str, Any], folder: Path) -> None:
    """Put the folder of a study before the names of its flare's files."""
    flare = data.get("flare")
    spectrum = flare.get("spectrum") if isinstance(flare, dict) else None
    if isinstance(spectrum, dict):
        for key in FILES:
            if isinstance(spectrum.get(key), str):
                spectrum[key] = str(folder / spectrum[key])


def without_usual_spectrum(data: dict[str, Any], light: FlareLight) -> None:
    """Leave out of a study's text what it does not say of the flare's spectrum; files by their full names."""
    if light == FlareLight():
        del data["flare"]["spectrum"]
        return
    spectrum = data["flare"]["spectrum"]
    for key in ("lines", "line_fluxes"):
        if not spectrum[key]:
            del spectrum[key]
    for key in FILES:
        if key in spectrum:
            spectrum[key] = str(Path(spectrum[key]).resolve())
