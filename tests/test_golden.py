"""Tables of the default questions, compared with the tables that an earlier version wrote.

A refactoring must not change an answer. Where a change is intended, `python tests/test_golden.py NAME ...` writes the
named tables again, and the commit says why they differ.
"""

from __future__ import annotations

import shlex
import shutil
import sys
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table
from commands import run
from marks import long_but

from mauvecl.study.study import Study
from mauvecl.web.state import State

GOLDEN = Path(__file__).parent / "data" / "golden"
# Of longer tables evenly spaced rows are kept.
MAX_ROWS = 50
# The host's arithmetic may differ in its last bits between processors; the device's does not.
RELATIVE_TOLERANCE = 1e-9
# Predicted changes of a ratio near one: differences of nearly equal numbers, whose rounding errors are relative to one.
CHANGES_OF_RATIOS = {"skew", "rounding", "clipping"}

QUESTIONS = {
    "detect": "detect -n 10000 --fap 0.01",
    "detect-with-unknowns": "detect -n 10000 --fap 0.01 --with-unknowns",
    "detect-pixel-processes": "detect -n 10000 --fap 0.01 --star M3V -m 9 -a 0.05"
    " --set processes.light_loss.uniform=[0,0.05]",
    "limit": "limit -n 10000 --fap 0.01",
    "limit-of-amplitude": "limit -n 10000 --fap 0.01 --star M3V -m 9 --of amplitude",
    "map": "map -n 10000 --fap 0.01 --star G2V --x magnitude:6:9:4 --y amplitude:0.01:0.3:4:log",
    "snr": "snr -n 4000",
    "simulate": "simulate --star G2V --magnitude 7.4",
    "gaussian": "gaussian -n 10000 --fap 0.01 --star G2V",
    "exposure": "exposure --snr 10 --at 300 --star G2V -m 7.4",
    "stare": "stare --star G2V -m 7.4",
    "stare-with-unknowns": "stare --star M3V -m 9 -a 0.3 --orbit-gap 2100 --thermal 0.5 --with-unknowns",
    "inject": "inject --star M3V --magnitude 9 --distance 5 --duration 20000 -n 200"
    " --set injections.sizes=4 --set injections.widths=3",
    "visible": "visible --look-at 'eps Eri' --start 2027-01-01 --days 20",
    "plan": "plan targets.csv --hours 20 --start 2027-01-01 --days 20 --completeness 'closed form'",
}
# Written by the page of version 0.1.0.
OLD_LINK = (
    "?star=M3V&magnitude=9&band=V&amplitude_percent=10&exposure_s=50&flare_temperature_k=10000&temperature_c=21"
    "&instrument=mauve&signal=net&sky=brightness&sky_brightness=22.1&statistic=matched&fap=0.001&unknown=the+usual"
    "&hours=100&realisations=100000&seed=1&tab=limit"
)
TARGETS = "name\nGJ 205\neps Eri\n"


def answer(name: str, folder: Path) -> Path:
    """Ask a question in `folder` and return the folder with its tables."""
    (folder / "targets.csv").write_text(TARGETS, encoding="utf-8")
    run(*shlex.split(QUESTIONS[name]), "--no-pictures", "--output", folder / "answer", folder=folder)
    return folder / "answer"


def thinned(path: Path) -> Table:
    """Read a table and return at most some `MAX_ROWS` of its rows."""
    table = Table.read(path)
    return table[:: max(1, len(table) // MAX_ROWS)]


@pytest.mark.parametrize("name", long_but(QUESTIONS, "exposure", "limit-of-amplitude", "map", "visible"))
def test_tables_of_default_questions_are_unchanged(name: str, tmp_path: Path) -> None:
    found = answer(name, tmp_path)
    expected = sorted((GOLDEN / name).glob("*.ecsv"))
    assert expected
    for path in expected:
        ours, theirs = thinned(found / path.name), Table.read(path)
        assert ours.colnames == theirs.colnames, path.name
        for column in theirs.colnames:
            assert ours[column].unit == theirs[column].unit
            assert ours[column].dtype.kind == theirs[column].dtype.kind
            if theirs[column].dtype.kind == "f":
                a, b = (np.ma.filled(np.ma.asarray(t[column]), np.nan) for t in (ours, theirs))
                rounding = RELATIVE_TOLERANCE if column in CHANGES_OF_RATIOS else 0.0
                np.testing.assert_allclose(a, b, RELATIVE_TOLERANCE, rounding, err_msg=f"{path.name}: {column}")
            else:
                assert list(ours[column]) == list(theirs[column]), f"{path.name}: {column}"


@pytest.mark.parametrize("name", QUESTIONS)
def test_old_study_files_are_read(name: str) -> None:
    # Files that a study names were next to it when it was written.
    text = (GOLDEN / name / "study.toml").read_text(encoding="utf-8")
    study = Study.build(tomllib.loads(text), name)
    assert Study.build(tomllib.loads(study.toml()), name) == study


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
        with tempfile.TemporaryDirectory() as temporary:
            written = answer(question, Path(temporary))
            shutil.rmtree(GOLDEN / question, ignore_errors=True)
            (GOLDEN / question).mkdir(parents=True)
            for each in written.glob("*.ecsv"):
                table = thinned(each)
                # The study is kept once, next to the tables.
                table.meta.pop("study", None)
                table.write(GOLDEN / question / each.name)
            shutil.copy(written / "study.toml", GOLDEN / question)
