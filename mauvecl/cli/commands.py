"""Commands with a study file and flags: of verbs, and of stores of raw spectra."""

from __future__ import annotations

import inspect
import json
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from mauvecl.answers.verbs import DRAWS, FEWER, OBSERVATION, VERBS, Verb
from mauvecl.cli import flags
from mauvecl.cli.console import Meter, show, show_view
from mauvecl.schema.columns import Column, View
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Range

if TYPE_CHECKING:
    from mauvecl.cli.invocation import Session
    from mauvecl.runs.store import Store
    from mauvecl.study.keywords import Keyword


@dataclass(frozen=True, kw_only=True)
class Command:
    """Command with a study file and flags, which are built when it is called."""

    verb: Verb
    run: Callable[..., None]  # receives the session of the study; `given` are the flags, others are options of its own
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
        _, *own = inspect.signature(self.run).parameters.values()
        other = next((f", or {what}" for flag, (what, *_) in flags.PLACES.items() if flag in keywords and what), "")
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
            **{p.name: (kinds[p.name], p.default) for p in own if p.name != "given"},
            **self._options(),
            "help_all": (Annotated[bool, flags.HELP_ALL], False),
        }

        def command(study_file: Path | None = None, **values: Any) -> None:
            del values["help_all"]
            self._call(study_file, keywords, values)

        parameters = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=usual, annotation=kind)
            for name, (kind, usual) in options.items()
        ]
        command.__name__ = verb.name
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {name: kind for name, (kind, _) in options.items()}
        return command

    def _call(self, study_file: Path | None, keywords: dict[str, Keyword], values: dict[str, Any]) -> None:
        """Run the command with the values of its flags and of its other options."""
        from mauvecl.cli.invocation import Session, question_time, question_values
        from mauvecl.study.study import Study

        given = {name: flags.numbers_of(keyword, values.pop(name)) for name, keyword in keywords.items()}
        for value in given.get("amplitude") or ():
            if not isinstance(value, str) and value >= 1:
                rise = f"--amplitude {value} is a rise of {100 * value:g} %"
                warnings.warn(f"{rise}; --amplitude {value}% is one of {value} %", stacklevel=2)
        given |= {name: values.pop(name, None) for name in ("setting", "paper")}
        for key, (_, plural, applies) in flags.PLACES.items():
            # A file that is no study is for the flag that takes such files.
            if study_file is not None and key in given and applies(study_file):
                if given[key]:
                    fault = f"{str(study_file)!r} and --{key} are both {plural}, but only one may be given"
                    raise InputError(fault, key=key)
                given[key] = [str(study_file)] if applies is flags.is_star else study_file
                study_file = None
        how = {name: values.pop(name, usual) for name, (_, usual) in self._options().items()}
        if "given" in inspect.signature(self.run).parameters:
            values["given"] = given
        own = None if study_file is None else Study.read(study_file)
        study, messages = self.verb.study_of(given, keywords, own, "command line")
        question_values(study, detects={"fap", "realisations"} <= keywords.keys())
        if self.draws:
            question_time(study, insist=how["insist"])
        with Session(self.verb.name, study, draws=self.draws, notes=messages, **how) as session:
            self.run(session, **values)

    def _options(self) -> dict[str, tuple[Any, Any]]:
        """Return the options of the session, with their defaults."""
        output = flags.output_option(self.writes or f"the folder mauvecl-{self.verb.name}")
        workers = flags.WORKERS if self.draws else flags.RESUMING if self.resumes else ()
        names = ("as_json", "quiet", "wide", *(["pictures"] if self.pictures else []), *workers)
        kinds = get_type_hints(flags.Options, include_extras=True)
        return {"output": (Annotated[Path | None, output], None)} | {
            name: (kinds[name], getattr(flags.Options, name)) for name in names
        }


#: Commands with a study by name, filled by `command_of`.
COMMANDS: dict[str, Command] = {}


def command_of(
    verb: Verb, *, draws: bool | None = None, **how: Any
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a function of the session the command of a verb; workers draw by default if the verb counts something."""

    def decorate(run: Callable[..., None]) -> Callable[..., None]:
        COMMANDS[verb.name] = Command(verb=verb, run=run, draws=bool(verb.counts) if draws is None else draws, **how)
        return run

    return decorate


RowsFlag = Annotated[
    str | None, flags.option(metavar="TEXT", text="Realisations, such as 1000:2000, without the last.")
]


@command_of(
    Verb(
        "realise",
        "",
        (*OBSERVATION, "flare", *DRAWS, "nuisances.usual", "sweep", "bulk"),
        group="simulate",
        common=("realisations", "seed", "frames", "components", "resume"),
        counts="spectra",
        defaults=FEWER,
    ),
    pictures=False,
    writes="mauvecl-frames.zarr; also NAME.fits, .h5, .hdf5",
)
def realise(session: Session) -> None:
    """Draw raw spectra in bulk: a Zarr store, a FITS or HDF5 file.

    One file holds fewer than 4 GiB. An array per star and flare, a row per realisation, with calibration, units and
    the study. An interrupted run keeps its rows: --resume draws the rest.

    Examples: mauvecl realise study.toml -n 10000 --output frames.zarr

    mauvecl realise --star G2V --magnitude 7.4 --amplitude 0.24 --exposure 5 -n 1000 --output frames.fits
    """
    from mauvecl.cli.invocation import question_room, report_interrupts, working
    from mauvecl.runs import bulk
    from mauvecl.runs.store import Store

    place = session.output or Path("mauvecl-frames.zarr")
    one_file = place.suffix in bulk.ENDINGS
    if not one_file and place.suffix not in ("", ".zarr"):
        raise InputError.of("output", str(place), f"a name ending in .zarr, {', '.join(bulk.ENDINGS)}")
    folder = bulk.unfinished(place) if one_file else place
    question_room(Store(folder, session.study), insist=session.insist)
    with (
        report_interrupts(lambda: f"what was written to {str(folder)!r} is kept, and --resume draws the rest"),
        session.metered("spectra") as meter,
        working(session.device, session.cluster) as workers,
    ):
        from mauvecl.runs.pool import Pool

        pool = Pool(workers)
        meter.standing = lambda: pool.standing
        draw = bulk.realise_file if one_file else bulk.realise
        store = draw(session.study, place, pool, resume=session.resume, restart=session.restart, progress=meter)
    _tell(store, place, session)


def _tell(store: Store, place: Path, session: Session) -> None:
    from mauvecl.runs.store import ARRAY_COLUMNS
    from mauvecl.study.cases import assumptions_of, collect_messages

    messages = collect_messages([scene.expectation for scene in store.scenes], store.study.processes)
    clauses = assumptions_of(store.study, ("instrument", "sky", "flare", "processes", "seed"))
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
    rows: RowsFlag = None,
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
    from mauvecl.answers.files import FAULT_COLUMNS, is_answer, verify_answer

    if is_answer(store):
        if repair or redraw or rows is not None:
            text = f"{str(store)!r} is the folder of an answer, but --repair, --redraw and --rows are for stores; "
            raise InputError(f"{text}give the command of the answer with --restart to write it again", key="store")
        faults: Sequence[Any] = verify_answer(store)
        columns: Sequence[Column] = FAULT_COLUMNS
        left = len(faults)
        outcome = "" if faults else "Every file agrees with the run record, and the record with its own digest."
    else:
        from mauvecl.device.engine import Engine
        from mauvecl.runs import bulk

        engine = Engine(device) if repair or redraw else None
        with Meter(quiet=quiet or as_json, unit="chunks") as meter:
            faults = bulk.verify(store, engine, repair=repair, redraw=redraw, rows=_rows_of(rows), progress=meter)
        columns, left = bulk.FAULT_COLUMNS, sum(not fault.mended for fault in faults)
        whole = f"Everything agrees with what {'the engine draws' if redraw else 'was written'}."
        outcome = f"{len(faults) - left} repaired, {left} left as found." if faults else whole
    found = [asdict(fault) for fault in faults]
    if as_json:
        print(json.dumps(found, indent=2))
    elif found:
        show_view(View(f"Not as it was written: {store}", columns, found))
    if outcome and not as_json:
        show([outcome])
    if left:
        raise typer.Exit(1)


def export(
    store: Annotated[Path, typer.Argument(help="Store that `mauvecl realise` wrote.")],
    file: Annotated[Path, typer.Argument(help="Ending in .fits, .h5 or .hdf5.")],
    array: Annotated[
        list[str] | None, flags.option("--array", metavar="TEXT", text="Such as star-1/flare-2; may be repeated [all].")
    ] = None,
    rows: RowsFlag = None,
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
    if text is None:
        return None
    first, _, stop = text.partition(":")
    try:
        return int(first), int(stop)
    except ValueError as error:
        raise InputError.of("rows", text, "a range such as 1000:2000") from error


@command_of(VERBS["limit"])
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


@command_of(VERBS["simulate"])
def simulate(
    session: Session,
    given: dict[str, Any],
    realisation: Annotated[str, typer.Option(metavar="INTEGER", help="Which realisation to show.")] = "0",
) -> None:
    """Draw a realisation, with flares if a flag names their amplitude."""
    from mauvecl.answers.signal import simulate as compute

    number = flags.whole_number(realisation, "--realisation", Range(0, 2**63 - 1))
    session.answer(compute(session.study, realisation=number, flaring=bool(given["amplitude"])))


@command_of(VERBS["plan"])
def plan(session: Session) -> None:
    """Plan a campaign; a report needs matplotlib for PDF, and a closed form needs no pool."""
    from mauvecl.charts.matplotlib import available

    if session.study.plan.report == "pdf" and not available():
        session.study = session.study.with_settings(["plan.report=html"])
        session.say(["The report is HTML: matplotlib is missing, `pip install 'mauvecl[plot]'` brings it."])
    session.draws = session.study.plan.completeness != "closed form"
    session.answer(session.ask())


@command_of(VERBS["stare"], draws=False, resumes=True)
def stare(session: Session, given: dict[str, Any], device: flags.DeviceFlag = None) -> None:
    """Draw stares on one device, which keeps their frames for a resume."""
    from mauvecl.answers.stare import stare as compute
    from mauvecl.device.stares import Stares

    if given["energy"] and (given["amplitude"] or given["flares"]):
        raise InputError("only one of --energy, --amplitude and --flares may be given", key="energy")

    stares = Stares(device)
    session.opened = stares.open_device
    with session.checkpoint() as checkpoint:
        answer = compute(session.study, stares, checkpoint=checkpoint)
    session.answer(answer)


def ask(session: Session) -> None:
    """Compute the answer, and print it."""
    session.answer(session.ask())


# Verbs without a function of their own; an analysis counts frames, and draws nothing.
command_of(VERBS["analyse"], draws=False)(ask)
for verb in VERBS.values():
    if verb.name not in COMMANDS:
        command_of(verb)(ask)
