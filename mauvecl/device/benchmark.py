"""Measurement of the speed of devices."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Any

from mauvecl.device.engine import Engine, devices
from mauvecl.device.errors import DeviceError
from mauvecl.device.toy_exposure import toy
from mauvecl.schema.tables import Column

PIXELS = 1600


def chi2_rate(engine: Engine, seconds: float = 0.5) -> float:
    """Measure chi2's pixel-realisations per second, for a quiescent and a flaring scenario on common draws."""
    quiet, flare = toy(PIXELS), toy(PIXELS, flare=0.1)

    def work(count: int) -> float:
        start = time.perf_counter()
        engine.detect(quiet, [flare], realisations=count, seed=1, statistics=("chi2",))
        return time.perf_counter() - start

    # The first call builds the kernels.
    work(64)
    count = 256
    while (spent := work(count)) < seconds / 4:
        count *= 4
    return count * PIXELS / min(spent, work(count))


#: Columns of the table of devices.
COLUMNS = (
    Column("number", heading="number"),
    Column("platform", heading="device", format=lambda platform, name: f"{platform}: {name}", others=("name",)),
    Column("driver", heading="driver"),
    Column("kind", heading="kind"),
    Column("compute_units", heading="units"),
    Column("global_memory", unit="byte", heading="GiB", format=lambda size: f"{size / 2**30:.1f}"),
    Column("promise", heading="promise"),
    Column("rate", unit="1 / s", heading="rate", format=lambda rate, error: error or _rate(rate), others=("error",)),
    Column("default", heading="chosen", format=lambda chosen: "default" if chosen else ""),
)


def _rate(rate: float | None) -> str:
    return "" if rate is None else f"{rate:.2g} /s"


def list_devices(*, measure: bool = True) -> list[dict[str, Any]]:
    """List all devices with their promise and, if `measure` is true, their speed.

    Returns
    -------
    list of dict
        Fields of `DeviceRecord`, ``rate`` (None if not measured) and ``error`` (the reason of a failure, or "").
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
