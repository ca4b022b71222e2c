"""NumPy reference of the kernels for statistics, S/N histograms and tallies, in the device's order of summation."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mauvecl.detection import requests, snr
from mauvecl.noise import layout, reference

fma = reference.fma


def observed(
    scene: Any, realisation: np.ndarray, seed: int, *, exposure: int = 0, number: int = 0,
    scenarios: Sequence[int] | None = None,
) -> np.ndarray:  # fmt: skip
    """Sum the DN above the base over the draws of exposure `number`, (n_scenario, n_padded, n_realisation)."""
    drawn_frames = range(number * scene.n_draws, (number + 1) * scene.n_draws)
    index, frames, changes = reference._all_frames(scene, realisation, drawn_frames, seed, exposure)
    drawn = reference.draws(scene, index, frames, seed, exposure=exposure)
    sums = []
    for k in range(len(scene.levels)) if scenarios is None else scenarios:
        analogue = reference.analogue(scene, drawn, k, *changes)
        dn = reference.digitise(analogue, scene.edges[k, :, None], clip=scene.clip)
        sums.append(dn.astype(np.int64).reshape(len(dn), scene.n_draws, -1).sum(axis=1))
    return np.array(sums)


def clipped(scene: Any, realisation: np.ndarray, seed: int) -> np.ndarray:
    """Count the frames below zero and above saturation of scenario 0, shape (n_realisation, n_pixel, 2)."""
    if not scene.clip:
        return np.zeros((len(realisation), scene.n_pixel, 2), np.int64)
    index, frames, changes = reference._all_frames(scene, realisation, range(scene.n_draws), seed)
    analogue = reference.analogue(scene, reference.draws(scene, index, frames, seed), 0, *changes)
    r, edge = analogue + reference.MAGIC, scene.edges[0, :, None]
    outside = np.stack([r < edge["low"], r > edge["high"]], axis=-1)[: scene.n_pixel]
    count: np.ndarray = outside.reshape(scene.n_pixel, scene.n_draws, -1, 2).sum(axis=1)
    return count.swapaxes(0, 1)


def statistics(hypotheses: requests.Hypotheses, plan: Any, realisation: np.ndarray, seed: int) -> np.ndarray:
    """Compute all channels of the kernels in their order; rows of `chi2_pair` are zero if it is not asked."""
    scene: Any = hypotheses.scene
    pair, smoothed = "chi2_pair" in hypotheses.statistics, len(plan.scales) > 0
    paper: Any = requests.STATISTICS["paper"]
    rows = paper.smoothing(hypotheses.setting).rows.astype(np.float32) if smoothed else np.zeros((0, 0))
    n_scenario, fixed = len(scene.levels), len(layout.FIXED_STATISTICS)
    weights, linear_end, pixels_end = plan.weights, plan.linear_end, plan.pixels_end
    constants = scene.constants(weights, linear_end, pixels_end)
    estimated, exposures = scene.comparison.estimated, scene.comparison.exposures
    added, scale = scene.job["reference_weight"], scene.job["pair_scale"]
    out = np.zeros((fixed * n_scenario + len(weights), len(realisation)), np.float32)
    x = _above_reference(scene, observed(scene, realisation, seed))
    drawn = max(exposures, 1) if exposures or pair or smoothed else 0
    others = [
        _above_reference(scene, observed(scene, realisation, seed, exposure=layout.REFERENCE, number=number))
        for number in range(drawn)
    ]
    finished, begin = [], 0
    for k in range(n_scenario):
        raw, level = x[k], scene.levels[k]
        y, variance = raw, np.zeros_like(raw)
        if exposures:
            total = np.sum([other[0] for other in others], axis=0, dtype=np.float32)
            y = fma(total, -added, raw)
        if estimated:
            estimate = scene.estimates[k]
            variance = _variance(raw, estimate)
            if exposures:
                variance = np.add(variance, added * _variance(total * added, estimate), dtype=np.float32)
            y = np.add(y, estimate["fraction"][:, None], dtype=np.float32)
            squares = _summed(y * y, scene.pixels["used"][:, None] / variance)
        else:
            squares = _summed(y, fma(y, level["inverse_variance"][:, None], level["twice"][:, None]))
        out[fixed * k] = squares + constants[k]
        out[fixed * k + 1], of_elements = _element_sums(scene, k, y, variance, weights[pixels_end[k] : linear_end[k]])
        out[fixed * n_scenario + int(pixels_end[k]) : fixed * n_scenario + int(linear_end[k])] = of_elements
        for p, pixel in enumerate(scene.pixels) if pair else ():
            d = raw[p] - others[0][0, p]
            if estimated:
                both = _variance(raw, estimate)[p] + _variance(others[0][0], estimate)[p]
                weight = pixel["used"] / both
            else:
                weight = scale * level[p]["inverse_variance"]
            out[fixed * k + 2] = fma(d * d, weight, out[fixed * k + 2])
        for linear in range(begin, int(pixels_end[k])):
            row = _summed(y, weights[linear])
            if estimated:
                row = np.divide(row, np.sqrt(_summed(variance, weights[linear] * weights[linear])), dtype=np.float32)
            else:
                row = row + constants[n_scenario + linear]
            out[fixed * n_scenario + linear] = row
        begin = int(linear_end[k])
        if smoothed:
            scales = plan.scales[plan.scale_end[k - 1] if k else 0 : plan.scale_end[k]]
            finished += _smoothed_sums(rows, scales, raw - others[0][0])
    return np.concatenate([out, np.array(finished, np.float32).reshape(len(finished), len(realisation))])


def _variance(x: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """Return the variances that an observer estimates from counts, shape (n_padded, n)."""
    gain, known, offset = (estimate[name][:, None] for name in ("gain", "variance", "net_offset"))
    return fma(np.maximum(x + offset, np.float32(0.0)), gain, known)


def _element_sums(scene: Any, k: int, y: Any, variance: Any, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `chi2_element` of a scenario, shape (n,), and weighted sums of its elements, shape (m, n)."""
    total: np.ndarray = np.zeros_like(y[0])
    weighted: np.ndarray = np.zeros((len(weights), total.size), np.float32)
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
                weighted = fma(inside, weights[:, p, None], weighted)
            inside, noise = np.zeros_like(total), np.zeros_like(total)
    return total, weighted


def marginalise(values: np.ndarray, subtractions: np.ndarray) -> np.ndarray:
    """Subtract the squares of channels as the kernel `marginalise` does."""
    out = values.copy()
    for base, first, end in subtractions.T:
        for row in out[first:end]:
            out[base] = fma(-row, row, out[base])
    return out


def _smoothed_sums(rows: np.ndarray, scales: np.ndarray, difference: np.ndarray) -> list[np.ndarray]:
    """Return the smoothed statistics of a scenario, each of shape (n,); `rows` holds the weights of each centre."""
    out = [np.zeros(difference.shape[1], np.float32) for _ in scales]
    for centre, row in enumerate(rows):
        value = np.zeros(difference.shape[1], np.float32)
        for p in np.flatnonzero(row):
            value = fma(difference[p], row[p], value)
        square = value * value
        out = [fma(square, scale[centre], one) for one, scale in zip(out, scales, strict=True)]
    return out


def _above_reference(scene: Any, counts: np.ndarray) -> np.ndarray:
    above = counts.astype(np.float32)
    if scene.frames:
        return np.asarray(above + scene.edges["whole"][:, :, None])
    return np.asarray((above + reference.MAGIC) - scene.levels["shift"][:, :, None])


def _summed(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return sums over pixels, (n,), with weights (n_pixel,) or (n_pixel, n), from four partial sums."""
    parts = [np.zeros(values.shape[1], np.float32) for _ in range(4)]
    for p, weight in enumerate(weights):
        parts[p % 4] = fma(values[p], weight, parts[p % 4])
    total: np.ndarray = (parts[0] + parts[1]) + (parts[2] + parts[3])
    return total


def histograms(scene: Any, observers: Any, elements: np.ndarray, realisation: np.ndarray, seed: int) -> snr.Counts:
    """Count pixels, S/N of elements and clipped frames as the kernel `histogram` does, including far values."""
    counts = snr.Counts(scene.n_pixel, len(elements))
    n = observed(scene, realisation, seed, scenarios=[0])[0]
    for e, element in enumerate(elements):
        first, end = int(element["first"]), int(element["end"])
        for p in range(first, end):
            counts.bins["pixel"].count(p, n[p] >> int(observers[p]["bin_shift"]))
        ratio = snr.signal_to_noise(n[first:end], observers[first:end], element["sky"])
        steps = (ratio - element["centre"]) * element["bins_per_unit"]
        counts.bins["element"].count(e, np.rint(steps).astype(np.int64))
    counts.clipped += clipped(scene, realisation, seed).sum(axis=0)
    counts.n = len(realisation)
    return counts


def tally(values: np.ndarray, grids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Count values, (n_channel, n), as the kernel `tally`: histograms, sums of steps and squares, numbers outside."""
    # The first and last bins include all values outside, the sums none.
    bins = layout.BINS
    histogram = np.zeros((len(grids), bins), np.uint32)
    sums, outside = np.zeros((len(grids), 2), np.int64), np.zeros(len(grids), np.uint32)
    end = np.float32(bins // 2 << layout.FINE_BITS)
    for g, grid in enumerate(grids):
        with np.errstate(over="ignore", invalid="ignore"):
            steps = (values[int(grid["channel"])] - grid["centre"]) * grid["steps_per_unit"]
        # NaN is counted at the lower end.
        steps = np.where(steps > -end, np.minimum(steps, end - np.float32(1.0)), -end)
        step = reference.nearest(steps).astype(np.int64)
        bin_index = (step >> layout.FINE_BITS) + bins // 2
        histogram[g] = np.bincount(bin_index, minlength=bins)
        inner = step[(bin_index > 0) & (bin_index < bins - 1)]
        sums[g] = inner.sum(), (inner * inner).sum()
        outside[g] = step.size - inner.size
    return histogram, sums, outside
