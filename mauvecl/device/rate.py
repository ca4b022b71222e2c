"""How fast a device is, in a second of its own work."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Any

from mauvecl.device.engine import Engine, devices
from mauvecl.device.errors import DeviceError
from mauvecl.device.selftest import toy

PIXELS = 1600


def chi2_rate(engine: Engine, seconds: float = 0.5) -> float:
    """Pixel-realisations per second of chi2, a quiescent and a flaring scenario on common draws."""
    quiet, flare = toy(PIXELS), toy(PIXELS, flare=0.1)

    def work(count: int) -> float:
        start = time.perf_counter()
        engine.detect(quiet, [flare], realisations=count, seed=1, statistics=("chi2",))
        return time.perf_counter() - start

    work(64)  # builds
    count = 256
    while (spent := work(count)) < seconds / 4:
        count *= 4
    return count * PIXELS / min(spent, work(count))


def measured(*, measure: bool = True) -> list[dict[str, Any]]:
    """Every device, what it promises and how fast it is.

    Parameters
    ----------
    measure : bool
        Without, only what the drivers say.

    Returns
    -------
    list of dict
        `DeviceRecord` with ``rate`` (None where not measured) and ``error``, why it failed, or "".

    Raises
    ------
    DeviceError
        If there is no device at all.
    """
    rates = []
    for number, record in enumerate(devices()):
        rate, error = None, ""
        if measure:
            try:
                rate = chi2_rate(Engine(str(number)))
            except DeviceError as failure:
                error = str(failure).splitlines()[0]
        rates.append(asdict(record) | {"rate": rate, "error": error})
    return rates
