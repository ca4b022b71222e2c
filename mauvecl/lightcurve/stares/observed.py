"""One stare as an observer sees it: light curves in bands of wavelength, and a spectrum for every frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.stares.components import MOST_STATISTICS, Components
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation
    from mauvecl.lightcurve.stares.stare import Stare

Float = NDArray[np.float64]
#: Draws the sums of a stare's frames: components to an array of shape (n_frame, n_statistic).
Draw = Callable[[Components], NDArray[Any]]

#: Frames at a time where each pixel of each is looked at.
BLOCK = 4096
#: Bit of a frame's quality whose mean reaches saturation in some pixel.
SATURATED = 1


@dataclass(frozen=True, eq=False)
class StareExpectation:
    """A star, its flares and a stare, before anything is drawn.

    Attributes
    ----------
    quiet : Expectation
        One frame without a flare.
    stare : Stare
    flare_electrons : ndarray, shape (n_flare, n_pixel)
        Electrons per frame of flares of one amplitude, each of another temperature.
    flare : ndarray, shape (n_frame, n_flare)
        Their mean amplitudes in each frame.
    """

    quiet: Expectation
    stare: Stare
    flare_electrons: Float
    flare: Float

    def components(self, weights: Float) -> Components:
        """What its frames are made of, for some sums over pixels."""
        return Components(self.quiet, self.flare_electrons, weights)

    @cached_property
    def coefficients(self) -> Float:
        """Strengths of star, sky, dark and flares in each frame, as far as known, shape (n_frame, 3 + n_flare)."""
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
        # Most stars are far from it: each component's brightest pixel together is more than any pixel has.
        near = np.flatnonzero(self.coefficients @ rise.max(axis=1) >= room.min())
        for begin in range(0, near.size, BLOCK):
            rows = near[begin : begin + BLOCK]
            quality[rows] = SATURATED * (self.coefficients[rows] @ rise >= room).any(axis=1)
        return quality

    def snr(self, flare: Float) -> float:
        """S/N of a flare for one who knows all but whether it is there: frames and pixels weighted by its own shape.

        Parameters
        ----------
        flare : ndarray, shape (n_frame, n_flare)
            Its mean amplitude in each spectrum and frame.
        """
        constant, each = self._bare.pixel_cumulants(2)
        variance = (constant + each[:3].sum(axis=0))[self.used]
        spectra = self._bare.mean_dn[3:, self.used]
        return float(np.sqrt(np.einsum("tk,kl,tl->", flare, spectra / variance @ spectra.T, flare, optimize=True)))

    def net(self, weights: Float, draw: Draw, kind: type[np.floating[Any]] = np.float64) -> tuple[Any, Any, Any]:
        """Net light in weighted sums of pixels, DN per second: drawn, its standard deviation, and its mean.

        Raw counts less bias and the dark at the temperature that is known, and so with the sky.

        Parameters
        ----------
        weights : ndarray, shape (n_sum, n_pixel)
            Zero where `used` is not.
        draw : callable
        kind : type
            Of what is kept: a few sums at a time are drawn in double precision.

        Returns
        -------
        net, sd, mean : ndarray of `kind`, shape (n_frame, n_sum)
            The standard deviation of photons, dark and reading alone: an observer does not know what jitters.
        """
        frame_s, coefficients = self.stare.frame_s, self.coefficients
        net, sd, mean = (np.empty((self.stare.n_frames, len(weights)), kind) for _ in range(3))
        for begin in range(0, len(weights), MOST_STATISTICS):
            there = slice(begin, begin + MOST_STATISTICS)
            rows = weights[there]
            first = self._bare.mean_dn @ rows.T
            drawn = np.asarray(draw(self.components(rows)), np.float64)
            # The sums are of raw counts less the quiescent star's at the expectation's own temperature.
            net[:, there] = (drawn + first[0] + first[1] + (1.0 - coefficients[:, 2:3]) * first[2]) / frame_s
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
        """Standard deviation and mean of the net light in weighted sums of pixels, DN per second, (n_frame, n_sum)."""
        frame_s, coefficients = self.stare.frame_s, self.coefficients
        constant, each = self._bare.pixel_cumulants(2)
        squares, light = weights.T**2, np.delete(self._bare.mean_dn, 2, axis=0) @ weights.T
        sd = np.sqrt(constant @ squares + coefficients @ (each @ squares))
        return sd / frame_s, np.delete(coefficients, 2, axis=1) @ light / frame_s


@dataclass(frozen=True, eq=False)
class Light:
    """What is seen of one stare, DN per second without bias and dark; arrays of shape (n_frame, ...).

    Attributes
    ----------
    bands : tuple of str
        The whole range first.
    flux, sd, mean : ndarray, shape (n_frame, n_band)
        Drawn; standard deviation of its own noise; without any.
    spectrum, spectrum_sd, spectrum_mean : ndarray of float32, shape (n_frame, n_element)
        The same in resolution elements.
    element_nm : ndarray, shape (n_element,)
    """

    bands: tuple[str, ...]
    flux: Float
    sd: Float
    mean: Float
    spectrum: NDArray[np.float32]
    spectrum_sd: NDArray[np.float32]
    spectrum_mean: NDArray[np.float32]
    element_nm: Float


def seen(staring: StareExpectation, bands_nm: Sequence[tuple[float, float]], draw: Draw) -> Light:
    """One stare in bands and resolution elements, all from the same draws of pixels.

    Parameters
    ----------
    staring : StareExpectation
    bands_nm : sequence of (float, float)
        From the first wavelength to before the last, nm; pixels that saturate count nowhere.
    draw : callable
        Draws the same pixels whatever the sums.

    Raises
    ------
    InputError
        For a band without a pixel.
    """
    quiet, used = staring.quiet, staring.used.astype(np.float64)
    rows = []
    for low, high in bands_nm:
        row = used * ((quiet.wavelength_nm >= low) & (quiet.wavelength_nm < high))
        if not row.any():
            raise InputError.of("bands_nm", (low, high), f"a band with usable pixels{quiet.saturation_clause}")
        rows.append(row)
    elements = used * (quiet.element == np.arange(quiet.element_wavelength_nm.size)[:, None])
    filled = np.flatnonzero(elements.any(axis=1))
    spectrum, spectrum_sd, spectrum_mean = staring.net(elements[filled], draw, np.float32)
    # Elements hold every pixel once, so that their sum is all there is.
    whole = spectrum.sum(axis=1, dtype=np.float64), *staring.expected(used[None])
    parts = staring.net(np.array(rows).reshape(len(rows), used.size), draw) if rows else np.zeros((3, len(whole[0]), 0))
    flux, sd, mean = (np.column_stack(both) for both in zip(whole, parts, strict=True))
    low, high = quiet.wavelength_nm[[0, -1]]
    return Light(
        (f"{low:.0f}-{high:.0f} nm", *(f"{a:g}-{b:g} nm" for a, b in bands_nm)),
        flux,
        sd,
        mean,
        spectrum,
        spectrum_sd,
        spectrum_mean,
        quiet.element_wavelength_nm[filled],
    )
