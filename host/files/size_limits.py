"""Reading of user files within size limits: only regular files, with limits of compressed and unpacked size."""

from __future__ import annotations

import bz2
import io
import lzma
import os
import stat
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from mauvecl.schema.errors import InputError
from mauvecl.schema.text import shortened

#: Default limits of file size and unpacked size, MiB; environment variables of these names override them.
LIMITS = {"MAUVECL_LARGEST_FILE_MIB": 256, "MAUVECL_LARGEST_CONTENT_MIB": 512}
#: Bytes unpacked at a time.
PIECE = 1 << 20
#: Memory for unpacking xz, in addition to its output; the highest preset needs 65 MiB.
XZ_MEMORY = 128 << 20


def limit_bytes(variable: str) -> int:
    """Return a limit in bytes, from the environment or `LIMITS`.

    Raises InputError if the environment variable is not an integer number of MiB from 1 to 2**20.
    """
    text = os.environ.get(variable, str(LIMITS[variable]))
    if not (text.isascii() and text.isdigit() and len(text) <= 7 and 1 <= int(text) <= 2**20):
        raise InputError.of(variable, text[:40], "a whole number of MiB from 1 to 1048576")
    return int(text) << 20


#: Largest number of characters of a line of text.
LONGEST_LINE = 2**17


def open_regular(path: Path, what: str) -> io.BufferedReader:
    """Open a regular file for reading.

    Parameters
    ----------
    what : str
        Expected kind of file, for messages: "spectrum file", "study".

    Raises InputError if the file does not exist, is not a regular file, or cannot be opened.
    """
    shown = shortened(str(path))
    try:
        # Non-blocking, because a pipe without a writer would never open.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise InputError(f"{what} {shown} does not exist", "a file", key="file", value=str(path)) from error
    except OSError as error:
        raise InputError(
            f"{what} {shown} cannot be opened ({error.strerror})", "a readable file", key="file", value=str(path)
        ) from error
    except ValueError as error:
        # Null bytes, and characters that file names cannot contain.
        raise InputError(f"{what} {shown} is not a path ({error})", "a file name", key="file", value=path) from error
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        kind = "a folder" if stat.S_ISDIR(mode) else "no regular file"
        raise InputError(f"{what} {shown} is {kind}", "a regular file", key="file", value=str(path))
    return open(descriptor, "rb")


def read_bytes(path: Path, what: str) -> bytes:
    """Read a regular file of limited size, without unpacking it.

    Raises InputError as `open_regular`, or if the file is too large or cannot be read.
    """
    shown = shortened(str(path))
    with open_regular(path, what) as file:
        most = limit_bytes("MAUVECL_LARGEST_FILE_MIB")
        try:
            # The file may have grown since its size was read.
            content = file.read(most + 1) if os.fstat(file.fileno()).st_size <= most else None
        except OSError as error:
            raise InputError(
                f"{what} {shown} cannot be read ({error.strerror})", "a readable file", key="file", value=str(path)
            ) from error
    if content is None or len(content) > most:
        raise InputError(
            f"{what} {shown} has more than {most >> 20} MiB",
            "less; MAUVECL_LARGEST_FILE_MIB sets the limit",
            key="MAUVECL_LARGEST_FILE_MIB",
            value=most >> 20,
        )
    return content


def check_size(path: Path, what: str, most: int | None = None) -> int:
    """Return the size of a regular file in bytes, without reading it.

    Parameters
    ----------
    most : int, optional
        Largest size, bytes; by default MAUVECL_LARGEST_FILE_MIB.

    Raises InputError if the file is larger, or as `open_regular`.
    """
    with open_regular(path, what) as file:
        size = os.fstat(file.fileno()).st_size
    largest = limit_bytes("MAUVECL_LARGEST_FILE_MIB") if most is None else most
    if size > largest:
        remedy = "less; MAUVECL_LARGEST_FILE_MIB sets the limit" if most is None else "less"
        raise InputError(
            f"{what} {shortened(str(path))} has more than {largest >> 20} MiB",
            remedy,
            key="MAUVECL_LARGEST_FILE_MIB" if most is None else "file",
            value=largest >> 20,
        )
    return size


def check_folder(path: Path, what: str, most_json: int = 16 << 20) -> None:
    """Check the files of a folder before another library reads them.

    Raises InputError for anything but regular files and folders, a file above MAUVECL_LARGEST_FILE_MIB, or JSON of more
    than `most_json` bytes.
    """
    for folder, _, names in os.walk(path):
        for name in names:
            file = Path(folder) / name
            check_size(file, what, most_json if name.endswith(".json") else None)


def lines_in(file: IO[str], what: str) -> Iterator[str]:
    """Yield the lines of a text, with their ends.

    Raises InputError for a line of more than `LONGEST_LINE` characters, of which no more is read.
    """
    number = 1
    while line := file.readline(LONGEST_LINE + 2):
        if len(line.rstrip("\r\n")) > LONGEST_LINE:
            raise InputError(
                f"{what} has more than {LONGEST_LINE} characters in line {number}",
                f"at most {LONGEST_LINE}",
                key="file",
                value=number,
            )
        yield line
        number += 1


def packed(start: bytes) -> bool:
    """Return whether content is compressed by gzip, bzip2 or xz, by its first bytes."""
    return start.startswith((b"\x1f\x8b", b"BZh", b"\xfd7zXZ\x00"))


def unpacked(content: bytes, what: str) -> bytes:
    """Unpack content that is compressed by gzip, bzip2 or xz; return other content unchanged.

    Parameters
    ----------
    what : str
        Description of the content for messages, including its name.

    Raises InputError if it unpacks to more than the limit or is damaged.
    """
    if content[:2] == b"\x1f\x8b":
        return _unpack(content, lambda: zlib.decompressobj(wbits=31), "gzip", what)
    if content[:3] == b"BZh":
        return _unpack(content, bz2.BZ2Decompressor, "bzip2", what)
    if content[:6] == b"\xfd7zXZ\x00":
        return _unpack(content, lambda: lzma.LZMADecompressor(memlimit=XZ_MEMORY), "xz", what)
    return content


def _unpack(content: bytes, start: Callable[[], Any], form: str, what: str) -> bytes:
    """Unpack in pieces, to detect decompression bombs early; several streams may follow one another."""
    most = limit_bytes("MAUVECL_LARGEST_CONTENT_MIB")
    pieces: list[bytes] = []
    size = 0
    try:
        while content:
            stream = start()
            waiting = content
            while not stream.eof:
                piece = stream.decompress(waiting, PIECE)
                # zlib returns unused input; the other decompressors keep it.
                waiting = getattr(stream, "unconsumed_tail", b"")
                size += len(piece)
                if size > most:
                    raise InputError(
                        f"{what} unpacks to more than {most >> 20} MiB",
                        "less; MAUVECL_LARGEST_CONTENT_MIB sets the limit",
                        key="MAUVECL_LARGEST_CONTENT_MIB",
                        value=most >> 20,
                    )
                pieces.append(piece)
                if not piece and not waiting and not stream.eof and getattr(stream, "needs_input", True):
                    raise EOFError("it ends too early")
            content = stream.unused_data.lstrip(b"\0")
    except (OSError, EOFError, zlib.error, lzma.LZMAError, MemoryError) as error:
        raise InputError(f"{what} is damaged {form}", "a whole file", key="file", value=str(error)) from error
    return b"".join(pieces)
