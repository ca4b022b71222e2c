"""Reader of visitors' spectra in a child process with limits, which protects the server."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from mauvecl.host.stars.flare_spectra import ObservedFlare
from mauvecl.host.stars.source import Source
from mauvecl.schema.errors import InputError

#: Memory of the reading process, MiB: Python with astropy and synphot maps some 400, a spectrum of 4 MiB as text 300.
MEMORY_MIB = 1536
#: Seconds that it may take, by the clock and of a processor.
SECONDS = 20
#: Content that a file of a visitor's may unpack to, MiB.
CONTENT_MIB = 64
#: Readers at the same time; other visitors wait for their turn, but no longer than `SECONDS`.
TOGETHER = 2
#: Exit codes of the reading process.
_REFUSED, _NO_ROOM = 2, 3
#: What files are read as, with the attributes other than its arrays.
KINDS: dict[type[Source | ObservedFlare], tuple[str, ...]] = {
    Source: ("name", "origin", "notes", "messages", "measured_nm", "unscaled"),
    ObservedFlare: ("name", "messages", "measured_nm"),
}
Spectrum = TypeVar("Spectrum", Source, ObservedFlare)
_turns = threading.BoundedSemaphore(TOGETHER)


def read_limited(content: bytes, kind: type[Spectrum], options: Mapping[str, Any] | None = None) -> Spectrum:
    """Read a spectrum from the bytes of a file, like its `read`, in a process with limited memory and time.

    Blocks for about a second, most of it for the start of Python: call it from a thread.

    Parameters
    ----------
    content : bytes
        What it is shows in itself: a name says nothing.
    kind : type
        `Source` or `ObservedFlare`.
    options : mapping, optional
        Further arguments of its `read`.

    Raises
    ------
    InputError
        If it holds no usable spectrum, or reading it takes more memory or time than allowed.
    """
    if not _turns.acquire(timeout=SECONDS):
        raise InputError("too many uploads are read at the same time", "yours again in a minute", key="upload")
    try:
        answer = _read_apart(content, kind.__name__, dict(options or {}))
    finally:
        _turns.release()
    with np.load(io.BytesIO(answer), allow_pickle=False) as read:
        words = json.loads(str(read["words"]))
        # JSON has no tuples.
        plain: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in words.items()
        }
        return kind(read["wavelength"], read["flux"], **plain)


def _read_apart(content: bytes, kind: str, options: dict[str, Any]) -> bytes:
    """Run the reading process and return its output."""
    environment = os.environ | {
        # One thread of a numerical library needs no stacks of many.
        **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
        "MAUVECL_LARGEST_CONTENT_MIB": str(CONTENT_MIB),
        "PYTHONIOENCODING": "utf-8",
        "PYTHONPATH": os.pathsep.join(filter(None, (_here(), os.environ.get("PYTHONPATH")))),
    }
    # A fresh interpreter, as spawn makes one: OpenCL does not survive a fork.
    command = [
        sys.executable,
        "-m",
        "mauvecl.web.sandboxed_reader",
        str(MEMORY_MIB),
        str(SECONDS),
        kind,
        json.dumps(options),
    ]
    with tempfile.TemporaryDirectory(prefix="mauvecl-upload-") as folder:
        try:
            done = subprocess.run(
                command, input=content, capture_output=True, timeout=SECONDS, cwd=folder, env=environment, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise InputError(
                f"the upload takes more than {SECONDS} s to read", "a spectrum of some thousand points", key="upload"
            ) from error
        except OSError as error:
            raise InputError(
                f"the upload cannot be read now ({error.strerror})",
                "it again later",
                key="upload",
                value=error.strerror,
            ) from error
    if done.returncode == 0:
        return done.stdout
    if done.returncode == _REFUSED:
        # The reader prints its error as a sentence.
        fault, _, expected = done.stderr.decode("utf-8", "replace").strip().partition(", expected ")
        raise InputError(fault, expected or None, key="upload")
    if done.returncode == _NO_ROOM:
        raise InputError(
            f"the upload takes more than {MEMORY_MIB} MiB of memory to read",
            "a spectrum of some thousand points",
            key="upload",
        )
    raise InputError("the upload ends its reader", "a spectrum as text, ECSV, VOTable or FITS", key="upload")


def _here() -> str:
    """Return the folder of the package, since the reading process starts in another one."""
    return str(Path(__file__).parents[2])


def _limit(memory_mib: int, seconds: int) -> None:
    """Limit memory, time and files of this process permanently."""
    import resource

    for kind, value in (
        (resource.RLIMIT_AS, memory_mib << 20),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_FSIZE, 64 << 20),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NPROC, 0),
    ):
        _, hard = resource.getrlimit(kind)
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(kind, (value, value))


def _main() -> int:
    """Run the reading process: file on standard input, arrays on standard output, errors on standard error."""
    memory_mib, seconds, asked, options = sys.argv[1:]
    _limit(int(memory_mib), int(seconds))
    try:
        file = Path("upload")
        file.write_bytes(sys.stdin.buffer.read())
        (kind,) = (one for one in KINDS if one.__name__ == asked)
        source = kind.read(file, **json.loads(options))
        out = io.BytesIO()
        np.savez(
            out,
            wavelength=source.wavelength_nm,
            flux=source.flux_flam,
            words=np.array(json.dumps({key: getattr(source, key) for key in KINDS[kind]})),
        )
    except InputError as error:
        print(error, file=sys.stderr)
        return _REFUSED
    except MemoryError:
        return _NO_ROOM
    sys.stdout.buffer.write(out.getvalue())
    return 0


if __name__ == "__main__":
    sys.exit(_main())
