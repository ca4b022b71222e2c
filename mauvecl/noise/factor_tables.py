"""Factors of priors on light, dark and sky, as the quantile tables that kernels read."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from mauvecl.noise import layout
from mauvecl.noise.prior_tables import table_of
from mauvecl.noise.unknowns import PROCESSES, Conditions
from mauvecl.schema.errors import InputError

if TYPE_CHECKING:
    from mauvecl.noise.processes import Processes

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Factors:
    """Factors of priors on light, dark and sky; factors on light include the sky's light."""

    #: Shape (n_modulation, 2 * layout.PRIOR_NODES); quantile tables; see `prior_tables.table_of`.
    tables: NDArray[np.float32]
    #: Factors at the priors' medians, to which the tables are relative.
    light: float
    dark: float
    sky: float
    #: Smallest and largest factors of all priors together.
    light_ends: tuple[float, float]
    dark_ends: tuple[float, float]
    sky_ends: tuple[float, float]

    @classmethod
    def of(cls, processes: Processes, conditions: Conditions) -> Self:
        """Compute the quantile tables of the priors' factors.

        Parameters
        ----------
        conditions : mapping of float
            Values of the expectation: ``temperature_c``, ``dark_slope_per_c``, ``light_loss``, ``pointing_loss``.
        """
        tables = np.empty((len(processes.modulations), 2 * layout.PRIOR_NODES), np.float32)
        ends = {"light": (1.0, 1.0), "dark": (1.0, 1.0), "sky": (1.0, 1.0)}
        centre = dict.fromkeys(ends, 1.0)
        for row, (name, factor) in enumerate(processes.modulations):
            prior, varied = getattr(processes, name), PROCESSES[name]
            change = partial(varied.change, conditions)
            first, last = prior.quantile(np.array([0.0, 1.0]))
            if not (varied.low <= first and last <= varied.high):
                raise InputError.of(
                    name, [float(first), float(last)], f"a prior within {varied.low:g} to {varied.high:g}"
                )
            tables[row], middle = table_of(prior, change)
            centre[factor] *= 1.0 + middle
            least, most = sorted(1.0 + change(np.array([first, last])))
            ends[factor] = ends[factor][0] * float(least), ends[factor][1] * float(most)
        return cls(tables, centre["light"], centre["dark"], centre["sky"], ends["light"], ends["dark"], ends["sky"])

    @staticmethod
    def on_light(light: float, sky: float, share: Float) -> Float:
        """Return the factor on each pixel's total light, of which the sky has this share, shape (n_pixel,)."""
        return np.asarray(light * (1.0 + (sky - 1.0) * share))
