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

Float = NDArray[np.float64]


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
    x : Expectation
    realisation : int
    seed : int
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
    index = np.array([realisation], np.uint64)
    n = scene.n_pixel
    each = x.n_frames // scene.n_draws  # frames in one draw
    gain = x.gain_dn_per_electron
    parts = {
        name: np.zeros(n)
        for name in ("source", "sky", "neighbours", "photon_noise", "dark", "read_noise", *scene.additive)
    }
    raw = np.zeros(n)
    for frame in range(scene.n_draws):
        factors = reference.factors(scene, index, frame, seed)
        light, warm, glow = ((1.0 + float(f[0])) * middle for f, middle in zip(factors, scene.medians, strict=True))
        dark_dn, photon_dn, analogue, dn = np.zeros((4, len(scene.pixels)))
        added = {name: np.zeros(len(scene.pixels)) for name in scene.additive}
        u_dark, z_split = np.zeros((2, len(scene.pixels)))
        for group in range(len(scene.pixels) // 4):
            drawn = reference.draws(scene, index, frame, group, seed)
            chance = reference.words_at(index, frame, "split_dark", group, seed)
            apart = random_numbers.four_normals(reference.words_at(index, frame, "split", group, seed))
            for i, p in enumerate(range(4 * group, 4 * group + 4)):
                v = reference.analogue(scene, drawn, i, p, 0, *factors)
                analogue[p] = v[0]
                dn[p] = reference.digitise(v, scene.edges[0, p], clip=scene.clip)[0]
                z_split[p] = apart[i][0]
                u_dark[p] = (float(chance[i][0]) + 0.5) / 2**32
                for name, electrons in drawn.added.items():
                    added[name][p] = scene.pixels[p]["electron_gain"] * electrons[i][0]
                if not scene.joint:
                    dark_dn[p] = scene.dark_counts[p]["gain"] * drawn.dark[i][0]
                if drawn.photon is not None:
                    pairs = random_numbers.four_normals(drawn.photon)
                    source = scene.photon_counts[0, p]
                    electrons = reference.poisson_draw(drawn.photon, i, source, scene.tables, pairs)[0]
                    photon_dn[p] = source["gain"] * electrons
        source, sky = each * light * gain * x.source_electrons, each * light * glow * gain * x.sky_electrons
        neighbours = each * light * gain * x.neighbour_electrons
        photon_variance = gain * (source + sky + neighbours)
        read_variance = each * x.read_noise_dn**2 + (each - 1) / 12
        mean_dark = each * warm * x.dark_dn
        # All random parts of this draw: photon noise + read noise + dark counts, DN.
        total = scene.base_dn[0] + analogue[:n]
        for charge in added.values():
            total = total - charge[:n]
        total = total - source - sky - neighbours - each * x.bias_dn
        if scene.joint:
            dark = _dark_given_total(total, mean_dark, x.dark_step_dn, photon_variance + read_variance, u_dark[:n])
        else:
            dark = x.dark_step_dn * np.rint(mean_dark / x.dark_step_dn) + dark_dn[:n]
        rest = total - dark
        if scene.photons:
            photon = gain * np.rint(each * x.light_electrons) + photon_dn[:n] - source - sky - neighbours
        else:
            both = photon_variance + read_variance
            share = np.divide(photon_variance, both, out=np.zeros(n), where=both > 0)
            photon = rest * share + np.sqrt(read_variance * share) * z_split[:n]
        charges = (charge[:n] for charge in added.values())
        for name, part in zip(parts, (source, sky, neighbours, photon, dark, rest - photon, *charges), strict=True):
            parts[name] += part
        raw += scene.base_dn[0] + dn[:n]
    parts["bias"] = np.asarray(x.n_frames * x.bias_dn)
    values = {"wavelength": x.wavelength_nm, "raw": raw} | parts
    values["digitisation"] = raw - sum(parts.values())
    if not x.neighbour_electrons.any():
        del values["neighbours"]
    values["net"] = raw - x.n_frames * (x.bias_dn + x.dark_dn) - x.subtracted_dn
    columns = [column for column in COLUMNS if column.name in values]
    about = {"signal": x.signal, "name": x.name, "exposure_s": x.exposure_s, "frames": x.n_frames, "seed": seed}
    return table_of(columns, [values], **about)


def _dark_given_total(total: Float, mean: Float, step: Float, variance: Float, chance: Float) -> Float:
    """Draw dark counts, DN, given their sum with a Gaussian of this variance, by inversion at `chance`."""
    dark = np.zeros(total.size)
    for p in np.flatnonzero(mean > 0):
        if variance[p] == 0:
            dark[p] = total[p]
            continue
        expected = mean[p] / step[p]
        # This range covers both the prior and the likelihood.
        reach = 9.0 * np.sqrt(expected) + 9.0
        counts = np.arange(max(int(expected - reach), 0), int(expected + reach) + 1)
        log = special.xlogy(counts, expected) - special.gammaln(counts + 1.0)
        log -= (total[p] - step[p] * counts) ** 2 / (2.0 * variance[p])
        below = np.cumsum(np.exp(log - log.max()))
        dark[p] = step[p] * counts[np.searchsorted(below, chance[p] * below[-1])]
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
