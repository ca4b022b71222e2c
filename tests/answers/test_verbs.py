"""Verbs: one name and signature in Python and on the command line, and one definition of a table's columns."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from answers import FEW, QUICK
from astropy.table import QTable
from commands import run
from marks import long_but
from scenes import paper

import mauvecl
from mauvecl import Engine, Study

SLOW = {
    "measure": ["measure.fits=20"],
    "stare": ["stare.duration_s=2000", "stare.search=true"],
    "inject": ["stare.duration_s=3000", "injections.sizes=3", "injections.widths=2", "injections.count=20",
               "injections.positions=2", "search.nulls=0", "injections.fitted=0"],
}  # fmt: skip


@pytest.mark.parametrize("name", long_but(QUICK, *(QUICK.keys() - {"change", "simulate"})))
def test_progress_ends_at_its_total(name: str, engine: Engine) -> None:
    """Pass all arguments by position, since all verbs have the same."""
    seen: list[tuple[int, int]] = []
    drawing = None if name == "plan" else engine
    getattr(mauvecl, name)(paper(*FEW + QUICK[name]), drawing, lambda *reported: seen.append(reported))
    done, total = zip(*seen, strict=True)
    assert list(done) == sorted(done)
    assert done[-1] == total[-1] > 0
    assert len(set(total)) == 1


# Observed frames take too long for this test.
@pytest.mark.parametrize("name", long_but(QUICK | SLOW, "exposure", "detect"))
def test_files_json_and_terminal_agree(name: str, tmp_path: Path) -> None:
    answer = getattr(mauvecl, name)(paper(*FEW, *(QUICK | SLOW)[name]))
    answer.write(tmp_path / "files")
    for file, table in answer.tables.items():
        path = tmp_path / "files" / f"{file}.ecsv"
        read, exact = QTable.read(path), io.StringIO()
        assert read.colnames == table.colnames
        for one in read.colnames:
            assert read[one].unit == table[one].unit
            assert read[one].info.description == table[one].info.description
        # Files are written without astropy's writer, to the last byte as by it.
        table.write(exact, format="ascii.ecsv")
        assert path.read_text(encoding="utf-8") == exact.getvalue()
    (tmp_path / "study.toml").write_text(answer.study.toml())
    words = (name, "study.toml", "--no-pictures", "-o")
    found = json.loads(run(*words, "json", "--json", folder=tmp_path).stdout)
    assert answer.json_tables.keys() <= found.keys()
    for key, table in answer.json_tables.items():
        assert list(found[key][0]) == table.colnames
        for column, *cells in zip(table.colnames, *(row.values() for row in found[key]), strict=True):
            values = np.ma.asarray(getattr(table[column], "value", table[column]))
            if values.dtype.kind == "f":
                # JSON has neither NaN nor infinities.
                values = np.ma.masked_invalid(values)
            assert cells == values.tolist(), (key, column)
    shown = run(*words, "shown", "--wide", folder=tmp_path).stdout
    for view in answer.views:
        assert view.title in shown
        if view.table is not None:
            headings, cells = view.texts()
            assert headings
            assert all(text in shown for row in cells for text in row)


def test_odd_words_in_tables_are_written_as_by_astropy(tmp_path: Path) -> None:
    stars, exact = [], io.StringIO()
    for number, name in enumerate(['said "so"', "a,b", "#", "two  spaces", "\u03bb", "0.1"]):
        (tmp_path / name).write_text("100 1e-13\n500 1e-13\n1100 1e-13\n")
        stars.append({"file": str(tmp_path / name), "magnitude": 7.0 + number})
    answer = mauvecl.exposure(Study.build({"star": stars, "signal": {"snr": 5.0, "wavelength_nm": 400.0}}, "test"))
    answer.write(tmp_path)
    answer.table.write(exact, format="ascii.ecsv")
    assert (tmp_path / "exposure.ecsv").read_text(encoding="utf-8") == exact.getvalue()
    assert len(answer.table) == len(stars)
