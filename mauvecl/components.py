"""One realisation taken apart: what the star, the photons, the dark, the read noise and the ADC put into it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mauvecl import reference
from mauvecl.scene import Mode, prepare

if TYPE_CHECKING:
    from astropy.table import QTable

    from mauvecl.host.expectation import Expectation


def components(x: Expectation, *, realisation: int, seed: int, mode: Mode = "auto") -> QTable:
    """The draws behind one raw spectrum, by the slow twin.

    Parameters
    ----------
    x : Expectation
    realisation : int
    seed : int
    mode : {"auto", "frames", "stacked"}

    Returns
    -------
    QTable
        One row per pixel, DN summed over the exposure: ``raw``, what the engine gives for this realisation; ``source``
        and ``sky``, the mean signals; ``photon_noise`` and ``read_noise``; ``dark``; ``bias``; ``digitisation``, what
        rounding and clipping changed. The last seven add up to the first.

    Notes
    -----
    The kernels draw photon and read noise as one Gaussian. Given their sum the photon part is again Gaussian; its
    draw comes from a stream of its own, so that taking a spectrum apart changes nothing in it.
    """
    import astropy.units as u
    from astropy.table import QTable

    scene = prepare([x], mode)
    index = np.array([realisation], np.uint64)
    n_draw = scene.n_draws
    n = scene.n_pixel
    each = x.n_frames // n_draw  # frames in one draw
    gain = x.gain_dn_per_electron
    photon_variance = each * gain**2 * (x.source_electrons + x.sky_electrons)
    read_variance = each * x.read_noise_dn**2 + (each - 1) / 12
    dark_gain = scene.pixels["dark_gain"][:n].astype(float)
    centre = np.rint(each * x.dark_dn / dark_gain)
    photon, read, dark, raw = np.zeros((4, n))
    for frame in range(n_draw):
        z, d, split, dn = np.zeros((4, len(scene.pixels)), np.float32)
        for group in range(len(scene.pixels) // 4):
            gaussian, count = reference.draws(scene, index, frame, group, seed)
            w = reference.words_at(index, frame, "split", group, seed)
            apart = [*reference.normal_pair(w[0], w[1]), *reference.normal_pair(w[2], w[3])]
            for i, p in enumerate(range(4 * group, 4 * group + 4)):
                pixel, level = scene.pixels[p], scene.levels[0, p]
                z[p], d[p], split[p] = gaussian[i][0], count[i][0], apart[i][0]
                dn[p] = reference.digitise(gaussian[i], count[i], pixel["dark_gain"], level, clip=scene.clip)[0]
        total = photon_variance + read_variance
        both = np.sqrt(total) * z[:n]
        mine = both * photon_variance / total + np.sqrt(photon_variance * read_variance / total) * split[:n]
        photon += mine
        read += both - mine
        dark += dark_gain * (centre + d[:n])
        raw += scene.base_dn[0] + dn[:n]
    table = QTable()
    table["wavelength"] = x.wavelength_nm * u.nm
    parts = {
        "source": x.n_frames * gain * x.source_electrons,
        "sky": x.n_frames * gain * x.sky_electrons,
        "photon_noise": photon,
        "dark": dark,
        "bias": x.n_frames * x.bias_dn,
        "read_noise": read,
    }
    table["raw"] = raw * u.adu
    for name, values in parts.items():
        table[name] = np.broadcast_to(values, n) * u.adu
    table["digitisation"] = (raw - sum(np.asarray(v) for v in parts.values())) * u.adu
    table["net"] = (raw - x.n_frames * (x.bias_dn + x.dark_dn)) * u.adu
    for name, text in DESCRIPTIONS.items():
        table[name].info.description = text
    table.meta |= {"name": x.name, "exposure_s": x.exposure_s, "frames": x.n_frames, "seed": seed}
    return table


DESCRIPTIONS = {
    "raw": "simulated raw spectrum, summed over the frames (DN)",
    "source": "mean signal of the star",
    "sky": "mean signal of the zodiacal light",
    "photon_noise": "drawn photon noise of star and sky",
    "dark": "drawn dark counts",
    "bias": "bias",
    "read_noise": "drawn read noise",
    "digitisation": "what rounding and clipping changed",
    "net": "raw less bias and mean dark",
}
