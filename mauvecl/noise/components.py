"""Decomposition of a realisation into star, sky, photon noise, dark, read noise and digitisation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Unpack

import numpy as np
from numpy.typing import NDArray
from scipy import special

from mauvecl.noise import random_numbers, reference
from mauvecl.noise.drawing import DrawingOptions
from mauvecl.noise.scene import prepare
from mauvecl.noise.unknowns import ADDITIVE
from mauvecl.schema.tables import Column, table_of

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation
    from mauvecl.noise.scene import Scene

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
        frames = np.arange(start, min(start + FRAMES_AT_ONCE, scene.n_draws))
        one = _Parts(x, scene, realisation, frames, seed)
        for name, part in zip(names, one.all(), strict=True):
            parts[name] += part.sum(axis=1)
        raw += frames.size * scene.base_dn[0] + one.recorded.sum(axis=1)
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

    def __init__(self, x: Expectation, scene: Scene, realisation: int, frames: NDArray[np.int64], seed: int) -> None:
        self.x, self.scene = x, scene
        self.each = x.n_frames // scene.n_draws  # frames in one draw
        index = np.full(frames.size, realisation, np.uint64)
        each_frame = [reference.factors(scene, index[:1], frame, seed) for frame in frames.tolist()]
        changes = [np.concatenate(factor) for factor in zip(*each_frame, strict=True)]
        self.light, self.warm, self.glow = (
            (1.0 + change.astype(np.float64)) * middle for change, middle in zip(changes, scene.medians, strict=True)
        )
        shape = len(scene.pixels), frames.size
        analogue, self.recorded, dark, photon = np.zeros((4, *shape))
        added = {name: np.zeros(shape) for name in scene.additive}
        groups = np.arange(len(scene.pixels) // 4)[:, None]
        words = np.stack(reference.words_at(index, frames, "split_dark", groups, seed), axis=1)
        scores = random_numbers.four_normals(reference.words_at(index, frames, "split", groups, seed))
        for group in range(groups.size):
            drawn = reference.draws(scene, index, frames, group, seed)
            for i, p in enumerate(range(4 * group, 4 * group + 4)):
                v = reference.analogue(scene, drawn, i, p, 0, *changes)
                analogue[p], self.recorded[p] = v, reference.digitise(v, scene.edges[0, p], clip=scene.clip)
                for name, charge in drawn.added.items():
                    added[name][p] = scene.pixels[p]["electron_gain"] * charge[i]
                if not scene.joint:
                    dark[p] = scene.dark_counts[p]["gain"] * drawn.dark[i]
                if drawn.photon is not None:
                    source = scene.photon_counts[0, p]
                    normals = random_numbers.four_normals(drawn.photon)
                    electrons = reference.poisson_draw(drawn.photon, i, source, scene.tables, normals)
                    photon[p] = source["gain"] * electrons
        n = scene.n_pixel
        self.recorded = self.recorded[:n]
        self.score = np.stack(scores, axis=1).reshape(shape)[:n]
        self.chance = (words.reshape(shape)[:n].astype(np.float64) + 0.5) / 2**32
        self.added = {name: charge[:n] for name, charge in added.items()}
        self.counted_dark, self.counted_photons = dark[:n], photon[:n]
        self.level = scene.base_dn[0][:, None] + analogue[:n]

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
