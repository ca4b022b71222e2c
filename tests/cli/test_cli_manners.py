"""What every verb of the command line has in common: help by examples, completion, no colour in pipes, JSON alone."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from commands import started
from typer.main import get_command

from mauvecl.cli.app import app

VERBS: dict[str, Any] = {
    name: verb
    for top, found in get_command(app).commands.items()  # type: ignore[attr-defined]
    for name, verb in {top: found, **{f"{top} {k}": v for k, v in getattr(found, "commands", {}).items()}}.items()
}


@pytest.mark.parametrize("name", VERBS)
def test_help_teaches_by_an_example(name: str) -> None:
    if not hasattr(VERBS[name], "commands"):
        assert f"mauvecl {name}" in VERBS[name].help.split("Example", 1)[1]
    assert all(p.help for p in VERBS[name].params if getattr(p, "opts", None) and p.param_type_name == "option")


def test_the_same_word_means_the_same_everywhere() -> None:
    """A flag has one help text, whatever the verb."""
    said: dict[str, set[str]] = {}
    for verb in VERBS.values():
        for parameter in verb.params:
            if parameter.param_type_name == "option" and parameter.name != "help":
                said.setdefault(parameter.opts[0], set()).add(parameter.help)
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
def test_pipes_get_no_colour_and_errors_their_own_way(tmp_path: Path) -> None:
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
@pytest.mark.parametrize(
    "words",
    [
        ("library", "--json"),
        ("detect", "--star", "G2V", "-m", "8", "-a", "0.1", "-n", "100000", "--no-pictures", "--json"),
        ("exposure", "--snr", "10", "--at", "300", "--star", "G2V", "-m", "7.4", "--json"),
    ],
    ids=lambda words: words[0],
)
def test_json_is_alone_on_standard_output(words: tuple[str, ...], tmp_path: Path) -> None:
    assert json.loads(started(*words, folder=tmp_path).stdout)


@pytest.mark.long
def test_quiet_prints_no_progress_and_no_files(tmp_path: Path) -> None:
    words = ("detect", "--star", "G2V", "-m", "8", "-a", "0.1", "-n", "100000", "--no-pictures")
    loud, quiet = (started(*words, *more, folder=tmp_path) for more in ((), ("--quiet",)))
    assert "detection.ecsv" in loud.stdout + loud.stderr
    assert "detection.ecsv" not in quiet.stdout + quiet.stderr
    assert quiet.stderr == ""
    assert "matched" in quiet.stdout


#: Takes a tenth of a second and more to load, and tells nobody that a value cannot be.
HEAVY = ("astropy", "matplotlib", "pyopencl", "scipy.optimize", "scipy.special", "ssl", "synphot")


#: Each with its exit code.
MISTAKES = {
    "--version": 0,
    "detect --magnitude 99": 2,
    "detect --amplitude -1": 2,
    "detect --star G22V": 2,
    "detect --star missing.txt": 2,
    "detect --statistic chi3": 2,
    "limit --exposure 0": 2,
    "map --x magnitude": 2,
    "snr --instrument mauv": 2,
    "gaussian --fap 1e-9": 2,
    "exposure missing.toml": 2,
    "realise --band Q": 2,
}
#: Each in a copy of one process that has only begun.
LOADING = """
import os, sys
from mauvecl.cli.app import main
for words in {words!r}:
    if os.fork() == 0:
        sys.argv, code = ["mauvecl", *words.split()], 0
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
        print("told", words, code, *(name for name in {heavy!r} if name in sys.modules), sep="|", flush=True)
        os._exit(0)
    os.wait()
"""


def test_nothing_large_is_loaded_for_a_mistake(tmp_path: Path) -> None:
    """What a user waits for after a typing error is imports, and nothing else: none of those that take long."""
    code = LOADING.format(words=tuple(MISTAKES), heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    told = [line.split("|")[1:] for line in done.stdout.splitlines() if line.startswith("told|")]
    assert told == [[words, str(code)] for words, code in MISTAKES.items()], done
