"""Protons that the Earth's field has trapped, along the orbit: a map computed once, with the package's script."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.ecsv import parse_ecsv

Energy = Literal[10, 30]


@dataclass(frozen=True, eq=False)
class FluxMap:
    """Flux of trapped protons by the place below, cm^-2 s^-1, from all directions.

    Attributes
    ----------
    step_deg : float
        Between the cells' middles.
    flux : dict of int to ndarray, shape (n_latitude, n_longitude)
        By the energy above which protons are counted, MeV; latitude from -90, longitude from -180.
    source : str
    """

    step_deg: float
    flux: dict[int, NDArray[np.float64]]
    source: str

    def at(
        self, longitude_deg: NDArray[np.float64], latitude_deg: NDArray[np.float64], above_mev: Energy = 10
    ) -> NDArray[np.float64]:
        """Flux at places, bilinearly between cells, (n,).

        Raises
        ------
        InputError
            For an energy that the map does not have.
        """
        if above_mev not in self.flux:
            raise InputError(f"protons above {above_mev} MeV, expected {' or '.join(map(str, self.flux))}")
        grid = self.flux[above_mev]
        row = np.clip((np.asarray(latitude_deg, float) + 90) / self.step_deg, 0, grid.shape[0] - 1)
        column = (np.asarray(longitude_deg, float) + 180) / self.step_deg % grid.shape[1]
        i, j = np.minimum(row.astype(int), grid.shape[0] - 2), column.astype(int) % grid.shape[1]
        right, up, along = (j + 1) % grid.shape[1], row - i, column - np.floor(column)
        south = (1 - along) * grid[i, j] + along * grid[i, right]
        north = (1 - along) * grid[i + 1, j] + along * grid[i + 1, right]
        return np.asarray((1 - up) * south + up * north)


@lru_cache(maxsize=1)
def proton_map() -> FluxMap:
    """AP8 at solar maximum, 510 km up: see `tools/build_flux_map.py`."""
    text = resources.files(__package__).joinpath("protons.ecsv").read_text(encoding="utf-8")
    table = parse_ecsv(text, "the embedded map of protons")
    step = float(table.meta["step_deg"])
    row = np.round((np.asarray(table["latitude"]) + 90) / step).astype(int)
    column = np.round((np.asarray(table["longitude"]) + 180) / step).astype(int)
    maps = {}
    for energy in (10, 30):
        grid = np.zeros((round(180 / step) + 1, round(360 / step)))
        grid[row, column] = table[f"above_{energy}_mev"]
        grid.setflags(write=False)
        maps[energy] = grid
    return FluxMap(step, maps, str(table.meta["source"]))
