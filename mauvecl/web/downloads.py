"""Downloads of the page: tables, documents, and the commands that reproduce them."""

from __future__ import annotations

import io
import json
import shlex
import tempfile
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from pprint import pformat
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from mauvecl.answers.verbs import VERBS
from mauvecl.schema import parsing
from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, found
from mauvecl.study.star import Star
from mauvecl.study.study import Study, keys_of, with_paths
from mauvecl.web.page import TABS
from mauvecl.web.question import asked

if TYPE_CHECKING:
    from mauvecl.answers.verbs import Verb
    from mauvecl.web.closed_forms import Answers, ClosedForms
    from mauvecl.web.question import Question
    from mauvecl.web.tab import Tab

#: Keys that are stated even at their default, so that readers see what was assumed.
STATED = ("star", "flare.amplitudes", "observation.exposure_s", "observation.instrument", "sky", "run.fap",
          "run.realisations", "run.seed")  # fmt: skip
#: Keys without a flag of their own verb that it uses: unknowns are drawn by everything that observes.
ALWAYS_USED = ("nuisances.", "observation.temperature_c")
#: Longest value in a command; a longer one is in the study file.
MOST_CHARACTERS = 500
#: Name of the study file in a command that needs it.
STUDY_FILE = "study.toml"

#: Arguments of verbs for what their command does if a flare is given.
OPTIONS = {"simulate": ", flaring=True"}

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
    for key, field in type(new).model_fields.items():
        name, values = f"{path}{key}", (getattr(new, key), getattr(old, key))
        # A new sky replaces all keys of the old one, and so does a section with a flag of its own.
        whole = name == "sky" or bool(found(field, Flag))
        if isinstance(values[0], BaseModel) and isinstance(values[1], BaseModel) and not whole:
            yield from differing(*values, f"{name}.")
        elif values[0] is not None and (values[0] != values[1] or name in STATED):
            yield name, _plain(values[0])


def _plain(value: Any) -> Any:
    """Return a value as TOML can hold it, without the defaults of records."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_defaults=True, exclude_none=True)
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return str(value) if isinstance(value, Path) else value


def as_program(verb: str, study: Study) -> str:
    """Return a question to a verb as a Python program."""
    data: dict[str, Any] = {}
    for name, value in keys_used(VERBS[verb], study, Study()):
        *sections, key = name.split(".")
        place = data
        for section in sections:
            place = place.setdefault(section, {})
        place[key] = value
    text = pformat(data, width=100, sort_dicts=False).replace("\n", "\n    ")
    return PROGRAM.format(verb=verb, data=text, options=OPTIONS.get(verb, ""))


def as_command(verb: str, study: Study) -> str:
    """Return a question to a verb as a command, which names a study file if flags cannot say all of it."""
    from_file = ["mauvecl", verb, STUDY_FILE]
    if any(file is not None for file in (study.flare.spectrum.file, *(star.file for star in study.star))):
        return shlex.join(from_file)
    question = VERBS[verb]
    base = Study().with_settings([f"{key}={value}" for key, value in (question.defaults or {}).items()])
    words = ["mauvecl", verb]
    for name, value in keys_used(question, study, base):
        if name == "data.file":
            words.insert(2, value)
        elif name == "star":
            words += [word for star in value for word in _star_words(star)]
        elif name == "sky":
            words += _sky_words(value)
        else:
            words += _flag_words(name, value, question) or ["--set", f"{name}={_toml(value)}"]
    long = any(len(word) > MOST_CHARACTERS for word in words)
    return shlex.join(from_file if long else words)


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
    """Return the words of a key's flag, or none if the verb has no flag that takes such a value."""
    for flag in (flag for key, _, flag in keys_of() if key == name and verb.accepts(name)):
        if isinstance(value, bool) and flag.read is None:
            on, _, off = flag.names[0].partition("/")
            return [on] if value else [off] if off else []
        if flag.read is parsing.line_fluxes:
            return [word for line, share in value.items() for word in (flag.names[0], f"{line}={share!r}")]
        if flag.read is parsing.axis and "start" in value:
            spaced = [value["quantity"], *(_text(value[key]) for key in ("start", "stop", "steps"))]
            return [flag.names[0], ":".join(spaced + ["log"] * value.get("log", False))]
        if flag.read in (None, parsing.words) and flag.kind in (None, str, list[str]):
            values = value if isinstance(value, list) else [value]
            if all(isinstance(item, str | int | float) for item in values):
                return [word for item in values for word in (flag.names[0], _text(item))]
    return []


def _star_words(star: dict[str, Any]) -> list[str]:
    """Return the flags of a star of the library."""
    names = {key: flag.names[0] for key, field in Star.model_fields.items() for flag in found(field, Flag)}
    usual = Star(library=star.get("library"))
    said = {key: value for key, value in star.items() if key in names and value != getattr(usual, key)}
    said = {"library": star.get("library")} | said
    return [word for key, value in said.items() for word in (names[key], _text(value))]


def _sky_words(sky: dict[str, Any]) -> list[str]:
    if sky.get("none"):
        return ["--sky", "none"]
    if "target" in sky:
        return ["--target", sky["target"], "--time", sky["time"]]
    return ["--sky", _text(sky["surface_brightness"])] if "surface_brightness" in sky else []


def _text(value: str | float) -> str:
    """Return a value as it is typed, with every digit of a number."""
    return value if isinstance(value, str) else f"{value:.17g}" if float(f"{value:.15g}") != value else f"{value:.15g}"


def _key(key: str) -> str:
    return key if key.isidentifier() and key.isascii() else json.dumps(key)


def _toml(value: Any) -> str:
    """Return a value as TOML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(key)} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False)


#: Held while matplotlib draws.
_drawing = threading.Lock()


def study_file(study: Study, name: str) -> tuple[str, bytes]:
    """Return name and content of the study file, in a zip archive with the visitor's files if there are any."""
    files, text = visitor_files(study), study.toml()
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


def visitor_files(study: Study) -> list[Path]:
    """Return the visitor's files that a study names, each once."""
    files: dict[Path, Path] = {}
    with_paths(study.model_dump(mode="json"), Study, lambda file: files.setdefault(file, file))
    return list(files)


def as_file(tab: Tab, name: str, ending: str, closed: ClosedForms, answers: Answers) -> tuple[str, bytes]:
    """Return file name and content of one of a tab's `files` or `documents`, or of the study that reproduces it.

    The ending is "ecsv", "fits" or "study", and empty for a document. Raises InputError if there is no such file, or it
    is not simulated yet.
    """
    from mauvecl.answers.answer import write_table

    if name in tab.documents and tab.documents[name] in answers:
        # Matplotlib's settings are those of the process.
        with _drawing:
            return name, answers[tab.documents[name]].documents[name]()
    if name not in tab.files or ending not in ("ecsv", "fits", "study"):
        raise InputError(f"{tab.title} has no file {name[:40]!r}.{ending[:10]}", "one of its own", key="name")
    if not tab.offers(name, answers):
        raise InputError(f"no {name} is computed yet: start a simulation first", key="name")
    if ending == "study":
        return study_file(tab.study(name, closed, answers), f"mauvecl-{name}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mauvecl-{name}.{ending}"
        write_table(tab.table(name, closed, answers), path)
        return path.name, path.read_bytes()


def commands_and_programs(tab: Tab, question: Question, folder: Path) -> list[dict[str, str]]:
    """Return each of a tab's `questions` as a command and as a Python program; `folder` holds the visitor's files."""
    entries = []
    for name in tab.questions:
        verb, study = asked(name, question.study(folder))
        # Paths relative to the study, instead of those on the server.
        data = with_paths(study.model_dump(mode="json"), Study, lambda file: Path(file.name))
        study = Study.build(data, "page")
        entries.append({"question": name, "command": as_command(verb, study), "python": as_program(verb, study)})
    return entries


def asked_study(name: str, study: Study) -> tuple[str, bytes]:
    """Return the study file of one of a tab's `questions`; raises InputError for any other name."""
    if name not in {question for tab in TABS.values() for question in tab.questions}:
        raise InputError(f"no tab asks {name[:40]!r}", "a question of a tab", key="name")
    _, wanted = asked(name, study)
    return study_file(wanted, "study")
