"""Read frames from files: tables with a row per frame, and what mauvecl writes itself."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.files.parsing import as_text, parsing
from mauvecl.host.files.size_limits import read_bytes, unpacked
from mauvecl.host.files.text_table import text_table
from mauvecl.host.spectra.fits_files import check_sizes
from mauvecl.observations.frames import Frames
from mauvecl.observations.mapping import FrameMapping
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.physical import DAY_S
from mauvecl.schema.text import shown

if TYPE_CHECKING:
    from astropy.table import Table

Float = NDArray[np.float64]

FORMATS = "a table in FITS, ECSV or CSV with a row for each frame"
#: Names of columns that need no mapping, in order of preference: those of mauvecl, of TESS and Kepler light curves, and
#: of lightkurve's and AltaiPony's tables.
KNOWN = {
    "time": ("time",),
    "flux": ("pdcsap_flux", "flux", "sap_flux"),
    "error": ("pdcsap_flux_err", "flux_err", "sap_flux_err", "flux_error", "error"),
    "quality": ("quality", "sap_quality"),
}


@dataclass(frozen=True, eq=False)
class FileTable:
    """A table of a file with the keywords of its header."""

    table: Table
    header: dict[str, Any]
    others: dict[str, Any]  # arrays of other extensions, by name


@validated
def read_frames(path: str | Path, mapping: FrameMapping | str | Path | None = None) -> Frames:
    """Read frames from a file.

    Parameters
    ----------
    path : str or Path
        FITS, ECSV or CSV, packed or not, with a row for each frame.
    mapping : FrameMapping or path, optional
        Where the quantities are. Files of mauvecl, TESS, Kepler and lightkurve need none.
    """
    path = Path(path)
    if isinstance(mapping, str | Path):
        mapping = FrameMapping.read(mapping)
    what = f"file {path.name!r}"
    content = unpacked(read_bytes(path, "file"), what)
    if content.startswith(b"SIMPLE  ="):
        found = _fits_table(content, what, mapping)
    else:
        text = as_text(content, what)
        found = FileTable(text_table(text, what, path.suffix.lower() == ".csv", FORMATS), {}, {})
    return _frames(found, mapping or _recognised(found, what), what, path.stem)


def _fits_table(content: bytes, what: str, mapping: FrameMapping | None) -> FileTable:
    """Return the table of a FITS file that a mapping names, or the first that has times and light."""
    from astropy.io import fits
    from astropy.table import Table

    try:
        check_sizes(content)
    except InputError as error:
        raise error.within(what) from error
    with parsing(what, FORMATS), warnings.catch_warnings(), fits.open(io.BytesIO(content), memmap=False) as hdus:
        warnings.simplefilter("ignore")
        tables = {n: hdu for n, hdu in enumerate(hdus) if isinstance(hdu, fits.BinTableHDU | fits.TableHDU)}
        others = {
            str(hdu.name): np.asarray(hdu.data, np.float64)
            for hdu in hdus
            if isinstance(hdu, fits.ImageHDU | fits.PrimaryHDU) and hdu.data is not None
        }
        for hdu in tables.values():
            if hdu.name == "WAVELENGTH" and "WAVELENGTH" in hdu.columns.names:
                others["WAVELENGTH"] = np.asarray(hdu.data["WAVELENGTH"], np.float64)
        header = dict(hdus[0].header)
        for number, hdu in tables.items():
            names = {str(name).lower() for name in hdu.columns.names}
            wanted = mapping is not None and mapping.hdu is not None
            if wanted and str(mapping.hdu) not in (hdu.name, str(number)):  # type: ignore[union-attr]
                continue
            if wanted or mapping is not None or ("time" in names and names & set(KNOWN["flux"])):
                return FileTable(Table.read(hdu), header | dict(hdu.header), others)
        seen = ", ".join(f"{hdu.name or number}" for number, hdu in tables.items()) or "none"
        named = "" if mapping is None or mapping.hdu is None else f" called {mapping.hdu!r}"
        raise InputError(f"{what} has the tables {seen}", f"one{named} with columns of time and flux", key="hdu")


def _recognised(found: FileTable, what: str) -> FrameMapping:
    """Return the mapping of a table whose columns have known names."""
    lower = {str(name).lower(): str(name) for name in found.table.colnames}
    columns = {key: next((lower[n] for n in names if n in lower), None) for key, names in KNOWN.items()}
    if columns["time"] is None or columns["flux"] is None:
        raise InputError(
            f"{what} has the columns {shown(', '.join(map(str, found.table.colnames)), 300)}",
            "columns named time and flux, or a mapping that names them",
            key="mapping",
        )
    spectra = "SPECTRUM" in found.others and "WAVELENGTH" in found.others
    if spectra:
        columns |= {"flux": "SPECTRUM", "error": "SPECTRUM_ERR", "wavelength": "WAVELENGTH"}
    given = {key: value for key, value in columns.items() if value is not None}
    return FrameMapping(**given, wavelength_unit="nm" if spectra else None)


def _frames(found: FileTable, mapping: FrameMapping, what: str, stem: str) -> Frames:
    columns = _Columns(found, what)
    unit = mapping.time_unit
    edges = [columns.numbers(name, unit, "s", "time_unit") for name in _several(mapping.time)]
    exposure: Float | float | None = mapping.exposure_s
    if mapping.exposure is not None:
        exposure = columns.numbers(mapping.exposure, None, "s", "")
    if len(edges) == 2:
        time, exposure = (edges[0] + edges[1]) / 2, edges[1] - edges[0]
    else:
        time = edges[0]
    flux = columns.plain(mapping.flux)
    n = time.size
    error = None if mapping.error is None else columns.plain(mapping.error)
    quality = None if mapping.quality is None else columns.whole(mapping.quality)
    wavelength = None if mapping.wavelength is None else columns.numbers(
        mapping.wavelength, mapping.wavelength_unit, "nm", "wavelength_unit")  # fmt: skip
    temperature = None if mapping.temperature is None else columns.numbers(mapping.temperature, "deg_C", "deg_C", "")
    epoch, scale, position = mapping.epoch_mjd, mapping.scale, mapping.position
    if epoch is None:
        epoch, scale, position = _dates(found.header, scale, position)
    # Times since a date far in the past lose digits as seconds; count from the first frame.
    finite = time[np.isfinite(time)]
    first = float(finite.min()) if finite.size else 0.0
    name = mapping.name or str(found.header.get("OBJECT", "") or stem)
    if n == 0:
        raise InputError(f"{what} has no rows", "a row for each frame", key="frames", value=0)
    dropped = ~np.isfinite(time)
    remarks = (f"{int(dropped.sum())} rows of {what} have no time and were left out",) if dropped.any() else ()
    kept = ~dropped
    made = Frames.of(
        time[kept] - first,
        flux[kept],
        None if error is None else error[kept],
        exposure_s=exposure if exposure is None or np.ndim(exposure) == 0 else np.asarray(exposure)[kept],
        quality=None if quality is None else quality[kept],
        name=name,
        wavelength_nm=wavelength,
        temperature_c=None if temperature is None else temperature[kept],
        unit=mapping.flux_unit or columns.unit(mapping.flux),
        reference_mjd=None if epoch is None else epoch + first / DAY_S,
        scale=scale.lower(),
        position=position,
    )
    if mapping.time_at != "middle":
        half = made.exposure_s / 2
        made = made.shifted(half if mapping.time_at == "start" else -half)
    return made.with_remarks(remarks)


def _several(time: str | tuple[str, str]) -> tuple[str, ...]:
    return (time,) if isinstance(time, str) else tuple(time)


def _dates(header: dict[str, Any], scale: str, position: str) -> tuple[float | None, str, str]:
    """Return epoch, scale and position from the keywords of a FITS header (standard 4.0, section 9)."""
    scale = scale or str(header.get("TIMESYS", "")).strip()
    position = position or str(header.get("TREFPOS", header.get("TIMEREF", ""))).strip()
    for keys, zero in ((("MJDREFI", "MJDREFF"), 0.0), (("BJDREFI", "BJDREFF"), -2_400_000.5),
                       (("JDREFI", "JDREFF"), -2_400_000.5)):  # fmt: skip
        if keys[0] in header:
            return float(header[keys[0]]) + float(header.get(keys[1], 0.0)) + zero, scale, position
    return (float(header["MJDREF"]) if "MJDREF" in header else None), scale, position


class _Columns:
    """Columns of a table and arrays of other extensions, by name."""

    def __init__(self, found: FileTable, what: str) -> None:
        self.found, self.what = found, what
        self.lower = {str(name).lower(): str(name) for name in found.table.colnames}

    def column(self, name: str) -> Any:
        if name in self.found.others:
            return self.found.others[name]
        if name.lower() not in self.lower:
            names = ", ".join([*map(str, self.found.table.colnames), *self.found.others])
            raise InputError.of("column", name, f"one of {shown(names, 300)}", where=self.what)
        return self.found.table[self.lower[name.lower()]]

    def unit(self, name: str) -> str:
        unit = getattr(self.column(name), "unit", None)
        return "" if unit is None else str(unit)

    def plain(self, name: str) -> Float:
        column = self.column(name)
        values = np.ma.asarray(getattr(column, "value", column))
        if values.dtype.kind not in "iufb":
            raise InputError(f"{self.what}: the column {name!r} holds no numbers", "a column of numbers", key=name)
        return np.asarray(np.ma.filled(values.astype(np.float64), np.nan))

    def whole(self, name: str) -> NDArray[np.int64]:
        """Return flags; those that are missing are set."""
        values = self.plain(name)
        return np.where(np.isfinite(values), np.nan_to_num(values), 1).astype(np.int64)

    def numbers(self, name: str, given: str | None, unit: str, key: str) -> Float:
        """Return a column in a unit; raises InputError if neither file nor mapping states its unit."""
        import astropy.units as u

        column, values = self.column(name), self.plain(name)
        stated = given or (None if getattr(column, "unit", None) is None else str(column.unit))
        if stated is None:
            if not key:
                stated = unit
            else:
                raise InputError(
                    f"{self.what}: the unit of the column {name!r} is not stated",
                    f"a mapping with {key}, such as {unit}",
                    key=key,
                )
        try:
            # TESS and Kepler write BJD - 2457000, days: the epoch is in the header.
            parsed = u.d if stated.upper().startswith("BJD") else u.Unit(stated)
            return np.asarray((values * parsed).to_value(unit, u.spectral() if unit == "nm" else []))
        except (ValueError, TypeError, u.UnitsError) as error:
            raise InputError.of(key or "unit", stated, f"a unit such as {unit}", where=self.what) from error
