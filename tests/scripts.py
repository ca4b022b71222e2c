"""Scripts of the checkout that are no modules of the package."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent


def loaded(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def tool(name: str) -> Any:
    """Load a script of `tools/` by its name without extension."""
    return loaded(ROOT / "tools" / f"{name}.py")
