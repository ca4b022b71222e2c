"""Declared once, used by Python and OpenCL alike: structs, stream numbers, polynomials, the tally's grid.

The kernels get these as rendered C; a test compares every offset on the device.
"""

from __future__ import annotations

import numpy as np

WORD_BITS = 32

#: Each random process draws from its own stream, the top byte of the counter's last word, so that adding
#: one moves no other. Gaussian noise and dark of the observed
#: exposure and of its reference; `split` takes a drawn spectrum apart.
STREAMS = {"noise": 0, "dark": 1, "reference_noise": 2, "reference_dark": 3, "split": 4}

#: What all scenarios share in one pixel. Poisson counts come out relative to a
#: whole number near the mean: as column + dark_low of an alias table, or from the expansion's coefficients.
PIXEL = np.dtype(
    [
        ("table_start", "u4"),
        ("table_bits", "u4"),
        ("dark_low", "i4"),
        ("dark_offset", "f4"),
        ("dark_slope", "f4"),
        ("dark_cubic", "f4"),
        ("dark_gain", "f4"),
        ("used", "f4"),
        ("inverse_variance", "f4"),
        ("element_end", "u4"),
        ("end_among_four", "u4"),
        ("inverse_element_variance", "f4"),
    ]
)

#: One scenario in one pixel: Gaussian DN rms, the part of the mean left out of the whole-DN base, the ADC's range
#: relative to that base, and base minus the quiescent mean.
LEVEL = np.dtype([("sd", "f4"), ("fraction", "f4"), ("low", "f4"), ("high", "f4"), ("offset", "f4")])

#: What an observer subtracts and assumes in one pixel: net = value + net_offset, noise^2 = gain max(net, 0) + variance.
OBSERVER = np.dtype([("net_offset", "f4"), ("gain", "f4"), ("variance", "f4"), ("used", "f4")])

#: One histogram: which channel of values it reads, its centre, and fine steps per unit of the statistic.
GRID = np.dtype([("channel", "u4"), ("centre", "f4"), ("steps_per_unit", "f4")])

STRUCTS = {"Pixel": PIXEL, "Level": LEVEL, "Observer": OBSERVER, "Grid": GRID}

#: Statistics with a channel in every scenario, in the kernel's order; linear statistics follow them.
FIXED_STATISTICS = ("chi2", "chi2_element", "chi2_pair")

#: A histogram has BINS bins of 2**FINE_BITS fine steps; a statistic's standard deviation is STEPS_PER_SIGMA steps.
BINS = 32768
FINE_BITS = 2
STEPS_PER_SIGMA = 2048
#: Values further out are held here; squares of it sum to 2**63 only after 2**27 realisations in one tile.
STEP_LIMIT = 2**18 - 1

#: Minimax fits in float32, made by tools/fit_normal.py: -2 ln(1 + f) / f for f in [sqrt(1/2) - 1, sqrt(2) - 1],
#: sin(pi s) / s and cos(pi s) in s^2 for s in [-1/2, 1/2].
POLYNOMIALS = {
    "log": (
        "-0x1.fffffap+0",
        "0x1.0000d4p+0",
        "-0x1.555ca0p-1",
        "0x1.ff30e2p-2",
        "-0x1.97073ap-2",
        "0x1.62c872p-2",
        "-0x1.501394p-2",
        "0x1.9e7c7ep-3",
    ),
    "sin": ("0x1.921fb6p+1", "-0x1.4abbc4p+2", "0x1.4668f2p+1", "-0x1.32535ap-1", "0x1.3e17cap-4"),
    "cos": ("0x1.fffffep-1", "-0x1.3bd3a6p+2", "0x1.03bd06p+2", "-0x1.54f61ap+0", "0x1.c1f066p-3"),
}
#: 2 ln 2 in float32.
TWO_LN2 = "0x1.62e430p+0"


def c_structs() -> str:
    """The structs as OpenCL C typedefs, in the order of `STRUCTS`."""
    scalars = {"u": "uint", "i": "int", "f": "float"}
    lines = []
    for name, dtype in STRUCTS.items():
        assert dtype.names is not None
        fields = "".join(f" {scalars[dtype[field].kind]} {field};" for field in dtype.names)
        lines.append(f"typedef struct {{{fields} }} {name};")
    return "\n".join(lines)
