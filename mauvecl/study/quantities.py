"""Quantities that sweeps, maps and limits vary."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Quantity:
    """Description and range of a quantity."""

    description: str  # for table columns
    axis: str  # axis label, with the unit
    low: float = float("nan")  # range of numbers; NaN for names
    high: float = float("nan")
    unit: str = ""  # in astropy's notation; empty if dimensionless
    suffix: str = ""  # follows a value in a title


QUANTITIES: dict[str, Quantity] = {
    "magnitude": Quantity("magnitude of the star in its band", "magnitude", -2.0, 25.0, "mag"),
    "amplitude": Quantity(
        "flare amplitude: relative rise of the photons in the flare's band", "flare amplitude", 1e-6, 1e4
    ),
    "flare_temperature": Quantity(
        "blackbody temperature of the flare", "flare temperature (K)", 1_000.0, 100_000.0, "K", " K"
    ),
    "balmer_jump": Quantity(
        "flux of the flare just below the Balmer edge over that just above", "Balmer jump ratio", 1.0, 100.0
    ),
    "second_temperature": Quantity(
        "temperature of the flare's second blackbody", "second temperature (K)", 1_000.0, 100_000.0, "K", " K"
    ),
    "second_area": Quantity("area of the flare's second blackbody over that of the first", "second area", 0.0, 1e6),
    "line_scale": Quantity("factor of all line fluxes of the flare", "line fluxes", 0.0, 1e6),
    "exposure": Quantity("length of the exposure", "exposure (s)", 1e-3, 1e7, "s", " s"),
    "detector_temperature": Quantity(
        "temperature of the detector", "detector temperature (deg C)", -100.0, 60.0, "deg_C", " deg C"
    ),
    "sky": Quantity(
        "zodiacal surface brightness in V", "sky brightness (V mag / arcsec²)", 10.0, 30.0, "mag / arcsec2",
        " mag/arcsec2",
    ),
    "star": Quantity("library name or file, with its magnitude", "star"),
}  # fmt: skip
#: Quantities of the flare's spectrum, with their keys in [flare.spectrum].
OF_SPECTRUM = {
    "balmer_jump": "balmer_jump",
    "second_temperature": "second_temperature_k",
    "second_area": "second_area",
    "line_scale": "line_scale",
}
#: Units of the quantities that have one.
UNITS = {name: quantity.unit for name, quantity in QUANTITIES.items() if quantity.unit}
