"""Common properties of all verbs: help with examples, completion, no colour in pipes, and JSON alone."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from commands import started
from typer.main import get_command
from typer.testing import CliRunner

from mauvecl.cli.app import app
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, found
from mauvecl.schema.section import fields_of
from mauvecl.study.study import Study

VERBS: dict[str, Any] = {
    name: verb
    for top, found in get_command(app).commands.items()  # type: ignore[attr-defined]
    for name, verb in {top: found, **{f"{top} {k}": v for k, v in getattr(found, "commands", {}).items()}}.items()
}

#: Paths of the keys that each flag sets, by its parameter.
KEYS: dict[str, list[tuple[str, ...]]] = {}
for key, field in fields_of(Study):
    for flag in found(field, Flag):
        KEYS.setdefault(flag.parameter, []).append(key)


@pytest.mark.parametrize("name", VERBS)
def test_help_has_an_example(name: str) -> None:
    if not hasattr(VERBS[name], "commands"):
        assert f"mauvecl {name}" in VERBS[name].help.split("Example", 1)[1]
    assert all(p.help for p in VERBS[name].params if getattr(p, "opts", None) and p.param_type_name == "option")


def test_list_of_verbs_is_not_truncated() -> None:
    """Check that the first sentence of each verb fits into 80 columns."""
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "80"}).output
    assert "Commands:" in shown
    assert "..." not in shown.partition("Commands:")[2]


@pytest.mark.parametrize("name", VERBS)
def test_defaults_in_help_equal_those_of_the_study(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run each verb without arguments as far as its study."""
    asked: list[Study] = []

    def noted(study: Study, **_: Any) -> None:
        asked.append(study)
        raise InputError("noted")

    monkeypatch.setattr("mauvecl.cli.foresight.question_values", noted)
    flags = {p.name: p.help for p in VERBS[name].params if p.param_type_name == "option"}
    if "settings" not in flags and "set" not in flags:
        return
    CliRunner().invoke(app, [name])
    for flag, text in flags.items():
        reported = re.search(r"\[([^][]*)\]\.$", text or "")
        keys = [key for key in KEYS.get(flag, ()) if key[0] != "star"]
        if reported is None or not keys:
            continue
        values = [_at(asked[0], key) for key in keys]
        number = re.match(r"-?[\d.]+", reported[1])
        if number and all(isinstance(value, int | float) for value in values):
            assert float(number[0]) in values, flag
        elif all(isinstance(value, str) for value in values):
            assert any(value in reported[1] for value in values), flag


def _at(study: Study, path: tuple[str, ...]) -> Any:
    value: Any = study
    for key in path:
        value = getattr(value, key)
    return value


def test_each_flag_has_one_help_text() -> None:
    """A flag has one help text, whatever the verb; only its default differs."""
    said: dict[str, set[str]] = {}
    for verb in VERBS.values():
        for parameter in verb.params:
            if parameter.param_type_name == "option" and parameter.name != "help":
                said.setdefault(parameter.opts[0], set()).add(re.sub(r" \[[^][]*\]\.$", "", parameter.help))
    several = {flag: texts for flag, texts in said.items() if len(texts) > 1}
    assert not several
    assert len(said) > 40


def test_bash_completes_verbs_and_flags(tmp_path: Path) -> None:
    for typed, wanted in (("mauvecl det", "detect"), ("mauvecl detect --magn", "--magnitude")):
        words = {"COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split()) - 1), "_MAUVECL_COMPLETE": "complete_bash"}
        # The program's name decides the variable; the console script has it.
        done = subprocess.run(
            [str(Path(sys.executable).parent / "mauvecl")], capture_output=True, text=True, env=os.environ | words
        )
        assert wanted in done.stdout.split(), done


@pytest.mark.long
def test_pipes_have_no_colour_and_errors_go_to_stderr(tmp_path: Path) -> None:
    plain = started("library", folder=tmp_path, TERM="xterm-256color")
    assert "\x1b" not in plain.stdout + plain.stderr
    assert "G2V" in plain.stdout
    wrong = started("detect", "--fap", "2", folder=tmp_path, code=2, TERM="xterm-256color")
    assert wrong.stdout == ""
    assert "\x1b" not in wrong.stderr
    assert len(wrong.stderr.strip().splitlines()) == 1
    unknown = started("detetc", folder=tmp_path, code=2)
    assert "detetc" in unknown.stderr


@pytest.mark.long
def test_json_is_alone_on_standard_output(tmp_path: Path) -> None:
    """Run a separate process, because OpenCL drivers do not print through Python."""
    words = (
        "detect",
        "--star",
        "G2V",
        "-m",
        "8",
        "-a",
        "0.1",
        "-n",
        "10000",
        "--fap",
        "0.01",
        "--no-pictures",
        "--json",
    )
    assert json.loads(started(*words, folder=tmp_path).stdout)


@pytest.mark.long
def test_quiet_prints_neither_progress_nor_files(tmp_path: Path) -> None:
    words = ("detect", "--star", "G2V", "-m", "8", "-a", "0.1", "-n", "10000", "--fap", "0.01", "--no-pictures")
    loud, quiet = (started(*words, *more, folder=tmp_path) for more in ((), ("--quiet",)))
    assert "detection.ecsv" in loud.stdout + loud.stderr
    assert "detection.ecsv" not in quiet.stdout + quiet.stderr
    assert quiet.stderr == ""
    assert "matched" in quiet.stdout


#: Takes a twentieth of a second and more to load, and tells nobody that a value cannot be.
HEAVY = ("astropy", "erfa", "matplotlib", "numpy", "pyopencl", "scipy", "ssl", "synphot", "zarr")
MISTAKES = [
    ["detect", "--magnitude", "99"],
    ["detect", "--amplitude", "-1"],
    ["detect", "--exposure", "fifty"],
    ["detect", "--star", "G22V"],
    ["detect", "--star", "missing.txt"],
    ["detect", "--statistic", "chi3"],
    ["detect", "--nuisance", "dark=-1"],
    ["detect", "--set", "processes.jitter.uniform=[1, 0]"],
    ["detect", "--no-such-flag"],
    ["limit", "--exposure", "0"],
    ["map", "--x", "magnitude"],
    ["snr", "--instrument", "mauv"],
    ["gaussian", "--fap", "1e-9"],
    ["exposure", "missing.toml"],
    ["realise", "--band", "Q"],
    ["stare", "--shape", "davenport"],
    ["inject", "--set", "search.slope=true", "--set", "search.offset=false"],
    ["visible", "--set", "orbit.limits.sun_deg=181"],
]
#: Runs command lines one after the other in one process, and tells after each what it has loaded.
TRIED = """
import atexit, gc, json, sys
atexit.register(lambda: print("frozen", gc.get_freeze_count() > 10_000, gc.get_stats()[0]["collections"] < 100))
from mauvecl.cli.app import main
for words in json.loads(sys.argv[1]):
    sys.argv = ["mauvecl", *words]
    try:
        main()
    except SystemExit as end:
        print(json.dumps([end.code, [name for name in HEAVY if name in sys.modules]]))
"""


def test_mistakes_load_no_heavy_package(tmp_path: Path) -> None:
    """Check that an error appears before any package is imported that takes long."""
    code = TRIED.replace("HEAVY", repr(HEAVY))
    asked = [["--version"], *MISTAKES]
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(asked)], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    reported = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("[")]
    # Nor is all of it looked through for circles at the end, or often before.
    assert done.stdout.splitlines()[-1] == "frozen True True"
    assert list(zip(asked, reported, strict=True)) == [
        (words, [0 if words == ["--version"] else 2, []]) for words in asked
    ]


@pytest.mark.long
@pytest.mark.parametrize(
    "started", [["-m", "mauvecl"], ["-c", "import sys; sys.argv[0] = 'mauvecl'; import mauvecl.cli.app"]]
)
@pytest.mark.parametrize(
    "module",
    ["importlib", "typing", "__future__", "mauvecl.answers.verbs", "mauvecl.schema", "mauvecl.cli.boundary", "typer"],
)
def test_interrupt_during_imports_prints_one_line(started: list[str], module: str, tmp_path: Path) -> None:
    """Interrupt a command while a module is imported."""
    (tmp_path / "sitecustomize.py").write_text(
        "import builtins, os, signal\n"
        "real = builtins.__import__\n"
        "def imported(name, within=None, *given, **how):\n"
        f"    if name == {module!r} and (within or {{}}).get('__name__', '').startswith('mauvecl'):\n"
        "        builtins.__import__ = real\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "    return real(name, within, *given, **how)\n"
        "builtins.__import__ = imported\n"
    )
    path = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])
    done = subprocess.run(
        [sys.executable, *started, "schema"], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.stderr == "mauvecl: interrupted\n"
    assert done.returncode in (-2, 130)


@pytest.mark.long
@pytest.mark.parametrize("script", [True, False])
def test_interrupt_after_any_delay_shows_no_traceback_of_mauvecl(script: bool, tmp_path: Path) -> None:
    """Interrupt a command 0 to 300 ms after its start; before it is imported, Python's own start can be interrupted."""
    home = str(Path(__file__).parents[2])
    (tmp_path / "mauvecl").write_text("import sys\nfrom mauvecl.cli.app import main\nsys.exit(main())\n")
    command = [sys.executable, *([str(tmp_path / "mauvecl")] if script else ["-m", "mauvecl"]), "schema"]
    said = set()
    for delay_ms in (*range(0, 60, 2), *range(60, 301, 20)):
        process = subprocess.Popen(
            command, env=os.environ | {"PYTHONPATH": home}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        time.sleep(delay_ms / 1000)
        process.send_signal(signal.SIGINT)
        _, text = process.communicate()
        assert process.returncode in (-signal.SIGINT, 130, 1, 0), text
        assert text == "mauvecl: interrupted\n" or not re.search(r"mauvecl/(__init__|cli|answers|schema)", text), text
        said.add(text)
    assert "mauvecl: interrupted\n" in said
