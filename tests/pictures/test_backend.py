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


@pytest.mark.long
@pytest.mark.parametrize(
    ("backend", "words"),
    [
        ("module://no.such.backend", ("-m", "mauvecl", *WORDS)),
        ("nonsense", ("-m", "mauvecl", *WORDS)),
        ("module://no.such.backend", ("-c", PYTHON)),
        ("TkAgg", ("-c", PYTHON)),
    ],
)
def test_pictures_do_not_load_the_backend(backend: str, words: tuple[str, ...], tmp_path: Path) -> None:
    """Notebooks name backends that are not installed, and others need a display."""
    environment = os.environ | {"MPLBACKEND": backend}
    done = subprocess.run([sys.executable, *words], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    if words[0] == "-m":
        assert (tmp_path / "out" / "exposure.png").stat().st_size > 1000
