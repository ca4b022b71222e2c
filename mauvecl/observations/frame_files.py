"""Frames of tables in files, whole or piece by piece, with a mapping of their columns."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.arrays import Float
from mauvecl.host.stars.columns import words_of
from mauvecl.host.tables.files import check_content, parsing, without_columns
from mauvecl.host.tables.fits_tables import FitsTables
from mauvecl.host.tables.names import first_of, is_magnitude, is_missing, key_of
from mauvecl.host.tables.opening import open_table
from mauvecl.host.tables.table import MemoryTable, TableFile, Values, convert, unit_in, without_indefinite
from mauvecl.host.tables.units import counts_unit, is_dated, unit_and_medium, vacuum_wavelengths
from mauvecl.observations import stored_frames as stored
from mauvecl.observations.frames import ALL_BITS, MAX_FRAMES, Frames, QualityBits
from mauvecl.observations.mapping import COLUMN_NAMES, FrameMapping, recognised, times_of
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, shortened

FORMATS = "give FITS, HDF5, ECSV, CSV, a Zarr store or a folder of spectra"
#: Columns of bands and stars; a light curve has one band and one star.
GROUPS = ("band", "filter", "filt", "passband", "bandpass", "filtercode", "phot_filter", "source_id", "tic",
          "tic_id", "ticid", "kic", "kepid", "epic", "object", "target", "star", "f")  # fmt: skip
#: Words in the names of flags, which exclude frames only if they are called quality or a mapping names them.
FLAGS = {"flag", "flags", "rejected", "quality", "qual", "dq", "status", "event", "mask"}
#: Units in which light is given as a deviation from its level, as TASOC does.
PARTS_OF_LEVEL = {"%": 1e-2, "percent": 1e-2, "ppt": 1e-3, "ppm": 1e-6, "ppb": 1e-9}
#: Smallest ratio of a level to its standard error from which it is above zero.
MIN_LEVEL_SNR = 5.0


@validated
def read_frames(
    path: str | Path,
    mapping: FrameMapping | str | Path | None = None,
    *,
    quality_bits: str | int | None = None,
    ignore_checksum: bool = False,
    raw: bool = False,
) -> Frames:
    """Read frames from a file or a folder.

    Spectra that take more memory than `MAUVECL_LARGEST_CONTENT_MIB` are reduced to their sum over wavelength while
    they are read; a remark says so, and `reduce_frames` reduces them with other weights.

    Parameters
    ----------
    path : str or Path
        FITS, HDF5, ECSV or CSV, packed or not; a Zarr store; or a folder of spectra. ``FILE[name]`` names an extension,
        or an array of a store.
    mapping : FrameMapping or path, optional
        Places of the quantities. Files of mauvecl, TESS, Kepler and lightkurve need none.
    quality_bits : str or int, optional
        Bits of the quality that exclude a frame, as in the mapping, over which they have precedence.
    ignore_checksum : bool
        Whether FITS files are read that their CHECKSUM or DATASUM contradicts.
    raw : bool
        Whether spectra of `mauvecl realise` keep bias and dark current, which are subtracted otherwise. Others are as
        their file has them.
    """
    with _open_frames(path, mapping, check=not ignore_checksum, raw=raw) as (file, mapping, name):
        if quality_bits is not None:
            mapping = mapping.model_copy(update={"quality_bits": quality_bits})
        return _frames_in(file, _quantities(file, mapping), mapping, name)


def frames_of(container: Any, mapping: FrameMapping | None = None, *, time: Any = None) -> Frames:
    """Build frames from a container of another package.

    Parameters
    ----------
    container : Table, TimeSeries, LightCurve or Spectrum
        A table, time series or light curve of astropy or lightkurve; or spectra such as those of specutils, with
        the attributes ``flux`` of shape (n_frame, n_pixel), ``spectral_axis``, ``uncertainty`` and ``mask``.
    mapping : FrameMapping, optional
        Places of the quantities of a table; columns with known names need none.
    time : Time, optional
        Middles of the frames, for spectra.
    """
    import astropy.units as u
    from astropy.nddata import StdDevUncertainty
    from astropy.table import Table

    if not hasattr(container, "colnames"):
        names = ("flux", "spectral_axis")
        if not all(hasattr(container, name) for name in names) or time is None or len(container.flux.shape) != 2:
            raise InputError.of("container", type(container).__name__, "a table with times, or spectra of shape "
                                "(n_frame, n_pixel) with flux, spectral_axis and `time`")  # fmt: skip
        masked, uncertainty = (getattr(container, name, None) for name in ("mask", "uncertainty"))
        flux = np.ma.MaskedArray(container.flux.value, False if masked is None else masked)
        nm = container.spectral_axis.to_value("nm", equivalencies=u.spectral())
        columns: dict[str, Any] = {"time": time, "flux": flux, "wavelength": np.tile(nm, (len(flux), 1))}
        if uncertainty is not None:
            columns["error"] = np.asarray(uncertainty.represent_as(StdDevUncertainty).array, np.float64)
        units = {"flux": container.flux.unit, "wavelength": "nm"}
        container = Table(columns, meta=dict(container.meta or {}), units=units)
        mapping = FrameMapping(**dict(zip(columns, columns, strict=True)))
    file = MemoryTable(container, type(container).__name__)
    mapping = mapping or recognised(file)
    return _frames_in(file, _quantities(file, mapping), mapping, str(container.meta.get("LABEL", "frames")))


@dataclass(frozen=True, eq=False)
class ReducedFrames:
    """Spectra reduced to weighted sums."""

    light_curves: tuple[Frames, ...]  #: one for each row of the weights
    pixels: stored.PixelStatistics  #: light and noise of each pixel of the file


@validated
def reduce_frames(
    path: str | Path, weights: ArrayLike | None = None, mapping: FrameMapping | str | Path | None = None
) -> ReducedFrames:
    """Read spectra in pieces and keep weighted sums of their pixels, however large the file is.

    Parameters
    ----------
    path : str or Path
        As for `read_frames`.
    weights : array_like, shape (n_weight, n_pixel), optional
        Weights of the pixels, in the order of the file; by default the sum over all pixels.
    mapping : FrameMapping or path, optional
    """
    with _open_frames(path, mapping) as (file, mapping, name):
        quantities = _quantities(file, mapping)
        _, flux, error, _ = _linear_light(quantities, mapping)
        if len(flux.shape) != 2:
            raise InputError.of("flux", flux.shape, "spectra, shape (n_frame, n_pixel)", where=file.label)
        bits = QualityBits.of(file.header, mapping.quality_bits, file.label)
        lights, pixels = stored.weighted_sums(flux, error, _excluding_bits(quantities.get("quality"), bits), weights)
        return ReducedFrames(tuple(_frames_in(file, quantities, mapping, name, light) for light in lights), pixels)


@dataclass(frozen=True)
class ColumnNames:
    """Names of the columns of a file of frames, some of which a mapping names."""

    names: tuple[str, ...]

    @classmethod
    def read(cls, path: str | Path) -> ColumnNames:
        """Read the names of a table in a file."""
        place, words = without_columns(path)
        with parsing(f"file {place.name!r}", FORMATS), _open_file(place, words[0] if words else None) as file:
            return cls(tuple(file.names))


@contextmanager
def _open_frames(
    path: str | Path, mapping: FrameMapping | str | Path | None, check: bool = True, raw: bool = False
) -> Iterator[tuple[TableFile, FrameMapping, str]]:
    """Open a file, folder or store; yield it with the mapping of its quantities and its name without extension.

    Without a mapping, it is that of a store or of the names of columns. Spectra of a store include bias and dark
    current if they are `raw`.
    """
    with parsing(f"file {shortened(Path(path).name)}", FORMATS):
        place, words = without_columns(path)
        mapping = FrameMapping.read(mapping) if isinstance(mapping, str | Path) else mapping
        name = words[0] if words else None if mapping is None or mapping.hdu is None else str(mapping.hdu)
        label = f"folder {place.name!r}"
        opened: AbstractContextManager[TableFile]
        if not place.is_dir():
            opened = _open_file(place, name, mapping, check, large=True)
        elif (place / "zarr.json").is_file():
            opened = stored.open_stored(place, label, name)
        elif mapping is None:
            fault = f"{label} is not a store of spectra; give a mapping that says where its quantities are"
            raise InputError(fault, key="mapping")
        else:
            open_file = partial(_open_file, name=name, check=check)
            opened = nullcontext(stored.FolderFile(place, mapping, label, open_file))
        with opened as file:
            _check_selection(file, words)
            if mapping is None:
                mapping = file.mapping(raw) if isinstance(file, stored.StoredFile) else recognised(file)
            yield file, mapping, place.stem


def _check_selection(file: TableFile, words: tuple[str, ...]) -> None:
    """Raise InputError for words in brackets that do not select one part of a file.

    An extension or array that does not exist, or has no columns, is refused when the file is read.
    """
    has_parts = isinstance(file, FitsTables | stored.StoredFile | stored.FolderFile)
    if len(words) > int(has_parts):
        remedy = "give one extension or array" if has_parts else "give the file alone, which has a single table"
        part = shortened(",".join(words))
        raise InputError(f"{file.label}: {part} in brackets selects no single part of it; {remedy}", key="hdu")


def _open_file(
    path: Path, name: str | None, mapping: FrameMapping | None = None, check: bool = True, large: bool = False
) -> AbstractContextManager[TableFile]:
    """Open the extension or array `name` of a file; only `large` files may exceed MAUVECL_LARGEST_FILE_MIB.

    Without a name, it is the first table with the times of the mapping, or with usual names of times and fluxes.
    """
    # The table has a column of each group of names.
    usual = [COLUMN_NAMES["time"], COLUMN_NAMES["flux"]]
    groups = usual if mapping is None else [(title,) for title in mapping.times]

    def of_fits(hdus: Any, label: str) -> TableFile:
        return stored.stored_in_fits(FitsTables(hdus, label), name) or FitsTables(hdus, label, name, groups)

    of_hdf5 = partial(stored.open_stored, name=name)
    return open_table(path, f"file {path.name!r}", check=check, large=large, of_fits=of_fits, of_hdf5=of_hdf5)


#: Columns, arrays and values of a file by the quantities of its mapping; two times of a frame are "time" and "end".
Quantities = dict[str, Values]


def _quantities(file: TableFile, mapping: FrameMapping) -> Quantities:
    """Find the quantities of a mapping, and check their rows before any is read."""
    quantities = {key: file.axis(mapping.flux, 2) if name == "wcs" else file.find(name)
             for key, name in zip(("time", "end"), mapping.times, strict=False)}  # fmt: skip
    names = {key: getattr(mapping, key) for key in ("flux", "error", "quality", "exposure", "temperature")}
    quantities |= {key: file.find(name) for key, name in names.items() if name is not None}
    if (nm := _wavelength(file, mapping)) is not None:
        quantities["wavelength"], rows = nm, quantities["flux"].n_rows
        if nm.shape == quantities["flux"].shape == quantities["time"].shape and not isinstance(file, stored.FolderFile):
            check_content(32 * rows, f"{file.label} has {rows} rows of pixels, which need 32 bytes each and at most")
            quantities = _with_row_per_frame(_with_numeric_flags(quantities), file.label)
    _check_rows(file, quantities)
    return _with_numeric_flags(quantities)


def _with_row_per_frame(quantities: Quantities, label: str) -> Quantities:
    """Return the quantities of a long table with a row for each frame; errors and flags for each pixel."""
    frames, frame = np.unique(_keys(quantities["time"]), return_inverse=True)
    pixels, pixel = np.unique(quantities["wavelength"].numbers(), return_inverse=True)
    number = frame * pixels.size + pixel
    counts = np.bincount(number, minlength=frames.size * pixels.size).reshape(frames.size, pixels.size)
    if (counts != 1).any():
        row, column = np.argwhere(counts != 1)[0]
        fault = f"{label}: the frame at {frames[row]} must have one row of wavelength {pixels[column]:g}"
        raise InputError(f"{fault}, not {counts[row, column]}", key="wavelength")
    place, by_frame = np.argsort(number).reshape(counts.shape), {}
    for key, values in quantities.items():
        if key in ("flux", "error", "quality"):
            rows = values.numbers()[place]
        elif key == "wavelength":
            rows = pixels
        else:
            rows = _keys(values)[place]
            if (rows != rows[:, :1]).any():
                raise InputError(f"{label}: {values.name!r} must not change within a frame", key=values.name)
            rows = rows[:, 0]
        by_frame[key] = replace(Values.of(values.name, rows, values.unit, label), keywords=values.keywords)
    return by_frame


def _keys(values: Values) -> NDArray[Any]:
    """Return numbers, or the texts of dates."""
    texts = values.texts()
    return np.asarray(values.numbers() if texts is None or not any(map(is_dated, texts)) else texts)


def _with_numeric_flags(quantities: Quantities) -> Quantities:
    """Return flags of frames as numbers, also those of words and those that lightkurve 2 writes into CSV."""
    quality = quantities.get("quality")
    # Flags of pixels are left as they are.
    if quality is None or len(quality.shape) != 1:
        return quantities
    texts = [text.lower() for text in quality.texts() or ()]
    # ASAS-SN has the flags G and B.
    words = {"true": 1, "false": 0, "bad": 1, "good": 0, "b": 1, "g": 0}
    if texts and {*texts} <= {*words}:
        flags = np.array([words[text] for text in texts])
    else:
        values, place = np.unique(quality.numbers(), return_inverse=True)
        digits = {value: f"{value:.0f}" for value in values[np.isfinite(values)].tolist()}
        if max(digits, default=0.0) >= 2**32 and {*"".join(digits.values())} <= {"0", "1"}:
            # Flags of lightkurve are the digits of binary numbers.
            values = np.array([float(int(digits[flag], 2)) if flag in digits else flag for flag in values.tolist()])
        flags = values[place]
    return quantities | {"quality": Values.of(quality.name, flags, label=quality.label)}


def _wavelength(file: TableFile, mapping: FrameMapping) -> Values | None:
    if mapping.wavelength_file is not None:
        with _open_file(Path(mapping.wavelength_file), None) as table:
            if mapping.wavelength is None and len(table.names) != 1:
                fault = f"{table.label}: no column of wavelengths is named"
                raise InputError(f"{fault}; give one of {', '.join(table.names)}", key="wavelength")
            column = table.find(mapping.wavelength or table.names[0])
            return Values.of(column.name, column.numbers().ravel(), column.unit, column.label)
    if mapping.wavelength is None:
        return None
    if mapping.wavelength == "wcs":
        return file.axis(mapping.flux, 1)
    if mapping.wavelength == "names":
        return file.wavelengths_in_names(mapping.flux)
    return file.find(mapping.wavelength)


def _check_rows(file: TableFile, quantities: Quantities) -> None:
    """Raise InputError unless all columns have one row, or spectrum, for each frame, before any is read."""
    label, n, flux = file.label, quantities["time"].n_rows, quantities["flux"]
    if not 0 < n <= MAX_FRAMES:
        expected = f"at most {MAX_FRAMES} frames, but has {n}" if n else "a row for each frame, but has no rows"
        raise InputError(f"{label} must have {expected}", key="frames")
    columns = [file.find(name) for name in file.columns if key_of(name) in GROUPS and "wavelength" not in quantities]
    for column in (column for column in columns if len(column.shape) == 1):
        name, texts = column.name, column.texts()
        cells = map(str, np.unique(column.numbers())) if texts is None else texts
        groups = sorted({cell for cell in cells if not is_missing(cell)})
        # The filter of ATLAS is called F, as is the light of others.
        if len(groups) > 1 and (key_of(name) != "f" or all(map(str.isalpha, groups))):
            fault = f"{label} must hold the light of one star in one band, but has rows of {len(groups)} different"
            raise InputError(f"{fault} {name!r} ({shortened(', '.join(groups), 80)}); divide the table", key="flux")
    for key, values in quantities.items():
        if key != "wavelength" and values.n_rows != n:
            fault = f"{label}: {values.name!r} must have {n} rows, as the times do, but has {values.n_rows}"
            raise InputError(fault, key=values.name)
    single = ("time", "end") if "wavelength" in quantities else ("time", "end", "flux")
    for values in (quantities[key] for key in single if key in quantities):
        if len(values.shape) == 2 and values.shape[1] > 1:
            fault = f"{label}: {values.name!r} holds {values.shape[1]} values in each row"
            raise InputError(f"{fault}; give one, or name wavelengths in a mapping", key=values.name)
    if len(flux.shape) > 2:
        pixels = " x ".join(map(str, flux.shape[1:]))
        fault = f"{label}: {flux.name!r} holds images of {pixels} pixels, as target pixel files do"
        raise InputError(f"{fault}; give a light curve, such as lightkurve's `to_lightcurve` makes", key="flux")


def _conditions(
    file: TableFile, quantities: Quantities, mapping: FrameMapping, exposure: Float | None
) -> dict[str, Any]:
    """Return exposure times, by default between edges, and temperatures, by columns, the mapping or the header."""
    n, nominal = quantities["time"].n_rows, file.header.get("CCD-TEMP")
    temperature = np.full(n, float(nominal)) if isinstance(nominal, int | float) else None
    try:
        # The header of BRITE's light curves has milliseconds for each image of a stack.
        nominal_s = 1e-3 * float(file.header["ObsExpoT"]) * float(file.header.get("ObsStack", 1.0))
    except (KeyError, ValueError):
        nominal_s = 0.0
    if "exposure" in quantities:
        exposure = convert(quantities["exposure"], mapping.exposure_unit, "s", "exposure_unit").numbers().reshape(n)
    elif 0.0 < (seconds := mapping.exposure_s or nominal_s) < np.inf:
        exposure = np.full(n, seconds)
    if "temperature" in quantities:
        celsius = convert(quantities["temperature"], mapping.temperature_unit, "deg_C", "temperature_unit")
        temperature = celsius.numbers().reshape(n)
    return {"exposure_s": exposure, "temperature_c": temperature}


def _relative_to_level(light: Float, sd: Float | None, unit: str) -> tuple[Float, Float | None, str, list[str]]:
    """Return light and errors, as multiples of the level if they are deviations from it in parts, and remarks."""
    finite = np.sort(light[np.isfinite(light)])
    finite, remarks = finite[finite.size // 100 : finite.size - finite.size // 100], list[str]()
    if not finite.size:
        return light, sd, unit, remarks
    level, share = float(finite.mean()), PARTS_OF_LEVEL.get(unit.lower())
    # A tenth of the light of a star is not below zero.
    if share is not None and finite[finite.size // 10] < 0.0:
        remarks = [f"its light is a deviation from its level in {unit}, and is read as a multiple of the level"]
        return 1.0 + share * light, None if sd is None else share * sd, "", remarks
    if not level > MIN_LEVEL_SNR * float(finite.std()) / np.sqrt(finite.size):
        cause = "not significantly above zero, as after a level or an image is subtracted"
        effect = "amplitudes and equivalent durations relative to it mean nothing"
        remarks = [f"the mean of its light is {level:.3g}, {cause}: {effect}"]
    return light, sd, unit, remarks


def _frames_in(
    file: TableFile, quantities: Quantities, mapping: FrameMapping, name: str, reduced: stored.Light | None = None
) -> Frames:
    """Build frames from a file and its quantities; with `reduced` light, which is not read again.

    They have the `name` unless the mapping or the header states one.
    """
    label, header = file.label, file.header
    edges = tuple(quantities[key] for key in ("time", "end") if key in quantities)
    time, between_edges_s, system, remarks = times_of(edges, file, mapping)
    by_frame = _conditions(file, quantities, mapping, between_edges_s)
    bits = QualityBits.of(header, mapping.quality_bits, label)
    nm = None if "wavelength" not in quantities else _vacuum_nm(quantities["wavelength"], mapping, file)
    light, sd, flags, unit, more = _read_light(file, quantities, mapping, bits, reduced)
    has_time = np.isfinite(time)
    if not has_time.any():
        raise InputError(f"{label}: at least one row must have a time, but none has", key="time")
    remarks += more
    if n_left := int(np.count_nonzero(~has_time)):
        words = "1 row has no time and was" if n_left == 1 else f"{n_left} rows have no time and were"
        remarks += (f"{label}: {words} left out",)
    quality = None if flags is None else np.where(np.isfinite(flags), flags, bits.mask & -bits.mask)
    by_frame |= {"error": sd, "quality": quality}
    frames = Frames.of(
        time[has_time], light[has_time],
        **{key: None if column is None else column[has_time] for key, column in by_frame.items()},
        quality_mask=bits.mask, mission=bits.mission, wavelength_nm=nm if light.ndim == 2 else None, unit=unit,
        name=mapping.name or str(header.get("OBJECT", "") or header.get("star", "") or name),
        instrument=str(header.get("INSTRUME", "") or header.get("TELESCOP", "")).strip(),
        reference_mjd=system.epoch_mjd, scale=system.scale, position=system.position,
        direction_deg=system.direction_deg, net=isinstance(file, stored.StoredFile) and mapping.flux != "raw",
    )  # fmt: skip
    if system.at != 0.5:
        frames = frames.shifted((0.5 - system.at) * frames.exposure_s)
    return frames.with_remarks((*remarks, *bits.remarks(frames.quality, frames.name)))


def _read_light(
    file: TableFile, quantities: Quantities, mapping: FrameMapping, bits: QualityBits, reduced: stored.Light | None
) -> tuple[Float, Float | None, Float | None, str, tuple[str, ...]]:
    """Return light, errors, flags, the unit of the light, and remarks."""
    unit, flux, error, remarks = _linear_light(quantities, mapping)
    light, sd, flags, more = reduced or stored.read_light(flux, error, _excluding_bits(quantities.get("quality"), bits))
    if "wavelength" not in quantities:
        light, sd = light.ravel(), None if sd is None else sd.ravel()
    sd = None if sd is None else without_indefinite(sd)
    notes, unused = [*file.remarks], [name for name in file.columns if FLAGS & {*words_of(name)}]
    if "quality" not in quantities and unused:
        notes.append(f"no flags are used; a mapping with quality names one of {', '.join(unused)}")
    if len(light.shape) == 1:
        light, sd, unit, on_level = _relative_to_level(light, sd, unit)
        notes += on_level
        if not np.isfinite(light).any():
            raise _without_light(file, flux.name)
    remarks += (*more, *(f"{file.label}: {text}" for text in notes))
    if sd is not None and not np.isfinite(sd).any():
        # lightkurve writes a column of NaN for errors that it does not know.
        sd = None
        remarks += (f"{file.label} has a column of errors without a number: it is left out",)
    if "quality" in quantities and len(quantities["quality"].shape) == 1:
        flags = quantities["quality"].numbers()
    return light, sd, flags, unit, remarks


def _without_light(file: TableFile, flux: str) -> InputError:
    """Return the error of a column of light without a number, with the mapping of another column of light."""
    usual = (first_of((name,), file.columns, file.label) for name in COLUMN_NAMES["flux"])
    columns = (file.find(name) for name in usual if name is not None and name != flux)
    others = [column.name for column in columns if np.isfinite(column.numbers()).any()]
    remedy = "give a column of light in a mapping with flux"
    if others:
        keys = recognised(file, others[0]).model_dump(mode="json", exclude_unset=True)
        remedy = f"give a mapping such as {', '.join(f'{key} = {value!r}' for key, value in keys.items())}"
    return InputError(f"{file.label}: {flux!r} holds no finite number; {remedy}", key="flux")


def _excluding_bits(quality: Values | None, bits: QualityBits) -> Values | None:
    """Return quality flags without the bits that do not exclude a frame or a pixel."""
    if quality is None or bits.mask == ALL_BITS:
        return quality
    return quality.mapped(lambda flags: np.where(np.isfinite(flags), bits.mask & flags.astype(np.int64), flags), "")


def _linear_light(quantities: Quantities, mapping: FrameMapping) -> tuple[str, Values, Values | None, tuple[str, ...]]:
    """Return the unit of the light, light and errors in it, and remarks; raise InputError if it is not linear."""
    flux, error, remarks = quantities["flux"], quantities.get("error"), tuple[str, ...]()
    file_unit = flux.stated_unit
    unit = mapping.flux_unit or file_unit
    if file_unit and unit != file_unit:
        remarks = (f"the unit of {flux.name!r} is {mapping.flux_unit} as the mapping says, not {file_unit}",)
    if not unit and (is_magnitude(flux.name) or {*words_of(flux.name)} & {"log", "ln", "dex"}):
        remedy = "convert magnitudes and logarithms first, or name a linear unit as flux_unit in a mapping"
        raise InputError.of("flux", flux.name, f"linear light: {remedy}", where=flux.label)
    if re.match(r"\s*(?:dex|log|db)\b", unit, re.IGNORECASE) or ("mag" in unit.lower() and "magg" not in unit.lower()):
        expected = "a linear unit: light in magnitudes must be converted first"
        raise InputError.of("flux_unit", unit, expected, where=flux.label)
    if error is None:
        return unit, flux, None, remarks
    named, error_unit = f"{error.label}: {error.name!r}", error.stated_unit
    if error.shape != flux.shape:
        fault = f"{named} must have the shape of the flux, {flux.shape}, not {error.shape}"
        raise InputError(fault, key="error")
    if error_unit and not unit and error_unit.lower() in PARTS_OF_LEVEL:
        remedy = "give errors in the unit of the light, or flux_unit = '1' in a mapping if its level is 1"
        raise InputError(f"{named} is in {error_unit}, and {flux.name!r} is not; {remedy}", key="error")
    if error_unit and unit and error_unit not in (unit, file_unit):
        try:
            of_error, of_light = (counts_unit(text) or unit_in(text) for text in (error_unit, unit))
            factor = float(of_error.to(of_light))
        except (ValueError, TypeError) as cause:
            fault = f"{named} must have a unit like that of {flux.name!r}, {unit}, not {error_unit}"
            raise InputError(fault, key="error") from cause
        error = error.mapped(lambda values: values * factor, unit)
    return unit, flux, error, remarks


def _vacuum_nm(wavelength: Values, mapping: FrameMapping, file: TableFile) -> Float:
    """Return the wavelengths of the pixels in vacuum, which must be the same in every frame."""
    unit, medium = unit_and_medium(mapping.wavelength_unit or "")
    stated_unit, stated_medium = unit_and_medium(wavelength.unit)
    nm = convert(replace(wavelength, unit=stated_unit or ""), unit, "nm", "wavelength_unit")
    by_frame = len(nm.shape) == 2
    pixels = nm.rows(slice(0, 1))[0] if by_frame else nm.numbers().ravel()
    if by_frame and not all(np.allclose(nm.rows(piece), pixels, rtol=1e-9, atol=0.0) for piece in nm.pieces):
        fault = f"{wavelength.label}: the wavelengths must be the same in every frame, but change"
        raise InputError(fault, key="wavelength")
    return vacuum_wavelengths(pixels, wavelength.name, "", medium or stated_medium, (file.header,))[0]
