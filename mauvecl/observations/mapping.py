"""Quantities of a file's columns, stated in a short TOML file or recognised by name, and the meaning of its times."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import model_validator

from mauvecl.host.arrays import Float
from mauvecl.host.tables import units
from mauvecl.host.tables.files import read_text, toml
from mauvecl.host.tables.names import divided_unit, first_of, is_magnitude, key_of
from mauvecl.host.tables.table import TableFile, Values, convert, unit_in
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.fields import DAY_S, Accepted, Exposure, WholeNumber
from mauvecl.schema.section import Record


class FrameMapping(Record):
    """Places of the quantities of frames in a file, or in the files of a folder.

    A quantity is the name of a column; in FITS files also of an image, or ``EXTENSION/COLUMN``; in a folder of spectra
    also a keyword of each file's header. A pattern such as ``flux_*`` names several columns, one for each pixel.
    """

    #: Extension of a FITS file whose columns are meant; by default the first table.
    hdu: Annotated[str | WholeNumber | None, Accepted("a name or number")] = None
    #: Times, as numbers or ISO 8601 dates; or start and end of each frame; ``wcs`` for the second axis of an image.
    time: Annotated[str | tuple[str, str], Accepted("the name of a column, or of two")]
    time_unit: str | None = None  #: unit of the times, if the file does not state it
    #: Part of the frame that the times refer to; by default the file's TIMEPIXR, or the middle.
    time_at: Literal["middle", "start", "end"] | None = None
    epoch: str | None = None  #: date of time zero: a name of `EPOCHS_MJD`, or an ISO 8601 date
    scale: str = ""  #: time scale, such as utc or tdb
    position: str = ""  #: place at which the times hold, as in FITS: TOPOCENTER, GEOCENTER or BARYCENTER
    #: The light: rate, counts or flux density, in any linear unit, one value or one spectrum per frame. If a column
    #: of wavelengths has as many rows, each row is one pixel of one frame.
    flux: str
    flux_unit: str | None = None  #: unit of the light, if the file does not state it
    error: str | None = None  #: standard errors of the light
    #: Flags of frames, or of each pixel; those with a bit of `quality_bits` are not searched.
    quality: str | None = None
    #: Bits of the quality that exclude a frame: their sum, "all", "none", or names and numbers such as "Desat, 128". By
    #: default lightkurve's default for Kepler and K2, the same without ImpulsiveOutlier for TESS, and all for others.
    quality_bits: Annotated[str | WholeNumber | None, Accepted("text or a whole number")] = None
    exposure: str | None = None  #: exposure times of the frames
    exposure_s: Exposure | None = None  #: exposure time of every frame
    exposure_unit: str | None = None  #: unit of the exposure times, if the file does not state it
    temperature: str | None = None  #: temperatures of the detector
    temperature_unit: str | None = None  #: unit of the temperatures, if the file does not state it
    #: Wavelengths of spectra; ``wcs`` for those of an image's header, ``names`` for numbers in names of columns.
    wavelength: str | None = None
    #: Unit of the wavelengths, which may end in " air", if the file does not state it.
    wavelength_unit: str | None = None
    #: File of the wavelengths, relative to the mapping; `wavelength` names its column if it has several.
    wavelength_file: str | None = None
    #: Table of the spectra in a folder, relative to it, with times and other quantities of each.
    table: str | None = None
    #: In a folder: names of the spectra, with ``*`` for any text; with `table`, its column of the files' names.
    files: str | None = None
    name: str | None = None  #: of the star

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.scale and units.scale_of(self.scale) not in units.SCALES.values():
            raise InputError.of("scale", self.scale, f"one of {', '.join(sorted(set(units.SCALES.values())))}")
        is_given = [self.exposure is not None, self.exposure_s is not None, not isinstance(self.time, str)]
        if sum(is_given) > 1:
            fault = "the exposure time is given twice; give only one of exposure, exposure_s and two columns of time"
            raise InputError(fault, key="exposure")
        if self.time_at is not None and not isinstance(self.time, str):
            raise InputError("time_at needs one column of times, not those of start and end", key="time_at")
        return self

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a mapping from a TOML file."""
        path = Path(path)
        keys = toml(read_text(path, "mapping"), f"mapping {shortened(path.name)}")
        if isinstance(keys.get("wavelength_file"), str):
            keys["wavelength_file"] = str(path.parent / keys["wavelength_file"])
        return cls(**keys)

    @property
    def times(self) -> tuple[str, ...]:
        """Names of the times: one, or start and end."""
        return (self.time,) if isinstance(self.time, str) else self.time

    @property
    def epoch_mjd(self) -> float | None:
        """Modified Julian date of time zero, or None if unknown."""
        if self.epoch is None:
            return None
        if self.epoch.lower() in units.EPOCHS_MJD:
            return units.EPOCHS_MJD[self.epoch.lower()]
        from mauvecl.host.exposure.background import parse_time

        with units.offline():
            try:
                return float(parse_time(self.epoch).mjd)
            except InputError as error:
                expected = f"one of {', '.join(units.EPOCHS_MJD)}, or a date such as 2026-03-01T12:00:00"
                raise InputError.of("epoch", self.epoch, expected) from error


#: Names of columns that need no mapping, in order of preference, in any case: those of mauvecl, of the pipelines of
#: Kepler, K2 and TESS, of lightkurve and AltaiPony, and of K2SFF, QLP, eleanor, TASOC and gPhoton.
COLUMN_NAMES = {
    "time": ("time",),
    "flux": ("flux_bgsub", "flux", "pdcsap_flux", "sap_flux", "kspsap_flux", "det_flux", "corr_flux", "corrected_flux",
             "fcor", "flux_corr", "detrended_flux", "rate", "rel_flux", "relative_flux", "normalized_flux",
             "norm_flux", "flux_norm", "flux_normalized", "rel_flux_t1", "ujy", "count_rate", "countrate", "cps",
             "counts", "cal_aper_flux", "whitelight_flux"),
    "quality": ("quality", "sap_quality"),
    "temperature": ("temperature",),
}  # fmt: skip
#: Names of times where no column is called time and none is named after its dates, such as BJD.
OTHER_TIMES = ("t", "date", "datetime", "timestamp", "date-obs", "date_obs", "utc", "ut")
#: Places in a frame that times refer to, as a part of its exposure.
PLACES_IN_FRAME = {"start": 0.0, "middle": 0.5, "end": 1.0}
#: Dates of observed light, MJD, from 1845 to 2269.
DATES_MJD = (-5000.0, 150_000.0)
#: Columns of files that state no unit of their times, these times, and words for them: Gaia DR3's epoch photometry, BJD
#: in TCB less 2455197.5 (documentation of vari_epoch_photometry), and GALEX, Unix time less 315964800 s (user guide of
#: gPhoton), with the columns of gPhoton's light curves.
TIMES_OF_COLUMNS = (
    ({"transit_id", "rejected_by_photometry"}, units.TimeSystem("d", 55_197.0, "tcb", "BARYCENTER"),
     "days from 2010-01-01 in TCB, as in Gaia DR3's epoch photometry"),
    ({"t0", "t1", "cps", "cps_err"}, units.TimeSystem("s", units.EPOCHS_MJD["gps"], "utc"),
     "seconds from 1980-01-06 in UTC, as in GALEX light curves of gPhoton"),
)  # fmt: skip
#: Extension of the light curves of CHEOPS. UTC in its header is that of the start and the end of a visit;
#: BJD_TIME is in TT: pycheops 1.1.14, documentation of `Dataset`.
CHEOPS = "SCI_COR_LIGHTCURVE"
#: Expected content of a cell of times, for messages.
DATE = "a number or a date such as 2026-03-01T12:00:00"


def recognised(file: TableFile, flux: str | None = None) -> FrameMapping:
    """Return the mapping of a file whose columns have known names, by default of the first known column of light."""
    file.check_choice()
    # FITS files also have images, and columns of other extensions, which do not count.
    names = [*file.columns, *(name for name in file.names if "/" not in name and name not in file.columns)]
    columns: dict[str, Any] = {key: first_of(usual, names, file.label) for key, usual in COLUMN_NAMES.items()}
    columns["flux"] = flux or columns["flux"]
    if columns["time"] is None:
        times = {name: time for name in names if (time := units.time_in_name(name)) is not None}
        dated = [name for name, time in times.items() if time.epoch_mjd is not None]
        for place in ("BARYCENTER", "HELIOCENTER"):
            # Barycentric dates are preferred; heliocentric ones differ from them by seconds.
            dated = [name for name in dated if times[name].position == place] or dated
        if len(dated) > 1:
            named = ", ".join(map(shortened, dated))
            fault = f"{file.label}: {len(dated)} columns may be the time; give a mapping that names one of {named}"
            raise InputError(fault, key="time")
        timed = [name for name in times if re.match(r"t(?:ime)?[\s_.]", name, re.IGNORECASE)]
        columns["time"] = dated[0] if dated else first_of((*OTHER_TIMES, *timed), names, file.label)
    if columns["time"] is None:
        edges = tuple(first_of((name,), names, file.label) for name in ("t0", "t1"))
        columns["time"] = None if None in edges else edges
    flux = divided_unit(columns["flux"] or "")[0]
    # Errors of another flux would be wrong.
    ends = ("_err", "_error", "err", "_e", "_unc", "_uncertainty", "_sigma", "_std")
    errors = [f"{flux}{end}" for end in ends] + [f"{start}{flux}" for start in ("e_", "err_", "sigma_", "sig_", "d")]
    errors += [flux.lower().replace("flux_", "flux_err_")] if "flux_" in flux.lower() else []
    columns["error"] = first_of((*errors, "error", "err", "uncertainty", "unc", "sigma"), names, file.label)
    if columns["flux"] is None and (magnitudes := [name for name in names if is_magnitude(name)]):
        fault = f"{file.label} has magnitudes ({', '.join(map(shortened, magnitudes))}) and no column of linear light"
        remedy = "give light in a linear unit, in a column named flux or that a mapping names"
        raise InputError(f"{fault}; {remedy}", key="flux")
    if columns["time"] is None or columns["flux"] is None:
        fault = f"{file.label} must have columns named time and flux, or a mapping that names them"
        raise InputError(f"{fault}, but has the columns {shortened(', '.join(file.names), 300)}", key="mapping")
    if "SPECTRUM" in file.names and "WAVELENGTH/WAVELENGTH" in file.names:
        columns |= {"flux": "SPECTRUM", "error": "SPECTRUM_ERR", "wavelength": "WAVELENGTH/WAVELENGTH"}
    return FrameMapping(**{key: value for key, value in columns.items() if value is not None})


def times_of(
    time: tuple[Values, ...], file: TableFile, mapping: FrameMapping
) -> tuple[Float, Float | None, units.TimeSystem, tuple[str, ...]]:
    """Return the times of frames, s, exposure times if their edges are given, the system of the times, and remarks.

    Between two edges, the time is the middle; another one refers to the part of the frame that the system states. Dated
    times count from the first, which is the epoch of the system, others from the zero of the file.
    """
    import astropy.units as u

    label, header = file.label, _stated_system(time, file)
    scale = units.scale_of(mapping.scale) or header.scale
    position = units.position_of(mapping.position) or header.position
    epoch, remarks = mapping.epoch_mjd, []
    texts = [values.texts() for values in time]
    if all(cells is not None and any(map(units.is_dated, cells)) for cells in texts):
        scale, unit, epoch, offset = scale or header.default_scale or "utc", u.d, 0.0, 0.0
        edges = [units.mjd_of(cells or [], scale, values.name, label)
                 for cells, values in zip(texts, time, strict=True)]  # fmt: skip
        if not (mapping.scale or header.scale or header.default_scale):
            remarks.append(f"the dates of {label} state no time scale and are assumed to be in UTC")
    else:
        edges = [values.numbers(DATE).ravel() for values in time]
        column, remarks = _time_unit(time, edges[0], file, mapping, header)
        unit = u.Unit(column.unit)
        offset = header.offset_in(unit, label)
        scale, position = scale or column.scale or header.default_scale, position or column.position
        epoch = next((mjd for mjd in (epoch, header.epoch_mjd, column.epoch_mjd) if mjd is not None), None)
    extension = str(file.header.get("EXTNAME", "")).upper()
    if extension.startswith(CHEOPS) and position == "BARYCENTER" and not mapping.scale:
        scale, dates = "tt", "as in all files of CHEOPS; UTC is the scale of its other dates"
        remarks.append(f"{time[0].name} of {label} is in TT, {dates}")
    exposure = None if len(edges) == 1 else np.asarray(((edges[1] - edges[0]) * unit).to_value(u.s))
    middles = np.mean(edges, axis=0) + offset
    finite = middles[np.isfinite(middles)]
    first = float(finite.min()) if finite.size else 0.0
    # Days since a date far in the past lose digits as seconds: subtract before the unit is changed.
    seconds, first_d = np.asarray(((middles - first) * unit).to_value(u.s)), float((first * unit).to_value(u.s)) / DAY_S
    if epoch is not None and mapping.epoch is None and not DATES_MJD[0] < epoch + first_d < DATES_MJD[1]:
        span = " and ".join(f"{float(edge):g}" for edge in (np.nanmin(edges[0]), np.nanmax(edges[0])))
        remarks.append(f"the times of {label} have no date, although their unit, name or header says so: {span}")
        epoch = None
    if epoch is None:
        seconds = seconds + first_d * DAY_S
    else:
        epoch = epoch + first_d
    place = 0.5 if len(edges) == 2 else PLACES_IN_FRAME.get(mapping.time_at or "", header.at)
    return seconds, exposure, replace(header, epoch_mjd=epoch, scale=scale, position=position, at=place), tuple(remarks)


def _stated_system(time: tuple[Values, ...], file: TableFile) -> units.TimeSystem:
    """Return the time system that a header and the columns of times state; raise InputError if these differ."""
    if any(values.keywords != time[0].keywords for values in time):
        names = " and ".join(values.name for values in time)
        raise InputError(f"{file.label}: {names} must be in one time system", key="time")
    return units.TimeSystem.of(file.header | {**time[0].keywords}, file.label)


def _time_unit(
    time: tuple[Values, ...], values: Float, file: TableFile, mapping: FrameMapping, header: units.TimeSystem
) -> tuple[units.TimeSystem, list[str]]:
    """Return the unit and the zero of times, as the mapping, the column, its name or the header states them."""
    if len({column.stated_unit for column in time}) > 1 and not mapping.time_unit:
        names = " and ".join(repr(column.name) for column in time)
        raise InputError(f"{file.label}: {names} must have the same unit, but have different units", key="time")
    text, named = mapping.time_unit or time[0].stated_unit, units.time_in_name(time[0].name)
    system = units.time_unit(text) if text else named
    if system is None and (text := text or header.unit) and (system := units.time_unit(text)) is None:
        # Checks the unit; times keep theirs, so that long times lose no digits.
        convert(replace(time[0], unit=text), None, "s", "time_unit")
        system = units.TimeSystem(str(unit_in(text)))
    remarks = list[str]()
    if system is None:
        keys, mission = {*map(key_of, file.columns)}, units.mission_of(file.header)
        if usual := [(times, words) for columns, times, words in TIMES_OF_COLUMNS if columns <= keys]:
            system, text = usual[0]
        else:
            finite = values[np.isfinite(values)]
            if not (mission and finite.size and 0 < float(np.median(finite)) < 20_000):
                convert(time[0], None, "s", "time_unit")
            name = units.MISSIONS[mission or "TESS"].upper()
            system, text = units.time_unit(name) or units.TimeSystem("d"), f"{name}, days, as in files of {mission}"
        remarks = [f"ASSUMED: the times of {file.label} are {text}; it states no unit"]
    elif system.epoch_mjd is None and named is not None and named.unit == system.unit:
        system = named
    epoch, of_header = system.epoch_mjd, header.epoch_mjd
    if mapping.epoch is None and epoch is not None and of_header is not None and abs(epoch - of_header) > 1e-5:
        fault = f"{file.label}: {time[0].name!r} counts from MJD {epoch:g} by its unit or name and from {of_header:g}"
        raise InputError(f"{fault} by its header; give one epoch, or a mapping with epoch", key="epoch")
    return system, remarks
