"""Processes of the command line: what they print and load, their progress, names of flags, and interruption."""

import json
import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from commands import started
from processes import python

import mauvecl
from mauvecl.cli.console import Meter


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
MISTAKES = (Path(__file__).parents[1] / "data" / "mistakes.txt").read_text(encoding="utf-8")
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
    code = TRIED.replace("HEAVY", repr(HEAVY))
    asked = [["--version"], *map(shlex.split, MISTAKES.strip().splitlines())]
    lines = python(code, json.dumps(asked), folder=tmp_path).stdout.splitlines()
    reported = [json.loads(line) for line in lines if line.startswith("[")]
    # Nor is all of it looked through for circles at the end, or often before.
    assert lines[-1] == "frozen True True"
    assert list(zip(asked, reported, strict=True)) == [
        (words, [0 if words == ["--version"] else 2, []]) for words in asked
    ]


#: Modules during whose import a command is interrupted, and code that wraps the interrupt in another error.
IMPORTED = ("importlib", "typing", "__future__", "mauvecl.host", "typer")
WRAPPED = (
    "type(str(), (), dict(name=Named()))",
    "real('pydantic_core').SchemaValidator(dict(type='literal', expected=[Named()]))",
)


@pytest.mark.long
@pytest.mark.parametrize(
    "started", [["-m", "mauvecl"], ["-c", "import sys; sys.argv[0] = 'mauvecl'; import mauvecl.cli.app"]]
)
@pytest.mark.parametrize(
    ("module", "within"),
    [*((name, "Named().__set_name__(None, str())") for name in IMPORTED),
     *(("importlib", wrapped) for wrapped in WRAPPED), *(("typer", wrapped) for wrapped in WRAPPED)],
)  # fmt: skip
def test_interrupt_during_imports_prints_one_line(started: list[str], module: str, within: str, tmp_path: Path) -> None:
    """Interrupt a command while a module is imported, also where Python or pydantic wraps the interrupt."""
    (tmp_path / "sitecustomize.py").write_text(
        "import builtins, os, signal\n"
        "real = builtins.__import__\n"
        "class Named:\n"
        "    def __set_name__(self, owner, name):\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "    __repr__ = lambda self: self.__set_name__(None, str())\n"
        "def imported(name, within=None, *given, **how):\n"
        f"    if name == {module!r} and (within or {{}}).get('__name__', '').startswith('mauvecl'):\n"
        "        builtins.__import__ = real\n"
        f"        {within}\n"
        "    return real(name, within, *given, **how)\n"
        "builtins.__import__ = imported\n"
    )
    path = os.pathsep.join([str(tmp_path), str(Path(__file__).parents[2])])
    done = subprocess.run(
        [sys.executable, *started, "schema"], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.stderr == "mauvecl: interrupted\n"
    assert done.returncode in ((-2, 130, 1) if within in WRAPPED else (-2, 130))


CLEARED = "\r\x1b[K"
#: Work done of a total every ten seconds, and what is shown of it: in a file and, of the last, on a terminal.
PROGRESS: dict[str, tuple[list[tuple[int, int]], list[str]]] = {
    # By the rate of the first tile, 1e12 realisations would take 348 000 years.
    "few": (
        [(0, 10**12), (1, 10**12), (2, 10**12)],
        [f"{done} of 1000000000000 realisations, 0.1 a second, time left unknown" for done in (1, 2)],
    ),
    "unknown": ([(0, 1000), (2, 1000)], ["2 of 1000 realisations, 0.2 a second, time left unknown"]),
    "seconds": ([(0, 1000), (100, 1000)], ["100 of 1000 realisations, 10 a second, 90 s left"]),
    "minutes": ([(0, 1000), (20, 1000)], ["20 of 1000 realisations, 2 a second, 8 min left"]),
    # A smaller number than before is late: the rate continues from the start.
    "late": (
        [(0, 1000), (400, 1000), (390, 1000), (500, 1000)],
        ["400 of 1000 realisations, 40 a second, 15 s left", "500 of 1000 realisations, 16.7 a second, 30 s left"],
    ),
    "next star": (
        [(0, 1000), (500, 1000), (0, 2000), (1000, 2000)],
        ["500 of 1000 realisations, 50 a second, 10 s left", "1000 of 2000 realisations, 100 a second, 10 s left"],
    ),
    "terminal": (
        [(0, 1000), (500, 1000), (0, 2000)],
        [f"{CLEARED}500 of 1000 realisations, 50 a second, 10 s left{CLEARED}"],
    ),
}


@pytest.mark.parametrize("name", PROGRESS)
def test_progress_states_rate_and_time_left(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, lines = PROGRESS[name]
    clock = SimpleNamespace(now=1e6)
    monkeypatch.setattr(time, "monotonic", lambda: clock.now)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: name == "terminal")
    with Meter() as meter:
        for done, total in steps:
            meter(done, total)
            clock.now += 10.0
    assert capsys.readouterr().err.rstrip("\n").split("\n") == lines


ROOT = Path(mauvecl.__file__).parent
#: The command line itself, and the command that the page offers.
OF_FLAGS = ("cli/", "web/tab.py")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
#: Docstrings, help texts, comments, the names of flags of fields, and whole commands, named as they are typed.
MEANT = re.compile(r'"""[\s\S]*?"""|#.*|Flag\([^)]*|flag="[^"]*"|`(?:mauvecl|wsl) [^`]*`')


def test_no_module_below_the_command_line_names_a_flag() -> None:
    files = {file.relative_to(ROOT): file for folder in (ROOT, ROOT / "host") for file in folder.rglob("*.py")}
    below = {name: file for name, file in files.items() if not str(name).startswith(OF_FLAGS)}
    assert len(below) > 120
    named = {name: FLAG.findall(MEANT.sub("", file.read_text(encoding="utf-8"))) for name, file in below.items()}
    assert {name: flags for name, flags in named.items() if flags} == {}


def test_dir_shows_public_names_only() -> None:
    shown = [name for name in dir(mauvecl) if not name.startswith("__")]
    assert sorted(shown) == sorted(mauvecl.__all__)
    assert all(getattr(mauvecl, name) is not None for name in shown)
