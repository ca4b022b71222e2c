"""What the documentation shows runs: the code of README and pages, word for word but for the number of realisations."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from mauvecl.study import Study

ROOT = Path(__file__).parent.parent
#: Pages whose Python runs as it stands; others need files or a cluster, and say so.
PAGES = ("README.md", "docs/tutorial.md", "docs/signal.md", "docs/limits.md", "docs/detection.md", "docs/processes.md")


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page)])
def test_python_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder with a study, and after the tutorial, as a reader comes to the other pages."""
    monkeypatch.chdir(tmp_path)
    study = {"star": [{"library": "G2V", "magnitude": 9.0}], "run": {"realisations": 100_000, "statistics": ["chi2"]}}
    Path("study.toml").write_text(Study.build(study, "test").toml())
    names: dict[str, object] = {}
    if page not in ("README.md", "docs/tutorial.md"):
        exec(blocks("docs/tutorial.md")[0].replace("1_000_000", "100_000"), names)
        names |= {"flares": [names["flare"]], "weights": np.ones(names["quiet"].wavelength_nm.size)}  # type: ignore[attr-defined]
    for text in blocks(page):
        exec(compile(text.replace("1_000_000", "100_000"), page, "exec"), names)


def test_no_page_is_left_out_of_the_contents() -> None:
    contents = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    pages = [p for p in (ROOT / "docs").glob("*.md") if p.name != "index.md"]
    pages += list((ROOT / "docs" / "notebooks").glob("*.ipynb"))
    for page in pages:
        assert str(page.relative_to(ROOT / "docs").with_suffix("")) in contents


def test_notebooks_are_kept_without_their_output() -> None:
    for page in (ROOT / "docs" / "notebooks").glob("*.ipynb"):
        cells = json.loads(page.read_text(encoding="utf-8"))["cells"]
        assert all(not cell.get("outputs") for cell in cells), page.name
