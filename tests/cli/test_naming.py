"""Messages name parameters in Python and flags on the command line."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest

import mauvecl
import mauvecl.cli.app
from mauvecl import Engine, Instrument, Sky, Source, Study
from mauvecl.answers.verbs import VERBS
from mauvecl.cli.naming import with_flags
from mauvecl.schema.errors import InputError
from mauvecl.schema.quantities import count, number, numbers

ROOT = Path(mauvecl.__file__).parent
#: The command line itself, and the command that the page offers.
OF_FLAGS = ("cli/", "web/commands.py")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
#: Whole commands are named as they are typed.
COMMAND = re.compile(r"`(?:mauvecl|wsl) [^`]*`")


def texts(file: Path) -> list[str]:
    """Return the text of every literal of a module except docstrings and the names of flags of fields."""
    source = file.read_text(encoding="utf-8")
    if "--" not in source:
        return []
    tree = ast.parse(source)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docs = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and isinstance(node.body[0], ast.Expr)
    }
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Flag"]
    docs |= {id(name) for call in calls for name in call.args}
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return [node.value for node in nodes if id(node) not in docs]


def test_no_module_below_the_command_line_names_a_flag() -> None:
    files = [*ROOT.rglob("*.py"), *(ROOT / "host").rglob("*.py")]
    below = {file for file in files if not str(file.relative_to(ROOT)).startswith(OF_FLAGS)}
    assert len(below) > 200
    # Help texts of the registry are the command line's own.
    helps = {verb.help for verb in VERBS.values()}
    named = {
        (str(file.relative_to(ROOT)), text)
        for file in below
        for text in texts(file)
        if text not in helps and FLAG.search(COMMAND.sub("", text))
    }
    assert not named


def test_dir_shows_public_names_only() -> None:
    shown = [name for name in dir(mauvecl) if not name.startswith("__")]
    assert sorted(shown) == sorted(mauvecl.__all__)
    assert all(getattr(mauvecl, name) is not None for name in shown)


STUDY = Study().with_changes({}, [{"library": "G2V", "magnitude": 7.4}])


@pytest.mark.parametrize(
    ("call", "key", "value"),
    [
        (lambda: Study().with_settings(["run.fap=3"]), "run.fap", 3),
        (lambda: Study().with_settings(["star.0.magnitude=x"]), "star.0.magnitude", "x"),
        (lambda: Study.build({"run": {"seeds": 3}}, "text"), "run.seeds", 3),
        (lambda: STUDY.at("magnitude", "bright"), "magnitude", "bright"),
        (lambda: Source.from_library("G2V").at_magnitude(99.0), "magnitude", None),
        (lambda: Source.from_library("G2V").at_magnitude([7]), "magnitude", [7]),
        (lambda: Engine().detect(1, [], realisations=10, seed=1), "quiet", 1),
        (lambda: Sky.of_brightness("dark"), "brightness", "dark"),
        (lambda: number("flare temperature", 1.0, "K", low=1000.0), "flare_temperature", 1.0),
        (lambda: numbers("wavelengths", np.array([1.0, -1.0]), "nm", low=0.0), "wavelengths", -1.0),
        (lambda: count("frames", 0, low=1), "frames", 0),
        (lambda: Instrument.load("mauve").with_(temperature_c=99.0), "temperature_c", 99.0),
    ],
)
def test_errors_carry_key_value_and_what_is_expected(call, key, value) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError) as caught:
        call()
    error = caught.value
    assert error.key == key
    if value is not None:
        assert error.value == value
    assert (error.expected or "") in str(error)
    assert FLAG.search(str(error)) is None


def test_remedies_become_flags() -> None:
    assert with_flags("`extend` continues it") == "--extend continues it"
    assert with_flags("expected `resume=True` or `wavelength_unit='nm air'`") == (
        "expected --resume or --wavelength-unit 'nm air'"
    )
    assert with_flags("`fap=0.001`, `statistic='paper'`") == "--fap 0.001, --statistic paper"
    assert with_flags("see `mauvecl realise --resume` and `nothing_known`") == (
        "see `mauvecl realise --resume` and `nothing_known`"
    )
