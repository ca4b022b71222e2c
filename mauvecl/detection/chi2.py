"""Chi-squared statistics of pixels, of resolution elements, relative to a noisy exposure, and of the MauveSim paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import orth, solve_triangular

from mauvecl.detection.distributions import QuadraticForm
from mauvecl.detection.statistics import Differences, Setting, Statistic
from mauvecl.host.arrays import Float
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    from mauvecl.host.exposure.expectation import Expectation

#: Relative width of the groups of pixels, by ratio of true to assumed variance, in closed forms.
GROUP_WIDTH = 0.005


class Chi2(Statistic):
    """Sum over pixels of the squared difference divided by its variance."""

    name = "chi2"
    definition: ClassVar[str] = "sum over pixels of (observed - reference)^2 / variance"
    label: ClassVar[str] = "χ² over pixels"

    def dof(self, setting: Setting) -> int:
        return int(setting.used.sum()) - setting.n_free

    def check(self, setting: Setting) -> None:
        super().check(setting)
        if (dof := self.dof(setting)) < 1:
            raise InputError(
                f"statistic {self.name!r} has no degrees of freedom: {setting.n_free} free unknowns describe all "
                f"{dof + setting.n_free} sums; use fewer unknowns or standard deviations instead of 'free'",
                key="statistic",
            )

    def form(self, setting: Setting, seen: Differences, flare: Expectation | None = None) -> QuadraticForm:
        true, scatter = seen.variance * setting.used, seen.scatter
        model = true if seen.estimated else self.variance(setting) * setting.used
        delta, model, true = (self._grouped(setting, values) for values in (seen.mean, model, true))
        counted = (model > 0) & (true > 0)
        delta, model, true = delta[counted], model[counted], true[counted]
        if setting.nuisances:
            if scatter is not None:
                scatter = self._grouped(setting, scatter * setting.used)[:, counted]
            return self._marginal_form(setting, counted, (delta, model, true), scatter)
        return QuadraticForm(true / model, delta / np.sqrt(true))

    def _marginal_form(
        self, setting: Setting, counted: NDArray[np.bool_], moments: tuple[Float, Float, Float], scatter: Float | None
    ) -> QuadraticForm:
        """Return the distribution of x^T C^-1 x for normal x.

        `counted` masks the terms of x, and `moments` are the mean, model's variance and true variance of those counted.
        """
        nuisances, (delta, model, true) = setting.nuisances, moments
        assert nuisances is not None
        if scatter is None and not delta.any() and np.array_equal(model, true):
            return QuadraticForm(np.ones(delta.size - nuisances.free), np.zeros(delta.size - nuisances.free))
        scale = np.sqrt(model)

        def projection() -> tuple[Float, Float]:
            spectra = self._grouped(setting, nuisances.spectra * setting.used)[:, counted]
            return spectra, nuisances.rows(model, spectra) * scale

        # The nodes of an integral over drawn factors share the model's variances.
        terms = np.packbits(counted).tobytes().hex()
        spectra, rows = setting.cached(f"projection of {self.name} on {terms}", projection)
        drawn = (nuisances.finite(spectra) if scatter is None else scatter) / scale
        ratio, moved = true / model, delta / scale
        groups, outside = _span(np.vstack([spectra / scale, drawn, moved]), ratio)
        # Components, covariance and quadratic form within the span; a group's basis is zero at other pixels.
        vectors = np.vstack([rows, drawn, moved])
        inside = np.hstack([vectors[:, members] @ basis for members, basis in groups])
        subtracted, scattered, moved = np.split(inside, (len(rows), len(rows) + len(drawn)))
        noise, end = scattered.T @ scattered, 0
        for members, basis in groups:
            start, end = end, end + basis.shape[1]
            noise[start:end, start:end] += basis.T @ (ratio[members, None] * basis)
        root = np.linalg.cholesky(noise)
        weight, vectors = np.linalg.eigh(root.T @ root - (subtracted @ root).T @ (subtracted @ root))
        # Projected-out directions have no weight.
        large = weight > 1e-9 * weight[-1]
        shift = vectors.T @ solve_triangular(root, moved[0], lower=True)
        return QuadraticForm(np.append(weight[large], outside), np.append(shift[large], np.zeros(outside.size)))

    def values(self, setting: Setting, x: Float, variance: Float, flare: Expectation | None = None) -> Float:
        x, variance = x * setting.used, variance * setting.used
        subtracted = np.sum((x @ self.subtracted_rows(setting).T) ** 2, axis=-1)
        x, variance = (self._grouped(setting, values) for values in (x, variance))
        total = np.sum(np.divide(x**2, variance, out=np.zeros_like(x), where=variance > 0), axis=-1)
        return np.asarray(total - subtracted)

    def subtracted_rows(self, setting: Setting) -> Float:
        """Return the weights per DN of the sums whose squares marginalisation subtracts, shape (k, n_pixel).

        The weights apply to used pixels. They are equal within an element if the statistic is `by_element`.
        """
        if not setting.nuisances:
            return np.zeros((0, setting.used.size))
        of_pixels = self.variance(setting), setting.nuisances.spectra
        model, spectra = (self._grouped(setting, values * setting.used) for values in of_pixels)
        return self._per_pixel(setting, setting.nuisances.rows(model, spectra))

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> tuple[Any, Float]:
        from scipy.sparse import eye_array

        directions = eye_array(setting.used.size, format="csr")[setting.used]
        return directions, np.ones(directions.shape[0])

    def square_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        """Return the coefficient of each pixel's squared difference, per DN^2, shape (n_pixel,)."""
        model = self._grouped(setting, self.variance(setting) * setting.used)
        inverse = np.divide(1.0, model, out=np.zeros_like(model), where=model > 0)
        weights = self._per_pixel(setting, inverse) - np.sum(self.subtracted_rows(setting) ** 2, axis=0)
        return np.asarray(weights * setting.used)

    def _grouped(self, setting: Setting, values: Float) -> Float:
        """Convert values per pixel, along the last axis, to values per squared term."""
        if not self.by_element:
            return values
        starts = np.flatnonzero(np.append(True, np.diff(setting.quiet.element) > 0))
        return np.asarray(np.add.reduceat(values, starts, axis=-1))

    def _per_pixel(self, setting: Setting, values: Float) -> Float:
        """Convert values per squared term to values per pixel."""
        if not self.by_element:
            return values
        return np.asarray(values[..., np.unique(setting.quiet.element, return_inverse=True)[1]])


def _span(vectors: Float, ratio: Float) -> tuple[list[tuple[NDArray[np.intp], Float]], Float]:
    """Return an orthonormal basis of vectors' parts in groups of pixels, and the weights outside its span.

    The vectors, (k, n), are in standard deviations of each value, and `ratio` holds true variances divided by the
    model's. The basis, of m vectors in all, is the members of each group and the vectors there, (n_member, m_group).
    The weights, (n - m,), are the mean of the group, which preserves the sum. The result is exact if ratios are equal
    within groups. Groups are `GROUP_WIDTH` wide, and the coupling of the span to the rest changes eigenvalues by the
    square of this width.
    """
    group = np.floor(np.log(ratio / ratio.min()) / GROUP_WIDTH)
    order = np.argsort(group, kind="stable")
    groups, outside = [], []
    for members in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        basis = orth(vectors[:, members].T, rcond=1e-13)
        groups.append((members, basis))
        n_outside = members.size - basis.shape[1]
        total = float(ratio[members].sum() - ratio[members] @ np.sum(basis**2, axis=1))
        outside.append(np.full(n_outside, total / max(n_outside, 1)))
    return groups, np.concatenate(outside)


class Chi2Element(Chi2):
    """Sum over resolution elements of the squared difference divided by its variance."""

    name = "chi2_element"
    definition: ClassVar[str] = "the same over sums of resolution elements"
    label: ClassVar[str] = "χ² over resolution elements"
    by_element: ClassVar[bool] = True

    def dof(self, setting: Setting) -> int:
        return int(np.unique(setting.quiet.element[setting.used]).size) - setting.n_free

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> tuple[Any, Float]:
        element = setting.quiet.element
        member = element[None, :] == np.unique(element[setting.used])[:, None]
        directions = member * np.sqrt(self.variance(setting)) * setting.used
        return directions / np.linalg.norm(directions, axis=1)[:, None], np.ones(len(directions))


class Chi2Pair(Chi2):
    """Chi-squared over pixels of the difference between two exposures."""

    name = "chi2_pair"
    definition: ClassVar[str] = "against a noisy quiescent exposure: twice the variance"
    label: ClassVar[str] = "χ² against a noisy exposure"
    paired: ClassVar[bool] = True


#: FWHM of the paper's smoothing, nm.
SMOOTHING_NM = 10.5
#: Centres per standard deviation of the smoothing, and points of the interpolation between them, which give the sum
#: over all pixels to 1e-4.
STEPS_PER_SIGMA = 2
POINTS = 8
#: Relative error of the sum's mean above which every pixel becomes a centre.
MAX_MEAN_ERROR = 1e-4
#: Variance, relative to the largest, below which a mode is due to rounding.
MIN_MODE_VARIANCE = 1e-10


@dataclass(frozen=True, eq=False)
class Smoothing:
    """A Gaussian smoothing at a few centres that represents the sum of squares over all pixels.

    Smoothed spectra vary slowly, so their squares are interpolated between the centres. The sum over all pixels is then
    a weighted sum over the centres.
    """

    centres: NDArray[np.int64]  # pixels at which the smoothed spectrum is computed, shape (n_centre,)
    between: Float  # interpolation of squares from centres to pixels, shape (n_pixel, n_centre)
    sigma: float  # standard deviation of the smoothing, pixels
    weights: csr_array  # smoothing weights, zero for unused pixels, shape (n_centre, n_pixel)

    @cached_property
    def rows(self) -> Float:
        """Dense array of the weights."""
        return np.asarray(self.weights.toarray())

    @classmethod
    def of(cls, x: Expectation, used: NDArray[np.bool_], flares: Sequence[Expectation] = ()) -> Smoothing:
        """Make the smoothing of the used pixels of spectra like `x`, accurate for the sums of `flares`."""
        n = x.wavelength_nm.size
        sigma = SMOOTHING_NM / np.sqrt(8 * np.log(2)) / float(np.median(np.diff(x.wavelength_nm)))
        step = max(int(sigma / STEPS_PER_SIGMA), 1)
        rows = _rows(n, sigma)
        centres, between = _interpolation(n, step)
        smoothing = cls(centres, between, sigma, rows[centres].multiply(used).tocsr())
        for flare in flares or (x,):
            # Non-negative factors of the centres must reproduce the mean of the sum over all pixels.
            scale, squares = smoothing.scale(flare), rows.power(2) @ (used * flare.variance_dn2)
            exact, mean = float(smoothing._inverse_flare(flare) @ squares), float(scale @ squares[centres])
            if (scale < 0).any() or abs(mean - exact) > MAX_MEAN_ERROR * exact:
                return cls(np.arange(n), np.eye(n), sigma, rows.multiply(used).tocsr())
        return smoothing

    def _inverse_flare(self, flare: Expectation) -> Float:
        """Return the inverse of the smoothed flare at every pixel, for squares of DN; zero where there is no light."""
        from scipy.ndimage import gaussian_filter1d

        expected = gaussian_filter1d(flare.recorded_light_dn, self.sigma, mode="nearest")
        return np.asarray(1.0 / np.where(expected > 0, expected, np.inf) / flare.exposure_s)

    def scale(self, flare: Expectation) -> Float:
        """Return the factors of squared smoothed DN in the sum of (F - Q)^2 / F in DN/s, shape (n_centre,)."""
        return np.asarray(self._inverse_flare(flare) @ self.between)

    def modes(self, scale: Float, variance: Float) -> tuple[Float, Float]:
        """Return the variances of the sum's independent modes, and their weights per centre, (n_centre, n_mode)."""
        # The covariance of the smoothed values times the roots of their factors.
        half = self.weights * np.sqrt(scale)[:, None]
        values, vectors = np.linalg.eigh(((half * variance) @ half.T).toarray())
        large = values > MIN_MODE_VARIANCE * values[-1]
        return values[large], vectors[:, large]

    def bands(self, n_padded: int, chunk: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """Return the weights of unfinished centres per chunk of pixels, and the number of centres each chunk finishes.

        The shapes are (n_chunk, n_slot, chunk) and (n_chunk,). Slot 0 belongs to the first unfinished centre.
        """
        n_centre, n_pixel = self.rows.shape
        used = self.rows != 0
        has_pixels = used.any(axis=1)
        first = np.where(has_pixels, used.argmax(axis=1), self.centres)
        last = np.where(has_pixels, n_pixel - 1 - used[:, ::-1].argmax(axis=1), self.centres)
        ends = np.arange(chunk, n_padded + 1, chunk)
        # Centres are finished in order.
        finished = np.searchsorted(np.maximum.accumulate(last), ends - 1, side="right")
        begun = np.searchsorted(np.minimum.accumulate(first[::-1])[::-1], ends, side="left")
        before = np.append(0, finished[:-1])
        slots = -(-int((begun - before).max()) // 4) * 4
        weights = np.zeros((ends.size, slots, chunk), np.float32)
        padded = np.zeros((n_centre, n_padded), np.float32)
        padded[:, :n_pixel] = self.rows
        for c, (low, high) in enumerate(zip(before, begun, strict=True)):
            weights[c, : high - low] = padded[low:high, c * chunk : (c + 1) * chunk]
        return weights, np.diff(finished, prepend=0).astype(np.uint32)


@lru_cache(maxsize=4)
def _interpolation(n: int, step: int) -> tuple[NDArray[np.int64], Float]:
    """Return evenly spaced pixels, including both ends, and the interpolation from them to all pixels.

    The interpolation, (n, n_centre), is by Lagrange polynomials through the nearest eight centres.
    """
    even = np.linspace(0, n - 1, -(-(n - 1) // step) + 1).round().astype(int)
    # One more centre next to each end, where interpolation is least accurate.
    centres = np.unique([*even, step // 2, n - 1 - step // 2]) if step > 1 else np.arange(n)
    points = min(POINTS, centres.size)
    between = np.zeros((n, centres.size))
    first = np.clip(np.searchsorted(centres, np.arange(n), side="right") - points // 2, 0, centres.size - points)
    near = first[:, None] + np.arange(points)
    at, diagonal = centres[near], np.eye(points, dtype=bool)
    ratios = (np.arange(n)[:, None, None] - at[:, None, :]) / np.where(diagonal, 1, at[:, :, None] - at[:, None, :])
    np.put_along_axis(between, near, np.where(diagonal, 1.0, ratios).prod(axis=2), axis=1)
    between.setflags(write=False)
    return centres, between


@lru_cache(maxsize=2)
def _rows(n: int, sigma: float) -> csr_array:
    """Return the weights of pixels in the smoothed spectrum; cached, as the computation takes a tenth of a second."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.sparse import csr_array

    return csr_array(gaussian_filter1d(np.eye(n), sigma, axis=0, mode="nearest"))


class Paper(Statistic):
    """Sum of (F - Q)^2 / F of smoothed spectra, where F is an exposure with a flare and Q one without."""

    name = "paper"
    definition: ClassVar[str] = (
        "the MauveSim paper's sum of (F - Q)^2 / F on smoothed spectra in DN/s, Q a noisy exposure, F flaring; a few "
        "faint pixels make most of it (see `effective_terms`)"
    )
    label: ClassVar[str] = "the paper's sum on smoothed spectra"
    shaped: ClassVar[bool] = True
    paired: ClassVar[bool] = True

    def smoothing(self, setting: Setting) -> Smoothing:
        """Return the paper's smoothing of the used pixels."""
        return setting.cached("smoothing", lambda: Smoothing.of(setting.quiet, setting.used, setting.flares))

    def scale(self, setting: Setting, flare: Expectation | None) -> Float:
        """Return the factors of the squares of smoothed DN, shape (n_centre,)."""
        assert flare is not None
        return self.smoothing(setting).scale(flare)

    def dof(self, setting: Setting) -> int:
        return int(setting.used.sum())

    def form(self, setting: Setting, seen: Differences, flare: Expectation | None = None) -> QuadraticForm:
        smoothing, scale = self.smoothing(setting), self.scale(setting, flare)
        weight, vectors = smoothing.modes(scale, seen.variance)
        mean = np.sqrt(scale) * (smoothing.weights @ seen.mean)
        return QuadraticForm(weight, mean @ vectors / np.sqrt(weight))

    def values(self, setting: Setting, x: Float, variance: Float, flare: Expectation | None = None) -> Float:
        return np.asarray((x @ self.smoothing(setting).rows.T) ** 2 @ self.scale(setting, flare))

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> tuple[Any, Float]:
        sd, scale = np.sqrt(self.variance(setting)) * setting.used, self.scale(setting, flare)
        square, vectors = self.smoothing(setting).modes(scale, sd**2)
        modes = vectors.T @ (np.sqrt(scale)[:, None] * self.smoothing(setting).rows)
        return modes * sd / np.sqrt(square)[:, None], square

    def square_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        return np.asarray(self.scale(setting, flare) @ self.smoothing(setting).rows ** 2)
