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

import numpy as np
import pytest
from commands import ended, run
from study_keys import fields, metadata
from typer.main import get_command
from typer.testing import CliRunner

import mauvecl
from mauvecl import Source, Study
from mauvecl.cli import app

FILE = Path(__file__).parent.parent / "data" / "flags.json"
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


def test_each_flag_has_one_help_text() -> None:
    said: dict[str, set[str]] = {}
    for flags in all_flags().values():
        for flag, about in flags.items():
            assert about["help"], flag
            said.setdefault(flag, set()).add(re.sub(r" \[[^][]*\]\.$", "", about["help"]))
    assert {flag: texts for flag, texts in said.items() if len(texts) > 1} == {}
    assert len(said) > 40


@pytest.mark.parametrize("name", [name for name, verb in VERBS.items() if not hasattr(verb, "commands")])
def test_help_has_examples_and_fits_80_columns(name: str, tmp_path: Path) -> None:
    shown = run(*name.split(), "--help", folder=tmp_path, columns=80).stdout
    examples = re.findall(r"^ +mauvecl (?:.*\\\n)*.*$", shown, re.MULTILINE)
    assert all(shlex.split(example)[0] == "mauvecl" for example in examples)
    assert any(" ".join(example.split()).startswith(f"mauvecl {name}") for example in examples)
    assert max(len(line) for example in examples for line in example.splitlines()) <= 80


def test_bare_command_lists_every_command_on_a_line_of_its_own() -> None:
    """Check that the first sentence of each command fits into 80 columns, and that a bare `mauvecl` is no error."""
    done = CliRunner().invoke(app.app, [], env={"COLUMNS": "80"})
    assert (done.exit_code, done.stderr) == (0, "")
    assert done.output == CliRunner().invoke(app.app, ["--help"], env={"COLUMNS": "80"}).output
    lines = done.output.splitlines()
    assert max(map(len, lines)) <= 80
    for name, one in TOP.items():
        sentence = one.help.partition("\n")[0]
        assert [line.split() for line in lines if line.startswith(f"  {name} ")] == [[name, *sentence.split()]]


@pytest.mark.parametrize("name", [name for name, one in VERBS.items() if "study_file" in {p.name for p in one.params}])
def test_help_shows_the_common_flags_and_help_all_every_flag(name: str) -> None:
    def listed(flag: str) -> list[str]:
        shown = CliRunner().invoke(app.app, [name, flag], env={"COLUMNS": "80"})
        assert shown.exit_code == 0
        lines = shown.output.splitlines()
        assert max(map(len, lines)) <= 80
        return [found[1] for line in lines if (found := re.match(r"  (?:-\w, )?(--[\w-]+)", line))]

    common, every = listed("--help"), listed("--help-all")
    assert 4 <= len(common) - 2 <= 12
    assert set(common) < set(every)
    assert {*every} == {max(one.opts, key=len) for one in options(VERBS[name])} | {"--help"}


def test_help_all_groups_flags_by_section() -> None:
    shown = CliRunner().invoke(app.app, ["detect", "--help-all"], env={"COLUMNS": "80"}).output
    groups = re.findall(r"^(\S.*):\n((?:  .*\n)+)", shown, re.MULTILINE)
    listed = {heading: re.findall(r"^  (?:-\w, )?(--[\w-]+)", lines, re.MULTILINE) for heading, lines in groups}
    wanted = {"Star": "--star", "Sky": "--sky", "Flare": "--line", "Run": "--fap"}
    assert [heading for heading, flag in wanted.items() if flag not in listed[heading]] == []
    assert {"--json", "--set"} <= {*listed["Output and devices"]}


def completed(typed: str, folder: Path) -> set[str]:
    """Return what bash offers for the last word."""
    words = f"mauvecl {typed}"
    asked = {"COMP_WORDS": words, "COMP_CWORD": str(words.count(" ")), "_MAUVECL_COMPLETE": "complete_bash"}
    # The program's name decides the variable; the console script has it.
    script = str(Path(sys.executable).parent / "mauvecl")
    own = {"PYTHONPATH": str(Path(mauvecl.__file__).parents[1])}
    done = subprocess.run([script], capture_output=True, text=True, env=os.environ | asked | own, cwd=folder)
    return set(done.stdout.split("\n")) - {""}


@pytest.mark.parametrize(("typed", "wanted"), [
    ("det", {"detect"}), ("detect --magn", {"--magnitude", "--magnitude-system"}), ("detect --star AUM", {"AUMic"}),
    ("detect --star G2V,yz", {"G2V,yzCMi"}), ("limit K2.5", {"K2.5V"}),
    ("detect -s my-", {"my-star.txt", "my-study.toml"}), ("detect my-", {"my-star.txt", "my-study.toml"}),
    ("snr --instrument m", {"mauve", "mauvesim", "my-study.toml"}),
    # The shell completes these, where nothing is offered.
    ("detect --flares my-", set()), ("detect --output my-", set()),
])  # fmt: skip
def test_bash_completes_names_and_files(typed: str, wanted: set[str], tmp_path: Path) -> None:
    for name in ("my-star.txt", "my-study.toml"):
        (tmp_path / name).touch()
    assert completed(typed, tmp_path) == wanted


def test_completed_names_are_accepted(tmp_path: Path) -> None:
    names = completed("detect --star ", tmp_path)
    assert {"AUMic", "YZCMi", "ADLeo", "G2V", "GJ581"} <= names
    for name in names:
        assert " " not in name
        Source.from_library(name)


def test_every_verb_with_flares_takes_the_flags_of_their_spectrum() -> None:
    spectrum = [field for path, field in fields() if path[:2] == ("flare", "spectrum")]
    flags = {flag.parameter for field in spectrum for flag in metadata(field, "Flag", every=True)}
    assert len(flags) > 8
    # `analyse` adds no flares: it takes the temperature of a blackbody that it looks for.
    names = [{one.name for one in options(verb)} for name, verb in VERBS.items() if name != "analyse"]
    taking = [one for one in names if "flare_temperature" in one]
    assert len(taking) >= 8
    assert all(one >= flags for one in taking)


def test_every_numeric_flag_refuses_text(tmp_path: Path) -> None:
    flags = {
        max(option.opts, key=len): name
        for name, verb in TOP.items()
        for option in getattr(verb, "params", ())
        if (getattr(option, "metavar", None) or "").rstrip(",.") in ("NUMBER", "INTEGER")
    }
    assert len(flags) > 40
    for flag, verb in sorted(flags.items()):
        star = ("--star", "G2V") if "star" in {option.name for option in TOP[verb].params} else ()
        code, out, reported = ended(verb, *star, flag, "many", folder=tmp_path)
        assert (code, out) == (2, ""), (verb, flag)
        assert reported.startswith(f"mauvecl: {flag} must be a "), reported
        assert reported.endswith(", not 'many'\n"), reported
        assert reported.count("\n") == 1


def spectrum(folder: Path, name: str) -> str:
    nm = np.linspace(170.0, 1150.0, 800)
    np.savetxt(folder / name, np.transpose([nm, 1e-12 * np.exp(-(((nm - 560) / 250) ** 2))]))
    return name


#: The argument of `analyse` is a file of frames.
OBSERVING = [name for name, one in TOP.items()
             if {"study_file", "star"} <= {p.name for p in one.params} and name != "analyse"]  # fmt: skip


@pytest.mark.parametrize("verb", OBSERVING)
def test_star_is_accepted_in_place_of_the_study(verb: str, tmp_path: Path) -> None:
    """Give every verb a star with a wrong magnitude, which its message names."""
    for star in ("G2V,M3V", spectrum(tmp_path, "noname")):
        code, _, reported = ended(verb, star, "-m", "99", folder=tmp_path)
        assert (code, reported) == (2, "mauvecl: --magnitude must be a number between -30 and 40 mag, not 99\n"), star
    code, _, reported = ended(verb, "G2V", "--star", "M3V", "-m", "7", folder=tmp_path)
    assert (code, reported) == (2, "mauvecl: 'G2V' and --star are both stars, but only one may be given\n")


def test_given_star_becomes_the_star_of_the_study(tmp_path: Path) -> None:
    for given in ("G2V", spectrum(tmp_path, "star.txt")):
        run("exposure", given, "-m", "8", "--snr", "10", "--at", "300", "--no-pictures", folder=tmp_path)
        (star,) = Study.read(tmp_path / "mauvecl-exposure" / "study.toml").star
        assert (star.library or (star.file and star.file.name), star.magnitude) == (given, 8.0)
    # A study is still one, whatever it is called.
    (tmp_path / "mauvecl-exposure" / "study.toml").rename(tmp_path / "study")
    assert "star V = 9" in run("exposure", "study", "-m", "9", "--no-pictures", folder=tmp_path).stdout


@pytest.mark.parametrize("name", ["ad leo", "Proxima", "YZ CMi", "GJ 388", "Barnard's star"])
def test_well_known_star_is_accepted_with_a_note(name: str, tmp_path: Path) -> None:
    shown = run("simulate", "--star", name, "--no-pictures", folder=tmp_path).stdout
    (star,) = Study.read(tmp_path / "mauvecl-simulate" / "study.toml").star
    assert re.search(rf"spectrum of .*V = {star.magnitude:g}, {star.distance_pc:g} pc, from \w+", shown)
    # The star may also be named in place of the study, with another magnitude.
    shown = run("simulate", name, "-m", "9", "--no-pictures", folder=tmp_path).stdout
    assert f"{name} V = 9" in shown
    assert f"V = {star.magnitude:g}" not in shown


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


@pytest.mark.parametrize(("changes", "shown"), [("{}", False), ("{bias_dn=5.0, dark_scale_dn_per_s=0.01}", True)])
def test_empty_columns_are_omitted(changes: str, shown: bool, tmp_path: Path) -> None:
    """The column of reasons is there only where the formula fails."""
    words = "gaussian --star G2V -m 9 --exposure 5 -n 2000 --fap 0.1 --statistic chi2 --no-pictures --set"
    done = run(*words.split(), f"observation.changes={changes}", folder=tmp_path)
    assert any("why" in row for row in tables(done.stdout)) == shown


#: Questions whose tables are wide.
WIDE = [
    ["simulate", "--star", "AU Mic", "-a", "5%"],
    ["limit", "--star", "AU Mic", "--of", "amplitude", "--fap", "0.1", "-n", "2000"],
    ["gaussian", "--star", "G2V", "-m", "9", "--sweep", "exposure=5,50", "--fap", "0.1", "-n", "2000"],
    ["stare", "--star", "M3V", "-m", "9", "-a", "0.5", "--duration", "900", "--distance", "5"],
    ["plan", "--set", "plan.targets=[{name='eps Eri'}, {name='EK Dra'}]", "--days", "3"],
]


def test_tables_have_one_part_in_80_columns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for words in WIDE:
        done = CliRunner().invoke(app.app, [*words, "--no-pictures"], env={"COLUMNS": "80", "FORCE_COLOR": "1"})
        shown = re.sub(r"\x1b\[[0-9;]*m", "", done.output)
        assert "─" in shown, shown
        # A part without a title begins with its headings.
        assert not re.search(r"\n *\n *\n +\w", shown), shown


@pytest.mark.long
def test_parts_of_a_table_repeat_only_the_labels(tmp_path: Path) -> None:
    """Print a year in 80 columns: each month occurs once, and each part repeats the names of the targets."""
    words = ["visible", "--look-at", "eps Eri", "--start", "2027-01-01", "--days", "365", "--no-pictures"]
    words += ["--output", str(tmp_path / "out")]
    shown = CliRunner().invoke(app.app, words, env={"COLUMNS": "80", "FORCE_COLOR": "1"}).output
    months = tables(shown.partition("Hours of exposure by month")[2])
    for month in range(1, 13):
        assert sum(f"2027-{month:02d}" in row for row in months) == 1
    parts = [row for row in months if row[0] == "target"]
    assert len(parts) == len([row for row in months if row[0] == "eps Eri"]) > 1


if __name__ == "__main__":
    FILE.write_text(json.dumps(all_flags(), indent=1) + "\n", encoding="utf-8")
