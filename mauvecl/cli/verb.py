"""Decorator that makes a function of a session a command with a study file and flags."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, get_type_hints

from mauvecl.answers.verbs import OBSERVATION, VERBS
from mauvecl.cli.flags import PICTURES, RESUMING, TELLING, WORKERS, SetFlag, StudyFile, output_flag, study_flags
from mauvecl.cli.question import holds_study, is_star, study_of
from mauvecl.cli.values import as_text

if TYPE_CHECKING:
    from mauvecl.answers.verbs import DefaultStudy
    from mauvecl.cli.session import Session


class StudyCommand(NamedTuple):
    """Command with the flags of a study, which are built when it is called."""

    help: str
    build: Callable[[], Callable[..., None]]


#: Commands of verbs with a study by name, filled by `takes_study`.
COMMANDS: dict[str, StudyCommand] = {}


def takes_study(
    *keys: str,
    name: str = "",
    help: str = "",
    without: str = "",
    defaults: Mapping[str, Any] = MappingProxyType({}),
    writes: str = "",
    default: DefaultStudy | None = None,
    draws: bool = True,
    resumes: bool = False,
    pictures: bool = True,
    observation: Sequence[str] = OBSERVATION,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a function a command with a study file and flags, called with the session of the resulting study.

    Parameters
    ----------
    *keys : str
        Keys and sections of the study whose flags the verb accepts, in addition to those of the observation.
    name, help : str
        Name and help text of the command; by default the function's name and docstring.
    without : str
        Key of the observation that the verb does not accept.
    defaults : mapping
        Defaults of keys that differ from the study's.
    writes : str
        Default output, if it is not a folder of tables.
    default : callable, optional
        Function of the flags that returns the study if no file is given; the paper's question by default.
    draws, pictures : bool
        Whether the verb draws realisations, and whether it draws pictures.
    resumes : bool
        Whether a verb that draws no realisations can be resumed.
    observation : sequence of str
        Keys instead of those of an observation. With a flag `targets`, a table may replace the study file.

    Returns
    -------
    callable
        Decorator of functions whose first parameter is the session. A parameter `given` receives the
        flags; others are the verb's own options.
    """

    def decorate(verb: Callable[..., None]) -> Callable[..., None]:
        called = name or verb.__name__
        COMMANDS[called] = StudyCommand(help or inspect.getdoc(verb) or "", lambda: build(called, verb))
        return verb

    def build(called: str, verb: Callable[..., None]) -> Callable[..., None]:
        flags = study_flags(*(key for key in (*observation, *keys) if key != without), defaults=defaults)
        output = output_flag(writes or f"the folder mauvecl-{called}")
        around = (
            {"output": (output, None)}
            | TELLING
            | (PICTURES if pictures else {})
            | (WORKERS if draws else RESUMING if resumes else {})
        )
        kinds = get_type_hints(verb, localns={"Session": Any}, include_extras=True)
        _, *own = inspect.signature(verb).parameters.values()

        def command(study_file: Path | None = None, **values: Any) -> None:
            from mauvecl.cli.foresight import question_time, question_values
            from mauvecl.cli.session import Session
            from mauvecl.schema.errors import InputError

            for key, (shown, read) in readers.items():
                if values.get(key) is not None and not isinstance(values[key], int | float):
                    values[key] = read(values[key], shown)
            given = {key: values.pop(key, None) for key in (*flags, "set")}
            if "targets" in flags and study_file is not None and not holds_study(study_file):
                given["targets"], study_file = study_file, None
            if "data" in flags and study_file is not None and study_file.suffix.lower() != ".toml":
                if given["data"] is not None:
                    raise InputError(
                        f"{str(study_file)!r} and --data are both observed frames", "one of them", key="data"
                    )
                given["data"], study_file = study_file, None
            if "star" in flags and study_file is not None and is_star(study_file):
                if given["star"]:
                    raise InputError(
                        f"{str(study_file)!r} and --star are both stars",
                        "one of them",
                        key="star",
                        value=str(study_file),
                    )
                given["star"], study_file = [str(study_file)], None
            if study_file is None:
                for one in flags.values():
                    if given[one.name] is None:
                        given[one.name] = defaults.get(f"{one.section}.{one.key}")
            how = {key: values.pop(key, usual) for key, (_, usual) in around.items()}
            if "given" in kinds:
                values["given"] = given
            study = study_of(study_file, given, flags, default)
            question_values(study, detects={"fap", "realisations"} <= flags.keys())
            if draws:
                question_time(study, **{key: how[key] for key in ("device", "cluster", "insist")})
            with Session(called, study, **how) as session:
                verb(session, **values)

        named = inspect.Parameter.KEYWORD_ONLY
        parameters = [
            inspect.Parameter("study_file", named, default=None, annotation=StudyFile),
            *(inspect.Parameter(key, named, default=None, annotation=one.kind) for key, one in flags.items()),
            inspect.Parameter("set", named, default=None, annotation=SetFlag),
            *(p.replace(kind=named, annotation=kinds[p.name]) for p in own if p.name != "given"),
            *(inspect.Parameter(key, named, default=usual, annotation=kind) for key, (kind, usual) in around.items()),
        ]
        readers = {}
        for place, parameter in enumerate(parameters):
            # Numbers are taken as text, so that messages have one style.
            kind, shown, read = as_text(parameter.annotation)
            if read is not None:
                readers[parameter.name] = shown or "--" + parameter.name.replace("_", "-"), read
                default_text = None if parameter.default is None else f"{parameter.default:g}"
                parameters[place] = parameter.replace(annotation=kind, default=default_text)
        command.__name__ = called
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {p.name: p.annotation for p in parameters}
        return command

    return decorate


def command_of(
    name: str, *, draws: bool | None = None, resumes: bool = False
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a function of the session the command of a registered verb.

    Parameters
    ----------
    draws : bool, optional
        Whether a pool draws; by default if the verb counts something.
    resumes : bool
        As for `takes_study`.
    """
    verb = VERBS[name]
    return takes_study(
        *verb.takes,
        name=name,
        help=verb.help,
        without=verb.without,
        defaults=verb.defaults or {},
        default=verb.default,
        draws=bool(verb.counts) if draws is None else draws,
        resumes=resumes,
        observation=verb.observation,
    )


def add_plain_commands() -> None:
    """Add the commands of verbs without their own function, which compute and print the answer."""

    def ask(session: Session) -> None:
        session.answer(session.ask())

    for name in VERBS:
        if name not in COMMANDS:
            command_of(name)(ask)
