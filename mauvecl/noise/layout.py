"""Structs, stream numbers, polynomials, tables and histogram grids shared by Python and OpenCL.

They are rendered into the kernels as C; a test compares every offset on the device.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.host.arrays import Float
from mauvecl.noise.disturbances import ADDITIVE, PointingDrifts
from mauvecl.noise.unknowns import PROCESSES

WORD_BITS = 32

#: Stream of each random process, the top byte of the counter's last word, so that a new process changes no other.
#: `noise` is the joint draw or the Gaussian part, `dark` and `photon` are Poisson counts drawn separately, and `split`
#: decomposes a drawn spectrum. In stares, `stare_unknown` varies from stare to stare, `stare_frame` from frame to
#: frame, and `stare_sums` gives the weighted sums if no pixels are drawn.
STREAMS = {
    "noise": 0,
    "dark": 1,
    "photon": 2,
    "split": 9,
    "split_dark": 10,
    "stare_unknown": 16,
    "stare_frame": 17,
    "stare_sums": 18,
    "stare_glow": 19,
    "stare_pointing": PointingDrifts.stream,
    **{name: process.stream for name, process in ADDITIVE.items()},
    **{name: process.stream for name, process in PROCESSES.items()},
}
#: Offset of the stream for draws of a reference exposure.
REFERENCE = 64


def _fields(kind: str, *names: str) -> list[tuple[str, str]]:
    """Return fields of a struct that have the same type."""
    return [(name, kind) for name in names]


#: Fields of a launch for the alias table of an additive process: its start, bits (0 if disabled) and lowest value.
TABLE_FIELDS = (("table", "u4"), ("bits", "u4"), ("low", "i4"))
#: Parameters of a launch: seed, sizes, numbers of the first frame and group of four pixels, alias tables of the charge
#: of additive processes, number of averaged quiescent exposures and its inverse, and half the ratio of the inverse
#: variance of one exposure to the one used.
JOB = np.dtype([
    *_fields("u4", "seed_low", "seed_high", "pixel_count", "padded_count", "scenario_count"),
    *_fields("u4", "draw_count", "frame_count", "first_frame", "first_group"),
    *((f"{name}_{field}", kind) for name in ADDITIVE for field, kind in TABLE_FIELDS),
    *_fields("u4", "reference_count"), *_fields("f4", "reference_weight", "pair_scale"),
])  # fmt: skip

#: Properties of a pixel shared by all scenarios.
PIXEL = np.dtype([("used", "f4"), ("element_end", "u4"), ("four_uneven", "u4"), ("electron_gain", "f4")])

#: A scenario in a pixel, read in every inner loop: coefficients of the draw as a polynomial of z, whole DN between
#: `nearest`'s result and the reference, the reference's inverse variance, and twice its product with the reference's
#: fraction of a DN.
LEVEL = np.dtype(_fields("f4", "c0", "c1", "c2", "c3", "c4", "shift", "inverse_variance", "twice"))

#: A scenario in a pixel, read when needed: whole DN of one draw's mean that the kernels omit, zero and saturation on
#: the scale of `nearest`, whole DN from the sum of draws to the reference, and, at an element's last pixel, the
#: reference's fraction of a DN and inverse variance summed over the element.
EDGE = np.dtype(
    [*_fields("i4", "base"), *_fields("f4", "low", "high", "whole", "element_offset", "inverse_element_variance")]
)

#: A Poisson count relative to an integer near its mean: column + low of an alias table or, with bits = 0, the
#: coefficients of the expansion; and DN per count.
POISSON = np.dtype(
    [*_fields("u4", "table", "bits"), *_fields("i4", "low"), *_fields("f4", "offset", "slope", "cubic", "gain")]
)

#: Cumulants from the second on.
CUMULANTS = ("variance", "third", "fourth", "fifth")

#: Response of a joint draw to factors on light and dark: their means, variances and third to fifth cumulants, DN; and
#: the sky's share of the light.
RESPONSE = np.dtype([
    *_fields("f4", "light", "dark", "light_variance", "dark_variance", "other_variance"),
    *_fields("f4", *(f"{part}_{name}" for name in CUMULANTS[1:] for part in ("light", "dark")), "sky_share"),
])  # fmt: skip

#: An observer's subtraction and noise in a pixel: net = value + net_offset, noise^2 = gain max(net, 0) + variance; and
#: the base-2 logarithm of the histogram's bin width in DN.
OBSERVER = np.dtype([("net_offset", "f4"), ("gain", "f4"), ("variance", "f4"), ("bin_shift", "u4")])

#: An observer's estimate of the variance in a pixel: net = x + net_offset, gain max(net, 0) + variance; and the
#: reference's fraction of a DN, zero for noisy reference exposures.
ESTIMATE = np.dtype([("net_offset", "f4"), ("gain", "f4"), ("variance", "f4"), ("fraction", "f4")])

#: A resolution element: its pixels, the sky subtracted from their sum, DN, and the grid of its S/N histogram.
ELEMENT = np.dtype([("first", "u4"), ("end", "u4"), ("sky", "f4"), ("centre", "f4"), ("bins_per_unit", "f4")])

#: A histogram: channel of its values, centre, and fine steps per unit of the statistic.
GRID = np.dtype([("channel", "u4"), ("centre", "f4"), ("steps_per_unit", "f4")])

#: A pixel of a stare's frames: the mean at unit coefficients minus the whole DN that kernels omit; star, sky, dark and
#: neighbours at unit coefficients, DN; second to fifth cumulants of the photons divided by their mean, of the total at
#: unit coefficients, and of the dark.
MIXTURE = np.dtype([
    *_fields("f4", "rest", "star", "sky", "dark", "neighbours", *(f"photon_{name}" for name in CUMULANTS)),
    *_fields("f4", *CUMULANTS, *(f"dark_{name}" for name in CUMULANTS)),
])  # fmt: skip

#: Properties common to all frames of a stare: number of frames without and with padding, unknowns, jitters, slope of
#: the dark with temperature, and numbers of rows of flares and of their amplitudes (one, or one per stare).
STARE_JOB = np.dtype([
    *_fields("u4", "frame_count", "padded_frames", "unknown_count", "jittered"),
    *_fields("f4", "light_jitter", "sky_jitter", "temperature_jitter", "dark_slope"),
    *_fields("u4", "scenario_count", "flare_rows", "amplitude_rows"),
])  # fmt: skip

#: Frames are padded to a multiple of this.
FRAME_BLOCK = 16
#: Taylor coefficients of q in exp(r) = 1 + r + r^2 q(r), with an error below 2e-8 for |r| <= ln(2) / 2; and ln(2) in
#: two parts, the first of which has nine bits, so that its multiples are exact.
EXPONENTIAL = tuple(float(np.float32(1.0 / np.prod(np.arange(1.0, n + 3)))) for n in range(6))
LN2_PARTS = (0.693359375, -2.1219444e-4)
LOG2_E = 1.442695

#: Minimax fits in float32 from tools/fit_normal.py: -2 ln(1 + f) / f for f in [sqrt(1/2) - 1, sqrt(2) - 1],
#: sin(pi s) / s and cos(pi s) in s^2 for s in [-1/2, 1/2].
POLYNOMIALS = {
    "log": ("-0x1.fffffap+0", "0x1.0000d4p+0", "-0x1.555ca0p-1", "0x1.ff30e2p-2", "-0x1.97073ap-2", "0x1.62c872p-2",
            "-0x1.501394p-2", "0x1.9e7c7ep-3"),
    "sin": ("0x1.921fb6p+1", "-0x1.4abbc4p+2", "0x1.4668f2p+1", "-0x1.32535ap-1", "0x1.3e17cap-4"),
    "cos": ("0x1.fffffep-1", "-0x1.3bd3a6p+2", "0x1.03bd06p+2", "-0x1.54f61ap+0", "0x1.c1f066p-3"),
}  # fmt: skip
#: 2 ln 2 in float32.
TWO_LN2 = "0x1.62e430p+0"

#: Structs by their names in C.
STRUCTS = {
    "Job": JOB, "Pixel": PIXEL, "Level": LEVEL, "Edge": EDGE, "Poisson": POISSON, "Response": RESPONSE,
    "Observer": OBSERVER, "Estimate": ESTIMATE, "Element": ELEMENT, "Grid": GRID, "Mixture": MIXTURE,
    "StareJob": STARE_JOB,
}  # fmt: skip

#: Statistics with a channel in every scenario, in the kernel's order; linear statistics follow them.
FIXED_STATISTICS = ("chi2", "chi2_element", "chi2_pair")

#: Adding and subtracting this rounds a float32 below 2**22 to the nearest integer.
MAGIC = 12582912.0

#: Quantile tables of priors run from each end to the median in octaves of probability, 2**-PRIOR_FINEST to 1/2, with
#: 2**PRIOR_BITS cells each. The device interpolates between nodes.
PRIOR_BITS = 7
PRIOR_FINEST = 56
#: Number of nodes from one end, with 1/2 repeated.
PRIOR_NODES = (PRIOR_FINEST - 1) * 2**PRIOR_BITS + 2

#: Bins of the S/N histogram of each pixel and element; the first and last bins only mark values outside.
OBSERVER_BINS = 2048

#: A histogram has BINS bins of 2**FINE_BITS fine steps; a statistic's standard deviation is STEPS_PER_SIGMA steps. The
#: first and last bins only mark values there and beyond, which `far` counts.
BINS = 32768
FINE_BITS = 2
STEPS_PER_SIGMA = 2048


def c_structs() -> str:
    """Render the structs as OpenCL C typedefs, in the order of `STRUCTS`."""
    scalars = {"u": "uint", "i": "int", "f": "float"}
    lines = []
    for name, dtype in STRUCTS.items():
        assert dtype.names is not None
        fields = "".join(f" {scalars[dtype[field].kind]} {field};" for field in dtype.names)
        lines.append(f"typedef struct {{{fields} }} {name};")
    return "\n".join(lines)


#: Largest mean of a table, at which 17 index bits leave 15 bits for acceptance.
LARGEST_MEAN = 1e8

#: From this mean on, counts come from an expansion of the inverse distribution function (kernels/poisson.cl.mako). Its
#: difference from the exact distribution is undetectable in 1e13 draws.
SMALLEST_EXPANDED = 1000.0


@dataclass(frozen=True)
class AliasTable:
    """Distribution over integers as 2**bits columns of one packed word each."""

    low: int  # count of column 0
    bits: int  # base-2 logarithm of the number of columns
    entries: NDArray[np.uint32]  # alias << (32 - bits) | threshold, shape (2**bits,)


def alias_table(mean: float) -> AliasTable:
    """Compute the alias table of a Poisson distribution with a mean of 0 to 1e8, to 2**-32 in each probability.

    Walker's method (1977, doi 10.1145/355744.355749) is applied to integers: the probabilities are rounded to multiples
    of 2**-32 that sum to one, which the table then represents exactly.
    """
    if mean == 0.0:
        return alias_table_of(np.ones(1))
    # All counts beyond this range have together less than half a word.
    reach = 6.5 * np.sqrt(mean) + 16.0
    low = max(int(mean - reach), 0)
    high = int(mean + reach + 0.5 * reach**2 / (mean + 1.0))
    counts = np.arange(low, high + 1)
    p = np.exp(special.xlogy(counts, mean) - mean - special.gammaln(counts + 1.0))
    inside = np.flatnonzero((np.cumsum(p) >= 2.0**-33) & (np.cumsum(p[::-1])[::-1] >= 2.0**-33))
    return alias_table_of(p[inside[0] : inside[-1] + 1], low + int(inside[0]))


def alias_table_of(probability: Float, low: int = 0) -> AliasTable:
    """Compute the alias table of up to 2**24 integers from `low` on, of probabilities of any sum."""
    bits = max(int(probability.size - 1).bit_length(), 1)
    padded = np.zeros(1 << bits)
    padded[: probability.size] = probability
    # Integers that sum to 2**32, by the method of largest remainders.
    exact = padded / padded.sum() * 2.0**WORD_BITS
    words: NDArray[np.int64] = np.floor(exact).astype(np.int64)
    words[np.argsort(words - exact, kind="stable")[: int(2**WORD_BITS - words.sum())]] += 1
    shift = WORD_BITS - bits
    share, remaining = 1 << shift, words.tolist()
    # A full column is its own alias, with threshold 0.
    entries = [column << shift for column in range(1 << bits)]
    small = [c for c, n in enumerate(remaining) if n < share]
    large = [c for c, n in enumerate(remaining) if n > share]
    while small:
        poor, rich = small.pop(), large[-1]
        entries[poor] = rich << shift | remaining[poor]
        remaining[rich] -= share - remaining[poor]
        if remaining[rich] <= share:
            large.pop()
            if remaining[rich] < share:
                small.append(rich)
    return AliasTable(low, bits, np.array(entries, dtype=np.uint32))
