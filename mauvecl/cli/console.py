"""Text on the terminal: tables, errors with flags in place of keys, and exit codes."""

from __future__ import annotations

import contextlib
import datetime
import errno
import os
import platform
import re
import shlex
import sys
import tempfile
import textwrap
import time
import traceback
import warnings
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from mauvecl.schema.columns import INTERVAL, View
from mauvecl.schema.errors import REMEDY, SUBJECT, InputError, printable

if TYPE_CHECKING:
    import typer
    from rich.console import Console

    from mauvecl.runs.pool import PoolProgress

#: Exit codes other than 0; 70 and 74 as sysexits.h has them, those above 128 as shells count signals.
FAULTY: Final = 1
BAD_INPUT: Final = 2
UNFORESEEN: Final = 70
OUTPUT_FULL: Final = 74
INTERRUPTED: Final = 130
READER_GONE: Final = 141
#: Their description in `--help`.
EXIT_CODES = (
    f"Exit codes: 0 done, {FAULTY} a check found a fault, {BAD_INPUT} bad input, {UNFORESEEN} an unforeseen failure "
    f"(a fault of mauvecl; a file with its traceback is named), {OUTPUT_FULL} standard output cannot be written, "
    f"{INTERRUPTED} interrupted, {READER_GONE} the reader of standard output went away, 143 terminated."
)
#: Error numbers of full disks and quotas, which name no file.
DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE)

#: What to do instead of giving a flag that was removed.
REMOVED = {
    "--forget": "leave it out, since a driver that failed is tried again by every run",
    "--keep-after": "leave it out, since finished parts of a run are saved after 20 s",
    "--trials": "give --set change.trials=NUMBER",
}
PRINTERS = ("click", "typer", "rich", "mauvecl.cli")  # libraries that write to standard output for mauvecl
LONGEST = 1000  # largest number of characters of a message
WIDEST = 100_000  # largest width of a table in a pipe or file, characters
PATIENCE_S = 2.0  # duration of work below which no progress is shown
CLEAR_LINE = "\r\x1b[K"  # text that clears the line of a terminal
#: Fraction of the work after which the remaining time is estimated, since the first tile's rate is unreliable.
ESTIMATED_FROM = 0.01
#: Units of the remaining time, s; smaller times than three of them are in the next one.
UNITS = (("days", 86_400.0), ("hours", 3600.0), ("min", 60.0))
_app: typer.Typer | None = None  # the running command line, whose flags messages name
folder: Path | None = None  # output folder of the verb, once known, to which tracebacks are written


def guarded(app: typer.Typer) -> int:
    """Run the command line, and return its exit code."""
    global _app, folder
    _app, folder = app, None
    out = sys.stdout

    def warn(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        # The kind of warnings of other packages tells more than their text.
        _say(f"note: {message}" + ("" if category is UserWarning else f" ({category.__name__})"), 0)

    for stream in (sys.stdout, sys.stderr):
        # Names may contain any character; those that the terminal's encoding lacks are written as escapes.
        if (change := getattr(stream, "reconfigure", None)) is not None:
            change(errors="backslashreplace")
    with warnings.catch_warnings():
        warnings.showwarning = warn
        try:
            code = app(standalone_mode=False)
            if code == INTERRUPTED:
                _say("interrupted", INTERRUPTED)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else BAD_INPUT if end.code else 0
            if isinstance(end.__context__, BrokenPipeError):
                # Click and rich end in different ways if the reader of standard output is gone.
                sys.stdout, code = out, READER_GONE
        except Exception as error:
            code = _failed(error)
    return _flushed(code if isinstance(code, int) else 0)


def _failed(error: Exception) -> int:
    """Report bad input, a wrong use of flags, a device or file that fails, or an unforeseen failure."""
    if isinstance(error, InputError):
        return _say(name_flag(error), BAD_INPUT)
    if isinstance(error, MemoryError):
        return _say("the memory does not suffice for this question; try a smaller one or use more memory", BAD_INPUT)
    if isinstance(error, OSError) and (code := _failed_call(error)):
        return code
    # Click's own classes are private to newer versions of typer.
    if hasattr(error, "format_message") and isinstance(getattr(error, "exit_code", None), int):
        # A usage error of Click, or the help text of an empty command line, which Click prints itself.
        text = str(error.format_message())
        flag = getattr(error, "option_name", "")
        if flag in REMOVED:
            text = f"the flag {flag} was removed: {REMOVED[flag]}"
        return _say(text.splitlines()[0] if text else "", BAD_INPUT) if text.strip() else BAD_INPUT
    # Python wraps an interrupt while a class is made, and pydantic one of its builders.
    if type(error).__name__ == "Abort" or "KeyboardInterrupt" in f"{error!r} {error.__cause__!r}":
        return _say("interrupted", INTERRUPTED)
    # Other failures are reported without what it loads.
    from mauvecl.device.drivers import DeviceError

    if isinstance(error, DeviceError):
        return _say(str(error), BAD_INPUT, keep_lines=error.kind == "kernel")
    file = _write_traceback(error)
    name = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return _say(
        f"something unforeseen happened, a fault of mauvecl ({name[:200]}); its traceback is in {str(file)!r}, and "
        "what was written before is kept",
        UNFORESEEN,
    )


def _failed_call(error: OSError) -> int:
    """Report a failure of standard output or of a file that the user named; return 0 for any other."""
    if code := _flushed(0):
        return code
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    if error.filename is None and str(frame.f_globals.get("__name__", "")).startswith(PRINTERS):
        # Click writes through its own stream.
        return _not_written(error)
    if error.filename is None and error.errno not in DISK:
        return 0
    named = isinstance(error.filename, str | bytes)
    name = "a file" if error.filename is None else repr(os.fsdecode(error.filename) if named else error.filename)
    return _say(
        f"{printable(name, 200)} cannot be used ({error.strerror or error}); "
        "give another place (what was written before is kept)",
        BAD_INPUT,
    )


def _say(text: str, code: int, *, keep_lines: bool = False) -> int:
    """Print one sentence on standard error, and return the exit code; `keep_lines` is for a compiler's log."""
    if not keep_lines:
        text = printable(re.sub(r"[\n\t]", " ", text), LONGEST)
    with contextlib.suppress(OSError, ValueError):
        print(f"mauvecl: {text}", file=sys.stderr, flush=True)
    return code


def _flushed(code: int) -> int:
    """Flush standard output; return the exit code, or that of a failure to write."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        return _not_written(error)
    except ValueError:
        # Already closed.
        pass
    return code


def _not_written(error: OSError) -> int:
    """Report that standard output fails, and discard its buffer, on which Python would fail again at exit."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
    if isinstance(error, BrokenPipeError):
        return READER_GONE
    reason = error.strerror
    return _say(f"standard output cannot be written ({reason}); use one with room (files are kept)", OUTPUT_FULL)


def _write_traceback(error: Exception) -> Path | str:
    """Write the traceback to a file in the output folder, or else in the folder of temporary files."""
    from mauvecl.host import VERSION

    now = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S")
    versions = f"mauvecl {VERSION}, Python {platform.python_version()}, {platform.platform()}"
    steps = "".join(traceback.format_exception(error, limit=-60))
    text = "\n".join([versions, f"command: {sys.argv!r}"[:20_000], steps])
    for place in filter(None, (folder, Path(tempfile.gettempdir()))):
        with contextlib.suppress(OSError):
            # A random name, which nobody can have created before.
            handle, name = tempfile.mkstemp(prefix=f"mauvecl-fault-{now}-", suffix=".txt", dir=place)
            with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
                file.write(text)
            return Path(name)
    return "no file, since none can be written"


class Meter:
    """Progress with rate and time left, on standard error, for work longer than two seconds.

    On a terminal and in a notebook it is one line that changes; elsewhere a line every ten seconds.
    """

    # Returns the progress of a pool, with parts from a checkpoint and parts that were counted again.
    standing: Callable[[], PoolProgress] | None = None

    def __init__(self, *, quiet: bool = False, unit: str = "realisations") -> None:
        self._quiet, self._unit = quiet, unit
        self._started = self._shown = time.monotonic()
        self._last = self._total = 0
        self._changes = sys.stderr.isatty() or "ipykernel" in sys.modules

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Clear the line."""
        if self._changes and self._shown > self._started:
            print(CLEAR_LINE, end="", file=sys.stderr, flush=True)

    def __call__(self, done: int, total: int) -> None:
        """Record how much work is done, in the meter's unit."""
        now = time.monotonic()
        if done < self._last and total == self._total:
            # Threads may report in another order than they worked.
            return
        if done <= self._last:
            # Start of the next star's work.
            self.__exit__()
            self._started = self._shown = now
        self._last, self._total = done, total
        if self._quiet or now - self._started < PATIENCE_S or now - self._shown < (0.2 if self._changes else 10.0):
            return
        self._shown, time_left = now, "time left unknown"
        standing = None if self.standing is None else self.standing()
        # Parts from a checkpoint took no time.
        counted = done - (standing.resumed if standing is not None and self._unit == "realisations" else 0)
        rate = counted / max(now - self._started, 1e-9)
        if counted >= ESTIMATED_FROM * total:
            seconds = (total - done) / rate
            unit, size = next((row for row in UNITS if seconds > 3 * row[1]), ("s", 1.0))
            time_left = f"{seconds / size:.0f} {unit} left"
        retries = f", {standing.retries} parts counted again" if standing is not None and standing.retries else ""
        line = f"{done} of {total} {self._unit}, {rate:.3g} a second, {time_left}{retries}"
        print(*((CLEAR_LINE, line) if self._changes else (line, "\n")), sep="", end="", file=sys.stderr, flush=True)


def _console(**options: Any) -> Console:
    from rich.console import Console

    # Names may contain brackets and colons, which are not markup here.
    return Console(highlight=False, markup=False, emoji=False, **options)


def show(lines: Sequence[str]) -> None:
    """Print plain lines on standard output; on a terminal they are broken between words, and continued indented."""
    console = _console(soft_wrap=True)
    fill = partial(textwrap.fill, break_long_words=False, break_on_hyphens=False)
    for line in lines:
        if console.is_terminal:
            indent = " " * (len(line) - len(line.lstrip()))
            line = fill(line, max(console.width, len(indent) + 1), subsequent_indent=2 * indent)
        console.print(line)


def show_view(view: View, *, wide: bool = True) -> bool:
    """Print a table of an answer, or the sentence in its place, and return whether columns were left out.

    Unless `wide`, a table that is too wide is printed without the columns of details, and first columns whose values
    all rows share stand in the title. A `wide` table in a pipe is as wide as it needs to be.
    """
    from rich import box
    from rich.table import Table

    if view.table is None:
        show([view.title])
        return False
    console = _console()
    room = WIDEST if wide and not console.is_terminal else console.width
    title, columns = view.title, _printed(view)
    left_out = not wide and bool(view.details) and _width(columns) > room
    if left_out:
        columns = _printed(view, view.details)
    n_rows = len(columns[0]) - 1 if columns else 0
    if not wide and n_rows and _width(columns) > room:
        # Of a single row the first column alone counts as shared, since its parts begin with its label.
        differing = (k for k, (_, *cells) in enumerate(columns) if len(set(cells)) > 1)
        shared = 1 if n_rows == 1 else next(differing, 0)
        if n_rows > 1 or _width(columns[shared:]) <= room:
            title = "; ".join([title, *(f"{heading} {cell}" for heading, cell, *_ in columns[:shared])])
            columns = columns[shared:]
    show([title])
    for part in _divided(columns, room):
        table = Table(box=box.SIMPLE_HEAD)
        for heading, *cells in part:
            numeric = bool(cells) and all(cell[:1] in "0123456789-+.<>=" for cell in cells)
            table.add_column(heading, justify="right" if numeric else "left", no_wrap=True)
        for row in zip(*(cells for _, *cells in part), strict=True):
            table.add_row(*row)
        # A column that exceeds the terminal is printed completely.
        _console(width=max(room, _width(part))).print(table)
    return left_out


def _printed(view: View, hidden: Collection[str] = ()) -> list[list[str]]:
    """Return the columns of a table, each with its heading and its cells."""
    headings, cells = view.texts(hidden, empty=False)
    return list(map(list, zip(headings, *cells, strict=True)))


def _width(columns: Sequence[list[str]]) -> int:
    """Return the width of a table: two blanks per column, and lines between columns and at both ends."""
    from rich.cells import cell_len

    return 1 + sum(3 + max(map(cell_len, column)) for column in columns)


def _divided(columns: list[list[str]], room: int) -> list[list[list[str]]]:
    """Divide a table: each part has the first columns, which identify rows, and as many others as fit."""
    if _width(columns) <= room:
        return [columns]
    # Each part repeats the first columns: as few as tell all rows apart, at most three, within half of the room.
    n_lines = len(columns[0])
    apart = next((n for n in (1, 2, 3) if len(set(zip(*columns[:n], strict=True))) == n_lines), 3)
    first = columns[: next((n for n in range(apart, 1, -1) if _width(columns[:n]) <= room / 2), 1)]
    # The column of an interval stays with that of its value.
    groups: list[list[list[str]]] = []
    for column in columns[len(first) :]:
        if groups and column[0] == INTERVAL:
            groups[-1].append(column)
        else:
            groups.append([column])
    parts = [[*first]]
    for group in groups:
        if len(parts[-1]) > len(first) and _width([*parts[-1], *group]) > room:
            parts.append([*first])
        parts[-1] += group
    return parts


def _flags(name: str, *, off: bool = False) -> list[str]:
    """Return the flags that set a parameter or a key of the study, or turn it off, the long one first.

    They are those of the called command, or else of all keys of the study.
    """
    from typer.main import get_command

    from mauvecl.study.study import keys_of

    command: Any = None if _app is None else get_command(_app)
    for word in sys.argv[1:]:
        command = getattr(command, "commands", {}).get(word, command)
    # If a key has several flags, the last takes its value unchanged.
    keywords = {keyword.path: keyword for keyword in keys_of() if f".{keyword.path}".endswith(f".{name}")}
    names = {name, *(keyword.name for keyword in keywords.values())}
    for parameter in getattr(command, "params", ()):
        if parameter.name in names:
            flags = parameter.secondary_opts if off else parameter.opts
            return sorted((flag for flag in flags if flag.startswith("-")), key=len, reverse=True)
    keyword = next((keyword for keyword in keys_of() if keyword.name in names), None)
    on, _, switched_off = keyword.flag.names[0].partition("/") if keyword else ("", "", "")
    return [flag for flag in [switched_off if off else on] if flag]


def with_flags(text: str) -> str:
    """Return a message with flags instead of the remedies in backticks."""

    def as_flag(match: re.Match[str]) -> str:
        value, off = match["value"], match["value"] in ("false", "False")
        flags = _flags(match["key"], off=off)
        if not flags:
            return match[0]
        return flags[0] if off or value in (None, "True") else f"{flags[0]} {shlex.quote(value)}"

    return REMEDY.sub(as_flag, text)


def name_flag(error: InputError) -> str:
    """Return the error's message with a flag instead of its key, if that flag gave the value."""
    if error.parts:
        # A flag that sets the same value of several stars is named once.
        return "; ".join(dict.fromkeys(map(name_flag, error.parts)))
    text, key = with_flags(str(error)), error.key or ""
    begin = SUBJECT.match(text)
    if begin is None or begin["key"].replace(" ", "_") not in (key, key.rpartition(".")[2]):
        return text
    # "flare amplitude" is the amplitude of a flare, and the key of a value in a table may have the flag of the table.
    name = re.sub(r"\.\d+(?=\.|$)", "", key)
    names = (name, name.removeprefix("flare_"), name.rpartition(".")[0])
    flags = next(filter(None, map(_flags, filter(None, names))), [])
    is_typed = any(
        word.partition("=")[0] == flag if flag.startswith("--") else word.startswith(flag)
        for word in sys.argv[1:]
        for flag in flags
    )
    return f"{flags[0]} {begin['verb'].removeprefix('= ')}{text[begin.end() :]}" if is_typed else text
