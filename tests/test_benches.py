"""Benches end if a process that they measure dies."""

import importlib
import os
import signal
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

BENCH = Path(__file__).parent.parent / "bench"

pytestmark = pytest.mark.long


@pytest.fixture
def peers(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the module of the peers, importable by its child processes too."""
    monkeypatch.syspath_prepend(BENCH)
    return importlib.import_module("peers")


def dies_at_start(model: Any) -> Any:
    """End as a peer does that the system kills while it compiles."""
    os.kill(os.getpid(), signal.SIGKILL)


def dies_in_a_run(model: Any) -> Any:
    """Return a peer that dies at its second run."""
    import numpy as np
    from peers import Peer

    runs: list[int] = []

    def chi2(n: int) -> Any:
        runs.append(n)
        if len(runs) > 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return np.full(n, 10.0)

    return Peer("mortal", "1", 10, chi2)


def model(peers: ModuleType) -> Any:
    import numpy as np

    return peers.Model(*[np.ones(10, np.float32)] * 5)


@pytest.mark.parametrize("make", [dies_at_start, dies_in_a_run])
def test_death_of_a_peer_raises(make: Any, peers: ModuleType) -> None:
    signal.signal(signal.SIGALRM, lambda *_: pytest.fail("waits for a process that has ended"))
    signal.alarm(60)
    try:
        with pytest.raises(ChildProcessError, match="ended with exit code -9"):
            peers.Child(make, model(peers)).seconds()
    finally:
        signal.alarm(0)
