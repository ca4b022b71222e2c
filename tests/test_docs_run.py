"""Run the snippets of README and documentation pages as written, in page order.

Each page has one folder and one Python namespace. Its Python blocks, its commands (indented lines that begin with
`mauvecl`) and its files (blocks of TOML whose first line names a file) run one after the other, after what the reader
brings (`BROUGHT`). Two things differ from what a reader does, and both are declared here: commands draw fewer
realisations (`REDUCED`), and some do not run (`NOT_RUN`).
"""

import re
import shlex
import shutil
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from commands import run
from layouts import documented_files
from scripts import ROOT

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
