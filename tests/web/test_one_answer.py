"""The same questions asked on the command line, in Python and on the page have the same answers, to the digits."""

import io
import json
import re
from pathlib import Path
from typing import Any

import pytest
from astropy.table import QTable
from commands import run
from visits import Server, Talk, link

from mauvecl import Study, detect, plan

#: Questions: star, magnitude, amplitude in per cent, exposure in s, and further fields of the page, flags and settings.
MORE: dict[str, tuple[dict[str, str], list[str], list[str]]] = {
    "": ({}, [], []),
    "hot flare": ({"flare_temperature_k": "15000"}, ["--flare-temperature", "15000"], ["flare.temperature_k=15000"]),
    "cold": ({"temperature_c": "10"}, ["--temperature", "10"], ["observation.temperature_c=10"]),
    "paper": ({"instrument": "mauvesim"}, ["--instrument", "mauvesim"], ["observation.instrument=mauvesim"]),
    "dark sky": ({"sky": "none"}, ["--sky", "none"], ["sky={none=true}"]),
}
DETECTIONS = [
    ("M3V", "9", "2", "50", ""), ("M3V", "10.5", "24", "50", ""), ("G2V", "7.4", "0.76", "50", ""),
    ("G2V", "8.5", "2", "300", ""), ("K5V", "8", "5", "5", ""), ("AU Mic", "8.81", "1", "60", ""),
    ("M3V", "9", "2", "50", "hot flare"), ("M3V", "9", "2", "50", "cold"), ("M3V", "9", "2", "50", "paper"),
    ("K3V", "9", "3", "50", "dark sky"),
]  # fmt: skip
FAP, N = "0.1", "2000"
TARGETS, HOURS = ("eps Eri", "GJ 205", "YZ CMi", "AD Leo"), "100"


def on_the_command_line(folder: Path, *words: str) -> dict[str, Any]:
    return dict(json.loads(run(*words, "--no-pictures", "--json", folder=folder).stdout))


def test_chances_are_the_same_everywhere(server: Server, tmp_path: Path) -> None:
    """Both chances of ten flares, which are twenty numbers, by the closed form that all three give.

    The page says them before a simulation in the words of the command line.
    """

    async def of_the_page(talk: Talk) -> list[tuple[list[float], str, str]]:
        found = []
        for star, magnitude, percent, exposure, more in DETECTIONS:
            entered = {"star": star, "magnitude": magnitude, "amplitude_percent": percent, "exposure_s": exposure}
            answer = (await talk.answer(link(**entered | {"fap": FAP} | MORE[more][0])))["answer"]
            found.append(([one["value"] for one in answer["numbers"]], answer["headline"], answer["shown"]))
        return found

    answers = zip(DETECTIONS, server.visited(of_the_page), strict=True)
    for (star, magnitude, percent, exposure, more), (page, sentence, shown) in answers:
        _, flags, settings = MORE[more]
        words = ["detect", "--star", star, "-m", magnitude, "-a", f"{percent}%", "-t", exposure, "-n", N, "--fap", FAP]
        answer = on_the_command_line(tmp_path, *words, *flags)
        (row,) = answer["rows"]
        said = re.sub(r"(?<=a chance of ).* % \(.*; ", f"{shown} (", answer["headline"])
        assert sentence == f"{said[:-1]}, by the estimate before a simulation.", "in the same words"
        python = Study().with_settings([
            f"star=[{{library='{star}', magnitude={magnitude}}}]", f"flare.amplitudes=[{float(percent) / 100}]",
            f"observation.exposure_s={exposure}", f"run.realisations={N}", f"run.fap={FAP}", *settings,
        ])  # fmt: skip
        (ours,) = detect(python).table
        for number, column in enumerate(("closed_form_probability", "ideal")):
            assert row[column] == pytest.approx(page[number], rel=1e-9), (star, column)
            assert row[column] == pytest.approx(ours[column], rel=1e-12), (star, column)
        assert row["probability"] == ours["probability"]


def test_plans_are_the_same_everywhere(server: Server, tmp_path: Path) -> None:
    """Headline, flares, their ideal number and the energy that half of them have, of four targets: twelve numbers."""
    asked = link(targets="\n".join(TARGETS), hours=HOURS, start="2027-01-01", days="30")

    async def of_the_page(talk: Talk) -> tuple[str, bytes]:
        assert (await talk.simulate("plan", asked)).startswith("Done")
        headline = (await talk.answer(asked, "plan"))["answer"]["headline"]
        command = (await talk.exported(f"{asked}&temperature_c=21", "plan"))["plan"]["command"]
        assert "--temperature 21" in command, "what is entered is no default"
        return headline, (await talk.file(link=asked, tab="plan", name="plan", ending="ecsv"))[1]

    headline, table = server.visited(of_the_page)
    page = QTable.read(io.BytesIO(table), format="ascii.ecsv")
    (tmp_path / "targets.csv").write_text("\n".join(["name", *TARGETS]) + "\n")
    words = ("plan", "targets.csv", "--hours", HOURS, "--start", "2027-01-01", "--days", "30")
    answer = on_the_command_line(tmp_path, *words)
    python = plan(Study().with_settings([
        f"plan.targets=[{', '.join(f'{{name={name!r}}}' for name in TARGETS)}]", f"plan.hours={HOURS}",
        "orbit.start=2027-01-01", "orbit.days=30",
    ]))  # fmt: skip
    assert answer["headline"] == headline, "in the same words"
    assert "detector temperature along the orbit" in answer["assumed"]
    for k, row in enumerate(answer["rows"]):
        for column in ("expected", "ideal", "E50"):
            numbers = [float(getattr(table[column], "value", table[column])[k]) for table in (page, python.table)]
            assert [row[column]] * 2 == pytest.approx(numbers, rel=1e-9), (row["target"], column)
