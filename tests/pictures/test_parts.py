"""Pictures and tables that show a part of an answer state how large the part is."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from marks import long_but

import mauvecl
from mauvecl.answers.answer import Answer
from mauvecl.answers.detection.detect import detect
from mauvecl.answers.measurements.measure import measure
from mauvecl.answers.signal.snr import snr
from mauvecl.answers.stares.inject import inject
from mauvecl.device.engine import Engine
from mauvecl.device.stare_engine import Stares
from mauvecl.pictures import answers, injections, measurements
from mauvecl.pictures.registry import pictures_of
from mauvecl.study.parts import First, note_of, part_note
from mauvecl.study.study import Study
from mauvecl.study.unknowns import describe_shares

SMALL = ("run.realisations=2000", "run.fap=0.1", 'star=[{library="G2V", magnitude=7.4}]', "flare.amplitudes=[0.5]")
INJECTED = (
    "stare.duration_s=1500", "injections.count=10", "injections.sizes=3", "injections.widths=8",
    "injections.fitted=2", "injections.positions=2", "search.nulls=0",
)  # fmt: skip


def study(*more: str) -> Study:
    return Study().with_settings([*SMALL, *more])


CASES: dict[str, tuple[Callable[[], Any], str, tuple[Any, str]]] = {
    "detect": (lambda: detect(study(), Engine()), "stars", (answers, "MOST_STARS")),
    "snr": (lambda: snr(study(), Engine()), "stars", (answers, "MOST_STARS")),
    "measure": (lambda: measure(study(), Engine()), "flares", (measurements, "MOST_FLARES")),
    "inject": (lambda: inject(study(*INJECTED), Stares()), "stars", (injections, "MOST_MAPS")),
}
#: Slices up to a most, and loops that end with the colours.
CUT = re.compile(r"\w+\[:MOST_\w+\]|zip\((?:COLOURS, \w+(?:\.items\(\))?|\w+, COLOURS), strict=False\)")
#: Pictures that show all, however many there are.
WHOLE = {"noise-budget"}


@pytest.mark.parametrize("case", long_but(CASES, "detect", "measure"))
def test_pictures_of_a_part_say_so(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    make, of, most = CASES[case]
    monkeypatch.setattr(*most, 1)
    answer: Answer = make()
    for number in (1, 2):
        several = replace(answer, **{of: getattr(answer, of) * number})  # type: ignore[type-var]
        for picture, draw in pictures_of(several).items():
            title = draw()._suptitle
            written = title.get_text().replace("\n", " ") if title else ""
            assert (f"1 of 2 {of} shown" in written) == (number > 1 and picture not in WHOLE), (picture, written)
            if picture == "curves":
                assert "6 of 8 half-widths shown" in written


def test_largest_shares_say_how_many_there_are() -> None:
    shares = dict.fromkeys("abcde", 0.2)
    assert describe_shares(shares) == "a 20 %, b 20 %, c 20 % (3 of 5 unknowns shown)"
    assert describe_shares({"a": 1.0}) == "a 100 %"


def test_part_has_a_note() -> None:
    assert (list(First("abc", 2, "letters")), First("abc", 2, "letters").note) == (["a", "b"], "2 of 3 letters shown")
    assert (First("abc", 3, "letters").note, note_of(First("abc", 1, "letters"))) == ("", "1 of 3 letters shown")
    assert (note_of("abc"), part_note(0, 0, "letters")) == ("", "")


def test_nothing_is_cut_off_without_a_note() -> None:
    """What shows answers neither slices up to a most nor runs out of colours."""
    root = Path(mauvecl.__file__).parent
    for folder in ("pictures", "cli", "answers"):
        for path in sorted((root / folder).rglob("*.py")):
            assert not CUT.findall(path.read_text()), path.name
