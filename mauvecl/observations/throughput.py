"""Throughput, wavelength zero point and line width from the spectra of standard stars.

The logarithm of the throughput over the nominal one is a cubic B-spline. Its second derivative has a normal prior whose
width follows from the data by restricted maximum likelihood. The posterior covariance consists of noise and of the bias
that this prior expects of the smoothing (Wahba 1983; Nychka 1988, doi 10.1080/01621459.1988.10478711). A throughput
smoother than the prior has less of it, so that the expected bias is scaled to that of the fitted curve; intervals then
hold the truth with their nominal probability on average over wavelength.

If all stars deviate alike from the spline, the throughput has structure that it does not follow. Each pixel then has a
factor of its own, whose spread follows from the data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.interpolate import BSpline
from scipy.optimize import minimize_scalar

from mauvecl.host.arrays import Float
from mauvecl.host.exposure.background import Sky
from mauvecl.host.exposure.expectation import continued_to_reach, expect
from mauvecl.host.exposure.response import Order, response_matrix
from mauvecl.host.instrument.instrument import Instrument
from mauvecl.observations.detector import CalibrationFrames, DarkFit, GoodnessOfFit, PhotonTransfer
from mauvecl.schema.errors import InputError

#: Knots of the errors of a star's spectrum, and their assumed relative size if only one star is observed.
ERROR_KNOTS, ONE_STAR_ERROR = 12, 0.10
#: Probability of chi-squared below which errors of the stars' spectra are fitted.
REJECTED = 0.01
#: Widths of the line function, over the nominal, through which the light is computed; it is quadratic in between.
WIDTHS = (1.0, 0.9, 1.1)
#: Steps of wavelength, nm, and of the relative width for derivatives.
STEP_NM, STEP_WIDTH = 0.2, 0.05
#: Largest fitted shift and stretch, nm, and relative change of the line's width, up to which the problem is linear.
LIMITS = np.array([5.0, 5.0, 0.3, 0.3])
#: Largest number of iterations, and the change of log throughput at which they end.
ITERATIONS, SETTLED = 50, 1e-5
#: Largest change of the logarithm of the throughput in an iteration, and of its difference from the nominal one.
LARGEST_STEP, LARGEST_LOG = 1.0, 10.0
#: Range of the logarithm of the smoothing parameter, relative to the information, and of that of spectra's errors.
LOG_SMOOTHING, LOG_ERROR = (-25.0, 25.0), (-9.0, 0.0)


@dataclass(frozen=True, eq=False)
class ThroughputFit(GoodnessOfFit):
    """Fit of the throughput."""

    wavelength_nm: Float  # shape (n_pixel,)
    log_factor: Float  # shape (n_pixel,); logarithm of the throughput over the nominal one
    # Shape (n_pixel + n_shape, n_pixel + n_shape); covariance of `log_factor` and, if they are fitted, of shift and
    # stretch in nm and of the relative width and its change.
    joint: Float
    # Wavelength of a feature less the nominal one in the middle of the spectrum, change of this shift to either end,
    # width of the line function's Gaussian in the middle, and its change to the red end, nm; nominal if not fitted.
    shape_nm: Float
    shape_error_nm: Float  # shape (4,); NaN if not fitted
    residual: Float  # shape (n_star, n_pixel); observed less fitted counts in standard deviations; NaN if not used
    chi2: float
    dof: float  # pixels less the effective number of parameters
    spectrum_error: float  # relative error of the stars' spectra at each of `ERROR_KNOTS` knots
    structure: float  # relative standard deviation of the pixels about the spline; 0 if it follows the throughput
    assumed: tuple[str, ...]  # quantities that these stars do not determine

    @property
    def error(self) -> Float:
        """Standard error of `log_factor`, shape (n_pixel,)."""
        return np.asarray(np.sqrt(np.diag(self.joint)[: self.wavelength_nm.size]))


class _LinearProblem:
    """Observed counts as a linear function of the parameters, and the parameters that fit them best.

    Values and the rows of the design are independent and of variance one. The spline's coefficients are the first
    parameters; `prior` has the standard deviation of each, infinite for free ones.
    """

    def __init__(self, values: Float, design: Float, prior: Float, penalty: Float) -> None:
        self.values, self.design, self.prior, self.penalty = values, design, prior, penalty
        self.normal, self.projected = design.T @ design, design.T @ values
        n = len(penalty)
        middle = np.log(np.trace(self.normal[:n, :n]) / np.trace(penalty))
        # The smoothing parameter of the largest restricted likelihood.
        self.smoothing = _most_likely(self.likelihood, tuple(middle + np.array(LOG_SMOOTHING)))
        self.covariance: Float = np.asarray(np.linalg.inv(self._information(self.smoothing, prior)))
        self.solution: Float = self.covariance @ self.projected

    def _information(self, smoothing: float, prior: Float) -> Float:
        full, n = np.diag(prior**-2.0), len(self.penalty)
        full[:n, :n] += smoothing * self.penalty
        return self.normal + full

    def likelihood(self, smoothing: float, prior: Float | None = None) -> float:
        """Return minus twice the logarithm of the restricted likelihood, up to a constant."""
        prior = self.prior if prior is None else prior
        full = self._information(smoothing, prior)
        best_fit = np.linalg.solve(full, self.projected)
        rank = len(self.penalty) - 2
        constrained = np.isfinite(prior)
        return float(
            self.values @ self.values - self.projected @ best_fit - rank * np.log(smoothing)
            + 2 * np.log(prior[constrained]).sum() + np.linalg.slogdet(full)[1]
        )  # fmt: skip

    def scaled(self, basis: Float) -> Float:
        """Return the covariance with a smoothing bias as large as that of the fitted curve, on average over pixels."""
        penalty, covariance = self.penalty, self.covariance
        n, pull = len(penalty), np.zeros_like(covariance)
        pull[:, :n] = self.smoothing * covariance[:, :n] @ penalty
        noise = covariance - pull @ covariance

        def spread(values: Float) -> Float:
            """Return the variance of a curve at the pixels from the covariance of its coefficients."""
            return np.asarray(np.einsum("pi,pi->p", basis @ values[:n, :n], basis))

        variance, bias = spread(covariance), basis @ (pull @ self.solution)[:n]
        of_noise, expected = (float(np.mean(spread(m) / variance)) for m in (pull @ noise @ pull.T, pull @ noise))
        if not expected > of_noise:
            return covariance
        scale = (float(np.mean(bias**2 / variance)) - of_noise) / (expected - of_noise)
        return np.asarray(noise + max(scale, 0.0) * pull @ covariance)

    def pixels(self, model: ThroughputModel) -> tuple[bool, float, float, float, Float, Float]:
        """Divide the residuals into those that all stars share, and those by which they differ.

        Return whether the stars differ from each other, chi-squared and degrees of freedom of the fit with a factor for
        each pixel, the relative standard deviation of these factors, which is zero if the spline follows the
        throughput, their logarithms, shape (n_pixel,), and the variances of these.
        """
        (n_star, n_pixel), design = model.observed_dn.shape, self.design
        residuals = self.values - design @ self.solution
        by_star = residuals.reshape(n_star, n_pixel)
        # The columns of the spline sum to one.
        scale = design[:, : model.basis.shape[1]].sum(axis=1).reshape(n_star, n_pixel)
        information = np.sum(scale**2, axis=0)
        used = information > 0
        shared = np.divide(np.sum(scale * by_star, axis=0), information, out=np.zeros(n_pixel), where=used)
        chi2 = float(residuals @ residuals)
        dof = float(np.any(design != 0, axis=1).sum() - np.sum(self.covariance * self.normal))
        of_shared = float(np.sum(shared**2 * information))
        dof_shared = dof - model.usable.sum() + used.sum()
        disagree = n_star > 1 and bool(scipy.stats.chi2.sf(chi2 - of_shared, dof - dof_shared) < REJECTED)
        if model.order != "paper" or scipy.stats.chi2.sf(of_shared, dof_shared) >= REJECTED:
            return disagree, chi2, dof, 0.0, np.zeros(n_pixel), np.zeros(n_pixel)
        variance = (of_shared - dof_shared) / float(np.sum(information))
        share = variance * information / (1 + variance * information)
        chi2 -= float(np.sum(shared**2 * information * share * (2 - share)))
        factors = np.log1p(share * shared), variance * (1 - share)
        return disagree, chi2, dof - float(share.sum()), float(np.sqrt(variance)), *factors


def _most_likely(likelihood: Callable[[float], float], log_range: tuple[float, float]) -> float:
    """Return the positive number at which -2 log likelihood is smallest."""
    minimum = minimize_scalar(lambda log: likelihood(np.exp(log)), bounds=log_range, method="bounded")
    return float(np.exp(minimum.x))


class ThroughputModel:
    """Mean light of standard stars for a throughput, wavelength scale and line width.

    The spline of the throughput has `knots` intervals. `light_error` is the relative standard deviation of the light of
    an observation, by pointing.
    """

    def __init__(
        self, stars: Sequence[CalibrationFrames], nominal: Instrument, dark: DarkFit, transfer: PhotonTransfer,
        *, knots: int, sky: Sky, order: Order, light_error: float,
    ) -> None:  # fmt: skip
        nm, fwhm, frame_s = nominal.wavelength_nm, nominal.gaussian_fwhm_nm, nominal.frame_s
        self.stars, self.nominal, self.dark, self.transfer = stars, nominal, dark, transfer
        self.order, self.light_error = order, light_error
        # B-spline at the pixels, shape (n_pixel, n_coefficient), and the matrix of its squared second derivative.
        self.basis, self.penalty = _basis(nm, knots)
        # Wavelengths of the pixels from -1 to 1.
        self.x = 2 * (nm - nm[0]) / np.ptp(nm) - 1
        # Mean light of a frame, and pixels that stay below saturation, shape (n_star, n_pixel).
        self.observed_dn = np.array([frames.raw_dn.mean(axis=0) - dark.mean_dn(frames) for frames in stars])
        self.usable = np.array([frames.usable(nominal) for frames in stars])
        # Seconds of dark current and their change with its slope, shape (n_star, 2).
        self.dark_terms = np.array([dark.terms(frames) for frames in stars])
        # Covariance between stars of each pixel's subtracted dark, shape (n_pixel, n_star, n_star).
        jacobian = np.column_stack([np.ones(len(stars)), self.dark_terms[:, 0]])
        self.dark_covariance = jacobian @ dark.covariance @ jacobian.T
        spectra = [frames.star for frames in stars if frames.star is not None]
        # Zodiacal light of a second in each pixel, shape (n_pixel,).
        quiet = expect(spectra[0], nominal, exposure=frame_s, sky=sky, order=order)
        self.sky_electrons = quiet.sky_electrons / frame_s
        # Each star with the electrons per second for its flux, through line functions of `WIDTHS` on the nominal.
        lines = [nominal.with_(gaussian_fwhm_nm=fwhm * width) for width in WIDTHS[: 3 if fwhm else 1]]
        reached = [continued_to_reach(star, lines[-1]) for star in spectra]
        self.responses = [(s, [response_matrix(line, s.wavelength_nm, order) for line in lines]) for s in reached]
        # Stars that differ in brightness alone count once.
        flux = [star.flux_flam / star.flux_flam.max() for star in spectra]
        self.n_stars = sum(
            all(later.shape != earlier.shape or not np.allclose(later, earlier) for earlier in flux[:k])
            for k, later in enumerate(flux)
        )
        # Number of fitted values of wavelengths (shift, stretch) and width (mean, change): none for a single star.
        self.n_shape = 0 if self.n_stars < 2 else 4 if fwhm > 0 else 2
        # Derivatives of the light with respect to these, for the nominal instrument, shape (n_star, n_pixel).
        self.slopes_dn = list[Float]()
        for step, place in [(STEP_NM, 0), (STEP_WIDTH, 2)][: self.n_shape // 2]:
            moved = step * np.eye(self.n_shape)[place]
            above, below = (self.light_dn(np.zeros(nm.size), sign * moved) for sign in (1, -1))
            slope = (above - below) / (2 * step)
            self.slopes_dn += [slope, slope * self.x]

    def light_dn(self, log_factor: Float, shape: Float) -> Float:
        """Return the mean light of a frame of each star, DN, shape (n_star, n_pixel).

        The light is quadratic in the local width of the line function.
        """
        shift, stretch, width, change = np.pad(shape, (0, 4 - shape.size))
        nm, local, step = self.nominal.wavelength_nm, width + change * self.x, WIDTHS[-1] - 1.0
        light = []
        for frames, (star, responses) in zip(self.stars, self.responses, strict=True):
            at, flux = star.wavelength_nm, star.flux_flam
            if shift or stretch:
                flux = np.interp(at + shift + stretch * np.interp(at, nm, self.x), at, flux)
            if self.order == "physical":
                flux = flux * np.exp(np.interp(at, nm, log_factor))
            electrons = responses[0] @ flux
            if width or change:
                narrow, wide = (response @ flux for response in responses[1:])
                slope, bend = (wide - narrow) / (2 * step), (wide + narrow - 2 * electrons) / (2 * step**2)
                electrons = electrons + local * (slope + local * bend)
            electrons = np.maximum(electrons * self.nominal.per_pixel("response", 1.0), 0.0) + self.sky_electrons
            light.append(self.nominal.per_pixel("gain", self.transfer.noise.gain) * electrons * frames.exposure_s)
        return np.array(light) if self.order == "physical" else np.array(light) * np.exp(log_factor)

    def variance_dn2(self, light_dn: Float) -> Float:
        """Return the variance of the mean frames of all stars, shape (n_star, n_pixel)."""
        frames = np.array([observation.n_frames for observation in self.stars])
        dark = self.dark_terms[:, :1] * self.dark.level_dn_per_s
        gains = self.nominal.per_pixel("gain", 1.0)
        return np.asarray(self.transfer.noise.variance(gains * light_dn, dark) / frames[:, None])

    def linearised(self, coefficients: Float, shape: Float, error: float) -> _LinearProblem:
        """Return the linear problem around a spline and a shape, for a relative error of the stars' spectra."""
        n_star, log_factor = len(self.stars), self.basis @ coefficients
        model = self.light_dn(log_factor, shape)
        columns = [model * column for column in self.basis.T]
        columns += [slope * np.exp(log_factor) for slope in self.slopes_dn]
        around = np.concatenate([coefficients, shape])
        prior = [np.inf] * around.size
        for star in np.eye(n_star)[:, :, None]:
            if self.light_error > 0:
                columns.append(star * model)
                prior.append(self.light_error)
            if error > 0:
                columns += [star * model * column for column in _linear_basis(self.nominal.wavelength_nm).T]
                prior += [error] * ERROR_KNOTS
        level = self.dark.level_dn_per_s.mean()
        jacobian = np.column_stack([np.ones(n_star), self.dark_terms[:, 0], level * self.dark_terms[:, 1]])
        values, vectors = np.linalg.eigh(self.dark.shared)
        for value, vector in zip(values, vectors.T, strict=True):
            if value > 0:
                columns.append(np.sqrt(value) * (jacobian @ vector)[:, None] * np.ones_like(model))
                prior.append(1.0)
        # Usable values become independent and of variance one.
        used, index = self.usable.T, np.arange(n_star)
        covariance = np.where(used[:, :, None] & used[:, None, :], self.dark_covariance, 0.0)
        covariance[:, index, index] += np.where(used, self.variance_dn2(model).T, 1.0)
        inverse = np.linalg.inv(np.linalg.cholesky(covariance))
        masked = [np.where(used.T, values, 0.0) for values in (*columns, self.observed_dn - model)]
        *columns, observed = (np.einsum("pij,jp->ip", inverse, values).ravel() for values in masked)
        design = np.column_stack(columns)
        return _LinearProblem(observed + design[:, : around.size] @ around, design, np.array(prior), self.penalty)


def fit_throughput(model: ThroughputModel, spectrum_error: float | None = None) -> ThroughputFit:
    """Fit the throughput to the mean frames of standard stars.

    With two or more stars, wavelengths and the width of the line function are fitted as well. `spectrum_error` is the
    relative error of the stars' spectra at `ERROR_KNOTS` knots; by default assumed for one star, and fitted if several
    disagree.
    """
    nm, fwhm, several = model.nominal.wavelength_nm, model.nominal.gaussian_fwhm_nm, model.n_stars > 1
    error = spectrum_error or 0.0
    best = _solve(model, error)
    m, n = model.n_shape, model.basis.shape[1]
    if several and spectrum_error is None and best.pixels(model)[0]:
        trial = _solve(model, ONE_STAR_ERROR)
        of_spectra = trial.prior == ONE_STAR_ERROR
        error = _most_likely(
            lambda sd: trial.likelihood(trial.smoothing, np.where(of_spectra, sd, trial.prior)), LOG_ERROR
        )
        best = _solve(model, error)
    shape = best.solution[n : n + m]
    if (np.abs(shape) > LIMITS[:m]).any():
        fault = "the stars' spectra must match a wavelength scale and line width near the nominal ones, but do not"
        most = f"use standards with shifts up to {LIMITS[0]:g} nm and widths within {100 * LIMITS[2]:g} %"
        raise InputError(f"{fault}; {most}", key="observations")
    _, chi2, dof, structure, log_pixel, variance = best.pixels(model)
    to_pixels = scipy.linalg.block_diag(model.basis, np.eye(m))
    joint = np.asarray(to_pixels @ best.scaled(model.basis)[: n + m, : n + m] @ to_pixels.T)
    # The fit to one star cannot tell errors of its spectrum from the throughput.
    unfitted_error = 0.0 if several or spectrum_error is not None else ONE_STAR_ERROR
    errors = unfitted_error * _linear_basis(nm)
    joint[: nm.size, : nm.size] += np.diag(variance) + errors @ errors.T + model.transfer.relative_gain_error**2
    log_factor = model.basis @ best.solution[:n] + log_pixel
    light = model.light_dn(log_factor, shape)
    sd = np.sqrt(model.variance_dn2(light) + np.diagonal(model.dark_covariance, axis1=1, axis2=2).T)
    residual = np.where(model.usable, (model.observed_dn - light) / sd, np.nan)
    fitted = {"wavelength zero point": m > 0, "line width": m == 4, "errors of the star's spectrum": several}
    # Widths are relative to the nominal one.
    scale, shape_error = np.array([1.0, 1.0, fwhm, fwhm]), np.sqrt(np.diag(joint))[nm.size :]
    return ThroughputFit(
        nm, log_factor, joint,
        shape_nm=scale * (np.pad(shape, (0, 4 - m)) + [0, 0, 1, 0]),
        shape_error_nm=scale * np.pad(shape_error, (0, 4 - m), constant_values=np.nan),
        residual=residual, chi2=chi2, dof=dof, spectrum_error=unfitted_error or error, structure=structure,
        assumed=tuple(name for name in fitted if not fitted[name]),
    )  # fmt: skip


def _solve(model: ThroughputModel, error: float) -> _LinearProblem:
    """Return the linear problem around its own solution, for a relative error of the stars' spectra.

    Raises InputError if the iterations do not settle.
    """
    n, m = model.basis.shape[1], model.n_shape
    coefficients, shape = np.zeros(n), np.zeros(m)
    for _ in range(ITERATIONS):
        linear = model.linearised(coefficients, shape, error)
        step = linear.solution[:n] - coefficients
        moved = np.abs(model.basis @ step).max()
        if moved < SETTLED:
            return linear
        coefficients = coefficients + step * min(1.0, LARGEST_STEP / moved)
        shape = np.clip(linear.solution[n : n + m], -LIMITS[:m], LIMITS[:m])
        if not np.abs(model.basis @ coefficients).max() < LARGEST_LOG:
            break
    fault = "no throughput makes the spectra of the stars those of the frames"
    remedy = "give frames of the stated stars, with dark frames if the dark current is not nominal"
    raise InputError(f"{fault}; {remedy}", key="observations")


def _basis(nm: Float, knots: int) -> tuple[Float, Float]:
    """Return a cubic B-spline basis, shape (n_pixel, knots + 3), and the matrix of its squared second derivative."""
    inner = np.linspace(nm[0], nm[-1], knots + 1)
    full = np.concatenate([np.full(3, nm[0]), inner, np.full(3, nm[-1])])
    design = BSpline.design_matrix(nm, full, 3).toarray()
    # The second derivative is linear between knots, so that two Gauss nodes integrate its square exactly.
    half = np.diff(inner)[:, None] / 2
    nodes = inner[:-1, None] + half * (1 + np.array([-1.0, 1.0]) / np.sqrt(3.0))
    second = BSpline(full, np.eye(knots + 3), 3).derivative(2)(nodes.ravel())
    return design, np.asarray((second * np.repeat(half, 2, axis=1).ravel()[:, None]).T @ second)


def _linear_basis(nm: Float) -> Float:
    """Return the basis of piecewise linear curves with `ERROR_KNOTS` knots, shape (n_pixel, ERROR_KNOTS)."""
    at = np.linspace(nm[0], nm[-1], ERROR_KNOTS)
    return np.column_stack([np.interp(nm, at, row) for row in np.eye(ERROR_KNOTS)])
