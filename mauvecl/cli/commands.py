"""Commands with a study file and flags, of verbs and of stores of raw spectra, and the session of one call."""

from __future__ import annotations

import inspect
import json
import shutil
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from mauvecl.answers.verbs import DRAWS, FEWER, OBSERVATION, VERBS, Verb
from mauvecl.cli import console, flags
from mauvecl.cli.console import Meter, show, show_view, with_flags
from mauvecl.schema.columns import Column, View
from mauvecl.schema.errors import InputError, counted, of_kind
from mauvecl.schema.fields import FirstRealisation

if TYPE_CHECKING:
    from mauvecl.answers.answer import Answer
    from mauvecl.device.build import Device
    from mauvecl.runs.checkpoint import Checkpoint
    from mauvecl.runs.cluster import DaskWorkers
    from mauvecl.runs.pool import LocalWorkers, Pool
    from mauvecl.runs.store import Store
    from mauvecl.study.study import Keyword, Study

#: Drawn spectra above which a run is questioned: they take a year on a hundred cores at the best rate of
#: `bench/results/rates.ecsv`, 6e9 pixels a second and core.
MOST_SPECTRA = 1e16


def check_question(study: Study, *, detects: bool, draws: bool, insist: bool) -> None:
    """Raise InputError for values that a later step would reject, or that would keep a hundred cores busy for a year.

    A verb that `detects` needs flares and thresholds; `insist` lets one that `draws` take any time.
    """
    from mauvecl.detection import check_fap, check_statistic
    from mauvecl.host.instrument import instrument_path
    from mauvecl.host.stars.library import known_band, named_star
    from mauvecl.host.tables.files import read_bytes, without_columns
    from mauvecl.study.study import is_there

    for star in study.star:
        if star.library is not None:
            named_star(star.library)
        elif star.file is not None and not is_there(str(star.file)):
            read_bytes(without_columns(star.file)[0], "spectrum file")
        known_band(star.band)
    instrument_path(study.observation.instrument, Path())
    run, count = study.run, study.run.realisations
    if detects:
        known_band(study.flare.band)
        for name in run.statistics:
            check_statistic(name)
        check_fap(run.fap, count, run.tails)
    spectra = count * len(study.star) * study.sweep.size * (1 + len(study.flare.amplitudes))
    if draws and spectra >= MOST_SPECTRA and not insist:
        raise InputError(
            f"realisations = {count:.3g} take {spectra / MOST_SPECTRA:.2g} years on a hundred cores; give fewer, "
            "or --insist to start anyway",
            key="realisations",
        )


def check_room(store: Store, *, insist: bool) -> None:
    """Raise InputError, with the required and the available space, for a store that does not fit on its disk."""
    if insist:
        return
    folder = next(folder for folder in (store.path, *store.path.absolute().parents) if folder.is_dir())
    # An unfinished store already has some of its bytes.
    written = sum(path.stat().st_size for path in store.path.glob("star-*/*/c/*/*"))
    free = shutil.disk_usage(folder).free + written
    if store.n_bytes > free:
        rows = free // (store.n_bytes // store.rows)
        raise InputError(
            f"realisations = {store.rows} need {store.n_bytes / 2**20:,.0f} MiB, but {str(store.path)!r} has room for "
            f"{free / 2**20:,.0f} MiB; give at most {rows} or another place, or --insist to start anyway",
            key="realisations",
        )


@dataclass(eq=False)
class Session(flags.Options):
    """Session of one call of a verb, during which only this process writes to the output folder."""

    verb: str
    study: Study
    flag_values: Mapping[str, Any]  # of the flags of keys, None where they are not given
    resources: ExitStack  # releases the output folder
    draws: bool  # whether a pool draws
    notes: Sequence[str] = ()  # messages on what the flags did not state, printed with those of the answer
    files: list[Path] = field(default_factory=list)
    started: float = field(default_factory=time.perf_counter)
    opened: Device | None = None  # device on which something was drawn without a pool, for the run record
    _pool: Pool | None = None
    _checkpoint: Checkpoint | None = None
    _lost: list[InputError] = field(default_factory=list)

    def report_lost(self) -> None:
        """Raise InputError if files of the answer could not be written."""
        if self._lost:
            first, n_more = self._lost[0], len(self._lost) - 1
            more = f"; the same holds for {n_more} more files of this answer" if n_more else ""
            raise InputError(f"{first}{more}", key=first.key)

    @cached_property
    def folder(self) -> Path:
        """Output folder, which is locked from the first use."""
        from mauvecl.answers.answer import make_folder
        from mauvecl.runs.checkpoint import locked

        folder = make_folder(self.output or Path(f"mauvecl-{self.verb}"))
        console.folder = folder
        self.resources.enter_context(locked(folder, "output folder"))
        return folder

    @contextmanager
    def checkpoint(self) -> Iterator[Checkpoint]:
        """Keep finished parts of the work in the output folder, and report interruptions."""
        from mauvecl.runs.checkpoint import Checkpoint

        def saved() -> str:
            if not checkpoint.kept:
                return "nothing was written, and nothing is half written"
            parts = f"{counted(checkpoint.kept, 'part')} of the work kept"
            return f"{parts} in {str(checkpoint.folder)!r}, and the same command with --resume continues from there"

        checkpoint = Checkpoint(self.folder, self.verb, self.study, resume=self.resume, restart=self.restart, held=True)
        with report_interrupts(saved), checkpoint:
            self.say(checkpoint.messages)
            yield checkpoint
            if damaged := checkpoint.damaged:
                self.say([f"{damaged} files of {str(checkpoint.folder)!r} were damaged and are drawn again."])
        self._checkpoint = checkpoint

    def say(self, lines: Sequence[str]) -> None:
        """Print messages, unless standard output is reserved for JSON."""
        if lines and not self.as_json:
            show([with_flags(line) for line in lines])

    def write_file(self, write: Callable[[], Path]) -> None:
        """Write a file; failures are reported at the end, after the answer is printed."""
        try:
            self.files.append(write())
        except InputError as error:
            self._lost.append(error)

    def ask(self) -> Any:
        """Return the verb's answer to the study, and show the progress of what the verb counts."""
        verb = VERBS[self.verb]
        if not verb.counts:
            return verb.ask(self.study)
        if not self.draws:
            with Meter(quiet=self.quiet or self.as_json, unit=verb.counts) as meter:
                return verb.ask(self.study, progress=meter)

        def prepare() -> None:
            # Modules for tables and pictures are imported in advance, which saves 0.75 s at the end.
            from mauvecl.charts.matplotlib import available, load, style

            for name in ("astropy.table", "astropy.io.misc.yaml", "rich.table"):
                import_module(name)
            load()
            if self.pictures and available():
                style()

        with (
            self.checkpoint() as checkpoint,
            self.pool(verb.counts, checkpoint=checkpoint, meanwhile=prepare) as (self._pool, meter),
        ):
            return verb.ask(self.study, self._pool, None if verb.counts == "realisations" else meter)

    @contextmanager
    def pool(self, counts: str, **options: Any) -> Iterator[tuple[Pool, Meter]]:
        """Yield a pool of the workers that the flags name, and its meter; the workers stop if the work ends early.

        The pool reports progress in realisations; the caller reports anything else that the meter `counts`.
        """
        from mauvecl.runs.pool import LocalWorkers, Pool

        with Meter(quiet=self.quiet or self.as_json, unit=counts) as meter:
            if self.cluster is not None:
                from mauvecl.runs.cluster import DaskWorkers

                workers: LocalWorkers | DaskWorkers = DaskWorkers(self.cluster, self.device)
            else:
                words = [] if self.device is None else self.device.split(",")
                workers = LocalWorkers([word.strip() for word in words] or [None])
            with closing(workers):
                pool = Pool(workers, progress=meter if counts == "realisations" else None, **options)
                meter.standing = lambda: pool.standing
                yield pool, meter

    def answer(self, answer: Answer) -> None:
        """Print an answer and write its files."""

        def written() -> str:
            names = ", ".join(path.name for path in self.files) or "nothing"
            flag = " with --resume" if self._checkpoint is not None and self._checkpoint.kept else ""
            place = f"written to {str(self.folder)!r}, each file whole"
            return f"{names} {place}, and the same command{flag} writes all of them"

        with report_interrupts(written):
            self._write_all(answer)
        # A note on sampled thresholds is left out where the answer has its own.
        repeated = of_kind(self.notes, "sampled") if of_kind(answer.messages, "sampled") else []
        notes = [note for note in self.notes if note not in repeated]
        if self.as_json:
            content = answer.as_json()
            messages = [with_flags(line) for line in (*notes, *content.pop("messages"))]
            self.print_json({"headline": answer.headline, "assumed": answer.assumed, "messages": messages} | content)
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

    def _write_all(self, answer: Answer) -> None:
        """Write tables, documents and pictures of an answer, its study and the run record; remove the checkpoint."""
        from mauvecl.answers.answer import write_record
        from mauvecl.charts.matplotlib import available

        writers = answer.writers
        if self.pictures and available():
            writers |= {f"{name}.png": draw for name, draw in answer.pictures.items()}
        elif self.pictures and not self.quiet:
            self.say(["No pictures: matplotlib is missing, `pip install 'mauvecl[plot]'` brings it."])
        for name, write in writers.items():
            self.write_file(partial(write, self.folder / name))
        data = answer.study.model_dump(mode="json", exclude_none=True)
        about: dict[str, Any] = {"pool": self._pool, "opened": self.opened, "files": self.files}
        about |= {"seconds": time.perf_counter() - self.started, "messages": [*answer.messages, *answer.remarks]}
        # Only a complete answer replaces another's files.
        about["whole"] = not self._lost
        self.write_file(partial(write_record, self.verb, data, answer.inputs, self.folder, **about))
        if self._checkpoint is not None and not self._lost:
            self._checkpoint.forget()

    def print_json(self, content: dict[str, Any]) -> None:
        """Print the answer as JSON."""
        from mauvecl.host.tables.files import json_text

        print(json_text(content))


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


@dataclass(frozen=True, kw_only=True)
class Command:
    """Command with a study file and flags, which are built when it is called."""

    verb: Verb
    run: Callable[..., None]  # receives the session of the study, and options of its own
    draws: bool  # whether workers draw realisations
    resumes: bool = False  # whether a verb that draws no realisations can be resumed
    pictures: bool = True
    writes: str = ""  # default output, if it is not a folder of tables

    def build(self) -> Callable[..., None]:
        """Return the function that typer calls."""
        from mauvecl.study.study import keys_of

        verb = self.verb
        keywords = {keyword.name: keyword for keyword in keys_of(verb.keys)}
        kinds = get_type_hints(self.run, localns={"Session": Any}, include_extras=True)
        _, *parameters_of_run = inspect.signature(self.run).parameters.values()
        other = next((f", or {noun}" for flag, (noun, *_) in flags.PLACES.items() if flag in keywords and noun), "")
        argument = typer.Argument(
            help=f"Study (TOML), the ECSV table of an answer{other}; flags override it.",
            show_default=False,
            autocompletion=flags.complete_study,
        )
        # Annotations and defaults by parameter.
        options: dict[str, tuple[Any, Any]] = {
            "study_file": (Annotated[Path | None, argument], None),
            **{name: (flags.study_option(keyword, verb.defaults or {}), None) for name, keyword in keywords.items()},
            "setting": (flags.SetFlag, None),
            **({"paper": (flags.PaperFlag, False)} if verb.accepts("observation.instrument") else {}),
            **{p.name: (kinds[p.name], p.default) for p in parameters_of_run},
            **self._options(),
            "help_all": (Annotated[bool, flags.HELP_ALL], False),
        }

        def command(study_file: Path | None = None, **values: Any) -> None:
            del values["help_all"]
            self._call(study_file, keywords, values)

        parameters = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
            for name, (kind, default) in options.items()
        ]
        command.__name__ = verb.name
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {name: kind for name, (kind, _) in options.items()}
        return command

    def _call(self, study_file: Path | None, keywords: dict[str, Keyword], values: dict[str, Any]) -> None:
        """Run the command with the values of its flags and of its other options."""
        from mauvecl.study.study import Study

        flag_values = {name: flags.numbers_of(keyword, values.pop(name)) for name, keyword in keywords.items()}
        for value in flag_values.get("amplitude") or ():
            if not isinstance(value, str) and value >= 1:
                rise = f"--amplitude {value} is a rise of {100 * value:g} %"
                warnings.warn(f"{rise}; --amplitude {value}% is one of {value} %", stacklevel=2)
        flag_values |= {name: values.pop(name, None) for name in ("setting", "paper")}
        for key, (_, plural, applies) in flags.PLACES.items():
            # A file that is no study is for the flag that takes such files.
            if study_file is not None and key in flag_values and applies(study_file):
                if flag_values[key]:
                    fault = f"{str(study_file)!r} and --{key} are both {plural}, but only one may be given"
                    raise InputError(fault, key=key)
                flag_values[key] = [str(study_file)] if applies is flags.is_star else study_file
                study_file = None
        options = {name: values.pop(name) for name in self._options()}
        read = None if study_file is None else Study.read(study_file)
        study, messages = self.verb.study_of(flag_values, keywords, read, "command line")
        detects = {"fap", "realisations"} <= keywords.keys()
        check_question(study, detects=detects, draws=self.draws, insist=options.get("insist", False))
        with ExitStack() as resources:
            session = Session(self.verb.name, study, flag_values, resources, self.draws, messages, **options)
            try:
                self.run(session, **values)
            except InputError:
                # No answer shows them.
                session.say(session.notes)
                raise
            session.report_lost()

    def _options(self) -> dict[str, tuple[Any, Any]]:
        """Return the options of the session, with their defaults."""
        default = self.writes or f"the folder mauvecl-{self.verb.name}"
        output = flags.option("--output", "-o", metavar="PATH", text=f"Where to write [{default}].")
        workers = flags.WORKERS if self.draws else flags.RESUMING if self.resumes else ()
        names = ("as_json", "quiet", "wide", *(["pictures"] if self.pictures else []), *workers)
        kinds = get_type_hints(flags.Options, include_extras=True)
        return {"output": (Annotated[Path | None, output], None)} | {
            name: (kinds[name], getattr(flags.Options, name)) for name in names
        }


Rows = Annotated[str | None, flags.option(metavar="TEXT", text="Realisations, such as 1000:2000, without the last.")]


def realise(session: Session) -> None:
    """Draw raw spectra in bulk: a Zarr store, a FITS or HDF5 file.

    One file holds fewer than 4 GiB. An array per star and flare, a row per realisation, with calibration, units and
    the study. An interrupted run keeps its rows: --resume draws the rest.

    Examples: mauvecl realise study.toml -n 10000 --output frames.zarr

    mauvecl realise --star G2V --magnitude 7.4 --amplitude 0.24 --exposure 5 -n 1000 --output frames.fits
    """
    from mauvecl.runs import bulk
    from mauvecl.runs.store import Store

    place = session.output or Path("mauvecl-frames.zarr")
    one_file = place.suffix in bulk.ENDINGS
    if not one_file and place.suffix not in ("", ".zarr"):
        raise InputError.of("output", str(place), f"a name ending in .zarr, {', '.join(bulk.ENDINGS)}")
    folder = bulk.unfinished(place) if one_file else place
    check_room(Store(folder, session.study), insist=session.insist)
    with (
        report_interrupts(lambda: f"what was written to {str(folder)!r} is kept, and --resume draws the rest"),
        session.pool("spectra") as (pool, meter),
    ):
        draw = bulk.realise_file if one_file else bulk.realise
        store = draw(session.study, place, pool, resume=session.resume, restart=session.restart, progress=meter)
    _show_store(store, place, session)


def _show_store(store: Store, place: Path, session: Session) -> None:
    """Print what a written store holds, as text or as JSON."""
    from mauvecl.runs.store import ARRAY_COLUMNS
    from mauvecl.study.cases import assumptions_of, collect_messages

    messages = collect_messages([scene.expectation for scene in store.scenes], store.study.processes)
    clauses = assumptions_of(store.study, ("instrument", "sky", "flare", "processes", "sweep", "seed"))
    assumed = f"Assumed: {'; '.join(clauses)}."
    session.say([*messages, assumed])
    rows = [
        {"array": scene.path, "star": scene.star, "amplitude": scene.amplitude, "shape": [store.rows, *scene.row],
         "type": scene.dtype.name} for scene in store.scenes
    ]  # fmt: skip
    if session.as_json:
        session.print_json(
            {"assumed": assumed, "messages": messages, "store": str(place), "bytes": store.n_bytes, "arrays": rows}
        )
        return
    title = (
        f"Raw spectra, DN; seed {store.study.run.seed}. Rows of the same number share their random numbers, rows of "
        "different number are independent."
    )
    show_view(View(title, ARRAY_COLUMNS, rows))
    if not session.quiet:
        seconds = time.perf_counter() - session.started
        session.say([f"Wrote {store.n_bytes / 2**20:.0f} MiB to {place} in {seconds:.1f} s."])


def verify(
    store: Annotated[
        Path, typer.Argument(help="Store that `mauvecl realise` wrote, or output folder of any other verb.")
    ],
    repair: Annotated[bool, typer.Option("--repair", help="Redraw damaged frames, bit for bit.")] = False,
    redraw: Annotated[
        bool, typer.Option("--redraw", help="Redraw and compare every spectrum, not only the digests.")
    ] = False,
    rows: Rows = None,
    device: flags.DeviceFlag = None,
    as_json: flags.JsonFlag = False,
    quiet: flags.QuietFlag = False,
) -> None:
    """Check that a store or an answer's folder is as it was written.

    In a store, finds flipped bytes, missing and foreign chunks, and can repair them. In the output folder of another
    verb, finds files that were changed or removed, by the digests in its run.json.

    Exit code 1 if anything is wrong and not repaired.

    Example: mauvecl verify frames.zarr --repair
    """
    from mauvecl.answers.answer import FAULT_COLUMNS, is_answer, verify_answer

    if is_answer(store):
        if repair or redraw or rows is not None:
            text = f"{str(store)!r} is the folder of an answer, but --repair, --redraw and --rows are for stores; "
            raise InputError(f"{text}give the command of the answer with --restart to write it again", key="store")
        faults: Sequence[Any] = verify_answer(store)
        columns: Sequence[Column] = FAULT_COLUMNS
        n_left = len(faults)
        outcome = "" if faults else "Every file agrees with the run record, and the record with its own digest."
    else:
        from mauvecl.device.engine import Engine
        from mauvecl.runs import bulk

        engine = Engine(device) if repair or redraw else None
        with Meter(quiet=quiet or as_json, unit="chunks") as meter:
            faults = bulk.verify(store, engine, repair=repair, redraw=redraw, rows=_rows_of(rows), progress=meter)
        columns, n_left = bulk.FAULT_COLUMNS, sum(not fault.mended for fault in faults)
        sound = f"Everything agrees with what {'the engine draws' if redraw else 'was written'}."
        outcome = f"{len(faults) - n_left} repaired, {n_left} left as found." if faults else sound
    rows_of_faults = [asdict(fault) for fault in faults]
    if as_json:
        print(json.dumps(rows_of_faults, indent=2))
    elif faults:
        show_view(View(f"Not as it was written: {store}", columns, rows_of_faults))
    if outcome and not as_json:
        show([outcome])
    if n_left:
        raise typer.Exit(1)


def export(
    store: Annotated[Path, typer.Argument(help="Store that `mauvecl realise` wrote.")],
    file: Annotated[Path, typer.Argument(help="Ending in .fits, .h5 or .hdf5.")],
    array: Annotated[
        list[str] | None, flags.option("--array", metavar="TEXT", text="Such as star-1/flare-2; may be repeated [all].")
    ] = None,
    rows: Rows = None,
    replace: flags.ReplaceFlag = False,
    quiet: flags.QuietFlag = False,
) -> None:
    """Write a part of a store as one FITS or HDF5 file.

    Example: mauvecl export frames.zarr some.fits --array star-1/quiescent --rows 0:1000
    """
    from mauvecl.runs import bulk
    from mauvecl.runs.store import Store

    bulk.export(bulk.Selection.of(Store.open(store), array, _rows_of(rows)), file, replace=replace)
    if not quiet:
        show([f"Wrote {file}, {file.stat().st_size / 2**20:.1f} MiB."])


def _rows_of(text: str | None) -> tuple[int, int] | None:
    """Read a range of rows, such as 1000:2000."""
    if text is None:
        return None
    first, _, stop = text.partition(":")
    try:
        return int(first), int(stop)
    except ValueError as error:
        raise InputError.of("rows", text, "a range such as 1000:2000") from error


def limit(
    session: Session,
    assumptions: Annotated[
        bool, typer.Option("--assumptions", help="Also show how much each assumed instrument value changes the limit.")
    ] = False,
) -> None:
    """Search for limits, and vary the assumptions about the instrument if `assumptions` is set."""
    answer = session.ask()
    if assumptions:
        from mauvecl.answers.limit import what_matters

        answer.assumptions = what_matters(session.study)
    session.answer(answer)


def simulate(
    session: Session,
    realisation: Annotated[str, typer.Option(metavar="INTEGER", help="Which realisation to show.")] = "0",
) -> None:
    """Draw a realisation, with flares if a flag names their amplitude."""
    from mauvecl.answers.signal import simulate as compute
    from mauvecl.schema.calls import checked
    from mauvecl.schema.section import number_or_text

    number = checked(FirstRealisation, "--realisation", number_or_text(realisation))
    session.answer(compute(session.study, realisation=number, flaring=bool(session.flag_values["amplitude"])))


def plan(session: Session) -> None:
    """Plan a campaign; a report needs matplotlib for PDF, and a closed form needs no pool."""
    from mauvecl.charts.matplotlib import available

    if session.study.plan.report == "pdf" and not available():
        session.study = session.study.with_settings(["plan.report=html"])
        session.say(["The report is HTML: matplotlib is missing, `pip install 'mauvecl[plot]'` brings it."])
    session.draws = session.study.plan.completeness != "closed form"
    session.answer(session.ask())


def stare(session: Session, device: flags.DeviceFlag = None) -> None:
    """Draw stares on one device, which keeps their frames for a resume."""
    from mauvecl.answers.stare import stare as compute
    from mauvecl.device.stares import Stares

    values = session.flag_values
    if values["energy"] and (values["amplitude"] or values["flares"]):
        raise InputError("only one of --energy, --amplitude and --flares may be given", key="energy")

    stares = Stares(device)
    session.opened = stares.open_device
    with session.checkpoint() as checkpoint:
        answer = compute(session.study, stares, checkpoint=checkpoint)
    session.answer(answer)


def ask(session: Session) -> None:
    """Compute the answer, and print it."""
    session.answer(session.ask())


REALISE = Verb(
    "realise",
    "",
    (*OBSERVATION, "flare", *DRAWS, "nuisances.usual", "sweep", "bulk"),
    group="simulate",
    common=("realisations", "seed", "frames", "components", "resume"),
    counts="spectra",
    defaults=FEWER,
)
#: Functions of the verbs that do more than `ask`.
OWN: dict[str, Callable[..., None]] = {"limit": limit, "simulate": simulate, "plan": plan, "stare": stare}
#: Commands with a study by name; an analysis counts frames, and draws nothing.
COMMANDS = {
    name: Command(
        verb=verb, run=OWN.get(name, ask), draws=bool(verb.counts) and name not in ("analyse", "stare"),
        resumes=name == "stare",
    )
    for name, verb in VERBS.items()
} | {
    "realise": Command(
        verb=REALISE, run=realise, draws=True, pictures=False, writes="mauvecl-frames.zarr; also NAME.fits, .h5, .hdf5"
    )
}  # fmt: skip
