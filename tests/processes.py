"""Python in a separate process, with another environment."""

import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory


def python(
    code: str,
    *words: str | Path,
    typed: str | None = None,
    cache: Path | str | None = None,
    folder: Path | None = None,
    **environment: str,
) -> subprocess.CompletedProcess[str]:
    """Run code, as an argument or typed, which must end without an error; its kernels may have a cache of its own."""
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
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done


def printed(text: str) -> dict[str, str]:
    """Return the lines that a process has printed, by their first words."""
    return dict(line.split(" ", 1) for line in text.splitlines())


#: Process that has imported mauvecl, which takes a second, and has opened no device: it forks for each code.
FORKS = """
import json, os, sys
import mauvecl.device.engine, mauvecl.device.selftest
for line in sys.stdin:
    asked = json.loads(line)
    child = os.fork()
    if child == 0:
        for number, path in enumerate((os.devnull, *asked["files"])):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), number)
        os.environ.clear()
        os.environ.update(asked["environment"])
        exec(compile(asked["code"], "code", "exec"), {"__name__": "__main__"})
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@cache
def forking() -> subprocess.Popen[str]:
    """Start the process that forks, which ends with this one."""
    return subprocess.Popen([sys.executable, "-c", FORKS], text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)


def forked(code: str, *, cache: Path | str, **environment: str) -> str:
    """Run code as `python` does, with mauvecl imported already, and return what it prints."""
    process = forking()
    assert process.stdin is not None
    with TemporaryDirectory() as folder:
        out, reported = files = [Path(folder) / name for name in ("out", "reported")]
        more = environment | {"MAUVECL_CACHE_DIR": str(cache)}
        asked = {"code": code, "environment": dict(os.environ) | more, "files": [str(file) for file in files]}
        print(json.dumps(asked), file=process.stdin, flush=True)
        ended = process.stdout.readline().strip()
        assert ended == "0", reported.read_text()
        assert "Traceback" not in reported.read_text()
        return out.read_text()
