"""Compare the numbers of the page with those of the commands that it prints, for random questions.

python tools/check_commands.py [--count 20] [--seed 1] [--tab NAME ...]

Each tab's tables are simulated as its buttons do, its printed commands are run, and columns are compared bit by bit.
"""

from __future__ import annotations

import argparse
import os
import shlex
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
from astropy.table import Table
from typer.testing import CliRunner

from mauvecl.answers.answer import write_table
from mauvecl.cli.app import app
from mauvecl.detection.requests import STATISTICS
from mauvecl.runs.pool import LocalWorkers, Pool
from mauvecl.schema.errors import InputError
from mauvecl.web.closed_forms import ClosedForms, FieldValues
from mauvecl.web.fields import FIELDS, IDEAL, UPLOADED_FILE, Choice, Number
from mauvecl.web.page import TABS, State, commands_and_programs, reads_of
from mauvecl.web.tab import Tab, simulate

#: Names of the commands' files, where they are not those of the page.
WRITTEN = {"observation": "observation-2", "snr": "snr-element"}
#: Entered texts of fields that are neither numbers nor choices, or that would make a question slow or impossible.
TEXTS: dict[str, tuple[str, ...]] = {
    "star": ("G2V", "K3V", "M3V", "GJ 581", "F5V", "blackbody 9000 K", "power law -1.5"),
    "ebv": ("", "0.1"),
    "lines": ("", "Mg II=0.03", "Mg II=0.02, 280=0.01, Balmer=0.1"),
    "own_unknown": ("", "200 1, 450 3, 700 1"),
    "target": ("290.68 +11.12", "30 -10"),
    "time": ("2026-09-01T12:00", "2026-03-01T00:00"),
    "targets": ("eps Eri", "AU Mic"),
    "realisations": ("10000",),
    "fap": ("0.05", "0.02"),
    "balmer_jump": ("", "2.5"),
    "second_temperature_k": ("", "30000"),
    "band": ("V", "Kepler", "GALEX NUV"),
    "magnitude": ("5.5", "7.25", "9", "10.1"),
    "amplitude_percent": ("0.7", "2", "13"),
    # Each fits a window of a target.
    "exposure_s": ("7.5", "50", "333.3", "1800"),
    "seed": ("1", "7", "123456789"),
    "joint_fit": ("no",),
    # The numbers of a year take half a minute.
    "days": ("3", "20", "31"),
}


def random_link(generator: np.random.Generator) -> str:
    """Return a random question as a link."""
    entered = {}
    for name, field in FIELDS.items():
        if name in TEXTS:
            entered[name] = str(generator.choice(TEXTS[name]))
        elif isinstance(field.read, Choice):
            # Links do not hold a visitor's files.
            entered[name] = str(generator.choice([text for text in field.read.options if text != UPLOADED_FILE]))
        elif isinstance(field.read, Number) and field.slider is not None:
            value = generator.uniform(field.slider.low, field.slider.high)
            entered[name] = f"{value:.0f}" if field.read.whole else f"{value:.4g}"
    if entered["balmer_jump"]:
        # A flare's spectrum has one of them.
        entered["second_temperature_k"] = ""
    entered["shortest_d"], entered["longest_d"] = sorted((entered["shortest_d"], entered["longest_d"]), key=float)
    if STATISTICS[entered["statistic"]].paired or entered["statistic"] == "paper":
        entered |= {"unknown": IDEAL, "own_unknown": ""}
    return "?" + urlencode(entered)


def possible_question(
    generator: np.random.Generator, tab: Tab, folder: Path, quick: bool = False
) -> tuple[State, ClosedForms]:
    """Return a random state of the page with the closed forms of a tab; saturated stars are drawn again.

    With `quick`, so are questions with an unknown spectrum of one's own, whose closed forms may take a minute.
    """
    while True:
        state = State(random_link(generator))
        if quick and state.entered["own_unknown"]:
            continue
        try:
            return state, ClosedForms.of(state.question(tab.reads), folder, chance=tab.chance)
        except InputError:
            continue


def page_tables(tab: Tab, state: State, closed: ClosedForms, folder: Path) -> dict[str, Table]:
    """Return the tables of a tab after all its simulations, each of the fields that it reads."""
    answers: dict[str, Any] = {}
    pool = Pool(LocalWorkers([None]))
    for name in tab.simulations:
        answers |= simulate(name, state.question(reads_of(name)).case(folder).study, pool)
    own = tab.own_table
    return {
        name: own(closed, answers) if own else answers[needed].tables[name]
        for name, needed in tab.files.items()
        if tab.offers(name, answers)
    }


def command_tables(tab: Tab, question: FieldValues, folder: Path) -> dict[str, Table]:
    """Run the printed commands of a tab, and return the tables that they write."""
    with _working_in(folder):
        for number, one in enumerate(commands_and_programs(tab, question, folder)):
            program, *words = shlex.split(one["command"])
            assert program == "mauvecl", one["command"]
            ended = CliRunner().invoke(app, [*words, "--no-pictures", "--quiet", "--output", f"out-{number}"])
            if ended.exit_code:
                raise RuntimeError(f"{one['command']}\n{ended.output}{ended.exception}")
    paths = sorted(folder.glob("out-*/*.ecsv"))
    return {path.stem: Table.read(path, format="ascii.ecsv") for path in paths}


def differences(tab: Tab, state: State, closed: ClosedForms, folder: Path) -> list[str]:
    """Return the columns of a tab in which page and command differ, as ``table: column``.

    A question without an answer, such as a limit beyond its range, is to be refused in the same words by both.
    """
    try:
        page = page_tables(tab, state, closed, folder)
    except InputError as error:
        try:
            command_tables(tab, closed.question, folder)
        except RuntimeError as refused:
            return [] if " ".join(str(error).split()) in " ".join(str(refused).split()) else [f"{error}: {refused}"]
        return [f"only the page refuses: {error}"]
    written = command_tables(tab, closed.question, folder)
    found = []
    for name, unwritten in page.items():
        # Files hold what is empty in another way.
        table = Table.read(write_table(unwritten, folder / f"page-{name}.ecsv"), format="ascii.ecsv")
        other = written[WRITTEN.get(name, name)]
        if table.colnames != other.colnames or len(table) != len(other):
            found.append(f"{name}: {table.colnames} of {len(table)} rows")
            continue
        for column in table.colnames:
            # Every digit, and what is masked or no number.
            one, two = ([*map(str, each[column].tolist())] for each in (table, other))
            found += [f"{name}: {column}"] * (one != two)
    return found


@contextmanager
def _working_in(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def main() -> None:
    """Compare the tabs, and print one line for each."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--count", type=int, default=20, help="questions per tab")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--tab", choices=TABS, action="append")
    given = arguments.parse_args()
    for name in given.tab or TABS:
        started, wrong = time.perf_counter(), 0
        for count in range(given.count):
            with tempfile.TemporaryDirectory() as place:
                folder = Path(place)
                generator = np.random.default_rng([given.seed, count])
                state, closed = possible_question(generator, TABS[name], folder)
                different = differences(TABS[name], state, closed, folder)
                wrong += bool(different)
                if different:
                    print(f"{name} ?{urlencode(state.entered)}\n  {'; '.join(different)}")
        seconds = time.perf_counter() - started
        print(f"{name}: {given.count - wrong} of {given.count} questions agree, {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
