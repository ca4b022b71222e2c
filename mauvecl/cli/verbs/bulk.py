"""Commands of stores of raw spectra: drawing, verification and export."""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mauvecl.answers.verbs import DRAWS, FEWER
from mauvecl.cli.flags import DeviceFlag, JsonFlag, QuietFlag
from mauvecl.cli.verb import takes_study

if TYPE_CHECKING:
    from mauvecl.cli.session import Session
    from mauvecl.store.layout import Store

StoreArgument = Annotated[Path, typer.Argument(help="Store that `mauvecl realise` wrote.")]
RowsFlag = Annotated[
    str | None,
    typer.Option(metavar="TEXT", help="Realisations, as in 1000:2000, the last not included.", show_default=False),
]


@takes_study(
    "flare",
    *DRAWS,
    "sweep",
    "bulk",
    defaults=FEWER,
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
    from mauvecl.cli.foresight import question_room
    from mauvecl.cli.session import report_interrupts, working
    from mauvecl.schema.errors import InputError
    from mauvecl.store import bulk
    from mauvecl.store.export import ENDINGS
    from mauvecl.store.layout import Store

    place = session.output or Path("mauvecl-frames.zarr")
    one_file = place.suffix in ENDINGS
    if not one_file and place.suffix not in ("", ".zarr"):
        raise InputError(
            f"--output {str(place)!r}", f"a name ending in .zarr, {', '.join(ENDINGS)}", key="output", value=str(place)
        )
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
    from mauvecl.cli.console import show_view
    from mauvecl.schema.tables import View
    from mauvecl.store.stored_scenes import ARRAY_COLUMNS
    from mauvecl.study.assumptions import assumption_line
    from mauvecl.study.messages import collect_messages

    messages = collect_messages([scene.expectation for scene in store.scenes], store.study.processes)
    assumed = assumption_line(store.study, ("instrument", "sky", "flare", "processes", "seed"))
    session.say([*messages, assumed])
    rows = [
        {
            "array": scene.path,
            "star": scene.star,
            "amplitude": scene.amplitude,
            "shape": [store.rows, *scene.row],
            "type": scene.dtype.name,
        }
        for scene in store.scenes
    ]
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
    repair: Annotated[bool, typer.Option("--repair", help="Draw again what is wrong, to the same bits.")] = False,
    redraw: Annotated[
        bool, typer.Option("--redraw", help="Draw every spectrum again and compare, not only digests.")
    ] = False,
    rows: RowsFlag = None,
    device: DeviceFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Check that a store or an answer's folder is as it was written.

    In a store, finds flipped bytes, missing and foreign chunks, and can repair them. In the output folder of another
    verb, finds files that were changed or removed, by the digests in its run.json.

    Exit code 1 if anything is wrong and not repaired.

    Example: mauvecl verify frames.zarr --repair
    """
    from mauvecl.answers.checked import is_answer
    from mauvecl.cli.console import Meter, show, show_view
    from mauvecl.schema.errors import InputError
    from mauvecl.schema.tables import View

    if is_answer(store):
        if repair or redraw or rows is not None:
            raise InputError(
                f"{str(store)!r} is the folder of an answer",
                "no --repair, --redraw or --rows, which are for stores: the same command with "
                "--restart writes the answer again",
                key="store",
                value=str(store),
            )
        _verify_answer(store, as_json=as_json)
        return
    from mauvecl.device.engine import Engine
    from mauvecl.store import bulk

    engine = Engine(device) if repair or redraw else None
    with Meter(quiet=quiet or as_json, unit="chunks") as meter:
        faults = bulk.verify(store, engine, repair=repair, redraw=redraw, rows=_rows_of(rows), progress=meter)
    left = sum(not fault.mended for fault in faults)
    if as_json:
        print(json.dumps([asdict(fault) for fault in faults], indent=2))
    else:
        if faults:
            show_view(View(f"Not as it was written: {store}", bulk.FAULT_COLUMNS, [asdict(one) for one in faults]))
        source = "with what was written" if not redraw else "with what the engine draws"
        show([f"{len(faults) - left} repaired, {left} left as found." if faults else f"Everything agrees {source}."])
    if left:
        raise typer.Exit(1)


def _verify_answer(folder: Path, *, as_json: bool) -> None:
    """Print files that differ from the run record, with exit code 1 if there are any."""
    from mauvecl.answers.checked import FAULT_COLUMNS, verify_answer
    from mauvecl.cli.console import show, show_view
    from mauvecl.schema.tables import View

    faults = verify_answer(folder)
    if as_json:
        print(json.dumps([asdict(fault) for fault in faults], indent=2))
    elif faults:
        show_view(View(f"Not as it was written: {folder}", FAULT_COLUMNS, [asdict(one) for one in faults]))
    else:
        show(["Every file agrees with the run record, and the record with its own digest."])
    if faults:
        raise typer.Exit(1)


def export(
    store: StoreArgument,
    file: Annotated[Path, typer.Argument(help="Ending in .fits, .h5 or .hdf5.")],
    array: Annotated[
        list[str] | None,
        typer.Option(
            "--array", metavar="TEXT", help="Such as star-1/flare-2; may be repeated [all].", show_default=False
        ),
    ] = None,
    rows: RowsFlag = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace what already has that name.")] = False,
    quiet: QuietFlag = False,
) -> None:
    """Write a part of a store as one FITS or HDF5 file.

    Example: mauvecl export frames.zarr some.fits --array star-1/quiescent --rows 0:1000
    """
    from mauvecl.cli.console import show
    from mauvecl.store.export import Selection
    from mauvecl.store.export import export as write
    from mauvecl.store.layout import Store

    write(Selection.of(Store.open(store), array, _rows_of(rows)), file, replace=replace)
    if not quiet:
        show([f"Wrote {file}, {file.stat().st_size / 2**20:.1f} MiB."])


def _rows_of(text: str | None) -> tuple[int, int] | None:
    from mauvecl.schema.errors import InputError

    if text is None:
        return None
    first, _, stop = text.partition(":")
    try:
        return int(first), int(stop)
    except ValueError as error:
        raise InputError(f"--rows {text!r}", "a range such as 1000:2000", key="rows", value=text) from error
