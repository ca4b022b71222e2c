"""Folders of spectra with one file per frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mauvecl.host.tables.names import matched
from mauvecl.host.tables.opening import read_table
from mauvecl.host.tables.table import MemoryTable, TableFile, Values
from mauvecl.observations.mapping import FrameMapping
from mauvecl.schema.errors import InputError

#: Largest number of files in a folder.
MAX_FILES = 2**20
#: Column of a table with the names of files, by default.
FILES = "file"

Open = Callable[[Path], AbstractContextManager[TableFile]]


class FolderFile(TableFile):
    """Spectra in the files of a folder; quantities of frames are keywords of their headers or columns of a table."""

    def __init__(self, folder: Path, mapping: FrameMapping, what: str, open_file: Open) -> None:
        super().__init__(what, {})
        self.open_file = open_file
        self.table: MemoryTable | None = None
        if mapping.table is not None:
            place = folder / mapping.table
            self.table = MemoryTable(read_table(place, "table of files", texts=()), f"table {mapping.table!r}")
            listed = self.table.find(mapping.files or FILES)
            self.paths = [folder / str(name) for name in listed.texts() or listed.read(0, listed.n_rows)]
        else:
            self.paths = sorted(
                path for path in folder.glob(mapping.files or "*")
                if not path.is_dir() and not path.name.startswith(".") and path.suffix != ".toml"
            )  # fmt: skip
        if not 1 <= len(self.paths) <= MAX_FILES:
            raise InputError(f"{what}: {mapping.files or '*'!r} names {len(self.paths)} files", f"1 to {MAX_FILES}",
                             key="files", value=mapping.files)  # fmt: skip
        with open_file(self.paths[0]) as first:
            self.header = first.header
            self.names_of_first = first.names
        self.headers = lru_cache(maxsize=1)(self._headers)
        self.values = lru_cache(maxsize=64)(self._values)

    @property
    def names(self) -> list[str]:
        """Names of the columns of the table, of keywords, and of the columns of the first file."""
        return [*(self.table.names if self.table else []), *map(str, self.header), *self.names_of_first]

    def named(self, name: str) -> Values | None:
        """Return a column of the table, a keyword of each header, or a column of each file."""
        if self.table is not None and (found := self.table.named(name)) is not None:
            return found
        keyword = matched(name, self.header)
        if keyword is not None:
            return Values.of(name, np.array(self._keywords(keyword)), None, self.what)
        with self.open_file(self.paths[0]) as first:
            one = first.named(name) or (first.find(name) if "*" in name else None)
        return None if one is None else self._of_files(name, one)

    def axis(self, name: str, dimension: int) -> Values:
        """Return the wavelengths of the first file's image; raise InputError if another file has others."""
        if dimension != 1:
            return super().axis(name, dimension)
        first: Values | None = None
        for path in self.paths:
            with self.open_file(path) as file:
                axis = file.axis(name, 1)
            first = first or axis
            if axis.shape != first.shape or not np.allclose(axis.numbers(), first.numbers(), rtol=1e-9, atol=0.0):
                raise InputError(f"{self.what}: {path.name} has other wavelengths than {self.paths[0].name}",
                                 "the same in every file", key="wavelength", value=path.name)  # fmt: skip
        assert first is not None
        return first

    def _of_files(self, name: str, one: Values) -> Values:
        """Return a column of every file, with one row per file."""
        n = int(np.prod(one.shape))

        def read(start: int, stop: int) -> Any:
            return np.stack([self.values(name, k, n) for k in range(start, stop)])

        return Values(name, (len(self.paths), n), read, one.unit, self.what)

    def _values(self, name: str, number: int, n: int) -> Any:
        path = self.paths[number]
        with self.open_file(path) as file:
            found = file.find(name).numbers().ravel()
        if found.size != n:
            raise InputError(f"{self.what}: {path.name} has {found.size} values of {name!r}",
                             f"{n} as in {self.paths[0].name}", key=name, value=path.name)  # fmt: skip
        return found

    def _headers(self) -> Sequence[dict[str, Any]]:
        headers = []
        for path in self.paths:
            with self.open_file(path) as file:
                headers.append(file.header)
        return headers

    def _keywords(self, keyword: str) -> list[Any]:
        found = [header.get(keyword) for header in self.headers()]
        if None in found:
            raise InputError(f"{self.what}: {self.paths[found.index(None)].name} has no {keyword}",
                             "the keyword in every file", key=keyword)  # fmt: skip
        return found
