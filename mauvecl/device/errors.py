"""Errors of devices and their drivers."""


class DeviceError(RuntimeError):
    """Failure of a device or driver, with a one-sentence message."""


class BuildError(DeviceError):
    """Failure to compile a kernel; the message contains the numbered source and the device's log."""
