"""The page's tabs, its state, which a link gives, its card, and what visitors take along: files, commands, programs."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import tempfile
import threading
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from pprint import pformat
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

from pydantic import BaseModel, TypeAdapter

from mauvecl.answers.answer import IF_KNOWN, write_table
from mauvecl.answers.closed_forms import BOTH_CHANCES
from mauvecl.answers.detect import chance_of_flare
from mauvecl.answers.verbs import GROUPS, VERBS
from mauvecl.detection import check_fap
from mauvecl.host.exposure.background import parse_position, parse_time
from mauvecl.host.stars.library import listed_note, resolve
from mauvecl.host.tables.units import offline
from mauvecl.schema.columns import chance_text
from mauvecl.schema.errors import InputError, of_kind, shortened
from mauvecl.schema.fields import Flag, as_typed, metadata_of
from mauvecl.schema.section import read_axis, read_line_fluxes, read_words
from mauvecl.study.plan import PlanTarget
from mauvecl.study.star import Star
from mauvecl.study.study import Study, keys_of, set_key, with_paths
from mauvecl.web.closed_forms import OTHER, TITLES, Answers, ClosedForms, FieldValues, chances, short
from mauvecl.web.exposure_tabs import DETECTION, LIMIT, NOISE, SIGNAL, SPECTRUM, UNKNOWN
from mauvecl.web.fields import FIELDS, FORMER_VALUES, IDEAL, REALISTIC, UPLOADED, Choice, Field, note, sentence, targets
from mauvecl.web.observation_tabs import (
    ANALYSE,
    CALIBRATE,
    CHANGE,
    COMPLETENESS,
    MEASUREMENT,
    PERIODS,
    PLAN,
    VISIBILITY,
)
from mauvecl.web.tab import QUESTIONS, Tab
from mauvecl.web.uploads import UPLOADS

if TYPE_CHECKING:
    from mauvecl.answers.verbs import Verb

#: Keys that are stated even at their default, so that readers see what was assumed.
STATED = ("star", "flare.amplitudes", "observation.exposure_s", "observation.instrument", "sky", "run.fap",
          "run.realisations", "run.seed")  # fmt: skip
#: Keys that verbs use without a flag for them, since everything that observes draws unknowns.
ALWAYS_USED = ("nuisances.", "observation.temperature_c")
MOST_CHARACTERS = 500  # longest value in a command; a longer one is in the study file
ANYTHING = TypeAdapter(Any)
_drawing = threading.Lock()  # held while matplotlib draws
WITH_MESSAGES = ("detection", "measure")  # answers whose messages are shown, which include those of the others
NOMINAL = "The throughput is nominal"  # start of the message about it, which the page shows once
#: Kinds of messages that change the answer, which are shown in red.
CHANGING = {"saturated", "no answer", "no limit", "no threshold", "no light", "wrong sign", "not marginalised",
            "outside the prior"}  # fmt: skip
MOST_LINKED = 8192  # largest number of characters of a link that are parsed
#: Tabs with pictures, in the order of their group.
DRAWN = (DETECTION, SPECTRUM, SIGNAL, NOISE, LIMIT, MEASUREMENT, UNKNOWN, CHANGE, PERIODS, COMPLETENESS, ANALYSE,
         CALIBRATE, VISIBILITY, PLAN)  # fmt: skip
#: Tab with pinned scenarios and the history of runs.
COMPARE = Tab(
    name="compare",
    title="Compare",
    group="tools",
    about="Scenarios that you have pinned, side by side, and what you have simulated; this browser tab keeps them.",
)
#: All tabs by name, in the order of the page: group by group. Verbs without pictures show their first view.
TABS: dict[str, Tab] = {
    tab.name: tab
    for group in GROUPS
    for tab in (
        *DRAWN,
        *(Tab(verb=name) for name, verb in VERBS.items() if verb.tab and name not in {drawn.name for drawn in DRAWN}),
        COMPARE,
    )
    if tab.group == group
}

#: Questions that a button simulates, with the first tab that has the button.
SIMULATIONS = {name: tab for tab in reversed(TABS.values()) for name in tab.simulations}


def reads_of(simulation: str) -> frozenset[str]:
    """Return the fields on which the answers of a simulation depend."""
    return SIMULATIONS[simulation].reads_of(simulation)


def card(tab: Tab, closed: ClosedForms, answers: Answers) -> dict[str, Any]:
    """Return the contents of the card, by the names of `Answer` in `protocol.js`."""
    messages = answers[tab.answer].messages if tab.answer in answers else []
    # The first sentence of the command line's output.
    names = (tab.answer, *tab.questions, *tab.simulations)
    plain = {
        "chance": tab.chance,
        "headline": next((str(answers[name].headline) for name in names if name in answers), ""),
        "numbers": [],
        "shown": tab.title,
        "words": tab.words(closed.question),
        "facts": [],
        "notes": _notes(messages),
        "simulated": sorted(name for name in answers if name not in ("snr", "draw", OTHER)),
        "files": [
            f"{other.name} {name}"
            for other in TABS.values()
            for name in (*other.files, *other.documents)
            if other.offers(name, answers)
        ],
    }
    return plain | (_with_chance(str(plain["headline"]), closed, answers) if tab.chance else {})


def _with_chance(headline: str, closed: ClosedForms, answers: Answers) -> dict[str, Any]:
    """Return the entries of a card with the chance of detection; its headline is by default that of the closed form."""
    q, x = closed.question, closed.quiet
    threshold, of_choices = closed.odds.threshold, chances(closed, answers)
    shown = {chance.unknown: chance_text(chance.value) for chance in of_choices}
    (chosen,) = (chance for chance in of_choices if chance.unknown == q.unknown)
    if not headline and chosen.value == chosen.value:
        ideal = q.unknown == REALISTIC and all(chance.value == chance.value for chance in of_choices)
        text = shown[q.unknown] + (f" ({shown[IDEAL]} {IF_KNOWN})" if ideal else "")
        text = chance_of_flare(closed.study, closed.case.label, closed.case.amplitudes[0], x, text)
        headline = f"{text}, by the estimate before a simulation."
    messages = [message for name in WITH_MESSAGES if name in answers for message in answers[name].messages]
    facts = []
    if "detection" in answers:
        (row,) = (row for row in answers["detection"].table if row["statistic"] == q.statistic)
        threshold = float(row["threshold"])
        facts.append(("In closed form", chance_text(closed.chance)))
    facts += [
        ("Threshold", f"{threshold:.4g}" if threshold == threshold else "none"),
        ("Expected with flare", f"{round(closed.odds.flaring.mean, 6) + 0.0:.4g}"),
        ("Best S/N per pixel", short(x.snr().max())),
        ("Best S/N per element", short(x.snr_per_element().max())),
    ]
    words = (
        f"Chance to detect {closed.words}, by the statistic {q.statistic} at a false-alarm probability of {q.fap:g} "
        f"per test, with the payload {q.instrument}."
    )
    return {
        "headline": headline,
        "numbers": [
            {"unknown": of, "title": TITLES[of], "shown": shown[of], "value": None if p != p else p, "interval": origin}
            for of, p, origin in of_choices
        ],
        "chosen": q.unknown,
        "shown": shown[q.unknown],
        "words": words,
        "facts": facts,
        # The card shows both chances itself.
        "notes": _notes(m for m in (*messages, *closed.messages) if m not in of_kind(messages, BOTH_CHANCES)),
    }


def _notes(messages: Iterable[str]) -> list[tuple[str, str]]:
    """Return messages once each, and whether each is a danger to the answer or mere information."""
    distinct = [m for m in dict.fromkeys(messages) if not m.startswith(NOMINAL)]
    return [(note(m), "danger" if getattr(m, "kind", "") in CHANGING else "info") for m in distinct]


def _simulation_names(text: str) -> tuple[str, ...]:
    """Parse names of simulations, without repetitions."""
    names = [name for name in text.split(",") if name]
    if len(names) > len(SIMULATIONS) or not set(names) <= SIMULATIONS.keys():
        raise InputError(f"{shortened(text)} is not a simulation: use some of {', '.join(SIMULATIONS)}")
    return tuple(dict.fromkeys(names))


#: Entries of a link in addition to the question.
SEEN = {
    "tab": Field(label="Tab", first=next(iter(TABS)), read=Choice(tuple(TABS))),
    "simulated": Field(label="Simulated", first="", read=_simulation_names),
}
#: All entries of a link, and their values on a new page.
ENTRIES = FIELDS | SEEN
FIRST = {name: field.read(field.first) for name, field in ENTRIES.items()}


class State:
    """State of a page that a link gives: the text of each field in `entered`, valid or not, and the visitor's files.

    `stray` is the message on entries of the link that are no fields, or that no field of the page can correct.
    """

    def __init__(self, link: str = "", uploads: Mapping[str, Any] | None = None) -> None:
        self.uploads, self.stray = dict(uploads or {}), ""
        self.entered = {name: field.first for name, field in ENTRIES.items()}
        self._values, self._invalid = dict(FIRST), dict[str, str]()  # by entry: values, and errors of invalid texts
        texts = self._parse(link)
        for name, field in ENTRIES.items():
            if name in texts:
                self.entered[name] = texts[name][: field.characters]
                try:
                    self._values[name] = self._read(name, texts[name])
                except InputError as error:
                    self._invalid[name] = sentence(error)
        for name, field in SEEN.items():
            if name in self._invalid:
                self.entered[name] = field.first
                self.stray += f" The link's {name}: {self._invalid.pop(name)}; it was left out."

    def _parse(self, link: str) -> dict[str, str]:
        """Return the texts of a link by entry, those of version 1 in today's words, and report entries in `stray`."""
        query = link.removeprefix("?")
        if len(query) > MOST_LINKED:
            self.stray = f"The link has more than {MOST_LINKED} characters and was left out."
            return {}
        texts = dict(parse_qsl(query, keep_blank_values=True, errors="replace"))
        if unknown := sorted(texts.keys() - ENTRIES.keys()):
            self.stray = f"The link holds {shortened(', '.join(unknown))}, which is no field here; it was left out."
        if texts.get("unknown") in FORMER_VALUES["unknown"]:
            self.stray += " The link is of version 1: its payload and unknowns have other names today."
            for name in FORMER_VALUES.keys() & texts.keys():
                texts[name] = FORMER_VALUES[name].get(texts[name], texts[name])
        return texts

    def _read(self, name: str, text: str) -> Any:
        """Return the value of an entry; raises InputError for an invalid text, or one of a file that is not here."""
        field = ENTRIES[name]
        if len(text) > field.characters:
            raise InputError(f"{shortened(text)} is too long: enter at most {field.characters} characters")
        if name in UPLOADS and text == UPLOADS[name].entered and name not in self.uploads:
            raise InputError(f"the {text} is not here: give its file again, since links do not hold it")
        return field.read(text)

    def faults_of(self, names: Collection[str]) -> dict[str, str]:
        """Return the error messages of some fields, with those of values that cannot be together."""
        faults = {name: message for name, message in self._invalid.items() if name in names}
        checks: dict[str, Callable[[], Any]] = {}
        if "fap" not in self._invalid:
            checks["realisations"] = lambda: check_fap(self._values["fap"], *self._values["realisations"])
        if self.entered["sky"] == "target and time":
            checks["target"] = lambda: parse_position(self.entered["target"])
            checks["time"] = lambda: parse_time(self.entered["time"])
        for name, check in checks.items():
            if name in names and name not in faults:
                try:
                    with offline():
                        check()
                except InputError as error:
                    faults[name] = sentence(error)
        return faults

    def texts(self, names: Collection[str]) -> tuple[str, ...]:
        """Return the text of the named fields, on which an answer depends."""
        return tuple(self.entered[name] for name in FIELDS if name in names)

    def question(self, names: Collection[str] = tuple(FIELDS)) -> FieldValues:
        """Return the question of the named fields; all others have their first values."""
        faults = self.faults_of(names)
        if faults:
            messages = (f"{ENTRIES[name].label}: {message}" for name, message in faults.items())
            raise InputError("; ".join(messages), key=next(iter(faults)))
        values = {name: (self._values if name in names else FIRST)[name] for name in FIELDS}
        uploaded = [name for name in UPLOADS if name in names and self.entered[name] == UPLOADS[name].entered]
        return FieldValues(values, {name: self.uploads[name] for name in uploaded})


def known_values(state: State) -> dict[str, Any]:
    """Return the known values of the star and of each target, and the values that can be entered for it.

    The star has ``about`` in words, ``given``, texts of fields, and ``offer``, the words of a button that enters them;
    ``targets`` has texts by the columns of the table for each row.
    """
    known: dict[str, Any] = {"about": "", "given": {}, "offer": ""}
    name = state.entered["star"]
    star = None if name == UPLOADED else resolve(name, own=False)
    if star is not None and star.entry is not None:
        magnitude = f"{star.entry.magnitude:g}"
        texts = {"magnitude": magnitude, "band": "V", "target": star.name}
        known = {"about": star.entry.about, "given": texts, "offer": f"Use V = {magnitude}"}
    elif star is not None and star.light is None:
        known["about"] = listed_note(name)
    rows: tuple[dict[str, Any], ...] = ()
    with contextlib.suppress(InputError):
        rows = targets(state.entered["targets"], check=False)
    return {"star": known, "targets": list(map(_target, rows))}


def _target(row: dict[str, Any]) -> dict[str, str]:
    """Return what is known of a target, as text for the page, or its fault."""
    try:
        star = PlanTarget.model_validate(row).target(simbad=False)
    except InputError as error:
        return {"fault": sentence(error)}
    facts = {"spectral_type": star.spectral_type, "V": star.magnitude, "distance_pc": star.distance_pc}
    target = {key: as_typed(value) for key, value in facts.items()}
    return target | {"coordinates": f"{star.ra_deg:.3f} {star.dec_deg:+.3f}", "about": star.source}


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
        return study_file(closed.study if needed is None else answers[needed].study, f"mauvecl-{name}")
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
