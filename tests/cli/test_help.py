"""What verbs have in common: flags, help, completion, narrow terminals; files, records, and what becomes of them."""

import atexit
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from itertools import pairwise, takewhile
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import pytest
from answers import VERBS as ANSWERS
from astropy.table import Table
from commands import Done, ended, run
from golden_inputs import write_inputs
from marks import long_but
from tables import DATA, toml
from typer.main import get_command
from typer.testing import CliRunner

import mauvecl
from mauvecl import Source, Study, detect
from mauvecl.cli import app

#: Words after each verb, its files besides study and record, and what it states; and what commands say.
TABLE, SAID = toml("verbs.toml"), toml("said.toml")
SETTINGS = TABLE.pop("settings")
#: Verbs that draw. Every table of theirs describes its columns and holds its study; of the others one table does.
DRAWING = {"snr", "detect", "limit", "map", "gaussian", "stare", "inject", "measure"}

ALL = pytest.mark.parametrize("verb", long_but(TABLE, "exposure", "limit", "visible"))


def words(verb: str) -> list[str]:
    return [verb, *shlex.split(TABLE[verb]["words"])]


@cache
def answered(verb: str) -> tuple[Path, Done]:
    """Ask a verb once for all tests; return the folder, whose answer is in `out`, and what was printed."""
    folder = Path(mkdtemp(prefix=f"mauvecl-{verb}-"))
    atexit.register(shutil.rmtree, folder)
    write_inputs(folder, " ".join(words(verb)))
    return folder, run(*words(verb), "--output", "out", folder=folder, columns=80)


@pytest.fixture
def out(verb: str, tmp_path: Path) -> Path:
    """Return a copy of an answer that a test may change."""
    return shutil.copytree(answered(verb)[0] / "out", tmp_path / "out")


def assumed(shown: str) -> list[str]:
    _, clauses = shown.split("\nAssumed:\n")
    lines = takewhile(lambda line: line.startswith("  "), clauses.splitlines())
    return [clause for line in lines for clause in line.strip().split("; ")]


@ALL
def test_verb_writes_its_files_and_a_study_that_gives_the_same_bits(verb: str) -> None:
    """State assumptions as well; with --json, standard output holds nothing else."""
    folder, done = answered(verb)
    written = [folder / "out" / name for name in (*TABLE[verb]["files"].split(), "study.toml", "run.json")]
    assert {*(folder / "out").iterdir()} == {*written}
    assert all(path.name in done.stdout.splitlines()[-1] for path in written)
    assert all(path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" for path in written if path.suffix == ".png")
    assert assumed(done.stdout) == TABLE[verb]["stated"].split("; ")
    headline, *others = done.stdout.splitlines()
    assert re.fullmatch(r"[A-Za-z0-9].* .*\.", headline), "the first line is the answer, in a sentence"
    shown = others[: others.index("Assumed:")]
    assert max(len(line.rstrip()) for line in shown if line.startswith("  ")) <= 80, "tables are narrow"
    assert "\x1b" not in done.stdout
    record = json.loads(written[-1].read_text())
    drawn = {"devices", "kernels"} if verb in DRAWING else set()
    assert {"seed", "study", "inputs", "wall_time_s", "mauvecl", "messages"} | drawn <= set(record)
    assert record["verb"] == verb
    assert all(len(entry.get("source digest", "-" * 64)) == 64 for entry in record["inputs"])
    # The study that was written is asked again.
    first, again = folder / "out", folder / "again"
    asked = [*words(verb)] if verb == "analyse" else [verb, first / "study.toml"]
    done = run(*asked, "--no-pictures", "--json", "-o", "again", folder=folder)
    assert json.loads(done.stdout)["assumed"] == f"Assumed: {TABLE[verb]['stated']}."
    for path in again.glob("*.ecsv"):
        assert path.read_text() == (first / path.name).read_text(), path.name
        if path.stem == verb or (verb in DRAWING and path.stem != "events"):
            assert Study.read(path) == Study.read(first / "study.toml")
            table = Table.read(path)
            assert [name for name in table.colnames if not table[name].info.description] == [], path.name
    assert (again / "study.toml").read_text() == (first / "study.toml").read_text()


def faults(out: Path, code: int = 1) -> list[tuple[str, str]]:
    """Return the files that `mauvecl verify` finds at fault, with their states."""
    found = json.loads(run("verify", out, "--json", folder=out.parent, code=code).stdout)
    return [(one["file"], one["state"]) for one in found]


@ALL
def test_every_changed_or_missing_file_is_noticed(verb: str, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check every verb, also without the packages for stores."""
    for package in ("zarr", "h5py", "xarray"):
        monkeypatch.setitem(sys.modules, package, None)
    assert "agrees" in run("verify", out, folder=out.parent).stdout
    for path in sorted(out.iterdir()):
        content = path.read_bytes()
        middle = len(content) // 2
        for changed in (content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :], content + b"\n", b""):
            path.write_bytes(changed)
            assert [name for name, _ in faults(out)] == [path.name], path
        path.unlink()
        assert faults(out) == [(path.name, "missing")]
        path.write_bytes(content)
    assert faults(out, code=0) == []


@pytest.mark.parametrize("verb", ["exposure"])
def test_every_value_of_the_record_is_verified(out: Path) -> None:
    """Change and remove each entry of the record, and digests together with their files."""
    place = out / "run.json"
    text = place.read_text(encoding="utf-8")
    record = json.loads(text)
    for key in record:
        for other in ({**record, key: "other"}, {k: v for k, v in record.items() if k != key}):
            place.write_text(json.dumps(other, indent=2) + "\n", encoding="utf-8")
            assert "run.json" in dict(faults(out)), key
    # The same values in another layout, and a key that is there twice.
    for changed in (json.dumps(record), text.replace("{", '{"verb": "detect",', 1), text[:-3], "[]"):
        place.write_text(changed, encoding="utf-8")
        assert [name for name, _ in faults(out)] == ["run.json"]
    place.write_text(text, encoding="utf-8")
    # Other files have no effect; flags of stores are refused.
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    assert faults(out, code=0) == []
    assert "--repair" in run("verify", out, "--repair", folder=out, code=2).stderr
    # Another answer replaces this one and its digests in the same folder.
    run(*words("exposure"), "--no-pictures", "--set", "run.seed=5", "--output", out, folder=out)
    assert faults(out, code=0) == []
    assert json.loads(place.read_text(encoding="utf-8"))["record_digest"] != record["record_digest"]


def on_writing(happens: Callable[[str], None], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda handle: happens(Path(f"/proc/self/fd/{handle}").readlink().name))


def full_from(step: int, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Simulate a disk that is full after `step` files; return the names of the files that were tried."""
    tried: list[str] = []

    def fill(name: str) -> None:
        tried.append(name)
        if len(tried) > step:
            raise OSError(28, "No space left on device")

    on_writing(fill, monkeypatch)
    return tried


def test_each_file_is_whole_or_missing_if_the_disk_fills(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The answer is printed all the same, and an earlier file is kept."""
    asked = (*words("simulate"), "--no-pictures", "--output")
    plain = run(*asked, "whole", folder=tmp_path).stdout
    whole = {p.name: p.read_bytes() for p in (tmp_path / "whole").iterdir()}
    assert len(whole) >= 4
    for step in range(len(whole)):
        earlier = tmp_path / str(step) / "observation-1.ecsv"
        earlier.parent.mkdir()
        earlier.write_text("of an earlier run")
        with monkeypatch.context() as patch:
            tried = full_from(step, patch)
            code, shown, reported = ended(*asked, str(step), *["--json"] * (step == 0), folder=tmp_path)
        assert code == 2
        assert "No space left on device" in reported
        there = {p.name: p.read_bytes() for p in earlier.parent.iterdir()}
        assert len(tried) == len(whole)
        if step == 0:
            assert "more files" in reported
            assert json.loads(shown)
            assert there == {earlier.name: b"of an earlier run"}
            continue
        assert len(there) == step
        # The run record holds the time.
        assert all(there[name] == whole[name] for name in there if name.endswith((".ecsv", ".toml")))
        assert shown.partition("Wrote")[0] == plain.partition("Wrote")[0]


def test_interruption_while_writing_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(name: str) -> None:
        if ".fits" in name:
            raise KeyboardInterrupt

    on_writing(interrupt, monkeypatch)
    code, _, reported = ended(*words("simulate"), "--no-pictures", "--output", "out", folder=tmp_path)
    assert code == 130
    assert reported == (
        "mauvecl: interrupted; observation-1.ecsv written to 'out', each file whole, and the same command writes all "
        "of them\n"
    )
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"observation-1.ecsv"}


def test_output_folder_is_locked_while_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, refused = (*words("exposure"), "--no-pictures", "--output", "out"), []

    def ask_again(name: str) -> None:
        with monkeypatch.context() as patch:
            on_writing(lambda name: None, patch)
            code, _, reported = ended(*asked, folder=tmp_path)
        refused.append(code == 2 and "another" in reported)

    on_writing(ask_again, monkeypatch)
    run(*asked, folder=tmp_path)
    assert refused == [True] * 3
    monkeypatch.undo()
    run(*asked, folder=tmp_path)


def test_files_of_the_previous_run_alone_are_removed(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run("simulate", "--star", "G2V", "--star", "K3V", "-m", "7", "-t", "5", "-o", "out", folder=tmp_path)
    assert {"observation-2.ecsv", "observation-2.png", "observation-1.png"} <= {path.name for path in out.iterdir()}
    (out / "notes.txt").write_text("mine")
    (out / "observation-2.fits").write_text("changed by hand")
    run(*words("exposure"), "--no-pictures", "--output", "out", folder=tmp_path)
    kept = {path.name for path in out.iterdir()}
    assert kept == {"exposure.ecsv", "study.toml", "run.json", "notes.txt", "observation-2.fits"}
    # A foreign record removes nothing.
    (tmp_path / "mine").write_text("mine")
    (out / "a").write_text("mine")
    for record in ("", "[]", '{"files": 3}', '{"files": {"../mine": "x"}}', '{"files": {"a": 1}}'):
        (out / "run.json").write_text(record)
        run(*words("exposure"), "--no-pictures", "--output", "out", folder=tmp_path)
        assert (out / "a").read_text() == (tmp_path / "mine").read_text() == "mine"


@pytest.mark.parametrize(("setting", "stated"), SETTINGS.items())
def test_assumptions_follow_the_study(setting: str, stated: str) -> None:
    few = ["run.realisations=500", "run.fap=0.5", "run.statistics=['matched']", "flare.amplitudes=[0.1]"]
    usual, changed = (detect(Study().with_settings([*few, *one])).assumed for one in ([], [setting]))
    assert stated not in usual
    assert stated in changed
    assert "\n" not in changed


@pytest.mark.parametrize("name", long_but(SAID, *(name for name in SAID if "long" not in SAID[name])))
def test_commands_say_what_applies(name: str, tmp_path: Path) -> None:
    row = {"says": [], "silent": [], "files": {}, "code": 0, "columns": 200} | SAID[name]
    for file, text in row["files"].items():
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(text)
    done = run(*shlex.split(row["run"]), "--no-pictures", folder=tmp_path, code=row["code"], columns=row["columns"])
    said = done.stdout + done.stderr
    assert [pattern for pattern in row["says"] if not re.search(pattern, said)] == [], said
    assert [pattern for pattern in row["silent"] if re.search(pattern, said)] == [], said


FILE = DATA / "flags.json"
TOP: dict[str, Any] = get_command(app.app).commands  # type: ignore[attr-defined]
#: Every verb, and every verb of `library`.
VERBS: dict[str, Any] = {
    name: verb
    for top, one in TOP.items()
    for name, verb in {top: one, **{f"{top} {k}": v for k, v in getattr(one, "commands", {}).items()}}.items()
}


def options(verb: Any) -> list[Any]:
    hidden = ("help", "install_completion", "show_completion")
    return [one for one in verb.params if one.param_type_name == "option" and one.name not in hidden]


def all_flags() -> dict[str, dict[str, Any]]:
    """Return the options of every verb by their first name."""
    return {
        name: {
            one.opts[0]: {
                "names": [*one.opts, *one.secondary_opts],
                "metavar": one.metavar,
                "repeated": one.multiple,
                "switch": one.is_flag,
                "help": one.help,
            }
            for one in options(verb)
        }
        for name, verb in VERBS.items()
    }


def test_flags_equal_those_of_the_file() -> None:
    """Compare with the file, flag by flag, and the order of flags as well."""
    listed, accept = json.loads(FILE.read_text("utf-8")), "`PYTHONPATH=tests python tests/cli/test_help.py` accepts it"
    now = all_flags()
    for verb in {**listed, **now}:
        old, new = listed.get(verb, {}), now.get(verb, {})
        changed = [flag for flag in {**old, **new} if old.get(flag) != new.get(flag)]
        assert changed == [], f"flags of {verb} are not those of {FILE.name}: {accept}"
        assert list(old) == list(new), f"flags of {verb} have another order than in {FILE.name}: {accept}"


@pytest.mark.parametrize("name", [name for name, verb in VERBS.items() if not hasattr(verb, "commands")])
def test_help_has_examples_and_the_common_flags_and_help_all_every_flag(name: str, tmp_path: Path) -> None:
    texts = [run(*name.split(), "--help", folder=tmp_path, columns=80).stdout]
    examples = re.findall(r"^ +mauvecl (?:.*\\\n)*.*$", texts[0], re.MULTILINE)
    assert all(shlex.split(example)[0] == "mauvecl" for example in examples)
    assert any(" ".join(example.split()).startswith(f"mauvecl {name}") for example in examples)
    assert max(len(line) for example in examples for line in example.splitlines()) <= 80
    if "study_file" not in {parameter.name for parameter in VERBS[name].params}:
        return
    texts.append(run(name, "--help-all", folder=tmp_path, columns=80).stdout)
    assert max(len(line) for text in texts for line in text.splitlines()) <= 80
    common, every = (re.findall(r"^  (?:-\w, )?(--[\w-]+)", text, re.MULTILINE) for text in texts)
    assert 4 <= len(common) - 2 <= 12
    assert set(common) < set(every)
    assert {*every} == {max(one.opts, key=len) for one in options(VERBS[name])} | {"--help"}
    if name == "detect":
        groups = dict(re.findall(r"^(\S.*):\n((?:  .*\n)+)", texts[1], re.MULTILINE))
        wanted = {"Star": "--star", "Sky": "--sky", "Flare": "--line", "Run": "--fap", "Output and devices": "--json"}
        assert [heading for heading, flag in wanted.items() if f" {flag} " not in groups[heading]] == []


def test_bare_command_lists_every_command_on_a_line_of_its_own() -> None:
    """List commands in four groups, answers in the order of the registry, and exit codes; to ask so is no error."""
    done = CliRunner().invoke(app.app, [], env={"COLUMNS": "80"})
    assert (done.exit_code, done.stderr) == (0, "")
    assert done.output == CliRunner().invoke(app.app, ["--help"], env={"COLUMNS": "80"}).output
    assert max(map(len, done.output.splitlines())) <= 80
    documented = (DATA.parents[1] / "docs" / "command-line.md").read_text()
    for code in (1, 2, 70, 74, 130, 141, 143):
        assert re.search(rf"\b{code}\b", done.output)
        assert f"| {code} |" in documented
    groups = re.findall(r"^(Plan|Simulate|Analyse|Tools)[^\n]*:\n((?:  .*\n)+)", done.output, re.MULTILINE)
    assert [heading for heading, _ in groups] == ["Plan", "Simulate", "Analyse", "Tools"]
    listed = [[line.split() for line in lines.splitlines()] for _, lines in groups]
    wanted = [[name, *one.help.partition("\n")[0].split()] for name, one in TOP.items()]
    assert sorted(words for lines in listed for words in lines) == sorted(wanted)
    for lines, own in zip(listed, ("plan", "stare", "analyse", "serve"), strict=True):
        names = [words[0] for words in lines]
        assert own in names
        answers = [name for name in names if name in ANSWERS]
        assert answers == sorted(answers, key=ANSWERS.index)


def completed(typed: str, folder: Path) -> set[str]:
    """Return what bash offers for the last word."""
    words = f"mauvecl {typed}"
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" ")), "_MAUVECL_COMPLETE": "complete_bash"}
    # The program's name decides the variable; the console script has it.
    script = str(Path(sys.executable).parent / "mauvecl")
    own = {"PYTHONPATH": str(Path(mauvecl.__file__).parents[1])}
    done = subprocess.run([script], capture_output=True, text=True, env=os.environ | asked | own, cwd=folder)
    return set(done.stdout.split("\n")) - {""}


COMPLETED = toml("completed.toml")


@pytest.mark.long
def test_bash_completes_names_which_are_accepted_and_files(tmp_path: Path) -> None:
    names = completed("detect --star ", tmp_path)
    assert {"AUMic", "YZCMi", "ADLeo", "G2V", "GJ581"} <= names
    for name in names:
        assert " " not in name
        Source.from_library(name)
    for name in ("my-star.txt", "my-study.toml"):
        (tmp_path / name).touch()
    for typed, offered in COMPLETED.items():
        assert completed(typed, tmp_path) == {*offered}, typed


def test_every_numeric_flag_refuses_text(tmp_path: Path) -> None:
    every = all_flags()
    numeric = [(name, flag) for name, flags in every.items() for flag, about in flags.items()
               if (about["metavar"] or "").rstrip(",.") in ("NUMBER", "INTEGER")]  # fmt: skip
    assert len(numeric) > 40
    for verb, flag in {flag: (verb, flag) for verb, flag in numeric}.values():
        star = ("--star", "G2V") if "--star" in every[verb] else ()
        code, out, reported = ended(verb, *star, flag, "many", folder=tmp_path)
        assert (code, out) == (2, ""), (verb, flag)
        assert re.fullmatch(rf"mauvecl: {flag} must be a .*, not 'many'\n", reported), reported


def tables(text: str) -> list[list[str]]:
    """Return the lines of the tables that a text shows, split at two blanks or more."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    return [re.split(r"\s{2,}", line.strip()) for line in plain.splitlines() if line.startswith("  ")]


@pytest.mark.parametrize("width", [10, 40, 80, 132])
def test_narrow_terminal_truncates_nothing(width: int, tmp_path: Path) -> None:
    words = ["detect", "--star", "G2V", "-m", "7.4", "-a", "0.01,0.02", "-n", "2000", "--fap", "0.1", "--no-pictures"]
    words += ["--sweep", "exposure=5,50", "--quiet", "--wide", "--output", str(tmp_path / "out")]
    wide = tables(run(*words, folder=tmp_path).stdout.partition("Assumed:")[0])
    env = {"COLUMNS": str(width), "FORCE_COLOR": "1"}
    shown = CliRunner().invoke(app.app, words, env=env).output
    narrow = tables(shown.partition("Assumed:")[0])
    assert "…" not in shown
    assert {cell for row in wide for cell in row} <= {cell for row in narrow for cell in row}
    # What a row is begins each of its parts, and a value keeps its interval.
    assert {row[0] for row in narrow if len(row) > 1} == {row[0] for row in wide if len(row) > 1}
    for row in wide:
        for value, interval in pairwise(row):
            if interval.startswith("["):
                assert any((value, interval) in pairwise(one) for one in narrow)
    if width >= 80:
        lines = re.sub(r"\x1b\[[0-9;]*m", "", shown).splitlines()
        assert max(map(len, lines)) <= width


if __name__ == "__main__":
    FILE.write_text(json.dumps(all_flags(), indent=1) + "\n", encoding="utf-8")
