"""Frames of a stare as sums of components, their light curves and spectra.

No frame needs its own expectation. Counts are sums of independent components: the star, the sky, the dark current,
neighbours of the star, and flares of several temperatures. The spectrum of a component is the same in all frames, and
only its strength, its coefficient, changes. The mean and all higher cumulants of a pixel, and of a weighted sum of
pixels, are therefore linear in the coefficients of a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.flares import MOST_TEMPERATURES
from mauvecl.host.arrays import Float, set_read_only
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.flares.stare import Stare
    from mauvecl.host.exposure.expectation import Expectation


#: Components of every frame; one flare component per temperature follows.
STEADY = ("star", "sky", "dark", "neighbours")
#: Largest number of weighted sums that are drawn together.
MOST_STATISTICS = 8
#: Variance and fourth cumulant of the rounding error, by their order, DN^order.
ROUNDING = {2: 1.0 / 12.0, 4: -1.0 / 120.0}


def known_strengths(stare: Stare, quiet: Expectation) -> Float:
    """Return known strengths of star, sky, dark, and neighbours and flares in each frame, shape (n_frame, 4)."""
    return np.column_stack([stare.light * stare.star, stare.light * stare.sky, stare.dark_factor(quiet), stare.light])


@dataclass(frozen=True, eq=False)
class Components:
    """Spectra of a stare's frames, and weights of the sums that are computed for each frame.

    The statistics of a frame are y_k = sum_p weights_kp (raw_p - mean_raw_p), with the mean raw counts of the quiescent
    star at the conditions of its expectation.
    """

    quiet: Expectation  #: a single frame of the quiescent star, for which the coefficients are one
    flare_electrons: Float  #: mean electrons per frame of flares of unit amplitude by temperature, (n_flare, n_pixel)
    weights: Float  #: linearly independent, and zero in pixels that saturate, shape (n_statistic, n_pixel)

    def __post_init__(self) -> None:
        n_pixel = self.quiet.wavelength_nm.size
        if self.quiet.n_frames != 1:
            raise InputError.of("n_frames", self.quiet.n_frames, "one frame of the stare")
        for name, text, least in (("flare_electrons", "flare spectra", 0), ("weights", "spectral weights", 1)):
            spectra = np.asarray(getattr(self, name), np.float64)
            if spectra.ndim != 2 or spectra.shape[1] != n_pixel or len(spectra) < least:
                raise InputError(f"{text} must have the shape (n, {n_pixel}), not {spectra.shape}", key=name)
            set_read_only(self, **{name: spectra})
        if len(self.flare_electrons) > MOST_TEMPERATURES:
            raise InputError.of("flare_electrons", len(self.flare_electrons), f"at most {MOST_TEMPERATURES} spectra")
        flares, weights, finite = self.flare_electrons, self.weights, "must be finite, but those of pixel {} are not"
        for key, wrong, fault in (
            ("flare_electrons", ~np.isfinite(flares), f"flare spectra {finite}"),
            ("weights", ~np.isfinite(weights), f"spectral weights {finite}"),
            ("flare_electrons", flares < 0, "flare spectra must be 0 or above, but a flare takes light from pixel {}"),
            ("weights", self.quiet.saturated & (weights != 0), "pixel {} saturates, so its weights must be 0"),
        ):
            if wrong.any():
                raise InputError(fault.format(int(np.argmax(wrong.any(axis=0)))), key=key)

    @classmethod
    def of(cls, quiet: Expectation, flares: Sequence[Expectation], weights: Float) -> Self:
        """Return the components from a frame of the quiescent star and frames with flares of unit amplitude."""
        added = [flare.source_electrons - quiet.source_electrons for flare in flares]
        return cls(quiet, np.reshape(added, (len(flares), quiet.wavelength_nm.size)), weights)

    @property
    def n_statistics(self) -> int:
        """Number of sums per frame."""
        return len(self.weights)

    @property
    def n_flares(self) -> int:
        """Number of flare temperatures."""
        return len(self.flare_electrons)

    @cached_property
    def mean_dn(self) -> Float:
        """Mean of each component at a coefficient of one, DN, shape (4 + n_flare, n_pixel); rows as `STEADY`."""
        x = self.quiet
        steady = [x.source_electrons, x.sky_electrons, np.zeros_like(x.dark_dn), x.neighbour_electrons]
        light = np.vstack([*steady, self.flare_electrons])
        light *= x.gain_dn_per_electron
        light[2] = x.dark_dn
        return light

    def pixel_cumulants(self, order: int) -> tuple[Float, Float]:
        """Return the cumulants of each pixel's count, of order 1 to 5.

        They are the constant part of read noise and rounding, (n_pixel,), and those of each component at a coefficient
        of one, (4 + n_flare, n_pixel).
        """
        x = self.quiet
        photon = x.gain_dn_per_electron ** (order - 1)
        if order > 2 and x.photon_noise == "gaussian":
            photon = np.zeros_like(photon)
        by_component = self.mean_dn * photon
        by_component[2] = x.dark_step_dn ** (order - 1) * x.dark_dn
        constant = np.full_like(photon, ROUNDING.get(order, 0.0))
        if order == 2:
            constant += x.read_noise_dn**2
        return constant, by_component

    def sum_cumulants(self, order: int) -> tuple[Float, Float]:
        """Return the joint cumulants of the weighted sums, with as many axes of n_statistic as the order.

        They are the constant part, and a row for each component at a coefficient of one, as of `pixel_cumulants`.
        """
        constant, by_component = self.pixel_cumulants(order)
        rows = np.vstack([constant, by_component])
        letters = "ijklm"[:order]
        sums = np.einsum(
            ",".join(f"{a}p" for a in letters) + f",cp->c{letters}", *[self.weights] * order, rows, optimize=True
        )
        return sums[0], sums[1:]

    @cached_property
    def component_means(self) -> Float:
        """Mean sums of each component at a coefficient of one, shape (4 + n_flare, n_statistic)."""
        return self.sum_cumulants(1)[1]

    def coefficients(self, stare: Stare, flare: Float | None = None) -> Float:
        """Return the known coefficients of star, sky, dark, neighbours and flares, shape (n_frame, 4 + n_flare).

        `flare` holds the amplitude of each flare spectrum in each frame, (n_frame, n_flare).
        """
        factors = np.zeros((stare.n_frames, len(STEADY) + self.n_flares))
        factors[:, : len(STEADY)] = known_strengths(stare, self.quiet)
        if flare is not None:
            if np.shape(flare) != (stare.n_frames, self.n_flares):
                raise InputError(
                    f"flare coefficients must have the shape {(stare.n_frames, self.n_flares)}, not {np.shape(flare)}",
                    key="flare",
                )
            factors[:, len(STEADY) :] = stare.light[:, None] * flare
        return factors

    def means(self, coefficients: Float) -> Float:
        """Return the mean statistics, (..., n_statistic), for coefficients of shape (..., 4 + n_flare)."""
        reference = np.zeros(len(STEADY) + self.n_flares)
        reference[: len(STEADY)] = 1.0
        return np.asarray((coefficients - reference) @ self.component_means)

    def covariance(self, coefficients: Float) -> Float:
        """Return the covariances of the statistics of frames, shape (..., n_statistic, n_statistic)."""
        constant, by_component = self.sum_cumulants(2)
        return np.asarray(constant + np.tensordot(coefficients, by_component, 1))

    def jittered_covariance(self, coefficients: Float, stare: Stare) -> Float:
        """Return `covariance` with the jitters of a stare."""
        covariance, directions = self.covariance(coefficients), self.directions(coefficients)
        for of, sd in stare.jitters.items():
            moved = sd * directions[of]
            covariance = covariance + moved[..., :, None] * moved[..., None, :]
        return covariance

    def directions(self, coefficients: Float) -> dict[str, Float]:
        """Return the derivatives of the mean statistics, each of shape (..., n_statistic).

        They are with respect to relative changes of the star, of all light and of the sky, and to the temperature.
        """
        mean = self.component_means
        light = np.delete(coefficients, 2, axis=-1) @ np.delete(mean, 2, axis=0)
        slope = self.quiet.conditions["dark_slope_per_c"]
        return {
            "star": coefficients[..., :1] * mean[0],
            "light": light,
            "sky": coefficients[..., 1:2] * mean[1],
            "temperature": slope * coefficients[..., 2:3] * mean[2],
        }


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
        """Components whose only sum adds up the used pixels."""
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
        constant, by_component = (values[..., self.used] for values in self._bare.pixel_cumulants(2))
        spectra, power = self._bare.mean_dn[len(STEADY) :, self.used], 0.0
        lit = np.flatnonzero(flare.any(axis=1))
        for begin in range(0, lit.size, BLOCK):
            rows = lit[begin : begin + BLOCK]
            variance = constant + self.coefficients[rows, : len(STEADY)] @ by_component[: len(STEADY)]
            power += float(np.sum((self.stare.light[rows, None] * flare[rows] @ spectra) ** 2 / variance))
        return float(np.sqrt(power))

    def net(self, weights: Float, draw: Draw, kind: type[np.floating[Any]] = np.float64) -> tuple[Any, Any, Any]:
        """Draw net light in weighted sums of pixels; return it with its standard deviation and mean, DN/s.

        Net light is the raw count minus bias and dark current at the known temperature; it includes the sky and
        neighbours. Weights, (n_sum, n_pixel), are zero in pixels that are not used. The standard deviation is that of
        photons, dark current and read noise, without jitter. Arrays are of type `kind` and shape (n_frame, n_sum).
        """
        frame_s, coefficients = self.stare.frame_s, self.coefficients
        net, sd, mean = (np.empty((self.stare.n_frames, len(weights)), kind) for _ in range(3))
        for begin in range(0, len(weights), MOST_STATISTICS):
            part = slice(begin, begin + MOST_STATISTICS)
            rows = weights[part]
            first = self._bare.mean_dn @ rows.T
            drawn = np.asarray(draw(self.components(rows)), np.float64)
            # The sums are relative to the quiescent light at the temperature of its expectation.
            net[:, part] = (drawn + first[0] + first[1] + first[3] + (1.0 - coefficients[:, 2:3]) * first[2]) / frame_s
            sd[:, part], mean[:, part] = self.expected(rows)
        return net, sd, mean

    def raw(self, draw: Draw) -> Float:
        """Return drawn raw counts of each pixel, DN, shape (n_frame, n_pixel); saturated pixels hold their mean."""
        frames = np.tile(self.quiet.recorded_dn, (self.stare.n_frames, 1))
        pixels, of_one_pixel = np.flatnonzero(self.used), np.eye(self.used.size)
        for begin in range(0, pixels.size, MOST_STATISTICS):
            part = pixels[begin : begin + MOST_STATISTICS]
            frames[:, part] += draw(self.components(of_one_pixel[part]))
        return frames

    @property
    def mean_raw(self) -> Float:
        """Mean raw counts of each pixel, DN, shape (n_frame, n_pixel)."""
        return np.asarray(self.coefficients @ self._bare.mean_dn + self.quiet.bias_dn)

    def expected(self, weights: Float) -> tuple[Float, Float]:
        """Return standard deviation and mean of the net light in sums of pixels, DN/s, shape (n_frame, n_sum)."""
        frame_s, coefficients = self.stare.frame_s, self.coefficients
        constant, by_component = self._bare.pixel_cumulants(2)
        squares, light = weights.T**2, np.delete(self._bare.mean_dn, 2, axis=0) @ weights.T
        sd = np.sqrt(constant @ squares + coefficients @ (by_component @ squares))
        return sd / frame_s, np.delete(coefficients, 2, axis=1) @ light / frame_s


@dataclass(frozen=True, eq=False)
class LightCurves:
    """Light curves and spectra of a stare, DN/s without bias and dark current."""

    bands: tuple[str, ...]  # the first is the whole range
    #: Shape (n_frame, n_band); drawn light, standard deviation of its noise, and light without noise.
    flux: Float
    sd: Float  # shape (n_frame, n_band)
    mean: Float  # shape (n_frame, n_band)
    quiescent: Float  # light of a frame without flares and changes, shape (n_band,)
    #: Shape (n_frame, n_element); the same in resolution elements.
    spectrum: NDArray[np.float32]
    spectrum_sd: NDArray[np.float32]  # shape (n_frame, n_element)
    spectrum_mean: NDArray[np.float32]  # shape (n_frame, n_element)
    element_nm: Float  # shape (n_element,)


def draw_light_curves(
    expectation: StareExpectation, bands_nm: Sequence[tuple[float, float]], draw: Draw
) -> LightCurves:
    """Draw a stare in bands and resolution elements; `draw` draws the same pixels for all sums.

    The upper limit of a band is excluded, and saturated pixels are not used. Raises InputError if a band contains no
    pixel.
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
    total = spectrum.sum(axis=1, dtype=np.float64), *expectation.expected(used[None])
    bands = expectation.net(np.array(rows).reshape(len(rows), used.size), draw)
    flux, sd, mean = (np.column_stack(columns) for columns in zip(total, bands, strict=True))
    low, high = quiet.wavelength_nm[[0, -1]]
    names = (f"{low:.0f}-{high:.0f} nm", *(f"{a:g}-{b:g} nm" for a, b in bands_nm))
    quiescent = np.array([used, *rows]) @ quiet.light_dn / quiet.frame_s
    element_nm = quiet.element_wavelength_nm[filled]
    return LightCurves(
        names, flux=flux, sd=sd, mean=mean, quiescent=quiescent, spectrum=spectrum, spectrum_sd=spectrum_sd,
        spectrum_mean=spectrum_mean, element_nm=element_nm,
    )  # fmt: skip
