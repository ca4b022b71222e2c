"""Least-squares fits within limits, and ends of intervals from the profile likelihood."""

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
#: Number of steps to the end of an interval; largest length of a step and of the last, relative to the root of the rise
#: of chi-squared; relative regularisation of degenerate parameters.
NEWTON_STEPS, LONGEST, CONVERGED, RIDGE = 200, 1.5, 1e-3, 1e-10
#: Factor on the lengths of all steps after one that turns back.
SHORTER = 0.5


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


def interval_end(
    linearised: Linearised, quantity: Callable[[Float], tuple[float, Float]], theta: Float,
    limits: tuple[Float, Float], chi2: float, rise: float, free: NDArray[np.intp] | None = None,
) -> tuple[float, float]:  # fmt: skip
    """Return the end of a quantity's interval on one side, where the smallest chi-squared has risen by `rise`.

    The end is the lower one if `rise` is negative. The second value is 1, or the share of the rise (below 1) that
    chi-squared has reached where the search stops without an end within the limits of the parameters. Each step goes
    to where the quantity is extreme on the surface of equal chi-squared, of linearised residuals. A parameter that
    reaches a limit stays there.

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
    (low, high), there, unit = limits, theta.copy(), np.sqrt(abs(rise))
    free = np.arange(theta.size) if free is None else free
    damping, last_change = 1.0, np.zeros(1)
    for _ in range(NEWTON_STEPS):
        residuals, derivatives = linearised(there)
        # A parameter without any effect, such as the cooling time of a flare that does not cool, keeps its value.
        power = np.sum(derivatives**2, axis=0)
        free = free[power[free] > 0.0]
        jacobian, slope = derivatives[:, free], quantity(there)[1][free]
        information = jacobian.T @ jacobian + np.diag(RIDGE * power[free])
        back, along = np.linalg.solve(information, np.column_stack([-(residuals @ jacobian), slope])).T
        if not slope @ along > 0.0:
            break
        room = chi2 + abs(rise) - float(residuals @ residuals + residuals @ jacobian @ back)
        step = back + np.sign(rise) * np.sqrt(max(room, 0.0) / (slope @ along)) * along
        change = jacobian @ step
        # Steps across a kink, where the peak changes frames, would not become shorter.
        damping *= SHORTER if np.sum(change * last_change) < 0.0 else 1.0
        length, last_change = float(np.linalg.norm(change)) / unit, change
        share = min(1.0, LONGEST / length) * damping
        there[free] += share * step
        outside = (there < low) | (there > high)
        if outside[free].any():
            there, free = np.clip(there, low, high), free[~outside[free]]
        elif share * length < CONVERGED:
            return quantity(there)[0], 1.0
    reached = (float(residuals @ residuals) - chi2) / abs(rise)
    return quantity(there)[0], min(reached, float(np.nextafter(1.0, 0.0)))
