"""Compute the map of trapped protons along the orbit, `host/orbit/protons.ecsv`.

python tools/build_flux_map.py        (needs the package aep8; some seconds)

NASA's AP8 at solar maximum in the field of 2026 (IGRF, extrapolated), as IRBEM has it. Cells below the smallest flux
kept are left out; what reads the map takes them as zero.
"""

from __future__ import annotations

import sys
from pathlib import Path

import aep8
import astropy.units as u
import numpy as np
from astropy.coordinates import EarthLocation
from astropy.table import Table
from astropy.time import Time
from astropy.utils import iers

STEP_DEG, HEIGHT_KM, SMALLEST = 2.0, 510.0, 0.1
ENERGIES_MEV = (10, 30)
EPOCH = "2026-09-14T00:00:00"
PLACE = Path(__file__).parent.parent / "host" / "orbit" / "protons.ecsv"


def main() -> None:
    """Write the map."""
    iers.conf.auto_download = False
    longitude, latitude = np.meshgrid(np.arange(-180, 180, STEP_DEG), np.arange(-90, 90.1, STEP_DEG))
    place = EarthLocation.from_geodetic(longitude.ravel() * u.deg, latitude.ravel() * u.deg, HEIGHT_KM * u.km)
    table = Table({"longitude": longitude.ravel(), "latitude": latitude.ravel()})
    for energy in ENERGIES_MEV:
        found = aep8.flux(place, Time(EPOCH), energy * u.MeV, kind="integral", solar="max", particle="p")
        table[f"above_{energy}_mev"] = found.to_value(1 / u.cm**2 / u.s)
    table = table[table["above_10_mev"] >= SMALLEST]
    for name in table.colnames:
        is_flux = name.startswith("above")
        table[name].info.unit = 1 / u.cm**2 / u.s if is_flux else u.deg
        table[name] = [float(f"{value:.3g}") for value in table[name]] * table[name].info.unit
    table.meta = {
        "description": "Omnidirectional flux of trapped protons above an energy; cells not named hold less than "
        f"{SMALLEST:g} above 10 MeV",
        "source": f"NASA AP8 at solar maximum (Sawyer & Vette 1976, NSSDC 76-06) by IRBEM, "
        f"package aep8 {aep8.__version__}",
        "height_km": HEIGHT_KM,
        "step_deg": STEP_DEG,
        "epoch": EPOCH,
        "tag": "C",
    }
    table.write(PLACE, format="ascii.ecsv", overwrite=True)
    sys.stdout.write(f"{PLACE.name}: {len(table)} cells, {PLACE.stat().st_size} bytes\n")


if __name__ == "__main__":
    main()
