"""Output to the terminal: tables, messages, progress."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Self

from mauvecl.schema.tables import INTERVAL, View, without_empty

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID
    from rich.table import Table

    from mauvecl.runs.pool import PoolProgress

#: Work shorter than this shows no progress, s.
PATIENCE_S = 2.0
#: Largest width of a table in a pipe or file, characters.
WIDEST = 100_000
#: Fraction of the work after which the remaining time is estimated, since the first tile's rate is unreliable.
TOLD_FROM = 0.01


class Meter:
    """Progress with rate and time left, on standard error, for work longer than two seconds.

    On a terminal and in a notebook it is a bar; elsewhere a plain line every ten seconds.
    """

    # Returns the progress of a pool, with parts from a checkpoint and parts that were counted again.
    standing: Callable[[], PoolProgress] | None = None

    def __init__(self, *, quiet: bool = False, unit: str = "realisations", work: str = "drawing") -> None:
        self._quiet, self._unit, self._work = quiet, unit, work
        self._started = self._shown = time.monotonic()
        self._last = self._total = 0
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def __call__(self, done: int, total: int) -> None:
        """Record how much work is done, in the meter's unit."""
        now = time.monotonic()
        if done < self._last and total == self._total:
            # Threads may report in another order than they worked.
            return
        if done <= self._last:
            # Start of the next star's work.
            self._stop()
            self._started = self._shown = now
        self._last, self._total = done, total
        if self._quiet or now - self._started < PATIENCE_S:
            return
        if sys.stderr.isatty() or "ipykernel" in sys.modules:
            self._draw(done, total)
        elif now - self._shown >= 10.0:
            self._shown = now
            rate = self._rate(done)
            left = self._left(done, total, rate)
            print(f"{done} of {total} {self._unit}, {rate:.3g} a second, {left}{self._retries()}", file=sys.stderr)

    def _left(self, done: int, total: int, rate: float) -> str:
        """Return the remaining time, once enough work is done to estimate it."""
        if rate * (time.monotonic() - self._started) < TOLD_FROM * total:
            return "time left unknown"
        seconds = (total - done) / rate
        for unit, size in (("days", 86_400.0), ("hours", 3600.0), ("min", 60.0)):
            if seconds > 3 * size:
                return f"{seconds / size:.0f} {unit} left"
        return f"{seconds:.0f} s left"

    def _rate(self, done: int) -> float:
        """Return the work done per second, without parts from a checkpoint."""
        resumed = self.standing().resumed if self.standing is not None and self._unit == "realisations" else 0
        return (done - resumed) / max(time.monotonic() - self._started, 1e-9)

    def _retries(self) -> str:
        """Return a note on failed devices, if any."""
        retries = 0 if self.standing is None else self.standing().retries
        return f", {retries} parts counted again" if retries else ""

    def _draw(self, done: int, total: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

        if self._bar is None:
            self._bar = Progress(
                TextColumn(self._work),
                BarColumn(),
                TaskProgressColumn(),
                TextColumn(f"{{task.fields[rate]}} {self._unit}/s"),
                TimeRemainingColumn(),
                TextColumn("left{task.fields[retries]}"),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            self._task = self._bar.add_task("", total=total, rate="", retries="")
        assert self._task is not None
        self._bar.update(
            self._task, completed=done, total=total, rate=f"{self._rate(done):,.0f}", retries=self._retries()
        )

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


def show(lines: Sequence[str]) -> None:
    """Print plain lines on standard output."""
    from rich.console import Console

    console = Console(highlight=False, soft_wrap=True, markup=False, emoji=False)
    for line in lines:
        console.print(line)


def show_view(view: View) -> None:
    """Print a table of an answer, or the sentence in its place."""
    if view.table is None:
        show([view.title])
    else:
        show_table(view.title, *view.texts())


def show_table(title: str, columns: Sequence[str], cells: Sequence[Sequence[Any]]) -> None:
    """Print a table without its empty columns, in parts if the terminal is narrower; cells are text."""
    from rich.console import Console

    columns, cells = without_empty(columns, cells)
    filled = list(range(len(columns)))
    # Names may contain brackets and colons, which are not markup here.
    how: dict[str, Any] = {"highlight": False, "markup": False, "emoji": False}
    console = Console(**how)
    if not console.is_terminal:
        # A pipe has no width, so the table is as wide as needed.
        console = Console(**how, width=WIDEST)
    # rich would wrap a table's title at the table's width.
    console.print(title, soft_wrap=True)
    for part in _parts(columns, cells, filled, console.width):
        # A column that exceeds the terminal is printed completely.
        Console(**how, width=max(console.width, _width(columns, cells, part))).print(_table(columns, cells, part))


def _table(columns: Sequence[str], cells: Sequence[Sequence[Any]], part: Sequence[int]) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD)
    for i in part:
        numeric = all(isinstance(row[i], str) and row[i][:1] in "0123456789-+.<>=" for row in cells) and bool(cells)
        table.add_column(columns[i], justify="right" if numeric else "left", no_wrap=True)
    for row in cells:
        table.add_row(*(str(row[i]) for i in part))
    return table


def _width(columns: Sequence[str], cells: Sequence[Sequence[Any]], part: Sequence[int]) -> int:
    """Return the width of a table: two blanks per column, and lines between columns and at both ends."""
    from rich.cells import cell_len

    return 1 + sum(3 + max(cell_len(text) for text in (columns[i], *(str(row[i]) for row in cells))) for i in part)


def _parts(columns: Sequence[str], cells: Sequence[Sequence[Any]], filled: list[int], room: int) -> list[list[int]]:
    """Return the columns of each part: the first columns, which identify rows, and as many others as fit."""
    if _width(columns, cells, filled) <= room:
        return [filled]
    # As few as needed, so that the first months are not repeated in each part.
    apart = next((n for n in (1, 2, 3) if len({tuple(row[i] for i in filled[:n]) for row in cells}) == len(cells)), 3)
    fitting = (filled[:n] for n in range(apart, 1, -1) if _width(columns, cells, filled[:n]) <= room / 2)
    first = next(fitting, filled[:1])
    together: list[list[int]] = []
    for i in filled[len(first) :]:
        if together and columns[i] == INTERVAL:
            together[-1].append(i)
        else:
            together.append([i])
    parts = [list(first)]
    for some in together:
        if len(parts[-1]) > len(first) and _width(columns, cells, [*parts[-1], *some]) > room:
            parts.append(list(first))
        parts[-1] += some
    return parts
