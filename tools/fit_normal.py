"""Fit the polynomials of mauvecl/noise/layout.py, by Lawson's reweighted least squares, rounded to float32.

python tools/fit_normal.py
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Function = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def fit(exact: Function, degree: int, low: float, high: float, weight: Function) -> tuple[list[str], float]:
    """Return float32 coefficients in hexadecimal, lowest power first, and the largest weighted error."""
    x = (low + high) / 2 + (high - low) / 2 * np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    powers, y, w = np.vander(x, degree + 1, increasing=True), exact(x), weight(x)
    share = np.full(x.size, 1 / x.size)
    for _ in range(400):
        root = np.sqrt(share) * w
        coefficients, *_ = np.linalg.lstsq(powers * root[:, None], y * root, rcond=None)
        error = np.abs((powers @ coefficients - y) * w)
        share = share * error / np.sum(share * error)
    return [float(np.float32(c)).hex() for c in coefficients], float(error.max())


def main() -> None:
    """Print the three polynomials with their errors."""
    ends = np.sqrt(0.5) - 1, np.sqrt(2.0) - 1
    one: Function = np.ones_like
    for name, *arguments in (
        # Only the product with f matters, so errors near f = 0 weigh less.
        ("log", lambda f: -2 * np.log1p(f) / f, 7, *ends, lambda f: np.abs(f) + 0.02),
        ("sin", lambda y: np.sin(np.pi * np.sqrt(y)) / np.sqrt(y), 4, 0.0, 0.25, one),
        ("cos", lambda y: np.cos(np.pi * np.sqrt(y)), 4, 0.0, 0.25, one),
    ):
        coefficients, error = fit(*arguments)
        print(f"{name}: {', '.join(coefficients)}  (error {error:.1e})")


if __name__ == "__main__":
    main()
