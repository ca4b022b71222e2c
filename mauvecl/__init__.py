"""Would the Mauve satellite see this stellar flare, and how sure can one be?

The public names are loaded when first used: importing mauvecl loads neither OpenCL nor synphot.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mauvecl.comparison import Comparison
    from mauvecl.engine import Engine
    from mauvecl.exposures import exposure_for
    from mauvecl.gaussian import gaussian_report
    from mauvecl.host.errors import InputError
    from mauvecl.host.expectation import Expectation, expect
    from mauvecl.host.instrument import Instrument
    from mauvecl.host.sky import Sky
    from mauvecl.host.source import Source
    from mauvecl.limits import limiting_magnitude, shortest_exposure, smallest_amplitude
    from mauvecl.maps import detection_map
    from mauvecl.pool import Pool
    from mauvecl.statistics import Linear
    from mauvecl.study import Study

__version__ = "0.1.0"
__all__ = [
    "Comparison",
    "Engine",
    "Expectation",
    "InputError",
    "Instrument",
    "Linear",
    "Pool",
    "Sky",
    "Source",
    "Study",
    "detection_map",
    "expect",
    "exposure_for",
    "gaussian_report",
    "limiting_magnitude",
    "shortest_exposure",
    "smallest_amplitude",
]

_HOMES = {
    "Comparison": "comparison",
    "Engine": "engine",
    "Expectation": "host.expectation",
    "InputError": "host.errors",
    "Instrument": "host.instrument",
    "Linear": "statistics",
    "Pool": "pool",
    "Sky": "host.sky",
    "Source": "host.source",
    "Study": "study",
    "detection_map": "maps",
    "expect": "host.expectation",
    "exposure_for": "exposures",
    "gaussian_report": "gaussian",
    "limiting_magnitude": "limits",
    "shortest_exposure": "limits",
    "smallest_amplitude": "limits",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mauvecl' has no attribute {name!r}")
    return getattr(import_module(f"mauvecl.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
