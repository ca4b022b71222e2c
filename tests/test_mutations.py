"""The list of `tools/mutation_check.py` is in step with the code: a renamed line or test would leave a check idle."""

from pathlib import Path

import pytest
from scripts import tool

ROOT = Path(__file__).parent.parent
check = tool("mutation_check")


def test_every_mutation_has_its_texts_and_its_test() -> None:
    sources, tests = check.files_of(ROOT, *check.SOURCES), check.files_of(ROOT, "tests")
    assert len(check.MUTATIONS) >= 70
    for name, (test, *edits) in check.MUTATIONS.items():
        assert edits, name
        for text, changed in edits:
            assert text != changed, name
            place = check.place_of(text, sources)
            if place.suffix == ".py":
                # A mutant that cannot be imported proves nothing.
                compile(sources[place].replace(text, changed), name, "exec")
        check.node_of(test, tests)


def test_texts_and_tests_that_are_missing_or_occur_twice_are_refused() -> None:
    files = {Path("a.py"): "def test_a(\nx = 1\n", Path("b.py"): "def test_b(\ny = 1\nx = 1\n\ndef test_a(\n"}
    assert check.place_of("y = 1", files) == Path("b.py")
    assert check.node_of("test_b[0.1]", files) == "b.py::test_b[0.1]"
    for text, words in (("z = 1", "occurs 0 times"), ("x = 1", r"occurs 2 times \(a.py, b.py\)")):
        with pytest.raises(SystemExit, match=words):
            check.place_of(text, files)
    for test, number in (("test_c", 0), ("test_a", 2)):
        with pytest.raises(SystemExit, match=f"in {number} files"):
            check.node_of(test, files)
