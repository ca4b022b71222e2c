"""Benches end if a process that they measure dies, and the list of mutations is in step with the code."""

import importlib
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scripts import ROOT, tool

check = tool("mutation_check")


def dies_at_start(model: Any) -> Any:
    """End as a peer does that the system kills while it compiles."""
    os.kill(os.getpid(), signal.SIGKILL)


def dies_in_a_run(model: Any) -> Any:
    """Return a peer that dies when its time is taken, after the check of its mean."""
    from peers import Peer

    return Peer("mortal", "1", 10, lambda n: dies_at_start(model) if n == 10 else np.full(n, 10.0))


@pytest.mark.long
@pytest.mark.parametrize("make", [dies_at_start, dies_in_a_run])
def test_death_of_a_peer_raises(make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    # Its child processes import the module, too.
    monkeypatch.syspath_prepend(ROOT / "bench")
    peers = importlib.import_module("peers")
    signal.signal(signal.SIGALRM, lambda *_: pytest.fail("waits for a process that has ended"))
    signal.alarm(60)
    try:
        with pytest.raises(ChildProcessError, match="ended with exit code -9"):
            peers.Child(make, peers.Model(*[np.ones(10, np.float32)] * 5)).seconds()
    finally:
        signal.alarm(0)


def test_every_mutation_has_its_texts_and_its_test() -> None:
    sources, tests = check.files_of(ROOT, *check.SOURCES), check.files_of(ROOT, "tests")
    assert len(check.MUTATIONS) >= 70
    for name, (test, *edits) in check.MUTATIONS.items():
        assert edits, name
        for text, changed in edits:
            assert text != changed, name
            place = check.place_of(text, sources)
            if place.suffix == ".py":
                # A mutant that cannot be imported proves nothing.
                compile(sources[place].replace(text, changed), name, "exec")
        check.node_of(test, tests)
    # Texts and tests that are missing or occur twice are refused.
    files = {Path("a.py"): "def test_a(\nx = 1\n", Path("b.py"): "def test_b(\ny = 1\nx = 1\n\ndef test_a(\n"}
    assert check.node_of("test_b[0.1]", files) == "b.py::test_b[0.1]"
    for find, one, words in (
        (check.place_of, "z = 1", "occurs 0 times"), (check.place_of, "x = 1", r"occurs 2 times \(a.py, b.py\)"),
        (check.node_of, "test_c", "in 0 files"), (check.node_of, "test_a", "in 2 files"),
    ):  # fmt: skip
        with pytest.raises(SystemExit, match=words):
            find(one, files)
