"""Answers: tables and printed views of a study, its headline, messages, assumptions and files.

The record of a run has the digests of its files, which tell whether they are unchanged.
"""

from __future__ import annotations

import datetime
import hashlib
import io
import json
import platform
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, asdict, dataclass
from functools import cached_property, partial
from html import escape
from importlib import import_module
from importlib.metadata import version
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, overload

from mauvecl.host import VERSION
from mauvecl.host.arrays import ContentEquality
from mauvecl.host.exposure.background import rate_of
from mauvecl.host.instrument import shipped_names
from mauvecl.host.tables.files import check_size, json_text, open_regular, read_text, write_whole, writing
from mauvecl.host.tables.names import header_text
from mauvecl.schema.calls import validated
from mauvecl.schema.columns import Column, Drawable, View, percent, records, stacked, table_of
from mauvecl.schema.errors import InputError
from mauvecl.study.cases import Case, Use, assumptions_of, cases, full_label, place_columns
from mauvecl.study.study import Study, read_embedded_study

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from mauvecl.answers.verbs import Progress
    from mauvecl.device.build import Device, DeviceRecord
    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.runs.pool import Pool


@dataclass(frozen=True, eq=False)
class StarInCell:
    """Star in a cell of the sweep."""

    label: str  # of the star
    at: Mapping[str, float | str]  # swept values by quantity

    @property
    def title(self) -> str:
        """Star and swept values, for pictures."""
        return full_label(self.label, self.at)

    @property
    def subject(self) -> str:
        """Star and swept values, for sentences that state the exposure."""
        return full_label(self.label, {name: value for name, value in self.at.items() if name != "exposure"})


def name_of_instrument(study: Study) -> str:
    """Return the name of the instrument in sentences."""
    return "Mauve" if study.observation.instrument in shipped_names() else Path(study.observation.instrument).stem


def first_of_several(number: int, name: str) -> str:
    """Return the end of a sentence on the first of several things, as in ", the first of 3 limits", or nothing."""
    return f", the first of {number} {name}" if number > 1 else ""


#: End of a sentence on the ideal answer, which is a bound of the realistic one.
IF_KNOWN = "if everything but the noise were known"


@dataclass(eq=False)
class TableOf:
    """Declaration of a table of an answer: its file, its printed view and its part of the JSON.

    An instance of the answer has the table itself as this attribute, which is computed when it is first read.
    Attributes of the answer are named by paths such as "study.run.seed", and values that differ between answers are
    given as functions of the answer.
    """

    file: str  # name of the file without its ending; empty for a table that is only printed or part of the JSON
    columns: Sequence[Column] | Callable[[Any], Sequence[Column]]
    rows: str | Callable[[Any], object]  # attribute with the rows, a single row, or the whole table
    _: KW_ONLY
    # Table of a row: attribute of the row, or function of answer and row. Declared columns that it lacks precede it.
    row_table: str | Callable[[Any, Any], Table] | None = None
    by_star: bool = False  # whether columns of the star and of swept quantities precede the declared ones
    title: str | Callable[[Any], str] = ""  # of the printed view, which tables without a title do not have
    shown: Callable[[Any], Any] = lambda table: table  # returns the rows of the table that are printed
    key: str = ""  # in JSON
    when: str = ""  # attribute that is true if the answer has the table; without one, every answer has it
    # Metadata of the table: attributes, whose last names are the keys.
    meta: Sequence[str] | Callable[[Any], Mapping[str, object]] = ("study",)

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, answer: None, owner: type) -> TableOf: ...

    @overload
    def __get__(self, answer: Answer, owner: type) -> QTable: ...

    def __get__(self, answer: Answer | None, owner: type) -> TableOf | QTable:
        if answer is None:
            return self
        # The instance's dictionary, which also frozen dataclasses have, hides this attribute from then on.
        vars(answer)[self.name] = table = self._table(answer)
        return table

    def _table(self, answer: Answer) -> QTable:
        """Compute the table of an answer."""
        rows: Any = self.rows(answer) if callable(self.rows) else attrgetter(self.rows)(answer)
        if hasattr(rows, "colnames"):
            return rows
        rows = rows if isinstance(rows, Iterable) else [rows]
        meta = self.meta(answer) if callable(self.meta) else answer_metadata(answer, *self.meta)
        if self.row_table is None:
            return table_of(self.columns_of(answer), rows, **meta)
        get = attrgetter(self.row_table) if isinstance(self.row_table, str) else partial(self.row_table, answer)
        tables = [(row, get(row)) for row in rows]
        names = {name for _, table in tables for name in table.colnames}
        return stacked([column for column in self.columns_of(answer) if column.name not in names], tables, **meta)

    def columns_of(self, answer: Answer) -> tuple[Column, ...]:
        """Return the columns for an answer."""
        declared = self.columns(answer) if callable(self.columns) else self.columns
        columns = tuple(column for column in declared if column.when is None or column.when(answer))
        return answer.with_star(columns) if self.by_star else columns

    def view(self, answer: Answer, title: str = "", table: Table | None = None) -> View:
        """Return the printed view for an answer, under another title or of other rows if they are given."""
        title = title or (self.title(answer) if callable(self.title) else self.title)
        return View(title, self.columns_of(answer), self.shown(getattr(answer, self.name)) if table is None else table)


def answer_metadata(answer: Answer, *paths: str) -> dict[str, object]:
    """Return attributes of an answer by the last names of their paths; "study" is the text of the study."""
    values = {path.rpartition(".")[2]: attrgetter(path)(answer) for path in paths}
    return values | ({"study": answer.study.text()} if "study" in values else {})


class Answer(Drawable, ContentEquality):
    """Answer of a verb to a study: tables, printed views, messages, pictures and files.

    Subclasses declare tables with `TableOf`, in the order of the files; the first is the answer itself.
    """

    #: File extensions of each table; in some answers only of the first table.
    ENDINGS: ClassVar[tuple[str, ...]] = ("ecsv",)
    #: Parts of the study that the answer uses.
    USES: ClassVar[tuple[Use, ...]]

    if TYPE_CHECKING:

        @property
        def study(self) -> Study:
            """Study of the answer."""

        @property
        def messages(self) -> Sequence[str]:
            """Messages for users, the most severe first."""

        @property
        def inputs(self) -> Sequence[Expectation]:
            """Expectations on which the answer is based, for the run record; none if nothing is exposed."""
    else:
        inputs = ()

    def _declared(self) -> list[TableOf]:
        """Return the declarations of the tables that the answer has."""
        tables = [table for table in vars(type(self)).values() if isinstance(table, TableOf)]
        return [table for table in tables if not table.when or attrgetter(table.when)(self)]

    def has_table(self, file: str) -> bool:
        """Return whether the answer has the table of a file, without making it."""
        return file in (table.file for table in self._declared())

    @property
    def tables(self) -> dict[str, Table]:
        """All tables by file name."""
        return {table.file: getattr(self, table.name) for table in self._declared() if table.file}

    @property
    def views(self) -> list[View]:
        """Printed tables, for the terminal and the page."""
        views = [table.view(self) for table in self._declared() if table.title]
        return [view for view in views if view.title]

    @property
    def json_tables(self) -> dict[str, Table]:
        """Tables in JSON by key; "rows" is the first table unless others are declared."""
        keyed = {table.key: getattr(self, table.name) for table in self._declared() if table.key}
        return keyed or {"rows": next(iter(self.tables.values()))}

    @property
    def instrument_name(self) -> str:
        """Name of the instrument in sentences."""
        return name_of_instrument(self.study)

    def with_star(self, columns: Sequence[Column]) -> tuple[Column, ...]:
        """Return columns after those of the star and of swept quantities that are not among them."""
        return (*place_columns(self.study.sweep, *(column.name for column in columns)), *columns)

    @property
    def headline(self) -> str:
        """The answer in one sentence, with its uncertainty; empty if there is none."""
        return ""

    @property
    def assumed(self) -> str:
        """Line with the study's assumptions about the parts that the answer uses."""
        return f"Assumed: {'; '.join(self.premises)}."

    @property
    def premises(self) -> list[str]:
        """The study's assumptions about the parts that the answer uses, one clause each."""
        return assumptions_of(self.study, self.uses)

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses."""
        return self.USES

    @cached_property
    def neighbours(self) -> QTable | None:
        """Table of the neighbours of the stars that the answer observes, or None if there are none."""
        if not self.study.has_neighbours or "instrument" not in self.uses:
            return None
        rows, shares = list[dict[str, Any]](), set[float]()
        for case in self.observed:
            near = case.neighbours
            if near is None:
                continue
            total = float((case.quiet.source_electrons + case.quiet.neighbour_electrons).sum())
            for star in near.stars:
                shares.add(case.star.neighbour_share)
                # Beyond the fibre no spectrum is needed.
                enters, share, spectrum = star.separation_arcsec <= case.instrument.field_of_view_radius_arcsec, 0.0, ""
                if enters:
                    rate, spectrum = rate_of(star, case.instrument, case.study.observation.order), star.spectrum[0]
                    share = near.share * float(rate.sum()) * case.quiet.frame_s / total
                rows.append({
                    "star": case.label, "name": star.name, "separation": star.separation_arcsec, "band": star.band,
                    "magnitude": float("nan") if star.magnitude is None else star.magnitude, "spectrum": spectrum,
                    "enters": enters, "share": share,
                })  # fmt: skip
        about = {"assumed_share": shares.pop() if len(shares) == 1 else sorted(shares), "study": self.study.text()}
        return table_of(NEIGHBOUR_COLUMNS, rows, **about) if rows else None

    @property
    def observed(self) -> Sequence[Case]:
        """Cases of the stars that the answer observes, at the study's own values; those of its study by default."""
        return cases(self.study, swept=False)

    @property
    def all_views(self) -> list[View]:
        """The views and, if there are any, the neighbours."""
        if self.neighbours is None:
            return self.views
        return [*self.views, View("Neighbours; what enters is an assumption", NEIGHBOUR_COLUMNS, self.neighbours)]

    @property
    def remarks(self) -> list[str]:
        """Remarks below the tables."""
        return []

    def _line(self) -> str:
        return repr(self.headline) if self.headline else f"to {self.study!r}"

    def __str__(self) -> str:
        """Return what the command prints, without details."""
        lines = [self.headline, *map(str, self.all_views), "Assumed:", *(f"  {clause}" for clause in self.premises)]
        return "\n".join(line for line in (*lines, *self.messages, *self.remarks) if line)

    def _repr_html_(self) -> str:
        return f"<p>{escape(self.headline)}</p>{''.join(view._repr_html_() for view in self.all_views)}"

    def as_json(self) -> dict[str, Any]:
        """Return the content that `--json` prints."""
        tables = self.json_tables | ({} if self.neighbours is None else {"neighbours": self.neighbours})
        return {"messages": list(self.messages)} | {key: records(table) for key, table in tables.items()}

    def write(self, folder: str | Path) -> list[Path]:
        """Write every table and the study, and return their paths.

        Raises InputError if a file cannot be written; an earlier file of that name is then unchanged.
        """
        path = make_folder(Path(folder))
        return [write(path / name) for name, write in self.writers.items()]

    @property
    def writers(self) -> dict[str, Callable[[Path], Path]]:
        """Functions that write the tables, the documents and the study to a path, by full file name."""
        documents = self.documents | {"study.toml": self.study.toml().encode}
        writers: dict[str, Any] = {name: partial(write_table, table) for name, table in self.files.items()}
        return writers | {name: partial(write_document, content) for name, content in documents.items()}

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        """Functions that make the content of documents, by full file name."""
        return {}

    def report(self, name: str, form: str) -> dict[str, Callable[[], bytes]]:
        """Return the document with the answer's report, which is "html" or "pdf"; pictures are imported for it."""
        return {f"{name}.{form}": lambda: import_module("mauvecl.charts.campaigns").report(self, form)}

    @property
    def files(self) -> dict[str, Table]:
        """Tables by full file name."""
        tables = self.tables | ({} if self.neighbours is None else {"neighbours": self.neighbours})
        return {f"{name}.{ending}": table for name, table in tables.items() for ending in self.ENDINGS}


NEIGHBOUR_COLUMNS = (
    Column("star", description="star that is observed", heading="star", kind=str),
    Column("name", description="neighbour", heading="neighbour", kind=str),
    Column("separation", "", "arcsec", "from the star", "arcsec", ".4g"),
    Column("magnitude", "", "mag", "in the band", "magnitude", ".2f"),
    Column("band", heading="band", kind=str),
    Column("spectrum", "", "", "spectrum that represents it; empty if its light does not enter", "spectrum", kind=str),
    Column("enters", description="whether it is within the fibre's radius, so that the assumed share of its light "
           "enters", heading="enters", format=lambda value: "yes" if value else "no", kind=bool),
    Column("share", description="share of the electrons of all stars in the fibre, without a flare",
           heading="of all stars", format=percent(".3g")),
)  # fmt: skip


def share_column(get: str) -> Column:
    """Return the column of the dilution, for answers with neighbours; `get` names it in a row."""
    text = "share of the star in the electrons of all stars in the fibre, without a flare (dilution)"
    return Column("target_share", get, "", text, "star's share", percent(".3g"),
                  when=lambda answer: answer.study.has_neighbours)  # fmt: skip


Item = TypeVar("Item")


def reported(items: Iterable[Item], total: int, progress: Progress) -> Iterator[Item]:
    """Yield items, and call ``progress(done, total)`` after the work on each.

    If that raises, a generator of items is closed at once, while the workers that it uses are still open.
    """
    try:
        for number, item in enumerate(items, 1):
            yield item
            if progress is not None:
                progress(number, total)
    finally:
        if isinstance(items, Generator):
            items.close()


#: File name of the run record, and its key with the digest of all other keys.
RECORD, OWN_DIGEST = "run.json", "record_digest"


@dataclass(frozen=True)
class FileFault:
    """File that differs from what the run wrote."""

    file: str
    state: str  # "changed", "missing" or another fault


#: Largest size of a file of an answer, bytes: spectra of the longest stare have 1.2e9.
LARGEST = 2**32

FAULT_COLUMNS = (Column("file", heading="file"), Column("state", heading="what"))


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; raise InputError if it is no regular file."""
    with open_regular(path, "file") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def record_digest(record: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a run record as canonical JSON: sorted keys, no spaces, without its own digest."""
    content = {key: value for key, value in record.items() if key != OWN_DIGEST}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def is_answer(folder: Path) -> bool:
    """Return whether a folder holds a run record, or the study and a table of an answer whose record is missing."""
    if (folder / RECORD).is_file():
        return True
    for path in folder.glob("*.ecsv") if (folder / "study.toml").is_file() else ():
        # A user's own tables have no study in their metadata.
        with suppress(InputError):
            if read_embedded_study(path):
                return True
    return False


@validated
def verify_answer(folder: str | Path) -> list[FileFault]:
    """Compare an answer's folder, the value of a verb's ``--output``, with the digests in its run record.

    Any change of a file of the run, and of the record itself, is detected, unless digests are also recomputed: the
    digest is not a signature. Other files in the folder are ignored.
    """
    folder = Path(folder)
    if not is_answer(folder):
        raise InputError(f"{str(folder)!r} holds no {RECORD}; give the output folder of a verb", key="folder")
    if not (folder / RECORD).is_file():
        return [FileFault(RECORD, "missing")]
    text = read_text(folder / RECORD, "run record")
    try:
        record = json.loads(text)
        named = record.get("files", {})
        files = {Path(name).name: digest for name, digest in named.items()}
    except (ValueError, AttributeError, RecursionError):
        return [FileFault(RECORD, "cannot be read")]
    faults = []
    if OWN_DIGEST not in record:
        faults.append(FileFault(RECORD, "holds no digest of itself: changed, or of an earlier version"))
    elif record[OWN_DIGEST] != record_digest(record) or text != json_text(record) + "\n":
        faults.append(FileFault(RECORD, "changed"))
    for name, digest in files.items():
        path, state = folder / name, "missing"
        try:
            if path.exists():
                check_size(path, "file", LARGEST)
                state = "" if digest_of(path) == digest else "changed"
        except (InputError, OSError):
            state = f"no regular file of at most {LARGEST >> 30} GiB"
        if state:
            faults.append(FileFault(name, state))
    return faults


FITS_KEYWORDS = {"name": "OBJECT", "exposure_s": "EXPTIME", "frames": "NFRAMES", "seed": "SEED"}


def make_folder(path: Path) -> Path:
    """Make a folder; raises InputError if it cannot be made or written to."""
    if path.exists() and not path.is_dir():
        raise InputError(f"output folder {str(path)!r} is a file: give the name of a folder", key="output")
    with writing(f"output folder {str(path)!r}", "use a writable one", key="output"):
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".mauvecl-probe"
        probe.write_text("")
        probe.unlink(missing_ok=True)
    return path


def write_table(table: Table, path: Path) -> Path:
    """Write a table as ECSV, or FITS by its ending; raises InputError if that fails, and keeps an existing file."""
    if path.suffix == ".fits":
        plain, packed = table.copy(), io.BytesIO()
        # FITS keywords are limited to eight letters and short values, so the study has its own file.
        values = {keyword: table.meta[key] for key, keyword in FITS_KEYWORDS.items() if key in table.meta}
        plain.meta = {key: header_text(value) if isinstance(value, str) else value for key, value in values.items()}
        plain.write(packed, format="fits")
        write_whole(path, packed.getbuffer())
    else:
        write_whole(path, ecsv_text(table).encode())
    return path


def ecsv_text(table: Table) -> str:
    """Return a table as ECSV text."""
    text = io.StringIO()
    table.write(text, format="ascii.ecsv")
    return text.getvalue()


def write_document(content: Callable[[], bytes], path: Path) -> Path:
    """Write a file from a function that returns its bytes; errors as for `write_table`."""
    write_whole(path, content())
    return path


def write_record(
    verb: str, study: Mapping[str, Any], expectations: Sequence[Expectation], folder: Path, *, pool: Pool | None,
    opened: Device | None = None, seconds: float, messages: Sequence[str], files: Sequence[Path], whole: bool = True,
) -> Path:  # fmt: skip
    """Write the run record, which says how an answer was computed.

    The study is as JSON can hold it. `opened` is the device if something was drawn without a pool. The record contains
    the digests of the written `files` and its own; see `verify_answer`. If these are the `whole` answer, unchanged
    files of an earlier run in the folder that this run did not write are removed.
    """
    record: dict[str, Any] = {
        "mauvecl": VERSION,
        "verb": verb,
        "date_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "wall_time_s": round(seconds, 3),
        "seed": study["run"]["seed"],
        "study": study,
        "inputs": [{"name": x.name} | dict(x.provenance) for x in expectations],
        "messages": list(messages),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in ("numpy", "scipy", "astropy", "synphot", "pyopencl")},
    }
    if pool is not None:
        record |= _devices(pool.devices, pool.kernel_digest) | {"shards": asdict(pool.standing)}
    elif opened is not None:
        record |= _devices([opened.record], opened.kernel_digest)
    record["files"] = {path.name: digest_of(path) for path in files}
    stale = [path for path in _left_by_another(folder) if path.name not in record["files"]] if whole else []
    # Converted to JSON and back, so that the digest of a record that is read again is the same.
    record = json.loads(json_text(record))
    record[OWN_DIGEST] = record_digest(record)
    written = write_document(f"{json_text(record)}\n".encode, folder / RECORD)
    for path in stale:
        path.unlink(missing_ok=True)
    return written


def _devices(devices: Sequence[DeviceRecord], kernels: str) -> dict[str, Any]:
    """Return what a run record says of the devices, with the outcome of the self-test on each if it was run."""
    from mauvecl.device.build import read_outcome

    missing = "not run on this device and version: mauvecl selftest"
    outcomes = [read_outcome(device) or missing for device in devices]
    return {"devices": [asdict(device) for device in devices], "kernels": kernels, "selftest": outcomes}


def _left_by_another(folder: Path) -> list[Path]:
    """Return the unchanged files of the run record in a folder."""
    try:
        named = json.loads(read_text(folder / RECORD, "run record")).get("files", {})
        files = [(folder / name, digest) for name, digest in named.items() if Path(name).name == name]
        return [path for path, digest in files if path.is_file() and digest_of(path) == digest]
    except (InputError, OSError, ValueError, AttributeError, RecursionError):
        # There is no record, or mauvecl has not written it.
        return []
