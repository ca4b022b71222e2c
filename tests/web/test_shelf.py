"""The memory that the server keeps for its visitors is bounded."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from mauvecl.web import shelf
from mauvecl.web.shelf import Shelf, size_of

MIB = 2**20


def test_size_is_that_of_arrays_also_of_views_and_in_objects() -> None:
    array = np.zeros(MIB, np.uint8)
    for value in (array, {"a": [array]}, SimpleNamespace(one=array[::2], two=array), (array[:1],)):
        assert MIB <= size_of(value) < 1.01 * MIB


def test_least_recently_used_values_are_dropped() -> None:
    """Let 60 visitors keep a result each, of which ten fit."""
    kept = Shelf(10 * MIB + MIB // 2)
    visitors: list[dict[str, Any]] = [{} for _ in range(60)]
    for number, visitor in enumerate(visitors):
        visitor["answer"] = np.zeros(MIB, np.uint8)
        kept.keep(visitor, "answer", visitor["answer"], partial(visitor.pop, "answer", None))
        # The first visitor's is asked for all the time.
        kept.used(visitors[0], "answer")
        assert sum(one.nbytes for each in visitors for one in each.values()) <= kept.most
        assert kept.size <= kept.most or number == 0
    assert [n for n, visitor in enumerate(visitors) if visitor] == [0, *range(51, 60)]


def test_values_of_a_visitor_who_left_make_room() -> None:
    kept = Shelf(2 * MIB + MIB // 2)
    one, other = {"a": np.zeros(MIB, np.uint8)}, {"a": np.zeros(MIB, np.uint8)}
    for visitor in (one, other):
        kept.keep(visitor, "a", visitor["a"], visitor.clear)
    kept.leave(one)
    assert MIB <= kept.size < 1.1 * MIB
    kept.keep(other, "b", np.zeros(MIB, np.uint8), other.clear)
    assert other


def test_a_value_replaced_under_its_key_is_counted_once() -> None:
    kept, owner = Shelf(3 * MIB), object()
    for _ in range(50):
        kept.keep(owner, "closed", np.zeros(MIB, np.uint8), lambda: None)
    assert MIB <= kept.size < 1.1 * MIB


def test_the_documentation_states_the_bounds() -> None:
    from pathlib import Path

    text = (Path(__file__).parents[2] / "docs" / "page.md").read_text()
    assert f"{shelf.MOST_RESULTS // MIB} MiB of results" in text
    assert f"{shelf.MOST_UPLOADS // MIB} MiB of" in text
