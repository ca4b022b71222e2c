"""Observables of a stare: light curves in wavelength bands, and a spectrum of every frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.stares.frame_components import MOST_STATISTICS, STEADY, Components
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.lightcurve.stares.stare import Stare

Float = NDArray[np.float64]
#: Draws the sums of a stare's frames, shape (n_frame, n_statistic), for some components.
Draw = Callable[[Components], NDArray[Any]]

#: Number of frames per block of computations by pixel.
BLOCK = 4096
#: Quality of a frame in which the mean of a pixel reaches saturation.
SATURATED = 1


@dataclass(frozen=True, eq=False)
class StareExpectation:
    """Expectation of a stare at a star with flares."""

    quiet: Expectation  # one frame without a flare
    stare: Stare
    flare_electrons: Float  # electrons per frame at unit amplitude, one row per temperature, shape (n_flare, n_pixel)
    flare: Float  # mean amplitudes in each frame, shape (n_frame, n_flare)

    def components(self, weights: Float) -> Components:
        """Return the components of its frames, for weighted sums over pixels."""
        return Components(self.quiet, self.flare_electrons, weights)

    @cached_property
    def coefficients(self) -> Float:
        """Known coefficients of star, sky, dark, neighbours and flares in each frame, shape (n_frame, 4 + n_flare)."""
        return self._bare.coefficients(self.stare, self.flare)

    @cached_property
    def _bare(self) -> Components:
        return self.components(self.used[None].astype(np.float64))

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Pixels that the quiescent star does not saturate, shape (n_pixel,)."""
        return ~self.quiet.saturated

    @cached_property
    def quality(self) -> NDArray[np.int32]:
        """`SATURATED` where the mean of a used pixel reaches saturation in a frame, 0 elsewhere, shape (n_frame,)."""
        rise = self._bare.mean_dn[:, self.used]
        room = self.quiet.ceiling_dn - self.quiet.bias_dn[self.used]
        quality = np.zeros(self.stare.n_frames, np.int32)
        # A fast upper bound excludes most frames: the sum of the maxima of all components.
        near = np.flatnonzero(self.coefficients @ rise.max(axis=1) >= room.min())
        for begin in range(0, near.size, BLOCK):
            rows = near[begin : begin + BLOCK]
            quality[rows] = SATURATED * (self.coefficients[rows] @ rise >= room).any(axis=1)
        return quality

    def snr(self, flare: Float) -> float:
        """Return the matched-filter S/N of a flare with mean amplitudes of shape (n_frame, n_flare)."""
        constant, each = self._bare.pixel_cumulants(2)
        variance = (constant + each[: len(STEADY)].sum(axis=0))[self.used]
        spectra = self._bare.mean_dn[len(STEADY) :, self.used]
        return float(np.sqrt(np.einsum("tk,kl,tl->", flare, spectra / variance @ spectra.T, flare, optimize=True)))

    def net(self, weights: Float, draw: Draw, kind: type[np.floating[Any]] = np.float64) -> tuple[Any, Any, Any]:
        """Draw the net light in weighted sums of pixels, and return it with its standard deviation and mean, DN/s.

        Net light is the raw count minus bias and dark current at the known temperature; it includes the sky and
        neighbours.

        Parameters
        ----------
        weights : ndarray, shape (n_sum, n_pixel)
            Zero in pixels that are not used.
        kind : type
            Type of the arrays.

        Returns
        -------
        net, sd, mean : ndarray of `kind`, shape (n_frame, n_sum)
            The standard deviation is that of photons, dark current and read noise, without jitter.
        """
        frame_s, coefficients = self.stare.frame_s, self.coefficients
        net, sd, mean = (np.empty((self.stare.n_frames, len(weights)), kind) for _ in range(3))
        for begin in range(0, len(weights), MOST_STATISTICS):
            there = slice(begin, begin + MOST_STATISTICS)
            rows = weights[there]
            first = self._bare.mean_dn @ rows.T
            drawn = np.asarray(draw(self.components(rows)), np.float64)
            # The sums are relative to the quiescent light at the temperature of its expectation.
            net[:, there] = (drawn + first[0] + first[1] + first[3] + (1.0 - coefficients[:, 2:3]) * first[2]) / frame_s
            sd[:, there], mean[:, there] = self.expected(rows)
        return net, sd, mean

    def raw(self, draw: Draw) -> Float:
        """Return drawn raw counts of each pixel, DN, shape (n_frame, n_pixel); saturated pixels hold their mean."""
        frames = np.tile(self.quiet.recorded_dn, (self.stare.n_frames, 1))
        pixels = np.flatnonzero(self.used)
        for begin in range(0, pixels.size, MOST_STATISTICS):
            some = pixels[begin : begin + MOST_STATISTICS]
            frames[:, some] += draw(self.components(np.eye(self.used.size)[some]))
        return frames

    @cached_property
    def mean_raw(self) -> Float:
        """Mean raw counts of each pixel, DN, shape (n_frame, n_pixel)."""
        return np.asarray(self.coefficients @ self._bare.mean_dn + self.quiet.bias_dn)

    def expected(self, weights: Float) -> tuple[Float, Float]:
        """Return standard deviation and mean of the net light in sums of pixels, DN/s, shape (n_frame, n_sum)."""
        frame_s, coefficients = self.stare.frame_s, self.coefficients
        constant, each = self._bare.pixel_cumulants(2)
        squares, light = weights.T**2, np.delete(self._bare.mean_dn, 2, axis=0) @ weights.T
        sd = np.sqrt(constant @ squares + coefficients @ (each @ squares))
        return sd / frame_s, np.delete(coefficients, 2, axis=1) @ light / frame_s


@dataclass(frozen=True, eq=False)
class LightCurves:
    """Light curves and spectra of a stare, DN/s without bias and dark current."""

    bands: tuple[str, ...]  # the first is the whole range
    #: Shape (n_frame, n_band); drawn light, standard deviation of its noise, and light without noise.
    flux: Float
    sd: Float  # shape (n_frame, n_band)
    mean: Float  # shape (n_frame, n_band)
    #: Shape (n_frame, n_element); the same in resolution elements.
    spectrum: NDArray[np.float32]
    spectrum_sd: NDArray[np.float32]  # shape (n_frame, n_element)
    spectrum_mean: NDArray[np.float32]  # shape (n_frame, n_element)
    element_nm: Float  # shape (n_element,)


def draw_light_curves(
    expectation: StareExpectation, bands_nm: Sequence[tuple[float, float]], draw: Draw
) -> LightCurves:
    """Draw a stare in bands and resolution elements, all from the same pixels.

    Raises InputError if a band contains no pixel.

    Parameters
    ----------
    bands_nm : sequence of (float, float)
        Wavelengths, nm; the upper limit is excluded, and saturated pixels are not used.
    draw : callable
        Draws the same pixels for all sums.
    """
    quiet, used = expectation.quiet, expectation.used.astype(np.float64)
    rows = []
    for low, high in bands_nm:
        row = used * ((quiet.wavelength_nm >= low) & (quiet.wavelength_nm < high))
        if not row.any():
            raise InputError.of("bands_nm", (low, high), f"a band with usable pixels{quiet.saturation_clause}")
        rows.append(row)
    elements = used * (quiet.element == np.arange(quiet.element_wavelength_nm.size)[:, None])
    filled = np.flatnonzero(elements.any(axis=1))
    spectrum, spectrum_sd, spectrum_mean = expectation.net(elements[filled], draw, np.float32)
    # Each pixel belongs to one element, so their sum is the whole range.
    whole = spectrum.sum(axis=1, dtype=np.float64), *expectation.expected(used[None])
    parts = (
        expectation.net(np.array(rows).reshape(len(rows), used.size), draw) if rows else np.zeros((3, len(whole[0]), 0))
    )
    flux, sd, mean = (np.column_stack(both) for both in zip(whole, parts, strict=True))
    low, high = quiet.wavelength_nm[[0, -1]]
    return LightCurves(
        (f"{low:.0f}-{high:.0f} nm", *(f"{a:g}-{b:g} nm" for a, b in bands_nm)),
        flux,
        sd,
        mean,
        spectrum,
        spectrum_sd,
        spectrum_mean,
        quiet.element_wavelength_nm[filled],
    )
