"""Fixtures of the tests of stores."""

from __future__ import annotations

import pytest

from mauvecl.store import stored_scenes


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Set chunks of some 64 rows, so that a small store has several."""
    monkeypatch.setattr(stored_scenes, "CHUNK_BYTES", 64 * 197 * 2)
