"""Observing limits as plain values; `visibility`, which applies them, takes longer to import."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

from mauvecl.schema.errors import InputError

EclipseRule = Literal["any", "only", "never"]


@dataclass(frozen=True)
class Limits:
    """Limits on when a target can be observed. Mauve's own limits are not public: all defaults are assumptions.

    Attributes
    ----------
    earth_limb_deg, sun_deg, moon_deg : float or None
        Smallest angles from the Earth's limb, the Sun and the Moon; None means no limit.
    declination_deg : (low, high) or None
        Field of regard in declination.
    normal_cone_deg : float or None
        Field of regard as a double cone about the orbit's normal.
    eclipse : {"any", "only", "never"}
        Whether to observe in the Earth's shadow.
    proton_flux : float or None
        Largest flux of trapped protons above 10 MeV, cm^-2 s^-1, which excludes the South Atlantic Anomaly.
    anomaly : tuple of (longitude, latitude), deg
        Polygon that replaces the proton map.
    shortest_s : float
        Length below which windows are dropped.
    duty_cycle : float
        Fraction of a window in which the star is exposed.
    """

    earth_limb_deg: float | None = 25.0
    sun_deg: float | None = 46.0
    moon_deg: float | None = 25.0
    declination_deg: tuple[float, float] | None = (-46.4, 31.8)
    normal_cone_deg: float | None = None
    eclipse: EclipseRule = "any"
    proton_flux: float | None = 10.0
    anomaly: tuple[tuple[float, float], ...] = ()
    shortest_s: float = 0.0
    duty_cycle: float = 1.0

    def __post_init__(self) -> None:
        for name, most in (("earth_limb_deg", 90), ("sun_deg", 180), ("moon_deg", 180), ("normal_cone_deg", 180)):
            value = getattr(self, name)
            if value is not None and not 0 <= value <= most:
                raise InputError.of(name, value, f"0 to {most}, or none")
        if self.declination_deg is not None:
            low, high = self.declination_deg
            if not -90 <= low < high <= 90:
                raise InputError.of("declination_deg", (low, high), "two rising values within -90 to 90")
        if self.eclipse not in ("any", "only", "never"):
            raise InputError.of("eclipse", self.eclipse, "any, only or never")
        if self.proton_flux is not None and not self.proton_flux > 0:
            raise InputError.of("proton_flux", self.proton_flux, "> 0 or none")
        if self.anomaly and (
            len(self.anomaly) < 3 or not all(math.isfinite(one) for corner in self.anomaly for one in corner)
        ):
            raise InputError(
                f"anomaly is a polygon of {len(self.anomaly)} corners",
                "at least 3, finite",
                key="anomaly",
                value=self.anomaly,
            )
        if not (math.isfinite(self.shortest_s) and self.shortest_s >= 0):
            raise InputError.of("shortest_s", self.shortest_s, ">= 0")
        if not 0 < self.duty_cycle <= 1:
            raise InputError.of("duty_cycle", self.duty_cycle, "above 0, at most 1")

    @property
    def assumptions(self) -> list[tuple[str, str, str]]:
        """Name, value and source of each limit in force."""
        return [
            (field.name, _text(getattr(self, field.name)), SOURCES[field.name])
            for field in fields(self)
            if getattr(self, field.name) not in (None, ())
        ]


_UVEX = "assumption, borrowed from UVEX (m4opt's definition of that mission); Mauve's own is not public"
#: Sources of the default values.
SOURCES = {
    "earth_limb_deg": _UVEX,
    "sun_deg": _UVEX,
    "moon_deg": _UVEX,
    "declination_deg": "assumption, field of regard in a talk of 2024, before launch; the flown orbit's is not public",
    "normal_cone_deg": "assumption: such a cone of 39.1 deg gives the field of regard of the talk of 2024",
    "eclipse": "assumption: observing is allowed in sunlight and shadow alike",
    "proton_flux": "assumption: no exposures above this flux of protons beyond 10 MeV (AP8 at solar maximum, 510 km)",
    "anomaly": "a polygon of one's own in place of the map of protons",
    "shortest_s": "assumption: no time is lost to pointing and acquisition",
    "duty_cycle": "assumption: the whole window is exposed; the share that Mauve reaches is not public",
}


def _text(value: object) -> str:
    if isinstance(value, tuple):
        return " ".join(_text(one) for one in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
