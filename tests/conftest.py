"""Shared fixtures: one engine for all tests, and the probe kernels behind a plain function."""

from __future__ import annotations

import pytest
from scenes import instrument, star

from mauvecl import shards
from mauvecl.engine import Engine
from mauvecl.host.expectation import Expectation


@pytest.fixture(scope="session")
def engine() -> Engine:
    """The default engine, shared because a build takes a second."""
    return Engine()


@pytest.fixture
def small_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares of 4096 realisations."""
    monkeypatch.setattr(shards, "SHARE", 1)


@pytest.fixture(scope="session")
def scene() -> list[Expectation]:
    """A star without and with two flares, on a part of the pixels."""
    return star(amplitudes=(0.05, 0.24), payload=instrument(part=True))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The page first: one process then keeps its server and browser, and others take the rest of its tests."""
    items.sort(key=lambda item: "test_page" not in item.nodeid)
