"""What the verbs of the command line share: engine, messages, files."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mauvecl.console import Meter
    from mauvecl.engine import Engine


def engine(device: str | None, meter: Meter | None) -> Engine:
    """The engine on a device, with progress."""
    from mauvecl.engine import Engine

    return Engine(device, progress=meter)


def say(lines: list[str], *, as_json: bool) -> None:
    """Tell the reader, unless standard output is for JSON alone."""
    from mauvecl.console import show

    if not as_json:
        show(lines)


def pictures_wanted(pictures: bool, *, quiet: bool, as_json: bool) -> bool:
    """Whether pictures are to be drawn; tells where matplotlib is missing."""
    from mauvecl.pictures import available

    if pictures and not available():
        if not quiet:
            say(["No pictures: matplotlib is missing, `pip install 'mauvecl[plot]'` brings it."], as_json=as_json)
        return False
    return pictures


def finish(files: list[Path], started: float, *, quiet: bool, as_json: bool) -> None:
    """Name the files written."""
    if not quiet:
        names = ", ".join(path.name for path in files)
        seconds = time.perf_counter() - started
        say([f"Wrote {names} to {files[0].parent}/ in {seconds:.1f} s."], as_json=as_json)


def short(value: Any) -> str:
    """What a cell of a sweep has, for the terminal, without its unit."""
    value = getattr(value, "value", value)
    return value if isinstance(value, str) else f"{value:g}"
