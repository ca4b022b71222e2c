"""Mapping from the columns of a file to frames, as a short TOML file that a user writes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import model_validator

from mauvecl.host.files.parsing import read_text, toml
from mauvecl.schema.errors import InputError
from mauvecl.schema.records import Record
from mauvecl.schema.text import shortened

#: Epochs by name, as modified Julian dates: of TESS and Kepler (their archive manuals), GPS and Unix seconds.
EPOCHS_MJD = {
    "mjd": 0.0,
    "jd": -2_400_000.5,
    "bjd": -2_400_000.5,
    "btjd": 56_999.5,
    "bkjd": 54_832.5,
    "gps": 44_244.0,
    "unix": 40_587.0,
}


class FrameMapping(Record):
    """Where the quantities of frames are in a file.

    Attributes
    ----------
    hdu : str or int, optional
        Extension of a FITS file; by default the first table that has the columns.
    time : str or (str, str)
        Column of times, or two columns with start and end of each frame.
    time_unit : str, optional
        Unit of the times, if the file does not state it.
    time_at : {"middle", "start", "end"}
        Part of the frame that the times refer to.
    epoch : str, optional
        Date of time zero: a name of `EPOCHS_MJD`, or an ISO 8601 date.
    scale : str, optional
        Time scale, such as utc or tdb.
    position : str, optional
        Place at which the times hold, as in FITS: TOPOCENTER, GEOCENTER or BARYCENTER.
    flux : str
        Column of the light: rate, counts or flux density, with any unit. In a file of spectra, the column or HDU that
        holds one spectrum per frame.
    flux_unit : str, optional
        Unit of the light, if the file does not state it.
    error, quality, exposure, temperature, wavelength : str, optional
        Columns or, for images, HDUs. Frames with a quality other than zero are not searched.
    exposure_s : float, optional
        Exposure time of every frame.
    wavelength_unit : str, optional
    name : str, optional
        Name of the star.
    """

    hdu: str | int | None = None
    time: str | tuple[str, str]
    time_unit: str | None = None
    time_at: Literal["middle", "start", "end"] = "middle"
    epoch: str | None = None
    scale: str = ""
    position: str = ""
    flux: str
    flux_unit: str | None = None
    error: str | None = None
    quality: str | None = None
    exposure: str | None = None
    exposure_s: float | None = None
    temperature: str | None = None
    wavelength: str | None = None
    wavelength_unit: str | None = None
    name: str | None = None

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
        what = f"mapping {shortened(path.name)}"
        return cls(**toml(read_text(path, "mapping"), what))

    @property
    def epoch_mjd(self) -> float | None:
        """Modified Julian date of time zero, or None if unknown."""
        if self.epoch is None:
            return None
        if self.epoch.lower() in EPOCHS_MJD:
            return EPOCHS_MJD[self.epoch.lower()]
        from mauvecl.host.sky.helioecliptic import offline, parse_time

        with offline():
            return float(parse_time(self.epoch).mjd)
