"""Flux of trapped protons along the orbit, from an embedded map."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mauvecl.schema.errors import InputError

from ..tables.ecsv import parse_ecsv

Energy = Literal[10, 30]


@dataclass(frozen=True, eq=False)
class FluxMap:
    """Omnidirectional flux of trapped protons by sub-satellite point, cm^-2 s^-1."""

    step_deg: float  # spacing of the grid
    # By lower energy limit, MeV; each of shape (n_latitude, n_longitude), from latitude -90 and longitude -180.
    flux: dict[int, NDArray[np.float64]]
    source: str

    def at(
        self, longitude_deg: NDArray[np.float64], latitude_deg: NDArray[np.float64], above_mev: Energy = 10
    ) -> NDArray[np.float64]:
        """Interpolate the flux above an energy bilinearly, shape (n,)."""
        if above_mev not in self.flux:
            raise InputError.of("above_mev", above_mev, " or ".join(map(str, self.flux)))
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
    """Return the map of AP8 at solar maximum, at an altitude of 510 km (see `tools/build_flux_map.py`)."""
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
