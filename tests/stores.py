"""Small stores of raw spectra for tests, and the ways in which a disk or a process fails them."""

import fcntl
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import study_of_g2v

from mauvecl import Engine, Study

CHUNK, LAST = "star-1/quiescent/c/1/0", "star-1/flare-1/c/4/0"


def study(realisations: int = 300, **sections: Any) -> Study:
    """Return a study of one star with one flare on 197 pixels, by default of one frame."""
    observed = {"exposure_s": 5.0, "changes": {"output_min_nm": 300.0, "output_max_nm": 360.0}}
    observed |= sections.pop("observation", {})
    run = {"realisations": realisations, "seed": 11} | sections.pop("run", {})
    return study_of_g2v(observation=observed, run=run, **sections).paper()


@contextmanager
def locked(folder: Path, *, wait: bool = True) -> Iterator[None]:
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        yield
    finally:
        os.close(handle)


def tree(path: Path) -> dict[str, bytes]:
    found = {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}
    return {name: text for name, text in found.items() if not Path(name).name.startswith(".")}


def flip(path: Path, place: int = 100) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


class Painter(Engine):
    """Engine without chance and OpenCL, whose rows contain their number and the seed, for tests that fork."""

    def __init__(self) -> None:
        """Make an engine without a device."""

    def realise(self, x: Any, *, start: int, count: int, seed: int, **how: Any) -> NDArray[Any]:
        number = np.arange(start, start + count, dtype=np.uint64)[:, None] * np.uint64(6364136223846793005)
        rows = ((number >> np.uint64(40)) + np.arange(x.wavelength_nm.size, dtype=np.uint64)) % np.uint64(60000)
        return rows.astype(np.uint16) ^ np.uint16(seed)


PAINTER: Any = Painter()


def killed_at(step: int, work: Callable[[], object], *calls: tuple[Any, str]) -> bool:
    """Do work in a child that is killed at one of its calls of some functions; return whether there were so many."""
    counted = iter(range(step))

    def mortal(real: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*given: Any, **how: Any) -> Any:
            if next(counted, None) is None:
                os.kill(os.getpid(), signal.SIGKILL)
            return real(*given, **how)

        return wrapped

    child = os.fork()
    if child == 0:
        try:
            for owner, name in calls:
                setattr(owner, name, mortal(getattr(owner, name)))
            work()
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def full_after(n_bytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    left, real = n_bytes, os.fsync

    def fsync(handle: int) -> None:
        nonlocal left
        left -= os.fstat(handle).st_size
        if left < 0:
            raise OSError(28, "No space left on device")
        real(handle)

    monkeypatch.setattr(os, "fsync", fsync)
