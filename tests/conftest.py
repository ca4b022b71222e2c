"""Shared fixtures: one engine for all tests, and the probe kernels behind a plain function."""

from __future__ import annotations

import pytest

from mauvecl.engine import Engine


@pytest.fixture(scope="session")
def engine() -> Engine:
    """The default engine, shared because a build takes a second."""
    return Engine()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The page first: one process then keeps its server and browser, and others take the rest of its tests."""
    items.sort(key=lambda item: "test_page" not in item.nodeid)
