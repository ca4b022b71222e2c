"""What every verb of the command line does around its answer: who draws, where it is written, how much is said."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from mauvecl.cli.boundary import writes_to

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.answers.answer import Answer
    from mauvecl.cli.console import Meter
    from mauvecl.device.device import Device
    from mauvecl.host.expectation import Expectation
    from mauvecl.runs.checkpoint import Checkpoint
    from mauvecl.runs.pool import Pool, Workers
    from mauvecl.schema.errors import InputError
    from mauvecl.study.study import Study


class Terminated(KeyboardInterrupt):
    """SIGTERM, as the end of a batch job's time or a shutdown sends it."""


@dataclass(eq=False)
class Session:
    """One call of a verb; use it in a `with` block, in which this process alone writes into the output folder.

    Attributes
    ----------
    verb : str
    study : Study
    output : Path, optional
        Folder for everything written.
    as_json, quiet, pictures : bool
    device : str, optional
        As `Engine` takes it; several with commas between them.
    cluster : str, optional
        As `cluster.DaskWorkers` takes it.
    resume, restart : bool
        What is to become of an unfinished run that is there.
    keep_after : float, optional
        Seconds after which finished parts of the work are kept on the disk; as `Checkpoint` has it by default.
    insist : bool
        Begin what would never end, or not fit.
    opened : Device, optional
        On which something was drawn without a pool, for the record.
    """

    verb: str
    study: Study
    output: Path | None = None
    as_json: bool = False
    quiet: bool = False
    pictures: bool = True
    device: str | None = None
    cluster: str | None = None
    resume: bool = False
    restart: bool = False
    keep_after: float | None = None
    insist: bool = False
    files: list[Path] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)
    opened: Device | None = None
    _pool: Pool | None = None
    _checkpoint: Checkpoint | None = None
    _lost: list[InputError] = field(default_factory=list)
    _held: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Let go of the output folder.

        Raises
        ------
        InputError
            If a file of the answer, which is printed by now, could not be written.
        """
        from mauvecl.schema.errors import InputError

        self._held.close()
        if kind is None and self._lost:
            others = f"; the same holds for {len(self._lost) - 1} more files of this answer" if self._lost[1:] else ""
            first = self._lost[0]
            error = InputError(f"{first}{others}", key=first.key, value=first.value)
            error.expected = first.expected
            raise error

    @cached_property
    def folder(self) -> Path:
        """Where everything is written; held from now on."""
        from mauvecl.answers.files import make_folder
        from mauvecl.runs.locks import locked

        folder = make_folder(self.output or Path(f"mauvecl-{self.verb}"))
        writes_to(folder)
        self._held.enter_context(locked(folder, "output folder"))
        return folder

    @contextmanager
    def pool(self, *, unit: str = "realisations") -> Iterator[Pool]:
        """Everyone who draws, with progress and a checkpoint; interruptions are told.

        Parameters
        ----------
        unit : str
            What progress counts: realisations, which the pool tells, or something that the caller tells `meter`.
        """
        from mauvecl.runs.pool import Pool

        self.meter = self.metered(unit)
        with self.checkpoint() as checkpoint, ExitStack() as stack:
            stack.enter_context(self.meter)
            workers = stack.enter_context(working(self.device, self.cluster))
            progress = self.meter if unit == "realisations" else None
            self._pool = Pool(workers, checkpoint=checkpoint, progress=progress, meanwhile=self._load)
            self.meter.standing = lambda: self._pool.standing
            yield self._pool

    @contextmanager
    def checkpoint(self) -> Iterator[Checkpoint]:
        """Keep finished parts of the work in the output folder, and report interruptions."""
        from mauvecl.runs.checkpoint import Checkpoint

        how: dict[str, Any] = {"resume": self.resume, "restart": self.restart}
        if self.keep_after is not None:
            how["patience_s"] = self.keep_after
        checkpoint = Checkpoint(self.folder, self.verb, self.study, held=True, **how)
        with told_of_interrupts(lambda: self._kept(checkpoint)), checkpoint:
            self.say(checkpoint.messages)
            yield checkpoint
            if checkpoint.damaged:
                self.say(
                    [f"{checkpoint.damaged} files of {str(checkpoint.folder)!r} were damaged and are drawn again."]
                )
        self._checkpoint = checkpoint

    def _load(self) -> None:
        """Import what tables and pictures need, which takes three quarters of a second at the end otherwise."""
        from importlib import import_module

        from mauvecl.pictures.registry import load
        from mauvecl.pictures.style import available, canvas

        for name in ("astropy.table", "astropy.io.misc.yaml", "rich.table"):
            import_module(name)
        load()
        if self.pictures and available():
            canvas()

    def metered(self, unit: str) -> Meter:
        """Progress in a unit, to be used in a `with` block."""
        from mauvecl.cli.console import Meter

        return Meter(quiet=self.quiet or self.as_json, unit=unit)

    def _kept(self, checkpoint: Checkpoint) -> str:
        kept = checkpoint.kept
        if not kept:
            return "nothing was written, and nothing is half written"
        parts = f"{kept} part{'s' if kept > 1 else ''} of the work"
        return f"{parts} kept in {str(checkpoint.folder)!r}, and the same command with --resume goes on from there"

    def say(self, lines: Sequence[str]) -> None:
        """Tell the reader, unless standard output is for JSON alone."""
        from mauvecl.cli.console import show
        from mauvecl.cli.naming import with_flags

        if lines and not self.as_json:
            show([with_flags(line) for line in lines])

    @cached_property
    def draws_pictures(self) -> bool:
        """Whether pictures are to be drawn; tells where matplotlib is missing."""
        from mauvecl.pictures.style import available

        if self.pictures and not available():
            if not self.quiet:
                self.say(["No pictures: matplotlib is missing, `pip install 'mauvecl[plot]'` brings it."])
            return False
        return self.pictures

    def write(self, table: Table, name: str) -> None:
        """Write a table into the folder, in the format of its name's ending."""
        from mauvecl.answers.files import write_table

        self.leave(lambda: write_table(table, self.folder / name))

    def _document(self, name: str, content: Callable[[], bytes]) -> Path:
        from mauvecl.answers.files import write_document

        return write_document(content(), self.folder / name)

    def leave(self, write: Callable[[], Path | Sequence[Path]]) -> None:
        """Have files written; one that cannot be is told at the end, when the answer is out."""
        from mauvecl.schema.errors import InputError

        try:
            made = write()
        except InputError as error:
            self._lost.append(error)
            return
        self.files += [made] if isinstance(made, Path) else made

    def record(self, study: Study, inputs: Sequence[Expectation], messages: Sequence[str]) -> None:
        """Write the study and the run record into the folder, and remove what was kept for a resume."""
        from mauvecl.answers.files import write_record, write_study

        if self.folder / "study.toml" not in self.files:
            self.leave(lambda: write_study(study, self.folder))
        seconds = time.perf_counter() - self.started
        pool = self._pool
        how: dict[str, Any] = {"pool": pool, "opened": self.opened, "seconds": seconds, "messages": messages}
        # Only a whole answer takes the place of another's.
        how |= {"files": self.files, "whole": not self._lost}
        self.leave(lambda: write_record(self.verb, study, inputs, self.folder, **how))
        if self._checkpoint is not None and not self._lost:
            self._checkpoint.forget()

    def ask(self, study: Study) -> Any:
        """Return the answer of the session's verb; a pool draws where the verb has something to count."""
        from mauvecl.answers.verbs import VERBS

        verb = VERBS[self.verb]
        if not verb.counts:
            return verb.ask(study)
        with self.pool(unit=verb.counts) as engine:
            return verb.ask(study, engine, None if verb.counts == "realisations" else self.meter)

    def answer(self, answer: Answer) -> None:
        """Print an answer and write its files."""
        self.say([*answer.messages, answer.assumed])
        with told_of_interrupts(self._written):
            self._leave_all(answer)
        if self.as_json:
            from mauvecl.cli.naming import with_flags

            content = answer.as_json()
            told = {"assumed": answer.assumed, "messages": [with_flags(line) for line in content["messages"]]}
            self.print_json(told | {key: value for key, value in content.items() if key != "messages"})
            return
        from mauvecl.cli.console import show_view

        for view in answer.all_views:
            show_view(view)
        self.say(answer.remarks)
        self.finish()

    def _leave_all(self, answer: Answer) -> None:
        """Tables, documents and pictures of an answer, then the run's record."""
        for name, table in answer.files.items():
            self.write(table, name)
        for name, content in answer.documents.items():
            self.leave(partial(self._document, name, content))
        if self.draws_pictures:
            for name, draw in answer.pictures.items():
                self.leave(partial(draw, self.folder / f"{name}.png"))
        self.record(answer.study, answer.inputs, [*answer.messages, *answer.remarks])

    def _written(self) -> str:
        """Describe what an interruption leaves while files are written."""
        whole = ", ".join(path.name for path in self.files) or "nothing"
        kept = None if self._checkpoint is None else self._checkpoint.kept
        again = "the same command with --resume" if kept else "the same command"
        return f"{whole} written to {str(self.folder)!r}, each file whole, and {again} writes all of them"

    def print_json(self, content: dict[str, Any]) -> None:
        """Print the answer as JSON."""
        from mauvecl.answers.files import json_text

        print(json_text(content))

    def finish(self) -> None:
        """Name the files written."""
        if self.files and not self.quiet:
            names = ", ".join(path.name for path in self.files)
            self.say([f"Wrote {names} to {self.folder}/ in {time.perf_counter() - self.started:.1f} s."])


@contextmanager
def working(device: str | None, cluster: str | None) -> Iterator[Workers]:
    """Open the workers that were asked for; release them at the end, at once if the work ended early."""
    from mauvecl.runs.pool import LocalWorkers

    if cluster is not None:
        from mauvecl.runs.cluster import DaskWorkers

        workers: Workers = DaskWorkers(cluster, device)
    else:
        workers = LocalWorkers([None] if device is None else [word.strip() for word in device.split(",")])
    try:
        yield workers
    except BaseException:
        workers.stop()
        raise
    finally:
        workers.close()


@contextmanager
def told_of_interrupts(kept: Callable[[], str]) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the work in order, with a sentence of what is kept; exit codes 130 and 143."""

    def terminate(*_: object) -> None:
        raise Terminated

    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, terminate) if main else None
    try:
        yield
    except KeyboardInterrupt as stop:
        terminated = isinstance(stop, Terminated)
        print(f"mauvecl: {'terminated' if terminated else 'interrupted'}; {kept()}", file=sys.stderr)
        sys.exit(143 if terminated else 130)
    finally:
        if main:
            signal.signal(signal.SIGTERM, before)
