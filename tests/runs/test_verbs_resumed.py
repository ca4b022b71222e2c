"""Verbs that are killed and resumed give the same tables, and compute nothing twice."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import run

PLAN = """
plan = {targets = [{name = "eps Eri"}, {name = "GJ 205"}], hours = 10, injections = 20}
orbit = {days = 3, step_s = 300}
search = {half_widths_s = [120]}
"""
STARE = """
star = [{library = "M3V", magnitude = 9}, {library = "K5V", magnitude = 8}]
stare = {duration_s = 1000}
search = {half_widths_s = [60]}
"""
MEASURE = """
star = [{library = "M3V", magnitude = 9}]
flare = {amplitudes = [0.1, 0.3, 0.5, 1.0], spectrum = {balmer_jump = 2}}
measure = {fits = 60}
nuisances = {dark = "free"}
"""


@pytest.mark.long
@pytest.mark.parametrize(("verb", "study"), [("plan", PLAN), ("stare", STARE), ("measure", MEASURE)])
def test_killed_run_is_resumed_to_the_same_bits(verb: str, study: str, tmp_path: Path) -> None:
    """Kill a run twice: what it had finished is not written again, and the tables are those of an undisturbed run."""
    (tmp_path / "study.toml").write_text(study)
    words = [verb, "study.toml", "--no-pictures", "--quiet"]
    script = (
        "from mauvecl.runs.checkpoint import Checkpoint; Checkpoint.__init__.__kwdefaults__['patience_s'] = 0.0; "
        "from mauvecl.cli.app import main; main()"
    )
    again = [sys.executable, "-c", script, *words, "--output", "out", "--resume"]
    kept = tmp_path / "out" / "checkpoint"

    def finished() -> dict[str, int]:
        return {path.name: path.stat().st_mtime_ns for path in kept.glob("[!.]*.npz")}

    before: dict[str, int] = {}
    for _ in range(2):
        process = subprocess.Popen(again, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        while finished().keys() <= before.keys():
            time.sleep(0.005)
            assert process.poll() is None, process.communicate()
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=60)
        now = finished()
        assert before.items() <= now.items(), "what was finished is kept, and not written again"
        before = now
    refusal = run(*words, "--output", "out", folder=tmp_path, code=2).stderr
    assert "--resume" in refusal
    assert "--restart" in refusal
    done = subprocess.run(again, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not kept.exists()
    run(*words, "--output", "whole", folder=tmp_path)
    tables = sorted((tmp_path / "whole").glob("*.ecsv"))
    assert len(tables) >= 2
    for path in tables:
        assert (tmp_path / "out" / path.name).read_bytes() == path.read_bytes()
    assert json.loads((tmp_path / "out" / "run.json").read_text())["verb"] == verb
