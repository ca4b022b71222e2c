"""The device reads the memory layout that Python defines."""

import numpy as np
from probes import Probes

from mauvecl.noise import layout


def test_every_offset_on_the_device(probes: Probes) -> None:
    expected = []
    for dtype in layout.STRUCTS.values():
        expected += [offset for _, offset in dtype.fields.values()] + [dtype.itemsize]
    out = probes.run("probe_layout", 1, np.zeros(len(expected), np.uint32))
    np.testing.assert_array_equal(out, expected)
