"""An OpenCL device in use: its context, its queue, and the kernels that were built for it."""

from __future__ import annotations

import os
from typing import Any

from mauvecl.device import program
from mauvecl.device.errors import DeviceError
from mauvecl.device.program import Variant
from mauvecl.noise.pixels import PIXEL_BLOCK

#: Vectors of realisations that one work-item of the kernels of a detection follows on a processor, at most.
VECTORS = 4


class Device:
    """What engine, launches and probes work on.

    Parameters
    ----------
    wanted : str, optional
        As `Engine` takes it.
    width : int, optional
        Realisations in one work-item: 16 on CPUs, 1 elsewhere.

    Attributes
    ----------
    record : DeviceRecord
    cl : module
        pyopencl.
    context, queue : pyopencl.Context, pyopencl.CommandQueue
    width : int
    step : int
        Launches are cut at multiples of what one work-item of any kernel follows.
    """

    def __init__(self, wanted: str | None = None, *, width: int | None = None) -> None:
        self.cl = program.load_opencl()
        handle, self.record = program.choose_device(wanted)
        self.context = self.cl.Context([handle])
        self.queue = self.cl.CommandQueue(self.context)
        self.width = width or (16 if self.record.kind == "cpu" else 1)
        self.step = VECTORS * self.width if self.width > 1 else 1
        self._vector_forms = self.width == 16 and self.record.platform == program.POCL
        self._programs: dict[str, Any] = {}
        self._kernels: dict[tuple[str, str], Any] = {}
        self._pid = os.getpid()

    @property
    def name(self) -> str:
        """Platform and device."""
        return self.record.label

    @property
    def variant(self) -> Variant:
        """How kernels are rendered for this device, whatever the scene."""
        return Variant(width=self.width, vector_forms=self._vector_forms, chunk=PIXEL_BLOCK if self.width > 1 else 4)

    @property
    def programs(self) -> list[str]:
        """The sources built so far."""
        return sorted(self._programs)

    @property
    def kernel_digest(self) -> str:
        """Short sha256 of the kernels rendered so far, for run records."""
        return program.digest("\n".join(self.programs))

    def kernel(self, rooms: tuple[str, ...], variant: Variant, name: str) -> Any:
        """A kernel of the built program of some sources; both are made once."""
        source = program.render(rooms, variant)
        if source not in self._programs:
            self._programs[source] = program.build(self.context, source)
        if (source, name) not in self._kernels:
            self._kernels[source, name] = self.cl.Kernel(self._programs[source], name)
        return self._kernels[source, name]

    def check_process(self) -> None:
        """Refuse to work where it cannot.

        Raises
        ------
        DeviceError
            After a fork: PoCL's threads do not survive it, and its next call would wait for them for ever.
        """
        if os.getpid() != self._pid:
            raise DeviceError("this Engine was made before a fork, expected an Engine made in this process (use spawn)")
