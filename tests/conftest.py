"""Shared fixtures: one engine for all tests, and the probe kernels behind a plain function."""

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from probes import Probes
from scenes import instrument, star

from mauvecl import Engine, Expectation, Instrument, Stares
from mauvecl.runs import checkpoint as shards


@pytest.fixture(scope="session", autouse=True)
def unsynchronised() -> Iterator[None]:
    """Leave written files to the system, which outlives processes that tests kill: a disk takes 10 ms for each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def interruptible() -> None:
    """Let tests interrupt commands: a shell that runs the tests in the background makes them ignore interrupts."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def engine() -> Engine:
    """Return the default engine, shared because a build takes a second."""
    return Engine()


@pytest.fixture(scope="session", params=["vector forms", "vectors of built-ins", "scalar"])
def probes(request: pytest.FixtureRequest, engine: Engine) -> Probes:
    """Return probes of PoCL's fast forms, of the plain vectors for other compilers, and of a GPU's scalars."""
    width = 1 if request.param == "scalar" else 16
    return Probes(device=engine.open_device, width=width, vector_forms=request.param == "vector forms")


@pytest.fixture(scope="session")
def one_by_one() -> Engine:
    """Return an engine with one realisation per work-item, as on a GPU."""
    return Engine(width=1)


@pytest.fixture(scope="session")
def stares(engine: Engine) -> Stares:
    return Stares(engine.open_device)


@pytest.fixture(scope="session")
def mauve() -> Instrument:
    return Instrument.load("mauvesim")


@pytest.fixture
def small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set shards of 4096 realisations."""
    monkeypatch.setattr(shards, "SHARD_WORK", 1)


@pytest.fixture
def small_disk(tmp_path: Path) -> Any:
    """Mount a separate file system of 2 MB, if tests may."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", place], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("file systems cannot be mounted here")
    yield place
    subprocess.run(["umount", "-l", place], check=True)


@pytest.fixture(scope="session")
def scene() -> list[Expectation]:
    """Return expectations of a star without and with two flares, on a part of the pixels."""
    return star(amplitudes=(0.05, 0.24), payload=instrument(part=True))


#: Files that take longest: a process that begins one of them last would work alone at the end.
LONGEST = ("test_page.py", "test_closed_loop.py", "test_unusual_light.py", "test_files.py", "test_spectra.py",
           "test_real_stars.py", "test_docs.py", "test_kernel_cache.py", "test_cluster.py",
           "test_server.py")  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort tests so that files with long ones run first, the longest before all others."""
    long = {item.path for item in items if item.get_closest_marker("long")}
    place = {name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: (place.get(item.path.name, len(LONGEST)), item.path not in long))
