"""Clusters that are not there, and workers that fail, raise an error that names what is wrong."""

from __future__ import annotations

import sys

import pytest
from refusals import refused

from mauvecl import DaskWorkers
from mauvecl.device.drivers import DeviceError


@pytest.mark.parametrize("package", ["distributed", "cryptography"])
def test_missing_package_raises(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse to start a cluster without encryption."""
    monkeypatch.setitem(sys.modules, package, None)
    with refused({"distributed": "dask"}.get(package, package), "'mauvecl[cluster]'"):
        DaskWorkers("local:2")


def test_absent_scheduler_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mauvecl.runs.cluster.PATIENCE_S", 1.0)
    with pytest.raises(DeviceError) as error:
        DaskWorkers("tcp://127.0.0.1:1")
    assert "tcp://127.0.0.1:1" in str(error.value)
