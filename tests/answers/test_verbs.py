"""One registry of verbs: the same name and signature in Python and on the command line."""

from __future__ import annotations

import inspect
from typing import Any

import pytest
import typer.main
from answers import FEW, QUICK
from marks import long_but

import mauvecl
from mauvecl import Engine, Study
from mauvecl.answers.answer import Answer
from mauvecl.answers.verbs import VERBS
from mauvecl.cli.app import app


@pytest.mark.parametrize("name", VERBS)
def test_each_verb_has_one_name_and_one_signature(name: str) -> None:
    verb = VERBS[name]
    assert getattr(mauvecl, name) is verb.ask
    assert verb.ask.__name__ == name
    assert name in mauvecl.__all__
    for older in verb.older:
        assert getattr(mauvecl, older) is verb.ask
        assert older in mauvecl.__all__
    study, engine, progress, *own = inspect.signature(verb.ask).parameters.values()
    assert [one.name for one in (study, engine, progress)] == ["study", "engine", "progress"]
    assert (study.default, engine.default, progress.default) == (inspect.Parameter.empty, None, None)
    assert all(one.kind is one.KEYWORD_ONLY and one.default is not one.empty for one in own)
    returned = inspect.signature(verb.ask).return_annotation
    module: Any = inspect.getmodule(inspect.unwrap(verb.ask))
    assert issubclass(getattr(module, returned), Answer)


def test_command_line_has_every_verb_in_order() -> None:
    group = typer.main.get_command(app)
    assert list(group.commands)[: len(VERBS)] == list(VERBS)  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", long_but(QUICK, *(QUICK.keys() - {"change", "simulate"})))
def test_progress_ends_at_its_total(name: str, engine: Engine) -> None:
    """Pass all arguments by position, since all verbs have the same."""
    seen: list[tuple[int, int]] = []
    drawing = None if name == "plan" else engine
    answer = VERBS[name].ask(Study().with_settings(FEW + QUICK[name]), drawing, lambda *reported: seen.append(reported))
    assert isinstance(answer, Answer)
    done, total = zip(*seen, strict=True)
    assert list(done) == sorted(done)
    assert done[-1] == total[-1] > 0
    assert len(set(total)) == 1
