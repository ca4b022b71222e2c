"""Outcome of the self-test on a device, which run records repeat."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mauvecl.device.kernel_cache import kernel_cache
from mauvecl.device.program import DeviceRecord
from mauvecl.host.version import VERSION
from mauvecl.schema.tables import Column


@dataclass(frozen=True)
class Check:
    """Outcome of one check, a line of the table."""

    name: str
    passed: bool
    result: str


#: Columns of the table of checks.
COLUMNS = (
    Column("passed", heading="result", format=lambda passed: "PASS" if passed else "FAIL"),
    Column("name", heading="check"),
    Column("result", heading="found"),
)


def write_outcome(device: DeviceRecord, checks: Sequence[Check], seconds: float) -> None:
    """Write the outcome to the kernel cache, for run records of the same device, driver and version."""
    record = {
        "mauvecl": VERSION,
        "device": asdict(device),
        "date_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "seconds": round(seconds, 1),
        "passed": all(check.passed for check in checks),
        "checks": [asdict(check) for check in checks],
    }
    kernel_cache().write_text(_key(device), json.dumps(record))


def read_outcome(device: DeviceRecord) -> dict[str, Any] | None:
    """Return the latest outcome for a device, or None."""
    text = kernel_cache().read_text(_key(device))
    return None if text is None else dict(json.loads(text))


def _key(device: DeviceRecord) -> str:
    said = f"selftest {VERSION} {device.label} {device.driver}"
    return hashlib.sha256(said.encode()).hexdigest()[:32]
