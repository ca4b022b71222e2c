"""Draws in NumPy: slow reference of the kernels, losses of light by pointing drifts, and components of a draw.

The generator is addressed by counter: each word depends only on realisation, frame, stream, group of pixels and seed.
Counters, arithmetic and the order of sums are those of the kernels. Integers equal the device's, and so do floats on
devices with strict arithmetic, because each fused multiply-add is rounded once. Tests and the self-test use it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from mauvecl.host.arrays import Float
from mauvecl.noise import layout
from mauvecl.noise.disturbances import ADDITIVE, PointingDrifts
from mauvecl.noise.drawing import DrawingOptions
from mauvecl.noise.scene import Scene, prepare
from mauvecl.noise.unknowns import PROCESSES, SIGNAL_PARTS
from mauvecl.schema.columns import Column, table_of

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.exposure.expectation import Expectation

MAGIC = np.float32(layout.MAGIC)
#: A function that computes a * b + c.
Fma = Callable[[Any, Any, Any], Any]
T = TypeVar("T", np.uint32, np.float32)
Words = tuple[NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32], NDArray[np.uint32]]
Floats = NDArray[np.float32]

_MULTIPLIERS = (np.uint64(0xD2511F53), np.uint64(0xCD9E8D57))
_KEY_STEPS = (0x9E3779B9, 0xBB67AE85)
_POLYNOMIALS = {
    name: [np.float32(float.fromhex(c)) for c in coefficients] for name, coefficients in layout.POLYNOMIALS.items()
}
_TWO_LN2 = np.float32(float.fromhex(layout.TWO_LN2))


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


def words_at(
    realisation: ArrayLike, frame: ArrayLike, stream: str, group: ArrayLike, seed: int, exposure: int = 0
) -> Words:
    """Return the four words that four neighbouring pixels of a realisation and frame share in a stream.

    The number of the stream is the top byte of the counter's last word. The group is the pixel index divided by four,
    and the exposure 0 for the observed one and `layout.REFERENCE` for the reference.
    """
    index, half = np.asarray(realisation, dtype=np.uint64), np.uint64(32)
    last = np.uint64((exposure + layout.STREAMS[stream]) << 24) | np.asarray(group, dtype=np.uint64)
    return philox((index & np.uint64(0xFFFFFFFF), index >> half, np.asarray(frame, dtype=np.uint64), last), seed)


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
    *lower, highest = _POLYNOMIALS[name]
    result: Floats = np.full_like(x, highest)
    for coefficient in reversed(lower):
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


def alias_draw(
    word: NDArray[np.uint32], table: NDArray[np.uint32], bits: ArrayLike, start: ArrayLike = 0
) -> NDArray[np.uint32]:
    """Return the column for each word of the alias table that begins at `start`; see `layout.AliasTable`."""
    shift = np.uint32(layout.WORD_BITS) - np.asarray(bits, np.uint32)
    column = word >> shift
    entry = table[np.asarray(start, np.uint32) + column]
    mask = (np.uint32(1) << shift) - np.uint32(1)
    return np.where((word & mask) < (entry & mask), column, entry >> shift)


def nearest(x: Floats) -> Floats:
    """Round to the nearest integer, ties to even, for values below 2**22."""
    return np.asarray((x + MAGIC) - MAGIC)


def _per_pixel(four: Sequence[NDArray[T]]) -> NDArray[T]:
    """Arrange arrays for the first to fourth pixel of each group, (n_group, n_draw), by pixel, (n_pixel, n_draw)."""
    return np.stack(four, axis=1).reshape(-1, four[0].shape[-1])


def poisson_counts(four: Words, source: NDArray[np.void], tables: NDArray[np.uint32]) -> Floats:
    """Return the counts of all pixels, relative to their rounded means, shape (n_pixel, n_draw)."""
    source = source[:, None]
    # Large means use an expansion in normals, in which both pixels of a pair use both words.
    z = _per_pixel(four_normals(four))
    curve = fma(z, source["cubic"], np.float32(0.16666667))
    counts = nearest(fma(z, fma(z, curve, source["slope"]), source["offset"]))
    by_table = source["bits"][:, 0] > 0
    words, row = _per_pixel(four)[by_table], source[by_table]
    counts[by_table] = alias_draw(words, tables, row["bits"], row["table"]).astype(np.int32) + row["low"]
    return counts


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of all pixels, padding included; arrays have the shape (n_pixel, n_draw)."""

    z: NDArray[np.floating]  # without padding if it is all that a draw needs
    dark: Floats | None = None
    photon: Words | None = None
    added: dict[str, Floats] = field(default_factory=dict)  # electrons of additive processes


def draws(scene: Scene, realisation: NDArray[np.uint64], frame: ArrayLike, seed: int, *, exposure: int = 0) -> Draws:
    """Draw everything that a frame needs; `frame` is one number, or one for each realisation."""
    job, groups = scene.job, np.arange(len(scene.pixels) // 4)[:, None]
    frame = int(job["first_frame"]) + np.asarray(frame)

    def drawn(stream: str) -> Words:
        return words_at(realisation, frame, stream, int(job["first_group"]) + groups, seed, exposure)

    added = {}
    for name in scene.additive:
        column = alias_draw(_per_pixel(drawn(name)), scene.tables, job[f"{name}_bits"], job[f"{name}_table"])
        added[name] = (column.astype(np.int32) + job[f"{name}_low"]).astype(np.float32)
    return Draws(
        _per_pixel(four_normals(drawn("noise"))),
        None if scene.joint else poisson_counts(drawn("dark"), scene.dark_counts, scene.tables),
        drawn("photon") if scene.photons else None,
        added,
    )


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


def combine_factors(a: Floats, b: Floats, fma: Fma = fma) -> Floats:
    """Return the product of two factors, all minus one."""
    return np.asarray(fma(a, b, a + b))


def factors(
    scene: Scene, realisation: NDArray[np.uint64], frame: int, seed: int, *, exposure: int = 0
) -> tuple[Floats, Floats, Floats]:
    """Draw factors on light, dark and sky, relative to the priors' medians and minus one, shape (n_realisation,)."""
    factor_of = {factor: np.zeros(len(realisation), np.float32) for factor in SIGNAL_PARTS}
    constant = np.zeros(len(realisation), np.float32)
    first = int(scene.job["first_frame"]) + frame
    for (name, factor), table in zip(scene.modulations, scene.priors, strict=True):
        if PROCESSES[name].when != "frame":
            words = words_at(realisation, 0, name, 0, seed)
            factor_of[factor] = combine_factors(factor_of[factor], quantile(words[0], words[1], table))
            continue
        for f in range(first, first + (1 if scene.frames else scene.n_frames)):
            words = words_at(realisation, f // 4, name, 0, seed, exposure)
            constant = constant + quantile(words[f % 4], words[(f + 1) % 4], table)
        if not scene.frames:
            constant = constant * (np.float32(1.0) / np.float32(scene.n_frames))
    return combine_factors(factor_of["light"], constant), factor_of["dark"], factor_of["sky"]


def analogue(
    scene: Scene, drawn: Draws, k: int, light: NDArray[Any], dark: NDArray[Any], sky: NDArray[Any], fma: Fma = fma
) -> Floats:
    """Return the analogue counts of a scenario above the levels' bases, before the ADC, shape (n_pixel, n_draw).

    Factors have the shape (n_draw,). Another `fma` computes in the precision of `drawn`, without the device's bits.
    """
    z, n_pixel = drawn.z, len(drawn.z)
    level = scene.levels[k, :n_pixel, None]
    if scene.modulations:
        response = scene.responses[k, :n_pixel, None]
        if any(factor == "sky" for _, factor in scene.modulations):
            light = combine_factors(light, sky * response["sky_share"], fma)
        v = _responding(response, level["c0"], z, light, dark, fma, quartic=scene.quartic)
    elif scene.joint:
        v = np.broadcast_to(level["c4" if scene.quartic else "c3"], z.shape)
        for name in ("c3", "c2", "c1", "c0") if scene.quartic else ("c2", "c1", "c0"):
            v = fma(z, v, level[name])
    else:
        assert drawn.dark is not None
        v = fma(drawn.dark, scene.dark_counts["gain"][:, None], fma(z, level["c1"], level["c0"]))
    if drawn.photon is not None:
        source = scene.photon_counts[k]
        v = fma(poisson_counts(drawn.photon, source, scene.tables), source["gain"][:, None], v)
    for electrons in drawn.added.values():
        v = fma(electrons, scene.pixels["electron_gain"][:, None], v)
    return v


def _responding(
    r: NDArray[np.void], c0: Floats, z: Floats, light_change: Floats, dark_change: Floats, fma: Fma, *, quartic: bool
) -> Floats:
    """Return a joint draw from normals z that responds to factors on light and dark, as `polynomial` without them."""
    unity = np.float32(1.0)
    light, dark = light_change + unity, dark_change + unity
    variance = fma(light, r["light_variance"], fma(dark, r["dark_variance"], r["other_variance"]))
    third = fma(light, r["light_third"], dark * r["dark_third"])
    fourth = fma(light, r["light_fourth"], dark * r["dark_fourth"])
    sd, skew, zz = np.sqrt(variance), third / variance, z * z
    curve = fourth * fma(zz, np.float32(0.041666668), np.float32(-0.125))
    curve = curve - third * skew * fma(zz, np.float32(0.055555556), np.float32(-0.1388889))
    cubic = curve / (variance * sd)
    v = fma(z, sd + cubic, fma(skew, fma(zz, np.float32(0.16666667), np.float32(-0.16666667)), c0))
    if quartic:
        fifth = fma(light, r["light_fifth"], dark * r["dark_fifth"])
        even = fifth * even_powers(zz, 0.008333334, -0.05, 0.025, fma)
        even = even - skew * fourth * even_powers(zz, 0.041666668, -0.20833333, 0.083333336, fma)
        even = even + skew * skew * third * even_powers(zz, 0.037037037, -0.16358025, 0.052469134, fma)
        v = v + even / (variance * variance)
    return np.asarray(v + fma(light_change, r["light"], dark_change * r["dark"]))


def even_powers(zz: Floats, second: float, first: float, constant: float, fma: Fma = fma) -> Floats:
    """Return a polynomial of the square of a normal."""
    return np.asarray(fma(zz, fma(zz, np.float32(second), np.float32(first)), np.float32(constant)))


def digitise(v: Floats, edge: np.void | NDArray[np.void], *, clip: bool) -> Floats:
    """Round and clip to DN above the level's base."""
    r = v + MAGIC
    if clip:
        r = np.where(r < edge["low"], edge["low"], r)
        r = np.where(r > edge["high"], edge["high"], r)
    return np.asarray(r - MAGIC)


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


def realise(scene: Scene, realisation: NDArray[np.uint64], seed: int) -> NDArray[np.int64]:
    """Draw raw DN of scenario 0, summed over the frames, shape (n_realisation, n_pixel)."""
    index, frames, changes = _all_frames(scene, realisation, range(scene.n_draws), seed)
    v = analogue(scene, draws(scene, index, frames, seed), 0, *changes)[: scene.n_pixel]
    dn = digitise(v, scene.edges[0, : scene.n_pixel, None], clip=scene.clip).astype(np.int64)
    dn += scene.base_dn[0][:, None]
    raw: NDArray[np.int64] = dn.reshape(scene.n_pixel, scene.n_draws, -1).sum(axis=1).T
    return raw


#: Drifts that are drawn at a time, per stare.
DRIFTS_AT_ONCE = 16


def pointing_drifts(
    process: PointingDrifts, numbers: NDArray[np.uint64], end_s: float, seed: int
) -> tuple[Float, Float, Float]:
    """Draw start, duration and depth of the drifts of stares up to a time, shape (n_stare, n_drift) each.

    Drifts are in order of time, and the last one of each stare begins at `end_s` or later.
    """
    parts: list[tuple[Float, Float, Float]] = []
    begin = np.zeros((len(numbers), 1))
    index, n, stream = np.asarray(numbers, np.uint64)[:, None], 0, "stare_pointing"
    while not parts or not (parts[-1][0][:, -1] >= end_s).all():
        drift = np.arange(n, n + DRIFTS_AT_ONCE)[None]
        # Half the sum of two squared normals is exponential, and has the same bits on every machine.
        a, b, c, d = (z.astype(np.float64) for z in four_normals(words_at(index, drift, stream, 0, seed)))
        wait, lasts = (a * a + b * b) / 2 * (3600.0 / process.rate_per_h), (c * c + d * d) / 2 * process.duration_s
        share = (words_at(index, drift, stream, 1, seed)[0].astype(np.float64) + 0.5) / 2**32
        ends = begin + np.cumsum(wait + lasts, axis=1)
        parts.append((ends - lasts, lasts, share * process.depth))
        begin, n = ends[:, -1:], n + DRIFTS_AT_ONCE
    start, lasts, depth = (np.concatenate(several, axis=1) for several in zip(*parts, strict=True))
    return start, lasts, depth


def pointing_losses(
    process: PointingDrifts, numbers: NDArray[np.uint64], start_s: Float, frame_s: float, seed: int
) -> Float:
    """Draw the mean share of the light that each frame loses, shape (n_stare, n_frame).

    Frames start at `start_s` after the start of the stare.
    """
    drifts = pointing_drifts(process, numbers, float(start_s[-1]) + frame_s, seed)
    ends, lost = np.array([start_s, start_s + frame_s]), np.empty((len(numbers), start_s.size))
    for row, (start, lasts, depth) in enumerate(zip(*drifts, strict=True)):
        # The integral of the lost share of the light up to both ends of each frame, s.
        before = np.cumsum(depth * lasts / 2) - depth * lasts / 2
        k = np.searchsorted(start, ends, side="right") - 1
        since = np.clip(ends - start[k], 0.0, lasts[k])
        until = before[k] + depth[k] * since * (since / np.maximum(lasts[k], 1e-300)) / 2
        lost[row] = np.diff(np.where(k < 0, 0.0, until), axis=0)[0]
    return np.clip(lost / frame_s, 0.0, 1.0)


#: Frames that are drawn together.
FRAMES_AT_ONCE = 256


def components(x: Expectation, *, realisation: int, seed: int, **drawing: Unpack[DrawingOptions]) -> QTable:
    """Decompose one raw spectrum into the draws of its components, with the NumPy reference.

    The table has one row per pixel, in DN summed over the exposure: ``raw``, as drawn by the engine; the mean signals
    ``source``, ``sky`` and, if there are any, ``neighbours``; ``photon_noise`` and ``read_noise``; ``dark``; the charge
    of each enabled additive process by its name; ``bias``; and ``digitisation``, the effect of rounding and clipping.
    ``raw`` is the sum of the others. Keywords are those of `Drawing`.

    Notes
    -----
    The kernels draw the noise as one sum. Its components are drawn here from their conditional distribution given that
    sum, from separate streams, so that the decomposition does not affect the spectrum. The conditional distribution of
    the dark counts is Poisson times Gaussian. Only in this decomposition, Poisson photons are treated as Gaussian.
    """
    scene = prepare([x], **drawing)
    parts: dict[str, Float] = {}
    for start in range(0, scene.n_draws, FRAMES_AT_ONCE):
        frames = range(start, min(start + FRAMES_AT_ONCE, scene.n_draws))
        for name, part in _split(x, scene, realisation, frames, seed).items():
            parts[name] = parts.get(name, 0.0) + part.sum(axis=1)
    raw = parts.pop("recorded") + scene.n_draws * scene.base_dn[0]
    parts["bias"] = np.asarray(x.n_frames * x.bias_dn)
    values = {"wavelength": x.wavelength_nm, "raw": raw} | parts
    values["digitisation"] = raw - sum(parts.values())
    if not x.neighbour_electrons.any():
        del values["neighbours"]
    values["net"] = raw - x.n_frames * (x.bias_dn + x.dark_dn) - x.subtracted_dn
    columns = [column for column in COLUMNS if column.name in values]
    metadata = {"signal": x.signal, "name": x.name, "exposure_s": x.exposure_s, "frames": x.n_frames, "seed": seed}
    return table_of(columns, [values], **metadata)


def _split(
    x: Expectation, scene: Scene, realisation: int, drawn_frames: range, seed: int
) -> dict[str, NDArray[np.floating]]:
    """Return what each draw records above the base, and its components, DN; arrays have the shape (n_pixel, n_draw)."""
    index, frames, changes = _all_frames(scene, np.array([realisation], np.uint64), drawn_frames, seed)
    light, warm, glow = (
        (1.0 + change.astype(np.float64)) * middle for change, middle in zip(changes, scene.medians, strict=True)
    )
    drawn, n, frames_per_draw = draws(scene, index, frames, seed), scene.n_pixel, x.n_frames // scene.n_draws
    v = analogue(scene, drawn, 0, *changes)
    gain, step = x.gain_dn_per_electron[:, None], x.dark_step_dn[:, None]
    source = frames_per_draw * light * gain * x.source_electrons[:, None]
    sky = frames_per_draw * light * glow * gain * x.sky_electrons[:, None]
    neighbours = frames_per_draw * light * gain * x.neighbour_electrons[:, None]
    photon_variance = gain * (source + sky + neighbours)
    read_variance = frames_per_draw * x.read_noise_dn[:, None] ** 2 + (frames_per_draw - 1) / 12
    mean_dark = frames_per_draw * warm * x.dark_dn[:, None]
    added = {name: (scene.pixels["electron_gain"][:, None] * charge)[:n] for name, charge in drawn.added.items()}
    # All random parts: photon noise + read noise + dark counts.
    total = scene.base_dn[0][:, None] + v[:n].astype(np.float64) - sum(added.values())
    total = total - source - sky - neighbours - frames_per_draw * x.bias_dn[:, None]
    groups = np.arange(len(scene.pixels) // 4)[:, None]
    if drawn.dark is None:
        chance = _per_pixel(words_at(index, frames, "split_dark", groups, seed))[:n].astype(np.float64) + 0.5
        dark = _dark_given_total(total, mean_dark, x.dark_step_dn, photon_variance + read_variance, chance / 2**32)
    else:
        dark = step * np.rint(mean_dark / step) + (scene.dark_counts["gain"][:, None] * drawn.dark)[:n]
    if drawn.photon is not None:
        counted = poisson_counts(drawn.photon, scene.photon_counts[0], scene.tables)[:n]
        photon = gain * (np.rint(frames_per_draw * x.light_electrons[:, None]) + counted) - source - sky - neighbours
    else:
        variance = photon_variance + read_variance
        share = np.divide(photon_variance, variance, out=np.zeros_like(variance), where=variance > 0)
        score = _per_pixel(four_normals(words_at(index, frames, "split", groups, seed)))[:n]
        photon = (total - dark) * share + np.sqrt(read_variance * share) * score
    parts = {"source": source, "sky": sky, "neighbours": neighbours, "photon_noise": photon, "dark": dark}
    parts |= {"read_noise": total - dark - photon, **added}
    return parts | {"recorded": digitise(v, scene.edges[0, :, None], clip=scene.clip)[:n]}


def _dark_given_total(total: Float, mean: Float, step: Float, variance: Float, chance: Float) -> Float:
    """Draw dark counts, DN, given their sum with a Gaussian of this variance, by inversion at `chance`.

    All arrays have the shape (n_pixel, n_draw) but `step`, which has the shape (n_pixel,).
    """
    dark = np.where((mean > 0) & (variance == 0), total, 0.0)
    for p in np.flatnonzero(mean.any(axis=1)):
        drawn = (mean[p] > 0) & (variance[p] > 0)
        if not drawn.any():
            continue
        expected = mean[p, drawn, None] / step[p]
        # This range covers both the prior and the likelihood.
        reach = 9.0 * np.sqrt(expected) + 9.0
        counts = np.arange(max(int((expected - reach).min()), 0), int((expected + reach).max()) + 1)
        log = special.xlogy(counts, expected) - special.gammaln(counts + 1.0)
        log -= (total[p, drawn, None] - step[p] * counts) ** 2 / (2.0 * variance[p, drawn, None])
        below = np.cumsum(np.exp(log - log.max(axis=1, keepdims=True)), axis=1)
        dark[p, drawn] = step[p] * counts[(below < chance[p, drawn, None] * below[:, -1:]).sum(axis=1)]
    return dark


COLUMNS = (
    Column("wavelength", unit="nm", description="vacuum wavelength, the middle of the pixel or element"),
    *(
        Column(name, unit="adu", description=text)
        for name, text in {
            "raw": "simulated raw spectrum, summed over the frames (DN)",
            "source": "mean signal of the star",
            "sky": "mean signal of the zodiacal light",
            "neighbours": "mean signal of neighbours in the fibre, which net does not contain",
            "photon_noise": "drawn photon noise of star and sky",
            "dark": "drawn dark counts",
            "read_noise": "drawn read noise",
            **{name: f"drawn charge of {process.label}" for name, process in ADDITIVE.items()},
            "bias": "bias",
            "digitisation": "what rounding and clipping changed",
            "net": "raw less bias, mean dark and, where the signal is the star's alone, mean sky",
        }.items()
    ),
)
