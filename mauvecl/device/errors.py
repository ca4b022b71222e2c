"""Errors of devices and their drivers."""

from typing import Literal

#: Kinds of failures that callers may want to tell apart.
Kind = Literal["no device", "unknown device", "processor", "memory", "failed", "lost", ""]


class DeviceError(RuntimeError):
    """Failure of a device, a driver or a worker, with a one-sentence message.

    `kind` is "no device", "unknown device" (a wrong name), "processor" (unknown to the driver), "memory" (too little),
    "failed" (at some realisations, also in further tries), "lost" (the scheduler of a cluster), or empty for others.
    """

    def __init__(self, message: str, kind: Kind = "") -> None:
        super().__init__(message)
        self.kind = kind


class BuildError(DeviceError):
    """Failure to compile a kernel; the message contains the numbered source and the device's log."""
