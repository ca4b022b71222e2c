"""Completion in shells: names of stars and instruments, and files.

Shells complete files by themselves where nothing else is offered, so only names bring their files along.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from glob import escape, glob
from pathlib import Path


def complete_star(incomplete: str) -> list[str]:
    """Return names of stars, and files, that continue the last of the stars with commas between them."""
    from mauvecl.host.stars.library import EXAMPLES, all_names, kept

    before, comma, last = incomplete.rpartition(",")
    # Shells take a blank for the end of a word; names are known without blanks.
    names = [name.replace(" ", "") for name in all_names() if name not in EXAMPLES]
    names += [star.name for star in kept() if " " not in star.name]
    return [f"{before}{comma}{word}" for word in (*_continued(last, names), *_files(last))]


def complete_instrument(incomplete: str) -> list[str]:
    """Return names of instruments, and TOML files."""
    from mauvecl.host.instrument import shipped_names

    return [*_continued(incomplete, shipped_names()), *_files(incomplete, (".toml",))]


def complete_study(incomplete: str) -> list[str]:
    """Return files, and names of stars if something is typed."""
    return complete_star(incomplete) if incomplete else _files(incomplete)


#: Functions by the keys of flags.
OF_KEYS = {
    "star.library": complete_star, "star.extend": complete_star, "change.extend": complete_star,
    "observation.instrument": complete_instrument,
}  # fmt: skip


def _continued(typed: str, names: Iterable[str]) -> list[str]:
    """Return the names that begin with a text in any case, with the text as it was typed."""
    return [typed + name[len(typed) :] for name in names if name.casefold().startswith(typed.casefold())]


def _files(typed: str, endings: Sequence[str] = ()) -> list[str]:
    """Return the files and folders that begin with a text."""
    found = sorted(glob(escape(typed) + "*"))
    folders = [f"{path}/" for path in found if Path(path).is_dir()]
    return [*folders, *(p for p in found if not Path(p).is_dir() and (not endings or p.endswith(tuple(endings))))]
