"""Runs of the command line, in this process or in a separate one."""

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path
from unittest import mock

from processes import python

from mauvecl.cli import app

#: The command line with small shards, so that a run of a second has several; shards change no answer.
SMALL_SHARDS = [
    sys.executable,
    "-c",
    "import runpy; import mauvecl.runs.checkpoint as s; s.SHARD_WORK = 2**27; "
    "s.Checkpoint.__init__.__kwdefaults__['patience_s'] = 0.0; runpy.run_module('mauvecl', run_name='__main__')",
]


Done = subprocess.CompletedProcess[str]


def run(*words: str | Path, folder: Path, code: int = 0, columns: int = 200) -> Done:
    """Run a command in this process, which is faster than `started`, in a terminal of some width."""
    found, out, reported = ended(*words, folder=folder, columns=columns)
    assert found == code, out + reported
    return Done(words, code, out, reported)


def ended(*words: str | Path, folder: Path, columns: int = 200) -> tuple[int, str, str]:
    """Run a command in this process; return exit code, standard output and standard error."""
    out, reported = io.StringIO(), io.StringIO()
    code = 0
    with (
        contextlib.chdir(folder),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(reported),
        mock.patch.object(sys, "argv", ["mauvecl", *map(str, words)]),
        mock.patch.dict(os.environ, {"COLUMNS": str(columns)}),
    ):
        try:
            app.main()
        except SystemExit as end:
            code = end.code or 0
    return code, out.getvalue(), reported.getvalue()


def started(*words: str | Path, folder: Path, code: int = 0, **environment: str) -> Done:
    """Run a command in another process, as from a shell."""
    module = "import runpy; runpy.run_module('mauvecl', run_name='__main__')"
    return python(module, *words, folder=folder, ends=code, **{"COLUMNS": "200"} | environment)
