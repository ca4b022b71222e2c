"""Base class of answers: study, messages, inputs, tables, pictures and files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from mauvecl.host.content_equality import ContentEquality
from mauvecl.schema.drawable import Drawable, documents_of
from mauvecl.schema.tables import View, records
from mauvecl.study.labels import full_label

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from astropy.table import QTable, Table

    from mauvecl.host.exposure.expectation import Expectation
    from mauvecl.study.assumptions import Use
    from mauvecl.study.cases import Case
    from mauvecl.study.study import Study


@dataclass(frozen=True, eq=False)
class InCell:
    """Star in a cell of the sweep."""

    label: str
    at: Mapping[str, float | str]

    @property
    def title(self) -> str:
        """Star and swept values, for pictures."""
        return full_label(self.label, self.at)


class Answer(Drawable, ContentEquality, ABC):
    """Answer of a verb to a study: tables, printed views, messages, pictures and files."""

    #: File extensions of each table; in some answers only of the first table.
    ENDINGS: ClassVar[tuple[str, ...]] = ("ecsv",)
    #: Parts of the study that the answer uses.
    USES: ClassVar[tuple[Use, ...]]

    #: Properties with the tables in JSON, by key; by default "rows" with the first table.
    JSON: ClassVar[Mapping[str, str]] = {}

    if TYPE_CHECKING:

        @property
        def study(self) -> Study:
            """Study of the answer."""

        @property
        def messages(self) -> Sequence[str]:
            """Messages for users, the most severe first."""

    @property
    @abstractmethod
    def tables(self) -> dict[str, Table]:
        """All tables by file name; the first is the answer itself."""

    @property
    @abstractmethod
    def inputs(self) -> list[Expectation]:
        """Expectations on which the answer is based, for the run record."""

    @property
    def assumed(self) -> str:
        """Line with the study's assumptions about the parts that the answer uses."""
        from mauvecl.study.assumptions import assumption_line

        return assumption_line(self.study, self.uses)

    @property
    def uses(self) -> tuple[Use, ...]:
        """Parts of the study that this answer uses."""
        return self.USES

    @property
    def views(self) -> list[View]:
        """Printed tables, for the terminal and the page."""
        return []

    @cached_property
    def neighbours(self) -> QTable | None:
        """Neighbours of the stars that the answer observes, or None."""
        from mauvecl.answers.neighbour_list import neighbour_table

        return (
            neighbour_table(self.observed, study=self.study.text())
            if self.study.has_neighbours and "instrument" in self.uses
            else None
        )

    @property
    def observed(self) -> Sequence[Case]:
        """Cases of the stars that the answer observes, at the study's own values; those of its study by default."""
        from mauvecl.study.cases import cases

        return cases(self.study, swept=False)

    @property
    def all_views(self) -> list[View]:
        """The views and, if there are any, the neighbours."""
        if self.neighbours is None:
            return self.views
        from mauvecl.answers.neighbour_list import COLUMNS

        return [*self.views, View("Neighbours; what enters is an assumption", COLUMNS, self.neighbours)]

    @property
    def remarks(self) -> list[str]:
        """Remarks below the tables."""
        return []

    def _line(self) -> str:
        return f"to {self.study!r}"

    def _repr_html_(self) -> str:
        return str(next(iter(self.tables.values()))._repr_html_())

    def as_json(self) -> dict[str, Any]:
        """Return the content that `--json` prints."""
        tables = {key: getattr(self, name) for key, name in self.JSON.items()}
        found = tables or {"rows": next(iter(self.tables.values()))}
        near = {} if self.neighbours is None else {"neighbours": self.neighbours}
        return {"messages": list(self.messages)} | {key: records(table) for key, table in (found | near).items()}

    def write(self, folder: str | Path) -> list[Path]:
        """Write every table and the study, and return their paths.

        Raises InputError if a file cannot be written; an earlier file of that name is then unchanged.
        """
        from mauvecl.answers.files import make_folder, write_document, write_study, write_table

        place = make_folder(Path(folder))
        return [
            *(write_table(table, place / name) for name, table in self.files.items()),
            *(write_document(content(), place / name) for name, content in self.documents.items()),
            write_study(self.study.toml(), place),
        ]

    @property
    def documents(self) -> dict[str, Callable[[], bytes]]:
        """Functions that make the content of documents, by full file name."""
        return documents_of(self)

    @property
    def files(self) -> dict[str, Table]:
        """Tables by full file name."""
        near = {} if self.neighbours is None else {"neighbours": self.neighbours}
        return {f"{name}.{ending}": table for name, table in (self.tables | near).items() for ending in self.ENDINGS}
