"""Names, links and examples of the documentation hold, and the snippets of README and pages run as written, in order.

Each page has one folder and one Python namespace. Its Python blocks, its commands (indented lines that begin with
`mauvecl`) and its files (blocks of TOML whose first line names a file) run one after the other, after what the reader
brings (`BROUGHT`). Two things differ from what a reader does, and both are declared here: commands draw fewer
realisations (`REDUCED`), and some do not run (`NOT_RUN`).
"""

import doctest
import importlib
import json
import pkgutil
import re
import shlex
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from commands import run
from layouts import documented_files
from scripts import ROOT
from typer.main import get_command

import mauvecl
from mauvecl import Instrument, Study
from mauvecl.cli import app

#: What is appended to a verb's flags, or instead to some commands; what Python draws fewer; what does not run, and why.
CHANGES = tomllib.loads((ROOT / "tests" / "data" / "brought" / "changes.toml").read_text(encoding="utf-8"))
REDUCED, INSTEAD, FEWER, NOT_RUN, NOT_EXECUTED = CHANGES.values()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SNIPPET = re.compile(r"^```(python|toml)\n(.*?)^```$|^    (mauvecl [^\n]*)$", re.DOTALL | re.MULTILINE)


def snippets(page: Path) -> Iterator[tuple[str, str]]:
    """Yield kind and text of every snippet of a page, in its order."""
    for kind, block, command in SNIPPET.findall(page.read_text(encoding="utf-8")):
        if command:
            yield "command", command
        elif kind == "python" or (kind == "toml" and re.match(r"# [\w.-]+\.toml\n", block)):
            yield kind, block


def bring(brought: str | tuple[str, str, str] | Callable[[], object]) -> None:
    """Copy a folder of the data, write a table that a page shows (page, first words and file), or call."""
    if isinstance(brought, str):
        shutil.copytree(ROOT / "tests" / "data" / brought, ".", dirs_exist_ok=True)
    elif isinstance(brought, tuple):
        page, begin, name = brought
        (text,) = re.findall(rf"```\n({begin}.*?)```", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.DOTALL)
        Path(name).write_text(text)
    else:
        brought()


def standards() -> None:
    """Write the study, the mapping and the frames of the page on standard stars."""
    names: dict[str, object] = {}
    for kind, snippet in snippets(ROOT / "docs" / "standard-star.md"):
        if kind == "command":
            return
        read_snippet(kind, snippet, names)


TARGETS, FRAMES = ("plan.md", "name,ra,", "targets.csv"), ("brought/frames", "flares")
BROUGHT: dict[str, tuple[str | tuple[str, str, str] | Callable[[], object], ...]] = {
    "README.md": (TARGETS, *FRAMES, standards),
    "gallery.md": (lambda: Path("tests").symlink_to(ROOT / "tests"),),
    "mapping.md": ("brought/mauve", lambda: documented_files(Path())),
    "my-instrument.md": ("brought/efficiency",),
    "neighbours.md": (("neighbours.md", "name,sep", "near.csv"), "brought/neighbours", *FRAMES),
    "my-star.md": ("brought/own-star", "brought/spectra"),
    "observations.md": FRAMES,
    "plan.md": (TARGETS,),
    "tutorial.md": ("brought/own-star",),
    "unknowns.md": ("brought/stray-light",),
    **dict.fromkeys(("cluster.md", "long-runs.md", "page.md"), ("brought/study",)),
}


def reduced(command: str) -> list[str]:
    """Return the words of a command after `mauvecl`, with the flags that make it short; none if it does not run."""
    words = shlex.split(command, comments=True)[1:]
    if any(re.match(pattern, shlex.join(words)) for pattern in NOT_RUN):
        return []
    own = next((flags for begin, flags in INSTEAD.items() if shlex.join(words).startswith(begin)), None)
    return words + shlex.split(REDUCED.get(words[0], "") if own is None else own)


@pytest.mark.long
@pytest.mark.parametrize("page", [page for page in PAGES if any(snippets(page))], ids=lambda page: page.stem)
def test_snippets_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MAUVECL_DATA_DIR", str(tmp_path / "data"))
    for brought in BROUGHT.get(page.name, ()):
        bring(brought)
    names: dict[str, object] = {}
    for kind, snippet in snippets(page):
        if kind != "command":
            read_snippet(kind, snippet, names)
        elif words := reduced(snippet):
            run(*words, folder=tmp_path)


def read_snippet(kind: str, snippet: str, names: dict[str, object]) -> None:
    """Write the file of a TOML block, or run a Python block in a namespace."""
    if kind == "toml":
        Path(snippet.partition("\n")[0].removeprefix("# ")).write_text(snippet)
    elif not any(word in snippet for word in NOT_EXECUTED):
        for many, few in FEWER.items():
            snippet = snippet.replace(many, few)
        exec(compile(snippet, "snippet", "exec"), names)


def test_skipped_snippets_exist_on_pages() -> None:
    every = [(page.name, kind, snippet) for page in PAGES for kind, snippet in snippets(page)]
    commands = [snippet.removeprefix("mauvecl ") for _, kind, snippet in every if kind == "command"]
    python = "".join(snippet for _, kind, snippet in every if kind == "python")
    assert len(commands) > 60
    for pattern in NOT_RUN:
        assert any(re.match(pattern, one) for one in commands), pattern
    for begin in (*REDUCED, *INSTEAD):
        assert any(one.startswith(begin) for one in commands), begin
    for word in (*FEWER, *NOT_EXECUTED):
        assert word in python, word
    assert set(BROUGHT) <= {name for name, *_ in every}
    assert sum(1 for one in commands if reduced(f"mauvecl {one}")) > 0.85 * len(commands)


#: `mauvecl/detection/detection.py`, or with a name in it: `mauvecl/detection/detection.py: Roc`. Paths of sources may
#: begin below `mauvecl`.
NAMED = re.compile(
    r"`((?:(?:host|kernels|mauvecl|tests|bench|tools|docs)/[\w./*-]+\.\w+)|(?:\w+/[\w/]+\.py))(?::\s*(\w+))?[^`]*`"
)
ALL_PAGES = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "RELEASING.md"]
#: What defines a name, by a file's ending.
DEFINITIONS = {".py": r"^\s*(?:def|class) {0}\b|^{0}\b.* = |^    {0}: ", ".mako": r"^(?:INLINE )?\w+ {0}\("}


def test_documented_names_exist_and_main_ones_have_examples() -> None:
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
    for main in (mauvecl.Source, mauvecl.Sky, mauvecl.Instrument, mauvecl.expect, mauvecl.Engine, mauvecl.Study):
        assert ">>> " in main.__doc__, main


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
