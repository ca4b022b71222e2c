"""Would the Mauve satellite see this stellar flare, and how sure can one be?

The public names are loaded when first used: importing mauvecl loads neither OpenCL nor synphot.
"""

import os
import sys

# Before any other import, since Ctrl-C while modules are imported must not print a traceback. Python has loaded os and
# sys itself; what it does before this line cannot be helped.
if sys.argv[:1] == ["-m"] or (sys.argv and os.path.basename(sys.argv[0]) == __name__):

    def _without_traceback(kind, error, trace, otherwise=sys.excepthook):  # type: ignore[no-untyped-def]
        # Python wraps what `__set_name__` raises while a class is made.
        if issubclass(kind, KeyboardInterrupt) or isinstance(error.__cause__, KeyboardInterrupt):
            print(f"{__name__}: interrupted", file=sys.stderr)
        else:
            otherwise(kind, error, trace)

    sys.excepthook = _without_traceback

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mauvecl.answers.verbs import HOMES
from mauvecl.host.version import VERSION
from mauvecl.schema import drawable

if sys.platform == "win32":
    from mauvecl.device.drivers import driver_sources

    raise ImportError(f"mauvecl does not run on Windows itself, expected {driver_sources('Windows')}")

if TYPE_CHECKING:
    from mauvecl.answers.analyse import analyse
    from mauvecl.answers.calibrate import calibrate
    from mauvecl.answers.change import change
    from mauvecl.answers.detect import detect
    from mauvecl.answers.gaussian import gaussian, gaussian_report
    from mauvecl.answers.inject import inject
    from mauvecl.answers.limit import limit, limiting_magnitude, shortest_exposure, smallest_amplitude, what_matters
    from mauvecl.answers.map import detection_map, map
    from mauvecl.answers.measure import measure
    from mauvecl.answers.plan import plan
    from mauvecl.answers.signal import exposure, exposure_for, simulate, snr
    from mauvecl.answers.stare import stare
    from mauvecl.answers.visible import visible
    from mauvecl.detection.detection import Detection, departures
    from mauvecl.detection.nuisances import Nuisances
    from mauvecl.detection.statistics import Linear
    from mauvecl.device.engine import Engine, Stares
    from mauvecl.fits.flare_model import FlareModel
    from mauvecl.fits.spectrum import fit, fit_two_temperatures, forecast
    from mauvecl.fits.time_course import fit_cooling, measure_along
    from mauvecl.flares.energies import EnergyScale
    from mauvecl.flares.events import Event
    from mauvecl.flares.settings import Cooling, Sinusoid
    from mauvecl.flares.shapes import SHAPES, TableShape
    from mauvecl.flares.stare import Stare
    from mauvecl.host.exposure.expectation import Expectation, expect
    from mauvecl.host.exposure.sky import Sky
    from mauvecl.host.instrument.curves import PixelMap
    from mauvecl.host.instrument.instrument import Instrument
    from mauvecl.host.stars.flare_spectra import BalmerFlare, Blackbody, FlareWithLines, ObservedFlare, TwoBlackbodies
    from mauvecl.host.stars.source import Source
    from mauvecl.noise.comparison import Comparison
    from mauvecl.noise.disturbances import CosmicRays, Normal, Uniform
    from mauvecl.noise.unknowns import Processes
    from mauvecl.observations.frame_files import read_frames
    from mauvecl.observations.frames import Frames
    from mauvecl.runs import bulk
    from mauvecl.runs.cluster import DaskWorkers
    from mauvecl.runs.pool import LocalWorkers, Pool
    from mauvecl.schema.errors import InputError
    from mauvecl.study.study import PAPER_BUDGETS, Study

drawable.connect(lambda: import_module("mauvecl.charts.chart"))

__version__ = VERSION
__all__ = [
    "PAPER_BUDGETS",
    "SHAPES",
    "BalmerFlare",
    "Blackbody",
    "Comparison",
    "Cooling",
    "CosmicRays",
    "DaskWorkers",
    "Detection",
    "EnergyScale",
    "Engine",
    "Event",
    "Expectation",
    "FlareModel",
    "FlareWithLines",
    "Frames",
    "InputError",
    "Instrument",
    "Linear",
    "LocalWorkers",
    "Normal",
    "Nuisances",
    "ObservedFlare",
    "PixelMap",
    "Pool",
    "Processes",
    "Sinusoid",
    "Sky",
    "Source",
    "Stare",
    "Stares",
    "Study",
    "TableShape",
    "TwoBlackbodies",
    "Uniform",
    "analyse",
    "bulk",
    "calibrate",
    "change",
    "departures",
    "detect",
    "detection_map",
    "expect",
    "exposure",
    "exposure_for",
    "fit",
    "fit_cooling",
    "fit_two_temperatures",
    "forecast",
    "gaussian",
    "gaussian_report",
    "inject",
    "limit",
    "limiting_magnitude",
    "map",
    "measure",
    "measure_along",
    "plan",
    "read_frames",
    "shortest_exposure",
    "simulate",
    "smallest_amplitude",
    "snr",
    "stare",
    "visible",
    "what_matters",
]

#: Where each is at home, verbs apart; `bulk` is a module.
_HOMES = HOMES | {
    "BalmerFlare": "host.stars.flare_spectra",
    "Blackbody": "host.stars.flare_spectra",
    "FlareModel": "fits.flare_model",
    "FlareWithLines": "host.stars.flare_spectra",
    "ObservedFlare": "host.stars.flare_spectra",
    "TwoBlackbodies": "host.stars.flare_spectra",
    "fit": "fits.spectrum",
    "forecast": "fits.spectrum",
    "Comparison": "noise.comparison",
    "Cooling": "flares.settings",
    "CosmicRays": "noise.disturbances",
    "DaskWorkers": "runs.cluster",
    "Detection": "detection.detection",
    "EnergyScale": "flares.energies",
    "Engine": "device.engine",
    "Event": "flares.events",
    "Expectation": "host.exposure.expectation",
    "Frames": "observations.frames",
    "read_frames": "observations.frame_files",
    "InputError": "schema.errors",
    "Instrument": "host.instrument.instrument",
    "Linear": "detection.statistics",
    "LocalWorkers": "runs.pool",
    "Normal": "noise.disturbances",
    "Nuisances": "detection.nuisances",
    "PAPER_BUDGETS": "study.study",
    "PixelMap": "host.instrument.curves",
    "Pool": "runs.pool",
    "Processes": "noise.unknowns",
    "SHAPES": "flares.shapes",
    "Sinusoid": "flares.settings",
    "Sky": "host.exposure.sky",
    "Source": "host.stars.source",
    "Stare": "flares.stare",
    "Stares": "device.engine",
    "Study": "study.study",
    "TableShape": "flares.shapes",
    "Uniform": "noise.disturbances",
    "bulk": "runs",
    "departures": "detection.detection",
    "expect": "host.exposure.expectation",
    "exposure_for": "answers.signal",
    "fit_cooling": "fits.time_course",
    "fit_two_temperatures": "fits.spectrum",
    "measure_along": "fits.time_course",
    "shortest_exposure": "answers.limit",
    "smallest_amplitude": "answers.limit",
    "what_matters": "answers.limit",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mauvecl' has no attribute {name!r}")
    home = import_module(f"mauvecl.{_HOMES[name]}")
    # A module of a room is no attribute of it before it is imported.
    return getattr(home, name, None) or import_module(f"{home.__name__}.{name}")


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
