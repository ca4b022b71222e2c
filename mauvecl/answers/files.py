"""Files of answers: tables, the study, and the record of a run. Nothing is computed here."""

from __future__ import annotations

import csv
import datetime
import io
import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.answers.checked import OWN_DIGEST, RECORD, digest_of, record_digest
from mauvecl.host.files.atomic import write_whole, writing
from mauvecl.host.files.json_text import json_text
from mauvecl.host.files.parsing import read_text
from mauvecl.host.version import VERSION
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.device.device import Device
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool


FITS_KEYWORDS = {"name": "OBJECT", "exposure_s": "EXPTIME", "frames": "NFRAMES", "seed": "SEED"}


def make_folder(path: Path) -> Path:
    """Make a folder; raises InputError if it cannot be made or written to."""
    if path.exists() and not path.is_dir():
        raise InputError(
            f"output folder {str(path)!r} is a file", "the name of a folder", key="output", value=str(path)
        )
    with writing(f"output folder {str(path)!r}", path, "a writable one", key="output"):
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".mauvecl-probe"
        probe.write_text("")
        probe.unlink(missing_ok=True)
    return path


def write_table(table: Table, path: Path) -> Path:
    """Write a table as ECSV, or as FITS by the file's ending, atomically.

    Raises InputError if it cannot be written; an existing file is then kept.
    """
    if path.suffix == ".fits":
        plain, packed = table.copy(), io.BytesIO()
        # FITS keywords are limited to eight letters and short values, so the study has its own file.
        plain.meta = {FITS_KEYWORDS[k]: v for k, v in plain.meta.items() if k in FITS_KEYWORDS}
        plain.write(packed, format="fits")
        write_whole(path, packed.getbuffer())
    else:
        write_whole(path, ecsv_text(table).encode())
    return path


def ecsv_text(table: Table) -> str:
    """Return a table as ECSV text with the bytes of astropy's writer, but faster for many rows."""
    text = io.StringIO()
    cells = [_words(column) for column in table.itercols()]
    if None in cells:
        table.write(text, format="ascii.ecsv")
    else:
        table[:0].write(text, format="ascii.ecsv")
        text.writelines(f"{' '.join(row)}\n" for row in zip(*cells, strict=True))
    return text.getvalue()


def _words(column: Any) -> list[str] | None:
    """Return the cells of a column as text, or None if it is masked or contains anything but numbers and text."""
    import numpy as np

    values = np.asarray(column)
    if values.ndim > 1 or values.dtype.kind not in "iufbU" or np.any(getattr(column, "mask", False)):
        return None
    if values.dtype.kind == "U":
        names, place = np.unique(values, return_inverse=True)
        return np.array([_quoted(str(name)) for name in names], object)[place].tolist()  # type: ignore[no-any-return]
    # A shorter float's digits are its own.
    return list(map(str, values.tolist() if values.dtype.kind != "f" or values.dtype == np.float64 else values))


def _quoted(word: str) -> str:
    """Quote a word if necessary, by the rules of `csv`."""
    line = io.StringIO()
    csv.writer(line, delimiter=" ", lineterminator="").writerow([word, "end"])
    return line.getvalue().removesuffix(" end") or '""'


def write_document(content: bytes, path: Path) -> Path:
    """Write a file from its bytes; errors as for `write_table`."""
    write_whole(path, content)
    return path


def write_study(text: str, folder: Path) -> Path:
    """Write the text of a study; errors as for `write_table`."""
    return write_document(text.encode(), folder / "study.toml")


def write_record(
    verb: str,
    study: Mapping[str, Any],
    expectations: Sequence[Expectation],
    folder: Path,
    *,
    pool: Pool | None,
    opened: Device | None = None,
    seconds: float,
    messages: Sequence[str],
    files: Sequence[Path] | None = None,
    whole: bool = True,
) -> Path:
    """Write the run record, which says how an answer was computed.

    Parameters
    ----------
    study : mapping
        The study as JSON can hold it.
    expectations : sequence of Expectation
        Their provenance holds the digests of the inputs.
    pool : Pool, optional
        The pool that drew, if any.
    opened : Device, optional
        The device, if something was drawn without a pool.
    seconds : float
        Wall time.
    messages : sequence of str
        Messages for the reader.
    files : sequence of Path, optional
        Written files; the record contains their digests and its own, see `checked.verify_answer`.
    whole : bool
        Whether these are all files of the answer. If so, unchanged files of an earlier run in the folder that this run
        did not write are removed.
    """
    record: dict[str, Any] = {
        "mauvecl": VERSION,
        "verb": verb,
        "date_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "wall_time_s": round(seconds, 3),
        "seed": study["run"]["seed"],
        "study": study,
        "inputs": [{"name": x.name} | dict(x.provenance) for x in expectations],
        "messages": list(messages),
        "python": platform.python_version(),
        "packages": _versions("numpy", "scipy", "astropy", "synphot", "pyopencl"),
    }
    if pool is not None or opened is not None:
        devices = pool.devices if pool is not None else [opened.record] if opened is not None else []
        record["devices"] = [asdict(device) for device in devices]
        record["kernels"] = (pool or opened).kernel_digest  # type: ignore[union-attr]
        if pool is not None:
            record["shards"] = asdict(pool.standing)
        # Outcome of the self-test on these devices, if it was run.
        from mauvecl.device.selftest_outcome import read_outcome

        missing = "not run on this device and version: mauvecl selftest"
        record["selftest"] = [read_outcome(device) or missing for device in devices]
    stale: list[Path] = []
    if files is not None:
        record["files"] = {path.name: digest_of(path) for path in files}
        if whole:
            stale = [path for path in _left_by_another(folder) if path.name not in record["files"]]
    # Converted to JSON and back, so that the digest of a record that is read again is the same.
    record = json.loads(json_text(record))
    record[OWN_DIGEST] = record_digest(record)
    written = write_json(record, folder / RECORD)
    for path in stale:
        path.unlink(missing_ok=True)
    return written


def _left_by_another(folder: Path) -> list[Path]:
    """Return the files of the record in a folder that are unchanged."""
    try:
        named = json.loads(read_text(folder / RECORD, "run record")).get("files", {})
        files = [(folder / name, digest) for name, digest in named.items() if Path(name).name == name]
        return [path for path, digest in files if path.is_file() and digest_of(path) == digest]
    except (InputError, OSError, ValueError, AttributeError, RecursionError):
        # No record, or not one of mauvecl's.
        return []


def write_json(content: Any, path: Path) -> Path:
    """Write plain data as JSON; errors as for `write_table`."""
    write_whole(path, (json_text(content) + "\n").encode())
    return path


def _versions(*names: str) -> dict[str, str]:
    from importlib.metadata import version

    return {name: version(name) for name in names}
