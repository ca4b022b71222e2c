"""Random words and normals, with the bits of the kernels.

The generator is addressed by counter: each word depends only on realisation, frame, stream, group of pixels and seed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Words = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32]]
Floats = NDArray[np.float32]

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

_MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_POLYNOMIALS = {
    name: [np.float32(float.fromhex(c)) for c in coefficients] for name, coefficients in POLYNOMIALS.items()
}
_TWO_LN2 = np.float32(float.fromhex(TWO_LN2))


def philox(counter: Sequence[ArrayLike], seed: int) -> Words:
    """Compute Philox4x32-10 (Salmon et al. 2011, doi 10.1145/2063384.2063405) of a counter and a 64-bit key.

    The four words of the counter are broadcast against each other.
    """
    c0, c1, c2, c3 = np.broadcast_arrays(*(np.asarray(c, dtype=np.uint64) for c in counter))
    half, low_half = np.uint64(32), np.uint64(0xFFFFFFFF)
    for r in range(10):
        k0, k1 = (
            np.uint64((((seed >> shift) & 0xFFFFFFFF) + r * step) & 0xFFFFFFFF)
            for shift, step in zip((0, 32), _KEY_STEPS, strict=True)
        )
        p0, p1 = _MULTIPLIERS[0] * c0, _MULTIPLIERS[1] * c2
        c0, c1, c2, c3 = (p1 >> half) ^ c1 ^ k0, p1 & low_half, (p0 >> half) ^ c3 ^ k1, p0 & low_half
    return (c0.astype(np.uint32), c1.astype(np.uint32), c2.astype(np.uint32), c3.astype(np.uint32))


def words(realisation: ArrayLike, frame: ArrayLike, stream: int, group: ArrayLike, seed: int) -> Words:
    """Return the four words that four neighbouring pixels share in a stream.

    The number of the stream is the top byte of the counter's last word, and the group is the pixel index divided by
    four.
    """
    index = np.asarray(realisation, dtype=np.uint64)
    last = np.uint64(stream << 24) | np.asarray(group, dtype=np.uint64)
    return philox(
        (index & np.uint64(0xFFFFFFFF), index >> np.uint64(32), np.asarray(frame, dtype=np.uint64), last), seed
    )


def fma(a: ArrayLike, b: ArrayLike, c: ArrayLike) -> Floats:
    """Compute a * b + c in float32 with a single rounding.

    The product is exact in float64. The sum is rounded to odd (its error decides the last bit), which makes the second
    rounding, to float32, correct (Boldo & Melquiond 2008, doi 10.1109/TC.2007.70819).
    """
    product = np.asarray(a, np.float64) * np.asarray(b, np.float64)
    addend = np.asarray(c, np.float64)
    total = product + addend
    virtual = total - product
    error = (product - (total - virtual)) + (addend - virtual)
    even = (np.asarray(total).view(np.int64) & 1) == 0
    odd = np.nextafter(total, np.where(error > 0, np.inf, -np.inf))
    return np.asarray(np.where((error != 0) & even, odd, total)).astype(np.float32)


def _horner(name: str, x: Floats) -> Floats:
    *rest, value = _POLYNOMIALS[name]
    result: Floats = np.full_like(x, value)
    for coefficient in reversed(rest):
        result = fma(result, x, coefficient)
    return result


def normal_pair(radius_word: NDArray[np.uint32], angle_word: NDArray[np.uint32]) -> tuple[Floats, Floats]:
    """Compute two standard normals from two words by the method of Box & Muller (1958, doi 10.1214/aoms/1177706645)."""
    t = radius_word.astype(np.float32) + np.float32(0.5)
    split = np.uint32(0x3F3504F3)
    bits = t.view(np.uint32) - split
    halvings = (np.int32(32) - (bits.view(np.int32) >> 23)).astype(np.float32)
    f = ((bits & np.uint32(0x007FFFFF)) + split).view(np.float32) - np.float32(1.0)
    radius = np.sqrt(fma(halvings, _TWO_LN2, f * _horner("log", f)))
    s = (angle_word << np.uint32(1)).view(np.int32).astype(np.float32) * np.float32(2.0**-32)
    y = s * s
    sine, cosine = s * _horner("sin", y), _horner("cos", y)
    radius = (radius.view(np.uint32) ^ (angle_word & np.uint32(0x80000000))).view(np.float32)
    return radius * cosine, radius * sine


def four_normals(w: Words) -> list[Floats]:
    """Return the normals of four neighbouring pixels."""
    return [*normal_pair(w[0], w[1]), *normal_pair(w[2], w[3])]
