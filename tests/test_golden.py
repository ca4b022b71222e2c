"""Tables of the default questions, compared with the tables that an earlier version wrote.

A refactoring must not change an answer. Where a change is intended, `python tests/test_golden.py NAME ...` writes the
named tables again, and the commit says why they differ.
"""

import hashlib
import json
import re
import shlex
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import zarr
from astropy.io import fits
from astropy.table import Table
from commands import run
from golden_inputs import write_inputs
from marks import long_but
from numpy.typing import NDArray

from mauvecl import Study

GOLDEN = Path(__file__).parent / "data" / "golden"
# Of longer tables evenly spaced rows are kept.
MAX_ROWS = 50
# Start of the question, pattern of the column, relative and absolute tolerance; the first that matches counts.
TOLERANCES = tomllib.loads((GOLDEN / "tolerances.toml").read_text(encoding="utf-8"))["tolerances"]
# What is compared of stars of the library, and of keys of studies.
LIBRARY = ("name", "spectral_type", "level", "temperature_k")
LIMITS = re.compile("default|enum|const|(m|M)(in|ax)(imum|Items)")

# Each is a command, or several after one another, of which the last one is the question.
QUESTIONS: dict[str, str] = tomllib.loads((GOLDEN / "questions.toml").read_text(encoding="utf-8"))
# Questions without `--output`, or with one of their own.
PLAIN = {"realise", "verify", "export", "library", "devices", "schema"}


def answer(name: str, folder: Path) -> Path:
    """Ask a question in `folder` and return the folder with its tables."""
    (folder / "answer").mkdir(exist_ok=True)
    write_inputs(folder, QUESTIONS[name])
    *before, asked = (shlex.split(one) for one in QUESTIONS[name].split(" && "))
    for words in before:
        run(*words, folder=folder)
    more = () if asked[0] in PLAIN else ("--no-pictures", "--output", folder / "answer")
    said = run(*asked, *more, folder=folder).stdout
    for table_name, table in more_tables(asked[0], said, folder / "answer"):
        table.write(folder / "answer" / f"{table_name}.ecsv")
    return folder / "answer"


def more_tables(verb: str, said: str, folder: Path) -> Iterator[tuple[str, Table]]:
    """Make tables of what a verb writes in other forms."""
    if verb in {"realise", "export"}:
        yield "arrays", Table(rows=[row for path in sorted(folder.iterdir()) for row in arrays(path)])
    elif verb in {"verify", "library"}:
        rows = [{key: row[key] for key in LIBRARY} for row in json.loads(said)] if verb == "library" else []
        yield verb, Table(rows=rows) if rows else Table({"faults": [len(json.loads(said))]})
    elif verb == "devices":
        yield verb, Table({"property": sorted(json.loads(said)[0])})
    elif verb == "schema":
        yield verb, Table(rows=list(keys(json.loads(said))))


def arrays(path: Path) -> Iterator[dict[str, Any]]:
    """Describe each array of a file or store; integers, whose bits are promised, by their digest."""
    for name, values in read_arrays(path):
        whole = values.dtype.kind in "iu"
        digest = hashlib.sha256(values.astype("<i8").tobytes()).hexdigest() if whole else ""
        about = {"array": name, "kind": values.dtype.kind, "shape": str(values.shape), "digest": digest}
        yield {**about, "mean": float(values.mean())}


def read_arrays(path: Path) -> Iterator[tuple[str, NDArray[Any]]]:
    """Read every array of numbers in a Zarr store, a FITS or an HDF5 file."""
    if path.suffix == ".zarr":
        yield from sorted(
            (one.path, one[...]) for _, group in zarr.open_group(path).groups() for _, one in group.arrays()
        )
    elif path.suffix == ".fits":
        with fits.open(path) as hdus:
            for hdu in hdus[1:]:
                columns = {"": hdu.data} if hdu.is_image else {one: hdu.data[one] for one in hdu.columns.names}
                yield from ((f"{hdu.name}/{one}", np.asarray(v)) for one, v in columns.items() if v.dtype.kind in "iuf")
    else:
        with h5py.File(path) as file:
            found: list[h5py.Dataset] = []
            file.visititems(lambda _, one: found.append(one) if isinstance(one, h5py.Dataset) else None)
            yield from ((one.name, one[...]) for one in found if one.dtype.kind in "iuf")


def keys(schema: dict[str, Any]) -> Iterator[dict[str, str]]:
    """List the sections of studies, each with the defaults, ranges and choices of its keys."""
    for section, about in {"study": schema, **schema["$defs"]}.items():
        found = {}
        for key, field in about.get("properties", {}).items():
            found[key] = {k: v for one in (*field.get("anyOf", ()), field) for k, v in one.items() if LIMITS.search(k)}
        yield {"section": section, "keys": json.dumps(found, sort_keys=True)}


def thinned(path: Path) -> Table:
    """Read a table and return at most some `MAX_ROWS` of its rows."""
    table = Table.read(path)
    return table[:: max(1, len(table) // MAX_ROWS)]


def tolerances(question: str, column: str) -> tuple[float, float]:
    return next(row[2:] for row in TOLERANCES if question.startswith(row[0]) and re.search(row[1], column))


@pytest.mark.parametrize("name", long_but(QUESTIONS, "detect", "exposure", "limit-of-amplitude", "map", "visible"))
def test_tables_of_default_questions_are_unchanged(name: str, tmp_path: Path) -> None:
    found = answer(name, tmp_path)
    expected = sorted((GOLDEN / name).glob("*.ecsv"))
    assert expected
    assert {path.name for path in expected} == {path.name for path in found.glob("*.ecsv")}
    for path in expected:
        ours, theirs = thinned(found / path.name), Table.read(path)
        assert ours.colnames == theirs.colnames, path.name
        for column in theirs.colnames:
            assert ours[column].unit == theirs[column].unit
            assert ours[column].dtype.kind == theirs[column].dtype.kind
            if theirs[column].dtype.kind == "f":
                a, b = (np.ma.filled(np.ma.asarray(t[column]), np.nan) for t in (ours, theirs))
                np.testing.assert_allclose(a, b, *tolerances(name, column), err_msg=f"{path.name}: {column}")
            else:
                assert list(ours[column]) == list(theirs[column]), f"{path.name}: {column}"


@pytest.mark.parametrize("name", [name for name, asked in QUESTIONS.items() if asked.split()[0] not in PLAIN])
def test_old_study_files_are_read(name: str) -> None:
    # Files that a study names were next to it when it was written; a study states their whole paths.
    text = (GOLDEN / name / "study.toml").read_text(encoding="utf-8")
    study = Study.build(tomllib.loads(text), name)
    assert Study.build(tomllib.loads(study.toml()), name).toml() == study.toml()


def test_old_stores_are_read_and_drawn_again(tmp_path: Path) -> None:
    store = tmp_path / "frames.zarr"
    shutil.copytree(GOLDEN / "frames.zarr", store)
    run("verify", store, "--redraw", folder=tmp_path, code=0)


if __name__ == "__main__":
    for question in sys.argv[1:] or QUESTIONS:
        print(question, flush=True)
        with tempfile.TemporaryDirectory() as temporary:
            written = answer(question, Path(temporary))
            shutil.rmtree(GOLDEN / question, ignore_errors=True)
            (GOLDEN / question).mkdir(parents=True)
            for each in written.glob("*.ecsv"):
                table = thinned(each)
                # The study is kept once, next to the tables; descriptions are not compared.
                table.meta.clear()
                for column in table.itercols():
                    column.info.description = None
                table.write(GOLDEN / question / each.name)
            if (written / "study.toml").exists():
                text = (written / "study.toml").read_text(encoding="utf-8").replace(f"{temporary}/", "")
                (GOLDEN / question / "study.toml").write_text(text, encoding="utf-8")
