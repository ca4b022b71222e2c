"""Downloads: tables, and the study that reproduces them as a file, program or command."""

from __future__ import annotations

import io
import json
import shlex
import tempfile
import zipfile
from pathlib import Path
from pprint import pformat
from typing import TYPE_CHECKING

from mauvecl.schema.errors import InputError
from mauvecl.web.question import STAR_FILE

if TYPE_CHECKING:
    from mauvecl.study.study import Study
    from mauvecl.web.closed_forms import ClosedForms
    from mauvecl.web.question import Question
    from mauvecl.web.tabs.tab import Answers, Tab

PYTHON = """from mauvecl import Engine, Study, detect

study = Study.build(
    {data},
    "page",
)
answer = detect(study, Engine())
print(answer.table)
"""


def study_file(study: Study, name: str) -> tuple[str, bytes]:
    """Return name and content of the study file, in a zip archive with an uploaded star."""
    file = study.star[0].file
    if file is None:
        return f"{name}.toml", study.toml().encode()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.write(file, STAR_FILE)
        # Path relative to the study, instead of that on the server.
        archive.writestr("study.toml", study.toml().replace(str(file.resolve()), STAR_FILE))
    return f"{name}.zip", out.getvalue()


def as_file(tab: Tab, name: str, ending: str, closed: ClosedForms, answers: Answers) -> tuple[str, bytes]:
    """Return file name and content of a tab's table, or of the study that reproduces it.

    Parameters
    ----------
    tab : Tab
    name : str
        One of the tab's `files`.
    ending : {"ecsv", "fits", "study"}
    closed : ClosedForms
    answers : mapping
        Answers that are simulated, by name.

    Raises
    ------
    InputError
        If there is no such table, or it is not simulated yet.
    """
    from mauvecl.answers.files import write_table

    if name not in tab.files or ending not in ("ecsv", "fits", "study"):
        raise InputError(
            f"{tab.title} has no file {name[:40]!r}.{ending[:10]}", "one of its own", key="name", value=name
        )
    wanted = tab.files[name]
    if wanted is not None and wanted not in answers:
        raise InputError(f"no {name} is computed yet", "a simulation first", key="name", value=name)
    if ending == "study":
        return study_file(tab.study(name, closed, answers), f"mauvecl-{name}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"mauvecl-{name}.{ending}"
        write_table(tab.table(name, closed, answers), path)
        return path.name, path.read_bytes()


def as_python(question: Question) -> str:
    """Return the question as a Python program."""
    data = pformat(question.data(), indent=4, width=100, sort_dicts=False)
    return PYTHON.format(data=data.replace("\n", "\n    "))


def as_command(question: Question) -> str:
    """Return the question as a command; an uploaded spectrum requires the study file."""
    q = question
    if q.uploaded is not None or len(q.own_unknown) > 20:
        return "mauvecl detect study.toml"
    data = q.data()
    spectrum = data["flare"].get("spectrum", {})
    words = ["mauvecl", "detect", "--star", q.star, "--magnitude", f"{q.magnitude:.15g}", "--band", q.band]
    words += [
        "--amplitude",
        repr(data["flare"]["amplitudes"][0]),
        "--flare-temperature",
        f"{q.flare_temperature_k:.15g}",
    ]
    for key, flag in (
        ("balmer_jump", "--balmer-jump"),
        ("second_temperature_k", "--second-temperature"),
        ("second_area", "--second-area"),
    ):
        words += [flag, f"{spectrum[key]:.15g}"] if key in spectrum else []
    for name, fraction in q.lines:
        words += ["--line", f"{name}={fraction:.15g}"]
    words += ["--exposure", f"{q.exposure_s:.15g}", "--instrument", q.instrument]
    words += ["--temperature", f"{q.temperature_c:.15g}"]
    words += {
        "brightness": ["--sky", f"{q.sky_brightness:.15g}"],
        "target and time": ["--target", q.target, "--time", q.time],
        "none": ["--sky", "none"],
    }[q.sky]
    for name in data["run"]["statistics"]:
        words += ["--statistic", name]
    words += ["--fap", f"{q.fap:.15g}", "--realisations", str(q.realisations.number), "--seed", str(q.seed)]
    if q.unknown == "the usual":
        words.append("--with-unknowns")
    if q.own_unknown:
        points = ", ".join(f"[{nm!r}, {dn!r}]" for nm, dn in q.own_unknown)
        words += ["--set", f"nuisances.own.own.points=[{points}]"]
    if q.see.strip():
        words += ["--set", f"orbit.targets={json.dumps([q.see.strip()])}", "--set", f"plan.hours={q.hours!r}"]
    if q.signal != "net":
        words += ["--set", f"observation.signal={q.signal}"]
    if q.realisations.tails != "counted":
        words += ["--set", f"run.tails={q.realisations.tails}"]
    return shlex.join(words)
