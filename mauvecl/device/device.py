"""An open OpenCL device: context, queue and compiled kernels."""

from __future__ import annotations

import os
from typing import Any

from mauvecl.device import program
from mauvecl.device.errors import DeviceError
from mauvecl.device.program import Variant
from mauvecl.noise.scene import PIXEL_BLOCK

#: Largest number of vectors of realisations per work-item of the detection kernels on a CPU.
VECTORS = 4


class Device:
    """Open OpenCL device with its context, queue and compiled kernels.

    Parameters
    ----------
    wanted : str, optional
        Number or part of the name, as for `Engine`.
    width : int, optional
        Realisations per work-item; by default 16 on CPUs, 1 elsewhere.

    Attributes
    ----------
    record : DeviceRecord
    cl : module
        The imported pyopencl.
    context, queue : pyopencl.Context, pyopencl.CommandQueue
    width : int
    step : int
        Realisations per work-item of the widest kernel; launches are cut at its multiples.
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
        """Platform and device name."""
        return self.record.label

    @property
    def variant(self) -> Variant:
        """Kernel variant of this device, before a scene sets its own options."""
        return Variant(width=self.width, vector_forms=self._vector_forms, chunk=PIXEL_BLOCK if self.width > 1 else 4)

    @property
    def programs(self) -> list[str]:
        """Sources built so far."""
        return sorted(self._programs)

    @property
    def kernel_digest(self) -> str:
        """Short sha256 of the kernels rendered so far, for run records."""
        return program.digest("\n".join(self.programs))

    def kernel(self, kernel_files: tuple[str, ...], variant: Variant, name: str) -> Any:
        """Return a kernel of the program of these files; both are built once."""
        source = program.render(kernel_files, variant)
        if source not in self._programs:
            self._programs[source] = program.build(self.context, source)
        if (source, name) not in self._kernels:
            self._kernels[source, name] = self.cl.Kernel(self._programs[source], name)
        return self._kernels[source, name]

    def check_process(self) -> None:
        """Raise DeviceError after a fork, which PoCL's threads do not survive: its next call would wait forever."""
        if os.getpid() != self._pid:
            raise DeviceError("this Engine was made before a fork, expected an Engine made in this process (use spawn)")
