"""Fits of single flares: peak, amplitude, half-width, temperature and equivalent duration, with standard errors.

For a given peak and half-width, the frames under the shape add up to one measurement of the flare's spectrum, of which
`results.measurements` finds amplitude and temperature. Peak and half-width follow by least squares from the template
that detected the flare, with the baseline of the search (Levenberg 1944, doi 10.1090/qam/10666; Marquardt 1963, doi
10.1137/0111030; Golub & Pereyra 1973, doi 10.1137/0710036); errors from the inverse of the information. Amplitudes of
flares near the threshold are biased high, because noise contributes to their detection; fits do not correct for that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mauvecl.results.measurements.profile import Profile

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.bank import Bank
    from mauvecl.lightcurve.search.templates import Templates

Float = NDArray[np.float64]

#: Largest number of steps of a fit, and the change of chi-squared at which it has converged.
STEPS, ENOUGH = 30, 1e-3
#: Frames are averaged if at least this many averages remain per half-width.
FINE = 25
#: Initial damping, and its divisor and factor after successful and failed steps.
DAMPING, EASIER, HARDER = 1e-2, 5.0, 4.0
#: Relative step of numerical derivatives.
DIFFERENCE = 1e-3
#: Largest change of peak, in half-widths, and of log half-width in one step.
LARGEST_STEP = 0.5


@dataclass(frozen=True, eq=False)
class FittedFlares:
    """Fitted flares and standard errors; arrays of shape (n,)."""

    peak_s: Float
    peak_error_s: Float
    amplitude: Float  # relative rise of the photons in the band
    amplitude_error: Float
    half_width_s: Float
    half_width_error_s: Float
    temperature_k: Float  # NaN if the templates have only one temperature
    temperature_error_k: Float
    equivalent_duration_s: Float  # proportional to the energy
    equivalent_duration_error_s: Float
    snr: Float


@dataclass(frozen=True, eq=False)
class SingleFlareFit:
    """Least-squares fit of single flares."""

    bank: Bank  # bank of the search, which defines shape, baseline and windows
    templates: Templates  # effect of flares on the sums of a frame

    def run(
        self,
        sums: NDArray[Any],
        start_s: Float,
        *,
        peak_s: ArrayLike,
        half_width_s: ArrayLike,
        variance: Float | None = None,
        curves: Float | None = None,
    ) -> FittedFlares:
        """Fit one flare to each of several light curves.

        Parameters
        ----------
        sums : ndarray, shape (n, n_frame, n_sum)
            Sums less their known mean.
        start_s : ndarray, shape (n_frame,)
        peak_s, half_width_s : array_like, shape (n,)
            Starting points, such as those of the template that detected each flare.
        variance : ndarray, shape (n_frame,), optional
            Variance of each frame's sums; 1 by default.
        curves : ndarray, shape (n_curve, n_frame), optional
            Baseline curves; see `Search`.
        """
        n = len(sums)
        peak, log_width = (np.array(np.broadcast_to(value, n), np.float64) for value in (peak_s, np.log(half_width_s)))
        several = max(1, int(np.exp(log_width.min()) / self.bank.frame_s / FINE)) if n else 1
        sums, start_s, variance, curves = self._averaged(several, sums, start_s, variance, curves)
        weight, level = self._windows(start_s, peak, np.exp(log_width), variance, curves)
        used = weight.any(axis=0)
        weight, level, start_s = weight[:, used], level[:, used], start_s[used]
        edges = np.column_stack([start_s, start_s + several * self.bank.frame_s])
        y = _remove_baseline(np.asarray(sums[:, used], np.float64), weight, level)

        def inner_products(peak: Float, log_width: Float) -> tuple[Float, Float]:
            """Return products of shape and derivatives with each other, (n, 3, 3), and with the sums, (n, 3, K)."""
            width = np.exp(log_width)
            step = DIFFERENCE * width
            here, later, wider = (
                self.bank.shape.mean_over(edges, p[:, None], w[:, None])
                for p, w in ((peak, width), (peak + step, width), (peak, width * np.exp(DIFFERENCE)))
            )
            three = _remove_baseline(
                np.stack([here, (later - here) / DIFFERENCE, (wider - here) / DIFFERENCE], 2), weight, level
            )
            weighted = three * weight[:, :, None]
            return np.einsum("nti,ntj->nij", weighted, three), np.einsum("nti,ntk->nik", weighted, y)

        products = inner_products(peak, log_width)
        log_kelvin, amplitude, gain = self._brightest(products)
        damping = np.full(n, DAMPING)
        going = np.ones(n, np.bool_)
        for _ in range(STEPS):
            information, pull = self._normal(products, amplitude, log_kelvin)
            diagonal = np.einsum("nii->ni", information)
            damped = information + (damping[:, None] * diagonal + 1e-12)[:, :, None] * np.eye(4)
            move = np.linalg.solve(damped, pull[:, :, None])[:, :, 0]
            move = np.where(going[:, None], np.clip(move, -LARGEST_STEP, LARGEST_STEP), 0.0)
            there = peak + move[:, 1] * np.exp(log_width), log_width + move[:, 2]
            tried = inner_products(*there)
            kelvin, best, reached = self._brightest(tried)
            better = going & (reached > gain)
            small = np.abs(reached - gain) < ENOUGH
            peak, log_width, log_kelvin, amplitude, gain = (
                np.where(better, a, b)
                for a, b in zip(
                    (*there, kelvin, best, reached), (peak, log_width, log_kelvin, amplitude, gain), strict=True
                )
            )
            products = tuple(  # type: ignore[assignment]
                np.where(better[:, None, None], a, b) for a, b in zip(tried, products, strict=True)
            )
            damping = np.where(better, damping / EASIER, damping * HARDER)
            going &= ~(small & better) & (damping < 1e6)
            if not going.any():
                break
        information, _ = self._normal(products, amplitude, log_kelvin)
        return self._with_errors(peak, log_width, log_kelvin, amplitude, gain, information)

    def _brightest(self, products: tuple[Float, Float]) -> tuple[Float, Float, Float]:
        """Return log temperature, amplitude and fall of chi-squared of the best fits of given shapes."""
        shapes, data = products
        length = np.sqrt(np.maximum(shapes[:, 0, 0], 1e-300))
        sums = data[:, 0] / length[:, None]
        profile = Profile(self.templates.mean_sums, sums)
        given = np.log(self.templates.temperatures_k[self.templates.chosen[0]])
        x = profile.best().log_k if self.templates.coloured else np.full(len(sums), given)
        amplitude, variance, _ = profile.parts(x)
        best = np.maximum(amplitude, 1e-12 * length)
        return x, best / length, (2 * amplitude - best) * best / variance

    def _averaged(
        self, several: int, sums: NDArray[Any], start_s: Float, variance: Float | None, curves: Float | None
    ) -> tuple[NDArray[Any], Float, Float | None, Float | None]:
        """Average groups of consecutive frames; incomplete groups at gaps are dropped."""
        if several == 1:
            return sums, start_s, variance, curves
        number = np.rint(start_s / self.bank.frame_s).astype(np.int64)
        _, first, count = np.unique(number // several, return_index=True, return_counts=True)
        rows = first[count == several][:, None] + np.arange(several)
        variance = np.ones(start_s.size) if variance is None else variance
        mean = np.stack([one[rows].mean(axis=1) for one in sums])
        return (
            mean, start_s[rows[:, 0]], variance[rows].mean(axis=1) / several,
            None if curves is None else curves[:, rows].mean(axis=2),
        )  # fmt: skip

    def _windows(
        self, start_s: Float, peak: Float, width: Float, variance: Float | None, curves: Float | None
    ) -> tuple[Float, Float]:
        """Return weights of frames, zero outside the windows, (n, n_frame), and baseline terms, (n, n_frame, p)."""
        n, frame_s = peak.size, self.bank.frame_s
        weight = np.zeros((n, start_s.size))
        terms = np.zeros((n, start_s.size, len(self.bank.baseline.powers) + (0 if curves is None else len(curves))))
        for k in range(n):
            lead, tail = self.bank.window(float(width[k]))
            since = (start_s - peak[k]) / frame_s
            inside = (since >= -lead - 1) & (since <= tail)
            weight[k, inside] = 1.0 if variance is None else 1.0 / variance[inside]
            time = since / (lead + tail)
            rows = [time**power for power in self.bank.baseline.powers] + list([] if curves is None else curves)
            for j, row in enumerate(rows):
                terms[k, :, j] = row
        if terms.shape[2]:
            # Orthonormal in each window, so that a projection is a sum of products.
            root = np.sqrt(weight)[:, :, None]
            basis = np.linalg.qr(root * terms)[0]
            terms = np.divide(basis, root, out=np.zeros_like(basis), where=root > 0)
        return weight, terms

    def _normal(self, products: tuple[Float, Float], amplitude: Float, log_kelvin: Float) -> tuple[Float, Float]:
        """Return information and gradient for log amplitude, peak in half-widths, log half-width, log temperature."""
        shapes, data = products
        spline = self.templates.mean_sums.spline
        r, dr = spline(log_kelvin), spline(log_kelvin, 1) * self.templates.coloured
        # Each derivative is a product of one in time and one in the sums.
        time, sums = np.array([0, 1, 2, 0]), np.stack([r, r, r, dr], axis=1)
        inner = np.einsum("nik,njk->nij", sums, sums)
        information = amplitude[:, None, None] ** 2 * shapes[:, time][:, :, time] * inner
        left = data[:, time] - amplitude[:, None, None] * shapes[:, time, 0][:, :, None] * r[:, None]
        pull = amplitude[:, None] * np.einsum("nik,nik->ni", left, sums)
        # Parameters without information keep their values.
        blind = np.einsum("nii->ni", information) <= 0
        information[blind] = 0
        np.einsum("nii->ni", information)[blind] = 1.0
        return information, pull

    def _with_errors(
        self, peak: Float, log_width: Float, log_kelvin: Float, amplitude: Float, gain: Float, information: Float
    ) -> FittedFlares:
        width, kelvin = np.exp(log_width), np.exp(log_kelvin)
        coloured = self.templates.coloured
        if not coloured:
            information = information[:, :3, :3]
        covariance = np.linalg.pinv(information, hermitian=True)
        error = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))
        both = np.sqrt(np.maximum(covariance[:, 0, 0] + covariance[:, 2, 2] + 2 * covariance[:, 0, 2], 0.0))
        duration = amplitude * width * self.bank.shape.equivalent_duration
        none = np.full(peak.size, np.nan)
        return FittedFlares(
            peak, width * error[:, 1], amplitude, amplitude * error[:, 0], width, width * error[:, 2],
            kelvin if coloured else none, kelvin * error[:, 3] if coloured else none,
            duration, duration * both, np.sqrt(np.maximum(gain, 0.0)),
        )  # fmt: skip


def _remove_baseline(values: Float, weight: Float, level: Float) -> Float:
    """Subtract from values (n, n_frame, k) their weighted projection on orthonormal terms (n, n_frame, p)."""
    if not level.shape[2]:
        return values
    amounts = np.einsum("ntp,ntk->npk", level * weight[:, :, None], values, optimize=True)
    return np.asarray(values - np.einsum("ntp,npk->ntk", level, amounts, optimize=True))
