"""What the kernels read of each pixel: structs filled for draws of counts, for responses, for estimated variances."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.host.errors import InputError
from mauvecl.noise import layout
from mauvecl.noise.cumulants import Cumulants
from mauvecl.noise.poisson import LARGEST_MEAN, SMALLEST_EXPANDED, AliasTable, table_set
from mauvecl.noise.processes import Factors

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

Float = NDArray[np.float64]

#: Pixels are padded to a multiple of this with ones that never contribute.
PIXEL_BLOCK = 32
#: DN^2 in place of none at all.
NO_VARIANCE = 1e-12


def padded(n_pixel: int) -> int:
    """Pixels with those that never contribute."""
    return -(-n_pixel // PIXEL_BLOCK) * PIXEL_BLOCK


def element_ends(x: Expectation) -> NDArray[np.bool_]:
    """The last pixels of resolution elements, shape (n_pixel,)."""
    return np.append(np.diff(x.element) > 0, True)


def of_detector(quiet: Expectation, used: NDArray[np.bool_]) -> NDArray[np.void]:
    """What all scenarios share: layout.PIXEL, shape (n_padded,)."""
    n_pixel = used.size
    pixels = np.zeros(padded(n_pixel), layout.PIXEL)
    pixels["used"][:n_pixel] = used
    pixels["element_end"][:n_pixel] = element_ends(quiet)
    # Fours within one element that all count need no look at each pixel.
    uneven = (pixels["element_end"] > 0) | (pixels["used"] == 0)
    pixels["four_uneven"] = np.repeat(uneven.reshape(-1, 4).any(axis=1), 4)
    pixels["cosmic_gain"][:n_pixel] = quiet.gain_dn_per_electron
    return pixels


def sky_share(x: Expectation) -> Float:
    """The sky's share of the light of each pixel, shape (n_pixel,); zero where there is none."""
    light = x.source_electrons + x.sky_electrons
    return np.divide(x.sky_electrons, light, out=np.zeros_like(light), where=light > 0)


def poisson_counts(out: NDArray[np.void], mean: Float, gain: Float, tables: list[AliasTable]) -> Float:
    """Fill in how Poisson counts are drawn; returns the whole numbers they are relative to, shape (n_pixel,)."""
    centre = np.rint(mean)
    # A pair shares two words: a table takes one, the expansion both. Two of a pair never go different ways.
    expanded = _both_of_a_pair(mean >= SMALLEST_EXPANDED)
    if (mean[~expanded] > LARGEST_MEAN).any():
        pixel = int(np.argmax(np.where(expanded, 0.0, mean)))
        raise InputError(
            f"pixel {pixel} has a Poisson mean of {mean[pixel]:.3g} in one draw beside a pixel of less than "
            f"{SMALLEST_EXPANDED:g}, expected at most {LARGEST_MEAN:g} there: draw frame by frame"
        )
    alias, starts = table_set(mean[~expanded].tolist(), tables)
    out["table"][~expanded] = starts
    out["bits"][~expanded] = [t.bits for t in alias]
    out["low"][~expanded] = np.array([t.low for t in alias]) - centre[~expanded]
    root = np.sqrt(mean[expanded])
    out["offset"][expanded] = (mean - centre)[expanded] - 1 / 6
    out["slope"][expanded] = root - 1 / (36 * root)
    out["cubic"][expanded] = -1 / (72 * root)
    out["gain"] = gain
    return centre


def _both_of_a_pair(chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels 2i and 2i + 1 where both are chosen; a last one without a neighbour decides alone."""
    pairs = np.append(chosen, chosen[-1:]) if chosen.size % 2 else chosen
    return np.repeat(pairs.reshape(-1, 2).all(axis=1), 2)[: chosen.size]


def estimate(out: NDArray[np.void], reference: Expectation, fraction: Float, mean_sum: Float) -> None:
    """How an observer who knows the detector estimates variances; padding has some, to divide by."""
    n_pixel, known = reference.wavelength_nm.size, reference.read_noise_dn**2 + reference.dark_variance_dn2 + 1 / 12
    out["variance"] = 1.0
    out["fraction"] = fraction
    out["net_offset"][:n_pixel] = mean_sum - reference.n_frames * (reference.bias_dn + reference.dark_dn)
    out["gain"][:n_pixel] = reference.gain_dn_per_electron
    out["variance"][:n_pixel] = np.maximum(reference.n_frames * known, NO_VARIANCE)


def respond(out: NDArray[np.void], x: Expectation, c: Cumulants, factors: Factors) -> None:
    """How a draw follows factors on light, dark and sky, from what they are at the priors' medians."""
    share, dark = sky_share(x), factors.dark
    light = factors.on_light(factors.light, factors.sky, share)
    # The sky's light follows both factors.
    out["sky_share"] = factors.light * factors.sky * share / light
    out["light"], out["dark"] = light * c.light_dn, dark * c.dark_dn
    out["light_variance"], out["dark_variance"] = light * c.light_variance, dark * c.dark_variance
    # A pixel without any noise must not divide zero by zero.
    out["other_variance"] = np.maximum(c.variance - c.light_variance - c.dark_variance, NO_VARIANCE)
    for order, name in ((3, "third"), (4, "fourth"), (5, "fifth")):
        out[f"light_{name}"] = light * c.photon_cumulant(order)
        out[f"dark_{name}"] = dark * c.dark_cumulant(order)
