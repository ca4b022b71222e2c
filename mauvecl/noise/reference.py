"""Slow NumPy reference of the kernels' draws, and the components of a draw.

Counters, arithmetic and the order of sums are those of the kernels. Integers equal the device's, and so do floats on
devices with strict arithmetic, because each fused multiply-add is rounded once. Tests and the self-test use it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from mauvecl.noise import layout, random_numbers
from mauvecl.noise.disturbances import ADDITIVE
from mauvecl.noise.drawing import DrawingOptions
from mauvecl.noise.random_numbers import Floats, Words, fma, four_normals, words
from mauvecl.noise.scene import Scene, prepare
from mauvecl.noise.unknowns import PROCESSES, SIGNAL_PARTS
from mauvecl.schema.columns import Column, table_of

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.exposure.expectation import Expectation

MAGIC = np.float32(layout.MAGIC)


def words_at(
    realisation: ArrayLike, frame: ArrayLike, stream: str, group: ArrayLike, seed: int, exposure: int = 0
) -> Words:
    """Return the four words that four neighbouring pixels of a realisation and frame share in a stream.

    The stream is a key of `layout.STREAMS`, the group is the pixel index divided by four, and the exposure is 0 for the
    observed one and `layout.REFERENCE` for the reference.
    """
    return words(realisation, frame, exposure + layout.STREAMS[stream], group, seed)


def alias_draw(word: NDArray[np.uint32], table: NDArray[np.uint32], bits: int) -> NDArray[np.uint32]:
    """Return the alias table's column for each word; see `layout.AliasTable`."""
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
    """Sum the DN above the base over the draws of exposure `number`, (n_scenario, n_padded, n_realisation)."""
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
    """Count the frames below zero and above saturation of scenario 0, shape (n_realisation, n_pixel, 2)."""
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


Float = NDArray[np.float64]

#: Frames that are drawn together.
FRAMES_AT_ONCE = 256


def components(
    x: Expectation,
    *,
    realisation: int,
    seed: int,
    **drawing: Unpack[DrawingOptions],
) -> QTable:
    """Decompose one raw spectrum into the draws of its components, with the NumPy reference.

    Parameters
    ----------
    mode, recipe, processes, first_frame
        See `Drawing`.

    Returns
    -------
    QTable
        One row per pixel, in DN summed over the exposure: ``raw``, as drawn by the engine; the mean signals ``source``,
        ``sky`` and, if there are any, ``neighbours``; ``photon_noise`` and ``read_noise``; ``dark``; the charge of each
        enabled additive process by its name; ``bias``; and ``digitisation``, the effect of rounding and clipping.
        ``raw`` is the sum of the others.

    Notes
    -----
    The kernels draw the noise as one sum. Its components are drawn here from their conditional distribution given that
    sum, from separate streams, so that the decomposition does not affect the spectrum. The conditional distribution of
    the dark counts is Poisson times Gaussian. Only in this decomposition, Poisson photons are treated as Gaussian.
    """
    scene = prepare([x], **drawing)
    names = ["source", "sky", "neighbours", "photon_noise", "dark", "read_noise", *scene.additive]
    parts = {name: np.zeros(scene.n_pixel) for name in names}
    raw = np.zeros(scene.n_pixel)
    for start in range(0, scene.n_draws, FRAMES_AT_ONCE):
        frames = range(start, min(start + FRAMES_AT_ONCE, scene.n_draws))
        one = _Parts(x, scene, realisation, frames, seed)
        for name, part in zip(names, one.all(), strict=True):
            parts[name] += part.sum(axis=1)
        raw += len(frames) * scene.base_dn[0] + one.recorded.sum(axis=1)
    parts["bias"] = np.asarray(x.n_frames * x.bias_dn)
    values = {"wavelength": x.wavelength_nm, "raw": raw} | parts
    values["digitisation"] = raw - sum(parts.values())
    if not x.neighbour_electrons.any():
        del values["neighbours"]
    values["net"] = raw - x.n_frames * (x.bias_dn + x.dark_dn) - x.subtracted_dn
    columns = [column for column in COLUMNS if column.name in values]
    about = {"signal": x.signal, "name": x.name, "exposure_s": x.exposure_s, "frames": x.n_frames, "seed": seed}
    return table_of(columns, [values], **about)


class _Parts:
    """Draws of several frames, or of the sum of all frames, in DN; arrays have the shape (n_pixel, n_draw)."""

    def __init__(self, x: Expectation, scene: Scene, realisation: int, drawn_frames: range, seed: int) -> None:
        self.x, self.scene = x, scene
        self.each = x.n_frames // scene.n_draws  # frames in one draw
        index, frames, changes = _all_frames(scene, np.array([realisation], np.uint64), drawn_frames, seed)
        self.light, self.warm, self.glow = (
            (1.0 + change.astype(np.float64)) * middle for change, middle in zip(changes, scene.medians, strict=True)
        )
        shape = len(scene.pixels), frames.size
        undigitised, self.recorded, dark, photon = np.zeros((4, *shape))
        added = {name: np.zeros(shape) for name in scene.additive}
        groups = np.arange(len(scene.pixels) // 4)[:, None]
        words = np.stack(words_at(index, frames, "split_dark", groups, seed), axis=1)
        scores = random_numbers.four_normals(words_at(index, frames, "split", groups, seed))
        for group in range(groups.size):
            drawn = draws(scene, index, frames, group, seed)
            for i, p in enumerate(range(4 * group, 4 * group + 4)):
                v = analogue(scene, drawn, i, p, 0, *changes)
                undigitised[p], self.recorded[p] = v, digitise(v, scene.edges[0, p], clip=scene.clip)
                for name, charge in drawn.added.items():
                    added[name][p] = scene.pixels[p]["electron_gain"] * charge[i]
                if not scene.joint:
                    dark[p] = scene.dark_counts[p]["gain"] * drawn.dark[i]
                if drawn.photon is not None:
                    source = scene.photon_counts[0, p]
                    normals = random_numbers.four_normals(drawn.photon)
                    electrons = poisson_draw(drawn.photon, i, source, scene.tables, normals)
                    photon[p] = source["gain"] * electrons
        n = scene.n_pixel
        self.recorded = self.recorded[:n]
        self.score = np.stack(scores, axis=1).reshape(shape)[:n]
        self.chance = (words.reshape(shape)[:n].astype(np.float64) + 0.5) / 2**32
        self.added = {name: charge[:n] for name, charge in added.items()}
        self.counted_dark, self.counted_photons = dark[:n], photon[:n]
        self.level = scene.base_dn[0][:, None] + undigitised[:n]

    def all(self) -> list[Float]:
        """Return source, sky, neighbours, photon noise, dark, read noise and the charges of additive processes."""
        x, scene, each = self.x, self.scene, self.each
        gain, step = x.gain_dn_per_electron[:, None], x.dark_step_dn[:, None]
        source = each * self.light * gain * x.source_electrons[:, None]
        sky = each * self.light * self.glow * gain * x.sky_electrons[:, None]
        neighbours = each * self.light * gain * x.neighbour_electrons[:, None]
        photon_variance = gain * (source + sky + neighbours)
        read_variance = each * x.read_noise_dn[:, None] ** 2 + (each - 1) / 12
        mean_dark = each * self.warm * x.dark_dn[:, None]
        # All random parts: photon noise + read noise + dark counts.
        total = self.level - sum(self.added.values())
        total = total - source - sky - neighbours - each * x.bias_dn[:, None]
        if scene.joint:
            dark = _dark_given_total(total, mean_dark, x.dark_step_dn, photon_variance + read_variance, self.chance)
        else:
            dark = step * np.rint(mean_dark / step) + self.counted_dark
        rest = total - dark
        if scene.photons:
            mean = gain * np.rint(each * x.light_electrons[:, None])
            photon = mean + self.counted_photons - source - sky - neighbours
        else:
            both = photon_variance + read_variance
            share = np.divide(photon_variance, both, out=np.zeros_like(both), where=both > 0)
            photon = rest * share + np.sqrt(read_variance * share) * self.score
        return [source, sky, neighbours, photon, dark, rest - photon, *self.added.values()]


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


#: Columns of the table of components.
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
