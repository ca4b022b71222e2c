"""The examples of the page about mappings are read as it says; other layouts are in tests/data/corpus."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from layouts import documented_files

from mauvecl import read_frames


def test_every_example_of_the_page_gives_the_same_frames(tmp_path: Path) -> None:
    documented_files(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "mapping.md").read_text(encoding="utf-8")
    examples = re.findall(
        r"```toml\n# ([\w-]+\.toml)\n(.*?)```.*?read_frames\(\"([\w.-]+)\", \"\1\"\)", page, re.DOTALL
    )
    assert [name for name, _, _ in examples] == re.findall(r"^# ([\w-]+\.toml)$", page, re.MULTILINE)
    assert len(examples) == 6
    for name, text, file in examples:
        (tmp_path / name).write_text(text)
        frames = read_frames(tmp_path / file, tmp_path / name)
        np.testing.assert_allclose(frames.flux, 100.0 + np.arange(120.0).reshape(30, 4))
        assert frames.error is not None
        np.testing.assert_allclose(frames.error, frames.flux / 10)
        assert frames.wavelength_nm is not None
        # The page's images have wavelengths in air, by a refractive index of 1.00028 within 1e-5.
        np.testing.assert_allclose(frames.wavelength_nm, [300.25, 400.25, 500.25, 600.25], rtol=2e-5)
        assert frames.date(float(frames.time_s[0]))[:21] == ("2026-03-01T00:00:02.5")
        np.testing.assert_allclose(np.diff(frames.time_s), 5.0, atol=1e-3)
        np.testing.assert_allclose(frames.exposure_s, 5.0)
