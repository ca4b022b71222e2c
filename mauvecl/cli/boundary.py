"""Conversion of failures to one sentence and an exit code, never a bare traceback."""

from __future__ import annotations

import contextlib
import datetime
import errno
import os
import platform
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import typer

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
#: Largest number of characters of a message.
LONGEST = 1000
#: Error numbers of full disks and quotas, which name no file.
DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE)

#: Libraries that write to standard output for mauvecl.
PRINTERS = ("click", "typer", "rich", "mauvecl.cli")
#: Output folder of the verb, once known, to which tracebacks are written.
_folder: Path | None = None


def writes_to(folder: Path) -> None:
    """Set the folder into which an unforeseen failure writes its traceback."""
    global _folder
    _folder = folder


def guarded(app: typer.Typer) -> int:
    """Run the command line.

    Returns
    -------
    int
        The exit code.
    """
    global _folder
    _folder = None
    _print_anything()
    out = sys.stdout
    with warnings.catch_warnings():
        warnings.showwarning = _warn
        try:
            code = _run(app)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else BAD_INPUT if end.code else 0
            if isinstance(end.__context__, BrokenPipeError):
                # Click and rich end in different ways if the reader of standard output is gone.
                sys.stdout, code = out, READER_GONE
    return _flushed(code)


def _run(app: typer.Typer) -> int:
    # Click's own classes are private to newer versions of typer.
    from mauvecl.schema.errors import InputError

    try:
        code = app(standalone_mode=False)
    except InputError as error:
        from mauvecl.cli.naming import name_flag

        return _say(name_flag(error), BAD_INPUT)
    except MemoryError:
        return _say("the memory does not suffice for this question, expected a smaller one or more of it", BAD_INPUT)
    except OSError as error:
        return _failed_call(error)
    except Exception as error:
        return _failed(error)
    if code == INTERRUPTED:
        return _say("interrupted", INTERRUPTED)
    return code if isinstance(code, int) else 0


def _failed(error: Exception) -> int:
    """Report a wrong use of flags, a device that fails, or an unforeseen failure."""
    if hasattr(error, "format_message") and isinstance(getattr(error, "exit_code", None), int):
        # A usage error of Click, or the help text of an empty command line, which Click prints itself.
        text = str(error.format_message())
        return _say(text.splitlines()[0] if text else "", BAD_INPUT) if text.strip() else BAD_INPUT
    if type(error).__name__ == "Abort":
        return _say("interrupted", INTERRUPTED)
    # Imported here, because verbs that draw nothing do not need it.
    program = sys.modules.get("mauvecl.device.program")
    if program is not None and isinstance(error, program.DeviceError):
        return _say(str(error), BAD_INPUT, whole=isinstance(error, program.BuildError))
    where = _write_traceback(error)
    what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return _say(
        f"something unforeseen happened, a fault of mauvecl ({what[:200]}); its traceback is in {str(where)!r}, and "
        "what was written before is kept",
        UNFORESEEN,
    )


def _failed_call(error: OSError) -> int:
    """Report an error of the operating system: standard output, or a file that the user named."""
    code = _flushed(0)
    if code:
        return code
    if error.filename is None and _raised_by(error).startswith(PRINTERS):
        # Click writes through its own stream.
        _discard()
        return _not_written(error)
    if error.filename is None and error.errno not in DISK:
        return _failed(error)
    name = (
        "a file"
        if error.filename is None
        else repr(os.fsdecode(error.filename) if not isinstance(error.filename, int) else error.filename)
    )
    return _say(
        f"{name if len(name) < 200 else name[:100] + '...' + name[-60:]} cannot be used ({error.strerror or error}), "
        "expected a place that can; what was written before is kept",
        BAD_INPUT,
    )


def _say(text: str, code: int, *, whole: bool = False) -> int:
    """Print one sentence on standard error; `whole` keeps the lines of a compiler's log."""
    if not whole:
        if len(text) > LONGEST:
            text = f"{text[: LONGEST - 203]}...{text[-200:]}"
        text = "".join(c if c.isprintable() else " " if c in "\n\t" else repr(c)[1:-1] for c in text)
    with contextlib.suppress(OSError, ValueError):
        print(f"mauvecl: {text}", file=sys.stderr, flush=True)
    return code


def _warn(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    """Print a warning of a library on one line."""
    _say(f"note: {message} ({category.__name__})", 0)


def _print_anything() -> None:
    """Write characters that the terminal's encoding lacks as escapes, since names may contain any character."""
    for stream in (sys.stdout, sys.stderr):
        change: Callable[..., None] | None = getattr(stream, "reconfigure", None)
        if change is not None:
            change(errors="backslashreplace")


def _flushed(code: int) -> int:
    """Flush standard output; return the exit code, or that of a failure to write."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        _discard()
        if isinstance(error, BrokenPipeError):
            return READER_GONE
        return _not_written(error)
    except ValueError:
        # Already closed.
        pass
    return code


def _not_written(error: OSError) -> int:
    return _say(
        f"standard output cannot be written ({error.strerror}), expected one with room; files are kept", OUTPUT_FULL
    )


def _raised_by(error: BaseException) -> str:
    """Return the name of the module that raised an exception."""
    step = error.__traceback__
    while step is not None and step.tb_next is not None:
        step = step.tb_next
    return "" if step is None else str(step.tb_frame.f_globals.get("__name__", ""))


def _discard() -> None:
    """Discard the buffer of standard output, on which Python would fail again at exit."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _write_traceback(error: Exception) -> Path | str:
    """Write the traceback to a file in the output folder, or else in the folder of temporary files."""
    from mauvecl.host.version import VERSION

    now = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%S")
    text = "\n".join(
        [
            f"mauvecl {VERSION}, Python {platform.python_version()}, {platform.platform()}",
            f"command: {sys.argv!r}"[:20_000],
            "".join(traceback.format_exception(error, limit=-60)),
        ]
    )
    for folder in (_folder, Path(tempfile.gettempdir())):
        if folder is None:
            continue
        with contextlib.suppress(OSError):
            # A random name, which nobody can have created before.
            handle, name = tempfile.mkstemp(prefix=f"mauvecl-fault-{now}-", suffix=".txt", dir=folder)
            with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
                file.write(text)
            return Path(name)
    return "no file, since none can be written"
