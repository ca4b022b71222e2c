"""Tabs of the page: the questions that they ask, their base class, and the tables and commands that they offer."""

from __future__ import annotations

import io
import json
import math
import re
import shlex
import tempfile
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from pprint import pformat
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, TypeAdapter

from mauvecl.answers.answer import write_table
from mauvecl.answers.verbs import VERBS, Progress
from mauvecl.schema.columns import View
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, metadata_of
from mauvecl.schema.section import read_axis, read_line_fluxes, read_words
from mauvecl.study.star import Star
from mauvecl.study.study import Study, keys_of, set_key, with_paths
from mauvecl.web.closed_forms import OTHER
from mauvecl.web.fields import FIELDS

if TYPE_CHECKING:
    from astropy.table import Table

    from mauvecl.answers.verbs import Verb
    from mauvecl.charts.chart import Chart
    from mauvecl.runs.pool import Pool
    from mauvecl.web.closed_forms import Answers, ClosedForms, FieldValues

#: Cells along each axis of the page's map, and realisations per cell.
MAP_STEPS, MAP_REALISATIONS = 8, 20_000
#: Injected flares: numbers of sizes and half-widths, flares of each, and positions.
INJECTED = {"of": "amplitude", "sizes": 12, "widths": 3, "count": 200, "positions": 4, "fitted": 0}
#: Largest number of simulated fits, and of those of two temperatures, which take fifty times as long.
MOST_FITS, MOST_OF_TWO = 10_000, 1000
DRAWN_UNITS = ("realisations", "steps", "cells")  # units of the progress of verbs that use the pool's devices
FIXED = ("star", "amplitude")  # columns that the page does not show: its question has one star and one flare
#: Keys that are stated even at their default, so that readers see what was assumed.
STATED = ("star", "flare.amplitudes", "observation.exposure_s", "observation.instrument", "sky", "run.fap",
          "run.realisations", "run.seed")  # fmt: skip
#: Keys that verbs use without a flag for them, since everything that observes draws unknowns.
ALWAYS_USED = ("nuisances.", "observation.temperature_c")
MOST_CHARACTERS = 500  # longest value in a command; a longer one is in the study file
ANYTHING = TypeAdapter(Any)
_drawing = threading.Lock()  # held while matplotlib draws


def _map_around(study: Study) -> Study:
    """Return the study of a coarse map around the question's star."""
    star, amplitude = study.star[0], study.flare.amplitudes[0]
    middle = 7.0 if star.magnitude is None else star.magnitude
    x = {"quantity": "magnitude", "start": middle - 2.5, "stop": middle + 2.5, "steps": MAP_STEPS}
    y = {"quantity": "amplitude", "start": amplitude / 10, "stop": amplitude * 3, "steps": MAP_STEPS, "log": True}
    # One statistic and the fewest realisations that the false-alarm probability allows keep the map fast.
    fewest = math.ceil(100 / study.run.fap)
    n = min(max(MAP_REALISATIONS, fewest), study.run.realisations)
    return _changed(study, map={"x": x, "y": y}, run={"realisations": n, "statistics": [study.run.statistics[-1]]})


def _changed(study: Study, **sections: dict[str, Any]) -> Study:
    """Return a study with other values of keys, by section."""
    return study.with_changes(sections, None, "page")


@dataclass(frozen=True)
class Simulation:
    """Verbs that answer a question of the page, and the study that they receive."""

    #: Verbs that answer it. The page keeps the answer of the first under the question's name, others under their own.
    verbs: tuple[str, ...]
    study: Callable[[Study], Study] = lambda study: study  # converts the study of the page


def _fits(study: Study) -> Study:
    """Return the study of fits of the flare's spectrum."""
    most = MOST_FITS if study.flare.spectrum.second_area is None else MOST_OF_TWO
    return _changed(study, measure={"fits": min(study.run.realisations, most)})


#: Simulations by the name of their question: that of the verb, unless it changes the study or has another name.
QUESTIONS = {name: Simulation((name,)) for name in VERBS} | {
    "detection": Simulation(("detect", "snr")),
    "map": Simulation(("map",), _map_around),
    "measure": Simulation(("measure",), _fits),
    "completeness": Simulation(("inject",), partial(_changed, injections=INJECTED, search={"nulls": 0})),
    "periods": Simulation(("change",), partial(_changed, change={"periods": True})),
}


def simulate(
    name: str, study: Study, pool: Pool, progress: Progress = None, *, inputs: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the answers to a question by name; its first verb reports its progress and takes the contents of files.

    A detection also has the answer with the other choice of unknowns, unless that is refused.
    """
    question = QUESTIONS[name]
    study, (main, *more) = question.study(study), question.verbs
    questions = [(name, main, study), *((verb, verb, study) for verb in more)]
    if name == "detection":
        questions.append((OTHER, main, _changed(study, nuisances={"usual": not study.nuisances.usual})))
    # Each verb announces its own realisations alone.
    n_draws = sum(VERBS[verb].counts == "realisations" for _, verb, _ in questions)
    pool.expect(study.run.realisations * n_draws)
    answers: dict[str, Any] = {}
    for key, verb, study in questions:
        try:
            answers[key] = VERBS[verb].ask(study, pool, progress, **(inputs or {} if verb == main else {}))
        except InputError:
            if key != OTHER:
                raise
    return answers


def target_words(question: FieldValues) -> str:
    """Return the targets and days of a question in words."""
    names = ", ".join(target["name"] for target in question.targets) or "no target yet"
    return f"{names}; {question.days:g} days from {question.start}"


@dataclass(kw_only=True, eq=False)
class Tab:
    """Tab of the page; what a tab with a verb does not state follows from its verb."""

    verb: str = ""  # name of the verb that it shows, if any
    name: str = ""
    title: str = ""
    about: str = ""  # what it shows, in a sentence
    pictures: tuple[Chart, ...] = ()
    simulations: Mapping[str, str] = field(default_factory=dict)  # questions that its buttons simulate, with labels
    needs: str = ""  # field without which no simulation of it can start
    answer: str = ""  # name of the simulated answer whose table is below the pictures
    view: int = 0  # number of that table among the answer's `views`
    #: Another table below the pictures, and the rows before there is an answer.
    own_view: Callable[[ClosedForms, Answers], View] | None = None
    rows_before: Callable[[FieldValues], list[list[str]]] = lambda question: []
    #: Questions of "Share, export, cite"; by default its own simulations.
    questions: tuple[str, ...] = ()
    #: Key of `GROUPS` under whose heading it stands; by default that of the verb that answers its first question.
    group: str = ""
    #: Whether the chance of detection stands above it, whose fields it then shows.
    chance: bool = True
    #: Its question in words, if it has no chance.
    words: Callable[[FieldValues], str] = lambda q: f"{q.star_in_words} of {q.band} = {q.magnitude:g}"
    #: Reads the file of the field that it `needs` on a thread of its own, and returns arguments of the verb.
    read_inputs: Callable[[FieldValues], dict[str, Any]] = lambda question: {}
    #: Fields that it reads although its verbs do not take their keys, and those that it does not read.
    also: tuple[str, ...] = ()
    never: tuple[str, ...] = ()
    #: Tables that can be downloaded, with the simulation that each needs, or none.
    files: Mapping[str, str | None] = field(default_factory=dict)
    own_table: Callable[[ClosedForms, Answers], Table] | None = None  # table of its only file, if no answer has it
    #: Documents of answers that can be downloaded, by file name, with the simulation that each needs.
    documents: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if verb := self.verb:
            title, (about, *_) = verb.capitalize(), VERBS[verb].help.split("\n")
            self.name, self.title, self.about = self.name or verb, self.title or title, self.about or about
            self.simulations, self.answer = self.simulations or {verb: title}, self.answer or verb
            self.files = self.files or {verb: verb}
        self.questions = self.questions or tuple(self.simulations) or ("detection",)
        self.group = self.group or VERBS[QUESTIONS[self.questions[0]].verbs[0]].group

    @cached_property
    def reads(self) -> frozenset[str]:
        """Fields on which the tab depends, with those of the card: the chance, and the limit in a sentence."""
        above = ("detection", "limit") if self.chance else ()
        return self.reads_of(*self.questions, *self.simulations, *above)

    def reads_of(self, *questions: str) -> frozenset[str]:
        """Return the fields on which questions depend, by the keys that the flags of their verbs set."""
        accepts = [VERBS[verb].accepts for question in questions for verb in QUESTIONS[question].verbs]
        names = (name for name, field in FIELDS.items() if any(takes(key) for takes in accepts for key in field.keys))
        return frozenset({*names, *self.also}).difference(self.never)

    def offers(self, name: str, answers: Answers) -> bool:
        """Return whether one of `files` or `documents` can be downloaded: the answer it needs is there and has it."""
        needed = self.documents[name] if name in self.documents else self.files[name]
        # An answer lacks tables that the question does not ask for.
        always = name in self.documents or self.own_table is not None
        return needed is None or (needed in answers and (always or answers[needed].has_table(name)))

    def rows(self, closed: ClosedForms, answers: Answers) -> list[list[str]]:
        """Return a small table as text with a header row; empty if there is nothing to report."""
        if self.own_view is None and self.answer not in answers:
            return self.rows_before(closed.question)
        view = answers[self.answer].views[self.view] if self.own_view is None else self.own_view(closed, answers)
        headings, cells = view.texts(FIXED, empty=False)
        return [headings, *cells] if headings else []


PROGRAM = """from mauvecl import Engine, Study, {verb}

study = Study.build(
    {data},
    "page",
)
answer = {verb}(study, Engine(){options})
print(next(iter(answer.tables.values())))
"""


def differing(new: BaseModel, old: BaseModel, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted path and the plain value of each key that has another value in `old`, or is `STATED`."""
    for key, model_field in type(new).model_fields.items():
        name, value, old_value = f"{path}{key}", getattr(new, key), getattr(old, key)
        # A new sky replaces all keys of the old one, and so does a section with a flag of its own.
        replaces = name == "sky" or bool(metadata_of(model_field, Flag))
        if isinstance(value, BaseModel) and isinstance(old_value, BaseModel) and not replaces:
            yield from differing(value, old_value, f"{name}.")
        elif value is not None and (value != old_value or name in STATED):
            # As TOML can hold it, without the defaults of records.
            yield name, ANYTHING.dump_python(value, mode="json", exclude_defaults=True, exclude_none=True)


def as_command(verb: str, study: Study) -> str:
    """Return a question to a verb as a command, which names a study file if flags cannot say all of it."""
    question, from_file = VERBS[verb], shlex.join(["mauvecl", verb, "study.toml"])
    if any(file is not None for file in (study.flare.spectrum.file, *(star.file for star in study.star))):
        return from_file
    base = Study().with_settings([f"{key}={value}" for key, value in (question.defaults or {}).items()])
    words = ["mauvecl", verb]
    for name, value in keys_used(question, study, base):
        if name == "data.file":
            words.insert(2, value)
        elif name == "star":
            for star in value:
                usual = Star(library=star.get("library"))
                stated = {key: entry for key, entry in star.items() if entry != getattr(usual, key)}
                words += _flag_words("star", {"library": usual.library} | stated, question)
        elif name == "sky":
            words += ["--sky", "none"] if value.get("none") else _flag_words("sky", value, question)
        else:
            # TOML on one line is JSON with another separator, and bare keys.
            toml = json.dumps(value, ensure_ascii=False, separators=(", ", " = "))
            toml = re.sub(r'"(\w+)" = ', r"\1 = ", toml, flags=re.ASCII)
            words += _flag_words(name, value, question) or ["--set", f"{name}={toml}"]
    return from_file if max(map(len, words)) > MOST_CHARACTERS else shlex.join(words)


def keys_used(verb: Verb, study: Study, base: Study) -> Iterator[tuple[str, Any]]:
    """Yield the keys that a verb uses of a study, with their plain values, if they are `differing` from a base."""
    flagged = {key for key, *_ in keys_of()}
    observes = verb.accepts("star.library")
    for name, value in differing(study, base):
        if name in ("star", "sky"):
            used = observes if name == "star" else verb.accepts("sky.surface_brightness")
        else:
            used = verb.accepts(name) or name not in flagged or (observes and name.startswith(ALWAYS_USED))
        if used:
            yield name, value


def _flag_words(name: str, value: Any, verb: Verb) -> list[str]:
    """Return the words of the flag of a key, or of each key of a star or sky; none if no flag takes such a value."""
    if name in ("star", "sky"):
        return [word for key, inner in value.items() for word in _flag_words(f"{name}.{key}", inner, verb)]
    for flag in (flag for key, _, flag in keys_of() if key == name and verb.accepts(name)):
        if isinstance(value, bool) and flag.read is None:
            on, _, off = flag.names[0].partition("/")
            return [on] if value else [off] if off else []
        if flag.read is read_line_fluxes:
            return [word for line, share in value.items() for word in (flag.names[0], f"{line}={share!r}")]
        if flag.read is read_axis and "start" in value:
            spaced = [value["quantity"], *(_text(value[key]) for key in ("start", "stop", "steps"))]
            return [flag.names[0], ":".join(spaced + ["log"] * value.get("log", False))]
        if flag.read in (None, read_words):
            values = value if isinstance(value, list) else [value]
            if all(isinstance(item, str | int | float) for item in values):
                return [word for item in values for word in (flag.names[0], _text(item))]
    return []


def _text(value: str | float) -> str:
    """Return a value as it is typed, with every digit of a number."""
    return value if isinstance(value, str) else str(value).removesuffix(".0")


def study_file(study: Study, name: str) -> tuple[str, bytes]:
    """Return name and content of the study file, in a zip archive with the visitor's files if there are any."""
    # The visitor's files that the study names, each once.
    files, text = dict[Path, Path](), study.toml()
    with_paths(study, lambda file: files.setdefault(file, file))
    if not files:
        return f"{name}.toml", text.encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.name)
            # Paths relative to the study, instead of those on the server.
            text = text.replace(str(file.resolve()), file.name)
        archive.writestr("study.toml", text)
    return f"{name}.zip", out.getvalue()


def as_file(tab: Tab, name: str, ending: str, closed: ClosedForms, answers: Answers) -> tuple[str, bytes]:
    """Return file name and content of one of a tab's `files` or `documents`, or of the study that reproduces it.

    The ending is "ecsv", "fits" or "study", and empty for a document.
    """
    if name not in tab.documents and (name not in tab.files or ending not in ("ecsv", "fits", "study")):
        raise InputError(f"{tab.title} has no file {name[:40]!r}.{ending[:10]}; use one of its own", key="name")
    if not tab.offers(name, answers):
        raise InputError(f"no {name} is computed yet: start a simulation first", key="name")
    if name in tab.documents:
        # Matplotlib's settings are those of the process.
        with _drawing:
            return name, answers[tab.documents[name]].documents[name]()
    if ending == "study":
        needed = tab.files[name]
        return study_file(closed.case.study if needed is None else answers[needed].study, f"mauvecl-{name}")
    with tempfile.TemporaryDirectory() as folder:
        path, make = Path(folder) / f"mauvecl-{name}.{ending}", tab.own_table
        write_table(make(closed, answers) if make else answers[str(tab.files[name])].tables[name], path)
        return path.name, path.read_bytes()


def commands_and_programs(tab: Tab, question: FieldValues, folder: Path) -> list[dict[str, str]]:
    """Return each of a tab's `questions` as a command and as a Python program; `folder` holds the visitor's files."""
    entries = []
    for name in tab.questions:
        (verb, *_), study = QUESTIONS[name].verbs, QUESTIONS[name].study(question.case(folder).study)
        # Paths relative to the study, instead of those on the server.
        study, keys = with_paths(study, lambda file: Path(file.name)), dict[str, Any]()
        for key, value in keys_used(VERBS[verb], study, Study()):
            set_key(keys, key.split("."), value, key)
        text = pformat(keys, width=100, sort_dicts=False).replace("\n", "\n    ")
        # The command does so if a flare is given.
        options = ", flaring=True" if verb == "simulate" else ""
        program = PROGRAM.format(verb=verb, data=text, options=options)
        entries.append({"question": name, "command": as_command(verb, study), "python": program})
    return entries
