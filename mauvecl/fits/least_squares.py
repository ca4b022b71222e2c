"""Least-squares fits within limits, covariances, and ends of intervals from the profile likelihood."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from mauvecl.host.arrays import Float

#: Function of the parameters that returns residuals, (n,), and their derivatives, (n, n_parameter).
Linearised = Callable[[Float], tuple[Float, Float]]

#: Largest number of evaluations of a fit.
MAX_EVALUATIONS = 200
#: Largest distance of starting parameters from the middle of their limits, over that of the limits.
LARGEST_SINE = 1.0 - 1e-9
#: Largest number of steps to the end of an interval.
NEWTON_STEPS = 200
#: Largest length of a step, and of the last one, relative to the root of the rise of chi-squared.
LONGEST, CONVERGED = 1.5, 1e-3
#: Factor on the lengths of all steps after one that turns back.
SHORTER = 0.5
#: Relative regularisation of degenerate parameters.
RIDGE = 1e-10
#: Largest number of holds and releases per parameter in a step.
TURNS = 3


def least_squares(
    linearised: Linearised, start: Float, limits: tuple[Float, Float], tolerance: float
) -> tuple[Float, float, bool]:  # fmt: skip
    """Return the parameters of the smallest chi-squared, this chi-squared, and whether the fit has converged.

    Parameters are sines within their limits (Levenberg-Marquardt method of MINPACK). The fit has converged if the
    relative change of chi-squared is at most `tolerance`.
    """
    low, high = limits
    middle, half = (low + high) / 2, (high - low) / 2

    @lru_cache(maxsize=2)
    def triangle(content: bytes) -> Float:
        """Return the triangular factor of derivatives and residuals as columns.

        Its columns have the same scalar products, on which alone the fit depends. It has few rows.
        """
        angles = np.frombuffer(content)
        residuals, jacobian = linearised(middle + half * np.sin(angles))
        return np.asarray(np.linalg.qr(np.column_stack([jacobian * half * np.cos(angles), residuals]), mode="r"))

    angles = np.arcsin(np.clip((start - middle) / half, -LARGEST_SINE, LARGEST_SINE))
    angles, _, report, _, status = scipy.optimize.leastsq(  # type: ignore[call-overload]
        lambda x: triangle(x.tobytes())[:, -1], angles, Dfun=lambda x: triangle(x.tobytes())[:, :-1],
        full_output=True, ftol=tolerance, xtol=1e-9, maxfev=MAX_EVALUATIONS,
    )  # fmt: skip
    return middle + half * np.sin(angles), float(report["fvec"] @ report["fvec"]), status in (1, 2, 3, 4)


def parameter_covariance(derivatives: Float) -> Float:
    """Return the covariance of fitted parameters from the derivatives of the residuals, (n, n_parameter).

    It is the inverse of the information, zero for parameters that have no effect.
    """
    scale = np.linalg.norm(derivatives, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    columns = derivatives / scale
    return np.asarray(np.linalg.pinv(columns.T @ columns, hermitian=True) / np.outer(scale, scale))


def interval_end(
    linearised: Linearised, quantity: Callable[[Float], tuple[float, Float]], theta: Float,
    limits: tuple[Float, Float], chi2: float, rise: float, free: NDArray[np.intp] | None = None,
) -> tuple[float, float]:  # fmt: skip
    """Return the end of a quantity's interval on one side, where the smallest chi-squared has risen by `rise`.

    The end is the lower one if `rise` is negative. The second value is 1, or the share of the rise (below 1) that
    chi-squared has reached where the search stops without an end within the limits of the parameters. Each step goes
    to where the quantity is extreme on the surface of equal chi-squared, of linearised residuals, within the limits.

    Parameters
    ----------
    linearised
        Residuals and their derivatives.
    quantity
        Function of the parameters that returns the quantity and its derivatives, (n_parameter,).
    theta, chi2
        Best fit.
    limits
        Smallest and largest parameters.
    free
        Numbers of the parameters that change, all by default.
    """
    (low, high), point, radius = limits, theta.copy(), np.sqrt(abs(rise))
    fitted = np.arange(theta.size) if free is None else free
    damping, last_change = 1.0, np.zeros(1)
    for _ in range(NEWTON_STEPS):
        residuals, derivatives = linearised(point)
        # A parameter without any effect, such as the cooling time of a flare that does not cool, keeps its value.
        power = np.sum(derivatives**2, axis=0)
        free = fitted[power[fitted] > 0.0]
        jacobian, slope = derivatives[:, free], np.sign(rise) * quantity(point)[1][free]
        information = jacobian.T @ jacobian + np.diag(RIDGE * power[free])
        distances = (low - point)[free], (high - point)[free]
        room = chi2 + abs(rise) - float(residuals @ residuals)
        step, held = _bounded_step(information, residuals @ jacobian, slope, room, distances)
        change = jacobian @ step
        # Steps across a kink, where the peak changes frames, would not become shorter.
        damping *= SHORTER if np.sum(change * last_change) < 0.0 else 1.0
        length, last_change = float(np.linalg.norm(change)) / radius, change
        share = LONGEST / max(length, LONGEST) * damping
        point[free] += share * step
        if share * length < CONVERGED:
            point[free[held]] += (1.0 - share) * step[held]
            point = np.clip(point, low, high)
            value, slope = quantity(point)
            if slope[free[~held]].any():
                return value, 1.0
            break
    reached = (float(residuals @ residuals) - chi2) / abs(rise)
    return quantity(point)[0], min(reached, float(np.nextafter(1.0, 0.0)))


def _bounded_step(
    information: Float, gradient: Float, slope: Float, room: float, distances: tuple[Float, Float]
) -> tuple[Float, NDArray[np.bool_]]:  # fmt: skip
    """Return the step to where a quantity is largest, and which parameters reach a limit.

    Chi-squared may rise by `room`; a step s changes it by 2 gradient s + s information s. The step lies between the
    `distances` from the limits. Parameters beyond a limit are held there, and released where the Lagrangian of the
    others rises inwards.
    """
    low, high = distances
    step, held = np.zeros(slope.size), np.zeros(slope.size, np.bool_)
    for _ in range(TURNS * slope.size + 1):
        free, fixed = np.flatnonzero(~held), step[held]
        rest = gradient + information[:, held] @ fixed
        pair = np.column_stack([-rest, slope])[free]
        back, along = np.linalg.solve(information[np.ix_(free, free)], pair).T
        left = room - float(fixed @ (gradient + rest)[held]) - float(rest[free] @ back)
        power = float(slope[free] @ along)
        pace = np.sqrt(max(left, 0.0) / power) if power > 0.0 else 0.0
        step[free] = back + pace * along
        beyond = (step < low) | (step > high)
        if beyond.any():
            step, held = np.clip(step, low, high), held | beyond
            continue
        uphill = pace * slope - gradient - information @ step
        if not power > 0.0 and left > 0.0:
            # Only limits end the quantity.
            uphill = np.where(slope == 0.0, uphill, slope)
        inwards = np.where(step <= low, uphill, -uphill) / np.sqrt(np.diag(information))
        inwards[~held] = 0.0
        if not (inwards > 0.0).any():
            break
        held[np.argmax(inwards)] = False
    return step, held
