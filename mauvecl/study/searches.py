"""A study's search for flares, and the flares that are injected, as data; `surveys` makes of them what is done."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from mauvecl.lightcurve.usual import HALF_WIDTHS_S, RANK, WINDOW_S, Per, check_shape, per_day
from mauvecl.study.nuisances import Spread
from mauvecl.study.sections import Part

if TYPE_CHECKING:
    from mauvecl.lightcurve.search.bank import Bank, Level
    from mauvecl.lightcurve.stares.stare import Stare
    from mauvecl.study.study import Study

#: Orbits over which a level with the orbit's cycle is fitted: fewer cannot tell the cycle from a flare of minutes.
CYCLE_ORBITS = 3.0

Positive = Annotated[float, Field(gt=0)]


class SearchChoice(Part):
    """How a stare is searched for flares, and how many false alarms there may be.

    Attributes
    ----------
    shape : str
    half_widths_s : tuple of float
        Of the bank.
    sums : int
        Of each frame, at most.
    offset, slope : bool
        Whether they are unknown of the level under a flare.
    cycle : bool, optional
        Whether the curves of the stare's unknowns are; where the stare has an unknown cycle by default.
    window_s : float, optional
        Time over which the level is taken for what it is; 1800 s by default, with a cycle three orbits.
    frame : dict of str to float or "free"
        What is unknown of each frame apart from all others, beside the stare's jitters: dark, light, sky, tilt.
    false_alarms : float
    per : {"day", "month", "year"}
        Of star-days of frames.
    null : {"sampled", "counted"}
        Whether the threshold comes from normal noise by importance sampling, or from the stares that are drawn.
    nulls : int
        Stares drawn without a flare.
    points, sigma
        The common rule beside it: so many consecutive points above so many standard deviations.
    """

    shape: str = "davenport2014"
    half_widths_s: Annotated[tuple[Positive, ...], Field(min_length=1)] = HALF_WIDTHS_S
    sums: Annotated[int, Field(ge=1, le=8)] = RANK
    offset: bool = True
    slope: bool = True
    cycle: bool | None = None
    window_s: Annotated[float, Field(ge=0)] | None = None
    frame: dict[Literal["dark", "light", "sky", "tilt"], Spread] = Field(default_factory=dict)
    false_alarms: Positive = 1.0
    per: Per = "month"
    null: Literal["sampled", "counted"] = "sampled"
    nulls: Annotated[int, Field(ge=0, le=1_000_000)] = 100
    points: Annotated[int, Field(ge=1, le=100)] = 3
    sigma: Positive = 3.0

    @model_validator(mode="after")
    def _possible(self) -> Self:
        check_shape(self.shape)
        if list(self.half_widths_s) != sorted(set(self.half_widths_s)):
            raise ValueError(f"search.half_widths_s = {list(self.half_widths_s)}, expected ascending times")
        if self.slope and not self.offset:
            raise ValueError("search.slope without search.offset, expected both or the offset alone")
        return self

    @property
    def rate(self) -> float:
        """False alarms per star-day."""
        return per_day(self.false_alarms, self.per)

    def white_bank(self, frame_s: float) -> Bank:
        """For one sum of each frame and no curves, as closed forms take it."""
        import numpy as np

        from mauvecl.lightcurve.flares.shapes import shape_of
        from mauvecl.lightcurve.search.bank import Bank, Level

        level = Level(self.offset, self.slope, False, WINDOW_S if self.window_s is None else self.window_s)
        return Bank(self.half_widths_s, np.ones((1, 1)), shape_of(self.shape), frame_s, level)

    def level(self, stare: Stare, orbit_s: float) -> Level:
        """What is unknown of the level in a stare."""
        from mauvecl.lightcurve.search.bank import Level

        cycle = self.cycle if self.cycle is not None else any("cosine" in u.name for u in stare.unknowns)
        window = self.window_s if self.window_s is not None else CYCLE_ORBITS * orbit_s if cycle else WINDOW_S
        return Level(self.offset, self.slope, cycle, window)

    def spreads(self) -> dict[str, float]:
        """Of what is unknown in each frame; infinite for what is projected out."""
        return {name: float("inf") if sd == "free" else float(sd) for name, sd in self.frame.items()}


#: What the sizes of injected flares may be.
Size = Literal["amplitude", "duration", "energy", "band_energy"]


class InjectionQuestion(Part):
    """Which flares are injected: sizes x half-widths, of the study's flare temperature and band.

    Attributes
    ----------
    of : {"amplitude", "duration", "energy", "band_energy"}, optional
        Sizes: amplitudes, equivalent durations (s), bolometric energies or those in the flare's band (erg); energies
        where the star's distance or radius is known, amplitudes elsewhere, by default.
    low, high : float, optional
        Smallest and largest size; from what the search should find, by default.
    sizes, widths : int
        How many, evenly in the logarithm.
    half_width_low_s, half_width_high_s : float
    shape : str, optional
        The search's by default.
    count : int
        Injections of each cell.
    positions : int
        Places in the stare at which they peak.
    fitted : int
        Injections of each cell whose flares are fitted, where they are found.
    """

    of: Size | None = None
    low: Positive | None = None
    high: Positive | None = None
    sizes: Annotated[int, Field(ge=2, le=256)] = 16
    widths: Annotated[int, Field(ge=1, le=256)] = 16
    half_width_low_s: Positive = 10.0
    half_width_high_s: Positive = 1800.0
    count: Annotated[int, Field(ge=10, le=10**8)] = 2_000
    positions: Annotated[int, Field(ge=2, le=100_000)] = 40
    fitted: Annotated[int, Field(ge=0, le=100_000)] = 40

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise ValueError(f"injections.low = {self.low:g} and high = {self.high:g}, expected low below high")
        if self.half_width_low_s > self.half_width_high_s:
            raise ValueError(
                f"injections.half_width_low_s = {self.half_width_low_s:g} is above half_width_high_s = "
                f"{self.half_width_high_s:g}, expected it below"
            )
        return self

    @property
    def half_widths_s(self) -> tuple[float, ...]:
        """Half-widths injected."""
        import numpy as np

        if self.widths == 1:
            return (self.half_width_low_s,)
        return tuple(float(w) for w in np.geomspace(self.half_width_low_s, self.half_width_high_s, self.widths))


def without_usual_search(data: dict[str, Any], study: Study) -> None:
    """Leave out of a study's text what it does not say of searches."""
    for name, usual in (("search", SearchChoice()), ("injections", InjectionQuestion())):
        if getattr(study, name) == usual:
            del data[name]
    if "search" in data and not data["search"]["frame"]:
        del data["search"]["frame"]
