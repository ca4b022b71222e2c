"""Commands that look from the orbit."""

import json
from pathlib import Path

import pytest
from astropy.table import Table
from commands import run

from mauvecl import Study
from mauvecl.cli.question import holds_study


def test_visible_writes_its_files(tmp_path: Path) -> None:
    words = ("visible", "--look-at", "eps Eri", "--look-at", "AU Mic", "--start", "2026-09-20", "--days", "3")
    done = run(*words, "--sun", "60", "--moon", "none", folder=tmp_path)
    assert "eps Eri" in done.stdout
    folder = tmp_path / "mauvecl-visible"
    names = {path.name for path in folder.iterdir()}
    assert {"visible.ecsv", "windows.ecsv", "visible.ics", "visible.png", "assumptions.ecsv", "run.json"} <= names
    study = Study.read(folder / "study.toml")
    assert (study.orbit.limits.sun_deg, study.orbit.limits.moon_deg, study.orbit.days) == (60.0, None, 3.0)
    # What is not said stays as it is.
    assert study.orbit.limits.earth_limb_deg == 25.0
    rows = json.loads(run("visible", folder / "study.toml", "--json", folder=tmp_path).stdout)["rows"]
    assert [row["target"] for row in rows] == ["eps Eri", "AU Mic"]


@pytest.mark.long
def test_plan_writes_its_files(tmp_path: Path) -> None:
    (tmp_path / "targets.csv").write_text("name,mass_msun,age_myr\neps Eri,0.82,500\nkappa1 Cet,,\n")
    words = ("--days", "20", "--hours", "50", "--completeness", "closed form", "--report", "html")
    done = run("plan", "targets.csv", *words, folder=tmp_path)
    assert "2 targets, 20 days" in done.stdout
    folder = tmp_path / "mauvecl-plan"
    assert {"plan.ecsv", "stars.ecsv", "energies.ecsv", "plan.html", "plan.png"} <= {p.name for p in folder.iterdir()}
    again = run("plan", folder / "plan.ecsv", "--json", "--no-pictures", folder=tmp_path)
    rows = json.loads(again.stdout)["rows"]
    assert [row["hours"] for row in rows] == [50.0, 50.0]
    assert rows[0]["expected"] > 0


def test_table_of_targets_is_distinguished_from_an_answer(tmp_path: Path) -> None:
    """Accept both in place of a study file; only the table of an answer holds a study."""
    for name, meta in (("targets", {}), ("plan", {"study": "[plan]"})):
        Table({"name": ["eps Eri"]}, meta=meta).write(tmp_path / f"{name}.ecsv")
    assert not holds_study(tmp_path / "targets.ecsv")
    assert holds_study(tmp_path / "plan.ecsv")
    assert not holds_study(Path("targets.csv"))
    assert holds_study(Path("study.toml"))
    run("visible", "targets.ecsv", "--days", "1", "--no-pictures", folder=tmp_path)
