"""Pictures do not depend on how matplotlib shows figures."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

WORDS = ("exposure", "--star", "G2V", "-m", "7.4", "--snr", "10", "--at", "300", "--output", "out")
PYTHON = """
import sys
from mauvecl import Source
figure = Source.from_library("G2V").plot()
assert figure._repr_png_()[:8] == b"\\x89PNG\\r\\n\\x1a\\n"
assert "matplotlib.pyplot" not in sys.modules
"""


@pytest.mark.parametrize("backend", ["module://matplotlib_inline.backend_inline", "module://no.such.backend", "TkAgg"])
def test_any_backend_that_a_kernel_names(backend: str, tmp_path: Path) -> None:
    for words in (("-m", "mauvecl", *WORDS), ("-c", PYTHON)):
        done = subprocess.run(
            [sys.executable, *words],
            cwd=tmp_path,
            env=os.environ | {"MPLBACKEND": backend},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "exposure.png").stat().st_size > 1000


def test_the_command_line_runs_with_a_backend_that_does_not_exist(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mauvecl", *WORDS],
        cwd=tmp_path,
        env=os.environ | {"MPLBACKEND": "nonsense"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
