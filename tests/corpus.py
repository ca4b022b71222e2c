"""Small files that are described in data: each column is an expression of the arrays below, or text stands as it is.

The README of data/corpus says what an entry may hold.
"""

import bz2
import gzip
import io
import itertools
import lzma
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from string import Template
from typing import Any

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import MaskedColumn, Table
from astropy.time import Time, TimeDelta

Case = dict[str, Any]
CORPUS = Path(__file__).parent / "data" / "corpus"
#: A spectrum that is not straight, so that a wrong column, unit, order or shift shows at each point.
NM = np.arange(170.0, 1000.0, 2.0)
FLUX = 1e-13 * (1.1 + np.sin(NM / 37.0)) * np.exp(-(((NM - 560.0) / 300.0) ** 2))
DENSITY = FLUX * u.erg / (u.s * u.cm**2 * u.AA)
#: The wavelengths in air, by Birch & Downs 1994 as in VALD, above 200 nm (Morton 2000, ApJS 130, 403).
SQUARE = (1000 / NM) ** 2
INDEX = 1 + 8.34254e-5 + 2.406147e-2 / (130 - SQUARE) + 1.5998e-4 / (38.9 - SQUARE)
#: A light curve of 60 frames.
K = np.arange(60)
#: Wavelengths of SDSS and LAMOST, Angstrom.
GRID = 10 ** (3.5682 + 1e-4 * np.arange(3909))
RNG = np.random.default_rng(2900)
LIGHT = np.round(RNG.normal(1000, 5, K.size), 3)
#: Frames of five pixels.
SPECTRA = RNG.normal(1000.0, 5.0, (K.size, 5)) * np.linspace(0.5, 1.5, 5)


def at(row: int, value: Any, column: Any) -> Any:
    """Return a column with another value in a row."""
    changed = np.array(column, object if isinstance(value, str) else np.result_type(column, type(value)))
    changed[row] = value
    return changed.astype(str) if isinstance(value, str) else changed


def curve(angstrom: Any) -> Any:
    """Return the light of a curved spectrum, erg s-1 cm-2 A-1."""
    return 1e-13 * (1.5 + np.sin(angstrom / 370.0))


def tiles(image: Any, how: str, **header: Any) -> bytes:
    """Return a FITS file with an image that is compressed in tiles."""
    packed = fits.CompImageHDU(np.float32(image), compression_type=how, quantize_level=-1e-18)
    packed.header.update(header)
    out = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(out, checksum=True)
    return out.getvalue()


NAMES: dict[str, Any] = {
    "np": np, "nm": NM, "wide": np.arange(170.0, 1100.0), "flux": FLUX, "k": K,
    "t": 20.0 * K + 100.0, "light": LIGHT, "error": 0 * K + 5.0,
    "per": lambda unit: DENSITY.to_value(u.Unit(unit), u.spectral_density(NM * u.nm)),
    "spectra": SPECTRA, "waves": np.linspace(250.5, 650.5, 5), "mixed": RNG.permutation(SPECTRA.size),
    "at": at, "air": np.where(NM > 205, NM / INDEX, NM), "shuffled": RNG.permutation(K.size), "nan": np.nan,
    "dates": lambda mjd, form: Time(Time(mjd, format="mjd", scale="tdb"), format=form),
    "hidden": lambda values, rows: MaskedColumn(values, mask=np.isin(np.arange(len(values)), rows)),
    "every": slice(None), "good": np.outer([1, 1], np.abs(np.arange(1024) - 506.5) < 487) > 0,
    "curve": curve, "grid": GRID, "tiles": tiles, "fibres": lambda low, high, ids: np.float32(
        np.outer(np.arange(len(ids)) + 1, 1e17 * curve(np.arange(low, high + 0.1, 0.8)))
    ),
    "sky": lambda ra, dec, frame: SkyCoord(ra, dec, unit="deg", frame=frame),
    "lapse": lambda seconds, form: TimeDelta(TimeDelta(seconds, format="sec"), format=form),
    "arrays": lambda *rows: np.array([*rows, None], object)[:-1],
}  # fmt: skip


def value(text: Any, **names: Any) -> Any:
    """Return the value of an expression, or an array that is given."""
    return eval(text, NAMES | names) if isinstance(text, str) else np.asarray(text)


def _filled(entry: Any, row: Case) -> Any:
    """Return an entry with the values of a row for ``$key``."""
    if isinstance(entry, str):
        return row[entry[1:]] if entry[:1] == "$" and entry[1:] in row else Template(entry).safe_substitute(row)
    if isinstance(entry, dict):
        return {_filled(key, row): _filled(one, row) for key, one in entry.items()}
    return [_filled(one, row) for one in entry] if isinstance(entry, list) else entry


def cases(path: Path) -> Iterator[tuple[str, Case]]:
    """Return the names and descriptions of the files of a part of the corpus, one for each row and form."""
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    for entry in content["case"]:
        tables = [entry.pop("each", [[], []]), entry.pop("by", [[], []])]
        for rows in itertools.product(*(table[1:] for table in tables)):
            changes: Case = {}
            for (heads, *_), row in zip(tables, rows, strict=True):
                values = row if isinstance(row, list) else [row]
                assert len(values) <= len(heads), f"{path.name}: {row} has more values than {heads}"
                changes |= zip(heads, values, strict=False)
            own = {key: one for key, one in changes.items() if not key.startswith("$")}
            case = _filled(
                content.get("given", {}) | entry | own, {key.removeprefix("$"): one for key, one in changes.items()}
            )
            known = [str(changes[key]) for key in changes if key.startswith("$")]
            words = [path.stem, case.get("name", case.get("file", "")), *known[:2]]
            for form in case.get("forms", [""]):
                yield " ".join(word for word in (*words, form) if word), case | {"form": form}


def columns_of(case: Case) -> Case:
    """Return the columns with their changes; one that is changed to an empty text is left out."""
    changed = case.get("columns", {}) | case.get("change", {})
    rows = value(case.get("rows", "every"))
    return {name: value(text)[rows] for name, text in changed.items() if text != ""}


def _text(case: Case) -> bytes:
    columns, mark, units = columns_of(case), case.get("mark", ","), case.get("units", {})
    names = [f"{name} [{units[name]}]" if name in units else name for name in columns]
    head = case.get("head", mark.join(f'"{name}"' if mark in name else name for name in names))
    if case["form"].startswith("below"):
        head = f"{mark.join(columns)}\n{mark.join(units.get(name, '') for name in columns)}"
    cells = [["" if one is np.ma.masked else str(one) for one in column] for column in columns.values()]
    rows = map(mark.join, zip(*cells, strict=True))
    remarks = [f"# {key} = {one}" for key, one in case.get("header", {}).items()]
    return "\n".join([*remarks, *filter(None, [head]), *rows, ""]).encode()


def _table(case: Case) -> Table:
    table = Table(columns_of(case), meta={key.lower(): one for key, one in case.get("header", {}).items()})
    for name, unit in case.get("units", {}).items():
        table[name].unit = u.UnrecognizedUnit(unit)
    for name, text in case.get("descriptions", {}).items():
        table[name].info.description = text
    return table


def _ecsv(case: Case) -> bytes:
    out = io.StringIO()
    _table(case).write(out, format="ascii.ecsv")
    return out.getvalue().encode()


def _votable(case: Case) -> bytes:
    out, table = io.BytesIO(), _table(case)
    for name in table.colnames:
        # Units that are not those of the standard are put in afterwards.
        table[name].unit = None
    table.write(out, format="votable", tabledata_format=case.get("tabledata", "tabledata"))
    content = out.getvalue().decode()
    for name, unit in case.get("units", {}).items():
        content = content.replace(f' name="{name}"', f' name="{name}" unit="{unit}"', 1)
    return content.encode()


FORMS = {"f": "D", "i": "K", "u": "K", "b": "L", "c": "M"}


def _hdu(case: Case) -> Any:
    """Return an extension; keywords are set after astropy has made it, which would change or refuse some."""
    if "image" in case:
        hdu: Any = fits.ImageHDU(value(case["image"]), name=case.get("extname"))
    else:
        made = []
        for name, values in columns_of(case).items():
            array = values.filled(np.nan) if isinstance(values, np.ma.MaskedArray) else np.asarray(values)
            width = array.itemsize // 4 if array.dtype.kind == "U" else int(np.prod(array.shape[1:]))
            form = f"{width if width != 1 else ''}{FORMS.get(array.dtype.kind, 'A')}"
            how = case.get("formats", {}).get(name, {})
            how = {"format": how} if isinstance(how, str) else how
            made.append(fits.Column(name, **({"format": form, "array": array} | how)))
        hdu = (fits.TableHDU if case.get("ascii") else fits.BinTableHDU).from_columns(made, name=case.get("extname"))
        for number, name in enumerate(columns_of(case), 1):
            if name in case.get("units", {}):
                hdu.header[f"TUNIT{number}"] = case["units"][name]
    hdu.header.update(case.get("header", {}) | case.get("more", {}))
    for key, text in case.get("comments", {}).items():
        hdu.header.comments[key] = text
    return hdu


def _fits(case: Case) -> bytes:
    if case.get("astropy"):
        out = io.BytesIO()
        _table(case).write(out, format="fits")
        return out.getvalue()
    primary = fits.PrimaryHDU(value(case["primary_image"]) if "primary_image" in case else None)
    primary.header.update(case.get("primary", {}))
    parts = case.get("hdus", [{}] if "columns" in case else [])
    out = io.BytesIO()
    hdus = [_hdu({key: one for key, one in case.items() if key != "hdus"} | part) for part in parts]
    fits.HDUList([primary, *hdus]).writeto(out, checksum=case.get("checksum", False))
    return out.getvalue()


WRITERS = {"csv": _text, "txt": _text, "below": _text, "ecsv": _ecsv, "vot": _votable, "fits": _fits}
PACKERS = {"": bytes, "gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress}


def _folder(case: Case, folder: Path) -> Path:
    """Write a file for each frame, ``$i``, and a table of them, and spoil some; keywords are expressions."""
    folder /= "frames"
    folder.mkdir()
    for i in range(K.size):
        one = _filled({key: case[key] for key in case if key not in ("per_frame", "list")}, {"i": i})
        for part in (one, *one.get("hdus", ())):
            for where in {"header", "primary"} & set(part):
                part[where] = {key: np.asarray(value(text)).item() for key, text in part[where].items()}
        written(one | {"file": case["per_frame"] % i}, folder)
    if "list" in case:
        listed = case["list"] | {"file": f"list.{case['list']['form']}"}
        written({"columns": case["columns"], "units": case["units"]} | listed, folder)
    for name, change in case.get("spoilt", {}).items():
        path = folder / name
        if isinstance(change, str):
            path.unlink(missing_ok=True)
            if change or path.suffix != ".fits":
                path.write_text(change)
        else:
            path.write_bytes(re.sub(change[0].encode(), change[1].encode(), path.read_bytes(), count=1))
    return folder


def written(case: Case, folder: Path) -> Path:
    """Write the file of a case, with the changes of its bytes, and return its path; a stored file is where it is."""
    stored = CORPUS.parent / case.get("folder", "") / case.get("file", "")
    if "folder" in case and "edits" not in case:
        return stored
    if "per_frame" in case:
        return _folder(case, folder)
    kind, _, packing = case["form"].partition(".")
    if "folder" in case:
        content = stored.read_bytes()
    elif "text" in case:
        content = case["text"].lstrip("\n").encode()
    else:
        content = value(case["raw"]) if "raw" in case else WRITERS[kind](case)
    for old, new, *count in case.get("edits", ()):
        changed = re.sub(old.encode(), new.encode(), content, count=sum(count))
        assert changed != content, f"{old} is not in the file"
        content = changed
    if "encoding" in case:
        content = content.decode().encode(case["encoding"])
    part = -(-len(content) // case.get("members", 1)) or 1
    content = b"".join(PACKERS[packing](content[k : k + part]) for k in range(0, len(content) or 1, part))
    content = content[: round(len(content) * case.get("share", 1))]
    path = folder / Path(case.get("file", f"a.{case['form']}")).name
    path.write_bytes(content)
    for name, text in case.get("beside", {}).items():
        (folder / name).write_text(text)
    return path


def mapping_of(case: Case, folder: Path) -> Path | None:
    """Write the mapping of a case, with its changes; a key that is changed to an empty text is left out."""
    if "mapping_file" in case:
        return CORPUS.parent / case["folder"] / case["mapping_file"]
    if not (how := case.get("mapping", {}) | case.get("how", {})):
        return None
    path = folder / "mapping.toml"
    path.write_text("\n".join(f"{key} = {one!r}" for key, one in how.items() if one != ""))
    return path
