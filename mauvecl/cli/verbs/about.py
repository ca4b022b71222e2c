"""Verbs about mauvecl itself: devices, their self-test, the schema of studies."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from mauvecl.cli.flags import DeviceFlag, JsonFlag, QuietFlag

WhereFlag = Annotated[
    Path | None,
    typer.Option("--output", "-o", metavar="PATH", help="Where to write [nowhere].", show_default=False),
]


def devices(
    rate: Annotated[bool, typer.Option("--rate/--no-rate", help="Measure each device for a second.")] = True,
    forget: Annotated[bool, typer.Option("--forget", help="Try drivers again that failed to build kernels.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """List the OpenCL devices that can run the kernels, and rates.

    Promise: which numbers are the same as on every other device.
    Rate: pixel-realisations per second of the chi2 statistic, two scenarios.

    Example: mauvecl devices
    """
    from mauvecl.device.benchmark import COLUMNS, list_devices
    from mauvecl.device.first_build import forget_outcomes
    from mauvecl.schema.tables import View

    if forget:
        forget_outcomes()
    records = list_devices() if rate else list_devices(measure=False)
    if as_json:
        print(json.dumps(records, indent=2))
        return
    from mauvecl.cli.console import show_view

    numbered = [{"number": number} | record for number, record in enumerate(records)]
    show_view(View("OpenCL devices; choose with --device NUMBER or part of a name", COLUMNS, numbered))


def selftest(
    device: DeviceFlag = None, output: WhereFlag = None, as_json: JsonFlag = False, quiet: QuietFlag = False
) -> None:
    """Check that your device computes what it should.

    Known answers, the NumPy reference, tests of chance and closed forms; takes about ten seconds.

    Exit code 1 if a check fails. Later run records on the same device carry the outcome.

    Example: mauvecl selftest
    """
    from dataclasses import asdict

    from mauvecl.answers import files
    from mauvecl.cli.console import Meter, show, show_view
    from mauvecl.device import selftest, selftest_outcome
    from mauvecl.device.engine import Engine
    from mauvecl.schema.tables import View

    started = time.perf_counter()
    folder = None if output is None else files.make_folder(output)
    with Meter(quiet=quiet or as_json) as meter:
        engine = Engine(device, progress=meter)
        checks = selftest.run(engine)
    seconds = time.perf_counter() - started
    selftest_outcome.write_outcome(engine.device, checks, seconds)
    failed = sum(not check.passed for check in checks)
    if as_json:
        print(json.dumps(selftest_outcome.read_outcome(engine.device) or [asdict(check) for check in checks], indent=2))
    else:
        title = f"Self-test of {engine.device_name}, driver {engine.driver}"
        show_view(View(title, selftest_outcome.COLUMNS, [asdict(check) for check in checks]))
        outcome = f"{failed} of {len(checks)} checks FAILED" if failed else f"All {len(checks)} checks passed"
        show([f"{outcome} in {seconds:.0f} s. Promise: {engine.device.promise}."])
    if folder is not None:
        files.write_json(selftest_outcome.read_outcome(engine.device), folder / "selftest.json")
    if failed:
        raise typer.Exit(1)


def schema() -> None:
    """Print the JSON schema of study files, for editors of TOML.

    A study names it in its first line, as in #:schema study.schema.json.

    Example: mauvecl schema > study.schema.json
    """
    from mauvecl.study.study import Study

    print(json.dumps(Study.model_json_schema(), indent=2))
