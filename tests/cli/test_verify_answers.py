"""`mauvecl verify` notices every change and removal in the folders of all verbs."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from commands import run
from refusals import refused
from test_files_written import VERBS

from mauvecl.answers.checked import verify_answer

MORE = {
    "gaussian": ("gaussian", "--star", "G2V", "-m", "7.4", "-n", "10000", "--fap", "0.01", "--sweep", "exposure=5"),
    "inject": (
        "inject", "--star", "M3V", "-m", "9", "--distance", "5", "--duration", "2000", "-n", "20",
        "--set", "injections.sizes=2", "--set", "injections.widths=2",
    ),
    "visible": ("visible", "--look-at", "eps Eri", "--start", "2027-01-01", "--days", "2"),
    "plan": ("plan", "targets.csv", "--hours", "20", "--start", "2027-01-01", "--days", "20",
             "--completeness", "closed form"),
}  # fmt: skip


def ask(verb: str, folder: Path) -> Path:
    (folder / "targets.csv").write_text("name\neps Eri\n", encoding="utf-8")
    words = (VERBS | MORE)[verb]
    pictures = () if "--no-pictures" in words else ("--no-pictures",)
    run(*words, *pictures, "--output", "out", folder=folder)
    return folder / "out"


@pytest.mark.long
@pytest.mark.parametrize("verb", [*VERBS, *MORE])
def test_every_changed_or_missing_file_is_noticed(verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check every verb, also without the packages for stores."""
    for package in ("zarr", "h5py", "xarray"):
        monkeypatch.setitem(sys.modules, package, None)
    out = ask(verb, tmp_path)
    assert "agrees" in run("verify", out, folder=tmp_path).stdout
    written = sorted(path for path in out.iterdir() if path.is_file() and path.name[0] != ".")
    assert {path.name for path in written} >= {"study.toml", "run.json"}
    for path in written:
        content = path.read_bytes()
        middle = len(content) // 2
        for changed in (content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :], content + b"\n", b""):
            path.write_bytes(changed)
            assert [one.file for one in verify_answer(out)] == [path.name], path
        reported = json.loads(run("verify", out, "--json", folder=tmp_path, code=1).stdout)
        assert reported[0]["file"] == path.name
        path.unlink()
        assert [(one.file, one.state) for one in verify_answer(out)] == [(path.name, "missing")]
        path.write_bytes(content)
    assert verify_answer(out) == []


def test_study_of_the_user_is_not_an_answer(tmp_path: Path) -> None:
    """Report nothing for a user's study and table, which no run wrote."""
    (tmp_path / "study.toml").write_text("[run]\nfap = 0.01\n", encoding="utf-8")
    header = "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: amplitude, datatype: float64}\n"
    (tmp_path / "flares.ecsv").write_text(f"{header}amplitude\n0.1\n", encoding="utf-8")
    assert "'.' is not a store of spectra" in run("verify", ".", folder=tmp_path, code=2).stderr
    with refused("folder"):
        verify_answer(tmp_path)


def test_every_value_of_the_record_is_verified(tmp_path: Path) -> None:
    """Change and remove each entry of the record, and digests together with their files."""
    out = ask("exposure", tmp_path)
    place = out / "run.json"
    text = place.read_text(encoding="utf-8")
    record = json.loads(text)
    for key in record:
        for other in ({**record, key: "other"}, {k: v for k, v in record.items() if k != key}):
            place.write_text(json.dumps(other, indent=2) + "\n", encoding="utf-8")
            assert any(one.file == "run.json" for one in verify_answer(out)), key
    # The same values in another layout, and a key that is there twice.
    for changed in (json.dumps(record), text.replace("{", '{"verb": "detect",', 1), text[:-3], "[]"):
        place.write_text(changed, encoding="utf-8")
        assert [one.file for one in verify_answer(out)] == ["run.json"]
    place.write_text(text, encoding="utf-8")
    assert verify_answer(out) == []


def test_verify_refuses_foreign_folders(tmp_path: Path) -> None:
    """Refuse flags of stores for an answer, and folders that hold neither; other files have no effect."""
    out = ask("exposure", tmp_path)
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    assert verify_answer(out) == []
    assert "--repair" in run("verify", out, "--repair", folder=tmp_path, code=2).stderr
    (tmp_path / "empty").mkdir()
    with refused("folder", "run.json"):
        verify_answer(tmp_path / "empty")


def test_repeated_run_is_verified(tmp_path: Path) -> None:
    """Replace an answer and its digests by another answer in the same folder."""
    out = ask("exposure", tmp_path)
    first = json.loads((out / "run.json").read_text(encoding="utf-8"))
    run(*VERBS["exposure"], "--no-pictures", "--set", "run.seed=5", "--output", "out", folder=tmp_path)
    assert verify_answer(out) == []
    assert json.loads((out / "run.json").read_text(encoding="utf-8"))["record_digest"] != first["record_digest"]
