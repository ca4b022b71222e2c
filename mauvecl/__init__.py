"""Would the Mauve satellite see this stellar flare, and how sure can one be?

The public names are loaded when first used: importing mauvecl loads neither OpenCL nor synphot.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mauvecl.host.version import VERSION

if TYPE_CHECKING:
    from mauvecl.answers.exposures import exposure_for
    from mauvecl.answers.gaussian import gaussian_report
    from mauvecl.answers.limits import limiting_magnitude, shortest_exposure, smallest_amplitude
    from mauvecl.answers.maps import detection_map
    from mauvecl.device.engine import Engine
    from mauvecl.host.errors import InputError
    from mauvecl.host.expectation import Expectation, expect
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.sky.zodiacal import Sky
    from mauvecl.host.stars.source import Source
    from mauvecl.noise.comparison import Comparison
    from mauvecl.runs.pool import Pool
    from mauvecl.statistics.linear import Linear
    from mauvecl.study.study import Study

__version__ = VERSION
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
    "Comparison": "noise.comparison",
    "Engine": "device.engine",
    "Expectation": "host.expectation",
    "InputError": "host.errors",
    "Instrument": "host.instrument.instrument",
    "Linear": "statistics.linear",
    "Pool": "runs.pool",
    "Sky": "host.sky.zodiacal",
    "Source": "host.stars.source",
    "Study": "study.study",
    "detection_map": "answers.maps",
    "expect": "host.expectation",
    "exposure_for": "answers.exposures",
    "gaussian_report": "answers.gaussian",
    "limiting_magnitude": "answers.limits",
    "shortest_exposure": "answers.limits",
    "smallest_amplitude": "answers.limits",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mauvecl' has no attribute {name!r}")
    return getattr(import_module(f"mauvecl.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
