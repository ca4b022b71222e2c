"""One definition of a table's columns serves files, JSON, the terminal and the page."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import astropy.units as u
import pytest
from answers import FEW, QUICK
from astropy.table import QTable

import mauvecl
from mauvecl import Engine, Study
from mauvecl.answers.verbs import VERBS
from mauvecl.cli.console import show_view
from mauvecl.schema.tables import Column, View, records, stacked, table_of
from mauvecl.web.tabs import TABS
from mauvecl.web.tabs.tab import FIXED, Tab

FLARES = Path(__file__).parents[1] / "data" / "flares"
SLOW = {
    "measure": ["measure.fits=20"],
    "stare": ["stare.duration_s=2000", "stare.search=true"],
    "inject": ["stare.duration_s=3000", "injections.sizes=3", "injections.widths=2", "injections.count=20",
               "injections.positions=2", "search.nulls=0", "injections.fitted=0"],
    "analyse": [f"data.file={FLARES / 'gj65_galex_nuv_5s.csv'}", f"data.mapping={FLARES / 'gj65.toml'}"],
}  # fmt: skip
#: Columns that only people read, or that are rows of the file.
ONLY_SHOWN = {"verdict", "shares"}
TURNED = {"map": "cell by cell in the file", "visible": "months are rows of the file"}


@pytest.mark.long
# Observed frames take too long for this test; tables of them are made by `table_of` as the next test holds.
@pytest.mark.parametrize("name", [name for name in VERBS if name not in ("analyse", "calibrate")])
def test_files_json_terminal_and_page_agree(
    name: str, engine: Engine, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = (QUICK | SLOW)[name]
    answer = VERBS[name].ask(Study().with_settings([*FEW, *settings]))
    answer.write(tmp_path)
    for file, table in answer.tables.items():
        read = QTable.read(tmp_path / f"{file}.ecsv")
        assert read.colnames == table.colnames
        assert [read[one].unit for one in read.colnames] == [table[one].unit for one in table.colnames]
    content = answer.as_json()
    for key, attribute in answer.JSON.items():
        assert repr(content[key]) == repr(records(getattr(answer, attribute))), key
    assert answer.views
    tables = [*answer.tables.values(), *(getattr(answer, attribute) for attribute in answer.JSON.values())]
    for number, view in enumerate(answer.views):
        show_view(view)
        shown = capsys.readouterr().out
        assert view.title in shown
        if view.table is None:
            continue
        headings, cells = view.texts()
        assert headings
        assert all(headings)
        assert all(text in shown for row in cells for text in row)
        named = [one for one in view.columns if one.name and one.name not in ONLY_SHOWN]
        for tab in TABS.values():
            # The tab of measurements shows closed forms, which have columns of their own.
            if tab.answer and tab.view == number and tab.verb == name and type(tab).shown is Tab.shown:
                titles, *rows = tab.rows(None, {tab.answer: answer})  # type: ignore[arg-type]
                assert set(titles) <= {one.heading for one in view.columns if one.name not in FIXED}
                assert len(rows) == len(cells)
        if name in TURNED and number == len(answer.views) - 1:
            continue
        names = [one.name for one in named]
        (table, *_) = [one for one in tables if set(names) <= set(one.colnames)]
        for one in named:
            assert (table[one.name].unit or u.one) == u.Unit(one.unit), one.name
            assert table[one.name].info.description == (one.description or None), one.name
        in_file = {repr([record[one] for one in names]) for record in records(table)}
        assert all(repr([record[one] for one in names]) in in_file for record in records(view.table))


def test_all_tables_come_from_columns() -> None:
    """Tables of answers are made of columns: nothing fills or extends an astropy table itself."""
    package = Path(mauvecl.__file__).parent
    found = []
    for room in ("answers", "results/detection", "lightcurve"):
        for file in (package / room).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if not isinstance(node, ast.Call):
                    continue
                called = getattr(node.func, "attr", getattr(node.func, "id", ""))
                if called in ("add_column", "add_columns") or (
                    called in ("Table", "QTable") and node.args + node.keywords
                ):
                    found.append(f"{file.name}:{node.lineno}")
    assert not found


def test_tab_shows_the_answer_of_its_verb() -> None:
    class Exposure(Tab):
        """Tab of exposures."""

        verb = "exposure"

    tab = Exposure()
    assert (tab.name, tab.title, tab.answer) == ("exposure", "Exposure", "exposure")
    assert tab.about == VERBS["exposure"].help.split("\n")[0]
    assert (tab.simulations, tab.files) == ({"exposure": "Exposure"}, {"exposure": "exposure"})
    answer = VERBS["exposure"].ask(Study().with_settings([*FEW, *QUICK["exposure"]]))
    headings, *rows = tab.rows(None, {"exposure": answer})  # type: ignore[arg-type]
    assert headings == ["exposure (s)", "frames", "S/N", "a frame less"]
    assert len(rows) == 1
    assert tab.table("exposure", None, {"exposure": answer}).colnames == answer.table.colnames  # type: ignore[arg-type]


class Row:
    def __init__(self, name: str, values: list[float], most: int | None) -> None:
        self.name, self.values, self.most = name, values, most


COLUMNS = (
    Column("name", kind=str),
    Column("value", "values", "s", "of each", "value (s)", ".1f", kind=float),
    Column("most", "", "", "a count", "most", lambda most, value: f"{most} of {value:g}", ("value",), int),
)


def test_rows_hold_arrays_and_missing_values() -> None:
    table = table_of(COLUMNS, [Row("a", [1.0, 2.0], 3), Row("b", [], 1), Row("c", [5.0], None)], seed=7)
    assert table["name"].tolist() == ["a", "a", "c"]
    assert table["value"].unit == "s"
    assert table["value"].info.description == "of each"
    assert table.meta == {"seed": 7}
    assert [record["most"] for record in records(table)] == [3, 3, None]
    headings, cells = View("title", COLUMNS, table).texts(hidden=["most"])
    assert (headings, cells) == (["value (s)"], [["1.0"], ["2.0"], ["5.0"]])


def test_empty_table_keeps_its_types() -> None:
    table = table_of(COLUMNS, [])
    assert [table[name].dtype.kind for name in table.colnames] == ["U", "f", "i"]


def test_stacked_tables_mask_missing_columns_and_refuse_two_units() -> None:
    parts: list[tuple[Any, Any]] = [
        ({"star": "x"}, table_of([Column("a", unit="s")], [{"a": 1.0}], seed=1, n=1)),
        ({"star": "y"}, table_of([Column("a", unit="s"), Column("b")], [{"a": 2.0, "b": 3}], seed=1, n=2)),
    ]
    table = stacked([Column("star")], parts, study="s")
    assert records(table) == [{"star": "x", "a": 1.0, "b": None}, {"star": "y", "a": 2.0, "b": 3}]
    assert table.meta == {"seed": 1, "study": "s"}
    parts.append(({"star": "z"}, table_of([Column("a", unit="erg")], [{"a": 1.0}])))
    with pytest.raises(ValueError, match="unit"):
        stacked([Column("star")], parts)
