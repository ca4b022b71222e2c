"""Study section for the calibration of an instrument."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

from pydantic import model_validator

from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, Help, Range, Widget
from mauvecl.schema.physical import DetectorTemperature, Magnitude
from mauvecl.schema.section import Section
from mauvecl.study.sections import Star

if TYPE_CHECKING:
    from mauvecl.host.stars.source import Source


class CalibrationObservation(Section):
    """Raw frames of a standard star, or of no light if neither `library` nor `spectrum` is given."""

    frames: Annotated[Path, Help("File of raw frames, DN with bias and dark")]
    mapping: Annotated[Path | None, Help("Where time, flux and temperature are in that file (TOML)")] = None
    library: Annotated[str | None, Help("Name of the standard star in the library")] = None
    spectrum: Annotated[Path | None, Help("File with the spectrum of the standard star, such as CALSPEC's")] = None
    magnitude: Annotated[Magnitude | None, Help("Magnitude", default="that of the spectrum")] = None
    band: Annotated[str, Help("Band of the magnitude")] = "V"
    temperature_c: Annotated[
        DetectorTemperature | None, Help("Detector temperature, where the frames do not state it")
    ] = None

    @model_validator(mode="after")
    def _one_star(self) -> Self:
        if self.library is not None and self.spectrum is not None:
            raise InputError("an observation has both library and spectrum", "one of them, or none for dark frames",
                             key="spectrum", value=self.spectrum)  # fmt: skip
        if self.magnitude is not None and self.library is None and self.spectrum is None:
            raise InputError.of("magnitude", self.magnitude, "library or spectrum of the star as well")
        return self

    def source(self) -> Source | None:
        """Load the spectrum of the star at its brightness; None for frames without light."""
        if self.library is None and self.spectrum is None:
            return None
        return Star(library=self.library, file=self.spectrum, magnitude=self.magnitude, band=self.band).source()


#: Keys of an observation that hold paths.
PATHS = tuple(
    name for name, field in CalibrationObservation.model_fields.items() if field.annotation in (Path, Path | None)
)


class CalibrateQuestion(Section):
    """Observations from which `calibrate` fits an instrument."""

    observations: Annotated[
        tuple[CalibrationObservation, ...],
        Help("Observations of standard stars and of no light"),
        Widget(
            label="Observations",
            hint="A zip archive: a TOML file with [[calibrate.observations]], as for the command line, and the frames, "
            "mappings and spectra that it names.",
            group="Standards",
            kind="upload",
        ),
    ] = ()
    knots: Annotated[
        int,
        Range(4, 200),
        Help("Intervals of the spline of the throughput"),
        Flag("--knots"),
        Widget(
            label="Intervals of the throughput",
            hint="Intervals of the spline that describes the throughput: more of them follow narrower features, with "
            "larger errors.",
            group="Standards",
        ),
    ] = 100
    light_error: Annotated[
        float,
        Range(0, 1),
        Help("Relative error of the light of an observation, by pointing"),
        Flag("--light-error"),
        Widget(
            label="Error of the light",
            hint="By how much the light of an observation differs, by pointing.",
            group="Standards",
            unit="%",
            scale=100.0,
        ),
    ] = 0.0
    spectrum_error: Annotated[
        Annotated[float, Range(0, 1)] | None,
        Help("Relative error of the spectra of the stars, at each of 12 wavelengths",
             default="0.1 for one star, fitted for several if they disagree"),
        Flag("--spectrum-error"),
        Widget(
            label="Error of the spectra",
            hint="Error of the stars' spectra, at each of 12 wavelengths. Empty: 10 % for one star, fitted if several "
            "disagree.",
            group="Standards",
            unit="%",
            scale=100.0,
        ),
    ] = None  # fmt: skip
