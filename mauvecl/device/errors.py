"""What a device or its driver cannot do."""


class DeviceError(RuntimeError):
    """The device or its driver cannot do what is asked; the message is one sentence."""


class BuildError(DeviceError):
    """A kernel did not compile; the message holds the numbered source and the device's log."""
