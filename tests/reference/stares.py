"""NumPy reference implementation of the stare kernels, with the same counters, arithmetic and order of summation."""

import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from mauvecl.flares import stare_scene
from mauvecl.noise import layout, reference, unknowns

Flares, StareScene, SumTable = stare_scene.Flares, stare_scene.StareScene, stare_scene.SumTable
fma = reference.fma


def exponential_less_one(x: np.ndarray) -> np.ndarray:
    """Return exp(x) - 1 for |x| < 80."""
    whole = x * np.float32(layout.LOG2_E) + reference.MAGIC
    n = whole - reference.MAGIC
    r = fma(n, np.float32(-layout.LN2_PARTS[1]), fma(n, np.float32(-layout.LN2_PARTS[0]), x))
    *rest, last = (np.float32(c) for c in layout.EXPONENTIAL)
    q = np.full_like(x, last)
    for term in reversed(rest):
        q = fma(q, r, term)
    scale = ((whole.view(np.int32) - reference.MAGIC.view(np.int32) + np.int32(127)) << 23).view(np.float32)
    return fma(scale, fma(r * r, q, r), scale - np.float32(1.0))


def strengths(scene: StareScene, numbers: np.ndarray, frame: int, seed: int, lost: np.ndarray) -> dict[str, np.ndarray]:
    """Draw steady components' coefficients and the factor on light in a frame, minus one, float32 (n_stare,) each."""
    moved = {str(name): np.zeros(len(numbers), np.float32) for name in unknowns.CHANGING}
    stare = scene.stare
    jitters = np.float32([stare.light_jitter, stare.sky_jitter, stare.temperature_jitter_c])
    if jitters.any():
        drawn = reference.four_normals(reference.words_at(numbers, int(scene.numbers[frame]), "stare_frame", 0, seed))
        for name, z, jitter in zip(("light", "sky", "temperature"), drawn, jitters, strict=False):
            moved[name] = z * jitter
    for u, kind in enumerate(scene.kinds):
        name = unknowns.CHANGING[kind]
        z = reference.four_normals(reference.words_at(numbers, 0, "stare_unknown", u // 4, seed))[u % 4]
        moved[name] = fma(z, scene.curves[u, frame], moved[name])
    star, star_less_one, sky, sky_less_one, dark, dark_less_one, near, near_less_one, _ = scene.known[:, frame]
    dark_slope = np.float32(scene.components.quiet.conditions["dark_slope_per_c"])
    light = moved["light"]
    if stare.pointing is not None:
        light = reference.combine_factors(light, -lost[:, frame])
    return {
        "star": fma(star, reference.combine_factors(light, moved["star"]), star_less_one),
        "sky": fma(sky, reference.combine_factors(light, moved["sky"]), sky_less_one),
        "dark": fma(dark, exponential_less_one(moved["temperature"] * dark_slope), dark_less_one),
        "neighbours": fma(near, light, near_less_one),
        "light": light,
    }


def glow(scene: StareScene, numbers: np.ndarray, frames: Iterable[int], seed: int) -> np.ndarray:
    """Draw a normal per statistic, and the factor on light minus one, float32 (n_stare, n_frame, n_statistic + 1)."""
    out, lost = [], scene.losses(numbers, seed)
    for frame in frames:
        z = _normals(scene, numbers, frame, "stare_glow", seed)
        out.append([*z[: len(scene.weights)], strengths(scene, numbers, frame, seed, lost)["light"]])
    return np.moveaxis(np.array(out), (0, 1, 2), (1, 2, 0))


def _normals(scene: StareScene, numbers: np.ndarray, frame: int, stream: str, seed: int) -> list[np.ndarray]:
    """Draw a normal per statistic, rounded up to groups of four, shape (n_stare,) each."""
    groups = range(-(-len(scene.weights) // 4))
    words = [reference.words_at(numbers, int(scene.numbers[frame]), stream, group, seed) for group in groups]
    return [z for each in words for z in reference.four_normals(each)]


def _conditions(
    scene: StareScene, flares: Flares, numbers: np.ndarray, frames: Iterable[int], seed: int
) -> Iterator[tuple[int, dict[str, np.ndarray], list[list[np.ndarray]]]]:
    """Yield each frame with its coefficients of steady components, and of the flares of each scenario."""
    lost = scene.losses(numbers, seed)
    for frame in frames:
        steady, of_flares = strengths(scene, numbers, frame, seed, lost), []
        light = steady["light"]
        for amplitudes in flares.amplitudes:
            given = flares.rows[:, :, frame] * (scene.known[-1, frame] * amplitudes[:, None])
            every = np.broadcast_to(given, (len(light), given.shape[1])).T
            of_flares.append([fma(light, flare, flare) for flare in every])
        yield frame, steady, of_flares


def pixels(scene: StareScene, flares: Flares, numbers: np.ndarray, frames: Iterable[int], seed: int) -> np.ndarray:
    """Draw statistics by the method "pixels", float32 (n_scenario, n_stare, n_frame, n_statistic)."""
    out = []
    for frame, steady, of_flares in _conditions(scene, flares, numbers, frames, seed):
        drawn = reference.draws(scene.scene, numbers, int(scene.numbers[frame]), seed)
        sums = np.zeros((4, len(of_flares), len(scene.weights), len(numbers)), np.float32)
        for k, flare in enumerate(of_flares):
            v = _counts(scene, drawn.z, steady, flare)
            for electrons in drawn.added.values():
                v = fma(electrons, scene.scene.pixels["electron_gain"][:, None], v)
            x = reference.digitise(v, scene.scene.edges[0, :, None], clip=scene.scene.clip)
            for p, weights in enumerate(scene.weights.T):
                sums[p % 4, k] = fma(x[p], weights[:, None], sums[p % 4, k])
        a, b, c, d = sums
        out.append(((a + b) + (c + d)) + scene.constants[:, None])
    return np.moveaxis(np.array(out), (0, 1, 2, 3), (2, 0, 3, 1))


def _counts(scene: StareScene, z: np.ndarray, conditions: dict[str, np.ndarray], flare: list[np.ndarray]) -> np.ndarray:
    """Return the counts of all pixels above their bases, before the ADC, shape (n_pixel, n_stare)."""
    m, one = scene.mixtures[:, None], np.float32(1.0)
    light, dark = fma(conditions["star"], m["star"], conditions["sky"] * m["sky"]), conditions["dark"]
    light = fma(conditions["neighbours"], m["neighbours"], light)
    for coefficient, spectrum in zip(flare, scene.spectra, strict=True):
        light = fma(coefficient, spectrum[:, None], light)
    variance = fma(light, m["photon_variance"], fma(dark, m["dark_variance"], m["variance"]))
    third, fourth, fifth = (fma(dark, m[f"dark_{name}"], m[name]) for name in ("third", "fourth", "fifth"))
    if scene.counts:
        third = fma(light, m["photon_third"], third)
        fourth = fma(light, m["photon_fourth"], fourth)
        fifth = fma(light, m["photon_fifth"], fifth)
    zz, sd, each = z * z, np.sqrt(variance), one / variance
    skew = third * each
    curve = fourth * fma(zz, np.float32(0.041666668), np.float32(-0.125))
    curve = curve - third * skew * fma(zz, np.float32(0.055555556), np.float32(-0.1388889))
    even = fifth * reference.even_powers(zz, 0.008333334, -0.05, 0.025)
    even = even - skew * fourth * reference.even_powers(zz, 0.041666668, -0.20833333, 0.083333336)
    even = even + skew * skew * third * reference.even_powers(zz, 0.037037037, -0.16358025, 0.052469134)
    straight = fma(curve * each, sd * each, sd)
    v = fma(z, straight, fma(skew, fma(zz, np.float32(0.16666667), np.float32(-0.16666667)), m["rest"]))
    return np.asarray(fma(even * each, each, v) + fma(dark, m["dark"], light))


def sums(scene: StareScene, flares: Flares, numbers: np.ndarray, frames: Iterable[int], seed: int) -> np.ndarray:
    """Draw statistics by the method "cumulants", float32 (n_scenario, n_stare, n_frame, n_statistic)."""
    table, out = SumTable.of(scene.components), []
    for frame, steady, of_flares in _conditions(scene, flares, numbers, frames, seed):
        z = _normals(scene, numbers, frame, "stare_sums", seed)
        out.append([_sums(scene, table, z, steady, flare) for flare in of_flares])
    return np.moveaxis(np.array(out), (0, 1, 2, 3), (2, 0, 3, 1))


def _chain(terms: Iterable[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    (a, b), *rest = terms
    total = np.asarray(a * b)
    for a, b in rest:
        total = fma(a, b, total)
    return total


def _sums(scene: StareScene, table: SumTable, z: Any, conditions: Any, flare: list[np.ndarray]) -> list[np.ndarray]:
    n = len(scene.weights)
    pairs = stare_scene.unique(n, 2)
    place = {key: i for i, key in enumerate(key for order in (1, 2, 3, 4) for key in stare_scene.unique(n, order))}
    lit = [(conditions["star"], 1), (conditions["sky"], 2), (conditions["neighbours"], 4)]
    lit += [(f, 5 + j) for j, f in enumerate(flare)]

    def cumulant(key: tuple[int, ...], light: bool = True) -> np.ndarray:
        total = np.full_like(z[0], table.rows[0, place[key]])
        for strength, row in [(conditions["dark"], 3), *(lit if light else [])]:
            total = fma(strength, table.rows[row, place[key]], total)
        return total

    def of(tensor: dict[tuple[int, ...], np.ndarray], *key: int) -> np.ndarray:
        return tensor[tuple(sorted(key, reverse=True))]

    c = {key: cumulant(key) for key in pairs}
    low: dict[tuple[int, int], np.ndarray] = {}
    m: dict[tuple[int, int], np.ndarray] = {}
    for b in range(n):
        for a in range(b, n):
            left = c[a, b]
            for i in range(b):
                left = fma(-low[a, i], low[b, i], left)
            if a == b:
                low[b, b] = np.sqrt(left)
                m[b, b] = np.float32(1.0) / low[b, b]
            else:
                low[a, b] = left * m[b, b]
    for a in range(n):
        for b in range(a):
            m[a, b] = -_chain((low[a, i], m[i, b]) for i in range(b, a)) * m[a, a]
    third = {key: cumulant(key, scene.counts) for key in stare_scene.unique(n, 3)}
    first = {(a, *key): _chain((m[a, i], of(third, i, *key)) for i in range(a + 1)) for a in range(n) for key in pairs}
    second = {
        (a, b, c): _chain((m[b, i], first[a, *sorted((i, c), reverse=True)]) for i in range(b + 1))
        for a, b in pairs
        for c in range(n)
    }
    skew: dict[tuple[int, ...], np.ndarray] = {
        (a, b, c): _chain((m[c, i], second[a, b, i]) for i in range(c + 1)) for a, b, c in stare_scene.unique(n, 3)
    }
    x = []
    for a in range(n):
        total = z[a]
        for b, d in pairs:
            q = z[b] * z[d] * np.float32(0.33333334)
            if b == d:
                q = fma(z[b], z[b], np.float32(-1.0)) * np.float32(0.16666667)
            total = fma(of(skew, a, b, d), q, total)
        if table.fourths:
            f = np.zeros_like(z[a])
            for key in itertools.combinations_with_replacement(range(a, -1, -1), 4):
                product = m[a, key[0]]
                for i in key[1:]:
                    product = product * m[a, i]
                f = fma(product, cumulant(key, scene.counts), f)
            zz, s = z[a] * z[a], skew[a, a, a]
            total = fma(f * z[a], fma(zz, np.float32(0.041666668), np.float32(-0.125)), total)
            total = fma(-s * s * z[a], fma(zz, np.float32(0.055555556), np.float32(-0.1388889)), total)
        x.append(total)
    u = [cumulant((a,)) + _chain((low[a, i], x[i]) for i in range(a + 1)) for a in range(n)]
    whole = dict(zip(pairs, table.lower, strict=True))
    return [_chain((whole[a, i], u[i]) for i in range(a + 1)) for a in range(n)]
