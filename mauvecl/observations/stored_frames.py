"""Frames in folders of spectra and in stores, read piece by piece, and weighted sums of their pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.arrays import Float
from mauvecl.host.tables.files import check_folder, limit_bytes, parsing
from mauvecl.host.tables.fits_tables import FitsTables
from mauvecl.host.tables.names import match_name
from mauvecl.host.tables.opening import read_table
from mauvecl.host.tables.table import MemoryTable, TableFile, Values, ends_of, marks_in, without_indefinite
from mauvecl.observations.frames import MAX_FRAMES, live_pixels
from mauvecl.observations.mapping import FrameMapping
from mauvecl.schema.errors import InputError, missing_package

#: Largest number of files in a folder.
MAX_FILES = 2**20


class FolderFile(TableFile):
    """Spectra in the files of a folder; quantities of frames are keywords of their headers or columns of a table."""

    def __init__(self, folder: Path, mapping: FrameMapping, label: str,
                 open_file: Callable[[Path], AbstractContextManager[TableFile]]) -> None:  # fmt: skip
        super().__init__(label, {}, [])
        self.open_file = open_file
        self.table: MemoryTable | None = None
        if mapping.table is not None:
            place = folder / mapping.table
            self.table = MemoryTable(read_table(place, "table of files"), f"table {mapping.table!r}")
            listed = self.table.find(mapping.files or "file")
            self.paths = [folder / str(name) for name in listed.texts() or listed.cells]
        else:
            self.paths = sorted(
                path for path in folder.glob(mapping.files or "*")
                if not path.is_dir() and not path.name.startswith(".") and path.suffix != ".toml"
            )  # fmt: skip
        if not 1 <= len(self.paths) <= MAX_FILES:
            fault = f"{label}: {mapping.files or '*'!r} must name 1 to {MAX_FILES} files, not {len(self.paths)}"
            raise InputError(fault, key="files")
        with open_file(self.paths[0]) as first:
            self.header = first.header
            self.names += [*(self.table.names if self.table else []), *map(str, self.header), *first.names]

    def named(self, name: str) -> Values | None:
        """Return a column of the table, a keyword of each header, or a column of each file."""
        if self.table is not None and (column := self.table.named(name)) is not None:
            return column
        if (keyword := match_name(name, self.header)) is not None:
            cells = [header.get(keyword) for header in self._headers]
            if None in cells:
                fault = f"{self.label}: {self.paths[cells.index(None)].name} needs the keyword {keyword}"
                raise InputError(fault, key=keyword)
            return Values.of(name, np.array(cells), None, self.label)
        with self.open_file(self.paths[0]) as first:
            column = first.named(name) or (first.find(name) if "*" in name else None)
        if column is None:
            return None
        n = int(np.prod(column.shape))

        @lru_cache(maxsize=64)
        def row(path: Path) -> Any:
            with self.open_file(path) as file:
                numbers = file.find(name).numbers().ravel()
            if numbers.size != n:
                fault = f"{self.label}: {path.name} needs {n} values of {name!r} as in {self.paths[0].name}"
                raise InputError(f"{fault}, not {numbers.size}", key=name)
            return numbers

        return Values(name, (len(self.paths), n), lambda piece: np.stack([*map(row, self.paths[piece])]), column.unit,
                      self.label, keywords=column.keywords)  # fmt: skip

    def axis(self, name: str, dimension: int) -> Values:
        """Return the wavelengths of the first file's image; raise InputError if another file has others."""
        if dimension != 1:
            return super().axis(name, dimension)
        axes = (file.axis(name, 1) for file in self._files())
        first = next(axes)
        for path, axis in zip(self.paths[1:], axes, strict=True):
            if axis.shape != first.shape or not np.allclose(axis.numbers(), first.numbers(), rtol=1e-9, atol=0.0):
                fault = f"{self.label}: {path.name} must have the wavelengths of {self.paths[0].name}"
                raise InputError(fault, key="wavelength")
        return first

    def _files(self) -> Iterator[TableFile]:
        for path in self.paths:
            with self.open_file(path) as file:
                yield file

    @cached_property
    def _headers(self) -> list[dict[str, Any]]:
        return [file.header for file in self._files()]


#: Attributes that every scene has, and calibrations of its pixels.
REQUIRED = ("exposure_s", "frames", "instrument", "dark_unit", "saturation_dn")
CALIBRATION = ("wavelength_nm", "bias_dn", "dark_dn", "read_noise_dn", "gain_dn_per_electron")
#: Largest number of pixels of a spectrum.
MAX_PIXELS = 2**20
WHOLE = "give a whole file that `mauvecl realise` wrote"


class StoredFile(TableFile):
    """A scene of a store as frames, one exposure after the other, with and without dark and bias."""

    def __init__(
        self, label: str, path: str, raw: Any, pixels: Mapping[str, Float], attributes: Mapping[str, Any],
        numbers: NDArray[np.int64] | None,
    ) -> None:  # fmt: skip
        """Take raw spectra, in DN, with the calibration of their pixels.

        The array `path`, such as ``star-1/flare-1``, of the shape (n_realisation, n_pixel) or (n_realisation, n_frame,
        n_pixel), is read when it is sliced. Attributes are those of an exposure, and `numbers` those of its stored
        frames, shape (n_frame,), or None.
        """
        if missing := [key for key in REQUIRED if key not in attributes]:
            fault = f"{label} lacks {missing[0]} of {path}"
            raise InputError(f"{fault}; give a file of this version of mauvecl", key="file")
        super().__init__(label, {"OBJECT": attributes.get("star", ""), "INSTRUME": attributes["instrument"]}, [])
        exposure, per_exposure = float(attributes["exposure_s"]), int(attributes["frames"])
        within = np.array([exposure / 2]) if numbers is None else (numbers + 0.5) * (exposure / per_exposure)
        #: Number of frames whose sum is a row.
        self.stacked = stacked = per_exposure if numbers is None else 1
        n_rows, n, n_pixel = within.size, int(raw.shape[0]) * within.size, pixels["wavelength_nm"].size
        if n > MAX_FRAMES:
            raise InputError(f"{label} must hold at most {MAX_FRAMES} frames of {path}, not {n}", key="frames")

        def read(piece: slice) -> Float:
            first, last = piece.start // n_rows, -(-piece.stop // n_rows)
            with parsing(label, WHOLE):
                rows = np.asarray(raw[first:last], np.float64).reshape(-1, n_pixel)
            return rows[piece.start - first * n_rows : piece.stop - first * n_rows]

        gain, ceiling = pixels["gain_dn_per_electron"], stacked * float(attributes["saturation_dn"])
        offset = stacked * (pixels["bias_dn"] + pixels["dark_dn"])
        dark = pixels["dark_dn"] * (1.0 if attributes["dark_unit"] == "DN" else gain)
        fixed = stacked * (pixels["read_noise_dn"] ** 2 + dark + 1 / 12)
        counts, row = Values("raw", (n, n_pixel), read, "adu", label), np.arange(n)
        flux = replace(counts.mapped(lambda dn: dn - offset, "adu"), name="flux")
        # Noise of dark, readout and rounding, and the Poisson noise of the counts themselves.
        error = flux.mapped(lambda light: np.asarray(np.sqrt(fixed + gain * np.maximum(light, 0.0))), "adu")
        saturated = counts.mapped(lambda dn: np.asarray((dn >= ceiling).any(axis=1), np.float64), "")
        quantities = [
            Values.of("time", row // n_rows * exposure + within[row % n_rows], "s", label),
            Values.of("exposure", np.full(n, exposure if numbers is None else exposure / per_exposure), "s", label),
            Values.of("wavelength", pixels["wavelength_nm"], "nm", label),
            flux,
            replace(error, name="error"),
            replace(saturated, name="quality", shape=(n,), row_bytes=8 * n_pixel),
            *([counts] if stacked == 1 else []),
        ]
        if "temperature_c" in attributes:
            quantities.append(Values.of("temperature", np.full(n, float(attributes["temperature_c"])), "deg_C", label))
        self.quantities = {values.name: values for values in quantities}
        self.names += self.quantities

    def named(self, name: str) -> Values | None:
        """Return a quantity."""
        return self.quantities.get(name)

    def mapping(self, raw: bool = False) -> FrameMapping:
        """Return the names of the quantities; of `raw` ones, with bias and dark current, only in single frames."""
        if raw and self.stacked > 1:
            remedy = "give single frames: `mauvecl realise --frames all`"
            raise InputError(f"{self.label} holds sums of {self.stacked} frames; {remedy}", key="frames")
        names = {name: name for name in self.quantities if name != "raw"}
        return FrameMapping(**names | {"flux_unit": "adu"} | ({"flux": "raw", "error": None} if raw else {}))


@contextmanager
def open_stored(place: Path | IO[bytes], label: str, name: str | None) -> Iterator[StoredFile]:
    """Open a scene of a Zarr store or of an HDF5 file, which have the same layout."""
    is_store = isinstance(place, Path)
    package = "zarr" if is_store else "h5py"
    try:
        module = import_module(package)
    except ImportError as error:
        raise missing_package(package, "a store", "bulk") from error
    if isinstance(place, Path):
        check_folder(place, "file")
    with ExitStack() as stack:
        with parsing(label, WHOLE):
            root: Any = module.open_group(place, mode="r") if is_store else stack.enter_context(module.File(place, "r"))
            scenes = [f"{star}/{scene}" for star in sorted(root) if star.startswith("star-")
                     for scene in sorted(root[star])
                     if scene == "quiescent" or (scene.startswith("flare-") and scene[6:].isdigit())]  # fmt: skip
            path = _requested_scene(sorted(scenes, key=lambda path: "flare" in path), name, label)
            group = root[path.partition("/")[0]]
            # A header may claim any number.
            if (largest := max(int(group[key].size) for key in CALIBRATION)) > MAX_PIXELS:
                raise InputError(f"{label} must hold at most {MAX_PIXELS} pixels, but holds {largest}", key="file")
            pixels = {key: np.asarray(group[key][:], np.float64) for key in CALIBRATION}
            frames = np.asarray(group["frame"][:], np.int64) if "frame" in group else None
            stored = StoredFile(label, path, root[path], pixels, dict(group.attrs), frames)
        yield stored


def stored_in_fits(file: FitsTables, name: str | None) -> StoredFile | None:
    """Return a scene of a FITS file that `mauvecl realise` wrote, or None for another file."""
    hdus = file.hdus
    scenes = {str(hdu.name): hdu for hdu in hdus if hdu.is_image and hdu.header.get("CTYPE1") == "WAVE-TAB"}
    if not str(hdus[0].header.get("ORIGIN", "")).startswith("mauvecl") or not scenes:
        return None
    names = {key.lower().replace("_", "/"): key for key in scenes}
    path = _requested_scene(list(names), name, file.label)
    hdu = scenes[names[path]]
    header = hdu.header
    with parsing(file.label, WHOLE):
        table = hdus[str(header["PS1_0"])].data
        pixels = {key.lower(): np.asarray(table[key][0], np.float64).ravel() for key in table.columns.names}
        pixels["wavelength_nm"] = pixels.pop("coords")
        frames = np.array([int(number) for number in str(header["FRAMES"]).split(",")]) if "FRAMES" in header else None
        # EXPTIME and NFRAMES are those of a row, which is a single frame or all frames of an exposure.
        attributes = {"star": header["OBJECT"], "instrument": header["INSTRUME"],
                      "dark_unit": header["DARKUNIT"], "exposure_s": header["TELAPSE"],
                      "frames": round(header["NFRAMES"] * header["TELAPSE"] / header["EXPTIME"])}  # fmt: skip
        attributes |= {key: header[word] for key, word in (("temperature_c", "CCD-TEMP"), ("saturation_dn", "SATURATE"))
                       if word in header}  # fmt: skip
        return StoredFile(file.label, path, hdu.section, pixels, attributes, frames)


def _requested_scene(scenes: list[str], name: str | None, label: str) -> str:
    """Return the requested scene, or the only one."""
    if not scenes:
        raise InputError(f"{label} holds no spectra; {WHOLE}", key="file")
    if name is None and len(scenes) > 1:
        fault = f"{label} holds {len(scenes)} arrays ({', '.join(scenes[:8])})"
        raise InputError(f"{fault}; give one, as in FILE[{scenes[-1]}]", key="hdu")
    if name and name not in scenes:
        raise InputError.of("hdu", name, f"one of {', '.join(scenes[:8])}", where=label)
    return name or scenes[0]


#: Light, errors and quality of frames, and remarks.
Light = tuple[Float, Float | None, Float | None, tuple[str, ...]]


@dataclass(frozen=True, eq=False)
class PixelStatistics:
    """Light and noise of each pixel over the frames without a fault, arrays of shape (n_pixel,)."""

    count: NDArray[np.int64]  #: frames in which the pixel is finite
    mean: Float  #: light of a frame
    scatter: Float  #: standard deviation of a frame, from differences of neighbours: slow changes have no part in it
    stated: Float | None  #: root of the mean of the squared errors that the file states


def weighted_sums(
    flux: Values, error: Values | None, quality: Values | None, weights: ArrayLike | None = None
) -> tuple[list[Light], PixelStatistics]:
    """Reduce spectra to weighted sums, by default the sum over all pixels, reading them twice in pieces.

    Quality has the shape of the flux or of its frames, and is zero where nothing is wrong. Pixels that are not finite
    in most frames are left out, other frames with one have no sum, and errors of pixels are taken to be independent.
    """
    n, n_pixel = flux.shape
    factors = np.ones((1, n_pixel)) if weights is None else np.atleast_2d(np.asarray(weights, np.float64))
    if factors.shape[1] != n_pixel or not np.isfinite(factors).all():
        expected = f"finite numbers of shape (n_weight, {n_pixel})"
        raise InputError.of("weights", factors.shape, expected, where=flux.label)
    flux = _without_flagged_pixels(flux, quality)
    statistics, finite, ends = _statistics(flux, error, quality)
    flux, notes = _without_marks(flux, ends)
    if notes:
        statistics, finite, _ = _statistics(flux, error, quality)
    live, remarks = live_pixels(finite, n, flux.label)
    columns, flags = factors[:, live].T, _flags_of_frames(quality)
    sums = np.concatenate([flux.rows(piece)[:, live] @ columns for piece in flux.pieces])
    errors: Any = [None] * len(factors)
    if error is not None:
        errors = np.concatenate([np.sqrt(error.rows(piece)[:, live] ** 2 @ columns**2) for piece in error.pieces]).T
    return [(light, sd, flags, notes + remarks) for light, sd in zip(sums.T, errors, strict=True)], statistics


def _without_flagged_pixels(flux: Values, quality: Values | None) -> Values:
    """Return light that is NaN where it is missing, and in pixels with their own quality flag."""

    def read(piece: slice) -> Float:
        values = without_indefinite(flux.rows(piece))
        if quality is not None and len(quality.shape) == 2:
            flags = quality.rows(piece) != 0
            values[flags & ~flags.all(axis=1, keepdims=True)] = np.nan
        return values

    return replace(flux, read=read)


def _without_marks(flux: Values, ends: tuple[float, float]) -> tuple[Values, tuple[str, ...]]:
    """Return light that is NaN where a number such as -999 marks a missing value, and remarks; see `marks_in`."""
    marks, notes = marks_in(flux, ends, "value", "values")
    unmarked = flux.mapped(lambda values: np.where(np.isin(values, marks), np.nan, values), flux.unit)
    return unmarked if marks else flux, tuple(f"{flux.label}: {text}" for text in notes)


def _flags_of_frames(quality: Values | None) -> Float | None:
    """Return one flag for each frame in which every pixel has one; None without flags of pixels."""
    if quality is None or len(quality.shape) == 1:
        return None
    rows = map(quality.rows, quality.pieces)
    return np.concatenate([np.where((flags != 0).all(axis=1), np.abs(flags).max(axis=1), 0.0) for flags in rows])


def _statistics(
    flux: Values, error: Values | None, quality: Values | None
) -> tuple[PixelStatistics, NDArray[np.int64], tuple[float, float]]:
    """Return statistics of frames without a fault, how often each pixel is finite in any frame, and the ends."""
    n_pixel = flux.shape[1]
    finite, count, pairs = np.zeros((3, n_pixel), np.int64)
    total, squares, squared_errors = np.zeros((3, n_pixel))
    before, ends = np.full((1, n_pixel), np.nan), (0.0, 0.0)
    for piece in flux.pieces:
        values = flux.rows(piece)
        ends = ends_of(np.array([*ends, *ends_of(values)]))
        finite += np.isfinite(values).sum(axis=0)
        if quality is not None:
            values[(quality.rows(piece).reshape(len(values), -1) != 0).all(axis=1)] = np.nan
        fine = np.isfinite(values)
        values[~fine] = np.nan
        steps = np.diff(values, axis=0, prepend=before)
        before = values[-1:].copy()
        count += fine.sum(axis=0)
        pairs += np.isfinite(steps).sum(axis=0)
        total += np.nansum(values, axis=0)
        squares += np.nansum(steps**2, axis=0)
        if error is not None:
            squared_errors += (error.rows(piece) ** 2).sum(axis=0, where=fine)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, scatter = total / count, np.sqrt(squares / pairs / 2.0)
        rms = None if error is None else np.sqrt(squared_errors / count)
    return PixelStatistics(count, mean, scatter, rms), finite, ends


def read_light(flux: Values, error: Values | None, quality: Values | None) -> Light:
    """Read light whole if it fits into memory, else reduced to its sum over wavelength."""
    n_bytes = 8 * int(np.prod(flux.shape)) * (1 if error is None else 2)
    limit = limit_bytes("MAUVECL_LARGEST_CONTENT_MIB")
    if len(flux.shape) == 1 or n_bytes <= limit:
        light = _without_flagged_pixels(flux, quality).numbers()
        whole, notes = _without_marks(replace(flux, read=light.__getitem__), ends_of(light))
        return whole.numbers(), None if error is None else error.numbers(), _flags_of_frames(quality), notes
    size = f"{n_bytes / 2**20:.0f} MiB of spectra, more than {limit >> 20} MiB"
    done = "they were summed over wavelength while they were read; MAUVECL_LARGEST_CONTENT_MIB sets the limit"
    ((light, sd, flags, more),) = weighted_sums(flux, error, quality)[0]
    return light, sd, flags, (f"{flux.label} has {size}: {done}", *more)
