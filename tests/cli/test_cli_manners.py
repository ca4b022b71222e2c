"""Processes of the command line: what they print and load, and how they are interrupted."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import started


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
def test_output_in_another_process_is_json_alone_or_quiet(tmp_path: Path) -> None:
    """Run separate processes, because OpenCL drivers do not print through Python."""
    words = ("detect", "--star", "G2V", "-m", "8", "-a", "0.1", "-n", "10000", "--fap", "0.01", "--no-pictures")
    loud, quiet, alone = (started(*words, *more, folder=tmp_path) for more in ((), ("--quiet",), ("--json",)))
    assert "detection.ecsv" in loud.stdout + loud.stderr
    assert "detection.ecsv" not in quiet.stdout + quiet.stderr
    assert quiet.stderr == ""
    assert "matched" in quiet.stdout
    assert json.loads(alone.stdout)


#: Takes a twentieth of a second and more to load, and tells nobody that a value cannot be.
HEAVY = ("astropy", "erfa", "matplotlib", "numpy", "pyopencl", "scipy", "ssl", "synphot", "zarr")
MISTAKES = """
detect --magnitude 99
detect --amplitude -1
detect --exposure fifty
detect --star G22V
detect --star missing.txt
detect --statistic chi3
detect --nuisance dark=-1
detect --set 'processes.jitter.uniform=[1, 0]'
detect --no-such-flag
limit --exposure 0
map --x magnitude
snr --instrument mauv
gaussian --fap 1e-9
exposure missing.toml
realise --band Q
stare --shape davenport
inject --set search.slope=true --set search.offset=false
visible --set orbit.limits.sun_deg=181
"""
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
    asked = [["--version"], *map(shlex.split, MISTAKES.strip().splitlines())]
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
    ["importlib", "typing", "__future__", "mauvecl.schema", "typer"],
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
