"""Read frames from files: what mauvecl writes, light curves of TESS and Kepler, and other files through a mapping."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.files.parsing import parsing
from mauvecl.host.files.size_limits import check_size, limit_bytes, open_regular, packed, read_bytes, unpacked
from mauvecl.host.files.text_table import text_table
from mauvecl.host.spectra.air import vacuum_from_air
from mauvecl.host.spectra.fits_files import check_sums
from mauvecl.host.spectra.formats import without_columns
from mauvecl.host.spectra.text import text_of
from mauvecl.observations.fits_frames import FitsFile, open_fits
from mauvecl.observations.folder_frames import FolderFile, keywords_of
from mauvecl.observations.frames import MAX_FRAMES, Frames
from mauvecl.observations.large_tables import LARGE, open_large
from mauvecl.observations.long_tables import spectra_of_rows
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.reduction import Light, PixelStatistics, weighted_sums, whole_or_reduced
from mauvecl.observations.stored_frames import StoredFile, is_store, open_hdf5, open_store, stored_in_fits
from mauvecl.observations.time_system import TimeSystem, mjd_of, position_of, scale_of, seconds_from_first
from mauvecl.observations.values import FrameFile, TableFile, Values, converted, unit_in
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S
from mauvecl.schema.text import shortened

Float = NDArray[np.float64]

FORMATS = "FITS, HDF5, ECSV, CSV, a Zarr store or a folder of spectra"
#: Names of columns that need no mapping, in order of preference: those of mauvecl, of TESS and Kepler light curves, and
#: of lightkurve's and AltaiPony's tables.
KNOWN = {
    "time": ("time",),
    "flux": ("flux", "pdcsap_flux", "sap_flux"),
    "quality": ("quality", "sap_quality"),
    "temperature": ("temperature",),
}
#: Part of a frame that times refer to.
PARTS = {"start": 0.0, "middle": 0.5, "end": 1.0}
SIGNATURES = {b"SIMPLE  =": "FITS", b"\x89HDF\r\n": "HDF5"}
ECSV = b"# %ECSV"


@validated
def read_frames(path: str | Path, mapping: FrameMapping | str | Path | None = None) -> Frames:
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
    """
    with _parsing(path), _frame_file(path, mapping) as (file, how, stem):
        return _frames_in(file, how, stem)


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
    from astropy.table import Table

    if not hasattr(container, "colnames"):
        names = ("flux", "spectral_axis")
        if not all(hasattr(container, name) for name in names) or time is None or len(container.flux.shape) != 2:
            raise InputError.of("container", type(container).__name__, "a table with times, or spectra of shape "
                                "(n_frame, n_pixel) with flux, spectral_axis and `time`")  # fmt: skip
        masked = getattr(container, "mask", None)
        mask = np.zeros(container.flux.shape, np.bool_) if masked is None else np.asarray(masked, np.bool_)
        columns: dict[str, Any] = {"time": time, "flux": np.ma.MaskedArray(container.flux.value, mask)}
        if getattr(container, "uncertainty", None) is not None:
            columns["flux_err"] = _standard_deviation(container.uncertainty)
        nm = container.spectral_axis.to_value("nm", equivalencies=_spectral())
        columns["wavelength"] = np.tile(nm, (len(columns["flux"]), 1))
        container = Table(
            columns, meta=dict(container.meta or {}), units={"flux": container.flux.unit, "wavelength": "nm"}
        )
        mapping = FrameMapping(time="time", flux="flux", wavelength="wavelength",
                               error="flux_err" if "flux_err" in columns else None)  # fmt: skip
    file = TableFile(container, type(container).__name__)
    return _frames_in(file, mapping or _recognised(file), str(container.meta.get("LABEL", "frames")))


def _spectral() -> Any:
    import astropy.units as u

    return u.spectral()


def _standard_deviation(uncertainty: Any) -> Float:
    """Return the standard deviations of an uncertainty of astropy's NDData, without unit."""
    from astropy.nddata import StdDevUncertainty

    return np.asarray(uncertainty.represent_as(StdDevUncertainty).array, np.float64)


@dataclass(frozen=True, eq=False)
class ReducedFrames:
    """Spectra reduced to weighted sums.

    Attributes
    ----------
    light_curves : tuple of Frames
        One for each row of the weights.
    pixels : PixelStatistics
        Light and noise of each pixel of the file.
    """

    light_curves: tuple[Frames, ...]
    pixels: PixelStatistics


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
    with _parsing(path), _frame_file(path, mapping) as (file, how, stem):
        _, flux, error, _ = _light(found := Quantities.of(file, how), how)
        if len(flux.shape) != 2:
            raise InputError.of("flux", flux.shape, "spectra, shape (n_frame, n_pixel)", where=file.what)
        given = None if weights is None else np.asarray(weights, np.float64)
        sums = weighted_sums(flux, error, found.quality, given)
        curves = tuple(
            _frames_in(file, how, stem, lambda *_, k=k: sums.light(k, flux.what, found.quality))
            for k in range(sums.sums.shape[1])
        )
        return ReducedFrames(curves, sums.pixels)


def _parsing(path: str | Path) -> AbstractContextManager[None]:
    """Return a context in which exceptions of other libraries become errors of a file."""
    return parsing(f"file {shortened(Path(path).name)}", FORMATS)


@contextmanager
def _frame_file(
    path: str | Path, mapping: FrameMapping | str | Path | None
) -> Iterator[tuple[FrameFile, FrameMapping, str]]:
    """Open a file, folder or store, and return its quantities and its name without extension."""
    place, words = without_columns(path)
    given = FrameMapping.read(mapping) if isinstance(mapping, str | Path) else mapping
    name = words[0] if words else None if given is None or given.hdu is None else str(given.hdu)
    with _open_frames(place, given, name) as (file, how):
        yield file, how, place.stem


@contextmanager
def _open_frames(
    path: Path, mapping: FrameMapping | None, name: str | None
) -> Iterator[tuple[FrameFile, FrameMapping]]:
    """Open a file with frames, and return where its quantities are."""
    what = f"file {path.name!r}"
    if path.is_dir():
        what = f"folder {path.name!r}"
        if is_store(path):
            with open_store(path, name, what) as store:
                yield store, mapping or store.mapping
        elif mapping is None:
            expected = "a mapping that says where the quantities of its files are"
            raise InputError(f"{what} is not a store of spectra", expected, key="mapping")
        else:
            yield FolderFile(path, mapping, what, lambda one: _opened(one, f"file {one.name!r}", name)), mapping
        return
    with _opened(path, what, name, mapping, large=True) as file:
        yield file, mapping or (file.mapping if isinstance(file, StoredFile) else _recognised(file))


@contextmanager
def _opened(
    path: Path, what: str, name: str | None, mapping: FrameMapping | None = None, *, large: bool = False
) -> Iterator[FrameFile]:
    """Open a file by its first bytes; only `large` ones may exceed MAUVECL_LARGEST_FILE_MIB."""
    if not large:
        check_size(path, "file")
    with open_regular(path, "file") as raw:
        start = raw.read(16)
        raw.seek(0)
        file: IO[bytes] = raw
        content: bytes | None = None
        commas = ".csv" in path.suffixes[-2:]
        if (commas or start.startswith(ECSV)) and not packed(start) and raw.seek(0, io.SEEK_END) > LARGE:
            raw.seek(0)
            with open_large(raw, what, commas, FORMATS) as table:
                yield table
            return
        raw.seek(0)
        if not any(start.startswith(mark) for mark in SIGNATURES):
            content = unpacked(read_bytes(path, "file"), what)
            start, file = content[:16], io.BytesIO(content)
        kind = next((kind for mark, kind in SIGNATURES.items() if start.startswith(mark)), "text")
        if kind == "FITS":
            with open_fits(file, what) as hdus:
                if file.seek(0, io.SEEK_END) <= limit_bytes("MAUVECL_LARGEST_FILE_MIB"):
                    _checked(hdus, what)
                with parsing(what, FORMATS):
                    stored = stored_in_fits(FitsFile(hdus, what), name)
                    found = stored or FitsFile(hdus, what, name, _wanted(mapping))
                yield _filled(found)
        elif kind == "HDF5":
            with open_hdf5(file, name, what) as scene:
                yield scene
        else:
            try:
                text = text_of(content or b"")
            except InputError as error:
                raise error.within(what) from error
            if not text.strip():
                raise InputError(f"{what} is empty", FORMATS, key="file")
            small = TableFile(text_table(text, what, commas, FORMATS), what)
            small.header |= keywords_of([line for line in text.splitlines() if line[:1] in "#%!;"])
            yield _filled(small)


def _filled(file: FrameFile) -> FrameFile:
    """Return a file; raise InputError if it has nothing with rows."""
    if not file.names:
        raise InputError(f"{file.what} has no table and no image", "a row for each frame", key="file")
    return file


def _checked(hdus: Any, what: str) -> None:
    try:
        check_sums(hdus)
    except InputError as error:
        raise error.within(what) from error


def _wanted(mapping: FrameMapping | None) -> tuple[tuple[str, ...], ...]:
    """Return groups of names, of each of which the chosen table has one."""
    return (KNOWN["time"], KNOWN["flux"]) if mapping is None else tuple((name,) for name in mapping.times)


def _recognised(file: FrameFile) -> FrameMapping:
    """Return the mapping of a file whose columns have known names."""
    lower = {name.lower(): name for name in file.names}
    columns = {key: next((lower[n] for n in names if n in lower), None) for key, names in KNOWN.items()}
    flux = (columns["flux"] or "").lower()
    # Errors of another flux would be wrong ones.
    columns["error"] = next((lower[n] for n in (f"{flux}_err", f"{flux}_error", "error") if n in lower), None)
    if columns["time"] is None or columns["flux"] is None:
        raise InputError(
            f"{file.what} has the columns {shortened(', '.join(file.names), 300)}",
            "columns named time and flux, or a mapping that names them",
            key="mapping",
        )
    if "SPECTRUM" in file.names and "WAVELENGTH/WAVELENGTH" in file.names:
        columns |= {"flux": "SPECTRUM", "error": "SPECTRUM_ERR", "wavelength": "WAVELENGTH/WAVELENGTH"}
    return FrameMapping(**{key: value for key, value in columns.items() if value is not None})


@dataclass(frozen=True, eq=False)
class Quantities:
    """Columns, arrays and values of a file that a mapping names."""

    time: tuple[Values, ...]
    flux: Values
    error: Values | None
    quality: Values | None
    exposure: Values | None
    temperature: Values | None
    wavelength: Values | None

    @classmethod
    def of(cls, file: FrameFile, mapping: FrameMapping) -> Quantities:
        """Find the quantities of a mapping."""

        def found(name: str | None) -> Values | None:
            return None if name is None else file.find(name)

        times = tuple(file.axis(mapping.flux, 2) if name == "wcs" else file.find(name) for name in mapping.times)
        flux = file.find(mapping.flux)
        one = cls(times, flux, found(mapping.error), found(mapping.quality), found(mapping.exposure),
                  found(mapping.temperature), _wavelength(file, mapping))  # fmt: skip
        nm = one.wavelength
        if nm is None or not nm.shape == flux.shape == times[0].shape or isinstance(file, FolderFile):
            return one
        if 32 * flux.n_rows > (most := limit_bytes("MAUVECL_LARGEST_CONTENT_MIB")):
            raise InputError(
                f"{file.what} has {flux.n_rows} rows of pixels",
                f"at most {most // 32}; MAUVECL_LARGEST_CONTENT_MIB sets the limit",
                key="MAUVECL_LARGEST_CONTENT_MIB",
                value=flux.n_rows,
            )
        return cls(*spectra_of_rows(times, flux, one.error, one.quality, one.exposure, one.temperature, nm, file.what))


def _wavelength(file: FrameFile, mapping: FrameMapping) -> Values | None:
    if mapping.wavelength_file is not None:
        path = Path(mapping.wavelength_file)
        with _opened(path, f"file {path.name!r}", None) as other:
            if mapping.wavelength is None and len(other.names) != 1:
                raise InputError.of("wavelength", None, f"one of {', '.join(other.names)}", where=other.what)
            found = other.find(mapping.wavelength or other.names[0])
            return Values.of(found.name, found.numbers().ravel(), found.unit, found.what)
    if mapping.wavelength is None:
        return None
    if mapping.wavelength == "wcs":
        return file.axis(mapping.flux, 1)
    if mapping.wavelength == "names":
        return file.wavelengths_in_names(mapping.flux)
    return file.find(mapping.wavelength)


def _frames_in(
    file: FrameFile, mapping: FrameMapping, stem: str, read: Callable[..., Light] = whole_or_reduced
) -> Frames:
    """Build frames from a file and the names of its quantities; `read` returns their light."""
    what = file.what
    found = Quantities.of(file, mapping)
    n = found.time[0].n_rows
    if n == 0:
        raise InputError(f"{what} has no rows", "a row for each frame", key="frames", value=0)
    if n > MAX_FRAMES:
        # Before anything of them is read.
        raise InputError(f"{what} has {n} rows", f"at most {MAX_FRAMES} frames", key="frames", value=n)
    for values in (*found.time, found.flux, found.error, found.quality, found.exposure, found.temperature):
        if values is not None and values.n_rows != n:
            raise InputError(f"{what}: {values.name!r} has {values.n_rows} rows", f"{n} as the times have",
                             key=values.name, value=values.n_rows)  # fmt: skip
    time, exposure_s, dates, remarks = _times(found.time, file, mapping)
    if found.exposure is not None:
        exposure_s = converted(found.exposure, mapping.exposure_unit, "s", "exposure_unit").numbers().reshape(n)
    elif mapping.exposure_s is not None:
        exposure_s = np.full(n, mapping.exposure_s)
    unit, flux, error, more = _light(found, mapping)
    remarks += more
    wavelength = None if found.wavelength is None else _vacuum_nm(found.wavelength, mapping.wavelength_unit)
    if len(flux.shape) == 2 and flux.shape[1] == 1 and wavelength is None:
        flux, error = _single(flux), None if error is None else _single(error)
    temperature = None
    if found.temperature is not None:
        temperature = converted(found.temperature, mapping.temperature_unit, "deg_C", "temperature_unit").numbers()
    elif isinstance(nominal := file.header.get("CCD-TEMP"), int | float):
        temperature = np.full(n, float(nominal))
    light, sd, flags, more = read(flux, error, found.quality)
    remarks += more
    if len(light.shape) == 1:
        wavelength = None
    kept = np.isfinite(time)
    if not kept.all():
        n_left = int(np.count_nonzero(~kept))
        words = "1 row has no time and was" if n_left == 1 else f"{n_left} rows have no time and were"
        remarks += (f"{what}: {words} left out",)
    if not kept.any():
        raise InputError(f"{what}: no row has a time", "times", key="time")
    made = Frames.of(
        time[kept],
        light[kept],
        None if sd is None else sd[kept],
        exposure_s=None if exposure_s is None else exposure_s[kept],
        quality=None if flags is None else np.where(np.isfinite(flags), flags, 1)[kept],
        name=mapping.name or str(file.header.get("OBJECT", "") or file.header.get("star", "") or stem),
        wavelength_nm=wavelength,
        temperature_c=None if temperature is None else temperature.reshape(n)[kept],
        unit=unit,
        instrument=str(file.header.get("INSTRUME", "") or file.header.get("TELESCOP", "")).strip(),
        reference_mjd=dates.epoch_mjd,
        scale=dates.scale,
        position=dates.position,
        direction_deg=dates.direction_deg,
    )
    if dates.at != 0.5:
        made = made.shifted((0.5 - dates.at) * made.exposure_s)
    return made.with_remarks(remarks)


def _times(
    time: tuple[Values, ...], file: FrameFile, mapping: FrameMapping
) -> tuple[Float, Float | None, TimeSystem, tuple[str, ...]]:
    """Return times in seconds from the first, exposure times of frames with a start and an end, and their dates."""
    import astropy.units as u

    stated = TimeSystem.of(file.header, file.what)
    scale, position = scale_of(mapping.scale) or stated.scale, position_of(mapping.position) or stated.position
    epoch, remarks, offset = mapping.epoch_mjd, [], stated.offset
    texts = [one.texts() for one in time]
    if all(text is not None and any(_dated(cell) for cell in text) for text in texts):
        scale, unit, epoch, offset = scale or "utc", u.d, 0.0, 0.0
        edges = [mjd_of(text or [], scale, one.name, file.what) for text, one in zip(texts, time, strict=True)]
        if not (mapping.scale or stated.scale):
            remarks.append(f"the dates of {file.what} state no time scale and are assumed to be in UTC")
    else:
        stated_unit = mapping.time_unit or time[0].unit or stated.unit
        if len({one.unit for one in time}) > 1 and not mapping.time_unit:
            names = " and ".join(repr(one.name) for one in time)
            raise InputError(f"{file.what}: {names} have different units", "one unit", key="time")
        # Checks the unit; times keep theirs, so that long times lose no digits.
        converted(replace(time[0], unit=stated_unit), mapping.time_unit, "s", "time_unit")
        unit = unit_in(stated_unit)
        edges = [one.numbers().ravel() for one in time]
        epoch = stated.epoch_mjd if epoch is None else epoch
    exposure = None if len(edges) == 1 else np.asarray(((edges[1] - edges[0]) * unit).to_value(u.s))
    seconds, first_d = seconds_from_first(np.mean(edges, axis=0) + offset, unit)
    at = 0.5 if len(edges) == 2 else PARTS.get(mapping.time_at or "", stated.at)
    dates = replace(stated, epoch_mjd=None if epoch is None else epoch + first_d, scale=scale, position=position, at=at)
    return (seconds if epoch is not None else seconds + first_d * DAY_S), exposure, dates, tuple(remarks)


def _dated(cell: str) -> bool:
    """Return whether a text begins as an ISO 8601 date."""
    return len(cell) >= 8 and cell[:4].isdigit() and cell[4:5] in ("-", ":")


def _light(found: Quantities, mapping: FrameMapping) -> tuple[str, Values, Values | None, tuple[str, ...]]:
    """Return the unit of the light, and light and errors in it."""
    remarks: tuple[str, ...] = ()
    unit, stated = mapping.flux_unit or found.flux.unit, found.flux.unit
    if mapping.flux_unit and stated and mapping.flux_unit != stated:
        remarks = (f"the unit of {found.flux.name!r} is {mapping.flux_unit} as the mapping says, not {stated}",)
    if "mag" in unit.lower() and "maggie" not in unit.lower():
        raise InputError.of("flux_unit", unit, "a linear unit: light in magnitudes must be converted first",
                            where=found.flux.what)  # fmt: skip
    error = found.error
    if error is None:
        return unit, found.flux, None, remarks
    if error.shape != found.flux.shape:
        raise InputError(f"{error.what}: {error.name!r} has the shape {error.shape}",
                         f"that of the flux, {found.flux.shape}", key="error", value=error.shape)  # fmt: skip
    if error.unit and unit and error.unit != unit and not mapping.flux_unit:
        try:
            factor = float(unit_in(error.unit).to(unit_in(unit)))
        except (ValueError, TypeError) as fault:
            raise InputError(f"{error.what}: {error.name!r} is in {error.unit} and {found.flux.name!r} in {unit}",
                             "units of the same kind", key="error", value=error.unit) from fault  # fmt: skip
        error = error.mapped(lambda values: values * factor, unit)
    return unit, found.flux, error, remarks


def _vacuum_nm(wavelength: Values, given: str | None) -> Float:
    """Return the wavelengths of the pixels, which must be the same in every frame."""
    plain = (given or "").removesuffix(" air").removesuffix(" vacuum") or None
    nm = converted(wavelength, plain, "nm", "wavelength_unit")
    rows = np.atleast_2d(nm.rows(0, 1) if len(nm.shape) == 2 else nm.numbers())[0]
    if len(nm.shape) == 2:
        for part in nm.pieces:
            if not np.allclose(nm.rows(part.start, part.stop), rows, rtol=1e-9, atol=0.0):
                raise InputError(f"{wavelength.what}: the wavelengths change from frame to frame",
                                 "the same in every frame", key="wavelength", value=wavelength.name)  # fmt: skip
    return vacuum_from_air(rows) if given and given.endswith(" air") else rows


def _single(values: Values) -> Values:
    """Return values of shape (n, 1) as (n,)."""
    return replace(values, shape=values.shape[:1], read=lambda start, stop: values.rows(start, stop)[:, 0])
