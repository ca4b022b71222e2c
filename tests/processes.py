"""Python in a separate process, with another environment, and work in a thread."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any


def python(
    code: str,
    *words: str | Path,
    typed: str | None = None,
    cache: Path | str | None = None,
    folder: Path | None = None,
    ends: int = 0,
    **environment: str,
) -> subprocess.CompletedProcess[str]:
    """Run code, as an argument or typed, which must end with an exit code; its kernels may have a cache of its own."""
    more = environment | ({} if cache is None else {"MAUVECL_CACHE_DIR": str(cache)})
    done = subprocess.run(
        [sys.executable, *(["-c", code] if typed is None else []), *map(str, words)],
        input=typed,
        env=os.environ | more,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == ends, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


def printed(text: str) -> dict[str, str]:
    """Return the lines that a process has printed, by their first words."""
    return dict(line.split(" ", 1) for line in text.splitlines())


def in_background(work: Callable[[], Any]) -> Future[Any]:
    """Do work in a daemon thread: one that waits for ever fails a test instead of holding it."""
    found: Future[Any] = Future()

    def end() -> None:
        try:
            found.set_result(work())
        except BaseException as error:
            found.set_exception(error)

    threading.Thread(target=end, daemon=True).start()
    return found
