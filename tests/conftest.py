"""Shared fixtures: one engine for all tests, and the probe kernels behind a plain function."""

from __future__ import annotations

import pytest

from mauvecl.engine import Engine


@pytest.fixture(scope="session")
def engine() -> Engine:
    """The default engine, shared because a build takes a second."""
    return Engine()
