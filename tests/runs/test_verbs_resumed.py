"""Plans and stares that are resumed give the same tables and compute nothing twice."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run

from mauvecl import Engine, LocalWorkers, Pool, Stares, Study, measure, plan
from mauvecl.answers.campaigns import planned_injections
from mauvecl.answers.stares import stare as stares_module
from mauvecl.runs.checkpoint import Checkpoint, kept

PLAN = [
    "plan.targets=[{name = 'eps Eri'}, {name = 'GJ 205'}]",
    "orbit.days=3",
    "orbit.step_s=120",
    "plan.hours=10",
    "plan.injections=40",
    "search.half_widths_s=[30, 120]",
]
MEASURE = ("measure", "--star", "M3V", "-m", "9", "--sweep", "amplitude=0.1,0.3,0.5,1", "--no-pictures",
           "--fits", "300", "--nuisance", "dark=free")  # fmt: skip


class StoppedError(Exception):
    """Error that ends a run in these tests."""


def unfinished(folder: Path, verb: str, study: Study, question: Any, compute: Any, **how: Any) -> Any:
    """Compute one part of a run, which ends before it is finished."""
    with Checkpoint(folder, verb, study, patience_s=0.0, **how) as checkpoint:
        return kept(checkpoint, question, compute)


def test_checkpoint_computes_once(tmp_path: Path) -> None:
    made = []

    def compute() -> dict[str, Any]:
        made.append(1)
        return {"values": np.arange(3.0) / 7}

    for resume in (False, True, True):
        found = unfinished(tmp_path, "plan", Study(), ("this", 1), compute, resume=resume)
        np.testing.assert_array_equal(found["values"], np.arange(3.0) / 7)
    assert len(made) == 1
    with Checkpoint(tmp_path, "plan", Study(), resume=True, patience_s=0.0) as checkpoint:
        kept(checkpoint, ("this", 2), compute)
    assert len(made) == 2, "another question is another computation"


@pytest.mark.long
def test_plan_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    study, inject, asked = Study().with_settings(PLAN), planned_injections.inject, []

    def counted(question: Study, *engine: Any) -> Any:
        asked.append(question.star[0].library)
        return inject(question, *engine)

    monkeypatch.setattr(planned_injections, "inject", counted)

    def stop(done: int, total: int) -> None:
        if done == 1:
            raise StoppedError

    def planned(progress: Any, **how: Any) -> Any:
        with Checkpoint(tmp_path, "plan", study, patience_s=0.0, **how) as checkpoint:
            workers = LocalWorkers([None])
            try:
                return plan(study, engine=Pool(workers, checkpoint=checkpoint), progress=progress)
            finally:
                workers.close()

    with pytest.raises(StoppedError):
        planned(stop)
    resumed = planned(None, resume=True)
    # The second target was in progress when the run ended.
    assert asked.count(resumed.stars["spectrum"][0]) == 1, "the first target is kept"
    assert 2 <= len(asked) <= 3
    whole = plan(study)
    for name, table in whole.tables.items():
        for column in table.colnames:
            np.testing.assert_array_equal(np.asarray(resumed.tables[name][column]), np.asarray(table[column]))


@pytest.mark.long
def test_stare_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that drawn frames and sampled thresholds are kept."""
    settings = ["star=[{library = 'M3V', magnitude = 9}, {library = 'K5V', magnitude = 8}]", "stare.duration_s=2000"]
    study = Study().with_settings([*settings, "search.half_widths_s=[30, 120]"])
    drawn: list[int] = []

    class Counting(Stares):
        def frames(self, *given: Any, **more: Any) -> Any:
            drawn.append(1)
            return super().frames(*given, **more)

    whole = stares_module.stare(study, Counting())
    each, alarms = len(drawn), stares_module.alarms
    drawn.clear()
    searched = []

    def stopping(*given: Any) -> Any:
        searched.append(1)
        if len(searched) == 2:
            raise StoppedError
        return alarms(*given)

    monkeypatch.setattr(stares_module, "alarms", stopping)
    with pytest.raises(StoppedError), Checkpoint(tmp_path, "stare", study, patience_s=0.0) as checkpoint:
        stares_module.stare(study, Counting(), checkpoint=checkpoint)
    assert len(drawn) == each
    with Checkpoint(tmp_path, "stare", study, resume=True) as checkpoint:
        resumed = stares_module.stare(study, Counting(), checkpoint=checkpoint)
        # Frames of both stars and their thresholds.
        assert checkpoint.resumed == each + 2
    assert len(drawn) == each, "no frame is drawn again"
    for name, table in whole.tables.items():
        for column in table.colnames:
            np.testing.assert_array_equal(np.asarray(resumed.tables[name][column]), np.asarray(table[column]))


@pytest.mark.long
def test_measurement_is_resumed(tmp_path: Path) -> None:
    """Read finished fits; the answer has the bits of one engine alone."""
    settings = [
        "star=[{library='M3V', magnitude=9}]",
        "flare.amplitudes=[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]",
        "measure.fits=60",
    ]
    study = Study().with_settings([*settings, "flare.spectrum.balmer_jump=2", "nuisances.dark=free"])
    drawn: list[int] = []

    class Counting(Engine):
        def count(self, *given: Any, **more: Any) -> Any:
            drawn.append(1)
            return super().count(*given, **more)

    def stop(done: int, total: int) -> None:
        raise StoppedError

    def measured(progress: Any, **how: Any) -> Any:
        with Checkpoint(tmp_path, "measure", study, patience_s=0.0, **how) as checkpoint:
            workers = LocalWorkers([None], make=Counting)
            try:
                return measure(study, Pool(workers, checkpoint=checkpoint), progress), checkpoint.resumed
            finally:
                workers.close()

    with pytest.raises(StoppedError):
        measured(stop)
    drawn.clear()
    resumed, kept_flares = measured(None, resume=True)
    # A pool prepares some flares while the first is finished, but not all of them.
    assert 1 <= kept_flares < 6
    assert len(drawn) == 6 - kept_flares, "flares that are kept are not drawn again"
    whole = measure(study, Engine())
    assert resumed == whole
    for name, table in whole.tables.items():
        for column in table.colnames:
            np.testing.assert_array_equal(np.asarray(resumed.tables[name][column]), np.asarray(table[column]))


@pytest.mark.long
def test_killed_run_is_resumed_to_the_same_bits(tmp_path: Path) -> None:
    """Kill and resume a run; its tables equal those of a run that was never stopped."""
    again = [sys.executable, "-m", "mauvecl", *MEASURE, "--output", "out", "--resume", "--keep-after", "0"]
    folder = tmp_path / "out" / "checkpoint"

    def files() -> int:
        return len(list(folder.glob("[!.]*-0-0-1.npz")))

    process = subprocess.Popen(again, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not files():
        time.sleep(0.005)
        assert process.poll() is None, process.communicate()
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    assert files() >= 1
    done = subprocess.run(again, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not folder.exists()
    run(*MEASURE, "--output", tmp_path / "whole", folder=tmp_path)
    tables = sorted((tmp_path / "whole").glob("*.ecsv"))
    assert len(tables) >= 2
    for path in tables:
        assert (tmp_path / "out" / path.name).read_bytes() == path.read_bytes()
    assert json.loads((tmp_path / "out" / "run.json").read_text())["verb"] == "measure"


def test_unfinished_run_is_not_overwritten(tmp_path: Path) -> None:
    study = Study().with_settings(["star=[{library = 'M3V', magnitude = 9}]"])
    (tmp_path / "mauvecl-stare").mkdir()
    unfinished(tmp_path / "mauvecl-stare", "stare", study, ("some part",), lambda: {"values": np.zeros(1)})
    done = run("stare", "--star", "M3V", "-m", "9", folder=tmp_path, code=2)
    assert "--resume" in done.stderr
    assert "--restart" in done.stderr
