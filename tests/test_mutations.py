"""The list of `tools/mutation_check.py` is in step with the code: a renamed line or test would leave a check idle."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_every_mutation_has_its_text_and_its_test() -> None:
    place = ROOT / "tools" / "mutation_check.py"
    spec = importlib.util.spec_from_file_location("mutation_check", place)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    assert len(module.MUTATIONS) > 40
    for name, one in module.MUTATIONS.items():
        for file, text, changed in one.edits:
            assert text in (ROOT / file).read_text(), name
            assert text != changed, name
        file, _, test = one.test.partition("::")
        assert f"def {test.partition('[')[0]}(" in (ROOT / file).read_text(), name
