"""The command line: one verb each, from a study file or flags."""

from __future__ import annotations

import json
import sys
import time
from typing import Annotated

import typer

from mauvecl.cli.boundary import EXIT_CODES, guarded
from mauvecl.cli.bulk import export, realise, verify
from mauvecl.cli.detect import detect, gaussian
from mauvecl.cli.flags import DeviceFlag, JsonFlag, OutputFlag, QuietFlag
from mauvecl.cli.injections import inject
from mauvecl.cli.library import app as library
from mauvecl.cli.limits import detection_map, limit
from mauvecl.cli.observe import exposure, simulate, snr
from mauvecl.cli.orbits import plan, visible
from mauvecl.cli.serve import serve
from mauvecl.cli.stares import stare
from mauvecl.host.version import VERSION

app = typer.Typer(
    name="mauvecl",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Would the Mauve satellite see this stellar flare, and how sure can one be?\n\n"
    "Start with `mauvecl detect`, which answers the question of the MauveSim paper. The throughput is nominal, not a "
    f"flight calibration. {EXIT_CODES}",
)


@app.command()
def devices(
    rate: Annotated[bool, typer.Option("--rate/--no-rate", help="Measure each device for a second.")] = True,
    as_json: JsonFlag = False,
) -> None:
    """List the OpenCL devices that the kernels can run on, what each promises, and its rate.

    Rate: pixel-realisations per second of the chi2 statistic, two scenarios. Example: mauvecl devices
    """
    from mauvecl.device.rate import measured

    found = measured() if rate else measured(measure=False)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    from mauvecl.cli.console import show_table

    cells = [
        (
            str(number),
            f"{record['platform']}: {record['name']}",
            record["driver"],
            record["kind"],
            str(record["compute_units"]),
            f"{record['global_memory'] / 2**30:.1f}",
            record["promise"],
            record["error"] or ("" if record["rate"] is None else f"{record['rate']:.2g} /s"),
            "default" if record["default"] else "",
        )
        for number, record in enumerate(found)
    ]
    columns = ("number", "device", "driver", "kind", "units", "GiB", "promise", "rate", "")
    show_table("OpenCL devices; choose with --device NUMBER or part of a name", columns, cells)


@app.command()
def selftest(
    device: DeviceFlag = None, output: OutputFlag = None, as_json: JsonFlag = False, quiet: QuietFlag = False
) -> None:
    """Known answers, twins, tests of chance and closed forms on your own device, in under a minute.

    Exit code 1 if a check fails. Later run records on the same device carry the outcome. Example: mauvecl selftest
    """
    from dataclasses import asdict

    from mauvecl.answers import report
    from mauvecl.cli.console import Meter, show, show_table
    from mauvecl.device import selftest
    from mauvecl.device.engine import Engine

    started = time.perf_counter()
    folder = None if output is None else report.make_folder(output)
    with Meter(quiet=quiet or as_json) as meter:
        engine = Engine(device, progress=meter)
        checks = selftest.run(engine)
    seconds = time.perf_counter() - started
    selftest.keep(engine, checks, seconds)
    failed = sum(not check.passed for check in checks)
    if as_json:
        print(json.dumps(selftest.last(engine.device) or [asdict(check) for check in checks], indent=2))
    else:
        cells = [("PASS" if check.passed else "FAIL", check.name, check.found) for check in checks]
        show_table(f"Self-test of {engine.device_name}, driver {engine.driver}", ("", "check", "found"), cells)
        outcome = f"{failed} of {len(checks)} checks FAILED" if failed else f"All {len(checks)} checks passed"
        show([f"{outcome} in {seconds:.0f} s. Promise: {engine.device.promise}."])
    if folder is not None:
        report.write_json(selftest.last(engine.device), folder / "selftest.json")
    if failed:
        raise typer.Exit(1)


@app.command()
def schema() -> None:
    """Print the JSON schema of study files, for editors that check TOML.

    Example: mauvecl schema > study.schema.json, and a first line #:schema study.schema.json in the study
    """
    from mauvecl.study.study import Study

    print(json.dumps(Study.model_json_schema(), indent=2))


app.add_typer(library, name="library")
for verb in (simulate, snr, exposure, detect, gaussian, limit):
    app.command()(verb)
app.command("map")(detection_map)
app.command()(stare)
app.command()(inject)
app.command()(visible)
app.command()(plan)
for verb in (realise, verify, export, serve):
    app.command()(verb)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"mauvecl {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command line; a failure is one sentence and an exit code, never a traceback."""
    sys.exit(guarded(app))
