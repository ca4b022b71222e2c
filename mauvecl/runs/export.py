"""Export of raw spectra to a FITS or HDF5 file."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host import VERSION
from mauvecl.host.tables.files import check_folder, parsing, write_whole
from mauvecl.runs.store import CALIBRATION, COMMON_DRAWS, NOMINAL, Store, StoredScene, exposure_attributes
from mauvecl.schema.errors import InputError, missing_package

if TYPE_CHECKING:
    from astropy.io.fits import BinTableHDU, HDUList, ImageHDU


#: Largest size of the spectra in a file, bytes; larger sets belong in a store.
MAX_BYTES = 4 * 2**30
#: Accepted endings of file names.
ENDINGS = (".fits", ".h5", ".hdf5")


@dataclass(frozen=True, eq=False)
class Selection:
    """Arrays and rows of a store."""

    store: Store
    scenes: Sequence[StoredScene]
    first: int
    stop: int

    @classmethod
    def of(cls, store: Store, scenes: Sequence[str] | None = None, rows: tuple[int, int] | None = None) -> Selection:
        """Select arrays and rows of a store; the default is everything.

        Parameters
        ----------
        store : Store
        scenes : sequence of str, optional
            Paths such as ``"star-1/flare-2"``.
        rows : (int, int), optional
            Half-open range of realisations.

        Raises
        ------
        InputError
            For an unknown array, an invalid range, a size above `MAX_BYTES`, or missing chunks.
        """
        first, stop = store.range_of(rows)
        chosen = [store.scene(name) for name in scenes] if scenes else store.scenes
        selection = cls(store, chosen, first, stop)
        size = sum((stop - first) * scene.row_bytes for scene in chosen)
        if size > MAX_BYTES:
            raise InputError(
                f"one file may hold {MAX_BYTES // 2**30} GiB, but the spectra have {size / 2**30:.1f} GiB: choose rows",
                key="rows",
            )
        for chunk in store.chunks(first, stop):
            if any(chunk.scene is s for s in chosen) and not store.has(chunk):
                raise InputError(
                    f"{chunk.key} is missing: use `mauvecl realise --resume` to complete the store", key="store"
                )
        return selection

    def rows(self, scene: StoredScene) -> NDArray[Any]:
        """Read the spectra of an array."""
        import zarr

        place = self.store.path / scene.path
        check_folder(place, "file")
        with parsing(f"array {scene.path} of store {str(self.store.path)!r}", "use `mauvecl verify` to check it"):
            rows = np.asarray(zarr.open_array(place, mode="r")[self.first : self.stop])
        if rows.shape != (self.stop - self.first, *scene.row) or rows.dtype != scene.dtype:
            raise InputError(
                f"array {scene.path} has the shape {rows.shape} and the type {rows.dtype}, but its study needs "
                f"{(self.stop - self.first, *scene.row)} and {scene.dtype}",
                key="store",
            )
        return rows


def export(selection: Selection, path: str | Path, *, replace: bool = False) -> Path:
    """Write spectra, calibration and origin to a file, atomically.

    Parameters
    ----------
    selection : Selection
    path : str or Path
        File name ending in .fits, .h5 or .hdf5. A FITS file has an image per array, whose spectral axis refers to a
        table of wavelengths (-TAB, FITS standard, section 8.3), and a table of the calibration per star.
    replace : bool
        Whether to replace an existing file.

    Raises
    ------
    InputError
        For another ending, or if the file exists or cannot be written.
    """
    path = Path(path)
    if path.suffix not in ENDINGS:
        raise InputError.of("file", path.name, f"a name ending in {', '.join(ENDINGS)}")
    if path.exists() and not (replace and path.is_file()):
        others = "another name, or `replace=True`" if path.is_file() else "the name of a file"
        raise InputError(f"export {str(path)!r} exists already: use {others}", key="file")
    # Written to memory first, because the HDF5 library aborts the process on a full disk.
    packed = io.BytesIO()
    if path.suffix == ".fits":
        _fits(selection).writeto(packed, checksum=True)
    else:
        _hdf5(selection, packed)
    write_whole(path, packed.getbuffer(), shared=True)
    return path


def _fits(selection: Selection) -> HDUList:
    from astropy.io import fits

    store = selection.store
    primary = fits.PrimaryHDU()
    primary.header["ORIGIN"] = (f"mauvecl {VERSION}", "simulated, not observed")
    primary.header["SEED"] = (str(store.study.run.seed), "of the random numbers")
    primary.header["FIRSTROW"] = (selection.first, "realisation of the first row of each image")
    for line in (COMMON_DRAWS, NOMINAL):
        primary.header["COMMENT"] = f"{line[0].upper()}{line[1:]}."
    primary.header["HISTORY"] = "The table STUDY holds the study that gives these spectra again."
    parts: list[ImageHDU | BinTableHDU] = []
    for group in dict.fromkeys(scene.group for scene in selection.scenes):
        here = [scene for scene in selection.scenes if scene.group == group]
        x, n = here[0].expectation, here[0].expectation.wavelength_nm.size
        # The -TAB axis requires all wavelengths in one cell, of shape (1, n_pixel): one row, whose columns are vectors.
        columns = [fits.Column("COORDS", f"{n}D", unit="nm", dim=f"(1,{n})", array=x.wavelength_nm.reshape(1, n, 1))]
        for key, unit in CALIBRATION.items():
            unit = unit.replace("DN", "adu").replace(" ", "")
            columns.append(fits.Column(key.upper(), f"{n}D", unit=unit, array=getattr(x, key).reshape(1, n)))
        name = f"{group}-calibration".upper().replace("-", "_")
        table = fits.BinTableHDU.from_columns(columns, name=name)
        parts += [*(_image(selection, scene, table.name) for scene in here), table]
    # Its lines may exceed the 72 characters of a card. FITS is restricted to ASCII; TOML strings accept escapes.
    text = re.sub(r"[^\x00-\x7f]", lambda letter: f"\\U{ord(letter[0]):08X}", store.study.toml())
    lines = text.splitlines()
    column = fits.Column("LINE", f"{max(map(len, lines))}A", array=lines)
    return fits.HDUList([primary, *parts, fits.BinTableHDU.from_columns([column], name="STUDY")])


def _image(selection: Selection, scene: StoredScene, table: str) -> ImageHDU:
    from astropy.io import fits

    x = scene.expectation
    hdu = fits.ImageHDU(selection.rows(scene), name=scene.path.upper().replace("/", "_"))
    header = hdu.header
    header["BUNIT"] = "adu"
    # FITS is restricted to ASCII, and files of spectra may have any name.
    header["OBJECT"] = scene.star.encode("ascii", "backslashreplace").decode()
    header["AMPLITUD"] = (scene.amplitude, "flare amplitude, 0 without a flare")
    header["EXPTIME"] = (x.frame_s if scene.frames is not None else x.exposure_s, "[s] of one row")
    header["TELAPSE"] = (x.exposure_s, "[s] of one realisation")
    header["INSTRUME"] = x.instrument
    header["SATURATE"] = (float(x.saturation_dn), "[adu] of a single frame, with bias")
    header["DARKUNIT"] = (x.dark_unit, "in which dark counts follow Poisson's law")
    if "temperature_c" in x.conditions:
        header["CCD-TEMP"] = (x.conditions["temperature_c"], "[Celsius]")
    header["NFRAMES"] = (1 if scene.frames is not None else x.n_frames, "frames summed in one row")
    # Axis 1 is the vacuum wavelength, by pixel from the calibration table.
    header["CTYPE1"], header["CUNIT1"] = "WAVE-TAB", "nm"
    header["CRPIX1"], header["CRVAL1"], header["CDELT1"] = 1.0, 1.0, 1.0
    header["PS1_0"] = (table, "extension of the coordinates")
    header["PS1_1"] = ("COORDS", "column of the coordinates")
    header["PV1_1"], header["PV1_2"], header["PV1_3"] = 1, 1, 1
    for number, name in enumerate(scene.dimensions[-2::-1], 2):
        first = float(selection.first if name == "realisation" else 0)
        header[f"CTYPE{number}"], header[f"CNAME{number}"] = "LINEAR", name
        header[f"CRPIX{number}"], header[f"CRVAL{number}"], header[f"CDELT{number}"] = 1.0, first, 1.0
    if scene.frames is not None:
        header["FRAMES"] = (",".join(map(str, scene.frames)), "numbers of the frames along axis 2")
    return hdu


def _hdf5(selection: Selection, place: io.BytesIO) -> None:
    try:
        import h5py
    except ImportError as error:
        raise missing_package("h5py", "an HDF5 file", "bulk") from error

    store = selection.store
    with h5py.File(place, "w") as file:
        file.attrs.update({"mauvecl": VERSION, "study": store.study.toml(), "seed": str(store.study.run.seed)})
        file.attrs.update({"first_row": selection.first, "draws": COMMON_DRAWS, "throughput": NOMINAL})
        for scene in selection.scenes:
            group = file.require_group(scene.group)
            if "wavelength_nm" not in group:
                group.attrs.update({"star": scene.star} | exposure_attributes(scene.expectation))
                if scene.frames is not None:
                    group["frame"] = np.array(scene.frames)
                for name, unit in CALIBRATION.items():
                    group[name] = getattr(scene.expectation, name)
                    group[name].attrs["units"] = unit
                group["wavelength_nm"].make_scale("wavelength")
            data = group.create_dataset(scene.name, data=selection.rows(scene), fletcher32=True, chunks=True)
            data.attrs.update({"units": "DN", "amplitude": scene.amplitude})
            for dimension, name in zip(data.dims, scene.dimensions, strict=True):
                dimension.label = name
            data.dims[data.ndim - 1].attach_scale(group["wavelength_nm"])
