"""Answers to the reviewers' checklists name files and lines that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
#: `file` "text of a line in it".
EVIDENCE = re.compile(r'`([\w./-]+)` "([^"]+)"')


def test_answers_are_where_the_checklist_says() -> None:
    answers = EVIDENCE.findall((ROOT / "docs" / "review.md").read_text(encoding="utf-8"))
    assert len(answers) > 35
    missing = [(file, text) for file, text in answers if text not in (ROOT / file).read_text(encoding="utf-8")]
    assert not missing


def test_references_of_the_paper_are_cited_and_identified() -> None:
    paper = (ROOT / "paper" / "paper.md").read_text(encoding="utf-8")
    entries = (ROOT / "paper" / "paper.bib").read_text(encoding="utf-8").split("\n@")[1:]
    names = {re.match(r"\w+\{(\w+),", one)[1] for one in entries}  # type: ignore[index]
    assert names == set(re.findall(r"@(\w+)", paper))
    assert all("doi = {" in one or "eprint = {" in one for one in entries)
    assert 250 < len(paper.split("---", 2)[2].split()) < 1000
    for section in ("Summary", "Statement of need", "State of the field", "Acknowledgements", "References"):
        assert f"\n# {section}\n" in paper
