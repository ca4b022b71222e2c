"""The orbit, its targets, and the limits of observations, which studies read without importing NumPy."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import model_serializer

from mauvecl.schema.errors import InputError
from mauvecl.schema.fields import Flag, OptionalNumber, Range, Unit, as_typed
from mauvecl.schema.section import Section, read_declinations, setting

#: Model of the orbit: the propagated elements, the mean orbit through them, or the one that suits the distance in time.
OrbitKind = Literal["auto", "tle", "mean"]
#: Angle between two directions; None for no limit.
Separation = Annotated[float | None, Unit("deg"), Range(0, 180), OptionalNumber()]


class Limits(Section):
    """Conditions for a target to be visible. Mauve's own limits are not public: all defaults are assumptions.

    None means no limit; study files say "none".
    """

    earth_limb_deg: Annotated[float | None, Unit("deg"), Range(0, 90), OptionalNumber()] = setting(
        25.0, "Smallest angle from the Earth's limb; or none", flag=Flag("--earth-limb", kind=str)
    )
    sun_deg: Separation = setting(46.0, "Smallest angle from the Sun; or none", flag=Flag("--sun", kind=str))
    moon_deg: Separation = setting(25.0, "Smallest angle from the Moon; or none", flag=Flag("--moon", kind=str))
    declination_deg: Annotated[tuple[float, float] | None, Unit("deg"), OptionalNumber()] = setting(
        (-46.4, 31.8),
        "Field of regard, low:high; or none",
        flag=Flag("--declination", kind=str, read=read_declinations),
        usual="-46.4:31.8",
    )
    normal_cone_deg: Separation = setting(
        None, "Field of regard as a double cone about the orbit's normal; or none", usual="none"
    )
    eclipse: Literal["any", "only", "never"] = setting(
        "any", "Observing in the Earth's shadow", flag="--eclipse", choices="any, only (in the shadow) or never"
    )
    proton_flux: Annotated[float | None, Unit("1 / (cm2 s)"), Range(0, open_low=True), OptionalNumber()] = setting(
        10.0, "Largest flux of protons above 10 MeV; or none", flag=Flag("--protons", kind=str)
    )
    anomaly: Annotated[tuple[tuple[float, float], ...], Unit("deg")] = setting(
        (), "Polygon of longitude and latitude in deg that replaces the map of protons"
    )
    shortest_s: Annotated[float, Unit("s"), Range(0)] = setting(0.0, "Length below which windows are dropped")
    duty_cycle: Annotated[float, Range(0, 1, open_low=True)] = setting(
        1.0, "Fraction of a window in which the star is exposed"
    )

    def _check_values(self) -> None:
        if self.declination_deg is not None:
            low, high = self.declination_deg
            if not -90 <= low < high <= 90:
                raise InputError.of("declination_deg", (low, high), "two rising values within -90 to 90")
        if 0 < len(self.anomaly) < 3:
            raise InputError.of("anomaly", self.anomaly, "a polygon of at least 3 corners")

    @model_serializer(mode="plain")
    def _with_none_as_text(self) -> dict[str, Any]:
        """Write "none" for no limit, since studies leave out what is None."""
        return {name: "none" if value is None else value for name, value in self}

    @property
    def assumptions(self) -> list[tuple[str, str, str]]:
        """Name, value and source of each limit in force."""
        rows, usual = [], type(self)()
        for name, value in self:
            if value in (None, ()) or (name == "proton_flux" and self.anomaly):
                continue
            default, source = getattr(usual, name), SOURCES[name]
            if default not in (None, (), value):
                source = f"set by the user; default {as_typed(default).replace(',', ' ')}: {source}"
            rows.append((name, as_typed(value).replace(",", " "), source))
        return rows


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
    "anomaly": "user-defined polygon that replaces the map of protons",
    "shortest_s": "assumption: no time is lost to pointing and acquisition",
    "duty_cycle": "assumption: the whole window is exposed; the share that Mauve reaches is not public",
}
