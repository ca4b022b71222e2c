"""Structs that the kernels read for each pixel: Poisson draws, responses to factors, estimated variances."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise import layout
from mauvecl.noise.cumulants import Cumulants
from mauvecl.noise.factor_tables import Factors
from mauvecl.noise.poisson import LARGEST_MEAN, SMALLEST_EXPANDED, AliasTable, table_set
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation

Float = NDArray[np.float64]

#: Pixels are padded to a multiple of this with pixels that do not contribute.
PIXEL_BLOCK = 32
#: Variance, DN^2, that replaces zero.
NO_VARIANCE = 1e-12


def padded(n_pixel: int) -> int:
    """Return the number of pixels including padding."""
    return -(-n_pixel // PIXEL_BLOCK) * PIXEL_BLOCK


def element_ends(x: Expectation) -> NDArray[np.bool_]:
    """Return which pixels are the last of a resolution element, shape (n_pixel,)."""
    return np.append(np.diff(x.element) > 0, True)


def detector_pixels(quiet: Expectation, used: NDArray[np.bool_]) -> NDArray[np.void]:
    """Return the properties that all scenarios share: layout.PIXEL, shape (n_padded,)."""
    n_pixel = used.size
    pixels = np.zeros(padded(n_pixel), layout.PIXEL)
    pixels["used"][:n_pixel] = used
    pixels["element_end"][:n_pixel] = element_ends(quiet)
    # Groups of four used pixels in one element are summed without tests of single pixels.
    uneven = (pixels["element_end"] > 0) | (pixels["used"] == 0)
    pixels["four_uneven"] = np.repeat(uneven.reshape(-1, 4).any(axis=1), 4)
    pixels["electron_gain"][:n_pixel] = quiet.gain_dn_per_electron
    return pixels


def sky_share(x: Expectation) -> Float:
    """Return the sky's share of each pixel's light, shape (n_pixel,); zero without light."""
    light = x.light_electrons
    return np.divide(x.sky_electrons, light, out=np.zeros_like(light), where=light > 0)


def fill_poisson_counts(out: NDArray[np.void], mean: Float, gain: Float, tables: list[AliasTable]) -> Float:
    """Fill `out` for draws of Poisson counts; return the integers to which counts are relative, shape (n_pixel,)."""
    centre = np.rint(mean)
    # A pair of pixels shares two words. A table uses one and the expansion both, so a pair must use the same method.
    expanded = _both_of_a_pair(mean >= SMALLEST_EXPANDED)
    if (mean[~expanded] > LARGEST_MEAN).any():
        pixel = int(np.argmax(np.where(expanded, 0.0, mean)))
        raise InputError(
            f"pixel {pixel} has a Poisson mean of {mean[pixel]:.3g} in one draw next to a pixel of less than "
            f"{SMALLEST_EXPANDED:g}",
            f"at most {LARGEST_MEAN:g} there: draw frame by frame",
            key="mode",
            value=float(mean[pixel]),
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
    """Return pixels 2i and 2i + 1 if both are chosen; a last pixel without a neighbour is decided alone."""
    pairs = np.append(chosen, chosen[-1:]) if chosen.size % 2 else chosen
    return np.repeat(pairs.reshape(-1, 2).all(axis=1), 2)[: chosen.size]


def fill_estimates(out: NDArray[np.void], reference: Expectation, fraction: Float, mean_sum: Float) -> None:
    """Fill `out` for variances estimated by an observer who knows the detector; padding has a variance of 1."""
    n_pixel, known = reference.wavelength_nm.size, reference.read_noise_dn**2 + reference.dark_variance_dn2 + 1 / 12
    out["variance"] = 1.0
    out["fraction"] = fraction
    out["net_offset"][:n_pixel] = mean_sum - reference.n_frames * (reference.bias_dn + reference.dark_dn)
    out["gain"][:n_pixel] = reference.gain_dn_per_electron
    out["variance"][:n_pixel] = np.maximum(reference.n_frames * known, NO_VARIANCE)


def fill_responses(out: NDArray[np.void], x: Expectation, c: Cumulants, factors: Factors) -> None:
    """Fill `out` with a draw's response to factors on light, dark and sky, relative to the priors' medians."""
    share, dark = sky_share(x), factors.dark
    light = factors.on_light(factors.light, factors.sky, share)
    # The sky's light follows both factors.
    out["sky_share"] = factors.light * factors.sky * share / light
    out["light"], out["dark"] = light * c.light_dn, dark * c.dark_dn
    out["light_variance"], out["dark_variance"] = light * c.light_variance, dark * c.dark_variance
    # A lower limit avoids 0 / 0 in pixels without noise.
    out["other_variance"] = np.maximum(c.variance - c.light_variance - c.dark_variance, NO_VARIANCE)
    for order, name in ((3, "third"), (4, "fourth"), (5, "fifth")):
        out[f"light_{name}"] = light * c.photon_cumulant(order)
        out[f"dark_{name}"] = dark * c.dark_cumulant(order)
