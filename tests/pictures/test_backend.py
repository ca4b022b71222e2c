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
def test_picture_works_with_backend_named_by_kernel(backend: str, tmp_path: Path) -> None:
    if "inline" in backend:
        pytest.importorskip("matplotlib_inline", reason="matplotlib cannot be imported with a backend that is absent")
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


def test_command_line_works_with_unknown_backend(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "mauvecl", *WORDS],
        cwd=tmp_path,
        env=os.environ | {"MPLBACKEND": "nonsense"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
