"""Names, imports and links in the documentation exist, and examples in docstrings give what they show."""

import doctest
import importlib
import json
import pkgutil
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from scripts import ROOT
from test_docs_run import PAGES
from typer.main import get_command

import mauvecl
from mauvecl import Instrument, Study
from mauvecl.cli import app

#: `mauvecl/detection/detection.py`, or with a name in it: `mauvecl/detection/detection.py: Roc`. Paths of sources may
#: begin below `mauvecl`.
NAMED = re.compile(
    r"`((?:(?:host|kernels|mauvecl|tests|bench|tools|docs)/[\w./*-]+\.\w+)|(?:\w+/[\w/]+\.py))(?::\s*(\w+))?[^`]*`"
)
ALL_PAGES = [*PAGES, ROOT / "CONTRIBUTING.md"]
#: What defines a name, by a file's ending.
DEFINITIONS = {".py": r"^\s*(?:def|class) {0}\b|^{0}\b.* = |^    {0}: ", ".mako": r"^(?:INLINE )?\w+ {0}\("}


def test_documented_names_exist() -> None:
    named = [(page.name, *found) for page in ALL_PAGES for found in NAMED.findall(page.read_text(encoding="utf-8"))]
    places = {
        file: next((one for top in ("", "mauvecl") for one in (ROOT / top).glob(file)), None) for _, file, _ in named
    }
    assert [(page, file) for page, file, _ in named if places[file] is None] == []
    defined = [(page, file, name) for page, file, name in named if name]
    assert len(defined) > 40
    for page, file, name in defined:
        pattern, text = DEFINITIONS[Path(file).suffix].format(name), places[file].read_text(encoding="utf-8")
        assert re.search(pattern, text, re.MULTILINE), (page, file, name)
    dotted = re.findall(r"`(mauvecl(?:\.\w+)+)`", (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8"))
    assert len(dotted) > 25
    # Imports in pages, benches, tools, and programs that tests start.
    files = [*ALL_PAGES, *(path for folder in ("bench", "tools", "tests") for path in (ROOT / folder).rglob("*.py"))]
    texts = "".join(path.read_text(encoding="utf-8") for path in files)
    imports = re.findall(r"^from (mauvecl[\w.]*) import (\w+(?:, \w+)*)", texts, re.MULTILINE)
    imported = {f"{home}.{name}" for home, names in imports for name in names.split(", ")}
    assert len(imported) > 100
    for name in (*dotted, *imported):
        pkgutil.resolve_name(name)


def test_studies_and_instruments_shown_are_valid() -> None:
    mapping, *_ = get_args(get_type_hints(mauvecl.read_frames)["mapping"])
    seen = 0
    for page in ALL_PAGES:
        for text in re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.DOTALL):
            data = tomllib.loads(text)
            if "extends" in data:
                given = {key: one for key, one in data.items() if key not in ("extends", "version")}
                values = {key: one["value"] if isinstance(one, dict) else one for key, one in given.items()}
                # Files of the reader's are not here.
                Instrument.load(data["extends"]).with_(**{k: v for k, v in values.items() if ".ecsv" not in str(v)})
                assert set(values) <= set(Instrument.model_fields)
            elif "time" in data:
                mapping(**data)
            else:
                Study.build(data, page.name)
            seen += 1
    assert seen > 10


def test_documented_commands_have_existing_verbs_and_flags() -> None:
    verbs: Any = get_command(app.app)
    seen = 0
    for page in ALL_PAGES:
        text = page.read_text(encoding="utf-8")
        for line in re.findall(r"^    (mauvecl .*)$", text, re.MULTILINE) + re.findall(r"`(mauvecl [^`\n]*)`", text):
            words = shlex.split(line.replace("...", ""), comments=True)[1:]
            command = verbs
            while words and words[0] in getattr(command, "commands", {}):
                command = command.commands[words.pop(0)]
            assert words[:1] == [] or words[0] == "VERB" or words[0].startswith("-") or command is not verbs, line
            flags = {flag for parameter in command.params for flag in (*parameter.opts, *parameter.secondary_opts)}
            flags |= {"--help", "--help-all"}
            assert {word.split("=")[0] for word in words if re.match("--?[a-z]", word)} <= flags, (page.name, line)
            seen += 1
    assert seen > 40


def test_notebooks_have_no_output_and_links_have_text() -> None:
    """Refuse links without text, which appear only in the built documentation."""
    for page in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        cells = json.loads(page.read_text(encoding="utf-8"))["cells"]
        assert all(not cell.get("outputs") for cell in cells), page.name
    assert not [page for page in ALL_PAGES if re.search(r"\[\]\([^)]*\)", page.read_text(encoding="utf-8"))]


EXAMPLES = sorted(
    ".".join((*above, *path.relative_to(ROOT).with_suffix("").parts))
    for folder, above in (("mauvecl", ()), ("host", ("mauvecl",)))
    for path in (ROOT / folder).rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_of_docstrings_run(name: str) -> None:
    failed, attempted = doctest.testmod(importlib.import_module(name))
    assert failed == 0 < attempted


def test_main_names_have_examples() -> None:
    for main in (mauvecl.Source, mauvecl.Sky, mauvecl.Instrument, mauvecl.expect, mauvecl.Engine, mauvecl.Study):
        assert ">>> " in main.__doc__, main
