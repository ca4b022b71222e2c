"""One call of a command: questions before long runs, workers, progress, and files."""

from __future__ import annotations

import shutil
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

from mauvecl.cli.console import Meter, show, show_view, with_flags, writes_to
from mauvecl.cli.flags import Options
from mauvecl.schema.errors import InputError, of_kind, reworded

if TYPE_CHECKING:
    from mauvecl.answers.answer import Answer
    from mauvecl.device.build import Device
    from mauvecl.runs.checkpoint import Checkpoint
    from mauvecl.runs.cluster import DaskWorkers
    from mauvecl.runs.pool import LocalWorkers, Pool
    from mauvecl.runs.store import Store
    from mauvecl.study.study import Study

#: Drawn spectra above which a run is questioned: they take a year on a hundred cores at the best rate of
#: `bench/results/rates.ecsv`, 6e9 pixels a second and core.
MOST_SPECTRA = 1e16
#: The engine's index of realisations has 63 bits: `Engine._check`.
MOST_REALISATIONS = 2**63 - 1


def question_values(study: Study, *, detects: bool) -> None:
    """Raise InputError for values that a later step would reject; a verb that `detects` needs flares and thresholds."""
    from mauvecl.detection import check_fap, check_statistic
    from mauvecl.host.instrument import instrument_path
    from mauvecl.host.stars.library import known_band, named_star
    from mauvecl.host.tables.files import read_bytes, without_columns
    from mauvecl.study.keywords import is_there

    for star in study.star:
        if star.library is not None:
            named_star(star.library)
        elif star.file is not None and not is_there(str(star.file)):
            read_bytes(without_columns(star.file)[0], "spectrum file")
        known_band(star.band)
    instrument_path(study.observation.instrument, Path())
    if not detects:
        return
    run = study.run
    known_band(study.flare.band)
    for name in run.statistics:
        check_statistic(name)
    check_fap(run.fap, run.realisations, run.tails)


def question_time(study: Study, *, insist: bool) -> None:
    """Raise InputError for a study that no device could finish; `insist` skips this check.

    More realisations than the index can count always raise it.
    """
    count = study.run.realisations
    if count > MOST_REALISATIONS:
        raise InputError.of("realisations", count, f"at most {MOST_REALISATIONS}: the index has 63 bits")
    spectra = count * len(study.star) * study.sweep.size * (1 + len(study.flare.amplitudes))
    if spectra >= MOST_SPECTRA and not insist:
        raise InputError(
            f"realisations = {count:.3g} take {spectra / MOST_SPECTRA:.2g} years on a hundred cores; give fewer, "
            "or --insist to start anyway",
            key="realisations",
        )


def question_room(store: Store, *, insist: bool) -> None:
    """Raise InputError, with the required and the available space, for a store that does not fit on its disk."""
    if insist:
        return
    there = next(folder for folder in (store.path, *store.path.absolute().parents) if folder.is_dir())
    # An unfinished store already has some of its bytes.
    held = sum(path.stat().st_size for path in store.path.glob("star-*/*/c/*/*"))
    free = shutil.disk_usage(there).free + held
    if store.n_bytes > free:
        rows = free // (store.n_bytes // store.rows)
        raise InputError(
            f"realisations = {store.rows} need {_size(store.n_bytes)}, but {str(store.path)!r} has room for "
            f"{_size(free)}; give at most {rows} or another place, or --insist to start anyway",
            key="realisations",
        )


def _size(size: float) -> str:
    for unit in ("bytes", "KiB", "MiB", "GiB", "TiB"):
        if size < 1024:
            return f"{size:.3g} {unit}"
        size /= 1024
    return f"{size:.3g} PiB"


@dataclass(eq=False)
class Session(Options):
    """Session of one call of a verb; in its `with` block, only this process writes to the output folder."""

    verb: str
    study: Study
    draws: bool  # whether a pool draws
    notes: Sequence[str] = ()  # what the flags did not state, which is printed with the messages of the answer
    files: list[Path] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)
    opened: Device | None = None  # device on which something was drawn without a pool, for the run record
    _pool: Pool | None = None
    _checkpoint: Checkpoint | None = None
    _lost: list[InputError] = field(default_factory=list)
    _held: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Release the output folder.

        Raises InputError if a file of the answer could not be written; the answer is printed before.
        """
        self._held.close()
        if kind is None and self._lost:
            others = f"; the same holds for {len(self._lost) - 1} more files of this answer" if self._lost[1:] else ""
            raise reworded(self._lost[0], f"{self._lost[0]}{others}")

    @cached_property
    def folder(self) -> Path:
        """Output folder, which is locked from the first use."""
        from mauvecl.answers.files import make_folder
        from mauvecl.runs.checkpoint import locked

        folder = make_folder(self.output or Path(f"mauvecl-{self.verb}"))
        writes_to(folder)
        self._held.enter_context(locked(folder, "output folder"))
        return folder

    @contextmanager
    def checkpoint(self) -> Iterator[Checkpoint]:
        """Keep finished parts of the work in the output folder, and report interruptions."""
        from mauvecl.runs.checkpoint import Checkpoint

        checkpoint = Checkpoint(self.folder, self.verb, self.study, resume=self.resume, restart=self.restart, held=True)
        with report_interrupts(lambda: self._kept(checkpoint)), checkpoint:
            self.say(checkpoint.messages)
            yield checkpoint
            if checkpoint.damaged:
                self.say(
                    [f"{checkpoint.damaged} files of {str(checkpoint.folder)!r} were damaged and are drawn again."]
                )
        self._checkpoint = checkpoint

    def _load(self) -> None:
        """Import modules for tables and pictures in advance, which saves 0.75 s at the end."""
        from importlib import import_module

        from mauvecl.charts.chart import load
        from mauvecl.charts.matplotlib import available, style

        for name in ("astropy.table", "astropy.io.misc.yaml", "rich.table"):
            import_module(name)
        load()
        if self.pictures and available():
            style()

    def metered(self, unit: str) -> Meter:
        """Return the progress in a unit, for a `with` block."""
        return Meter(quiet=self.quiet or self.as_json, unit=unit)

    def _kept(self, checkpoint: Checkpoint) -> str:
        parts_kept = checkpoint.kept
        if not parts_kept:
            return "nothing was written, and nothing is half written"
        parts = f"{parts_kept} part{'s' if parts_kept > 1 else ''} of the work"
        return f"{parts} kept in {str(checkpoint.folder)!r}, and the same command with --resume continues from there"

    def say(self, lines: Sequence[str]) -> None:
        """Print messages, unless standard output is reserved for JSON."""
        if lines and not self.as_json:
            show([with_flags(line) for line in lines])

    def leave(self, write: Callable[[], Path | Sequence[Path]]) -> None:
        """Write files; failures are reported at the end, after the answer is printed."""
        try:
            made = write()
        except InputError as error:
            self._lost.append(error)
            return
        self.files += [made] if isinstance(made, Path) else made

    def ask(self) -> Any:
        """Return the answer of the session's verb to its study, with the progress of what the verb counts."""
        from mauvecl.answers.verbs import VERBS

        verb = VERBS[self.verb]
        if not verb.counts:
            return verb.ask(self.study)
        if not self.draws:
            with self.metered(verb.counts) as meter:
                return verb.ask(self.study, progress=meter)
        from mauvecl.runs.pool import Pool

        # The pool reports its own progress in realisations.
        own = verb.counts == "realisations"
        with (
            self.checkpoint() as checkpoint,
            self.metered(verb.counts) as meter,
            working(self.device, self.cluster) as workers,
        ):
            pool = Pool(workers, checkpoint=checkpoint, progress=meter if own else None, meanwhile=self._load)
            self._pool, meter.standing = pool, lambda: pool.standing
            return verb.ask(self.study, pool, None if own else meter)

    def answer(self, answer: Answer) -> None:
        """Print an answer and write its files."""
        with report_interrupts(self._written):
            self._leave_all(answer)
        # A note on sampled thresholds is left out where the answer has its own.
        told = of_kind(self.notes, "sampled") if of_kind(answer.messages, "sampled") else []
        notes = [note for note in self.notes if note not in told]
        if self.as_json:
            content = answer.as_json()
            said = [with_flags(line) for line in (*notes, *content.pop("messages"))]
            self.print_json({"headline": answer.headline, "assumed": answer.assumed, "messages": said} | content)
            return
        self.say([answer.headline])
        left_out = [show_view(view, wide=self.wide) for view in answer.all_views]
        self.say(["Assumed:", *(f"  {clause}" for clause in answer.premises)])
        self.say([*notes, *answer.messages, *answer.remarks])
        if any(left_out):
            self.say(["Tables are shown without details: `--wide` shows all columns, and the files hold them."])
        if self.files and not self.quiet:
            names = ", ".join(path.name for path in self.files)
            self.say([f"Wrote {names} to {self.folder}/ in {time.perf_counter() - self.started:.1f} s."])

    def _leave_all(self, answer: Answer) -> None:
        """Write tables, documents and pictures of an answer, its study and the run record; remove the checkpoint."""
        from mauvecl.answers.files import write_document, write_record, write_table
        from mauvecl.charts.matplotlib import available

        for name, table in answer.files.items():
            self.leave(partial(write_table, table, self.folder / name))
        for name, content in answer.documents.items():
            self.leave(partial(write_document, content, self.folder / name))
        if self.pictures and available():
            for name, draw in answer.pictures.items():
                self.leave(partial(draw, self.folder / f"{name}.png"))
        elif self.pictures and not self.quiet:
            self.say(["No pictures: matplotlib is missing, `pip install 'mauvecl[plot]'` brings it."])
        study = answer.study
        if self.folder / "study.toml" not in self.files:
            self.leave(partial(write_document, study.toml().encode, self.folder / "study.toml"))
        seconds, messages = time.perf_counter() - self.started, [*answer.messages, *answer.remarks]
        how: dict[str, Any] = {"pool": self._pool, "opened": self.opened, "seconds": seconds, "messages": messages}
        # Only a complete answer replaces another's files.
        how |= {"files": self.files, "whole": not self._lost}
        data = study.model_dump(mode="json", exclude_none=True)
        self.leave(lambda: write_record(self.verb, data, answer.inputs, self.folder, **how))
        if self._checkpoint is not None and not self._lost:
            self._checkpoint.forget()

    def _written(self) -> str:
        """Describe what an interruption leaves while files are written."""
        whole = ", ".join(path.name for path in self.files) or "nothing"
        parts_kept = None if self._checkpoint is None else self._checkpoint.kept
        again = "the same command with --resume" if parts_kept else "the same command"
        return f"{whole} written to {str(self.folder)!r}, each file whole, and {again} writes all of them"

    def print_json(self, content: dict[str, Any]) -> None:
        """Print the answer as JSON."""
        from mauvecl.host.tables.files import json_text

        print(json_text(content))


@contextmanager
def working(device: str | None, cluster: str | None) -> Iterator[LocalWorkers | DaskWorkers]:
    """Open the requested workers; release them at the end, immediately if the work ended early."""
    from mauvecl.runs.pool import LocalWorkers

    if cluster is not None:
        from mauvecl.runs.cluster import DaskWorkers

        workers: LocalWorkers | DaskWorkers = DaskWorkers(cluster, device)
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
def report_interrupts(message: Callable[[], str]) -> Iterator[None]:
    """Stop the work in order at Ctrl-C and SIGTERM, with a message on kept results; exit codes 130 and 143."""
    terminated = False

    def terminate(*_: object) -> None:
        # Sent at the time limit of a batch job or at shutdown.
        nonlocal terminated
        terminated = True
        raise KeyboardInterrupt

    main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGTERM, terminate) if main else None
    try:
        yield
    except KeyboardInterrupt:
        print(f"mauvecl: {'terminated' if terminated else 'interrupted'}; {message()}", file=sys.stderr)
        sys.exit(143 if terminated else 130)
    finally:
        if main:
            signal.signal(signal.SIGTERM, before)
