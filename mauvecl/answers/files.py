"""Files of answers: tables, documents and the record of the run, whose digests tell whether they are unchanged."""

from __future__ import annotations

import datetime
import hashlib
import io
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mauvecl.host import VERSION
from mauvecl.host.tables.files import check_size, json_text, open_regular, read_text, write_whole, writing
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Column
from mauvecl.schema.errors import InputError
from mauvecl.study.study import read_embedded_study

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.device.build import Device, DeviceRecord
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool

#: File name of the run record, and its key with the digest of all other keys.
RECORD, OWN_DIGEST = "run.json", "record_digest"


@dataclass(frozen=True)
class FileFault:
    """File that differs from what the run wrote."""

    file: str
    state: str  # "changed", "missing" or another fault


#: Largest size of a file of an answer, bytes: spectra of the longest stare have 1.2e9.
LARGEST = 2**32

FAULT_COLUMNS = (Column("file", heading="file"), Column("state", heading="what"))


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; raise InputError if it is no regular file."""
    with open_regular(path, "file") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def record_digest(record: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a run record as canonical JSON: sorted keys, no spaces, without its own digest."""
    content = {key: value for key, value in record.items() if key != OWN_DIGEST}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def is_answer(folder: Path) -> bool:
    """Return whether a folder holds a run record, or the study and a table of an answer whose record is missing."""
    if (folder / RECORD).is_file():
        return True
    for path in folder.glob("*.ecsv") if (folder / "study.toml").is_file() else ():
        # A user's own tables have no study in their metadata.
        with suppress(InputError):
            if read_embedded_study(path):
                return True
    return False


@validated
def verify_answer(folder: str | Path) -> list[FileFault]:
    """Compare an answer's folder, the value of a verb's ``--output``, with the digests in its run record.

    Any change of a file of the run, and of the record itself, is detected, unless digests are also recomputed: the
    digest is not a signature. Other files in the folder are ignored.
    """
    folder = Path(folder)
    if not is_answer(folder):
        raise InputError(f"{str(folder)!r} holds no {RECORD}; give the output folder of a verb", key="folder")
    if not (folder / RECORD).is_file():
        return [FileFault(RECORD, "missing")]
    text = read_text(folder / RECORD, "run record")
    try:
        record = json.loads(text)
        named = record.get("files", {})
        files = {Path(name).name: digest for name, digest in named.items()}
    except (ValueError, AttributeError, RecursionError):
        return [FileFault(RECORD, "cannot be read")]
    faults = []
    if OWN_DIGEST not in record:
        faults.append(FileFault(RECORD, "holds no digest of itself: changed, or of an earlier version"))
    elif record[OWN_DIGEST] != record_digest(record) or text != json_text(record) + "\n":
        faults.append(FileFault(RECORD, "changed"))
    for name, digest in files.items():
        path, state = folder / name, "missing"
        try:
            if path.exists():
                check_size(path, "file", LARGEST)
                state = "" if digest_of(path) == digest else "changed"
        except (InputError, OSError):
            state = f"no regular file of at most {LARGEST >> 30} GiB"
        if state:
            faults.append(FileFault(name, state))
    return faults


FITS_KEYWORDS = {"name": "OBJECT", "exposure_s": "EXPTIME", "frames": "NFRAMES", "seed": "SEED"}


def make_folder(path: Path) -> Path:
    """Make a folder; raises InputError if it cannot be made or written to."""
    if path.exists() and not path.is_dir():
        raise InputError(f"output folder {str(path)!r} is a file: give the name of a folder", key="output")
    with writing(f"output folder {str(path)!r}", "use a writable one", key="output"):
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
    """Return a table as ECSV text."""
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    return text.getvalue()


def write_document(content: Callable[[], bytes], path: Path) -> Path:
    """Write a file from a function that returns its bytes; errors as for `write_table`."""
    write_whole(path, content())
    return path


def write_record(
    verb: str, study: Mapping[str, Any], expectations: Sequence[Expectation], folder: Path, *, pool: Pool | None,
    opened: Device | None = None, seconds: float, messages: Sequence[str], files: Sequence[Path], whole: bool = True,
) -> Path:  # fmt: skip
    """Write the run record, which says how an answer was computed.

    The study is as JSON can hold it. `opened` is the device if something was drawn without a pool. The record contains
    the digests of the written `files` and its own; see `verify_answer`. If these are the `whole` answer, unchanged
    files of an earlier run in the folder that this run did not write are removed.
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
        "packages": {name: version(name) for name in ("numpy", "scipy", "astropy", "synphot", "pyopencl")},
    }
    if pool is not None:
        record |= _devices(pool.devices, pool.kernel_digest) | {"shards": asdict(pool.standing)}
    elif opened is not None:
        record |= _devices([opened.record], opened.kernel_digest)
    record["files"] = {path.name: digest_of(path) for path in files}
    stale = [path for path in _left_by_another(folder) if path.name not in record["files"]] if whole else []
    # Converted to JSON and back, so that the digest of a record that is read again is the same.
    record = json.loads(json_text(record))
    record[OWN_DIGEST] = record_digest(record)
    written = write_document(f"{json_text(record)}\n".encode, folder / RECORD)
    for path in stale:
        path.unlink(missing_ok=True)
    return written


def _devices(devices: Sequence[DeviceRecord], kernels: str) -> dict[str, Any]:
    """Return what a run record says of the devices, with the outcome of the self-test on each if it was run."""
    from mauvecl.device.build import read_outcome

    missing = "not run on this device and version: mauvecl selftest"
    outcomes = [read_outcome(device) or missing for device in devices]
    return {"devices": [asdict(device) for device in devices], "kernels": kernels, "selftest": outcomes}


def _left_by_another(folder: Path) -> list[Path]:
    """Return the files of the record in a folder that are unchanged."""
    try:
        named = json.loads(read_text(folder / RECORD, "run record")).get("files", {})
        files = [(folder / name, digest) for name, digest in named.items() if Path(name).name == name]
        return [path for path, digest in files if path.is_file() and digest_of(path) == digest]
    except (InputError, OSError, ValueError, AttributeError, RecursionError):
        # No record, or not one of mauvecl's.
        return []
