"""Mapping from the columns of a file to frames, as a short TOML file that a user writes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import model_validator

from mauvecl.host.tables.files import read_text, toml
from mauvecl.host.tables.units import EPOCHS_MJD, SCALES, offline, scale_of
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.physical import Exposure
from mauvecl.schema.section import Record


class FrameMapping(Record):
    """Places of the quantities of frames in a file, or in the files of a folder.

    A quantity is the name of a column; in FITS files also of an image, or ``EXTENSION/COLUMN``; in a folder of spectra
    also a keyword of each file's header. A pattern such as ``flux_*`` names several columns, one for each pixel.

    Attributes
    ----------
    hdu : str or int, optional
        Extension of a FITS file whose columns are meant; by default the first table.
    time : str or (str, str)
        Times, as numbers or ISO 8601 dates; or start and end of each frame; ``wcs`` for the second axis of an image.
    time_unit : str, optional
        Unit of the times, if the file does not state it.
    time_at : {"middle", "start", "end"}, optional
        Part of the frame that the times refer to; by default the file's TIMEPIXR, or the middle.
    epoch : str, optional
        Date of time zero: a name of `EPOCHS_MJD`, or an ISO 8601 date.
    scale : str, optional
        Time scale, such as utc or tdb.
    position : str, optional
        Place at which the times hold, as in FITS: TOPOCENTER, GEOCENTER or BARYCENTER.
    flux : str
        The light: rate, counts or flux density, with any linear unit, one value or one spectrum for each frame. If a
        column of wavelengths has as many rows, each row is one pixel of one frame.
    flux_unit : str, optional
        Unit of the light, if the file does not state it.
    error, quality, exposure, temperature : str, optional
        Frames with a bit of `quality_bits` in their quality are not searched; neither are pixels with one, where there
        is one for each pixel.
    quality_bits : str or int, optional
        Bits of the quality that exclude a frame: their sum, "all", "none", or names and numbers such as "Desat, 128".
        By default lightkurve's default for Kepler and K2, the same without ImpulsiveOutlier for TESS, and all bits for
        other files.
    exposure_s : float, optional
        Exposure time of every frame.
    exposure_unit, temperature_unit, wavelength_unit : str, optional
        Units, if the file does not state them. A unit of wavelength may end in " air".
    wavelength : str, optional
        Wavelengths of spectra; ``wcs`` for those in the header of an image, ``names`` for numbers in names of columns.
    wavelength_file : str, optional
        File of the wavelengths, relative to the mapping; `wavelength` names its column if it has several.
    table : str, optional
        Table of the spectra in a folder, relative to it, with times and other quantities of each.
    files : str
        In a folder: names of the spectra, with ``*`` for any text; with `table`, its column of the files' names.
    name : str, optional
        Name of the star.
    """

    hdu: str | int | None = None
    time: str | tuple[str, str]
    time_unit: str | None = None
    time_at: Literal["middle", "start", "end"] | None = None
    epoch: str | None = None
    scale: str = ""
    position: str = ""
    flux: str
    flux_unit: str | None = None
    error: str | None = None
    quality: str | None = None
    quality_bits: str | int | None = None
    exposure: str | None = None
    exposure_s: Exposure | None = None
    exposure_unit: str | None = None
    temperature: str | None = None
    temperature_unit: str | None = None
    wavelength: str | None = None
    wavelength_unit: str | None = None
    wavelength_file: str | None = None
    table: str | None = None
    files: str | None = None
    name: str | None = None

    @model_validator(mode="after")
    def _known_scale(self) -> Self:
        if self.scale and scale_of(self.scale) not in SCALES.values():
            raise InputError.of("scale", self.scale, f"one of {', '.join(sorted(set(SCALES.values())))}")
        return self

    @model_validator(mode="after")
    def _one_exposure(self) -> Self:
        given = [self.exposure is not None, self.exposure_s is not None, not isinstance(self.time, str)]
        if sum(given) > 1:
            raise InputError(
                "the exposure time is given twice", "only one of exposure, exposure_s and two columns of time",
                key="exposure",
            )  # fmt: skip
        return self

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a mapping from a TOML file."""
        path = Path(path)
        given = toml(read_text(path, "mapping"), f"mapping {shortened(path.name)}")
        if isinstance(given.get("wavelength_file"), str):
            given["wavelength_file"] = str(path.parent / given["wavelength_file"])
        return cls(**given)

    @property
    def times(self) -> tuple[str, ...]:
        """Names of the times: one, or start and end."""
        return (self.time,) if isinstance(self.time, str) else self.time

    @property
    def epoch_mjd(self) -> float | None:
        """Modified Julian date of time zero, or None if unknown."""
        if self.epoch is None:
            return None
        if self.epoch.lower() in EPOCHS_MJD:
            return EPOCHS_MJD[self.epoch.lower()]
        from mauvecl.host.exposure.sky import parse_time

        with offline():
            try:
                return float(parse_time(self.epoch).mjd)
            except InputError as error:
                expected = f"one of {', '.join(EPOCHS_MJD)}, or a date such as 2026-03-01T12:00:00"
                raise InputError.of("epoch", self.epoch, expected) from error
