"""Declared once, used by Python and OpenCL alike: structs, stream numbers, polynomials, the tally's grid.

The kernels get these as rendered C; a test compares every offset on the device.
"""

from __future__ import annotations

import numpy as np

WORD_BITS = 32

#: Each random process draws from its own stream, the top byte of the counter's last word, so that adding one moves no
#: other. `noise` is the joint Gaussian or what is Gaussian alone, `dark` and `photon` their Poisson counts where drawn
#: apart; `split` takes a drawn spectrum apart. Of a stare `stare_unknown` holds what differs from stare to stare,
#: `stare_frame` what does from frame to frame, and `stare_sums` the weighted sums where no pixel is drawn.
STREAMS = {
    "noise": 0,
    "dark": 1,
    "photon": 2,
    "cosmic": 3,
    "jitter": 4,
    "detector_temperature": 5,
    "light_loss": 6,
    "pointing_loss": 7,
    "qe_scale": 8,
    "split": 9,
    "split_dark": 10,
    "sky_level": 11,
    "stare_unknown": 16,
    "stare_frame": 17,
    "stare_sums": 18,
    "stare_glow": 19,
}
#: Added to the stream for the draws of a reference exposure.
REFERENCE = 64

#: What a launch needs to know: the seed, sizes, where frames and groups of four pixels begin to be counted, the alias
#: table of the cosmic rays' charge, how many quiescent exposures are averaged, one over that, and by what half the
#: inverse variance of one exposure exceeds the inverse variance used.
JOB = np.dtype(
    [
        ("seed_low", "u4"),
        ("seed_high", "u4"),
        ("pixel_count", "u4"),
        ("padded_count", "u4"),
        ("scenario_count", "u4"),
        ("draw_count", "u4"),
        ("frame_count", "u4"),
        ("first_frame", "u4"),
        ("first_group", "u4"),
        ("cosmic_table", "u4"),
        ("cosmic_bits", "u4"),
        ("cosmic_low", "i4"),
        ("reference_count", "u4"),
        ("reference_weight", "f4"),
        ("pair_scale", "f4"),
    ]
)

#: What all scenarios share in one pixel.
PIXEL = np.dtype([("used", "f4"), ("element_end", "u4"), ("four_uneven", "u4"), ("cosmic_gain", "f4")])

#: One scenario in one pixel, read in every inner loop: coefficients of the draw as a polynomial of z, the whole DN
#: that separate `nearest`'s result from the reference's, the reference's inverse variance, and twice that times the
#: reference's fraction of a DN.
LEVEL = np.dtype(
    [
        ("c0", "f4"),
        ("c1", "f4"),
        ("c2", "f4"),
        ("c3", "f4"),
        ("c4", "f4"),
        ("shift", "f4"),
        ("inverse_variance", "f4"),
        ("twice", "f4"),
    ]
)

#: One scenario in one pixel, read where needed: whole DN of one draw's mean that the kernels leave out, zero and
#: saturation as `nearest` sees them, whole DN from the sum of draws to the reference, and, at an element's last pixel,
#: the reference's fraction of a DN and inverse variance summed over the element.
EDGE = np.dtype(
    [
        ("base", "i4"),
        ("low", "f4"),
        ("high", "f4"),
        ("whole", "f4"),
        ("element_offset", "f4"),
        ("inverse_element_variance", "f4"),
    ]
)

#: A Poisson count relative to a whole number near its mean: column + low of an alias table, or, with bits = 0, from the
#: expansion's coefficients; and DN per count.
POISSON = np.dtype(
    [
        ("table", "u4"),
        ("bits", "u4"),
        ("low", "i4"),
        ("offset", "f4"),
        ("slope", "f4"),
        ("cubic", "f4"),
        ("gain", "f4"),
    ]
)

#: How a joint draw follows factors on light and dark: their means, variances, third to fifth cumulants, DN; and the
#: share of the light that is the sky's.
RESPONSE = np.dtype(
    [
        ("light", "f4"),
        ("dark", "f4"),
        ("light_variance", "f4"),
        ("dark_variance", "f4"),
        ("other_variance", "f4"),
        ("light_third", "f4"),
        ("dark_third", "f4"),
        ("light_fourth", "f4"),
        ("dark_fourth", "f4"),
        ("light_fifth", "f4"),
        ("dark_fifth", "f4"),
        ("sky_share", "f4"),
    ]
)

#: What an observer subtracts and assumes in one pixel: net = value + net_offset, noise^2 = gain max(net, 0) + variance;
#: and the base-2 logarithm of its histogram's bins in DN.
OBSERVER = np.dtype([("net_offset", "f4"), ("gain", "f4"), ("variance", "f4"), ("bin_shift", "u4")])

#: How an observer estimates a variance in one pixel of a scenario: net = x + net_offset, variance = gain max(net, 0) +
#: variance; and the reference's fraction of a DN, zero where noisy exposures take its place.
ESTIMATE = np.dtype([("net_offset", "f4"), ("gain", "f4"), ("variance", "f4"), ("fraction", "f4")])

#: A resolution element: its pixels, the sky subtracted of their sum, DN, and the grid of its S/N's histogram.
ELEMENT = np.dtype([("first", "u4"), ("end", "u4"), ("sky", "f4"), ("centre", "f4"), ("bins_per_unit", "f4")])

#: One histogram: which channel of values it reads, its centre, and fine steps per unit of the statistic.
GRID = np.dtype([("channel", "u4"), ("centre", "f4"), ("steps_per_unit", "f4")])

#: One pixel of a stare's frames: what is left of the mean at coefficients of one beside the whole DN that kernels leave
#: out; star, sky and dark at a coefficient of one, DN; the photons' second to fifth cumulants over their mean; those of
#: everything at coefficients of one; those of the dark alone.
MIXTURE = np.dtype(
    [
        ("rest", "f4"),
        ("star", "f4"),
        ("sky", "f4"),
        ("dark", "f4"),
        ("photon_variance", "f4"),
        ("photon_third", "f4"),
        ("photon_fourth", "f4"),
        ("photon_fifth", "f4"),
        ("variance", "f4"),
        ("third", "f4"),
        ("fourth", "f4"),
        ("fifth", "f4"),
        ("dark_variance", "f4"),
        ("dark_third", "f4"),
        ("dark_fourth", "f4"),
        ("dark_fifth", "f4"),
    ]
)

#: What holds for all frames of a stare: how many there are, and with padding; what is unknown of it; its jitters; how
#: the dark follows the temperature; rows of flares, and of factors on them, one or one to a stare.
STARING = np.dtype(
    [
        ("frame_count", "u4"),
        ("padded_frames", "u4"),
        ("unknown_count", "u4"),
        ("jittered", "u4"),
        ("light_jitter", "f4"),
        ("sky_jitter", "f4"),
        ("temperature_jitter", "f4"),
        ("dark_slope", "f4"),
        ("scenario_count", "u4"),
        ("flare_rows", "u4"),
        ("amplitude_rows", "u4"),
    ]
)

#: Rows of what is known of each frame: coefficients, and the same less one; the factor on all light.
KNOWN_OF_FRAMES = ("star", "star_less_one", "sky", "sky_less_one", "dark", "dark_less_one", "light")
#: What an unknown of a stare is of: rows of what it moves.
MOVED = ("star", "light", "sky", "temperature")
#: Frames are padded to a multiple of this.
FRAME_BLOCK = 16
#: exp(r) = 1 + r + r^2 q(r): Taylor's coefficients of q, off by less than 2e-8 for |r| <= ln(2) / 2; and ln(2) in two
#: parts, of which the first has nine bits, so that its multiples are exact.
EXPONENTIAL = tuple(float(np.float32(1.0 / np.prod(np.arange(1.0, n + 3)))) for n in range(6))
LN2_PARTS = (0.693359375, -2.1219444e-4)
LOG2_E = 1.442695

STRUCTS = {
    "Job": JOB,
    "Pixel": PIXEL,
    "Level": LEVEL,
    "Edge": EDGE,
    "Poisson": POISSON,
    "Response": RESPONSE,
    "Observer": OBSERVER,
    "Estimate": ESTIMATE,
    "Element": ELEMENT,
    "Grid": GRID,
    "Mixture": MIXTURE,
    "Staring": STARING,
}

#: Statistics with a channel in every scenario, in the kernel's order; linear statistics follow them.
FIXED_STATISTICS = ("chi2", "chi2_element", "chi2_pair")

#: Adding and subtracting this rounds a float32 below 2**22 to the nearest whole number.
MAGIC = 12582912.0

#: Priors' tables of quantiles run from each end to the median in octaves of probability, 2**-PRIOR_FINEST to 1/2, of
#: 2**PRIOR_BITS cells each, between whose nodes the device interpolates.
PRIOR_BITS = 7
PRIOR_FINEST = 56
#: Nodes from one end: 1/2 comes twice.
PRIOR_NODES = (PRIOR_FINEST - 1) * 2**PRIOR_BITS + 2

#: Histograms of S/N: one per pixel and element; the first and the last bin only mark what lies outside.
OBSERVER_BINS = 2048

#: A histogram has BINS bins of 2**FINE_BITS fine steps; a statistic's standard deviation is STEPS_PER_SIGMA steps. What
#: falls into the first or the last, or further out, is only marked there: `far` counts it.
BINS = 32768
FINE_BITS = 2
STEPS_PER_SIGMA = 2048

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
