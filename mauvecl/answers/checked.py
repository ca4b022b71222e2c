"""Verification of an answer's folder by the digests of its files and of the run record."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mauvecl.host.files.json_text import json_text
from mauvecl.host.files.parsing import read_text
from mauvecl.host.files.size_limits import check_size, open_regular
from mauvecl.schema.calls import validated
from mauvecl.schema.errors import InputError
from mauvecl.schema.tables import Column
from mauvecl.study.study_text import read_embedded_study

#: File name of the run record, and its key with the digest of all other keys.
RECORD, OWN_DIGEST = "run.json", "record_digest"


@dataclass(frozen=True)
class FileFault:
    """File that differs from what the run wrote."""

    file: str
    state: str  # "changed", "missing" or another fault


#: Largest size of a file of an answer, bytes.
LARGEST = 2**30

#: Columns of the table of faults.
FAULT_COLUMNS = (Column("file", heading="file"), Column("state", heading="what"))


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; raise InputError if it is no regular file."""
    with open_regular(path, "file") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def record_digest(record: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a run record as canonical JSON: sorted keys, no spaces, without its own digest."""
    rest = {key: value for key, value in record.items() if key != OWN_DIGEST}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def is_answer(folder: Path) -> bool:
    """Return whether a folder holds a run record, or the study and a table of an answer whose record is missing."""
    if (folder / RECORD).is_file():
        return True
    return (folder / "study.toml").is_file() and any(map(_is_table_of_answer, folder.glob("*.ecsv")))


def _is_table_of_answer(path: Path) -> bool:
    """Return whether a table has a study in its metadata, which a user's own tables do not."""
    try:
        return bool(read_embedded_study(path))
    except InputError:
        return False


@validated
def verify_answer(folder: str | Path) -> list[FileFault]:
    """Compare an answer's folder with the digests in its run record.

    Any change of a file of the run, and of the record itself, is detected, unless digests are also recomputed: the
    digest is not a signature. Other files in the folder are ignored.

    Parameters
    ----------
    folder : str or Path
        Value of a verb's ``--output``.

    Returns
    -------
    list of FileFault
        Empty if all files are unchanged.
    """
    folder = Path(folder)
    if not is_answer(folder):
        raise InputError(
            f"{str(folder)!r} holds no {RECORD}", "the output folder of a verb", key="folder", value=str(folder)
        )
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
        path = folder / name
        try:
            same = path.exists() and check_size(path, "file", LARGEST) and digest_of(path) == digest
        except (InputError, OSError):
            faults.append(FileFault(name, f"no regular file of at most {LARGEST >> 30} GiB"))
            continue
        if not same:
            faults.append(FileFault(name, "changed" if path.exists() else "missing"))
    return faults
