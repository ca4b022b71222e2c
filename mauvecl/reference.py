"""A slow NumPy twin of every kernel: the same counters, the same arithmetic, the same order of sums.

Integers are equal to the device's; so are floats where the device's arithmetic is strict, because every
fused multiply-add here is rounded once, as there. Used by tests and by the self-test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl import layout
from mauvecl.scene import Scene

if TYPE_CHECKING:
    from mauvecl.detection import ChannelPlan, Detection

Words = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32]]
Floats = NDArray[np.float32]

_MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_POLYNOMIALS = {
    name: [np.float32(float.fromhex(c)) for c in coefficients] for name, coefficients in layout.POLYNOMIALS.items()
}
_TWO_LN2 = np.float32(float.fromhex(layout.TWO_LN2))
_MAGIC = np.float32(layout.MAGIC)


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


def words_at(realisation: ArrayLike, frame: int, stream: str, group: ArrayLike, seed: int, exposure: int = 0) -> Words:
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
    exposure : int
        0 for the observed exposure, `layout.REFERENCE` for the other.
    """
    index = np.asarray(realisation, dtype=np.uint64)
    last = np.uint64((exposure + layout.STREAMS[stream]) << 24) | np.asarray(group, dtype=np.uint64)
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
    return np.asarray((x + _MAGIC) - _MAGIC)


@dataclass(frozen=True, eq=False)
class Draws:
    """What was drawn for four neighbouring pixels; each entry has the shape (n_realisation,)."""

    z: list[Floats]
    dark: list[Floats]
    photon: Words | None
    cosmic: list[Floats]


def poisson_draw(words: Words, i: int, source: np.void, tables: NDArray[np.uint32], pairs: Sequence[Floats]) -> Floats:
    """One pixel's count, relative to its whole number; `pairs` are the normals of the four words."""
    if not source["bits"]:
        return expansion_draw(pairs[i], source["offset"], source["slope"], source["cubic"])
    column = alias_draw(words[i], tables[int(source["table"]) :], int(source["bits"]))
    return np.asarray((column.astype(np.int32) + source["low"]).astype(np.float32))


def four_normals(w: Words) -> list[Floats]:
    """Normals of four neighbouring pixels."""
    return [*normal_pair(w[0], w[1]), *normal_pair(w[2], w[3])]


def draws(
    scene: Scene, realisation: NDArray[np.uint64], frame: int, group: int, seed: int, *, exposure: int = 0
) -> Draws:
    """Everything drawn for four pixels of one draw."""
    job = scene.job
    address = (realisation, int(job["first_frame"]) + frame)
    place = (int(job["first_group"]) + group, seed, exposure)
    z = four_normals(words_at(*address, "noise", *place))
    dark: list[Floats] = []
    if not scene.joint:
        w = words_at(*address, "dark", *place)
        y = four_normals(w)
        four = scene.dark_counts[4 * group : 4 * group + 4]
        dark = [poisson_draw(w, i, four[i], scene.tables, y) for i in range(4)]
    photon = words_at(*address, "photon", *place) if scene.photons else None
    cosmic: list[Floats] = []
    if scene.cosmic:
        table, bits = scene.tables[int(job["cosmic_table"]) :], int(job["cosmic_bits"])
        cosmic = [
            (alias_draw(word, table, bits).astype(np.int32) + job["cosmic_low"]).astype(np.float32)
            for word in words_at(*address, "cosmic", *place)
        ]
    return Draws(z, dark, photon, cosmic)


def quantile(word: NDArray[np.uint32], table: Floats) -> Floats:
    """A prior's value at the probability that a word stands for."""
    bits = layout.PRIOR_BITS
    cell = word >> np.uint32(32 - bits)
    part = (word & np.uint32(2 ** (32 - bits) - 1)).astype(np.float32) * np.float32(1.0 / 2 ** (32 - bits))
    return fma(part, table[cell + 1] - table[cell], table[cell])


def factors(
    scene: Scene, realisation: NDArray[np.uint64], frame: int, seed: int, *, exposure: int = 0
) -> tuple[Floats, Floats]:
    """Factors on light and dark of one draw, each shape (n_realisation,)."""
    found = {"light": np.ones(len(realisation), np.float32), "dark": np.ones(len(realisation), np.float32)}
    kept = np.ones(len(realisation), np.float32)
    first = int(scene.job["first_frame"]) + frame
    for (name, factor), table in zip(scene.modulations, scene.priors, strict=True):
        if name != "jitter":
            found[factor] = found[factor] * quantile(words_at(realisation, 0, name, 0, seed)[0], table)
            continue
        lost = np.zeros(len(realisation), np.float32)
        for f in range(first, first + (1 if scene.frames else scene.n_frames)):
            lost = lost + quantile(words_at(realisation, f // 4, name, 0, seed, exposure)[f % 4], table)
        one = np.float32(1.0)
        kept = one - lost if scene.frames else fma(lost, np.float32(-1.0) / np.float32(scene.n_frames), one)
    return found["light"] * kept, found["dark"]


def analogue(scene: Scene, drawn: Draws, i: int, pixel: int, k: int, light: Floats, dark: Floats) -> Floats:
    """The count above the level's base before the ADC, shape (n_realisation,)."""
    level, z = scene.levels[k, pixel], drawn.z[i]
    if scene.modulations:
        v = _responding(scene.responses[k, pixel], level["c0"], z, light, dark)
    elif scene.joint:
        first, *rest = ("c4", "c3", "c2", "c1", "c0") if scene.quartic else ("c3", "c2", "c1", "c0")
        v = np.full_like(z, level[first])
        for name in rest:
            v = fma(z, v, level[name])
    else:
        v = fma(drawn.dark[i], scene.dark_counts[pixel]["gain"], fma(z, level["c1"], level["c0"]))
    if drawn.photon is not None:
        source = scene.photon_counts[k, pixel]
        # The two of a pair use each other's words where the count comes from a normal.
        count = poisson_draw(drawn.photon, i, source, scene.tables, four_normals(drawn.photon))
        v = fma(count, source["gain"], v)
    if scene.cosmic:
        v = fma(drawn.cosmic[i], scene.pixels[pixel]["cosmic_gain"], v)
    return v


def _responding(r: np.void, c0: np.float32, z: Floats, light: Floats, dark: Floats) -> Floats:
    variance = fma(light, r["light_variance"], fma(dark, r["dark_variance"], r["other_variance"]))
    third = fma(light, r["light_third"], dark * r["dark_third"])
    fourth = fma(light, r["light_fourth"], dark * r["dark_fourth"])
    with np.errstate(invalid="ignore", divide="ignore"):  # padded pixels have no variance
        sd, share, zz = np.sqrt(variance), third / variance, z * z
        curve = fourth * fma(zz, np.float32(0.041666668), np.float32(-0.125))
        curve = curve - third * share * fma(zz, np.float32(0.055555556), np.float32(-0.1388889))
        cubic = curve / (variance * sd)
        v = fma(z, sd + cubic, fma(share, fma(zz, np.float32(0.16666667), np.float32(-0.16666667)), c0))
    one = np.float32(1.0)
    out: Floats = v + fma(light - one, r["light"], (dark - one) * r["dark"])
    return out


def digitise(v: Floats, edge: np.void, *, clip: bool) -> Floats:
    """DN above the level's base, rounded and clipped."""
    r = v + _MAGIC
    if clip:
        r = np.where(r < edge["low"], edge["low"], r)
        r = np.where(r > edge["high"], edge["high"], r)
    return np.asarray(r - _MAGIC)


def observed(
    scene: Scene,
    realisation: NDArray[np.uint64],
    seed: int,
    *,
    exposure: int = 0,
    number: int = 0,
    scenarios: Sequence[int] | None = None,
) -> NDArray[np.float32]:
    """DN above the base, summed over the draws, of scenarios; of exposure `number` of several.

    Returns
    -------
    ndarray of float32, shape (n_scenario, n_padded, n_realisation)
    """
    chosen = range(len(scene.levels)) if scenarios is None else scenarios
    total = np.zeros((len(chosen), len(scene.pixels), len(realisation)), np.float32)
    for frame in range(number * scene.n_draws, (number + 1) * scene.n_draws):
        first = frame if scene.frames else number * scene.n_frames
        light, dark = factors(scene, realisation, first, seed, exposure=exposure)
        for group in range(len(scene.pixels) // 4):
            drawn = draws(scene, realisation, frame, group, seed, exposure=exposure)
            for i, p in enumerate(range(4 * group, 4 * group + 4)):
                for row, k in enumerate(chosen):
                    v = analogue(scene, drawn, i, p, k, light, dark)
                    total[row, p] += digitise(v, scene.edges[k, p], clip=scene.clip)
    return total


def clipped(scene: Scene, realisation: NDArray[np.uint64], seed: int) -> NDArray[np.int64]:
    """Frames that each pixel of scenario 0 spends below and above the ADC's range.

    Returns
    -------
    ndarray of int64, shape (n_realisation, n_pixel, 2)
    """
    count = np.zeros((len(realisation), len(scene.pixels), 2), np.int64)
    if scene.clip:
        for frame in range(scene.n_draws):
            light, dark = factors(scene, realisation, frame, seed)
            for group in range(-(-scene.n_pixel // 4)):
                drawn = draws(scene, realisation, frame, group, seed)
                for i, p in enumerate(range(4 * group, min(4 * group + 4, len(scene.pixels)))):
                    r = analogue(scene, drawn, i, p, 0, light, dark) + _MAGIC
                    count[:, p, 0] += r < scene.edges[0, p]["low"]
                    count[:, p, 1] += r > scene.edges[0, p]["high"]
    return count[:, : scene.n_pixel]


def realise(scene: Scene, realisation: NDArray[np.uint64], seed: int) -> NDArray[np.int64]:
    """Raw DN of scenario 0 summed over the frames, shape (n_realisation, n_pixel)."""
    above = observed(scene, realisation, seed, scenarios=[0])[0, : scene.n_pixel]
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
    smoothed: Smoothed | None = None,
) -> NDArray[np.float32]:
    """Every channel of the kernels `statistics` and `comparison`, in their order.

    Parameters
    ----------
    scene : Scene
    realisation : ndarray of uint64, shape (n,)
    seed : int
    weights : ndarray of float32, shape (n_linear, n_padded)
    linear_end : ndarray of uint32, shape (n_scenario,)
    pair : bool
        Whether `chi2_pair` is wanted; its rows are zero otherwise.
    smoothed : Smoothed, optional
        Where `paper` is wanted.

    Returns
    -------
    ndarray of float32, shape (3 n_scenario + n_linear + n_smoothed, n)
    """
    n_scenario, fixed = len(scene.levels), len(layout.FIXED_STATISTICS)
    constants = scene.constants(weights, linear_end)
    estimated, exposures = scene.comparison.estimated, scene.comparison.exposures
    share, scale = scene.job["reference_share"], scene.job["pair_scale"]
    out = np.zeros((fixed * n_scenario + len(weights), len(realisation)), np.float32)
    x = _above_template(scene, observed(scene, realisation, seed))
    drawn = max(exposures, 1) if exposures or pair or smoothed is not None else 0
    others = [
        _above_template(scene, observed(scene, realisation, seed, exposure=layout.REFERENCE, number=number))
        for number in range(drawn)
    ]
    finished = []
    begin = 0
    for k in range(n_scenario):
        t = int(scene.templates[k])
        raw, level = x[k], scene.levels[k]
        y: Floats = raw
        variance: Floats = np.zeros_like(raw)
        if exposures:
            total = np.sum([other[t] for other in others], axis=0, dtype=np.float32)
            y = fma(total, -share, raw)
        if estimated:
            estimate = scene.estimates[k]
            variance = _variance(raw, estimate)
            if exposures:
                variance = np.add(variance, share * _variance(total * share, estimate), dtype=np.float32)
            y = np.add(y, estimate["fraction"][:, None], dtype=np.float32)
        parts = [np.zeros(len(realisation), np.float32) for _ in range(4)]
        for p, pixel in enumerate(scene.pixels):
            if estimated:
                parts[p % 4] = fma(y[p] * y[p], pixel["used"] / variance[p], parts[p % 4])
            else:
                slope = fma(y[p], level[p]["inverse_variance"], level[p]["twice"])
                parts[p % 4] = fma(y[p], slope, parts[p % 4])
        out[fixed * k] = ((parts[0] + parts[1]) + (parts[2] + parts[3])) + constants[k]
        out[fixed * k + 1] = _element_sum(scene, k, y, variance)
        for p, pixel in enumerate(scene.pixels) if pair else ():
            d = raw[p] - others[0][t, p]
            if estimated:
                both = _variance(raw, estimate)[p] + _variance(others[0][t], estimate)[p]
                weight = pixel["used"] / both
            else:
                weight = scale * level[p]["inverse_variance"]
            out[fixed * k + 2] = fma(d * d, weight, out[fixed * k + 2])
        for linear in range(begin, int(linear_end[k])):
            row = _summed(y, weights[linear])
            if estimated:
                row = np.divide(row, np.sqrt(_summed(variance, weights[linear] * weights[linear])), dtype=np.float32)
            else:
                row = row + constants[n_scenario + linear]
            out[fixed * n_scenario + linear] = row
        begin = int(linear_end[k])
        if smoothed is not None:
            finished += smoothed.sums(raw - others[0][t], k)
    return np.concatenate([out, np.array(finished, np.float32).reshape(len(finished), len(realisation))])


def _variance(x: Floats, estimate: NDArray[np.void]) -> Floats:
    """What an observer takes counts for, shape (n_padded, n)."""
    gain, known, offset = (estimate[name][:, None] for name in ("gain", "variance", "net_offset"))
    return fma(np.maximum(x + offset, np.float32(0.0)), gain, known)


def _element_sum(scene: Scene, k: int, y: Floats, variance: Floats) -> Floats:
    """The statistic `chi2_element` of a scenario, shape (n,)."""
    total: Floats = np.zeros_like(y[0])
    inside, noise = total, total
    estimated = scene.comparison.estimated
    for p, (pixel, edge) in enumerate(zip(scene.pixels, scene.edges[k], strict=True)):
        if pixel["four_uneven"] or estimated:
            inside = fma(y[p], pixel["used"], inside)
            noise = fma(variance[p], pixel["used"], noise)
        elif p % 4 == 0:
            inside = inside + ((y[p] + y[p + 1]) + (y[p + 2] + y[p + 3]))
        if pixel["element_end"]:
            if estimated:
                total = np.add(total, inside * inside / np.maximum(noise, np.float32(1e-12)), dtype=np.float32)
            else:
                inside = np.add(inside, edge["element_offset"], dtype=np.float32)
                total = fma(inside * inside, edge["inverse_element_variance"], total)
            inside, noise = np.zeros_like(total), np.zeros_like(total)
    return total


@dataclass(frozen=True, eq=False)
class Smoothed:
    """What the statistic `paper` needs: weights of each centre, shape (n_centre, n_padded), and factors of squares."""

    rows: NDArray[np.float32]
    scales: NDArray[np.float32]
    scale_end: NDArray[np.uint32]

    @classmethod
    def of(cls, found: Detection, plan: ChannelPlan) -> Smoothed:
        """Of a detection's channels."""
        rows = np.zeros((len(found.smoothing.rows), len(found.scene.pixels)), np.float32)
        rows[:, : found.scene.n_pixel] = found.smoothing.rows
        return cls(rows, plan.scales, plan.scale_end)

    def sums(self, difference: Floats, k: int) -> list[Floats]:
        """The smoothed statistics of a scenario, each shape (n,)."""
        begin = int(self.scale_end[k - 1]) if k else 0
        out = [np.zeros(difference.shape[1], np.float32) for _ in range(begin, int(self.scale_end[k]))]
        for centre, row in enumerate(self.rows):
            value = np.zeros(difference.shape[1], np.float32)
            for p in np.flatnonzero(row):
                value = fma(difference[p], row[p], value)
            square = value * value
            out = [fma(square, self.scales[begin + i, centre], one) for i, one in enumerate(out)]
        return out


def _above_template(scene: Scene, above: NDArray[np.float32]) -> NDArray[np.float32]:
    if scene.frames:
        return np.asarray(above + scene.edges["whole"][:, :, None])
    return np.asarray((above + _MAGIC) - scene.levels["shift"][:, :, None])


def _summed(values: NDArray[np.float32], weights: NDArray[np.float32]) -> Floats:
    """Weighted sums over pixels, shape (n_pixel, n) to (n,): four side by side, by pixel number modulo four."""
    parts = [np.zeros(values.shape[1], np.float32) for _ in range(4)]
    for p, weight in enumerate(weights):
        parts[p % 4] = fma(values[p], weight, parts[p % 4])
    total: Floats = (parts[0] + parts[1]) + (parts[2] + parts[3])
    return total


def histograms(
    scene: Scene,
    observers: NDArray[np.void],
    elements: NDArray[np.void],
    realisation: NDArray[np.uint64],
    seed: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """The kernel `histogram`: each pixel's counts, each element's S/N, and frames clipped.

    Returns
    -------
    pixel_counts, element_counts : ndarray of int64, shapes (n_pixel, OBSERVER_BINS) and (n_element, OBSERVER_BINS)
    clipped : ndarray of int64, shape (n_pixel, 2)
        Below and above the ADC's range.
    """
    bins, half = layout.OBSERVER_BINS, layout.OBSERVER_BINS // 2
    n = observed(scene, realisation, seed, scenarios=[0])[0]
    pixel_counts = np.zeros((scene.n_pixel, bins), np.int64)
    element_counts = np.zeros((len(elements), bins), np.int64)
    for e, element in enumerate(elements):
        signal, variance = (np.zeros(len(realisation), np.float32) for _ in range(2))
        for p in range(int(element["first"]), int(element["end"])):
            observer = observers[p]
            net = n[p] + observer["net_offset"]
            signal = signal + net
            variance = variance + fma(np.maximum(net, np.float32(0.0)), observer["gain"], observer["variance"])
            whole = (n[p].astype(np.int64) >> int(observer["bin_shift"])) + half
            pixel_counts[p] = np.bincount(np.clip(whole, 0, bins - 1), minlength=bins)
        with np.errstate(invalid="ignore"):
            steps = (signal / np.sqrt(variance) - element["centre"]) * element["bins_per_unit"]
        whole = nearest(np.clip(steps, np.float32(-half), np.float32(half - 1))).astype(np.int64) + half
        element_counts[e] = np.bincount(whole, minlength=bins)
    return pixel_counts, element_counts, clipped(scene, realisation, seed).sum(axis=0)


def tally(values: NDArray[np.float32], grids: NDArray[np.void]) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Histograms, shape (n_grid, BINS), and sums of fine steps and their squares, shape (n_grid, 2).

    Parameters
    ----------
    values : ndarray of float32, shape (n_channel, n)
    grids : ndarray of layout.GRID, shape (n_grid,)
    """
    bins = layout.BINS
    histogram = np.zeros((len(grids), bins), np.uint32)
    sums = np.zeros((len(grids), 2), np.int64)
    limit = np.float32(layout.STEP_LIMIT)
    for g, grid in enumerate(grids):
        steps = (values[int(grid["channel"])] - grid["centre"]) * grid["steps_per_unit"]
        step = nearest(np.clip(steps, -limit, limit)).astype(np.int64)
        bin_index = np.clip((step >> layout.FINE_BITS) + bins // 2, 0, bins - 1)
        histogram[g] = np.bincount(bin_index, minlength=bins)
        sums[g] = step.sum(), (step * step).sum()
    return histogram, sums
