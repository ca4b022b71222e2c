"""Tables of the default questions, compared with the tables that an earlier version wrote.

A refactoring must not change an answer. Where a change is intended, `python tests/test_golden.py NAME ...` writes the
named tables again, and the commit says why they differ.
"""

from __future__ import annotations

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
from mauvecl.web.state import State

GOLDEN = Path(__file__).parent / "data" / "golden"
# Of longer tables evenly spaced rows are kept.
MAX_ROWS = 50
# Start of the question, pattern of the column, relative and absolute tolerance; the first that matches counts. The
# host's arithmetic may differ in its last bits between processors; the device's does not. What an optimiser or a
# search for the ends of an interval makes of these bits was measured with one and two threads of OpenBLAS, and with the
# instructions of a processor of 2013; the tolerances are some ten times as large.
TOLERANCES = [
    # Predicted changes of a ratio near one: differences of nearly equal numbers.
    ("", "skew|rounding|clipping", 1e-9, 1e-9),
    # Residuals of a fit without noise are zero but for rounding.
    ("measure", "chi2_perfect", 1e-6, 1e-3),
    # Profile intervals end where an iteration stops.
    ("measure", "low|high", 1e-3, 0.0),
    ("measure", "", 1e-6, 0.0),
    # Rates fall with the square of the statistic in the exponent, and are zero for bright flares. The likelihood of the
    # light of a rotating star is flat at its maximum, and all that follows moves with it.
    ("analyse", "rate_|probability", 0.02, 1e-9),
    ("analyse", "bic", 1e-2, 1e-2),
    ("analyse-rotating", "", 1e-2, 0.0),
    ("analyse", "low|high", 5e-3, 0.0),
    ("analyse", "", 1e-4, 0.0),
    ("calibrate", "mode_", 1e-4, 1e-4),
    ("calibrate", "", 1e-4, 1e-9),
    ("", "", 1e-9, 0.0),
]
# What is compared of stars of the library, and of keys of studies.
LIBRARY = ("name", "spectral_type", "level", "temperature_k")
LIMITS = re.compile("default|enum|const|(m|M)(in|ax)(imum|Items)")

# Each is a command, or several after one another, of which the last one is the question.
QUESTIONS = {
    "detect": "detect -n 10000 --fap 0.01",
    "detect-with-unknowns": "detect -n 10000 --fap 0.01 --with-unknowns",
    "detect-pixel-processes": "detect -n 10000 --fap 0.01 --star M3V -m 9 -a 0.05"
    " --set processes.light_loss.uniform=[0,0.05]",
    "detect-other-statistics": "detect -n 2000 --fap 0.05 --star M3V -m 9 -a 0.05 --statistic chi2_pair"
    " --statistic uv_excess --statistic paper --set observation.signal=paper --sky none",
    "detect-electrons": "detect -n 10000 --fap 0.01 --star K5V -m 8 -a 0.05 -t 5 --instrument mauve-electrons",
    "detect-neighbours": "detect -n 10000 --fap 0.01 --star M3V -m 9 -a 0.05 --neighbours near.csv"
    " --neighbour-share 0.5 --tails sampled",
    "limit": "limit -n 10000 --fap 0.01",
    "limit-of-amplitude": "limit -n 10000 --fap 0.01 --star M3V -m 9 --of amplitude",
    "limit-of-exposure": "limit -n 10000 --fap 0.01 --star M3V -m 9 --of exposure -a 0.01 --statistic matched",
    "map": "map -n 10000 --fap 0.01 --star G2V --x magnitude:6:9:4 --y amplitude:0.01:0.3:4:log",
    "map-of-exposure": "map -n 10000 --fap 0.01 --star M3V -m 9 -a 0.1 --x exposure:5:300:4:log"
    " --y flare_temperature:6000:20000:3 --statistic chi2_element --instrument mauve-electrons",
    "snr": "snr -n 4000",
    "snr-electrons": "snr -n 1000 --star M3V -m 9 --instrument mauve-electrons --sky 21",
    "simulate": "simulate --star G2V --magnitude 7.4",
    "simulate-of-target": "simulate --star K5V -m 8 --target 'eps Eri' --time 2027-01-05T00:00:00"
    " --neighbours near.csv --band B",
    "gaussian": "gaussian -n 10000 --fap 0.01 --star G2V",
    "gaussian-electrons": "gaussian -n 2000 --fap 0.05 --star M3V -m 9 --instrument mauve-electrons",
    "exposure": "exposure --snr 10 --at 300 --star G2V -m 7.4",
    "exposure-of-element": "exposure --snr 5 --at 450 --star M3V -m 9 --per element --instrument mauve-electrons",
    "stare": "stare --star G2V -m 7.4",
    "stare-with-unknowns": "stare --star M3V -m 9 -a 0.3 --orbit-gap 2100 --thermal 0.5 --with-unknowns",
    "stare-pointing": "stare --star M3V -m 9 -a 1 --pointing-drifts 4 --duration 1500 --half-width 30 --distance 5"
    " --shape tovarmendoza2022 --set search.shape=tovarmendoza2022 --flare-temperature 14000",
    "inject": "inject --star M3V --magnitude 9 --distance 5 --duration 20000 -n 200"
    " --set injections.sizes=4 --set injections.widths=3",
    "inject-durations": "inject --star G2V -m 7.4 --duration 4000 --size duration -n 50 --instrument mauve-electrons"
    " --set injections.sizes=3 --set injections.widths=2 --set injections.fitted=5 --pointing-drifts 2",
    "measure-balmer-jump": "measure --star M3V -m 9 -a 0.5 --balmer-jump 2 --nuisance dark=free"
    " --nuisance light=free --fits 50",
    "measure-with-unknowns": "measure --star M3V -m 9 -a 0.5 --sweep flare_temperature=8000,15000 --with-unknowns"
    " --fits 20",
    "measure-two-temperatures": "measure --star M3V -m 7 -a 1 --second-temperature 30000 --second-area 0.05"
    " --model two-temperatures --distance 5 --radius 0.4 --fits 10",
    "measure-lines": "measure --star M3V -m 7 -a 1 --flare-temperature 9000 --line 'Mg II=0.05' --line 'H alpha=0.02'"
    " --model lines --skip 322:368 --fits 20",
    "measure-file": "measure --star M3V -m 9.4 --flare-file flare.dat --flare-quiescent quiet.dat"
    " --flare-wavelength-unit Angstrom --continue-at 9500 --as-observed --distance 4.97 --fits 20",
    "measure-stare": "measure --star M3V -m 9 -a 2 --snr-per-bin 20 --joint-fit --duration 200 --half-width 20"
    " --distance 5 --fits 10",
    "analyse-rotating": "analyse rotating.csv --mapping curve.toml --alarms-per day",
    "analyse-flares": "analyse flares.csv --mapping curve.toml --false-alarms 10 --alarms-per day",
    "analyse-counts": "analyse counts.csv --mapping ct.toml --false-alarms 10 --alarms-per day",
    "analyse-spectra": "stare --star M3V -m 9 -a 0.5 --duration 500 --half-width 25 --distance 5"
    " --output drawn --no-pictures && analyse drawn/light-curve-1.fits --star M3V -m 9 --distance 5 --false-alarms 10"
    " --alarms-per day",
    "change": "change --star M3V -m 9",
    "change-with-unknowns": "change --star M3V -m 9 --change spectrum --change-file vb8.fits --change 'Mg II'"
    " --change colour --change 200-320 --visits 30 --fap 0.01 --power 0.8 --nuisance dark=0.1 --nuisance light=0.02",
    "change-periods": "change --star K5V -m 8 -t 300 --change 320-700 --visits 8 --periods --look-at 'eps Eri'"
    " --days 6 --longest-period 5 --trials 10",
    "calibrate": "calibrate standards.toml --knots 40",
    "calibrate-one-star": 'calibrate --light-error 0.01 --set \'calibrate.observations=[{frames="a0v.fits",'
    ' mapping="raw.toml", library="A0V", magnitude=5}]\'',
    "calibrate-two-stars": "calibrate --knots 20 --spectrum-error 0.02 --instrument mauve-electrons"
    ' --set \'calibrate.observations=[{frames="a0v.fits", mapping="raw.toml", library="A0V", magnitude=5},'
    ' {frames="g2v.fits", mapping="raw.toml", library="G2V", magnitude=4}]\'',
    "visible": "visible --look-at 'eps Eri' --start 2027-01-01 --days 20",
    "visible-mean-orbit": "visible --look-at '150.0 +20.0' --look-at 'AU Mic' --start 2027-03-01 --days 10 --orbit mean"
    " --eclipse never --sun 60 --protons none",
    "plan": "plan targets.csv --hours 20 --start 2027-01-01 --days 20 --completeness 'closed form'",
    "realise": "realise --star G2V -m 7.4 -a 0.24 -t 5 -n 20 --output answer/frames.zarr",
    "realise-frames": "realise --star M3V -m 9 -a 0.5 -t 25 -n 10 --frames 0,4 --components --seed 7"
    " --set processes.cosmic_rays.rate_per_cm2_s=300 --set processes.jitter.uniform=[0,0.05]"
    " --instrument mauve-electrons --output answer/frames.fits",
    "verify": "realise --star G2V -m 7.4 -a 0.24 -t 5 -n 20 --output frames.zarr && verify frames.zarr --redraw --json",
    "export": "realise --star G2V -m 7.4 -a 0.24 -t 5 -n 20 --output frames.zarr"
    " && export frames.zarr answer/part.h5 --array star-1/flare-1 --rows 5:15",
    "library": "library --json",
    "devices": "devices --no-rate --json",
    "schema": "schema",
}
# Written by the page of version 0.1.0.
OLD_LINK = (
    "?star=M3V&magnitude=9&band=V&amplitude_percent=10&exposure_s=50&flare_temperature_k=10000&temperature_c=21"
    "&instrument=mauve&signal=net&sky=brightness&sky_brightness=22.1&statistic=matched&fap=0.001&unknown=the+usual"
    "&hours=100&realisations=100000&seed=1&tab=limit"
)
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
    """Return relative and absolute tolerance of a column."""
    return next(row[2:] for row in TOLERANCES if question.startswith(row[0]) and re.search(row[1], column))


@pytest.mark.parametrize("name", long_but(QUESTIONS, "exposure", "limit-of-amplitude", "map", "visible"))
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


def test_old_links_of_the_page_are_followed() -> None:
    state = State()
    state.follow(OLD_LINK)
    assert state.stray == ""
    assert not state.faults
    assert state.entered["star"] == "M3V"
    assert state.entered["amplitude_percent"] == "10"


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
