"""Chi-squared statistics of pixels, of resolution elements, and relative to a noisy exposure."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from mauvecl.statistics.distributions import QuadraticForm
from mauvecl.statistics.statistic import Differences, Float, QuadraticStatistic, Setting, Tilt

if TYPE_CHECKING:
    from mauvecl.host.expectation import Expectation


#: Relative width of the groups of pixels, by ratio of true to assumed variance, in closed forms.
GROUP_WIDTH = 0.005


class Chi2(QuadraticStatistic):
    """Sum over pixels of the squared difference divided by its variance."""

    name = "chi2"
    definition: ClassVar[str] = "sum over pixels of (observed - reference)^2 / variance"
    label: ClassVar[str] = "chi2 over pixels"
    kernel_sum: ClassVar[str | None] = "chi2"

    def dof(self, setting: Setting) -> int:
        return int(setting.used.sum()) - self._free(setting)

    @staticmethod
    def _free(setting: Setting) -> int:
        return setting.nuisances.free if setting.nuisances else 0

    def form(self, setting: Setting, seen: Differences, flare: Expectation | None = None) -> QuadraticForm:
        true, scatter = seen.variance * setting.used, seen.scatter
        model = true if seen.estimated else self.variance(setting) * setting.used
        delta, model, true = (self._grouped(setting, values) for values in (seen.mean, model, true))
        counts = (model > 0) & (true > 0)
        delta, model, true = delta[counts], model[counts], true[counts]
        if setting.nuisances:
            if scatter is not None:
                scatter = self._grouped(setting, scatter * setting.used)[:, counts]
            return self._marginal_form(setting, counts, delta, model, true, scatter)
        return QuadraticForm(true / model, delta / np.sqrt(true))

    def _marginal_form(
        self,
        setting: Setting,
        counts: NDArray[np.bool_],
        delta: Float,
        model: Float,
        true: Float,
        scatter: Float | None,
    ) -> QuadraticForm:
        """Return the distribution of x^T C^-1 x for normal x of mean `delta`, true variance and nuisance scatter."""
        nuisances = setting.nuisances
        assert nuisances is not None
        if scatter is None and not delta.any() and np.array_equal(model, true):
            size = delta.size - nuisances.free
            return QuadraticForm(np.ones(size), np.zeros(size))
        scale = np.sqrt(model)

        def projection() -> tuple[Float, Float]:
            spectra = self._spectra(setting)[:, counts]
            return spectra, nuisances.rows(model, spectra) * scale

        # The nodes of an integral over drawn factors share the model's variances.
        pixels = np.packbits(counts).tobytes().hex()
        spectra, rows = setting.cached(f"projection of {self.name} on {pixels}", projection)
        drawn = (nuisances.finite(spectra) if scatter is None else scatter) / scale
        basis, rest = _span(np.vstack([spectra / scale, drawn, delta / scale]), true / model)
        # Covariance and quadratic form within the span.
        noise = basis.T @ ((true / model)[:, None] * basis) + (drawn @ basis).T @ (drawn @ basis)
        taken, root = rows @ basis, np.linalg.cholesky(noise)
        weight, vectors = np.linalg.eigh(root.T @ root - (taken @ root).T @ (taken @ root))
        # Projected-out directions have no weight.
        kept = weight > 1e-9 * weight[-1]
        shift = vectors.T @ solve_triangular(root, basis.T @ (delta / scale), lower=True)
        weights, shifts = np.append(weight[kept], rest), np.append(shift[kept], np.zeros(rest.size))
        return QuadraticForm(weights, shifts)

    def values(self, setting: Setting, x: Float, variance: Float, flare: Expectation | None = None) -> Float:
        x, variance = x * setting.used, variance * setting.used
        subtracted = np.sum((x @ self.subtracted_rows(setting).T) ** 2, axis=-1)
        x, variance = (self._grouped(setting, values) for values in (x, variance))
        total = np.sum(np.divide(x**2, variance, out=np.zeros_like(x), where=variance > 0), axis=-1)
        return np.asarray(total - subtracted)

    def subtracted_rows(self, setting: Setting) -> Float:
        if not setting.nuisances:
            return super().subtracted_rows(setting)
        model = self._grouped(setting, self.variance(setting) * setting.used)
        return self._per_pixel(setting, setting.nuisances.rows(model, self._spectra(setting)))

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> Tilt:
        from scipy.sparse import eye_array

        directions = eye_array(setting.used.size, format="csr")[setting.used]
        return Tilt(directions, np.ones(directions.shape[0]))

    def square_weights(self, setting: Setting, flare: Expectation | None = None) -> Float:
        model = self._grouped(setting, self.variance(setting) * setting.used)
        inverse = np.divide(1.0, model, out=np.zeros_like(model), where=model > 0)
        weights = self._per_pixel(setting, inverse) - np.sum(self.subtracted_rows(setting) ** 2, axis=0)
        return np.asarray(weights * setting.used)

    def _grouped(self, setting: Setting, values: Float) -> Float:
        """Convert values per pixel, along the last axis, to values per squared term."""
        return values

    def _per_pixel(self, setting: Setting, values: Float) -> Float:
        """Convert values per squared term to values per pixel."""
        return values

    def _spectra(self, setting: Setting) -> Float:
        """Return the nuisance spectra per squared term."""
        assert setting.nuisances is not None
        return self._grouped(setting, setting.nuisances.spectra * setting.used)


def _span(vectors: Float, ratio: Float) -> tuple[Float, Float]:
    """Return an orthonormal basis of the vectors' parts in groups of pixels, and the weights outside its span.

    Parameters
    ----------
    vectors : ndarray, shape (k, n)
        Vectors in standard deviations of each value.
    ratio : ndarray, shape (n,)
        True variances divided by the model's.

    Returns
    -------
    basis : ndarray, shape (n, m)
    rest : ndarray, shape (n - m,)
        Coefficients of squares along the directions outside the span: the mean of the group, which preserves the sum.

    Notes
    -----
    The result is exact if ratios are equal within groups. Groups are `GROUP_WIDTH` wide, and the coupling of the span
    to the rest changes eigenvalues by the square of this width.
    """
    order = np.argsort(ratio)
    group = np.floor(np.log(ratio[order] / ratio[order[0]]) / GROUP_WIDTH)
    parts, rest = [], []
    for members in np.split(order, np.flatnonzero(np.diff(group)) + 1):
        basis, sizes, _ = np.linalg.svd(vectors[:, members].T, full_matrices=False)
        basis = basis[:, sizes > 1e-13 * sizes[0]] if sizes[0] > 0 else basis[:, :0]
        part = np.zeros((ratio.size, basis.shape[1]))
        part[members] = basis
        parts.append(part)
        left = members.size - basis.shape[1]
        total = float(ratio[members].sum() - ratio[members] @ np.sum(basis**2, axis=1))
        rest.append(np.full(left, total / max(left, 1)))
    return np.hstack(parts), np.concatenate(rest)


class Chi2Element(Chi2):
    """Sum over resolution elements of the squared difference divided by its variance."""

    name = "chi2_element"
    definition: ClassVar[str] = "the same over sums of 10.5 nm resolution elements"
    label: ClassVar[str] = "chi2 over 10.5 nm elements"
    kernel_sum: ClassVar[str | None] = "chi2_element"
    by_element: ClassVar[bool] = True

    def dof(self, setting: Setting) -> int:
        return int(np.unique(setting.quiet.element[setting.used]).size) - self._free(setting)

    def tilt(self, setting: Setting, flare: Expectation | None = None) -> Tilt:
        element = setting.quiet.element
        member = element[None, :] == np.unique(element[setting.used])[:, None]
        directions = member * np.sqrt(self.variance(setting)) * setting.used
        return Tilt(directions / np.linalg.norm(directions, axis=1)[:, None], np.ones(len(directions)))

    def _grouped(self, setting: Setting, values: Float) -> Float:
        starts = np.flatnonzero(np.append(True, np.diff(setting.quiet.element) > 0))
        return np.asarray(np.add.reduceat(values, starts, axis=-1))

    def _per_pixel(self, setting: Setting, values: Float) -> Float:
        return np.asarray(values[..., np.unique(setting.quiet.element, return_inverse=True)[1]])


class Chi2Pair(Chi2):
    """Chi-squared over pixels of the difference between two exposures."""

    name = "chi2_pair"
    definition: ClassVar[str] = "against a noisy quiescent exposure: twice the variance"
    label: ClassVar[str] = "chi2 against a noisy exposure"
    kernel_sum: ClassVar[str | None] = "chi2_pair"
    paired: ClassVar[bool] = True
    marginal: ClassVar[bool] = False
