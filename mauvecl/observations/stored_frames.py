"""Frames in folders of spectra and in stores, read piece by piece, and weighted sums of their pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.host.arrays import Float
from mauvecl.host.tables.files import check_folder, limit_bytes, parsing
from mauvecl.host.tables.fits_tables import FitsTables
from mauvecl.host.tables.names import matched
from mauvecl.host.tables.opening import read_table
from mauvecl.host.tables.table import MemoryTable, TableFile, Values
from mauvecl.observations.frames import MAX_FRAMES, live_pixels
from mauvecl.observations.mapping import FrameMapping
from mauvecl.schema.errors import InputError, missing_package

#: Largest number of files in a folder.
MAX_FILES = 2**20


class FolderFile(TableFile):
    """Spectra in the files of a folder; quantities of frames are keywords of their headers or columns of a table."""

    def __init__(self, folder: Path, mapping: FrameMapping, what: str,
                 open_file: Callable[[Path], AbstractContextManager[TableFile]]) -> None:  # fmt: skip
        super().__init__(what, {}, [])
        self.open_file = open_file
        self.table: MemoryTable | None = None
        if mapping.table is not None:
            place = folder / mapping.table
            self.table = MemoryTable(read_table(place, "table of files"), f"table {mapping.table!r}")
            listed = self.table.find(mapping.files or "file")
            self.paths = [folder / str(name) for name in listed.texts() or listed.read(0, listed.n_rows)]
        else:
            self.paths = sorted(
                path for path in folder.glob(mapping.files or "*")
                if not path.is_dir() and not path.name.startswith(".") and path.suffix != ".toml"
            )  # fmt: skip
        if not 1 <= len(self.paths) <= MAX_FILES:
            fault = f"{what}: {mapping.files or '*'!r} must name 1 to {MAX_FILES} files, not {len(self.paths)}"
            raise InputError(fault, key="files")
        with open_file(self.paths[0]) as first:
            self.header = first.header
            self.names += [*(self.table.names if self.table else []), *map(str, self.header), *first.names]

    def named(self, name: str) -> Values | None:
        """Return a column of the table, a keyword of each header, or a column of each file."""
        if self.table is not None and (column := self.table.named(name)) is not None:
            return column
        if (keyword := matched(name, self.header)) is not None:
            found = [header.get(keyword) for header in self._headers]
            if None in found:
                fault = f"{self.what}: {self.paths[found.index(None)].name} needs the keyword {keyword}"
                raise InputError(fault, key=keyword)
            return Values.of(name, np.array(found), None, self.what)
        with self.open_file(self.paths[0]) as first:
            one = first.named(name) or (first.find(name) if "*" in name else None)
        if one is None:
            return None
        n = int(np.prod(one.shape))

        @lru_cache(maxsize=64)
        def values(number: int) -> Any:
            path = self.paths[number]
            with self.open_file(path) as file:
                found = file.find(name).numbers().ravel()
            if found.size != n:
                fault = f"{self.what}: {path.name} needs {n} values of {name!r} as in {self.paths[0].name}"
                raise InputError(f"{fault}, not {found.size}", key=name)
            return found

        def read(start: int, stop: int) -> Any:
            return np.stack([values(k) for k in range(start, stop)])

        # A column of every file, with one row per file.
        return Values(name, (len(self.paths), n), read, one.unit, self.what)

    def axis(self, name: str, dimension: int) -> Values:
        """Return the wavelengths of the first file's image; raise InputError if another file has others."""
        if dimension != 1:
            return super().axis(name, dimension)
        with self.open_file(self.paths[0]) as file:
            first = file.axis(name, 1)
        for path in self.paths[1:]:
            with self.open_file(path) as file:
                axis = file.axis(name, 1)
            if axis.shape != first.shape or not np.allclose(axis.numbers(), first.numbers(), rtol=1e-9, atol=0.0):
                fault = f"{self.what}: {path.name} must have the wavelengths of {self.paths[0].name}"
                raise InputError(fault, key="wavelength")
        return first

    @cached_property
    def _headers(self) -> list[dict[str, Any]]:
        headers = []
        for path in self.paths:
            with self.open_file(path) as file:
                headers.append(file.header)
        return headers


#: Attributes that every scene has.
REQUIRED = ("exposure_s", "frames", "instrument", "dark_unit", "saturation_dn")
#: Largest number of pixels of a spectrum.
MAX_PIXELS = 2**20
WHOLE = "give a whole file that `mauvecl realise` wrote"


class StoredFile(TableFile):
    """A scene of a store as frames, one exposure after the other, with and without dark and bias."""

    def __init__(
        self, what: str, path: str, raw: Any, calibration: Mapping[str, Float], of: Mapping[str, Any],
        numbers: NDArray[np.int64] | None,
    ) -> None:  # fmt: skip
        """Take raw spectra, in DN, with the calibration of their pixels.

        The array `path`, such as ``star-1/flare-1``, of the shape (n_realisation, n_pixel) or (n_realisation, n_frame,
        n_pixel), is read when it is sliced. `of` are attributes of an exposure, and `numbers` those of its stored
        frames, shape (n_frame,), or None.
        """
        if missing := [key for key in REQUIRED if key not in of]:
            raise InputError(f"{what} lacks {missing[0]} of {path}; give a file of this version of mauvecl", key="file")
        super().__init__(what, {"OBJECT": of.get("star", ""), "INSTRUME": of["instrument"]}, [])
        self.raw, self.calibration, self.attributes = raw, calibration, of
        self.stacked = int(of["frames"]) if numbers is None else 1
        self.per_row = 1 if numbers is None else numbers.size
        exposure, frame = float(of["exposure_s"]), float(of["exposure_s"]) / int(of["frames"])
        n, ceiling = int(raw.shape[0]) * self.per_row, self.stacked * float(of["saturation_dn"])
        if n > MAX_FRAMES:
            raise InputError(f"{what} must hold at most {MAX_FRAMES} frames of {path}, not {n}", key="frames")
        within = np.array([exposure / 2]) if numbers is None else (numbers + 0.5) * frame
        at, shape = np.arange(n), (n, calibration["wavelength_nm"].size)

        def saturated(start: int, stop: int) -> NDArray[np.int64]:
            return np.asarray((self._raw(start, stop) >= ceiling).any(axis=1), np.int64)

        parts = [
            Values.of("time", at // self.per_row * exposure + within[at % self.per_row], "s", what),
            Values.of("exposure", np.full(n, exposure if numbers is None else frame), "s", what),
            Values.of("wavelength", calibration["wavelength_nm"], "nm", what),
            Values("flux", shape, self._flux, "adu", what),
            Values("error", shape, self._error, "adu", what),
            Values("quality", (n,), saturated, "", what, 8 * shape[1]),
        ]
        if self.stacked == 1:
            parts.append(Values("raw", shape, self._raw, "adu", what))
        if "temperature_c" in of:
            parts.append(Values.of("temperature", np.full(n, float(of["temperature_c"])), "deg_C", what))
        self.parts = {one.name: one for one in parts}
        self.names += self.parts

    def named(self, name: str) -> Values | None:
        """Return a quantity."""
        return self.parts.get(name)

    def mapping(self, raw: bool = False) -> FrameMapping:
        """Return the names of the quantities; of `raw` ones, with bias and dark current, only in single frames."""
        if raw and self.stacked > 1:
            remedy = "give single frames: `mauvecl realise --frames all`"
            raise InputError(f"{self.what} holds sums of {self.stacked} frames; {remedy}", key="frames")
        names = {name: name for name in self.parts if name != "raw"}
        return FrameMapping(**names | {"flux_unit": "adu"} | ({"flux": "raw", "error": None} if raw else {}))

    def _raw(self, start: int, stop: int) -> Float:
        first, last = start // self.per_row, -(-stop // self.per_row)
        with parsing(self.what, WHOLE):
            raw = np.asarray(self.raw[first:last], np.float64).reshape(-1, self.parts["flux"].shape[1])
        skipped = first * self.per_row
        return raw[start - skipped : stop - skipped]

    def _flux(self, start: int, stop: int) -> Float:
        of = self.calibration
        return self._raw(start, stop) - self.stacked * (of["bias_dn"] + of["dark_dn"])

    def _error(self, start: int, stop: int) -> Float:
        """Return the noise of dark, readout and rounding, and the Poisson noise of the counts themselves."""
        of, gain = self.calibration, self.calibration["gain_dn_per_electron"]
        light = np.maximum(self._flux(start, stop), 0.0)
        dark = of["dark_dn"] * (1.0 if self.attributes["dark_unit"] == "DN" else gain)
        return np.asarray(np.sqrt(self.stacked * (of["read_noise_dn"] ** 2 + dark + 1 / 12) + gain * light))


@contextmanager
def open_stored(place: Path | IO[bytes], what: str, name: str | None) -> Iterator[StoredFile]:
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
        with parsing(what, WHOLE):
            root: Any = module.open_group(place, mode="r") if is_store else stack.enter_context(module.File(place, "r"))
            found = [f"{star}/{scene}" for star in sorted(root) if star.startswith("star-")
                     for scene in sorted(root[star])
                     if scene == "quiescent" or (scene.startswith("flare-") and scene[6:].isdigit())]  # fmt: skip
            path = _chosen(sorted(found, key=lambda one: "flare" in one), name, what)
            group = root[path.partition("/")[0]]
            names = ("wavelength_nm", "bias_dn", "dark_dn", "read_noise_dn", "gain_dn_per_electron")
            largest = max(int(group[key].size) for key in names)
            if largest > MAX_PIXELS:
                # A header may claim any number.
                raise InputError(f"{what} must hold at most {MAX_PIXELS} pixels, but holds {largest}", key="file")
            of = {key: np.asarray(group[key][:], np.float64) for key in names}
            frames = np.asarray(group["frame"][:], np.int64) if "frame" in group else None
            stored = StoredFile(what, path, root[path], of, dict(group.attrs), frames)
        yield stored


def stored_in_fits(file: FitsTables, name: str | None) -> StoredFile | None:
    """Return a scene of a FITS file that `mauvecl realise` wrote, or None for another file."""
    hdus = file.hdus
    scenes = {str(hdu.name): hdu for hdu in hdus if hdu.is_image and hdu.header.get("CTYPE1") == "WAVE-TAB"}
    if not str(hdus[0].header.get("ORIGIN", "")).startswith("mauvecl") or not scenes:
        return None
    names = {key.lower().replace("_", "/"): key for key in scenes}
    path = _chosen(list(names), name, file.what)
    hdu = scenes[names[path]]
    header = hdu.header
    with parsing(file.what, WHOLE):
        table = hdus[str(header["PS1_0"])].data
        of = {key.lower(): np.asarray(table[key][0], np.float64).ravel() for key in table.columns.names}
        of["wavelength_nm"] = of.pop("coords")
        frames = np.array([int(one) for one in str(header["FRAMES"]).split(",")]) if "FRAMES" in header else None
        # EXPTIME and NFRAMES are those of a row, which is a single frame or all frames of an exposure.
        attributes = {"star": header["OBJECT"], "instrument": header["INSTRUME"],
                      "dark_unit": header["DARKUNIT"], "exposure_s": header["TELAPSE"],
                      "frames": round(header["NFRAMES"] * header["TELAPSE"] / header["EXPTIME"])}  # fmt: skip
        attributes |= {key: header[word] for key, word in (("temperature_c", "CCD-TEMP"), ("saturation_dn", "SATURATE"))
                       if word in header}  # fmt: skip
        return StoredFile(file.what, path, hdu.section, of, attributes, frames)


def _chosen(found: list[str], name: str | None, what: str) -> str:
    """Return the requested scene, or the only one."""
    if not found:
        raise InputError(f"{what} holds no spectra; {WHOLE}", key="file")
    if name is None and len(found) > 1:
        fault = f"{what} holds {len(found)} arrays ({', '.join(found[:8])})"
        raise InputError(f"{fault}; give one, as in FILE[{found[-1]}]", key="hdu")
    wanted = name or found[0]
    if wanted not in found:
        raise InputError.of("hdu", wanted, f"one of {', '.join(found[:8])}", where=what)
    return wanted


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
    given = np.ones((1, n_pixel)) if weights is None else np.atleast_2d(np.asarray(weights, np.float64))
    if given.shape[1] != n_pixel or not np.isfinite(given).all():
        raise InputError.of("weights", given.shape, f"finite numbers of shape (n_weight, {n_pixel})", where=flux.what)
    statistics, finite = _statistics(flux, error, quality)
    live, remarks = live_pixels(finite, n, flux.what)
    sums = np.empty((n, len(given)))
    errors = None if error is None else np.empty_like(sums)
    for part in flux.pieces:
        sums[part] = _piece(flux, quality, part)[:, live] @ given[:, live].T
        if error is not None and errors is not None:
            errors[part] = np.sqrt(error.rows(part.start, part.stop)[:, live] ** 2 @ given[:, live].T ** 2)
    flags = _flags(quality)
    each: Any = errors.T if errors is not None else [None] * len(given)
    return [(light, sd, flags, remarks) for light, sd in zip(sums.T, each, strict=True)], statistics


def _piece(flux: Values, quality: Values | None, part: slice) -> Float:
    """Return rows of spectra, NaN in pixels with their own quality flag."""
    values = flux.rows(part.start, part.stop)
    if quality is not None and len(quality.shape) == 2:
        flags = quality.rows(part.start, part.stop) != 0
        values[flags & ~flags.all(axis=1, keepdims=True)] = np.nan
    return values


def _flags(quality: Values | None) -> Float | None:
    """Return one flag for each frame in which every pixel has one; None without flags of pixels."""
    if quality is None or len(quality.shape) == 1:
        return None
    rows = (quality.rows(part.start, part.stop) for part in quality.pieces)
    return np.concatenate([np.where((one != 0).all(axis=1), np.abs(one).max(axis=1), 0.0) for one in rows])


def _statistics(
    flux: Values, error: Values | None, quality: Values | None
) -> tuple[PixelStatistics, NDArray[np.int64]]:
    """Return statistics of frames without a fault, and how often each pixel is finite in any frame."""
    n_pixel = flux.shape[1]
    finite, count, pairs = np.zeros((3, n_pixel), np.int64)
    total, squares, stated = np.zeros((3, n_pixel))
    before = np.full((1, n_pixel), np.nan)
    for part in flux.pieces:
        values = _piece(flux, quality, part)
        finite += np.isfinite(values).sum(axis=0)
        if quality is not None and len(quality.shape) == 1:
            values[quality.rows(part.start, part.stop) != 0] = np.nan
        fine = np.isfinite(values)
        values[~fine] = np.nan
        count += fine.sum(axis=0)
        total += values.sum(axis=0, where=fine)
        steps = np.diff(values, axis=0, prepend=before)
        before = values[-1:].copy()
        del values
        known = np.isfinite(steps)
        pairs += known.sum(axis=0)
        squares += np.square(steps, out=steps).sum(axis=0, where=known)
        if error is not None:
            stated += np.where(fine, error.rows(part.start, part.stop) ** 2, 0.0).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, scatter = total / count, np.sqrt(squares / pairs / 2.0)
        return PixelStatistics(count, mean, scatter, None if error is None else np.sqrt(stated / count)), finite


def whole_or_reduced(flux: Values, error: Values | None, quality: Values | None) -> Light:
    """Read light whole if it fits into memory, else reduced to its sum over wavelength."""
    n_bytes = 8 * int(np.prod(flux.shape)) * (1 if error is None else 2)
    limit = limit_bytes("MAUVECL_LARGEST_CONTENT_MIB")
    if len(flux.shape) == 1 or n_bytes <= limit:
        light = np.empty(flux.shape)
        for part in flux.pieces:
            light[part] = _piece(flux, quality, part)
        return light, None if error is None else error.numbers(), _flags(quality), ()
    remark = (
        f"{flux.what} has {n_bytes / 2**20:.0f} MiB of spectra, more than {limit >> 20} MiB: they were summed over "
        "wavelength while they were read; MAUVECL_LARGEST_CONTENT_MIB sets the limit"
    )
    ((light, sd, flags, more),) = weighted_sums(flux, error, quality)[0]
    return light, sd, flags, (remark, *more)
