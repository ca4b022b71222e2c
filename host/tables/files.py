"""Files: regular and of bounded size, written whole, and read as text, TOML, JSON or ECSV with errors in one style."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import io
import json
import lzma
import math
import os
import re
import secrets
import stat
import tomllib
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from mauvecl.schema.errors import InputError, printable, shortened

if TYPE_CHECKING:
    import numpy as np
    from astropy.table import Table
    from numpy.typing import NDArray

#: Prefix of files that are being written, and advice for a full or read-only disk.
UNFINISHED, NO_ROOM = ".unfinished-", "use a writable disk with room; what was written before is kept"


@contextlib.contextmanager
def writing(label: str, remedy: str, *, key: str) -> Iterator[None]:
    """Convert failures of the operating system in the block to an InputError: what `label` names cannot be written."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{label} cannot be written ({error.strerror or error}); {remedy}", key=key) from error


def write_whole(path: Path, *parts: bytes | memoryview, shared: bool = False) -> None:
    """Write the parts of a file atomically: under a temporary name, flushed to the disk, then renamed.

    Other processes may write a `shared` file at the same time; the last one wins. Raises InputError if the file cannot
    be written; an existing file is then kept.
    """
    tail = f".{os.getpid()}-{secrets.token_hex(4)}" if shared else ""
    unfinished = path.with_name(f"{UNFINISHED}{path.name}{tail}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished.open("wb", buffering=0) as file:
            for part in parts:
                unwritten = memoryview(part).cast("B")
                while unwritten:
                    unwritten = unwritten[file.write(unwritten) :]
            os.fsync(file.fileno())
        unfinished.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            unfinished.unlink(missing_ok=True)
        with writing(repr(str(path)), NO_ROOM, key="file"):
            raise


def json_text(content: Any) -> str:
    """Return plain data as JSON text, with null for NaN and infinity."""
    return json.dumps(_finite(content), indent=2, default=str, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    return [_finite(item) for item in value] if isinstance(value, list | tuple) else value


#: Default limits of file size and unpacked size, MiB; environment variables of these names override them.
LIMITS = {"MAUVECL_LARGEST_FILE_MIB": 256, "MAUVECL_LARGEST_CONTENT_MIB": 512}
#: Bytes unpacked at a time.
PIECE = 1 << 20


def limit_bytes(variable: str) -> int:
    """Return a limit in bytes, from the environment or `LIMITS`."""
    text = os.environ.get(variable, str(LIMITS[variable]))
    if not (text.isascii() and text.isdigit() and len(text) <= 7 and 1 <= int(text) <= 2**20):
        raise InputError.of(variable, text[:40], "a whole number of MiB from 1 to 1048576")
    return int(text) << 20


def check_content(n_bytes: int, sentence: str) -> None:
    """Raise InputError with a sentence, which ends with the limit, above MAUVECL_LARGEST_CONTENT_MIB of content."""
    limit = "MAUVECL_LARGEST_CONTENT_MIB"
    if n_bytes > (most := limit_bytes(limit)):
        raise InputError(f"{sentence} {most >> 20} MiB; {limit} sets the limit", key=limit)


#: Largest numbers of characters of a line of text and of bytes of a store's JSON.
MAX_LINE, MAX_JSON_BYTES = 2**17, 16 << 20


def open_regular(path: Path, kind: str) -> io.BufferedReader:
    """Open a regular file for reading; messages name its kind, such as "spectrum file" or "study"."""
    shown = shortened(str(path))
    try:
        # Non-blocking, because a pipe without a writer would never open.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError as error:
        raise InputError(f"{kind} {shown} does not exist; give the path of a file", key="file") from error
    except (OSError, ValueError) as error:
        # Null bytes, and characters that file names cannot contain, raise ValueError.
        fault = f"{kind} {shown} cannot be opened ({getattr(error, 'strerror', error)})"
        raise InputError(f"{fault}; give the path of a file", key="file") from error
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        folder = ", not a folder" if stat.S_ISDIR(mode) else ""
        raise InputError(f"{kind} {shown} must be a regular file{folder}", key="file")
    return open(descriptor, "rb")


def read_bytes(path: Path, kind: str) -> bytes:
    """Read a regular file of limited size, without unpacking it."""
    with open_regular(path, kind) as file:
        _check_n_bytes(os.fstat(file.fileno()).st_size, path, kind)
        try:
            content = file.read(limit_bytes("MAUVECL_LARGEST_FILE_MIB") + 1)
        except OSError as error:
            shown = shortened(str(path))
            raise InputError(f"{kind} {shown} must be readable, but is not ({error.strerror})", key="file") from error
    # The file may have grown since its size was read, or the system states no size, as below /proc.
    _check_n_bytes(len(content), path, kind)
    return content


def check_size(path: Path, kind: str, most: int | None = None) -> int:
    """Return the size of a regular file; raise InputError above `most` bytes (by default MAUVECL_LARGEST_FILE_MIB)."""
    with open_regular(path, kind) as file:
        return _check_n_bytes(os.fstat(file.fileno()).st_size, path, kind, most)


def _check_n_bytes(n_bytes: int, path: Path, kind: str, most: int | None = None) -> int:
    """Return the size of a file in bytes; raise InputError as `check_size` if it is too large."""
    limit = "MAUVECL_LARGEST_FILE_MIB"
    largest = limit_bytes(limit) if most is None else most
    if n_bytes > largest:
        fault = f"{kind} {shortened(str(path))} must have at most {largest >> 20} MiB"
        raise InputError(fault if most else f"{fault}; {limit} sets the limit", key="file" if most else limit)
    return n_bytes


def check_folder(path: Path, kind: str) -> None:
    """Raise InputError for files that other libraries should not read: devices, large files, JSON above its limit."""
    for folder, _, names in os.walk(path):
        for name in names:
            file = Path(folder) / name
            check_size(file, kind, MAX_JSON_BYTES if name.endswith(".json") else None)


def lines_in(file: IO[str], label: str) -> Iterator[str]:
    """Yield the lines of a text in UTF-8, with their ends; reading stops at a line longer than `MAX_LINE`."""
    try:
        for number, line in enumerate(iter(lambda: file.readline(MAX_LINE + 2), ""), 1):
            if len(line.rstrip("\r\n")) > MAX_LINE:
                raise InputError(f"{label} must have at most {MAX_LINE} characters in line {number}", key="file")
            yield line
    except UnicodeDecodeError as error:
        raise InputError(f"{label} must be text in UTF-8", key="file") from error


#: Names of compressions and functions that open their files, by the first bytes of these.
PACKED: dict[bytes, tuple[str, Callable[[Any], Any]]] = {
    b"\x1f\x8b": ("gzip", gzip.open), b"BZh": ("bzip2", bz2.open), b"\xfd7zXZ\x00": ("xz", lzma.open),
}  # fmt: skip


def unpacked(content: bytes, label: str) -> bytes:
    """Unpack content of gzip, bzip2 or xz, in pieces to detect decompression bombs; return other content unchanged."""
    form, opener = next((packing for mark, packing in PACKED.items() if content.startswith(mark)), ("", None))
    if opener is None:
        return content
    plain = bytearray()
    try:
        with opener(io.BytesIO(content)) as file:
            while piece := file.read(PIECE):
                plain += piece
                check_content(len(plain), f"{label} must unpack to at most")
    except (OSError, EOFError, zlib.error, lzma.LZMAError, MemoryError) as error:
        raise InputError(f"{label} is damaged {form}; give a whole file", key="file") from error
    return bytes(plain)


#: Range of absolute values of numbers from users, apart from 0; products of several stay within double precision.
SMALLEST, LARGEST = 1e-30, 1e30
#: Largest energy in erg, since flares reach 1e38, and the ending of keys of energies.
ERG, LARGEST_ERG = "_erg", 1e45
#: Other keys of energies.
ENERGIES = ("injections.low", "injections.high")
#: Range of integers of 64 bits, signed or unsigned.
INTEGERS = (-(2**63), 2**64 - 1)
#: Longest text and deepest nesting of a study or an instrument.
MAX_TEXT, MAX_DEPTH = 4096, 32
#: Place in a file, in messages of parsers.
PLACE = re.compile(r"\b(?:line|row|column) \d{1,9}(?:,? (?:line|row|column) \d{1,9})*")
#: Largest number of parts of a dotted TOML key.
MAX_PARTS = 512


@contextlib.contextmanager
def parsing(label: str, remedy: str) -> Iterator[None]:
    """Convert any exception of a parser of foreign content, such as an OverflowError, to InputError."""
    try:
        yield
    except InputError:
        raise
    except RecursionError as error:
        raise InputError(f"{label} must be nested less deeply", key="file") from error
    except MemoryError as error:
        raise InputError(f"{label} needs more memory than is available", key="file") from error
    except Exception as error:
        # Other libraries' messages are for their programmers, but may state the place.
        place = PLACE.search(str(error))
        raise InputError(f"{label} cannot be read{f' ({place[0]})' if place else ''}; {remedy}", key="file") from error


@contextlib.contextmanager
def reading(label: str, remedy: str) -> Iterator[None]:
    """Convert any exception of a reader of astropy to InputError, and silence its warnings."""
    with parsing(label, remedy), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def read_text(path: Path, kind: str) -> str:
    """Read a regular file of limited size as UTF-8 text, with or without a byte-order mark."""
    return as_text(read_bytes(path, kind), f"{kind} {shortened(str(path))}")


def as_text(content: bytes, label: str) -> str:
    """Decode text in UTF-8 or UTF-16, with or without the byte-order mark of editors on Windows."""
    try:
        text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError as error:
        if b"\0" in content[:4096]:
            raise InputError(f"{label} must be text, but holds null bytes", key="file") from error
        line, odd = content[: error.start].count(b"\n") + 1, content[error.start]
        fault = f"{label} must be text in UTF-8, but its byte 0x{odd:02x} in line {line} is not: save it as UTF-8"
        raise InputError(fault, key="file") from error
    if "\0" in text:
        raise InputError(f"{label} must be text, but holds null bytes", key="file")
    return text


def is_file(path: Path) -> bool:
    """Return whether a path exists and is not a folder; False for impossible paths."""
    return os.path.exists(path) and not os.path.isdir(path)


def toml(text: str, label: str) -> dict[str, Any]:
    """Parse TOML; raise InputError if it is invalid, or as `check_keys` and `possible`."""
    check_keys(text, label)
    with parsing(label, "give TOML"):
        try:
            tree = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"{label} must be valid TOML: {printable(str(error), 160)}", key="file") from error
    possible(tree, label)
    return tree


def check_keys(text: str, label: str) -> None:
    """Raise InputError for TOML with a key of too many parts."""
    parts = 1 + max(part.count(".") for part in re.split(r"[=,{}\[\]\n#]", text))
    if parts > MAX_PARTS:
        # The memory of Python's parser grows with the square of this number.
        raise InputError(f"{label} has a key of {parts} parts, but may have at most {MAX_PARTS}", key="file")


def possible(data: Any, label: str, key: str = "", depth: int = 0) -> None:
    """Raise InputError for values that are impossible in any study or instrument; `key` is that of nested data."""
    is_energy = key in ENERGIES or any(part.endswith(ERG) for part in key.split("."))
    fault = _fault(data, LARGEST_ERG if is_energy else LARGEST)
    if depth > MAX_DEPTH:
        fault = f"must be nested at most {MAX_DEPTH} deep"
    if fault:
        named = printable(key, 80)
        raise InputError(f"{label}: {named or 'the value'} {fault}", key=named or None)
    if isinstance(data, Mapping):
        for name, item in data.items():
            if isinstance(name, str) and (bad := _fault(name)):
                raise InputError(f"{label}: a key {bad}", key=printable(name, 80))
            possible(item, label, f"{key}.{name}" if key else str(name), depth + 1)
    elif isinstance(data, list | tuple):
        for i, item in enumerate(data):
            possible(item, label, f"{key}.{i}", depth + 1)


def _fault(value: Any, largest: float = LARGEST) -> str | None:
    """Return the fault of a value, as the end of a sentence about it, or None if the value is possible."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int):
        if not INTEGERS[0] <= value <= INTEGERS[1]:
            return f"is a whole number of {value.bit_length()} bits, but may have at most 64"
    elif isinstance(value, float):
        # NaN and infinity are checked where the meaning of the value is known.
        if math.isfinite(value) and value and not SMALLEST <= abs(value) <= largest:
            return f"must be 0 or a size from {SMALLEST:g} to {largest:g}, not {value!r}"
    elif isinstance(value, str | Path):
        text = str(value)
        if len(text) > MAX_TEXT:
            return f"is a text of {len(text)} characters, but may have at most {MAX_TEXT}"
        if not text.isprintable() and (bad := next((c for c in text if c == "\0" or "\ud800" <= c <= "\udfff"), None)):
            return f"= {shortened(text)} must not hold the character {bad!r}"
    return None


def without_columns(path: str | Path) -> tuple[Path, tuple[str, ...]]:
    """Divide ``grid.fits[g45]``, unless it is a file, into the file and the words in brackets, which select a part."""
    text = str(path)
    match = re.fullmatch(r"(?s)(.+?)\[([^\[\]]*)\]", text)
    if match is None or os.path.isfile(text):
        return Path(text), ()
    return Path(match[1]), tuple(word.strip() for word in match[2].split(",") if word.strip())


#: Largest number of values of a header with expanded aliases; a few KiB of aliases can expand to 1e9 values.
MAX_VALUES = 100_000
#: Largest number of characters of a header; YAML in pure Python takes half a minute for a megabyte.
MAX_HEADER = 256 * 2**10
#: A cell in quotes, and a quote that begins one; others are units, as in ``-3°00'00"``.
_QUOTED, _OPEN = re.compile(r'(?:^|(?<=[,;|\t ]))"(?:[^"]|"")*"(?=[,;|\t ]|$)'), re.compile(r'(?:^|[,;|\t ])"')


def read_ecsv(path: str | Path, kind: str, remedy: str = "give an ECSV table") -> Table:
    """Read an ECSV file; the message on one that cannot be parsed ends with the remedy."""
    return parse_ecsv(*text_and_label(path, kind), remedy)


def parse_ecsv(text: str, label: str, remedy: str = "give an ECSV table") -> Table:
    """Parse ECSV text, as `read_ecsv`; messages name it by its label."""
    from astropy.table import Table

    from mauvecl.host.tables.units import with_mission_formats

    lines = text.splitlines()
    check_header(lines, label)
    check_cells([line for line in lines if not line.startswith("#")], label)
    # Tables of lightkurve have times in the days of the missions.
    with_mission_formats()
    with reading(label, remedy):
        # Passed as lines, because astropy takes a text of one line for a file name.
        return Table.read([*lines, ""], format="ascii.ecsv")


@dataclass(frozen=True, eq=False)
class Numbers:
    """Table of numbers."""

    columns: dict[str, NDArray[np.float64]]  # shape (n,) each
    units: dict[str, str]  # units of the columns; empty for a column without one
    meta: dict[str, Any]

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        return self.columns[name]


def text_and_label(path: str | Path, kind: str) -> tuple[str, str]:
    """Read the text of a file, which may be compressed, and return it with the file's label for messages."""
    label = f"{kind} {shortened(str(path))}"
    return as_text(unpacked(read_bytes(Path(path), kind), label), label), label


def parse_numbers(text: str, label: str) -> Numbers:
    """Parse an ECSV table of numbers; raise InputError if values are missing or not numeric, or as `read_ecsv`."""
    import numpy as np
    import yaml  # comes with astropy

    lines = text.splitlines()
    check_header(lines, label)
    header, rows = [line[2:] for line in lines if line[:1] == "#"], [line for line in lines if line[:1] != "#"]
    # Numbers that single blanks separate need no import of astropy's tables.
    with contextlib.suppress(yaml.YAMLError, LookupError, TypeError, ValueError, AttributeError):
        keys = yaml.load("\n".join(header[1:]), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
        fields = keys["datatype"]
        types = {field["name"]: field["datatype"] for field in fields if "subtype" not in field}
        is_numeric = len(types) == len(fields) and all(kind[:3] in ("flo", "int", "uin") for kind in types.values())
        if is_numeric and "delimiter" not in keys and rows[0].split(" ") == [*types]:
            values = np.array([row.split(" ") for row in rows[1:] if row], np.float64).reshape(-1, len(types))
            units = {field["name"]: str(field.get("unit", "")) for field in fields}
            return Numbers(dict(zip(types, values.T.copy(), strict=True)), units, dict(keys.get("meta") or {}))
    table = parse_ecsv(text, label)
    for name in table.colnames:
        if table[name].dtype.kind not in "iuf" or np.ma.is_masked(table[name]) or table[name].ndim != 1:
            raise InputError(f"{label}: {name} must hold numbers only, but has missing or other values", key=name)
    columns = {name: np.asarray(table[name], np.float64) for name in table.colnames}
    return Numbers(columns, {name: str(table[name].unit or "") for name in table.colnames}, dict(table.meta))


def check_header(lines: list[str], label: str) -> None:
    """Raise InputError if a header is longer than `MAX_HEADER` or its aliases expand to more than `MAX_VALUES`."""
    import yaml  # comes with astropy

    header = [line[2:] for line in lines if line.startswith("# ")]
    size = sum(map(len, header))
    if size > MAX_HEADER:
        raise InputError(f"{label} must have a header of at most {MAX_HEADER} characters, not {size}", key="file")
    if not any("*" in line for line in header):
        return
    with parsing(label, "give an ECSV table"):
        root = yaml.compose("\n".join(header[1:]), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    # An alias repeats a node, also one that contains itself.
    count, waiting = 0, [root]
    while waiting:
        inner = getattr(waiting.pop(), "value", None)
        for item in inner if isinstance(inner, list) else ():
            waiting += item if isinstance(item, tuple) else (item,)
        count += 1
        if count + len(waiting) >= MAX_VALUES:
            raise InputError(f"{label} must have a header that expands to fewer than {MAX_VALUES} values", key="file")


def check_cells(lines: list[str], label: str) -> None:
    """Raise InputError for cells that extend over lines, for long lines, and for more content than may be read.

    Arrays of texts give each line the width of the longest, so one wide line of many takes a large memory.
    """
    widest = max(map(len, lines), default=0)
    shape = f"{len(lines)} lines, of which the longest has {widest} characters"
    check_content(widest * len(lines), f"{label} has {shape}; if all were as long, they must have at most")
    if widest > MAX_LINE:
        raise InputError(f"{label} has a line of {widest} characters, but may have at most {MAX_LINE}", key="file")
    odd = next((n for n, line in enumerate(lines, 1) if '"' in line and _OPEN.search(_QUOTED.sub("", line))), None)
    if odd is not None:
        raise InputError(f"{label} must have one line per row, but a cell extends beyond row {odd}", key="file")
