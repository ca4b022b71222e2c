"""Slow NumPy reference implementation of the kernels' draws.

Counters, arithmetic and the order of sums are those of the kernels. Integers equal the device's, and so do floats on
devices with strict arithmetic, because each fused multiply-add is rounded once. Tests and the self-test use it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.noise import layout
from mauvecl.noise.random_numbers import Floats, Words, fma, four_normals, words
from mauvecl.noise.scene import Scene

MAGIC = np.float32(layout.MAGIC)


def words_at(
    realisation: ArrayLike, frame: ArrayLike, stream: str, group: ArrayLike, seed: int, exposure: int = 0
) -> Words:
    """Return the four words that four neighbouring pixels of a realisation and frame share in a stream.

    Parameters
    ----------
    realisation : array_like of int
        64-bit indices.
    frame : array_like of int
    stream : str
        A key of `layout.STREAMS`.
    group : array_like of int
        Pixel index divided by four.
    exposure : int
        0 for the observed exposure, `layout.REFERENCE` for the reference.
    """
    return words(realisation, frame, exposure + layout.STREAMS[stream], group, seed)


def alias_draw(word: NDArray[np.uint32], table: NDArray[np.uint32], bits: int) -> NDArray[np.uint32]:
    """Return the alias table's column for each word; see `poisson.AliasTable`."""
    shift = np.uint32(layout.WORD_BITS - bits)
    column = word >> shift
    entry = table[column]
    mask = (np.uint32(1) << shift) - np.uint32(1)
    return np.where((word & mask) < (entry & mask), column, entry >> shift)


def expansion_draw(z: Floats, offset: np.float32, slope: np.float32, cubic: np.float32) -> Floats:
    """Return Poisson counts of a large mean, relative to the mean rounded to an integer."""
    curve = fma(z, cubic, np.float32(0.16666667))
    return nearest(fma(z, fma(z, curve, slope), offset))


def nearest(x: Floats) -> Floats:
    """Round to the nearest integer, ties to even, for values below 2**22."""
    return np.asarray((x + MAGIC) - MAGIC)


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of four neighbouring pixels; each array has the shape (n_realisation,)."""

    z: list[Floats]
    dark: list[Floats]
    photon: Words | None
    added: dict[str, list[Floats]]  # electrons of additive processes


def poisson_draw(words: Words, i: int, source: np.void, tables: NDArray[np.uint32], pairs: Sequence[Floats]) -> Floats:
    """Return one pixel's count, relative to its rounded mean; `pairs` are the normals of the four words."""
    if not source["bits"]:
        return expansion_draw(pairs[i], source["offset"], source["slope"], source["cubic"])
    column = alias_draw(words[i], tables[int(source["table"]) :], int(source["bits"]))
    return np.asarray((column.astype(np.int32) + source["low"]).astype(np.float32))


def draws(
    scene: Scene, realisation: NDArray[np.uint64], frame: ArrayLike, group: int, seed: int, *, exposure: int = 0
) -> Draws:
    """Draw everything that four pixels of one draw need; `frame` is one number, or one for each realisation."""
    job = scene.job
    address = (realisation, int(job["first_frame"]) + np.asarray(frame))
    place = (int(job["first_group"]) + group, seed, exposure)
    z = four_normals(words_at(*address, "noise", *place))
    dark: list[Floats] = []
    if not scene.joint:
        w = words_at(*address, "dark", *place)
        y = four_normals(w)
        four = scene.dark_counts[4 * group : 4 * group + 4]
        dark = [poisson_draw(w, i, four[i], scene.tables, y) for i in range(4)]
    photon = words_at(*address, "photon", *place) if scene.photons else None
    added: dict[str, list[Floats]] = {}
    for name in scene.additive:
        table, bits = scene.tables[int(job[f"{name}_table"]) :], int(job[f"{name}_bits"])
        added[name] = [
            (alias_draw(word, table, bits).astype(np.int32) + job[f"{name}_low"]).astype(np.float32)
            for word in words_at(*address, name, *place)
        ]
    return Draws(z, dark, photon, added)


def quantile(word: NDArray[np.uint32], finer: NDArray[np.uint32], table: Floats) -> Floats:
    """Return a prior's factor minus one at the probability given by a word and its finer digits."""
    low_bits = 23 - layout.PRIOR_BITS
    side = word.view(np.int32) >> 31
    within = ((finer & np.uint32(0x7FFFFF)).astype(np.float32) + np.float32(0.5)) * np.float32(2.0**-23)
    t = (word.view(np.int32) ^ side).astype(np.float32) + within
    bits = t.view(np.uint32) - np.uint32((127 + 32 - layout.PRIOR_FINEST) << 23)
    cell = (bits >> np.uint32(low_bits)) + (side.view(np.uint32) & np.uint32(layout.PRIOR_NODES))
    part = (bits & np.uint32(2**low_bits - 1)).astype(np.float32) * np.float32(2.0**-low_bits)
    return fma(part, table[cell + 1] - table[cell], table[cell])


def combine_factors(a: Floats, b: Floats) -> Floats:
    """Return the product of two factors, all minus one."""
    return fma(a, b, a + b)


def factors(
    scene: Scene, realisation: NDArray[np.uint64], frame: int, seed: int, *, exposure: int = 0
) -> tuple[Floats, Floats, Floats]:
    """Draw factors on light, dark and sky, relative to the priors' medians and minus one, shape (n_realisation,)."""
    factor_of = {factor: np.zeros(len(realisation), np.float32) for factor in ("light", "dark", "sky")}
    kept = np.zeros(len(realisation), np.float32)
    first = int(scene.job["first_frame"]) + frame
    for (name, factor), table in zip(scene.modulations, scene.priors, strict=True):
        if name != "jitter":
            words = words_at(realisation, 0, name, 0, seed)
            factor_of[factor] = combine_factors(factor_of[factor], quantile(words[0], words[1], table))
            continue
        for f in range(first, first + (1 if scene.frames else scene.n_frames)):
            words = words_at(realisation, f // 4, name, 0, seed, exposure)
            kept = kept + quantile(words[f % 4], words[(f + 1) % 4], table)
        if not scene.frames:
            kept = kept * (np.float32(1.0) / np.float32(scene.n_frames))
    return combine_factors(factor_of["light"], kept), factor_of["dark"], factor_of["sky"]


def analogue(
    scene: Scene, drawn: Draws, i: int, pixel: int, k: int, light: Floats, dark: Floats, sky: Floats
) -> Floats:
    """Return the analogue count above the level's base, before the ADC, shape (n_realisation,)."""
    level, z = scene.levels[k, pixel], drawn.z[i]
    if scene.modulations:
        if any(factor == "sky" for _, factor in scene.modulations):
            light = combine_factors(light, sky * scene.responses[k, pixel]["sky_share"])
        v = _responding(scene.responses[k, pixel], level["c0"], z, light, dark, quartic=scene.quartic)
    elif scene.joint:
        first, *rest = ("c4", "c3", "c2", "c1", "c0") if scene.quartic else ("c3", "c2", "c1", "c0")
        v = np.full_like(z, level[first])
        for name in rest:
            v = fma(z, v, level[name])
    else:
        v = fma(drawn.dark[i], scene.dark_counts[pixel]["gain"], fma(z, level["c1"], level["c0"]))
    if drawn.photon is not None:
        source = scene.photon_counts[k, pixel]
        # Both pixels of a pair use both words if the count comes from a normal.
        count = poisson_draw(drawn.photon, i, source, scene.tables, four_normals(drawn.photon))
        v = fma(count, source["gain"], v)
    for electrons in drawn.added.values():
        v = fma(electrons[i], scene.pixels[pixel]["electron_gain"], v)
    return v


def _responding(
    r: np.void, c0: np.float32, z: Floats, light_change: Floats, dark_change: Floats, *, quartic: bool
) -> Floats:
    one = np.float32(1.0)
    light, dark = light_change + one, dark_change + one
    variance = fma(light, r["light_variance"], fma(dark, r["dark_variance"], r["other_variance"]))
    third = fma(light, r["light_third"], dark * r["dark_third"])
    fourth = fma(light, r["light_fourth"], dark * r["dark_fourth"])
    with np.errstate(invalid="ignore", divide="ignore"):  # padded pixels have no variance
        sd, skew, zz = np.sqrt(variance), third / variance, z * z
        curve = fourth * fma(zz, np.float32(0.041666668), np.float32(-0.125))
        curve = curve - third * skew * fma(zz, np.float32(0.055555556), np.float32(-0.1388889))
        cubic = curve / (variance * sd)
        v = fma(z, sd + cubic, fma(skew, fma(zz, np.float32(0.16666667), np.float32(-0.16666667)), c0))
        if quartic:
            fifth = fma(light, r["light_fifth"], dark * r["dark_fifth"])
            even = fifth * _quartic(zz, 0.008333334, -0.05, 0.025)
            even = even - skew * fourth * _quartic(zz, 0.041666668, -0.20833333, 0.083333336)
            even = even + skew * skew * third * _quartic(zz, 0.037037037, -0.16358025, 0.052469134)
            v = v + even / (variance * variance)
    out: Floats = v + fma(light_change, r["light"], dark_change * r["dark"])
    return out


def _quartic(zz: Floats, second: float, first: float, constant: float) -> Floats:
    return fma(zz, fma(zz, np.float32(second), np.float32(first)), np.float32(constant))


def digitise(v: Floats, edge: np.void, *, clip: bool) -> Floats:
    """Round and clip to DN above the level's base."""
    r = v + MAGIC
    if clip:
        r = np.where(r < edge["low"], edge["low"], r)
        r = np.where(r > edge["high"], edge["high"], r)
    return np.asarray(r - MAGIC)


def observed(
    scene: Scene,
    realisation: NDArray[np.uint64],
    seed: int,
    *,
    exposure: int = 0,
    number: int = 0,
    scenarios: Sequence[int] | None = None,
) -> NDArray[np.int64]:
    """Sum the DN above the base over the draws of exposure `number`, for each scenario.

    Returns
    -------
    ndarray of int64, shape (n_scenario, n_padded, n_realisation)
    """
    chosen = range(len(scene.levels)) if scenarios is None else scenarios
    total = np.zeros((len(chosen), len(scene.pixels), len(realisation)), np.int64)
    drawn_frames = range(number * scene.n_draws, (number + 1) * scene.n_draws)
    index, frames, changes = _all_frames(scene, realisation, drawn_frames, seed, exposure)
    for group in range(len(scene.pixels) // 4):
        drawn = draws(scene, index, frames, group, seed, exposure=exposure)
        for i, p in enumerate(range(4 * group, 4 * group + 4)):
            for row, k in enumerate(chosen):
                v = analogue(scene, drawn, i, p, k, *changes)
                with np.errstate(invalid="ignore"):  # padded pixels
                    dn = digitise(v, scene.edges[k, p], clip=scene.clip).astype(np.int64)
                total[row, p] = dn.reshape(scene.n_draws, -1).sum(axis=0)
    return total


def _all_frames(
    scene: Scene, realisation: NDArray[np.uint64], frames: range, seed: int, exposure: int = 0
) -> tuple[NDArray[np.uint64], NDArray[np.int64], NDArray[np.float32]]:
    """Return realisation, frame and `factors` of each draw, frame by frame, since NumPy is fast for long arrays only.

    Shapes are (n_draw,), (n_draw,) and (3, n_draw).
    """
    changes = [
        factors(scene, realisation, frame if scene.frames else first, seed, exposure=exposure)
        for frame, first in ((frame, frame * scene.n_frames) for frame in frames)
    ]
    return np.tile(realisation, len(frames)), np.repeat(frames, len(realisation)), np.concatenate(changes, axis=1)


def clipped(scene: Scene, realisation: NDArray[np.uint64], seed: int) -> NDArray[np.int64]:
    """Count the frames in which each pixel of scenario 0 is below zero and above saturation.

    Returns
    -------
    ndarray of int64, shape (n_realisation, n_pixel, 2)
    """
    count = np.zeros((len(realisation), len(scene.pixels), 2), np.int64)
    if scene.clip:
        index, frames, changes = _all_frames(scene, realisation, range(scene.n_draws), seed)
        for group in range(-(-scene.n_pixel // 4)):
            drawn = draws(scene, index, frames, group, seed)
            for i, p in enumerate(range(4 * group, min(4 * group + 4, len(scene.pixels)))):
                r = (analogue(scene, drawn, i, p, 0, *changes) + MAGIC).reshape(scene.n_draws, -1)
                count[:, p, 0] = (r < scene.edges[0, p]["low"]).sum(axis=0)
                count[:, p, 1] = (r > scene.edges[0, p]["high"]).sum(axis=0)
    return count[:, : scene.n_pixel]


def realise(scene: Scene, realisation: NDArray[np.uint64], seed: int) -> NDArray[np.int64]:
    """Draw raw DN of scenario 0, summed over the frames, shape (n_realisation, n_pixel)."""
    above = observed(scene, realisation, seed, scenarios=[0])[0, : scene.n_pixel]
    raw: NDArray[np.int64] = (above + scene.n_draws * scene.base_dn[0][:, None]).T
    return raw
