"""Downloads: tables, and the studies that reproduce them, with their commands and programs."""

from __future__ import annotations

import io
import tempfile
import threading
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from mauvecl.schema.errors import InputError
from mauvecl.study.calibrations import PATHS
from mauvecl.web.commands import as_command, as_program
from mauvecl.web.simulations import asked
from mauvecl.web.standards import placed
from mauvecl.web.tabs import TABS

if TYPE_CHECKING:
    from mauvecl.study.study import Study
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.question import Question
    from mauvecl.web.tabs.tab import Answers, Tab


#: Held while matplotlib draws.
_drawing = threading.Lock()


def study_file(study: Study, name: str) -> tuple[str, bytes]:
    """Return name and content of the study file, in a zip archive with the visitor's files if there are any."""
    files, text = [*visitor_files(study).values(), *observation_files(study)], study.toml()
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


def visitor_files(study: Study) -> dict[tuple[str, ...], Path]:
    """Return the visitor's files that a study names, by the path of sections and key."""
    star, light, data = study.star[0], study.flare.spectrum, study.data
    every = {("star", "file"): star.file, ("star", "neighbours"): star.neighbours,
             ("flare", "spectrum", "file"): light.file, ("flare", "spectrum", "quiescent"): light.quiescent,
             ("change", "file"): study.change.file, ("data", "file"): data.file,
             ("data", "mapping"): data.mapping}  # fmt: skip
    return {place: file for place, file in every.items() if file is not None}


def observation_files(study: Study) -> list[Path]:
    """Return the visitor's files that the observations of a calibration name, without duplicates."""
    rows = study.calibrate.observations
    every = (getattr(one, key) for one in rows for key in PATHS)
    return list(dict.fromkeys(file for file in every if file is not None))


def as_file(tab: Tab, name: str, ending: str, closed: ClosedForms, answers: Answers) -> tuple[str, bytes]:
    """Return file name and content of a tab's table, or of the study that reproduces it.

    Parameters
    ----------
    tab : Tab
    name : str
        One of the tab's `files`.
    ending : {"ecsv", "fits", "study"}
        Empty for a document.
    closed : ClosedForms
    answers : mapping
        Simulated answers by name.

    Raises
    ------
    InputError
        If there is no such table, or it is not simulated yet.
    """
    from mauvecl.answers.files import write_table

    if name in tab.documents and tab.documents[name] in answers:
        # Matplotlib's settings are those of the process.
        with _drawing:
            return name, answers[tab.documents[name]].documents[name]()
    if name not in tab.files or ending not in ("ecsv", "fits", "study"):
        raise InputError(
            f"{tab.title} has no file {name[:40]!r}.{ending[:10]}", "one of its own", key="name", value=name
        )
    if not tab.offers(name, answers):
        raise InputError(f"no {name} is computed yet", "a simulation first", key="name", value=name)
    if ending == "study":
        return study_file(tab.study(name, closed, answers), f"mauvecl-{name}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mauvecl-{name}.{ending}"
        write_table(tab.table(name, closed, answers), path)
        return path.name, path.read_bytes()


def commands_and_programs(tab: Tab, question: Question, folder: Path) -> list[dict[str, str]]:
    """Return each of a tab's `questions` as a command and as a Python program.

    Parameters
    ----------
    tab : Tab
    question : Question
    folder : Path
        Where the visitor's files are.
    """
    found = []
    for name in tab.questions:
        verb, study = asked(name, question.study(folder))
        for place, file in visitor_files(study).items():
            # Relative to the study, instead of that on the server.
            study = study.with_value(place, Path(file.name))
        if rows := placed(study.calibrate.observations, lambda file: file.name):
            study = study.with_changes({"calibrate": {"observations": rows}}, None, "page")
        found.append({"question": name, "command": as_command(verb, study), "python": as_program(verb, study)})
    return found


def asked_study(name: str, study: Study) -> tuple[str, bytes]:
    """Return the study file of one of a tab's `questions`; raises InputError for any other name."""
    if name not in {one for tab in TABS.values() for one in tab.questions}:
        raise InputError(f"no tab asks {name[:40]!r}", "a question of a tab", key="name", value=name)
    _, wanted = asked(name, study)
    return study_file(wanted, "study")
