"""Kernels that return one step of a draw for chosen words."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.device import build


class Probes:
    """Probe kernels of a device, by default with its vector width and its choice of the fast forms for PoCL."""

    def __init__(self, *, width: int | None = None, vector_forms: bool | None = None, device: build.Device) -> None:
        self.cl, self.context, self.queue = device.cl, device.context, device.queue
        plain = device.variant
        self.width = width or plain.width
        forms = plain.vector_forms if vector_forms is None else vector_forms
        variant = build.Variant(
            width=self.width, vector_forms=forms and self.width > 1, chunk=32 if self.width > 1 else 4
        )
        self.program = build.build(self.context, build.render(("probes",), variant))

    def run(
        self, name: str, items: int, out: NDArray[Any], *inputs: Any, out_first: Any = None, start: Any = None
    ) -> NDArray[Any]:
        """Launch a probe kernel and return `out`, its last argument.

        Input arrays are uploaded. `out_first` is an output before `out`, and `start` the initial contents of `out`.
        """
        flags = self.cl.mem_flags
        arguments = [
            self.cl.Buffer(self.context, flags.READ_ONLY | flags.COPY_HOST_PTR, hostbuf=np.ascontiguousarray(x))
            if isinstance(x, np.ndarray)
            else x
            for x in inputs
        ]
        outs = [x for x in (out_first, out) if x is not None]
        buffers = [self.cl.Buffer(self.context, flags.READ_WRITE, x.nbytes) for x in outs]
        if start is not None:
            self.cl.enqueue_copy(self.queue, buffers[-1], start)
        local = (1,) if self.width > 1 and name != "probe_layout" else None
        self.cl.Kernel(self.program, name)(self.queue, (items,), local, *arguments, *buffers)
        for array, buffer in zip(outs, buffers, strict=True):
            self.cl.enqueue_copy(self.queue, array, buffer)
        return out

    def philox(self, counters: NDArray[np.uint32], keys: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """Return eight words per counter: four of the plain generator, four of its loop-invariant form."""
        out = np.empty((len(counters), 8), np.uint32)
        return self.run("probe_philox", len(counters), out, np.uint32(len(counters)), counters, keys)

    def normal(self, radius: NDArray[np.uint32], angle: NDArray[np.uint32]) -> NDArray[np.float32]:
        """Return two rows of normal deviates from two words each; sizes are multiples of the width."""
        words = np.stack([radius, angle])
        return self.run("probe_normal", radius.size // self.width, np.empty(words.shape, np.float32), words)

    def alias(self, words: NDArray[np.uint32], table: NDArray[np.uint32], bits: int) -> NDArray[np.uint32]:
        """Return the column that each word selects."""
        items = words.size // self.width
        return self.run("probe_alias", items, np.empty(words.size, np.uint32), words, table, np.uint32(bits))

    def prior(
        self, word: NDArray[np.uint32], finer: NDArray[np.uint32], table: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return a prior's factors minus one at the probabilities given by two words each."""
        words = np.stack([word, finer])
        return self.run("probe_prior", word.size // self.width, np.empty(word.size, np.float32), words, table)
