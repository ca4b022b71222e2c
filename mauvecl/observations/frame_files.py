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
from mauvecl.host.tables.files import limit_bytes, parsing, without_columns
from mauvecl.host.tables.fits_tables import FitsTables
from mauvecl.host.tables.names import is_magnitude, is_missing, key_of
from mauvecl.host.tables.opening import open_table
from mauvecl.host.tables.table import (
    MemoryTable,
    TableFile,
    Values,
    converted,
    marks_in,
    unit_in,
    unit_in_name,
    without_indefinite,
)
from mauvecl.host.tables.units import is_dated, unit_and_medium, vacuum_wavelengths
from mauvecl.observations.frames import ALL_BITS, MAX_FRAMES, Frames, QualityBits
from mauvecl.observations.mapping import KNOWN, FrameMapping, recognised, times_of
from mauvecl.observations.stored_frames import (
    FolderFile,
    Light,
    PixelStatistics,
    StoredFile,
    open_stored,
    stored_in_fits,
    weighted_sums,
    whole_or_reduced,
)
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, shortened

FORMATS = "give FITS, HDF5, ECSV, CSV, a Zarr store or a folder of spectra"
#: Columns of bands and of stars, of which a light curve has one.
GROUPS = ("band", "filter", "filt", "passband", "bandpass", "filtercode", "phot_filter", "source_id", "tic",
          "tic_id", "ticid", "kic", "kepid", "epic", "object", "target", "star", "f")  # fmt: skip
#: Words in the names of flags, which exclude frames only if they are called quality or a mapping names them.
FLAGS = {"flag", "flags", "rejected", "quality", "qual", "dq", "status", "event", "mask"}
#: Units in which light is given as a deviation from its level, as TASOC does.
PARTS_OF_LEVEL = {"%": 1e-2, "percent": 1e-2, "ppt": 1e-3, "ppm": 1e-6, "ppb": 1e-9}
#: Standard errors by which a level is above zero.
SURE = 5.0


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
    with _frame_file(path, mapping, check=not ignore_checksum) as (file, how, stem):
        if raw and mapping is None and isinstance(file, StoredFile):
            how = file.mapping(raw=True)
        if quality_bits is not None:
            how = how.model_copy(update={"quality_bits": quality_bits})
        return _frames_in(file, _quantities(file, how), how, stem)


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
    pixels: PixelStatistics  #: light and noise of each pixel of the file


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
    with _frame_file(path, mapping) as (file, how, stem):
        found = _quantities(file, how)
        _, flux, error, _ = _light(found, how)
        if len(flux.shape) != 2:
            raise InputError.of("flux", flux.shape, "spectra, shape (n_frame, n_pixel)", where=file.what)
        quality = _masked(found.get("quality"), QualityBits.of(file.header, how.quality_bits, file.what))
        lights, pixels = weighted_sums(flux, error, quality, weights)
        return ReducedFrames(tuple(_frames_in(file, found, how, stem, light) for light in lights), pixels)


@dataclass(frozen=True)
class ColumnNames:
    """Names of the columns of a file of frames, some of which a mapping names."""

    names: tuple[str, ...]

    @classmethod
    def read(cls, path: str | Path) -> ColumnNames:
        """Read the names of a table in a file."""
        place, words = without_columns(path)
        what = f"file {place.name!r}"
        with parsing(what, FORMATS), _opened(place, what, words[0] if words else None) as file:
            return cls(tuple(file.names))


@contextmanager
def _frame_file(
    path: str | Path, mapping: FrameMapping | str | Path | None, check: bool = True
) -> Iterator[tuple[TableFile, FrameMapping, str]]:
    """Open a file, folder or store; yield it with the places of its quantities and its name without extension."""
    with parsing(f"file {shortened(Path(path).name)}", FORMATS):
        place, words = without_columns(path)
        how = FrameMapping.read(mapping) if isinstance(mapping, str | Path) else mapping
        name = words[0] if words else None if how is None or how.hdu is None else str(how.hdu)
        what = f"{'folder' if place.is_dir() else 'file'} {place.name!r}"
        opened: AbstractContextManager[TableFile]
        if not place.is_dir():
            opened = _opened(place, what, name, how, check, large=True)
        elif (place / "zarr.json").is_file():
            opened = open_stored(place, what, name)
        elif how is None:
            fault = f"{what} is not a store of spectra; give a mapping that says where its quantities are"
            raise InputError(fault, key="mapping")
        else:
            open_one = partial(_opened, name=name, check=check)
            opened = nullcontext(FolderFile(place, how, what, lambda one: open_one(one, f"file {one.name!r}")))
        with opened as file:
            yield file, how or (file.mapping() if isinstance(file, StoredFile) else recognised(file)), place.stem


def _opened(
    path: Path, what: str, name: str | None, how: FrameMapping | None = None, check: bool = True, large: bool = False
) -> AbstractContextManager[TableFile]:
    """Open a file with frames; only `large` ones may exceed MAUVECL_LARGEST_FILE_MIB."""
    # Groups of names, of each of which the chosen table has one.
    wanted = (KNOWN["time"], KNOWN["flux"]) if how is None else tuple((each,) for each in how.times)

    def of_fits(hdus: Any, what: str) -> TableFile:
        return stored_in_fits(FitsTables(hdus, what), name) or FitsTables(hdus, what, name, wanted)

    return open_table(path, what, check=check, large=large, of_fits=of_fits, of_hdf5=partial(open_stored, name=name))


#: Columns, arrays and values of a file by the quantities of its mapping; two times of a frame are "time" and "end".
Quantities = dict[str, Values]


def _quantities(file: TableFile, mapping: FrameMapping) -> Quantities:
    """Find the quantities of a mapping, and check their rows before any is read."""
    found = {key: file.axis(mapping.flux, 2) if name == "wcs" else file.find(name)
             for key, name in zip(("time", "end"), mapping.times, strict=False)}  # fmt: skip
    names = {key: getattr(mapping, key) for key in ("flux", "error", "quality", "exposure", "temperature")}
    found |= {key: file.find(name) for key, name in names.items() if name is not None}
    if (nm := _wavelength(file, mapping)) is not None:
        found["wavelength"], rows = nm, found["flux"].n_rows
        if nm.shape == found["flux"].shape == found["time"].shape and not isinstance(file, FolderFile):
            limit = "MAUVECL_LARGEST_CONTENT_MIB"
            if 32 * rows > (most := limit_bytes(limit)):
                fault = f"{file.what} must have at most {most // 32} rows of pixels, but has {rows}"
                raise InputError(f"{fault}; {limit} sets the limit", key=limit)
            found = _of_frames(_with_flags(found), file.what)
    _check_rows(file, found)
    return _with_flags(found)


def _of_frames(found: Quantities, what: str) -> Quantities:
    """Return the quantities of a long table with a row for each frame; errors and flags for each pixel."""
    frames, frame = np.unique(_keys(found["time"]), return_inverse=True)
    pixels, pixel = np.unique(found["wavelength"].numbers(), return_inverse=True)
    number = frame * pixels.size + pixel
    counts = np.bincount(number, minlength=frames.size * pixels.size).reshape(frames.size, pixels.size)
    if (counts != 1).any():
        row, column = np.argwhere(counts != 1)[0]
        raise InputError(
            f"{what}: the frame at {frames[row]} must have one row of wavelength {pixels[column]:g}, "
            f"not {counts[row, column]}",
            key="wavelength",
        )
    place, made = np.argsort(number).reshape(counts.shape), {}
    for key, values in found.items():
        if key in ("flux", "error", "quality"):
            rows = values.numbers()[place]
        elif key == "wavelength":
            rows = pixels
        else:
            rows = _keys(values)[place]
            if (rows != rows[:, :1]).any():
                raise InputError(f"{what}: {values.name!r} must not change within a frame", key=values.name)
            rows = rows[:, 0]
        made[key] = Values.of(values.name, rows, values.unit, what)
    return made


def _keys(values: Values) -> NDArray[Any]:
    """Return numbers, or the texts of dates."""
    texts = values.texts()
    return np.asarray(values.numbers() if texts is None or not any(map(is_dated, texts)) else texts)


def _with_flags(found: Quantities) -> Quantities:
    """Return flags of frames as numbers, also those of words and those that lightkurve 2 writes into CSV."""
    quality = found.get("quality")
    # Those of pixels are left as they are.
    if quality is None or len(quality.shape) != 1:
        return found
    texts = [text.lower() for text in quality.texts() or ()]
    # G and B are those of ASAS-SN.
    words = {"true": 1, "false": 0, "bad": 1, "good": 0, "b": 1, "g": 0}
    if texts and {*texts} <= {*words}:
        flags = np.array([words[text] for text in texts])
    else:
        values, place = np.unique(quality.numbers(), return_inverse=True)
        digits = {value: f"{value:.0f}" for value in values[np.isfinite(values)].tolist()}
        if max(digits, default=0.0) >= 2**32 and {*"".join(digits.values())} <= {"0", "1"}:
            # Those of lightkurve are the digits of binary numbers.
            values = np.array([float(int(digits[one], 2)) if one in digits else one for one in values.tolist()])
        flags = values[place]
    return found | {"quality": Values.of(quality.name, flags, what=quality.what)}


def _wavelength(file: TableFile, mapping: FrameMapping) -> Values | None:
    if mapping.wavelength_file is not None:
        path = Path(mapping.wavelength_file)
        with _opened(path, f"file {path.name!r}", None) as other:
            if mapping.wavelength is None and len(other.names) != 1:
                fault = f"{other.what}: no column of wavelengths is named"
                raise InputError(f"{fault}; give one of {', '.join(other.names)}", key="wavelength")
            found = other.find(mapping.wavelength or other.names[0])
            return Values.of(found.name, found.numbers().ravel(), found.unit, found.what)
    if mapping.wavelength is None:
        return None
    if mapping.wavelength == "wcs":
        return file.axis(mapping.flux, 1)
    if mapping.wavelength == "names":
        return file.wavelengths_in_names(mapping.flux)
    return file.find(mapping.wavelength)


def _check_rows(file: TableFile, found: Quantities) -> None:
    """Raise InputError unless all columns have one row, or spectrum, for each frame, before any is read."""
    what, n, flux = file.what, found["time"].n_rows, found["flux"]
    if not 0 < n <= MAX_FRAMES:
        expected = f"at most {MAX_FRAMES} frames, but has {n}" if n else "a row for each frame, but has no rows"
        raise InputError(f"{what} must have {expected}", key="frames")
    # A light curve is that of one star in one band.
    groups = [file.find(name) for name in file.columns if key_of(name) in GROUPS and "wavelength" not in found]
    for group in (one for one in groups if len(one.shape) == 1):
        name, texts = group.name, group.texts()
        cells = map(str, np.unique(group.numbers())) if texts is None else texts
        held = sorted({cell for cell in cells if not is_missing(cell)})
        # The filter of ATLAS is called F, as is the light of others.
        if len(held) > 1 and (key_of(name) != "f" or all(map(str.isalpha, held))):
            fault = f"{what} must hold the light of one star in one band, but has rows of {len(held)} different"
            raise InputError(f"{fault} {name!r} ({shortened(', '.join(held), 80)}); divide the table", key="flux")
    for key, values in found.items():
        if key != "wavelength" and values.n_rows != n:
            fault = f"{what}: {values.name!r} must have {n} rows, as the times do, but has {values.n_rows}"
            raise InputError(fault, key=values.name)
    single = ("time", "end") if "wavelength" in found else ("time", "end", "flux")
    each = (one for key, one in found.items() if key in single)
    if odd := next((one for one in each if len(one.shape) == 2 and one.shape[1] > 1), None):
        fault = f"{what}: {odd.name!r} holds {odd.shape[1]} values in each row"
        raise InputError(f"{fault}; give one, or name wavelengths in a mapping", key=odd.name)
    if len(flux.shape) > 2:
        pixels = " x ".join(map(str, flux.shape[1:]))
        raise InputError(
            f"{what}: {flux.name!r} holds images of {pixels} pixels, as target pixel files do; "
            "give a light curve, such as lightkurve's `to_lightcurve` makes",
            key="flux",
        )


def _conditions(file: TableFile, found: Quantities, mapping: FrameMapping, exposure: Float | None) -> dict[str, Any]:
    """Return exposure times, by default between edges, and temperatures, by columns, the mapping or the header."""
    n, nominal = found["time"].n_rows, file.header.get("CCD-TEMP")
    temperature = np.full(n, float(nominal)) if isinstance(nominal, int | float) else None
    try:
        # The header of BRITE's light curves has milliseconds for each image of a stack.
        stated = 1e-3 * float(file.header["ObsExpoT"]) * float(file.header.get("ObsStack", 1.0))
    except (KeyError, ValueError):
        stated = 0.0
    if "exposure" in found:
        exposure = converted(found["exposure"], mapping.exposure_unit, "s", "exposure_unit").numbers().reshape(n)
    elif 0.0 < (one := mapping.exposure_s or stated) < np.inf:
        exposure = np.full(n, one)
    if "temperature" in found:
        celsius = converted(found["temperature"], mapping.temperature_unit, "deg_C", "temperature_unit")
        temperature = celsius.numbers().reshape(n)
    return {"exposure_s": exposure, "temperature_c": temperature}


def _of_level(light: Float, sd: Float | None, unit: str) -> tuple[Float, Float | None, str, list[str]]:
    """Return light and errors, as multiples of the level if they are deviations from it in parts, and remarks."""
    held = np.sort(light[np.isfinite(light)])
    if not held.size:
        return light, sd, unit, []
    held = held[held.size // 100 : held.size - held.size // 100]
    level, part = float(held.mean()), PARTS_OF_LEVEL.get(unit.lower())
    # A tenth of the light of a star is not below zero.
    if part is not None and held[held.size // 10] < 0.0:
        said = [f"its light is a deviation from its level in {unit}, and is read as a multiple of the level"]
        return 1.0 + part * light, None if sd is None else part * sd, "", said
    if level > SURE * float(held.std()) / np.sqrt(held.size):
        return light, sd, unit, []
    said = [f"the mean of its light is {level:.3g}, not significantly above zero, as after a level or an image is "
            "subtracted: amplitudes and equivalent durations relative to it mean nothing"]  # fmt: skip
    return light, sd, unit, said


def _frames_in(
    file: TableFile, found: Quantities, mapping: FrameMapping, stem: str, reduced: Light | None = None
) -> Frames:
    """Build frames from a file and its quantities; with `reduced` light, which is not read again."""
    what, header = file.what, file.header
    edges = tuple(found[key] for key in ("time", "end") if key in found)
    time, between_edges_s, dates, remarks = times_of(edges, file, mapping)
    each = _conditions(file, found, mapping, between_edges_s)
    bits = QualityBits.of(header, mapping.quality_bits, what)
    wavelength = None if "wavelength" not in found else _vacuum_nm(found["wavelength"], mapping.wavelength_unit, file)
    light, sd, flags, unit, more = _read_light(file, found, mapping, bits, reduced)
    kept = np.isfinite(time)
    if not kept.any():
        raise InputError(f"{what}: at least one row must have a time, but none has", key="time")
    remarks += more
    if n_left := int(np.count_nonzero(~kept)):
        words = "1 row has no time and was" if n_left == 1 else f"{n_left} rows have no time and were"
        remarks += (f"{what}: {words} left out",)
    each["error"] = sd
    each["quality"] = None if flags is None else np.where(np.isfinite(flags), flags, bits.mask & -bits.mask)
    made = Frames.of(
        time[kept],
        light[kept],
        **{name: None if values is None else values[kept] for name, values in each.items()},
        quality_mask=bits.mask,
        mission=bits.mission,
        name=mapping.name or str(header.get("OBJECT", "") or header.get("star", "") or stem),
        wavelength_nm=wavelength if light.ndim == 2 else None,
        unit=unit,
        instrument=str(header.get("INSTRUME", "") or header.get("TELESCOP", "")).strip(),
        reference_mjd=dates.epoch_mjd,
        scale=dates.scale,
        position=dates.position,
        direction_deg=dates.direction_deg,
        net=isinstance(file, StoredFile) and mapping.flux != "raw",
    )
    if dates.at != 0.5:
        made = made.shifted((0.5 - dates.at) * made.exposure_s)
    if made.quality is not None:
        remarks += bits.remarks(made.quality, made.name)
    return made.with_remarks(remarks)


def _read_light(
    file: TableFile, found: Quantities, mapping: FrameMapping, bits: QualityBits, reduced: Light | None
) -> tuple[Float, Float | None, Float | None, str, tuple[str, ...]]:
    """Return light, errors, flags, the unit of the light, and remarks."""
    unit, flux, error, remarks = _light(found, mapping)
    light, sd, flags, more = reduced or whole_or_reduced(flux, error, _masked(found.get("quality"), bits))
    if "wavelength" not in found:
        light, sd = light.ravel(), None if sd is None else sd.ravel()
    light, sd = without_indefinite(light), None if sd is None else without_indefinite(sd)
    marks, said = marks_in(light, "values")
    light = np.where(np.isin(light, marks), np.nan, light) if marks else light
    unused = [name for name in file.columns if FLAGS & {*words_of(name)}]
    if "quality" not in found and unused:
        said = [*said, f"no flags are used; a mapping with quality names one of {', '.join(unused)}"]
    if len(light.shape) == 1:
        light, sd, unit, on_level = _of_level(light, sd, unit)
        said = [*said, *on_level]
    remarks += (*more, *(f"{file.what}: {text}" for text in (*file.remarks, *said)))
    if sd is not None and not np.isfinite(sd).any():
        # lightkurve writes a column of NaN for errors that it does not know.
        sd = None
        remarks += (f"{file.what} has a column of errors without a number: it is left out",)
    if "quality" in found and len(found["quality"].shape) == 1:
        flags = found["quality"].numbers()
    return light, sd, flags, unit, remarks


def _masked(quality: Values | None, bits: QualityBits) -> Values | None:
    """Return quality flags without the bits that do not exclude a frame or a pixel."""
    if quality is None or bits.mask == ALL_BITS:
        return quality
    return quality.mapped(lambda flags: np.where(np.isfinite(flags), bits.mask & flags.astype(np.int64), flags), "")


def _light(found: Quantities, mapping: FrameMapping) -> tuple[str, Values, Values | None, tuple[str, ...]]:
    """Return the unit of the light, light and errors in it, and remarks."""
    flux, error = found["flux"], found.get("error")
    remarks: tuple[str, ...] = ()
    stated = flux.unit or unit_in_name(flux.name)
    unit = mapping.flux_unit or stated
    if mapping.flux_unit and stated and mapping.flux_unit != stated:
        remarks = (f"the unit of {flux.name!r} is {mapping.flux_unit} as the mapping says, not {stated}",)
    if not unit and (is_magnitude(flux.name) or {*words_of(flux.name)} & {"log", "ln", "dex"}):
        expected = (
            "linear light: convert magnitudes and logarithms first, or name a linear unit as flux_unit in a mapping"
        )
        raise InputError.of("flux", flux.name, expected, where=flux.what)
    if re.match(r"\s*(?:dex|log|db)\b", unit, re.IGNORECASE) or ("mag" in unit.lower() and "magg" not in unit.lower()):
        expected = "a linear unit: light in magnitudes must be converted first"
        raise InputError.of("flux_unit", unit, expected, where=flux.what)
    if error is None:
        return unit, flux, None, remarks
    named = f"{error.what}: {error.name!r}"
    if error.shape != flux.shape:
        fault = f"{named} must have the shape of the flux, {flux.shape}, not {error.shape}"
        raise InputError(fault, key="error")
    own = error.unit or unit_in_name(error.name)
    if own and not unit and own.lower() in PARTS_OF_LEVEL:
        remedy = "give errors in the unit of the light, or flux_unit = '1' in a mapping if its level is 1"
        raise InputError(f"{named} is in {own}, and {flux.name!r} is not; {remedy}", key="error")
    if own and unit and own not in (unit, stated):
        try:
            factor = float(unit_in(own).to(unit_in(unit)))
        except (ValueError, TypeError) as cause:
            fault = f"{named} must have a unit like that of {flux.name!r}, {unit}, not {own}"
            raise InputError(fault, key="error") from cause
        error = error.mapped(lambda values: values * factor, unit)
    return unit, flux, error, remarks


def _vacuum_nm(wavelength: Values, given: str | None, file: TableFile) -> Float:
    """Return the wavelengths of the pixels in vacuum, which must be the same in every frame."""
    plain, medium = unit_and_medium(given or "")
    stated, in_unit = unit_and_medium(wavelength.unit)
    nm = converted(replace(wavelength, unit=stated or ""), plain, "nm", "wavelength_unit")
    rows = nm.rows(0, 1)[0] if len(nm.shape) == 2 else nm.numbers().ravel()
    for part in nm.pieces if len(nm.shape) == 2 else []:
        if not np.allclose(nm.rows(part.start, part.stop), rows, rtol=1e-9, atol=0.0):
            fault = f"{wavelength.what}: the wavelengths must be the same in every frame, but change"
            raise InputError(fault, key="wavelength")
    found, _ = vacuum_wavelengths(rows, wavelength.name, "", medium or in_unit, (file.header,))
    return found
