"""Fixtures of the tests of stores."""

from collections.abc import Iterator

import pytest

from mauvecl.runs import store


@pytest.fixture(autouse=True, scope="module")
def small_chunks() -> Iterator[None]:
    """Set chunks of some 64 rows, so that a small store has several."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "CHUNK_BYTES", 64 * 197 * 2)
        yield
