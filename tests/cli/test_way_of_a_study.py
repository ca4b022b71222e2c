"""A study passes through few modules on its way from the command line to an answer."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import pytest
from commands import run

from mauvecl.study.study import Study

#: Largest number of modules whose functions receive a study.
MOST = 15
SMALL = ("injections.count=10", "injections.positions=2", "injections.sizes=2", "injections.widths=1",
         "injections.fitted=0", "search.nulls=0", "search.half_widths_s=[60]", "stare.duration_s=3600")  # fmt: skip


@contextmanager
def modules_that_receive_a_study() -> Iterator[set[str]]:
    """Collect the modules of mauvecl with functions that are called with a study, in all threads."""
    modules: set[str] = set()

    def watch(frame: FrameType, event: str, _: object) -> None:
        name = frame.f_globals.get("__name__", "")
        if event == "call" and name.startswith("mauvecl."):
            code = frame.f_code
            names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
            if any(isinstance(frame.f_locals.get(one), Study) for one in names):
                modules.add(name)

    before = sys.getprofile()
    threading.setprofile(watch)
    sys.setprofile(watch)
    try:
        yield modules
    finally:
        sys.setprofile(before)
        threading.setprofile(None)  # type: ignore[arg-type]


@pytest.mark.long
def test_inject_passes_its_study_through_few_modules(tmp_path: Path) -> None:
    settings = [word for setting in SMALL for word in ("--set", setting)]
    with modules_that_receive_a_study() as modules:
        run("inject", "--star", "G2V", "-m", "7.4", *settings, "--no-pictures", folder=tmp_path)
    assert {"mauvecl.answers.stares.inject", "mauvecl.study.cases"} <= modules
    assert len(modules) <= MOST, sorted(modules)
    assert not [
        name for name in modules if name.startswith(("mauvecl.lightcurve", "mauvecl.device", "mauvecl.results"))
    ]
