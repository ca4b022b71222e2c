"""A slow NumPy twin of every kernel: the same counters, the same arithmetic, the same order of sums.

Integers are equal to the device's; so are floats where the device's arithmetic is strict, because every
fused multiply-add here is rounded once, as there. Used by tests and by the self-test.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl import layout
from mauvecl.scene import Scene

Words = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32]]
Floats = NDArray[np.float32]

_MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_POLYNOMIALS = {
    name: [np.float32(float.fromhex(c)) for c in coefficients] for name, coefficients in layout.POLYNOMIALS.items()
}
_TWO_LN2 = np.float32(float.fromhex(layout.TWO_LN2))
_NEAREST = np.float32(12582912.0)


def philox(counter: Sequence[ArrayLike], seed: int) -> Words:
    """Philox4x32-10 (Salmon et al. 2011, doi 10.1145/2063384.2063405).

    Parameters
    ----------
    counter : four array_like of uint32
        Broadcast against each other.
    seed : int
        The 64-bit key.
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


def words_at(realisation: ArrayLike, frame: int, stream: str, group: ArrayLike, seed: int) -> Words:
    """The four words that four neighbouring pixels of one realisation and frame share in a stream.

    Parameters
    ----------
    realisation : array_like of int
        64-bit indices.
    frame : int
    stream : str
        A key of `layout.STREAMS`.
    group : array_like of int
        Pixel index over four.
    seed : int
    """
    index = np.asarray(realisation, dtype=np.uint64)
    last = np.uint64(layout.STREAMS[stream] << 24) | np.asarray(group, dtype=np.uint64)
    return philox((index & np.uint64(0xFFFFFFFF), index >> np.uint64(32), np.uint64(frame), last), seed)


def fma(a: ArrayLike, b: ArrayLike, c: ArrayLike) -> Floats:
    """a * b + c in float32, rounded once.

    The product is exact in float64. The sum is rounded to odd there (its error decides the last bit), which makes the
    second rounding, to float32, the correct one (Boldo & Melquiond 2008, doi 10.1109/TC.2007.70819).
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
    """Two standard normals from two words, by Box and Muller (1958, doi 10.1214/aoms/1177706645)."""
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


def alias_draw(word: NDArray[np.uint32], table: NDArray[np.uint32], bits: int) -> NDArray[np.uint32]:
    """The alias table's column for each word; see `poisson.AliasTable`."""
    shift = np.uint32(layout.WORD_BITS - bits)
    column = word >> shift
    entry = table[column]
    mask = (np.uint32(1) << shift) - np.uint32(1)
    return np.where((word & mask) < (entry & mask), column, entry >> shift)


def expansion_draw(z: Floats, offset: np.float32, slope: np.float32, cubic: np.float32) -> Floats:
    """Poisson counts of a large mean, relative to the whole number nearest to it."""
    curve = fma(z, cubic, np.float32(0.16666667))
    return nearest(fma(z, fma(z, curve, slope), offset))


def nearest(x: Floats) -> Floats:
    """Nearest whole number, ties to even, for values below 2**22."""
    return (x + _NEAREST) - _NEAREST


def draws(
    scene: Scene, realisation: NDArray[np.uint64], frame: int, group: int, seed: int, *, reference: bool = False
) -> tuple[list[Floats], list[Floats]]:
    """Gaussian z and dark count d of four pixels, each shape (n_realisation,)."""
    prefix = "reference_" if reference else ""
    g = words_at(realisation, frame, f"{prefix}noise", group, seed)
    w = words_at(realisation, frame, f"{prefix}dark", group, seed)
    z = [*normal_pair(g[0], g[1]), *normal_pair(g[2], g[3])]
    four = scene.pixels[4 * group : 4 * group + 4]
    if scene.expansion:
        y = [*normal_pair(w[0], w[1]), *normal_pair(w[2], w[3])]
        coefficients = zip(four["dark_offset"], four["dark_slope"], four["dark_cubic"], strict=True)
        return z, [expansion_draw(y[i], *c) for i, c in enumerate(coefficients)]
    d = []
    for i, pixel in enumerate(four):
        table = scene.tables[int(pixel["table_start"]) :]
        column = alias_draw(w[i], table, int(pixel["table_bits"]))
        d.append((column.astype(np.int32) + pixel["dark_low"]).astype(np.float32))
    return z, d


def digitise(z: Floats, d: Floats, dark_gain: np.float32, level: np.void, *, clip: bool) -> Floats:
    """DN above the level's base, rounded and clipped."""
    dn = nearest(fma(level["sd"], z, fma(dark_gain, d, level["fraction"])))
    return np.clip(dn, level["low"], level["high"]) if clip else dn


def observed(
    scene: Scene, realisation: NDArray[np.uint64], seed: int, *, reference: bool = False
) -> NDArray[np.float32]:
    """DN above the base, summed over the draws, of every scenario.

    Returns
    -------
    ndarray of float32, shape (n_scenario, n_padded, n_realisation)
    """
    scenarios = scene.levels[:1] if reference else scene.levels
    total = np.zeros((len(scenarios), len(scene.pixels), len(realisation)), np.float32)
    for frame in range(scene.n_draws):
        for group in range(len(scene.pixels) // 4):
            z, d = draws(scene, realisation, frame, group, seed, reference=reference)
            for i, p in enumerate(range(4 * group, 4 * group + 4)):
                for k, levels in enumerate(scenarios):
                    total[k, p] += digitise(z[i], d[i], scene.pixels[p]["dark_gain"], levels[p], clip=scene.clip)
    return total


def realise(scene: Scene, realisation: NDArray[np.uint64], seed: int) -> NDArray[np.int64]:
    """Raw DN of scenario 0 summed over the frames, shape (n_realisation, n_pixel)."""
    above = observed(scene.part([0]), realisation, seed)[0, : scene.n_pixel]
    raw: NDArray[np.int64] = (above.astype(np.int64) + scene.n_draws * scene.base_dn[0][:, None]).T
    return raw


def statistics(
    scene: Scene,
    realisation: NDArray[np.uint64],
    seed: int,
    weights: NDArray[np.float32],
    linear_end: NDArray[np.uint32],
    *,
    pair: bool = True,
) -> NDArray[np.float32]:
    """Every channel of the kernel `statistics`, in its order.

    Parameters
    ----------
    scene : Scene
    realisation : ndarray of uint64, shape (n,)
    seed : int
    weights : ndarray of float32, shape (n_linear, n_padded)
    linear_end : ndarray of uint32, shape (n_scenario,)
    pair : bool
        Whether `chi2_pair` is wanted; its rows are zero otherwise.

    Returns
    -------
    ndarray of float32, shape (3 n_scenario + n_linear, n)
    """
    n_scenario, fixed = len(scene.levels), len(layout.FIXED_STATISTICS)
    out = np.zeros((fixed * n_scenario + len(weights), len(realisation)), np.float32)
    x = observed(scene, realisation, seed) + scene.levels["offset"][:, :, None]
    if pair:
        quiet = observed(scene, realisation, seed, reference=True)[0] + scene.levels["offset"][0][:, None]
    begin = 0
    for k in range(n_scenario):
        chi2, chi2_element, chi2_pair = (out[fixed * k + i] for i in range(fixed))
        inside = np.zeros(len(realisation), np.float32)
        chi2[:] = _summed(x[k] * x[k], scene.pixels["inverse_variance"])
        for p, pixel in enumerate(scene.pixels):
            if pixel["end_among_four"]:
                inside = fma(x[k, p], pixel["used"], inside)
            elif p % 4 == 0:
                used = scene.pixels["used"][p : p + 4]
                inside = inside + (
                    fma(x[k, p], used[0], x[k, p + 1] * used[1]) + fma(x[k, p + 2], used[2], x[k, p + 3] * used[3])
                )
            if pixel["element_end"]:
                chi2_element[:] = fma(inside * inside, pixel["inverse_element_variance"], chi2_element)
                inside = np.zeros(len(realisation), np.float32)
            if pair:
                difference = x[k, p] - quiet[p]
                chi2_pair[:] = fma(difference * difference, np.float32(0.5) * pixel["inverse_variance"], chi2_pair)
        for linear in range(begin, int(linear_end[k])):
            out[fixed * n_scenario + linear] = _summed(x[k], weights[linear])
        begin = int(linear_end[k])
    return out


def _summed(values: NDArray[np.float32], weights: NDArray[np.float32]) -> Floats:
    """Weighted sums over pixels, shape (n_pixel, n) to (n,): four side by side, by pixel number modulo four."""
    parts = [np.zeros(values.shape[1], np.float32) for _ in range(4)]
    for p, weight in enumerate(weights):
        parts[p % 4] = fma(values[p], weight, parts[p % 4])
    total: Floats = (parts[0] + parts[1]) + (parts[2] + parts[3])
    return total


def signal_to_noise(
    scene: Scene, observers: NDArray[np.void], realisation: NDArray[np.uint64], seed: int
) -> tuple[Floats, Floats]:
    """S/N per pixel, shape (n_padded, n), and per resolution element, shape (n_element, n)."""
    above = observed(scene.part([0]), realisation, seed)[0]
    pixels, elements = np.zeros_like(above), []
    signal, variance = (np.zeros(len(realisation), np.float32) for _ in range(2))
    for p, observer in enumerate(observers):
        net = above[p] + observer["net_offset"]
        noise2 = fma(np.maximum(net, np.float32(0.0)), observer["gain"], observer["variance"])
        signal = signal + net * observer["used"]
        variance = fma(noise2, observer["used"], variance)
        pixels[p] = net / np.sqrt(noise2)
        if scene.pixels[p]["element_end"]:
            elements.append(signal / np.sqrt(variance))
            signal, variance = np.zeros_like(signal), np.zeros_like(variance)
    return pixels, np.array(elements)


def tally(
    values: NDArray[np.float32], grids: NDArray[np.void], bins: int, fine_bits: int
) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Histograms, shape (n_grid, bins), and sums of fine steps and their squares, shape (n_grid, 2).

    Parameters
    ----------
    values : ndarray of float32, shape (n_channel, n)
    grids : ndarray of layout.GRID, shape (n_grid,)
    bins, fine_bits : int
    """
    histogram = np.zeros((len(grids), bins), np.uint32)
    sums = np.zeros((len(grids), 2), np.int64)
    limit = np.float32(layout.STEP_LIMIT)
    for g, grid in enumerate(grids):
        steps = (values[int(grid["channel"])] - grid["centre"]) * grid["steps_per_unit"]
        step = nearest(np.clip(steps, -limit, limit)).astype(np.int64)
        bin_index = np.clip((step >> fine_bits) + bins // 2, 0, bins - 1)
        histogram[g] = np.bincount(bin_index, minlength=bins)
        sums[g] = step.sum(), (step * step).sum()
    return histogram, sums
