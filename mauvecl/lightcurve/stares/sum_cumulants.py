"""Joint cumulants of weighted sums of a frame, from which the sums are drawn without drawing pixels.

The cumulants of independent counts add up, so those of the sums are exact. A frame is drawn as the Cholesky factor of
the sums times normals. A quadratic function of all normals is added to each, which reproduces the third cumulants, and
if needed a cubic function (Cornish & Fisher 1938, doi 10.2307/1400905, in several dimensions).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.lightcurve.stares.frame_components import STEADY, Components
from mauvecl.lightcurve.stares.stare_scene import Flares, StareScene, unique
from mauvecl.noise.cumulants import expansion_error
from mauvecl.noise.processes import NONE, Processes
from mauvecl.noise.unknowns import ADDITIVE
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.lightcurve.stares.stare import Stare
    from mauvecl.lightcurve.stares.stare_requests import Method

Float = NDArray[np.float64]
Floats = NDArray[np.float32]

#: Number of frames after which Pearson's test would notice the neglected cumulants at five sigma: sixteen thousand
#: star-years of 5 s.
FRAMES_TO_NOTICE = 1e11
#: Number of classes of that test: range in standard deviations that contains all but 1e-14.
CLASSES = 15.3
#: Smallest distance of a pixel's mean from zero and saturation, in standard deviations.
RAIL_SIGMA = 8.0
#: Smallest variance of a pixel, DN^2; below it, rounding is not like noise of variance 1/12.
LEAST_VARIANCE = 1.0


@dataclass(frozen=True, eq=False)
class SumTable:
    """Cumulants of whitened sums, which are independent and have unit variance at coefficients of one."""

    #: Shape (4 + n_flare, n); total at coefficients of one, then star, sky, dark, neighbours and each flare: means (0
    #: for the total), then the unique second, third and, if needed, fourth cumulants, in the order of
    #: `stare_scene.unique`; fourth ones are multiplied by their multiplicity.
    rows: Floats
    #: Shape (n_statistic * (n_statistic + 1) / 2,); lower triangular matrix that converts whitened sums to the
    #: statistics.
    whole: Floats
    fourths: bool  # whether fourth cumulants are needed

    @classmethod
    def of(cls, components: Components) -> Self:
        """Compute the table.

        Raises InputError if weights are linearly dependent, or counts are too few for the expansion.
        """
        n = components.n_statistics
        constant, each = components.sum_cumulants(2)
        covariance = constant + each[: len(STEADY)].sum(axis=0)
        sd = np.sqrt(np.diag(covariance))
        if (sd == 0).any() or np.linalg.eigvalsh(covariance / np.outer(sd, sd))[0] < 1e-9:
            raise InputError(
                f"{n} spectral weights of which one is a sum of others", "independent ones", key="weights", value=n
            )
        lower = np.linalg.cholesky(covariance)
        white = Components(
            components.quiet,
            components.flare_electrons,
            np.asarray(np.linalg.solve(lower, components.weights), np.float64),
        )
        fourths = _fourths_are_needed(components) or _fourths_are_needed(white)
        columns = []
        for order in range(1, 5 if fourths else 4):
            constant, each = white.sum_cumulants(order)
            reference = constant + (0.0 if order == 1 else each[: len(STEADY)].sum(axis=0))
            for key in unique(n, order):
                often = 1
                if order == 4:
                    often = math.factorial(4) // math.prod(math.factorial(m) for m in Counter(key).values())
                columns.append(often * np.array([reference[key], *(component[key] for component in each)]))
        return cls(np.array(columns, np.float32).T.copy(), lower[np.tril_indices(n)].astype(np.float32), fourths)

    @property
    def packed(self) -> Floats:
        """Array for the kernel."""
        return np.concatenate([self.rows.ravel(), self.whole])


def check_sums(scene: StareScene, flares: Flares) -> None:
    """Raise InputError if cumulants do not describe frames: clipping, pixels without noise, or rare large hits."""
    for name in scene.scene.additive:
        raise InputError(
            f"{ADDITIVE[name].label} with method 'cumulants'", "method 'pixels'", key="method", value="cumulants"
        )
    x = scene.components.quiet
    used = (scene.components.weights != 0).any(axis=0)
    for light, dark in scene.conditions(flares):
        mean = x.bias_dn + light + dark * x.dark_dn
        variance = x.read_noise_dn**2 + x.gain_dn_per_electron * light + dark * x.dark_variance_dn2
        sd = np.sqrt(variance)
        near = used & ((mean - RAIL_SIGMA * sd < 0.0) | (mean + RAIL_SIGMA * sd > x.highest_dn))
        if near.any():
            pixel = int(np.argmax(near))
            raise InputError(
                f"pixel {pixel} of {x.name} comes within {RAIL_SIGMA:g} sigma of zero or saturation and has a weight",
                "method 'pixels', which clips, or weight 0 there",
                key="method",
                value="cumulants",
            )
        if (used & (variance < LEAST_VARIANCE)).any():
            pixel = int(np.argmax(used & (variance < LEAST_VARIANCE)))
            raise InputError(
                f"pixel {pixel} of {x.name} scatters by {sd[pixel]:.2g} DN, too little for its rounding to be noise",
                "method 'pixels'",
                key="method",
                value="cumulants",
            )


def method_for(components: Components, stare: Stare, processes: Processes = NONE) -> Method:
    """Return the method for frames without flares: cumulants if these describe them, otherwise pixels."""
    scene = StareScene.of(components, stare, processes)
    try:
        check_sums(scene, Flares.of(components, stare, None, None, 1))
        SumTable.of(components)
    except InputError:
        return "pixels"
    return "cumulants"


def _over_sd(components: Components) -> list[Float]:
    """Return the standardised third to seventh cumulants of each sum, shape (n_statistic,) each."""
    x, w = components.quiet, components.weights
    photons, dark = components.mean_dn[:2].sum(axis=0), components.mean_dn[2]
    sd = np.sqrt(np.sum(w**2 * (x.unsaturated_variance_dn2), axis=1))
    cumulants = []
    for order in range(3, 8):
        cumulant = x.dark_step_dn ** (order - 1) * dark
        if x.photon_noise == "poisson":
            cumulant = cumulant + x.gain_dn_per_electron ** (order - 1) * photons
        cumulants.append(np.sum(w**order * cumulant, axis=1) / sd**order)
    return cumulants


def _fourths_are_needed(components: Components) -> bool:
    """Return whether neglecting cumulants beyond the third could be noticed.

    Raises InputError if neglecting those beyond the fourth could be noticed.
    """
    shapes = _over_sd(components)
    least = 5.0 * np.sqrt(2.0 * CLASSES) / FRAMES_TO_NOTICE
    beyond = expansion_error(shapes, fourth_power=False)
    if (beyond > least).any():
        row = int(np.argmax(beyond))
        raise InputError(
            f"the sum with spectral weight {row} has a skewness of {abs(shapes[0][row]):.2g} in a frame "
            f"of {components.quiet.name}, too much for method 'cumulants'",
            "method 'pixels'",
            key="method",
            value="cumulants",
        )
    g3, g4 = shapes[0], shapes[1]
    cubic, linear = g4 / 24 - g3**2 / 18, g3**2 * (5 / 36 - 6 / 36)
    return bool((24 * cubic**2 + 2 * linear**2 > least).any())
