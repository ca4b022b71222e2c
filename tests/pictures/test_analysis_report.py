"""The report of an analysis: every table and picture, in HTML and PDF, with equal bytes for equal analyses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mauvecl import Study, analyse
from mauvecl.observations.frames import Frames


@pytest.mark.long
def test_report_has_every_table_remark_and_picture() -> None:
    pytest.importorskip("matplotlib")
    time, rng = np.arange(300) * 60.0, np.random.default_rng(1)
    light = rng.normal(100.0, 1.0, 300) + np.where(time > 9000, 30 * np.exp((9000 - time) / 600), 0.0)
    answer = analyse(Study(), frames=Frames.of(time, light, np.ones(300), name="<A & B>"))
    (page,) = (make().decode() for make in answer.documents.values())
    assert "<A & B>" not in page
    assert "&lt;A &amp; B&gt;: 300 frames" in page
    assert all(view.title.split(";")[0] in page.replace("&lt;A &amp; B&gt;", "<A & B>") for view in answer.views)
    assert page.count("<img") == len(answer.pictures)
    paper = replace(answer, study=Study(data={"report": "pdf"}))  # type: ignore[arg-type]
    (name,) = paper.documents
    assert name == "analyse.pdf"
    content = paper.documents[name]()
    assert content.startswith(b"%PDF")
    assert content == paper.documents[name]()
