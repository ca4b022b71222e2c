"""Frames of tables in files, whole or piece by piece, with a mapping of their columns."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.spectra.columns import words_of
from mauvecl.host.spectra.units import medium_of, unit_and_medium, vacuum_wavelengths
from mauvecl.host.tables.files import limit_bytes, parsing, without_columns
from mauvecl.host.tables.fits_tables import FitsTables
from mauvecl.host.tables.names import divided_unit, first_of, is_magnitude, is_missing, key_of
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
from mauvecl.host.tables.units import (
    EPOCHS_MJD,
    MISSIONS,
    TimeSystem,
    TimeUnit,
    is_dated,
    mjd_of,
    position_of,
    scale_of,
    seconds_from_first,
    time_in_name,
    time_unit,
)
from mauvecl.observations.frames import ALL_BITS, MAX_FRAMES, Frames, QualityBits, decimal_flags
from mauvecl.observations.mapping import FrameMapping
from mauvecl.observations.stored_frames import (
    FolderFile,
    Light,
    PixelStatistics,
    StoredFile,
    is_store,
    open_hdf5,
    open_store,
    stored_in_fits,
    weighted_sums,
    whole_or_reduced,
)
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError, shortened
from mauvecl.schema.physical import DAY_S


def _keys(values: Values) -> NDArray[Any]:
    """Return numbers, or the texts of dates."""
    texts = values.texts()
    return np.asarray(values.numbers() if texts is None or not any(map(is_dated, texts)) else texts)


Float = NDArray[np.float64]

FORMATS = "FITS, HDF5, ECSV, CSV, a Zarr store or a folder of spectra"
#: Names of columns that need no mapping, in order of preference, in any case: those of mauvecl, of the pipelines of
#: Kepler, K2 and TESS, of lightkurve and AltaiPony, and of K2SFF, QLP, eleanor, TASOC and gPhoton.
KNOWN = {
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
#: Names of the times at which frames start and end, where no other column is a time.
EDGES = ("t0", "t1")
#: Columns of bands and of stars, of which a light curve has one.
GROUPS = ("band", "filter", "filt", "passband", "bandpass", "filtercode", "phot_filter", "source_id", "tic",
          "tic_id", "ticid", "kic", "kepid", "epic", "object", "target", "star", "f")  # fmt: skip
#: Words in the names of flags, which exclude frames only if they are called quality or a mapping names them.
FLAGS = {"flag", "flags", "rejected", "quality", "qual", "dq", "status", "event", "mask"}
#: Part of a frame that times refer to.
PARTS = {"start": 0.0, "middle": 0.5, "end": 1.0}
#: Dates of observed light, MJD, from 1845 to 2269.
DATES_MJD = (-5000.0, 150_000.0)
#: Units in which light is given as a deviation from its level, as TASOC does.
PARTS_OF_LEVEL = {"%": 1e-2, "percent": 1e-2, "ppt": 1e-3, "ppm": 1e-6, "ppb": 1e-9}
#: Columns of files that state no unit of their times, these times, and what they are: Gaia DR3's epoch photometry, BJD
#: in TCB less 2455197.5 (documentation of vari_epoch_photometry), and GALEX, Unix time less 315964800 s (user guide of
#: gPhoton), of which the columns are those of gPhoton's light curves.
TIMES_OF_COLUMNS = (
    ({"transit_id", "rejected_by_photometry"}, TimeUnit("d", 55_197.0, "tcb", "BARYCENTER"),
     "days from 2010-01-01 in TCB, as in Gaia DR3's epoch photometry"),
    ({"t0", "t1", "cps", "cps_err"}, TimeUnit("s", EPOCHS_MJD["gps"], "utc"),
     "seconds from 1980-01-06 in UTC, as in GALEX light curves of gPhoton"),
)  # fmt: skip
#: Extension of the light curves of CHEOPS. UTC in its header is that of the start and the end of a visit;
#: BJD_TIME is in TT: pycheops 1.1.14, documentation of `Dataset`.
CHEOPS = "SCI_COR_LIGHTCURVE"
#: Standard errors by which a level is above zero.
SURE = 5.0
#: What a cell of times may be.
DATE = "a number or a date such as 2026-03-01T12:00:00"


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
    with _parsing(path), _frame_file(path, mapping, check=not ignore_checksum) as (file, how, stem):
        if raw and mapping is None and isinstance(file, StoredFile):
            how = file.raw_mapping
        if quality_bits is not None:
            how = how.model_copy(update={"quality_bits": quality_bits})
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
    import astropy.units as u
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
        nm = container.spectral_axis.to_value("nm", equivalencies=u.spectral())
        columns["wavelength"] = np.tile(nm, (len(columns["flux"]), 1))
        container = Table(
            columns, meta=dict(container.meta or {}), units={"flux": container.flux.unit, "wavelength": "nm"}
        )
        mapping = FrameMapping(time="time", flux="flux", wavelength="wavelength",
                               error="flux_err" if "flux_err" in columns else None)  # fmt: skip
    file = MemoryTable(container, type(container).__name__)
    return _frames_in(file, mapping or _recognised(file), str(container.meta.get("LABEL", "frames")))


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
        quality = _masked(found.quality, QualityBits.of(file.header, how.quality_bits, file.what))
        sums = weighted_sums(flux, error, quality, given)
        curves = tuple(
            _frames_in(file, how, stem, lambda *_, k=k: sums.light(k, flux.what, quality))
            for k in range(sums.sums.shape[1])
        )
        return ReducedFrames(curves, sums.pixels)


@dataclass(frozen=True)
class ColumnNames:
    """Names of the columns of a file of frames, some of which a mapping names."""

    names: tuple[str, ...]

    @classmethod
    def read(cls, path: str | Path) -> ColumnNames:
        """Read the names of a table in a file."""
        place, words = without_columns(path)
        with _parsing(path), _opened(place, f"file {place.name!r}", words[0] if words else None) as file:
            return cls(tuple(file.names))


def _parsing(path: str | Path) -> AbstractContextManager[None]:
    """Return a context in which exceptions of other libraries become errors of a file."""
    return parsing(f"file {shortened(Path(path).name)}", FORMATS)


@contextmanager
def _frame_file(
    path: str | Path, mapping: FrameMapping | str | Path | None, check: bool = True
) -> Iterator[tuple[TableFile, FrameMapping, str]]:
    """Open a file, folder or store, and return its quantities and its name without extension."""
    place, words = without_columns(path)
    given = FrameMapping.read(mapping) if isinstance(mapping, str | Path) else mapping
    name = words[0] if words else None if given is None or given.hdu is None else str(given.hdu)
    with _open_frames(place, given, name, check) as (file, how):
        yield file, how, place.stem


@contextmanager
def _open_frames(
    path: Path, mapping: FrameMapping | None, name: str | None, check: bool
) -> Iterator[tuple[TableFile, FrameMapping]]:
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
            open_one = partial(_opened, name=name, check=check)
            yield FolderFile(path, mapping, what, lambda one: open_one(one, f"file {one.name!r}")), mapping
        return
    with _opened(path, what, name, mapping, check, large=True) as file:
        yield file, mapping or (file.mapping if isinstance(file, StoredFile) else _recognised(file))


def _opened(
    path: Path,
    what: str,
    name: str | None,
    mapping: FrameMapping | None = None,
    check: bool = True,
    *,
    large: bool = False,
) -> AbstractContextManager[TableFile]:
    """Open a file with frames; only `large` ones may exceed MAUVECL_LARGEST_FILE_MIB."""

    def of_fits(hdus: Any) -> TableFile:
        return stored_in_fits(FitsTables(hdus, what), name) or FitsTables(hdus, what, name, _wanted(mapping))

    return open_table(
        path, what, expected=FORMATS, check=check, large=large, of_fits=of_fits,
        of_hdf5=lambda file: open_hdf5(file, name, what),
    )  # fmt: skip


def _wanted(mapping: FrameMapping | None) -> tuple[tuple[str, ...], ...]:
    """Return groups of names, of each of which the chosen table has one."""
    return (KNOWN["time"], KNOWN["flux"]) if mapping is None else tuple((name,) for name in mapping.times)


def _recognised(file: TableFile) -> FrameMapping:
    """Return the mapping of a file whose columns have known names."""
    # Of FITS files also images, but no columns of other extensions.
    names = [*file.columns, *(name for name in file.names if "/" not in name and name not in file.columns)]
    columns: dict[str, Any] = {key: first_of(known, names, file.what) for key, known in KNOWN.items()}
    if columns["time"] is None:
        said = {name: found for name in names if (found := time_in_name(name)) is not None}
        dated = [name for name, one in said.items() if one.epoch_mjd is not None]
        for place in ("BARYCENTER", "HELIOCENTER"):
            # Dates at the barycentre are those of the light; those at the Sun are seconds from them.
            dated = [name for name in dated if said[name].position == place] or dated
        if len(dated) > 1:
            fault = f"{file.what}: {len(dated)} columns may be the time: {', '.join(map(shortened, dated))}"
            raise InputError(fault, "a mapping that names one", key="time")
        timed = [name for name in said if re.match(r"t(?:ime)?[\s_.]", name, re.IGNORECASE)]
        columns["time"] = dated[0] if dated else first_of((*OTHER_TIMES, *timed), names, file.what)
    if columns["time"] is None:
        edges = tuple(first_of((name,), names, file.what) for name in EDGES)
        columns["time"] = None if None in edges else edges
    flux = divided_unit(columns["flux"] or "")[0]
    # Errors of another flux would be wrong ones.
    ends = ("_err", "_error", "err", "_e", "_unc", "_uncertainty", "_sigma", "_std")
    errors = [f"{flux}{end}" for end in ends] + [f"{start}{flux}" for start in ("e_", "err_", "sigma_", "sig_", "d")]
    errors += [flux.lower().replace("flux_", "flux_err_")] if "flux_" in flux.lower() else []
    columns["error"] = first_of((*errors, "error", "err", "uncertainty", "unc", "sigma"), names, file.what)
    if columns["flux"] is None and (magnitudes := [name for name in names if is_magnitude(name)]):
        fault = f"{file.what} has magnitudes ({', '.join(map(shortened, magnitudes))}) and no column of linear light"
        raise InputError(fault, "light in a linear unit, in a column named flux or that a mapping names", key="flux")
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
    def of(cls, file: TableFile, mapping: FrameMapping) -> Quantities:
        """Find the quantities of a mapping."""

        def found(name: str | None) -> Values | None:
            return None if name is None else file.find(name)

        times = tuple(file.axis(mapping.flux, 2) if name == "wcs" else file.find(name) for name in mapping.times)
        flux = file.find(mapping.flux)
        one = cls(times, flux, found(mapping.error), _flags(found(mapping.quality)), found(mapping.exposure),
                  found(mapping.temperature), _wavelength(file, mapping))  # fmt: skip
        nm = one.wavelength
        if nm is None or not nm.shape == flux.shape == times[0].shape or isinstance(file, FolderFile):
            return one
        if 32 * flux.n_rows > (most := limit_bytes("MAUVECL_LARGEST_CONTENT_MIB")):
            raise InputError(
                f"{file.what} has {flux.n_rows} rows of pixels",
                f"at most {most // 32}; MAUVECL_LARGEST_CONTENT_MIB sets the limit",
                key="MAUVECL_LARGEST_CONTENT_MIB",
            )
        return one._of_frames(nm, file.what)

    def _of_frames(self, wavelength: Values, what: str) -> Quantities:
        """Return the quantities of a long table with a row for each frame; errors and flags for each pixel.

        Raises InputError if a frame lacks a wavelength that another has, has one twice, or has two exposure times or
        temperatures.
        """
        key, nm = _keys(self.time[0]), wavelength.numbers()
        frames, frame = np.unique(key, return_inverse=True)
        pixels, pixel = np.unique(nm, return_inverse=True)
        counts = np.zeros((frames.size, pixels.size), np.int64)
        np.add.at(counts, (frame, pixel), 1)
        if (counts != 1).any():
            row, column = np.argwhere(counts != 1)[0]
            fault = (
                f"{what}: the frame at {frames[row]} has {counts[row, column]} rows of wavelength {pixels[column]:g}"
            )
            raise InputError(fault, "one row for each pixel of each frame", key="wavelength")
        place = np.empty(counts.shape, np.int64)
        place[frame, pixel] = np.arange(key.size)

        def spectra(values: Values) -> Values:
            return Values.of(values.name, values.numbers()[place], values.unit, what)

        def single(values: Values) -> Values:
            rows = _keys(values)[place]
            if (rows != rows[:, :1]).any():
                fault = f"{what}: {values.name!r} changes within a frame"
                raise InputError(fault, "one value for each frame", key=values.name)
            return Values.of(values.name, rows[:, 0], values.unit, what)

        error, quality = (one and spectra(one) for one in (self.error, self.quality))
        exposure, temperature = (one and single(one) for one in (self.exposure, self.temperature))
        axis = Values.of(wavelength.name, pixels, wavelength.unit, what)
        return Quantities(
            tuple(map(single, self.time)), spectra(self.flux), error, quality, exposure, temperature, axis
        )


def _flags(quality: Values | None) -> Values | None:
    """Return quality flags of which ``True`` and ``False`` in texts, and "bad" and "good", are 1 and 0."""
    texts = None if quality is None else quality.texts()
    # G and B are those of ASAS-SN.
    words = {"true": 1, "false": 0, "bad": 1, "good": 0, "b": 1, "g": 0}
    if quality is None or not texts or not {text.lower() for text in texts} <= {*words}:
        return quality
    return Values.of(quality.name, np.array([words[text.lower()] for text in texts]), what=quality.what)


def _wavelength(file: TableFile, mapping: FrameMapping) -> Values | None:
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


def _number_of_rows(file: TableFile, found: Quantities) -> int:
    """Return the number of frames before any is read; raise InputError unless all columns have as many."""
    what, n = file.what, found.time[0].n_rows
    if n == 0:
        raise InputError(f"{what} has no rows", "a row for each frame", key="frames")
    if n > MAX_FRAMES:
        raise InputError(f"{what} has {n} rows", f"at most {MAX_FRAMES} frames", key="frames")
    if found.wavelength is None:
        _check_one_source(file)
    for values in (*found.time, found.flux, found.error, found.quality, found.exposure, found.temperature):
        if values is not None and values.n_rows != n:
            raise InputError(f"{what}: {values.name!r} has {values.n_rows} rows", f"{n} as the times have",
                             key=values.name)  # fmt: skip
    single = found.time if found.wavelength is not None else (*found.time, found.flux)
    if odd := next((one for one in single if len(one.shape) == 2 and one.shape[1] > 1), None):
        expected = "one, or pixels with a wavelength, which a mapping names"
        raise InputError(f"{what}: {odd.name!r} holds {odd.shape[1]} values in each row", expected, key=odd.name)
    if len(found.flux.shape) > 2:
        pixels = " x ".join(map(str, found.flux.shape[1:]))
        raise InputError(f"{what}: {found.flux.name!r} holds images of {pixels} pixels, as target pixel files do",
                         "a light curve, such as lightkurve's `to_lightcurve` makes", key="flux")  # fmt: skip
    return n


def _temperature_c(file: TableFile, found: Quantities, mapping: FrameMapping, n: int) -> Float | None:
    """Return the detector temperature of each frame, from a column or the header, or None."""
    if found.temperature is not None:
        return converted(found.temperature, mapping.temperature_unit, "deg_C", "temperature_unit").numbers().reshape(n)
    nominal = file.header.get("CCD-TEMP")
    return np.full(n, float(nominal)) if isinstance(nominal, int | float) else None


def _brite_exposure_s(file: TableFile) -> float | None:
    """Return the exposure time in the header of BRITE's light curves, in milliseconds for each image of a stack."""
    try:
        found = 1e-3 * float(file.header["ObsExpoT"]) * float(file.header.get("ObsStack", 1.0))
    except (KeyError, ValueError):
        return None
    return found if 0.0 < found < np.inf else None


def _without_marks(light: Float) -> tuple[Float, Sequence[str]]:
    """Return light without marks of missing values, and what to say about them."""
    marks, said = marks_in(light, "values")
    return (np.where(np.isin(light, marks), np.nan, light), said) if marks else (light, ())


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


def _left_out(what: str, kept: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return the remark on rows without a time; raise InputError if no row has one."""
    if not kept.any():
        raise InputError(f"{what}: no row has a time", "times", key="time")
    n_left = int(np.count_nonzero(~kept))
    words = "1 row has no time and was" if n_left == 1 else f"{n_left} rows have no time and were"
    return (f"{what}: {words} left out",) if n_left else ()


def _frames_in(
    file: TableFile, mapping: FrameMapping, stem: str, read: Callable[..., Light] = whole_or_reduced
) -> Frames:
    """Build frames from a file and the names of its quantities; `read` returns their light."""
    what = file.what
    found = Quantities.of(file, mapping)
    n = _number_of_rows(file, found)
    time, exposure_s, dates, remarks = _times(found.time, file, mapping)
    if found.exposure is not None:
        exposure_s = converted(found.exposure, mapping.exposure_unit, "s", "exposure_unit").numbers().reshape(n)
    elif (one_s := mapping.exposure_s or _brite_exposure_s(file)) is not None:
        exposure_s = np.full(n, one_s)
    bits = QualityBits.of(file.header, mapping.quality_bits, what)
    wavelength = None if found.wavelength is None else _vacuum_nm(found.wavelength, mapping.wavelength_unit, file)
    light, sd, flags, unit, more = _read_light(file, found, mapping, bits, read)
    if len(light.shape) == 1:
        wavelength = None
    remarks += more
    kept = np.isfinite(time)
    remarks += _left_out(what, kept)
    temperature = _temperature_c(file, found, mapping, n)
    made = Frames.of(
        time[kept],
        light[kept],
        None if sd is None else sd[kept],
        exposure_s=None if exposure_s is None else exposure_s[kept],
        quality=None if flags is None else np.where(np.isfinite(flags), flags, bits.mask & -bits.mask)[kept],
        quality_mask=bits.mask,
        mission=bits.mission,
        name=mapping.name or str(file.header.get("OBJECT", "") or file.header.get("star", "") or stem),
        wavelength_nm=wavelength,
        temperature_c=None if temperature is None else temperature[kept],
        unit=unit,
        instrument=str(file.header.get("INSTRUME", "") or file.header.get("TELESCOP", "")).strip(),
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
    file: TableFile, found: Quantities, mapping: FrameMapping, bits: QualityBits, read: Callable[..., Light]
) -> tuple[Float, Float | None, Float | None, str, tuple[str, ...]]:
    """Return light, errors, flags, the unit of the light, and remarks; `read` returns the first three."""
    what = file.what
    unit, flux, error, remarks = _light(found, mapping)
    remarks += tuple(f"{what}: {text}" for text in file.remarks)
    if len(flux.shape) == 2 and flux.shape[1] == 1 and found.wavelength is None:
        flux, error = _single(flux), None if error is None else _single(error)
    light, sd, flags, more = read(flux, error, _masked(found.quality, bits))
    remarks += more
    light, said = _without_marks(without_indefinite(light))
    sd = None if sd is None else without_indefinite(sd)
    remarks += tuple(f"{what}: {text}" for text in said)
    unused = [name for name in file.columns if FLAGS & {*words_of(name)}]
    if found.quality is None and unused:
        remarks += (f"{what}: no flags are used; a mapping with quality names one of {', '.join(unused)}",)
    if len(light.shape) == 1:
        light, sd, unit, said = _of_level(light, sd, unit)
        remarks += tuple(f"{what}: {text}" for text in said)
    if sd is not None and not np.isfinite(sd).any():
        # lightkurve writes a column of NaN for errors that it does not know.
        sd = None
        remarks += (f"{what} has a column of errors without a number: it is left out",)
    if found.quality is not None and len(found.quality.shape) == 1:
        flags = decimal_flags(found.quality.numbers())
    return light, sd, flags, unit, remarks


def _check_one_source(file: TableFile) -> None:
    """Raise InputError if a column says that the rows are of several bands or stars."""
    for name in file.columns:
        if key_of(name) not in GROUPS or len((values := file.find(name)).shape) != 1:
            continue
        texts = values.texts()
        cells = [str(one) for one in np.unique(values.numbers())] if texts is None else texts
        held = sorted({cell for cell in cells if not is_missing(cell)})
        # The filter of ATLAS is called F, as is the light of others.
        if len(held) > 1 and (key_of(name) != "f" or all(map(str.isalpha, held))):
            fault = f"{file.what} has rows of {len(held)} different {name!r} ({shortened(', '.join(held), 80)})"
            raise InputError(fault, "the light of one star in one band: divide the table", key="flux")


def _masked(quality: Values | None, bits: QualityBits) -> Values | None:
    """Return quality flags without the bits that do not exclude a frame or a pixel."""
    if quality is None or bits.mask == ALL_BITS:
        return quality
    return quality.mapped(lambda flags: np.where(np.isfinite(flags), bits.mask & flags.astype(np.int64), flags), "")


def _times(
    time: tuple[Values, ...], file: TableFile, mapping: FrameMapping
) -> tuple[Float, Float | None, TimeSystem, tuple[str, ...]]:
    """Return times in seconds from the first, exposure times of frames with a start and an end, and their dates."""
    import astropy.units as u

    stated = TimeSystem.of(file.header, file.what)
    scale, position = scale_of(mapping.scale) or stated.scale, position_of(mapping.position) or stated.position
    epoch, remarks = mapping.epoch_mjd, []
    texts = [one.texts() for one in time]
    if all(text is not None and any(is_dated(cell) for cell in text) for text in texts):
        scale, unit, epoch, offset = scale or stated.default_scale or "utc", u.d, 0.0, 0.0
        edges = [mjd_of(text or [], scale, one.name, file.what) for text, one in zip(texts, time, strict=True)]
        if not (mapping.scale or stated.scale or stated.default_scale):
            remarks.append(f"the dates of {file.what} state no time scale and are assumed to be in UTC")
    else:
        edges = [one.numbers(DATE).ravel() for one in time]
        said, remarks = _time_unit(time, edges[0], file, mapping, stated)
        unit = u.Unit(said.unit)
        offset = stated.offset_in(unit, file.what)
        scale, position = scale or said.scale or stated.default_scale, position or said.position
        epoch = _epoch_mjd(said, stated, time[0].name, file.what) if epoch is None else epoch
    is_cheops = str(file.header.get("EXTNAME", "")).upper().startswith(CHEOPS)
    if is_cheops and position == "BARYCENTER" and not mapping.scale:
        scale = "tt"
        remarks.append(
            f"{time[0].name} of {file.what} is in TT, as in all files of CHEOPS; UTC is the scale of its other dates"
        )
    exposure = None if len(edges) == 1 else np.asarray(((edges[1] - edges[0]) * unit).to_value(u.s))
    seconds, first_d = seconds_from_first(np.mean(edges, axis=0) + offset, unit)
    at = 0.5 if len(edges) == 2 else PARTS.get(mapping.time_at or "", stated.at)
    if epoch is not None and mapping.epoch is None and not DATES_MJD[0] < epoch + first_d < DATES_MJD[1]:
        span = " and ".join(f"{float(edge):g}" for edge in (np.nanmin(edges[0]), np.nanmax(edges[0])))
        remarks.append(f"the times of {file.what} have no date, although their unit, name or header says so: {span}")
        epoch = None
    dates = replace(stated, epoch_mjd=None if epoch is None else epoch + first_d, scale=scale, position=position, at=at)
    return (seconds if epoch is not None else seconds + first_d * DAY_S), exposure, dates, tuple(remarks)


def _epoch_mjd(said: TimeUnit, stated: TimeSystem, name: str, what: str) -> float | None:
    """Return the MJD from which times count, as their unit or name says or else the header; these must agree."""
    if said.epoch_mjd is None or stated.epoch_mjd is None:
        return said.epoch_mjd if stated.epoch_mjd is None else stated.epoch_mjd
    if abs(said.epoch_mjd - stated.epoch_mjd) > 1e-5:
        fault = (
            f"{what}: {name!r} counts from MJD {said.epoch_mjd:g} by its unit or name and from {stated.epoch_mjd:g} by "
            "its header"
        )
        raise InputError(fault, "one epoch, or a mapping with epoch", key="epoch")
    return stated.epoch_mjd


def _time_unit(
    time: tuple[Values, ...], values: Float, file: TableFile, mapping: FrameMapping, stated: TimeSystem
) -> tuple[TimeUnit, list[str]]:
    """Return the unit of times and what it says of their zero: of the mapping, the column, its name, the header."""
    if len({one.unit or unit_in_name(one.name) for one in time}) > 1 and not mapping.time_unit:
        names = " and ".join(repr(one.name) for one in time)
        raise InputError(f"{file.what}: {names} have different units", "one unit", key="time")
    text = mapping.time_unit or time[0].unit or unit_in_name(time[0].name)
    named = time_in_name(time[0].name)
    said = named if not text else time_unit(text)
    if said is None:
        text = text or stated.unit
        said = time_unit(text) if text else None
        if said is None and text:
            # Checks the unit; times keep theirs, so that long times lose no digits.
            converted(replace(time[0], unit=text), None, "s", "time_unit")
            said = TimeUnit(str(unit_in(text)))
    if said is None:
        held = {*map(key_of, file.columns)}
        for columns, times, text in TIMES_OF_COLUMNS:
            if columns <= held:
                return times, [f"ASSUMED: the times of {file.what} are {text}; it states no unit"]
        words = {str(file.header.get(key, "") or "").strip().upper() for key in ("MISSION", "TELESCOP")}
        mission = next((one for one in MISSIONS if one in words), None)
        finite = values[np.isfinite(values)]
        if mission is None or not (finite.size and 0 < float(np.median(finite)) < 20_000):
            converted(time[0], None, "s", "time_unit")
        name = MISSIONS[mission or "TESS"].upper()
        said = time_unit(name) or TimeUnit("d")
        return said, [
            f"ASSUMED: the times of {file.what} are {name}, days, as in files of {mission}; it states no unit"
        ]
    if said.epoch_mjd is None and named is not None and named.unit == said.unit:
        said = named
    return said, []


def _light(found: Quantities, mapping: FrameMapping) -> tuple[str, Values, Values | None, tuple[str, ...]]:
    """Return the unit of the light, and light and errors in it."""
    remarks: tuple[str, ...] = ()
    stated = found.flux.unit or unit_in_name(found.flux.name)
    unit = mapping.flux_unit or stated
    if mapping.flux_unit and stated and mapping.flux_unit != stated:
        remarks = (f"the unit of {found.flux.name!r} is {mapping.flux_unit} as the mapping says, not {stated}",)
    words = set(words_of(found.flux.name))
    if not unit and (is_magnitude(found.flux.name) or words & {"log", "ln", "dex"}):
        expected = (
            "linear light: convert magnitudes and logarithms first, or name a linear unit as flux_unit in a mapping"
        )
        raise InputError.of("flux", found.flux.name, expected, where=found.flux.what)
    if re.match(r"\s*(?:dex|log|db)\b", unit, re.IGNORECASE) or ("mag" in unit.lower() and "magg" not in unit.lower()):
        raise InputError.of("flux_unit", unit, "a linear unit: light in magnitudes must be converted first",
                            where=found.flux.what)  # fmt: skip
    error = found.error
    if error is None:
        return unit, found.flux, None, remarks
    if error.shape != found.flux.shape:
        raise InputError(f"{error.what}: {error.name!r} has the shape {error.shape}",
                         f"that of the flux, {found.flux.shape}", key="error")  # fmt: skip
    own = error.unit or unit_in_name(error.name)
    if own and not unit and own.lower() in PARTS_OF_LEVEL:
        raise InputError(f"{error.what}: {error.name!r} is in {own}, and {found.flux.name!r} is not",
                         "errors in the unit of the light, or flux_unit = '1' in a mapping if its level is 1",
                         key="error")  # fmt: skip
    if own and unit and own not in (unit, stated):
        try:
            factor = float(unit_in(own).to(unit_in(unit)))
        except (ValueError, TypeError) as fault:
            raise InputError(f"{error.what}: {error.name!r} is in {own} and {found.flux.name!r} in {unit}",
                             "units of the same kind", key="error") from fault  # fmt: skip
        error = error.mapped(lambda values: values * factor, unit)
    return unit, found.flux, error, remarks


def _vacuum_nm(wavelength: Values, given: str | None, file: TableFile) -> Float:
    """Return the wavelengths of the pixels in vacuum, which must be the same in every frame."""
    plain, medium = unit_and_medium(given or "")
    stated, in_unit = unit_and_medium(wavelength.unit)
    nm = converted(replace(wavelength, unit=stated or ""), plain, "nm", "wavelength_unit")
    rows = np.atleast_2d(nm.rows(0, 1) if len(nm.shape) == 2 else nm.numbers())[0]
    if len(nm.shape) == 2:
        for part in nm.pieces:
            if not np.allclose(nm.rows(part.start, part.stop), rows, rtol=1e-9, atol=0.0):
                raise InputError(f"{wavelength.what}: the wavelengths change from frame to frame",
                                 "the same in every frame", key="wavelength")  # fmt: skip
    found, _ = vacuum_wavelengths(rows, wavelength.name, "", medium or in_unit, partial(medium_of, file.header))
    return found


def _single(values: Values) -> Values:
    """Return values of shape (n, 1) as (n,)."""
    return replace(values, shape=values.shape[:1], read=lambda start, stop: values.rows(start, stop)[:, 0])
