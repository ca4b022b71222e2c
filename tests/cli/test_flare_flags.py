"""Flags of the flare's spectrum reach the study of every verb that takes a flare temperature."""

from __future__ import annotations

from pathlib import Path

import typer
from commands import run
from typer.main import get_command

from mauvecl import Study
from mauvecl.cli.app import app
from mauvecl.cli.flags import study_flags

STAR = ("--star", "M3V", "--magnitude", "9", "--amplitude", "0.05", "--no-pictures", "-n", "20000", "--fap", "0.01")


def test_flags_set_the_spectrum(tmp_path: Path) -> None:
    lines = ("--line", "Mg II=0.03", "--line", "280.5 = 0.01", "--line-flux", "H beta=1e-13")
    run("detect", *STAR, "--balmer-jump", "2.5", *lines, "--output", "out", folder=tmp_path)
    (file,) = (tmp_path / "out").glob("study.toml")
    light = Study.read(file).flare.spectrum
    assert light.balmer_jump == 2.5
    assert light.lines == {"Mg II": 0.03, "280.5": 0.01}
    assert light.line_fluxes == {"H beta": 1e-13}


def test_every_verb_with_flares_takes_the_flags() -> None:
    group = get_command(app)
    context = typer.Context(group)
    seen = 0
    for name in group.list_commands(context):  # type: ignore[attr-defined]
        names = {one.name for one in group.get_command(context, name).params}  # type: ignore[attr-defined]
        # `analyse` adds no flares: it takes the temperature of a blackbody that it looks for.
        if "flare_temperature" in names and name != "analyse":
            seen += 1
            assert names >= set(study_flags("flare.spectrum", defaults={})), name
    assert seen >= 8
