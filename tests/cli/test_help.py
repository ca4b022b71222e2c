"""What all verbs have in common: flags, help with examples, completion, values, stars, and narrow terminals."""

import json
import os
import re
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from answers import VERBS as ANSWERS
from commands import ended, run
from tables import DATA, toml
from typer.main import get_command
from typer.testing import CliRunner

import mauvecl
from mauvecl import Source
from mauvecl.cli import app

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
    listed, accept = json.loads(FILE.read_text(encoding="utf-8")), "`python tests/cli/test_help.py` accepts a change"
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


@pytest.mark.parametrize("typed", COMPLETED)
def test_bash_completes_names_and_files(typed: str, tmp_path: Path) -> None:
    for name in ("my-star.txt", "my-study.toml"):
        (tmp_path / name).touch()
    assert completed(typed, tmp_path) == set(COMPLETED[typed])


def test_completed_names_are_accepted(tmp_path: Path) -> None:
    names = completed("detect --star ", tmp_path)
    assert {"AUMic", "YZCMi", "ADLeo", "G2V", "GJ581"} <= names
    for name in names:
        assert " " not in name
        Source.from_library(name)


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
