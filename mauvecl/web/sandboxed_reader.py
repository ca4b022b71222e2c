"""Reader of visitors' files in a child process with limits, which protects the server."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, TypeVar

import numpy as np

from mauvecl.schema.errors import InputError

#: Memory of the reading process, MiB: Python with astropy and synphot maps some 400, a spectrum of 4 MiB as text 300.
MEMORY_MIB = 1536
SECONDS = 20  # longest duration of reading, by the clock and of processor time
CONTENT_MIB = 64  # largest size to which a visitor's file may unpack
TOGETHER = 2  # number of readers at the same time; other visitors wait for at most `SECONDS`
_REFUSED, _NO_ROOM = 2, 3  # exit codes of the reading process
T = TypeVar("T")
#: Expected content of an upload if it is too large, and in general: a spectrum, or frames.
EXPECTED_SPECTRUM = "a spectrum of some thousand points", "a spectrum as text, ECSV, VOTable or FITS"
EXPECTED_FRAMES = "fewer frames", "frames as FITS, ECSV or CSV"
_turns = threading.BoundedSemaphore(TOGETHER)


def read_limited(
    kind: Callable[..., T],
    reader: Callable[..., T],
    files: Mapping[str, bytes],
    *,
    expected: tuple[str, str] = EXPECTED_SPECTRUM,
    **options: Any,
) -> T:
    """Read the first of some files, by their names, in a process with limited memory and time.

    The reader, a function of a path and of options, may need the other files; it returns a dataclass of this kind.
    Errors say what is `expected`: of a file that is too large, and in general.
    Blocks for about a second, most of it for the start of Python: call it from a thread.
    """
    if not _turns.acquire(timeout=SECONDS):
        raise InputError("too many uploads are read at the same time: try again in a minute", key="upload")
    try:
        answer = _read_apart(reader, files, options, expected)
    finally:
        _turns.release()
    with np.load(io.BytesIO(answer), allow_pickle=False) as arrays:
        words = json.loads(str(arrays["words"]))
        values = {name: tuple(value) if isinstance(value, list) else value for name, value in words.items()}
        return kind(**values, **{name: arrays[name] for name in arrays.files if name != "words"})


def _read_apart(
    reader: Callable[..., Any], files: Mapping[str, bytes], options: dict[str, Any], expected: tuple[str, str]
) -> bytes:
    """Run the reading process and return its output."""
    smaller, content = expected
    environment = os.environ | {
        # One thread of a numerical library needs no stacks of many.
        **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
        "MAUVECL_LARGEST_CONTENT_MIB": str(CONTENT_MIB),
        "PYTHONIOENCODING": "utf-8",
        # The reading process starts in another folder than that of the package.
        "PYTHONPATH": os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")))),
    }
    name = f"{reader.__module__}:{reader.__qualname__}"
    words = json.dumps({"reader": name, "file": next(iter(files)), "options": options})
    # A fresh interpreter, as spawn makes one: OpenCL does not survive a fork.
    command = [sys.executable, "-m", __name__, str(MEMORY_MIB), str(SECONDS), words]
    with tempfile.TemporaryDirectory(prefix="mauvecl-upload-") as folder:
        for file, contained in files.items():
            (Path(folder) / file).write_bytes(contained)
        try:
            process = subprocess.run(command, capture_output=True, timeout=SECONDS, cwd=folder, env=environment)
        except subprocess.TimeoutExpired as error:
            raise InputError(f"the upload takes more than {SECONDS} s to read; give {smaller}", key="upload") from error
        except OSError as error:
            fault = f"the upload cannot be read now ({error.strerror}): try again later"
            raise InputError(fault, key="upload") from error
    if process.returncode == 0:
        return process.stdout
    reasons = {
        # The reader prints its error as a sentence.
        _REFUSED: process.stderr.decode("utf-8", "replace").strip(),
        _NO_ROOM: f"the upload takes more than {MEMORY_MIB} MiB of memory to read; give {smaller}",
    }
    raise InputError(reasons.get(process.returncode, f"the upload ended its reader; give {content}"), key="upload")


def _main() -> int:
    """Run the reading process: files in its folder, arrays on standard output, errors on standard error."""
    import resource

    memory_mib, seconds, words = sys.argv[1:]
    request = json.loads(words)
    # Memory, time and files are limited permanently.
    limits = {"AS": int(memory_mib) << 20, "CPU": int(seconds), "FSIZE": 64 << 20, "CORE": 0, "NPROC": 0}
    for name, value in limits.items():
        # A lower limit of the server's holds as well.
        with contextlib.suppress(ValueError):
            resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (value, value))
    try:
        content = resolve_name(request["reader"])(Path(request["file"]), **request["options"])
        values = {field.name: getattr(content, field.name) for field in fields(content)}
        arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
        words = json.dumps({name: value for name, value in values.items() if name not in arrays})
        out = io.BytesIO()
        np.savez(out, words=np.array(words), **arrays)  # type: ignore[arg-type]
    except InputError as error:
        print(error, file=sys.stderr)
        return _REFUSED
    except MemoryError:
        return _NO_ROOM
    sys.stdout.buffer.write(out.getvalue())
    return 0


if __name__ == "__main__":
    sys.exit(_main())
