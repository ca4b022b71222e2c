"""Would the Mauve satellite see this stellar flare, and how sure can one be?

The public names are loaded when first used: importing mauvecl loads neither OpenCL nor synphot.
"""

import os
import sys

# Before any other import, since Ctrl-C while modules are imported must not print a traceback. Python has loaded os and
# sys itself; what it does before this line cannot be helped.
if sys.argv[:1] == ["-m"] or (sys.argv and os.path.basename(sys.argv[0]) == __name__):

    def _without_traceback(kind, error, trace, otherwise=sys.excepthook):  # type: ignore[no-untyped-def]
        # Python wraps what `__set_name__` raises while a class is made, and pydantic what interrupts its builders.
        if issubclass(kind, KeyboardInterrupt) or "KeyboardInterrupt" in f"{error!r} {error.__cause__!r}":
            print(f"{__name__}: interrupted", file=sys.stderr)
        else:
            otherwise(kind, error, trace)

    sys.excepthook = _without_traceback

from functools import cache
from importlib import import_module
from typing import Any

from mauvecl.host import VERSION

if sys.platform == "win32":
    from mauvecl.device.drivers import driver_sources

    raise ImportError(f"mauvecl does not run on Windows itself, expected {driver_sources('Windows')}")

__version__ = VERSION


@cache
def _homes() -> dict[str, str]:
    """Return the module of every public name, as the stub states it."""
    import re
    from importlib.resources import files

    text = files(__name__).joinpath("__init__.pyi").read_text(encoding="utf-8")
    return {name: home for home, name in re.findall(r"^from (\S+) import (\w+) as \2$", text, re.MULTILINE)}


def __getattr__(name: str) -> Any:
    if name == "__all__":
        return [*_homes()]
    if name not in _homes():
        raise AttributeError(f"module 'mauvecl' has no attribute {name!r}")
    home = import_module(_homes()[name])
    # A module of a room is no attribute of it before it is imported.
    return getattr(home, name, None) or import_module(f"{home.__name__}.{name}")


def __dir__() -> list[str]:
    return sorted([*_homes(), "__version__"])
